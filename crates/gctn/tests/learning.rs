//! What training must do: learn, repeat, go on.

mod toy;

use gctn::{
    Augmentation, Compact, Decision, Device, Network, NetworkConfig, PlaceLoss, Precision,
    Resnet43, Sample, Storage, Trainer, TrainingConfig,
};
use heightmap::{Heightmap, Workspace};
use nalgebra::{Isometry2, Vector2};
use toy::Toy;

#[test]
fn a_toy_is_learned_in_seconds() {
    const ROTATIONS: u32 = 4;
    let network = NetworkConfig {
        rotations: ROTATIONS as usize,
        ..NetworkConfig::compact()
    };
    let training = TrainingConfig {
        steps: 80,
        warm_up_steps: 10,
        ..TrainingConfig::compact()
    };
    let scenes: Vec<Toy> = (0..60).map(|seed| Toy::new(seed, ROTATIONS)).collect();
    let mut trainer = Trainer::new(&network, &training).unwrap();
    let mut losses = Vec::new();
    for step in 0..training.steps as usize {
        let samples: Vec<_> = (0..training.batch)
            .map(|index| scenes[(step * training.batch + index) % scenes.len()].sample())
            .collect();
        let step = trainer.train_step(&samples).unwrap();
        losses.push(step.pick + step.place);
    }
    let mean = |losses: &[f64]| losses.iter().sum::<f64>() / losses.len() as f64;
    let (first, last) = (mean(&losses[..10]), mean(&losses[70..]));
    assert!(
        last < 0.5 * first,
        "the loss went from {first} to {last} nats"
    );

    let policy = trainer.policy().unwrap();
    let held_out = (10_000..10_020).map(|seed| Toy::new(seed, ROTATIONS));
    let errors: Vec<_> = held_out
        .map(|scene| scene.error(&policy.decide(&scene.observation, &scene.goal, &[]).unwrap()))
        .collect();
    let picked = errors.iter().flatten().count();
    let placed = errors
        .iter()
        .flatten()
        .filter(|(distance_m, _)| *distance_m < 0.005)
        .count();
    assert!(
        picked >= 19 && placed >= 18,
        "of 20 scenes {picked} picked and {placed} placed: {errors:?}"
    );
}

#[test]
fn a_step_shown_from_another_start_is_learned_in_seconds() {
    const ROTATIONS: u32 = 4;
    let network = NetworkConfig {
        rotations: ROTATIONS as usize,
        ..NetworkConfig::matching()
    };
    let training = TrainingConfig {
        steps: 150,
        warm_up_steps: 10,
        ..TrainingConfig::compact()
    };
    let scenes: Vec<Toy> = (0..100).map(|seed| Toy::new(seed, ROTATIONS)).collect();
    let mut trainer = Trainer::new(&network, &training).unwrap();
    for step in 0..training.steps as usize {
        let samples: Vec<_> = (0..training.batch)
            .map(|index| {
                let scene = &scenes[(step * training.batch + index) % scenes.len()];
                match index {
                    // Seen after the step: it is done.
                    0 => Sample {
                        observation: &scene.goal,
                        done: true,
                        ..scene.shown_elsewhere()
                    },
                    _ => scene.shown_elsewhere(),
                }
            })
            .collect();
        trainer.train_step(&samples).unwrap();
    }
    let policy = trainer.policy().unwrap();
    let (mut picked, mut placed) = (0, 0);
    for scene in (10_000..10_020).map(|seed| Toy::new(seed, ROTATIONS)) {
        let goal = scene.shown_elsewhere().goal;
        let decision = policy.decide(&scene.observation, goal, &[]).unwrap();
        let error = scene.error(&decision);
        picked += usize::from(error.is_some());
        placed += usize::from(error.is_some_and(|(distance_m, _)| distance_m < 0.006));
    }
    assert!(
        picked >= 17 && placed >= 15,
        "of 20 scenes {picked} picked, {placed} placed"
    );
}

