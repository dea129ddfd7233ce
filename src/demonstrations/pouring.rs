//! Pouring: what a pour is, where a recording shows one, and what it achieves (the paper's
//! section 5.2).
//!
//! The cup's axis is the tip-frame direction that points up when the cup is grasped, and its tilt
//! the angle between that axis and the vertical. The cup pours while the tilt is above 70 degrees.
//! A demonstration lasts from the gripper closing on the cup to the first tilt below 20 degrees
//! after the pour. Its task parameters are where the tip is on average while it pours, and where
//! it was at the grasp: `w = (x_c, y_c, x_s, y_s)` in the base frame.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use super::Demonstration;
use super::augmentation::Augmentation;
use super::recording::{
    ArmRecording, Exclusion, JointRecording, Reason, RecordingRules, RobotConfig,
};
use super::task::{Factor, Task, TaskMeasureError, TaskSettingError, Violation};
use crate::kinematics::Chain;
use crate::parameters::{Interval, TaskLocation, TaskParameters, TaskSpace};
use crate::pose::{STATE_DIM, StateFrame, tilt, up_in_tip};
use crate::trajectory::{Motion, Trajectory};

/// The pouring task (`config/tasks/pour.toml`).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PouringTask {
    /// Name of the location where the cup pours.
    pub pour_location: String,
    /// Name of the location where the cup is grasped.
    pub source_cup: String,
    /// States of a demonstration, `T`.
    pub steps: usize,
    /// The cup pours while it is tilted further than this.
    pub pour_tilt_deg: f64,
    /// The demonstration ends when the tilt first falls below this after the pour.
    pub end_tilt_deg: f64,
    /// Between two times above `pour_tilt_deg` a tilt below this makes them two pours.
    pub same_pour_tilt_deg: f64,
    /// Roll, pitch and yaw (URDF convention) of the tip orientation whose rotation vector is 0.
    pub reference_rpy_deg: [f64; 3],
    /// What a recording must be like.
    pub recording: RecordingRules,
    /// What a motion must be like to be a valid pour. Of recordings, only those that leave the
    /// workspace are excluded for it.
    pub validity: PourBounds,
    /// How demonstrations are multiplied before training.
    pub augmentation: Augmentation,
}

/// What a motion must be like to be a valid pour. Each bound is that of the simulated
/// demonstrations, widened by about 15 %.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PourBounds {
    /// Time from the grasp to the pour, s.
    pub pour_start_secs: Interval,
    /// Time above the pour's tilt, s.
    pub pour_duration_secs: Interval,
    /// Time of the whole motion, s.
    pub duration_secs: Interval,
    /// Largest tilt that a pour may reach.
    pub max_tilt_deg: f64,
    /// Largest tilt that may be left at the end.
    pub max_end_tilt_deg: f64,
    /// Mean height of the tip above the grasp while pouring, m.
    pub lift_m: Interval,
    /// How far the tip may sink below the grasp.
    pub max_sink_m: f64,
    /// Where the tip may be, m in the base frame.
    pub workspace_x_m: Interval,
    /// See `workspace_x_m`.
    pub workspace_y_m: Interval,
    /// See `workspace_x_m`.
    pub workspace_z_m: Interval,
    /// Largest speed of the tip between two states.
    pub max_speed_m_per_s: f64,
    /// Largest turning speed of the tip between two states.
    pub max_turn_deg_per_s: f64,
    /// Largest acceleration of the tip over three states.
    pub max_acceleration_m_per_s2: f64,
}

impl Default for PourBounds {
    fn default() -> Self {
        Self {
            pour_start_secs: Interval { lower: 2.4, upper: 8.0 },
            pour_duration_secs: Interval { lower: 1.0, upper: 6.9 },
            duration_secs: Interval { lower: 4.4, upper: 13.5 },
            max_tilt_deg: 130.0,
            max_end_tilt_deg: 25.0,
            lift_m: Interval { lower: 0.08, upper: 0.27 },
            max_sink_m: 0.02,
            workspace_x_m: Interval { lower: 0.40, upper: 0.95 },
            workspace_y_m: Interval { lower: -0.20, upper: 0.75 },
            workspace_z_m: Interval { lower: -0.20, upper: 0.40 },
            max_speed_m_per_s: 0.8,
            max_turn_deg_per_s: 180.0,
            max_acceleration_m_per_s2: 3.5,
        }
    }
}

impl Default for PouringTask {
    fn default() -> Self {
        Self {
            pour_location: "pour_location".into(),
            source_cup: "source_cup".into(),
            steps: 100,
            pour_tilt_deg: 70.0,
            end_tilt_deg: 20.0,
            same_pour_tilt_deg: 50.0,
            reference_rpy_deg: [0.0, -90.0, 160.0],
            recording: RecordingRules::default(),
            validity: PourBounds::default(),
            augmentation: Augmentation::default(),
        }
    }
}

/// One time that the cup pours, in fractions of the index of the tilts it was found in.
#[derive(Debug, Clone, PartialEq)]
struct Pour {
    /// The intervals above the pour's tilt; more than one where the tilt wavers about it.
    above: Vec<[f64; 2]>,
}

impl Pour {
    fn start(&self) -> f64 {
        self.above[0][0]
    }

