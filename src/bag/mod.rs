//! Bags: MCAP files; the folders that rosbag2 writes, in MCAP or SQLite, split or not, compressed as files or
//! message by message; and the bags of ROS 1.
//!
//! Only joint states and the topics of grippers are read; what else a bag holds is not even decompressed
//! where the bag has an index. A folder is read by its files: `metadata.yaml` may be missing; where it is
//! there, it says which files belong together. What is damaged is left out and told; what comes before the
//! damage is kept.
//!
//! Memory is bounded whatever a file holds: by 256 MiB for what is read at a time, and by
//! what [`JointMessages`] keeps.

pub mod definitions;
mod mcap_file;
mod message;
pub mod motions;
mod ros1_file;
mod sqlite;
pub mod writer;

use std::collections::{BTreeSet, HashSet};
use std::fs::{self, File};
use std::io::{self, Read, Seek};
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use crate::demonstrations::joint_messages::{Assembled, JointMessages};
use crate::demonstrations::recording::{Channels, JointRecording};
use message::{Content, Encoding};

/// Largest record or message that is read; what is larger is damage. A 4K image has 25 MB.
const LARGEST_RECORD: usize = 256 << 20;

/// How much larger than the file what it decompresses to may be on disk, where that is more than
/// [`LARGEST_RECORD`].
const LARGEST_GROWTH: u64 = 200;

/// What a message that rosbag2 compressed begins with. In CDR the first byte is 0.
const ZSTD_MAGIC: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];

/// Longest name of a topic that is read, bytes. ROS allows 255.
const LONGEST_NAME: usize = 1024;

/// Topics in encodings that can't be read which are told.
const UNREAD_TOPICS: usize = 8;

/// Share of the frames that may lack a joint, at either end, before it is told as damage.
const INCOMPLETE_SHARE: f64 = 0.05;

