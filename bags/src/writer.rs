//! Writing bags.

use crate::metadata::{
    FileInformation, Metadata, MetadataFile, Nanoseconds, Profiles, StartingTime, TopicCount,
    TopicMetadata,
};
use crate::{BagError, Qos, Topic};
use mcap::records::MessageHeader;
use msgs::{Description, Interface, to_cdr_in};
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// How chunks are compressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Compression {
    /// Not at all.
    None,
    /// Zstandard of a level, 1 to 22.
    Zstd(u32),
}

impl Default for Compression {
    /// The level with which a step of a demonstration is smallest for its time: see the README.
    fn default() -> Self {
        Self::Zstd(3)
    }
}

/// Target size of a chunk before compression: what a reader must hold in memory.
const CHUNK_BYTES: u64 = 4 << 20;
/// Smaller ones, where files are to be small, would be all overhead.
const MIN_CHUNK_BYTES: u64 = 1 << 16;
/// Name of the metadata records that keep the notes of a bag that has no `metadata.yaml` yet.
pub(crate) const NOTES_RECORD: &str = "sctn notes";

/// How a bag is written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WriteOptions {
    /// How chunks are compressed.
    pub compression: Compression,
    /// A new file begins when the present one has this many bytes.
    pub split_bytes: Option<u64>,
    /// A new file begins when the present one spans this much log time.
    pub split_duration: Option<Duration>,
}

impl WriteOptions {
    /// A file is looked at once a chunk.
    fn chunk_bytes(self) -> u64 {
        let limit = self.split_bytes.unwrap_or(CHUNK_BYTES);
        limit.clamp(MIN_CHUNK_BYTES, CHUNK_BYTES)
    }
}

impl From<Compression> for WriteOptions {
    fn from(compression: Compression) -> Self {
        Self {
            compression,
            ..Self::default()
        }
    }
}

/// A topic of a [`BagWriter`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct TopicHandle(usize);

struct WrittenTopic {
    /// In the present file.
    channel_id: u16,
    metadata: TopicMetadata,
    definition: Vec<u8>,
    definition_encoding: String,
    message_count: u64,
}

/// Numbers and times of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamps {
    /// Number within the topic; a gap says that messages are missing.
    pub sequence: u32,
    /// When it was received, since the clock's zero.
    pub log_time: Duration,
    /// When it was sent.
    pub publish_time: Duration,
}

/// The file that is being written.
struct OpenFile {
    path: PathBuf,
    name: String,
    file: File,
    writer: mcap::Writer<BufWriter<File>>,
    message_count: u64,
    /// Log times of the first and of the last message.
    span_ns: Option<(u64, u64)>,
    /// Bytes of messages since the size of the file was looked up.
    unmeasured: u64,
    /// Notes that stand in this file.
    noted: usize,
}

/// Writes one bag. Only [`finish`](Self::finish) gives it its name; until then it is `NAME.partial`, of which
/// everything up to the last [`flush`](Self::flush) survives the end of the process, and everything up to the
/// last [`sync`](Self::sync) that of the machine.
pub struct BagWriter {
    folder: PathBuf,
    partial: PathBuf,
    name: String,
    options: WriteOptions,
    open: OpenFile,
    /// Files that are complete.
    complete: Vec<FileInformation>,
    complete_bytes: u64,
    topics: Vec<WrittenTopic>,
    custom_data: BTreeMap<String, String>,
    buffer: Vec<u8>,
}

/// Where a bag lies while it is written.
pub fn partial_path(folder: &Path) -> PathBuf {
    let mut name = folder.file_name().unwrap_or_default().to_owned();
    name.push(".partial");
    folder.with_file_name(name)
}

