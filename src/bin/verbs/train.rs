//! `tcvae train`: from demonstrations to a model file.

use std::collections::BTreeMap;
use std::fs::{self, File, TryLockError};
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use clap::{Args, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::json;

use tcvae::artifact::{self, Artifact, DataSource, Learned, ModelDocument, TcVaeDocument};
use tcvae::demonstrations::{Demonstration, Splits, TaskConfig};
use tcvae::kinematics::RobotRecord;
use tcvae::model::{Backend, Weights};
use tcvae::parameters::{Interval, MannerSpace, TaskLocation, TaskSpace};
use tcvae::primitives::{ClassicalConfig, DmpConfig, PrimitiveError, ProMpConfig, TpGmmConfig};
use tcvae::training::sweep::{nested, overlay};
use tcvae::training::{
    self, Checkpoint, EpochReport, MeanTerms, Outcome, Progress, Trained, TrainingConfig,
};

use super::metrics::{Metrics, MetricsLine};
use super::sources::{Copies, Data, Recordings};
use super::{ExitStatus, UsageError, evaluate, print_json, print_line};

/// Manner parameters are bounded at this many standard deviations of the prior.
const MANNER_BOUND: f64 = 3.0;
/// What a checkpoint's file says it is.
const CHECKPOINT: &str = "checkpoint";

/// A primitive that can be learned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Primitive {
    /// Task-conditioned variational autoencoder
    TcVae,
    /// Task-parameterised Gaussian mixture: no manner parameters
    TpGmm,
    /// Probabilistic movement primitive: no manner parameters
    #[value(name = "promp")]
    ProMp,
    /// Dynamic movement primitive: no manner parameters
    Dmp,
}

/// Arguments of `tcvae train`.
#[derive(Debug, Args)]
#[cfg_attr(
    all(feature = "ros", feature = "bag"),
    command(mut_arg("paths", |paths| paths.required(false).required_unless_present("live")))
)]
pub(crate) struct TrainArgs {
    #[command(flatten)]
    recordings: Recordings,
    /// Model file to write
    #[arg(short, long, value_name = "MODEL")]
    output: PathBuf,
    /// What to learn
    #[arg(long, value_enum, default_value_t = Primitive::TcVae)]
    primitive: Primitive,
    /// Settings; what the file leaves out keeps the task's preset (config/train-*.toml), or the
    /// classical primitive's default
    #[arg(long, value_name = "F.toml")]
    config: Option<PathBuf>,
    /// One setting, such as `network.width=64`, or `components=10` of a TP-GMM
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Seed of the start values, of the batches and of the noise
    #[arg(long)]
    seed: Option<u64>,
    /// Burn's backend: flex or ndarray
    #[arg(long)]
    backend: Option<Backend>,
    /// Go on from the checkpoint beside the model file
    #[arg(long)]
    resume: bool,
    /// Print the answer as JSON
    #[arg(long)]
    pub(crate) json: bool,
    #[cfg(all(feature = "ros", feature = "bag"))]
    #[command(flatten)]
    live: super::record::Live,
}

pub(crate) fn run(mut args: TrainArgs) -> anyhow::Result<ExitStatus> {
    // What can go wrong without learning anything goes wrong first.
    let copies = match args.primitive {
        Primitive::TcVae => Copies::Made,
        _ => {
            refuse_what_only_a_network_has(&args)?;
            Copies::LeftOut
        }
    };
    let files = Files::beside(&args.output)?;
    let _folder = files.claim()?;
    let live: Option<(PathBuf, Arc<AtomicBool>)> = None;
    #[cfg(all(feature = "ros", feature = "bag"))]
    let live = {
        let Recordings { robot, task, .. } = &args.recordings;
        live.or(args.live.record(&args.output, robot.as_deref(), task.as_deref())?)
    };
    args.recordings.paths.extend(live.iter().map(|(file, _)| file.clone()));
    let source = Source::load(&args.recordings, copies)?;
    let began = Instant::now();
    let mut artifact = if args.primitive == Primitive::TcVae {
        let config = network_settings(&args, source.preset())?;
        let start = args.resume.then(|| files.checkpoint(&config, &source)).transpose()?;
        let stop = live.map_or_else(stop_on_signal, |(_, stop)| Ok(stop))?;
        match learn(&files, &source, &config, start, &stop)? {
            Some(artifact) => artifact,
            None => return Ok(ExitStatus::BelowAsked),
        }
    } else {
        fit(&args, &source)?
    };
    // What was learned is kept even where it can't be measured.
    let Source { splits, digest, .. } = &source;
    evaluate::add_names(&mut artifact, splits);
    if let Err(error) = evaluate::calibrate(&mut artifact, &splits.validation) {
        eprintln!("the model is saved without a calibration of its deviations: {error}");
    }
    match evaluate::measure(&artifact, splits, digest.clone(), evaluate::DEFAULT_SEED) {
        Ok(evaluation) => artifact.document.evaluation = Some(evaluation),
        Err(error) => eprintln!("the model is saved without an evaluation: {error}"),
    }
    files.finish(&artifact)?;
    Ok(report(&artifact, &files.model, began.elapsed(), args.json))
}

