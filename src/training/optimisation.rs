//! The loop over epochs and batches.

use std::sync::atomic::{AtomicBool, Ordering};

use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use rand::seq::SliceRandom;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

use super::adam::Adam;
use super::anchors::Scorer;
use super::config::{SettingError, TrainingConfig};
use super::report::{EpochReport, LatentStatistics, MeanTerms};
use super::selection::Selector;
use crate::demonstrations::{Demonstration, Splits, Task};
use crate::model::{
    Backend, Batch, ConfigError, Layout, LearnedPrior, ModelConfig, NamedTensor, Normalizer,
    Objective, PartGradients, Posterior, Recogniser, Recognition, Strengths, Terms, Units, Weights,
    WeightsError, time_major,
};
use crate::primitives::PrimitiveError;
use crate::trajectory::Motion;

/// Why a training can't start or go on.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TrainingError {
    /// A setting.
    #[error("{0}")]
    Setting(#[from] SettingError),
    /// A size of the networks.
    #[error("{0}")]
    Config(#[from] ConfigError),
    /// A backend that this build does not have.
    #[error("this build has no backend {backend}")]
    Backend {
        /// The backend.
        backend: Backend,
    },
    /// Too few demonstrations.
    #[error("{found} demonstrations for {part}; at least {needed} are needed")]
    TooFew {
        /// `training` or `validation`.
        part: &'static str,
        /// Demonstrations that there are.
        found: usize,
        /// Demonstrations that are needed.
        needed: usize,
    },
    /// Demonstrations that don't fit together.
    #[error("demonstration {id} has states of {found} values; others have {expected}")]
    StateDim {
        /// The demonstration.
        id: String,
        /// Values of its states.
        found: usize,
        /// Values of the others' states.
        expected: usize,
    },
    /// A demonstration that can't be aligned.
    #[error(
        "demonstration {id} has {found} events; network.segments = {} needs {needed}", needed + 1
    )]
    Events {
        /// The demonstration.
        id: String,
        /// Events that it has.
        found: usize,
        /// Events between that many segments.
        needed: usize,
    },
    /// A factor that the task does not measure.
    #[error("the task measures no factor {name} for manner.anchors; it measures {known}")]
    UnknownFactor {
        /// The factor.
        name: String,
        /// Those that there are.
        known: String,
    },
    /// More anchors than latents.
    #[error("{anchors} manner.anchors for {latents} network.latents; at most one for each")]
    TooManyAnchors {
        /// The anchors.
        anchors: usize,
        /// The latents.
        latents: usize,
    },
    /// A prior that can't be learned.
    #[error("the learned prior (network.prior_components): {0}")]
    Prior(#[from] PrimitiveError),
    /// A demonstration that does not show the task.
    #[error("demonstration {id} does not show the task, so it has no factors for manner.anchors")]
    NoFactors {
        /// The demonstration.
        id: String,
    },
    /// The objective is no longer finite.
    #[error(
        "the training diverged in epoch {epoch}: the objective is no longer finite; lower \
         learning_rate (now {learning_rate})"
    )]
    Diverged {
        /// The epoch.
        epoch: usize,
        /// The learning rate.
        learning_rate: f64,
    },
}

/// Why a checkpoint is not one of this training.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("the checkpoint does not fit this training: {0}")]
pub struct CheckpointError(#[from] WeightsError);

/// The whole state of a training between two epochs.
#[derive(Debug, Clone, PartialEq)]
pub struct Checkpoint {
    /// Epochs that are done.
    pub epochs: usize,
    /// The recognition network and the decoder.
    pub model: Adam,
    /// The adversary.
    pub adversary: Adam,
    /// The last epoch that is done.
    pub report: Option<EpochReport>,
    /// The epoch that would be kept by now, where epochs are selected.
    pub best: Option<Best>,
}

/// The model of one epoch.
#[derive(Debug, Clone, PartialEq)]
pub struct Best {
    /// Number of the epoch, from 1.
    pub epoch: usize,
    /// Samples that were robust and valid.
    pub hits: usize,
    /// The recognition network and the decoder.
    pub model: Vec<f32>,
}

/// What a training tells while it runs.
#[derive(Debug)]
#[non_exhaustive]
pub enum Progress<'a> {
    /// A batch was learned.
    Batch {
        /// Batches that are done, over all epochs.
        done: usize,
        /// Batches of the whole training.
        total: usize,
    },
    /// An epoch is over.
    Epoch {
        /// What it brought.
        report: &'a EpochReport,
        /// The state after it.
        checkpoint: &'a Checkpoint,
    },
}

