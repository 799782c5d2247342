//! Mangled bags of every kind, for as long as BAGS_FUZZ_SECONDS says [default: 10]: whatever stands in a file, reading, verifying and
//! recovering end with an answer. Mutations are drawn at random, not guided by coverage; a failure names its seed.

use bags::{BagReader, Compression, recover, verify};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// Files of all layouts that the reader knows, small.
fn corpus(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let options = || {
        mcap::WriteOptions::new()
            .profile("ros2")
            .chunk_size(Some(300))
    };
    let kinds = [
        ("zstd.mcap", options()),
        (
            "lz4.mcap",
            options().compression(Some(mcap::Compression::Lz4)),
        ),
        ("none.mcap", options().compression(None)),
        ("flat.mcap", options().use_chunks(false)),
        (
            "bare.mcap",
            options()
                .compression(None)
                .emit_chunk_indexes(false)
                .emit_statistics(false)
                .repeat_channels(false)
                .repeat_schemas(false),
        ),
    ];
    let mut files = Vec::new();
    for (name, options) in kinds {
        let path = folder.join(name);
        let file = std::io::BufWriter::new(std::fs::File::create(&path).unwrap());
        let mut writer = options.create(file).unwrap();
        for topic in ["/a", "/b"] {
            let schema = writer
                .add_schema("std_msgs/msg/String", "ros2msg", b"string data")
                .unwrap();
            let metadata = [(
                "offered_qos_profiles".to_owned(),
                "- reliability: reliable".to_owned(),
            )];
            let channel = writer
                .add_channel(schema, topic, "cdr", &metadata.into())
                .unwrap();
            for time in 0..20u64 {
                let header = mcap::records::MessageHeader {
                    channel_id: channel,
                    sequence: time as u32,
                    log_time: time,
                    publish_time: time,
                };
                let data = [0, 1, 0, 0, 3, 0, 0, 0, b'h', b'i', 0];
                writer.write_to_known_channel(&header, &data).unwrap();
            }
        }
        writer.finish().unwrap();
        drop(writer);
        let bytes = std::fs::read(&path).unwrap();
        files.push((path, bytes));
    }
    let sqlite = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/rosbags_sqlite");
    let bytes = std::fs::read(sqlite.join("rosbags_sqlite.db3")).unwrap();
    files.push((folder.join("bag.db3"), bytes));
    files
}

fn mangle(bytes: &mut Vec<u8>, rng: &mut ChaCha8Rng) {
    for _ in 0..rng.random_range(1..6) {
        if bytes.is_empty() {
            return;
        }
        let at = rng.random_range(0..bytes.len());
        match rng.random_range(0..7) {
            0 => bytes[at] ^= 1 << rng.random_range(0..8),
            1 => bytes[at] = rng.random(),
            // A length or an offset, also an absurd one.
            2 => {
                let value: u64 = match rng.random_range(0..3) {
                    0 => rng.random_range(0..2 * bytes.len() as u64),
                    1 => u64::MAX - rng.random_range(0..32),
                    _ => rng.next_u64() >> rng.random_range(0..64),
                };
                let end = bytes.len().min(at + 8);
                bytes[at..end].copy_from_slice(&value.to_le_bytes()[..end - at]);
            }
            3 => bytes.truncate(at),
            4 => {
                let end = bytes.len().min(at + rng.random_range(1..200));
                bytes.drain(at..end);
            }
            // A piece of the file once more, somewhere else.
            5 => {
                let end = bytes.len().min(at + rng.random_range(1..400));
                let piece = bytes[at..end].to_vec();
                let to = rng.random_range(0..=bytes.len());
                bytes.splice(to..to, piece);
            }
            _ => {
                let end = bytes.len().min(at + rng.random_range(1..64));
                bytes[at..end].fill(if rng.random() { 0 } else { 0xff });
            }
        }
    }
}

#[test]
fn whatever_stands_in_a_file_there_is_an_answer() {
    let seconds = std::env::var("BAGS_FUZZ_SECONDS").map_or(10, |text| text.parse().unwrap());
    let memory = Path::new("/dev/shm");
    let folder = match memory.is_dir() {
        true => TempDir::new_in(memory),
        false => TempDir::new(),
    }
    .unwrap();
    let corpus = corpus(folder.path());
    let end = Instant::now() + Duration::from_secs(seconds);
    let (mut rounds, mut whole) = (0u64, 0u64);
    while Instant::now() < end {
        let mut rng = ChaCha8Rng::seed_from_u64(rounds);
        let (path, sound) = &corpus[rounds as usize % corpus.len()];
        let mut bytes = sound.clone();
        if rounds >= corpus.len() as u64 {
            mangle(&mut bytes, &mut rng);
        }
        std::fs::write(path, &bytes).unwrap();
        let copy = folder.path().join("copy");
        let outcome = std::panic::catch_unwind(|| {
            let read = BagReader::open(path).map(|bag| {
                let error = bag.messages().take(10_000).find_map(Result::err);
                let from = Duration::from_nanos(5);
                let _ = bag
                    .messages_between(&["/a"], from, Duration::from_nanos(9))
                    .take(10_000)
                    .count();
                error.map(|error| error.to_string())
            });
            let verified = verify(path).map(|verification| verification.whole);
            let recovered = recover(path, &copy, Compression::None);
            let _ = std::fs::remove_dir_all(&copy);
            let partial = bags::partial_path(&copy);
            let _ = std::fs::remove_dir_all(partial);
            (read, verified, recovered.is_ok())
        });
        let Ok((read, verified, _)) = outcome else {
            panic!("seed {rounds}, {}: panicked", path.display());
        };
        // What is whole can be read.
        if verified.is_ok_and(|is_whole| is_whole) {
            whole += 1;
            assert!(
                matches!(read, Ok(None)),
                "seed {rounds}, {}: {read:?}",
                path.display()
            );
        }
        rounds += 1;
    }
    assert!(whole >= corpus.len() as u64, "the sound ones are whole");
    println!("{rounds} files, {whole} of them whole");
}
