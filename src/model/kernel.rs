//! Vectorised products and activations for the packed decoder.
//!
//! One call computes a whole layer: for every row the sum of a start row and of the products of up
//! to three input rows (a convolution's taps) with their weights, then the activation, then the
//! residual connection, all in registers. The weights lie in panels of two vectors' width, so the
//! inner loop reads them in one stream. `pulp` picks the widest instructions of the machine.
//!
//! Vectors never pass through a closure: a closure is compiled without the machine's features, and
//! each instruction in it becomes a call, which made everything five times slower.

use pulp::{Arch, Simd, WithSimd};

use super::config::Activation;

/// Rows that are computed together: with panels of two vectors, 12 accumulators and 4 operands
/// fill the 16 registers of AVX2.
const BLOCK_ROWS: usize = 6;

/// Runs `op` with the widest vectors that this machine has and `pulp` builds by default.
pub(crate) fn dispatch<Op: WithSimd>(op: Op) -> Op::Output {
    #[cfg(target_arch = "x86_64")]
    if let Some(simd) = pulp::x86::V3::try_new() {
        return Simd::vectorize(simd, op);
    }
    Arch::new().dispatch(op)
}

/// Width of a weight panel on this machine: two vectors.
pub(crate) fn panel_width() -> usize {
    struct Width;
    impl WithSimd for Width {
        type Output = usize;
        #[inline(always)]
        fn with_simd<S: Simd>(self, _: S) -> usize {
            2 * S::F32_LANES
        }
    }
    dispatch(Width)
}

/// `n` rounded up to whole panels.
pub(crate) fn padded(n: usize) -> usize {
    n.next_multiple_of(panel_width())
}

/// The weights of a layer, packed.
#[derive(Debug, Clone)]
pub(crate) struct PackedWeights {
    /// Rows that each output row reads.
    pub(crate) taps: usize,
    /// Values that are read of each such row.
    pub(crate) inputs: usize,
    /// Width of an output row, in whole panels.
    pub(crate) outputs: usize,
    panels: Vec<f32>,
}

impl PackedWeights {
    /// Packs `weight`, `[taps * inputs, outputs]` row by row; columns are padded with zeros.
    pub(crate) fn new(weight: &[f32], taps: usize, inputs: usize, outputs: usize) -> Self {
        let rows = taps * inputs;
        assert_eq!(weight.len(), rows * outputs, "a weight for each input and output");
        let width = panel_width();
        let mut panels = Vec::with_capacity(rows * padded(outputs));
        for first in (0..outputs).step_by(width) {
            for row in 0..rows {
                let columns = first..first + width;
                panels.extend(columns.map(|c| match c < outputs {
                    true => weight[row * outputs + c],
                    false => 0.0,
                }));
            }
        }
        Self { taps, inputs, outputs: padded(outputs), panels }
    }
}

/// Where along a sequence a convolution's outer taps fall outside.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Edges {
    /// Steps between the taps.
    pub(crate) dilation: usize,
    /// Steps of a sequence.
    pub(crate) steps: usize,
    /// Sequences side by side: the row of step `t` of sequence `b` is `t * batch + b`.
    pub(crate) batch: usize,
}

/// Kinds of start rows of one sequence: all taps inside, the first outside, the last, both.
pub(crate) const EDGE_KINDS: usize = 4;

impl Edges {
    /// The start row of an output row.
    #[inline(always)]
    pub(crate) fn start(self, row: usize) -> usize {
        let (t, b) = (row / self.batch, row % self.batch);
        let before = usize::from(t < self.dilation);
        let after = usize::from(t + self.dilation >= self.steps);
        b * EDGE_KINDS + before + 2 * after
    }
}

/// One layer's work.
pub(crate) struct Layer<'a> {
    /// The weights.
    pub(crate) weights: &'a PackedWeights,
    /// Input rows.
    pub(crate) x: &'a [f32],
    /// Values from one input row to the next.
    pub(crate) x_stride: usize,
    /// Rows from one tap to the next.
    pub(crate) tap_rows: usize,
    /// Start rows, `weights.outputs` wide.
    pub(crate) start: &'a [f32],
    /// Which start row each output row takes; the first one where there are no edges.
    pub(crate) edges: Option<Edges>,
    /// Number of output rows.
    pub(crate) rows: usize,
    /// The nonlinearity, if any.
    pub(crate) activation: Option<Activation>,
    /// Whether the middle tap's row is added at the end.
    pub(crate) residual: bool,
    /// Output rows.
    pub(crate) out: &'a mut [f32],
    /// Values from one output row to the next.
    pub(crate) out_stride: usize,
}

