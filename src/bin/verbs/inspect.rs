//! `tcvae inspect`: what is in recordings, and why something is left out.

use clap::Args;
use serde_json::{Value, json};

use tcvae::demonstrations::Task;

use super::sources::{Examination, Examined, Recordings};
use super::{ExitStatus, print_json, print_line};

/// Arguments of `tcvae inspect`.
#[derive(Debug, Args)]
pub(crate) struct InspectArgs {
    #[command(flatten)]
    recordings: Recordings,
    /// Print the answer as JSON
    #[arg(long)]
    pub(crate) json: bool,
}

pub(crate) fn run(args: InspectArgs) -> anyhow::Result<ExitStatus> {
    let examination = args.recordings.examine()?;
    if args.json {
        print_json(&answer(&examination));
    } else {
        print_table(&examination);
    }
    let accepted = examination.recordings.iter().any(|r| r.outcome.is_ok());
    // With nothing to learn from, the data is bad.
    Ok(if accepted { ExitStatus::Done } else { ExitStatus::BadData })
}

/// The machine-readable answer.
fn answer(examination: &Examination) -> Value {
    let demonstration = |recording: &Examined| {
        let Examined { id, duration_secs, rate_hz, skipped, damage, digest: _, outcome } =
            recording;
        let mut value = json!({
            "id": id, "accepted": outcome.is_ok(), "reason": null, "detail": detail(examination, recording),
            "duration_secs": duration_secs, "rate_hz": rate_hz, "arm": null, "task": null,
            "skipped_lines": skipped, "damage": damage,
        });
        match outcome {
            Err(exclusion) => value["reason"] = json!(exclusion.reason),
            Ok((segment, demonstration)) => {
                value["arm"] = json!(segment.arm);
                value["task"] = task_json(examination, demonstration.w.values());
                value["segment_secs"] = json!([segment.grasp_secs, segment.end_secs]);
                let factors = examination.task.factors(&segment.motion);
                value["factors"] = factors.iter().map(|f| (f.name, f.value)).collect();
            }
        }
        value
    };
    let demonstrations: Vec<_> = examination.recordings.iter().map(demonstration).collect();
    let counts = examination.counts();
    json!({
        "demonstrations": demonstrations,
        "summary": {
            "recordings": examination.recordings.len(),
            "accepted": counts.accepted,
            "excluded": counts.excluded,
            "arms": counts.arms,
            "synthetic": examination.synthetic,
        },
    })
}

/// `w` by the names of its locations.
fn task_json(examination: &Examination, w: &[f64]) -> Value {
    let space = examination.task.task_space();
    let locations = space.locations().iter().zip(w.chunks(2));
    locations.map(|(location, xy)| (location.name.clone(), json!(xy))).collect()
}

/// What there is to say about one recording.
fn detail(examination: &Examination, recording: &Examined) -> String {
    let mut list = match &recording.outcome {
        Err(exclusion) => vec![exclusion.detail.clone()],
        Ok((segment, _)) => {
            let violations = examination.task.violations(&segment.motion);
            violations.iter().map(ToString::to_string).collect()
        }
    };
    list.extend(recording.damage.iter().map(|damage| format!("damaged: {damage}")));
    list.join("; ")
}

fn print_table(examination: &Examination) {
    let width = examination.recordings.iter().map(|r| r.id.len()).max().unwrap_or(0).max(2);
    let space = examination.task.task_space();
    let names: Vec<_> = space.locations().iter().map(|l| format!("{:>15}", l.name)).collect();
    print_line(&format!(
        "{:>4}  {:width$} {:>7} {:>6}  {:13} {:5} {} {:>7} {:>6} {:>6}  detail",
        "#",
        "id",
        "seconds",
        "Hz",
        "result",
        "arm",
        names.join(" "),
        "start s",
        "pour s",
        "tilt"
    ));
    for (i, recording) in examination.recordings.iter().enumerate() {
        let Examined { id, duration_secs, rate_hz, outcome, .. } = recording;
        let (result, rest) = match outcome {
            Err(exclusion) => (
                exclusion.reason.to_string(),
                format!("{:5} {:15} {:15} {:7} {:6} {:6}", "", "", "", "", "", ""),
            ),
            Ok((segment, demonstration)) => {
                let [pour, source] = [0, 1].map(|i| {
                    let [x, y] = demonstration.w.location(i);
                    format!("({x:.3}, {y:.3})")
                });
                let factors = examination.task.factors(&segment.motion);
                let value = |i: usize| factors.get(i).map_or(f64::NAN, |f| f.value);
                let rest = format!(
                    "{:5} {pour:>15} {source:>15} {:7.2} {:6.2} {:6.1}",
                    segment.arm,
                    value(0),
                    value(1),
                    value(2)
                );
                ("accepted".into(), rest)
            }
        };
        print_line(
            format!(
                "{:>4}  {id:width$} {duration_secs:7.2} {rate_hz:6.1}  {result:13} {rest}  {}",
                i + 1,
                detail(examination, recording)
            )
            .trim_end(),
        );
    }
    let skipped: usize = examination.recordings.iter().map(|r| r.skipped).sum();
    print_line(&format!("\n{}", examination.summary()));
    if skipped > 0 {
        print_line(&format!("{skipped} lines or messages that are no frame were skipped"));
    }
}
