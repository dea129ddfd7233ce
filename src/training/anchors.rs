//! Our variant's anchors: what of the measured factors is manner, as standard scores.

use nalgebra::{DMatrix, DVector};
use statrs::distribution::{ContinuousCDF, Normal};

use super::optimisation::TrainingError;
use crate::demonstrations::{Demonstration, Task};

/// Ridge of the least squares, as a share of the number of demonstrations.
const RIDGE: f64 = 1e-6;

/// The standard scores of the named factors on demonstrations, one row for each. Each factor is
/// regressed linearly on the task and on the scores before its own; the ranks of what remains
/// become quantiles of the standard normal distribution. So each score is standard normal, and
/// uncorrelated with the task and the others.
///
/// # Errors
/// A factor that the task does not measure, and a demonstration that does not show the task.
pub(super) fn scores(
    names: &[String],
    task: &dyn Task,
    demonstrations: &[Demonstration],
) -> Result<Vec<Vec<f32>>, TrainingError> {
    let mut measured = Vec::with_capacity(demonstrations.len());
    for demonstration in demonstrations {
        let factors = task.factors(&demonstration.motion);
        if factors.is_empty() {
            return Err(TrainingError::NoFactors { id: demonstration.id.clone() });
        }
        let value = |name: &String| match factors.iter().find(|f| f.name == name) {
            Some(factor) => Ok(factor.value),
            None => Err(TrainingError::UnknownFactor {
                name: name.clone(),
                known: factors.iter().map(|f| f.name).collect::<Vec<_>>().join(", "),
            }),
        };
        measured.push(names.iter().map(value).collect::<Result<Vec<_>, _>>()?);
    }
    let columns = |i: usize| measured.iter().map(|row| row[i]).collect::<Vec<f64>>();
    let tasks: Vec<&[f64]> = demonstrations.iter().map(|d| d.w.values()).collect();
    let mut explaining = standardised(&tasks);
    let mut scores = vec![Vec::with_capacity(names.len()); demonstrations.len()];
    for i in 0..names.len() {
        let column = normal_scores(&residuals(&explaining, &columns(i)));
        scores.iter_mut().zip(&column).for_each(|(row, z)| row.push(*z as f32));
        explaining.push(column);
    }
    Ok(scores)
}

/// The columns of the rows, each with mean 0 and deviation 1; 0 where it does not vary.
fn standardised(rows: &[&[f64]]) -> Vec<Vec<f64>> {
    let n = rows.len() as f64;
    let column = |i: usize| {
        let mean = rows.iter().map(|row| row[i]).sum::<f64>() / n;
        let variance = rows.iter().map(|row| (row[i] - mean).powi(2)).sum::<f64>() / n;
        let scale = if variance > 1e-18 { variance.sqrt() } else { f64::INFINITY };
        rows.iter().map(|row| (row[i] - mean) / scale).collect()
    };
    (0..rows.first().map_or(0, |row| row.len())).map(column).collect()
}

/// What least squares on the columns and a constant leave of `y`.
fn residuals(columns: &[Vec<f64>], y: &[f64]) -> Vec<f64> {
    let n = y.len();
    let design = DMatrix::from_fn(n, columns.len() + 1, |row, i| match columns.get(i) {
        Some(column) => column[row],
        None => 1.0,
    });
    let y = DVector::from_column_slice(y);
    let ridge = DMatrix::from_diagonal_element(design.ncols(), design.ncols(), RIDGE * n as f64);
    let gram = design.tr_mul(&design) + ridge;
    let solution = gram.cholesky().expect("the ridge makes it positive definite");
    let fitted = &design * solution.solve(&design.tr_mul(&y));
    (y - fitted).iter().copied().collect()
}

/// The quantiles of the standard normal distribution at the ranks of the values.
fn normal_scores(values: &[f64]) -> Vec<f64> {
    let normal = Normal::standard();
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|a, b| values[*a].total_cmp(&values[*b]));
    let mut scores = vec![0.0; values.len()];
    for (rank, place) in order.into_iter().enumerate() {
        scores[place] = normal.inverse_cdf((rank as f64 + 0.5) / values.len() as f64);
    }
    scores
}

#[cfg(test)]
mod tests {
    use rand::rngs::ChaCha8Rng;
    use rand::{RngExt, SeedableRng};

    use super::*;
    use crate::demonstrations::arcs::{ArcsSimulation, ArcsTask, simulate};

    fn correlation(a: &[f64], b: &[f64]) -> f64 {
        let n = a.len() as f64;
        let mean = |v: &[f64]| v.iter().sum::<f64>() / n;
        let (mean_a, mean_b) = (mean(a), mean(b));
        let sum = |f: &dyn Fn(f64, f64) -> f64| -> f64 {
            a.iter().zip(b).map(|(a, b)| f(a - mean_a, b - mean_b)).sum()
        };
        sum(&|a, b| a * b) / (sum(&|a, _| a * a) * sum(&|_, b| b * b)).sqrt()
    }

    #[test]
    fn a_score_is_what_neither_the_task_nor_the_scores_before_it_explain() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let n = 2000;
        let mut uniform = || (0..n).map(|_| rng.random_range(-1.0..1.0)).collect::<Vec<f64>>();
        let (w, a, own) = (uniform(), uniform(), uniform());
        let factor: Vec<f64> = (0..n).map(|i| 3.0 * w[i] - 2.0 * a[i] + 0.1 * own[i]).collect();
        let scores = normal_scores(&residuals(&[w.clone(), a.clone()], &factor));
        assert!(correlation(&scores, &own) > 0.97, "{}", correlation(&scores, &own));
        // Ranks keep the residuals' independence up to sampling, 1 / sqrt(2000).
        assert!(correlation(&scores, &w).abs() < 3e-2 && correlation(&scores, &a).abs() < 3e-2);
    }

    #[test]
    fn scores_are_standard_normal() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let values: Vec<f64> = (0..1000).map(|_| rng.random_range(0.0..1.0_f64).powi(4)).collect();
        let mut scores = normal_scores(&values);
        scores.sort_by(f64::total_cmp);
        // Quantiles from tables of the normal distribution.
        for (place, quantile) in [(22, -2.0047), (499, -0.0013), (841, 1.0007), (974, 1.9515)] {
            assert!((scores[place] - quantile).abs() < 1e-3, "{place}: {}", scores[place]);
        }
    }

    #[test]
    fn arcs_are_scored_by_their_factors() {
        let simulation = ArcsSimulation { count: 400, ..ArcsSimulation::default() };
        let splits = simulate(&simulation, &mut ChaCha8Rng::seed_from_u64(7)).splits;
        let names = ["radius".to_owned(), "span".to_owned()];
        let task = ArcsTask::default();
        let scores = scores(&names, &task, &splits.train).unwrap();
        assert_eq!((scores.len(), scores[0].len()), (splits.train.len(), 2));
        let of = |i: usize| scores.iter().map(|row| f64::from(row[i])).collect::<Vec<_>>();
        let spans: Vec<f64> =
            splits.train.iter().map(|d| task.factors(&d.motion)[1].value).collect();
        assert!(correlation(&of(1), &spans) > 0.9);
        let unknown = super::scores(&["speed".to_owned()], &task, &splits.train).unwrap_err();
        assert_eq!(
            unknown.to_string(),
            "the task measures no factor speed for manner.anchors; it measures radius, span, start"
        );
    }
}
