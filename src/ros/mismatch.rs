//! Endpoints of one topic that do not match: in what, and what to do about it.

use rustdds::dds::qos::QosPolicyId;
use rustdds::{QosPolicies, policy};

/// What may be done on either side, so that a publisher and a subscription match.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fixes {
    /// By who publishes.
    pub publisher: &'static str,
    /// By who subscribes.
    pub subscription: &'static str,
}

/// A topic's name as ROS has it, from how DDS does, where parts of services have names of their own.
pub fn ros_name(dds: &str) -> &str {
    ["rt", "rq", "rr"].iter().find_map(|prefix| dds.strip_prefix(prefix)).unwrap_or(dds)
}

/// In what a publisher and a subscription do not match, and what to do about it.
///
/// # Arguments
/// * `who`: such as `a subscription`
pub fn mismatch(
    topic: &str,
    who: &str,
    offered: &QosPolicies,
    requested: &QosPolicies,
) -> (String, Fixes) {
    let policy = offered.compliance_failure_wrt(requested);
    let of = |offer: &str, request: &str| format!("{offer} is offered, {request} requested");
    let (name, what, publisher, subscription) = match policy {
        Some(QosPolicyId::Reliability) => {
            let says = |qos: &QosPolicies| match qos.reliability() {
                Some(policy::Reliability::Reliable { .. }) => "reliable",
                _ => "best effort",
            };
            (
                "reliability",
                of(says(offered), says(requested)),
                "publish with reliable reliability (ros2 topic pub --qos-reliability reliable)",
                "subscribe with best effort reliability (ros2 topic echo --qos-reliability best_effort)",
            )
        }
        Some(QosPolicyId::Durability) => {
            let says = |qos: &QosPolicies| match qos.durability() {
                None | Some(policy::Durability::Volatile) => "volatile",
                Some(_) => "transient local",
            };
            (
                "durability",
                of(says(offered), says(requested)),
                "publish with transient local durability (ros2 topic pub --qos-durability transient_local)",
                "subscribe with volatile durability (ros2 topic echo --qos-durability volatile)",
            )
        }
        Some(QosPolicyId::Deadline) => (
            "deadline",
            "the offered one is longer than the requested".into(),
            "offer a shorter deadline",
            "request none",
        ),
        Some(QosPolicyId::Liveliness) => (
            "liveliness",
            "less is offered than requested".into(),
            "offer what is requested",
            "request automatic liveliness",
        ),
        other => {
            let what = other.map(|policy| format!("{policy:?}")).unwrap_or_default();
            ("QoS", what, "compare ros2 topic info -v", "compare ros2 topic info -v")
        }
    };
    let fact = format!(
        "{who} of {topic} does not match in {name} ({what}), so that nothing passes between them"
    );
    (fact, Fixes { publisher, subscription })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustdds::QosPolicyBuilder;

    #[test]
    fn a_mismatch_is_told_with_its_fix() {
        let reliable = QosPolicyBuilder::new()
            .reliability(policy::Reliability::Reliable {
                max_blocking_time: rustdds::Duration::ZERO,
            })
            .build();
        let best_effort =
            QosPolicyBuilder::new().reliability(policy::Reliability::BestEffort).build();
        let latched =
            QosPolicyBuilder::new().durability(policy::Durability::TransientLocal).build();
        let (told, fixes) = mismatch("/t", "a publisher", &best_effort, &reliable);
        assert!(
            told.contains("reliability (best effort is offered, reliable requested)"),
            "{told}"
        );
        assert!(fixes.publisher.contains("publish with reliable"));
        let (told, fixes) = mismatch("/t", "a subscription", &QosPolicies::qos_none(), &latched);
        assert!(
            told.contains("durability (volatile is offered, transient local requested)"),
            "{told}"
        );
        assert!(fixes.subscription.contains("--qos-durability volatile"));
    }

    #[test]
    fn names_on_the_wire_are_those_of_ros_with_something_ahead() {
        assert_eq!(ros_name("rt/tcvae/goal_pose"), "/tcvae/goal_pose");
        assert_eq!(ros_name("rq/tcvae/sampleRequest"), "/tcvae/sampleRequest");
        assert_eq!(ros_name("ros_discovery_info"), "ros_discovery_info");
    }
}