impl Layer<'_> {
    /// Computes all rows.
    #[inline(always)]
    pub(crate) fn run<S: Simd>(mut self, simd: S) {
        let mut row = 0;
        while row + BLOCK_ROWS <= self.rows {
            self.block::<S, BLOCK_ROWS>(simd, row);
            row += BLOCK_ROWS;
        }
        match self.rows - row {
            0 => {}
            1 => self.block::<S, 1>(simd, row),
            2 => self.block::<S, 2>(simd, row),
            3 => self.block::<S, 3>(simd, row),
            4 => self.block::<S, 4>(simd, row),
            _ => self.block::<S, 5>(simd, row),
        }
    }

    #[inline(always)]
    fn block<S: Simd, const ROWS: usize>(&mut self, simd: S, row: usize) {
        let PackedWeights { taps, inputs, outputs, panels } = self.weights;
        let (taps, inputs, outputs) = (*taps, *inputs, *outputs);
        let width = 2 * S::F32_LANES;
        let (panels, _) = S::as_simd_f32s(panels);
        for (panel, column) in
            panels.chunks_exact(2 * taps * inputs).zip((0..outputs).step_by(width))
        {
            let mut sums = [[simd.splat_f32s(0.0); 2]; ROWS];
            for (m, sums) in sums.iter_mut().enumerate() {
                let start = match self.edges {
                    Some(edges) => edges.start(row + m) * outputs,
                    None => 0,
                };
                *sums = pair::<S>(&self.start[start + column..][..width]);
            }
            for tap in 0..taps {
                let first = (row + tap * self.tap_rows) * self.x_stride;
                let mut x: [&[f32]; ROWS] = [&[]; ROWS];
                for (m, x) in x.iter_mut().enumerate() {
                    *x = &self.x[first + m * self.x_stride..][..inputs];
                }
                let panel = &panel[2 * tap * inputs..][..2 * inputs];
                for k in 0..inputs {
                    let w = [panel[2 * k], panel[2 * k + 1]];
                    for m in 0..ROWS {
                        let x = simd.splat_f32s(x[m][k]);
                        sums[m][0] = simd.mul_add_f32s(x, w[0], sums[m][0]);
                        sums[m][1] = simd.mul_add_f32s(x, w[1], sums[m][1]);
                    }
                }
            }
            for (m, mut sums) in sums.into_iter().enumerate() {
                if let Some(activation) = self.activation {
                    sums[0] = activate(simd, activation, sums[0]);
                    sums[1] = activate(simd, activation, sums[1]);
                }
                if self.residual {
                    let middle = (row + m + self.tap_rows) * self.x_stride + column;
                    let x = pair::<S>(&self.x[middle..][..width]);
                    sums = [simd.add_f32s(sums[0], x[0]), simd.add_f32s(sums[1], x[1])];
                }
                let out = &mut self.out[(row + m) * self.out_stride + column..][..width];
                S::as_mut_simd_f32s(out).0.copy_from_slice(&sums);
            }
        }
    }
}

/// `out = activation(a + b)`, row by row with row `a` of the step and row `b` of the start rows:
/// the first convolution, whose only input that changes along the sequence is known beforehand.
#[inline(always)]
pub(crate) fn add_and_activate<S: Simd>(
    simd: S,
    a: &[f32],
    b: &[f32],
    activation: Activation,
    out: &mut [f32],
) {
    let (a, b) = (S::as_simd_f32s(a).0, S::as_simd_f32s(b).0);
    for ((a, b), out) in a.iter().zip(b).zip(S::as_mut_simd_f32s(out).0) {
        *out = activate(simd, activation, simd.add_f32s(*a, *b));
    }
}

/// Activations in place of the values before them, with the slope of each where a backward pass
/// wants it.
#[cfg(feature = "train")]
pub(crate) struct Activate<'a> {
    /// The nonlinearity.
    pub(crate) activation: Activation,
    /// Values, and then activations.
    pub(crate) values: &'a mut [f32],
    /// A slope for each value; empty where none are wanted.
    pub(crate) slopes: &'a mut [f32],
}

#[cfg(feature = "train")]
impl WithSimd for Activate<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { activation, values, slopes } = self;
        let (values, rest) = S::as_mut_simd_f32s(values);
        let (slopes, rest_slopes) = S::as_mut_simd_f32s(slopes);
        if slopes.is_empty() {
            values.iter_mut().for_each(|x| *x = activate(simd, activation, *x));
        }
        for (x, slope) in values.iter_mut().zip(slopes) {
            *slope = activation_slope(simd, activation, *x);
            *x = activate(simd, activation, *x);
        }
        // What does not fill a vector: in the first lanes of one.
        if !rest.is_empty() {
            let x = simd.partial_load_f32s(rest);
            simd.partial_store_f32s(rest_slopes, activation_slope(simd, activation, x));
            simd.partial_store_f32s(rest, activate(simd, activation, x));
        }
    }
}

