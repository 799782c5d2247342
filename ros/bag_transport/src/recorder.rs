//! The recorder: one subscription for each topic, one thread that writes the bag.
//!
//! Confirmations, step results and rewards are flushed to the file as soon as they arrive, together with everything before them,
//! and are never dropped for lack of room in the queue. A flushed step result is republished on the topic with
//! [`RECORDED_SUFFIX`] as an acknowledgement: whoever receives it there can rely on the bag, even if the recorder is killed.

use crate::{LARGE_TYPES, TransportError};
use bags::{BagError, BagWriter, Qos, Stamps, TopicHandle, WriteOptions};
use msgs::Interface;
use msgs::sctn_msgs::{Reward, StepConfirmation, StepResult};
use node_kit::{Node, Offer, RawPublisher, RawQos};
use regex::RegexSet;
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, mpsc};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};
use tokio::sync::watch;
use tokio::time::timeout_at;

/// How often discovery is asked for new topics.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// How often what has come is closed off, so that it survives the end of the process.
const FLUSH_EVERY: Duration = Duration::from_secs(1);
/// At the end, how long what has arrived may take to be read, should more go on arriving.
const LAST_WORDS: Duration = Duration::from_secs(1);
/// Types of which a crash must not lose a message: they are flushed at once.
const FLUSHED_AT_ONCE: [&str; 3] = [
    StepConfirmation::TYPE_NAME,
    StepResult::TYPE_NAME,
    Reward::TYPE_NAME,
];
/// Appended to the topic of step results: republished after the flush, as an acknowledgement. Hidden from other recorders.
pub const RECORDED_SUFFIX: &str = "_recorded";

type Result<T, E = TransportError> = std::result::Result<T, E>;

/// How to record.
#[derive(Clone, Copy, Debug)]
pub struct RecorderOptions {
    /// How the bag is written.
    pub write: WriteOptions,
    /// Bytes that may wait for the disk; what comes beyond is lost and counted.
    pub queue_bytes: usize,
    /// The recording ends before less room than this is left on the disk.
    pub min_free_bytes: u64,
    /// Log times come from `/clock`, else from the system's.
    pub use_sim_time: bool,
}

impl Default for RecorderOptions {
    fn default() -> Self {
        Self {
            write: WriteOptions::default(),
            queue_bytes: 192 << 20,
            min_free_bytes: 64 << 20,
            use_sim_time: false,
        }
    }
}

/// Which topics to record.
#[derive(Debug, Default)]
pub struct Selection {
    /// Every topic but the hidden ones.
    pub all: bool,
    /// Absolute names.
    pub names: BTreeSet<String>,
    /// Names that match one of these.
    pub patterns: RegexSet,
    /// Names that match one of these are left out, whatever else selects them.
    pub exclude: RegexSet,
    /// Also names with a part that begins with an underscore.
    pub hidden: bool,
}

impl Selection {
    fn contains(&self, topic: &str) -> bool {
        let hidden = topic.split('/').any(|part| part.starts_with('_'));
        let selected = self.names.contains(topic)
            || ((self.all || self.patterns.is_match(topic)) && (self.hidden || !hidden));
        selected && !self.exclude.is_match(topic)
    }
}

/// What was recorded of a topic.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct TopicCount {
    /// Messages that were received and handed on to the disk.
    pub messages: u64,
    /// Messages whose numbers say that they were sent and never arrived.
    pub lost_in_transport: u64,
    /// Messages that arrived while the queue to the disk was full.
    pub lost_in_queue: u64,
}

/// Why a recording ended by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum End {
    /// It was asked to.
    Asked,
    /// There was hardly any room left on the disk.
    DiskFull,
}

/// What came of a recording.
#[derive(Clone, Debug, Serialize)]
pub struct Recording {
    /// The bag.
    pub bag: PathBuf,
    /// Why it ended.
    pub end: End,
    /// Messages in it.
    pub messages: u64,
    /// Bytes of its files.
    pub bytes: u64,
    /// Its files.
    pub files: usize,
    /// Its topics.
    pub topics: BTreeMap<String, TopicCount>,
}

impl Recording {
    /// Why the bag does not hold all that arrived, if so.
    pub fn shortcoming(&self) -> Option<String> {
        let lost: u64 = self.topics.values().map(|topic| topic.lost_in_queue).sum();
        if self.end == End::DiskFull {
            Some("the disk was full before the end".to_owned())
        } else if lost > 0 {
            Some(format!(
                "{lost} messages found no room on their way to the disk"
            ))
        } else {
            None
        }
    }
}

