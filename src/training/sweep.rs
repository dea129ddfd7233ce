//! Many trainings that differ in their settings, and which of them is best on the validation set.
//!
//! Test demonstrations play no part here. The score is the share of prior samples that are robust
//! and valid, under floors: alone it would choose a model that hardly varies.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::config::TrainingConfig;
use crate::evaluation::Evaluation;

/// A sweep (`config/sweep-*.toml`).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SweepConfig {
    /// What is trained on: recordings, or a data set, as for `tcvae train`.
    pub data: Vec<String>,
    /// The task that was shown, a TOML file; that of `tcvae train` without one.
    #[serde(default)]
    pub task: Option<String>,
    /// The robot that was recorded, a TOML file; Baxter without one.
    #[serde(default)]
    pub robot: Option<String>,
    /// Folder for the models and what was measured.
    pub output: String,
    /// Each combination of settings is trained with each of these seeds.
    pub seeds: Vec<u64>,
    /// Settings that differ from a training's default in all rows.
    #[serde(default)]
    pub set: toml::Table,
    /// What a combination must reach to be chosen.
    #[serde(default)]
    pub floors: Floors,
    /// Kinds of models; the best combination of each is chosen.
    #[serde(rename = "row")]
    pub rows: Vec<Row>,
}

/// What a combination of settings must reach, as means over its seeds on the validation set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Floors {
    /// SUCCESS at the smallest threshold, as a share of the best in the row.
    pub success: f64,
    /// Active latents.
    pub active_latents: f64,
    /// Largest leak of the task, R2.
    pub leak: f64,
}

impl Default for Floors {
    fn default() -> Self {
        Self { success: 0.9, active_latents: 1.0, leak: 0.1 }
    }
}

/// A kind of models.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Row {
    /// Its name, as in a table of results.
    pub name: String,
    /// Settings that differ in all of the row.
    #[serde(default)]
    pub set: toml::Table,
    /// Settings with the values to try; all combinations are. Nested ones as `"network.width"`.
    #[serde(default)]
    pub grid: BTreeMap<String, Vec<toml::Value>>,
    /// Floors of this row in place of the sweep's.
    #[serde(default)]
    pub floors: Option<Floors>,
}

/// One training of a sweep.
#[derive(Debug, Clone, PartialEq)]
pub struct Run {
    /// Name of its row.
    pub row: String,
    /// The values of the row's grid, as text; the same for all seeds of a combination.
    pub combination: String,
    /// All of its settings.
    pub config: TrainingConfig,
}

/// What came of a training: one line of `runs*.jsonl`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Record {
    /// Name of its folder.
    pub run: String,
    /// Name of its row.
    pub row: String,
    /// The values of the row's grid.
    pub combination: String,
    /// Its seed.
    pub seed: u64,
    /// SHA-256 over all settings and the data, so that another sweep's line is not taken for it.
    pub digest: String,
    /// Time of the training and the evaluation.
    pub seconds: f64,
    /// What was measured on the validation set; none where there is no model.
    pub validation: Option<Evaluation>,
    /// Why there is no model.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub failure: Option<String>,
}

/// A combination of settings as its seeds did on the validation set.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Ranked {
    /// Name of its row.
    pub row: String,
    /// The values of the row's grid.
    pub combination: String,
    /// Seeds that brought a model.
    pub seeds: usize,
    /// Seeds that did not.
    pub failures: usize,
    /// Mean share of samples that are robust and valid, at the smallest threshold.
    pub robust_and_valid: f64,
    /// Mean ROBUSTNESS there.
    pub robustness: f64,
    /// Mean SUCCESS there.
    pub success: f64,
    /// Mean number of active latents.
    pub active_latents: f64,
    /// Mean leak of the task.
    pub leak_r2: f64,
    /// Floors that it misses; it is chosen only where it misses none.
    pub misses: Vec<&'static str>,
}

/// Why a sweep can't be.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SweepError {
    /// There is nothing to do.
    #[error("the sweep has no {what}; name at least one")]
    Empty {
        /// What is missing.
        what: &'static str,
    },
    /// Two rows of a name.
    #[error("two rows are named {name:?}; their runs could not be told apart")]
    Twice {
        /// The name.
        name: String,
    },
    /// Settings of a row that are none.
    #[error("row {row:?}: {detail}")]
    Settings {
        /// The row.
        row: String,
        /// What is wrong.
        detail: String,
    },
}

