//! The rules of the server, on a primitive whose motions are known by construction.
#![expect(clippy::unwrap_used, reason = "a test that panics says where")]

use std::sync::Arc;

use nalgebra::{Isometry3, Matrix3, Rotation3, UnitQuaternion, Vector3};
use proptest::prelude::*;
use rand::rngs::ChaCha8Rng;
use rand::{Rng, RngExt, SeedableRng};
use tcvae::demonstrations::Demonstration;
use tcvae::demonstrations::TaskConfig;
use tcvae::demonstrations::manipulation::ManipulationTask;
use tcvae::demonstrations::pouring;
use tcvae::kinematics::{Chain, RobotRecord};
use tcvae::parameters::{
    Interval, MannerParameters, MannerSpace, TaskLocation, TaskParameters, TaskSpace,
};
use tcvae::pose::StateFrame;
use tcvae::primitive::{Generated, MannerConditioned, MovementPrimitive};
use tcvae::primitives::{Classical, ClassicalConfig, DmpConfig, ProMpConfig, TpGmmConfig};
use tcvae::serving::{
    ErrorCode, Familiarity, GivenLocation, MannerMode, OutOfDistribution, PrimitiveServer, RankBy,
    Sample, SampleReply, SampleRequest, ServedModel, Settings, StartPolicy,
};
use tcvae::trajectory::{JointTrajectory, Trajectory};

const STEPS: usize = 100;

/// A pour along minimum-jerk ramps: `h1` raises the highest tilt by 8 degrees per unit, `h2` lifts
/// the cup higher by 2 cm per unit.
#[derive(Debug)]
struct RollPour {
    space: TaskSpace,
    manner: MannerSpace,
    frame: StateFrame,
    /// What the pour misses its location by, in y (m).
    offset_m: f64,
}

fn ramp(phase: f64, from: f64, to: f64) -> f64 {
    let s = ((phase - from) / (to - from)).clamp(0.0, 1.0);
    s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)
}

/// The gripper points ahead with the cup's axis, the tip's x, upwards.
fn grasp_orientation() -> UnitQuaternion<f64> {
    let columns = Matrix3::from_columns(&[Vector3::z(), -Vector3::y(), Vector3::x()]);
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(columns))
}

impl MovementPrimitive for RollPour {
    fn task_space(&self) -> &TaskSpace {
        &self.space
    }
    fn steps(&self) -> usize {
        STEPS
    }
    fn state_dim(&self) -> usize {
        6
    }
    fn generate(&self, w: &TaskParameters) -> Generated {
        self.decode(w, &MannerParameters::mean(&self.manner))
    }
}

impl MannerConditioned for RollPour {
    fn manner_space(&self) -> &MannerSpace {
        &self.manner
    }
    fn decode(&self, w: &TaskParameters, h: &MannerParameters) -> Generated {
        let (pour, source, h) = (w.location(0), w.location(1), h.values());
        let pose = |t: usize| {
            let phase = t as f64 / (STEPS - 1) as f64;
            let moved = ramp(phase, 0.1, 0.5);
            let x = source[0] + moved * (pour[0] - source[0]);
            let y = source[1] + moved * (pour[1] + self.offset_m - source[1]);
            let z = -0.05 + (0.15 + 0.02 * h[1]) * ramp(phase, 0.05, 0.35);
            let tilt = (92.0 + 8.0 * h[0]) * (ramp(phase, 0.45, 0.7) - ramp(phase, 0.75, 1.0));
            let roll = UnitQuaternion::from_scaled_axis(Vector3::x() * tilt.to_radians());
            Isometry3::from_parts(Vector3::new(x, y, z).into(), roll * grasp_orientation())
        };
        let mean = self.frame.trajectory(&(0..STEPS).map(pose).collect::<Vec<_>>());
        let stddev = Trajectory::new(6, vec![0.003; 6 * STEPS]).unwrap();
        Generated { mean, stddev, duration_secs: None }
    }
    fn sample_manner(&self, rng: &mut dyn Rng) -> MannerParameters {
        let values = (0..2).map(|_| rng.random_range(-1.0..1.0)).collect();
        MannerParameters::new(&self.manner, values).unwrap()
    }
}

fn baxter() -> Chain {
    tcvae::urdf::chain(include_str!("../config/baxter.urdf"), "base", "left_gripper").unwrap()
}