    fn end(&self) -> f64 {
        self.above[self.above.len() - 1][1]
    }
}

/// A pour in a recording, with its times in the recording's.
#[derive(Debug, Clone, PartialEq)]
pub struct Segment {
    /// Name of the arm that poured.
    pub arm: String,
    /// When the gripper has closed on the cup.
    pub grasp_secs: f64,
    /// When the tilt first exceeds the pour's.
    pub pour_start_secs: f64,
    /// When the tilt last falls below the pour's.
    pub pour_end_secs: f64,
    /// When the tilt first falls below the end's.
    pub end_secs: f64,
    /// From the grasp to the end, in the states of the task.
    pub motion: Motion,
}

impl PouringTask {
    /// Checks what no type can say.
    ///
    /// # Errors
    /// The first setting that can't be.
    pub fn check(&self) -> Result<(), TaskSettingError> {
        let error = |name, value: &dyn std::fmt::Display, expected| {
            Err(TaskSettingError { name, value: value.to_string(), expected })
        };
        let Self { pour_location, source_cup, steps, .. } = self;
        if pour_location.is_empty() || source_cup.is_empty() || pour_location == source_cup {
            return error("pour_location", pour_location, "a name, and another than source_cup");
        }
        if !(4..=10_000).contains(steps) {
            return error("steps", steps, "from 4 to 10000");
        }
        let [end, same, pour] = [self.end_tilt_deg, self.same_pour_tilt_deg, self.pour_tilt_deg];
        if !(0.0 < end && end <= same && same <= pour && pour < 180.0) {
            let expected = "below 180, and not below same_pour_tilt_deg, which is not below \
                            end_tilt_deg, which is above 0";
            return error("pour_tilt_deg", &pour, expected);
        }
        if let Some(angle) = self.reference_rpy_deg.iter().find(|a| !a.is_finite()) {
            return error("reference_rpy_deg", angle, "three finite angles");
        }
        for (name, interval) in [
            ("validity.workspace_x_m", self.validity.workspace_x_m),
            ("validity.workspace_y_m", self.validity.workspace_y_m),
        ] {
            let Interval { lower, upper } = interval;
            if !(lower.is_finite() && upper.is_finite() && lower <= upper) {
                let value = format!("[{lower}, {upper}]");
                return error(name, &value, "finite, the lower bound first");
            }
        }
        self.augmentation.check()
    }

    /// Where the states' rotation vectors are measured from.
    pub fn state_frame(&self) -> StateFrame {
        let [roll, pitch, yaw] = self.reference_rpy_deg.map(f64::to_radians);
        StateFrame { reference: UnitQuaternion::from_euler_angles(roll, pitch, yaw) }
    }

    /// The two locations, each with the interval of the workspace.
    pub fn task_space(&self) -> TaskSpace {
        let location = |name: &String| TaskLocation {
            name: name.clone(),
            x: self.validity.workspace_x_m,
            y: self.validity.workspace_y_m,
        };
        let locations = vec![location(&self.pour_location), location(&self.source_cup)];
        TaskSpace::new("m", locations).expect("two names and finite intervals")
    }

    /// The demonstration in a recording: that of the arm that grasps and pours.
    ///
    /// # Errors
    /// Why the recording is left out. Where no arm pours, the reason of the one that moved most.
    ///
    /// # Panics
    /// When an arm of the robot has not as many joints as the chain.
    pub fn demonstration(
        &self,
        recording: &JointRecording,
        robot: &RobotConfig,
        chain: &Chain,
    ) -> Result<(Segment, Demonstration), Exclusion> {
        let rules = &self.recording;
        let duration = recording.duration_secs();
        if duration < rules.min_duration_secs {
            return Err(Exclusion::new(
                Reason::TooShort,
                format!(
                    "{} frames last {duration:.2} s, at least {} s are needed",
                    recording.times_secs.len(),
                    rules.min_duration_secs
                ),
            ));
        }
        if let Some(jump) = recording.largest_jump(rules.jump_window_secs)
            && jump.change_rad > rules.jump_rad
        {
            return Err(Exclusion::new(
                Reason::Jump,
                format!(
                    "{} changes by {:.2} rad within {} s at {:.2} s, limit {} rad",
                    jump.joint,
                    jump.change_rad,
                    rules.jump_window_secs,
                    jump.at_secs,
                    rules.jump_rad
                ),
            ));
        }
        let unreadable =
            |e: super::recording::RecordingError| Exclusion::new(Reason::Unreadable, e.to_string());
        let mut found: Option<Segment> = None;
        let mut others: Vec<(f64, Exclusion)> = Vec::new();
        let mut missing = None;
        for arm in robot.arms() {
            let motion = match arm.motion(recording, chain) {
                Ok(motion) => motion,
                // One arm is enough.
                Err(e) => {
                    missing.get_or_insert(e);
                    continue;
                }
            };
            match (self.segment(&motion), &found) {
                (Ok(segment), None) => found = Some(segment),
                (Ok(segment), Some(other)) => {
                    return Err(Exclusion::new(
                        Reason::SeveralPours,
                        format!("both arms pour, {} and {}", other.arm, segment.arm),
                    ));
                }
                (Err(exclusion), _) => others.push((motion.extent_m(), exclusion)),
            }
        }
        let segment = match found {
            Some(segment) => {
                // The other arm pours too, only not as a demonstration would.
                if let Some((_, other)) =
                    others.into_iter().find(|(_, e)| e.reason > Reason::NoPour)
                {
                    return Err(other);
                }
                segment
            }
            None => {
                // An arm that only drifts, or holds the bowl, did not mean to pour.
                let moved_most = others.into_iter().max_by(|(a, _), (b, _)| a.total_cmp(b));
                return Err(match (moved_most, missing) {
                    (Some((_, exclusion)), _) => exclusion,
                    (None, missing) => unreadable(missing.expect("a robot has an arm")),
                });
            }
        };
        let w = self.empirical_task(&segment.motion).map_err(|e| {
            // Only a pour that falls between two resampled states can get lost here.
            Exclusion::new(Reason::NoPour, e.to_string())
        })?;
        let motion = segment.motion.clone();
        let (id, events) = (recording.id.clone(), self.events(&motion));
        Ok((segment, Demonstration { id, w, motion, events }))
    }

