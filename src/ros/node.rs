//! The node: what its topics, services and parameters do with a
//! [`PrimitiveServer`].

mod execute;
mod eyes;
mod introspection;
mod locations;
mod managed;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{
    AtomicBool, AtomicI64, AtomicU64, AtomicUsize, Ordering::Relaxed, Ordering::SeqCst,
};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use futures::future::BoxFuture;
use ros2_client::builtin_interfaces::Time as StampTime;
use ros2_client::entities_info::ParticipantEntitiesInfo;
use ros2_client::parameters::raw;
use ros2_client::qos::History;
use ros2_client::rcl_interfaces::{
    DescribeParametersRequest, DescribeParametersResponse, GetParameterTypesRequest,
    GetParameterTypesResponse, GetParametersRequest, GetParametersResponse, ListParametersRequest,
    ListParametersResponse, SetParametersAtomicallyResponse, SetParametersRequest,
    SetParametersResponse,
};
use ros2_client::{Context, Gid, ParameterValue, Publisher, QosProfile};
use tokio::sync::{Notify, watch};
use tokio::task::{AbortHandle, JoinSet};

use super::banner::{Banner, location_command};
use super::convert::{self, Frames};
use super::delays::Delays;
use super::environment::Environment;
use super::lane::{Lane, WAITING};
use super::log::NodeLog;
use super::markers::markers;
use super::messages::builtin_interfaces::Time;
use super::messages::diagnostic_msgs::DiagnosticArray;
use super::messages::geometry_msgs::{PointStamped, PoseStamped};
use super::messages::lifecycle_msgs::TransitionEvent;
use super::messages::nav_msgs::Path;
use super::messages::sensor_msgs::JointState;
use super::messages::std_msgs::Text;
use super::messages::std_srvs::{TriggerRequest, TriggerResponse};
use super::messages::tcvae_msgs::{
    DescribePrimitiveRequest, LoadModelRequest, LoadModelResponse, SampleTrajectoryRequest,
    SampleTrajectoryResponse, SetMannerRequest, SetMannerResponse,
};
use super::messages::tf2_msgs::TFMessage;
use super::messages::trajectory_msgs::{JointTrajectory, MultiDOFJointTrajectory};
use super::messages::visualization_msgs::MarkerArray;
use super::names::NodeNames;
use super::parameters::{self, Parameter};
use super::participant::{self, ParticipantError};
use super::state::{Loaded, Loader, NodeState};
use super::tf::FrameTree;
use super::wiring::{Reply, Wiring, WiringError, answer, each, each_from, latched, reliable};
use crate::serving::{
    Description, ErrorCode, PrimitiveServer, Refusal, Sample, SampleReply, SampleRequest,
};
use crate::trajectory as core;
use execute::Execution;
use eyes::{Counts, message_time};
use locations::{Given, may_come};

