//! `~/execute`: samples a motion, checks it, and has a controller drive it.
//!
//! Every goal is accepted, so that its result can say in words what is wrong with it; only an id that is known, or
//! too many goals at once, are rejected. One goal drives at a time; the others are BUSY.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, Weak};
use std::time::{Duration, Instant};

use futures::StreamExt;
use ros2_client::action::{
    CancelGoalResponse, FeedbackMessage, GetResultRequest, GetResultResponse, GoalId, GoalInfo,
    GoalStatusEnum, SendGoalRequest, SendGoalResponse,
};
use ros2_client::action_msgs::GoalStatusArray;
use ros2_client::builtin_interfaces::Time as StampTime;
use ros2_client::{Context, Publisher, RmwRequestId};
use tokio::sync::{oneshot, watch};
use tokio::task::JoinSet;
use tokio::time::MissedTickBehavior;

use super::super::goals::Goals;
use super::super::messages::action_msgs::CancelGoalRequest;
use super::super::messages::control_msgs::{
    FollowJointTrajectoryFeedback, FollowJointTrajectoryGoal, FollowJointTrajectoryResult,
};
use super::super::messages::tcvae_msgs::{
    self, ExecuteFeedback, ExecuteGoal, ExecuteResult, SampleTrajectoryRequest,
};
use super::super::wiring::{
    ActionClient, ActionServer, Reply, Service, Wiring, WiringError, answer,
};
use super::locations::may_come;
use super::{Shared, Turn, convert, lock, with};
use crate::serving::{ErrorCode, Refusal, Sample, SampleRequest, StartPolicy};

/// How often a client hears how far its goal is.
const FEEDBACK_PERIOD: Duration = Duration::from_millis(100);
/// How often a controller that is to stop is told so, and how often it is looked for.
const REPEAT: Duration = Duration::from_millis(500);
/// From when an endpoint is discovered until it is matched (measured: below 20 ms on loopback).
const MATCHING: Duration = Duration::from_millis(100);
/// How long a controller's late acceptance of a goal is looked out for.
const LATE: Duration = Duration::from_secs(60);
/// How long a result is kept before it is forgotten, at most.
const SWEEP: Duration = Duration::from_secs(11);

type ResultReply = Reply<GetResultRequest, GetResultResponse<ExecuteResult>>;

/// The action, its goals, and the controller that drives.
pub(super) struct Execution {
    goals: Mutex<Goals<ExecuteResult, ResultReply>>,
    /// The way to stop each goal that is under way.
    stops: Mutex<BTreeMap<GoalId, watch::Sender<Option<Stop>>>>,
    controller: Mutex<Option<Arc<Controller>>>,
    /// Held by the goal that drives.
    driving: tokio::sync::Mutex<()>,
    feedback: Publisher<FeedbackMessage<ExecuteFeedback>>,
    status: Publisher<GoalStatusArray>,
}

/// The rest of the action's endpoints, which its tasks own.
pub(super) struct Requests {
    goals: Service<SendGoalRequest<ExecuteGoal>, SendGoalResponse>,
    cancels: Service<CancelGoalRequest, CancelGoalResponse>,
    results: Service<GetResultRequest, GetResultResponse<ExecuteResult>>,
}

/// Why a goal is stopped.
#[derive(Debug, Clone, PartialEq)]
enum Stop {
    /// A client wants it.
    Canceled,
    /// The node does not serve any more.
    Refused(Refusal),
}

/// How a goal that was not refused ends.
enum End {
    Driven(Box<Sample>),
    Canceled,
    /// With the motion that was driven so far.
    Failed(Refusal, Option<Box<Sample>>),
}

impl From<Refusal> for End {
    fn from(refusal: Refusal) -> Self {
        Self::Failed(refusal, None)
    }
}

/// A server of `control_msgs/action/FollowJointTrajectory`.
struct Controller {
    /// As the parameter has it.
    name: String,
    client: ActionClient<
        FollowJointTrajectoryGoal,
        FollowJointTrajectoryResult,
        FollowJointTrajectoryFeedback,
    >,
    participant: rustdds::DomainParticipant,
}