/// A classical primitive is fitted in one go and draws nothing.
fn refuse_what_only_a_network_has(args: &TrainArgs) -> Result<(), UsageError> {
    let TrainArgs { primitive, seed, backend, resume, .. } = args;
    for (flag, given) in
        [("--resume", *resume), ("--seed", seed.is_some()), ("--backend", backend.is_some())]
    {
        if given {
            let primitive = primitive.to_possible_value();
            let name = primitive.as_ref().map_or("", |value| value.get_name());
            return Err(UsageError(format!(
                "{flag} is for --primitive tc-vae; a {name} is fitted at once and draws nothing, so \
                 leave it out"
            )));
        }
    }
    Ok(())
}

/// Fits a classical primitive to the recorded demonstrations.
fn fit(args: &TrainArgs, source: &Source) -> anyhow::Result<Artifact> {
    let steps = source.preset().steps;
    let config = match args.primitive {
        Primitive::TpGmm => {
            ClassicalConfig::TpGmm(settings(args, TpGmmConfig { steps, ..Default::default() })?)
        }
        Primitive::ProMp => {
            ClassicalConfig::ProMp(settings(args, ProMpConfig { steps, ..Default::default() })?)
        }
        _ => ClassicalConfig::Dmp(settings(args, DmpConfig { steps, ..Default::default() })?),
    };
    let train = &source.splits.train;
    eprintln!("fitting to {} demonstrations", train.len());
    let fitted = config.fit(&source.task_space, train).map_err(|error| match error {
        PrimitiveError::Setting { .. } => UsageError(format!("--set: {error}")).into(),
        _ => anyhow::Error::from(error),
    })?;
    source.artifact(Learned::Classical(fitted), Weights::new())
}

/// Trains a model, with a checkpoint and a line of metrics after every epoch; none where it was
/// stopped.
pub(super) fn learn(
    files: &Files,
    source: &Source,
    config: &TrainingConfig,
    start: Option<Checkpoint>,
    stop: &AtomicBool,
) -> anyhow::Result<Option<Artifact>> {
    let mut log = Log::new(files, config, source, start.as_ref())?;
    keep_memory();
    let task = source.task.task();
    let outcome = training::train(config, task, &source.splits, start, stop, &mut |progress| {
        log.show(progress);
    });
    let saved = log.finish();
    let outcome = outcome?;
    saved?;
    match outcome {
        Outcome::Stopped { epochs } => {
            let checkpoint = files.checkpoint.display();
            eprintln!(
                "stopped after epoch {epochs} of {}; {}",
                config.epochs,
                match epochs {
                    0 => "nothing to save yet".to_owned(),
                    _ => format!("saved {checkpoint}; the same command with --resume goes on"),
                }
            );
            Ok(None)
        }
        Outcome::Finished(trained) => {
            let Trained { model, normalizer, weights, latents, last_epoch, selected_epoch } =
                *trained;
            let learned = Learned::TcVae(TcVaeDocument {
                training: config.clone(),
                last_epoch,
                selected_epoch,
                manner_space: MannerSpace::unnamed(model.network.latents, MANNER_BOUND),
                latents,
                normalizer,
                model,
                deviation_scale: None,
            });
            source.artifact(learned, weights).map(Some)
        }
    }
}

