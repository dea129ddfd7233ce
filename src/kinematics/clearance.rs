//! How far the arm stays from itself and from the table below it.
//!
//! Every part of the robot is taken as a capsule: all points within a radius of a segment. The distance of
//! two capsules is that of their segments less their radii, exactly; so is that of a capsule and a plane.
//! Parts belong to *bodies*: body 0 stands still with the base, body `k` moves with the `k`-th joint. Two
//! parts are held apart when at least two joints lie between them; neighbours touch at their joint.

use std::fmt;

use nalgebra::{Point3, Vector3};
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;

use super::chain::Chain;
use super::forward::Frame;
use super::inverse::Solver;

/// Configurations at which parts are looked at that might touch always.
const PROBES: usize = 100;
/// Parts that touch in more than this share of them are built that way.
const ALWAYS: f64 = 0.95;
/// Bodies that stand on the table rather than above it: the base and what the first joint turns.
const STANDING_BODIES: usize = 2;

/// A part of the robot.
#[derive(Debug, Clone, PartialEq)]
pub struct Capsule {
    /// The link that it is a part of.
    pub link: String,
    /// The body that it moves with: 0 for the base, `k` for what the `k`-th joint moves.
    pub body: usize,
    /// One end of its segment (m): for body 0 in the base frame, for others in the frame of the link that the
    /// joint moves.
    pub from: Point3<f64>,
    /// The other end.
    pub to: Point3<f64>,
    /// Radius (m).
    pub radius: f64,
}

/// The parts of a robot, which of them must stay apart, and the table.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Hull {
    /// With their ends in the frames that forward kinematics uses.
    parts: Vec<Capsule>,
    pairs: Vec<(usize, usize)>,
    touching: Vec<[String; 2]>,
    table_height_m: Option<f64>,
}

/// What came nearest to what.
#[derive(Debug, Clone, PartialEq)]
pub struct Nearest {
    /// Distance (m), negative where they overlap.
    pub distance_m: f64,
    /// Which parts.
    pub contact: Contact,
}

/// Two things that should not touch.
#[derive(Debug, Clone, PartialEq)]
pub enum Contact {
    /// Two links.
    Links(String, String),
    /// A link and the table.
    Table(String),
}

impl fmt::Display for Contact {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Links(a, b) => write!(f, "{a} and {b}"),
            Self::Table(link) => write!(f, "{link} and the table"),
        }
    }
}

impl Hull {
    /// The hull of these parts on a chain. Links that are named together in `ignored` are not held apart,
    /// nor are parts that touch wherever the joints stand ([`Hull::touching`]). No link may come below the
    /// table's height in the base frame (m), but for those that nothing or only the first joint moves.
    ///
    /// # Panics
    /// When a part belongs to a body that the chain does not have.
    pub fn new(
        chain: &Chain,
        mut parts: Vec<Capsule>,
        ignored: &[[String; 2]],
        table_height_m: Option<f64>,
    ) -> Self {
        for part in parts.iter_mut().filter(|part| part.body > 0) {
            let aligned_from_joint = chain.aligned_from_joint(part.body - 1);
            part.from = aligned_from_joint * part.from;
            part.to = aligned_from_joint * part.to;
        }
        let is_ignored = |a: &Capsule, b: &Capsule| {
            ignored
                .iter()
                .any(|[x, y]| (*x == a.link && *y == b.link) || (*x == b.link && *y == a.link))
        };
        let all = (0..parts.len()).flat_map(|a| (0..a).map(move |b| (b, a)));
        let apart = |&(a, b): &(usize, usize)| {
            let (a, b) = (&parts[a], &parts[b]);
            a.body.abs_diff(b.body) >= 2 && !is_ignored(a, b)
        };
        let pairs: Vec<_> = all.filter(apart).collect();
        let mut hull = Self { parts, pairs, touching: Vec::new(), table_height_m };
        hull.leave_out_what_always_touches(chain);
        hull
    }

