//! Bags: MCAP files; the folders that rosbag2 writes, in MCAP or SQLite, split or not, compressed as files or
//! message by message; and the bags of ROS 1.
//!
//! Only joint states and the topics of grippers are read; what else a bag holds is not even decompressed
//! where the bag has an index. A folder is read by its files: `metadata.yaml` may be missing. What is
//! damaged is left out and told; what comes before the damage is kept.

pub mod definitions;
mod mcap_file;
mod message;
pub mod motions;
mod ros1_file;
mod sqlite;
pub mod writer;

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{self, Read, Seek};
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use crate::demonstrations::joint_messages::{Assembled, JointMessages};
use crate::demonstrations::recording::{Channels, JointRecording};
use message::{Content, Encoding};

/// Largest record or message that is read; what is larger is damage. A 4K image has 25 MB.
const LARGEST_RECORD: usize = 256 << 20;

/// How much larger than the file what it decompresses to may be.
const LARGEST_GROWTH: u64 = 200;

/// Share of the frames that may lack a joint, at either end, before it is told as damage.
const INCOMPLETE_SHARE: f64 = 0.05;

/// What rosbag2 writes beside its files.
const METADATA: &str = "metadata.yaml";

/// Folders below the given one that bags are looked for in.
const LEVELS: usize = 4;

/// Why a bag is no recording.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BagError {
    /// A file or folder can't be opened.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// A file is damaged before its first message, or none of its kind.
    #[error("{}: {reason}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// No topic has joint states that can be read.
    #[error("no joint states can be read: {reason}")]
    NoJointStates {
        /// What there is instead.
        reason: String,
    },
}

/// A bag: one file, or the parts of a recording that was split.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Bag {
    /// The file, or the folder of its parts.
    pub path: PathBuf,
    /// The files, in the order of recording.
    pub files: Vec<PathBuf>,
}

/// A recording, and what was left out of it.
#[derive(Debug, Clone, PartialEq)]
pub struct BagRecording {
    /// The recording.
    pub recording: JointRecording,
    /// Messages that were read.
    pub messages: usize,
    /// Messages and values that can't be read, or say the same time again.
    pub skipped: usize,
    /// What is damaged; nothing in a sound bag.
    pub damage: Vec<String>,
    /// SHA-256 over the messages that were read, in hexadecimal digits.
    pub digest: String,
}

/// A topic that is asked for.
#[derive(Debug, Clone)]
struct Topic {
    name: String,
    content: Content,
    encoding: Encoding,
}

/// What was read so far.
struct Reading<'m, 'c> {
    channels: &'c Channels,
    messages: &'m mut JointMessages<'c>,
    digest: Sha256,
    read: usize,
    damaged: usize,
    /// What was wrong with the first message that can't be read.
    first_damage: Option<String>,
    /// Topics that are asked for in an encoding that can't be read.
    unread: BTreeSet<String>,
}

impl Bag {
    /// The bags in a path: a file, a folder of rosbag2's, or a folder of these, sorted by name. None
    /// where there is no bag.
    ///
    /// # Errors
    /// A file or folder can't be looked into.
    pub fn find(path: &Path) -> Result<Vec<Self>, BagError> {
        let mut found = Vec::new();
        if path.is_dir() {
            collect(path, LEVELS, &mut found)?;
        } else if kind(path).is_some() {
            found.push(Self::of_file(path));
        }
        Ok(found)
    }

    fn of_file(path: &Path) -> Self {
        Self { path: path.into(), files: vec![path.into()] }
    }

    /// Reads the recording: these joints, and these grippers.
    ///
    /// # Errors
    /// A file that can't be opened or read before its first message; no joint states.
    pub fn read(&self, channels: &Channels) -> Result<BagRecording, BagError> {
        let mut messages = JointMessages::new(channels);
        let mut reading = Reading {
            channels,
            messages: &mut messages,
            digest: Sha256::new(),
            read: 0,
            damaged: 0,
            first_damage: None,
            unread: BTreeSet::new(),
        };
        let mut damage = Vec::new();
        for path in &self.files {
            let before = reading.read;
            if let Err(reason) = read_file(path, &mut reading)? {
                if self.files.len() == 1 && reading.read == before {
                    return Err(BagError::Damaged { path: path.clone(), reason });
                }
                let read = reading.read - before;
                damage.push(format!("{}: after {read} messages: {reason}", name(path)));
            }
        }
        let Reading { digest, read, damaged, first_damage, unread, .. } = reading;
        damage.extend(unread.iter().map(|topic| format!("{topic}; cdr and ros1 are read")));
        if let Some(first) = first_damage {
            damage.push(format!("{damaged} messages can't be read, the first: {first}"));
        }
        let Assembled { recording, other_joints, not_finite, doubled, incomplete } =
            messages.assemble(name(&self.path));
        if recording.times_secs.is_empty() {
            let reason = if !damage.is_empty() {
                damage.join("; ")
            } else if !other_joints.is_empty() {
                let (others, asked) = (other_joints.join(", "), channels.joints.join(", "));
                format!("the joints in it are {others}; {asked} are looked for")
            } else {
                "no topic of the type sensor_msgs/JointState has a message".into()
            };
            return Err(BagError::NoJointStates { reason });
        }
        let frames = recording.times_secs.len() + incomplete;
        if incomplete as f64 > INCOMPLETE_SHARE * frames as f64 {
            damage.push(format!(
                "{incomplete} of {frames} frames are left out, as some joint is heard of later than \
                 others or no more"
            ));
        }
        let digest = digest.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
        let skipped = damaged + not_finite + doubled + incomplete;
        Ok(BagRecording { recording, messages: read, skipped, damage, digest })
    }
}

