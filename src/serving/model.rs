//! What a server serves: a primitive with its task, on a robot.

use std::sync::Arc;

use crate::demonstrations::Task;
use crate::kinematics::{ArmDescription, Chain, CollisionRules, Hull, RobotRecord, RuleError};
use crate::parameters::{Interval, TaskSpace};
use crate::pose::StateFrame;
use crate::primitive::MannerConditioned;
use crate::serving::Familiarity;

/// A trained primitive and what its model file says of it.
#[derive(Debug)]
pub struct ServedModel {
    /// First 12 digits of the SHA-256 over what was learned.
    pub model_id: String,
    /// How it was learned, such as `TC-VAE` or `ProMP`.
    pub method: String,
    /// The primitive; its states are the 6-D states of [`crate::pose`].
    pub primitive: Box<dyn MannerConditioned + Send + Sync>,
    /// What the task measures of a motion.
    pub task: Box<dyn Task>,
    /// Where the states' rotation vectors are measured from.
    pub frame: StateFrame,
    /// How long motions take before they are slowed down (s): of a primitive that knows phases
    /// only, all of them; of others, the median.
    pub duration_secs: f64,
    /// The arm that the model was made for.
    pub robot: RobotRecord,
    /// The stored evaluation as JSON; `null` where there is none.
    pub evaluation_json: String,
    /// Whether the demonstrations were synthetic.
    pub synthetic_data: bool,
    /// Whether its motions are the mirror images of those that were learned, for the other arm.
    pub mirrored: bool,
    /// How far out tasks and manners lie.
    pub familiarity: Familiarity,
}

impl ServedModel {
    /// What the task parameters are.
    pub fn space(&self) -> &TaskSpace {
        self.primitive.task_space()
    }

    /// A task to try the model with, one `(x, y)` for each location: the most typical training
    /// task, or the middle of the trained region where the model has none.
    pub fn example_task(&self) -> Vec<[f64; 2]> {
        match self.familiarity.most_typical_task() {
            Some(w) => w.chunks(2).map(|xy| [xy[0], xy[1]]).collect(),
            None => {
                let middle = |i: Interval| 0.5 * (i.lower + i.upper);
                self.space().locations().iter().map(|l| [l.x, l.y].map(middle)).collect()
            }
        }
    }
}

/// An arm whose motions the robot's arm makes as their mirror images in the xz plane.
#[derive(Debug, Clone, PartialEq)]
pub struct OtherArm {
    /// Its joints, from the base to the tip.
    pub joint_names: Vec<String>,
    /// What each of its joints' positions is multiplied by.
    pub signs: Vec<f64>,
}

/// The arm that executes.
#[derive(Debug, Clone)]
pub struct Robot {
    /// Name of the robot.
    pub name: String,
    /// From the base frame to the tip.
    pub chain: Chain,
    /// What must stay apart.
    pub hull: Hull,
    /// Smallest distance that is left between what must stay apart (m).
    pub clearance_m: f64,
    /// Links whose shape is not known.
    pub unmodelled: Vec<String>,
    /// The arm of which this one is the mirror image; models that were made for it are served mirrored.
    pub mirrors: Option<OtherArm>,
    /// Joints that are not the arm's, each with a position to show it in.
    pub others: Vec<(String, f64)>,
    /// The description that all of it is from (URDF).
    pub description: Arc<str>,
}

impl Robot {
    /// The robot of a description under these rules.
    ///
    /// # Errors
    /// Rules that do not fit the description.
    pub fn new(
        arm: ArmDescription,
        rules: &CollisionRules,
        description: &str,
    ) -> Result<Self, RuleError> {
        let hull = arm.hull(rules)?;
        let ArmDescription { name, chain, unmodelled, others, .. } = arm;
        Ok(Self {
            name,
            chain,
            hull,
            clearance_m: rules.clearance_m,
            unmodelled,
            mirrors: None,
            others,
            description: description.into(),
        })
    }

    /// Whether nothing comes too near to anything at `q`.
    ///
    /// # Panics
    /// When `q` has not one value per joint.
    pub fn is_clear(&self, q: &[f64]) -> bool {
        self.hull.nearest_within(&self.chain, std::iter::once(q), self.clearance_m).is_none()
    }

    /// What keeps the arm from touching what, in a line for people.
    pub fn clearance(&self) -> String {
        const MOST_NAMES: usize = 4;
        let parts = self.hull.parts();
        let table = match self.hull.table_height_m() {
            Some(height) => format!("a table at z = {height} m"),
            None => "no table".to_owned(),
        };
        let mut text = match parts {
            0 => "no shapes, so that nothing keeps it off itself or a table".to_owned(),
            _ => format!("{parts} shapes, {} m off each other; {table}", self.clearance_m),
        };
        if let Some(first) = self.unmodelled.get(..MOST_NAMES.min(self.unmodelled.len()))
            && !first.is_empty()
        {
            text += &format!("; no shape of {}", first.join(", "));
            if let more @ 1.. = self.unmodelled.len() - first.len() {
                text += &format!(" and {more} more");
            }
        }
        text
    }
}
