//! Writing bags.

use crate::metadata::{
    FileInformation, Metadata, MetadataFile, Nanoseconds, Profiles, StartingTime, TopicCount,
    TopicMetadata,
};
use crate::{BagError, Qos, qos};
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

/// A topic of a [`BagWriter`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TopicHandle(usize);

struct WrittenTopic {
    channel_id: u16,
    metadata: TopicMetadata,
    message_count: u64,
}

/// Writes one bag. Only [`finish`](Self::finish) gives it its name; until then it is `NAME.partial`, of which
/// everything up to the last [`flush`](Self::flush) survives the end of the process, and everything up to the
/// last [`sync`](Self::sync) that of the machine.
pub struct BagWriter {
    folder: PathBuf,
    partial: PathBuf,
    file_path: PathBuf,
    file_name: String,
    file: File,
    writer: mcap::Writer<BufWriter<File>>,
    topics: Vec<WrittenTopic>,
    custom_data: BTreeMap<String, String>,
    /// Times of the first and of the last message.
    span_ns: Option<(u64, u64)>,
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
    pub fn create(folder: &Path, compression: Compression) -> Result<Self, BagError> {
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
        let file_name = format!("{name}_0.mcap");
        let file_path = partial.join(&file_name);
        let file =
            File::create_new(&file_path).map_err(|source| BagError::io(&file_path, source))?;
        let clone = file
            .try_clone()
            .map_err(|source| BagError::io(&file_path, source))?;
        let (compression, level) = match compression {
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
            .chunk_size(Some(CHUNK_BYTES))
            .create(BufWriter::new(clone))
            .map_err(|error| BagError::mcap(&file_path, error))?;
        Ok(Self {
            folder: folder.to_owned(),
            partial,
            file_path,
            file_name,
            file,
            writer,
            topics: Vec::new(),
            custom_data: BTreeMap::new(),
            span_ns: None,
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
        if let Some(index) = self
            .topics
            .iter()
            .position(|topic| topic.metadata.name == name)
        {
            let actual = &self.topics[index].metadata.type_name;
            if actual != type_name {
                let (topic, actual, expected) =
                    (name.to_owned(), actual.clone(), type_name.to_owned());
                return Err(BagError::Conflict {
                    topic,
                    actual,
                    expected,
                });
            }
            return Ok(TopicHandle(index));
        }
        let mut metadata = BTreeMap::new();
        metadata.insert(
            "offered_qos_profiles".to_owned(),
            qos::to_yaml(offered).map_err(|error| self.yaml(error))?,
        );
        metadata.insert("topic_type_hash".to_owned(), type_hash.to_owned());
        let mcap = |error| BagError::mcap(&self.file_path, error);
        let schema = self
            .writer
            .add_schema(type_name, "ros2msg", definition.as_bytes())
            .map_err(mcap)?;
        let channel_id = self
            .writer
            .add_channel(schema, name, "cdr", &metadata)
            .map_err(mcap)?;
        self.topics.push(WrittenTopic {
            channel_id,
            metadata: TopicMetadata {
                name: name.to_owned(),
                type_name: type_name.to_owned(),
                serialization_format: "cdr".to_owned(),
                offered_qos_profiles: Profiles::List(
                    offered.iter().map(|qos| (*qos).into()).collect(),
                ),
                type_description_hash: type_hash.to_owned(),
            },
            message_count: 0,
        });
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
        let (log_time, publish_time) = (nanoseconds(log_time)?, nanoseconds(publish_time)?);
        let topic = &mut self.topics[topic.0];
        let header = MessageHeader {
            channel_id: topic.channel_id,
            sequence: topic.message_count as u32,
            log_time,
            publish_time,
        };
        self.writer
            .write_to_known_channel(&header, cdr)
            .map_err(|error| BagError::mcap(&self.file_path, error))?;
        topic.message_count += 1;
        let (first, last) = self.span_ns.unwrap_or((log_time, log_time));
        self.span_ns = Some((first.min(log_time), last.max(log_time)));
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
        self.writer
            .flush()
            .map_err(|error| BagError::mcap(&self.file_path, error))
    }

    /// [`Self::flush`], and waits until the disk has it: it survives a power cut.
    pub fn sync(&mut self) -> Result<(), BagError> {
        self.flush()?;
        self.file
            .sync_data()
            .map_err(|error| BagError::io(&self.file_path, error))
    }

    /// Bytes in the file so far, without the open chunk.
    pub fn bytes(&self) -> Result<u64, BagError> {
        Ok(self
            .file
            .metadata()
            .map_err(|error| BagError::io(&self.file_path, error))?
            .len())
    }

    /// Messages so far.
    pub fn message_count(&self) -> u64 {
        self.topics.iter().map(|topic| topic.message_count).sum()
    }

    /// Completes the bag and gives it its name.
    pub fn finish(mut self) -> Result<(), BagError> {
        let information = self.metadata();
        let text = serde_yaml_ng::to_string(&information).map_err(|error| self.yaml(error))?;
        // As rosbag2 does, so that the file alone is a bag too.
        let record = mcap::records::Metadata {
            name: "rosbag2".to_owned(),
            metadata: BTreeMap::from([("serialized_metadata".to_owned(), text)]),
        };
        let mcap = |error| BagError::mcap(&self.file_path, error);
        self.writer.write_metadata(&record).map_err(mcap)?;
        self.writer.finish().map_err(mcap)?;
        let io = |error| BagError::io(&self.file_path, error);
        self.writer.into_inner().flush().map_err(io)?;
        self.file.sync_all().map_err(io)?;

        let path = self.partial.join("metadata.yaml");
        let yaml = serde_yaml_ng::to_string(&MetadataFile { information }).map_err(|error| {
            BagError::Damaged {
                path: path.clone(),
                reason: error.to_string(),
            }
        })?;
        let io = |error| BagError::io(&path, error);
        let mut file = File::create_new(&path).map_err(io)?;
        file.write_all(yaml.as_bytes()).map_err(io)?;
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
        let (first, last) = self.span_ns.unwrap_or((0, 0));
        let starting_time = StartingTime {
            nanoseconds_since_epoch: first,
        };
        let duration = Nanoseconds {
            nanoseconds: last - first,
        };
        let topics = self.topics.iter().map(|topic| TopicCount {
            topic_metadata: topic.metadata.clone(),
            message_count: topic.message_count,
        });
        Metadata {
            version: 9,
            storage_identifier: "mcap".to_owned(),
            duration,
            starting_time,
            message_count: self.message_count(),
            topics_with_message_count: topics.collect(),
            // Chunks are compressed by the storage, not by rosbag2.
            compression_format: String::new(),
            compression_mode: String::new(),
            relative_file_paths: vec![self.file_name.clone()],
            files: vec![FileInformation {
                path: self.file_name.clone(),
                starting_time,
                duration,
                message_count: self.message_count(),
            }],
            custom_data: (!self.custom_data.is_empty()).then(|| self.custom_data.clone()),
            ros_distro: "jazzy".to_owned(),
        }
    }

    fn yaml(&self, error: serde_yaml_ng::Error) -> BagError {
        BagError::Damaged {
            path: self.file_path.clone(),
            reason: error.to_string(),
        }
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
