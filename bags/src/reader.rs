//! Reading bags.

use crate::metadata::{Metadata, MetadataFile, Profiles, TopicMetadata};
use crate::packing::{Packing, Unpacked, unpack};
use crate::qos::{self, Profile};
use crate::scan::{self, Event, MAX_RECORD_BYTES, Records, Scan};
use crate::sqlite::{Rows, Selection, SqliteFile};
use crate::{BagError, Qos};
use mcap::records::op;
use mcap::sans_io::indexed_reader::{
    IndexedReadEvent, IndexedReader, IndexedReaderOptions, ReadOrder,
};
use mcap::sans_io::linear_reader::LinearReaderOptions;
use mcap::sans_io::summary_reader::{SummaryReadEvent, SummaryReader, SummaryReaderOptions};
use msgs::{Interface, from_cdr, from_recorded_cdr};
use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// A topic of a bag.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Topic {
    /// Its name.
    pub name: String,
    /// Its type, for instance `sensor_msgs/msg/Image`.
    pub type_name: String,
    /// Definition of the type with all it depends on; empty if the bag has none.
    pub definition: Vec<u8>,
    /// How the definition is written, for instance `ros2msg`.
    pub definition_encoding: String,
    /// How messages are written, `cdr` in bags of ROS 2.
    pub message_encoding: String,
    /// RIHS01 hash of the type; empty if the bag has none.
    pub type_hash: String,
    /// What its publishers offered.
    pub offered: Vec<Qos>,
    /// The same with all that the bag says.
    pub(crate) profiles: Vec<Profile>,
    /// Number of messages.
    pub message_count: u64,
}

/// A message as it stands in the bag.
#[derive(Clone, Debug, PartialEq)]
pub struct RawMessage {
    /// Its topic; `message_count` is that of the file.
    pub topic: Arc<Topic>,
    /// Number within the topic by its recorder; 0 from recorders that count nothing.
    pub sequence: u32,
    /// When it was logged, since the clock's zero.
    pub log_time: Duration,
    /// When it was published.
    pub publish_time: Duration,
    /// CDR with header.
    pub data: Vec<u8>,
}

impl Topic {
    /// A topic as `metadata.yaml` lists it.
    fn listed(topic: TopicMetadata) -> Self {
        let profiles = match topic.offered_qos_profiles {
            Profiles::List(profiles) => profiles,
            Profiles::Text(text) => qos::from_yaml(&text),
        };
        Self {
            name: topic.name,
            type_name: topic.type_name,
            definition: Vec::new(),
            definition_encoding: String::new(),
            message_encoding: topic.serialization_format,
            type_hash: topic.type_description_hash,
            offered: profiles.iter().map(Into::into).collect(),
            profiles,
            message_count: 0,
        }
    }
}

impl RawMessage {
    /// The message as a type of this workspace, if it is of that type in that definition.
    pub fn decode<T: Interface>(&self) -> Result<T, BagError> {
        let topic = &*self.topic;
        let refuse = |actual: String, expected: &str| BagError::Type {
            topic: topic.name.clone(),
            actual,
            expected: expected.to_owned(),
        };
        if topic.type_name != T::TYPE_NAME {
            return Err(refuse(topic.type_name.clone(), T::TYPE_NAME));
        }
        if topic.message_encoding != "cdr" {
            return Err(refuse(
                format!("messages of encoding {:?}", topic.message_encoding),
                "cdr",
            ));
        }
        let is_current = topic.type_hash == T::TYPE_HASH;
        let is_known = is_current || T::EARLIER_TYPE_HASHES.contains(&topic.type_hash.as_str());
        if !topic.type_hash.is_empty() && !is_known {
            return Err(BagError::Definition {
                topic: topic.name.clone(),
                type_name: topic.type_name.clone(),
                actual: topic.type_hash.clone(),
                expected: T::TYPE_HASH.to_owned(),
            });
        }
        let message = match is_current {
            true => from_cdr(&self.data),
            false => from_recorded_cdr(&self.data),
        };
        message.map_err(|source| BagError::Message {
            topic: topic.name.clone(),
            time: self.log_time,
            source,
        })
    }
}

