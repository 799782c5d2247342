//! What decisions and training samples cost in processor time, and what comes out of them: to compare builds of two commits, run in turn.
//!
//! `costs decide|decide-bf16 CHECKPOINT REPEAT FOLDER...`: decides each step of the demonstrations in the folders, so many times, shown
//! the demonstration of its scene that began from another start where there is one. Prints one line for each decision, then the
//! mean processor time of one.
//!
//! `costs train compact|matching STEPS FOLDER...`: so many gradient steps of 4 samples of the same steps, in bf16, where the processor
//! has it. Prints the losses of each, then the mean processor time of a sample.

use bags::Demonstration;
use cpu_time::ProcessTime;
use gctn::{
    Augmentation, Device, Goal, GoalConditioning, Interpolation, Matching, Network, NetworkConfig,
    Policy, Precision, Sample, SensorNoise, Trainer, TrainingConfig,
};
use learning::goal;
use std::error::Error;
use std::path::{Path, PathBuf};

/// All demonstrations that lie in folders, in the order of their names.
fn demonstrations(folders: &[String]) -> Result<Vec<Demonstration>, Box<dyn Error>> {
    let mut all = Vec::new();
    for folder in folders {
        let entries = std::fs::read_dir(folder).map_err(|error| format!("{folder}: {error}"))?;
        let mut paths: Vec<PathBuf> = entries
            .map(|entry| entry.map(|entry| entry.path()))
            .collect::<Result<_, _>>()?;
        paths.sort();
        for path in paths {
            all.push(Demonstration::read(&path)?);
        }
    }
    Ok(all)
}

/// The steps of demonstrations, each with what it is shown.
fn samples(all: &[Demonstration], conditioning: GoalConditioning) -> Vec<Sample<'_>> {
    let mut samples = Vec::new();
    for one in all {
        let of_its_scene = |other: &&Demonstration| {
            other.problem == one.problem
                && other.seed == one.seed
                && other.start_seed != one.start_seed
        };
        let shown = match conditioning {
            GoalConditioning::Sequence => all.iter().find(of_its_scene).unwrap_or(one),
            _ => one,
        };
        let goals = shown.goals();
        let mut reached = 0;
        for step in &one.steps {
            let Some(goal): Option<Goal<'_>> =
                goal(shown.observation(0), &goals, reached, conditioning)
            else {
                continue;
            };
            reached += usize::from(step.delta_reward > 0.0);
            samples.push(Sample {
                observation: &step.observation,
                goal,
                pick: step.action.pick,
                place: step.action.place,
                done: false,
            });
        }
    }
    samples
}

fn decide(
    checkpoint: &str,
    precision: Precision,
    repeat: u32,
    folders: &[String],
) -> Result<(), Box<dyn Error>> {
    let policy = Policy::load_for(Path::new(checkpoint), Device::Cpu, precision)?;
    let all = demonstrations(folders)?;
    let samples = samples(&all, policy.config().conditioning);
    let mut lines = Vec::new();
    for sample in &samples {
        lines.push(policy.decide(sample.observation, sample.goal, &[])?);
    }
    let begun = ProcessTime::now();
    for _ in 0..repeat {
        for sample in &samples {
            policy.decide(sample.observation, sample.goal, &[])?;
        }
    }
    let spent = begun.elapsed().as_secs_f64();
    for decision in lines {
        let [pick, place] = [decision.pick, decision.place].map(|pose| {
            let position = pose.translation.vector;
            [position.x, position.y, pose.rotation.angle()]
        });
        let numbers = (
            pick,
            place,
            decision.pick_score,
            decision.place_score,
            decision.done,
            decision.success,
        );
        println!("{}", serde_json::to_string(&numbers)?);
    }
    let count = f64::from(repeat) * samples.len() as f64;
    eprintln!(
        "{} decisions, {:.2} ms each",
        count,
        1e3 * spent / count.max(1.0)
    );
    Ok(())
}

fn train(network: &str, steps: usize, folders: &[String]) -> Result<(), Box<dyn Error>> {
    let mut training = TrainingConfig {
        precision: Precision::Bf16,
        ..TrainingConfig::compact()
    };
    let network = match network {
        "compact" => NetworkConfig::compact(),
        "matching" => {
            // As in config/recipes/any_start_8_turns.yaml.
            training.augmentation = Augmentation {
                hue_probability: 0.3,
                permutation_probability: 0.3,
                mirror_probability: 0.5,
                interpolation: Interpolation::Nearest,
                sensor: SensorNoise {
                    gain_sigma: 0.04,
                    tint_sigma: 0.03,
                    color_noise: 4.0,
                    height_noise_m: 0.002,
                    height_offset_sigma_m: 0.0005,
                    hole_share: 0.0,
                },
                ..Augmentation::default()
            };
            let matching = Matching {
                candidates: 8,
                shape_weight: 80.0,
                pick_shape_weight: 20.0,
                fine_shapes: true,
                ..Matching::default()
            };
            NetworkConfig {
                network: Network::Matching(matching),
                ..NetworkConfig::matching()
            }
        }
        other => return Err(format!("network {other}: expected compact or matching").into()),
    };
    let mut trainer = Trainer::new(&network, &training)?;
    let all = demonstrations(folders)?;
    let samples = samples(&all, network.conditioning);
    let mut order = (0..samples.len()).cycle().map(|index| {
        // Spread over the demonstrations.
        samples[index * 7919 % samples.len()]
    });
    let mut begun = ProcessTime::now();
    for step in 0..=steps {
        let batch: Vec<Sample<'_>> = order.by_ref().take(training.batch).collect();
        let losses = trainer.train_step(&batch)?;
        println!("{losses:?}");
        if step == 0 {
            begun = ProcessTime::now();
        }
    }
    let count = steps * training.batch;
    let spent = begun.elapsed().as_secs_f64();
    eprintln!(
        "{count} samples, {:.2} ms each",
        1e3 * spent / count.max(1) as f64
    );
    Ok(())
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match &*arguments {
        [command, what, number, folders @ ..] if !folders.is_empty() => {
            gctn::set_threads(1);
            match &**command {
                "decide" => return decide(what, Precision::F32, number.parse()?, folders),
                "decide-bf16" => return decide(what, Precision::Bf16, number.parse()?, folders),
                "train" => return train(what, number.parse()?, folders),
                _ => {}
            }
        }
        _ => {}
    }
    Err(
        "expected: costs decide CHECKPOINT REPEAT FOLDER... or costs train NETWORK STEPS FOLDER..."
            .into(),
    )
}
