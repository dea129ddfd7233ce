//! The states of a managed node and what leads from one to another, as rcl has them: names, numbers and order.
//!
//! A node is unconfigured, inactive, active or finalized. Each transition goes through a state of its own, in which
//! work is done; here nothing takes time or fails, so that nobody finds the node in one of those.

use super::messages::lifecycle_msgs::{State, Transition, TransitionDescription};

/// Where the node is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Lifecycle {
    /// It has a model, but no task.
    Unconfigured = 1,
    /// It hears its task, and answers nothing.
    Inactive = 2,
    /// It serves.
    Active = 3,
    /// It is over; only its end comes after it.
    Finalized = 4,
}

/// A transition that a client may ask for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Step {
    /// The transition.
    id: u8,
    label: &'static str,
    from: Lifecycle,
    /// The state in between.
    between: u8,
    to: Lifecycle,
    /// The transition with which the one in between is left.
    success: u8,
}

impl Step {
    /// Where it leads.
    pub fn goal(&self) -> Lifecycle {
        self.to
    }

    /// Its two parts, as a transition event tells them.
    pub fn events(&self) -> [TransitionDescription; 2] {
        [
            described(self.id, self.label, self.from as u8, self.between),
            described(self.success, SUCCESS, self.between, self.to as u8),
        ]
    }
}

/// Labels of states by their numbers, in rcl's order.
const STATES: [(u8, &str); 11] = [
    (0, "unknown"),
    (1, "unconfigured"),
    (2, "inactive"),
    (3, "active"),
    (4, "finalized"),
    (10, "configuring"),
    (11, "cleaningup"),
    (12, "shuttingdown"),
    (13, "activating"),
    (14, "deactivating"),
    (15, "errorprocessing"),
];
const ERROR_PROCESSING: u8 = 15;

const SUCCESS: &str = "transition_success";
const FAILURE: &str = "transition_failure";
const ERROR: &str = "transition_error";

/// What may be asked for, in rcl's order.
const STEPS: [Step; 7] = {
    use Lifecycle::{Active, Finalized, Inactive, Unconfigured};
    const fn step(
        id: u8,
        label: &'static str,
        from: Lifecycle,
        between: u8,
        to: Lifecycle,
        success: u8,
    ) -> Step {
        Step { id, label, from, between, to, success }
    }
    [
        step(1, "configure", Unconfigured, 10, Inactive, 10),
        step(2, "cleanup", Inactive, 11, Unconfigured, 20),
        step(3, "activate", Inactive, 13, Active, 30),
        step(4, "deactivate", Active, 14, Inactive, 40),
        step(5, "shutdown", Unconfigured, 12, Finalized, 50),
        step(6, "shutdown", Inactive, 12, Finalized, 50),
        step(7, "shutdown", Active, 12, Finalized, 50),
    ]
};

impl Lifecycle {
    /// Number and label.
    pub fn state(self) -> State {
        state(self as u8)
    }

    /// The transition that a client asks for, by its label where it gives one, else by its number; none where it
    /// does not lead away from here.
    pub fn step(self, asked: &Transition) -> Option<Step> {
        let is_asked = |step: &&Step| match asked.label.as_str() {
            "" => step.id == asked.id,
            label => step.label == label,
        };
        STEPS.iter().filter(|step| step.from == self).find(is_asked).copied()
    }

    /// The transitions that lead away from here.
    pub fn available(self) -> Vec<TransitionDescription> {
        let steps = STEPS.iter().filter(|step| step.from == self);
        steps.map(|step| described(step.id, step.label, step.from as u8, step.between)).collect()
    }

    /// The labels of those, for a person.
    pub fn ways_on(self) -> String {
        let steps = STEPS.iter().filter(|step| step.from == self);
        let labels: Vec<_> = steps.map(|step| step.label).collect();
        if labels.is_empty() { "nothing".into() } else { labels.join(", ") }
    }
}

