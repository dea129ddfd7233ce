//! A recording of any kind: where it is, and how it is read.

use std::fs;
use std::path::{Path, PathBuf};
#[cfg(feature = "bag")]
use std::sync::Arc;

use anyhow::ensure;
#[cfg(feature = "bag")]
use tcvae::archive::{self, LeftOut, Unpacked};
#[cfg(feature = "bag")]
use tcvae::bag::{self, Bag, BagRecording};
#[cfg(feature = "bag")]
use tcvae::csv::{self, CsvRecording};
use tcvae::demonstrations::recording::{Channels, JointRecording};
use tcvae::mime::{self, MimeError, MimeRecording};

#[cfg(feature = "bag")]
use super::simulate::TRUTH_FILE;

/// What a recording is, for who gave none.
#[cfg(feature = "bag")]
const KINDS: &str = "a recording is a bag (.mcap, .db3, .bag, or a folder that rosbag2 wrote), a table (.csv), a \
                     folder with joint_angles.txt, as MIME has them, or a .zip of these";
#[cfg(not(feature = "bag"))]
const KINDS: &str = "a recording is a folder with joint_angles.txt, as MIME has them";

/// A recording: what it is, and where.
#[derive(Debug)]
pub(crate) struct Recorded {
    source: Source,
    /// The folder or file that it is named after; within an archive below that.
    path: PathBuf,
    /// What it was unpacked from.
    #[cfg(feature = "bag")]
    archive: Option<Arc<Archive>>,
}

/// What a recording is.
#[derive(Debug)]
enum Source {
    /// A folder in the layout of MIME.
    Mime(PathBuf),
    /// A bag.
    #[cfg(feature = "bag")]
    Bag(Bag),
    /// A table.
    #[cfg(feature = "bag")]
    Csv(PathBuf),
    /// What can't be read, and why.
    #[cfg(feature = "bag")]
    Unreadable(String),
}

/// An archive, and where its files are for now.
#[cfg(feature = "bag")]
#[derive(Debug)]
struct Archive {
    path: PathBuf,
    unpacked: Unpacked,
}

/// A recording that was read.
#[derive(Debug)]
pub(crate) struct Read {
    pub(crate) recording: JointRecording,
    /// Lines, or messages and values, that were skipped.
    pub(crate) skipped: usize,
    /// What is damaged of it.
    pub(crate) damage: Vec<String>,
    /// SHA-256 over what was read.
    pub(crate) digest: String,
}

impl Recorded {
    /// All recordings at a path.
    pub(crate) fn find(path: &Path) -> anyhow::Result<Vec<Self>> {
        let mut found = Vec::new();
        #[cfg(feature = "bag")]
        if path.exists() {
            found.extend(Bag::find(path)?.into_iter().map(|bag| Self::new(Source::Bag(bag))));
            let is_part_of_a_bag =
                |file: &Path| found.iter().any(|bag| file.starts_with(bag.path()));
            let (mut tables, mut archives) = (Vec::new(), Vec::new());
            for file in bag::files(path)? {
                if csv::is_table(&file) && !is_part_of_a_bag(&file) {
                    tables.push(Self::new(Source::Csv(file)));
                } else if archive::is_archive(&file) && !is_part_of_a_bag(&file) {
                    archives.extend(Self::find_in_archive(&file)?);
                }
            }
            found.extend(tables);
            found.extend(archives);
        }
        // A file of a demonstration stands for its folder.
        let folder = mime::demonstration_of(path).filter(|_| path.is_file()).unwrap_or(path);
        if folder.is_file() {
            ensure!(!found.is_empty(), "{}: no recording; {KINDS}", path.display());
            return Ok(found);
        }
        match mime::find(folder) {
            Ok(folders) => {
                found.extend(folders.into_iter().map(|folder| Self::new(Source::Mime(folder))));
            }
            Err(MimeError::Empty { .. }) => {
                ensure!(!found.is_empty(), "{}: no recording in there; {KINDS}", path.display());
            }
            Err(e) => return Err(e.into()),
        }
        Ok(found)
    }

    fn new(source: Source) -> Self {
        let path = match &source {
            Source::Mime(path) => path.clone(),
            #[cfg(feature = "bag")]
            Source::Bag(bag) => bag.path.clone(),
            #[cfg(feature = "bag")]
            Source::Csv(path) => path.clone(),
            #[cfg(feature = "bag")]
            Source::Unreadable(_) => PathBuf::new(),
        };
        Self {
            source,
            path,
            #[cfg(feature = "bag")]
            archive: None,
        }
    }

