//! Endpoints by the names that ROS 2 users know: expanded and remapped, with types, their hashes, and QoS.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use futures::StreamExt;
use ros2_client::action::{
    CancelGoalResponse, FeedbackMessage, GetResultRequest, GetResultResponse, SendGoalRequest,
    SendGoalResponse,
};
use ros2_client::action_msgs::GoalStatusArray;
use ros2_client::qos::{Durability, History, WhenFull};
use ros2_client::{
    Client, Context, Gid, Message, MessageInfo, MessageTypeName, Name, Node, NodeName, NodeOptions,
    Publisher, QosProfile, RmwRequestId, Server, ServiceMapping, ServiceTypeName, Subscription,
};
use rustdds::{DomainParticipant, GUID};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::runtime::Handle;

use super::interfaces::user_data;
use super::messages::action_msgs::CancelGoalRequest;
use super::names::{NameError, NodeNames};

/// Why the node has no such endpoint.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WiringError {
    /// A name that is not allowed.
    #[error(transparent)]
    Name(#[from] NameError),
    /// The DDS library refused.
    #[error("can't create {what}: {reason}")]
    Refused {
        /// The endpoint.
        what: String,
        /// What the library says.
        reason: String,
    },
}

/// A package and a type in it, such as `("std_msgs", "String")`.
pub type TypeName = (&'static str, &'static str);

/// Reliable, and only the latest `depth` are kept.
pub fn reliable(depth: usize) -> QosProfile {
    QosProfile::subscription_default()
        .reliability_reliable(WhenFull::DEFAULT)
        .history(History::KeepLast { depth })
}

/// How long after a message was lost its receiver wants to know of it.
const LOST: Duration = Duration::from_millis(500);

/// Of an end that receives: what is lost is asked for soon. A writer would not match others if it offered that.
fn eager(qos: QosProfile) -> QosProfile {
    qos.latency_budget(Some(LOST))
}

/// Reliable, and whoever joins late receives the latest `depth`.
pub fn latched(depth: usize) -> QosProfile {
    reliable(depth).durability(Durability::TransientLocal)
}

/// The node on the graph, and what makes endpoints of it.
pub struct Wiring {
    node: Node,
    participant: DomainParticipant,
    names: NodeNames,
    mapping: ServiceMapping,
    matched: Arc<Matched>,
}

impl Wiring {
    /// Puts the node on the graph.
    ///
    /// # Errors
    /// When the DDS library refuses.
    pub fn new(
        context: &Context,
        names: NodeNames,
        mapping: ServiceMapping,
    ) -> Result<Self, WiringError> {
        let refused =
            |reason: String| WiringError::Refused { what: format!("node {names}"), reason };
        let name = NodeName::new(names.namespace(), names.name());
        // Parameters and log messages are served by our own endpoints: ros2-client's have no
        // descriptors, and a history of one message.
        let options = NodeOptions::new().enable_rosout(false).start_parameter_services(false);
        let node = context
            .new_node(name.map_err(|e| refused(e.to_string()))?, options)
            .map_err(|e| refused(e.to_string()))?;
        let participant = context.domain_participant();
        Ok(Self { node, participant, names, mapping, matched: Arc::default() })
    }

    /// What the owner is to tell which readers are matched.
    pub fn matched(&self) -> Arc<Matched> {
        Arc::clone(&self.matched)
    }

    /// The names that topics and services go by.
    pub fn names(&self) -> &NodeNames {
        &self.names
    }

    /// A publisher of the topic that the code calls `topic`.
    ///
    /// # Errors
    /// A name that is not allowed; the library's refusal.
    pub fn publisher<M: Serialize>(
        &mut self,
        topic: &str,
        (package, message): TypeName,
        qos: QosProfile,
    ) -> Result<Publisher<M>, WiringError> {
        let topic = self.names.topic(topic)?;
        let qos = qos.user_data(user_data(&format!("{package}/msg/{message}")));
        self.publish_on(topic, MessageTypeName::new(package, message), qos)
    }

    fn publish_on<M: Serialize>(
        &mut self,
        topic: String,
        message: MessageTypeName,
        qos: QosProfile,
    ) -> Result<Publisher<M>, WiringError> {
        let dds = self.node.create_topic(&parse(&topic)?, message, &qos);
        dds.and_then(|dds| self.node.create_publisher(&dds, Some(qos)))
            .map_err(|e| WiringError::Refused { what: topic, reason: e.to_string() })
    }

