//! Probabilistic movement primitives (A. Paraschos, C. Daniel, J. Peters and G. Neumann,
//! *Probabilistic Movement Primitives*, NIPS 2013).
//!
//! A motion is `y(s) = Phi(s) v`: radial basis functions over the phase s, and weights v, one set
//! for each value of the state. Ridge regression gives each demonstration's weights. Their
//! distribution adapts to a task by conditioning: weights and task parameters are jointly normal
//! over the demonstrations, and a task is answered with `p(v | w)`, as Maeda et al. (2017) answer a
//! partner's motion. What is answered can be conditioned further on via points, as Paraschos et al.
//! do.

use nalgebra::{Cholesky, DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::{
    MOST_FUNCTIONS, PrimitiveError, STEPS, bounded, check, check_window, generated, prepared,
    wrong_numbers, wrong_sizes,
};
use crate::parameters::{TaskParameters, TaskSpace};
use crate::primitive::{Demonstration, Generated, MovementPrimitive};
use crate::trajectory::Trajectory;

/// Value of a basis function half way to its neighbours, before they are normalized to sum to 1.
///
/// 0.7 as in dfki-ric/movement_primitives, whose functions these are.
const OVERLAP: f64 = 0.7;

/// How a [`ProMp`] is fitted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ProMpConfig {
    /// States of a generated trajectory; demonstrations are resampled to them.
    pub steps: usize,
    /// Basis functions for each value of the state.
    pub basis_functions: usize,
    /// Share of the motion by which dynamic time warping may move its steps, to give the
    /// demonstrations the timing of the most typical one first; with 0 they keep their own.
    pub alignment_window: f64,
    /// Ridge of the regression of the weights.
    pub weight_ridge: f64,
    /// Added to the variances of the task parameters, in their squared unit. With it a task that
    /// the demonstrations don't vary in does not move the motion, and few demonstrations are not
    /// taken at their word.
    pub task_ridge: f64,
}

impl Default for ProMpConfig {
    fn default() -> Self {
        Self {
            steps: STEPS,
            basis_functions: 20,
            alignment_window: 0.0,
            weight_ridge: 1e-6,
            task_ridge: 1e-6,
        }
    }
}

impl ProMpConfig {
    fn check(&self) -> Result<(), PrimitiveError> {
        let Self { steps: _, basis_functions, alignment_window, weight_ridge, task_ridge } = *self;
        check_window(alignment_window)?;
        let error = |name, value, range| Err(PrimitiveError::Setting { name, value, range });
        if !(2..=MOST_FUNCTIONS).contains(&basis_functions) {
            return error("basis_functions", basis_functions as f64, "from 2 to 1000");
        }
        for (name, value) in [("weight_ridge", weight_ridge), ("task_ridge", task_ridge)] {
            if !(0.0..=1e6).contains(&value) {
                return error(name, value, "from 0 to 1e6");
            }
        }
        Ok(())
    }
}

/// The basis functions at a phase in `[0, 1]`: Gaussians with centres at equal distances from 0 to
/// 1, normalized to sum to 1.
fn basis(count: usize, phase: f64) -> DVector<f64> {
    let variance = -1.0 / (8.0 * (count * count) as f64 * OVERLAP.ln());
    let value = |i: usize| {
        let center = i as f64 / (count - 1) as f64;
        (-(phase - center).powi(2) / (2.0 * variance)).exp()
    };
    let values = DVector::from_fn(count, |i, _| value(i));
    let sum = values.sum();
    values / sum
}

/// The basis functions at `steps` equal steps of phase, `[steps, count]`.
fn design(count: usize, steps: usize) -> DMatrix<f64> {
    let rows: Vec<_> =
        (0..steps).map(|t| basis(count, t as f64 / (steps - 1) as f64).transpose()).collect();
    DMatrix::from_rows(&rows)
}

/// The weights of a motion by ridge regression, `[state_dim * basis_functions]`: all of the first
/// value of the state, then all of the second.
///
/// # Errors
/// More basis functions than the motion determines, without a ridge.
///
/// # Panics
/// With fewer than two basis functions.
pub fn weights(
    motion: &Trajectory,
    basis_functions: usize,
    ridge: f64,
) -> Result<DVector<f64>, PrimitiveError> {
    assert!(basis_functions >= 2, "at least two basis functions");
    let design = design(basis_functions, motion.steps());
    let mut normal = design.transpose() * &design;
    for i in 0..basis_functions {
        normal[(i, i)] += ridge;
    }
    let matrix = "matrix of the basis functions";
    let cholesky =
        Cholesky::new(normal).ok_or(PrimitiveError::NotPositiveDefinite { matrix, index: 0 })?;
    let states = DMatrix::from_row_slice(motion.steps(), motion.dim(), motion.values());
    let weights = cholesky.solve(&(design.transpose() * states));
    Ok(DVector::from_column_slice(weights.as_slice()))
}

