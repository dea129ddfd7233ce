#![no_main]

// The two files, parted by bytes that stand in no text.
libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    let mut parts = data.split(|byte| *byte == 0xff);
    for name in ["joint_angles.txt", "g.txt"] {
        tcvae_fuzz::file(name, parts.next().unwrap_or_default());
    }
    if let Ok(read) = tcvae::mime::read(tcvae_fuzz::folder(), &tcvae_fuzz::channels()) {
        tcvae_fuzz::check(&read.recording);
    }
});
