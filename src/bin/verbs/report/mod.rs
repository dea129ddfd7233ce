//! `tcvae report`: tables and figures from trained files, in one command.

mod figures;
mod measures;
mod tables;

use std::collections::hash_map::Entry;
use std::collections::{HashMap, HashSet};
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use serde::Deserialize;
use serde_json::json;

use tcvae::artifact::{self, Artifact};
use tcvae::demonstrations::{Demonstration, Splits, TaskConfig};
use tcvae::report::{Block, Page};

use super::sources::{Copies, Data, Recordings};
use super::{ExitStatus, UsageError, print_json, print_line};
use measures::Measures;

/// Arguments of `tcvae report`.
#[derive(Debug, Args)]
pub(crate) struct ReportArgs {
    /// What to report on, such as config/report.toml
    #[arg(long, value_name = "F.toml")]
    config: PathBuf,
    /// Folder for the page, its pictures and its numbers; files of the same names are replaced
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Print what was written as JSON
    #[arg(long)]
    pub(crate) json: bool,
}

/// A report (`config/report.toml`).
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct ReportConfig {
    title: String,
    /// Paragraphs above everything.
    introduction: Vec<String>,
    /// What makes the report from nothing.
    commands: String,
    /// Folder in which measurements are kept, so that a report that is made again measures nothing
    /// twice.
    cache: PathBuf,
    /// Seed of every random draw.
    seed: u64,
    #[serde(rename = "part")]
    parts: Vec<Part>,
    /// Where the paper's rows are not what its text says.
    #[serde(rename = "deviation", default)]
    deviations: Vec<Deviation>,
}

/// Models of one kind of data beside each other.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Part {
    title: String,
    /// Paragraphs above its tables.
    #[serde(default)]
    notes: Vec<String>,
    /// What the models were trained on.
    data: Vec<PathBuf>,
    #[serde(default)]
    robot: Option<PathBuf>,
    /// Seeds of the models in rows.
    seeds: Vec<u64>,
    #[serde(rename = "test")]
    tests: Vec<TestSet>,
    #[serde(rename = "row")]
    rows: Vec<Row>,
    /// Pairs of rows whose difference is told, the first less the second.
    #[serde(default)]
    compare: Vec<[String; 2]>,
    #[serde(rename = "figure", default)]
    figures: Vec<Figure>,
}

/// What the models are measured on.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct TestSet {
    name: String,
    /// A data set or recordings, all of which is tested on; without, it is the part of the data that
    /// a training holds out.
    #[serde(default)]
    path: Option<PathBuf>,
    /// Whether probes are fitted on the first half of it, and the second half is tested on, instead of
    /// probes that are fitted on what was trained on.
    #[serde(default)]
    halves: bool,
}

/// A line of a table: the models of one kind, one for each seed.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Row {
    name: String,
    /// A model file; with `{seed}` in it, one for each of the part's seeds.
    models: String,
    /// What the paper reports.
    #[serde(default)]
    paper: Option<Paper>,
}

/// The paper's numbers at each threshold.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Paper {
    success: Vec<f64>,
    #[serde(default)]
    robustness: Vec<f64>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Figure {
    /// `Figure 6`.
    name: String,
    caption: String,
    shows: Shows,
    /// The rows whose first models are shown.
    rows: Vec<String>,
}

/// What a figure shows.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Shows {
    /// The path of the first two state values, along each manner parameter.
    Paths,
    /// The tilt over time, along each manner parameter.
    Tilts,
    /// Where samples achieve the task.
    Locations,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Deviation {
    paper: String,
    here: String,
    why: String,
}

/// A row with its files.
struct Loaded<'c> {
    config: &'c Row,
    models: Vec<Artifact>,
}

pub(crate) fn run(args: ReportArgs) -> anyhow::Result<ExitStatus> {
    let ReportArgs { config: path, output, json } = args;
    let of_file = |e: &dyn std::fmt::Display| UsageError(format!("{}: {e}", path.display()));
    let text = fs::read_to_string(&path).map_err(|e| of_file(&e))?;
    let config: ReportConfig = toml::from_str(&text).map_err(|e| of_file(&e))?;
    config.check().map_err(|e| of_file(&e))?;
    fs::create_dir_all(&output).with_context(|| output.display().to_string())?;

    let mut blocks: Vec<Block> = config.introduction.iter().cloned().map(Block::Text).collect();
    let mut numbers = Vec::new();
    for part in &config.parts {
        eprintln!("\n{}", part.title);
        let (of_part, found) = report_part(part, &config)?;
        blocks.extend(of_part);
        numbers.push(json!({ "part": part.title, "tests": found }));
    }
    if !config.deviations.is_empty() {
        blocks.push(tables::deviations(&config.deviations));
    }
    blocks.push(Block::Heading(2, "How this page was made".into()));
    blocks.push(Block::Code(config.commands.clone()));
    let page = Page { title: config.title.clone(), blocks };
    let written = write(&output, &page, &numbers)?;
    if json {
        print_json(&json!({ "files": written }));
    } else {
        print_line(&format!("{}: {} files", output.display(), written.len()));
    }
    Ok(ExitStatus::Done)
}

