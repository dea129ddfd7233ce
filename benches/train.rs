//! Time of one training step (recognition network, decoder, adversary, both Adams), at the arcs' size.
//!
//! `cargo bench --bench train`. With `TCVAE_TRAIN_PEER` naming a folder, it takes the steps that
//! `benches/peers/train.py` asks for instead. A batch is computed in as many parts as rayon has
//! threads (`RAYON_NUM_THREADS`).

use std::hint::black_box;
use std::path::Path;
use std::time::Instant;

use criterion::{BenchmarkId, Criterion};
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use rayon::prelude::*;
use safetensors::SafeTensors;
use serde::Deserialize;
use tcvae::model::{
    Backend, Batch, Layout, ModelConfig, NamedTensor, NetworkConfig, Objective, PartGradients,
    Strengths, Weights,
};
use tcvae::training::Adam;

fn main() {
    match std::env::var_os("TCVAE_TRAIN_PEER") {
        Some(folder) => beside_a_peer(Path::new(&folder)),
        None => {
            let mut criterion = Criterion::default().configure_from_args();
            shapes(&mut criterion);
            criterion.final_summary();
        }
    }
}

/// A training in the middle of it.
struct Training {
    objective: Objective,
    model: Adam,
    adversary: Adam,
    parts: Vec<Batch>,
    strengths: Strengths,
    learning_rate: f64,
}

impl Training {
    /// One step; returns the mean negative log-likelihood before it.
    fn step(&mut self) -> f64 {
        let sequences = self.parts.iter().map(|part| part.sequences).sum();
        let gradients = |part: &Batch| {
            let (model, adversary) = (&self.model.values, &self.adversary.values);
            self.objective.gradients(model, adversary, part, sequences, self.strengths)
        };
        let parts: Vec<PartGradients> = self.parts.par_iter().map(gradients).collect();
        let mut parts = parts.into_iter();
        let mut sum = parts.next().expect("at least one part");
        for part in parts {
            let add = |a: &mut [f32], b: &[f32]| a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
            add(&mut sum.model, &part.model);
            add(&mut sum.adversary, &part.adversary);
            sum.terms.add(&part.terms);
        }
        self.model.step(&sum.model, self.learning_rate);
        self.adversary.step(&sum.adversary, self.learning_rate);
        sum.terms.negative_log_likelihood / sequences as f64
    }
}

/// The sequences of a batch, time-major, in as many parts as there are threads.
fn parts(
    config: &ModelConfig,
    sequences: usize,
    x: &[f32],
    w: &[f32],
    noise: &[f32],
) -> Vec<Batch> {
    let ModelConfig { steps, state_dim, task_dim, network } = config;
    let indices: Vec<usize> = (0..sequences).collect();
    let part = |indices: &[usize]| {
        let (first, count) = (indices[0], indices.len());
        let state = |t: usize| {
            let start = (t * sequences + first) * state_dim;
            x[start..start + count * state_dim].iter().copied()
        };
        let rows = |values: &[f32], dim: usize| values[first * dim..(first + count) * dim].to_vec();
        Batch {
            sequences: count,
            x: (0..*steps).flat_map(state).collect(),
            w: rows(w, *task_dim),
            noise: rows(noise, network.latents),
            anchors: Vec::new(),
        }
    };
    indices.chunks(sequences.div_ceil(rayon::current_num_threads())).map(part).collect()
}

fn shapes(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("training step");
    for width in [32, 64] {
        let network = NetworkConfig { width, ..NetworkConfig::default() };
        let config = ModelConfig { steps: 32, state_dim: 2, task_dim: 2, network };
        for batch in [16, 128] {
            let mut rng = ChaCha8Rng::seed_from_u64(1);
            let mut start = |layout: Layout| Adam::new(layout.initial(&mut rng));
            let value = |i: usize| ((i * 7919 % 101) as f32 - 50.0) / 30.0;
            let values = |count: usize| (0..count).map(value).collect::<Vec<_>>();
            let [x, w, noise] = [32 * 2, 2, 4].map(|size| values(batch * size));
            let mut training = Training {
                model: start(Layout::of_model(&config)),
                adversary: start(Layout::of_adversary(&config, 64)),
                objective: Objective::new(&config, 64, Backend::default()),
                parts: parts(&config, batch, &x, &w, &noise),
                strengths: Strengths { beta: 4.0, alpha: 50.0, gamma: 0.0 },
                learning_rate: 1e-3,
            };
            let id = BenchmarkId::new(format!("width {width}"), format!("batch {batch}"));
            group.bench_function(id, |bencher| bencher.iter(|| black_box(training.step())));
        }
    }
    group.finish();
}

/// What the script asks for.
#[derive(Deserialize)]
struct Asked {
    model: ModelConfig,
    adversary_width: usize,
    alpha: f32,
    beta: f32,
    learning_rate: f64,
    /// Steps whose likelihoods the script compares with its own.
    compared: usize,
    seconds: f64,
}

/// Takes steps from the script's start values on the script's batch: prints the likelihoods of the
/// first ones, and then the times of more (µs), one a line.
fn beside_a_peer(folder: &Path) {
    let read = |name: &str| std::fs::read(folder.join(name)).expect("the script wrote it");
    let asked: Asked = serde_json::from_slice(&read("asked.json")).expect("what is asked");
    let bytes = read("tensors.safetensors");
    let tensor = |(name, view): (String, safetensors::tensor::TensorView<'_>)| {
        let value = |b: &[u8]| f32::from_le_bytes(b.try_into().expect("four bytes"));
        let values = view.data().chunks_exact(4).map(value).collect();
        (name, NamedTensor { shape: view.shape().to_vec(), values })
    };
    let file = SafeTensors::deserialize(&bytes).expect("a safetensors file");
    let tensors: Weights = file.tensors().into_iter().map(tensor).collect();
    let start = |layout: Layout| Adam::new(layout.from_weights(&tensors).expect("its weights"));
    let Asked { model, adversary_width, alpha, beta, learning_rate, compared, seconds } = asked;
    let [x, w, noise] = ["x", "w", "noise"].map(|name| &tensors[name]);
    let mut training = Training {
        model: start(Layout::of_model(&model)),
        adversary: start(Layout::of_adversary(&model, adversary_width)),
        objective: Objective::new(&model, adversary_width, Backend::default()),
        parts: parts(&model, w.shape[0], &x.values, &w.values, &noise.values),
        strengths: Strengths { beta, alpha, gamma: 0.0 },
        learning_rate,
    };
    for _ in 0..compared {
        println!("{}", training.step());
    }
    println!("times");
    let began = Instant::now();
    while began.elapsed().as_secs_f64() < seconds {
        let start = Instant::now();
        black_box(training.step());
        println!("{:.1}", start.elapsed().as_secs_f64() * 1e6);
    }
}
