//! The classical primitives through the program: train, evaluate and sample, as a TC-VAE.
#![cfg(feature = "train")]

mod support;

use std::fs;
use std::path::Path;
use std::process::Output;

use serde_json::Value;
use tcvae::artifact::{Artifact, Learned};
use tcvae::evaluation::ModelEvaluation;

use support::tcvae;

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).expect("UTF-8")
}

#[track_caller]
fn done(args: &[&str], folder: &Path) -> Output {
    let output = tcvae(args, folder);
    assert_eq!(output.status.code(), Some(0), "{args:?}: {output:?}");
    output
}

fn json(output: &Output) -> Value {
    serde_json::from_slice(&output.stdout).expect("the answer is JSON")
}

#[test]
fn on_pours_each_is_fitted_measured_and_sampled_by_the_commands_of_a_tc_vae() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    let simulate = ["simulate", "pouring", "--seed", "6", "--count", "40", "-o", "data"];
    done(&[&simulate[..], &["--set", "sides=right"]].concat(), path);
    let mut ids = Vec::new();
    for (primitive, name, set, least) in [
        ("tp-gmm", "TP-GMM", "components=10", 0.8),
        ("promp", "ProMP", "basis_functions=15", 0.8),
        ("dmp", "DMP", "alignment_window=0.05", 0.8),
    ] {
        let model = format!("{primitive}.safetensors");
        let again = format!("{primitive}-again.safetensors");
        let train = ["train", "data", "--primitive", primitive, "--set", set, "-o"];
        let output = done(&[&train[..], &[&model, "--json"]].concat(), path);
        let said = text(&output.stderr);
        // Nobody's copies: 19 recordings and nothing else.
        assert!(said.contains("fitting to 19 demonstrations"), "{said}");
        assert!(!said.contains("copies"), "{said}");
        let answer = json(&output);
        assert_eq!((&answer["primitive"], &answer["demonstrations"]), (&name.into(), &19.into()));
        done(&[&train[..], &[&again]].concat(), path);
        let read = |name: &str| fs::read(path.join(name)).expect("a model");
        assert_eq!(read(&model), read(&again), "one data set, one file");

        let artifact = Artifact::load(&path.join(&model)).expect("a model file");
        let document = &artifact.document;
        assert_eq!(document.learned.name(), name);
        assert_eq!((document.training_demonstrations, artifact.training_tasks().len()), (19, 19));
        assert_eq!(answer["model_id"], artifact.model_id());
        let (key, value) = set.split_once('=').expect("a setting");
        let Learned::Classical(classical) = &document.learned else { panic!("{name}") };
        let stored = serde_json::to_value(classical).expect("JSON");
        assert_eq!(stored[primitive]["settings"][key].to_string(), value);
        assert_eq!(stored[primitive]["settings"]["steps"], 100);
        ids.push(artifact.model_id());

        let evaluate = ["evaluate", &model, "--data", "data"];
        let measured = json(&done(&[&evaluate[..], &["--json"]].concat(), path));
        let stored = document.evaluation.as_ref().expect("it was measured");
        assert_eq!(measured, serde_json::to_value(stored).expect("JSON"));
        let stored = stored.classical().expect("a primitive without manner");
        assert_eq!((stored.cases, stored.seed), (6, 0));
        assert_eq!(stored.model_id, artifact.model_id());
        assert_eq!(stored.data_digest, document.data_digest);
        assert!(stored.success[2].mean >= least, "{name}: {:?}", stored.success);
        let table = text(&done(&evaluate, path).stdout);
        for line in [name, "success", "success and valid", "median task error"] {
            assert!(table.lines().any(|l| l.starts_with(line)), "{table}");
        }

        // A task that it learned from, and not one at the edge, so that it is one that can be served.
        let w = artifact.training_tasks().nth(1).expect("a task").to_vec();
        let pour = format!("pour_location={},{}", w[0], w[1]);
        let source = format!("source_cup={},{}", w[2], w[3]);
        let sample = ["sample", &model, "--task", &pour, "--task", &source, "--json"];
        let output = tcvae(&[&sample[..], &["--random-manner", "--count", "2"]].concat(), path);
        let answer = json(&output);
        assert_eq!(answer["model_id"], artifact.model_id());
        if primitive == "promp" {
            assert_eq!(output.status.code(), Some(0), "{}", answer["error_message"]);
            let samples = answer["samples"].as_array().expect("samples");
            assert_eq!(samples.len(), 2);
            assert_eq!(samples[0]["joint_trajectory"], samples[1]["joint_trajectory"]);
            assert_eq!(samples[0]["manner_names"], serde_json::json!([]));
        } else {
            assert!(matches!(output.status.code(), Some(0 | 1)), "{output:?}");
        }
        let output = tcvae(&[&sample[..], &["--manner", "h1=0.5"]].concat(), path);
        assert_eq!(output.status.code(), Some(2));
        let message = json(&output)["error_message"].to_string();
        assert!(message.contains("the primitive has no manner parameters"), "{message}");
    }
    assert!(ids[0] != ids[1] && ids[0] != ids[2] && ids[1] != ids[2], "{ids:?}");

    // Every recording has its place: what one model is tested on, no other is trained on.
    let digest = |model: &str| {
        let artifact = Artifact::load(&path.join(model)).expect("a model file");
        artifact.document.data_digest
    };
    assert_eq!(digest("tp-gmm.safetensors"), digest("dmp.safetensors"));
}

