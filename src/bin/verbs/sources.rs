//! Where demonstrations come from: the robot, the task, and the recordings that a verb is given.

use std::collections::{BTreeMap, HashSet};
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use clap::Args;
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use rayon::prelude::*;
use sha2::{Digest, Sha256};

use tcvae::artifact::DataSource;
use tcvae::config::{self, ConfigError, LoadedRobot};
use tcvae::demonstrations::augmentation::AugmentationReport;
use tcvae::demonstrations::manipulation::{ManipulationTask, Segment};
use tcvae::demonstrations::quality::Quality;
use tcvae::demonstrations::recording::{CutAt, Exclusion, GripperSource, JointRecording, Reason};
use tcvae::demonstrations::{Demonstration, Splits, TaskConfig, pouring};
use tcvae::kinematics::RobotRecord;
use tcvae::kinematics::following::{FollowOptions, follow};
use tcvae::trajectory::Motion;
use tcvae::{dataset, urdf};

use super::UsageError;
use super::recorded::Recorded;

/// The robot of a TOML file, with arms that fit its chain; Baxter without one.
pub(crate) fn load_robot(path: Option<&Path>) -> anyhow::Result<LoadedRobot> {
    let robot = config::robot(path, urdf::arm).map_err(usage)?;
    let dof = robot.chain.dof();
    for arm in robot.config.arms() {
        let (joints, signs) = (arm.joints.len(), arm.mirror_signs.as_ref().map_or(dof, Vec::len));
        if joints != dof || signs != dof {
            let (robot, arm) = (&robot.config.name, &arm.name);
            return Err(UsageError(format!(
                "robot {robot}: the {arm} arm has {joints} joints and {signs} mirror_signs; {dof} \
                 of each are needed"
            ))
            .into());
        }
        let GripperSource { closed, open, .. } = arm.gripper_source;
        if !(closed.is_finite() && open.is_finite() && closed != open) {
            let (robot, arm) = (&robot.config.name, &arm.name);
            return Err(UsageError(format!(
                "robot {robot}: the {arm} arm's gripper_source is closed at {closed} and open at \
                 {open}; two finite values that differ are needed"
            ))
            .into());
        }
    }
    Ok(robot)
}

/// The task of a TOML file; pouring without one.
pub(crate) fn load_task(path: Option<&Path>) -> anyhow::Result<TaskConfig> {
    match path {
        Some(path) => {
            let task = config::task(path).map_err(usage)?;
            task.check().map_err(|e| UsageError(format!("{}: {e}", path.display())))?;
            Ok(task)
        }
        None => Ok(TaskConfig::Manipulation(pouring::task())),
    }
}

/// What is wrong with a file that somebody wrote is wrong usage.
fn usage(error: ConfigError) -> UsageError {
    UsageError(error.to_string())
}

/// Recordings, and which of them to use.
#[derive(Debug, Default, Args)]
pub(crate) struct Recordings {
    /// Bags (.mcap and .bag files, folders of rosbag2) and folders of demonstrations in the layout of MIME, or
    /// folders of these; for training also a data set that `tcvae simulate arcs` wrote
    #[arg(required = true, value_name = "RECORDINGS")]
    pub(crate) paths: Vec<PathBuf>,
    /// The robot that was recorded; Baxter without it
    #[arg(long, value_name = "F.toml")]
    pub(crate) robot: Option<PathBuf>,
    /// The task that was shown; pouring without it
    #[arg(long, value_name = "F.toml")]
    pub(crate) task: Option<PathBuf>,
    /// Use only these demonstrations: numbers as `inspect` shows them, or ids, with commas
    #[arg(long, value_name = "3,7", value_delimiter = ',')]
    pub(crate) only: Vec<String>,
    /// Leave these demonstrations out
    #[arg(long, value_name = "3,7", value_delimiter = ',', conflicts_with = "only")]
    pub(crate) exclude: Vec<String>,
}

/// What a recording turned out to be.
#[derive(Debug, Clone)]
pub(crate) struct Examined {
    /// Name of the recording.
    pub(crate) id: String,
    /// Time from the first frame to the last; 0 where it can't be read.
    pub(crate) duration_secs: f64,
    /// Frames per second; 0 where it can't be read.
    pub(crate) rate_hz: f64,
    /// Lines, or messages and values, that were skipped.
    pub(crate) skipped: usize,
    /// What is damaged of it.
    pub(crate) damage: Vec<String>,
    /// SHA-256 over what was read; empty where they can't be read.
    pub(crate) digest: String,
    /// What is notable about it; none where it can't be read.
    pub(crate) quality: Option<Quality>,
    /// The demonstration, or why there is none.
    pub(crate) outcome: Result<(Segment, Demonstration), Exclusion>,
}

