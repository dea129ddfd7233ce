//! From a task and a manner to a motion that may leave: decode, aim, follow with the arm, time,
//! and check what the arm will do. Nothing here draws at random.

use std::f64::consts::PI;

use nalgebra::Isometry3;
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;

use crate::demonstrations::{TaskMeasureError, Violation};
use crate::kinematics::Chain;
use crate::kinematics::following::{FollowError, FollowOptions, follow};
use crate::kinematics::inverse::{InverseOptions, solve};
use crate::kinematics::timing::{Overshoot, Scales, Timed, eased, time};
use crate::parameters::{MannerParameters, TaskParameters};
use crate::pose::position_stddev;
use crate::primitive::Generated;
use crate::serving::approach::{touching, way_there};
use crate::serving::{ErrorCode, GivenLocation, Refusal, Robot, Sample, ServedModel};
use crate::trajectory::{EndEffectorTrajectory, JointTrajectory, Motion};

/// Decodings beyond the first with which a motion is aimed at its task.
const AIM_ROUNDS: usize = 3;
/// Share of the tolerance within which a motion need not be aimed better.
const AIM_SHARE: f64 = 0.05;
/// Points of a motion at a rate that is asked for, at most.
pub(super) const MOST_POINTS: f64 = 5000.0;
/// How often a motion is made anew until it has the points of its rate, give or take one in so many.
const RATE_ROUNDS: usize = 3;
const RATE_SHARE: usize = 50;
/// Largest factor by which a motion is slowed down beyond what the velocity scale alone asks for.
const MOST_SLOWDOWN: f64 = 4.0;
/// A motion whose ends are faster than rest gathers and loses speed at these rates of the tip.
const EASE_M_PER_S2: f64 = 0.5;
const EASE_RAD_PER_S2: f64 = 1.5;
/// The longest that takes at either end, as a share of the motion.
const MOST_EASE: f64 = 0.1;
/// How far inside its limits each joint is kept at the points (rad or m), so that it is inside between them.
const LIMIT_MARGIN: f64 = 0.01;
/// Where a quick look for a way begins: at postures of demonstrations, and then in so many places, or in more where
/// no posture is known; and where it begins after the first way that was found.
const QUICK_POSTURES: usize = 3;
const QUICK_STARTS: usize = 1;
const QUICK_STARTS_WITHOUT_POSTURES: usize = 8;
const QUICK_FURTHER_STARTS: usize = 1;
/// Configurations of one pose that are looked at before it counts as one that can't be taken.
const FEASIBLE_STARTS: usize = 50;
/// Seed of the inverse kinematics' start configurations. It is fixed, so that one task in one
/// manner is always the same motion.
const START_SEED: u64 = 1;

/// What every try of a request has in common.
#[derive(Debug, Clone)]
pub(super) struct Order {
    pub(super) w: TaskParameters,
    pub(super) in_distribution_task: f64,
    pub(super) tolerance_m: f64,
    pub(super) scales: Scales,
    /// How many times as fast as it was learned.
    pub(super) speed: f64,
    pub(super) rate_hz: Option<f64>,
    pub(super) start: Start,
    pub(super) warnings: Vec<String>,
}

/// Where the arm is before the motion.
#[derive(Debug, Clone)]
pub(super) enum Start {
    /// It is brought from here to the first point.
    Approach(Vec<f64>),
    /// It has to be at the first point, within a tolerance (rad or m).
    Near(Vec<f64>, f64),
    /// Nobody asks.
    Anywhere,
}

impl Start {
    fn positions(&self) -> Option<&Vec<f64>> {
        match self {
            Self::Approach(q) | Self::Near(q, _) => Some(q),
            Self::Anywhere => None,
        }
    }
}

/// How hard a way is looked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Effort {
    /// Where there are others to try.
    Quick,
    /// With all starts; and where there is no way, it is found out why.
    Thorough,
}

