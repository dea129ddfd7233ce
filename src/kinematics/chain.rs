//! The chain of joints from the base to the tip.

use std::collections::BTreeMap;
use std::f64::consts::PI;

use nalgebra::{Isometry3, Unit, UnitQuaternion, Vector3};
use rand::{Rng, RngExt};

use super::JointLimits;
use super::forward::Link;

/// How a joint moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum JointKind {
    /// Turns about its axis between two limits.
    Revolute,
    /// Turns about its axis without limits.
    Continuous,
    /// Slides along its axis between two limits.
    Prismatic,
}

/// One moving joint of a [`Chain`]. Positions are in rad, or in m for a prismatic joint.
#[derive(Debug, Clone, PartialEq)]
pub struct Joint {
    /// Name, as a controller knows it.
    pub name: String,
    /// How it moves.
    pub kind: JointKind,
    /// The joint's frame at position 0, in the frame of the moving joint before it (of the base for
    /// the first joint); the fixed joints between the two are folded in.
    pub parent_from_joint: Isometry3<f64>,
    /// The axis in the joint's frame.
    pub axis: Unit<Vector3<f64>>,
    /// Smallest position; minus infinity for a continuous joint.
    pub lower: f64,
    /// Largest position; infinity for a continuous joint.
    pub upper: f64,
    /// Largest speed, rad/s or m/s.
    pub velocity: f64,
    /// Largest acceleration, rad/s² or m/s², where one is known. URDF files before version 1.2
    /// have none.
    pub acceleration: Option<f64>,
    /// Largest jerk, rad/s³ or m/s³, where one is known.
    pub jerk: Option<f64>,
    /// The joint that this one follows, if it does not move on its own.
    pub mimic: Option<Mimic>,
}

/// How a joint follows another of its chain: it is at `multiplier` times the other's position plus `offset`.
#[derive(Debug, Clone, PartialEq)]
pub struct Mimic {
    /// Name of the other joint.
    pub joint: String,
    /// Units of this joint per unit of the other.
    pub multiplier: f64,
    /// Where this joint is when the other is at 0 (rad, or m).
    pub offset: f64,
}

impl Joint {
    /// The middle of the joint's range, and 0 for a continuous joint.
    pub fn middle(&self) -> f64 {
        if self.lower.is_finite() && self.upper.is_finite() {
            0.5 * (self.lower + self.upper)
        } else {
            0.0
        }
    }

    /// Distance from `position` to the nearer limit, negative outside; infinite without limits.
    pub fn margin(&self, position: f64) -> f64 {
        (position - self.lower).min(self.upper - position)
    }
}

/// Why joints are not a chain.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ChainError {
    /// Nothing moves between the base and the tip.
    #[error("no joint moves between {base_frame:?} and {tip_frame:?}; choose a tip further out")]
    NoJoints {
        /// The base.
        base_frame: String,
        /// The tip.
        tip_frame: String,
    },
    /// A joint stands twice.
    #[error("the joint {joint:?} stands twice between the base and the tip")]
    Duplicate {
        /// Name of the joint.
        joint: String,
    },
    /// An axis or an origin is not finite, or an axis has no direction.
    #[error("the origin or the axis of joint {joint:?} is not a finite transform with a direction")]
    Geometry {
        /// Name of the joint.
        joint: String,
    },
    /// The position limits leave no room, or are not finite where they must be.
    #[error(
        "joint {joint:?} has position limits {lower} to {upper}; give it a <limit> whose lower is \
         below its upper"
    )]
    Range {
        /// Name of the joint.
        joint: String,
        /// Lower limit.
        lower: f64,
        /// Upper limit.
        upper: f64,
    },
    /// No velocity limit, without which nothing can be timed.
    #[error(
        "joint {joint:?} has velocity limit {velocity}; give it a <limit> with a velocity above 0"
    )]
    Velocity {
        /// Name of the joint.
        joint: String,
        /// The limit.
        velocity: f64,
    },
    /// A joint that follows one that is not there, that follows another itself, or by no number.
    #[error(
        "joint {joint:?} is a mimic of {of:?} by {multiplier} and {offset}; it can only follow a joint between \
         the base and the tip that moves on its own, by finite numbers, the first not 0"
    )]
    Mimic {
        /// Name of the joint.
        joint: String,
        /// The joint that it follows.
        of: String,
        /// See [`Mimic::multiplier`].
        multiplier: f64,
        /// See [`Mimic::offset`].
        offset: f64,
    },
    /// An acceleration or a jerk limit that is not above 0.
    #[error("joint {joint:?} has {what} limit {limit}; it must be above 0")]
    Limit {
        /// Name of the joint.
        joint: String,
        /// `acceleration` or `jerk`.
        what: &'static str,
        /// The limit.
        limit: f64,
    },
}

