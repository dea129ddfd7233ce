//! Time of one decode, at the sizes of the shipped models and at those of the peers' comparison.
//!
//! `cargo bench --no-default-features --bench decode` needs neither Burn nor ROS. With
//! `TCVAE_DECODE_PEER` naming a folder, it decodes what `benches/peers/decode.py` put there instead.

use std::hint::black_box;
use std::path::Path;
use std::time::Instant;

use criterion::{BenchmarkId, Criterion};
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use safetensors::SafeTensors;
use tcvae::model::{Layout, ModelConfig, NamedTensor, NetworkConfig, PackedDecoder, Weights};

fn main() {
    match std::env::var_os("TCVAE_DECODE_PEER") {
        Some(folder) => beside_a_peer(Path::new(&folder)),
        None => {
            let mut criterion = Criterion::default().configure_from_args();
            shapes(&mut criterion);
            criterion.final_summary();
        }
    }
}

fn shapes(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("decode");
    for (width, steps, state_dim, task_dim) in [(32, 32, 2, 2), (64, 64, 2, 2), (32, 100, 6, 4)] {
        let network = NetworkConfig { width, ..NetworkConfig::default() };
        let config = ModelConfig { steps, state_dim, task_dim, network };
        let layout = Layout::of_decoder(&config);
        let values = layout.initial(&mut ChaCha8Rng::seed_from_u64(1));
        let decoder =
            PackedDecoder::new(&config, &layout.to_weights(&values)).expect("its own weights");
        for batch in [1, 16] {
            let (h, w) = (vec![0.5; batch * 4], vec![-0.25; batch * task_dim]);
            let mut workspace = decoder.workspace(batch);
            let id = BenchmarkId::new(format!("width {width}, {steps} steps"), batch);
            group.bench_function(id, |bencher| {
                bencher.iter(|| {
                    let decoded = decoder.decode(black_box(&h), black_box(&w), &mut workspace);
                    black_box(decoded.mean[0])
                });
            });
        }
    }
    group.finish();
}

/// Decodes the script's inputs with the script's weights, prints the times (µs, one a line), and
/// writes what was decoded for the script to compare.
fn beside_a_peer(folder: &Path) {
    let read = |name: &str| std::fs::read(folder.join(name)).expect("the script wrote it");
    let config: ModelConfig = serde_json::from_slice(&read("model.json")).expect("a ModelConfig");
    let bytes = read("weights.safetensors");
    let tensor = |(name, view): (String, safetensors::tensor::TensorView<'_>)| {
        let value = |b: &[u8]| f32::from_le_bytes(b.try_into().expect("four bytes"));
        let values = view.data().chunks_exact(4).map(value).collect();
        (name, NamedTensor { shape: view.shape().to_vec(), values })
    };
    let file = SafeTensors::deserialize(&bytes).expect("a safetensors file");
    let mut tensors: Weights = file.tensors().into_iter().map(tensor).collect();
    let [h, w] = ["h", "w"].map(|name| tensors.remove(name).expect("an input"));
    let batch = h.shape[0];

    let decoder = PackedDecoder::new(&config, &tensors).expect("the script's weights");
    let mut workspace = decoder.workspace(batch);
    let mut decode = || {
        black_box(decoder.decode(black_box(&h.values), black_box(&w.values), &mut workspace));
    };
    let began = Instant::now();
    let mut warm = 0;
    while warm < 100 || began.elapsed().as_millis() < 100 {
        decode();
        warm += 1;
    }
    for _ in 0..warm {
        let start = Instant::now();
        decode();
        println!("{:.3}", start.elapsed().as_secs_f64() * 1e6);
    }
    let decoded = decoder.decode(&h.values, &w.values, &mut workspace);
    let all = decoded.mean.iter().chain(decoded.log_variance);
    let bytes: Vec<u8> = all.flat_map(|v| v.to_le_bytes()).collect();
    std::fs::write(folder.join("decoded.f32"), bytes).expect("the script's folder");
}