/// A model whose pours miss their location by `offset_m`.
fn model(offset_m: f64) -> ServedModel {
    let location = |name: &str, y: [f64; 2]| TaskLocation {
        name: name.into(),
        x: Interval { lower: 0.5, upper: 0.8 },
        y: Interval { lower: y[0], upper: y[1] },
    };
    let locations = vec![location("pour_location", [0.1, 0.5]), location("source_cup", [0.0, 0.3])];
    let task = pouring::task();
    let primitive = RollPour {
        space: TaskSpace::new("m", locations).unwrap(),
        manner: MannerSpace::unnamed(2, 3.0),
        frame: task.state_frame(),
        offset_m,
    };
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let intervals = primitive.space.intervals();
    let mut draw = |_| intervals.iter().map(|i| rng.random_range(i.lower..i.upper)).collect();
    let familiarity = Familiarity::new((0..500).map(&mut draw).collect(), &primitive);
    ServedModel {
        model_id: "0123456789ab".into(),
        method: "TC-VAE".into(),
        frame: task.state_frame(),
        primitive: Box::new(primitive),
        task: Box::new(task),
        duration_secs: 8.0,
        robot: RobotRecord::new("baxter", &baxter(), String::new()),
        evaluation_json: "null".into(),
        synthetic_data: true,
        mirrored: false,
        familiarity,
    }
}

fn serving(model: ServedModel) -> PrimitiveServer {
    let robot = tcvae::config::robot(None, tcvae::urdf::arm).unwrap().served();
    PrimitiveServer::new(Arc::new(model), Arc::new(robot), Settings::default()).unwrap()
}

fn server() -> PrimitiveServer {
    serving(model(0.0))
}

fn location(name: &str, x: f64, y: f64) -> GivenLocation {
    GivenLocation { name: name.into(), xy: [x, y] }
}

/// A request to pour at `(x, y)`, from a cup amid the trained region.
fn pour_at(x: f64, y: f64) -> SampleRequest {
    let task = vec![location("pour_location", x, y), location("source_cup", 0.6, 0.1)];
    SampleRequest { task, ..SampleRequest::default() }
}

fn request() -> SampleRequest {
    pour_at(0.65, 0.3)
}

fn one(server: &PrimitiveServer, request: &SampleRequest) -> Sample {
    let mut reply = server.sample(request, 0.0);
    assert_eq!(reply.refusal, None);
    assert_eq!(reply.samples.len(), 1);
    reply.samples.remove(0)
}

/// The code and the message of a request that is not served, which must have served nothing.
fn refusal(server: &PrimitiveServer, request: &SampleRequest) -> (ErrorCode, String) {
    let reply = server.sample(request, 0.0);
    assert!(reply.samples.is_empty());
    let refusal = reply.refusal.expect("a refusal");
    (refusal.code, refusal.message)
}

/// Checks what joint_trajectory_controller checks, and the limits, which it does not.
fn check_controller_rules(trajectory: &JointTrajectory, chain: &Chain, velocity_scale: f64) {
    assert_eq!(trajectory.joint_names, chain.joint_names());
    assert!(trajectory.times_secs[0] > 0.0);
    assert!(trajectory.times_secs.windows(2).all(|w| w[1] > w[0]));
    assert!(trajectory.velocities.last().unwrap().iter().all(|v| *v == 0.0));
    for (i, (q, v)) in trajectory.positions.iter().zip(&trajectory.velocities).enumerate() {
        assert!(chain.within_limits(q), "point {i}");
        for (j, joint) in chain.joints().iter().enumerate() {
            let limit = velocity_scale * joint.velocity * (1.0 + 1e-9);
            assert!(v[j].abs() <= limit, "point {i}, {}: {}", joint.name, v[j]);
            if i > 0 {
                let step = trajectory.times_secs[i] - trajectory.times_secs[i - 1];
                let moved = (q[j] - trajectory.positions[i - 1][j]).abs();
                assert!(moved <= limit * step, "point {i}, {}: {moved} in {step} s", joint.name);
            }
        }
    }
}

fn root(file: &str) -> std::path::PathBuf {
    std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(file)
}

