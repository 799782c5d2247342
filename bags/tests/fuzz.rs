//! Mangled bags of every kind, for as long as BAGS_FUZZ_SECONDS says [default: 10]: whatever stands in a file, reading, verifying and
//! recovering end with an answer. Mutations are drawn at random; a failure names its seed. The same under the guidance of
//! coverage: `bags/fuzz`.

mod mangled;

use mangled::{answer, corpus};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::path::Path;
use std::time::{Duration, Instant};
use tempfile::TempDir;

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
        let outcome = std::panic::catch_unwind(|| answer(path));
        let Ok(is_whole) = outcome else {
            panic!("seed {rounds}, {}: see above", path.display());
        };
        whole += u64::from(is_whole);
        rounds += 1;
    }
    assert!(whole >= corpus.len() as u64, "the sound ones are whole");
    println!("{rounds} files, {whole} of them whole");
}
