//! Recordings as tables: a CSV file with a row of names, then a row for each frame.
//!
//! A column with the time is needed: without one the rate would be a guess. Its name says its unit:
//! `time`, `timestamp`, `stamp` or `t` are seconds, as they are with `_s`, `_sec` or `_secs`; `_ms`, `_us`
//! and `_ns` say otherwise. Columns that are named like a joint are angles (rad); those named like a
//! gripper are per cent open; those named like a gripper's joint or topic count as these do. Other columns
//! are passed over. Fields are parted by commas, semicolons or tabs, whichever the names have most of; an
//! empty field says nothing.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use csv_core::{ReadRecordResult, Reader, ReaderBuilder};
use sha2::{Digest, Sha256};

use crate::demonstrations::joint_messages::{Assembled, JointMessages, MessageTime, Told};
use crate::demonstrations::recording::{Channels, JointRecording};

/// Longest row that is read, bytes.
const LONGEST_ROW: usize = 1 << 20;

/// Rows with damage that are skipped before a recording counts as unreadable, as a share of all.
const MAX_DAMAGED_SHARE: f64 = 0.01;

/// Columns that an error message names.
const LISTED_COLUMNS: usize = 24;

/// Seconds that a time without a named unit may have: beyond, in the year 5138, it counts nanoseconds.
const LARGEST_SECS: f64 = 1e11;

/// Why a file is no recording.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CsvError {
    /// The file can't be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// No column has the time.
    #[error(
        "no column has the time; name it time (seconds) or time_ns (nanoseconds). The columns are {columns}"
    )]
    NoTime {
        /// Names of the columns, comma-separated.
        columns: String,
    },
    /// No column is a joint's.
    #[error("no column is named like a joint; {joints} are looked for. The columns are {columns}")]
    NoJoints {
        /// Names of the joints, comma-separated.
        joints: String,
        /// Names of the columns, comma-separated.
        columns: String,
    },
    /// The time is in another unit than its column says.
    #[error(
        "line {line}: the {column} is {value}, too large for seconds; name the column {column}_ns if it \
         counts nanoseconds"
    )]
    Unit {
        /// The line, from 1.
        line: u64,
        /// Name of the column.
        column: String,
        /// The value.
        value: f64,
    },
    /// Rows can't be read.
    #[error("{damaged} of {rows} rows can't be read; the first: {first}")]
    Unreadable {
        /// Their number.
        damaged: usize,
        /// That of all rows.
        rows: usize,
        /// What is wrong with the first.
        first: String,
    },
    /// There are too few frames.
    #[error("it has {frames} frames; at least 2 are needed")]
    TooFew {
        /// Their number.
        frames: usize,
    },
}

/// A recording, and what was skipped while reading it.
#[derive(Debug, Clone, PartialEq)]
pub struct CsvRecording {
    /// The recording.
    pub recording: JointRecording,
    /// Rows and values that can't be read, or say the same time again.
    pub skipped: usize,
    /// What is wrong with the file; nothing in a sound one.
    pub damage: Vec<String>,
    /// SHA-256 over the file, in hexadecimal digits.
    pub digest: String,
}

/// Whether a file has the name of a table.
pub fn is_table(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("csv"))
}

