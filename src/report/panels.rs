//! Small pictures of one kind side by side, with one scale for all: what each manner parameter does,
//! and where motions meet their task.

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::motions::tilt_over_time;
use super::{PlotError, PlottedMotion, colour, failed, range};

/// Panels in a row.
const ACROSS: usize = 5;
/// Sizes in pixels: of the drawn square in a panel, of what stands around it, and of texts.
const SIDE: u32 = 150;
const MARGIN: u32 = 8;
const LEFT: u32 = 46;
const BELOW: u32 = 32;
const PANEL_TITLE: u32 = 20;
const TITLE: u32 = 34;
const LEGEND: u32 = 30;
const TEXT: u32 = 12;
const SMALL_TEXT: u32 = 10;
/// Pictures are drawn this many times as large as they are shown: the library rounds every point to
/// a pixel.
const SCALE: u32 = 8;
/// Values that a traversal's colours stand for, from -SPAN to SPAN standard deviations.
const SPAN: f64 = 2.0;

/// Points of a plane.
pub type Points = Vec<(f64, f64)>;

/// One small picture.
#[derive(Debug, Clone, PartialEq)]
pub struct Panel<T> {
    /// What it shows.
    pub title: String,
    /// The curves or motions in it, or sets of points.
    pub shown: Vec<T>,
}

/// A curve of a traversal.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve<T> {
    /// The manner parameter, in standard deviations; it decides the colour.
    pub value: f64,
    /// The points, or the motion.
    pub shown: T,
}

/// How a plane is drawn.
#[derive(Debug, Clone, PartialEq)]
pub struct Plane {
    /// Text at the horizontal axis.
    pub x: String,
    /// Text at the vertical axis.
    pub y: String,
    /// A place to mark with a cross.
    pub mark: [f64; 2],
    /// Radius of a circle around the mark; none for 0.
    pub radius: f64,
}

/// Paths in a plane: a panel for each manner parameter, a path for each of its values, with a dot at
/// its end.
///
/// # Errors
/// What the drawing library reports.
pub fn paths_svg(
    title: &str,
    panels: &[Panel<Curve<Points>>],
    plane: &Plane,
) -> Result<String, PlotError> {
    let points = panels.iter().flat_map(|p| &p.shown).flat_map(|c| &c.shown).copied();
    let limits = square(points, plane);
    grid(title, panels, 0, Legend::Traversal, |area, panel| {
        let mut chart = plane_chart(area, plane, limits)?;
        for Curve { value, shown } in &panel.shown {
            let line = LineSeries::new(shown.iter().copied(), stroke(shade(*value), 1.5));
            chart.draw_series(line).map_err(failed)?;
        }
        let ends = panel.shown.iter().filter_map(|c| Some((c.value, *c.shown.last()?)));
        let dots = ends.map(|(value, end)| Circle::new(end, px(3), shade(value).filled()));
        chart.draw_series(dots).map_err(failed)?;
        mark(&mut chart, plane)
    })
}

/// Where motions meet their task: a panel for each kind of model, a set of points for each task in a
/// colour of its own.
///
/// # Errors
/// What the drawing library reports.
pub fn locations_svg(
    title: &str,
    panels: &[Panel<Points>],
    plane: &Plane,
    half_width: f64,
) -> Result<String, PlotError> {
    let [x, y] = plane.mark;
    let limits = ((x - half_width, x + half_width), (y - half_width, y + half_width));
    grid(title, panels, 0, Legend::None, |area, panel| {
        let mut chart = plane_chart(area, plane, limits)?;
        for (i, points) in panel.shown.iter().enumerate() {
            // What lies outside stands at the edge, so that nothing is hidden.
            let inside = |v: f64, (low, high): (f64, f64)| v.clamp(low, high);
            let points = points.iter().map(|p| (inside(p.0, limits.0), inside(p.1, limits.1)));
            let dots = points.map(|p| Circle::new(p, px(2), colour(i).mix(0.7).filled()));
            chart.draw_series(dots).map_err(failed)?;
        }
        mark(&mut chart, plane)
    })
}

