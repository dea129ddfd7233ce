//! What identifies an arm: a model file carries the record of the arm that it was made for, and is
//! served on another description only if that one moves the same.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};
use serde::{Deserialize, Serialize};

use crate::kinematics::{Chain, Joint};
use crate::pose::mirrored;

/// Configurations that a record stores.
const CONFIGURATIONS: usize = 20;
/// Half the range of a joint without limits (rad).
const TURN: f64 = std::f64::consts::PI;
/// Largest distance between the tips of two descriptions of one arm (m).
const POSITION_TOLERANCE_M: f64 = 1e-3;
/// Largest angle between the tips of two descriptions of one arm (rad).
const ORIENTATION_TOLERANCE_RAD: f64 = 1e-3;

/// Postures of demonstrations that a record stores, at most, and how near two may be to count as one (rad).
const MOST_POSTURES: usize = 12;
const SAME_POSTURE: f64 = 0.2;
/// What a turned tip counts in metres, where postures are compared with a pose.
const METRES_PER_RAD: f64 = 0.3;

/// An arm as a model file remembers it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotRecord {
    /// Name of the robot.
    pub name: String,
    /// Frame of the task and of every pose.
    pub base_frame: String,
    /// Link whose origin is the tip.
    pub tip_frame: String,
    /// Joints from the base to the tip.
    pub joint_names: Vec<String>,
    /// Joint configurations inside the limits (rad, m).
    pub configurations: Vec<Vec<f64>>,
    /// The tip in the base frame at each configuration: x y z (m), then the quaternion x y z w.
    pub base_from_tip: Vec<[f64; 7]>,
    /// SHA-256 of the description that the record was made from; provenance only.
    pub urdf_sha256: String,
    /// Postures of the arm in which demonstrations began, each different from the others (rad, m); empty where
    /// none is known.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub postures: Vec<Vec<f64>>,
}

/// How a description differs from the arm of a record.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RecordMismatch {
    /// Other joints, or another order.
    #[error("the model moves the joints {expected}; this robot's arm has {found}")]
    Joints {
        /// Joints of the record, comma-separated.
        expected: String,
        /// Joints of the description, comma-separated.
        found: String,
    },
    /// The tip is elsewhere.
    #[error(
        "at stored configuration {configuration} the tip {tip} is {position_mm:.2} mm and \
         {orientation_mrad:.2} mrad from where the model's robot has it (limits 1 mm, 1 mrad)"
    )]
    Tip {
        /// Index of the configuration.
        configuration: usize,
        /// Name of the tip frame.
        tip: String,
        /// Distance (mm).
        position_mm: f64,
        /// Angle (mrad).
        orientation_mrad: f64,
    },
    /// The record contradicts itself.
    #[error("the robot record holds {configurations} configurations and {poses} poses")]
    Damaged {
        /// Configurations with as many values as there are joints.
        configurations: usize,
        /// Poses.
        poses: usize,
    },
}

