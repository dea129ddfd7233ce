//! From recordings of pouring to a model file, in two commands.
#![cfg(feature = "train")]

mod support;

use std::fs;

use serde_json::Value;
use tcvae::artifact::{Artifact, DataSource};
use tcvae::demonstrations::TaskConfig;
use tcvae::evaluation::ModelEvaluation;
use tcvae::urdf;

use support::tcvae;

const TRAIN: &[&str] = &[
    "train",
    "data",
    "--task",
    "task.toml",
    "--set",
    "epochs=8",
    "--set",
    "batch=8",
    "--set",
    "beta=0.1",
    "--set",
    "network.width=8",
    "--set",
    "steps=50",
    "-o",
];

#[test]
fn recordings_become_a_model_file_that_says_all_about_itself() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    let args = ["simulate", "pouring", "--seed", "6", "--count", "40", "-o", "data"];
    assert_eq!(tcvae(&args, path).status.code(), Some(0));
    let task = format!(
        "based_on = \"{}/config/tasks/pour.toml\"\n\
         augmentation = {{ train_copies = 57, validation_copies = 6 }}\n",
        env!("CARGO_MANIFEST_DIR")
    );
    fs::write(path.join("task.toml"), task).expect("written");
    for name in ["a.safetensors", "b.safetensors"] {
        let output = tcvae(&[TRAIN, &[name]].concat(), path);
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        let said = String::from_utf8(output.stderr).expect("UTF-8");
        assert!(said.contains("31 of 40 recordings accepted"), "{said}");
        assert!(said.contains("31 demonstrations are few"), "{said}");
        assert!(said.contains("19 to train on, 6 to validate on and 6 to test on"), "{said}");
        assert!(said.contains("with 63 copies 76 and 12"), "{said}");
    }
    let read = |name: &str| fs::read(path.join(name)).expect("the model");
    assert_eq!(read("a.safetensors"), read("b.safetensors"), "one seed, one file");

    let artifact = Artifact::load(&path.join("a.safetensors")).expect("a model file");
    let document = &artifact.document;
    assert_eq!(document.data_source, DataSource::Synthetic);
    assert_eq!(document.state_names, ["x", "y", "z", "rx", "ry", "rz"]);
    assert_eq!(document.training_demonstrations, 76);
    assert_eq!(artifact.training_tasks().len(), 76);
    assert!((5.0..12.0).contains(&document.duration_secs), "{}", document.duration_secs);
    let TaskConfig::Manipulation(task) = &document.task else { panic!("{:?}", document.task) };
    assert_eq!(task.augmentation.train_copies, 57);
    let names: Vec<_> = document.task_space.locations().iter().map(|l| &*l.name).collect();
    assert_eq!(names, ["pour_location", "source_cup"]);
    for interval in document.task_space.intervals() {
        assert!(-0.2 < interval.lower && interval.upper < 0.95, "{interval:?}");
        assert!(interval.upper - interval.lower > 0.2, "{interval:?}");
    }
    let robot = document.robot.as_ref().expect("poses are of a robot");
    assert_eq!(robot.configurations.len(), 20);
    let baxter = urdf::chain(include_str!("../config/baxter.urdf"), "base", "left_gripper");
    robot.check(&baxter.expect("Baxter")).expect("the model's robot is Baxter");
    let evaluation = document.evaluation.as_ref().and_then(ModelEvaluation::tc_vae);
    let evaluation = evaluation.expect("it was measured");
    assert_eq!((evaluation.cases, evaluation.success[1].threshold), (6, 0.02));

    // The fifth that was held out is what `evaluate` tests on, with the same result.
    let args = ["evaluate", "a.safetensors", "--data", "data", "--json"];
    let output = tcvae(&args, path);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let measured: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(measured, serde_json::to_value(evaluation).expect("JSON"));
}
