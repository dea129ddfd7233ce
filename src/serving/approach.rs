//! Getting there: from where the arm is to the first point of a motion, clear of what must not be touched.
//!
//! Straight through joint space if that is clear; else up and over, or by a configuration to one side. This is no
//! planner: what takes more is refused.

use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;

use crate::kinematics::Nearest;
use crate::kinematics::following::{FollowOptions, follow};
use crate::kinematics::timing::{Overshoot, Scales, approach};
use crate::serving::{ErrorCode, Refusal, Robot};
use crate::trajectory::JointTrajectory;

/// Configurations between two points at which the clearance is looked at.
const BETWEEN: usize = 3;
/// Heights by which an approach is led over what is in the way (m).
const DETOURS_M: [f64; 3] = [0.1, 0.2, 0.3];
/// Configurations that are drawn for a way around, and how many of them are tried.
const DETOUR_DRAWS: usize = 300;
const MOST_DETOURS: usize = 60;
/// Where an arm that is nearer to the first point than this begins (rad or m), it needs no approach.
const THERE: f64 = 1e-3;
/// Seed of the configurations, so that one way is always the same.
const SEED: u64 = 1;

/// The way from where the arm is to the first point of a motion, where its last point is; nothing where it is
/// there.
///
/// # Errors
/// [`ErrorCode::Collision`] with what is in the way.
pub(super) fn way_there(
    robot: &Robot,
    from: &[f64],
    motion: &JointTrajectory,
    scales: Scales,
) -> Result<Option<JointTrajectory>, Refusal> {
    let to = &motion.positions[0];
    if from.iter().zip(to).all(|(a, b)| (a - b).abs() < THERE) {
        return Ok(None);
    }
    let step_secs = motion.times_secs[0];
    let direct = legs(robot, &[from, to], step_secs, scales).map_err(|e| {
        Refusal::new(ErrorCode::JointLimit, format!("on the way to the first point: {e}"))
    })?;
    let Some(touches) = touching(robot, Some(from), &direct) else { return Ok(Some(direct)) };
    if robot.is_clear(from) {
        for between in detours(robot, from, to) {
            let between = between.iter().map(Vec::as_slice);
            let way: Vec<_> = [from].into_iter().chain(between).chain([to.as_slice()]).collect();
            if let Ok(detour) = legs(robot, &way, step_secs, scales)
                && touching(robot, Some(from), &detour).is_none()
            {
                return Ok(Some(detour));
            }
        }
    }
    Err(Refusal::new(
        ErrorCode::Collision,
        format!(
            "on the way from where the arm is to the first point {} would be {:.3} m apart, limit {:.3} m; \
             move the arm elsewhere first",
            touches.contact, touches.distance_m, robot.clearance_m
        ),
    ))
}

/// From rest to rest between these configurations.
fn legs(
    robot: &Robot,
    way: &[&[f64]],
    step_secs: f64,
    scales: Scales,
) -> Result<JointTrajectory, Overshoot> {
    let mut legs =
        way.windows(2).map(|leg| approach(&robot.chain, leg[0], leg[1], step_secs, scales));
    let mut whole = legs.next().expect("a way has two ends")?.trajectory;
    for leg in legs {
        let leg = leg?.trajectory;
        // It begins one step after the one before has ended.
        let end = whole.times_secs.last().copied().unwrap_or_default();
        whole.times_secs.extend(leg.times_secs.iter().map(|time| end + time));
        whole.positions.extend(leg.positions);
        whole.velocities.extend(leg.velocities);
        whole.accelerations.extend(leg.accelerations);
    }
    Ok(whole)
}

/// Where an arm is whose tip is higher by so much (m), reached without a jump; nothing where it can't be.
fn lifted(robot: &Robot, q: &[f64], height_m: f64) -> Option<Vec<f64>> {
    const STEPS: usize = 10;
    const STEP_SECS: f64 = 0.2;
    let tip = robot.chain.forward(q);
    let poses: Vec<_> = (0..=STEPS)
        .map(|i| {
            let mut pose = tip;
            pose.translation.z += height_m * i as f64 / STEPS as f64;
            pose
        })
        .collect();
    let options = FollowOptions { start: Some(q.to_vec()), starts: 1, ..FollowOptions::default() };
    let mut rng = ChaCha8Rng::seed_from_u64(SEED);
    let followed = follow(&robot.chain, &poses, STEP_SECS, &options, &mut rng).ok()?;
    let near = followed.positions[0].iter().zip(q).all(|(a, b)| (a - b).abs() < 0.05);
    near.then(|| followed.positions[STEPS].clone())
}

/// Configurations to go by on the way from one to another, the likelier ones first: up and over, and then any,
/// by the time that they cost.
fn detours<'a>(
    robot: &'a Robot,
    from: &'a [f64],
    to: &'a [f64],
) -> impl Iterator<Item = Vec<Vec<f64>>> + 'a {
    let over = DETOURS_M.into_iter().flat_map(move |height| {
        let above = lifted(robot, to, height);
        let risen = lifted(robot, from, height);
        let both = risen.zip(above.clone()).map(|(risen, above)| vec![risen, above]);
        above.map(|above| vec![above]).into_iter().chain(both)
    });
    let around = std::iter::once(()).flat_map(move |()| {
        let joints = robot.chain.joints();
        let secs = |a: &[f64], b: &[f64]| {
            let pairs = a.iter().zip(b).zip(joints);
            pairs.map(|((a, b), joint)| (a - b).abs() / joint.velocity).fold(0.0, f64::max)
        };
        let mut rng = ChaCha8Rng::seed_from_u64(SEED);
        let drawn = (0..DETOUR_DRAWS).map(|_| robot.chain.draw(&mut rng));
        let mut drawn: Vec<_> = drawn.filter(|q| robot.is_clear(q)).collect();
        drawn.sort_by(|a, b| {
            let [a, b] = [a, b].map(|q| secs(from, q) + secs(q, to));
            a.total_cmp(&b)
        });
        drawn.truncate(MOST_DETOURS);
        drawn.into_iter().map(|q| vec![q])
    });
    over.chain(around)
}

/// What comes too near along a trajectory, at its points or between them, or on the way from its start.
pub(super) fn touching(
    robot: &Robot,
    start: Option<&[f64]>,
    trajectory: &JointTrajectory,
) -> Option<Nearest> {
    let Robot { chain, hull, clearance_m, .. } = robot;
    let share = |i: usize| i as f64 / (BETWEEN + 1) as f64;
    let first = &trajectory.positions[0];
    let mut between: Vec<Vec<f64>> = Vec::new();
    if let Some(start) = start {
        let at = |i| start.iter().zip(first).map(|(a, b)| a + share(i) * (b - a)).collect();
        between.extend((0..=BETWEEN).map(at));
    }
    for k in 1..trajectory.positions.len() {
        between.extend((1..=BETWEEN).map(|i| trajectory.between(k - 1, share(i))));
    }
    let all = trajectory.positions.iter().chain(&between).map(Vec::as_slice);
    hull.nearest_within(chain, all, *clearance_m)
}
