//! End-effector poses and the 6-D states that the model sees.
//!
//! A state is the tip's position in the base frame (m) and its rotation vector (rad) relative to a
//! stated reference orientation, `base_from_tip = reference * exp(r)`. Along a trajectory the
//! rotation vector is unwrapped: of the vectors that mean the same rotation, each step takes the
//! one nearest to the step before, so a motion through a half turn has no jump.

use std::f64::consts::TAU;

use nalgebra::{Isometry3, Matrix3, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

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

    /// The frame of states that are mirrored by [`mirrored_states`].
    pub fn mirrored(&self) -> Self {
        let turned = Isometry3::from_parts(Translation3::identity(), self.reference);
        Self { reference: mirrored(&turned).rotation }
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

/// Radius of the ball that holds 95 % of a normal distribution in three dimensions, in standard deviations of one
/// of them: the root of the .95 quantile of chi squared with three degrees of freedom.
pub const BAND_STDDEVS: f64 = 2.795_483_482_915_108;

/// Standard deviation of the position (m) along an axis, of a state's standard deviations: the root of the mean
/// variance.
pub fn position_stddev(stddev: &[f64]) -> f64 {
    root_mean_square(&stddev[..3])
}

/// Standard deviation of the rotation vector (rad), likewise.
pub fn orientation_stddev(stddev: &[f64]) -> f64 {
    root_mean_square(&stddev[3..STATE_DIM])
}

fn root_mean_square(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64).sqrt()
}

/// What predicted standard deviations of a pose's state are multiplied by.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DeviationScale {
    /// Of the position.
    pub position: f64,
    /// Of the rotation vector.
    pub orientation: f64,
}

impl DeviationScale {
    /// Whether both are numbers above 0.
    pub fn is_positive(&self) -> bool {
        [self.position, self.orientation].iter().all(|s| s.is_finite() && *s > 0.0)
    }

    /// The deviations, scaled.
    ///
    /// # Panics
    /// For other states than those of poses.
    pub fn scaled(&self, stddev: &Trajectory) -> Trajectory {
        let Self { position: p, orientation: o } = *self;
        scaled_states(stddev, [p, p, p, o, o, o])
    }
}

fn scaled_states(states: &Trajectory, factors: [f64; STATE_DIM]) -> Trajectory {
    assert_eq!(states.dim(), STATE_DIM, "states of poses");
    let values = states.states().flat_map(|state| state.iter().zip(factors).map(|(v, f)| v * f));
    Trajectory::new(STATE_DIM, values.collect()).expect("finite factors")
}

/// Values of a pose's state as a turn: the position, what the angle leaves of the turn, the angle.
pub(crate) const TURN_DIM: usize = STATE_DIM + 1;
/// Values of a motion as turns that are the same at each step: the axis, and the first orientation.
pub(crate) const TURN_CONSTANTS: usize = 6;

/// A motion's states as turns from its first orientation, in the frame of that:
/// `first * exp(angle_t * axis + rest_t)`, where the axis is that of the largest turn. Beside the states
/// `(position, rest, angle)` the constants `(axis, first)`.
#[cfg(feature = "train")]
pub(crate) fn to_turns(states: &Trajectory) -> (Trajectory, [f64; TURN_CONSTANTS]) {
    let base = StateFrame { reference: UnitQuaternion::identity() };
    let first = rotation_vector(states.state(0));
    let frame = StateFrame { reference: UnitQuaternion::from_scaled_axis(first) };
    let relative = frame.trajectory(&base.poses(states));
    let turns = || relative.states().map(rotation_vector);
    let largest = turns().max_by(|a, b| a.norm().total_cmp(&b.norm()));
    let axis = unit(&largest.unwrap_or_default());
    let values = relative.states().zip(turns()).flat_map(|(state, turn)| {
        let angle = turn.dot(&axis);
        let rest = turn - axis * angle;
        [state[0], state[1], state[2], rest.x, rest.y, rest.z, angle]
    });
    let values =
        Trajectory::new(TURN_DIM, values.collect()).expect("finite states are finite turns");
    (values, [axis.x, axis.y, axis.z, first.x, first.y, first.z])
}

