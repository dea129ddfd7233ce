//! The node's ROS 2 side: command line, names, parameters, messages, and the wiring of topics and
//! services to the [server](crate::serving).

pub mod arguments;
pub mod banner;
pub mod convert;
pub mod delays;
pub mod doctor;
pub mod environment;
pub mod goals;
pub mod interfaces;
pub mod lane;
pub mod lifecycle;
pub mod log;
pub mod markers;
pub mod messages;
pub mod mismatch;
pub mod names;
pub mod node;
pub mod parameters;
pub mod participant;
pub mod recorder;
pub mod state;
pub mod tf;
pub mod wiring;
pub mod yaml;