/// How a training ended.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// All epochs are done.
    Finished(Box<Trained>),
    /// It was told to stop; the last epoch's checkpoint stands.
    Stopped {
        /// Epochs that are done.
        epochs: usize,
    },
}

/// A trained model.
#[derive(Debug, Clone, PartialEq)]
pub struct Trained {
    /// Its shape.
    pub model: ModelConfig,
    /// Its units.
    pub normalizer: Normalizer,
    /// Its tensors: the networks', and the baseline's where it has one.
    pub weights: Weights,
    /// The posteriors of the validation set, one entry for each latent.
    pub latents: Vec<LatentStatistics>,
    /// The last epoch.
    pub last_epoch: Option<EpochReport>,
    /// The epoch whose model this is, where epochs are selected.
    pub selected_epoch: Option<usize>,
}

impl Checkpoint {
    fn start(layouts: &[Layout; 2], seed: u64) -> Self {
        let mut rng = stream(seed, START_STREAM);
        let [model, adversary] = layouts;
        let model = Adam::new(model.initial(&mut rng));
        let adversary = Adam::new(adversary.initial(&mut rng));
        Self { epochs: 0, model, adversary, report: None, best: None }
    }

    /// The state but for the report as tensors, for a file: `model.values`, `model.first`, … and
    /// `epochs`.
    pub fn to_weights(&self) -> Weights {
        let mut weights = Weights::new();
        let mut add = |name: String, values: &[f32]| {
            let values = values.to_vec();
            weights.insert(name, NamedTensor { shape: vec![values.len()], values });
        };
        for (player, Adam { values, first, second, steps }) in
            [("model", &self.model), ("adversary", &self.adversary)]
        {
            add(format!("{player}.values"), values);
            add(format!("{player}.first"), first);
            add(format!("{player}.second"), second);
            add(format!("{player}.steps"), &split_count(*steps));
        }
        add("epochs".into(), &split_count(self.epochs as u64));
        if let Some(Best { epoch, hits, model }) = &self.best {
            add("best.epoch".into(), &split_count(*epoch as u64));
            add("best.hits".into(), &split_count(*hits as u64));
            add("best.model".into(), model);
        }
        weights
    }

    /// The state of a training with this configuration, from tensors.
    ///
    /// # Errors
    /// A tensor that is missing or is another configuration's.
    pub fn from_weights(
        config: &TrainingConfig,
        model: &ModelConfig,
        weights: &Weights,
        report: Option<EpochReport>,
    ) -> Result<Self, CheckpointError> {
        let flat = |name: &str, len: usize| -> Result<Vec<f32>, CheckpointError> {
            Ok(crate::model::checked(weights, name, &[len])?.values.clone())
        };
        let count = |name: &str| flat(name, 2).map(|halves| join_count(&halves));
        let adam = |player: &str, layout: &Layout| -> Result<Adam, CheckpointError> {
            let tensor = |kind: &str| flat(&format!("{player}.{kind}"), layout.len());
            let steps = count(&format!("{player}.steps"))?;
            let (values, first, second) = (tensor("values")?, tensor("first")?, tensor("second")?);
            Ok(Adam { values, first, second, steps })
        };
        let [of_model, of_adversary] = layouts(config, model);
        let best = || -> Result<Best, CheckpointError> {
            let (epoch, hits) = (count("best.epoch")? as usize, count("best.hits")? as usize);
            Ok(Best { epoch, hits, model: flat("best.model", of_model.len())? })
        };
        Ok(Self {
            best: weights.contains_key("best.model").then(best).transpose()?,
            epochs: count("epochs")? as usize,
            model: adam("model", &of_model)?,
            adversary: adam("adversary", &of_adversary)?,
            report,
        })
    }
}

