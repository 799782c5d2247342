//! Reading bags.

use crate::metadata::MetadataFile;
use crate::{BagError, Qos, qos};
use mcap::sans_io::indexed_reader::{IndexedReadEvent, IndexedReader, IndexedReaderOptions};
use mcap::sans_io::linear_reader::LinearReaderOptions;
use mcap::sans_io::summary_reader::{SummaryReadEvent, SummaryReader, SummaryReaderOptions};
use msgs::{Interface, from_cdr};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// A larger record or chunk is taken for damage.
const MAX_RECORD_BYTES: usize = 256 << 20;

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
    /// Number of messages.
    pub message_count: u64,
}

/// A message as it stands in the bag.
#[derive(Clone, Debug, PartialEq)]
pub struct RawMessage {
    /// Its topic; `message_count` is that of the file.
    pub topic: Arc<Topic>,
    /// When it was logged, since the clock's zero.
    pub log_time: Duration,
    /// When it was published.
    pub publish_time: Duration,
    /// CDR with header.
    pub data: Vec<u8>,
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
        if !topic.type_hash.is_empty() && topic.type_hash != T::TYPE_HASH {
            return Err(BagError::Definition {
                topic: topic.name.clone(),
                type_name: topic.type_name.clone(),
                actual: topic.type_hash.clone(),
                expected: T::TYPE_HASH.to_owned(),
            });
        }
        from_cdr(&self.data).map_err(|source| BagError::Message {
            topic: topic.name.clone(),
            time: self.log_time,
            source,
        })
    }
}

struct BagFile {
    path: PathBuf,
    summary: mcap::Summary,
    topics: BTreeMap<u16, Arc<Topic>>,
}

/// A bag. Holds the indices only; messages come one at a time.
pub struct BagReader {
    path: PathBuf,
    files: Vec<BagFile>,
    topics: Vec<Topic>,
    notes: BTreeMap<String, String>,
}

impl BagReader {
    /// Opens a folder with `metadata.yaml`, or a single MCAP file.
    pub fn open(path: &Path) -> Result<Self, BagError> {
        let (paths, notes) = if path.is_dir() {
            read_metadata(path)?
        } else {
            (vec![path.to_owned()], BTreeMap::new())
        };
        let files: Vec<BagFile> = paths.into_iter().map(open_file).collect::<Result<_, _>>()?;
        let mut topics: BTreeMap<&str, Topic> = BTreeMap::new();
        for topic in files.iter().flat_map(|file| file.topics.values()) {
            topics
                .entry(&topic.name)
                .and_modify(|known| known.message_count += topic.message_count)
                .or_insert_with(|| Topic::clone(topic));
        }
        let topics = topics.into_values().collect();
        Ok(Self {
            path: path.to_owned(),
            files,
            topics,
            notes,
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

    /// Log times of the first and of the last message, if there is one.
    pub fn span(&self) -> Option<(Duration, Duration)> {
        let stats = self
            .files
            .iter()
            .filter_map(|file| file.summary.stats.as_ref());
        let stats = stats.filter(|stats| stats.message_count > 0);
        let span =
            |(first, last): (u64, u64), (start, end): (u64, u64)| (first.min(start), last.max(end));
        let (first, last) = stats
            .map(|stats| (stats.message_start_time, stats.message_end_time))
            .reduce(span)?;
        Some((Duration::from_nanos(first), Duration::from_nanos(last)))
    }

    /// All messages in the order of the file, checksums verified.
    pub fn messages(&self) -> Messages<'_> {
        Messages {
            files: self.files.iter(),
            order: Order::File,
            current: None,
        }
    }

    /// Messages of the topics named (all if none) in order of log time, from `from` up to before `until`. Reads only
    /// the chunks that hold such messages; files without an index are refused.
    pub fn messages_between(
        &self,
        topics: &[&str],
        from: Duration,
        until: Duration,
    ) -> Messages<'_> {
        let nanoseconds = |time: Duration| u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
        let mut options = IndexedReaderOptions::new()
            .starting_at(nanoseconds(from))
            .ending_before(nanoseconds(until))
            .with_record_length_limit(MAX_RECORD_BYTES);
        if !topics.is_empty() {
            options = options.include_topics(topics.iter().copied());
        }
        Messages {
            files: self.files.iter(),
            order: Order::Time(Box::new(options)),
            current: None,
        }
    }
}

/// Paths of the files and notes.
fn read_metadata(folder: &Path) -> Result<(Vec<PathBuf>, BTreeMap<String, String>), BagError> {
    let not_a_bag = |reason: String| BagError::NotABag {
        path: folder.to_owned(),
        reason,
    };
    let path = folder.join("metadata.yaml");
    let text = match std::fs::read_to_string(&path) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            return Err(not_a_bag(
                "metadata.yaml is missing, expected a finished bag".into(),
            ));
        }
        Err(error) => return Err(BagError::io(&path, error)),
    };
    let file: MetadataFile = serde_yaml_ng::from_str(&text)
        .map_err(|error| not_a_bag(format!("metadata.yaml: {error}")))?;
    let information = file.information;
    if information.storage_identifier != "mcap" {
        return Err(not_a_bag(format!(
            "its storage is {:?}, expected \"mcap\"",
            information.storage_identifier
        )));
    }
    if !information.compression_mode.is_empty()
        && !information.compression_mode.eq_ignore_ascii_case("none")
    {
        return Err(not_a_bag(format!(
            "its compression mode is {:?}, expected compression by the storage or none",
            information.compression_mode
        )));
    }
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
    Ok((paths, information.custom_data.unwrap_or_default()))
}

