//! What the environment of a ROS 2 process says: the domain, how far discovery reaches, and how
//! services are laid out.

use ros2_client::ServiceMapping;

/// Largest domain that has ports: those of domain 232 start at 7400 + 250 * 232 = 65400.
pub const MAX_DOMAIN: u16 = 232;

/// Why the environment is refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum EnvironmentError {
    /// A domain that does not exist.
    #[error(
        "ROS_DOMAIN_ID is {value:?}; domains are whole numbers from 0 to {MAX_DOMAIN}. \
         Set one of them, or unset it for domain 0"
    )]
    Domain {
        /// The value.
        value: String,
    },
    /// A range that does not exist.
    #[error(
        "ROS_AUTOMATIC_DISCOVERY_RANGE is {value:?}; it is one of OFF, LOCALHOST, SUBNET, \
         SYSTEM_DEFAULT. Set one of them, or unset it for SUBNET"
    )]
    Range {
        /// The value.
        value: String,
    },
}

/// How far discovery reaches.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DiscoveryRange {
    /// Nobody is found and nobody finds the node.
    Off,
    /// This machine.
    Localhost,
    /// Every machine that multicast reaches.
    Subnet,
}

/// The environment of the node.
#[derive(Debug, Clone, PartialEq)]
pub struct Environment {
    /// The DDS domain, 0 to [`MAX_DOMAIN`].
    pub domain: u16,
    /// How far discovery reaches.
    pub range: DiscoveryRange,
    /// Machines that are told of the node directly, by name or address.
    pub static_peers: Vec<String>,
    /// How the clients' middleware lays out services.
    pub service_mapping: ServiceMapping,
    /// Settings that the node can't follow, in words.
    pub warnings: Vec<String>,
}