impl ReportConfig {
    /// Checks what no type can say.
    fn check(&self) -> Result<(), String> {
        let mut figures = HashSet::new();
        for figure in self.parts.iter().flat_map(|part| &part.figures) {
            if !figures.insert(slug(&figure.name)) {
                let name = &figure.name;
                return Err(format!("two figures are named {name:?}, and so would be their files"));
            }
        }
        for part in &self.parts {
            let known = |row: &String| part.rows.iter().any(|r| r.name == *row);
            let named = part.compare.iter().flatten();
            let named = named.chain(part.figures.iter().flat_map(|figure| &figure.rows));
            if let Some(row) = named.into_iter().find(|row| !known(row)) {
                return Err(format!("{:?} has no row {row:?}", part.title));
            }
            for (what, empty) in [
                ("data", part.data.is_empty()),
                ("test", part.tests.is_empty()),
                ("row", part.rows.is_empty()),
                ("seeds", part.seeds.is_empty()),
            ] {
                if empty {
                    return Err(format!("{:?} has no {what}; name at least one", part.title));
                }
            }
        }
        Ok(())
    }
}

impl Row {
    fn files(&self, seeds: &[u64]) -> Vec<PathBuf> {
        const SEED: &str = "{seed}";
        match self.models.contains(SEED) {
            true => seeds
                .iter()
                .map(|seed| self.models.replace(SEED, &seed.to_string()).into())
                .collect(),
            false => vec![PathBuf::from(&self.models)],
        }
    }
}

/// The blocks of a part, and its numbers for other programs.
fn report_part(
    part: &Part,
    config: &ReportConfig,
) -> anyhow::Result<(Vec<Block>, Vec<serde_json::Value>)> {
    let load = |path: &PathBuf| Artifact::load(path).with_context(|| path.display().to_string());
    let rows = part.rows.iter().map(|row| {
        let files = row.files(&part.seeds);
        let models = files.iter().map(load).collect::<anyhow::Result<Vec<_>>>()?;
        Ok(Loaded { config: row, models })
    });
    let rows: Vec<Loaded<'_>> = rows.collect::<anyhow::Result<_>>()?;
    figures::check(&part.figures, &rows)?;
    let sources = Sources::load(part, &rows)?;
    let measures = Measures { cache: &config.cache, seed: config.seed };

    let mut blocks = vec![Block::Heading(2, part.title.clone())];
    blocks.extend(part.notes.iter().cloned().map(Block::Text));
    blocks.extend(tables::demonstrations(&sources));
    let mut numbers = Vec::new();
    for test in &part.tests {
        let measured = measures.measure(test, &rows, &sources)?;
        blocks.extend(tables::of_test(part, test, &rows, &measured, config.seed));
        numbers.push(tables::numbers(test, &rows, &measured));
    }
    blocks.extend(tables::manners(part, &rows));
    for figure in &part.figures {
        blocks.extend(figures::draw(figure, &rows, &sources, config.seed)?);
    }
    Ok((blocks, numbers))
}

/// The data that models were trained on, as each of their tasks sees it.
struct Sources {
    data: HashMap<String, Data>,
    recordings: Recordings,
}

impl Sources {
    fn load(part: &Part, rows: &[Loaded<'_>]) -> anyhow::Result<Self> {
        let (paths, robot) = (part.data.clone(), part.robot.clone());
        let recordings = Recordings { paths, robot, ..Recordings::default() };
        let mut data = HashMap::new();
        for artifact in rows.iter().flat_map(|row| &row.models) {
            let task = &artifact.document.task;
            if let Entry::Vacant(entry) = data.entry(key(task)) {
                let found = entry.insert(recordings.data(Some(task), Copies::Made)?);
                eprintln!("{}", found.summary);
            }
        }
        Ok(Self { data, recordings })
    }

    fn of(&self, artifact: &Artifact) -> &Data {
        &self.data[&key(&artifact.document.task)]
    }

    /// What a model is measured on, with the digest of the data.
    fn splits(&self, test: &TestSet, artifact: &Artifact) -> anyhow::Result<(Splits, String)> {
        let Data { splits, digest, .. } = self.of(artifact);
        let Some(path) = &test.path else { return Ok((splits.clone(), digest.clone())) };
        let (paths, robot) = (vec![path.clone()], self.recordings.robot.clone());
        let recordings = Recordings { paths, robot, ..Recordings::default() };
        let (mut demonstrations, digest) = recordings.demonstrations(&artifact.document.task)?;
        let train: Vec<Demonstration> = match test.halves {
            true => demonstrations.drain(..demonstrations.len() / 2).collect(),
            false => splits.train.clone(),
        };
        let validation = splits.validation.clone();
        Ok((Splits { train, validation, test: demonstrations }, digest))
    }
}

fn key(task: &TaskConfig) -> String {
    serde_json::to_string(task).expect("a task is JSON")
}

/// Writes the page in both forms, its pictures, and its numbers.
fn write(
    output: &Path,
    page: &Page,
    numbers: &[serde_json::Value],
) -> anyhow::Result<Vec<PathBuf>> {
    let numbers = serde_json::to_string_pretty(numbers).expect("numbers are JSON") + "\n";
    let (html, markdown) = (page.html(), page.markdown());
    let mut files = vec![
        ("index.html", html.as_str()),
        ("README.md", markdown.as_str()),
        ("results.json", numbers.as_str()),
    ];
    files.extend(page.pictures());
    let write = |(name, content): (&str, &str)| {
        let path = output.join(name);
        artifact::write(&path, content.as_bytes())?;
        Ok(path)
    };
    files.into_iter().map(write).collect()
}

/// The row of that name.
fn row<'r, 'c>(rows: &'r [Loaded<'c>], name: &str) -> &'r Loaded<'c> {
    rows.iter().find(|row| row.config.name == name).expect("checked with the configuration")
}

/// The text as a name of a file.
fn slug(text: &str) -> String {
    let words = text.split(|c: char| !c.is_ascii_alphanumeric()).filter(|word| !word.is_empty());
    words.collect::<Vec<_>>().join("-").to_lowercase()
}
