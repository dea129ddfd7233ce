//! Recordings in the layout of MIME (Sharma et al., *Multiple Interactions Made Easy*, CoRL 2018).
//!
//! A demonstration is a folder with `joint_angles.txt`, one object of joint names and angles (rad)
//! per line, and `left_gripper.txt` and `right_gripper.txt`, one number per line: per cent open.
//! There are no time stamps; frames come at 100 Hz. What real downloads hold is read as it is: lines
//! written as JSON or as Python literals, keys in any order, stray lines in between, grippers with
//! a few per cent more or fewer lines than joints.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use crate::demonstrations::recording::{
    Channels, GripperChannel, GripperRecording, JointRecording,
};
use crate::demonstrations::simulation::RawDemonstration;

/// Frames per second of a MIME recording.
pub const RATE_HZ: f64 = 100.0;

/// Name of the file with the joints.
const JOINTS_FILE: &str = "joint_angles.txt";

/// Lines with damage that are skipped before a recording counts as unreadable, as a share of all.
const MAX_DAMAGED_SHARE: f64 = 0.01;

/// Lines with damage after which no more are read.
const MOST_DAMAGED: usize = 100_000;

/// Largest file that is read, bytes: 100 Hz for an hour and a half, where MIME's last half a minute.
const LARGEST_FILE: u64 = 256 << 20;

/// Problems that an error message lists; the rest is counted.
const LISTED_PROBLEMS: usize = 5;

/// A line that can't be read.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    /// The file.
    pub file: PathBuf,
    /// The line, from 1; 0 for the file as a whole.
    pub line: usize,
    /// What is wrong.
    pub what: String,
}

/// Why a folder is not a recording.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MimeError {
    /// A file or folder can't be opened.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// No folder below holds `joint_angles.txt`.
    #[error(
        "{}: no demonstration here; a demonstration is a folder with {JOINTS_FILE}, a task is a \
         folder of such folders", path.display()
    )]
    Empty {
        /// The folder.
        path: PathBuf,
    },
    /// Lines of the files can't be read.
    #[error("{}", list(problems))]
    Unreadable {
        /// All of them.
        problems: Vec<Problem>,
    },
}

fn list(problems: &[Problem]) -> String {
    let mut text = String::new();
    for (i, Problem { file, line, what }) in problems.iter().take(LISTED_PROBLEMS).enumerate() {
        let separator = if i == 0 { "" } else { "; " };
        let name = file
            .file_name()
            .map_or_else(|| file.display().to_string(), |n| n.to_string_lossy().into_owned());
        let place = if *line == 0 { name } else { format!("{name}:{line}") };
        let _ = write!(text, "{separator}{place}: {what}");
    }
    if problems.len() > LISTED_PROBLEMS {
        let _ = write!(text, "; and {} more", problems.len() - LISTED_PROBLEMS);
    }
    text
}

/// A recording, and what was skipped while reading it.
#[derive(Debug, Clone, PartialEq)]
pub struct MimeRecording {
    /// The recording.
    pub recording: JointRecording,
    /// Lines that are no frame and need not be one, such as a finger's joint or a bare number.
    pub stray_lines: usize,
    /// Lines that should have been a frame and were skipped.
    pub damaged: Vec<Problem>,
    /// SHA-256 over the files, in hexadecimal digits.
    pub digest: String,
}

/// The demonstrations at a path, in the order of their names: the folder itself, or the folders in
/// it (a task's folder), or in those (a folder of tasks).
///
/// # Errors
/// The path can't be read, or there is no demonstration.
pub fn find(path: &Path) -> Result<Vec<PathBuf>, MimeError> {
    let mut found = Vec::new();
    collect(path, 2, &mut found)?;
    if found.is_empty() {
        return Err(MimeError::Empty { path: path.into() });
    }
    Ok(found)
}

/// Whether a file of this name may be one of a demonstration: its joints, or a gripper.
pub fn is_part(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "txt")
}

/// The demonstration that a file is a part of.
pub fn demonstration_of(file: &Path) -> Option<&Path> {
    let folder = file.parent()?;
    // The folder of a file without one is empty.
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    (is_part(file) && folder.join(JOINTS_FILE).is_file()).then_some(folder)
}