fn right_arm() -> tcvae::config::LoadedRobot {
    let file = root("config/robots/baxter-right.toml");
    tcvae::config::robot(Some(&file), tcvae::urdf::arm).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(20))]
    #[test]
    fn a_mirrored_request_is_the_mirrored_motion_of_the_other_arm(
        x in 0.6..0.7f64, y in 0.2..0.4f64, manner in proptest::array::uniform2(-1.0..1.0f64)
    ) {
        let names = || vec!["h1".to_owned(), "h2".to_owned()];
        let asked = |side: f64| SampleRequest {
            manner_names: names(),
            manner_values: manner.to_vec(),
            task: pour_at(x, y).task.into_iter().map(|l| GivenLocation { xy: [l.xy[0], side * l.xy[1]], ..l }).collect(),
            ..SampleRequest::default()
        };
        let robot = Arc::new(right_arm().served());
        let right = PrimitiveServer::new(Arc::new(model(0.0)), robot, Settings::default()).unwrap();
        prop_assert!(right.model().mirrored && right.describe().mirrored);
        let [shown, mirror] = [one(&server(), &asked(1.0)), one(&right, &asked(-1.0))];
        check_controller_rules(&mirror.joint_trajectory, &right.robot().chain, 1.0);
        prop_assert_eq!(&mirror.manner_values, &shown.manner_values);
        prop_assert!((mirror.slowdown - 1.0).abs() < 1e-9 && (shown.slowdown - 1.0).abs() < 1e-9);
        let poses = |s: &Sample| s.end_effector_trajectory.base_from_tip.clone();
        for (a, b) in poses(&shown).iter().zip(poses(&mirror)) {
            let a = tcvae::pose::mirrored(a);
            // Each follows its own path as well as the inverse kinematics does.
            prop_assert!((a.translation.vector - b.translation.vector).norm() < 1e-3);
            prop_assert!(a.rotation.angle_to(&b.rotation) < 1e-2);
        }
    }
}

#[test]
fn an_arm_that_is_no_mirror_image_serves_no_model_of_the_other() {
    let refused = |change: fn(&mut tcvae::serving::Robot, &mut ServedModel)| {
        let (mut robot, mut model) = (right_arm().served(), model(0.0));
        change(&mut robot, &mut model);
        let server = PrimitiveServer::new(Arc::new(model), Arc::new(robot), Settings::default());
        server.unwrap_err()
    };
    let nobody_says_so = refused(|robot, _| robot.mirrors = None);
    let other_signs = refused(|robot, _| {
        if let Some(other) = &mut robot.mirrors {
            other.signs[2] = 1.0;
        }
    });
    let one_sided = refused(|_, model| {
        let symmetry = tcvae::demonstrations::manipulation::Symmetry::None;
        model.task = Box::new(ManipulationTask { symmetry, ..pouring::task() });
    });
    for refusal in [nobody_says_so, other_signs, one_sided] {
        assert_eq!(refusal.code, ErrorCode::RobotMismatch, "{refusal}");
    }
}

#[test]
fn the_task_of_the_right_arm_is_the_mirror_image_of_the_left_ones() {
    let task = tcvae::config::task(&root("config/tasks/pour-right.toml")).unwrap();
    assert_eq!(task, TaskConfig::Manipulation(pouring::task().mirrored().unwrap()));
}

#[test]
fn a_sample_meets_its_task_and_the_rules_of_a_controller() {
    let server = server();
    let sample = one(&server, &request());
    let chain = &server.robot().chain;
    check_controller_rules(&sample.joint_trajectory, chain, 1.0);
    assert_eq!(sample.joint_trajectory.positions.len(), STEPS);
    assert!(sample.task_error < 0.005, "{}", sample.task_error);
    assert!(sample.joint_margin >= 0.0 && sample.slowdown >= 1.0);
    assert_eq!(sample.position_stddev.len(), STEPS);
    let poses = &sample.end_effector_trajectory.base_from_tip;
    for (q, pose) in sample.joint_trajectory.positions.iter().zip(poses) {
        assert!((chain.forward(q).translation.vector - pose.translation.vector).norm() < 1e-9);
    }
}

#[test]
fn a_manner_knob_changes_the_motion_and_not_the_pour() {
    let mut server = server();
    let plain = one(&server, &request());
    server.set_manner(&["h2".into()], &[1.5], false).unwrap();
    let lifted = one(&server, &request());
    let height = |s: &Sample| s.end_effector_trajectory.base_from_tip[60].translation.z;
    assert!((height(&lifted) - height(&plain) - 0.03).abs() < 0.002);
    assert!(lifted.task_error < 0.005);
    assert_eq!(lifted.manner_values, [0.0, 1.5]);
}

#[test]
fn a_miss_that_aiming_can_mend_is_mended_and_said() {
    let sample = one(&serving(model(0.03)), &request());
    assert!(sample.task_error < 0.002, "{}", sample.task_error);
    assert!(sample.warnings.iter().any(|w| w.contains("0.030 m beside")), "{:?}", sample.warnings);
}

