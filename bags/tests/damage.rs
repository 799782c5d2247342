//! Damaged bags: `verify` tells, `recover` brings back every chunk that is intact, nothing panics.

use bags::{BagReader, BagWriter, Compression, Qos, Verification, recover, verify};
use mcap::records::Record;
use msgs::std_msgs;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tempfile::TempDir;

const CHUNKS: u64 = 12;
const MESSAGES_PER_CHUNK: u64 = 25;

/// A folder in memory where there is one: thousands of bags are synced to it.
fn folder() -> TempDir {
    let memory = Path::new("/dev/shm");
    if memory.is_dir() {
        TempDir::new_in(memory).unwrap()
    } else {
        TempDir::new().unwrap()
    }
}

fn write(bag: &Path, compression: Compression) -> PathBuf {
    let mut writer = BagWriter::create(bag, compression).unwrap();
    writer.note("problem", "placing");
    let texts = writer
        .add::<std_msgs::String>("/chatter", Qos::RELIABLE)
        .unwrap();
    let flags = writer.add::<std_msgs::Bool>("/flag", Qos::LATCHED).unwrap();
    for index in 0..CHUNKS * MESSAGES_PER_CHUNK {
        let time = Duration::from_millis(index);
        let text = std_msgs::String {
            data: format!("{index}: {}", "text ".repeat(index as usize % 7)),
        };
        writer.write(texts, time, &text).unwrap();
        if index % 10 == 0 {
            writer
                .write(flags, time, &std_msgs::Bool::default())
                .unwrap();
        }
        if index % MESSAGES_PER_CHUNK == MESSAGES_PER_CHUNK - 1 {
            writer.flush().unwrap();
        }
    }
    writer.finish().unwrap();
    bag.join(format!(
        "{}_0.mcap",
        bag.file_name().unwrap().to_str().unwrap()
    ))
}

type Message = (u16, u64, Vec<u8>);

/// The chunks of a sound file by another reader: their bytes in the file and their messages.
fn chunks(bytes: &[u8]) -> Vec<(std::ops::Range<usize>, Vec<Message>)> {
    let summary = mcap::Summary::read(bytes).unwrap().unwrap();
    let chunk = |index: &mcap::records::ChunkIndex| {
        let start = index.chunk_start_offset as usize;
        let range = start..start + index.chunk_length as usize;
        let record = mcap::parse_record(bytes[start], &bytes[start + 9..range.end]).unwrap();
        let Record::Chunk { header, data } = record else {
            panic!("no chunk where the index has one")
        };
        let records = mcap::read::ChunkReader::new(header, &data).unwrap();
        let messages = records.filter_map(|record| match record.unwrap() {
            Record::Message { header, data } => {
                Some((header.channel_id, header.log_time, data.into_owned()))
            }
            _ => None,
        });
        (range.clone(), messages.collect())
    };
    summary.chunk_indexes.iter().map(chunk).collect()
}

/// All messages of a bag; the channels are numbered as in the files above.
fn messages(bag: &Path) -> Vec<Message> {
    let reader = BagReader::open(bag).unwrap();
    let messages = reader.messages().map(|message| {
        let message = message.unwrap();
        let channel = if message.topic.name == "/chatter" {
            1
        } else {
            2
        };
        (channel, message.log_time.as_nanos() as u64, message.data)
    });
    messages.collect()
}

/// Breaks the file with `harm`, which says which bytes are no longer what they were.
fn damage_is_told_and_the_rest_saved(
    count: usize,
    seed: u64,
    harm: impl Fn(&mut Vec<u8>, &mut ChaCha8Rng) -> std::ops::Range<usize>,
) {
    let folder = folder();
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    for compression in [Compression::None, Compression::default()] {
        let bag = folder.path().join(format!("bag {compression:?}"));
        let file = write(&bag, compression);
        let sound = std::fs::read(&file).unwrap();
        let chunks = chunks(&sound);
        assert!(chunks.len() as u64 >= CHUNKS);
        for round in 0..count / 2 {
            let mut bytes = sound.clone();
            let harmed = harm(&mut bytes, &mut rng);
            let broken = folder.path().join("broken.mcap");
            std::fs::write(&broken, &bytes).unwrap();
            let verification = verify(&broken).unwrap();
            assert!(!verification.whole, "round {round}: {harmed:?} is not told");

            let copy = folder.path().join("copy");
            let recovery = recover(&broken, &copy, Compression::None).unwrap();
            let intact = chunks
                .iter()
                .filter(|(range, _)| range.end <= harmed.start || range.start >= harmed.end);
            let expected: Vec<Message> =
                intact.flat_map(|(_, messages)| messages.clone()).collect();
            let saved = messages(&copy);
            assert_eq!(recovery.messages, saved.len() as u64);
            // A harmed field of a chunk's header, its first log time for instance, leaves its messages intact.
            let all: Vec<Message> = chunks
                .iter()
                .flat_map(|(_, messages)| messages.clone())
                .collect();
            let header_harmed = harmed.len() == 1 && saved == all;
            assert!(
                saved == expected || header_harmed,
                "round {round}: {harmed:?}: {} of {}, {recovery:?}",
                saved.len(),
                expected.len()
            );
            std::fs::remove_dir_all(copy).unwrap();
        }
    }
}

