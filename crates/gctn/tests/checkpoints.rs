//! What a checkpoint must bring back, and which ones are refused.

use gctn::{
    Calibration, Compact, Decision, Goal, GoalConditioning, Matching, ModelCard, Network,
    NetworkConfig, Policy, Storage, Trainer, TrainingConfig,
};
use heightmap::{Disk, Heightmap, Workspace};
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

fn workspace() -> Workspace {
    Workspace {
        rows: 32,
        cols: 32,
        ..Workspace::RAVENS
    }
}

fn trainer() -> Trainer {
    let network = NetworkConfig {
        rows: 32,
        cols: 32,
        ..NetworkConfig::new(Network::Compact(Compact {
            channels: [4, 4, 8, 8],
            window_cells: 5,
            ..Compact::default()
        }))
    };
    Trainer::new(&network, &TrainingConfig::compact()).unwrap()
}

fn scene() -> [Heightmap; 2] {
    [3, 5].map(|step| {
        let mut heightmap = Heightmap::new(workspace());
        for (index, byte) in heightmap.rgb.iter_mut().enumerate() {
            *byte = (index * step % 256) as u8;
        }
        heightmap
    })
}

fn saved(storage: Storage) -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    let card = ModelCard::from([("task".into(), "placing".into())]);
    trainer().save_checkpoint(&path, storage, &card).unwrap();
    (folder, path)
}

#[test]
fn a_checkpoint_decides_as_its_trainer() {
    let (_folder, path) = saved(Storage::F32);
    let policy = Policy::load(&path).unwrap();
    assert_eq!(policy.config(), trainer().network());
    assert_eq!(policy.card()["task"], "placing");
    let [observation, goal] = scene();
    let decide = |policy: &Policy| policy.decide(&observation, &goal, &[]).unwrap();
    assert_eq!(decide(&policy), decide(&trainer().policy().unwrap()));
    assert_eq!(decide(&policy), decide(&policy));
}

#[test]
fn a_decision_is_the_same_on_another_thread() {
    let policy = trainer().policy().unwrap();
    let [observation, goal] = scene();
    let here = policy.decide(&observation, &goal, &[]).unwrap();
    let there = std::thread::spawn(move || policy.decide(&observation, &goal, &[]).unwrap());
    assert_eq!(here, there.join().unwrap());
}

#[test]
fn sixteen_bits_decide_nearly_the_same_from_half_the_bytes() {
    let (_full_folder, full) = saved(Storage::F32);
    let (_half_folder, half) = saved(Storage::F16);
    let [full_len, half_len] = [&full, &half].map(|path| std::fs::metadata(path).unwrap().len());
    assert!(
        half_len < full_len * 6 / 10,
        "{half_len} of {full_len} bytes"
    );
    let [observation, goal] = scene();
    let [full, half] = [full, half].map(|path| {
        let decision = Policy::load(&path)
            .unwrap()
            .decide(&observation, &goal, &[]);
        decision.unwrap().pick_map.scores
    });
    let error = full
        .iter()
        .zip(&half)
        .map(|(full, half)| (full - half).abs())
        .fold(0.0, f32::max);
    assert!(error < 1e-4 && error > 0.0, "{error}");
}

#[test]
fn excluded_picks_are_not_picked_again() {
    let policy = trainer().policy().unwrap();
    let [observation, goal] = scene();
    let mut exclude: Vec<Disk> = Vec::new();
    for _ in 0..5 {
        let decision = policy.decide(&observation, &goal, &exclude).unwrap();
        let pick = decision.pick.translation.vector;
        assert!(
            exclude
                .iter()
                .all(|known| (known.center_m.coords - pick).norm() > known.radius_m)
        );
        let sum: f64 = decision
            .pick_map
            .scores
            .iter()
            .map(|score| f64::from(*score))
            .sum();
        assert!((sum - 1.0).abs() < 1e-4, "{sum}");
        exclude.push(Disk {
            center_m: pick.into(),
            radius_m: 0.01,
        });
    }
    exclude.iter_mut().for_each(|disk| disk.radius_m = 1.0);
    let error = policy
        .decide(&observation, &goal, &exclude)
        .unwrap_err()
        .to_string();
    assert_eq!(
        error,
        "all cells are within the disks about the 5 excluded picks"
    );
}

