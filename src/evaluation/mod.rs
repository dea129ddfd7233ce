//! How good a model is: SUCCESS (eq. 15), ROBUSTNESS (eq. 16), and beside them the measures
//! without which neither means anything: active latents, reconstruction error, leak, validity.

mod calibration;
pub mod comparison;
pub mod disentanglement;
pub mod intervals;
pub mod leak;
pub mod manner;
#[cfg(test)]
mod oracles;
mod primitive;

pub use calibration::{Calibration, deviation_scale};
pub use primitive::{PrimitiveEvaluation, evaluate_primitive, evaluate_primitive_cases};

use std::collections::BTreeMap;

use rand::rngs::ChaCha8Rng;
use rand::seq::SliceRandom;
use rand::{Rng, RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use crate::demonstrations::{Demonstration, Splits, Task};
use crate::model::{Posterior, Recognition};
use crate::parameters::{MannerParameters, TaskParameters};
use crate::primitive::{MannerConditioned, MovementPrimitive};
use crate::trajectory::{Motion, Trajectory};
use calibration::Standardised;
use disentanglement::{Cases, Disentanglement, disentanglement};
use intervals::Share;
use leak::Encodings;

/// KL divergence from the prior above which a latent counts as active.
pub const ACTIVE_KL_NATS: f64 = 0.1;
/// Fewest encodings that the leak's probe is fitted on, and scored on.
const PROBE_ENCODINGS: [usize; 2] = [5000, 1000];
/// Fewest test cases that disentanglement is measured on.
const DISENTANGLEMENT_CASES: usize = 200;

/// A share of cases at one threshold, with its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// Largest distance that counts, in the task's unit.
    pub threshold: f64,
    /// Share of the cases.
    pub mean: f64,
    /// Lower end of the 95 % interval.
    pub low: f64,
    /// Upper end of the 95 % interval.
    pub high: f64,
}

/// The measured quality of a model; stored in the model file and printed by `evaluate --json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Evaluation {
    /// Share of test cases whose reconstruction from the posterior mean achieves its task (eq. 15).
    pub success: Vec<Score>,
    /// Share of prior samples that achieve the task of a test case (eq. 16).
    pub robustness: Vec<Score>,
    /// Share of prior samples that are robust and inside the task's validity bounds.
    pub robust_and_valid: Vec<Score>,
    /// Share of the prior samples that show the task and break a bound of validity, for each bound
    /// that any breaks.
    #[serde(default)]
    pub broken_bounds: BTreeMap<String, f64>,
    /// [`Self::robustness`] and [`Self::robust_and_valid`] with latents from N(0, I), for a model
    /// whose prior is a learned one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub with_standard_normal_prior: Option<PriorScores>,
    /// Latents whose mean KL on validation is above 0.1 nat.
    pub active_latents: usize,
    /// Root mean square error of the reconstruction over all steps and state values, in the
    /// state's own units.
    pub reconstruction_rmse: f64,
    /// R2 of a strong probe from sampled h to the best-predicted component of w, floored at 0.
    pub leak_r2: f64,
    /// Share of pairs whose manner, decoded at another case's task, achieves that task at the
    /// middle threshold.
    pub swap: f64,
    /// How well the predicted deviations fit the reconstruction's errors.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub calibration: Option<Calibration>,
    /// Whether each manner parameter means one thing; none with fewer than 200 test cases, on which
    /// it would be noise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub disentanglement: Option<Disentanglement>,
    /// Number of test cases.
    pub cases: usize,
    /// Seed of every random draw of the evaluation.
    pub seed: u64,
    /// The model that was evaluated: the first 12 digits of the SHA-256 over what it learned.
    pub model_id: String,
    /// SHA-256 over the data set.
    pub data_digest: String,
}

/// The measured quality of a model of either kind: what there is to measure depends on whether it
/// has manner parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
#[expect(clippy::large_enum_variant, reason = "a program has one or two of them")]
pub enum ModelEvaluation {
    /// Of a TC-VAE.
    TcVae(Evaluation),
    /// Of a classical primitive, which has no manner parameters.
    Classical(PrimitiveEvaluation),
}