fn open_file(path: PathBuf) -> Result<BagFile, BagError> {
    let summary = read_summary(&path)?;
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
    Ok(BagFile {
        path,
        summary,
        topics,
    })
}

impl Topic {
    fn of(channel: &mcap::Channel<'_>, message_count: u64) -> Self {
        let metadata = |key: &str| channel.metadata.get(key).cloned().unwrap_or_default();
        let schema = channel.schema.as_deref();
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
            offered: qos::from_yaml(&metadata("offered_qos_profiles")),
            message_count,
        }
    }
}

fn read_summary(path: &Path) -> Result<mcap::Summary, BagError> {
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
        .with_record_length_limit(MAX_RECORD_BYTES);
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
    reader.finish().ok_or_else(|| BagError::Damaged {
        path: path.to_owned(),
        reason: "it has no summary".to_owned(),
    })
}

enum Order {
    File,
    Time(Box<IndexedReaderOptions>),
}

enum Source {
    Linear(Box<mcap::io::MessageReader<BufReader<File>>>),
    Indexed {
        reader: Box<IndexedReader>,
        file: File,
        size: u64,
        buffer: Vec<u8>,
    },
}

/// Messages of a bag, one at a time. Nothing comes after an error.
pub struct Messages<'a> {
    files: std::slice::Iter<'a, BagFile>,
    order: Order,
    current: Option<(&'a BagFile, Source)>,
}

impl Iterator for Messages<'_> {
    type Item = Result<RawMessage, BagError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            if self.current.is_none() {
                let file = self.files.next()?;
                match Source::open(file, &self.order) {
                    Ok(source) => self.current = Some((file, source)),
                    Err(error) => return Some(Err(self.end(error))),
                }
            }
            let (file, source) = self.current.as_mut()?;
            match source.next(file) {
                Ok(Some(message)) => return Some(Ok(message)),
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

impl Source {
    fn open(bag_file: &BagFile, order: &Order) -> Result<Self, BagError> {
        let path = &bag_file.path;
        let io = |error| BagError::io(path, error);
        let file = File::open(path).map_err(io)?;
        match order {
            Order::File => {
                let options = LinearReaderOptions::default()
                    .with_prevalidate_chunk_crcs(true)
                    .with_validate_data_section_crc(true)
                    .with_validate_summary_section_crc(true)
                    .with_record_length_limit(MAX_RECORD_BYTES);
                let reader =
                    mcap::io::MessageReader::new_with_options(BufReader::new(file), options);
                Ok(Self::Linear(Box::new(reader)))
            }
            Order::Time(options) => {
                let messages = bag_file
                    .summary
                    .stats
                    .as_ref()
                    .is_none_or(|stats| stats.message_count > 0);
                if bag_file.summary.chunk_indexes.is_empty() && messages {
                    let reason = "it has no index of its chunks".to_owned();
                    return Err(BagError::Damaged {
                        path: path.clone(),
                        reason,
                    });
                }
                let size = file.metadata().map_err(io)?.len();
                let reader = IndexedReader::new_with_options(
                    &bag_file.summary,
                    IndexedReaderOptions::clone(options),
                )
                .map_err(|error| BagError::mcap(path, error))?;
                Ok(Self::Indexed {
                    reader: Box::new(reader),
                    file,
                    size,
                    buffer: Vec::new(),
                })
            }
        }
    }

    fn next(&mut self, bag_file: &BagFile) -> Result<Option<RawMessage>, BagError> {
        let path = &bag_file.path;
        let mcap = |error| BagError::mcap(path, error);
        let damaged = |reason: String| BagError::Damaged {
            path: path.clone(),
            reason,
        };
        match self {
            Self::Linear(reader) => {
                let Some(message) = reader.next() else {
                    return Ok(None);
                };
                let message = message.map_err(mcap)?;
                let channel = &message.channel;
                // Channels of files without a full summary are known from the data section alone.
                let topic = bag_file.topics.get(&channel.id);
                let topic = topic
                    .cloned()
                    .unwrap_or_else(|| Arc::new(Topic::of(channel, 0)));
                Ok(Some(RawMessage {
                    topic,
                    log_time: Duration::from_nanos(message.log_time),
                    publish_time: Duration::from_nanos(message.publish_time),
                    data: message.data.into_owned(),
                }))
            }
            Self::Indexed {
                reader,
                file,
                size,
                buffer,
            } => {
                while let Some(event) = reader.next_event() {
                    match event.map_err(mcap)? {
                        IndexedReadEvent::ReadChunkRequest { offset, length } => {
                            if offset
                                .checked_add(length as u64)
                                .is_none_or(|end| end > *size)
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
                                log_time: Duration::from_nanos(header.log_time),
                                publish_time: Duration::from_nanos(header.publish_time),
                                data: data.to_vec(),
                            }));
                        }
                    }
                }
                Ok(None)
            }
        }
    }
}
