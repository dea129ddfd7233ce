//! Kinematics of one arm: where its joints put the tip, and which joints put the tip there.
//!
//! A [`Chain`] comes from a robot description (the `urdf` module reads one). [`Chain::forward`] and
//! [`Chain::jacobian`] go from joints to the tip; [`inverse`] goes back for one pose.

mod chain;
mod forward;

pub mod inverse;

pub use chain::{Chain, ChainError, Joint, JointKind};
