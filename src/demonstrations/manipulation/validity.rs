//! What a motion must be like to be a valid one of its task.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::profile::Profile;
use super::{Action, ManipulationTask};
use crate::demonstrations::task::{TaskSettingError, Violation};
use crate::parameters::Interval;
use crate::trajectory::Motion;

/// What a motion must be like to be valid; what is absent is not asked for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bounds {
    /// Time from the start to the action, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub action_start_secs: Option<Interval>,
    /// Time of the action, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub action_duration_secs: Option<Interval>,
    /// Time of the whole motion, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub duration_secs: Option<Interval>,
    /// Largest tilt of all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_tilt_deg: Option<f64>,
    /// Largest tilt that may be left at the end.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_end_tilt_deg: Option<f64>,
    /// Mean height of the tip above the start during the action, m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lift_m: Option<Interval>,
    /// Height of the tip at the end above the start, m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub end_height_m: Option<Interval>,
    /// Height of the tip above its end when the action ends, m: how far from above it comes down.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub arrival_height_m: Option<Interval>,
    /// How far the tip may sink below the start.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_sink_m: Option<f64>,
    /// Where the tip may be, m in the base frame.
    pub workspace_x_m: Interval,
    /// See `workspace_x_m`.
    pub workspace_y_m: Interval,
    /// See `workspace_x_m`.
    pub workspace_z_m: Interval,
    /// Largest speed of the tip between two states.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_speed_m_per_s: Option<f64>,
    /// Largest turning speed of the tip between two states.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_turn_deg_per_s: Option<f64>,
    /// Largest acceleration of the tip over three states.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_acceleration_m_per_s2: Option<f64>,
}

impl Bounds {
    pub(super) fn check(&self) -> Result<(), TaskSettingError> {
        let Self {
            action_start_secs,
            action_duration_secs,
            duration_secs,
            max_tilt_deg,
            max_end_tilt_deg,
            lift_m,
            end_height_m,
            arrival_height_m,
            max_sink_m,
            workspace_x_m,
            workspace_y_m,
            workspace_z_m,
            max_speed_m_per_s,
            max_turn_deg_per_s,
            max_acceleration_m_per_s2,
        } = *self;
        for (name, interval) in [
            ("validity.action_start_secs", action_start_secs),
            ("validity.action_duration_secs", action_duration_secs),
            ("validity.duration_secs", duration_secs),
            ("validity.lift_m", lift_m),
            ("validity.end_height_m", end_height_m),
            ("validity.arrival_height_m", arrival_height_m),
            ("validity.workspace_x_m", Some(workspace_x_m)),
            ("validity.workspace_y_m", Some(workspace_y_m)),
            ("validity.workspace_z_m", Some(workspace_z_m)),
        ] {
            if let Some(Interval { lower, upper }) = interval
                && !(lower.is_finite() && upper.is_finite() && lower <= upper)
            {
                let (value, expected) =
                    (format!("[{lower}, {upper}]"), "finite, the lower bound first");
                return Err(TaskSettingError { name, value, expected });
            }
        }
        for (name, value) in [
            ("validity.max_tilt_deg", max_tilt_deg),
            ("validity.max_end_tilt_deg", max_end_tilt_deg),
            ("validity.max_sink_m", max_sink_m),
            ("validity.max_speed_m_per_s", max_speed_m_per_s),
            ("validity.max_turn_deg_per_s", max_turn_deg_per_s),
            ("validity.max_acceleration_m_per_s2", max_acceleration_m_per_s2),
        ] {
            if let Some(value) = value
                && !(value >= 0.0 && value.is_finite())
            {
                let (value, expected) = (value.to_string(), "finite and not negative");
                return Err(TaskSettingError { name, value, expected });
            }
        }
        Ok(())
    }

