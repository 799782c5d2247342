//! Is a bag whole? And what can be saved of one that is not.

use crate::metadata::Metadata;
use crate::packing::{Packing, Unpacked, inner_name, unpack};
use crate::reader::{parse_metadata, read_summary};
use crate::scan::{self, Damage, Event, Records, Scan};
use crate::sqlite::{Rows, Selection, SqliteFile};
use crate::writer::{NOTES_RECORD, Stamps};
use crate::{BagError, BagWriter, Topic, TopicHandle, WriteOptions};
use mcap::records::op;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Only so many findings are described, all are counted.
const MAX_FINDINGS: usize = 1000;

/// Something that is not as it should be.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// The file's name.
    pub file: String,
    /// First byte, where the file's bytes are concerned.
    pub offset: Option<u64>,
    /// Number of bytes that cannot be used; 0 if none.
    pub length: u64,
    /// What is wrong, and what was expected.
    pub reason: String,
}

/// Findings, the first of them described.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Findings {
    /// How many there are.
    pub count: u64,
    /// Bytes that cannot be used.
    pub bytes: u64,
    /// The first thousand.
    pub first: Vec<Finding>,
}

impl Findings {
    fn push(&mut self, finding: Finding) {
        self.count += 1;
        self.bytes += finding.length;
        if self.first.len() < MAX_FINDINGS {
            self.first.push(finding);
        }
    }

    fn add(&mut self, file: &str, offset: Option<u64>, reason: String) {
        self.push(Finding {
            file: file.to_owned(),
            offset,
            length: 0,
            reason,
        });
    }

    fn add_damage(&mut self, file: &str, damage: Damage) {
        self.push(Finding {
            file: file.to_owned(),
            offset: Some(damage.offset),
            length: damage.length,
            reason: damage.reason,
        });
    }
}

/// One file of a verified bag.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct VerifiedFile {
    /// Its name.
    pub name: String,
    /// Its size.
    pub bytes: u64,
    /// Sound messages.
    pub messages: u64,
    /// Sound chunks.
    pub chunks: u64,
    /// Sound chunks that carry no checksum: damage of their data would go unnoticed.
    pub unchecked_chunks: u64,
    /// The largest chunk, uncompressed.
    pub largest_chunk_bytes: u64,
}

/// One topic of a verified bag.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct VerifiedTopic {
    /// Its name.
    pub name: String,
    /// Its type.
    pub type_name: String,
    /// Sound messages.
    pub messages: u64,
    /// Messages that the recorder's numbers say are missing; 0 also for recorders that count nothing.
    pub missing: u64,
    /// Longest time without a message between its first and its last, in seconds.
    pub longest_gap_s: f64,
    /// When that began, since the clock's zero, in seconds.
    pub longest_gap_at_s: f64,
}

/// What [`verify`] found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Verification {
    /// The bag.
    pub path: PathBuf,
    /// No finding: every byte is as its writer meant it, as far as there are checksums.
    pub whole: bool,
    /// Its files.
    pub files: Vec<VerifiedFile>,
    /// Its topics, by name.
    pub topics: Vec<VerifiedTopic>,
    /// What is wrong.
    pub findings: Findings,
    /// What is odd and takes nothing away from the bag.
    pub remarks: Vec<String>,
}

/// What [`recover`] saved.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Recovery {
    /// The repaired copy.
    pub path: PathBuf,
    /// Nothing had to be left out.
    pub complete: bool,
    /// Messages in the copy.
    pub messages: u64,
    /// Chunks whose messages are in the copy.
    pub chunks: u64,
    /// Messages of each topic in the copy.
    pub topics: BTreeMap<String, u64>,
    /// What was left out, and why.
    pub lost: Findings,
}

/// Where the files of a bag are, also of one that was never finished.
struct Found {
    paths: Vec<PathBuf>,
    metadata: Option<Metadata>,
}

