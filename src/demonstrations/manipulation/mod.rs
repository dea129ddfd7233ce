//! What an arm does with an object that it carries, such as pouring from a cup (the paper's section
//! 5.2) or stacking a block: the parts that a task's TOML is made of, and what they measure.
//!
//! A demonstration lasts while the gripper holds the object, or while the arm is in motion. In it the
//! action happens once: the object is tilted, or carried from one place to another. Task parameters
//! are `(x, y)` of the tip in the base frame, where it starts, where it ends, and where it is on
//! average during the action. All of it is read off the states alone, so that it can be measured of a
//! demonstration and of what a model decodes in the same way.

mod profile;
mod segmentation;
mod validity;

use profile::Profile;
pub use segmentation::Segment;
pub use validity::Bounds;

use std::borrow::Cow;

use nalgebra::UnitQuaternion;
use serde::{Deserialize, Serialize};

use super::augmentation::Augmentation;
use super::recording::{CutAt, Reason, RecordingRules};
use super::task::{Factor, Task, TaskMeasureError, TaskSettingError, Violation};
use crate::parameters::{TaskLocation, TaskParameters, TaskSpace};
use crate::pose::StateFrame;
use crate::trajectory::Motion;

/// A task of an arm with an object (`config/tasks/*.toml`).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ManipulationTask {
    /// Name, such as `pouring`.
    pub name: String,
    /// States of a demonstration, `T`.
    #[serde(default = "default_steps")]
    pub steps: usize,
    /// Roll, pitch and yaw (URDF convention) of the tip orientation whose rotation vector is 0.
    pub reference_rpy_deg: [f64; 3],
    /// Distances from the task at which success and robustness are told, m.
    #[serde(default = "default_thresholds")]
    pub thresholds_m: [f64; 3],
    /// Whether demonstrations with the robot's mirrored arm count.
    #[serde(default)]
    pub symmetry: Symmetry,
    /// Factors of the manner that manner parameters are to be named after, in their order.
    #[serde(default)]
    pub manner: Vec<String>,
    /// What is done with the object, once in each demonstration.
    pub action: Action,
    /// What a demonstration lasts.
    #[serde(default)]
    pub segment: SegmentRules,
    /// The locations that are the task parameters, in their order.
    pub locations: Vec<Location>,
    /// What a recording must be like.
    #[serde(default)]
    pub recording: RecordingRules,
    /// What a motion must be like to be valid. Of recordings, only those that leave the workspace are
    /// excluded for it.
    pub validity: Bounds,
    /// How demonstrations are multiplied.
    #[serde(default)]
    pub augmentation: Augmentation,
}

fn default_steps() -> usize {
    100
}

fn default_thresholds() -> [f64; 3] {
    [0.01, 0.02, 0.05]
}

/// What the task looks the same under.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Symmetry {
    /// Nothing: the served arm alone demonstrates.
    None,
    /// The plane of the base's x and z: what the mirrored arm does counts when mirrored.
    #[default]
    Xz,
}

/// What is done with the object, and how it shows in the poses of the tip.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Action {
    /// The object's axis, which points up at the start, is tilted.
    Tilt {
        /// What people call it: `pour` makes the factors `pour_start` and `pour_duration`, and the
        /// reasons `no_pour` and `several_pours`.
        name: String,
        /// Tilted further than this.
        above_deg: f64,
        /// Between two times above `above_deg` a tilt below this makes them two actions.
        same_above_deg: f64,
    },
    /// The object is away from where it starts, and not yet where it ends.
    Carry {
        /// See `Tilt`.
        name: String,
        /// Away further than this over the ground, m.
        radius_m: f64,
        /// The least distance over the ground between start and end, m.
        least_m: f64,
    },
}

impl Action {
    /// What people call it.
    pub fn name(&self) -> &str {
        match self {
            Self::Tilt { name, .. } | Self::Carry { name, .. } => name,
        }
    }
}

/// What a demonstration lasts.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SegmentRules {
    /// From when to when.
    pub during: During,
    /// Not longer than to the first tilt below this after the action; absent for all of it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub until_tilt_below_deg: Option<f64>,
}