/// A try that may not leave.
#[derive(Debug)]
pub(super) struct Failure {
    pub(super) refusal: Refusal,
    /// How many stages it passed.
    stage: u8,
    /// By how much it failed the next one; 0 would have passed.
    excess: f64,
}

impl Failure {
    /// How near it came: how many stages it passed, and by how little it failed the next.
    pub(super) fn nearness(&self) -> (u8, f64) {
        (self.stage, -self.excess)
    }

    /// The one that came nearer to passing.
    pub(super) fn nearer(best: Option<Self>, other: Self) -> Self {
        match best {
            Some(best) if best.nearness() >= other.nearness() => best,
            _ => other,
        }
    }
}

/// The arm along a path, in time.
struct Executed {
    /// In the learned timing.
    motion: Motion,
    poses: Vec<Isometry3<f64>>,
    timed: Timed,
    position_error_m: f64,
    orientation_error_rad: f64,
}

impl Order {
    /// The motion of task and manner `h`, if it passes every check. `seed` and `tries` of the
    /// sample are left for the caller.
    pub(super) fn carry_out(
        &self,
        model: &ServedModel,
        robot: &Robot,
        h: &MannerParameters,
        effort: Effort,
    ) -> Result<Sample, Failure> {
        let mut warnings = self.warnings.clone();
        let generated = self.aimed(model, h, &mut warnings);
        let stddev = generated.stddev.clone();
        let decoded = generated.motion(model.duration_secs);
        let (mut motion, mut shares) = at_rest(model, &decoded, decoded.states.steps());
        let mut executed = self.executed(model, robot, &motion, effort, self.start.positions())?;
        if let Some(rate_hz) = self.rate_hz {
            // The rate counts in the time that the motion takes once it is slowed down, which depends on its points.
            for _ in 0..RATE_ROUNDS {
                let duration = motion.duration_secs / self.speed * executed.timed.slowdown;
                let points = self.points(rate_hz, duration)?;
                if points.abs_diff(motion.states.steps()) * RATE_SHARE <= points {
                    break;
                }
                (motion, shares) = at_rest(model, &decoded, points);
                // The same way as before, and so about as fast.
                let first = executed.timed.trajectory.positions[0].clone();
                executed = self.executed(model, robot, &motion, effort, Some(&first))?;
            }
        }
        let empirical = self.check_task(model, &executed)?;
        self.check_validity(model, &executed)?;
        let Executed { poses, timed, position_error_m, orientation_error_rad, .. } = executed;
        let Timed { trajectory: primitive, slowdown } = timed;

        let approach = match &self.start {
            Start::Approach(from) => way_there(robot, from, &primitive, self.scales)
                .map_err(|refusal| Failure { refusal, stage: 4, excess: 1.0 })?,
            Start::Near(..) | Start::Anywhere => None,
        };
        let begin = approach.as_ref().map_or(0, |approach| approach.times_secs.len() - 1);
        let whole = match approach {
            Some(approach) => approach.followed_by(primitive),
            None => primitive,
        };
        let min_clearance = self.check_clearance(robot, &whole)?;
        let before = whole.positions[..begin].iter().map(|q| robot.chain.forward(q));
        let stddev = stddev.at(shares.into_iter());
        let margins = whole.positions.iter().map(|q| robot.chain.margin(q));
        Ok(Sample {
            end_effector_trajectory: EndEffectorTrajectory {
                times_secs: whole.times_secs.clone(),
                base_from_tip: before.chain(poses).collect(),
            },
            primitive_start_index: begin as u32,
            manner_names: model.primitive.manner_space().names(),
            manner_values: h.values().to_vec(),
            task_error: model.space().distance(&self.w, &empirical),
            task: named(model, &self.w),
            empirical_task: named(model, &empirical),
            position_error: position_error_m,
            orientation_error: orientation_error_rad,
            joint_margin: margins.fold(f64::INFINITY, f64::min),
            min_clearance,
            slowdown,
            in_distribution_task: self.in_distribution_task,
            in_distribution_manner: model.familiarity.manner(h.values()),
            // An approach is not learned, so there is nothing uncertain about it.
            position_stddev: std::iter::repeat_n(0.0, begin)
                .chain(stddev.states().map(position_stddev))
                .collect(),
            joint_trajectory: whole,
            seed: 0,
            tries: 0,
            warnings,
        })
    }

