//! The model file: everything that serving, evaluating and repeating need, in one safetensors file.
//!
//! The tensors are `training.tasks`, the tasks that were trained on, and of a TC-VAE the weights
//! ([`crate::model::Layout`] names them) and the baseline where it has one. The metadata holds one
//! key, `tcvae`, with a JSON document, which also holds all of a classical primitive:
//!
//! ```json
//! { "kind": "model", "format_version": 3,
//!   "tensors_sha256": "…", "document_sha256": "…",
//!   "document": { "learned": { "tc-vae": { … } }, … } }
//! ```
//!
//! Both digests are checked on loading, so that a damaged or edited file is refused and nothing is
//! guessed. A file is written beside its place and then renamed, so that no reader sees half of it.
//! There are no dates in it: the same training gives the same bytes.

use std::collections::HashMap;
use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use nalgebra::{Quaternion, UnitQuaternion};
use safetensors::tensor::{Dtype, TensorView};
use safetensors::{SafeTensors, serialize};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::value::{RawValue, to_raw_value};
use sha2::{Digest, Sha256};

use crate::demonstrations::TaskConfig;
use crate::evaluation::ModelEvaluation;
use crate::kinematics::RobotRecord;
use crate::model::{ModelConfig, ModelError, NamedTensor, Normalizer, TcVaePrimitive, Weights};
use crate::parameters::{MannerSpace, TaskSpace};
use crate::pose::{DeviationScale, STATE_NAMES, StateFrame};
use crate::primitive::MannerConditioned;
use crate::primitives::Classical;
use crate::serving::{Familiarity, ServedModel};
use crate::training::{EpochReport, LatentStatistics, TrainingConfig};

/// The format that this program reads and writes.
pub const FORMAT_VERSION: u32 = 3;

/// The metadata key of the document.
const KEY: &str = "tcvae";
/// The tasks that were trained on, `[demonstrations, task_dim]`, in the task's units.
const TASKS: &str = "training.tasks";
/// Training tasks that a server compares a task with, at most: finding how far out each of them
/// lies takes time that grows with the square of their number.
const MOST_TASKS: usize = 1000;
/// Larger files are no models of ours.
const MAX_BYTES: u64 = 256 << 20;

/// Why a file is not one that can be served.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ArtifactError {
    /// The operating system refused.
    #[error("{action} {}: {source}", path.display())]
    Io {
        /// What was tried.
        action: &'static str,
        /// On which file.
        path: PathBuf,
        /// Its answer.
        source: io::Error,
    },
    /// The file is larger than any model.
    #[error("the file has {bytes} bytes; a model has at most {MAX_BYTES}")]
    TooLarge {
        /// Its size.
        bytes: u64,
    },
    /// The file is no safetensors file, or not all of one.
    #[error("the file is damaged: {detail}; copy it again, or train anew")]
    Damaged {
        /// What is wrong.
        detail: String,
    },
    /// A safetensors file that is not ours.
    #[error("the file is no {expected} of this program: {detail}")]
    Foreign {
        /// `model` or `checkpoint`.
        expected: &'static str,
        /// What is missing.
        detail: String,
    },
    /// The file is from a newer program, or from an older one.
    #[error(
        "the file has format version {found}; this program reads version {FORMAT_VERSION}; {}",
        if *found > FORMAT_VERSION { "update it" } else { "train again" }
    )]
    Version {
        /// The file's version.
        found: u32,
    },
    /// The content is not what was written.
    #[error(
        "the {part} are not what was written: their SHA-256 is {found}, and {expected} is stored; \
         the file was edited or damaged"
    )]
    Digest {
        /// `tensors` or `metadata`.
        part: &'static str,
        /// The digest of what was read.
        found: String,
        /// The digest that is stored.
        expected: String,
    },
    /// The document says something that this version does not know.
    #[error("the file's document can't be read: {detail}")]
    Document {
        /// What is wrong.
        detail: String,
    },
    /// A model whose states are no poses of a robot's tip.
    #[error(
        "the model's states ({states}) are no poses of a robot's tip, so there is nothing to send \
         to an arm; tcvae sample prints its states"
    )]
    NoRobot {
        /// Names of the state's values, comma-separated.
        states: String,
    },
    /// The parts are not a model.
    #[error(transparent)]
    Model(#[from] ModelError),
}

