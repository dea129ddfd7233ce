//! From messages to a recording: joint angles that came bit by bit, from one publisher or several, become
//! frames of all joints.
//!
//! Messages have two times: the publisher's stamp, and when they were logged. A publisher's stamps are
//! used where they are a clock, moved as a whole to the log's; else the log's times are. Messages may
//! come out of order, and twice.

use std::collections::{BTreeMap, BTreeSet};

use super::recording::{Channels, GripperRecording, JointRecording};

/// Stamps are no clock when their span differs from the log's by more than this, and by more than
/// [`SPAN_SHARE`] of it.
const SPAN_NANOS: i64 = 1_000_000_000;
/// See [`SPAN_NANOS`].
const SPAN_SHARE: f64 = 0.1;

/// Names of joints that nobody asks for which are kept, to tell what there is instead.
const OTHER_JOINTS: usize = 64;

/// When a message was sent, in nanoseconds of two clocks that need not agree.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MessageTime {
    /// When it was logged.
    pub log_nanos: i64,
    /// The publisher's stamp; none in a message without one, or where it was left at 0.
    pub stamp_nanos: Option<i64>,
}

/// Messages of a recording, as they are read.
#[derive(Debug)]
pub struct JointMessages<'a> {
    channels: &'a Channels,
    /// When each publisher sent its messages.
    publishers: BTreeMap<String, Vec<MessageTime>>,
    /// What each publisher said of each joint, rad.
    joints: Vec<BTreeMap<String, Track>>,
    /// What each publisher said of each gripper, per cent open.
    grippers: Vec<BTreeMap<String, Track>>,
    other_joints: BTreeSet<String>,
    not_finite: usize,
}

/// What one publisher said of one thing: numbers of its messages, and the values in them.
#[derive(Debug, Clone, Default)]
struct Track {
    messages: Vec<usize>,
    values: Vec<f64>,
}

/// A recording, and what was left out of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Assembled {
    /// The recording.
    pub recording: JointRecording,
    /// Joints that are not asked for, or the first 64 of them.
    pub other_joints: Vec<String>,
    /// Values that are no finite number.
    pub not_finite: usize,
    /// Frames at a time that an earlier one has.
    pub doubled: usize,
    /// Frames before all joints were heard of first, or after one was last.
    pub incomplete: usize,
}

impl<'a> JointMessages<'a> {
    /// No message so far.
    pub fn new(channels: &'a Channels) -> Self {
        let tracks = |count| vec![BTreeMap::new(); count];
        let (joints, grippers) = (tracks(channels.joints.len()), tracks(channels.grippers.len()));
        let (publishers, other_joints) = (BTreeMap::new(), BTreeSet::new());
        Self { channels, publishers, joints, grippers, other_joints, not_finite: 0 }
    }

    /// Takes the angles of one message; those of joints that are not asked for are left out.
    pub fn joint_states(
        &mut self,
        publisher: &str,
        time: MessageTime,
        names: &[String],
        positions: &[f64],
    ) {
        let message = self.message(publisher, time);
        for (name, &value) in names.iter().zip(positions) {
            if let Some(i) = self.channels.joints.iter().position(|joint| joint == name) {
                self.not_finite += push(&mut self.joints[i], publisher, message, value);
            } else if self.other_joints.len() < OTHER_JOINTS && !self.other_joints.contains(name) {
                self.other_joints.insert(name.clone());
            }
            for (i, gripper) in self.channels.grippers.iter().enumerate() {
                if gripper.source.joint.as_ref() == Some(name) {
                    let percent = gripper.source.percent_open(value);
                    self.not_finite += push(&mut self.grippers[i], publisher, message, percent);
                }
            }
        }
    }

    /// Takes what a topic says of the grippers whose topic it is.
    pub fn gripper(&mut self, topic: &str, time: MessageTime, value: f64) {
        let message = self.message(topic, time);
        for (i, gripper) in self.channels.grippers.iter().enumerate() {
            if gripper.source.topic.as_deref() == Some(topic) {
                let percent = gripper.source.percent_open(value);
                self.not_finite += push(&mut self.grippers[i], topic, message, percent);
            }
        }
    }

    /// Notes a message and returns its number.
    fn message(&mut self, publisher: &str, time: MessageTime) -> usize {
        if !self.publishers.contains_key(publisher) {
            self.publishers.insert(publisher.into(), Vec::new());
        }
        let times = self.publishers.get_mut(publisher).expect("just inserted");
        times.push(time);
        times.len() - 1
    }