#[test]
fn a_thousand_truncations_are_told_and_every_chunk_before_them_is_saved() {
    damage_is_told_and_the_rest_saved(1000, 1, |bytes, rng| {
        let end = bytes.len();
        let cut = rng.random_range(0..end);
        bytes.truncate(cut);
        cut..end
    });
}

#[test]
fn a_thousand_bit_flips_are_told_and_every_other_chunk_is_saved() {
    damage_is_told_and_the_rest_saved(1000, 2, |bytes, rng| {
        let at = rng.random_range(0..bytes.len());
        bytes[at] ^= 1 << rng.random_range(0..8);
        at..at + 1
    });
}

#[test]
fn a_sound_bag_is_whole_and_its_copy_is_the_same() {
    let folder = folder();
    let bag = folder.path().join("bag");
    write(&bag, Compression::default());
    let Verification {
        whole,
        files,
        topics,
        findings,
        ..
    } = verify(&bag).unwrap();
    assert!(whole, "{findings:?}");
    assert_eq!(files[0].messages, 330);
    assert_eq!(files[0].unchecked_chunks, 0);
    assert_eq!((topics[0].messages, topics[1].messages), (300, 30));
    assert_eq!((topics[0].missing, topics[0].longest_gap_s), (0, 0.001));
    let copy = folder.path().join("copy");
    let recovery = recover(&bag, &copy, Compression::default()).unwrap();
    assert!(recovery.complete);
    assert_eq!(messages(&copy), messages(&bag));
    assert_eq!(
        BagReader::open(&copy).unwrap().notes()["problem"],
        "placing"
    );
    assert!(verify(&copy).unwrap().whole);
}

#[test]
fn a_bag_that_was_never_finished_is_recovered_with_its_notes() {
    let folder = folder();
    let bag = folder.path().join("bag");
    let mut writer = BagWriter::create(&bag, Compression::default()).unwrap();
    let topic = writer
        .add::<std_msgs::String>("/chatter", Qos::RELIABLE)
        .unwrap();
    writer.note("problem", "placing");
    for step in 0..3 {
        let text = std_msgs::String {
            data: format!("{step}"),
        };
        writer
            .write(topic, Duration::from_secs(step), &text)
            .unwrap();
        writer.flush().unwrap();
    }
    let text = std_msgs::String {
        data: "in the open chunk".into(),
    };
    writer.write(topic, Duration::from_secs(3), &text).unwrap();
    // As if the process had been killed: neither finish nor drop.
    std::mem::forget(writer);
    let partial = bags::partial_path(&bag);
    assert!(!verify(&partial).unwrap().whole);
    let recovery = recover(&partial, &bag.with_file_name("copy"), Compression::None).unwrap();
    assert_eq!(recovery.messages, 3);
    assert!(!recovery.complete);
    let copy = BagReader::open(&recovery.path).unwrap();
    assert_eq!(copy.notes()["problem"], "placing");
    assert_eq!(copy.topics()[0].offered, [Qos::RELIABLE]);
}

#[test]
fn numbers_that_are_missing_and_gaps_are_told() {
    let folder = folder();
    let bag = folder.path().join("bag");
    let mut writer = BagWriter::create(&bag, Compression::default()).unwrap();
    let topic = writer
        .add::<std_msgs::Bool>("/flag", Qos::RELIABLE)
        .unwrap();
    for (sequence, second) in [(0, 0), (1, 1), (5, 9), (6, 10)] {
        let time = Duration::from_secs(second);
        let stamps = bags::Stamps {
            sequence,
            log_time: time,
            publish_time: time,
        };
        writer
            .write_stamped(topic, stamps, &[0, 1, 0, 0, 1])
            .unwrap();
    }
    writer.finish().unwrap();
    let verification = verify(&bag).unwrap();
    // The file is whole all the same.
    assert!(verification.whole);
    let topic = &verification.topics[0];
    assert_eq!(
        (topic.missing, topic.longest_gap_s, topic.longest_gap_at_s),
        (3, 8.0, 1.0)
    );
}

#[test]
fn metadata_that_contradicts_the_files_is_told() {
    let folder = folder();
    let bag = folder.path().join("bag");
    write(&bag, Compression::default());
    let path = bag.join("metadata.yaml");
    let text = std::fs::read_to_string(&path).unwrap();
    std::fs::write(
        &path,
        text.replace("message_count: 300", "message_count: 301"),
    )
    .unwrap();
    let verification = verify(&bag).unwrap();
    assert!(!verification.whole);
    assert!(
        verification.findings.first[0].reason.contains("301"),
        "{verification:?}"
    );
}

#[test]
fn what_is_no_bag_at_all_is_an_error_or_damage_but_no_panic() {
    let folder = folder();
    let path = folder.path().join("other.mcap");
    for bytes in [&b""[..], b"hello", &[0x89; 100], &[0; 5000], &[6; 5000]] {
        std::fs::write(&path, bytes).unwrap();
        assert!(!verify(&path).unwrap().whole);
        let copy = folder.path().join("copy");
        assert_eq!(
            recover(&path, &copy, Compression::None).unwrap().messages,
            0
        );
        std::fs::remove_dir_all(copy).unwrap();
    }
    assert!(verify(&folder.path().join("missing")).is_err());
    assert!(verify(folder.path().parent().unwrap()).is_err());
}
