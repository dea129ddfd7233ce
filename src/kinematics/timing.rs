//! Times, velocities and accelerations for a joint path: when the arm is where, and no faster than it may be.
//!
//! The points keep their equal spacing in time. Where a joint would exceed its velocity limit, or its
//! acceleration or jerk limit if one is known, the whole motion is slowed down by one factor, so every share
//! of the time spent anywhere, and with it what the motion measures, stays the same.
//!
//! # The motion between the points
//! A controller that gets positions and velocities joins them by cubic polynomials, and one that gets
//! accelerations too by quintic ones (`joint_trajectory_controller` does both). Velocities and accelerations
//! at the points are those of the cubic spline through the positions whose acceleration never jumps, so both
//! play the same curve: this spline. Its largest velocity, acceleration and jerk are computed exactly, and so
//! is how far it leaves the range of a joint, which between the points is not a matter of the points alone.
//!
//! # Its ends
//! The first and the last velocity and acceleration are 0: the arm is at rest before and after. There the spline
//! has an acceleration, so the first and the last step are two curves, for the two kinds of controller. Both are
//! held to the limits, the quintic by the hull of its Bézier points, which is never inside the curve. A path that ends in full motion
//! would be braked within its last step; the caller eases it first ([`eased`]). The first point is due one step
//! after the start, because a controller wants a time above 0 to go there.
//!
//! # Getting there
//! [`approach`] goes straight from one configuration to another from rest to rest, as fast as the limits of
//! all joints allow: the way is shared by all, and along it the speed rises, stays and falls, at constant
//! jerk where jerks are limited (the double-S profile in Biagiotti and Melchiorri, Trajectory Planning for
//! Automatic Machines and Robots, 2008, section 3.4).

use super::chain::{Chain, Joint};
use crate::trajectory::JointTrajectory;

/// Acceleration that an approach is made with where a joint has no limit (rad/s² or m/s²); MoveIt takes the same.
const UNKNOWN_ACCELERATION: f64 = 1.0;
/// Steps in which the acceleration of an approach comes up.
const RISE_STEPS: f64 = 2.0;
/// Points of an approach at least, so that its profile is there.
const LEAST_STEPS: f64 = 8.0;

/// A joint trajectory and how far it was slowed down.
#[derive(Debug, Clone, PartialEq)]
pub struct Timed {
    /// Positions, velocities, accelerations and times. Point `n`, counted from 1, is due at `n` steps.
    pub trajectory: JointTrajectory,
    /// The factor by which every step takes longer than was asked for, at least 1.
    pub slowdown: f64,
}

/// A joint would leave its range between two points.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error(
    "after point {point} {joint} would swing to {position:.4} on its way to the next, beyond its limit of {limit:.4}"
)]
pub struct Overshoot {
    /// The point before, from 1.
    pub point: usize,
    /// The joint.
    pub joint: String,
    /// How far it would go (rad, or m).
    pub position: f64,
    /// Its limit (rad, or m).
    pub limit: f64,
}

/// Shares of the limits that may be used.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scales {
    /// Of the velocity limits.
    pub velocity: f64,
    /// Of the acceleration limits.
    pub acceleration: f64,
}

impl Default for Scales {
    /// All of them.
    fn default() -> Self {
        Self { velocity: 1.0, acceleration: 1.0 }
    }
}

/// The trajectory through `positions` (one configuration per point: rad, or m for prismatic joints),
/// `step_secs` apart or further where the limits ask for it.
///
/// # Errors
/// A joint that leaves its range between the points, where it did not at them.
///
/// # Panics
/// Without positions, with configurations of another length than the chain's, or with a step or a
/// scale that is not above 0.
pub fn time(
    chain: &Chain,
    positions: &[Vec<f64>],
    step_secs: f64,
    scales: Scales,
) -> Result<Timed, Overshoot> {
    assert!(!positions.is_empty(), "a trajectory has at least 1 point");
    positions.iter().for_each(|q| chain.assert_dof(q));
    for value in [step_secs, scales.velocity, scales.acceleration] {
        assert!(value > 0.0, "steps and scales are above 0");
    }

    let (velocities, accelerations) = spline(positions);
    Steps { positions: positions.to_vec(), velocities, accelerations }.timed(
        chain,
        step_secs,
        scales,
        |k| k == 0 || k + 2 == positions.len(),
    )
}