/// The inverse of [`to_turns`], of means with their standard deviations; an axis may have any length
/// but 0. The deviations are to first order, as if all values were independent.
pub(crate) fn from_turns(
    (mean, stddev): (&Trajectory, &Trajectory),
    (constants, constants_stddev): (&[f64; TURN_CONSTANTS], &[f64; TURN_CONSTANTS]),
) -> (Trajectory, Trajectory) {
    let three = |values: &[f64]| Vector3::new(values[0], values[1], values[2]);
    let first = three(&constants[3..]);
    let axis = unit(&three(constants));
    let frame = StateFrame { reference: UnitQuaternion::from_scaled_axis(first) };
    let turn = |state: &[f64]| rotation_vector(state) + axis * state[6];
    let pose = |state: &[f64]| {
        let r = turn(state);
        frame.pose(&[state[0], state[1], state[2], r.x, r.y, r.z])
    };
    let poses: Vec<_> = mean.states().map(pose).collect();
    let base = StateFrame { reference: UnitQuaternion::identity() };
    let states = base.trajectory(&poses);
    let of_axis = (Matrix3::identity() - axis * axis.transpose())
        / three(constants).norm().max(f64::MIN_POSITIVE.sqrt());
    let of_first = right_jacobian(&first);
    let squares =
        |m: Matrix3<f64>, stddev: Vector3<f64>| m.component_mul(&m) * stddev.component_mul(&stddev);
    let deviations = mean.states().zip(stddev.states()).zip(states.states());
    let values = deviations.flat_map(|((turns, stddev), state)| {
        let turn = turn(turns);
        let to_state = right_jacobian_inverse(&rotation_vector(state));
        let by_turn = to_state * right_jacobian(&turn);
        let back = UnitQuaternion::from_scaled_axis(-turn).to_rotation_matrix();
        let variance = squares(by_turn, rotation_vector(stddev))
            + (by_turn * axis).map(|d| (d * stddev[6]).powi(2))
            + squares(by_turn * of_axis * turns[6], three(constants_stddev))
            + squares(to_state * back.matrix() * of_first, three(&constants_stddev[3..]));
        let [x, y, z] = variance.map(f64::sqrt).into();
        [stddev[0], stddev[1], stddev[2], x, y, z]
    });
    let stddev = Trajectory::new(STATE_DIM, values.collect()).expect("finite turns are finite");
    (states, stddev)
}

/// The rotation vector of a state.
fn rotation_vector(state: &[f64]) -> Vector3<f64> {
    Vector3::new(state[3], state[4], state[5])
}

/// The vector at length 1; 0 where it has no direction.
fn unit(vector: &Vector3<f64>) -> Vector3<f64> {
    vector.try_normalize(1e-9).unwrap_or_default()
}

/// `J` with `exp(r + d) = exp(r) exp(J d)` to first order.
fn right_jacobian(r: &Vector3<f64>) -> Matrix3<f64> {
    let (angle, cross) = (r.norm(), r.cross_matrix());
    // Limits at 0 where the quotients lose their digits.
    let (a, b) = if angle > 1e-3 {
        let square = angle * angle;
        ((1.0 - angle.cos()) / square, (angle - angle.sin()) / (square * angle))
    } else {
        (0.5, 1.0 / 6.0)
    };
    Matrix3::identity() - cross * a + cross * cross * b
}

