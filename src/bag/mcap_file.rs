//! MCAP files: by their index where they have one, so that only chunks with what is asked for are read;
//! else from start to end.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};

use mcap::McapError;
use mcap::records::{ChunkIndex, Record, op};

use super::message::Content;
use super::{LARGEST_RECORD, Reading, Topic};

const MAGIC: &[u8] = b"\x89MCAP0\r\n";

/// Bytes before a record's content: what it is, and its length.
const RECORD_START: u64 = 9;

/// Bytes of a chunk's content before the name of its compression.
const CHUNK_START: usize = 32;

/// Bytes at the end of a file, from where the footer says where the summary begins.
const FOOTER_END: u64 = 28;

/// Why a file can't be read on.
#[derive(Debug, thiserror::Error)]
pub(super) enum McapFileError {
    #[error("{0}")]
    Io(#[from] io::Error),
    #[error("it does not begin as an MCAP file")]
    Magic,
    #[error("it ends in the middle of a record")]
    End,
    #[error("a record of {length} bytes; at most {LARGEST_RECORD} are read")]
    Large { length: u64 },
    #[error("a chunk is compressed by {0:?}; zstd and lz4 are read")]
    Compression(String),
    #[error("a chunk can't be decompressed: {0}")]
    Decompression(io::Error),
    #[error("a chunk's checksum is {found:08x} where it says {said:08x}")]
    Checksum { found: u32, said: u32 },
    #[error("its index is damaged")]
    Index,
    #[error("{0}")]
    Record(#[from] McapError),
}

/// Reads the messages of a file.
pub(super) fn read(file: &mut File, reading: &mut Reading<'_, '_>) -> Result<(), McapFileError> {
    let size = file.metadata()?.len();
    // Without a summary, or with a damaged one, what comes before it can be whole.
    if let Ok(Some(summary)) = summary(file, size, reading)
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

/// What a file says at its end of what is in it.
struct Summary {
    /// Those that are asked for.
    channels: Channels,
    /// The numbers of all whose types are known.
    declared: BTreeSet<u16>,
    chunks: Vec<ChunkIndex>,
    messages: u64,
}

/// The summary; none where there is none, or where it is too large: 100 GB have one of some 20 MB.
fn summary(
    file: &mut File,
    size: u64,
    reading: &mut Reading<'_, '_>,
) -> Result<Option<Summary>, McapFileError> {
    let Some(footer) = size.checked_sub(RECORD_START + FOOTER_END) else { return Ok(None) };
    let mut start = [0; 8];
    file.seek(SeekFrom::Start(footer + RECORD_START))?;
    file.read_exact(&mut start)?;
    let start = u64::from_le_bytes(start);
    let length = match footer.checked_sub(start) {
        Some(length) if start > 0 && length <= LARGEST_RECORD as u64 => length,
        _ => return Ok(None),
    };
    let mut bytes = Vec::new();
    file.seek(SeekFrom::Start(start))?;
    file.by_ref().take(length).read_to_end(&mut bytes)?;
    let mut schemas = Schemas::new();
    let mut summary = Summary {
        channels: Channels::new(),
        declared: BTreeSet::new(),
        chunks: Vec::new(),
        messages: 0,
    };
    // Schemas may come after the channels that are of them.
    walk(&bytes, &mut |opcode, data| {
        if opcode == op::SCHEMA {
            declaration(opcode, data, &mut schemas, &mut summary.channels, reading)?;
        }
        Ok(true)
    })?;
    walk(&bytes, &mut |opcode, data| {
        match opcode {
            op::CHANNEL => {
                let of = declaration(opcode, data, &mut schemas, &mut summary.channels, reading)?;
                summary.declared.extend(of);
            }
            op::CHUNK_INDEX => {
                if let Record::ChunkIndex(chunk) = mcap::parse_record(opcode, data)? {
                    summary.chunks.push(chunk);
                }
            }
            op::STATISTICS => {
                if let Record::Statistics(statistics) = mcap::parse_record(opcode, data)? {
                    summary.messages = statistics.message_count;
                }
            }
            _ => {}
        }
        Ok(true)
    })?;
    Ok(Some(summary))
}

/// Whether every message is in a chunk that the summary names, with its channels, and each chunk is named
/// once.
fn has_index(summary: &Summary, size: u64) -> bool {
    let Summary { channels: _, declared, chunks, messages } = summary;
    let indexed = chunks.iter().all(|chunk| {
        let channels = &chunk.message_index_offsets;
        !channels.is_empty() && channels.keys().all(|id| declared.contains(id))
    });
    let together = chunks.iter().map(|chunk| u128::from(chunk.compressed_size)).sum::<u128>();
    *messages > 0 && !chunks.is_empty() && indexed && together <= u128::from(size)
}

/// Topics that are asked for, by the numbers of their channels.
type Channels = BTreeMap<u16, Topic>;

/// Names of types, by the numbers of their schemas.
type Schemas = BTreeMap<u16, String>;

/// Takes a schema, or a channel; returns the number of a channel whose type is known.
fn declaration(
    opcode: u8,
    data: &[u8],
    schemas: &mut Schemas,
    channels: &mut Channels,
    reading: &mut Reading<'_, '_>,
) -> Result<Option<u16>, McapFileError> {
    match mcap::parse_record(opcode, data)? {
        Record::Schema { header, .. } => {
            // Names of types that nobody asks for may be long, and many.
            let name = Content::of_type(&header.name).map(|_| header.name);
            schemas.insert(header.id, name.unwrap_or_default());
        }
        Record::Channel(channel) => {
            let type_name = schemas.get(&channel.schema_id);
            let known = type_name.map_or("", String::as_str);
            let topic = reading.topic(&channel.topic, known, &channel.message_encoding);
            channels.extend(topic.map(|topic| (channel.id, topic)));
            // 0 is that of channels without any.
            return Ok((type_name.is_some() || channel.schema_id == 0).then_some(channel.id));
        }
        _ => {}
    }
    Ok(None)
}

fn indexed(
    file: &mut File,
    size: u64,
    summary: Summary,
    reading: &mut Reading<'_, '_>,
) -> Result<(), McapFileError> {
    let Summary { channels, declared: _, mut chunks, messages: _ } = summary;
    chunks.retain(|chunk| chunk.message_index_offsets.keys().any(|id| channels.contains_key(id)));
    chunks.sort_by_key(|chunk| chunk.chunk_start_offset);
    let mut records = Records { file: BufReader::new(file), size, data: Vec::new() };
    let mut plain = Vec::new();
    for chunk in &chunks {
        if reading.is_full() {
            break;
        }
        if chunk.compression.is_empty() {
            records.plain_messages(chunk, &channels, reading)?;
            continue;
        }
        if records.next_at(chunk.chunk_start_offset, size)? != op::CHUNK {
            return Err(McapFileError::Index);
        }
        let chunk = Chunk::new(&records.data)?;
        let decompressed = chunk.decompress(&mut plain);
        walk(&plain, &mut |opcode, data| {
            if opcode == op::MESSAGE {
                message(data, &channels, reading)?;
            }
            Ok(!reading.is_full())
        })?;
        decompressed?;
    }
    Ok(())
}

fn linear(file: &mut File, size: u64, reading: &mut Reading<'_, '_>) -> Result<(), McapFileError> {
    let (mut schemas, mut channels) = (Schemas::new(), Channels::new());
    all_records(file, size, &mut |opcode, data| {
        match opcode {
            op::MESSAGE => message(data, &channels, reading)?,
            op::SCHEMA | op::CHANNEL => {
                declaration(opcode, data, &mut schemas, &mut channels, reading)?;
            }
            _ => {}
        }
        Ok(!reading.is_full())
    })
}

/// Takes a message, if its channel is asked for.
fn message(
    data: &[u8],
    channels: &Channels,
    reading: &mut Reading<'_, '_>,
) -> Result<(), McapFileError> {
    // The channel's number, the message's, and the times of logging and publishing.
    let (channel, rest) = data.split_first_chunk().ok_or(McapFileError::End)?;
    let (_, rest) = rest.split_first_chunk::<4>().ok_or(McapFileError::End)?;
    let (logged, rest) = rest.split_first_chunk().ok_or(McapFileError::End)?;
    let (published, data) = rest.split_first_chunk().ok_or(McapFileError::End)?;
    if let Some(topic) = channels.get(&u16::from_le_bytes(*channel)) {
        let [logged, published] = [logged, published].map(|time| i64::from_le_bytes(*time));
        // Where nobody noted when it was logged, it was published then.
        reading.message(topic, if logged == 0 { published } else { logged }, data);
    }
    Ok(())
}

/// Gives the records before the end of the data to `take`, those in chunks too, as long as that returns
/// true.
fn all_records(
    file: &mut File,
    size: u64,
    take: &mut impl FnMut(u8, &[u8]) -> Result<bool, McapFileError>,
) -> Result<(), McapFileError> {
    file.rewind()?;
    let mut records = Records { file: BufReader::new(file), size, data: Vec::new() };
    let mut magic = [0; MAGIC.len()];
    records.file.read_exact(&mut magic).map_err(|_| McapFileError::Magic)?;
    if magic != MAGIC {
        return Err(McapFileError::Magic);
    }
    let mut plain = Vec::new();
    loop {
        let opcode = match records.next() {
            // Of a chunk that is cut off, what is there can be whole.
            Err(Cut { opcode: op::CHUNK, reason: McapFileError::End }) => {
                let chunk = Chunk::new(&records.data)?;
                // That it ends too early is told below.
                let _ = chunk.decompress(&mut plain);
                walk(&plain, take)?;
                return Err(McapFileError::End);
            }
            opcode => opcode.map_err(|cut| cut.reason)?,
        };
        let goes_on = match opcode {
            // Nothing that follows is data.
            op::DATA_END | op::FOOTER => false,
            op::CHUNK => {
                let chunk = Chunk::new(&records.data)?;
                let decompressed = chunk.decompress(&mut plain);
                let walked = walk(&plain, take);
                decompressed?;
                let goes_on = walked?;
                chunk.check(&plain)?;
                goes_on
            }
            _ => take(opcode, &records.data)?,
        };
        if !goes_on {
            return Ok(());
        }
    }
}

/// Gives records one after another to `take`, as long as that returns true; returns whether it did.
fn walk(
    mut bytes: &[u8],
    take: &mut impl FnMut(u8, &[u8]) -> Result<bool, McapFileError>,
) -> Result<bool, McapFileError> {
    while let Some((opcode, rest)) = bytes.split_first() {
        let (length, rest) = rest.split_first_chunk().ok_or(McapFileError::End)?;
        let length = usize::try_from(u64::from_le_bytes(*length)).unwrap_or(usize::MAX);
        let (data, rest) = rest.split_at_checked(length).ok_or(McapFileError::End)?;
        if !take(*opcode, data)? {
            return Ok(false);
        }
        bytes = rest;
    }
    Ok(true)
}

/// A chunk, as far as it is there.
struct Chunk<'a> {
    plain_size: u64,
    /// 0 where there is none.
    checksum: u32,
    compression: &'a [u8],
    packed: &'a [u8],
}

impl<'a> Chunk<'a> {
    fn new(data: &'a [u8]) -> Result<Self, McapFileError> {
        let (start, rest) = data.split_first_chunk::<CHUNK_START>().ok_or(McapFileError::End)?;
        // The first 16 bytes are times.
        let (_, sizes) = start.split_at(16);
        let number = |at: usize| sizes[at..at + 4].try_into().expect("four bytes");
        let plain_size = u64::from_le_bytes(sizes[..8].try_into().expect("eight bytes"));
        let [checksum, length] = [8, 12].map(|at| u32::from_le_bytes(number(at)));
        let (compression, rest) =
            rest.split_at_checked(length as usize).ok_or(McapFileError::End)?;
        let (size, rest) = rest.split_first_chunk().ok_or(McapFileError::End)?;
        let size = usize::try_from(u64::from_le_bytes(*size)).unwrap_or(usize::MAX);
        // What follows is padding.
        Ok(Self { plain_size, checksum, compression, packed: &rest[..size.min(rest.len())] })
    }

    /// Writes what it holds, as much of it as can be decompressed.
    fn decompress(&self, plain: &mut Vec<u8>) -> Result<(), McapFileError> {
        plain.clear();
        let size = self.plain_size;
        if size > LARGEST_RECORD as u64 {
            return Err(McapFileError::Large { length: size });
        }
        let read = match self.compression {
            b"" => self.packed.take(size).read_to_end(plain),
            b"zstd" => {
                plain.reserve(size as usize);
                let whole = zstd::bulk::Decompressor::new().and_then(|mut decompressor| {
                    decompressor.decompress_to_buffer(self.packed, plain)
                });
                // At once is faster, but of what is damaged gives nothing.
                whole.or_else(|_| {
                    plain.clear();
                    zstd::Decoder::with_buffer(self.packed)?.take(size).read_to_end(plain)
                })
            }
            b"lz4" => lz4::Decoder::new(self.packed)
                .and_then(|decoder| decoder.take(size).read_to_end(plain)),
            other => {
                let name: String = String::from_utf8_lossy(other).chars().take(40).collect();
                return Err(McapFileError::Compression(name));
            }
        };
        read.map_err(McapFileError::Decompression)?;
        if plain.len() as u64 == size { Ok(()) } else { Err(McapFileError::End) }
    }

    /// Compares the checksum.
    fn check(&self, plain: &[u8]) -> Result<(), McapFileError> {
        let mut crc = flate2::Crc::new();
        crc.update(plain);
        let (found, said) = (crc.sum(), self.checksum);
        if said == 0 || found == said {
            return Ok(());
        }
        Err(McapFileError::Checksum { found, said })
    }
}

/// The records of a file.
struct Records<'f> {
    file: BufReader<&'f mut File>,
    size: u64,
    /// The content of the last one.
    data: Vec<u8>,
}

/// Why a record is not whole.
struct Cut {
    opcode: u8,
    reason: McapFileError,
}

impl Records<'_> {
    /// Reads the next record; what there is of it where it is cut off.
    fn next(&mut self) -> Result<u8, Cut> {
        let mut opcode = 0;
        let read = self.next_before(self.size, &mut opcode);
        read.map_err(|reason| Cut { opcode, reason }).map(|()| opcode)
    }

