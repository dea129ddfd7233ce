//! Why nothing is seen: the environment, the network, a real conversation over it, and what others there are and
//! do, each with what to do about it.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::time::{Duration, Instant};

use futures::StreamExt;
use ros2_client::entities_info::ParticipantEntitiesInfo;
use ros2_client::{Context, ServiceMapping};
use rustdds::discovery::{DiscoveredReaderData, DiscoveredWriterData};
use rustdds::{DomainParticipant, DomainParticipantStatusEvent, RTPSEntity, StatusEvented};
use serde::Serialize;
use socket2::{Domain, Protocol, Socket, Type};

use super::environment::{DiscoveryRange, Environment, MAX_DOMAIN};
use super::messages::std_msgs::Text;
use super::mismatch::{mismatch, ros_name};
use super::names::NodeNames;
use super::participant;
use super::wiring::{Wiring, reliable};

/// The group that participants announce themselves to (RTPS 2.5, 9.6.2.4.1).
const GROUP: Ipv4Addr = Ipv4Addr::new(239, 255, 0, 1);
/// How long two participants of one machine may take to talk to each other.
const PATIENCE: Duration = Duration::from_secs(10);
/// Bytes of the long message: more than the largest UDP packet carries.
const LONG: usize = 200_000;

/// How a check came out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// As it should be.
    Good,
    /// It may be as it should be; a person can tell.
    Doubtful,
    /// This keeps programs from seeing each other.
    Bad,
}

/// What one check found.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// What was looked at.
    pub check: &'static str,
    /// How it came out.
    pub verdict: Verdict,
    /// What is the case.
    pub fact: String,
    /// What to do; empty where there is nothing to do.
    pub next: String,
}

fn good(check: &'static str, fact: impl Into<String>) -> Finding {
    Finding { check, verdict: Verdict::Good, fact: fact.into(), next: String::new() }
}

fn doubtful(check: &'static str, fact: impl Into<String>, next: impl Into<String>) -> Finding {
    Finding { check, verdict: Verdict::Doubtful, fact: fact.into(), next: next.into() }
}

fn bad(check: &'static str, fact: impl Into<String>, next: impl Into<String>) -> Finding {
    Finding { check, verdict: Verdict::Bad, fact: fact.into(), next: next.into() }
}

/// What the variables of the environment say, and which of them keep programs apart.
pub fn environment(
    environment: &Environment,
    variable: impl Fn(&str) -> Option<String>,
) -> Vec<Finding> {
    const CHECK: &str = "environment";
    let set = |name: &str| variable(name).filter(|value| !value.trim().is_empty());
    let mut findings = Vec::new();
    let domain = match set("ROS_DOMAIN_ID") {
        Some(_) => format!("ROS_DOMAIN_ID is {}", environment.domain),
        None => "ROS_DOMAIN_ID is not set, so the domain is 0".to_owned(),
    };
    findings.push(good(CHECK, domain));
    findings.push(match environment.range {
        DiscoveryRange::Subnet => good(CHECK, "discovery reaches the whole subnet"),
        DiscoveryRange::Localhost => doubtful(
            CHECK,
            "discovery is confined to this machine",
            "for programs on other machines unset ROS_LOCALHOST_ONLY and ROS_AUTOMATIC_DISCOVERY_RANGE, \
             here and there",
        ),
        DiscoveryRange::Off => bad(
            CHECK,
            "discovery is off, so nobody finds anybody",
            "unset ROS_AUTOMATIC_DISCOVERY_RANGE, or set it to SUBNET or LOCALHOST",
        ),
    });
    if !environment.static_peers.is_empty() {
        let peers = environment.static_peers.join(", ");
        findings.push(good(CHECK, format!("these are told directly (ROS_STATIC_PEERS): {peers}")));
    }
    findings
        .extend(environment.warnings.iter().map(|warning| doubtful(CHECK, warning.clone(), "")));
    let middleware = set("RMW_IMPLEMENTATION").unwrap_or_else(|| "rmw_fastrtps_cpp".into());
    if environment.service_mapping == ServiceMapping::Cyclone {
        findings.push(doubtful(
            CHECK,
            "RMW_IMPLEMENTATION is rmw_cyclonedds_cpp: services are laid out as Cyclone DDS does, and Fast DDS \
             clients can't call them",
            "give the node the same RMW_IMPLEMENTATION as its clients",
        ));
    }
    if let Some(server) = set("ROS_DISCOVERY_SERVER") {
        findings.push(bad(
            CHECK,
            format!("ROS_DISCOVERY_SERVER is {server}: programs with it find others through that server alone, which this node does not speak to"),
            "unset it for the programs that are to see the node, or name their machines in ROS_STATIC_PEERS without a server",
        ));
    }
    if let Some(enable) = set("ROS_SECURITY_ENABLE").filter(|value| value == "true") {
        findings.push(bad(
            CHECK,
            format!("ROS_SECURITY_ENABLE is {enable}: programs with it ignore this node, which has no keys"),
            "unset it for the programs that are to see the node",
        ));
    }
    for name in
        ["FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE", "CYCLONEDDS_URI"]
    {
        let is_for = |which: &str| middleware.contains(which);
        let counts =
            if name.starts_with("CYCLONE") { is_for("cyclone") } else { is_for("fastrtps") };
        if let Some(value) = set(name).filter(|_| counts) {
            findings.push(doubtful(
                CHECK,
                format!("{name} is {value}: it may confine clients to interfaces, peers or shared memory"),
                "try without it",
            ));
        }
    }
    findings
}