/// Where demonstrations came from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DataSource {
    /// Simulated by this program.
    Synthetic,
    /// Recorded on a robot.
    Recorded,
}

/// What a TC-VAE is beside its tensors, and how it came about.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TcVaeDocument {
    /// The shape of the networks.
    pub model: ModelConfig,
    /// The settings of the training, its seed among them.
    pub training: TrainingConfig,
    /// The last epoch.
    pub last_epoch: Option<EpochReport>,
    /// The epoch whose model this is; the last one where none is named.
    #[serde(default)]
    pub selected_epoch: Option<usize>,
    /// What h means, and what each of its values does.
    pub manner_space: MannerSpace,
    /// Posteriors of the validation set, one entry for each latent.
    pub latents: Vec<LatentStatistics>,
    /// Offsets and scales.
    pub normalizer: Normalizer,
    /// What makes the decoder's deviations fit the validation part; none where states are no poses, and of
    /// files that were written before it was measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub deviation_scale: Option<DeviationScale>,
}

/// What was learned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[expect(clippy::large_enum_variant, reason = "a program has one or two of them")]
pub enum Learned {
    /// A TC-VAE, whose weights are tensors.
    TcVae(TcVaeDocument),
    /// A classical primitive, all of it.
    Classical(Classical),
}

impl Learned {
    /// The primitive's name, as people write it.
    pub fn name(&self) -> &'static str {
        match self {
            Self::TcVae(_) => "TC-VAE",
            Self::Classical(classical) => classical.name(),
        }
    }
}

/// All that a model file says beside its tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelDocument {
    /// Which primitive this is, and what it learned.
    pub learned: Learned,
    /// Revision of the program's sources.
    pub git_revision: String,
    /// SHA-256 over the data that was trained on.
    pub data_digest: String,
    /// Where that data came from.
    pub data_source: DataSource,
    /// Demonstrations that were trained on.
    pub training_demonstrations: usize,
    /// What w means, with the region that was trained.
    pub task_space: TaskSpace,
    /// Names of the state's values.
    pub state_names: Vec<String>,
    /// Median duration of the demonstrations, at which motions are served whose model knows phases
    /// only.
    pub duration_secs: f64,
    /// Orientation of the tip whose rotation vector is 0, as a unit quaternion (x, y, z, w); none
    /// where states are no poses.
    pub state_reference_xyzw: Option<[f64; 4]>,
    /// The task, and how it measures motions.
    pub task: TaskConfig,
    /// The robot; none where states are no poses.
    pub robot: Option<RobotRecord>,
    /// The measured quality.
    pub evaluation: Option<ModelEvaluation>,
}

/// A model file's content.
#[derive(Debug, Clone, PartialEq)]
pub struct Artifact {
    /// The document.
    pub document: ModelDocument,
    /// The tasks that were trained on; the weights and the baseline, if any.
    tensors: Weights,
}

impl Artifact {
    /// A model with the tasks that it was trained on, in the order of the task space. Those of a
    /// classical primitive are its only tensor, so it has no weights.
    ///
    /// # Errors
    /// Parts that don't fit together.
    pub fn new(
        document: ModelDocument,
        weights: Weights,
        training_tasks: &[Vec<f64>],
    ) -> Result<Self, ArtifactError> {
        let mut tensors = weights;
        let values = training_tasks.iter().flatten().map(|v| *v as f32).collect();
        let shape = vec![training_tasks.len(), document.task_space.dim()];
        tensors.insert(TASKS.into(), NamedTensor { shape, values });
        Self { document, tensors }.checked()
    }

    /// Reads a model file.
    ///
    /// # Errors
    /// Why it can't be served.
    pub fn load(path: &Path) -> Result<Self, ArtifactError> {
        Self::from_bytes(&read(path)?)
    }

