//! `tcvae evaluate`: both of the paper's metrics, and beside them what tells whether they mean
//! anything.

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::{Context, ensure};
use clap::Args;
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;

use tcvae::artifact::{Artifact, Learned, ModelDocument, TcVaeDocument};
use tcvae::demonstrations::{Demonstration, Splits};
use tcvae::evaluation::disentanglement::Disentanglement;
use tcvae::evaluation::manner::{described, manner_effects};
use tcvae::evaluation::{
    self, Calibration, CaseOutcome, Evaluation, EvaluationOptions, ModelEvaluation,
    PrimitiveEvaluation, PriorScores, Score, evaluate_cases, evaluate_primitive_cases,
};
use tcvae::model::{Backend, Recogniser};

use super::sources::{Copies, Recordings};
use super::{ExitStatus, print_json, print_line};

/// Seed of an evaluation where none is given.
pub(crate) const DEFAULT_SEED: u64 = 0;

/// Arguments of `tcvae evaluate`.
#[derive(Debug, Args)]
pub(crate) struct EvaluateArgs {
    /// Model file
    model: PathBuf,
    /// Folder with the data, such as `tcvae simulate` writes; a fifth of the demonstrations in
    /// recordings is tested on, the same fifth that a training on them holds out
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// The robot that was recorded; Baxter without it
    #[arg(long, value_name = "F.toml")]
    robot: Option<PathBuf>,
    /// Seed of every random draw of the evaluation
    #[arg(long, default_value_t = DEFAULT_SEED)]
    seed: u64,
    /// Print the answer as JSON
    #[arg(long)]
    pub(crate) json: bool,
}

pub(crate) fn run(args: EvaluateArgs) -> anyhow::Result<ExitStatus> {
    let EvaluateArgs { model, data, robot, seed, json } = args;
    let artifact = Artifact::load(&model).with_context(|| model.display().to_string())?;
    let recordings = Recordings { paths: vec![data], robot, ..Recordings::default() };
    let ModelDocument { learned, task, task_space, .. } = &artifact.document;
    let copies = match learned {
        Learned::TcVae(_) => Copies::Made,
        Learned::Classical(_) => Copies::LeftOut,
    };
    let data = recordings.data(Some(task), copies)?;
    let (of_model, of_data) = (task.task().name(), data.task.task().name());
    ensure!(
        of_model == of_data,
        "{} is a model of {of_model} and the data is of {of_data}; evaluate it on {of_model}",
        model.display()
    );
    let evaluation = measure(&artifact, &data.splits, data.digest, seed)?;
    if json {
        print_json(&evaluation);
    } else {
        print_line(&match &evaluation {
            ModelEvaluation::TcVae(evaluation) => {
                let latents = artifact.primitive().manner_space().dim();
                table(evaluation, latents, &task_space.unit)
            }
            ModelEvaluation::Classical(evaluation) => {
                classical_table(evaluation, learned.name(), &task_space.unit)
            }
        });
    }
    Ok(ExitStatus::Done)
}

/// Measures a model by its own task at its task's thresholds.
pub(crate) fn measure(
    artifact: &Artifact,
    splits: &Splits,
    data_digest: String,
    seed: u64,
) -> anyhow::Result<ModelEvaluation> {
    Ok(measure_cases(artifact, splits, data_digest, seed)?.0)
}

/// [`measure`], with what came of every test case.
pub(crate) fn measure_cases(
    artifact: &Artifact,
    splits: &Splits,
    data_digest: String,
    seed: u64,
) -> anyhow::Result<(ModelEvaluation, Vec<CaseOutcome>)> {
    let ModelDocument { learned, task, duration_secs, .. } = &artifact.document;
    let (primitive, model_id) = (artifact.primitive(), artifact.model_id());
    let (thresholds, duration_secs) = (task.thresholds().to_vec(), *duration_secs);
    let task = task.task();
    Ok(match learned {
        Learned::TcVae(TcVaeDocument { model, normalizer, .. }) => {
            let weights = artifact.weights();
            let recogniser = Recogniser::new(model, normalizer, weights, Backend::default())?;
            let options = EvaluationOptions {
                thresholds,
                duration_secs,
                seed,
                ..EvaluationOptions::default()
            };
            let (measured, outcomes) =
                evaluate_cases(&*primitive, &recogniser, task, splits, &options)?;
            let measured = Evaluation { model_id, data_digest, ..measured };
            (ModelEvaluation::TcVae(measured), outcomes)
        }
        Learned::Classical(_) => {
            let cases = &splits.test;
            let (measured, outcomes) =
                evaluate_primitive_cases(&*primitive, task, cases, &thresholds, duration_secs)?;
            let measured = PrimitiveEvaluation { seed, model_id, data_digest, ..measured };
            (ModelEvaluation::Classical(measured), outcomes)
        }
    })
}

