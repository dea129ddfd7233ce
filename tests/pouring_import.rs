//! What is simulated is imported: every trap is left out for its reason, and every demonstration
//! is found with its truth. The truth is read off the simulator's plan; importing sees only files.

#![expect(clippy::unwrap_used, reason = "in a test a panic is the report")]

use std::collections::BTreeMap;
use std::path::Path;

use tcvae::demonstrations::recording::{Exclusion, Reason, RobotConfig};
use tcvae::demonstrations::simulation::{Simulated, Simulation};
use tcvae::demonstrations::{Demonstration, Task};
use tcvae::demonstrations::{manipulation::Segment, pouring};
use tcvae::kinematics::Chain;
use tcvae::{mime, urdf};

type Import = Result<(Segment, Demonstration), Exclusion>;

fn baxter() -> Chain {
    urdf::chain(include_str!("../config/baxter.urdf"), "base", "left_gripper").unwrap()
}

fn import(folder: &Path, chain: &Chain) -> Import {
    let robot = RobotConfig::default();
    let read = mime::read(folder, &robot.channels())
        .map_err(|e| Exclusion::new(Reason::Unreadable, e.to_string()))?;
    pouring::task().demonstration(&read.recording, &robot, chain)
}

/// Every demonstration of a simulation, and what importing its files gives.
fn round_trip(simulation: &Simulation) -> Vec<(Simulated, Import)> {
    let (chain, robot) = (baxter(), RobotConfig::default());
    let folder = tempfile::tempdir().unwrap();
    let assignments = simulation.assignments(&robot).unwrap();
    let one = |assignment| {
        let simulated = simulation.simulate(assignment, &robot, &chain).unwrap();
        mime::write(folder.path(), &simulated.raw).unwrap();
        let demo = folder.path().join(&assignment.id);
        let imported = import(&demo, &chain);
        std::fs::remove_dir_all(demo).unwrap();
        (simulated, imported)
    };
    assignments.iter().map(one).collect()
}

fn correlation(pairs: &[[f64; 2]]) -> f64 {
    let n = pairs.len() as f64;
    let mean = |i: usize| pairs.iter().map(|p| p[i]).sum::<f64>() / n;
    let means = [mean(0), mean(1)];
    let product = |i: usize, j: usize| {
        pairs.iter().map(|p| (p[i] - means[i]) * (p[j] - means[j])).sum::<f64>()
    };
    product(0, 1) / (product(0, 0) * product(1, 1)).sqrt()
}

