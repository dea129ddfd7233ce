//! What a primitive without manner parameters achieves: it has one motion for each task, so SUCCESS
//! is all there is of the paper's metrics.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{
    CaseOutcome, EvaluationError, Score, check_same, intervals, mean_square_difference, score,
    share,
};
use crate::demonstrations::{Demonstration, Task};
use crate::primitive::MovementPrimitive;
use crate::trajectory::Motion;

/// The measured quality of a primitive without manner parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PrimitiveEvaluation {
    /// Share of test cases whose generated motion achieves its task (eq. 15), with Wilson's
    /// intervals.
    pub success: Vec<Score>,
    /// Share of those that are inside the task's validity bounds too.
    pub success_and_valid: Vec<Score>,
    /// Share of the motions that show the task and break a bound of validity, for each bound that any
    /// breaks.
    pub broken_bounds: BTreeMap<String, f64>,
    /// Median over the cases of the distance between the task and the one that the generated motion
    /// achieves, in the task's unit; none where most motions don't show the task at all.
    pub median_task_error: Option<f64>,
    /// Root mean square distance of the generated motions from the demonstrated ones, over all steps
    /// and state values. A primitive without manner can't tell demonstrations of one task apart,
    /// so this holds their variety too.
    pub reconstruction_rmse: f64,
    /// Number of test cases.
    pub cases: usize,
    /// Seed that was asked for; nothing is drawn, so another one measures the same.
    pub seed: u64,
    /// What tells the model from others, as in [`super::Evaluation::model_id`].
    pub model_id: String,
    /// SHA-256 over the data set.
    pub data_digest: String,
}

/// Measures a primitive on `cases`, which it was not fitted to. `thresholds` are distances from the
/// task that count as achieving it, in the task's unit; motions take `duration_secs`. Seed, model
/// and data are left for the caller.
///
/// # Errors
/// Fewer than 2 cases; cases whose states or tasks have another dimension than the primitive's.
///
/// # Panics
/// Without a threshold.
pub fn evaluate_primitive<P: MovementPrimitive + ?Sized>(
    primitive: &P,
    task: &dyn Task,
    cases: &[Demonstration],
    thresholds: &[f64],
    duration_secs: f64,
) -> Result<PrimitiveEvaluation, EvaluationError> {
    Ok(evaluate_primitive_cases(primitive, task, cases, thresholds, duration_secs)?.0)
}

