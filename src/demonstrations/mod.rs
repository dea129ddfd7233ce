//! Demonstrations, the tasks that they show, and what those tasks measure of a motion.

pub mod arcs;
pub mod augmentation;
pub mod joint_messages;
pub mod manipulation;
pub mod mirroring;
pub mod pouring;
pub mod quality;
pub mod recording;
pub mod simulation;
pub mod task;

pub use crate::primitive::Demonstration;
pub use task::{Task, TaskConfig, TaskMeasureError, TaskSettingError, Violation};

use rand::Rng;
use rand::seq::SliceRandom;

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

impl Splits {
    /// The parts with their names.
    pub fn parts(&self) -> [(&'static str, &[Demonstration]); 3] {
        let Self { train, validation, test } = self;
        [("train", train), ("validation", validation), ("test", test)]
    }

    /// The paper's proportions of 208 demonstrations: 124 to train on, 42 to validate on and 42 to
    /// test on, drawn at random. With fewer than five, everything is trained on.
    pub fn random<R: Rng + ?Sized>(mut demonstrations: Vec<Demonstration>, rng: &mut R) -> Self {
        demonstrations.shuffle(rng);
        let count = demonstrations.len();
        let held_out = if count < 5 { 0 } else { ((count * 42 + 104) / 208).max(1) };
        let test = demonstrations.split_off(count - held_out);
        let validation = demonstrations.split_off(count - 2 * held_out);
        Self { train: demonstrations, validation, test }
    }
}
