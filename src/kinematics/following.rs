//! Joint positions whose tip follows a path of poses.
//!
//! Each point is solved by damped least squares from the point before it, so the arm stays on one
//! branch of its solutions. What decides whether a path can be followed to its end is where the arm
//! begins: the first point is solved from many start configurations, each is followed, and the best
//! complete path is kept. The search ends early at the first path that is comfortable: every joint
//! [`FollowOptions::good_margin_rad`] off its limits and no faster than its velocity limit.
//!
//! A redundant arm's freedom goes into staying off the limits ([`FollowOptions::centring_secs`]).
//!
//! # What counts as continuous
//! Between two points a joint may move as far as its velocity limit allows in the time between them.
//! A motion that is only too fast is no jump, for the uniform slowdown of [`super::timing`] makes it
//! legal, while a change of branch stays a jump however slowly it is played. The two are told apart
//! by halving: where a joint moves too far, the arm is led through the pose half way between the
//! two points, and the same limit holds for each half. The steps of a fast motion halve with it; a
//! change of branch keeps its size. Halving ends at [`FollowOptions::max_slowdown`]: a motion that
//! had to be slowed down further is refused as a jump.

use std::f64::consts::TAU;

use nalgebra::{Isometry3, Rotation3};
use rand::Rng;

use super::chain::{Chain, Joint, JointKind};
use super::clearance::{Contact, Hull, Posed, Who};
use super::forward::Frame;
use super::inverse::{Residual, Solver, Tolerance, rotation_vector};

/// Largest step of a joint (rad or m) whatever the time between two points is: between points far
/// apart a change of branch could be within the velocity limit.
const LARGEST_STEP: f64 = 0.5;

/// Start configurations nearer than this to each other in every joint (rad or m) are one.
const SAME_START: f64 = 0.05;

/// Steps along the freedom of the first pose, and the share of the way to the middle in each.
const SETTLING_STEPS: usize = 12;
const SETTLING_PULL: f64 = 0.5;

/// Random configurations from which a point is tried before it counts as out of reach.
const REACH_RESTARTS: usize = 32;

/// Where it is not to be found out why a path can't be followed: the poses that are tried, each from so many
/// configurations, to find out whether it can be at all.
const PROBES: usize = 3;
const PROBE_STEP: usize = 4;
const PROBE_RESTARTS: usize = 12;

/// How a path is followed.
#[derive(Debug, Clone, PartialEq)]
pub struct FollowOptions<'a> {
    /// What must stay apart at every point.
    pub hull: Option<&'a Hull>,
    /// Smallest distance that is left between what must stay apart (m).
    pub clearance_m: f64,
    /// How near to each pose the tip must be.
    pub tolerance: Tolerance,
    /// The configuration to begin near to, such as where the arm is. When its path is complete, it
    /// is taken; otherwise the search goes on as without.
    pub start: Option<Vec<f64>>,
    /// Configurations that are looked at first, such as postures of demonstrations: the arm goes on from there
    /// without using its freedom.
    pub postures: Vec<&'a [f64]>,
    /// How far inside its limits each joint is kept (rad, or m), so that it does not swing beyond them between
    /// two points; no further than a tenth of its range.
    pub limit_margin: f64,
    /// Start configurations for the first point: the middle of the joints' ranges, then random
    /// ones. At least one is tried.
    pub starts: usize,
    /// Start configurations that are still tried after the first complete path, when none is
    /// comfortable.
    pub further_starts: usize,
    /// Smallest distance to a limit (rad, or m) that leaves nothing to wish for.
    pub good_margin_rad: f64,
    /// Time in which a joint at its limit goes back towards the middle, as far as the pose leaves it
    /// free (s). Infinity leaves the freedom unused.
    pub centring_secs: f64,
    /// Largest slowdown that makes a motion legal; counts as the next power of two.
    pub max_slowdown: f64,
    /// Whether it is worked out why a path can't be followed, which takes longer than the search.
    pub diagnose: bool,
}

