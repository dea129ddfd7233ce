//! Seconds to read the joint states of a bag with our reader, and to only read and decompress the chunks of
//! an MCAP file that hold a topic, which any reader of it must do. bags.py sets Python's readers beside it.
//!
//! `peer_bags BAG TOPIC`

use std::error::Error;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use std::time::Instant;

use mcap::sans_io::{SummaryReadEvent, SummaryReader};
use tcvae::bag::Bag;
use tcvae::demonstrations::recording::RobotConfig;

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let (Some(path), Some(topic)) = (arguments.next(), arguments.next()) else {
        return Err("peer_bags BAG TOPIC".into());
    };
    let start = Instant::now();
    let bags = Bag::find(Path::new(&path))?;
    let read = bags.first().ok_or("no bag")?.read(&RobotConfig::default().channels())?;
    let secs = start.elapsed().as_secs_f64();
    let frames = read.recording.times_secs.len();
    let start = Instant::now();
    let bytes = if Path::new(&path).is_file() { chunks(&path, &topic)? } else { 0 };
    let chunk_secs = start.elapsed().as_secs_f64();
    println!(
        "{{\"secs\": {secs}, \"frames\": {frames}, \"chunk_secs\": {chunk_secs}, \"chunk_bytes\": {bytes}}}"
    );
    Ok(())
}

/// Reads and decompresses the chunks that hold messages of a topic; returns their bytes.
fn chunks(path: &str, topic: &str) -> Result<usize, Box<dyn Error>> {
    let mut file = File::open(path)?;
    let mut reader = SummaryReader::new();
    while let Some(event) = reader.next_event() {
        match event? {
            SummaryReadEvent::ReadRequest(need) => {
                let read = file.read(reader.insert(need))?;
                reader.notify_read(read);
            }
            SummaryReadEvent::SeekRequest(to) => reader.notify_seeked(file.seek(to)?),
        }
    }
    let summary = reader.finish().ok_or("no summary")?;
    let (mut packed, mut plain, mut bytes) = (Vec::new(), Vec::new(), 0);
    let mut decompressor = zstd::bulk::Decompressor::new()?;
    for chunk in &summary.chunk_indexes {
        let is_its = |id| summary.channels.get(id).is_some_and(|channel| channel.topic == topic);
        if !chunk.message_index_offsets.keys().any(is_its) {
            continue;
        }
        file.seek(SeekFrom::Start(chunk.compressed_data_offset()?))?;
        packed.resize(usize::try_from(chunk.compressed_size)?, 0);
        file.read_exact(&mut packed)?;
        bytes += match chunk.compression.as_str() {
            "" => packed.len(),
            "zstd" => {
                plain.resize(usize::try_from(chunk.uncompressed_size)?, 0);
                decompressor.decompress_to_buffer(&packed, &mut plain[..])?
            }
            other => return Err(format!("chunks are compressed by {other}").into()),
        };
    }
    Ok(bytes)
}
