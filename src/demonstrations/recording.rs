//! What every importer delivers, a [`JointRecording`], and how one arm's motion comes out of it.
//!
//! A robot with two mirrored arms has its demonstrations with either; those of the second arm are
//! mirrored in the xz plane, joint by joint, so that all of them show the first arm.

use std::collections::BTreeMap;

use nalgebra::Isometry3;
use serde::{Deserialize, Serialize};

use super::task::TaskSettingError;
use crate::kinematics::{Chain, CollisionRules, JointLimits};
use crate::parameters::Interval;

/// Joint angles and grippers over time, whatever file they came from.
#[derive(Debug, Clone, PartialEq)]
pub struct JointRecording {
    /// Name of the recording, unique among those read together.
    pub id: String,
    /// Time of each frame, strictly increasing.
    pub times_secs: Vec<f64>,
    /// Names of the joints, in the order of the values.
    pub joint_names: Vec<String>,
    /// One vector per frame: rad.
    pub positions: Vec<Vec<f64>>,
    /// The grippers, sampled at the frames.
    pub grippers: Vec<GripperRecording>,
    /// Where things were, as topics say.
    pub points: Vec<PointRecording>,
    /// When somebody marked a new demonstration.
    pub marks_secs: Vec<f64>,
}

/// Where something was over time, as a topic says. Its times may lie before the first frame.
#[derive(Debug, Clone, PartialEq)]
pub struct PointRecording {
    /// Name of the topic.
    pub topic: String,
    /// The frame that the positions are in.
    pub frame: String,
    /// Time of each position, ascending.
    pub times_secs: Vec<f64>,
    /// Positions in the frame.
    pub positions_m: Vec<[f64; 3]>,
}

/// How far a gripper is open over time.
#[derive(Debug, Clone, PartialEq)]
pub struct GripperRecording {
    /// Name of the gripper, such as `left_gripper`.
    pub name: String,
    /// One value per frame: per cent open.
    pub percent_open: Vec<f64>,
}

impl JointRecording {
    /// Time from the first frame to the last.
    pub fn duration_secs(&self) -> f64 {
        match (self.times_secs.first(), self.times_secs.last()) {
            (Some(first), Some(last)) => last - first,
            _ => 0.0,
        }
    }

    /// Mean number of frames per second; 0 for less than two frames.
    pub fn rate_hz(&self) -> f64 {
        let duration = self.duration_secs();
        if duration > 0.0 { (self.times_secs.len() - 1) as f64 / duration } else { 0.0 }
    }
}

/// Why a recording does not hold an arm.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// A joint of the arm is missing.
    #[error("the recording has no joint {name:?}; it has {known}")]
    JointMissing {
        /// Name of the joint.
        name: String,
        /// Names of the joints that the recording has, comma-separated.
        known: String,
    },
    /// The arm's gripper is missing.
    #[error(
        "the recording has no gripper {name:?}; it has {known}. Name its joint or its topic as \
         gripper_source in the robot's TOML"
    )]
    GripperMissing {
        /// Name of the gripper.
        name: String,
        /// Names of the grippers that the recording has, comma-separated.
        known: String,
    },
}

/// An arm in a recording: its joints from the base to the tip, and its gripper.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Arm {
    /// Name, such as `left`.
    pub name: String,
    /// Names of the joints, in the order of the chain.
    pub joints: Vec<String>,
    /// Name of the gripper; in the layout of MIME, of its file. Absent where none is recorded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gripper: Option<String>,
    /// Where messages say how far the gripper is open.
    #[serde(default, skip_serializing_if = "GripperSource::is_empty")]
    pub gripper_source: GripperSource,
    /// For an arm that is the mirror image of the chain's: the sign of each joint with which its
    /// angles are those of the chain's arm in mirrored motion. Absent for the chain's own arm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mirror_signs: Option<Vec<f64>>,
}