impl Default for FollowOptions<'_> {
    fn default() -> Self {
        Self {
            hull: None,
            clearance_m: 0.01,
            tolerance: Tolerance::default(),
            start: None,
            postures: Vec::new(),
            limit_margin: 0.0,
            starts: 64,
            further_starts: 8,
            good_margin_rad: 0.1,
            centring_secs: 1.0,
            max_slowdown: 8.0,
            diagnose: true,
        }
    }
}

/// A path in joint space.
#[derive(Debug, Clone, PartialEq)]
pub struct Followed {
    /// Joint positions, one configuration per pose (rad, or m for prismatic joints).
    pub positions: Vec<Vec<f64>>,
    /// Largest distance of the tip from its pose (m).
    pub position_error_m: f64,
    /// Largest angle of the tip from its pose (rad).
    pub orientation_error_rad: f64,
    /// Smallest distance of a joint to one of its limits (rad, or m); infinite without limits.
    pub joint_margin_rad: f64,
    /// Largest step of a joint as a share of what its velocity limit allows; above 1 the motion has
    /// to be slowed down.
    pub speed: f64,
}

/// Why no joint path follows the poses. Points are counted from 1, and point `n` is due at `n`
/// steps of time.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum FollowError {
    /// The arm cannot reach a pose, with or without its limits.
    #[error(
        "point {point} of {points} (t = {time_secs:.1} s) is {} out of reach of {tip_frame}",
        out_of_reach(*position_error_m, *orientation_error_rad)
    )]
    Unreachable {
        /// The first point that fails, from 1.
        point: usize,
        /// Number of points.
        points: usize,
        /// Time of the point (s).
        time_secs: f64,
        /// The tip.
        tip_frame: String,
        /// Distance of the nearest pose that was found (m).
        position_error_m: f64,
        /// Angle of the nearest pose that was found (rad).
        orientation_error_rad: f64,
    },
    /// The arm could reach a pose, were it not for a joint's limit.
    #[error(
        "at point {point} of {points} (t = {time_secs:.1} s) {joint} would be {excess_rad:.2} rad \
         beyond its limit of {limit:.2}; move the path, or turn the tip less"
    )]
    JointLimit {
        /// The first point that fails, from 1.
        point: usize,
        /// Number of points.
        points: usize,
        /// Time of the point (s).
        time_secs: f64,
        /// The joint furthest beyond its limit.
        joint: String,
        /// The limit less the margin that is kept to it (rad, or m).
        limit: f64,
        /// How far beyond it (rad, or m).
        excess_rad: f64,
    },
    /// Every pose can be reached, but not without a joint jumping in between.
    #[error(
        "before point {point} of {points} (t = {time_secs:.1} s) {joint} would have to jump by \
         {step_rad:.2} rad, where {limit_rad:.2} rad are allowed; move the path, or give it more \
         time"
    )]
    JointJump {
        /// The point after the jump, from 1.
        point: usize,
        /// Number of points.
        points: usize,
        /// Time of the point (s).
        time_secs: f64,
        /// The joint that jumps furthest, measured by its limit.
        joint: String,
        /// How far it moves (rad, or m).
        step_rad: f64,
        /// How far it may move in that time with the largest slowdown (rad, or m).
        limit_rad: f64,
    },
    /// Every pose can be reached, but not without the arm touching itself or the table.
    #[error(
        "at point {point} of {points} (t = {time_secs:.1} s) {contact} would {}; the limit is \
         {:.1} cm",
        apart(*distance_m), 100.0 * limit_m
    )]
    Collision {
        /// The first point that fails, from 1.
        point: usize,
        /// Number of points.
        points: usize,
        /// Time of the point (s).
        time_secs: f64,
        /// What comes too near to what.
        contact: Contact,
        /// Their distance (m), negative where they overlap.
        distance_m: f64,
        /// Smallest distance that must be left (m).
        limit_m: f64,
    },
    /// No way was found, and nobody asked why.
    #[error(
        "no way past point {point} of {points} (t = {time_secs:.1} s) was found from {starts} starts"
    )]
    GaveUp {
        /// The first point that no attempt reached, from 1.
        point: usize,
        /// Number of points.
        points: usize,
        /// Time of the point (s).
        time_secs: f64,
        /// Start configurations that were tried.
        starts: usize,
    },
    /// The path is empty.
    #[error("the path has no points; it needs at least 1")]
    Empty,
    /// A pose, the time step or the start configuration is not a usable number.
    #[error("{what} is not finite, or not above 0 where it must be")]
    NotFinite {
        /// What it is: `pose 3`, `the time step`.
        what: String,
    },
    /// The start configuration is one of another arm.
    #[error("the start has {found} joint positions; the arm has {expected} joints")]
    StartLength {
        /// Joints of the arm.
        expected: usize,
        /// Positions in the start.
        found: usize,
    },
}