impl ModelEvaluation {
    /// The evaluation of a TC-VAE; none of another primitive.
    pub fn tc_vae(&self) -> Option<&Evaluation> {
        match self {
            Self::TcVae(evaluation) => Some(evaluation),
            Self::Classical(_) => None,
        }
    }

    /// The evaluation of a classical primitive; none of a TC-VAE.
    pub fn classical(&self) -> Option<&PrimitiveEvaluation> {
        match self {
            Self::Classical(evaluation) => Some(evaluation),
            Self::TcVae(_) => None,
        }
    }
}

/// How robust samples are under another prior.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PriorScores {
    /// As [`Evaluation::robustness`].
    pub robustness: Vec<Score>,
    /// As [`Evaluation::robust_and_valid`].
    pub robust_and_valid: Vec<Score>,
}

/// How to evaluate.
#[derive(Debug, Clone, PartialEq)]
pub struct EvaluationOptions {
    /// Distances from the task that count as achieving it, ascending, in the task's unit.
    pub thresholds: Vec<f64>,
    /// Prior samples for each test case, the paper's K.
    pub samples_per_case: usize,
    /// Time that the motions of a primitive take which knows phases only; the median duration.
    pub duration_secs: f64,
    /// Seed of every random draw.
    pub seed: u64,
}

impl Default for EvaluationOptions {
    /// The paper's thresholds for arcs.
    fn default() -> Self {
        Self {
            thresholds: vec![0.025, 0.05, 0.1],
            samples_per_case: 20,
            duration_secs: 1.0,
            seed: 0,
        }
    }
}

/// What came of one test case, at each threshold; of a primitive without manner, whether it succeeds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CaseOutcome {
    /// 1 where the reconstruction achieves the task, else 0.
    pub success: Vec<f64>,
    /// Share of the prior samples that achieve it.
    pub robustness: Vec<f64>,
    /// Share of the prior samples that achieve it and are inside the bounds of validity.
    pub robust_and_valid: Vec<f64>,
}

/// Why a model can't be evaluated on data.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum EvaluationError {
    /// Too few demonstrations in a part of the data.
    #[error("the {split} part has {found} demonstrations; an evaluation needs at least {needed}")]
    TooFew {
        /// Name of the part.
        split: &'static str,
        /// Demonstrations that it has.
        found: usize,
        /// Demonstrations that it needs.
        needed: usize,
    },
    /// Model and data speak of different things.
    #[error(
        "demonstration {id} has {found} {values} where the model has {expected}; \
         evaluate on data of the model's task"
    )]
    Mismatch {
        /// The demonstration.
        id: String,
        /// What differs.
        values: &'static str,
        /// The demonstration's number.
        found: usize,
        /// The model's number.
        expected: usize,
    },
}

/// Measures a model on data (section 4 of the paper): it is fitted to the training part, active
/// latents are counted on the validation part, and everything else is measured on the test part;
/// the leak's probe is fitted on the training part. A posterior mean outside the manner's bounds
/// is served at the nearest bound.
///
/// `model_id` and `data_digest` are the caller's to fill in; here they are empty.
///
/// # Errors
/// Fewer than 2 test or 1 training and validation demonstrations; demonstrations whose states or
/// tasks have another dimension than the model's.
///
/// # Panics
/// When `options` has no threshold or no samples, or `recognition` does not answer for every
/// demonstration.
pub fn evaluate<M, R>(
    model: &M,
    recognition: &R,
    task: &dyn Task,
    splits: &Splits,
    options: &EvaluationOptions,
) -> Result<Evaluation, EvaluationError>
where
    M: MannerConditioned + ?Sized,
    R: Recognition + ?Sized,
{
    Ok(evaluate_cases(model, recognition, task, splits, options)?.0)
}

