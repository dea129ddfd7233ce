//! The program's verbs, one module each, and what they share.

pub(crate) mod check;
#[cfg(feature = "ros")]
pub(crate) mod doctor;
pub(crate) mod evaluate;
pub(crate) mod export;
pub(crate) mod inspect;
mod metrics;
#[cfg(all(feature = "ros", feature = "bag"))]
pub(crate) mod record;
mod recorded;
pub(crate) mod report;
pub(crate) mod sample;
pub(crate) mod simulate;
pub(crate) mod sources;
pub(crate) mod sweep;
pub(crate) mod train;

#[cfg(unix)]
use std::fs::Permissions;
use std::io::{self, BufWriter, Write};
use std::path::Path;
use std::sync::Arc;

use serde::Serialize;

use tcvae::artifact::Artifact;
use tcvae::serving::{self, PrimitiveServer};
use tcvae::{config, urdf};

/// How a verb ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ExitStatus {
    /// All that was asked for is done.
    Done = 0,
    /// It is done, and the result is below what was asked.
    BelowAsked = 1,
    /// The command can't be carried out as it was given.
    WrongUsage = 2,
    /// The data, or a model, can't be used.
    BadData = 3,
}

impl ExitStatus {
    /// The status of an error: wrong usage where it says so, else bad data.
    pub(crate) fn of(error: &anyhow::Error) -> Self {
        if error.is::<UsageError>() { Self::WrongUsage } else { Self::BadData }
    }
}

/// A command that can't be carried out as it was given.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(crate) struct UsageError(pub(crate) String);

/// Prints a line to stdout. A reader that has gone away, as after `| head`, is no error.
pub(crate) fn print_line(line: &str) {
    let _ = writeln!(io::stdout(), "{line}");
}

/// Prints an answer as JSON to stdout.
pub(crate) fn print_json(answer: &impl Serialize) {
    let text = serde_json::to_string_pretty(answer).expect("an answer is JSON");
    print_line(&text);
}

/// Writes a file beside its place first, so that no one reads half of it; readable by all.
pub(crate) fn write_whole(path: &Path, text: &str) -> anyhow::Result<()> {
    write_with(path, |file| Ok(file.write_all(text.as_bytes())?))
}

/// Writes a file bit by bit, likewise.
pub(crate) fn write_with(
    path: &Path,
    content: impl FnOnce(&mut dyn Write) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    let refused = |e: std::io::Error| UsageError(format!("writing {}: {e}", path.display()));
    let folder = match path.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    };
    if !folder.is_dir() {
        let (path, folder) = (path.display(), folder.display());
        let reason = format!("writing {path}: there is no folder {folder}; make it");
        return Err(UsageError(reason).into());
    }
    let file = tempfile::NamedTempFile::new_in(folder).map_err(refused)?;
    let mut buffer = BufWriter::new(file);
    content(&mut buffer)?;
    let file = buffer.into_inner().map_err(|e| refused(e.into_error()))?;
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        file.as_file().set_permissions(Permissions::from_mode(0o644)).map_err(refused)?;
    }
    file.persist(path).map_err(|e| refused(e.error))?;
    Ok(())
}

/// A server of a model on the robot of a TOML file, or on Baxter's left arm.
pub(crate) fn server(
    artifact: &Artifact,
    robot: Option<&Path>,
    settings: serving::Settings,
) -> anyhow::Result<PrimitiveServer> {
    let robot = config::robot(robot, urdf::arm)?.served();
    let model = Arc::new(artifact.served_model()?);
    Ok(PrimitiveServer::new(model, Arc::new(robot), settings)?)
}

/// `--set KEY=VALUE` settings, looked up by name; what nobody looked up is refused in the end.
#[derive(Debug)]
pub(crate) struct Settings {
    pairs: Vec<(String, String)>,
    known: Vec<&'static str>,
}

impl Settings {
    /// Settings in the form `key=value`.
    pub(crate) fn new(set: &[String]) -> anyhow::Result<Self> {
        let pair = |setting: &String| match setting.split_once('=') {
            Some((key, value)) => Ok((key.trim().to_owned(), value.trim().to_owned())),
            None => Err(UsageError(format!("--set {setting}: write it as KEY=VALUE"))),
        };
        let pairs = set.iter().map(pair).collect::<Result<_, _>>()?;
        Ok(Self { pairs, known: Vec::new() })
    }

    /// The last value of a key, read by `parse`; `default` where it was not set.
    pub(crate) fn get<T>(
        &mut self,
        key: &'static str,
        default: T,
        expected: &str,
        parse: impl Fn(&str) -> Option<T>,
    ) -> anyhow::Result<T> {
        self.known.push(key);
        let Some((_, value)) = self.pairs.iter().rev().find(|(k, _)| k == key) else {
            return Ok(default);
        };
        let refused = || UsageError(format!("--set {key}={value}: {key} is {expected}"));
        Ok(parse(value).ok_or_else(refused)?)
    }

    /// Refuses keys that nobody looked up.
    pub(crate) fn finish(self) -> anyhow::Result<()> {
        let Self { pairs, known } = self;
        match pairs.iter().find(|(key, _)| !known.contains(&key.as_str())) {
            None => Ok(()),
            Some((key, _)) => {
                let known = known.join(", ");
                Err(UsageError(format!("--set {key}: unknown; known are: {known}")).into())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(set: &[&str]) -> Settings {
        Settings::new(&set.iter().map(|s| s.to_string()).collect::<Vec<_>>()).unwrap()
    }

    fn steps(settings: &mut Settings) -> anyhow::Result<usize> {
        settings.get("steps", 32, "a whole number", |v| v.parse().ok())
    }

    #[test]
    fn the_last_setting_counts_and_what_is_not_set_keeps_its_default() {
        assert_eq!(steps(&mut settings(&["steps=8", "steps=16"])).unwrap(), 16);
        assert_eq!(steps(&mut settings(&[])).unwrap(), 32);
    }

    #[test]
    fn a_setting_that_is_none_is_wrong_usage() {
        let mut wrong = settings(&["steps=many"]);
        let error = steps(&mut wrong).unwrap_err();
        assert_eq!(error.to_string(), "--set steps=many: steps is a whole number");
        assert_eq!(ExitStatus::of(&error), ExitStatus::WrongUsage);
        let mut unknown = settings(&["step=3"]);
        steps(&mut unknown).unwrap();
        assert_eq!(
            unknown.finish().unwrap_err().to_string(),
            "--set step: unknown; known are: steps"
        );
        assert!(Settings::new(&["steps".to_owned()]).is_err());
    }
}
