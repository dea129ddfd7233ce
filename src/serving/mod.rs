//! The state and the rules of the node, without any I/O: which task is asked for, which manner is
//! set, and which motions may leave.
//!
//! A motion leaves only as a [`Sample`], and a [`Sample`] is made only by
//! [`PrimitiveServer::sample`], after every check: the empirical task parameters of the motion as
//! the joints execute it are within tolerance (the paper's `G`, eq. 15), every joint stays inside
//! its limits, between the points too, steps no further than its velocity allows, the arm touches neither
//! itself nor the table, and the motion is valid.

mod approach;
mod familiarity;
mod mirrored;
mod model;
mod motion;
mod refusal;
mod request;
mod server;
mod settings;

pub use familiarity::Familiarity;
pub use model::{OtherArm, Robot, ServedModel};
pub use refusal::{ErrorCode, Refusal};
pub use request::{
    Description, GivenLocation, MAX_COUNT, RankBy, Sample, SampleReply, SampleRequest,
};
pub use server::PrimitiveServer;
pub use settings::{MannerMode, OutOfDistribution, SPEEDS, Settings, StartPolicy};
