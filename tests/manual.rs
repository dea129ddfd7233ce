//! `tcvae completions` and `tcvae man`.

use std::fs;
use std::process::Command;

fn tcvae(args: &[&str]) -> std::process::Output {
    Command::new(env!("CARGO_BIN_EXE_tcvae")).args(args).output().expect("tcvae runs")
}

#[test]
fn completions_know_the_verbs() {
    for shell in ["bash", "zsh", "fish"] {
        let output = tcvae(&["completions", shell]);
        let text = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success());
        for word in ["simulate", "train", "--json", "random-manner"] {
            assert!(text.contains(word.trim_start_matches('-')), "{shell}: {word}");
        }
    }
    assert_eq!(tcvae(&["completions", "tcsh"]).status.code(), Some(2));
}

#[test]
fn there_is_a_page_for_the_program_and_for_each_verb() {
    let folder = tempfile::tempdir().unwrap();
    assert!(tcvae(&["man", folder.path().to_str().unwrap()]).status.success());
    for page in ["tcvae.1", "tcvae-train.1", "tcvae-sample.1"] {
        let text = fs::read_to_string(folder.path().join(page)).unwrap();
        assert!(text.contains(".SH"), "{page}");
    }
    let missing = folder.path().join("no");
    let output = tcvae(&["man", missing.to_str().unwrap()]);
    let told = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{told}");
    assert!(told.contains("there is no folder"), "{told}");
}