/// What others than Rust call a controller's action.
const FOLLOW_JOINT_TRAJECTORY: (&str, &str) = ("control_msgs", "FollowJointTrajectory");
const GOAL_TYPE: &str = "control_msgs::action::dds_::FollowJointTrajectory_SendGoal_Request_";

impl Controller {
    fn new(name: &str, wiring: &mut Wiring, context: &Context) -> Result<Self, WiringError> {
        let client = wiring.action_client(name, FOLLOW_JOINT_TRAJECTORY)?;
        Ok(Self { name: name.into(), client, participant: context.domain_participant() })
    }

    /// Whether somebody serves the action.
    fn is_there(&self) -> bool {
        let name = |kind: &str, what: &str| format!("{kind}{}/_action/{what}", self.client.action);
        let requests = [name("rq", "send_goalRequest"), name("rq", "get_resultRequest")];
        let answers = [name("rr", "send_goalReply"), name("rr", "get_resultReply")];
        let readers = self.participant.discovered_readers();
        let writers = self.participant.discovered_writers();
        let reads = |topic: &String| {
            readers.iter().any(|reader| reader.subscription_topic_data.topic_name() == topic)
        };
        let writes = |topic: &String| {
            writers.iter().any(|writer| writer.publication_topic_data.topic_name() == topic)
        };
        requests.iter().all(reads) && answers.iter().all(writes)
    }

    /// The actions of this type that there are instead.
    fn others(&self) -> Vec<String> {
        let readers = self.participant.discovered_readers();
        let goals =
            readers.iter().filter(|reader| reader.subscription_topic_data.type_name() == GOAL_TYPE);
        let mut names: Vec<String> = goals
            .filter_map(|reader| {
                let topic = reader.subscription_topic_data.topic_name();
                topic.strip_prefix("rq")?.strip_suffix("/_action/send_goalRequest").map(Into::into)
            })
            .collect();
        names.sort();
        names.dedup();
        names
    }

    /// Returns when somebody serves the action.
    async fn found(&self, timeout: Duration) -> Result<(), Refusal> {
        if self.is_there() {
            return Ok(());
        }
        let deadline = Instant::now() + timeout;
        while Instant::now() < deadline {
            tokio::time::sleep(Duration::from_millis(20)).await;
            if self.is_there() {
                tokio::time::sleep(MATCHING).await;
                return Ok(());
            }
        }
        let next = match self.others().as_slice() {
            [] => "no other is there either; start the controller".to_owned(),
            others => format!("there is {}; set the parameter to it", others.join(", ")),
        };
        Err(rejected(format!(
            "nobody serves the action {} (execute.controller) after {:.1} s; {next}",
            self.client.action,
            timeout.as_secs_f64()
        )))
    }

    /// Hands a goal over.
    fn send(
        &self,
        goal_id: GoalId,
        goal: FollowJointTrajectoryGoal,
    ) -> Result<RmwRequestId, Refusal> {
        let sent = self.client.goals.send_request(SendGoalRequest { goal_id, goal });
        sent.map_err(|e| {
            rejected(format!("{} could not be asked to drive: {e}", self.client.action))
        })
    }