/// What a recording shows all through a demonstration.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum During {
    /// The gripper holds the object, from closing to opening.
    #[default]
    Grasp,
    /// The tip moves, from the first time to the last; for recordings without a gripper.
    Motion,
}

/// A location of the task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Location {
    /// Name, which is also the name of the node's topic.
    pub name: String,
    /// Where the tip is then is what a motion achieves.
    pub at: At,
    /// A topic of points or poses in the base frame that says where it was in a recording; absent where
    /// the recorded motion itself says it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub topic: Option<String>,
    /// With `topic`: a recording whose motion is further off than this is none of the task, m.
    #[serde(default = "default_agreement")]
    pub agree_within_m: f64,
}

impl Location {
    /// The default of [`Self::agree_within_m`].
    pub const AGREE_WITHIN_M: f64 = 0.05;
}

fn default_agreement() -> f64 {
    Location::AGREE_WITHIN_M
}

/// When the tip is at a location.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum At {
    /// In the first state.
    Start,
    /// On average over the time of the action.
    Action,
    /// In the last state.
    End,
}

impl ManipulationTask {
    /// Checks what no type can say.
    ///
    /// # Errors
    /// The first setting that can't be.
    pub fn check(&self) -> Result<(), TaskSettingError> {
        let error = |name, value: &dyn std::fmt::Display, expected| {
            Err(TaskSettingError { name, value: value.to_string(), expected })
        };
        // Names become those of topics, parameters and columns.
        let is_name = |name: &str| {
            name.starts_with(|c: char| c.is_ascii_lowercase())
                && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
        };
        const NAME: &str = "lower-case letters, digits and underscores, a letter first";
        for (setting, name) in [("name", self.name.as_str()), ("action.name", self.action.name())] {
            if !is_name(name) {
                return error(setting, &name, NAME);
            }
        }
        if !(4..=10_000).contains(&self.steps) {
            return error("steps", &self.steps, "from 4 to 10000");
        }
        if let Some(angle) = self.reference_rpy_deg.iter().find(|a| !a.is_finite()) {
            return error("reference_rpy_deg", angle, "three finite angles");
        }
        let [a, b, c] = self.thresholds_m;
        if !(0.0 < a && a < b && b < c && c.is_finite()) {
            return error("thresholds_m", &format!("[{a}, {b}, {c}]"), "above 0, and ascending");
        }
        self.check_action()?;
        if !(1..=16).contains(&self.locations.len()) {
            return error("locations", &self.locations.len(), "1 to 16 locations");
        }
        for (i, Location { name, topic, agree_within_m, at: _ }) in
            self.locations.iter().enumerate()
        {
            if !is_name(name) {
                return error("locations.name", name, NAME);
            }
            if self.locations[..i].iter().any(|other| other.name == *name) {
                return error("locations.name", name, "another than those before it");
            }
            if topic.as_ref().is_some_and(|topic| !topic.starts_with('/')) {
                let topic = topic.as_deref().unwrap_or_default();
                return error(
                    "locations.topic",
                    &topic,
                    "a topic's full name, which begins with /",
                );
            }
            if !(*agree_within_m > 0.0 && agree_within_m.is_finite()) {
                return error("locations.agree_within_m", agree_within_m, "above 0");
            }
        }
        let factors = self.factor_names();
        for (i, name) in self.manner.iter().enumerate() {
            if !factors.contains(name) || self.manner[..i].contains(name) {
                let value = format!("{name} (the factors are {})", factors.join(", "));
                return error("manner", &value, "a factor of the task, each once");
            }
        }
        self.recording.check()?;
        self.validity.check()?;
        self.augmentation.check()
    }