/// Where messages say how far a gripper is open, and in which numbers: a joint among the joint states, or
/// a topic of numbers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GripperSource {
    /// A finger's joint.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub joint: Option<String>,
    /// A topic.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub topic: Option<String>,
    /// The value when it is closed, rad or m of the joint, or as the topic counts.
    pub closed: f64,
    /// The value when it is open; may be less than `closed`.
    pub open: f64,
}

impl Default for GripperSource {
    fn default() -> Self {
        Self { joint: None, topic: None, closed: 0.0, open: 100.0 }
    }
}

impl GripperSource {
    fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Per cent that the gripper is open, beyond 0 and 100 where `value` is beyond the ends.
    pub fn percent_open(&self, value: f64) -> f64 {
        100.0 * (value - self.closed) / (self.open - self.closed)
    }
}

/// The robot that demonstrations were recorded on (`config/robots/*.toml`).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotConfig {
    /// Name, such as `baxter`.
    pub name: String,
    /// URDF file, relative to the TOML; absent for the embedded Baxter description.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub urdf: Option<String>,
    /// The frame that poses are expressed in.
    pub base_frame: String,
    /// The link whose pose is learned.
    pub tip_link: String,
    /// The arm that is served, `base_frame` to `tip_link`.
    pub arm: Arm,
    /// The other arm, if demonstrations with it count when mirrored.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mirrored_arm: Option<Arm>,
    /// A file of the joints' limits as MoveIt has it (`joint_limits.yaml`), relative to the TOML.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub joint_limits: Option<String>,
    /// Limits of joints by their names, in place of those of the file and of the description.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub limits: BTreeMap<String, JointLimits>,
    /// What the arm must not touch.
    #[serde(default)]
    pub collision: CollisionRules,
    /// Where people work with the served arm, for simulating them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub workplace: Option<Workplace>,
}

/// Where people who guide an arm have their objects, and how they hold its hand: level or pointing down a
/// bit. Positions are the tip's at a grasp, in the base frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Workplace {
    /// Where objects stand.
    pub x_m: Interval,
    /// See `x_m`.
    pub y_m: Interval,
    /// Heights at which objects are grasped.
    pub height_m: Interval,
    /// Directions over the ground in which the hand points, counted from the base's x axis.
    pub heading_deg: Interval,
    /// The `(x, y)` that the hand mostly comes from.
    pub shoulder_m: [f64; 2],
    /// How far the hand mostly turns against the direction from there.
    pub heading_turn_deg: f64,
}

impl Default for RobotConfig {
    /// Baxter's left arm, with the right one mirrored.
    fn default() -> Self {
        let joints = |side: &str| {
            let name = |joint| format!("{side}_{joint}");
            ["s0", "s1", "e0", "e1", "w0", "w1", "w2"].map(name).to_vec()
        };
        let arm = |side: &str, mirror_signs| Arm {
            name: side.into(),
            joints: joints(side),
            gripper: Some(format!("{side}_gripper")),
            // Of the electric gripper's description: a finger moves by 20.8 mm.
            gripper_source: GripperSource {
                joint: Some(format!("{}_gripper_l_finger_joint", &side[..1])),
                topic: None,
                closed: 0.0,
                open: 0.0208,
            },
            mirror_signs,
        };
        Self {
            name: "baxter".into(),
            urdf: None,
            base_frame: "base".into(),
            tip_link: "left_gripper".into(),
            arm: arm("left", None),
            mirrored_arm: Some(arm("right", Some(super::mirroring::BAXTER_SIGNS.to_vec()))),
            joint_limits: None,
            limits: BTreeMap::new(),
            collision: CollisionRules { table_height_m: Some(-0.22), ..CollisionRules::default() },
            workplace: Some(Workplace {
                x_m: Interval { lower: 0.5, upper: 0.85 },
                y_m: Interval { lower: -0.05, upper: 0.6 },
                height_m: Interval { lower: -0.10, upper: 0.05 },
                heading_deg: Interval { lower: -60.0, upper: 20.0 },
                shoulder_m: [0.1, 0.25],
                heading_turn_deg: -20.0,
            }),
        }
    }
}