/// The interfaces over which others can be reached.
pub fn interfaces(range: DiscoveryRange) -> Vec<Finding> {
    const CHECK: &str = "interfaces";
    let mut findings = Vec::new();
    let mut reach = 0;
    for interface in netdev::get_interfaces() {
        let addresses: Vec<String> =
            interface.ipv4.iter().map(|net| net.addr().to_string()).collect();
        if !interface.is_up() || addresses.is_empty() {
            continue;
        }
        let (name, addresses) = (&interface.name, addresses.join(", "));
        if interface.is_loopback() {
            findings.push(good(CHECK, format!("{name} has {addresses} (this machine)")));
        } else if interface.is_multicast() {
            reach += 1;
            findings.push(good(CHECK, format!("{name} has {addresses} and takes multicast")));
        } else {
            reach += 1;
            findings.push(doubtful(
                CHECK,
                format!("{name} has {addresses} and takes no multicast"),
                format!(
                    "for machines behind it set ROS_STATIC_PEERS, or: ip link set {name} multicast on"
                ),
            ));
        }
    }
    if reach == 0 && range == DiscoveryRange::Subnet {
        findings.push(doubtful(
            CHECK,
            "no interface but loopback is up, so nobody on other machines can be reached",
            "connect to a network; for this machine alone all is well",
        ));
    }
    findings
}

/// Whether a packet to a group comes back to this machine, interface by interface.
pub fn multicast(range: DiscoveryRange) -> Vec<Finding> {
    const CHECK: &str = "multicast";
    if range != DiscoveryRange::Subnet {
        return Vec::new();
    }
    let mut findings = Vec::new();
    for interface in netdev::get_interfaces() {
        if !interface.is_up() || interface.is_loopback() || !interface.is_multicast() {
            continue;
        }
        let Some(address) = interface.ipv4.first().map(|net| net.addr()) else { continue };
        let name = &interface.name;
        findings.push(match looped(address) {
            Ok(true) => good(CHECK, format!("what is sent to {GROUP} on {name} comes back")),
            Ok(false) => bad(
                CHECK,
                format!("what is sent to {GROUP} on {name} does not come back within a second"),
                "let UDP to 239.255.0.1 pass the firewall (ufw allow in proto udp to 224.0.0.0/4; ufw allow in \
                 proto udp from 224.0.0.0/4), or set ROS_STATIC_PEERS here and there",
            ),
            Err(e) => bad(
                CHECK,
                format!("nothing can be sent to {GROUP} on {name}: {e}"),
                format!("ip route add 224.0.0.0/4 dev {name}, or set ROS_STATIC_PEERS here and there"),
            ),
        });
    }
    findings
}

