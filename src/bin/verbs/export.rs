//! `tcvae export`: the training set as a table or as a recording, for other programs.

use std::path::{Path, PathBuf};

use anyhow::ensure;
use clap::Args;
use serde_json::json;

use tcvae::demonstrations::{Demonstration, TaskConfig};

use super::sources::{Copies, Data, Recordings};
use super::{ExitStatus, UsageError, print_json, print_line, write_with};

/// Arguments of `tcvae export`.
#[derive(Debug, Args)]
pub(crate) struct ExportArgs {
    #[command(flatten)]
    recordings: Recordings,
    /// The file to write: a table (.csv), one line for each state, or a recording of the tip's poses (.mcap)
    #[arg(short, long, value_name = "F")]
    output: PathBuf,
    /// Also the copies that augmentation makes to train and to validate on
    #[arg(long)]
    copies: bool,
    /// Print the answer as JSON
    #[arg(long)]
    pub(crate) json: bool,
}

pub(crate) fn run(args: ExportArgs) -> anyhow::Result<ExitStatus> {
    let ExportArgs { recordings, output, copies, json } = args;
    let kind = output.extension().and_then(|extension| extension.to_str());
    let write: fn(&Path, &Data) -> anyhow::Result<()> = match kind {
        Some("csv") => write_csv,
        #[cfg(feature = "bag")]
        Some("mcap") => write_mcap,
        _ => {
            let output = output.display();
            let reason = format!(
                "-o {output}: the name of a table ends with .csv, that of a recording with .mcap"
            );
            return Err(UsageError(reason).into());
        }
    };
    let copies = if copies { Copies::Made } else { Copies::LeftOut };
    let data = recordings.data(None, copies)?;
    ensure!(
        episodes(&data).next().is_some(),
        "no demonstration to write: {}. `tcvae inspect` says why",
        data.summary.lines().take(2).collect::<Vec<_>>().join(", ")
    );
    write(&output, &data)?;
    let parts = data.splits.parts().map(|(name, part)| (name.to_owned(), json!(part.len())));
    let parts: serde_json::Map<_, _> = parts.into_iter().collect();
    if json {
        print_json(&json!({ "file": output, "episodes": parts, "data_digest": data.digest }));
    } else {
        eprintln!("{}", data.summary);
        print_line(&output.display().to_string());
    }
    Ok(ExitStatus::Done)
}

/// The demonstrations with their part and number, in their order.
fn episodes(data: &Data) -> impl Iterator<Item = (usize, &'static str, &Demonstration)> {
    let parts = data.splits.parts().into_iter();
    let all = parts.flat_map(|(name, part)| part.iter().map(move |d| (name, d)));
    all.enumerate().map(|(i, (name, demonstration))| (i, name, demonstration))
}

/// A line for each state, with the names of columns that LeRobot's data sets have where they mean the same.
fn write_csv(path: &Path, data: &Data) -> anyhow::Result<()> {
    let task = data.task.task();
    let mut names: Vec<String> =
        ["episode_index", "episode_id", "part", "frame_index", "timestamp"]
            .map(String::from)
            .to_vec();
    names.extend(state_columns(&data.task).iter().map(|name| format!("observation.state.{name}")));
    names.extend(task.task_space().value_names().iter().map(|name| format!("task.{name}")));
    let factors =
        episodes(data).next().map(|(_, _, d)| task.factors(&d.motion)).unwrap_or_default();
    names.extend(factors.iter().map(|factor| format!("manner.{}", factor.name)));
    write_with(path, |file| {
        writeln!(file, "{}", names.join(","))?;
        for (index, part, demonstration) in episodes(data) {
            let Demonstration { id, w, motion, .. } = demonstration;
            let factors = task.factors(motion).into_iter().map(|factor| factor.value);
            let constants: Vec<String> =
                w.values().iter().copied().chain(factors).map(number).collect();
            for (step, state) in states(&data.task, demonstration).into_iter().enumerate() {
                let time = number(step as f64 * motion.step_secs());
                write!(file, "{index},{},{part},{step},{time}", quoted(id))?;
                for value in state.into_iter().map(number).chain(constants.iter().cloned()) {
                    write!(file, ",{value}")?;
                }
                writeln!(file)?;
            }
        }
        Ok(())
    })
}

/// A text as a field of a table.
fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.into()
    }
}

fn number(value: f64) -> String {
    format!("{value:.9}")
}

/// Names of the values of [`states`].
fn state_columns(task: &TaskConfig) -> Vec<String> {
    match task.state_frame() {
        Some(_) => ["x", "y", "z", "qx", "qy", "qz", "qw"].map(String::from).to_vec(),
        None => task.state_names(),
    }
}

/// A demonstration's states; poses with a quaternion.
fn states(task: &TaskConfig, demonstration: &Demonstration) -> Vec<Vec<f64>> {
    let states = &demonstration.motion.states;
    let Some(frame) = task.state_frame() else {
        return states.states().map(<[f64]>::to_vec).collect();
    };
    let pose = |pose: nalgebra::Isometry3<f64>| {
        let (p, q) = (pose.translation.vector, pose.rotation);
        vec![p.x, p.y, p.z, q.i, q.j, q.k, q.w]
    };
    frame.poses(states).into_iter().map(pose).collect()
}

/// What there is to say of a demonstration.
#[cfg(feature = "bag")]
fn about(data: &Data, part: &str, demonstration: &Demonstration) -> serde_json::Value {
    let task = data.task.task();
    let names = task.task_space().value_names();
    let w: serde_json::Map<_, _> =
        names.into_iter().zip(demonstration.w.values().iter().map(|v| json!(v))).collect();
    let factors = task.factors(&demonstration.motion).into_iter();
    let manner: serde_json::Map<_, _> =
        factors.map(|f| (f.name.into_owned(), json!(f.value))).collect();
    json!({ "id": demonstration.id, "part": part, "task": w, "manner": manner })
}

#[cfg(feature = "bag")]
fn write_mcap(path: &Path, data: &Data) -> anyhow::Result<()> {
    use tcvae::bag::motions::{PlayedMotion, PlayedRobot, write_motions};
    let Some((frame, robot)) = data.task.state_frame().zip(data.robot.as_ref()) else {
        let reason = "its states are no poses of a robot's tip; write a table (.csv)";
        return Err(UsageError(format!("-o {}: {reason}", path.display())).into());
    };
    let motion = |(_, part, demonstration): (usize, &str, &Demonstration)| {
        let motion = &demonstration.motion;
        PlayedMotion {
            about: about(data, part, demonstration).to_string(),
            times_secs: (0..motion.states.steps()).map(|i| i as f64 * motion.step_secs()).collect(),
            base_from_tip: frame.poses(&motion.states),
            joint_positions: Vec::new(),
        }
    };
    let motions: Vec<_> = episodes(data).map(motion).collect();
    let robot = PlayedRobot {
        base_frame: robot.base_frame.clone(),
        tip_frame: robot.tip_frame.clone(),
        joint_names: Vec::new(),
        description: None,
    };
    write_motions(path, &robot, &motions).map_err(|e| UsageError(e.to_string()).into())
}
