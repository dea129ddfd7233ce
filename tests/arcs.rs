//! `tcvae simulate arcs`, then what is done with its folder.
#![cfg(feature = "train")]

mod support;

use std::fs;
use std::path::Path;
use std::process::Output;

use serde_json::Value;
use tcvae::artifact::Artifact;
use tcvae::evaluation::{Evaluation, ModelEvaluation, Score};

use support::tcvae;

fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).expect("UTF-8")
}

fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).expect("UTF-8")
}

#[test]
fn the_same_seed_writes_the_same_bytes_and_another_seed_others() {
    let folder = tempfile::tempdir().unwrap();
    for (seed, name) in [("5", "a"), ("5", "b"), ("6", "c")] {
        let args = ["simulate", "arcs", "--seed", seed, "--count", "30", "-o", name];
        assert_eq!(tcvae(&args, folder.path()).status.code(), Some(0));
    }
    for file in ["train.csv", "validation.csv", "test.csv", "truth.json", "dataset.json"] {
        let read = |name: &str| fs::read(folder.path().join(name).join(file)).unwrap();
        assert_eq!(read("a"), read("b"), "{file}");
        assert_ne!(read("a"), read("c"), "{file}");
    }
}

#[test]
fn without_a_count_it_writes_8000_1000_1000_arcs() {
    let folder = tempfile::tempdir().unwrap();
    let output = tcvae(&["simulate", "arcs", "--seed", "1", "-o", "data", "--json"], folder.path());
    let answer: Value = serde_json::from_str(&stdout(&output)).unwrap();
    assert_eq!(answer["demonstrations"], 10_000);
    for (part, count) in [("train", 8000), ("validation", 1000), ("test", 1000)] {
        assert_eq!(answer[part], count);
        let file = folder.path().join("data").join(format!("{part}.csv"));
        let lines = fs::read_to_string(file).unwrap().lines().count();
        assert_eq!(lines, 1 + 32 * count);
    }
    let truth = fs::read(folder.path().join("data/truth.json")).unwrap();
    let truth: Value = serde_json::from_slice(&truth).unwrap();
    assert_eq!(truth["demonstrations"].as_array().unwrap().len(), 10_000);
}

#[test]
fn starts_fill_half_a_turn_or_all_of_it_as_set() {
    let folder = tempfile::tempdir().unwrap();
    let below_the_centre = |start: &str| {
        let set = format!("start={start}");
        let args = ["simulate", "arcs", "--count", "500", "--set", &set, "-o", start];
        assert_eq!(tcvae(&args, folder.path()).status.code(), Some(0));
        let truth = fs::read(folder.path().join(start).join("truth.json")).unwrap();
        let truth: Value = serde_json::from_slice(&truth).unwrap();
        let points = fs::read_to_string(folder.path().join(start).join("train.csv")).unwrap();
        let first = points.lines().filter(|l| l.split(',').nth(1) == Some("0"));
        let below =
            first.zip(truth["demonstrations"].as_array().unwrap()).filter(|(line, truth)| {
                let y: f64 = line.split(',').nth(3).unwrap().parse().unwrap();
                y < truth["task"]["center"][1].as_f64().unwrap() - 1e-12
            });
        below.count()
    };
    assert_eq!(below_the_centre("half"), 0);
    // Of 400 arcs to train; a fair coin's deviation is 10.
    assert!((150..250).contains(&below_the_centre("full")));
}

#[test]
fn wrong_usage_is_told_with_exit_code_2_and_writes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("file"), "").unwrap();
    fs::create_dir(folder.path().join("full")).unwrap();
    fs::write(folder.path().join("full/notes.txt"), "").unwrap();
    for (args, reason) in [
        (&["-o", "new", "--count", "9"][..], "--count 9: arcs are simulated 10 to 1000000 at once"),
        (&["-o", "new", "--set", "start=third"], "--set start=third: start is half or full"),
        (&["-o", "new", "--set", "begin=half"], "--set begin: unknown; known are: start, steps"),
        (&["-o", "new", "--set", "start"], "--set start: write it as KEY=VALUE"),
        (&["-o", "new", "--set", "steps=2"], "steps is a number of points from 3 to 1000"),
        (&["-o", "full"], "full is not empty: it holds notes.txt; choose a new folder"),
        (&["-o", "file/new"], "cannot make the folder file/new: "),
        (&["-o", "/proc/new"], "cannot make the folder /proc/new: "),
        (&["--seed", "one", "-o", "new"], "--seed"),
        (&[], "--output <DIR>"),
    ] {
        let output = tcvae(&[&["simulate", "arcs"], args].concat(), folder.path());
        assert_eq!(output.status.code(), Some(2), "{args:?}");
        assert!(stderr(&output).contains(reason), "{args:?}: {}", stderr(&output));
        assert!(!folder.path().join("new").exists());
    }
}

#[test]
fn what_cannot_be_evaluated_is_bad_data_with_exit_code_3_and_still_an_answer() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("model.safetensors"), "not a model").unwrap();
    for (model, reason) in
        [("none.safetensors", "none.safetensors: "), ("model.safetensors", "model.safetensors: ")]
    {
        let args = ["evaluate", model, "--data", "data", "--json"];
        let output = tcvae(&args, folder.path());
        assert_eq!(output.status.code(), Some(3));
        let answer: Value = serde_json::from_str(&stdout(&output)).unwrap();
        let message = answer["error_message"].as_str().unwrap();
        assert!(message.contains(reason), "{message}");
        assert!(stderr(&output).contains(message));
    }
}

