//! Task-parameterised Gaussian mixtures (S. Calinon, *A tutorial on task-parameterized movement
//! learning and retrieval*, 2016): the paper's baseline for pouring.
//!
//! Demonstrations, time beside state, are seen from each frame of their task. One mixture is fitted
//! to all views at once: a component has a Gaussian in each frame, and a sample's responsibilities
//! are those of the product over the frames. For a new task each component's Gaussians are moved
//! with their frames and multiplied, and the motion is the regression of the state on time.
//!
//! As in Calinon's own programs time is part of every frame's view, so the product sharpens it; the
//! same holds for state values that no frame moves (height, orientation), whose reported standard
//! deviation is that of one view divided by the root of the number of frames.

use nalgebra::{Cholesky, DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::gmm::{Gaussian, Gmm, GmmConfig, Initialization, Mixture, Regression, slices};
use super::{
    ALIGNMENT_WINDOW, PrimitiveError, STEPS, bounded, check, check_window, generated, prepared,
    wrong_numbers, wrong_sizes,
};
use crate::parameters::{TaskParameters, TaskSpace};
use crate::primitive::{Demonstration, Generated, MovementPrimitive};
use crate::trajectory::Trajectory;

/// How a [`TpGmm`] is fitted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TpGmmConfig {
    /// States of a generated trajectory; demonstrations are resampled to them. Only [`TpGmm`] asks.
    pub steps: usize,
    /// Number of Gaussians in each frame; the paper's is 25.
    pub components: usize,
    /// Share of the motion by which dynamic time warping may move its steps, to give the
    /// demonstrations the timing of the most typical one first; with 0 they keep their own.
    pub alignment_window: f64,
    /// Most steps of the optimisation.
    pub max_iterations: usize,
    /// Change of the mean log-likelihood (nat per sample) below which the optimisation ends.
    pub tolerance: f64,
    /// Added to the diagonal of every covariance; 1e-4 is the square of 1 cm, of 10 mrad, and of a
    /// hundredth of the motion's time. With much less, motions change from one component to the
    /// next so quickly that simulated pours accelerate beyond what is valid.
    pub regularization: f64,
}

impl Default for TpGmmConfig {
    /// The paper's, where it says.
    fn default() -> Self {
        Self {
            steps: STEPS,
            components: 25,
            alignment_window: ALIGNMENT_WINDOW,
            max_iterations: 100,
            tolerance: 1e-4,
            regularization: 1e-4,
        }
    }
}

/// Largest entry of a covariance's inverse that parts may have: that of a standard deviation of 30
/// nanometres.
const LARGEST_PRECISION: f64 = 1e15;

/// A frame of a task: a state is `matrix * view + origin`.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// `A`, `[state_dim, state_dim]`, invertible.
    pub matrix: DMatrix<f64>,
    /// `b`, `[state_dim]`.
    pub origin: DVector<f64>,
}

impl Frame {
    /// The world's frame.
    pub fn world(state_dim: usize) -> Self {
        Self { matrix: DMatrix::identity(state_dim, state_dim), origin: DVector::zeros(state_dim) }
    }

    /// A frame that is moved to `location` in the first two values of the state.
    pub fn at(location: [f64; 2], state_dim: usize) -> Self {
        let mut frame = Self::world(state_dim);
        frame.origin.rows_mut(0, 2).copy_from_slice(&location);
        frame
    }

    /// The frames of a task: one at each of its locations, or the world's where it has none.
    pub fn of_task(w: &TaskParameters, state_dim: usize) -> Vec<Self> {
        let count = w.values().len() / 2;
        if count == 0 {
            return vec![Self::world(state_dim)];
        }
        (0..count).map(|i| Self::at(w.location(i), state_dim)).collect()
    }
}

/// A mixture with one Gaussian of `(time, state)` per component and frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct FramedGmm {
    mixture: Mixture,
}

