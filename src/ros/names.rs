//! Names as a ROS 2 user knows them: namespaces, `~`, relative names, `{node}`, and remapping.
//!
//! The rules are those of `rcl`: a name is expanded first, then the first remap rule whose left
//! side, expanded in the same way, equals it decides. The node's own name and namespace are
//! remapped before anything else.

use std::fmt;

/// Why something is not a name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NameError {
    /// A part of a name that ROS 2 does not allow.
    #[error("{name:?} is not a {kind}: {reason}")]
    Invalid {
        /// The name.
        name: String,
        /// What it should be.
        kind: &'static str,
        /// What is wrong with it.
        reason: String,
    },
}

/// What a remap rule applies to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RemapFrom {
    /// `__node` or `__name`: the node's name.
    Node,
    /// `__ns`: the node's namespace.
    Namespace,
    /// A name of topics and services.
    Any(String),
    /// A name of topics, written `rostopic://name`.
    Topic(String),
    /// A name of services, written `rosservice://name`.
    Service(String),
}

/// One remap rule, `[node:]from:=to`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Remap {
    /// The node that the rule is for; all where there is none.
    pub node: Option<String>,
    /// What it applies to.
    pub from: RemapFrom,
    /// What it becomes.
    pub to: String,
}

/// Names of topics or names of services.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Topic,
    Service,
}

/// The node's name and namespace, and the remap rules that its topics and services go through.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NodeNames {
    namespace: String,
    name: String,
    rules: Vec<Remap>,
}

impl NodeNames {
    /// The names of a node that is called `name` in namespace `/` unless a rule says otherwise.
    ///
    /// # Errors
    /// A rule that makes the name or the namespace invalid.
    pub fn new(name: &str, rules: &[Remap]) -> Result<Self, NameError> {
        let first = |wanted: &RemapFrom, name: &str| {
            rules
                .iter()
                .find(|r| r.from == *wanted && r.node.as_deref().is_none_or(|n| n == name))
                .map(|r| r.to.clone())
        };
        let name = first(&RemapFrom::Node, name).unwrap_or_else(|| name.into());
        check_token(&name, "node name", &name)?;
        let namespace = first(&RemapFrom::Namespace, &name).unwrap_or_else(|| "/".into());
        if namespace != "/" {
            check_absolute(&namespace, "namespace")?;
        }
        let rules = rules.iter().filter(|r| r.node.as_deref().is_none_or(|n| n == name)).cloned();
        Ok(Self { namespace, rules: rules.collect(), name })
    }

    /// The node's namespace, `/` or `/a/b`.
    pub fn namespace(&self) -> &str {
        &self.namespace
    }

    /// The node's name without its namespace.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The node's name with its namespace, `/a/b/tcvae`.
    pub fn fully_qualified(&self) -> String {
        join(&self.namespace, &self.name)
    }

    /// The name under which the node's log messages appear, `a.b.tcvae`.
    pub fn logger(&self) -> String {
        self.fully_qualified()[1..].replace('/', ".")
    }

    /// The absolute name of the topic that the code calls `name`.
    ///
    /// # Errors
    /// A name that is not allowed, as written or as remapped.
    pub fn topic(&self, name: &str) -> Result<String, NameError> {
        self.resolve(name, Kind::Topic)
    }

    /// The absolute name of the service that the code calls `name`.
    ///
    /// # Errors
    /// A name that is not allowed, as written or as remapped.
    pub fn service(&self, name: &str) -> Result<String, NameError> {
        self.resolve(name, Kind::Service)
    }

    fn resolve(&self, name: &str, kind: Kind) -> Result<String, NameError> {
        let expanded = self.expand(name)?;
        for rule in &self.rules {
            let from = match (&rule.from, kind) {
                (RemapFrom::Any(from), _)
                | (RemapFrom::Topic(from), Kind::Topic)
                | (RemapFrom::Service(from), Kind::Service) => from,
                _ => continue,
            };
            if self.expand(from)? == expanded {
                return self.expand(&rule.to);
            }
        }
        Ok(expanded)
    }

    /// An absolute name: `~` is the node, `{node}` and `{ns}` are replaced, a relative name starts
    /// at the namespace.
    fn expand(&self, name: &str) -> Result<String, NameError> {
        let namespace = self.namespace.trim_start_matches('/');
        let replaced = name
            .replace("{node}", &self.name)
            .replace("{ns}", namespace)
            .replace("{namespace}", namespace);
        let absolute = match replaced.strip_prefix('~') {
            Some("") => self.fully_qualified(),
            Some(rest) => match rest.strip_prefix('/') {
                Some(rest) => join(&self.fully_qualified(), rest),
                None => {
                    return Err(NameError::Invalid {
                        name: name.into(),
                        kind: "name",
                        reason: format!("a slash follows ~; write ~/{rest}"),
                    });
                }
            },
            None if replaced.starts_with('/') => replaced,
            None => join(&self.namespace, &replaced),
        };
        check_absolute(&absolute, "name")?;
        Ok(absolute)
    }
}

impl fmt::Display for NodeNames {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.fully_qualified())
    }
}

/// `name` under `namespace`.
fn join(namespace: &str, name: &str) -> String {
    format!("{}/{name}", namespace.trim_end_matches('/'))
}

