#![no_main]

use std::path::Path;

/// What all files below a folder hold together.
fn bytes(folder: &Path) -> u64 {
    let entries = std::fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("one"));
    let sizes = entries.map(|entry| match entry.file_type().expect("a type").is_dir() {
        true => bytes(&entry.path()),
        false => entry.metadata().expect("a size").len(),
    });
    sizes.sum()
}

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    let path = tcvae_fuzz::file("one.zip", data);
    if let Ok(unpacked) = tcvae::archive::unpack(&path, |name| name.ends_with(".txt")) {
        assert!(bytes(unpacked.folder()) <= 256 << 20);
    }
});