/// Why the node does not run.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum NodeError {
    /// No way onto the network.
    #[error(transparent)]
    Participant(#[from] ParticipantError),
    /// An endpoint that can't be made.
    #[error(transparent)]
    Wiring(#[from] WiringError),
    /// The system gives no thread.
    #[error("no thread to sample in: {0}")]
    Thread(#[from] std::io::Error),
}

/// The node while it runs. Dropping it takes the node off the graph.
pub struct RunningNode {
    tasks: JoinSet<()>,
    shared: Option<Arc<Shared>>,
    log: NodeLog,
}

/// What the tasks of the node share.
struct Shared {
    names: NodeNames,
    frames: Frames,
    loader: Arc<dyn Loader>,
    clock: Clock,
    state: Mutex<NodeState>,
    /// Where frames are, and word of each that comes.
    tree: Mutex<FrameTree>,
    transforms_heard: Notify,
    /// How long those took that publish locations.
    delays: Arc<Mutex<Delays>>,
    /// Locations that came on topics, in their order, while the first of them waits for its transform.
    waiting: Mutex<VecDeque<Given>>,
    /// Requests that wait for transforms.
    requests_waiting: AtomicUsize,
    wiring: Mutex<Wiring>,
    /// Topics that come and go with the model and the parameters, by their names.
    topics: Mutex<BTreeMap<String, AbortHandle>>,
    /// Samples that are published go through one lane, so that the last one asked for is the last
    /// one published.
    publishing: Lane,
    sampling: Lane,
    /// Whether a goal waits for its turn in the lane.
    goal_waits: AtomicBool,
    /// How many goals came, and how many of them the last turn knew of; both change while the state is held.
    goals_asked: AtomicU64,
    goals_served: AtomicU64,
    joint_trajectory: Publisher<JointTrajectory>,
    end_effector_trajectory: Publisher<MultiDOFJointTrajectory>,
    end_effector_path: Publisher<Path>,
    markers: Publisher<MarkerArray>,
    transition_event: Publisher<TransitionEvent>,
    diagnostics: Publisher<DiagnosticArray>,
    preview: Publisher<JointState>,
    /// The motion that the ghost plays.
    previewed: watch::Sender<Option<Arc<core::JointTrajectory>>>,
    robot_description: Publisher<Text>,
    execution: Execution,
    counts: Mutex<Counts>,
    model_info: Publisher<Text>,
    parameter_events: Publisher<raw::ParameterEvent>,
    // Last, so that it outlives everything that communicates.
    context: Context,
}

/// How long a motion that was published may be on its way.
const SOON: Duration = Duration::from_secs(2);

/// What a sample is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Turn {
    /// A task topic, of which the latest counts.
    Goal,
    /// A request whose answer is published.
    Publish,
    /// A request whose answer only its client gets.
    Answer,
}

/// Time for stamps, and a time for ages that never goes back.
struct Clock {
    started: Instant,
    /// Nanoseconds of `/clock`.
    simulated: AtomicI64,
}

impl RunningNode {
    /// Puts the node on the graph. It needs a tokio runtime.
    ///
    /// # Errors
    /// No way onto the network, or an endpoint that can't be made.
    pub fn start(
        names: NodeNames,
        environment: &Environment,
        state: NodeState,
        loader: Arc<dyn Loader>,
        log: NodeLog,
        rosout: bool,
    ) -> Result<Self, NodeError> {
        let context = participant::join(environment)?;
        let mut wiring = Wiring::new(&context, names.clone(), environment.service_mapping)?;
        if rosout {
            let lifespan = Some(Duration::from_secs(10));
            let qos = latched(1000).lifespan(lifespan);
            log.attach(wiring.publisher("/rosout", ("rcl_interfaces", "Log"), qos)?);
        }
        let trajectory = ("trajectory_msgs", "JointTrajectory");
        let poses = ("trajectory_msgs", "MultiDOFJointTrajectory");
        let event = ("rcl_interfaces", "ParameterEvent");
        let joint_state = ("sensor_msgs", "JointState");
        let (execution, executions) = Execution::new(&mut wiring)?;
        let mut tasks = JoinSet::new();
        let participants = wiring.participants::<ParticipantEntitiesInfo>(&context)?;
        let delays = Arc::<Mutex<Delays>>::default();
        let heard = Arc::clone(&delays);
        let mut see = warn_of_twin(names.clone(), context.participant_entities_info().gid());
        tasks.spawn(each_from(participants, move |participant, info| {
            // What a participant says first tells how long its messages take.
            lock(&heard).hear(&info);
            see(participant);
        }));
        let shared = Arc::new(Shared {
            frames: Frames {
                base: state.robot_files().base_frame.clone(),
                tip: state.robot_files().tip_link.clone(),
            },
            loader,
            clock: Clock { started: Instant::now(), simulated: AtomicI64::new(0) },
            state: Mutex::new(state),
            tree: Mutex::default(),
            transforms_heard: Notify::new(),
            delays,
            waiting: Mutex::default(),
            requests_waiting: AtomicUsize::new(0),
            topics: Mutex::default(),
            publishing: Lane::new("publishing")?,
            sampling: Lane::new("sampling")?,
            goal_waits: AtomicBool::new(false),
            goals_asked: AtomicU64::new(0),
            goals_served: AtomicU64::new(0),
            joint_trajectory: wiring.publisher("~/joint_trajectory", trajectory, soon())?,
            end_effector_trajectory: wiring.publisher(
                "~/end_effector_trajectory",
                poses,
                soon(),
            )?,
            end_effector_path: wiring.publisher(
                "~/end_effector_path",
                ("nav_msgs", "Path"),
                latched(1),
            )?,
            markers: wiring.publisher(
                "~/markers",
                ("visualization_msgs", "MarkerArray"),
                latched(1),
            )?,
            transition_event: wiring.publisher(
                "~/transition_event",
                ("lifecycle_msgs", "TransitionEvent"),
                reliable(10),
            )?,
            diagnostics: wiring.publisher(
                "/diagnostics",
                ("diagnostic_msgs", "DiagnosticArray"),
                reliable(1),
            )?,
            preview: wiring.publisher("~/preview/joint_states", joint_state, reliable(10))?,
            previewed: watch::Sender::new(None),
            robot_description: wiring.publisher(
                "~/robot_description",
                ("std_msgs", "String"),
                latched(1),
            )?,
            execution,
            counts: Mutex::default(),
            model_info: wiring.publisher("~/model_info", ("std_msgs", "String"), latched(1))?,
            parameter_events: wiring.publisher("/parameter_events", event, reliable(1000))?,
            wiring: Mutex::new(wiring),
            names,
            context,
        });
        shared.serve(&mut tasks)?;
        shared.serve_parameters(&mut tasks)?;
        shared.serve_lifecycle(&mut tasks)?;
        shared.serve_execute(executions, &mut tasks);
        shared.serve_introspection(&log, &mut tasks)?;
        let participant = shared.context.domain_participant();
        let matched = shared.wiring().matched();
        tasks.spawn(introspection::follow_matches(participant, matched));
        shared.sync_controller();
        tasks.spawn(eyes::diagnose(Arc::downgrade(&shared)));
        tasks.spawn(eyes::preview(Arc::downgrade(&shared), shared.previewed.subscribe()));
        let goal_pose = shared.wiring().subscription(
            "~/goal_pose",
            ("geometry_msgs", "PoseStamped"),
            reliable(10),
        )?;
        let weak = Arc::downgrade(&shared);
        tasks.spawn(each_from(goal_pose, move |goal: PoseStamped, info| {
            with(&weak, |shared| shared.goal_pose(goal, &info));
        }));
        for (topic, qos, is_static) in
            [("/tf", reliable(100), false), ("/tf_static", latched(100), true)]
        {
            let transforms = shared.wiring().subscription(topic, ("tf2_msgs", "TFMessage"), qos)?;
            let weak = Arc::downgrade(&shared);
            tasks.spawn(each(transforms, move |message: TFMessage| {
                with(&weak, |shared| shared.transforms(&message, is_static));
            }));
        }
        let joint_states = shared.wiring().subscription(
            "/joint_states",
            joint_state,
            QosProfile::subscription_default().history(History::KeepLast { depth: 1 }),
        )?;
        let weak = Arc::downgrade(&shared);
        tasks.spawn(each(joint_states, move |joints: JointState| {
            if joints.name.len() != joints.position.len() {
                // Velocities or efforts alone are no news of where the arm is; half a message is none at all.
                log::debug!(
                    "joint states of {} joints with {} positions say nothing",
                    joints.name.len(),
                    joints.position.len()
                );
                return;
            }
            with(&weak, |shared| {
                let named = joints.name.iter().map(String::as_str).zip(joints.position);
                shared.state().server.set_joint_state(named, shared.now_secs());
            });
        }));
        shared.sync_topics();
        shared.announce_model();
        shared.announce_robot();
        shared.announce_parameters(&[], &shared.parameters());
        Ok(Self { tasks, shared: Some(shared), log })
    }

    /// What the node serves, and commands to try.
    pub fn banner(&self, environment: &Environment) -> String {
        self.shared.as_ref().map(|shared| shared.banner(environment)).unwrap_or_default()
    }

    /// Takes the node off the graph.
    pub async fn stop(mut self) {
        if let Some(shared) = &self.shared {
            shared.execution.end().await;
            lock(&shared.topics).values().for_each(AbortHandle::abort);
        }
        self.tasks.shutdown().await;
        self.log.detach();
        // A lane that publishes at this moment holds the state a little longer; one that samples
        // holds no more than its own request, and is not waited for.
        let state = self.shared.take().as_ref().map(Arc::downgrade);
        let deadline = Instant::now() + Duration::from_secs(1);
        while state.as_ref().is_some_and(|s| s.strong_count() > 0) && Instant::now() < deadline {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }
}

/// Reliable, for what must come soon or not at all.
fn soon() -> QosProfile {
    reliable(1).lifespan(Some(SOON))
}

/// Does something with the shared state, while it is there.
fn with<T>(shared: &Weak<Shared>, act: impl FnOnce(&Arc<Shared>) -> T) -> Option<T> {
    shared.upgrade().map(|shared| act(&shared))
}

/// The lock's content; a panic elsewhere does not make it unusable, since every change is made on
/// a clone that replaces it whole.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Shared {
    fn state(&self) -> MutexGuard<'_, NodeState> {
        lock(&self.state)
    }

    fn wiring(&self) -> MutexGuard<'_, Wiring> {
        lock(&self.wiring)
    }

    fn now_secs(&self) -> f64 {
        self.clock.started.elapsed().as_secs_f64()
    }

    /// The time for stamps: the system's, or that of `/clock`.
    fn stamp(&self) -> StampTime {
        self.stamp_in(&self.state())
    }

    /// The same, for who holds the state.
    fn stamp_in(&self, state: &NodeState) -> StampTime {
        match state.use_sim_time {
            true => StampTime::from_nanos(self.clock.simulated.load(Relaxed)),
            false => StampTime::now(),
        }
    }

    fn banner(&self, environment: &Environment) -> String {
        let state = self.state();
        Banner {
            description: &state.server.describe(),
            locations: state.server.model().space().locations(),
            example: &state.server.model().example_task(),
            model_path: state.model_path(),
            robot_path: state.robot_files().path(),
            clearance: &state.server.robot().clearance(),
            frames: &self.frames,
            names: &self.names,
            environment,
        }
        .text()
    }

    // ---- Topics ----

    /// Makes the topics that the model and the parameters call for, and no others: one for each
    /// location of the task, and `/clock` while it is wanted.
    fn sync_topics(self: &Arc<Self>) {
        let wanted: BTreeSet<String> = {
            let state = self.state();
            let space = state.server.model().space();
            let locations = space.locations().iter().map(|l| format!("~/{}", l.name));
            locations.chain(state.use_sim_time.then(|| "/clock".into())).collect()
        };
        let mut topics = lock(&self.topics);
        topics.retain(|topic, task| {
            let keep = wanted.contains(topic);
            if !keep {
                task.abort();
            }
            keep
        });
        for topic in wanted {
            if topics.contains_key(&topic) {
                continue;
            }
            match self.listen(&topic) {
                Ok(task) => {
                    topics.insert(topic, tokio::spawn(task).abort_handle());
                }
                Err(e) => log::error!("{e}"),
            }
        }
    }

    fn listen(self: &Arc<Self>, topic: &str) -> Result<BoxFuture<'static, ()>, WiringError> {
        let weak = Arc::downgrade(self);
        let mut wiring = self.wiring();
        Ok(match topic.strip_prefix("~/") {
            Some(location) => {
                let points = ("geometry_msgs", "PointStamped");
                let points = wiring.subscription(topic, points, reliable(10))?;
                let location = location.to_owned();
                Box::pin(each_from(points, move |point: PointStamped, info| {
                    with(&weak, |shared| shared.task_location(&location, point, &info));
                }))
            }
            None => {
                // A message of one field has the layout of the field.
                let clock = ("rosgraph_msgs", "Clock");
                let qos =
                    QosProfile::subscription_default().history(History::KeepLast { depth: 1 });
                let clock = wiring.subscription(topic, clock, qos)?;
                Box::pin(each(clock, move |time: Time| {
                    let nanos = i64::from(time.sec) * 1_000_000_000 + i64::from(time.nanosec);
                    with(&weak, |shared| shared.clock.simulated.store(nanos, Relaxed));
                }))
            }
        })
    }

    // ---- Sampling ----

    /// Samples for the task that is the latest when its turn comes, and publishes. So of many
    /// goals in a burst the last is served, and those before it only if there is time.
    fn publish_latest(
        self: &Arc<Self>,
        received: Instant,
        activation: Option<u64>,
    ) -> Result<(), Refusal> {
        self.check_active(&self.state(), activation)?;
        if self.goal_waits.swap(true, SeqCst) {
            return Ok(());
        }
        let asked = self.publish_sample(Turn::Goal, received, |_| {});
        if asked.is_err() {
            self.goal_waits.store(false, SeqCst);
        }
        asked
    }

    /// Samples for the latest task and publishes; `done` hears of it.
    fn publish_sample(
        self: &Arc<Self>,
        turn: Turn,
        received: Instant,
        done: impl FnOnce(&SampleReply) + Send + 'static,
    ) -> Result<(), Refusal> {
        self.sample(turn, received, SampleRequest::default(), move |shared, reply, activation| {
            done(&shared.published(reply, received, activation));
        })
    }

    /// Answers a request when its turn comes, with the state of that moment, and then does something with the
    /// answer, which is also told which time that the node was active it was asked for in.
    fn sample(
        self: &Arc<Self>,
        turn: Turn,
        received: Instant,
        request: SampleRequest,
        then: impl FnOnce(&Self, SampleReply, Option<u64>) + Send + 'static,
    ) -> Result<(), Refusal> {
        let activation = {
            let state = self.state();
            self.check_active(&state, state.activation())?;
            state.activation()
        };
        let lane = match turn {
            Turn::Goal | Turn::Publish => &self.publishing,
            Turn::Answer => &self.sampling,
        };
        let shared = Arc::downgrade(self);
        lane.run(move || {
            let now = with(&shared, |shared| {
                let state = shared.state();
                if turn == Turn::Goal {
                    // A goal from here on needs a turn of its own; one that came between two turns was served by the
                    // one before.
                    shared.goal_waits.store(false, SeqCst);
                    let asked = shared.goals_asked.load(SeqCst);
                    if shared.goals_served.swap(asked, SeqCst) == asked {
                        return None;
                    }
                }
                Some((state.server.clone(), shared.now_secs()))
            });
            let Some((server, now_secs)) = now.flatten() else { return };
            let answered = catch_unwind(AssertUnwindSafe(|| server.sample(&request, now_secs)));
            let reply = answered.unwrap_or_else(|_| SampleReply {
                samples: Vec::new(),
                refusal: Some(Refusal::new(
                    ErrorCode::Internal,
                    "the program broke while it sampled; please report it with the terminal's \
                     last lines",
                )),
                model_id: server.model().model_id.clone(),
            });
            with(&shared, |shared| {
                let mut reply = SampleReply {
                    refusal: reply.refusal.map(|r| shared.with_next_step(&server, &request, r)),
                    ..reply
                };
                // The node may have been deactivated meanwhile.
                if let Err(refusal) = shared.check_active(&shared.state(), activation) {
                    reply = SampleReply { samples: Vec::new(), refusal: Some(refusal), ..reply };
                }
                lock(&shared.counts).answered(&reply, received.elapsed());
                if let Some(refusal) = &reply.refusal {
                    log::warn!("{refusal}");
                }
                then(shared, reply, activation);
            });
        })
    }

    /// A refusal for want of a location says how to publish one.
    fn with_next_step(
        &self,
        server: &PrimitiveServer,
        request: &SampleRequest,
        refusal: Refusal,
    ) -> Refusal {
        let missing = match refusal.code {
            ErrorCode::NoTask => server.missing_location(&request.task),
            _ => None,
        };
        match missing {
            Some(location) => {
                let model = server.model();
                let index = model.space().location_index(&location.name).unwrap_or_default();
                let example = model.example_task()[index];
                let base = &self.frames.base;
                let command = location_command(&self.names, base, &location.name, example);
                Refusal { message: format!("{}:\n  {command}", refusal.message), ..refusal }
            }
            None => refusal,
        }
    }

    /// Publishes the first sample of an answer; the answer then, which is a refusal if it could not be.
    fn published(
        &self,
        reply: SampleReply,
        received: Instant,
        activation: Option<u64>,
    ) -> SampleReply {
        let Some(sample) = reply.samples.first() else { return reply };
        match self.publish(sample, &reply.model_id, received, activation) {
            Ok(()) => reply,
            Err(refusal) => {
                log::error!("not published: {refusal}");
                SampleReply { samples: Vec::new(), refusal: Some(refusal), ..reply }
            }
        }
    }

    fn publish(
        &self,
        sample: &Sample,
        model_id: &str,
        received: Instant,
        activation: Option<u64>,
    ) -> Result<(), Refusal> {
        let joints = &sample.joint_trajectory;
        // Nobody deactivates the node while this is held, so that no motion leaves an inactive one.
        let state = self.state();
        self.check_active(&state, activation)?;
        if let Err(e) = self.joint_trajectory.publish(self.frames.joint_trajectory(joints)) {
            let message = format!("the trajectory could not be published: {e}");
            return Err(Refusal::new(ErrorCode::Internal, message));
        }
        let took_ms = received.elapsed().as_secs_f64() * 1e3;
        self.show_motion(&state, sample);
        drop(state);
        lock(&self.counts).published();
        let notes: String = sample.warnings.iter().map(|w| format!("; note: {w}")).collect();
        log::info!("published in {took_ms:.2} ms: {}{notes}", summary(sample, model_id));
        Ok(())
    }

    /// What goes with a motion that is on its way; it is lost where it can't be sent.
    fn show_motion(&self, state: &NodeState, sample: &Sample) {
        let (joints, poses) = (&sample.joint_trajectory, &sample.end_effector_trajectory);
        let stamp = message_time(self.stamp_in(state));
        let tolerance_m = state.server.settings().tolerance_m;
        let path = self.frames.path(poses, stamp);
        let markers = markers(&self.frames, sample, tolerance_m, stamp);
        let poses = self.frames.end_effector_trajectory(poses);
        let sent = [
            self.end_effector_trajectory.publish(poses).map_err(|e| e.to_string()),
            self.end_effector_path.publish(path).map_err(|e| e.to_string()),
            self.markers.publish(markers).map_err(|e| e.to_string()),
        ];
        for e in sent.into_iter().filter_map(Result::err) {
            log::error!("a motion is on its way, but not all that goes with it: {e}");
        }
        self.previewed.send_replace(Some(Arc::new(joints.clone())));
    }

    // ---- Services ----

    fn serve(self: &Arc<Self>, tasks: &mut JoinSet<()>) -> Result<(), WiringError> {
        let mut wiring = self.wiring();

        let server = wiring.service("~/sample", ("std_srvs", "Trigger"))?;
        let shared = Arc::downgrade(self);
        tasks.spawn(answer(server, move |_: TriggerRequest, reply| {
            with(&shared, |shared| shared.trigger(reply));
            async {}
        }));

        let server = wiring.service("~/sample_trajectory", ("tcvae_msgs", "SampleTrajectory"))?;
        let shared = Arc::downgrade(self);
        tasks.spawn(answer(server, move |request: SampleTrajectoryRequest, reply| {
            with(&shared, |shared| shared.sample_trajectory(request, reply));
            async {}
        }));

        let server = wiring.service("~/set_manner", ("tcvae_msgs", "SetManner"))?;
        let shared = Arc::downgrade(self);
        tasks.spawn(answer(server, move |request: SetMannerRequest, reply: Reply<_, _>| {
            if let Some(response) = with(&shared, |shared| shared.set_manner(&request)) {
                reply.send(response);
            }
            async {}
        }));

        let server = wiring.service("~/describe_primitive", ("tcvae_msgs", "DescribePrimitive"))?;
        let shared = Arc::downgrade(self);
        tasks.spawn(answer(server, move |_: DescribePrimitiveRequest, reply: Reply<_, _>| {
            let description = with(&shared, |shared| shared.state().server.describe());
            if let Some(description) = description {
                reply.send(convert::description(description));
            }
            async {}
        }));

        let server = wiring.service("~/load_model", ("tcvae_msgs", "LoadModel"))?;
        let shared = Arc::downgrade(self);
        tasks.spawn(answer(server, move |request: LoadModelRequest, reply: Reply<_, _>| {
            let shared = shared.clone();
            async move {
                let Some(shared) = shared.upgrade() else { return };
                reply.send(shared.load_model(request.path).await);
            }
        }));
        Ok(())
    }

    fn trigger(self: &Arc<Self>, reply: Reply<TriggerRequest, TriggerResponse>) {
        let received = Instant::now();
        let later = reply.clone();
        let asked = self.publish_sample(Turn::Publish, received, move |answer| {
            later.send(match (&answer.refusal, answer.samples.first()) {
                (None, Some(sample)) => {
                    TriggerResponse { success: true, message: summary(sample, &answer.model_id) }
                }
                (refusal, _) => TriggerResponse {
                    success: false,
                    message: refusal.as_ref().map(Refusal::to_string).unwrap_or_default(),
                },
            });
        });
        if let Err(refusal) = asked {
            lock(&self.counts).turned_away(&refusal);
            log::warn!("{refusal}");
            reply.send(TriggerResponse { success: false, message: refusal.to_string() });
        }
    }

    fn sample_trajectory(
        self: &Arc<Self>,
        message: SampleTrajectoryRequest,
        reply: Reply<SampleTrajectoryRequest, SampleTrajectoryResponse>,
    ) {
        let received = Instant::now();
        let publish = message.publish;
        let request = self.frames.request(&lock(&self.tree), message.clone());
        let all_framed = message.task.iter().all(|t| !t.point.header.frame_id.is_empty());
        match request {
            // Not for ever, and not too many of them.
            Err(refusal) if all_framed && may_come(&refusal) => {
                if self.requests_waiting.fetch_add(1, SeqCst) >= WAITING {
                    self.requests_waiting.fetch_sub(1, SeqCst);
                    self.answer_sample(Err(refusal), publish, received, reply);
                    return;
                }
                let shared = Arc::clone(self);
                tokio::spawn(async move {
                    let request = shared.once_heard(received, |shared| {
                        shared.frames.request(&lock(&shared.tree), message.clone())
                    });
                    let request = request.await;
                    shared.requests_waiting.fetch_sub(1, SeqCst);
                    shared.answer_sample(request, publish, received, reply);
                });
            }
            request => self.answer_sample(request, publish, received, reply),
        }
    }

    fn answer_sample(
        self: &Arc<Self>,
        request: Result<SampleRequest, Refusal>,
        publish: bool,
        received: Instant,
        reply: Reply<SampleTrajectoryRequest, SampleTrajectoryResponse>,
    ) {
        let turn = if publish { Turn::Publish } else { Turn::Answer };
        let later = reply.clone();
        let asked = request.and_then(|request| {
            self.sample(turn, received, request, move |shared, reply, activation| {
                let reply = match publish {
                    true => shared.published(reply, received, activation),
                    false => reply,
                };
                // As in publishing: the node stays active until the answer is on its way.
                let state = shared.state();
                let reply = match shared.check_active(&state, activation) {
                    Ok(()) => reply,
                    Err(refusal) => {
                        SampleReply { samples: Vec::new(), refusal: Some(refusal), ..reply }
                    }
                };
                later.send(shared.frames.response(reply));
            })
        });
        if let Err(refusal) = asked {
            lock(&self.counts).turned_away(&refusal);
            log::warn!("{refusal}");
            let model_id = self.state().server.model().model_id.clone();
            let samples = Vec::new();
            let answer = SampleReply { samples, refusal: Some(refusal), model_id };
            reply.send(self.frames.response(answer));
        }
    }

    fn set_manner(self: &Arc<Self>, request: &SetMannerRequest) -> SetMannerResponse {
        let changed = self.change(|state| {
            state.server.set_manner(&request.names, &request.values, request.reset)
        });
        if let Err(refusal) = &changed {
            log::warn!("manner refused: {refusal}");
        }
        let (error_code, error_message) = convert::error(changed.err().as_ref());
        let state = self.state();
        let axes = state.server.model().primitive.manner_space().axes();
        let manner = convert::manner(axes, state.server.manner());
        SetMannerResponse { error_code, error_message, manner }
    }

    async fn load_model(self: &Arc<Self>, path: String) -> LoadModelResponse {
        let loaded = match self.read_model(path).await {
            Ok(loaded) => self.change(|state| state.load(loaded.clone())),
            Err(refusal) => Err(refusal),
        };
        if let Err(refusal) = &loaded {
            log::warn!("model refused, the old one stays: {refusal}");
        }
        let (error_code, error_message) = convert::error(loaded.err().as_ref());
        let model_id = self.state().server.model().model_id.clone();
        LoadModelResponse { error_code, error_message, model_id }
    }

    /// Reads a model file where it holds up nobody.
    async fn read_model(&self, path: String) -> Result<Loaded, Refusal> {
        let loader = Arc::clone(&self.loader);
        let read = tokio::task::spawn_blocking(move || {
            let model = Arc::new(loader.model(&path)?);
            Ok(Loaded { path, model })
        });
        read.await.unwrap_or_else(|e| {
            Err(Refusal::new(ErrorCode::Internal, format!("the program broke on this file: {e}")))
        })
    }

    // ---- Parameters ----

    fn serve_parameters(self: &Arc<Self>, tasks: &mut JoinSet<()>) -> Result<(), WiringError> {
        let mut wiring = self.wiring();

        let server = wiring.service("~/get_parameters", ("rcl_interfaces", "GetParameters"))?;
        let shared = Arc::downgrade(self);
        tasks.spawn(answer(server, move |request: GetParametersRequest, reply: Reply<_, _>| {
            let values = with(&shared, |s| parameters::get(&s.parameters(), &request.names));
            if let Some(values) = values {
                reply.send(GetParametersResponse { values });
            }
            async {}
        }));

        let server =
            wiring.service("~/get_parameter_types", ("rcl_interfaces", "GetParameterTypes"))?;
        let shared = Arc::downgrade(self);
        tasks.spawn(answer(
            server,
            move |request: GetParameterTypesRequest, reply: Reply<_, _>| {
                let values = with(&shared, |s| parameters::types(&s.parameters(), &request.names));
                if let Some(values) = values {
                    reply.send(GetParameterTypesResponse { values });
                }
                async {}
            },
        ));

        let server =
            wiring.service("~/describe_parameters", ("rcl_interfaces", "DescribeParameters"))?;
        let shared = Arc::downgrade(self);
        tasks.spawn(answer(
            server,
            move |request: DescribeParametersRequest, reply: Reply<_, _>| {
                let values =
                    with(&shared, |s| parameters::describe(&s.parameters(), &request.names));
                if let Some(values) = values {
                    reply.send(DescribeParametersResponse { values });
                }
                async {}
            },
        ));

        let server = wiring.service("~/list_parameters", ("rcl_interfaces", "ListParameters"))?;
        let shared = Arc::downgrade(self);
        tasks.spawn(answer(server, move |request: ListParametersRequest, reply: Reply<_, _>| {
            let ListParametersRequest { prefixes, depth } = request;
            let result = with(&shared, |s| parameters::list(&s.parameters(), &prefixes, depth));
            if let Some(result) = result {
                reply.send(ListParametersResponse { result });
            }
            async {}
        }));

        let server = wiring.service("~/set_parameters", ("rcl_interfaces", "SetParameters"))?;
        let shared = Arc::downgrade(self);
        tasks.spawn(answer(server, move |request: SetParametersRequest, reply: Reply<_, _>| {
            let shared = shared.clone();
            async move {
                let Some(shared) = shared.upgrade() else { return };
                let mut results = Vec::with_capacity(request.parameter.len());
                for parameter in request.parameter {
                    results.push(shared.set_parameters(vec![parameter]).await);
                }
                reply.send(SetParametersResponse { results });
            }
        }));

        let server = wiring.service(
            "~/set_parameters_atomically",
            ("rcl_interfaces", "SetParametersAtomically"),
        )?;
        let shared = Arc::downgrade(self);
        tasks.spawn(answer(server, move |request: SetParametersRequest, reply: Reply<_, _>| {
            let shared = shared.clone();
            async move {
                let Some(shared) = shared.upgrade() else { return };
                let result = shared.set_parameters(request.parameter).await;
                reply.send(SetParametersAtomicallyResponse { result });
            }
        }));
        Ok(())
    }

    fn parameters(&self) -> Vec<Parameter> {
        self.state().parameters()
    }

    /// Sets all of these parameters, or none.
    async fn set_parameters(
        self: &Arc<Self>,
        wanted: Vec<raw::Parameter>,
    ) -> raw::SetParametersResult {
        let wanted: Vec<(String, ParameterValue)> =
            wanted.into_iter().map(|p| (p.name, p.value.into())).collect();
        let result = match self.read_models(&wanted).await {
            Ok(loaded) => self.change(|state| {
                wanted.iter().try_for_each(|(name, value)| state.set(name, value.clone(), &loaded))
            }),
            Err(refusal) => Err(refusal.to_string()),
        };
        if let Err(reason) = &result {
            log::warn!("parameter refused: {reason}");
        }
        result.into()
    }

    /// The models that these parameters ask for.
    async fn read_models(
        &self,
        wanted: &[(String, ParameterValue)],
    ) -> Result<Vec<Loaded>, Refusal> {
        let mut loaded = Vec::new();
        for (name, value) in wanted {
            if let ("model_path", ParameterValue::String(path)) = (name.as_str(), value) {
                loaded.push(self.read_model(path.clone()).await?);
            }
        }
        Ok(loaded)
    }

    /// Changes the state wholly or not at all, and tells the graph what changed.
    fn change<E>(
        self: &Arc<Self>,
        change: impl FnOnce(&mut NodeState) -> Result<(), E>,
    ) -> Result<(), E> {
        let (before, after, model_changed) = {
            let mut state = self.state();
            let before = state.parameters();
            let mut changed = state.clone();
            change(&mut changed)?;
            let old_model = std::ptr::from_ref(state.server.model());
            let model_changed = !std::ptr::eq(old_model, changed.server.model());
            *state = changed;
            (before, state.parameters(), model_changed)
        };
        self.announce_parameters(&before, &after);
        if model_changed {
            self.announce_model();
        }
        self.sync_topics();
        self.sync_controller();
        Ok(())
    }

    /// Publishes what changed.
    fn announce_parameters(&self, before: &[Parameter], after: &[Parameter]) {
        let name = self.names.fully_qualified();
        if let Some(event) = parameters::event(before, after, self.stamp(), &name)
            && let Err(e) = self.parameter_events.publish(event)
        {
            log::warn!("a parameter event could not be sent: {e}");
        }
    }

    /// Publishes the robot's description.
    fn announce_robot(&self) {
        let data = self.state().server.robot().description.to_string();
        if let Err(e) = self.robot_description.publish(Text { data }) {
            log::warn!("the robot's description could not be sent: {e}");
        }
    }

    /// Publishes what is served.
    fn announce_model(&self) {
        let description = self.state().server.describe();
        let Description { primitive, method, model_id, .. } = &description;
        log::info!("serving {primitive} with the {method} model {model_id}");
        let data = convert::model_info(&description, &self.frames);
        if let Err(e) = self.model_info.publish(Text { data }) {
            log::warn!("the model's description could not be sent: {e}");
        }
    }
}