impl Environment {
    /// Reads the variables that `variable` looks up.
    ///
    /// # Errors
    /// A domain or a discovery range that does not exist.
    pub fn read(variable: impl Fn(&str) -> Option<String>) -> Result<Self, EnvironmentError> {
        let variable = |name| variable(name).map(|v| v.trim().to_owned()).filter(|v| !v.is_empty());
        let domain = match variable("ROS_DOMAIN_ID") {
            None => 0,
            Some(value) => match value.parse() {
                Ok(domain) if domain <= MAX_DOMAIN => domain,
                _ => return Err(EnvironmentError::Domain { value }),
            },
        };
        // As in rcl, the older variable decides where it is set.
        let range = match variable("ROS_LOCALHOST_ONLY").as_deref() {
            Some("1") => DiscoveryRange::Localhost,
            Some(_) => DiscoveryRange::Subnet,
            None => match variable("ROS_AUTOMATIC_DISCOVERY_RANGE") {
                None => DiscoveryRange::Subnet,
                Some(value) => match value.to_ascii_uppercase().as_str() {
                    "OFF" => DiscoveryRange::Off,
                    "LOCALHOST" => DiscoveryRange::Localhost,
                    "SUBNET" | "SYSTEM_DEFAULT" => DiscoveryRange::Subnet,
                    _ => return Err(EnvironmentError::Range { value }),
                },
            },
        };
        let mut warnings = Vec::new();
        let mut static_peers: Vec<String> = variable("ROS_STATIC_PEERS")
            .iter()
            .flat_map(|peers| peers.split(';'))
            .map(|peer| peer.trim().to_owned())
            .filter(|peer| !peer.is_empty())
            .collect();
        if !static_peers.is_empty() {
            match range {
                DiscoveryRange::Subnet => {}
                DiscoveryRange::Localhost => warnings.push(
                    "with static peers the node can also be found by multicast on the subnet, \
                     although the discovery range is LOCALHOST"
                        .into(),
                ),
                DiscoveryRange::Off => {
                    static_peers.clear();
                    warnings
                        .push("ROS_STATIC_PEERS has no effect: the discovery range is OFF".into());
                }
            }
        }
        let service_mapping = match variable("RMW_IMPLEMENTATION").as_deref() {
            Some("rmw_cyclonedds_cpp") => ServiceMapping::Cyclone,
            Some(other @ ("rmw_zenoh_cpp" | "rmw_zenoh")) => {
                warnings.push(format!(
                    "RMW_IMPLEMENTATION is {other}, but this node speaks DDS: clients see it only \
                     with a DDS middleware such as rmw_fastrtps_cpp"
                ));
                ServiceMapping::Enhanced
            }
            _ => ServiceMapping::Enhanced,
        };
        Ok(Self { domain, range, static_peers, service_mapping, warnings })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(variables: &[(&str, &str)]) -> Result<Environment, EnvironmentError> {
        Environment::read(|name| {
            variables.iter().find(|(n, _)| *n == name).map(|(_, value)| (*value).to_owned())
        })
    }

    #[test]
    fn an_empty_environment_is_domain_0_on_the_subnet() {
        let environment = read(&[]).unwrap();
        assert_eq!((environment.domain, environment.range), (0, DiscoveryRange::Subnet));
        assert_eq!(environment.service_mapping, ServiceMapping::Enhanced);
        assert!(environment.warnings.is_empty());
    }

    #[test]
    fn domains_from_0_to_232_exist() {
        assert_eq!(read(&[("ROS_DOMAIN_ID", "232")]).unwrap().domain, 232);
        assert_eq!(read(&[("ROS_DOMAIN_ID", " 7 ")]).unwrap().domain, 7);
        assert_eq!(read(&[("ROS_DOMAIN_ID", "")]).unwrap().domain, 0);
        for value in ["233", "-1", "x", "1.5", "99999999999"] {
            let error = read(&[("ROS_DOMAIN_ID", value)]).unwrap_err();
            assert!(error.to_string().contains("from 0 to 232"), "{error}");
        }
    }

    #[test]
    fn the_discovery_range_is_read_in_any_case_and_the_older_variable_decides() {
        let range = |variables: &[_]| read(variables).map(|e| e.range);
        const NAME: &str = "ROS_AUTOMATIC_DISCOVERY_RANGE";
        assert_eq!(range(&[(NAME, "localhost")]), Ok(DiscoveryRange::Localhost));
        assert_eq!(range(&[(NAME, "OFF")]), Ok(DiscoveryRange::Off));
        assert_eq!(range(&[(NAME, "SYSTEM_DEFAULT")]), Ok(DiscoveryRange::Subnet));
        assert!(range(&[(NAME, "HOST")]).is_err());
        assert_eq!(
            range(&[(NAME, "SUBNET"), ("ROS_LOCALHOST_ONLY", "1")]),
            Ok(DiscoveryRange::Localhost)
        );
        assert_eq!(range(&[("ROS_LOCALHOST_ONLY", "0")]), Ok(DiscoveryRange::Subnet));
    }

    #[test]
    fn static_peers_are_separated_by_semicolons_and_nobody_where_discovery_is_off() {
        let peers = |range| {
            read(&[
                ("ROS_STATIC_PEERS", "10.0.0.2; robot.local;;"),
                ("ROS_AUTOMATIC_DISCOVERY_RANGE", range),
            ])
            .map(|e| (e.static_peers, e.warnings.len()))
        };
        let both = vec!["10.0.0.2".to_owned(), "robot.local".to_owned()];
        assert_eq!(peers("SUBNET"), Ok((both.clone(), 0)));
        assert_eq!(peers("LOCALHOST"), Ok((both, 1)));
        assert_eq!(peers("OFF"), Ok((vec![], 1)));
    }

    #[test]
    fn what_the_node_cannot_follow_is_a_warning() {
        let environment =
            read(&[("ROS_LOCALHOST_ONLY", "1"), ("RMW_IMPLEMENTATION", "rmw_zenoh_cpp")]);
        assert_eq!(environment.unwrap().warnings.len(), 1);
        let cyclone = read(&[("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp")]).unwrap();
        assert_eq!(cyclone.service_mapping, ServiceMapping::Cyclone);
    }
}
