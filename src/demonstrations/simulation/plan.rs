//! How a hand moves: overlapping minimum-jerk sub-movements, and the joints that follow.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, UnitVector3, Vector3};
use rand::RngExt;
use rand::rngs::ChaCha8Rng;

use super::scene::Scene;
use super::{RATE_HZ, direction, normal};
use crate::kinematics::Chain;
use crate::kinematics::following::{FollowOptions, follow};

/// Inverse kinematics sees every fifth frame; the joints between are interpolated.
const FRAMES_PER_FOLLOWED_POINT: usize = 5;

/// A change that happens along a minimum-jerk profile.
#[derive(Debug, Clone, Copy)]
pub(super) struct Move<V> {
    pub(super) start: f64,
    pub(super) duration: f64,
    pub(super) by: V,
}

impl<V: std::ops::Mul<f64, Output = V> + Copy> Move<V> {
    /// The share of the change that has happened at `t`.
    fn at(&self, t: f64) -> V {
        self.by * minimum_jerk((t - self.start) / self.duration)
    }

    /// The change as a detour: there at the middle, gone at the end.
    fn bump_at(&self, t: f64) -> V {
        let u = ((t - self.start) / self.duration).clamp(0.0, 1.0);
        self.by * (64.0 * (u * (1.0 - u)).powi(3))
    }

    pub(super) fn end(&self) -> f64 {
        self.start + self.duration
    }
}

/// Flash and Hogan's profile: 0 to 1 with no speed and no acceleration at the ends.
fn minimum_jerk(u: f64) -> f64 {
    let u = u.clamp(0.0, 1.0);
    u * u * u * (10.0 + u * (6.0 * u - 15.0))
}

