//! `tcvae check`: what a server makes of requests over the whole trained region.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::Context;
use clap::Args;
use nalgebra::Isometry3;
use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};
use rayon::prelude::*;
use serde_json::{Value, json};

use tcvae::artifact::Artifact;
use tcvae::kinematics::Joint;
use tcvae::parameters::Interval;
use tcvae::report::{Asked, Outcome, requests_svg};
use tcvae::serving::{
    ErrorCode, GivenLocation, PrimitiveServer, SPEEDS, Sample, SampleRequest, ServedModel, Settings,
};

use super::sample::sample_json;
use super::{ExitStatus, UsageError, print_json, print_line, server, write_whole, write_with};

/// Requests that are timed one after the other, before the rest is worked out on all cores.
const TIMED: usize = 300;
/// The slowest of them that are told.
const MOST_TOLD: usize = 10;
/// Requests whose samples are in memory at the same time.
const AT_ONCE: usize = 1000;
/// Draws of a task until one lies among those that were trained on, and of a start until it is clear.
const MOST_DRAWS: usize = 10_000;

/// Arguments of `tcvae check`.
#[derive(Debug, Args)]
pub(crate) struct CheckArgs {
    /// The model file
    model: PathBuf,
    /// The robot's TOML; Baxter's left arm without
    #[arg(long, value_name = "FILE")]
    robot: Option<PathBuf>,
    /// Number of requests, each of another task in another manner
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u32).range(1..))]
    count: u32,
    /// Seed of the requests
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Ask for tasks up to so much outside the trained region, too (m), and allow them
    #[arg(long, value_name = "M", default_value_t = 0.0, allow_hyphen_values = true)]
    beyond: f64,
    /// Let the arm begin anywhere, so that each motion has an approach
    #[arg(long)]
    from_anywhere: bool,
    /// Share of the requests that can be followed that must be served; below it the exit code is 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.995)]
    at_least: f64,
    /// Print the answer as JSON
    #[arg(long)]
    pub(crate) json: bool,
    /// Draw where requests are served, from above, into an SVG file
    #[arg(long, value_name = "FILE")]
    plot: Option<PathBuf>,
    /// Write each request that was served with its sample, one JSON object a line, for other programs to verify
    #[arg(long, value_name = "F.jsonl")]
    samples: Option<PathBuf>,
    /// Write each request of a known kind that was refused with the paths of its draws, one JSON object a line, for
    /// other programs to find out whether they could be followed
    #[arg(long, value_name = "F.jsonl")]
    refused: Option<PathBuf>,
    /// How many times as fast as it was learned each motion is to be
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, allow_hyphen_values = true)]
    speed: f64,
}

/// A request and what came of it.
struct Checked {
    request: SampleRequest,
    /// Whether its task is like those that were trained on.
    familiar: bool,
    outcome: Outcome,
    /// The code of its refusal.
    refused: Option<ErrorCode>,
    sample: Option<Measured>,
    /// The lines that are written of it, until they are: of its sample, or of its refusal.
    lines: [Option<Vec<u8>>; 2],
    /// What the sample breaks after all.
    violations: Vec<String>,
    millis: f64,
}

/// What is kept of a sample.
struct Measured {
    task_error: f64,
    position_error: f64,
    orientation_error: f64,
    joint_margin: f64,
    min_clearance: f64,
    slowdown: f64,
    /// The fastest joint's speed, as a share of its limit.
    speed_share: f64,
    tries: f64,
}

impl Measured {
    fn new(sample: &Sample, joints: &[Joint]) -> Self {
        let speeds = sample.joint_trajectory.velocities.iter().flat_map(|v| v.iter().zip(joints));
        Self {
            task_error: sample.task_error,
            position_error: sample.position_error,
            orientation_error: sample.orientation_error,
            joint_margin: sample.joint_margin,
            min_clearance: sample.min_clearance,
            slowdown: sample.slowdown,
            speed_share: speeds.map(|(v, joint)| v.abs() / joint.velocity).fold(0.0, f64::max),
            tries: f64::from(sample.tries),
        }
    }
}

