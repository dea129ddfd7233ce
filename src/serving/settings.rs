//! What an operator sets, and keeps until set again: the node's parameters.

use crate::serving::{ErrorCode, Refusal};

/// Where the manner comes from when a request does not say.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum MannerMode {
    /// The values that are set; the prior's mean at start.
    #[default]
    Fixed,
    /// A draw from the prior for every sample.
    Prior,
}

/// What happens to a task outside the trained region.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum OutOfDistribution {
    /// It is refused.
    #[default]
    Reject,
    /// It is served with a warning, if it passes the checks.
    Warn,
}

/// What happens where the arm is not at the first point of a motion.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum StartPolicy {
    /// It is brought there first.
    #[default]
    Approach,
    /// The motion is refused, and so it is where nobody knows where the arm is.
    Refuse,
    /// The motion begins at its first point all the same.
    Ignore,
}

/// The slowest and the fastest that a motion is made, as a multiple of what was learned.
pub const SPEEDS: [f64; 2] = [0.1, 4.0];

/// The settings of a server.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// Largest distance between a location and where the executed motion puts it (m).
    pub tolerance_m: f64,
    /// Oldest task that is served (s); 0 means any age.
    pub max_age_secs: f64,
    /// Where the manner comes from.
    pub manner_mode: MannerMode,
    /// Seed of every random draw; each request with seed 0 starts from it.
    pub seed: u64,
    /// Draws per sample before it is refused.
    pub max_tries: u32,
    /// Share of the joints' velocity limits that may be used, in (0, 1].
    pub velocity_scale: f64,
    /// Share of the joints' acceleration limits that may be used, in (0, 1].
    pub acceleration_scale: f64,
    /// How many times as fast as it was learned a motion is made, where the limits allow it.
    pub speed: f64,
    /// What happens to a task outside the trained region.
    pub out_of_distribution: OutOfDistribution,
    /// What happens where the arm is not at the first point.
    pub start_policy: StartPolicy,
    /// Largest distance of a joint from the first point that is none (rad).
    pub start_tolerance_rad: f64,
    /// Oldest joint states that tell where the arm is (s).
    pub start_max_age_secs: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            tolerance_m: 0.02,
            max_age_secs: 0.0,
            manner_mode: MannerMode::default(),
            seed: 1,
            max_tries: 20,
            velocity_scale: 1.0,
            acceleration_scale: 1.0,
            speed: 1.0,
            out_of_distribution: OutOfDistribution::default(),
            start_policy: StartPolicy::default(),
            start_tolerance_rad: 0.05,
            start_max_age_secs: 1.0,
        }
    }
}

impl Settings {
    /// The settings, if every number is inside its range.
    ///
    /// # Errors
    /// [`ErrorCode::BadRequest`] with the name, the value and the range.
    pub fn checked(self) -> Result<Self, Refusal> {
        let ranges = [
            ("task.tolerance_m", self.tolerance_m, 1e-4, 1.0),
            ("task.max_age_s", self.max_age_secs, 0.0, 1e9),
            ("sample.max_tries", f64::from(self.max_tries), 1.0, 1000.0),
            ("limits.velocity_scale", self.velocity_scale, 0.01, 1.0),
            ("limits.acceleration_scale", self.acceleration_scale, 0.01, 1.0),
            ("sample.speed", self.speed, SPEEDS[0], SPEEDS[1]),
            ("start.tolerance_rad", self.start_tolerance_rad, 0.0, 3.2),
            ("start.max_age_s", self.start_max_age_secs, 0.01, 3600.0),
        ];
        for (name, value, lower, upper) in ranges {
            if !(lower..=upper).contains(&value) {
                return Err(Refusal::new(
                    ErrorCode::BadRequest,
                    format!("{name} = {value} is outside [{lower}, {upper}]; the old value stays"),
                ));
            }
        }
        Ok(self)
    }
}