fn find(path: &Path, findings: &mut Findings) -> Result<Found, BagError> {
    let io = |error| BagError::io(path, error);
    if !std::fs::metadata(path).map_err(io)?.is_dir() {
        return Ok(Found {
            paths: vec![path.to_owned()],
            metadata: None,
        });
    }
    let metadata = match parse_metadata(path) {
        Ok(metadata) => Some(metadata),
        Err(BagError::NotABag { reason, .. }) => {
            findings.add("metadata.yaml", None, reason);
            None
        }
        Err(error) => return Err(error),
    };
    let mut paths = Vec::new();
    for entry in std::fs::read_dir(path).map_err(io)? {
        let path = entry.map_err(io)?.path();
        let inner = inner_name(&path);
        let extension = inner.as_ref().unwrap_or(&path).extension();
        if extension.is_some_and(|extension| extension == "mcap" || extension == "db3") {
            paths.push(path);
        }
    }
    // Its recorder stopped between compressing a file and removing it.
    let both = paths.clone();
    let listed = |path: &Path| {
        let files = metadata.iter().flat_map(|found| &found.relative_file_paths);
        let mut names = files.map(|name| Path::new(name).file_name());
        names.any(|name| name == path.file_name())
    };
    paths.retain(|path| match inner_name(path) {
        Some(inner) => !both.contains(&inner) || listed(path),
        None => !both.iter().any(|other| {
            listed(other) && !listed(path) && inner_name(other).as_ref() == Some(path)
        }),
    });
    // NAME_2 before NAME_10.
    paths.sort_by_key(|path| (path.as_os_str().len(), path.clone()));
    for listed in metadata.iter().flat_map(|found| &found.relative_file_paths) {
        let name = Path::new(listed).file_name();
        if !paths.iter().any(|path| path.file_name() == name) {
            let reason = format!("{listed} is listed and not there");
            findings.add("metadata.yaml", None, reason);
        }
    }
    if paths.is_empty() {
        return Err(BagError::NotABag {
            path: path.to_owned(),
            reason: "it holds no .mcap and no .db3 file".into(),
        });
    }
    Ok(Found { paths, metadata })
}

fn name_of(path: &Path) -> String {
    path.file_name()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned()
}

/// A file of a bag, uncompressed if it was compressed as a whole; a compressed stream that ends early is reported.
fn open(path: &Path, findings: &mut Findings) -> Result<Unpacked, BagError> {
    let unpacked = unpack(path)?;
    if let Some(reason) = &unpacked.cut {
        let reason = format!("cannot be uncompressed to its end: {reason}");
        findings.add(&name_of(path), None, reason);
    }
    Ok(unpacked)
}

fn is_sqlite(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "db3")
}

/// What is known of the channels of a file.
#[derive(Default)]
struct Channels {
    schemas: BTreeMap<u16, mcap::Schema<'static>>,
    channels: BTreeMap<u16, Topic>,
}

impl Channels {
    /// Takes up a schema or channel record; anything else is passed over. An error if it is malformed or contradicts
    /// an earlier one.
    fn record(&mut self, opcode: u8, body: &[u8]) -> Result<(), String> {
        match opcode {
            op::SCHEMA => {
                let (id, name, encoding, data) = scan::schema(body).ok_or("not a valid schema")?;
                let schema = mcap::Schema {
                    id,
                    name,
                    encoding,
                    data: data.into(),
                };
                match self.schemas.get(&id) {
                    Some(known) if *known != schema => {
                        return Err(format!("schema {id} is defined twice, differently"));
                    }
                    _ => self.schemas.insert(id, schema),
                };
            }
            op::CHANNEL => {
                let channel = scan::channel(body).ok_or("not a valid channel")?;
                let schema = self.schemas.get(&channel.schema_id).cloned();
                if schema.is_none() && channel.schema_id != 0 {
                    return Err(format!(
                        "channel {} of topic {} has the unknown schema {}",
                        channel.id, channel.topic, channel.schema_id
                    ));
                }
                let id = channel.id;
                let topic = Topic::of(
                    &mcap::Channel {
                        id,
                        topic: channel.topic,
                        schema: schema.map(Into::into),
                        message_encoding: channel.message_encoding,
                        metadata: channel.metadata,
                    },
                    0,
                );
                match self.channels.get(&id) {
                    Some(known) if *known != topic => {
                        return Err(format!("channel {id} is defined twice, differently"));
                    }
                    _ => self.channels.insert(id, topic),
                };
            }
            _ => {}
        }
        Ok(())
    }

