//! The settings of a training.

use serde::{Deserialize, Serialize};

use crate::model::{Backend, ModelConfig, NetworkConfig};

/// The settings of a training (`config/train-*.toml`); the default is the arcs'.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainingConfig {
    /// Steps of a trajectory, `T`; demonstrations are resampled to them.
    pub steps: usize,
    /// Seed of the start values, of the batches and of the noise. One seed gives one model file.
    pub seed: u64,
    /// Burn's backend.
    pub backend: Backend,
    /// Passes over the training set.
    pub epochs: usize,
    /// Demonstrations in a batch.
    pub batch: usize,
    /// Parts of a batch, computed side by side on as many cores as there are. The number decides
    /// the order of the sums and so the last bits of the result; the number of cores does not.
    pub parts: usize,
    /// Adam's learning rate at the start.
    pub learning_rate: f64,
    /// Share of it that is left at the end; between them it follows half a cosine.
    pub final_learning_rate_share: f64,
    /// Factor of the KL divergence (eq. 5).
    pub beta: f64,
    /// Factor of the adversary's loss, summed over the values of w, in the model's objective
    /// (eq. 14); 0 is the paper's row without auxiliary loss.
    pub alpha: f64,
    /// Epochs over which alpha grows from 0.
    pub alpha_ramp_epochs: usize,
    /// Our variant: factor of the likelihood of what is the same at each step of a motion, durations
    /// and a turn's axis and first orientation, which would else count as often as there are steps.
    pub constants_factor: f64,
    /// The networks.
    pub network: NetworkConfig,
    /// The adversary.
    pub adversary: AdversaryConfig,
    /// What the manner parameters are to mean.
    pub manner: MannerConfig,
    /// Which epoch's model is kept.
    pub selection: SelectionConfig,
}

/// Which epoch's model is kept: the one whose samples on the validation set are robust and valid
/// most often, of those after `alpha_ramp_epochs` with enough active latents. A model that hardly
/// varies is always robust, so there is no selection without these floors.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SelectionConfig {
    /// Prior samples on each of up to 200 validation demonstrations after every epoch; 0 keeps the
    /// last epoch.
    pub samples: usize,
    /// Distance from the task within which a sample is robust, in the task's unit.
    pub threshold: f64,
    /// Latents with a mean KL above 0.1 nat on the validation set that a kept model has at least.
    pub min_active_latents: usize,
    /// Epochs without a better one after which the training stops; 0 never stops early.
    pub patience: usize,
}

impl SelectionConfig {
    /// Whether the training is over after this many epochs with the best one at `best`.
    #[cfg(feature = "train")]
    pub(crate) fn stops(&self, epochs: usize, best: Option<usize>) -> bool {
        best.is_some_and(|best| self.patience > 0 && epochs >= best + self.patience)
    }
}

/// Our variant's named manner parameters; not in the paper.
///
/// Each factor in `anchors` is measured on every demonstration, and the part of it that neither
/// the task nor the factors before it explain becomes a standard score. The first latents' posterior
/// means are drawn to these scores, so that each of them means its factor, and, as the scores are
/// standard normal and independent of the task, the prior stays what people do.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MannerConfig {
    /// Names of the task's factors for the first latents, in order; empty leaves all of them to the
    /// ELBO, as the paper does.
    pub anchors: Vec<String>,
    /// Factor of half the squared distance between posterior means and their scores, gamma: the
    /// inverse variance that the scores are believed to have.
    pub anchor_strength: f64,
}

/// The adversary `f_W` (eq. 13).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AdversaryConfig {
    /// Channels of its two hidden layers.
    pub width: usize,
    /// Its own Adam's learning rate, constant.
    pub learning_rate: f64,
}

impl Default for AdversaryConfig {
    fn default() -> Self {
        Self { width: 64, learning_rate: 1e-3 }
    }
}

impl Default for TrainingConfig {
    fn default() -> Self {
        Self {
            steps: 32,
            seed: 0,
            backend: Backend::Flex,
            epochs: 60,
            batch: 128,
            parts: 2,
            learning_rate: 2e-3,
            final_learning_rate_share: 0.01,
            beta: 4.0,
            alpha: 50.0,
            alpha_ramp_epochs: 20,
            constants_factor: 1.0,
            network: NetworkConfig::default(),
            adversary: AdversaryConfig::default(),
            manner: MannerConfig::default(),
            selection: SelectionConfig::default(),
        }
    }
}

/// Why settings can't be trained with.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{name} is {value}; it must be {expected}")]
pub struct SettingError {
    /// The key.
    pub name: &'static str,
    /// Its value.
    pub value: f64,
    /// What it must be.
    pub expected: &'static str,
}