/// A normal distribution of motions.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MotionDistribution {
    /// Values of one state.
    pub state_dim: usize,
    /// Mean of the weights, `[state_dim * basis_functions]`, in the order of [`weights`].
    pub mean: DVector<f64>,
    /// Covariance of the weights.
    #[serde(with = "super::matrix")]
    pub covariance: DMatrix<f64>,
}

impl MotionDistribution {
    fn basis_functions(&self) -> usize {
        self.mean.len() / self.state_dim
    }

    /// Mean and variance of each state value at `steps` equal steps of phase, both
    /// `[steps, state_dim]` row by row.
    ///
    /// # Panics
    /// With fewer than two steps.
    pub fn marginals(&self, steps: usize) -> (Vec<f64>, Vec<f64>) {
        assert!(steps >= 2, "a trajectory has at least 2 steps");
        let count = self.basis_functions();
        let (mut mean, mut variances) = (Vec::new(), Vec::new());
        for t in 0..steps {
            let basis = basis(count, t as f64 / (steps - 1) as f64);
            for i in 0..self.state_dim {
                let block = self.covariance.view((i * count, i * count), (count, count));
                mean.push(basis.dot(&self.mean.rows(i * count, count)));
                variances.push(basis.dot(&(block * &basis)));
            }
        }
        (mean, variances)
    }

    /// The distribution of those motions that pass through `state` at `phase`, measured with
    /// `variance` in each value (eq. 5 and 6 of Paraschos et al.).
    ///
    /// # Errors
    /// Motions that don't vary at this phase, with a variance of 0.
    ///
    /// # Panics
    /// When `state` is not one.
    pub fn through(
        &self,
        phase: f64,
        state: &[f64],
        variance: f64,
    ) -> Result<Self, PrimitiveError> {
        assert_eq!(state.len(), self.state_dim, "values of a state");
        let count = self.basis_functions();
        let basis = basis(count, phase);
        let mut observation = DMatrix::zeros(self.state_dim, self.mean.len());
        for i in 0..self.state_dim {
            observation.view_mut((i, i * count), (1, count)).copy_from(&basis.transpose());
        }
        let across = &self.covariance * observation.transpose();
        let mut of_state = &observation * &across;
        for i in 0..self.state_dim {
            of_state[(i, i)] += variance;
        }
        let matrix = "covariance of the via point";
        let cholesky = Cholesky::new(of_state)
            .ok_or(PrimitiveError::NotPositiveDefinite { matrix, index: 0 })?;
        let missing = DVector::from_column_slice(state) - &observation * &self.mean;
        Ok(Self {
            state_dim: self.state_dim,
            mean: &self.mean + &across * cholesky.solve(&missing),
            covariance: &self.covariance - &across * cholesky.solve(&across.transpose()),
        })
    }
}

/// The stored parts of a [`ProMp`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Parts {
    task_space: TaskSpace,
    steps: usize,
    /// Mean of the task parameters.
    task_mean: DVector<f64>,
    /// By how much the weights move with the task: `Cov(v, w) Cov(w, w)^-1`.
    #[serde(with = "super::matrix")]
    gain: DMatrix<f64>,
    /// The weights at the mean task, and their covariance given any task.
    motions: MotionDistribution,
    /// Variance of what the basis functions don't express, for each value of the state.
    residual_variance: DVector<f64>,
}

/// A probabilistic movement primitive, conditioned on its task parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Parts", into = "Parts")]
pub struct ProMp {
    parts: Parts,
}

