//! From messages to a recording: joint angles that came bit by bit, from one publisher or several, become
//! frames of all joints.
//!
//! Messages have two times: the publisher's stamp, and when they were logged. A publisher's stamps are
//! used where they are a clock, moved as a whole to the log's; else the log's times are. Messages may
//! come out of order, and twice.

use std::collections::{BTreeMap, BTreeSet};

use super::recording::{Channels, GripperRecording, JointRecording, PointRecording};

/// Stamps are no clock when their span differs from the log's by more than this, and by more than
/// [`SPAN_SHARE`] of it.
const SPAN_NANOS: i64 = 1_000_000_000;
/// See [`SPAN_NANOS`].
const SPAN_SHARE: f64 = 0.1;

/// Names of joints that nobody asks for which are kept, to tell what there is instead.
const OTHER_JOINTS: usize = 64;

/// Characters of such a name that are kept.
const OTHER_JOINT_CHARS: usize = 80;

/// Numbers of 8 bytes that are kept of a recording: 256 MiB, five hours of two arms at 100 Hz or fifty
/// minutes of one at 1 kHz.
const ROOM: usize = 1 << 25;

/// Numbers that a message takes beside its values: its two times.
const NUMBERS_PER_MESSAGE: usize = size_of::<MessageTime>() / size_of::<f64>();

/// Numbers that a publisher takes beside its messages and its name.
const NUMBERS_PER_PUBLISHER: usize = 32;

/// When a message was sent, in nanoseconds of two clocks that need not agree.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MessageTime {
    /// When it was logged.
    pub log_nanos: i64,
    /// The publisher's stamp; none in a message without one, or where it was left at 0.
    pub stamp_nanos: Option<i64>,
}

/// What a value is of, by its place among those that are asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Told {
    /// A joint: rad.
    Joint(usize),
    /// A gripper: per cent open.
    Gripper(usize),
}

/// Messages of a recording, as they are read. Only values that are asked for are kept, and of these only
/// so many: a recording without an end takes no memory without an end.
#[derive(Debug)]
pub struct JointMessages<'a> {
    channels: &'a Channels,
    publishers: BTreeMap<String, Publisher>,
    /// What topics said of where something is.
    points: BTreeMap<String, Points>,
    marks: Vec<MessageTime>,
    other_joints: BTreeSet<String>,
    not_finite: usize,
    /// Numbers that may still be kept.
    room: usize,
    is_full: bool,
}

/// What one publisher said: the times of its messages, and a row of values for each.
#[derive(Debug, Default)]
struct Publisher {
    times: Vec<MessageTime>,
    /// What it spoke of so far: a joint, or, after the joints, a gripper.
    columns: Vec<Column>,
    /// Row by row: rad of a joint, per cent open of a gripper; NaN of what a message did not tell.
    values: Vec<f64>,
}

/// Where something was, as a topic said.
#[derive(Debug, Default)]
struct Points {
    /// The frame of the first message; those in another one are left out.
    frame: String,
    times: Vec<MessageTime>,
    positions_m: Vec<[f64; 3]>,
}