struct McapFile {
    path: PathBuf,
    summary: mcap::Summary,
    topics: BTreeMap<u16, Arc<Topic>>,
}

enum BagFile {
    Mcap(McapFile),
    Sqlite(SqliteFile),
}

/// A bag. Holds the indices only; messages come one at a time.
pub struct BagReader {
    path: PathBuf,
    files: Vec<BagFile>,
    packing: Packing,
    topics: Vec<Topic>,
    notes: BTreeMap<String, String>,
    /// Files that were compressed as a whole, uncompressed.
    _unpacked: Vec<Unpacked>,
}

impl BagReader {
    /// Opens a folder with `metadata.yaml`, or a single MCAP or SQLite file.
    pub fn open(path: &Path) -> Result<Self, BagError> {
        let Listing {
            paths,
            notes,
            packing,
            topics: listed,
        } = if path.is_dir() {
            read_metadata(path)?
        } else {
            Listing::of_file(path)
        };
        let mut unpacked = Vec::new();
        let mut files = Vec::new();
        for path in paths {
            files.push(BagFile::open(path, &mut unpacked)?);
        }
        let mut topics: BTreeMap<&str, Topic> = BTreeMap::new();
        for topic in files.iter().flat_map(BagFile::topics) {
            topics
                .entry(&topic.name)
                .and_modify(|known| known.message_count += topic.message_count)
                .or_insert_with(|| Topic::clone(topic));
        }
        // A topic that stayed silent may stand in metadata.yaml alone.
        for topic in &listed {
            topics
                .entry(&topic.name)
                .or_insert_with(|| Topic::clone(topic));
        }
        let topics = topics.into_values().collect();
        Ok(Self {
            path: path.to_owned(),
            files,
            packing,
            topics,
            notes,
            _unpacked: unpacked,
        })
    }

    /// Where the bag lies.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The topics, by name.
    pub fn topics(&self) -> &[Topic] {
        &self.topics
    }

    /// Facts about the whole bag: `custom_data` of `metadata.yaml`.
    pub fn notes(&self) -> &BTreeMap<String, String> {
        &self.notes
    }

    /// The files, in order.
    pub fn files(&self) -> impl Iterator<Item = FileSummary<'_>> {
        self.files.iter().map(BagFile::summary)
    }

    /// Log times of the first and of the last message, if there is one.
    pub fn span(&self) -> Option<(Duration, Duration)> {
        self.files
            .iter()
            .filter_map(|file| file.summary().span)
            .reduce(|(first, last), (start, end)| (first.min(start), last.max(end)))
    }

    /// All messages in the order of the file, checksums verified.
    pub fn messages(&self) -> Messages<'_> {
        Messages {
            files: self.files.iter(),
            packing: self.packing,
            order: Order::File,
            current: None,
        }
    }

    /// Messages of the topics named (all if none) in order of log time, from `from` up to before `until`. Reads only
    /// the chunks that hold such messages. A file without an index is read from its beginning, in its own order.
    pub fn messages_between(
        &self,
        topics: &[&str],
        from: Duration,
        until: Duration,
    ) -> Messages<'_> {
        let nanoseconds = |time: Duration| u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
        Messages {
            files: self.files.iter(),
            packing: self.packing,
            order: Order::Time {
                topics: topics.iter().map(|&topic| topic.to_owned()).collect(),
                from_ns: nanoseconds(from),
                until_ns: nanoseconds(until.max(from)),
                newest_first: false,
            },
            current: None,
        }
    }

    /// The last message of a topic before a time, if there is one. Where there is an index, reads only the chunk that holds it.
    pub fn last_before(&self, topic: &str, time: Duration) -> Result<Option<RawMessage>, BagError> {
        let order = Order::Time {
            topics: vec![topic.to_owned()],
            from_ns: 0,
            until_ns: u64::try_from(time.as_nanos()).unwrap_or(u64::MAX),
            newest_first: true,
        };
        for file in self.files.iter().rev() {
            let mut source = Source::open(file, &order)?;
            let newest_first = matches!(source, Source::Indexed { .. });
            let mut last = None;
            while let Some(message) = source.next(&order)? {
                last = Some(message);
                if newest_first {
                    break;
                }
            }
            if let Some(message) = last {
                return message.unpacked(self.packing).map(Some);
            }
        }
        Ok(None)
    }
}

