//! Simulated demonstrations of pouring, for want of recorded ones.
//!
//! A person guides one arm of a Baxter: idles, reaches for the cup, closes the gripper, lifts,
//! carries, tilts, holds, lets the tilt fall, puts the cup back. The hand moves in overlapping
//! minimum-jerk sub-movements; the joints follow by inverse kinematics. Proportions and figures are
//! those of human pours with other arms (40 demonstrations: 10 each with a Franka Panda and a KUKA
//! LWR for the times and angles used here), and of MIME's files for what is around them: noise, the
//! other arm, stray lines, angles beyond the limits, and demonstrations that are none.
//!
//! What is planted is the truth that importing is measured against: it is computed from the plan,
//! without kinematics and without any of the code that it measures.

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, UnitVector3, Vector3};
use rand::rngs::ChaCha8Rng;
use rand::seq::SliceRandom;
use rand::{Rng, RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use super::mirroring::{BAXTER_SIGNS, mirrored_joints};
use super::recording::Reason;
use crate::kinematics::Chain;
use crate::kinematics::following::{FollowOptions, follow};

/// Frames per second, as MIME's.
const RATE_HZ: f64 = 100.0;

/// Inverse kinematics sees every fifth frame; the joints between are interpolated.
const FRAMES_PER_FOLLOWED_POINT: usize = 5;

/// The joints of a frame, in the order of MIME's files.
pub const MIME_JOINTS: [&str; 17] = [
    "left_w0", "left_w1", "left_w2", "right_s0", "right_s1", "right_w0", "right_w1", "head_pan",
    "right_w2", "head_nod", "torso_t0", "left_e0", "left_e1", "left_s0", "left_s1", "right_e0",
    "right_e1",
];

/// Joints of one arm, from the base to the tip.
const ARM_JOINTS: [&str; 7] = ["s0", "s1", "e0", "e1", "w0", "w1", "w2"];

/// What to simulate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PourSimulation {
    /// Raw demonstrations, those that must be left out among them.
    pub count: usize,
    /// Seed of everything that is drawn.
    pub seed: u64,
    /// Correlation of the largest tilt with the time above the pour's tilt; also scales how much
    /// the manner follows from where the cups stand. 0.88 is life-like, with 0 every factor is
    /// drawn by itself, which is what measuring disentanglement needs.
    pub correlation: f64,
    /// Whether people lean the cup to either side of the hand, mostly that to which they carry it;
    /// else all lean it to the right. Averages of both sides pour nothing.
    pub both_sides: bool,
}

