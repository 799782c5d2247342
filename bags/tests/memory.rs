//! What it costs to look through a bag does not depend on its size. Alone in its program: it measures the whole of it.

use bags::{BagReader, BagWriter, Compression, Qos, recover, verify};
use std::path::Path;
use std::time::Duration;
use tempfile::TempDir;

const CHUNK_BYTES: usize = 24 << 20;
const CHUNKS: u64 = 12;

/// Most memory this process has had since the last call [bytes].
fn peak() -> usize {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix("VmHWM:"))
        .unwrap();
    let kilobytes: usize = line.trim().trim_end_matches(" kB").parse().unwrap();
    std::fs::write("/proc/self/clear_refs", "5").unwrap();
    kilobytes << 10
}

fn write(bag: &Path) {
    let mut writer = BagWriter::create(bag, Compression::Zstd(1)).unwrap();
    let topic = writer
        .add_raw_topic(
            "/big",
            "std_msgs/msg/ByteMultiArray",
            "",
            "",
            &[Qos::RELIABLE],
        )
        .unwrap();
    // Half of it compresses.
    let mut state = 1u64;
    let data: Vec<u8> = (0..CHUNK_BYTES)
        .map(|index| {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1);
            if index % 2 == 0 {
                (state >> 56) as u8
            } else {
                0
            }
        })
        .collect();
    for index in 0..CHUNKS {
        let time = Duration::from_secs(index);
        writer.write_cdr(topic, time, time, &data).unwrap();
    }
    writer.finish().unwrap();
}

#[test]
fn looking_through_a_bag_takes_less_than_four_of_its_chunks() {
    let folder = TempDir::new().unwrap();
    let bag = folder.path().join("bag");
    write(&bag);
    let file = bag.join("bag_0.mcap");
    let size = std::fs::metadata(&file).unwrap().len() as usize;
    assert!(size > 4 * CHUNK_BYTES, "the test measures nothing");
    peak();
    let before = peak();
    let limit = before + 4 * CHUNK_BYTES;

    assert!(verify(&bag).unwrap().whole);
    let used = peak();
    assert!(used < limit, "verify: {used}, before it {before}");

    // Damage in the header of a chunk, so that the rest is searched for.
    let mut bytes = std::fs::read(&file).unwrap();
    let third = mcap::Summary::read(&bytes).unwrap().unwrap().chunk_indexes[3].chunk_start_offset;
    bytes[third as usize + 3] ^= 1;
    let broken = folder.path().join("broken.mcap");
    std::fs::write(&broken, &bytes[..size - 1000]).unwrap();
    drop(bytes);
    peak();
    let copy = folder.path().join("copy");
    let recovery = recover(&broken, &copy, Compression::Zstd(1)).unwrap();
    assert!(
        (CHUNKS - 2..CHUNKS).contains(&recovery.messages),
        "{recovery:?}"
    );
    let used = peak();
    assert!(used < limit, "recover: {used}, before it {before}");

    let reader = BagReader::open(&bag).unwrap();
    let middle = Duration::from_secs(CHUNKS / 2);
    assert_eq!(
        reader.messages_between(&[], middle, Duration::MAX).count(),
        6
    );
    let used = peak();
    assert!(used < limit, "from the middle: {used}, before it {before}");
    assert_eq!(reader.messages().count(), CHUNKS as usize);
    let used = peak();
    assert!(used < limit, "all: {used}, before it {before}");
}