/// The tilt over time: a panel for each manner parameter, a curve for each of its values, and below it
/// a bar as long as the time above the threshold.
///
/// # Errors
/// What the drawing library reports.
pub fn tilts_svg(
    title: &str,
    panels: &[Panel<Curve<PlottedMotion>>],
    threshold_deg: f64,
) -> Result<String, PlotError> {
    const BARS: u32 = 90;
    let curves = || panels.iter().flat_map(|p| &p.shown).map(|c| tilt_over_time(&c.shown));
    let (_, longest) = range(curves().flatten().map(|p| p.0));
    let (_, highest) = range(curves().flatten().map(|p| p.1).chain([threshold_deg]));
    grid(title, panels, BARS, Legend::Traversal, |area, panel| {
        let (upper, lower) = area.split_vertically(px(SIDE + BELOW));
        let mut chart = chart(&upper, (0.0, longest), (0.0, 1.08 * highest))?;
        let mut mesh = chart.configure_mesh();
        mesh.light_line_style(TRANSPARENT).x_labels(5).y_labels(6).y_desc("tilt (degrees)");
        mesh.y_label_formatter(&|v| format!("{v:.0}")).x_label_formatter(&|v| format!("{v:.0}"));
        mesh.label_style(text(SMALL_TEXT)).draw().map_err(failed)?;
        let line = [(0.0, threshold_deg), (longest, threshold_deg)];
        let dashes = DashedLineSeries::new(line, px(5), px(3), stroke(BLACK, 1.0));
        chart.draw_series(dashes).map_err(failed)?;
        for Curve { value, shown } in &panel.shown {
            let line = LineSeries::new(tilt_over_time(shown), stroke(shade(*value), 1.5));
            chart.draw_series(line).map_err(failed)?;
        }
        let mut bars = self::chart(&lower, (0.0, longest), (0.0, panel.shown.len() as f64))?;
        let mut mesh = bars.configure_mesh();
        mesh.disable_mesh().y_labels(0).x_labels(5).x_desc("time (s); bars: length of the pour");
        mesh.x_label_formatter(&|v| format!("{v:.0}"));
        mesh.label_style(text(SMALL_TEXT)).draw().map_err(failed)?;
        for (i, Curve { value, shown }) in panel.shown.iter().enumerate() {
            let bottom = i as f64;
            let corners = [(0.0, bottom + 0.15), (above(shown, threshold_deg), bottom + 0.85)];
            let bar = Rectangle::new(corners, shade(*value).filled());
            bars.draw_series([bar]).map_err(failed)?;
        }
        Ok(())
    })
}

/// Time that the tilt is above the threshold (s).
fn above(motion: &PlottedMotion, threshold_deg: f64) -> f64 {
    let step = |pair: &[(f64, f64)]| {
        let [(t, a), (u, b)] = [pair[0], pair[1]];
        let (low, high) = (a.min(b), a.max(b));
        let share = if high > low { (high - threshold_deg) / (high - low) } else { 1.0 };
        if high > threshold_deg { (u - t) * share.clamp(0.0, 1.0) } else { 0.0 }
    };
    tilt_over_time(motion).windows(2).map(step).sum()
}

/// What stands below the panels.
#[derive(Clone, Copy, PartialEq)]
enum Legend {
    None,
    /// The colours of a manner parameter's values.
    Traversal,
}