impl Default for PourSimulation {
    fn default() -> Self {
        Self { count: 280, seed: 0, correlation: 0.88, both_sides: true }
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
    /// The arm can't make any of the motions that were drawn.
    #[error(
        "{tries} motions in a row are out of the arm's reach; the chain from {base_frame} to \
         {tip_frame} is not Baxter's"
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
    /// Whether the right arm pours.
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
    /// One frame per line: rad, in the order of [`MIME_JOINTS`].
    pub frames: Vec<[f64; 17]>,
    /// Per cent open, one value per line; not as many as frames.
    pub left_gripper: Vec<f64>,
    /// Like `left_gripper`.
    pub right_gripper: Vec<f64>,
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

impl PourSimulation {
    /// Which demonstrations there will be: about a quarter must be left out, 45 % are right-handed.
    ///
    /// # Errors
    /// The correlation is not in `[0, 1)`.
    pub fn assignments(&self) -> Result<Vec<Assignment>, SimulationError> {
        if !(0.0..1.0).contains(&self.correlation) {
            return Err(SimulationError::Correlation { value: self.correlation });
        }
        let mut rng = self.rng(u64::MAX);
        let share = |share: f64| (share * self.count as f64).round() as usize;
        let mut traps: Vec<Option<Reason>> = Vec::with_capacity(self.count);
        for (reason, count) in [
            (Reason::SeveralPours, share(0.125)),
            (Reason::NoPour, share(0.05)),
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
        let mut number = 4000;
        let mut assignment = |(index, (trap, right)): (usize, (Option<Reason>, bool))| {
            number += rng.random_range(1..=9);
            let month = ["Jul", "Aug", "Sep"][rng.random_range(0..3_usize)];
            let id = format!("{number}{month}{:02}", rng.random_range(1..=30));
            Assignment { id, trap, right, index: index as u64 }
        };
        Ok(traps.into_iter().zip(right).enumerate().map(&mut assignment).collect())
    }

    /// Simulates one demonstration; `chain` is that of Baxter's left arm. Each has its own random
    /// numbers, so they may be simulated in any order.
    ///
    /// # Errors
    /// The arm can't make any of many motions that were drawn.
    pub fn simulate(
        &self,
        assignment: &Assignment,
        chain: &Chain,
    ) -> Result<Simulated, SimulationError> {
        const MAX_TRIES: usize = 200;
        let mut rng = self.rng(assignment.index);
        let loose = loosened(chain);
        for redrawn in 0..MAX_TRIES {
            // A few guides push joints beyond the limits of the description.
            let chain = if rng.random_bool(0.3) { &loose } else { chain };
            let plan = Plan::draw(self, assignment.trap, &mut rng);
            let Some(joints) = plan.joints(chain, &mut rng) else { continue };
            let raw = plan.raw(assignment, joints, &mut rng);
            let truth = plan.truth(assignment);
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

/// The chain with limits that are 0.18 rad wider, which is how far MIME's angles leave them.
fn loosened(chain: &Chain) -> Chain {
    const BEYOND_RAD: f64 = 0.18;
    let mut joints = chain.joints().to_vec();
    for joint in &mut joints {
        joint.lower -= BEYOND_RAD;
        joint.upper += BEYOND_RAD;
    }
    Chain::new(chain.base_frame(), chain.tip_frame(), joints, *chain.last_joint_from_tip())
        .expect("wider limits are limits")
}

/// A change that happens along a minimum-jerk profile.
#[derive(Debug, Clone, Copy)]
struct Move<V> {
    start: f64,
    duration: f64,
    by: V,
}

impl<V: std::ops::Mul<f64, Output = V> + Copy> Move<V> {
    /// The share of the change that has happened at `t`.
    fn at(&self, t: f64) -> V {
        self.by * minimum_jerk((t - self.start) / self.duration)
    }

    /// The change as a detour: there at the middle, gone at the end.
    fn bump_at(&self, t: f64) -> V {
        let u = ((t - self.start) / self.duration).clamp(0.0, 1.0);
        self.by * (64.0 * (u * (1.0 - u)).powi(3))
    }

    fn end(&self) -> f64 {
        self.start + self.duration
    }
}

/// Flash and Hogan's profile: 0 to 1 with no speed and no acceleration at the ends.
fn minimum_jerk(u: f64) -> f64 {
    let u = u.clamp(0.0, 1.0);
    u * u * u * (10.0 + u * (6.0 * u - 15.0))
}

/// Where a minimum-jerk profile reaches `share`.
fn minimum_jerk_inverse(share: f64) -> f64 {
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..50 {
        let middle = 0.5 * (low + high);
        if minimum_jerk(middle) < share { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}

/// One demonstration as it is meant: the hand of the left arm over time. Times are s, tilts
/// degrees, everything else m and rad.
#[derive(Debug, Clone)]
struct Plan {
    duration: f64,
    /// Pose of the hand at the grasp.
    grasp: Isometry3<f64>,
    /// When the gripper closes and opens, in turns.
    gripper_changes: Vec<f64>,
    /// From the hand's position at the grasp.
    start_offset: Vector3<f64>,
    moves: Vec<Move<Vector3<f64>>>,
    detours: Vec<Move<Vector3<f64>>>,
    /// Turns about the vertical.
    yaws: Vec<Move<f64>>,
    tilts: Vec<Move<f64>>,
    tilt_detours: Vec<Move<f64>>,
    /// What the tilt turns about, in the base frame before the yaw.
    tilt_axis: UnitVector3<f64>,
    /// What the cup is tilted about, as an angle from the hand's direction: 0 degrees where it rolls to
    /// the hand's right, 90 where it pitches ahead, 180 where it rolls to the left.
    from_right_deg: f64,
    /// Where the hand draws back to while the cup tilts, so that the spout stays over the bowl; all
    /// of the way at 90 degrees.
    drawn_back: Vector3<f64>,
    /// Direction from the source to the pour in the plane, rad.
    way: f64,
    /// Where something goes wrong, if it does.
    accident_secs: f64,
}

/// Degrees above which the cup pours, and below which a demonstration ends.
const POUR_TILT_DEG: f64 = 70.0;
const END_TILT_DEG: f64 = 20.0;

impl Plan {
    fn draw(simulation: &PourSimulation, trap: Option<Reason>, rng: &mut ChaCha8Rng) -> Self {
        let scene = Scene::draw(simulation.correlation, trap, rng);
        let manner = Manner::draw(simulation, trap, &scene, rng);
        let mut clock = rng.random_range(0.4..1.4);
        let approach = scene.grasp.rotation * Vector3::z();

        // Reach in two sub-movements: to a point behind the cup, then forward.
        let behind = -approach * rng.random_range(0.08..0.14);
        let far = Vector3::new(
            rng.random_range(-0.16..-0.04),
            rng.random_range(-0.06..0.10),
            rng.random_range(0.02..0.14),
        );
        let start_offset = behind + far;
        let mut plan = Self {
            duration: 0.0,
            grasp: scene.grasp,
            gripper_changes: Vec::new(),
            start_offset,
            moves: Vec::new(),
            detours: Vec::new(),
            yaws: Vec::new(),
            tilts: Vec::new(),
            tilt_detours: Vec::new(),
            tilt_axis: manner.tilt_axis,
            from_right_deg: manner.from_right_deg,
            drawn_back: manner.drawn_back,
            way: (scene.pour.y - scene.grasp.translation.y)
                .atan2(scene.pour.x - scene.grasp.translation.x),
            accident_secs: 0.0,
        };
        if rng.random_bool(0.12) {
            // Turning the open gripper over before the grasp is no pour.
            let duration = rng.random_range(2.6..3.6);
            let by = rng.random_range(80.0..100.0);
            plan.tilt_detours.push(Move { start: clock, duration, by });
            clock += duration + 0.1;
        }
        clock = plan.reach(clock, behind, -far, rng);
        clock += rng.random_range(0.25..0.6);
        let grasped = clock;
        plan.gripper_changes.push(grasped);

        // Lift and carry. The pour's start was drawn; lifting and carrying have to fit before it.
        let pause = manner.pause;
        let lift_start = grasped + pause;
        let time_to_pour = manner.pour_start - pause;
        let lift_secs = time_to_pour * rng.random_range(0.30..0.42);
        let up = Vector3::new(
            rng.random_range(-0.015..0.015),
            rng.random_range(-0.015..0.015),
            scene.lift,
        );
        plan.moves.push(Move { start: lift_start, duration: lift_secs, by: up });
        let carry_start = lift_start + lift_secs * rng.random_range(0.45..0.75);
        // Carrying ends about when pouring begins, often a little later.
        let carry_end = grasped + manner.pour_start - rng.random_range(-0.5..1.0);
        let carry_secs = (carry_end - carry_start).max(1.0);
        let to_pour = scene.pour - scene.grasp.translation.vector - up - manner.drawn_back;
        // The way is covered in one to three overlapping sub-movements over one or two points that
        // lie a little off the straight line.
        let parts = rng.random_range(1..=3_usize);
        let mut done = 0.0;
        for part in 0..parts {
            let share = if part + 1 == parts { 1.0 - done } else { (1.0 - done) * 0.5 };
            let at = done * 0.75 * carry_secs;
            let start = carry_start + at;
            let duration = if part + 1 == parts {
                carry_secs - at
            } else {
                (carry_secs - at) * rng.random_range(0.7..0.95)
            };
            plan.moves.push(Move { start, duration, by: to_pour * share });
            done += share;
        }
        for _ in 0..rng.random_range(0..=2) {
            let duration = carry_secs * rng.random_range(0.5..0.9);
            let start = carry_start + rng.random_range(0.0..1.0) * (carry_secs - duration);
            let by = direction(rng) * rng.random_range(0.004..0.022);
            plan.detours.push(Move { start, duration, by });
        }
        // The way bends, most often away from the body.
        let across = Vector3::new(-plan.way.sin(), plan.way.cos(), 0.0);
        let bend = to_pour.norm() * (0.06 * across.x.signum() + 0.08 * normal(rng));
        plan.detours.push(Move { start: carry_start, duration: carry_secs, by: across * bend });
        plan.yaws.push(Move { start: carry_start, duration: carry_secs, by: manner.yaw });

        // The pour.
        let poured = plan.pour(grasped + manner.pour_start, &manner, rng);
        let mut fallen = poured;
        if trap == Some(Reason::SeveralPours) {
            fallen = plan.pour_again(poured, &manner, rng);
        }
        plan.accident_secs = match trap {
            // While it still pours, or on the way back up.
            Some(Reason::Incomplete) => {
                let end = plan.tilts.last().map_or(poured, |fall| fall.start);
                end + rng.random_range(-0.3..0.3)
            }
            Some(Reason::TooShort) => rng.random_range(0.4..2.5),
            _ => rng.random_range(0.1..0.9) * fallen,
        };
        if trap == Some(Reason::Incomplete) && rng.random_bool(0.5) {
            plan.gripper_changes.push(plan.accident_secs);
        }

        // Put the cup back, somewhere near its place.
        let back_start = fallen - rng.random_range(0.2..0.9);
        let place = Vector3::new(
            rng.random_range(-0.05..0.05),
            rng.random_range(-0.05..0.05),
            rng.random_range(0.0..0.01),
        );
        let here = plan.offset(1e9);
        let above = Vector3::new(place.x, place.y, here.z);
        let back_secs = rng.random_range(1.8..2.8);
        plan.moves.push(Move { start: back_start, duration: back_secs, by: above - here });
        plan.yaws.push(Move { start: back_start, duration: back_secs, by: -manner.yaw });
        let tilt_left = plan.tilt_deg(1e9);
        plan.tilts.push(Move { start: fallen, duration: 1.0, by: -tilt_left });
        let down_start = back_start + 0.7 * back_secs;
        let down_secs = rng.random_range(1.0..1.6);
        plan.moves.push(Move { start: down_start, duration: down_secs, by: place - above });
        clock = down_start.max(back_start + 0.3 * back_secs) + down_secs;
        clock = clock.max(back_start + back_secs) + rng.random_range(0.2..0.5);
        if plan.gripper_changes.len() % 2 == 1 {
            plan.gripper_changes.push(clock);
        }
        clock += rng.random_range(0.2..0.5);
        let retreat_secs = rng.random_range(1.0..1.6);
        plan.moves.push(Move {
            start: clock,
            duration: retreat_secs,
            by: -approach * rng.random_range(0.08..0.13)
                + Vector3::z() * rng.random_range(0.0..0.05),
        });
        plan.duration = clock + retreat_secs + rng.random_range(0.4..1.2);
        plan
    }

    /// From behind the cup to the cup; returns when it is there.
    fn reach(
        &mut self,
        start: f64,
        behind: Vector3<f64>,
        near: Vector3<f64>,
        rng: &mut ChaCha8Rng,
    ) -> f64 {
        let first = Move { start, duration: rng.random_range(1.2..2.2), by: near };
        let second = Move {
            start: first.start + first.duration * rng.random_range(0.6..0.9),
            duration: rng.random_range(1.0..1.6),
            by: -behind,
        };
        self.moves.extend([first, second]);
        first.end().max(second.end())
    }

    /// Tilts and lets the tilt fall so that the cup pours from `start` for the manner's time;
    /// returns when the tilt has fallen.
    fn pour(&mut self, start: f64, manner: &Manner, rng: &mut ChaCha8Rng) -> f64 {
        let from = self.tilt_deg(1e9);
        let rise = Move {
            start: start - manner.rise_secs * manner.crossing(from),
            duration: manner.rise_secs,
            by: manner.maximum_tilt - from,
        };
        let left = rng.random_range(0.0..8.0_f64);
        let falls_by = manner.maximum_tilt - left;
        let until_crossing =
            minimum_jerk_inverse((manner.maximum_tilt - POUR_TILT_DEG).max(0.0) / falls_by);
        let fall = Move {
            start: start + manner.pour_duration - manner.fall_secs * until_crossing,
            duration: manner.fall_secs,
            by: -falls_by,
        };
        // Nobody holds an angle: it wavers by a degree.
        for _ in 0..2 {
            let duration = rng.random_range(0.5..1.0) * (fall.end() - rise.start) * 0.5;
            let start = rise.start + rng.random_range(0.2..1.0) * (fall.start - rise.start);
            self.tilt_detours.push(Move { start, duration, by: rng.random_range(-1.2..1.2) });
        }
        // The hand moves while it pours, most often onward from where it came.
        let turn = self.way + manner.stray;
        let length = rng.random_range(0.012..0.06);
        let along = Vector3::new(turn.cos(), turn.sin(), rng.random_range(-0.4..0.4));
        self.moves.push(Move {
            start: start - rng.random_range(0.0..0.3),
            duration: manner.pour_duration.max(0.8) + rng.random_range(0.0..0.5),
            by: along * length,
        });
        self.tilts.extend([rise, fall]);
        fall.end()
    }

    /// A second pour after the first: from a tilt that is left, after a pause elsewhere, or after
    /// putting the gripper off and on. Returns when its tilt has fallen.
    fn pour_again(&mut self, poured: f64, manner: &Manner, rng: &mut ChaCha8Rng) -> f64 {
        match rng.random_range(0..3) {
            0 => {
                // The first fall stops half-way.
                let from = self.tilt_deg(1e9);
                if let Some(fall) = self.tilts.last_mut() {
                    fall.by += rng.random_range(15.0..38.0) - from;
                }
            }
            1 => {
                let by =
                    Vector3::new(rng.random_range(-0.06..0.06), rng.random_range(-0.06..0.06), 0.0);
                self.moves.push(Move { start: poured, duration: 1.5, by });
            }
            _ => {
                let open = poured + rng.random_range(0.3..0.6);
                self.gripper_changes.extend([open, open + rng.random_range(0.6..1.0)]);
            }
        }
        // Each grasp has its own cup axis; what tilt is left counts for the second one.
        let pause = rng.random_range(1.4..2.4) + manner.rise_secs * manner.crossing(0.0);
        self.pour(poured + pause, manner, rng)
    }

    /// Where the hand is, from its position at the grasp.
    fn offset(&self, t: f64) -> Vector3<f64> {
        let moved: Vector3<f64> = self.moves.iter().map(|m| m.at(t)).sum();
        let detour: Vector3<f64> = self.detours.iter().map(|m| m.bump_at(t)).sum();
        let tilt = self.tilt_deg(t).to_radians();
        self.start_offset + moved + detour + self.drawn_back * tilt.sin()
    }

    /// Tilt of the cup against its axis at the grasp.
    fn tilt_deg(&self, t: f64) -> f64 {
        let tilt: f64 = self.tilts.iter().map(|m| m.at(t)).sum();
        let detour: f64 = self.tilt_detours.iter().map(|m| m.bump_at(t)).sum();
        tilt + detour
    }

    /// The hand in the base frame.
    fn pose(&self, t: f64) -> Isometry3<f64> {
        // Turning by phi about an axis with height z tilts the vertical by less than phi:
        // cos(tilt) = z^2 + (1 - z^2) cos(phi).
        let tilt = self.tilt_deg(t).to_radians();
        let z2 = self.tilt_axis.z.powi(2);
        let turn = ((tilt.cos() - z2) / (1.0 - z2)).clamp(-1.0, 1.0).acos().copysign(tilt);
        let yaw: f64 = self.yaws.iter().map(|m| m.at(t)).sum();
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw)
            * UnitQuaternion::from_axis_angle(&self.tilt_axis, turn)
            * self.grasp.rotation;
        Isometry3::from_parts(
            Translation3::from(self.grasp.translation.vector + self.offset(t)),
            rotation,
        )
    }

    /// The arm's joints at every frame; none where the arm can't make the motion.
    fn joints(&self, chain: &Chain, rng: &mut ChaCha8Rng) -> Option<Vec<Vec<f64>>> {
        let step_secs = FRAMES_PER_FOLLOWED_POINT as f64 / RATE_HZ;
        let points = (self.duration / step_secs).ceil() as usize + 1;
        let poses: Vec<_> = (0..points).map(|i| self.pose(i as f64 * step_secs)).collect();
        let followed = follow(chain, &poses, step_secs, &FollowOptions::default(), rng).ok()?;
        // A guided arm is no faster than a driven one.
        if followed.speed > 1.0 {
            return None;
        }
        let q = followed.positions;
        let frames = (points - 1) * FRAMES_PER_FOLLOWED_POINT;
        let frame = |frame: usize| {
            let i = frame / FRAMES_PER_FOLLOWED_POINT;
            let u = (frame % FRAMES_PER_FOLLOWED_POINT) as f64 / FRAMES_PER_FOLLOWED_POINT as f64;
            let at = |k: isize| &q[(i as isize + k).clamp(0, points as isize - 1) as usize];
            (0..chain.dof())
                .map(|j| catmull_rom([at(-1)[j], at(0)[j], at(1)[j], at(2)[j]], u))
                .collect()
        };
        Some((0..frames).map(frame).collect())
    }

    /// The files of this demonstration, with what goes wrong in them.
    fn raw(
        &self,
        assignment: &Assignment,
        mut joints: Vec<Vec<f64>>,
        rng: &mut ChaCha8Rng,
    ) -> RawDemonstration {
        let trap = assignment.trap;
        let accident = ((self.accident_secs * RATE_HZ) as usize).min(joints.len() - 2);
        let mut keep = joints.len();
        match trap {
            Some(Reason::Jump) => {
                let joint = rng.random_range(0..ARM_JOINTS.len());
                let by = rng.random_range(1.2..2.2) * if rng.random_bool(0.5) { 1.0 } else { -1.0 };
                let lasts =
                    if rng.random_bool(0.5) { joints.len() } else { rng.random_range(1..40) };
                for q in joints.iter_mut().skip(accident).take(lasts) {
                    q[joint] += by;
                }
            }
            Some(Reason::TooShort) => keep = accident,
            // Either the cup was dropped, or the recording ends here.
            Some(Reason::Incomplete) if self.gripper_changes.len() != 2 => keep = accident,
            Some(Reason::Incomplete) if self.gripper_changes[1] != self.accident_secs => {
                keep = accident;
            }
            _ => {}
        }
        if trap != Some(Reason::Jump) && rng.random_bool(0.1) {
            // A single encoder step of 2 to 4 rad/s, which is no reason to reject a recording.
            let frame = rng.random_range(0..joints.len());
            let joint = rng.random_range(0..ARM_JOINTS.len());
            joints[frame][joint] += rng.random_range(0.02..0.04);
        }
        joints.truncate(keep);
        let frames = joints.len();
        let mut other = other_arm(frames, rng);
        for arm in [&mut joints, &mut other] {
            add_noise(arm, rng);
        }
        let mirror = |arm: Vec<Vec<f64>>| -> Vec<Vec<f64>> {
            arm.iter().map(|q| mirrored_joints(q, &BAXTER_SIGNS)).collect()
        };
        let [left, right] =
            if assignment.right { [other, mirror(joints)] } else { [joints, mirror(other)] };
        let head = [rng.random_range(-0.3..0.3), 0.0, 0.0];
        let value = |name: &str, frame: usize| match name.split_once('_') {
            Some((side @ ("left" | "right"), joint)) => {
                let j = ARM_JOINTS.iter().position(|n| *n == joint).unwrap_or_default();
                if side == "left" { left[frame][j] } else { right[frame][j] }
            }
            _ => head[usize::from(name != "head_pan")],
        };
        let frames_out: Vec<[f64; 17]> =
            (0..frames).map(|frame| MIME_JOINTS.map(|name| value(name, frame))).collect();

        let pouring_gripper = self.gripper(trap, frames, rng);
        let other_gripper = idle_gripper(frames, rng);
        let [left_gripper, right_gripper] = if assignment.right {
            [other_gripper, pouring_gripper]
        } else {
            [pouring_gripper, other_gripper]
        };
        let stray_lines = (0..rng.random_range(0..=4))
            .map(|_| {
                let width = rng.random_range(0.0..0.0208);
                let line = if rng.random_bool(0.7) {
                    format!("{{\"l_gripper_l_finger_joint\": {width:.17}}}")
                } else {
                    format!("{width:.17}")
                };
                (rng.random_range(0..=frames), line)
            })
            .collect();
        let mut raw = RawDemonstration {
            id: assignment.id.clone(),
            frames: frames_out,
            left_gripper,
            right_gripper,
            stray_lines,
            cut_lines: Vec::new(),
            python_syntax: rng.random_bool(0.15),
        };
        raw.stray_lines.sort_by_key(|(frame, _)| *frame);
        if trap == Some(Reason::Unreadable) {
            match rng.random_range(0..2) {
                0 => raw.cut_lines = (0..frames).filter(|_| rng.random_bool(0.1)).collect(),
                _ if assignment.right => raw.right_gripper.clear(),
                _ => raw.left_gripper.clear(),
            }
        }
        raw
    }

    /// Per cent open of the gripper that grasps, in a number of lines that is not that of frames.
    fn gripper(&self, trap: Option<Reason>, frames: usize, rng: &mut ChaCha8Rng) -> Vec<f64> {
        let open = rng.random_range(92.0..100.0_f64);
        let closed = if trap == Some(Reason::NoGrasp) {
            // It never closes on anything.
            rng.random_range(75.0..open)
        } else {
            rng.random_range(1.0..14.0)
        };
        let at = |t: f64| {
            let changes = self.gripper_changes.iter().filter(|&&change| change <= t).count();
            if changes % 2 == 1 { closed } else { open }
        };
        other_length(frames, rng).map(|frame| at(frame / RATE_HZ)).collect()
    }

    /// What the demonstration holds, read off the plan every millisecond.
    fn truth(&self, assignment: &Assignment) -> Truth {
        const STEP_SECS: f64 = 1e-3;
        let mut truth = Truth {
            id: assignment.id.clone(),
            expected: assignment.trap.map_or_else(|| "accept".into(), |r| r.to_string()),
            arm: if assignment.right { "right" } else { "left" }.into(),
            task: BTreeMap::new(),
            factors: BTreeMap::new(),
        };
        if assignment.trap.is_some() {
            return truth;
        }
        let grasped = self.gripper_changes[0];
        let (mut sum, mut samples) = (Vector3::zeros(), 0_u32);
        let (mut first, mut last, mut maximum) = (f64::NAN, f64::NAN, 0.0_f64);
        let mut t = grasped;
        while t < self.duration {
            let tilt = self.tilt_deg(t);
            maximum = maximum.max(tilt);
            if tilt > POUR_TILT_DEG {
                if samples == 0 {
                    first = t;
                }
                last = t;
                sum += self.pose(t).translation.vector;
                samples += 1;
            } else if samples > 0 && tilt < END_TILT_DEG {
                break;
            }
            t += STEP_SECS;
        }
        let mean = sum / f64::from(samples);
        let Isometry3 { translation, rotation } = self.pose(grasped);
        let source = translation.vector;
        let from_right = self.from_right_deg;
        let to_the_right = is_to_the_right(&(mean - source), &rotation);
        let style = if to_the_right { from_right } else { 180.0 - from_right };
        truth.task.insert("pour_location".into(), [mean.x, mean.y]);
        truth.task.insert("source_cup".into(), [source.x, source.y]);
        for (name, value) in [
            ("grasp", grasped),
            ("pour_start", first - grasped),
            ("pour_end", last - grasped),
            ("pour_duration", f64::from(samples) * STEP_SECS),
            ("maximum_tilt", maximum),
            ("duration", t - grasped),
            ("lift", mean.z - source.z),
            ("style", style),
        ] {
            truth.factors.insert(name.into(), value);
        }
        truth
    }
}

/// Where the cups stand and how the hand grasps.
struct Scene {
    grasp: Isometry3<f64>,
    /// Where the hand begins to pour.
    pour: Vector3<f64>,
    lift: f64,
    /// How far the pour is from the source, in standard deviations.
    far: f64,
}

impl Scene {
    fn draw(correlation: f64, trap: Option<Reason>, rng: &mut ChaCha8Rng) -> Self {
        let place = |rng: &mut ChaCha8Rng| -> Vector3<f64> {
            Vector3::new(rng.random_range(0.5..0.85), rng.random_range(-0.05..0.6), 0.0)
        };
        let (source, pour) = loop {
            let source = place(rng);
            let mut pour = place(rng);
            if trap == Some(Reason::OutOfRegion) {
                // Across the robot, where the other arm should have poured.
                pour.y = rng.random_range(-0.42..-0.30);
                if source.y > 0.15 {
                    continue;
                }
                break (source, pour);
            }
            if (0.2..0.4).contains(&(pour - source).norm()) {
                break (source, pour);
            }
        };
        let far = ((pour - source).norm() - 0.3) / 0.058;
        let height = rng.random_range(-0.10..0.05);
        let tied = correlation * 0.6;
        let lift = loop {
            let lift = 0.16 + 0.035 * (tied * far + (1.0 - tied * tied).sqrt() * normal(rng));
            if (0.10..0.22).contains(&lift) {
                break lift;
            }
        };
        // The hand comes from the shoulder, more or less.
        let from_shoulder = source - Vector3::new(0.1, 0.25, 0.0);
        let natural = from_shoulder.y.atan2(from_shoulder.x).to_degrees() * 0.8 - 20.0;
        let azimuth = loop {
            let azimuth = if correlation > 0.0 {
                natural + 14.0 * normal(rng)
            } else {
                rng.random_range(-60.0..20.0)
            };
            if (-60.0..20.0).contains(&azimuth) {
                break azimuth;
            }
        };
        let pitch = rng.random_range(0.0..25.0_f64);
        let roll = rng.random_range(-8.0..8.0_f64);
        // Upright: the gripper's x up, its z forward.
        let upright = UnitQuaternion::from_euler_angles(
            0.0,
            -std::f64::consts::FRAC_PI_2,
            std::f64::consts::PI,
        );
        let rotation = UnitQuaternion::from_euler_angles(
            roll.to_radians(),
            pitch.to_radians(),
            f64::to_radians(azimuth),
        ) * upright;
        let grasp = Isometry3::from_parts(Translation3::new(source.x, source.y, height), rotation);
        let pour = Vector3::new(pour.x, pour.y, height + lift);
        Self { grasp, pour, lift, far }
    }
}

/// How the person pours.
struct Manner {
    /// From the grasp to the lift, s.
    pause: f64,
    /// From the grasp to the pour, s.
    pour_start: f64,
    pour_duration: f64,
    maximum_tilt: f64,
    rise_secs: f64,
    fall_secs: f64,
    from_right_deg: f64,
    tilt_axis: UnitVector3<f64>,
    /// See [`Plan::drawn_back`].
    drawn_back: Vector3<f64>,
    /// Direction of the hand's motion while it pours, from that of the way before it, rad.
    stray: f64,
    /// Turn of the hand about the vertical while carrying, rad.
    yaw: f64,
}

impl Manner {
    fn draw(
        simulation: &PourSimulation,
        trap: Option<Reason>,
        scene: &Scene,
        rng: &mut ChaCha8Rng,
    ) -> Self {
        let PourSimulation { correlation, both_sides, .. } = *simulation;
        let tied = correlation * 0.6;
        let from_roll = match rng.random_range(0.0..1.0) {
            u if u < 0.6 => rng.random_range(0.0..12.0),
            u if u < 0.9 => rng.random_range(20.0..50.0),
            _ => rng.random_range(65.0..90.0_f64),
        };
        let hand = scene.grasp.rotation;
        let (roll, pitch) = (hand * Vector3::z(), -(hand * Vector3::y()));
        // People mostly lean a cup to the side to which they carry it.
        let way = scene.pour - scene.grasp.translation.vector;
        let to_the_right = match both_sides {
            true => is_to_the_right(&way, &hand) == rng.random_bool(0.5 + 0.5 * correlation),
            false => true,
        };
        let from_right_deg = if to_the_right { from_roll } else { 180.0 - from_roll };
        let from_right = from_right_deg.to_radians();
        let tilt_axis =
            UnitVector3::new_normalize(roll * from_right.cos() + pitch * from_right.sin());
        // The spout is some centimetres above the hand, and leans to where the tilt's axis says.
        let leans = tilt_axis.cross(&Vector3::z()).normalize();
        let drawn_back = -leans * rng.random_range(0.02..0.07);
        let stray = if correlation > 0.0 {
            0.9 * normal(rng)
        } else {
            rng.random_range(0.0..std::f64::consts::TAU)
        };
        let yaw = (6.0 * normal(rng)).clamp(-14.0, 14.0).to_radians();
        loop {
            let z = normal(rng);
            let other = normal(rng);
            let mut maximum_tilt = 90.0 + 8.0 * z;
            let spread = correlation * z + (1.0 - correlation * correlation).sqrt() * other;
            let pour_duration = 2.5 * (0.35 * spread).exp();
            let late = tied * scene.far + (1.0 - tied * tied).sqrt() * normal(rng);
            let pour_start = 4.3 + 0.8 * late;
            let mut rise_secs = (4.5 + 0.9 * normal(rng)).clamp(3.0, 6.0);
            let mut fall_secs = rng.random_range(2.5..3.7);
            let pause = rng.random_range(0.3..0.9);
            if !(74.0..115.0).contains(&maximum_tilt)
                || !(1.2..6.0).contains(&pour_duration)
                || !(2.8..7.0).contains(&pour_start)
            {
                continue;
            }
            if trap == Some(Reason::NoPour) {
                maximum_tilt = rng.random_range(35.0..64.0);
            }
            // The tilt begins after the lift; a short pour has fast ramps.
            let crossing = minimum_jerk_inverse((POUR_TILT_DEG / maximum_tilt).min(1.0));
            rise_secs = rise_secs.min((pour_start - pause - 0.2) / crossing);
            let faster = ((pour_duration - 0.05) / ((1.0 - crossing) * (rise_secs + fall_secs)))
                .clamp(0.0, 1.0);
            if trap != Some(Reason::NoPour) {
                rise_secs *= faster;
                fall_secs *= faster;
            }
            if rise_secs < 1.4 || fall_secs < 1.2 {
                continue;
            }
            return Self {
                pause,
                pour_start,
                pour_duration,
                maximum_tilt,
                rise_secs,
                fall_secs,
                from_right_deg,
                tilt_axis,
                drawn_back,
                stray,
                yaw,
            };
        }
    }

    /// The share of the rise's time, from a tilt that is left, after which the cup pours.
    fn crossing(&self, from: f64) -> f64 {
        minimum_jerk_inverse(((POUR_TILT_DEG - from) / (self.maximum_tilt - from)).min(1.0))
    }
}

/// Whether a way over the ground goes to the right of where the hand points.
fn is_to_the_right(way: &Vector3<f64>, hand: &UnitQuaternion<f64>) -> bool {
    way.dot(&(hand * Vector3::z()).cross(&Vector3::z())) > 0.0
}

/// The arm that doesn't pour: it hangs where it was left, and drifts.
fn other_arm(frames: usize, rng: &mut ChaCha8Rng) -> Vec<Vec<f64>> {
    const REST: [f64; 7] = [0.1, -0.55, 0.0, 0.75, 0.0, 1.26, 0.0];
    // The limits of Baxter's joints nearest to where some of MIME's angles lie beyond them.
    const LIMITS: [(usize, f64, f64); 5] =
        [(0, -1.7017, -1.0), (1, 1.047, 1.0), (3, -0.05, -1.0), (5, 2.094, 1.0), (6, -3.059, -1.0)];
    let mut rest = REST.map(|q| q + 0.25 * normal(rng));
    if rng.random_bool(0.25) {
        let (joint, limit, side) = LIMITS[rng.random_range(0..LIMITS.len())];
        rest[joint] = limit + side * rng.random_range(0.02..0.17);
    }
    let drift = rest.map(|_| {
        let rate = rng.random_range(0.1..0.5);
        let phase = rng.random_range(0.0..std::f64::consts::TAU);
        (0.02 * normal(rng), rate, phase, 0.002 * normal(rng))
    });
    let frame = |i: usize| {
        let t = i as f64 / RATE_HZ;
        let drifted = |(q, (size, rate, phase, slope)): (&f64, &(f64, f64, f64, f64))| {
            q + size * (rate * t + phase).sin() + slope * t
        };
        rest.iter().zip(&drift).map(drifted).collect()
    };
    (0..frames).map(frame).collect()
}

/// The gripper of the arm that doesn't pour: open, closed all the time, or holding the bowl.
fn idle_gripper(frames: usize, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let (open, closed) = (rng.random_range(92.0..100.0), rng.random_range(0.0..10.0));
    let closes_at = match rng.random_range(0..4) {
        0 => 0.0,
        1 => rng.random_range(0.1..0.5) * frames as f64,
        _ => f64::INFINITY,
    };
    other_length(frames, rng).map(|frame| if frame >= closes_at { closed } else { open }).collect()
}

/// The frames (with fractions) at which a gripper's file has its lines: as many as frames, and up
/// to 3 % more or fewer.
fn other_length(frames: usize, rng: &mut ChaCha8Rng) -> impl Iterator<Item = f64> + use<> {
    let sign = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
    let lines = (frames as f64 * (1.0 + sign * rng.random_range(0.01..0.03))).round() as usize;
    let lines = lines.max(2);
    let scale = (frames.max(2) - 1) as f64 / (lines - 1) as f64;
    (0..lines).map(move |i| i as f64 * scale)
}

/// Adds the noise of encoders and of a guiding hand: 0.3 mrad, mostly below 6 Hz.
fn add_noise(joints: &mut [Vec<f64>], rng: &mut ChaCha8Rng) {
    const STDDEV_RAD: f64 = 3e-4;
    const CORNER_HZ: f64 = 6.0;
    let keep = (-std::f64::consts::TAU * CORNER_HZ / RATE_HZ).exp();
    let add = STDDEV_RAD * (1.0 - keep * keep).sqrt();
    let mut noise = [0.0; 7].map(|_: f64| STDDEV_RAD * normal(rng));
    for q in joints {
        for (q, noise) in q.iter_mut().zip(&mut noise) {
            *noise = keep * *noise + add * normal(rng);
            *q += *noise;
        }
    }
}

/// The value at `u` between the second and the third of four equally spaced points.
fn catmull_rom([p0, p1, p2, p3]: [f64; 4], u: f64) -> f64 {
    let [a, b] = [0.5 * (p2 - p0), 0.5 * (p3 - p1)];
    let (u2, u3) = (u * u, u * u * u);
    p1 * (2.0 * u3 - 3.0 * u2 + 1.0)
        + a * (u3 - 2.0 * u2 + u)
        + p2 * (3.0 * u2 - 2.0 * u3)
        + b * (u3 - u2)
}

fn normal(rng: &mut (impl Rng + ?Sized)) -> f64 {
    StandardNormal.sample(rng)
}

/// A direction, every one as likely.
fn direction(rng: &mut (impl Rng + ?Sized)) -> Vector3<f64> {
    Vector3::new(normal(rng), normal(rng), normal(rng)).normalize()
}
