//! Classical movement primitives, as baselines behind [`MovementPrimitive`]: task-parameterised
//! Gaussian mixtures, probabilistic and dynamic movement primitives. They have no manner
//! parameters; each answers a task with its one mean motion.
//!
//! What a task means to them: each location `(x, y)` of the task space is a frame that is only
//! translated, in the first two values of the state. The rest of the state is the world's.
//!
//! [`MovementPrimitive`]: crate::primitive::MovementPrimitive

pub mod classical;
pub mod dmp;
pub mod dtw;
pub mod gmm;
mod matrix;
pub mod promp;
pub mod tp_gmm;

pub use classical::{Classical, ClassicalConfig, Fitted};
pub use dmp::{DmpConfig, DmpPrimitive};
pub use promp::{ProMp, ProMpConfig};
pub use tp_gmm::{TpGmm, TpGmmConfig};

use crate::parameters::{TaskParameters, TaskSpace};
use crate::primitive::{Demonstration, Generated};
use crate::trajectory::Trajectory;

/// Why a primitive can't be fitted, or parts are not a primitive.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PrimitiveError {
    /// Too few demonstrations, or samples.
    #[error("{found} {what} where at least {needed} are needed; {remedy}")]
    TooFew {
        /// What there is too little of.
        what: &'static str,
        /// How many there are.
        found: usize,
        /// How many it takes.
        needed: usize,
        /// What helps.
        remedy: &'static str,
    },
    /// A demonstration that speaks of something else than the first, or than the task space.
    #[error("demonstration {id} has {found} {values} where {expected} are needed")]
    Mismatch {
        /// The demonstration.
        id: String,
        /// What differs.
        values: &'static str,
        /// Its number.
        found: usize,
        /// The number that it needs.
        expected: usize,
    },
    /// A setting outside its range.
    #[error("{name} is {value}; it must be {range}")]
    Setting {
        /// Name of the setting.
        name: &'static str,
        /// Its value.
        value: f64,
        /// What it may be.
        range: &'static str,
    },
    /// A matrix that has to be positive definite and is not, to the precision of a number.
    #[error(
        "the {matrix} of part {index} is not positive definite; raise the regularization, or use \
         fewer components or weights"
    )]
    NotPositiveDefinite {
        /// Which matrix.
        matrix: &'static str,
        /// Which of them, such as the mixture's component.
        index: usize,
    },
    /// Stored parts that don't fit together.
    #[error("the stored {primitive} does not fit together: {detail}")]
    Parts {
        /// Which primitive.
        primitive: &'static str,
        /// What does not fit, with its numbers.
        detail: String,
    },
}

/// States of a generated trajectory, where no other number is set: those of a pour.
const STEPS: usize = 100;
/// Most states of a trajectory, most values of a state, most basis functions, as a TC-VAE's.
const MOST_STEPS: usize = 20_000;
const MOST_VALUES: usize = 1000;
const MOST_FUNCTIONS: usize = 1000;
/// Largest number that a primitive may be made of, and largest task parameter that it follows, both
/// far beyond any data: within them everything that is generated is finite.
const LARGEST_PART: f64 = 1e9;
const LARGEST_TASK: f64 = 1e6;

/// The task, with each value at most [`LARGEST_TASK`] away from 0.
fn bounded(space: &TaskSpace, w: &TaskParameters) -> TaskParameters {
    let values = w.values().iter().map(|v| v.clamp(-LARGEST_TASK, LARGEST_TASK)).collect();
    TaskParameters::new(space, values).expect("a task of this space")
}

/// What is wrong with the sizes of stored parts; `None` where nothing is.
fn wrong_sizes(space: &TaskSpace, steps: usize, state_dim: usize) -> Option<String> {
    let least = if space.dim() > 0 { 2 } else { 1 };
    let fits = (2..=MOST_STEPS).contains(&steps) && (least..=MOST_VALUES).contains(&state_dim);
    (!fits).then(|| {
        format!(
            "{steps} steps of {state_dim} values; 2 to {MOST_STEPS} of {least} to {MOST_VALUES} \
             are possible"
        )
    })
}

/// What is wrong with stored numbers; `None` where nothing is.
fn wrong_numbers<'a>(mut numbers: impl Iterator<Item = &'a f64>) -> Option<String> {
    let wrong = numbers.find(|v| v.is_nan() || v.abs() > LARGEST_PART)?;
    Some(format!("a value is {wrong}; at most {LARGEST_PART:e} is possible"))
}

/// Checks a setting that is a share of the motion.
fn check_window(value: f64) -> Result<(), PrimitiveError> {
    match value {
        0.0..=1.0 => Ok(()),
        _ => {
            let (name, range) = ("alignment_window", "from 0 to 1");
            Err(PrimitiveError::Setting { name, value, range })
        }
    }
}

