//! The networks on Burn (eq. 6-13), as functions of parameters that are passed in.
//!
//! Sequences lie time-major, `[steps * batch, channels]`: row `t * batch + b` is step `t` of
//! sequence `b`. A shift along time is then a cut of whole rows, and a dilated convolution is three
//! matrix products ("matmul form"); Burn's own convolution is far slower in training.

use std::collections::BTreeMap;

use burn::tensor::{Device, Gradients, Tensor, TensorData, activation};

use super::config::{Activation, ModelConfig, TAPS};
use super::layout::Layout;

/// Bounds of the recognition network's log-variance.
const POSTERIOR_LOG_VARIANCE: (f32, f32) = (-10.0, 4.0);

/// Parameters on a device. Biases are rows, `[1, out]`.
#[derive(Debug)]
pub(crate) struct Parameters<'l> {
    layout: &'l Layout,
    tensors: BTreeMap<&'l str, Tensor<2>>,
}

impl<'l> Parameters<'l> {
    /// Parameters with these values. Gradients are kept for them where `device` has autodiff.
    pub(crate) fn new(layout: &'l Layout, values: &[f32], device: &Device) -> Self {
        let mut rest = values;
        let mut tensors = BTreeMap::new();
        for spec in layout.specs() {
            let (values, after) = rest.split_at(spec.len());
            rest = after;
            let columns = *spec.shape.last().expect("no parameter is a scalar");
            let shape = [spec.len() / columns, columns];
            let tensor = tensor(values.to_vec(), shape, device);
            let tensor = if device.is_autodiff() { tensor.require_grad() } else { tensor };
            tensors.insert(spec.name.as_str(), tensor);
        }
        Self { layout, tensors }
    }

    /// The gradient of every parameter in the order of the layout; 0 where none arrived.
    pub(crate) fn gradients(&self, gradients: &mut Gradients) -> Vec<f32> {
        let mut flat = Vec::with_capacity(self.layout.len());
        for spec in self.layout.specs() {
            match self.tensors[spec.name.as_str()].grad_remove(gradients) {
                Some(gradient) => flat.extend(values(gradient)),
                None => flat.resize(flat.len() + spec.len(), 0.0),
            }
        }
        flat
    }

    fn get(&self, name: &str) -> Tensor<2> {
        self.tensors[name].clone()
    }

    fn dense(&self, name: &str, x: Tensor<2>) -> Tensor<2> {
        x.matmul(self.get(&format!("{name}.weight"))) + self.get(&format!("{name}.bias"))
    }

    fn mlp(&self, name: &str, activation: Activation, x: Tensor<2>) -> Tensor<2> {
        let hidden = activate(activation, self.dense(&format!("{name}.hidden"), x));
        self.dense(&format!("{name}.output"), hidden)
    }
}

/// A tensor of values that are given row by row.
pub(crate) fn tensor(values: Vec<f32>, shape: [usize; 2], device: &Device) -> Tensor<2> {
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// The values of a tensor, row by row.
pub(crate) fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_into_vec().expect("the networks compute in f32")
}

fn activate(activation: Activation, x: Tensor<2>) -> Tensor<2> {
    match activation {
        Activation::Relu => activation::relu(x),
        Activation::Gelu => {
            let half = x.clone().mul_scalar(0.5);
            let erf = x.mul_scalar(std::f32::consts::FRAC_1_SQRT_2).erf();
            half.clone() * erf + half
        }
    }
}

/// `q(h|x)` of a batch, `[batch, latents]` each.
#[derive(Debug, Clone)]
pub(crate) struct PosteriorTensors {
    pub(crate) mean: Tensor<2>,
    pub(crate) log_variance: Tensor<2>,
}

/// `p(x|w, h)` of a batch, time-major, `[steps * batch, state_dim]` each.
#[derive(Debug, Clone)]
pub(crate) struct DecodedTensors {
    pub(crate) mean: Tensor<2>,
    pub(crate) log_variance: Tensor<2>,
}