/// [`evaluate`], with what came of every test case, in their order.
///
/// # Errors
/// As [`evaluate`].
///
/// # Panics
/// As [`evaluate`].
pub fn evaluate_cases<M, R>(
    model: &M,
    recognition: &R,
    task: &dyn Task,
    splits: &Splits,
    options: &EvaluationOptions,
) -> Result<(Evaluation, Vec<CaseOutcome>), EvaluationError>
where
    M: MannerConditioned + ?Sized,
    R: Recognition + ?Sized,
{
    check(model, splits)?;
    let EvaluationOptions { thresholds, samples_per_case, duration_secs, seed } = options;
    assert!(!thresholds.is_empty() && *samples_per_case > 0, "nothing to measure");
    // Each measure draws from a stream of its own, so that none changes when another does.
    let stream = |number| {
        let mut rng = ChaCha8Rng::seed_from_u64(*seed);
        rng.set_stream(number);
        rng
    };
    let cases = &splits.test;
    let manners = manners(model, recognition, cases);
    let decode =
        |w: &TaskParameters, h: &MannerParameters| model.decode(w, h).motion(*duration_secs);
    let task_error = |w: &TaskParameters, motion: &Motion| match task.empirical_task(motion) {
        Ok(measured) => model.task_space().distance(&measured, w),
        Err(_) => f64::INFINITY,
    };

    let mut reconstruction_errors = Vec::with_capacity(cases.len());
    let mut square_error = 0.0;
    let mut standardised = Standardised::default();
    for (case, h) in cases.iter().zip(&manners) {
        let generated = model.decode(&case.w, h);
        standardised.add(&generated, &case.motion.states);
        let motion = generated.motion(*duration_secs);
        square_error += mean_square_difference(&motion.states, &case.motion.states);
        reconstruction_errors.push(task_error(&case.w, &motion));
    }
    let success = |&threshold: &f64| {
        score(threshold, intervals::wilson(share(&reconstruction_errors, threshold), cases.len()))
    };

    let sampled = |rng: &mut ChaCha8Rng, sample: &Sampler<'_>| -> Vec<PriorSamples> {
        let of_case = |case: &Demonstration| {
            let mut samples = PriorSamples::default();
            for _ in 0..*samples_per_case {
                let motion = sample(&case.w, rng);
                let error = task_error(&case.w, &motion);
                let broken = match error.is_finite() {
                    true => task.violations(&motion),
                    false => Vec::new(),
                };
                let valid = error.is_finite() && broken.is_empty();
                samples.errors.push(error);
                samples.valid_errors.push(if valid { error } else { f64::INFINITY });
                samples.broken.extend(broken.iter().map(|v| v.bound));
            }
            samples
        };
        cases.iter().map(of_case).collect()
    };
    let prior_scores = |samples: &[PriorSamples]| {
        // The same resamples for every threshold, so that the intervals are nested as the shares are.
        let clustered = |errors: fn(&PriorSamples) -> &[f64], &threshold: &f64| {
            let shares: Vec<f64> = samples.iter().map(|s| share(errors(s), threshold)).collect();
            score(threshold, intervals::cluster_bootstrap(&shares, &mut stream(2)))
        };
        let all = |errors| thresholds.iter().map(|t| clustered(errors, t)).collect();
        PriorScores { robustness: all(|s| &s.errors), robust_and_valid: all(|s| &s.valid_errors) }
    };
    let samples = sampled(&mut stream(1), &|w, rng| decode(w, &model.sample_manner(rng)));
    let PriorScores { robustness, robust_and_valid } = prior_scores(&samples);
    let with_standard_normal_prior = model.has_learned_prior().then(|| {
        prior_scores(&sampled(&mut stream(5), &|w, rng| {
            let latents: Vec<f64> =
                StandardNormal.sample_iter(rng).take(model.manner_space().dim()).collect();
            model.decode_latents(w, &latents).motion(*duration_secs)
        }))
    });

    let active = active_latents(&recognition.recognise(&splits.validation));

    let partners = derangement(cases.len(), &mut stream(3));
    let swap_threshold = thresholds[thresholds.len() / 2];
    let swap_errors: Vec<f64> = cases
        .iter()
        .zip(partners)
        .map(|(case, partner)| task_error(&case.w, &decode(&case.w, &manners[partner])))
        .collect();

    let mut rng = stream(4);
    let [fit, held_out] = [&splits.train, cases].map(|part| part.as_slice());
    let fit = encodings(recognition, fit, &active, PROBE_ENCODINGS[0], &mut rng);
    let held_out = encodings(recognition, held_out, &active, PROBE_ENCODINGS[1], &mut rng);

    let outcome = |(error, samples): (&f64, &PriorSamples)| {
        let shares = |errors: &[f64]| thresholds.iter().map(|t| share(errors, *t)).collect();
        CaseOutcome {
            success: shares(std::slice::from_ref(error)),
            robustness: shares(&samples.errors),
            robust_and_valid: shares(&samples.valid_errors),
        }
    };
    let outcomes = reconstruction_errors.iter().zip(&samples).map(outcome).collect();
    let evaluation = Evaluation {
        success: thresholds.iter().map(success).collect(),
        robustness,
        robust_and_valid,
        broken_bounds: broken_bounds(&samples),
        with_standard_normal_prior,
        active_latents: active.iter().filter(|a| **a).count(),
        reconstruction_rmse: (square_error / cases.len() as f64).sqrt(),
        leak_r2: leak::leak_r2(&fit, &held_out, &mut rng),
        swap: share(&swap_errors, swap_threshold),
        calibration: Some(standardised.calibration()),
        disentanglement: (cases.len() >= DISENTANGLEMENT_CASES)
            .then(|| disentangled(model, recognition, task, splits, &mut stream(6)))
            .flatten(),
        cases: cases.len(),
        seed: *seed,
        model_id: String::new(),
        data_digest: String::new(),
    };
    Ok((evaluation, outcomes))
}

