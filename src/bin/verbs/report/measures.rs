//! Measuring the rows of a report, each model once.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use tcvae::artifact::{self, Artifact};
use tcvae::demonstrations::Splits;
use tcvae::evaluation::{CaseOutcome, Evaluation, ModelEvaluation};

use super::super::evaluate;
use super::{Loaded, Sources, TestSet};

/// What was measured of one model on one test set.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Measured {
    pub(super) evaluation: ModelEvaluation,
    /// One for each test case.
    pub(super) outcomes: Vec<CaseOutcome>,
}

impl Measured {
    /// The evaluation of a model with manner parameters.
    pub(super) fn with_manner(&self) -> Option<&Evaluation> {
        match &self.evaluation {
            ModelEvaluation::TcVae(evaluation) => Some(evaluation),
            ModelEvaluation::Classical(_) => None,
        }
    }
}

pub(super) struct Measures<'a> {
    pub(super) cache: &'a Path,
    pub(super) seed: u64,
}

impl Measures<'_> {
    /// Measures every model of every row, in their order.
    pub(super) fn measure(
        &self,
        test: &TestSet,
        rows: &[Loaded<'_>],
        sources: &Sources,
    ) -> anyhow::Result<Vec<Vec<Measured>>> {
        let mut all = Vec::new();
        // Models of one task share their test cases, which take time to read.
        let mut known: Vec<(String, Splits, String)> = Vec::new();
        for row in rows {
            for artifact in &row.models {
                let task = super::key(&artifact.document.task);
                if !known.iter().any(|(known, ..)| *known == task) {
                    let (splits, digest) = sources.splits(test, artifact)?;
                    known.push((task, splits, digest));
                }
            }
        }
        if let [(_, first, _), others @ ..] = known.as_slice()
            && let Some((_, other, _)) = others.iter().find(|o| o.1.test.len() != first.test.len())
        {
            let (test, a, b) = (&test.name, first.test.len(), other.test.len());
            bail!(
                "{test}: rows have {a} and {b} test cases, as their tasks differ; compare rows of \
                 one task"
            );
        }
        for row in rows {
            let measure = |artifact: &Artifact| {
                let task = super::key(&artifact.document.task);
                let of_task = known.iter().find(|(known, ..)| *known == task);
                let (_, splits, digest) = of_task.expect("read above");
                self.one(test, artifact, splits, &sources.of(artifact).digest, digest)
            };
            let name = &row.config.name;
            eprintln!("{}: {name}, {} models", test.name, row.models.len());
            let measured = row.models.par_iter().map(measure).collect::<anyhow::Result<Vec<_>>>();
            all.push(measured.with_context(|| format!("row {name}"))?);
        }
        Ok(all)
    }

    fn one(
        &self,
        test: &TestSet,
        artifact: &Artifact,
        splits: &Splits,
        trained_on: &str,
        digest: &str,
    ) -> anyhow::Result<Measured> {
        let path = self.path(test, artifact, [trained_on, digest]);
        if let Ok(text) = fs::read_to_string(&path)
            && let Ok(measured) = serde_json::from_str(&text)
        {
            return Ok(measured);
        }
        let digest = digest.to_owned();
        let (evaluation, outcomes) = evaluate::measure_cases(artifact, splits, digest, self.seed)?;
        let measured = Measured { evaluation, outcomes };
        fs::create_dir_all(self.cache).with_context(|| self.cache.display().to_string())?;
        let text = serde_json::to_string(&measured).expect("measures are JSON");
        artifact::write(&path, text.as_bytes())?;
        Ok(measured)
    }

    /// Where the measurement is kept: for this model, what probes are fitted on, what is tested on, and
    /// these sources of the program.
    fn path(&self, test: &TestSet, artifact: &Artifact, digests: [&str; 2]) -> PathBuf {
        let (model, revision) = (artifact.model_id(), env!("TCVAE_GIT_REVISION"));
        let data = digests.join(" ");
        let key = format!("{model} {data} {} {} {revision}", test.halves, self.seed);
        let digest = Sha256::digest(key.as_bytes());
        let name: String = digest[..8].iter().map(|byte| format!("{byte:02x}")).collect();
        self.cache.join(format!("{model}-{name}.json"))
    }
}