/// Whether this machine hears what it sends to the group over an interface.
fn looped(address: Ipv4Addr) -> std::io::Result<bool> {
    let receiver = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    receiver.join_multicast_v4(&GROUP, &address)?;
    receiver.set_read_timeout(Some(Duration::from_millis(200)))?;
    let port = receiver.local_addr()?.port();
    let sender = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
    sender.set_multicast_if_v4(&address)?;
    sender.set_multicast_loop_v4(true)?;
    let word = format!("tcvae doctor {}", std::process::id());
    let mut heard = [0; 64];
    for _ in 0..5 {
        sender.send_to(word.as_bytes(), &SocketAddrV4::new(GROUP, port).into())?;
        if let Ok((count, _)) = receiver.recv_from(&mut heard)
            && &heard[..count] == word.as_bytes()
        {
            return Ok(true);
        }
    }
    Ok(false)
}

/// The domains in which programs of this machine are, by the ports that they hold; with how many there are.
pub fn domains_here() -> BTreeMap<u16, usize> {
    let mut domains: BTreeMap<u16, BTreeSet<u16>> = BTreeMap::new();
    let table = fs::read_to_string("/proc/net/udp").unwrap_or_default();
    for port in table.lines().filter_map(local_port) {
        if let Some((domain, participant)) = participant_of(port) {
            domains.entry(domain).or_default().insert(participant);
        }
    }
    domains.into_iter().map(|(domain, participants)| (domain, participants.len())).collect()
}

/// The port of a line of `/proc/net/udp`, such as `  12: 00000000:1CF2 00000000:0000 07 …`.
fn local_port(line: &str) -> Option<u16> {
    let address = line.split_whitespace().nth(1)?;
    u16::from_str_radix(address.split_once(':')?.1, 16).ok()
}

/// The domain and the participant that a port is the discovery port of (RTPS 2.5, 9.6.2.3).
fn participant_of(port: u16) -> Option<(u16, u16)> {
    let above = port.checked_sub(7400)?;
    let (domain, offset) = (above / 250, above % 250);
    // Above 101 are ports that Linux gives to outgoing connections, which mean nothing.
    (domain <= 101 && offset >= 10 && offset % 2 == 0).then(|| (domain, (offset - 10) / 2))
}