/// Two vectors from as many values.
#[inline(always)]
fn pair<S: Simd>(values: &[f32]) -> [S::f32s; 2] {
    let (vectors, _) = S::as_simd_f32s(values);
    [vectors[0], vectors[1]]
}

#[inline(always)]
fn activate<S: Simd>(simd: S, activation: Activation, x: S::f32s) -> S::f32s {
    match activation {
        Activation::Relu => simd.max_f32s(x, simd.splat_f32s(0.0)),
        Activation::Gelu => gelu(simd, x),
    }
}

/// `erf(x / sqrt 2) = x P(x^2) / Q(x^2)` on `[-5.25, 5.25]`, to 7e-9 before rounding; beyond, erf
/// is 1 within the same error. Our own fit: `tests/golden/erf.py`.
const ERF_RANGE: f32 = 5.25;
const ERF_P: [f32; 6] =
    [0.797_884_5, 0.065_444_51, 0.009_234_113, 3.168_001_5e-4, 1.278_106_7e-5, 4.878_59e-8];
const ERF_Q: [f32; 6] =
    [1.0, 0.248_688_83, 0.028_022_085, 1.825_752_9e-3, 7.085_325e-5, 1.247_880_9e-6];

/// `x Phi(x)` with the error function.
#[inline(always)]
fn gelu<S: Simd>(simd: S, x: S::f32s) -> S::f32s {
    let limit = simd.splat_f32s(ERF_RANGE);
    let clamped = simd.max_f32s(simd.min_f32s(x, limit), simd.neg_f32s(limit));
    let u = simd.mul_f32s(clamped, clamped);
    let (p, q) = (polynomial(simd, ERF_P, u), polynomial(simd, ERF_Q, u));
    let erf = simd.div_f32s(simd.mul_f32s(clamped, p), q);
    let half = simd.mul_f32s(x, simd.splat_f32s(0.5));
    simd.mul_add_f32s(half, erf, half)
}

/// The activation's derivative.
#[cfg(feature = "train")]
#[inline(always)]
fn activation_slope<S: Simd>(simd: S, activation: Activation, x: S::f32s) -> S::f32s {
    match activation {
        Activation::Relu => {
            let zero = simd.splat_f32s(0.0);
            simd.select_f32s(simd.greater_than_f32s(x, zero), simd.splat_f32s(1.0), zero)
        }
        Activation::Gelu => gelu_slope(simd, x),
    }
}

/// `gelu'(x) - 1 / 2 = x P(x^2) / Q(x^2)` on `[-5.5, 5.5]`, to 6e-8 before rounding; it is odd and
/// ±1/2 beyond to 6e-7. Our own fit: `tests/golden/erf.py`.
#[cfg(feature = "train")]
const SLOPE_RANGE: f32 = 5.5;
#[cfg(feature = "train")]
const SLOPE_P: [f32; 7] = [
    0.797_884_6,
    0.011_832_512,
    0.012_260_671,
    8.076_608e-4,
    3.124_063e-5,
    2.192_207_8e-6,
    1.240_079_8e-8,
];
#[cfg(feature = "train")]
const SLOPE_Q: [f32; 7] = [
    1.0,
    0.348_163_43,
    0.056_420_308,
    0.005_612_190_3,
    3.761_184_6e-4,
    1.722_848_9e-5,
    5.419_877e-7,
];

/// `Phi(x) + x phi(x)`.
#[cfg(feature = "train")]
#[inline(always)]
fn gelu_slope<S: Simd>(simd: S, x: S::f32s) -> S::f32s {
    let limit = simd.splat_f32s(SLOPE_RANGE);
    let clamped = simd.max_f32s(simd.min_f32s(x, limit), simd.neg_f32s(limit));
    let u = simd.mul_f32s(clamped, clamped);
    let (p, q) = (polynomial(simd, SLOPE_P, u), polynomial(simd, SLOPE_Q, u));
    let odd = simd.div_f32s(simd.mul_f32s(clamped, p), q);
    simd.add_f32s(odd, simd.splat_f32s(0.5))
}