impl ProMp {
    /// Fits the joint distribution to demonstrations.
    ///
    /// # Errors
    /// Too few demonstrations for the task parameters, or some of another task space or state;
    /// settings out of range; demonstrations that don't vary in their task, without a ridge.
    pub fn fit(
        config: &ProMpConfig,
        space: &TaskSpace,
        demonstrations: &[Demonstration],
    ) -> Result<Self, PrimitiveError> {
        config.check()?;
        let steps = config.steps;
        let state_dim = check(space, steps, demonstrations, space.dim() + 2)?;
        let motions = prepared(steps, config.alignment_window, demonstrations);
        let count = config.basis_functions;
        let weights = motions
            .iter()
            .map(|m| weights(m, count, config.weight_ridge))
            .collect::<Result<Vec<_>, _>>()?;

        let mut residual_variance = DVector::zeros(state_dim);
        let design = design(count, steps);
        for (motion, weights) in motions.iter().zip(&weights) {
            let states = DMatrix::from_row_slice(steps, state_dim, motion.values());
            let fitted = &design * DMatrix::from_column_slice(count, state_dim, weights.as_slice());
            for (i, column) in (states - fitted).column_iter().enumerate() {
                residual_variance[i] += column.norm_squared() / (steps * motions.len()) as f64;
            }
        }

        let centered = |columns: &[DVector<f64>]| {
            let mut matrix = DMatrix::from_columns(columns);
            let mean = matrix.column_mean();
            matrix.column_iter_mut().for_each(|mut column| column -= &mean);
            (mean, matrix)
        };
        let (weight_mean, weights) = centered(&weights);
        let tasks: Vec<_> =
            demonstrations.iter().map(|d| DVector::from_column_slice(d.w.values())).collect();
        let (task_mean, tasks) = centered(&tasks);
        let degrees = (demonstrations.len() - 1) as f64;
        let mut of_tasks = &tasks * tasks.transpose() / degrees;
        for i in 0..space.dim() {
            of_tasks[(i, i)] += config.task_ridge;
        }
        let across = &weights * tasks.transpose() / degrees;
        let gain = if space.dim() == 0 {
            across
        } else {
            let matrix = "covariance of the task parameters";
            let cholesky = Cholesky::new(of_tasks)
                .ok_or(PrimitiveError::NotPositiveDefinite { matrix, index: 0 })?;
            cholesky.solve(&across.transpose()).transpose()
        };
        // The covariance of what the task does not explain: the Schur complement, as a sum of
        // squares that rounding can't make negative.
        let unexplained = weights - &gain * tasks;
        let covariance = &unexplained * unexplained.transpose() / degrees;
        let motions = MotionDistribution { state_dim, mean: weight_mean, covariance };
        let task_space = space.clone();
        Self::try_from(Parts { task_space, steps, task_mean, gain, motions, residual_variance })
    }

    /// The motions for task `w`.
    pub fn motions(&self, w: &TaskParameters) -> MotionDistribution {
        let Parts { task_mean, gain, motions, .. } = &self.parts;
        let mut motions = motions.clone();
        motions.mean += gain * (DVector::from_column_slice(w.values()) - task_mean);
        motions
    }
}

impl TryFrom<Parts> for ProMp {
    type Error = PrimitiveError;

    fn try_from(parts: Parts) -> Result<Self, PrimitiveError> {
        let Parts { task_space, steps, task_mean, gain, motions, residual_variance } = &parts;
        let MotionDistribution { state_dim, mean, covariance } = motions;
        let (count, dim) = (mean.len(), task_space.dim());
        let numbers = [
            task_mean.as_slice(),
            gain.as_slice(),
            mean.as_slice(),
            covariance.as_slice(),
            residual_variance.as_slice(),
        ];
        let wrong = if let Some(wrong) = wrong_sizes(task_space, *steps, *state_dim) {
            Some(wrong)
        } else if count < 2 * state_dim || !count.is_multiple_of(*state_dim) {
            Some(format!("{count} weights for {state_dim} values of a state"))
        } else if task_mean.len() != dim || gain.shape() != (count, dim) {
            Some(format!("the gain is not of {count} weights and {dim} task parameters"))
        } else if covariance.shape() != (count, count) || residual_variance.len() != *state_dim {
            Some(format!("the covariance is not of {count} weights"))
        } else if let Some(wrong) = wrong_numbers(numbers.into_iter().flatten()) {
            Some(wrong)
        } else if !residual_variance.iter().chain(&covariance.diagonal()).all(|v| *v >= 0.0) {
            Some("a variance is negative".to_string())
        } else {
            None
        };
        match wrong {
            Some(detail) => Err(PrimitiveError::Parts { primitive: "ProMP", detail }),
            None => Ok(Self { parts }),
        }
    }
}

impl From<ProMp> for Parts {
    fn from(promp: ProMp) -> Self {
        promp.parts
    }
}

impl MovementPrimitive for ProMp {
    fn task_space(&self) -> &TaskSpace {
        &self.parts.task_space
    }