/// Where a minimum-jerk profile reaches `share`.
pub(super) fn minimum_jerk_inverse(share: f64) -> f64 {
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..50 {
        let middle = 0.5 * (low + high);
        if minimum_jerk(middle) < share { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}

/// One demonstration as it is meant: the hand of the served arm over time. Times are s, tilts
/// degrees, everything else m and rad.
#[derive(Debug, Clone)]
pub(super) struct Plan {
    pub(super) duration: f64,
    /// Pose of the hand at the grasp.
    pub(super) grasp: Isometry3<f64>,
    /// When the gripper closes and opens, in turns.
    pub(super) gripper_changes: Vec<f64>,
    /// From the hand's position at the grasp.
    start_offset: Vector3<f64>,
    pub(super) moves: Vec<Move<Vector3<f64>>>,
    detours: Vec<Move<Vector3<f64>>>,
    /// Turns about the vertical.
    pub(super) yaws: Vec<Move<f64>>,
    pub(super) tilts: Vec<Move<f64>>,
    pub(super) tilt_detours: Vec<Move<f64>>,
    /// What the tilt turns about, in the base frame before the yaw.
    pub(super) tilt_axis: UnitVector3<f64>,
    /// Where the hand draws back to while the object tilts; all of the way at 90 degrees.
    pub(super) drawn_back: Vector3<f64>,
    /// Direction from the source to the target in the plane, rad.
    pub(super) way: f64,
    /// Where something goes wrong, if it does.
    pub(super) accident_secs: f64,
}

impl Plan {
    /// The hand, idle, some way behind the object; with it, that way in two parts.
    pub(super) fn behind(scene: &Scene, rng: &mut ChaCha8Rng) -> (Self, [Vector3<f64>; 2]) {
        let behind = -scene.approach() * rng.random_range(0.08..0.14);
        let far = Vector3::new(
            rng.random_range(-0.16..-0.04),
            rng.random_range(-0.06..0.10),
            rng.random_range(0.02..0.14),
        );
        let way = scene.target - scene.grasp.translation.vector;
        let plan = Self {
            duration: 0.0,
            grasp: scene.grasp,
            gripper_changes: Vec::new(),
            start_offset: behind + far,
            moves: Vec::new(),
            detours: Vec::new(),
            yaws: Vec::new(),
            tilts: Vec::new(),
            tilt_detours: Vec::new(),
            // Any that lies flat, for who tilts nothing.
            tilt_axis: Vector3::x_axis(),
            drawn_back: Vector3::zeros(),
            way: way.y.atan2(way.x),
            accident_secs: 0.0,
        };
        (plan, [behind, far])
    }

    /// From behind the object to the object; returns when it is there.
    pub(super) fn reach(
        &mut self,
        start: f64,
        behind: Vector3<f64>,
        near: Vector3<f64>,
        rng: &mut ChaCha8Rng,
    ) -> f64 {
        let first = Move { start, duration: rng.random_range(1.2..2.2), by: near };
        let second = Move {
            start: first.start + first.duration * rng.random_range(0.6..0.9),
            duration: rng.random_range(1.0..1.6),
            by: -behind,
        };
        self.moves.extend([first, second]);
        first.end().max(second.end())
    }

    /// Lifts the object a bit off the vertical; returns by how much.
    pub(super) fn lift(
        &mut self,
        start: f64,
        duration: f64,
        by: f64,
        rng: &mut ChaCha8Rng,
    ) -> Vector3<f64> {
        let up = Vector3::new(rng.random_range(-0.015..0.015), rng.random_range(-0.015..0.015), by);
        self.moves.push(Move { start, duration, by: up });
        up
    }

    /// Carries the object, turning it about the vertical.
    pub(super) fn carry(
        &mut self,
        start: f64,
        duration: f64,
        by: Vector3<f64>,
        yaw: f64,
        rng: &mut ChaCha8Rng,
    ) {
        // The way is covered in one to three overlapping sub-movements over one or two points that
        // lie a little off the straight line.
        let parts = rng.random_range(1..=3_usize);
        let mut done = 0.0;
        for part in 0..parts {
            let share = if part + 1 == parts { 1.0 - done } else { (1.0 - done) * 0.5 };
            let at = done * 0.75 * duration;
            let secs = if part + 1 == parts {
                duration - at
            } else {
                (duration - at) * rng.random_range(0.7..0.95)
            };
            self.moves.push(Move { start: start + at, duration: secs, by: by * share });
            done += share;
        }
        for _ in 0..rng.random_range(0..=2) {
            let secs = duration * rng.random_range(0.5..0.9);
            let start = start + rng.random_range(0.0..1.0) * (duration - secs);
            let by = direction(rng) * rng.random_range(0.004..0.022);
            self.detours.push(Move { start, duration: secs, by });
        }
        // The way bends, most often away from the body.
        let across = Vector3::new(-self.way.sin(), self.way.cos(), 0.0);
        let bend = by.norm() * (0.06 * across.x.signum() + 0.08 * normal(rng));
        self.detours.push(Move { start, duration, by: across * bend });
        self.yaws.push(Move { start, duration, by: yaw });
    }

    /// Lets go, and draws the hand back.
    pub(super) fn retreat(&mut self, start: f64, approach: &Vector3<f64>, rng: &mut ChaCha8Rng) {
        let duration = rng.random_range(1.0..1.6);
        self.moves.push(Move {
            start,
            duration,
            by: -approach * rng.random_range(0.08..0.13)
                + Vector3::z() * rng.random_range(0.0..0.05),
        });
        self.duration = start + duration + rng.random_range(0.4..1.2);
    }

    /// Where the hand is, from its position at the grasp.
    pub(super) fn offset(&self, t: f64) -> Vector3<f64> {
        let moved: Vector3<f64> = self.moves.iter().map(|m| m.at(t)).sum();
        let detour: Vector3<f64> = self.detours.iter().map(|m| m.bump_at(t)).sum();
        let tilt = self.tilt_deg(t).to_radians();
        self.start_offset + moved + detour + self.drawn_back * tilt.sin()
    }

    /// Tilt of the object against its axis at the grasp.
    pub(super) fn tilt_deg(&self, t: f64) -> f64 {
        let tilt: f64 = self.tilts.iter().map(|m| m.at(t)).sum();
        let detour: f64 = self.tilt_detours.iter().map(|m| m.bump_at(t)).sum();
        tilt + detour
    }

    /// The hand in the base frame.
    pub(super) fn pose(&self, t: f64) -> Isometry3<f64> {
        // Turning by phi about an axis with height z tilts the vertical by less than phi:
        // cos(tilt) = z^2 + (1 - z^2) cos(phi).
        let tilt = self.tilt_deg(t).to_radians();
        let z2 = self.tilt_axis.z.powi(2);
        let turn = ((tilt.cos() - z2) / (1.0 - z2)).clamp(-1.0, 1.0).acos().copysign(tilt);
        let yaw: f64 = self.yaws.iter().map(|m| m.at(t)).sum();
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw)
            * UnitQuaternion::from_axis_angle(&self.tilt_axis, turn)
            * self.grasp.rotation;
        Isometry3::from_parts(
            Translation3::from(self.grasp.translation.vector + self.offset(t)),
            rotation,
        )
    }

    /// The arm's joints at every frame; none where the arm can't make the motion.
    pub(super) fn joints(&self, chain: &Chain, rng: &mut ChaCha8Rng) -> Option<Vec<Vec<f64>>> {
        let step_secs = FRAMES_PER_FOLLOWED_POINT as f64 / RATE_HZ;
        let points = (self.duration / step_secs).ceil() as usize + 1;
        let poses: Vec<_> = (0..points).map(|i| self.pose(i as f64 * step_secs)).collect();
        let followed = follow(chain, &poses, step_secs, &FollowOptions::default(), rng).ok()?;
        // A guided arm is no faster than a driven one.
        if followed.speed > 1.0 {
            return None;
        }
        let q = followed.positions;
        let frames = (points - 1) * FRAMES_PER_FOLLOWED_POINT;
        let frame = |frame: usize| {
            let i = frame / FRAMES_PER_FOLLOWED_POINT;
            let u = (frame % FRAMES_PER_FOLLOWED_POINT) as f64 / FRAMES_PER_FOLLOWED_POINT as f64;
            let at = |k: isize| &q[(i as isize + k).clamp(0, points as isize - 1) as usize];
            (0..chain.dof())
                .map(|j| catmull_rom([at(-1)[j], at(0)[j], at(1)[j], at(2)[j]], u))
                .collect()
        };
        Some((0..frames).map(frame).collect())
    }
}

/// The value at `u` between the second and the third of four equally spaced points.
fn catmull_rom([p0, p1, p2, p3]: [f64; 4], u: f64) -> f64 {
    let [a, b] = [0.5 * (p2 - p0), 0.5 * (p3 - p1)];
    let (u2, u3) = (u * u, u * u * u);
    p1 * (2.0 * u3 - 3.0 * u2 + 1.0)
        + a * (u3 - 2.0 * u2 + u)
        + p2 * (3.0 * u2 - 2.0 * u3)
        + b * (u3 - u2)
}
