//! The change test that policy and executor make on each heightmap.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use heightmap::{ChangeRules, Heightmap, Workspace, largest_change};
use nalgebra::Point2;

/// A table with noise of a millimetre, of a kind of its own for each seed.
fn table(seed: usize) -> Heightmap {
    let mut heightmap = Heightmap::new(Workspace::RAVENS);
    heightmap.rgb.fill(100);
    for (index, height_m) in heightmap.height_m.iter_mut().enumerate() {
        let noise = (index + 1).wrapping_mul(seed).wrapping_mul(2_654_435_761) >> 16 & 0xff;
        *height_m = noise as f32 * 4e-6;
    }
    heightmap
}

fn change(criterion: &mut Criterion) {
    let (source, latest) = (table(1), table(2));
    let around = [Point2::new(0.5, 0.2), Point2::new(0.5, -0.2)];
    let rules = ChangeRules::default();
    assert_eq!(largest_change(&source, &latest, &rules, &around), Ok(None));
    criterion.bench_function("largest_change 320 x 160", |bencher| {
        bencher.iter(|| largest_change(black_box(&source), black_box(&latest), &rules, &around))
    });
}

criterion_group!(benches, change);
criterion_main!(benches);
