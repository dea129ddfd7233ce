//! The messages on the wire: serde structs whose fields follow the `.msg`, `.srv` and `.action`
//! definitions in name, type and order, as CDR needs them.
//!
//! Two tests hold them: every struct encodes random messages to the same bytes as rclpy
//! (`tests/golden/messages.json`, made by `tests/golden/messages.py`), and its fields are those
//! of the definition, for `tcvae_msgs` read from `msg/tcvae_msgs` itself.
//!
//! One module per ROS package. Of `rcl_interfaces` and `action_msgs`, ros2-client's own types
//! serve where it has them. Units are ROS's: metres, radians, seconds, quaternions as (x, y, z, w).

mod actions;
mod standard;
pub mod tcvae_msgs;

pub use actions::{action_msgs, control_msgs};
pub use standard::{
    builtin_interfaces, diagnostic_msgs, geometry_msgs, lifecycle_msgs, nav_msgs, rcl_interfaces,
    sensor_msgs, std_msgs, std_srvs, tf2_msgs, trajectory_msgs, type_description_interfaces,
    visualization_msgs,
};

/// Marks structs as messages for ros2-client.
macro_rules! messages {
    ($($name:ident),* $(,)?) => { $(impl ros2_client::Message for $name {})* };
}
use messages;

#[cfg(test)]
mod tests;