    /// How many points a motion of a duration has at a rate.
    fn points(&self, rate_hz: f64, duration_secs: f64) -> Result<usize, Failure> {
        let points = duration_secs * rate_hz;
        if points <= MOST_POINTS {
            return Ok(points.round().max(1.0) as usize + 1);
        }
        Err(Failure {
            refusal: Refusal::new(
                ErrorCode::BadRequest,
                format!(
                    "rate_hz = {rate_hz} makes {points:.0} points of a motion that takes {duration_secs:.1} s; at \
                     most {MOST_POINTS} are served; choose a lower rate"
                ),
            ),
            stage: 1,
            excess: points / MOST_POINTS,
        })
    }

    /// The poses of the tip that the motion of a manner asks for.
    pub(super) fn wished(&self, model: &ServedModel, h: &MannerParameters) -> Vec<Isometry3<f64>> {
        let decoded = self.aimed(model, h, &mut Vec::new()).motion(model.duration_secs);
        let (motion, _) = at_rest(model, &decoded, decoded.states.steps());
        model.frame.poses(&motion.states)
    }

    /// The decoder's motion, aimed: where `G` of the motion misses the task, the decoder is asked
    /// for a task moved by the miss the other way, and the motion that misses least is kept.
    ///
    /// A decoder trained well maps tasks to motions almost as a translation, so each round divides
    /// the miss several times; the check of the executed motion stays what decides.
    fn aimed(
        &self,
        model: &ServedModel,
        h: &MannerParameters,
        warnings: &mut Vec<String>,
    ) -> Generated {
        let space = model.space();
        let mut asked = self.w.clone();
        let mut generated = model.primitive.decode(&asked, h);
        let Ok(mut reached) = empirical(model, &generated) else {
            return generated;
        };
        for _ in 0..AIM_ROUNDS {
            let miss = space.distance(&self.w, &reached);
            if miss <= AIM_SHARE * self.tolerance_m {
                break;
            }
            let moved = asked.values().iter().zip(self.w.values()).zip(reached.values());
            let moved = moved.map(|((asked, w), reached)| asked + w - reached).collect();
            let Ok(candidate) = TaskParameters::new(space, moved) else { break };
            let next = model.primitive.decode(&candidate, h);
            match empirical(model, &next) {
                Ok(there) if space.distance(&self.w, &there) < miss => {
                    (asked, generated, reached) = (candidate, next, there);
                }
                _ => break,
            }
        }
        let moved = space.distance(&self.w, &asked);
        if moved > self.tolerance_m {
            warnings.push(format!(
                "the decoder was asked for a task {moved:.3} {} beside this one to meet it",
                space.unit
            ));
        }
        generated
    }

