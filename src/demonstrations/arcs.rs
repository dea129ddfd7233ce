//! Arcs of a circle: the paper's synthetic task (section 4.1).
//!
//! The task parameters are the circle's centre; radius, span and start angle are the manner. The
//! centre's empirical value `G` (eq. 15) is that of the circle which fits the points best in
//! Taubin's sense (G. Taubin, *Estimation of Planar Curves, Surfaces, and Nonplanar Space Curves
//! Defined by Implicit Equations*, PAMI 1991).

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};

use super::task::{Factor, Task, TaskMeasureError, Violation};
use super::{Demonstration, Splits};
use crate::parameters::{Interval, TaskLocation, TaskParameters, TaskSpace};
use crate::trajectory::{Motion, Trajectory};

/// Radii of the demonstrations.
const RADIUS: Interval = Interval { lower: 0.2, upper: 0.5 };
/// Angles that the demonstrations sweep: 90 to 270 degrees.
const SPAN_RAD: Interval = Interval { lower: FRAC_PI_2, upper: 3.0 * FRAC_PI_2 };
/// Both coordinates of the demonstrations' centres; mean 0.5, standard deviation 0.289.
const CENTER: Interval = Interval { lower: 0.0, upper: 1.0 };
/// Share of itself by which a bound of the data is widened before a motion breaks it.
const MARGIN: f64 = 0.15;

/// Where demonstrated arcs may start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ArcStart {
    /// Angles in `[0, pi]`.
    #[default]
    Half,
    /// Any angle, `[0, 2 pi)`; the harder set, since an angle is not a number.
    Full,
}

/// The task of drawing an arc around a centre.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ArcsTask {
    /// Where the demonstrated arcs start.
    pub start: ArcStart,
    /// Radii of a valid arc: the data's, 15 % wider at either end.
    pub valid_radius: Interval,
    /// Angles that a valid arc sweeps, counter-clockwise, in rad: the data's, 15 % wider at either
    /// end.
    pub valid_span_rad: Interval,
    /// Largest root mean square distance of a valid arc's points from its circle, as a share of
    /// the radius.
    pub valid_residual: f64,
}

impl Default for ArcsTask {
    fn default() -> Self {
        Self {
            start: ArcStart::Half,
            valid_radius: widened(RADIUS),
            valid_span_rad: widened(SPAN_RAD),
            valid_residual: 0.05,
        }
    }
}

fn widened(interval: Interval) -> Interval {
    let Interval { lower, upper } = interval;
    Interval { lower: lower * (1.0 - MARGIN), upper: upper * (1.0 + MARGIN) }
}

/// The parameters of one arc, drawn counter-clockwise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Arc {
    /// Centre of its circle: the task.
    pub center: [f64; 2],
    /// Radius of its circle.
    pub radius: f64,
    /// Angle that it sweeps.
    pub span_rad: f64,
    /// Direction from the centre to its first point.
    pub start_rad: f64,
}

impl Arc {
    /// An arc of the data's distribution: every parameter uniform, centre in the unit square,
    /// radius in `[0.2, 0.5]`, span in `[90, 270]` degrees.
    pub fn random<R: Rng + ?Sized>(start: ArcStart, rng: &mut R) -> Self {
        let mut uniform =
            |Interval { lower, upper }: Interval| lower + (upper - lower) * rng.random::<f64>();
        let turn = match start {
            ArcStart::Half => PI,
            ArcStart::Full => TAU,
        };
        Self {
            center: [uniform(CENTER), uniform(CENTER)],
            radius: uniform(RADIUS),
            span_rad: uniform(SPAN_RAD),
            start_rad: uniform(Interval { lower: 0.0, upper: turn }),
        }
    }

    /// `steps` points at equal angles, the first at the start and the last at the end.
    ///
    /// # Panics
    /// When `steps` is below 2.
    pub fn motion(&self, steps: usize) -> Motion {
        assert!(steps >= 2, "a trajectory has at least 2 steps");
        let values = (0..steps).flat_map(|i| {
            let angle = self.start_rad + self.span_rad * i as f64 / (steps - 1) as f64;
            let (sin, cos) = angle.sin_cos();
            [self.center[0] + self.radius * cos, self.center[1] + self.radius * sin]
        });
        let states = Trajectory::new(2, values.collect()).expect("a finite arc is a trajectory");
        Motion { states, duration_secs: ArcsTask::DURATION_SECS }
    }
}

