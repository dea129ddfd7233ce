//! Motions of a robot's tip as a recording that others play: poses, paths, transforms and joint states.

use std::path::Path;

use nalgebra::Isometry3;

use super::definitions::definition;
use super::writer::{BagWriteError, BagWriter, Compression, OfferedQos, RawMessage, TopicId};

/// Nanoseconds at which the first motion starts. Some programs take 0 for no time.
const START_NANOS: u64 = 1_000_000_000;
/// Nanoseconds between two motions.
const PAUSE_NANOS: u64 = 1_000_000_000;

/// A motion to write.
#[derive(Debug, Clone, PartialEq)]
pub struct PlayedMotion {
    /// What there is to say of it, JSON.
    pub about: String,
    /// Time of each pose, ascending.
    pub times_secs: Vec<f64>,
    /// The tip in the base frame.
    pub base_from_tip: Vec<Isometry3<f64>>,
    /// Joint positions at each pose; empty where there are none.
    pub joint_positions: Vec<Vec<f64>>,
}

/// Whose motions they are.
#[derive(Debug, Clone, PartialEq)]
pub struct PlayedRobot {
    /// The frame of the poses.
    pub base_frame: String,
    /// The link whose pose it is.
    pub tip_frame: String,
    /// Names of the joints, in the order of their positions; empty where there are none.
    pub joint_names: Vec<String>,
    /// Its URDF, where it is known.
    pub description: Option<String>,
}

/// Writes motions one after the other, a second apart, replacing what is there.
///
/// # Topics
/// `/motion` (`std_msgs/String`, what there is to say of a motion, at its start), `/tip_path`
/// (`nav_msgs/Path`, likewise), `/tip_pose` (`geometry_msgs/PoseStamped`), `/tf` (from the base to
/// `TIP_of_motion`), and, of robots with joints, `/joint_states` and `/robot_description`. Everything happens from 1 s after the epoch on.
///
/// # Errors
/// The file can't be written; its name does not end with `.mcap`.
pub fn write_motions(
    path: &Path,
    robot: &PlayedRobot,
    motions: &[PlayedMotion],
) -> Result<(), BagWriteError> {
    let mut bag = BagWriter::create(path, Compression::Zstd, true)?;
    let latched = OfferedQos { reliable: true, transient_local: true };
    let live = OfferedQos { reliable: true, transient_local: false };
    let topic = |bag: &mut BagWriter, name: &str, type_name: &str, qos| {
        bag.topic(name, type_name, definition(type_name, |_| None).as_deref(), &[qos])
    };
    let about = topic(&mut bag, "/motion", "std_msgs/msg/String", latched)?;
    let paths = topic(&mut bag, "/tip_path", "nav_msgs/msg/Path", latched)?;
    let poses = topic(&mut bag, "/tip_pose", "geometry_msgs/msg/PoseStamped", live)?;
    let transforms = topic(&mut bag, "/tf", "tf2_msgs/msg/TFMessage", live)?;
    let joints = match robot.joint_names.is_empty() {
        true => None,
        false => Some(topic(&mut bag, "/joint_states", "sensor_msgs/msg/JointState", live)?),
    };
    let mut sequence = 0;
    let mut write = |bag: &mut BagWriter, topic: TopicId, nanos: u64, data: Vec<u8>| {
        sequence += 1;
        let message = RawMessage { log_nanos: nanos, publish_nanos: nanos, sequence, data: &data };
        bag.write(topic, message)
    };
    if let Some(text) = &robot.description {
        let description = topic(&mut bag, "/robot_description", "std_msgs/msg/String", latched)?;
        write(&mut bag, description, START_NANOS, Cdr::new().string(text).done())?;
    }
    let base = robot.base_frame.as_str();
    // Not the robot's own frame, which its joints move when the recording is played to it.
    let moving = format!("{}_of_motion", robot.tip_frame);
    let mut start = START_NANOS;
    for motion in motions {
        let at = |secs: f64| start + (secs * 1e9).round() as u64;
        write(&mut bag, about, start, Cdr::new().string(&motion.about).done())?;
        let mut path = Cdr::new().header(start, base).count(motion.base_from_tip.len());
        for (secs, pose) in motion.times_secs.iter().zip(&motion.base_from_tip) {
            path = path.header(at(*secs), base).pose(pose);
        }
        write(&mut bag, paths, start, path.done())?;
        for (i, (secs, pose)) in motion.times_secs.iter().zip(&motion.base_from_tip).enumerate() {
            let nanos = at(*secs);
            write(&mut bag, poses, nanos, Cdr::new().header(nanos, base).pose(pose).done())?;
            let transform = Cdr::new().count(1).header(nanos, base).string(&moving);
            write(&mut bag, transforms, nanos, transform.pose(pose).done())?;
            if let (Some(topic), Some(positions)) = (joints, motion.joint_positions.get(i)) {
                let mut state = Cdr::new().header(nanos, "").count(robot.joint_names.len());
                for name in &robot.joint_names {
                    state = state.string(name);
                }
                let state = state.numbers(positions).numbers(&[]).numbers(&[]);
                write(&mut bag, topic, nanos, state.done())?;
            }
        }
        start = at(motion.times_secs.last().copied().unwrap_or(0.0)) + PAUSE_NANOS;
    }
    bag.finish()
}

/// A message in CDR, little-endian.
struct Cdr(Vec<u8>);

impl Cdr {
    /// Bytes ahead of the content, which alignment does not count.
    const AHEAD: usize = 4;

    fn new() -> Self {
        Self(vec![0, 1, 0, 0])
    }

    fn aligned(mut self, to: usize) -> Self {
        while !(self.0.len() - Self::AHEAD).is_multiple_of(to) {
            self.0.push(0);
        }
        self
    }

    fn u32(self, value: u32) -> Self {
        let mut cdr = self.aligned(4);
        cdr.0.extend(value.to_le_bytes());
        cdr
    }

    fn count(self, value: usize) -> Self {
        self.u32(u32::try_from(value).expect("a message has less than 2^32 elements"))
    }

    fn f64(self, value: f64) -> Self {
        let mut cdr = self.aligned(8);
        cdr.0.extend(value.to_le_bytes());
        cdr
    }

    fn string(self, text: &str) -> Self {
        let mut cdr = self.count(text.len() + 1);
        cdr.0.extend(text.as_bytes());
        cdr.0.push(0);
        cdr
    }

    fn numbers(self, values: &[f64]) -> Self {
        values.iter().fold(self.count(values.len()), |cdr, value| cdr.f64(*value))
    }

    fn header(self, nanos: u64, frame: &str) -> Self {
        let (secs, nanos) = (nanos / 1_000_000_000, nanos % 1_000_000_000);
        self.u32(secs as u32).u32(nanos as u32).string(frame)
    }

    /// A pose, or a transform: position and orientation.
    fn pose(self, pose: &Isometry3<f64>) -> Self {
        let (p, q) = (pose.translation.vector, pose.rotation);
        [p.x, p.y, p.z, q.i, q.j, q.k, q.w].into_iter().fold(self, Self::f64)
    }

    fn done(self) -> Vec<u8> {
        self.0
    }
}
