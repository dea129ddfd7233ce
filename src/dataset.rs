//! Folders of simulated arcs, in files that other programs read.
//!
//! | file | content |
//! |---|---|
//! | `dataset.json` | format, version, the task with its settings, what was simulated |
//! | `train.csv`, `validation.csv`, `test.csv` | one point a line: `id,step,x,y` |
//! | `truth.json` | the arcs that the points were drawn from; for checks, never read back |
//!
//! The task parameters of a demonstration that is read are measured from its points, as those of a
//! recording are. Numbers are written with all their digits, so that reading gives what was
//! written and the same seed gives the same bytes.

use std::collections::HashSet;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::json;
use sha2::{Digest, Sha256};

use crate::demonstrations::arcs::{ArcsSimulation, ArcsTask, SimulatedArcs};
use crate::demonstrations::{Demonstration, Splits, TaskConfig};
use crate::trajectory::{Motion, Trajectory};

const FORMAT: &str = "tcvae-arcs";
const VERSION: u32 = 1;
const MANIFEST: &str = "dataset.json";
const TRUTH: &str = "truth.json";
const PARTS: [&str; 3] = ["train.csv", "validation.csv", "test.csv"];
const HEADER: &str = "id,step,x,y";

/// Why a data set can't be written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DataSetError {
    /// The operating system refused.
    #[error("{action} {}: {source}", path.display())]
    Io {
        /// What was tried.
        action: &'static str,
        /// On which file or folder.
        path: PathBuf,
        /// Its answer.
        source: io::Error,
    },
    /// The folder to write holds something already.
    #[error("{} is not empty: it holds {found}; choose a new folder", path.display())]
    NotEmpty {
        /// The folder.
        path: PathBuf,
        /// One of the entries that it holds.
        found: String,
    },
    /// The folder to read holds no data set.
    #[error(
        "{} has no {MANIFEST}, so it is no finished data set; `tcvae simulate arcs` writes one",
        path.display()
    )]
    NoDataSet {
        /// The folder.
        path: PathBuf,
    },
    /// The manifest says something else than it should.
    #[error("{}: {detail}", path.display())]
    Manifest {
        /// The manifest.
        path: PathBuf,
        /// What is wrong.
        detail: String,
    },
    /// A line says something else than it should.
    #[error("{}, line {line}: {detail}", path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// The line, counted from 1.
        line: usize,
        /// What is wrong.
        detail: String,
    },
    /// A demonstration does not show its task.
    #[error("{}, demonstration {id}: {detail}", path.display())]
    Demonstration {
        /// The file.
        path: PathBuf,
        /// The demonstration.
        id: String,
        /// What is wrong.
        detail: String,
    },
}

/// What stands in `dataset.json`.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Manifest {
    format: String,
    version: u32,
    task: TaskConfig,
    seed: u64,
    count: usize,
    steps: usize,
}

/// A data set that was read.
#[derive(Debug, Clone, PartialEq)]
pub struct DataSet {
    /// The task that the demonstrations show.
    pub task: TaskConfig,
    /// The demonstrations.
    pub splits: Splits,
    /// SHA-256 over the files that were read, in hexadecimal digits.
    pub digest: String,
}