/// What to simulate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ArcsSimulation {
    /// Arcs in all; one in ten is for validation and one in ten for testing.
    pub count: usize,
    /// Points of an arc.
    pub steps: usize,
    /// Where the arcs start.
    pub start: ArcStart,
}

impl Default for ArcsSimulation {
    /// The paper's 8000/1000/1000, in 32 points.
    fn default() -> Self {
        Self { count: 10_000, steps: 32, start: ArcStart::Half }
    }
}

/// Simulated demonstrations with the arcs that they were drawn from, in the order of training,
/// validation and test.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulatedArcs {
    /// The demonstrations.
    pub splits: Splits,
    /// The truth of each of them.
    pub arcs: Vec<Arc>,
}

/// Draws arcs without noise; the same draws for the same `rng`.
///
/// # Panics
/// When `simulation.steps` is below 2.
pub fn simulate<R: Rng + ?Sized>(simulation: &ArcsSimulation, rng: &mut R) -> SimulatedArcs {
    let &ArcsSimulation { count, steps, start } = simulation;
    let space = ArcsTask::task_space();
    let mut arcs = Vec::with_capacity(count);
    let mut part = |name: &str, count: usize| -> Vec<Demonstration> {
        let demonstration = |i| {
            let arc = Arc::random(start, rng);
            arcs.push(arc);
            let w = TaskParameters::new(&space, arc.center.to_vec())
                .expect("a centre in the unit square is one of the task space");
            let motion = arc.motion(steps);
            Demonstration { id: format!("{name}-{i:05}"), w, motion, events: Vec::new() }
        };
        (0..count).map(demonstration).collect()
    };
    let tenth = (count as f64 / 10.0).round() as usize;
    let splits = Splits {
        train: part("train", count - 2 * tenth),
        validation: part("validation", tenth),
        test: part("test", tenth),
    };
    SimulatedArcs { splits, arcs }
}

impl ArcsTask {
    /// An arc takes no time; its motions last one second by convention.
    pub const DURATION_SECS: f64 = 1.0;
    /// Names of the values of a state.
    pub const STATE_NAMES: [&str; 2] = ["x", "y"];

    /// The task of arcs that start there.
    pub fn new(start: ArcStart) -> Self {
        Self { start, ..Self::default() }
    }

    /// One location, `center`, without a unit.
    pub fn task_space() -> TaskSpace {
        let center = TaskLocation { name: "center".into(), x: CENTER, y: CENTER };
        TaskSpace::new("1", vec![center]).expect("one location with finite intervals")
    }

    /// The manner of an arc as [`Task::factors`] reports it.
    pub fn factors_of(&self, arc: &Arc) -> Vec<Factor> {
        let mut factors = vec![
            Factor {
                name: "radius".into(),
                unit: "1",
                phrase: "radius".into(),
                value: arc.radius,
                derived: false,
            },
            Factor {
                name: "span".into(),
                unit: "rad",
                phrase: "span".into(),
                value: arc.span_rad,
                derived: false,
            },
        ];
        match self.start {
            // The branch is cut opposite to the middle of the data, so that an arc which starts
            // slightly outside it has an angle next to its neighbours'.
            ArcStart::Half => factors.push(Factor {
                name: "start".into(),
                unit: "rad",
                phrase: "start angle".into(),
                value: wrapped(arc.start_rad - FRAC_PI_2) + FRAC_PI_2,
                derived: false,
            }),
            ArcStart::Full => {
                let (sin, cos) = arc.start_rad.sin_cos();
                let factor = |name: &'static str, phrase: &'static str, value| Factor {
                    name: name.into(),
                    unit: "1",
                    phrase: phrase.into(),
                    value,
                    derived: false,
                };
                factors.push(factor("start_cos", "cosine of the start angle", cos));
                factors.push(factor("start_sin", "sine of the start angle", sin));
            }
        }
        factors
    }