/// The panels in rows, each `more` higher than a square.
fn grid<T>(
    title: &str,
    panels: &[Panel<T>],
    more: u32,
    legend: Legend,
    draw: impl Fn(&DrawingArea<SVGBackend<'_>, Shift>, &Panel<T>) -> Result<(), PlotError>,
) -> Result<String, PlotError> {
    let across = panels.len().clamp(1, ACROSS) as u32;
    let down = panels.len().div_ceil(ACROSS).max(1) as u32;
    let (width, height) = (LEFT + SIDE + MARGIN, PANEL_TITLE + SIDE + BELOW + more);
    // The legend needs the room of two panels.
    let shown = (across.max(2) * width, TITLE + down * height + LEGEND);
    let drawn = (px(shown.0), px(shown.1));
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, drawn).into_drawing_area();
        root.fill(&WHITE).map_err(failed)?;
        let middle = Pos::new(HPos::Center, VPos::Center);
        let heading = |area: &DrawingArea<_, Shift>, words: &str, at: (u32, u32), size| {
            let style = text(size).into_text_style(area).pos(middle);
            area.draw_text(words, &style, (px(at.0) as i32, px(at.1) as i32)).map_err(failed)
        };
        heading(&root, title, (shown.0 / 2, TITLE / 2), 16)?;
        for (i, panel) in (0..).zip(panels) {
            let corner = (px(i % across * width), px(TITLE + i / across * height));
            let area = root.clone().shrink(corner, (px(width), px(height)));
            heading(&area, &panel.title, (LEFT + SIDE / 2, PANEL_TITLE / 2), TEXT)?;
            let (_, area) = area.split_vertically(px(PANEL_TITLE));
            draw(&area, panel)?;
        }
        if legend == Legend::Traversal {
            let (_, below) = root.split_vertically(px(shown.1 - LEGEND));
            draw_legend(&below)?;
        }
        root.present().map_err(failed)?;
    }
    let size = |(width, height)| format!("width=\"{width}\" height=\"{height}\"");
    Ok(svg.replacen(&size(drawn), &size(shown), 1))
}

/// The colours from -SPAN to SPAN.
fn draw_legend(area: &DrawingArea<SVGBackend<'_>, Shift>) -> Result<(), PlotError> {
    const STEPS: u32 = 9;
    const BOX: u32 = 16;
    const FIRST: u32 = 138;
    let at = |x: u32, y: u32| (px(x) as i32, px(y) as i32);
    let words = |words: String, x: u32| Text::new(words, at(x, 9), text(TEXT));
    area.draw(&words(format!("manner parameter: {:.0}", -SPAN), 12)).map_err(failed)?;
    for i in 0..STEPS {
        let value = SPAN * (2.0 * f64::from(i) / f64::from(STEPS - 1) - 1.0);
        let left = FIRST + BOX * i;
        let corners = [at(left, 8), at(left + BOX, 8 + TEXT)];
        area.draw(&Rectangle::new(corners, shade(value).filled())).map_err(failed)?;
    }
    let end = format!("+{SPAN:.0} standard deviations");
    area.draw(&words(end, FIRST + BOX * STEPS + 8)).map_err(failed)
}

/// Blue below, orange above, dark in the middle: in print too, light is far from the middle.
fn shade(value: f64) -> RGBColor {
    const ENDS: [[f64; 3]; 2] = [[86.0, 180.0, 233.0], [240.0, 150.0, 40.0]];
    const MIDDLE: [f64; 3] = [60.0, 60.0, 70.0];
    let end = ENDS[usize::from(value > 0.0)];
    let share = (value.abs() / SPAN).min(1.0);
    let [r, g, b] = [0, 1, 2].map(|i| (MIDDLE[i] + share * (end[i] - MIDDLE[i])).round() as u8);
    RGBColor(r, g, b)
}

type Limits = ((f64, f64), (f64, f64));

/// A square around the points and the mark, so that circles stay circles.
fn square(points: impl Iterator<Item = (f64, f64)> + Clone, plane: &Plane) -> Limits {
    let [x, y] = plane.mark;
    let (across, along) =
        (range(points.clone().map(|p| p.0).chain([x])), range(points.map(|p| p.1).chain([y])));
    let half = 0.53 * (across.1 - across.0).max(along.1 - along.0).max(2.0 * plane.radius);
    let around = |(low, high): (f64, f64)| (0.5 * (low + high) - half, 0.5 * (low + high) + half);
    (around(across), around(along))
}

type Chart<'a> = ChartContext<
    'a,
    SVGBackend<'a>,
    Cartesian2d<plotters::coord::types::RangedCoordf64, plotters::coord::types::RangedCoordf64>,
>;

fn chart<'a>(
    area: &DrawingArea<SVGBackend<'a>, Shift>,
    across: (f64, f64),
    along: (f64, f64),
) -> Result<Chart<'a>, PlotError> {
    ChartBuilder::on(area)
        .margin_right(px(MARGIN))
        .x_label_area_size(px(BELOW))
        .y_label_area_size(px(LEFT))
        .build_cartesian_2d(across.0..across.1, along.0..along.1)
        .map_err(failed)
}

