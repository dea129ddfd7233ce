//! More demonstrations from few: the same pours elsewhere.
//!
//! A copy is turned about the vertical and moved as a whole, its task parameters with it, and its
//! pour is shifted by up to 5 cm while its grasp stays, as the paper does (section 5.2). What is
//! kept is still a valid pour inside the region of the demonstrations.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};

use super::pouring::PouringTask;
use super::task::Task;
use super::{Demonstration, Splits};
use crate::parameters::Interval;
use crate::trajectory::Motion;

/// How demonstrations are multiplied.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Augmentation {
    /// Copies of each demonstration to train on, besides itself.
    pub train_copies: usize,
    /// Copies of each demonstration to validate on, besides itself.
    pub validation_copies: usize,
    /// Largest turn about the vertical.
    pub max_turn_deg: f64,
    /// Largest move along x and along y.
    pub max_move_m: f64,
    /// Largest shift of the pour against the grasp.
    pub max_pour_shift_m: f64,
    /// How far task parameters may leave the box around the demonstrated ones.
    pub region_margin_m: f64,
    /// Tries for each copy; what fails all of them is left out.
    pub tries: usize,
}

impl Default for Augmentation {
    /// About the paper's numbers: 124 demonstrations become 124 + 6652 to train on, and 42 become
    /// 42 + 462 to validate on.
    fn default() -> Self {
        Self {
            train_copies: 54,
            validation_copies: 11,
            max_turn_deg: 30.0,
            max_move_m: 0.15,
            max_pour_shift_m: 0.05,
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
    /// Copies for which every try failed.
    pub failed: usize,
    /// Tries that were no valid pours, or outside the region.
    pub rejected: usize,
}

impl Augmentation {
    /// Adds copies to what is trained and validated on; what is tested on stays as it was
    /// recorded. `fits` may refuse a copy, for instance one that the arm can't make.
    pub fn augment<R: Rng + ?Sized>(
        &self,
        task: &PouringTask,
        splits: &mut Splits,
        mut fits: impl FnMut(&Motion, &mut R) -> bool,
        rng: &mut R,
    ) -> AugmentationReport {
        let mut report = AugmentationReport::default();
        // Nothing of what is tested on goes into the region.
        let region = region(splits.train.iter().chain(&splits.validation), self.region_margin_m);
        let Splits { train, validation, test: _ } = splits;
        for (part, copies) in [(train, self.train_copies), (validation, self.validation_copies)] {
            let mut made = Vec::with_capacity(part.len() * copies);
            for demonstration in part.iter() {
                for copy in 1..=copies {
                    let found = (0..self.tries).find_map(|_| {
                        let copy = self.copy(task, demonstration, copy, rng);
                        let inside = |c: &Demonstration| {
                            region.iter().zip(c.w.values()).all(|(r, v)| r.contains(*v))
                        };
                        let copy = copy.filter(inside).filter(|c| fits(&c.motion, rng));
                        report.rejected += usize::from(copy.is_none());
                        copy
                    });
                    match found {
                        Some(copy) => made.push(copy),
                        None => report.failed += 1,
                    }
                }
            }
            report.made += made.len();
            part.extend(made);
        }
        report
    }

    /// One random copy; none where it is no valid pour.
    fn copy<R: Rng + ?Sized>(
        &self,
        task: &PouringTask,
        demonstration: &Demonstration,
        number: usize,
        rng: &mut R,
    ) -> Option<Demonstration> {
        let symmetric = |limit: f64, rng: &mut R| limit * (2.0 * rng.random::<f64>() - 1.0);
        let turn = symmetric(self.max_turn_deg.to_radians(), rng);
        let by =
            Vector3::new(symmetric(self.max_move_m, rng), symmetric(self.max_move_m, rng), 0.0);
        // Uniform over the disc.
        let angle = symmetric(std::f64::consts::PI, rng);
        let radius = self.max_pour_shift_m * rng.random::<f64>().sqrt();
        let shift = Vector3::new(radius * angle.cos(), radius * angle.sin(), 0.0);

        let motion = moved(task, &shifted(task, &demonstration.motion, shift)?, turn, by);
        let copied = Demonstration {
            id: format!("{}+{number}", demonstration.id),
            w: task.empirical_task(&motion).ok()?,
            events: task.events(&motion),
            motion,
        };
        // A demonstration of a manner beyond the bounds stays what it is; its copies may not break
        // what it kept.
        let broken = |motion| task.violations(motion).into_iter().map(|v| v.bound);
        let before: Vec<_> = broken(&demonstration.motion).collect();
        broken(&copied.motion).all(|bound| before.contains(&bound)).then_some(copied)
    }
}

/// The motion turned about the vertical through its grasp, then moved.
pub fn moved(task: &PouringTask, motion: &Motion, turn_rad: f64, by: Vector3<f64>) -> Motion {
    let frame = task.state_frame();
    let poses = frame.poses(&motion.states);
    let grasp = Translation3::from(poses[0].translation.vector);
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn_rad);
    let transform = Translation3::from(by) * grasp * turn * grasp.inverse();
    let poses: Vec<Isometry3<f64>> = poses.iter().map(|pose| transform * pose).collect();
    Motion { states: frame.trajectory(&poses), duration_secs: motion.duration_secs }
}

/// The motion with its pour shifted and its grasp in place: between them the shift grows along a
/// minimum-jerk profile. None for a motion without a pour.
pub fn shifted(task: &PouringTask, motion: &Motion, shift: Vector3<f64>) -> Option<Motion> {
    let pour_start_secs = task.factors(motion).first()?.value;
    // Complete in the last state before the pour, so that all of the pour is shifted alike.
    let pour_step = (pour_start_secs / motion.step_secs()).floor().max(1.0);
    let mut states = motion.states.clone();
    let mut values = states.values().to_vec();
    for (t, state) in values.chunks_exact_mut(states.dim()).enumerate() {
        let u = (t as f64 / pour_step).min(1.0);
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
    use crate::demonstrations::pouring::tests::{one_pour, rolled};
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;

    fn demonstrations(count: usize) -> Vec<Demonstration> {
        let task = PouringTask::default();
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
            let task = PouringTask::default();
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
        fn a_shift_moves_the_pour_and_keeps_the_grasp(x in -0.05..0.05f64, y in -0.05..0.05f64) {
            let task = PouringTask::default();
            let before = rolled(&one_pour(90.0), 0.1);
            let after = shifted(&task, &before, Vector3::new(x, y, 0.0)).unwrap();
            prop_assert_eq!(before.states.state(0), after.states.state(0));
            let [a, b] = [&before, &after].map(|m| task.empirical_task(m).unwrap());
            prop_assert!((b.values()[0] - a.values()[0] - x).abs() < 1e-9);
            prop_assert!((b.values()[1] - a.values()[1] - y).abs() < 1e-9);
        }
    }

    #[test]
    fn copies_are_valid_inside_the_region_and_never_tested_on() {
        let task = PouringTask::default();
        let all = demonstrations(10);
        let mut splits = Splits {
            train: all[..6].to_vec(),
            validation: all[6..8].to_vec(),
            test: all[8..].to_vec(),
        };
        let augmentation = Augmentation {
            train_copies: 5,
            validation_copies: 2,
            region_margin_m: 0.1,
            ..Augmentation::default()
        };
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let report = augmentation.augment(&task, &mut splits, |_, _| true, &mut rng);
        assert_eq!(report.made, 6 * 5 + 2 * 2, "{report:?}");
        assert_eq!((splits.train.len(), splits.validation.len()), (36, 6));
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
        let augmentation = Augmentation { train_copies: 2, tries: 3, ..Augmentation::default() };
        let mut splits = Splits { train: demonstrations(4), ..Splits::default() };
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let task = PouringTask::default();
        let report = augmentation.augment(&task, &mut splits, |_, _| false, &mut rng);
        assert_eq!(report, AugmentationReport { made: 0, failed: 8, rejected: 24 });
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