/// Checks that demonstrations are of one kind and of this task space, and returns the number of
/// values in their states.
fn check(
    space: &TaskSpace,
    steps: usize,
    demonstrations: &[Demonstration],
    needed: usize,
) -> Result<usize, PrimitiveError> {
    if !(2..=MOST_STEPS).contains(&steps) {
        let (name, value, range) = ("steps", steps as f64, "from 2 to 20000");
        return Err(PrimitiveError::Setting { name, value, range });
    }
    let found = demonstrations.len();
    if found < needed.max(1) {
        let (what, remedy) = ("demonstrations", "record more");
        return Err(PrimitiveError::TooFew { what, found, needed: needed.max(1), remedy });
    }
    let dim = demonstrations[0].motion.states.dim();
    for Demonstration { id, w, motion, events: _ } in demonstrations {
        let mismatch = |values, found, expected| PrimitiveError::Mismatch {
            id: id.clone(),
            values,
            found,
            expected,
        };
        if motion.states.dim() != dim {
            return Err(mismatch("values in a state", motion.states.dim(), dim));
        }
        if dim < 2 && space.dim() > 0 {
            return Err(mismatch("values in a state, of which a location moves two,", dim, 2));
        }
        if w.values().len() != space.dim() {
            return Err(mismatch("task parameters", w.values().len(), space.dim()));
        }
    }
    Ok(dim)
}

/// How far steps may move in alignment, as a share of the motion: the default where demonstrations
/// are aligned. On simulated pours of several styles an alignment without limit takes the tilt out
/// of the mean motion: where the directions of two motions differ, the cheapest path spends little
/// time on the differing parts.
pub const ALIGNMENT_WINDOW: f64 = 0.1;

/// The demonstrations in `steps` states each, and with the timing of the most typical one if
/// `window` is above 0, the share of the motion by which [`dtw`] may move a step.
///
/// What is compared must not depend on the task: the distance from each location stands for the two
/// values that it moves, and the rest of the state for itself. Each is taken less its mean over the
/// motion, so that an offset is not taken for a difference in timing, and divided by its standard
/// deviation over all demonstrations. The most typical demonstration is the one nearest to the mean
/// of these.
fn prepared(steps: usize, window: f64, demonstrations: &[Demonstration]) -> Vec<Trajectory> {
    let motions: Vec<Trajectory> =
        demonstrations.iter().map(|d| d.motion.states.resampled(steps)).collect();
    let window = (window * steps as f64).round() as usize;
    if window == 0 || motions.len() < 2 {
        return motions;
    }
    let mut views: Vec<Vec<f64>> =
        motions.iter().zip(demonstrations).map(|(m, d)| seen_from_locations(m, &d.w)).collect();
    let dim = views[0].len() / steps;
    for i in 0..dim {
        for view in &mut views {
            let mean = view.iter().skip(i).step_by(dim).sum::<f64>() / steps as f64;
            view.iter_mut().skip(i).step_by(dim).for_each(|v| *v -= mean);
        }
        let values = views.iter().flat_map(|v| v.iter().skip(i).step_by(dim));
        let square = values.map(|v| v * v).sum::<f64>() / (views.len() * steps) as f64;
        // A value that never changes says nothing about timing.
        let scale = if square > 1e-24 { 1.0 / square.sqrt() } else { 0.0 };
        for view in &mut views {
            view.iter_mut().skip(i).step_by(dim).for_each(|v| *v *= scale);
        }
    }
    let mean: Vec<f64> = (0..steps * dim)
        .map(|i| views.iter().map(|v| v[i]).sum::<f64>() / views.len() as f64)
        .collect();
    let from_mean =
        |view: &[f64]| view.iter().zip(&mean).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
    let distances: Vec<f64> = views.iter().map(|v| from_mean(v)).collect();
    let typical = (0..views.len()).min_by(|a, b| distances[*a].total_cmp(&distances[*b]));
    let views: Vec<Trajectory> = views
        .into_iter()
        .map(|v| Trajectory::new(dim, v).expect("finite states, seen from finite locations"))
        .collect();
    let reference = &views[typical.expect("there are demonstrations")];
    let warp = |(view, motion)| {
        let pattern = dtw::StepPattern::Symmetric2;
        dtw::warp(view, reference, pattern, Some(window)).applied(motion, steps)
    };
    views.iter().zip(&motions).map(warp).collect()
}

