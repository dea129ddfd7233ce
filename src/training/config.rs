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
    /// The networks.
    pub network: NetworkConfig,
    /// The adversary.
    pub adversary: AdversaryConfig,
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
            network: NetworkConfig::default(),
            adversary: AdversaryConfig::default(),
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
    /// The settings for pouring: a hundred steps, and our variant's task baseline
    /// and margins.
    pub fn pouring() -> Self {
        Self {
            steps: 100,
            beta: 1.0,
            network: NetworkConfig {
                task_baseline: true,
                margins: true,
                ..NetworkConfig::default()
            },
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
        ] {
            if !fits {
                return Err(SettingError { name, value, expected });
            }
        }
        Ok(())
    }

    /// The model that is trained on states and tasks of these sizes.
    pub fn model(&self, state_dim: usize, task_dim: usize) -> ModelConfig {
        let network = self.network.clone();
        let steps = self.steps.saturating_add(2 * network.margin());
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
    fn the_shipped_files_are_the_presets() {
        let arcs: TrainingConfig =
            toml::from_str(include_str!("../../config/train-arcs.toml")).unwrap();
        assert_eq!(arcs, TrainingConfig::default());
        let pouring: TrainingConfig =
            toml::from_str(include_str!("../../config/train-pouring.toml")).unwrap();
        assert_eq!(pouring, TrainingConfig::pouring());
    }

    #[test]
    fn the_shipped_files_name_every_setting() {
        let keys = |table: &toml::Table| {
            let mut keys = Vec::new();
            for (key, value) in table {
                match value.as_table() {
                    Some(inner) => keys.extend(inner.keys().map(|k| format!("{key}.{k}"))),
                    None => keys.push(key.clone()),
                }
            }
            keys
        };
        let all = keys(&toml::Table::try_from(TrainingConfig::default()).unwrap());
        for file in [
            include_str!("../../config/train-arcs.toml"),
            include_str!("../../config/train-pouring.toml"),
        ] {
            assert_eq!(keys(&file.parse().unwrap()), all);
        }
    }

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
    }
}
