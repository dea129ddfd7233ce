//! A motion as RViz and Foxglove draw it: the tip's path, the band of its uncertainty, and the task with its
//! tolerance.

use nalgebra::{Point3, Unit, Vector3 as Direction};

use super::convert::Frames;
use super::messages::builtin_interfaces::Time;
use super::messages::geometry_msgs::{Point, Pose, Vector3};
use super::messages::std_msgs::{ColorRGBA, Header};
use super::messages::visualization_msgs::{Marker, MarkerArray};
use crate::pose::BAND_STDDEVS;
use crate::serving::Sample;

/// Rings of the band, and the corners of each.
const RINGS: usize = 40;
const CORNERS: usize = 8;
/// Width of the path's line, and thickness of a location's disc (m).
const LINE_M: f32 = 0.004;
const DISC_M: f64 = 0.002;
/// Where points are nearer than this, there is no direction from one to the next (m).
const STANDING_M: f64 = 1e-6;

const BLUE: [f32; 3] = [0.12, 0.47, 0.71];
const GREY: [f32; 3] = [0.5, 0.5, 0.5];
const GREEN: [f32; 3] = [0.17, 0.63, 0.17];
const ORANGE: [f32; 3] = [1.0, 0.5, 0.05];

/// The markers of a sample, in place of those of the one before. `tolerance_m` is the radius of the discs at the
/// task's locations.
pub fn markers(frames: &Frames, sample: &Sample, tolerance_m: f64, stamp: Time) -> MarkerArray {
    let header = Header { stamp, frame_id: frames.base.clone() };
    let marker = |ns: &str, id: i32, kind: i32, rgb: [f32; 3], alpha: f32| Marker {
        header: header.clone(),
        ns: ns.into(),
        id,
        r#type: kind,
        color: ColorRGBA { r: rgb[0], g: rgb[1], b: rgb[2], a: alpha },
        ..Marker::default()
    };
    let begin = sample.primitive_start_index as usize;
    let tips: Vec<Point3<f64>> = sample
        .end_effector_trajectory
        .base_from_tip
        .iter()
        .map(|pose| pose.translation.vector.into())
        .collect();
    let line = |ns: &str, points: &[Point3<f64>], rgb| Marker {
        scale: Vector3 { x: LINE_M.into(), ..Vector3::default() },
        points: points.iter().map(point).collect(),
        ..marker(ns, 0, Marker::LINE_STRIP, rgb, 1.0)
    };
    let mut markers = vec![Marker { action: Marker::DELETE_ALL, ..marker("", 0, 0, GREY, 0.0) }];
    if begin > 0 {
        markers.push(line("approach", &tips[..=begin], GREY));
    }
    markers.push(line("path", &tips[begin..], BLUE));
    let radii: Vec<f64> = sample.position_stddev.iter().map(|s| BAND_STDDEVS * s).collect();
    markers.push(Marker {
        scale: Vector3 { x: 1.0, y: 1.0, z: 1.0 },
        points: tube(&tips[begin..], &radii[begin..]).iter().map(point).collect(),
        ..marker("band", 0, Marker::TRIANGLE_LIST, BLUE, 0.25)
    });
    for (id, (asked, reached)) in (0..).zip(sample.task.iter().zip(&sample.empirical_task)) {
        // A location has no height; it is shown where the tip comes nearest to it.
        let away = |tip: &&Point3<f64>| (tip.x - asked.xy[0]).hypot(tip.y - asked.xy[1]);
        let nearest = tips[begin..].iter().min_by(|a, b| away(a).total_cmp(&away(b)));
        let z = nearest.map_or(0.0, |tip| tip.z);
        let at =
            |xy: [f64; 2]| Pose { position: Point { x: xy[0], y: xy[1], z }, ..Pose::default() };
        let round = |across: f64, high: f64| Vector3 { x: across, y: across, z: high };
        markers.push(Marker {
            pose: at(asked.xy),
            scale: round(2.0 * tolerance_m, DISC_M),
            ..marker(&asked.name, id, Marker::CYLINDER, GREEN, 0.5)
        });
        markers.push(Marker {
            pose: at(reached.xy),
            scale: round(2.0 * f64::from(LINE_M), 2.0 * f64::from(LINE_M)),
            ..marker(&format!("{}/reached", asked.name), id, Marker::SPHERE, ORANGE, 1.0)
        });
    }
    MarkerArray { markers }
}

