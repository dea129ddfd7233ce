//! Pours drawn at random, as poses of the tip: what a person would ask of the arm, without noise.

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use rand::{Rng, RngExt};

/// Which way the cup is tilted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Style {
    /// About the direction that the hand points in: the forearm rolls.
    Roll,
    /// Forwards, about the horizontal across it.
    Pitch,
}

/// A pour for the left arm: grasp, lift, transport, tilt, hold, and back up to 20 degrees. The cup
/// and the pour lie in front of the robot, 0.2 to 0.4 m apart.
pub(crate) fn pour<R: Rng + ?Sized>(
    style: Style,
    points: usize,
    rng: &mut R,
) -> Vec<Isometry3<f64>> {
    let mut within = |lower: f64, upper: f64| rng.random_range(lower..upper);
    let (source, target) = loop {
        let mut place = || Vector3::new(within(0.5, 0.85), within(-0.05, 0.6), 0.0);
        let (source, target) = (place(), place());
        if (0.2..0.4).contains(&(target - source).norm()) {
            break (source, target);
        }
    };
    let grasp_z = within(-0.10, 0.05);
    let lift = within(0.10, 0.22);
    let azimuth = within(-60.0, 20.0).to_radians();
    let turn = within(-20.0, 20.0).to_radians();
    let pitch = within(0.0, 25.0).to_radians();
    let most = within(80.0, 105.0).to_radians();
    let tilt_end = 20f64.to_radians();
    let side = if within(0.0, 1.0) < 0.5 { -1.0 } else { 1.0 };
    let hold = within(0.10, 0.25);

    (0..points)
        .map(|i| {
            let phase = i as f64 / (points - 1) as f64;
            let part = |from: f64, to: f64| minimum_jerk((phase - from) / (to - from));
            let position = source
                + (target - source) * part(0.08, 0.45)
                + Vector3::z() * (grasp_z + lift * part(0.0, 0.3));
            // The tilt starts before the transport ends.
            let fall = 0.7 + hold / 2.0;
            let tilt = most * part(0.3, 0.7 - hold / 2.0) - (most - tilt_end) * part(fall, 1.0);
            // The cup's axis is the tip's x; the hand points along its z, level or downwards.
            let upright = Matrix3::from_columns(&[Vector3::z(), -Vector3::y(), Vector3::x()]);
            let tilted = match style {
                Style::Roll => Rotation3::from_axis_angle(&Vector3::z_axis(), side * tilt),
                Style::Pitch => Rotation3::from_axis_angle(&Vector3::y_axis(), tilt),
            };
            let heading =
                Rotation3::from_axis_angle(&Vector3::z_axis(), azimuth + turn * part(0.1, 0.6));
            let down = Rotation3::from_axis_angle(&Vector3::y_axis(), pitch);
            let rotation = heading * down * Rotation3::from_matrix_unchecked(upright) * tilted;
            Isometry3::from_parts(
                Translation3::from(position),
                UnitQuaternion::from_rotation_matrix(&rotation),
            )
        })
        .collect()
}

/// From 0 at 0 to 1 at 1, at rest at both ends.
fn minimum_jerk(share: f64) -> f64 {
    let s = share.clamp(0.0, 1.0);
    s * s * s * (10.0 + s * (6.0 * s - 15.0))
}