    /// The pour in an arm's motion.
    ///
    /// # Errors
    /// Why there is none, or none that can be used.
    pub fn segment(&self, arm: &ArmRecording) -> Result<Segment, Exclusion> {
        let name = &arm.arm;
        let grasps = self.grasps(arm)?;
        // Only what happens while the gripper holds the cup counts.
        let mut pours = Vec::new();
        let mut largest_deg = 0.0_f64;
        for &[grasp, release] in &grasps {
            let cup_axis = up_in_tip(&arm.base_from_tip[grasp]);
            let tilts = tilts_deg(&arm.base_from_tip[grasp..release], &cup_axis);
            largest_deg = tilts.iter().fold(largest_deg, |a, b| a.max(*b));
            pours.extend(self.pours(&tilts).into_iter().map(|p| (grasp, p, tilts.clone())));
        }
        let time = |index: f64| {
            let i = (index.floor() as usize).min(arm.times_secs.len() - 2);
            let [a, b] = [arm.times_secs[i], arm.times_secs[i + 1]];
            a + (index - i as f64) * (b - a)
        };
        let (grasp, pour, tilts) = match pours.len() {
            0 => {
                return Err(Exclusion::new(
                    Reason::NoPour,
                    format!(
                        "{name} arm: the tilt reaches {largest_deg:.0} of the {} degrees that are \
                         a pour",
                        self.pour_tilt_deg
                    ),
                ));
            }
            1 => pours.remove(0),
            n => {
                let times: Vec<_> = pours
                    .iter()
                    .map(|(g, p, _)| format!("{:.1} s", time(*g as f64 + p.start())))
                    .collect();
                return Err(Exclusion::new(
                    Reason::SeveralPours,
                    format!("{name} arm: {n} pours, at {}; one is needed", times.join(", ")),
                ));
            }
        };
        let after = pour.end().ceil() as usize;
        let end = (after..tilts.len()).find(|&i| tilts[i] < self.end_tilt_deg);
        let Some(end) = end else {
            let least = tilts[after.min(tilts.len() - 1)..].iter().copied().fold(180.0, f64::min);
            return Err(Exclusion::new(
                Reason::Incomplete,
                format!(
                    "{name} arm: after the pour the tilt falls to {least:.0} degrees before the \
                     cup is released or the recording ends, below {} is needed",
                    self.end_tilt_deg
                ),
            ));
        };
        let grasp_secs = arm.times_secs[grasp];
        let end_secs = arm.times_secs[grasp + end];
        let range = grasp..=grasp + end;
        let states = self.state_frame().trajectory(&arm.base_from_tip[range.clone()]);
        let segment = Segment {
            arm: name.clone(),
            grasp_secs,
            pour_start_secs: time(grasp as f64 + pour.start()),
            pour_end_secs: time(grasp as f64 + pour.end()),
            end_secs,
            motion: Motion {
                states: at_equal_times(&states, &arm.times_secs[range], self.steps),
                duration_secs: end_secs - grasp_secs,
            },
        };
        // A motion of another manner than the bounds foresee is still a demonstration; one that
        // leaves the workspace is none of this task.
        let left: Vec<_> = self
            .violations(&segment.motion)
            .iter()
            .filter(|v| v.bound.starts_with("workspace"))
            .map(ToString::to_string)
            .collect();
        if left.is_empty() {
            Ok(segment)
        } else {
            let detail = format!("{name} arm: {}", left.join("; "));
            Err(Exclusion::new(Reason::OutOfRegion, detail))
        }
    }

    /// Frames from a closing of the gripper to the next opening, or to the end.
    fn grasps(&self, arm: &ArmRecording) -> Result<Vec<[usize; 2]>, Exclusion> {
        let rules = &self.recording;
        let holds = rules.holds(&arm.times_secs, &arm.percent_open);
        // A gripper that is closed from the start was not seen to grasp.
        let grasps: Vec<[usize; 2]> =
            holds.iter().filter(|[first, end]| *first > 0 && end - first >= 2).copied().collect();
        if grasps.is_empty() {
            let smallest = arm.percent_open.iter().copied().fold(f64::INFINITY, f64::min);
            let frames = arm.percent_open.len();
            let what = if holds.first().is_some_and(|[first, _]| *first == 0) {
                "the gripper is closed from the first frame and never closes again".to_owned()
            } else {
                format!(
                    "the gripper never closes; it is open by {smallest:.0} % at the least over \
                     {frames} frames, below {} % is closed",
                    rules.closed_below_percent
                )
            };
            return Err(Exclusion::new(Reason::NoGrasp, format!("{} arm: {what}", arm.arm)));
        }
        Ok(grasps)
    }