impl BagWriter {
    /// Begins a bag. The folder must not exist, nor the rest of an earlier try; its parent must.
    pub fn create(folder: &Path, options: impl Into<WriteOptions>) -> Result<Self, BagError> {
        let options = options.into();
        let Some(name) = folder.file_name().and_then(|name| name.to_str()) else {
            let reason = "expected a path that ends in a name of valid Unicode".to_owned();
            return Err(BagError::NotABag {
                path: folder.to_owned(),
                reason,
            });
        };
        if folder.exists() {
            return Err(BagError::Exists {
                path: folder.to_owned(),
            });
        }
        let partial = partial_path(folder);
        fs::create_dir(&partial).map_err(|source| match source.kind() {
            std::io::ErrorKind::AlreadyExists => BagError::HalfWritten {
                path: partial.clone(),
            },
            _ => BagError::io(&partial, source),
        })?;
        Ok(Self {
            folder: folder.to_owned(),
            open: OpenFile::create(&partial, format!("{name}_0.mcap"), options)?,
            name: name.to_owned(),
            partial,
            options,
            complete: Vec::new(),
            complete_bytes: 0,
            topics: Vec::new(),
            custom_data: BTreeMap::new(),
            buffer: Vec::new(),
        })
    }

    /// Removes what an earlier try has left half-written. `true`: there was something.
    pub fn discard_partial(folder: &Path) -> Result<bool, BagError> {
        let partial = partial_path(folder);
        match fs::remove_dir_all(&partial) {
            Ok(()) => Ok(true),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(false),
            Err(error) => Err(BagError::io(&partial, error)),
        }
    }

    /// Adds a topic of a type known by its description; the same topic again gives the same handle.
    pub fn add_topic(
        &mut self,
        name: &str,
        description: Description,
        offered: &[Qos],
    ) -> Result<TopicHandle, BagError> {
        let Description {
            type_name,
            definition,
            type_hash,
        } = description;
        self.add_raw_topic(name, type_name, definition, type_hash, offered)
    }

    /// Adds a topic of any type. `definition` is the text with all it depends on, empty if unknown;
    /// `type_hash` its RIHS01 hash, empty if unknown.
    pub fn add_raw_topic(
        &mut self,
        name: &str,
        type_name: &str,
        definition: &str,
        type_hash: &str,
        offered: &[Qos],
    ) -> Result<TopicHandle, BagError> {
        self.add_any_topic(
            TopicMetadata {
                name: name.to_owned(),
                type_name: type_name.to_owned(),
                serialization_format: "cdr".to_owned(),
                offered_qos_profiles: Profiles::List(
                    offered.iter().map(|qos| (*qos).into()).collect(),
                ),
                type_description_hash: type_hash.to_owned(),
            },
            definition.as_bytes(),
            "ros2msg",
        )
    }

    /// Adds a topic as it stands in another bag.
    pub fn add_topic_of(&mut self, topic: &Topic) -> Result<TopicHandle, BagError> {
        self.add_any_topic(
            TopicMetadata {
                name: topic.name.clone(),
                type_name: topic.type_name.clone(),
                serialization_format: topic.message_encoding.clone(),
                offered_qos_profiles: Profiles::List(topic.profiles.clone()),
                type_description_hash: topic.type_hash.clone(),
            },
            &topic.definition,
            &topic.definition_encoding,
        )
    }

    fn add_any_topic(
        &mut self,
        metadata: TopicMetadata,
        definition: &[u8],
        definition_encoding: &str,
    ) -> Result<TopicHandle, BagError> {
        let known = self
            .topics
            .iter()
            .position(|topic| topic.metadata.name == metadata.name);
        if let Some(index) = known {
            let actual = &self.topics[index].metadata.type_name;
            if *actual != metadata.type_name {
                return Err(BagError::Conflict {
                    actual: actual.clone(),
                    topic: metadata.name,
                    expected: metadata.type_name,
                });
            }
            return Ok(TopicHandle(index));
        }
        let mut topic = WrittenTopic {
            channel_id: 0,
            metadata,
            definition: definition.to_vec(),
            definition_encoding: definition_encoding.to_owned(),
            message_count: 0,
        };
        self.open.add(&mut topic)?;
        self.topics.push(topic);
        Ok(TopicHandle(self.topics.len() - 1))
    }

    /// Adds a topic of a type of this workspace.
    pub fn add<T: Interface>(&mut self, name: &str, offered: Qos) -> Result<TopicHandle, BagError> {
        self.add_raw_topic(name, T::TYPE_NAME, T::DEFINITION, T::TYPE_HASH, &[offered])
    }

