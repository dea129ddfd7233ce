//! Writes spoilt messages to everything that a node hears, one end after the other.
//!
//!     garbler NODE COUNT SEED SEEDS [NAME]...
//!
//! `NODE` is the node's full name; `COUNT` messages go to each of its subscriptions and services, except to those that
//! end with a `NAME`. `SEEDS` is the folder of sound messages, `fuzz/seeds/node`, whose names tell where they go; an
//! end without one gets random bytes alone. It prints a line of JSON: how many messages went to each topic of DDS.

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context as _, ensure};
use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};
use rustdds::bytes::Bytes;
use rustdds::no_key::{DataWriter, SerializerAdapter};
use rustdds::policy::{Durability, History, Reliability};
use rustdds::{DomainParticipant, QosPolicyBuilder, RepresentationIdentifier, TopicKind};
use tcvae::ros::environment::Environment;
use tcvae::ros::participant;

/// Bytes as they are.
struct Raw;

impl SerializerAdapter<Bytes> for Raw {
    type Error = Infallible;

    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }

    fn to_bytes(value: &Bytes) -> Result<Bytes, Infallible> {
        Ok(value.clone())
    }
}

/// The topics that the node hears, and their types.
fn heard(participant: &DomainParticipant, node: &str) -> BTreeMap<String, String> {
    let readers = participant.discovered_readers();
    let topics = readers.iter().map(|reader| &reader.subscription_topic_data);
    let named = topics.map(|topic| (topic.topic_name().clone(), topic.type_name().clone()));
    let common = ["rt/joint_states", "rt/tf", "rt/tf_static", "rt/clock", "ros_discovery_info"];
    let is_its = |topic: &str| {
        let inner = topic.get(2..).is_some_and(|rest| rest.starts_with(node));
        (inner && !topic.starts_with("rr")) || common.contains(&topic)
    };
    named.filter(|(topic, _)| is_its(topic)).collect()
}

/// The name of the seed for a topic: `rq/tcvae/sampleRequest` has `sample`.
fn seed_name(topic: &str, node: &str) -> String {
    let path = topic.get(2..).unwrap_or_default();
    let path = path.strip_prefix(node).unwrap_or(path).trim_start_matches('/');
    let path = match topic.starts_with("rq") {
        true => path.strip_suffix("Request").unwrap_or(path),
        false => path,
    };
    path.replace("_action/", "").replace('/', "_")
}

/// A few bytes changed, cut short, made longer, or replaced.
fn spoilt(good: &[u8], chance: &mut ChaCha8Rng) -> Bytes {
    let mut data = good.to_vec();
    match chance.random_range(0..6) {
        0 => data = (0..chance.random_range(0..200)).map(|_| chance.random()).collect(),
        1 => data.truncate(chance.random_range(0..=data.len())),
        2 => data.extend((0..chance.random_range(1..100)).map(|_| chance.random::<u8>())),
        _ => {
            for _ in 0..chance.random_range(1..6) {
                if data.is_empty() {
                    break;
                }
                let at = chance.random_range(0..data.len());
                let any = chance.random();
                data[at] = [0, 1, 0x7f, 0x80, 0xff, any][chance.random_range(0..6)];
            }
        }
    }
    data.into()
}

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [node, count, seed, seeds, spared @ ..] = arguments.as_slice() else {
        anyhow::bail!("garbler NODE COUNT SEED SEEDS [NAME]...");
    };
    let (count, mut chance) = (count.parse::<u64>()?, ChaCha8Rng::seed_from_u64(seed.parse()?));
    let participant = participant::enter(&Environment::read(|name| std::env::var(name).ok())?)?;
    let publisher = participant.create_publisher(&QosPolicyBuilder::new().build())?;

    // Discovery comes in pieces; it is over when nothing has come for a second.
    let (mut topics, mut since, began) = (BTreeMap::new(), Instant::now(), Instant::now());
    while topics.is_empty() || since.elapsed() < Duration::from_secs(1) {
        ensure!(began.elapsed() < Duration::from_secs(20), "there is no {node}");
        std::thread::sleep(Duration::from_millis(50));
        let now = heard(&participant, node);
        if now != topics {
            (topics, since) = (now, Instant::now());
        }
    }
    topics.retain(|topic, _| {
        let name = topic.strip_suffix("Request").unwrap_or(topic);
        !spared.iter().any(|spared| name.ends_with(spared.as_str()))
    });
    let most = rustdds::Duration::from_secs(1);
    let qos = QosPolicyBuilder::new()
        .reliability(Reliability::Reliable { max_blocking_time: most })
        .durability(Durability::TransientLocal)
        .history(History::KeepLast { depth: 100 })
        .build();
    let mut told = serde_json::Map::new();
    for (name, kind) in topics {
        // An input of the fuzz target: an end, a length, and a message, of which four bytes tell its encoding.
        let path = Path::new(seeds).join(seed_name(&name, node));
        let good = std::fs::read(&path).map(|input| input[7..].to_vec()).unwrap_or_default();
        let topic = participant.create_topic(name.clone(), kind, &qos, TopicKind::NoKey)?;
        let writer: DataWriter<Bytes, Raw> = publisher.create_datawriter_no_key(&topic, None)?;
        std::thread::sleep(Duration::from_millis(200));
        let mut sent = 0_u64;
        for i in 0..count {
            let message = spoilt(&good, &mut chance);
            sent += u64::from(writer.write(message, None).is_ok());
            // No faster than the node takes them, as what it has no room for it never looks at.
            if i % 50 == 49 {
                let took = writer.wait_for_acknowledgments(Duration::from_secs(30));
                ensure!(took.context("the node")?, "{name}: not taken for 30 s");
            }
        }
        told.insert(name, sent.into());
    }
    println!("{}", serde_json::to_string(&told)?);
    Ok(())
}
