//! Gaussian mixtures: fitted by expectation maximisation, and asked for some values given others
//! (Gaussian mixture regression; Z. Ghahramani and M. I. Jordan, *Supervised learning from
//! incomplete data via an EM approach*, NIPS 1993).
//!
//! One implementation of the optimisation serves plain mixtures and the task-parameterised ones of
//! [`super::tp_gmm`], where a component has one Gaussian per frame and all frames share the
//! responsibilities; a plain mixture is the case of one frame.
//!
//! Samples are the columns of a matrix, shape `[dim, samples]`.

use std::f64::consts::TAU;

use nalgebra::{Cholesky, DMatrix, DVector};
use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};

use super::PrimitiveError;

/// A normal distribution.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Gaussian {
    /// Its mean, `[dim]`.
    pub mean: DVector<f64>,
    /// Its covariance, `[dim, dim]`.
    #[serde(with = "super::matrix")]
    pub covariance: DMatrix<f64>,
}

/// A normal distribution, prepared for its density: `log p(x) = constant - |whitening x - center|^2
/// / 2`.
#[derive(Debug, Clone)]
struct Density {
    /// Inverse of the covariance's Cholesky factor.
    whitening: DMatrix<f64>,
    /// The mean, whitened.
    center: DVector<f64>,
    constant: f64,
}

impl Density {
    /// None when the covariance is not positive definite.
    fn new(gaussian: &Gaussian) -> Option<Self> {
        let lower = Cholesky::new(gaussian.covariance.clone())?.l();
        let dim = lower.nrows();
        let half_log_determinant: f64 = lower.diagonal().iter().map(|v| v.ln()).sum();
        let whitening = lower.solve_lower_triangular(&DMatrix::identity(dim, dim))?;
        let center = &whitening * &gaussian.mean;
        let constant = -0.5 * dim as f64 * TAU.ln() - half_log_determinant;
        Some(Self { whitening, center, constant })
    }

    /// Logarithms of the density at each column of `samples`, `[dim, samples]`.
    fn logarithms(&self, samples: &DMatrix<f64>) -> DVector<f64> {
        let whitened = &self.whitening * samples;
        let logarithm = |column: &[f64]| {
            let pairs = column.iter().zip(self.center.as_slice());
            self.constant - 0.5 * pairs.map(|(a, b)| (a - b) * (a - b)).sum::<f64>()
        };
        let columns = whitened.as_slice().chunks_exact(self.center.len());
        DVector::from_iterator(samples.ncols(), columns.map(logarithm))
    }
}

/// Where the optimisation starts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Initialization {
    /// Equal slices of the first value's range, which is time.
    #[default]
    Slices,
    /// The samples nearest to each of the seeds that k-means++ draws.
    KMeansPlusPlus,
}

/// How a mixture is fitted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GmmConfig {
    /// Number of Gaussians.
    pub components: usize,
    /// Where the optimisation starts.
    pub initialization: Initialization,
    /// Most steps of the optimisation.
    pub max_iterations: usize,
    /// Change of the mean log-likelihood (nat per sample) below which the optimisation ends.
    pub tolerance: f64,
    /// Added to the diagonal of every covariance, in the squared unit of its value.
    pub regularization: f64,
}

impl Default for GmmConfig {
    fn default() -> Self {
        Self {
            components: 25,
            initialization: Initialization::Slices,
            max_iterations: 100,
            tolerance: 1e-4,
            regularization: 1e-6,
        }
    }
}

impl GmmConfig {
    /// Checks the settings, for a mixture of `samples` samples.
    pub(super) fn check(&self, samples: usize) -> Result<(), PrimitiveError> {
        let Self { components, initialization: _, max_iterations: _, tolerance, regularization } =
            self;
        let error = |name, value, range| Err(PrimitiveError::Setting { name, value, range });
        if *components == 0 {
            return error("components", 0.0, "at least 1");
        }
        if !tolerance.is_finite() {
            return error("tolerance", *tolerance, "finite");
        }
        if !(0.0..=1e6).contains(regularization) {
            return error("regularization", *regularization, "from 0 to 1e6");
        }
        if samples < *components {
            let (what, remedy) = ("samples", "add some, or lower components");
            let (found, needed) = (samples, *components);
            return Err(PrimitiveError::TooFew { what, found, needed, remedy });
        }
        Ok(())
    }
}