    /// The times that the cup pours.
    fn pours(&self, tilts_deg: &[f64]) -> Vec<Pour> {
        let mut pours: Vec<Pour> = Vec::new();
        for interval in above(tilts_deg, self.pour_tilt_deg) {
            match pours.last_mut() {
                Some(pour) => {
                    let gap = pour.end().ceil() as usize..=interval[0].floor() as usize;
                    let least = tilts_deg[gap].iter().copied().fold(180.0, f64::min);
                    if least < self.same_pour_tilt_deg {
                        pours.push(Pour { above: vec![interval] });
                    } else {
                        pour.above.push(interval);
                    }
                }
                None => pours.push(Pour { above: vec![interval] }),
            }
        }
        pours
    }

    /// What the measures of a motion have in common.
    fn profile(&self, motion: &Motion) -> Profile {
        let poses = self.state_frame().poses(&motion.states);
        let tilts_deg = tilts_deg(&poses, &up_in_tip(&poses[0]));
        let pours = self.pours(&tilts_deg);
        Profile { poses, tilts_deg, pours }
    }
}

/// A motion's poses, tilts and pours.
struct Profile {
    poses: Vec<Isometry3<f64>>,
    tilts_deg: Vec<f64>,
    pours: Vec<Pour>,
}

impl Profile {
    fn maximum_tilt_deg(&self) -> f64 {
        self.tilts_deg.iter().copied().fold(0.0, f64::max)
    }

    /// Direction of the tip's z axis, which points out of a gripper, over the ground at the grasp;
    /// counted from the base's x axis.
    fn heading_deg(&self) -> f64 {
        let forward = self.poses[0].rotation * Vector3::z();
        forward.y.atan2(forward.x).to_degrees()
    }

    /// Where the cup leans when it is tilted most, as an angle between 0 degrees, where it rolls to the
    /// side of the hand to which it is carried, over 90, where it pitches ahead, to 180, where it rolls
    /// to the other side.
    fn style_deg(&self) -> f64 {
        let most =
            (0..self.poses.len()).max_by(|a, b| self.tilts_deg[*a].total_cmp(&self.tilts_deg[*b]));
        let grasp = &self.poses[0];
        let turn = most.map(|i| self.poses[i].rotation * grasp.rotation.inverse());
        let axis = turn.map_or(Vector3::zeros(), |turn| turn.scaled_axis());
        // Tilted about the hand's heading a cup rolls to the right, about the opposite to the left.
        let from_right = axis.y.atan2(axis.x).to_degrees() - self.heading_deg();
        let ahead = grasp.rotation * Vector3::z();
        let way = self.mean_position_while_pouring() - grasp.translation.vector;
        let to_the_right = way.dot(&ahead.cross(&Vector3::z())) > 0.0;
        let style = if to_the_right { from_right } else { 180.0 - from_right };
        (style + 90.0).rem_euclid(360.0) - 90.0
    }

    /// Steps during which the cup pours.
    fn pour_steps(&self) -> f64 {
        self.pours.iter().flat_map(|p| &p.above).map(|[a, b]| b - a).sum()
    }

    /// Mean position of the tip over the time that the cup pours, moving linearly between states.
    fn mean_position_while_pouring(&self) -> Vector3<f64> {
        let position = |at: f64| {
            let i = (at.floor() as usize).min(self.poses.len() - 2);
            let [a, b] = [i, i + 1].map(|i| self.poses[i].translation.vector);
            a + (b - a) * (at - i as f64)
        };
        let mut sum = Vector3::zeros();
        for &[start, end] in self.pours.iter().flat_map(|p| &p.above) {
            // Between two states the mean of the ends is the mean.
            let mut from = start;
            while from < end {
                let to = (from.floor() + 1.0).min(end);
                sum += (position(from) + position(to)) * (0.5 * (to - from));
                from = to;
            }
        }
        sum / self.pour_steps()
    }
}

