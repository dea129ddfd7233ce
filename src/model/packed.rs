//! The decoder (eq. 9-12) as it is served: weights packed once, buffers reused, no framework.
//!
//! h and w are constant along a sequence. What they add to a convolution is one product for the
//! whole sequence, which every step takes up, except that near the ends some taps fall outside.
//! Of the first convolution nothing else remains but the phase, which is the same for every
//! sequence and is computed when the weights are packed.

use pulp::{Simd, WithSimd};

use super::config::{ModelConfig, TAPS};
use super::kernel::{EDGE_KINDS, Edges, Layer, PackedWeights, add_and_activate, dispatch, padded};
use super::layout::{Layout, WeightsError};
use super::{NamedTensor, Weights};

/// A fully connected layer.
#[derive(Debug, Clone)]
struct Dense {
    weights: PackedWeights,
    bias: Vec<f32>,
}

/// An MLP of two layers.
#[derive(Debug, Clone)]
struct Mlp {
    hidden: Dense,
    output: Dense,
}

/// A dilated convolution.
#[derive(Debug, Clone)]
struct Convolution {
    /// Weights of what changes along the sequence; none in the first layer.
    weights: Option<PackedWeights>,
    /// Weights of what is constant, one group of outputs for each tap; the bias is the middle tap's.
    constant: Dense,
    dilation: usize,
}

/// A decoder's weights, laid out for decoding.
#[derive(Debug, Clone)]
pub struct PackedDecoder {
    config: ModelConfig,
    manner: Mlp,
    task: Mlp,
    /// What the phase adds to the first convolution, one row for each step.
    phase: Vec<f32>,
    convolutions: Vec<Convolution>,
    /// Hidden layers of the mean and of the log-variance side by side.
    head: Mlp,
}

/// The buffers of one decoding, reused from call to call.
#[derive(Debug, Clone)]
pub struct Workspace {
    batch: usize,
    hidden: Vec<f32>,
    constants: Vec<f32>,
    products: Vec<f32>,
    starts: Vec<f32>,
    /// Activations: rows of zeros before the first step and after the last, where taps fall
    /// outside.
    activations: [Vec<f32>; 2],
    head_hidden: Vec<f32>,
    head: Vec<f32>,
    mean: Vec<f32>,
    log_variance: Vec<f32>,
}

/// A decoded batch, in the network's normalised units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Decoded<'a> {
    /// Mean of each state value, `[batch, steps, state_dim]`.
    pub mean: &'a [f32],
    /// Logarithm of its variance, the same shape.
    pub log_variance: &'a [f32],
}

impl Dense {
    fn new(weight: &NamedTensor, bias: &NamedTensor) -> Self {
        let [inputs, outputs] = [weight.shape[0], weight.shape[1]];
        let weights = PackedWeights::new(&weight.values, 1, inputs, outputs);
        Self { bias: padded_row(&bias.values), weights }
    }

    /// What computing `rows` rows of `x` into `out` takes.
    #[inline(always)]
    fn layer<'a>(
        &'a self,
        x: &'a [f32],
        x_stride: usize,
        rows: usize,
        out: &'a mut [f32],
        out_stride: usize,
    ) -> Layer<'a> {
        Layer {
            weights: &self.weights,
            x,
            x_stride,
            tap_rows: 0,
            start: &self.bias,
            edges: None,
            rows,
            activation: None,
            residual: false,
            out,
            out_stride,
        }
    }
}

impl PackedDecoder {
    /// Packs the tensors `decoder.*` of `weights`.
    ///
    /// # Errors
    /// A tensor that is missing, has a wrong shape, or holds a value that is not finite.
    pub fn new(config: &ModelConfig, weights: &Weights) -> Result<Self, WeightsError> {
        // One pass over all of them, so that what follows can't fail.
        Layout::of_decoder(config).from_weights(weights)?;
        let tensor = |name: &str| &weights[name];
        let mlp = |name: &str| {
            let dense = |layer: &str| {
                let tensor = |kind: &str| tensor(&format!("{name}.{layer}.{kind}"));
                Dense::new(tensor("weight"), tensor("bias"))
            };
            Mlp { hidden: dense("hidden"), output: dense("output") }
        };
        let (width, latents) = (config.network.width, config.network.latents);
        let convolutions = (0..config.network.layers).map(|i| {
            let tensor = |kind: &str| tensor(&format!("decoder.layers.{i}.{kind}"));
            // The codes of h and w end at whole panels, as the layers that make them write them.
            let groups: &[usize] = if i == 0 { &[width, width, latents] } else { &[latents] };
            Convolution {
                weights: (i > 0)
                    .then(|| PackedWeights::new(&tensor("weight").values, TAPS, width, width)),
                constant: pack_constant(tensor("constant"), tensor("bias"), groups, width),
                dilation: ModelConfig::dilation(i),
            }
        });
        Ok(Self {
            manner: mlp("decoder.manner"),
            task: mlp("decoder.task"),
            phase: phase_rows(config, tensor("decoder.layers.0.weight")),
            convolutions: convolutions.collect(),
            head: pack_head(config, weights),
            config: config.clone(),
        })
    }

