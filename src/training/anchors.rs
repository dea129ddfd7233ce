//! Our variant's anchors: what of the measured factors is manner, as standard scores.

use nalgebra::{DMatrix, DVector};
use statrs::distribution::{ContinuousCDF, Normal};

use super::optimisation::TrainingError;
use crate::demonstrations::{Demonstration, Task};

/// Ridge of the least squares, as a share of the number of demonstrations.
const RIDGE: f64 = 1e-6;

/// Degree of the polynomials in the task that explain a factor. A hand's heading follows from where
/// the cup stands by an angle, which a line leaves a trace of; degree 3 has 35 products of four
/// values, many for 124 demonstrations.
const DEGREE: usize = 2;

/// Turns measured factors into standard scores. Each factor is regressed on the polynomials of the
/// task and on the scores before its own; where what remains ranks among the training set becomes a
/// quantile of the standard normal distribution. So each score is standard normal, and uncorrelated
/// with the task's polynomials and the other scores.
#[derive(Debug)]
pub(super) struct Scorer<'a> {
    names: &'a [String],
    task: &'a dyn Task,
    /// Mean and deviation of each value of the task.
    standard: Vec<[f64; 2]>,
    /// For each factor, the coefficients of what explains it, and what remains in the training set,
    /// ascending.
    factors: Vec<(DVector<f64>, Vec<f64>)>,
}

impl<'a> Scorer<'a> {
    /// Fits the scores of the named factors to demonstrations.
    ///
    /// # Errors
    /// A factor that the task does not measure, and a demonstration that does not show the task.
    pub(super) fn fit(
        names: &'a [String],
        task: &'a dyn Task,
        demonstrations: &[Demonstration],
    ) -> Result<Self, TrainingError> {
        let dim = demonstrations.first().map_or(0, |d| d.w.values().len());
        let standard = (0..dim).map(|i| moments(demonstrations.iter().map(|d| d.w.values()[i])));
        let mut scorer = Self { names, task, standard: standard.collect(), factors: Vec::new() };
        let measured = scorer.measured(demonstrations)?;
        let mut explaining = scorer.polynomials(demonstrations);
        for i in 0..names.len() {
            let values = measured.iter().map(|row| row[i]);
            let values = DVector::from_iterator(measured.len(), values);
            let coefficients = least_squares(&explaining, &values);
            let mut remaining = residuals(&explaining, &coefficients, &values);
            remaining.sort_by(f64::total_cmp);
            scorer.factors.push((coefficients, remaining));
            let scores = scorer.scores_of(i, &explaining, &values);
            explaining = with_column(explaining, &scores);
        }
        Ok(scorer)
    }

    /// The scores of demonstrations, one row for each.
    ///
    /// # Errors
    /// A demonstration that does not show the task.
    pub(super) fn scores(
        &self,
        demonstrations: &[Demonstration],
    ) -> Result<Vec<Vec<f32>>, TrainingError> {
        let measured = self.measured(demonstrations)?;
        let mut explaining = self.polynomials(demonstrations);
        let mut rows = vec![Vec::with_capacity(self.names.len()); demonstrations.len()];
        for i in 0..self.names.len() {
            let values = measured.iter().map(|row| row[i]);
            let values = DVector::from_iterator(measured.len(), values);
            let scores = self.scores_of(i, &explaining, &values);
            rows.iter_mut().zip(&scores).for_each(|(row, z)| row.push(*z as f32));
            explaining = with_column(explaining, &scores);
        }
        Ok(rows)
    }

    /// The named factors, one row for each demonstration.
    fn measured(&self, demonstrations: &[Demonstration]) -> Result<Vec<Vec<f64>>, TrainingError> {
        let of_demonstration = |demonstration: &Demonstration| {
            if self.names.is_empty() {
                return Ok(Vec::new());
            }
            let factors = self.task.factors(&demonstration.motion);
            if factors.is_empty() {
                return Err(TrainingError::NoFactors { id: demonstration.id.clone() });
            }
            let value = |name: &String| match factors.iter().find(|f| f.name == *name) {
                Some(factor) => Ok(factor.value),
                None => Err(TrainingError::UnknownFactor {
                    name: name.clone(),
                    known: factors.iter().map(|f| &*f.name).collect::<Vec<_>>().join(", "),
                }),
            };
            self.names.iter().map(value).collect()
        };
        demonstrations.iter().map(of_demonstration).collect()
    }

