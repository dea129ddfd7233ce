//! From a goal to a checked joint trajectory of 100 points, node-side: decode, aim, inverse
//! kinematics, timing, checks. Random tasks of the trained region; before the timing it prints how
//! many are served, how the times are spread, and how long a start takes.
//!
//!     cargo bench --no-default-features --bench serving

use std::sync::Arc;
use std::time::Instant;

use criterion::{Criterion, criterion_group, criterion_main};
use rand::{RngExt, SeedableRng, rngs::ChaCha8Rng};
use tcvae::artifact::Artifact;
use tcvae::serving::{GivenLocation, PrimitiveServer, SampleRequest, Settings};

const MODEL: &[u8] = include_bytes!("../models/pouring.safetensors");
const REQUESTS: usize = 2000;

fn server() -> PrimitiveServer {
    let robot = tcvae::config::robot(None, tcvae::urdf::arm).expect("the built-in robot");
    let model = Artifact::from_bytes(MODEL).expect("the built-in model");
    let model = model.served_model().expect("a model of a robot");
    PrimitiveServer::new(Arc::new(model), Arc::new(robot.served()), Settings::default())
        .expect("a server")
}

/// Requests amid the trained region, each with a manner from the prior.
fn requests(server: &PrimitiveServer) -> Vec<SampleRequest> {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let space = server.model().space();
    let mut requests = Vec::new();
    while requests.len() < REQUESTS {
        let mut draw = |i: tcvae::parameters::Interval| rng.random_range(i.lower..=i.upper);
        let task: Vec<_> = space
            .locations()
            .iter()
            .map(|l| GivenLocation { name: l.name.clone(), xy: [draw(l.x), draw(l.y)] })
            .collect();
        let w: Vec<_> = task.iter().flat_map(|l| l.xy).collect();
        if server.model().familiarity.task(&w) > 0.0 {
            let seed = 1 + requests.len() as u64;
            requests.push(SampleRequest { task, sample_manner: true, seed, ..Default::default() });
        }
    }
    requests
}

fn serving(criterion: &mut Criterion) {
    let start = Instant::now();
    let server = server();
    println!("model, robot and server made in {:.1} ms", 1e3 * start.elapsed().as_secs_f64());

    let requests = requests(&server);
    let mut milliseconds = Vec::with_capacity(REQUESTS);
    let mut refused = std::collections::BTreeMap::<&str, usize>::new();
    for request in &requests {
        let start = Instant::now();
        let reply = server.sample(request, 0.0);
        milliseconds.push(1e3 * start.elapsed().as_secs_f64());
        if let Some(refusal) = reply.refusal {
            *refused.entry(refusal.code.name()).or_default() += 1;
        }
    }
    milliseconds.sort_by(f64::total_cmp);
    let served = REQUESTS - refused.values().sum::<usize>();
    println!("{served} of {REQUESTS} tasks of the trained region served; refused: {refused:?}");
    println!(
        "a request: median {:.2} ms, 99th percentile {:.2} ms",
        milliseconds[REQUESTS / 2],
        milliseconds[REQUESTS * 99 / 100]
    );

    let mut next = requests.iter().cycle();
    criterion.bench_function("goal to checked joint trajectory, 100 points", |bencher| {
        bencher.iter(|| server.sample(next.next().expect("a cycle"), 0.0));
    });
}

criterion_group!(benches, serving);
criterion_main!(benches);