/// An absolute name of one or more allowed parts.
fn check_absolute(name: &str, kind: &'static str) -> Result<(), NameError> {
    let invalid = |reason: String| NameError::Invalid { name: name.into(), kind, reason };
    let Some(rest) = name.strip_prefix('/') else {
        return Err(invalid(format!("it starts with a slash; write /{name}")));
    };
    rest.split('/').try_for_each(|token| check_token(token, kind, name))
}

/// One part between slashes: letters, digits and underscores, not starting with a digit.
fn check_token(token: &str, kind: &'static str, name: &str) -> Result<(), NameError> {
    let invalid = |reason: String| NameError::Invalid { name: name.into(), kind, reason };
    if token.is_empty() {
        return Err(invalid("a part of it is empty".into()));
    }
    if let Some(c) = token.chars().find(|c| !(c.is_ascii_alphanumeric() || *c == '_')) {
        return Err(invalid(format!("{c:?} is neither a letter, a digit nor an underscore")));
    }
    if token.starts_with(|c: char| c.is_ascii_digit()) {
        return Err(invalid(format!("{token:?} starts with a digit")));
    }
    if token.contains("__") {
        return Err(invalid(format!("{token:?} has two underscores in a row")));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rule(from: RemapFrom, to: &str) -> Remap {
        Remap { node: None, from, to: to.into() }
    }

    fn any(from: &str, to: &str) -> Remap {
        rule(RemapFrom::Any(from.into()), to)
    }

    #[test]
    fn private_relative_and_absolute_names_expand_as_in_rcl() {
        let names = NodeNames::new("tcvae", &[rule(RemapFrom::Namespace, "/left/arm")]).unwrap();
        for (name, expected) in [
            ("~/goal_pose", "/left/arm/tcvae/goal_pose"),
            ("~", "/left/arm/tcvae"),
            ("goal_pose", "/left/arm/goal_pose"),
            ("/goal_pose", "/goal_pose"),
            ("{node}/x", "/left/arm/tcvae/x"),
            ("/{ns}/x", "/left/arm/x"),
        ] {
            assert_eq!(names.topic(name).unwrap(), expected);
        }
        assert_eq!(names.fully_qualified(), "/left/arm/tcvae");
        assert_eq!(names.logger(), "left.arm.tcvae");
    }

    #[test]
    fn in_the_root_namespace_no_slash_is_doubled() {
        let names = NodeNames::new("tcvae", &[]).unwrap();
        assert_eq!(names.topic("joint_states").unwrap(), "/joint_states");
        assert_eq!(names.topic("~/x").unwrap(), "/tcvae/x");
    }

    #[test]
    fn the_first_rule_that_fits_decides_and_both_sides_are_expanded() {
        let rules = [any("~/goal_pose", "/goal"), any("/tcvae/goal_pose", "/never"), any("a", "b")];
        let names = NodeNames::new("tcvae", &rules).unwrap();
        assert_eq!(names.topic("~/goal_pose").unwrap(), "/goal");
        assert_eq!(names.topic("/a").unwrap(), "/b");
        assert_eq!(names.service("~/sample").unwrap(), "/tcvae/sample");
    }

    #[test]
    fn a_renamed_node_takes_its_private_names_along() {
        let rules = [rule(RemapFrom::Node, "right"), any("~/goal_pose", "~/target")];
        let names = NodeNames::new("tcvae", &rules).unwrap();
        assert_eq!(names.topic("~/goal_pose").unwrap(), "/right/target");
    }

    #[test]
    fn rules_for_topics_services_and_other_nodes_stay_apart() {
        let rules = [
            rule(RemapFrom::Topic("x".into()), "t"),
            rule(RemapFrom::Service("x".into()), "s"),
            Remap { node: Some("other".into()), ..any("y", "z") },
            Remap { node: Some("tcvae".into()), ..any("u", "v") },
        ];
        let names = NodeNames::new("tcvae", &rules).unwrap();
        assert_eq!(names.topic("x").unwrap(), "/t");
        assert_eq!(names.service("x").unwrap(), "/s");
        assert_eq!(names.topic("y").unwrap(), "/y");
        assert_eq!(names.topic("u").unwrap(), "/v");
    }

    #[test]
    fn names_that_ros_does_not_allow_are_refused_with_the_reason() {
        let refused = |rules: &[Remap]| NodeNames::new("tcvae", rules).unwrap_err().to_string();
        assert_eq!(
            refused(&[rule(RemapFrom::Namespace, "left")]),
            "\"left\" is not a namespace: it starts with a slash; write /left"
        );
        assert_eq!(
            refused(&[rule(RemapFrom::Node, "a/b")]),
            "\"a/b\" is not a node name: '/' is neither a letter, a digit nor an underscore"
        );
        let names = NodeNames::new("tcvae", &[any("x", "1y")]).unwrap();
        assert_eq!(
            names.topic("x").unwrap_err().to_string(),
            "\"/1y\" is not a name: \"1y\" starts with a digit"
        );
        assert!(names.topic("~x").is_err());
        assert!(names.topic("a//b").is_err());
        assert!(names.topic("a/").is_err());
    }
}