/// Distances between prior samples' empirical task and their case's; infinite where there is none.
#[derive(Debug, Default)]
struct PriorSamples {
    errors: Vec<f64>,
    /// The same, infinite where a bound of validity is broken too.
    valid_errors: Vec<f64>,
    /// The bounds that are broken, as often as they are.
    broken: Vec<&'static str>,
}

/// Draws a motion for a task.
type Sampler<'a> = dyn Fn(&TaskParameters, &mut ChaCha8Rng) -> Motion + 'a;

fn broken_bounds(samples: &[PriorSamples]) -> BTreeMap<String, f64> {
    let count: usize = samples.iter().map(|s| s.errors.len()).sum();
    let mut shares = BTreeMap::new();
    for bound in samples.iter().flat_map(|s| &s.broken) {
        *shares.entry((*bound).to_owned()).or_insert(0.0) += 1.0 / count as f64;
    }
    shares
}

fn score(threshold: f64, Share { mean, low, high }: Share) -> Score {
    Score { threshold, mean, low, high }
}

/// Share of the errors that do not exceed the threshold.
fn share(errors: &[f64], threshold: f64) -> f64 {
    errors.iter().filter(|e| **e <= threshold).count() as f64 / errors.len() as f64
}

fn check<M: MannerConditioned + ?Sized>(model: &M, splits: &Splits) -> Result<(), EvaluationError> {
    let Splits { train, validation, test } = splits;
    for (split, part, needed) in
        [("training", train, 1), ("validation", validation, 1), ("test", test, 2)]
    {
        if part.len() < needed {
            return Err(EvaluationError::TooFew { split, found: part.len(), needed });
        }
        part.iter().try_for_each(|demonstration| check_same(model, demonstration))?;
    }
    Ok(())
}

/// Checks that the demonstration is of the model's task and states.
fn check_same<P: MovementPrimitive + ?Sized>(
    model: &P,
    Demonstration { id, w, motion, events: _ }: &Demonstration,
) -> Result<(), EvaluationError> {
    for (values, found, expected) in [
        ("values in a state", motion.states.dim(), model.state_dim()),
        ("task parameters", w.values().len(), model.task_space().dim()),
    ] {
        if found != expected {
            return Err(EvaluationError::Mismatch { id: id.clone(), values, found, expected });
        }
    }
    Ok(())
}

/// Mean square difference over all steps and values, the demonstration resampled to the model's
/// steps.
fn mean_square_difference(decoded: &Trajectory, demonstrated: &Trajectory) -> f64 {
    let demonstrated = demonstrated.resampled(decoded.steps());
    let pairs = decoded.values().iter().zip(demonstrated.values());
    pairs.map(|(a, b)| (a - b).powi(2)).sum::<f64>() / decoded.values().len() as f64
}

