//! Chains from robot descriptions, and where they put the tip, against Pinocchio's figures.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng, rngs::ChaCha8Rng};
use serde::Deserialize;
use tcvae::kinematics::{Chain, Joint, RecordMismatch, RobotRecord, inverse};
use tcvae::pose::mirrored;
use tcvae::urdf;

const BAXTER: &str = include_str!("../config/baxter.urdf");
const QUIRKS: &str = include_str!("fixtures/baxter_quirks.urdf");
const ODD_ARM: &str = include_str!("fixtures/odd_arm.urdf");

#[derive(Deserialize)]
struct Golden {
    chains: Vec<GoldenChain>,
}

#[derive(Deserialize)]
struct GoldenChain {
    urdf: String,
    base: String,
    tip: String,
    joints: Vec<String>,
    cases: Vec<GoldenCase>,
}

#[derive(Deserialize)]
struct GoldenCase {
    q: Vec<f64>,
    position: [f64; 3],
    quaternion_xyzw: [f64; 4],
    jacobian: Vec<f64>,
}

impl GoldenCase {
    fn base_from_tip(&self) -> Isometry3<f64> {
        let [x, y, z, w] = self.quaternion_xyzw;
        let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
        Isometry3::from_parts(Translation3::from(Vector3::from(self.position)), rotation)
    }
}

fn golden() -> Vec<GoldenChain> {
    let golden: Golden = serde_json::from_str(include_str!("golden/forward.json")).expect("JSON");
    golden.chains
}

fn arm(urdf_xml: &str, side: &str) -> Chain {
    urdf::chain(urdf_xml, "base", &format!("{side}_gripper")).expect("an arm")
}

fn anywhere(chain: &Chain, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let value = |j: &Joint| rng.random_range(j.lower.max(-3.0)..j.upper.min(3.1));
    chain.joints().iter().map(value).collect()
}

fn assert_same_pose(a: &Isometry3<f64>, b: &Isometry3<f64>, tolerance: f64) {
    let distance = (a.translation.vector - b.translation.vector).norm();
    let angle = a.rotation.angle_to(&b.rotation);
    assert!(distance < tolerance && angle < 10.0 * tolerance, "{distance} m, {angle} rad");
}

/// The Panda's pose of the hand's tip from the Denavit-Hartenberg parameters, in Craig's convention, that
/// its maker publishes: a, d and alpha of each joint, then the flange, the hand's turn and the fingertips.
fn panda(q: &[f64]) -> Isometry3<f64> {
    const QUARTER: f64 = std::f64::consts::FRAC_PI_2;
    let parameters = [
        (0.0, 0.333, 0.0),
        (0.0, 0.0, -QUARTER),
        (0.0, 0.316, QUARTER),
        (0.0825, 0.0, QUARTER),
        (-0.0825, 0.384, -QUARTER),
        (0.0, 0.0, QUARTER),
        (0.088, 0.0, QUARTER),
    ];
    let about = |axis, angle| {
        Isometry3::from_parts(
            Translation3::identity(),
            UnitQuaternion::from_axis_angle(&axis, angle),
        )
    };
    let mut pose = Isometry3::identity();
    for ((a, d, alpha), theta) in parameters.into_iter().zip(q) {
        pose *= about(Vector3::x_axis(), alpha)
            * Translation3::new(a, 0.0, 0.0)
            * about(Vector3::z_axis(), *theta)
            * Translation3::new(0.0, 0.0, d);
    }
    pose * Translation3::new(0.0, 0.0, 0.107)
        * about(Vector3::z_axis(), -0.5 * QUARTER)
        * Translation3::new(0.0, 0.0, 0.1034)
}

#[test]
fn the_pandas_description_is_what_its_maker_publishes() {
    let text = include_str!("../config/panda.urdf");
    let chain = urdf::chain(text, "panda_link0", "panda_hand_tcp").expect("an arm");
    let rng = &mut ChaCha8Rng::seed_from_u64(3);
    for _ in 0..200 {
        let q = anywhere(&chain, rng);
        assert_same_pose(&chain.forward(&q), &panda(&q), 1e-9);
    }
}

