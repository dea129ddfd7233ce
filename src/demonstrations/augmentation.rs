//! More demonstrations from few: the same actions elsewhere.
//!
//! As the paper does (section 5.2), a copy's action is shifted by up to 5 cm while its start stays,
//! the weights of its dynamic movement primitive are perturbed a little, and the whole is turned
//! about the vertical and moved. Its task parameters move along: they are those of the copy's own
//! motion. What is kept is still a valid motion inside the region of the demonstrations.
//!
//! Ours on top, not in the paper: a copy is also a little longer or shorter, higher or lower, and
//! tilted more or less. Copies of one demonstration that share its manner teach a recognition network
//! to tell demonstrations apart, instead of what they do.

use std::collections::VecDeque;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};

use super::manipulation::{Action, ManipulationTask};
use super::task::{Task, TaskSettingError};
use super::{Demonstration, Splits};
use crate::alignment::{Alignment, segment_secs};
use crate::parameters::{Interval, TaskParameters};
use crate::primitives::dmp::{DmpConfig, PoseDmp};
use crate::trajectory::Motion;

/// How demonstrations are multiplied.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Augmentation {
    /// Copies to train on, spread evenly over the demonstrations, which stay beside them.
    pub train_copies: usize,
    /// Copies to validate on, likewise.
    pub validation_copies: usize,
    /// Largest turn about the vertical.
    pub max_turn_deg: f64,
    /// Largest move along x and along y.
    pub max_move_m: f64,
    /// Largest shift of the action, and of the end, against the start.
    pub max_shift_m: f64,
    /// Standard deviation of the noise on the weights of a demonstration's dynamic movement
    /// primitive, as a share of each. 0.004 moves the tip by about 3 mm and turns it by 2 degrees,
    /// as neighbouring weights are large and nearly cancel.
    pub weight_noise: f64,
    /// Ours: largest change of the times before, during and after the action, as a share of each.
    pub max_stretch: f64,
    /// Ours: largest change of the turn from the start, as a share.
    pub max_turn_change: f64,
    /// Ours: largest change of the height above the start, as a share.
    pub max_lift_change: f64,
    /// Ours: largest move up or down of the whole.
    pub max_rise_m: f64,
    /// How far task parameters may leave the box around the demonstrated ones.
    pub region_margin_m: f64,
    /// Tries for each copy; a demonstration that fails all of them is copied no more.
    pub tries: usize,
}

impl Default for Augmentation {
    /// The paper's numbers (table 1): 124 + 6652 demonstrations to train on, 42 + 462 to validate on.
    fn default() -> Self {
        Self {
            train_copies: 6652,
            validation_copies: 462,
            max_turn_deg: 30.0,
            max_move_m: 0.15,
            max_shift_m: 0.05,
            weight_noise: 0.004,
            max_stretch: 0.15,
            max_turn_change: 0.08,
            max_lift_change: 0.2,
            max_rise_m: 0.05,
            region_margin_m: 0.0,
            tries: 50,
        }
    }
}

/// What augmentation did.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct AugmentationReport {
    /// Copies that were made.
    pub made: usize,
    /// Copies that are missing, as no demonstration could be copied any more.
    pub failed: usize,
    /// Tries that were no valid motions, or outside the region.
    pub rejected: usize,
}

impl Augmentation {
    /// The paper's, which keeps the manner of each demonstration.
    pub fn paper() -> Self {
        let (max_stretch, max_turn_change, max_lift_change, max_rise_m) = (0.0, 0.0, 0.0, 0.0);
        Self { max_stretch, max_turn_change, max_lift_change, max_rise_m, ..Self::default() }
    }

    /// Checks what no type can say.
    ///
    /// # Errors
    /// The first setting that can't be.
    pub fn check(&self) -> Result<(), TaskSettingError> {
        let any = |name, value: f64| (name, value, f64::MAX, "finite and not negative");
        let share = |name, value: f64| (name, value, 0.9, "from 0 to 0.9");
        for (name, value, limit, expected) in [
            any("augmentation.max_turn_deg", self.max_turn_deg),
            any("augmentation.max_move_m", self.max_move_m),
            any("augmentation.max_shift_m", self.max_shift_m),
            any("augmentation.max_rise_m", self.max_rise_m),
            any("augmentation.region_margin_m", self.region_margin_m),
            share("augmentation.weight_noise", self.weight_noise),
            share("augmentation.max_stretch", self.max_stretch),
            share("augmentation.max_turn_change", self.max_turn_change),
            share("augmentation.max_lift_change", self.max_lift_change),
        ] {
            // Also false for what is not a number.
            if !(0.0..=limit).contains(&value) {
                return Err(TaskSettingError { name, value: value.to_string(), expected });
            }
        }
        Ok(())
    }

