//! `tcvae inspect`: what is in recordings, and why something is left out.

use std::path::PathBuf;

use clap::Args;
use serde_json::{Value, json};

use tcvae::demonstrations::manipulation::Segment;
use tcvae::demonstrations::quality::{self, ArmQuality, Neighbour, Quality};
use tcvae::demonstrations::task::Factor;
use tcvae::demonstrations::{Demonstration, Task};
use tcvae::pose::{tilt, up_in_tip};
use tcvae::report::{Block, Page, PlottedRecording, recordings_svg, tasks_svg};

use super::sources::{Examination, Examined, Recordings};
use super::{ExitStatus, print_json, print_line, write_whole};

/// Two demonstrations whose tips are this near all the way (m, root mean square) are the same one.
const SAME_MOTION_M: f64 = 0.001;

/// Points of a tilt profile.
const PROFILE_POINTS: usize = 50;

/// Recordings in one picture of the page.
const PICTURES_TOGETHER: usize = 40;

/// Arguments of `tcvae inspect`.
#[derive(Debug, Args)]
pub(crate) struct InspectArgs {
    #[command(flatten)]
    recordings: Recordings,
    /// Print the answer as JSON
    #[arg(long)]
    pub(crate) json: bool,
    /// Write a page with the table, and with plots of the tasks and of every recording
    #[arg(long, value_name = "F.html")]
    html: Option<PathBuf>,
}

pub(crate) fn run(args: InspectArgs) -> anyhow::Result<ExitStatus> {
    let inspection = Inspection::new(args.recordings.examine()?);
    if let Some(path) = &args.html {
        write_whole(path, &inspection.page()?.html())?;
    }
    if args.json {
        print_json(&inspection.answer());
    } else {
        inspection.print();
    }
    let accepted = inspection.examination.recordings.iter().any(|r| r.outcome.is_ok());
    // With nothing to learn from, the data is bad.
    Ok(if accepted { ExitStatus::Done } else { ExitStatus::BadData })
}

/// What there is to tell of recordings.
struct Inspection {
    examination: Examination,
    /// For each recording that is a demonstration, the one that moves most alike, as a place among the
    /// recordings.
    nearest: Vec<Option<Neighbour>>,
}

impl Inspection {
    fn new(examination: Examination) -> Self {
        let mut nearest = vec![None; examination.recordings.len()];
        let (places, demonstrations): (Vec<usize>, Vec<&Demonstration>) = examination
            .recordings
            .iter()
            .enumerate()
            .filter_map(|(i, recording)| Some((i, &recording.outcome.as_ref().ok()?.1)))
            .unzip();
        let found = quality::nearest(&demonstrations, &examination.task.state_frame());
        for (place, neighbour) in places.iter().zip(found) {
            nearest[*place] = neighbour.map(|n| Neighbour { index: places[n.index], ..n });
        }
        Self { examination, nearest }
    }

    fn recordings(&self) -> impl Iterator<Item = (usize, &Examined)> {
        self.examination.recordings.iter().enumerate()
    }

    fn factors(&self, segment: &Segment) -> Vec<Factor> {
        self.examination.task.factors(&segment.motion)
    }

    fn result(&self, recording: &Examined) -> String {
        match &recording.outcome {
            Ok(_) => "accepted".into(),
            Err(exclusion) => self.examination.task.reason_name(exclusion.reason),
        }
    }

    /// The machine-readable answer.
    fn answer(&self) -> Value {
        let demonstrations: Vec<_> = self.recordings().map(|(i, r)| self.entry(i, r)).collect();
        let counts = self.examination.counts();
        let spreads = self.spreads().into_iter().map(|Spread { name, unit, mean, stddev, low, high }| {
            let of = json!({ "unit": unit, "mean": mean, "stddev": stddev, "min": low, "max": high });
            (name, of)
        });
        json!({
            "demonstrations": demonstrations,
            "summary": {
                "recordings": self.examination.recordings.len(),
                "accepted": counts.accepted,
                "excluded": counts.excluded,
                "arms": counts.arms,
                "synthetic": self.examination.synthetic,
                "values": spreads.collect::<serde_json::Map<_, _>>(),
                "warnings": self.warnings(),
            },
        })
    }

