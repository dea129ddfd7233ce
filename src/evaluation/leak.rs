//! Leak: how much of the task a strong probe reads from the manner, which should hold none of it.

use rand::{Rng, RngExt};
use smartcore::ensemble::random_forest_regressor::{
    RandomForestRegressor, RandomForestRegressorParameters,
};
use smartcore::linalg::basic::matrix::DenseMatrix;

/// Trees of the probe; more change the third digit of R2.
const TREES: usize = 100;
/// Fewest encodings in a leaf. Fully grown trees fit noise, which hides weak leaks; on the planted
/// leaks of the tests 20 finds as much as 5 or more.
const LEAF: usize = 20;

/// Sampled manners with the tasks of the demonstrations that they encode.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Encodings {
    /// One manner each, all of one length.
    pub h: Vec<Vec<f64>>,
    /// One task each, all of one length.
    pub w: Vec<Vec<f64>>,
}

/// Coefficient of determination of `predicted` for `truth`: 1 for exact, 0 for as good as the
/// mean, below 0 for worse; `None` where the truth does not vary.
pub fn r2(predicted: &[f64], truth: &[f64]) -> Option<f64> {
    let mean = truth.iter().sum::<f64>() / truth.len() as f64;
    let total: f64 = truth.iter().map(|t| (t - mean).powi(2)).sum();
    let residual: f64 = predicted.iter().zip(truth).map(|(p, t)| (p - t).powi(2)).sum();
    (total > 0.0).then(|| 1.0 - residual / total)
}

/// R2 of a random forest from manner to the best-predicted component of the task, floored at 0:
/// fitted on one set of encodings, scored on another. Without any manner it is 0, and so is that
/// of a component that does not vary.
///
/// # Panics
/// When a set of encodings is empty, or its manners, or tasks, differ in length.
pub fn leak_r2<R: Rng + ?Sized>(fit: &Encodings, score: &Encodings, rng: &mut R) -> f64 {
    let scores = component_r2(fit, score, rng);
    scores.into_iter().flatten().fold(0.0, f64::max)
}

/// R2 of the forest for each component of the task.
fn component_r2<R: Rng + ?Sized>(
    fit: &Encodings,
    score: &Encodings,
    rng: &mut R,
) -> Vec<Option<f64>> {
    let manners = fit.h[0].len();
    if manners == 0 {
        return Vec::new();
    }
    let matrix = |h| DenseMatrix::from_2d_vec(h).expect("manners of one length");
    let [fit_h, score_h] = [matrix(&fit.h), matrix(&score.h)];
    let component = |i| {
        let column = |w: &[Vec<f64>]| -> Vec<f64> { w.iter().map(|w| w[i]).collect() };
        let parameters = RandomForestRegressorParameters::default()
            .with_n_trees(TREES)
            .with_min_samples_leaf(LEAF)
            .with_m(manners)
            .with_seed(rng.random());
        let forest = RandomForestRegressor::fit(&fit_h, &column(&fit.w), parameters)
            .expect("as many manners as tasks");
        let predicted: Vec<f64> = forest.predict(&score_h).expect("manners of the same length");
        r2(&predicted, &column(&score.w))
    };
    (0..fit.w[0].len()).map(component).collect()
}

#[cfg(test)]
pub(super) mod tests {
    use std::collections::BTreeMap;
    use std::f64::consts::TAU;

    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;

    use super::*;

    /// SplitMix64 from seed 0, as `tests/golden/evaluation.py` draws it.
    pub(in crate::evaluation) fn uniform(index: u64) -> f64 {
        let mut z = (index + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 * 2f64.powi(-53)
    }

    /// Cases `from..to` with a planted leak, as the golden script plants it.
    fn planted(leak: &str, from: u64, to: u64) -> Encodings {
        let mut encodings = Encodings::default();
        for i in from..to {
            let u: Vec<f64> = (0..8).map(|k| uniform(8 * i + k)).collect();
            let w = vec![u[0], u[1]];
            let noise = [u[2] - 0.5, u[3] - 0.5, u[4] - 0.5];
            let sign = if noise[0] > 0.0 { 1.0 } else { -1.0 };
            encodings.h.push(match leak {
                "none" => noise.to_vec(),
                "linear" => vec![w[0] + noise[0], noise[1], noise[2]],
                "folded" => {
                    vec![(TAU * w[0]).sin() + 0.2 * noise[0], (w[0] - w[1]).powi(2), noise[2]]
                }
                "product" => vec![sign, sign * (w[1] - 0.5) + 0.1 * noise[1], noise[2]],
                _ => panic!("unknown leak {leak}"),
            });
            encodings.w.push(w);
        }
        encodings
    }

    #[test]
    fn planted_leaks_are_found_as_scikit_learns_forest_finds_them() {
        #[derive(serde::Deserialize)]
        struct Golden {
            leak_r2: BTreeMap<String, Vec<f64>>,
        }
        let golden: Golden =
            serde_json::from_str(include_str!("../../tests/golden/evaluation.json")).unwrap();
        assert_eq!(golden.leak_r2.len(), 4);
        for (leak, expected) in golden.leak_r2 {
            let (fit, score) = (planted(&leak, 0, 5000), planted(&leak, 5000, 6000));
            let mut rng = ChaCha8Rng::seed_from_u64(1);
            let found = component_r2(&fit, &score, &mut rng);
            for (found, &expected) in found.iter().zip(&expected) {
                let found = found.unwrap();
                assert!((found - expected).abs() < 0.02, "{leak}: {found} is not {expected}");
            }
            let largest = expected.into_iter().fold(0.0, f64::max);
            let found = leak_r2(&fit, &score, &mut rng);
            assert!((found - largest).abs() < 0.02, "{leak}: {found} is not {largest}");
        }
    }

    #[test]
    fn the_same_seed_finds_the_same_leak() {
        let (fit, score) = (planted("linear", 0, 500), planted("linear", 500, 600));
        let found = |seed| leak_r2(&fit, &score, &mut ChaCha8Rng::seed_from_u64(seed));
        assert_eq!(found(1), found(1));
        assert_ne!(found(1), found(2));
    }

    #[test]
    fn no_manner_and_a_task_that_never_varies_leak_nothing() {
        let mut encodings = planted("linear", 0, 50);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        encodings.w.iter_mut().for_each(|w| *w = vec![0.5]);
        assert_eq!(leak_r2(&encodings, &encodings, &mut rng), 0.0);
        encodings.h.iter_mut().for_each(Vec::clear);
        assert_eq!(leak_r2(&encodings, &encodings, &mut rng), 0.0);
    }

    #[test]
    fn r2_is_one_for_exact_and_nothing_for_the_mean() {
        assert_eq!(r2(&[1.0, 2.0, 3.0], &[1.0, 2.0, 3.0]), Some(1.0));
        assert_eq!(r2(&[2.0, 2.0, 2.0], &[1.0, 2.0, 3.0]), Some(0.0));
        assert_eq!(r2(&[2.0], &[2.0]), None);
    }
}
