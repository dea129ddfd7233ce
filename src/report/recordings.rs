//! Recordings in pictures: what the arm did over time in each, and where their tasks lie.

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::above::{chart_from_above, seen};
use super::{PlotError, colour, failed, range};

/// A recording over time.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PlottedRecording {
    /// Its title.
    pub title: String,
    /// Whether it is a demonstration; others are drawn in grey.
    pub accepted: bool,
    /// Times of the points (s).
    pub times_secs: Vec<f64>,
    /// Tilt of what is held (degrees), one value a point.
    pub tilt_deg: Vec<f64>,
    /// Height of the tip in the base frame (m), one value a point.
    pub height_m: Vec<f64>,
    /// Per cent that the gripper is open, one value a point; empty without a gripper.
    pub percent_open: Vec<f64>,
    /// From when to when the demonstration lasts.
    pub segment_secs: Option<[f64; 2]>,
    /// From when to when the action happens in it.
    pub action_secs: Option<[f64; 2]>,
}

/// The task of a demonstration: where its locations lie, in their order.
pub type PlottedTask = Vec<[f64; 2]>;

const WIDTH: u32 = 250;
const HEIGHT: u32 = 130;
const ACROSS: usize = 4;

/// A small picture for each recording: tilt and height over time, where the gripper is closed (bar below),
/// the demonstration (light) and the action in it (darker).
///
/// # Errors
/// What the drawing library reports.
pub fn recordings_svg(
    recordings: &[PlottedRecording],
    tilt_threshold_deg: Option<f64>,
) -> Result<String, PlotError> {
    let down = recordings.len().div_ceil(ACROSS).max(1) as u32;
    let mut svg = String::new();
    {
        let size = (WIDTH * ACROSS as u32, HEIGHT * down);
        let root = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        root.fill(&WHITE).map_err(failed)?;
        for (i, recording) in recordings.iter().enumerate() {
            let (column, row) = ((i % ACROSS) as u32, (i / ACROSS) as u32);
            let corner = (column * WIDTH, row * HEIGHT);
            draw(&root.clone().shrink(corner, (WIDTH, HEIGHT)), recording, tilt_threshold_deg)?;
        }
        root.present().map_err(failed)?;
    }
    Ok(svg)
}

fn draw(
    area: &DrawingArea<SVGBackend<'_>, Shift>,
    recording: &PlottedRecording,
    tilt_threshold_deg: Option<f64>,
) -> Result<(), PlotError> {
    const TITLE: u32 = 18;
    const HIGHEST_DEG: f64 = 130.0;
    const BAR_DEG: f64 = 10.0;
    let style = ("sans-serif", 12).into_text_style(area).pos(Pos::new(HPos::Left, VPos::Center));
    area.draw_text(&recording.title, &style, (30, TITLE as i32 / 2 + 1)).map_err(failed)?;
    let (_, area) = area.split_vertically(TITLE);
    let times = &recording.times_secs;
    let end = times.last().copied().unwrap_or(0.0).max(1e-3);
    let mut chart = ChartBuilder::on(&area)
        .margin_right(6)
        .x_label_area_size(18)
        .y_label_area_size(30)
        .build_cartesian_2d(0.0..end, -BAR_DEG..HIGHEST_DEG)
        .map_err(failed)?;
    let mut shade = |secs: Option<[f64; 2]>, strength: f64| {
        let Some([from, to]) = secs else { return Ok(()) };
        let area =
            Rectangle::new([(from, 0.0), (to, HIGHEST_DEG)], colour(0).mix(strength).filled());
        chart.draw_series([area]).map(|_| ()).map_err(failed)
    };
    shade(recording.segment_secs, 0.12)?;
    shade(recording.action_secs, 0.25)?;
    chart
        .configure_mesh()
        .disable_mesh()
        .x_labels(5)
        .y_labels(4)
        .x_label_formatter(&|v| format!("{v:.0} s"))
        .y_label_formatter(&|v| format!("{v:.0}°"))
        .label_style(("sans-serif", 10))
        .draw()
        .map_err(failed)?;
    if let Some(threshold) = tilt_threshold_deg {
        let line = [(0.0, threshold), (end, threshold)];
        chart
            .draw_series(DashedLineSeries::new(line, 4, 4, BLACK.mix(0.4).into()))
            .map_err(failed)?;
    }
    // Heights have a scale of their own: the lowest at the bottom, 40 cm above it at the top.
    let (lowest, _) = range(recording.height_m.iter().copied());
    let heights = recording.height_m.iter().map(|z| HIGHEST_DEG * ((z - lowest) / 0.4).min(1.0));
    let (tilts, heights_in) = match recording.accepted {
        true => (colour(0), colour(1)),
        false => (RGBColor(90, 90, 90), RGBColor(190, 170, 150)),
    };
    let line = |values: Vec<f64>| times.iter().copied().zip(values).collect::<Vec<_>>();
    chart.draw_series(LineSeries::new(line(heights.collect()), heights_in)).map_err(failed)?;
    let tilt = recording.tilt_deg.iter().map(|tilt| tilt.min(HIGHEST_DEG)).collect();
    chart.draw_series(LineSeries::new(line(tilt), tilts.stroke_width(2))).map_err(failed)?;
    // The gripper, as a bar where it is closed.
    let closed = recording.percent_open.iter().map(|open| *open < 50.0).collect::<Vec<_>>();
    let mut from = None;
    for i in 0..=closed.len() {
        match (closed.get(i).copied().unwrap_or(false), from) {
            (true, None) => from = Some(times[i]),
            (false, Some(start)) => {
                let until = times.get(i).copied().unwrap_or(end);
                let corners = [(start, -BAR_DEG), (until, -0.3 * BAR_DEG)];
                chart
                    .draw_series([Rectangle::new(corners, BLACK.mix(0.6).filled())])
                    .map_err(failed)?;
                from = None;
            }
            _ => {}
        }
    }
    Ok(())
}