    /// Reads a model file's bytes.
    ///
    /// # Errors
    /// Why it can't be served.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, ArtifactError> {
        let (document, tensors) = decode(bytes, "model")?;
        Self { document, tensors }.checked()
    }

    /// The file's bytes; the same content gives the same bytes.
    pub fn to_bytes(&self) -> Vec<u8> {
        encode(&self.tensors, "model", &self.document)
    }

    /// Writes the file: beside its place first, then renamed.
    ///
    /// # Errors
    /// What the operating system refused. A document that would not be read back, such as one with
    /// a number that is not finite, is not written.
    pub fn save(&self, path: &Path) -> Result<(), ArtifactError> {
        let bytes = self.to_bytes();
        Self::from_bytes(&bytes)?;
        write(path, &bytes)
    }

    /// What tells this model from others: the first 12 digits of the SHA-256 over what it learned,
    /// the tensors and all of a classical primitive.
    pub fn model_id(&self) -> String {
        let tensors = tensors_digest(&self.tensors);
        let digest = match &self.document.learned {
            Learned::TcVae(_) => tensors,
            Learned::Classical(classical) => {
                let parts = serde_json::to_string(classical).expect("a primitive is JSON");
                hex(&Sha256::digest(tensors + &parts))
            }
        };
        digest[..12].to_owned()
    }

    /// The model as a movement primitive; a classical one has no manner parameters.
    pub fn primitive(&self) -> Box<dyn MannerConditioned + Send + Sync> {
        self.build().expect("checked when it was made")
    }

    /// The model as a server serves it, on the robot that it was made for.
    ///
    /// # Errors
    /// A model without a robot.
    pub fn served_model(&self) -> Result<ServedModel, ArtifactError> {
        let document = &self.document;
        let (Some(robot), Some([x, y, z, w])) = (&document.robot, document.state_reference_xyzw)
        else {
            return Err(ArtifactError::NoRobot { states: document.state_names.join(", ") });
        };
        let reference = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
        let primitive = self.primitive();
        let tasks = self.training_tasks().step_by(self.training_tasks().len() / MOST_TASKS + 1);
        let tasks = tasks.map(|w| w.iter().map(|v| f64::from(*v)).collect()).collect();
        Ok(ServedModel {
            model_id: self.model_id(),
            method: document.learned.name().into(),
            task: document.task.clone().into_task(),
            frame: StateFrame { reference },
            duration_secs: document.duration_secs,
            robot: robot.clone(),
            evaluation_json: serde_json::to_string(&document.evaluation)
                .expect("an evaluation is JSON"),
            synthetic_data: document.data_source == DataSource::Synthetic,
            mirrored: false,
            familiarity: Familiarity::new(tasks, &*primitive),
            primitive,
        })
    }

    /// The weights.
    pub fn weights(&self) -> &Weights {
        &self.tensors
    }

    /// The tasks that were trained on, in the order and unit of the task space.
    pub fn training_tasks(&self) -> impl ExactSizeIterator<Item = &[f32]> {
        self.tensors[TASKS].values.chunks_exact(self.document.task_space.dim())
    }

    fn build(&self) -> Result<Box<dyn MannerConditioned + Send + Sync>, ModelError> {
        let ModelDocument { learned, task_space, .. } = &self.document;
        match learned {
            Learned::TcVae(TcVaeDocument {
                model,
                normalizer,
                manner_space,
                deviation_scale,
                ..
            }) => {
                let (task_space, manner_space) = (task_space.clone(), manner_space.clone());
                let primitive = TcVaePrimitive::new(
                    model,
                    normalizer,
                    &self.tensors,
                    task_space,
                    manner_space,
                )?;
                Ok(match deviation_scale {
                    Some(scale) => Box::new(primitive.with_deviation_scale(*scale)?),
                    None => Box::new(primitive),
                })
            }
            Learned::Classical(classical) => Ok(Box::new(classical.clone())),
        }
    }

    fn checked(self) -> Result<Self, ArtifactError> {
        let primitive = self.build()?;
        let ModelDocument { learned, task_space, state_names, duration_secs, .. } = &self.document;
        let document = |detail| Err(ArtifactError::Document { detail });
        if let Err(setting) = self.document.task.check() {
            return document(format!("the task's {setting}"));
        }
        if task_space.dim() == 0 {
            return document("a task space without locations".into());
        }
        if primitive.task_space() != task_space {
            let [ours, its] = [task_space, primitive.task_space()].map(|s| s.value_names());
            return document(format!(
                "the task space ({}) is not that of the primitive ({})",
                ours.join(", "),
                its.join(", ")
            ));
        }
        let state_dim = primitive.state_dim();
        if state_names.len() != state_dim {
            let named = state_names.len();
            return document(format!("{named} state names for {state_dim} state values"));
        }
        if self.document.state_reference_xyzw.is_some() && *state_names != STATE_NAMES {
            let names = state_names.join(", ");
            return document(format!("a reference orientation for the states {names}"));
        }
        if let Learned::TcVae(TcVaeDocument { latents, .. }) = learned
            && latents.len() != primitive.manner_space().dim()
        {
            return document(format!(
                "statistics of {} latents where the model has {}",
                latents.len(),
                primitive.manner_space().dim()
            ));
        }
        if !(duration_secs.is_finite() && *duration_secs > 0.0) {
            return document(format!("a duration of {duration_secs} s; above 0 is needed"));
        }
        match self.tensors.get(TASKS) {
            Some(NamedTensor { shape, values })
                if matches!(shape[..], [_, dim] if dim == task_space.dim())
                    && values.iter().all(|v| v.is_finite()) =>
            {
                Ok(self)
            }
            Some(NamedTensor { shape, .. }) => {
                document(format!("the tensor {TASKS} has the shape {shape:?}, or is not finite"))
            }
            None => document(format!("the tensor {TASKS} is missing")),
        }
    }
}

