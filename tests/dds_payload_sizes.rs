//! Messages of every size around the limits of `patches/0004-fragments-of-8192-bytes.patch` arrive.
//!
//! The receiver is rustdds, which drops a fragment that claims to be larger than its message.

#![cfg(feature = "ros")]

use futures::StreamExt;
use ros2_client::qos::{Durability, History, WhenFull};
use ros2_client::{Context, MessageTypeName, Name, Node, NodeName, NodeOptions, QosProfile};
use rustdds::DomainParticipantBuilder;
use std::net::Ipv4Addr;
use std::time::Duration;
use tcvae::ros::messages::std_msgs::Text;

const FRAGMENT_SIZE: usize = 8192;
const DATAGRAM: usize = 1452;

fn node(domain: u16, name: &str) -> Node {
    let participant = DomainParticipantBuilder::new(domain)
        .with_only_networks([Ipv4Addr::LOCALHOST])
        .build()
        .unwrap();
    let context = Context::from_domain_participant(participant).unwrap();
    context.new_node(NodeName::new("/", name).unwrap(), NodeOptions::new()).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn messages_of_every_size_arrive_whole() {
    // Tests of other processes run at the same time.
    let domain = u16::try_from(1 + std::process::id() % 100).unwrap();
    let mut sender = node(domain, "sender");
    let mut receiver = node(domain, "receiver");
    for node in [&mut sender, &mut receiver] {
        tokio::spawn(node.spinner().unwrap().spin());
    }
    let qos = QosProfile::publisher_default()
        .reliability_reliable(WhenFull::DEFAULT)
        .durability(Durability::TransientLocal)
        .history(History::KeepAll);
    let name = Name::new("/", "sizes").unwrap();
    let kind = MessageTypeName::new("std_msgs", "String");
    let topic = sender.create_topic(&name, kind.clone(), &qos).unwrap();
    let publisher = sender.create_publisher::<Text>(&topic, None).unwrap();
    let topic = receiver.create_topic(&name, kind, &qos).unwrap();
    let subscription = receiver.create_subscription::<Text>(&topic, None).unwrap();

    let sizes: Vec<usize> = (DATAGRAM - 140..DATAGRAM + 20)
        .step_by(4)
        .chain([2000, 5000])
        .chain(FRAGMENT_SIZE - 16..FRAGMENT_SIZE + 4)
        .chain([2 * FRAGMENT_SIZE, 2 * FRAGMENT_SIZE + 1, 100_000])
        .collect();
    for (index, size) in sizes.iter().enumerate() {
        let letter = char::from(b'a' + u8::try_from(index % 26).unwrap());
        publisher.publish(Text { data: letter.to_string().repeat(*size) }).unwrap();
    }
    let mut received = vec![];
    let mut messages = Box::pin(subscription.async_stream());
    while received.len() < sizes.len() {
        let next = tokio::time::timeout(Duration::from_secs(20), messages.next()).await;
        let next = next.unwrap_or_else(|_| panic!("only {received:?} of {sizes:?} arrived"));
        let (text, _) = next.unwrap().unwrap();
        let letter = char::from(b'a' + u8::try_from(received.len() % 26).unwrap());
        assert!(text.data.chars().all(|c| c == letter), "message {} is damaged", received.len());
        received.push(text.data.len());
    }
    assert_eq!(received, sizes);
}