/// Writes simulated arcs into a folder that does not exist or is empty.
///
/// # Errors
/// A folder that can't be made, or holds something; a file that can't be written.
pub fn save(
    folder: &Path,
    simulation: &ArcsSimulation,
    seed: u64,
    simulated: &SimulatedArcs,
) -> Result<(), DataSetError> {
    let io = |action, path: &Path| {
        let path = path.to_owned();
        move |source| DataSetError::Io { action, path, source }
    };
    fs::create_dir_all(folder).map_err(io("cannot make the folder", folder))?;
    let mut entries = fs::read_dir(folder).map_err(io("cannot look into", folder))?;
    if let Some(entry) = entries.next() {
        let found = match entry {
            Ok(entry) => entry.file_name().to_string_lossy().into_owned(),
            Err(source) => return Err(io("cannot look into", folder)(source)),
        };
        return Err(DataSetError::NotEmpty { path: folder.to_owned(), found });
    }
    let write = |name: &str, content: &dyn Fn(&mut BufWriter<File>) -> io::Result<()>| {
        let path = folder.join(name);
        let write = || -> io::Result<()> {
            let mut file = BufWriter::new(File::create(&path)?);
            content(&mut file)?;
            file.flush()
        };
        write().map_err(io("cannot write", &path))
    };
    let task = ArcsTask::new(simulation.start);
    let SimulatedArcs { splits, arcs } = simulated;
    let Splits { train, validation, test } = splits;
    for (name, part) in PARTS.into_iter().zip([train, validation, test]) {
        write(name, &|file| {
            writeln!(file, "{HEADER}")?;
            for Demonstration { id, motion, .. } in part {
                for (step, state) in motion.states.states().enumerate() {
                    writeln!(file, "{id},{step},{},{}", state[0], state[1])?;
                }
            }
            Ok(())
        })?;
    }
    write(TRUTH, &|file| {
        let truth = |(demonstration, arc): (&Demonstration, _)| {
            let factors = task.factors_of(arc).into_iter();
            let factors: serde_json::Map<_, _> =
                factors.map(|f| (f.name.into_owned(), json!(f.value))).collect();
            let center = demonstration.w.location(0);
            let id = &demonstration.id;
            json!({ "id": id, "expected": "accept", "task": { "center": center }, "factors": factors })
        };
        let all = train.iter().chain(validation).chain(test).zip(arcs);
        let demonstrations: Vec<_> = all.map(truth).collect();
        serde_json::to_writer(&mut *file, &json!({ "demonstrations": demonstrations }))?;
        writeln!(file)
    })?;
    // Last, so that a folder with a manifest is whole.
    let ArcsSimulation { count, steps, start: _ } = *simulation;
    let (format, version) = (FORMAT.into(), VERSION);
    let task = TaskConfig::Arcs(task);
    let manifest = Manifest { format, version, task, seed, count, steps };
    write(MANIFEST, &|file| {
        serde_json::to_writer_pretty(&mut *file, &manifest)?;
        writeln!(file)
    })
}

/// Whether the folder holds a data set of this format.
pub fn is_data_set(folder: &Path) -> bool {
    folder.join(MANIFEST).is_file()
}

/// Reads a data set.
///
/// # Errors
/// A folder without a manifest, a newer format, a line that is not a point, points that are no arc;
/// with file and line.
pub fn load(folder: &Path) -> Result<DataSet, DataSetError> {
    if !is_data_set(folder) {
        return Err(DataSetError::NoDataSet { path: folder.to_owned() });
    }
    let mut digest = Sha256::new();
    let mut read = |name: &str| {
        let path = folder.join(name);
        match fs::read_to_string(&path) {
            Ok(text) => {
                digest.update(format!("{name} {}\n", text.len()));
                digest.update(&text);
                Ok((path, text))
            }
            Err(source) => Err(DataSetError::Io { action: "cannot read", path, source }),
        }
    };
    let (path, text) = read(MANIFEST)?;
    let task = manifest(&text).map_err(|detail| DataSetError::Manifest { path, detail })?.task;
    let mut ids = HashSet::new();
    let mut parts = Vec::with_capacity(PARTS.len());
    for name in PARTS {
        let (path, text) = read(name)?;
        parts.push(demonstrations(&path, &text, &task, &mut ids)?);
    }
    let [train, validation, test] = parts.try_into().expect("as many parts as names");
    let splits = Splits { train, validation, test };
    let digest = digest.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
    Ok(DataSet { task, splits, digest })
}

fn manifest(text: &str) -> Result<Manifest, String> {
    // Format and version come first: a newer version may have other fields.
    #[derive(Deserialize)]
    struct Kind {
        format: String,
        version: u32,
    }
    let Kind { format, version } = serde_json::from_str(text).map_err(|e| e.to_string())?;
    if format != FORMAT {
        return Err(format!("the format is {format:?}; this program reads {FORMAT:?}"));
    }
    if version > VERSION {
        return Err(format!(
            "format version {version} is newer than {VERSION}, the newest that this program \
             reads; update the program"
        ));
    }
    serde_json::from_str(text).map_err(|e| e.to_string())
}

