//! Our own messages, services and action, as defined in `msg/tcvae_msgs`.

use super::geometry_msgs::PointStamped;
use super::messages;
use super::sensor_msgs::JointState;
use super::trajectory_msgs::{JointTrajectory, MultiDOFJointTrajectory};
use serde::{Deserialize, Serialize};

/// One location that a task is about.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TaskLocation {
    /// For example `pour_location`.
    pub name: String,
    /// Where; a zero stamp means the latest transform.
    pub point: PointStamped,
}

/// One manner parameter of the loaded model, in standard deviations of its prior.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MannerParameter {
    /// For example `pour_duration`.
    pub name: String,
    /// The present value.
    pub value: f64,
    /// The smallest allowed.
    pub lower: f64,
    /// The largest allowed.
    pub upper: f64,
    /// What it does, measured.
    pub effect: String,
}

/// One sampled and checked motion.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Sample {
    /// The motion of the joints.
    pub joint_trajectory: JointTrajectory,
    /// The same motion of the tip.
    pub end_effector_trajectory: MultiDOFJointTrajectory,
    /// First point after the approach.
    pub primitive_start_index: u32,
    /// Names of the manner parameters.
    pub manner_names: Vec<String>,
    /// Their values, standard deviations of the prior.
    pub manner_values: Vec<f64>,
    /// The task parameters of the motion as executed.
    pub empirical_task: Vec<TaskLocation>,
    /// m, largest distance to a location that was asked for.
    pub task_error: f64,
    /// m, worst inverse kinematics error.
    pub position_error: f64,
    /// rad, worst inverse kinematics error.
    pub orientation_error: f64,
    /// rad, smallest distance to a joint limit.
    pub joint_margin: f64,
    /// m, to the table and to itself; NaN where not modelled.
    pub min_clearance: f64,
    /// At least 1, the uniform factor that keeps the limits.
    pub slowdown: f64,
    /// Share of training tasks that lie further out.
    pub in_distribution_task: f64,
    /// Share of the prior that lies further out.
    pub in_distribution_manner: f64,
    /// m, one per point.
    pub position_stddev: Vec<f64>,
    /// What reproduces this sample.
    pub seed: u64,
    /// Samples drawn until one passed the checks.
    pub tries: u32,
    /// What the receiver should know.
    pub warnings: Vec<String>,
}

/// The request of `srv/SampleTrajectory`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename = "SampleTrajectory_Request")]
pub struct SampleTrajectoryRequest {
    /// Where; empty for the latest topics.
    pub task: Vec<TaskLocation>,
    /// Manner parameters to set; the rest comes from the node's setting, or from the prior.
    pub manner_names: Vec<String>,
    /// Their values, standard deviations of the prior.
    pub manner_values: Vec<f64>,
    /// Draws what `manner_names` leaves open.
    pub sample_manner: bool,
    /// How many, at most 64; 0 means 1.
    pub count: u32,
    /// 0 means the node's.
    pub seed: u64,
    /// Where the arm is; empty for `/joint_states`, or none.
    pub start: JointState,
    /// 0 means the parameter.
    pub velocity_scale: f64,
    /// 0 means the parameter.
    pub acceleration_scale: f64,
    /// Points per second; 0 means the model's.
    pub rate_hz: f64,
    /// Empty, `margin`, `smoothness` or `duration`.
    pub rank_by: String,
    /// Also publishes the first sample.
    pub publish: bool,
    /// Serves tasks outside the trained region.
    pub allow_out_of_distribution: bool,
}

/// The response of `srv/SampleTrajectory`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename = "SampleTrajectory_Response")]
pub struct SampleTrajectoryResponse {
    /// A value of `msg/ErrorCode`; not 0: there may be fewer samples than asked for.
    pub error_code: i32,
    /// What went wrong, how much, the limit, what to do.
    pub error_message: String,
    /// The samples, each of them checked.
    pub samples: Vec<Sample>,
    /// The model that they come from.
    pub model_id: String,
}