    /// Whether the controller takes a goal that was handed over. One that is not answered in time is canceled,
    /// also when it is accepted later.
    async fn accepted(
        self: &Arc<Self>,
        goal_id: GoalId,
        request: RmwRequestId,
        timeout: Duration,
    ) -> Result<(), NotAccepted> {
        let (sender, receiver) = oneshot::channel();
        let controller = Arc::clone(self);
        tokio::spawn(async move {
            let asked = controller.client.goals.async_receive_response(request);
            let answer = match tokio::time::timeout(LATE, asked).await {
                Err(_) => return,
                Ok(Ok(answer)) => Ok(answer.accepted),
                Ok(Err(e)) => Err(e.to_string()),
            };
            if let Err(Ok(true)) = sender.send(answer) {
                controller.stop_late(goal_id).await;
            }
        });
        let action = &self.client.action;
        match tokio::time::timeout(timeout, receiver).await {
            Ok(Ok(Ok(true))) => Ok(()),
            Ok(Ok(Ok(false))) => Err(NotAccepted::Refused(rejected(format!(
                "{action} rejected the motion; its log says why (often joints that it does not have, or a \
                 controller that is not active)"
            )))),
            Ok(Ok(Err(e))) => Err(NotAccepted::Silent(rejected(format!(
                "{action} gave no answer that can be read: {e}"
            )))),
            Ok(Err(_)) | Err(_) => {
                self.cancel(goal_id);
                Err(NotAccepted::Silent(rejected(format!(
                    "{action} did not answer within {:.1} s (execute.timeout_s), and the motion was canceled; \
                     see whether it runs",
                    timeout.as_secs_f64()
                ))))
            }
        }
    }

    /// Tells the controller to stop a goal that it accepted too late, until it says how that ended. Nothing is dropped
    /// before: a controller does not read what it has of a client that has left.
    async fn stop_late(&self, goal_id: GoalId) {
        let action = &self.client.action;
        log::warn!("{action} accepted a goal too late; it is canceled");
        let asked = self.client.results.async_call_service(GetResultRequest { goal_id });
        let told = async {
            let mut repeat = tokio::time::interval(REPEAT);
            loop {
                repeat.tick().await;
                if !self.is_there() {
                    return;
                }
                self.cancel(goal_id);
            }
        };
        tokio::select! {
            answer = asked => match answer {
                Ok(answer) => log::info!("{action} ended that goal: {:?}", answer.status),
                Err(e) => log::error!("{action} gave no result that can be read: {e}; see whether the arm moves"),
            },
            () = told => log::error!("{action} left with that goal; nobody knows what the arm does now"),
            () = tokio::time::sleep(LATE) => {
                log::error!("{action} does not say that it ended that goal; the arm may still move");
            }
        }
    }

    fn cancel(&self, goal_id: GoalId) {
        let goal_info = GoalInfo { goal_id, stamp: StampTime::ZERO };
        if let Err(e) = self.client.cancels.send_request(CancelGoalRequest { goal_info }) {
            log::error!("{} can't be told to stop: {e}", self.client.action);
        }
    }
}

enum NotAccepted {
    /// The controller said no.
    Refused(Refusal),
    /// It said nothing, and may say so later; this client of it is not used again.
    Silent(Refusal),
}

fn rejected(message: String) -> Refusal {
    Refusal::new(ErrorCode::ControllerRejected, message)
}

fn aborted(message: String) -> Refusal {
    Refusal::new(ErrorCode::ControllerAborted, message)
}

impl Execution {
    pub(super) fn new(wiring: &mut Wiring) -> Result<(Self, Requests), WiringError> {
        let ActionServer { goals, cancels, results, feedback, status } =
            wiring.action_server("~/execute", ("tcvae_msgs", "Execute"))?;
        let execution = Self {
            goals: Mutex::default(),
            stops: Mutex::default(),
            controller: Mutex::default(),
            driving: tokio::sync::Mutex::default(),
            feedback,
            status,
        };
        Ok((execution, Requests { goals, cancels, results }))
    }

    /// Stops every goal that is under way.
    fn stop(&self, why: &Stop) {
        for stop in lock(&self.stops).values() {
            stop.send_replace(Some(why.clone()));
        }
    }