/// How far a recording is.
#[derive(Clone, Copy, Debug, Default)]
pub struct Progress {
    /// Messages received.
    pub messages: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Messages lost in the transport.
    pub lost_in_transport: u64,
    /// Messages lost in the queue.
    pub lost_in_queue: u64,
}

/// On its way to the disk.
enum Entry {
    Topic {
        index: usize,
        name: String,
        type_name: String,
        offered: Vec<Qos>,
        /// Where to say which messages are safe.
        kept: Option<Box<RawPublisher>>,
    },
    Note(&'static str, String),
    Message {
        index: usize,
        stamps: Stamps,
        data: Vec<u8>,
        flush: bool,
    },
}

/// What tasks and the writing thread share.
#[derive(Default)]
struct Shared {
    queued_bytes: AtomicUsize,
    received_bytes: AtomicU64,
    heard: Mutex<Vec<Heard>>,
    ended: AtomicBool,
}

/// What has come on a topic.
struct Heard {
    topic: String,
    count: TopicCount,
    /// The first fields of the last message.
    head: [u8; STAMP_END],
}

/// Where the stamp ends in a message that begins with one: after the CDR header, seconds and nanoseconds.
const STAMP_END: usize = 4 + 4 + 4;

impl Shared {
    fn heard(&self) -> MutexGuard<'_, Vec<Heard>> {
        self.heard.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A topic that is being recorded.
struct Followed {
    type_name: String,
    index: usize,
    asked: RawQos,
    task: tokio::task::JoinHandle<Option<()>>,
}

/// Subscribes to topics; one thread writes what arrives.
pub struct Recorder {
    node: Node,
    path: PathBuf,
    options: RecorderOptions,
    shared: Arc<Shared>,
    queue: mpsc::Sender<Entry>,
    writer: JoinHandle<Result<Written>>,
    followed: BTreeMap<String, Followed>,
    /// Goes when nothing more is to be listened to.
    listening: watch::Sender<()>,
    /// Topics that cannot be recorded, warned about once.
    refused: BTreeSet<String>,
}

struct Written {
    bag: BagWriter,
    end: End,
}

impl Recorder {
    /// Begins a bag. The node hears every participant but its own.
    pub fn start(node: &Node, path: &Path, options: RecorderOptions) -> Result<Self> {
        let bag = BagWriter::create(path, options.write)?;
        let shared = Arc::new(Shared::default());
        let (queue, entries) = mpsc::channel();
        let writing = Writing {
            disk: put_on_disk(&bag)?,
            bag,
            topics: Vec::new(),
            shared: Arc::clone(&shared),
            min_free_bytes: options.min_free_bytes,
        };
        let span = node.span().clone();
        let writer = std::thread::Builder::new()
            .name("recorder".into())
            .spawn(move || {
                let ended = Arc::clone(&writing.shared);
                let result = span.in_scope(|| writing.run(&entries));
                ended.ended.store(true, Relaxed);
                result
            })
            .map_err(|source| TransportError::Io {
                what: "thread of the recorder".to_owned(),
                source,
            })?;
        Ok(Self {
            node: node.clone(),
            path: path.to_owned(),
            options,
            shared,
            queue,
            writer,
            followed: BTreeMap::new(),
            listening: watch::Sender::new(()),
            refused: BTreeSet::new(),
        })
    }

    /// Notes a fact about the whole bag.
    pub fn note(&self, key: &'static str, value: impl ToString) {
        let _ = self.queue.send(Entry::Note(key, value.to_string()));
    }

    /// Records a topic from now on, before anybody publishes it, so that nothing of it is missed.
    pub fn expect(&mut self, topic: &str, type_name: &str, offered: Qos) -> Result<()> {
        let name = self.node.resolve(topic);
        self.record(&name, type_name, &[offered])
    }

    /// Looks for topics as they appear, until the writing ends.
    pub async fn follow(&mut self, selection: &Selection) -> Result<()> {
        while !self.shared.ended.load(Relaxed) {
            self.look(selection)?;
            tokio::time::sleep(LOOK_EVERY).await;
        }
        Ok(())
    }

    /// Waits until the writing has ended by itself; [`Self::finish`] says why.
    pub async fn ended(&self) {
        while !self.shared.ended.load(Relaxed) {
            tokio::time::sleep(LOOK_EVERY).await;
        }
    }

    /// Stamp of the last message on a topic whose type begins with a stamp or a header, if one has come (ns).
    pub fn last_stamp_ns(&self, topic: &str) -> Option<i64> {
        let name = self.node.resolve(topic);
        let heard = self.shared.heard();
        let heard = heard.iter().find(|heard| heard.topic == name)?;
        (heard.count.messages > 0).then(|| stamp_ns(&heard.head))
    }

