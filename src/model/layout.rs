//! The parameters of the networks: their names, shapes and order, and how they start.
//!
//! | name | shape | what |
//! |---|---|---|
//! | `recognition.layers.I.weight` | `[3 in, width]` | convolution; rows: the taps `t-d`, `t`, `t+d`, each with its channels |
//! | `recognition.{mean,log_variance}.{hidden,output}.weight` | `[in, out]` | the two MLPs after the mean over time |
//! | `decoder.{manner,task}.{hidden,output}.weight` | `[in, out]` | the MLPs that encode h and w |
//! | `decoder.layers.I.weight` | `[3 in, width]` | convolution over what changes along a sequence: the phase in layer 0, the layer before in the others |
//! | `decoder.layers.I.constant` | `[in, 3 width]` | the same convolution's share of what is constant along a sequence: (code of h, code of w, h) in layer 0, h in the others; columns: the taps, each with its channels |
//! | `decoder.{mean,log_variance}.{hidden,output}.weight` | `[in, out]` | the two MLPs at each step |
//! | `adversary.layers.I.weight` | `[in, out]` | the adversary `f_W`; not in the model file |
//! | `….bias` | `[out]` | beside each weight |
//!
//! A convolution over the concatenation of all its channels, as the paper has it, is the sum of the
//! `weight` and the `constant` part; keeping them apart costs nothing and lets h's share be
//! computed once for a sequence.

use rand::{Rng, RngExt};

use super::config::{ModelConfig, TAPS};
use super::{NamedTensor, Weights};

/// One parameter tensor of a network.
#[derive(Debug, Clone, PartialEq)]
pub struct ParameterSpec {
    /// Name, as in the table of this module.
    pub name: String,
    /// Length of each axis.
    pub shape: Vec<usize>,
    /// Inputs of one output of the layer, from which the start values' range follows.
    pub fan_in: usize,
}

impl ParameterSpec {
    /// Number of values.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether it has no values.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Parameters in the order in which they are drawn, stepped and stored in a flat vector.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Layout(Vec<ParameterSpec>);

/// Why weights are not those of a model.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum WeightsError {
    /// A tensor is missing.
    #[error("the tensor {name} is missing")]
    Missing {
        /// Its name.
        name: String,
    },
    /// A tensor has another shape than the configuration asks for.
    #[error("the tensor {name} has the shape {found:?}; the configuration asks for {expected:?}")]
    Shape {
        /// Its name.
        name: String,
        /// The shape that it has.
        found: Vec<usize>,
        /// The shape that it must have.
        expected: Vec<usize>,
    },
    /// A value is NaN or infinite.
    #[error("value {index} of the tensor {name} is {value}; a finite number is needed")]
    NotFinite {
        /// Name of the tensor.
        name: String,
        /// Place of the value.
        index: usize,
        /// The value.
        value: f32,
    },
}

impl Layout {
    /// The recognition network's and the decoder's parameters: what a model file holds.
    pub fn of_model(config: &ModelConfig) -> Self {
        let n = &config.network;
        let mut layout = Self::default();
        for i in 0..n.layers {
            let context =
                if n.recognition_sees_context { n.phase_functions + config.task_dim } else { 0 };
            let channels = if i == 0 { config.state_dim + context } else { n.width };
            layout.dense(&format!("recognition.layers.{i}"), TAPS * channels, n.width);
        }
        for head in ["mean", "log_variance"] {
            layout.mlp(
                &format!("recognition.{head}"),
                n.recognition_parts * n.width,
                n.width,
                n.latents,
            );
        }
        layout.extend(Self::of_decoder(config));
        layout
    }

    /// The decoder's parameters alone: what serving needs.
    pub fn of_decoder(config: &ModelConfig) -> Self {
        let n = &config.network;
        let mut layout = Self::default();
        layout.mlp("decoder.manner", n.latents, n.width, n.width);
        layout.mlp("decoder.task", config.task_dim, n.width, n.width);
        for i in 0..n.layers {
            let (channels, constants) = if i == 0 {
                (n.phase_functions, config.first_constants())
            } else {
                (n.width, n.latents)
            };
            let name = format!("decoder.layers.{i}");
            let fan_in = TAPS * (channels + constants);
            layout.tensor(&name, "weight", &[TAPS * channels, n.width], fan_in);
            layout.tensor(&name, "constant", &[constants, TAPS * n.width], fan_in);
            layout.tensor(&name, "bias", &[n.width], fan_in);
        }
        for head in ["mean", "log_variance"] {
            layout.mlp(&format!("decoder.{head}"), n.width, n.width, config.state_dim);
        }
        layout
    }

    /// The adversary's parameters: an MLP of three layers from h to w.
    pub fn of_adversary(config: &ModelConfig, width: usize) -> Self {
        let mut layout = Self::default();
        layout.dense("adversary.layers.0", config.network.latents, width);
        layout.dense("adversary.layers.1", width, width);
        layout.dense("adversary.layers.2", width, config.task_dim);
        layout
    }

    /// The parameters in their order.
    pub fn specs(&self) -> &[ParameterSpec] {
        &self.0
    }

    /// Number of values of all parameters.
    pub fn len(&self) -> usize {
        self.0.iter().map(ParameterSpec::len).sum()
    }

