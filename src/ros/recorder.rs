//! Topics as they are on the graph, for recording: names and types known when the program runs, messages as
//! the bytes that came.
//!
//! Each publisher is heard by a reader that asks for what it offers: reliable delivery from those that send
//! again what was lost, and what was sent before from those that keep it. One reader can't ask for both: a
//! publisher that offers less than its reader asks for is not heard at all. What two readers hear is one
//! message, by its publisher's number; a number that nobody heard is a message that was lost.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use futures::{FutureExt, StreamExt};
use ros2_client::builtin_topics::ros_discovery;
use ros2_client::entities_info::{NodeEntitiesInfo, ParticipantEntitiesInfo};
use ros2_client::{Gid, NodeName};
use rustdds::no_key::{
    DataWriterCdr, Decode, DefaultDecoder, DeserializerAdapter, SimpleDataReader,
};
use rustdds::policy::{Durability, History, Reliability};
use rustdds::{
    CDRDeserializerAdapter, DomainParticipant, GUID, QosPolicies, QosPolicyBuilder, RTPSEntity,
    RepresentationIdentifier, Subscriber, Timestamp, TopicKind,
};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::{Interval, MissedTickBehavior};

use super::environment::Environment;
use super::messages::sensor_msgs::JointState;
use super::names::NodeNames;
use super::participant::{self, ParticipantError};

/// Messages that a reader keeps. At 1 kHz these are a second.
const DEPTH: i32 = 1000;
/// The same of a type whose messages may be large, as images are.
const DEPTH_OF_LARGE: i32 = 64;
/// KiB of messages that wait to be written. With more than that readers wait, and then lose.
const WAITING_KIB: u32 = 64 << 10;
/// How often the graph is looked at.
const LOOK: Duration = Duration::from_millis(100);
/// How far back a message can come a second time, in numbers of its publisher.
const REMEMBERED: i64 = 4 * DEPTH as i64;

/// Why nothing can be recorded.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecorderError {
    /// No way onto the network.
    #[error(transparent)]
    Participant(#[from] ParticipantError),
    /// The DDS library refused.
    #[error("can't listen to {what}: {reason}")]
    Refused {
        /// The topic.
        what: String,
        /// What the library says.
        reason: String,
    },
}

/// A topic that is asked for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Wanted {
    /// Its absolute name, such as `/joint_states`.
    pub name: String,
    /// Its type, such as `sensor_msgs/msg/JointState`; without one, that of its first publisher.
    pub type_name: Option<String>,
}

/// How a publisher offers its messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Offer {
    /// Whether messages that are lost are sent again.
    pub reliable: bool,
    /// Whether who joins late receives the latest.
    pub transient_local: bool,
}

/// A message as it came.
#[derive(Debug)]
pub struct Heard {
    /// Which of the topics that were asked for.
    pub topic: usize,
    /// When it was received, since the epoch.
    pub received_nanos: u64,
    /// When it was sent, since the epoch; as the publisher's clock says, where it says.
    pub sent_nanos: Option<u64>,
    /// The publisher's number for it, from 1.
    pub number: i64,
    /// CDR, with its four bytes ahead.
    pub data: Vec<u8>,
    publisher: GUID,
    /// Its share of what may wait.
    room: Option<OwnedSemaphorePermit>,
}

/// A topic, and what was heard of it so far.
#[derive(Debug, Clone)]
pub struct Topic {
    /// Its absolute name.
    pub name: String,
    /// Its type, where it is known.
    pub type_name: Option<String>,
    /// How the publishers that are there offer it, one for each.
    pub offers: Vec<Offer>,
    /// Types of publishers that are not heard, since it is another one.
    pub other_types: BTreeSet<String>,
    /// Messages.
    pub messages: u64,
    publishers: BTreeMap<GUID, Numbers>,
    readers: BTreeSet<Offer>,
}

impl Topic {
    /// Messages that were sent meanwhile and did not come.
    pub fn lost(&self) -> u64 {
        self.publishers.values().map(Numbers::lost).sum()
    }
}

/// The numbers of a publisher's messages that were heard.
#[derive(Debug, Clone, Default)]
struct Numbers {
    first: i64,
    last: i64,
    count: u64,
    recent: BTreeSet<i64>,
}