impl SweepConfig {
    /// All trainings, in the order of the file: rows, combinations, seeds. What is not set is that of
    /// [`TrainingConfig::default`], in which all variants of ours are off, whatever the task.
    ///
    /// # Errors
    /// Nothing to do, two rows of one name, and settings that are none.
    pub fn runs(&self) -> Result<Vec<Run>, SweepError> {
        for (what, empty) in [
            ("data", self.data.is_empty()),
            ("seeds", self.seeds.is_empty()),
            ("row", self.rows.is_empty()),
        ] {
            if empty {
                return Err(SweepError::Empty { what });
            }
        }
        let mut runs = Vec::new();
        for (i, row) in self.rows.iter().enumerate() {
            if self.rows[..i].iter().any(|other| slug(&other.name) == slug(&row.name)) {
                return Err(SweepError::Twice { name: row.name.clone() });
            }
            for values in combinations(&row.grid) {
                let mut table =
                    toml::Table::try_from(TrainingConfig::default()).expect("settings are TOML");
                overlay(&mut table, self.set.clone());
                overlay(&mut table, row.set.clone());
                for (key, value) in &values {
                    overlay(&mut table, nested(key, (*value).clone()));
                }
                let error = |detail: String| SweepError::Settings { row: row.name.clone(), detail };
                let config: TrainingConfig =
                    table.try_into().map_err(|e: toml::de::Error| error(e.message().into()))?;
                config.check().map_err(|e| error(e.to_string()))?;
                let told = values.iter().map(|(key, value)| format!("{key}={value}"));
                let combination = told.collect::<Vec<_>>().join(" ");
                runs.extend(self.seeds.iter().map(|&seed| Run {
                    row: row.name.clone(),
                    combination: combination.clone(),
                    config: TrainingConfig { seed, ..config.clone() },
                }));
            }
        }
        Ok(runs)
    }

    /// The combinations of every row, best first: those that miss no floor by their score, then the
    /// others.
    pub fn ranking(&self, records: &[Record]) -> Vec<Ranked> {
        self.rows.iter().flat_map(|row| self.ranking_of(row, records)).collect()
    }

    fn ranking_of(&self, row: &Row, records: &[Record]) -> Vec<Ranked> {
        let mut combinations: BTreeMap<&str, Vec<&Record>> = BTreeMap::new();
        for record in records.iter().filter(|r| r.row == row.name) {
            combinations.entry(&record.combination).or_default().push(record);
        }
        let ranked = |(combination, records): (&str, Vec<&Record>)| {
            let measured: Vec<&Evaluation> =
                records.iter().filter_map(|r| r.validation.as_ref()).collect();
            let mean = |of: &dyn Fn(&Evaluation) -> f64| {
                measured.iter().map(|e| of(e)).sum::<f64>() / measured.len() as f64
            };
            Ranked {
                row: row.name.clone(),
                combination: combination.to_owned(),
                seeds: measured.len(),
                failures: records.len() - measured.len(),
                robust_and_valid: mean(&|e| e.robust_and_valid[0].mean),
                robustness: mean(&|e| e.robustness[0].mean),
                success: mean(&|e| e.success[0].mean),
                active_latents: mean(&|e| e.active_latents as f64),
                leak_r2: mean(&|e| e.leak_r2),
                misses: Vec::new(),
            }
        };
        let mut ranking: Vec<Ranked> = combinations.into_iter().map(ranked).collect();
        let best = ranking.iter().map(|r| r.success).fold(0.0, f64::max);
        let floors = row.floors.as_ref().unwrap_or(&self.floors);
        for ranked in &mut ranking {
            // Written so that what is not a number misses too.
            for (name, reached) in [
                ("a model for each seed", ranked.seeds > 0 && ranked.failures == 0),
                ("success", ranked.success >= floors.success * best),
                ("active latents", ranked.active_latents >= floors.active_latents),
                ("leak", ranked.leak_r2 <= floors.leak),
            ] {
                if !reached {
                    ranked.misses.push(name);
                }
            }
        }
        ranking.sort_by(|a, b| {
            let misses = a.misses.len().min(1).cmp(&b.misses.len().min(1));
            misses.then(b.robust_and_valid.total_cmp(&a.robust_and_valid))
        });
        ranking
    }
}

impl Run {
    /// Name of its folder.
    pub fn name(&self) -> String {
        let Self { row, combination, config } = self;
        let parts = [row.as_str(), combination, &format!("seed={}", config.seed)];
        parts.iter().filter(|p| !p.is_empty()).map(|p| slug(p)).collect::<Vec<_>>().join("_")
    }
}

/// The text as a name of a file.
fn slug(text: &str) -> String {
    let kept = |c: char| c.is_ascii_alphanumeric() || "=.-".contains(c);
    let words = text.split(|c: char| !kept(c)).filter(|word| !word.is_empty());
    words.collect::<Vec<_>>().join("-").to_lowercase()
}

/// Every combination of the values, the last key's varying fastest.
fn combinations(grid: &BTreeMap<String, Vec<toml::Value>>) -> Vec<Vec<(&str, &toml::Value)>> {
    let mut combinations = vec![Vec::new()];
    for (key, values) in grid {
        let mut longer = Vec::with_capacity(combinations.len() * values.len());
        for before in &combinations {
            let with = |value| [before.as_slice(), &[(key.as_str(), value)]].concat();
            longer.extend(values.iter().map(with));
        }
        combinations = longer;
    }
    combinations
}

/// `a.b = value` as tables.
pub fn nested(key: &str, value: toml::Value) -> toml::Table {
    let (first, value) = match key.split_once('.') {
        Some((first, rest)) => (first, toml::Value::Table(nested(rest, value))),
        None => (key, value),
    };
    toml::Table::from_iter([(first.to_owned(), value)])
}

