//! `tcvae export` and `tcvae sample --mcap`: what other programs read of a training set and of motions.
#![cfg(all(feature = "train", feature = "bag"))]
#![expect(clippy::unwrap_used, reason = "in a test a panic is the report")]

mod support;

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use serde_json::Value;
use tcvae::bag::Bag;
use tcvae::demonstrations::recording::Channels;

use support::tcvae;

/// Messages of each topic of a file, with the type and whether its definition is there.
fn topics(path: &Path) -> BTreeMap<String, (String, usize)> {
    let bytes = fs::read(path).unwrap();
    let mut topics = BTreeMap::new();
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let channel = message.unwrap().channel;
        let schema = channel.schema.as_ref().unwrap();
        assert_eq!((schema.encoding.as_str(), schema.data.is_empty()), ("ros2msg", false));
        let entry = topics.entry(channel.topic.clone()).or_insert((schema.name.clone(), 0));
        entry.1 += 1;
    }
    topics
}

fn simulated() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let args = ["simulate", "pouring", "--seed", "4", "--count", "12", "-o", "data"];
    assert_eq!(tcvae(&args, folder.path()).status.code(), Some(0));
    folder
}

#[test]
fn a_table_has_a_line_for_each_state_of_each_demonstration() {
    let folder = simulated();
    let output = tcvae(&["export", "data", "-o", "set.csv", "--json"], folder.path());
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let answer: Value = serde_json::from_slice(&output.stdout).unwrap();
    let part = |name: &str| answer["episodes"][name].as_u64().unwrap() as usize;
    let episodes = part("train") + part("validation") + part("test");
    assert!(episodes >= 5 && part("test") >= 1, "{answer}");

    let table = fs::read_to_string(folder.path().join("set.csv")).unwrap();
    let lines: Vec<Vec<&str>> = table.lines().map(|line| line.split(',').collect()).collect();
    assert_eq!(lines.len(), 1 + 100 * episodes);
    let column = |name: &str| lines[0].iter().position(|n| *n == name).unwrap();
    let value = |line: usize, name: &str| lines[line][column(name)].parse::<f64>().unwrap();
    // The source cup is where the tip is in the first state; a quaternion has the length 1.
    for first in (1..lines.len()).step_by(100) {
        for axis in ["x", "y"] {
            let tip = value(first, &format!("observation.state.{axis}"));
            assert!((tip - value(first, &format!("task.source_cup.{axis}"))).abs() < 1e-6);
        }
        let q = ["qx", "qy", "qz", "qw"].map(|n| value(first, &format!("observation.state.{n}")));
        assert!((q.iter().map(|q| q * q).sum::<f64>() - 1.0).abs() < 1e-6);
        let duration = value(first + 99, "timestamp");
        assert!((duration - value(first, "manner.duration")).abs() < 1e-6);
    }
}

#[test]
fn a_recording_has_each_demonstration_with_what_there_is_to_say_of_it() {
    let folder = simulated();
    let output = tcvae(&["export", "data", "-o", "set.mcap", "--json"], folder.path());
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let answer: Value = serde_json::from_slice(&output.stdout).unwrap();
    let episodes: u64 =
        answer["episodes"].as_object().unwrap().values().filter_map(Value::as_u64).sum();
    let topics = topics(&folder.path().join("set.mcap"));
    let of = |topic: &str| (topics[topic].0.as_str(), topics[topic].1 as u64);
    assert_eq!(of("/motion"), ("std_msgs/msg/String", episodes));
    assert_eq!(of("/tip_path"), ("nav_msgs/msg/Path", episodes));
    assert_eq!(of("/tip_pose"), ("geometry_msgs/msg/PoseStamped", 100 * episodes));
    assert_eq!(of("/tf"), ("tf2_msgs/msg/TFMessage", 100 * episodes));
}