    fn look(&mut self, selection: &Selection) -> Result<()> {
        let mut offers: BTreeMap<String, Vec<Offer>> = BTreeMap::new();
        for offer in self.node.graph().offers() {
            if self.followed.contains_key(&offer.topic) || selection.contains(&offer.topic) {
                offers.entry(offer.topic.clone()).or_default().push(offer);
            }
        }
        for (topic, offers) in offers {
            let type_name = match self.followed.get(&topic) {
                Some(followed) => followed.type_name.clone(),
                None => offers[0].type_name.clone(),
            };
            let (same, other): (Vec<&Offer>, Vec<&Offer>) = offers
                .iter()
                .partition(|offer| offer.type_name == type_name);
            if let Some(other) = other.first()
                && self.refused.insert(format!("{topic} {}", other.type_name))
            {
                tracing::warn!(
                    "{topic}: messages of type {} are not recorded, as the topic has type {type_name}",
                    other.type_name
                );
            }
            let mut offered: Vec<Qos> = same.iter().map(|offer| qos(offer.qos)).collect();
            offered.sort();
            offered.dedup();
            if offered.is_empty() || self.refused.contains(&topic) {
                continue;
            }
            if let Err(error) = self.record(&topic, &type_name, &offered) {
                tracing::warn!("{topic} is not recorded: {error:#}");
                self.refused.insert(topic);
            }
        }
        Ok(())
    }

    /// Subscribes with the least that all publishers offer; again where a new one offers less.
    fn record(&mut self, topic: &str, type_name: &str, offered: &[Qos]) -> Result<()> {
        let asked = RawQos {
            reliable: offered.iter().all(|qos| qos.reliable),
            transient_local: offered.iter().all(|qos| qos.transient_local),
            depth: if LARGE_TYPES.contains(&type_name) {
                16
            } else {
                256
            },
        };
        let index = match self.followed.get(topic) {
            Some(followed)
                if followed.asked.reliable <= asked.reliable
                    && followed.asked.transient_local <= asked.transient_local =>
            {
                return Ok(());
            }
            Some(followed) => {
                tracing::info!("{topic}: a publisher offers less than before, subscribing again");
                followed.task.abort();
                followed.index
            }
            None => {
                let kept =
                    if type_name == StepResult::TYPE_NAME && !topic.ends_with(RECORDED_SUFFIX) {
                        let qos = RawQos {
                            reliable: true,
                            transient_local: false,
                            depth: 64,
                        };
                        let name = format!("{topic}/{RECORDED_SUFFIX}");
                        Some(Box::new(self.node.raw_publisher(&name, type_name, qos)?))
                    } else {
                        None
                    };
                let mut heard = self.shared.heard();
                heard.push(Heard {
                    topic: topic.to_owned(),
                    count: TopicCount::default(),
                    head: [0; STAMP_END],
                });
                let entry = Entry::Topic {
                    index: heard.len() - 1,
                    name: topic.to_owned(),
                    type_name: type_name.to_owned(),
                    offered: offered.to_vec(),
                    kept,
                };
                // The writing has ended: its reason comes out at the end.
                let _ = self.queue.send(entry);
                heard.len() - 1
            }
        };
        let mut subscription = self.node.raw_subscription(topic, type_name, asked)?;
        let shared = Arc::clone(&self.shared);
        let queue = self.queue.clone();
        let limit = self.options.queue_bytes;
        let flush = FLUSHED_AT_ONCE.contains(&type_name);
        let clock = self.options.use_sim_time.then(|| self.node.clock().clone());
        let mut listening = self.listening.subscribe();
        let task = self.node.spawn(async move {
            let mut sequence = shared.heard()[index].count.sequence();
            loop {
                let message = tokio::select! {
                    biased;
                    message = subscription.recv() => message,
                    _ = listening.changed() => return,
                };
                let now = match &clock {
                    Some(clock) => clock.time(),
                    None => SystemTime::now()
                        .duration_since(UNIX_EPOCH)
                        .unwrap_or_default(),
                };
                let length = message.data.len();
                // Small, rare, and what the rest is worth nothing without.
                let full = !flush && shared.queued_bytes.load(Relaxed) + length > limit;
                {
                    let heard = &mut shared.heard()[index];
                    heard.count.lost_in_transport += message.lost_before;
                    if full {
                        heard.count.lost_in_queue += 1;
                    } else {
                        heard.count.messages += 1;
                        let head = message.data.len().min(STAMP_END);
                        heard.head = [0; STAMP_END];
                        heard.head[..head].copy_from_slice(&message.data[..head]);
                    }
                }
                sequence += message.lost_before + 1;
                if full {
                    continue;
                }
                shared.queued_bytes.fetch_add(length, Relaxed);
                shared.received_bytes.fetch_add(length as u64, Relaxed);
                let stamps = Stamps {
                    // A gap in the bag says that messages are missing.
                    sequence: (sequence - 1) as u32,
                    log_time: now,
                    publish_time: message.sent_ns.map_or(now, Duration::from_nanos),
                };
                let entry = Entry::Message {
                    index,
                    stamps,
                    data: message.data,
                    flush,
                };
                if queue.send(entry).is_err() {
                    return;
                }
            }
        });
        let followed = Followed {
            type_name: type_name.to_owned(),
            index,
            asked,
            task,
        };
        self.followed.insert(topic.to_owned(), followed);
        Ok(())
    }