    /// 1 and all products of up to [`DEGREE`] of the task's standardised values, one row for each
    /// demonstration.
    fn polynomials(&self, demonstrations: &[Demonstration]) -> DMatrix<f64> {
        let row = |d: &Demonstration| {
            let standard = d.w.values().iter().zip(&self.standard);
            products(&standard.map(|(w, [mean, scale])| (w - mean) / scale).collect::<Vec<_>>())
        };
        let rows: Vec<Vec<f64>> = demonstrations.iter().map(row).collect();
        DMatrix::from_fn(rows.len(), rows.first().map_or(0, Vec::len), |r, c| rows[r][c])
    }

    fn scores_of(&self, i: usize, explaining: &DMatrix<f64>, values: &DVector<f64>) -> Vec<f64> {
        let (coefficients, of_training) = &self.factors[i];
        let remaining = residuals(explaining, coefficients, values);
        remaining.iter().map(|value| normal_score(*value, of_training)).collect()
    }
}

/// Mean and deviation, which is infinite instead of 0, so that what never varies is 0.
fn moments(values: impl Iterator<Item = f64> + Clone) -> [f64; 2] {
    let n = values.clone().count() as f64;
    let mean = values.clone().sum::<f64>() / n;
    let variance = values.map(|v| (v - mean).powi(2)).sum::<f64>() / n;
    [mean, if variance > 1e-18 { variance.sqrt() } else { f64::INFINITY }]
}

/// 1 and all products of up to [`DEGREE`] of the values.
fn products(values: &[f64]) -> Vec<f64> {
    let mut all = vec![1.0];
    // Products of one degree less, each with the first value that may still be multiplied.
    let mut before = vec![(1.0, 0)];
    for _ in 0..DEGREE {
        let longer = |&(product, first): &(f64, usize)| {
            (first..values.len()).map(move |i| (product * values[i], i))
        };
        before = before.iter().flat_map(longer).collect();
        all.extend(before.iter().map(|(product, _)| product));
    }
    all
}

fn with_column(matrix: DMatrix<f64>, column: &[f64]) -> DMatrix<f64> {
    let at = matrix.ncols();
    let mut wider = matrix.insert_column(at, 0.0);
    wider.set_column(at, &DVector::from_column_slice(column));
    wider
}

fn least_squares(design: &DMatrix<f64>, y: &DVector<f64>) -> DVector<f64> {
    let ridge = RIDGE * y.len() as f64;
    let ridge = DMatrix::from_diagonal_element(design.ncols(), design.ncols(), ridge);
    let gram = design.tr_mul(design) + ridge;
    gram.cholesky().expect("the ridge makes it positive definite").solve(&design.tr_mul(y))
}

/// What the columns leave of `y`.
fn residuals(design: &DMatrix<f64>, coefficients: &DVector<f64>, y: &DVector<f64>) -> Vec<f64> {
    (y - design * coefficients).iter().copied().collect()
}

/// The quantile of the standard normal distribution at the rank of the value among others, which
/// are ascending.
fn normal_score(value: f64, others: &[f64]) -> f64 {
    let below = others.partition_point(|other| *other < value);
    let same = others[below..].partition_point(|other| *other <= value);
    // In the middle of those that equal it; beyond the ends half a rank further.
    let rank = (below as f64 + 0.5 * same as f64).clamp(0.5, others.len() as f64 - 0.5);
    Normal::standard().inverse_cdf(rank / others.len() as f64)
}

#[cfg(test)]
mod tests {
    use rand::rngs::ChaCha8Rng;
    use rand::{RngExt, SeedableRng};

