//! The figures of a report, from the first model of a row.

use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;

use tcvae::artifact::{Artifact, Learned};
use tcvae::demonstrations::Demonstration;
use tcvae::evaluation::ACTIVE_KL_NATS;
use tcvae::parameters::{MannerParameters, TaskParameters};
use tcvae::report::{
    Block, Curve, Panel, Plane, PlottedMotion, Points, locations_svg, paths_svg, tilts_svg,
};
use tcvae::trajectory::Motion;

use super::super::UsageError;
use super::{Figure, Loaded, Shows, Sources, row, slug};

/// Values of a manner parameter along its traversal, in standard deviations.
const VALUES: [f64; 7] = [-2.0, -4.0 / 3.0, -2.0 / 3.0, 0.0, 2.0 / 3.0, 4.0 / 3.0, 2.0];
/// Tasks that samples are shown for, and samples for each.
const TASKS: usize = 6;
const SAMPLES: usize = 40;

/// Checks that there is something to turn where a figure turns manner parameters.
pub(super) fn check(figures: &[Figure], rows: &[Loaded<'_>]) -> Result<(), UsageError> {
    for Figure { name, rows: names, .. } in
        figures.iter().filter(|figure| !matches!(figure.shows, Shows::Locations))
    {
        for row in names.iter().map(|name| row(rows, name)) {
            if row.models[0].primitive().manner_space().dim() == 0 {
                let row = &row.config.name;
                return Err(UsageError(format!(
                    "{name}: {row} has no manner parameter to turn; show its locations"
                )));
            }
        }
    }
    Ok(())
}

/// A picture for each row; of locations, one for all.
pub(super) fn draw(
    figure: &Figure,
    rows: &[Loaded<'_>],
    sources: &Sources,
    seed: u64,
) -> anyhow::Result<Vec<Block>> {
    let Figure { name, caption, shows, rows: names } = figure;
    let shown: Vec<&Loaded<'_>> = names.iter().map(|name| row(rows, name)).collect();
    let picture = |title: &str, svg: String| Block::Picture {
        caption: format!("{name}. {caption}"),
        file: format!("{}.svg", slug(&format!("{name} {title}"))),
        svg,
    };
    if let Shows::Locations = shows {
        let panels = shown.iter().map(|row| locations(row, sources, seed)).collect::<Vec<_>>();
        let task = &shown[0].models[0].document;
        // The paper's circle: the middle threshold.
        let radius = task.task.thresholds()[1];
        let unit = axis_unit(&task.task_space.unit);
        let (x, y) = (format!("off in x{unit}"), format!("off in y{unit}"));
        let plane = Plane { x, y, mark: [0.0, 0.0], radius };
        let svg = locations_svg(name, &panels, &plane, 3.5 * radius)?;
        return Ok(vec![picture("", svg)]);
    }
    let of_row = |row: &&Loaded<'_>| {
        let artifact = &row.models[0];
        let w = typical_task(artifact, sources);
        let title = format!("{name}: {}", row.config.name);
        let svg = match shows {
            Shows::Paths => {
                let unit = axis_unit(&artifact.document.task_space.unit);
                let [x, y] = w.location(0);
                let plane = Plane {
                    x: format!("x{unit}"),
                    y: format!("y{unit}"),
                    mark: [x, y],
                    radius: artifact.document.task.thresholds()[1],
                };
                let path = |motion: Motion| motion.states.states().map(|s| (s[0], s[1])).collect();
                paths_svg(&title, &traversals(artifact, &w, path), &plane)?
            }
            Shows::Tilts => {
                let task = &artifact.document.task;
                let Some((frame, threshold)) = task.state_frame().zip(task.tilt_threshold_deg())
                else {
                    anyhow::bail!("{name}: nothing is tilted in its task; show paths");
                };
                let plotted = |motion: Motion| PlottedMotion {
                    times_secs: (0..motion.states.steps())
                        .map(|i| i as f64 * motion.step_secs())
                        .collect(),
                    base_from_tip: frame.poses(&motion.states),
                };
                tilts_svg(&title, &traversals(artifact, &w, plotted), threshold)?
            }
            Shows::Locations => unreachable!("drawn above"),
        };
        Ok(picture(&row.config.name, svg))
    };
    shown.iter().map(of_row).collect()
}

/// A panel for each manner parameter.
fn traversals<T>(
    artifact: &Artifact,
    w: &TaskParameters,
    shown: impl Fn(Motion) -> T,
) -> Vec<Panel<Curve<T>>> {
    let primitive = artifact.primitive();
    let space = primitive.manner_space();
    let active = |axis: usize| match &artifact.document.learned {
        Learned::TcVae(model) => model.latents[axis].kl > ACTIVE_KL_NATS,
        Learned::Classical(_) => false,
    };
    let panel = |(axis, name): (usize, String)| {
        let curve = |&value: &f64| {
            let mut h = vec![0.0; space.dim()];
            h[axis] = value;
            let h = MannerParameters::clamped(space, &h);
            let motion = primitive.decode(w, &h).motion(artifact.document.duration_secs);
            Curve { value, shown: shown(motion) }
        };
        let title = if active(axis) { name } else { format!("{name} (inactive)") };
        Panel { title, shown: VALUES.iter().map(curve).collect() }
    };
    space.names().into_iter().enumerate().map(panel).collect()
}

/// How far from their task samples achieve it: points of one set belong to one task.
fn locations(row: &Loaded<'_>, sources: &Sources, seed: u64) -> Panel<Points> {
    let artifact = &row.models[0];
    let (primitive, task) = (artifact.primitive(), artifact.document.task.task());
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let cases = &sources.of(artifact).splits.test;
    let of_case = |case: &Demonstration| {
        let [x, y] = case.w.location(0);
        let mut sample = || {
            let h = primitive.sample_manner(&mut rng);
            let motion = primitive.decode(&case.w, &h).motion(artifact.document.duration_secs);
            let [u, v] = task.empirical_task(&motion).ok()?.location(0);
            Some((u - x, v - y))
        };
        (0..SAMPLES).filter_map(|_| sample()).collect()
    };
    let every = (cases.len() / TASKS).max(1);
    let shown = cases.iter().step_by(every).take(TASKS).map(of_case).collect();
    Panel { title: row.config.name.clone(), shown }
}

/// The test case's task that is nearest to the mean of all.
fn typical_task(artifact: &Artifact, sources: &Sources) -> TaskParameters {
    let cases = &sources.of(artifact).splits.test;
    let dim = artifact.document.task_space.dim();
    let mean =
        |i: usize| cases.iter().map(|case| case.w.values()[i]).sum::<f64>() / cases.len() as f64;
    let mean: Vec<f64> = (0..dim).map(mean).collect();
    let from_mean = |w: &TaskParameters| -> f64 {
        w.values().iter().zip(&mean).map(|(a, b)| (a - b).powi(2)).sum()
    };
    let nearest = cases.iter().min_by(|a, b| from_mean(&a.w).total_cmp(&from_mean(&b.w)));
    nearest.expect("measured before, so there are cases").w.clone()
}

/// ` (m)`; nothing where values have no unit.
fn axis_unit(unit: &str) -> String {
    if unit == "1" { String::new() } else { format!(" ({unit})") }
}
