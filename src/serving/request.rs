//! What a client asks for, and what it gets.

use crate::parameters::MannerAxis;
use crate::serving::{Refusal, StartPolicy};
use crate::trajectory::{EndEffectorTrajectory, JointTrajectory};

/// Most samples that one request may ask for.
pub const MAX_COUNT: u32 = 64;

/// How several samples are ordered.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum RankBy {
    /// As they were drawn.
    #[default]
    Drawn,
    /// Largest joint margin first.
    Margin,
    /// Smoothest joint motion first.
    Smoothness,
    /// Shortest first.
    Duration,
}

/// A point of the task, in the base frame.
#[derive(Debug, Clone, PartialEq)]
pub struct GivenLocation {
    /// Name of the location.
    pub name: String,
    /// `(x, y)` in the base frame (m).
    pub xy: [f64; 2],
}

/// A request for samples. `Default` asks for one sample of the latest task as the node is set.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SampleRequest {
    /// Locations of the task; those left out are the latest that were set.
    pub task: Vec<GivenLocation>,
    /// Names of the manner parameters that the request fixes.
    pub manner_names: Vec<String>,
    /// Their values.
    pub manner_values: Vec<f64>,
    /// Draw the manner parameters that are not fixed by name from the prior.
    pub sample_manner: bool,
    /// Number of samples; 0 means 1.
    pub count: u32,
    /// Seed; 0 means the node's.
    pub seed: u64,
    /// Where the joints are, by name; empty where that is not known. Other joints than the arm's may
    /// be among them. The motion must begin there.
    pub start: Vec<(String, f64)>,
    /// What happens where the arm is not at the first point of the motion; none means the setting.
    pub start_policy: Option<StartPolicy>,
    /// Whether the motion is driven at once; then it must be known where the arm is, unless the policy is that
    /// it does not matter.
    pub is_driven: bool,
    /// Share of the velocity limits; 0 means the setting.
    pub velocity_scale: f64,
    /// Share of the acceleration limits; 0 means the setting.
    pub acceleration_scale: f64,
    /// How many times as fast as it was learned; 0 means the setting.
    pub speed: f64,
    /// Points per second of the trajectory; 0 means the model's own.
    pub rate_hz: f64,
    /// Order of the samples.
    pub rank_by: RankBy,
    /// Serve a task outside the trained region, with a warning.
    pub allow_out_of_distribution: bool,
}

/// A motion that passed every check; the fields of `tcvae_msgs/msg/Sample`.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    /// The joints over time.
    pub joint_trajectory: JointTrajectory,
    /// The tip over time, by forward kinematics of the joints.
    pub end_effector_trajectory: EndEffectorTrajectory,
    /// First point after the approach.
    pub primitive_start_index: u32,
    /// Names of the manner parameters.
    pub manner_names: Vec<String>,
    /// Their values, in standard deviations of the prior.
    pub manner_values: Vec<f64>,
    /// The task that was asked for.
    pub task: Vec<GivenLocation>,
    /// `G` of the motion as executed.
    pub empirical_task: Vec<GivenLocation>,
    /// Largest distance to a location that the task's G measures (m).
    pub task_error: f64,
    /// Worst position error of the inverse kinematics (m).
    pub position_error: f64,
    /// Worst orientation error of the inverse kinematics (rad).
    pub orientation_error: f64,
    /// Smallest distance of a joint to one of its limits (rad).
    pub joint_margin: f64,
    /// Smallest distance to the table and to itself (m); NaN where not modelled.
    pub min_clearance: f64,
    /// The uniform factor by which the motion was slowed down, at least 1.
    pub slowdown: f64,
    /// Share of the training tasks that lie further out than this task.
    pub in_distribution_task: f64,
    /// Share of the prior that lies further out than this manner.
    pub in_distribution_manner: f64,
    /// Standard deviation of the position (m), one per point.
    pub position_stddev: Vec<f64>,
    /// Seed that makes this sample again.
    pub seed: u64,
    /// Draws that it took.
    pub tries: u32,
    /// What a careful reader should know.
    pub warnings: Vec<String>,
}

/// The answer to a [`SampleRequest`].
#[derive(Debug, Clone, PartialEq)]
pub struct SampleReply {
    /// Samples, each of them checked; fewer than asked for when there is a refusal.
    pub samples: Vec<Sample>,
    /// Why there are fewer samples than asked for.
    pub refusal: Option<Refusal>,
    /// The model that was sampled.
    pub model_id: String,
}

/// What the node serves; the fields of `tcvae_msgs/srv/DescribePrimitive`.
#[derive(Debug, Clone, PartialEq)]
pub struct Description {
    /// The model that is served.
    pub model_id: String,
    /// How it was learned, such as `TC-VAE` or `ProMP`.
    pub method: String,
    /// Name of the task, such as `pouring`.
    pub primitive: String,
    /// Names of the values of `w`.
    pub task_names: Vec<String>,
    /// Lower end of the trained region, one per value of `w`.
    pub task_lower: Vec<f64>,
    /// Upper end of the trained region, one per value of `w`.
    pub task_upper: Vec<f64>,
    /// The manner parameters and what they do.
    pub manner: Vec<MannerAxis>,
    /// Their values as set.
    pub manner_values: Vec<f64>,
    /// The stored evaluation as JSON; `null` where the model has none.
    pub evaluation_json: String,
    /// Name of the robot.
    pub robot: String,
    /// Names of its joints, in the order of every trajectory.
    pub joint_names: Vec<String>,
    /// Whether the model was trained on synthetic demonstrations.
    pub synthetic_data: bool,
    /// Whether its motions are the mirror images of those that were learned, for the other arm.
    pub mirrored: bool,
}
