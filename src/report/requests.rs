//! Requests from above: where they are served.

use plotters::prelude::*;

use super::above::{chart_from_above, seen};
use super::{PlotError, colour, failed};

/// What came of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Outcome {
    /// It got a sample.
    Served,
    /// It got none, though its motion could be followed.
    Refused,
    /// Its motion can't be followed.
    OutOfReach,
    /// It is not like what was trained on.
    Unfamiliar,
}

/// A request: where its locations are, and what came of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Asked {
    /// One `(x, y)` in the base frame for each location (m).
    pub task: Vec<[f64; 2]>,
    /// What came of it.
    pub outcome: Outcome,
}

const SIZE: u32 = 480;

/// A map for each location: a dot where each request had it, coloured by what came of it.
///
/// # Errors
/// What the drawing library reports.
pub fn requests_svg(names: &[String], asked: &[Asked]) -> Result<String, PlotError> {
    let mut svg = String::new();
    {
        let size = (SIZE * names.len().max(1) as u32, SIZE + 20);
        let root = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        root.fill(&WHITE).map_err(failed)?;
        for (i, area) in root.split_evenly((1, names.len().max(1))).into_iter().enumerate() {
            let Some(name) = names.get(i) else { break };
            let area = area.titled(name, ("sans-serif", 15)).map_err(failed)?;
            let at = |asked: &Asked| asked.task.get(i).copied();
            let mut chart = chart_from_above(&area, asked.iter().filter_map(at), 0.03)?;
            // The rare ones on top.
            for (outcome, label, style) in [
                (Outcome::Unfamiliar, "not like the demonstrations", RGBColor(190, 190, 190)),
                (Outcome::Served, "served", colour(2)),
                (Outcome::OutOfReach, "out of reach", colour(5)),
                (Outcome::Refused, "refused, though within reach", colour(1)),
            ] {
                let such: Vec<_> = asked.iter().filter(|a| a.outcome == outcome).collect();
                let count = such.len();
                let dots = such.into_iter().filter_map(at).map(seen);
                chart
                    .draw_series(dots.map(|p| Circle::new(p, 2, style.mix(0.8).filled())))
                    .map_err(failed)?
                    .label(format!("{label}: {count}"))
                    .legend(move |(x, y)| Circle::new((x + 8, y), 4, style.filled()));
            }
            if i + 1 == names.len() {
                chart
                    .configure_series_labels()
                    .position(SeriesLabelPosition::UpperRight)
                    .background_style(WHITE.mix(0.8))
                    .border_style(BLACK.mix(0.3))
                    .draw()
                    .map_err(failed)?;
            }
        }
        root.present().map_err(failed)?;
    }
    Ok(svg)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_location_has_its_map_and_each_outcome_its_count() {
        let names = ["pour_location", "source_cup"].map(String::from);
        let asked = |outcome| Asked { task: vec![[0.6, 0.1], [0.5, 0.2]], outcome };
        let all = [Outcome::Served, Outcome::Served, Outcome::Refused].map(asked);
        let svg = requests_svg(&names, &all).unwrap();
        for text in ["pour_location", "source_cup", "served: 2", "within reach: 1"] {
            assert!(svg.contains(text), "{text:?} is missing");
        }
        assert!(requests_svg(&names, &[]).is_ok() && requests_svg(&[], &[]).is_ok());
    }
}
