#![no_main]

use std::collections::BTreeMap;
use std::sync::OnceLock;
use std::time::Instant;

use ros2_client::action::{
    FeedbackMessage, GetResultRequest, GetResultResponse, GoalStatusEnum, SendGoalRequest,
    SendGoalResponse,
};
use ros2_client::builtin_interfaces::Time as StampTime;
use ros2_client::entities_info::ParticipantEntitiesInfo;
use ros2_client::rcl_interfaces::{
    DescribeParametersRequest, DescribeParametersResponse, GetParameterTypesRequest,
    GetParameterTypesResponse, GetParametersRequest, GetParametersResponse, ListParametersRequest,
    ListParametersResponse, SetParametersAtomicallyResponse, SetParametersRequest,
    SetParametersResponse,
};
use ros2_client::parameters::raw;
use rustdds::RepresentationIdentifier;
use rustdds::serialization::{deserialize_from_cdr_with_rep_id, to_vec};
use serde::Serialize;
use serde::de::DeserializeOwned;

use tcvae::artifact::Artifact;
use tcvae::config::BAXTER_URDF;
use tcvae::demonstrations::recording::RobotConfig;
use tcvae::ros::convert::{self, Frames};
use tcvae::ros::goals::Goals;
use tcvae::ros::interfaces;
use tcvae::ros::lifecycle;
use tcvae::ros::messages::action_msgs::CancelGoalRequest;
use tcvae::ros::messages::builtin_interfaces::Time;
use tcvae::ros::messages::control_msgs::{
    FollowJointTrajectoryFeedback, FollowJointTrajectoryResult,
};
use tcvae::ros::messages::geometry_msgs::{PointStamped, PoseStamped};
use tcvae::ros::messages::lifecycle_msgs::{
    ChangeStateRequest, ChangeStateResponse, EmptyRequest, GetAvailableStatesResponse,
    GetAvailableTransitionsResponse, GetStateResponse,
};
use tcvae::ros::messages::rcl_interfaces::{GetLoggerLevelsRequest, SetLoggerLevelsRequest};
use tcvae::ros::messages::sensor_msgs::JointState;
use tcvae::ros::messages::std_srvs::TriggerRequest;
use tcvae::ros::messages::tcvae_msgs::{
    DescribePrimitiveRequest, ExecuteGoal, ExecuteResult, LoadModelRequest,
    SampleTrajectoryRequest, SetMannerRequest,
};
use tcvae::ros::messages::tf2_msgs::TFMessage;
use tcvae::ros::messages::type_description_interfaces::GetTypeDescriptionRequest;
use tcvae::ros::parameters;
use tcvae::ros::state::{Loader, NodeState, RobotFiles};
use tcvae::ros::tf::FrameTree;
use tcvae::serving::{ErrorCode, Refusal, Robot, SampleRequest, ServedModel};
use tcvae::urdf;

/// What a message changes.
struct Node {
    frames: Frames,
    state: NodeState,
    tree: FrameTree,
    goals: Goals<ExecuteResult, ()>,
    started: Instant,
    /// Motions that may still be sampled for this input; each takes as long as a hundred messages.
    samples: usize,
}