pub(crate) fn run(args: CheckArgs) -> anyhow::Result<ExitStatus> {
    for (name, value, fits, expected) in [
        ("--at-least", args.at_least, (0.0..=1.0).contains(&args.at_least), "0 to 1"),
        ("--speed", args.speed, (SPEEDS[0]..=SPEEDS[1]).contains(&args.speed), "0.1 to 4"),
        ("--beyond", args.beyond, (0.0..=10.0).contains(&args.beyond), "0 to 10 m"),
    ] {
        if !fits {
            return Err(UsageError(format!("{name} {value}: {expected} are possible")).into());
        }
    }
    let artifact = Artifact::load(&args.model)
        .with_context(|| format!("the model {}", args.model.display()))?;
    let server = server(&artifact, args.robot.as_deref(), Settings::default())?;
    let requests = requests(&args, &server)?;
    let timed = requests.len().min(TIMED);
    let mut checked: Vec<Checked> = Vec::new();
    let mut check_all = |files: &mut [Option<&mut dyn Write>; 2]| -> anyhow::Result<()> {
        let with_lines = files.each_ref().map(Option::is_some);
        let (first, rest) = requests.split_at(timed);
        let first = first.iter().map(|request| check(&server, request, with_lines)).collect();
        let at_once = |some: &[SampleRequest]| -> Vec<_> {
            some.par_iter().map(|request| check(&server, request, with_lines)).collect()
        };
        for mut some in std::iter::once(first).chain(rest.chunks(AT_ONCE).map(at_once)) {
            for one in &mut some {
                for (file, line) in files.iter_mut().zip(&mut one.lines) {
                    if let (Some(file), Some(line)) = (file, line.take()) {
                        file.write_all(&line)?;
                    }
                }
            }
            checked.extend(some);
        }
        Ok(())
    };
    match (&args.samples, &args.refused) {
        (Some(samples), Some(refused)) => write_with(samples, |samples| {
            write_with(refused, |refused| check_all(&mut [Some(samples), Some(refused)]))
        })?,
        (Some(path), None) => write_with(path, |file| check_all(&mut [Some(file), None]))?,
        (None, Some(path)) => write_with(path, |file| check_all(&mut [None, Some(file)]))?,
        (None, None) => check_all(&mut [None, None])?,
    }
    if let Some(path) = &args.plot {
        let locations = server.model().space().locations();
        let names: Vec<_> = locations.iter().map(|l| l.name.clone()).collect();
        let asked = checked.iter().map(|c| Asked {
            task: c.request.task.iter().map(|location| location.xy).collect(),
            outcome: c.outcome,
        });
        write_whole(path, &requests_svg(&names, &asked.collect::<Vec<_>>())?)?;
    }
    let answer = answer(&args, &server, &checked, timed);
    if args.json {
        print_json(&answer);
    } else {
        table(&answer);
    }
    let violations = answer["violations"].as_u64().unwrap_or(0);
    let share = answer["served_fraction"].as_f64();
    let below = share.map_or(args.at_least > 0.0, |share| share < args.at_least);
    Ok(if violations > 0 || below { ExitStatus::BelowAsked } else { ExitStatus::Done })
}

/// Requests drawn evenly from the trained region, or from around it, each in its own manner.
fn requests(args: &CheckArgs, server: &PrimitiveServer) -> anyhow::Result<Vec<SampleRequest>> {
    let ServedModel { familiarity, .. } = server.model();
    let mut rng = ChaCha8Rng::seed_from_u64(args.seed);
    let chain = &server.robot().chain;
    let mut requests = Vec::new();
    for i in 0..u64::from(args.count) {
        let mut tries = 0;
        let task = loop {
            let task = task(server, args.beyond, &mut rng);
            let w: Vec<f64> = task.iter().flat_map(|location| location.xy).collect();
            if args.beyond > 0.0 || familiarity.task(&w) > 0.0 {
                break task;
            }
            tries += 1;
            anyhow::ensure!(
                tries < MOST_DRAWS,
                "none of {MOST_DRAWS} tasks drawn from the trained region lies among the training tasks; \
                 ask for --beyond 0.01"
            );
        };
        let start = match args.from_anywhere {
            true => chain.joint_names().into_iter().zip(anywhere(server, &mut rng)?).collect(),
            false => Vec::new(),
        };
        // Seeds of requests differ from those of other runs; 0 would be the server's own.
        let seed = args.seed.wrapping_mul(1 << 32).wrapping_add(i).max(1);
        requests.push(SampleRequest {
            task,
            start,
            seed,
            sample_manner: true,
            speed: args.speed,
            allow_out_of_distribution: args.beyond > 0.0,
            ..SampleRequest::default()
        });
    }
    Ok(requests)
}