    fn leave_out_what_always_touches(&mut self, chain: &Chain) {
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        let mut anywhere = Solver::new(chain);
        let mut touched = vec![0; self.pairs.len()];
        let mut posed = Posed::new(self);
        for _ in 0..PROBES {
            anywhere.start_anywhere(&mut rng);
            posed.move_to(self, chain, &anywhere.q);
            for (count, &(a, b)) in touched.iter_mut().zip(&self.pairs) {
                *count += usize::from(posed.distance(self, a, b) < 0.0);
            }
        }
        let always = |count: usize| count as f64 > ALWAYS * PROBES as f64;
        let link = |part: usize| self.parts[part].link.clone();
        let touching = self.pairs.iter().zip(&touched).filter(|(_, count)| always(**count));
        self.touching = touching.map(|(&(a, b), _)| [link(a), link(b)]).collect();
        self.touching.dedup();
        let mut counts = touched.iter();
        self.pairs.retain(|_| !counts.next().is_some_and(|count| always(*count)));
    }

    /// Links whose parts touch wherever the joints stand, so that they are not held apart.
    pub fn touching(&self) -> &[[String; 2]] {
        &self.touching
    }

    /// Number of parts.
    pub fn parts(&self) -> usize {
        self.parts.len()
    }

    /// Height of the table (m in the base frame), where there is one.
    pub fn table_height_m(&self) -> Option<f64> {
        self.table_height_m
    }

    /// The same hull above another table, or none.
    #[must_use]
    pub fn with_table(mut self, table_height_m: Option<f64>) -> Self {
        self.table_height_m = table_height_m;
        self
    }

    /// What is nearest to each other at `q`; `None` where nothing has to stay apart.
    ///
    /// # Panics
    /// When `q` has not one value per joint.
    pub fn nearest(&self, chain: &Chain, q: &[f64]) -> Option<Nearest> {
        self.nearest_of(chain, std::iter::once(q))
    }

    /// What is nearest to each other at any of these configurations; `None` where nothing has to stay apart.
    ///
    /// # Panics
    /// When a configuration has not one value per joint.
    pub fn nearest_of<'a>(
        &self,
        chain: &Chain,
        configurations: impl Iterator<Item = &'a [f64]>,
    ) -> Option<Nearest> {
        self.nearest_within(chain, configurations, f64::INFINITY)
    }

    /// What is nearest to each other at any of these configurations, where that is nearer than `within_m`. It
    /// takes the less time the smaller that is.
    ///
    /// # Panics
    /// When a configuration has not one value per joint.
    pub fn nearest_within<'a>(
        &self,
        chain: &Chain,
        configurations: impl Iterator<Item = &'a [f64]>,
        within_m: f64,
    ) -> Option<Nearest> {
        let mut posed = Posed::new(self);
        let mut nearest: Option<(f64, Who)> = None;
        for q in configurations {
            chain.assert_dof(q);
            let within_m = nearest.map_or(within_m, |(distance, _)| distance);
            nearest = posed.nearest(self, chain, q, within_m).or(nearest);
        }
        nearest.map(|(distance_m, who)| Nearest { distance_m, contact: self.contact(who) })
    }

    pub(super) fn contact(&self, (a, b): Who) -> Contact {
        let link = |part: usize| self.parts[part].link.clone();
        match b {
            Some(b) => Contact::Links(link(a), link(b)),
            None => Contact::Table(link(a)),
        }
    }
}

/// Two parts, or a part and the table.
pub(super) type Who = (usize, Option<usize>);

/// A hull at one configuration. All buffers are made once.
#[derive(Debug, Clone)]
pub(super) struct Posed {
    bodies: Vec<Frame>,
    ends: Vec<[Vector3<f64>; 2]>,
    /// Twice the middle of each part, and the radius of the ball around it.
    balls: Vec<(Vector3<f64>, f64)>,
}

impl Posed {
    pub(super) fn new(hull: &Hull) -> Self {
        let ball = |part: &Capsule| 0.5 * (part.to - part.from).norm() + part.radius;
        let twice_middle = |part: &Capsule| part.from.coords + part.to.coords;
        Self {
            bodies: Vec::new(),
            ends: hull.parts.iter().map(|part| [part.from.coords, part.to.coords]).collect(),
            balls: hull.parts.iter().map(|part| (twice_middle(part), ball(part))).collect(),
        }
    }

    fn move_to(&mut self, hull: &Hull, chain: &Chain, q: &[f64]) {
        chain.bodies(q, &mut self.bodies);
        let posed = self.ends.iter_mut().zip(&mut self.balls);
        for ((ends, ball), part) in posed.zip(&hull.parts) {
            if part.body > 0 {
                let Frame { rotation, position } = &self.bodies[part.body - 1];
                *ends = [&part.from, &part.to].map(|end| rotation * end.coords + position);
                ball.0 = ends[0] + ends[1];
            }
        }
    }

