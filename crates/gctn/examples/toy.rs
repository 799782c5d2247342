//! Learns the toy (blocks of which the goal shows one elsewhere), and says how well and how fast:
//! `cargo run --release -p gctn --example toy -- [STEPS] [bf16]`.

#[path = "../tests/toy/mod.rs"]
mod toy;

use gctn::{NetworkConfig, Precision, Trainer, TrainingConfig};
use std::time::Instant;
use toy::Toy;

fn main() -> Result<(), gctn::Error> {
    let steps = std::env::args()
        .nth(1)
        .and_then(|steps| steps.parse().ok())
        .unwrap_or(500);
    let bf16 = std::env::args()
        .nth(2)
        .is_some_and(|precision| precision == "bf16");
    let training = TrainingConfig {
        steps,
        precision: if bf16 {
            Precision::Bf16
        } else {
            Precision::F32
        },
        ..TrainingConfig::compact()
    };
    let scenes: Vec<Toy> = (0..400).map(|seed| Toy::new(seed, 36)).collect();
    let held_out: Vec<Toy> = (10_000..10_050).map(|seed| Toy::new(seed, 36)).collect();
    let mut trainer = Trainer::new(&NetworkConfig::compact(), &training)?;
    println!("{} weights", trainer.parameters());

    let started = Instant::now();
    let (mut pick, mut place) = (0.0, 0.0);
    const REPORT: u64 = 50;
    for step in 0..steps {
        let batch = training.batch;
        let samples: Vec<_> = (0..batch)
            .map(|index| scenes[(step as usize * batch + index) % scenes.len()].sample())
            .collect();
        let losses = trainer.train_step(&samples)?;
        (pick, place) = (pick + losses.pick, place + losses.place);
        if (step + 1) % REPORT == 0 {
            let seconds = started.elapsed().as_secs_f64();
            println!(
                "step {:5}: pick {:.3}, place {:.3} nats; {seconds:.1} s, {:.1} ms a sample",
                step + 1,
                pick / REPORT as f64,
                place / REPORT as f64,
                1e3 * seconds / ((step + 1) as f64 * batch as f64),
            );
            (pick, place) = (0.0, 0.0);
        }
    }

    let policy = trainer.policy()?;
    let started = Instant::now();
    let mut errors = Vec::new();
    for scene in &held_out {
        let decision = policy.decide(&scene.observation, &scene.goal, &[])?;
        errors.push(scene.error(&decision));
    }
    let seconds = started.elapsed().as_secs_f64();
    let near = |limit_m: f64| {
        let good =
            |error: &&Option<(f64, f64)>| error.is_some_and(|(m, rad)| m < limit_m && rad < 0.26);
        errors.iter().filter(good).count()
    };
    let mut distances: Vec<_> = errors.iter().flatten().map(|(m, _)| *m).collect();
    distances.sort_by(f64::total_cmp);
    let turned = errors
        .iter()
        .flatten()
        .filter(|(_, rad)| *rad < 0.09)
        .count();
    println!(
        "{} scenes: picked {}, turned right {turned}, placed within 10 mm {}, within 5 mm {}; median {:.1} mm; {:.1} ms a decision",
        errors.len(),
        distances.len(),
        near(0.010),
        near(0.005),
        distances
            .get(distances.len() / 2)
            .map_or(f64::NAN, |m| 1e3 * m),
        1e3 * seconds / errors.len() as f64,
    );
    Ok(())
}