impl Reading<'_, '_> {
    /// A topic that is asked for; none for others.
    fn topic(&mut self, name: &str, type_name: &str, encoding: &str) -> Option<Topic> {
        let content = Content::of_type(type_name)?;
        let of_gripper =
            || self.channels.grippers.iter().any(|g| g.source.topic.as_deref() == Some(name));
        if content != Content::JointStates && !of_gripper() {
            return None;
        }
        let Some(encoding) = Encoding::named(encoding) else {
            self.unread.insert(format!("{name} is encoded as {encoding:?}"));
            return None;
        };
        Some(Topic { name: name.into(), content, encoding })
    }

    fn message(&mut self, topic: &Topic, log_nanos: i64, data: &[u8]) {
        let Topic { name, content, encoding } = topic;
        match message::take(self.messages, name, *content, *encoding, log_nanos, data) {
            Ok(()) => {
                self.read += 1;
                for part in [name.as_bytes(), &log_nanos.to_le_bytes(), data] {
                    self.digest.update((part.len() as u64).to_le_bytes());
                    self.digest.update(part);
                }
            }
            Err(e) => self.damaged(topic, &e.to_string()),
        }
    }

    fn damaged(&mut self, topic: &Topic, reason: &str) {
        self.damaged += 1;
        self.first_damage.get_or_insert_with(|| format!("on {}, {reason}", topic.name));
    }
}

/// Reads a file; within, what went wrong with its content.
fn read_file(path: &Path, reading: &mut Reading<'_, '_>) -> Result<Result<(), String>, BagError> {
    let (kind, compressed) = kind(path).expect("found by its name");
    let open = |source| BagError::Io { path: path.into(), source };
    let mut file = File::open(path).map_err(open)?;
    if !compressed {
        return Ok(read_storage(kind, path, &mut file, reading));
    }
    let mut plain = tempfile::NamedTempFile::new().map_err(open)?;
    let most = file.metadata().map_err(open)?.len().saturating_mul(LARGEST_GROWTH);
    let copied = match zstd::Decoder::new(file) {
        Ok(decoder) => io::copy(&mut decoder.take(most.saturating_add(1)), plain.as_file_mut()),
        Err(e) => Err(e),
    };
    let copied = match copied {
        Ok(copied) if copied > most => Err(format!("it holds more than {most} bytes")),
        Ok(_) => Ok(()),
        Err(e) => Err(format!("it can't be decompressed: {e}")),
    };
    plain.as_file_mut().rewind().map_err(open)?;
    // What could be decompressed may hold messages all the same.
    let plain_path = plain.path().to_owned();
    let read = read_storage(kind, &plain_path, plain.as_file_mut(), reading);
    Ok(copied.and(read))
}

fn read_storage(
    kind: Kind,
    path: &Path,
    file: &mut File,
    reading: &mut Reading<'_, '_>,
) -> Result<(), String> {
    match kind {
        Kind::Mcap => mcap_file::read(file, reading).map_err(|e| e.to_string()),
        Kind::Sqlite => sqlite::read(path, reading).map_err(|e| e.to_string()),
        Kind::Ros1 => ros1_file::read(file, reading).map_err(|e| e.to_string()),
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Mcap,
    Sqlite,
    Ros1,
}

/// How messages are stored in a file of this name, and whether it is compressed as a whole; none where it
/// stores no messages.
fn kind(path: &Path) -> Option<(Kind, bool)> {
    let name = name(path);
    let plain = name.strip_suffix(".zstd");
    let (_, extension) = plain.unwrap_or(name).rsplit_once('.')?;
    let kind = match extension {
        "mcap" => Kind::Mcap,
        "db3" => Kind::Sqlite,
        "bag" => Kind::Ros1,
        _ => return None,
    };
    Some((kind, plain.is_some()))
}

fn name(path: &Path) -> &str {
    path.file_name().and_then(|name| name.to_str()).unwrap_or_default()
}

fn collect(folder: &Path, levels: usize, found: &mut Vec<Bag>) -> Result<(), BagError> {
    let io = |source| BagError::Io { path: folder.into(), source };
    let (mut files, mut folders, mut has_metadata) = (Vec::new(), Vec::new(), false);
    for entry in fs::read_dir(folder).map_err(io)? {
        let entry = entry.map_err(io)?.path();
        if entry.is_dir() {
            folders.push(entry);
        } else if kind(&entry).is_some() {
            files.push(entry);
        } else {
            has_metadata |= name(&entry) == METADATA;
        }
    }
    files.sort_by_key(|file| (part(file).map(|(_, number)| number), file.clone()));
    let folder_name = name(folder);
    let parts = files.iter().all(|file| part(file).is_some_and(|(of, _)| of == folder_name));
    if !files.is_empty() && (has_metadata || parts) {
        found.push(Bag { path: folder.into(), files });
        return Ok(());
    }
    files.sort();
    found.extend(files.iter().map(|file| Bag::of_file(file)));
    if levels > 0 {
        folders.sort();
        for folder in folders {
            collect(&folder, levels - 1, found)?;
        }
    }
    Ok(())
}

/// The recording that a file is a part of by its name, and its number: `pours_3.db3`.
fn part(file: &Path) -> Option<(&str, u64)> {
    let (of, number) = name(file).split('.').next()?.rsplit_once('_')?;
    Some((of, number.parse().ok()?))
}
