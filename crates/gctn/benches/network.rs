//! Decisions and training samples: `cargo bench -p gctn --bench network`.

use criterion::{Criterion, criterion_group, criterion_main};
use gctn::{Goal, NetworkConfig, Sample, Trainer, TrainingConfig};
use heightmap::{Heightmap, Workspace};
use nalgebra::{Isometry2, Vector2};

fn heightmap(seed: usize) -> Heightmap {
    let mut heightmap = Heightmap::new(Workspace::RAVENS);
    for (index, byte) in heightmap.rgb.iter_mut().enumerate() {
        *byte = ((index + seed) * 31 % 251) as u8;
    }
    heightmap
}

fn networks(criterion: &mut Criterion) {
    let [observation, previous, goal] = [1, 3, 2].map(heightmap);
    let sample = Sample {
        observation: &observation,
        goal: Goal::step(&previous, &goal),
        pick: Isometry2::new(Vector2::new(0.5, 0.1), 0.0),
        place: Isometry2::new(Vector2::new(0.4, -0.2), 1.0),
        done: false,
    };
    let compact = (NetworkConfig::compact(), TrainingConfig::compact());
    let published = (NetworkConfig::resnet43(), TrainingConfig::published());
    let matching = (NetworkConfig::matching(), TrainingConfig::compact());
    let networks = [
        ("compact", compact),
        ("matching", matching),
        ("resnet43", published),
    ];
    for (name, (network, training)) in networks {
        let mut group = criterion.benchmark_group(name);
        group.sample_size(10);
        let mut trainer = Trainer::new(&network, &training).expect("the configuration is good");
        let policy = trainer.policy().expect("a copy of the weights");
        let threads = training.threads;
        group.bench_function(format!("decide, {threads} threads"), |bencher| {
            bencher.iter(|| {
                let decision = policy.decide(&observation, sample.goal, &[]);
                decision.expect("a decision")
            });
        });
        let batch = vec![sample; training.batch];
        group.bench_function(
            format!("train step of {}, {threads} threads", batch.len()),
            |bencher| {
                bencher.iter(|| trainer.train_step(&batch).expect("a step"));
            },
        );
        group.finish();
    }
}

criterion_group!(benches, networks);
criterion_main!(benches);