/// Reads the recording in a file: these joints, and those of these grippers that it has.
///
/// # Errors
/// The file can't be read; no time; no joint; less than two frames; or more than 1 % of the rows damaged.
pub fn read(path: &Path, channels: &Channels) -> Result<CsvRecording, CsvError> {
    let io = |source| CsvError::Io { path: path.into(), source };
    let mut input =
        BufReader::new(Hashed { file: File::open(path).map_err(io)?, digest: Sha256::new() });
    let delimiter = delimiter(input.fill_buf().map_err(io)?);
    let mut rows = Rows::new(input, delimiter);
    let names: Vec<String> = match rows.next().map_err(io)? {
        Some(row) => row.map(|field| String::from_utf8_lossy(field).trim().to_owned()).collect(),
        None => Vec::new(),
    };
    let columns = Columns::new(&names, channels)?;
    let mut messages = JointMessages::new(channels);
    let (mut total, mut damaged, mut first) = (0, 0, None);
    let mut told = Vec::new();
    while !messages.is_full() {
        let line = rows.parser.line();
        let Some(row) = rows.next().map_err(io)? else { break };
        total += 1;
        told.clear();
        match columns.frame(row, &mut told) {
            Ok(secs) if columns.is_too_large(secs) => {
                let column = names[columns.time].clone();
                return Err(CsvError::Unit { line, column, value: secs });
            }
            Ok(secs) => {
                let log_nanos = (secs * 1e9).round() as i64;
                messages.told("", MessageTime { log_nanos, stamp_nanos: None }, &told);
            }
            Err(what) => {
                damaged += 1;
                first.get_or_insert_with(|| format!("line {line}: {what}"));
            }
        }
    }
    let mut damage = Vec::new();
    if let Some(first) = first {
        if damaged > (MAX_DAMAGED_SHARE * total as f64) as usize {
            return Err(CsvError::Unreadable { damaged, rows: total, first });
        }
        damage.push(format!("{damaged} of {total} rows can't be read, the first: {first}"));
    }
    if messages.is_full() {
        damage.push(format!(
            "only its first {total} rows are read: of one recording no more angles are kept than fit in \
             256 MiB; split it"
        ));
    }
    let id = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let Assembled { recording, other_joints: _, not_finite, doubled, incomplete } =
        messages.assemble(&id);
    let frames = recording.times_secs.len();
    if frames < 2 {
        return Err(CsvError::TooFew { frames });
    }
    if incomplete > 0 {
        damage
            .push(format!("{incomplete} rows at its ends are left out, as a joint is not in them"));
    }
    let digest = rows.input.into_inner().digest.finalize();
    let digest = digest.iter().map(|byte| format!("{byte:02x}")).collect();
    Ok(CsvRecording {
        recording,
        skipped: damaged + not_finite + doubled + incomplete,
        damage,
        digest,
    })
}

/// What the names are parted by: of the signs that are used for it the one that stands most in their line.
fn delimiter(start: &[u8]) -> u8 {
    let line = start.split(|byte| matches!(byte, b'\n' | b'\r')).find(|line| !line.is_empty());
    let count = |sign: &u8| line.unwrap_or_default().iter().filter(|byte| *byte == sign).count();
    // Of several that stand as often the last.
    [b'\t', b';', b','].into_iter().max_by_key(count).unwrap_or(b',')
}

/// What the columns are.
struct Columns {
    /// How many there are.
    count: usize,
    time: usize,
    /// Seconds of one of its units; none where its name says none.
    unit_secs: Option<f64>,
    /// What the others tell that are asked for, by their places.
    told: BTreeMap<usize, Vec<Column>>,
}

/// What a column tells, and its values' line: an offset and a factor.
#[derive(Debug, Clone, Copy)]
struct Column {
    told: Told,
    at_zero: f64,
    per_unit: f64,
}