impl Examined {
    fn unreadable(id: String, reason: String) -> Self {
        Self {
            id,
            duration_secs: 0.0,
            rate_hz: 0.0,
            skipped: 0,
            damage: Vec::new(),
            digest: String::new(),
            quality: None,
            outcome: Err(Exclusion::new(Reason::Unreadable, reason)),
        }
    }
}

/// Recordings that were looked at, with what they were looked at for.
#[derive(Debug)]
pub(crate) struct Examination {
    pub(crate) robot: LoadedRobot,
    pub(crate) task: ManipulationTask,
    pub(crate) recordings: Vec<Examined>,
    /// Whether a simulator's truth lies beside any of the recordings.
    pub(crate) synthetic: bool,
}

impl Recordings {
    /// Reads all recordings and finds the demonstrations in them.
    pub(crate) fn examine(&self) -> anyhow::Result<Examination> {
        self.examine_for(load_task(self.task.as_deref())?)
    }

    fn examine_for(&self, task: TaskConfig) -> anyhow::Result<Examination> {
        let robot = load_robot(self.robot.as_deref())?;
        let task = match task {
            TaskConfig::Manipulation(task) => task,
            other => {
                let name = other.task().name();
                let reason = format!("the task {name} has no demonstrations in recordings");
                return Err(UsageError(reason).into());
            }
        };
        let mut found = Vec::new();
        for path in &self.paths {
            found.extend(Recorded::find(path)?);
        }
        // A link, or a path given twice, leads to what was found already.
        let mut seen = HashSet::new();
        found.retain(|recorded| seen.insert(recorded.place()));
        let synthetic = found.iter().any(|r| r.has_beside(super::simulate::TRUTH_FILE));
        let mut channels = robot.config.channels();
        channels.points = task.locations.iter().filter_map(|l| l.topic.clone()).collect();
        if let CutAt::Marker(topic) = &task.recording.cut_at {
            channels.marker = Some(topic.clone());
        }
        let examine = |(recorded, id): (&Recorded, String)| {
            let mut read = match recorded.read(&channels) {
                Ok(read) => read,
                Err(reason) => return vec![Examined::unreadable(id, reason)],
            };
            read.recording.id = id;
            let pieces = match recorded.may_hold_several() {
                true => read.recording.cut(&task.recording),
                false => vec![read.recording],
            };
            let examine = |(number, piece): (usize, JointRecording)| Examined {
                duration_secs: piece.duration_secs(),
                rate_hz: piece.rate_hz(),
                // Told once, where it is not known which piece lacks it.
                skipped: if number == 0 { read.skipped } else { 0 },
                damage: read.damage.clone(),
                digest: read.digest.clone(),
                quality: Some(task.quality(&piece, &robot.config, &robot.chain)),
                outcome: task.demonstration(&piece, &robot.config, &robot.chain),
                id: piece.id,
            };
            pieces.into_iter().enumerate().map(examine).collect()
        };
        let ids = ids(&found);
        let work: Vec<_> = found.iter().zip(ids).collect();
        let mut recordings: Vec<Examined> = work.into_par_iter().flat_map(examine).collect();
        for number in self.left_out_by_user(&recordings)? {
            let reason = "left out on the command line";
            recordings[number].outcome = Err(Exclusion::new(Reason::User, reason));
        }
        Ok(Examination { robot, task, recordings, synthetic })
    }

    /// The demonstrations, split, to train or to evaluate on: those of a data set that `tcvae
    /// simulate arcs` wrote, or those in recordings, for `task` where it is given; these multiplied
    /// where `copies` are asked for.
    pub(crate) fn data(&self, task: Option<&TaskConfig>, copies: Copies) -> anyhow::Result<Data> {
        match self.paths.as_slice() {
            [path] if dataset::is_data_set(path) => {
                let dataset::DataSet { task, splits, digest } = dataset::load(path)?;
                let summary = format!("{}: a data set of simulated arcs", path.display());
                let source = DataSource::Synthetic;
                Ok(Data { task, splits, digest, source, robot: None, summary })
            }
            paths => {
                if let Some(path) = paths.iter().find(|path| dataset::is_data_set(path)) {
                    let path = path.display();
                    return Err(UsageError(format!("{path} is a data set; name it alone")).into());
                }
                let task = match task {
                    Some(task) => task.clone(),
                    None => load_task(self.task.as_deref())?,
                };
                Ok(self.examine_for(task)?.data(copies))
            }
        }
    }