/// The networks of one model on one device.
#[derive(Debug, Clone)]
pub(crate) struct Networks {
    pub(crate) config: ModelConfig,
    device: Device,
    /// The phase's functions through each tap of the first convolution, `[steps, taps * functions]`.
    phase: Tensor<2>,
    /// For each layer, whether each tap lies inside the sequence (1) or not (0), `[steps, taps]`.
    inside: Vec<Tensor<2>>,
}

impl Networks {
    pub(crate) fn new(config: &ModelConfig, device: &Device) -> Self {
        let steps = config.steps;
        // Rows of `values` as each tap sees them, zeros beyond the ends.
        let taps = |dilation: usize, values: &[f32]| {
            let count = values.len() / steps;
            let at = |t: Option<usize>| match t.filter(|t| *t < steps) {
                Some(t) => values[t * count..(t + 1) * count].to_vec(),
                None => vec![0.0; count],
            };
            let row = |t: usize| {
                [at(t.checked_sub(dilation)), at(Some(t)), at(Some(t + dilation))].concat()
            };
            tensor((0..steps).flat_map(row).collect(), [steps, TAPS * count], device)
        };
        let ones = vec![1.0; steps];
        let inside = (0..config.network.layers).map(|i| taps(ModelConfig::dilation(i), &ones));
        Self {
            phase: taps(ModelConfig::dilation(0), &config.phase()),
            inside: inside.collect(),
            config: config.clone(),
            device: device.clone(),
        }
    }

    /// `q(h|x)` (eq. 6-8) for `x`, time-major; our variant's `q(h|x, w)`, which sees the phase and
    /// `w`, `[batch, task_dim]`, at every step.
    pub(crate) fn recognise(
        &self,
        parameters: &Parameters<'_>,
        x: Tensor<2>,
        w: &Tensor<2>,
    ) -> PosteriorTensors {
        let network = &self.config.network;
        let mut x = x;
        if network.recognition_sees_context {
            let ([steps, batch], phase) = ([self.config.steps, w.dims()[0]], self.config.phase());
            let functions = network.phase_functions;
            let rows = phase.chunks_exact(functions).flat_map(|row| row.repeat(batch));
            let phase = tensor(rows.collect(), [steps * batch, functions], &self.device);
            x = Tensor::cat(vec![x, phase, w.clone().repeat_dim(0, steps)], 1);
        }
        for i in 0..network.layers {
            let y = self.convolve(parameters, &format!("recognition.layers.{i}"), i, x.clone());
            x = self.finish_layer(i, x, y);
        }
        let [rows, width] = x.dims();
        let steps = self.config.steps;
        let (batch, parts) = (rows / steps, network.recognition_parts);
        let x = x.reshape([steps, batch * width]);
        let mean = |part: usize| {
            let of_part = part * steps / parts..(part + 1) * steps / parts;
            let part = x.clone().slice([of_part, 0..batch * width]);
            part.mean_dim(0).reshape([batch, width])
        };
        let pooled = Tensor::cat((0..parts).map(mean).collect(), 1);
        let mean = parameters.mlp("recognition.mean", network.activation, pooled.clone());
        let log_variance = parameters.mlp("recognition.log_variance", network.activation, pooled);
        let (lower, upper) = POSTERIOR_LOG_VARIANCE;
        let log_variance = match network.bounded_variances {
            true => log_variance.clamp(lower, upper),
            false => log_variance,
        };
        PosteriorTensors { mean, log_variance }
    }