    /// Adds copies to what is trained and validated on; what is tested on stays as it was
    /// recorded. `fits` may refuse a copy, for instance one that the arm can't make.
    pub fn augment<R: Rng + ?Sized>(
        &self,
        task: &ManipulationTask,
        splits: &mut Splits,
        mut fits: impl FnMut(&Motion, &mut R) -> bool,
        rng: &mut R,
    ) -> AugmentationReport {
        let mut report = AugmentationReport::default();
        // Nothing of what is tested on goes into the region.
        let region = region(splits.train.iter().chain(&splits.validation), self.region_margin_m);
        let Splits { train, validation, test: _ } = splits;
        for (part, copies) in [(train, self.train_copies), (validation, self.validation_copies)] {
            if part.is_empty() {
                continue;
            }
            let mut made = Vec::with_capacity(copies);
            // In turns, so that all have as many; one that can't be copied leaves its turns to others.
            let mut turns: VecDeque<_> = part.iter().map(|d| (Original::new(task, d), 1)).collect();
            while made.len() < copies
                && let Some((original, number)) = turns.pop_front()
            {
                let found = (0..self.tries).find_map(|_| {
                    let copy = self.copy(&original, number, rng);
                    let inside = |c: &Demonstration| {
                        region.iter().zip(c.w.values()).all(|(r, v)| r.contains(*v))
                    };
                    let copy = copy.filter(inside).filter(|c| fits(&c.motion, rng));
                    report.rejected += usize::from(copy.is_none());
                    copy
                });
                if let Some(copy) = found {
                    made.push(copy);
                    turns.push_back((original, number + 1));
                }
            }
            report.failed += copies - made.len();
            report.made += made.len();
            part.extend(made);
        }
        report
    }

    /// One random copy; none where it is no valid motion.
    fn copy<R: Rng + ?Sized>(
        &self,
        original: &Original<'_>,
        number: usize,
        rng: &mut R,
    ) -> Option<Demonstration> {
        let Original { task, demonstration, broken, off, .. } = original;
        let symmetric = |limit: f64, rng: &mut R| limit * (2.0 * rng.random::<f64>() - 1.0);
        let turn = symmetric(self.max_turn_deg.to_radians(), rng);
        let by = Vector3::new(
            symmetric(self.max_move_m, rng),
            symmetric(self.max_move_m, rng),
            symmetric(self.max_rise_m, rng),
        );
        // Uniform over the disc.
        let angle = symmetric(std::f64::consts::PI, rng);
        let radius = self.max_shift_m * rng.random::<f64>().sqrt();
        let shift = Vector3::new(radius * angle.cos(), radius * angle.sin(), 0.0);

        let motion = original.perturbed(self.weight_noise, rng);
        let more = |limit: f64, rng: &mut R| 1.0 + symmetric(limit, rng);
        let (turn_by, lift_by) = (more(self.max_turn_change, rng), more(self.max_lift_change, rng));
        let stretch = [0; 3].map(|_| more(self.max_stretch, rng));
        let motion = stretched(task, &scaled(task, &motion, turn_by, lift_by), &stretch)?;
        let motion = moved(task, &shifted(task, &motion, shift)?, turn, by);
        let measured = task.empirical_task(&motion).ok()?;
        let copied = Demonstration {
            id: format!("{}+{number}", demonstration.id),
            w: off.added(task, &measured, turn)?,
            events: task.events(&motion),
            motion,
        };
        // A demonstration of a manner beyond the bounds stays what it is; its copies may not break
        // what it kept.
        let kept = task.violations(&copied.motion).into_iter().all(|v| broken.contains(&v.bound));
        kept.then_some(copied)
    }
}

/// A demonstration that is copied, with what all of its copies need.
struct Original<'a> {
    task: &'a ManipulationTask,
    demonstration: &'a Demonstration,
    /// Bounds of validity that it breaks itself.
    broken: Vec<&'static str>,
    /// How far its task parameters are from what its motion shows.
    off: Offsets,
    poses: Vec<Isometry3<f64>>,
    dmp: PoseDmp,
    /// The motion as the primitive repeats it.
    repeated: Vec<Isometry3<f64>>,
}