    /// What the arm does to follow the motion, from a configuration near to one if that is possible.
    fn executed(
        &self,
        model: &ServedModel,
        robot: &Robot,
        motion: &Motion,
        effort: Effort,
        near: Option<&Vec<f64>>,
    ) -> Result<Executed, Failure> {
        let chain = &robot.chain;
        let step_secs = motion.step_secs();
        let wished = model.frame.poses(&motion.states);
        let mut postures = model.robot.postures_near(chain, &wished[0]);
        postures.truncate(match effort {
            Effort::Quick => QUICK_POSTURES,
            Effort::Thorough => usize::MAX,
        });
        let options = FollowOptions {
            postures,
            hull: Some(&robot.hull),
            clearance_m: robot.clearance_m,
            start: near.cloned(),
            limit_margin: LIMIT_MARGIN,
            ..match effort {
                Effort::Quick => FollowOptions {
                    starts: match model.robot.postures.is_empty() {
                        true => QUICK_STARTS_WITHOUT_POSTURES,
                        false => QUICK_STARTS,
                    },
                    further_starts: QUICK_FURTHER_STARTS,
                    diagnose: false,
                    ..FollowOptions::default()
                },
                Effort::Thorough => FollowOptions::default(),
            }
        };
        let mut rng = ChaCha8Rng::seed_from_u64(START_SEED);
        let followed = follow(chain, &wished, step_secs, &options, &mut rng)
            .map_err(|e| cannot_follow(model, chain, &wished, &self.w, &e))?;
        if let Start::Near(start, tolerance) = &self.start {
            check_start(robot, start, &followed.positions[0], *tolerance)?;
        }
        let timed = time(chain, &followed.positions, step_secs / self.speed, self.scales)
            .map_err(|e| swings(model, &e))?;
        let scale = self.scales.velocity.min(self.scales.acceleration);
        let beyond = timed.slowdown * scale / self.speed.max(1.0);
        if beyond > MOST_SLOWDOWN {
            return Err(Failure {
                refusal: Refusal::new(
                    ErrorCode::TooFast,
                    format!(
                        "the motion would have to be {beyond:.1} times slower for the joints to \
                         keep up, limit {MOST_SLOWDOWN}; try another {}",
                        alternatives(model)
                    ),
                ),
                stage: 1,
                excess: beyond - MOST_SLOWDOWN,
            });
        }
        let poses: Vec<_> = followed.positions.iter().map(|q| chain.forward(q)).collect();
        Ok(Executed {
            motion: Motion {
                states: model.frame.trajectory(&poses),
                duration_secs: motion.duration_secs,
            },
            poses,
            timed,
            position_error_m: followed.position_error_m,
            orientation_error_rad: followed.orientation_error_rad,
        })
    }

    /// The smallest distance between what must stay apart at the points (m), NaN where nothing must; it is
    /// looked at between the points, too, and from the start on.
    fn check_clearance(&self, robot: &Robot, whole: &JointTrajectory) -> Result<f64, Failure> {
        if let Some(nearest) = touching(robot, None, whole) {
            return Err(Failure {
                refusal: Refusal::new(
                    ErrorCode::Collision,
                    format!(
                        "{} would be {:.3} m apart, limit {:.3} m; try another task, or another way in",
                        nearest.contact, nearest.distance_m, robot.clearance_m
                    ),
                ),
                stage: 4,
                excess: robot.clearance_m - nearest.distance_m,
            });
        }
        let points = whole.positions.iter().map(Vec::as_slice);
        let nearest = robot.hull.nearest_of(&robot.chain, points);
        Ok(nearest.map_or(f64::NAN, |nearest| nearest.distance_m))
    }

    /// `G` of the motion as executed, if it is within tolerance of the task.
    fn check_task(
        &self,
        model: &ServedModel,
        executed: &Executed,
    ) -> Result<TaskParameters, Failure> {
        let failure = |message: String, excess| Failure {
            refusal: Refusal::new(ErrorCode::TaskCheckFailed, message),
            stage: 2,
            excess,
        };
        let reached = model.task.empirical_task(&executed.motion).map_err(|e| {
            let another = alternatives(model);
            failure(format!("the motion does not show its task: {e}; try another {another}"), PI)
        })?;
        let space = model.space();
        let error = space.distance(&self.w, &reached);
        if error <= self.tolerance_m {
            return Ok(reached);
        }
        let misses = space.locations().iter().enumerate().map(|(i, location)| {
            let (a, b) = (self.w.location(i), reached.location(i));
            format!("{} {:.3} m", location.name, (a[0] - b[0]).hypot(a[1] - b[1]))
        });
        Err(failure(
            format!(
                "the motion misses its task: {}; task.tolerance_m is {:.3}; try another {} or a \
                 larger tolerance",
                misses.collect::<Vec<_>>().join(", "),
                self.tolerance_m,
                alternatives(model)
            ),
            error - self.tolerance_m,
        ))
    }