/// Points with their velocities and accelerations in units of one step of time.
struct Steps {
    positions: Vec<Vec<f64>>,
    velocities: Vec<Vec<f64>>,
    accelerations: Vec<Vec<f64>>,
}

impl Steps {
    /// The trajectory with steps as long as the limits ask for. Where `differ` says of the step after a point
    /// that the cubic and the quintic there are not the same, both are looked at.
    fn timed(
        self,
        chain: &Chain,
        step_secs: f64,
        scales: Scales,
        differ: impl Fn(usize) -> bool,
    ) -> Result<Timed, Overshoot> {
        let Self { positions, mut velocities, mut accelerations } = self;
        let mut slowdown = 1.0f64;
        for (k, (pair, ends)) in positions.windows(2).zip(velocities.windows(2)).enumerate() {
            for (j, joint) in chain.joints().iter().enumerate() {
                let (from, to) = (pair[0][j], pair[1][j]);
                let cubic = Cubic { step: to - from, start: ends[0][j], end: ends[1][j] };
                let mut peaks = cubic.peaks(from);
                if differ(k) {
                    let (start, end) = (accelerations[k][j], accelerations[k + 1][j]);
                    peaks = peaks.or(&cubic.quintic_peaks(from, start, end));
                }
                slowdown = slowdown.max(peaks.slowdown(joint, step_secs, scales));
                // A joint that begins outside its range may come back.
                let (lower, upper) = (joint.lower.min(from).min(to), joint.upper.max(from).max(to));
                for (position, beyond, limit) in [
                    (peaks.lowest, peaks.lowest < lower, joint.lower),
                    (peaks.highest, peaks.highest > upper, joint.upper),
                ] {
                    if beyond {
                        let joint = joint.name.clone();
                        return Err(Overshoot { point: k + 1, joint, position, limit });
                    }
                }
            }
        }
        if slowdown > 1.0 {
            // So that rounding leaves nothing above a limit.
            slowdown *= 1.0 + 1e-9;
        }
        let step_secs = step_secs * slowdown;
        velocities.iter_mut().flatten().for_each(|velocity| *velocity /= step_secs);
        accelerations.iter_mut().flatten().for_each(|a| *a /= step_secs * step_secs);
        let trajectory = JointTrajectory {
            joint_names: chain.joint_names(),
            times_secs: (1..=positions.len()).map(|n| n as f64 * step_secs).collect(),
            positions,
            velocities,
            accelerations,
        };
        Ok(Timed { trajectory, slowdown })
    }
}

/// The straight way from `from` to `to` through joint space, from rest to rest in the least time, in points
/// about `step_secs` apart; the last is `to`. Without a way there is one point.
///
/// # Errors
/// As [`time`].
///
/// # Panics
/// As [`time`].
pub fn approach(
    chain: &Chain,
    from: &[f64],
    to: &[f64],
    step_secs: f64,
    scales: Scales,
) -> Result<Timed, Overshoot> {
    chain.assert_dof(from);
    chain.assert_dof(to);
    // An acceleration that comes up within one step would overshoot between the points.
    let profile = Profile::along(chain, from, to, scales, RISE_STEPS * step_secs);
    let duration = profile.duration_secs();
    let count = (duration / step_secs).ceil().max(LEAST_STEPS);
    let step_secs = (duration / count).max(1e-3);
    let mut steps =
        Steps { positions: Vec::new(), velocities: Vec::new(), accelerations: Vec::new() };
    for n in 0..=count as usize {
        let [share, speed, acceleration] = match n as f64 / count {
            end if end == 0.0 || end == 1.0 => [end, 0.0, 0.0],
            amid => profile.at(amid * duration),
        };
        let way = || from.iter().zip(to).map(|(from, to)| to - from);
        // Rounding leads nowhere but between the ends, which may be at limits.
        let position = |(&from, &to): (&f64, &f64)| match share {
            1.0 => to,
            share => (from + share * (to - from)).clamp(from.min(to), from.max(to)),
        };
        steps.positions.push(from.iter().zip(to).map(position).collect());
        steps.velocities.push(way().map(|way| way * speed * step_secs).collect());
        steps.accelerations.push(way().map(|way| way * acceleration * step_secs.powi(2)).collect());
    }
    let Timed { mut trajectory, slowdown } = steps.timed(chain, step_secs, scales, |_| true)?;
    // Where the arm is now is no point of the trajectory.
    let now = trajectory.times_secs.remove(0);
    trajectory.times_secs.iter_mut().for_each(|time| *time -= now);
    trajectory.positions.remove(0);
    trajectory.velocities.remove(0);
    trajectory.accelerations.remove(0);
    Ok(Timed { trajectory, slowdown })
}