/// The answer, and whether the model is worth anything.
fn report(artifact: &Artifact, path: &Path, took: Duration, json: bool) -> ExitStatus {
    let ModelDocument { learned, training_demonstrations, .. } = &artifact.document;
    let (name, model_id, seconds) = (learned.name(), artifact.model_id(), took.as_secs_f64());
    let shown = path.display();
    let Learned::TcVae(TcVaeDocument { training, last_epoch, latents, .. }) = learned else {
        if json {
            print_json(&json!({
                "model": path, "model_id": model_id, "primitive": name,
                "demonstrations": training_demonstrations, "seconds": seconds,
            }));
        } else {
            print_line(&format!(
                "{shown}: model {model_id}, a {name} of {training_demonstrations} demonstrations \
                 in {seconds:.1} s"
            ));
        }
        return ExitStatus::Done;
    };
    let active = latents.iter().filter(|l| l.kl > MeanTerms::ACTIVE_KL).count();
    // Fewer than asked for, where the training stopped early.
    let epochs = last_epoch.as_ref().map_or(0, |last| last.epoch);
    if json {
        print_json(&json!({
            "model": path, "model_id": model_id, "primitive": name, "epochs": epochs,
            "seed": training.seed, "active_latents": active,
            "kl": latents.iter().map(|l| l.kl).collect::<Vec<_>>(),
            "seconds": seconds,
        }));
    } else {
        print_line(&format!(
            "{shown}: model {model_id}, {active} of {} latents active, {epochs} epochs in \
             {seconds:.0} s",
            latents.len(),
        ));
    }
    if active == 0 {
        eprintln!(
            "the model has collapsed: no latent is active (mean KL above {} nat), so every manner \
             gives the same motion; lower beta (now {}) or raise alpha more slowly",
            MeanTerms::ACTIVE_KL,
            training.beta
        );
        return ExitStatus::BelowAsked;
    }
    ExitStatus::Done
}

/// The settings of a TC-VAE's training; what has a flag of its own counts most.
fn network_settings(args: &TrainArgs, preset: TrainingConfig) -> anyhow::Result<TrainingConfig> {
    let mut config = settings(args, preset)?;
    config.seed = args.seed.unwrap_or(config.seed);
    config.backend = args.backend.unwrap_or(config.backend);
    config.check().map_err(|e| UsageError(e.to_string()))?;
    Ok(config)
}

/// The preset, the file's settings over it, and the command line's over those.
fn settings<C: Serialize + DeserializeOwned>(args: &TrainArgs, preset: C) -> anyhow::Result<C> {
    let usage = |message: String| anyhow::Error::from(UsageError(message));
    let mut table = toml::Table::try_from(preset).expect("settings are TOML");
    if let Some(path) = &args.config {
        let of_file = |e: &dyn std::fmt::Display| usage(format!("{}: {e}", path.display()));
        let text = fs::read_to_string(path).map_err(|e| of_file(&e))?;
        let file: toml::Table = text.parse().map_err(|e| of_file(&e))?;
        // By itself first, so that what is wrong is shown with its line.
        toml::from_str::<C>(&text).map_err(|e| of_file(&e))?;
        overlay(&mut table, file);
    }
    for setting in &args.set {
        let Some((key, value)) = setting.split_once('=') else {
            return Err(usage(format!("--set {setting}: write it as KEY=VALUE")));
        };
        overlay(&mut table, nested(key.trim(), self::value(value.trim())));
    }
    table.try_into().map_err(|e: toml::de::Error| usage(format!("--set: {}", e.message())))
}

/// The value as TOML; what is none is a string.
fn value(text: &str) -> toml::Value {
    let parsed = format!("value = {text}").parse::<toml::Table>().ok();
    let parsed = parsed.and_then(|mut table| table.remove("value"));
    parsed.unwrap_or_else(|| toml::Value::String(text.into()))
}

/// Demonstrations, and what the model file says of them.
pub(super) struct Source {
    task: TaskConfig,
    pub(super) splits: Splits,
    pub(super) digest: String,
    data_source: DataSource,
    task_space: TaskSpace,
    state_names: Vec<String>,
    state_reference_xyzw: Option<[f64; 4]>,
    robot: Option<RobotRecord>,
}

impl Source {
    pub(super) fn load(recordings: &Recordings, copies: Copies) -> anyhow::Result<Self> {
        let Data { task, splits, digest, source, robot, summary } =
            recordings.data(None, copies)?;
        eprintln!("{summary}");
        let (space, state_names) = (task.task().task_space(), task.state_names());
        let reference = task.state_frame().map(|frame| frame.reference);
        Ok(Self {
            task_space: trained_region(&space, &splits.train),
            task,
            splits,
            digest,
            data_source: source,
            state_names,
            state_reference_xyzw: reference.map(|q| [q.i, q.j, q.k, q.w]),
            robot,
        })
    }

    fn preset(&self) -> TrainingConfig {
        match &self.task {
            TaskConfig::Manipulation(task) => TrainingConfig::of_arm(&task.manner),
            _ => TrainingConfig::default(),
        }
    }