/// The inverse of [`right_jacobian`], which has none at full turns: there it is that of a little less.
fn right_jacobian_inverse(r: &Vector3<f64>) -> Matrix3<f64> {
    let (angle, cross) = (r.norm(), r.cross_matrix());
    let b = if angle > 1e-3 {
        let half = 0.5 * angle;
        let tangent = half.tan();
        let tangent = if tangent.abs() > 1e-3 { tangent } else { 1e-3_f64.copysign(tangent) };
        (1.0 - half / tangent) / (angle * angle)
    } else {
        1.0 / 12.0
    };
    Matrix3::identity() + cross * 0.5 + cross * cross * b
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

/// States mirrored in the xz plane: those of the mirrored poses in the mirrored frame, since
/// `M exp(r) M = exp(-M r)`.
///
/// # Panics
/// For other states than those of poses.
pub fn mirrored_states(states: &Trajectory) -> Trajectory {
    scaled_states(states, [1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
}

#[cfg(test)]
mod tests {
    use super::*;
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

    proptest! {
        #[test]
        fn mirrored_states_are_those_of_the_mirrored_poses(
            poses in proptest::collection::vec(pose(), 2..9), reference in pose()
        ) {
            let frame = StateFrame { reference: reference.rotation };
            let states = frame.trajectory(&poses);
            let back = frame.mirrored().poses(&mirrored_states(&states));
            for (back, pose) in back.iter().zip(&poses) {
                let difference = back.to_homogeneous() - mirrored(pose).to_homogeneous();
                prop_assert!(difference.norm() < 1e-9, "{}", difference);
            }
            prop_assert_eq!(mirrored_states(&mirrored_states(&states)), states);
        }
    }

    fn turn() -> impl Strategy<Value = Vector3<f64>> {
        let value = || -1.3..1.3f64;
        (value(), value(), value()).prop_map(|(x, y, z)| Vector3::new(x, y, z))
    }

    proptest! {
        #[test]
        fn turns_give_their_states_back(first in turn(), other in turn(), rest in turn()) {
            let states = (0..20).flat_map(|i| {
                let at = f64::from(i) / 19.0;
                let r = first + other * at + rest * (at * (1.0 - at));
                [0.1 * at, 0.2, 0.3, r.x, r.y, r.z]
            });
            let states = Trajectory::new(STATE_DIM, states.collect()).unwrap();
            let (turns, constants) = to_turns(&states);
            prop_assert!(turns.state(0)[3..].iter().all(|v| v.abs() < 1e-9));
            let stddev = Trajectory::new(TURN_DIM, vec![0.01; TURN_DIM * 20]).unwrap();
            let (back, _) = from_turns((&turns, &stddev), (&constants, &[0.0; TURN_CONSTANTS]));
            let frame = StateFrame { reference: UnitQuaternion::identity() };
            for (a, b) in frame.poses(&states).iter().zip(frame.poses(&back)) {
                prop_assert!(a.rotation.angle_to(&b.rotation) < 1e-7);
                prop_assert!((a.translation.vector - b.translation.vector).norm() < 1e-12);
            }
        }

        /// Each deviation alone, against differences.
        #[test]
        fn deviations_are_those_of_small_changes(
            first in turn(), axis in turn(), rest in turn(), angle in -1.5..1.5f64,
            value in 0..TURN_DIM + TURN_CONSTANTS,
        ) {
            const STEP: f64 = 1e-6;
            prop_assume!(axis.norm() > 0.1);
            let values = |by: f64| {
                let mut all = vec![0.1, 0.2, 0.3, rest.x, rest.y, rest.z, angle];
                all.extend([axis.x, axis.y, axis.z, first.x, first.y, first.z]);
                all[value] += by;
                all
            };
            let mut alone = vec![0.0; TURN_DIM + TURN_CONSTANTS];
            alone[value] = 1.0;
            let turned = |mean: &[f64]| {
                let split = |all: &[f64]| {
                    let turns = Trajectory::new(TURN_DIM, all[..TURN_DIM].repeat(2)).unwrap();
                    let constants: [f64; TURN_CONSTANTS] = all[TURN_DIM..].try_into().unwrap();
                    (turns, constants)
                };
                let ((mean, constants), (stddev, deviations)) = (split(mean), split(&alone));
                let (mean, stddev) = from_turns((&mean, &stddev), (&constants, &deviations));
                (rotation_vector(mean.state(0)), rotation_vector(stddev.state(0)))
            };
            let (mean, stddev) = turned(&values(0.0));
            // Around half a turn two rotation vectors far from each other are nearly the same.
            prop_assume!(mean.norm() < 3.0);
            let [after, before] = [STEP, -STEP].map(|by| turned(&values(by)).0);
            let change = (after - before) / (2.0 * STEP);
            for i in 0..3 {
                prop_assert!((change[i].abs() - stddev[i]).abs() < 1e-4, "{change} {stddev}");
            }
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
