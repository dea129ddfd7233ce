//! Demonstrations, the tasks that they show, and what those tasks measure of a motion.

pub mod task;

pub use task::{Task, TaskMeasureError, Violation};

use crate::parameters::TaskParameters;
use crate::trajectory::Motion;

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
