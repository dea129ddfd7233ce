//! Pictures as SVG, and pages of tables and pictures as HTML and Markdown.

mod above;
mod motions;
mod page;
mod panels;
mod recordings;
mod requests;

pub use motions::{PlottedLocation, PlottedMotion, motions_svg};
pub use page::{Block, Page};
pub use panels::{Curve, Panel, Plane, Points, locations_svg, paths_svg, tilts_svg};
pub use recordings::{PlottedRecording, PlottedTask, recordings_svg, tasks_svg};
pub use requests::{Asked, Outcome, requests_svg};

use std::fmt::Display;

use plotters::style::RGBColor;

/// A colour for each sample, distinguishable in print and to most colour-blind readers
/// (Okabe and Ito's palette).
const COLOURS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(230, 159, 0),
    RGBColor(90, 90, 90),
];

/// A picture could not be drawn.
#[derive(Debug, thiserror::Error)]
#[error("the picture could not be drawn: {0}")]
pub struct PlotError(String);

fn colour(i: usize) -> RGBColor {
    COLOURS[i % COLOURS.len()]
}

fn range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)))
}

fn failed(error: impl Display) -> PlotError {
    PlotError(error.to_string())
}
