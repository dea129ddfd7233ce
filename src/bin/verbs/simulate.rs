//! `tcvae simulate`: demonstrations whose truth is known.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use serde_json::json;

use tcvae::dataset::{self, DataSetError};
use tcvae::demonstrations::arcs::{self, ArcStart, ArcsSimulation};

use super::{ExitStatus, Settings, UsageError, print_json, print_line};

/// Fewest arcs, one for each of the ten shares of 8/1/1.
const MIN_ARCS: usize = 10;
/// Most arcs: about 2 GB of files.
const MAX_ARCS: usize = 1_000_000;

/// What can be simulated.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum Simulated {
    /// Arcs of a circle around a centre, the paper's synthetic task
    Arcs,
}

/// Arguments of `tcvae simulate`.
#[derive(Debug, Args)]
pub(crate) struct SimulateArgs {
    /// What to simulate
    what: Simulated,
    /// Seed of every random draw; the same seed writes the same bytes
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Demonstrations in all; arcs: 10000, of which one in ten is for validation and one in ten
    /// for testing
    #[arg(long)]
    count: Option<usize>,
    /// A setting; arcs: start=half|full (start angles in [0, pi] or all), steps=N (points of an
    /// arc)
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Folder to write, new or empty
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Print the answer as JSON
    #[arg(long)]
    pub(crate) json: bool,
}

pub(crate) fn run(args: SimulateArgs) -> anyhow::Result<ExitStatus> {
    match args.what {
        Simulated::Arcs => simulate_arcs(&args),
    }
}

fn simulate_arcs(args: &SimulateArgs) -> anyhow::Result<ExitStatus> {
    let SimulateArgs { what: _, seed, count, set, output, json } = args;
    let default = ArcsSimulation::default();
    let mut settings = Settings::new(set)?;
    let start = settings.get("start", default.start, "half or full", |value| match value {
        "half" => Some(ArcStart::Half),
        "full" => Some(ArcStart::Full),
        _ => None,
    })?;
    let steps = settings.get("steps", default.steps, "a number of points from 3 to 1000", |v| {
        v.parse().ok().filter(|steps| (3..=1000).contains(steps))
    })?;
    settings.finish()?;
    let count = count.unwrap_or(default.count);
    if !(MIN_ARCS..=MAX_ARCS).contains(&count) {
        let reason =
            format!("--count {count}: arcs are simulated {MIN_ARCS} to {MAX_ARCS} at once");
        return Err(UsageError(reason).into());
    }
    let simulation = ArcsSimulation { count, steps, start };
    let simulated = arcs::simulate(&simulation, &mut ChaCha8Rng::seed_from_u64(*seed));
    // Nothing is wrong with any data where the output can't be written.
    dataset::save(output, &simulation, *seed, &simulated)
        .map_err(|error: DataSetError| UsageError(error.to_string()))?;
    let [train, validation, test] = {
        let splits = &simulated.splits;
        [splits.train.len(), splits.validation.len(), splits.test.len()]
    };
    if *json {
        print_json(&json!({
            "folder": output, "demonstrations": count, "train": train,
            "validation": validation, "test": test, "steps": steps, "seed": seed,
        }));
    } else {
        let folder = output.display();
        print_line(&format!(
            "{folder}: {count} arcs of {steps} points, seed {seed} \
             ({train} to train, {validation} to validate, {test} to test)"
        ));
    }
    Ok(ExitStatus::Done)
}