    /// The smallest distance at `q` (m), and of what, where it is below `within`.
    pub(super) fn nearest(
        &mut self,
        hull: &Hull,
        chain: &Chain,
        q: &[f64],
        within: f64,
    ) -> Option<(f64, Who)> {
        self.move_to(hull, chain, q);
        let (mut nearest, mut within) = (None, within);
        for &(a, b) in &hull.pairs {
            let ((twice_a, ball_a), (twice_b, ball_b)) = (self.balls[a], self.balls[b]);
            let reach = 2.0 * (ball_a + ball_b + within).max(0.0);
            if (twice_a - twice_b).norm_squared() < reach * reach {
                let distance = self.distance(hull, a, b);
                if distance < within {
                    (nearest, within) = (Some((distance, (a, Some(b)))), distance);
                }
            }
        }
        if let Some(table) = hull.table_height_m {
            for (i, (part, [from, to])) in hull.parts.iter().zip(&self.ends).enumerate() {
                let distance = from.z.min(to.z) - part.radius - table;
                if part.body >= STANDING_BODIES && distance < within {
                    (nearest, within) = (Some((distance, (i, None))), distance);
                }
            }
        }
        nearest
    }

    fn distance(&self, hull: &Hull, a: usize, b: usize) -> f64 {
        between_segments(&self.ends[a], &self.ends[b]) - hull.parts[a].radius - hull.parts[b].radius
    }
}