/// The shares of a motion's path at `points` equal steps of time, when its ends are eased: it gathers speed for
/// `start_secs` and loses it for `end_secs`, each at a constant rate, and in between goes as it did. Returned
/// with how long that takes: half of both more than `duration_secs`.
pub fn eased(
    duration_secs: f64,
    start_secs: f64,
    end_secs: f64,
    points: usize,
) -> (impl Iterator<Item = f64>, f64) {
    let whole = duration_secs + 0.5 * (start_secs + end_secs);
    let share = move |i: usize| {
        let t = whole * i as f64 / (points - 1) as f64;
        let left = whole - t;
        let way = if t < start_secs {
            0.5 * t * t / start_secs
        } else if left < end_secs {
            duration_secs - 0.5 * left * left / end_secs
        } else {
            t - 0.5 * start_secs
        };
        way / duration_secs
    };
    ((0..points).map(share), whole)
}

/// How far along a straight way the arm is, over time.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Profile {
    /// Time during which the acceleration rises, or falls.
    jerked: f64,
    /// Time until the speed is reached.
    rising: f64,
    /// Time at that speed.
    cruising: f64,
    /// Largest acceleration that is reached, in ways per second squared.
    acceleration: f64,
}

impl Profile {
    /// The fastest along a way of these joints, in units of the whole way, whose acceleration takes at least
    /// `rise_secs` to come up.
    fn along(chain: &Chain, from: &[f64], to: &[f64], scales: Scales, rise_secs: f64) -> Self {
        let (mut v, mut a, mut j) = (f64::INFINITY, f64::INFINITY, f64::INFINITY);
        for (joint, (from, to)) in chain.joints().iter().zip(from.iter().zip(to)) {
            let way = (to - from).abs();
            if way > 0.0 {
                let acceleration = joint.acceleration.unwrap_or(UNKNOWN_ACCELERATION);
                v = v.min(scales.velocity * joint.velocity / way);
                a = a.min(scales.acceleration * acceleration / way);
                j = j.min(joint.jerk.map_or(f64::INFINITY, |jerk| jerk / way));
            }
        }
        if v == f64::INFINITY {
            return Self { jerked: 0.0, rising: 0.0, cruising: 0.0, acceleration: 0.0 };
        }
        j = j.min(a / rise_secs);
        // As if the speed is reached, ...
        let (jerked, rising) = match v * j < a * a {
            true => ((v / j).sqrt(), 2.0 * (v / j).sqrt()),
            false => (a / j, a / j + v / a),
        };
        let cruising = 1.0 / v - rising;
        if cruising >= 0.0 {
            let acceleration = v / (rising - jerked);
            return Self { jerked, rising, cruising, acceleration };
        }
        // ... or else only the acceleration, or not even that.
        let jerked = a / j;
        let rising = 0.5 * jerked + (0.25 * jerked * jerked + 1.0 / a).sqrt();
        if rising >= 2.0 * jerked {
            return Self { jerked, rising, cruising: 0.0, acceleration: a };
        }
        let jerked = (0.5 / j).cbrt();
        Self { jerked, rising: 2.0 * jerked, cruising: 0.0, acceleration: j * jerked }
    }

    fn duration_secs(&self) -> f64 {
        2.0 * self.rising + self.cruising
    }