    /// Takes note of a message of one of them.
    fn message(
        &self,
        header: &mcap::records::MessageHeader,
        data: &[u8],
        topics: &mut Topics,
    ) -> Result<(), String> {
        let id = header.channel_id;
        let topic = self.channels.get(&id);
        let topic = topic.ok_or_else(|| format!("a message of the unknown channel {id}"))?;
        topics.message(topic, header.sequence, header.log_time, data)
    }

    fn of_summary(summary: &mcap::Summary) -> Self {
        let schemas = summary.schemas.iter();
        let channels = summary.channels.iter();
        Self {
            schemas: schemas
                .map(|(id, schema)| (*id, mcap::Schema::clone(schema)))
                .collect(),
            channels: channels
                .map(|(id, channel)| (*id, Topic::of(channel, 0)))
                .collect(),
        }
    }
}

/// Looks at every byte of a bag: framing, checksums, indices, counts, and the times of its messages. An error only if
/// it cannot be read at all.
pub fn verify(path: &Path) -> Result<Verification, BagError> {
    let mut findings = Findings::default();
    let found = find(path, &mut findings)?;
    let mut topics = Topics::of(Packing::declared(found.metadata.as_ref()));
    let mut files = Vec::new();
    for path in &found.paths {
        let unpacked = open(path, &mut findings)?;
        let name = name_of(path);
        let mut file = if is_sqlite(&unpacked.path) {
            verify_sqlite(&unpacked.path, name, &mut findings, &mut topics)?
        } else {
            verify_mcap(&unpacked.path, name, &mut findings, &mut topics)?
        };
        file.bytes = std::fs::metadata(path)
            .map_err(|error| BagError::io(path, error))?
            .len();
        files.push(file);
    }
    let mut remarks = Vec::new();
    if let Some(metadata) = &found.metadata {
        compare_metadata(metadata, &files, &topics, &mut findings);
        if metadata.storage_identifier.is_empty() {
            remarks.push(
                "metadata.yaml: storage_identifier is \"\", expected \"mcap\" or \"sqlite3\"; the files are read by their kind"
                    .to_owned(),
            );
        }
        for listed in &metadata.topics_with_message_count {
            topics.declare(
                &listed.topic_metadata.name,
                &listed.topic_metadata.type_name,
            );
        }
    }
    Ok(Verification {
        path: path.to_owned(),
        whole: findings.count == 0,
        files,
        topics: topics.by_name.into_iter().map(Progress::finish).collect(),
        findings,
        remarks,
    })
}

fn compare_metadata(
    metadata: &Metadata,
    files: &[VerifiedFile],
    topics: &Topics,
    findings: &mut Findings,
) {
    let mut differ = |what: &str, said: u64, found: u64| {
        if said != found {
            let reason = format!("it says {said} messages {what}, the files hold {found}");
            findings.add("metadata.yaml", None, reason);
        }
    };
    let total = files.iter().map(|file| file.messages).sum();
    differ("in all", metadata.message_count, total);
    for topic in &metadata.topics_with_message_count {
        let name = &topic.topic_metadata.name;
        let found = topics.by_name.get(name).map_or(0, |topic| topic.messages);
        differ(&format!("on {name}"), topic.message_count, found);
    }
}