/// One file of a bag.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FileSummary<'a> {
    /// Where it lies.
    pub path: &'a Path,
    /// `mcap` or `sqlite3`.
    pub storage: &'static str,
    /// Messages by its own count.
    pub message_count: u64,
    /// Chunks by its own index.
    pub chunk_count: usize,
    /// Log times of the first and of the last message, if there is one.
    pub span: Option<(Duration, Duration)>,
}

impl BagFile {
    /// Opens a file by its ending; one compressed as a whole is uncompressed first.
    fn open(path: PathBuf, unpacked: &mut Vec<Unpacked>) -> Result<Self, BagError> {
        let file = unpack(&path)?;
        if let Some(reason) = file.cut {
            return Err(BagError::Damaged { path, reason });
        }
        let path = file.path.clone();
        unpacked.push(file);
        if path.extension() == Some(OsStr::new("db3")) {
            return Ok(Self::Sqlite(SqliteFile::open(path)?));
        }
        open_mcap(path).map(Self::Mcap)
    }

    fn topics(&self) -> Box<dyn Iterator<Item = &Arc<Topic>> + '_> {
        match self {
            Self::Mcap(file) => Box::new(file.topics.values()),
            Self::Sqlite(file) => Box::new(file.topics.values()),
        }
    }

    fn summary(&self) -> FileSummary<'_> {
        match self {
            Self::Mcap(file) => {
                let stats = file.summary.stats.as_ref();
                let span = stats.filter(|stats| stats.message_count > 0).map(|stats| {
                    let time = Duration::from_nanos;
                    (time(stats.message_start_time), time(stats.message_end_time))
                });
                FileSummary {
                    path: &file.path,
                    storage: "mcap",
                    message_count: stats.map_or(0, |stats| stats.message_count),
                    chunk_count: file.summary.chunk_indexes.len(),
                    span,
                }
            }
            Self::Sqlite(file) => FileSummary {
                path: &file.path,
                storage: "sqlite3",
                message_count: file.message_count,
                chunk_count: 0,
                span: file.span,
            },
        }
    }
}

/// What `metadata.yaml` says that a reader needs.
struct Listing {
    paths: Vec<PathBuf>,
    notes: BTreeMap<String, String>,
    packing: Packing,
    /// Its topics, without messages and definitions, which are in the files.
    topics: Vec<Topic>,
}

impl Listing {
    /// Of a file without a `metadata.yaml`.
    fn of_file(path: &Path) -> Self {
        Self {
            paths: vec![path.to_owned()],
            notes: BTreeMap::new(),
            packing: Packing::Undeclared,
            topics: Vec::new(),
        }
    }
}

/// `metadata.yaml` of a bag.
pub(crate) fn parse_metadata(folder: &Path) -> Result<Metadata, BagError> {
    let not_a_bag = |reason: String| BagError::NotABag {
        path: folder.to_owned(),
        reason,
    };
    let path = folder.join("metadata.yaml");
    let text = match std::fs::read_to_string(&path) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            return Err(not_a_bag(
                "metadata.yaml is missing, expected a finished bag; try sctn bag recover".into(),
            ));
        }
        Err(error) if error.kind() == std::io::ErrorKind::InvalidData => {
            return Err(not_a_bag("metadata.yaml is no text".into()));
        }
        Err(error) => return Err(BagError::io(&path, error)),
    };
    let file: MetadataFile = serde_yaml_ng::from_str(&text)
        .map_err(|error| not_a_bag(format!("metadata.yaml: {error}")))?;
    Ok(file.information)
}