/// Adds to a freshly trained model what each of its manner parameters does, where it has any.
pub(crate) fn add_names(artifact: &mut Artifact, splits: &Splits) {
    let primitive = artifact.primitive();
    let ModelDocument { learned, task, duration_secs, .. } = &mut artifact.document;
    let Learned::TcVae(TcVaeDocument { latents, manner_space, .. }) = learned else { return };
    let active: Vec<bool> =
        latents.iter().map(|latent| latent.kl > evaluation::ACTIVE_KL_NATS).collect();
    let tasks: Vec<_> = splits.train.iter().map(|d| d.w.clone()).collect();
    let mut rng = ChaCha8Rng::seed_from_u64(DEFAULT_SEED);
    let effects = manner_effects(&*primitive, task.task(), &tasks, *duration_secs, &mut rng);
    *manner_space = described(manner_space, &effects, &active);
}

/// Adds to a freshly trained model what makes its deviations fit the validation part.
pub(crate) fn calibrate(
    artifact: &mut Artifact,
    validation: &[Demonstration],
) -> anyhow::Result<()> {
    let primitive = artifact.primitive();
    let Learned::TcVae(TcVaeDocument { model, normalizer, .. }) = &artifact.document.learned else {
        return Ok(());
    };
    let recogniser = Recogniser::new(model, normalizer, artifact.weights(), Backend::default())?;
    let scale = evaluation::deviation_scale(&*primitive, &recogniser, validation);
    if let Learned::TcVae(document) = &mut artifact.document.learned {
        document.deviation_scale = scale;
    }
    Ok(())
}

/// What both tables begin with: what was measured on what, shares of the test cases, and the bounds
/// of validity that motions break.
struct Head<'a> {
    model: &'a str,
    data_digest: &'a str,
    cases: usize,
    seed: u64,
    unit: &'a str,
    /// Names with a score for each threshold.
    rows: &'a [(&'a str, &'a [Score])],
    broken_bounds: &'a BTreeMap<String, f64>,
}

impl Head<'_> {
    fn lines(&self) -> Vec<String> {
        let Self { model, data_digest, cases, seed, unit, rows, broken_bounds } = self;
        let unit = if *unit == "1" { String::new() } else { format!(" {unit}") };
        let head = |score: &Score| format!("{:<24}", format!("within {}{unit}", score.threshold));
        let thresholds = rows.first().map_or(&[][..], |(_, scores)| scores);
        let mut lines = vec![
            format!(
                "{model} on data {}: {cases} test cases, seed {seed}",
                data_digest.get(..12).unwrap_or(data_digest)
            ),
            String::new(),
            format!("{:<22}{}", "", thresholds.iter().map(head).collect::<String>()),
        ];
        lines.extend(rows.iter().map(|(name, scores)| row(name, scores)));
        if !broken_bounds.is_empty() {
            let mut broken: Vec<_> = broken_bounds.iter().collect();
            broken.sort_by(|a, b| b.1.total_cmp(a.1));
            let told: Vec<_> =
                broken.iter().map(|(bound, share)| format!("{bound} {share:.3}")).collect();
            lines.push(format!("{:<22}{}", "broken bounds", told.join(", ")));
        }
        lines
    }
}

/// A measure with its score at each threshold.
fn row(name: &str, scores: &[Score]) -> String {
    let cell = |Score { threshold: _, mean, low, high }: &Score| {
        format!("{:<24}", format!("{mean:.3} [{low:.3}, {high:.3}]"))
    };
    format!("{name:<22}{}", scores.iter().map(cell).collect::<String>())
}