    /// The shape of the model.
    pub fn config(&self) -> &ModelConfig {
        &self.config
    }

    /// Buffers for decoding `batch` sequences at once.
    ///
    /// # Panics
    /// When `batch` is 0.
    pub fn workspace(&self, batch: usize) -> Workspace {
        assert!(batch > 0, "at least one sequence");
        let ModelConfig { steps, state_dim, network, .. } = &self.config;
        let width = padded(network.width);
        let rows = steps * batch;
        let margin = ModelConfig::dilation(network.layers - 1) * batch;
        let activation = vec![0.0; (rows + 2 * margin) * width];
        Workspace {
            batch,
            hidden: vec![0.0; batch * width],
            constants: vec![0.0; batch * (2 * width + network.latents)],
            products: vec![0.0; batch * TAPS * width],
            starts: vec![0.0; batch * EDGE_KINDS * width],
            activations: [activation.clone(), activation],
            head_hidden: vec![0.0; rows * self.head.hidden.weights.outputs],
            head: vec![0.0; rows * self.head.output.weights.outputs],
            mean: vec![0.0; rows * state_dim],
            log_variance: vec![0.0; rows * state_dim],
        }
    }

    /// Decodes the workspace's number of sequences: `h` is `[batch, latents]`, `w` is
    /// `[batch, task_dim]`, both normalised.
    ///
    /// # Panics
    /// When `h` or `w` have another length.
    pub fn decode<'w>(&self, h: &[f32], w: &[f32], workspace: &'w mut Workspace) -> Decoded<'w> {
        let batch = workspace.batch;
        assert_eq!(h.len(), batch * self.config.network.latents, "h is [batch, latents]");
        assert_eq!(w.len(), batch * self.config.task_dim, "w is [batch, task_dim]");
        dispatch(Decode { decoder: self, h, w, workspace: &mut *workspace });
        Decoded { mean: &workspace.mean, log_variance: &workspace.log_variance }
    }
}

struct Decode<'a> {
    decoder: &'a PackedDecoder,
    h: &'a [f32],
    w: &'a [f32],
    workspace: &'a mut Workspace,
}

impl WithSimd for Decode<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { decoder, h, w, workspace } = self;
        let Workspace {
            batch,
            hidden,
            constants,
            products,
            starts,
            activations,
            head_hidden,
            head,
            mean,
            log_variance,
        } = workspace;
        let batch = *batch;
        let ModelConfig { steps, state_dim, task_dim, network } = &decoder.config;
        let (steps, latents) = (*steps, network.latents);
        let width = padded(network.width);
        let rows = steps * batch;
        let activation = Some(network.activation);

        // The codes of h and w, then h itself, in one row for each sequence.
        let stride = 2 * width + latents;
        for (mlp, x, inputs, place) in
            [(&decoder.manner, h, latents, 0), (&decoder.task, w, *task_dim, width)]
        {
            let layer = mlp.hidden.layer(x, inputs, batch, hidden, width);
            Layer { activation, ..layer }.run(simd);
            mlp.output.layer(hidden, width, batch, &mut constants[place..], stride).run(simd);
        }
        for (constants, h) in constants.chunks_exact_mut(stride).zip(h.chunks_exact(latents)) {
            constants[2 * width..].copy_from_slice(h);
        }

        let margin = ModelConfig::dilation(network.layers - 1) * batch;
        let [mut from, mut to] = {
            let [a, b] = activations;
            [a, b]
        };
        for convolution in &decoder.convolutions {
            let Convolution { weights, constant, dilation } = convolution;
            let (x, x_stride) =
                if weights.is_none() { (&**constants, stride) } else { (h, latents) };
            constant.layer(x, x_stride, batch, products, TAPS * width).run(simd);
            start_rows(products, width, starts);
            let edges = Edges { dilation: *dilation, steps, batch };
            let out = &mut to[margin * width..][..rows * width];
            match weights {
                None => {
                    for (row, out) in out.chunks_exact_mut(width).enumerate() {
                        let phase = &decoder.phase[row / batch * width..][..width];
                        let start = &starts[edges.start(row) * width..][..width];
                        add_and_activate(simd, phase, start, network.activation, out);
                    }
                }
                Some(weights) => {
                    let reach = dilation * batch;
                    Layer {
                        weights,
                        x: &from[(margin - reach) * width..],
                        x_stride: width,
                        tap_rows: reach,
                        start: starts,
                        edges: Some(edges),
                        rows,
                        activation,
                        residual: network.residual,
                        out,
                        out_stride: width,
                    }
                    .run(simd);
                }
            }
            std::mem::swap(&mut from, &mut to);
        }

        let x = &from[margin * width..];
        let head_width = decoder.head.hidden.weights.outputs;
        let layer = decoder.head.hidden.layer(x, width, rows, head_hidden, head_width);
        Layer { activation, ..layer }.run(simd);
        let out_width = decoder.head.output.weights.outputs;
        decoder.head.output.layer(head_hidden, head_width, rows, head, out_width).run(simd);

        for (row, head) in head.chunks_exact(out_width).enumerate() {
            let (t, b) = (row / batch, row % batch);
            let place = (b * steps + t) * state_dim..(b * steps + t + 1) * state_dim;
            mean[place.clone()].copy_from_slice(&head[..*state_dim]);
            let raw = &head[*state_dim..2 * *state_dim];
            log_variance[place.clone()].copy_from_slice(raw);
            if network.bounded_variances {
                let (centre, half_range) = network.log_variance_range();
                let bound = |v: &mut f32| *v = centre + half_range * (*v / half_range).tanh();
                log_variance[place].iter_mut().for_each(bound);
            }
        }
    }
}