    fn check_action(&self) -> Result<(), TaskSettingError> {
        let error = |name, value: f64, expected| {
            Err(TaskSettingError { name, value: value.to_string(), expected })
        };
        let until = self.segment.until_tilt_below_deg;
        match self.action {
            Action::Tilt { above_deg, same_above_deg, .. } => {
                let until = until.unwrap_or(same_above_deg);
                if !(0.0 < until
                    && until <= same_above_deg
                    && same_above_deg <= above_deg
                    && above_deg < 180.0)
                {
                    let expected = "below 180, and not below same_above_deg, which is not below \
                                    segment.until_tilt_below_deg, which is above 0";
                    return error("action.above_deg", above_deg, expected);
                }
            }
            Action::Carry { radius_m, least_m, .. } => {
                if !(radius_m > 0.0 && least_m >= 2.0 * radius_m && least_m.is_finite()) {
                    let expected = "above 0, and at most half of least_m";
                    return error("action.radius_m", radius_m, expected);
                }
                if let Some(until) = until {
                    let expected = "absent, as an object that is carried is not tilted";
                    return error("segment.until_tilt_below_deg", until, expected);
                }
            }
        }
        Ok(())
    }

    /// Where the states' rotation vectors are measured from.
    pub fn state_frame(&self) -> StateFrame {
        let [roll, pitch, yaw] = self.reference_rpy_deg.map(f64::to_radians);
        StateFrame { reference: UnitQuaternion::from_euler_angles(roll, pitch, yaw) }
    }

    /// The task of the mirrored arm: the same motions, mirrored in the xz plane; none for a task without that
    /// symmetry.
    pub fn mirrored(&self) -> Option<Self> {
        let [roll, pitch, yaw] = self.reference_rpy_deg;
        let workspace_y_m = self.validity.workspace_y_m.mirrored();
        (self.symmetry == Symmetry::Xz).then(|| Self {
            reference_rpy_deg: [-roll, pitch, -yaw],
            validity: Bounds { workspace_y_m, ..self.validity.clone() },
            ..self.clone()
        })
    }

    /// The locations, each with the interval of the workspace.
    pub fn task_space(&self) -> TaskSpace {
        let location = |location: &Location| TaskLocation {
            name: location.name.clone(),
            x: self.validity.workspace_x_m,
            y: self.validity.workspace_y_m,
        };
        let locations = self.locations.iter().map(location).collect();
        TaskSpace::new("m", locations).expect("names that differ and finite intervals")
    }

    /// What a reason for leaving a recording out is called in this task: `no_pour`.
    pub fn reason_name(&self, reason: Reason) -> String {
        Self::reason_of(self.action.name(), reason)
    }

    /// What a reason for leaving a recording out is called where the action has this name.
    pub(super) fn reason_of(action: &str, reason: Reason) -> String {
        match reason {
            Reason::NoAction => format!("no_{action}"),
            Reason::SeveralActions => format!("several_{action}s"),
            other => other.to_string(),
        }
    }

    /// Topics beside joint states and grippers that recordings of the task need: those that tell locations,
    /// and that of a marker.
    pub fn topics(&self) -> impl Iterator<Item = &str> {
        let marker = match &self.recording.cut_at {
            CutAt::Marker(topic) => Some(topic.as_str()),
            CutAt::Grasps | CutAt::Pauses => None,
        };
        self.locations.iter().filter_map(|location| location.topic.as_deref()).chain(marker)
    }

    /// Tilt beyond which the action happens; none for an action that is no tilt.
    pub fn tilt_threshold_deg(&self) -> Option<f64> {
        match self.action {
            Action::Tilt { above_deg, .. } => Some(above_deg),
            Action::Carry { .. } => None,
        }
    }

    /// What is missing of the action in a motion without one.
    fn lacking(&self, reached: f64) -> String {
        let name = self.action.name();
        match self.action {
            Action::Tilt { above_deg, .. } => {
                format!(
                    "the tilt reaches {reached:.0} of the {above_deg} degrees that are a {name}"
                )
            }
            Action::Carry { least_m, .. } => {
                format!("it is carried {reached:.3} m of the {least_m} m that are a {name}")
            }
        }
    }

    /// When the action starts and ends, in steps and fractions of them; none where it does not happen.
    pub(super) fn action_steps(&self, motion: &Motion) -> Option<[f64; 2]> {
        let profile = self.profile(motion);
        profile.actions.first().map(|action| [action.start(), action.end()])
    }

    /// Names of the task's factors, in their order.
    pub fn factor_names(&self) -> Vec<String> {
        self.measures().into_iter().map(|measure| measure.name.into_owned()).collect()
    }

