//! Bags: what is written is read, and what is no bag says why.

use bags::{BagError, BagReader, BagWriter, Compression, Qos, RawMessage, partial_path};
use msgs::{description, rosgraph_msgs, sensor_msgs, std_msgs};
use proptest::prelude::*;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tempfile::TempDir;

fn folder() -> (TempDir, PathBuf) {
    let folder = TempDir::new().unwrap();
    let bag = folder.path().join("run");
    (folder, bag)
}

fn text(data: impl Into<String>) -> std_msgs::String {
    std_msgs::String { data: data.into() }
}

/// Texts `0` to `count - 1`, one a millisecond, and a clock every tenth.
fn write(bag: &Path, count: u64, compression: Compression) {
    let mut writer = BagWriter::create(bag, compression).unwrap();
    let texts = writer
        .add::<std_msgs::String>("/chatter", Qos::RELIABLE)
        .unwrap();
    let clocks = writer
        .add::<rosgraph_msgs::Clock>("/clock", Qos::BEST_EFFORT)
        .unwrap();
    for index in 0..count {
        let time = Duration::from_millis(index);
        writer
            .write(texts, time, &text(format!("{index}")))
            .unwrap();
        if index % 10 == 0 {
            writer
                .write(clocks, time, &rosgraph_msgs::Clock::default())
                .unwrap();
        }
        if index % 1000 == 999 {
            writer.flush().unwrap();
        }
    }
    writer.note("problem", "placing");
    writer.finish().unwrap();
}

fn file(bag: &Path) -> PathBuf {
    bag.join("run_0.mcap")
}

#[test]
fn what_is_written_is_read_in_order() {
    for compression in [Compression::None, Compression::default()] {
        let (_folder, bag) = folder();
        write(&bag, 2500, compression);
        let reader = BagReader::open(&bag).unwrap();
        let texts: Vec<String> = reader
            .messages()
            .map(Result::unwrap)
            .filter(|message| message.topic.name == "/chatter")
            .map(|message| message.decode::<std_msgs::String>().unwrap().data)
            .collect();
        assert!(
            texts
                .iter()
                .map(|text| text.parse::<u64>().unwrap())
                .eq(0..2500)
        );
        assert_eq!(reader.notes()["problem"], "placing");
        assert_eq!(
            reader.span(),
            Some((Duration::ZERO, Duration::from_millis(2499)))
        );
        let counts: Vec<(&str, u64, &str)> = reader
            .topics()
            .iter()
            .map(|topic| {
                (
                    topic.name.as_str(),
                    topic.message_count,
                    topic.type_name.as_str(),
                )
            })
            .collect();
        assert_eq!(
            counts,
            [
                ("/chatter", 2500, "std_msgs/msg/String"),
                ("/clock", 250, "rosgraph_msgs/msg/Clock")
            ]
        );
        assert_eq!(reader.topics()[1].offered, [Qos::BEST_EFFORT]);
        assert_eq!(
            reader.topics()[1].definition,
            description("rosgraph_msgs/msg/Clock")
                .unwrap()
                .definition
                .as_bytes()
        );
        // The file alone is a bag, too.
        assert_eq!(
            BagReader::open(&file(&bag)).unwrap().messages().count(),
            2750
        );
    }
}

#[test]
fn a_topic_and_a_span_of_time_are_found_without_the_rest() {
    let (_folder, bag) = folder();
    write(&bag, 5000, Compression::default());
    let reader = BagReader::open(&bag).unwrap();
    let (from, until) = (Duration::from_millis(2345), Duration::from_millis(2355));
    let found = |topics: &[&str]| -> Vec<u128> {
        let messages = reader
            .messages_between(topics, from, until)
            .map(Result::unwrap);
        messages
            .map(|message| message.log_time.as_millis())
            .collect()
    };
    assert_eq!(found(&["/chatter"]), (2345..2355).collect::<Vec<_>>());
    assert_eq!(found(&["/clock"]), [2350]);
    assert_eq!(found(&[]).len(), 11);
    assert_eq!(found(&["/other"]).len(), 0);
    let last = |topic: &str, milliseconds: u64| {
        let message = reader.last_before(topic, Duration::from_millis(milliseconds));
        message.unwrap().map(|message| message.log_time.as_millis())
    };
    assert_eq!(last("/clock", 2355), Some(2350));
    assert_eq!(last("/clock", 2350), Some(2340));
    assert_eq!(last("/chatter", 1_000_000), Some(4999));
    assert_eq!(last("/chatter", 0), None);
    assert_eq!(last("/other", 2355), None);
}