    fn entry(&self, i: usize, recording: &Examined) -> Value {
        let Examined { id, duration_secs, rate_hz, skipped, damage, digest: _, quality, outcome } =
            recording;
        let mut value = json!({
            "id": id, "accepted": outcome.is_ok(), "reason": null, "detail": self.detail(i, recording),
            "duration_secs": duration_secs, "rate_hz": rate_hz, "arm": null, "task": null,
            "skipped_lines": skipped, "damage": damage, "quality": quality.as_ref().map(quality_json),
        });
        match outcome {
            Err(exclusion) => {
                value["reason"] = json!(self.examination.task.reason_name(exclusion.reason));
            }
            Ok((segment, demonstration)) => {
                value["arm"] = json!(segment.arm);
                value["task"] = self.task_json(demonstration.w.values());
                value["segment_secs"] = json!([segment.start_secs, segment.end_secs]);
                value["action_secs"] = json!([segment.action_start_secs, segment.action_end_secs]);
                value["factors"] = self
                    .factors(segment)
                    .into_iter()
                    .map(|f| (f.name.into_owned(), json!(f.value)))
                    .collect();
                value["tilt_profile_deg"] = json!(self.tilt_profile_deg(segment));
                value["nearest"] = self.nearest[i].map_or(Value::Null, |neighbour| {
                    let Neighbour { index, motion_m, task_m } = neighbour;
                    let id = &self.examination.recordings[index].id;
                    json!({ "id": id, "motion_m": motion_m, "task_m": task_m })
                });
            }
        }
        value
    }

    /// `w` by the names of its locations.
    fn task_json(&self, w: &[f64]) -> Value {
        let space = self.examination.task.task_space();
        let locations = space.locations().iter().zip(w.chunks(2));
        locations.map(|(location, xy)| (location.name.clone(), json!(xy))).collect()
    }

    /// The tilt at equally spaced times of the demonstration.
    fn tilt_profile_deg(&self, segment: &Segment) -> Vec<f64> {
        let states = segment.motion.states.resampled(PROFILE_POINTS);
        let poses = self.examination.task.state_frame().poses(&states);
        let axis = up_in_tip(&poses[0]);
        poses.iter().map(|pose| tilt(pose, &axis).to_degrees()).collect()
    }

    /// What there is to say about one recording.
    fn detail(&self, i: usize, recording: &Examined) -> String {
        let mut list = match &recording.outcome {
            Err(exclusion) => vec![exclusion.detail.clone()],
            Ok((segment, _)) => {
                let violations = self.examination.task.violations(&segment.motion);
                violations.iter().map(ToString::to_string).collect()
            }
        };
        if let Some(Neighbour { index, .. }) = self.nearest[i].filter(is_the_same) {
            list.push(format!("moves as {} does", self.examination.recordings[index].id));
        }
        if let Some(Quality { gaps, longest_gap_secs, .. }) = &recording.quality
            && *gaps > 0
        {
            list.push(format!("{gaps} gaps, the longest {longest_gap_secs:.2} s"));
        }
        list.extend(recording.damage.iter().map(|damage| format!("damaged: {damage}")));
        list.join("; ")
    }

    /// The spread of locations and of factors over what is accepted.
    fn spreads(&self) -> Vec<Spread> {
        let names = self.examination.task.task_space().value_names();
        let mut values: Vec<(String, &'static str, Vec<f64>)> =
            names.into_iter().map(|name| (name, "m", Vec::new())).collect();
        let locations = values.len();
        for (segment, demonstration) in
            self.examination.recordings.iter().filter_map(|r| r.outcome.as_ref().ok())
        {
            let factors = self.factors(segment);
            values.resize_with(locations + factors.len(), Default::default);
            for ((_, _, values), value) in values.iter_mut().zip(demonstration.w.values()) {
                values.push(*value);
            }
            for (spread, factor) in values[locations..].iter_mut().zip(factors) {
                (spread.0, spread.1) = (factor.name.into_owned(), factor.unit);
                spread.2.push(factor.value);
            }
        }
        values.retain(|(_, _, values)| !values.is_empty());
        values.into_iter().map(|(name, unit, values)| Spread::new(name, unit, &values)).collect()
    }

    /// What a person may want to do something about.
    fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        for (i, neighbour) in self.nearest.iter().enumerate() {
            if let Some(Neighbour { index, .. }) = neighbour.as_ref().filter(|n| is_the_same(n))
                && *index > i
            {
                let [a, b] = [i, *index].map(|i| &self.examination.recordings[i].id);
                warnings.push(format!(
                    "{a} and {b} are the same motion, which would be trained and tested on: \
                     --exclude {b}"
                ));
            }
        }
        let with_gaps = self
            .recordings()
            .filter(|(_, r)| r.quality.as_ref().is_some_and(|q| q.gaps > 0))
            .count();
        if with_gaps > 0 {
            let recordings = self.examination.recordings.len();
            warnings.push(format!("{with_gaps} of {recordings} recordings have gaps in time"));
        }
        if let Some((id, joint, by)) = self.furthest_outside()
            && by > BEYOND_LIMITS
        {
            warnings.push(format!(
                "{joint} of {id} is {by:.2} beyond its limit (rad or m); are the joints in the order \
                 and the units of the robot's description?"
            ));
        }
        warnings
    }