impl RobotConfig {
    /// The arms that may show a demonstration, the served one first.
    pub fn arms(&self) -> impl Iterator<Item = &Arm> {
        std::iter::once(&self.arm).chain(&self.mirrored_arm)
    }

    /// The joints of all arms, and their grippers.
    pub fn channels(&self) -> Channels {
        let gripper = |arm: &Arm| {
            let name = arm.gripper.clone()?;
            Some(GripperChannel { name, source: arm.gripper_source.clone() })
        };
        Channels {
            joints: self.arms().flat_map(|a| a.joints.clone()).collect(),
            grippers: self.arms().filter_map(gripper).collect(),
            points: Vec::new(),
            marker: None,
        }
    }
}

/// What a recording must be like to be read as a demonstration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RecordingRules {
    /// Shorter recordings show nothing.
    pub min_duration_secs: f64,
    /// A joint that changes by more than this within `jump_window_secs` is a broken recording.
    pub jump_rad: f64,
    /// See `jump_rad`.
    pub jump_window_secs: f64,
    /// An open gripper has closed when it is open by less than this.
    pub closed_below_percent: f64,
    /// A closed gripper has opened when it is open by more than this.
    pub open_above_percent: f64,
    /// Closings and openings that last shorter than this are none.
    pub min_gripper_secs: f64,
    /// An arm moves while one of its joints does so faster than this.
    pub still_rad_per_s: f64,
    /// Motions that last shorter than this are none.
    pub min_motion_secs: f64,
    /// Where one demonstration ends and the next begins, in a recording that went on.
    pub cut_at: CutAt,
    /// For `cut_at = "pauses"`: all arms stand still for longer than this.
    pub pause_secs: f64,
}

/// Where one demonstration ends and the next begins, in a recording that went on.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CutAt {
    /// Amid each time that all grippers are open after one held something and before one does again.
    #[default]
    Grasps,
    /// Amid each time that all arms stand still.
    Pauses,
    /// At each message of this topic, whatever its type.
    Marker(String),
}

impl Default for RecordingRules {
    fn default() -> Self {
        Self {
            min_duration_secs: 3.0,
            jump_rad: 1.0,
            jump_window_secs: 0.2,
            closed_below_percent: 45.0,
            open_above_percent: 55.0,
            min_gripper_secs: 0.2,
            still_rad_per_s: 0.03,
            min_motion_secs: 0.2,
            cut_at: CutAt::Grasps,
            pause_secs: 2.0,
        }
    }
}

/// Half of the time over which the speed of a joint is measured, so that noise is no motion.
const HALF_SPEED_SECS: f64 = 0.1;

impl RecordingRules {
    pub(super) fn check(&self) -> Result<(), TaskSettingError> {
        let secs = |name, value: f64| (name, value, value >= 0.0, "finite and not negative");
        let above = |name, value: f64| (name, value, value > 0.0, "finite and above 0");
        let (closed, open) = (self.closed_below_percent, self.open_above_percent);
        for (name, value, fits, expected) in [
            secs("recording.min_duration_secs", self.min_duration_secs),
            above("recording.jump_rad", self.jump_rad),
            above("recording.jump_window_secs", self.jump_window_secs),
            (
                "recording.closed_below_percent",
                closed,
                closed <= open,
                "at most open_above_percent",
            ),
            secs("recording.open_above_percent", open),
            secs("recording.min_gripper_secs", self.min_gripper_secs),
            above("recording.still_rad_per_s", self.still_rad_per_s),
            secs("recording.min_motion_secs", self.min_motion_secs),
            above("recording.pause_secs", self.pause_secs),
        ] {
            if !(fits && value.is_finite()) {
                return Err(TaskSettingError { name, value: value.to_string(), expected });
            }
        }
        match &self.cut_at {
            CutAt::Marker(topic) if !topic.starts_with('/') => Err(TaskSettingError {
                name: "recording.cut_at.marker",
                value: topic.clone(),
                expected: "a topic's full name, which begins with /",
            }),
            _ => Ok(()),
        }
    }

