//! Simulated demonstrations of pouring and of stacking, for want of recorded ones.
//!
//! A person guides an arm: idles, reaches for the object, closes the gripper, lifts, carries, and pours
//! and puts the cup back, or puts the block on another one. The hand moves in overlapping
//! minimum-jerk sub-movements; the joints follow by inverse kinematics. Proportions and figures are
//! those of human pours with other arms (40 demonstrations: 10 each with a Franka Panda and a KUKA
//! LWR for the times and angles used here), and of MIME's files for what is around them: noise, the
//! other arm, stray lines, angles beyond the limits, and demonstrations that are none. Of stacking
//! there are no figures of people here: its times are those of the pours' ways, its heights those of a
//! block.
//!
//! What is planted is the truth that importing is measured against: it is computed from the plan,
//! without kinematics and without any of the code that it measures.

mod files;
mod plan;
mod pouring;
mod scene;
mod stacking;

use std::collections::BTreeMap;

use nalgebra::Vector3;
use rand::rngs::ChaCha8Rng;
use rand::seq::SliceRandom;
use rand::{Rng, RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use self::pouring::Pour;
use self::stacking::Stack;
use super::manipulation::ManipulationTask;
use super::recording::{Reason, RobotConfig, Workplace};
use crate::kinematics::Chain;

/// Frames per second, as MIME's.
const RATE_HZ: f64 = 100.0;

/// The joints of a frame, in the order of MIME's files.
pub const MIME_JOINTS: [&str; 17] = [
    "left_w0", "left_w1", "left_w2", "right_s0", "right_s1", "right_w0", "right_w1", "head_pan",
    "right_w2", "head_nod", "torso_t0", "left_e0", "left_e1", "left_s0", "left_s1", "right_e0",
    "right_e1",
];

/// What people do with an object.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Activity {
    /// They pour from a cup (`config/tasks/pour.toml`).
    Pouring,
    /// They put a block on another one (`config/tasks/stack.toml`).
    Stacking,
}

impl Activity {
    /// What a reason for leaving a recording out is called in the task.
    fn reason_name(self, reason: Reason) -> String {
        let action = match self {
            Self::Pouring => "pour",
            Self::Stacking => "stack",
        };
        ManipulationTask::reason_of(action, reason)
    }
}

/// What to simulate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Simulation {
    /// What people do.
    pub activity: Activity,
    /// Raw demonstrations, those that must be left out among them.
    pub count: usize,
    /// Seed of everything that is drawn.
    pub seed: u64,
    /// Correlation of the largest tilt with the time above the pour's tilt, or of the lift of a block with the way that it
    /// is carried; also scales how much
    /// the manner follows from where the cups stand. 0.88 is life-like, with 0 every factor is
    /// drawn by itself, which is what measuring disentanglement needs.
    pub correlation: f64,
    /// Pouring: whether people lean the cup to either side of the hand, mostly that to which they carry it;
    /// else all lean it to the right. Averages of both sides pour nothing.
    pub both_sides: bool,
}

impl Default for Simulation {
    fn default() -> Self {
        Self {
            activity: Activity::Pouring,
            count: 280,
            seed: 0,
            correlation: 0.88,
            both_sides: true,
        }
    }
}

/// Why a simulation can't be.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SimulationError {
    /// The correlation is not one.
    #[error("correlation is {value}; choose a value from 0 to below 1")]
    Correlation {
        /// The value.
        value: f64,
    },
    /// Nobody says where people work with the robot.
    #[error(
        "the robot {robot} has no [workplace] in its TOML, which says where people work with it; config/robots/baxter.toml has one"
    )]
    NoWorkplace {
        /// Name of the robot.
        robot: String,
    },
    /// The arm can't make any of the motions that were drawn.
    #[error(
        "{tries} motions in a row are out of the reach of the arm from {base_frame} to {tip_frame}; \
         move or shrink the workplace in the robot's TOML"
    )]
    Infeasible {
        /// Motions that were drawn.
        tries: usize,
        /// Base of the chain.
        base_frame: String,
        /// Tip of the chain.
        tip_frame: String,
    },
}

/// One demonstration that is to be simulated: what kind it will be.
#[derive(Debug, Clone, PartialEq)]
pub struct Assignment {
    /// Name of its folder: a number, month and day.
    pub id: String,
    /// Why it must be left out; none for a demonstration.
    pub trap: Option<Reason>,
    /// Whether the mirrored arm acts.
    pub right: bool,
    index: u64,
}

/// What a demonstration holds in truth (`truth.json`).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Truth {
    /// Name of the demonstration.
    pub id: String,
    /// `accept`, or the reason for leaving it out.
    pub expected: String,
    /// The arm that moved.
    pub arm: String,
    /// `(x, y)` of each location, m, mirrored where the right arm moved; empty where there is no
    /// pour to learn from.
    pub task: BTreeMap<String, [f64; 2]>,
    /// The manner, s, degrees and m; empty where there is no pour to learn from.
    pub factors: BTreeMap<String, f64>,
}

/// The content of `truth.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TruthFile {
    /// One entry per demonstration.
    pub demonstrations: Vec<Truth>,
}

/// The files of a demonstration before they are text.
#[derive(Debug, Clone, PartialEq)]
pub struct RawDemonstration {
    /// Name of the folder.
    pub id: String,
    /// Names of the joints, in the order of a frame.
    pub joint_names: Vec<String>,
    /// One frame per line: rad.
    pub frames: Vec<Vec<f64>>,
    /// Name of each gripper, and how far it is open in per cent, one value per line; not as many as
    /// frames.
    pub grippers: Vec<(String, Vec<f64>)>,
    /// Lines that are no frame, each with the frame that it comes before.
    pub stray_lines: Vec<(usize, String)>,
    /// Frames whose line is cut off in the middle, ascending.
    pub cut_lines: Vec<usize>,
    /// Whether lines are Python literals instead of JSON.
    pub python_syntax: bool,
}