#[test]
fn another_grid_and_broken_heightmaps_are_refused() {
    let policy = trainer().policy().unwrap();
    let [observation, goal] = scene();
    let other = Heightmap::new(Workspace::RAVENS);
    let error = policy
        .decide(&observation, &other, &[])
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("320x160") && error.contains("32x32"),
        "{error}"
    );
    let mut short = observation.clone();
    short.rgb.pop();
    let error = policy.decide(&short, &goal, &[]).unwrap_err().to_string();
    assert_eq!(
        error,
        "the observation: rgb has 3071 elements, expected 3072"
    );
    let mut infinite = goal.clone();
    infinite.height_m[5] = f32::INFINITY;
    let error = policy
        .decide(&observation, &infinite, &[])
        .unwrap_err()
        .to_string();
    assert_eq!(error, "the goal: height at index 5 is not finite");
}

#[test]
fn a_network_conditioned_on_a_sequence_wants_the_image_before_the_goal() {
    let network = NetworkConfig {
        rows: 32,
        cols: 32,
        rotations: 4,
        conditioning: GoalConditioning::Sequence,
        ..NetworkConfig::new(Network::Matching(Matching {
            channels: [4, 4, 8, 8],
            window_cells: 5,
            ..Matching::default()
        }))
    };
    let trainer = Trainer::new(&network, &TrainingConfig::compact()).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    let card = ModelCard::new();
    trainer.save_checkpoint(&path, Storage::F32, &card).unwrap();
    let policy = Policy::load(&path).unwrap();
    assert_eq!(policy.config().conditioning, GoalConditioning::Sequence);
    let [observation, image] = scene();
    let decide = |goal: Goal<'_>| policy.decide(&observation, goal, &[]);
    let error = decide((&image).into()).unwrap_err().to_string();
    assert_eq!(
        error,
        "the network is conditioned on sequence, but the image before the goal is missing"
    );
    let decision = decide(Goal::step(&observation, &image)).unwrap();
    assert!(
        decision
            .done
            .is_some_and(|done| (0.0..=1.0).contains(&done))
    );
    let done = policy.done(&observation, Goal::step(&observation, &image));
    assert_eq!(done.unwrap(), decision.done);
    // What an older network does not look at changes nothing.
    let older = self::trainer().policy().unwrap();
    let without = older.decide(&observation, &image, &[]).unwrap();
    let with = older.decide(&observation, Goal::step(&observation, &image), &[]);
    assert_eq!(with.unwrap(), without);
    assert_eq!(without.done, None);
}

#[test]
fn a_calibrated_checkpoint_decides_the_same_and_says_how_likely_it_is() {
    let (folder, path) = saved(Storage::F16);
    let calibrated = folder.path().join("calibrated.safetensors");
    let calibration = Calibration {
        weights: [0.5, 0.25, 0.125, -1.0, 0.0625, 2.0],
        steps: 60,
    };
    gctn::calibrate(&path, &calibrated, &calibration).unwrap();
    let [plain, with] = [path, calibrated].map(|path| Policy::load(&path).unwrap());
    assert_eq!(
        (plain.calibration(), with.calibration()),
        (None, Some(&calibration))
    );
    assert_eq!((plain.card(), plain.config()), (with.card(), with.config()));
    let [observation, goal] = scene();
    let plain = plain.decide(&observation, &goal, &[]).unwrap();
    let with = with.decide(&observation, &goal, &[]).unwrap();
    let success = with.success.unwrap();
    assert_eq!(success, calibration.probability(&plain.evidence));
    assert_eq!(
        with,
        Decision {
            success: Some(success),
            ..plain.clone()
        }
    );
}