/// The moving joints from a base frame to a tip frame, in that order.
#[derive(Debug, Clone, PartialEq)]
pub struct Chain {
    base_frame: String,
    tip_frame: String,
    /// All of them, in their order.
    moving: Vec<Joint>,
    /// Those that move on their own, with limits that hold for those that follow them, too.
    joints: Vec<Joint>,
    last_joint_from_tip: Isometry3<f64>,
    /// What forward kinematics multiplies: the joints' frames turned so that every axis is z.
    pub(super) links: Vec<Link>,
    /// From the last of `links` to the tip.
    pub(super) last_link_from_tip: (nalgebra::Matrix3<f64>, Vector3<f64>),
}

impl Chain {
    /// A chain of these joints. Those that follow others are no joints of the chain by themselves: a configuration
    /// has no values of theirs, and their limits narrow the others'.
    ///
    /// # Errors
    /// No joint at all, a joint that follows none of them, a name that stands twice, a transform that is not finite, limits that
    /// leave no room, no velocity limit.
    pub fn new(
        base_frame: impl Into<String>,
        tip_frame: impl Into<String>,
        joints: Vec<Joint>,
        last_joint_from_tip: Isometry3<f64>,
    ) -> Result<Self, ChainError> {
        let (base_frame, tip_frame) = (base_frame.into(), tip_frame.into());
        let moving = joints;
        let mut joints: Vec<Joint> = moving.iter().filter(|j| j.mimic.is_none()).cloned().collect();
        if joints.is_empty() {
            return Err(ChainError::NoJoints { base_frame, tip_frame });
        }
        for (i, joint) in moving.iter().enumerate() {
            check(joint)?;
            if moving[..i].iter().any(|j| j.name == joint.name) {
                return Err(ChainError::Duplicate { joint: joint.name.clone() });
            }
        }
        if !is_finite(&last_joint_from_tip) {
            return Err(ChainError::Geometry { joint: moving[moving.len() - 1].name.clone() });
        }
        let leaders = moving.iter().map(|joint| leader(joint, &joints));
        let leaders: Vec<_> = leaders.collect::<Result<_, _>>()?;
        for (joint, (leader, multiplier, offset)) in moving.iter().zip(&leaders) {
            narrow(&mut joints[*leader], joint, *multiplier, *offset);
        }
        // What is left after narrowing may be no range.
        joints.iter().try_for_each(check)?;
        let mut links = Vec::with_capacity(joints.len());
        let mut aligned_from_joint = UnitQuaternion::identity();
        for (joint, &(leader, multiplier, offset)) in moving.iter().zip(&leaders) {
            let joint_from_aligned = z_to(&joint.axis);
            let transform = aligned_from_joint * joint.parent_from_joint * joint_from_aligned;
            links.push(Link::new(&transform, joint.kind, leader, multiplier, offset));
            aligned_from_joint = joint_from_aligned.inverse();
        }
        let last = aligned_from_joint * last_joint_from_tip;
        let last_link_from_tip =
            (last.rotation.to_rotation_matrix().into_inner(), last.translation.vector);
        Ok(Self {
            base_frame,
            tip_frame,
            moving,
            joints,
            last_joint_from_tip,
            links,
            last_link_from_tip,
        })
    }

    /// Name of the frame that poses are given in.
    pub fn base_frame(&self) -> &str {
        &self.base_frame
    }