impl Task for PouringTask {
    fn name(&self) -> &'static str {
        "pouring"
    }

    fn task_space(&self) -> TaskSpace {
        Self::task_space(self)
    }

    /// `G(x)`: the mean `(x, y)` of the tip over the time above the pour's tilt, and its `(x, y)`
    /// in the first state, which is the grasp.
    fn empirical_task(&self, motion: &Motion) -> Result<TaskParameters, TaskMeasureError> {
        let profile = self.profile(motion);
        if profile.pours.is_empty() || profile.pour_steps() <= 0.0 {
            return Err(TaskMeasureError {
                detail: format!(
                    "the tilt reaches {:.0} of the {} degrees that are a pour",
                    profile.maximum_tilt_deg(),
                    self.pour_tilt_deg
                ),
            });
        }
        let pour = profile.mean_position_while_pouring();
        let source = motion.states.state(0);
        TaskParameters::new(&self.task_space(), vec![pour.x, pour.y, source[0], source[1]])
            .map_err(|e| TaskMeasureError { detail: e.to_string() })
    }

    fn violations(&self, motion: &Motion) -> Vec<Violation> {
        let bounds = &self.validity;
        let profile = self.profile(motion);
        let mut violations = Violations(Vec::new());
        let (Some(first), Some(last)) = (profile.poses.first(), profile.tilts_deg.last()) else {
            return violations.0;
        };
        let step_secs = motion.step_secs();
        let maximum_tilt = profile.maximum_tilt_deg();
        violations.within("duration_secs", "s", motion.duration_secs, bounds.duration_secs);
        if profile.pours.is_empty() {
            violations.at_least("pour_tilt_deg", "degrees", maximum_tilt, self.pour_tilt_deg);
        } else {
            violations.at_most("pours", "times", profile.pours.len() as f64, 1.0);
            let start_secs = profile.pours[0].start() * step_secs;
            violations.within("pour_start_secs", "s", start_secs, bounds.pour_start_secs);
            let pour_secs = profile.pour_steps() * step_secs;
            violations.within("pour_duration_secs", "s", pour_secs, bounds.pour_duration_secs);
            let lift = profile.mean_position_while_pouring().z - first.translation.z;
            violations.within("lift_m", "m", lift, bounds.lift_m);
        }
        violations.at_most("max_tilt_deg", "degrees", maximum_tilt, bounds.max_tilt_deg);
        violations.at_most("max_end_tilt_deg", "degrees", *last, bounds.max_end_tilt_deg);

        let positions: Vec<_> = profile.poses.iter().map(|p| p.translation.vector).collect();
        let [low, high] = [Vector3::inf, Vector3::sup]
            .map(|f| positions.iter().skip(1).fold(positions[0], |a, b| f(&a, b)));
        violations.at_most("max_sink_m", "m", first.translation.z - low.z, bounds.max_sink_m);
        for (i, (name, interval)) in [
            ("workspace_x_m", bounds.workspace_x_m),
            ("workspace_y_m", bounds.workspace_y_m),
            ("workspace_z_m", bounds.workspace_z_m),
        ]
        .into_iter()
        .enumerate()
        {
            violations.at_least(name, "m", low[i], interval.lower);
            violations.at_most(name, "m", high[i], interval.upper);
        }
        let largest = |values: &mut dyn Iterator<Item = f64>| values.fold(0.0, f64::max);
        let speed = largest(&mut positions.windows(2).map(|p| (p[1] - p[0]).norm() / step_secs));
        violations.at_most("max_speed_m_per_s", "m/s", speed, bounds.max_speed_m_per_s);
        let turn = largest(
            &mut profile
                .poses
                .windows(2)
                .map(|p| p[0].rotation.angle_to(&p[1].rotation).to_degrees() / step_secs),
        );
        violations.at_most("max_turn_deg_per_s", "degrees/s", turn, bounds.max_turn_deg_per_s);
        let acceleration = largest(
            &mut positions
                .windows(3)
                .map(|p| (p[2] - 2.0 * p[1] + p[0]).norm() / step_secs.powi(2)),
        );
        let limit = bounds.max_acceleration_m_per_s2;
        violations.at_most("max_acceleration_m_per_s2", "m/s2", acceleration, limit);
        violations.0
    }

    /// When the pour starts, how long it lasts, how far it tilts, how long all of it takes, and how
    /// high above the grasp it is.
    /// The start and the end of the pour.
    fn events(&self, motion: &Motion) -> Vec<f64> {
        let profile = self.profile(motion);
        let last = (motion.states.steps() - 1) as f64;
        let events = profile.pours.first().map(|pour| [pour.start() / last, pour.end() / last]);
        events
            .filter(|[start, end]| 0.0 < *start && start < end && *end < 1.0)
            .into_iter()
            .flatten()
            .collect()
    }

    fn factors(&self, motion: &Motion) -> Vec<Factor> {
        let profile = self.profile(motion);
        let Some(first) = profile.pours.first() else { return Vec::new() };
        let step_secs = motion.step_secs();
        let lift = profile.mean_position_while_pouring().z - profile.poses[0].translation.z;
        let factor = |name, unit, phrase, value| Factor {
            name,
            unit,
            phrase,
            value,
            derived: name == "duration",
        };
        vec![
            factor("pour_start", "s", "until the pour starts", first.start() * step_secs),
            factor("pour_duration", "s", "of pouring", profile.pour_steps() * step_secs),
            factor("maximum_tilt", "degrees", "of largest tilt", profile.maximum_tilt_deg()),
            factor("duration", "s", "from grasp to end", motion.duration_secs),
            factor("lift", "m", "above the grasp while pouring", lift),
            factor(
                "style",
                "degrees",
                "from rolling to where it is carried (0) to pitching ahead (90)",
                profile.style_deg(),
            ),
            factor("heading", "degrees", "of the hand's heading", profile.heading_deg()),
            factor("grasp_height", "m", "of the grasp's height", profile.poses[0].translation.z),
        ]
    }
}