    /// Notes a fact about the whole bag in `custom_data` of `metadata.yaml`.
    pub fn note(&mut self, key: &str, value: impl ToString) {
        self.custom_data.insert(key.to_owned(), value.to_string());
    }

    /// Writes a message given as CDR with its header. Times since the clock's zero.
    pub fn write_cdr(
        &mut self,
        topic: TopicHandle,
        log_time: Duration,
        publish_time: Duration,
        cdr: &[u8],
    ) -> Result<(), BagError> {
        let stamps = Stamps {
            sequence: self.topics[topic.0].message_count as u32,
            log_time,
            publish_time,
        };
        self.write_stamped(topic, stamps, cdr)
    }

    /// [`Self::write_cdr`] with a number of the caller's.
    pub fn write_stamped(
        &mut self,
        topic: TopicHandle,
        stamps: Stamps,
        cdr: &[u8],
    ) -> Result<(), BagError> {
        let log_time = nanoseconds(stamps.log_time)?;
        if self.is_split_due(log_time)? {
            self.split()?;
        }
        let topic = &mut self.topics[topic.0];
        let header = MessageHeader {
            channel_id: topic.channel_id,
            sequence: stamps.sequence,
            log_time,
            publish_time: nanoseconds(stamps.publish_time)?,
        };
        self.open.write(&header, cdr)?;
        topic.message_count += 1;
        Ok(())
    }

    fn is_split_due(&mut self, log_time: u64) -> Result<bool, BagError> {
        let open = &mut self.open;
        if open.message_count == 0 {
            return Ok(false);
        }
        if let (Some(limit), Some((first, _))) = (self.options.split_duration, open.span_ns)
            && u128::from(log_time.saturating_sub(first)) >= limit.as_nanos()
        {
            return Ok(true);
        }
        match self.options.split_bytes {
            // Looked up once a chunk.
            Some(limit) if open.unmeasured >= self.options.chunk_bytes() => {
                open.unmeasured = 0;
                Ok(open.bytes()? >= limit)
            }
            _ => Ok(false),
        }
    }

    /// Completes the present file and begins the next one.
    pub fn split(&mut self) -> Result<(), BagError> {
        let name = format!("{}_{}.mcap", self.name, self.complete.len() + 1);
        let mut next = OpenFile::create(&self.partial, name, self.options)?;
        for topic in &mut self.topics {
            next.add(topic)?;
        }
        let done = std::mem::replace(&mut self.open, next);
        // The notes of a bag that is never finished stand in its first file.
        self.open.noted = self.custom_data.len();
        self.close(done, None)
    }

    /// Puts a complete file on the disk.
    fn close(
        &mut self,
        done: OpenFile,
        metadata: Option<&mcap::records::Metadata>,
    ) -> Result<(), BagError> {
        let information = done.information();
        self.complete_bytes += done.finish(metadata)?;
        self.complete.push(information);
        Ok(())
    }

    /// Writes a message, logged and published at `time`.
    pub fn write<T: Interface>(
        &mut self,
        topic: TopicHandle,
        time: Duration,
        message: &T,
    ) -> Result<(), BagError> {
        let metadata = &self.topics[topic.0].metadata;
        if metadata.type_name != T::TYPE_NAME {
            let (topic, actual) = (metadata.name.clone(), metadata.type_name.clone());
            return Err(BagError::Type {
                topic,
                actual,
                expected: T::TYPE_NAME.to_owned(),
            });
        }
        let mut buffer = std::mem::take(&mut self.buffer);
        to_cdr_in(message, &mut buffer).map_err(|source| BagError::Message {
            topic: metadata.name.clone(),
            time,
            source,
        })?;
        let result = self.write_cdr(topic, time, time, &buffer);
        self.buffer = buffer;
        result
    }

    /// Closes the chunk and hands everything to the system: it survives the end of this process.
    pub fn flush(&mut self) -> Result<(), BagError> {
        self.open.flush(&self.custom_data)
    }

    /// [`Self::flush`], and waits until the disk has it: it survives a power cut.
    pub fn sync(&mut self) -> Result<(), BagError> {
        self.flush()?;
        self.open
            .file
            .sync_data()
            .map_err(|error| BagError::io(&self.open.path, error))
    }