/// Topics while messages pass.
struct Topics {
    packing: Packing,
    by_name: BTreeMap<String, Progress>,
}

#[derive(Default)]
struct Progress {
    type_name: String,
    messages: u64,
    missing: u64,
    last: Option<(u32, u64)>,
    gap: (u64, u64),
}

impl Topics {
    fn of(packing: Packing) -> Self {
        Self {
            packing,
            by_name: BTreeMap::new(),
        }
    }

    /// Takes note of a topic, which may stay without messages.
    fn declare(&mut self, name: &str, type_name: &str) {
        if !self.by_name.contains_key(name) {
            let progress = Progress {
                type_name: type_name.to_owned(),
                ..Progress::default()
            };
            self.by_name.insert(name.to_owned(), progress);
        }
    }

    /// Takes note of a message; an error if it was compressed by itself and is damaged.
    fn message(
        &mut self,
        topic: &Topic,
        sequence: u32,
        log_time: u64,
        data: &[u8],
    ) -> Result<(), String> {
        let progress = match self.by_name.get_mut(&topic.name) {
            Some(progress) => progress,
            None => self.by_name.entry(topic.name.clone()).or_default(),
        };
        progress.type_name.clone_from(&topic.type_name);
        progress.messages += 1;
        if let Some((number, time)) = progress.last {
            if sequence > number {
                progress.missing += u64::from(sequence - number - 1);
            }
            let gap = log_time.saturating_sub(time);
            if gap > progress.gap.0 {
                progress.gap = (gap, time);
            }
        }
        progress.last = Some((sequence, log_time));
        let opened = self.packing.open(&topic.message_encoding, data);
        opened.map(drop).map_err(|reason| {
            let name = &topic.name;
            format!("a message on {name} that cannot be uncompressed: {reason}")
        })
    }
}

impl Progress {
    fn finish((name, progress): (String, Self)) -> VerifiedTopic {
        VerifiedTopic {
            name,
            type_name: progress.type_name,
            messages: progress.messages,
            missing: progress.missing,
            longest_gap_s: Duration::from_nanos(progress.gap.0).as_secs_f64(),
            longest_gap_at_s: Duration::from_nanos(progress.gap.1).as_secs_f64(),
        }
    }
}

fn verify_sqlite(
    path: &Path,
    name: String,
    findings: &mut Findings,
    topics: &mut Topics,
) -> Result<VerifiedFile, BagError> {
    let mut verified = VerifiedFile {
        name: name.clone(),
        ..VerifiedFile::default()
    };
    let mut read = || -> Result<(), BagError> {
        let file = SqliteFile::open(path.to_owned())?;
        for topic in file.topics.values() {
            topics.declare(&topic.name, &topic.type_name);
        }
        for line in file.integrity()? {
            findings.add(&name, None, line);
        }
        let mut rows = Rows::new(Selection::File);
        while let Some(message) = rows.next(&file)? {
            verified.messages += 1;
            let time = message.time.as_nanos() as u64;
            if let Err(reason) = topics.message(&message.topic, 0, time, &message.data) {
                findings.add(&name, None, reason);
            }
        }
        Ok(())
    };
    match read() {
        Err(error @ (BagError::Damaged { .. } | BagError::NotABag { .. })) => {
            findings.add(&name, None, error.to_string());
        }
        other => other?,
    }
    Ok(verified)
}

/// A chunk as it was found.
struct SeenChunk {
    offset: u64,
    length: u64,
    start: u64,
    end: u64,
}

/// Everything that the end of a file repeats about its data, for comparison.
#[derive(Default)]
struct Tally {
    chunks: Vec<SeenChunk>,
    messages: u64,
    channel_messages: BTreeMap<u16, u64>,
    span: Option<(u64, u64)>,
    /// Messages of the last chunk: channel, log times and offsets.
    last_chunk: BTreeMap<u16, Vec<(u64, u64)>>,
    data_ended: bool,
    damaged: bool,
}