impl FramedGmm {
    /// Fits the mixture to motions and the frames of each one's task; phase, from 0 to 1, is the
    /// time. It starts with components in equal slices of time, so nothing is drawn.
    ///
    /// # Errors
    /// Settings out of range; fewer samples than components; a frame whose matrix can't be
    /// inverted; a covariance that is not positive definite in spite of the regularization.
    ///
    /// # Panics
    /// Without motions, or when their tasks have other numbers of frames.
    pub fn fit(
        config: &TpGmmConfig,
        motions: &[Trajectory],
        frames: &[Vec<Frame>],
    ) -> Result<Self, PrimitiveError> {
        let TpGmmConfig {
            steps: _,
            components,
            alignment_window: _,
            max_iterations,
            tolerance,
            regularization,
        } = *config;
        let config = GmmConfig {
            components,
            initialization: Initialization::Slices,
            max_iterations,
            tolerance,
            regularization,
        };
        let samples: usize = motions.iter().map(Trajectory::steps).sum();
        config.check(samples)?;
        let dim = motions[0].dim();
        let block = |index: usize| {
            let mut block = DMatrix::zeros(1 + dim, samples);
            let mut column = 0;
            for (motion, frames) in motions.iter().zip(frames) {
                let Frame { matrix, origin } = &frames[index];
                let inverse =
                    matrix.clone().try_inverse().ok_or(PrimitiveError::NotPositiveDefinite {
                        matrix: "matrix of the frame",
                        index,
                    })?;
                for (t, state) in motion.states().enumerate() {
                    block[(0, column)] = t as f64 / (motion.steps() - 1) as f64;
                    let view = &inverse * (DVector::from_column_slice(state) - origin);
                    block.view_mut((1, column), (dim, 1)).copy_from(&view);
                    column += 1;
                }
            }
            Ok(block)
        };
        let count = frames[0].len();
        assert!(frames.iter().all(|f| f.len() == count), "as many frames for each motion");
        let blocks = (0..count).map(block).collect::<Result<Vec<_>, _>>()?;
        let start = slices(&blocks[0], components);
        Ok(Self { mixture: Mixture::fit(&config, &blocks, &start)? })
    }

    /// The mixture of `(time, state)` in the world for a task with these frames: each component is
    /// the product of its Gaussians, moved with their frames.
    ///
    /// # Errors
    /// A covariance that is not positive definite.
    ///
    /// # Panics
    /// When there are not as many frames as the mixture has.
    pub fn in_world(&self, frames: &[Frame]) -> Result<Gmm, PrimitiveError> {
        assert_eq!(frames.len(), self.mixture.frames.len(), "one frame for each of the mixture's");
        let component = |index: usize| {
            let error = PrimitiveError::NotPositiveDefinite { matrix: "covariance", index };
            let inverse = |m| Cholesky::new(m).map(|c| c.inverse()).ok_or(error.clone());
            let dim = self.mixture.frames[0][index].mean.len();
            let mut precision = DMatrix::zeros(dim, dim);
            let mut weighted = DVector::zeros(dim);
            for (frame, gaussians) in frames.iter().zip(&self.mixture.frames) {
                let Gaussian { mean, covariance } = &gaussians[index];
                // Time is the same in every frame.
                let mut matrix = DMatrix::identity(dim, dim);
                matrix.view_mut((1, 1), (dim - 1, dim - 1)).copy_from(&frame.matrix);
                let mut moved = &matrix * mean;
                let mut state = moved.rows_mut(1, dim - 1);
                state += &frame.origin;
                let own = inverse(&matrix * covariance * matrix.transpose())?;
                weighted += &own * moved;
                precision += own;
            }
            let covariance = inverse(precision)?;
            Ok(Gaussian { mean: &covariance * weighted, covariance })
        };
        let count = self.mixture.weights.len();
        Ok(Gmm {
            weights: self.mixture.weights.clone(),
            components: (0..count).map(component).collect::<Result<_, _>>()?,
        })
    }
}

/// The stored parts of a [`TpGmm`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Parts {
    task_space: TaskSpace,
    steps: usize,
    state_dim: usize,
    mixture: FramedGmm,
}

/// A task-parameterised Gaussian mixture, with a frame at each location of the task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Parts", into = "Parts")]
pub struct TpGmm {
    parts: Parts,
}

impl TpGmm {
    /// Fits the mixture to demonstrations.
    ///
    /// # Errors
    /// No demonstrations, or some of another task space or state; settings out of range; fewer
    /// samples than components; a covariance that is not positive definite in spite of the
    /// regularization.
    pub fn fit(
        config: &TpGmmConfig,
        space: &TaskSpace,
        demonstrations: &[Demonstration],
    ) -> Result<Self, PrimitiveError> {
        let steps = config.steps;
        let state_dim = check(space, steps, demonstrations, 1)?;
        check_window(config.alignment_window)?;
        let motions = prepared(steps, config.alignment_window, demonstrations);
        let frames: Vec<_> =
            demonstrations.iter().map(|d| Frame::of_task(&d.w, state_dim)).collect();
        let mixture = FramedGmm::fit(config, &motions, &frames)?;
        Self::try_from(Parts { task_space: space.clone(), steps, state_dim, mixture })
    }

