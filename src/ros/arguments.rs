//! The node's command line: `--model`, `--robot`, `--urdf`, and everything that `rcl` understands after
//! `--ros-args`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use log::LevelFilter;
use ros2_client::ParameterValue;

use super::names::{NameError, NodeNames, Remap, RemapFrom};
use super::yaml;

/// What `--help` prints.
pub const HELP: &str = "\
Serves a learned movement primitive on ROS 2: a goal pose in, a checked trajectory out.

Usage: tcvae_node [OPTIONS] [--ros-args [ROS OPTIONS] [--]]

Without options it serves the built-in model on the built-in Baxter description.

Options:
  --model FILE      the model to serve; same as the parameter model_path
  --robot FILE      the robot's TOML, as tcvae's --robot; same as the parameter robot_path
  --urdf FILE       the robot's description alone; same as the parameter urdf_path
  -h, --help        print this and leave
  -V, --version     print the version and leave

ROS options, after --ros-args:
  -r, --remap FROM:=TO        rename a topic or a service; __ns:=/left, __node:=name
  -p, --param NAME:=VALUE     set a parameter; a list is in `ros2 param list /tcvae`
  --params-file FILE          set the parameters that a YAML file holds
  --log-level [LOGGER:=]LEVEL debug, info, warn, error or fatal
  --disable-rosout-logs       don't publish log messages on /rosout

Environment: ROS_DOMAIN_ID, ROS_AUTOMATIC_DISCOVERY_RANGE, ROS_LOCALHOST_ONLY,
RMW_IMPLEMENTATION (only to match the service layout of rmw_cyclonedds_cpp).
";

/// Why the command line is refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ArgumentError {
    /// An argument that the node does not have.
    #[error("unknown argument {argument:?}; {hint}")]
    Unknown {
        /// The argument.
        argument: String,
        /// What was probably meant.
        hint: String,
    },
    /// A flag without its value.
    #[error("{flag} needs a value: {flag} {form}")]
    Missing {
        /// The flag.
        flag: String,
        /// The form of its value.
        form: &'static str,
    },
    /// A value of the wrong form.
    #[error("{flag} {value:?} is not of the form {form}")]
    Form {
        /// The flag.
        flag: String,
        /// The value.
        value: String,
        /// The form that it needs.
        form: &'static str,
    },
    /// A parameter's value that is not one.
    #[error("{flag} {value:?}: {source}")]
    Value {
        /// The flag.
        flag: String,
        /// The value.
        value: String,
        /// What is wrong with it.
        source: yaml::YamlError,
    },
    /// A parameter file that can't be read.
    #[error("parameter file {}: {source}", .path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// A parameter file that is not one.
    #[error("parameter file {}: {source}", .path.display())]
    ParameterFile {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: yaml::YamlError,
    },
    /// A name that is not allowed.
    #[error(transparent)]
    Name(#[from] NameError),
}

/// What the command line asks for.
#[derive(Debug, PartialEq)]
pub enum Command {
    /// Serve.
    Run(Arguments),
    /// Print [`HELP`].
    Help,
    /// Print the version.
    Version,
}

/// Where a parameter's value comes from.
#[derive(Debug, Clone, PartialEq)]
pub enum ParameterSource {
    /// `-p [node:]name:=value`.
    Value {
        /// The node that it is for; all where there is none.
        node: Option<String>,
        /// Name of the parameter.
        name: String,
        /// Its value.
        value: ParameterValue,
    },
    /// `--params-file`.
    File(PathBuf),
}

/// The level of one logger, or of the node's own.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LogLevel {
    /// Name of the logger; the node's own where there is none.
    pub logger: Option<String>,
    /// Least severe level that is logged.
    pub level: LevelFilter,
}

/// A command line that serves.
#[derive(Debug, Clone, PartialEq)]
pub struct Arguments {
    /// Remap rules, in their order.
    pub remaps: Vec<Remap>,
    /// Sources of parameters; a later one overrides an earlier one.
    pub parameters: Vec<ParameterSource>,
    /// Levels of the loggers, in their order.
    pub log_levels: Vec<LogLevel>,
    /// Whether log messages go to `/rosout`.
    pub rosout: bool,
    /// Whether log messages go to the terminal.
    pub terminal: bool,
    /// Options of `rcl` that have no meaning here.
    pub ignored: Vec<String>,
}

impl Default for Arguments {
    fn default() -> Self {
        Self {
            remaps: Vec::new(),
            parameters: Vec::new(),
            log_levels: Vec::new(),
            rosout: true,
            terminal: true,
            ignored: Vec::new(),
        }
    }
}