impl Tally {
    fn message(&mut self, header: &mcap::records::MessageHeader) {
        let time = header.log_time;
        let (first, last) = self.span.unwrap_or((time, time));
        self.span = Some((first.min(time), last.max(time)));
        self.messages += 1;
        *self.channel_messages.entry(header.channel_id).or_default() += 1;
    }
}

fn verify_mcap(
    path: &Path,
    name: String,
    findings: &mut Findings,
    topics: &mut Topics,
) -> Result<VerifiedFile, BagError> {
    let io = |error| BagError::io(path, error);
    let summary = read_summary(path);
    let hints = summary.as_ref().map_or_else(|_| Vec::new(), chunk_offsets);
    if let Err(error) = &summary {
        findings.add(&name, None, error.to_string());
    }
    let hashed = File::open(path).map_err(io)?;
    let mut crc = RunningCrc::new(&hashed);
    let mut scan = Scan::new(File::open(path).map_err(io)?, hints).map_err(io)?;
    let mut verified = VerifiedFile {
        name: name.clone(),
        ..VerifiedFile::default()
    };
    let mut channels = Channels::default();
    let mut tally = Tally::default();
    let mut footer = None;
    let mut summary_start = 0;
    while let Some(event) = scan.next().map_err(io)? {
        match event {
            Event::Damage(damage) => {
                tally.damaged = true;
                findings.add_damage(&name, damage);
            }
            Event::Chunk {
                offset,
                length,
                header,
                records,
            } => {
                verified.chunks += 1;
                verified.unchecked_chunks += u64::from(header.uncompressed_crc == 0);
                verified.largest_chunk_bytes =
                    verified.largest_chunk_bytes.max(header.uncompressed_size);
                tally.last_chunk.clear();
                tally.chunks.push(SeenChunk {
                    offset,
                    length,
                    start: header.message_start_time,
                    end: header.message_end_time,
                });
                for record in Records::new(records).flatten() {
                    let (within, opcode, body) = record;
                    if opcode != op::MESSAGE {
                        if let Err(reason) = channels.record(opcode, body) {
                            findings.add(&name, Some(offset), reason);
                        }
                        continue;
                    }
                    if let Some((header, data)) = scan::message(body) {
                        let index = tally.last_chunk.entry(header.channel_id).or_default();
                        index.push((header.log_time, within));
                        tally.message(&header);
                        if let Err(reason) = channels.message(&header, data, topics) {
                            findings.add(&name, Some(offset), reason);
                        }
                        verified.messages += 1;
                    }
                }
            }
            Event::Record {
                offset,
                opcode,
                body,
            } => match opcode {
                op::SCHEMA | op::CHANNEL => {
                    if let Err(reason) = channels.record(opcode, body) {
                        findings.add(&name, Some(offset), reason);
                    }
                }
                op::MESSAGE => {
                    if let Some((header, data)) = scan::message(body) {
                        tally.message(&header);
                        if let Err(reason) = channels.message(&header, data, topics) {
                            findings.add(&name, Some(offset), reason);
                        }
                        verified.messages += 1;
                    }
                }
                op::MESSAGE_INDEX => {
                    let fits = scan::message_index(body).is_some_and(|(id, mut entries)| {
                        entries.sort_unstable();
                        let found = tally.last_chunk.get_mut(&id);
                        found.map_or(entries.is_empty(), |found| {
                            found.sort_unstable();
                            *found == entries
                        })
                    });
                    if !fits && !tally.damaged {
                        let reason = "an index of messages that does not fit its chunk";
                        findings.add(&name, Some(offset), reason.into());
                    }
                }
                op::DATA_END => {
                    tally.data_ended = true;
                    summary_start = offset + 9 + body.len() as u64;
                    let expected = scan::data_end(body).unwrap_or(0);
                    let actual = crc.up_to(offset).map_err(io)?;
                    if expected != 0 && expected != actual {
                        let reason = "the checksum of the data does not fit";
                        findings.add(&name, Some(offset), reason.into());
                    }
                }
                op::FOOTER => {
                    if let Ok(mcap::records::Record::Footer(found)) =
                        mcap::parse_record(opcode, body)
                    {
                        footer = Some((offset, found));
                    }
                }
                // Their contents are compared below; here that they can be read.
                _ if opcode < 0x80 => {
                    if let Err(error) = mcap::parse_record(opcode, body) {
                        findings.add(&name, Some(offset), error.to_string());
                    }
                }
                _ => {}
            },
        }
        if !tally.data_ended {
            let position = scan.position();
            crc.up_to(position).map_err(io)?;
        }
    }
    match footer {
        Some((offset, footer)) if footer.summary_crc != 0 && summary_start != 0 => {
            let mut crc = RunningCrc::new(&hashed);
            crc.position = summary_start;
            // The footer's own fields up to the checksum count too.
            let actual = crc.up_to(offset + 9 + 16).map_err(io)?;
            if actual != footer.summary_crc {
                let reason = "the checksum of the summary does not fit";
                findings.add(&name, Some(summary_start), reason.into());
            }
        }
        Some(_) => {}
        None if summary.is_ok() => findings.add(&name, None, "it has no footer".into()),
        None => {}
    }
    if !tally.data_ended {
        let reason = "its data has no end: its writer stopped half-way, or it was cut";
        findings.add(&name, None, reason.into());
    }
    if let Ok(summary) = &summary {
        compare_summary(&name, summary, &tally, findings);
    }
    channels.channels.values().for_each(|topic| {
        topics.declare(&topic.name, &topic.type_name);
    });
    Ok(verified)
}