    /// When the action starts, how long it lasts, how far it tilts, how long all of it takes, how high
    /// above the start it is, and how the hand is held.
    fn measures(&self) -> Vec<Measure> {
        let action = self.action.name();
        let tilts = matches!(self.action, Action::Tilt { .. });
        let measure = |name: &'static str, unit, phrase: &'static str, of| Measure {
            name: name.into(),
            unit,
            phrase: phrase.into(),
            of,
        };
        let mut measures = vec![
            Measure {
                name: format!("{action}_start").into(),
                unit: "s",
                phrase: format!("until the {action} starts").into(),
                of: |profile, motion| profile.actions[0].start() * motion.step_secs(),
            },
            Measure {
                name: format!("{action}_duration").into(),
                unit: "s",
                phrase: format!("of the {action}").into(),
                of: |profile, motion| profile.action_steps() * motion.step_secs(),
            },
        ];
        if tilts {
            let of: MeasureOf = |profile, _| profile.maximum_tilt_deg();
            measures.push(measure("maximum_tilt", "degrees", "of largest tilt", of));
        }
        let of: MeasureOf = |_, motion| motion.duration_secs;
        measures.push(measure(DURATION, "s", "from start to end", of));
        measures.push(Measure {
            name: "lift".into(),
            unit: "m",
            phrase: format!("above the start during the {action}").into(),
            of: |profile, _| profile.lift_m(),
        });
        if tilts {
            let phrase = "from rolling to where it is carried (0) to pitching ahead (90)";
            measures.push(measure("style", "degrees", phrase, |profile, _| profile.style_deg()));
        }
        let of: MeasureOf = |profile, _| profile.heading_deg();
        measures.push(measure("heading", "degrees", "of the hand's heading", of));
        let of: MeasureOf = |profile, _| profile.first().translation.z;
        measures.push(measure("grasp_height", "m", "of the height at the start", of));
        measures
    }
}

/// The time of all of a motion, of which its parts are most.
const DURATION: &str = "duration";

type MeasureOf = fn(&Profile, &Motion) -> f64;

/// How a factor is measured, of a motion with an action.
struct Measure {
    name: Cow<'static, str>,
    unit: &'static str,
    phrase: Cow<'static, str>,
    of: MeasureOf,
}

impl Task for ManipulationTask {
    fn name(&self) -> &str {
        &self.name
    }

    fn task_space(&self) -> TaskSpace {
        Self::task_space(self)
    }

    /// `G(x)`: for each location the tip's `(x, y)` in the first state, in the last, or on average over
    /// the time of the action.
    fn empirical_task(&self, motion: &Motion) -> Result<TaskParameters, TaskMeasureError> {
        let profile = self.profile(motion);
        if !profile.has_action() {
            return Err(TaskMeasureError { detail: self.lacking(profile.reached()) });
        }
        let place = |location: &Location| {
            let place = match location.at {
                At::Start => profile.first().translation.vector,
                At::Action => profile.mean_position_in_action(),
                At::End => profile.last().translation.vector,
            };
            [place.x, place.y]
        };
        TaskParameters::new(&self.task_space(), self.locations.iter().flat_map(place).collect())
            .map_err(|e| TaskMeasureError { detail: e.to_string() })
    }

    fn violations(&self, motion: &Motion) -> Vec<Violation> {
        self.validity.violations(&self.profile(motion), self, motion)
    }

    /// The start and the end of the action.
    fn events(&self, motion: &Motion) -> Vec<f64> {
        let profile = self.profile(motion);
        let last = (motion.states.steps() - 1) as f64;
        let events = profile.actions.first().map(|a| [a.start() / last, a.end() / last]);
        events
            .filter(|[start, end]| 0.0 < *start && start < end && *end < 1.0)
            .into_iter()
            .flatten()
            .collect()
    }

    fn mirrored(&self) -> Option<Box<dyn Task>> {
        Self::mirrored(self).map(|task| Box::new(task) as Box<dyn Task>)
    }