/// Manner parameters of posterior means.
fn manners<M, R>(model: &M, recognition: &R, cases: &[Demonstration]) -> Vec<MannerParameters>
where
    M: MannerConditioned + ?Sized,
    R: Recognition + ?Sized,
{
    let posteriors = recognition.recognise(cases);
    assert_eq!(posteriors.len(), cases.len(), "one posterior for each demonstration");
    posteriors.iter().map(|p| model.manner(&p.mean)).collect()
}

/// Manner parameters of posterior means against the task's factors, forests fitted on the training
/// part; none where a part shows no factors.
fn disentangled<M, R>(
    model: &M,
    recognition: &R,
    task: &dyn Task,
    splits: &Splits,
    rng: &mut ChaCha8Rng,
) -> Option<Disentanglement>
where
    M: MannerConditioned + ?Sized,
    R: Recognition + ?Sized,
{
    let mut names = Vec::new();
    let mut measured = |part: &[Demonstration]| {
        let (mut manners, mut factors) = (Vec::new(), Vec::new());
        for (demonstration, posterior) in part.iter().zip(recognition.recognise(part)) {
            let mut found = task.factors(&demonstration.motion);
            found.retain(|factor| !factor.derived);
            if !found.is_empty() {
                names = found.iter().map(|factor| factor.name.to_string()).collect();
                manners.push(model.manner(&posterior.mean).values().to_vec());
                factors.push(found.iter().map(|factor| factor.value).collect::<Vec<_>>());
            }
        }
        (manners, factors)
    };
    let ((h, factors), (test_h, test_factors)) = (measured(&splits.train), measured(&splits.test));
    (!h.is_empty() && !test_h.is_empty()).then(|| {
        let fit = Cases { h: &h, factors: &factors };
        disentanglement(&names, fit, Cases { h: &test_h, factors: &test_factors }, rng)
    })
}

/// Which latents carry information: mean KL divergence of their posteriors from the standard
/// normal prior above [`ACTIVE_KL_NATS`]. Empty without posteriors.
pub fn active_latents(posteriors: &[Posterior]) -> Vec<bool> {
    let latents = posteriors.first().map_or(0, |p| p.mean.len());
    let kl = |p: &Posterior, i: usize| {
        let (mean, log_variance) = (p.mean[i], p.log_variance[i]);
        0.5 * (mean * mean + log_variance.exp() - log_variance - 1.0)
    };
    let mean_kl = |i| posteriors.iter().map(|p| kl(p, i)).sum::<f64>() / posteriors.len() as f64;
    (0..latents).map(|i| mean_kl(i) > ACTIVE_KL_NATS).collect()
}

/// For each of `count` cases another one, none for itself: a random cycle through all of them.
fn derangement<R: Rng + ?Sized>(count: usize, rng: &mut R) -> Vec<usize> {
    let mut order: Vec<usize> = (0..count).collect();
    order.shuffle(rng);
    let mut partners = vec![0; count];
    for (place, &case) in order.iter().enumerate() {
        partners[case] = order[(place + 1) % count];
    }
    partners
}

/// At least `count` manners sampled from the demonstrations' posteriors, active latents only: one
/// for each demonstration, in turns where they are fewer than `count`.
fn encodings<R: Recognition + ?Sized, G: Rng + ?Sized>(
    recognition: &R,
    demonstrations: &[Demonstration],
    active: &[bool],
    count: usize,
    rng: &mut G,
) -> Encodings {
    let posteriors = recognition.recognise(demonstrations);
    let mut encodings = Encodings::default();
    while encodings.h.len() < count {
        for (demonstration, Posterior { mean, log_variance }) in
            demonstrations.iter().zip(&posteriors)
        {
            let mut sample = |i: usize| {
                mean[i] + (0.5 * log_variance[i]).exp() * rng.sample::<f64, _>(StandardNormal)
            };
            let h = (0..mean.len()).filter(|i| active[*i]).map(&mut sample).collect();
            encodings.h.push(h);
            encodings.w.push(demonstration.w.values().to_vec());
        }
    }
    encodings
}

#[cfg(test)]
mod tests {
    use super::oracles::{Oracle, exact_arc, exact_manner};
    use super::*;
    use crate::demonstrations::arcs::{Arc, ArcsSimulation, ArcsTask, simulate};

