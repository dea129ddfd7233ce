//! Paths of poses become joint paths that an arm can execute, or a refusal that says where and by
//! how much.

use nalgebra::{Isometry3, Unit, UnitQuaternion, Vector3};
use proptest::prelude::*;
use rand::{SeedableRng, rngs::ChaCha8Rng};
use tcvae::kinematics::following::{FollowError, FollowOptions, Followed, follow};
use tcvae::kinematics::inverse::{InverseOptions, solve};
use tcvae::kinematics::timing::{Scales, time};
use tcvae::kinematics::{Chain, Joint, JointKind};
use tcvae::urdf;

#[path = "support/pours.rs"]
mod pours;

const STEP_SECS: f64 = 5.0 / 99.0;

fn baxter() -> Chain {
    let xml = include_str!("../config/baxter.urdf");
    urdf::chain(xml, "base", "left_gripper").expect("an arm")
}

fn rng(seed: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed)
}

/// Three joints about z with links of 1, 0.6 and 0.2 m: what it reaches can be said by hand.
fn planar(shoulder: f64) -> Chain {
    let joint = |name: &str, x: f64, limit: f64| Joint {
        name: name.into(),
        kind: JointKind::Revolute,
        parent_from_joint: Isometry3::translation(x, 0.0, 0.0),
        axis: Vector3::z_axis(),
        lower: -limit,
        upper: limit,
        velocity: 1.0,
        acceleration: None,
        jerk: None,
        mimic: None,
    };
    let joints =
        vec![joint("shoulder", 0.0, shoulder), joint("elbow", 1.0, 2.8), joint("wrist", 0.6, 2.8)];
    Chain::new("base", "tip", joints, Isometry3::translation(0.2, 0.0, 0.0)).expect("a chain")
}

/// The tip pointing away from the base, at `radius` in direction `angle`.
fn outwards(radius: f64, angle: f64) -> Isometry3<f64> {
    Isometry3::rotation(Vector3::z() * angle) * Isometry3::translation(radius, 0.0, 0.0)
}

fn assert_follows(
    chain: &Chain,
    path: &[Isometry3<f64>],
    step_secs: f64,
    options: &FollowOptions<'_>,
    followed: &Followed,
) {
    assert_eq!(followed.positions.len(), path.len());
    let (mut position_error, mut orientation_error, mut margin) = (0f64, 0f64, f64::INFINITY);
    for (pose, q) in path.iter().zip(&followed.positions) {
        assert!(chain.within_limits(q), "{q:?}");
        margin = margin.min(chain.margin(q));
        let tip = chain.forward(q);
        let distance = (tip.translation.vector - pose.translation.vector).norm();
        position_error = position_error.max(distance);
        orientation_error = orientation_error.max(tip.rotation.angle_to(&pose.rotation));
    }
    assert!(position_error <= options.tolerance.position_m);
    assert!(orientation_error <= options.tolerance.orientation_rad);
    assert!((position_error - followed.position_error_m).abs() < 1e-9);
    assert!((orientation_error - followed.orientation_error_rad).abs() < 1e-6);
    assert!((margin - followed.joint_margin_rad).abs() < 1e-12);

    let mut speed = 0f64;
    for pair in followed.positions.windows(2) {
        for (j, joint) in chain.joints().iter().enumerate() {
            speed = speed.max((pair[1][j] - pair[0][j]).abs() / (joint.velocity * step_secs));
        }
    }
    assert!((speed - followed.speed).abs() < 1e-9);
    assert!(speed <= options.max_slowdown);
}