/// The start rows of each sequence from what its constants add through each tap.
#[inline(always)]
fn start_rows(products: &[f32], width: usize, starts: &mut [f32]) {
    let sequences = products.chunks_exact(TAPS * width);
    for (products, starts) in sequences.zip(starts.chunks_exact_mut(EDGE_KINDS * width)) {
        let (before, rest) = products.split_at(width);
        let (middle, after) = rest.split_at(width);
        for (kind, start) in starts.chunks_exact_mut(width).enumerate() {
            let share = |outside: bool| if outside { 0.0 } else { 1.0 };
            let (first, last) = (share(kind & 1 != 0), share(kind & 2 != 0));
            for (i, start) in start.iter_mut().enumerate() {
                *start = first * before[i] + middle[i] + last * after[i];
            }
        }
    }
}

/// A row with zeros behind it up to whole panels.
fn padded_row(values: &[f32]) -> Vec<f32> {
    let mut row = values.to_vec();
    row.resize(padded(values.len()), 0.0);
    row
}

/// Packs `constant`, `[groups, 3 width]`: every group of inputs but the last (h) and every tap's
/// group of outputs ends at a whole panel.
fn pack_constant(
    constant: &NamedTensor,
    bias: &NamedTensor,
    groups: &[usize],
    width: usize,
) -> Dense {
    let padded_width = padded(width);
    let outputs = TAPS * padded_width;
    let spread = |row: &[f32]| row.chunks_exact(width).flat_map(padded_row).collect::<Vec<_>>();
    let mut weight = Vec::new();
    let mut rows = constant.values.chunks_exact(TAPS * width);
    for (i, &group) in groups.iter().enumerate() {
        weight.extend(rows.by_ref().take(group).flat_map(spread));
        if i + 1 < groups.len() {
            weight.resize(weight.len() + (padded_width - group) * outputs, 0.0);
        }
    }
    let mut middle = vec![0.0; outputs];
    middle[padded_width..padded_width + width].copy_from_slice(&bias.values);
    let weights = PackedWeights::new(&weight, 1, weight.len() / outputs, outputs);
    Dense { weights, bias: middle }
}

/// What the phase adds to the first convolution at each step, `[steps, padded width]`; `weight`
/// has one row for each of the phase's functions in each tap.
fn phase_rows(config: &ModelConfig, weight: &NamedTensor) -> Vec<f32> {
    let (phase, functions) = (config.phase(), config.network.phase_functions);
    let dilation = ModelConfig::dilation(0);
    let zeros = vec![0.0; functions];
    let at =
        |t: Option<usize>| t.and_then(|t| phase.chunks_exact(functions).nth(t)).unwrap_or(&zeros);
    let mut rows = Vec::new();
    for t in 0..config.steps {
        let taps = [at(t.checked_sub(dilation)), at(Some(t)), at(Some(t + dilation))].concat();
        let mut row = vec![0.0; config.network.width];
        for (tap, weight) in taps.iter().zip(weight.values.chunks_exact(row.len())) {
            row.iter_mut().zip(weight).for_each(|(row, weight)| *row += tap * weight);
        }
        rows.extend(padded_row(&row));
    }
    rows
}