#[test]
fn the_full_set_is_imported_as_its_truth_says() {
    let all = round_trip(&Simulation { seed: 20, ..Simulation::default() });

    let mut kinds: BTreeMap<&str, usize> = BTreeMap::new();
    let mut accurate = 0;
    let mut style_error = 0.0;
    let mut pairs = Vec::new();
    for (simulated, imported) in &all {
        let truth = &simulated.truth;
        *kinds.entry(&truth.expected).or_default() += 1;
        let (segment, demonstration) = match imported {
            Ok(found) => found,
            Err(exclusion) => {
                let reason = pouring::task().reason_name(exclusion.reason);
                assert_eq!(reason, truth.expected, "{truth:?} {exclusion}");
                continue;
            }
        };
        assert_eq!("accept", truth.expected, "{truth:?}");
        assert_eq!(segment.arm, truth.arm);
        let near = |value: f64, name: &str, limit: f64| {
            let expected = truth.factors[name];
            assert!((value - expected).abs() < limit, "{name} {value} {expected} {truth:?}");
        };
        near(segment.start_secs, "grasp", 0.1);
        near(segment.action_start_secs - segment.start_secs, "pour_start", 0.1);
        near(segment.action_end_secs - segment.start_secs, "pour_end", 0.1);
        near(segment.end_secs - segment.start_secs, "duration", 0.1);
        let w = demonstration.w.values();
        let off = |i: usize, name: &str| {
            let [x, y] = truth.task[name];
            (w[i] - x).hypot(w[i + 1] - y)
        };
        let factors = pouring::task().factors(&demonstration.motion);
        let style = factors.iter().find(|f| f.name == "style").expect("a factor").value;
        // The hand also turns about the vertical, by up to 14 degrees, which turns the axis a little.
        near(style, "style", 12.0);
        style_error += (style - truth.factors["style"]).abs();
        let error_m = off(0, "pour_location").max(off(2, "source_cup"));
        accurate += usize::from(error_m < 0.005);
        pairs.push([truth.factors["maximum_tilt"], truth.factors["pour_duration"]]);
    }
    assert_eq!(pairs.len(), 208);
    assert!(style_error / 208.0 < 3.0, "{style_error} degrees over 208");
    assert!(accurate as f64 >= 0.99 * pairs.len() as f64, "{accurate} of 208 within 5 mm");
    let r = correlation(&pairs);
    assert!((0.75..0.93).contains(&r), "correlation {r}");

    // Every kind of trap was there, and as many as the proportions say.
    let expected = [
        ("accept", 208),
        ("incomplete", 2),
        ("jump", 2),
        ("no_grasp", 14),
        ("no_pour", 14),
        ("out_of_region", 2),
        ("several_pours", 35),
        ("too_short", 1),
        ("unreadable", 2),
    ];
    assert_eq!(kinds.into_iter().collect::<Vec<_>>(), expected);
    let right = all.iter().filter(|(s, _)| s.truth.arm == "right").count();
    assert_eq!(right, 126);
    assert!(
        all.iter().any(|(s, _)| s.raw.python_syntax)
            && all.iter().any(|(s, _)| !s.raw.python_syntax)
    );
    // Angles beyond the limits are no reason to exclude anything.
    let s1 = 14;
    let beyond = |s: &Simulated| s.raw.frames.iter().any(|f| f[s1] > 1.047 + 0.01);
    assert!(all.iter().any(|(s, imported)| beyond(s) && imported.is_ok()));
}

#[test]
fn without_correlation_the_manner_is_drawn_factor_by_factor() {
    let simulation = Simulation { seed: 5, correlation: 0.0, ..Simulation::default() };
    let chain = baxter();
    let mut tilt_and_time = Vec::new();
    let mut start_and_distance = Vec::new();
    let robot = RobotConfig::default();
    for assignment in simulation.assignments(&robot).unwrap().iter().filter(|a| a.trap.is_none()) {
        let truth = simulation.simulate(assignment, &robot, &chain).unwrap().truth;
        tilt_and_time.push([truth.factors["maximum_tilt"], truth.factors["pour_duration"]]);
        let ([a, b], [c, d]) = (truth.task["pour_location"], truth.task["source_cup"]);
        start_and_distance.push([truth.factors["pour_start"], (a - c).hypot(b - d)]);
    }
    for pairs in [tilt_and_time, start_and_distance] {
        // 208 independent pairs stay within three standard deviations of 1 / sqrt(208).
        assert!(correlation(&pairs).abs() < 0.21, "{}", correlation(&pairs));
    }
}

#[test]
fn one_seed_is_the_same_files_and_another_seed_is_not() {
    let chain = baxter();
    let text = |seed| {
        let simulation = Simulation { count: 3, seed, ..Simulation::default() };
        let folder = tempfile::tempdir().unwrap();
        let mut files = Vec::new();
        // In reverse: the order must not matter.
        let robot = RobotConfig::default();
        for assignment in simulation.assignments(&robot).unwrap().iter().rev() {
            let simulated = simulation.simulate(assignment, &robot, &chain).unwrap();
            mime::write(folder.path(), &simulated.raw).unwrap();
            let demo = folder.path().join(&assignment.id);
            for name in ["joint_angles.txt", "left_gripper.txt", "right_gripper.txt"] {
                files.push(std::fs::read(demo.join(name)).unwrap());
            }
        }
        files
    };
    assert_eq!(text(7), text(7));
    assert_ne!(text(7), text(8));
}

#[test]
fn a_correlation_of_one_or_more_is_refused() {
    for correlation in [-0.1, 1.0, f64::NAN] {
        let simulation = Simulation { correlation, ..Simulation::default() };
        assert!(simulation.assignments(&RobotConfig::default()).is_err());
    }
}