    /// Whether there are no parameters.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Start values, one after the other in the order of the layout: uniform in
    /// `± 1 / sqrt(fan_in)`, weights and biases alike.
    pub fn initial(&self, rng: &mut impl Rng) -> Vec<f32> {
        let mut values = Vec::with_capacity(self.len());
        for spec in &self.0 {
            let bound = 1.0 / (spec.fan_in as f32).sqrt();
            values.extend((0..spec.len()).map(|_| rng.random_range(-bound..bound)));
        }
        values
    }

    /// Flat values as tensors by name.
    ///
    /// # Panics
    /// When the number of values is not the layout's.
    pub fn to_weights(&self, values: &[f32]) -> Weights {
        assert_eq!(values.len(), self.len(), "one value for each parameter");
        let mut rest = values;
        let tensor = |spec: &ParameterSpec| {
            let (values, after) = rest.split_at(spec.len());
            rest = after;
            let tensor = NamedTensor { shape: spec.shape.clone(), values: values.to_vec() };
            (spec.name.clone(), tensor)
        };
        self.0.iter().map(tensor).collect()
    }

    /// The layout's values out of tensors by name; other tensors are left aside.
    ///
    /// # Errors
    /// A tensor that is missing, has another shape, or holds a value that is not finite.
    pub fn from_weights(&self, weights: &Weights) -> Result<Vec<f32>, WeightsError> {
        let mut values = Vec::with_capacity(self.len());
        for spec in &self.0 {
            values.extend(&checked(weights, &spec.name, &spec.shape)?.values);
        }
        Ok(values)
    }

    /// Adds the parameters of `other` after these.
    pub fn extend(&mut self, other: Self) {
        self.0.extend(other.0);
    }

    fn mlp(&mut self, name: &str, inputs: usize, hidden: usize, outputs: usize) {
        self.dense(&format!("{name}.hidden"), inputs, hidden);
        self.dense(&format!("{name}.output"), hidden, outputs);
    }

    fn dense(&mut self, name: &str, inputs: usize, outputs: usize) {
        self.tensor(name, "weight", &[inputs, outputs], inputs);
        self.tensor(name, "bias", &[outputs], inputs);
    }

    fn tensor(&mut self, layer: &str, kind: &str, shape: &[usize], fan_in: usize) {
        self.0.push(ParameterSpec { name: format!("{layer}.{kind}"), shape: shape.into(), fan_in });
    }
}

/// The tensor of that name, with its shape and its values checked.
pub(crate) fn checked<'w>(
    weights: &'w Weights,
    name: &str,
    shape: &[usize],
) -> Result<&'w NamedTensor, WeightsError> {
    let tensor = weights.get(name).ok_or_else(|| WeightsError::Missing { name: name.into() })?;
    if tensor.shape != shape || tensor.values.len() != shape.iter().product::<usize>() {
        return Err(WeightsError::Shape {
            name: name.into(),
            found: tensor.shape.clone(),
            expected: shape.into(),
        });
    }
    match tensor.values.iter().position(|v| !v.is_finite()) {
        Some(index) => {
            let value = tensor.values[index];
            Err(WeightsError::NotFinite { name: name.into(), index, value })
        }
        None => Ok(tensor),
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::super::config::{Activation, NetworkConfig};
    use super::*;
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;

    /// A model small enough for tests, with every part in it.
    pub(crate) fn small(activation: Activation, residual: bool) -> ModelConfig {
        let network =
            NetworkConfig { latents: 3, width: 8, activation, residual, ..Default::default() };
        ModelConfig { steps: 12, state_dim: 2, task_dim: 4, network }
    }

    /// Start values of all of a model's parameters.
    pub(crate) fn weights(config: &ModelConfig, seed: u64) -> Weights {
        let layout = Layout::of_model(config);
        layout.to_weights(&layout.initial(&mut ChaCha8Rng::seed_from_u64(seed)))
    }

    #[test]
    fn flat_values_become_weights_and_back() {
        let config = small(Activation::Gelu, true);
        let layout = Layout::of_model(&config);
        let values = layout.initial(&mut ChaCha8Rng::seed_from_u64(1));
        assert_eq!(layout.from_weights(&layout.to_weights(&values)).unwrap(), values);
    }

    #[test]
    fn a_tensor_of_another_shape_is_refused_by_name() {
        let config = small(Activation::Gelu, true);
        let mut weights = weights(&config, 1);
        weights.get_mut("decoder.layers.1.bias").unwrap().shape = vec![2, 4];
        let error = Layout::of_decoder(&config).from_weights(&weights).unwrap_err();
        assert_eq!(
            error.to_string(),
            "the tensor decoder.layers.1.bias has the shape [2, 4]; the configuration asks for [8]"
        );
    }

    #[test]
    fn a_value_that_is_not_finite_is_refused_with_its_place() {
        let config = small(Activation::Gelu, true);
        let mut weights = weights(&config, 1);
        weights.get_mut("decoder.layers.1.bias").unwrap().values[5] = f32::NAN;
        let error = Layout::of_decoder(&config).from_weights(&weights).unwrap_err();
        assert!(matches!(error, WeightsError::NotFinite { index: 5, .. }));
    }
}