    /// Share of the way at a time, its speed and its acceleration (ways, seconds).
    fn at(&self, secs: f64) -> [f64; 3] {
        let duration = self.duration_secs();
        if duration == 0.0 || secs >= duration {
            return [1.0, 0.0, 0.0];
        }
        if secs > 0.5 * duration {
            let [share, speed, acceleration] = self.at(duration - secs);
            return [1.0 - share, speed, -acceleration];
        }
        let Self { jerked, rising, acceleration: a, .. } = *self;
        let jerk = if jerked > 0.0 { a / jerked } else { 0.0 };
        let top = a * (rising - jerked);
        if secs < jerked {
            [jerk * secs.powi(3) / 6.0, 0.5 * jerk * secs * secs, jerk * secs]
        } else if secs < rising - jerked {
            let t = secs - jerked;
            let (share, speed) = (jerk * jerked.powi(3) / 6.0, 0.5 * jerk * jerked * jerked);
            [share + t * (speed + 0.5 * a * t), speed + a * t, a]
        } else if secs < rising {
            let left = rising - secs;
            let share = 0.5 * top * rising - top * left + jerk * left.powi(3) / 6.0;
            [share, top - 0.5 * jerk * left * left, jerk * left]
        } else {
            [0.5 * top * rising + top * (secs - rising), top, 0.0]
        }
    }
}

/// Velocities and accelerations at the points, per step, of the cubic spline with continuous acceleration whose
/// velocity is 0 at both ends; the accelerations there are 0 instead of the spline's.
fn spline(positions: &[Vec<f64>]) -> (Vec<Vec<f64>>, Vec<Vec<f64>>) {
    let (points, dof) = (positions.len(), positions[0].len());
    let mut velocities = vec![vec![0.0; dof]; points];
    let mut accelerations = vec![vec![0.0; dof]; points];
    // v[k-1] + 4 v[k] + v[k+1] = 3 (q[k+1] - q[k-1]): eliminated downwards, then filled in upwards.
    let mut pivots = vec![0.0; points];
    for k in 1..points.saturating_sub(1) {
        pivots[k] = 1.0 / (4.0 - pivots[k - 1]);
        for j in 0..dof {
            let right = 3.0 * (positions[k + 1][j] - positions[k - 1][j]);
            velocities[k][j] = (right - velocities[k - 1][j]) * pivots[k];
        }
    }
    for k in (1..points.saturating_sub(1)).rev() {
        let (here, after) = velocities.split_at_mut(k + 1);
        for (here, after) in here[k].iter_mut().zip(&after[0]) {
            *here -= pivots[k] * after;
        }
    }
    for k in 1..points {
        for j in 0..dof {
            let step = positions[k][j] - positions[k - 1][j];
            let (start, end) = (velocities[k - 1][j], velocities[k][j]);
            let cubic = Cubic { step, start, end };
            if k + 1 < points {
                accelerations[k][j] = cubic.linear() + 2.0 * cubic.quadratic();
            }
        }
    }
    (velocities, accelerations)
}

/// The cubic over one step of time that moves by `step` with these velocities at its ends:
/// `q'(u) = start + 2 (3 step - 2 start - end) u + 3 (start + end - 2 step) u^2`.
struct Cubic {
    step: f64,
    start: f64,
    end: f64,
}

/// How far a joint goes within a step, and how fast, in units of the step.
#[derive(Debug, Clone, Copy)]
struct Peaks {
    lowest: f64,
    highest: f64,
    speed: f64,
    acceleration: f64,
    jerk: f64,
}

impl Peaks {
    fn or(&self, other: &Self) -> Self {
        Self {
            lowest: self.lowest.min(other.lowest),
            highest: self.highest.max(other.highest),
            speed: self.speed.max(other.speed),
            acceleration: self.acceleration.max(other.acceleration),
            jerk: self.jerk.max(other.jerk),
        }
    }

    /// By how much slower the step has to be for a joint's limits.
    fn slowdown(&self, joint: &Joint, step_secs: f64, scales: Scales) -> f64 {
        let speed = self.speed / (step_secs * scales.velocity * joint.velocity);
        let acceleration = joint.acceleration.map_or(0.0, |limit| {
            self.acceleration / (step_secs.powi(2) * scales.acceleration * limit)
        });
        let jerk = joint.jerk.map_or(0.0, |limit| self.jerk / (step_secs.powi(3) * limit));
        speed.max(acceleration.sqrt()).max(jerk.cbrt())
    }
}