#[test]
fn a_request_twice_gives_the_same_motion_and_its_seed_gives_it_again() {
    let server = server();
    let drawn = SampleRequest { sample_manner: true, count: 3, seed: 5, ..request() };
    let (a, b) = (server.sample(&drawn, 0.0).samples, server.sample(&drawn, 0.0).samples);
    assert_eq!(a.len(), 3);
    for (a, b) in a.iter().zip(&b) {
        assert!(a.joint_trajectory == b.joint_trajectory);
    }
    assert_ne!(a[0].manner_values, a[1].manner_values);
    let again = one(&server, &SampleRequest { count: 1, seed: a[2].seed, ..drawn });
    assert!(again.joint_trajectory == a[2].joint_trajectory);
}

#[test]
fn the_nodes_own_seed_goes_on_from_request_to_request_and_starts_again_when_set() {
    let mut server = server();
    let drawn = SampleRequest { sample_manner: true, ..request() };
    let first = one(&server, &drawn);
    assert_ne!(one(&server, &drawn).manner_values, first.manner_values);
    server.set_settings(Settings { seed: 9, ..Settings::default() }).unwrap();
    server.set_settings(Settings::default()).unwrap();
    assert_eq!(one(&server, &drawn).manner_values, first.manner_values);
}

#[test]
fn the_latest_locations_serve_a_request_without_its_own() {
    let mut server = server();
    let latest = SampleRequest::default();
    let (code, message) = refusal(&server, &latest);
    assert_eq!(code, ErrorCode::NoTask);
    assert!(message.contains("no pour_location so far"), "{message}");
    server.set_location("pour_location", [0.65, 0.3], 1.0).unwrap();
    let (code, message) = refusal(&server, &latest);
    assert_eq!(code, ErrorCode::NoTask);
    assert!(message.contains("no source_cup so far"), "{message}");
    server.set_default_location("source_cup", Some([0.6, 0.1])).unwrap();
    one(&server, &latest);
}

#[test]
fn an_old_task_is_refused_with_its_age() {
    let mut server = server();
    server.set_settings(Settings { max_age_secs: 5.0, ..Settings::default() }).unwrap();
    server.set_location("pour_location", [0.65, 0.3], 1.0).unwrap();
    server.set_location("source_cup", [0.6, 0.1], 4.0).unwrap();
    assert_eq!(server.sample(&SampleRequest::default(), 5.9).refusal, None);
    let refusal = server.sample(&SampleRequest::default(), 6.5).refusal.unwrap();
    assert_eq!(refusal.code, ErrorCode::StaleTask);
    assert!(refusal.message.contains("5.5 s old"), "{}", refusal.message);
}

#[test]
fn a_task_outside_the_trained_region_is_refused_unless_that_is_allowed() {
    let mut server = server();
    let outside = pour_at(0.65, 0.52);
    let (code, message) = refusal(&server, &outside);
    assert_eq!(code, ErrorCode::OutOfDistribution);
    assert!(message.contains("pour_location.y = 0.520 m"), "{message}");
    let allowed = SampleRequest { allow_out_of_distribution: true, ..outside.clone() };
    let warnings = one(&server, &allowed).warnings;
    assert!(warnings.iter().any(|w| w.contains("outside the trained region")), "{warnings:?}");
    let out_of_distribution = OutOfDistribution::Warn;
    server.set_settings(Settings { out_of_distribution, ..Settings::default() }).unwrap();
    one(&server, &outside);
}

#[test]
fn a_pour_out_of_reach_is_refused_with_the_first_point_and_what_to_move() {
    let request = SampleRequest { allow_out_of_distribution: true, ..pour_at(1.9, 0.3) };
    let (code, message) = refusal(&server(), &request);
    assert_eq!(code, ErrorCode::Unreachable, "{message}");
    assert!(message.contains("of 100") && message.contains("move pour_location"), "{message}");
}