/// What the node hears, and what it does with it. A test compares the names with those of the running node.
const ENDS: [(&str, fn(&mut Node, &[u8]) -> Option<()>); 37] = [
    ("~/goal_pose", |node, cdr| {
        let PoseStamped { header, pose } = read(cdr)?;
        let goal = node.state.server.goal_location().to_owned();
        node.location(&goal, &PointStamped { header, point: pose.position })?;
        node.sample(&SampleRequest::default())
    }),
    ("~/pour_location", |node, cdr| node.location("pour_location", &read(cdr)?)),
    ("~/source_cup", |node, cdr| node.location("source_cup", &read(cdr)?)),
    ("/joint_states", |node, cdr| {
        let joints: JointState = read(cdr)?;
        let named = joints.name.iter().map(String::as_str).zip(joints.position);
        node.state.server.set_joint_state(named, 0.0);
        Some(())
    }),
    ("/tf", |node, cdr| node.transforms(&read(cdr)?, false)),
    ("/tf_static", |node, cdr| node.transforms(&read(cdr)?, true)),
    ("/clock", |_, cdr| {
        let time: Time = read(cdr)?;
        let nanos = i64::from(time.sec) * 1_000_000_000 + i64::from(time.nanosec);
        write(&StampTime::from_nanos(nanos))
    }),
    ("ros_discovery_info", |_, cdr| {
        let participant: ParticipantEntitiesInfo = read(cdr)?;
        let names = participant.nodes().iter().map(|node| node.fully_qualified_name());
        names.for_each(|name| assert!(name.starts_with('/')));
        Some(())
    }),
    ("~/sample", |node, cdr| {
        let TriggerRequest { .. } = read(cdr)?;
        node.sample(&SampleRequest::default())
    }),
    ("~/sample_trajectory", |node, cdr| {
        let request: SampleTrajectoryRequest = read(cdr)?;
        match node.frames.request(&node.tree, request) {
            Ok(request) => node.sample(&SampleRequest { count: request.count.min(2), ..request }),
            Err(refusal) => write(&convert::error(Some(&refusal))),
        }
    }),
    ("~/set_manner", |node, cdr| {
        let SetMannerRequest { names, values, reset } = read(cdr)?;
        let before = node.state.server.manner().to_vec();
        let refused = node.state.server.set_manner(&names, &values, reset).is_err();
        let now = node.state.server.manner();
        assert!(!refused || now == before, "a refused manner changed something");
        assert!(now.iter().all(|value| value.is_finite()));
        let axes = node.state.server.model().primitive.manner_space().axes();
        write(&convert::manner(axes, now))
    }),
    ("~/describe_primitive", |node, cdr| {
        let DescribePrimitiveRequest { .. } = read(cdr)?;
        write(&convert::description(node.state.server.describe()))
    }),
    ("~/load_model", |_, cdr| read::<LoadModelRequest>(cdr).map(drop)),
    ("~/change_state", |node, cdr| {
        let request: ChangeStateRequest = read(cdr)?;
        let step = node.state.lifecycle.step(&request.transition);
        if let Some(step) = &step {
            node.state.move_to(step.goal());
        }
        write(&ChangeStateResponse { success: step.is_some() })
    }),
    ("~/get_state", |node, cdr| {
        let EmptyRequest { .. } = read(cdr)?;
        write(&GetStateResponse { current_state: node.state.lifecycle.state() })
    }),
    ("~/get_available_states", |_, cdr| {
        let EmptyRequest { .. } = read(cdr)?;
        write(&GetAvailableStatesResponse { available_states: lifecycle::states() })
    }),
    ("~/get_available_transitions", |node, cdr| {
        let EmptyRequest { .. } = read(cdr)?;
        let available_transitions = node.state.lifecycle.available();
        write(&GetAvailableTransitionsResponse { available_transitions })
    }),
    ("~/get_transition_graph", |_, cdr| {
        let EmptyRequest { .. } = read(cdr)?;
        let available_transitions = lifecycle::graph();
        write(&GetAvailableTransitionsResponse { available_transitions })
    }),
    ("~/get_type_description", |_, cdr| {
        write(&interfaces::answer(&read::<GetTypeDescriptionRequest>(cdr)?))
    }),
    ("~/get_logger_levels", |_, cdr| read::<GetLoggerLevelsRequest>(cdr).map(drop)),
    ("~/set_logger_levels", |_, cdr| read::<SetLoggerLevelsRequest>(cdr).map(drop)),
    ("~/describe_parameters", |node, cdr| {
        let DescribeParametersRequest { names } = read(cdr)?;
        let values = parameters::describe(&node.state.parameters(), &names);
        write(&DescribeParametersResponse { values })
    }),
    ("~/get_parameter_types", |node, cdr| {
        let GetParameterTypesRequest { names } = read(cdr)?;
        let values = parameters::types(&node.state.parameters(), &names);
        write(&GetParameterTypesResponse { values })
    }),
    ("~/get_parameters", |node, cdr| {
        let GetParametersRequest { names } = read(cdr)?;
        let values = parameters::get(&node.state.parameters(), &names);
        write(&GetParametersResponse { values })
    }),
    ("~/list_parameters", |node, cdr| {
        let ListParametersRequest { prefixes, depth } = read(cdr)?;
        let result = parameters::list(&node.state.parameters(), &prefixes, depth);
        write(&ListParametersResponse { result })
    }),
    ("~/set_parameters", |node, cdr| {
        let SetParametersRequest { parameter } = read(cdr)?;
        let results = parameter.into_iter().map(|one| node.set(vec![one])).collect();
        write(&SetParametersResponse { results })
    }),
    ("~/set_parameters_atomically", |node, cdr| {
        let SetParametersRequest { parameter } = read(cdr)?;
        let result = node.set(parameter);
        write(&SetParametersAtomicallyResponse { result })
    }),
    ("~/execute/_action/send_goal", |node, cdr| {
        let SendGoalRequest { goal_id, goal } = read::<SendGoalRequest<ExecuteGoal>>(cdr)?;
        let stamp = StampTime::ZERO;
        let accepted = node.goals.accept(goal_id, stamp);
        if accepted {
            node.goals.begin(goal_id);
        }
        assert!(!node.goals.accept(goal_id, stamp), "the same goal twice");
        write(&goal)?;
        write(&SendGoalResponse { accepted, stamp })
    }),
    ("~/execute/_action/cancel_goal", |node, cdr| {
        let CancelGoalRequest { goal_info } = read(cdr)?;
        let canceled = node.goals.cancel(&goal_info);
        for goal in &canceled.goals_canceling {
            let result = ExecuteResult::default();
            node.goals.end(goal.goal_id, GoalStatusEnum::Canceled, result, node.started);
        }
        write(&canceled)?;
        write(&node.goals.statuses())
    }),
    ("~/execute/_action/get_result", |node, cdr| {
        let GetResultRequest { goal_id } = read(cdr)?;
        match node.goals.result(goal_id, ()) {
            Some(((), answer)) => write(&answer),
            None => Some(()),
        }
    }),
    // What a controller says.
    ("send_goal", |_, cdr| read::<SendGoalResponse>(cdr).map(drop)),
    ("cancel_goal", |_, cdr| read::<ros2_client::action::CancelGoalResponse>(cdr).map(drop)),
    ("get_result", |_, cdr| {
        let answer = read::<GetResultResponse<FollowJointTrajectoryResult>>(cdr)?;
        assert!(!answer.result.error_name().is_empty());
        Some(())
    }),
    ("feedback", |_, cdr| {
        let message = read::<FeedbackMessage<FollowJointTrajectoryFeedback>>(cdr)?;
        assert!(message.feedback.largest_error() >= 0.0);
        Some(())
    }),
    // The header that rmw_cyclonedds_cpp puts before requests and answers.
    ("~/sample", |_, cdr| read::<((u64, i64), TriggerRequest)>(cdr).map(drop)),
    ("~/sample_trajectory", |_, cdr| {
        read::<((u64, i64), SampleTrajectoryRequest)>(cdr).map(drop)
    }),
    ("~/set_parameters", |_, cdr| read::<((u64, i64), SetParametersRequest)>(cdr).map(drop)),
];