impl<'a> Original<'a> {
    fn new(task: &'a ManipulationTask, demonstration: &'a Demonstration) -> Self {
        let motion = &demonstration.motion;
        let poses = task.state_frame().poses(&motion.states);
        let dmp = PoseDmp::fit(&DmpConfig::default(), &poses)
            .expect("a motion has states enough for a primitive");
        let repeated = dmp.rollout(&dmp.start(), &dmp.goal(), poses.len());
        let broken = task.violations(motion).into_iter().map(|v| v.bound).collect();
        let off = Offsets::new(task, demonstration);
        Self { task, demonstration, broken, off, poses, dmp, repeated }
    }

    /// The motion, changed by what noise on the primitive's weights changes in its rollout; what the
    /// primitive does not capture of the motion stays.
    fn perturbed<R: Rng + ?Sized>(&self, noise: f64, rng: &mut R) -> Motion {
        let dmp = self.dmp.perturbed(noise, rng);
        let other = dmp.rollout(&dmp.start(), &dmp.goal(), self.poses.len());
        let changed = self.poses.iter().zip(&self.repeated).zip(&other).map(|((pose, a), b)| {
            let by = b.translation.vector - a.translation.vector;
            let turn = b.rotation * a.rotation.inverse();
            Isometry3::from_parts((pose.translation.vector + by).into(), turn * pose.rotation)
        });
        let states = self.task.state_frame().trajectory(&changed.collect::<Vec<_>>());
        Motion { states, duration_secs: self.demonstration.motion.duration_secs }
    }
}

/// How far the locations of a demonstration are from where its motion shows them: not at all, but where
/// a topic told them.
struct Offsets(Vec<[f64; 2]>);

impl Offsets {
    fn new(task: &ManipulationTask, demonstration: &Demonstration) -> Self {
        let Ok(measured) = task.empirical_task(&demonstration.motion) else {
            return Self(Vec::new());
        };
        let pairs = demonstration.w.values().chunks(2).zip(measured.values().chunks(2));
        Self(pairs.map(|(told, shown)| [told[0] - shown[0], told[1] - shown[1]]).collect())
    }

    /// The task parameters of a copy that shows these ones, after a turn about the vertical.
    fn added(
        &self,
        task: &ManipulationTask,
        measured: &TaskParameters,
        turn_rad: f64,
    ) -> Option<TaskParameters> {
        let (sin, cos) = turn_rad.sin_cos();
        let shown = measured.values().chunks(2).zip(&self.0);
        let told = shown
            .flat_map(|(at, [x, y])| [at[0] + (cos * x - sin * y), at[1] + (sin * x + cos * y)]);
        TaskParameters::new(&task.task_space(), told.collect()).ok()
    }
}

/// The motion with every turn from the start, and every height above it, times a factor. Heights are
/// those above the straight way from the first state to where the object is put down, or above the first
/// state where it is not put down.
pub fn scaled(task: &ManipulationTask, motion: &Motion, turn_by: f64, lift_by: f64) -> Motion {
    let frame = task.state_frame();
    let poses = frame.poses(&motion.states);
    let start = poses[0];
    let last = (poses.len() - 1) as f64;
    let rise = match task.action {
        Action::Tilt { .. } => 0.0,
        Action::Carry { .. } => poses[poses.len() - 1].translation.z - start.translation.z,
    };
    let scaled = |(i, pose): (usize, &Isometry3<f64>)| {
        let mut position = pose.translation;
        let ground = start.translation.z + rise * (i as f64 / last);
        position.z = ground + lift_by * (position.z - ground);
        let turn = (pose.rotation * start.rotation.inverse()).scaled_axis();
        let turn = UnitQuaternion::from_scaled_axis(turn * turn_by);
        Isometry3::from_parts(position, turn * start.rotation)
    };
    let poses: Vec<_> = poses.iter().enumerate().map(scaled).collect();
    Motion { states: frame.trajectory(&poses), duration_secs: motion.duration_secs }
}

/// The motion with the times between its events times factors, of which there is one more than
/// events. None for a motion without the action.
pub fn stretched(task: &ManipulationTask, motion: &Motion, factors: &[f64]) -> Option<Motion> {
    let events = task.events(motion);
    if events.len() + 1 != factors.len() {
        return None;
    }
    let before = segment_secs(motion, &events);
    let after: Vec<f64> = before.iter().zip(factors).map(|(secs, by)| secs * by).collect();
    let (steps, from, to) =
        (motion.states.steps(), Alignment::of_events(&events), Alignment::new(&after));
    let times = (0..steps).map(|i| from.time(to.phase(i as f64 / (steps - 1) as f64)));
    Some(Motion { states: motion.states.at(times), duration_secs: after.iter().sum() })
}