/// Collects the bounds that are broken; a value that is not a number breaks each.
struct Violations(Vec<Violation>);

impl Violations {
    fn at_most(&mut self, bound: &'static str, unit: &'static str, value: f64, limit: f64) {
        if value > limit || value.is_nan() {
            self.0.push(Violation { bound, value, limit, unit });
        }
    }

    fn at_least(&mut self, bound: &'static str, unit: &'static str, value: f64, limit: f64) {
        if value < limit || value.is_nan() {
            self.0.push(Violation { bound, value, limit, unit });
        }
    }

    fn within(&mut self, bound: &'static str, unit: &'static str, value: f64, limits: Interval) {
        self.at_least(bound, unit, value, limits.lower);
        self.at_most(bound, unit, value, limits.upper);
    }
}

/// The tilt of the cup in each pose, degrees.
fn tilts_deg(poses: &[Isometry3<f64>], cup_axis_in_tip: &Vector3<f64>) -> Vec<f64> {
    poses.iter().map(|p| tilt(p, cup_axis_in_tip).to_degrees()).collect()
}

/// Where values, interpolated linearly, are above a threshold: intervals of the fractional index.
fn above(values: &[f64], threshold: f64) -> Vec<[f64; 2]> {
    let mut intervals: Vec<[f64; 2]> = Vec::new();
    let mut start = values.first().filter(|&&v| v > threshold).map(|_| 0.0);
    for (i, pair) in values.windows(2).enumerate() {
        let crossing = || i as f64 + (threshold - pair[0]) / (pair[1] - pair[0]);
        match (start, pair[1] > threshold) {
            (None, true) => start = Some(crossing()),
            (Some(from), false) => {
                intervals.push([from, crossing()]);
                start = None;
            }
            _ => {}
        }
    }
    if let Some(from) = start {
        intervals.push([from, (values.len() - 1) as f64]);
    }
    intervals
}

