#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    let path = tcvae_fuzz::file("one.csv", data);
    if let Ok(read) = tcvae::csv::read(&path, &tcvae_fuzz::channels()) {
        tcvae_fuzz::check(&read.recording);
    }
});