impl RobotRecord {
    /// The record of an arm, with configurations inside its limits (half a turn either way for
    /// joints without), always the same ones for the same limits.
    pub fn new(name: &str, chain: &Chain, urdf_sha256: String) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        let mut draw =
            |joint: &Joint| rng.random_range(joint.lower.max(-TURN)..=joint.upper.min(TURN));
        let configurations: Vec<Vec<f64>> =
            (0..CONFIGURATIONS).map(|_| chain.joints().iter().map(&mut draw).collect()).collect();
        let base_from_tip = configurations.iter().map(|q| pose_values(&chain.forward(q))).collect();
        Self {
            name: name.into(),
            base_frame: chain.base_frame().into(),
            tip_frame: chain.tip_frame().into(),
            joint_names: chain.joint_names(),
            configurations,
            base_from_tip,
            urdf_sha256,
            postures: Vec::new(),
        }
    }

    /// The record with a few of the postures in which demonstrations began: as different from each other as can
    /// be, in an order that begins with those which tell most of all.
    pub fn with_postures(self, demonstrated: &[Vec<f64>]) -> Self {
        let away =
            |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>();
        let nearest = |to: &[f64], chosen: &[Vec<f64>]| {
            chosen.iter().map(|q| away(q, to)).fold(f64::INFINITY, f64::min)
        };
        let cost = |q: &[f64]| demonstrated.iter().map(|other| away(q, other)).sum::<f64>();
        // The one amid all, then always the one that is furthest from those chosen so far.
        let amid = demonstrated.iter().min_by(|a, b| cost(a).total_cmp(&cost(b)));
        let mut postures: Vec<Vec<f64>> = amid.cloned().into_iter().collect();
        while postures.len() < MOST_POSTURES {
            let furthest = demonstrated
                .iter()
                .max_by(|a, b| nearest(a, &postures).total_cmp(&nearest(b, &postures)));
            match furthest {
                Some(q) if nearest(q, &postures) > SAME_POSTURE * SAME_POSTURE => {
                    postures.push(q.clone());
                }
                _ => break,
            }
        }
        Self { postures, ..self }
    }

    /// The postures of demonstrations, those first whose tip is nearest to a pose.
    pub fn postures_near(&self, chain: &Chain, base_from_tip: &Isometry3<f64>) -> Vec<&[f64]> {
        let away = |q: &[f64]| {
            let tip = chain.forward(q);
            let metres = (tip.translation.vector - base_from_tip.translation.vector).norm();
            metres + METRES_PER_RAD * tip.rotation.angle_to(&base_from_tip.rotation)
        };
        let fitting = self.postures.iter().filter(|q| q.len() == chain.dof());
        let mut postures: Vec<_> = fitting.map(|q| (away(q), q.as_slice())).collect();
        postures.sort_by(|a, b| a.0.total_cmp(&b.0));
        postures.into_iter().map(|(_, q)| q).collect()
    }

    /// The record of the arm that is the mirror image in the xz plane: at `signs * q` it is where this one
    /// is at `q`.
    pub fn mirrored(&self, joint_names: Vec<String>, tip_frame: &str, signs: &[f64]) -> Self {
        let signed = |q: &Vec<f64>| q.iter().zip(signs).map(|(q, sign)| q * sign).collect();
        let pose = |values: &[f64; 7]| pose_values(&mirrored(&pose_of(values)));
        Self {
            tip_frame: tip_frame.into(),
            joint_names,
            configurations: self.configurations.iter().map(signed).collect(),
            base_from_tip: self.base_from_tip.iter().map(pose).collect(),
            postures: self.postures.iter().map(signed).collect(),
            ..self.clone()
        }
    }

    /// Whether `chain` is the arm of this record: the same joints in the same order, and the tip
    /// within 1 mm and 1 mrad at every stored configuration.
    ///
    /// # Errors
    /// The first difference.
    pub fn check(&self, chain: &Chain) -> Result<(), RecordMismatch> {
        let found = chain.joint_names();
        if found != self.joint_names {
            return Err(RecordMismatch::Joints {
                expected: self.joint_names.join(", "),
                found: found.join(", "),
            });
        }
        let whole = self.configurations.iter().filter(|q| q.len() == found.len()).count();
        if whole == 0 || whole != self.configurations.len() || whole != self.base_from_tip.len() {
            return Err(RecordMismatch::Damaged {
                configurations: whole,
                poses: self.base_from_tip.len(),
            });
        }
        for (configuration, (q, values)) in
            self.configurations.iter().zip(&self.base_from_tip).enumerate()
        {
            let (expected, found) = (pose_of(values), chain.forward(q));
            let position = (expected.translation.vector - found.translation.vector).norm();
            let orientation = expected.rotation.angle_to(&found.rotation);
            // Written so that a NaN in an edited record is a mismatch too.
            let same = position <= POSITION_TOLERANCE_M && orientation <= ORIENTATION_TOLERANCE_RAD;
            if !same {
                return Err(RecordMismatch::Tip {
                    configuration,
                    tip: self.tip_frame.clone(),
                    position_mm: 1e3 * position,
                    orientation_mrad: 1e3 * orientation,
                });
            }
        }
        Ok(())
    }
}

fn pose_values(pose: &Isometry3<f64>) -> [f64; 7] {
    let (p, q) = (pose.translation.vector, pose.rotation);
    [p.x, p.y, p.z, q.i, q.j, q.k, q.w]
}

fn pose_of(values: &[f64; 7]) -> Isometry3<f64> {
    let [x, y, z, i, j, k, w] = *values;
    Isometry3::from_parts(
        Translation3::new(x, y, z),
        UnitQuaternion::from_quaternion(Quaternion::new(w, i, j, k)),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::urdf;

    fn record() -> (Chain, RobotRecord) {
        let urdf = include_str!("../../config/baxter.urdf");
        let chain = urdf::chain(urdf, "base", "left_gripper").unwrap();
        let record = RobotRecord::new("baxter", &chain, String::new());
        (chain, record)
    }

    #[test]
    fn postures_are_few_and_differ_and_the_first_is_amid_all() {
        let (_, record) = record();
        let at = |s0: f64| {
            let mut q = vec![0.1, -0.2, 0.3, 0.4, 0.5, 0.6, 0.7];
            q[0] = s0;
            q
        };
        let demonstrated: Vec<_> = (0..200).map(|i| at(-0.5 + 0.005 * f64::from(i))).collect();
        let postures = record.clone().with_postures(&demonstrated).postures;
        assert!((postures[0][0] - 0.0).abs() < 0.01, "{postures:?}");
        assert!((3..=MOST_POSTURES).contains(&postures.len()), "{postures:?}");
        for (i, a) in postures.iter().enumerate() {
            assert!(postures[..i].iter().all(|b| (a[0] - b[0]).abs() > SAME_POSTURE));
        }
        assert_eq!(record.clone().with_postures(&vec![at(0.2); 50]).postures, [at(0.2)]);
        assert_eq!(record.clone().with_postures(&[]), record);
    }

    #[test]
    fn the_posture_whose_tip_is_nearest_comes_first() {
        let (chain, record) = record();
        let record = record.clone().with_postures(&record.configurations);
        for q in &record.postures {
            let near = record.postures_near(&chain, &chain.forward(q));
            assert_eq!((near[0], near.len()), (q.as_slice(), record.postures.len()));
        }
    }
}
