//! The TC-VAE (sections 3.1-3.3 of the paper): its networks and objective on Burn, and the packed
//! decoder that serves it without.

use std::collections::BTreeMap;

use crate::demonstrations::Demonstration;

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
