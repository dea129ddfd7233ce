//! Pouring, the paper's task (section 5.2), in the terms of [`super::manipulation`].
//!
//! The cup's axis is the tip-frame direction that points up when the cup is grasped, and its tilt
//! the angle between that axis and the vertical. The cup pours while the tilt is above 70 degrees.
//! A demonstration lasts from the gripper closing on the cup to the first tilt below 20 degrees
//! after the pour. Its task parameters are where the tip is on average while it pours, and where
//! it was at the grasp: `w = (x_c, y_c, x_s, y_s)` in the base frame.

use super::augmentation::Augmentation;
use super::manipulation::{
    Action, At, Bounds, During, Location, ManipulationTask, SegmentRules, Symmetry,
};
use super::recording::RecordingRules;
use crate::parameters::Interval;

/// The pouring task (`config/tasks/pour.toml`). Each bound of validity is that of the simulated
/// demonstrations, widened by about 15 %.
pub fn task() -> ManipulationTask {
    let location = |name: &str, at| Location {
        name: name.into(),
        at,
        topic: None,
        agree_within_m: Location::AGREE_WITHIN_M,
    };
    let within = |lower, upper| Interval { lower, upper };
    ManipulationTask {
        name: "pouring".into(),
        steps: 100,
        reference_rpy_deg: [0.0, -90.0, 160.0],
        thresholds_m: [0.01, 0.02, 0.05],
        symmetry: Symmetry::Xz,
        manner: ["pour_start", "pour_duration", "maximum_tilt", "lift", "heading", "grasp_height"]
            .map(String::from)
            .to_vec(),
        action: Action::Tilt { name: "pour".into(), above_deg: 70.0, same_above_deg: 50.0 },
        segment: SegmentRules { during: During::Grasp, until_tilt_below_deg: Some(20.0) },
        locations: vec![location("pour_location", At::Action), location("source_cup", At::Start)],
        recording: RecordingRules::default(),
        validity: Bounds {
            action_start_secs: Some(within(2.4, 8.0)),
            action_duration_secs: Some(within(1.0, 6.9)),
            duration_secs: Some(within(4.4, 13.5)),
            max_tilt_deg: Some(130.0),
            max_end_tilt_deg: Some(25.0),
            lift_m: Some(within(0.08, 0.27)),
            end_height_m: None,
            arrival_height_m: None,
            max_sink_m: Some(0.02),
            workspace_x_m: within(0.40, 0.95),
            workspace_y_m: within(-0.20, 0.75),
            workspace_z_m: within(-0.20, 0.40),
            max_speed_m_per_s: Some(0.8),
            max_turn_deg_per_s: Some(180.0),
            max_acceleration_m_per_s2: Some(3.5),
        },
        augmentation: Augmentation::default(),
    }
}
