//! MCAP files: by their index where they have one, so that only chunks with what is asked for are read;
//! else from start to end.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};

use mcap::records::{Record, op};
use mcap::sans_io::indexed_reader::ReadOrder;
use mcap::sans_io::{
    IndexedReadEvent, IndexedReader, IndexedReaderOptions, LinearReadEvent, LinearReader,
    LinearReaderOptions, SummaryReadEvent, SummaryReader, SummaryReaderOptions,
};
use mcap::{McapError, Summary};

use super::{LARGEST_RECORD, Reading, Topic};

/// Reads the messages of a file.
pub(super) fn read(file: &mut File, reading: &mut Reading<'_, '_>) -> Result<(), McapError> {
    let size = file.metadata()?.len();
    // Without a summary, or with a damaged one, what comes before it can be whole.
    if let Ok(Some(summary)) = summary(file, size)
        && has_index(&summary)
    {
        let read_before = reading.read;
        let read = indexed(file, size, &summary, reading);
        if read.is_ok() || reading.read > read_before {
            return read;
        }
    }
    linear(file, size, reading)
}

fn summary(file: &mut File, size: u64) -> Result<Option<Summary>, McapError> {
    file.rewind()?;
    let options = SummaryReaderOptions::default()
        .with_file_size(size)
        .with_record_length_limit(LARGEST_RECORD);
    let mut reader = SummaryReader::new_with_options(options);
    while let Some(event) = reader.next_event() {
        match event? {
            SummaryReadEvent::ReadRequest(need) => {
                let need = bounded(need, file, size)?;
                let read = file.read(reader.insert(need))?;
                reader.notify_read(read);
            }
            SummaryReadEvent::SeekRequest(to) => reader.notify_seeked(file.seek(to)?),
        }
    }
    Ok(reader.finish())
}

/// As much of a request as the file can answer: a damaged length asks for more memory than there is.
fn bounded(need: usize, file: &mut File, size: u64) -> Result<usize, McapError> {
    let left = size.saturating_sub(file.stream_position()?);
    // One byte at the end, so that the reader hears that it is there.
    Ok(need.min(usize::try_from(left).unwrap_or(usize::MAX)).max(1))
}

/// Whether every message is in a chunk that the summary names, with its channels.
fn has_index(summary: &Summary) -> bool {
    let messages = summary.stats.as_ref().map_or(0, |stats| stats.message_count);
    let indexed = summary.chunk_indexes.iter().all(|chunk| !chunk.message_index_offsets.is_empty());
    messages > 0 && !summary.chunk_indexes.is_empty() && indexed
}

/// What a channel is asked for, if anything.
fn topic(channel: &mcap::Channel<'_>, reading: &mut Reading<'_, '_>) -> Option<Topic> {
    let type_name = channel.schema.as_ref().map_or("", |schema| schema.name.as_str());
    reading.topic(&channel.topic, type_name, &channel.message_encoding)
}

fn indexed(
    file: &mut File,
    size: u64,
    summary: &Summary,
    reading: &mut Reading<'_, '_>,
) -> Result<(), McapError> {
    let mut asked_for = BTreeMap::new();
    for (id, channel) in &summary.channels {
        if let Some(topic) = topic(channel, reading) {
            asked_for.insert(*id, topic);
        }
    }
    if asked_for.is_empty() {
        return Ok(());
    }
    let topics: BTreeSet<String> = asked_for.values().map(|topic| topic.name.clone()).collect();
    let options = IndexedReaderOptions::new()
        .with_order(ReadOrder::File)
        .include_topics(topics)
        .with_record_length_limit(LARGEST_RECORD);
    let mut reader = IndexedReader::new_with_options(summary, options)?;
    let mut chunk = Vec::new();
    while let Some(event) = reader.next_event() {
        match event? {
            IndexedReadEvent::ReadChunkRequest { offset, length } => {
                if offset.checked_add(length as u64).is_none_or(|end| end > size) {
                    return Err(McapError::UnexpectedEof);
                }
                file.seek(SeekFrom::Start(offset))?;
                chunk.resize(length, 0);
                file.read_exact(&mut chunk)?;
                reader.insert_chunk_record_data(offset, &chunk)?;
            }
            IndexedReadEvent::Message { header, data } => {
                // Two channels can share a topic, and only one of them be asked for.
                if let Some(topic) = asked_for.get(&header.channel_id) {
                    reading.message(topic, header.log_time.cast_signed(), data);
                }
            }
        }
    }
    Ok(())
}

fn linear(file: &mut File, size: u64, reading: &mut Reading<'_, '_>) -> Result<(), McapError> {
    file.rewind()?;
    let options = LinearReaderOptions::default()
        .with_validate_chunk_crcs(true)
        .with_record_length_limit(LARGEST_RECORD);
    let mut reader = LinearReader::new_with_options(options);
    let mut schemas: BTreeMap<u16, String> = BTreeMap::new();
    let mut asked_for: BTreeMap<u16, Topic> = BTreeMap::new();
    while let Some(event) = reader.next_event() {
        match event? {
            LinearReadEvent::ReadRequest(need) => {
                let need = bounded(need, file, size)?;
                let read = file.read(reader.insert(need))?;
                reader.notify_read(read);
            }
            LinearReadEvent::Record { opcode, data } => match opcode {
                op::SCHEMA | op::CHANNEL | op::MESSAGE => match mcap::parse_record(opcode, data)? {
                    Record::Schema { header, .. } => {
                        schemas.insert(header.id, header.name);
                    }
                    Record::Channel(channel) => {
                        let type_name = schemas.get(&channel.schema_id).map_or("", String::as_str);
                        let topic =
                            reading.topic(&channel.topic, type_name, &channel.message_encoding);
                        asked_for.extend(topic.map(|topic| (channel.id, topic)));
                    }
                    Record::Message { header, data } => {
                        if let Some(topic) = asked_for.get(&header.channel_id) {
                            reading.message(topic, header.log_time.cast_signed(), &data);
                        }
                    }
                    _ => {}
                },
                // Nothing that follows is data.
                op::DATA_END => return Ok(()),
                _ => {}
            },
        }
    }
    Ok(())
}