    /// The mixture in its frames.
    pub fn mixture(&self) -> &FramedGmm {
        &self.parts.mixture
    }

    fn regression(&self, w: &TaskParameters) -> Result<Regression, PrimitiveError> {
        let Parts { state_dim, mixture, .. } = &self.parts;
        mixture.in_world(&Frame::of_task(w, *state_dim))?.regression(1)
    }
}

impl TryFrom<Parts> for TpGmm {
    type Error = PrimitiveError;

    fn try_from(parts: Parts) -> Result<Self, PrimitiveError> {
        let Parts { task_space, steps, state_dim, mixture: FramedGmm { mixture } } = &parts;
        let frames = (task_space.dim() / 2).max(1);
        let dim = state_dim.saturating_add(1);
        let fits = |g: &Gaussian| g.mean.len() == dim && g.covariance.shape() == (dim, dim);
        let narrow = |g: &Gaussian| {
            let inverse = Cholesky::new(g.covariance.clone()).map(|c| c.inverse());
            inverse.is_none_or(|m| !m.iter().all(|v| v.abs() <= LARGEST_PRECISION))
        };
        let components = mixture.weights.len();
        let wrong = if let Some(wrong) = wrong_sizes(task_space, *steps, *state_dim) {
            Some(wrong)
        } else if mixture.frames.len() != frames {
            Some(format!("{} frames for {frames} locations", mixture.frames.len()))
        } else if components == 0 || mixture.frames.iter().any(|f| f.len() != components) {
            Some(format!("not {components} Gaussians in each frame"))
        } else if !mixture.weights.iter().all(|w| *w > 0.0 && *w <= 1.0) {
            Some("a component's weight is outside (0, 1]".to_string())
        } else if !mixture.frames.iter().flatten().all(fits) {
            Some(format!("a Gaussian is not of {dim} values"))
        } else if let Some(wrong) = wrong_numbers(
            mixture.frames.iter().flatten().flat_map(|g| g.mean.iter().chain(&g.covariance)),
        ) {
            Some(wrong)
        } else if mixture.frames.iter().flatten().any(narrow) {
            Some("a covariance is not positive definite, or too narrow".to_string())
        } else {
            None
        };
        if let Some(detail) = wrong {
            return Err(PrimitiveError::Parts { primitive: "TP-GMM", detail });
        }
        let zero = TaskParameters::new(task_space, vec![0.0; task_space.dim()]);
        let tp_gmm = Self { parts };
        // The frames only move, so covariances are those of every other task too.
        tp_gmm.regression(&zero.expect("as many zeros as the space has values"))?;
        Ok(tp_gmm)
    }
}

impl From<TpGmm> for Parts {
    fn from(tp_gmm: TpGmm) -> Self {
        tp_gmm.parts
    }
}

impl MovementPrimitive for TpGmm {
    fn task_space(&self) -> &TaskSpace {
        &self.parts.task_space
    }

    fn steps(&self) -> usize {
        self.parts.steps
    }

    fn state_dim(&self) -> usize {
        self.parts.state_dim
    }