    /// A subscription of the topic that the code calls `topic`.
    ///
    /// # Errors
    /// A name that is not allowed; the library's refusal.
    pub fn subscription<M: DeserializeOwned + 'static>(
        &mut self,
        topic: &str,
        (package, message): TypeName,
        qos: QosProfile,
    ) -> Result<Subscription<M>, WiringError> {
        let topic = self.names.topic(topic)?;
        let qos = qos.user_data(user_data(&format!("{package}/msg/{message}")));
        self.subscribe_to(topic, MessageTypeName::new(package, message), qos)
    }

    fn subscribe_to<M: DeserializeOwned + 'static>(
        &mut self,
        topic: String,
        message: MessageTypeName,
        qos: QosProfile,
    ) -> Result<Subscription<M>, WiringError> {
        let dds = self.node.create_topic(&parse(&topic)?, message, &qos);
        dds.and_then(|dds| self.node.create_subscription(&dds, Some(eager(qos))))
            .map_err(|e| WiringError::Refused { what: topic, reason: e.to_string() })
    }

    /// The participants of the domain and their nodes, as middlewares tell each other.
    ///
    /// # Errors
    /// The library's refusal.
    pub fn participants<M: DeserializeOwned + 'static>(
        &mut self,
        context: &Context,
    ) -> Result<Subscription<M>, WiringError> {
        const TOPIC: &str = "ros_discovery_info";
        let qos = latched(100);
        let message = MessageTypeName::new("rmw_dds_common", "ParticipantEntitiesInfo");
        context
            .create_topic(TOPIC.into(), message, &qos)
            .and_then(|dds| self.node.create_subscription(&dds, Some(qos)))
            .map_err(|e| WiringError::Refused { what: TOPIC.into(), reason: e.to_string() })
    }

    /// A server of the service that the code calls `service`.
    ///
    /// # Errors
    /// A name that is not allowed; the library's refusal.
    pub fn service<Q, A>(
        &mut self,
        service: &str,
        (package, kind): TypeName,
    ) -> Result<Service<Q, A>, WiringError>
    where
        Q: Message + Clone + 'static,
        A: Message + 'static,
    {
        let service = self.names.service(service)?;
        self.serve(service, Of::Package(package, kind))
    }

    fn serve<Q, A>(&mut self, service: String, of: Of<'_>) -> Result<Service<Q, A>, WiringError>
    where
        Q: Message + Clone + 'static,
        A: Message + 'static,
    {
        let (kind, requests, answers) = of.service();
        let clients = Clients {
            participant: self.participant.clone(),
            answers: format!("rr{service}Reply"),
            are_told: self.mapping == ServiceMapping::Enhanced,
            known: Mutex::default(),
            matched: Arc::clone(&self.matched),
        };
        self.node
            .create_server(self.mapping, &parse(&service)?, &kind, eager(requests), answers)
            .map(|server| Service { server, clients, kept: Mutex::default() })
            .map_err(|e| WiringError::Refused { what: service, reason: e.to_string() })
    }

    fn call<Q, A>(&mut self, service: String, of: Of<'_>) -> Result<Client<Q, A>, WiringError>
    where
        Q: Message + Clone + 'static,
        A: Message + 'static,
    {
        let (kind, requests, answers) = of.service();
        self.node
            .create_client(self.mapping, &parse(&service)?, &kind, requests, eager(answers))
            .map_err(|e| WiringError::Refused { what: service, reason: e.to_string() })
    }

    /// The endpoints of a server of the action that the code calls `action`.
    ///
    /// # Errors
    /// A name that is not allowed; the library's refusal.
    pub fn action_server<G, R, F>(
        &mut self,
        action: &str,
        (package, kind): TypeName,
    ) -> Result<ActionServer<G, R, F>, WiringError>
    where
        G: Message + Clone + 'static,
        R: Message + Clone + 'static,
        F: Message + 'static,
    {
        let under = format!("{}/_action", self.names.service(action)?);
        let (message, feedback) = feedback(package, kind);
        let cancel = Of::Package("action_msgs", "CancelGoal");
        let status = MessageTypeName::new("action_msgs", "GoalStatusArray");
        let latest = latched(1).user_data(user_data("action_msgs/msg/GoalStatusArray"));
        Ok(ActionServer {
            goals: self
                .serve(format!("{under}/send_goal"), Of::Action(package, kind, "SendGoal"))?,
            cancels: self.serve(format!("{under}/cancel_goal"), cancel)?,
            results: self
                .serve(format!("{under}/get_result"), Of::Action(package, kind, "GetResult"))?,
            feedback: self.publish_on(format!("{under}/feedback"), message, feedback)?,
            status: self.publish_on(format!("{under}/status"), status, latest)?,
        })
    }

    /// The endpoints of a client of the action that the code calls `action`.
    ///
    /// # Errors
    /// A name that is not allowed; the library's refusal.
    pub fn action_client<G, R, F>(
        &mut self,
        action: &str,
        (package, kind): TypeName,
    ) -> Result<ActionClient<G, R, F>, WiringError>
    where
        G: Message + Clone + 'static,
        R: Message + Clone + 'static,
        F: Message + 'static,
    {
        let action = self.names.service(action)?;
        let under = format!("{action}/_action");
        let (message, feedback) = feedback(package, kind);
        let cancel = Of::Package("action_msgs", "CancelGoal");
        Ok(ActionClient {
            goals: self
                .call(format!("{under}/send_goal"), Of::Action(package, kind, "SendGoal"))?,
            cancels: self.call(format!("{under}/cancel_goal"), cancel)?,
            results: self
                .call(format!("{under}/get_result"), Of::Action(package, kind, "GetResult"))?,
            feedback: self.subscribe_to(format!("{under}/feedback"), message, feedback)?,
            action,
        })
    }
}

/// The type of a service.
enum Of<'a> {
    /// Of a package, by its name.
    Package(&'a str, &'a str),
    /// Of an action of a package, by the action's name and that of its part.
    Action(&'a str, &'a str, &'a str),
}

impl Of<'_> {
    /// The type, and the QoS of requests and of answers, with the hashes of theirs.
    fn service(&self) -> (ServiceTypeName, QosProfile, QosProfile) {
        // Answers of many clients at once must not push each other out before they arrived.
        let qos = |name: &str, part: &str| {
            reliable(ANSWERS).user_data(user_data(&format!("{name}_{part}")))
        };
        let (kind, name) = match self {
            Self::Package(package, kind) => {
                (ServiceTypeName::new(package, kind), format!("{package}/srv/{kind}"))
            }
            Self::Action(package, kind, part) => {
                let kind = format!("{kind}_{part}");
                (ServiceTypeName::in_action(package, &kind), format!("{package}/action/{kind}"))
            }
        };
        (kind, qos(&name, "Request"), qos(&name, "Response"))
    }
}

