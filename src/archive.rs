//! Zip archives of recordings: what is asked for in one is unpacked into a folder that goes when it is no
//! more needed.
//!
//! Whoever made the archive, nothing is written outside that folder, and not more than a bound that grows
//! with the archive's size: its files may not grow more than recordings do.

use std::fs::{self, File};
use std::io::{self, BufReader, Read};
use std::path::{Component, Path, PathBuf};

use flate2::bufread::DeflateDecoder;
use rawzip::{CompressionMethod, FileReader, ZipArchive, ZipArchiveEntryWayfinder};
use tempfile::TempDir;

/// How much larger than the archive what is unpacked may be, where that is more than [`ALWAYS_ALLOWED`].
const LARGEST_GROWTH: u64 = 200;

/// Bytes that may be unpacked of an archive of any size.
const ALWAYS_ALLOWED: u64 = 256 << 20;

/// Files that are unpacked.
const MOST_FILES: usize = 100_000;

/// Files that can't be unpacked which are told.
const LISTED: usize = 20;

/// Why nothing is unpacked.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ArchiveError {
    /// The archive can't be read, or nothing be written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The archive.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// The file is no archive, or a damaged one.
    #[error("{}: no zip archive can be read: {source}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: rawzip::Error,
    },
    /// It would grow out of proportion, as only damage or malice makes it.
    #[error(
        "{}: what is asked for in it is more than {limit} {what}; unpack it and name the folder",
        path.display()
    )]
    Large {
        /// The archive.
        path: PathBuf,
        /// The limit.
        limit: u64,
        /// Of what.
        what: &'static str,
    },
}

/// What was unpacked; goes with this.
#[derive(Debug)]
pub struct Unpacked {
    folder: TempDir,
    /// Files that are asked for and can't be unpacked, with the reason; no more than 20 of them.
    pub left_out: Vec<LeftOut>,
}

/// A file that can't be unpacked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LeftOut {
    /// Its name in the archive.
    pub name: String,
    /// Why.
    pub reason: String,
}

impl Unpacked {
    /// Where the files are.
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }
}

/// Whether a file has the name of an archive.
pub fn is_archive(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("zip"))
}

/// Unpacks the files whose own names are asked for.
///
/// # Errors
/// The archive can't be read, is damaged, or would unpack to more than 200 times its size.
pub fn unpack(path: &Path, is_asked_for: impl Fn(&str) -> bool) -> Result<Unpacked, ArchiveError> {
    unpack_within(path, is_asked_for, ALWAYS_ALLOWED)
}

fn unpack_within(
    path: &Path,
    is_asked_for: impl Fn(&str) -> bool,
    always_allowed: u64,
) -> Result<Unpacked, ArchiveError> {
    let io = |source| ArchiveError::Io { path: path.into(), source };
    let damaged = |source| ArchiveError::Damaged { path: path.into(), source };
    let folder = tempfile::Builder::new().prefix("tcvae-").tempdir().map_err(io)?;
    let mut unpacked = Unpacked { folder, left_out: Vec::new() };
    let file = File::open(path).map_err(io)?;
    let size = file.metadata().map_err(io)?.len();
    let limit = size.saturating_mul(LARGEST_GROWTH).max(always_allowed);
    let mut buffer = vec![0; rawzip::RECOMMENDED_BUFFER_SIZE];
    let archive = ZipArchive::from_file(file, &mut buffer).map_err(damaged)?;
    let mut entries = archive.entries(&mut buffer);
    let (mut left, mut files) = (limit, 0);
    while let Some(entry) = entries.next_entry().map_err(damaged)? {
        let name = String::from_utf8_lossy(entry.file_path().as_bytes()).into_owned();
        let own = name.rsplit(['/', '\\']).next().unwrap_or_default();
        // macOS puts what it knows of a file beside it.
        if entry.is_dir() || own.starts_with("._") || !is_asked_for(own) {
            continue;
        }
        files += 1;
        if files > MOST_FILES {
            let limit = MOST_FILES as u64;
            return Err(ArchiveError::Large { path: path.into(), limit, what: "files" });
        }
        let file = Entry {
            name: &name,
            method: entry.compression_method(),
            is_encrypted: entry.flags().is_encrypted(),
            wayfinder: entry.wayfinder(),
        };
        match file.unpack(&archive, unpacked.folder(), left) {
            Ok(written) if written > left => {
                return Err(ArchiveError::Large { path: path.into(), limit, what: "bytes" });
            }
            Ok(written) => left -= written,
            Err(reason) if unpacked.left_out.len() < LISTED => {
                unpacked.left_out.push(LeftOut { name, reason });
            }
            Err(_) => {}
        }
    }
    Ok(unpacked)
}