/// The motion turned about the vertical through its start, then moved.
pub fn moved(task: &ManipulationTask, motion: &Motion, turn_rad: f64, by: Vector3<f64>) -> Motion {
    let frame = task.state_frame();
    let poses = frame.poses(&motion.states);
    let start = Translation3::from(poses[0].translation.vector);
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn_rad);
    let transform = Translation3::from(by) * start * turn * start.inverse();
    let poses: Vec<Isometry3<f64>> = poses.iter().map(|pose| transform * pose).collect();
    Motion { states: frame.trajectory(&poses), duration_secs: motion.duration_secs }
}

/// The motion with its action shifted and its start in place: between them the shift grows along a
/// minimum-jerk profile, until the object is tilted, or has arrived. None for a motion without the
/// action.
pub fn shifted(task: &ManipulationTask, motion: &Motion, shift: Vector3<f64>) -> Option<Motion> {
    let action = task.action_steps(motion)?;
    let there = match task.action {
        Action::Tilt { .. } => action[0],
        Action::Carry { .. } => action[1],
    };
    // Complete in the last state before, so that all of the action is shifted alike.
    let there = there.floor().max(1.0);
    let mut states = motion.states.clone();
    let mut values = states.values().to_vec();
    for (t, state) in values.chunks_exact_mut(states.dim()).enumerate() {
        let u = (t as f64 / there).min(1.0);
        let share = u * u * u * (10.0 + u * (6.0 * u - 15.0));
        state[..3].iter_mut().zip(shift.iter()).for_each(|(v, s)| *v += share * s);
    }
    states = crate::trajectory::Trajectory::new(states.dim(), values).ok()?;
    Some(Motion { states, duration_secs: motion.duration_secs })
}

