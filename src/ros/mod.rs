//! The node's ROS 2 side.

pub mod messages;