    /// Name of the frame that follows poses.
    pub fn tip_frame(&self) -> &str {
        &self.tip_frame
    }

    /// The joints that move on their own, from the base to the tip.
    pub fn joints(&self) -> &[Joint] {
        &self.joints
    }

    /// Number of joints that move on their own.
    pub fn dof(&self) -> usize {
        self.joints.len()
    }

    /// Names of the joints, in the order of the values of a configuration.
    pub fn joint_names(&self) -> Vec<String> {
        self.joints.iter().map(|j| j.name.clone()).collect()
    }

    /// The tip in the frame of the last moving joint.
    pub fn last_joint_from_tip(&self) -> &Isometry3<f64> {
        &self.last_joint_from_tip
    }

    /// The same chain with these limits in place of its own, by the names of joints; those of other joints
    /// have no effect.
    ///
    /// # Errors
    /// A limit that is not above 0.
    pub fn with_limits(
        mut self,
        limits: &BTreeMap<String, JointLimits>,
    ) -> Result<Self, ChainError> {
        for joint in &mut self.joints {
            if let Some(limits) = limits.get(&joint.name) {
                joint.velocity = limits.velocity.unwrap_or(joint.velocity);
                joint.acceleration = limits.acceleration.or(joint.acceleration);
                joint.jerk = limits.jerk.or(joint.jerk);
                check(joint)?;
            }
        }
        Ok(self)
    }

    /// The same chain with position limits so much further out on both sides (rad or m).
    ///
    /// # Errors
    /// A distance that leaves no range.
    pub fn widened(&self, by: f64) -> Result<Self, ChainError> {
        let mut joints = self.moving.clone();
        for joint in &mut joints {
            joint.lower -= by;
            joint.upper += by;
        }
        Self::new(&*self.base_frame, &*self.tip_frame, joints, self.last_joint_from_tip)
    }

    /// The configuration with every joint in the middle of its range.
    pub fn middle(&self) -> Vec<f64> {
        self.joints.iter().map(Joint::middle).collect()
    }

    /// A configuration drawn evenly from inside the limits; from a full turn for a joint without.
    pub fn draw<R: Rng + ?Sized>(&self, rng: &mut R) -> Vec<f64> {
        let draw = |joint: &Joint| {
            let half_range = (0.5 * (joint.upper - joint.lower)).min(PI);
            joint.middle() + rng.random_range(-half_range..=half_range)
        };
        self.joints.iter().map(draw).collect()
    }

    /// Whether every value of `q` is inside its joint's limits; false for NaN.
    ///
    /// # Panics
    /// When `q` has not one value per joint.
    pub fn within_limits(&self, q: &[f64]) -> bool {
        self.assert_dof(q);
        self.joints.iter().zip(q).all(|(j, v)| (j.lower..=j.upper).contains(v))
    }

    /// Smallest distance of a joint to one of its limits (rad or m), negative outside; infinite
    /// when every joint is continuous.
    ///
    /// # Panics
    /// When `q` has not one value per joint.
    pub fn margin(&self, q: &[f64]) -> f64 {
        self.assert_dof(q);
        self.joints.iter().zip(q).map(|(j, &v)| j.margin(v)).fold(f64::INFINITY, f64::min)
    }

    /// Into the frame that forward kinematics uses for what a joint moves, from the joint's own frame.
    pub(super) fn aligned_from_joint(&self, joint: usize) -> UnitQuaternion<f64> {
        z_to(&self.moving[joint].axis).inverse()
    }

    pub(super) fn assert_dof(&self, q: &[f64]) {
        assert_eq!(q.len(), self.dof(), "a configuration has one value per joint");
    }
}

