//! `tcvae train` as its users see it.
#![cfg(feature = "train")]

mod support;

use std::fs;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use tcvae::artifact::{Artifact, Learned};

use support::{command, tcvae};

fn run(args: &[&str]) -> Output {
    tcvae(args, Path::new("."))
}

/// The program, running, with its output kept.
fn start(args: &[&str]) -> Child {
    let mut command = command(args, Path::new("."));
    command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("the program starts")
}

#[track_caller]
fn done(args: &[&str]) {
    let output = run(args);
    assert!(output.status.success(), "{args:?}: {}", text(&output));
}

fn text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// A folder with a data set in `arcs`.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let arcs = path(&folder, "arcs");
    done(&["simulate", "arcs", "--seed", "1", "--count", "60", "-o", &arcs]);
    folder
}

fn path(folder: &tempfile::TempDir, name: &str) -> String {
    folder.path().join(name).to_str().expect("a UTF-8 path").to_owned()
}

/// A training that takes a second, with a beta at which nothing collapses.
fn train<'a>(arcs: &'a str, model: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let mut args = vec!["train", arcs, "-o", model, "--set", "epochs=6", "--set", "batch=8"];
    args.extend(["--set", "network.width=8", "--set", "beta=0.01", "--set", "learning_rate=0.02"]);
    args.extend(more);
    args
}

fn lines(path: impl AsRef<Path>) -> usize {
    fs::read_to_string(path).map_or(0, |text| text.lines().count())
}

#[cfg(unix)]
fn interrupt(child: &Child) {
    let status = Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    assert!(status.expect("kill starts").success());
}

#[test]
fn one_seed_gives_one_file_and_the_file_says_how_it_was_made() {
    let folder = folder();
    let (arcs, a, b) =
        (path(&folder, "arcs"), path(&folder, "a/m.safetensors"), path(&folder, "b/m.safetensors"));
    done(&train(&arcs, &a, &["--seed", "4"]));
    done(&train(&arcs, &b, &["--seed", "4"]));
    assert_eq!(fs::read(&a).unwrap(), fs::read(&b).unwrap());

    let Artifact { document, .. } = Artifact::load(Path::new(&a)).unwrap();
    let Learned::TcVae(model) = &document.learned else { panic!("{:?}", document.learned) };
    assert_eq!((model.training.seed, model.training.epochs), (4, 6));
    assert_eq!(document.training_demonstrations, 48);
    assert_eq!(document.state_names, ["x", "y"]);
    let center = &document.task_space.locations()[0];
    assert!(center.x.lower >= 0.0 && center.x.upper <= 1.0 && center.x.upper > 0.8);

    // One line of metrics for each epoch, below its head in the table, and nothing half-done left behind.
    assert_eq!(lines(folder.path().join("a/m.metrics.jsonl")), 6);
    assert_eq!(lines(folder.path().join("a/m.metrics.csv")), 7);
    let mut left: Vec<_> = fs::read_dir(folder.path().join("a"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    left.sort();
    assert_eq!(left, ["m.metrics.csv", "m.metrics.jsonl", "m.safetensors"]);
}

#[cfg(unix)]
#[test]
fn an_interrupted_training_that_is_resumed_gives_the_same_file() {
    let folder = folder();
    let (arcs, whole, cut) = (
        path(&folder, "arcs"),
        path(&folder, "whole/m.safetensors"),
        path(&folder, "cut/m.safetensors"),
    );
    done(&train(&arcs, &whole, &[]));

    // Stopped after its first epoch.
    let metrics = folder.path().join("cut/m.metrics.jsonl");
    let child = start(&train(&arcs, &cut, &[]));
    let began = Instant::now();
    while lines(&metrics) < 1 && began.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(1));
    }
    interrupt(&child);
    let output = child.wait_with_output().unwrap();
    if output.status.code() == Some(1) {
        assert!(text(&output).contains("--resume goes on"), "{}", text(&output));
        assert!(!Path::new(&cut).exists());
        let done_before = lines(&metrics);
        assert!((1..6).contains(&done_before));
        done(&train(&arcs, &cut, &["--resume"]));
    } else {
        // It was faster than the signal.
        assert!(output.status.success(), "{}", text(&output));
    }
    assert_eq!(lines(&metrics), 6);
    assert_eq!(fs::read(&cut).unwrap(), fs::read(&whole).unwrap());
}

#[test]
fn a_model_that_collapsed_is_saved_and_said_to_be_worthless() {
    let folder = folder();
    let (arcs, model) = (path(&folder, "arcs"), path(&folder, "m.safetensors"));
    let output = run(&train(&arcs, &model, &["--set", "beta=1000"]));
    assert_eq!(output.status.code(), Some(1), "{}", text(&output));
    assert!(text(&output).contains("the model has collapsed: no latent is active"));
    Artifact::load(Path::new(&model)).unwrap();
}

#[test]
fn a_checkpoint_of_another_training_is_refused() {
    let folder = folder();
    let (arcs, model) = (path(&folder, "arcs"), path(&folder, "m.safetensors"));
    let output = run(&train(&arcs, &model, &["--resume"]));
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output).contains("there is no checkpoint"), "{}", text(&output));
}

#[test]
fn a_folder_that_can_not_be_written_is_refused_before_training() {
    let folder = folder();
    let arcs = path(&folder, "arcs");
    fs::write(folder.path().join("file"), "").unwrap();
    for model in ["file/m.safetensors", "/proc/m.safetensors"] {
        let model = if model.starts_with('/') { model.to_owned() } else { path(&folder, model) };
        let output = run(&train(&arcs, &model, &[]));
        assert_eq!(output.status.code(), Some(3), "{}", text(&output));
        assert!(!text(&output).contains("epoch 1"), "{}", text(&output));
    }
    // A folder where a file is asked for.
    let output = run(&train(&arcs, &arcs, &[]));
    assert_eq!(output.status.code(), Some(2), "{}", text(&output));
}

#[test]
fn a_second_training_into_one_folder_is_refused() {
    let folder = folder();
    let (arcs, first, second) =
        (path(&folder, "arcs"), path(&folder, "o/a.safetensors"), path(&folder, "o/b.safetensors"));
    let mut child = start(&train(&arcs, &first, &["--set", "epochs=100000"]));
    let metrics = folder.path().join("o/a.metrics.jsonl");
    let began = Instant::now();
    while lines(&metrics) < 1 && began.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(5));
    }
    let output = run(&train(&arcs, &second, &[]));
    child.kill().unwrap();
    child.wait().unwrap();
    assert_eq!(output.status.code(), Some(3));
    assert!(text(&output).contains("another training is writing into"), "{}", text(&output));
    // The lock goes with its holder.
    done(&train(&arcs, &second, &[]));
}

#[test]
fn a_setting_that_is_none_and_data_that_is_none_have_their_exit_codes() {
    let folder = folder();
    let (arcs, model, none) =
        (path(&folder, "arcs"), path(&folder, "m.safetensors"), path(&folder, "none"));
    assert_eq!(run(&train(&arcs, &model, &["--set", "epoch=3"])).status.code(), Some(2));
    assert_eq!(run(&train(&arcs, &model, &["--backend", "cuda"])).status.code(), Some(2));
    assert_eq!(run(&train(&none, &model, &[])).status.code(), Some(3));
}
