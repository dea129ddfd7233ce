//! `tcvae sample`: motions of a model, checked as the node checks them.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{Args, ValueEnum};
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use serde_json::{Value, json};

use tcvae::artifact::Artifact;
#[cfg(feature = "bag")]
use tcvae::config::LoadedRobot;
use tcvae::parameters::{MannerParameters, TaskParameters, TaskSpace};
use tcvae::report::{PlottedLocation, PlottedMotion, motions_svg};
use tcvae::serving::{
    ErrorCode, GivenLocation, MAX_COUNT, RankBy, Refusal, Sample, SampleReply, SampleRequest,
    Settings,
};

#[cfg(feature = "bag")]
use super::sources::load_robot;
use super::{ExitStatus, UsageError, print_json, print_line, server, write_whole};

/// Arguments of `tcvae sample`.
#[derive(Debug, Args)]
pub(crate) struct SampleArgs {
    /// The model file
    model: PathBuf,
    /// A location of the task in the base frame (m); one for each location of the model
    #[arg(long, value_name = "NAME=X,Y", value_parser = location)]
    task: Vec<GivenLocation>,
    /// The robot's TOML; Baxter's left arm without
    #[arg(long, value_name = "FILE")]
    robot: Option<PathBuf>,
    /// A manner parameter, in standard deviations of the prior; the others are 0
    #[arg(long, value_name = "NAME=VALUE", value_parser = named_value, allow_hyphen_values = true)]
    manner: Vec<(String, f64)>,
    /// Draw the manner parameters that --manner does not give from the prior
    #[arg(long)]
    random_manner: bool,
    /// Number of motions, at most 64
    #[arg(long, default_value_t = 1)]
    count: u32,
    /// Seed of the draws
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
    seed: u64,
    /// Serve a task outside the trained region, with a warning
    #[arg(long)]
    allow_out_of_distribution: bool,
    /// Where a joint stands (rad or m), from where the arm is brought to the first point; one for each joint
    #[arg(long, value_name = "JOINT=POSITION", value_parser = named_value, allow_hyphen_values = true)]
    start: Vec<(String, f64)>,
    /// How many times as fast as it was learned, where the limits allow it [default: 1]
    #[arg(long, value_name = "FACTOR", value_parser = above_zero, allow_hyphen_values = true)]
    speed: Option<f64>,
    /// Share of the velocity limits that may be used [default: 1]
    #[arg(long, value_name = "SHARE", value_parser = above_zero, allow_hyphen_values = true)]
    velocity_scale: Option<f64>,
    /// Share of the acceleration limits that may be used [default: 1]
    #[arg(long, value_name = "SHARE", value_parser = above_zero, allow_hyphen_values = true)]
    acceleration_scale: Option<f64>,
    /// Points per second [default: as many points as the model has]
    #[arg(long, value_name = "HZ", value_parser = above_zero, allow_hyphen_values = true)]
    rate_hz: Option<f64>,
    /// Order of the motions: as drawn, or the one first whose least distance to a joint limit is largest, that
    /// is smoothest, or that is shortest
    #[arg(long, value_enum, default_value_t)]
    rank_by: Order,
    /// Print the answer as JSON: the fields of Sample.msg
    #[arg(long, conflicts_with = "csv")]
    pub(crate) json: bool,
    /// Print the points as CSV: sample, time, joints, tip
    #[arg(long)]
    csv: bool,
    /// Write the motions, one after the other, as a recording that Foxglove and `ros2 bag` play
    #[cfg(feature = "bag")]
    #[arg(long, value_name = "F.mcap")]
    mcap: Option<PathBuf>,
    /// Draw the paths and the tilt over time into an SVG file
    #[arg(long, value_name = "FILE")]
    plot: Option<PathBuf>,
}

/// `NAME=X,Y`.
fn location(text: &str) -> Result<GivenLocation, String> {
    let parsed = || {
        let (name, xy) = text.split_once('=')?;
        let (x, y) = xy.split_once(',')?;
        let xy = [x.trim().parse().ok()?, y.trim().parse().ok()?];
        Some(GivenLocation { name: name.trim().into(), xy })
    };
    parsed().ok_or_else(|| "write it as NAME=X,Y, such as pour_location=0.65,0.25".into())
}

/// A number above 0, which in a request stands for the default.
fn above_zero(text: &str) -> Result<f64, String> {
    let parsed = text.trim().parse().ok().filter(|value: &f64| value.is_finite() && *value > 0.0);
    parsed.ok_or_else(|| "a number above 0 is needed".into())
}

/// What the motions are ordered by.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ValueEnum)]
enum Order {
    #[default]
    Drawn,
    Margin,
    Smoothness,
    Duration,
}