/// The box around task parameters, widened.
fn region<'a>(
    demonstrations: impl Iterator<Item = &'a Demonstration>,
    margin: f64,
) -> Vec<Interval> {
    let mut region: Vec<Interval> = Vec::new();
    for demonstration in demonstrations {
        let values = demonstration.w.values();
        region.resize(values.len(), Interval { lower: f64::INFINITY, upper: f64::NEG_INFINITY });
        for (interval, value) in region.iter_mut().zip(values) {
            interval.lower = interval.lower.min(value - margin);
            interval.upper = interval.upper.max(value + margin);
        }
    }
    region
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::demonstrations::manipulation::tests::{one_pour, one_stack, rolled, stacking};
    use crate::demonstrations::pouring;
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;

    fn demonstrations(count: usize) -> Vec<Demonstration> {
        let task = pouring::task();
        let one = |i: usize| {
            let motion = rolled(&one_pour(80.0 + i as f64), 0.1);
            let (turn, by) = (0.1 * i as f64, Vector3::new(0.02 * i as f64, 0.3, 0.0));
            let motion = moved(&task, &motion, turn, by);
            let w = task.empirical_task(&motion).unwrap();
            let events = task.events(&motion);
            Demonstration { id: i.to_string(), w, motion, events }
        };
        (0..count).map(one).collect()
    }

    proptest! {
        #[test]
        fn the_task_moves_with_the_motion_and_the_manner_stays(
            turn in -3.0..3.0f64, x in -0.5..0.5f64, y in -0.5..0.5f64,
        ) {
            let task = pouring::task();
            let before = rolled(&one_pour(90.0), 0.1);
            let after = moved(&task, &before, turn, Vector3::new(x, y, 0.0));
            let [a, b] = [&before, &after].map(|m| task.empirical_task(m).unwrap());
            let [pour, source] = [0, 1].map(|i| Vector3::new(a.location(i)[0], a.location(i)[1], 0.0));
            let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn);
            let expected = rotation * (pour - source) + source;
            for (value, expected) in
                b.values().iter().zip([expected.x + x, expected.y + y, source.x + x, source.y + y])
            {
                prop_assert!((value - expected).abs() < 1e-9);
            }
            for (a, b) in task.factors(&before).iter().zip(&task.factors(&after)) {
                // The hand turns along.
                let turned = if a.name == "heading" { turn.to_degrees() } else { 0.0 };
                let off = (b.value - a.value - turned + 180.0).rem_euclid(360.0) - 180.0;
                prop_assert!(off.abs() < 1e-9, "{:?} {:?}", a, b);
            }
        }

        #[test]
        fn a_stretch_changes_the_times_alone(
            before in 0.8..1.2f64, during in 0.8..1.2f64, after in 0.8..1.2f64,
        ) {
            let task = pouring::task();
            let motion = rolled(&one_pour(90.0), 0.1);
            let other = stretched(&task, &motion, &[before, during, after]).unwrap();
            let [a, b] = [&motion, &other].map(|m| task.factors(m));
            let by = [before, during, 1.0, f64::NAN, 1.0, 1.0, 1.0, 1.0];
            for ((a, b), by) in a.iter().zip(&b).zip(by) {
                let limit = if a.unit == "s" { 0.05 } else { 0.01 + 0.005 * a.value.abs() };
                prop_assert!(by.is_nan() || (b.value - by * a.value).abs() < limit, "{:?} {:?}", a, b);
            }
            let [a, b] = [&motion, &other].map(|m| task.empirical_task(m).unwrap());
            for (a, b) in a.values().iter().zip(b.values()) {
                prop_assert!((a - b).abs() < 2e-3, "{} {}", a, b);
            }
        }

        #[test]
        fn scaling_changes_tilt_and_lift_alone(turn_by in 0.9..1.1f64, lift_by in 0.8..1.2f64) {
            let task = pouring::task();
            let motion = rolled(&one_pour(90.0), 0.1);
            let other = scaled(&task, &motion, turn_by, lift_by);
            let of = |motion: &Motion, name: &str| {
                task.factors(motion).into_iter().find(|f| f.name == name).unwrap().value
            };
            let near = |name: &str, by: f64| {
                (of(&other, name) - by * of(&motion, name)).abs() < 1e-9
            };
            prop_assert!(near("maximum_tilt", turn_by) && near("lift", lift_by));
            prop_assert!(near("duration", 1.0) && near("heading", 1.0));
        }

        #[test]
        fn a_shift_moves_the_pour_and_keeps_the_grasp(x in -0.05..0.05f64, y in -0.05..0.05f64) {
            let task = pouring::task();
            let before = rolled(&one_pour(90.0), 0.1);
            let after = shifted(&task, &before, Vector3::new(x, y, 0.0)).unwrap();
            prop_assert_eq!(before.states.state(0), after.states.state(0));
            let [a, b] = [&before, &after].map(|m| task.empirical_task(m).unwrap());
            prop_assert!((b.values()[0] - a.values()[0] - x).abs() < 1e-9);
            prop_assert!((b.values()[1] - a.values()[1] - y).abs() < 1e-9);
        }
    }

    #[test]
    fn a_stack_elsewhere_keeps_its_start_and_the_height_of_its_end() {
        let (task, motion) = (stacking(), one_stack());
        let ends = |motion: &Motion| {
            let poses = task.state_frame().poses(&motion.states);
            [0, poses.len() - 1].map(|i| poses[i].translation.vector)
        };
        let shift = Vector3::new(0.03, -0.02, 0.0);
        let [start, end] = ends(&motion);
        let [after_start, after_end] = ends(&shifted(&task, &motion, shift).unwrap());
        assert!((after_start - start).norm() < 1e-12 && (after_end - end - shift).norm() < 1e-12);
        let higher = scaled(&task, &motion, 1.0, 1.2);
        let [after_start, after_end] = ends(&higher);
        assert!((after_start - start).norm() < 1e-12 && (after_end - end).norm() < 1e-12);
        let lift = |motion: &Motion| task.factors(motion)[3].value;
        assert!(lift(&higher) > 1.1 * lift(&motion), "{} {}", lift(&higher), lift(&motion));
        assert!(stretched(&task, &motion, &[1.1, 0.9, 1.0]).is_some());
    }

    #[test]
    fn a_copy_of_what_a_topic_told_is_as_far_from_it() {
        let task = pouring::task();
        let mut demonstration = demonstrations(1).remove(0);
        let told: Vec<f64> = demonstration
            .w
            .values()
            .iter()
            .zip([0.02, -0.01, 0.0, 0.0])
            .map(|(w, by)| w + by)
            .collect();
        demonstration.w = TaskParameters::new(&task.task_space(), told).unwrap();
        let off = Offsets::new(&task, &demonstration);
        let turn = 0.5;
        let copy = moved(&task, &demonstration.motion, turn, Vector3::new(0.1, 0.0, 0.0));
        let shown = task.empirical_task(&copy).unwrap();
        let w = off.added(&task, &shown, turn).unwrap();
        let [x, y] = [0, 1].map(|i| w.values()[i] - shown.values()[i]);
        assert!((x.hypot(y) - 0.02_f64.hypot(0.01)).abs() < 1e-12);
        assert!((y.atan2(x) - (-0.01_f64).atan2(0.02) - turn).abs() < 1e-9);
        assert_eq!(w.values()[2..], shown.values()[2..]);
    }

    #[test]
    fn noise_on_the_weights_changes_the_motion_a_little_and_its_grasp_not_at_all() {
        let task = pouring::task();
        let all = demonstrations(1);
        let original = Original::new(&task, &all[0]);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let frame = task.state_frame();
        let (mut moves, mut turns, mut rounds) = (0.0, 0.0, 0.0);
        for _ in 0..200 {
            let noise = Augmentation::default().weight_noise;
            let poses = frame.poses(&original.perturbed(noise, &mut rng).states);
            assert_eq!(poses[0].translation, original.poses[0].translation);
            assert!(poses[0].rotation.angle_to(&original.poses[0].rotation) < 1e-9);
            for (a, b) in poses.iter().zip(&original.poses) {
                moves += (a.translation.vector - b.translation.vector).norm_squared();
                turns += a.rotation.angle_to(&b.rotation).powi(2);
                rounds += 1.0;
            }
        }
        let (moved, turned) = ((moves / rounds).sqrt(), (turns / rounds).sqrt().to_degrees());
        assert!((0.001..0.01).contains(&moved) && (0.3..3.0).contains(&turned), "{moved} {turned}");
        let same = original.perturbed(0.0, &mut rng);
        for (a, b) in same.states.values().iter().zip(all[0].motion.states.values()) {
            assert!((a - b).abs() < 1e-9, "without noise nothing changes: {a} {b}");
        }
    }

    #[test]
    fn copies_are_valid_inside_the_region_and_never_tested_on() {
        let task = pouring::task();
        let all = demonstrations(10);
        let mut splits = Splits {
            train: all[..6].to_vec(),
            validation: all[6..8].to_vec(),
            test: all[8..].to_vec(),
        };
        let augmentation = Augmentation {
            train_copies: 32,
            validation_copies: 4,
            region_margin_m: 0.1,
            ..Augmentation::default()
        };
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let report = augmentation.augment(&task, &mut splits, |_, _| true, &mut rng);
        assert_eq!(report.made, 32 + 4, "{report:?}");
        assert_eq!((splits.train.len(), splits.validation.len()), (38, 6));
        // As evenly as it goes: two of six have one more.
        let of =
            |id: &str| splits.train.iter().filter(|d| d.id.starts_with(&format!("{id}+"))).count();
        assert_eq!(all[..6].iter().map(|d| of(&d.id)).collect::<Vec<_>>(), [6, 6, 5, 5, 5, 5]);
        assert_eq!(splits.test, all[8..]);
        let region = region(all[..8].iter(), 0.1 + 1e-12);
        for demonstration in splits.train.iter().chain(&splits.validation) {
            assert_eq!(task.violations(&demonstration.motion), []);
            assert_eq!(task.empirical_task(&demonstration.motion).unwrap(), demonstration.w);
            assert!(region.iter().zip(demonstration.w.values()).all(|(r, v)| r.contains(*v)));
        }
        assert_ne!(splits.train[6].w, splits.train[7].w);
    }

    #[test]
    fn a_copy_that_does_not_fit_is_left_out_and_counted() {
        let augmentation = Augmentation { train_copies: 8, tries: 3, ..Augmentation::default() };
        let mut splits = Splits { train: demonstrations(4), ..Splits::default() };
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let task = pouring::task();
        let report = augmentation.augment(&task, &mut splits, |_, _| false, &mut rng);
        assert_eq!(report, AugmentationReport { made: 0, failed: 8, rejected: 12 });
        assert_eq!(splits.train.len(), 4);
    }

    #[test]
    fn demonstrations_are_split_as_the_paper_splits_them() {
        let count = |n: usize| {
            let demonstrations = demonstrations(1).into_iter().cycle().take(n).collect();
            let splits = Splits::random(demonstrations, &mut ChaCha8Rng::seed_from_u64(0));
            [splits.train.len(), splits.validation.len(), splits.test.len()]
        };
        assert_eq!(count(208), [124, 42, 42]);
        assert_eq!(count(10), [6, 2, 2]);
        assert_eq!(count(3), [3, 0, 0]);
    }
}