    fn check_validity(&self, model: &ServedModel, executed: &Executed) -> Result<(), Failure> {
        // In the learned timing: making it slower on request makes no motion invalid, and speeds only fall. Made
        // faster, it is to keep the bounds of speeds and accelerations as it is executed.
        let mut violations = model.task.violations(&executed.motion);
        let faster = self.speed / executed.timed.slowdown;
        if violations.is_empty() && faster > 1.0 {
            let Motion { states, duration_secs } = executed.motion.clone();
            let motion = Motion { states, duration_secs: duration_secs / faster };
            violations = model.task.violations(&motion);
            violations.retain(Violation::is_rate);
        }
        if violations.is_empty() {
            return Ok(());
        }
        let texts: Vec<_> = violations.iter().map(ToString::to_string).collect();
        Err(Failure {
            refusal: Refusal::new(
                ErrorCode::InvalidMotion,
                format!(
                    "the motion is not a valid one: {}; try another {}",
                    texts.join("; "),
                    alternatives(model)
                ),
            ),
            stage: 3,
            excess: violations.len() as f64,
        })
    }
}

/// Whether each of the poses has a configuration, on its own, that may be taken.
pub(super) fn could_be_followed(robot: &Robot, poses: &[Isometry3<f64>]) -> bool {
    let chain = &robot.chain;
    let mut rng = ChaCha8Rng::seed_from_u64(START_SEED);
    let mut seed = chain.middle();
    poses.iter().all(|pose| {
        (0..FEASIBLE_STARTS).any(|_| {
            let found = solve(chain, pose, &seed, &InverseOptions::default(), &mut rng);
            let Ok(found) = found else { return false };
            let clear = robot.is_clear(&found.positions);
            seed = match clear {
                true => found.positions,
                false => chain.draw(&mut rng),
            };
            clear
        })
    })
}

/// A motion in so many points whose ends are at rest, and the shares of the decoded one at which they are.
fn at_rest(model: &ServedModel, decoded: &Motion, points: usize) -> (Motion, Vec<f64>) {
    let [start, end] = end_times(model, decoded);
    let (shares, duration_secs) = eased(decoded.duration_secs, start, end, points);
    let shares: Vec<_> = shares.collect();
    let states = decoded.states.at(shares.iter().copied());
    (Motion { states, duration_secs }, shares)
}

/// How long a motion takes to gather its speed at the start, and to lose it at the end (s).
fn end_times(model: &ServedModel, motion: &Motion) -> [f64; 2] {
    let (steps, step_secs) = (motion.states.steps(), motion.step_secs());
    [[0, 1], [steps - 2, steps - 1]].map(|pair| {
        let [a, b] = pair.map(|t| model.frame.pose(motion.states.state(t)));
        let speed = (b.translation.vector - a.translation.vector).norm() / step_secs;
        let turning = a.rotation.angle_to(&b.rotation) / step_secs;
        let needed = (speed / EASE_M_PER_S2).max(turning / EASE_RAD_PER_S2);
        needed.min(MOST_EASE * motion.duration_secs)
    })
}

fn check_start(robot: &Robot, start: &[f64], first: &[f64], tolerance: f64) -> Result<(), Failure> {
    let differences = start.iter().zip(first).map(|(a, b)| (a - b).abs());
    let worst = differences.enumerate().max_by(|a, b| a.1.total_cmp(&b.1));
    match worst {
        Some((joint, difference)) if difference > tolerance => Err(Failure {
            refusal: Refusal::new(
                ErrorCode::StartTooFar,
                format!(
                    "{} stands {difference:.3} rad from the first point of the motion ({:.3} rad), limit \
                     {tolerance:.3} rad; move the arm there first, or set start.policy to approach",
                    robot.chain.joints()[joint].name,
                    first[joint],
                ),
            ),
            stage: 1,
            excess: difference,
        }),
        _ => Ok(()),
    }
}

