//! The SQLite files of rosbag2.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use rusqlite::limits::Limit;
use rusqlite::{Connection, Error, ErrorCode, OpenFlags};

use super::{LARGEST_RECORD, Reading, Topic};

/// Why a file can't be read on.
#[derive(Debug, thiserror::Error)]
pub(super) enum SqliteError {
    #[error("{0}")]
    Sqlite(#[from] Error),
    #[error("it has no table {0:?}, which rosbag2 writes")]
    NoTable(&'static str),
    #[error(
        "what is in its -wal file alone is left out, as its folder can't be written to; copy the folder"
    )]
    Log,
}

/// Reads the messages of a file. Rows of other topics are passed over without their data.
pub(super) fn read(path: &Path, reading: &mut Reading<'_, '_>) -> Result<(), SqliteError> {
    // Unless there is a log to be read, nothing is to be written beside the file, as SQLite does with
    // those that rosbag2 leaves; the folder may not even allow it.
    let log = fs::metadata(path.with_extension("db3-wal"));
    if !log.is_ok_and(|log| log.len() > 0) {
        return messages(&alone(path)?, reading);
    }
    let connection = Connection::open_with_flags(path, OpenFlags::SQLITE_OPEN_READ_ONLY)?;
    let schema: Result<i64, Error> =
        connection.query_row("SELECT count(*) FROM sqlite_schema", [], |row| row.get(0));
    if schema.is_err_and(|e| e.sqlite_error_code() == Some(ErrorCode::CannotOpen)) {
        messages(&alone(path)?, reading)?;
        return Err(SqliteError::Log);
    }
    messages(&connection, reading)
}

/// Opens a file as it is, whatever is beside it.
fn alone(path: &Path) -> Result<Connection, Error> {
    let name = path.to_string_lossy();
    let name = name.replace('%', "%25").replace('?', "%3f").replace('#', "%23");
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_URI;
    Connection::open_with_flags(format!("file:{name}?immutable=1"), flags)
}

/// Reads the messages of an open file.
fn messages(connection: &Connection, reading: &mut Reading<'_, '_>) -> Result<(), SqliteError> {
    connection.set_limit(Limit::SQLITE_LIMIT_LENGTH, LARGEST_RECORD as i32)?;
    // The file may come from anybody: it is to be data alone.
    connection.execute_batch("PRAGMA trusted_schema = OFF; PRAGMA cell_size_check = ON;")?;
    for table in ["topics", "messages"] {
        // A view could count without end.
        let is_table: bool = connection.query_row(
            "SELECT count(*) FROM sqlite_schema WHERE name = ? AND type = 'table'
             AND sql NOT LIKE 'CREATE VIRTUAL%'",
            [table],
            |row| Ok(row.get::<_, i64>(0)? > 0),
        )?;
        if !is_table {
            return Err(SqliteError::NoTable(table));
        }
    }
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
    while let Some(row) = rows.next()?
        && !reading.is_full()
    {
        let topic = &asked_for[&row.get(0)?];
        reading.message(topic, row.get(1)?, row.get_ref(2)?.as_blob().map_err(Error::from)?);
    }
    Ok(())
}