/// A grid so small that a step takes milliseconds.
fn small_workspace() -> Workspace {
    Workspace {
        rows: 48,
        cols: 32,
        ..Workspace::RAVENS
    }
}

fn small(network: Network) -> NetworkConfig {
    NetworkConfig {
        rows: 48,
        cols: 32,
        rotations: 8,
        ..NetworkConfig::new(network)
    }
}

fn small_compact() -> NetworkConfig {
    small(Network::Compact(Compact {
        channels: [4, 4, 8, 8],
        window_cells: 5,
        ..Compact::default()
    }))
}

fn small_resnet43() -> NetworkConfig {
    small(Network::Resnet43(Resnet43 {
        crop_px: 16,
        ..Resnet43::default()
    }))
}

fn heightmap(seed: usize) -> Heightmap {
    let mut heightmap = Heightmap::new(small_workspace());
    for (index, byte) in heightmap.rgb.iter_mut().enumerate() {
        *byte = ((index + seed) * (31 + seed) % 251) as u8;
    }
    for (index, height_m) in heightmap.height_m.iter_mut().enumerate() {
        *height_m = ((index + seed) * 17 % 41) as f32 * 1e-3;
    }
    heightmap
}

fn sample<'a>(observation: &'a Heightmap, goal: &'a Heightmap) -> Sample<'a> {
    let corner = observation.workspace.origin_m.coords;
    Sample {
        observation,
        goal: goal.into(),
        pick: Isometry2::new(corner + Vector2::new(0.03, 0.05), 0.0),
        place: Isometry2::new(corner + Vector2::new(0.06, 0.11), 2.0),
        done: false,
    }
}

/// Trains `steps` steps and decides.
fn run(trainer: &mut Trainer, steps: usize) -> Decision {
    let (observation, goal) = (heightmap(1), heightmap(2));
    let samples = vec![sample(&observation, &goal); trainer.config().batch];
    for _ in 0..steps {
        trainer.train_step(&samples).unwrap();
    }
    let policy = trainer.policy().unwrap();
    policy.decide(&observation, &goal, &[]).unwrap()
}

fn short(seed: u64) -> TrainingConfig {
    TrainingConfig {
        seed,
        steps: 20,
        warm_up_steps: 2,
        augmentation: Augmentation {
            hue_probability: 0.5,
            gain_sigma: 0.1,
            ..Augmentation::default()
        },
        ..TrainingConfig::compact()
    }
}

/// On a processor without bf16 the same bits, on another one other bits of about the same numbers.
#[test]
fn bf16_rounds_only_where_the_processor_computes_in_it() {
    let computed = Precision::Bf16.on(Device::Cpu);
    for network in [small_compact(), small_resnet43()] {
        let [f32, bf16] = [Precision::F32, Precision::Bf16].map(|precision| {
            let training = TrainingConfig {
                precision,
                ..short(0)
            };
            let mut trainer = Trainer::new(&network, &training).unwrap();
            let (observation, goal) = (heightmap(1), heightmap(2));
            let samples = vec![sample(&observation, &goal); training.batch];
            trainer.train_step(&samples).unwrap();
            let losses = trainer.losses(&samples).unwrap();
            losses.pick + losses.place
        });
        assert_eq!(f32 == bf16, computed == Precision::F32, "{f32}, {bf16}");
        assert!((f32 - bf16).abs() < 0.05 * f32, "{f32}, {bf16}");
    }
}

#[test]
fn one_seed_gives_one_network_and_another_seed_another() {
    let network = small_compact();
    let [first, again, other] =
        [1, 1, 2].map(|seed| run(&mut Trainer::new(&network, &short(seed)).unwrap(), 5));
    assert_eq!(first, again);
    assert_ne!(first, other);
}