/// A joint that leaves its range between two points.
fn swings(model: &ServedModel, overshoot: &Overshoot) -> Failure {
    let another = alternatives(model);
    Failure {
        refusal: Refusal::new(ErrorCode::JointLimit, format!("{overshoot}; try another {another}")),
        stage: 1,
        excess: (overshoot.position - overshoot.limit).abs(),
    }
}

/// What else may be asked for where a motion is refused.
fn alternatives(model: &ServedModel) -> &'static str {
    match model.primitive.manner_space().dim() {
        0 => "task",
        _ => "manner or task",
    }
}

/// Why the arm can't follow, with the location to move.
fn cannot_follow(
    model: &ServedModel,
    chain: &Chain,
    wished: &[Isometry3<f64>],
    w: &TaskParameters,
    error: &FollowError,
) -> Failure {
    let (code, point) = match *error {
        FollowError::Unreachable { point, .. } | FollowError::GaveUp { point, .. } => {
            (ErrorCode::Unreachable, point)
        }
        FollowError::JointLimit { point, .. } => (ErrorCode::JointLimit, point),
        FollowError::JointJump { point, .. } => (ErrorCode::JointJump, point),
        FollowError::Collision { point, .. } => (ErrorCode::Collision, point),
        // A decoded trajectory is neither empty nor infinite, and a start has the arm's length.
        _ => (ErrorCode::Internal, 1),
    };
    let hint = match code {
        ErrorCode::Unreachable if !matches!(error, FollowError::GaveUp { .. }) => {
            format!("; {}", where_to_move(model, chain, w, wished[point - 1]))
        }
        _ => String::new(),
    };
    Failure {
        refusal: Refusal::new(code, format!("{error}{hint}")),
        stage: 0,
        // The later the point that fails, the nearer the motion came.
        excess: (wished.len() - point) as f64,
    }
}

/// Which location to move, and which way, for the arm to reach a tip that it does not reach.
fn where_to_move(
    model: &ServedModel,
    chain: &Chain,
    w: &TaskParameters,
    tip: Isometry3<f64>,
) -> String {
    let shoulder = chain.joints()[0].parent_from_joint.translation.vector;
    let links = chain.joints()[1..].iter().map(|j| j.parent_from_joint.translation.vector.norm());
    let length = links.sum::<f64>() + chain.last_joint_from_tip().translation.vector.norm();
    let distance = |i: &usize| {
        let [x, y] = w.location(*i);
        (x - shoulder.x).hypot(y - shoulder.y)
    };
    let locations = model.space().locations();
    let by_distance = |a: &usize, b: &usize| distance(a).total_cmp(&distance(b));
    // Out of reach is either too far away or, within half the arm's length, too near.
    let (location, way) = if (tip.translation.vector - shoulder).norm() > 0.5 * length {
        ((0..locations.len()).max_by(by_distance), "towards the base")
    } else {
        ((0..locations.len()).min_by(by_distance), "away from the base")
    };
    location.map_or(String::new(), |i| format!("move {} {way}", locations[i].name))
}

fn empirical(
    model: &ServedModel,
    generated: &Generated,
) -> Result<TaskParameters, TaskMeasureError> {
    model.task.empirical_task(&generated.clone().motion(model.duration_secs))
}

fn named(model: &ServedModel, w: &TaskParameters) -> Vec<GivenLocation> {
    let locations = model.space().locations().iter().enumerate();
    locations.map(|(i, l)| GivenLocation { name: l.name.clone(), xy: w.location(i) }).collect()
}