fn point(p: &Point3<f64>) -> Point {
    Point { x: p.x, y: p.y, z: p.z }
}

/// The triangles of a tube about a path, with a radius at each of its points: three corners each.
fn tube(path: &[Point3<f64>], radii: &[f64]) -> Vec<Point3<f64>> {
    let last = path.len().saturating_sub(1);
    let rings = RINGS.min(path.len());
    let at = |ring: usize| ring * last / (rings - 1).max(1);
    let mut around: Option<Unit<Direction<f64>>> = None;
    let mut corners: Vec<Vec<Point3<f64>>> = Vec::new();
    for ring in 0..rings {
        let i = at(ring);
        let (before, after) =
            (&path[at(ring.saturating_sub(1))], &path[at((ring + 1).min(rings - 1))]);
        let Some(along) = Unit::try_new(after - before, STANDING_M) else { continue };
        // The direction of the ring before, as far as it is across this one's, so that the tube does not twist.
        let guess = around.map_or_else(Direction::x, Unit::into_inner);
        let across = |guess: Direction<f64>| {
            Unit::try_new(guess - along.into_inner() * guess.dot(&along), STANDING_M)
        };
        let Some(first) = across(guess).or_else(|| across(Direction::y())) else { continue };
        around = Some(first);
        let second = along.cross(&first);
        let corner = |k: usize| {
            let (sin, cos) = (std::f64::consts::TAU * k as f64 / CORNERS as f64).sin_cos();
            path[i] + radii[i] * (first.into_inner() * cos + second * sin)
        };
        corners.push((0..CORNERS).map(corner).collect());
    }
    let pairs = corners.iter().zip(corners.iter().skip(1));
    let quads = pairs.flat_map(|(a, b)| {
        (0..CORNERS).flat_map(move |k| {
            let next = (k + 1) % CORNERS;
            [a[k], b[k], b[next], a[k], b[next], a[next]]
        })
    });
    quads.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tube_is_as_wide_as_its_radii_all_along_a_bent_path() {
        let path: Vec<_> = (0..100)
            .map(|i| f64::from(i) / 99.0)
            .map(|t| Point3::new((3.0 * t).cos(), (3.0 * t).sin(), 0.2 * t))
            .collect();
        let radii: Vec<_> = (0..100).map(|i| 0.01 + 1e-4 * f64::from(i)).collect();
        let corners = tube(&path, &radii);
        assert_eq!(corners.len(), 6 * CORNERS * (RINGS - 1));
        for corner in &corners {
            let near = path.iter().zip(&radii).map(|(p, r)| ((corner - p).norm(), r));
            let (distance, radius) = near.min_by(|a, b| a.0.total_cmp(&b.0)).unwrap();
            assert!((distance - radius).abs() < 2e-3, "{distance} {radius}");
        }
    }

    #[test]
    fn a_path_that_stands_still_has_a_tube_where_it_moves() {
        let path: Vec<_> = (0..20).map(|i| Point3::new(f64::from(i.max(10)), 0.0, 0.0)).collect();
        let corners = tube(&path, &[0.1; 20]);
        assert!(
            !corners.is_empty() && corners.iter().all(|c| c.coords.iter().all(|v| v.is_finite()))
        );
        assert_eq!(tube(&path[..2], &[0.1; 2]), []);
        assert_eq!(tube(&[], &[]), []);
    }
}
