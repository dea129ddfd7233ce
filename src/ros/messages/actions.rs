//! Actions: what rcl's protocol for them consists of beyond ros2-client's generic types, and the action that
//! joint trajectory controllers serve.

/// What goes with goals.
pub mod action_msgs {
    use ros2_client::action::GoalInfo;
    use serde::{Deserialize, Serialize};

    /// The request of `action_msgs/srv/CancelGoal`. With neither an id nor a stamp all goals are meant, with only a
    /// stamp those accepted until then, with only an id that goal, with both that goal and those.
    #[derive(Clone, Debug, Serialize, Deserialize)]
    #[serde(rename = "CancelGoal_Request")]
    pub struct CancelGoalRequest {
        /// Which goals.
        pub goal_info: GoalInfo,
    }

    super::super::messages!(CancelGoalRequest);
}

/// What joint trajectory controllers speak.
pub mod control_msgs {
    use serde::{Deserialize, Serialize};

    use super::super::builtin_interfaces::Duration;
    use super::super::std_msgs::Header;
    use super::super::trajectory_msgs::{
        JointTrajectory, JointTrajectoryPoint, MultiDOFJointTrajectory,
    };

    /// How far one joint may be off.
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct JointTolerance {
        /// The joint.
        pub name: String,
        /// rad or m; 0 means the controller's own.
        pub position: f64,
        /// rad/s or m/s.
        pub velocity: f64,
        /// rad/s2 or m/s2.
        pub acceleration: f64,
    }

    /// How far one component of a joint with several may be off.
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct JointComponentTolerance {
        /// The joint.
        pub joint_name: String,
        /// Which component.
        pub component: u16,
        /// rad or m; 0 means the controller's own.
        pub position: f64,
        /// rad/s or m/s.
        pub velocity: f64,
        /// rad/s2 or m/s2.
        pub acceleration: f64,
    }

    /// The goal of `action/FollowJointTrajectory`.
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    #[serde(rename = "FollowJointTrajectory_Goal")]
    pub struct FollowJointTrajectoryGoal {
        /// The motion.
        pub trajectory: JointTrajectory,
        /// Of joints with several degrees of freedom.
        pub multi_dof_trajectory: MultiDOFJointTrajectory,
        /// Empty for the controller's own.
        pub path_tolerance: Vec<JointTolerance>,
        /// Empty for the controller's own.
        pub component_path_tolerance: Vec<JointComponentTolerance>,
        /// Empty for the controller's own.
        pub goal_tolerance: Vec<JointTolerance>,
        /// Empty for the controller's own.
        pub component_goal_tolerance: Vec<JointComponentTolerance>,
        /// How much later than planned the end may be reached; 0 for the controller's own.
        pub goal_time_tolerance: Duration,
    }

    /// The result of `action/FollowJointTrajectory`.
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    #[serde(rename = "FollowJointTrajectory_Result")]
    pub struct FollowJointTrajectoryResult {
        /// 0, or what went wrong.
        pub error_code: i32,
        /// In words.
        pub error_string: String,
    }

    impl FollowJointTrajectoryResult {
        /// The name of its error code.
        pub fn error_name(&self) -> &'static str {
            match self.error_code {
                0 => "SUCCESSFUL",
                -1 => "INVALID_GOAL",
                -2 => "INVALID_JOINTS",
                -3 => "OLD_HEADER_TIMESTAMP",
                -4 => "PATH_TOLERANCE_VIOLATED",
                -5 => "GOAL_TOLERANCE_VIOLATED",
                _ => "an unknown error",
            }
        }
    }

    /// The feedback of `action/FollowJointTrajectory`, as far as all distributions have it alike. What follows is
    /// not read.
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    #[serde(rename = "FollowJointTrajectory_Feedback")]
    pub struct FollowJointTrajectoryFeedback {
        /// When.
        pub header: Header,
        /// Which joints.
        pub joint_names: Vec<String>,
        /// Where they should be.
        pub desired: JointTrajectoryPoint,
        /// Where they are.
        pub actual: JointTrajectoryPoint,
        /// The difference.
        pub error: JointTrajectoryPoint,
    }

    impl FollowJointTrajectoryFeedback {
        /// The largest deviation of a joint (rad): as the controller tells it, or else of where the joints are from
        /// where they should be.
        pub fn largest_error(&self) -> f64 {
            let found =
                self.desired.positions.iter().zip(&self.actual.positions).map(|(d, a)| d - a);
            let errors: Vec<f64> = match self.error.positions.as_slice() {
                [] => found.collect(),
                told => told.to_vec(),
            };
            errors.iter().map(|e| e.abs()).filter(|e| e.is_finite()).fold(0.0, f64::max)
        }
    }

    super::super::messages!(
        FollowJointTrajectoryGoal,
        FollowJointTrajectoryResult,
        FollowJointTrajectoryFeedback,
    );
}