    fn factors(&self, motion: &Motion) -> Vec<Factor> {
        let profile = self.profile(motion);
        if !profile.has_action() {
            return Vec::new();
        }
        let factor = |Measure { name, unit, phrase, of }: Measure| Factor {
            value: of(&profile, motion),
            derived: name == DURATION,
            name,
            unit,
            phrase,
        };
        self.measures().into_iter().map(factor).collect()
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::demonstrations::recording::{ArmRecording, Exclusion};
    use crate::demonstrations::{TaskConfig, pouring};
    use crate::pose::STATE_DIM;
    use crate::trajectory::Trajectory;
    use nalgebra::Isometry3;
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
            states: pouring::task().state_frame().trajectory(&poses),
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
        let w = pouring::task().empirical_task(&rolled(&one_pour(80.0), 0.1)).unwrap();
        for (value, expected) in w.values().iter().zip([0.6, 0.05, 0.6, 0.0]) {
            assert!((value - expected).abs() < 1e-9, "{w:?}");
        }
    }

    #[test]
    fn factors_are_read_at_the_crossings() {
        let factors = pouring::task().factors(&rolled(&one_pour(80.0), 0.1));
        let values: Vec<_> = factors.iter().map(|f| f.value).collect();
        assert_eq!(values.len(), 8);
        for (value, expected) in values.iter().zip([3.75, 2.5, 80.0, 9.9, 0.15]) {
            assert!((value - expected).abs() < 1e-9, "{factors:?}");
        }
    }

    #[test]
    fn a_tilt_of_61_degrees_is_no_pour_and_says_so() {
        let motion = rolled(&one_pour(61.0), 0.1);
        let task = pouring::task();
        let error = task.empirical_task(&motion).unwrap_err();
        assert_eq!(error.to_string(), "the tilt reaches 61 of the 70 degrees that are a pour");
        assert!(names(&task.violations(&motion)).contains(&"action.above_deg"));
        assert!(task.factors(&motion).is_empty());
    }

    #[test]
    fn bounds_that_break_are_named_with_their_numbers() {
        let task = pouring::task();
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
        assert_eq!(
            names(&task.violations(&rolled(&twice, 0.065))),
            ["actions", "action_start_secs"]
        );
    }