/// A count as two tensor values that f32 holds exactly.
fn split_count(count: u64) -> [f32; 2] {
    [(count >> 24) as f32, (count & 0xff_ffff) as f32]
}

fn join_count(halves: &[f32]) -> u64 {
    ((halves[0] as u64) << 24) + halves[1] as u64
}

/// Stream of the start values; the epochs' streams are their numbers, from 1.
const START_STREAM: u64 = 0;
/// Stream of the noise on the validation set: the same in every epoch.
const VALIDATION_STREAM: u64 = u64::MAX;

/// Stream of what a learned prior is fitted with.
const PRIOR_STREAM: u64 = u64::MAX - 1;

fn stream(seed: u64, stream: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(stream);
    rng
}

fn layouts(config: &TrainingConfig, model: &ModelConfig) -> [Layout; 2] {
    [Layout::of_model(model), Layout::of_adversary(model, config.adversary.width)]
}

/// Demonstrations in normalised units.
struct Normalised {
    config: ModelConfig,
    /// One sequence of states for each demonstration.
    x: Vec<Vec<f32>>,
    w: Vec<Vec<f32>>,
    /// The standard scores that the first latents are drawn to; empty rows without.
    anchors: Vec<Vec<f32>>,
}

impl Normalised {
    fn new(
        config: &ModelConfig,
        units: &Units,
        demonstrations: &[Demonstration],
        anchors: Vec<Vec<f32>>,
    ) -> Self {
        let w: Vec<_> = demonstrations.iter().map(|d| units.task(d.w.values())).collect();
        let states = |(d, w): (&Demonstration, &Vec<f32>)| units.states(&d.motion.states, w);
        let x = demonstrations.iter().zip(&w).map(states).collect();
        Self { config: config.clone(), x, w, anchors }
    }

    fn len(&self) -> usize {
        self.x.len()
    }

    /// The batch of the demonstrations at `indices`, with fresh noise.
    fn batch(&self, indices: &[u32], rng: &mut ChaCha8Rng) -> Batch {
        let x = indices.iter().map(|&i| self.x[i as usize].clone()).collect();
        let latents = self.config.network.latents;
        Batch {
            sequences: indices.len(),
            x: time_major(&self.config, x),
            w: indices.iter().flat_map(|&i| self.w[i as usize].iter().copied()).collect(),
            noise: StandardNormal.sample_iter(rng).take(indices.len() * latents).collect(),
            anchors: indices
                .iter()
                .flat_map(|&i| self.anchors[i as usize].iter().copied())
                .collect(),
        }
    }

    /// The batch in parts of nearly equal size.
    fn parts(&self, indices: &[u32], parts: usize, rng: &mut ChaCha8Rng) -> Vec<Batch> {
        indices
            .chunks(indices.len().div_ceil(parts))
            .map(|indices| self.batch(indices, rng))
            .collect()
    }
}