fn collect(path: &Path, levels: usize, found: &mut Vec<PathBuf>) -> Result<(), MimeError> {
    let io = |source| MimeError::Io { path: path.into(), source };
    if path.join(JOINTS_FILE).exists() {
        found.push(path.into());
        return Ok(());
    }
    let mut folders = Vec::new();
    let mut has_gripper = false;
    for entry in std::fs::read_dir(path).map_err(io)? {
        let entry = entry.map_err(io)?.path();
        has_gripper |= entry.file_name().is_some_and(|n| {
            let name = n.to_string_lossy();
            name == "left_gripper.txt" || name == "right_gripper.txt"
        });
        if entry.is_dir() {
            folders.push(entry);
        }
    }
    // A demonstration that lacks its joints is one all the same, and is reported as such.
    if has_gripper {
        found.push(path.into());
    } else if levels > 0 {
        folders.sort();
        for folder in folders {
            collect(&folder, levels - 1, found)?;
        }
    }
    Ok(())
}

/// Reads the demonstration in a folder: these joints, and those of these grippers that it has.
///
/// # Errors
/// A file can't be read; no gripper; no frame; or more than 1 % of the lines damaged.
pub fn read(folder: &Path, channels: &Channels) -> Result<MimeRecording, MimeError> {
    let mut digest = Sha256::new();
    let mut text = |file: &Path| {
        let bytes = contents(file).map_err(|source| MimeError::Io { path: file.into(), source })?;
        digest.update(bytes.len().to_le_bytes());
        digest.update(&bytes);
        let lossy = |e: std::string::FromUtf8Error| String::from_utf8_lossy(e.as_bytes()).into();
        Ok(String::from_utf8(bytes).unwrap_or_else(lossy))
    };
    let joints_file = folder.join(JOINTS_FILE);
    let joints = text(&joints_file)?;
    let mut lines = Lines { file: joints_file, damaged: Vec::new(), stray: 0, total: 0 };
    let mut positions = Vec::new();
    for (number, line) in numbered(&joints) {
        if lines.is_hopeless() {
            break;
        }
        lines.total += 1;
        match frame(line, &channels.joints) {
            Ok(Some(frame)) => positions.push(frame),
            Ok(None) => lines.stray += 1,
            Err(what) => lines.damage(number, what),
        }
    }
    let mut problems = lines.fatal();
    if positions.len() < 2 && problems.is_empty() {
        let what = format!(
            "{} of {} lines hold the {} joints; at least 2 are needed",
            positions.len(),
            lines.total,
            channels.joints.len()
        );
        problems.push(Problem { file: lines.file.clone(), line: 0, what });
    }
    let mut stray_lines = lines.stray;
    let mut damaged = lines.damaged;

    let mut grippers = Vec::new();
    for GripperChannel { name, .. } in &channels.grippers {
        let file = folder.join(format!("{name}.txt"));
        if !file.exists() {
            continue;
        }
        let text = text(&file)?;
        let mut lines = Lines { file, damaged: Vec::new(), stray: 0, total: 0 };
        let mut values = Vec::new();
        for (number, line) in numbered(&text) {
            if lines.is_hopeless() {
                break;
            }
            lines.total += 1;
            match line.parse::<f64>() {
                Ok(value) if value.is_finite() => values.push(value),
                Ok(value) => lines.damage(number, format!("{value} is not a finite number")),
                Err(_) if line.starts_with('{') => lines.stray += 1,
                Err(_) => lines.damage(number, format!("{:?} is not a number", shortened(line))),
            }
        }
        problems.extend(lines.fatal());
        stray_lines += lines.stray;
        if values.is_empty() {
            let what = "no line holds a number".into();
            problems.push(Problem { file: lines.file.clone(), line: 0, what });
        } else {
            let percent_open = aligned(&values, positions.len());
            grippers.push(GripperRecording { name: name.clone(), percent_open });
        }
        damaged.extend(lines.damaged);
    }
    if let Some(missing) =
        channels.grippers.iter().find(|g| !folder.join(format!("{}.txt", g.name)).exists())
    {
        let file = folder.join(format!("{}.txt", missing.name));
        problems.push(Problem { file, line: 0, what: "the file is missing".into() });
    }
    if !problems.is_empty() {
        return Err(MimeError::Unreadable { problems });
    }
    let recording = JointRecording {
        id: folder
            .file_name()
            .map_or_else(|| "demonstration".into(), |n| n.to_string_lossy().into_owned()),
        times_secs: (0..positions.len()).map(|i| i as f64 / RATE_HZ).collect(),
        joint_names: channels.joints.clone(),
        positions,
        grippers,
        points: Vec::new(),
        marks_secs: Vec::new(),
    };
    let digest = digest.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
    Ok(MimeRecording { recording, stray_lines, damaged, digest })
}