/// A message as it comes: which representation, two bytes of options, and the fields.
fn read<M: DeserializeOwned>(cdr: &[u8]) -> Option<M> {
    let (header, body) = cdr.split_at_checked(4)?;
    let representation = match header {
        [0, 0, ..] => RepresentationIdentifier::CDR_BE,
        _ => RepresentationIdentifier::CDR_LE,
    };
    deserialize_from_cdr_with_rep_id(body, representation).ok().map(|(message, _)| message)
}

/// Whatever is answered can be sent.
fn write<M: Serialize>(message: &M) -> Option<()> {
    to_vec::<M, byteorder::LittleEndian>(message).expect("a message that can be sent");
    Some(())
}

/// The built-in model and robot, and no files.
struct BuiltIn;

impl Loader for BuiltIn {
    fn model(&self, _: &str) -> Result<ServedModel, Refusal> {
        const POURING: &[u8] = include_bytes!("../../models/pouring.safetensors");
        Ok(Artifact::from_bytes(POURING).and_then(|a| a.served_model()).expect("the model"))
    }

    fn robot(&self, files: &RobotFiles) -> Result<Robot, Refusal> {
        let arm = urdf::arm(BAXTER_URDF, &files.base_frame, &files.tip_link).expect("the arm");
        let rules = RobotConfig::default().collision;
        Ok(Robot::new(arm, &rules, BAXTER_URDF).expect("the robot"))
    }
}