fn apart(distance_m: f64) -> String {
    match distance_m {
        d if d < 0.0 => format!("overlap by {:.1} cm", -100.0 * d),
        d => format!("be {:.1} cm apart", 100.0 * d),
    }
}

fn out_of_reach(position_error_m: f64, orientation_error_rad: f64) -> String {
    let centimetres = 100.0 * position_error_m;
    let degrees = orientation_error_rad.to_degrees();
    if degrees < 1.0 {
        format!("{centimetres:.1} cm")
    } else if centimetres < 0.1 {
        format!("{degrees:.0} degrees")
    } else {
        format!("{centimetres:.1} cm and {degrees:.0} degrees")
    }
}

/// Joint positions whose tip goes through `base_from_tip`, the poses `step_secs` apart.
///
/// The result depends only on the arguments and on the state of `rng`.
///
/// # Errors
/// Where and by how much the path fails; a path, time step or start that is not usable.
pub fn follow<R: Rng + ?Sized>(
    chain: &Chain,
    base_from_tip: &[Isometry3<f64>],
    step_secs: f64,
    options: &FollowOptions<'_>,
    rng: &mut R,
) -> Result<Followed, FollowError> {
    check(chain, base_from_tip, step_secs, options)?;
    let path: Vec<Frame> = base_from_tip.iter().map(Frame::from).collect();
    let mut follower = Follower::new(chain, &path, step_secs, options);
    follower.search(rng);
    match follower.best {
        Some(best) => Ok(best.followed(chain.dof())),
        None if options.diagnose => Err(follower.diagnosis(rng)),
        None => Err(follower.gave_up()),
    }
}

fn check(
    chain: &Chain,
    base_from_tip: &[Isometry3<f64>],
    step_secs: f64,
    options: &FollowOptions<'_>,
) -> Result<(), FollowError> {
    let not_finite = |what: String| Err(FollowError::NotFinite { what });
    if base_from_tip.is_empty() {
        return Err(FollowError::Empty);
    }
    if !(step_secs.is_finite() && step_secs > 0.0) {
        return not_finite("the time step".into());
    }
    for (i, pose) in base_from_tip.iter().enumerate() {
        let finite = |v: &[f64]| v.iter().all(|x| x.is_finite());
        if !finite(pose.translation.vector.as_slice()) || !finite(pose.rotation.coords.as_slice()) {
            return not_finite(format!("pose {}", i + 1));
        }
    }
    for start in options.start.iter().map(Vec::as_slice).chain(options.postures.iter().copied()) {
        if start.len() != chain.dof() {
            return Err(FollowError::StartLength { expected: chain.dof(), found: start.len() });
        }
        if let Some(joint) = start.iter().position(|v| !v.is_finite()) {
            return not_finite(format!("the start of {}", chain.joints()[joint].name));
        }
    }
    Ok(())
}

/// A complete path and how good it is.
#[derive(Debug, Clone)]
struct Candidate {
    /// `[points, joints]`, row by row.
    positions: Vec<f64>,
    position_error_m: f64,
    orientation_error_rad: f64,
    margin: f64,
    speed: f64,
}

