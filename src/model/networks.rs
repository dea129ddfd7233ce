//! The networks on Burn (eq. 6-13), as functions of parameters that are passed in.
//!
//! Sequences lie time-major, `[steps * batch, channels]`: row `t * batch + b` is step `t` of
//! sequence `b`. A shift along time is then a cut of whole rows, and a dilated convolution is three
//! matrix products ("matmul form"); Burn's own convolution is far slower in training.

use std::collections::BTreeMap;

use burn::tensor::{Device, Gradients, Tensor, TensorData, activation};

use super::backend::Backend;
use super::config::{Activation, ModelConfig, TAPS};
use super::fused::{self, LayerShape};
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
    /// Whether layers are computed by [`super::fused`]; else they are composed of Burn's operations.
    fused: bool,
}

impl Networks {
    pub(crate) fn new(config: &ModelConfig, backend: Backend, device: &Device) -> Self {
        Self { config: config.clone(), device: device.clone(), fused: backend == Backend::Flex }
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
            let phase = self.phase(w.dims()[0]);
            x = Tensor::cat(vec![x, phase, w.clone().repeat_dim(0, self.config.steps)], 1);
        }
        for i in 0..network.layers {
            x = self.convolve(parameters, &format!("recognition.layers.{i}"), i, x, None);
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
        let mean = self.mlp(parameters, "recognition.mean", pooled.clone());
        let log_variance = self.mlp(parameters, "recognition.log_variance", pooled);
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
        let manner = self.mlp(parameters, "decoder.manner", h.clone());
        let task = self.mlp(parameters, "decoder.task", w);
        // What is constant along the sequence: the codes at the first convolution, h at all others.
        let mut constants = Tensor::cat(vec![manner, task, h.clone()], 1);
        let mut x = self.phase(h.dims()[0]);
        for i in 0..network.layers {
            let name = format!("decoder.layers.{i}");
            let products = constants.matmul(parameters.get(&format!("{name}.constant")));
            x = self.convolve(parameters, &name, i, x, Some(products));
            constants = h.clone();
        }
        let mean = self.mlp(parameters, "decoder.mean", x.clone());
        let raw = self.mlp(parameters, "decoder.log_variance", x);
        let bounded = |raw: Tensor<2>| {
            let (centre, half_range) = network.log_variance_range();
            raw.div_scalar(half_range).tanh().mul_scalar(half_range).add_scalar(centre)
        };
        let log_variance = if network.bounded_variances { bounded(raw) } else { raw };
        DecodedTensors { mean, log_variance }
    }

    /// The adversary's guess of w from h, `f_W(h)` (eq. 13).
    pub(crate) fn guess_task(&self, parameters: &Parameters<'_>, h: Tensor<2>) -> Tensor<2> {
        let activation = Some(self.config.network.activation);
        let x = self.dense(parameters, "adversary.layers.0", activation, h);
        let x = self.dense(parameters, "adversary.layers.1", activation, x);
        self.dense(parameters, "adversary.layers.2", None, x)
    }

    /// The phase's functions at every step of every sequence, `[steps * batch, functions]`.
    fn phase(&self, batch: usize) -> Tensor<2> {
        let functions = self.config.network.phase_functions;
        let phase = self.config.phase();
        let rows = phase.chunks_exact(functions).flat_map(|row| row.repeat(batch));
        tensor(rows.collect(), [self.config.steps * batch, functions], &self.device)
    }

    fn mlp(&self, parameters: &Parameters<'_>, name: &str, x: Tensor<2>) -> Tensor<2> {
        let activation = Some(self.config.network.activation);
        let hidden = self.dense(parameters, &format!("{name}.hidden"), activation, x);
        self.dense(parameters, &format!("{name}.output"), None, hidden)
    }

    fn dense(
        &self,
        parameters: &Parameters<'_>,
        name: &str,
        activation: Option<Activation>,
        x: Tensor<2>,
    ) -> Tensor<2> {
        let shape = LayerShape { reach: None, activation, residual: false };
        self.layer(parameters, name, x, None, shape)
    }

    /// A layer of a TCN: the dilated convolution of `x`, with zeros beyond its ends.
    fn convolve(
        &self,
        parameters: &Parameters<'_>,
        name: &str,
        layer: usize,
        x: Tensor<2>,
        constants: Option<Tensor<2>>,
    ) -> Tensor<2> {
        let network = &self.config.network;
        let batch = x.dims()[0] / self.config.steps;
        let shape = LayerShape {
            reach: Some(ModelConfig::dilation(layer) * batch),
            activation: Some(network.activation),
            residual: network.residual && layer > 0,
        };
        self.layer(parameters, name, x, constants, shape)
    }