impl Node {
    /// As it is after its start, with the cup somewhere.
    fn new() -> Self {
        static START: OnceLock<NodeState> = OnceLock::new();
        let state = START.get_or_init(|| {
            let mut values = BTreeMap::new();
            let cup = ros2_client::ParameterValue::DoubleArray(vec![0.60, 0.10]);
            values.insert("task.source_cup.default".to_owned(), cup);
            NodeState::new(values, &BuiltIn).expect("a node").0
        });
        static SAMPLES: OnceLock<usize> = OnceLock::new();
        let asked = || std::env::var("TCVAE_SAMPLES").map_or(1, |n| n.parse().expect("a number"));
        let files = state.robot_files();
        Self {
            frames: Frames { base: files.base_frame.clone(), tip: files.tip_link.clone() },
            state: state.clone(),
            tree: FrameTree::default(),
            goals: Goals::default(),
            started: Instant::now(),
            samples: *SAMPLES.get_or_init(asked),
        }
    }

    fn location(&mut self, name: &str, given: &PointStamped) -> Option<()> {
        let located = self.frames.location(&self.tree, name, &given.header, &given.point);
        let set = located.and_then(|l| self.state.server.set_location(&l.name, l.xy, 0.0));
        if let Err(refusal) = &set {
            assert_ne!(refusal.code, ErrorCode::Internal, "{refusal}");
            assert!(!refusal.message.is_empty());
        }
        set.ok()
    }

    fn transforms(&mut self, message: &TFMessage, is_static: bool) -> Option<()> {
        for transform in &message.transforms {
            let _complaint = self.tree.hear(transform, is_static);
            let header = transform.header.clone();
            for frame_id in [transform.child_frame_id.clone(), header.frame_id.clone()] {
                let mut there = PointStamped::default();
                there.header.frame_id = frame_id;
                there.header.stamp = header.stamp;
                self.location("source_cup", &there);
            }
        }
        Some(())
    }

    /// Sets all of them or none.
    fn set(&mut self, wanted: Vec<raw::Parameter>) -> raw::SetParametersResult {
        let mut changed = self.state.clone();
        let set = wanted.into_iter().try_for_each(|one| changed.set(&one.name, one.value.into(), &[]));
        if set.is_ok() {
            let (before, after) = (self.state.parameters(), changed.parameters());
            if let Some(event) = parameters::event(&before, &after, StampTime::ZERO, "/tcvae") {
                write(&event);
            }
            self.state = changed;
        }
        set.into()
    }

    fn sample(&mut self, request: &SampleRequest) -> Option<()> {
        self.samples = self.samples.checked_sub(1)?;
        let reply = self.state.server.sample(request, 0.0);
        if let Some(refusal) = &reply.refusal {
            assert_ne!(refusal.code, ErrorCode::Internal, "{refusal}");
        }
        write(&self.frames.response(reply))
    }
}

// Up to four messages one after the other: to which end, how long, and the bytes.
libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    let (mut node, mut rest) = (Node::new(), data);
    for _ in 0..4 {
        let [end, low, high, others @ ..] = rest else { return };
        let length = usize::from(u16::from_le_bytes([*low, *high])).min(others.len());
        let (cdr, others) = others.split_at(length);
        let (_, hear) = ENDS[usize::from(*end) % ENDS.len()];
        hear(&mut node, cdr);
        rest = others;
    }
});