/// [`evaluate_primitive`], with what came of every case, in their order.
///
/// # Errors
/// As [`evaluate_primitive`].
///
/// # Panics
/// As [`evaluate_primitive`].
pub fn evaluate_primitive_cases<P: MovementPrimitive + ?Sized>(
    primitive: &P,
    task: &dyn Task,
    cases: &[Demonstration],
    thresholds: &[f64],
    duration_secs: f64,
) -> Result<(PrimitiveEvaluation, Vec<CaseOutcome>), EvaluationError> {
    assert!(!thresholds.is_empty(), "nothing to measure");
    if cases.len() < 2 {
        let (split, found, needed) = ("test", cases.len(), 2);
        return Err(EvaluationError::TooFew { split, found, needed });
    }
    let (mut errors, mut valid_errors) = (Vec::new(), Vec::new());
    let mut broken_bounds = BTreeMap::new();
    let mut square_error = 0.0;
    for case in cases {
        check_same(primitive, case)?;
        let motion = Motion { states: primitive.generate(&case.w).mean, duration_secs };
        square_error += mean_square_difference(&motion.states, &case.motion.states);
        let error = match task.empirical_task(&motion) {
            Ok(measured) => primitive.task_space().distance(&measured, &case.w),
            Err(_) => f64::INFINITY,
        };
        let broken = match error.is_finite() {
            true => task.violations(&motion),
            false => Vec::new(),
        };
        for violation in &broken {
            *broken_bounds.entry(violation.bound.to_owned()).or_insert(0.0) +=
                1.0 / cases.len() as f64;
        }
        let valid = error.is_finite() && broken.is_empty();
        errors.push(error);
        valid_errors.push(if valid { error } else { f64::INFINITY });
    }
    let scores = |errors: &[f64]| {
        let wilson = |&t: &f64| score(t, intervals::wilson(share(errors, t), cases.len()));
        thresholds.iter().map(wilson).collect()
    };
    let (success, success_and_valid) = (scores(&errors), scores(&valid_errors));
    let outcome = |error: &f64| CaseOutcome {
        success: thresholds.iter().map(|t| f64::from(error <= t)).collect(),
        robustness: Vec::new(),
        robust_and_valid: Vec::new(),
    };
    let outcomes = errors.iter().map(outcome).collect();
    errors.sort_by(f64::total_cmp);
    let evaluation = PrimitiveEvaluation {
        success,
        success_and_valid,
        broken_bounds,
        median_task_error: Some(errors[cases.len() / 2]).filter(|e| e.is_finite()),
        reconstruction_rmse: (square_error / cases.len() as f64).sqrt(),
        cases: cases.len(),
        seed: 0,
        model_id: String::new(),
        data_digest: String::new(),
    };
    Ok((evaluation, outcomes))
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;

    use super::super::oracles::{Oracle, exact_arc, exact_manner};
    use super::*;
    use crate::demonstrations::arcs::{Arc, ArcsSimulation, ArcsTask, simulate};
    use crate::trajectory::Trajectory;

    fn cases() -> Vec<Demonstration> {
        let simulation = ArcsSimulation { count: 1000, ..ArcsSimulation::default() };
        simulate(&simulation, &mut ChaCha8Rng::seed_from_u64(7)).splits.test
    }

    fn measure(decode: fn(&[f64], &[f64]) -> Arc) -> PrimitiveEvaluation {
        let oracle = Oracle::new(decode, exact_manner, 0.0);
        let task = ArcsTask::default();
        evaluate_primitive(&oracle, &task, &cases(), &[0.025, 0.05], 1.0).unwrap()
    }

    fn means(scores: &[Score]) -> Vec<f64> {
        scores.iter().map(|s| s.mean).collect()
    }

    #[test]
    fn the_median_manner_at_the_task_succeeds_and_repeats_nobody() {
        let evaluation = measure(exact_arc);
        assert_eq!(means(&evaluation.success), [1.0; 2]);
        assert_eq!(means(&evaluation.success_and_valid), [1.0; 2]);
        assert_eq!(evaluation.cases, 100);
        assert!(evaluation.median_task_error.unwrap() < 1e-9);
        assert!(evaluation.reconstruction_rmse > 0.1);
        // Wilson: 1 / (1 + z^2 / 100).
        assert!((evaluation.success[0].low - 0.963_007).abs() < 1e-5);
    }

    #[test]
    fn a_motion_beside_its_task_succeeds_from_that_distance_on() {
        let evaluation = measure(|w, h| exact_arc(&[w[0] + 0.03, w[1]], h));
        assert_eq!(means(&evaluation.success), [0.0, 1.0]);
        assert!((evaluation.median_task_error.unwrap() - 0.03).abs() < 1e-9);
    }

    #[test]
    fn a_motion_that_is_none_of_the_task_is_told_from_one_that_shows_nothing() {
        let tiny = measure(|w, h| Arc { radius: 0.03, ..exact_arc(w, h) });
        assert_eq!(means(&tiny.success), [1.0; 2]);
        assert_eq!(means(&tiny.success_and_valid), [0.0; 2]);
        assert!((tiny.broken_bounds["valid_radius"] - 1.0).abs() < 1e-9);
        let point = measure(|w, h| Arc { radius: 0.0, ..exact_arc(w, h) });
        assert_eq!(means(&point.success), [0.0; 2]);
        assert_eq!(point.median_task_error, None);
        assert!(point.broken_bounds.is_empty());
    }

    #[test]
    fn too_few_and_odd_cases_are_refused() {
        let oracle = Oracle::exact();
        let refusal = |cases: &[Demonstration]| {
            let task = ArcsTask::default();
            evaluate_primitive(&oracle, &task, cases, &[0.1], 1.0).unwrap_err().to_string()
        };
        let mut cases = cases();
        let one = refusal(&cases[..1]);
        assert_eq!(one, "the test part has 1 demonstrations; an evaluation needs at least 2");
        cases[1].motion.states = Trajectory::new(3, vec![0.0; 9]).unwrap();
        assert!(refusal(&cases).contains("has 3 values in a state where the model has 2"));
    }
}