/// Trains a primitive for `task` on `data.train` and reports on `data.validation`; the test part is
/// left alone.
///
/// The result depends on the configuration, the demonstrations and `start` alone: not on the
/// number of cores, and not on where a training was stopped and resumed. `stop` is read before
/// every batch.
///
/// # Errors
/// Settings or data that can't be trained with, and an objective that is no longer finite.
pub fn train(
    config: &TrainingConfig,
    task: &dyn Task,
    data: &Splits,
    start: Option<Checkpoint>,
    stop: &AtomicBool,
    observe: &mut dyn FnMut(Progress<'_>),
) -> Result<Outcome, TrainingError> {
    let model = model_config(config, data)?;
    let sequences = |part: &[Demonstration]| -> Vec<Demonstration> {
        part.iter().map(|d| as_sequence(&model, d)).collect()
    };
    let scorer = Scorer::fit(&config.manner.anchors, task, &data.train)?;
    let anchors = scorer.scores(&data.train)?;
    let train = sequences(&data.train);
    let units = Units::fit(&model, &train);
    let train = Normalised::new(&model, &units, &train, anchors);
    let anchors = scorer.scores(&data.validation)?;
    let held_out = Normalised::new(&model, &units, &sequences(&data.validation), anchors);

    let layouts = layouts(config, &model);
    let objective = Objective::new(&model, config.adversary.width, config.backend)
        .with_constants(config.constants_factor as f32);
    let mut state = start.unwrap_or_else(|| Checkpoint::start(&layouts, config.seed));
    let batches = train.len().div_ceil(config.batch);
    let total = config.epochs * batches;
    let selector = Selector::new(config, task, &data.validation);
    let weights = |values: &[f32]| {
        let mut weights = layouts[0].to_weights(values);
        if let Some(baseline) = &units.baseline {
            baseline.add_to(&mut weights);
        }
        weights
    };
    for epoch in state.epochs..config.epochs {
        let mut rng = stream(config.seed, epoch as u64 + 1);
        let mut order: Vec<u32> = (0..train.len() as u32).collect();
        order.shuffle(&mut rng);
        let mut sums = Terms::default();
        for (i, indices) in order.chunks(config.batch).enumerate() {
            if stop.load(Ordering::Relaxed) {
                return Ok(Outcome::Stopped { epochs: epoch });
            }
            let done = epoch * batches + i;
            let strengths = Strengths {
                beta: config.beta as f32,
                alpha: config.alpha_at(done as f64 / batches as f64) as f32,
                gamma: config.manner.anchor_strength as f32,
            };
            let parts = train.parts(indices, config.parts, &mut rng);
            let gradients = |part: &Batch| {
                let (model, adversary) = (&state.model.values, &state.adversary.values);
                objective.gradients(model, adversary, part, indices.len(), strengths)
            };
            let summed = sum(parts.par_iter().map(gradients).collect());
            if !summed.model.iter().chain(&summed.adversary).all(|g| g.is_finite()) {
                let learning_rate = config.learning_rate;
                return Err(TrainingError::Diverged { epoch: epoch + 1, learning_rate });
            }
            let learning_rate = config.learning_rate_at(done as f64 / total as f64);
            state.model.step(&summed.model, learning_rate);
            state.adversary.step(&summed.adversary, config.adversary.learning_rate);
            sums.add(&summed.terms);
            observe(Progress::Batch { done: done + 1, total });
        }
        state.epochs = epoch + 1;
        let validation = mean(&terms(&objective, &state, &held_out, config));
        let hits = selector.as_ref().map(|selector| {
            let hits = selector.hits(&model, &units.normalizer, &weights(&state.model.values));
            let eligible = selector.eligible(state.epochs, validation.active_latents());
            // Of equals the later one, which has learned longer.
            if eligible && state.best.as_ref().is_none_or(|best| hits >= best.hits) {
                let (epoch, model) = (state.epochs, state.model.values.clone());
                state.best = Some(Best { epoch, hits, model });
            }
            hits as f64 / selector.samples() as f64
        });
        let share = state.epochs as f64 / config.epochs as f64;
        let report = EpochReport {
            epoch: state.epochs,
            learning_rate: config.learning_rate_at(share),
            alpha: config.alpha_at(state.epochs as f64),
            train: mean(&sums),
            validation,
            robust_and_valid: hits,
        };
        state.report = Some(report.clone());
        observe(Progress::Epoch { report: &report, checkpoint: &state });
        let best = state.best.as_ref().map(|best| best.epoch);
        if config.selection.stops(state.epochs, best) {
            break;
        }
    }

    let selected_epoch = state.best.as_ref().map(|best| best.epoch);
    let mut weights = weights(state.best.as_ref().map_or(&state.model.values, |best| &best.model));
    let normalizer = units.normalizer;
    let recogniser = Recogniser::new(&model, &normalizer, &weights, config.backend)
        .expect("weights that were just trained");
    let latents = statistics(&recogniser.recognise(&data.validation));
    if model.network.prior_components > 0 {
        let mut rng = stream(config.seed, PRIOR_STREAM);
        let samples = sampled(&recogniser.recognise(&data.train), &mut rng);
        LearnedPrior::fit(&samples, model.network.prior_components, &mut rng)?.add_to(&mut weights);
    }
    let last_epoch = state.report;
    Ok(Outcome::Finished(Box::new(Trained {
        model,
        normalizer,
        weights,
        latents,
        last_epoch,
        selected_epoch,
    })))
}

/// Checks settings and data, and gives the model's shape.
fn model_config(config: &TrainingConfig, data: &Splits) -> Result<ModelConfig, TrainingError> {
    config.check()?;
    if !Backend::ALL.contains(&config.backend) {
        return Err(TrainingError::Backend { backend: config.backend });
    }
    for (part, demonstrations) in [("training", &data.train), ("validation", &data.validation)] {
        if demonstrations.len() < 2 {
            let found = demonstrations.len();
            return Err(TrainingError::TooFew { part, found, needed: 2 });
        }
    }
    let first = &data.train[0];
    let expected = first.motion.states.dim();
    let odd = |d: &&Demonstration| d.motion.states.dim() != expected;
    if let Some(d) = data.train.iter().chain(&data.validation).find(odd) {
        let found = d.motion.states.dim();
        return Err(TrainingError::StateDim { id: d.id.clone(), found, expected });
    }
    // Phases alone need no events; times need those of every segment's ends.
    let needed = config.network.segments.saturating_sub(1);
    let odd = |d: &&Demonstration| needed > 0 && d.events.len() != needed;
    if let Some(d) = data.train.iter().chain(&data.validation).find(odd) {
        let (id, found) = (d.id.clone(), d.events.len());
        return Err(TrainingError::Events { id, found, needed });
    }
    let model = config.model(expected, first.w.values().len());
    model.check()?;
    let (anchors, latents) = (config.manner.anchors.len(), config.network.latents);
    if anchors > latents {
        return Err(TrainingError::TooManyAnchors { anchors, latents });
    }
    Ok(model)
}

/// The demonstration with what the networks see in place of its states.
fn as_sequence(model: &ModelConfig, demonstration: &Demonstration) -> Demonstration {
    let states = model.sequence(demonstration);
    let motion = Motion { states, ..demonstration.motion };
    Demonstration { motion, ..demonstration.clone() }
}

/// The gradients of a batch from those of its parts, in their order.
fn sum(parts: Vec<PartGradients>) -> PartGradients {
    let mut parts = parts.into_iter();
    let mut total = parts.next().expect("a batch has at least one part");
    for part in parts {
        let add = |a: &mut [f32], b: &[f32]| a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
        add(&mut total.model, &part.model);
        add(&mut total.adversary, &part.adversary);
        total.terms.add(&part.terms);
    }
    total
}

/// The terms on held-out demonstrations.
fn terms(
    objective: &Objective,
    state: &Checkpoint,
    data: &Normalised,
    config: &TrainingConfig,
) -> Terms {
    let mut rng = stream(config.seed, VALIDATION_STREAM);
    let indices: Vec<u32> = (0..data.len() as u32).collect();
    let batches: Vec<Batch> =
        indices.chunks(config.batch).map(|indices| data.batch(indices, &mut rng)).collect();
    let of_batch =
        |batch: &Batch| objective.terms(&state.model.values, &state.adversary.values, batch);
    let mut sums = Terms::default();
    for terms in batches.par_iter().map(of_batch).collect::<Vec<_>>() {
        sums.add(&terms);
    }
    sums
}

fn mean(sums: &Terms) -> MeanTerms {
    let n = sums.sequences as f64;
    MeanTerms {
        negative_log_likelihood: sums.negative_log_likelihood / n,
        kl: sums.kl.iter().map(|kl| kl / n).collect(),
        adversary: sums.adversary / n,
        anchors: sums.anchors.iter().map(|squared| squared / n).collect(),
    }
}

/// One sample of each posterior.
fn sampled(posteriors: &[Posterior], rng: &mut ChaCha8Rng) -> Vec<Vec<f64>> {
    let mut sample = |posterior: &Posterior| {
        let latents = posterior.mean.iter().zip(&posterior.log_variance);
        let noise = |(mean, v): (&f64, &f64)| {
            let z: f64 = StandardNormal.sample(rng);
            mean + (0.5 * v).exp() * z
        };
        latents.map(noise).collect()
    };
    posteriors.iter().map(&mut sample).collect()
}

fn statistics(posteriors: &[Posterior]) -> Vec<LatentStatistics> {
    let n = posteriors.len() as f64;
    let latents = posteriors.first().map_or(0, |p| p.mean.len());
    let of_latent = |i: usize| {
        let mean_of = |f: &dyn Fn(f64, f64) -> f64| {
            posteriors.iter().map(|p| f(p.mean[i], p.log_variance[i])).sum::<f64>() / n
        };
        let mean = mean_of(&|mean, _| mean);
        LatentStatistics {
            mean,
            stddev: mean_of(&|m, _| (m - mean).powi(2)).sqrt(),
            variance: mean_of(&|_, v| v.exp()),
            kl: mean_of(&|m, v| 0.5 * (m * m + v.exp() - v - 1.0)),
        }
    };
    (0..latents).map(of_latent).collect()
}

#[cfg(test)]
mod tests {
    use super::super::{MannerConfig, SelectionConfig};
    use super::*;
    use crate::demonstrations::task::Factor;
    use crate::demonstrations::{TaskMeasureError, Violation};
    use crate::model::normalizer_tests::{demonstrations, space};
    use crate::model::{Activation, NetworkConfig};
    use crate::parameters::{TaskParameters, TaskSpace};

    /// The task of the tests' demonstrations: from one location to the other. Their manner is the
    /// bulge between.
    #[derive(Debug)]
    struct TwoWays;

    impl Task for TwoWays {
        fn name(&self) -> &'static str {
            "two ways"
        }

        fn task_space(&self) -> TaskSpace {
            space()
        }

        fn empirical_task(&self, motion: &Motion) -> Result<TaskParameters, TaskMeasureError> {
            let ends = [0, motion.states.steps() - 1].map(|i| motion.states.state(i)).concat();
            Ok(TaskParameters::new(&space(), ends).unwrap())
        }

        fn violations(&self, _: &Motion) -> Vec<Violation> {
            Vec::new()
        }

        fn factors(&self, motion: &Motion) -> Vec<Factor> {
            let last = motion.states.steps() - 1;
            let [a, b, middle] = [0, last, last / 2].map(|i| motion.states.state(i)[0]);
            vec![Factor {
                name: "bulge".into(),
                unit: "m",
                phrase: "aside".into(),
                value: middle - 0.5 * (a + b),
                derived: false,
            }]
        }
    }

    fn config() -> TrainingConfig {
        TrainingConfig {
            steps: 12,
            seed: 7,
            epochs: 4,
            batch: 16,
            alpha: 1.0,
            beta: 1.0,
            alpha_ramp_epochs: 2,
            network: NetworkConfig { width: 8, ..NetworkConfig::default() },
            adversary: super::super::AdversaryConfig { width: 8, ..Default::default() },
            ..TrainingConfig::default()
        }
    }

    fn data() -> Splits {
        Splits {
            train: demonstrations(56, 12, 1),
            validation: demonstrations(16, 12, 2),
            test: Vec::new(),
        }
    }

    fn run(config: &TrainingConfig, start: Option<Checkpoint>) -> (Trained, Vec<Checkpoint>) {
        let mut checkpoints = Vec::new();
        let stop = AtomicBool::new(false);
        let outcome = train(config, &TwoWays, &data(), start, &stop, &mut |progress| {
            if let Progress::Epoch { checkpoint, .. } = progress {
                checkpoints.push(checkpoint.clone());
            }
        });
        match outcome.unwrap() {
            Outcome::Finished(trained) => (*trained, checkpoints),
            stopped => panic!("{stopped:?}"),
        }
    }

    #[test]
    fn one_seed_gives_one_result_and_another_seed_another() {
        let (first, _) = run(&config(), None);
        assert_eq!(run(&config(), None).0, first);
        assert_ne!(run(&TrainingConfig { seed: 8, ..config() }, None).0.weights, first.weights);
    }

    #[test]
    fn a_resumed_training_ends_bit_for_bit_as_one_that_never_stopped() {
        let config = config();
        let (whole, checkpoints) = run(&config, None);
        // By way of the tensors that a file holds.
        let tensors = checkpoints[1].to_weights();
        let start = Checkpoint::from_weights(
            &config,
            &whole.model,
            &tensors,
            checkpoints[1].report.clone(),
        )
        .unwrap();
        assert_eq!(start, checkpoints[1]);
        let (resumed, rest) = run(&config, Some(start));
        assert_eq!(rest, checkpoints[2..]);
        assert_eq!(resumed, whole);
    }

    #[test]
    fn a_training_that_is_told_to_stop_leaves_whole_epochs_behind() {
        let stop = AtomicBool::new(false);
        let mut epochs = 0;
        let outcome =
            train(&config(), &TwoWays, &data(), None, &stop, &mut |progress| match progress {
                Progress::Batch { done, .. } => stop.store(done == 6, Ordering::Relaxed),
                Progress::Epoch { .. } => epochs += 1,
            });
        assert_eq!(outcome.unwrap(), Outcome::Stopped { epochs: 1 });
        assert_eq!(epochs, 1);
    }

    #[test]
    fn training_lowers_the_objective() {
        for network in [
            config().network,
            NetworkConfig { activation: Activation::Relu, residual: false, ..config().network },
            NetworkConfig { task_baseline: true, ..config().network },
        ] {
            let config = TrainingConfig { epochs: 30, network, ..config() };
            let mut losses = Vec::new();
            let stop = AtomicBool::new(false);
            train(&config, &TwoWays, &data(), None, &stop, &mut |progress| {
                if let Progress::Epoch { report, .. } = progress {
                    losses.push(report.validation.negative_log_likelihood);
                }
            })
            .unwrap();
            assert!(losses[29] < losses[0] - 5.0, "{} -> {}", losses[0], losses[29]);
        }
    }

    #[test]
    fn an_anchored_latent_becomes_its_factor() {
        let network = NetworkConfig {
            task_baseline: true,
            recognition_sees_context: true,
            segments: 1,
            margins: true,
            ..config().network
        };
        let manner = MannerConfig { anchors: vec!["bulge".into()], anchor_strength: 300.0 };
        let config =
            TrainingConfig { epochs: 100, learning_rate: 5e-3, network, manner, ..config() };
        let (trained, checkpoints) = run(&config, None);
        let anchors = |i: usize| checkpoints[i].report.as_ref().unwrap().train.anchors[0];
        assert!(anchors(99) < 0.1 * anchors(0), "{} -> {}", anchors(0), anchors(99));
        let recogniser =
            Recogniser::new(&trained.model, &trained.normalizer, &trained.weights, config.backend)
                .unwrap();
        let fresh = demonstrations(100, 12, 5);
        let pairs: Vec<[f64; 2]> = recogniser
            .recognise(&fresh)
            .iter()
            .zip(&fresh)
            .map(|(p, d)| [p.mean[0], TwoWays.factors(&d.motion)[0].value])
            .collect();
        let sum = |of: &dyn Fn(&[f64; 2]) -> f64| pairs.iter().map(of).sum::<f64>();
        let both = sum(&|[h, bulge]| h * bulge);
        let correlation = both / (sum(&|[h, _]| h * h) * sum(&|[_, bulge]| bulge * bulge)).sqrt();
        assert!(correlation > 0.85, "{correlation}");
    }

    #[test]
    fn the_epoch_that_hits_most_is_kept_among_those_that_may_be() {
        let selection = |samples, min_active_latents, patience| SelectionConfig {
            samples,
            threshold: 0.2,
            min_active_latents,
            patience,
        };
        // A prior that is learned in the end changes nothing of the choice.
        let network =
            NetworkConfig { task_baseline: true, prior_components: 2, ..config().network };
        let config = TrainingConfig { epochs: 12, network, ..config() };
        let with = |selection| run(&TrainingConfig { selection, ..config.clone() }, None);
        let (last, all) = with(selection(0, 0, 0));
        assert_eq!(last.selected_epoch, None);

        let (kept, checkpoints) = with(selection(4, 0, 0));
        let shares: Vec<f64> = checkpoints
            .iter()
            .map(|c| c.report.as_ref().unwrap().robust_and_valid.unwrap())
            .collect();
        let epoch = kept.selected_epoch.unwrap();
        // Alpha grows over two epochs; before, none may be kept.
        assert!(epoch >= 2 && shares[1..].iter().all(|s| *s <= shares[epoch - 1]), "{shares:?}");
        assert!(shares.iter().any(|s| *s > 0.0), "{shares:?}");
        // Choosing changes nothing of the training.
        assert_eq!(checkpoints[11].model, all[11].model);

        // A model with more active latents than it has is never kept; the last one is.
        let (none, _) = with(selection(4, 5, 1));
        assert_eq!((none.selected_epoch, none.weights), (None, last.weights));

        let (_, stopped) = with(selection(4, 0, 2));
        let best = stopped.last().unwrap().best.as_ref().unwrap().epoch;
        assert!(stopped.len() == best + 2 || stopped.len() == 12, "{} {best}", stopped.len());
    }

    #[test]
    fn anchors_that_can_not_be_are_refused() {
        let refusal = |anchors: &[&str]| {
            let anchors = anchors.iter().map(|a| a.to_string()).collect();
            let manner = MannerConfig { anchors, anchor_strength: 1.0 };
            let config = TrainingConfig { manner, ..config() };
            let stop = AtomicBool::new(false);
            train(&config, &TwoWays, &data(), None, &stop, &mut |_| ()).unwrap_err().to_string()
        };
        assert_eq!(
            refusal(&["speed"]),
            "the task measures no factor speed for manner.anchors; it measures bulge"
        );
        assert_eq!(
            refusal(&["bulge"; 5]),
            "5 manner.anchors for 4 network.latents; at most one for each"
        );
    }

    #[test]
    fn both_backends_train_alike() {
        for &backend in Backend::ALL {
            let config = TrainingConfig { backend, epochs: 2, ..config() };
            let (trained, _) = run(&config, None);
            let (reference, _) = run(&TrainingConfig { epochs: 2, ..self::config() }, None);
            for (name, tensor) in &trained.weights {
                for (a, b) in tensor.values.iter().zip(&reference.weights[name].values) {
                    assert!((a - b).abs() < 1e-4, "{backend}: {name}: {a} {b}");
                }
            }
        }
    }

    #[test]
    fn a_training_that_diverges_says_so() {
        // Finite, but not as an f32.
        let config = TrainingConfig { beta: 1e300, ..config() };
        let stop = AtomicBool::new(false);
        let error = train(&config, &TwoWays, &data(), None, &stop, &mut |_| ()).unwrap_err();
        assert!(matches!(error, TrainingError::Diverged { epoch: 1, .. }), "{error}");
    }

    #[test]
    fn too_few_demonstrations_are_refused() {
        let data = Splits { validation: Vec::new(), ..data() };
        let stop = AtomicBool::new(false);
        let error = train(&config(), &TwoWays, &data, None, &stop, &mut |_| ()).unwrap_err();
        assert_eq!(error.to_string(), "0 demonstrations for validation; at least 2 are needed");
    }

    #[test]
    fn counts_survive_as_tensor_values() {
        for count in [0, 1, 0xff_ffff, 0x100_0000, 12_345_678_901] {
            assert_eq!(join_count(&split_count(count)), count);
        }
    }
}
