//! The state and the rules of the node, without any I/O: which task is asked for, which manner is
//! set, and which motions may leave.
//!
//! A motion leaves only as a [`Sample`], and a [`Sample`] is made only by
//! [`PrimitiveServer::sample`], after every check.

mod refusal;
mod request;

pub use refusal::{ErrorCode, Refusal};
pub use request::{
    Description, GivenLocation, MAX_COUNT, RankBy, Sample, SampleReply, SampleRequest,
};

mod settings;

pub use settings::{MannerMode, OutOfDistribution, Settings};