    fn layer(
        &self,
        parameters: &Parameters<'_>,
        name: &str,
        x: Tensor<2>,
        constants: Option<Tensor<2>>,
        shape: LayerShape,
    ) -> Tensor<2> {
        let [weight, bias] =
            ["weight", "bias"].map(|kind| parameters.get(&format!("{name}.{kind}")));
        if self.fused {
            return fused::layer(x, weight, bias, constants, shape);
        }
        let LayerShape { reach, activation, residual } = shape;
        let mut y = match reach {
            None => x.clone().matmul(weight),
            Some(reach) => self.convolution(x.clone(), weight, reach),
        };
        y = y + bias;
        if let (Some(constants), Some(reach)) = (constants, reach) {
            y = y + self.constant(constants, reach);
        }
        if let Some(activation) = activation {
            y = activate(activation, y);
        }
        if residual { x + y } else { y }
    }

    /// The dilated convolution of `x` alone, composed: a product for each tap.
    fn convolution(&self, x: Tensor<2>, weight: Tensor<2>, reach: usize) -> Tensor<2> {
        let [rows, channels] = x.dims();
        let width = weight.dims()[1];
        let tap = |i: usize| weight.clone().slice([i * channels..(i + 1) * channels, 0..width]);
        let y = x.clone().matmul(tap(1));
        if reach >= rows {
            return y;
        }
        let zeros = Tensor::zeros([reach, width], &self.device);
        let before = x.clone().slice([0..rows - reach, 0..channels]).matmul(tap(0));
        let after = x.slice([reach..rows, 0..channels]).matmul(tap(2));
        y + Tensor::cat(vec![zeros.clone(), before], 0) + Tensor::cat(vec![after, zeros], 0)
    }

    /// Each sequence's `constants`, `[batch, taps * width]`, taken up by the steps at which their tap
    /// lies inside the sequence, composed.
    fn constant(&self, constants: Tensor<2>, reach: usize) -> Tensor<2> {
        let (batch, steps) = (constants.dims()[0], self.config.steps);
        let width = constants.dims()[1] / TAPS;
        let dilation = reach / batch;
        let inside = |t: usize| [t >= dilation, true, t + dilation < steps].map(f32::from);
        let inside = tensor((0..steps).flat_map(inside).collect(), [steps, TAPS], &self.device);
        let by_tap = constants.reshape([batch, TAPS, width]).swap_dims(0, 1);
        inside.matmul(by_tap.reshape([TAPS, batch * width])).reshape([steps * batch, width])
    }
}

#[cfg(test)]
mod tests {
    use super::super::layout::tests::small;
    use super::*;
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;

    /// Means and log-variances of both networks, and the gradients of their weighted sum.
    fn computed(config: &ModelConfig, fused: bool, batch: usize) -> [Vec<f32>; 3] {
        let device = Backend::Flex.device().autodiff();
        let networks = Networks { fused, ..Networks::new(config, Backend::Flex, &device) };
        let layout = Layout::of_model(config);
        let flat = layout.initial(&mut ChaCha8Rng::seed_from_u64(3));
        let parameters = Parameters::new(&layout, &flat, &device);
        let ramp = |rows: usize, columns: usize| {
            let values = (0..rows * columns).map(|i| (i * 7919 % 101) as f32 / 50.0 - 1.0);
            tensor(values.collect(), [rows, columns], &device)
        };
        let ModelConfig { steps, state_dim, task_dim, ref network } = *config;
        let (x, w) = (ramp(steps * batch, state_dim), ramp(batch, task_dim));
        let PosteriorTensors { mean, log_variance } = networks.recognise(&parameters, x, &w);
        let decoded = networks.decode(&parameters, mean.clone(), w);
        let weighted = |t: Tensor<2>| {
            let [rows, columns] = t.dims();
            (t * ramp(rows, columns)).sum()
        };
        let sum = weighted(mean.clone())
            + weighted(log_variance)
            + weighted(decoded.mean.clone())
            + weighted(decoded.log_variance);
        assert_eq!(mean.dims(), [batch, network.latents]);
        let gradients = parameters.gradients(&mut sum.backward());
        [values(mean.inner()), values(decoded.mean.inner()), gradients]
    }

    #[test]
    fn fused_layers_are_the_composed_ones() {
        for (activation, residual, context) in
            [(Activation::Gelu, true, true), (Activation::Relu, false, false)]
        {
            // The last dilation, 8, is longer than the sequence, and that before longer than half of
            // it; widths and rows fill no vector.
            let mut config = small(activation, residual);
            (config.steps, config.network.width, config.network.layers) = (7, 5, 4);
            config.network.recognition_sees_context = context;
            (config.network.phase_functions, config.network.recognition_parts) = (3, 2);
            for batch in [1, 3] {
                let [composed, fused] = [false, true].map(|f| computed(&config, f, batch));
                for (composed, fused) in composed.iter().zip(&fused) {
                    let scale = composed.iter().fold(1.0f32, |m, v| m.max(v.abs()));
                    assert_eq!(composed.len(), fused.len());
                    for (a, b) in composed.iter().zip(fused) {
                        assert!((a - b).abs() < 1e-5 * scale, "{a} {b}");
                    }
                }
            }
        }
    }
}
