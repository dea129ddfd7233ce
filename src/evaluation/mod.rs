//! How good a model is: SUCCESS (eq. 15), ROBUSTNESS (eq. 16), and beside them the measures
//! without which neither means anything: active latents, reconstruction error, leak, validity.

use serde::{Deserialize, Serialize};

/// A share of cases at one threshold, with its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// Largest distance that counts, in the task's unit.
    pub threshold: f64,
    /// Share of the cases.
    pub mean: f64,
    /// Lower end of the 95 % interval.
    pub low: f64,
    /// Upper end of the 95 % interval.
    pub high: f64,
}

/// The measured quality of a model; stored in the model file and printed by `evaluate --json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Evaluation {
    /// Share of test cases whose reconstruction from the posterior mean achieves its task (eq. 15).
    pub success: Vec<Score>,
    /// Share of prior samples that achieve the task of a test case (eq. 16).
    pub robustness: Vec<Score>,
    /// Share of prior samples that are robust and inside the task's validity bounds.
    pub robust_and_valid: Vec<Score>,
    /// Latents whose mean KL on validation is above 0.1 nat.
    pub active_latents: usize,
    /// Root mean square error of the reconstruction over all steps and state values, in the
    /// state's own units.
    pub reconstruction_rmse: f64,
    /// R2 of a strong probe from sampled h to the best-predicted component of w, floored at 0.
    pub leak_r2: f64,
    /// Share of pairs whose manner, decoded at another case's task, achieves that task at the
    /// middle threshold.
    pub swap: f64,
    /// Number of test cases.
    pub cases: usize,
    /// Seed of every random draw of the evaluation.
    pub seed: u64,
    /// The model that was evaluated: the first 12 digits of the SHA-256 over its tensors.
    pub model_id: String,
    /// SHA-256 over the test data.
    pub data_digest: String,
}
