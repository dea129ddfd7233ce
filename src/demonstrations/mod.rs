//! Demonstrations, the tasks that they show, and what those tasks measure of a motion.

pub mod arcs;
pub mod mirroring;
pub mod pouring;
pub mod recording;
pub mod simulation;
pub mod task;

pub use task::{Task, TaskConfig, TaskMeasureError, Violation};

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

/// Demonstrations in the three parts that learning needs: to fit, to choose, to report.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Splits {
    /// What the networks are fitted to.
    pub train: Vec<Demonstration>,
    /// What settings are chosen on.
    pub validation: Vec<Demonstration>,
    /// What nobody looks at while choosing.
    pub test: Vec<Demonstration>,
}
