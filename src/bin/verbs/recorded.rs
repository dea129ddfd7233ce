//! A recording of any kind: where it is, and how it is read.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::ensure;
#[cfg(feature = "bag")]
use tcvae::bag::{Bag, BagRecording};
use tcvae::demonstrations::recording::{Channels, JointRecording};
use tcvae::mime::{self, MimeError, MimeRecording};

/// What a recording is, for who gave none.
#[cfg(feature = "bag")]
const KINDS: &str = "a recording is a bag (.mcap, .db3, .bag, or a folder that rosbag2 wrote) or a folder with \
                     joint_angles.txt, as MIME has them";
#[cfg(not(feature = "bag"))]
const KINDS: &str = "a recording is a folder with joint_angles.txt, as MIME has them";

/// Where a recording is.
#[derive(Debug)]
pub(crate) enum Recorded {
    /// A folder in the layout of MIME.
    Mime(PathBuf),
    /// A bag.
    #[cfg(feature = "bag")]
    Bag(Bag),
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
        #[cfg(feature = "bag")]
        let mut found: Vec<Self> = if path.exists() {
            Bag::find(path)?.into_iter().map(Self::Bag).collect()
        } else {
            Vec::new()
        };
        #[cfg(not(feature = "bag"))]
        let mut found = Vec::new();
        if path.is_file() {
            ensure!(!found.is_empty(), "{}: no recording; {KINDS}", path.display());
            return Ok(found);
        }
        match mime::find(path) {
            Ok(folders) => found.extend(folders.into_iter().map(Self::Mime)),
            Err(MimeError::Empty { .. }) => {
                ensure!(!found.is_empty(), "{}: no recording in there; {KINDS}", path.display());
            }
            Err(e) => return Err(e.into()),
        }
        Ok(found)
    }

    /// The folder or file that it is named after.
    pub(crate) fn path(&self) -> &Path {
        match self {
            Self::Mime(folder) => folder,
            #[cfg(feature = "bag")]
            Self::Bag(bag) => &bag.path,
        }
    }

    /// Whether it may hold several demonstrations; in the layout of MIME each has its folder.
    pub(crate) fn may_hold_several(&self) -> bool {
        !matches!(self, Self::Mime(_))
    }

    /// Where that is, whatever links lead there.
    pub(crate) fn place(&self) -> PathBuf {
        fs::canonicalize(self.path()).unwrap_or_else(|_| self.path().to_owned())
    }

    /// Whether a file of this name lies beside it.
    pub(crate) fn has_beside(&self, file: &str) -> bool {
        self.place().parent().is_some_and(|folder| folder.join(file).is_file())
    }

    /// Reads it; what can't be read is told as a reason to leave it out.
    pub(crate) fn read(&self, channels: &Channels) -> Result<Read, String> {
        match self {
            Self::Mime(folder) => {
                let MimeRecording { recording, stray_lines, damaged, digest } =
                    mime::read(folder, channels).map_err(|e| e.to_string())?;
                let skipped = stray_lines + damaged.len();
                Ok(Read { recording, skipped, damage: Vec::new(), digest })
            }
            #[cfg(feature = "bag")]
            Self::Bag(bag) => {
                let BagRecording { recording, messages: _, skipped, damage, digest } =
                    bag.read(channels).map_err(|e| e.to_string())?;
                Ok(Read { recording, skipped, damage, digest })
            }
        }
    }
}
