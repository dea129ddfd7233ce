//! `tcvae simulate pouring`, then `tcvae inspect`: the answer is the truth that was planted.
#![cfg(feature = "train")]
#![expect(clippy::unwrap_used, reason = "in a test a panic is the report")]

mod support;

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::Output;

use serde_json::Value;

use support::tcvae;

fn json(output: &Output) -> Value {
    serde_json::from_slice(&output.stdout).expect("the answer is JSON")
}

/// A folder with 40 simulated recordings in `data`.
fn simulated() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    let args = ["simulate", "pouring", "--seed", "4", "--count", "40", "-o", "data", "--json"];
    let output = tcvae(&args, folder.path());
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    assert_eq!(json(&output)["demonstrations"], 40);
    folder
}

/// Holds what `inspect` says of simulated recordings against the truth beside them; returns how many are
/// accepted.
fn holds_against_the_truth(
    folder: &Path,
    args: &[&str],
    action: &str,
    locations: [&str; 2],
) -> usize {
    let output = tcvae(&[&["inspect", "data", "--json"], args].concat(), folder);
    assert_eq!(output.status.code(), Some(0));
    let answer = json(&output);
    let truth: Value =
        serde_json::from_slice(&fs::read(folder.join("data/truth.json")).unwrap()).unwrap();
    let truth: BTreeMap<_, _> = truth["demonstrations"]
        .as_array()
        .unwrap()
        .iter()
        .map(|t| (t["id"].as_str().unwrap(), t))
        .collect();
    let demonstrations = answer["demonstrations"].as_array().unwrap();
    assert_eq!(demonstrations.len(), truth.len());
    let mut accepted = 0;
    for found in demonstrations {
        let truth = truth[found["id"].as_str().unwrap()];
        if truth["expected"] != "accept" {
            assert_eq!(found["accepted"], false);
            assert_eq!(found["reason"], truth["expected"], "{found}");
            assert!(!found["detail"].as_str().unwrap().is_empty());
            continue;
        }
        accepted += 1;
        assert_eq!(found["accepted"], true, "{found}");
        assert_eq!((&found["reason"], &found["arm"]), (&Value::Null, &truth["arm"]));
        assert!((found["rate_hz"].as_f64().unwrap() - 100.0).abs() < 1e-6);
        for location in locations {
            for axis in 0..2 {
                let value = |v: &Value| v["task"][location][axis].as_f64().unwrap();
                assert!((value(found) - value(truth)).abs() < 0.005, "{found} {truth}");
            }
        }
        for (factor, limit) in [("start", 0.1), ("duration", 0.1)] {
            let factor = format!("{action}_{factor}");
            let value = |v: &Value| v["factors"][&factor].as_f64().unwrap();
            assert!((value(found) - value(truth)).abs() < limit, "{factor} {found} {truth}");
        }
    }
    let summary = &answer["summary"];
    assert_eq!(summary["accepted"], accepted);
    assert_eq!(
        (&summary["recordings"], &summary["synthetic"]),
        (&truth.len().into(), &true.into())
    );
    accepted
}

#[test]
fn every_recording_is_accepted_or_left_out_as_the_truth_says() {
    let folder = simulated();
    let accepted =
        holds_against_the_truth(folder.path(), &[], "pour", ["pour_location", "source_cup"]);
    assert_eq!(accepted, 31);
}

#[test]
fn so_are_those_of_another_robot_and_of_another_action() {
    let config = |file: &str| format!("{}/config/{file}", env!("CARGO_MANIFEST_DIR"));
    let (panda, pour) = (config("robots/panda.toml"), config("tasks/pour-panda.toml"));
    let stack = config("tasks/stack.toml");
    for (what, robot, task, action, locations) in [
        ("pouring", Some(&panda), &pour, "pour", ["pour_location", "source_cup"]),
        ("stacking", None, &stack, "stack", ["stack_location", "source_block"]),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let robot: Vec<&str> = robot.iter().flat_map(|robot| ["--robot", robot.as_str()]).collect();
        // So many that each trap is there.
        let simulate = ["simulate", what, "--seed", "6", "--count", "200", "-o", "data"];
        let output = tcvae(&[&simulate[..], &robot].concat(), folder.path());
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        let args = [&["--task", task], &robot[..]].concat();
        let accepted = holds_against_the_truth(folder.path(), &args, action, locations);
        assert!(accepted > 140, "{what}: {accepted}");
    }
}

#[test]
fn demonstrations_are_left_out_by_number_or_by_name() {
    let folder = simulated();
    let accepted = |args: &[&str]| -> Vec<String> {
        let output = tcvae(&[&["inspect", "data", "--json"], args].concat(), folder.path());
        let answer = json(&output);
        let demonstrations = answer["demonstrations"].as_array().unwrap().iter();
        let accepted = demonstrations.filter(|d| d["accepted"] == true);
        accepted.map(|d| d["id"].as_str().unwrap().to_owned()).collect()
    };
    let all = accepted(&[]);
    assert_eq!(accepted(&["--only", &format!("{},{}", all[2], all[0])]), [&*all[0], &*all[2]]);
    assert_eq!(accepted(&["--exclude", &all[0]]), all[1..]);
    let output = tcvae(&["inspect", "data", "--exclude", "41"], folder.path());
    assert_eq!(output.status.code(), Some(2));
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(message, "tcvae: no demonstration \"41\"; there are 40, counted from 1\n");
}

#[test]
fn a_table_is_for_people_and_ends_with_a_summary() {
    let folder = simulated();
    let output = tcvae(&["inspect", "data"], folder.path());
    let table = String::from_utf8(output.stdout).unwrap();
    assert_eq!(table.lines().take_while(|l| !l.is_empty()).count(), 41);
    assert!(table.contains("31 of 40 recordings accepted"), "{table}");
    assert!(table.contains("left out: 2 no_grasp, 2 no_pour, 5 several_pours"), "{table}");
    assert!(table.contains("they are synthetic"));
}

#[test]
fn what_holds_no_demonstration_is_bad_data_and_what_holds_none_of_use_too() {
    let folder = tempfile::tempdir().unwrap();
    let output = tcvae(&["inspect", ".", "--json"], folder.path());
    assert_eq!(output.status.code(), Some(3));
    assert!(
        json(&output)["error_message"]
            .as_str()
            .unwrap()
            .contains("no recording in there; a recording is")
    );

    fs::create_dir(folder.path().join("demo")).unwrap();
    fs::write(folder.path().join("demo/joint_angles.txt"), "{}\n").unwrap();
    let output = tcvae(&["inspect", ".", "--json"], folder.path());
    assert_eq!(output.status.code(), Some(3), "with its answer");
    let demonstration = &json(&output)["demonstrations"][0];
    assert_eq!(demonstration["reason"], "unreadable");
    assert_eq!(demonstration["id"], "demo");
}

#[test]
fn a_task_or_robot_with_an_unknown_key_is_wrong_usage() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("task.toml"), "task = \"arcs\"\npour_tilt = 60\n").unwrap();
    let output = tcvae(&["inspect", ".", "--task", "task.toml"], folder.path());
    assert_eq!(output.status.code(), Some(2));
    let message = String::from_utf8(output.stderr).unwrap();
    assert!(message.contains("task.toml") && message.contains("pour_tilt"), "{message}");
}