impl Candidate {
    /// 1 for a comfortable path; half of it is lost at a limit, and a faster one loses as much as
    /// it has to be slowed down.
    fn score(&self, options: &FollowOptions<'_>) -> f64 {
        let margin = (self.margin / options.good_margin_rad).clamp(0.0, 1.0);
        0.5 * (1.0 + margin) / self.speed.max(1.0)
    }

    fn restart(&mut self) {
        self.position_error_m = 0.0;
        self.orientation_error_rad = 0.0;
        self.margin = f64::INFINITY;
        self.speed = 0.0;
    }

    fn followed(self, dof: usize) -> Followed {
        Followed {
            positions: self.positions.chunks_exact(dof).map(<[f64]>::to_vec).collect(),
            position_error_m: self.position_error_m,
            orientation_error_rad: self.orientation_error_rad,
            joint_margin_rad: self.margin,
            speed: self.speed,
        }
    }
}

/// How a start configuration is used. Centred ones make better paths, but they gather in a few
/// places; the others reach paths that have no room for centring.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Manner {
    /// The freedom of the first pose, and of every pose after it, goes into staying off the limits.
    Centred,
    /// The freedom is left alone.
    AsItStands,
}

/// A joint's motion between two points.
#[derive(Debug, Clone, Copy)]
struct Step {
    joint: usize,
    /// How far it moves (rad, or m).
    step: f64,
    /// The same as a share of what it may.
    share: f64,
}

/// A joint outside its limits.
#[derive(Debug, Clone, Copy)]
struct Beyond {
    joint: usize,
    limit: f64,
    excess: f64,
}

/// Why one attempt ended at a point.
#[derive(Debug, Clone, Copy)]
enum Obstacle {
    NotReached,
    Jump(Step),
    Touches(f64, Who),
}

/// Where an attempt ended.
#[derive(Debug, Clone)]
struct Failure {
    /// The point that was not reached, from 0.
    index: usize,
    obstacle: Obstacle,
    /// The configuration at the point before (at the point itself for the first).
    q: Vec<f64>,
}

struct Follower<'a> {
    chain: &'a Chain,
    path: &'a [Frame],
    options: &'a FollowOptions<'a>,
    step_secs: f64,
    /// How far each joint may move in one step.
    bounds: Vec<f64>,
    /// How often a step may be halved.
    halvings: u32,
    /// Share of the way to the middle in one step.
    pull: f64,
    solver: Solver<'a>,
    posed: Option<(&'a Hull, Posed)>,
    before: Vec<f64>,
    starts: Vec<Vec<f64>>,
    attempt: Candidate,
    best: Option<Candidate>,
    furthest: Option<Failure>,
}

impl<'a> Follower<'a> {
    fn new(
        chain: &'a Chain,
        path: &'a [Frame],
        step_secs: f64,
        options: &'a FollowOptions<'a>,
    ) -> Self {
        let bound = |joint: &Joint| (joint.velocity * step_secs).min(LARGEST_STEP);
        Self {
            chain,
            path,
            options,
            step_secs,
            bounds: chain.joints().iter().map(bound).collect(),
            halvings: options.max_slowdown.clamp(1.0, 1024.0).log2().ceil() as u32,
            pull: 1.0 - (-step_secs / options.centring_secs).exp(),
            solver: Solver::inside(chain, options.limit_margin),
            posed: options.hull.map(|hull| (hull, Posed::new(hull))),
            before: vec![0.0; chain.dof()],
            starts: Vec::new(),
            attempt: Candidate {
                positions: vec![0.0; path.len() * chain.dof()],
                position_error_m: 0.0,
                orientation_error_rad: 0.0,
                margin: 0.0,
                speed: 0.0,
            },
            best: None,
            furthest: None,
        }
    }

