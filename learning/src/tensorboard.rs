//! Event files for TensorBoard: TFRecords of protocol buffers (tensorflow/core/util/event.proto), scalars only.

use prost::Message;
use std::fs::File;
use std::io::Write;
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

/// One record of an event file.
#[derive(Clone, PartialEq, Message)]
struct Event {
    /// Seconds since 1970.
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(string, optional, tag = "3")]
    file_version: Option<String>,
    #[prost(message, optional, tag = "5")]
    summary: Option<Summary>,
}

#[derive(Clone, PartialEq, Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    value: Vec<Value>,
}

#[derive(Clone, PartialEq, Message)]
struct Value {
    #[prost(string, tag = "1")]
    tag: String,
    #[prost(float, optional, tag = "2")]
    simple_value: Option<f32>,
}

/// Writes an event file.
#[derive(Debug)]
pub struct EventFile(File);

/// Seconds since 1970: for people only.
fn now() -> f64 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0.0, |since| since.as_secs_f64())
}

/// The checksum of a TFRecord: CRC-32C, rotated and shifted.
fn masked_crc(data: &[u8]) -> [u8; 4] {
    let crc = crc32c::crc32c(data);
    crc.rotate_right(15).wrapping_add(0xa282_ead8).to_le_bytes()
}

impl EventFile {
    /// Begins a new event file in a folder, which TensorBoard is pointed at. A resumed training begins another
    /// one, which TensorBoard reads as going on.
    pub fn create(directory: &Path) -> std::io::Result<Self> {
        std::fs::create_dir_all(directory)?;
        // TensorBoard finds files by "tfevents", and orders them by name.
        let name = |count: usize| format!("events.out.tfevents.{:010}.{count}.sctn", now() as u64);
        let mut options = File::options();
        options.write(true).create_new(true);
        let mut count = 0;
        let file = loop {
            match options.open(directory.join(name(count))) {
                Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => count += 1,
                file => break file?,
            }
        };
        let mut events = Self(file);
        events.write(&Event {
            wall_time: now(),
            file_version: Some("brain.Event:2".into()),
            ..Event::default()
        })?;
        Ok(events)
    }

    /// Writes scalars of a step, at once.
    pub fn scalars(&mut self, step: u64, scalars: &[(&str, f64)]) -> std::io::Result<()> {
        let value = scalars.iter().map(|(tag, value)| Value {
            tag: (*tag).into(),
            simple_value: Some(*value as f32),
        });
        self.write(&Event {
            wall_time: now(),
            step: step as i64,
            summary: Some(Summary {
                value: value.collect(),
            }),
            ..Event::default()
        })
    }

    fn write(&mut self, event: &Event) -> std::io::Result<()> {
        let data = event.encode_to_vec();
        let length = (data.len() as u64).to_le_bytes();
        let mut record = length.to_vec();
        record.extend(masked_crc(&length));
        record.extend(&data);
        record.extend(masked_crc(&data));
        self.0.write_all(&record)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checksums_are_those_of_tensorflow() {
        // CRC-32C of 32 zero bytes (RFC 3720, B.4) is 0x8a9136aa.
        assert_eq!(crc32c::crc32c(&[0; 32]), 0x8a91_36aa);
        let expected = 0x8a91_36aa_u32.rotate_right(15).wrapping_add(0xa282_ead8);
        assert_eq!(masked_crc(&[0; 32]), expected.to_le_bytes());
    }

    #[test]
    fn scalars_are_laid_out_as_the_format_says() {
        let folder = tempfile::tempdir().unwrap();
        let mut events = EventFile::create(folder.path()).unwrap();
        events.scalars(300, &[("loss/pick", 1.5)]).unwrap();
        // A second one beside it does not overwrite the first.
        EventFile::create(folder.path()).unwrap();
        let mut paths: Vec<_> = std::fs::read_dir(folder.path())
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .collect();
        paths.sort();
        assert_eq!(paths.len(), 2);
        let bytes = std::fs::read(&paths[0]).unwrap();
        let length = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap()) as usize;
        let first = length(0);
        assert!(bytes[12..12 + first].ends_with(b"\x1a\x0dbrain.Event:2"));
        let at = 16 + first;
        let data = &bytes[at + 12..at + 12 + length(at)];
        // step: field 2, 300 as a varint; then field 5, summary; its field 1, value; tag and a float.
        let tail = b"\x10\xac\x02\x2a\x12\x0a\x10\x0a\x09loss/pick\x15\x00\x00\xc0\x3f";
        assert!(data.ends_with(tail), "{data:02x?}");
        assert_eq!(bytes.len(), at + 16 + length(at));
        assert_eq!(&bytes[bytes.len() - 4..], masked_crc(data));
    }
}
