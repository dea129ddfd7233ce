//! The networks, the objective, its gradients and one step of Adam against PyTorch
//! (tests/golden/tcvae.py).
#![cfg(feature = "train")]

use std::collections::BTreeMap;

use serde::Deserialize;
use tcvae::model::{
    Backend, Batch, Layout, ModelConfig, NamedTensor, Objective, PackedDecoder, PartGradients,
    Strengths, Weights,
};
use tcvae::training::Adam;

#[derive(Deserialize)]
struct Tensor {
    shape: Vec<usize>,
    values: Vec<f32>,
}

#[derive(Deserialize)]
struct Case {
    model: ModelConfig,
    adversary_width: usize,
    alpha: f32,
    beta: f32,
    learning_rate: f64,
    batch: usize,
    x: Vec<f32>,
    w: Vec<f32>,
    noise: Vec<f32>,
    weights: BTreeMap<String, Tensor>,
    h: Vec<f32>,
    decoded_mean: Vec<f32>,
    decoded_log_variance: Vec<f32>,
    negative_log_likelihood: f64,
    kl: Vec<f64>,
    adversary: f64,
    gradients: BTreeMap<String, Tensor>,
    after_one_step: BTreeMap<String, Tensor>,
}

fn cases() -> Vec<Case> {
    serde_json::from_str(include_str!("golden/tcvae.json")).expect("the script wrote it")
}

fn weights(tensors: &BTreeMap<String, Tensor>) -> Weights {
    let named = |t: &Tensor| NamedTensor { shape: t.shape.clone(), values: t.values.clone() };
    tensors.iter().map(|(name, t)| (name.clone(), named(t))).collect()
}

/// `[batch, steps, dim]` as `[steps, batch, dim]`.
fn time_major(case: &Case) -> Vec<f32> {
    let ModelConfig { steps, state_dim, .. } = case.model;
    let row = |t: usize, b: usize| &case.x[(b * steps + t) * state_dim..][..state_dim];
    (0..steps).flat_map(|t| (0..case.batch).flat_map(move |b| row(t, b))).copied().collect()
}

impl Case {
    fn layouts(&self) -> [Layout; 2] {
        [Layout::of_model(&self.model), Layout::of_adversary(&self.model, self.adversary_width)]
    }

    fn flat(&self, tensors: &BTreeMap<String, Tensor>) -> [Vec<f32>; 2] {
        self.layouts().map(|layout| layout.from_weights(&weights(tensors)).expect("its shapes"))
    }

    /// The gradients as our program computes them.
    fn computed(&self, backend: Backend) -> PartGradients {
        let part = Batch {
            sequences: self.batch,
            x: time_major(self),
            w: self.w.clone(),
            noise: self.noise.clone(),
            anchors: Vec::new(),
        };
        let strengths = Strengths { beta: self.beta, alpha: self.alpha, gamma: 0.0 };
        let [model, adversary] = self.flat(&self.weights);
        Objective::new(&self.model, self.adversary_width, backend)
            .gradients(&model, &adversary, &part, self.batch, strengths)
    }
}

#[track_caller]
fn assert_close(what: &str, found: &[f32], expected: &[f32], tolerance: f32) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let scale = expected.iter().fold(1e-3f32, |m, v| m.max(v.abs()));
    for (i, (f, e)) in found.iter().zip(expected).enumerate() {
        assert!((f - e).abs() <= tolerance * scale, "{what}[{i}] is {f}, PyTorch has {e}");
    }
}

#[test]
fn the_terms_of_the_objective_are_pytorchs_on_every_backend() {
    for case in cases() {
        for &backend in Backend::ALL {
            let terms = case.computed(backend).terms;
            let relative = |found: f64, expected: f64| (found - expected).abs() / expected.abs();
            assert!(relative(terms.negative_log_likelihood, case.negative_log_likelihood) < 1e-5);
            assert!(relative(terms.adversary, case.adversary) < 1e-5);
            for (found, expected) in terms.kl.iter().zip(&case.kl) {
                assert!((found - expected).abs() < 1e-5, "{found} {expected}");
            }
        }
    }
}

#[test]
fn every_gradient_is_pytorchs_on_every_backend() {
    for case in cases() {
        let expected = weights(&case.gradients);
        for &backend in Backend::ALL {
            let PartGradients { model, adversary, .. } = case.computed(backend);
            for (layout, found) in case.layouts().iter().zip([model, adversary]) {
                for (name, found) in layout.to_weights(&found) {
                    let what = format!("{backend}: gradient of {name}");
                    assert_close(&what, &found.values, &expected[&name].values, 1e-5);
                }
            }
        }
    }
}

#[test]
fn a_step_of_adam_lands_where_pytorchs_does() {
    for case in cases() {
        let PartGradients { model, adversary, .. } = case.computed(Backend::default());
        let starts = case.flat(&case.weights);
        let ends = case.flat(&case.after_one_step);
        for ((start, gradient), end) in starts.into_iter().zip([model, adversary]).zip(ends) {
            let mut adam = Adam::new(start);
            adam.step(&gradient, case.learning_rate);
            assert_close("after one step", &adam.values, &end, 1e-5);
        }
    }
}

#[test]
fn the_packed_decoder_decodes_as_pytorch_does() {
    for case in cases() {
        let decoder = PackedDecoder::new(&case.model, &weights(&case.weights)).unwrap();
        let mut workspace = decoder.workspace(case.batch);
        let decoded = decoder.decode(&case.h, &case.w, &mut workspace);
        assert_close("mean", decoded.mean, &case.decoded_mean, 1e-5);
        assert_close("log-variance", decoded.log_variance, &case.decoded_log_variance, 1e-5);
    }
}
