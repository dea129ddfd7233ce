//! Times and velocities for a joint path: when the arm is where, and no faster than it may be.
//!
//! The points keep their equal spacing in time. Where a joint would exceed its velocity limit, or
//! its acceleration limit if one is known, the whole motion is slowed down by one factor, so every
//! share of the time spent anywhere, and with it what the motion measures, stays the same.
//!
//! # The motion between the points
//! A controller that gets positions and velocities joins them by cubic polynomials
//! (`joint_trajectory_controller` does), so these are what has to respect the limits, and their
//! largest velocity and acceleration are computed exactly. The velocity at a point is the central
//! difference, cut down to three times the slower of the two steps beside it and 0 where a joint
//! turns round (Fritsch and Carlson 1980): then each joint moves in one direction between two
//! points and never beyond them, so position limits hold in between as well.
//!
//! # Its ends
//! The first and the last velocity are 0: the arm is at rest before and after. A path that ends in
//! full motion is therefore braked within its last step, which an acceleration limit turns into a
//! slowdown. The first point is due one step after the start, because a controller wants a time
//! above 0 to go there.

use super::chain::{Chain, Joint};
use crate::trajectory::JointTrajectory;

/// A joint trajectory and how far it was slowed down.
#[derive(Debug, Clone, PartialEq)]
pub struct Timed {
    /// Positions, velocities and times. Point `n`, counted from 1, is due at `n` steps.
    pub trajectory: JointTrajectory,
    /// The factor by which every step takes longer than was asked for, at least 1.
    pub slowdown: f64,
}

/// The trajectory through `positions` (one configuration per point: rad, or m for prismatic
/// joints), `step_secs` apart or further where the limits ask for it. `velocity_scale` and
/// `acceleration_scale` are the shares of the chain's limits that may be used.
///
/// # Panics
/// Without positions, with configurations of another length than the chain's, or with a step or a
/// scale that is not above 0.
pub fn time(
    chain: &Chain,
    positions: &[Vec<f64>],
    step_secs: f64,
    velocity_scale: f64,
    acceleration_scale: f64,
) -> Timed {
    assert!(!positions.is_empty(), "a trajectory has at least 1 point");
    positions.iter().for_each(|q| chain.assert_dof(q));
    for value in [step_secs, velocity_scale, acceleration_scale] {
        assert!(value > 0.0, "steps and scales are above 0");
    }

    // Everything below is in units of one step until the slowdown is known.
    let mut velocities = velocities(positions);
    let mut slowdown = 1.0f64;
    for (pair, ends) in positions.windows(2).zip(velocities.windows(2)) {
        for (j, joint) in chain.joints().iter().enumerate() {
            let cubic = Cubic { step: pair[1][j] - pair[0][j], start: ends[0][j], end: ends[1][j] };
            slowdown =
                slowdown.max(needed(&cubic, joint, step_secs, velocity_scale, acceleration_scale));
        }
    }
    if slowdown > 1.0 {
        // So that rounding leaves nothing above a limit.
        slowdown *= 1.0 + 1e-9;
    }

    let step_secs = step_secs * slowdown;
    for velocity in velocities.iter_mut().flatten() {
        *velocity /= step_secs;
    }
    let trajectory = JointTrajectory {
        joint_names: chain.joint_names(),
        times_secs: (1..=positions.len()).map(|n| n as f64 * step_secs).collect(),
        positions: positions.to_vec(),
        velocities,
    };
    Timed { trajectory, slowdown }
}

/// The slowdown that one joint needs between two points.
fn needed(
    cubic: &Cubic,
    joint: &Joint,
    step_secs: f64,
    velocity_scale: f64,
    acceleration_scale: f64,
) -> f64 {
    let speed = cubic.speed() / step_secs / (velocity_scale * joint.velocity);
    let acceleration = joint.acceleration.map_or(0.0, |limit| {
        cubic.acceleration() / (step_secs * step_secs) / (acceleration_scale * limit)
    });
    speed.max(acceleration.sqrt())
}