#[test]
fn pours_that_the_arm_can_reach_are_followed_and_within_velocity_limits_once_timed() {
    let chain = baxter();
    let options = FollowOptions::default();
    for (style, at_least) in [(pours::Style::Roll, 0.98), (pours::Style::Pitch, 0.9)] {
        let mut draw = rng(11);
        let (mut reachable, mut complete) = (0, 0);
        for seed in 0..60 {
            let path = pours::pour(style, 100, &mut draw);
            match follow(&chain, &path, STEP_SECS, &options, &mut rng(seed)) {
                Ok(followed) => {
                    complete += 1;
                    assert_follows(&chain, &path, STEP_SECS, &options, &followed);
                    let timed = time(&chain, &followed.positions, STEP_SECS, Scales::default());
                    // A path that ends at a limit may swing beyond it between its points.
                    let Ok(timed) = timed else { continue };
                    let step_secs = timed.trajectory.times_secs[0];
                    for pair in timed.trajectory.positions.windows(2) {
                        for (j, joint) in chain.joints().iter().enumerate() {
                            let step = (pair[1][j] - pair[0][j]).abs();
                            assert!(step <= joint.velocity * step_secs * (1.0 + 1e-9));
                        }
                    }
                }
                Err(error) => {
                    // An independent look: is every pose in reach on its own?
                    let mut reach = rng(1);
                    let lone = InverseOptions { max_restarts: 50, ..Default::default() };
                    let each = path
                        .iter()
                        .all(|p| solve(&chain, p, &chain.middle(), &lone, &mut reach).is_ok());
                    assert!(!error.to_string().is_empty());
                    reachable += usize::from(each);
                }
            }
        }
        reachable += complete;
        assert!(complete > 15, "{style:?}: {complete}");
        let share = complete as f64 / reachable as f64;
        assert!(share >= at_least, "{style:?}: {complete} of {reachable}");
    }
}

#[test]
fn the_same_seed_gives_the_same_joint_path() {
    let chain = baxter();
    let path = pours::pour(pours::Style::Roll, 100, &mut rng(2));
    // No margin is good enough, so that every start is tried.
    let options = FollowOptions { good_margin_rad: 10.0, ..Default::default() };
    let follow = |seed| follow(&chain, &path, STEP_SECS, &options, &mut rng(seed)).unwrap();
    assert_eq!(follow(1), follow(1));
}

#[test]
fn more_starts_find_a_better_path_and_never_a_worse_one() {
    let chain = baxter();
    let mut draw = rng(3);
    let mut better = 0;
    for _ in 0..20 {
        let path = pours::pour(pours::Style::Roll, 100, &mut draw);
        let score = |starts| {
            let options = FollowOptions {
                starts,
                further_starts: starts,
                good_margin_rad: 10.0,
                ..Default::default()
            };
            follow(&chain, &path, STEP_SECS, &options, &mut rng(1))
                .map_or(0.0, |f| 0.5 * (1.0 + f.joint_margin_rad / 10.0) / f.speed.max(1.0))
        };
        let (few, many) = (score(2), score(32));
        assert!(many >= few, "{few} {many}");
        better += usize::from(many > few);
    }
    assert!(better > 5, "{better}");
}

#[test]
fn a_given_start_is_where_the_path_begins() {
    let chain = baxter();
    let start = vec![-0.3, -0.4, 0.2, 0.9, -0.1, 1.0, 0.4];
    let first = chain.forward(&start);
    let path: Vec<_> = (0..50)
        .map(|i| Isometry3::translation(0.0, -0.002 * f64::from(i), 0.001 * f64::from(i)) * first)
        .collect();
    let options = FollowOptions { start: Some(start.clone()), ..Default::default() };
    let followed = follow(&chain, &path, 0.05, &options, &mut rng(1)).unwrap();
    assert_follows(&chain, &path, 0.05, &options, &followed);
    for (a, b) in followed.positions[0].iter().zip(&start) {
        assert!((a - b).abs() < 1e-6);
    }
}

#[test]
fn of_two_branches_the_path_takes_that_of_the_posture() {
    let arm = planar(3.0);
    let path: Vec<_> = (0..40).map(|i| outwards(1.2, 0.01 * f64::from(i))).collect();
    for elbow in [-1.0, 1.0] {
        // The elbow on this side; the tip is not yet where the path begins.
        let posture = [-0.5 * elbow, 1.2 * elbow, -0.7 * elbow];
        let options = FollowOptions { postures: vec![&posture], ..FollowOptions::default() };
        let followed = follow(&arm, &path, STEP_SECS, &options, &mut rng(1)).expect("a path");
        assert_follows(&arm, &path, STEP_SECS, &options, &followed);
        assert!(followed.positions.iter().all(|q| q[1] * elbow > 0.5), "{elbow}");
    }
}

#[test]
fn a_start_outside_the_limits_is_taken_to_the_nearest_inside() {
    let chain = baxter();
    let start = vec![-0.3, -0.4, 0.2, -0.1, -0.1, 1.0, 0.4];
    let path = vec![chain.forward(&[-0.3, -0.4, 0.2, -0.05, -0.1, 1.0, 0.4]); 3];
    let options = FollowOptions { start: Some(start), ..Default::default() };
    let followed = follow(&chain, &path, 0.05, &options, &mut rng(1)).unwrap();
    assert!((followed.positions[0][3] + 0.05).abs() < 1e-6);
}