fn joined(lines: &[String]) -> String {
    lines.iter().map(|line| line.trim_end()).collect::<Vec<_>>().join("\n")
}

/// The evaluation of a classical primitive as a person reads it.
fn classical_table(evaluation: &PrimitiveEvaluation, name: &str, unit: &str) -> String {
    let PrimitiveEvaluation {
        success,
        success_and_valid,
        broken_bounds,
        median_task_error,
        reconstruction_rmse,
        cases,
        seed,
        model_id,
        data_digest,
    } = evaluation;
    let head = Head {
        model: &format!("{name} {model_id}"),
        data_digest,
        cases: *cases,
        seed: *seed,
        unit,
        rows: &[("success", success), ("success and valid", success_and_valid)],
        broken_bounds,
    };
    let mut lines = head.lines();
    let error = match median_task_error {
        Some(error) => format!("{error:.4}"),
        None => "most motions don't show the task".into(),
    };
    lines.extend([
        String::new(),
        format!("{:<22}{error}", "median task error"),
        format!("{:<22}{reconstruction_rmse:.4}", "reconstruction rmse"),
        format!("{:<22}none: one motion for each task", "manner parameters"),
    ]);
    joined(&lines)
}

/// The evaluation as a person reads it: never one of the two metrics without its companions.
fn table(evaluation: &Evaluation, latents: usize, unit: &str) -> String {
    let Evaluation {
        success,
        robustness,
        robust_and_valid,
        broken_bounds,
        with_standard_normal_prior,
        active_latents,
        reconstruction_rmse,
        leak_r2,
        swap,
        calibration,
        disentanglement,
        cases,
        seed,
        model_id,
        data_digest,
    } = evaluation;
    let head = Head {
        model: &format!("model {model_id}"),
        data_digest,
        cases: *cases,
        seed: *seed,
        unit,
        rows: &[
            ("success", success),
            ("robustness", robustness),
            ("robust and valid", robust_and_valid),
        ],
        broken_bounds,
    };
    let mut lines = head.lines();
    if let Some(PriorScores { robustness, robust_and_valid }) = with_standard_normal_prior {
        lines.push("with latents of N(0, I) instead of the learned prior's:".into());
        lines.push(row("robustness", robustness));
        lines.push(row("robust and valid", robust_and_valid));
    }
    lines.extend([
        String::new(),
        format!("{:<22}{active_latents} of {latents}", "active latents"),
        format!("{:<22}{reconstruction_rmse:.4}", "reconstruction rmse"),
        format!("{:<22}{leak_r2:.3}", "leak of the task, R2"),
        format!("{:<22}{swap:.3}", "swap, middle distance"),
    ]);
    if let Some(Calibration {
        within_one,
        within_two,
        rms,
        position_in_band,
        orientation_in_band,
    }) = calibration
    {
        lines.push(format!(
            "{:<22}{within_one:.3} within 1 deviation (normal: 0.683), {within_two:.3} within 1.96 \
             (0.950), rms {rms:.2} (1)",
            "calibration"
        ));
        if let Some((positions, orientations)) = position_in_band.zip(*orientation_in_band) {
            lines.push(format!(
                "{:<22}{positions:.3} of the positions, {orientations:.3} of the orientations (0.950)",
                "inside the band"
            ));
        }
    }
    if let Some(measured) = disentanglement {
        let Disentanglement { disentanglement, completeness, mig, informativeness, .. } = measured;
        lines.push(format!(
            "{:<22}{disentanglement:.3}, completeness {completeness:.3}, MIG {mig:.3}",
            "disentanglement (DCI)"
        ));
        let told = measured.factors.iter().zip(informativeness);
        let told: Vec<_> = told.map(|(factor, r2)| format!("{factor} {r2:.2}")).collect();
        lines.push(format!("{:<22}{}", "R2 of factors from h", told.join(", ")));
    }
    joined(&lines)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scores(mean: f64) -> Vec<Score> {
        let score = |threshold| Score { threshold, mean, low: mean - 0.01, high: mean + 0.01 };
        vec![score(0.01), score(0.02)]
    }

    #[test]
    fn the_table_of_a_classical_primitive_shows_what_there_is() {
        let mut evaluation = PrimitiveEvaluation {
            success: scores(0.9),
            success_and_valid: scores(0.8),
            broken_bounds: BTreeMap::from([("tilt".into(), 0.1)]),
            median_task_error: Some(0.004321),
            reconstruction_rmse: 0.1,
            cases: 42,
            seed: 0,
            model_id: "0123456789ab".into(),
            data_digest: "fedcba9876543210".into(),
        };
        assert_eq!(
            classical_table(&evaluation, "TP-GMM", "m"),
            "\
TP-GMM 0123456789ab on data fedcba987654: 42 test cases, seed 0

                      within 0.01 m           within 0.02 m
success               0.900 [0.890, 0.910]    0.900 [0.890, 0.910]
success and valid     0.800 [0.790, 0.810]    0.800 [0.790, 0.810]
broken bounds         tilt 0.100

median task error     0.0043
reconstruction rmse   0.1000
manner parameters     none: one motion for each task"
        );
        evaluation.median_task_error = None;
        let table = classical_table(&evaluation, "TP-GMM", "m");
        assert!(table.contains("median task error     most motions don't show the task"));
    }

    #[test]
    fn the_table_shows_every_measure() {
        let mut evaluation = Evaluation {
            success: scores(0.9),
            robustness: scores(0.8),
            robust_and_valid: scores(0.7),
            broken_bounds: BTreeMap::from([("lift".into(), 0.01), ("tilt".into(), 0.09)]),
            with_standard_normal_prior: None,
            active_latents: 2,
            reconstruction_rmse: 0.01234,
            leak_r2: 0.05,
            swap: 0.65,
            calibration: None,
            disentanglement: None,
            cases: 42,
            seed: 7,
            model_id: "0123456789ab".into(),
            data_digest: "fedcba9876543210".into(),
        };
        assert_eq!(
            table(&evaluation, 4, "m"),
            "\
model 0123456789ab on data fedcba987654: 42 test cases, seed 7

                      within 0.01 m           within 0.02 m
success               0.900 [0.890, 0.910]    0.900 [0.890, 0.910]
robustness            0.800 [0.790, 0.810]    0.800 [0.790, 0.810]
robust and valid      0.700 [0.690, 0.710]    0.700 [0.690, 0.710]
broken bounds         tilt 0.090, lift 0.010

active latents        2 of 4
reconstruction rmse   0.0123
leak of the task, R2  0.050
swap, middle distance 0.650"
        );
        evaluation.calibration = Some(Calibration {
            within_one: 0.7,
            within_two: 0.96,
            rms: 0.9,
            position_in_band: Some(0.94),
            orientation_in_band: Some(0.97),
        });
        evaluation.disentanglement = Some(Disentanglement {
            factors: vec!["radius".into(), "span".into()],
            informativeness: vec![0.99, 0.9],
            importance: vec![vec![1.0, 0.0]],
            disentanglement: 0.8,
            completeness: 0.75,
            mig: 0.4,
        });
        let with_all = table(&evaluation, 4, "m");
        let lines: Vec<_> = with_all.lines().skip(12).collect();
        assert_eq!(
            lines,
            [
                "calibration           0.700 within 1 deviation (normal: 0.683), 0.960 within 1.96 \
                 (0.950), rms 0.90 (1)",
                "inside the band       0.940 of the positions, 0.970 of the orientations (0.950)",
                "disentanglement (DCI) 0.800, completeness 0.750, MIG 0.400",
                "R2 of factors from h  radius 0.99, span 0.90",
            ]
        );
        evaluation.with_standard_normal_prior =
            Some(PriorScores { robustness: scores(0.6), robust_and_valid: scores(0.5) });
        let with_both = table(&evaluation, 4, "m");
        let lines: Vec<_> = with_both.lines().skip(7).take(3).collect();
        assert_eq!(
            lines,
            [
                "with latents of N(0, I) instead of the learned prior's:",
                "robustness            0.600 [0.590, 0.610]    0.600 [0.590, 0.610]",
                "robust and valid      0.500 [0.490, 0.510]    0.500 [0.490, 0.510]",
            ]
        );
    }
}