#[test]
fn requests_that_make_no_sense_are_refused_by_name_and_number() {
    let server = server();
    let manner = |names: &[&str], values: &[f64]| SampleRequest {
        manner_names: names.iter().map(ToString::to_string).collect(),
        manner_values: values.to_vec(),
        ..request()
    };
    let task = |name: &str, x: f64| SampleRequest {
        task: vec![location(name, x, 0.3)],
        ..SampleRequest::default()
    };
    let start = vec![("left_s0".into(), 0.0)];
    let cases = [
        (SampleRequest { count: 1_000_000, ..request() }, ErrorCode::BadRequest, "at most 64"),
        (manner(&["h1"], &[]), ErrorCode::BadRequest, "1 manner names and 0 values"),
        (manner(&["h1", "h1"], &[0.0, 1.0]), ErrorCode::BadRequest, "given twice"),
        (manner(&["speed"], &[0.0]), ErrorCode::MannerUnknown, "known are: h1, h2"),
        (manner(&["h1"], &[3.5]), ErrorCode::MannerRange, "h1 = 3.5 is outside [-3, 3]"),
        (manner(&["h1"], &[f64::NAN]), ErrorCode::NotFinite, "h1 is NaN"),
        (task("cup", 0.6), ErrorCode::TaskUnknown, "it has pour_location, source_cup"),
        (task("pour_location", f64::INFINITY), ErrorCode::NotFinite, "(inf, 0.3)"),
        (SampleRequest { rate_hz: 1e6, ..request() }, ErrorCode::BadRequest, "rate_hz"),
        (SampleRequest { rate_hz: f64::NAN, ..request() }, ErrorCode::NotFinite, "rate_hz"),
        (SampleRequest { velocity_scale: 2.0, ..request() }, ErrorCode::BadRequest, "[0.01, 1]"),
        (SampleRequest { velocity_scale: -0.5, ..request() }, ErrorCode::BadRequest, "[0.01, 1]"),
        (SampleRequest { start, ..request() }, ErrorCode::BadRequest, "left_s1"),
    ];
    for (request, code, text) in cases {
        let (found, message) = refusal(&server, &request);
        assert_eq!(found, code, "{message}");
        assert!(message.contains(text), "{text:?} is not in {message:?}");
    }
}

/// A request that says where the arm is.
fn starting_at(server: &PrimitiveServer, q: &[f64]) -> SampleRequest {
    let names = server.robot().chain.joint_names();
    SampleRequest { start: names.into_iter().zip(q.iter().copied()).collect(), ..request() }
}

#[test]
fn by_the_policy_refuse_the_arm_has_to_be_at_the_first_point() {
    let mut server = server();
    let start_policy = StartPolicy::Refuse;
    server.set_settings(Settings { start_policy, ..Settings::default() }).unwrap();
    let (code, message) = refusal(&server, &request());
    assert_eq!(code, ErrorCode::StaleJointState, "{message}");
    let middle = server.robot().chain.middle();
    let (code, message) = refusal(&server, &starting_at(&server, &middle));
    assert_eq!(code, ErrorCode::StartTooFar, "{message}");
    server.set_settings(Settings::default()).unwrap();
    let first = one(&server, &request()).joint_trajectory.positions[0].clone();
    server.set_settings(Settings { start_policy, ..Settings::default() }).unwrap();
    assert_eq!(one(&server, &starting_at(&server, &first)).primitive_start_index, 0);
}

#[test]
fn an_arm_elsewhere_is_brought_to_the_first_point() {
    let mut server = server();
    let chain = server.robot().chain.clone();
    let there = one(&server, &request());
    assert!(there.warnings.iter().any(|w| w.contains("no joint states")), "{:?}", there.warnings);
    // Near to where the motion begins, so that it goes on in the same posture.
    let mut q = there.joint_trajectory.positions[0].clone();
    q.iter_mut().zip(chain.middle()).for_each(|(q, middle)| *q += 0.2 * (middle - *q));
    let sample = one(&server, &starting_at(&server, &q));
    let begin = sample.primitive_start_index as usize;
    assert!(begin >= 7, "{begin}");
    let trajectory = &sample.joint_trajectory;
    check_controller_rules(trajectory, &chain, 1.0);
    let at_rest = vec![0.0; chain.dof()];
    assert_eq!(
        (&trajectory.velocities[begin], &trajectory.accelerations[begin]),
        (&at_rest, &at_rest)
    );
    assert_eq!(trajectory.positions.len(), begin + there.joint_trajectory.positions.len());
    assert_eq!(sample.position_stddev.len(), trajectory.positions.len());
    let poses = &sample.end_effector_trajectory.base_from_tip;
    assert_eq!(poses.len(), trajectory.positions.len());
    for (q, pose) in trajectory.positions.iter().zip(poses) {
        assert!((chain.forward(q).to_homogeneous() - pose.to_homogeneous()).norm() < 1e-9);
    }
    // The steps of the primitive are its own, and equal; the approach begins where the arm is.
    let times = &trajectory.times_secs;
    let step = times[begin + 1] - times[begin];
    assert!(times[begin..].windows(2).all(|t| (t[1] - t[0] - step).abs() < 1e-9));
    let first = &trajectory.positions[0];
    assert!(first.iter().zip(&q).all(|(a, b)| (a - b).abs() < 0.05), "{first:?} after {q:?}");

    // An arm that stands a bit outside a limit is pulled inside; further out it is left to a person.
    let upper = chain.joints()[1].upper;
    let beyond = |by: f64| {
        let mut q = q.clone();
        q[1] = upper + by;
        starting_at(&server, &q)
    };
    check_controller_rules(&one(&server, &beyond(0.04)).joint_trajectory, &chain, 1.0);
    let (code, message) = refusal(&server, &beyond(0.06));
    assert_eq!(code, ErrorCode::JointLimit, "{message}");
    assert!(message.starts_with("left_s1 stands at 1.107 rad, 0.060 rad beyond"), "{message}");

    // What /joint_states say counts likewise, for as long as it is fresh.
    let names = chain.joint_names();
    let (some, rest) = names.split_at(3);
    let named = |names: &[String], from: usize| -> Vec<(String, f64)> {
        names.iter().cloned().zip(q[from..].iter().copied()).collect()
    };
    for (part, at_secs) in [(named(some, 0), 1.0), (named(rest, 3), 1.5)] {
        server.set_joint_state(part.iter().map(|(name, q)| (name.as_str(), *q)), at_secs);
    }
    server.set_joint_state([("left_s0", f64::NAN), ("right_s0", 1.0)].into_iter(), 1.9);
    let at = |now_secs: f64| {
        let reply = server.sample(&request(), now_secs);
        assert_eq!(reply.refusal, None);
        reply.samples[0].clone()
    };
    assert_eq!(at(1.9).joint_trajectory, sample.joint_trajectory);
    let late = at(2.1);
    assert_eq!(late.primitive_start_index, 0);
    assert!(late.warnings.iter().any(|w| w.contains("1.1 s old")), "{:?}", late.warnings);
}