impl TrainingConfig {
    /// The settings for the motion of an arm with an object: a hundred steps, and our variants, with a
    /// manner parameter for each of these factors of its task; with none, with two that nothing names.
    pub fn of_arm(factors: &[String]) -> Self {
        Self {
            steps: 100,
            epochs: 40,
            beta: 2.0,
            alpha: 50.0,
            alpha_ramp_epochs: 10,
            constants_factor: 0.3,
            network: NetworkConfig {
                latents: factors.len().max(2),
                prior_components: 16,
                task_baseline: true,
                margins: true,
                segments: 3,
                orientations_as_turns: true,
                recognition_sees_context: true,
                recognition_parts: 8,
                phase_functions: 16,
                least_log_variance: -2.5,
                ..NetworkConfig::default()
            },
            manner: MannerConfig { anchors: factors.to_vec(), anchor_strength: 1000.0 },
            ..Self::default()
        }
    }

    /// Checks what no type can say. The sizes of the networks are [`ModelConfig::check`]'s.
    ///
    /// # Errors
    /// The first setting that can't be.
    pub fn check(&self) -> Result<(), SettingError> {
        let count = |name, value: usize| (name, value as f64, value >= 1, "at least 1");
        let factor = |name, value: f64| {
            (name, value, value.is_finite() && value >= 0.0, "finite and not negative")
        };
        let rate = |name, value: f64| (name, value, value > 0.0 && value <= 1.0, "in (0, 1]");
        for (name, value, fits, expected) in [
            count("epochs", self.epochs),
            count("batch", self.batch),
            count("parts", self.parts),
            count("adversary.width", self.adversary.width),
            rate("learning_rate", self.learning_rate),
            rate("adversary.learning_rate", self.adversary.learning_rate),
            factor("final_learning_rate_share", self.final_learning_rate_share),
            factor("beta", self.beta),
            factor("alpha", self.alpha),
            factor("constants_factor", self.constants_factor),
            factor("manner.anchor_strength", self.manner.anchor_strength),
            factor("selection.threshold", self.selection.threshold),
        ] {
            if !fits {
                return Err(SettingError { name, value, expected });
            }
        }
        // Settings that would do nothing, or not what they say.
        let SelectionConfig { samples, threshold, patience, .. } = self.selection;
        let strength = self.manner.anchor_strength;
        let anchored = self.manner.anchors.is_empty() || strength > 0.0;
        let unseen = !self.network.task_conditioned && self.alpha > 0.0;
        for (name, value, fits, expected) in [
            ("alpha", self.alpha, !unseen, "0 where network.task_conditioned is false"),
            ("manner.anchor_strength", strength, anchored, "above 0 with manner.anchors"),
            (
                "selection.threshold",
                threshold,
                samples == 0 || threshold > 0.0,
                "above 0 with selection.samples",
            ),
            (
                "selection.patience",
                patience as f64,
                patience == 0 || samples > 0,
                "0 without selection.samples, as no epoch is better than another",
            ),
        ] {
            if !fits {
                return Err(SettingError { name, value, expected });
            }
        }
        Ok(())
    }

    /// The model that is trained on motions and tasks of these sizes.
    pub fn model(&self, state_dim: usize, task_dim: usize) -> ModelConfig {
        let network = self.network.clone();
        let steps = self.steps.saturating_add(2 * network.margin());
        let state_dim = state_dim.saturating_add(network.beside());
        ModelConfig { steps, state_dim, task_dim, network }
    }

    /// The learning rate after a share of the steps.
    #[cfg(feature = "train")]
    pub(crate) fn learning_rate_at(&self, share: f64) -> f64 {
        let end = self.learning_rate * self.final_learning_rate_share;
        end + (self.learning_rate - end) * 0.5 * (1.0 + (std::f64::consts::PI * share).cos())
    }

    /// Alpha after a number of epochs, which need not be whole.
    #[cfg(feature = "train")]
    pub(crate) fn alpha_at(&self, epochs: f64) -> f64 {
        match self.alpha_ramp_epochs {
            0 => self.alpha,
            ramp => self.alpha * (epochs / ramp as f64).min(1.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_setting_is_refused() {
        let error = toml::from_str::<TrainingConfig>("epoch = 3").unwrap_err();
        assert!(error.message().contains("unknown field `epoch`"), "{error}");
    }

    #[test]
    fn a_setting_that_can_not_be_is_refused_by_name() {
        let config = TrainingConfig { learning_rate: -0.1, ..Default::default() };
        let error = config.check().unwrap_err();
        assert_eq!(error.to_string(), "learning_rate is -0.1; it must be in (0, 1]");
        assert!(TrainingConfig { beta: f64::NAN, ..Default::default() }.check().is_err());
        for (set, said) in [
            ("[network]\ntask_conditioned = false", "alpha is 50; it must be 0 where"),
            ("[manner]\nanchors = ['span']", "manner.anchor_strength is 0; it must be above 0"),
            ("[selection]\nsamples = 2", "selection.threshold is 0; it must be above 0"),
            ("[selection]\npatience = 2", "selection.patience is 2; it must be 0 without"),
        ] {
            let config: TrainingConfig = toml::from_str(set).unwrap();
            let error = config.check().unwrap_err().to_string();
            assert!(error.starts_with(said), "{error}");
        }
    }
}
