//! Which epoch's model is kept: the one whose samples on the validation set are robust and valid
//! most often, under floors that a collapsed model does not pass. The validation set's ELBO would
//! rank models nearly backwards.

use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use rayon::prelude::*;

use super::config::TrainingConfig;
use crate::demonstrations::{Demonstration, Task};
use crate::model::{ModelConfig, Normalizer, TcVaePrimitive, Weights};
use crate::parameters::MannerSpace;
use crate::primitive::MannerConditioned;

/// Validation demonstrations whose tasks are sampled, at most; the first ones, which augmentation
/// puts before their copies.
const CASES: usize = 200;
/// Bound of the manners that are sampled, in standard deviations of the prior.
const BOUND: f64 = 3.0;

/// Counts samples that are robust and valid.
#[derive(Debug)]
pub(super) struct Selector<'a> {
    task: &'a dyn Task,
    cases: &'a [Demonstration],
    samples: usize,
    threshold: f64,
    min_active_latents: usize,
    after_epochs: usize,
    duration_secs: f64,
    seed: u64,
}

impl<'a> Selector<'a> {
    /// The selector that the settings ask for; none where the last epoch is to be kept.
    pub(super) fn new(
        config: &TrainingConfig,
        task: &'a dyn Task,
        validation: &'a [Demonstration],
    ) -> Option<Self> {
        let cases = &validation[..validation.len().min(CASES)];
        let mut durations: Vec<f64> = cases.iter().map(|d| d.motion.duration_secs).collect();
        durations.sort_by(f64::total_cmp);
        (config.selection.samples > 0).then(|| Self {
            task,
            cases,
            samples: config.selection.samples,
            threshold: config.selection.threshold,
            min_active_latents: config.selection.min_active_latents,
            after_epochs: config.alpha_ramp_epochs,
            duration_secs: durations[durations.len() / 2],
            seed: config.seed,
        })
    }

    /// Whether an epoch's model may be kept at all.
    pub(super) fn eligible(&self, epoch: usize, active_latents: usize) -> bool {
        epoch >= self.after_epochs && active_latents >= self.min_active_latents
    }

    /// Samples that are drawn of each model.
    pub(super) fn samples(&self) -> usize {
        self.cases.len() * self.samples
    }

    /// How many of the samples reach their task within the threshold and break no bound.
    pub(super) fn hits(
        &self,
        config: &ModelConfig,
        units: &Normalizer,
        weights: &Weights,
    ) -> usize {
        let space = self.task.task_space();
        let manner = MannerSpace::unnamed(config.network.latents, BOUND);
        // The prior is learned when the training is over; until then it is N(0, I).
        let mut config = config.clone();
        config.network.prior_components = 0;
        let Ok(primitive) = TcVaePrimitive::new(&config, units, weights, space.clone(), manner)
        else {
            // Weights that decode to nothing finite hit nothing.
            return 0;
        };
        let of_case = |(i, case): (usize, &Demonstration)| {
            // The same manners for every epoch.
            let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
            rng.set_stream(i as u64);
            let hit = |_: &usize| {
                let generated = primitive.decode(&case.w, &primitive.sample_manner(&mut rng));
                let motion = generated.motion(self.duration_secs);
                let reached = self.task.empirical_task(&motion);
                let near = |w| space.distance(&w, &case.w) <= self.threshold;
                reached.is_ok_and(near) && self.task.violations(&motion).is_empty()
            };
            (0..self.samples).filter(hit).count()
        };
        self.cases.par_iter().enumerate().map(of_case).sum()
    }
}