/// Packs the two MLPs at each step as one: the hidden layers side by side, and an output layer of
/// two blocks.
fn pack_head(config: &ModelConfig, weights: &Weights) -> Mlp {
    let (width, dim) = (config.network.width, config.state_dim);
    let tensors = |layer: &str, kind: &str| {
        ["mean", "log_variance"].map(|head| &weights[&format!("decoder.{head}.{layer}.{kind}")])
    };
    let side_by_side = |[a, b]: [&NamedTensor; 2], columns: usize| {
        let rows = a.values.chunks_exact(columns).zip(b.values.chunks_exact(columns));
        rows.flat_map(|(a, b)| [a, b].concat()).collect::<Vec<f32>>()
    };
    let hidden = side_by_side(tensors("hidden", "weight"), width);
    let [mean, log_variance] = tensors("output", "weight");
    let zeros = vec![0.0; width * dim];
    let zeros = NamedTensor { shape: vec![width, dim], values: zeros };
    let output =
        [side_by_side([mean, &zeros], dim), side_by_side([&zeros, log_variance], dim)].concat();
    Mlp {
        hidden: Dense {
            weights: PackedWeights::new(&hidden, 1, width, 2 * width),
            bias: padded_row(&side_by_side(tensors("hidden", "bias"), width)),
        },
        output: Dense {
            weights: PackedWeights::new(&output, 1, 2 * width, 2 * dim),
            bias: padded_row(&side_by_side(tensors("output", "bias"), dim)),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::super::config::Activation;
    use super::super::layout::tests::{small, weights};
    use super::*;

    fn ramp(n: usize, seed: usize) -> Vec<f32> {
        (0..n).map(|i| ((i * 31 + seed * 17) % 23) as f32 / 8.0 - 1.4).collect()
    }

    #[test]
    fn a_batch_decodes_as_its_sequences_do_one_by_one() {
        let config = small(Activation::Gelu, true);
        let decoder = PackedDecoder::new(&config, &weights(&config, 3)).unwrap();
        let (h, w) = (ramp(5 * 3, 1), ramp(5 * 4, 2));
        let mut many = decoder.workspace(5);
        let batch = decoder.decode(&h, &w, &mut many);
        let mut one = decoder.workspace(1);
        let size = config.steps * config.state_dim;
        for b in 0..5 {
            let single = decoder.decode(&h[b * 3..(b + 1) * 3], &w[b * 4..(b + 1) * 4], &mut one);
            assert_eq!(single.mean, &batch.mean[b * size..(b + 1) * size]);
            assert_eq!(single.log_variance, &batch.log_variance[b * size..(b + 1) * size]);
        }
    }

    #[test]
    fn a_workspace_carries_nothing_from_one_decoding_to_the_next() {
        let config = small(Activation::Relu, false);
        let decoder = PackedDecoder::new(&config, &weights(&config, 4)).unwrap();
        let mut workspace = decoder.workspace(1);
        let first = decoder.decode(&ramp(3, 1), &ramp(4, 1), &mut workspace).mean.to_vec();
        decoder.decode(&ramp(3, 5), &ramp(4, 9), &mut workspace);
        assert_eq!(decoder.decode(&ramp(3, 1), &ramp(4, 1), &mut workspace).mean, first);
    }

    #[cfg(feature = "train")]
    #[test]
    fn the_packed_decoder_computes_what_burn_does() {
        use super::super::networks::{Networks, Parameters, tensor, values};

        for (activation, residual, phase_functions, bounded) in
            [(Activation::Gelu, true, 1, true), (Activation::Relu, false, 5, false)]
        {
            // Odd sizes: neither panels nor row blocks come out even, and the last dilation is
            // longer than half the sequence.
            let mut config = small(activation, residual);
            (config.network.width, config.steps, config.network.layers) = (19, 13, 4);
            config.network.phase_functions = phase_functions;
            config.network.bounded_variances = bounded;
            config.network.least_log_variance = -3.0;
            let weights = weights(&config, 5);
            let batch = 3;
            let (h, w) = (ramp(batch * 3, 3), ramp(batch * 4, 4));

            let backend = super::super::Backend::Flex;
            let device = backend.device();
            let layout = Layout::of_decoder(&config);
            let flat = layout.from_weights(&weights).unwrap();
            let decoded = Networks::new(&config, backend, &device).decode(
                &Parameters::new(&layout, &flat, &device),
                tensor(h.clone(), [batch, 3], &device),
                tensor(w.clone(), [batch, 4], &device),
            );
            let (mean, log_variance) = (values(decoded.mean), values(decoded.log_variance));

            let decoder = PackedDecoder::new(&config, &weights).unwrap();
            let mut workspace = decoder.workspace(batch);
            let packed = decoder.decode(&h, &w, &mut workspace);
            for b in 0..batch {
                for t in 0..config.steps {
                    for d in 0..2 {
                        let here = (b * config.steps + t) * 2 + d;
                        let there = (t * batch + b) * 2 + d;
                        assert!((packed.mean[here] - mean[there]).abs() < 1e-5);
                        let difference = packed.log_variance[here] - log_variance[there];
                        assert!(difference.abs() < 1e-5);
                    }
                }
            }
        }
    }
}