/// A configuration in which the arm may stand.
fn anywhere(server: &PrimitiveServer, rng: &mut ChaCha8Rng) -> anyhow::Result<Vec<f64>> {
    let robot = server.robot();
    (0..MOST_DRAWS).map(|_| robot.chain.draw(rng)).find(|q| robot.is_clear(q)).with_context(|| {
        format!(
            "in none of {MOST_DRAWS} configurations {} is clear of itself and the table",
            robot.name
        )
    })
}

fn task(server: &PrimitiveServer, beyond_m: f64, rng: &mut ChaCha8Rng) -> Vec<GivenLocation> {
    let mut draw =
        |Interval { lower, upper }: Interval| rng.random_range(lower - beyond_m..=upper + beyond_m);
    let locations = server.model().space().locations();
    let at = |l: &tcvae::parameters::TaskLocation| GivenLocation {
        name: l.name.clone(),
        xy: [draw(l.x), draw(l.y)],
    };
    locations.iter().map(at).collect()
}

fn check(server: &PrimitiveServer, request: &SampleRequest, with_lines: [bool; 2]) -> Checked {
    let start = Instant::now();
    let reply = server.sample(request, 0.0);
    let millis = 1e3 * start.elapsed().as_secs_f64();
    let refused = reply.refusal.map(|refusal| refusal.code);
    let sample = reply.samples.first();
    let familiar = server.is_familiar(request, 0.0).unwrap_or(false);
    let outcome = if sample.is_some() {
        Outcome::Served
    } else if !familiar {
        Outcome::Unfamiliar
    } else if server.could_be_followed(request, 0.0).unwrap_or(true) {
        Outcome::Refused
    } else {
        Outcome::OutOfReach
    };
    Checked {
        request: request.clone(),
        familiar,
        outcome,
        refused,
        sample: sample.map(|s| Measured::new(s, server.robot().chain.joints())),
        lines: [
            sample.filter(|_| with_lines[0]).map(|s| line(server, request, s)),
            refused
                .filter(|_| with_lines[1] && familiar)
                .map(|code| refused_line(server, request, code, outcome)),
        ],
        violations: sample.map_or(Vec::new(), |s| violations(server, request, s)),
        millis,
    }
}

