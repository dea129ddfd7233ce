//! YAML as ROS 2 uses it: the value of `-p name:=value`, and parameter files.

use ros2_client::ParameterValue;
use saphyr::{LoadableYamlNode, Scalar, Yaml};

/// Why a text is not a value or not a parameter file.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum YamlError {
    /// Not YAML at all.
    #[error("not YAML: {0}")]
    Syntax(String),
    /// YAML, but not of the form of a parameter file.
    #[error("{at}: {reason}")]
    Form {
        /// Where in the file.
        at: String,
        /// What is wrong there.
        reason: String,
    },
}

/// The parameters that a file gives to the nodes that a pattern matches.
#[derive(Debug, Clone, PartialEq)]
pub struct Section {
    /// The nodes, such as `/**`, `/left/tcvae`, `tcvae`.
    pub nodes: String,
    /// Names, with dots between their levels, and values.
    pub parameters: Vec<(String, ParameterValue)>,
}

impl Section {
    /// Whether the section is for the node of this fully qualified name. `*` stands for one part
    /// of a name, `**` for any number of them.
    pub fn matches(&self, fully_qualified: &str) -> bool {
        fn glob(pattern: &[&str], name: &[&str]) -> bool {
            match (pattern.split_first(), name.split_first()) {
                (None, None) => true,
                (Some((&"**", rest)), _) => (0..=name.len()).any(|i| glob(rest, &name[i..])),
                (Some((p, rest)), Some((n, others))) => (*p == "*" || p == n) && glob(rest, others),
                _ => false,
            }
        }
        fn parts(name: &str) -> Vec<&str> {
            name.split('/').filter(|p| !p.is_empty()).collect()
        }
        glob(&parts(&self.nodes), &parts(fully_qualified))
    }
}

/// The value that a text means: a boolean, a number, a string, or an array of them.
///
/// # Errors
/// Text that is not YAML; a mapping; an array of mixed types.
pub fn value(text: &str) -> Result<ParameterValue, YamlError> {
    let documents = Yaml::load_from_str(text).map_err(|e| YamlError::Syntax(e.to_string()))?;
    match documents.first() {
        None => Ok(ParameterValue::String(String::new())),
        Some(node) => convert(node, text),
    }
}

/// The sections of a parameter file, in the order of the file.
///
/// # Errors
/// Text that is not YAML; a section without `ros__parameters`; a value of no ROS type.
pub fn sections(text: &str) -> Result<Vec<Section>, YamlError> {
    let documents = Yaml::load_from_str(text).map_err(|e| YamlError::Syntax(e.to_string()))?;
    let mut sections = Vec::new();
    for document in &documents {
        collect_sections(document, "", &mut sections)?;
    }
    Ok(sections)
}

fn collect_sections(
    node: &Yaml,
    namespace: &str,
    sections: &mut Vec<Section>,
) -> Result<(), YamlError> {
    let at = if namespace.is_empty() { "the file" } else { namespace };
    let Some(mapping) = node.as_mapping() else {
        return Err(form(at, "expected names of nodes, and ros__parameters below them"));
    };
    for (key, node) in mapping {
        let key = key_text(key, at)?;
        if key == "ros__parameters" {
            let mut parameters = Vec::new();
            collect_parameters(node, "", &mut parameters)?;
            sections.push(Section { nodes: namespace.into(), parameters });
        } else {
            collect_sections(node, &format!("{namespace}/{}", key.trim_matches('/')), sections)?;
        }
    }
    Ok(())
}

fn collect_parameters(
    node: &Yaml,
    prefix: &str,
    parameters: &mut Vec<(String, ParameterValue)>,
) -> Result<(), YamlError> {
    let at = if prefix.is_empty() { "ros__parameters" } else { prefix };
    let Some(mapping) = node.as_mapping() else {
        return Err(form(at, "expected names and values of parameters"));
    };
    for (key, node) in mapping {
        let key = key_text(key, at)?;
        let name = if prefix.is_empty() { key } else { format!("{prefix}.{key}") };
        if node.is_mapping() {
            collect_parameters(node, &name, parameters)?;
        } else {
            let value = convert(node, &name)?;
            parameters.push((name, value));
        }
    }
    Ok(())
}

fn key_text(key: &Yaml, at: &str) -> Result<String, YamlError> {
    key.as_str().map(Into::into).ok_or_else(|| form(at, format!("the key {key:?} is not text")))
}