fn read_metadata(folder: &Path) -> Result<Listing, BagError> {
    let not_a_bag = |reason: String| BagError::NotABag {
        path: folder.to_owned(),
        reason,
    };
    let information = parse_metadata(folder)?;
    // Tools that rebuild metadata.yaml leave it empty; each file is read by its kind in any case.
    if !["mcap", "sqlite3", ""].contains(&information.storage_identifier.as_str()) {
        return Err(not_a_bag(format!(
            "its storage is {:?}, expected \"mcap\" or \"sqlite3\"",
            information.storage_identifier
        )));
    }
    let format = information.compression_format.as_str();
    match information.compression_mode.to_lowercase().as_str() {
        "" | "none" | "storage" => {}
        "file" | "message" if format != "zstd" => {
            return Err(not_a_bag(format!(
                "its compression format is {format:?}, expected \"zstd\""
            )));
        }
        "file" | "message" => {}
        other => {
            return Err(not_a_bag(format!(
                "its compression mode is {other:?}, expected none, file, message or storage"
            )));
        }
    }
    let packing = Packing::declared(Some(&information));
    let names = information.relative_file_paths.iter();
    let paths = names.map(|name| match Path::new(name).file_name() {
        // Only names within the folder: the file is not ours to trust.
        Some(name) => Ok(folder.join(name)),
        None => Err(not_a_bag(format!(
            "relative_file_paths has {name:?}, expected a file name"
        ))),
    });
    let paths = paths.collect::<Result<Vec<_>, _>>()?;
    if paths.is_empty() {
        return Err(not_a_bag(
            "relative_file_paths is empty, expected at least one file".into(),
        ));
    }
    Ok(Listing {
        paths,
        notes: information.custom_data.unwrap_or_default(),
        packing,
        topics: information
            .topics_with_message_count
            .into_iter()
            .map(|listed| Topic::listed(listed.topic_metadata))
            .collect(),
    })
}

fn open_mcap(path: PathBuf) -> Result<McapFile, BagError> {
    let mut summary = read_summary(&path)?;
    // The end of a file may repeat nothing of what is in it.
    if summary.stats.is_none() || summary.channels.is_empty() {
        summary = scan_summary(&path, summary)?;
    }
    let counts = summary
        .stats
        .as_ref()
        .map(|stats| &stats.channel_message_counts);
    let topic = |channel: &Arc<mcap::Channel<'static>>| {
        let count = counts
            .and_then(|counts| counts.get(&channel.id))
            .copied()
            .unwrap_or_default();
        (channel.id, Arc::new(Topic::of(channel, count)))
    };
    let topics = summary.channels.values().map(topic).collect();
    Ok(McapFile {
        path,
        summary,
        topics,
    })
}

/// Fills in the channels and counts of a file whose summary lacks them.
fn scan_summary(path: &Path, mut summary: mcap::Summary) -> Result<mcap::Summary, BagError> {
    let io = |error| BagError::io(path, error);
    let mut scan = Scan::new(File::open(path).map_err(io)?, Vec::new()).map_err(io)?;
    let mut stats = mcap::records::Statistics::default();
    let mut record = |opcode: u8, body: &[u8]| match opcode {
        op::SCHEMA => {
            if let Some((id, name, encoding, data)) = scan::schema(body) {
                let schema = mcap::Schema {
                    id,
                    name,
                    encoding,
                    data: data.into(),
                };
                summary.schemas.insert(id, Arc::new(schema));
            }
        }
        op::CHANNEL => {
            if let Some(channel) = scan::channel(body) {
                let channel = mcap::Channel {
                    id: channel.id,
                    topic: channel.topic,
                    schema: summary.schemas.get(&channel.schema_id).cloned(),
                    message_encoding: channel.message_encoding,
                    metadata: channel.metadata,
                };
                summary.channels.insert(channel.id, Arc::new(channel));
            }
        }
        op::MESSAGE => {
            if let Some((header, _)) = scan::message(body) {
                let time = header.log_time;
                let first = stats.message_count == 0;
                stats.message_start_time = if first {
                    time
                } else {
                    stats.message_start_time.min(time)
                };
                stats.message_end_time = stats.message_end_time.max(time);
                stats.message_count += 1;
                *stats
                    .channel_message_counts
                    .entry(header.channel_id)
                    .or_default() += 1;
            }
        }
        _ => {}
    };
    while let Some(event) = scan.next().map_err(io)? {
        match event {
            Event::Record { opcode, body, .. } => record(opcode, body),
            Event::Chunk { records, .. } => {
                for (_, opcode, body) in Records::new(records).flatten() {
                    record(opcode, body);
                }
            }
            Event::Damage(damage) => {
                return Err(BagError::Damaged {
                    path: path.to_owned(),
                    reason: format!("{} at byte {}", damage.reason, damage.offset),
                });
            }
        }
    }
    summary.stats = Some(stats);
    Ok(summary)
}

