//! Whether each manner parameter means one thing: DCI (Eastwood and Williams, ICLR 2018) and MIG
//! (Chen et al., NeurIPS 2018) against the factors that a task measures.
//!
//! Importances are those of permutation: how much worse a random forest predicts a factor when one
//! manner parameter is exchanged between cases. Unlike the forest's own importances they are
//! measured on cases that it was not fitted to.

use rand::seq::SliceRandom;
use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};
use smartcore::ensemble::random_forest_regressor::{
    RandomForestRegressor, RandomForestRegressorParameters,
};
use smartcore::linalg::basic::matrix::DenseMatrix;

use super::leak::r2;

/// Trees of a forest.
const TREES: usize = 50;
/// Fewest cases in a leaf.
const LEAF: usize = 5;
/// Times that a manner parameter is exchanged, to average what that costs.
const EXCHANGES: usize = 5;
/// Bins of a value, of equally many cases, for the mutual information.
const BINS: usize = 10;

/// How manner parameters and factors belong together.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Disentanglement {
    /// Names of the factors.
    pub factors: Vec<String>,
    /// R2 with which all manner parameters together predict each factor, floored at 0: DCI's
    /// informativeness.
    pub informativeness: Vec<f64>,
    /// For each manner parameter its share in the prediction of each factor; the shares of a factor
    /// add up to 1, or to 0 where nothing predicts it.
    pub importance: Vec<Vec<f64>>,
    /// How near each manner parameter is to serving one factor alone, weighted by how much it
    /// serves at all: 1 where each does, 0 where each serves all alike.
    pub disentanglement: f64,
    /// How near each factor is to being served by one manner parameter alone, mean over factors.
    pub completeness: f64,
    /// Mutual information gap: how much more of a factor's entropy its best manner parameter tells
    /// than its second best, mean over factors.
    pub mig: f64,
}

/// Manner parameters and factors of the same cases.
#[derive(Debug, Clone, Copy)]
pub struct Cases<'a> {
    /// One manner each, all of one length.
    pub h: &'a [Vec<f64>],
    /// One list of factors each, all of one length.
    pub factors: &'a [Vec<f64>],
}

