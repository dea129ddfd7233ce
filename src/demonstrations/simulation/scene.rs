//! Where things stand on the table, and how the hand grasps.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rand::RngExt;
use rand::rngs::ChaCha8Rng;

use super::normal;
use crate::demonstrations::recording::{Reason, Workplace};
use crate::parameters::Interval;

/// Where the objects stand and how the hand grasps.
pub(super) struct Scene {
    pub(super) grasp: Isometry3<f64>,
    /// Where the hand begins to pour, or what it puts down is above.
    pub(super) target: Vector3<f64>,
    pub(super) lift: f64,
    /// How far the target is from the source, in standard deviations.
    pub(super) far: f64,
}

impl Scene {
    pub(super) fn draw(
        correlation: f64,
        trap: Option<Reason>,
        workplace: &Workplace,
        rng: &mut ChaCha8Rng,
    ) -> Self {
        let within = |interval: Interval, rng: &mut ChaCha8Rng| {
            rng.random_range(interval.lower..interval.upper)
        };
        let Workplace { x_m, y_m, height_m, heading_deg, shoulder_m, heading_turn_deg, .. } =
            *workplace;
        let place = |rng: &mut ChaCha8Rng| -> Vector3<f64> {
            Vector3::new(within(x_m, rng), within(y_m, rng), 0.0)
        };
        let (source, target) = loop {
            let source = place(rng);
            let mut target = place(rng);
            if trap == Some(Reason::OutOfRegion) {
                // Across the robot, where the other arm should have poured.
                target.y = y_m.lower + rng.random_range(-0.37..-0.25);
                if source.y > y_m.lower + 0.2 {
                    continue;
                }
                break (source, target);
            }
            if (0.2..0.4).contains(&(target - source).norm()) {
                break (source, target);
            }
        };
        let far = ((target - source).norm() - 0.3) / 0.058;
        let height = within(height_m, rng);
        let tied = correlation * 0.6;
        let lift = loop {
            let lift = 0.16 + 0.035 * (tied * far + (1.0 - tied * tied).sqrt() * normal(rng));
            if (0.10..0.22).contains(&lift) {
                break lift;
            }
        };
        // The hand comes from the shoulder, more or less.
        let from_shoulder = source - Vector3::new(shoulder_m[0], shoulder_m[1], 0.0);
        let natural = from_shoulder.y.atan2(from_shoulder.x).to_degrees() * 0.8 + heading_turn_deg;
        let azimuth = loop {
            let azimuth = if correlation > 0.0 {
                natural + 14.0 * normal(rng)
            } else {
                within(heading_deg, rng)
            };
            if (heading_deg.lower..heading_deg.upper).contains(&azimuth) {
                break azimuth;
            }
        };
        let pitch = rng.random_range(0.0..25.0_f64);
        let roll = rng.random_range(-8.0..8.0_f64);
        // Upright: the gripper's x up, its z forward.
        let upright = UnitQuaternion::from_euler_angles(
            0.0,
            -std::f64::consts::FRAC_PI_2,
            std::f64::consts::PI,
        );
        let rotation = UnitQuaternion::from_euler_angles(
            roll.to_radians(),
            pitch.to_radians(),
            f64::to_radians(azimuth),
        ) * upright;
        let grasp = Isometry3::from_parts(Translation3::new(source.x, source.y, height), rotation);
        let target = Vector3::new(target.x, target.y, height + lift);
        Self { grasp, target, lift, far }
    }

    /// Where the hand points.
    pub(super) fn approach(&self) -> Vector3<f64> {
        self.grasp.rotation * Vector3::z()
    }
}
