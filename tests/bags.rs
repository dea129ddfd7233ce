//! Bags that other programs wrote are read as those programs read them, and damage is told and loses
//! only what is damaged.
#![cfg(feature = "bag")]
#![expect(clippy::unwrap_used, reason = "in a test a panic is the report")]

use std::fs;
use std::path::{Path, PathBuf};

use proptest::prelude::*;
use serde::Deserialize;
use tcvae::bag::{Bag, BagRecording};
use tcvae::demonstrations::recording::{Channels, GripperChannel, GripperSource};

/// What tests/golden/bags.py wrote, and what Python's libraries read in it.
#[derive(Deserialize)]
struct Expected {
    bags: Vec<String>,
    joints: Vec<String>,
    /// Stamp (ns) and angles.
    states: Vec<(i64, Vec<f64>)>,
    /// Time of the log (ns) and value.
    numbers: Vec<(i64, f64)>,
}

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/bags")
}

fn expected() -> Expected {
    serde_json::from_slice(&fs::read(folder().join("expected.json")).unwrap()).unwrap()
}

fn channels() -> Channels {
    let source =
        GripperSource { joint: None, topic: Some("/gripper".into()), closed: 0.0, open: 50.0 };
    let gripper = GripperChannel { name: "hand".into(), source };
    Channels { joints: expected().joints, grippers: vec![gripper], ..Channels::default() }
}

fn read(path: &Path) -> BagRecording {
    let bags = Bag::find(path).unwrap();
    assert_eq!(bags.len(), 1, "{bags:?}");
    bags[0].read(&channels()).unwrap()
}

#[test]
fn every_bag_is_read_as_python_reads_it() {
    let expected = expected();
    assert_eq!(expected.bags.len(), 14);
    let (start, _) = expected.states[0];
    for name in &expected.bags {
        let BagRecording { recording, messages, skipped, damage, .. } = read(&folder().join(name));
        assert_eq!((skipped, damage), (0, Vec::new()), "{name}");
        assert_eq!(messages, expected.states.len() + expected.numbers.len(), "{name}");
        assert_eq!(recording.id, *name);
        assert_eq!(recording.joint_names, expected.joints, "{name}");
        let positions: Vec<_> = expected.states.iter().map(|(_, q)| q.clone()).collect();
        assert_eq!(recording.positions, positions, "{name}");
        let times = expected.states.iter().map(|(stamp, _)| (stamp - start) as f64 * 1e-9);
        let apart = recording.times_secs.iter().zip(times).map(|(t, e)| (t - e).abs());
        assert!(apart.fold(0.0, f64::max) < 1e-9, "{name}");
        // 5 of 50 at first, which is the first that was heard.
        let hand = &recording.grippers[0].percent_open;
        assert_eq!((hand[0], hand[hand.len() - 1]), (10.0, 50.0), "{name}");
    }
}

#[test]
fn a_folder_of_bags_is_many_recordings_and_a_split_one_is_one() {
    let found = Bag::find(&folder()).unwrap();
    let names: Vec<_> = found.iter().map(|bag| bag.path.file_name().unwrap()).collect();
    assert_eq!(names.len(), 14, "{names:?}");
    let split = found.iter().find(|bag| bag.path.ends_with("sqlite_split")).unwrap();
    assert_eq!(split.files.len(), 3);
    assert!(split.files[1].ends_with("sqlite_split_1.db3"));
    assert_eq!(Bag::find(&folder().join("expected.json")).unwrap(), []);
}

#[test]
fn the_digest_is_of_what_was_read() {
    let digest = |name: &str| read(&folder().join(name)).digest;
    assert_eq!(digest("sqlite"), digest("sqlite_message"));
    assert_eq!(digest("zstd.mcap"), digest("no_index.mcap"));
    assert_eq!(digest("ros1.mcap"), digest("lz4.bag"));
    assert_ne!(digest("zstd.mcap"), digest("ros1.mcap"));
}

/// A copy of a file of the golden folder, edited.
fn edited(name: &str, edit: impl Fn(&mut Vec<u8>)) -> (tempfile::TempDir, PathBuf) {
    let mut bytes = fs::read(folder().join(name)).unwrap();
    edit(&mut bytes);
    let target = tempfile::tempdir().unwrap();
    let path = target.path().join(Path::new(name).file_name().unwrap());
    fs::write(&path, bytes).unwrap();
    (target, path)
}