/// The tasks of demonstrations from above, with a line from the last location of each to its first.
///
/// # Errors
/// What the drawing library reports.
pub fn tasks_svg(names: &[String], tasks: &[PlottedTask]) -> Result<String, PlotError> {
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, (620, 560)).into_drawing_area();
        root.fill(&WHITE).map_err(failed)?;
        let mut chart = chart_from_above(&root, tasks.iter().flatten().copied(), 0.05)?;
        for task in tasks {
            let way = task.iter().copied().map(seen).collect::<Vec<_>>();
            chart.draw_series(LineSeries::new(way, BLACK.mix(0.15))).map_err(failed)?;
        }
        for (i, name) in names.iter().enumerate() {
            let at = tasks.iter().filter_map(|task| task.get(i)).copied().map(seen);
            let dots = at.map(|p| Circle::new(p, 3, colour(i).mix(0.8).filled()));
            chart
                .draw_series(dots)
                .map_err(failed)?
                .label(name)
                .legend(move |(x, y)| Circle::new((x + 8, y), 4, colour(i).filled()));
        }
        chart
            .configure_series_labels()
            .background_style(WHITE.mix(0.8))
            .border_style(BLACK.mix(0.3))
            .draw()
            .map_err(failed)?;
        root.present().map_err(failed)?;
    }
    Ok(svg)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_recording_has_its_picture_also_an_empty_one() {
        let recording = PlottedRecording {
            title: "3 4315Aug02".into(),
            accepted: true,
            times_secs: vec![0.0, 1.0, 2.0, 3.0],
            tilt_deg: vec![0.0, 80.0, 80.0, 0.0],
            height_m: vec![0.0, 0.1, 0.1, 0.0],
            percent_open: vec![100.0, 0.0, 0.0, 100.0],
            segment_secs: Some([0.5, 2.9]),
            action_secs: Some([0.9, 2.1]),
        };
        let empty = PlottedRecording { title: "4 broken".into(), ..PlottedRecording::default() };
        let svg = recordings_svg(&[recording, empty], Some(70.0)).unwrap();
        for text in ["3 4315Aug02", "4 broken", "3 s"] {
            assert!(svg.contains(text), "{text:?} is missing");
        }
    }

    #[test]
    fn locations_stand_where_they_are_also_without_any() {
        let names = ["pour_location", "source_cup"].map(String::from);
        let svg = tasks_svg(&names, &[vec![[0.6, 0.1], [0.5, 0.2]]]).unwrap();
        assert!(svg.contains("pour_location") && svg.contains("source_cup"));
        assert!(tasks_svg(&names, &[]).is_ok());
    }
}
