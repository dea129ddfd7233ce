//! Our variant's learned prior: a mixture of Gaussians fitted to the latents that the
//! demonstrations are encoded as, in place of N(0, I), and the map that makes manner parameters of
//! it which are standard normal all the same.
//!
//! The paper's prior is where the posteriors are pulled to, not where they end: between and beyond
//! them lie manners that nobody showed, and samples from there decode to motions that are none.
//! The mixture knows where people's manners lie. Its triangular (Knothe-Rosenblatt) map takes one
//! value after the other to the quantile of its conditional distribution given those before it, so
//! it is invertible, smooth, and exact: a manner parameter stays independent of the others and of
//! the task, and says how usual its value is. Not in the paper.

use nalgebra::{Cholesky, DMatrix, DVector};
use rand::Rng;
use statrs::distribution::{ContinuousCDF, Normal};

use super::layout::{WeightsError, checked};
use super::{ModelError, NamedTensor, Weights};
use crate::primitives::PrimitiveError;
use crate::primitives::gmm::{Gaussian, Gmm, GmmConfig, Initialization};

const WEIGHTS: &str = "prior.weights";
const MEANS: &str = "prior.means";
const FACTORS: &str = "prior.factors";

/// Added to the variances of the fitted mixture, in squared units of the latents.
const REGULARIZATION: f64 = 1e-4;
/// Components with less of the conditional weight than this are passed over.
const NEGLIGIBLE: f64 = 1e-12;
/// Quantiles are taken no nearer to 0 and 1, which is beyond 8 standard deviations.
const TAIL: f64 = 1e-16;
/// Steps that find a quantile; each at least halves the bracket.
const STEPS: usize = 60;

/// A prior of the latents that was learned from their posteriors. Among a model's tensors:
/// `prior.weights`, `[components]`, `prior.means`, `[components, latents]`, and `prior.factors`,
/// `[components, latents, latents]`, the lower Cholesky factors of the covariances.
#[derive(Debug, Clone, PartialEq)]
pub struct LearnedPrior {
    latents: usize,
    components: Vec<Component>,
}

#[derive(Debug, Clone, PartialEq)]
struct Component {
    weight: f64,
    mean: Vec<f64>,
    /// Rows of the lower Cholesky factor, `[latents, latents]`.
    factor: Vec<f64>,
}

/// The mixture given the latents so far.
struct Conditional<'a> {
    prior: &'a LearnedPrior,
    /// Logarithm of each component's weight times its density at the latents so far.
    log_weights: Vec<f64>,
    /// The latents so far, whitened by each component.
    whitened: Vec<Vec<f64>>,
    normal: Normal,
}

/// The next latent's distribution: shares, means and deviations.
struct Next(Vec<[f64; 3]>);

impl LearnedPrior {
    /// Fits a prior to samples of the latents, one vector each.
    ///
    /// # Errors
    /// Fewer samples than components.
    ///
    /// # Panics
    /// Without samples, or when they differ in length.
    pub fn fit<R: Rng + ?Sized>(
        samples: &[Vec<f64>],
        components: usize,
        rng: &mut R,
    ) -> Result<Self, PrimitiveError> {
        let config = GmmConfig {
            components,
            initialization: Initialization::KMeansPlusPlus,
            regularization: REGULARIZATION,
            ..GmmConfig::default()
        };
        let columns: Vec<_> = samples.iter().map(|s| DVector::from_column_slice(s)).collect();
        let Gmm { weights, components } = Gmm::fit(&config, &DMatrix::from_columns(&columns), rng)?;
        let component = |(weight, Gaussian { mean, covariance }): (f64, Gaussian)| {
            let factor = Cholesky::new(covariance).expect("a fitted covariance").l();
            // As a file holds them, so that a model that is saved and read is the same.
            let stored = |values: &[f64]| values.iter().map(|v| f64::from(*v as f32)).collect();
            Component {
                weight: f64::from(weight as f32),
                mean: stored(mean.as_slice()),
                factor: stored(factor.transpose().as_slice()),
            }
        };
        let components = weights.into_iter().zip(components).map(component).collect();
        Ok(Self { latents: samples[0].len(), components })
    }