#[test]
fn of_a_truncated_bag_what_comes_before_is_kept_and_the_damage_told() {
    for name in
        ["zstd.mcap", "no_chunks.mcap", "plain.mcap", "ros1.mcap", "none.bag", "bz2.bag", "lz4.bag"]
    {
        let (_folder, path) = edited(name, |bytes| bytes.truncate(bytes.len() * 3 / 5));
        let BagRecording { recording, damage, .. } = read(&path);
        let whole = read(&folder().join(name)).recording;
        let frames = recording.positions.len();
        assert!((2..whole.positions.len()).contains(&frames), "{name}: {frames}");
        assert_eq!(recording.positions, whole.positions[..frames], "{name}");
        assert!(damage[0].starts_with(&format!("{name}: after ")), "{damage:?}");
    }
}

#[test]
fn a_bag_that_is_none_and_one_without_joint_states_say_so() {
    let refusal =
        |path: &Path| Bag::find(path).unwrap()[0].read(&channels()).unwrap_err().to_string();
    for name in ["zstd.mcap", "none.bag", "sqlite/sqlite.db3", "sqlite_file/sqlite_file.db3.zstd"] {
        let (_folder, path) = edited(name, Vec::clear);
        let told = refusal(&path);
        assert!(told.contains(Path::new(name).file_name().unwrap().to_str().unwrap()), "{told}");
    }
    let (_folder, path) = edited("plain.mcap", |bytes| {
        // Every channel is of another type then.
        let name = b"sensor_msgs/msg/JointState";
        let places: Vec<_> =
            (0..bytes.len() - name.len()).filter(|&i| bytes[i..].starts_with(name)).collect();
        places.into_iter().for_each(|i| bytes[i] = b'x');
    });
    assert_eq!(
        refusal(&path),
        "no joint states can be read: no topic of the type sensor_msgs/JointState has a message"
    );
    let other = Channels { joints: vec!["a".into()], ..channels() };
    let told =
        Bag::find(&folder().join("sqlite")).unwrap()[0].read(&other).unwrap_err().to_string();
    assert!(told.contains("the joints in it are head_pan, left_e0, "), "{told}");
    assert!(told.ends_with("; a are looked for"), "{told}");
}

#[test]
fn a_record_that_is_longer_than_its_chunk_ends_it() {
    let (_folder, path) = edited("plain.mcap", |bytes| {
        // No index, so that the file is walked through; and the length of its eleventh message is larger.
        let end = bytes.len();
        bytes[end - 28..end - 12].fill(0);
        let is_message =
            |i: &usize| bytes[*i] == 5 && bytes[i + 3..i + 9] == [0; 6] && bytes[i + 1] > 22;
        let place = (0..end - 9).filter(is_message).nth(10).unwrap();
        bytes[place + 3] = 0xff;
    });
    let BagRecording { recording, damage, .. } = read(&path);
    assert!((1..30).contains(&recording.positions.len()), "{recording:?}");
    assert!(damage[0].ends_with("it ends in the middle of a record"), "{damage:?}");
}

/// A bag with the messages of another, edited: the time of the log and of publishing, and the data.
fn rewritten(name: &str, edit: impl Fn(u64, &[u8]) -> (u64, u64, Vec<u8>)) -> tempfile::TempDir {
    written(name, mcap::WriteOptions::new(), edit)
}

fn written(
    name: &str,
    options: mcap::WriteOptions,
    edit: impl Fn(u64, &[u8]) -> (u64, u64, Vec<u8>),
) -> tempfile::TempDir {
    let bytes = fs::read(folder().join(name)).unwrap();
    let target = tempfile::tempdir().unwrap();
    let file = fs::File::create(target.path().join("edited.mcap")).unwrap();
    let mut writer = options.create(file).unwrap();
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        let (log_time, publish_time, data) = edit(message.log_time, &message.data);
        writer
            .write(&mcap::Message { log_time, publish_time, data: data.into(), ..message })
            .unwrap();
    }
    writer
        .attach(&mcap::Attachment {
            log_time: 1,
            create_time: 1,
            name: "calibration".into(),
            media_type: "text/plain".into(),
            data: b"0".repeat(10_000).into(),
        })
        .unwrap();
    writer.finish().unwrap();
    target
}

#[test]
fn what_fuzzing_found_stays_mended() {
    let found = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/regressions/mcap");
    let target = tempfile::tempdir().unwrap();
    let path = target.path().join("one.mcap");
    let mut count = 0;
    for file in fs::read_dir(found).unwrap() {
        fs::copy(file.unwrap().path(), &path).unwrap();
        // What the fuzz targets ask for; whether something of it can be read is of no matter.
        let joints = ["a", "b"].map(String::from).to_vec();
        let channels = Channels { joints, ..Channels::default() };
        if let Ok(read) = Bag::find(&path).unwrap()[0].read(&channels) {
            assert!(read.recording.times_secs.is_sorted_by(|a, b| a < b));
        }
        count += 1;
    }
    assert!(count >= 2);
}