    /// When any of these joints moves: from which frame, and before which. What lasts too short is none.
    pub(super) fn moves(&self, times_secs: &[f64], positions: &[Vec<f64>]) -> Vec<[usize; 2]> {
        let frames = times_secs.len();
        let (mut from, mut to) = (0, 0);
        let mut runs: Vec<[usize; 2]> = Vec::new();
        for i in 0..frames {
            while times_secs[i] - times_secs[from] > HALF_SPEED_SECS + 1e-9 {
                from += 1;
            }
            while to + 1 < frames && times_secs[to] - times_secs[i] < HALF_SPEED_SECS - 1e-9 {
                to += 1;
            }
            let secs = times_secs[to] - times_secs[from];
            let pairs = || positions[from].iter().zip(&positions[to]);
            let moves =
                secs > 0.0 && pairs().any(|(a, b)| (b - a).abs() / secs > self.still_rad_per_s);
            match runs.last_mut() {
                Some(run) if moves && run[1] == i => run[1] = i + 1,
                _ if moves => runs.push([i, i + 1]),
                _ => {}
            }
        }
        let lasts = |run: &[usize; 2]| times_secs[run[1] - 1] - times_secs[run[0]];
        runs.retain(|run| lasts(run) >= self.min_motion_secs);
        runs
    }

    /// When a gripper is closed: from which frame, and before which. What lasts too short is what was
    /// before going on.
    pub(super) fn holds(&self, times_secs: &[f64], percent_open: &[f64]) -> Vec<[usize; 2]> {
        // Runs of frames in one state of the gripper: [first, end), and whether it is closed.
        let mut runs: Vec<([usize; 2], bool)> = Vec::new();
        let threshold = 0.5 * (self.closed_below_percent + self.open_above_percent);
        for (i, &open) in percent_open.iter().enumerate() {
            let closed = match runs.last() {
                None => open < threshold,
                Some((_, true)) => open <= self.open_above_percent,
                Some((_, false)) => open < self.closed_below_percent,
            };
            match runs.last_mut() {
                Some((run, state)) if *state == closed => run[1] = i + 1,
                _ => runs.push(([i, i + 1], closed)),
            }
        }
        let mut steady: Vec<([usize; 2], bool)> = Vec::new();
        for (run, closed) in runs {
            let lasts = times_secs[run[1] - 1] - times_secs[run[0]];
            match steady.last_mut() {
                Some((before, state)) if *state == closed || lasts < self.min_gripper_secs => {
                    before[1] = run[1];
                }
                _ => steady.push((run, closed)),
            }
        }
        steady.into_iter().filter(|(_, closed)| *closed).map(|(run, _)| run).collect()
    }
}

/// What an importer is to read.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Channels {
    /// Names of joints.
    pub joints: Vec<String>,
    /// Grippers.
    pub grippers: Vec<GripperChannel>,
    /// Topics of points or poses.
    pub points: Vec<String>,
    /// A topic whose messages mark new demonstrations.
    pub marker: Option<String>,
}

/// A gripper that an importer is to read.
#[derive(Debug, Clone, PartialEq)]
pub struct GripperChannel {
    /// Its name.
    pub name: String,
    /// Where messages speak of it.
    pub source: GripperSource,
}

/// The motion of one arm, as that of the served arm.
#[derive(Debug, Clone, PartialEq)]
pub struct ArmRecording {
    /// Name of the arm that moved.
    pub arm: String,
    /// Time of each frame, strictly increasing.
    pub times_secs: Vec<f64>,
    /// Joint angles of the served arm, rad; one vector per frame.
    pub positions: Vec<Vec<f64>>,
    /// The tip of the served arm in the base frame.
    pub base_from_tip: Vec<Isometry3<f64>>,
    /// Per cent that the gripper is open; absent where none is recorded.
    pub percent_open: Option<Vec<f64>>,
}

