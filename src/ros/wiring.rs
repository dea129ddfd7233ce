//! Endpoints by the names that ROS 2 users know: expanded and remapped, with types and QoS.

use std::sync::{Arc, Weak};

use futures::StreamExt;
use ros2_client::qos::{Durability, History, WhenFull};
use ros2_client::{
    Context, Message, MessageTypeName, Name, Node, NodeName, NodeOptions, Publisher, QosProfile,
    RmwRequestId, Server, ServiceMapping, ServiceTypeName, Subscription,
};
use serde::Serialize;
use serde::de::DeserializeOwned;

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

/// Reliable, and whoever joins late receives the latest `depth`.
pub fn latched(depth: usize) -> QosProfile {
    reliable(depth).durability(Durability::TransientLocal)
}

/// The node on the graph, and what makes endpoints of it.
pub struct Wiring {
    node: Node,
    names: NodeNames,
    mapping: ServiceMapping,
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
        Ok(Self { node, names, mapping })
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
        let name = parse(&topic)?;
        let dds = self.node.create_topic(&name, MessageTypeName::new(package, message), &qos);
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
        let name = parse(&topic)?;
        let dds = self.node.create_topic(&name, MessageTypeName::new(package, message), &qos);
        dds.and_then(|dds| self.node.create_subscription(&dds, Some(qos)))
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
    ) -> Result<Server<Q, A>, WiringError>
    where
        Q: Message + Clone + 'static,
        A: Message + 'static,
    {
        let service = self.names.service(service)?;
        let kind = ServiceTypeName::new(package, kind);
        // Answers of many clients at once must not push each other out before they arrived.
        let qos = reliable(100);
        self.node
            .create_server(self.mapping, &parse(&service)?, &kind, qos.clone(), qos)
            .map_err(|e| WiringError::Refused { what: service, reason: e.to_string() })
    }
}

fn parse(name: &str) -> Result<Name, WiringError> {
    Name::parse(name).map_err(|e| WiringError::Refused { what: name.into(), reason: e.to_string() })
}

/// Hands every message of a subscription to `handle`, for ever.
pub async fn each<M: DeserializeOwned + 'static>(
    subscription: Subscription<M>,
    mut handle: impl FnMut(M),
) {
    let mut messages = Box::pin(subscription.async_stream());
    while let Some(message) = messages.next().await {
        match message {
            Ok((message, _)) => handle(message),
            Err(e) => log::debug!("a message that can't be read: {e}"),
        }
    }
}

/// Hands every request of a service to `handle`, one after the other, for ever.
pub async fn answer<Q, A, F>(server: Server<Q, A>, mut handle: impl FnMut(Q, Reply<Q, A>) -> F)
where
    Q: Message + 'static,
    A: Message + 'static,
    F: Future<Output = ()>,
{
    let server = Arc::new(server);
    let mut requests = server.receive_request_stream();
    while let Some(request) = requests.next().await {
        match request {
            Ok((id, request)) => {
                handle(request, Reply { server: Arc::downgrade(&server), id }).await;
            }
            Err(e) => log::debug!("a request that can't be read: {e}"),
        }
    }
}

/// The way back to the client of one request. It does not keep the service alive.
pub struct Reply<Q: Message, A: Message> {
    server: Weak<Server<Q, A>>,
    id: RmwRequestId,
}

impl<Q: Message, A: Message> Clone for Reply<Q, A> {
    fn clone(&self) -> Self {
        Self { server: Weak::clone(&self.server), id: self.id }
    }
}

impl<Q: Message + 'static, A: Message + 'static> Reply<Q, A> {
    /// Answers the request.
    pub fn send(&self, answer: A) {
        let Some(server) = self.server.upgrade() else { return };
        if let Err(e) = server.send_response(self.id, answer) {
            log::warn!("an answer could not be sent: {e}");
        }
    }
}