impl Arguments {
    /// Reads a command line, without the program's name.
    ///
    /// # Errors
    /// Arguments that are unknown, incomplete or of the wrong form.
    pub fn parse(arguments: impl IntoIterator<Item = String>) -> Result<Command, ArgumentError> {
        let mut parsed = Self::default();
        // `--model`, `--robot` and `--urdf` override parameter files, wherever they stand.
        let mut plain = Vec::new();
        let mut in_ros_arguments = false;
        let mut arguments = arguments.into_iter();
        while let Some(argument) = arguments.next() {
            match argument.as_str() {
                "--ros-args" => in_ros_arguments = true,
                "--" => in_ros_arguments = false,
                _ if in_ros_arguments => parsed.ros_argument(argument, &mut arguments)?,
                "-h" | "--help" => return Ok(Command::Help),
                "-V" | "--version" => return Ok(Command::Version),
                _ => plain.push(plain_argument(argument, &mut arguments)?),
            }
        }
        parsed.parameters.extend(plain);
        Ok(Command::Run(parsed))
    }

    fn ros_argument(
        &mut self,
        flag: String,
        rest: &mut impl Iterator<Item = String>,
    ) -> Result<(), ArgumentError> {
        match flag.as_str() {
            "-r" | "--remap" => {
                const FORM: &str = "FROM:=TO";
                let text = value_of(&flag, FORM, rest)?;
                let rule = remap(&text);
                self.remaps.push(rule.ok_or(ArgumentError::Form {
                    flag,
                    value: text,
                    form: FORM,
                })?);
            }
            "-p" | "--param" => {
                const FORM: &str = "NAME:=VALUE";
                let text = value_of(&flag, FORM, rest)?;
                self.parameters.push(parameter(flag, text, FORM)?);
            }
            "--params-file" => {
                let path = value_of(&flag, "FILE", rest)?.into();
                self.parameters.push(ParameterSource::File(path));
            }
            "--log-level" => {
                const FORM: &str = "LEVEL or LOGGER:=LEVEL (debug, info, warn, error, fatal)";
                let text = value_of(&flag, FORM, rest)?;
                let level = log_level(&text);
                self.log_levels.push(level.ok_or(ArgumentError::Form {
                    flag,
                    value: text,
                    form: FORM,
                })?);
            }
            "--enable-rosout-logs" => self.rosout = true,
            "--disable-rosout-logs" => self.rosout = false,
            "--enable-stdout-logs" => self.terminal = true,
            "--disable-stdout-logs" => self.terminal = false,
            "--enable-external-lib-logs" | "--disable-external-lib-logs" => {}
            "-e" | "--enclave" | "--log-config-file" | "--log-file-name" => {
                value_of(&flag, "VALUE", rest)?;
                self.ignored.push(flag);
            }
            _ => {
                let hint = if flag.contains(":=") {
                    format!("write -r {flag} to remap, -p {flag} to set a parameter")
                } else if ["--model", "--robot", "--urdf", "-h", "--help", "-V", "--version"]
                    .contains(&flag.as_str())
                {
                    "it stands before --ros-args, or after a closing --".to_owned()
                } else {
                    "after --ros-args stand -r, -p, --params-file and --log-level; \
                     see tcvae_node --help"
                        .to_owned()
                };
                return Err(ArgumentError::Unknown { argument: flag, hint });
            }
        }
        Ok(())
    }

    /// The parameters that the command line gives to the node, a later source overriding an
    /// earlier one. `read` reads a parameter file.
    ///
    /// # Errors
    /// A file that `read` fails on, or that is not a parameter file.
    pub fn overrides(
        &self,
        names: &NodeNames,
        read: impl Fn(&Path) -> std::io::Result<String>,
    ) -> Result<BTreeMap<String, ParameterValue>, ArgumentError> {
        let mut values = BTreeMap::new();
        for source in &self.parameters {
            match source {
                ParameterSource::Value { node, name, value } => {
                    if node.as_deref().is_none_or(|n| n == names.name()) {
                        values.insert(name.clone(), value.clone());
                    }
                }
                ParameterSource::File(path) => {
                    let text = read(path).map_err(|source| ArgumentError::Unreadable {
                        path: path.clone(),
                        source,
                    })?;
                    let sections = yaml::sections(&text).map_err(|source| {
                        ArgumentError::ParameterFile { path: path.clone(), source }
                    })?;
                    let node = names.fully_qualified();
                    for section in sections.into_iter().filter(|s| s.matches(&node)) {
                        values.extend(section.parameters);
                    }
                }
            }
        }
        Ok(values)
    }
}