/// A mixture of Gaussians.
#[derive(Debug, Clone, PartialEq)]
pub struct Gmm {
    /// Share of each component; they sum to 1.
    pub weights: Vec<f64>,
    /// The components, all of the same dimension.
    pub components: Vec<Gaussian>,
}

impl Gmm {
    /// Fits a mixture to `samples`, `[dim, samples]`.
    ///
    /// # Errors
    /// Settings out of range; fewer samples than components; a covariance that is not positive
    /// definite in spite of the regularization.
    pub fn fit<R: Rng + ?Sized>(
        config: &GmmConfig,
        samples: &DMatrix<f64>,
        rng: &mut R,
    ) -> Result<Self, PrimitiveError> {
        config.check(samples.ncols())?;
        let start = match config.initialization {
            Initialization::Slices => slices(samples, config.components),
            Initialization::KMeansPlusPlus => nearest_seeds(samples, config.components, rng),
        };
        let blocks = std::slice::from_ref(samples);
        Ok(Mixture::fit(config, blocks, &start)?.into_plain())
    }

    /// One step of the optimisation, expectation then maximisation, on `samples`,
    /// `[dim, samples]`.
    ///
    /// # Errors
    /// A covariance that is not positive definite.
    pub fn stepped(
        &self,
        samples: &DMatrix<f64>,
        regularization: f64,
    ) -> Result<Self, PrimitiveError> {
        let blocks = std::slice::from_ref(samples);
        let Expectation { responsibilities, .. } = self.mixture().expectation(blocks)?;
        Ok(Mixture::maximization(blocks, &responsibilities, regularization).into_plain())
    }

    /// Mean logarithm of the density of `samples`, `[dim, samples]`, in nat per sample.
    ///
    /// # Errors
    /// A covariance that is not positive definite.
    pub fn mean_log_likelihood(&self, samples: &DMatrix<f64>) -> Result<f64, PrimitiveError> {
        Ok(self.mixture().expectation(std::slice::from_ref(samples))?.mean_log_likelihood)
    }

    /// Bayesian information criterion on `samples`, `[dim, samples]`; of two mixtures the one with
    /// less is to be preferred.
    ///
    /// # Errors
    /// A covariance that is not positive definite.
    pub fn bic(&self, samples: &DMatrix<f64>) -> Result<f64, PrimitiveError> {
        let (count, dim) = (self.weights.len(), samples.nrows());
        let free = count * (dim + dim * (dim + 1) / 2) + count - 1;
        let n = samples.ncols() as f64;
        Ok(-2.0 * n * self.mean_log_likelihood(samples)? + free as f64 * n.ln())
    }

    /// Prepares the regression of the other values on the first `inputs` ones.
    ///
    /// # Errors
    /// A covariance of the inputs that is not positive definite.
    ///
    /// # Panics
    /// When no value remains to be predicted.
    pub fn regression(&self, inputs: usize) -> Result<Regression, PrimitiveError> {
        let conditional = |(index, (weight, gaussian)): (usize, (&f64, &Gaussian))| {
            let Gaussian { mean, covariance } = gaussian;
            let outputs = mean.len().checked_sub(inputs).filter(|o| *o > 0);
            let outputs = outputs.expect("a value that remains to be predicted");
            let of_inputs = covariance.view((0, 0), (inputs, inputs)).into_owned();
            let across = covariance.view((inputs, 0), (outputs, inputs));
            let input_mean = mean.rows(0, inputs).into_owned();
            let input = Gaussian { mean: input_mean, covariance: of_inputs };
            let Some(density) = Density::new(&input) else {
                let matrix = "covariance of the inputs";
                return Err(PrimitiveError::NotPositiveDefinite { matrix, index });
            };
            // across cov^-1, with cov^-1 = whitening^T whitening.
            let gain = across * density.whitening.transpose() * &density.whitening;
            let remaining = covariance.view((inputs, inputs), (outputs, outputs));
            Ok(Conditional {
                log_weight: weight.ln(),
                input_mean: input.mean,
                density,
                output_mean: mean.rows(inputs, outputs).into_owned(),
                covariance: remaining - &gain * across.transpose(),
                gain,
            })
        };
        let parts = self.weights.iter().zip(&self.components).enumerate();
        Ok(Regression { conditionals: parts.map(conditional).collect::<Result<_, _>>()? })
    }

