//! What an embedding must learn, bring back and refuse.

use gctn::{
    Augmentation, Compact, Embedding, EmbeddingConfig, EmbeddingTrainer, EmbeddingTraining,
    ModelCard, Network, NetworkConfig, Storage, Trainer, TrainingConfig,
};
use heightmap::{Heightmap, Workspace};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn config() -> EmbeddingConfig {
    EmbeddingConfig {
        rows: 64,
        cols: 32,
        channels: [4, 4, 8, 8],
        features: 4,
        ..EmbeddingConfig::default()
    }
}

fn training(seed: u64) -> EmbeddingTraining {
    EmbeddingTraining {
        seed,
        steps: 60,
        learning_rate: 3e-3,
        augmentation: Augmentation::NONE,
        displacement_sigma_px: 1.0,
        displacement_spacing_px: 16,
        ..EmbeddingTraining::default()
    }
}

/// Four images: from one to the next, one of three discs goes from the left to the right. Where it lies is noise.
fn sequence(seed: u64) -> Vec<Heightmap> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    (0..4)
        .map(|step| {
            let workspace = Workspace {
                rows: 64,
                cols: 32,
                ..Workspace::RAVENS
            };
            let mut heightmap = Heightmap::new(workspace);
            for disc in 0..3 {
                let row = 12 + 20 * disc + rng.random_range(0..4);
                let col = if disc < step { 22 } else { 6 } + rng.random_range(0..4);
                for index in 0..64 * 32_usize {
                    let (far, wide) = ((index / 32).abs_diff(row), (index % 32).abs_diff(col));
                    if far * far + wide * wide < 16 {
                        heightmap.rgb[3 * index] = 200;
                        heightmap.height_m[index] = 0.02;
                    }
                }
            }
            heightmap
        })
        .collect()
}

fn trained(seed: u64, steps: u64) -> EmbeddingTrainer {
    let mut trainer = EmbeddingTrainer::new(&config(), &training(seed)).unwrap();
    for step in 0..steps {
        let pair = [2 * step, 2 * step + 1].map(sequence);
        let pair: Vec<Vec<&Heightmap>> = pair.iter().map(|one| one.iter().collect()).collect();
        trainer.train_step(&pair).unwrap();
    }
    trainer
}

fn saved(trainer: &EmbeddingTrainer) -> (tempfile::TempDir, std::path::PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("embedding.safetensors");
    let card = ModelCard::from([("task".into(), "discs".into())]);
    trainer.save_checkpoint(&path, &card).unwrap();
    (folder, path)
}

#[test]
fn images_of_the_same_time_come_to_lie_together() {
    let (_folder, path) = saved(&trained(0, 60));
    let embedding = Embedding::load(&path).unwrap();
    assert_eq!(embedding.config(), &config());
    assert_eq!(embedding.card()["task"], "discs");
    let embed = |seed| -> Vec<_> {
        let images = sequence(seed);
        images
            .iter()
            .map(|image| embedding.embed(image).unwrap())
            .collect()
    };
    // Of one demonstration to those of another, whose discs lie elsewhere.
    let mut right = 0;
    for seed in 10_000..10_020 {
        let (known, seen) = (embed(seed), embed(seed + 100));
        for (index, seen) in seen.iter().enumerate() {
            right += usize::from(Embedding::nearest(seen, &known) == Some(index));
        }
    }
    assert!(right >= 76, "{right} of 80");
    assert_eq!(Embedding::nearest(&embed(1)[0], &[]), None);
}

#[test]
fn one_seed_gives_one_embedding() {
    let bytes = |seed| std::fs::read(saved(&trained(seed, 3)).1).unwrap();
    let once = bytes(0);
    assert!(once == bytes(0));
    assert!(once != bytes(1));
}

#[test]
fn what_is_no_embedding_is_refused_by_name() {
    let trainer = EmbeddingTrainer::new(&config(), &training(0)).unwrap();
    let (folder, path) = saved(&trainer);
    let refused = || Embedding::load(&path).unwrap_err().to_string();
    let embedding = Embedding::load(&path).unwrap();
    let error = embedding.embed(&Heightmap::new(Workspace::RAVENS));
    let error = error.unwrap_err().to_string();
    assert!(error.contains("64x32"), "{error}");
    let mut broken = sequence(0).remove(0);
    broken.height_m[7] = f32::NAN;
    let error = embedding.embed(&broken).unwrap_err().to_string();
    assert_eq!(error, "the heightmap: height at index 7 is not finite");

    let bytes = std::fs::read(&path).unwrap();
    for len in [0, 100, bytes.len() / 2, bytes.len() - 1] {
        std::fs::write(&path, &bytes[..len]).unwrap();
        let error = refused();
        assert!(error.contains("truncated"), "{error}");
    }
    // Halves of 16 bits: the last number becomes NaN.
    let mut nan = bytes.clone();
    let end = nan.len();
    nan[end - 2..].copy_from_slice(&[0x00, 0x7e]);
    std::fs::write(&path, &nan).unwrap();
    let error = refused();
    assert!(error.contains("not finite"), "{error}");
    let network = NetworkConfig {
        rows: 32,
        cols: 32,
        ..NetworkConfig::new(Network::Compact(Compact {
            channels: [4, 4, 8, 8],
            window_cells: 5,
            ..Compact::default()
        }))
    };
    let policy = Trainer::new(&network, &TrainingConfig::compact()).unwrap();
    let card = ModelCard::new();
    policy.save_checkpoint(&path, Storage::F16, &card).unwrap();
    let error = refused();
    assert!(
        error.contains("embedding.safetensors") && error.contains("\"gctn-checkpoint\""),
        "{error}"
    );
    drop(folder);
}

#[test]
fn a_demonstration_of_one_image_teaches_nothing_and_is_refused() {
    let mut trainer = EmbeddingTrainer::new(&config(), &training(0)).unwrap();
    let images = sequence(0);
    let error = trainer
        .train_step(&[images.iter().collect(), vec![&images[0]]])
        .unwrap_err();
    let expected = "demonstration 1 has 1 images, expected at least 2";
    assert_eq!(error.to_string(), expected);
    let short = EmbeddingTraining {
        displacement_spacing_px: 1,
        ..training(0)
    };
    let error = EmbeddingTrainer::new(&config(), &short).unwrap_err();
    assert!(error.to_string().contains("displacement_spacing_px is 1"));
}