    fn search<R: Rng + ?Sized>(&mut self, rng: &mut R) {
        if let Some(start) = &self.options.start {
            self.solver.start(start);
            if self.attempt(Manner::AsItStands) {
                return;
            }
        }
        let options = self.options;
        for posture in &options.postures {
            self.solver.start(posture);
            if self.attempt(Manner::AsItStands) && self.is_comfortable() {
                return;
            }
        }
        let mut left = options.starts.max(1);
        let mut probed = options.diagnose;
        let mut manner = Manner::Centred;
        self.solver.start(&self.chain.middle());
        while left > 0 {
            left -= 1;
            if self.attempt(manner) && self.is_comfortable() {
                return;
            }
            if self.best.is_some() {
                left = left.min(options.further_starts);
            } else if !probed {
                probed = true;
                if self.is_out_of_reach(rng) {
                    return;
                }
            }
            self.solver.start_anywhere(rng);
            manner = match manner {
                Manner::Centred => Manner::AsItStands,
                Manner::AsItStands => Manner::Centred,
            };
        }
    }

    /// Whether the best path so far leaves nothing to wish for.
    fn is_comfortable(&self) -> bool {
        self.best.as_ref().is_some_and(|best| best.score(self.options) >= 1.0)
    }

    /// Follows the path from where the solver stands; whether the path is complete.
    fn attempt(&mut self, manner: Manner) -> bool {
        let first = &self.path[0];
        let mut residual = self.solver.descend(first);
        let mut pull = 0.0;
        if manner == Manner::Centred && residual.within(&self.options.tolerance) {
            pull = self.pull;
            for _ in 0..SETTLING_STEPS {
                residual = self.solver.track(first, SETTLING_PULL);
            }
        }
        if !residual.within(&self.options.tolerance) {
            self.fail(0, Obstacle::NotReached);
            return false;
        }
        let near = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < SAME_START);
        if self.starts.iter().any(|s| near(s, &self.solver.q)) {
            return false;
        }
        self.starts.push(self.solver.q.clone());
        if let Some(obstacle) = self.touches() {
            self.fail(0, obstacle);
            return false;
        }