    /// Stops every goal, and waits until the arm was told so, but not for ever.
    pub(super) async fn end(&self) {
        let message = "the node was stopped, and the controller told to stop";
        self.stop(&Stop::Refused(Refusal::new(ErrorCode::NotActive, message)));
        let deadline = Instant::now() + Duration::from_secs(2);
        while !lock(&self.stops).is_empty() && Instant::now() < deadline {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    }

    /// Stops every goal of a node that serves no more.
    pub(super) fn refuse(&self, refusal: Refusal) {
        self.stop(&Stop::Refused(refusal));
    }

    fn publish_status(&self) {
        let statuses = lock(&self.goals).statuses();
        if let Err(e) = self.status.publish(statuses) {
            log::warn!("the states of the goals could not be sent: {e}");
        }
    }

    fn publish_feedback(&self, goal_id: GoalId, stage: &str, progress: f64, error: f64) {
        let (stage, max_tracking_error) = (stage.into(), error);
        let feedback = ExecuteFeedback { stage, progress, max_tracking_error };
        if let Err(e) = self.feedback.publish(FeedbackMessage { goal_id, feedback }) {
            log::debug!("how far a goal is could not be sent: {e}");
        }
    }
}

impl Shared {
    pub(super) fn serve_execute(self: &Arc<Self>, requests: Requests, tasks: &mut JoinSet<()>) {
        let Requests { goals, cancels, results } = requests;
        let shared = Arc::downgrade(self);
        tasks.spawn(answer(goals, move |request: SendGoalRequest<ExecuteGoal>, reply| {
            with(&shared, |shared| shared.new_goal(request, &reply));
            async {}
        }));
        let shared = Arc::downgrade(self);
        tasks.spawn(answer(cancels, move |request: CancelGoalRequest, reply: Reply<_, _>| {
            with(&shared, |shared| {
                let canceled = lock(&shared.execution.goals).cancel(&request.goal_info);
                {
                    let stops = lock(&shared.execution.stops);
                    for goal in &canceled.goals_canceling {
                        if let Some(stop) = stops.get(&goal.goal_id) {
                            stop.send_replace(Some(Stop::Canceled));
                        }
                    }
                }
                if !canceled.goals_canceling.is_empty() {
                    shared.execution.publish_status();
                }
                reply.send(canceled);
            });
            async {}
        }));
        let shared = Arc::downgrade(self);
        tasks.spawn(answer(results, move |request: GetResultRequest, reply: ResultReply| {
            with(&shared, |shared| {
                let mut goals = lock(&shared.execution.goals);
                goals.forget(Instant::now());
                let answered = goals.result(request.goal_id, reply);
                drop(goals);
                if let Some((reply, answer)) = answered {
                    reply.send(answer);
                }
            });
            async {}
        }));
    }

    /// Makes the client of the controller that the parameter names, if there is none yet.
    pub(super) fn sync_controller(&self) {
        let name = self.state().controller.clone();
        let mut controller = lock(&self.execution.controller);
        if controller.as_ref().is_some_and(|controller| controller.name == name) {
            return;
        }
        *controller = None;
        if name.is_empty() {
            return;
        }
        match Controller::new(&name, &mut self.wiring(), &self.context) {
            Ok(new) => *controller = Some(Arc::new(new)),
            Err(e) => log::error!("there is no way to the controller: {e}"),
        }
    }

    fn new_goal(
        self: &Arc<Self>,
        request: SendGoalRequest<ExecuteGoal>,
        reply: &Reply<SendGoalRequest<ExecuteGoal>, SendGoalResponse>,
    ) {
        let SendGoalRequest { goal_id, goal } = request;
        let stamp = self.stamp();
        let (stop, stopped) = watch::channel(None);
        let accepted = {
            let mut goals = lock(&self.execution.goals);
            goals.forget(Instant::now());
            let accepted = goals.accept(goal_id, stamp);
            if accepted {
                // While nobody can cancel it, who would find no way to stop it.
                lock(&self.execution.stops).insert(goal_id, stop);
            }
            accepted
        };
        if !accepted {
            log::warn!("goal {goal_id:?} rejected: its id is known, or too many are under way");
            reply.send(SendGoalResponse { accepted, stamp });
            return;
        }
        let activation = self.state().activation();
        // What is told of the goal comes after its acceptance.
        reply.send(SendGoalResponse { accepted, stamp });
        self.execution.publish_status();
        tokio::spawn(Arc::clone(self).pursue(goal_id, goal, activation, stopped));
    }