impl Cubic {
    fn peaks(&self, from: f64) -> Peaks {
        let (a, b) = (self.linear(), self.quadratic());
        let inside = |u: &f64| *u > 0.0 && *u < 1.0;
        let velocity = |u: f64| self.start + u * (a + u * b);
        let turn = [-a / (2.0 * b)].into_iter().filter(inside);
        let speeds = turn.map(velocity).chain([self.start, self.end]);
        // Where the velocity is 0, by the form of the roots that loses no digits.
        let root = (a * a - 4.0 * b * self.start).max(0.0).sqrt();
        let w = -0.5 * (a + a.signum() * root);
        let position = |u: f64| from + u * (self.start + u * (0.5 * a + u * b / 3.0));
        let turns = [w / b, self.start / w].into_iter().filter(inside).map(position);
        let ends = [from, from + self.step];
        let all = turns.chain(ends);
        Peaks {
            lowest: all.clone().fold(f64::INFINITY, f64::min),
            highest: all.fold(f64::NEG_INFINITY, f64::max),
            speed: speeds.fold(0.0, |most, v| v.abs().max(most)),
            // Linear, so at one of the ends.
            acceleration: a.abs().max((a + 2.0 * b).abs()),
            jerk: (2.0 * b).abs(),
        }
    }

    /// Bounds of the quintic with the same ends and these accelerations there.
    fn quintic_peaks(&self, from: f64, start: f64, end: f64) -> Peaks {
        let to = from + self.step;
        let points = [
            from,
            from + 0.2 * self.start,
            from + 0.4 * self.start + 0.05 * start,
            to - 0.4 * self.end + 0.05 * end,
            to - 0.2 * self.end,
            to,
        ];
        let largest = |values: &[f64]| values.iter().fold(0.0, |most: f64, v| v.abs().max(most));
        let differences = |values: &[f64], factor: f64| -> Vec<f64> {
            values.windows(2).map(|pair| factor * (pair[1] - pair[0])).collect()
        };
        let velocities = differences(&points, 5.0);
        let accelerations = differences(&velocities, 4.0);
        let jerks = differences(&accelerations, 3.0);
        Peaks {
            lowest: points.into_iter().fold(f64::INFINITY, f64::min),
            highest: points.into_iter().fold(f64::NEG_INFINITY, f64::max),
            speed: largest(&velocities),
            acceleration: largest(&accelerations),
            jerk: largest(&jerks),
        }
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
        limited(velocities, acceleration, None)
    }

    fn limited(velocities: &[f64], acceleration: Option<f64>, jerk: Option<f64>) -> Chain {
        let joint = |(i, &velocity): (usize, &f64)| Joint {
            name: format!("joint_{i}"),
            kind: JointKind::Revolute,
            parent_from_joint: Isometry3::identity(),
            axis: Vector3::z_axis(),
            lower: -30.0,
            upper: 30.0,
            velocity,
            acceleration,
            jerk,
            mimic: None,
        };
        let joints = velocities.iter().enumerate().map(joint).collect();
        Chain::new("base", "tip", joints, Isometry3::identity()).unwrap()
    }

    /// Position, velocity, acceleration and jerk of what a controller plays between the points, sampled 20 times
    /// per step straight from the conditions at the step's ends: four for cubics, six for quintics.
    fn played(trajectory: &JointTrajectory, joint: usize, quintic: bool) -> Vec<[f64; 4]> {
        let mut played = Vec::new();
        for k in 1..trajectory.times_secs.len() {
            let h = trajectory.times_secs[k] - trajectory.times_secs[k - 1];
            let ends = |values: &[Vec<f64>]| [values[k - 1][joint], values[k][joint]];
            let ([p0, p1], [v0, v1]) = (ends(&trajectory.positions), ends(&trajectory.velocities));
            let [a0, a1] = ends(&trajectory.accelerations);
            // Coefficients of t^0 to t^5.
            let c = if quintic {
                let (x, y, z) = (
                    p1 - p0 - v0 * h - 0.5 * a0 * h * h,
                    (v1 - v0 - a0 * h) * h,
                    (a1 - a0) * h * h,
                );
                [
                    p0,
                    v0,
                    0.5 * a0,
                    (10.0 * x - 4.0 * y + 0.5 * z) / h.powi(3),
                    (-15.0 * x + 7.0 * y - z) / h.powi(4),
                    (6.0 * x - 3.0 * y + 0.5 * z) / h.powi(5),
                ]
            } else {
                let c2 = (3.0 * (p1 - p0) / h - 2.0 * v0 - v1) / h;
                let c3 = (2.0 * (p0 - p1) / h + v0 + v1) / (h * h);
                [p0, v0, c2, c3, 0.0, 0.0]
            };
            for i in 0..=20 {
                let t = h * f64::from(i) / 20.0;
                let derivative = |order: i32| -> f64 {
                    let term = |(n, c): (i32, &f64)| {
                        let factor: i32 = (0..order).map(|k| n - k).product();
                        if n < order { 0.0 } else { c * f64::from(factor) * t.powi(n - order) }
                    };
                    (0..).zip(&c).map(term).sum()
                };
                played.push([derivative(0), derivative(1), derivative(2), derivative(3)]);
            }
        }
        played
    }