    /// How far it is.
    pub fn progress(&self) -> Progress {
        let mut progress = Progress {
            bytes: self.shared.received_bytes.load(Relaxed),
            ..Progress::default()
        };
        for Heard { count, .. } in self.shared.heard().iter() {
            progress.messages += count.messages;
            progress.lost_in_transport += count.lost_in_transport;
            progress.lost_in_queue += count.lost_in_queue;
        }
        progress
    }

    /// Stops listening, writes what has arrived until now, and gives the bag its name.
    pub async fn finish(self) -> Result<Recording> {
        let Self {
            path,
            shared,
            queue,
            writer,
            followed,
            listening,
            ..
        } = self;
        drop(listening);
        let deadline = Instant::now() + LAST_WORDS;
        for mut topic in followed.into_values() {
            if timeout_at(deadline.into(), &mut topic.task).await.is_err() {
                topic.task.abort();
            }
        }
        // The thread ends when all senders are gone: those of the tasks go with them.
        drop(queue);
        let written = tokio::task::spawn_blocking(move || writer.join())
            .await
            .ok()
            .and_then(std::result::Result::ok)
            .ok_or(TransportError::Panicked("recorder"))?;
        let Written { mut bag, end } = written.map_err(|source| TransportError::BrokenOff {
            partial: bags::partial_path(&path),
            bag: path.clone(),
            source: Box::new(source),
        })?;
        bag.flush()?;
        let (messages, bytes, files) = (bag.message_count(), bag.bytes()?, bag.file_count());
        tokio::task::spawn_blocking(move || bag.finish())
            .await
            .map_err(|_| TransportError::Panicked("end of the recorder"))??;
        Ok(Recording {
            bag: path,
            end,
            messages,
            bytes,
            files,
            topics: shared
                .heard()
                .iter()
                .map(|heard| (heard.topic.clone(), heard.count.clone()))
                .collect(),
        })
    }
}

impl TopicCount {
    /// Number of the next message.
    fn sequence(&self) -> u64 {
        self.messages + self.lost_in_transport + self.lost_in_queue
    }
}

/// The stamp at the beginning of a message, whichever its byte order.
fn stamp_ns(head: &[u8; STAMP_END]) -> i64 {
    let field = |at: usize| {
        let bytes = [head[at], head[at + 1], head[at + 2], head[at + 3]];
        match head[1] & 1 {
            1 => u32::from_le_bytes(bytes),
            _ => u32::from_be_bytes(bytes),
        }
    };
    i64::from(field(4) as i32) * 1_000_000_000 + i64::from(field(8))
}

fn qos(offer: RawQos) -> Qos {
    Qos {
        reliable: offer.reliable,
        transient_local: offer.transient_local,
        depth: if offer.transient_local { 1 } else { 10 },
    }
}

/// A thread that has files put on the disk while others write: what has come survives a power cut a few seconds later,
/// and the system's own buffers never grow so far that it stops the writer.
fn put_on_disk(bag: &BagWriter) -> Result<mpsc::SyncSender<File>> {
    let (disk, files) = mpsc::sync_channel::<File>(1);
    let partial = bag.partial().to_owned();
    std::thread::Builder::new()
        .name("disk".into())
        .spawn(move || {
            for file in files {
                if let Err(error) = file.sync_data() {
                    tracing::error!("{}: {error}", partial.display());
                }
            }
        })
        .map_err(|source| TransportError::Io {
            what: "thread of the disk".to_owned(),
            source,
        })?;
    Ok(disk)
}

/// The thread that owns the bag.
struct Writing {
    bag: BagWriter,
    disk: mpsc::SyncSender<File>,
    topics: Vec<Option<(TopicHandle, Option<Box<RawPublisher>>)>>,
    shared: Arc<Shared>,
    min_free_bytes: u64,
}

impl Writing {
    fn run(mut self, entries: &mpsc::Receiver<Entry>) -> Result<Written> {
        let mut flushed = Instant::now();
        let mut unflushed = false;
        loop {
            if unflushed && flushed.elapsed() >= FLUSH_EVERY {
                self.bag.flush()?;
                (flushed, unflushed) = (Instant::now(), false);
                // Still busy with the last time: then the next time.
                let _ = self.disk.try_send(self.bag.open_file()?);
                if self.is_disk_full()? {
                    return self.end(End::DiskFull);
                }
            }
            let entry = match entries.recv_timeout(FLUSH_EVERY) {
                Ok(entry) => entry,
                Err(mpsc::RecvTimeoutError::Timeout) => continue,
                Err(mpsc::RecvTimeoutError::Disconnected) => return self.end(End::Asked),
            };
            match entry {
                Entry::Topic {
                    index,
                    name,
                    type_name,
                    offered,
                    kept,
                } => {
                    let handle = self.add(&name, &type_name, &offered)?;
                    let count = self.topics.len().max(index + 1);
                    self.topics.resize_with(count, || None);
                    self.topics[index] = Some((handle, kept));
                }
                Entry::Note(key, value) => self.bag.note(key, value),
                Entry::Message {
                    index,
                    stamps,
                    data,
                    flush,
                } => {
                    self.shared.queued_bytes.fetch_sub(data.len(), Relaxed);
                    // Each topic is announced in the queue before its first message.
                    let Some((handle, kept)) = self.topics.get(index).and_then(Option::as_ref)
                    else {
                        tracing::error!(
                            "a message of topic number {index}, which was not announced, is lost"
                        );
                        continue;
                    };
                    self.bag.write_stamped(*handle, stamps, &data)?;
                    unflushed = true;
                    if flush {
                        self.bag.flush()?;
                        if let Some(kept) = kept {
                            kept.publish(data);
                        }
                    }
                }
            }
        }
    }