/// What stands in the metadata. The document's digest is over its text, so that a program that
/// knows more settings reads it too.
#[derive(Serialize, Deserialize)]
struct Envelope {
    kind: String,
    format_version: u32,
    tensors_sha256: String,
    document_sha256: String,
    document: Box<RawValue>,
}

/// Tensors and a document as the bytes of a safetensors file.
pub fn encode(tensors: &Weights, kind: &str, document: &impl Serialize) -> Vec<u8> {
    let document = to_raw_value(document).expect("a document is JSON");
    let envelope = Envelope {
        kind: kind.into(),
        format_version: FORMAT_VERSION,
        tensors_sha256: tensors_digest(tensors),
        document_sha256: hex(&Sha256::digest(document.get())),
        document,
    };
    let envelope = serde_json::to_string(&envelope).expect("a document is JSON");
    let bytes: Vec<_> = tensors.iter().map(|(name, t)| (name, &t.shape, le_bytes(t))).collect();
    let views = bytes.iter().map(|(name, shape, bytes)| {
        let view = TensorView::new(Dtype::F32, shape.to_vec(), bytes);
        (name, view.expect("a tensor has a value for each place"))
    });
    serialize(views, Some(HashMap::from([(KEY.to_owned(), envelope)])))
        .expect("tensors of f32 can be written")
}

/// The document and the tensors of a file of one kind.
///
/// # Errors
/// Why they are not what was written.
pub fn decode<D: DeserializeOwned>(
    bytes: &[u8],
    kind: &'static str,
) -> Result<(D, Weights), ArtifactError> {
    let damaged = |detail: String| ArtifactError::Damaged { detail };
    let foreign = |detail: String| ArtifactError::Foreign { expected: kind, detail };
    let safetensors = |e: safetensors::SafeTensorError| damaged(e.to_string());
    let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(safetensors)?;
    let text = metadata.metadata().as_ref().and_then(|m| m.get(KEY));
    let text = text.ok_or_else(|| foreign(format!("its metadata has no {KEY:?}")))?;

    // Kind and version come first: another version has another document.
    #[derive(Deserialize)]
    struct Kind {
        kind: String,
        format_version: u32,
    }
    let found: Kind = serde_json::from_str(text).map_err(|e| foreign(e.to_string()))?;
    if found.kind != kind {
        return Err(foreign(format!("it is a {}", found.kind)));
    }
    if found.format_version != FORMAT_VERSION {
        return Err(ArtifactError::Version { found: found.format_version });
    }
    let unreadable = |e: serde_json::Error| ArtifactError::Document { detail: e.to_string() };
    let envelope: Envelope = serde_json::from_str(text).map_err(unreadable)?;
    let Envelope { tensors_sha256, document_sha256, document, .. } = envelope;

    let mut tensors = Weights::new();
    for (name, view) in SafeTensors::deserialize(bytes).map_err(safetensors)?.tensors() {
        if view.dtype() != Dtype::F32 {
            return Err(damaged(format!("the tensor {name} is {:?}, not F32", view.dtype())));
        }
        let value = |b: &[u8]| f32::from_le_bytes(b.try_into().expect("four bytes"));
        let values = view.data().chunks_exact(4).map(value).collect();
        tensors.insert(name, NamedTensor { shape: view.shape().to_vec(), values });
    }
    for (part, found, expected) in [
        ("tensors", tensors_digest(&tensors), tensors_sha256),
        ("metadata", hex(&Sha256::digest(document.get())), document_sha256),
    ] {
        if found != expected {
            return Err(ArtifactError::Digest { part, found, expected });
        }
    }
    Ok((serde_json::from_str(document.get()).map_err(unreadable)?, tensors))
}

