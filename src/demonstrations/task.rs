//! What a task measures of a motion: the paper's `G` (eq. 15), and whether the motion is one.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use super::arcs::ArcsTask;
use super::manipulation::ManipulationTask;
use crate::parameters::{TaskParameters, TaskSpace};
use crate::pose::{STATE_NAMES, StateFrame};
use crate::trajectory::Motion;

/// Why a motion has no empirical task parameters.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{detail}")]
pub struct TaskMeasureError {
    /// Fact, number, limit: `the tilt reaches 61 of the 70 degrees that are a pour`.
    pub detail: String,
}

/// A bound of validity that a motion breaks.
#[derive(Debug, Clone, PartialEq)]
pub struct Violation {
    /// Name of the bound, as in the task's TOML.
    pub bound: &'static str,
    /// What was measured.
    pub value: f64,
    /// The limit.
    pub limit: f64,
    /// Unit of both.
    pub unit: &'static str,
}

impl Violation {
    /// Whether it is about how fast something is, and not about when or where.
    pub fn is_rate(&self) -> bool {
        self.unit.contains("/s")
    }
}

impl std::fmt::Display for Violation {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { bound, value, limit, unit } = self;
        write!(f, "{bound} {value:.3} {unit}, limit {limit:.3} {unit}")
    }
}

/// A quantity that describes the manner of a motion, such as the duration of the pour.
#[derive(Debug, Clone, PartialEq)]
pub struct Factor {
    /// Name, such as `pour_duration`.
    pub name: Cow<'static, str>,
    /// Unit, such as `s`.
    pub unit: &'static str,
    /// What a person reads after number and unit: `of the pour`.
    pub phrase: Cow<'static, str>,
    /// The value.
    pub value: f64,
    /// Whether other factors determine most of it, as a pour's start and length do the time of the
    /// whole motion.
    pub derived: bool,
}

/// What a task measures of a motion. Nothing that models, trains or serves knows more of it.
pub trait Task: std::fmt::Debug + Send + Sync {
    /// Name, such as `pouring`.
    fn name(&self) -> &str;

    /// What the task parameters are.
    fn task_space(&self) -> TaskSpace;

    /// `G(x)`: the task parameters that the motion achieves, in the order of the task space.
    ///
    /// # Errors
    /// When the motion does not show the task, such as one that never pours.
    fn empirical_task(&self, motion: &Motion) -> Result<TaskParameters, TaskMeasureError>;

    /// Every bound of validity that the motion breaks; none for a valid motion.
    fn violations(&self, motion: &Motion) -> Vec<Violation>;

    /// When the events happen that every motion of the task passes, as shares of the motion's time,
    /// ascending inside (0, 1), always as many; empty where the task has none, or the motion does
    /// not show it.
    fn events(&self, motion: &Motion) -> Vec<f64> {
        let _ = motion;
        Vec::new()
    }

    /// The task as its mirror image in the xz plane shows it; none where it is not the same then.
    fn mirrored(&self) -> Option<Box<dyn Task>> {
        None
    }

    /// Manner factors of the motion, always the same ones in the same order; empty where the motion
    /// does not show the task.
    fn factors(&self, motion: &Motion) -> Vec<Factor>;
}

/// A task with its settings, as data sets and model files store it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "task", rename_all = "snake_case")]
#[non_exhaustive]
#[expect(clippy::large_enum_variant, reason = "a program has one or two of them")]
pub enum TaskConfig {
    /// Arcs of a circle around a centre.
    Arcs(ArcsTask),
    /// What an arm does with an object.
    Manipulation(ManipulationTask),
}

/// Why a task's settings can't be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{name} is {value}; it must be {expected}")]
pub struct TaskSettingError {
    /// The key.
    pub name: &'static str,
    /// Its value.
    pub value: String,
    /// What it must be.
    pub expected: &'static str,
}

impl TaskConfig {
    /// Checks what no type can say.
    ///
    /// # Errors
    /// The first setting that can't be.
    pub fn check(&self) -> Result<(), TaskSettingError> {
        match self {
            Self::Arcs(_) => Ok(()),
            Self::Manipulation(task) => task.check(),
        }
    }

    /// The task that measures motions.
    pub fn task(&self) -> &dyn Task {
        match self {
            Self::Arcs(task) => task,
            Self::Manipulation(task) => task,
        }
    }

    /// The task that measures motions, on its own.
    pub fn into_task(self) -> Box<dyn Task> {
        match self {
            Self::Arcs(task) => Box::new(task),
            Self::Manipulation(task) => Box::new(task),
        }
    }

    /// Distances from the task at which success and robustness are reported, in the task space's unit;
    /// the paper's by default.
    pub fn thresholds(&self) -> [f64; 3] {
        match self {
            Self::Arcs(_) => [0.025, 0.05, 0.1],
            Self::Manipulation(task) => task.thresholds_m,
        }
    }

    /// Where states are poses of a robot's tip, what their rotations are measured from.
    pub fn state_frame(&self) -> Option<StateFrame> {
        match self {
            Self::Arcs(_) => None,
            Self::Manipulation(task) => Some(task.state_frame()),
        }
    }

    /// Names of a state's values.
    pub fn state_names(&self) -> Vec<String> {
        let names: &[&str] = match self {
            Self::Arcs(_) => &["x", "y"],
            Self::Manipulation(_) => &STATE_NAMES,
        };
        names.iter().map(ToString::to_string).collect()
    }

    /// Tilt, in degrees, beyond which the action happens; none where it is no tilt.
    pub fn tilt_threshold_deg(&self) -> Option<f64> {
        match self {
            Self::Arcs(_) => None,
            Self::Manipulation(task) => task.tilt_threshold_deg(),
        }
    }
}