    /// `p(x|w, h)` (eq. 9-12) for `h`, `[batch, latents]`, and `w`, `[batch, task_dim]`.
    pub(crate) fn decode(
        &self,
        parameters: &Parameters<'_>,
        h: Tensor<2>,
        w: Tensor<2>,
    ) -> DecodedTensors {
        let network = &self.config.network;
        let manner = parameters.mlp("decoder.manner", network.activation, h.clone());
        let task = parameters.mlp("decoder.task", network.activation, w);
        let codes = Tensor::cat(vec![manner, task, h.clone()], 1);
        let batch = h.dims()[0];
        let (steps, width) = (self.config.steps, network.width);

        // The first convolution reads the phase and what is constant along the sequence.
        let phase = self.phase.clone().matmul(parameters.get("decoder.layers.0.weight"))
            + parameters.get("decoder.layers.0.bias");
        let constant = self.constant(parameters, 0, codes).reshape([steps, batch, width]);
        let y = (constant + phase.reshape([steps, 1, width])).reshape([steps * batch, width]);
        let mut x = activate(network.activation, y);
        for i in 1..network.layers {
            let y = self.convolve(parameters, &format!("decoder.layers.{i}"), i, x.clone())
                + self.constant(parameters, i, h.clone());
            x = self.finish_layer(i, x, y);
        }
        let mean = parameters.mlp("decoder.mean", network.activation, x.clone());
        let raw = parameters.mlp("decoder.log_variance", network.activation, x);
        let bounded = |raw: Tensor<2>| {
            let (centre, half_range) = network.log_variance_range();
            raw.div_scalar(half_range).tanh().mul_scalar(half_range).add_scalar(centre)
        };
        let log_variance = if network.bounded_variances { bounded(raw) } else { raw };
        DecodedTensors { mean, log_variance }
    }

    /// The adversary's guess of w from h, `f_W(h)` (eq. 13).
    pub(crate) fn guess_task(&self, parameters: &Parameters<'_>, h: Tensor<2>) -> Tensor<2> {
        let activation = self.config.network.activation;
        let x = activate(activation, parameters.dense("adversary.layers.0", h));
        let x = activate(activation, parameters.dense("adversary.layers.1", x));
        parameters.dense("adversary.layers.2", x)
    }

    fn finish_layer(&self, layer: usize, x: Tensor<2>, y: Tensor<2>) -> Tensor<2> {
        let y = activate(self.config.network.activation, y);
        if self.config.network.residual && layer > 0 { x + y } else { y }
    }

    /// The dilated convolution of `x`, with zeros beyond its ends.
    fn convolve(
        &self,
        parameters: &Parameters<'_>,
        name: &str,
        layer: usize,
        x: Tensor<2>,
    ) -> Tensor<2> {
        let weight = parameters.get(&format!("{name}.weight"));
        let bias = parameters.get(&format!("{name}.bias"));
        let [rows, channels] = x.dims();
        let width = weight.dims()[1];
        let tap = |i: usize| weight.clone().slice([i * channels..(i + 1) * channels, 0..width]);
        let batch = rows / self.config.steps;
        let reach = ModelConfig::dilation(layer) * batch;
        let y = x.clone().matmul(tap(1)) + bias;
        if reach >= rows {
            return y;
        }
        let zeros = Tensor::zeros([reach, width], &self.device);
        let before = x.clone().slice([0..rows - reach, 0..channels]).matmul(tap(0));
        let after = x.slice([reach..rows, 0..channels]).matmul(tap(2));
        y + Tensor::cat(vec![zeros.clone(), before], 0) + Tensor::cat(vec![after, zeros], 0)
    }

    /// A convolution's share of `constants`, `[batch, inputs]`, which don't change along the
    /// sequence: one product for each tap, taken up by the steps at which the tap lies inside.
    fn constant(
        &self,
        parameters: &Parameters<'_>,
        layer: usize,
        constants: Tensor<2>,
    ) -> Tensor<2> {
        let weight = parameters.get(&format!("decoder.layers.{layer}.constant"));
        let batch = constants.dims()[0];
        let (steps, width) = (self.config.steps, self.config.network.width);
        let products = constants.matmul(weight).reshape([batch, TAPS, width]);
        let products = products.swap_dims(0, 1).reshape([TAPS, batch * width]);
        self.inside[layer].clone().matmul(products).reshape([steps * batch, width])
    }
}
