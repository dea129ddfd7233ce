//! The least that a node on the same stack as ours can do, for `latency.py`: a goal in, a trajectory out whose bytes
//! are made beforehand.
//!
//! It hears `/echo/goal_pose`, publishes `/echo/joint_trajectory` with the node's QoS, and says `ready`.

use tcvae::ros::environment::Environment;
use tcvae::ros::messages::builtin_interfaces::Duration;
use tcvae::ros::messages::geometry_msgs::PoseStamped;
use tcvae::ros::messages::trajectory_msgs::{JointTrajectory, JointTrajectoryPoint};
use tcvae::ros::names::NodeNames;
use tcvae::ros::participant;
use tcvae::ros::wiring::{Wiring, each, reliable};

/// As many bytes as the node's: 100 points of 7 joints, with velocities and accelerations.
fn trajectory() -> JointTrajectory {
    let point = |index: i32| JointTrajectoryPoint {
        positions: vec![0.5; 7],
        velocities: vec![0.5; 7],
        accelerations: vec![0.5; 7],
        time_from_start: Duration { sec: index + 1, nanosec: 0 },
        ..Default::default()
    };
    JointTrajectory {
        joint_names: (0..7).map(|joint| format!("left_{joint}")).collect(),
        points: (0..100).map(point).collect(),
        ..Default::default()
    }
}

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let environment = Environment::read(|name| std::env::var(name).ok())?;
    let context = participant::join(&environment)?;
    let names = NodeNames::new("echo", &[])?;
    let mut wiring = Wiring::new(&context, names, environment.service_mapping)?;
    let kind = ("trajectory_msgs", "JointTrajectory");
    let publisher = wiring.publisher("~/joint_trajectory", kind, reliable(1))?;
    let goals =
        wiring.subscription("~/goal_pose", ("geometry_msgs", "PoseStamped"), reliable(10))?;
    let answer = trajectory();
    println!("ready");
    let echo = each(goals, move |_: PoseStamped| {
        if let Err(e) = publisher.publish(answer.clone()) {
            eprintln!("{e}");
        }
    });
    tokio::select! {
        () = echo => {}
        interrupted = tokio::signal::ctrl_c() => interrupted?,
    }
    Ok(())
}