    fn add(
        &mut self,
        name: &str,
        type_name: &str,
        offered: &[Qos],
    ) -> Result<TopicHandle, BagError> {
        if let Some(description) = msgs::description(type_name) {
            return self.bag.add_topic(name, description, offered);
        }
        if let Some((definition, hash)) = bags::standard_definition(type_name) {
            return self
                .bag
                .add_raw_topic(name, type_name, &definition, hash, offered);
        }
        let definition = bags::installed_definition(type_name).unwrap_or_default();
        if definition.is_empty() {
            tracing::warn!(
                "{name}: the definition of {type_name} is unknown (it is in no folder of AMENT_PREFIX_PATH); the bag holds \
                 the messages without it"
            );
        } else {
            tracing::debug!("{name}: {type_name}");
        }
        self.bag
            .add_raw_topic(name, type_name, &definition, "", offered)
    }

    fn is_disk_full(&self) -> Result<bool> {
        let partial = self.bag.partial();
        let disk = rustix::fs::statvfs(partial).map_err(|error| TransportError::Io {
            what: partial.display().to_string(),
            source: error.into(),
        })?;
        Ok(disk.f_bavail.saturating_mul(disk.f_frsize) < self.min_free_bytes)
    }

    fn end(self, end: End) -> Result<Written> {
        if end == End::DiskFull {
            tracing::error!("hardly any room is left on the disk: the recording ends here");
        }
        Ok(Written { bag: self.bag, end })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_are_selected_by_name_pattern_and_exclusion() {
        let patterns = |patterns: &[&str]| RegexSet::new(patterns).unwrap();
        let selection = Selection {
            names: BTreeSet::from(["/goal".to_owned()]),
            patterns: patterns(&["^/(front|left)/"]),
            exclude: patterns(&["depth"]),
            ..Selection::default()
        };
        for (topic, expected) in [
            ("/goal", true),
            ("/goals", false),
            ("/front/color/image_raw", true),
            ("/front/depth/image_raw", false),
            ("/right/color/image_raw", false),
            ("/left/_hidden", false),
        ] {
            assert_eq!(selection.contains(topic), expected, "{topic}");
        }
        let all = Selection {
            all: true,
            ..Selection::default()
        };
        assert!(all.contains("/anything/at/all"));
        assert!(!all.contains("/_hidden"));
        let hidden = Selection {
            hidden: true,
            ..all
        };
        assert!(hidden.contains("/_hidden"));
    }
}
