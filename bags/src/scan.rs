//! Walks through an MCAP file that may be damaged: what is sound comes as events, what is not as damage.
//!
//! The walk trusts nothing: lengths are checked against the record's own fields and the file's end before anything
//! is read, a chunk counts only when its checksum fits, and after damage the walk goes on at the next chunk. It holds one chunk at
//! a time, compressed and not.

use mcap::records::{ChunkHeader, op};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read};
use std::os::unix::fs::FileExt;

/// A larger record or chunk is taken for damage.
pub(crate) const MAX_RECORD_BYTES: u64 = 256 << 20;
/// Opcode and length.
const RECORD_HEADER: u64 = 9;
/// A chunk's fields before the name of its compression.
const CHUNK_FIELDS: usize = 8 + 8 + 8 + 4 + 4;
/// Length of the longest name of a compression.
const MAX_COMPRESSION_NAME: usize = 16;
/// How much of the file is searched at a time for the next sound record.
const WINDOW_BYTES: usize = 1 << 20;
const MAGIC_BYTES: u64 = mcap::MAGIC.len() as u64;

/// A stretch of the file that cannot be used.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Damage {
    /// First byte.
    pub offset: u64,
    /// Number of bytes.
    pub length: u64,
    /// What is wrong.
    pub reason: String,
}

/// What comes next in a file.
#[derive(Debug)]
pub(crate) enum Event<'a> {
    /// A record outside of chunks.
    Record {
        /// Its first byte in the file.
        offset: u64,
        /// Its kind, see [`mcap::records::op`].
        opcode: u8,
        /// What it says.
        body: &'a [u8],
    },
    /// A chunk, its checksum verified if it has one; all its records are well-formed.
    Chunk {
        /// Its first byte in the file.
        offset: u64,
        /// Bytes in the file, with opcode and length.
        length: u64,
        /// Its header.
        header: ChunkHeader,
        /// Its records, uncompressed.
        records: &'a [u8],
    },
    /// Bytes that are not a record.
    Damage(Damage),
}

/// Where messages stand in a file: the two are not mixed, so that the inside of a damaged chunk is never read as records.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Layout {
    Unknown,
    Chunks,
    Messages,
}

/// A walk through a file.
pub(crate) struct Scan {
    file: File,
    size: u64,
    position: u64,
    /// Offsets of chunks that the file's own index names, ascending.
    hints: Vec<u64>,
    layout: Layout,
    /// After the footer nothing may come but the magic.
    footer_seen: bool,
    started: bool,
    raw: Vec<u8>,
    chunk: Vec<u8>,
}

impl Scan {
    /// Begins at the start of the file. `hints`: offsets of chunks by the file's index, if it could be read.
    pub fn new(file: File, mut hints: Vec<u64>) -> io::Result<Self> {
        let size = file.metadata()?.len();
        hints.sort_unstable();
        Ok(Self {
            file,
            size,
            position: 0,
            layout: if hints.is_empty() {
                Layout::Unknown
            } else {
                Layout::Chunks
            },
            hints,
            footer_seen: false,
            started: false,
            raw: Vec::new(),
            chunk: Vec::new(),
        })
    }

    /// Where the next event begins.
    pub fn position(&self) -> u64 {
        self.position
    }