/// Measures how manner parameters and factors belong together: forests are fitted on one set of
/// cases, everything is measured on another.
///
/// # Panics
/// When a set is empty, or its manners, or factors, differ in length.
pub fn disentanglement<R: Rng + ?Sized>(
    names: &[impl AsRef<str>],
    fit: Cases<'_>,
    held_out: Cases<'_>,
    rng: &mut R,
) -> Disentanglement {
    let (latents, factors) = (fit.h[0].len(), names.len());
    let column = |rows: &[Vec<f64>], i: usize| rows.iter().map(|row| row[i]).collect::<Vec<_>>();
    let mut importance = vec![vec![0.0; factors]; latents];
    let mut informativeness = vec![0.0; factors];
    let mut gaps = Vec::with_capacity(factors);
    for j in 0..factors {
        let truth = column(held_out.factors, j);
        let shares = importances(fit, &column(fit.factors, j), held_out, &truth, rng);
        informativeness[j] = shares.r2;
        let total: f64 = shares.of_latents.iter().sum();
        if total > 0.0 {
            for (row, share) in importance.iter_mut().zip(&shares.of_latents) {
                row[j] = share / total;
            }
        }
        let information: Vec<f64> =
            (0..latents).map(|i| mutual_information(&column(held_out.h, i), &truth)).collect();
        gaps.push(gap(&information, entropy(&truth)));
    }
    let (mut disentanglement, mut weight) = (0.0, 0.0);
    for row in &importance {
        let sum: f64 = row.iter().sum();
        disentanglement += sum * concentration(row);
        weight += sum;
    }
    let of_factor = |j| concentration(&column(&importance, j));
    Disentanglement {
        factors: names.iter().map(|name| name.as_ref().to_owned()).collect(),
        completeness: mean(&(0..factors).map(of_factor).collect::<Vec<_>>()),
        disentanglement: if weight > 0.0 { disentanglement / weight } else { 0.0 },
        mig: mean(&gaps),
        informativeness,
        importance,
    }
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// One minus the entropy of the shares, in units of the largest there can be; 0 for no shares.
fn concentration(shares: &[f64]) -> f64 {
    let total: f64 = shares.iter().sum();
    if total <= 0.0 || shares.len() < 2 {
        return if total > 0.0 { 1.0 } else { 0.0 };
    }
    let term =
        |share: &f64| if *share > 0.0 { -(share / total) * (share / total).ln() } else { 0.0 };
    1.0 - shares.iter().map(term).sum::<f64>() / (shares.len() as f64).ln()
}

struct Importances {
    /// R2 of the prediction from all manner parameters, floored at 0.
    r2: f64,
    /// Loss of R2 when one of them is exchanged between cases, floored at 0.
    of_latents: Vec<f64>,
}

fn importances<R: Rng + ?Sized>(
    fit: Cases<'_>,
    target: &Vec<f64>,
    held_out: Cases<'_>,
    truth: &[f64],
    rng: &mut R,
) -> Importances {
    let latents = fit.h[0].len();
    let matrix = |rows: &[Vec<f64>]| {
        DenseMatrix::from_2d_vec(&rows.to_vec()).expect("manners of one length")
    };
    let parameters = RandomForestRegressorParameters::default()
        .with_n_trees(TREES)
        .with_min_samples_leaf(LEAF)
        .with_m(latents)
        .with_seed(rng.random());
    let forest = RandomForestRegressor::fit(&matrix(fit.h), target, parameters)
        .expect("as many manners as factors");
    let score = |h: &[Vec<f64>]| {
        let predicted: Vec<f64> = forest.predict(&matrix(h)).expect("manners of the same length");
        r2(&predicted, truth).unwrap_or(0.0)
    };
    let whole = score(held_out.h);
    let exchanged = |i: usize| {
        let mut lost = 0.0;
        for _ in 0..EXCHANGES {
            let mut order: Vec<usize> = (0..held_out.h.len()).collect();
            order.shuffle(rng);
            let mut h = held_out.h.to_vec();
            for (row, &other) in h.iter_mut().zip(&order) {
                row[i] = held_out.h[other][i];
            }
            lost += (whole - score(&h)) / EXCHANGES as f64;
        }
        lost.max(0.0)
    };
    let of_latents = match whole > 0.0 {
        true => (0..latents).map(exchanged).collect(),
        false => vec![0.0; latents],
    };
    Importances { r2: whole.max(0.0), of_latents }
}

/// The bin of each value; bins hold equally many values, and equal values share one.
fn bins(values: &[f64]) -> Vec<usize> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let edges: Vec<f64> = (1..BINS).map(|i| sorted[i * sorted.len() / BINS]).collect();
    values.iter().map(|v| edges.partition_point(|edge| edge <= v)).collect()
}

fn entropy(values: &[f64]) -> f64 {
    mutual_information(values, values)
}

/// Mutual information of two values, each in bins (nat).
fn mutual_information(a: &[f64], b: &[f64]) -> f64 {
    let n = a.len() as f64;
    let mut joint = [[0.0_f64; BINS]; BINS];
    for (i, j) in bins(a).into_iter().zip(bins(b)) {
        joint[i][j] += 1.0 / n;
    }
    let rows = joint.map(|row| row.iter().sum::<f64>());
    let mut information = 0.0;
    for j in 0..BINS {
        let column: f64 = joint.iter().map(|row| row[j]).sum();
        for (i, row) in joint.iter().enumerate().filter(|(_, row)| row[j] > 0.0) {
            information += row[j] * (row[j] / (rows[i] * column)).ln();
        }
    }
    information
}

