//! A whole layer as one operation of Burn, with its backward pass written by hand.
//!
//! Burn's own operations pass over a layer's values some twenty times, forwards and backwards: a
//! product for each tap, sums, and five steps of a GELU whose error function and exponential are
//! computed value by value. Here the products add up in place and the activation comes with its slope
//! in one vectorised pass. It runs on Flex; other backends compose Burn's operations
//! ([`super::networks`]), and the two are tested to agree.

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::ops::FloatTensorOps;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, TensorMetadata, backend_extension};
use burn::tensor::{Tensor, TensorData};

use super::config::{Activation, TAPS};
use super::kernel::{Activate, dispatch};

/// How a layer computes `act(sum_k x[t + (k - 1) dilation] W_k + bias + constants) (+ x)`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct LayerShape {
    /// Rows from one tap to the next, time-major: dilation times batch; none for a dense layer,
    /// whose only tap is the row itself.
    pub(crate) reach: Option<usize>,
    /// The nonlinearity, if any.
    pub(crate) activation: Option<Activation>,
    /// Whether `x` is added at the end.
    pub(crate) residual: bool,
}

/// The operation, as Burn extends its backends.
#[backend_extension(Flex, Autodiff)]
pub(crate) trait FusedLayer: Backend {
    /// The layer of `x`, `[rows, inputs]`, with `weight`, `[taps * inputs, outputs]`, `bias`,
    /// `[1, outputs]`, and `constants`: each sequence's share of what does not change along it through
    /// each tap, `[batch, taps * outputs]`; one of no rows stands for none.
    fn fused_layer(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        constants: FloatTensor<Self>,
        shape: LayerShape,
    ) -> FloatTensor<Self>;
}

/// [`FusedLayer::fused_layer`] of tensors.
pub(crate) fn layer(
    x: Tensor<2>,
    weight: Tensor<2>,
    bias: Tensor<2>,
    constants: Option<Tensor<2>>,
    shape: LayerShape,
) -> Tensor<2> {
    let constants = constants.unwrap_or_else(|| Tensor::empty([0, 0], &x.device()));
    Tensor::from_dispatch(Dispatch::fused_layer(
        x.into_dispatch(),
        weight.into_dispatch(),
        bias.into_dispatch(),
        constants.into_dispatch(),
        shape,
    ))
}

impl FusedLayer for Flex {
    fn fused_layer(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        constants: FloatTensor<Self>,
        shape: LayerShape,
    ) -> FloatTensor<Self> {
        forward([&x, &weight, &bias, &constants], shape, false).0
    }
}

impl<C: CheckpointStrategy> FusedLayer for Autodiff<Flex, C> {
    fn fused_layer(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        constants: FloatTensor<Self>,
        shape: LayerShape,
    ) -> FloatTensor<Self> {
        let nodes = [x.node(), weight.node(), bias.node(), constants.node()];
        let [x, weight, bias, constants] =
            [x, weight, bias, constants].map(|tensor| tensor.into_primitive());
        let inputs = [&x, &weight, &bias, &constants];
        match LayerBackward.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prepared) => {
                let (out, slopes) = forward(inputs, shape, true);
                let constants = constants.shape()[0];
                prepared.finish(Kept { x, weight, constants, slopes, shape }, out)
            }
            OpsKind::UnTracked(prepared) => prepared.finish(forward(inputs, shape, false).0),
        }
    }
}

type Array = FloatTensor<Flex>;

/// What a backward pass needs of the forward pass.
#[derive(Debug, Clone)]
struct Kept {
    x: Array,
    weight: Array,
    /// Rows of the constants.
    constants: usize,
    /// Slopes of the activation; none without one.
    slopes: Option<Array>,
    shape: LayerShape,
}

#[derive(Debug)]
struct LayerBackward;

impl Backward<Flex, 4> for LayerBackward {
    type State = Kept;

    fn backward(self, ops: Ops<Kept, 4>, gradients: &mut Gradients, _: &mut Checkpointer) {
        let gradient = gradients.consume::<Flex>(&ops.node);
        let wanted = ops.parents.each_ref().map(Option::is_some);
        let of_inputs = backward(&gradient, &ops.state, wanted);
        for (node, gradient) in ops.parents.into_iter().zip(of_inputs) {
            if let (Some(node), Some(gradient)) = (node, gradient) {
                gradients.register::<Flex>(node.id, gradient);
            }
        }
    }
}

