//! The tables of a report.

use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use serde_json::json;

use tcvae::artifact::Learned;
use tcvae::evaluation::comparison::{Comparison, Outcomes};
use tcvae::evaluation::intervals::Share;
use tcvae::evaluation::{CaseOutcome, Evaluation, ModelEvaluation};
use tcvae::parameters::MannerAxis;
use tcvae::report::Block;
use tcvae::training::LatentStatistics;

use super::super::sources::Data;
use super::measures::Measured;
use super::{Deviation, Loaded, Paper, Part, Sources, TestSet};

/// A metric that every test case has a value of at each threshold.
#[derive(Clone, Copy)]
struct Metric {
    name: &'static str,
    of_case: fn(&CaseOutcome) -> &[f64],
    of_paper: fn(&Paper) -> &[f64],
}

const METRICS: [Metric; 3] = [
    Metric { name: "SUCCESS", of_case: |o| &o.success, of_paper: |p| &p.success },
    Metric { name: "ROBUSTNESS", of_case: |o| &o.robustness, of_paper: |p| &p.robustness },
    Metric { name: "R and valid", of_case: |o| &o.robust_and_valid, of_paper: |_| &[] },
];

/// What the models were trained on, with the counts of the paper's table 1 and the data's digest.
pub(super) fn demonstrations(sources: &Sources) -> Vec<Block> {
    let told = |data: &Data| format!("{}\ndata {:.12}", data.summary, data.digest);
    let mut told: Vec<_> = sources.data.values().map(told).collect();
    told.sort();
    told.dedup();
    told.into_iter().map(Block::Code).collect()
}