    fn artifact(&self, learned: Learned, weights: Weights) -> anyhow::Result<Artifact> {
        let train = &self.splits.train;
        let tasks: Vec<_> = train.iter().map(|d| d.w.values().to_vec()).collect();
        let document = ModelDocument {
            learned,
            git_revision: env!("TCVAE_GIT_REVISION").into(),
            data_digest: self.digest.clone(),
            data_source: self.data_source,
            training_demonstrations: train.len(),
            task_space: self.task_space.clone(),
            state_names: self.state_names.clone(),
            duration_secs: median_duration_secs(train),
            state_reference_xyzw: self.state_reference_xyzw,
            task: self.task.clone(),
            robot: self.robot.clone(),
            evaluation: None,
        };
        Ok(Artifact::new(document, weights, &tasks)?)
    }
}

/// The space with the box around the tasks that were trained on as its intervals.
fn trained_region(space: &TaskSpace, demonstrations: &[Demonstration]) -> TaskSpace {
    let around = |value: usize, otherwise: Interval| {
        let values = || demonstrations.iter().map(|d| d.w.values()[value]);
        match demonstrations {
            [] => otherwise,
            _ => Interval {
                lower: values().fold(f64::INFINITY, f64::min),
                upper: values().fold(f64::NEG_INFINITY, f64::max),
            },
        }
    };
    let location = |(i, location): (usize, &TaskLocation)| TaskLocation {
        name: location.name.clone(),
        x: around(2 * i, location.x),
        y: around(2 * i + 1, location.y),
    };
    let locations = space.locations().iter().enumerate().map(location).collect();
    TaskSpace::new(space.unit.clone(), locations).expect("the names are the space's")
}

fn median_duration_secs(demonstrations: &[Demonstration]) -> f64 {
    let mut durations: Vec<_> = demonstrations.iter().map(|d| d.motion.duration_secs).collect();
    durations.sort_by(f64::total_cmp);
    durations[durations.len() / 2]
}

/// The files of a training, all in one folder.
pub(super) struct Files {
    pub(super) model: PathBuf,
    checkpoint: PathBuf,
    metrics: PathBuf,
}

/// What a checkpoint's file says beside its tensors.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CheckpointDocument {
    training: TrainingConfig,
    data_digest: String,
    report: Option<EpochReport>,
}

impl Files {
    pub(super) fn beside(model: &Path) -> anyhow::Result<Self> {
        if model.is_dir() || model.file_name().is_none() {
            let path = model.display();
            return Err(UsageError(format!("-o {path} is a folder; name a file in it")).into());
        }
        Ok(Self {
            model: model.to_owned(),
            checkpoint: model.with_extension("checkpoint.safetensors"),
            metrics: model.with_extension("metrics.jsonl"),
        })
    }

    /// Makes the folder, checks that it can be written to, and keeps other trainings out of it for
    /// as long as the answer lives.
    pub(super) fn claim(&self) -> anyhow::Result<File> {
        let folder = artifact::folder_of(&self.model);
        let at = || folder.display().to_string();
        fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", at()))?;
        let lock = File::open(folder).with_context(at)?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => bail!(
                "another training is writing into {}; wait for it, or choose another folder",
                at()
            ),
            Err(TryLockError::Error(e)) => return Err(e).with_context(at),
        }
        tempfile::NamedTempFile::new_in(folder)
            .with_context(|| format!("cannot write into the folder {}", at()))?;
        Ok(lock)
    }

    /// The checkpoint, if it is one of this training.
    pub(super) fn checkpoint(
        &self,
        config: &TrainingConfig,
        source: &Source,
    ) -> anyhow::Result<Checkpoint> {
        let path = self.checkpoint.display();
        if !self.checkpoint.exists() {
            return Err(UsageError(format!("--resume: there is no checkpoint {path}")).into());
        }
        let bytes = artifact::read(&self.checkpoint)?;
        let (document, tensors): (CheckpointDocument, _) =
            artifact::decode(&bytes, CHECKPOINT).with_context(|| path.to_string())?;
        let CheckpointDocument { training, data_digest, report } = document;
        if data_digest != source.digest {
            bail!("--resume: {path} was trained on other data ({data_digest:.12})");
        }
        if let Some(key) = first_difference(&training, config) {
            let message = format!("--resume: {path} was trained with another {key}");
            return Err(UsageError(message).into());
        }
        let first = &source.splits.train.first().context("no demonstrations to train on")?;
        let model = config.model(first.motion.states.dim(), first.w.values().len());
        Ok(Checkpoint::from_weights(config, &model, &tensors, report)?)
    }

    /// Writes the whole model; there is nothing left to resume.
    pub(super) fn finish(&self, artifact: &Artifact) -> anyhow::Result<()> {
        artifact.save(&self.model)?;
        let _ = fs::remove_file(&self.checkpoint);
        Ok(())
    }

    fn save(&self, checkpoint: &Checkpoint, document: &CheckpointDocument) -> anyhow::Result<()> {
        let bytes = artifact::encode(&checkpoint.to_weights(), CHECKPOINT, document);
        Ok(artifact::write(&self.checkpoint, &bytes)?)
    }
}