impl Numbers {
    /// Whether a number is heard for the first time.
    fn hear(&mut self, number: i64) -> bool {
        // What is further back than numbers are remembered was heard, or is older than the first.
        let forgotten = self.first..=self.last.saturating_sub(REMEMBERED);
        if (self.count > 0 && forgotten.contains(&number)) || !self.recent.insert(number) {
            return false;
        }
        while self.recent.len() as i64 > REMEMBERED {
            self.recent.pop_first();
        }
        if self.count == 0 {
            (self.first, self.last) = (number, number);
        }
        self.first = self.first.min(number);
        self.last = self.last.max(number);
        self.count += 1;
        true
    }

    fn lost(&self) -> u64 {
        match self.count {
            0 => 0,
            count => self.last.abs_diff(self.first).saturating_add(1).saturating_sub(count),
        }
    }
}

/// Bytes as they come.
struct Raw;

#[derive(Clone)]
struct RawDecoder;

impl DeserializerAdapter<Vec<u8>> for Raw {
    type Error = std::convert::Infallible;
    type Decoded = Vec<u8>;

    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        &[RepresentationIdentifier::CDR_LE, RepresentationIdentifier::CDR_BE]
    }

    fn transform_decoded(decoded: Vec<u8>) -> Vec<u8> {
        decoded
    }
}

impl Decode<'_, Vec<u8>> for RawDecoder {
    type Error = std::convert::Infallible;

    fn decode_bytes(
        self,
        bytes: &[u8],
        encoding: RepresentationIdentifier,
    ) -> Result<Vec<u8>, Self::Error> {
        let little_endian = u8::from(encoding == RepresentationIdentifier::CDR_LE);
        let mut data = Vec::with_capacity(4 + bytes.len());
        data.extend([0, little_endian, 0, 0]);
        data.extend(bytes);
        Ok(data)
    }
}

impl DefaultDecoder<Vec<u8>> for Raw {
    type Decoder = RawDecoder;
    const DECODER: RawDecoder = RawDecoder;
}

/// Listens on the graph. Dropping it takes it off the graph.
pub struct Recorder {
    topics: Vec<Topic>,
    heard: mpsc::UnboundedReceiver<Heard>,
    sender: mpsc::UnboundedSender<Heard>,
    room: Arc<Semaphore>,
    stop: watch::Sender<bool>,
    readers: JoinSet<()>,
    look: Interval,
    presence: Presence,
    subscriber: Subscriber,
    // Last, so that it outlives everything that communicates.
    participant: DomainParticipant,
}

/// What tells others which node the readers belong to.
struct Presence {
    participant: Gid,
    node: NodeEntitiesInfo,
    writer: DataWriterCdr<ParticipantEntitiesInfo>,
}

impl Presence {
    fn tell(&self) {
        let info = ParticipantEntitiesInfo::new(self.participant, vec![self.node.clone()]);
        // Others see readers without a node where this is lost.
        let _ = self.writer.write(info, Some(Timestamp::now()));
    }
}

impl Recorder {
    /// Joins the graph and listens to the topics whose types are known. It needs a tokio runtime.
    ///
    /// # Errors
    /// No way onto the network; the library's refusal.
    pub fn start(
        environment: &Environment,
        names: &NodeNames,
        topics: Vec<Wanted>,
    ) -> Result<Self, RecorderError> {
        let participant = participant::enter(environment)?;
        let refused =
            |what: &str, reason: String| RecorderError::Refused { what: what.into(), reason };
        let this = format!("the graph as {names}");
        let of_this = |reason: String| refused(&this, reason);
        let subscriber = participant
            .create_subscriber(&QosPolicies::qos_none())
            .map_err(|e| of_this(e.to_string()))?;
        let presence = presence(&participant, names).map_err(of_this)?;
        presence.tell();
        let (sender, heard) = mpsc::unbounded_channel();
        let mut look = tokio::time::interval(LOOK);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let topics = topics.into_iter().map(|Wanted { name, type_name }| Topic {
            name,
            type_name,
            offers: Vec::new(),
            other_types: BTreeSet::new(),
            messages: 0,
            publishers: BTreeMap::new(),
            readers: BTreeSet::new(),
        });
        let mut recorder = Self {
            topics: topics.collect(),
            heard,
            sender,
            room: Arc::new(Semaphore::new(WAITING_KIB as usize)),
            stop: watch::Sender::new(false),
            readers: JoinSet::new(),
            look,
            presence,
            subscriber,
            participant,
        };
        // Most publishers are reliable; these are heard from their first message.
        let usual = Offer { reliable: true, transient_local: false };
        for topic in 0..recorder.topics.len() {
            if recorder.topics[topic].type_name.is_some() {
                recorder.listen(topic, usual)?;
            }
        }
        Ok(recorder)
    }

