//! Recordings as MCAP files, as MCAP's ROS 2 profile has them, so that `ros2 bag`, Foxglove and others read them.
//!
//! A recording grows beside its place, as `NAME.partial.mcap`, and is moved there when it is whole. What is
//! in it at any time ends with a whole chunk, so a program that is killed leaves what it wrote until then.

use std::collections::BTreeMap;
use std::fs::{self, File, TryLockError};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use mcap::{McapError, WriteOptions, Writer};

/// What the file says wrote it.
const LIBRARY: &str = concat!("tcvae ", env!("CARGO_PKG_VERSION"));

/// Bytes of messages after which a chunk ends.
const CHUNK: u64 = 1 << 20;

/// Why a recording can't be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BagWriteError {
    /// The name is none of an MCAP file.
    #[error("{}: a recording is an MCAP file, so its name ends with .mcap", path.display())]
    Name {
        /// The file.
        path: PathBuf,
    },
    /// There is a file already.
    #[error("{}: it is there already; --force replaces it, or choose another name", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// What an interrupted recording left is there.
    #[error(
        "{}: a recording that was interrupted left it. Look at it with tcvae inspect, and move it away, or \
         replace it with --force",
        path.display()
    )]
    Partial {
        /// The file.
        path: PathBuf,
    },
    /// Another program records to the same place.
    #[error("{}: another program is recording there; wait for it, or choose another name", path.display())]
    Busy {
        /// The file.
        path: PathBuf,
    },
    /// A file can't be opened.
    #[error("{}: {source}", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// Writing failed, as on a full disk.
    #[error(
        "{}: {reason}, so the recording ended; {messages} messages at least are in that file",
        path.display()
    )]
    Write {
        /// The file that holds what was written until then.
        path: PathBuf,
        /// What is wrong.
        reason: String,
        /// Messages that are in whole chunks.
        messages: u64,
    },
}

/// How chunks are compressed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Compression {
    /// With Zstandard, at its default level.
    #[default]
    Zstd,
    /// Not at all.
    None,
}

/// How a publisher offers its messages, as far as it matters for playing them again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct OfferedQos {
    /// Whether messages that are lost are sent again.
    pub reliable: bool,
    /// Whether who joins late receives the latest.
    pub transient_local: bool,
}

/// A topic of the recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct TopicId(u16);

/// One message, as bytes.
#[derive(Debug, Clone, Copy)]
pub struct RawMessage<'a> {
    /// When it was received, since the epoch.
    pub log_nanos: u64,
    /// When it was sent, since the epoch.
    pub publish_nanos: u64,
    /// The publisher's number for it.
    pub sequence: u32,
    /// CDR, with its four bytes ahead.
    pub data: &'a [u8],
}

/// A recording that is being written. Dropped before [`finish`](Self::finish), it stays where it grew.
pub struct BagWriter<W: Write = BufWriter<File>> {
    writer: Writer<NoSeek<W>>,
    path: PathBuf,
    partial: PathBuf,
    force: bool,
    /// Messages in all, and those in chunks that are on disk.
    written: u64,
    flushed: u64,
}

impl BagWriter {
    /// Begins a recording.
    ///
    /// # Errors
    /// A file is there already, or of a recording that was interrupted, unless `force` says to replace it;
    /// another program records there; the file can't be made.
    pub fn create(
        path: &Path,
        compression: Compression,
        force: bool,
    ) -> Result<Self, BagWriteError> {
        let partial = partial(path)?;
        let open = |source| BagWriteError::Open { path: partial.clone(), source };
        if path.is_dir() || (path.exists() && !force) {
            return Err(BagWriteError::Exists { path: path.into() });
        }
        let file = File::options().write(true).create(true).truncate(false).open(&partial);
        let file = file.map_err(open)?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(BagWriteError::Busy { path: partial }),
            // Some file systems know no locks.
            Err(TryLockError::Error(_)) => {}
        }
        if file.metadata().map_err(open)?.len() > 0 && !force {
            return Err(BagWriteError::Partial { path: partial });
        }
        file.set_len(0).map_err(open)?;
        Self::on(BufWriter::new(file), compression, path, partial, force)
    }

    /// Ends the recording, and moves it to its place.
    ///
    /// # Errors
    /// Writing failed, or somebody else put a file there.
    pub fn finish(mut self) -> Result<(), BagWriteError> {
        let finished = self.writer.finish();
        let Self { writer, path, partial, force, written, flushed } = self;
        let failed = |reason: String| BagWriteError::Write {
            path: partial.clone(),
            reason,
            messages: flushed,
        };
        finished.map_err(|e| failed(reason(&e)))?;
        let file = writer.into_inner().into_inner().into_inner();
        let file = file.map_err(|e| failed(e.to_string()))?;
        file.sync_all().map_err(|e| failed(e.to_string()))?;
        let failed = |reason: String| BagWriteError::Write {
            path: partial.clone(),
            reason,
            messages: written,
        };
        if path.exists() && !force {
            return Err(failed(format!("it is whole, but {} is there by now", path.display())));
        }
        fs::rename(&partial, &path).map_err(|e| failed(format!("it can't be moved: {e}")))
    }

    /// Leaves nothing of the recording.
    pub fn discard(self) {
        // Nothing more is to be done where it can't be removed.
        let _ = fs::remove_file(&self.partial);
    }
}