/// The type and the QoS of an action's feedback.
fn feedback(package: &str, kind: &str) -> (MessageTypeName, QosProfile) {
    let message = format!("{kind}_FeedbackMessage");
    let hash = user_data(&format!("{package}/action/{message}"));
    (MessageTypeName::in_action(package, &message), reliable(10).user_data(hash))
}

/// What serves an action.
pub struct ActionServer<G: Message + Clone, R: Message + Clone, F: Message> {
    /// Goals come here.
    pub goals: Service<SendGoalRequest<G>, SendGoalResponse>,
    /// Wishes to cancel them.
    pub cancels: Service<CancelGoalRequest, CancelGoalResponse>,
    /// Who wants to know their results.
    pub results: Service<GetResultRequest, GetResultResponse<R>>,
    /// How far they are.
    pub feedback: Publisher<FeedbackMessage<F>>,
    /// Which there are.
    pub status: Publisher<GoalStatusArray>,
}

/// What speaks to the server of an action.
pub struct ActionClient<G: Message + Clone, R: Message + Clone, F: Message> {
    /// Its full name.
    pub action: String,
    /// Takes goals.
    pub goals: Client<SendGoalRequest<G>, SendGoalResponse>,
    /// Cancels them.
    pub cancels: Client<CancelGoalRequest, CancelGoalResponse>,
    /// Tells their results.
    pub results: Client<GetResultRequest, GetResultResponse<R>>,
    /// Tells how far they are.
    pub feedback: Subscription<FeedbackMessage<F>>,
}

fn parse(name: &str) -> Result<Name, WiringError> {
    Name::parse(name).map_err(|e| WiringError::Refused { what: name.into(), reason: e.to_string() })
}

/// Hands every message of a subscription to `handle`, for ever.
pub async fn each<M: DeserializeOwned + 'static>(
    subscription: Subscription<M>,
    mut handle: impl FnMut(M),
) {
    each_from(subscription, |message, _| handle(message)).await;
}