/// What a file holds, which must be an ordinary one, and end.
fn contents(path: &Path) -> io::Result<Vec<u8>> {
    let refused = |what: &str| Err(io::Error::new(io::ErrorKind::InvalidData, what.to_owned()));
    if !path.metadata()?.is_file() {
        return refused("it is no ordinary file");
    }
    let mut bytes = Vec::new();
    File::open(path)?.take(LARGEST_FILE + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > LARGEST_FILE {
        return refused(&format!("it is larger than {LARGEST_FILE} bytes"));
    }
    Ok(bytes)
}

/// The state of reading one file.
struct Lines {
    file: PathBuf,
    damaged: Vec<Problem>,
    stray: usize,
    total: usize,
}

impl Lines {
    fn damage(&mut self, line: usize, what: String) {
        self.damaged.push(Problem { file: self.file.clone(), line, what });
    }

    /// Whether there is damage without an end.
    fn is_hopeless(&self) -> bool {
        self.damaged.len() >= MOST_DAMAGED
    }

    /// The damage, where it is more than a few lines of a long file.
    fn fatal(&mut self) -> Vec<Problem> {
        let tolerated = (MAX_DAMAGED_SHARE * self.total as f64) as usize;
        let is_fatal = self.damaged.len() > tolerated || self.is_hopeless();
        if is_fatal { std::mem::take(&mut self.damaged) } else { Vec::new() }
    }
}

/// Lines that are not empty, numbered from 1.
fn numbered(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let lines = text.trim_start_matches('\u{feff}').lines().enumerate();
    lines.map(|(i, line)| (i + 1, line.trim())).filter(|(_, line)| !line.is_empty())
}

fn shortened(line: &str) -> String {
    const LENGTH: usize = 40;
    match line.char_indices().nth(LENGTH) {
        Some((at, _)) => format!("{}...", &line[..at]),
        None => line.into(),
    }
}

/// The joints of one line; none for a line that is not about them.
fn frame(line: &str, joints: &[String]) -> Result<Option<Vec<f64>>, String> {
    if !line.starts_with('{') {
        // A number that lost its way is stray; anything else is damage.
        return match line.parse::<f64>() {
            Ok(_) => Ok(None),
            Err(_) => Err(format!("{:?} is no object of joint angles", shortened(line))),
        };
    }
    let mut values: Vec<Option<f64>> = vec![None; joints.len()];
    let entries = Entries { rest: line[1..].trim_start(), done: false };
    for entry in entries {
        let (key, value) = entry?;
        if let Some(place) = joints.iter().position(|j| j == key) {
            let number: f64 =
                value.parse().map_err(|_| format!("{key} is {:?}, no number", shortened(value)))?;
            if !number.is_finite() {
                return Err(format!("{key} is {number}, not a finite number"));
            }
            values[place] = Some(number);
        }
    }
    if values.iter().all(Option::is_none) {
        return Ok(None);
    }
    let missing = values.iter().zip(joints).find(|(v, _)| v.is_none());
    match missing {
        Some((_, joint)) => Err(format!("{joint} is missing")),
        None => Ok(Some(values.into_iter().flatten().collect())),
    }
}

/// The entries of a flat object, as JSON or as Python writes it, after its opening brace.
struct Entries<'a> {
    rest: &'a str,
    done: bool,
}