fn plane_chart<'a>(
    area: &DrawingArea<SVGBackend<'a>, Shift>,
    plane: &Plane,
    (across, along): Limits,
) -> Result<Chart<'a>, PlotError> {
    let mut chart = chart(area, across, along)?;
    let mut mesh = chart.configure_mesh();
    mesh.light_line_style(TRANSPARENT).x_labels(4).y_labels(5);
    mesh.x_desc(plane.x.clone()).y_desc(plane.y.clone()).label_style(text(SMALL_TEXT));
    mesh.draw().map_err(failed)?;
    Ok(chart)
}

fn mark(chart: &mut Chart<'_>, plane: &Plane) -> Result<(), PlotError> {
    let [x, y] = plane.mark;
    chart.draw_series([Cross::new((x, y), px(4), stroke(BLACK, 1.0))]).map_err(failed)?;
    if plane.radius > 0.0 {
        let circle = (0..=72).map(|i| {
            let angle = f64::from(i) * std::f64::consts::TAU / 72.0;
            (x + plane.radius * angle.cos(), y + plane.radius * angle.sin())
        });
        chart.draw_series(LineSeries::new(circle, stroke(BLACK, 1.0))).map_err(failed)?;
    }
    Ok(())
}

/// As many drawn pixels as that many shown ones.
fn px(shown: u32) -> u32 {
    shown * SCALE
}

fn text(size: u32) -> (&'static str, u32) {
    ("sans-serif", px(size))
}

fn stroke(colour: RGBColor, width: f64) -> ShapeStyle {
    colour.stroke_width((width * f64::from(SCALE)).round() as u32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Isometry3, Vector3};

    fn plane() -> Plane {
        Plane { x: "x (m)".into(), y: "y (m)".into(), mark: [0.2, 0.3], radius: 0.02 }
    }

    #[test]
    fn every_panel_is_drawn_with_its_title_and_axes() {
        let curve = |value: f64| Curve {
            value,
            shown: (0..20).map(|i| (f64::from(i) * 0.01, 0.1 * value)).collect(),
        };
        let panel = |i: usize| Panel {
            title: format!("h{i}"),
            shown: [-2.0, 0.0, 2.0].map(curve).to_vec(),
        };
        let svg = paths_svg("arcs", &(1..8).map(panel).collect::<Vec<_>>(), &plane()).unwrap();
        for text in ["arcs", "h1", "h7", "x (m)", "y (m)", "+2 standard deviations"] {
            assert!(svg.contains(text), "{text:?} is missing");
        }
        // A path for each curve, and a circle.
        assert!(svg.matches("<polyline").count() >= 7 * 4);
    }

    #[test]
    fn what_misses_by_far_stands_at_the_edge() {
        let panel = Panel { title: "VAE".into(), shown: vec![vec![(0.2, 0.3), (9.0, 0.3)]] };
        let svg = locations_svg("pours", &[panel], &plane(), 0.05).unwrap();
        assert_eq!(svg.matches("<circle").count(), 2);
    }

    #[test]
    fn a_bar_is_as_long_as_the_pour() {
        // Up to 100 degrees in one second, and back down in another.
        let pose = |i: i32| {
            let degrees = 100.0 - f64::from((i - 10).abs()) * 10.0;
            Isometry3::new(Vector3::zeros(), Vector3::x() * degrees.to_radians())
        };
        let motion = PlottedMotion {
            times_secs: (0..=20).map(|i| 0.1 * f64::from(i)).collect(),
            base_from_tip: (0..=20).map(pose).collect(),
        };
        assert!((above(&motion, 70.0) - 0.6).abs() < 1e-9);
        let panel = Panel {
            title: "pour_duration".into(),
            shown: vec![Curve { value: 1.0, shown: motion }],
        };
        let svg = tilts_svg("pours", &[panel], 70.0).unwrap();
        assert!(svg.contains("pour_duration") && svg.contains("length of the pour"));
    }
}
