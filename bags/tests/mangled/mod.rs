//! What a mangled file is made from, and what has to be true of one. Shared by the random mutations of `../fuzz.rs` and by the
//! fuzz target that coverage guides (`bags/fuzz`).

use bags::{BagReader, Compression, recover, verify};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Files of all layouts that the reader knows, small.
pub fn corpus(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
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
    let data = Path::new(file!()).parent().unwrap().join("../data");
    // The path is that of the compiler, which starts in the root of the repository; tests start in their crate.
    let data = [data.clone(), Path::new("..").join(data)];
    let data = data.iter().find(|folder| folder.is_dir()).unwrap();
    let sqlite = data.join("rosbags_sqlite/rosbags_sqlite.db3");
    files.push((folder.join("bag.db3"), std::fs::read(sqlite).unwrap()));
    let packed = data.join("rosbags_sqlite_file/rosbags_sqlite_file.db3.zstd");
    files.push((folder.join("bag.db3.zstd"), std::fs::read(packed).unwrap()));
    let packed = zstd::encode_all(files[1].1.as_slice(), 3).unwrap();
    files.push((folder.join("packed.mcap.zstd"), packed));
    files
}

/// Reads, verifies and recovers a file: whatever stands in it, each ends with an answer, and what is whole can be read. Whether it
/// is whole.
pub fn answer(path: &Path) -> bool {
    let copy = path.with_file_name("copy");
    let read = BagReader::open(path).map(|bag| {
        let error = bag.messages().take(10_000).find_map(Result::err);
        let (from, until) = (Duration::from_nanos(5), Duration::from_nanos(9));
        let between = bag.messages_between(&["/a"], from, until).take(10_000);
        for message in between.map_while(Result::ok) {
            assert!((from..until).contains(&message.log_time), "{message:?}");
        }
        error.map(|error| error.to_string())
    });
    let verified = verify(path).map(|verification| verification.whole);
    let recovered = recover(path, &copy, Compression::None);
    if recovered.is_ok() {
        // Whatever it was made from, a copy is whole.
        let copied = verify(&copy).unwrap();
        assert!(copied.whole, "{:?}", copied.findings);
    }
    let _ = std::fs::remove_dir_all(&copy);
    let _ = std::fs::remove_dir_all(bags::partial_path(&copy));
    let whole = verified.is_ok_and(|whole| whole);
    if whole {
        assert!(matches!(read, Ok(None)), "{read:?}");
    }
    whole
}