/// Distance of two segments (Ericson, Real-Time Collision Detection, 2005, section 5.1.9): the nearest point
/// of the second's line to the first's, pulled into the second, and the nearest point of the first to that.
fn between_segments([p, p_end]: &[Vector3<f64>; 2], [q, q_end]: &[Vector3<f64>; 2]) -> f64 {
    const POINT: f64 = 1e-18;
    let (u, v, w) = (p_end - p, q_end - q, p - q);
    let (uu, vv) = (u.norm_squared(), v.norm_squared());
    let (uv, uw, vw) = (u.dot(&v), u.dot(&w), v.dot(&w));
    let share =
        |top: f64, bottom: f64| if bottom > POINT { (top / bottom).clamp(0.0, 1.0) } else { 0.0 };
    // Shares of the way along the first and along the second. Of parallel ones any start will do.
    let s = share(uv * vw - uw * vv, uu * vv - uv * uv);
    let t = share(uv * s + vw, vv);
    let s = share(uv * t - uw, uu);
    (w + u * s - v * t).norm()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kinematics::{Joint, JointKind};
    use nalgebra::Isometry3;
    use proptest::prelude::*;
    use std::f64::consts::FRAC_PI_2;

    /// Three links of 0.4 m in the plane of x and y.
    fn planar() -> Chain {
        let joint = |i: usize| Joint {
            name: format!("joint_{i}"),
            kind: JointKind::Revolute,
            parent_from_joint: Isometry3::translation(if i == 0 { 0.0 } else { 0.4 }, 0.0, 0.0),
            axis: Vector3::z_axis(),
            lower: -3.0,
            upper: 3.0,
            velocity: 1.0,
            acceleration: None,
            jerk: None,
            mimic: None,
        };
        Chain::new(
            "base",
            "tip",
            (0..3).map(joint).collect(),
            Isometry3::translation(0.4, 0.0, 0.0),
        )
        .unwrap()
    }

    fn link(body: usize) -> Capsule {
        let to = Point3::new(0.4, 0.0, 0.0);
        Capsule { link: format!("link_{body}"), body, from: Point3::origin(), to, radius: 0.05 }
    }

    fn arm(ignored: &[[String; 2]], table: Option<f64>) -> Hull {
        Hull::new(&planar(), (1..=3).map(link).collect(), ignored, table)
    }

    #[test]
    fn a_folded_arm_meets_itself_and_neighbours_do_not_count() {
        let hull = arm(&[], None);
        // A zigzag: the third link lies beside the first, 0.4 m off.
        let beside = hull.nearest(&planar(), &[0.0, FRAC_PI_2, FRAC_PI_2]);
        let beside = beside.unwrap();
        assert!((beside.distance_m - 0.3).abs() < 1e-9, "{beside:?}");
        assert_eq!(beside.contact, Contact::Links("link_1".into(), "link_3".into()));
        let folded = hull.nearest(&planar(), &[0.0, 2.6, 2.6]).unwrap();
        assert!(folded.distance_m < 0.0, "{folded:?}");
        let ignored = [["link_3".to_owned(), "link_1".to_owned()]];
        assert_eq!(arm(&ignored, None).nearest(&planar(), &[0.0, 2.6, 2.6]), None);
    }

    #[test]
    fn the_table_is_below_what_the_second_joint_moves() {
        let nearest = arm(&[], Some(-0.2)).nearest(&planar(), &[0.0; 3]).unwrap();
        assert!((nearest.distance_m - 0.15).abs() < 1e-12, "{nearest:?}");
        assert_eq!(nearest.contact, Contact::Table("link_2".into()));
        assert_eq!(nearest.contact.to_string(), "link_2 and the table");
    }

    #[test]
    fn parts_that_always_touch_are_told_and_left_out() {
        let around = Capsule { radius: 2.0, ..link(0) };
        let hull = Hull::new(&planar(), vec![around, link(1), link(2)], &[], None);
        assert_eq!(hull.touching(), [["link_0".to_owned(), "link_2".to_owned()]]);
        assert_eq!(hull.nearest(&planar(), &[0.0; 3]), None);
    }

    #[test]
    fn a_part_stands_where_its_link_is_whatever_the_joints_axis() {
        let mut joints = planar().joints().to_vec();
        joints[1].axis = Vector3::y_axis();
        let chain = Chain::new("base", "tip", joints, Isometry3::identity()).unwrap();
        let ball = |body, x: f64| {
            let at = Point3::new(x, 0.0, 0.0);
            Capsule { link: format!("link_{body}"), body, from: at, to: at, radius: 0.01 }
        };
        // Turned up by a quarter turn, the second link's end is 0.3 m above the first's.
        let hull = Hull::new(&chain, vec![ball(0, 0.4), ball(2, 0.3)], &[], None);
        let nearest = hull.nearest(&chain, &[0.0, -FRAC_PI_2, 0.0]).unwrap();
        assert!((nearest.distance_m - 0.28).abs() < 1e-9, "{nearest:?}");
    }

    fn point() -> impl Strategy<Value = Vector3<f64>> {
        prop::array::uniform3(-1.0..1.0f64).prop_map(Vector3::from)
    }

    proptest! {
        #[test]
        fn what_is_passed_over_is_further_away(
            q in prop::array::uniform3(-3.0..3.0f64), within in -0.1..0.5f64,
        ) {
            let hull = arm(&[], Some(-0.2));
            let chain = planar();
            let nearest = hull.nearest(&chain, &q).unwrap();
            let all = hull.pairs.iter().map(|&(a, b)| {
                let mut posed = Posed::new(&hull);
                posed.move_to(&hull, &chain, &q);
                posed.distance(&hull, a, b)
            });
            // In the plane the table is 0.15 m below every link.
            let least = all.fold(0.15, f64::min);
            prop_assert!((nearest.distance_m - least).abs() < 1e-12);
            let found = hull.nearest_within(&chain, std::iter::once(&q[..]), within);
            prop_assert_eq!(found, (least < within).then_some(nearest));
        }

        #[test]
        fn no_two_points_of_segments_are_nearer_than_their_distance(
            p in prop::array::uniform2(point()), q in prop::array::uniform2(point()), flat in 0..4u8,
        ) {
            // Now and then a segment is a point, or both are parallel.
            let p = if flat == 1 { [p[0], p[0]] } else { p };
            let q = match flat {
                2 => [q[0], q[0]],
                3 => [q[0], q[0] + (p[1] - p[0]) * 0.7],
                _ => q,
            };
            let distance = between_segments(&p, &q);
            let at = |[a, b]: &[Vector3<f64>; 2], share: f64| a + (b - a) * share;
            let mut least = f64::INFINITY;
            for i in 0..=60 {
                for j in 0..=60 {
                    let (a, b) = (at(&p, f64::from(i) / 60.0), at(&q, f64::from(j) / 60.0));
                    least = least.min((a - b).norm());
                }
            }
            prop_assert!(distance <= least + 1e-9, "{} above {}", distance, least);
            // 60 steps of segments at most 3.5 m long.
            prop_assert!(distance >= least - 0.06, "{} far below {}", distance, least);
        }
    }
}
