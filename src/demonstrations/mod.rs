//! Demonstrations, the tasks that they show, and what those tasks measure of a motion.

pub mod arcs;
pub mod mirroring;
pub mod pouring;
pub mod recording;
pub mod simulation;
pub mod task;

pub use task::{Task, TaskConfig, TaskMeasureError, Violation};

pub use crate::primitive::Demonstration;

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