/// `--model FILE`, `--robot FILE` or `--urdf=FILE`, as the parameter that it sets.
fn plain_argument(
    argument: String,
    rest: &mut impl Iterator<Item = String>,
) -> Result<ParameterSource, ArgumentError> {
    let (flag, value) = match argument.split_once('=') {
        Some((flag, value)) if flag.starts_with("--") => (flag, Some(value.to_owned())),
        _ => (argument.as_str(), None),
    };
    let name = match flag {
        "--model" => "model_path",
        "--robot" => "robot_path",
        "--urdf" => "urdf_path",
        _ => {
            let is_ros = ["-r", "-p", "--remap", "--param", "--params-file", "--log-level"]
                .contains(&flag)
                || argument.contains(":=");
            let hint = match is_ros {
                true => format!("write tcvae_node --ros-args {argument} …"),
                false => "there are --model FILE, --robot FILE, --urdf FILE, --help, --version, and --ros-args \
                          for the rest"
                    .to_owned(),
            };
            return Err(ArgumentError::Unknown { argument, hint });
        }
    };
    let value = match value {
        Some(value) => value,
        None => value_of(flag, "FILE", rest)?,
    };
    Ok(ParameterSource::Value {
        node: None,
        name: name.into(),
        value: ParameterValue::String(value),
    })
}

fn value_of(
    flag: &str,
    form: &'static str,
    rest: &mut impl Iterator<Item = String>,
) -> Result<String, ArgumentError> {
    rest.next().ok_or_else(|| ArgumentError::Missing { flag: flag.into(), form })
}

/// `[node:]from:=to`.
fn remap(text: &str) -> Option<Remap> {
    let (left, to) = text.split_once(":=")?;
    let (node, from) = match left.split_once("://") {
        Some(("rostopic", topic)) => (None, RemapFrom::Topic(topic.into())),
        Some(("rosservice", service)) => (None, RemapFrom::Service(service.into())),
        Some(_) => return None,
        None => {
            let (node, from) = split_node(left);
            let from = match from {
                "" => return None,
                "__node" | "__name" => RemapFrom::Node,
                "__ns" => RemapFrom::Namespace,
                name => RemapFrom::Any(name.into()),
            };
            (node, from)
        }
    };
    (!to.is_empty()).then(|| Remap { node, from, to: to.into() })
}

/// `[node:]name:=value`.
fn parameter(
    flag: String,
    text: String,
    form: &'static str,
) -> Result<ParameterSource, ArgumentError> {
    let Some((left, right)) = text.split_once(":=").filter(|(left, _)| !left.is_empty()) else {
        return Err(ArgumentError::Form { flag, value: text, form });
    };
    let (node, name) = split_node(left);
    match yaml::value(right) {
        Ok(value) => Ok(ParameterSource::Value { name: name.into(), value, node }),
        Err(source) => Err(ArgumentError::Value { flag, source, value: text }),
    }
}

fn split_node(left: &str) -> (Option<String>, &str) {
    match left.split_once(':') {
        Some((node, name)) => (Some(node.trim_start_matches('/').into()), name),
        None => (None, left),
    }
}