#[test]
fn what_the_arm_keeps_off_is_told_and_so_is_what_nobody_knows() {
    let mut robot = tcvae::config::robot(None, tcvae::urdf::arm).unwrap().served();
    let told = "12 shapes, 0.01 m off each other; a table at z = -0.22 m; no shape of right_upper_shoulder, \
                right_lower_shoulder, right_upper_elbow, right_lower_elbow and 4 more";
    assert_eq!(robot.clearance(), told);
    robot.unmodelled.clear();
    robot.hull = robot.hull.with_table(None);
    assert_eq!(robot.clearance(), "12 shapes, 0.01 m off each other; no table");
    robot.hull = tcvae::kinematics::Hull::default();
    assert_eq!(robot.clearance(), "no shapes, so that nothing keeps it off itself or a table");
}

#[test]
fn an_arm_that_would_touch_the_table_goes_another_way_or_not_at_all() {
    let mut server = server();
    let free = one(&server, &request());
    assert!(free.min_clearance >= 0.01, "{}", free.min_clearance);
    // The table up to just below the hand: the motion stays clear of it or is refused.
    let lowest = free.end_effector_trajectory.base_from_tip.iter().map(|p| p.translation.z);
    let lowest = lowest.fold(f64::INFINITY, f64::min);
    server.set_surroundings(Some(lowest - 0.02), 0.01).unwrap();
    let (code, message) = refusal(&server, &request());
    assert_eq!(code, ErrorCode::Collision, "{message}");
    assert!(message.contains("and the table"), "{message}");
    assert!(server.set_surroundings(Some(f64::NAN), 0.01).is_err());
    assert!(server.set_surroundings(None, -0.01).is_err());
    server.set_surroundings(None, 0.0).unwrap();
    assert_eq!(one(&server, &request()).joint_trajectory, free.joint_trajectory);
}

#[test]
fn a_smaller_scale_slows_the_motion_down_by_one_factor_and_moves_nothing() {
    let server = server();
    let fast = one(&server, &request());
    let slow = one(&server, &SampleRequest { velocity_scale: 0.1, ..request() });
    check_controller_rules(&slow.joint_trajectory, &server.robot().chain, 0.1);
    assert!(slow.slowdown > fast.slowdown);
    assert_eq!(slow.joint_trajectory.positions, fast.joint_trajectory.positions);
    let ratio = slow.slowdown / fast.slowdown;
    for (s, f) in slow.joint_trajectory.times_secs.iter().zip(&fast.joint_trajectory.times_secs) {
        assert!((s / f - ratio).abs() < 1e-9);
    }
}