#[test]
fn the_mean_of_checkpoints_lies_between_them_and_is_of_one_network() {
    let (folder, path) = saved(Storage::F32);
    let path_of = |name: &str| folder.path().join(name);
    // The same weights with another sign of one bias: their mean is 0 there, and the same everywhere else.
    let bytes = std::fs::read(&path).unwrap();
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    let values = |bytes: &[u8], name: &str| -> Vec<f32> {
        let tensors = SafeTensors::deserialize(bytes).unwrap();
        let tensor = tensors.tensor(name).unwrap();
        match tensor.dtype() {
            Dtype::F32 => tensor
                .data()
                .chunks_exact(4)
                .map(|number| f32::from_le_bytes(number.try_into().unwrap()))
                .collect(),
            _ => panic!("expected 32-bit floats"),
        }
    };
    let name = "pick.bias";
    let turned: Vec<u8> = values(&bytes, name)
        .iter()
        .flat_map(|value| (-value).to_le_bytes())
        .collect();
    let views = tensors.tensors().into_iter().map(|(known, view)| {
        let data = if known == name {
            &turned[..]
        } else {
            view.data()
        };
        let view = TensorView::new(view.dtype(), view.shape().to_vec(), data);
        (known, view.unwrap())
    });
    let (_, header) = SafeTensors::read_metadata(&bytes).unwrap();
    let other = safetensors::serialize(views, header.metadata().clone()).unwrap();
    std::fs::write(path_of("other"), other).unwrap();
    let mean = path_of("mean");
    gctn::average(&[path.clone(), path_of("other")], &mean).unwrap();
    let [one, mean_of_both] = [&path, &mean].map(|path| Policy::load(path).unwrap());
    assert_eq!(mean_of_both.card()["mean of"], "2 snapshots");
    let [observation, goal] = scene();
    let decide = |policy: &Policy| policy.decide(&observation, &goal, &[]).unwrap();
    // A bias of all picks alike changes no probability.
    let [before, after] = [decide(&one), decide(&mean_of_both)];
    assert!((before.pick_score - after.pick_score).abs() < 1e-3);
    let stored = std::fs::read(&mean).unwrap();
    let stored = SafeTensors::deserialize(&stored).unwrap();
    assert_eq!(stored.tensor(name).unwrap().data(), [0, 0]);

    let another = path_of("another");
    let network = NetworkConfig {
        rotations: 5,
        ..trainer().network().clone()
    };
    let another_trainer = Trainer::new(&network, &TrainingConfig::compact()).unwrap();
    another_trainer
        .save_checkpoint(&another, Storage::F32, &ModelCard::new())
        .unwrap();
    let error = gctn::average(&[another, path], &path_of("none")).unwrap_err();
    assert!(error.to_string().contains("another"), "{error}");
    let error = gctn::average(&[], &path_of("none")).unwrap_err();
    assert!(error.to_string().contains("at least 1"), "{error}");
}

#[test]
fn the_matching_network_is_refused_without_a_sequence() {
    let network = NetworkConfig {
        conditioning: GoalConditioning::NextStep,
        ..NetworkConfig::matching()
    };
    let error = network.check().unwrap_err().to_string();
    assert!(
        error.contains("conditioning is next_step") && error.contains("sequence"),
        "{error}"
    );
}

type Head = BTreeMap<String, String>;
type Tensors = BTreeMap<String, (Dtype, Vec<usize>, Vec<u8>)>;

/// Rewrites a checkpoint.
fn edit(path: &Path, change: impl FnOnce(&mut Tensors, &mut Head)) {
    let bytes = std::fs::read(path).unwrap();
    let (_, header) = SafeTensors::read_metadata(&bytes).unwrap();
    let mut head = serde_json::from_str(&header.metadata().as_ref().unwrap()["gctn"]).unwrap();
    let mut tensors: Tensors = SafeTensors::deserialize(&bytes)
        .unwrap()
        .tensors()
        .into_iter()
        .map(|(name, view)| {
            (
                name,
                (view.dtype(), view.shape().to_vec(), view.data().to_vec()),
            )
        })
        .collect();
    change(&mut tensors, &mut head);
    let metadata = HashMap::from([("gctn".to_owned(), serde_json::to_string(&head).unwrap())]);
    let views = tensors.iter().map(|(name, (dtype, shape, data))| {
        (name, TensorView::new(*dtype, shape.clone(), data).unwrap())
    });
    std::fs::write(path, safetensors::serialize(views, Some(metadata)).unwrap()).unwrap();
}

fn refusal(change: impl FnOnce(&mut Tensors, &mut Head)) -> String {
    let (_folder, path) = saved(Storage::F32);
    edit(&path, change);
    let error = Policy::load(&path).unwrap_err().to_string();
    assert!(error.contains("model.safetensors"), "{error}");
    error
}

#[test]
fn an_edit_that_changes_nothing_is_accepted() {
    let (_folder, path) = saved(Storage::F32);
    edit(&path, |_, _| ());
    Policy::load(&path).unwrap();
}

#[test]
fn a_missing_tensor_is_named() {
    let error = refusal(|tensors, _| assert!(tensors.remove("pick.bias").is_some()));
    assert!(error.contains("tensor pick.bias: missing"), "{error}");
}