/// What a sample breaks, judged by what it says of itself alone.
fn violations(server: &PrimitiveServer, request: &SampleRequest, sample: &Sample) -> Vec<String> {
    let (model, robot) = (server.model(), server.robot());
    let (chain, trajectory) = (&robot.chain, &sample.joint_trajectory);
    let times = &trajectory.times_secs;
    let mut broken = Vec::new();
    let mut hold = |what: &str, holds: bool| {
        if !holds {
            broken.push(what.to_owned());
        }
    };
    hold("names of the joints", trajectory.joint_names == chain.joint_names());
    hold("times rise", times[0] > 0.0 && times.windows(2).all(|t| t[1] > t[0]));
    hold(
        "rest at the end",
        trajectory.velocities.last().is_some_and(|v| v.iter().all(|v| *v == 0.0)),
    );
    hold("limits", trajectory.positions.iter().all(|q| chain.within_limits(q)));
    let speeds = trajectory
        .velocities
        .iter()
        .all(|v| v.iter().zip(chain.joints()).all(|(v, j)| v.abs() <= j.velocity * (1.0 + 1e-9)));
    hold("velocities", speeds);
    let steps = (1..times.len()).all(|k| {
        let pair = trajectory.positions[k].iter().zip(&trajectory.positions[k - 1]);
        let step_secs = times[k] - times[k - 1];
        pair.zip(chain.joints())
            .all(|((b, a), j)| (b - a).abs() <= j.velocity * step_secs * (1.0 + 1e-9))
    });
    hold("steps", steps);
    let poses = &sample.end_effector_trajectory.base_from_tip;
    let forward =
        trajectory.positions.iter().zip(poses).all(|(q, pose)| {
            (chain.forward(q).to_homogeneous() - pose.to_homogeneous()).norm() < 1e-9
        });
    hold("forward kinematics", forward && poses.len() == times.len());
    let begin = sample.primitive_start_index as usize;
    let motion = tcvae::trajectory::Motion {
        states: model.frame.trajectory(&poses[begin..]),
        duration_secs: (times[times.len() - 1] - times[begin]) / sample.slowdown * request.speed,
    };
    let w: Vec<f64> = request.task.iter().flat_map(|location| location.xy).collect();
    let reached = model.task.empirical_task(&motion).ok();
    let error = reached.map_or(f64::INFINITY, |reached| {
        let pairs = reached.values().chunks(2).zip(w.chunks(2));
        pairs.map(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1])).fold(0.0, f64::max)
    });
    hold("the task", error <= server.settings().tolerance_m);
    hold("validity", model.task.violations(&motion).is_empty());
    let nearest = robot.hull.nearest_of(chain, trajectory.positions.iter().map(Vec::as_slice));
    hold("clearance", nearest.is_none_or(|nearest| nearest.distance_m >= robot.clearance_m));
    broken
}

/// What benches/peers/feasible.py reads.
fn refused_line(
    server: &PrimitiveServer,
    request: &SampleRequest,
    code: ErrorCode,
    outcome: Outcome,
) -> Vec<u8> {
    let wished = server.wished(request, 0.0).unwrap_or_default();
    let pose = |pose: &Isometry3<f64>| {
        let (p, q) = (pose.translation.vector, pose.rotation);
        [p.x, p.y, p.z, q.i, q.j, q.k, q.w]
    };
    let paths = wished.iter().map(|path| path.iter().map(pose).collect::<Vec<_>>());
    let line = json!({
        "seed": request.seed,
        "code": code.name(),
        "could_be_followed": outcome == Outcome::Refused,
        "paths": paths.collect::<Vec<_>>(),
    });
    (line.to_string() + "\n").into_bytes()
}

/// What tests/verify reads.
fn line(server: &PrimitiveServer, request: &SampleRequest, sample: &Sample) -> Vec<u8> {
    let settings = server.settings();
    let task: BTreeMap<_, _> = request.task.iter().map(|l| (&l.name, l.xy)).collect();
    let start: BTreeMap<_, _> = request.start.iter().map(|(name, q)| (name, q)).collect();
    let line = json!({
        "request": {
            "task": task,
            "tolerance_m": settings.tolerance_m,
            "velocity_scale": settings.velocity_scale,
            "acceleration_scale": settings.acceleration_scale,
            "speed": request.speed,
            "start": if start.is_empty() { Value::Null } else { json!(start) },
        },
        "sample": sample_json(sample),
    });
    (line.to_string() + "\n").into_bytes()
}