    /// The arc that a motion draws.
    fn measure(&self, motion: &Motion) -> Result<(Arc, Circle), CircleError> {
        let dim = motion.states.dim();
        if dim != 2 {
            return Err(CircleError::Dimension { dim });
        }
        let points: Vec<[f64; 2]> = motion.states.states().map(|s| [s[0], s[1]]).collect();
        let circle = fit_circle(&points)?;
        let angle = |[x, y]: [f64; 2]| (y - circle.center[1]).atan2(x - circle.center[0]);
        let span_rad = points.windows(2).map(|p| wrapped(angle(p[1]) - angle(p[0]))).sum();
        let arc = Arc {
            center: circle.center,
            radius: circle.radius,
            span_rad,
            start_rad: angle(points[0]),
        };
        Ok((arc, circle))
    }
}

/// The angle's representative in `[-pi, pi)`.
fn wrapped(angle_rad: f64) -> f64 {
    (angle_rad + PI).rem_euclid(TAU) - PI
}

impl Task for ArcsTask {
    fn name(&self) -> &'static str {
        "arcs"
    }

    fn task_space(&self) -> TaskSpace {
        Self::task_space()
    }

    fn empirical_task(&self, motion: &Motion) -> Result<TaskParameters, TaskMeasureError> {
        let fail = |detail: String| TaskMeasureError { detail };
        let (arc, _) = self.measure(motion).map_err(|e| fail(e.to_string()))?;
        TaskParameters::new(&Self::task_space(), arc.center.to_vec())
            .map_err(|e| fail(e.to_string()))
    }

    fn violations(&self, motion: &Motion) -> Vec<Violation> {
        let (arc, circle) = match self.measure(motion) {
            Ok(measured) => measured,
            // Not a circle at all: as far from one as can be.
            Err(_) => {
                let (value, limit) = (f64::INFINITY, self.valid_residual);
                return vec![Violation { bound: "valid_residual", value, limit, unit: "1" }];
            }
        };
        let mut violations = Vec::new();
        let mut check = |bound, value: f64, interval: Interval, unit| {
            let limit = if value < interval.lower { interval.lower } else { interval.upper };
            if !interval.contains(value) {
                violations.push(Violation { bound, value, limit, unit });
            }
        };
        check("valid_radius", arc.radius, self.valid_radius, "1");
        check("valid_span_rad", arc.span_rad, self.valid_span_rad, "rad");
        let residual = Interval { lower: 0.0, upper: self.valid_residual };
        check("valid_residual", circle.rms_residual / circle.radius, residual, "1");
        violations
    }

    fn factors(&self, motion: &Motion) -> Vec<Factor> {
        self.measure(motion).map(|(arc, _)| self.factors_of(&arc)).unwrap_or_default()
    }
}

/// A circle fitted to points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Circle {
    /// Its centre.
    pub center: [f64; 2],
    /// Its radius.
    pub radius: f64,
    /// Root mean square distance of the points from it.
    pub rms_residual: f64,
}

/// Why points have no circle.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CircleError {
    /// Two points or fewer lie on many circles.
    #[error("{points} points have no one circle; at least 3 are needed")]
    TooFew {
        /// Number of points.
        points: usize,
    },
    /// The states are not points in the plane.
    #[error("a state has {dim} values where a point of an arc has 2")]
    Dimension {
        /// Values of a state.
        dim: usize,
    },
    /// A coordinate is NaN, infinite, or so large that its powers are.
    #[error("point {index} is ({x}, {y}); finite coordinates below 1e50 are needed")]
    NotFinite {
        /// Place of the point.
        index: usize,
        /// Its x.
        x: f64,
        /// Its y.
        y: f64,
    },
    /// The points are one point.
    #[error("the {points} points lie within {spread:e} of each other; a point has no circle")]
    Point {
        /// Number of points.
        points: usize,
        /// Root mean square distance from their mean.
        spread: f64,
    },
    /// The points lie on a line.
    #[error(
        "the points lie on a line: the circle's radius is over {MAX_RADIUS_SPREADS:.0} times \
         their spread of {spread:.3e}; a line has no centre"
    )]
    Line {
        /// Root mean square distance of the points from their mean.
        spread: f64,
    },
}