impl Arm {
    /// The arm's motion in a recording; `chain` is that of the served arm.
    ///
    /// # Errors
    /// A joint or the gripper is not in the recording.
    ///
    /// # Panics
    /// When the arm has not as many joints (and signs) as the chain.
    pub fn motion(
        &self,
        recording: &JointRecording,
        chain: &Chain,
    ) -> Result<ArmRecording, RecordingError> {
        assert_eq!(self.joints.len(), chain.dof(), "the arm has the joints of the chain");
        let place = |name: &String| {
            let place = recording.joint_names.iter().position(|n| n == name);
            place.ok_or_else(|| RecordingError::JointMissing {
                name: name.clone(),
                known: recording.joint_names.join(", "),
            })
        };
        let places = self.joints.iter().map(place).collect::<Result<Vec<_>, _>>()?;
        let percent_open = |name: &String| {
            let gripper = recording.grippers.iter().find(|g| g.name == *name);
            let gripper = gripper.map(|g| g.percent_open.clone());
            gripper.ok_or_else(|| RecordingError::GripperMissing {
                name: name.clone(),
                known: recording.grippers.iter().map(|g| &*g.name).collect::<Vec<_>>().join(", "),
            })
        };
        let percent_open = self.gripper.as_ref().map(percent_open).transpose()?;
        let own = |frame: &Vec<f64>| {
            let own: Vec<f64> = places.iter().map(|&i| frame[i]).collect();
            match &self.mirror_signs {
                Some(signs) => super::mirroring::mirrored_joints(&own, signs),
                None => own,
            }
        };
        let positions: Vec<Vec<f64>> = recording.positions.iter().map(own).collect();
        Ok(ArmRecording {
            arm: self.name.clone(),
            times_secs: recording.times_secs.clone(),
            base_from_tip: positions.iter().map(|q| chain.forward(q)).collect(),
            positions,
            percent_open,
        })
    }
}

impl ArmRecording {
    /// How far the tip came about: the diagonal of the box around its positions, m.
    pub fn extent_m(&self) -> f64 {
        let positions = || self.base_from_tip.iter().map(|p| p.translation.vector);
        let Some(first) = positions().next() else { return 0.0 };
        let [low, high] = positions()
            .fold([first; 2], |[low, high], position| [low.inf(&position), high.sup(&position)]);
        (high - low).norm()
    }
}

/// Why a recording is not among the demonstrations. A task has its own names for some of them
/// ([`super::manipulation::ManipulationTask::reason_name`]).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Reason {
    /// The files can't be read as a recording.
    Unreadable,
    /// Too few frames to show anything.
    TooShort,
    /// A joint jumps: the recording is broken.
    Jump,
    /// The gripper never closes on anything.
    NoGrasp,
    /// What was grasped is not used as the task says; `no_pour`.
    NoAction,
    /// It is so more than once; `several_pours`.
    SeveralActions,
    /// The recording ends, or the gripper opens, before the action is over.
    Incomplete,
    /// The motion leaves the bounds of the task.
    OutOfRegion,
    /// The user left it out.
    User,
}

impl std::fmt::Display for Reason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Unreadable => "unreadable",
            Self::TooShort => "too_short",
            Self::Jump => "jump",
            Self::NoGrasp => "no_grasp",
            Self::NoAction => "no_action",
            Self::SeveralActions => "several_actions",
            Self::Incomplete => "incomplete",
            Self::OutOfRegion => "out_of_region",
            Self::User => "user",
        })
    }
}

/// The recorded reason for leaving a recording out, with its numbers.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{reason}: {detail}")]
pub struct Exclusion {
    /// The kind of reason.
    pub reason: Reason,
    /// Fact, number, limit: `the tilt reaches 61 of the 70 degrees that are a pour`.
    pub detail: String,
}

