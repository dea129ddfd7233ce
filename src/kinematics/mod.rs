//! Kinematics of one arm: where its joints put the tip, which joints put the tip on a path, and how
//! fast the arm may go along it.
//!
//! A [`Chain`] comes from a robot description (the `urdf` module reads one). [`Chain::forward`] and
//! [`Chain::jacobian`] go from joints to the tip; [`inverse`] goes back for one pose and
//! [`following`] for a whole path, clear of what a [`Hull`] says it must not touch; [`timing`] gives joint positions times and velocities that the
//! arm can keep.

mod chain;
mod clearance;
mod description;
mod forward;
mod record;

pub mod following;
pub mod inverse;
pub mod timing;

pub use chain::{Chain, ChainError, Joint, JointKind, Mimic};
pub use clearance::{Capsule, Contact, Hull, Nearest};
pub use description::{
    ArmDescription, CollisionRules, JointLimits, LinkPlace, PartRule, RuleError,
};
pub use record::{RecordMismatch, RobotRecord};
