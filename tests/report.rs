//! `tcvae report`: pages from trained files, and what it refuses.
#![cfg(feature = "train")]

mod support;

use std::fs;
use std::path::Path;

use serde_json::Value;
use support::tcvae;

const REPORT: &str = r#"
title = "Small arcs"
introduction = ["Two rows."]
commands = "tcvae report"
cache = "measured"
seed = 0
[[part]]
title = "Arcs"
data = ["arcs"]
seeds = [0, 1]
compare = [["TC-VAE", "one seed"]]
[[part.test]]
name = "held out"
[[part.test]]
name = "others"
path = "others"
halves = true
[[part.row]]
name = "TC-VAE"
models = "model-{seed}.safetensors"
paper = { success = [0.5, 0.97, 0.99], robustness = [0.43, 0.89, 0.94] }
[[part.row]]
name = "one seed"
models = "model-0.safetensors"
[[part.row]]
name = "ProMP"
models = "promp.safetensors"
[[part.figure]]
name = "Figure 6"
caption = "One at a time."
shows = "paths"
rows = ["TC-VAE"]
[[part.figure]]
name = "Figure 7"
caption = "Beside the task."
shows = "locations"
rows = ["TC-VAE", "ProMP"]
[[deviation]]
paper = "long"
here = "short"
why = "it is a test"
"#;

fn done(args: &[&str], folder: &Path) {
    let output = tcvae(args, folder);
    assert_eq!(output.status.code(), Some(0), "{args:?}: {output:?}");
}

#[test]
fn a_page_is_made_from_trained_files() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    done(&["simulate", "arcs", "--seed", "3", "--count", "100", "-o", "arcs"], path);
    done(&["simulate", "arcs", "--seed", "4", "--count", "60", "-o", "others"], path);
    for seed in ["0", "1"] {
        let model = format!("model-{seed}.safetensors");
        let small = ["--set", "epochs=2", "--set", "network.width=8", "--set", "batch=32"];
        let args = [&["train", "arcs", "--seed", seed, "-o", &model], &small[..]].concat();
        // A collapsed model is reported on like any other.
        assert!(matches!(tcvae(&args, path).status.code(), Some(0 | 1)));
    }
    done(&["train", "arcs", "--primitive", "promp", "-o", "promp.safetensors"], path);
    fs::write(path.join("report.toml"), REPORT).expect("written");
    let report = ["report", "--config", "report.toml", "-o", "page"];
    done(&report, path);

    let read = |name: &str| fs::read_to_string(path.join("page").join(name)).expect(name);
    let (html, markdown) = (read("index.html"), read("README.md"));
    for text in [
        "TC-VAE<br>(2 seeds)",
        "- in the paper",
        "ProMP<br>(1 seed)",
        "TC-VAE less one seed",
        "a data set of simulated arcs\ndata ",
        "no manner",
        "Deviations from the paper's text",
    ] {
        assert!(html.contains(text) && markdown.contains(text), "{text}");
    }
    // All pictures are in the page itself, and beside the Markdown.
    assert_eq!(html.matches("<svg").count(), 2);
    assert!(!html.contains("src=") && !html.contains("href="));
    assert!(markdown.contains("(figure-6-tc-vae.svg)") && read("figure-7.svg").contains("ProMP"));
    let numbers: Value = serde_json::from_str(&read("results.json")).expect("JSON");
    let tests = numbers[0]["tests"].as_array().expect("tests");
    assert_eq!(tests[0]["rows"][0]["models"][1]["cases"], 10);
    assert_eq!(tests[1]["rows"][2]["models"][0]["cases"], 30);

    let elsewhere = REPORT.replace("path = \"others\"", "path = \"nowhere\"");
    fs::write(path.join("elsewhere.toml"), elsewhere).expect("written");
    let output = tcvae(&["report", "--config", "elsewhere.toml", "-o", "none"], path);
    let told = String::from_utf8(output.stderr).expect("text");
    assert!(told.contains("nowhere: no such file or folder"), "{told}");

    let nothing_to_turn = REPORT.replace("rows = [\"TC-VAE\"]", "rows = [\"ProMP\"]");
    fs::write(path.join("nothing.toml"), nothing_to_turn).expect("written");
    let output = tcvae(&["report", "--config", "nothing.toml", "-o", "none"], path);
    let told = String::from_utf8(output.stderr).expect("text");
    assert_eq!(output.status.code(), Some(2));
    assert!(told.contains("Figure 6: ProMP has no manner parameter to turn"), "{told}");

    // What was measured is kept, and the same page is made of it.
    let kept = fs::read_dir(path.join("measured")).expect("a folder").count();
    assert_eq!(kept, 2 * 3);
    done(&report, path);
    assert_eq!(read("index.html"), html);
}

#[test]
fn a_report_that_can_not_be_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    let refusal = |text: &str, status| {
        fs::write(path.join("report.toml"), text).expect("written");
        let output = tcvae(&["report", "--config", "report.toml", "-o", "page"], path);
        assert_eq!(output.status.code(), Some(status), "{output:?}");
        String::from_utf8(output.stderr).expect("text")
    };
    let other = REPORT.replace("[\"TC-VAE\", \"one seed\"]", "[\"TC-VAE\", \"two seeds\"]");
    assert!(refusal(&other, 2).contains("\"Arcs\" has no row \"two seeds\""));
    assert!(refusal(&REPORT.replace("seeds = [0, 1]", "seeds = []"), 2).contains("has no seeds"));
    assert!(refusal(&REPORT.replace("caption", "text"), 2).contains("unknown field `text`"));
    let same = REPORT.replace("Figure 7", "Figure 6");
    assert!(refusal(&same, 2).contains("two figures are named \"Figure 6\""));
    assert!(refusal(REPORT, 3).contains("model-0.safetensors"));
}
