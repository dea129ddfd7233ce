//! What a training tells of itself.

use serde::{Deserialize, Serialize};

/// The terms of the objective, each the mean over demonstrations.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeanTerms {
    /// Negative log-likelihood of a motion in normalised units (nat).
    pub negative_log_likelihood: f64,
    /// KL divergence of each latent from the prior (nat).
    pub kl: Vec<f64>,
    /// L1 distance of the adversary's guess from w, in normalised units.
    pub adversary: f64,
    /// Mean square distance of each anchored latent's posterior means from its factor's scores, whose
    /// variance is 1.
    #[serde(default)]
    pub anchors: Vec<f64>,
}

impl MeanTerms {
    /// The KL divergence that makes a latent count as active (nat).
    pub const ACTIVE_KL: f64 = 0.1;

    /// Latents whose mean KL divergence is above [`Self::ACTIVE_KL`].
    pub fn active_latents(&self) -> usize {
        self.kl.iter().filter(|kl| **kl > Self::ACTIVE_KL).count()
    }
}

/// One epoch.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpochReport {
    /// Number of the epoch, from 1.
    pub epoch: usize,
    /// Adam's learning rate at its end.
    pub learning_rate: f64,
    /// Factor of the adversary's loss at its end.
    pub alpha: f64,
    /// On the training set, while it was being learned.
    pub train: MeanTerms,
    /// On the validation set, after the epoch.
    pub validation: MeanTerms,
    /// Share of the prior samples on validation tasks that are robust and valid, where epochs are
    /// selected by it.
    #[serde(default)]
    pub robust_and_valid: Option<f64>,
}

/// The posteriors of one latent over the validation set.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LatentStatistics {
    /// Mean of the posterior means.
    pub mean: f64,
    /// Standard deviation of the posterior means.
    pub stddev: f64,
    /// Mean of the posterior variances.
    pub variance: f64,
    /// Mean KL divergence from the prior (nat).
    pub kl: f64,
}