#[test]
fn on_arcs_each_returns_its_states() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    done(&["simulate", "arcs", "--count", "200", "-o", "data"], path);
    for primitive in ["tp-gmm", "promp", "dmp"] {
        let model = format!("{primitive}.safetensors");
        let mut train = vec!["train", "data", "--primitive", primitive, "-o", &model];
        if primitive == "tp-gmm" {
            train.extend(["--set", "components=8"]);
        }
        done(&train, path);
        let evaluation = json(&done(&["evaluate", &model, "--data", "data", "--json"], path));
        let evaluation: ModelEvaluation = serde_json::from_value(evaluation).expect("one of two");
        let evaluation = evaluation.classical().expect("a primitive without manner");
        // The mean of arcs of all manners is an arc beside its task, never far from it.
        assert!(evaluation.success[2].mean > 0.9, "{primitive}: {:?}", evaluation.success);
        let sample = ["sample", &model, "--task", "center=0.4,0.6", "--json"];
        let answer = json(&done(&sample, path));
        let states = answer["samples"][0]["states"].as_array().expect("states");
        assert_eq!(
            (states.len(), &answer["samples"][0]["manner_values"]),
            (32, &Value::Array(vec![]))
        );
    }
}

#[test]
fn what_a_classical_primitive_has_not_is_wrong_usage() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    done(&["simulate", "arcs", "--count", "20", "-o", "data"], path);
    let train = ["train", "data", "-o", "model.safetensors", "--primitive"];
    fs::write(path.join("network.toml"), "epochs = 3\n").expect("written");
    for (args, reason) in [
        (&["tp-gmm", "--resume"][..], "--resume is for --primitive tc-vae; a tp-gmm is fitted at"),
        (&["promp", "--seed", "1"], "--seed is for --primitive tc-vae; a promp is fitted at once"),
        (&["dmp", "--backend", "flex"], "--backend is for --primitive tc-vae"),
        (&["tp-gmm", "--set", "epochs=3"], "unknown field `epochs`"),
        (&["promp", "--set", "components=3"], "unknown field `components`"),
        (&["dmp", "--config", "network.toml"], "unknown field `epochs`"),
        (&["dmp", "--set", "steps=1"], "steps is 1; it must be from 2 to 20000"),
        (&["promp", "--set", "basis_functions=1"], "basis_functions is 1; it must be"),
        (&["tp-gmm", "--set", "alignment_window=2"], "alignment_window is 2; it must be"),
        (&["gmm"], "invalid value 'gmm'"),
    ] {
        let output = tcvae(&[&train, args].concat(), path);
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{args:?}: {said}");
        assert!(said.contains(reason), "{args:?}: {said}");
        assert!(!path.join("model.safetensors").exists());
    }
}
