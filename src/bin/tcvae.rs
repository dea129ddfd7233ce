//! `tcvae`: simulating and inspecting data, training, and evaluating models.
//!
//! Exit codes: 0 done, 1 a result below what was asked, 2 wrong usage, 3 bad data.

mod verbs;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use clap::{CommandFactory, Parser, Subcommand};

#[cfg(feature = "ros")]
use verbs::doctor;
#[cfg(all(feature = "ros", feature = "bag"))]
use verbs::record;
use verbs::{
    ExitStatus, UsageError, check, evaluate, export, inspect, print_json, print_line, report,
    sample, simulate, sweep, train,
};

/// Learns movement primitives from demonstrations, and measures them.
#[derive(Debug, Parser)]
#[command(
    version,
    after_help = "Exit codes: 0 done, 1 a result below what was asked, \
    2 wrong usage, 3 bad data."
)]
struct Cli {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Debug, Subcommand)]
enum Verb {
    /// Write simulated demonstrations into a folder
    Simulate(simulate::SimulateArgs),
    /// Learn a model from demonstrations
    Train(train::TrainArgs),
    /// Train many models that differ in their settings, and rank them
    Sweep(sweep::SweepArgs),
    /// Sample checked motions of a model
    Sample(sample::SampleArgs),
    /// Ask for motions over the whole trained region, and tell what is served
    Check(check::CheckArgs),
    /// Measure a model on data that it was not trained on
    Evaluate(evaluate::EvaluateArgs),
    /// Make tables and figures from trained models
    Report(report::ReportArgs),
    /// Show what is in recordings, and why something is left out
    Inspect(inspect::InspectArgs),
    /// Write the training set as a table or as a recording, for other programs
    Export(export::ExportArgs),
    /// Record joint states and grippers from the ROS graph
    #[cfg(all(feature = "ros", feature = "bag"))]
    Record(record::RecordArgs),
    /// Find out why nothing is seen on the ROS graph, and what to do
    #[cfg(feature = "ros")]
    Doctor(doctor::DoctorArgs),
    /// Write a shell's completions to standard output
    Completions {
        /// The shell
        shell: clap_complete::Shell,
    },
    /// Write manual pages into a folder
    Man {
        /// The folder, which must exist
        folder: PathBuf,
    },
}

impl Verb {
    fn json(&self) -> bool {
        match self {
            Self::Simulate(args) => args.json,
            Self::Train(args) => args.json,
            Self::Sweep(args) => args.json,
            Self::Sample(args) => args.json,
            Self::Check(args) => args.json,
            Self::Evaluate(args) => args.json,
            Self::Report(args) => args.json,
            Self::Inspect(args) => args.json,
            Self::Export(args) => args.json,
            #[cfg(all(feature = "ros", feature = "bag"))]
            Self::Record(args) => args.json,
            #[cfg(feature = "ros")]
            Self::Doctor(args) => args.json,
            Self::Completions { .. } | Self::Man { .. } => false,
        }
    }

    fn run(self) -> anyhow::Result<ExitStatus> {
        match self {
            Self::Simulate(args) => simulate::run(args),
            Self::Train(args) => train::run(args),
            Self::Sweep(args) => sweep::run(args),
            Self::Sample(args) => sample::run(args),
            Self::Check(args) => check::run(args),
            Self::Evaluate(args) => evaluate::run(args),
            Self::Report(args) => report::run(args),
            Self::Inspect(args) => inspect::run(args),
            Self::Export(args) => export::run(args),
            #[cfg(all(feature = "ros", feature = "bag"))]
            Self::Record(args) => record::run(args),
            #[cfg(feature = "ros")]
            Self::Doctor(args) => doctor::run(args),
            Self::Completions { shell } => completions(shell),
            Self::Man { folder } => manual(&folder),
        }
    }
}

fn completions(shell: clap_complete::Shell) -> anyhow::Result<ExitStatus> {
    let mut text = Vec::new();
    clap_complete::generate(shell, &mut Cli::command(), "tcvae", &mut text);
    print_line(String::from_utf8_lossy(&text).trim_end());
    Ok(ExitStatus::Done)
}

/// A page for the program and one for each verb.
fn manual(folder: &Path) -> anyhow::Result<ExitStatus> {
    if !folder.is_dir() {
        let reason = format!("there is no folder {}; make it", folder.display());
        return Err(UsageError(reason).into());
    }
    clap_mangen::generate_to(Cli::command(), folder)
        .with_context(|| format!("writing manual pages into {}", folder.display()))?;
    Ok(ExitStatus::Done)
}

/// The error with its causes. Some errors tell their cause, or the file that they are about,
/// themselves; nothing is said twice.
fn message(error: &anyhow::Error) -> String {
    let mut message = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if cause.contains(&message) {
            message = cause;
        } else if !message.contains(&cause) {
            message = format!("{message}: {cause}");
        }
    }
    message
}

fn main() -> ExitCode {
    let Cli { verb } = Cli::parse();
    let json = verb.json();
    let status = verb.run().unwrap_or_else(|error| {
        let message = message(&error);
        if json {
            print_json(&serde_json::json!({ "error_message": message }));
        }
        eprintln!("tcvae: {message}");
        ExitStatus::of(&error)
    });
    ExitCode::from(status as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, thiserror::Error)]
    #[error("cannot read a file: {source}")]
    struct Told {
        source: std::io::Error,
    }

    #[test]
    fn no_cause_is_told_twice() {
        let told = |context: &'static str| {
            let error = Told { source: std::io::Error::other("disk on fire") };
            message(&Err::<(), _>(error).context(context).unwrap_err())
        };
        assert_eq!(told("training"), "training: cannot read a file: disk on fire");
        assert_eq!(told("a file"), "cannot read a file: disk on fire");
    }
}