/// One thing that a publisher speaks of.
#[derive(Debug)]
struct Column {
    channel: usize,
    /// Messages that tell it.
    told: usize,
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
        Self::with_room(channels, ROOM)
    }

    /// No message so far, and room for that many numbers.
    fn with_room(channels: &'a Channels, room: usize) -> Self {
        let (publishers, other_joints) = (BTreeMap::new(), BTreeSet::new());
        let (points, marks) = (BTreeMap::new(), Vec::new());
        let (not_finite, is_full) = (0, false);
        Self { channels, publishers, points, marks, other_joints, not_finite, room, is_full }
    }

    /// Whether a message found no room: that one and those after it are left out.
    pub fn is_full(&self) -> bool {
        self.is_full
    }

    /// Takes the angles of one message, by the names of their joints; those of joints that are not asked
    /// for are left out. Of a name that stands twice the first counts.
    pub fn joint_states<'n>(
        &mut self,
        publisher: &str,
        time: MessageTime,
        angles: impl IntoIterator<Item = (&'n str, f64)>,
    ) {
        let Channels { joints, grippers, .. } = self.channels;
        let mut told = Vec::with_capacity(joints.len() + grippers.len());
        let mut tell = |what: Told, value: f64| {
            if told.iter().all(|(other, _)| *other != what) {
                told.push((what, value));
            }
        };
        for (name, value) in angles {
            if let Some(i) = joints.iter().position(|joint| joint == name) {
                tell(Told::Joint(i), value);
            } else if self.other_joints.len() < OTHER_JOINTS && !self.other_joints.contains(name) {
                let name: String = name.chars().take(OTHER_JOINT_CHARS).collect();
                self.other_joints.insert(name);
            }
            for (i, gripper) in grippers.iter().enumerate() {
                if gripper.source.joint.as_deref() == Some(name) {
                    tell(Told::Gripper(i), gripper.source.percent_open(value));
                }
            }
        }
        self.told(publisher, time, &told);
    }

    /// Takes what a topic says of the grippers whose topic it is.
    pub fn gripper(&mut self, topic: &str, time: MessageTime, value: f64) {
        let of_topic = self.channels.grippers.iter().enumerate().filter_map(|(i, gripper)| {
            let is_its = gripper.source.topic.as_deref() == Some(topic);
            is_its.then(|| (Told::Gripper(i), gripper.source.percent_open(value)))
        });
        self.told(topic, time, &of_topic.collect::<Vec<_>>());
    }

    /// Takes where a topic says that something is, in a frame.
    pub fn point(&mut self, topic: &str, time: MessageTime, frame: &str, position_m: [f64; 3]) {
        if !position_m.iter().all(|value| value.is_finite()) {
            self.not_finite += 1;
            return;
        }
        let of_topic = match self.points.contains_key(topic) {
            true => 0,
            false => NUMBERS_PER_PUBLISHER + (topic.len() + frame.len()) / size_of::<f64>(),
        };
        if !self.takes(of_topic + NUMBERS_PER_MESSAGE + position_m.len()) {
            return;
        }
        let points = self.points.entry(topic.into()).or_default();
        if points.times.is_empty() {
            points.frame = frame.into();
        }
        if points.frame == frame {
            points.times.push(time);
            points.positions_m.push(position_m);
        }
    }

    /// Takes a mark between two demonstrations.
    pub fn mark(&mut self, time: MessageTime) {
        if self.takes(NUMBERS_PER_MESSAGE) {
            self.marks.push(time);
        }
    }

    /// Whether there is room for so many numbers, which is used then.
    fn takes(&mut self, needed: usize) -> bool {
        match self.room.checked_sub(needed) {
            Some(left) if !self.is_full => {
                self.room = left;
                true
            }
            _ => {
                self.is_full = true;
                false
            }
        }
    }

    /// Takes the values of one message, each of another thing.
    pub fn told(&mut self, publisher: &str, time: MessageTime, told: &[(Told, f64)]) {
        let joints = self.channels.joints.len();
        let channel = |told: Told| match told {
            Told::Joint(joint) => joint,
            Told::Gripper(gripper) => joints + gripper,
        };
        let told: Vec<_> = told.iter().map(|(what, value)| (channel(*what), *value)).collect();
        let finite = || told.iter().filter(|(_, value)| value.is_finite());
        self.not_finite += told.len() - finite().count();
        if finite().count() == 0 || self.is_full {
            return;
        }
        let known = self.publishers.get(publisher);
        let new_columns = match known {
            Some(publisher) => finite().filter(|(c, _)| publisher.column(*c).is_none()).count(),
            None => finite().count(),
        };
        let (rows, columns) = known.map_or((0, 0), |p| (p.times.len(), p.columns.len()));
        let of_publisher = NUMBERS_PER_PUBLISHER + publisher.len() / size_of::<f64>();
        let needed = new_columns * rows
            + (NUMBERS_PER_MESSAGE + columns + new_columns)
            + if known.is_none() { of_publisher } else { 0 };
        let is_new = known.is_none();
        if !self.takes(needed) {
            return;
        }
        if is_new {
            self.publishers.insert(publisher.into(), Publisher::default());
        }
        self.publishers.get_mut(publisher).expect("just inserted").push(time, finite());
    }

    /// The recording that the messages make. Its frames are at the times of the joint that was heard of
    /// most, from when all were heard of first until one was last; other joints stand between their
    /// messages in proportion, grippers as last heard. Where several publishers speak of a joint, the
    /// one that says most of it counts. Joints and grippers that nobody speaks of are not in it.
    pub fn assemble(&self, id: &str) -> Assembled {
        // Across publishers nothing but the log tells what was at the same time; if it tells no time, the
        // stamps must be of one clock.
        let mut logged = self.publishers.values().flat_map(|p| &p.times).map(|t| t.log_nanos);
        let first_logged = logged.next();
        let log_runs = logged.any(|nanos| Some(nanos) != first_logged);
        let ordered: BTreeMap<&str, Vec<(i64, usize)>> = self
            .publishers
            .iter()
            .map(|(name, publisher)| {
                let clock = clock(&publisher.times, log_runs);
                let mut order: Vec<_> = clock.into_iter().zip(0..).collect();
                order.sort_unstable();
                (name.as_str(), order)
            })
            .collect();
        let series = |channel: usize| {
            let by_publisher = self.publishers.iter().filter_map(|(name, publisher)| {
                Some((name, publisher, publisher.column(channel)?))
            });
            let (name, publisher, column) = by_publisher
                .max_by_key(|(_, publisher, column)| publisher.columns[*column].told)?;
            Some(Series::new(&ordered[name.as_str()], publisher, column))
        };
        let joint_count = self.channels.joints.len();
        let joints: Vec<usize> =
            (0..joint_count).filter(|&joint| series(joint).is_some()).collect();
        let (mut first, mut last) = (i64::MIN, i64::MAX);
        let mut most: Option<Series> = None;
        for &joint in &joints {
            let series = series(joint).expect("one that is spoken of");
            first = first.max(series.nanos[0]);
            last = last.min(series.nanos[series.nanos.len() - 1]);
            if most.as_ref().is_none_or(|most| series.nanos.len() >= most.nanos.len()) {
                most = Some(series);
            }
        }
        let (all, mut doubled) = most.as_ref().map_or((0, 0), |m| (m.nanos.len(), m.doubled));
        let mut frames = most.map_or_else(Vec::new, |most| most.nanos);
        frames.retain(|nanos| (first..=last).contains(nanos));
        let incomplete = all - frames.len();
        // Of a span of years seconds can't tell nanoseconds apart.
        let start = frames.first().copied().unwrap_or(0);
        let secs = |nanos: i64| nanos_between(start, nanos) * 1e-9;
        let known = frames.len();
        frames.dedup_by(|later, earlier| secs(*later) <= secs(*earlier));
        doubled += known - frames.len();
        let mut positions = vec![Vec::with_capacity(joints.len()); frames.len()];
        // Joint by joint, so that no more than one is there twice.
        for &joint in &joints {
            let column = series(joint).expect("one that is spoken of").in_proportion(&frames);
            positions.iter_mut().zip(column).for_each(|(frame, value)| frame.push(value));
        }
        let grippers = self.channels.grippers.iter().enumerate().filter_map(|(i, gripper)| {
            let percent_open = series(joint_count + i)?.as_last_heard(&frames);
            Some(GripperRecording { name: gripper.name.clone(), percent_open })
        });
        let recording = JointRecording {
            id: id.into(),
            grippers: grippers.collect(),
            times_secs: frames.iter().map(|nanos| secs(*nanos)).collect(),
            positions,
            joint_names: joints.iter().map(|&joint| self.channels.joints[joint].clone()).collect(),
            points: self
                .points
                .iter()
                .map(|(topic, p)| p.assemble(topic, &frames, log_runs))
                .collect(),
            marks_secs: self.marks_secs(&frames),
        };
        let other_joints = self.other_joints.iter().cloned().collect();
        let not_finite = self.not_finite;
        Assembled { recording, other_joints, not_finite, doubled, incomplete }
    }
}

