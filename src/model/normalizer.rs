//! Between the world's units and the network's: f64 in metres and radians outside, f32 around 1
//! inside.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::config::ModelConfig;
use super::layout::{WeightsError, checked};
use super::{ModelError, NamedTensor, Weights};
use crate::pose::TURN_DIM;
use crate::primitive::Demonstration;
#[cfg(any(feature = "train", test))]
use crate::trajectory::Trajectory;

/// Offsets and scales of states and tasks: the network sees `(value - offset) / scale`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Normalizer {
    /// Mean of each state value over the training set, in the state's unit; 0 where the model has
    /// a task baseline, which takes its place.
    pub state_offset: Vec<f64>,
    /// Standard deviation of each state value around the offset or the baseline.
    pub state_scale: Vec<f64>,
    /// Mean of each task value over the training set.
    pub task_offset: Vec<f64>,
    /// Standard deviation of each task value.
    pub task_scale: Vec<f64>,
}

/// Our variant's affine task baseline: at each step, the state that follows from w alone,
/// `A_t w + b_t`. In the weights: `baseline.weight`, `[task_dim, steps * state_dim]` (of the
/// normalised w), and `baseline.bias`, `[steps * state_dim]`, both in the state's units.
#[derive(Debug, Clone, PartialEq)]
pub struct Baseline {
    weight: Vec<f32>,
    bias: Vec<f32>,
}

/// Ridge of the baseline's least squares, as a share of the number of demonstrations: enough that
/// a task value that never varies does no harm.
const BASELINE_RIDGE: f64 = 1e-6;

/// The normalised task is cut off here, far beyond any data, so that f32 stays finite.
const TASK_LIMIT: f64 = 1e3;

const WEIGHT: &str = "baseline.weight";
const BIAS: &str = "baseline.bias";

impl Normalizer {
    /// Fits offsets, scales and, where the configuration asks for one, the baseline to
    /// demonstrations of `config.steps` states.
    ///
    /// # Panics
    /// When a demonstration's sizes are not the configuration's.
    pub fn fit(config: &ModelConfig, demonstrations: &[Demonstration]) -> (Self, Option<Baseline>) {
        let Units { normalizer, baseline, .. } = Units::fit(config, demonstrations);
        (normalizer, baseline)
    }
}

impl Baseline {
    /// The baseline among a model's tensors.
    ///
    /// # Errors
    /// A tensor that is missing, has a wrong shape, or holds a value that is not finite.
    pub fn from_weights(config: &ModelConfig, weights: &Weights) -> Result<Self, WeightsError> {
        let size = config.steps * config.state_dim;
        let weight = checked(weights, WEIGHT, &[config.task_dim, size])?.values.clone();
        let bias = checked(weights, BIAS, &[size])?.values.clone();
        Ok(Self { weight, bias })
    }

    /// Adds the baseline's tensors to a model's.
    pub fn add_to(&self, weights: &mut Weights) {
        let size = self.bias.len();
        let shape = vec![self.weight.len() / size, size];
        weights.insert(WEIGHT.into(), NamedTensor { shape, values: self.weight.clone() });
        weights.insert(BIAS.into(), NamedTensor { shape: vec![size], values: self.bias.clone() });
    }
}

/// What converts between units: the normalizer, and the baseline where the model has one.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Units {
    pub(crate) normalizer: Normalizer,
    pub(crate) baseline: Option<Baseline>,
    steps: usize,
    /// Whether the network sees the task; else every task is 0.
    conditioned: bool,
}

impl Units {
    /// The conversion that a model was trained with.
    pub(crate) fn new(
        config: &ModelConfig,
        normalizer: &Normalizer,
        weights: &Weights,
    ) -> Result<Self, ModelError> {
        let Normalizer { state_offset, state_scale, task_offset, task_scale } = normalizer;
        for (name, values, expected) in [
            ("state_offset", state_offset, config.state_dim),
            ("state_scale", state_scale, config.state_dim),
            ("task_offset", task_offset, config.task_dim),
            ("task_scale", task_scale, config.task_dim),
        ] {
            let scale = name.ends_with("scale");
            let fits = |v: &f64| v.is_finite() && !(scale && *v <= 0.0);
            if values.len() != expected || !values.iter().all(fits) {
                return Err(ModelError::Normalizer { name, expected, found: values.clone() });
            }
        }
        let baseline = match config.network.task_baseline {
            true => Some(Baseline::from_weights(config, weights)?),
            false => None,
        };
        let conditioned = config.network.task_conditioned;
        Ok(Self { normalizer: normalizer.clone(), baseline, steps: config.steps, conditioned })
    }

