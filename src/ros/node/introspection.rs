//! What the node tells of itself and of its connections: types, loggers, and endpoints that do not match.

use std::collections::BTreeSet;
use std::sync::Arc;

use futures::StreamExt;
use rustdds::{DomainParticipant, DomainParticipantStatusEvent, GUID, QosPolicies, StatusEvented};
use tokio::task::JoinSet;

use super::super::interfaces;
use super::super::log::NodeLog;
use super::super::messages::rcl_interfaces::{
    GetLoggerLevelsRequest, GetLoggerLevelsResponse, LoggerLevel, SetLoggerLevelsRequest,
    SetLoggerLevelsResponse, SetLoggerLevelsResult,
};
use super::super::messages::type_description_interfaces::GetTypeDescriptionRequest;
use super::super::mismatch::{mismatch, ros_name};
use super::super::wiring::{Matched, Reply, WiringError, answer};
use super::Shared;

impl Shared {
    pub(super) fn serve_introspection(
        self: &Arc<Self>,
        log: &NodeLog,
        tasks: &mut JoinSet<()>,
    ) -> Result<(), WiringError> {
        let mut wiring = self.wiring();

        let kind = ("type_description_interfaces", "GetTypeDescription");
        let server = wiring.service("~/get_type_description", kind)?;
        tasks.spawn(answer(
            server,
            move |request: GetTypeDescriptionRequest, reply: Reply<_, _>| {
                reply.send(interfaces::answer(&request));
                async {}
            },
        ));

        let server =
            wiring.service("~/get_logger_levels", ("rcl_interfaces", "GetLoggerLevels"))?;
        let known = log.clone();
        tasks.spawn(answer(server, move |request: GetLoggerLevelsRequest, reply: Reply<_, _>| {
            let levels = request.names.into_iter().map(|name| {
                let level = known.level(&name);
                LoggerLevel { name, level }
            });
            reply.send(GetLoggerLevelsResponse { levels: levels.collect() });
            async {}
        }));

        let server =
            wiring.service("~/set_logger_levels", ("rcl_interfaces", "SetLoggerLevels"))?;
        let known = log.clone();
        tasks.spawn(answer(server, move |request: SetLoggerLevelsRequest, reply: Reply<_, _>| {
            let set = |LoggerLevel { name, level }: LoggerLevel| match known.set_level(&name, level)
            {
                Ok(()) => SetLoggerLevelsResult { successful: true, reason: String::new() },
                Err(reason) => SetLoggerLevelsResult { successful: false, reason },
            };
            let results = request.levels.into_iter().map(set).collect();
            reply.send(SetLoggerLevelsResponse { results });
            async {}
        }));
        Ok(())
    }
}

/// Takes note of the readers that are matched, and warns once of every endpoint of others that speaks of the same topic
/// and does not match.
pub(super) async fn follow_matches(participant: DomainParticipant, matched: Arc<Matched>) {
    let listener = participant.status_listener();
    let mut events = Box::pin(listener.as_async_status_stream());
    let mut known: BTreeSet<GUID> = BTreeSet::new();
    while let Some(event) = events.next().await {
        use DomainParticipantStatusEvent as Event;
        match event {
            Event::RemoteReaderQosIncompatible {
                remote_reader,
                requested_qos,
                offered_qos,
                ..
            } if known.insert(remote_reader) => {
                let readers = participant.discovered_readers();
                let reader =
                    readers.iter().find(|r| r.reader_proxy.remote_reader_guid == remote_reader);
                let topic = reader.map(|r| r.subscription_topic_data.topic_name().clone());
                warn(topic, "subscription", &offered_qos, &requested_qos);
            }
            Event::RemoteWriterQosIncompatible {
                remote_writer,
                requested_qos,
                offered_qos,
                ..
            } if known.insert(remote_writer) => {
                let writers = participant.discovered_writers();
                let writer =
                    writers.iter().find(|w| w.writer_proxy.remote_writer_guid == remote_writer);
                let topic = writer.map(|w| w.publication_topic_data.topic_name().clone());
                warn(topic, "publisher", &offered_qos, &requested_qos);
            }
            Event::RemoteReaderMatched { remote_reader, .. } => matched.insert(remote_reader),
            Event::ReaderLost { guid, .. } | Event::WriterLost { guid, .. } => {
                known.remove(&guid);
                matched.retain(|reader| reader != guid);
            }
            Event::ParticipantLost { id, .. } => matched.retain(|reader| reader.prefix != id),
            _ => {}
        }
    }
}

fn warn(topic: Option<String>, theirs: &str, offered: &QosPolicies, requested: &QosPolicies) {
    let topic = topic.unwrap_or_default();
    let topic = ros_name(&topic);
    let is_subscription = theirs == "subscription";
    let (fact, fixes) = mismatch(topic, &format!("a {theirs}"), offered, requested);
    log::warn!("{fact}; {}", if is_subscription { fixes.subscription } else { fixes.publisher });
}