impl Topic {
    pub(crate) fn of(channel: &mcap::Channel<'_>, message_count: u64) -> Self {
        let metadata = |key: &str| channel.metadata.get(key).cloned().unwrap_or_default();
        let schema = channel.schema.as_deref();
        let profiles = qos::from_yaml(&metadata("offered_qos_profiles"));
        Self {
            name: channel.topic.clone(),
            type_name: schema.map(|schema| schema.name.clone()).unwrap_or_default(),
            definition: schema
                .map(|schema| schema.data.to_vec())
                .unwrap_or_default(),
            definition_encoding: schema
                .map(|schema| schema.encoding.clone())
                .unwrap_or_default(),
            message_encoding: channel.message_encoding.clone(),
            type_hash: metadata("topic_type_hash"),
            offered: profiles.iter().map(Into::into).collect(),
            profiles,
            message_count,
        }
    }
}

pub(crate) fn read_summary(path: &Path) -> Result<mcap::Summary, BagError> {
    let io = |error| BagError::io(path, error);
    let mcap = |error| BagError::mcap(path, error);
    let mut file = File::open(path).map_err(io)?;
    let size = file.metadata().map_err(io)?.len();
    let mut magic = [0; mcap::MAGIC.len()];
    match file.read_exact(&mut magic) {
        Ok(()) if magic == mcap::MAGIC => {}
        Err(error) if error.kind() != std::io::ErrorKind::UnexpectedEof => return Err(io(error)),
        _ => {
            let reason = "the file does not begin as an MCAP file".to_owned();
            return Err(BagError::NotABag {
                path: path.to_owned(),
                reason,
            });
        }
    }
    let mut end = [0; mcap::MAGIC.len()];
    let whole = size >= 2 * mcap::MAGIC.len() as u64
        && file
            .seek(SeekFrom::End(-(mcap::MAGIC.len() as i64)))
            .and_then(|_| file.read_exact(&mut end))
            .is_ok()
        && end == mcap::MAGIC;
    if !whole {
        return Err(BagError::Truncated {
            path: path.to_owned(),
        });
    }
    let options = SummaryReaderOptions::default()
        .with_file_size(size)
        .with_record_length_limit(MAX_RECORD_BYTES as usize);
    let mut reader = SummaryReader::new_with_options(options);
    while let Some(event) = reader.next_event() {
        match event.map_err(mcap)? {
            SummaryReadEvent::ReadRequest(need) => {
                let read = file.read(reader.insert(need)).map_err(io)?;
                reader.notify_read(read);
            }
            SummaryReadEvent::SeekRequest(to) => reader.notify_seeked(file.seek(to).map_err(io)?),
        }
    }
    Ok(reader.finish().unwrap_or_default())
}

#[derive(Debug)]
enum Order {
    File,
    Time {
        topics: Vec<String>,
        from_ns: u64,
        until_ns: u64,
        /// Where the file's index allows it.
        newest_first: bool,
    },
}