impl<'a> Entries<'a> {
    fn entry(&mut self) -> Result<Option<(&'a str, &'a str)>, String> {
        if let Some(after) = self.rest.strip_prefix('}') {
            self.done = true;
            let after = after.trim_start();
            return if after.is_empty() {
                Ok(None)
            } else {
                Err(format!("{:?} follows the object", shortened(after)))
            };
        }
        // Python 2 marks its strings: u'left_s0'.
        let quoted = self.rest.strip_prefix('u').unwrap_or(self.rest);
        let quote = quoted.chars().next().filter(|c| matches!(c, '"' | '\''));
        let quote = quote.ok_or_else(|| self.cut_off())?;
        let (key, after) = quoted[1..].split_once(quote).ok_or_else(|| self.cut_off())?;
        let after = after.trim_start().strip_prefix(':').ok_or_else(|| self.cut_off())?;
        let end = after.find([',', '}']).ok_or_else(|| self.cut_off())?;
        let value = after[..end].trim();
        let after = &after[end..];
        self.rest = after.strip_prefix(',').unwrap_or(after).trim_start();
        Ok(Some((key, value)))
    }

    fn cut_off(&self) -> String {
        if self.rest.is_empty() {
            "the line ends inside the object".into()
        } else {
            format!("an entry is expected at {:?}", shortened(self.rest))
        }
    }
}

impl<'a> Iterator for Entries<'a> {
    type Item = Result<(&'a str, &'a str), String>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.done {
            return None;
        }
        let entry = self.entry();
        if entry.is_err() {
            self.done = true;
        }
        entry.transpose()
    }
}

/// The values at `frames` equal steps of normalised index, each the nearest one: grippers are
/// binary.
fn aligned(values: &[f64], frames: usize) -> Vec<f64> {
    let scale = (values.len() - 1) as f64 / (frames.max(2) - 1) as f64;
    (0..frames).map(|i| values[(i as f64 * scale).round() as usize]).collect()
}