impl From<Order> for RankBy {
    fn from(order: Order) -> Self {
        match order {
            Order::Drawn => Self::Drawn,
            Order::Margin => Self::Margin,
            Order::Smoothness => Self::Smoothness,
            Order::Duration => Self::Duration,
        }
    }
}

/// `NAME=VALUE`.
fn named_value(text: &str) -> Result<(String, f64), String> {
    let parsed = || {
        let (name, value) = text.split_once('=')?;
        Some((name.trim().into(), value.trim().parse().ok()?))
    };
    parsed().ok_or_else(|| "write it as NAME=VALUE, such as h1=0.5".into())
}

pub(crate) fn run(args: SampleArgs) -> anyhow::Result<ExitStatus> {
    let artifact = Artifact::load(&args.model)
        .with_context(|| format!("the model {}", args.model.display()))?;
    if artifact.document.robot.is_none() {
        return states(&args, &artifact);
    }
    let server = server(&artifact, args.robot.as_deref(), Settings::default())?;
    let (manner_names, manner_values) = args.manner.iter().cloned().unzip();
    let request = SampleRequest {
        task: args.task.clone(),
        manner_names,
        manner_values,
        sample_manner: args.random_manner,
        count: args.count,
        seed: args.seed,
        start: args.start.clone(),
        velocity_scale: args.velocity_scale.unwrap_or_default(),
        acceleration_scale: args.acceleration_scale.unwrap_or_default(),
        speed: args.speed.unwrap_or_default(),
        rate_hz: args.rate_hz.unwrap_or_default(),
        rank_by: args.rank_by.into(),
        allow_out_of_distribution: args.allow_out_of_distribution,
        ..SampleRequest::default()
    };
    let reply = server.sample(&request, 0.0);
    if let Some(path) = &args.plot
        && !reply.samples.is_empty()
    {
        let threshold = artifact.document.task.tilt_threshold_deg();
        plot(path, &args, &reply.samples, server.settings().tolerance_m, threshold)?;
    }
    #[cfg(feature = "bag")]
    if let Some(path) = &args.mcap
        && !reply.samples.is_empty()
    {
        let robot = load_robot(args.robot.as_deref())?;
        write_mcap(path, &robot, &reply.samples)?;
    }
    if args.json {
        print_json(&reply_json(&reply));
    } else if args.csv {
        print_line(csv(&reply.samples).trim_end());
    } else {
        table(&reply);
    }
    match reply.refusal {
        None => Ok(ExitStatus::Done),
        Some(refusal) => {
            if !args.json {
                eprintln!("tcvae: {refusal}");
            }
            Ok(status(&refusal))
        }
    }
}

/// How a refusal ends the program.
fn status(refusal: &Refusal) -> ExitStatus {
    match refusal.code {
        ErrorCode::NoTask
        | ErrorCode::TaskUnknown
        | ErrorCode::NotFinite
        | ErrorCode::MannerUnknown
        | ErrorCode::MannerRange
        | ErrorCode::BadRequest => ExitStatus::WrongUsage,
        _ => ExitStatus::BelowAsked,
    }
}

fn reply_json(reply: &SampleReply) -> Value {
    let refusal = reply.refusal.as_ref();
    json!({
        "samples": reply.samples.iter().map(sample_json).collect::<Vec<_>>(),
        "error_code": refusal.map_or(0, |r| r.code as i32),
        "error_message": refusal.map_or("", |r| r.message.as_str()),
        "model_id": reply.model_id,
    })
}

