//! Holds the arrows of the module map in `lib.rs`: a module uses those above it and none below,
//! adapters don't know each other, and only `model` and `training` name burn.
#![expect(clippy::unwrap_used, reason = "a test that panics says where")]

use std::fs;
use std::path::{Path, PathBuf};

/// The core's modules; each may use those before it.
const CORE: [&str; 12] = [
    "parameters",
    "trajectory",
    "alignment",
    "pose",
    "primitive",
    "kinematics",
    "primitives",
    "model",
    "demonstrations",
    "evaluation",
    "training",
    "serving",
];

/// The modules around the core; each may use the whole core and no other adapter, but for those
/// named here.
const ADAPTERS: [(&str, &[&str]); 10] = [
    ("archive", &[]),
    ("config", &[]),
    ("csv", &[]),
    ("artifact", &[]),
    ("urdf", &[]),
    ("bag", &[]),
    ("mime", &[]),
    ("dataset", &[]),
    ("ros", &[]),
    ("report", &[]),
];

fn sources(directory: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(directory).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(sources(&path));
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
    found.sort();
    found
}

/// Each library source with its module and its lines of code, without comments and unit tests.
fn library() -> Vec<(PathBuf, String, Vec<String>)> {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut library = Vec::new();
    for path in sources(&src) {
        let inner = path.strip_prefix(&src).unwrap().to_path_buf();
        let first = inner.iter().next().unwrap().to_str().unwrap();
        let module = first.trim_end_matches(".rs").to_string();
        if module == "lib" || module == "bin" {
            continue;
        }
        let text = fs::read_to_string(&path).unwrap();
        let code = text.lines().take_while(|l| !l.starts_with("#[cfg(test)]"));
        let code = code.filter(|l| !l.trim_start().starts_with("//")).map(String::from).collect();
        library.push((inner, module, code));
    }
    assert!(library.len() > 20, "the sources were not found");
    library
}

/// The modules of this crate that a line names.
fn named(line: &str) -> impl Iterator<Item = &str> {
    line.split("crate::").skip(1).map(|rest| {
        rest.split(|c: char| !(c.is_alphanumeric() || c == '_')).next().unwrap_or_default()
    })
}

#[test]
fn modules_use_only_those_above_them() {
    let core = |name: &str| CORE.iter().position(|m| *m == name);
    let mut wrong = Vec::new();
    for (path, module, code) in library() {
        let adapter = ADAPTERS.iter().find(|(name, _)| *name == module);
        assert!(core(&module).is_some() || adapter.is_some(), "{module} is in no list");
        for line in code {
            for used in named(&line) {
                let known = core(used).is_some() || ADAPTERS.iter().any(|(name, _)| *name == used);
                if used == module || !known {
                    continue;
                }
                let allowed = match (core(&module), core(used), adapter) {
                    (Some(this), Some(other), _) => other < this,
                    (None, Some(_), _) => true,
                    (None, None, Some((_, others))) => others.contains(&used),
                    _ => false,
                };
                if !allowed {
                    wrong.push(format!("{}: {}", path.display(), line.trim()));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "against the arrows:\n{}", wrong.join("\n"));
}

#[test]
fn only_model_and_training_name_burn() {
    for (path, module, code) in library() {
        if module == "model" || module == "training" {
            continue;
        }
        for line in code {
            assert!(!line.contains("burn::"), "{}: {line}", path.display());
        }
    }
}

#[test]
fn what_models_trains_and_serves_knows_no_action() {
    for (path, module, code) in library() {
        if ["model", "training", "serving", "ros"].contains(&module.as_str()) {
            for line in code {
                assert!(!line.to_lowercase().contains("pour"), "{}: {line}", path.display());
            }
        }
    }
}

#[test]
fn the_core_reads_no_files_sockets_clocks_or_ambient_randomness() {
    let ambient = [
        "std::fs",
        "std::net",
        "std::time::Instant",
        "std::time::SystemTime",
        "rand::rng()",
        "log::",
    ];
    for (path, module, code) in library() {
        if !CORE.contains(&module.as_str()) {
            continue;
        }
        for line in code {
            let found = ambient.iter().find(|a| line.contains(**a));
            assert!(found.is_none(), "{}: {line}", path.display());
        }
    }
}
