//! rosbag2's SQLite storage (`.db3`), read-only.

use crate::{BagError, Topic, qos};
use rusqlite::{Connection, OpenFlags, OptionalExtension, Row, params};
use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// How many rows are looked up at a time; their data is read one by one.
const PAGE_ROWS: usize = 256;

/// A `.db3` file.
pub(crate) struct SqliteFile {
    pub path: PathBuf,
    connection: Connection,
    pub topics: BTreeMap<i64, Arc<Topic>>,
    pub message_count: u64,
    /// Times of the first and of the last message.
    pub span: Option<(Duration, Duration)>,
}

/// Which messages, in which order.
#[derive(Clone, Debug)]
pub(crate) enum Selection {
    /// All, as they were written.
    File,
    /// By time, of the topics with these ids (all if none are given).
    Time {
        topics: Option<Vec<i64>>,
        from_ns: i64,
        until_ns: i64,
    },
}

/// One message.
pub(crate) struct SqliteMessage {
    pub topic: Arc<Topic>,
    pub time: Duration,
    pub data: Vec<u8>,
}

impl SqliteFile {
    pub fn open(path: PathBuf) -> Result<Self, BagError> {
        let error = |error| sqlite_error(&path, error);
        // SQLite would only say "unable to open".
        std::fs::File::open(&path).map_err(|source| BagError::io(&path, source))?;
        let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let connection = Connection::open_with_flags(&path, flags).map_err(error)?;
        let mut topics = read_topics(&connection).map_err(error)?;
        let counts = read_counts(&connection).map_err(error)?;
        let message_count = counts.values().sum();
        for (id, topic) in &mut topics {
            topic.message_count = counts.get(id).copied().unwrap_or(0);
        }
        let span = connection
            .query_row(
                "SELECT min(timestamp), max(timestamp) FROM messages",
                [],
                |row| {
                    Ok(row
                        .get::<_, Option<i64>>(0)?
                        .zip(row.get::<_, Option<i64>>(1)?))
                },
            )
            .map_err(error)?;
        let span = span
            .map(|(first, last)| Ok((time(&path, first)?, time(&path, last)?)))
            .transpose()?;
        Ok(Self {
            connection,
            topics: topics
                .into_iter()
                .map(|(id, topic)| (id, Arc::new(topic)))
                .collect(),
            message_count,
            span,
            path,
        })
    }

    /// What SQLite's own check finds.
    pub fn integrity(&self) -> Result<Vec<String>, BagError> {
        let error = |error| sqlite_error(&self.path, error);
        let mut statement = self
            .connection
            .prepare("PRAGMA integrity_check")
            .map_err(error)?;
        let lines = statement.query_map([], |row| row.get(0)).map_err(error)?;
        let mut lines = lines.collect::<Result<Vec<String>, _>>().map_err(error)?;
        lines.retain(|line| line != "ok");
        Ok(lines)
    }

    pub fn ids(&self, names: &[String]) -> Option<Vec<i64>> {
        let wanted = |topic: &Topic| names.contains(&topic.name);
        let ids = || self.topics.iter().filter(|(_, topic)| wanted(topic));
        (!names.is_empty()).then(|| ids().map(|(id, _)| *id).collect())
    }
}

/// Walks through the messages of a file.
pub(crate) struct Rows {
    selection: Selection,
    /// Timestamps and ids of the messages that come next.
    page: VecDeque<(i64, i64)>,
    /// Those of the last one.
    last: Option<(i64, i64)>,
    done: bool,
}

impl Rows {
    pub fn new(selection: Selection) -> Self {
        Self {
            selection,
            page: VecDeque::new(),
            last: None,
            done: false,
        }
    }

    pub fn next(&mut self, file: &SqliteFile) -> Result<Option<SqliteMessage>, BagError> {
        let error = |error| sqlite_error(&file.path, error);
        if self.page.is_empty() && !self.done {
            self.page = self.read_page(&file.connection).map_err(error)?;
            self.done = self.page.len() < PAGE_ROWS;
        }
        let Some(key) = self.page.pop_front() else {
            return Ok(None);
        };
        self.last = Some(key);
        let mut statement = file
            .connection
            .prepare_cached("SELECT topic_id, timestamp, data FROM messages WHERE id = ?1")
            .map_err(error)?;
        let (topic, timestamp, data): (i64, i64, Vec<u8>) = statement
            .query_row([key.1], |row| Ok((row.get(0)?, row.get(1)?, row.get(2)?)))
            .map_err(error)?;
        let topic = file.topics.get(&topic).ok_or_else(|| BagError::Damaged {
            path: file.path.clone(),
            reason: format!("a message of the unknown topic {topic}"),
        })?;
        Ok(Some(SqliteMessage {
            topic: Arc::clone(topic),
            time: time(&file.path, timestamp)?,
            data,
        }))
    }