/// The fields of Sample.msg. Times are numbers of seconds; NaN, which JSON has not, is null.
pub(super) fn sample_json(sample: &Sample) -> Value {
    let Sample {
        joint_trajectory,
        end_effector_trajectory,
        primitive_start_index,
        manner_names,
        manner_values,
        task: _,
        empirical_task,
        task_error,
        position_error,
        orientation_error,
        joint_margin,
        min_clearance,
        slowdown,
        in_distribution_task,
        in_distribution_manner,
        position_stddev,
        seed,
        tries,
        warnings,
    } = sample;
    let points = joint_trajectory.times_secs.iter().enumerate().map(|(i, time)| {
        json!({
            "positions": joint_trajectory.positions[i],
            "velocities": joint_trajectory.velocities[i],
            "accelerations": joint_trajectory.accelerations[i],
            "time_from_start": time,
        })
    });
    let tip = &end_effector_trajectory;
    let poses = tip.times_secs.iter().zip(&tip.base_from_tip).map(|(time, pose)| {
        let (p, q) = (pose.translation.vector, pose.rotation);
        json!({
            "transforms": [{
                "translation": { "x": p.x, "y": p.y, "z": p.z },
                "rotation": { "x": q.i, "y": q.j, "z": q.k, "w": q.w },
            }],
            "time_from_start": time,
        })
    });
    let empirical = empirical_task.iter().map(|location| {
        let [x, y] = location.xy;
        json!({ "name": location.name, "point": { "x": x, "y": y } })
    });
    json!({
        "joint_trajectory": {
            "joint_names": joint_trajectory.joint_names,
            "points": points.collect::<Vec<_>>(),
        },
        "end_effector_trajectory": { "points": poses.collect::<Vec<_>>() },
        "primitive_start_index": primitive_start_index,
        "manner_names": manner_names,
        "manner_values": manner_values,
        "empirical_task": empirical.collect::<Vec<_>>(),
        "task_error": task_error,
        "position_error": position_error,
        "orientation_error": orientation_error,
        "joint_margin": joint_margin,
        "min_clearance": min_clearance,
        "slowdown": slowdown,
        "in_distribution_task": in_distribution_task,
        "in_distribution_manner": in_distribution_manner,
        "position_stddev": position_stddev,
        "seed": seed,
        "tries": tries,
        "warnings": warnings,
    })
}

fn csv(samples: &[Sample]) -> String {
    let mut text = String::new();
    for (n, sample) in samples.iter().enumerate() {
        let joints = &sample.joint_trajectory;
        if n == 0 {
            text += "sample,time_s";
            for name in &joints.joint_names {
                let _ = write!(text, ",{name}");
            }
            text += ",x,y,z,qx,qy,qz,qw\n";
        }
        for (i, pose) in sample.end_effector_trajectory.base_from_tip.iter().enumerate() {
            let _ = write!(text, "{n},{:.6}", joints.times_secs[i]);
            for position in &joints.positions[i] {
                let _ = write!(text, ",{position:.6}");
            }
            let (p, q) = (pose.translation.vector, pose.rotation);
            for value in [p.x, p.y, p.z, q.i, q.j, q.k, q.w] {
                let _ = write!(text, ",{value:.6}");
            }
            text.push('\n');
        }
    }
    text
}

fn table(reply: &SampleReply) {
    if reply.samples.is_empty() {
        return;
    }
    print_line("sample  points  duration  task error  joint margin  slowdown  tries  manner");
    for (n, sample) in reply.samples.iter().enumerate() {
        let times = &sample.joint_trajectory.times_secs;
        let manner: Vec<_> = sample
            .manner_names
            .iter()
            .zip(&sample.manner_values)
            .map(|(name, value)| format!("{name} {value:+.2}"))
            .collect();
        print_line(&format!(
            "{n:6}  {:6}  {:6.2} s  {:7.1} mm  {:8.3} rad  {:8.2}  {:5}  {}",
            times.len(),
            times.last().copied().unwrap_or_default(),
            1e3 * sample.task_error,
            sample.joint_margin,
            sample.slowdown,
            sample.tries,
            manner.join(", ")
        ));
        for warning in &sample.warnings {
            print_line(&format!("        {warning}"));
        }
    }
}

/// The motions as a recording, with the description that shows the robot's.
#[cfg(feature = "bag")]
fn write_mcap(path: &Path, robot: &LoadedRobot, samples: &[Sample]) -> anyhow::Result<()> {
    use tcvae::bag::motions::{PlayedMotion, PlayedRobot, write_motions};
    let motion = |sample: &Sample| {
        let manner = sample.manner_names.iter().zip(&sample.manner_values);
        let manner: serde_json::Map<_, _> =
            manner.map(|(name, value)| (name.clone(), json!(value))).collect();
        let about = json!({
            "manner": manner, "task_error_m": sample.task_error, "seed": sample.seed,
        });
        PlayedMotion {
            about: about.to_string(),
            times_secs: sample.joint_trajectory.times_secs.clone(),
            base_from_tip: sample.end_effector_trajectory.base_from_tip.clone(),
            joint_positions: sample.joint_trajectory.positions.clone(),
        }
    };
    let motions: Vec<_> = samples.iter().map(motion).collect();
    let robot = PlayedRobot {
        base_frame: robot.config.base_frame.clone(),
        tip_frame: robot.config.tip_link.clone(),
        joint_names: samples[0].joint_trajectory.joint_names.clone(),
        description: Some(robot.urdf.clone()),
    };
    write_motions(path, &robot, &motions).map_err(|e| UsageError(e.to_string()).into())
}

