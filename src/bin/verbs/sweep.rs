//! `tcvae sweep`: many trainings, and which of them is best on the validation set.

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use anyhow::Context;
use clap::Args;
use serde_json::json;
use sha2::{Digest, Sha256};

use tcvae::demonstrations::Splits;
use tcvae::training::TrainingConfig;
use tcvae::training::sweep::{Ranked, Record, Run, SweepConfig};

use super::sources::{Copies, Recordings};
use super::train::{Files, Source, learn, stop_on_signal};
use super::{ExitStatus, UsageError, evaluate, print_json, print_line};

/// Name of a run's model in its folder.
pub(crate) const MODEL_FILE: &str = "model.safetensors";

/// Arguments of `tcvae sweep`.
#[derive(Debug, Args)]
pub(crate) struct SweepArgs {
    /// The sweep, such as config/sweep-arcs.toml
    #[arg(long, value_name = "F.toml")]
    config: PathBuf,
    /// Only every N-th training, from the I-th on: one of N processes or machines that share the
    /// work and the output folder
    #[arg(long, value_name = "I/N", default_value = "1/1")]
    shard: Shard,
    /// Print the ranking as JSON
    #[arg(long)]
    pub(crate) json: bool,
}

/// One of several parts of the work, counted from 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Shard {
    index: usize,
    of: usize,
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once('/');
        let shard =
            parts.and_then(|(i, n)| Some(Self { index: i.parse().ok()?, of: n.parse().ok()? }));
        shard
            .filter(|Self { index, of }| (1..=*of).contains(index))
            .ok_or_else(|| format!("{text} is no part of a whole; write 1/4 … 4/4 for four"))
    }
}

pub(crate) fn run(args: SweepArgs) -> anyhow::Result<ExitStatus> {
    let SweepArgs { config: path, shard, json } = args;
    let of_file = |e: &dyn std::fmt::Display| UsageError(format!("{}: {e}", path.display()));
    let text = fs::read_to_string(&path).map_err(|e| of_file(&e))?;
    let sweep: SweepConfig = toml::from_str(&text).map_err(|e| of_file(&e))?;
    let runs = sweep.runs().map_err(|e| of_file(&e))?;
    let paths = sweep.data.iter().map(PathBuf::from).collect();
    let [robot, task] = [&sweep.robot, &sweep.task].map(|f| f.as_ref().map(PathBuf::from));
    let recordings = Recordings { paths, robot, task, ..Recordings::default() };
    let source = Source::load(&recordings, Copies::Made)?;
    let output = Path::new(&sweep.output);
    fs::create_dir_all(output).with_context(|| output.display().to_string())?;

    let stop = stop_on_signal()?;
    let mut below = false;
    let ours = runs.iter().enumerate().filter(|(i, _)| i % shard.of == shard.index - 1);
    for (i, run) in ours {
        let digest = digest(&run.config, &source.digest);
        if records(output)?.iter().any(|r| r.run == run.name() && r.digest == digest) {
            continue;
        }
        eprintln!("\nrun {} of {}: {}", i + 1, runs.len(), run.name());
        let Some(record) = train(output, run, digest, &source, &stop)? else {
            below = true;
            break;
        };
        append(&output.join(format!("runs-{}-of-{}.jsonl", shard.index, shard.of)), &record)?;
        if stop.load(Ordering::Relaxed) {
            below = true;
            break;
        }
    }
    // Of older sweeps in the same folder, or of other data, nothing counts.
    let wanted: BTreeMap<String, String> =
        runs.iter().map(|run| (run.name(), digest(&run.config, &source.digest))).collect();
    let mut done = records(output)?;
    done.retain(|r| wanted.get(&r.run) == Some(&r.digest));
    let ranking = sweep.ranking(&done);
    if json {
        print_json(&json!({ "runs": runs.len(), "done": done.len(), "ranking": ranking }));
    } else {
        print_line(&table(&ranking, done.len(), runs.len()));
    }
    choose(output, &ranking, &runs)?;
    Ok(if below { ExitStatus::BelowAsked } else { ExitStatus::Done })
}

