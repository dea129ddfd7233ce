//! The bags of ROS 1, format 2.0: by their index where they have one, so that only chunks with what is
//! asked for are read; else from start to end.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};

use super::{LARGEST_RECORD, Reading, Topic};

const MAGIC: &[u8] = b"#ROSBAG V2.0\n";

/// What a record is.
mod op {
    pub(super) const MESSAGE: u8 = 0x02;
    pub(super) const BAG: u8 = 0x03;
    pub(super) const CHUNK: u8 = 0x05;
    pub(super) const CHUNK_INFO: u8 = 0x06;
    pub(super) const CONNECTION: u8 = 0x07;
}

/// Why a file can't be read on.
#[derive(Debug, thiserror::Error)]
pub(super) enum Ros1Error {
    #[error("{0}")]
    Io(#[from] io::Error),
    #[error("it does not begin as a bag of ROS 1, format 2.0")]
    Magic,
    #[error("it ends in the middle of a record")]
    End,
    #[error("a record's header is damaged")]
    Header,
    #[error("a record of {length} bytes; at most {LARGEST_RECORD} are read")]
    Large { length: u64 },
    #[error("a chunk is compressed by {0:?}; none, bz2 and lz4 are read")]
    Compression(String),
    #[error("a chunk can't be decompressed: {0}")]
    Decompression(io::Error),
}

/// Topics that are asked for, by the numbers of their connections.
type Connections = BTreeMap<u32, Topic>;

/// Reads the messages of a file.
pub(super) fn read(file: &mut File, reading: &mut Reading<'_, '_>) -> Result<(), Ros1Error> {
    let mut bag = Records { size: file.metadata()?.len(), file: BufReader::new(file) };
    bag.file.rewind()?;
    let mut magic = [0; MAGIC.len()];
    bag.file.read_exact(&mut magic).map_err(|_| Ros1Error::Magic)?;
    if magic != MAGIC {
        return Err(Ros1Error::Magic);
    }
    let first = bag.next()?.ok_or(Ros1Error::End)?;
    if first.header.op()? != op::BAG {
        return Err(Ros1Error::Header);
    }
    let index = u64::from_le_bytes(first.header.number("index_pos")?);
    bag.skip(&first)?;
    let chunks_at = bag.file.stream_position()?;

    let mut connections = Connections::new();
    // A bag that was not closed has no index, and one that is damaged may have a wrong one.
    if let Ok(Some(chunks)) = bag.chunks_of_index(index, reading, &mut connections) {
        for at in chunks {
            if reading.is_full() {
                break;
            }
            bag.file.seek(SeekFrom::Start(at))?;
            let record = bag.next()?.ok_or(Ros1Error::End)?;
            if record.header.op()? != op::CHUNK {
                return Err(Ros1Error::Header);
            }
            let data = bag.data(&record)?;
            chunk(&record.header, &data, reading, &mut connections)?;
        }
        return Ok(());
    }
    bag.file.seek(SeekFrom::Start(chunks_at))?;
    while let Some(record) = bag.next()?
        && !reading.is_full()
    {
        match record.header.op()? {
            op::CHUNK => {
                let data = bag.data(&record)?;
                chunk(&record.header, &data, reading, &mut connections)?;
            }
            op::CONNECTION | op::MESSAGE => {
                let data = bag.data(&record)?;
                content(&record.header, &data, reading, &mut connections)?;
            }
            _ => bag.skip(&record)?,
        }
    }
    Ok(())
}

/// Takes what is in a chunk.
fn chunk(
    header: &Header,
    data: &[u8],
    reading: &mut Reading<'_, '_>,
    connections: &mut Connections,
) -> Result<(), Ros1Error> {
    let compression = String::from_utf8_lossy(header.field("compression")?).into_owned();
    let size = u64::from(u32::from_le_bytes(header.number("size")?));
    if size > LARGEST_RECORD as u64 {
        return Err(Ros1Error::Large { length: size });
    }
    let mut plain = Vec::new();
    let decompressed = match compression.as_str() {
        "none" => Ok(0),
        "bz2" => bzip2::read::BzDecoder::new(data).take(size).read_to_end(&mut plain),
        "lz4" => lz4::Decoder::new(data).and_then(|d| d.take(size).read_to_end(&mut plain)),
        _ => return Err(Ros1Error::Compression(compression)),
    };
    let mut rest = if compression == "none" { data } else { &plain };
    // What could be decompressed of a damaged chunk is whole.
    while !rest.is_empty() {
        let (header, data);
        (header, rest) = split(rest)?;
        (data, rest) = split(rest)?;
        content(&Header(header.to_vec()), data, reading, connections)?;
    }
    decompressed.map_err(Ros1Error::Decompression)?;
    Ok(())
}

/// Bytes that begin with their length, and what follows them.
fn split(bytes: &[u8]) -> Result<(&[u8], &[u8]), Ros1Error> {
    let (length, rest) = bytes.split_first_chunk().ok_or(Ros1Error::End)?;
    rest.split_at_checked(u32::from_le_bytes(*length) as usize).ok_or(Ros1Error::End)
}

/// Takes a connection, or a message of one that is asked for.
fn content(
    header: &Header,
    data: &[u8],
    reading: &mut Reading<'_, '_>,
    connections: &mut Connections,
) -> Result<(), Ros1Error> {
    match header.op()? {
        op::CONNECTION => {
            let name = String::from_utf8_lossy(header.field("topic")?).into_owned();
            let of_type = Header(data.to_vec());
            let type_name = String::from_utf8_lossy(of_type.field("type")?).into_owned();
            if let Some(topic) = reading.topic(&name, &type_name, "ros1") {
                connections.insert(u32::from_le_bytes(header.number("conn")?), topic);
            }
        }
        op::MESSAGE => {
            if let Some(topic) = connections.get(&u32::from_le_bytes(header.number("conn")?)) {
                let [secs, nanos] = {
                    let time: [u8; 8] = header.number("time")?;
                    let (secs, nanos) = time.split_at(4);
                    [secs, nanos].map(|n| u32::from_le_bytes(n.try_into().expect("four of eight")))
                };
                let log_nanos = i64::from(secs) * 1_000_000_000 + i64::from(nanos);
                reading.message(topic, log_nanos, data);
            }
        }
        _ => {}
    }
    Ok(())
}

/// The fields of a record: each its length, its name, `=` and its value.
struct Header(Vec<u8>);

impl Header {
    fn field(&self, name: &str) -> Result<&[u8], Ros1Error> {
        let mut rest = &self.0[..];
        while !rest.is_empty() {
            let field;
            (field, rest) = split(rest).map_err(|_| Ros1Error::Header)?;
            let value = field.strip_prefix(name.as_bytes()).and_then(|v| v.strip_prefix(b"="));
            if let Some(value) = value {
                return Ok(value);
            }
        }
        Err(Ros1Error::Header)
    }

