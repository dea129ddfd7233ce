//! The node as a managed one: who asks is told where it is, and may lead it elsewhere.

use std::sync::Arc;

use tokio::task::JoinSet;

use super::super::lifecycle::{self, Lifecycle};
use super::super::messages::lifecycle_msgs::{
    ChangeStateRequest, ChangeStateResponse, EmptyRequest, GetAvailableStatesResponse,
    GetAvailableTransitionsResponse, GetStateResponse, Transition, TransitionDescription,
    TransitionEvent,
};
use super::super::state::NodeState;
use super::super::wiring::{Reply, WiringError, answer};
use super::{Shared, lock, with};
use crate::serving::{ErrorCode, Refusal};

impl Shared {
    /// Nothing is served but by an active node, and nothing that was asked for before it was last activated.
    pub(super) fn check_active(
        &self,
        state: &NodeState,
        asked_in: Option<u64>,
    ) -> Result<(), Refusal> {
        match (state.activation(), asked_in) {
            (None, _) => Err(self.not_active(state.lifecycle)),
            (now, asked) if now == asked => Ok(()),
            _ => Err(Refusal::new(
                ErrorCode::NotActive,
                "the node was not active all the time since this was asked for; ask again",
            )),
        }
    }

    pub(super) fn not_active(&self, at: Lifecycle) -> Refusal {
        let next = match at {
            Lifecycle::Unconfigured => "configure it, then activate it",
            Lifecycle::Inactive | Lifecycle::Active => "activate it",
            Lifecycle::Finalized => "start it again",
        };
        let (state, name) = (at.state().label, &self.names);
        let command = match at {
            Lifecycle::Finalized => String::new(),
            _ => format!(": ros2 lifecycle set {name} {}", at.ways_on().replace(", ", "|")),
        };
        Refusal::new(ErrorCode::NotActive, format!("the node is {state}; {next}{command}"))
    }

    pub(super) fn serve_lifecycle(
        self: &Arc<Self>,
        tasks: &mut JoinSet<()>,
    ) -> Result<(), WiringError> {
        let mut wiring = self.wiring();

        let server = wiring.service("~/change_state", ("lifecycle_msgs", "ChangeState"))?;
        let shared = Arc::downgrade(self);
        tasks.spawn(answer(server, move |request: ChangeStateRequest, reply: Reply<_, _>| {
            if let Some(success) = with(&shared, |shared| shared.change_state(&request.transition))
            {
                reply.send(ChangeStateResponse { success });
            }
            async {}
        }));

        let server = wiring.service("~/get_state", ("lifecycle_msgs", "GetState"))?;
        let shared = Arc::downgrade(self);
        tasks.spawn(answer(server, move |_: EmptyRequest, reply: Reply<_, _>| {
            if let Some(current_state) = with(&shared, |shared| shared.state().lifecycle.state()) {
                reply.send(GetStateResponse { current_state });
            }
            async {}
        }));

        let server =
            wiring.service("~/get_available_states", ("lifecycle_msgs", "GetAvailableStates"))?;
        tasks.spawn(answer(server, move |_: EmptyRequest, reply: Reply<_, _>| {
            reply.send(GetAvailableStatesResponse { available_states: lifecycle::states() });
            async {}
        }));

        let transitions = ("lifecycle_msgs", "GetAvailableTransitions");
        let server = wiring.service("~/get_available_transitions", transitions)?;
        let shared = Arc::downgrade(self);
        tasks.spawn(answer(server, move |_: EmptyRequest, reply: Reply<_, _>| {
            let available = with(&shared, |shared| shared.state().lifecycle.available());
            if let Some(available_transitions) = available {
                reply.send(GetAvailableTransitionsResponse { available_transitions });
            }
            async {}
        }));

        let server = wiring.service("~/get_transition_graph", transitions)?;
        tasks.spawn(answer(server, move |_: EmptyRequest, reply: Reply<_, _>| {
            let available_transitions = lifecycle::graph();
            reply.send(GetAvailableTransitionsResponse { available_transitions });
            async {}
        }));
        Ok(())
    }

    /// Leads the node elsewhere; whether it is there.
    fn change_state(&self, asked: &Transition) -> bool {
        let step = {
            // Those that wait, too, are asked for in the state that is left.
            let mut waiting = lock(&self.waiting);
            let mut state = self.state();
            let at = state.lifecycle;
            let Some(step) = at.step(asked) else {
                log::warn!(
                    "the transition {} ({:?}) does not lead away from {}; {} does",
                    asked.id,
                    asked.label,
                    at.state().label,
                    at.ways_on()
                );
                return false;
            };
            match step.goal() {
                Lifecycle::Unconfigured => {
                    state.server.forget();
                    waiting.clear();
                }
                Lifecycle::Finalized => waiting.clear(),
                Lifecycle::Inactive => waiting.retain(|given| !given.is_goal),
                Lifecycle::Active => {}
            }
            if state.lifecycle == Lifecycle::Active {
                self.previewed.send_replace(None);
                self.execution.refuse(self.not_active(step.goal()));
            }
            state.move_to(step.goal());
            step
        };
        log::info!("the node is {}", step.goal().state().label);
        let timestamp = u64::try_from(self.stamp().to_nanos()).unwrap_or_default();
        for event in step.events() {
            let TransitionDescription { transition, start_state, goal_state } = event;
            let event = TransitionEvent { timestamp, transition, start_state, goal_state };
            if let Err(e) = self.transition_event.publish(event) {
                log::warn!("a transition event could not be sent: {e}");
            }
        }
        true
    }
}