/// The same, with where each comes from.
pub async fn each_from<M: DeserializeOwned + 'static>(
    subscription: Subscription<M>,
    mut handle: impl FnMut(M, MessageInfo),
) {
    let mut messages = Box::pin(subscription.async_stream());
    while let Some(message) = messages.next().await {
        match message {
            Ok((message, info)) => handle(message, info),
            Err(e) => log::debug!("a message that can't be read: {e}"),
        }
    }
}

/// A service: requests come, and answers go back.
pub struct Service<Q: Message, A: Message> {
    server: Server<Q, A>,
    clients: Clients,
    /// Answers whose clients' ends are not known yet, in their order.
    kept: Mutex<BTreeMap<Gid, VecDeque<(RmwRequestId, A)>>>,
}

/// Where clients hear answers. Discovery is not of one piece: a client that has found the service may send a
/// request before its own end for answers is known here, and what is sent to nobody is lost.
struct Clients {
    participant: DomainParticipant,
    /// The topic of the answers, as DDS has it.
    answers: String,
    /// Whether requests tell whose they are. Those of Cyclone's layout tell half of an id of their own.
    are_told: bool,
    /// The ends that are known by now.
    known: Mutex<BTreeMap<Gid, End>>,
    matched: Arc<Matched>,
}

/// The readers of others that a writer of ours sends to. One that is discovered is not yet one of them.
#[derive(Debug, Default)]
pub struct Matched(Mutex<BTreeSet<GUID>>);

impl Matched {
    fn readers(&self) -> MutexGuard<'_, BTreeSet<GUID>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes note of a reader.
    pub fn insert(&self, reader: GUID) {
        self.readers().insert(reader);
    }

    /// Forgets those that are gone.
    pub fn retain(&self, are_there: impl Fn(GUID) -> bool) {
        self.readers().retain(|reader| are_there(*reader));
    }
}

/// Where an answer goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum End {
    /// To the client's reader alone.
    Reader(GUID),
    /// To all clients, which pick out what is theirs.
    All,
}

/// How long an answer waits for its client's end to be discovered, and how often that is looked for.
const DISCOVERY: Duration = Duration::from_secs(10);
const LOOK: Duration = Duration::from_millis(20);
/// After this long an end that is discovered is taken as matched, should word of that have been lost.
const MATCHING: Duration = Duration::from_secs(1);
/// Requests, and answers of one client, that are kept.
const ANSWERS: usize = 100;
/// Clients that are remembered; with more, they are looked for again.
const MOST_CLIENTS: usize = 1000;

impl Clients {
    /// Where the client that sends requests with this id hears answers, if that is known.
    fn known(&self, client: Gid) -> Option<End> {
        if !self.are_told {
            return Some(End::All);
        }
        let known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        // One that was lost and came back is matched anew.
        known.get(&client).copied().filter(|end| *end == End::All || self.is_matched(*end))
    }

    /// Looks for the client's end.
    fn look_for(&self, client: Gid) -> Option<End> {
        let readers = self.participant.discovered_readers();
        let ends = readers
            .iter()
            .filter(|reader| *reader.subscription_topic_data.topic_name() == self.answers)
            .map(|reader| reader.reader_proxy.remote_reader_guid);
        end_of(client, ends)
    }

    /// Whether what is sent to this end now arrives.
    fn is_matched(&self, end: End) -> bool {
        match end {
            End::Reader(reader) => self.matched.readers().contains(&reader),
            End::All => false,
        }
    }

    fn remember(&self, client: Gid, end: End) {
        if let End::Reader(reader) = end {
            self.matched.insert(reader);
        }
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        if known.len() >= MOST_CLIENTS {
            known.clear();
        }
        known.insert(client, end);
    }
}

/// The end of a client among those of a service: the one whose id it gives, as Fast DDS does, or else the only one
/// of its participant.
fn end_of(client: Gid, ends: impl Iterator<Item = GUID>) -> Option<End> {
    // Ids begin with 12 bytes of the participant.
    let participant = |gid: Gid| gid.to_bytes16()[..12].to_vec();
    let its: Vec<GUID> =
        ends.filter(|end| participant((*end).into()) == participant(client)).collect();
    match its.as_slice() {
        [] => None,
        [only] => Some(End::Reader(*only)),
        several => {
            let told = several.iter().find(|end| Gid::from(**end) == client);
            Some(told.map_or(End::All, |end| End::Reader(*end)))
        }
    }
}