    fn mixture(&self) -> Mixture {
        Mixture { weights: self.weights.clone(), frames: vec![self.components.clone()] }
    }
}

/// A component, conditioned on its inputs.
#[derive(Debug, Clone)]
struct Conditional {
    log_weight: f64,
    input_mean: DVector<f64>,
    density: Density,
    output_mean: DVector<f64>,
    gain: DMatrix<f64>,
    covariance: DMatrix<f64>,
}

/// The distribution of a mixture's other values given its first ones.
#[derive(Debug, Clone)]
pub struct Regression {
    conditionals: Vec<Conditional>,
}

impl Regression {
    /// Mean and covariance of the outputs at `input`: those of the whole conditional mixture, the
    /// spread of its components' means among them.
    ///
    /// # Panics
    /// When `input` is not as long as what the regression was prepared for.
    pub fn at(&self, input: &[f64]) -> Gaussian {
        let input = DVector::from_column_slice(input);
        let column = DMatrix::from_column_slice(input.len(), 1, input.as_slice());
        let log_density = |c: &Conditional| c.log_weight + c.density.logarithms(&column)[0];
        let mut shares = DVector::from_iterator(
            self.conditionals.len(),
            self.conditionals.iter().map(log_density),
        );
        normalize_logarithms(shares.as_mut_slice());
        let means: Vec<DVector<f64>> = self
            .conditionals
            .iter()
            .map(|c| &c.output_mean + &c.gain * (&input - &c.input_mean))
            .collect();
        let dim = means[0].len();
        let mut mean = DVector::zeros(dim);
        means.iter().zip(shares.iter()).for_each(|(m, share)| mean.axpy(*share, m, 1.0));
        let mut covariance = DMatrix::zeros(dim, dim);
        for ((c, component_mean), &share) in self.conditionals.iter().zip(&means).zip(&shares) {
            let apart = component_mean - &mean;
            covariance += &c.covariance * share;
            covariance.ger(share, &apart, &apart, 1.0);
        }
        Gaussian { mean, covariance }
    }
}

/// Turns logarithms of shares into shares that sum to 1, and returns the logarithm of their sum.
fn normalize_logarithms(logarithms: &mut [f64]) -> f64 {
    let largest = logarithms.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let sum: f64 = logarithms.iter().map(|v| (v - largest).exp()).sum();
    let log_sum = largest + sum.ln();
    logarithms.iter_mut().for_each(|v| *v = (*v - log_sum).exp());
    log_sum
}

/// A mixture whose components have one Gaussian in each frame, independent of each other given the
/// component.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Mixture {
    /// Share of each component.
    pub(super) weights: Vec<f64>,
    /// The Gaussians: one list of components for each frame.
    pub(super) frames: Vec<Vec<Gaussian>>,
}

/// Which component each sample is of.
struct Expectation {
    mean_log_likelihood: f64,
    /// `[components, samples]`; each column sums to 1.
    responsibilities: DMatrix<f64>,
}

impl Mixture {
    /// Fits a mixture to `blocks`, the same samples seen from each frame, `[dim, samples]` each,
    /// starting with the responsibilities `start`, `[components, samples]`. The caller has checked
    /// the settings.
    pub(super) fn fit(
        config: &GmmConfig,
        blocks: &[DMatrix<f64>],
        start: &DMatrix<f64>,
    ) -> Result<Self, PrimitiveError> {
        let mut mixture = Self::maximization(blocks, start, config.regularization);
        let mut before = f64::NEG_INFINITY;
        for _ in 0..config.max_iterations {
            let Expectation { mean_log_likelihood, responsibilities } =
                mixture.expectation(blocks)?;
            if (mean_log_likelihood - before).abs() < config.tolerance {
                break;
            }
            before = mean_log_likelihood;
            mixture = Self::maximization(blocks, &responsibilities, config.regularization);
        }
        Ok(mixture)
    }