/// Trains a small model on the arcs in `data` for a few epochs.
fn train_briefly(folder: &Path, model: &str) -> Output {
    let set =
        ["epochs=20", "batch=16", "network.width=16", "learning_rate=5e-3", "alpha=1", "beta=0.5"];
    let mut args = vec!["train", "data", "--seed", "3", "-o", model];
    args.extend(set.iter().flat_map(|s| ["--set", s]));
    tcvae(&args, folder)
}

#[test]
fn arcs_are_simulated_trained_on_and_evaluated_by_one_seed() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let simulate = ["simulate", "arcs", "--count", "400", "-o", "data"];
    assert_eq!(tcvae(&simulate, folder).status.code(), Some(0));
    for model in ["a/model.safetensors", "b/model.safetensors"] {
        let output = train_briefly(folder, model);
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    }
    let read = |name: &str| fs::read(folder.join(name)).unwrap();
    assert_eq!(read("a/model.safetensors"), read("b/model.safetensors"));

    let evaluate = |more: &[&str]| {
        let args = [&["evaluate", "a/model.safetensors", "--data", "data"], more].concat();
        let output = tcvae(&args, folder);
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
        stdout(&output)
    };
    let text = evaluate(&["--json"]);
    assert_eq!(text, evaluate(&["--json"]));
    let answer: Value = serde_json::from_str(&text).unwrap();
    let keys: Vec<&String> = answer.as_object().unwrap().keys().collect();
    assert_eq!(
        keys,
        [
            "active_latents",
            "broken_bounds",
            "calibration",
            "cases",
            "data_digest",
            "leak_r2",
            "model_id",
            "reconstruction_rmse",
            "robust_and_valid",
            "robustness",
            "seed",
            "success",
            "swap"
        ]
    );
    assert_eq!((&answer["cases"], &answer["seed"]), (&40.into(), &0.into()));
    for measure in ["success", "robustness", "robust_and_valid"] {
        let scores = answer[measure].as_array().unwrap();
        let thresholds: Vec<f64> =
            scores.iter().map(|s| s["threshold"].as_f64().unwrap()).collect();
        assert_eq!(thresholds, [0.025, 0.05, 0.1]);
    }
    // Even so little training reconstructs better than the data's mean, whose error is 0.39.
    assert!(answer["reconstruction_rmse"].as_f64().unwrap() < 0.25, "{text}");

    // The model file holds the same evaluation, and another seed draws other samples.
    let artifact = Artifact::load(&folder.join("a/model.safetensors")).unwrap();
    let stored = serde_json::to_value(artifact.document.evaluation.as_ref().unwrap()).unwrap();
    assert_eq!(stored, answer);
    let other: Value = serde_json::from_str(&evaluate(&["--json", "--seed", "1"])).unwrap();
    assert_eq!(other["success"], answer["success"]);
    assert_ne!(other["robust_and_valid"], answer["robust_and_valid"]);
    let primitive = artifact.primitive();
    let effects = primitive.manner_space().axes().iter().map(|a| a.effect.as_str());
    assert!(effects.clone().all(|e| e != "not measured"), "{:?}", effects.collect::<Vec<_>>());

    // A person reads every measure.
    let table = evaluate(&[]);
    for line in ["success", "robustness", "robust and valid", "active latents", "leak", "swap"] {
        assert!(table.lines().any(|l| l.starts_with(line)), "{table}");
    }
}

#[test]
fn the_shipped_model_scores_what_its_file_says_and_what_was_asked() {
    let folder = tempfile::tempdir().unwrap();
    let simulate = ["simulate", "arcs", "--seed", "0", "-o", "data"];
    assert_eq!(tcvae(&simulate, folder.path()).status.code(), Some(0));
    let model = concat!(env!("CARGO_MANIFEST_DIR"), "/models/arcs.safetensors");
    let output = tcvae(&["evaluate", model, "--data", "data", "--json"], folder.path());
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let measured: Evaluation = serde_json::from_str(&stdout(&output)).unwrap();
    let document = Artifact::load(Path::new(model)).unwrap().document;
    let stored = document.evaluation.as_ref().and_then(ModelEvaluation::tc_vae).unwrap();

    assert_eq!(
        (&measured.model_id, &measured.data_digest),
        (&stored.model_id, &document.data_digest)
    );
    assert_eq!((measured.cases, measured.seed), (1000, stored.seed));
    // Processors round differently, which can move a motion over a threshold.
    let close = |a: f64, b: f64| assert!((a - b).abs() < 0.005, "{measured:?} {stored:?}");
    for (measured, stored) in [
        (&measured.success, &stored.success),
        (&measured.robustness, &stored.robustness),
        (&measured.robust_and_valid, &stored.robust_and_valid),
    ] {
        for (measured, stored) in measured.iter().zip(stored) {
            assert_eq!(measured.threshold, stored.threshold);
            close(measured.mean, stored.mean);
            close(measured.low, stored.low);
        }
    }
    close(measured.reconstruction_rmse, stored.reconstruction_rmse);
    close(measured.leak_r2, stored.leak_r2);
    close(measured.swap, stored.swap);

    let at = |scores: &[Score]| scores.iter().find(|s| s.threshold == 0.05).unwrap().low;
    assert!(at(&measured.success) > 0.85 && at(&measured.robustness) > 0.85);
    assert!(at(&measured.robust_and_valid) > 0.8);
    assert!(measured.active_latents >= 2);
    assert!(measured.leak_r2 < 0.05);
}