/// A copy of a bag of tests/data, its `metadata.yaml` altered.
fn altered_copy(name: &str, alter: impl Fn(String) -> String) -> (TempDir, PathBuf) {
    let (folder, copy) = folder();
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data");
    std::fs::create_dir(&copy).unwrap();
    for file in std::fs::read_dir(data.join(name)).unwrap() {
        let file = file.unwrap();
        std::fs::copy(file.path(), copy.join(file.file_name())).unwrap();
    }
    let metadata = copy.join("metadata.yaml");
    let text = alter(std::fs::read_to_string(&metadata).unwrap());
    std::fs::write(&metadata, text).unwrap();
    (folder, copy)
}

#[test]
fn an_empty_storage_identifier_is_read_by_the_kind_of_the_files_and_remarked() {
    for (name, said, storage) in [
        ("rosbags_sqlite", "storage_identifier: sqlite3", "sqlite3"),
        ("rosbags_plain", "storage_identifier: mcap", "mcap"),
    ] {
        let empty = |text: String| {
            assert!(text.contains(said));
            text.replace(said, "storage_identifier: \"\"")
        };
        let (_folder, bag) = altered_copy(name, empty);
        let info = bags::BagInfo::read(&bag).unwrap();
        assert_eq!((info.messages, info.files[0].storage), (6, storage));
        let verification = bags::verify(&bag).unwrap();
        assert!(verification.whole, "{:?}", verification.findings);
        assert_eq!(verification.remarks.len(), 1);
        assert!(verification.remarks[0].contains("storage_identifier"));
        let (_folder, other) =
            altered_copy(name, |text| text.replace(said, "storage_identifier: tar"));
        let refusal = bags::BagInfo::read(&other).unwrap_err().to_string();
        assert!(refusal.contains("\"tar\""), "{refusal}");
    }
}

#[test]
fn a_topic_without_messages_is_listed_with_none() {
    // In metadata.yaml alone, as where nothing was ever published.
    let silent = "  topics_with_message_count:\n  - topic_metadata:\n      name: /silent\n      \
        type: std_msgs/msg/String\n      serialization_format: cdr\n      offered_qos_profiles: []\n      \
        type_description_hash: ''\n    message_count: 0\n";
    for name in ["rosbags_sqlite", "rosbags_plain"] {
        let (_folder, bag) = altered_copy(name, |text| {
            let key = "  topics_with_message_count:\n";
            assert!(text.contains(key), "{text}");
            text.replace(key, silent)
        });
        is_listed_with_none(&bag, "/silent");
    }
    // In the database too, as rosbag2 writes it.
    let (_folder, bag) = altered_copy("rosbags_sqlite", |text| text);
    let database = rusqlite::Connection::open(bag.join("rosbags_sqlite.db3")).unwrap();
    database
        .execute(
            "INSERT INTO topics (id, name, type, serialization_format, offered_qos_profiles, type_description_hash) \
             VALUES (77, '/silent', 'std_msgs/msg/String', 'cdr', '', '')",
            [],
        )
        .unwrap();
    drop(database);
    is_listed_with_none(&bag, "/silent");
}

fn is_listed_with_none(bag: &Path, topic: &str) {
    let info = bags::BagInfo::read(bag).unwrap();
    let listed = info.topics.iter().find(|listed| listed.name == topic);
    let listed = listed.unwrap_or_else(|| panic!("{topic} is not listed"));
    assert_eq!(
        (listed.messages, listed.type_name.as_str()),
        (0, "std_msgs/msg/String")
    );
    let verification = bags::verify(bag).unwrap();
    assert!(verification.whole, "{:?}", verification.findings);
    let mut topics = verification.topics.iter();
    let verified = topics.find(|verified| verified.name == topic).unwrap();
    assert_eq!(
        (verified.messages, verified.type_name.as_str()),
        (0, "std_msgs/msg/String")
    );
}