    fn expectation(&self, blocks: &[DMatrix<f64>]) -> Result<Expectation, PrimitiveError> {
        let samples = blocks[0].ncols();
        let mut responsibilities = DMatrix::zeros(self.weights.len(), samples);
        for (index, weight) in self.weights.iter().enumerate() {
            let mut log_densities = DVector::from_element(samples, weight.ln());
            for (frame, block) in self.frames.iter().zip(blocks) {
                let density = Density::new(&frame[index]);
                let error = PrimitiveError::NotPositiveDefinite { matrix: "covariance", index };
                log_densities += density.ok_or(error)?.logarithms(block);
            }
            responsibilities.set_row(index, &log_densities.transpose());
        }
        let mut log_likelihood = 0.0;
        for mut column in responsibilities.column_iter_mut() {
            log_likelihood += normalize_logarithms(column.as_mut_slice());
        }
        Ok(Expectation { mean_log_likelihood: log_likelihood / samples as f64, responsibilities })
    }

    fn maximization(
        blocks: &[DMatrix<f64>],
        responsibilities: &DMatrix<f64>,
        regularization: f64,
    ) -> Self {
        // As scikit-learn does, so that a component which no sample is of stays a number.
        let counts: Vec<f64> =
            responsibilities.row_iter().map(|r| r.sum() + 10.0 * f64::EPSILON).collect();
        let total: f64 = counts.iter().sum();
        let gaussian = |block: &DMatrix<f64>, index: usize| {
            let shares = responsibilities.row(index).transpose();
            let mean = block * &shares / counts[index];
            let mut apart = block.clone();
            let columns = apart.as_mut_slice().chunks_exact_mut(block.nrows());
            for (column, share) in columns.zip(shares.as_slice()) {
                let root = share.sqrt();
                column.iter_mut().zip(mean.as_slice()).for_each(|(v, m)| *v = (*v - m) * root);
            }
            let mut covariance = &apart * apart.transpose() / counts[index];
            for i in 0..block.nrows() {
                covariance[(i, i)] += regularization;
            }
            Gaussian { mean, covariance }
        };
        let frame = |block| (0..counts.len()).map(|index| gaussian(block, index)).collect();
        Self {
            frames: blocks.iter().map(frame).collect(),
            weights: counts.iter().map(|c| c / total).collect(),
        }
    }

    fn into_plain(mut self) -> Gmm {
        let components = self.frames.pop().expect("a mixture has a frame");
        Gmm { weights: self.weights, components }
    }
}

/// Responsibilities `[components, samples]`: each sample is of the slice of the first value's
/// range that it lies in.
pub(super) fn slices(samples: &DMatrix<f64>, components: usize) -> DMatrix<f64> {
    let first = samples.row(0);
    let (lower, upper) = (first.min(), first.max());
    let slice = |v: f64| {
        let share = (v - lower) / (upper - lower).max(f64::MIN_POSITIVE);
        ((share * components as f64) as usize).min(components.saturating_sub(1))
    };
    assignment(components, first.iter().map(|v| slice(*v)).collect())
}

/// Responsibilities `[components, samples]`: each sample is of the nearest of the seeds, which are
/// samples drawn with a probability in proportion to their squared distance from the seeds before
/// (D. Arthur and S. Vassilvitskii, *k-means++: The Advantages of Careful Seeding*, 2007).
fn nearest_seeds<R: Rng + ?Sized>(
    samples: &DMatrix<f64>,
    components: usize,
    rng: &mut R,
) -> DMatrix<f64> {
    let count = samples.ncols();
    let mut nearest = vec![0; count];
    let mut distances = vec![f64::INFINITY; count];
    let mut seed = rng.random_range(0..count);
    for component in 0..components {
        for (i, column) in samples.column_iter().enumerate() {
            let distance = (column - samples.column(seed)).norm_squared();
            if distance < distances[i] {
                (distances[i], nearest[i]) = (distance, component);
            }
        }
        let mut left = rng.random::<f64>() * distances.iter().sum::<f64>();
        seed = distances
            .iter()
            .position(|d| {
                left -= d;
                left < 0.0
            })
            .unwrap_or(count - 1);
    }
    assignment(components, nearest)
}