    /// The recording that the messages make. Its frames are at the times of the joint that was heard of
    /// most, from when all were heard of first until one was last; other joints stand between their
    /// messages in proportion, grippers as last heard. Where several publishers speak of a joint, the
    /// one that says most of it counts. Joints and grippers that nobody speaks of are not in it.
    pub fn assemble(&self, id: &str) -> Assembled {
        let clocks: BTreeMap<&str, Vec<i64>> =
            self.publishers.iter().map(|(name, times)| (name.as_str(), clock(times))).collect();
        let series = |tracks: &BTreeMap<String, Track>| {
            let (publisher, track) = tracks.iter().max_by_key(|(_, t)| t.values.len())?;
            Some(Series::new(&clocks[publisher.as_str()], track))
        };
        let heard = self.channels.joints.iter().zip(&self.joints);
        let joints: Vec<(&String, Series)> =
            heard.filter_map(|(name, tracks)| Some((name, series(tracks)?))).collect();
        let first = joints.iter().map(|(_, s)| s.nanos[0]).max().unwrap_or(0);
        let last = joints.iter().map(|(_, s)| s.nanos[s.nanos.len() - 1]).min().unwrap_or(0);
        let most = joints.iter().max_by_key(|(_, series)| series.nanos.len());
        let within = |nanos: &i64| (first..=last).contains(nanos);
        let frames: Vec<i64> = most.map_or_else(Vec::new, |(_, series)| {
            series.nanos.iter().copied().filter(within).collect()
        });
        let columns: Vec<Vec<f64>> = joints.iter().map(|(_, s)| s.in_proportion(&frames)).collect();
        let grippers = self.channels.grippers.iter().zip(&self.grippers);
        let grippers = grippers.filter_map(|(gripper, tracks)| {
            let percent_open = series(tracks)?.as_last_heard(&frames);
            Some(GripperRecording { name: gripper.name.clone(), percent_open })
        });
        let recording = JointRecording {
            id: id.into(),
            times_secs: frames.iter().map(|t| nanos_between(frames[0], *t) * 1e-9).collect(),
            positions: (0..frames.len())
                .map(|i| columns.iter().map(|column| column[i]).collect())
                .collect(),
            grippers: grippers.collect(),
            joint_names: joints.iter().map(|(name, _)| (*name).clone()).collect(),
            points: Vec::new(),
            marks_secs: Vec::new(),
        };
        let doubled = most.map_or(0, |(_, series)| series.doubled);
        let incomplete = most.map_or(0, |(_, series)| series.nanos.len() - frames.len());
        let other_joints = self.other_joints.iter().cloned().collect();
        let not_finite = self.not_finite;
        Assembled { recording, other_joints, not_finite, doubled, incomplete }
    }
}

/// Adds a value to what a publisher said; 1 where it is no finite number.
fn push(
    tracks: &mut BTreeMap<String, Track>,
    publisher: &str,
    message: usize,
    value: f64,
) -> usize {
    if !value.is_finite() {
        return 1;
    }
    if !tracks.contains_key(publisher) {
        tracks.insert(publisher.into(), Track::default());
    }
    let track = tracks.get_mut(publisher).expect("just inserted");
    track.messages.push(message);
    track.values.push(value);
    0
}

/// When each message was sent, on the log's clock.
fn clock(times: &[MessageTime]) -> Vec<i64> {
    let logged = || times.iter().map(|time| time.log_nanos);
    let stamps: Option<Vec<i64>> = times.iter().map(|time| time.stamp_nanos).collect();
    let Some(stamps) = stamps.filter(|stamps| !stamps.is_empty()) else {
        return logged().collect();
    };
    let span = |first: Option<i64>, last: Option<i64>| match (first, last) {
        (Some(first), Some(last)) => last.saturating_sub(first),
        _ => 0,
    };
    let of_log = span(logged().min(), logged().max());
    let of_stamps = span(stamps.iter().copied().min(), stamps.iter().copied().max());
    let apart = of_log.abs_diff(of_stamps);
    let allowed = SPAN_NANOS.max((SPAN_SHARE * of_log as f64) as i64);
    if apart > allowed.unsigned_abs() {
        return logged().collect();
    }
    let mut behind: Vec<i64> = logged().zip(&stamps).map(|(l, s)| l.saturating_sub(*s)).collect();
    let middle = behind.len() / 2;
    let (_, &mut offset, _) = behind.select_nth_unstable(middle);
    stamps.iter().map(|stamp| stamp.saturating_add(offset)).collect()
}