    /// The file that is being written, for another thread to put on the disk ([`File::sync_data`]) while this one goes on.
    pub fn open_file(&self) -> Result<File, BagError> {
        let clone = self.open.file.try_clone();
        clone.map_err(|error| BagError::io(&self.open.path, error))
    }

    /// Bytes in the files so far, without the open chunk.
    pub fn bytes(&self) -> Result<u64, BagError> {
        Ok(self.complete_bytes + self.open.bytes()?)
    }

    /// Where the bag lies while it is written.
    pub fn partial(&self) -> &Path {
        &self.partial
    }

    /// Files so far.
    pub fn file_count(&self) -> usize {
        self.complete.len() + 1
    }

    /// Messages so far.
    pub fn message_count(&self) -> u64 {
        self.topics.iter().map(|topic| topic.message_count).sum()
    }

    /// Completes the bag and gives it its name.
    pub fn finish(self) -> Result<(), BagError> {
        let information = self.metadata();
        let yaml = |error: serde_yaml_ng::Error| BagError::Damaged {
            path: self.partial.join("metadata.yaml"),
            reason: error.to_string(),
        };
        let text = serde_yaml_ng::to_string(&information).map_err(yaml)?;
        let whole = serde_yaml_ng::to_string(&MetadataFile { information }).map_err(yaml)?;
        // As rosbag2 does, so that the file alone is a bag too.
        let record = mcap::records::Metadata {
            name: "rosbag2".to_owned(),
            metadata: BTreeMap::from([("serialized_metadata".to_owned(), text)]),
        };
        self.open.finish(Some(&record))?;

        let path = self.partial.join("metadata.yaml");
        let io = |error| BagError::io(&path, error);
        let mut file = File::create_new(&path).map_err(io)?;
        file.write_all(whole.as_bytes()).map_err(io)?;
        file.sync_all().map_err(io)?;
        sync_folder(&self.partial)?;
        fs::rename(&self.partial, &self.folder)
            .map_err(|error| BagError::io(&self.folder, error))?;
        sync_folder(
            self.folder
                .parent()
                .filter(|path| !path.as_os_str().is_empty())
                .unwrap_or(Path::new(".")),
        )
    }

    fn metadata(&self) -> Metadata {
        let mut files = self.complete.clone();
        files.push(self.open.information());
        let with_messages = || files.iter().filter(|file| file.message_count > 0);
        let first = |file: &FileInformation| file.starting_time.nanoseconds_since_epoch;
        let last = |file: &FileInformation| first(file) + file.duration.nanoseconds;
        let start = with_messages().map(first).min().unwrap_or(0);
        let end = with_messages().map(last).max().unwrap_or(0);
        let topics = self.topics.iter().map(|topic| TopicCount {
            topic_metadata: topic.metadata.clone(),
            message_count: topic.message_count,
        });
        Metadata {
            version: 9,
            storage_identifier: "mcap".to_owned(),
            duration: Nanoseconds {
                nanoseconds: end - start,
            },
            starting_time: StartingTime {
                nanoseconds_since_epoch: start,
            },
            message_count: self.message_count(),
            topics_with_message_count: topics.collect(),
            // Chunks are compressed by the storage, not by rosbag2.
            compression_format: String::new(),
            compression_mode: String::new(),
            relative_file_paths: files.iter().map(|file| file.path.clone()).collect(),
            files,
            custom_data: (!self.custom_data.is_empty()).then(|| self.custom_data.clone()),
            ros_distro: "jazzy".to_owned(),
        }
    }
}

impl OpenFile {
    fn create(folder: &Path, name: String, options: WriteOptions) -> Result<Self, BagError> {
        let path = folder.join(&name);
        let io = |source| BagError::io(&path, source);
        let file = File::create_new(&path).map_err(io)?;
        let clone = file.try_clone().map_err(io)?;
        let (compression, level) = match options.compression {
            Compression::None => (None, 0),
            Compression::Zstd(level) => (Some(mcap::Compression::Zstd), level),
        };
        let writer = mcap::WriteOptions::new()
            .profile("ros2")
            .library(concat!("sctn ", env!("CARGO_PKG_VERSION")))
            .compression(compression)
            .compression_level(level)
            // Threads of its own would cost more than they win on chunks of this size.
            .compression_threads(0)
            .chunk_size(Some(options.chunk_bytes()))
            .create(BufWriter::new(clone))
            .map_err(|error| BagError::mcap(&path, error))?;
        Ok(Self {
            path,
            name,
            file,
            writer,
            message_count: 0,
            span_ns: None,
            unmeasured: 0,
            noted: 0,
        })
    }