/// The request of `srv/SetManner`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename = "SetManner_Request")]
pub struct SetMannerRequest {
    /// The manner parameters to set.
    pub names: Vec<String>,
    /// Their values, standard deviations of the prior.
    pub values: Vec<f64>,
    /// Puts all others back to the prior's mean.
    pub reset: bool,
}

/// The response of `srv/SetManner`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename = "SetManner_Response")]
pub struct SetMannerResponse {
    /// A value of `msg/ErrorCode`.
    pub error_code: i32,
    /// What went wrong, how much, the limit, what to do.
    pub error_message: String,
    /// All manner parameters as they are now.
    pub manner: Vec<MannerParameter>,
}

/// The request of `srv/DescribePrimitive`, which has no fields; ROS sends one byte in their place.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename = "DescribePrimitive_Request")]
pub struct DescribePrimitiveRequest {
    /// Without meaning.
    pub structure_needs_at_least_one_member: u8,
}

/// The response of `srv/DescribePrimitive`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename = "DescribePrimitive_Response")]
pub struct DescribePrimitiveResponse {
    /// Names the model file.
    pub model_id: String,
    /// What kind of primitive.
    pub primitive: String,
    /// Names of the task parameters.
    pub task_names: Vec<String>,
    /// Lower corner of the trained region.
    pub task_lower: Vec<f64>,
    /// Upper corner of the trained region.
    pub task_upper: Vec<f64>,
    /// The manner parameters.
    pub manner: Vec<MannerParameter>,
    /// What was measured of the model, as JSON.
    pub evaluation_json: String,
    /// Name of the robot.
    pub robot: String,
    /// The joints, in the order of the trajectories.
    pub joint_names: Vec<String>,
    /// Trained on simulated demonstrations.
    pub synthetic_data: bool,
}

/// The request of `srv/LoadModel`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename = "LoadModel_Request")]
pub struct LoadModelRequest {
    /// The model file, on the node's machine.
    pub path: String,
}

/// The response of `srv/LoadModel`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename = "LoadModel_Response")]
pub struct LoadModelResponse {
    /// A value of `msg/ErrorCode`; not 0: the old model stays.
    pub error_code: i32,
    /// What went wrong, how much, the limit, what to do.
    pub error_message: String,
    /// The model that is loaded now.
    pub model_id: String,
}

/// The goal of `action/Execute`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename = "Execute_Goal")]
pub struct ExecuteGoal {
    /// Where; empty for the latest topics.
    pub task: Vec<TaskLocation>,
    /// Manner parameters to set; the rest comes from the node's setting, or from the prior.
    pub manner_names: Vec<String>,
    /// Their values, standard deviations of the prior.
    pub manner_values: Vec<f64>,
    /// Draws what `manner_names` leaves open.
    pub sample_manner: bool,
    /// 0 means the node's.
    pub seed: u64,
    /// 0 means the parameter.
    pub velocity_scale: f64,
    /// 0 means the parameter.
    pub acceleration_scale: f64,
    /// Empty for the parameter; `approach`, `refuse` or `ignore`.
    pub start_policy: String,
    /// Serves tasks outside the trained region.
    pub allow_out_of_distribution: bool,
}

/// The result of `action/Execute`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename = "Execute_Result")]
pub struct ExecuteResult {
    /// A value of `msg/ErrorCode`.
    pub error_code: i32,
    /// What went wrong, how much, the limit, what to do.
    pub error_message: String,
    /// The motion that was driven.
    pub sample: Sample,
}

/// The feedback of `action/Execute`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename = "Execute_Feedback")]
pub struct ExecuteFeedback {
    /// `sampling`, `approaching` or `executing`.
    pub stage: String,
    /// 0 to 1, of the motion.
    pub progress: f64,
    /// rad, largest joint deviation so far.
    pub max_tracking_error: f64,
}

messages!(
    TaskLocation,
    MannerParameter,
    Sample,
    SampleTrajectoryRequest,
    SampleTrajectoryResponse,
    SetMannerRequest,
    SetMannerResponse,
    DescribePrimitiveRequest,
    DescribePrimitiveResponse,
    LoadModelRequest,
    LoadModelResponse,
    ExecuteGoal,
    ExecuteResult,
    ExecuteFeedback,
);