#[test]
fn centring_keeps_the_arm_off_its_limits() {
    let chain = baxter();
    let mut draw = rng(5);
    let (mut with, mut without) = (0.0, 0.0);
    for _ in 0..30 {
        let path = pours::pour(pours::Style::Roll, 100, &mut draw);
        let margin = |centring_secs| {
            let options = FollowOptions { starts: 1, centring_secs, ..Default::default() };
            follow(&chain, &path, STEP_SECS, &options, &mut rng(1)).map(|f| f.joint_margin_rad)
        };
        if let (Ok(a), Ok(b)) = (margin(1.0), margin(f64::INFINITY)) {
            with += a;
            without += b;
        }
    }
    assert!(with > 1.02 * without, "{with} {without}");
}

#[test]
fn a_path_that_leaves_the_arms_reach_is_refused_at_the_first_point_outside() {
    // The stretched arm reaches 1.8 m. Steps of 1 cm from 1.505 m: point 30 is at 1.795 m, and
    // point 31 the first outside, by 5 mm.
    let path: Vec<_> = (0..40).map(|i| outwards(1.505 + 0.01 * f64::from(i), 0.3)).collect();
    let options = FollowOptions::default();
    let error = follow(&planar(3.0), &path, 0.1, &options, &mut rng(1)).unwrap_err();
    let FollowError::Unreachable { point, points, time_secs, position_error_m, .. } = error else {
        panic!("{error}");
    };
    assert_eq!((point, points), (31, 40));
    assert!((time_secs - 3.1).abs() < 1e-9);
    assert!((position_error_m - 0.005).abs() < 1e-4, "{position_error_m}");
    assert_eq!(error.to_string(), "point 31 of 40 (t = 3.1 s) is 0.5 cm out of reach of tip");
}

#[test]
fn a_pose_that_only_a_limit_forbids_names_the_joint_and_the_limit() {
    // Round the base with the arm stretched as far as the wrist allows: the shoulder turns with it.
    let path: Vec<_> = (0..40).map(|i| outwards(1.7999, 0.05 * f64::from(i))).collect();
    let error =
        follow(&planar(1.5), &path, 0.1, &FollowOptions::default(), &mut rng(1)).unwrap_err();
    let FollowError::JointLimit { ref joint, limit, excess_rad, point, .. } = error else {
        panic!("{error}");
    };
    // The elbow gives the shoulder a little room.
    assert_eq!((joint.as_str(), limit), ("shoulder", 1.5));
    assert!((31..=33).contains(&point) && excess_rad < 0.06, "{error}");
}

#[test]
fn a_change_of_branch_is_refused_though_every_pose_is_in_reach() {
    // At a distance of 1.2 m to the wrist, the shoulder stands 29 degrees to either side of it.
    // With a shoulder of +-40 degrees only one side serves the first pose and only the other the
    // last; in the middle both do.
    let chain = planar(40f64.to_radians());
    let path: Vec<_> =
        (0..60).map(|i| outwards(1.4, (-30.0 + f64::from(i)).to_radians())).collect();
    let mut lone = rng(1);
    for pose in &path {
        solve(&chain, pose, &[0.0; 3], &InverseOptions::default(), &mut lone).unwrap();
    }
    for step_secs in [0.05, 0.5, 5.0] {
        let error = follow(&chain, &path, step_secs, &FollowOptions::default(), &mut rng(1));
        assert!(
            matches!(error, Err(FollowError::JointLimit { .. } | FollowError::JointJump { .. })),
            "{error:?}"
        );
    }
}

#[test]
fn two_poses_with_an_unreachable_way_between_them_are_a_jump_however_slow() {
    // Past the base at a tenth of a metre, where no tip comes.
    let path = [outwards(0.9, 0.0), outwards(0.9, 2.9)];
    let error =
        follow(&planar(3.0), &path, 60.0, &FollowOptions::default(), &mut rng(1)).unwrap_err();
    assert!(matches!(error, FollowError::JointJump { point: 2, points: 2, .. }), "{error}");
}

