//! Fuzz target: a file as the input says. libFuzzer keeps the inputs that reach new code; see the README.

#![no_main]

#[path = "../../tests/mangled/mod.rs"]
mod mangled;

use libfuzzer_sys::fuzz_target;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;
use tempfile::TempDir;

/// A file in memory where there is such a folder: each input is one.
static FOLDER: LazyLock<TempDir> = LazyLock::new(|| {
    let memory = Path::new("/dev/shm");
    let folder = match memory.is_dir() {
        true => TempDir::new_in(memory),
        false => TempDir::new(),
    };
    folder.expect("a folder for the inputs")
});

/// Its kind by what it begins with, as its name would say.
fn name(data: &[u8]) -> &'static str {
    if data.starts_with(b"SQLite") {
        "input.db3"
    } else if data.starts_with(&[0x28, 0xb5, 0x2f, 0xfd]) {
        "input.mcap.zstd"
    } else {
        "input.mcap"
    }
}

fuzz_target!(
    init: {
        // The first inputs: sound files of every kind, into a folder that is named on the command line too.
        if let Some(seeds) = std::env::var_os("BAGS_FUZZ_SEEDS").map(PathBuf::from) {
            for (path, bytes) in mangled::corpus(FOLDER.path()) {
                let name = path.file_name().unwrap_or_default();
                std::fs::write(seeds.join(name), bytes).expect("a seed");
            }
        }
    },
    |data: &[u8]| {
        let path = FOLDER.path().join(name(data));
        std::fs::write(&path, data).expect("the input as a file");
        mangled::answer(&path);
    }
);
