//! `tcvae sweep`: shared work, resumed work, and a choice that only the validation set makes.
#![cfg(feature = "train")]

mod support;

use std::fs;
use std::path::Path;

use serde_json::Value;
use tcvae::artifact::Artifact;
use tcvae::training::TrainingConfig;

use support::tcvae;

const SWEEP: &str = r#"
data = ["arcs"]
output = "swept"
seeds = [0, 1]
set = { epochs = 2, batch = 32, network = { width = 8 } }
floors = { success = 0.0, active_latents = 0.0, leak = 1.0 }
[[row]]
name = "TC-VAE"
grid = { alpha = [1, 10] }
[[row]]
name = "diverges"
set = { beta = 1e300 }
"#;

fn lines(folder: &Path) -> Vec<String> {
    let mut lines = Vec::new();
    for shard in 1..=2 {
        let path = folder.join(format!("swept/runs-{shard}-of-2.jsonl"));
        lines.extend(fs::read_to_string(path).unwrap_or_default().lines().map(String::from));
    }
    lines
}

#[test]
fn two_processes_share_a_sweep_and_a_third_finds_it_done() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    let simulated =
        tcvae(&["simulate", "arcs", "--seed", "3", "--count", "60", "-o", "arcs"], path);
    assert_eq!(simulated.status.code(), Some(0), "{simulated:?}");
    fs::write(path.join("sweep.toml"), SWEEP).expect("written");
    let shard = |part| tcvae(&["sweep", "--config", "sweep.toml", "--shard", part], path);
    std::thread::scope(|scope| {
        let processes = ["1/2", "2/2"].map(|part| scope.spawn(move || shard(part)));
        for process in processes {
            let output = process.join().expect("no panic");
            assert_eq!(output.status.code(), Some(0), "{output:?}");
        }
    });
    let done = lines(path);
    assert_eq!(done.len(), 6, "{done:?}");

    // All is done: nothing is trained again, and the ranking is whole.
    let output = tcvae(&["sweep", "--config", "sweep.toml", "--json"], path);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    assert_eq!(lines(path), done);
    let answer: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!((&answer["runs"], &answer["done"]), (&6.into(), &6.into()));
    let ranking = answer["ranking"].as_array().expect("a list");
    assert_eq!(ranking.len(), 3);
    assert_eq!((&ranking[0]["seeds"], &ranking[0]["failures"]), (&2.into(), &0.into()));
    let diverged = &ranking[2];
    assert_eq!((&diverged["row"], &diverged["failures"]), (&"diverges".into(), &2.into()));
    assert_eq!(diverged["misses"][0], "a model for each seed");

    // The chosen settings are ones that `train --config` takes.
    let chosen = fs::read_to_string(path.join("swept/chosen-tc-vae.toml")).expect("chosen");
    let chosen: TrainingConfig = toml::from_str(&chosen).expect("settings");
    let told = format!("alpha={}", chosen.alpha);
    assert_eq!(ranking[0]["combination"], told);
    assert!(!path.join("swept/chosen-diverges.toml").exists());

    // A model of a sweep says nothing of the test set, and what was measured is the validation's.
    let model = path.join("swept/tc-vae_alpha=1_seed=1/model.safetensors");
    let artifact = Artifact::load(&model).expect("a model file");
    assert_eq!(artifact.document.evaluation, None);
    let of_model = done.iter().find(|line| line.contains("tc-vae_alpha=1_seed=1")).expect("a line");
    let of_model: Value = serde_json::from_str(of_model).expect("JSON");
    assert_eq!(of_model["validation"]["model_id"], artifact.model_id());

    // Other settings are other runs.
    fs::write(path.join("sweep.toml"), SWEEP.replace("epochs = 2", "epochs = 1")).expect("written");
    let output = tcvae(&["sweep", "--config", "sweep.toml", "--shard", "1/6", "--json"], path);
    let answer: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!((output.status.code(), &answer["done"]), (Some(0), &1.into()));
}

#[test]
fn what_is_no_sweep_is_wrong_usage() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    for (text, reason) in [
        (SWEEP.replace("seeds = [0, 1]", "seeds = []"), "the sweep has no seeds"),
        (SWEEP.replace("beta = 1e300", "betta = 1"), "unknown field `betta`"),
        (SWEEP.replace("output", "outptu"), "unknown field `outptu`"),
    ] {
        fs::write(path.join("sweep.toml"), text).expect("written");
        let output = tcvae(&["sweep", "--config", "sweep.toml"], path);
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(said.contains("sweep.toml: ") && said.contains(reason), "{said}");
    }
    let output = tcvae(&["sweep", "--config", "sweep.toml", "--shard", "3/2"], path);
    assert_eq!(output.status.code(), Some(2), "{output:?}");
}