fn compare_summary(name: &str, summary: &mcap::Summary, tally: &Tally, findings: &mut Findings) {
    if let Some(stats) = &summary.stats {
        let mut differ = |what: &str, said: u64, found: u64| {
            if said != found {
                let reason = format!("its summary says {said} {what}, it holds {found}");
                findings.add(name, None, reason);
            }
        };
        differ("messages", stats.message_count, tally.messages);
        differ(
            "chunks",
            stats.chunk_count.into(),
            tally.chunks.len() as u64,
        );
        for (channel, said) in &stats.channel_message_counts {
            let found = tally.channel_messages.get(channel).copied().unwrap_or(0);
            differ(&format!("messages of channel {channel}"), *said, found);
        }
        if let Some((first, last)) = tally.span {
            differ("ns as the first log time", stats.message_start_time, first);
            differ("ns as the last log time", stats.message_end_time, last);
        }
    }
    if summary.chunk_indexes.is_empty() {
        return;
    }
    let indexed: BTreeMap<u64, &mcap::records::ChunkIndex> = summary
        .chunk_indexes
        .iter()
        .map(|index| (index.chunk_start_offset, index))
        .collect();
    for chunk in &tally.chunks {
        let fits = indexed.get(&chunk.offset).is_some_and(|index| {
            (
                index.chunk_length,
                index.message_start_time,
                index.message_end_time,
            ) == (chunk.length, chunk.start, chunk.end)
        });
        if !fits {
            let reason = "a chunk that the index does not name as it is";
            findings.add(name, Some(chunk.offset), reason.into());
        }
    }
    let seen: Vec<u64> = tally.chunks.iter().map(|chunk| chunk.offset).collect();
    for offset in indexed.keys() {
        if seen.binary_search(offset).is_err() && !tally.damaged {
            let reason = "the index names a chunk that is not there";
            findings.add(name, Some(*offset), reason.into());
        }
    }
}

fn chunk_offsets(summary: &mcap::Summary) -> Vec<u64> {
    let indexes = summary.chunk_indexes.iter();
    indexes.map(|index| index.chunk_start_offset).collect()
}