    fn arcs(count: usize) -> Splits {
        let simulation = ArcsSimulation { count, ..ArcsSimulation::default() };
        simulate(&simulation, &mut ChaCha8Rng::seed_from_u64(7)).splits
    }

    fn measure(oracle: &Oracle) -> Evaluation {
        let options = EvaluationOptions::default();
        evaluate(oracle, oracle, &ArcsTask::default(), &arcs(2000), &options).unwrap()
    }

    fn means(scores: &[Score]) -> Vec<f64> {
        assert!(scores.iter().all(|s| s.low <= s.mean && s.mean <= s.high));
        scores.iter().map(|s| s.mean).collect()
    }

    #[test]
    fn a_model_that_is_right_scores_so_in_everything() {
        let evaluation = measure(&Oracle::exact());
        assert_eq!(means(&evaluation.success), [1.0; 3]);
        assert_eq!(means(&evaluation.robustness), [1.0; 3]);
        assert_eq!(means(&evaluation.robust_and_valid), [1.0; 3]);
        assert_eq!(evaluation.active_latents, 3);
        assert!(evaluation.reconstruction_rmse < 1e-9);
        assert!(evaluation.leak_r2 < 0.02, "{}", evaluation.leak_r2);
        assert_eq!(evaluation.swap, 1.0);
        assert_eq!(evaluation.cases, 200);
        let Disentanglement { factors, disentanglement, informativeness, .. } =
            evaluation.disentanglement.unwrap();
        assert_eq!(factors, ["radius", "span", "start"]);
        assert!(disentanglement > 0.95, "{disentanglement}");
        assert!(informativeness.iter().all(|r2| *r2 > 0.97), "{informativeness:?}");
        // Wilson: 1 / (1 + z^2 / 200).
        assert!((evaluation.robustness[0].low - 0.981_154).abs() < 1e-5);
    }

    #[test]
    fn a_collapsed_model_scores_in_both_metrics_and_is_told_by_the_others() {
        let middle = |w: &[f64], _: &[f64]| exact_arc(w, &[0.0; 3]);
        let evaluation = measure(&Oracle::new(middle, |_| vec![0.0; 3], 0.0));
        assert_eq!(means(&evaluation.success), [1.0; 3]);
        assert_eq!(means(&evaluation.robustness), [1.0; 3]);
        assert_eq!(evaluation.active_latents, 0);
        assert!(evaluation.reconstruction_rmse > 0.1);
        assert_eq!(evaluation.leak_r2, 0.0);
    }

    #[test]
    fn a_model_that_keeps_the_task_in_its_manner_leaks_and_is_not_robust() {
        let decode = |_: &[f64], h: &[f64]| {
            let center = [0.5 + 0.289 * h[0], 0.5 + 0.289 * h[1]];
            exact_arc(&center, &[0.0, 0.0, h[2]])
        };
        let recognise = |arc: &Arc| {
            let [x, y] = arc.center;
            vec![(x - 0.5) / 0.289, (y - 0.5) / 0.289, exact_manner(arc)[2]]
        };
        let evaluation = measure(&Oracle::new(decode, recognise, -8.0));
        assert_eq!(means(&evaluation.success), [1.0; 3]);
        assert!(evaluation.leak_r2 > 0.98, "{}", evaluation.leak_r2);
        // The mean density of N(0.5, 0.289) on the unit interval is 0.916, so a disk of radius
        // 0.1 around a task holds 0.916^2 pi 0.1^2 of the samples.
        let Score { low, high, .. } = evaluation.robustness[2];
        assert!(low < 0.0264 && 0.0264 < high, "{low} {high}");
        assert!(evaluation.swap < 0.03);
    }

    #[test]
    fn a_motion_that_is_robust_but_none_of_the_task_counts_as_invalid() {
        let tiny = |w: &[f64], h: &[f64]| Arc { radius: 0.03, ..exact_arc(w, h) };
        let evaluation = measure(&Oracle::new(tiny, exact_manner, -8.0));
        assert_eq!(means(&evaluation.robustness), [1.0; 3]);
        assert_eq!(means(&evaluation.robust_and_valid), [0.0; 3]);
    }

