//! A bag of 10 GB is listed and played from the middle with the memory of a small one.

use std::fs::File;
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

const DOMAIN: u16 = 52;
const MESSAGE_BYTES: usize = 1_000_000;
const LARGE: u64 = 10_000;
/// Memory that may come and go: buffers of the middleware, and where the allocator happens to put things.
const LEEWAY_MB: f64 = 48.0;
static ZEROS: [u8; MESSAGE_BYTES] = [0; MESSAGE_BYTES];

/// Leaves out of the file what is zero: it takes no room on the disk.
struct Sparse(File);

impl Write for Sparse {
    fn write(&mut self, buffer: &[u8]) -> io::Result<usize> {
        let (head, tail) = buffer.split_at(buffer.len().min(4096));
        self.0.write_all(head)?;
        if (1..=ZEROS.len()).contains(&tail.len()) && tail == &ZEROS[..tail.len()] {
            // The last byte is there, so that the file ends where it should.
            self.0.seek_relative(tail.len() as i64 - 1)?;
            self.0.write_all(&[0])?;
        } else {
            self.0.write_all(tail)?;
        }
        Ok(buffer.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

impl Seek for Sparse {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.0.seek(to)
    }
}

/// So many messages of 1 MB, a hundred a second, with a latched state every second.
fn write(path: &Path, count: u64) {
    let options = mcap::WriteOptions::new()
        .profile("ros2")
        .compression(None)
        .chunk_size(Some(4 << 20));
    let file = Sparse(File::create_new(path).unwrap());
    let mut writer = options.create(BufWriter::new(file)).unwrap();
    let mut add = |topic: &str, qos: &str| {
        let schema = writer
            .add_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
            .unwrap();
        let metadata = [("offered_qos_profiles".to_owned(), qos.to_owned())];
        writer
            .add_channel(schema, topic, "cdr", &metadata.into())
            .unwrap()
    };
    let large = add("/large", "- {reliability: reliable, durability: volatile}");
    let state = add(
        "/state",
        "- {reliability: reliable, durability: transient_local}",
    );
    let mut data = vec![0; MESSAGE_BYTES];
    data[1] = 1;
    for index in 0..count {
        let mut write = |channel_id: u16, data: &[u8]| {
            let time = 1_000_000_000 + index * 10_000_000;
            let header = mcap::records::MessageHeader {
                channel_id,
                sequence: index as u32,
                log_time: time,
                publish_time: time,
            };
            writer.write_to_known_channel(&header, data).unwrap();
        };
        write(large, &data);
        if index % 100 == 0 {
            write(state, &[0, 1, 0, 0, 2, 0, 0, 0, b'a', 0]);
        }
    }
    writer.finish().unwrap();
}

/// Runs `sctn bag`; its output, and the most memory that it has had [MB].
fn sctn_bag(arguments: &[&str], bag: &Path) -> (String, f64) {
    let mut child = Command::new(env!("CARGO_BIN_EXE_sctn"))
        .arg("bag")
        .args(arguments)
        .arg(bag)
        .env("ROS_DOMAIN_ID", DOMAIN.to_string())
        .env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut peak_mb = 0.0f64;
    while child.try_wait().unwrap().is_none() {
        let status = std::fs::read_to_string(format!("/proc/{}/status", child.id()));
        let line = status
            .iter()
            .flat_map(|status| status.lines())
            .find_map(|line| line.strip_prefix("VmHWM:"));
        if let Some(line) = line {
            let kilobytes: f64 = line.trim().trim_end_matches(" kB").parse().unwrap();
            peak_mb = peak_mb.max(kilobytes * 1024.0 / 1e6);
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{arguments:?}");
    (String::from_utf8(output.stdout).unwrap(), peak_mb)
}

#[test]
fn a_bag_of_ten_gigabytes_is_listed_and_played_from_the_middle_with_the_memory_of_a_small_one() {
    let folder = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let (small, large) = (
        folder.path().join("small.mcap"),
        folder.path().join("large.mcap"),
    );
    write(&small, 200);
    write(&large, LARGE);
    let bytes = std::fs::metadata(&large).unwrap().len();
    assert!(bytes > 10_000_000_000, "{bytes}");

    let (_, expected) = sctn_bag(&["info"], &small);
    let (text, peak) = sctn_bag(&["info", "--json"], &large);
    let info: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!(info["messages"], LARGE + LARGE / 100);
    assert!(
        peak < expected + LEEWAY_MB,
        "info: {peak} MB, small: {expected} MB"
    );

    let play = |start: &str, bag: &Path| {
        let json = ["play", "--json", "--start", start, "--duration", "0.2"];
        let (text, peak) = sctn_bag(&json, bag);
        let report: serde_json::Value = serde_json::from_str(text.trim()).unwrap();
        (report["messages"].as_u64().unwrap(), peak)
    };
    let (_, expected) = play("1.005", &small);
    // What stood on the latched topic, and twenty of the large ones.
    let (messages, peak) = play("50.005", &large);
    assert_eq!(messages, 21);
    assert!(
        peak < expected + LEEWAY_MB,
        "play: {peak} MB, small: {expected} MB"
    );
}
