#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| tcvae_fuzz::bag("one.db3", data));