/// All states.
pub fn states() -> Vec<State> {
    STATES.iter().map(|(id, _)| state(*id)).collect()
}

/// All transitions.
pub fn graph() -> Vec<TransitionDescription> {
    let mut transitions = Vec::new();
    // Where what happens in between leads by success, by failure and by error.
    let mut outcomes = |between: u8, success: (u8, Lifecycle), failure: Lifecycle, error: u8| {
        let (first, to) = success;
        transitions.push(described(first, SUCCESS, between, to as u8));
        transitions.push(described(first + 1, FAILURE, between, failure as u8));
        transitions.push(described(first + 2, ERROR, between, error));
    };
    outcomes(10, (10, Lifecycle::Inactive), Lifecycle::Unconfigured, ERROR_PROCESSING);
    outcomes(11, (20, Lifecycle::Unconfigured), Lifecycle::Inactive, ERROR_PROCESSING);
    outcomes(13, (30, Lifecycle::Active), Lifecycle::Inactive, ERROR_PROCESSING);
    outcomes(14, (40, Lifecycle::Inactive), Lifecycle::Active, ERROR_PROCESSING);
    outcomes(12, (50, Lifecycle::Finalized), Lifecycle::Finalized, ERROR_PROCESSING);
    let finalized = Lifecycle::Finalized;
    outcomes(ERROR_PROCESSING, (60, Lifecycle::Unconfigured), finalized, finalized as u8);
    let asked =
        STEPS.iter().map(|step| described(step.id, step.label, step.from as u8, step.between));
    asked.chain(transitions).collect()
}

fn state(id: u8) -> State {
    let label = STATES.iter().find(|(known, _)| *known == id).map_or("unknown", |(_, label)| label);
    State { id, label: label.into() }
}

fn described(id: u8, label: &str, from: u8, to: u8) -> TransitionDescription {
    TransitionDescription {
        transition: Transition { id, label: label.into() },
        start_state: state(from),
        goal_state: state(to),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asked(id: u8, label: &str) -> Transition {
        Transition { id, label: label.into() }
    }

    #[test]
    fn a_node_is_brought_up_and_down_by_labels_and_by_numbers() {
        let mut at = Lifecycle::Unconfigured;
        for (transition, goal) in [
            (asked(1, ""), Lifecycle::Inactive),
            (asked(0, "activate"), Lifecycle::Active),
            // The label counts.
            (asked(99, "deactivate"), Lifecycle::Inactive),
            (asked(2, ""), Lifecycle::Unconfigured),
            (asked(0, "shutdown"), Lifecycle::Finalized),
        ] {
            let step = at.step(&transition).unwrap();
            let [left, arrived] = step.events();
            assert_eq!(left.start_state, at.state());
            assert_eq!(
                (&left.goal_state, &arrived.goal_state),
                (&arrived.start_state, &goal.state())
            );
            at = step.goal();
            assert_eq!(at, goal);
        }
        assert_eq!(at.ways_on(), "nothing");
    }

    #[test]
    fn what_does_not_lead_away_from_here_is_refused() {
        assert_eq!(Lifecycle::Unconfigured.step(&asked(3, "")), None);
        assert_eq!(Lifecycle::Active.step(&asked(1, "configure")), None);
        assert_eq!(Lifecycle::Active.step(&asked(5, "")), None, "the shutdown of another state");
        assert_eq!(Lifecycle::Finalized.step(&asked(0, "shutdown")), None);
        assert_eq!(Lifecycle::Inactive.step(&asked(0, "")), None);
    }

    #[test]
    fn the_graph_holds_every_way_that_is_available() {
        let graph = graph();
        assert_eq!((graph.len(), states().len()), (25, 11));
        use Lifecycle::{Active, Finalized, Inactive, Unconfigured};
        for at in [Unconfigured, Inactive, Active, Finalized] {
            assert!(at.available().iter().all(|way| graph.contains(way)));
        }
    }
}