    async fn pursue(
        self: Arc<Self>,
        goal_id: GoalId,
        goal: ExecuteGoal,
        activation: Option<u64>,
        stopped: watch::Receiver<Option<Stop>>,
    ) {
        lock(&self.execution.goals).begin(goal_id);
        self.execution.publish_status();
        let end = self.execute(goal_id, goal, activation, stopped).await.unwrap_or_else(|end| end);
        let (status, refusal, sample) = match end {
            End::Driven(sample) => (GoalStatusEnum::Succeeded, None, Some(sample)),
            End::Canceled => (GoalStatusEnum::Canceled, None, None),
            End::Failed(refusal, sample) => (GoalStatusEnum::Aborted, Some(refusal), sample),
        };
        match (&refusal, status) {
            (Some(refusal), _) => log::warn!("goal {goal_id:?} aborted: {refusal}"),
            (None, GoalStatusEnum::Canceled) => log::info!("goal {goal_id:?} canceled"),
            _ => log::info!("goal {goal_id:?} succeeded"),
        }
        let (error_code, error_message) = convert::error(refusal.as_ref());
        let sample: tcvae_msgs::Sample =
            sample.map(|sample| self.frames.sample(&sample)).unwrap_or_default();
        let result = ExecuteResult { error_code, error_message, sample };
        let waiting =
            lock(&self.execution.goals).end(goal_id, status, result.clone(), Instant::now());
        self.execution.publish_status();
        for reply in waiting {
            reply.send(GetResultResponse { status, result: result.clone() });
        }
        lock(&self.execution.stops).remove(&goal_id);
        let shared: Weak<Self> = Arc::downgrade(&self);
        drop(self);
        tokio::time::sleep(SWEEP).await;
        with(&shared, |shared| lock(&shared.execution.goals).forget(Instant::now()));
    }

    /// From the goal to the end of the motion.
    async fn execute(
        self: &Arc<Self>,
        goal_id: GoalId,
        goal: ExecuteGoal,
        activation: Option<u64>,
        mut stopped: watch::Receiver<Option<Stop>>,
    ) -> Result<End, End> {
        self.check_active(&self.state(), activation)?;
        let Ok(_driving) = self.execution.driving.try_lock() else {
            return Err(Refusal::new(
                ErrorCode::Busy,
                "another goal is driving the arm; wait for its end, or cancel it",
            )
            .into());
        };
        self.execution.publish_feedback(goal_id, "sampling", 0.0, 0.0);
        let sample = tokio::select! {
            sample = self.motion(goal) => sample?,
            stop = reason(&mut stopped) => return Err(ended(stop, None)),
        };
        let (controller, timeout) = {
            let state = self.state();
            let timeout = Duration::from_secs_f64(state.controller_timeout_secs);
            let controller = lock(&self.execution.controller).clone();
            let controller = controller.ok_or_else(|| {
                rejected(
                    "no controller is set; set execute.controller to the name of its action, such as \
                     /joint_trajectory_controller/follow_joint_trajectory"
                        .into(),
                )
            })?;
            (controller, timeout)
        };
        tokio::select! {
            found = controller.found(timeout) => found?,
            stop = reason(&mut stopped) => return Err(ended(stop, None)),
        }
        let trajectory = self.frames.joint_trajectory(&sample.joint_trajectory);
        let drive = GoalId::new_random();
        let goal = FollowJointTrajectoryGoal { trajectory, ..FollowJointTrajectoryGoal::default() };
        let request = {
            // Nobody deactivates the node while this is held, so that no motion leaves an inactive one.
            let state = self.state();
            self.check_active(&state, activation)?;
            let request = controller.send(drive, goal)?;
            self.show_motion(&state, &sample);
            request
        };
        match controller.accepted(drive, request, timeout).await {
            Ok(()) => {}
            Err(NotAccepted::Refused(refusal)) => {
                self.previewed.send_replace(None);
                return Err(refusal.into());
            }
            Err(NotAccepted::Silent(refusal)) => {
                self.previewed.send_replace(None);
                // Its answers are not to be taken for those to another goal.
                *lock(&self.execution.controller) = None;
                self.sync_controller();
                return Err(refusal.into());
            }
        }
        log::info!("{} drives goal {goal_id:?}", controller.client.action);
        let end = self.follow(goal_id, drive, &controller, &sample, timeout, &mut stopped).await;
        match end {
            Ok(()) => Ok(End::Driven(sample)),
            Err(End::Failed(refusal, _)) => Err(End::Failed(refusal, Some(sample))),
            Err(end) => Err(end),
        }
    }

