//! The plane of the base frame as one sees it from above with the robot at the bottom.

use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

use super::{PlotError, failed, range};

/// A chart whose points are [`seen`].
pub(super) type ChartFromAbove<'a, DB> =
    ChartContext<'a, DB, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// Where a chart from above has a point of the base frame (m): x upwards, y to the left.
pub(super) fn seen([x, y]: [f64; 2]) -> (f64, f64) {
    (-y, x)
}

/// A chart with room for all points and `margin_m` around them, of one scale for both axes, or circles
/// would be ellipses.
pub(super) fn chart_from_above<'a, DB: DrawingBackend>(
    area: &'a DrawingArea<DB, Shift>,
    points: impl Iterator<Item = [f64; 2]> + Clone,
    margin_m: f64,
) -> Result<ChartFromAbove<'a, DB>, PlotError> {
    let points = points.map(seen);
    let middle_and_half = |(low, high): (f64, f64)| match low <= high {
        true => (0.5 * (low + high), 0.5 * (high - low)),
        false => (0.0, 0.0),
    };
    let (x, half_across) = middle_and_half(range(points.clone().map(|p| p.0)));
    let (y, half_along) = middle_and_half(range(points.map(|p| p.1)));
    let half = half_across.max(half_along) + margin_m;
    let mut chart = ChartBuilder::on(area)
        .margin(10)
        .x_label_area_size(36)
        .y_label_area_size(48)
        .build_cartesian_2d(x - half..x + half, y - half..y + half)
        .map_err(failed)?;
    chart
        .configure_mesh()
        .x_desc("y (m), to the robot's left")
        .y_desc("x (m), ahead of the robot")
        .x_label_formatter(&|v| format!("{:.2}", -v))
        .y_label_formatter(&|v| format!("{v:.2}"))
        .light_line_style(TRANSPARENT)
        .x_labels(6)
        .y_labels(6)
        .draw()
        .map_err(failed)?;
    Ok(chart)
}