    /// The topics, in the order in which they were asked for.
    pub fn topics(&self) -> &[Topic] {
        &self.topics
    }

    /// Other topics that have publishers, with their types.
    pub fn others(&self) -> BTreeSet<(String, String)> {
        let wanted = |name: &str| self.topics.iter().any(|topic| topic.name == name);
        self.publishers()
            .into_iter()
            .map(|(_, name, type_name, _)| (name, type_name))
            .filter(|(name, _)| !wanted(name))
            .collect()
    }

    /// The next message; waits until there is one. Nothing is lost where it is not waited for to the end.
    ///
    /// # Errors
    /// A topic that appeared can't be listened to.
    pub async fn next(&mut self) -> Result<Heard, RecorderError> {
        loop {
            let heard = tokio::select! {
                biased;
                _ = self.look.tick() => {
                    self.look_at_graph()?;
                    continue;
                }
                heard = self.heard.recv() => heard.expect("the recorder has a sender itself"),
            };
            if !self.topics[heard.topic].publishers.contains_key(&heard.publisher) {
                // So that who reads the first message knows how its publisher offers it.
                self.look_at_graph()?;
            }
            if self.is_new(&heard) {
                return Ok(heard);
            }
        }
    }

    /// Listens no more; what came until now and was not handed out, but for what is beyond `most`.
    pub async fn stop(&mut self, most: u64) -> Vec<Heard> {
        self.stop.send_replace(true);
        let mut rest = Vec::new();
        loop {
            tokio::select! {
                biased;
                Some(mut heard) = self.heard.recv() => {
                    // Nobody waits for it to be written.
                    heard.room = None;
                    rest.push(heard);
                }
                ended = self.readers.join_next() => if ended.is_none() { break },
            }
        }
        while let Ok(heard) = self.heard.try_recv() {
            rest.push(heard);
        }
        rest.retain({
            let mut left = most;
            move |heard| {
                let wanted = left > 0 && self.is_new(heard);
                left -= u64::from(wanted);
                wanted
            }
        });
        rest
    }

    fn is_new(&mut self, heard: &Heard) -> bool {
        let topic = &mut self.topics[heard.topic];
        let new = topic.publishers.entry(heard.publisher).or_default().hear(heard.number);
        topic.messages += u64::from(new);
        new
    }

    /// Listens to publishers that have appeared.
    fn look_at_graph(&mut self) -> Result<(), RecorderError> {
        let publishers = self.publishers();
        for index in 0..self.topics.len() {
            let topic = &mut self.topics[index];
            topic.offers.clear();
            for (_, name, type_name, offer) in &publishers {
                if *name != topic.name {
                    continue;
                }
                if topic.type_name.get_or_insert_with(|| type_name.clone()) != type_name {
                    topic.other_types.insert(type_name.clone());
                } else {
                    topic.offers.push(*offer);
                }
            }
            let new: BTreeSet<Offer> =
                topic.offers.iter().filter(|o| !topic.readers.contains(o)).copied().collect();
            for offer in new {
                self.listen(index, offer)?;
            }
        }
        Ok(())
    }