#[test]
fn bags_of_another_program_are_read() {
    for name in [
        "rosbags_plain",
        "rosbags_zstd",
        "rosbags_sqlite",
        "rosbags_sqlite_file",
        "rosbags_sqlite_message",
    ] {
        let bag = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("tests/data")
            .join(name);
        let reader = BagReader::open(&bag).unwrap();
        let messages: Vec<RawMessage> = reader.messages().map(Result::unwrap).collect();
        for (index, message) in messages[..5].iter().enumerate() {
            assert_eq!(
                message.decode::<std_msgs::String>().unwrap(),
                text(format!("text {index}"))
            );
            assert_eq!(message.log_time, Duration::new(1, index as u32));
        }
        let image: sensor_msgs::Image = messages[5].decode().unwrap();
        assert_eq!(
            (image.height, image.width, image.data.as_slice()),
            (2, 3, [0, 1, 2, 3, 4, 5].as_slice())
        );
        assert_eq!(messages.len(), 6);
        let hash = &reader.topics()[0].type_hash;
        let expected = description("std_msgs/msg/String").unwrap().type_hash;
        assert!(hash == expected || (hash.is_empty() && !name.contains("sqlite")));
        // Topics and spans of time are found there as in bags of ours.
        let (from, until) = (Duration::new(1, 2), Duration::new(1, 4));
        let found = reader.messages_between(&["/chatter"], from, until);
        let times: Vec<u32> = found
            .map(|message| message.unwrap().log_time.subsec_nanos())
            .collect();
        assert_eq!(times, [2, 3], "{name}");
        let last = reader.last_before("/chatter", until).unwrap().unwrap();
        assert_eq!(last.data, messages[3].data, "{name}");
        let folder = TempDir::new().unwrap();
        let copy = folder.path().join("copy");
        // Whatever was compressed, how, and by whom: the copy holds the messages as they were before.
        let verification = bags::verify(&bag).unwrap();
        assert!(verification.whole, "{name}: {:?}", verification.findings);
        let recovery = bags::recover(&bag, &copy, Compression::None).unwrap();
        assert_eq!((recovery.messages, recovery.complete), (6, true), "{name}");
        let data = |messages: &[RawMessage]| -> Vec<Vec<u8>> {
            messages
                .iter()
                .map(|message| message.data.clone())
                .collect()
        };
        let copied = BagReader::open(&copy).unwrap();
        let copied: Vec<RawMessage> = copied.messages().map(Result::unwrap).collect();
        assert_eq!(data(&copied), data(&messages), "{name}");
    }
}

/// A file as rosbag2 compresses it: one frame of zstd.
fn compress(file: &Path) {
    let packed = zstd::encode_all(std::fs::File::open(file).unwrap(), 3).unwrap();
    let mut name = file.as_os_str().to_owned();
    name.push(".zstd");
    std::fs::write(name, packed).unwrap();
}

#[test]
fn a_file_compressed_as_a_whole_is_verified_and_saved_up_to_its_damage() {
    let (folder, bag) = folder();
    write(&bag, 20_000, Compression::None);
    let plain = file(&bag);
    compress(&plain);
    let packed = bag.join("run_0.mcap.zstd");
    // Its recorder was killed before it removed the file itself: the messages count once.
    let metadata = std::fs::read_to_string(bag.join("metadata.yaml")).unwrap();
    assert!(bags::verify(&bag).unwrap().whole);
    std::fs::remove_file(&plain).unwrap();
    std::fs::write(
        bag.join("metadata.yaml"),
        metadata
            .replace("run_0.mcap", "run_0.mcap.zstd")
            .replace("compression_format: ''", "compression_format: zstd")
            .replace("compression_mode: ''", "compression_mode: FILE"),
    )
    .unwrap();
    let verification = bags::verify(&bag).unwrap();
    assert!(verification.whole, "{:?}", verification.findings);
    assert_eq!(verification.files[0].name, "run_0.mcap.zstd");
    assert_eq!(BagReader::open(&bag).unwrap().messages().count(), 22_000);

    let mut bytes = std::fs::read(&packed).unwrap();
    bytes.truncate(bytes.len() / 2);
    std::fs::write(&packed, &bytes).unwrap();
    let verification = bags::verify(&bag).unwrap();
    assert!(!verification.whole);
    let first = &verification.findings.first[0];
    assert_eq!(first.file, "run_0.mcap.zstd");
    assert!(
        first.reason.starts_with("cannot be uncompressed"),
        "{first:?}"
    );
    let error = BagReader::open(&bag).err().unwrap();
    assert!(matches!(error, BagError::Damaged { .. }), "{error}");
    // Also without the metadata, as its recorder leaves it when it is killed.
    std::fs::remove_file(bag.join("metadata.yaml")).unwrap();
    let copy = folder.path().join("copy");
    let recovery = bags::recover(&bag, &copy, Compression::None).unwrap();
    assert!(!recovery.complete);
    assert!(
        (1_000..22_000).contains(&recovery.messages),
        "{}",
        recovery.messages
    );
    let reader = BagReader::open(&copy).unwrap();
    let texts = reader.messages().map(Result::unwrap);
    let texts = texts.filter(|message| message.topic.name == "/chatter");
    for (index, message) in texts.enumerate() {
        let said: std_msgs::String = message.decode().unwrap();
        assert_eq!(said.data, index.to_string());
    }
}