impl Exclusion {
    /// An exclusion for this reason.
    pub fn new(reason: Reason, detail: impl Into<String>) -> Self {
        Self { reason, detail: detail.into() }
    }
}

/// The largest change of a joint within a window of time.
#[derive(Debug, Clone, PartialEq)]
pub struct Jump {
    /// Name of the joint.
    pub joint: String,
    /// When the window ends.
    pub at_secs: f64,
    /// Largest value less smallest value of the joint inside the window.
    pub change_rad: f64,
}

impl JointRecording {
    /// The demonstrations of one that went on recording, cut as the rules say. Each begins at time 0; of
    /// several, the ids are numbered from 1.
    pub fn cut(self, rules: &RecordingRules) -> Vec<Self> {
        let frames = self.times_secs.len();
        let mut cuts = match &rules.cut_at {
            CutAt::Grasps => self.between_grasps(rules),
            CutAt::Pauses => self.amid_pauses(rules),
            CutAt::Marker(_) => {
                let frame = |mark: &f64| self.times_secs.partition_point(|t| t < mark);
                self.marks_secs.iter().map(frame).filter(|i| (1..frames).contains(i)).collect()
            }
        };
        cuts.dedup();
        if cuts.is_empty() {
            return vec![self];
        }
        cuts.push(frames);
        let mut from = 0;
        let piece = |(number, to): (usize, usize)| {
            let range = from..to;
            from = to;
            Self {
                id: format!("{}#{}", self.id, number + 1),
                times_secs: self.times_secs[range.clone()]
                    .iter()
                    .map(|t| t - self.times_secs[range.start])
                    .collect(),
                joint_names: self.joint_names.clone(),
                positions: self.positions[range.clone()].to_vec(),
                grippers: self
                    .grippers
                    .iter()
                    .map(|g| GripperRecording {
                        name: g.name.clone(),
                        percent_open: g.percent_open[range.clone()].to_vec(),
                    })
                    .collect(),
                // Where things were before it counts, too.
                points: self
                    .points
                    .iter()
                    .map(|p| PointRecording {
                        times_secs: p
                            .times_secs
                            .iter()
                            .map(|t| t - self.times_secs[range.start])
                            .collect(),
                        ..p.clone()
                    })
                    .collect(),
                marks_secs: Vec::new(),
            }
        };
        cuts.into_iter().enumerate().map(piece).collect()
    }

    /// Frames amid each time that all grippers are open after one held something and before one does
    /// again. A gripper that never opens, or never closes, holds nothing.
    fn between_grasps(&self, rules: &RecordingRules) -> Vec<usize> {
        let frames = self.times_secs.len();
        let mut held = vec![false; frames];
        // The first frame that is after something was held.
        let mut after_first = frames;
        for gripper in &self.grippers {
            for [first, end] in rules.holds(&self.times_secs, &gripper.percent_open) {
                if end - first == frames {
                    continue;
                }
                held[first..end].fill(true);
                // What is closed from the start was not seen to grasp.
                if first > 0 {
                    after_first = after_first.min(end);
                }
            }
        }
        let mut cuts = Vec::new();
        let mut open_from = None;
        for (frame, held) in held.into_iter().enumerate().skip(after_first) {
            match (held, open_from) {
                (false, None) => open_from = Some(frame),
                (true, Some(from)) => {
                    cuts.push((from + frame) / 2);
                    open_from = None;
                }
                _ => {}
            }
        }
        cuts
    }

    /// Frames amid each pause between two motions.
    fn amid_pauses(&self, rules: &RecordingRules) -> Vec<usize> {
        let moves = rules.moves(&self.times_secs, &self.positions);
        let pauses = moves.windows(2).map(|pair| [pair[0][1] - 1, pair[1][0]]);
        pauses
            .filter(|[from, to]| self.times_secs[*to] - self.times_secs[*from] > rules.pause_secs)
            .map(|[from, to]| (from + to).div_ceil(2))
            .collect()
    }