    /// The joint that is furthest beyond its limit in any recording.
    fn furthest_outside(&self) -> Option<(&str, &str, f64)> {
        let all = self.examination.recordings.iter().flat_map(|recording| {
            let arms = recording.quality.iter().flat_map(|quality| &quality.arms);
            arms.filter_map(|arm| {
                let (joint, by) = arm.furthest_outside.as_ref()?;
                Some((recording.id.as_str(), joint.as_str(), *by))
            })
        });
        all.max_by(|a, b| a.2.total_cmp(&b.2))
    }

    /// The first line of the table and the others.
    fn table(&self) -> (Vec<String>, Vec<Vec<String>>) {
        let space = self.examination.task.task_space();
        let factors: Vec<String> =
            self.examination.task.factor_names().into_iter().take(3).collect();
        let head = ["#", "id", "seconds", "Hz", "result", "arm"].map(String::from).into_iter();
        let names = space.locations().iter().map(|l| l.name.clone()).chain(factors.iter().cloned());
        let head: Vec<String> =
            head.chain(names).chain(["nearest", "detail"].map(String::from)).collect();
        let row = |(i, recording): (usize, &Examined)| {
            let Examined { id, duration_secs, rate_hz, outcome, .. } = recording;
            let mut row = vec![
                (i + 1).to_string(),
                id.clone(),
                format!("{duration_secs:.2}"),
                format!("{rate_hz:.1}"),
                self.result(recording),
            ];
            if let Ok((segment, demonstration)) = outcome {
                row.push(segment.arm.clone());
                let locations = demonstration.w.values().chunks(2);
                row.extend(locations.map(|xy| format!("({:.3}, {:.3})", xy[0], xy[1])));
                let values = self.factors(segment).into_iter().take(factors.len());
                row.extend(values.map(|factor| written(factor.value, factor.unit)));
                let nearest = self.nearest[i].map(|n| format!("{:.1} cm", 100.0 * n.motion_m));
                row.push(nearest.unwrap_or_default());
            }
            row.resize(head.len() - 1, String::new());
            row.push(self.detail(i, recording));
            row
        };
        let rows = self.recordings().map(row).collect();
        (head, rows)
    }

    /// Counts, spreads and warnings, a line each.
    fn summary(&self) -> Vec<String> {
        let mut lines: Vec<String> = self.examination.summary().lines().map(String::from).collect();
        let spread = |Spread { name, unit, mean, stddev, low, high }: Spread| {
            let [mean, stddev, low, high] = [mean, stddev, low, high].map(|v| written(v, unit));
            format!("{name}: {mean} ± {stddev} ({low} to {high})")
        };
        lines.extend(self.spreads().into_iter().map(spread));
        let skipped: usize = self.examination.recordings.iter().map(|r| r.skipped).sum();
        if skipped > 0 {
            lines.push(format!("{skipped} lines or messages that are no frame were skipped"));
        }
        lines.extend(self.warnings().into_iter().map(|warning| format!("warning: {warning}")));
        lines
    }

    fn print(&self) {
        let (head, rows) = self.table();
        let widths: Vec<usize> = (0..head.len())
            .map(|i| {
                rows.iter().chain([&head]).map(|row| row[i].chars().count()).max().unwrap_or(0)
            })
            .collect();
        // Names and details read from the left, numbers from the right.
        let on_the_left = |i: usize| matches!(i, 1 | 4 | 5) || i + 1 == widths.len();
        for row in std::iter::once(&head).chain(&rows) {
            let cells = row.iter().enumerate().map(|(i, cell)| match on_the_left(i) {
                true => format!("{cell:<width$}", width = widths[i]),
                false => format!("{cell:>width$}", width = widths[i]),
            });
            print_line(cells.collect::<Vec<_>>().join("  ").trim_end());
        }
        print_line(&format!("\n{}", self.summary().join("\n")));
    }