fn answer(args: &CheckArgs, server: &PrimitiveServer, checked: &[Checked], timed: usize) -> Value {
    let count =
        |outcome: Outcome| checked.iter().filter(|c| c.familiar && c.outcome == outcome).count();
    let unfamiliar: Vec<_> = checked.iter().filter(|c| !c.familiar).collect();
    let served_unfamiliar = unfamiliar.iter().filter(|c| c.sample.is_some()).count();
    let served = count(Outcome::Served);
    let feasible = served + count(Outcome::Refused);
    let mut refused = BTreeMap::<&str, usize>::new();
    for code in checked.iter().filter_map(|c| c.refused) {
        *refused.entry(code.name()).or_default() += 1;
    }
    let samples = || checked.iter().filter_map(|c| c.sample.as_ref());
    let least = |of: fn(&Measured) -> f64| samples().map(of).fold(f64::INFINITY, f64::min);
    let most = |of: fn(&Measured) -> f64| samples().map(of).fold(f64::NEG_INFINITY, f64::max);
    let slowed = samples().filter(|s| s.slowdown > 1.0).count();
    let tries: Vec<f64> = samples().map(|s| s.tries).collect();
    let violations: Vec<_> = checked
        .iter()
        .filter(|c| !c.violations.is_empty())
        .map(|c| json!({ "seed": c.request.seed, "broken": c.violations }))
        .collect();
    let mut slowest: Vec<&Checked> = checked[..timed].iter().collect();
    slowest.sort_by(|a, b| b.millis.total_cmp(&a.millis));
    let millis = |rank: usize| slowest[slowest.len() - 1 - rank.min(slowest.len() - 1)].millis;
    let told = slowest.iter().take(MOST_TOLD).map(|c| {
        let tries = c.sample.as_ref().map(|sample| sample.tries);
        json!({ "seed": c.request.seed, "ms": c.millis, "tries": tries, "refused": c.refused.map(ErrorCode::name) })
    });
    let finite = |value: f64| if value.is_finite() { json!(value) } else { Value::Null };
    json!({
        "model_id": server.model().model_id,
        "robot": server.robot().name,
        "seed": args.seed,
        "requests": checked.len(),
        "unfamiliar": unfamiliar.len(),
        "served_unfamiliar": served_unfamiliar,
        "out_of_reach": count(Outcome::OutOfReach),
        "feasible": feasible,
        "served": served,
        "served_fraction":
            if feasible == 0 { Value::Null } else { json!(served as f64 / feasible as f64) },
        "refused": refused,
        "violations": violations.len(),
        "violated": violations,
        "worst": {
            "task_error_m": finite(most(|s| s.task_error)),
            "position_error_m": finite(most(|s| s.position_error)),
            "orientation_error_rad": finite(most(|s| s.orientation_error)),
            "joint_margin_rad": finite(least(|s| s.joint_margin)),
            "clearance_m": finite(least(|s| s.min_clearance)),
            "speed_share": finite(most(|s| s.speed_share)),
            "slowdown": finite(most(|s| s.slowdown)),
        },
        "slowed_fraction": finite(slowed as f64 / tries.len() as f64),
        "tries": {
            "mean": finite(tries.iter().sum::<f64>() / tries.len() as f64),
            "most": finite(tries.iter().copied().fold(f64::NEG_INFINITY, f64::max)),
        },
        "latency_ms": {
            "median": millis(timed / 2),
            "p99": millis(timed * 99 / 100),
            "timed": timed,
            "slowest": told.collect::<Vec<_>>(),
        },
    })
}

fn table(answer: &Value) {
    let number = |value: &Value| match value.as_f64() {
        Some(value) if value.fract() == 0.0 => format!("{value:.0}"),
        Some(value) => format!("{value:.4}"),
        None => "-".into(),
    };
    let of = |key: &str| number(&answer[key]);
    print_line(&format!(
        "{} requests: {} can be followed, {} of them served ({}); {} out of reach; {} unfamiliar, of which \
         {} served",
        of("requests"),
        of("feasible"),
        of("served"),
        of("served_fraction"),
        of("out_of_reach"),
        of("unfamiliar"),
        of("served_unfamiliar")
    ));
    for (what, values) in [
        ("refused", &answer["refused"]),
        ("worst", &answer["worst"]),
        ("tries", &answer["tries"]),
        ("ms", &answer["latency_ms"]),
    ] {
        let values = values.as_object().into_iter().flatten().filter(|(_, v)| !v.is_array());
        let values: Vec<_> = values.map(|(name, v)| format!("{name} {}", number(v))).collect();
        print_line(&format!("  {what:8} {}", values.join(", ")));
    }
    print_line(&format!("  slowed   {} of the served", of("slowed_fraction")));
    print_line(&format!("  violated {} samples", of("violations")));
}
