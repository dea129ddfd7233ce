//! What a server serves: a primitive with its task, on a robot.

use crate::demonstrations::Task;
use crate::kinematics::{Chain, RobotRecord};
use crate::parameters::TaskSpace;
use crate::pose::StateFrame;
use crate::primitive::MannerConditioned;
use crate::serving::Familiarity;

/// A trained primitive and what its model file says of it.
#[derive(Debug)]
pub struct ServedModel {
    /// First 12 digits of the SHA-256 over the tensors.
    pub model_id: String,
    /// The primitive; its states are the 6-D states of [`crate::pose`].
    pub primitive: Box<dyn MannerConditioned + Send + Sync>,
    /// What the task measures of a motion.
    pub task: Box<dyn Task>,
    /// Where the states' rotation vectors are measured from.
    pub frame: StateFrame,
    /// How long the motion takes, before it is slowed down (s).
    pub duration_secs: f64,
    /// The arm that the model was made for.
    pub robot: RobotRecord,
    /// The stored evaluation as JSON; `null` where there is none.
    pub evaluation_json: String,
    /// Whether the demonstrations were synthetic.
    pub synthetic_data: bool,
    /// How far out tasks and manners lie.
    pub familiarity: Familiarity,
}

impl ServedModel {
    /// What the task parameters are.
    pub fn space(&self) -> &TaskSpace {
        self.primitive.task_space()
    }
}

/// The arm that executes.
#[derive(Debug, Clone)]
pub struct Robot {
    /// Name of the robot.
    pub name: String,
    /// From the base frame to the tip.
    pub chain: Chain,
}
