//! The TC-VAE (sections 3.1-3.3 of the paper): its networks and objective on Burn, and the packed
//! decoder that serves it without.

mod backend;
mod config;
#[cfg(feature = "train")]
mod fused;
mod kernel;
mod layout;
#[cfg(feature = "train")]
mod networks;
mod normalizer;
#[cfg(feature = "train")]
mod objective;
mod packed;
mod primitive;
mod prior;
#[cfg(feature = "train")]
mod recogniser;

pub use backend::{Backend, UnknownBackend};
pub use config::{Activation, ConfigError, ModelConfig, NetworkConfig};
pub use layout::{Layout, ParameterSpec, WeightsError};
#[cfg(all(test, feature = "train"))]
pub(crate) use normalizer::tests as normalizer_tests;
pub use normalizer::{Baseline, Normalizer};
#[cfg(feature = "train")]
pub use objective::{Batch, Objective, PartGradients, Strengths, Terms};
pub use packed::{Decoded, PackedDecoder, Workspace};
pub use primitive::TcVaePrimitive;
pub use prior::LearnedPrior;
#[cfg(feature = "train")]
pub use recogniser::Recogniser;
#[cfg(feature = "train")]
pub(crate) use {layout::checked, normalizer::Units, recogniser::time_major};

use std::collections::BTreeMap;

use crate::primitive::Demonstration;

/// An array of `f32` with a shape, row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedTensor {
    /// Length of each axis.
    pub shape: Vec<usize>,
    /// The values, last axis fastest.
    pub values: Vec<f32>,
}

/// A model's weights by name, in the order of their names; the border between Burn, the packed
/// decoder and the model file.
pub type Weights = BTreeMap<String, NamedTensor>;

/// Why parts are not a model.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ModelError {
    /// A size of the configuration.
    #[error("the model's configuration: {0}")]
    Config(#[from] ConfigError),
    /// A tensor.
    #[error("the model's weights: {0}")]
    Weights(#[from] WeightsError),
    /// An offset or a scale.
    #[error(
        "the normalizer's {name} is {found:?}; {expected} finite values are needed, scales above 0"
    )]
    Normalizer {
        /// Which of them.
        name: &'static str,
        /// Its values.
        found: Vec<f64>,
        /// Number of values that it must have.
        expected: usize,
    },
    /// A learned prior whose parts are not a mixture.
    #[error(
        "the learned prior is no mixture: its shares add up to {total}, where 1 is needed, or one \
         of them or of its deviations is not above 0"
    )]
    Prior {
        /// Sum of the components' shares.
        total: f64,
    },
    /// A space has another number of values than the model.
    #[error("the {name} space has {found} values where the model has {expected}")]
    Space {
        /// `task` or `manner`.
        name: &'static str,
        /// Values of the space.
        found: usize,
        /// Values of the model.
        expected: usize,
    },
    /// The weights are finite, but what they decode to is not.
    #[error("the model decodes to values that are not finite; its weights are no trained model's")]
    NotFinite,
}

/// The recognition network's answer for one demonstration (eq. 6-8).
#[derive(Debug, Clone, PartialEq)]
pub struct Posterior {
    /// Mean of each latent.
    pub mean: Vec<f64>,
    /// Logarithm of the variance of each latent.
    pub log_variance: Vec<f64>,
}

/// Something that infers the manner of demonstrations.
pub trait Recognition {
    /// `q(h|x)` for each demonstration.
    fn recognise(&self, demonstrations: &[Demonstration]) -> Vec<Posterior>;
}