    /// All demonstrations, neither split nor multiplied, with the digest of what was read: to test
    /// on, where others were trained on.
    pub(crate) fn demonstrations(
        &self,
        task: &TaskConfig,
    ) -> anyhow::Result<(Vec<Demonstration>, String)> {
        if let Some(path) = self.paths.iter().find(|path| !path.exists()) {
            return Err(UsageError(format!("{}: no such file or folder", path.display())).into());
        }
        match self.paths.as_slice() {
            [path] if dataset::is_data_set(path) => {
                let dataset::DataSet { splits, digest, .. } = dataset::load(path)?;
                let Splits { train, validation, test } = splits;
                Ok(([train, validation, test].concat(), digest))
            }
            _ => {
                let examination = self.examine_for(task.clone())?;
                let (demonstrations, digest) = demonstrations(examination.recordings);
                Ok((demonstrations, hex(digest)))
            }
        }
    }

    /// Which recordings are left out by `--only` or `--exclude`.
    fn left_out_by_user(&self, recordings: &[Examined]) -> Result<Vec<usize>, UsageError> {
        let place = |name: &String| {
            let by_id = recordings.iter().position(|recording| recording.id == *name);
            let by_number = || {
                let number: usize = name.parse().ok()?;
                (1..=recordings.len()).contains(&number).then(|| number - 1)
            };
            by_id.or_else(by_number).ok_or_else(|| {
                let count = recordings.len();
                UsageError(format!("no demonstration {name:?}; there are {count}, counted from 1"))
            })
        };
        let listed = |names: &[String]| names.iter().map(place).collect::<Result<HashSet<_>, _>>();
        let (only, exclude) = (listed(&self.only)?, listed(&self.exclude)?);
        let out = |i: &usize| exclude.contains(i) || !(only.is_empty() || only.contains(i));
        Ok((0..recordings.len()).filter(out).collect())
    }
}

/// Whether augmentation's copies stand beside the recorded demonstrations. What is tested on, and
/// the digest of the data, is the same with and without.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Copies {
    /// As many as the task says, for what a network is fitted to and chosen by.
    Made,
    /// None: for primitives of few parameters, which are fitted to what was recorded.
    LeftOut,
}

/// The seed of the split and of augmentation. It is not that of a training: what is held out to
/// test on must be the same for every training on the same data.
const SPLIT_SEED: u64 = 0;

/// Fewer demonstrations than this are few: what is measured on a fifth of them says little.
const FEW_DEMONSTRATIONS: usize = 50;

/// Demonstrations to train or to evaluate on.
#[derive(Debug)]
pub(crate) struct Data {
    pub(crate) task: TaskConfig,
    pub(crate) splits: Splits,
    /// SHA-256 over what was read and how it was used, in hexadecimal digits.
    pub(crate) digest: String,
    pub(crate) source: DataSource,
    /// The robot; none where states are no poses.
    pub(crate) robot: Option<RobotRecord>,
    /// What a person reads about it.
    pub(crate) summary: String,
}