fn convert(node: &Yaml, at: &str) -> Result<ParameterValue, YamlError> {
    if let Some(sequence) = node.as_sequence() {
        return convert_sequence(sequence, at);
    }
    match node {
        Yaml::Value(Scalar::Boolean(value)) => Ok(ParameterValue::Boolean(*value)),
        Yaml::Value(Scalar::Integer(value)) => Ok(ParameterValue::Integer(*value)),
        Yaml::Value(Scalar::FloatingPoint(value)) => Ok(ParameterValue::Double(value.0)),
        Yaml::Value(Scalar::String(value)) => Ok(ParameterValue::String(value.to_string())),
        Yaml::Value(Scalar::Null) => Ok(ParameterValue::String(String::new())),
        _ => Err(form(at, "not a boolean, a number, a string, or an array of them")),
    }
}

/// An array of one type; whole numbers among decimals become decimals, and an empty array, whose
/// type nothing tells, is one of decimals.
fn convert_sequence(sequence: &[Yaml], at: &str) -> Result<ParameterValue, YamlError> {
    let number = |y: &Yaml| y.as_integer().map(|i| i as f64).or_else(|| y.as_floating_point());
    if !sequence.is_empty()
        && let Some(values) = sequence.iter().map(|y| y.as_integer()).collect()
    {
        return Ok(ParameterValue::IntegerArray(values));
    }
    if let Some(values) = sequence.iter().map(number).collect() {
        return Ok(ParameterValue::DoubleArray(values));
    }
    if let Some(values) = sequence.iter().map(|y| y.as_bool()).collect() {
        return Ok(ParameterValue::BooleanArray(values));
    }
    if let Some(values) = sequence.iter().map(|y| y.as_str().map(Into::into)).collect() {
        return Ok(ParameterValue::StringArray(values));
    }
    Err(form(at, "the values of an array have one type"))
}

fn form(at: &str, reason: impl Into<String>) -> YamlError {
    YamlError::Form { at: at.into(), reason: reason.into() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ParameterValue as P;

    #[test]
    fn a_value_has_the_type_that_its_text_shows() {
        for (text, expected) in [
            ("true", P::Boolean(true)),
            ("7", P::Integer(7)),
            ("-3", P::Integer(-3)),
            ("0.5", P::Double(0.5)),
            ("1e-3", P::Double(1e-3)),
            ("prior", P::String("prior".into())),
            ("'7'", P::String("7".into())),
            ("/a/b.safetensors", P::String("/a/b.safetensors".into())),
            ("", P::String(String::new())),
            ("[0.6, 0]", P::DoubleArray(vec![0.6, 0.0])),
            ("[1, 2]", P::IntegerArray(vec![1, 2])),
            ("[]", P::DoubleArray(vec![])),
            ("[a, b]", P::StringArray(vec!["a".into(), "b".into()])),
            ("[true, false]", P::BooleanArray(vec![true, false])),
        ] {
            assert_eq!(value(text).unwrap(), expected, "{text}");
        }
        assert!(matches!(value(".nan").unwrap(), P::Double(v) if v.is_nan()));
    }

    #[test]
    fn an_array_of_two_types_and_a_mapping_are_refused() {
        assert!(value("[1, a]").is_err());
        assert!(value("{a: 1}").is_err());
        assert!(value("[1, 2").is_err());
    }

    #[test]
    fn a_parameter_file_has_sections_of_nodes_with_nested_names() {
        let text = "
/**:
  ros__parameters:
    sample:
      seed: 3
      max_tries: 5
/left:
  tcvae:
    ros__parameters:
      manner.mode: prior
";
        let found = sections(text).unwrap();
        assert_eq!(found[0].nodes, "/**");
        assert_eq!(
            found[0].parameters,
            [("sample.seed".into(), P::Integer(3)), ("sample.max_tries".into(), P::Integer(5))]
        );
        assert_eq!(found[1].nodes, "/left/tcvae");
        assert_eq!(found[1].parameters, [("manner.mode".into(), P::String("prior".into()))]);
    }

    #[test]
    fn sections_match_nodes_by_parts_of_their_names() {
        let matches =
            |nodes: &str, name| Section { nodes: nodes.into(), parameters: vec![] }.matches(name);
        for nodes in ["/**", "/tcvae", "tcvae", "/*", "/**/tcvae"] {
            assert!(matches(nodes, "/tcvae"), "{nodes}");
        }
        assert!(matches("/left/tcvae", "/left/tcvae"));
        assert!(matches("/*/tcvae", "/left/tcvae"));
        assert!(matches("/**/tcvae", "/a/b/tcvae"));
        assert!(!matches("tcvae", "/left/tcvae"));
        assert!(!matches("/*", "/left/tcvae"));
        assert!(!matches("/other", "/tcvae"));
    }

    #[test]
    fn a_file_without_sections_says_what_it_expected() {
        let error = sections("sample.seed: 3").unwrap_err().to_string();
        assert_eq!(error, "/sample.seed: expected names of nodes, and ros__parameters below them");
        assert!(sections("a: [").is_err());
        assert_eq!(sections("").unwrap(), []);
    }
}