#[test]
fn copies_are_there_when_asked_for_and_a_file_of_another_kind_is_wrong_usage() {
    let folder = simulated();
    let task = format!(
        "based_on = \"{}/config/tasks/pour.toml\"\n[augmentation]\ntrain_copies = 8\nvalidation_copies = 2\n",
        env!("CARGO_MANIFEST_DIR")
    );
    fs::write(folder.path().join("task.toml"), task).unwrap();
    let export = |more: &[&str]| {
        let args = [&["export", "data", "--task", "task.toml", "--json"], more].concat();
        tcvae(&args, folder.path())
    };
    let train = |more: &[&str]| -> u64 {
        let answer: Value = serde_json::from_slice(&export(more).stdout).unwrap();
        answer["episodes"]["train"].as_u64().unwrap()
    };
    assert_eq!(train(&["-o", "a.csv", "--copies"]), train(&["-o", "b.csv"]) + 8);
    let refused = export(&["-o", "set.parquet"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(!folder.path().join("set.parquet").exists());
}

#[test]
fn sampled_motions_are_a_recording_with_the_joints_that_were_answered() {
    let folder = tempfile::tempdir().unwrap();
    let model = format!("{}/models/pouring.safetensors", env!("CARGO_MANIFEST_DIR"));
    let args = [
        "sample",
        &model,
        "--task",
        "pour_location=0.65,0.35",
        "--task",
        "source_cup=0.60,0.10",
        "--random-manner",
        "--count",
        "3",
        "--seed",
        "5",
        "--json",
        "--mcap",
        "pours.mcap",
    ];
    let output = tcvae(&args, folder.path());
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let answer: Value = serde_json::from_slice(&output.stdout).unwrap();
    let path = folder.path().join("pours.mcap");
    let topics = topics(&path);
    assert_eq!(topics["/robot_description"].1, 1);
    assert_eq!(topics["/motion"].1, 3);

    let trajectory = |i: usize| &answer["samples"][i]["joint_trajectory"];
    let names: Vec<String> = serde_json::from_value(trajectory(0)["joint_names"].clone()).unwrap();
    let channels = Channels { joints: names, ..Channels::default() };
    let read = Bag::find(&path).unwrap()[0].read(&channels).unwrap().recording;
    let expected: Vec<Vec<f64>> = (0..3)
        .flat_map(|i| trajectory(i)["points"].as_array().unwrap())
        .map(|point| serde_json::from_value(point["positions"].clone()).unwrap())
        .collect();
    assert_eq!(read.positions, expected);
}

#[test]
fn what_can_not_be_written_or_made_leaves_nothing_behind() {
    let folder = simulated();
    let left_out = (1..=12).map(|i: i32| i.to_string()).collect::<Vec<_>>().join(",");
    let nothing = ["export", "data", "--exclude", &left_out, "-o", "set.csv"];
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let arcs = root.join("models/arcs.safetensors").display().to_string();
    let panda = fs::read_to_string(root.join("config/robots/panda.toml")).unwrap();
    let panda =
        panda.replace("../panda.urdf", &root.join("config/panda.urdf").display().to_string());
    let (bare, _) = panda.split_once("[workplace]").unwrap();
    fs::write(folder.path().join("bare.toml"), bare).unwrap();
    for (args, code, words) in [
        (&nothing[..], 3, "no demonstration to write"),
        (&["export", "data", "-o", "no/set.csv"], 2, "there is no folder no; make it"),
        (&["simulate", "pouring", "--robot", "bare.toml", "-o", "new"], 2, "no [workplace]"),
        (
            &["sample", &arcs, "--task", "center=0,0", "--mcap", "new"],
            2,
            "are for models of a robot's tip",
        ),
    ] {
        let output = tcvae(args, folder.path());
        let told = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{args:?}: {told}");
        assert!(told.contains(words), "{args:?}: {told}");
    }
    let mut left: Vec<_> = fs::read_dir(&folder).unwrap().map(|e| e.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, ["bare.toml", "data"]);
}