    fn page(&self) -> anyhow::Result<Page> {
        let task = &self.examination.task;
        let mut blocks: Vec<Block> = self.summary().into_iter().map(Block::Text).collect();
        let accepted =
            || self.examination.recordings.iter().filter_map(|r| r.outcome.as_ref().ok());
        if accepted().next().is_some() {
            let names: Vec<String> =
                task.task_space().locations().iter().map(|l| l.name.clone()).collect();
            let of = |w: &[f64]| w.chunks(2).map(|xy| [xy[0], xy[1]]).collect();
            let tasks: Vec<_> = accepted().map(|(_, d)| of(d.w.values())).collect();
            blocks.push(Block::Picture {
                caption: "The tasks that were shown, from above.".into(),
                file: "tasks.svg".into(),
                svg: tasks_svg(&names, &tasks)?,
            });
        }
        blocks.push(Block::Heading(2, "Recordings".into()));
        let plotted: Vec<_> = self.recordings().map(|(i, r)| self.plotted(i, r)).collect();
        for (i, part) in plotted.chunks(PICTURES_TOGETHER).enumerate() {
            let (first, last) = (PICTURES_TOGETHER * i + 1, PICTURES_TOGETHER * i + part.len());
            blocks.push(Block::Picture {
                caption: format!(
                    "Recordings {first} to {last} over time: tilt (thick) and height of the tip, from \
                     its lowest to 40 cm above it; the bar is the closed gripper, light blue the \
                     demonstration, darker its {}. Grey: left out; of two arms the one that moves more.",
                    task.action.name()
                ),
                file: format!("recordings-{}.svg", i + 1),
                svg: recordings_svg(part, task.tilt_threshold_deg())?,
            });
        }
        let (head, rows) = self.table();
        blocks.push(Block::Table { caption: "What was found".into(), head, rows });
        Ok(Page { title: format!("Demonstrations of {}", task.name), blocks })
    }

    fn plotted(&self, i: usize, recording: &Examined) -> PlottedRecording {
        let title = format!("{} {}: {}", i + 1, recording.id, self.result(recording));
        let segment = recording.outcome.as_ref().ok().map(|(segment, _)| segment);
        let arms = recording.quality.iter().flat_map(|quality| &quality.arms);
        let arm = match segment {
            Some(segment) => arms.into_iter().find(|arm| arm.arm == segment.arm),
            None => arms.into_iter().max_by(|a, b| a.extent_m.total_cmp(&b.extent_m)),
        };
        let timeline = arm.map(|arm| arm.timeline.clone()).unwrap_or_default();
        PlottedRecording {
            title,
            accepted: segment.is_some(),
            times_secs: timeline.times_secs,
            tilt_deg: timeline.tilt_deg,
            height_m: timeline.height_m,
            percent_open: timeline.percent_open,
            segment_secs: segment.map(|s| [s.start_secs, s.end_secs]),
            action_secs: segment.map(|s| [s.action_start_secs, s.action_end_secs]),
        }
    }
}

/// Joints further beyond their limits than this are not those of the description. Those of MIME are up to
/// 0.18 rad.
const BEYOND_LIMITS: f64 = 0.5;

fn is_the_same(neighbour: &Neighbour) -> bool {
    neighbour.motion_m < SAME_MOTION_M
}

/// How values are spread.
struct Spread {
    name: String,
    unit: &'static str,
    mean: f64,
    stddev: f64,
    low: f64,
    high: f64,
}

impl Spread {
    /// Of at least one value.
    fn new(name: String, unit: &'static str, values: &[f64]) -> Self {
        let count = values.len() as f64;
        let mean = values.iter().sum::<f64>() / count;
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        let extreme = |pick: fn(f64, f64) -> f64| values.iter().copied().fold(mean, pick);
        let (low, high) = (extreme(f64::min), extreme(f64::max));
        Self { name, unit, mean, stddev: (squares / count).sqrt(), low, high }
    }
}

/// A value as people read it, with its unit.
fn written(value: f64, unit: &str) -> String {
    match unit {
        "m" => format!("{value:.3} m"),
        "s" => format!("{value:.2} s"),
        "degrees" => format!("{value:.1}°"),
        unit => format!("{value:.3} {unit}"),
    }
}

fn quality_json(quality: &Quality) -> Value {
    let Quality {
        frames,
        gaps,
        longest_gap_secs,
        largest_jump,
        idle_start_secs,
        idle_end_secs,
        arms,
    } = quality;
    let jump = largest_jump.as_ref().map(|jump| {
        json!({ "joint": jump.joint, "change_rad": jump.change_rad, "at_secs": jump.at_secs })
    });
    let arm = |arm: &ArmQuality| {
        let ArmQuality {
            arm,
            extent_m,
            grasps,
            actions,
            frames_outside,
            furthest_outside,
            timeline: _,
        } = arm;
        let furthest =
            furthest_outside.as_ref().map(|(joint, by)| json!({ "joint": joint, "by": by }));
        json!({
            "arm": arm, "extent_m": extent_m, "grasps": grasps, "actions": actions,
            "frames_outside_limits": frames_outside, "furthest_outside_limits": furthest,
        })
    };
    json!({
        "frames": frames, "gaps": gaps, "longest_gap_secs": longest_gap_secs, "largest_jump": jump,
        "idle_secs": [idle_start_secs, idle_end_secs], "arms": arms.iter().map(arm).collect::<Vec<_>>(),
    })
}