#[test]
fn a_speed_makes_the_motion_faster_or_slower_and_moves_nothing() {
    let server = server();
    let learned = one(&server, &request());
    for speed in [0.5, 1.2] {
        let sample = one(&server, &SampleRequest { speed, ..request() });
        check_controller_rules(&sample.joint_trajectory, &server.robot().chain, 1.0);
        assert_eq!(sample.slowdown, 1.0);
        assert_eq!(sample.joint_trajectory.positions, learned.joint_trajectory.positions);
        let times = sample.joint_trajectory.times_secs.iter();
        for (s, l) in times.zip(&learned.joint_trajectory.times_secs) {
            assert!((l / s - speed).abs() < 1e-9);
        }
    }
    let mut set = server.clone();
    set.set_settings(Settings { speed: 0.5, ..Settings::default() }).unwrap();
    let slow = one(&server, &SampleRequest { speed: 0.5, ..request() });
    assert_eq!(one(&set, &request()).joint_trajectory, slow.joint_trajectory);
}

#[test]
fn a_motion_that_limits_hold_back_is_as_fast_as_they_allow() {
    let server = server();
    let request = SampleRequest { speed: 1.2, velocity_scale: 0.2, ..request() };
    let sample = one(&server, &request);
    check_controller_rules(&sample.joint_trajectory, &server.robot().chain, 0.2);
    let alone = one(&server, &SampleRequest { speed: 1.0, ..request });
    // The same motion in the end, told in other factors.
    assert!((sample.slowdown / alone.slowdown - 1.2).abs() < 1e-9, "{}", sample.slowdown);
}

#[test]
fn a_speed_beyond_what_the_task_allows_is_refused() {
    let (code, message) = refusal(&server(), &SampleRequest { speed: 4.0, ..request() });
    assert_eq!(code, ErrorCode::InvalidMotion);
    assert!(message.contains("max_turn_deg_per_s"), "{message}");
    let (code, message) = refusal(&server(), &SampleRequest { speed: 5.0, ..request() });
    assert_eq!(code, ErrorCode::BadRequest);
    assert!(message.contains("[0.1, 4]"), "{message}");
}

#[test]
fn a_rate_gives_that_many_points_per_second_of_the_motion_as_executed() {
    let server = server();
    let sample = one(&server, &SampleRequest { rate_hz: 50.0, ..request() });
    let times = &sample.joint_trajectory.times_secs;
    let step = (times[times.len() - 1] - times[0]) / (times.len() - 1) as f64;
    assert!((1.0 / step - 50.0).abs() < 1.0, "{step}");
    check_controller_rules(&sample.joint_trajectory, &server.robot().chain, 1.0);
}

#[test]
fn when_no_draw_passes_the_nearest_is_told() {
    let mut server = server();
    let manner_mode = MannerMode::Prior;
    let settings = Settings { max_tries: 3, manner_mode, ..Settings::default() };
    server.set_settings(settings).unwrap();
    let request = SampleRequest { allow_out_of_distribution: true, ..pour_at(1.9, 0.3) };
    let (code, message) = refusal(&server, &request);
    assert_eq!(code, ErrorCode::Unreachable, "{message}");
    assert!(message.starts_with("none of 3 draws passed"), "{message}");
}

#[test]
fn a_mean_that_fails_is_drawn_anew_but_what_is_set_stays() {
    // The mean lifts the cup by 15 cm; this task wants 16 cm, and h2 lifts by 2 cm a unit.
    let mut strict = model(0.0);
    let mut task = pouring::task();
    task.validity.lift_m.as_mut().unwrap().lower = 0.16;
    strict.task = Box::new(task);
    let mut server = serving(strict);
    let sample = one(&server, &request());
    assert!(sample.tries > 1 && sample.manner_values[1] > 0.0, "{:?}", sample.manner_values);
    assert!(sample.warnings.iter().any(|w| w.contains("lift_m")), "{:?}", sample.warnings);

    server.set_manner(&["h2".into()], &[0.0], false).unwrap();
    let (code, message) = refusal(&server, &request());
    assert_eq!(code, ErrorCode::InvalidMotion, "{message}");
    server.set_manner(&[], &[], true).unwrap();
    one(&server, &request());
    let both = SampleRequest {
        manner_names: vec!["h1".into(), "h2".into()],
        manner_values: vec![0.0, 0.0],
        ..request()
    };
    let (_, message) = refusal(&server, &both);
    assert!(message.starts_with("the motion is not a valid one"), "{message}");
}

#[test]
fn samples_are_ranked_by_what_is_asked_for() {
    let server = server();
    let drawn = SampleRequest { sample_manner: true, count: 6, seed: 3, ..request() };
    let by = |rank_by| server.sample(&SampleRequest { rank_by, ..drawn.clone() }, 0.0).samples;
    assert!(by(RankBy::Margin).windows(2).all(|s| s[0].joint_margin >= s[1].joint_margin));
    let end = |s: &Sample| s.joint_trajectory.times_secs[STEPS - 1];
    assert!(by(RankBy::Duration).windows(2).all(|s| end(&s[0]) <= end(&s[1])));
}

