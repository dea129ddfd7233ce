//! The demonstration in a recording: which arm shows it, from when to when.

use super::profile::Profile;
use super::{During, ManipulationTask, Symmetry};
use crate::demonstrations::Demonstration;
use crate::demonstrations::recording::{
    Arm, ArmRecording, Exclusion, JointRecording, PointRecording, Reason, RobotConfig,
};
use crate::demonstrations::task::Task;
use crate::kinematics::Chain;
use crate::parameters::TaskParameters;
use crate::pose::STATE_DIM;
use crate::trajectory::{Motion, Trajectory};

/// A demonstration in a recording, with its times in the recording's.
#[derive(Debug, Clone, PartialEq)]
pub struct Segment {
    /// Name of the arm.
    pub arm: String,
    /// When it begins: the gripper has closed on the object, or the tip moves.
    pub start_secs: f64,
    /// When the action starts.
    pub action_start_secs: f64,
    /// When the action ends.
    pub action_end_secs: f64,
    /// When it ends.
    pub end_secs: f64,
    /// From the start to the end, in the states of the task.
    pub motion: Motion,
    /// The joints of the served arm at the start, rad.
    pub posture: Vec<f64>,
}

impl ManipulationTask {
    /// The arms that may demonstrate the task.
    pub fn arms<'a>(&self, robot: &'a RobotConfig) -> impl Iterator<Item = &'a Arm> + use<'a> {
        let mirrored = match self.symmetry {
            Symmetry::Xz => robot.mirrored_arm.as_ref(),
            Symmetry::None => None,
        };
        std::iter::once(&robot.arm).chain(mirrored)
    }

    /// The demonstration in a recording: that of the arm that acts.
    ///
    /// # Errors
    /// Why the recording is left out. Where no arm acts, the reason of the one that moved most.
    ///
    /// # Panics
    /// When an arm of the robot has not as many joints as the chain.
    pub fn demonstration(
        &self,
        recording: &JointRecording,
        robot: &RobotConfig,
        chain: &Chain,
    ) -> Result<(Segment, Demonstration), Exclusion> {
        self.check_recording(recording)?;
        let unreadable = |e: &dyn std::error::Error| {
            let reason = Reason::Unreadable;
            Exclusion::new(reason, e.to_string())
        };
        let mut found: Option<(&Arm, Segment)> = None;
        let mut others: Vec<(f64, Exclusion)> = Vec::new();
        let mut missing = None;
        for arm in self.arms(robot) {
            let motion = match arm.motion(recording, chain) {
                Ok(motion) => motion,
                // One arm is enough.
                Err(e) => {
                    missing.get_or_insert(e);
                    continue;
                }
            };
            match (self.segment(&motion), &found) {
                (Ok(segment), None) => found = Some((arm, segment)),
                (Ok(segment), Some((_, other))) => {
                    let (name, other) = (self.action.name(), &other.arm);
                    return Err(Exclusion::new(
                        Reason::SeveralActions,
                        format!("both arms {name}, {other} and {}", segment.arm),
                    ));
                }
                (Err(exclusion), _) => others.push((motion.extent_m(), exclusion)),
            }
        }
        let Some((arm, segment)) = found else {
            // An arm that only drifts, or holds the bowl, did not mean to act.
            let moved_most = others.into_iter().max_by(|(a, _), (b, _)| a.total_cmp(b));
            return Err(match (moved_most, missing) {
                (Some((_, exclusion)), _) => exclusion,
                (None, missing) => unreadable(&missing.expect("a robot has an arm")),
            });
        };
        // The other arm acts too, only not as a demonstration would.
        if let Some((_, other)) = others.into_iter().find(|(_, e)| e.reason > Reason::NoAction) {
            return Err(other);
        }
        let measured = self.empirical_task(&segment.motion).map_err(|e| {
            // Only an action that falls between two resampled states can get lost here.
            Exclusion::new(Reason::NoAction, e.to_string())
        })?;
        let w = self.recorded_task(recording, robot, arm, &segment, measured)?;
        let motion = segment.motion.clone();
        let (id, events) = (recording.id.clone(), self.events(&motion));
        Ok((segment, Demonstration { id, w, motion, events }))
    }

    /// What a recording must be like, whatever it shows.
    fn check_recording(&self, recording: &JointRecording) -> Result<(), Exclusion> {
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
        match recording.largest_jump(rules.jump_window_secs) {
            Some(jump) if jump.change_rad > rules.jump_rad => Err(Exclusion::new(
                Reason::Jump,
                format!(
                    "{} changes by {:.2} rad within {} s at {:.2} s, limit {} rad",
                    jump.joint,
                    jump.change_rad,
                    rules.jump_window_secs,
                    jump.at_secs,
                    rules.jump_rad
                ),
            )),
            _ => Ok(()),
        }
    }

    /// The task parameters of a demonstration: as measured of the motion, but for locations that a topic
    /// tells.
    fn recorded_task(
        &self,
        recording: &JointRecording,
        robot: &RobotConfig,
        arm: &Arm,
        segment: &Segment,
        measured: TaskParameters,
    ) -> Result<TaskParameters, Exclusion> {
        let mut w = measured.values().to_vec();
        for (place, location) in w.chunks_exact_mut(2).zip(&self.locations) {
            let Some(topic) = &location.topic else { continue };
            let told = recording.points.iter().find(|points| points.topic == *topic);
            let Some(PointRecording { frame, times_secs, positions_m, .. }) =
                told.filter(|points| !points.positions_m.is_empty())
            else {
                let (name, detail) = (&location.name, "which has no point or pose");
                return Err(Exclusion::new(
                    Reason::Unreadable,
                    format!("{name} is on the topic {topic}, {detail} in the recording"),
                ));
            };
            if frame.trim_start_matches('/') != robot.base_frame {
                let base = &robot.base_frame;
                return Err(Exclusion::new(
                    Reason::Unreadable,
                    format!("{topic} is in the frame {frame:?}; {base:?} is needed"),
                ));
            }
            // What is to be done is known before it begins.
            let before = times_secs.partition_point(|t| *t <= segment.start_secs);
            let [x, y, _] = positions_m[before.saturating_sub(1)];
            let told = [x, if arm.mirror_signs.is_some() { -y } else { y }];
            let off = (told[0] - place[0]).hypot(told[1] - place[1]);
            if off > location.agree_within_m {
                let (name, limit) = (&location.name, location.agree_within_m);
                return Err(Exclusion::new(
                    Reason::OutOfRegion,
                    format!("the motion is {off:.3} m from {name} on {topic}, limit {limit} m"),
                ));
            }
            place.copy_from_slice(&told);
        }
        TaskParameters::new(&self.task_space(), w)
            .map_err(|e| Exclusion::new(Reason::Unreadable, e.to_string()))
    }

    /// The demonstration in an arm's motion.
    ///
    /// # Errors
    /// Why there is none, or none that can be used.
    pub fn segment(&self, arm: &ArmRecording) -> Result<Segment, Exclusion> {
        let name = &arm.arm;
        let Search { mut found, reached } = self.search(arm)?;
        let time = |index: f64| {
            let i = (index.floor() as usize).min(arm.times_secs.len() - 2);
            let [a, b] = [arm.times_secs[i], arm.times_secs[i + 1]];
            a + (index - i as f64) * (b - a)
        };
        let found = match found.len() {
            0 => {
                let detail = format!("{name} arm: {}", self.lacking(reached));
                return Err(Exclusion::new(Reason::NoAction, detail));
            }
            1 => found.remove(0),
            n => {
                let times: Vec<_> =
                    found.iter().map(|f| format!("{:.1} s", time(f.action_start()))).collect();
                let action = self.action.name();
                return Err(Exclusion::new(
                    Reason::SeveralActions,
                    format!("{name} arm: {n} {action}s, at {}; one is needed", times.join(", ")),
                ));
            }
        };
        let end = self.end(arm, &found)?;
        let Found { start, .. } = found;
        let (start_secs, end_secs) = (arm.times_secs[start], arm.times_secs[end]);
        let states = self.state_frame().trajectory(&arm.base_from_tip[start..=end]);
        let segment = Segment {
            arm: name.clone(),
            start_secs,
            action_start_secs: time(found.action_start()),
            action_end_secs: time(found.action_end()),
            end_secs,
            motion: Motion {
                states: at_equal_times(&states, &arm.times_secs[start..=end], self.steps),
                duration_secs: end_secs - start_secs,
            },
            posture: arm.positions[start].clone(),
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

    /// Times that the action happens in an arm's motion.
    pub(in crate::demonstrations) fn count_actions(&self, arm: &ArmRecording) -> usize {
        self.search(arm).map_or(0, |search| search.found.len())
    }

    /// The actions in an arm's motion. Only what happens while the gripper holds the object, or while the
    /// arm moves, counts.
    fn search(&self, arm: &ArmRecording) -> Result<Search, Exclusion> {
        let holds = match self.segment.during {
            During::Grasp => self.grasps(arm)?,
            During::Motion => self.motions(arm)?,
        };
        let mut search = Search { found: Vec::new(), reached: 0.0 };
        for &[start, end] in &holds {
            let profile = self.profile_of(arm.base_from_tip[start..end].to_vec());
            search.reached = search.reached.max(profile.reached());
            for action in 0..profile.actions.len() {
                search.found.push(Found { start, end, action, profile: profile.clone() });
            }
        }
        Ok(search)
    }

    /// The last frame of a demonstration.
    fn end(&self, arm: &ArmRecording, found: &Found) -> Result<usize, Exclusion> {
        let (name, action) = (&arm.arm, self.action.name());
        let incomplete = |detail: String| {
            Err(Exclusion::new(Reason::Incomplete, format!("{name} arm: {detail}")))
        };
        let frames = arm.times_secs.len();
        let Some(below) = self.segment.until_tilt_below_deg else {
            return match self.segment.during {
                During::Grasp if found.end == frames => incomplete(format!(
                    "the recording ends before the object is released; it is {} s long",
                    arm.times_secs[frames - 1]
                )),
                During::Grasp | During::Motion => Ok(found.end - 1),
            };
        };
        let tilts = &found.profile.tilts_deg;
        let after = found.profile.actions[found.action].end().ceil() as usize;
        match (after..tilts.len()).find(|&i| tilts[i] < below) {
            Some(end) => Ok(found.start + end),
            None => {
                let least =
                    tilts[after.min(tilts.len() - 1)..].iter().copied().fold(180.0, f64::min);
                incomplete(format!(
                    "after the {action} the tilt falls to {least:.0} degrees before the object is \
                     released or the recording ends, below {below} is needed"
                ))
            }
        }
    }

    /// Frames from a closing of the gripper to the next opening, or to the end.
    fn grasps(&self, arm: &ArmRecording) -> Result<Vec<[usize; 2]>, Exclusion> {
        let rules = &self.recording;
        let Some(percent_open) = &arm.percent_open else {
            return Err(Exclusion::new(
                Reason::Unreadable,
                format!(
                    "{} arm: the robot's TOML names no gripper for it, and a demonstration lasts \
                     while one holds something; name it, or set segment.during = \"motion\"",
                    arm.arm
                ),
            ));
        };
        let holds = rules.holds(&arm.times_secs, percent_open);
        // A gripper that is closed from the start was not seen to grasp.
        let grasps: Vec<[usize; 2]> =
            holds.iter().filter(|[first, end]| *first > 0 && end - first >= 2).copied().collect();
        if grasps.is_empty() {
            let smallest = percent_open.iter().copied().fold(f64::INFINITY, f64::min);
            let frames = percent_open.len();
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

    /// The frames from when the arm first moves to when it last does.
    fn motions(&self, arm: &ArmRecording) -> Result<Vec<[usize; 2]>, Exclusion> {
        let moves = self.recording.moves(&arm.times_secs, &arm.positions);
        let all = moves.first().zip(moves.last()).map(|(first, last)| [first[0], last[1]]);
        match all {
            Some([first, end]) if end - first >= 2 => Ok(vec![[first, end]]),
            _ => Err(Exclusion::new(
                Reason::NoAction,
                format!(
                    "{} arm: no joint moves faster than {} rad/s for {} s",
                    arm.arm, self.recording.still_rad_per_s, self.recording.min_motion_secs
                ),
            )),
        }
    }
}

/// The actions in a recording, and how far it came towards one.
struct Search {
    found: Vec<Found>,
    reached: f64,
}

/// An action in the frames `start..end` of a recording.
struct Found {
    start: usize,
    end: usize,
    /// Which of the profile's.
    action: usize,
    profile: Profile,
}

impl Found {
    fn action_start(&self) -> f64 {
        self.start as f64 + self.profile.actions[self.action].start()
    }

    fn action_end(&self) -> f64 {
        self.start as f64 + self.profile.actions[self.action].end()
    }
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