    /// All publishers of topics of ROS: name, type and offer of each.
    fn publishers(&self) -> Vec<(GUID, String, String, Offer)> {
        let of_ros = |writer: rustdds::discovery::DiscoveredWriterData| {
            let data = writer.publication_topic_data;
            let name = data.topic_name.strip_prefix("rt")?.to_owned();
            let offer = Offer {
                reliable: matches!(data.reliability, Some(Reliability::Reliable { .. })),
                transient_local: data.durability.is_some_and(|d| d != Durability::Volatile),
            };
            Some((data.key, name, ros_type(&data.type_name)?, offer))
        };
        self.participant.discovered_writers().into_iter().filter_map(of_ros).collect()
    }

    /// Makes a reader that asks for this.
    fn listen(&mut self, index: usize, offer: Offer) -> Result<(), RecorderError> {
        let Topic { name, type_name, readers, .. } = &mut self.topics[index];
        let depth = depth(type_name.as_deref().unwrap_or_default());
        let Some(type_name) = type_name.as_deref().and_then(dds_type) else { return Ok(()) };
        let refused = |reason: String| RecorderError::Refused { what: name.clone(), reason };
        let qos = QosPolicyBuilder::new()
            .history(History::KeepLast { depth })
            .durability(match offer.transient_local {
                true => Durability::TransientLocal,
                false => Durability::Volatile,
            })
            .reliability(match offer.reliable {
                true => Reliability::Reliable { max_blocking_time: rustdds::Duration::ZERO },
                false => Reliability::BestEffort,
            })
            .build();
        let topic = self
            .participant
            .create_topic(format!("rt{name}"), type_name, &qos, TopicKind::NoKey)
            .map_err(|e| refused(e.to_string()))?;
        let reader = self
            .subscriber
            .create_simple_datareader_no_key::<Vec<u8>, Raw>(&topic, Some(qos))
            .map_err(|e| refused(e.to_string()))?;
        readers.insert(offer);
        self.presence.node.add_reader(Gid::from(reader.guid()));
        self.presence.tell();
        let way = Way {
            topic: index,
            sender: self.sender.clone(),
            room: Arc::clone(&self.room),
            stop: self.stop.subscribe(),
        };
        self.readers.spawn(read(reader, way));
        Ok(())
    }
}

/// Where a reader's messages go, and until when.
struct Way {
    topic: usize,
    sender: mpsc::UnboundedSender<Heard>,
    room: Arc<Semaphore>,
    stop: watch::Receiver<bool>,
}

/// Hands out what a reader hears until it is told to stop, and then what has come.
async fn read(reader: SimpleDataReader<Vec<u8>, Raw>, way: Way) {
    let Way { topic, sender, room, mut stop } = way;
    let mut messages = Box::pin(reader.as_async_stream());
    loop {
        let message = tokio::select! {
            biased;
            message = messages.next() => message,
            _ = stop.wait_for(|stop| *stop) => match messages.next().now_or_never() {
                Some(message) => message,
                None => return,
            },
        };
        match message {
            Some(Ok(message)) => {
                let kib = u32::try_from(message.sample.len() / 1024 + 1).unwrap_or(WAITING_KIB);
                let room = Arc::clone(&room).acquire_many_owned(kib.min(WAITING_KIB)).await;
                let heard = Heard {
                    topic,
                    received_nanos: nanos(message.receive_instant),
                    sent_nanos: message.source_timestamp().map(nanos).filter(|nanos| *nanos > 0),
                    number: i64::from(message.sequence_number),
                    publisher: message.writer_guid,
                    data: message.into_value(),
                    room: room.ok(),
                };
                if sender.send(heard).is_err() {
                    return;
                }
            }
            // Its number stays away, so that it counts as lost.
            Some(Err(e)) => log::debug!("a message that can't be read: {e}"),
            None => return,
        }
    }
}

fn presence(participant: &DomainParticipant, names: &NodeNames) -> Result<Presence, String> {
    let text = |e: &dyn std::fmt::Display| e.to_string();
    let node = NodeName::new(names.namespace(), names.name()).map_err(|e| text(&e))?;
    let qos = &*ros_discovery::QOS_PUB;
    let topic = participant
        .create_topic(
            ros_discovery::TOPIC_NAME.into(),
            ros_discovery::TYPE_NAME.into(),
            qos,
            TopicKind::NoKey,
        )
        .map_err(|e| text(&e))?;
    let publisher = participant.create_publisher(qos).map_err(|e| text(&e))?;
    let writer: DataWriterCdr<ParticipantEntitiesInfo> =
        publisher.create_datawriter_no_key(&topic, None).map_err(|e| text(&e))?;
    let mut node = NodeEntitiesInfo::new(node);
    node.add_writer(Gid::from(writer.guid()));
    Ok(Presence { participant: Gid::from(participant.guid()), node, writer })
}

