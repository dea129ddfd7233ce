//! Kinematics of Baxter's left arm: forward kinematics, Jacobian, one pose, and paths of 100 points
//! in 5 s. Before the timings it prints what share was solved, and how the times are spread.
//!
//!     cargo bench --bench kinematics

use std::time::Instant;

use criterion::{Criterion, criterion_group, criterion_main};
use nalgebra::Isometry3;
use rand::{RngExt, SeedableRng, rngs::ChaCha8Rng};
use tcvae::kinematics::following::{FollowOptions, follow};
use tcvae::kinematics::inverse::{InverseOptions, solve};
use tcvae::kinematics::timing::{Scales, time};
use tcvae::kinematics::{Chain, Joint};

#[path = "../tests/support/pours.rs"]
mod pours;

const STEP_SECS: f64 = 5.0 / 99.0;
const TARGETS: usize = 2000;
const PATHS: usize = 300;

fn arm() -> Chain {
    let xml = include_str!("../config/baxter.urdf");
    tcvae::urdf::chain(xml, "base", "left_gripper").expect("an arm")
}

fn anywhere(chain: &Chain, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let value = |j: &Joint| rng.random_range(j.lower..j.upper);
    chain.joints().iter().map(value).collect()
}

fn targets(chain: &Chain) -> Vec<Isometry3<f64>> {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    (0..TARGETS).map(|_| chain.forward(&anywhere(chain, &mut rng))).collect()
}

fn paths(style: pours::Style) -> Vec<Vec<Isometry3<f64>>> {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    (0..PATHS).map(|_| pours::pour(style, 100, &mut rng)).collect()
}

/// Milliseconds that each call takes.
fn clocked<T>(inputs: &[T], mut call: impl FnMut(&T)) -> Vec<f64> {
    let clock = |input| {
        let start = Instant::now();
        call(input);
        1e3 * start.elapsed().as_secs_f64()
    };
    inputs.iter().map(clock).collect()
}

fn spread(mut milliseconds: Vec<f64>) -> String {
    milliseconds.sort_by(f64::total_cmp);
    let n = milliseconds.len();
    let mean = milliseconds.iter().sum::<f64>() / n as f64;
    let (median, p99) = (milliseconds[n / 2], milliseconds[n * 99 / 100]);
    format!("mean {mean:.4} ms, median {median:.4} ms, 99th percentile {p99:.4} ms")
}

fn report(_: &mut Criterion) {
    let chain = arm();
    for max_restarts in [0, 30, 200] {
        let options = InverseOptions { max_restarts, ..Default::default() };
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut solved = 0;
        let times = clocked(&targets(&chain), |target| {
            let found = solve(&chain, target, &chain.middle(), &options, &mut rng);
            solved += usize::from(found.is_ok());
        });
        let share = 100.0 * solved as f64 / TARGETS as f64;
        println!(
            "one pose, at most {max_restarts} restarts: {share:.2} % of {TARGETS} solved, {}",
            spread(times)
        );
    }
    for style in [pours::Style::Roll, pours::Style::Pitch] {
        let paths = paths(style);
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        // What an upper bound on the feasible paths is: those of which each pose is in reach.
        let reachable = |path: &&Vec<Isometry3<f64>>| {
            let options = InverseOptions { max_restarts: 100, ..Default::default() };
            let mut reach = ChaCha8Rng::seed_from_u64(5);
            path.iter().all(|p| solve(&chain, p, &chain.middle(), &options, &mut reach).is_ok())
        };
        let reachable = paths.iter().filter(reachable).count();
        let (mut complete, mut without_slowing, mut timed_as_learned) = (0, 0, 0);
        let mut margins = Vec::new();
        let times = clocked(&paths, |path| {
            let options = FollowOptions::default();
            if let Ok(followed) = follow(&chain, path, STEP_SECS, &options, &mut rng) {
                complete += 1;
                without_slowing += usize::from(followed.speed <= 1.0);
                margins.push(followed.joint_margin_rad);
                let timed = time(&chain, &followed.positions, STEP_SECS, Scales::default());
                timed_as_learned += usize::from(timed.is_ok_and(|timed| timed.slowdown <= 1.0));
            }
        });
        margins.sort_by(f64::total_cmp);
        println!(
            "{style:?} pours: {complete} of {PATHS} followed ({reachable} have every pose in \
             reach), {without_slowing} with no step above a velocity limit, {timed_as_learned} \
             not slowed down, median joint margin {:.3} rad; following and timing {}",
            margins[margins.len() / 2],
            spread(times)
        );
    }
}

fn kinematics(criterion: &mut Criterion) {
    let chain = arm();
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let configurations: Vec<_> = (0..256).map(|_| anywhere(&chain, &mut rng)).collect();
    let mut q = configurations.iter().cycle();
    criterion.bench_function("forward", |b| {
        b.iter(|| chain.forward(q.next().expect("a cycle does not end")))
    });
    criterion.bench_function("jacobian", |b| {
        b.iter(|| chain.jacobian(q.next().expect("a cycle does not end")))
    });

    let targets = targets(&chain);
    let mut target = targets.iter().cycle();
    let (options, middle) = (InverseOptions::default(), chain.middle());
    criterion.bench_function("one pose", |b| {
        b.iter(|| {
            let target = target.next().expect("a cycle does not end");
            solve(&chain, target, &middle, &options, &mut rng)
        })
    });

    let paths = paths(pours::Style::Roll);
    let mut path = paths.iter().cycle();
    let options = FollowOptions::default();
    criterion.bench_function("follow 100 points", |b| {
        b.iter(|| {
            let path = path.next().expect("a cycle does not end");
            follow(&chain, path, STEP_SECS, &options, &mut rng)
        })
    });
    let followed =
        paths.iter().find_map(|path| follow(&chain, path, STEP_SECS, &options, &mut rng).ok());
    let positions = followed.expect("one of the pours is in reach").positions;
    criterion.bench_function("time 100 points", |b| {
        b.iter(|| time(&chain, &positions, STEP_SECS, Scales::default()))
    });
}

criterion_group!(benches, report, kinematics);
criterion_main!(benches);