/// Largest radius, in root mean square distances of the points from their mean, of what still
/// counts as a circle. An arc of one degree has 200.
const MAX_RADIUS_SPREADS: f64 = 1e4;

/// The circle that minimises `mean((|p - c|^2 - r^2)^2) / mean(4 |p - c|^2)`, Taubin's
/// approximation of the mean square distance, by Newton's method on the characteristic polynomial
/// of its generalised eigenvalue problem (N. Chernov, *Circular and Linear Regression*, 2010,
/// section 5.10).
///
/// # Errors
/// Fewer than three points, points that are not finite, points on one point or on a line.
pub fn fit_circle(points: &[[f64; 2]]) -> Result<Circle, CircleError> {
    // Sixth powers of the coordinates' differences occur below.
    let finite = |p: &[f64; 2]| p.iter().all(|v| v.abs() < 1e50);
    if let Some(index) = points.iter().position(|p| !finite(p)) {
        let [x, y] = points[index];
        return Err(CircleError::NotFinite { index, x, y });
    }
    if points.len() < 3 {
        return Err(CircleError::TooFew { points: points.len() });
    }
    let count = points.len() as f64;
    let mean = |f: &dyn Fn(&[f64; 2]) -> f64| points.iter().map(f).sum::<f64>() / count;
    let middle = [mean(&|p| p[0]), mean(&|p| p[1])];
    let spread = mean(&|p| (p[0] - middle[0]).powi(2) + (p[1] - middle[1]).powi(2)).sqrt();
    let magnitude = middle[0].abs().max(middle[1].abs());
    if spread <= 1e-12 * magnitude || spread < 1e-100 {
        return Err(CircleError::Point { points: points.len(), spread });
    }

    // Moments about the mean in units of the spread, so that mean(z) = 1 and every tolerance is
    // relative; z = x^2 + y^2.
    let unit = |p: &[f64; 2]| [(p[0] - middle[0]) / spread, (p[1] - middle[1]) / spread];
    let [mut xx, mut yy, mut xy, mut xz, mut yz, mut zz] = [0.0; 6];
    for [x, y] in points.iter().map(unit) {
        let z = x * x + y * y;
        xx += x * x / count;
        yy += y * y / count;
        xy += x * y / count;
        xz += x * z / count;
        yz += y * z / count;
        zz += z * z / count;
    }
    let covariance = xx * yy - xy * xy;
    let variance_z = zz - 1.0;
    // The smallest root eta >= 0 of a0 + a1 eta + a2 eta^2 + 4 eta^3; Newton from 0 rises to it
    // without overshooting.
    let a0 = xz * (xz * yy - yz * xy) + yz * (yz * xx - xz * xy) - variance_z * covariance;
    let a1 = variance_z + 4.0 * covariance - xz * xz - yz * yz;
    let a2 = -3.0 - zz;
    let mut eta = 0.0;
    let mut value: f64 = a0;
    for _ in 0..50 {
        let slope = a1 + eta * (2.0 * a2 + eta * 12.0);
        let next = eta - value / slope;
        let next_value = a0 + next * (a1 + next * (a2 + next * 4.0));
        if next == eta || !next.is_finite() || next_value.abs() >= value.abs() {
            break;
        }
        (eta, value) = (next, next_value);
    }
    let determinant = eta * eta - eta + covariance;
    let center = [
        (xz * (yy - eta) - yz * xy) / (2.0 * determinant),
        (yz * (xx - eta) - xz * xy) / (2.0 * determinant),
    ];
    let radius = (center[0] * center[0] + center[1] * center[1] + 1.0).sqrt();
    if radius.is_nan() || radius > MAX_RADIUS_SPREADS {
        return Err(CircleError::Line { spread });
    }
    let center = [middle[0] + spread * center[0], middle[1] + spread * center[1]];
    let radius = spread * radius;
    let distance = |p: &[f64; 2]| (p[0] - center[0]).hypot(p[1] - center[1]) - radius;
    let rms_residual = mean(&|p| distance(p).powi(2)).sqrt();
    Ok(Circle { center, radius, rms_residual })
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;

    use super::*;

    fn motion(points: &[[f64; 2]]) -> Motion {
        let states = Trajectory::new(2, points.concat()).unwrap();
        Motion { states, duration_secs: 1.0 }
    }

    fn bounds(motion: &Motion) -> Vec<&'static str> {
        ArcsTask::default().violations(motion).iter().map(|v| v.bound).collect()
    }

    const ARC: Arc = Arc { center: [0.3, 0.7], radius: 0.4, span_rad: 3.0, start_rad: 1.0 };

    #[derive(Deserialize)]
    struct Golden {
        name: String,
        points: Vec<[f64; 2]>,
        center: [f64; 2],
        radius: f64,
        rms_residual: f64,
    }

    #[test]
    fn the_fit_agrees_with_an_independent_program() {
        let golden: Vec<Golden> =
            serde_json::from_str(include_str!("../../tests/golden/taubin.json")).unwrap();
        assert!(golden.len() >= 12);
        for Golden { name, points, center, radius, rms_residual } in golden {
            let circle = fit_circle(&points).unwrap();
            // The distance from the origin limits what either program can know of the centre.
            let magnitude = center[0].abs().max(center[1].abs()).max(radius);
            let tolerance = 1e-10 * radius + 1e-15 * magnitude * magnitude / radius;
            for (found, expected) in [
                (circle.center[0], center[0]),
                (circle.center[1], center[1]),
                (circle.radius, radius),
                (circle.rms_residual, rms_residual),
            ] {
                let difference = (found - expected).abs();
                assert!(difference < tolerance, "{name}: {found} is not {expected}");
            }
        }
    }

    #[test]
    fn every_simulated_arc_measures_its_own_centre_and_manner_and_is_valid() {
        for start in [ArcStart::Half, ArcStart::Full] {
            let task = ArcsTask::new(start);
            let simulation = ArcsSimulation { count: 500, steps: 32, start };
            let SimulatedArcs { splits, arcs } =
                simulate(&simulation, &mut ChaCha8Rng::seed_from_u64(1));
            let all = [splits.train, splits.validation, splits.test].concat();
            for (demonstration, arc) in all.iter().zip(&arcs) {
                let measured = task.empirical_task(&demonstration.motion).unwrap();
                assert!(ArcsTask::task_space().distance(&measured, &demonstration.w) < 1e-9);
                assert_eq!(task.violations(&demonstration.motion), []);
                let factors = task.factors(&demonstration.motion);
                for (found, expected) in factors.iter().zip(task.factors_of(arc)) {
                    assert_eq!(found.name, expected.name);
                    assert!((found.value - expected.value).abs() < 1e-9, "{arc:?}");
                }
                assert_eq!(factors.len(), task.factors_of(arc).len());
            }
        }
    }

    #[test]
    fn simulated_parameters_fill_their_ranges_evenly() {
        let simulation = ArcsSimulation { start: ArcStart::Full, ..ArcsSimulation::default() };
        let arcs = simulate(&simulation, &mut ChaCha8Rng::seed_from_u64(2)).arcs;
        let column = |value: fn(&Arc) -> f64| -> Vec<f64> { arcs.iter().map(value).collect() };
        for (values, lower, upper) in [
            (column(|a| a.center[0]), 0.0, 1.0),
            (column(|a| a.center[1]), 0.0, 1.0),
            (column(|a| a.radius), 0.2, 0.5),
            (column(|a| a.span_rad.to_degrees()), 90.0, 270.0),
            (column(|a| a.start_rad.to_degrees()), 0.0, 360.0),
        ] {
            // Of 10000 uniform values a tenth of the range holds 1000 with a deviation of 30.
            let mut shares = [0; 10];
            for value in values {
                shares[(10.0 * (value - lower) / (upper - lower)) as usize] += 1;
            }
            assert!(shares.iter().all(|n| (850..1150).contains(n)), "{shares:?}");
        }
    }

    #[test]
    fn one_in_ten_is_for_validation_and_one_in_ten_for_testing() {
        let splits = |count| {
            let simulation = ArcsSimulation { count, ..ArcsSimulation::default() };
            let splits = simulate(&simulation, &mut ChaCha8Rng::seed_from_u64(3)).splits;
            (splits.train.len(), splits.validation.len(), splits.test.len())
        };
        assert_eq!(splits(10_000), (8000, 1000, 1000));
        assert_eq!(splits(10), (8, 1, 1));
        assert_eq!(splits(57), (45, 6, 6));
    }

    #[test]
    fn points_without_a_circle_are_refused_with_the_reason() {
        let task = ArcsTask::default();
        let reason = |points: &[[f64; 2]]| {
            let error = task.empirical_task(&motion(points)).unwrap_err();
            assert_eq!(bounds(&motion(points)), ["valid_residual"]);
            error.to_string()
        };
        let point = reason(&[[0.3, 0.4]; 32]);
        assert!(point.contains("a point has no circle"), "{point}");
        let line: Vec<[f64; 2]> = (0..32).map(|i| [0.1 * f64::from(i), 0.3]).collect();
        let line = reason(&line);
        assert!(line.contains("a line has no centre"), "{line}");
        let slanted: Vec<[f64; 2]> =
            (0..32).map(|i| [0.017 * f64::from(i), 0.3 - 0.013 * f64::from(i)]).collect();
        assert!(reason(&slanted).contains("a line has no centre"));
        let two = reason(&[[0.0, 0.0], [1.0, 0.0]]);
        assert!(two.contains("at least 3"), "{two}");
        let far = reason(&[[0.0, 0.0], [1e80, 0.0], [0.0, 1.0]]);
        assert!(far.contains("point 1 is (1"), "{far}");
    }

    #[test]
    fn a_coordinate_that_is_not_finite_is_refused_by_its_place() {
        let error = fit_circle(&[[0.0, 1.0], [1.0, 0.0], [f64::NAN, 0.0]]).unwrap_err();
        assert!(matches!(error, CircleError::NotFinite { index: 2, .. }));
    }

    #[test]
    fn states_in_space_are_no_arc() {
        let states = Trajectory::new(3, vec![0.0; 12]).unwrap();
        let motion = Motion { states, duration_secs: 1.0 };
        let error = ArcsTask::default().empirical_task(&motion).unwrap_err();
        assert_eq!(error.to_string(), "a state has 3 values where a point of an arc has 2");
    }

    #[test]
    fn an_arc_outside_the_bounds_breaks_the_bound_by_name() {
        assert_eq!(bounds(&ARC.motion(32)), [""; 0]);
        assert_eq!(bounds(&Arc { radius: 0.03, ..ARC }.motion(32)), ["valid_radius"]);
        assert_eq!(bounds(&Arc { radius: 0.58, ..ARC }.motion(32)), ["valid_radius"]);
        assert_eq!(bounds(&Arc { radius: 0.57, ..ARC }.motion(32)), [""; 0]);
        assert_eq!(bounds(&Arc { span_rad: 1.3, ..ARC }.motion(32)), ["valid_span_rad"]);
        assert_eq!(bounds(&Arc { span_rad: 5.5, ..ARC }.motion(32)), ["valid_span_rad"]);
        assert_eq!(bounds(&Arc { span_rad: -3.0, ..ARC }.motion(32)), ["valid_span_rad"]);
        let mut crooked: Vec<[f64; 2]> =
            ARC.motion(32).states.states().map(|s| [s[0], s[1]]).collect();
        for point in crooked.iter_mut().step_by(2) {
            *point = [point[0] * 1.15, point[1] * 1.15];
        }
        assert!(bounds(&motion(&crooked)).contains(&"valid_residual"));
    }

    #[test]
    fn a_start_just_below_zero_is_next_to_one_just_above() {
        let start = |start_rad| {
            let factors = ArcsTask::default().factors(&Arc { start_rad, ..ARC }.motion(32));
            factors.iter().find(|f| f.name == "start").unwrap().value
        };
        assert!((start(-0.1) + 0.1).abs() < 1e-9);
        assert!((start(PI + 0.1) - PI - 0.1).abs() < 1e-9);
    }

    #[test]
    fn settings_of_another_name_are_refused() {
        let task: ArcsTask = serde_json::from_str(r#"{"start": "full"}"#).unwrap();
        assert_eq!(task, ArcsTask::new(ArcStart::Full));
        assert!(serde_json::from_str::<ArcsTask>(r#"{"begin": "full"}"#).is_err());
    }
}