/// The demonstrations of one file, in its order.
fn demonstrations(
    path: &Path,
    text: &str,
    task: &TaskConfig,
    ids: &mut HashSet<String>,
) -> Result<Vec<Demonstration>, DataSetError> {
    let at = |line, detail| DataSetError::Line { path: path.to_owned(), line, detail };
    let mut lines = text.lines().zip(1..);
    match lines.next() {
        Some((HEADER, _)) => {}
        found => {
            let found = found.map_or("", |(header, _)| header);
            return Err(at(1, format!("the header is {found:?} where {HEADER:?} is needed")));
        }
    }
    let mut finished = Vec::new();
    let mut current: Option<(&str, Vec<f64>)> = None;
    let mut finish = |(id, values): (&str, Vec<f64>)| {
        let demonstration = demonstration(id, values, task);
        finished.push(demonstration.map_err(|detail| {
            let id = id.to_owned();
            DataSetError::Demonstration { path: path.to_owned(), id, detail }
        })?);
        Ok(())
    };
    for (text, line) in lines {
        let Point { id, step, state } = point(text).map_err(|detail| at(line, detail))?;
        if current.as_ref().is_none_or(|(current, _)| *current != id) {
            if !ids.insert(id.to_owned()) {
                return Err(at(line, format!("the demonstration {id} stood before already")));
            }
            if let Some(whole) = current.replace((id, Vec::new())) {
                finish(whole)?;
            }
        }
        let values = &mut current.as_mut().expect("a demonstration was begun").1;
        let expected = values.len() / state.len();
        if step != expected {
            return Err(at(line, format!("step {step} of {id} where step {expected} is needed")));
        }
        values.extend(state);
    }
    if let Some(whole) = current {
        finish(whole)?;
    }
    Ok(finished)
}

struct Point<'a> {
    id: &'a str,
    step: usize,
    state: [f64; 2],
}

fn point(line: &str) -> Result<Point<'_>, String> {
    let fields: Vec<&str> = line.split(',').collect();
    let &[id, step, x, y] = fields.as_slice() else {
        return Err(format!("{} fields where {HEADER} are needed", fields.len()));
    };
    let number = |name: &str, text: &str| match text.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        _ => Err(format!("{name} is {text:?}; a finite number is needed")),
    };
    let step = step.parse().map_err(|_| format!("step is {step:?}; a whole number is needed"))?;
    Ok(Point { id, step, state: [number("x", x)?, number("y", y)?] })
}

