//! The parameters of the node, and the file that ships them.
#![cfg(feature = "ros")]
#![expect(clippy::unwrap_used, reason = "a test that panics says where")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use ros2_client::ParameterValue;
use tcvae::artifact::Artifact;
use tcvae::config::BAXTER_URDF;
use tcvae::demonstrations::recording::RobotConfig;
use tcvae::ros::arguments::{Arguments, Command};
use tcvae::ros::names::NodeNames;
use tcvae::ros::parameters::{Parameter, find};
use tcvae::ros::state::{Loaded, Loader, NodeState, RobotFiles};
use tcvae::serving::{ErrorCode, Refusal, Robot, ServedModel};

struct Files;

fn root(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn robot(urdf: &str, files: &RobotFiles) -> Result<Robot, Refusal> {
    let arm = tcvae::urdf::arm(urdf, &files.base_frame, &files.tip_link)
        .map_err(|e| Refusal::new(ErrorCode::RobotMismatch, e.to_string()))?;
    Ok(Robot::new(arm, &RobotConfig::default().collision, urdf).unwrap())
}

impl Loader for Files {
    fn model(&self, path: &str) -> Result<ServedModel, Refusal> {
        assert_eq!(path, "");
        Ok(Artifact::load(&root("models/pouring.safetensors")).unwrap().served_model().unwrap())
    }

    fn robot(&self, files: &RobotFiles) -> Result<Robot, Refusal> {
        match files.path() {
            "" => robot(BAXTER_URDF, files),
            "a.toml" => {
                let (base_frame, tip_link) = ("base".into(), "left_gripper".into());
                robot(BAXTER_URDF, &RobotFiles { base_frame, tip_link, ..files.clone() })
            }
            other => panic!("{other}"),
        }
    }
}

fn start(line: &str) -> Result<(NodeState, Vec<String>), Refusal> {
    let names = NodeNames::new("tcvae", &[]).unwrap();
    let Command::Run(arguments) = Arguments::parse(line.split(' ').map(Into::into)).unwrap() else {
        panic!("{line}");
    };
    let values: BTreeMap<_, _> = arguments
        .overrides(&names, |path| std::fs::read_to_string(root(path.to_str().unwrap())))
        .unwrap();
    NodeState::new(values, &Files)
}

fn value(parameters: &[Parameter], name: &str) -> ParameterValue {
    find(parameters, name).unwrap().value.clone()
}

#[test]
fn the_shipped_file_holds_every_parameter_at_its_built_in_value() {
    let (state, warnings) = start("--ros-args --params-file config/node.yaml").unwrap();
    assert_eq!(warnings, [] as [&str; 0]);
    let built_in = NodeState::new(BTreeMap::new(), &Files).unwrap().0.parameters();
    assert_eq!(state.parameters(), built_in);

    let names = NodeNames::new("tcvae", &[]).unwrap();
    let file = "--ros-args --params-file config/node.yaml".split(' ').map(Into::into);
    let Command::Run(arguments) = Arguments::parse(file).unwrap() else { panic!("not a run") };
    let held =
        arguments.overrides(&names, |path| std::fs::read_to_string(root(path.to_str().unwrap())));
    let held: Vec<_> = held.unwrap().into_keys().collect();
    let axes = state.server.model().primitive.manner_space().names();
    let is_axis = |name: &str| axes.iter().any(|axis| name == format!("manner.{axis}"));
    let expected: Vec<_> =
        built_in.into_iter().map(|p| p.name).filter(|name| !is_axis(name)).collect();
    assert_eq!(held, expected);
}

#[test]
fn a_start_takes_values_and_warns_of_names_that_there_are_not() {
    let (state, warnings) = start(
        "--ros-args -p sample.max_tries:=7 -p limits.velocity_scale:=1 -p sample.sed:=4 \
         -p task.source_cup.default:=[0.6,0.1]",
    )
    .unwrap();
    let parameters = state.parameters();
    assert_eq!(value(&parameters, "sample.max_tries"), ParameterValue::Integer(7));
    assert_eq!(value(&parameters, "limits.velocity_scale"), ParameterValue::Double(1.0));
    assert_eq!(
        value(&parameters, "task.source_cup.default"),
        ParameterValue::DoubleArray(vec![0.6, 0.1])
    );
    assert_eq!(warnings.len(), 1);
    assert!(warnings[0].contains("did you mean sample.seed?"), "{warnings:?}");
}

#[test]
fn a_start_refuses_values_that_are_none() {
    for (line, words) in [
        ("--ros-args -p sample.max_tries:=0", "[1, 1000]"),
        ("--ros-args -p model_path:=5", "model_path is not a string"),
        ("--ros-args -p tip_link:=no_such_link", "no_such_link"),
        ("--robot a.toml --ros-args -p tip_link:=left_hand", "leave tip_link empty"),
        ("--robot a.toml --ros-args -p urdf_path:=a.urdf", "leave one of them empty"),
        ("--ros-args -p task.source_cup.default:=[1,2,3]", "3 values"),
    ] {
        let refusal = start(line).unwrap_err();
        assert!(refusal.message.contains(words), "{refusal}");
    }
}

#[test]
fn a_robots_own_frames_may_be_said_again() {
    let again = "-p base_frame:=base -p tip_link:=left_gripper";
    let (state, _) = start(&format!("--robot a.toml --ros-args {again}")).unwrap();
    assert_eq!(state.robot_files().tip_link, "left_gripper");
}

/// A robot that calls its frames otherwise than the built-in one.
struct Renamed;

impl Loader for Renamed {
    fn model(&self, path: &str) -> Result<ServedModel, Refusal> {
        let mut model = Files.model(path)?;
        model.robot.base_frame = "world".into();
        model.robot.tip_frame = "cup".into();
        Ok(model)
    }

    fn robot(&self, files: &RobotFiles) -> Result<Robot, Refusal> {
        let urdf = BAXTER_URDF.replace("\"base\"", "\"world\"");
        robot(&urdf.replace("\"left_gripper\"", "\"cup\""), files)
    }
}

#[test]
fn frames_that_are_not_set_are_the_models() {
    let (state, _) = NodeState::new(BTreeMap::new(), &Renamed).unwrap();
    let files = state.robot_files();
    assert_eq!((files.base_frame.as_str(), files.tip_link.as_str()), ("world", "cup"));
    let set = BTreeMap::from([("base_frame".into(), ParameterValue::String("base".into()))]);
    assert!(NodeState::new(set, &Renamed).unwrap_err().message.contains("no link \"base\""));
}

#[test]
fn what_is_fixed_at_start_takes_only_its_own_value() {
    let mut state = start("--ros-args").unwrap().0;
    let text = |text: &str| ParameterValue::String(text.into());
    state.set("base_frame", text("base"), &[]).unwrap();
    let reason = state.set("base_frame", text("torso"), &[]).unwrap_err();
    assert!(reason.contains("fixed at start"), "{reason}");
}

#[test]
fn defaults_and_manner_outlive_another_model() {
    let mut state = start("--ros-args -p task.source_cup.default:=[0.6,0.1]").unwrap().0;
    let axis = state.server.model().primitive.manner_space().names()[0].clone();
    state.set(&format!("manner.{axis}"), ParameterValue::Double(0.5), &[]).unwrap();
    let before = state.parameters();
    let model = std::sync::Arc::new(Files.model("").unwrap());
    let loaded = Loaded { path: "copy.safetensors".into(), model };
    state.set("model_path", ParameterValue::String("copy.safetensors".into()), &[loaded]).unwrap();
    let after = state.parameters();
    let changed: Vec<_> = before
        .iter()
        .filter(|old| value(&after, &old.name) != old.value)
        .map(|old| old.name.as_str())
        .collect();
    assert_eq!(changed, ["model_path"]);
    assert_eq!(state.server.missing_location(&[]).unwrap().name, "pour_location");
}