impl JointMessages<'_> {
    /// When marks were set, after the first of these frames; in order.
    fn marks_secs(&self, frames: &[i64]) -> Vec<f64> {
        let Some(&first) = frames.first() else { return Vec::new() };
        let mut marks: Vec<f64> =
            self.marks.iter().map(|mark| nanos_between(first, mark.log_nanos) * 1e-9).collect();
        marks.sort_by(f64::total_cmp);
        marks
    }
}

impl Points {
    /// In the order of time, counted from the first of these frames.
    fn assemble(&self, topic: &str, frames: &[i64], log_runs: bool) -> PointRecording {
        let first = frames.first().copied().unwrap_or(0);
        let clock = clock(&self.times, log_runs);
        let mut order: Vec<_> = clock.into_iter().zip(0..).collect();
        order.sort_unstable();
        PointRecording {
            topic: topic.into(),
            frame: self.frame.clone(),
            times_secs: order
                .iter()
                .map(|(nanos, _)| nanos_between(first, *nanos) * 1e-9)
                .collect(),
            positions_m: order.iter().map(|(_, i): &(i64, usize)| self.positions_m[*i]).collect(),
        }
    }
}

impl Publisher {
    /// The place of a channel in the rows.
    fn column(&self, channel: usize) -> Option<usize> {
        self.columns.iter().position(|column| column.channel == channel)
    }

