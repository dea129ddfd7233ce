//! A few motions from above, and their tilt over time.

use nalgebra::Isometry3;
use plotters::prelude::*;

use super::above::{chart_from_above, seen};
use super::{PlotError, colour, failed};
use crate::pose::{tilt, up_in_tip};

/// One motion of the tip.
#[derive(Debug, Clone, PartialEq)]
pub struct PlottedMotion {
    /// Time of each pose (s).
    pub times_secs: Vec<f64>,
    /// The tip in the base frame.
    pub base_from_tip: Vec<Isometry3<f64>>,
}

/// A named location that the motions must meet.
#[derive(Debug, Clone, PartialEq)]
pub struct PlottedLocation {
    /// Name.
    pub name: String,
    /// `(x, y)` in the base frame (m).
    pub xy: [f64; 2],
}

/// The path of motions from above, with the task's locations and the circle of the tolerance, and
/// beside it the tip's tilt from its first orientation over time, with the threshold of a pour where
/// the task has one.
///
/// # Errors
/// What the drawing library reports.
pub fn motions_svg(
    title: &str,
    motions: &[PlottedMotion],
    locations: &[PlottedLocation],
    tolerance_m: f64,
    tilt_threshold_deg: Option<f64>,
) -> Result<String, PlotError> {
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, (960, 440)).into_drawing_area();
        root.fill(&WHITE).map_err(failed)?;
        let root = root.titled(title, ("sans-serif", 18)).map_err(failed)?;
        let (left, right) = root.split_horizontally(440);
        draw_path(&left, motions, locations, tolerance_m)?;
        draw_tilt(&right, motions, tilt_threshold_deg)?;
        root.present().map_err(failed)?;
    }
    Ok(svg)
}

fn draw_path<DB: DrawingBackend>(
    area: &DrawingArea<DB, plotters::coord::Shift>,
    motions: &[PlottedMotion],
    locations: &[PlottedLocation],
    tolerance_m: f64,
) -> Result<(), PlotError> {
    let xy = |p: &Isometry3<f64>| [p.translation.x, p.translation.y];
    let points = motions.iter().flat_map(|m| m.base_from_tip.iter().map(xy));
    let all = points.chain(locations.iter().map(|l| l.xy));
    let mut chart = chart_from_above(area, all, 0.06)?;
    for (i, motion) in motions.iter().enumerate() {
        let line = motion.base_from_tip.iter().map(|p| seen(xy(p)));
        let line = LineSeries::new(line, colour(i).stroke_width(2));
        chart.draw_series(line).map_err(failed)?;
    }
    for location in locations {
        let (x, y) = seen(location.xy);
        let circle = (0..=72).map(|i| {
            let angle = f64::from(i) * std::f64::consts::TAU / 72.0;
            (x + tolerance_m * angle.cos(), y + tolerance_m * angle.sin())
        });
        chart.draw_series(LineSeries::new(circle, BLACK.stroke_width(1))).map_err(failed)?;
        let label = Text::new(
            location.name.clone(),
            (x - 0.05, y + tolerance_m + 0.015),
            ("sans-serif", 13),
        );
        chart.draw_series([label]).map_err(failed)?;
        chart.draw_series([Cross::new((x, y), 4, BLACK)]).map_err(failed)?;
    }
    Ok(())
}

fn draw_tilt<DB: DrawingBackend>(
    area: &DrawingArea<DB, plotters::coord::Shift>,
    motions: &[PlottedMotion],
    threshold_deg: Option<f64>,
) -> Result<(), PlotError> {
    let last = motions.iter().filter_map(|m| m.times_secs.last());
    let duration = last.fold(1.0_f64, |a, b| a.max(*b));
    let tilts: Vec<Vec<(f64, f64)>> = motions.iter().map(tilt_over_time).collect();
    let highest = tilts.iter().flatten().fold(threshold_deg.unwrap_or(10.0), |a, p| a.max(p.1));
    let mut chart = ChartBuilder::on(area)
        .margin(10)
        .x_label_area_size(36)
        .y_label_area_size(48)
        .build_cartesian_2d(0.0..duration, 0.0..1.1 * highest)
        .map_err(failed)?;
    chart
        .configure_mesh()
        .x_desc("time (s)")
        .y_desc("tilt of the cup (degrees)")
        .light_line_style(TRANSPARENT)
        .draw()
        .map_err(failed)?;
    if let Some(threshold) = threshold_deg {
        let line = [(0.0, threshold), (duration, threshold)];
        chart.draw_series(DashedLineSeries::new(line, 6, 4, BLACK.into())).map_err(failed)?;
        let label = format!("pouring: above {threshold:.0}°");
        let at = (0.01 * duration, threshold + 0.05 * highest);
        chart.draw_series([Text::new(label, at, ("sans-serif", 13))]).map_err(failed)?;
    }
    for (i, points) in tilts.into_iter().enumerate() {
        chart.draw_series(LineSeries::new(points, colour(i).stroke_width(2))).map_err(failed)?;
    }
    Ok(())
}

/// The tilt of the tip from its first orientation (s, degrees).
pub(super) fn tilt_over_time(motion: &PlottedMotion) -> Vec<(f64, f64)> {
    let Some(first) = motion.base_from_tip.first() else { return Vec::new() };
    let axis = up_in_tip(first);
    let tilts = motion.base_from_tip.iter().map(|pose| tilt(pose, &axis).to_degrees());
    motion.times_secs.iter().copied().zip(tilts).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn the_picture_names_its_locations_and_axes() {
        let pose = |i| {
            let t = f64::from(i) / 20.0;
            Isometry3::new(Vector3::new(0.6, 0.3 * t, 0.1), Vector3::x() * 1.6 * t)
        };
        let motion = PlottedMotion {
            times_secs: (0..=20).map(|i| 0.1 * f64::from(i)).collect(),
            base_from_tip: (0..=20).map(pose).collect(),
        };
        let location = PlottedLocation { name: "pour_location".into(), xy: [0.6, 0.3] };
        let svg = motions_svg("a pour", &[motion], &[location], 0.02, Some(70.0)).unwrap();
        for text in ["a pour", "pour_location", "time (s)", "pouring: above 70°"] {
            assert!(svg.contains(text), "{text:?} is missing");
        }
    }
}