    /// The next event; none at the end. Only what the system refuses is an error.
    pub fn next(&mut self) -> io::Result<Option<Event<'_>>> {
        if !self.started {
            self.started = true;
            let mut magic = [0; mcap::MAGIC.len()];
            let read = read_up_to(&self.file, &mut magic, 0)?;
            self.position = MAGIC_BYTES.min(self.size);
            if magic != *mcap::MAGIC {
                return Ok(Some(Event::Damage(Damage {
                    offset: 0,
                    length: read as u64,
                    reason: "the file does not begin with the magic of MCAP".into(),
                })));
            }
        }
        if self.position >= self.size {
            return Ok(None);
        }
        if self.footer_seen {
            return self.end();
        }
        let offset = self.position;
        let (opcode, length) = match self.header_at(offset)? {
            Ok(header) => header,
            Err(reason) => {
                if self.is_cut_chunk(offset)? {
                    self.layout = Layout::Chunks;
                }
                return self.skip(offset, reason);
            }
        };
        let end = offset + RECORD_HEADER + length;
        if opcode == op::CHUNK {
            return self.read_chunk(offset, length);
        }
        if opcode == op::MESSAGE {
            if self.layout == Layout::Chunks {
                let reason = "a message outside of chunks in a file of chunks".to_owned();
                return self.skip(offset, reason);
            }
            self.layout = Layout::Messages;
        }
        // Before a large read: a length that has flipped leads to nothing.
        if end != self.size && self.header_at(end)?.is_err() && opcode != op::FOOTER {
            let reason =
                format!("a record of kind {opcode:#04x} and {length} bytes that no other follows");
            if length > WINDOW_BYTES as u64 || opcode == op::MESSAGE {
                return self.skip(offset, reason);
            }
        }
        self.raw.resize(length as usize, 0);
        self.file
            .read_exact_at(&mut self.raw, offset + RECORD_HEADER)?;
        // Exactly as long as its fields say: or a bit of the length or of the kind has flipped.
        match expected_length(opcode, &self.raw) {
            Some(expected) if expected == length => {}
            // Later versions may add fields, and then another record follows.
            Some(expected) if expected < length && self.header_at(end)?.is_ok() => {}
            _ => {
                let reason = format!(
                    "a record of kind {opcode:#04x} whose fields do not fit its length {length}"
                );
                return self.skip(offset, reason);
            }
        }
        self.footer_seen = opcode == op::FOOTER;
        self.position = end;
        Ok(Some(Event::Record {
            offset,
            opcode,
            body: &self.raw,
        }))
    }

    /// Whether a chunk begins there that the file's end cuts off, or that was never completed.
    fn is_cut_chunk(&self, offset: u64) -> io::Result<bool> {
        let mut header = [0; RECORD_HEADER as usize];
        read_up_to(&self.file, &mut header, offset)?;
        let mut fields = Fields(&header[1..]);
        let length = fields.u64().unwrap_or(0);
        Ok(header[0] == op::CHUNK
            && (length == u64::MAX || self.chunk_header_at(offset, length)?.is_ok()))
    }

    /// What follows the footer: the magic, and nothing else.
    fn end(&mut self) -> io::Result<Option<Event<'_>>> {
        let offset = self.position;
        let mut magic = [0; mcap::MAGIC.len()];
        read_up_to(&self.file, &mut magic, offset)?;
        self.position = self.size;
        if magic == *mcap::MAGIC && offset + MAGIC_BYTES == self.size {
            return Ok(None);
        }
        Ok(Some(Event::Damage(Damage {
            offset,
            length: self.size - offset,
            reason: "after the footer comes something else than the magic of MCAP".into(),
        })))
    }

    /// Kind and length of the record at an offset, if it can be one.
    fn header_at(&self, offset: u64) -> io::Result<Result<(u8, u64), String>> {
        let mut header = [0; RECORD_HEADER as usize];
        let read = read_up_to(&self.file, &mut header, offset)?;
        if read < header.len() {
            return Ok(Err("the file ends within the header of a record".into()));
        }
        let opcode = header[0];
        let mut length = [0; 8];
        length.copy_from_slice(&header[1..]);
        let length = u64::from_le_bytes(length);
        let left = self.size - offset - RECORD_HEADER;
        Ok(if opcode == 0 {
            Err("a record of kind 0x00".into())
        } else if opcode > op::DATA_END && opcode < 0x80 {
            Err(format!("a record of the unknown kind {opcode:#04x}"))
        } else if opcode == op::CHUNK && length == u64::MAX {
            Err("a chunk that was never completed".into())
        } else if length > left {
            Err(format!(
                "a record of kind {opcode:#04x} and {length} bytes where {left} are left"
            ))
        } else if length > MAX_RECORD_BYTES {
            Err(format!(
                "a record of kind {opcode:#04x} and {length} bytes, expected at most {MAX_RECORD_BYTES}"
            ))
        } else {
            Ok((opcode, length))
        })
    }

    fn read_chunk(&mut self, offset: u64, length: u64) -> io::Result<Option<Event<'_>>> {
        let (header, header_length) = match self.chunk_header_at(offset, length)? {
            Ok(header) => header,
            Err(reason) => return self.skip(offset, reason),
        };
        self.layout = Layout::Chunks;
        let total = RECORD_HEADER + length;
        self.position = offset + total;
        let damage = |reason| {
            Ok(Some(Event::Damage(Damage {
                offset,
                length: total,
                reason,
            })))
        };
        if header.uncompressed_size > MAX_RECORD_BYTES {
            return damage(format!(
                "a chunk of {} bytes uncompressed, expected at most {MAX_RECORD_BYTES}",
                header.uncompressed_size
            ));
        }
        self.raw.resize(header.compressed_size as usize, 0);
        let start = offset + RECORD_HEADER + header_length;
        self.file.read_exact_at(&mut self.raw, start)?;
        if let Err(reason) = uncompress(&header, &mut self.raw, &mut self.chunk) {
            return damage(reason);
        }
        if header.uncompressed_crc != 0 && crc32fast::hash(&self.chunk) != header.uncompressed_crc {
            return damage("a chunk whose checksum does not fit".into());
        }
        if let Some(Err(reason)) = Records::new(&self.chunk).find(Result::is_err) {
            return damage(format!("a chunk with {reason}"));
        }
        Ok(Some(Event::Chunk {
            offset,
            length: total,
            header,
            records: &self.chunk,
        }))
    }

    /// The header of the chunk at an offset and its length, if its fields fit the record's length.
    fn chunk_header_at(
        &self,
        offset: u64,
        length: u64,
    ) -> io::Result<Result<(ChunkHeader, u64), String>> {
        let mut bytes = [0; CHUNK_FIELDS + MAX_COMPRESSION_NAME + 8];
        let read = read_up_to(&self.file, &mut bytes, offset + RECORD_HEADER)?;
        Ok(parse_chunk_header(&bytes[..read], length)
            .ok_or_else(|| "a chunk whose fields do not fit its length".to_owned()))
    }

    /// Damage from `offset` to the next sound record.
    fn skip(&mut self, offset: u64, reason: String) -> io::Result<Option<Event<'_>>> {
        let next = self.find_sound(offset + 1)?;
        self.position = next;
        Ok(Some(Event::Damage(Damage {
            offset,
            length: next - offset,
            reason,
        })))
    }

    /// The first sound record at or after an offset; the end of the file if there is none.
    fn find_sound(&mut self, from: u64) -> io::Result<u64> {
        const IN_CHUNKS: &[u8] = &[op::CHUNK, op::DATA_END];
        const AMONG_MESSAGES: &[u8] = &[op::MESSAGE, op::SCHEMA, op::CHANNEL, op::DATA_END];
        let hint = self.hints.partition_point(|hint| *hint < from);
        if let Some(&hint) = self.hints.get(hint) {
            // The index knows better than a search through other people's bytes.
            if self.is_sound(hint, op::CHUNK)? {
                return Ok(hint);
            }
        }
        match self.layout {
            Layout::Chunks => self.find(from, IN_CHUNKS),
            Layout::Messages => self.find(from, AMONG_MESSAGES),
            Layout::Unknown => {
                let found = self.find(from, &[op::CHUNK])?;
                self.layout = Layout::Chunks;
                if found < self.size {
                    return Ok(found);
                }
                self.layout = Layout::Messages;
                self.find(from, AMONG_MESSAGES)
            }
        }
    }

    fn find(&mut self, from: u64, wanted: &[u8]) -> io::Result<u64> {
        let mut window = std::mem::take(&mut self.raw);
        window.resize(WINDOW_BYTES, 0);
        let mut start = from;
        while start < self.size {
            let read = read_up_to(&self.file, &mut window, start)?;
            if read == 0 {
                break;
            }
            for (index, opcode) in window[..read].iter().enumerate() {
                if !wanted.contains(opcode) {
                    continue;
                }
                // The length's upper half is zero: a cheap look before a read.
                let high = window[..read].get(index + 5..index + 9);
                let offset = start + index as u64;
                if high.is_none_or(|high| high == [0; 4]) && self.is_sound(offset, *opcode)? {
                    self.raw = window;
                    return Ok(offset);
                }
            }
            start += read as u64;
        }
        self.raw = window;
        Ok(self.size)
    }

    /// Whether a record of that kind starts there.
    fn is_sound(&self, offset: u64, expected: u8) -> io::Result<bool> {
        let Ok((opcode, length)) = self.header_at(offset)? else {
            return Ok(false);
        };
        if opcode != expected {
            return Ok(false);
        }
        if opcode == op::CHUNK {
            return Ok(self.chunk_header_at(offset, length)?.is_ok());
        }
        if (opcode == op::DATA_END && length != 4) || (opcode == op::MESSAGE && length < 22) {
            return Ok(false);
        }
        // There is little in it that could be checked: others must follow.
        let mut end = offset + RECORD_HEADER + length;
        for _ in 0..2 {
            if end == self.size {
                break;
            }
            match self.header_at(end)? {
                Ok((op::FOOTER, _)) => break,
                Ok((_, length)) => end += RECORD_HEADER + length,
                Err(_) => return Ok(false),
            }
        }
        Ok(true)
    }
}