#[test]
fn an_index_that_does_not_say_what_the_channels_are_is_done_without() {
    let whole = read(&folder().join("plain.mcap")).recording;
    for (schemas, channels) in [(true, true), (false, true), (true, false), (false, false)] {
        for compression in [None, Some(mcap::Compression::Zstd)] {
            let options = mcap::WriteOptions::new()
                .repeat_schemas(schemas)
                .repeat_channels(channels)
                .compression(compression);
            let folder = written("plain.mcap", options, |log, data| (log, log, data.to_vec()));
            let BagRecording { recording, damage, .. } = read(&folder.path().join("edited.mcap"));
            assert_eq!((recording.positions, damage), (whole.positions.clone(), Vec::new()));
        }
    }
}

#[test]
fn messages_that_rosbag2_compressed_one_by_one_are_read_in_mcap_too() {
    let folder =
        rewritten("plain.mcap", |log, data| (log, log, zstd::encode_all(data, 3).unwrap()));
    let BagRecording { recording, skipped, damage, .. } = read(&folder.path().join("edited.mcap"));
    let whole = read(&self::folder().join("plain.mcap")).recording;
    assert_eq!((recording.positions, recording.times_secs), (whole.positions, whole.times_secs));
    assert_eq!((skipped, damage), (0, Vec::new()));
}

#[test]
fn without_times_of_the_log_those_of_publishing_count_or_else_the_stamps() {
    let whole = read(&folder().join("plain.mcap")).recording;
    for publishes in [true, false] {
        let edit = |log, data: &[u8]| (0, if publishes { log } else { 0 }, data.to_vec());
        let folder = rewritten("plain.mcap", edit);
        let recording = read(&folder.path().join("edited.mcap")).recording;
        assert_eq!(recording.times_secs, whole.times_secs, "{publishes}");
        assert_eq!(recording.positions, whole.positions, "{publishes}");
    }
}

#[test]
fn metadata_says_which_files_are_one_recording_and_what_is_missing_of_it() {
    let target = tempfile::tempdir().unwrap();
    let path = target.path().join("session");
    fs::create_dir(&path).unwrap();
    for part in 0..3 {
        let from = folder().join(format!("sqlite_split/sqlite_split_{part}.db3"));
        fs::copy(from, path.join(["z.db3", "b.db3", "c.db3"][part])).unwrap();
    }
    let write = |names: &[&str]| {
        let names: String = names.iter().map(|name| format!("    - {name}\n")).collect();
        let text = format!("rosbag2_bagfile_information:\n  relative_file_paths:\n{names}  a: b\n");
        fs::write(path.join("metadata.yaml"), text).unwrap();
    };
    write(&["z.db3", "session/b.db3", "c.db3"]);
    let whole = read(&folder().join("sqlite_split"));
    let BagRecording { recording, damage, digest, .. } = read(&path);
    assert_eq!((&recording.positions, damage), (&whole.recording.positions, Vec::new()));
    assert_eq!(digest, whole.digest, "in the order of metadata.yaml");

    // What it does not name is another recording, and what is not there is told.
    write(&["z.db3", "a.db3.zstd", "b.db3.zstd"]);
    let bags = Bag::find(&path).unwrap();
    let files: Vec<_> = bags.iter().map(|bag| bag.files.len()).collect();
    assert_eq!(files, [2, 1], "{bags:?}");
    let damage = bags[0].read(&channels()).unwrap().damage;
    assert_eq!(damage[0], "metadata.yaml names a.db3.zstd, which is not there");
    fs::remove_file(path.join("metadata.yaml")).unwrap();
    assert_eq!(Bag::find(&path).unwrap().len(), 3);
}