/// What a log line or a trigger's answer says of a sample.
fn summary(sample: &Sample, model_id: &str) -> String {
    let times = &sample.joint_trajectory.times_secs;
    let task: Vec<_> = sample
        .empirical_task
        .iter()
        .map(|l| format!("{} ({:.3}, {:.3})", l.name, l.xy[0], l.xy[1]))
        .collect();
    format!(
        "{} points over {:.2} s, {}, task error {:.1} mm, slowed down {:.2} times, seed {}, \
         model {model_id}",
        times.len(),
        times.last().copied().unwrap_or_default(),
        task.join(", "),
        sample.task_error * 1e3,
        sample.slowdown,
        sample.seed,
    )
}

/// Warns once of every other participant that has a node of this name.
fn warn_of_twin(names: NodeNames, own: Gid) -> impl FnMut(ParticipantEntitiesInfo) {
    let mut known = BTreeSet::new();
    move |participant| {
        let name = names.fully_qualified();
        let twin = participant.nodes().iter().any(|node| node.fully_qualified_name() == name);
        if twin && participant.gid() != own && known.insert(participant.gid()) {
            log::warn!(
                "another node is called {name}; clients can't tell the two apart. Rename one: \
                 --ros-args -r __node:=another_name"
            );
        }
    }
}