fn plot(
    path: &Path,
    args: &SampleArgs,
    samples: &[Sample],
    tolerance_m: f64,
    threshold_deg: Option<f64>,
) -> anyhow::Result<()> {
    let motions: Vec<_> = samples
        .iter()
        .map(|sample| PlottedMotion {
            times_secs: sample.end_effector_trajectory.times_secs.clone(),
            base_from_tip: sample.end_effector_trajectory.base_from_tip.clone(),
        })
        .collect();
    let locations: Vec<_> =
        args.task.iter().map(|l| PlottedLocation { name: l.name.clone(), xy: l.xy }).collect();
    let title = format!("served motions: {}, from seed {}", samples.len(), args.seed);
    let svg = motions_svg(&title, &motions, &locations, tolerance_m, threshold_deg)?;
    write_whole(path, &svg)
}

/// A model without a robot: its states, as the decoder has them.
fn states(args: &SampleArgs, artifact: &Artifact) -> anyhow::Result<ExitStatus> {
    #[cfg(feature = "bag")]
    let with_mcap = args.mcap.is_some();
    #[cfg(not(feature = "bag"))]
    let with_mcap = false;
    let timing = [args.speed, args.velocity_scale, args.acceleration_scale, args.rate_hz];
    let of_an_arm = !args.start.is_empty()
        || timing.iter().any(Option::is_some)
        || args.rank_by != Order::default();
    if args.robot.is_some() || args.plot.is_some() || with_mcap || of_an_arm {
        let refused = "--robot, --plot, --mcap, --start, --speed, --velocity-scale, --acceleration-scale, --rate-hz and \
                       --rank-by are for models of a robot's tip; this one's states are";
        let states = artifact.document.state_names.join(", ");
        return Err(UsageError(format!("{refused} {states}")).into());
    }
    if !(1..=MAX_COUNT).contains(&args.count) {
        return Err(UsageError(format!("--count {}: 1 to {MAX_COUNT}", args.count)).into());
    }
    let primitive = artifact.primitive();
    let w = task(primitive.task_space(), &args.task)?;
    let space = primitive.manner_space();
    let mut samples = Vec::new();
    for i in 0..u64::from(args.count) {
        let mut rng = ChaCha8Rng::seed_from_u64(args.seed.wrapping_add(i));
        let mut h = match args.random_manner {
            true => primitive.sample_manner(&mut rng).values().to_vec(),
            false => vec![0.0; space.dim()],
        };
        for (name, value) in &args.manner {
            h[space.index(name).map_err(|e| UsageError(e.to_string()))?] = *value;
        }
        let h = MannerParameters::new(space, h).map_err(|e| UsageError(e.to_string()))?;
        samples.push((primitive.decode(&w, &h), h, args.seed.wrapping_add(i)));
    }
    if args.json {
        let samples = samples.iter().map(|(generated, h, seed)| {
            json!({
                "states": generated.mean.states().collect::<Vec<_>>(),
                "stddev": generated.stddev.states().collect::<Vec<_>>(),
                "state_names": artifact.document.state_names,
                "manner_names": space.names(),
                "manner_values": h.values(),
                "seed": seed,
            })
        });
        print_json(&json!({
            "samples": samples.collect::<Vec<_>>(),
            "error_code": 0,
            "error_message": "",
            "model_id": artifact.model_id(),
        }));
        return Ok(ExitStatus::Done);
    }
    print_line(&format!("sample,step,{}", artifact.document.state_names.join(",")));
    for (n, (generated, ..)) in samples.iter().enumerate() {
        for (t, state) in generated.mean.states().enumerate() {
            let values: Vec<_> = state.iter().map(|v| format!("{v:.6}")).collect();
            print_line(&format!("{n},{t},{}", values.join(",")));
        }
    }
    Ok(ExitStatus::Done)
}

fn task(space: &TaskSpace, given: &[GivenLocation]) -> Result<TaskParameters, UsageError> {
    let known = || {
        let names: Vec<_> = space.locations().iter().map(|l| l.name.as_str()).collect();
        names.join(", ")
    };
    if let Some(unknown) = given.iter().find(|g| space.location_index(&g.name).is_none()) {
        let reason = format!("no location {:?}; the model has {}", unknown.name, known());
        return Err(UsageError(reason));
    }
    let mut values = Vec::with_capacity(space.dim());
    for location in space.locations() {
        let given = given.iter().rfind(|g| g.name == location.name).ok_or_else(|| {
            UsageError(format!("give --task {}=X,Y; the model needs {}", location.name, known()))
        })?;
        values.extend(given.xy);
    }
    TaskParameters::new(space, values).map_err(|e| UsageError(e.to_string()))
}