    /// The prior among a model's tensors.
    ///
    /// # Errors
    /// A tensor that is missing or has a wrong shape; shares or deviations that are not above 0.
    pub fn from_weights(
        latents: usize,
        components: usize,
        weights: &Weights,
    ) -> Result<Self, ModelError> {
        let values = |name, shape: &[usize]| -> Result<Vec<f64>, WeightsError> {
            Ok(checked(weights, name, shape)?.values.iter().map(|v| f64::from(*v)).collect())
        };
        let shares = values(WEIGHTS, &[components])?;
        let means = values(MEANS, &[components, latents])?;
        let factors = values(FACTORS, &[components, latents, latents])?;
        let parts = means.chunks_exact(latents).zip(factors.chunks_exact(latents * latents));
        let component = |(&weight, (mean, factor)): (&f64, (&[f64], &[f64]))| Component {
            weight,
            mean: mean.to_vec(),
            factor: factor.to_vec(),
        };
        let components: Vec<_> = shares.iter().zip(parts).map(component).collect();
        let positive = |c: &Component| {
            c.weight >= 0.0 && (0..latents).all(|i| c.factor[i * latents + i] > 0.0)
        };
        let total: f64 = shares.iter().sum();
        if !components.iter().all(positive) || (total - 1.0).abs() > 1e-3 {
            return Err(ModelError::Prior { total });
        }
        Ok(Self { latents, components })
    }

    /// Adds the prior's tensors to a model's.
    pub fn add_to(&self, weights: &mut Weights) {
        let (k, n) = (self.components.len(), self.latents);
        let mut add = |name: &str, shape: Vec<usize>, of: &dyn Fn(&Component) -> Vec<f64>| {
            let values = self.components.iter().flat_map(of).map(|v| v as f32).collect();
            weights.insert(name.into(), NamedTensor { shape, values });
        };
        add(WEIGHTS, vec![k], &|c| vec![c.weight]);
        add(MEANS, vec![k, n], &|c| c.mean.clone());
        add(FACTORS, vec![k, n, n], &|c| c.factor.clone());
    }

    /// The latents of manner parameters, which are standard normal where latents follow this prior.
    pub fn latents(&self, manner: &[f64]) -> Vec<f64> {
        let mut conditional = Conditional::new(self);
        let latent = |(i, manner): (usize, &f64)| {
            let latent = conditional.next(i).quantile(&conditional.normal, *manner);
            conditional.fix(i, latent);
            latent
        };
        manner.iter().enumerate().map(latent).collect()
    }

    /// The manner parameters of latents: the inverse of [`Self::latents`].
    pub fn manner(&self, latents: &[f64]) -> Vec<f64> {
        let mut conditional = Conditional::new(self);
        let manner = |(i, latent): (usize, &f64)| {
            let share = conditional.next(i).share(&conditional.normal, *latent);
            conditional.fix(i, *latent);
            conditional.normal.inverse_cdf(share.clamp(TAIL, 1.0 - TAIL))
        };
        latents.iter().enumerate().map(manner).collect()
    }
}

impl<'a> Conditional<'a> {
    fn new(prior: &'a LearnedPrior) -> Self {
        let log_weights = prior.components.iter().map(|c| c.weight.ln()).collect();
        let whitened = vec![Vec::with_capacity(prior.latents); prior.components.len()];
        Self { prior, log_weights, whitened, normal: Normal::standard() }
    }

    /// Mean and deviation of latent `i` in component `k`.
    fn moments(&self, k: usize, i: usize) -> [f64; 2] {
        let Component { mean, factor, .. } = &self.prior.components[k];
        let row = &factor[i * self.prior.latents..];
        let shift: f64 = row.iter().zip(&self.whitened[k]).map(|(l, z)| l * z).sum();
        [mean[i] + shift, row[i]]
    }

    /// The distribution of latent `i`, given those before it.
    fn next(&self, i: usize) -> Next {
        let most = self.log_weights.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let shares: Vec<f64> = self.log_weights.iter().map(|w| (w - most).exp()).collect();
        let total: f64 = shares.iter().sum();
        let parts = shares.iter().enumerate().filter(|(_, share)| **share > NEGLIGIBLE * total);
        let part = |(k, share): (usize, &f64)| {
            let [mean, deviation] = self.moments(k, i);
            [share / total, mean, deviation]
        };
        Next(parts.map(part).collect())
    }

    fn fix(&mut self, i: usize, latent: f64) {
        for k in 0..self.whitened.len() {
            let [mean, deviation] = self.moments(k, i);
            let z = (latent - mean) / deviation;
            self.log_weights[k] -= 0.5 * z * z + deviation.ln();
            self.whitened[k].push(z);
        }
    }
}

impl Next {
    /// Share of the distribution below a value.
    fn share(&self, normal: &Normal, value: f64) -> f64 {
        self.0.iter().map(|[p, mean, deviation]| p * normal.cdf((value - mean) / deviation)).sum()
    }

    fn density(&self, value: f64) -> f64 {
        let of = |[p, mean, deviation]: &[f64; 3]| {
            let z = (value - mean) / deviation;
            p / deviation * (-0.5 * z * z).exp() / std::f64::consts::TAU.sqrt()
        };
        self.0.iter().map(of).sum()
    }