/// A simulated demonstration.
#[derive(Debug, Clone, PartialEq)]
pub struct Simulated {
    /// What is written.
    pub raw: RawDemonstration,
    /// What it holds.
    pub truth: Truth,
    /// Motions that were drawn before this one and that the arm can't make.
    pub redrawn: usize,
}

impl Simulation {
    /// Which demonstrations there will be: about a quarter must be left out, 45 % are those of the mirrored
    /// arm where there is one.
    ///
    /// # Errors
    /// The correlation is not in `[0, 1)`; a robot without a workplace.
    pub fn assignments(&self, robot: &RobotConfig) -> Result<Vec<Assignment>, SimulationError> {
        if !(0.0..1.0).contains(&self.correlation) {
            return Err(SimulationError::Correlation { value: self.correlation });
        }
        workplace(robot)?;
        let mut rng = self.rng(u64::MAX);
        let share = |share: f64| (share * self.count as f64).round() as usize;
        let mut traps: Vec<Option<Reason>> = Vec::with_capacity(self.count);
        for (reason, count) in [
            (Reason::SeveralActions, share(0.125)),
            (Reason::NoAction, share(0.05)),
            (Reason::NoGrasp, share(0.05)),
            (Reason::Jump, share(2.0 / 280.0)),
            (Reason::Incomplete, share(2.0 / 280.0)),
            (Reason::OutOfRegion, share(2.0 / 280.0)),
            (Reason::Unreadable, share(2.0 / 280.0)),
            (Reason::TooShort, share(1.0 / 280.0)),
        ] {
            traps.extend(std::iter::repeat_n(Some(reason), count));
        }
        traps.resize(self.count, None);
        traps.shuffle(&mut rng);
        let mut right: Vec<bool> = (0..self.count).map(|i| i < share(0.45)).collect();
        right.shuffle(&mut rng);
        if robot.mirrored_arm.is_none() {
            right.fill(false);
        }
        let mut number = 4000;
        let mut assignment = |(index, (trap, right)): (usize, (Option<Reason>, bool))| {
            number += rng.random_range(1..=9);
            let month = ["Jul", "Aug", "Sep"][rng.random_range(0..3_usize)];
            let id = format!("{number}{month}{:02}", rng.random_range(1..=30));
            Assignment { id, trap, right, index: index as u64 }
        };
        Ok(traps.into_iter().zip(right).enumerate().map(&mut assignment).collect())
    }

    /// Simulates one demonstration; `chain` is that of the robot's served arm. Each has its own random
    /// numbers, so they may be simulated in any order.
    ///
    /// # Errors
    /// The arm can't make any of many motions that were drawn; a robot without a workplace.
    pub fn simulate(
        &self,
        assignment: &Assignment,
        robot: &RobotConfig,
        chain: &Chain,
    ) -> Result<Simulated, SimulationError> {
        const MAX_TRIES: usize = 200;
        let workplace = workplace(robot)?;
        let mut rng = self.rng(assignment.index);
        let loose = loosened(chain);
        let Assignment { id, trap, .. } = assignment;
        let arm = match &robot.mirrored_arm {
            Some(mirrored) if assignment.right => mirrored,
            _ => &robot.arm,
        };
        let mut truth = Truth {
            id: id.clone(),
            expected: trap.map_or_else(|| "accept".into(), |r| self.activity.reason_name(r)),
            arm: arm.name.clone(),
            task: BTreeMap::new(),
            factors: BTreeMap::new(),
        };
        for redrawn in 0..MAX_TRIES {
            // A few guides push joints beyond the limits of the description.
            let chain = if rng.random_bool(0.3) { &loose } else { chain };
            let raw = match self.activity {
                Activity::Pouring => {
                    let pour = Pour::draw(self, *trap, workplace, &mut rng);
                    let Some(joints) = pour.plan.joints(chain, &mut rng) else { continue };
                    if trap.is_none() {
                        pour.truth(&mut truth);
                    }
                    pour.plan.raw(assignment, robot, joints, &mut rng)
                }
                Activity::Stacking => {
                    let stack = Stack::draw(self, *trap, workplace, &mut rng);
                    let Some(joints) = stack.plan.joints(chain, &mut rng) else { continue };
                    if trap.is_none() {
                        stack.truth(&mut truth);
                    }
                    stack.plan.raw(assignment, robot, joints, &mut rng)
                }
            };
            return Ok(Simulated { raw, truth, redrawn });
        }
        Err(SimulationError::Infeasible {
            tries: MAX_TRIES,
            base_frame: chain.base_frame().into(),
            tip_frame: chain.tip_frame().into(),
        })
    }

    fn rng(&self, stream: u64) -> ChaCha8Rng {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(stream);
        rng
    }
}

fn workplace(robot: &RobotConfig) -> Result<&Workplace, SimulationError> {
    let missing = || SimulationError::NoWorkplace { robot: robot.name.clone() };
    robot.workplace.as_ref().ok_or_else(missing)
}

/// The chain with limits that are 0.18 rad wider, which is how far MIME's angles leave them.
fn loosened(chain: &Chain) -> Chain {
    const BEYOND_RAD: f64 = 0.18;
    chain.widened(BEYOND_RAD).expect("wider limits are limits")
}

fn normal(rng: &mut (impl Rng + ?Sized)) -> f64 {
    StandardNormal.sample(rng)
}

/// A direction, every one as likely.
fn direction(rng: &mut (impl Rng + ?Sized)) -> Vector3<f64> {
    Vector3::new(normal(rng), normal(rng), normal(rng)).normalize()
}