fn forward(inputs: [&Array; 4], shape: LayerShape, keep: bool) -> (Array, Option<Array>) {
    let [x, weight, bias, constants] = inputs.map(Array::to_contiguous);
    let [rows, outputs] = [x.shape()[0], weight.shape()[1]];
    let batch = constants.shape()[0];
    let mut out = starts(values(&bias), values(&constants), batch, rows, shape.reach);
    let (x, weight) = (Matrix::of(&x), Matrix::of(&weight));
    for tap in taps(shape.reach, rows) {
        let out = &mut out[tap.out * outputs..][..tap.rows * outputs];
        let weight = weight.rows(tap.weight * x.shape[1], x.shape[1]);
        add_product(out, x.rows(tap.x, tap.rows), weight);
    }
    let mut slopes = Vec::new();
    if let Some(activation) = shape.activation {
        slopes.resize(if keep { out.len() } else { 0 }, 0.0);
        dispatch(Activate { activation, values: &mut out, slopes: &mut slopes });
    }
    if shape.residual {
        add(&mut out, x.values);
    }
    let slopes = (!slopes.is_empty()).then(|| array(slopes, [rows, outputs]));
    (array(out, [rows, outputs]), slopes)
}

fn backward(gradient: &Array, kept: &Kept, wanted: [bool; 4]) -> [Option<Array>; 4] {
    let Kept { x, weight, constants, slopes, shape } = kept;
    let [gradient, x, weight] = [gradient, x, weight].map(Array::to_contiguous);
    let [x_wanted, weight_wanted, bias_wanted, constants_wanted] = wanted;
    let [rows, inputs, outputs] = [x.shape()[0], x.shape()[1], weight.shape()[1]];
    // The gradient before the activation.
    let sloped: Option<Vec<f32>> = slopes.as_ref().map(|slopes| {
        values(&gradient)
            .iter()
            .zip(values(slopes))
            .map(|(gradient, slope)| gradient * slope)
            .collect()
    });
    let before = sloped.as_deref().unwrap_or(values(&gradient));
    let before = Matrix::new(before, outputs);

    let of_x = x_wanted.then(|| {
        let mut of_x = match shape.residual {
            true => values(&gradient).to_vec(),
            false => vec![0.0; rows * inputs],
        };
        for tap in taps(shape.reach, rows) {
            let weight = Matrix::of(&weight).rows(tap.weight * inputs, inputs);
            let of_x = &mut of_x[tap.x * inputs..][..tap.rows * inputs];
            add_product(of_x, before.rows(tap.out, tap.rows), weight.transposed());
        }
        array(of_x, [rows, inputs])
    });
    let of_weight = weight_wanted.then(|| {
        let mut of_weight = vec![0.0; weight.shape()[0] * outputs];
        for tap in taps(shape.reach, rows) {
            let x = Matrix::of(&x).rows(tap.x, tap.rows);
            let of_tap = &mut of_weight[tap.weight * inputs * outputs..][..inputs * outputs];
            add_product(of_tap, x.transposed(), before.rows(tap.out, tap.rows));
        }
        array(of_weight, [weight.shape()[0], outputs])
    });
    let of_bias = bias_wanted.then(|| array(sum_of_blocks(before.values, outputs), [1, outputs]));
    let of_constants = constants_wanted.then(|| {
        let batch = *constants;
        let block = batch * outputs;
        let mut of_constants = vec![0.0; TAPS * block];
        for tap in taps(shape.reach, rows) {
            let of_tap =
                sum_of_blocks(&before.values[tap.out * outputs..][..tap.rows * outputs], block);
            for (b, row) in of_tap.chunks_exact(outputs).enumerate() {
                let start = (b * TAPS + tap.weight) * outputs;
                of_constants[start..start + outputs].copy_from_slice(row);
            }
        }
        array(of_constants, [batch, TAPS * outputs])
    });
    [of_x, of_weight, of_bias, of_constants]
}

/// Rows that one tap of a layer takes from its input to its output.
struct Tap {
    /// Number of the tap, and so of its part of the weight.
    weight: usize,
    /// First row of the input.
    x: usize,
    /// First row of the output.
    out: usize,
    /// Number of rows.
    rows: usize,
}