/// How many messages of a type a reader keeps.
fn depth(type_name: &str) -> i32 {
    match type_name.split('/').next() {
        Some("geometry_msgs" | "std_msgs" | "tf2_msgs") => DEPTH,
        _ if type_name == "sensor_msgs/msg/JointState" => DEPTH,
        _ => DEPTH_OF_LARGE,
    }
}

/// `sensor_msgs::msg::dds_::JointState_` as `sensor_msgs/msg/JointState`; none for what is no message of ROS.
fn ros_type(dds: &str) -> Option<String> {
    let (package, name) = dds.split_once("::msg::dds_::")?;
    Some(format!("{package}/msg/{}", name.strip_suffix('_')?))
}

/// The way back.
fn dds_type(ros: &str) -> Option<String> {
    let (package, name) = ros.split_once("/msg/")?;
    Some(format!("{package}::msg::dds_::{name}_"))
}

/// The names of the joints in a `sensor_msgs/msg/JointState`; none where it can't be read.
///
/// # Arguments
/// * `data`: CDR, with its four bytes ahead
pub fn joint_names(data: &[u8]) -> Option<Vec<String>> {
    let encoding = match data {
        [0, 0, ..] => RepresentationIdentifier::CDR_BE,
        [0, 1, ..] => RepresentationIdentifier::CDR_LE,
        _ => return None,
    };
    let message = CDRDeserializerAdapter::<JointState>::from_bytes(data.get(4..)?, encoding);
    message.ok().map(|message| message.name)
}

/// Nanoseconds since the epoch, of RTPS's fractions of 2^-32 s.
fn nanos(time: Timestamp) -> u64 {
    let ticks = u128::from(time.to_ticks());
    ((ticks * 1_000_000_000 + (1 << 31)) >> 32) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn types_are_named_as_ros_users_know_them_and_back() {
        let dds = "sensor_msgs::msg::dds_::JointState_";
        assert_eq!(ros_type(dds).as_deref(), Some("sensor_msgs/msg/JointState"));
        assert_eq!(dds_type("sensor_msgs/msg/JointState").as_deref(), Some(dds));
        assert_eq!(ros_type("ShapeType"), None);
        assert_eq!(ros_type("a::srv::dds_::B_Request_"), None);
    }

    #[test]
    fn a_number_counts_once_and_those_that_stay_away_are_lost() {
        let mut numbers = Numbers::default();
        let heard: Vec<_> = [5, 6, 8, 6, 7, 11].map(|n| numbers.hear(n)).into();
        assert_eq!(heard, [true, true, true, false, true, true]);
        assert_eq!(numbers.lost(), 2); // 9 and 10
        // What was sent before comes late where a publisher keeps it.
        assert!(numbers.hear(4) && !numbers.hear(4));
        assert_eq!(numbers.lost(), 2);
    }

    #[test]
    fn numbers_need_no_more_memory_in_a_long_recording() {
        let mut numbers = Numbers::default();
        for n in 1..=3 * REMEMBERED {
            assert!(numbers.hear(n));
        }
        assert_eq!(numbers.recent.len() as i64, REMEMBERED);
        assert!(!numbers.hear(1) && !numbers.hear(3 * REMEMBERED));
        assert_eq!(numbers.lost(), 0);
    }

    #[test]
    fn times_are_those_of_the_publisher_to_the_nanosecond() {
        for expected in [1_u64, 999_999_999, 1_795_397_557_123_456_789] {
            let seconds = u128::from(expected) << 32;
            let ticks = (seconds / 1_000_000_000) as u64;
            let found = nanos(Timestamp::from_ticks(ticks));
            assert!(found.abs_diff(expected) <= 1, "{expected}: {found}");
        }
    }
}