impl Order {
    fn includes(&self, topic: &str, time_ns: u64) -> bool {
        match self {
            Self::File => true,
            Self::Time {
                topics,
                from_ns,
                until_ns,
                ..
            } => {
                (topics.is_empty() || topics.iter().any(|name| name == topic))
                    && (*from_ns..*until_ns).contains(&time_ns)
            }
        }
    }
}

enum Source<'a> {
    Linear {
        bag_file: &'a McapFile,
        reader: Box<mcap::io::MessageReader<BufReader<File>>>,
    },
    Indexed {
        bag_file: &'a McapFile,
        reader: Box<IndexedReader>,
        file: File,
        size: u64,
        buffer: Vec<u8>,
    },
    Sqlite {
        bag_file: &'a SqliteFile,
        rows: Rows,
    },
}

/// Messages of a bag, one at a time. Nothing comes after an error.
pub struct Messages<'a> {
    files: std::slice::Iter<'a, BagFile>,
    packing: Packing,
    order: Order,
    current: Option<Source<'a>>,
}

impl Iterator for Messages<'_> {
    type Item = Result<RawMessage, BagError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            if self.current.is_none() {
                let file = self.files.next()?;
                match Source::open(file, &self.order) {
                    Ok(source) => self.current = Some(source),
                    Err(error) => return Some(Err(self.end(error))),
                }
            }
            let source = self.current.as_mut()?;
            match source.next(&self.order) {
                Ok(Some(message)) => {
                    let message = message.unpacked(self.packing);
                    return Some(message.map_err(|error| self.end(error)));
                }
                Ok(None) => self.current = None,
                Err(error) => return Some(Err(self.end(error))),
            }
        }
    }
}

impl Messages<'_> {
    fn end(&mut self, error: BagError) -> BagError {
        self.files = [].iter();
        self.current = None;
        error
    }
}

impl RawMessage {
    fn unpacked(self, packing: Packing) -> Result<Self, BagError> {
        match packing.open(&self.topic.message_encoding, &self.data) {
            Ok(None) => Ok(self),
            Ok(Some(data)) => Ok(Self { data, ..self }),
            Err(reason) => Err(BagError::Packed {
                topic: self.topic.name.clone(),
                time: self.log_time,
                reason,
            }),
        }
    }
}

impl<'a> Source<'a> {
    fn open(bag_file: &'a BagFile, order: &Order) -> Result<Self, BagError> {
        let bag_file = match bag_file {
            BagFile::Mcap(file) => file,
            BagFile::Sqlite(bag_file) => {
                let ns = |time: u64| i64::try_from(time).unwrap_or(i64::MAX);
                let selection = match order {
                    Order::File => Selection::File,
                    Order::Time {
                        topics,
                        from_ns,
                        until_ns,
                        ..
                    } => Selection::Time {
                        topics: bag_file.ids(topics),
                        from_ns: ns(*from_ns),
                        until_ns: ns(*until_ns),
                    },
                };
                let rows = Rows::new(selection);
                return Ok(Self::Sqlite { bag_file, rows });
            }
        };
        let path = &bag_file.path;
        let io = |error| BagError::io(path, error);
        let file = File::open(path).map_err(io)?;
        let summary = &bag_file.summary;
        let messages = summary
            .stats
            .as_ref()
            .is_none_or(|stats| stats.message_count > 0);
        let indexed = !summary.chunk_indexes.is_empty() || !messages;
        match order {
            Order::Time {
                topics,
                from_ns,
                until_ns,
                newest_first,
            } if indexed => {
                // The library takes no known topic for every topic.
                let known =
                    |name: &String| bag_file.topics.values().any(|topic| topic.name == *name);
                let until_ns = match topics.is_empty() || topics.iter().any(known) {
                    true => until_ns,
                    false => from_ns,
                };
                let mut options = IndexedReaderOptions::new()
                    .with_order(if *newest_first {
                        ReadOrder::ReverseLogTime
                    } else {
                        ReadOrder::LogTime
                    })
                    .starting_at(*from_ns)
                    .ending_before(*until_ns)
                    .with_record_length_limit(MAX_RECORD_BYTES as usize);
                if !topics.is_empty() {
                    options = options.include_topics(topics.iter().cloned());
                }
                let reader = IndexedReader::new_with_options(summary, options)
                    .map_err(|error| BagError::mcap(path, error))?;
                Ok(Self::Indexed {
                    bag_file,
                    reader: Box::new(reader),
                    size: file.metadata().map_err(io)?.len(),
                    file,
                    buffer: Vec::new(),
                })
            }
            _ => {
                let options = LinearReaderOptions::default()
                    .with_prevalidate_chunk_crcs(true)
                    .with_validate_data_section_crc(true)
                    .with_validate_summary_section_crc(true)
                    .with_record_length_limit(MAX_RECORD_BYTES as usize);
                let reader =
                    mcap::io::MessageReader::new_with_options(BufReader::new(file), options);
                Ok(Self::Linear {
                    bag_file,
                    reader: Box::new(reader),
                })
            }
        }
    }