    /// The value below which the share of the standard normal distribution below `z` lies: Newton's
    /// method inside a bracket that shrinks.
    fn quantile(&self, normal: &Normal, z: f64) -> f64 {
        let of_part = |[_, mean, deviation]: &[f64; 3]| mean + deviation * z;
        let mut low = self.0.iter().map(of_part).fold(f64::INFINITY, f64::min);
        let mut high = self.0.iter().map(of_part).fold(f64::NEG_INFINITY, f64::max);
        let target = normal.cdf(z);
        let mut value = 0.5 * (low + high);
        for _ in 0..STEPS {
            let excess = self.share(normal, value) - target;
            *(if excess < 0.0 { &mut low } else { &mut high }) = value;
            let step = value - excess / self.density(value);
            let next = if low < step && step < high { step } else { 0.5 * (low + high) };
            if (next - value).abs() <= 1e-12 * (1.0 + value.abs()) {
                return next;
            }
            value = next;
        }
        value
    }
}

#[cfg(test)]
mod tests {
    use std::sync::LazyLock;

    use super::*;
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    /// Points around a ring, which no normal distribution describes, and one value beside them.
    fn ring(count: usize, seed: u64) -> Vec<Vec<f64>> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let point = |_| {
            let (x, y, noise) = (normal(), normal(), 0.05 * normal());
            let radius = (1.0 + noise) / f64::hypot(x, y);
            vec![radius * x, radius * y, 0.5 * radius * x + 0.2 * normal()]
        };
        (0..count).map(point).collect()
    }

    fn fitted() -> &'static LearnedPrior {
        static FITTED: LazyLock<LearnedPrior> = LazyLock::new(|| {
            LearnedPrior::fit(&ring(3000, 1), 16, &mut ChaCha8Rng::seed_from_u64(2)).unwrap()
        });
        &FITTED
    }

    #[test]
    fn drawn_manners_lie_where_the_latents_lay() {
        let prior = fitted();
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let draw = |_| {
            let manner: Vec<f64> = StandardNormal.sample_iter(&mut rng).take(3).collect();
            prior.latents(&manner)
        };
        let drawn: Vec<_> = (0..2000).map(draw).collect();
        let off = |h: &Vec<f64>| (h[0].hypot(h[1]) - 1.0).abs();
        let near = drawn.iter().filter(|h| off(h) < 0.25).count();
        assert!(near > 1960, "{near} of 2000 on the ring");
        // All around it.
        for quadrant in [[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]] {
            let inside = |h: &&Vec<f64>| h[0] * quadrant[0] > 0.0 && h[1] * quadrant[1] > 0.0;
            let share = drawn.iter().filter(inside).count() as f64 / 2000.0;
            assert!((share - 0.25).abs() < 0.05, "{quadrant:?} {share}");
        }
    }

    #[test]
    fn manners_of_fresh_latents_are_standard_normal_and_independent() {
        let prior = fitted();
        let manners: Vec<_> = ring(4000, 4).iter().map(|h| prior.manner(h)).collect();
        let mean = |of: &dyn Fn(&Vec<f64>) -> f64| manners.iter().map(of).sum::<f64>() / 4000.0;
        for i in 0..3 {
            assert!(mean(&|u| u[i]).abs() < 0.08, "{i} {}", mean(&|u| u[i]));
            let square = mean(&|u| u[i] * u[i]);
            assert!((square - 1.0).abs() < 0.12, "{i} {square}");
            for j in 0..i {
                assert!(mean(&|u| u[i] * u[j]).abs() < 0.08);
                // Not only uncorrelated: the ring's values are that already.
                let squares = mean(&|u| (u[i] * u[i] - 1.0) * (u[j] * u[j] - 1.0));
                assert!(squares.abs() < 0.25, "{i} {j} {squares}");
            }
        }
    }

    #[test]
    fn a_prior_survives_the_weights() {
        let prior = fitted();
        let mut weights = Weights::new();
        prior.add_to(&mut weights);
        assert_eq!(&LearnedPrior::from_weights(3, 16, &weights).unwrap(), prior);
        assert!(LearnedPrior::from_weights(3, 17, &weights).is_err());
        weights.get_mut(WEIGHTS).unwrap().values[0] = 3.0;
        let error = LearnedPrior::from_weights(3, 16, &weights).unwrap_err();
        assert!(error.to_string().contains("add up to"), "{error}");
    }

    proptest! {
        #[test]
        fn latents_and_manners_are_inverse(
            manner in prop::collection::vec(-3.0..3.0f64, 3),
        ) {
            let prior = fitted();
            let back = prior.manner(&prior.latents(&manner));
            for (a, b) in manner.iter().zip(&back) {
                prop_assert!((a - b).abs() < 1e-6, "{:?} {:?}", manner, back);
            }
        }
    }
}
