//! Writing and reading a demonstration of nine steps at full size.

use bags::{BagWriter, Compression, Demonstration, DemonstrationStep, Qos};
use criterion::{BatchSize, Criterion, Throughput, criterion_group, criterion_main};
use heightmap::{Heightmap, Workspace};
use nalgebra::Isometry2;
use pick_place::{Outcome, PickPlace, PrimitiveSettings};
use std::time::Duration;
use tempfile::TempDir;

/// A table with a disk that moves from step to step.
fn observation(step: usize) -> Heightmap {
    let mut heightmap = Heightmap::new(Workspace::RAVENS);
    let cols = heightmap.workspace.cols;
    for (index, (rgb, height_m)) in heightmap
        .rgb
        .as_chunks_mut::<3>()
        .0
        .iter_mut()
        .zip(&mut heightmap.height_m)
        .enumerate()
    {
        let (row, col) = ((index / cols) as f32, (index % cols) as f32);
        let off = (row - 30.0 * step as f32 - 20.0).hypot(col - 80.0);
        (*rgb, *height_m) = if off < 12.0 {
            ([200, 30, 30], 0.02)
        } else {
            ([160, 150, 140], 0.001 * (row * 0.1).sin())
        };
    }
    heightmap
}

fn demonstration() -> Demonstration {
    let pose = Isometry2::translation(0.5, 0.0);
    let settings = PrimitiveSettings {
        clearance_m: 0.1,
        lift_m: 0.05,
        travel_m_s: 1.0,
        carry_m_s: 0.5,
        descend_m_s: 0.2,
        acceleration_m_s2: 4.0,
    };
    let step = |index| DemonstrationStep {
        observation: observation(index),
        action: PickPlace {
            pick: pose,
            place: pose,
        },
        settings,
        module: "placing".into(),
        delta_reward: 1.0 / 9.0,
        outcome: Outcome::Placed,
    };
    Demonstration {
        problem: "placing".into(),
        seed: 0,
        start_seed: 0,
        steps: (0..9).map(step).collect(),
        last: observation(9),
    }
}

fn demonstrations(criterion: &mut Criterion) {
    let demonstration = demonstration();
    let folder = || TempDir::new().expect("a temporary folder");
    let mut group = criterion.benchmark_group("demonstration_9_steps");
    group.bench_function("write", |bencher| {
        bencher.iter_batched(
            folder,
            |folder| demonstration.write(&folder.path().join("000000")),
            BatchSize::PerIteration,
        )
    });
    let kept = folder();
    let path = kept.path().join("000000");
    demonstration.write(&path).expect("a bag");
    group.bench_function("read", |bencher| {
        bencher.iter(|| Demonstration::read(&path).expect("a demonstration"))
    });
    group.finish();
}

/// 100 messages of 1 MB that do not compress, without compression, up to `sync`.
fn raw(criterion: &mut Criterion) {
    let message: Vec<u8> = (0..1_000_000u32)
        .map(|index| (index.wrapping_mul(2_654_435_761) >> 13) as u8)
        .collect();
    let mut group = criterion.benchmark_group("raw_100_mb");
    group
        .throughput(Throughput::Bytes(100_000_000))
        .sample_size(10);
    group.bench_function("write", |bencher| {
        bencher.iter_batched(
            || TempDir::new().expect("a temporary folder"),
            |folder| {
                let mut bag = BagWriter::create(&folder.path().join("raw"), Compression::None)
                    .expect("a bag");
                let topic = bag
                    .add::<msgs::sensor_msgs::Image>("/image", Qos::BEST_EFFORT)
                    .expect("a topic");
                for index in 0..100 {
                    let time = Duration::from_millis(index);
                    bag.write_cdr(topic, time, time, &message).expect("room");
                }
                bag.sync().expect("room");
                folder
            },
            BatchSize::PerIteration,
        )
    });
    group.finish();
}

criterion_group!(benches, demonstrations, raw);
criterion_main!(benches);
