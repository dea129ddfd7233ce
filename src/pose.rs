//! End-effector poses and the 6-D states that the model sees.
//!
//! A state is the tip's position in the base frame (m) and its rotation vector (rad) relative to a
//! stated reference orientation, `base_from_tip = reference * exp(r)`. Along a trajectory the
//! rotation vector is unwrapped: of the vectors that mean the same rotation, each step takes the
//! one nearest to the step before, so a motion through a half turn has no jump.

use std::f64::consts::TAU;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use crate::trajectory::Trajectory;

/// Values of a pose's state.
pub const STATE_DIM: usize = 6;

/// Names of a pose's state values.
pub const STATE_NAMES: [&str; STATE_DIM] = ["x", "y", "z", "rx", "ry", "rz"];

/// Where rotation vectors are measured from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StateFrame {
    /// The orientation of the tip in the base frame whose rotation vector is 0.
    pub reference: UnitQuaternion<f64>,
}

impl StateFrame {
    /// The state of one pose, with the shortest rotation vector.
    pub fn state(&self, base_from_tip: &Isometry3<f64>) -> [f64; STATE_DIM] {
        let p = base_from_tip.translation.vector;
        let r = (self.reference.inverse() * base_from_tip.rotation).scaled_axis();
        [p.x, p.y, p.z, r.x, r.y, r.z]
    }

    /// The pose of a state.
    pub fn pose(&self, state: &[f64]) -> Isometry3<f64> {
        let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(state[3], state[4], state[5]));
        Isometry3::from_parts(
            Translation3::new(state[0], state[1], state[2]),
            self.reference * rotation,
        )
    }

    /// The states of poses that follow each other, unwrapped.
    ///
    /// # Panics
    /// With fewer than two poses, or poses that are not finite.
    pub fn trajectory(&self, poses: &[Isometry3<f64>]) -> Trajectory {
        let mut values = Vec::with_capacity(STATE_DIM * poses.len());
        let mut previous: Option<Vector3<f64>> = None;
        for pose in poses {
            let mut state = self.state(pose);
            let mut r = Vector3::new(state[3], state[4], state[5]);
            if let Some(previous) = previous {
                r = nearest_equivalent(r, previous);
            }
            previous = Some(r);
            state[3..].copy_from_slice(r.as_slice());
            values.extend(state);
        }
        Trajectory::new(STATE_DIM, values).expect("poses are finite and at least two")
    }

    /// The poses of a trajectory's states.
    pub fn poses(&self, trajectory: &Trajectory) -> Vec<Isometry3<f64>> {
        trajectory.states().map(|s| self.pose(s)).collect()
    }
}

/// Of the rotation vectors `r + 2 pi k r/|r|`, which all mean the same rotation, the one nearest
/// to `previous`.
fn nearest_equivalent(r: Vector3<f64>, previous: Vector3<f64>) -> Vector3<f64> {
    let angle = r.norm();
    // Near the identity the axis is undefined: turn about the axis of the step before.
    let axis = if angle > 1e-9 {
        r / angle
    } else if previous.norm() > 1e-9 {
        previous.normalize()
    } else {
        return r;
    };
    let turns = ((previous.dot(&axis) - angle) / TAU).round();
    r + axis * (turns * TAU)
}

/// The direction in the tip frame that points up in this pose: `R^T e_z`. Taken at the grasp, where
/// the cup stands upright, it is the cup's axis.
pub fn up_in_tip(base_from_tip: &Isometry3<f64>) -> Vector3<f64> {
    base_from_tip.rotation.inverse() * Vector3::z()
}

/// Angle between the cup's axis and the vertical (rad), in `[0, pi]`.
pub fn tilt(base_from_tip: &Isometry3<f64>, cup_axis_in_tip: &Vector3<f64>) -> f64 {
    (base_from_tip.rotation * cup_axis_in_tip).z.clamp(-1.0, 1.0).acos()
}

/// The pose mirrored in the xz plane: `p -> (x, -y, z)`, `R -> M R M` with `M = diag(1, -1, 1)`.
///
/// On a quaternion `M R M` keeps w and y and negates x and z.
pub fn mirrored(base_from_tip: &Isometry3<f64>) -> Isometry3<f64> {
    let p = base_from_tip.translation.vector;
    let q = base_from_tip.rotation;
    let mirrored = nalgebra::Quaternion::new(q.w, -q.i, q.j, -q.k);
    Isometry3::from_parts(
        Translation3::new(p.x, -p.y, p.z),
        UnitQuaternion::new_unchecked(mirrored),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Matrix3;
    use proptest::prelude::*;

    fn pose() -> impl Strategy<Value = Isometry3<f64>> {
        let value = || -1.0..1.0f64;
        ((value(), value(), value()), (value(), value(), value())).prop_map(|(p, r)| {
            Isometry3::new(Vector3::new(p.0, p.1, p.2), 1.8 * Vector3::new(r.0, r.1, r.2))
        })
    }

    proptest! {
        #[test]
        fn a_state_gives_its_pose_back(pose in pose(), reference in pose()) {
            let frame = StateFrame { reference: reference.rotation };
            let back = frame.pose(&frame.state(&pose));
            prop_assert!(back.rotation.angle_to(&pose.rotation) < 1e-7);
            prop_assert!((back.translation.vector - pose.translation.vector).norm() < 1e-12);
        }

        #[test]
        fn mirroring_is_m_r_m_and_twice_is_nothing(pose in pose()) {
            let m = Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, 1.0));
            let expected = m * pose.rotation.to_rotation_matrix().matrix() * m;
            let mirror = mirrored(&pose);
            prop_assert!((mirror.rotation.to_rotation_matrix().matrix() - expected).norm() < 1e-12);
            prop_assert!((mirrored(&mirror).to_homogeneous() - pose.to_homogeneous()).norm() < 1e-12);
        }
    }

    #[test]
    fn turning_through_a_full_turn_has_no_jump() {
        let frame = StateFrame { reference: UnitQuaternion::identity() };
        let turn = |i| Isometry3::rotation(Vector3::x() * (0.1 * f64::from(i) - 0.3));
        let trajectory = frame.trajectory(&(0..80).map(turn).collect::<Vec<_>>());
        for (i, state) in trajectory.states().enumerate() {
            assert!((state[3] - (0.1 * i as f64 - 0.3)).abs() < 1e-9, "step {i}: {}", state[3]);
        }
    }

    #[test]
    fn the_tilt_of_the_grasp_is_zero_and_grows_with_the_turn() {
        let grasp = Isometry3::rotation(Vector3::new(0.3, -0.2, 1.0));
        let axis = up_in_tip(&grasp);
        assert!(tilt(&grasp, &axis) < 1e-7);
        let tilted = Isometry3::rotation(Vector3::x() * 1.2) * grasp;
        assert!((tilt(&tilted, &axis) - 1.2).abs() < 1e-9);
    }
}