#[test]
fn a_damaged_message_among_compressed_ones_is_told_and_left_out() {
    let (folder, bag) = folder();
    let mut writer = BagWriter::create(&bag, Compression::None).unwrap();
    let topic = writer
        .add::<std_msgs::String>("/chatter", Qos::RELIABLE)
        .unwrap();
    for index in 0..10u64 {
        let cdr = msgs::to_cdr(&text(format!("{index}"))).unwrap();
        let mut packed = zstd::encode_all(cdr.as_slice(), 3).unwrap();
        if index == 4 {
            packed.truncate(packed.len() - 3);
        }
        let time = Duration::from_millis(index);
        writer.write_cdr(topic, time, time, &packed).unwrap();
    }
    writer.finish().unwrap();
    // Nobody says that they are compressed: what they begin with does.
    let verification = bags::verify(&bag).unwrap();
    assert_eq!(verification.findings.count, 1);
    let reason = &verification.findings.first[0].reason;
    assert!(
        reason.contains("/chatter that cannot be uncompressed"),
        "{reason}"
    );
    let copy = folder.path().join("copy");
    let recovery = bags::recover(&bag, &copy, Compression::None).unwrap();
    assert_eq!((recovery.messages, recovery.complete), (9, false));
    let reader = BagReader::open(&copy).unwrap();
    let said = reader.messages().map(|message| {
        let said: std_msgs::String = message.unwrap().decode().unwrap();
        said.data
    });
    let said: Vec<String> = said.collect();
    assert_eq!(said, ["0", "1", "2", "3", "5", "6", "7", "8", "9"]);
}

#[test]
fn files_without_chunks_or_index_and_with_lz4_are_read() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("other.mcap");
    let options = || mcap::WriteOptions::new().profile("ros2");
    for (options, indexed) in [
        (options().use_chunks(false), false),
        (options().compression(Some(mcap::Compression::Lz4)), true),
        (
            options()
                .emit_chunk_indexes(false)
                .emit_message_indexes(false)
                .emit_statistics(false)
                .repeat_channels(false)
                .repeat_schemas(false)
                .calculate_chunk_crcs(false)
                // The mcap crate gets it wrong without checksums of the chunks.
                .calculate_data_section_crc(false),
            false,
        ),
    ] {
        let file = std::io::BufWriter::new(std::fs::File::create(&path).unwrap());
        let mut writer = options.create(file).unwrap();
        let schema = writer
            .add_schema("other_msgs/msg/Other", "ros2msg", b"uint8 a")
            .unwrap();
        let channel = writer
            .add_channel(schema, "/other", "cdr", &Default::default())
            .unwrap();
        for time in 0..10u64 {
            let header = mcap::records::MessageHeader {
                channel_id: channel,
                sequence: 0,
                log_time: time,
                publish_time: time,
            };
            writer
                .write_to_known_channel(&header, &[0, 1, 0, 0, time as u8])
                .unwrap();
        }
        writer.finish().unwrap();
        drop(writer);
        let reader = BagReader::open(&path).unwrap();
        let last = |message: Result<RawMessage, BagError>| message.unwrap().data[4];
        assert!(reader.messages().map(last).eq(0..10));
        let (from, until) = (Duration::from_nanos(3), Duration::from_nanos(6));
        let found = reader.messages_between(&["/other"], from, until);
        assert!(found.map(last).eq(3..6), "indexed: {indexed}");
        assert_eq!(
            reader.messages().next().unwrap().unwrap().topic.type_name,
            "other_msgs/msg/Other"
        );
        assert!(bags::verify(&path).unwrap().whole);
    }
}

