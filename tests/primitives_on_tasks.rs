//! The classical primitives on the tasks of the crate: what they achieve, and what they can't.

#![expect(clippy::unwrap_used, reason = "in a test a panic is the report")]

use std::time::Instant;

use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use tcvae::demonstrations::arcs::{ArcsSimulation, ArcsTask, simulate};
use tcvae::demonstrations::pouring;
use tcvae::demonstrations::recording::RobotConfig;
use tcvae::demonstrations::simulation::Simulation;
use tcvae::demonstrations::{Demonstration, Splits, TaskConfig};
use tcvae::evaluation::{PrimitiveEvaluation, Score, evaluate_primitive};
use tcvae::primitives::{DmpConfig, DmpPrimitive, ProMp, ProMpConfig, TpGmm, TpGmmConfig};
use tcvae::trajectory::Motion;
use tcvae::{MovementPrimitive, mime, urdf};

/// The pours of simulated recordings, as importing finds them.
fn pours(count: usize, both_sides: bool) -> Splits {
    let simulation = Simulation { count, seed: 20, both_sides, ..Simulation::default() };
    let chain = urdf::chain(include_str!("../config/baxter.urdf"), "base", "left_gripper").unwrap();
    let robot = RobotConfig::default();
    let folder = tempfile::tempdir().unwrap();
    let mut accepted = Vec::new();
    for assignment in simulation.assignments(&robot).unwrap() {
        let simulated = simulation.simulate(&assignment, &robot, &chain).unwrap();
        mime::write(folder.path(), &simulated.raw).unwrap();
        let recording = folder.path().join(&assignment.id);
        if let Ok(read) = mime::read(&recording, &robot.channels()) {
            let imported = pouring::task().demonstration(&read.recording, &robot, &chain);
            accepted.extend(imported.map(|(_, demonstration)| demonstration));
        }
        std::fs::remove_dir_all(recording).unwrap();
    }
    Splits::random(accepted, &mut ChaCha8Rng::seed_from_u64(1))
}

/// Evaluates what was not trained on, and prints what comes out; `--nocapture` shows it.
fn measured(
    name: &str,
    config: &TaskConfig,
    splits: &Splits,
    fit: impl FnOnce() -> Box<dyn MovementPrimitive>,
) -> PrimitiveEvaluation {
    let started = Instant::now();
    let primitive = fit();
    let fit_secs = started.elapsed().as_secs_f64();
    let mut durations: Vec<f64> = splits.train.iter().map(|d| d.motion.duration_secs).collect();
    durations.sort_by(f64::total_cmp);
    let duration_secs = durations[durations.len() / 2];
    let cases = [splits.validation.clone(), splits.test.clone()].concat();
    let started = Instant::now();
    cases.iter().for_each(|case| drop(primitive.generate(&case.w)));
    let generate_us = 1e6 * started.elapsed().as_secs_f64() / cases.len() as f64;
    let (task, thresholds) = (config.task(), config.thresholds());
    let evaluation =
        evaluate_primitive(&*primitive, task, &cases, &thresholds, duration_secs).unwrap();
    let PrimitiveEvaluation { success, success_and_valid, median_task_error, .. } = &evaluation;
    println!(
        "{name}: SUCCESS {:.2?}, and valid {:.2?}, median error {median_task_error:.4?}, rmse \
         {:.3}; fitted in {fit_secs:.2} s, generates in {generate_us:.0} us",
        means(success),
        means(success_and_valid),
        evaluation.reconstruction_rmse,
    );
    evaluation
}

fn means(scores: &[Score]) -> Vec<f64> {
    assert!(scores.iter().all(|s| s.low <= s.mean && s.mean <= s.high && s.low < s.high));
    scores.iter().map(|s| s.mean).collect()
}

#[test]
fn an_average_of_pours_to_both_sides_pours_nothing() {
    let splits = pours(70, true);
    let task = pouring::task();
    let (space, config) = (task.task_space(), TaskConfig::Manipulation(task));
    let fit = || TpGmm::fit(&TpGmmConfig::default(), &space, &splits.train).unwrap();
    let blended = measured("TP-GMM", &config, &splits, || Box::new(fit()));
    assert!(means(&blended.success)[2] < 0.5);
}

