//! MCAP files: by their index where they have one, so that only chunks with what is asked for are read;
//! else from start to end.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};

use mcap::records::{ChunkIndex, MessageHeader, Record, op};
use mcap::sans_io::indexed_reader::ReadOrder;
use mcap::sans_io::{
    IndexedReadEvent, IndexedReader, IndexedReaderOptions, LinearReadEvent, LinearReader,
    LinearReaderOptions, SummaryReadEvent, SummaryReader, SummaryReaderOptions,
};
use mcap::{McapError, Summary};

use super::message::Content;
use super::{LARGEST_RECORD, Reading, Topic};

/// Reads the messages of a file.
pub(super) fn read(file: &mut File, reading: &mut Reading<'_, '_>) -> Result<(), McapError> {
    let size = file.metadata()?.len();
    // Without a summary, or with a damaged one, what comes before it can be whole.
    if let Ok(Some(summary)) = summary(file, size)
        && has_index(&summary, size)
    {
        let read_before = reading.read;
        let read = indexed(file, size, summary, reading);
        if read.is_ok() || reading.read > read_before {
            return read;
        }
    }
    linear(file, size, reading)
}

/// Bytes at the end of a file, from where the footer says where the summary begins.
const FOOTER_END: u64 = 28;

fn summary(file: &mut File, size: u64) -> Result<Option<Summary>, McapError> {
    let mut start = [0; 8];
    file.seek(SeekFrom::Start(size.saturating_sub(FOOTER_END)))?;
    file.read_exact(&mut start)?;
    // It is kept as a whole; 100 GB have one of some 20 MB.
    if size.saturating_sub(u64::from_le_bytes(start)) > LARGEST_RECORD as u64 {
        return Ok(None);
    }
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

/// Whether every message is in a chunk that the summary names, with its channels, and each chunk is named
/// once.
fn has_index(summary: &Summary, size: u64) -> bool {
    let messages = summary.stats.as_ref().map_or(0, |stats| stats.message_count);
    let chunks = &summary.chunk_indexes;
    let indexed = chunks.iter().all(|chunk| !chunk.message_index_offsets.is_empty());
    let together = chunks.iter().map(|chunk| u128::from(chunk.compressed_size)).sum::<u128>();
    messages > 0 && !chunks.is_empty() && indexed && together <= u128::from(size)
}

/// What a channel is asked for, if anything.
fn topic(channel: &mcap::Channel<'_>, reading: &mut Reading<'_, '_>) -> Option<Topic> {
    let type_name = channel.schema.as_ref().map_or("", |schema| schema.name.as_str());
    reading.topic(&channel.topic, type_name, &channel.message_encoding)
}

/// When a message was logged; where nobody noted that, when it was published.
fn log_nanos(header: &MessageHeader) -> i64 {
    let MessageHeader { log_time, publish_time, .. } = *header;
    if log_time == 0 { publish_time } else { log_time }.cast_signed()
}

fn indexed(
    file: &mut File,
    size: u64,
    mut summary: Summary,
    reading: &mut Reading<'_, '_>,
) -> Result<(), McapError> {
    let mut asked_for = BTreeMap::new();
    for (id, channel) in &summary.channels {
        if let Some(topic) = topic(channel, reading) {
            asked_for.insert(*id, topic);
        }
    }
    let is_asked_for = |chunk: &ChunkIndex| {
        chunk.message_index_offsets.keys().any(|id| asked_for.contains_key(id))
    };
    summary.chunk_indexes.retain(is_asked_for);
    let (mut plain, compressed): (Vec<_>, Vec<_>) =
        summary.chunk_indexes.into_iter().partition(|chunk| chunk.compression.is_empty());
    plain.sort_by_key(|chunk| chunk.chunk_start_offset);
    let mut messages = PlainMessages { file: BufReader::new(&mut *file), size, data: Vec::new() };
    for chunk in &plain {
        messages.read(chunk, &asked_for, reading)?;
    }
    if compressed.is_empty() {
        return Ok(());
    }
    summary.chunk_indexes = compressed;
    let topics: BTreeSet<String> = asked_for.values().map(|topic| topic.name.clone()).collect();
    let options = IndexedReaderOptions::new()
        .with_order(ReadOrder::File)
        .include_topics(topics)
        .with_record_length_limit(LARGEST_RECORD);
    let mut reader = IndexedReader::new_with_options(&summary, options)?;
    let mut chunk = Vec::new();
    while let Some(event) = reader.next_event()
        && !reading.is_full()
    {
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
                    reading.message(topic, log_nanos(&header), data);
                }
            }
        }
    }
    Ok(())
}

/// Bytes before a record's content: what it is, and its length.
const RECORD_START: u64 = 9;

/// Messages in chunks that are not compressed: the index of a chunk says where each one is, so that what
/// lies between them is passed over.
struct PlainMessages<'f> {
    file: BufReader<&'f mut File>,
    size: u64,
    data: Vec<u8>,
}