/// What rosbag2 writes beside its files, and how much of it is read: a split recording names each file.
const METADATA: &str = "metadata.yaml";
/// See [`METADATA`].
const LARGEST_METADATA: u64 = 16 << 20;

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
    /// Files that `metadata.yaml` names and that are not there.
    pub missing: Vec<String>,
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
    /// Topics that are asked for in an encoding that can't be read, or the first of them.
    unread: BTreeSet<String>,
    /// Room for a message that comes compressed.
    plain: Vec<u8>,
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
            collect(path, LEVELS, &mut HashSet::new(), &mut found)?;
        } else if path.is_file() && kind(path).is_some() {
            found.push(Self::of_file(path));
        }
        Ok(found)
    }

    fn of_file(path: &Path) -> Self {
        Self { path: path.into(), files: vec![path.into()], missing: Vec::new() }
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
            plain: Vec::new(),
        };
        let not_there = |file: &String| format!("{METADATA} names {file}, which is not there");
        let mut damage: Vec<String> = self.missing.iter().map(not_there).collect();
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
        let is_full = reading.is_full();
        let Reading { digest, read, damaged, first_damage, unread, .. } = reading;
        if is_full {
            damage.push(format!(
                "only its first {read} messages are read: of one recording no more angles are kept \
                 than fit in 256 MiB; split it"
            ));
        }
        damage.extend(unread);
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
        let Channels { joints: _, grippers, points, marker } = self.channels;
        let of_gripper = || grippers.iter().any(|g| g.source.topic.as_deref() == Some(name));
        let content = match Content::of_type(type_name) {
            _ if marker.as_deref() == Some(name) => {
                // Whatever it holds, and however that is encoded.
                let (content, encoding) = (Content::Mark, Encoding::Ros1);
                return Some(Topic { name: name.into(), content, encoding });
            }
            Some(content @ Content::JointStates) => content,
            Some(content @ Content::Number(_)) if of_gripper() => content,
            Some(content @ (Content::Point | Content::Transform))
                if points.iter().any(|topic| topic == name) =>
            {
                content
            }
            _ => return None,
        };
        let unread = if name.len() > LONGEST_NAME {
            format!("a topic has a name of {} bytes, of which {LONGEST_NAME} are read", name.len())
        } else if let Some(encoding) = Encoding::named(encoding) {
            return Some(Topic { name: name.into(), content, encoding });
        } else {
            let encoding: String = encoding.chars().take(40).collect();
            format!("{name} is encoded as {encoding:?}; cdr and ros1 are read")
        };
        if self.unread.len() < UNREAD_TOPICS {
            self.unread.insert(unread);
        }
        None
    }

    /// Whether what comes now would be left out.
    fn is_full(&self) -> bool {
        self.messages.is_full()
    }

    /// Takes a message, which may be compressed.
    fn message(&mut self, topic: &Topic, log_nanos: i64, data: &[u8]) {
        if topic.encoding != Encoding::Cdr || !data.starts_with(&ZSTD_MAGIC) {
            return self.plain_message(topic, log_nanos, data);
        }
        let mut plain = std::mem::take(&mut self.plain);
        plain.clear();
        match decompress(data, &mut plain) {
            Ok(()) => self.plain_message(topic, log_nanos, &plain),
            Err(e) => self.damaged(topic, &format!("it can't be decompressed: {e}")),
        }
        self.plain = plain;
    }

    fn plain_message(&mut self, topic: &Topic, log_nanos: i64, data: &[u8]) {
        let Topic { name, content, encoding } = topic;
        match message::take(self.messages, name, *content, *encoding, log_nanos, data) {
            // Not read, as there was no room for it.
            Ok(()) if self.is_full() => {}
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

/// Appends what a compressed message holds.
fn decompress(data: &[u8], plain: &mut Vec<u8>) -> io::Result<()> {
    let decoder = zstd::Decoder::with_buffer(data)?;
    let mut decoder = decoder.take(LARGEST_RECORD as u64 + 1);
    decoder.read_to_end(plain)?;
    if plain.len() > LARGEST_RECORD {
        return Err(io::Error::other(format!("it is larger than {LARGEST_RECORD} bytes")));
    }
    Ok(())
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
    let size = file.metadata().map_err(open)?.len();
    let most = size.saturating_mul(LARGEST_GROWTH).max(LARGEST_RECORD as u64);
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

/// Adds the bags in a folder that was not looked into before: links may lead in circles.
fn collect(
    folder: &Path,
    levels: usize,
    seen: &mut HashSet<PathBuf>,
    found: &mut Vec<Bag>,
) -> Result<(), BagError> {
    let io = |source| BagError::Io { path: folder.into(), source };
    if !seen.insert(fs::canonicalize(folder).map_err(io)?) {
        return Ok(());
    }
    let (mut files, mut folders) = (Vec::new(), Vec::new());
    for entry in fs::read_dir(folder).map_err(io)? {
        let entry = entry.map_err(io)?.path();
        if entry.is_dir() {
            folders.push(entry);
        } else if entry.is_file() && kind(&entry).is_some() {
            files.push(entry);
        }
    }
    files.sort_by_key(|file| (part(file).map(|(_, number)| number), file.clone()));
    let is_part = |file: &PathBuf| part(file).is_some_and(|(of, _)| of == name(folder));
    match metadata(folder).map_err(io)? {
        Some(metadata) if !files.is_empty() => {
            let named = named_files(&metadata);
            let (mut parts, mut missing) = (Vec::new(), Vec::new());
            for name_of_part in &named {
                match files.iter().position(|file| is_same(name(file), name_of_part)) {
                    Some(place) => parts.push(files.remove(place)),
                    None => missing.push(name_of_part.clone()),
                }
            }
            // What stands there compressed and as it was is one file. What is named like a part was not
            // noted in time, and without any name all files are parts.
            files.retain(|file| !named.iter().any(|part| is_same(name(file), part)));
            let (more, others): (Vec<_>, Vec<_>) =
                files.into_iter().partition(|file| named.is_empty() || is_part(file));
            parts.extend(more);
            if parts.is_empty() {
                found.extend(others.iter().map(|file| Bag::of_file(file)));
                return Ok(());
            }
            found.push(Bag { path: folder.into(), files: parts, missing });
            found.extend(others.iter().map(|file| Bag::of_file(file)));
            return Ok(());
        }
        None if !files.is_empty() && files.iter().all(is_part) => {
            found.push(Bag { path: folder.into(), files, missing: Vec::new() });
            return Ok(());
        }
        _ => {}
    }
    files.sort();
    found.extend(files.iter().map(|file| Bag::of_file(file)));
    if levels > 0 {
        folders.sort();
        for folder in folders {
            collect(&folder, levels - 1, seen, found)?;
        }
    }
    Ok(())
}

/// What `metadata.yaml` in a folder says; none where there is none.
fn metadata(folder: &Path) -> io::Result<Option<String>> {
    let path = folder.join(METADATA);
    if !path.is_file() {
        return Ok(None);
    }
    let mut bytes = Vec::new();
    File::open(path)?.take(LARGEST_METADATA).read_to_end(&mut bytes)?;
    Ok(Some(String::from_utf8_lossy(&bytes).into_owned()))
}

/// The files that `metadata.yaml` names, without their folders. Of YAML this knows what rosbag2 writes: a
/// list of one name a line, or none in brackets.
fn named_files(metadata: &str) -> Vec<String> {
    const KEY: &str = "relative_file_paths:";
    let lines = metadata.lines().map(str::trim).skip_while(|line| *line != KEY).skip(1);
    let names = lines.map_while(|line| line.strip_prefix("- "));
    let own = |path: &str| {
        let path = path.trim().trim_matches(['"', '\'']);
        path.rsplit('/').next().unwrap_or(path).to_owned()
    };
    names.map(own).collect()
}

/// Whether two names are of the same file, compressed or not.
fn is_same(a: &str, b: &str) -> bool {
    a.trim_end_matches(".zstd") == b.trim_end_matches(".zstd")
}

/// Whether a file of this name may be one of a bag.
pub fn is_part(path: &Path) -> bool {
    name(path) == METADATA || kind(path).is_some()
}

/// The files at a path, sorted by name: itself, or those in the folder and as far below it as bags are
/// looked for.
///
/// # Errors
/// A folder can't be looked into.
pub fn files(path: &Path) -> Result<Vec<PathBuf>, BagError> {
    fn collect(
        folder: &Path,
        levels: usize,
        seen: &mut HashSet<PathBuf>,
        found: &mut Vec<PathBuf>,
    ) -> Result<(), BagError> {
        let io = |source| BagError::Io { path: folder.into(), source };
        if !seen.insert(fs::canonicalize(folder).map_err(io)?) {
            return Ok(());
        }
        for entry in fs::read_dir(folder).map_err(io)? {
            let entry = entry.map_err(io)?.path();
            if entry.is_file() {
                found.push(entry);
            } else if entry.is_dir() && levels > 0 {
                collect(&entry, levels - 1, seen, found)?;
            }
        }
        Ok(())
    }
    let mut found = Vec::new();
    if path.is_dir() {
        collect(path, LEVELS, &mut HashSet::new(), &mut found)?;
    } else if path.is_file() {
        found.push(path.into());
    }
    found.sort();
    Ok(found)
}

/// The recording that a file is a part of by its name, and its number: `pours_3.db3`.
fn part(file: &Path) -> Option<(&str, u64)> {
    let (of, number) = name(file).split('.').next()?.rsplit_once('_')?;
    Some((of, number.parse().ok()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// All bags below a folder, at any depth.
    fn below(folder: &Path, found: &mut Vec<PathBuf>) {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                below(&path, found);
            } else if kind(&path).is_some() {
                found.push(path);
            }
        }
    }

    /// Reads all that `tests/golden/bags` has, or the folder that `TCVAE_FOREIGN_BAGS` names, since the files
    /// of other projects are not ours to ship. Of foxglove/mcap the folder `tests/conformance/data` has 416
    /// of them (or `tests/golden/conformance.py` makes them), and of ros2/rosbag2 those named `resources`
    /// and `bags` have 39; more are in foxglove/mcap's `testdata` (`git lfs pull`). For example:
    ///
    /// ```text
    /// TCVAE_FOREIGN_BAGS=~/mcap/tests/conformance/data cargo test --lib foreign -- --nocapture
    /// ```
    #[test]
    fn foreign_bags_are_read_to_their_ends() {
        let foreign = std::env::var_os("TCVAE_FOREIGN_BAGS").map(PathBuf::from);
        let ours = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/bags");
        let folder = foreign.clone().unwrap_or(ours);
        let mut files = Vec::new();
        below(&folder, &mut files);
        assert!(!files.is_empty(), "no bag below {}", folder.display());
        let channels = Channels { joints: vec!["a".into()], ..Channels::default() };
        let (mut complaints, mut with_joints) = (Vec::new(), 0);
        for path in &files {
            let read = Bag::of_file(path).read(&channels);
            let complaint = match &read {
                Ok(BagRecording { damage, .. }) => damage.first().cloned(),
                Err(BagError::NoJointStates { reason }) if reason.starts_with("no topic") => None,
                Err(BagError::NoJointStates { reason }) if reason.starts_with("the joints") => {
                    with_joints += 1;
                    None
                }
                Err(e) => Some(e.to_string()),
            };
            complaints.extend(complaint.map(|told| format!("{}: {told}", path.display())));
            // An index lets what nobody asks for be passed over; without it all is walked through.
            if kind(path) == Some((Kind::Mcap, false)) {
                let walked = mcap_file::count_messages(&mut File::open(path).unwrap());
                let told = walked.as_ref().err().map(|e| format!("{}: {e}", path.display()));
                complaints.extend(told);
                let expected = fs::read_to_string(path.with_extension("json")).ok();
                if let (Some(expected), Ok(walked)) = (expected, walked) {
                    let expected = expected.matches("\"type\": \"Message\"").count();
                    assert_eq!(walked, expected, "{}", path.display());
                }
            }
        }
        println!("{} bags, {with_joints} with joint states", files.len());
        assert!(complaints.is_empty(), "{}", complaints.join("\n"));
        assert!(foreign.is_some() || with_joints == files.len(), "all of ours have joint states");
    }

    #[test]
    fn the_files_that_metadata_names_are_found_in_what_rosbag2_writes() {
        let metadata = "rosbag2_bagfile_information:\n  version: 9\n  relative_file_paths:\n    \
                        - pours_0.mcap\n    - old/pours_1.mcap\n    - \"pours 2.mcap\"\n  \
                        duration:\n    nanoseconds: 1\n";
        assert_eq!(named_files(metadata), ["pours_0.mcap", "pours_1.mcap", "pours 2.mcap"]);
        assert_eq!(named_files("  relative_file_paths: []\n"), Vec::<String>::new());
        assert_eq!(named_files(""), Vec::<String>::new());
    }
}