/// Writes a simulated demonstration into `folder/<its id>` as MIME does.
///
/// # Errors
/// A file or the folder can't be written.
pub fn write(folder: &Path, demonstration: &RawDemonstration) -> Result<(), MimeError> {
    let RawDemonstration {
        id,
        joint_names,
        frames,
        grippers,
        stray_lines,
        cut_lines,
        python_syntax,
    } = demonstration;
    let quote = if *python_syntax { '\'' } else { '"' };
    let mut joints = String::with_capacity(frames.len() * 450);
    let mut stray = stray_lines.iter().peekable();
    for (i, frame) in frames.iter().enumerate() {
        while let Some((_, line)) = stray.next_if(|(before, _)| *before <= i) {
            joints.push_str(line);
            joints.push('\n');
        }
        let start = joints.len();
        for (j, (name, value)) in joint_names.iter().zip(frame).enumerate() {
            let separator = if j == 0 { "{" } else { ", " };
            let _ = write!(joints, "{separator}{quote}{name}{quote}: {value:.7}");
        }
        joints.push('}');
        if cut_lines.binary_search(&i).is_ok() {
            joints.truncate(start + (joints.len() - start) * 3 / 5);
        }
        joints.push('\n');
    }
    for (_, line) in stray {
        joints.push_str(line);
        joints.push('\n');
    }
    let gripper = |values: &[f64]| {
        values.iter().fold(String::new(), |mut text, value| {
            let _ = writeln!(text, "{value:.2}");
            text
        })
    };
    let folder = folder.join(id);
    let io = |path: &Path| {
        let path = path.to_path_buf();
        |source| MimeError::Io { path, source }
    };
    std::fs::create_dir_all(&folder).map_err(io(&folder))?;
    let grippers = grippers.iter().map(|(name, values)| (format!("{name}.txt"), gripper(values)));
    for (name, text) in std::iter::once((JOINTS_FILE.to_owned(), joints)).chain(grippers) {
        let path = folder.join(name);
        std::fs::write(&path, text).map_err(io(&path))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::demonstrations::recording::GripperSource;
    use proptest::prelude::*;

    fn channels() -> Channels {
        Channels {
            joints: ["left_s0", "left_s1"].map(String::from).to_vec(),
            grippers: ["left_gripper", "right_gripper"]
                .map(|name| GripperChannel { name: name.into(), source: GripperSource::default() })
                .to_vec(),
            ..Channels::default()
        }
    }

    /// A folder with these files, as a download leaves it.
    fn folder(joints: &str, left: &str, right: &str) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for (name, text) in
            [(JOINTS_FILE, joints), ("left_gripper.txt", left), ("right_gripper.txt", right)]
        {
            std::fs::write(folder.path().join(name), text).unwrap();
        }
        folder
    }

    #[test]
    fn json_and_python_lines_are_read_by_key_and_stray_lines_are_counted() {
        let joints = "{\"head_pan\": 0.1, \"left_s1\": -5.5e-1, \"left_s0\": 0.25}\n\
                      {\"l_gripper_l_finger_joint\": 0.019999999552965164}\n\
                      {'left_s0': 0.5, 'left_s1': -0.25, 'torso_t0': 0.0}\n\
                      0.0123\n\
                      \n\
                      {u'left_s1':1, u'left_s0':2}\r\n";
        let folder = folder(joints, "100.0\n0\n", "97\n97\n97\n");
        let read = read(folder.path(), &channels()).unwrap();
        assert_eq!(read.recording.positions, [[0.25, -0.55], [0.5, -0.25], [2.0, 1.0]]);
        assert_eq!(read.recording.times_secs, [0.0, 0.01, 0.02]);
        assert_eq!((read.stray_lines, read.damaged.len()), (2, 0));
        assert_eq!(read.recording.grippers[0].name, "left_gripper");
    }

    #[test]
    fn grippers_of_another_length_are_aligned_by_normalised_index() {
        let frame = "{\"left_s0\": 0.0, \"left_s1\": 0.0}\n";
        // Closed from 60 % to 80 % of the file, which is 2 % longer than the joints'.
        let gripper: String =
            (0..1020).map(|i| if (612..816).contains(&i) { "3.1\n" } else { "98.4\n" }).collect();
        let folder = folder(&frame.repeat(1000), &gripper, "50\n");
        let read = read(folder.path(), &channels()).unwrap();
        let open = &read.recording.grippers[0].percent_open;
        assert_eq!(open.len(), 1000);
        let closed: Vec<_> = (0..1000).filter(|&i| open[i] < 50.0).collect();
        assert!((closed[0] as i64 - 600).abs() <= 1, "{}", closed[0]);
        assert!((closed[closed.len() - 1] as i64 - 799).abs() <= 1);
        assert_eq!(read.recording.grippers[1].percent_open, [50.0; 1000]);
    }

    #[test]
    fn damage_is_reported_by_file_and_line_all_at_once() {
        let joints = "{\"left_s0\": 0.0, \"left_s1\": 0.0}\n\
                      {\"left_s0\": 0.0, \"left\n\
                      {\"left_s0\": NaN, \"left_s1\": 0.0}\n\
                      {\"left_s0\": 0.0}\n";
        let folder = folder(joints, "100\nopen\n", "100\n");
        let error = read(folder.path(), &channels()).unwrap_err();
        let MimeError::Unreadable { ref problems } = error else { panic!("{error}") };
        let places: Vec<_> = problems.iter().map(|p| p.line).collect();
        assert_eq!(places, [2, 3, 4, 2]);
        assert_eq!(
            error.to_string(),
            "joint_angles.txt:2: an entry is expected at \"\\\"left\"; \
             joint_angles.txt:3: left_s0 is NaN, not a finite number; \
             joint_angles.txt:4: left_s1 is missing; \
             left_gripper.txt:2: \"open\" is not a number"
        );
    }

    #[test]
    fn one_cut_line_in_a_long_recording_is_skipped_and_said() {
        let frame = "{\"left_s0\": 0.0, \"left_s1\": 0.0}\n";
        let folder = folder(&format!("{}{{\"left_s0\": 0.", frame.repeat(300)), "1\n", "1\n");
        let read = read(folder.path(), &channels()).unwrap();
        assert_eq!(read.recording.positions.len(), 300);
        assert_eq!(read.damaged[0].line, 301);
    }

    #[test]
    fn a_missing_gripper_file_is_named() {
        let frame = "{\"left_s0\": 0.0, \"left_s1\": 0.0}\n";
        let folder = folder(&frame.repeat(3), "100\n", "100\n");
        std::fs::remove_file(folder.path().join("right_gripper.txt")).unwrap();
        let error = read(folder.path(), &channels()).unwrap_err();
        assert_eq!(error.to_string(), "right_gripper.txt: the file is missing");
    }

    #[test]
    fn a_file_without_an_end_is_refused_and_damage_without_an_end_is_not_kept() {
        let frame = "{\"left_s0\": 0.0, \"left_s1\": 0.0}\n";
        let folder = folder(&frame.repeat(3), "100\n", "100\n");
        let gripper = folder.path().join("left_gripper.txt");
        std::fs::write(&gripper, "x\n".repeat(MOST_DAMAGED + 7)).unwrap();
        let error = read(folder.path(), &channels()).unwrap_err();
        let MimeError::Unreadable { ref problems } = error else { panic!("{error}") };
        // And that no line holds a number.
        assert_eq!(problems.len(), MOST_DAMAGED + 1);
        let sparse = std::fs::File::create(&gripper).unwrap();
        sparse.set_len(LARGEST_FILE + 1).unwrap();
        let told = read(folder.path(), &channels()).unwrap_err().to_string();
        assert!(told.ends_with("left_gripper.txt: it is larger than 268435456 bytes"), "{told}");
    }

    #[cfg(unix)]
    #[test]
    fn what_is_no_ordinary_file_is_not_read() {
        let folder = folder("", "100\n", "100\n");
        let joints = folder.path().join(JOINTS_FILE);
        std::fs::remove_file(&joints).unwrap();
        std::os::unix::fs::symlink("/dev/zero", &joints).unwrap();
        let told = read(folder.path(), &channels()).unwrap_err().to_string();
        assert!(told.ends_with("joint_angles.txt: it is no ordinary file"), "{told}");
    }

    #[test]
    fn demonstrations_are_found_in_a_task_folder_and_by_themselves() {
        let task = tempfile::tempdir().unwrap();
        for name in ["4316Aug02", "4315Aug02", "notes"] {
            std::fs::create_dir(task.path().join(name)).unwrap();
        }
        std::fs::write(task.path().join("4316Aug02").join(JOINTS_FILE), "").unwrap();
        std::fs::write(task.path().join("4315Aug02/left_gripper.txt"), "").unwrap();
        let names = |path: &Path| -> Vec<_> {
            let found = find(path).unwrap();
            found.iter().map(|f| f.file_name().unwrap().to_string_lossy().into_owned()).collect()
        };
        assert_eq!(names(task.path()), ["4315Aug02", "4316Aug02"]);
        assert_eq!(names(&task.path().join("4316Aug02")), ["4316Aug02"]);
        assert!(matches!(find(&task.path().join("notes")), Err(MimeError::Empty { .. })));
        assert!(matches!(find(&task.path().join("absent")), Err(MimeError::Io { .. })));
        let one = task.path().join("4316Aug02");
        assert_eq!(demonstration_of(&one.join(JOINTS_FILE)), Some(one.as_path()));
        assert_eq!(demonstration_of(&one.join("left_gripper.txt")), Some(one.as_path()));
        assert_eq!(demonstration_of(&one.join("video.mp4")), None);
        assert_eq!(demonstration_of(&task.path().join("notes/a.txt")), None);
    }

    proptest! {
        #[test]
        fn no_line_brings_the_reader_down(line in "[{}'\":, u0-9a-z_.é-]{0,60}") {
            let _ = frame(&line, &channels().joints);
        }

        #[test]
        fn both_syntaxes_give_the_numbers_back(a in -4.0..4.0f64, b in -4.0..4.0f64) {
            let json = format!("{{\"left_s1\": {b}, \"left_s0\": {a:e}}}");
            let python = json.replace('"', "'");
            for line in [json, python] {
                prop_assert_eq!(frame(&line, &channels().joints), Ok(Some(vec![a, b])));
            }
        }
    }
}