/// Trains and measures one model, going on where an earlier process stopped; none where this one
/// was told to stop.
fn train(
    output: &Path,
    run: &Run,
    digest: String,
    source: &Source,
    stop: &AtomicBool,
) -> anyhow::Result<Option<Record>> {
    let began = Instant::now();
    let files = Files::beside(&output.join(run.name()).join(MODEL_FILE))?;
    let _folder = files.claim()?;
    // A checkpoint of other settings is worth nothing here.
    let start = files.checkpoint(&run.config, source).ok();
    let mut record = Record {
        run: run.name(),
        row: run.row.clone(),
        combination: run.combination.clone(),
        seed: run.config.seed,
        digest,
        seconds: 0.0,
        validation: None,
        failure: None,
    };
    match learn(&files, source, &run.config, start, stop) {
        Ok(None) => return Ok(None),
        Ok(Some(mut artifact)) => {
            evaluate::add_names(&mut artifact, &source.splits);
            // What is tested on stays unseen until the end, also in the model's file.
            let Splits { train, validation, test: _ } = source.splits.clone();
            let splits = Splits { train, test: validation.clone(), validation };
            let seed = evaluate::DEFAULT_SEED;
            let measured = evaluate::measure(&artifact, &splits, source.digest.clone(), seed)?;
            record.validation = measured.tc_vae().cloned();
            files.finish(&artifact)?;
        }
        // One that diverged is a result too; a full disk is none.
        Err(error) => match error.downcast_ref::<tcvae::training::TrainingError>() {
            Some(failure) => {
                eprintln!("{failure}");
                record.failure = Some(failure.to_string());
            }
            None => return Err(error),
        },
    }
    record.seconds = began.elapsed().as_secs_f64();
    Ok(Some(record))
}