/// Which of the joints that move on their own tells where a joint is, and by which numbers.
fn leader(joint: &Joint, joints: &[Joint]) -> Result<(usize, f64, f64), ChainError> {
    let index = |name: &str| joints.iter().position(|j| j.name == name);
    let Some(Mimic { joint: of, multiplier, offset }) = &joint.mimic else {
        return Ok((index(&joint.name).expect("it is one of them"), 1.0, 0.0));
    };
    let usable = multiplier.is_finite() && *multiplier != 0.0 && offset.is_finite();
    match index(of).filter(|_| usable) {
        Some(index) => Ok((index, *multiplier, *offset)),
        None => Err(ChainError::Mimic {
            joint: joint.name.clone(),
            of: of.clone(),
            multiplier: *multiplier,
            offset: *offset,
        }),
    }
}

/// Keeps a joint where one that follows it is inside its own limits.
fn narrow(leader: &mut Joint, follower: &Joint, multiplier: f64, offset: f64) {
    let [a, b] = [follower.lower, follower.upper].map(|limit| (limit - offset) / multiplier);
    leader.lower = leader.lower.max(a.min(b));
    leader.upper = leader.upper.min(a.max(b));
    let slowest = |own: f64, limit: f64| own.min(limit / multiplier.abs());
    leader.velocity = slowest(leader.velocity, follower.velocity);
    for (own, limit) in
        [(&mut leader.acceleration, follower.acceleration), (&mut leader.jerk, follower.jerk)]
    {
        if let Some(limit) = limit {
            *own = Some(slowest(own.unwrap_or(f64::INFINITY), limit));
        }
    }
}

fn check(joint: &Joint) -> Result<(), ChainError> {
    let name = || joint.name.clone();
    let is_unit = (joint.axis.norm() - 1.0).abs() < 1e-6;
    if !(is_unit && is_finite(&joint.parent_from_joint)) {
        return Err(ChainError::Geometry { joint: name() });
    }
    let bounded = joint.lower.is_finite() && joint.upper.is_finite();
    let has_room = joint.lower < joint.upper;
    if !(has_room && (bounded || joint.kind == JointKind::Continuous)) {
        return Err(ChainError::Range { joint: name(), lower: joint.lower, upper: joint.upper });
    }
    if !(joint.velocity.is_finite() && joint.velocity > 0.0) {
        return Err(ChainError::Velocity { joint: name(), velocity: joint.velocity });
    }
    for (what, limit) in [("acceleration", joint.acceleration), ("jerk", joint.jerk)] {
        if let Some(limit) = limit.filter(|limit| !(limit.is_finite() && *limit > 0.0)) {
            return Err(ChainError::Limit { joint: name(), what, limit });
        }
    }
    Ok(())
}

fn is_finite(transform: &Isometry3<f64>) -> bool {
    let finite = |v: &[f64]| v.iter().all(|x| x.is_finite());
    finite(transform.translation.vector.as_slice()) && finite(transform.rotation.coords.as_slice())
}