#[test]
fn the_tip_is_where_pinocchio_puts_it() {
    for golden in golden() {
        let xml = if golden.urdf.starts_with("config") { BAXTER } else { ODD_ARM };
        let chain = urdf::chain(xml, &golden.base, &golden.tip).unwrap();
        assert_eq!(chain.joint_names(), golden.joints);
        for case in &golden.cases {
            assert_same_pose(&chain.forward(&case.q), &case.base_from_tip(), 1e-12);
        }
    }
}

#[test]
fn the_jacobian_is_pinocchios() {
    for golden in golden() {
        let xml = if golden.urdf.starts_with("config") { BAXTER } else { ODD_ARM };
        let chain = urdf::chain(xml, &golden.base, &golden.tip).unwrap();
        for case in &golden.cases {
            let (tip, jacobian) = chain.jacobian(&case.q);
            assert_same_pose(&tip, &case.base_from_tip(), 1e-12);
            let expected =
                nalgebra::DMatrix::from_row_slice(6, golden.joints.len(), &case.jacobian);
            assert!((jacobian - expected).amax() < 1e-12);
        }
    }
}

#[test]
fn the_jacobian_is_the_derivative_of_the_tip() {
    let chain = urdf::chain(ODD_ARM, "world", "tool").unwrap();
    let step = 1e-6;
    for golden in golden().iter().filter(|g| g.tip == "tool") {
        for case in &golden.cases {
            let (_, jacobian) = chain.jacobian(&case.q);
            for joint in 0..chain.dof() {
                let moved = |by: f64| {
                    let mut q = case.q.clone();
                    q[joint] += by;
                    chain.forward(&q)
                };
                let (before, after) = (moved(-step), moved(step));
                let linear = (after.translation.vector - before.translation.vector) / (2.0 * step);
                let angular =
                    (after.rotation * before.rotation.inverse()).scaled_axis() / (2.0 * step);
                let column = jacobian.column(joint);
                assert!((column.fixed_rows::<3>(0) - linear).norm() < 1e-8);
                assert!((column.fixed_rows::<3>(3) - angular).norm() < 1e-8);
            }
        }
    }
}

#[test]
fn baxters_tip_is_where_its_published_description_puts_it() {
    let checks = [
        ([0.0; 7], [0.81514, 1.01014, 0.32098]),
        ([0.0, -0.55, 0.0, 0.75, 0.0, 1.26, 0.0], [0.63588, 0.83089, 0.19450]),
    ];
    for (q, expected) in checks {
        let position = arm(BAXTER, "left").forward(&q).translation.vector;
        assert!((position - Vector3::from(expected)).amax() < 1e-5, "{position}");
    }
}

#[test]
fn baxters_limits_are_those_that_are_published() {
    for side in ["left", "right"] {
        let chain = arm(BAXTER, side);
        let names: Vec<_> = ["s0", "s1", "e0", "e1", "w0", "w1", "w2"]
            .iter()
            .map(|joint| format!("{side}_{joint}"))
            .collect();
        assert_eq!(chain.joint_names(), names);
        let limits: Vec<_> =
            chain.joints().iter().map(|j| (j.lower, j.upper, j.velocity)).collect();
        #[expect(clippy::approx_constant, reason = "the description's own half of pi")]
        const H: f64 = 1.57079632679;
        let expected = [
            (-1.70167993878, 1.70167993878, 1.5),
            (-2.147, 1.047, 1.5),
            (-3.05417993878, 3.05417993878, 1.5),
            (-0.05, 2.618, 1.5),
            (-3.059, 3.059, 4.0),
            (-H, 2.094, 4.0),
            (-3.059, 3.059, 4.0),
        ];
        assert_eq!(limits, expected);
    }
}

#[test]
fn a_joint_never_shares_its_name_with_a_link_of_our_baxter() {
    let robot = urdf_rs::read_from_string(BAXTER).unwrap();
    assert!(robot.joints.iter().all(|j| robot.links.iter().all(|l| l.name != j.name)));
}