/// Velocities at the points, per step: 0 at both ends, and such that no joint overshoots a point.
fn velocities(positions: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let dof = positions[0].len();
    let mut velocities = vec![vec![0.0; dof]; positions.len()];
    for (velocity, around) in velocities.iter_mut().skip(1).zip(positions.windows(3)) {
        for (j, velocity) in velocity.iter_mut().enumerate() {
            let (before, after) = (around[1][j] - around[0][j], around[2][j] - around[1][j]);
            if before * after > 0.0 {
                let largest = 3.0 * before.abs().min(after.abs());
                *velocity = (0.5 * (before + after)).clamp(-largest, largest);
            }
        }
    }
    velocities
}

/// The cubic over one step of time that moves by `step` with these velocities at its ends:
/// `q'(u) = start + 2 (3 step - 2 start - end) u + 3 (start + end - 2 step) u^2`.
struct Cubic {
    step: f64,
    start: f64,
    end: f64,
}

impl Cubic {
    /// Largest speed.
    fn speed(&self) -> f64 {
        let (a, b) = (self.linear(), self.quadratic());
        let at = -a / (2.0 * b);
        let inside = if at > 0.0 && at < 1.0 { self.start + at * (a + at * b) } else { self.start };
        self.start.abs().max(self.end.abs()).max(inside.abs())
    }

    /// Largest acceleration; it is linear, so at one of the ends.
    fn acceleration(&self) -> f64 {
        let (a, b) = (self.linear(), self.quadratic());
        a.abs().max((a + 2.0 * b).abs())
    }

    fn linear(&self) -> f64 {
        2.0 * (3.0 * self.step - 2.0 * self.start - self.end)
    }