    /// What an arm with a 100 Hz recording shows: the gripper holds the cup in these frames.
    fn arm(tilts_deg: &[f64], closed: &[[usize; 2]]) -> ArmRecording {
        let motion = rolled(tilts_deg, 0.01);
        let frames = tilts_deg.len();
        let is_closed = |i: usize| closed.iter().any(|c| (c[0]..c[1]).contains(&i));
        let mut base_from_tip = pouring::task().state_frame().poses(&motion.states);
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
            percent_open: Some(
                (0..frames).map(|i| if is_closed(i) { 4.0 } else { 97.0 }).collect(),
            ),
        }
    }

    /// [`one_pour`] over 1000 frames.
    fn slow_pour(top: f64) -> Vec<f64> {
        let at = |i: f64| ((i - 200.0) / 200.0).min((800.0 - i) / 200.0).clamp(0.0, 1.0);
        (0..1000).map(|i| top * at(f64::from(i))).collect()
    }

    fn excluded(tilts_deg: &[f64], closed: &[[usize; 2]]) -> Exclusion {
        pouring::task().segment(&arm(tilts_deg, closed)).unwrap_err()
    }

    #[test]
    fn a_segment_lasts_from_the_closing_to_the_first_tilt_below_20_degrees() {
        let segment = pouring::task().segment(&arm(&slow_pour(80.0), &[[100, 950]])).unwrap();
        assert!((segment.start_secs - 1.0).abs() < 1e-9);
        assert!((segment.action_start_secs - 3.75).abs() < 1e-6, "{}", segment.action_start_secs);
        assert!((segment.action_end_secs - 6.25).abs() < 1e-6);
        assert!((7.49..7.52).contains(&segment.end_secs), "{}", segment.end_secs);
        assert_eq!(segment.motion.states.steps(), 100);
        let w = pouring::task().empirical_task(&segment.motion).unwrap();
        assert!((w.values()[1] - 0.05).abs() < 1e-4, "{w:?}");
        assert!((w.values()[3] - 0.01).abs() < 1e-9);
    }

    #[test]
    fn an_open_gripper_neither_grasps_nor_pours() {
        let exclusion = excluded(&slow_pour(80.0), &[]);
        assert_eq!(exclusion.reason, Reason::NoGrasp);
        assert!(exclusion.detail.contains("97 %"), "{exclusion}");
        // Tilted with the gripper open, then a grasp without a tilt.
        assert_eq!(excluded(&slow_pour(80.0), &[[850, 990]]).reason, Reason::NoAction);
        assert_eq!(excluded(&slow_pour(80.0), &[[0, 950]]).reason, Reason::NoGrasp);
    }

    #[test]
    fn each_reason_comes_with_its_number() {
        let exclusion = excluded(&slow_pour(61.0), &[[100, 950]]);
        assert_eq!(
            exclusion.to_string(),
            "no_action: left arm: the tilt reaches 61 of the 70 degrees that are a pour"
        );
        let exclusion = excluded(&slow_pour(80.0), &[[100, 700]]);
        assert_eq!(exclusion.reason, Reason::Incomplete);
        assert!(exclusion.detail.contains("40 degrees"), "{exclusion}");
        let twice: Vec<_> = slow_pour(80.0).into_iter().chain(slow_pour(80.0)).collect();
        let exclusion = excluded(&twice, &[[100, 1900]]);
        assert_eq!(exclusion.reason, Reason::SeveralActions);
        assert!(exclusion.detail.contains("at 3.8 s, 13.8 s"), "{exclusion}");
        // With the cup put down in between, too.
        assert_eq!(excluded(&twice, &[[100, 900], [1000, 1900]]).reason, Reason::SeveralActions);
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
        let segment = pouring::task().segment(&arm(&with_dip(60.0), &[[100, 950]])).unwrap();
        assert!((segment.action_end_secs - 6.25).abs() < 1e-6);
        assert_eq!(excluded(&with_dip(45.0), &[[100, 950]]).reason, Reason::SeveralActions);
    }

    #[test]
    fn a_flicker_of_the_gripper_is_neither_a_grasp_nor_a_release() {
        let mut arm = arm(&slow_pour(80.0), &[[100, 950]]);
        let open = arm.percent_open.as_mut().unwrap();
        open[30] = 0.0;
        open[500] = 100.0;
        let segment = pouring::task().segment(&arm).unwrap();
        assert!((segment.start_secs - 1.0).abs() < 1e-9);
    }

    fn task_of(text: &str) -> TaskConfig {
        toml::from_str(text).unwrap()
    }

    #[test]
    fn the_shipped_pouring_is_the_built_in_one() {
        let file = task_of(include_str!("../../../config/tasks/pour.toml"));
        assert_eq!(file, TaskConfig::Manipulation(pouring::task()));
    }

    #[test]
    fn shipped_tasks_can_be_and_a_key_that_no_task_has_is_refused() {
        for text in [
            include_str!("../../../config/tasks/pour.toml"),
            include_str!("../../../config/tasks/stack.toml"),
            include_str!("../../../config/tasks/arcs.toml"),
        ] {
            assert_eq!(task_of(text).check(), Ok(()));
            let wrong = format!("pour_tilt = 70\n{text}");
            assert!(toml::from_str::<TaskConfig>(&wrong).is_err());
        }
    }

    #[test]
    fn settings_that_can_not_be_are_refused_by_name() {
        assert_eq!(pouring::task().check(), Ok(()));
        let text = include_str!("../../../config/tasks/pour.toml");
        for (from, to, said) in [
            ("steps = 100", "steps = 1", "steps is 1; it must be from 4 to 10000"),
            (
                "\"pour_location\"",
                "'source_cup'",
                "locations.name is source_cup; it must be another",
            ),
            (
                "\"pour_location\"",
                "'Pour here'",
                "locations.name is Pour here; it must be lower-case",
            ),
            ("name = \"pour\"", "name = ''", "action.name is ; it must be lower-case"),
            (
                "above_deg = 70.0",
                "above_deg = nan",
                "action.above_deg is NaN; it must be below 180",
            ),
            (
                "below_deg = 20.0",
                "below_deg = 60",
                "action.above_deg is 70; it must be below 180, and",
            ),
            ("[0.0, -90.0, 160.0]", "[0, inf, 0]", "reference_rpy_deg is inf; it must be three"),
            (
                "[0.01, 0.02",
                "[0.02, 0.02",
                "thresholds_m is [0.02, 0.02, 0.05]; it must be above 0",
            ),
            (
                "\"lift\"",
                "\"speed\"",
                "manner is speed (the factors are pour_start, pour_duration, ",
            ),
            (
                "workspace_x_m = { lower = 0.40, upper = 0.95 }",
                "workspace_x_m = { lower = 1.0, upper = 0.0 }",
                "validity.workspace_x_m is [1, 0]; it must be finite",
            ),
            (
                "max_sink_m = 0.02",
                "max_sink_m = nan",
                "validity.max_sink_m is NaN; it must be finite",
            ),
            (
                "jump_rad = 1.0",
                "jump_rad = 0",
                "recording.jump_rad is 0; it must be finite and above",
            ),
            (
                "weight_noise = 0.004",
                "weight_noise = -1.0",
                "augmentation.weight_noise is -1; it must be from 0 to 0.9",
            ),
            (
                "max_stretch = 0.15",
                "max_stretch = 1.5",
                "augmentation.max_stretch is 1.5; it must be",
            ),
            ("max_move_m = 0.15", "max_move_m = nan", "augmentation.max_move_m is NaN; it must be"),
        ] {
            assert!(text.contains(from), "{from}");
            let error = task_of(&text.replacen(from, to, 1)).check().unwrap_err().to_string();
            assert!(error.starts_with(said), "{error}");
        }
    }

    /// The shipped task of stacking.
    pub(in crate::demonstrations) fn stacking() -> ManipulationTask {
        let TaskConfig::Manipulation(task) =
            task_of(include_str!("../../../config/tasks/stack.toml"))
        else {
            panic!("stacking is a manipulation")
        };
        task
    }

    /// A block that is lifted by 15 cm until step 20 of 100, carried by 30 cm along y until step 70 at
    /// one speed, and lowered by 10 cm in the end.
    pub(in crate::demonstrations) fn one_stack() -> Motion {
        let upright = UnitQuaternion::from_euler_angles(0.0, -90_f64.to_radians(), 0.0);
        let pose = |i: i32| {
            let share = |from: f64, to: f64| ((f64::from(i) - from) / (to - from)).clamp(0.0, 1.0);
            let z = 0.15 * share(0.0, 20.0) - 0.10 * share(75.0, 99.0);
            Isometry3::from_parts([0.6, 0.3 * share(20.0, 70.0), z].into(), upright)
        };
        let poses: Vec<_> = (0..100).map(pose).collect();
        Motion { states: stacking().state_frame().trajectory(&poses), duration_secs: 9.9 }
    }

    #[test]
    fn a_stack_ends_where_it_is_put_down_and_starts_where_it_was_taken() {
        let (task, motion) = (stacking(), one_stack());
        let w = task.empirical_task(&motion).unwrap();
        for (value, expected) in w.values().iter().zip([0.6, 0.3, 0.6, 0.0]) {
            assert!((value - expected).abs() < 1e-9, "{w:?}");
        }
        // 2 cm from either end of 30 cm in 5 s.
        let factors = task.factors(&motion);
        let expected = [("stack_start", 2.0 + 1.0 / 3.0), ("stack_duration", 13.0 / 3.0)];
        for (factor, (name, value)) in factors.iter().zip(expected) {
            assert!(factor.name == name && (factor.value - value).abs() < 1e-9, "{factor:?}");
        }
        assert_eq!(task.violations(&motion), []);
        assert_eq!(task.events(&motion).len(), 2);
    }

    #[test]
    fn a_block_that_is_dropped_or_pushed_in_is_no_valid_stack() {
        let (task, motion) = (stacking(), one_stack());
        let with_height = |of: &dyn Fn(usize, f64) -> f64| {
            let mut values = motion.states.values().to_vec();
            for (i, state) in values.chunks_exact_mut(STATE_DIM).enumerate() {
                state[2] = of(i, state[2]);
            }
            let states = Trajectory::new(STATE_DIM, values).unwrap();
            names(&task.violations(&Motion { states, ..motion.clone() }))
        };
        // It ends at the height that it was taken from: beside the other block, not on it.
        let beside = |i: usize, z: f64| if i > 75 { z - 0.05 * (i - 75) as f64 / 24.0 } else { z };
        assert_eq!(with_height(&beside), ["end_height_m"]);
        // It comes in at the height of its place.
        let pushed = |i: usize, z: f64| if i > 30 { z.min(0.05) } else { z };
        assert!(with_height(&pushed).contains(&"arrival_height_m"));
    }

    #[test]
    fn what_is_put_back_is_no_stack() {
        let task = stacking();
        let frame = task.state_frame();
        let mut poses = frame.poses(&one_stack().states);
        for pose in &mut poses {
            pose.translation.y *= 0.1;
        }
        let motion = Motion { states: frame.trajectory(&poses), duration_secs: 9.9 };
        let error = task.empirical_task(&motion).unwrap_err();
        assert_eq!(error.to_string(), "it is carried 0.030 m of the 0.1 m that are a stack");
        assert!(task.factors(&motion).is_empty() && task.events(&motion).is_empty());
        assert!(names(&task.violations(&motion)).contains(&"action.least_m"));
    }

    #[test]
    fn a_stack_that_is_never_released_is_incomplete() {
        let task = stacking();
        let poses = task.state_frame().poses(&one_stack().states);
        let arm = |open: &dyn Fn(usize) -> bool| ArmRecording {
            arm: "left".into(),
            times_secs: (0..poses.len()).map(|i| 0.1 * i as f64).collect(),
            positions: vec![vec![]; poses.len()],
            base_from_tip: poses.clone(),
            percent_open: Some(
                (0..poses.len()).map(|i| if open(i) { 100.0 } else { 0.0 }).collect(),
            ),
        };
        let segment = task.segment(&arm(&|i| !(3..=95).contains(&i))).unwrap();
        assert_eq!((segment.start_secs, segment.end_secs), (0.1 * 3.0, 0.1 * 95.0));
        let exclusion = task.segment(&arm(&|i| i < 3)).unwrap_err();
        assert_eq!(exclusion.reason, Reason::Incomplete);
        assert_eq!(task.reason_name(Reason::SeveralActions), "several_stacks");
    }

    #[test]
    fn without_a_gripper_a_demonstration_lasts_while_the_arm_moves() {
        let mut task = pouring::task();
        task.segment.during = During::Motion;
        let mut arm = arm(&slow_pour(80.0), &[[100, 950]]);
        arm.percent_open = None;
        // A joint that moves from 0.5 s to 9 s.
        let frames = arm.times_secs.len();
        arm.positions = (0..frames).map(|i| vec![0.003 * i.clamp(50, 900) as f64]).collect();
        let segment = task.segment(&arm).unwrap();
        assert!((segment.start_secs - 0.5).abs() < 0.1, "{}", segment.start_secs);
        assert!((segment.action_start_secs - 3.75).abs() < 1e-6);

        task.segment.during = During::Grasp;
        let exclusion = task.segment(&arm).unwrap_err();
        assert_eq!(exclusion.reason, Reason::Unreadable);
        assert!(exclusion.detail.contains("segment.during = \"motion\""), "{exclusion}");
        task.segment.during = During::Motion;
        arm.positions = vec![vec![0.0]; frames];
        let exclusion = task.segment(&arm).unwrap_err();
        assert_eq!(exclusion.reason, Reason::NoAction);
        assert!(exclusion.detail.contains("no joint moves faster than 0.03 rad/s"), "{exclusion}");
    }

    proptest! {
        #[test]
        fn the_task_moves_with_the_motion(
            x in -0.2..0.2f64, y in -0.2..0.2f64, top in 75.0..110.0f64,
        ) {
            let task = pouring::task();
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
            let task = pouring::task();
            let w = |top| task.empirical_task(&rolled(&one_pour(top), 0.1)).unwrap();
            let (a, b) = (w(top), w(top + 1e-6));
            prop_assert!((a.values()[1] - b.values()[1]).abs() < 1e-6);
        }
    }
}
