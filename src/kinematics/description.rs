//! An arm as a robot description has it, and what a person may add to it.

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Point3};
use serde::{Deserialize, Serialize};

use super::{Capsule, Chain, ChainError, Hull};

/// An arm with what is known of the robot around it.
#[derive(Debug, Clone)]
pub struct ArmDescription {
    /// Name of the robot.
    pub name: String,
    /// From the base frame to the tip.
    pub chain: Chain,
    /// Every link that stands still with the base or moves with one of the chain's joints.
    pub links: Vec<LinkPlace>,
    /// What there is of the robot's shape.
    pub parts: Vec<Capsule>,
    /// Joints of the robot that are not the arm's, each with a position inside its limits: 0 where that is one.
    pub others: Vec<(String, f64)>,
    /// Links with a shape that is not among the parts: meshes, and links behind joints of their own.
    pub unmodelled: Vec<String>,
}

/// Where a link is.
#[derive(Debug, Clone, PartialEq)]
pub struct LinkPlace {
    /// Name of the link.
    pub name: String,
    /// The body that it belongs to, as [`Capsule::body`].
    pub body: usize,
    /// The link in the frame of its body.
    pub body_from_link: Isometry3<f64>,
}

impl LinkPlace {
    /// The place of a link.
    pub fn new(name: &str, body: usize, body_from_link: Isometry3<f64>) -> Self {
        Self { name: name.into(), body, body_from_link }
    }
}

/// What an arm must not touch (`[collision]` in `config/robots/*.toml`).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CollisionRules {
    /// Smallest distance that is left between parts, and above the table (m).
    pub clearance_m: f64,
    /// Height of the table in the base frame (m); none where there is no table.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub table_height_m: Option<f64>,
    /// Pairs of links that may touch.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub ignore: Vec<[String; 2]>,
    /// Parts beside those of the description, such as a tool.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub parts: Vec<PartRule>,
}

impl Default for CollisionRules {
    fn default() -> Self {
        Self { clearance_m: 0.01, table_height_m: None, ignore: Vec::new(), parts: Vec::new() }
    }
}

/// A capsule on a link.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PartRule {
    /// The link.
    pub link: String,
    /// The ends of its segment in the link's frame (m); the same for a ball.
    pub from_m: [f64; 3],
    /// See `from_m`.
    pub to_m: [f64; 3],
    /// Radius (m).
    pub radius_m: f64,
}

/// Limits of one joint; those that are absent are the description's.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct JointLimits {
    /// Largest speed, rad/s or m/s; not above the description's.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub velocity: Option<f64>,
    /// Largest acceleration, rad/s² or m/s².
    #[serde(skip_serializing_if = "Option::is_none")]
    pub acceleration: Option<f64>,
    /// Largest jerk, rad/s³ or m/s³.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub jerk: Option<f64>,
}

/// Why what a person added does not fit.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RuleError {
    /// A value that is none.
    #[error("{name} is {value}; {expected}")]
    Value {
        /// The setting.
        name: String,
        /// Its value.
        value: f64,
        /// What it may be.
        expected: String,
    },
    /// A link that the arm does not have.
    #[error(
        "{setting} names the link {link:?}, which neither stands still with the base nor moves with the arm; \
         those that do: {known}"
    )]
    Link {
        /// The setting.
        setting: &'static str,
        /// The link.
        link: String,
        /// Links that there are, comma-separated.
        known: String,
    },
    /// Limits that make no chain.
    #[error(transparent)]
    Chain(#[from] ChainError),
}

impl ArmDescription {
    /// The hull of the arm under these rules.
    ///
    /// # Errors
    /// A distance or radius that is none, a link that is not there.
    pub fn hull(&self, rules: &CollisionRules) -> Result<Hull, RuleError> {
        let finite = |name: &str, value: f64, fits: bool, expected: &str| match fits {
            true => Ok(()),
            false => Err(RuleError::Value { name: name.into(), value, expected: expected.into() }),
        };
        let clearance = rules.clearance_m;
        let fits = (0.0..=1.0).contains(&clearance);
        finite("collision.clearance_m", clearance, fits, "0 to 1 m are possible")?;
        if let Some(height) = rules.table_height_m {
            finite("collision.table_height_m", height, height.is_finite(), "it must be finite")?;
        }
        for [a, b] in &rules.ignore {
            self.place("collision.ignore", a)?;
            self.place("collision.ignore", b)?;
        }
        let mut parts = self.parts.clone();
        for part in &rules.parts {
            let place = self.place("collision.parts", &part.link)?;
            let radius = part.radius_m;
            let fits = radius.is_finite() && radius > 0.0;
            finite("collision.parts.radius_m", radius, fits, "it must be above 0")?;
            for value in part.from_m.into_iter().chain(part.to_m) {
                finite("collision.parts", value, value.is_finite(), "it must be finite")?;
            }
            let [from, to] =
                [part.from_m, part.to_m].map(|end| place.body_from_link * Point3::from(end));
            parts.push(Capsule { link: part.link.clone(), body: place.body, from, to, radius });
        }
        Ok(Hull::new(&self.chain, parts, &rules.ignore, rules.table_height_m))
    }

    /// The arm with further limits of its joints; those of other joints have no effect.
    ///
    /// # Errors
    /// A limit that is not above 0, or a velocity above the description's.
    pub fn with_limits(
        mut self,
        limits: &BTreeMap<String, JointLimits>,
    ) -> Result<Self, RuleError> {
        for joint in self.chain.joints() {
            if let Some(velocity) = limits.get(&joint.name).and_then(|limits| limits.velocity)
                && velocity > joint.velocity
            {
                return Err(RuleError::Value {
                    name: format!("the velocity limit of {}", joint.name),
                    value: velocity,
                    expected: format!(
                        "the description allows {}, and a limit can only be lower",
                        joint.velocity
                    ),
                });
            }
        }
        self.chain = self.chain.with_limits(limits)?;
        Ok(self)
    }

    fn place(&self, setting: &'static str, link: &str) -> Result<&LinkPlace, RuleError> {
        self.links.iter().find(|place| place.name == link).ok_or_else(|| {
            let known: Vec<_> = self.links.iter().map(|place| &*place.name).collect();
            RuleError::Link { setting, link: link.into(), known: known.join(", ") }
        })
    }
}