/// The first setting in which two configurations differ.
fn first_difference(a: &TrainingConfig, b: &TrainingConfig) -> Option<String> {
    let flat = |config: &TrainingConfig| {
        let table = toml::Table::try_from(config).expect("settings are TOML");
        let mut flat = BTreeMap::new();
        for (key, value) in table {
            match value {
                toml::Value::Table(inner) => {
                    flat.extend(inner.into_iter().map(|(k, v)| (format!("{key}.{k}"), v)));
                }
                value => {
                    flat.insert(key, value);
                }
            }
        }
        flat
    };
    let (a, b) = (flat(a), flat(b));
    let differs = |key: &&String| a.get(*key) != b.get(*key);
    a.keys().chain(b.keys()).find(differs).cloned()
}

/// What is shown and written while a training runs.
struct Log<'a> {
    files: &'a Files,
    config: &'a TrainingConfig,
    digest: &'a str,
    metrics: Metrics,
    bar: Option<ProgressBar>,
    epoch_began: Instant,
    /// The first thing that could not be written; later ones follow from it.
    failure: Option<anyhow::Error>,
}

impl<'a> Log<'a> {
    fn new(
        files: &'a Files,
        config: &'a TrainingConfig,
        source: &'a Source,
        start: Option<&Checkpoint>,
    ) -> anyhow::Result<Self> {
        // Of a training that goes on, the epochs that its checkpoint knows of.
        let done = start.map_or(0, |s| s.epochs);
        let metrics = Metrics::keeping(&files.metrics, done)?;
        let Splits { train, validation, .. } = &source.splits;
        let from = if done > 0 { format!(", from epoch {}", done + 1) } else { String::new() };
        eprintln!(
            "training on {} demonstrations, {} to validate on; {} epochs{from}; seed {}; {}",
            train.len(),
            validation.len(),
            config.epochs,
            config.seed,
            config.backend
        );
        let bar = std::io::stderr().is_terminal().then(|| {
            let style = ProgressStyle::with_template("{bar:30} {percent:>3} % {eta:>5}  {msg}");
            ProgressBar::new(0).with_style(style.expect("the template is one"))
        });
        let digest = source.digest.as_str();
        let epoch_began = Instant::now();
        Ok(Self { files, config, digest, metrics, bar, epoch_began, failure: None })
    }

    fn show(&mut self, progress: Progress<'_>) {
        match progress {
            Progress::Batch { done, total } => {
                if let Some(bar) = &self.bar {
                    bar.set_length(total as u64);
                    // Batches that a checkpoint brought along say nothing of the speed.
                    if bar.position() == 0 && done > 1 {
                        bar.set_position(done as u64 - 1);
                        bar.reset_eta();
                    }
                    bar.set_position(done as u64);
                }
            }
            Progress::Epoch { report, checkpoint } => {
                let seconds = self.epoch_began.elapsed().as_secs_f64();
                self.epoch_began = Instant::now();
                let line = epoch_line(report, self.config.epochs, seconds);
                match &self.bar {
                    Some(bar) => bar.set_message(line),
                    None => eprintln!("{line}"),
                }
                if let Err(error) = self.write(report, checkpoint, seconds) {
                    self.failure.get_or_insert(error);
                }
            }
            _ => {}
        }
    }

    fn write(
        &mut self,
        report: &EpochReport,
        checkpoint: &Checkpoint,
        seconds: f64,
    ) -> anyhow::Result<()> {
        let active_latents = report.validation.active_latents();
        let line = MetricsLine { report: report.clone(), active_latents, seconds };
        self.metrics.add(&line)?;
        let document = CheckpointDocument {
            training: self.config.clone(),
            data_digest: self.digest.into(),
            report: Some(report.clone()),
        };
        self.files.save(checkpoint, &document)
    }