    fn paths() -> impl Strategy<Value = Vec<Vec<f64>>> {
        prop::collection::vec(prop::collection::vec(-3.0..3.0f64, 2), 1..30)
    }

    fn timed(chain: &Chain, positions: &[Vec<f64>], step: f64, velocity: f64) -> Timed {
        time(chain, positions, step, Scales { velocity, acceleration: 1.0 }).unwrap()
    }

    proptest! {
        #[test]
        fn what_a_controller_plays_stays_inside_every_limit(
            positions in paths(),
            step in 0.01..1.0f64,
            velocity in 0.05..1.0f64,
            acceleration in 0.05..1.0f64,
        ) {
            let chain = limited(&[1.5, 0.7], Some(6.0), Some(40.0));
            let timed = time(&chain, &positions, step, Scales { velocity, acceleration }).unwrap();
            prop_assert!(timed.slowdown >= 1.0);
            for (j, joint) in chain.joints().iter().enumerate() {
                for quintic in [false, true] {
                    for [_, v, a, jerk] in played(&timed.trajectory, j, quintic) {
                        prop_assert!(v.abs() <= joint.velocity * velocity * (1.0 + 1e-6));
                        prop_assert!(a.abs() <= 6.0 * acceleration * (1.0 + 1e-6));
                        prop_assert!(jerk.abs() <= 40.0 * (1.0 + 1e-4), "{} {}", jerk, quintic);
                    }
                }
            }
        }

        #[test]
        fn neither_velocity_nor_acceleration_jumps(positions in paths()) {
            let trajectory = timed(&chain(&[1.5, 0.7], None), &positions, 0.1, 1.0).trajectory;
            for joint in 0..2 {
                let played = played(&trajectory, joint, false);
                for pair in played.chunks(21).collect::<Vec<_>>().windows(2) {
                    // Position, velocity and acceleration.
                    for (end, start) in pair[0][20].iter().zip(pair[1][0]).take(3) {
                        prop_assert!((end - start).abs() < 1e-6 * (1.0 + end.abs()));
                    }
                }
            }
        }

        #[test]
        fn times_rise_from_above_zero_in_equal_steps_and_both_ends_are_at_rest(
            positions in paths(), step in 0.01..1.0f64,
        ) {
            let trajectory = timed(&chain(&[1.5, 0.7], None), &positions, step, 1.0).trajectory;
            prop_assert_eq!(&trajectory.positions, &positions);
            prop_assert_eq!(trajectory.times_secs.len(), positions.len());
            prop_assert_eq!(trajectory.velocities.len(), positions.len());
            prop_assert_eq!(trajectory.accelerations.len(), positions.len());
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
        fn a_joint_that_would_leave_its_range_between_two_points_is_told(positions in paths()) {
            // The range ends where the points do.
            let mut joints = chain(&[1.5, 0.7], None).joints().to_vec();
            for (j, joint) in joints.iter_mut().enumerate() {
                joint.lower = positions.iter().map(|q| q[j]).fold(2.9, f64::min);
                joint.upper = positions.iter().map(|q| q[j]).fold(3.0, f64::max);
            }
            let narrow = Chain::new("base", "tip", joints, Isometry3::identity()).unwrap();
            let wide = timed(&chain(&[1.5, 0.7], None), &positions, 0.1, 1.0).trajectory;
            let leaves = |j: usize, by: f64| {
                let joint = &narrow.joints()[j];
                played(&wide, j, false).iter().any(|[q, ..]| {
                    *q < joint.lower - by || *q > joint.upper + by
                })
            };
            match time(&narrow, &positions, 0.1, Scales::default()) {
                Ok(_) => prop_assert!(!leaves(0, 1e-9) && !leaves(1, 1e-9)),
                // The samples may miss the turn.
                Err(e) => prop_assert!(leaves(0, -1e-2) || leaves(1, -1e-2), "{}", e),
            }
        }

        #[test]
        fn half_the_velocity_takes_twice_the_time(positions in paths()) {
            let chain = chain(&[1.5, 0.7], None);
            let slowdown = |scale| timed(&chain, &positions, 1e-3, scale).slowdown;
            let (full, half) = (slowdown(1.0), slowdown(0.5));
            prop_assume!(full > 1.0);
            prop_assert!((half / full - 2.0).abs() < 1e-6);
        }

        #[test]
        fn an_approach_goes_straight_from_rest_to_rest_inside_the_limits(
            from in prop::collection::vec(-3.0..3.0f64, 2),
            to in prop::collection::vec(-3.0..3.0f64, 2),
            jerk in prop::option::of(5.0..50.0f64),
        ) {
            let chain = limited(&[1.5, 0.7], Some(3.0), jerk);
            let Timed { trajectory, slowdown } =
                approach(&chain, &from, &to, 0.05, Scales::default()).unwrap();
            let last = trajectory.positions.len() - 1;
            prop_assert_eq!(&trajectory.positions[last], &to);
            for j in 0..2 {
                let between = from[j].min(to[j])..=from[j].max(to[j]);
                prop_assert!(trajectory.positions.iter().all(|q| between.contains(&q[j])));
            }
            prop_assert_eq!(&trajectory.velocities[last][..], &[0.0, 0.0][..]);
            prop_assert!(trajectory.times_secs[0] > 0.0);
            // What the corners of the profile cost between the points is little.
            prop_assert!(slowdown < 1.5, "{}", slowdown);
            for j in 0..2 {
                for quintic in [false, true] {
                    for [_, v, a, jerk_there] in played(&trajectory, j, quintic) {
                        prop_assert!(v.abs() <= [1.5, 0.7][j] * (1.0 + 1e-6));
                        prop_assert!(a.abs() <= 3.0 * (1.0 + 1e-6));
                        prop_assert!(jerk_there.abs() <= jerk.unwrap_or(f64::INFINITY) * (1.0 + 1e-4));
                    }
                }
            }
            let way = [to[0] - from[0], to[1] - from[1]];
            for q in &trajectory.positions {
                let cross = (q[0] - from[0]) * way[1] - (q[1] - from[1]) * way[0];
                prop_assert!(cross.abs() < 1e-9);
            }
        }
    }

    /// Ruckig's durations, made by tests/golden/approach.py.
    #[test]
    fn an_approach_takes_as_long_as_ruckig_says() {
        #[derive(serde::Deserialize)]
        struct Case {
            from: Vec<f64>,
            to: Vec<f64>,
            velocity: Vec<f64>,
            acceleration: Vec<f64>,
            jerk: Option<Vec<f64>>,
            duration_secs: f64,
        }
        let text = include_str!("../../tests/golden/approach.json");
        let cases: Vec<Case> = serde_json::from_str(text).unwrap();
        assert!(cases.len() >= 100);
        for case in cases {
            let mut joints = chain(&case.velocity, None).joints().to_vec();
            for (j, joint) in joints.iter_mut().enumerate() {
                joint.acceleration = Some(case.acceleration[j]);
                joint.jerk = case.jerk.as_ref().map(|jerk| jerk[j]);
            }
            let chain = Chain::new("base", "tip", joints, Isometry3::identity()).unwrap();
            let profile = Profile::along(&chain, &case.from, &case.to, Scales::default(), 0.0);
            let duration = profile.duration_secs();
            assert!((duration - case.duration_secs).abs() < 1e-6 * duration, "{duration}");
            // The whole way is gone, and each of its rates is the slope of the one before.
            assert_eq!((profile.at(0.0)[0], profile.at(duration)[0]), (0.0, 1.0));
            let step = duration / 1000.0;
            let rates: Vec<_> = (0..=1000).map(|i| profile.at(f64::from(i) * step)).collect();
            for pair in rates.windows(2) {
                let slope = |k: usize| (pair[1][k] - pair[0][k]) / step;
                let middle = |k: usize| 0.5 * (pair[1][k] + pair[0][k]);
                assert!((slope(0) - middle(1)).abs() <= profile.acceleration * step);
                let jerked = profile.jerked > 0.0;
                assert!(
                    !jerked
                        || (slope(1) - middle(2)).abs()
                            <= profile.acceleration / profile.jerked * step
                );
            }
        }
    }

    #[test]
    fn easing_takes_half_of_its_times_longer_and_ends_where_the_path_does() {
        let (shares, whole) = eased(4.0, 0.4, 1.0, 471);
        assert!((whole - 4.7).abs() < 1e-12);
        let shares: Vec<_> = shares.collect();
        assert_eq!((shares[0], shares[470]), (0.0, 1.0));
        // In between as fast as before: 0.01 s a step of 4 s.
        assert!((shares[201] - shares[200] - 0.0025).abs() < 1e-12);
        // At both ends the speed goes to 0 evenly.
        let speeds: Vec<_> = shares.windows(2).map(|s| s[1] - s[0]).collect();
        assert!(speeds[0] < 0.02 * 0.0025 && speeds[469] < 0.01 * 0.0025);
        assert!(speeds.windows(2).all(|s| (s[1] - s[0]).abs() <= 0.0025 / 40.0 + 1e-12));
        let (same, whole) = eased(4.0, 0.0, 0.0, 5);
        assert_eq!((same.collect::<Vec<_>>(), whole), (vec![0.0, 0.25, 0.5, 0.75, 1.0], 4.0));
    }

    #[test]
    fn a_motion_inside_its_limits_keeps_its_time() {
        let positions: Vec<_> = (0..50).map(|i| vec![(0.05 * f64::from(i)).sin()]).collect();
        let timed = timed(&chain(&[2.0], None), &positions, 0.1, 1.0);
        assert_eq!(timed.slowdown, 1.0);
        assert!((timed.trajectory.times_secs[49] - 5.0).abs() < 1e-12);
        for i in 8..28 {
            let at = 0.05 * i as f64;
            let velocity = timed.trajectory.velocities[i][0];
            let acceleration = timed.trajectory.accelerations[i][0];
            assert!((velocity - 0.5 * at.cos()).abs() < 1e-3, "point {i}: {velocity}");
            assert!((acceleration + 0.25 * at.sin()).abs() < 1e-2, "point {i}: {acceleration}");
        }
    }

    #[test]
    fn the_slowdown_is_what_the_fastest_step_needs_and_no_more() {
        // There and back, and at rest for long at both ends.
        let mut positions = vec![vec![0.0]; 9];
        positions[4] = vec![1.0];
        let free = timed(&chain(&[1e3], None), &positions, 1.0, 1.0).trajectory;
        let most = |k: usize| {
            let played = played(&free, 0, false);
            played.iter().map(|values| values[k].abs()).fold(0.0, f64::max)
        };
        let slowdown = timed(&chain(&[0.5], None), &positions, 0.5, 1.0).slowdown;
        assert!((slowdown / (most(1) / 0.25) - 1.0).abs() < 0.01, "{slowdown}");
        let half = Scales { velocity: 1.0, acceleration: 0.5 };
        let slowdown = time(&chain(&[1e3], Some(1.0)), &positions, 1.0, half).unwrap().slowdown;
        assert!((slowdown - (most(2) / 0.5).sqrt()).abs() < 1e-6, "{slowdown}");
        let jerked = limited(&[1e3], None, Some(1.5));
        let slowdown = timed(&jerked, &positions, 1.0, 1.0).slowdown;
        assert!((slowdown - (most(3) / 1.5).cbrt()).abs() < 1e-6, "{slowdown}");
    }

    #[test]
    fn one_point_is_a_trajectory_at_rest() {
        let trajectory = timed(&chain(&[1.0], None), &[vec![0.3]], 0.1, 1.0).trajectory;
        assert_eq!(trajectory.times_secs, [0.1]);
        assert_eq!(trajectory.velocities, [[0.0]]);
        assert_eq!(trajectory.accelerations, [[0.0]]);
    }

    #[test]
    fn no_way_to_go_is_gone_at_once() {
        let trajectory = approach(&chain(&[1.0], None), &[0.3], &[0.3], 0.1, Scales::default());
        let trajectory = trajectory.unwrap().trajectory;
        assert!(trajectory.times_secs.last().is_some_and(|t| *t < 0.1));
        assert!(trajectory.positions.iter().all(|q| q[0] == 0.3));
    }
}