#[test]
fn a_further_tensor_is_named() {
    let error = refusal(|tensors, _| {
        let copy = tensors["pick.bias"].clone();
        tensors.insert("pick.third".into(), copy);
    });
    assert!(
        error.contains("tensor pick.third: the configured network has no such tensor"),
        "{error}"
    );
}

#[test]
fn a_misshapen_tensor_is_named() {
    let error = refusal(|tensors, _| {
        let entry = tensors.get_mut("stem.bias").unwrap();
        entry.1 = vec![2, 2];
    });
    assert!(
        error.contains("tensor stem.bias: shape [2, 2], expected [4]"),
        "{error}"
    );
}

#[test]
fn a_tensor_that_is_not_finite_is_named() {
    let error = refusal(|tensors, _| {
        let entry = tensors.get_mut("stem.bias").unwrap();
        entry.2[4..8].copy_from_slice(&f32::NAN.to_le_bytes());
    });
    assert!(
        error.contains("tensor stem.bias: has numbers that are not finite"),
        "{error}"
    );
}

#[test]
fn a_tensor_of_whole_numbers_is_named() {
    let error = refusal(|tensors, _| tensors.get_mut("stem.bias").unwrap().0 = Dtype::I32);
    assert!(
        error.contains("tensor stem.bias: type I32, expected F32 or F16"),
        "{error}"
    );
}

#[test]
fn another_network_is_refused() {
    let error = refusal(|_, head| {
        let network = head.get_mut("network").unwrap();
        *network = network.replace("[4,4,8,8]", "[4,8,8,8]");
    });
    assert!(
        error.contains("tensor level1.down.weight: shape [4, 4, 3, 3], expected [8, 4, 3, 3]"),
        "{error}"
    );
    let error = refusal(|_, head| {
        let network = head.get_mut("network").unwrap();
        *network = serde_json::to_string(&NetworkConfig::resnet43()).unwrap();
    });
    assert!(
        error.contains("tensor heads.bias: the configured network has no such tensor"),
        "{error}"
    );
}

#[test]
fn another_version_or_format_is_refused() {
    let error = refusal(|_, head| drop(head.insert("version".into(), "0".into())));
    assert!(
        error.contains("version is \"0\", expected \"1\""),
        "{error}"
    );
    let error = refusal(|_, head| drop(head.insert("format".into(), "pt".into())));
    assert!(error.contains("format is \"pt\""), "{error}");
    let error = refusal(|_, head| head.clear());
    assert!(error.contains("no \"format\" in its head"), "{error}");
}

#[test]
fn a_configuration_that_makes_no_sense_is_refused() {
    let error = refusal(|_, head| {
        let network = head.get_mut("network").unwrap();
        *network = network.replace("\"rows\":32", "\"rows\":33");
    });
    assert!(
        error.contains("rows is 33, expected a multiple of 16"),
        "{error}"
    );
    let error = refusal(|_, head| {
        let network = head.get_mut("network").unwrap();
        *network = network.replace("\"rows\"", "\"lines\"");
    });
    assert!(error.contains("unknown field `lines`"), "{error}");
}

#[test]
fn broken_files_are_refused() {
    let (_folder, path) = saved(Storage::F32);
    let bytes = std::fs::read(&path).unwrap();
    for len in [0, 4, 100, bytes.len() / 2, bytes.len() - 1] {
        std::fs::write(&path, &bytes[..len]).unwrap();
        let error = Policy::load(&path).unwrap_err().to_string();
        assert!(
            error.contains("model.safetensors") && error.contains("truncated"),
            "{error}"
        );
    }
    std::fs::write(
        &path,
        b"this is no checkpoint at all, but long enough to have a header",
    )
    .unwrap();
    assert!(Policy::load(&path).is_err());
    std::fs::remove_file(&path).unwrap();
    let error = Policy::load(&path).unwrap_err().to_string();
    assert!(
        error.contains("model.safetensors") && error.contains("No such file"),
        "{error}"
    );
}

#[test]
fn a_failed_write_leaves_the_old_file() {
    let (folder, path) = saved(Storage::F32);
    let before = std::fs::read(&path).unwrap();
    // The file beside it cannot be made: a folder stands in its place.
    std::fs::create_dir(folder.path().join("model.safetensors.part")).unwrap();
    assert!(
        trainer()
            .save_checkpoint(&path, Storage::F16, &ModelCard::new())
            .is_err()
    );
    assert!(std::fs::read(&path).unwrap() == before);
}
