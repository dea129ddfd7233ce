//! Mirroring in the xz plane, which turns what the right arm shows into what the left one does.
//!
//! Poses are mirrored by [`crate::pose::mirrored`]. An arm that is built as the mirror image of
//! another is mirrored joint by joint, which needs no kinematics: `right(s * q)` is the mirror image
//! of `left(q)` for one sign `s` per joint.

/// The signs of Baxter's arms, s0 to w2: joints whose axis lies in the plane of symmetry when the
/// arm is stretched out turn the other way. From Rethink Robotics' description of the robot, in
/// which the arms differ only in the y and the yaw of their mounts.
pub const BAXTER_SIGNS: [f64; 7] = [-1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0];

/// The joint angles (rad) with which the mirrored arm makes the mirrored motion.
///
/// # Panics
/// When there are not as many signs as joints.
pub fn mirrored_joints(joints: &[f64], signs: &[f64]) -> Vec<f64> {
    assert_eq!(joints.len(), signs.len(), "one sign per joint");
    joints.iter().zip(signs).map(|(q, s)| q * s).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pose::mirrored;
    use crate::urdf;
    use proptest::prelude::*;

    const BAXTER: &str = include_str!("../../config/baxter.urdf");

    proptest! {
        #[test]
        fn the_right_arm_with_signs_makes_the_left_arms_motion_mirrored(
            q in proptest::collection::vec(-1.5..1.5f64, 7)
        ) {
            let left = urdf::chain(BAXTER, "base", "left_gripper").unwrap();
            let right = urdf::chain(BAXTER, "base", "right_gripper").unwrap();
            let other = mirrored_joints(&q, &BAXTER_SIGNS);
            let difference = right.forward(&other).to_homogeneous()
                - mirrored(&left.forward(&q)).to_homogeneous();
            prop_assert!(difference.norm() < 1e-9, "{}", difference);
            prop_assert_eq!(mirrored_joints(&other, &BAXTER_SIGNS), q);
        }
    }
}