/// The checksum of a file from one byte to another.
struct RunningCrc<'a> {
    file: &'a File,
    position: u64,
    hasher: crc32fast::Hasher,
    buffer: Vec<u8>,
}

impl<'a> RunningCrc<'a> {
    fn new(file: &'a File) -> Self {
        Self {
            file,
            position: 0,
            hasher: crc32fast::Hasher::new(),
            buffer: vec![0; 1 << 16],
        }
    }

    fn up_to(&mut self, end: u64) -> io::Result<u32> {
        while self.position < end {
            let count = self.buffer.len().min((end - self.position) as usize);
            let buffer = &mut self.buffer[..count];
            self.file.read_exact_at(buffer, self.position)?;
            self.hasher.update(buffer);
            self.position += count as u64;
        }
        Ok(self.hasher.clone().finalize())
    }
}

/// Writes a repaired copy of a bag, finished or not: the messages of all chunks whose checksums fit, in their order. In
/// files without chunks every message whose framing is sound counts. The copy is a bag of its own; the original stays as it is.
pub fn recover(
    source: &Path,
    copy: &Path,
    options: impl Into<WriteOptions>,
) -> Result<Recovery, BagError> {
    let mut lost = Findings::default();
    let found = find(source, &mut lost)?;
    BagWriter::discard_partial(copy)?;
    let mut copied = Copied {
        bag: BagWriter::create(copy, options)?,
        packing: Packing::declared(found.metadata.as_ref()),
        topics: BTreeMap::new(),
        counts: BTreeMap::new(),
        chunks: 0,
    };
    let notes = found.metadata.and_then(|metadata| metadata.custom_data);
    for (key, value) in notes.into_iter().flatten() {
        copied.bag.note(&key, value);
    }
    for path in &found.paths {
        let unpacked = open(path, &mut lost)?;
        let name = name_of(path);
        if is_sqlite(&unpacked.path) {
            copied.sqlite(&unpacked.path, name, &mut lost)?;
        } else {
            copied.mcap(&unpacked.path, name, &mut lost)?;
        }
    }
    let messages = copied.bag.message_count();
    copied.bag.finish()?;
    Ok(Recovery {
        path: copy.to_owned(),
        complete: lost.count == 0,
        messages,
        chunks: copied.chunks,
        topics: copied.counts,
        lost,
    })
}

/// A copy that is being made.
struct Copied {
    bag: BagWriter,
    packing: Packing,
    topics: BTreeMap<String, TopicHandle>,
    counts: BTreeMap<String, u64>,
    chunks: u64,
}

impl Copied {
    /// Also topics without messages; two of one name and different types come to light with their messages.
    fn announce(&mut self, topic: &Topic) {
        if let Ok(handle) = self.bag.add_topic_of(topic) {
            self.topics.insert(topic.name.clone(), handle);
            self.counts.entry(topic.name.clone()).or_default();
        }
    }

    /// Writes a message as it was before rosbag2 compressed it; `false`: that cannot be undone.
    fn write(&mut self, topic: &Topic, stamps: Stamps, data: &[u8]) -> Result<bool, BagError> {
        let Ok(data) = self.packing.open_cow(&topic.message_encoding, data) else {
            return Ok(false);
        };
        let handle = match self.topics.get(&topic.name) {
            Some(handle) => *handle,
            None => {
                let handle = self.bag.add_topic_of(topic)?;
                self.topics.insert(topic.name.clone(), handle);
                self.counts.insert(topic.name.clone(), 0);
                handle
            }
        };
        self.bag.write_stamped(handle, stamps, &data)?;
        if let Some(count) = self.counts.get_mut(&topic.name) {
            *count += 1;
        }
        Ok(true)
    }