/// Hands every request of a service to `handle`, one after the other, for ever.
pub async fn answer<Q, A, F>(service: Service<Q, A>, mut handle: impl FnMut(Q, Reply<Q, A>) -> F)
where
    Q: Message + 'static,
    A: Message + 'static,
    F: Future<Output = ()>,
{
    let service = Arc::new(service);
    let runtime = Handle::current();
    let mut requests = service.server.receive_request_stream();
    while let Some(request) = requests.next().await {
        match request {
            Ok((id, request)) => {
                let service = Arc::downgrade(&service);
                handle(request, Reply { service, runtime: runtime.clone(), id }).await;
            }
            Err(e) => log::debug!("a request that can't be read: {e}"),
        }
    }
}

/// The way back to the client of one request. It does not keep the service alive.
pub struct Reply<Q: Message, A: Message> {
    service: Weak<Service<Q, A>>,
    runtime: Handle,
    id: RmwRequestId,
}

impl<Q: Message, A: Message> Clone for Reply<Q, A> {
    fn clone(&self) -> Self {
        Self { service: Weak::clone(&self.service), runtime: self.runtime.clone(), id: self.id }
    }
}

impl<Q: Message + Send + Sync + 'static, A: Message + Send + Sync + 'static> Reply<Q, A> {
    /// Answers the request.
    pub fn send(&self, answer: A) {
        let Some(service) = self.service.upgrade() else { return };
        if let Some(end) = service.clients.known(self.id.writer_gid) {
            service.send(self.id, answer, end);
            return;
        }
        let client = self.id.writer_gid;
        if !service.keep(self.id, answer) {
            return;
        }
        drop(service);
        let service = Weak::clone(&self.service);
        self.runtime.spawn(async move {
            let asked = Instant::now();
            let mut discovered = None;
            loop {
                let Some(service) = service.upgrade() else { return };
                let found = service.clients.look_for(client);
                if found.is_some() && discovered.is_none() {
                    discovered = Some(Instant::now());
                }
                match found {
                    Some(end)
                        if service.clients.is_matched(end)
                            || discovered.is_some_and(|then| then.elapsed() > MATCHING) =>
                    {
                        service.clients.remember(client, end);
                        return service.send_kept(client, end);
                    }
                    None if asked.elapsed() > DISCOVERY => {
                        return service.send_kept(client, End::All);
                    }
                    _ => {}
                }
                drop(service);
                tokio::time::sleep(LOOK).await;
            }
        });
    }
}

impl<Q: Message + 'static, A: Message + 'static> Service<Q, A> {
    /// Keeps an answer until its client's end is known; whether it is the first, and nobody looks for the end yet.
    fn keep(&self, id: RmwRequestId, answer: A) -> bool {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        if kept.len() >= MOST_CLIENTS && !kept.contains_key(&id.writer_gid) {
            drop(kept);
            self.send(id, answer, End::All);
            return false;
        }
        let answers = kept.entry(id.writer_gid).or_default();
        if answers.len() >= ANSWERS {
            answers.pop_front();
        }
        answers.push_back((id, answer));
        answers.len() == 1
    }

    fn send_kept(&self, client: Gid, end: End) {
        let answers = self.kept.lock().unwrap_or_else(PoisonError::into_inner).remove(&client);
        for (id, answer) in answers.into_iter().flatten() {
            self.send(id, answer, end);
        }
    }

    fn send(&self, id: RmwRequestId, answer: A, end: End) {
        let reader = match end {
            End::Reader(reader) => Some(reader),
            End::All => None,
        };
        if let Err(e) = self.server.send_response_to(id, answer, reader) {
            log::warn!("an answer could not be sent: {e}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An id of a participant's end.
    fn guid(participant: u8, end: u8) -> GUID {
        let mut bytes = [participant; 16];
        bytes[12..].copy_from_slice(&[0, 0, end, 4]);
        GUID::from_bytes(bytes)
    }

    #[test]
    fn an_answer_goes_to_the_end_that_is_told_or_the_only_one_there_is() {
        let ends = || [guid(1, 1), guid(2, 1), guid(2, 2)].into_iter();
        let of = |client: GUID| end_of(client.into(), ends());
        assert_eq!(of(guid(1, 9)), Some(End::Reader(guid(1, 1))));
        assert_eq!(of(guid(2, 2)), Some(End::Reader(guid(2, 2))));
        assert_eq!(of(guid(2, 9)), Some(End::All));
        assert_eq!(of(guid(3, 1)), None);
    }
}