/// Reads a whole file.
///
/// # Errors
/// What the operating system refused; a file that is larger than any model.
pub fn read(path: &Path) -> Result<Vec<u8>, ArtifactError> {
    let io = |source| ArtifactError::Io { action: "cannot read", path: path.into(), source };
    let file = File::open(path).map_err(io)?;
    let bytes = file.metadata().map_err(io)?.len();
    if bytes > MAX_BYTES {
        return Err(ArtifactError::TooLarge { bytes });
    }
    let mut content = Vec::new();
    file.take(MAX_BYTES).read_to_end(&mut content).map_err(io)?;
    Ok(content)
}

/// Writes a whole file: beside its place first, then renamed, readable by all.
///
/// # Errors
/// What the operating system refused.
pub fn write(path: &Path, content: &[u8]) -> Result<(), ArtifactError> {
    let io = |source| ArtifactError::Io { action: "cannot write", path: path.into(), source };
    let mut file = tempfile::NamedTempFile::new_in(folder_of(path)).map_err(io)?;
    file.write_all(content).map_err(io)?;
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        file.as_file().set_permissions(fs::Permissions::from_mode(0o644)).map_err(io)?;
    }
    file.as_file().sync_all().map_err(io)?;
    file.persist(path).map_err(|e| io(e.error))?;
    Ok(())
}

/// The folder that a file lies in.
pub fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    }
}

/// SHA-256 over names, shapes and values, in the order of the names.
fn tensors_digest(tensors: &Weights) -> String {
    let mut digest = Sha256::new();
    for (name, tensor) in tensors {
        digest.update(format!("{name} {:?}\n", tensor.shape));
        digest.update(le_bytes(tensor));
    }
    hex(&digest.finalize())
}