/// A rotation that turns z into `axis`.
fn z_to(axis: &Unit<Vector3<f64>>) -> UnitQuaternion<f64> {
    UnitQuaternion::rotation_between_axis(&Vector3::z_axis(), axis).unwrap_or_else(|| {
        // Opposite to z: any half turn across it.
        UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn slide() -> Joint {
        Joint {
            name: "slide".into(),
            kind: JointKind::Prismatic,
            parent_from_joint: Isometry3::identity(),
            axis: -Vector3::z_axis(),
            lower: -0.5,
            upper: 0.1,
            velocity: 1.0,
            acceleration: None,
            jerk: None,
            mimic: None,
        }
    }

    fn chain(joints: Vec<Joint>) -> Result<Chain, ChainError> {
        Chain::new("base", "tip", joints, Isometry3::translation(1.0, 0.0, 0.0))
    }

    #[test]
    fn the_margin_is_the_distance_to_the_nearest_limit_and_negative_outside() {
        let second = Joint { name: "second".into(), lower: -10.0, upper: 10.0, ..slide() };
        let chain = chain(vec![slide(), second]).unwrap();
        assert!((chain.margin(&[0.0, 0.0]) - 0.1).abs() < 1e-12);
        assert!((chain.margin(&[-0.3, 9.95]) - 0.05).abs() < 1e-12);
        assert!((chain.margin(&[0.3, 0.0]) + 0.2).abs() < 1e-12);
        assert!(chain.within_limits(&[0.1, 0.0]) && !chain.within_limits(&[0.11, 0.0]));
        assert!(!chain.within_limits(&[0.0, f64::NAN]));
        assert_eq!(chain.middle(), [-0.2, 0.0]);
    }

    #[test]
    fn a_joint_along_minus_z_moves_down() {
        let tip = chain(vec![slide()]).unwrap().forward(&[0.1]);
        assert!((tip.translation.vector - Vector3::new(1.0, 0.0, -0.1)).norm() < 1e-12);
        assert!(tip.rotation.angle() < 1e-12);
    }

    #[test]
    fn a_name_may_not_stand_twice() {
        let error = chain(vec![slide(), slide()]).unwrap_err();
        assert_eq!(error, ChainError::Duplicate { joint: "slide".into() });
    }

    #[test]
    fn an_acceleration_limit_must_be_above_zero() {
        let limits = |acceleration, jerk| {
            let limits = JointLimits { velocity: None, acceleration, jerk };
            BTreeMap::from([(slide().name, limits), ("another".into(), limits)])
        };
        let free = chain(vec![slide()]).unwrap();
        let slow = free.clone().with_limits(&limits(Some(2.0), None)).unwrap();
        assert_eq!((slow.joints()[0].acceleration, slow.joints()[0].jerk), (Some(2.0), None));
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(free.clone().with_limits(&limits(Some(bad), None)).is_err());
            let error = free.clone().with_limits(&limits(None, Some(bad))).unwrap_err();
            assert!(error.to_string().contains("jerk limit"), "{error}");
        }
    }

    /// A slide whose second half follows the first, as in a telescope, and turns back.
    #[test]
    fn a_joint_that_follows_another_moves_with_it_and_narrows_its_limits() {
        let follower = |multiplier, offset| Joint {
            name: "follower".into(),
            lower: -0.1,
            upper: 0.2,
            velocity: 0.5,
            acceleration: Some(3.0),
            mimic: Some(Mimic { joint: slide().name, multiplier, offset }),
            ..slide()
        };
        let telescope = chain(vec![slide(), follower(-0.5, 0.05)]).unwrap();
        assert_eq!((telescope.dof(), telescope.joint_names()), (1, vec![slide().name]));
        let joint = &telescope.joints()[0];
        // Of -0.1 <= 0.05 - 0.5 q <= 0.2, and of the slide's own.
        let own = (slide().lower, slide().upper);
        assert!((joint.lower - own.0.max(-0.3)).abs() < 1e-12, "{}", joint.lower);
        assert!((joint.upper - own.1.min(0.3)).abs() < 1e-12, "{}", joint.upper);
        assert_eq!((joint.velocity, joint.acceleration), (slide().velocity.min(1.0), Some(6.0)));
        let both = chain(vec![slide(), Joint { mimic: None, ..follower(1.0, 0.0) }]).unwrap();
        for q in [-0.2, 0.0, 0.25] {
            let expected = both.forward(&[q, 0.05 - 0.5 * q]);
            assert!(
                (telescope.forward(&[q]).to_homogeneous() - expected.to_homogeneous()).norm()
                    < 1e-12
            );
            let (_, jacobian) = telescope.jacobian(&[q]);
            let (_, each) = both.jacobian(&[q, 0.05 - 0.5 * q]);
            let sum = each.column(0) - 0.5 * each.column(1);
            assert!((jacobian.column(0) - sum).norm() < 1e-12);
        }
        for wrong in [
            follower(0.0, 0.0),
            follower(f64::NAN, 0.0),
            Joint {
                mimic: Some(Mimic { joint: "moon".into(), multiplier: 1.0, offset: 0.0 }),
                ..follower(1.0, 0.0)
            },
        ] {
            let error = chain(vec![slide(), wrong]).unwrap_err();
            assert!(matches!(error, ChainError::Mimic { .. }), "{error}");
        }
        // It would have to be where it can't be.
        assert!(matches!(chain(vec![slide(), follower(1e-9, 5.0)]), Err(ChainError::Range { .. })));
    }
}