    fn next(&mut self, order: &Order) -> Result<Option<RawMessage>, BagError> {
        match self {
            Self::Sqlite { bag_file, rows } => Ok(rows.next(bag_file)?.map(|message| RawMessage {
                topic: message.topic,
                sequence: 0,
                log_time: message.time,
                publish_time: message.time,
                data: message.data,
            })),
            Self::Linear { bag_file, reader } => {
                for message in reader {
                    let message = message.map_err(|error| BagError::mcap(&bag_file.path, error))?;
                    let channel = &message.channel;
                    if !order.includes(&channel.topic, message.log_time) {
                        continue;
                    }
                    // Channels of files without a full summary are known from the data section alone.
                    let topic = bag_file.topics.get(&channel.id);
                    let topic = topic
                        .cloned()
                        .unwrap_or_else(|| Arc::new(Topic::of(channel, 0)));
                    return Ok(Some(RawMessage {
                        topic,
                        sequence: message.sequence,
                        log_time: Duration::from_nanos(message.log_time),
                        publish_time: Duration::from_nanos(message.publish_time),
                        data: message.data.into_owned(),
                    }));
                }
                Ok(None)
            }
            Self::Indexed {
                bag_file,
                reader,
                file,
                size,
                buffer,
            } => next_indexed(bag_file, reader, file, *size, buffer),
        }
    }
}

fn next_indexed(
    bag_file: &McapFile,
    reader: &mut IndexedReader,
    file: &mut File,
    size: u64,
    buffer: &mut Vec<u8>,
) -> Result<Option<RawMessage>, BagError> {
    let path = &bag_file.path;
    let mcap = |error| BagError::mcap(path, error);
    let damaged = |reason: String| BagError::Damaged {
        path: path.clone(),
        reason,
    };
    while let Some(event) = reader.next_event() {
        match event.map_err(mcap)? {
            IndexedReadEvent::ReadChunkRequest { offset, length } => {
                if offset
                    .checked_add(length as u64)
                    .is_none_or(|end| end > size)
                {
                    return Err(damaged(format!(
                        "its index names a chunk beyond its {size} bytes"
                    )));
                }
                buffer.resize(length, 0);
                file.seek(SeekFrom::Start(offset))
                    .and_then(|_| file.read_exact(buffer))
                    .map_err(|error| BagError::io(path, error))?;
                reader
                    .insert_chunk_record_data(offset, buffer)
                    .map_err(mcap)?;
            }
            IndexedReadEvent::Message { header, data } => {
                let topic = bag_file.topics.get(&header.channel_id).cloned();
                let topic = topic.ok_or_else(|| {
                    damaged(format!(
                        "a message of the unknown channel {}",
                        header.channel_id
                    ))
                })?;
                return Ok(Some(RawMessage {
                    topic,
                    sequence: header.sequence,
                    log_time: Duration::from_nanos(header.log_time),
                    publish_time: Duration::from_nanos(header.publish_time),
                    data: data.to_vec(),
                }));
            }
        }
    }
    Ok(None)
}