    fn quadratic(&self) -> f64 {
        3.0 * (self.start + self.end - 2.0 * self.step)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kinematics::JointKind;
    use nalgebra::{Isometry3, Vector3};
    use proptest::prelude::*;

    fn chain(velocities: &[f64], acceleration: Option<f64>) -> Chain {
        let joint = |(i, &velocity): (usize, &f64)| Joint {
            name: format!("joint_{i}"),
            kind: JointKind::Revolute,
            parent_from_joint: Isometry3::identity(),
            axis: Vector3::z_axis(),
            lower: -3.0,
            upper: 3.0,
            velocity,
            acceleration,
        };
        let joints = velocities.iter().enumerate().map(joint).collect();
        Chain::new("base", "tip", joints, Isometry3::identity()).unwrap()
    }

    /// Positions, velocities and accelerations of the cubics that a controller plays, sampled
    /// 20 times per step straight from the four conditions at the step's ends.
    fn played(trajectory: &JointTrajectory, joint: usize) -> Vec<[f64; 3]> {
        let mut played = Vec::new();
        for k in 1..trajectory.times_secs.len() {
            let h = trajectory.times_secs[k] - trajectory.times_secs[k - 1];
            let (p0, p1) = (trajectory.positions[k - 1][joint], trajectory.positions[k][joint]);
            let (v0, v1) = (trajectory.velocities[k - 1][joint], trajectory.velocities[k][joint]);
            let c2 = (3.0 * (p1 - p0) / h - 2.0 * v0 - v1) / h;
            let c3 = (2.0 * (p0 - p1) / h + v0 + v1) / (h * h);
            for i in 0..=20 {
                let t = h * f64::from(i) / 20.0;
                played.push([
                    p0 + t * (v0 + t * (c2 + t * c3)),
                    v0 + t * (2.0 * c2 + t * 3.0 * c3),
                    2.0 * c2 + 6.0 * c3 * t,
                ]);
            }
        }
        played
    }

    fn paths() -> impl Strategy<Value = Vec<Vec<f64>>> {
        prop::collection::vec(prop::collection::vec(-3.0..3.0f64, 2), 1..30)
    }

    proptest! {
        #[test]
        fn what_a_controller_plays_stays_inside_every_limit(
            positions in paths(),
            step in 0.01..1.0f64,
            velocity_scale in 0.05..1.0f64,
            acceleration_scale in 0.05..1.0f64,
        ) {
            let chain = chain(&[1.5, 0.7], Some(6.0));
            let timed = time(&chain, &positions, step, velocity_scale, acceleration_scale);
            prop_assert!(timed.slowdown >= 1.0);
            for (j, joint) in chain.joints().iter().enumerate() {
                for [position, velocity, acceleration] in played(&timed.trajectory, j) {
                    prop_assert!((-3.0 - 1e-9..=3.0 + 1e-9).contains(&position));
                    prop_assert!(velocity.abs() <= joint.velocity * velocity_scale * (1.0 + 1e-6));
                    prop_assert!(acceleration.abs() <= 6.0 * acceleration_scale * (1.0 + 1e-6));
                }
            }
        }

        #[test]
        fn times_rise_from_above_zero_in_equal_steps_and_both_ends_are_at_rest(
            positions in paths(), step in 0.01..1.0f64,
        ) {
            let trajectory = time(&chain(&[1.5, 0.7], None), &positions, step, 1.0, 1.0).trajectory;
            prop_assert_eq!(&trajectory.positions, &positions);
            prop_assert_eq!(trajectory.times_secs.len(), positions.len());
            prop_assert_eq!(trajectory.velocities.len(), positions.len());
            let first = trajectory.times_secs[0];
            prop_assert!(first >= step);
            for (n, time) in trajectory.times_secs.iter().enumerate() {
                prop_assert!((time - (n + 1) as f64 * first).abs() < 1e-9);
            }
            let at_rest = [0.0, 0.0];
            prop_assert_eq!(&trajectory.velocities[0][..], &at_rest[..]);
            prop_assert_eq!(&trajectory.velocities[positions.len() - 1][..], &at_rest[..]);
        }

        #[test]
        fn no_joint_leaves_the_range_between_two_points(positions in paths()) {
            let trajectory = time(&chain(&[1.5, 0.7], None), &positions, 0.1, 1.0, 1.0).trajectory;
            for joint in 0..2 {
                let played = played(&trajectory, joint);
                for (samples, ends) in played.chunks(21).zip(positions.windows(2)) {
                    let (a, b) = (ends[0][joint], ends[1][joint]);
                    for [position, ..] in samples {
                        prop_assert!(*position >= a.min(b) - 1e-9 && *position <= a.max(b) + 1e-9);
                    }
                }
            }
        }

        #[test]
        fn half_the_velocity_takes_twice_the_time(positions in paths()) {
            let slowdown =
                |scale| time(&chain(&[1.5, 0.7], None), &positions, 1e-3, scale, 1.0).slowdown;
            let (full, half) = (slowdown(1.0), slowdown(0.5));
            prop_assume!(full > 1.0);
            prop_assert!((half / full - 2.0).abs() < 1e-6);
        }
    }

    #[test]
    fn a_motion_inside_its_limits_keeps_its_time() {
        let positions: Vec<_> = (0..50).map(|i| vec![(0.05 * f64::from(i)).sin()]).collect();
        let timed = time(&chain(&[2.0], None), &positions, 0.1, 1.0, 1.0);
        assert_eq!(timed.slowdown, 1.0);
        assert!((timed.trajectory.times_secs[49] - 5.0).abs() < 1e-12);
        for (i, velocity) in timed.trajectory.velocities.iter().enumerate().skip(1).take(28) {
            let expected = 0.5 * (0.05 * i as f64).cos();
            assert!((velocity[0] - expected).abs() < 1e-3, "point {i}: {}", velocity[0]);
        }
    }

    #[test]
    fn the_slowdown_is_what_the_fastest_step_needs_and_no_more() {
        // From rest to rest in one step a cubic's top speed is 1.5 times its mean.
        let positions = [vec![0.0], vec![1.0]];
        let timed = time(&chain(&[0.5], None), &positions, 0.5, 1.0, 1.0);
        assert!((timed.slowdown - 6.0).abs() < 1e-6, "{}", timed.slowdown);
        // And its acceleration 6 / h^2.
        let timed = time(&chain(&[1e3], Some(1.0)), &positions, 1.0, 1.0, 0.5);
        assert!((timed.slowdown - 12f64.sqrt()).abs() < 1e-6, "{}", timed.slowdown);
    }

    #[test]
    fn one_point_is_a_trajectory_at_rest() {
        let trajectory = time(&chain(&[1.0], None), &[vec![0.3]], 0.1, 1.0, 1.0).trajectory;
        assert_eq!(trajectory.times_secs, [0.1]);
        assert_eq!(trajectory.velocities, [[0.0]]);
    }
}