/// From one time to another; the two may be further apart than an `i64` holds.
fn nanos_between(from: i64, to: i64) -> f64 {
    (i128::from(to) - i128::from(from)) as f64
}

/// Values at strictly increasing times.
#[derive(Debug, Clone)]
struct Series {
    nanos: Vec<i64>,
    values: Vec<f64>,
    doubled: usize,
}

impl Series {
    /// A track, which has at least one value, on its publisher's clock. Of values at the same time the
    /// first counts.
    fn new(clock: &[i64], track: &Track) -> Self {
        let heard = track.messages.iter().map(|&message| clock[message]);
        let mut pairs: Vec<(i64, f64)> = heard.zip(track.values.iter().copied()).collect();
        pairs.sort_by_key(|(nanos, _)| *nanos);
        let all = pairs.len();
        pairs.dedup_by_key(|(nanos, _)| *nanos);
        let doubled = all - pairs.len();
        let (nanos, values) = pairs.into_iter().unzip();
        Self { nanos, values, doubled }
    }

    /// The values at times between the first and the last.
    fn in_proportion(&self, times: &[i64]) -> Vec<f64> {
        let at = |&time: &i64| {
            let next = self.nanos.partition_point(|nanos| *nanos < time);
            if self.nanos.get(next) == Some(&time) || next == 0 {
                return self.values[next];
            }
            let (before, after) = (self.nanos[next - 1], self.nanos[next]);
            let share = nanos_between(before, time) / nanos_between(before, after);
            self.values[next - 1] + share * (self.values[next] - self.values[next - 1])
        };
        times.iter().map(at).collect()
    }