#[inline(always)]
fn polynomial<S: Simd, const N: usize>(simd: S, coefficients: [f32; N], x: S::f32s) -> S::f32s {
    let mut value = simd.splat_f32s(coefficients[N - 1]);
    for i in (0..N - 1).rev() {
        value = simd.mul_add_f32s(value, x, simd.splat_f32s(coefficients[i]));
    }
    value
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Apply<'a>(&'a [f32], &'a mut [f32], Activation);

    impl WithSimd for Apply<'_> {
        type Output = ();
        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) {
            add_and_activate(simd, self.0, &vec![0.0; self.0.len()], self.2, self.1);
        }
    }

    #[test]
    fn gelu_is_that_of_the_error_function() {
        // 0.5 x (1 + erf(x / sqrt 2)) in double precision, from Python's math.erf.
        let known: [(f32, f64); 9] = [
            (-6.0, -5.919_525_87e-9),
            (-4.0, -1.266_849_673_325e-4),
            (-1.0, -0.158_655_253_931_457_07),
            (-0.1, -0.046_017_216_272_297_1),
            (0.0, 0.0),
            (0.5, 0.345_731_230_637_006_65),
            (1.5, 1.399_789_198_096_713),
            (3.0, 2.995_950_305_905_11),
            (7.0, 6.999_999_999_991_041),
        ];
        let mut x = vec![0.0; 16];
        let mut y = vec![0.0; 16];
        for (x, (value, _)) in x.iter_mut().zip(known) {
            *x = value;
        }
        dispatch(Apply(&x, &mut y, Activation::Gelu));
        for (y, (x, expected)) in y.iter().zip(known) {
            let error = (f64::from(*y) - expected).abs();
            assert!(error < 3e-7 * f64::from(x).abs().max(1.0), "gelu({x}) = {y}, not {expected}");
        }
    }

    #[cfg(feature = "train")]
    #[test]
    fn activations_come_with_their_slopes() {
        // Phi(x) + x phi(x) in double precision, from Python's math.erf and math.exp.
        let known: [(f32, f64); 7] = [
            (-6.0, -3.546_870_95e-8),
            (-4.0, -5.036_496_61e-4),
            (-1.0, -0.083_315_470_587_686),
            (0.0, 0.5),
            (0.5, 0.867_495_124_656_163),
            (3.0, 1.011_945_647_204_184),
            (7.0, 1.000_000_000_062_67),
        ];
        // Longer than any vector by a bit, so that there is a rest.
        let x: Vec<f32> = known.iter().cycle().take(37).map(|(x, _)| *x).collect();
        for activation in [Activation::Gelu, Activation::Relu] {
            let (mut values, mut slopes) = (x.clone(), vec![0.0; x.len()]);
            dispatch(Activate { activation, values: &mut values, slopes: &mut slopes });
            let mut alone = x.clone();
            dispatch(Activate { activation, values: &mut alone, slopes: &mut [] });
            assert_eq!(alone, values);
            for (slope, (x, gelu)) in slopes.iter().zip(known.iter().cycle()) {
                let expected = match activation {
                    Activation::Gelu => *gelu,
                    Activation::Relu => f64::from(*x > 0.0),
                };
                let error = (f64::from(*slope) - expected).abs();
                assert!(error < 1e-6, "{activation:?}'({x}) = {slope}, not {expected}");
            }
        }
    }

    #[test]
    fn a_layer_is_its_matrix_product() {
        let (taps, inputs, outputs, rows) = (3, 5, 7, 11);
        let value = |i: usize| ((i * 7919 % 101) as f32 - 50.0) / 50.0;
        let weight: Vec<f32> = (0..taps * inputs * outputs).map(value).collect();
        let weights = PackedWeights::new(&weight, taps, inputs, outputs);
        let x: Vec<f32> = (0..(rows + taps - 1) * inputs).map(|i| value(i + 13)).collect();
        let start = vec![0.25; weights.outputs];
        let mut out = vec![0.0; rows * weights.outputs];
        let out_stride = weights.outputs;

        struct Run<'a>(Layer<'a>);
        impl WithSimd for Run<'_> {
            type Output = ();
            #[inline(always)]
            fn with_simd<S: Simd>(self, simd: S) {
                self.0.run(simd);
            }
        }
        dispatch(Run(Layer {
            weights: &weights,
            x: &x,
            x_stride: inputs,
            tap_rows: 1,
            start: &start,
            edges: None,
            rows,
            activation: Some(Activation::Relu),
            residual: false,
            out: &mut out,
            out_stride,
        }));
        for row in 0..rows {
            for column in 0..outputs {
                let products = (0..taps * inputs)
                    .map(|k| x[row * inputs + k] * weight[k * outputs + column])
                    .sum::<f32>();
                let expected = (0.25 + products).max(0.0);
                assert!((out[row * out_stride + column] - expected).abs() < 1e-5);
            }
        }
    }
}