    #[test]
    fn a_centre_beside_the_task_succeeds_at_the_thresholds_that_it_is_within() {
        let beside = |w: &[f64], h: &[f64]| exact_arc(&[w[0] + 0.03, w[1]], h);
        let evaluation = measure(&Oracle::new(beside, exact_manner, -8.0));
        assert_eq!(means(&evaluation.success), [0.0, 1.0, 1.0]);
        assert_eq!(means(&evaluation.robustness), [0.0, 1.0, 1.0]);
        assert!((evaluation.reconstruction_rmse - 0.03 / 2f64.sqrt()).abs() < 1e-9);
    }

    #[test]
    fn a_manner_that_misses_the_task_half_of_the_time_is_half_robust() {
        let decode =
            |w: &[f64], h: &[f64]| exact_arc(&[w[0] + if h[0] > 0.0 { 0.2 } else { 0.0 }, w[1]], h);
        let evaluation = measure(&Oracle::new(decode, exact_manner, -8.0));
        let Score { mean, low, high, .. } = evaluation.robustness[1];
        assert!(low < 0.5 && 0.5 < high && high - low < 0.04, "{mean} {low} {high}");
        assert!((evaluation.swap - 0.5).abs() < 0.12, "{}", evaluation.swap);
    }

    #[test]
    fn a_point_in_place_of_an_arc_achieves_nothing() {
        let point = |w: &[f64], h: &[f64]| Arc { radius: 0.0, ..exact_arc(w, h) };
        let evaluation = measure(&Oracle::new(point, exact_manner, -8.0));
        assert_eq!(means(&evaluation.success), [0.0; 3]);
        assert_eq!(means(&evaluation.robustness), [0.0; 3]);
        assert_eq!(means(&evaluation.robust_and_valid), [0.0; 3]);
    }

    #[test]
    fn the_seed_decides_every_draw() {
        let decode = |w: &[f64], h: &[f64]| exact_arc(&[w[0] + 0.05 * h[0], w[1]], h);
        let oracle = Oracle::new(decode, exact_manner, -1.0);
        let splits = arcs(300);
        let evaluate = |seed| {
            let options = EvaluationOptions { seed, ..EvaluationOptions::default() };
            evaluate(&oracle, &oracle, &ArcsTask::default(), &splits, &options).unwrap()
        };
        assert_eq!(evaluate(1), evaluate(1));
        assert_ne!(evaluate(1).robustness, evaluate(2).robustness);
    }

    #[test]
    fn latents_are_active_from_a_tenth_of_a_nat() {
        // KL of N(m, 1) from the prior is m^2 / 2.
        let posterior = |m: f64| Posterior { mean: vec![m, 0.0, 0.0], log_variance: vec![0.0; 3] };
        assert_eq!(active_latents(&[posterior(0.46)]), [true, false, false]);
        assert_eq!(active_latents(&[posterior(0.44)]), [false, false, false]);
        let narrow = Posterior { mean: vec![0.0; 2], log_variance: vec![-1.0, 0.1] };
        assert_eq!(active_latents(&[narrow]), [true, false]);
    }

    #[test]
    fn nobody_is_swapped_with_himself() {
        for count in [2, 3, 50] {
            let partners = derangement(count, &mut ChaCha8Rng::seed_from_u64(1));
            assert!(partners.iter().enumerate().all(|(i, &p)| i != p));
            let mut sorted = partners;
            sorted.sort_unstable();
            assert_eq!(sorted, (0..count).collect::<Vec<_>>());
        }
    }

    #[test]
    fn too_little_data_and_data_of_another_task_are_refused() {
        let oracle = Oracle::exact();
        let refusal = |splits: &Splits| {
            let options = EvaluationOptions::default();
            let task = ArcsTask::default();
            evaluate(&oracle, &oracle, &task, splits, &options).unwrap_err().to_string()
        };
        let mut splits = arcs(10);
        assert_eq!(
            refusal(&splits),
            "the test part has 1 demonstrations; an evaluation needs at least 2"
        );
        splits = arcs(20);
        splits.validation[1].motion.states = Trajectory::new(3, vec![0.0; 9]).unwrap();
        assert_eq!(
            refusal(&splits),
            "demonstration validation-00001 has 3 values in a state where the model has 2; \
             evaluate on data of the model's task"
        );
    }
}