    fn sqlite(&mut self, path: &Path, name: String, lost: &mut Findings) -> Result<(), BagError> {
        let mut read = || -> Result<(), BagError> {
            let file = SqliteFile::open(path.to_owned())?;
            for topic in file.topics.values() {
                self.announce(topic);
            }
            let mut rows = Rows::new(Selection::File);
            while let Some(message) = rows.next(&file)? {
                let stamps = Stamps {
                    sequence: 0,
                    log_time: message.time,
                    publish_time: message.time,
                };
                if !self.write(&message.topic, stamps, &message.data)? {
                    lost.add(&name, None, packed(&message.topic));
                }
            }
            Ok(())
        };
        match read() {
            Err(error @ (BagError::Damaged { .. } | BagError::NotABag { .. })) => {
                lost.add(&name, None, error.to_string());
                Ok(())
            }
            other => other,
        }
    }

    fn mcap(&mut self, path: &Path, name: String, lost: &mut Findings) -> Result<(), BagError> {
        let io = |error| BagError::io(path, error);
        let summary = read_summary(path).ok();
        let hints = summary.as_ref().map_or_else(Vec::new, chunk_offsets);
        let mut channels = summary.as_ref().map(Channels::of_summary);
        let channels = channels.get_or_insert_default();
        for topic in channels.channels.values() {
            self.announce(topic);
        }
        let mut scan = Scan::new(File::open(path).map_err(io)?, hints).map_err(io)?;
        let mut orphans: BTreeMap<u16, u64> = BTreeMap::new();
        let mut ended = false;
        let mut packed_wrong: BTreeMap<String, u64> = BTreeMap::new();
        let mut message = |copied: &mut Self, channels: &Channels, body: &[u8]| {
            let Some((header, data)) = scan::message(body) else {
                return Ok(());
            };
            let Some(topic) = channels.channels.get(&header.channel_id) else {
                *orphans.entry(header.channel_id).or_default() += 1;
                return Ok(());
            };
            let stamps = Stamps {
                sequence: header.sequence,
                log_time: Duration::from_nanos(header.log_time),
                publish_time: Duration::from_nanos(header.publish_time),
            };
            if !copied.write(topic, stamps, data)? {
                *packed_wrong.entry(packed(topic)).or_default() += 1;
            }
            Ok::<_, BagError>(())
        };
        while let Some(event) = scan.next().map_err(io)? {
            match event {
                Event::Damage(damage) => lost.add_damage(&name, damage),
                Event::Chunk {
                    offset, records, ..
                } => {
                    self.chunks += 1;
                    for (_, opcode, body) in Records::new(records).flatten() {
                        if opcode == op::MESSAGE {
                            message(self, channels, body)?;
                        } else if let Err(reason) = channels.record(opcode, body) {
                            lost.add(&name, Some(offset), reason);
                        }
                    }
                }
                Event::Record {
                    offset,
                    opcode,
                    body,
                } => match opcode {
                    op::MESSAGE => message(self, channels, body)?,
                    op::SCHEMA | op::CHANNEL => {
                        if let Err(reason) = channels.record(opcode, body) {
                            lost.add(&name, Some(offset), reason);
                        }
                    }
                    op::METADATA => {
                        let notes = scan::metadata(body).filter(|(name, _)| name == NOTES_RECORD);
                        for (key, value) in notes.into_iter().flat_map(|(_, entries)| entries) {
                            self.bag.note(&key, value);
                        }
                    }
                    op::DATA_END => ended = true,
                    _ => {}
                },
            }
        }
        if !ended {
            let reason = "its data has no end: its writer stopped half-way, or it was cut";
            lost.add(&name, None, reason.into());
        }
        for (reason, count) in packed_wrong {
            lost.add(&name, None, format!("{count} times {reason}"));
        }
        for (channel, count) in orphans {
            let reason = format!("{count} messages of the unknown channel {channel}");
            lost.add(&name, None, reason);
        }
        Ok(())
    }
}

fn packed(topic: &Topic) -> String {
    let name = &topic.name;
    format!("a message on {name} that cannot be uncompressed")
}