    /// [`Normalizer::fit`].
    pub(crate) fn fit(config: &ModelConfig, demonstrations: &[Demonstration]) -> Self {
        let ModelConfig { steps, state_dim, task_dim, ref network } = *config;
        let tasks: Vec<&[f64]> = demonstrations.iter().map(|d| d.w.values()).collect();
        let (task_offset, task_scale) = moments(task_dim, &tasks);
        let states = demonstrations.iter().flat_map(|d| d.motion.states.states());
        let (state_offset, state_scale) = moments(state_dim, &states.collect::<Vec<_>>());
        let normalizer = Normalizer { state_offset, state_scale, task_offset, task_scale };
        let conditioned = network.task_conditioned;
        let mut units = Self { normalizer, baseline: None, steps, conditioned };
        if network.task_baseline {
            units.baseline = Some(units.fit_baseline(demonstrations));
            units.normalizer.state_offset = vec![0.0; state_dim];
            let residual = |d: &Demonstration| {
                let centre = units.centre(&units.task(d.w.values()));
                let x = d.motion.states.values();
                x.iter().zip(centre).map(|(x, centre)| x - centre).collect::<Vec<_>>()
            };
            let residuals: Vec<f64> = demonstrations.iter().flat_map(residual).collect();
            let rows: Vec<&[f64]> = residuals.chunks(state_dim).collect();
            units.normalizer.state_scale = moments(state_dim, &rows).1;
        }
        if network.orientations_as_turns {
            // What an angle leaves over is often noise, which is not to weigh as much as the angle.
            let turn = &mut units.normalizer.state_scale[3..TURN_DIM];
            let largest = turn.iter().copied().fold(0.0, f64::max);
            turn.fill(largest);
        }
        units
    }

    /// Least squares of the states at every step on (normalised w, 1).
    fn fit_baseline(&self, demonstrations: &[Demonstration]) -> Baseline {
        let inputs = self.normalizer.task_offset.len() + 1;
        let size = self.steps * self.normalizer.state_offset.len();
        let ridge = BASELINE_RIDGE * demonstrations.len() as f64;
        let mut gram = DMatrix::from_diagonal_element(inputs, inputs, ridge);
        let mut moments = DMatrix::zeros(inputs, size);
        for d in demonstrations {
            let mut w = self.task(d.w.values());
            w.push(1.0);
            let w = DVector::from_iterator(inputs, w.into_iter().map(f64::from));
            gram.ger(1.0, &w, &w, 1.0);
            moments.ger(1.0, &w, &DVector::from_column_slice(d.motion.states.values()), 1.0);
        }
        let solution =
            gram.cholesky().expect("the ridge makes it positive definite").solve(&moments);
        let row = |i: usize| solution.row(i).iter().map(|v| *v as f32).collect::<Vec<_>>();
        Baseline { weight: (0..inputs - 1).flat_map(row).collect(), bias: row(inputs - 1) }
    }

    /// The normalised task; zeros for a network that does not see it.
    pub(crate) fn task(&self, w: &[f64]) -> Vec<f32> {
        if !self.conditioned {
            return vec![0.0; w.len()];
        }
        let Normalizer { task_offset, task_scale, .. } = &self.normalizer;
        let scaled = w.iter().zip(task_offset).zip(task_scale).map(|((w, o), s)| (w - o) / s);
        scaled.map(|w| w.clamp(-TASK_LIMIT, TASK_LIMIT) as f32).collect()
    }

    /// What the network's 0 means at each step: the offset, or the baseline at the normalised task.
    pub(crate) fn centre(&self, task: &[f32]) -> Vec<f64> {
        let Some(Baseline { weight, bias }) = &self.baseline else {
            return self.normalizer.state_offset.repeat(self.steps);
        };
        let mut centre: Vec<f64> = bias.iter().copied().map(f64::from).collect();
        for (row, w) in weight.chunks_exact(bias.len()).zip(task) {
            centre.iter_mut().zip(row).for_each(|(c, a)| *c += f64::from(*a) * f64::from(*w));
        }
        centre
    }

    /// The normalised states of a motion for a normalised task.
    #[cfg(any(feature = "train", test))]
    pub(crate) fn states(&self, states: &Trajectory, task: &[f32]) -> Vec<f32> {
        let scale = self.normalizer.state_scale.iter().cycle();
        let values = states.values().iter().zip(self.centre(task));
        values.zip(scale).map(|((x, centre), scale)| ((x - centre) / scale) as f32).collect()
    }
}