impl Columns {
    fn new(names: &[String], channels: &Channels) -> Result<Self, CsvError> {
        let listed = || {
            let more = names.len().saturating_sub(LISTED_COLUMNS);
            let list = names[..names.len() - more].join(", ");
            if more > 0 { format!("{list} and {more} more") } else { list }
        };
        let times = names.iter().enumerate().filter_map(|(i, name)| Some((i, time_unit(name)?)));
        let Some((time, unit_secs)) = times.min_by_key(|(i, _)| *i) else {
            return Err(CsvError::NoTime { columns: listed() });
        };
        let mut told: BTreeMap<usize, Vec<Column>> = BTreeMap::new();
        let mut has_joint = false;
        for (place, name) in names.iter().enumerate().filter(|(place, _)| *place != time) {
            let joint = channels.joints.iter().position(|joint| joint == name);
            has_joint |= joint.is_some();
            let joint = joint.map(|i| Column { told: Told::Joint(i), at_zero: 0.0, per_unit: 1.0 });
            let grippers = channels.grippers.iter().enumerate().filter_map(|(i, gripper)| {
                let told = Told::Gripper(i);
                let source = &gripper.source;
                if gripper.name == *name {
                    return Some(Column { told, at_zero: 0.0, per_unit: 1.0 });
                }
                let is_its = |of: &Option<String>| of.as_ref() == Some(name);
                let at_zero = source.percent_open(0.0);
                let per_unit = source.percent_open(1.0) - at_zero;
                (is_its(&source.joint) || is_its(&source.topic)).then_some(Column {
                    told,
                    at_zero,
                    per_unit,
                })
            });
            let of_column: Vec<_> = joint.into_iter().chain(grippers).collect();
            if !of_column.is_empty() {
                told.insert(place, of_column);
            }
        }
        if !has_joint {
            let joints = channels.joints.join(", ");
            return Err(CsvError::NoJoints { joints, columns: listed() });
        }
        Ok(Self { count: names.len(), time, unit_secs, told })
    }

    /// Adds what a row tells, and returns its time.
    fn frame<'r>(
        &self,
        row: impl ExactSizeIterator<Item = &'r [u8]>,
        told: &mut Vec<(Told, f64)>,
    ) -> Result<f64, String> {
        if row.len() != self.count {
            return Err(format!("it has {} fields, the names are {}", row.len(), self.count));
        }
        let mut secs = None;
        for (place, field) in row.enumerate() {
            let of_column = self.told.get(&place);
            if place != self.time && of_column.is_none() {
                continue;
            }
            let text = String::from_utf8_lossy(field);
            let text = text.trim();
            if text.is_empty() && place != self.time {
                continue;
            }
            let number: f64 = text.parse().map_err(|_| {
                let text: String = text.chars().take(40).collect();
                format!("{text:?} in column {} is no number", place + 1)
            })?;
            if place == self.time {
                secs = Some(number * self.unit_secs.unwrap_or(1.0)).filter(|secs| secs.is_finite());
            }
            for column in of_column.into_iter().flatten() {
                told.push((column.told, column.at_zero + column.per_unit * number));
            }
        }
        secs.ok_or_else(|| "its time is no finite number".into())
    }

    /// Whether that can't be seconds, where the name says nothing else.
    fn is_too_large(&self, secs: f64) -> bool {
        self.unit_secs.is_none() && secs.abs() > LARGEST_SECS
    }
}

/// Whether a column has the time, and then the seconds of its unit, if its name has one.
fn time_unit(name: &str) -> Option<Option<f64>> {
    let name = name.to_ascii_lowercase();
    let name = name.trim_start_matches('_');
    let (base, unit) = match name.split_once('_') {
        Some((base, unit)) => (base, Some(unit)),
        None => (name, None),
    };
    if !matches!(base, "time" | "timestamp" | "stamp" | "t") {
        return None;
    }
    Some(match unit {
        None => None,
        Some("s" | "sec" | "secs" | "seconds") => Some(1.0),
        Some("ms" | "msec" | "msecs" | "millis" | "milliseconds") => Some(1e-3),
        Some("us" | "usec" | "usecs" | "micros" | "microseconds") => Some(1e-6),
        Some("ns" | "nsec" | "nsecs" | "nanos" | "nanoseconds") => Some(1e-9),
        Some(_) => return None,
    })
}

/// The rows of a table, one at a time.
struct Rows<R> {
    parser: Reader,
    input: R,
    fields: Vec<u8>,
    ends: Vec<usize>,
}

impl<R: BufRead> Rows<R> {
    fn new(input: R, delimiter: u8) -> Self {
        let parser = ReaderBuilder::new().delimiter(delimiter).build();
        Self { parser, input, fields: vec![0; 1024], ends: vec![0; 64] }
    }