/// What alignment compares, row by row: the distance from each location of the task, then the values
/// that no location moves.
fn seen_from_locations(motion: &Trajectory, w: &TaskParameters) -> Vec<f64> {
    let moved = if w.values().is_empty() { 0 } else { 2 };
    let seen = |state: &[f64]| {
        let distance = |l: &[f64]| (state[0] - l[0]).hypot(state[1] - l[1]);
        let distances = w.values().chunks_exact(2).map(distance);
        distances.chain(state[moved..].iter().copied()).collect::<Vec<_>>()
    };
    motion.states().flat_map(seen).collect()
}

/// A mean and variances, each `[steps, dim]` row by row, as what a primitive answers.
///
/// # Panics
/// When they are not finite, which those of checked parts and a [`bounded`] task are.
fn generated(dim: usize, mean: Vec<f64>, variances: Vec<f64>) -> Generated {
    let stddev = variances.into_iter().map(|v| v.max(0.0).sqrt()).collect();
    let trajectory =
        |values| Trajectory::new(dim, values).expect("checked parts give finite states");
    Generated { mean: trajectory(mean), stddev: trajectory(stddev), duration_secs: None }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::parameters::{Interval, TaskLocation};
    use crate::trajectory::Motion;

    /// A space of this many locations.
    pub(crate) fn space(locations: usize) -> TaskSpace {
        let interval = Interval { lower: -1.0, upper: 1.0 };
        let location = |i| TaskLocation { name: format!("location_{i}"), x: interval, y: interval };
        TaskSpace::new("m", (0..locations).map(location).collect()).unwrap()
    }

    pub(crate) fn task(w: &[f64]) -> TaskParameters {
        TaskParameters::new(&space(w.len() / 2), w.to_vec()).unwrap()
    }

    /// A number in `[-1, 1]` that looks random.
    fn scattered(i: usize) -> f64 {
        2.0 * (43_758.545_3 * (12.9898 * i as f64 + 4.1).sin()).rem_euclid(1.0) - 1.0
    }

    /// Minimum-jerk motions with a bump in height, each with a timing of its own: from the second
    /// location to the first one, or around the only one, or from 0 to 1.
    pub(crate) fn demonstrations(locations: usize, count: usize) -> Vec<Demonstration> {
        let one = |n: usize| {
            let w: Vec<f64> = (0..2 * locations).map(|i| 0.5 * scattered(7 * n + i)).collect();
            let (from, to) = match locations {
                0 => ([0.0; 2], [1.0; 2]),
                1 => ([w[0] - 0.2, w[1]], [w[0] + 0.2, w[1]]),
                _ => ([w[2], w[3]], [w[0], w[1]]),
            };
            let (height, late) = (0.3 + 0.03 * scattered(n), 1.0 + 0.3 * scattered(n + 1000));
            let steps = 50 + n % 3;
            let values = (0..steps).flat_map(|t| {
                let s = (t as f64 / (steps - 1) as f64).powf(late);
                let share = s * s * s * (10.0 + s * (6.0 * s - 15.0));
                let [x, y] = [0, 1].map(|i| from[i] + share * (to[i] - from[i]));
                [x, y, height * 16.0 * (s * (1.0 - s)).powi(2)]
            });
            let states = Trajectory::new(3, values.collect()).unwrap();
            let motion = Motion { states, duration_secs: 2.0 };
            Demonstration { id: n.to_string(), w: task(&w), motion, events: Vec::new() }
        };
        (0..count).map(one).collect()
    }

    pub(crate) fn largest_difference(a: &Trajectory, b: &Trajectory) -> f64 {
        assert_eq!((a.steps(), a.dim()), (b.steps(), b.dim()));
        a.values().iter().zip(b.values()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    }

    #[test]
    fn alignment_takes_the_timing_out_and_keeps_the_ends() {
        let demonstrations = demonstrations(2, 12);
        let spread = |motions: &[Trajectory]| {
            let variance = |t: usize| {
                let heights: Vec<f64> = motions.iter().map(|m| m.state(t)[2]).collect();
                let mean = heights.iter().sum::<f64>() / heights.len() as f64;
                heights.iter().map(|h| (h - mean).powi(2)).sum::<f64>() / heights.len() as f64
            };
            (0..60).map(variance).sum::<f64>() / 60.0
        };
        let (raw, aligned) =
            (prepared(60, 0.0, &demonstrations), prepared(60, 0.2, &demonstrations));
        assert!(spread(&aligned) < 0.7 * spread(&raw), "{} {}", spread(&aligned), spread(&raw));
        for (a, b) in raw.iter().zip(&aligned) {
            for (a, b) in [(a.state(0), b.state(0)), (a.state(59), b.state(59))] {
                assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 0.02), "{a:?} {b:?}");
            }
        }
    }
}