#[test]
fn a_database_that_was_not_closed_is_read_with_its_log() {
    let (_folder, path) = edited("sqlite/sqlite.db3", |_| {});
    let whole = read(&path).recording;
    let writer = rusqlite::Connection::open(&path).unwrap();
    writer.pragma_update(None, "journal_mode", "WAL").unwrap();
    writer.pragma_update(None, "wal_autocheckpoint", 0).unwrap();
    let copied = writer
        .execute(
            "INSERT INTO messages (topic_id, timestamp, data)
             SELECT topic_id, timestamp + 1, data FROM messages",
            [],
        )
        .unwrap();
    let log = path.with_extension("db3-wal");
    assert!(fs::metadata(&log).unwrap().len() > 10_000, "the rows are in the log alone");
    // As a crash leaves it, and while it is written to.
    let crashed = tempfile::tempdir().unwrap();
    let copy = crashed.path().join("sqlite.db3");
    fs::copy(&path, &copy).unwrap();
    fs::copy(&log, copy.with_extension("db3-wal")).unwrap();
    for path in [&path, &copy] {
        let BagRecording { recording, messages, skipped, .. } = read(path);
        assert_eq!(recording.positions, whole.positions);
        // Its own table has the rows of the camera too.
        assert!(skipped > 0 && messages < 2 * copied, "{messages} of {copied}");
        assert_eq!(messages, 2 * (expected().states.len() + expected().numbers.len()));
    }
}

#[cfg(unix)]
#[test]
fn a_database_in_a_folder_that_cant_be_written_to_is_read_and_its_log_missed() {
    let target = tempfile::tempdir().unwrap();
    let path = target.path().join("one#1?.db3");
    fs::copy(folder().join("sqlite/sqlite.db3"), &path).unwrap();
    let writer = rusqlite::Connection::open(&path).unwrap();
    writer.pragma_update(None, "journal_mode", "WAL").unwrap();
    drop(writer);
    // Root may write to any folder, but not where a link leads nowhere.
    std::os::unix::fs::symlink("nowhere/x", path.with_extension("db3-shm")).unwrap();
    let whole = read(&folder().join("sqlite"));
    let BagRecording { recording, damage, .. } = read(&path);
    assert_eq!((&recording.positions, damage), (&whole.recording.positions, Vec::new()));
    assert_eq!(fs::read_dir(target.path()).unwrap().count(), 2, "nothing is written beside it");
    fs::write(path.with_extension("db3-wal"), "rows").unwrap();
    let BagRecording { recording, damage, .. } = read(&path);
    assert_eq!(recording.positions, whole.recording.positions);
    assert!(damage[0].contains("what is in its -wal file alone is left out"), "{damage:?}");
}

#[test]
fn a_database_of_which_a_query_would_not_end_is_refused() {
    let (_folder, path) = edited("sqlite/sqlite.db3", |_| {});
    let connection = rusqlite::Connection::open(&path).unwrap();
    connection
        .execute_batch(
            "ALTER TABLE messages RENAME TO others;
             CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n)
             SELECT id, 1 AS topic_id, 5 AS timestamp, x'00' AS data FROM n;",
        )
        .unwrap();
    drop(connection);
    let told = Bag::find(&path).unwrap()[0].read(&channels()).unwrap_err().to_string();
    assert!(told.ends_with("it has no table \"messages\", which rosbag2 writes"), "{told}");
}

#[cfg(unix)]
#[test]
fn links_in_circles_are_followed_once_and_pipes_are_no_bags() {
    use std::os::unix::fs::symlink;
    let target = tempfile::tempdir().unwrap();
    let path = target.path();
    fs::copy(folder().join("zstd.mcap"), path.join("one.mcap")).unwrap();
    for i in 0..60 {
        symlink(".", path.join(format!("again{i}"))).unwrap();
    }
    symlink("nowhere", path.join("gone.mcap")).unwrap();
    let pipe = path.join("pipe.mcap");
    assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    let found = Bag::find(path).unwrap();
    assert_eq!(found.len(), 1, "{found:?}");
    assert_eq!(Bag::find(&pipe).unwrap(), []);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 150, ..ProptestConfig::default() })]

    /// Whatever is flipped, nothing panics, and frames that are kept have finite values in order.
    #[test]
    fn flipped_bytes_never_panic(
        which in 0..9_usize,
        flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..8),
        keep in 0.3..1.0_f64,
    ) {
        let name = [
            "zstd.mcap", "lz4.mcap", "no_chunks.mcap", "ros1.mcap", "sqlite/sqlite.db3",
            "sqlite_message/sqlite_message.db3", "none.bag", "bz2.bag", "lz4.bag",
        ][which];
        let (_folder, path) = edited(name, |bytes| {
            let kept = (bytes.len() as f64 * keep) as usize;
            bytes.truncate(kept);
            for (place, value) in &flips {
                let i = place.index(bytes.len());
                bytes[i] = *value;
            }
        });
        if let Ok(read) = Bag::find(&path).unwrap()[0].read(&channels()) {
            let times = &read.recording.times_secs;
            prop_assert!(times.is_sorted_by(|a, b| a < b));
            prop_assert!(read.recording.positions.iter().flatten().all(|q| q.is_finite()));
        }
    }
}