    /// The motion of a goal, sampled and checked.
    async fn motion(self: &Arc<Self>, goal: ExecuteGoal) -> Result<Box<Sample>, Refusal> {
        let received = Instant::now();
        let request = self.driven_request(goal, received).await?;
        let (sender, receiver) = oneshot::channel();
        self.sample(Turn::Answer, received, request, move |_, reply, _| {
            // Who waited may have been stopped.
            let _ = sender.send(reply);
        })?;
        let broken = || Refusal::new(ErrorCode::Internal, "the sampling thread gave no answer");
        let reply = receiver.await.map_err(|_| broken())?;
        match (reply.refusal, reply.samples.into_iter().next()) {
            (Some(refusal), _) => Err(refusal),
            (None, Some(sample)) => Ok(Box::new(sample)),
            (None, None) => Err(broken()),
        }
    }

    /// The core's form of a goal, when the transforms that it needs are known.
    async fn driven_request(
        &self,
        goal: ExecuteGoal,
        received: Instant,
    ) -> Result<SampleRequest, Refusal> {
        let ExecuteGoal {
            task,
            manner_names,
            manner_values,
            sample_manner,
            seed,
            velocity_scale,
            acceleration_scale,
            start_policy,
            allow_out_of_distribution,
        } = goal;
        let start_policy = match start_policy.as_str() {
            "" => None,
            "approach" => Some(StartPolicy::Approach),
            "refuse" => Some(StartPolicy::Refuse),
            "ignore" => Some(StartPolicy::Ignore),
            other => {
                return Err(Refusal::new(
                    ErrorCode::BadRequest,
                    format!("start_policy is {other:?}; it is empty, approach, refuse or ignore"),
                ));
            }
        };
        let all_framed = task.iter().all(|t| !t.point.header.frame_id.is_empty());
        let message = SampleTrajectoryRequest {
            task,
            manner_names,
            manner_values,
            sample_manner,
            seed,
            velocity_scale,
            acceleration_scale,
            allow_out_of_distribution,
            ..SampleTrajectoryRequest::default()
        };
        let request = |shared: &Self| shared.frames.request(&lock(&shared.tree), message.clone());
        let request = match request(self) {
            Err(refusal) if all_framed && may_come(&refusal) => {
                self.once_heard(received, request).await
            }
            request => request,
        };
        Ok(SampleRequest { start_policy, is_driven: true, ..request? })
    }