#[test]
fn a_description_with_a_manufacturers_quirks_is_the_same_arm() {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    for side in ["left", "right"] {
        let (ours, theirs) = (arm(BAXTER, side), arm(QUIRKS, side));
        assert_eq!(ours.joint_names(), theirs.joint_names());
        for (a, b) in ours.joints().iter().zip(theirs.joints()) {
            assert_eq!((a.lower, a.upper, a.velocity), (b.lower, b.upper, b.velocity));
        }
        for _ in 0..100 {
            let q = anywhere(&ours, &mut rng);
            assert_same_pose(&ours.forward(&q), &theirs.forward(&q), 1e-10);
        }
    }
}

#[test]
fn the_right_arm_mirrors_the_left() {
    let (left, right) = (arm(BAXTER, "left"), arm(BAXTER, "right"));
    let signs = [-1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0];
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    for _ in 0..1000 {
        let q = anywhere(&left, &mut rng);
        let mirror: Vec<_> = q.iter().zip(signs).map(|(q, sign)| sign * q).collect();
        assert_same_pose(&right.forward(&mirror), &mirrored(&left.forward(&q)), 1e-10);
    }
}

#[test]
fn a_pose_that_the_arm_can_take_is_found_again() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let odd = urdf::chain(ODD_ARM, "world", "tool").unwrap();
    for (chain, count) in [(arm(BAXTER, "left"), 500), (arm(BAXTER, "right"), 500), (odd, 300)] {
        for _ in 0..count {
            let target = chain.forward(&anywhere(&chain, &mut rng));
            let options = inverse::InverseOptions::default();
            let found =
                inverse::solve(&chain, &target, &chain.middle(), &options, &mut rng).unwrap();
            assert!(chain.within_limits(&found.positions));
            let reached = chain.forward(&found.positions);
            let distance = (reached.translation.vector - target.translation.vector).norm();
            assert!((distance - found.position_error_m).abs() < 1e-12);
            assert!(distance < 1e-3 && reached.rotation.angle_to(&target.rotation) < 1e-2);
        }
    }
}

#[test]
fn a_pose_out_of_reach_is_refused_with_the_distance() {
    // Four metres away; the arm reaches less than 1.6 m from the base.
    let chain = arm(BAXTER, "left");
    let mut target = chain.forward(&[0.0; 7]);
    target.translation.vector *= 3.0;
    let options = inverse::InverseOptions { max_restarts: 20, ..Default::default() };
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let error = inverse::solve(&chain, &target, &chain.middle(), &options, &mut rng).unwrap_err();
    let furthest = target.translation.vector.norm() - 1.6;
    assert!(error.nearest.position_error_m > furthest, "{error}");
    assert!(error.to_string().contains("cm"), "{error}");
}

#[test]
fn a_record_of_an_arm_knows_its_own_description_and_no_other() {
    let chain = |xml, tip| urdf::chain(xml, "base", tip).unwrap();
    let arm = chain(BAXTER, "left_gripper");
    let record = RobotRecord::new("baxter", &arm, String::new());
    assert!(record.configurations.iter().all(|q| arm.within_limits(q)));
    assert_eq!(record.check(&arm), Ok(()));
    assert_eq!(record.check(&chain(QUIRKS, "left_gripper")), Ok(()));

    let right = record.check(&chain(BAXTER, "right_gripper"));
    assert!(matches!(right, Err(RecordMismatch::Joints { .. })), "{right:?}");
    // The hand is 25 mm before the gripper.
    let hand = record.check(&chain(BAXTER, "left_hand"));
    assert!(matches!(hand, Err(RecordMismatch::Tip { configuration: 0, .. })), "{hand:?}");

    let mut moved = record.clone();
    moved.base_from_tip[3][2] += 0.0009;
    assert_eq!(moved.check(&arm), Ok(()));
    moved.base_from_tip[3][2] += 0.0002;
    let error = moved.check(&arm);
    assert!(matches!(error, Err(RecordMismatch::Tip { configuration: 3, .. })), "{error:?}");

    moved.base_from_tip.truncate(7);
    assert!(matches!(moved.check(&arm), Err(RecordMismatch::Damaged { poses: 7, .. })));
}