    /// The fields of the next row; none at the end.
    fn next(&mut self) -> io::Result<Option<impl ExactSizeIterator<Item = &[u8]>>> {
        let (mut length, mut count) = (0, 0);
        loop {
            let input = self.input.fill_buf()?;
            let (result, taken, written, ended) =
                self.parser.read_record(input, &mut self.fields[length..], &mut self.ends[count..]);
            self.input.consume(taken);
            (length, count) = (length + written, count + ended);
            let full = match result {
                ReadRecordResult::InputEmpty => continue,
                ReadRecordResult::OutputFull => &mut length,
                ReadRecordResult::OutputEndsFull => &mut count,
                ReadRecordResult::Record => break,
                ReadRecordResult::End => return Ok(None),
            };
            if *full >= LONGEST_ROW {
                let line = self.parser.line();
                let told = format!("the row at line {line} is longer than {LONGEST_ROW} bytes");
                return Err(io::Error::new(io::ErrorKind::InvalidData, told));
            }
            match result {
                ReadRecordResult::OutputFull => self.fields.resize(2 * self.fields.len(), 0),
                _ => self.ends.resize(2 * self.ends.len(), 0),
            }
        }
        let (fields, ends) = (&self.fields, &self.ends[..count]);
        Ok(Some((0..count).map(move |i| {
            let start = if i == 0 { 0 } else { ends[i - 1] };
            &fields[start..ends[i]]
        })))
    }
}

/// A file whose digest is taken as it is read.
struct Hashed {
    file: File,
    digest: Sha256,
}

impl Read for Hashed {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.file.read(buffer)?;
        self.digest.update(&buffer[..count]);
        Ok(count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::demonstrations::recording::{GripperChannel, GripperSource};
    use proptest::prelude::*;

    fn channels() -> Channels {
        let source = GripperSource {
            joint: Some("finger".into()),
            topic: Some("/hand".into()),
            closed: 0.01,
            open: 0.05,
        };
        let hand = GripperChannel { name: "hand".into(), source };
        let joints = ["a", "b"].map(String::from).to_vec();
        Channels { joints, grippers: vec![hand], ..Channels::default() }
    }

    fn read_text(text: impl AsRef<[u8]>) -> Result<CsvRecording, CsvError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("one.csv");
        std::fs::write(&path, text).unwrap();
        read(&path, &channels())
    }

    fn refusal(text: &str) -> String {
        read_text(text).unwrap_err().to_string()
    }

    #[test]
    fn columns_are_found_by_name_and_rows_stand_in_the_order_of_their_times() {
        let text = "\u{feff}\"b\", Time ,a,note\r\n0.5,2.5,1e-1,x\r\n\r\n0.25,2.0,-0.1,\"y, z\"\r\n,3.0,0.3,\n";
        let CsvRecording { recording, skipped, damage, digest } = read_text(text).unwrap();
        assert_eq!(recording.id, "one.csv");
        assert_eq!(recording.joint_names, ["a", "b"]);
        assert_eq!(recording.times_secs, [0.0, 0.5]);
        assert_eq!(recording.positions, [[-0.1, 0.25], [0.1, 0.5]]);
        assert_eq!(recording.grippers, []);
        // The last row lacks b.
        assert_eq!((skipped, damage.len()), (1, 1), "{damage:?}");
        let expected = Sha256::digest(text).iter().map(|b| format!("{b:02x}")).collect::<String>();
        assert_eq!(digest, expected);
    }

    #[test]
    fn the_names_unit_is_that_of_the_time() {
        for (name, step) in [
            ("t", 0.1),
            ("Stamp", 0.1),
            ("timestamp_secs", 0.1),
            ("time_s", 0.1),
            ("__time", 0.1),
            ("time_ms", 100.0),
            ("t_us", 1e5),
            ("time_ns", 1e8),
            ("stamp_nanos", 1e8),
        ] {
            let text = format!("{name},a\n{},1\n{},2\n", 3.0 * step, 4.0 * step);
            let times = read_text(text).unwrap().recording.times_secs;
            assert!((times[1] - 0.1).abs() < 1e-9, "{name}: {times:?}");
        }
        for name in ["torque", "t_0", "time_of_day", "_", ""] {
            assert_eq!(time_unit(name), None, "{name}");
        }
    }