/// SHA-256 over the settings that are not the default and the data, in hexadecimal digits: a setting
/// that a later version adds makes no other run of this one.
fn digest(config: &TrainingConfig, of_data: &str) -> String {
    let table = |config| toml::Table::try_from(config).expect("settings are TOML");
    let set = difference(table(config), &table(&TrainingConfig::default()));
    let mut digest = Sha256::new();
    digest.update(toml::to_string(&set).expect("settings are TOML"));
    digest.update(of_data);
    digest.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The values of `table` that `other` does not have.
fn difference(table: toml::Table, other: &toml::Table) -> toml::Table {
    let differs = |(key, value): (String, toml::Value)| match (value, other.get(&key)) {
        (toml::Value::Table(inner), Some(toml::Value::Table(other))) => {
            let inner = difference(inner, other);
            (!inner.is_empty()).then_some((key, toml::Value::Table(inner)))
        }
        (value, Some(other)) if value == *other => None,
        (value, _) => Some((key, value)),
    };
    table.into_iter().filter_map(differs).collect()
}

/// What all shards have written so far. A line that another process has not finished is left out.
pub(crate) fn records(output: &Path) -> anyhow::Result<Vec<Record>> {
    let mut files = Vec::new();
    for entry in fs::read_dir(output).with_context(|| output.display().to_string())? {
        let path = entry?.path();
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        if name.starts_with("runs-") && name.ends_with(".jsonl") {
            files.push(path);
        }
    }
    files.sort();
    let mut records = Vec::new();
    for path in files {
        let text = fs::read_to_string(&path).with_context(|| path.display().to_string())?;
        records.extend(text.lines().filter_map(|line| serde_json::from_str::<Record>(line).ok()));
    }
    Ok(records)
}

fn append(path: &Path, record: &Record) -> anyhow::Result<()> {
    let at = || path.display().to_string();
    // A process that was killed may have left half a line.
    let torn = fs::read(path).is_ok_and(|bytes| bytes.last().is_some_and(|last| *last != b'\n'));
    let mut file: File =
        OpenOptions::new().create(true).append(true).open(path).with_context(at)?;
    let line = serde_json::to_string(record)?;
    writeln!(file, "{}{line}", if torn { "\n" } else { "" }).with_context(at)
}

/// Writes the settings of each row's best combination that misses no floor, for `train --config`.
fn choose(output: &Path, ranking: &[Ranked], runs: &[Run]) -> anyhow::Result<()> {
    let mut rows: Vec<&str> = Vec::new();
    for best in ranking.iter().filter(|r| r.misses.is_empty()) {
        if rows.contains(&best.row.as_str()) {
            continue;
        }
        rows.push(&best.row);
        let same = |run: &&Run| run.row == best.row && run.combination == best.combination;
        if let Some(run) = runs.iter().find(same) {
            let name = run.name();
            let row = name.split('_').next().unwrap_or_default();
            let path = output.join(format!("chosen-{row}.toml"));
            fs::write(&path, toml::to_string(&run.config)?)
                .with_context(|| path.display().to_string())?;
        }
    }
    Ok(())
}

/// The ranking as a person reads it.
fn table(ranking: &[Ranked], done: usize, runs: usize) -> String {
    let wide = |of: &dyn Fn(&Ranked) -> &str| {
        ranking.iter().map(|r| of(r).chars().count()).max().unwrap_or(0).max(11) + 2
    };
    let (row, combination) = (wide(&|r| &r.row), wide(&|r| &r.combination));
    let mut lines = vec![
        format!("{done} of {runs} runs are done; means over seeds on the validation set"),
        format!(
            "{:row$}{:combination$}{:>5} {:>7} {:>7} {:>7} {:>7} {:>6}  misses",
            "row", "settings", "seeds", "R+valid", "R", "S", "active", "leak"
        ),
    ];
    lines.extend(ranking.iter().map(|r| {
        format!(
            "{:row$}{:combination$}{:>5} {:>7.3} {:>7.3} {:>7.3} {:>7.1} {:>6.3}  {}",
            r.row,
            r.combination,
            r.seeds,
            r.robust_and_valid,
            r.robustness,
            r.success,
            r.active_latents,
            r.leak_r2,
            r.misses.join(", ")
        )
    }));
    lines.iter().map(|line| line.trim_end()).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shard_is_a_part_of_a_whole() {
        assert_eq!("2/3".parse(), Ok(Shard { index: 2, of: 3 }));
        for wrong in ["0/3", "4/3", "1", "a/b", "1/0", "-1/2"] {
            assert!(wrong.parse::<Shard>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_digest_is_of_what_differs_from_the_default() {
        let one = |text: &str| text.parse::<toml::Table>().unwrap();
        let set =
            difference(one("a = 1\nb = 2\n[c]\nd = 3\ne = 4"), &one("a = 1\nb = 3\n[c]\nd = 3"));
        assert_eq!(set, one("b = 2\n[c]\ne = 4"));
        let config = TrainingConfig::default();
        let other = TrainingConfig { beta: 3.0, ..config.clone() };
        let digests = [digest(&config, "a"), digest(&config, "b"), digest(&other, "a")];
        assert!(digests[0] != digests[1] && digests[0] != digests[2]);
        assert_eq!(digests[0], digest(&config, "a"));
    }

    #[test]
    fn a_torn_line_is_left_out_and_does_not_spoil_the_next() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("runs-1-of-2.jsonl");
        let record = |run: &str| Record {
            run: run.into(),
            row: "a".into(),
            combination: String::new(),
            seed: 1,
            digest: "d".into(),
            seconds: 2.0,
            validation: None,
            failure: Some("diverged".into()),
        };
        append(&path, &record("first")).unwrap();
        let mut file = OpenOptions::new().append(true).open(&path).unwrap();
        write!(file, "{{\"run\": \"tor").unwrap();
        append(&path, &record("second")).unwrap();
        append(&folder.path().join("runs-2-of-2.jsonl"), &record("third")).unwrap();
        let names: Vec<_> = records(folder.path()).unwrap().into_iter().map(|r| r.run).collect();
        assert_eq!(names, ["first", "second", "third"]);
    }
}
