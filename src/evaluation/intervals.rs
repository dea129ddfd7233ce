//! 95 % intervals of shares: Wilson's where cases are independent, a cluster bootstrap where
//! several samples belong to one case.

use rand::{Rng, RngExt};

/// The 97.5 % quantile of the standard normal distribution.
const Z: f64 = 1.959_963_984_540_054;
/// Resamples of the bootstrap; the ends of the interval then stand on 50 resamples each.
pub(super) const RESAMPLES: usize = 2000;

/// A share with its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Share {
    /// The share.
    pub mean: f64,
    /// Lower end of the interval.
    pub low: f64,
    /// Upper end of the interval.
    pub high: f64,
}

/// Wilson's score interval of a share `mean` of `cases` independent cases (E. B. Wilson, *Probable
/// Inference, the Law of Succession, and Statistical Inference*, 1927).
pub fn wilson(mean: f64, cases: usize) -> Share {
    let n = cases as f64;
    let denominator = 1.0 + Z * Z / n;
    let middle = (mean + Z * Z / (2.0 * n)) / denominator;
    let half = Z / denominator * (mean * (1.0 - mean) / n + Z * Z / (4.0 * n * n)).sqrt();
    // At a share of 0 or 1 rounding can leave the share just outside its interval.
    Share { mean, low: (middle - half).clamp(0.0, mean), high: (middle + half).clamp(mean, 1.0) }
}

/// The percentile bootstrap over cases: `case_shares` are the shares of each case's samples, and
/// cases are drawn with replacement, since the samples of one case are not independent.
///
/// Equal cases have no spread to resample; Wilson's interval over the cases stands in for it, as
/// if all samples of a case were one.
pub fn cluster_bootstrap<R: Rng + ?Sized>(case_shares: &[f64], rng: &mut R) -> Share {
    let cases = case_shares.len();
    let mean = case_shares.iter().sum::<f64>() / cases as f64;
    if case_shares.windows(2).all(|pair| pair[0] == pair[1]) {
        return wilson(mean, cases);
    }
    let mut resample =
        |_| (0..cases).map(|_| case_shares[rng.random_range(0..cases)]).sum::<f64>() / cases as f64;
    interval(mean, (0..RESAMPLES).map(&mut resample).collect())
}

/// The mean with the middle 95 % of what resampling made of it.
pub(super) fn interval(mean: f64, mut resampled: Vec<f64>) -> Share {
    resampled.sort_by(f64::total_cmp);
    let quantile = |q: f64| resampled[(q * (resampled.len() - 1) as f64).round() as usize];
    Share { mean, low: quantile(0.025).min(mean), high: quantile(0.975).max(mean) }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;

    use super::*;

    #[derive(serde::Deserialize)]
    struct Golden {
        wilson: Vec<Wilson>,
    }

    #[derive(serde::Deserialize)]
    struct Wilson {
        hits: f64,
        cases: usize,
        interval: [f64; 2],
    }

    #[test]
    fn wilsons_interval_is_that_of_another_program() {
        let golden: Golden =
            serde_json::from_str(include_str!("../../tests/golden/evaluation.json")).unwrap();
        assert_eq!(golden.wilson.len(), 5);
        for Wilson { hits, cases, interval: [low, high] } in golden.wilson {
            let share = wilson(hits / cases as f64, cases);
            assert!((share.low - low).abs() < 1e-12, "{share:?}");
            assert!((share.high - high).abs() < 1e-12, "{share:?}");
        }
    }

    #[test]
    fn the_bootstrap_of_independent_cases_is_close_to_wilsons_interval() {
        let cases: Vec<f64> = (0..1000).map(|i| f64::from(i % 5 != 0)).collect();
        let bootstrap = cluster_bootstrap(&cases, &mut ChaCha8Rng::seed_from_u64(1));
        let wilson = wilson(0.8, 1000);
        assert!((bootstrap.mean - 0.8).abs() < 1e-12);
        assert!((bootstrap.low - wilson.low).abs() < 0.004, "{bootstrap:?} {wilson:?}");
        assert!((bootstrap.high - wilson.high).abs() < 0.004, "{bootstrap:?} {wilson:?}");
    }

    #[test]
    fn cases_whose_samples_agree_widen_the_interval() {
        // The same share of samples, once spread over all cases, once all or nothing.
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let spread: Vec<f64> = (0..100).map(|i| 0.5 + 0.05 * f64::from(i % 3 - 1)).collect();
        let clustered: Vec<f64> = (0..100).map(|i| f64::from(i % 2)).collect();
        let width = |share: Share| share.high - share.low;
        let spread = width(cluster_bootstrap(&spread, &mut rng));
        let clustered = width(cluster_bootstrap(&clustered, &mut rng));
        assert!(clustered > 5.0 * spread, "{clustered} {spread}");
    }

    #[test]
    fn a_perfect_score_is_not_certain() {
        let share = cluster_bootstrap(&[1.0; 42], &mut ChaCha8Rng::seed_from_u64(3));
        assert_eq!((share.mean, share.high), (1.0, 1.0));
        assert!(share.low < 0.92 && share.low > 0.9, "{share:?}");
    }
}