        self.attempt.restart();
        self.record(0, &residual);
        for index in 1..self.path.len() {
            let (from, to) = (self.path[index - 1], self.path[index]);
            let residual = self.advance(&from, &to, self.halvings, pull);
            match residual.and_then(|residual| self.touches().map_or(Ok(residual), Err)) {
                Ok(residual) => self.record(index, &residual),
                Err(obstacle) => {
                    self.fail(index, obstacle);
                    return false;
                }
            }
        }
        match &mut self.best {
            Some(best) if best.score(self.options) >= self.attempt.score(self.options) => {}
            Some(best) => std::mem::swap(best, &mut self.attempt),
            None => self.best = Some(self.attempt.clone()),
        }
        true
    }

    /// What comes too near to what where the solver stands.
    fn touches(&mut self) -> Option<Obstacle> {
        let (hull, posed) = self.posed.as_mut()?;
        let within = self.options.clearance_m;
        let (distance, who) = posed.nearest(hull, self.chain, &self.solver.q, within)?;
        Some(Obstacle::Touches(distance, who))
    }

    /// Goes from one pose to the next without a jump.
    fn advance(
        &mut self,
        from: &Frame,
        to: &Frame,
        halvings: u32,
        pull: f64,
    ) -> Result<Residual, Obstacle> {
        self.before.copy_from_slice(&self.solver.q);
        let residual = self.solver.track(to, pull);
        let reached = residual.within(&self.options.tolerance);
        let step = self.furthest_step(&self.before, &self.solver.q);
        if reached && step.share <= 1.0 {
            return Ok(residual);
        }
        self.solver.start(&self.before);
        if halvings == 0 {
            return Err(if reached { Obstacle::Jump(step) } else { Obstacle::NotReached });
        }
        let half_way = half_way(from, to);
        self.advance(from, &half_way, halvings - 1, 0.5 * pull)?;
        self.advance(&half_way, to, halvings - 1, 0.5 * pull)
    }

    /// The joint that moves furthest, measured by what it may move.
    fn furthest_step(&self, before: &[f64], after: &[f64]) -> Step {
        let steps = before.iter().zip(after).zip(&self.bounds).enumerate();
        steps
            .map(|(joint, ((before, after), bound))| {
                let step = (after - before).abs();
                Step { joint, step, share: step / bound }
            })
            .fold(Step { joint: 0, step: 0.0, share: 0.0 }, |furthest, step| {
                if step.share > furthest.share { step } else { furthest }
            })
    }

    fn record(&mut self, index: usize, residual: &Residual) {
        let dof = self.chain.dof();
        let attempt = &mut self.attempt;
        attempt.position_error_m = attempt.position_error_m.max(residual.position_m());
        attempt.orientation_error_rad =
            attempt.orientation_error_rad.max(residual.orientation_rad());
        attempt.margin = attempt.margin.min(self.chain.margin(&self.solver.q));
        let row = index * dof;
        attempt.positions[row..row + dof].copy_from_slice(&self.solver.q);
        if index > 0 {
            for (joint, limits) in self.chain.joints().iter().enumerate() {
                let step = self.solver.q[joint] - attempt.positions[row - dof + joint];
                attempt.speed = attempt.speed.max(step.abs() / (limits.velocity * self.step_secs));
            }
        }
    }

    fn fail(&mut self, index: usize, obstacle: Obstacle) {
        if self.furthest.as_ref().is_none_or(|f| index > f.index) {
            self.furthest = Some(Failure { index, obstacle, q: self.solver.q.clone() });
        }
    }

    fn gave_up(&self) -> FollowError {
        let index = self.furthest.as_ref().map_or(0, |failure| failure.index);
        FollowError::GaveUp {
            point: index + 1,
            points: self.path.len(),
            time_secs: self.time_secs(index),
            starts: self.options.starts,
        }
    }

    /// Why the path cannot be followed, once every start has failed: the first pose from there on
    /// that the arm cannot take at all, or else the obstacle that the furthest attempt met.
    fn diagnosis<R: Rng + ?Sized>(&mut self, rng: &mut R) -> FollowError {
        let Failure { index, obstacle, q } =
            self.furthest.take().expect("an attempt without a path has failed somewhere");
        let mut arrival = None;
        self.solver.start(&q);
        for later in index..self.path.len() {
            match self.reach(later, REACH_RESTARTS, rng) {
                Ok(()) => arrival = arrival.or_else(|| Some(self.solver.q.clone())),
                Err(residual) => return self.out_of_reach(later, &residual, rng),
            }
        }
        let step = match (obstacle, arrival) {
            (Obstacle::Jump(step), _) => step,
            (Obstacle::Touches(distance_m, who), _) => {
                let hull = self.options.hull.expect("only a hull touches");
                return FollowError::Collision {
                    point: index + 1,
                    points: self.path.len(),
                    time_secs: self.time_secs(index),
                    contact: hull.contact(who),
                    distance_m,
                    limit_m: self.options.clearance_m,
                };
            }
            (Obstacle::NotReached, arrival) => {
                // The arm got stuck: at a limit, or where its branch of solutions ends.
                let mut free = Solver::without_limits(self.chain);
                free.start(&q);
                let reached = free.descend(&self.path[index]).within(&self.options.tolerance);
                if let (true, Some(beyond)) = (reached, self.beyond_limit(&free.q)) {
                    return self.joint_limit(index, beyond);
                }
                self.furthest_step(&q, &arrival.expect("the pose was reached from elsewhere"))
            }
        };
        FollowError::JointJump {
            point: index + 1,
            points: self.path.len(),
            time_secs: self.time_secs(index),
            joint: self.chain.joints()[step.joint].name.clone(),
            step_rad: step.step,
            limit_rad: self.bounds[step.joint],
        }
    }

    /// Whether a pose from where all attempts have ended so far seems to be one that the arm can't take: then more
    /// attempts are in vain.
    fn is_out_of_reach<R: Rng + ?Sized>(&mut self, rng: &mut R) -> bool {
        let ended = match (&self.best, &self.furthest) {
            (None, Some(Failure { index, obstacle: Obstacle::NotReached, .. })) => *index,
            _ => return false,
        };
        let mut probes = (ended..self.path.len()).step_by(PROBE_STEP).take(PROBES);
        probes.any(|index| self.reach(index, PROBE_RESTARTS, rng).is_err())
    }

    /// Brings the solver to a pose, however far the joints have to move; or says how near it came,
    /// and stands there.
    fn reach<R: Rng + ?Sized>(
        &mut self,
        index: usize,
        restarts: usize,
        rng: &mut R,
    ) -> Result<(), Residual> {
        let mut nearest: Option<(Residual, Vec<f64>)> = None;
        for _ in 0..=restarts {
            let residual = self.solver.descend(&self.path[index]);
            if residual.within(&self.options.tolerance) {
                return Ok(());
            }
            if nearest.as_ref().is_none_or(|(n, _)| residual.squared() < n.squared()) {
                nearest = Some((residual, self.solver.q.clone()));
            }
            self.solver.start_anywhere(rng);
        }
        let (residual, q) = nearest.expect("at least one descent was made");
        self.solver.start(&q);
        Err(residual)
    }

    /// The error for a pose that the arm cannot take, the solver standing at the nearest.
    fn out_of_reach<R: Rng + ?Sized>(
        &self,
        index: usize,
        residual: &Residual,
        rng: &mut R,
    ) -> FollowError {
        // Is it the limits? Then the joint that is least beyond its own is to blame.
        let mut free = Solver::without_limits(self.chain);
        free.start(&self.solver.q);
        let mut least: Option<Beyond> = None;
        for _ in 0..REACH_RESTARTS {
            if free.descend(&self.path[index]).within(&self.options.tolerance) {
                let beyond = self.beyond_limit(&free.q);
                if let Some(beyond) = beyond
                    && least.is_none_or(|least| beyond.excess < least.excess)
                {
                    least = Some(beyond);
                }
            }
            free.start_anywhere(rng);
        }
        match least {
            Some(beyond) => self.joint_limit(index, beyond),
            None => FollowError::Unreachable {
                point: index + 1,
                points: self.path.len(),
                time_secs: self.time_secs(index),
                tip_frame: self.chain.tip_frame().into(),
                position_error_m: residual.position_m(),
                orientation_error_rad: residual.orientation_rad(),
            },
        }
    }

    /// The joint furthest beyond a limit, where a turning joint may be whole turns away.
    fn beyond_limit(&self, q: &[f64]) -> Option<Beyond> {
        let mut furthest: Option<Beyond> = None;
        for (joint, (limits, &value)) in self.chain.joints().iter().zip(q).enumerate() {
            let value = match limits.kind {
                JointKind::Revolute => value - TAU * ((value - limits.middle()) / TAU).round(),
                JointKind::Continuous | JointKind::Prismatic => value,
            };
            let (lower, upper) = (self.solver.lower[joint], self.solver.upper[joint]);
            let excess = (value - upper).max(lower - value);
            if excess > 0.0 && furthest.is_none_or(|f| excess > f.excess) {
                let limit = if value > upper { upper } else { lower };
                furthest = Some(Beyond { joint, limit, excess });
            }
        }
        furthest
    }

    fn joint_limit(&self, index: usize, beyond: Beyond) -> FollowError {
        FollowError::JointLimit {
            point: index + 1,
            points: self.path.len(),
            time_secs: self.time_secs(index),
            joint: self.chain.joints()[beyond.joint].name.clone(),
            limit: beyond.limit,
            excess_rad: beyond.excess,
        }
    }

    fn time_secs(&self, index: usize) -> f64 {
        (index + 1) as f64 * self.step_secs
    }
}

/// The pose half way between two.
fn half_way(from: &Frame, to: &Frame) -> Frame {
    let turn = rotation_vector(&(to.rotation * from.rotation.transpose()));
    Frame {
        rotation: Rotation3::new(0.5 * turn).into_inner() * from.rotation,
        position: 0.5 * (from.position + to.position),
    }
}