    fn steps(&self) -> usize {
        self.parts.steps
    }

    fn state_dim(&self) -> usize {
        self.parts.motions.state_dim
    }

    fn generate(&self, w: &TaskParameters) -> Generated {
        let w = &bounded(self.task_space(), w);
        let (mean, mut variances) = self.motions(w).marginals(self.parts.steps);
        let residual = self.parts.residual_variance.iter().cycle();
        variances.iter_mut().zip(residual).for_each(|(v, residual)| *v += residual);
        generated(self.state_dim(), mean, variances)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::primitives::tests::{demonstrations, largest_difference, space, task};

    fn fitted(demonstrations: &[Demonstration]) -> ProMp {
        let config = ProMpConfig { steps: 50, ..ProMpConfig::default() };
        ProMp::fit(&config, &space(2), demonstrations).unwrap()
    }

    #[test]
    fn a_motion_that_follows_the_task_linearly_is_learned_exactly() {
        // A bump, moved by the first location, stretched by the second.
        let motion = |w: &[f64]| {
            let weights = DVector::from_fn(40, |i, _| {
                let bump = (0.3 * i as f64).sin();
                if i < 20 { bump + w[0] + 2.0 * w[2] } else { w[1] - w[3] * bump }
            });
            let design = design(20, 50);
            let states = &design * DMatrix::from_column_slice(20, 2, weights.as_slice());
            Trajectory::new(2, states.transpose().as_slice().to_vec()).unwrap()
        };
        let demonstrations: Vec<Demonstration> = demonstrations(2, 30)
            .into_iter()
            .map(|mut d| {
                d.motion.states = motion(d.w.values());
                d
            })
            .collect();
        let config = ProMpConfig {
            steps: 50,
            weight_ridge: 1e-12,
            task_ridge: 0.0,
            ..ProMpConfig::default()
        };
        let promp = ProMp::fit(&config, &space(2), &demonstrations).unwrap();
        for w in [[0.1, 0.7, -0.3, 0.2], [0.0; 4]] {
            let Generated { mean, stddev, .. } = promp.generate(&task(&w));
            assert!(largest_difference(&mean, &motion(&w)) < 1e-6);
            assert!(stddev.values().iter().all(|v| *v < 1e-5));
        }
    }

    #[test]
    fn the_motion_goes_from_one_location_to_the_other_and_a_via_point_pulls_it() {
        let promp = fitted(&demonstrations(2, 40));
        let w = task(&[0.3, 0.2, -0.4, 0.1]);
        let mean = promp.generate(&w).mean;
        let (first, last) = (mean.state(0), mean.state(49));
        assert!((first[0] + 0.4).hypot(first[1] - 0.1) < 0.02, "{first:?}");
        assert!((last[0] - 0.3).hypot(last[1] - 0.2) < 0.02, "{last:?}");
        let before = promp.motions(&w);
        let via = [mean.state(25)[0], mean.state(25)[1], mean.state(25)[2] + 0.02];
        let through = before.through(25.0 / 49.0, &via, 1e-8).unwrap();
        let (after, variances) = through.marginals(50);
        assert!((after[3 * 25 + 2] - via[2]).abs() < 1e-3);
        let (_, variances_before) = before.marginals(50);
        assert!(variances[3 * 25 + 2] < 1e-3 * variances_before[3 * 25 + 2]);
    }

    #[test]
    fn storing_gives_the_same_primitive_and_odd_parts_are_refused() {
        let promp = fitted(&demonstrations(2, 10));
        let text = serde_json::to_string(&promp).unwrap();
        assert_eq!(serde_json::from_str::<ProMp>(&text).unwrap(), promp);
        let odd = text.replacen("\"state_dim\":3", "\"state_dim\":7", 1);
        let error = serde_json::from_str::<ProMp>(&odd).unwrap_err().to_string();
        assert!(error.contains("60 weights for 7 values of a state"), "{error}");
    }

    #[test]
    fn fewer_demonstrations_than_the_task_needs_are_refused() {
        let config = ProMpConfig::default();
        let refused = ProMp::fit(&config, &space(2), &demonstrations(2, 5));
        assert!(matches!(refused, Err(PrimitiveError::TooFew { found: 5, needed: 6, .. })));
        let one = ProMpConfig { basis_functions: 1, ..config };
        let error = ProMp::fit(&one, &space(2), &demonstrations(2, 9)).unwrap_err();
        assert_eq!(error.to_string(), "basis_functions is 1; it must be from 2 to 1000");
    }
}