    use super::*;
    use crate::demonstrations::arcs::{ArcsSimulation, ArcsTask, simulate};
    use crate::demonstrations::task::Factor;
    use crate::demonstrations::{TaskMeasureError, Violation};
    use crate::parameters::{TaskParameters, TaskSpace};
    use crate::trajectory::Motion;

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
        let simulation = ArcsSimulation { count: 4000, ..ArcsSimulation::default() };
        let splits = simulate(&simulation, &mut ChaCha8Rng::seed_from_u64(7)).splits;
        /// Factors that hang together, and on the task.
        #[derive(Debug)]
        struct Tied(ArcsTask);
        impl Task for Tied {
            fn name(&self) -> &str {
                "tied"
            }
            fn task_space(&self) -> TaskSpace {
                self.0.task_space()
            }
            fn empirical_task(&self, motion: &Motion) -> Result<TaskParameters, TaskMeasureError> {
                self.0.empirical_task(motion)
            }
            fn violations(&self, motion: &Motion) -> Vec<Violation> {
                self.0.violations(motion)
            }
            fn factors(&self, motion: &Motion) -> Vec<Factor> {
                let mut factors = self.0.factors(motion);
                let w = self.0.empirical_task(motion).unwrap();
                let [x, y] = [w.values()[0], w.values()[1]];
                factors[0].value += 2.0 * x - x * y;
                factors[1].value += 3.0 * factors[0].value;
                factors
            }
        }
        let names = ["radius".to_owned(), "span".to_owned()];
        let tied = Tied(ArcsTask::default());
        let scorer = Scorer::fit(&names, &tied, &splits.train).unwrap();
        // Also on demonstrations that it was not fitted to.
        for part in [&splits.train, &splits.test] {
            let scores = scorer.scores(part).unwrap();
            let score = |i: usize| scores.iter().map(|z| f64::from(z[i])).collect::<Vec<_>>();
            let own = |i: usize| {
                part.iter().map(|d| tied.0.factors(&d.motion)[i].value).collect::<Vec<_>>()
            };
            let w = |i: usize| part.iter().map(|d| d.w.values()[i]).collect::<Vec<_>>();
            for i in 0..2 {
                assert!(correlation(&score(i), &own(i)) > 0.96, "{i}");
                for other in [w(0), w(1), score(1 - i)] {
                    let tie = correlation(&score(i), &other);
                    assert!(tie.abs() < 0.1, "{i} {tie} of {}", part.len());
                }
            }
        }
    }

    #[test]
    fn scores_are_standard_normal() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut values: Vec<f64> =
            (0..1000).map(|_| rng.random_range(0.0..1.0_f64).powi(4)).collect();
        values.sort_by(f64::total_cmp);
        // Quantiles from tables of the normal distribution.
        for (place, quantile) in [(22, -2.0047), (499, -0.0013), (841, 1.0007), (974, 1.9515)] {
            let score = normal_score(values[place], &values);
            assert!((score - quantile).abs() < 1e-3, "{place}: {score}");
        }
        // Beyond the ends as at them.
        assert_eq!(normal_score(-1.0, &values), normal_score(values[0], &values));
        assert_eq!(normal_score(2.0, &values), normal_score(values[999], &values));
    }

    #[test]
    fn every_product_is_there_once() {
        assert_eq!(products(&[2.0, 3.0]), [1.0, 2.0, 3.0, 4.0, 6.0, 9.0]);
    }

    #[test]
    fn a_factor_that_the_task_does_not_measure_is_refused() {
        let simulation = ArcsSimulation { count: 40, ..ArcsSimulation::default() };
        let splits = simulate(&simulation, &mut ChaCha8Rng::seed_from_u64(7)).splits;
        let (names, task) = (["speed".to_owned()], ArcsTask::default());
        let unknown = Scorer::fit(&names, &task, &splits.train).unwrap_err();
        assert_eq!(
            unknown.to_string(),
            "the task measures no factor speed for manner.anchors; it measures radius, span, start"
        );
    }
}