#[test]
fn a_motion_that_is_only_too_fast_is_followed_up_to_the_largest_slowdown() {
    let chain = planar(3.0);
    let options = FollowOptions::default();
    // The shoulder's limit is 1 rad/s, so 0.1 rad in each step of 0.1 s.
    let turn = |step_rad: f64| -> Vec<_> {
        (0..20).map(|i| outwards(1.79, step_rad * f64::from(i))).collect()
    };
    let fast = turn(0.25);
    let start = Some(chain.middle());
    let options = FollowOptions { start, ..options };
    let followed = follow(&chain, &turn(0.1), 0.1, &options, &mut rng(1)).unwrap();
    assert!(followed.speed < 1.05, "{}", followed.speed);
    let fast = &fast[..10];
    let followed = follow(&chain, fast, 0.1, &options, &mut rng(1)).unwrap();
    assert_follows(&chain, fast, 0.1, &options, &followed);
    assert!((followed.speed - 2.5).abs() < 0.1, "{}", followed.speed);
    let timed = time(&chain, &followed.positions, 0.1, Scales::default()).unwrap();
    assert!(timed.slowdown >= 2.4, "{}", timed.slowdown);

    let error = follow(&chain, fast, 0.025, &options, &mut rng(1)).unwrap_err();
    assert!(matches!(error, FollowError::JointJump { point: 2, .. }), "{error}");
}

#[test]
fn every_kind_of_joint_is_followed() {
    let xml = include_str!("fixtures/odd_arm.urdf");
    let chain = urdf::chain(xml, "world", "tool").unwrap();
    let q = |i: f64| vec![0.5 + 0.08 * i, 0.1 + 0.004 * i, -0.5 + 0.01 * i, 0.7 - 0.02 * i];
    // More than a full turn of the continuous joint.
    let path: Vec<_> = (0..100).map(|i| chain.forward(&q(f64::from(i) * 0.7))).collect();
    let options = FollowOptions { start: Some(q(0.0)), ..Default::default() };
    let followed = follow(&chain, &path, 0.1, &options, &mut rng(1)).unwrap();
    assert_follows(&chain, &path, 0.1, &options, &followed);
    for (a, b) in followed.positions[99].iter().zip(q(99.0 * 0.7)) {
        assert!((a - b).abs() < 1e-3);
    }
}

#[test]
fn input_that_cannot_be_followed_is_named() {
    let chain = planar(3.0);
    let fine = vec![outwards(1.5, 0.0); 3];
    let refusal = |path: &[Isometry3<f64>], step_secs: f64, start: Option<Vec<f64>>| {
        let options = FollowOptions { start, ..Default::default() };
        follow(&chain, path, step_secs, &options, &mut rng(1)).unwrap_err().to_string()
    };
    assert!(refusal(&[], 0.1, None).contains("no points"));
    for step_secs in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(refusal(&fine, step_secs, None).starts_with("the time step"));
    }
    let mut broken = fine.clone();
    broken[1].translation.vector.y = f64::NAN;
    assert!(refusal(&broken, 0.1, None).starts_with("pose 2"));
    assert!(refusal(&fine, 0.1, Some(vec![0.0; 2])).contains("2 joint positions"));
    let start = Some(vec![0.0, f64::NAN, 0.0]);
    assert!(refusal(&fine, 0.1, start).starts_with("the start of elbow"));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    #[test]
    fn no_path_however_wild_panics_or_breaks_a_promise(
        poses in prop::collection::vec(
            ((-1e3..1e3f64, -2.0..2.0f64, -2.0..2.0f64), (-4.0..4.0f64, -4.0..4.0f64, -4.0..4.0f64)),
            1..6,
        ),
        scale in prop::sample::select(vec![1e-6, 1e-3, 1.0, 1e200]),
        step_secs in prop::sample::select(vec![1e-9, 0.05, 1.0, 1e9]),
    ) {
        let chain = baxter();
        let path: Vec<_> = poses
            .iter()
            .map(|&((x, y, z), (a, b, c))| {
                let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(a, b, c));
                Isometry3::from_parts((scale * Vector3::new(x, y, z)).into(), rotation)
            })
            .collect();
        let options = FollowOptions { starts: 8, ..Default::default() };
        if let Ok(followed) = follow(&chain, &path, step_secs, &options, &mut rng(1)) {
            assert_follows(&chain, &path, step_secs, &options, &followed);
        }
        // And an arm whose axes don't reach every direction.
        let flat = planar(1.0);
        let turned = Unit::new_normalize(Vector3::new(1.0, 2.0, 3.0));
        let path = [outwards(1.0, 0.1), path[0] * UnitQuaternion::from_axis_angle(&turned, 0.3)];
        let _ = follow(&flat, &path, step_secs, &options, &mut rng(1));
    }
}