/// Puts the values of `over` into `table`, those of inner tables one by one.
pub fn overlay(table: &mut toml::Table, over: toml::Table) {
    for (key, value) in over {
        match (table.get_mut(&key), value) {
            (Some(toml::Value::Table(inner)), toml::Value::Table(over)) => overlay(inner, over),
            (_, value) => {
                table.insert(key, value);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::Score;

    fn sweep(rows: &str) -> SweepConfig {
        toml::from_str(&format!("data = ['d']\noutput = 'o'\nseeds = [0, 5]\n{rows}")).unwrap()
    }

    const ROWS: &str = "
        [[row]]
        name = 'no aux'
        set = { alpha = 0, network = { width = 16 } }
        [[row]]
        name = 'TC-VAE'
        grid = { beta = [1, 4], 'network.latents' = [2, 3] }
    ";

    #[test]
    fn every_combination_is_trained_with_every_seed() {
        let runs = sweep(ROWS).runs().unwrap();
        let names: Vec<_> = runs.iter().map(Run::name).collect();
        assert_eq!(names.len(), 2 + 4 * 2);
        assert_eq!(names[..2], ["no-aux_seed=0", "no-aux_seed=5"]);
        assert_eq!(names[3], "tc-vae_beta=1-network.latents=2_seed=5");
        let TrainingConfig { alpha, ref network, seed, .. } = runs[1].config;
        assert_eq!((alpha, network.width, network.latents, seed), (0.0, 16, 4, 5));
        let TrainingConfig { beta, ref network, .. } = runs[9].config;
        assert_eq!((beta, network.width, network.latents), (4.0, 32, 3));
    }

    #[test]
    fn a_sweep_that_can_not_be_is_refused() {
        let refusal = |rows: &str| sweep(rows).runs().unwrap_err();
        let unknown = refusal("[[row]]\nname = 'a'\nset = { network = { depth = 3 } }");
        assert!(unknown.to_string().starts_with("row \"a\": unknown field `depth`"), "{unknown}");
        let out = refusal("[[row]]\nname = 'a'\ngrid = { batch = [0] }");
        assert_eq!(out.to_string(), "row \"a\": batch is 0; it must be at least 1");
        let twice = refusal("[[row]]\nname = 'a b'\n[[row]]\nname = 'A  B'");
        assert!(matches!(twice, SweepError::Twice { .. }), "{twice}");
        assert_eq!(refusal("row = []").to_string(), "the sweep has no row; name at least one");
    }

    fn record(combination: &str, seed: u64, [s, rv, active, leak]: [f64; 4]) -> Record {
        let score = |mean| vec![Score { threshold: 0.1, mean, low: mean, high: mean }];
        Record {
            run: format!("{combination} {seed}"),
            row: "TC-VAE".into(),
            combination: combination.into(),
            seed,
            digest: String::new(),
            seconds: 1.0,
            validation: Some(Evaluation {
                success: score(s),
                robustness: score(rv),
                robust_and_valid: score(rv),
                broken_bounds: BTreeMap::new(),
                with_standard_normal_prior: None,
                active_latents: active as usize,
                reconstruction_rmse: 0.1,
                leak_r2: leak,
                swap: 1.0,
                calibration: None,
                disentanglement: None,
                cases: 10,
                seed: 0,
                model_id: String::new(),
                data_digest: String::new(),
            }),
            failure: None,
        }
    }

    #[test]
    fn the_best_is_chosen_among_those_above_the_floors() {
        let mut failed = record("diverged", 0, [0.0; 4]);
        failed.validation = None;
        let records = [
            record("good", 0, [0.9, 0.8, 3.0, 0.0]),
            record("good", 5, [1.0, 0.6, 4.0, 0.04]),
            record("collapsed", 0, [0.95, 1.0, 0.0, 0.0]),
            record("leaking", 0, [1.0, 0.9, 4.0, 0.5]),
            record("blurred", 0, [0.5, 0.9, 4.0, 0.0]),
            record("fair", 0, [1.0, 0.65, 4.0, 0.0]),
            failed,
        ];
        let ranking = sweep(ROWS).ranking(&records);
        let order: Vec<_> = ranking.iter().map(|r| r.combination.as_str()).collect();
        assert_eq!(order[..2], ["good", "fair"]);
        let good = &ranking[0];
        assert_eq!((good.seeds, good.active_latents, good.misses.len()), (2, 3.5, 0));
        assert!((good.robust_and_valid - 0.7).abs() < 1e-12 && (good.leak_r2 - 0.02).abs() < 1e-12);
        let misses: BTreeMap<_, _> =
            ranking[2..].iter().map(|r| (r.combination.as_str(), r.misses.clone())).collect();
        assert_eq!(misses["collapsed"], ["active latents"]);
        assert_eq!(misses["leaking"], ["leak"]);
        assert_eq!(misses["blurred"], ["success"]);
        assert!(misses["diverged"].contains(&"a model for each seed"));
    }
}
