//! The node's ROS 2 side: command line, names, parameters, messages, and the wiring of topics and
//! services to the [server](crate::serving).

pub mod arguments;
pub mod environment;
pub mod log;
pub mod messages;
pub mod names;
pub mod parameters;
pub mod participant;
pub mod yaml;