fn assignment(components: usize, of: Vec<usize>) -> DMatrix<f64> {
    let mut responsibilities = DMatrix::zeros(components, of.len());
    of.iter().enumerate().for_each(|(i, component)| responsibilities[(*component, i)] = 1.0);
    responsibilities
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;
    use rand_distr::StandardNormal;

    /// Three clusters in the plane, 200 samples each.
    fn clusters(rng: &mut ChaCha8Rng) -> DMatrix<f64> {
        let centers = [[0.0, 0.0], [4.0, 1.0], [1.0, 5.0]];
        let mut sample = |i: usize| {
            let [x, y] = centers[i % 3];
            let mut noise = || 0.5 * rng.sample::<f64, _>(StandardNormal);
            DVector::from_vec(vec![x + noise(), y + noise()])
        };
        DMatrix::from_columns(&(0..600).map(&mut sample).collect::<Vec<_>>())
    }

    fn config(components: usize) -> GmmConfig {
        let initialization = Initialization::KMeansPlusPlus;
        GmmConfig { components, initialization, ..GmmConfig::default() }
    }

    #[test]
    fn clusters_are_found_and_bic_counts_them() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let samples = clusters(&mut rng);
        let gmm = Gmm::fit(&config(3), &samples, &mut rng).unwrap();
        for center in [[0.0, 0.0], [4.0, 1.0], [1.0, 5.0]] {
            let center = DVector::from_column_slice(&center);
            let nearest = gmm.components.iter().map(|c| (&c.mean - &center).norm());
            assert!(nearest.fold(f64::INFINITY, f64::min) < 0.1);
        }
        for (weight, component) in gmm.weights.iter().zip(&gmm.components) {
            assert!((weight - 1.0 / 3.0).abs() < 0.01);
            assert!((component.covariance[(0, 0)] - 0.25).abs() < 0.06);
        }
        let mut bic = |components| {
            Gmm::fit(&config(components), &samples, &mut rng).unwrap().bic(&samples).unwrap()
        };
        let scores = [bic(1), bic(2), gmm.bic(&samples).unwrap(), bic(6)];
        let least = scores.iter().copied().fold(f64::INFINITY, f64::min);
        assert_eq!(least, scores[2], "{scores:?}");
    }

    #[test]
    fn every_step_gains_likelihood() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let samples = clusters(&mut rng);
        let start = GmmConfig { max_iterations: 0, ..config(4) };
        let mut gmm = Gmm::fit(&start, &samples, &mut rng).unwrap();
        let mut before = gmm.mean_log_likelihood(&samples).unwrap();
        for _ in 0..20 {
            gmm = gmm.stepped(&samples, 0.0).unwrap();
            let after = gmm.mean_log_likelihood(&samples).unwrap();
            assert!(after >= before - 1e-12, "{before} {after}");
            before = after;
        }
    }

    #[test]
    fn the_same_seed_gives_the_same_mixture() {
        let samples = clusters(&mut ChaCha8Rng::seed_from_u64(5));
        let fit = |seed| Gmm::fit(&config(5), &samples, &mut ChaCha8Rng::seed_from_u64(seed));
        assert_eq!(fit(1).unwrap(), fit(1).unwrap());
        assert_ne!(fit(1).unwrap(), fit(2).unwrap());
    }

    #[test]
    fn regression_far_from_every_sample_is_still_a_number() {
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let gmm = Gmm::fit(&config(3), &clusters(&mut rng), &mut rng).unwrap();
        let Gaussian { mean, covariance } = gmm.regression(1).unwrap().at(&[1e6]);
        assert!(mean[0].is_finite() && covariance[(0, 0)] > 0.0);
    }

    #[test]
    fn samples_without_spread_are_refused_unless_regularized() {
        let samples = DMatrix::from_element(2, 50, 1.0);
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let bare = GmmConfig { regularization: 0.0, ..config(2) };
        assert_eq!(
            Gmm::fit(&bare, &samples, &mut rng).unwrap_err().to_string(),
            "the covariance of part 0 is not positive definite; raise the regularization, or use \
             fewer components or weights"
        );
        assert!(Gmm::fit(&config(2), &samples, &mut rng).is_ok());
        assert!(matches!(
            Gmm::fit(&config(51), &samples, &mut rng),
            Err(PrimitiveError::TooFew { found: 50, needed: 51, .. })
        ));
        assert!(Gmm::fit(&config(0), &samples, &mut rng).is_err());
    }
}