/// Mean and standard deviation of each value of the rows; 1 instead of a deviation of 0.
fn moments(dim: usize, rows: &[&[f64]]) -> (Vec<f64>, Vec<f64>) {
    let n = rows.len().max(1) as f64;
    let mut mean = vec![0.0; dim];
    for row in rows {
        mean.iter_mut().zip(*row).for_each(|(m, v)| *m += v / n);
    }
    let mut variance = vec![0.0; dim];
    for row in rows {
        let both = row.iter().zip(&mean);
        variance.iter_mut().zip(both).for_each(|(s, (v, m))| *s += (v - m).powi(2) / n);
    }
    let deviation = |variance: f64| match variance.sqrt() {
        // Rounding alone gives a value that never varies a deviation near 1e-16.
        d if d > 1e-9 => d,
        _ => 1.0,
    };
    (mean, variance.into_iter().map(deviation).collect())
}

#[cfg(test)]
pub(crate) mod tests {
    use super::super::config::Activation;
    use super::super::layout::tests::small;
    use super::*;
    use crate::parameters::{Interval, TaskLocation, TaskParameters, TaskSpace};
    use crate::trajectory::Motion;
    use rand::rngs::ChaCha8Rng;
    use rand::{RngExt, SeedableRng};

    /// The space of the tests' tasks: two locations.
    pub(crate) fn space() -> TaskSpace {
        let interval = Interval { lower: -1.0, upper: 1.0 };
        let location = |name: &str| TaskLocation { name: name.into(), x: interval, y: interval };
        TaskSpace::new("m", vec![location("a"), location("b")]).unwrap()
    }

    /// Motions in the plane from one location to the other, with a bulge that is their manner.
    pub(crate) fn demonstrations(n: usize, steps: usize, seed: u64) -> Vec<Demonstration> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let demonstration = |i: usize| {
            let w: Vec<f64> = (0..4).map(|_| rng.random_range(-1.0..1.0)).collect();
            let bulge: f64 = rng.random_range(-0.5..0.5);
            let state = |t: usize| {
                let s = t as f64 / (steps - 1) as f64;
                let side = bulge * (std::f64::consts::PI * s).sin();
                [w[0] + s * (w[2] - w[0]) + side, w[1] + s * (w[3] - w[1]) - side]
            };
            let states = Trajectory::new(2, (0..steps).flat_map(state).collect()).unwrap();
            Demonstration {
                id: i.to_string(),
                events: Vec::new(),
                motion: Motion { states, duration_secs: 2.0 },
                w: TaskParameters::new(&space(), w).unwrap(),
            }
        };
        (0..n).map(demonstration).collect()
    }

    #[test]
    fn normalised_states_have_mean_0_and_deviation_1() {
        let config = small(Activation::Gelu, true);
        let data = demonstrations(200, config.steps, 1);
        let units = Units::fit(&config, &data);
        let normalised =
            data.iter().flat_map(|d| units.states(&d.motion.states, &units.task(d.w.values())));
        let rows: Vec<f64> = normalised.map(f64::from).collect();
        let (mean, deviation) = moments(2, &rows.chunks(2).collect::<Vec<_>>());
        assert!(mean.iter().all(|m| m.abs() < 1e-6), "{mean:?}");
        assert!(deviation.iter().all(|d| (d - 1.0).abs() < 1e-6), "{deviation:?}");
    }

    #[test]
    fn a_baseline_explains_what_is_affine_in_the_task() {
        let mut config = small(Activation::Gelu, true);
        config.network.task_baseline = true;
        let data = demonstrations(400, config.steps, 2);
        let units = Units::fit(&config, &data);
        // What remains is the bulge: nothing at the ends, and in every demonstration one factor.
        for d in demonstrations(20, config.steps, 3) {
            let task = units.task(d.w.values());
            let centre = units.centre(&task);
            let first = d.motion.states.state(0)[0] - centre[0];
            assert!(first.abs() < 1e-4, "{first}");
        }
        assert!(units.normalizer.state_scale.iter().all(|s| *s < 0.3));
    }

    #[test]
    fn a_baseline_survives_the_weights() {
        let mut config = small(Activation::Gelu, true);
        config.network.task_baseline = true;
        let units = Units::fit(&config, &demonstrations(50, config.steps, 2));
        let mut weights = Weights::new();
        units.baseline.as_ref().unwrap().add_to(&mut weights);
        assert_eq!(Units::new(&config, &units.normalizer, &weights).unwrap(), units);
    }

    #[test]
    fn a_task_without_end_stays_finite() {
        let config = small(Activation::Gelu, true);
        let units = Units::fit(&config, &demonstrations(50, config.steps, 2));
        assert!(units.task(&[1e300, -1e300, 0.0, 0.0]).iter().all(|w| w.abs() <= 1e3));
    }
}
