//! The SQLite files of rosbag2.

use std::collections::BTreeMap;
use std::io::{self, Read};
use std::path::Path;

use rusqlite::{Connection, Error, OpenFlags};

use super::{LARGEST_RECORD, Reading, Topic};

/// What a compressed message begins with. A message in CDR begins with a 0.
const ZSTD_MAGIC: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];

/// Reads the messages of a file.
pub(super) fn read(path: &Path, reading: &mut Reading<'_, '_>) -> Result<(), Error> {
    let connection = Connection::open_with_flags(path, OpenFlags::SQLITE_OPEN_READ_ONLY)?;
    let mut asked_for: BTreeMap<i64, Topic> = BTreeMap::new();
    let mut topics =
        connection.prepare("SELECT id, name, type, serialization_format FROM topics")?;
    let mut rows = topics.query([])?;
    while let Some(row) = rows.next()? {
        let (name, type_name, encoding): (String, String, String) =
            (row.get(1)?, row.get(2)?, row.get(3)?);
        if let Some(topic) = reading.topic(&name, &type_name, &encoding) {
            asked_for.insert(row.get(0)?, topic);
        }
    }
    if asked_for.is_empty() {
        return Ok(());
    }
    let ids: Vec<String> = asked_for.keys().map(i64::to_string).collect();
    let mut messages = connection.prepare(&format!(
        "SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({}) ORDER BY id",
        ids.join(", ")
    ))?;
    let mut rows = messages.query([])?;
    let mut plain = Vec::new();
    while let Some(row) = rows.next()? {
        let topic = &asked_for[&row.get(0)?];
        let data = row.get_ref(2)?.as_blob()?;
        if !data.starts_with(&ZSTD_MAGIC) {
            reading.message(topic, row.get(1)?, data);
            continue;
        }
        plain.clear();
        match decompress(data, &mut plain) {
            Ok(()) => reading.message(topic, row.get(1)?, &plain),
            Err(e) => reading.damaged(topic, &format!("it can't be decompressed: {e}")),
        }
    }
    Ok(())
}

/// Appends what a compressed message holds.
fn decompress(data: &[u8], plain: &mut Vec<u8>) -> io::Result<()> {
    let decoder = zstd::Decoder::with_buffer(data)?;
    let mut decoder = decoder.take(LARGEST_RECORD as u64 + 1);
    decoder.read_to_end(plain)?;
    if plain.len() > LARGEST_RECORD {
        return Err(io::Error::other(format!("it is larger than {LARGEST_RECORD} bytes")));
    }
    Ok(())
}
