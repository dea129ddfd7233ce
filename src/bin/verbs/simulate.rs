//! `tcvae simulate`: demonstrations whose truth is known.

use std::fs;
use std::path::PathBuf;

use clap::{Args, ValueEnum};
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use rayon::prelude::*;
use serde_json::json;

use tcvae::dataset::{self, DataSetError};
use tcvae::demonstrations::arcs::{self, ArcStart, ArcsSimulation};
use tcvae::demonstrations::simulation::{Activity, Simulation, Truth, TruthFile};
use tcvae::mime;

use super::sources::load_robot;
use super::{ExitStatus, Settings, UsageError, print_json, print_line};

/// Fewest arcs, one for each of the ten shares of 8/1/1.
const MIN_ARCS: usize = 10;
/// Most arcs: about 2 GB of files.
const MAX_ARCS: usize = 1_000_000;
/// Most recordings: about 7 GB of files.
const MAX_RECORDINGS: usize = 10_000;
/// What is true of simulated demonstrations; where it lies, they are simulated.
pub(crate) const TRUTH_FILE: &str = "truth.json";

/// What can be simulated.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum Simulated {
    /// Arcs of a circle around a centre, the paper's synthetic task
    Arcs,
    /// People who guide an arm in pouring from a cup, in the layout of MIME
    Pouring,
    /// People who guide an arm in putting a block on another one, likewise
    Stacking,
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
    /// for testing; pouring and stacking: 280, of which about a quarter must be left out
    #[arg(long)]
    count: Option<usize>,
    /// The robot whose arm is guided; Baxter without it
    #[arg(long, value_name = "F.toml")]
    robot: Option<PathBuf>,
    /// A setting; arcs: start=half|full (start angles in [0, pi] or all), steps=N (points of an
    /// arc); pouring and stacking: correlation=R from 0 to below 1 (of the manner with itself and
    /// with the task; life-like is 0.88); pouring: sides=both|right (people lean the cup to the side to which they
    /// carry it, or all to the right)
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
        Simulated::Pouring => simulate_people(&args, Activity::Pouring),
        Simulated::Stacking => simulate_people(&args, Activity::Stacking),
    }
}

fn simulate_arcs(args: &SimulateArgs) -> anyhow::Result<ExitStatus> {
    let SimulateArgs { what: _, seed, count, robot, set, output, json } = args;
    if robot.is_some() {
        return Err(
            UsageError("--robot: arcs are drawn in the plane, without a robot".into()).into()
        );
    }
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

fn simulate_people(args: &SimulateArgs, activity: Activity) -> anyhow::Result<ExitStatus> {
    let SimulateArgs { what: _, seed, count, robot, set, output, json } = args;
    let default = Simulation { activity, ..Simulation::default() };
    let mut settings = Settings::new(set)?;
    let correlation = settings.get(
        "correlation",
        default.correlation,
        "a number from 0 to below 1",
        |value| value.parse().ok().filter(|r| (0.0..1.0).contains(r)),
    )?;
    let mut both_sides = default.both_sides;
    if activity == Activity::Pouring {
        both_sides = settings.get("sides", both_sides, "both or right", |value| match value {
            "both" => Some(true),
            "right" => Some(false),
            _ => None,
        })?;
    }
    settings.finish()?;
    let count = count.unwrap_or(default.count);
    if !(1..=MAX_RECORDINGS).contains(&count) {
        let reason =
            format!("--count {count}: 1 to {MAX_RECORDINGS} recordings are simulated at once");
        return Err(UsageError(reason).into());
    }
    let simulation = Simulation { activity, count, seed: *seed, correlation, both_sides };
    let robot = load_robot(robot.as_deref())?;
    let assignments =
        simulation.assignments(&robot.config).map_err(|e| UsageError(e.to_string()))?;
    // From here on there is a folder.
    let refused = |what: &dyn std::fmt::Display| {
        UsageError(format!("{}: {what}; choose a new folder", output.display()))
    };
    fs::create_dir_all(output).map_err(|e| refused(&e))?;
    if fs::read_dir(output).map_err(|e| refused(&e))?.next().is_some() {
        return Err(refused(&"not empty").into());
    }
    let write = |assignment| -> anyhow::Result<(Truth, usize)> {
        let simulated = simulation
            .simulate(assignment, &robot.config, &robot.chain)
            .map_err(|e| UsageError(e.to_string()))?;
        mime::write(output, &simulated.raw).map_err(|e| UsageError(e.to_string()))?;
        Ok((simulated.truth, simulated.redrawn))
    };
    let written: Vec<_> = assignments.par_iter().map(write).collect::<Result<_, _>>()?;
    let redrawn: usize = written.iter().map(|(_, redrawn)| redrawn).sum();
    let accepted = assignments.iter().filter(|a| a.trap.is_none()).count();
    // Last, so that a folder with the truth is whole.
    let truth = TruthFile { demonstrations: written.into_iter().map(|(truth, _)| truth).collect() };
    let text = serde_json::to_string_pretty(&truth)? + "\n";
    fs::write(output.join(TRUTH_FILE), text).map_err(|e| refused(&e))?;
    if *json {
        print_json(&json!({
            "folder": output, "demonstrations": count, "accepted": accepted,
            "excluded": count - accepted, "redrawn": redrawn, "correlation": correlation,
            "both_sides": both_sides, "seed": seed,
        }));
    } else {
        let (folder, out) = (output.display(), count - accepted);
        print_line(&format!(
            "{folder}: {count} recordings, seed {seed}: {accepted} demonstrations to learn from and {out} \
             recordings to leave out ({redrawn} motions beyond the arm's reach were drawn anew)"
        ));
    }
    Ok(ExitStatus::Done)
}