fn le_bytes(tensor: &NamedTensor) -> Vec<u8> {
    tensor.values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;

    use super::*;
    use crate::demonstrations::arcs::{ArcStart, ArcsTask};
    use crate::demonstrations::pouring;
    use crate::model::{Layout, NetworkConfig};
    use crate::parameters::TaskParameters;
    use crate::primitive::MovementPrimitive;
    use crate::primitives::classical;

    fn artifact() -> Artifact {
        let network = NetworkConfig { width: 4, ..NetworkConfig::default() };
        let model = ModelConfig { steps: 6, state_dim: 2, task_dim: 2, network };
        let layout = Layout::of_model(&model);
        let values = layout.initial(&mut ChaCha8Rng::seed_from_u64(1));
        let statistics = LatentStatistics { mean: 0.1, stddev: 0.9, variance: 0.2, kl: 1.3 };
        let learned = Learned::TcVae(TcVaeDocument {
            training: TrainingConfig::default(),
            last_epoch: None,
            selected_epoch: None,
            manner_space: MannerSpace::unnamed(model.network.latents, 3.0),
            latents: vec![statistics; model.network.latents],
            normalizer: Normalizer {
                state_offset: vec![0.1, 1.0 / 3.0],
                state_scale: vec![0.3, 0.7],
                task_offset: vec![0.5; 2],
                task_scale: vec![0.29; 2],
            },
            deviation_scale: None,
            model,
        });
        let tasks = [vec![0.25, 0.5], vec![0.75, 0.125]];
        let document = document(learned, ArcsTask::task_space(), &["x", "y"]);
        Artifact::new(document, layout.to_weights(&values), &tasks).unwrap()
    }

    fn document(learned: Learned, task_space: TaskSpace, state_names: &[&str]) -> ModelDocument {
        ModelDocument {
            learned,
            git_revision: "0123abc".into(),
            data_digest: "00".into(),
            data_source: DataSource::Synthetic,
            training_demonstrations: 2,
            task_space,
            state_names: state_names.iter().map(|name| name.to_string()).collect(),
            duration_secs: 1.0,
            state_reference_xyzw: None,
            task: TaskConfig::Arcs(ArcsTask::new(ArcStart::Half)),
            robot: None,
            evaluation: None,
        }
    }

    /// A model of each classical primitive.
    fn classical() -> [Artifact; 3] {
        classical::tests::all().map(|primitive| {
            let space = primitive.task_space().clone();
            let document = document(Learned::Classical(primitive), space, &["x", "y", "z"]);
            Artifact::new(document, Weights::new(), &[vec![0.1, 0.2, 0.3, 0.4]]).unwrap()
        })
    }

    #[test]
    fn a_saved_model_is_the_model_that_is_loaded() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.safetensors");
        let artifact = artifact();
        artifact.save(&path).unwrap();
        let loaded = Artifact::load(&path).unwrap();
        assert_eq!(loaded, artifact);
        assert_eq!(loaded.to_bytes(), artifact.to_bytes());
        assert_eq!(loaded.training_tasks().nth(1).unwrap(), [0.75, 0.125]);
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o644);
        }
    }

    #[test]
    fn a_saved_classical_model_is_the_model_that_is_loaded() {
        let mut ids = Vec::new();
        for artifact in classical() {
            let bytes = artifact.to_bytes();
            let loaded = Artifact::from_bytes(&bytes).unwrap();
            assert_eq!(loaded, artifact);
            assert_eq!(loaded.to_bytes(), bytes);
            let (saved, read) = (artifact.primitive(), loaded.primitive());
            let w = TaskParameters::new(saved.task_space(), vec![0.1, 0.2, -0.1, 0.3]).unwrap();
            assert_eq!(read.generate(&w), saved.generate(&w));
            // All three have the same tensors, and are told apart nevertheless.
            ids.push(loaded.model_id());
        }
        assert!(ids[0] != ids[1] && ids[0] != ids[2] && ids[1] != ids[2], "{ids:?}");
    }

    #[test]
    fn a_damaged_or_crafted_classical_model_is_refused_with_a_reason() {
        for Artifact { document, tensors } in classical() {
            let bytes = encode(&tensors, "model", &document);
            for end in [bytes.len() / 2, bytes.len() - 1] {
                let error = Artifact::from_bytes(&bytes[..end]).unwrap_err();
                assert!(matches!(error, ArtifactError::Damaged { .. }), "{end}: {error}");
            }
            let whole = serde_json::to_value(&document).unwrap();
            let Learned::Classical(primitive) = &document.learned else { panic!() };
            let parts = serde_json::to_value(primitive).unwrap();
            let kind = parts.as_object().unwrap().keys().next().unwrap();
            let parts = format!("/learned/classical/{kind}/parts");
            // With digests that fit, so that only what the parts say is wrong.
            let refused = |pointer: &str, by: serde_json::Value| {
                let mut crafted = whole.clone();
                *crafted.pointer_mut(pointer).unwrap() = by;
                let bytes = encode(&tensors, "model", &crafted);
                Artifact::from_bytes(&bytes).unwrap_err().to_string()
            };
            let error = refused(&format!("{parts}/steps"), 1.into());
            let reason = format!("the stored {} does not fit together", primitive.name());
            assert!(error.contains(&reason), "{error}");
            let error = refused(&format!("{parts}/task_space/locations/0/name"), "cup".into());
            assert!(error.contains("is not that of the primitive (cup.x"), "{error}");
            let error = refused("/state_names", serde_json::json!(["x", "y"]));
            assert!(error.contains("2 state names for 3 state values"), "{error}");
            let reference = serde_json::json!([0.0, 0.0, 0.0, 1.0]);
            let error = refused("/state_reference_xyzw", reference);
            assert!(error.contains("a reference orientation for the states x, y, z"), "{error}");
            let missing = Artifact::from_bytes(&encode(&Weights::new(), "model", &document));
            assert!(missing.unwrap_err().to_string().contains("training.tasks is missing"));
        }
    }

    #[test]
    fn a_task_that_can_not_be_is_refused_by_its_setting() {
        let mut task = pouring::task();
        task.augmentation.max_stretch = 1.5;
        let Artifact { mut document, tensors } = artifact();
        document.task = TaskConfig::Manipulation(task);
        let error = Artifact::from_bytes(&encode(&tensors, "model", &document)).unwrap_err();
        assert!(
            error.to_string().contains("the task's augmentation.max_stretch is 1.5"),
            "{error}"
        );
    }

    #[test]
    fn every_truncation_is_refused() {
        let bytes = artifact().to_bytes();
        for end in [0, 1, 7, 8, 100, bytes.len() / 2, bytes.len() - 1] {
            let error = Artifact::from_bytes(&bytes[..end]).unwrap_err();
            assert!(matches!(error, ArtifactError::Damaged { .. }), "{end}: {error}");
        }
    }

    #[test]
    fn every_changed_byte_of_the_tensors_is_refused() {
        let bytes = artifact().to_bytes();
        for back in [1, 2, 333, 1000] {
            let mut edited = bytes.clone();
            edited[bytes.len() - back] ^= 0x10;
            let error = Artifact::from_bytes(&edited).unwrap_err();
            assert!(matches!(error, ArtifactError::Digest { part: "tensors", .. }), "{error}");
        }
    }

    /// The bytes with one piece of the metadata replaced by another of the same length.
    fn edited(bytes: &[u8], from: &str, to: &str) -> Vec<u8> {
        assert_eq!(from.len(), to.len());
        let (from, to) = (from.replace('"', "\\\""), to.replace('"', "\\\""));
        let place = bytes.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
        let mut edited = bytes.to_vec();
        edited[place..place + to.len()].copy_from_slice(to.as_bytes());
        edited
    }

    #[test]
    fn edited_metadata_is_refused() {
        let bytes =
            edited(&artifact().to_bytes(), r#""duration_secs":1.0"#, r#""duration_secs":1.5"#);
        let error = Artifact::from_bytes(&bytes).unwrap_err();
        assert!(matches!(error, ArtifactError::Digest { part: "metadata", .. }), "{error}");
    }

    #[test]
    fn a_file_from_before_a_setting_existed_is_read() {
        let Artifact { document, tensors } = artifact();
        let mut older = serde_json::to_value(&document).unwrap();
        let network = older["learned"]["tc-vae"]["model"]["network"].as_object_mut().unwrap();
        assert!(network.remove("margins").is_some());
        let read = Artifact::from_bytes(&encode(&tensors, "model", &older)).unwrap();
        assert_eq!(read.document, document);
    }

    #[test]
    fn another_format_is_refused_with_both_versions_and_what_to_do() {
        for (version, remedy) in [(9, "update it"), (1, "train again")] {
            let bytes = edited(
                &artifact().to_bytes(),
                r#""format_version":3"#,
                &format!(r#""format_version":{version}"#),
            );
            assert_eq!(
                Artifact::from_bytes(&bytes).unwrap_err().to_string(),
                format!(
                    "the file has format version {version}; this program reads version 3; {remedy}"
                )
            );
        }
    }

    #[test]
    fn another_programs_safetensors_file_is_refused() {
        let bytes = serialize(Vec::<(String, TensorView<'_>)>::new(), None).unwrap();
        let error = Artifact::from_bytes(&bytes).unwrap_err();
        assert!(matches!(error, ArtifactError::Foreign { .. }), "{error}");
        let checkpoint = encode(&Weights::new(), "checkpoint", &1);
        assert_eq!(
            Artifact::from_bytes(&checkpoint).unwrap_err().to_string(),
            "the file is no model of this program: it is a checkpoint"
        );
    }

    #[test]
    fn parts_that_do_not_fit_are_refused_when_a_model_is_made() {
        let Artifact { document, tensors } = artifact();
        let mut missing = tensors.clone();
        missing.remove("decoder.layers.1.weight");
        let error = Artifact::new(document.clone(), missing, &[]).unwrap_err();
        assert!(error.to_string().contains("decoder.layers.1.weight is missing"), "{error}");
        let document = ModelDocument { state_names: vec!["x".into()], ..document };
        assert!(Artifact::new(document, tensors, &[]).is_err());
    }

    #[test]
    fn what_could_not_be_read_back_is_not_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.safetensors");
        let mut artifact = artifact();
        let Learned::TcVae(model) = &mut artifact.document.learned else { panic!() };
        model.latents[0].kl = f64::NAN;
        assert!(matches!(artifact.save(&path), Err(ArtifactError::Document { .. })));
        assert!(!path.exists());
    }

    #[test]
    fn the_id_of_a_network_is_that_of_its_tensors() {
        let mut artifact = artifact();
        let id = artifact.model_id();
        artifact.document.duration_secs = 2.0;
        assert_eq!(artifact.model_id(), id);
        artifact.tensors.get_mut("decoder.mean.output.bias").unwrap().values[0] += 1.0;
        assert_ne!(artifact.model_id(), id);
    }
}