    fn read_page(&self, connection: &Connection) -> rusqlite::Result<VecDeque<(i64, i64)>> {
        let key = |row: &Row<'_>| Ok((row.get(0)?, row.get(1)?));
        match &self.selection {
            Selection::File => {
                let mut statement = connection.prepare_cached(
                    "SELECT timestamp, id FROM messages WHERE id > ?1 ORDER BY id LIMIT ?2",
                )?;
                let after = self.last.map_or(i64::MIN, |(_, id)| id);
                statement
                    .query_map(params![after, PAGE_ROWS as i64], key)?
                    .collect()
            }
            Selection::Time {
                topics,
                from_ns,
                until_ns,
            } => {
                let topics = match topics {
                    Some(ids) => {
                        let ids: Vec<String> = ids.iter().map(i64::to_string).collect();
                        format!("AND topic_id IN ({})", ids.join(", "))
                    }
                    None => String::new(),
                };
                let mut statement = connection.prepare_cached(&format!(
                    "SELECT timestamp, id FROM messages WHERE (timestamp, id) > (?1, ?2) \
                     AND timestamp < ?3 {topics} ORDER BY timestamp, id LIMIT ?4"
                ))?;
                // The first id may be anything: begin at the end of the moment before.
                let (time, id) = self.last.unwrap_or((from_ns.saturating_sub(1), i64::MAX));
                statement
                    .query_map(params![time, id, until_ns, PAGE_ROWS as i64], key)?
                    .collect()
            }
        }
    }
}

fn read_topics(connection: &Connection) -> rusqlite::Result<BTreeMap<i64, Topic>> {
    // Columns came one by one with the versions of rosbag2.
    let mut columns = Vec::new();
    connection.pragma(None, "table_info", "topics", |row| {
        columns.push(row.get::<_, String>("name")?);
        Ok(())
    })?;
    let optional = |name: &str| {
        if columns.iter().any(|column| column == name) {
            format!("coalesce({name}, '')")
        } else {
            "''".to_owned()
        }
    };
    let mut statement = connection.prepare(&format!(
        "SELECT id, name, type, serialization_format, {}, {} FROM topics",
        optional("offered_qos_profiles"),
        optional("type_description_hash"),
    ))?;
    let topics = statement.query_map([], |row| {
        let profiles = qos::from_yaml(&row.get::<_, String>(4)?);
        let topic = Topic {
            name: row.get(1)?,
            type_name: row.get(2)?,
            definition: Vec::new(),
            definition_encoding: String::new(),
            message_encoding: row.get(3)?,
            type_hash: row.get(5)?,
            offered: profiles.iter().map(Into::into).collect(),
            profiles,
            message_count: 0,
        };
        Ok((row.get(0)?, topic))
    })?;
    let mut topics = topics.collect::<rusqlite::Result<BTreeMap<i64, Topic>>>()?;
    let has_definitions = connection
        .query_row(
            "SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = 'message_definitions'",
            [],
            |_| Ok(()),
        )
        .optional()?
        .is_some();
    if has_definitions {
        let mut statement = connection.prepare(
            "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions",
        )?;
        let definitions =
            statement.query_map([], |row| Ok((row.get(0)?, (row.get(1)?, row.get(2)?))))?;
        let definitions =
            definitions.collect::<rusqlite::Result<BTreeMap<String, (String, String)>>>()?;
        for topic in topics.values_mut() {
            if let Some((encoding, definition)) = definitions.get(&topic.type_name) {
                topic.definition_encoding.clone_from(encoding);
                topic.definition = definition.clone().into_bytes();
            }
        }
    }
    Ok(topics)
}

fn read_counts(connection: &Connection) -> rusqlite::Result<BTreeMap<i64, u64>> {
    let mut statement =
        connection.prepare("SELECT topic_id, count(*) FROM messages GROUP BY topic_id")?;
    let count = |count: i64| u64::try_from(count).unwrap_or(0);
    let counts = statement.query_map([], |row| Ok((row.get(0)?, count(row.get(1)?))))?;
    counts.collect()
}

fn time(path: &Path, timestamp: i64) -> Result<Duration, BagError> {
    let nanoseconds = u64::try_from(timestamp).map_err(|_| BagError::Damaged {
        path: path.to_owned(),
        reason: format!("a message with the timestamp {timestamp}, expected 0 or more"),
    })?;
    Ok(Duration::from_nanos(nanoseconds))
}

fn sqlite_error(path: &Path, error: rusqlite::Error) -> BagError {
    if error.sqlite_error_code() == Some(rusqlite::ErrorCode::NotADatabase) {
        return BagError::NotABag {
            path: path.to_owned(),
            reason: "the file is no SQLite database".to_owned(),
        };
    }
    BagError::Damaged {
        path: path.to_owned(),
        reason: error.to_string(),
    }
}
