//! Episodes of a problem, and what golden tests compare of them.

use multiravens::{Environment, Problem};
use std::path::Path;
use ur5::WorkCell;

/// An environment of a problem of the repository.
pub fn environment(problem: &str) -> Environment {
    let problems = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/problems");
    let problem = Problem::load(&problems, problem).unwrap();
    Environment::new(&problem, &WorkCell::builtin().unwrap())
}

/// FNV-1a over colours and height bits.
fn heightmap_hash(environment: &mut Environment) -> u64 {
    let heightmap = environment.observe().unwrap();
    let heights = heightmap
        .height_m
        .iter()
        .flat_map(|z| z.to_bits().to_le_bytes());
    let bytes = heightmap.rgb.iter().copied().chain(heights);
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}

/// Plays a demonstration; hashes of the heightmap at the start and the end, and of the last state.
pub fn demonstration(environment: &mut Environment, seed: u64) -> [u64; 3] {
    environment.reset(seed).unwrap();
    let start = heightmap_hash(environment);
    while !environment.is_done() {
        let action = environment.demonstrate().unwrap();
        environment.step(&action).unwrap();
    }
    assert!(environment.is_complete(), "seed {seed}");
    [start, heightmap_hash(environment), environment.state_hash()]
}