    /// Every bound that a motion breaks.
    pub(super) fn violations(
        &self,
        profile: &Profile,
        task: &ManipulationTask,
        motion: &Motion,
    ) -> Vec<Violation> {
        let mut violations = Violations(Vec::new());
        let step_secs = motion.step_secs();
        let [start, end] = [profile.first(), profile.last()].map(|pose| pose.translation.z);
        let (maximum_tilt, end_tilt) =
            (profile.maximum_tilt_deg(), profile.tilts_deg[profile.tilts_deg.len() - 1]);
        violations.within("duration_secs", "s", motion.duration_secs, self.duration_secs);
        match profile.actions.first() {
            None => match task.action {
                Action::Tilt { above_deg, .. } => {
                    violations.at_least("action.above_deg", "degrees", maximum_tilt, above_deg);
                }
                Action::Carry { least_m, .. } => {
                    violations.at_least("action.least_m", "m", profile.reached(), least_m);
                }
            },
            Some(action) => {
                violations.at_most("actions", "times", profile.actions.len() as f64, Some(1.0));
                let start_secs = action.start() * step_secs;
                violations.within("action_start_secs", "s", start_secs, self.action_start_secs);
                let secs = profile.action_steps() * step_secs;
                violations.within("action_duration_secs", "s", secs, self.action_duration_secs);
                violations.within("lift_m", "m", profile.lift_m(), self.lift_m);
                let height = profile.position(action.end()).z - end;
                violations.within("arrival_height_m", "m", height, self.arrival_height_m);
            }
        }
        violations.at_most("max_tilt_deg", "degrees", maximum_tilt, self.max_tilt_deg);
        violations.at_most("max_end_tilt_deg", "degrees", end_tilt, self.max_end_tilt_deg);
        violations.within("end_height_m", "m", end - start, self.end_height_m);

        let positions: Vec<_> = profile.poses.iter().map(|p| p.translation.vector).collect();
        let [low, high] = [Vector3::inf, Vector3::sup]
            .map(|f| positions.iter().skip(1).fold(positions[0], |a, b| f(&a, b)));
        violations.at_most("max_sink_m", "m", start - low.z, self.max_sink_m);
        for (i, (name, interval)) in [
            ("workspace_x_m", self.workspace_x_m),
            ("workspace_y_m", self.workspace_y_m),
            ("workspace_z_m", self.workspace_z_m),
        ]
        .into_iter()
        .enumerate()
        {
            violations.at_least(name, "m", low[i], interval.lower);
            violations.at_most(name, "m", high[i], Some(interval.upper));
        }
        let largest = |values: &mut dyn Iterator<Item = f64>| values.fold(0.0, f64::max);
        let speed = largest(&mut positions.windows(2).map(|p| (p[1] - p[0]).norm() / step_secs));
        violations.at_most("max_speed_m_per_s", "m/s", speed, self.max_speed_m_per_s);
        let turn = largest(
            &mut profile
                .poses
                .windows(2)
                .map(|p| p[0].rotation.angle_to(&p[1].rotation).to_degrees() / step_secs),
        );
        violations.at_most("max_turn_deg_per_s", "degrees/s", turn, self.max_turn_deg_per_s);
        let acceleration = largest(
            &mut positions
                .windows(3)
                .map(|p| (p[2] - 2.0 * p[1] + p[0]).norm() / step_secs.powi(2)),
        );
        let limit = self.max_acceleration_m_per_s2;
        violations.at_most("max_acceleration_m_per_s2", "m/s2", acceleration, limit);
        violations.0
    }
}

/// Collects the bounds that are broken; a value that is not a number breaks each.
struct Violations(Vec<Violation>);

impl Violations {
    fn at_most(&mut self, bound: &'static str, unit: &'static str, value: f64, limit: Option<f64>) {
        if let Some(limit) = limit
            && (value > limit || value.is_nan())
        {
            self.0.push(Violation { bound, value, limit, unit });
        }
    }

    fn at_least(&mut self, bound: &'static str, unit: &'static str, value: f64, limit: f64) {
        if value < limit || value.is_nan() {
            self.0.push(Violation { bound, value, limit, unit });
        }
    }

    fn within(
        &mut self,
        bound: &'static str,
        unit: &'static str,
        value: f64,
        limits: Option<Interval>,
    ) {
        if let Some(Interval { lower, upper }) = limits {
            self.at_least(bound, unit, value, lower);
            self.at_most(bound, unit, value, Some(upper));
        }
    }
}