    /// The recordings in an archive, named as if it was a folder. Archives in it are passed over.
    #[cfg(feature = "bag")]
    fn find_in_archive(path: &Path) -> anyhow::Result<Vec<Self>> {
        let is_asked_for = |name: &str| {
            let file = Path::new(name);
            bag::is_part(file) || csv::is_table(file) || mime::is_part(file) || name == TRUTH_FILE
        };
        let unreadable = |path: PathBuf, reason: String| Self {
            source: Source::Unreadable(reason),
            path,
            archive: None,
        };
        let unpacked = match archive::unpack(path, is_asked_for) {
            Ok(unpacked) => unpacked,
            Err(e) => return Ok(vec![unreadable(path.into(), e.to_string())]),
        };
        let left_out = unpacked.left_out.iter();
        let mut left_out: Vec<_> = left_out
            .map(|LeftOut { name, reason }| unreadable(path.join(name), reason.clone()))
            .collect();
        let archive = Arc::new(Archive { path: path.into(), unpacked });
        let mut found = Self::find(archive.unpacked.folder()).unwrap_or_default();
        if found.is_empty() && left_out.is_empty() {
            return Ok(vec![unreadable(path.into(), format!("no recording in there; {KINDS}"))]);
        }
        for recorded in &mut found {
            let inside = recorded.path.strip_prefix(archive.unpacked.folder());
            let inside = inside.map(Path::to_owned).unwrap_or_default();
            // Files at its top are a demonstration that is named after the archive.
            recorded.path = match inside.as_os_str().is_empty() {
                true => path.with_extension(""),
                false => path.join(inside),
            };
            recorded.archive = Some(archive.clone());
        }
        found.append(&mut left_out);
        Ok(found)
    }

    /// The folder or file that it is named after.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Whether it may hold several demonstrations; in the layout of MIME each has its folder.
    pub(crate) fn may_hold_several(&self) -> bool {
        !matches!(self.source, Source::Mime(_))
    }

    /// Where that is, whatever links lead there.
    pub(crate) fn place(&self) -> PathBuf {
        #[cfg(feature = "bag")]
        if let Some(archive) = &self.archive {
            let place = fs::canonicalize(&archive.path).unwrap_or_else(|_| archive.path.clone());
            let inside = self.path.strip_prefix(&archive.path).unwrap_or(Path::new(""));
            return place.join(inside);
        }
        fs::canonicalize(self.path()).unwrap_or_else(|_| self.path().to_owned())
    }

    /// Whether a file of this name lies beside it.
    pub(crate) fn has_beside(&self, file: &str) -> bool {
        let is_beside =
            |path: &Path| path.parent().is_some_and(|folder| folder.join(file).is_file());
        #[cfg(feature = "bag")]
        if self.archive.is_some() {
            let unpacked = match &self.source {
                Source::Mime(path) | Source::Csv(path) => path,
                Source::Bag(bag) => &bag.path,
                Source::Unreadable(_) => return false,
            };
            return is_beside(unpacked) || unpacked.join(file).is_file();
        }
        is_beside(&self.place())
    }

    /// Reads it; what can't be read is told as a reason to leave it out.
    pub(crate) fn read(&self, channels: &Channels) -> Result<Read, String> {
        match &self.source {
            Source::Mime(folder) => {
                let MimeRecording { recording, stray_lines, damaged, digest } =
                    mime::read(folder, channels).map_err(|e| self.told(&e))?;
                let skipped = stray_lines + damaged.len();
                Ok(Read { recording, skipped, damage: Vec::new(), digest })
            }
            #[cfg(feature = "bag")]
            Source::Bag(bag) => {
                let BagRecording { recording, messages: _, skipped, damage, digest } =
                    bag.read(channels).map_err(|e| self.told(&e))?;
                Ok(Read { recording, skipped, damage, digest })
            }
            #[cfg(feature = "bag")]
            Source::Csv(path) => {
                let CsvRecording { recording, skipped, damage, digest } =
                    csv::read(path, channels).map_err(|e| self.told(&e))?;
                Ok(Read { recording, skipped, damage, digest })
            }
            #[cfg(feature = "bag")]
            Source::Unreadable(reason) => Err(reason.clone()),
        }
    }

    /// What is wrong, in the names of an archive rather than of where it is unpacked.
    fn told(&self, error: &dyn std::error::Error) -> String {
        let told = error.to_string();
        #[cfg(feature = "bag")]
        if let Some(archive) = &self.archive {
            let folder = archive.unpacked.folder().to_string_lossy();
            return told.replace(&*folder, &archive.path.to_string_lossy());
        }
        told
    }
}