#[test]
fn an_empty_bag_is_a_bag() {
    let (_folder, bag) = folder();
    write(&bag, 0, Compression::default());
    let reader = BagReader::open(&bag).unwrap();
    assert_eq!(reader.messages().count(), 0);
    assert_eq!(reader.span(), None);
}

#[test]
fn types_unknown_to_this_program_are_carried() {
    let (_folder, bag) = folder();
    let mut writer = BagWriter::create(&bag, Compression::default()).unwrap();
    let topic = writer
        .add_raw_topic("/other", "other_msgs/msg/Other", "uint8 a\n", "", &[])
        .unwrap();
    writer
        .write_cdr(
            topic,
            Duration::from_nanos(7),
            Duration::from_nanos(5),
            &[0, 1, 0, 0, 42],
        )
        .unwrap();
    writer.finish().unwrap();
    let reader = BagReader::open(&bag).unwrap();
    let message = reader.messages().next().unwrap().unwrap();
    assert_eq!(message.data, [0, 1, 0, 0, 42]);
    assert_eq!(
        (message.log_time.as_nanos(), message.publish_time.as_nanos()),
        (7, 5)
    );
    assert_eq!(message.topic.definition, b"uint8 a\n");
    let error = message
        .decode::<std_msgs::String>()
        .unwrap_err()
        .to_string();
    assert_eq!(
        error,
        "topic /other holds other_msgs/msg/Other, expected std_msgs/msg/String"
    );
}

#[test]
fn a_type_that_has_changed_since_is_refused() {
    let (_folder, bag) = folder();
    let mut writer = BagWriter::create(&bag, Compression::default()).unwrap();
    let topic = writer
        .add_raw_topic(
            "/a",
            "std_msgs/msg/String",
            "string text\n",
            "RIHS01_00",
            &[],
        )
        .unwrap();
    writer
        .write_cdr(
            topic,
            Duration::ZERO,
            Duration::ZERO,
            &msgs::to_cdr(&text("a")).unwrap(),
        )
        .unwrap();
    writer.finish().unwrap();
    let message = BagReader::open(&bag)
        .unwrap()
        .messages()
        .next()
        .unwrap()
        .unwrap();
    assert!(matches!(
        message.decode::<std_msgs::String>(),
        Err(BagError::Definition { .. })
    ));
}

#[test]
fn a_topic_has_one_type() {
    let (_folder, bag) = folder();
    let mut writer = BagWriter::create(&bag, Compression::default()).unwrap();
    let topic = writer.add::<std_msgs::String>("/a", Qos::RELIABLE).unwrap();
    assert_eq!(
        writer.add::<std_msgs::String>("/a", Qos::RELIABLE).unwrap(),
        topic
    );
    let error = writer
        .add::<std_msgs::Bool>("/a", Qos::RELIABLE)
        .unwrap_err()
        .to_string();
    assert_eq!(
        error,
        "topic /a is written as std_msgs/msg/String already, expected std_msgs/msg/Bool"
    );
    assert!(matches!(
        writer.write(topic, Duration::ZERO, &std_msgs::Bool::default()),
        Err(BagError::Type { .. })
    ));
}