#[test]
fn on_pours_to_one_side_the_linear_ones_pour_where_they_are_told() {
    let splits = pours(140, false);
    assert!(splits.train.len() > 50 && splits.test.len() > 15, "{}", splits.train.len());
    let task = pouring::task();
    let space = task.task_space();
    let config = TaskConfig::Manipulation(task);
    let train = &splits.train;

    let tp_gmm = |config: TpGmmConfig| TpGmm::fit(&config, &space, train).unwrap();
    let blended = measured("TP-GMM", &config, &splits, || Box::new(tp_gmm(TpGmmConfig::default())));
    assert!(means(&blended.success)[2] > 0.9);

    let promp = |config: ProMpConfig| ProMp::fit(&config, &space, train).unwrap();
    let default = measured("ProMP", &config, &splits, || Box::new(promp(ProMpConfig::default())));
    assert!(means(&default.success_and_valid)[0] > 0.9);
    assert!(default.median_task_error.unwrap() < 0.004);
    // The hand moves while it pours and styles differ, which a product of Gaussians blends.
    assert!(means(&blended.success)[0] < 0.5 * means(&default.success)[0]);
    // Manners vary: nobody can repeat a demonstration from its task alone.
    assert!((0.05..0.4).contains(&default.reconstruction_rmse));

    let dmp = |config: DmpConfig| DmpPrimitive::fit(&config, &space, train).unwrap();
    let default = measured("DMP", &config, &splits, || Box::new(dmp(DmpConfig::default())));
    assert!(means(&default.success_and_valid)[0] > 0.9);
    // The spring follows a new goal too late for the pour.
    let smooth = DmpConfig { smooth_scaling: true, ..DmpConfig::default() };
    let late = measured("DMP, smooth scaling", &config, &splits, || Box::new(dmp(smooth)));
    let [one_cm, _, five_cm] = means(&late.success)[..] else { panic!("three thresholds") };
    assert!(one_cm < 0.2 && five_cm > 0.8, "{one_cm} {five_cm}");

    // Without a limit, alignment takes the tilt out of the mean of several styles.
    let free = ProMpConfig { alignment_window: 1.0, ..ProMpConfig::default() };
    let flat = measured("ProMP, aligned freely", &config, &splits, || Box::new(promp(free)));
    assert!(means(&flat.success)[2] < 0.7);
}

#[test]
fn on_arcs_a_mean_motion_is_centred_beside_its_task_and_always_as_far() {
    let simulation = ArcsSimulation { count: 1000, ..ArcsSimulation::default() };
    let splits = simulate(&simulation, &mut ChaCha8Rng::seed_from_u64(7)).splits;
    let (space, config) = (ArcsTask::task_space(), TaskConfig::Arcs(ArcsTask::default()));
    let train = &splits.train;
    let unaligned =
        TpGmmConfig { steps: 32, components: 10, alignment_window: 0.0, ..TpGmmConfig::default() };
    let check = |name: &str, fit: &dyn Fn() -> Box<dyn MovementPrimitive>| {
        let evaluation = measured(name, &config, &splits, fit);
        // The mean of arcs of all manners is an arc of a circle beside theirs.
        let error = evaluation.median_task_error.unwrap();
        assert!((0.025..0.06).contains(&error), "{error}");
        let [first, _, last] = means(&evaluation.success)[..] else { panic!("three thresholds") };
        assert!(first < 0.05 && last > 0.95, "{first} {last}");
        assert!((0.15..0.3).contains(&evaluation.reconstruction_rmse));
    };
    let promp = ProMpConfig { steps: 32, ..ProMpConfig::default() };
    let dmp = DmpConfig { steps: 32, ..DmpConfig::default() };
    check("TP-GMM", &|| Box::new(TpGmm::fit(&unaligned, &space, train).unwrap()));
    check("ProMP", &|| Box::new(ProMp::fit(&promp, &space, train).unwrap()));
    check("DMP", &|| Box::new(DmpPrimitive::fit(&dmp, &space, train).unwrap()));
    // With one frame every task's motion is the same one, moved.
    let tp_gmm = TpGmm::fit(&unaligned, &space, train).unwrap();
    let error = |case: &Demonstration| {
        let states = tp_gmm.generate(&case.w).mean;
        let motion = Motion { states, duration_secs: 1.0 };
        space.distance(&config.task().empirical_task(&motion).unwrap(), &case.w)
    };
    let errors: Vec<f64> = splits.test.iter().map(error).collect();
    assert!(errors.iter().all(|e| (e - errors[0]).abs() < 1e-9));
}
