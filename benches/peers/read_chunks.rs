//! Reads and decompresses the chunks of an MCAP file that hold messages of a topic, and does nothing with
//! them: what any reader of that topic must do. bags.py sets `tcvae inspect` beside it.
//!
//! `read_chunks FILE TOPIC`

use std::error::Error;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};

use mcap::sans_io::{SummaryReadEvent, SummaryReader};

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let (Some(path), Some(topic)) = (arguments.next(), arguments.next()) else {
        return Err("read_chunks FILE TOPIC".into());
    };
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
                decompressor.decompress_to_buffer(&packed, &mut plain)?
            }
            other => return Err(format!("chunks are compressed by {other}").into()),
        };
    }
    println!("{bytes}");
    Ok(())
}