impl PlainMessages<'_> {
    fn read(
        &mut self,
        chunk: &ChunkIndex,
        asked_for: &BTreeMap<u16, Topic>,
        reading: &mut Reading<'_, '_>,
    ) -> Result<(), McapError> {
        let start = chunk.compressed_data_offset()?;
        let end = start.checked_add(chunk.uncompressed_size).filter(|end| *end <= self.size);
        let end = end.ok_or(McapError::UnexpectedEof)?;
        let mut places = Vec::new();
        for (id, &at) in &chunk.message_index_offsets {
            if !asked_for.contains_key(id) {
                continue;
            }
            if self.record(at, self.size)? != op::MESSAGE_INDEX {
                return Err(McapError::BadIndex);
            }
            if let Record::MessageIndex(index) = mcap::parse_record(op::MESSAGE_INDEX, &self.data)?
            {
                places.extend(index.records.iter().map(|entry| entry.offset));
            }
        }
        // In the order of the file, and none twice.
        places.sort_unstable();
        places.dedup();
        for place in places {
            if reading.is_full() {
                break;
            }
            let at = start.checked_add(place).ok_or(McapError::BadIndex)?;
            if self.record(at, end)? != op::MESSAGE {
                return Err(McapError::BadIndex);
            }
            if let Record::Message { header, data } = mcap::parse_record(op::MESSAGE, &self.data)?
                && let Some(topic) = asked_for.get(&header.channel_id)
            {
                reading.message(topic, log_nanos(&header), &data);
            }
        }
        Ok(())
    }

    /// Reads the record at a place, which must end before another, into `data`; returns what it is.
    fn record(&mut self, at: u64, end: u64) -> Result<u8, McapError> {
        // To seek from here keeps what is buffered.
        let here = self.file.stream_position()?;
        let by = i128::from(at) - i128::from(here);
        self.file.seek_relative(i64::try_from(by).map_err(|_| McapError::BadIndex)?)?;
        let mut start = [0; RECORD_START as usize];
        self.file.read_exact(&mut start)?;
        let [opcode, length @ ..] = start;
        let length = u64::from_le_bytes(length);
        let left = end.saturating_sub(at.saturating_add(RECORD_START));
        if length > left || length > LARGEST_RECORD as u64 {
            return Err(McapError::RecordTooLarge { opcode, len: length });
        }
        self.data.resize(length as usize, 0);
        self.file.read_exact(&mut self.data)?;
        Ok(opcode)
    }
}

fn linear(file: &mut File, size: u64, reading: &mut Reading<'_, '_>) -> Result<(), McapError> {
    let mut schemas: BTreeMap<u16, String> = BTreeMap::new();
    let mut asked_for: BTreeMap<u16, Topic> = BTreeMap::new();
    records(file, size, |opcode, data| {
        // Nothing that follows is data.
        if opcode == op::DATA_END || reading.is_full() {
            return Ok(false);
        }
        if !matches!(opcode, op::SCHEMA | op::CHANNEL | op::MESSAGE) {
            return Ok(true);
        }
        match mcap::parse_record(opcode, data)? {
            Record::Schema { header, .. } => {
                // Names of types that nobody asks for may be long, and many.
                let name = Content::of_type(&header.name).map(|_| header.name).unwrap_or_default();
                schemas.insert(header.id, name);
            }
            Record::Channel(channel) => {
                let type_name = schemas.get(&channel.schema_id).map_or("", String::as_str);
                let topic = reading.topic(&channel.topic, type_name, &channel.message_encoding);
                asked_for.extend(topic.map(|topic| (channel.id, topic)));
            }
            Record::Message { header, data } => {
                if let Some(topic) = asked_for.get(&header.channel_id) {
                    reading.message(topic, log_nanos(&header), &data);
                }
            }
            _ => {}
        }
        Ok(true)
    })
}

/// Gives the records of a file, those in its chunks too, to `take`, as long as that returns true.
fn records(
    file: &mut File,
    size: u64,
    mut take: impl FnMut(u8, &[u8]) -> Result<bool, McapError>,
) -> Result<(), McapError> {
    file.rewind()?;
    let options = LinearReaderOptions::default()
        .with_validate_chunk_crcs(true)
        .with_record_length_limit(LARGEST_RECORD);
    let mut reader = LinearReader::new_with_options(options);
    while let Some(event) = reader.next_event() {
        match event? {
            LinearReadEvent::ReadRequest(need) => {
                let need = bounded(need, file, size)?;
                let read = file.read(reader.insert(need))?;
                reader.notify_read(read);
            }
            LinearReadEvent::Record { opcode, data } => {
                if !take(opcode, data)? {
                    return Ok(());
                }
            }
        }
    }
    Ok(())
}

/// Walks through a file without its index, and counts the messages.
#[cfg(test)]
pub(super) fn count_messages(file: &mut File) -> Result<usize, McapError> {
    let size = file.metadata()?.len();
    let mut messages = 0;
    records(file, size, |opcode, _| {
        messages += usize::from(opcode == op::MESSAGE);
        Ok(opcode != op::DATA_END)
    })?;
    Ok(messages)
}