/// The taps that reach into a sequence of that many rows.
fn taps(reach: Option<usize>, rows: usize) -> Vec<Tap> {
    match reach {
        None => vec![Tap { weight: 0, x: 0, out: 0, rows }],
        Some(reach) => {
            let middle = Tap { weight: 1, x: 0, out: 0, rows };
            let inside = rows.saturating_sub(reach);
            let before = Tap { weight: 0, x: 0, out: reach, rows: inside };
            let after = Tap { weight: 2, x: reach, out: 0, rows: inside };
            [middle, before, after].into_iter().filter(|tap| tap.rows > 0).collect()
        }
    }
}

/// What the products are added to: the bias, and the constants through the taps that lie inside.
fn starts(
    bias: &[f32],
    constants: &[f32],
    batch: usize,
    rows: usize,
    reach: Option<usize>,
) -> Vec<f32> {
    let outputs = bias.len();
    let mut out = bias.repeat(rows);
    if batch == 0 {
        return out;
    }
    for tap in taps(reach, rows) {
        let rows = &mut out[tap.out * outputs..][..tap.rows * outputs];
        for step in rows.chunks_exact_mut(batch * outputs) {
            let constants = constants.chunks_exact(TAPS * outputs);
            for (row, constants) in step.chunks_exact_mut(outputs).zip(constants) {
                add(row, &constants[tap.weight * outputs..][..outputs]);
            }
        }
    }
    out
}

/// The sum of equal blocks of values.
fn sum_of_blocks(values: &[f32], block: usize) -> Vec<f32> {
    let mut sum = vec![0.0; block];
    values.chunks_exact(block).for_each(|block| add(&mut sum, block));
    sum
}

fn add(to: &mut [f32], more: &[f32]) {
    to.iter_mut().zip(more).for_each(|(a, b)| *a += b);
}

fn values(array: &Array) -> &[f32] {
    array.as_slice().expect("contiguous f32")
}

fn array(values: Vec<f32>, shape: [usize; 2]) -> Array {
    Flex::float_from_data(TensorData::new(values, shape), &Default::default())
}

/// A matrix whose rows or columns lie one after the other.
#[derive(Clone, Copy)]
struct Matrix<'a> {
    values: &'a [f32],
    shape: [usize; 2],
    /// Values from one row to the next, and from one column to the next.
    strides: [usize; 2],
}

impl<'a> Matrix<'a> {
    /// Row by row.
    fn new(values: &'a [f32], columns: usize) -> Self {
        Self { values, shape: [values.len() / columns, columns], strides: [columns, 1] }
    }

    fn of(array: &'a Array) -> Self {
        Self::new(values(array), array.shape()[1])
    }

    fn rows(self, first: usize, count: usize) -> Self {
        let columns = self.shape[1];
        Self::new(&self.values[first * columns..][..count * columns], columns)
    }

    fn transposed(self) -> Self {
        let ([rows, columns], [down, right]) = (self.shape, self.strides);
        Self { shape: [columns, rows], strides: [right, down], ..self }
    }
}

/// Adds the product `a b` to `out`, row by row.
fn add_product(out: &mut [f32], a: Matrix<'_>, b: Matrix<'_>) {
    let ([rows, inner], columns) = (a.shape, b.shape[1]);
    assert_eq!(inner, b.shape[0], "inner sizes");
    assert_eq!(out.len(), rows * columns, "outer sizes");
    let [[a_down, a_right], [b_down, b_right]] =
        [a.strides, b.strides].map(|strides| strides.map(|s| s as isize));
    #[expect(unsafe_code, reason = "the product of matrices that is fast has no safe signature")]
    // SAFETY: a matrix holds as many values as its rows and columns ask for, one after the other
    // (`Matrix::new` divides, `rows` cuts, `transposed` swaps), `out` was just checked to, and it is
    // borrowed mutably, so it overlaps neither.
    unsafe {
        gemm::gemm(
            rows,
            columns,
            inner,
            out.as_mut_ptr(),
            1,
            columns as isize,
            true,
            a.values.as_ptr(),
            a_right,
            a_down,
            b.values.as_ptr(),
            b_right,
            b_down,
            1.0,
            1.0,
            false,
            false,
            false,
            gemm::Parallelism::None,
        );
    }
}