/// Reads until the buffer is full or the file ends.
fn read_up_to(file: &File, buffer: &mut [u8], offset: u64) -> io::Result<usize> {
    let mut read = 0;
    while read < buffer.len() {
        match file.read_at(&mut buffer[read..], offset + read as u64) {
            Ok(0) => break,
            Ok(count) => read += count,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(read)
}

fn parse_chunk_header(bytes: &[u8], length: u64) -> Option<(ChunkHeader, u64)> {
    let mut fields = Fields(bytes);
    let mut header = ChunkHeader {
        message_start_time: fields.u64()?,
        message_end_time: fields.u64()?,
        uncompressed_size: fields.u64()?,
        uncompressed_crc: fields.u32()?,
        compression: String::new(),
        compressed_size: 0,
    };
    let name = fields.u32()? as usize;
    if name > MAX_COMPRESSION_NAME {
        return None;
    }
    header.compression = std::str::from_utf8(fields.take(name)?).ok()?.to_owned();
    header.compressed_size = fields.u64()?;
    let header_length = (CHUNK_FIELDS + name + 8) as u64;
    let fits = header_length.checked_add(header.compressed_size) == Some(length);
    fits.then_some((header, header_length))
}

/// Fills `out` with the records of a chunk; `raw` may be used up.
fn uncompress(header: &ChunkHeader, raw: &mut Vec<u8>, out: &mut Vec<u8>) -> Result<(), String> {
    let expected = header.uncompressed_size as usize;
    out.clear();
    match header.compression.as_str() {
        "" => std::mem::swap(raw, out),
        "zstd" => {
            // In one go, straight into the result: a window of its own could be as large as a damaged header says.
            out.reserve_exact(expected);
            let mut decompressor =
                zstd::bulk::Decompressor::new().map_err(|error| error.to_string())?;
            decompressor
                .decompress_to_buffer(raw.as_slice(), out)
                .map_err(|error| format!("a chunk that zstd cannot uncompress: {error}"))?;
        }
        "lz4" => {
            let decoder = lz4::Decoder::new(raw.as_slice());
            decoder
                .and_then(|decoder| decoder.take(expected as u64 + 1).read_to_end(out))
                .map_err(|error| format!("a chunk that lz4 cannot uncompress: {error}"))?;
        }
        other => return Err(format!("a chunk with the unknown compression {other:?}")),
    }
    if out.len() != expected {
        return Err(format!(
            "a chunk of {} bytes uncompressed, expected {expected}",
            out.len()
        ));
    }
    Ok(())
}

/// The records of a chunk: offset within it, kind, body. Nothing comes after an error.
pub(crate) struct Records<'a> {
    bytes: &'a [u8],
    position: usize,
}

impl<'a> Records<'a> {
    pub fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, position: 0 }
    }
}