#[test]
fn a_resumed_training_goes_on_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let [state, whole, resumed] =
        ["state", "whole", "resumed"].map(|name| folder.path().join(format!("{name}.safetensors")));
    let (network, training) = (small_compact(), short(3));
    let mut trainer = Trainer::new(&network, &training).unwrap();
    run(&mut trainer, 4);
    trainer.save_state(&state).unwrap();
    run(&mut trainer, 4);
    trainer
        .save_checkpoint(&whole, Storage::F32, &Default::default())
        .unwrap();

    let mut trainer = Trainer::resume(&state, &network, &training).unwrap();
    assert_eq!(trainer.step(), 4);
    run(&mut trainer, 4);
    trainer
        .save_checkpoint(&resumed, Storage::F32, &Default::default())
        .unwrap();
    assert!(std::fs::read(whole).unwrap() == std::fs::read(resumed).unwrap());
}

#[test]
fn a_state_of_another_training_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("state.safetensors");
    let network = small_compact();
    Trainer::new(&network, &short(3))
        .unwrap()
        .save_state(&path)
        .unwrap();
    let error = Trainer::resume(&path, &network, &short(4))
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("state.safetensors") && error.contains("\"seed\":3"),
        "{error}"
    );
    let error = Trainer::resume(&path, &small_resnet43(), &short(3))
        .unwrap_err()
        .to_string();
    assert!(error.contains("\"kind\":\"compact\""), "{error}");
}

#[test]
fn the_published_network_takes_to_one_sample() {
    let training = TrainingConfig {
        augmentation: Augmentation::NONE,
        threads: 1,
        ..TrainingConfig::published()
    };
    let mut trainer = Trainer::new(&small_resnet43(), &training).unwrap();
    let (observation, goal) = (heightmap(1), heightmap(2));
    let samples = [sample(&observation, &goal)];
    let before = trainer.losses(&samples).unwrap();
    run(&mut trainer, 12);
    let after = trainer.losses(&samples).unwrap();
    assert!(
        after.pick + after.place < 0.5 * (before.pick + before.place),
        "{before:?} {after:?}"
    );
}

#[test]
fn one_flat_loss_is_the_logarithm_of_the_choices() {
    // Weights that say nothing: uniform over 24 x 16 cells, and over 8 rotations besides.
    let network = small_compact();
    let training = TrainingConfig {
        place_loss: PlaceLoss::AllRotations,
        label_sigma_cells: 0.0,
        ..short(1)
    };
    let trainer = Trainer::new(&network, &training).unwrap();
    let empty = Heightmap::new(small_workspace());
    let losses = trainer.losses(&[sample(&empty, &empty)]).unwrap();
    // At random weights the logits are small, not zero.
    let cells = (24.0 * 16.0f64).ln();
    assert!((losses.pick - cells).abs() < 0.2, "{losses:?}, {cells}");
    assert!((losses.place - cells - 8f64.ln()).abs() < 0.2, "{losses:?}");
}

#[test]
fn bad_samples_and_batches_are_refused_by_name() {
    let mut trainer = Trainer::new(&small_compact(), &short(1)).unwrap();
    let (observation, goal) = (heightmap(1), heightmap(2));
    let good = sample(&observation, &goal);
    let error = trainer.train_step(&[good]).unwrap_err().to_string();
    assert_eq!(error, "a batch of 1 samples, expected 4");

    let mut broken = goal.clone();
    broken.height_m[7] = f32::NAN;
    let bad = Sample {
        goal: (&broken).into(),
        ..good
    };
    let error = trainer
        .train_step(&[good, good, bad, good])
        .unwrap_err()
        .to_string();
    assert_eq!(error, "the goal: height at index 7 is not finite");

    let bad = Sample {
        pick: Isometry2::new(Vector2::new(0.0, 0.0), 0.0),
        ..good
    };
    let error = trainer
        .train_step(&[bad, good, good, good])
        .unwrap_err()
        .to_string();
    assert!(
        error.starts_with("sample 0: the pick pose (0 m, 0 m"),
        "{error}"
    );

    let table = Heightmap::new(Workspace::RAVENS);
    let bad = Sample {
        observation: &table,
        ..good
    };
    let error = trainer.losses(&[bad]).unwrap_err().to_string();
    assert!(
        error.contains("320x160") && error.contains("48x32"),
        "{error}"
    );
    assert_eq!(trainer.step(), 0);
}