/// `LEVEL` or `LOGGER:=LEVEL`, in any case.
fn log_level(text: &str) -> Option<LogLevel> {
    let (logger, level) = match text.split_once(":=") {
        Some((logger, level)) => (Some(logger.to_owned()), level),
        None => (None, text),
    };
    let level = match level.to_ascii_lowercase().as_str() {
        "unset" | "debug" => LevelFilter::Debug,
        "info" => LevelFilter::Info,
        "warn" => LevelFilter::Warn,
        "error" | "fatal" => LevelFilter::Error,
        _ => return None,
    };
    Some(LogLevel { logger, level })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(line: &str) -> Result<Command, ArgumentError> {
        Arguments::parse(line.split_whitespace().map(Into::into))
    }

    fn run(line: &str) -> Arguments {
        match parse(line).unwrap() {
            Command::Run(arguments) => arguments,
            other => panic!("{other:?}"),
        }
    }

    fn overrides(line: &str, file: &str) -> BTreeMap<String, ParameterValue> {
        let names = NodeNames::new("tcvae", &run(line).remaps).unwrap();
        run(line).overrides(&names, |_| Ok(file.into())).unwrap()
    }

    fn refused(line: &str) -> String {
        parse(line).unwrap_err().to_string()
    }

    #[test]
    fn nothing_at_all_serves() {
        assert_eq!(run(""), Arguments::default());
    }

    #[test]
    fn help_and_version_are_asked_for_outside_ros_arguments() {
        assert_eq!(parse("--help").unwrap(), Command::Help);
        assert_eq!(parse("--ros-args -r a:=b -- -V").unwrap(), Command::Version);
        assert!(parse("--ros-args --help").is_err());
    }

    #[test]
    fn remap_rules_name_nodes_topics_and_services() {
        let arguments =
            run("--ros-args -r __ns:=/left --remap tcvae:__node:=pourer -r ~/goal_pose:=/goal \
             -r rostopic://a:=b -r rosservice:///c:=d");
        let expected = [
            (None, RemapFrom::Namespace, "/left"),
            (Some("tcvae".to_owned()), RemapFrom::Node, "pourer"),
            (None, RemapFrom::Any("~/goal_pose".into()), "/goal"),
            (None, RemapFrom::Topic("a".into()), "b"),
            (None, RemapFrom::Service("/c".into()), "d"),
        ];
        let found: Vec<_> = arguments.remaps.into_iter().map(|r| (r.node, r.from, r.to)).collect();
        assert_eq!(found, expected.map(|(node, from, to)| (node, from, to.to_owned())));
    }

    #[test]
    fn later_parameters_override_earlier_ones_and_other_nodes_are_left_out() {
        let file = "
/**: {ros__parameters: {sample.seed: 1, manner: {mode: prior}}}
other: {ros__parameters: {sample.seed: 2}}
";
        let line = "--ros-args -p sample.seed:=3 --params-file f.yaml -p task.tolerance_m:=0.01 \
                    -p tcvae:publish_on_task:=true -p other:base_frame:=x";
        let expected = [
            ("manner.mode", ParameterValue::String("prior".into())),
            ("publish_on_task", ParameterValue::Boolean(true)),
            ("sample.seed", ParameterValue::Integer(1)),
            ("task.tolerance_m", ParameterValue::Double(0.01)),
        ];
        let expected: BTreeMap<_, _> =
            expected.into_iter().map(|(name, value)| (name.to_owned(), value)).collect();
        assert_eq!(overrides(line, file), expected);
    }

    #[test]
    fn plain_flags_set_parameters_over_files() {
        let file = "/**: {ros__parameters: {model_path: from_file}}";
        let line = "--model a.safetensors --urdf=b.urdf --ros-args --params-file f.yaml";
        let found = overrides(line, file);
        assert_eq!(found["model_path"], ParameterValue::String("a.safetensors".into()));
        assert_eq!(found["urdf_path"], ParameterValue::String("b.urdf".into()));
    }

    #[test]
    fn log_levels_and_outputs_are_understood_in_any_case() {
        let arguments =
            run("--ros-args --log-level WARN --log-level rustdds:=debug --disable-rosout-logs \
             --enable-external-lib-logs --enclave /x");
        assert_eq!(
            arguments.log_levels,
            [
                LogLevel { logger: None, level: LevelFilter::Warn },
                LogLevel { logger: Some("rustdds".into()), level: LevelFilter::Debug },
            ]
        );
        assert!(!arguments.rosout && arguments.terminal);
        assert_eq!(arguments.ignored, ["--enclave"]);
    }

    #[test]
    fn what_is_unknown_or_incomplete_is_refused_with_a_hint() {
        assert_eq!(refused("-p a:=1"), "unknown argument \"-p\"; write tcvae_node --ros-args -p …");
        assert_eq!(
            refused("--ros-args __ns:=/left"),
            "unknown argument \"__ns:=/left\"; \
             write -r __ns:=/left to remap, -p __ns:=/left to set a parameter"
        );
        assert_eq!(
            refused("--ros-args --model f"),
            "unknown argument \"--model\"; it stands before --ros-args, or after a closing --"
        );
        assert_eq!(refused("--model"), "--model needs a value: --model FILE");
        assert_eq!(refused("--ros-args -p seed=3"), "-p \"seed=3\" is not of the form NAME:=VALUE");
        assert!(refused("--modle f").contains("--model FILE"));
        assert!(refused("--ros-args --log-level loud").contains("debug, info, warn"));
        assert!(refused("--ros-args -r a:=").contains("FROM:=TO"));
        assert!(refused("--ros-args -p a:=[1,x]").contains("one type"));
    }

    #[test]
    fn a_parameter_file_that_is_missing_or_malformed_is_named() {
        let arguments = run("--ros-args --params-file no/such.yaml");
        let names = NodeNames::new("tcvae", &[]).unwrap();
        let missing = |_: &Path| Err(std::io::Error::from(std::io::ErrorKind::NotFound));
        let error = arguments.overrides(&names, missing).unwrap_err().to_string();
        assert!(error.starts_with("parameter file no/such.yaml: "), "{error}");
        let error = arguments.overrides(&names, |_| Ok("a: [".into())).unwrap_err().to_string();
        assert!(error.contains("not YAML"), "{error}");
    }
}