    /// Watches over a motion that a controller drives, until it ends one way or another.
    async fn follow(
        &self,
        goal_id: GoalId,
        drive: GoalId,
        controller: &Controller,
        sample: &Sample,
        timeout: Duration,
        stopped: &mut watch::Receiver<Option<Stop>>,
    ) -> Result<(), End> {
        let action = &controller.client.action;
        let times = &sample.joint_trajectory.times_secs;
        let duration_secs = times.last().copied().unwrap_or_default();
        let approach_secs = match sample.primitive_start_index {
            0 => 0.0,
            first => times.get(first as usize).copied().unwrap_or_default(),
        };
        let grace_secs = self.state().controller_grace_secs;
        let began = self.stamp();
        let asked =
            controller.client.results.async_call_service(GetResultRequest { goal_id: drive });
        tokio::pin!(asked);
        let mut heard = Box::pin(controller.client.feedback.async_stream());
        let mut tick = tokio::time::interval(FEEDBACK_PERIOD);
        tick.set_missed_tick_behavior(MissedTickBehavior::Skip);
        let mut repeat = tokio::time::interval(REPEAT);
        repeat.set_missed_tick_behavior(MissedTickBehavior::Skip);
        let mut error = 0.0_f64;
        let mut stopping: Option<(End, Instant)> = None;
        let answer = loop {
            tokio::select! {
                answer = &mut asked => break answer,
                Some(message) = heard.next() => {
                    if let Ok((FeedbackMessage { goal_id, feedback }, _)) = message
                        && goal_id == drive
                    {
                        error = error.max(feedback.largest_error());
                    }
                }
                stop = reason(stopped), if stopping.is_none() => {
                    controller.cancel(drive);
                    self.previewed.send_replace(None);
                    stopping = Some((ended(stop, None), Instant::now()));
                }
                _ = tick.tick() => {
                    let elapsed_secs = (self.stamp().to_nanos() - began.to_nanos()) as f64 * 1e-9;
                    let stage = if elapsed_secs < approach_secs { "approaching" } else { "executing" };
                    let progress = (elapsed_secs / duration_secs).clamp(0.0, 1.0);
                    self.execution.publish_feedback(goal_id, stage, progress, error);
                    if elapsed_secs > duration_secs + grace_secs && stopping.is_none() {
                        controller.cancel(drive);
                        let end = aborted(format!(
                            "{action} has not ended the motion after {elapsed_secs:.1} s, which takes \
                             {duration_secs:.1} s (execute.grace_s allows {grace_secs:.1} s more); it was told \
                             to stop"
                        ));
                        stopping = Some((end.into(), Instant::now()));
                    }
                }
                _ = repeat.tick() => {
                    if !controller.is_there() {
                        return Err(aborted(format!(
                            "{action} left in the middle of the motion; nobody knows what the arm does now"
                        ))
                        .into());
                    }
                    if let Some((_, since)) = &stopping {
                        if since.elapsed() > timeout {
                            return Err(aborted(format!(
                                "{action} was told to stop and does not say that it has, {:.1} s later \
                                 (execute.timeout_s); the arm may still move",
                                timeout.as_secs_f64()
                            ))
                            .into());
                        }
                        controller.cancel(drive);
                    }
                }
            }
        };
        let GetResultResponse { status, result } = answer
            .map_err(|e| aborted(format!("{action} gave no result that can be read: {e}")))?;
        let told = match result.error_string.as_str() {
            "" => result.error_name().to_owned(),
            text => format!("{}: {text}", result.error_name()),
        };
        match (status, stopping) {
            (GoalStatusEnum::Succeeded, _) if result.error_code == 0 => {
                self.execution.publish_feedback(goal_id, "executing", 1.0, error);
                Ok(())
            }
            (GoalStatusEnum::Canceled, Some((end, _))) => Err(end),
            (GoalStatusEnum::Canceled, None) => {
                Err(aborted(format!("somebody else canceled the motion at {action}")).into())
            }
            (GoalStatusEnum::Unknown, _) => {
                Err(aborted(format!("{action} does not know of the motion any more")).into())
            }
            (_, Some((end, _))) => {
                log::warn!("{action}, told to stop, aborted the motion ({told})");
                Err(end)
            }
            (_, None) => Err(aborted(format!(
                "{action} aborted the motion ({told}); the largest deviation of a joint was {error:.3} rad"
            ))
            .into()),
        }
    }
}

/// Why a goal is to stop, when it is.
async fn reason(stopped: &mut watch::Receiver<Option<Stop>>) -> Stop {
    match stopped.wait_for(Option::is_some).await.map(|stop| stop.clone()) {
        Ok(Some(stop)) => stop,
        // The sender lives as long as the goal.
        _ => std::future::pending().await,
    }
}

/// How a goal that was stopped ends.
fn ended(stop: Stop, sample: Option<Box<Sample>>) -> End {
    match stop {
        Stop::Canceled => End::Canceled,
        Stop::Refused(refusal) => End::Failed(refusal, sample),
    }
}