/// States recorded at `times_secs`, interpolated linearly at `steps` equally spaced times.
fn at_equal_times(states: &Trajectory, times_secs: &[f64], steps: usize) -> Trajectory {
    let (first, last) = (times_secs[0], times_secs[times_secs.len() - 1]);
    let mut values = Vec::with_capacity(steps * STATE_DIM);
    let mut i = 0;
    for k in 0..steps {
        let time = first + (last - first) * k as f64 / (steps - 1) as f64;
        while i + 2 < times_secs.len() && times_secs[i + 1] < time {
            i += 1;
        }
        let share = ((time - times_secs[i]) / (times_secs[i + 1] - times_secs[i])).clamp(0.0, 1.0);
        let pair = states.state(i).iter().zip(states.state(i + 1));
        values.extend(pair.map(|(a, b)| a + share * (b - a)));
    }
    Trajectory::new(STATE_DIM, values).expect("the states are finite and at least two")
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A pour that rolls the hand about its direction (x): tilts are its angles. The hand moves
    /// along y with the step.
    pub(in crate::demonstrations) fn rolled(tilts_deg: &[f64], step_secs: f64) -> Motion {
        let upright = UnitQuaternion::from_euler_angles(0.0, -90_f64.to_radians(), 0.0);
        let pose = |(i, tilt): (usize, &f64)| {
            let roll = UnitQuaternion::from_euler_angles(tilt.to_radians(), 0.0, 0.0);
            let height = 0.15 * (i as f64 / 20.0).min(1.0);
            Isometry3::from_parts([0.6, 0.001 * i as f64, height].into(), roll * upright)
        };
        let poses: Vec<_> = tilts_deg.iter().enumerate().map(pose).collect();
        Motion {
            states: PouringTask::default().state_frame().trajectory(&poses),
            duration_secs: step_secs * (tilts_deg.len() - 1) as f64,
        }
    }

    /// Up to `top` between steps 20 and 40 of 100, down between 60 and 80.
    pub(in crate::demonstrations) fn one_pour(top: f64) -> Vec<f64> {
        let at = |i: f64| ((i - 20.0) / 20.0).min((80.0 - i) / 20.0).clamp(0.0, 1.0);
        (0..100).map(|i| top * at(f64::from(i))).collect()
    }

    fn names(violations: &[Violation]) -> Vec<&'static str> {
        violations.iter().map(|v| v.bound).collect()
    }

    #[test]
    fn the_task_is_the_mean_place_above_70_degrees_and_the_first_place() {
        // Above 70 of 80 degrees from step 37.5 to step 62.5, so the mean is that of step 50.
        let w = PouringTask::default().empirical_task(&rolled(&one_pour(80.0), 0.1)).unwrap();
        for (value, expected) in w.values().iter().zip([0.6, 0.05, 0.6, 0.0]) {
            assert!((value - expected).abs() < 1e-9, "{w:?}");
        }
    }

    #[test]
    fn factors_are_read_at_the_crossings() {
        let factors = PouringTask::default().factors(&rolled(&one_pour(80.0), 0.1));
        let values: Vec<_> = factors.iter().map(|f| f.value).collect();
        assert_eq!(values.len(), 8);
        for (value, expected) in values.iter().zip([3.75, 2.5, 80.0, 9.9, 0.15]) {
            assert!((value - expected).abs() < 1e-9, "{factors:?}");
        }
    }

    #[test]
    fn a_tilt_of_61_degrees_is_no_pour_and_says_so() {
        let motion = rolled(&one_pour(61.0), 0.1);
        let task = PouringTask::default();
        let error = task.empirical_task(&motion).unwrap_err();
        assert_eq!(error.to_string(), "the tilt reaches 61 of the 70 degrees that are a pour");
        assert!(names(&task.violations(&motion)).contains(&"pour_tilt_deg"));
        assert!(task.factors(&motion).is_empty());
    }

    #[test]
    fn bounds_that_break_are_named_with_their_numbers() {
        let task = PouringTask::default();
        let mut tilts = one_pour(90.0);
        assert_eq!(names(&task.violations(&rolled(&tilts, 0.1))), [""; 0]);
        assert_eq!(
            names(&task.violations(&rolled(&tilts, 0.2))),
            ["duration_secs"],
            "a pour of 19.8 s"
        );
        tilts[99] = 30.0;
        let violations = task.violations(&rolled(&tilts, 0.1));
        assert_eq!(names(&violations), ["max_end_tilt_deg", "max_turn_deg_per_s"]);
        assert_eq!(
            violations[0].to_string(),
            "max_end_tilt_deg 30.000 degrees, limit 25.000 degrees"
        );
        let twice: Vec<_> = one_pour(90.0).iter().chain(&one_pour(90.0)).copied().collect();
        assert_eq!(names(&task.violations(&rolled(&twice, 0.065))), ["pours", "pour_start_secs"]);
    }

    /// What an arm with a 100 Hz recording shows: the gripper holds the cup in these frames.
    fn arm(tilts_deg: &[f64], closed: &[[usize; 2]]) -> ArmRecording {
        let motion = rolled(tilts_deg, 0.01);
        let frames = tilts_deg.len();
        let is_closed = |i: usize| closed.iter().any(|c| (c[0]..c[1]).contains(&i));
        let mut base_from_tip = PouringTask::default().state_frame().poses(&motion.states);
        for (i, pose) in base_from_tip.iter_mut().enumerate() {
            let lifted = i as f64 - closed.first().map_or(0.0, |c| c[0] as f64);
            pose.translation.z = 0.15 * (lifted / 150.0).clamp(0.0, 1.0);
            pose.translation.y *= 0.1;
        }
        ArmRecording {
            arm: "left".into(),
            times_secs: (0..frames).map(|i| 0.01 * i as f64).collect(),
            positions: vec![vec![]; frames],
            base_from_tip,
            percent_open: (0..frames).map(|i| if is_closed(i) { 4.0 } else { 97.0 }).collect(),
        }
    }

    /// [`one_pour`] over 1000 frames.
    fn slow_pour(top: f64) -> Vec<f64> {
        let at = |i: f64| ((i - 200.0) / 200.0).min((800.0 - i) / 200.0).clamp(0.0, 1.0);
        (0..1000).map(|i| top * at(f64::from(i))).collect()
    }

    fn excluded(tilts_deg: &[f64], closed: &[[usize; 2]]) -> Exclusion {
        PouringTask::default().segment(&arm(tilts_deg, closed)).unwrap_err()
    }

    #[test]
    fn a_segment_lasts_from_the_closing_to_the_first_tilt_below_20_degrees() {
        let segment =
            PouringTask::default().segment(&arm(&slow_pour(80.0), &[[100, 950]])).unwrap();
        assert!((segment.grasp_secs - 1.0).abs() < 1e-9);
        assert!((segment.pour_start_secs - 3.75).abs() < 1e-6, "{}", segment.pour_start_secs);
        assert!((segment.pour_end_secs - 6.25).abs() < 1e-6);
        assert!((7.49..7.52).contains(&segment.end_secs), "{}", segment.end_secs);
        assert_eq!(segment.motion.states.steps(), 100);
        let w = PouringTask::default().empirical_task(&segment.motion).unwrap();
        assert!((w.values()[1] - 0.05).abs() < 1e-4, "{w:?}");
        assert!((w.values()[3] - 0.01).abs() < 1e-9);
    }

    #[test]
    fn an_open_gripper_neither_grasps_nor_pours() {
        let exclusion = excluded(&slow_pour(80.0), &[]);
        assert_eq!(exclusion.reason, Reason::NoGrasp);
        assert!(exclusion.detail.contains("97 %"), "{exclusion}");
        // Tilted with the gripper open, then a grasp without a tilt.
        assert_eq!(excluded(&slow_pour(80.0), &[[850, 990]]).reason, Reason::NoPour);
        assert_eq!(excluded(&slow_pour(80.0), &[[0, 950]]).reason, Reason::NoGrasp);
    }

    #[test]
    fn each_reason_comes_with_its_number() {
        let exclusion = excluded(&slow_pour(61.0), &[[100, 950]]);
        assert_eq!(
            exclusion.to_string(),
            "no_pour: left arm: the tilt reaches 61 of the 70 degrees that are a pour"
        );
        let exclusion = excluded(&slow_pour(80.0), &[[100, 700]]);
        assert_eq!(exclusion.reason, Reason::Incomplete);
        assert!(exclusion.detail.contains("40 degrees"), "{exclusion}");
        let twice: Vec<_> = slow_pour(80.0).into_iter().chain(slow_pour(80.0)).collect();
        let exclusion = excluded(&twice, &[[100, 1900]]);
        assert_eq!(exclusion.reason, Reason::SeveralPours);
        assert!(exclusion.detail.contains("at 3.8 s, 13.8 s"), "{exclusion}");
        // With the cup put down in between, too.
        assert_eq!(excluded(&twice, &[[100, 900], [1000, 1900]]).reason, Reason::SeveralPours);
    }

    #[test]
    fn a_tilt_that_wavers_about_70_degrees_is_one_pour_and_one_that_falls_to_45_two() {
        let with_dip = |to: f64| {
            let mut tilts = slow_pour(80.0);
            for (i, tilt) in tilts.iter_mut().enumerate() {
                let near = 1.0 - (i as f64 - 500.0).abs() / 80.0;
                *tilt -= (80.0 - to) * near.max(0.0);
            }
            tilts
        };
        let segment = PouringTask::default().segment(&arm(&with_dip(60.0), &[[100, 950]])).unwrap();
        assert!((segment.pour_end_secs - 6.25).abs() < 1e-6);
        assert_eq!(excluded(&with_dip(45.0), &[[100, 950]]).reason, Reason::SeveralPours);
    }

    #[test]
    fn a_flicker_of_the_gripper_is_neither_a_grasp_nor_a_release() {
        let mut arm = arm(&slow_pour(80.0), &[[100, 950]]);
        arm.percent_open[30] = 0.0;
        arm.percent_open[500] = 100.0;
        let segment = PouringTask::default().segment(&arm).unwrap();
        assert!((segment.grasp_secs - 1.0).abs() < 1e-9);
    }

    #[test]
    fn the_shipped_file_holds_the_defaults() {
        let text = include_str!("../../config/tasks/pour.toml");
        let config: crate::demonstrations::TaskConfig = toml::from_str(text).unwrap();
        assert_eq!(config, crate::demonstrations::TaskConfig::Pouring(PouringTask::default()));
        assert!(toml::from_str::<PouringTask>("pour_tilt = 70").is_err());
    }

    #[test]
    fn settings_that_can_not_be_are_refused_by_name() {
        assert_eq!(PouringTask::default().check(), Ok(()));
        for (set, said) in [
            ("steps = 1", "steps is 1; it must be from 4 to 10000"),
            ("pour_location = 'source_cup'", "pour_location is source_cup; it must be a name"),
            ("pour_tilt_deg = nan", "pour_tilt_deg is NaN; it must be below 180"),
            ("end_tilt_deg = 60", "pour_tilt_deg is 70; it must be below 180, and not below"),
            ("reference_rpy_deg = [0, inf, 0]", "reference_rpy_deg is inf; it must be three"),
            (
                "validity.workspace_x_m = { lower = 1.0, upper = 0.0 }",
                "validity.workspace_x_m is [1, 0]; it must be finite",
            ),
            (
                "augmentation.weight_noise = -1.0",
                "augmentation.weight_noise is -1; it must be from 0 to 0.9",
            ),
            ("augmentation.max_stretch = 1.5", "augmentation.max_stretch is 1.5; it must be"),
            ("augmentation.max_move_m = nan", "augmentation.max_move_m is NaN; it must be"),
        ] {
            let task: PouringTask = toml::from_str(set).unwrap();
            let error = task.check().unwrap_err().to_string();
            assert!(error.starts_with(said), "{error}");
        }
    }

    #[test]
    fn the_papers_file_differs_in_its_copies_alone() {
        let text = include_str!("../../config/tasks/pour-paper.toml");
        let config: crate::demonstrations::TaskConfig = toml::from_str(text).unwrap();
        let paper = PouringTask { augmentation: Augmentation::paper(), ..PouringTask::default() };
        assert_eq!(config, crate::demonstrations::TaskConfig::Pouring(paper));
    }

    proptest! {
        #[test]
        fn the_task_moves_with_the_motion(
            x in -0.2..0.2f64, y in -0.2..0.2f64, top in 75.0..110.0f64,
        ) {
            let task = PouringTask::default();
            let motion = rolled(&one_pour(top), 0.1);
            let moved: Vec<f64> = motion
                .states
                .states()
                .flat_map(|s| [s[0] + x, s[1] + y, s[2], s[3], s[4], s[5]])
                .collect();
            let moved = Motion {
                states: Trajectory::new(STATE_DIM, moved).unwrap(),
                duration_secs: motion.duration_secs,
            };
            let [a, b] = [&motion, &moved].map(|m| task.empirical_task(m).unwrap());
            for (i, by) in [x, y, x, y].into_iter().enumerate() {
                prop_assert!((b.values()[i] - a.values()[i] - by).abs() < 1e-9);
            }
        }

        #[test]
        fn the_task_is_continuous_in_the_tilt(top in 71.0..110.0f64) {
            let task = PouringTask::default();
            let w = |top| task.empirical_task(&rolled(&one_pour(top), 0.1)).unwrap();
            let (a, b) = (w(top), w(top + 1e-6));
            prop_assert!((a.values()[1] - b.values()[1]).abs() < 1e-6);
        }
    }
}
