//! The settings under `config/` are what the program does without them, and what the figures were made with.
#![cfg(feature = "train")]

use tcvae::demonstrations::pouring;
use tcvae::training::TrainingConfig;
use tcvae::training::sweep::SweepConfig;

#[test]
fn the_shipped_files_are_the_presets() {
    let of = |text| toml::from_str::<TrainingConfig>(text).unwrap();
    assert_eq!(of(include_str!("../config/train-arcs.toml")), TrainingConfig::default());
    let pouring = TrainingConfig::of_arm(&pouring::task().manner);
    assert_eq!(of(include_str!("../config/train-pouring.toml")), pouring);
}

#[test]
fn the_shipped_files_name_every_setting() {
    let keys = |table: &toml::Table| {
        let mut keys = Vec::new();
        for (key, value) in table {
            match value.as_table() {
                Some(inner) => keys.extend(inner.keys().map(|k| format!("{key}.{k}"))),
                None => keys.push(key.clone()),
            }
        }
        keys
    };
    let all = keys(&toml::Table::try_from(TrainingConfig::default()).unwrap());
    for file in
        [include_str!("../config/train-arcs.toml"), include_str!("../config/train-pouring.toml")]
    {
        assert_eq!(keys(&file.parse().unwrap()), all);
    }
}

#[test]
fn the_shipped_sweeps_are_ones() {
    for (text, runs) in [
        (include_str!("../config/sweep-arcs.toml"), 30),
        (include_str!("../config/sweep-arcs-literal.toml"), 6),
        (include_str!("../config/sweep-arcs-full.toml"), 15),
        (include_str!("../config/sweep-pouring.toml"), 18),
        (include_str!("../config/results-arcs.toml"), 30),
        (include_str!("../config/results-arcs-full.toml"), 30),
        (include_str!("../config/results-pouring.toml"), 20),
    ] {
        let sweep: SweepConfig = toml::from_str(text).unwrap();
        assert_eq!(sweep.runs().unwrap().len(), runs, "{}", sweep.output);
    }
}

#[test]
fn the_results_on_pouring_are_of_the_shipped_settings() {
    let text = include_str!("../config/results-pouring-ours.toml");
    let sweep: SweepConfig = toml::from_str(text).unwrap();
    for run in sweep.runs().unwrap() {
        let shipped = TrainingConfig {
            seed: run.config.seed,
            ..TrainingConfig::of_arm(&pouring::task().manner)
        };
        assert_eq!(run.config, shipped);
    }
}