    #[test]
    fn nanoseconds_of_a_clock_keep_their_steps() {
        let start = 1_700_000_000_000_000_000_i64;
        let rows: String = (0..50).map(|i| format!("{},{i}\n", start + 10_000_000 * i)).collect();
        let times = read_text(format!("time_ns,a\n{rows}")).unwrap().recording.times_secs;
        for (i, time) in times.iter().enumerate() {
            assert!((time - 0.01 * i as f64).abs() < 1e-6, "{i}: {time}");
        }
        let told = refusal(&format!("time,a\n{rows}"));
        assert!(told.starts_with("line 2: the time is 1700000000000000000, too large"), "{told}");
    }

    #[test]
    fn grippers_are_per_cent_or_count_as_their_joint_or_topic() {
        for (name, values) in
            [("hand", ["100", "25"]), ("finger", ["0.05", "0.02"]), ("/hand", ["0.05", "2e-2"])]
        {
            let text = format!("t;a;{name}\n0;0;{}\n1;0;{}\n", values[0], values[1]);
            let hand = &read_text(text).unwrap().recording.grippers[0];
            assert_eq!(hand.name, "hand");
            for (open, expected) in hand.percent_open.iter().zip([100.0, 25.0]) {
                assert!((open - expected).abs() < 1e-9, "{name}: {hand:?}");
            }
        }
    }

    #[test]
    fn what_is_no_recording_says_why() {
        assert_eq!(
            refusal("a,b\n0,0\n1,1\n"),
            "no column has the time; name it time (seconds) or time_ns (nanoseconds). The columns are a, b"
        );
        assert_eq!(
            refusal("t\tx\n0\t0\n"),
            "no column is named like a joint; a, b are looked for. The columns are t, x"
        );
        assert_eq!(refusal("t,a\n0,1\n"), "it has 1 frames; at least 2 are needed");
        assert!(refusal("").starts_with("no column has the time"));
        assert_eq!(
            refusal("t,a\n0,1\n1,x\n2,3,4\n"),
            "2 of 3 rows can't be read; the first: line 3: \"x\" in column 2 is no number"
        );
        assert_eq!(
            refusal("t,a\n0,1\ninf,1\n1,1\n"),
            "1 of 3 rows can't be read; the first: line 3: its time is no finite number"
        );
        let told = refusal(&format!("t,a\n0,\"{}", "1".repeat(LONGEST_ROW + 1)));
        assert!(told.contains("is longer than 1048576 bytes"), "{told}");
        let names: String = (0..LONGEST_ROW).map(|_| ",").collect();
        assert!(refusal(&names).contains("is longer than"));
    }

    #[test]
    fn one_damaged_row_in_a_long_table_is_skipped_and_told() {
        let rows: String = (0..300).map(|i| format!("{}.5,1,2\n", i)).collect();
        let CsvRecording { recording, skipped, damage, .. } =
            read_text(format!("t,a,b\n{rows}300.5,1")).unwrap();
        assert_eq!((recording.positions.len(), skipped), (300, 1));
        assert_eq!(
            damage,
            ["1 of 301 rows can't be read, the first: line 302: it has 2 fields, the names are 3"]
        );
    }

    proptest! {
        #[test]
        fn no_table_brings_the_reader_down(text in "(t|time_ns|a|b|hand|[,;\t\"\r\n0-9.e-]){0,80}") {
            if let Ok(read) = read_text(text) {
                prop_assert!(read.recording.times_secs.is_sorted_by(|a, b| a < b));
            }
        }
    }
}