impl<W: Write> BagWriter<W> {
    fn on(
        sink: W,
        compression: Compression,
        path: &Path,
        partial: PathBuf,
        force: bool,
    ) -> Result<Self, BagWriteError> {
        let options = WriteOptions::new()
            .profile("ros2")
            .library(LIBRARY)
            .compression(match compression {
                Compression::Zstd => Some(mcap::Compression::Zstd),
                Compression::None => None,
            })
            .compression_threads(0)
            .chunk_size(Some(CHUNK))
            // A chunk is written in one go, and never changed.
            .disable_seeking(true);
        let writer = options.create(NoSeek::new(sink)).map_err(|e| BagWriteError::Write {
            path: partial.clone(),
            reason: reason(&e),
            messages: 0,
        })?;
        Ok(Self { writer, path: path.into(), partial, force, written: 0, flushed: 0 })
    }

    /// Where the recording grows.
    pub fn partial(&self) -> &Path {
        &self.partial
    }

    /// Adds a topic.
    ///
    /// # Arguments
    /// * `type_name`: such as `sensor_msgs/msg/JointState`
    /// * `definition`: of the type with all that it is made of, where it is known
    /// * `offered`: how its publishers offer it
    ///
    /// # Errors
    /// Writing failed.
    pub fn topic(
        &mut self,
        name: &str,
        type_name: &str,
        definition: Option<&str>,
        offered: &[OfferedQos],
    ) -> Result<TopicId, BagWriteError> {
        let encoding = if definition.is_some() { "ros2msg" } else { "" };
        let text = definition.unwrap_or_default().as_bytes();
        let metadata = BTreeMap::from([("offered_qos_profiles".to_owned(), profiles(offered))]);
        let schema = self.writer.add_schema(type_name, encoding, text);
        let channel =
            schema.and_then(|schema| self.writer.add_channel(schema, name, "cdr", &metadata));
        channel.map(TopicId).map_err(|e| self.failed(&e))
    }

    /// Adds a message.
    ///
    /// # Errors
    /// Writing failed.
    pub fn write(&mut self, topic: TopicId, message: RawMessage<'_>) -> Result<(), BagWriteError> {
        let RawMessage { log_nanos, publish_nanos, sequence, data } = message;
        let header = MessageHeader {
            channel_id: topic.0,
            sequence,
            log_time: log_nanos,
            publish_time: publish_nanos,
        };
        self.writer.write_to_known_channel(&header, data).map_err(|e| self.failed(&e))?;
        self.written += 1;
        Ok(())
    }

    /// Ends the present chunk, so that what was written is on disk.
    ///
    /// # Errors
    /// Writing failed.
    pub fn flush(&mut self) -> Result<(), BagWriteError> {
        self.writer.flush().map_err(|e| self.failed(&e))?;
        self.flushed = self.written;
        Ok(())
    }

    fn failed(&self, error: &McapError) -> BagWriteError {
        BagWriteError::Write {
            path: self.partial.clone(),
            reason: reason(error),
            messages: self.flushed,
        }
    }
}

/// What went wrong, as the system says where it is the system.
fn reason(error: &McapError) -> String {
    match error {
        McapError::Io(error) => error.to_string(),
        error => error.to_string(),
    }
}

/// Where a recording grows: `pours.partial.mcap` for `pours.mcap`.
fn partial(path: &Path) -> Result<PathBuf, BagWriteError> {
    let stem =
        path.file_name().and_then(|name| name.to_str()).and_then(|n| n.strip_suffix(".mcap"));
    match stem {
        Some(stem) if !stem.is_empty() => Ok(path.with_file_name(format!("{stem}.partial.mcap"))),
        _ => Err(BagWriteError::Name { path: path.into() }),
    }
}