    /// Reads the record at a place, which ends before another; returns what it is.
    fn next_at(&mut self, at: u64, end: u64) -> Result<u8, McapFileError> {
        // To seek from here keeps what is buffered.
        let by = i128::from(at) - i128::from(self.file.stream_position()?);
        self.file.seek_relative(i64::try_from(by).map_err(|_| McapFileError::Index)?)?;
        let mut opcode = 0;
        self.next_before(end, &mut opcode)?;
        Ok(opcode)
    }

    fn next_before(&mut self, end: u64, opcode: &mut u8) -> Result<(), McapFileError> {
        self.data.clear();
        let mut start = [0; RECORD_START as usize];
        self.file.read_exact(&mut start).map_err(|_| McapFileError::End)?;
        let [first, length @ ..] = start;
        *opcode = first;
        let length = u64::from_le_bytes(length);
        let left = end.saturating_sub(self.file.stream_position()?);
        if length.min(left) > LARGEST_RECORD as u64 {
            return Err(McapFileError::Large { length });
        }
        self.file.by_ref().take(length.min(left)).read_to_end(&mut self.data)?;
        if length > left { Err(McapFileError::End) } else { Ok(()) }
    }

    /// Takes the messages of a chunk that is not compressed: its index says where each one is, so that
    /// what lies between them is passed over.
    fn plain_messages(
        &mut self,
        chunk: &ChunkIndex,
        channels: &Channels,
        reading: &mut Reading<'_, '_>,
    ) -> Result<(), McapFileError> {
        let start = chunk.compressed_data_offset()?;
        let end = start.checked_add(chunk.uncompressed_size).filter(|end| *end <= self.size);
        let end = end.ok_or(McapFileError::End)?;
        let mut places = Vec::new();
        for (id, &at) in &chunk.message_index_offsets {
            if !channels.contains_key(id) {
                continue;
            }
            if self.next_at(at, self.size)? != op::MESSAGE_INDEX {
                return Err(McapFileError::Index);
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
            let at = start.checked_add(place).ok_or(McapFileError::Index)?;
            if self.next_at(at, end)? != op::MESSAGE {
                return Err(McapFileError::Index);
            }
            message(&self.data, channels, reading)?;
        }
        Ok(())
    }
}

/// Walks through a file without its index, and counts the messages.
#[cfg(test)]
pub(super) fn count_messages(file: &mut File) -> Result<usize, McapFileError> {
    let size = file.metadata()?.len();
    let mut messages = 0;
    all_records(file, size, &mut |opcode, _| {
        messages += usize::from(opcode == op::MESSAGE);
        Ok(true)
    })?;
    Ok(messages)
}
