//! Our half of ik.py: draws poses and pour paths for Baxter's left arm, solves them, and prints them with our
//! solutions and times as JSON. Single-threaded. Poses are `[x, y, z, qx, qy, qz, qw]`.
//!
//! `peer_ik [POSES] [PATHS_OF_EACH_KIND] [SEED]`

use std::error::Error;
use std::time::Instant;

use nalgebra::{Isometry3, Unit, UnitQuaternion, Vector3};
use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};
use serde_json::{Value, json};
use tcvae::kinematics::following::{FollowOptions, follow};
use tcvae::kinematics::inverse::{InverseOptions, solve};
use tcvae::kinematics::{Chain, Joint};

#[path = "../../tests/support/pours.rs"]
mod pours;
use pours::{Style, pour};

const POINTS: usize = 100;
const STEP_SECS: f64 = 5.0 / 99.0;

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1).map(|argument| argument.parse::<u64>());
    let mut next = |default| arguments.next().unwrap_or(Ok(default));
    let (poses, paths, seed) = (next(2000)?, next(300)?, next(1)?);

    let chain =
        tcvae::urdf::chain(include_str!("../../config/baxter.urdf"), "base", "left_gripper")?;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let targets: Vec<_> = (0..poses).map(|_| chain.forward(&anywhere(&chain, &mut rng))).collect();
    // The machine's caches and clocks are warm before the first time is taken.
    for target in targets.iter().take(100) {
        let _ = one_pose(&chain, target, &mut rng);
    }
    let single: Vec<_> = targets.iter().map(|target| one_pose(&chain, target, &mut rng)).collect();

    let mut followed = Vec::new();
    for kind in ["roll", "mixed", "pitch"] {
        for _ in 0..paths {
            let path = match kind {
                "roll" => pour(Style::Roll, POINTS, &mut rng),
                "pitch" => pour(Style::Pitch, POINTS, &mut rng),
                _ => mixed(&mut rng),
            };
            followed.push(one_path(kind, &chain, &path, &mut rng));
        }
    }
    println!(
        "{}",
        json!({
            "joint_names": chain.joint_names(), "step_secs": STEP_SECS, "poses": single,
            "paths": followed,
        })
    );
    Ok(())
}

/// A configuration drawn evenly from inside the limits.
fn anywhere(chain: &Chain, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let value = |joint: &Joint| rng.random_range(joint.lower..joint.upper);
    chain.joints().iter().map(value).collect()
}

/// A pour that tilts about an axis between those of a roll and of a pitch.
fn mixed(rng: &mut ChaCha8Rng) -> Vec<Isometry3<f64>> {
    let direction = rng.random_range(25.0..65.0_f64).to_radians();
    // Of the same numbers, so that the two differ in the axis alone.
    let seed = rng.random();
    let pour = |style| pour(style, POINTS, &mut ChaCha8Rng::seed_from_u64(seed));
    let (rolled, pitched) = (pour(Style::Roll), pour(Style::Pitch));
    let between = |(rolled, pitched): (&Isometry3<f64>, &Isometry3<f64>)| {
        // The one turns upright by the tilt about z, the other about y, which is seen in where y goes.
        let y = rolled.rotation.inverse() * pitched.rotation * Vector3::y();
        let roll = y.x.atan2(y.y);
        let upright = rolled.rotation * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), -roll);
        let axis = Vector3::new(0.0, direction.sin(), roll.signum() * direction.cos());
        let tilt = UnitQuaternion::from_axis_angle(&Unit::new_normalize(axis), roll.abs());
        Isometry3::from_parts(rolled.translation, upright * tilt)
    };
    rolled.iter().zip(&pitched).map(between).collect()
}

fn one_pose(chain: &Chain, target: &Isometry3<f64>, rng: &mut ChaCha8Rng) -> Value {
    let (middle, options) = (chain.middle(), InverseOptions::default());
    let start = Instant::now();
    let found = solve(chain, target, &middle, &options, rng);
    let secs = start.elapsed().as_secs_f64();
    let solution = found.ok().map(|found| found.positions);
    json!({ "pose": pose(target), "solution": solution, "ms": 1e3 * secs })
}

fn one_path(kind: &str, chain: &Chain, path: &[Isometry3<f64>], rng: &mut ChaCha8Rng) -> Value {
    let options = FollowOptions::default();
    let start = Instant::now();
    let followed = follow(chain, path, STEP_SECS, &options, rng);
    let secs = start.elapsed().as_secs_f64();
    let start = Instant::now();
    let stepped = point_by_point(chain, path, rng);
    let stepped_secs = start.elapsed().as_secs_f64();
    json!({
        "kind": kind, "poses": path.iter().map(pose).collect::<Vec<_>>(),
        "solution": followed.ok().map(|followed| followed.positions), "ms": 1e3 * secs,
        "stepped": stepped, "stepped_ms": 1e3 * stepped_secs,
    })
}

/// As the peers do it: each point from the one before, the first from many starts.
fn point_by_point(
    chain: &Chain,
    path: &[Isometry3<f64>],
    rng: &mut ChaCha8Rng,
) -> Option<Vec<Vec<f64>>> {
    let mut options = InverseOptions { max_restarts: 64, ..InverseOptions::default() };
    let mut q = chain.middle();
    let mut positions = Vec::with_capacity(path.len());
    for target in path {
        q = solve(chain, target, &q, &options, rng).ok()?.positions;
        positions.push(q.clone());
        options.max_restarts = 0;
    }
    Some(positions)
}

fn pose(base_from_tip: &Isometry3<f64>) -> [f64; 7] {
    let (p, q) = (base_from_tip.translation.vector, base_from_tip.rotation);
    [p.x, p.y, p.z, q.i, q.j, q.k, q.w]
}