    /// The largest change of any joint within `window_secs`; none for an empty recording.
    pub fn largest_jump(&self, window_secs: f64) -> Option<Jump> {
        let mut largest: Option<Jump> = None;
        for (j, name) in self.joint_names.iter().enumerate() {
            let mut first = 0;
            for i in 0..self.positions.len() {
                // A hair of tolerance, so that a window of 20 steps of 10 ms holds 21 frames.
                while self.times_secs[i] - self.times_secs[first] > window_secs + 1e-9 {
                    first += 1;
                }
                let window = self.positions[first..=i].iter().map(|q| q[j]);
                let (low, high) = window
                    .fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
                if largest.as_ref().is_none_or(|l| high - low > l.change_rad) {
                    largest = Some(Jump {
                        joint: name.clone(),
                        at_secs: self.times_secs[i],
                        change_rad: high - low,
                    });
                }
            }
        }
        largest
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn recording(values: impl IntoIterator<Item = f64>) -> JointRecording {
        let positions: Vec<Vec<f64>> = values.into_iter().map(|v| vec![v]).collect();
        JointRecording {
            id: "r".into(),
            times_secs: (0..positions.len()).map(|i| 0.01 * i as f64).collect(),
            joint_names: vec!["j".into()],
            positions,
            grippers: vec![],
            points: vec![],
            marks_secs: vec![],
        }
    }

    #[test]
    fn a_slow_motion_is_no_jump_and_its_largest_change_is_that_of_the_window() {
        let jump = recording((0..300).map(|i| 0.02 * f64::from(i))).largest_jump(0.2).unwrap();
        assert!((jump.change_rad - 0.4).abs() < 1e-9, "{jump:?}");
    }

    #[test]
    fn a_spike_that_comes_back_at_once_is_seen() {
        let spike = (0..100).map(|i| if i == 50 { 1.3 } else { 0.0 });
        let jump = recording(spike).largest_jump(0.2).unwrap();
        assert_eq!((jump.change_rad, jump.at_secs), (1.3, 0.5));
    }

    /// A recording of grippers at 10 Hz: `o` open, `c` closed.
    fn grippers(states: &[&str]) -> JointRecording {
        let percent = |state: char| if state == 'o' { 100.0 } else { 0.0 };
        let gripper = |(i, states): (usize, &&str)| GripperRecording {
            name: format!("g{i}"),
            percent_open: states.chars().map(percent).collect(),
        };
        let frames = states[0].len();
        JointRecording {
            times_secs: (0..frames).map(|i| 5.0 + 0.1 * i as f64).collect(),
            positions: (0..frames).map(|i| vec![i as f64]).collect(),
            grippers: states.iter().enumerate().map(gripper).collect(),
            ..recording([])
        }
    }

    /// The first frames of the pieces.
    fn cut(states: &[&str]) -> Vec<usize> {
        let pieces = grippers(states).cut(&RecordingRules::default());
        let together: usize = pieces.iter().map(|piece| piece.positions.len()).sum();
        assert_eq!(together, states[0].len());
        assert!(pieces.iter().all(|p| p.grippers[0].percent_open.len() == p.times_secs.len()));
        pieces.iter().map(|piece| piece.positions[0][0] as usize).collect()
    }

    #[test]
    fn a_recording_is_cut_where_all_grippers_are_open_between_two_grasps() {
        assert_eq!(cut(&["oooccccooooooccccooo"]), [0, 10]);
        assert_eq!(cut(&["oooccccooooooccccoooocccccoooo"]), [0, 10, 19]);
        // Another holds on meanwhile, until it opens, too.
        assert_eq!(cut(&["oooccccooooooccccooo", "ooooocccccccccoooooo"]), [0]);
        assert_eq!(cut(&["oooccccooooooccccooo", "ooooocccccoooooooooo"]), [0, 11]);
        // One that never moves says nothing.
        assert_eq!(cut(&["oooccccooooooccccooo", "cccccccccccccccccccc"]), [0, 10]);
    }

    #[test]
    fn a_recording_without_grippers_is_cut_amid_its_pauses_or_at_marks() {
        // Moves, pauses for 3 s, moves, pauses for 1 s, moves; at 100 Hz, with noise of 0.3 mrad.
        let speeds = [(200, 1.0), (300, 0.0), (200, -1.0), (100, 0.0), (200, 1.0)];
        let speeds = speeds.iter().flat_map(|&(frames, speed)| std::iter::repeat_n(speed, frames));
        let mut at = 0.0;
        let positions = speeds.enumerate().map(|(i, speed): (usize, f64)| {
            at += 0.01 * speed;
            at + 3e-4 * (i as f64).sin()
        });
        let recording = JointRecording { marks_secs: vec![1.005, 8.0], ..recording(positions) };
        let lengths = |cut_at| {
            let rules = RecordingRules { cut_at, ..RecordingRules::default() };
            let pieces = recording.clone().cut(&rules);
            pieces.iter().map(|piece| piece.times_secs.len()).collect::<Vec<_>>()
        };
        let amid = lengths(CutAt::Pauses);
        assert!(amid.len() == 2 && (amid[0] as i64 - 350).abs() < 10, "{amid:?}");
        assert_eq!(lengths(CutAt::Marker("/next".into())), [101, 699, 200]);
        assert_eq!(lengths(CutAt::Grasps), [1000]);
    }

    #[test]
    fn where_things_were_before_a_piece_is_known_in_it() {
        let mut whole = recording((0..1000).map(|i| 0.01 * f64::from(i)));
        whole.marks_secs = vec![5.0];
        whole.points = vec![PointRecording {
            topic: "/bowl".into(),
            frame: "base".into(),
            times_secs: vec![1.0, 6.0],
            positions_m: vec![[0.5, 0.0, 0.0], [0.6, 0.0, 0.0]],
        }];
        let rules = RecordingRules { cut_at: CutAt::Marker("/m".into()), ..Default::default() };
        let pieces = whole.cut(&rules);
        assert_eq!(pieces[1].points[0].times_secs, [-4.0, 1.0]);
    }

    #[test]
    fn one_grasp_is_one_demonstration() {
        for states in ["oooccccooo", "oooccccccc", "oooooooooo", "cccccccccc", "ccccoooccc"] {
            assert_eq!(cut(&[states]), [0], "{states}");
        }
        // A flicker is no grasp.
        assert_eq!(cut(&["ooocccccoccccccooo"]), [0]);
        let whole = grippers(&["ooocccooo"]);
        assert_eq!(whole.clone().cut(&RecordingRules::default()), [whole]);
    }

    #[test]
    fn pieces_are_numbered_and_begin_at_0() {
        let pieces = grippers(&["oooccccooooooccccooo"]).cut(&RecordingRules::default());
        assert_eq!([&pieces[0].id, &pieces[1].id], ["r#1", "r#2"]);
        assert_eq!(pieces[1].times_secs[0], 0.0);
        assert!((pieces[1].times_secs[1] - 0.1).abs() < 1e-9);
    }

    #[test]
    fn the_shipped_robot_is_the_default() {
        let text = include_str!("../../config/robots/baxter.toml");
        assert_eq!(toml::from_str::<RobotConfig>(text).unwrap(), RobotConfig::default());
        assert!(toml::from_str::<RobotConfig>("tip = \"left_hand\"").is_err());
    }

    #[test]
    fn the_rate_is_that_of_the_frames() {
        let recording = recording(std::iter::repeat_n(0.0, 101));
        assert!((recording.rate_hz() - 100.0).abs() < 1e-9);
        assert!((recording.duration_secs() - 1.0).abs() < 1e-9);
    }

    #[test]
    fn reasons_are_written_as_in_the_files() {
        for reason in [Reason::TooShort, Reason::SeveralActions, Reason::OutOfRegion] {
            assert_eq!(serde_json::to_string(&reason).unwrap(), format!("\"{reason}\""));
        }
    }
}
