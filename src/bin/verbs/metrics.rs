//! What a training tells of every epoch, as two files of the same content: JSON lines, and a table for
//! spreadsheets and plotting programs.

use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::Context;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use tcvae::training::EpochReport;

/// One epoch.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct MetricsLine {
    #[serde(flatten)]
    pub(super) report: EpochReport,
    pub(super) active_latents: usize,
    pub(super) seconds: f64,
}

/// The files of a training's metrics.
#[derive(Debug)]
pub(super) struct Metrics {
    path: PathBuf,
    lines: File,
    table: File,
    /// Whether the table has its head, which the first epoch decides.
    headed: bool,
}

impl Metrics {
    /// The files at `path`, JSON lines, and beside it, a table, with the first `done` epochs that are
    /// in them already.
    pub(super) fn keeping(path: &Path, done: usize) -> anyhow::Result<Self> {
        let old = match done {
            0 => String::new(),
            _ => fs::read_to_string(path).unwrap_or_default(),
        };
        let create = |path: &Path| File::create(path).with_context(|| path.display().to_string());
        let (lines, table) = (create(path)?, create(&path.with_extension("csv"))?);
        let mut metrics = Self { path: path.to_owned(), lines, table, headed: false };
        let parsed = old.lines().filter_map(|line| serde_json::from_str::<MetricsLine>(line).ok());
        for line in parsed.filter(|line| line.report.epoch <= done) {
            metrics.add(&line)?;
        }
        Ok(metrics)
    }

    /// Adds an epoch to both.
    pub(super) fn add(&mut self, line: &MetricsLine) -> anyhow::Result<()> {
        let mut cells = Vec::new();
        flatten(String::new(), &serde_json::to_value(line)?, &mut cells);
        let row = |of: fn(&(String, String)) -> &str| {
            cells.iter().map(of).collect::<Vec<_>>().join(",") + "\n"
        };
        let mut text = String::new();
        if !self.headed {
            text.push_str(&row(|(name, _)| name));
            self.headed = true;
        }
        text.push_str(&row(|(_, value)| value));
        let path = || self.path.display().to_string();
        writeln!(self.lines, "{}", serde_json::to_string(line)?).with_context(path)?;
        self.table.write_all(text.as_bytes()).with_context(path)
    }
}

/// The numbers of a value with their places in it: `validation.kl.2`. None of them, and no name, needs
/// quoting.
fn flatten(name: String, value: &Value, cells: &mut Vec<(String, String)>) {
    let inside = |key: &dyn std::fmt::Display| match name.as_str() {
        "" => key.to_string(),
        name => format!("{name}.{key}"),
    };
    match value {
        Value::Object(fields) => {
            fields.iter().for_each(|(key, value)| flatten(inside(key), value, cells));
        }
        Value::Array(values) => {
            (1..).zip(values).for_each(|(place, value)| flatten(inside(&place), value, cells));
        }
        Value::Null => cells.push((name, String::new())),
        other => cells.push((name, other.to_string())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tcvae::training::MeanTerms;

    fn line(epoch: usize) -> MetricsLine {
        let terms = MeanTerms {
            negative_log_likelihood: -2.5,
            kl: vec![0.5, 0.0],
            adversary: 1.0,
            anchors: Vec::new(),
        };
        let report = EpochReport {
            epoch,
            learning_rate: 0.001,
            alpha: 50.0,
            train: terms.clone(),
            validation: terms,
            robust_and_valid: None,
        };
        MetricsLine { report, active_latents: 1, seconds: 0.25 }
    }

    #[test]
    fn both_files_say_the_same_and_go_on_where_a_training_does() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.metrics.jsonl");
        let mut metrics = Metrics::keeping(&path, 0).unwrap();
        (1..=3).for_each(|epoch| metrics.add(&line(epoch)).unwrap());
        // The third epoch's checkpoint was never written.
        let mut metrics = Metrics::keeping(&path, 2).unwrap();
        metrics.add(&line(3)).unwrap();
        let lines = fs::read_to_string(&path).unwrap();
        assert_eq!(lines.lines().count(), 3);
        let table = fs::read_to_string(folder.path().join("m.metrics.csv")).unwrap();
        let mut rows = table.lines();
        let head: Vec<_> = rows.next().unwrap().split(',').collect();
        let first: Vec<_> = rows.next().unwrap().split(',').collect();
        assert_eq!((head.len(), rows.count()), (first.len(), 2));
        let cell = |name: &str| first[head.iter().position(|h| *h == name).unwrap()];
        assert_eq!(cell("epoch"), "1");
        assert_eq!(cell("validation.kl.1"), "0.5");
        assert_eq!(cell("validation.negative_log_likelihood"), "-2.5");
        assert_eq!((cell("robust_and_valid"), cell("seconds")), ("", "0.25"));
    }
}