impl Examination {
    /// Splits the accepted demonstrations and, where `copies` are asked for, multiplies those to
    /// train and to validate on. Copies that the arm can't follow are drawn anew.
    fn data(self, copies: Copies) -> Data {
        let summary = self.summary();
        let Self { robot, task, recordings, synthetic } = self;
        let accepted = recordings.iter().filter_map(|recording| recording.outcome.as_ref().ok());
        let postures: Vec<_> = accepted.map(|(segment, _)| segment.posture.clone()).collect();
        let (demonstrations, mut digest) = demonstrations(recordings);
        digest.update(serde_json::to_string(&task).expect("a task is JSON"));
        let mut rng = ChaCha8Rng::seed_from_u64(SPLIT_SEED);
        let few = demonstrations.len() < FEW_DEMONSTRATIONS;
        let count = demonstrations.len();
        let mut splits = Splits::random(demonstrations, &mut rng);
        let parts = [&splits.train, &splits.validation, &splits.test].map(Vec::len);
        let within_reach = |motion: &Motion, rng: &mut ChaCha8Rng| {
            let poses = task.state_frame().poses(&motion.states);
            follow(&robot.chain, &poses, motion.step_secs(), &FollowOptions::default(), rng).is_ok()
        };
        let [train, validation, test] = parts;
        let mut summary = format!(
            "{summary}\n{train} to train on, {validation} to validate on and {test} to test on"
        );
        if copies == Copies::Made {
            let AugmentationReport { made, failed, .. } =
                task.augmentation.augment(&task, &mut splits, within_reach, &mut rng);
            let [train, validation] = [&splits.train, &splits.validation].map(Vec::len);
            let _ = write!(summary, "; with {made} copies {train} and {validation}");
            if failed > 0 {
                let _ =
                    write!(summary, "; {failed} more copies found no place within the arm's reach");
            }
        }
        if few {
            let _ = write!(
                summary,
                "\nwarning: {count} demonstrations are few; with fewer than {FEW_DEMONSTRATIONS} \
                 the measured quality says little. Record more"
            );
        }
        Data {
            robot: Some(
                RobotRecord::new(&robot.config.name, &robot.chain, robot.urdf_sha256)
                    .with_postures(&postures),
            ),
            task: TaskConfig::Manipulation(task),
            splits,
            digest: hex(digest),
            source: if synthetic { DataSource::Synthetic } else { DataSource::Recorded },
            summary,
        }
    }

    /// How many recordings are demonstrations, and why the others are none.
    pub(crate) fn summary(&self) -> String {
        let counts = self.counts();
        let list = |counts: &BTreeMap<String, usize>| {
            let counts: Vec<_> = counts.iter().map(|(name, n)| format!("{n} {name}")).collect();
            counts.join(", ")
        };
        let Counts { accepted, excluded, arms } = &counts;
        let mut summary = format!("{accepted} of {} recordings accepted", self.recordings.len());
        if !arms.is_empty() {
            let _ = write!(summary, " ({})", list(arms));
        }
        if !excluded.is_empty() {
            let _ = write!(summary, "\nleft out: {}", list(excluded));
        }
        if self.synthetic {
            summary.push_str("\na truth.json lies beside the recordings: they are synthetic");
        }
        summary
    }

    /// How many recordings are what.
    pub(crate) fn counts(&self) -> Counts {
        let mut counts = Counts::default();
        for recording in &self.recordings {
            match &recording.outcome {
                Ok((segment, _)) => {
                    counts.accepted += 1;
                    *counts.arms.entry(segment.arm.clone()).or_default() += 1;
                }
                Err(e) => *counts.excluded.entry(self.task.reason_name(e.reason)).or_default() += 1,
            }
        }
        counts
    }
}

/// The demonstrations in recordings, with the digest of their files.
fn demonstrations(recordings: Vec<Examined>) -> (Vec<Demonstration>, Sha256) {
    let mut digest = Sha256::new();
    let mut demonstrations = Vec::new();
    for Examined { id, digest: of_files, outcome, .. } in recordings {
        if let Ok((_, demonstration)) = outcome {
            digest.update(format!("{id} {of_files}\n"));
            demonstrations.push(demonstration);
        }
    }
    (demonstrations, digest)
}

fn hex(digest: Sha256) -> String {
    digest.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

/// How many recordings are what.
#[derive(Debug, Default)]
pub(crate) struct Counts {
    pub(crate) accepted: usize,
    /// By reason.
    pub(crate) excluded: BTreeMap<String, usize>,
    /// Accepted ones by arm.
    pub(crate) arms: BTreeMap<String, usize>,
}

/// Names of the folders; those that stand twice with the folder above.
fn ids(found: &[Recorded]) -> Vec<String> {
    let name = |path: &Path| {
        // The name of `.` is that of the folder it stands for.
        let path = fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
        path.file_name()
            .map_or_else(|| "demonstration".into(), |n| n.to_string_lossy().into_owned())
    };
    let mut count: BTreeMap<String, usize> = BTreeMap::new();
    for recorded in found {
        *count.entry(name(recorded.path())).or_default() += 1;
    }
    let id = |recorded: &Recorded| {
        let own = name(recorded.path());
        if count[&own] > 1 { recorded.path().to_string_lossy().into_owned() } else { own }
    };
    found.iter().map(id).collect()
}