/// All tables of one test set.
pub(super) fn of_test(
    part: &Part,
    test: &TestSet,
    rows: &[Loaded<'_>],
    measured: &[Vec<Measured>],
    seed: u64,
) -> Vec<Block> {
    let (digest, cases, success) = match &measured[0][0].evaluation {
        ModelEvaluation::TcVae(e) => (&e.data_digest, e.cases, &e.success),
        ModelEvaluation::Classical(e) => (&e.data_digest, e.cases, &e.success),
    };
    let digest = digest.get(..12).unwrap_or(digest);
    let about = format!("{}, {}: {cases} cases, data {digest}", part.title, test.name);
    let mut columns = Vec::new();
    for metric in METRICS {
        for (i, score) in success.iter().enumerate() {
            columns.extend(Column::new(metric, score.threshold, i, measured, seed));
        }
    }
    let mut blocks = vec![scores_table(&about, rows, &columns), companions(&about, rows, measured)];
    blocks.extend(differences(&about, part, rows, &columns));
    blocks
}

/// One metric at one threshold.
struct Column {
    metric: Metric,
    threshold: f64,
    /// Place of the threshold among all.
    place: usize,
    comparison: Comparison,
    /// Place of each row in the comparison; none for a row without the metric.
    compared: Vec<Option<usize>>,
}

impl Column {
    /// None where no row has the metric.
    fn new(
        metric: Metric,
        threshold: f64,
        place: usize,
        measured: &[Vec<Measured>],
        seed: u64,
    ) -> Option<Self> {
        let mut outcomes: Vec<Outcomes> = Vec::new();
        let mut compared = Vec::new();
        for row in measured {
            let of_seed = |m: &Measured| -> Option<Vec<f64>> {
                m.outcomes.iter().map(|o| (metric.of_case)(o).get(place).copied()).collect()
            };
            let of_row: Option<Outcomes> = row.iter().map(of_seed).collect();
            compared.push(of_row.is_some().then_some(outcomes.len()));
            outcomes.extend(of_row);
        }
        if outcomes.is_empty() {
            return None;
        }
        let comparison = Comparison::new(&outcomes, &mut ChaCha8Rng::seed_from_u64(seed));
        Some(Self { metric, threshold, place, comparison, compared })
    }

    fn head(&self) -> String {
        format!("{} @ {}", self.metric.name, self.threshold)
    }

    fn mean(&self, row: usize) -> String {
        self.compared[row].map_or("-".into(), |row| share(self.comparison.mean(row)))
    }

    fn difference(&self, row: usize, other: usize) -> String {
        match (self.compared[row], self.compared[other]) {
            (Some(a), Some(b)) => share(self.comparison.difference(a, b)),
            _ => "-".into(),
        }
    }
}

/// The paper's table 2 beside ours.
fn scores_table(about: &str, rows: &[Loaded<'_>], columns: &[Column]) -> Block {
    let mut lines = Vec::new();
    for (i, row) in rows.iter().enumerate() {
        let cells = columns.iter().map(|column| column.mean(i));
        let seeds = match row.models.len() {
            1 => "1 seed".to_owned(),
            count => format!("{count} seeds"),
        };
        let name = format!("{}\n({seeds})", row.config.name);
        lines.push([name].into_iter().chain(cells).collect());
        if let Some(paper) = &row.config.paper {
            let cell = |column: &Column| {
                let value = (column.metric.of_paper)(paper).get(column.place);
                value.map_or("-".into(), |value| number(*value))
            };
            let name = "- in the paper".to_owned();
            lines.push([name].into_iter().chain(columns.iter().map(cell)).collect());
        }
    }
    let heads = columns.iter().map(Column::head);
    Block::Table {
        caption: format!(
            "{about}. Shares with 95 % intervals: paired bootstrap, clustered by seed and test case"
        ),
        head: ["model".to_owned()].into_iter().chain(heads).collect(),
        rows: lines,
    }
}

/// What no share may be read without.
fn companions(about: &str, rows: &[Loaded<'_>], measured: &[Vec<Measured>]) -> Block {
    let line = |(row, measured): (&Loaded<'_>, &Vec<Measured>)| {
        let all = |of: &dyn Fn(&Evaluation) -> Option<f64>| {
            let values = measured.iter().filter_map(Measured::with_manner).filter_map(of);
            spread(&values.collect::<Vec<_>>())
        };
        let rmse: Vec<f64> = measured
            .iter()
            .map(|m| match &m.evaluation {
                ModelEvaluation::TcVae(e) => e.reconstruction_rmse,
                ModelEvaluation::Classical(e) => e.reconstruction_rmse,
            })
            .collect();
        let active = match row.models[0].primitive().manner_space().dim() {
            0 => "no manner".into(),
            latents => format!("{} of {latents}", all(&|e| Some(e.active_latents as f64))),
        };
        vec![
            row.config.name.clone(),
            active,
            spread(&rmse),
            all(&|e| Some(e.leak_r2)),
            all(&|e| Some(e.swap)),
            all(&|e| Some(e.with_standard_normal_prior.as_ref()?.robust_and_valid[0].mean)),
            all(&|e| e.calibration.map(|c| c.within_one)),
            all(&|e| e.calibration.map(|c| c.within_two)),
            all(&|e| e.disentanglement.as_ref().map(|d| d.disentanglement)),
            all(&|e| e.disentanglement.as_ref().map(|d| d.completeness)),
            all(&|e| e.disentanglement.as_ref().map(|d| d.mig)),
            all(&|e| {
                let measured = e.disentanglement.as_ref()?;
                measured.informativeness.iter().copied().reduce(f64::min)
            }),
        ]
    };
    let head = [
        "model",
        "active latents",
        "reconstruction rmse",
        "leak of w (R2)",
        "swap",
        "R and valid, N(0, I)",
        "errors within 1 deviation (.683)",
        "within 1.96 (.950)",
        "DCI disentanglement",
        "DCI completeness",
        "MIG",
        "least R2 of a factor from h",
    ];
    Block::Table {
        caption: format!(
            "{about}. What no share may be read without: means over seeds, least and most in \
             brackets"
        ),
        head: head.map(String::from).to_vec(),
        rows: rows.iter().zip(measured).map(line).collect(),
    }
}

fn differences(about: &str, part: &Part, rows: &[Loaded<'_>], columns: &[Column]) -> Option<Block> {
    let place = |name: &String| rows.iter().position(|row| row.config.name == *name);
    let line = |[a, b]: &[String; 2]| {
        let (i, j) = (place(a)?, place(b)?);
        let cells = columns.iter().map(|column| column.difference(i, j));
        Some([format!("{a} less {b}")].into_iter().chain(cells).collect())
    };
    let lines: Vec<Vec<String>> = part.compare.iter().filter_map(line).collect();
    let heads = columns.iter().map(Column::head);
    (!lines.is_empty()).then(|| Block::Table {
        caption: format!("{about}. Differences of rows on the same resamples"),
        head: ["rows".to_owned()].into_iter().chain(heads).collect(),
        rows: lines,
    })
}

/// What the manner parameters of the rows in figures do.
pub(super) fn manners(part: &Part, rows: &[Loaded<'_>]) -> Vec<Block> {
    let mut names: Vec<&String> = part.figures.iter().flat_map(|f| &f.rows).collect();
    names.sort();
    names.dedup();
    let table = |name: &String| {
        let Learned::TcVae(model) = &super::row(rows, name).models[0].document.learned else {
            return None;
        };
        let line = |(axis, latent): (&MannerAxis, &LatentStatistics)| {
            vec![axis.name.clone(), axis.effect.clone(), format!("{:.2}", latent.kl)]
        };
        let axes = model.manner_space.axes().iter().zip(&model.latents);
        Some(Block::Table {
            caption: format!("{}, {name}: what each manner parameter does, first seed", part.title),
            head: ["manner parameter", "effect", "KL (nat)"].map(String::from).to_vec(),
            rows: axes.map(line).collect(),
        })
    };
    names.into_iter().filter_map(table).collect()
}

pub(super) fn deviations(deviations: &[Deviation]) -> Block {
    let line =
        |Deviation { paper, here, why }: &Deviation| vec![paper.clone(), here.clone(), why.clone()];
    Block::Table {
        caption: "Deviations from the paper's text".into(),
        head: ["the paper", "here", "why"].map(String::from).to_vec(),
        rows: deviations.iter().map(line).collect(),
    }
}

/// Every measure of every model, for other programs.
pub(super) fn numbers(
    test: &TestSet,
    rows: &[Loaded<'_>],
    measured: &[Vec<Measured>],
) -> serde_json::Value {
    let row = |(row, measured): (&Loaded<'_>, &Vec<Measured>)| {
        let evaluations: Vec<_> = measured.iter().map(|m| &m.evaluation).collect();
        json!({ "row": row.config.name, "models": evaluations })
    };
    let rows: Vec<_> = rows.iter().zip(measured).map(row).collect();
    json!({ "test": test.name, "rows": rows })
}

/// `.583`, and below it `[.550, .614]`.
fn share(Share { mean, low, high }: Share) -> String {
    format!("{}\n[{}, {}]", number(mean), number(low), number(high))
}

/// Three decimals, without the zero before the point.
fn number(value: f64) -> String {
    let text = format!("{value:.3}");
    match text.strip_prefix("-0").or(text.strip_prefix('0')) {
        Some(rest) if value < 0.0 => format!("-{rest}"),
        Some(rest) => rest.into(),
        None => text,
    }
}

/// The mean, with the ends where values differ.
fn spread(values: &[f64]) -> String {
    if values.is_empty() {
        return "-".into();
    }
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let (low, high) = values.iter().fold((f64::MAX, f64::MIN), |(a, b), v| (a.min(*v), b.max(*v)));
    let number = |v: f64| if v >= 1.0 { format!("{v:.1}") } else { format!("{v:.3}") };
    match low == high {
        true => number(mean),
        false => format!("{} ({}-{})", number(mean), number(low), number(high)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_written_as_in_the_paper() {
        let text = |mean, low, high| share(Share { mean, low, high });
        assert_eq!(text(0.5834, 0.55, 1.0), ".583\n[.550, 1.000]");
        assert_eq!(text(-0.02, -0.0004, 0.01), "-.020\n[-.000, .010]");
        assert_eq!(spread(&[0.01, 0.03]), "0.020 (0.010-0.030)");
        assert_eq!(spread(&[4.0, 4.0]), "4.0");
        assert_eq!(spread(&[]), "-");
    }
}