/// The gap between the largest and the second largest, as a share of the entropy.
fn gap(information: &[f64], entropy: f64) -> f64 {
    let mut sorted = information.to_vec();
    sorted.sort_by(|a, b| b.total_cmp(a));
    match (sorted.as_slice(), entropy > 0.0) {
        ([first, second, ..], true) => (first - second) / entropy,
        ([first], true) => first / entropy,
        _ => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;

    use super::super::leak::tests::uniform;
    use super::*;

    /// Cases as `tests/golden/evaluation.py` plants them.
    fn planted(kind: &str, from: u64, to: u64) -> [Vec<Vec<f64>>; 2] {
        let (mut manners, mut factors) = (Vec::new(), Vec::new());
        for i in from..to {
            let u: Vec<f64> = (0..8).map(|k| uniform(8 * i + k)).collect();
            let v = vec![u[0], u[1], u[2]];
            let noise = [0.1 * (u[3] - 0.5), 0.1 * (u[4] - 0.5), 0.1 * (u[5] - 0.5)];
            manners.push(match kind {
                "separate" => vec![v[1] + noise[0], -v[0] + noise[1], v[2].powi(2), u[6]],
                "mixed" => {
                    let (c, s) = (0.8, 0.6);
                    vec![c * v[0] - s * v[1], s * v[0] + c * v[1] + noise[0], v[2], u[6]]
                }
                "shared" => vec![v[0] + v[1] + v[2], u[5], u[6], u[7]],
                _ => panic!("unknown kind {kind}"),
            });
            factors.push(v);
        }
        [manners, factors]
    }

    fn measured(kind: &str) -> Disentanglement {
        let ([h, factors], [held_h, held_factors]) =
            (planted(kind, 0, 2000), planted(kind, 2000, 3000));
        disentanglement(
            &["a", "b", "c"],
            Cases { h: &h, factors: &factors },
            Cases { h: &held_h, factors: &held_factors },
            &mut ChaCha8Rng::seed_from_u64(1),
        )
    }

    #[test]
    fn planted_factors_are_found_as_scikit_learn_finds_them() {
        #[derive(serde::Deserialize)]
        struct Golden {
            disentanglement: BTreeMap<String, Expected>,
        }
        #[derive(serde::Deserialize)]
        struct Expected {
            informativeness: Vec<f64>,
            disentanglement: f64,
            completeness: f64,
            mig: f64,
        }
        let golden: Golden =
            serde_json::from_str(include_str!("../../tests/golden/evaluation.json")).unwrap();
        assert_eq!(golden.disentanglement.len(), 3);
        for (kind, expected) in golden.disentanglement {
            let found = measured(&kind);
            let near = |name: &str, found: f64, expected: f64, limit: f64| {
                assert!((found - expected).abs() < limit, "{kind}: {name} {found} {expected}");
            };
            for (found, expected) in found.informativeness.iter().zip(&expected.informativeness) {
                near("informativeness", *found, *expected, 0.02);
            }
            near("disentanglement", found.disentanglement, expected.disentanglement, 0.03);
            near("completeness", found.completeness, expected.completeness, 0.03);
            near("mig", found.mig, expected.mig, 1e-9);
        }
    }

    #[test]
    fn one_parameter_for_each_factor_is_disentangled_and_one_for_all_is_not() {
        let separate = measured("separate");
        assert!(separate.disentanglement > 0.95 && separate.mig > 0.4, "{separate:?}");
        assert!(separate.importance[1][0] > 0.98 && separate.importance[3][0] < 0.02);
        let shared = measured("shared");
        assert!(shared.disentanglement < 0.1 && shared.completeness > 0.9, "{shared:?}");
    }

    #[test]
    fn nothing_that_predicts_is_no_disentanglement() {
        let rows = vec![vec![0.0, 0.0]; 20];
        let cases = Cases { h: &rows, factors: &rows };
        let found = disentanglement(&["a", "b"], cases, cases, &mut ChaCha8Rng::seed_from_u64(1));
        assert_eq!((found.disentanglement, found.completeness, found.mig), (0.0, 0.0, 0.0));
    }
}
