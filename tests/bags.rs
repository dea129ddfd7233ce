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