    /// Ends the display; what could not be written on the way is an error now.
    fn finish(self) -> anyhow::Result<()> {
        if let Some(bar) = &self.bar {
            bar.abandon();
        }
        self.failure.map_or(Ok(()), Err)
    }
}

/// An epoch as a person reads it.
fn epoch_line(report: &EpochReport, epochs: usize, seconds: f64) -> String {
    let EpochReport { epoch, validation, robust_and_valid, .. } = report;
    let MeanTerms { negative_log_likelihood, kl, adversary, anchors } = validation;
    let listed =
        |values: &[f64]| values.iter().map(|v| format!("{v:.2}")).collect::<Vec<_>>().join(" ");
    let anchors = match anchors.as_slice() {
        [] => String::new(),
        squared => format!(", from anchors {}", listed(squared)),
    };
    let selected = match robust_and_valid {
        Some(share) => format!(", robust and valid {share:.3}"),
        None => String::new(),
    };
    format!(
        "epoch {epoch}/{epochs}: validation nll {negative_log_likelihood:.1}, kl {}, adversary \
         {adversary:.2}{anchors}{selected}; {seconds:.1} s",
        listed(kl)
    )
}

/// A flag that the first Ctrl-C or SIGTERM sets; the second ends the program at once.
pub(super) fn stop_on_signal() -> anyhow::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = stop.clone();
    ctrlc::set_handler(move || {
        if flag.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
    })?;
    Ok(stop)
}

/// Keeps freed blocks with the process. A training step frees and takes megabytes; by default
/// glibc gives them back to the kernel each time, and the page faults cost more than the products.
fn keep_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        const KEPT: libc::c_int = 1 << 30;
        // More is refused by older versions of glibc.
        const MAPPED: libc::c_int = 32 << 20;
        const AHEAD: libc::c_int = 64 << 20;
        #[expect(
            unsafe_code,
            reason = "mallopt has no safe binding; it only sets allocator limits"
        )]
        // SAFETY: mallopt takes plain numbers, and glibc guards its settings by its own lock.
        unsafe {
            libc::mallopt(libc::M_MMAP_THRESHOLD, MAPPED);
            libc::mallopt(libc::M_TRIM_THRESHOLD, KEPT);
            libc::mallopt(libc::M_TOP_PAD, AHEAD);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn args(set: &[&str]) -> TrainArgs {
        TrainArgs {
            recordings: Recordings::default(),
            output: "model.safetensors".into(),
            primitive: Primitive::TcVae,
            config: None,
            set: set.iter().map(|s| s.to_string()).collect(),
            seed: None,
            backend: None,
            resume: false,
            json: false,
            #[cfg(all(feature = "ros", feature = "bag"))]
            live: Default::default(),
        }
    }

    #[test]
    fn settings_lie_over_the_file_and_the_file_over_the_preset() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("settings.toml");
        fs::write(&file, "epochs = 3\nbatch = 32\n[network]\nwidth = 16\n").unwrap();
        let args = TrainArgs {
            config: Some(file),
            seed: Some(5),
            ..args(&["epochs=4", "network.activation=relu", "beta=2"])
        };
        let config = network_settings(&args, TrainingConfig::of_arm(&[])).unwrap();
        let preset = TrainingConfig::of_arm(&[]);
        let network = tcvae::model::NetworkConfig {
            width: 16,
            activation: tcvae::model::Activation::Relu,
            ..preset.network
        };
        let expected =
            TrainingConfig { epochs: 4, batch: 32, seed: 5, beta: 2.0, network, ..preset };
        assert_eq!(config, expected);
    }

    #[test]
    fn what_is_no_setting_is_wrong_usage() {
        for set in ["epoch=3", "network.depth=3", "epochs=many", "epochs", "batch=0"] {
            let error = network_settings(&args(&[set]), TrainingConfig::default()).unwrap_err();
            assert_eq!(ExitStatus::of(&error), ExitStatus::WrongUsage, "{set}: {error}");
        }
    }

    #[test]
    fn the_setting_that_differs_is_named() {
        let a = TrainingConfig::default();
        let mut b = a.clone();
        assert_eq!(first_difference(&a, &b), None);
        b.network.width = 64;
        assert_eq!(first_difference(&a, &b).unwrap(), "network.width");
        // What is not written unless it is set counts too.
        b = a.clone();
        b.network.margins = true;
        assert_eq!(first_difference(&a, &b).unwrap(), "network.margins");
    }
}
