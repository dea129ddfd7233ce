//! The way onto the network: a DDS participant in the domain and range of the environment.

use std::net::{IpAddr, Ipv4Addr, ToSocketAddrs};

use ros2_client::{Context, CreateError};
use rustdds::{DomainParticipant, DomainParticipantBuilder};

use super::environment::{DiscoveryRange, Environment};

/// Why there is no way onto the network.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ParticipantError {
    /// Every participant of the domain is taken.
    #[error(
        "no participant id is free in domain {domain}: 120 programs of this machine are in it, or \
         other programs hold its ports ({first} to {last}). End some of them, or choose another \
         ROS_DOMAIN_ID"
    )]
    NoneFree {
        /// The domain.
        domain: u16,
        /// First unicast port of the domain.
        first: u16,
        /// Last unicast port of the domain.
        last: u16,
    },
    /// A static peer whose address nobody knows.
    #[error(
        "ROS_STATIC_PEERS names {peer:?}, which has no IPv4 address here ({reason}); separate names and \
         addresses by semicolons, and leave out those that are not known"
    )]
    Peer {
        /// The peer.
        peer: String,
        /// What the system says.
        reason: String,
    },
    /// Anything else that went wrong.
    #[error("can't join domain {domain}: {reason}")]
    Other {
        /// The domain.
        domain: u16,
        /// What the DDS library says.
        reason: String,
    },
}

/// Joins the domain of the environment.
///
/// # Errors
/// When no participant id is free, or the network can't be used.
pub fn join(environment: &Environment) -> Result<Context, ParticipantError> {
    let domain = environment.domain;
    Context::from_domain_participant(enter(environment)?)
        .map_err(|e: CreateError| ParticipantError::Other { domain, reason: e.to_string() })
}

/// Joins the domain of the environment, for who speaks DDS there.
///
/// # Errors
/// As [`join`].
pub fn enter(environment: &Environment) -> Result<DomainParticipant, ParticipantError> {
    let domain = environment.domain;
    let mut builder = DomainParticipantBuilder::new(domain);
    let peers: Result<Vec<Vec<IpAddr>>, _> =
        environment.static_peers.iter().map(|peer| addresses(peer)).collect();
    builder = builder.initial_peers(peers?.into_iter().flatten());
    match environment.range {
        DiscoveryRange::Localhost if environment.static_peers.is_empty() => {
            builder = builder.with_only_networks([Ipv4Addr::LOCALHOST]);
        }
        DiscoveryRange::Subnet | DiscoveryRange::Localhost => {}
        DiscoveryRange::Off => {
            builder = builder.with_only_networks(Vec::<IpAddr>::new()).same_host_loopback(false);
        }
    }
    builder.build().map_err(|e| match e {
        rustdds::dds::CreateError::OutOfResources { .. } => {
            let (first, last) = ports(domain);
            ParticipantError::NoneFree { domain, first, last }
        }
        e => ParticipantError::Other { domain, reason: e.to_string() },
    })
}

/// The IPv4 addresses of a machine, which rustdds speaks.
fn addresses(peer: &str) -> Result<Vec<IpAddr>, ParticipantError> {
    let unknown = |reason: String| ParticipantError::Peer { peer: peer.into(), reason };
    let found = (peer, 0).to_socket_addrs().map_err(|e| unknown(e.to_string()))?;
    let found: Vec<IpAddr> = found.map(|address| address.ip()).filter(IpAddr::is_ipv4).collect();
    if found.is_empty() { Err(unknown("only IPv6".into())) } else { Ok(found) }
}

/// The unicast ports of a domain: discovery of participant 0 to data of participant 119
/// (RTPS 2.5, 9.6.2.3). The last domain has fewer, since ports end.
fn ports(domain: u16) -> (u16, u16) {
    let first = 7400 + 250 * domain + 10;
    (first, first.saturating_add(1 + 2 * 119))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::environment::MAX_DOMAIN;

    #[test]
    fn the_ports_of_a_domain_end_where_ports_end() {
        assert_eq!(ports(0), (7410, 7649));
        assert_eq!(ports(MAX_DOMAIN), (65410, 65535));
    }
}