#[test]
fn a_bag_is_never_overwritten_and_a_half_written_one_is_noticed() {
    let (_folder, bag) = folder();
    let mut writer = BagWriter::create(&bag, Compression::default()).unwrap();
    let topic = writer.add::<std_msgs::String>("/a", Qos::RELIABLE).unwrap();
    writer.write(topic, Duration::ZERO, &text("a")).unwrap();
    writer.flush().unwrap();
    assert!(!bag.exists(), "only a finished bag has its name");
    // As if the process had been killed: neither finish nor drop.
    std::mem::forget(writer);
    assert!(matches!(
        BagWriter::create(&bag, Compression::default()),
        Err(BagError::HalfWritten { .. })
    ));
    assert!(matches!(BagReader::open(&bag), Err(BagError::Io { .. })));
    let partial = partial_path(&bag);
    assert!(matches!(
        BagReader::open(&partial),
        Err(BagError::NotABag { .. })
    ));
    assert!(matches!(
        BagReader::open(&file(&partial)),
        Err(BagError::Truncated { .. })
    ));
    assert!(BagWriter::discard_partial(&bag).unwrap());
    assert!(!BagWriter::discard_partial(&bag).unwrap());
    write(&bag, 1, Compression::default());
    assert!(matches!(
        BagWriter::create(&bag, Compression::default()),
        Err(BagError::Exists { .. })
    ));
}

#[test]
fn everything_up_to_the_last_flush_is_in_the_file_of_a_killed_writer() {
    let (_folder, bag) = folder();
    let mut writer = BagWriter::create(&bag, Compression::default()).unwrap();
    let topic = writer.add::<std_msgs::String>("/a", Qos::RELIABLE).unwrap();
    for step in 0..3 {
        writer
            .write(topic, Duration::from_secs(step), &text("a".repeat(1000)))
            .unwrap();
        writer.sync().unwrap();
    }
    writer
        .write(topic, Duration::from_secs(3), &text("not flushed"))
        .unwrap();
    std::mem::forget(writer);
    let bytes = std::fs::read(file(&partial_path(&bag))).unwrap();
    let options = mcap::read::Options::IgnoreEndMagic.into();
    let messages = mcap::MessageStream::new_with_options(&bytes, options).unwrap();
    assert_eq!(messages.take_while(Result::is_ok).count(), 3);
}

#[test]
fn what_is_no_bag_says_why() {
    let (folder, bag) = folder();
    let refusal = |path: &Path| BagReader::open(path).err().unwrap().to_string();
    assert!(refusal(&bag).contains("run: No such file"));
    std::fs::create_dir(&bag).unwrap();
    assert!(refusal(&bag).ends_with(
        "not a bag: metadata.yaml is missing, expected a finished bag; try sctn bag recover"
    ));
    std::fs::write(bag.join("metadata.yaml"), "rosbag2_bagfile_information: 3").unwrap();
    assert!(refusal(&bag).contains("not a bag: metadata.yaml: "));
    let other = folder.path().join("other.mcap");
    std::fs::write(&other, "hello").unwrap();
    assert!(refusal(&other).ends_with("not a bag: the file does not begin as an MCAP file"));
    std::fs::write(&other, "something longer that is no MCAP file").unwrap();
    assert!(refusal(&other).ends_with("not a bag: the file does not begin as an MCAP file"));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn a_cut_file_is_refused(cut: prop::sample::Index) {
        let (_folder, bag) = folder();
        write(&bag, 50, Compression::default());
        let bytes = std::fs::read(file(&bag)).unwrap();
        std::fs::write(file(&bag), &bytes[..cut.index(bytes.len())]).unwrap();
        let error = BagReader::open(&bag).err().expect("a cut file was opened");
        let told = matches!(error, BagError::Truncated { .. } | BagError::NotABag { .. });
        prop_assert!(told, "{error}");
    }

    #[test]
    fn a_flipped_bit_never_changes_a_message_silently(at: prop::sample::Index, bit in 0u8..8) {
        let (_folder, bag) = folder();
        write(&bag, 50, Compression::default());
        let mut bytes = std::fs::read(file(&bag)).unwrap();
        let at = at.index(bytes.len());
        bytes[at] ^= 1 << bit;
        let read = |bag: &Path| -> Result<Vec<(String, Duration, Vec<u8>)>, BagError> {
            let reader = BagReader::open(bag)?;
            let messages = reader.messages();
            messages.map(|message| message.map(|message| (message.topic.name.clone(), message.log_time, message.data))).collect()
        };
        let before = read(&bag).unwrap();
        std::fs::write(file(&bag), bytes).unwrap();
        if let Ok(after) = read(&bag) {
            prop_assert_eq!(before, after, "byte {}", at);
        }
    }
}
