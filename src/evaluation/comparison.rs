//! Rows of models beside each other: several seeds each, measured on the same test cases.
//!
//! Neither the seeds of a row nor the cases that its models share are independent measurements, so
//! both are resampled: a paired bootstrap, clustered by seed and by test case. Every row sees the same
//! resamples, so that the difference of two rows is surer than either of them.

use rand::{Rng, RngExt};

use super::intervals::{RESAMPLES, Share, interval, wilson};

/// What a row's models made of each test case: one list for each seed, values from 0 to 1 in the
/// order of the cases.
pub type Outcomes = Vec<Vec<f64>>;

/// Means of rows over the same resamples.
#[derive(Debug, Clone, PartialEq)]
pub struct Comparison {
    rows: Vec<Row>,
}

#[derive(Debug, Clone, PartialEq)]
struct Row {
    mean: f64,
    /// Test cases, where there is no spread to resample.
    constant: Option<usize>,
    resampled: Vec<f64>,
}

impl Comparison {
    /// Resamples the rows, each with as many seeds as it has.
    ///
    /// # Panics
    /// When a row has no seed, or seeds have different numbers of cases, or none.
    pub fn new<R: Rng + ?Sized>(rows: &[Outcomes], rng: &mut R) -> Self {
        let cases = rows.first().and_then(|row| row.first()).map_or(0, Vec::len);
        let even = |row: &Outcomes| !row.is_empty() && row.iter().all(|seed| seed.len() == cases);
        assert!(cases > 0 && rows.iter().all(even), "every seed is measured on every case");
        let most_seeds = rows.iter().map(Vec::len).max().unwrap_or_default();
        let mut resampled = vec![Vec::with_capacity(RESAMPLES); rows.len()];
        for _ in 0..RESAMPLES {
            let mut weights = vec![0.0; cases];
            (0..cases).for_each(|_| weights[rng.random_range(0..cases)] += 1.0);
            // The same draw decides the seed of every row, however many it has.
            let draws: Vec<f64> = (0..most_seeds).map(|_| rng.random_range(0.0..1.0)).collect();
            for (row, means) in rows.iter().zip(&mut resampled) {
                let seeds = draws.iter().take(row.len()).map(|u| (u * row.len() as f64) as usize);
                let of_seed = |seed: usize| -> f64 {
                    row[seed].iter().zip(&weights).map(|(value, weight)| value * weight).sum()
                };
                let sum: f64 = seeds.map(of_seed).sum();
                means.push(sum / (row.len() * cases) as f64);
            }
        }
        let row = |(row, resampled): (&Outcomes, Vec<f64>)| {
            let mut all = row.iter().flatten();
            let first = all.next().expect("at least one case");
            Row {
                mean: row.iter().flatten().sum::<f64>() / (row.len() * cases) as f64,
                constant: all.all(|value| value == first).then_some(cases),
                resampled,
            }
        };
        Self { rows: rows.iter().zip(resampled).map(row).collect() }
    }

    /// The mean of a row with its 95 % interval; Wilson's over the cases where all of its values are
    /// equal.
    ///
    /// # Panics
    /// Without such a row.
    pub fn mean(&self, row: usize) -> Share {
        let Row { mean, constant, resampled } = &self.rows[row];
        match constant {
            Some(cases) => wilson(*mean, *cases),
            None => interval(*mean, resampled.clone()),
        }
    }

    /// By how much the mean of `row` is above that of `other`, with its 95 % interval.
    ///
    /// # Panics
    /// Without such rows.
    pub fn difference(&self, row: usize, other: usize) -> Share {
        let [a, b] = [row, other].map(|row| &self.rows[row]);
        let differences = a.resampled.iter().zip(&b.resampled).map(|(a, b)| a - b).collect();
        interval(a.mean - b.mean, differences)
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;

    use super::super::intervals::cluster_bootstrap;
    use super::*;

    fn rng() -> ChaCha8Rng {
        ChaCha8Rng::seed_from_u64(1)
    }

    fn width(share: Share) -> f64 {
        share.high - share.low
    }

    #[test]
    fn a_single_seed_is_the_bootstrap_over_cases() {
        let cases: Vec<f64> = (0..500).map(|i| f64::from(i % 4) / 3.0).collect();
        let expected = cluster_bootstrap(&cases, &mut rng());
        let found = Comparison::new(&[vec![cases]], &mut rng()).mean(0);
        assert!((found.mean - expected.mean).abs() < 1e-12);
        assert!((found.low - expected.low).abs() < 5e-3, "{found:?} {expected:?}");
        assert!((found.high - expected.high).abs() < 5e-3, "{found:?} {expected:?}");
    }

    #[test]
    fn seeds_that_disagree_widen_the_interval() {
        let level = |share: usize| (0..500).map(|i| f64::from(i % 10 < share)).collect::<Vec<_>>();
        let agreeing: Outcomes = vec![level(6); 5];
        let disagreeing = vec![level(4), level(5), level(6), level(7), level(8)];
        let comparison = Comparison::new(&[agreeing, disagreeing], &mut rng());
        let [a, b] = [0, 1].map(|row| comparison.mean(row));
        assert!((a.mean - 0.6).abs() < 1e-12 && (b.mean - 0.6).abs() < 1e-12);
        // Five seeds of deviation .141: 2 * 1.96 * .141 / sqrt 5 = .248 of theirs alone.
        assert!(width(b) > 0.2 && width(a) < 0.1, "{a:?} {b:?}");
    }

    #[test]
    fn rows_that_fail_on_the_same_cases_differ_surely() {
        let hard = |i: usize| f64::from(!i.is_multiple_of(3));
        let row = |shift: f64| vec![(0..300).map(|i| 0.9 * hard(i) + shift).collect::<Vec<_>>()];
        let comparison = Comparison::new(&[row(0.05), row(0.0)], &mut rng());
        let difference = comparison.difference(0, 1);
        assert!((difference.mean - 0.05).abs() < 1e-12);
        assert!(width(difference) < 1e-9, "{difference:?}");
        assert!(width(comparison.mean(0)) > 0.05);
        assert!((comparison.difference(1, 0).mean + 0.05).abs() < 1e-12);
    }

    #[test]
    fn a_perfect_row_is_not_certain() {
        let share = Comparison::new(&[vec![vec![1.0; 42]; 5]], &mut rng()).mean(0);
        assert_eq!((share.mean, share.high), (1.0, 1.0));
        assert!(share.low < 0.92 && share.low > 0.9, "{share:?}");
    }
}