impl<'a> Iterator for Records<'a> {
    type Item = Result<(u64, u8, &'a [u8]), String>;

    fn next(&mut self) -> Option<Self::Item> {
        let offset = self.position;
        let mut fields = Fields(self.bytes.get(offset..)?);
        if fields.0.is_empty() {
            return None;
        }
        let mut record = || {
            let opcode = fields.take(1)?[0];
            let length = fields.u64()?;
            let body = fields.take(usize::try_from(length).ok()?)?;
            let expected = expected_length(opcode, body)?;
            (expected <= length).then_some((opcode, body))
        };
        let Some((opcode, body)) = record() else {
            self.position = self.bytes.len();
            return Some(Err(format!("invalid record at byte {offset}")));
        };
        self.position += RECORD_HEADER as usize + body.len();
        Some(Ok((offset as u64, opcode, body)))
    }
}

/// How long a record of that kind has to be by its own fields; none if it is not of that kind.
fn expected_length(opcode: u8, body: &[u8]) -> Option<u64> {
    let mut fields = Fields(body);
    match opcode {
        op::HEADER => {
            fields.block()?;
            fields.block()?;
        }
        op::FOOTER => {
            fields.take(20)?;
        }
        op::SCHEMA => {
            fields.take(2)?;
            fields.block()?;
            fields.block()?;
            fields.block()?;
        }
        op::CHANNEL => {
            fields.take(4)?;
            fields.block()?;
            fields.block()?;
            fields.block()?;
        }
        op::MESSAGE => {
            fields.take(22)?;
            return Some(body.len() as u64);
        }
        op::MESSAGE_INDEX => {
            fields.take(2)?;
            (fields.block()?.len() % 16 == 0).then_some(())?;
        }
        op::CHUNK_INDEX => {
            fields.take(32)?;
            fields.block()?;
            fields.take(8)?;
            fields.block()?;
            fields.take(16)?;
        }
        op::ATTACHMENT => {
            fields.take(16)?;
            fields.block()?;
            fields.block()?;
            let data = fields.u64()?;
            fields.take(usize::try_from(data).ok()?)?;
            fields.take(4)?;
        }
        op::ATTACHMENT_INDEX => {
            fields.take(40)?;
            fields.block()?;
            fields.block()?;
        }
        op::STATISTICS => {
            fields.take(42)?;
            fields.block()?;
        }
        op::METADATA => {
            fields.block()?;
            fields.block()?;
        }
        op::METADATA_INDEX => {
            fields.take(16)?;
            fields.block()?;
        }
        op::SUMMARY_OFFSET => {
            fields.take(17)?;
        }
        op::DATA_END => {
            fields.take(4)?;
        }
        0x80.. => return Some(body.len() as u64),
        _ => return None,
    }
    Some((body.len() - fields.0.len()) as u64)
}

/// Little-endian fields of a record, one after the other.
struct Fields<'a>(&'a [u8]);