    /// The latest value at each time; before the first, the first.
    fn as_last_heard(&self, times: &[i64]) -> Vec<f64> {
        let at = |time: &i64| {
            let heard = self.nanos.partition_point(|nanos| nanos <= time);
            self.values[heard.saturating_sub(1)]
        };
        times.iter().map(at).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::recording::{GripperChannel, GripperSource};
    use super::*;

    const MILLI: i64 = 1_000_000;

    fn channels() -> Channels {
        let source = GripperSource {
            joint: Some("finger".into()),
            topic: Some("/hand".into()),
            closed: 0.01,
            open: 0.05,
        };
        let hand = GripperChannel { name: "hand".into(), source };
        Channels {
            joints: ["a", "b"].map(String::from).to_vec(),
            grippers: vec![hand],
            ..Channels::default()
        }
    }

    fn at(log_millis: i64, stamp_millis: Option<i64>) -> MessageTime {
        let stamp_nanos = stamp_millis.map(|stamp| stamp * MILLI);
        MessageTime { log_nanos: log_millis * MILLI, stamp_nanos }
    }

    fn names(names: &[&str]) -> Vec<String> {
        names.iter().map(|name| (*name).to_owned()).collect()
    }

    fn close(found: &[f64], expected: &[f64]) {
        assert_eq!(found.len(), expected.len(), "{found:?}");
        assert!(found.iter().zip(expected).all(|(f, e)| (f - e).abs() < 1e-9), "{found:?}");
    }

    #[test]
    fn frames_are_messages_with_joints_in_the_order_that_is_asked_for() {
        let channels = channels();
        let mut messages = JointMessages::new(&channels);
        for i in 0..3 {
            let positions = [i as f64, 0.03, 10.0 + i as f64, 7.0];
            let names = names(&["b", "finger", "a", "other"]);
            messages.joint_states("/joint_states", at(10 * i, None), &names, &positions);
        }
        let Assembled { recording, other_joints, not_finite, doubled, incomplete } =
            messages.assemble("one");
        assert_eq!(other_joints, ["finger", "other"]);
        assert_eq!(recording.id, "one");
        assert_eq!(recording.joint_names, ["a", "b"]);
        assert_eq!(recording.positions, [[10.0, 0.0], [11.0, 1.0], [12.0, 2.0]]);
        close(&recording.times_secs, &[0.0, 0.01, 0.02]);
        close(&recording.grippers[0].percent_open, &[50.0; 3]);
        assert_eq!((not_finite, doubled, incomplete), (0, 0, 0));
    }

    #[test]
    fn stamps_that_run_as_the_log_does_replace_its_jitter_and_order_messages() {
        let channels = channels();
        let mut messages = JointMessages::new(&channels);
        // Logged late, out of order, and one of them twice.
        for (log, stamp, value) in
            [(1003, 20, 2.0), (1000, 0, 0.0), (1001, 10, 1.0), (1004, 30, 3.0), (1005, 30, 9.0)]
        {
            messages.joint_states("/j", at(log, Some(stamp)), &names(&["a"]), &[value]);
        }
        let Assembled { recording, doubled, .. } = messages.assemble("one");
        close(&recording.times_secs, &[0.0, 0.01, 0.02, 0.03]);
        assert_eq!(recording.positions, [[0.0], [1.0], [2.0], [3.0]]);
        assert_eq!(doubled, 1);
    }

    #[test]
    fn stamps_that_are_no_clock_give_way_to_the_log() {
        let channels = channels();
        for stamps in [
            [Some(5), Some(5), Some(5)],
            [Some(1), None, Some(3)],
            [Some(0), Some(90_000), Some(1)],
        ] {
            let mut messages = JointMessages::new(&channels);
            for (i, stamp) in stamps.into_iter().enumerate() {
                let time = at(2000 * i as i64, stamp);
                messages.joint_states("/j", time, &names(&["a"]), &[i as f64]);
            }
            let recording = messages.assemble("one").recording;
            close(&recording.times_secs, &[0.0, 2.0, 4.0]);
        }
    }

    #[test]
    fn joints_of_several_publishers_stand_in_proportion_and_topics_as_last_heard() {
        let channels = channels();
        let mut messages = JointMessages::new(&channels);
        for i in 0..=10 {
            messages.joint_states(
                "/arm",
                at(10 * i, Some(10 * i + 77_000)),
                &names(&["a"]),
                &[0.0],
            );
        }
        for (millis, value) in [(15, 0.0), (55, 4.0), (95, 8.0)] {
            messages.joint_states("/wrist", at(millis, None), &names(&["b"]), &[value]);
        }
        messages.gripper("/hand", at(42, None), 0.05);
        messages.gripper("/hand", at(61, None), 0.01);
        messages.gripper("/foot", at(62, None), 0.05);
        let Assembled { recording, incomplete, .. } = messages.assemble("one");
        // From 20 to 90 ms both are known.
        assert_eq!(incomplete, 3);
        let b: Vec<f64> = recording.positions.iter().map(|frame| frame[1]).collect();
        close(&b, &[0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5]);
        let hand = &recording.grippers[0].percent_open;
        close(hand, &[100.0, 100.0, 100.0, 100.0, 100.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn of_two_publishers_of_a_joint_the_one_that_says_more_counts() {
        let channels = channels();
        let mut messages = JointMessages::new(&channels);
        for i in 0..4 {
            messages.joint_states("/full", at(10 * i, None), &names(&["a"]), &[1.0]);
            if i % 2 == 0 {
                messages.joint_states("/throttled", at(10 * i + 3, None), &names(&["a"]), &[2.0]);
            }
        }
        let recording = messages.assemble("one").recording;
        assert_eq!(recording.positions, [[1.0]; 4]);
        assert_eq!(recording.joint_names, ["a"]);
        assert_eq!(recording.grippers, []);
    }

    #[test]
    fn values_that_are_no_number_are_counted_and_messages_shorter_than_their_names_read() {
        let channels = channels();
        let mut messages = JointMessages::new(&channels);
        messages.joint_states("/j", at(0, None), &names(&["a", "b"]), &[0.0, f64::NAN]);
        messages.joint_states("/j", at(10, None), &names(&["a", "b"]), &[1.0]);
        let Assembled { recording, not_finite, .. } = messages.assemble("one");
        assert_eq!(recording.positions, [[0.0], [1.0]]);
        assert_eq!(not_finite, 1);
        assert_eq!(JointMessages::new(&channels).assemble("none").recording.times_secs, [0.0; 0]);
    }

    #[test]
    fn times_at_the_ends_of_the_clock_do_no_harm() {
        let channels = channels();
        let mut messages = JointMessages::new(&channels);
        for (log_nanos, stamp_nanos) in [(i64::MAX, Some(i64::MIN)), (i64::MIN, Some(i64::MAX))] {
            let time = MessageTime { log_nanos, stamp_nanos };
            messages.joint_states("/j", time, &names(&["a"]), &[0.0]);
        }
        assert_eq!(messages.assemble("one").recording.positions.len(), 2);
    }
}