    /// Adds a message.
    fn push<'v>(
        &mut self,
        time: MessageTime,
        told: impl Iterator<Item = &'v (usize, f64)> + Clone,
    ) {
        let before = self.columns.len();
        for (channel, _) in told.clone() {
            if self.column(*channel).is_none() {
                self.columns.push(Column { channel: *channel, told: 0 });
            }
        }
        let width = self.columns.len();
        if width > before && before > 0 {
            let rows = self.values.chunks(before);
            let not_told = std::iter::repeat_n(f64::NAN, width - before);
            self.values =
                rows.flat_map(|row| row.iter().copied().chain(not_told.clone())).collect();
        }
        let start = self.values.len();
        self.values.resize(start + width, f64::NAN);
        for (channel, value) in told {
            let column = self.column(*channel).expect("just added");
            self.columns[column].told += 1;
            self.values[start + column] = *value;
        }
        self.times.push(time);
    }
}

/// When each message was sent, on the log's clock, or where that does not run on the stamps'.
fn clock(times: &[MessageTime], log_runs: bool) -> Vec<i64> {
    let logged = || times.iter().map(|time| time.log_nanos);
    let stamps: Option<Vec<i64>> = times.iter().map(|time| time.stamp_nanos).collect();
    let Some(stamps) = stamps.filter(|stamps| !stamps.is_empty()) else {
        return logged().collect();
    };
    if !log_runs {
        return stamps;
    }
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
    /// A publisher's column, which has at least one value, in the order of its messages' times. Of values
    /// at the same time the first counts.
    fn new(order: &[(i64, usize)], publisher: &Publisher, column: usize) -> Self {
        let told = publisher.columns[column].told;
        let (mut nanos, mut values) = (Vec::with_capacity(told), Vec::with_capacity(told));
        for (time, message) in order {
            let value = publisher.values[message * publisher.columns.len() + column];
            if !value.is_nan() && nanos.last() != Some(time) {
                nanos.push(*time);
                values.push(value);
            }
        }
        let doubled = told - nanos.len();
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

    /// Names with their angles.
    fn angles<'n>(names: &'n [&'n str], values: &'n [f64]) -> impl Iterator<Item = (&'n str, f64)> {
        names.iter().copied().zip(values.iter().copied())
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
            let names = ["b", "finger", "a", "other"];
            messages.joint_states("/joint_states", at(10 * i, None), angles(&names, &positions));
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
            messages.joint_states("/j", at(log, Some(stamp)), angles(&["a"], &[value]));
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
                messages.joint_states("/j", time, angles(&["a"], &[i as f64]));
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
            messages.joint_states("/arm", at(10 * i, Some(10 * i + 77_000)), [("a", 0.0)]);
        }
        for (millis, value) in [(15, 0.0), (55, 4.0), (95, 8.0)] {
            messages.joint_states("/wrist", at(millis, None), angles(&["b"], &[value]));
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
            messages.joint_states("/full", at(10 * i, None), angles(&["a"], &[1.0]));
            if i % 2 == 0 {
                messages.joint_states("/throttled", at(10 * i + 3, None), angles(&["a"], &[2.0]));
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
        messages.joint_states("/j", at(0, None), angles(&["a", "b"], &[0.0, f64::NAN]));
        messages.joint_states("/j", at(10, None), angles(&["a", "b"], &[1.0]));
        let Assembled { recording, not_finite, .. } = messages.assemble("one");
        assert_eq!(recording.positions, [[0.0], [1.0]]);
        assert_eq!(not_finite, 1);
        assert_eq!(JointMessages::new(&channels).assemble("none").recording.times_secs, [0.0; 0]);
    }

    #[test]
    fn without_a_log_that_runs_the_stamps_are_the_clock_of_all() {
        let channels = channels();
        let mut messages = JointMessages::new(&channels);
        for i in 0..3 {
            let stamp = Some(100 + 10 * i);
            messages.joint_states("/arm", at(0, stamp), [("a", i as f64)]);
            messages.joint_states("/wrist", at(0, stamp.map(|s| s - 5)), [("b", i as f64)]);
        }
        let recording = messages.assemble("one").recording;
        close(&recording.times_secs, &[0.0, 0.01]);
        assert_eq!(recording.positions, [[0.5, 1.0], [1.5, 2.0]]);
    }

    #[test]
    fn a_joint_that_is_named_twice_counts_once_and_one_that_comes_later_counts_from_then_on() {
        let channels = channels();
        let mut messages = JointMessages::new(&channels);
        messages.joint_states("/j", at(0, None), [("a", 0.5), ("a", 9.0)]);
        messages.joint_states("/j", at(10, None), [("b", 1.0), ("a", 1.5)]);
        messages.joint_states("/j", at(20, None), [("a", 2.5), ("b", 2.0)]);
        let Assembled { recording, doubled, incomplete, .. } = messages.assemble("one");
        assert_eq!(recording.positions, [[1.5, 1.0], [2.5, 2.0]]);
        assert_eq!((doubled, incomplete), (0, 1));
    }

    #[test]
    fn what_finds_no_room_is_left_out_and_what_came_before_stays() {
        let channels = channels();
        // A row has the two joints and the two times with their mark.
        let width = NUMBERS_PER_MESSAGE + 2;
        let mut messages = JointMessages::with_room(&channels, NUMBERS_PER_PUBLISHER + 100 * width);
        for i in 0..100 {
            assert!(!messages.is_full());
            messages.joint_states("/j", at(10 * i, None), [("a", i as f64), ("b", 0.0)]);
            // Joints that nobody asks for take no room, however many.
            messages.joint_states("/other", at(10 * i, None), [("c", 0.0); 500]);
        }
        assert!(!messages.is_full());
        messages.joint_states("/j", at(1000, None), [("a", 100.0), ("b", 0.0)]);
        assert!(messages.is_full());
        let recording = messages.assemble("one").recording;
        assert_eq!(recording.positions.len(), 100);
        assert_eq!(recording.positions[99], [99.0, 0.0]);
    }

    #[test]
    fn publishers_and_joints_that_come_one_by_one_take_room_too() {
        let channels = channels();
        let mut messages = JointMessages::with_room(&channels, 1000);
        let count = (0..).take_while(|i| {
            messages.joint_states(&format!("/publisher/{i}"), at(*i, None), [("a", 0.0)]);
            !messages.is_full()
        });
        let expected = 1000 / (NUMBERS_PER_PUBLISHER + NUMBERS_PER_MESSAGE + 2);
        assert!(count.count().abs_diff(expected) <= 1);

        let mut messages = JointMessages::with_room(&channels, 1000);
        let mut count = 0;
        while !messages.is_full() {
            messages.joint_states("/j", at(count, None), [("a", 0.0)]);
            count += 1;
        }
        let rows = messages.publishers["/j"].times.len();
        let mut messages = JointMessages::with_room(&channels, 1000);
        (0..rows as i64 - 1).for_each(|i| messages.joint_states("/j", at(i, None), [("a", 0.0)]));
        assert!(!messages.is_full());
        // To tell of one joint more, every row must widen.
        messages.joint_states("/j", at(count, None), [("b", 0.0)]);
        assert!(messages.is_full());
    }

    #[test]
    fn times_at_the_ends_of_the_clock_do_no_harm() {
        let channels = channels();
        let mut messages = JointMessages::new(&channels);
        for (log_nanos, stamp_nanos) in [(i64::MAX, Some(i64::MIN)), (i64::MIN, Some(i64::MAX))] {
            let time = MessageTime { log_nanos, stamp_nanos };
            messages.joint_states("/j", time, angles(&["a"], &[0.0]));
        }
        assert_eq!(messages.assemble("one").recording.positions.len(), 2);
        // Nanoseconds apart, after 300 years.
        let mut messages = JointMessages::new(&channels);
        for log_nanos in [i64::MIN, i64::MAX - 2, i64::MAX - 1, i64::MAX] {
            let time = MessageTime { log_nanos, stamp_nanos: None };
            messages.joint_states("/j", time, [("a", 0.0)]);
        }
        let Assembled { recording, doubled, .. } = messages.assemble("one");
        assert_eq!((recording.times_secs.len(), recording.positions.len(), doubled), (2, 2, 2));
    }
}