fn demonstration(id: &str, values: Vec<f64>, task: &TaskConfig) -> Result<Demonstration, String> {
    let states = Trajectory::new(2, values).map_err(|e| e.to_string())?;
    let motion = Motion { states, duration_secs: ArcsTask::DURATION_SECS };
    let w = task.task().empirical_task(&motion).map_err(|e| e.to_string())?;
    Ok(Demonstration { id: id.into(), w, motion, events: Vec::new() })
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;

    use super::*;
    use crate::demonstrations::arcs::{ArcStart, simulate};

    const SIMULATION: ArcsSimulation =
        ArcsSimulation { count: 20, steps: 16, start: ArcStart::Full };

    fn simulated(seed: u64) -> SimulatedArcs {
        simulate(&SIMULATION, &mut ChaCha8Rng::seed_from_u64(seed))
    }

    fn saved() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        save(folder.path(), &SIMULATION, 1, &simulated(1)).unwrap();
        folder
    }

    /// What reading says after one edit of a file.
    fn refusal(file: &str, edit: impl Fn(&str) -> String) -> String {
        let folder = saved();
        let path = folder.path().join(file);
        let text = fs::read_to_string(&path).unwrap();
        let edited = edit(&text);
        assert_ne!(text, edited);
        fs::write(&path, edited).unwrap();
        let error = load(folder.path()).unwrap_err().to_string();
        error.replace(&format!("{}/", folder.path().display()), "")
    }

    #[test]
    fn what_was_saved_is_loaded_with_its_task_measured() {
        let folder = saved();
        let loaded = load(folder.path()).unwrap();
        assert_eq!(loaded.task, TaskConfig::Arcs(ArcsTask::new(ArcStart::Full)));
        let expected = simulated(1).splits;
        for (loaded, expected) in [
            (&loaded.splits.train, &expected.train),
            (&loaded.splits.validation, &expected.validation),
            (&loaded.splits.test, &expected.test),
        ] {
            assert_eq!(loaded.len(), expected.len());
            for (loaded, expected) in loaded.iter().zip(expected) {
                assert_eq!((&loaded.id, &loaded.motion), (&expected.id, &expected.motion));
                assert!(ArcsTask::task_space().distance(&loaded.w, &expected.w) < 1e-9);
            }
        }
        assert_eq!(loaded.digest.len(), 64);
    }

    #[test]
    fn the_digest_changes_with_a_digit() {
        let digest = load(saved().path()).unwrap().digest;
        assert_eq!(digest, load(saved().path()).unwrap().digest);
        let folder = saved();
        let path = folder.path().join("test.csv");
        let text = fs::read_to_string(&path).unwrap();
        let last = if text.ends_with("1\n") { "2\n" } else { "1\n" };
        fs::write(&path, format!("{}{last}", &text[..text.len() - 2])).unwrap();
        assert_ne!(digest, load(folder.path()).unwrap().digest);
    }

    #[test]
    fn the_truth_holds_every_arc_by_the_factors_of_the_task() {
        let folder = saved();
        let truth = fs::read_to_string(folder.path().join(TRUTH)).unwrap();
        let truth: serde_json::Value = serde_json::from_str(&truth).unwrap();
        let demonstrations = truth["demonstrations"].as_array().unwrap();
        assert_eq!(demonstrations.len(), 20);
        let simulated = simulated(1);
        assert_eq!(demonstrations[19]["id"], "test-00001");
        assert_eq!(demonstrations[19]["expected"], "accept");
        assert_eq!(demonstrations[19]["task"]["center"], json!(simulated.arcs[19].center));
        assert_eq!(demonstrations[19]["factors"]["radius"], simulated.arcs[19].radius);
        assert_eq!(demonstrations[19]["factors"]["start_cos"], simulated.arcs[19].start_rad.cos());
    }

    #[test]
    fn a_folder_that_holds_something_is_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("notes.txt"), "mine").unwrap();
        let error = save(folder.path(), &SIMULATION, 1, &simulated(1)).unwrap_err();
        assert!(
            error.to_string().ends_with("is not empty: it holds notes.txt; choose a new folder")
        );
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_folder_that_cannot_be_made_is_refused_with_the_systems_reason() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        fs::write(&file, "").unwrap();
        let error = save(&file.join("data"), &SIMULATION, 1, &simulated(1)).unwrap_err();
        assert!(error.to_string().starts_with("cannot make the folder"), "{error}");
    }

    #[test]
    fn an_empty_folder_is_no_data_set() {
        let folder = tempfile::tempdir().unwrap();
        let error = load(folder.path()).unwrap_err();
        assert!(matches!(error, DataSetError::NoDataSet { .. }));
        assert!(error.to_string().contains("has no dataset.json"));
    }

    #[test]
    fn a_missing_part_is_named() {
        let folder = saved();
        fs::remove_file(folder.path().join("validation.csv")).unwrap();
        let error = load(folder.path()).unwrap_err().to_string();
        assert!(error.contains("cannot read") && error.contains("validation.csv"), "{error}");
    }

    #[test]
    fn a_damaged_line_is_refused_by_file_and_line() {
        let third = |new: &'static str| {
            move |text: &str| {
                let mut lines: Vec<&str> = text.lines().collect();
                lines[2] = new;
                lines.join("\n")
            }
        };
        for (line, reason) in [
            ("train-00000,1,0.5", "3 fields where id,step,x,y are needed"),
            ("train-00000,1,0.5,nan", "y is \"nan\"; a finite number is needed"),
            ("train-00000,1,0.5,", "y is \"\"; a finite number is needed"),
            ("train-00000,-1,0.5,0.5", "step is \"-1\"; a whole number is needed"),
            ("train-00000,2,0.5,0.5", "step 2 of train-00000 where step 1 is needed"),
        ] {
            let found = refusal("train.csv", third(line));
            assert_eq!(found, format!("train.csv, line 3: {reason}"));
        }
        assert_eq!(
            refusal("test.csv", |text| text.replacen("id,step", "name,step", 1)),
            "test.csv, line 1: the header is \"name,step,x,y\" where \"id,step,x,y\" is needed"
        );
        assert_eq!(
            refusal("test.csv", |text| text.replace("test-00001", "train-00001")),
            "test.csv, line 18: the demonstration train-00001 stood before already"
        );
    }

    #[test]
    fn points_that_are_no_arc_are_refused_by_their_demonstration() {
        let refusal =
            refusal("test.csv", |_| "id,step,x,y\na,0,0,0\na,1,1,1\na,2,2,2\na,3,3,3\n".to_owned());
        assert!(refusal.starts_with("test.csv, demonstration a: the points lie on a line"));
    }

    #[test]
    fn a_newer_or_a_foreign_format_is_refused() {
        assert!(
            refusal(MANIFEST, |text| text.replace("\"version\": 1", "\"version\": 2"))
                .contains("format version 2 is newer than 1")
        );
        assert!(
            refusal(MANIFEST, |text| text.replace(FORMAT, "other")).contains("format is \"other\"")
        );
        assert!(refusal(MANIFEST, |text| text[..20].to_owned()).starts_with("dataset.json: "));
    }
}