    fn generate(&self, w: &TaskParameters) -> Generated {
        let Parts { steps, state_dim, .. } = self.parts;
        let w = &bounded(self.task_space(), w);
        let regression = self.regression(w).expect("checked at construction");
        let (mut mean, mut variances) = (Vec::new(), Vec::new());
        for t in 0..steps {
            let state = regression.at(&[t as f64 / (steps - 1) as f64]);
            mean.extend(state.mean.iter());
            variances.extend(state.covariance.diagonal().iter());
        }
        generated(state_dim, mean, variances)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::primitives::tests::{demonstrations, largest_difference, space, task};

    fn fitted(config: &TpGmmConfig) -> TpGmm {
        TpGmm::fit(config, &space(2), &demonstrations(2, 20)).unwrap()
    }

    fn few() -> TpGmmConfig {
        TpGmmConfig { steps: 40, components: 8, regularization: 1e-6, ..TpGmmConfig::default() }
    }

    #[test]
    fn moving_the_task_moves_the_motion() {
        let tp_gmm = fitted(&few());
        let here = tp_gmm.generate(&task(&[0.3, 0.2, -0.4, 0.1]));
        let there = tp_gmm.generate(&task(&[1.3, -1.8, 0.6, -1.9]));
        for (a, b) in here.mean.states().zip(there.mean.states()) {
            for (i, by) in [1.0, -2.0, 0.0].into_iter().enumerate() {
                assert!((a[i] + by - b[i]).abs() < 1e-9);
            }
        }
        assert!(largest_difference(&here.stddev, &there.stddev) < 1e-9);
    }

    #[test]
    fn the_motion_goes_from_one_location_to_the_other() {
        let tp_gmm = fitted(&few());
        for w in [[0.3, 0.2, -0.4, 0.1], [0.0, 0.5, -0.5, -0.5]] {
            let mean = tp_gmm.generate(&task(&w)).mean;
            let (first, last) = (mean.state(0), mean.state(39));
            assert!((first[0] - w[2]).hypot(first[1] - w[3]) < 0.03, "{first:?}");
            assert!((last[0] - w[0]).hypot(last[1] - w[1]) < 0.03, "{last:?}");
        }
    }

    #[test]
    fn one_frame_at_the_origin_is_plain_regression_on_time() {
        let config = TpGmmConfig { steps: 30, ..few() };
        let demonstrations = demonstrations(0, 10);
        let tp_gmm = TpGmm::fit(&config, &space(0), &demonstrations).unwrap();
        let motions = prepared(30, ALIGNMENT_WINDOW, &demonstrations);
        let columns: Vec<DVector<f64>> = motions
            .iter()
            .flat_map(|m| m.states().enumerate())
            .map(|(t, s)| {
                DVector::from_iterator(4, [t as f64 / 29.0].into_iter().chain(s.iter().copied()))
            })
            .collect();
        let plain = GmmConfig { components: 8, ..GmmConfig::default() };
        let mut rng = <rand::rngs::ChaCha8Rng as rand::SeedableRng>::seed_from_u64(0);
        let gmm = Gmm::fit(&plain, &DMatrix::from_columns(&columns), &mut rng).unwrap();
        let regression = gmm.regression(1).unwrap();
        let Generated { mean, stddev, .. } = tp_gmm.generate(&task(&[]));
        for t in 0..30 {
            let expected = regression.at(&[t as f64 / 29.0]);
            for i in 0..3 {
                assert!((mean.state(t)[i] - expected.mean[i]).abs() < 1e-9);
                let deviation = expected.covariance[(i, i)].sqrt();
                assert!((stddev.state(t)[i] - deviation).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn storing_gives_the_same_primitive_and_odd_parts_are_refused() {
        let tp_gmm = fitted(&few());
        let text = serde_json::to_string(&tp_gmm).unwrap();
        assert_eq!(serde_json::from_str::<TpGmm>(&text).unwrap(), tp_gmm);
        let refused = |from: &str, to: &str| {
            let odd = text.replacen(from, to, 1);
            assert_ne!(odd, text);
            serde_json::from_str::<TpGmm>(&odd).unwrap_err().to_string()
        };
        let error = refused("\"state_dim\":3", "\"state_dim\":4");
        assert!(error.contains("a Gaussian is not of 5 values"), "{error}");
        let error = refused("\"steps\":40", "\"steps\":1");
        assert!(error.contains("1 steps of 3 values"), "{error}");
    }

    #[test]
    fn too_little_and_odd_data_are_refused() {
        let error = |demonstrations: &[Demonstration]| {
            TpGmm::fit(&few(), &space(2), demonstrations).unwrap_err().to_string()
        };
        assert_eq!(error(&[]), "0 demonstrations where at least 1 are needed; record more");
        let mut odd = demonstrations(2, 3);
        odd[1].w = task(&[0.0, 0.0]);
        assert_eq!(error(&odd), "demonstration 1 has 2 task parameters where 4 are needed");
        let many = TpGmmConfig { components: 1000, ..few() };
        let refused = TpGmm::fit(&many, &space(2), &demonstrations(2, 3));
        assert!(matches!(refused, Err(PrimitiveError::TooFew { found: 120, needed: 1000, .. })));
    }
}
