//! What a movement primitive is to its users: something that learns from demonstrations, and turns
//! task parameters, and manner parameters where it has them, into a trajectory.

use rand::Rng;

use crate::parameters::{MannerParameters, MannerSpace, TaskParameters, TaskSpace};
use crate::trajectory::{Motion, Trajectory};

/// One demonstration, cut to the primitive and resampled.
#[derive(Debug, Clone, PartialEq)]
pub struct Demonstration {
    /// Where it comes from: the recording's name, and what augmentation made of it.
    pub id: String,
    /// The task that it achieved.
    pub w: TaskParameters,
    /// The motion.
    pub motion: Motion,
}

/// A trajectory as a primitive generates it.
#[derive(Debug, Clone, PartialEq)]
pub struct Generated {
    /// The mean over phase, shape `[steps, state_dim]`; this is what is served.
    pub mean: Trajectory,
    /// Standard deviation of each value, the shape of the mean; reported, never added as noise.
    pub stddev: Trajectory,
}

/// A learned motion that adapts to task parameters.
pub trait MovementPrimitive: std::fmt::Debug {
    /// What the primitive's task parameters are.
    fn task_space(&self) -> &TaskSpace;

    /// Number of states in a generated trajectory.
    fn steps(&self) -> usize;

    /// Values of one state.
    fn state_dim(&self) -> usize;

    /// The motion for task `w`; with the prior's mean where the primitive has a manner.
    fn generate(&self, w: &TaskParameters) -> Generated;
}

/// A primitive whose manner can be chosen apart from its task.
pub trait MannerConditioned: MovementPrimitive {
    /// What the primitive's manner parameters are.
    fn manner_space(&self) -> &MannerSpace;

    /// The motion for task `w` in manner `h` (eq. 9-12).
    fn decode(&self, w: &TaskParameters, h: &MannerParameters) -> Generated;

    /// A manner from the prior `p(h)`, cut off at the bounds of the space.
    fn sample_manner(&self, rng: &mut dyn Rng) -> MannerParameters;
}