impl<'a> Fields<'a> {
    fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(count)?;
        self.0 = rest;
        Some(taken)
    }

    fn u16(&mut self) -> Option<u16> {
        Some(u16::from_le_bytes(self.take(2)?.try_into().ok()?))
    }

    fn text(&mut self) -> Option<String> {
        String::from_utf8(self.block()?.to_vec()).ok()
    }

    fn map(&mut self) -> Option<BTreeMap<String, String>> {
        let mut entries = Fields(self.block()?);
        let mut map = BTreeMap::new();
        while !entries.0.is_empty() {
            map.insert(entries.text()?, entries.text()?);
        }
        Some(map)
    }

    fn u32(&mut self) -> Option<u32> {
        Some(u32::from_le_bytes(self.take(4)?.try_into().ok()?))
    }

    fn u64(&mut self) -> Option<u64> {
        Some(u64::from_le_bytes(self.take(8)?.try_into().ok()?))
    }

    /// Bytes after their number.
    fn block(&mut self) -> Option<&'a [u8]> {
        let length = self.u32()?;
        self.take(length as usize)
    }
}

/// A schema: id, name, encoding, data.
pub(crate) fn schema(body: &[u8]) -> Option<(u16, String, String, Vec<u8>)> {
    let mut fields = Fields(body);
    Some((
        fields.u16()?,
        fields.text()?,
        fields.text()?,
        fields.block()?.to_vec(),
    ))
}

/// A channel.
pub(crate) fn channel(body: &[u8]) -> Option<mcap::records::Channel> {
    let mut fields = Fields(body);
    Some(mcap::records::Channel {
        id: fields.u16()?,
        schema_id: fields.u16()?,
        topic: fields.text()?,
        message_encoding: fields.text()?,
        metadata: fields.map()?,
    })
}

/// A message and its data.
pub(crate) fn message(body: &[u8]) -> Option<(mcap::records::MessageHeader, &[u8])> {
    let mut fields = Fields(body);
    let header = mcap::records::MessageHeader {
        channel_id: fields.u16()?,
        sequence: fields.u32()?,
        log_time: fields.u64()?,
        publish_time: fields.u64()?,
    };
    Some((header, fields.0))
}

/// The index of a chunk's messages of one channel: its id, log times and offsets.
pub(crate) fn message_index(body: &[u8]) -> Option<(u16, Vec<(u64, u64)>)> {
    let mut fields = Fields(body);
    let id = fields.u16()?;
    let entries = fields.block()?.chunks_exact(16).map(|entry| {
        let mut entry = Fields(entry);
        Some((entry.u64()?, entry.u64()?))
    });
    Some((id, entries.collect::<Option<_>>()?))
}

/// A record of metadata: name and entries.
pub(crate) fn metadata(body: &[u8]) -> Option<(String, BTreeMap<String, String>)> {
    let mut fields = Fields(body);
    Some((fields.text()?, fields.map()?))
}

/// The checksum that ends the data.
pub(crate) fn data_end(body: &[u8]) -> Option<u32> {
    Fields(body).u32()
}
