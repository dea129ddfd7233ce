//! What the fuzz targets share: where their files are, what is asked for, and what must hold of whatever is
//! read.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use tcvae::bag::Bag;
use tcvae::demonstrations::recording::{
    Channels, GripperChannel, GripperSource, JointRecording,
};

/// A folder for this process.
pub fn folder() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| tempfile::tempdir().expect("a folder").keep())
}

/// A file in that folder.
pub fn file(name: &str, data: &[u8]) -> PathBuf {
    let path = folder().join(name);
    fs::write(&path, data).expect("written");
    path
}

/// Two joints and a gripper, as the seeds have them.
pub fn channels() -> Channels {
    let source = GripperSource {
        joint: Some("f".into()),
        topic: Some("/g".into()),
        closed: 0.0,
        open: 50.0,
    };
    let gripper = GripperChannel { name: "g".into(), source };
    let joints = ["a", "b"].map(String::from).to_vec();
    Channels { joints, grippers: vec![gripper], ..Channels::default() }
}

/// Reads a bag of that name.
pub fn bag(name: &str, data: &[u8]) {
    let path = file(name, data);
    for bag in Bag::find(&path).expect("a file that is there") {
        if let Ok(read) = bag.read(&channels()) {
            check(&read.recording);
        }
    }
}

/// Times increase, and a frame has every joint.
pub fn check(recording: &JointRecording) {
    let JointRecording { times_secs, joint_names, positions, grippers, .. } = recording;
    assert!(times_secs.is_sorted_by(|a, b| a < b));
    assert_eq!(times_secs.len(), positions.len());
    let frames = positions.iter().all(|frame| frame.len() == joint_names.len());
    assert!(frames && positions.iter().flatten().all(|angle| angle.is_finite()));
    assert!(grippers.iter().all(|gripper| gripper.percent_open.len() == times_secs.len()));
}
