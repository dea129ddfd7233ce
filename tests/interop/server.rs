//! A bare ros2-client server for the tests of `patches/`: no code of the node in between.
//!
//! It serves `/dds_probe/points` (`tcvae_msgs/srv/SampleTrajectory`) on loopback: one sample whose
//! joint trajectory has as many points as the request's `count` says, seven joints each. It says
//! `ready` when it serves, and leaves cleanly on SIGINT.

use futures::StreamExt;
use rustdds::DomainParticipantBuilder;
use std::net::Ipv4Addr;
use tcvae::ros::messages::builtin_interfaces::Duration;
use tcvae::ros::messages::tcvae_msgs::{Sample, SampleTrajectoryRequest, SampleTrajectoryResponse};
use tcvae::ros::messages::trajectory_msgs::{JointTrajectory, JointTrajectoryPoint};

/// A reply whose every number tells where it belongs, so that the client can check all of them.
fn reply(points: u32) -> SampleTrajectoryResponse {
    let point = |index: u32| JointTrajectoryPoint {
        positions: (0..7).map(|joint| f64::from(index) + f64::from(joint) / 8.0).collect(),
        velocities: (0..7).map(|joint| -f64::from(index) - f64::from(joint) / 8.0).collect(),
        time_from_start: Duration::from_secs_f64(f64::from(index + 1) * 0.125),
        ..Default::default()
    };
    let joint_trajectory = JointTrajectory {
        joint_names: (0..7).map(|joint| format!("joint_{joint}")).collect(),
        points: (0..points).map(point).collect(),
        ..Default::default()
    };
    SampleTrajectoryResponse {
        samples: vec![Sample { joint_trajectory, ..Default::default() }],
        model_id: "dds_probe".into(),
        ..Default::default()
    }
}

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    use ros2_client::qos::{Durability, History, WhenFull};
    use ros2_client::{Context, Name, NodeName, NodeOptions, QosProfile, ServiceTypeName};

    env_logger::init();
    let domain = std::env::var("ROS_DOMAIN_ID")?.parse()?;
    let participant =
        DomainParticipantBuilder::new(domain).with_only_networks([Ipv4Addr::LOCALHOST]).build()?;
    let context = Context::from_domain_participant(participant)?;
    let mut node = context.new_node(NodeName::new("/", "dds_probe")?, NodeOptions::new())?;
    let qos = QosProfile::publisher_default()
        .reliability_reliable(WhenFull::DEFAULT)
        .durability(Durability::Volatile)
        .history(History::KeepLast { depth: 10 });
    let server = node.create_server::<SampleTrajectoryRequest, SampleTrajectoryResponse>(
        ros2_client::ServiceMapping::Enhanced,
        &Name::new("/dds_probe", "points")?,
        &ServiceTypeName::new("tcvae_msgs", "SampleTrajectory"),
        qos.clone(),
        qos,
    )?;
    let spinner = tokio::spawn(node.spinner()?.spin());
    println!("ready");

    let serve = async {
        let mut requests = server.receive_request_stream();
        while let Some(request) = requests.next().await {
            let (id, request) = request?;
            server.async_send_response(id, reply(request.count)).await?;
        }
        anyhow::Ok(())
    };
    tokio::select! {
        served = serve => served?,
        interrupted = tokio::signal::ctrl_c() => interrupted?,
    }
    // The node tells its spinner to stop; when that no longer holds the participant, the context's
    // end tells the others.
    drop(node);
    let _ = spinner.await;
    Ok(())
}
