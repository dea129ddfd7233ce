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
    /// When the events of the task happen, as shares of the motion's time, ascending inside (0, 1);
    /// empty for a task without.
    pub events: Vec<f64>,
}

/// A trajectory as a primitive generates it.
#[derive(Debug, Clone, PartialEq)]
pub struct Generated {
    /// The mean over phase, shape `[steps, state_dim]`; this is what is served.
    pub mean: Trajectory,
    /// Standard deviation of each value, the shape of the mean; reported, never added as noise.
    pub stddev: Trajectory,
    /// How long the motion takes; none where the primitive knows phases only, and others choose.
    pub duration_secs: Option<f64>,
}

impl Generated {
    /// The mean as a motion, which takes `otherwise_secs` where the primitive knows phases only.
    pub fn motion(self, otherwise_secs: f64) -> Motion {
        let duration_secs = self.duration_secs.unwrap_or(otherwise_secs);
        Motion { states: self.mean, duration_secs }
    }
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

    /// The manner parameters of latents, such as a posterior's mean; a value outside its bounds is
    /// put at the nearest. They are the latents themselves, but for a primitive with a learned
    /// prior.
    ///
    /// # Panics
    /// When there is not one finite value for each manner parameter.
    fn manner(&self, latents: &[f64]) -> MannerParameters {
        MannerParameters::clamped(self.manner_space(), latents)
    }

    /// The motion for task `w` at latents that need not be what a manner parameter may be; without
    /// a learned prior those of the manner parameters, likewise put at their bounds.
    ///
    /// # Panics
    /// When there is not one finite value for each manner parameter.
    fn decode_latents(&self, w: &TaskParameters, latents: &[f64]) -> Generated {
        self.decode(w, &self.manner(latents))
    }

    /// Whether the prior of the latents was learned; else it is N(0, I).
    fn has_learned_prior(&self) -> bool {
        false
    }
}