    fn number<const N: usize>(&self, name: &str) -> Result<[u8; N], Ros1Error> {
        self.field(name)?.try_into().map_err(|_| Ros1Error::Header)
    }

    fn op(&self) -> Result<u8, Ros1Error> {
        Ok(self.number::<1>("op")?[0])
    }
}

/// A record whose data is still to be read, or skipped.
struct Record {
    header: Header,
    data: u64,
}

/// A file, record by record.
struct Records<'f> {
    file: BufReader<&'f mut File>,
    size: u64,
}

impl Records<'_> {
    /// The next record's header; none at the end.
    fn next(&mut self) -> Result<Option<Record>, Ros1Error> {
        if self.file.stream_position()? >= self.size {
            return Ok(None);
        }
        let length = self.length()?;
        let header = Header(self.bytes(length)?);
        Ok(Some(Record { header, data: self.length()? }))
    }

    fn length(&mut self) -> Result<u64, Ros1Error> {
        let mut length = [0; 4];
        self.file.read_exact(&mut length).map_err(|_| Ros1Error::End)?;
        Ok(u64::from(u32::from_le_bytes(length)))
    }

    /// That many bytes, which the file must have.
    fn bytes(&mut self, length: u64) -> Result<Vec<u8>, Ros1Error> {
        if length > LARGEST_RECORD as u64 {
            return Err(Ros1Error::Large { length });
        }
        if length > self.size.saturating_sub(self.file.stream_position()?) {
            return Err(Ros1Error::End);
        }
        let mut bytes = vec![0; length as usize];
        self.file.read_exact(&mut bytes)?;
        Ok(bytes)
    }

    fn data(&mut self, record: &Record) -> Result<Vec<u8>, Ros1Error> {
        self.bytes(record.data)
    }

    fn skip(&mut self, record: &Record) -> Result<(), Ros1Error> {
        Ok(self.file.seek_relative(record.data as i64)?)
    }

    /// Where chunks with messages that are asked for are; none where there is no index.
    fn chunks_of_index(
        &mut self,
        at: u64,
        reading: &mut Reading<'_, '_>,
        connections: &mut Connections,
    ) -> Result<Option<Vec<u64>>, Ros1Error> {
        if at == 0 || at >= self.size {
            return Ok(None);
        }
        self.file.seek(SeekFrom::Start(at))?;
        let mut chunks = Vec::new();
        while let Some(record) = self.next()? {
            let data = self.data(&record)?;
            match record.header.op()? {
                op::CONNECTION => content(&record.header, &data, reading, connections)?,
                op::CHUNK_INFO => {
                    let at = u64::from_le_bytes(record.header.number("chunk_pos")?);
                    // The numbers of its connections, each with that of its messages.
                    let asked_for = data.chunks_exact(8).any(|pair| {
                        let number = pair[..4].try_into().expect("four of eight");
                        connections.contains_key(&u32::from_le_bytes(number))
                    });
                    if asked_for {
                        chunks.push(at);
                    }
                }
                _ => {}
            }
        }
        // In the order of the file, and none twice.
        chunks.sort_unstable();
        chunks.dedup();
        Ok(Some(chunks))
    }
}