/// A file in an archive.
struct Entry<'a> {
    name: &'a str,
    method: CompressionMethod,
    is_encrypted: bool,
    wayfinder: ZipArchiveEntryWayfinder,
}

impl Entry<'_> {
    /// Writes no more than one byte beyond `most` of the file below a folder; returns the bytes.
    fn unpack(
        &self,
        archive: &ZipArchive<FileReader>,
        folder: &Path,
        most: u64,
    ) -> Result<u64, String> {
        let is_plain = |path: &Path| path.components().all(|c| matches!(c, Component::Normal(_)));
        let inside = PathBuf::from(self.name.replace('\\', "/"));
        if !is_plain(&inside) {
            return Err("its path leads out of the archive".into());
        }
        if self.is_encrypted {
            return Err("it is encrypted".into());
        }
        let target = folder.join(inside);
        let text = |e: io::Error| e.to_string();
        fs::create_dir_all(target.parent().unwrap_or(folder)).map_err(text)?;
        let entry = archive.get_entry(self.wayfinder).map_err(|e| e.to_string())?;
        let mut file = File::create_new(&target).map_err(|e| match e.kind() {
            io::ErrorKind::AlreadyExists => "it is in the archive twice".into(),
            _ => e.to_string(),
        })?;
        let most = most.saturating_add(1);
        let packed = BufReader::new(entry.reader());
        // At the end the reader compares the size and the checksum.
        let written = match self.method {
            CompressionMethod::STORE => {
                io::copy(&mut entry.verifying_reader(packed).take(most), &mut file)
            }
            CompressionMethod::DEFLATE => {
                let plain = DeflateDecoder::new(packed);
                io::copy(&mut entry.verifying_reader(plain).take(most), &mut file)
            }
            other => Err(io::Error::other(format!("it is compressed by {other}; deflate is read"))),
        };
        if written.is_err() {
            // What it begins with may be taken for the whole.
            fs::remove_file(&target).map_err(text)?;
        }
        written.map_err(text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rawzip::ZipArchiveWriter;
    use std::io::Write;

    /// An archive with these files, deflated or as they are.
    fn archive(files: &[(&str, &[u8])], deflate: bool) -> Vec<u8> {
        let mut bytes = Vec::new();
        let mut archive = ZipArchiveWriter::new(&mut bytes);
        for (name, content) in files {
            let method =
                if deflate { CompressionMethod::DEFLATE } else { CompressionMethod::STORE };
            let name = rawzip::path::EntryPath::verbatim(name.as_bytes());
            let (mut entry, config) =
                archive.new_file(name).compression_method(method).start().unwrap();
            let descriptor = if deflate {
                let encoder =
                    flate2::write::DeflateEncoder::new(&mut entry, flate2::Compression::default());
                let mut writer = config.wrap(encoder);
                writer.write_all(content).unwrap();
                let (encoder, descriptor) = writer.finish().unwrap();
                encoder.finish().unwrap();
                descriptor
            } else {
                let mut writer = config.wrap(&mut entry);
                writer.write_all(content).unwrap();
                writer.finish().unwrap().1
            };
            entry.finish(descriptor).unwrap();
        }
        archive.finish().unwrap();
        bytes
    }

    fn unpacked(bytes: &[u8]) -> Result<Unpacked, ArchiveError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("one.zip");
        fs::write(&path, bytes).unwrap();
        let inside = unpack_within(&path, |name| name.ends_with(".txt"), 1 << 16);
        let beside: Vec<_> = fs::read_dir(folder.path()).unwrap().collect();
        assert_eq!(beside.len(), 1, "nothing is written beside the archive");
        inside
    }

    #[test]
    fn what_is_asked_for_is_unpacked_and_goes_again() {
        let text = b"0.1\n".repeat(10_000);
        let files: [(&str, &[u8]); 5] = [
            ("task/one/a.txt", &text),
            ("task/one/video.mp4", b"much"),
            ("task/one/._a.txt", b"of a Mac"),
            ("task\\two\\a.txt", b"of Windows"),
            ("b.txt", b""),
        ];
        for deflate in [true, false] {
            let unpacked = unpacked(&archive(&files, deflate)).unwrap();
            let folder = unpacked.folder().to_owned();
            assert_eq!(fs::read(folder.join("task/one/a.txt")).unwrap(), text);
            assert_eq!(fs::read(folder.join("task/two/a.txt")).unwrap(), b"of Windows");
            assert_eq!(fs::read(folder.join("b.txt")).unwrap(), b"");
            assert_eq!(fs::read_dir(folder.join("task/one")).unwrap().count(), 1);
            assert_eq!(unpacked.left_out, []);
            drop(unpacked);
            assert!(!folder.exists());
        }
    }

    #[test]
    fn paths_that_lead_out_and_names_that_stand_twice_are_left_out_and_told() {
        let files: [(&str, &[u8]); 6] = [
            ("../out.txt", b"1"),
            ("a/../../out.txt", b"2"),
            ("/out.txt", b"3"),
            ("..\\out.txt", b"4"),
            ("a.txt", b"5"),
            ("a.txt", b"6"),
        ];
        let unpacked = unpacked(&archive(&files, true)).unwrap();
        assert_eq!(fs::read(unpacked.folder().join("a.txt")).unwrap(), b"5");
        let reasons: Vec<_> = unpacked.left_out.iter().map(|file| file.reason.as_str()).collect();
        let out = "its path leads out of the archive";
        assert_eq!(reasons, [out, out, out, out, "it is in the archive twice"]);
        assert_eq!(fs::read_dir(unpacked.folder()).unwrap().count(), 1);
    }

    #[test]
    fn what_grows_out_of_proportion_is_refused() {
        // 1000 times its size, of which 200 are allowed, and 64 KiB always.
        let zeros = vec![0; 1 << 20];
        let told = unpacked(&archive(&[("a.txt", &zeros)], true)).unwrap_err().to_string();
        assert!(told.ends_with("bytes; unpack it and name the folder"), "{told}");
        assert!(unpacked(&archive(&[("a.txt", &zeros[..1 << 16])], true)).is_ok());
        assert!(unpacked(&archive(&[("a.txt", &zeros)], false)).is_ok());
        // One that is too large by little, after others.
        let part = &zeros[..60 << 10];
        let three = [("a.txt", part), ("b.txt", part), ("c.txt", part)];
        assert!(matches!(unpacked(&archive(&three, true)), Err(ArchiveError::Large { .. })));
    }

    #[test]
    fn damage_is_told_by_the_file_that_has_it() {
        let mut bytes = archive(&[("a.txt", b"0123456789"), ("b.txt", b"0123456789")], false);
        let place = bytes.windows(10).position(|window| window == b"0123456789").unwrap();
        bytes[place] = b'x';
        let unpacked_some = unpacked(&bytes).unwrap();
        assert_eq!(unpacked_some.left_out[0].name, "a.txt");
        assert!(!unpacked_some.folder().join("a.txt").exists());
        assert!(unpacked_some.folder().join("b.txt").exists());
        let told = unpacked(b"PK, but not more").unwrap_err().to_string();
        assert!(told.contains("one.zip: no zip archive can be read"), "{told}");
    }

    proptest! {
        #[test]
        fn flipped_bytes_never_panic(
            flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
            deflate: bool,
        ) {
            let mut bytes = archive(&[("x/a.txt", &[7; 500]), ("b.txt", b"text")], deflate);
            for (place, value) in flips {
                let place = place.index(bytes.len());
                bytes[place] = value;
            }
            let _ = unpacked(&bytes);
        }
    }
}