/// As `rosbag2` has it in channels, with the numbers of its policies, which every version of it reads. It
/// plays a topic again as its publishers offered it.
fn profiles(offered: &[OfferedQos]) -> String {
    const INFINITE: &str = "\n    sec: 9223372036\n    nsec: 854775807";
    let profile = |OfferedQos { reliable, transient_local }: &OfferedQos| {
        let reliability = if *reliable { 1 } else { 2 };
        let durability = if *transient_local { 1 } else { 2 };
        format!(
            "- history: 3\n  depth: 0\n  reliability: {reliability}\n  durability: {durability}\n  \
             deadline:{INFINITE}\n  lifespan:{INFINITE}\n  liveliness: 1\n  \
             liveliness_lease_duration:{INFINITE}\n  avoid_ros_namespace_conventions: false"
        )
    };
    match offered {
        [] => String::new(),
        offered => offered.iter().map(profile).collect::<Vec<_>>().join("\n"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bag::Bag;
    use crate::demonstrations::recording::Channels;

    const BOTH: [OfferedQos; 2] = [
        OfferedQos { reliable: true, transient_local: true },
        OfferedQos { reliable: false, transient_local: false },
    ];

    /// `{name: [a], position: [at]}` of `sensor_msgs/msg/JointState`.
    fn joint_state(at: f64) -> Vec<u8> {
        let mut data = vec![0, 1, 0, 0];
        for n in [0_u32, 0, 1, 0, 1, 2] {
            data.extend(n.to_le_bytes());
        }
        data.extend(b"a\0\0\0");
        data.extend(1_u32.to_le_bytes());
        data.extend(at.to_le_bytes());
        data.extend([0; 8]);
        data
    }

    fn message(data: &[u8], n: u64) -> RawMessage<'_> {
        RawMessage { log_nanos: n * 10_000_000, publish_nanos: n, sequence: n as u32, data }
    }

    fn record<W: Write>(bag: &mut BagWriter<W>, count: u64) -> Result<(), BagWriteError> {
        let topic = bag.topic("/joint_states", "sensor_msgs/msg/JointState", None, &BOTH)?;
        for n in 0..count {
            bag.write(topic, message(&joint_state(n as f64), n))?;
        }
        bag.flush()
    }

    fn positions(path: &Path) -> Vec<Vec<f64>> {
        let channels = Channels { joints: vec!["a".into()], ..Channels::default() };
        let bags = Bag::find(path).unwrap();
        assert_eq!(bags.len(), 1);
        bags[0].read(&channels).unwrap().recording.positions
    }

    #[test]
    fn a_recording_is_at_its_place_only_when_it_is_whole() {
        for compression in [Compression::Zstd, Compression::None] {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("a.mcap");
            let mut bag = BagWriter::create(&path, compression, false).unwrap();
            let partial = bag.partial().to_owned();
            assert_eq!(partial, folder.path().join("a.partial.mcap"));
            record(&mut bag, 5).unwrap();
            // As a program that is killed now leaves it.
            assert!(!path.exists());
            assert_eq!(positions(&partial).len(), 5);
            bag.finish().unwrap();
            assert!(!partial.exists());
            assert_eq!(positions(&path), [[0.0], [1.0], [2.0], [3.0], [4.0]]);
        }
    }

    #[test]
    fn what_is_there_is_not_replaced_unless_asked_for() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mcap");
        let create = |force| BagWriter::create(&path, Compression::Zstd, force);
        let first = create(false).unwrap();
        assert!(matches!(create(true), Err(BagWriteError::Busy { .. })));
        drop(first);
        // It holds a header, as of a program that was killed.
        assert!(matches!(create(false), Err(BagWriteError::Partial { .. })));
        let mut again = create(true).unwrap();
        record(&mut again, 1).unwrap();
        again.finish().unwrap();
        assert!(matches!(create(false), Err(BagWriteError::Exists { .. })));
        create(true).unwrap().discard();
        assert_eq!(positions(&path).len(), 1);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
        let other = BagWriter::create(&folder.path().join("a.bag"), Compression::Zstd, false);
        assert!(matches!(other, Err(BagWriteError::Name { .. })));
    }

    #[test]
    fn a_full_disk_is_told_with_what_is_left() {
        struct Disk(usize);
        impl Write for Disk {
            fn write(&mut self, data: &[u8]) -> io::Result<usize> {
                if self.0 < data.len() {
                    return Err(io::ErrorKind::StorageFull.into());
                }
                self.0 -= data.len();
                Ok(data.len())
            }
            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        let (path, partial) = (Path::new("a.mcap"), PathBuf::from("a.partial.mcap"));
        let mut bag = BagWriter::on(Disk(2000), Compression::None, path, partial, false).unwrap();
        record(&mut bag, 3).unwrap();
        let error = record(&mut bag, 300).unwrap_err().to_string();
        assert!(error.starts_with("a.partial.mcap: no storage space, so"), "{error}");
        assert!(error.contains("; 3 messages at least"), "{error}");
    }

    #[test]
    fn a_topic_says_how_it_was_offered_and_what_its_messages_are() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mcap");
        let mut bag = BagWriter::create(&path, Compression::Zstd, false).unwrap();
        let latched = bag.topic("/x", "std_msgs/msg/Bool", Some("bool data\n"), &BOTH[..1]);
        bag.write(latched.unwrap(), message(&[0, 1, 0, 0, 1], 7)).unwrap();
        bag.finish().unwrap();
        let data = fs::read(&path).unwrap();
        let summary = mcap::Summary::read(&data).unwrap().unwrap();
        let channel = summary.channels.values().next().unwrap();
        let schema = channel.schema.as_ref().unwrap();
        assert_eq!(
            (schema.name.as_str(), schema.encoding.as_str()),
            ("std_msgs/msg/Bool", "ros2msg")
        );
        assert_eq!(&schema.data[..], b"bool data\n");
        let profile = &channel.metadata["offered_qos_profiles"];
        assert!(profile.contains("reliability: 1\n  durability: 1\n"), "{profile}");
        assert_eq!(profiles(&[]), "");
    }
}