#[test]
fn a_model_for_another_tip_is_refused_and_the_old_one_stays() {
    let mut server = server();
    let mut other = model(0.0);
    other.model_id = "ba9876543210".into();
    for pose in &mut other.robot.base_from_tip {
        pose[2] += 0.002;
    }
    let refusal = server.load_model(Arc::new(other)).unwrap_err();
    assert_eq!(refusal.code, ErrorCode::RobotMismatch);
    assert!(refusal.message.contains("2.00 mm"), "{}", refusal.message);
    assert_eq!(server.model().model_id, "0123456789ab");
}

#[test]
fn loading_a_model_keeps_the_task_and_the_manner_of_the_same_names() {
    let mut server = server();
    server.set_location("source_cup", [0.6, 0.1], 1.0).unwrap();
    server.set_location("pour_location", [0.65, 0.3], 1.0).unwrap();
    server.set_manner(&["h2".into()], &[1.0], false).unwrap();
    server.load_model(Arc::new(model(0.0))).unwrap();
    assert_eq!(server.manner(), [0.0, 1.0]);
    one(&server, &SampleRequest::default());
}

/// Each classical primitive, fitted to pours of the model's own primitive.
fn classical() -> [Classical; 3] {
    let shown = model(0.0).primitive;
    let space = shown.task_space().clone();
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let intervals = space.intervals();
    let demonstration = |n: usize| {
        let w = intervals.iter().map(|i| rng.random_range(i.lower..i.upper)).collect();
        let w = TaskParameters::new(&space, w).unwrap();
        let h = shown.sample_manner(&mut rng);
        let motion = shown.decode(&w, &h).motion(8.0);
        Demonstration { id: n.to_string(), w, motion, events: Vec::new() }
    };
    let demonstrations: Vec<_> = (0..40).map(demonstration).collect();
    [
        ClassicalConfig::TpGmm(TpGmmConfig::default()),
        ClassicalConfig::ProMp(ProMpConfig::default()),
        ClassicalConfig::Dmp(DmpConfig::default()),
    ]
    .map(|config| config.fit(&space, &demonstrations).unwrap())
}

#[test]
fn a_classical_primitive_is_served_with_its_one_motion_and_no_manner() {
    for primitive in classical() {
        let name = primitive.name();
        let mut server = serving(ServedModel { primitive: Box::new(primitive), ..model(0.0) });
        let description = server.describe();
        assert_eq!((description.manner.len(), description.manner_values.len()), (0, 0));

        let asked = SampleRequest { count: 3, sample_manner: true, ..request() };
        let SampleReply { samples, refusal, .. } = server.sample(&asked, 0.0);
        assert_eq!(refusal, None, "{name}");
        for sample in &samples {
            assert_eq!(sample.joint_trajectory, samples[0].joint_trajectory);
            assert_eq!((sample.tries, sample.manner_names.len()), (1, 0));
            assert!(sample.task_error < 0.02, "{name}: {}", sample.task_error);
        }

        let unknown = server.set_manner(&["h1".into()], &[0.0], false).unwrap_err();
        assert_eq!(unknown.code, ErrorCode::MannerUnknown);
        let told = "the primitive has no manner parameters";
        assert!(unknown.message.contains(told), "{}", unknown.message);
        let asked = SampleRequest {
            manner_names: vec!["h1".into()],
            manner_values: vec![0.0],
            ..request()
        };
        assert_eq!(self::refusal(&server, &asked).0, ErrorCode::MannerUnknown);

        // With nothing to draw, what fails once is not tried again.
        let far = SampleRequest { allow_out_of_distribution: true, ..pour_at(2.0, 0.3) };
        let (_, message) = self::refusal(&server, &far);
        assert!(!message.contains("draws passed"), "{name}: {message}");
        // Whatever is asked for, it is answered.
        for x in [1e300, -1e300] {
            let far = SampleRequest { allow_out_of_distribution: true, ..pour_at(x, 0.3) };
            self::refusal(&server, &far);
        }
    }
}

#[test]
fn every_manner_of_a_primitive_without_any_is_as_familiar_as_can_be() {
    let [primitive, ..] = classical();
    let familiarity = Familiarity::new(Vec::new(), &primitive);
    assert_eq!(familiarity.manner(&[]), 1.0);
}