/// Which domains announcements come in from other machines: their addresses.
pub fn domains_elsewhere(own: u16, wait: Duration) -> BTreeMap<u16, BTreeSet<Ipv4Addr>> {
    let here: BTreeSet<Ipv4Addr> = netdev::get_interfaces()
        .iter()
        .flat_map(|interface| interface.ipv4.iter().map(|net| net.addr()).collect::<Vec<_>>())
        .collect();
    let listen = |domain: u16| -> std::io::Result<UdpSocket> {
        let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
        socket.set_reuse_address(true)?;
        socket.set_nonblocking(true)?;
        socket.bind(&SocketAddrV4::new(GROUP, 7400 + 250 * domain).into())?;
        socket.join_multicast_v4(&GROUP, &Ipv4Addr::UNSPECIFIED)?;
        Ok(socket.into())
    };
    let sockets: Vec<(u16, UdpSocket)> = (0..=MAX_DOMAIN)
        .filter(|domain| *domain != own)
        .filter_map(|domain| Some((domain, listen(domain).ok()?)))
        .collect();
    let mut found: BTreeMap<u16, BTreeSet<Ipv4Addr>> = BTreeMap::new();
    let end = Instant::now() + wait;
    let mut packet = [0; 2048];
    while Instant::now() < end {
        for (domain, socket) in &sockets {
            while let Ok((count, from)) = socket.recv_from(&mut packet) {
                if let std::net::IpAddr::V4(from) = from.ip()
                    && packet[..count].starts_with(b"RTPS")
                    && !here.contains(&from)
                {
                    found.entry(*domain).or_default().insert(from);
                }
            }
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    found
}

/// What follows from others in other domains.
pub fn other_domains(
    own: u16,
    here: &BTreeMap<u16, usize>,
    elsewhere: &BTreeMap<u16, BTreeSet<Ipv4Addr>>,
) -> Vec<Finding> {
    const CHECK: &str = "other domains";
    let next = |domain: u16| format!("if that is whom you look for: export ROS_DOMAIN_ID={domain}");
    let on_this = here.iter().filter(|(domain, _)| **domain != own).map(|(domain, count)| {
        let fact = format!("{count} participants of this machine are in domain {domain}");
        doubtful(CHECK, fact, next(*domain))
    });
    let on_others = elsewhere.iter().map(|(domain, addresses)| {
        let addresses: Vec<String> = addresses.iter().map(Ipv4Addr::to_string).collect();
        let fact = format!("domain {domain} has participants on {}", addresses.join(", "));
        doubtful(CHECK, fact, next(*domain))
    });
    on_this.chain(on_others).collect()
}

/// Two participants of this process, as two programs would have them, talk to each other.
pub async fn conversation(environment: &Environment) -> Finding {
    const CHECK: &str = "conversation";
    if environment.range == DiscoveryRange::Off {
        return doubtful(CHECK, "not tried, since discovery is off", "");
    }
    let began = Instant::now();
    match converse(environment).await {
        Ok(Some((short, long))) => good(
            CHECK,
            format!(
                "two participants found each other and said something in {:.1} s, and {} kB in {:.2} s",
                short.as_secs_f64(),
                LONG / 1000,
                long.as_secs_f64()
            ),
        ),
        Ok(None) => bad(
            CHECK,
            format!(
                "two participants of this machine, in domain {}, did not hear each other within {:.0} s",
                environment.domain,
                began.elapsed().as_secs_f64()
            ),
            "a firewall that blocks UDP on loopback, or a container without a network, does this; let UDP ports \
             7400 to 65535 pass on lo",
        ),
        Err(reason) => bad(CHECK, reason, "see what holds these ports: ss -ulpn"),
    }
}

async fn converse(environment: &Environment) -> Result<Option<(Duration, Duration)>, String> {
    let topic = format!("/tcvae_doctor_{}", std::process::id());
    let text = ("std_msgs", "String");
    let wiring = |name: &str| {
        let context = participant::join(environment).map_err(|e| e.to_string())?;
        let names = NodeNames::new(name, &[]).map_err(|e| e.to_string())?;
        let wiring = Wiring::new(&context, names, environment.service_mapping);
        wiring.map(|wiring| (context, wiring)).map_err(|e| e.to_string())
    };
    let (_speaking, mut speaker) = wiring("tcvae_doctor_speaker")?;
    let (_hearing, mut hearer) = wiring("tcvae_doctor_hearer")?;
    let publisher =
        speaker.publisher::<Text>(&topic, text, reliable(1)).map_err(|e| e.to_string())?;
    let subscription =
        hearer.subscription::<Text>(&topic, text, reliable(1)).map_err(|e| e.to_string())?;
    let mut heard = Box::pin(subscription.async_stream());
    let mut took = Vec::new();
    for length in [5, LONG] {
        let data = "x".repeat(length);
        let began = Instant::now();
        let arrived = async {
            loop {
                // Whoever is not matched yet does not hear it.
                publisher.publish(Text { data: data.clone() }).map_err(|e| e.to_string())?;
                let next = tokio::time::timeout(Duration::from_millis(250), heard.next()).await;
                if let Ok(Some(Ok((said, _)))) = next
                    && said.data == data
                {
                    return Ok::<(), String>(());
                }
            }
        };
        match tokio::time::timeout(PATIENCE, arrived).await {
            Ok(done) => done?,
            Err(_) => return Ok(None),
        }
        took.push(began.elapsed());
    }
    Ok(Some((took[0], took[1])))
}

/// Who else is in the domain, and which of their endpoints, and ours, do not match.
///
/// # Errors
/// No way onto the network.
pub async fn neighbours(
    environment: &Environment,
    wait: Duration,
) -> Result<Vec<Finding>, participant::ParticipantError> {
    let participant = participant::enter(environment)?;
    let context = Context::from_domain_participant(participant.clone()).map_err(|e| {
        participant::ParticipantError::Other { domain: environment.domain, reason: e.to_string() }
    })?;
    let mut nodes: BTreeSet<String> = BTreeSet::new();
    let mut programs: BTreeMap<String, usize> = BTreeMap::new();
    let listening = async {
        let listener = participant.status_listener();
        let mut events = Box::pin(listener.as_async_status_stream());
        while let Some(event) = events.next().await {
            if let DomainParticipantStatusEvent::ParticipantDiscovered { dpd } = event
                && dpd.guid != participant.guid()
            {
                *programs.entry(format!("{:?}", dpd.vendor_id)).or_default() += 1;
            }
        }
    };
    let names = NodeNames::new("tcvae_doctor", &[]).ok();
    let wiring = names.and_then(|n| Wiring::new(&context, n, environment.service_mapping).ok());
    let infos = wiring.and_then(|mut w| {
        let subscription = w.participants::<ParticipantEntitiesInfo>(&context).ok()?;
        Some((w, subscription))
    });
    let naming = async {
        let Some((_wiring, subscription)) = infos else { return };
        let mut infos = Box::pin(subscription.async_stream());
        while let Some(info) = infos.next().await {
            if let Ok((info, _)) = info {
                let names = info.nodes().iter().map(|node| node.fully_qualified_name());
                nodes.extend(names.filter(|name| !name.starts_with("/tcvae_doctor")));
            }
        }
    };
    let _ = tokio::time::timeout(wait, async { tokio::join!(listening, naming) }).await;
    Ok(tell_of(environment.domain, &programs, &nodes, &participant))
}

fn tell_of(
    domain: u16,
    programs: &BTreeMap<String, usize>,
    nodes: &BTreeSet<String>,
    participant: &DomainParticipant,
) -> Vec<Finding> {
    const CHECK: &str = "others";
    let mut findings = Vec::new();
    if programs.is_empty() {
        findings.push(doubtful(
            CHECK,
            format!("nobody else is in domain {domain}"),
            "start the other program; if it runs, give it this ROS_DOMAIN_ID, and the same discovery range",
        ));
        return findings;
    }
    for (vendor, count) in programs {
        let many = if *count == 1 { "program" } else { "programs" };
        findings.push(good(CHECK, format!("{count} {many} with {vendor} in domain {domain}")));
    }
    if nodes.is_empty() {
        findings.push(doubtful(
            CHECK,
            "none of them has told of a ROS 2 node",
            "if they are ROS 2 programs, see whether their middleware is older than ROS 2 Iron",
        ));
    } else {
        let names: Vec<&str> = nodes.iter().map(String::as_str).collect();
        findings.push(good(CHECK, format!("nodes: {}", names.join(", "))));
    }
    findings
        .extend(connections(&participant.discovered_readers(), &participant.discovered_writers()));
    findings
}

/// The topics on which some publisher and some subscription do not match.
fn connections(readers: &[DiscoveredReaderData], writers: &[DiscoveredWriterData]) -> Vec<Finding> {
    const CHECK: &str = "topics";
    let mut findings = BTreeMap::new();
    let mut matched = 0;
    for writer in writers {
        let (ours, topic) =
            (&writer.publication_topic_data, &writer.publication_topic_data.topic_name);
        for reader in readers {
            let theirs = &reader.subscription_topic_data;
            if theirs.topic_name() != topic {
                continue;
            }
            let name = ros_name(topic);
            if *theirs.type_name() != ours.type_name {
                let fact = format!(
                    "{name} is published as {} and subscribed to as {}",
                    plain_type(&ours.type_name),
                    plain_type(theirs.type_name())
                );
                let next = "give both the same type, or remap one of them";
                findings.insert(fact.clone(), bad(CHECK, fact, next));
            } else if ours.qos().compliance_failure_wrt(&theirs.qos()).is_some() {
                let (fact, fixes) = mismatch(name, "a subscription", &ours.qos(), &theirs.qos());
                let next = format!("{}, or {}", fixes.publisher, fixes.subscription);
                findings.insert(fact.clone(), bad(CHECK, fact, next));
            } else if hash(&writer.user_data) != hash(&reader.user_data)
                && hash(&writer.user_data).is_some()
                && hash(&reader.user_data).is_some()
            {
                let fact = format!(
                    "the two sides of {name} have different definitions of {}",
                    plain_type(&ours.type_name)
                );
                let next = "build both with the same version of that package";
                findings.insert(fact.clone(), doubtful(CHECK, fact, next));
            } else {
                matched += 1;
            }
        }
    }
    let mut findings: Vec<Finding> = findings.into_values().collect();
    if matched > 0 {
        findings.insert(0, good(CHECK, format!("{matched} pairs of endpoints match")));
    }
    findings
}

/// The hash in what an endpoint tells of its type; none where it tells none that is valid.
fn hash(user_data: &[u8]) -> Option<&str> {
    let text = std::str::from_utf8(user_data).ok()?;
    text.split(';')
        .find_map(|part| part.strip_prefix("typehash="))
        .filter(|h| h.starts_with("RIHS01_"))
}

/// A type's name as ROS writes it, from how DDS does.
fn plain_type(dds: &str) -> String {
    let plain = dds.replace("::dds_::", "::").replace("::", "/");
    plain.strip_suffix('_').unwrap_or(&plain).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(variables: &[(&str, &str)]) -> Vec<Finding> {
        let read = |name: &str| {
            variables.iter().find(|(n, _)| *n == name).map(|(_, value)| (*value).to_owned())
        };
        environment(&Environment::read(read).unwrap(), read)
    }

    #[test]
    fn an_empty_environment_is_good() {
        assert!(of(&[]).iter().all(|finding| finding.verdict == Verdict::Good), "{:?}", of(&[]));
    }

    #[test]
    fn what_keeps_programs_apart_is_told_with_what_to_do() {
        for (name, value, verdict) in [
            ("ROS_DISCOVERY_SERVER", "10.0.0.1:11811", Verdict::Bad),
            ("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF", Verdict::Bad),
            ("ROS_LOCALHOST_ONLY", "1", Verdict::Doubtful),
            ("ROS_SECURITY_ENABLE", "true", Verdict::Bad),
            ("FASTDDS_DEFAULT_PROFILES_FILE", "/x.xml", Verdict::Doubtful),
            ("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp", Verdict::Doubtful),
        ] {
            let findings = of(&[(name, value)]);
            let worst = findings.iter().max_by_key(|finding| finding.verdict).unwrap();
            assert_eq!(worst.verdict, verdict, "{name}");
            assert!(!worst.next.is_empty(), "{name}");
        }
        // A profile of a middleware that nobody uses says nothing.
        assert!(of(&[("CYCLONEDDS_URI", "x")]).iter().all(|f| f.verdict == Verdict::Good));
    }

    #[test]
    fn ports_tell_the_domain_and_the_participant() {
        assert_eq!(participant_of(7410), Some((0, 0)));
        assert_eq!(participant_of(7412), Some((0, 1)));
        assert_eq!(participant_of(7411), None, "that of data");
        assert_eq!(participant_of(7400), None, "that of multicast");
        assert_eq!(participant_of(7400 + 250 * 42 + 10 + 2 * 7), Some((42, 7)));
        assert_eq!(participant_of(53), None);
        let line = "  12: 0100007F:1CF2 00000000:0000 07 00000000:00000000 00:00000000 00000000";
        assert_eq!(local_port(line), Some(7410));
        assert_eq!(local_port("  sl  local_address rem_address   st tx_queue"), None);
    }

    #[test]
    fn others_in_other_domains_are_told_of() {
        let here = BTreeMap::from([(0, 1), (7, 3)]);
        let elsewhere = BTreeMap::from([(42, BTreeSet::from([Ipv4Addr::new(10, 0, 0, 9)]))]);
        let told = other_domains(0, &here, &elsewhere);
        let facts: Vec<&str> = told.iter().map(|finding| finding.fact.as_str()).collect();
        assert_eq!(
            facts,
            [
                "3 participants of this machine are in domain 7",
                "domain 42 has participants on 10.0.0.9"
            ]
        );
        assert!(told[1].next.contains("ROS_DOMAIN_ID=42"));
    }

    #[test]
    fn hashes_and_types_are_read_from_what_middlewares_write() {
        assert_eq!(hash(b"typehash=RIHS01_ab;"), Some("RIHS01_ab"));
        assert_eq!(hash(b"enclave=/;typehash=RIHS01_ab;"), Some("RIHS01_ab"));
        assert_eq!(hash(b"typehash=INVALID;"), None);
        assert_eq!(plain_type("std_msgs::msg::dds_::String_"), "std_msgs/msg/String");
        assert_eq!(plain_type("a::srv::dds_::B_Request_"), "a/srv/B_Request");
    }
}
