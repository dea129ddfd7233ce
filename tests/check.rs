//! `tcvae check`: what is served over the trained region.
#![cfg(feature = "train")]

mod support;

use std::fs;
use std::path::Path;

use serde_json::Value;
use support::tcvae;

const MODEL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/models/pouring.safetensors");

#[test]
fn every_request_is_counted_once_and_a_seed_gives_the_same_answer() {
    let folder = tempfile::tempdir().unwrap();
    let ask = |more: &[&str]| {
        let args = [&["check", MODEL, "--count", "40", "--json"], more].concat();
        let output = tcvae(&args, folder.path());
        let answer: Value = serde_json::from_slice(&output.stdout).unwrap();
        (output.status.code(), answer)
    };
    let (code, mut answer) =
        ask(&["--plot", "map.svg", "--samples", "s.jsonl", "--at-least", "0.9"]);
    let number = |key: &str| answer[key].as_u64().unwrap();
    assert_eq!((code, number("requests"), number("violations")), (Some(0), 40, 0), "{answer}");
    let refused: u64 =
        answer["refused"].as_object().unwrap().values().flat_map(Value::as_u64).sum();
    assert_eq!(number("served") + refused, 40);
    assert_eq!(number("feasible") + number("out_of_reach") + number("unfamiliar"), 40);
    assert!(answer["worst"]["clearance_m"].as_f64().unwrap() >= 0.01, "{answer}");
    assert!(answer["worst"]["task_error_m"].as_f64().unwrap() <= 0.02, "{answer}");
    assert!(answer["worst"]["speed_share"].as_f64().unwrap() <= 1.0 + 1e-6, "{answer}");
    let lines = fs::read_to_string(folder.path().join("s.jsonl")).unwrap();
    assert_eq!(lines.lines().count() as u64, number("served"));
    let first: Value = serde_json::from_str(lines.lines().next().unwrap()).unwrap();
    assert!(first["request"]["task"]["source_cup"].is_array(), "{first}");
    assert!(fs::read_to_string(folder.path().join("map.svg")).unwrap().contains("source_cup"));

    let (_, mut again) = ask(&[]);
    for answer in [&mut answer, &mut again] {
        answer.as_object_mut().unwrap().remove("latency_ms");
    }
    assert_eq!(answer, again);
    let (_, other) = ask(&["--seed", "2"]);
    assert_ne!(answer["worst"], other["worst"]);
}

#[test]
fn beyond_the_region_requests_may_be_refused_and_do_not_count() {
    let folder = tempfile::tempdir().unwrap();
    let args = ["check", MODEL, "--count", "40", "--beyond", "0.3", "--json", "--at-least", "0"];
    let output = tcvae(&args, folder.path());
    let answer: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(
        (output.status.code(), answer["violations"].as_u64()),
        (Some(0), Some(0)),
        "{answer}"
    );
    assert!(answer["unfamiliar"].as_u64().unwrap() > 20, "{answer}");
    let served = |key: &str| answer[key].as_u64().unwrap();
    assert!(served("feasible") <= 20 && served("served_unfamiliar") > 0, "{answer}");
    let refused: u64 =
        answer["refused"].as_object().unwrap().values().flat_map(Value::as_u64).sum();
    assert_eq!(served("served") + served("served_unfamiliar") + refused, 40, "{answer}");
}

#[test]
fn below_the_share_that_is_asked_for_the_exit_code_tells() {
    let folder = tempfile::tempdir().unwrap();
    // A table at the height of the hand leaves nothing to serve, nor anything that could be.
    let robot = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/robots/baxter.toml");
    let text = fs::read_to_string(robot)
        .unwrap()
        .replace("table_height_m = -0.22", "table_height_m = 0.5");
    fs::write(folder.path().join("robot.toml"), text).unwrap();
    let args = ["check", MODEL, "--count", "5", "--robot", "robot.toml"];
    let output = tcvae(&args, folder.path());
    let told = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert!(told.contains("5 requests: 0 can be followed") && told.contains("COLLISION"), "{told}");
    for (wrong, words) in [
        (&["check", MODEL, "--at-least", "1.5"][..], "--at-least 1.5"),
        (&["check", MODEL, "--beyond", "-1"], "--beyond -1"),
        (&["check", MODEL, "--count", "0"], "0 is not in"),
    ] {
        let output = tcvae(wrong, folder.path());
        let told = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{told}");
        assert!(told.contains(words), "{told}");
    }
}