    /// Tells the file of a topic.
    fn add(&mut self, topic: &mut WrittenTopic) -> Result<(), BagError> {
        let TopicMetadata {
            name,
            type_name,
            serialization_format,
            offered_qos_profiles,
            type_description_hash,
        } = &topic.metadata;
        let offered =
            serde_yaml_ng::to_string(offered_qos_profiles).map_err(|error| BagError::Damaged {
                path: self.path.clone(),
                reason: error.to_string(),
            })?;
        let metadata = BTreeMap::from([
            ("offered_qos_profiles".to_owned(), offered),
            (
                "topic_type_hash".to_owned(),
                type_description_hash.to_owned(),
            ),
        ]);
        let mcap = |error| BagError::mcap(&self.path, error);
        let schema = match (type_name.as_str(), topic.definition.as_slice()) {
            ("", []) => 0,
            (name, definition) => self
                .writer
                .add_schema(name, &topic.definition_encoding, definition)
                .map_err(mcap)?,
        };
        topic.channel_id = self
            .writer
            .add_channel(schema, name, serialization_format, &metadata)
            .map_err(mcap)?;
        Ok(())
    }

    fn write(&mut self, header: &MessageHeader, data: &[u8]) -> Result<(), BagError> {
        self.writer
            .write_to_known_channel(header, data)
            .map_err(|error| BagError::mcap(&self.path, error))?;
        self.message_count += 1;
        self.unmeasured += data.len() as u64;
        let time = header.log_time;
        let (first, last) = self.span_ns.unwrap_or((time, time));
        self.span_ns = Some((first.min(time), last.max(time)));
        Ok(())
    }

    fn flush(&mut self, notes: &BTreeMap<String, String>) -> Result<(), BagError> {
        let mcap = |error| BagError::mcap(&self.path, error);
        if self.noted < notes.len() {
            self.noted = notes.len();
            let record = mcap::records::Metadata {
                name: NOTES_RECORD.to_owned(),
                metadata: notes.clone(),
            };
            self.writer.write_metadata(&record).map_err(mcap)?;
        }
        self.writer.flush().map_err(mcap)
    }

    fn bytes(&self) -> Result<u64, BagError> {
        let metadata = self.file.metadata();
        Ok(metadata
            .map_err(|error| BagError::io(&self.path, error))?
            .len())
    }

    fn information(&self) -> FileInformation {
        let (first, last) = self.span_ns.unwrap_or((0, 0));
        FileInformation {
            path: self.name.clone(),
            starting_time: StartingTime {
                nanoseconds_since_epoch: first,
            },
            duration: Nanoseconds {
                nanoseconds: last - first,
            },
            message_count: self.message_count,
        }
    }

    /// Completes the file, waits until the disk has it, and gives its size.
    fn finish(mut self, metadata: Option<&mcap::records::Metadata>) -> Result<u64, BagError> {
        let path = self.path.clone();
        let mcap = |error| BagError::mcap(&path, error);
        if let Some(metadata) = metadata {
            self.writer.write_metadata(metadata).map_err(mcap)?;
        }
        self.writer.finish().map_err(mcap)?;
        let io = |error| BagError::io(&path, error);
        self.writer.into_inner().flush().map_err(io)?;
        self.file.sync_all().map_err(io)?;
        Ok(self.file.metadata().map_err(io)?.len())
    }
}

fn nanoseconds(time: Duration) -> Result<u64, BagError> {
    u64::try_from(time.as_nanos()).map_err(|_| BagError::Time(time))
}

/// Makes names in a folder last.
fn sync_folder(folder: &Path) -> Result<(), BagError> {
    File::open(folder)
        .and_then(|folder| folder.sync_all())
        .map_err(|error| BagError::io(folder, error))
}
