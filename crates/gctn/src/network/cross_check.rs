//! Against independent implementations, written from the definitions: in numpy (`tests/cross_check.py`) and in
//! PyTorch (`tests/cross_check_pytorch.py`), which also has every gradient.

use heightmap::{Heightmap, Workspace};
use nalgebra::Point2;
use rand::RngExt;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use safetensors::tensor::{Dtype, TensorView};
use serde_json::json;
use std::path::{Path, PathBuf};
use std::process::Command;
use tch::{Device, Kind, Tensor};

use super::{Builder, Model};
use crate::augment::Warp;
use crate::input::{Label, encode, tensor};
use crate::losses::{done_loss, first_place_loss, pick_loss, place_logits, place_loss};
use crate::{Compact, ModelCard, Network, NetworkConfig, PlaceLoss, Precision, Resnet43, Storage};
use crate::{
    Goal, GoalConditioning, GrConvnet, Interpolation, Matching, TrainingConfig, checkpoint,
};

/// Who checks.
#[derive(Clone, Copy, Debug)]
enum Judge {
    Numpy,
    PyTorch,
}

impl Judge {
    fn script(self) -> &'static str {
        match self {
            Self::Numpy => "tests/cross_check.py",
            Self::PyTorch => "tests/cross_check_pytorch.py",
        }
    }

    /// The first Python that can import what the script needs.
    fn python(self) -> PathBuf {
        let module = match self {
            Self::Numpy => "numpy",
            Self::PyTorch => "torch",
        };
        let environment = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../.venv/bin/python3");
        // The last one has what the distribution's packages brought.
        let pythons = [environment, "python3".into(), "/usr/bin/python3".into()];
        let imports = |python: &PathBuf| {
            let run = Command::new(python)
                .args(["-c", &format!("import {module}")])
                .output();
            run.is_ok_and(|output| output.status.success())
        };
        pythons.into_iter().find(imports).unwrap_or_else(|| {
            panic!("no Python here has {module}: see CONTRIBUTING.md, \"Cross-checks\"")
        })
    }
}

fn scene(config: &NetworkConfig, rng: &mut ChaCha8Rng) -> Heightmap {
    let mut heightmap = Heightmap::new(Workspace {
        rows: config.rows,
        cols: config.cols,
        ..Workspace::RAVENS
    });
    rng.fill(&mut heightmap.rgb[..]);
    heightmap
        .height_m
        .fill_with(|| rng.random_range(-0.002..0.05));
    heightmap
}

/// Writes a case: weights, images and labels, and what this crate makes of them; has it checked.
fn check(
    judge: Judge,
    config: &NetworkConfig,
    double: bool,
    loss: PlaceLoss,
    sigma_cells: f64,
    tolerance: f64,
) {
    crate::set_threads(1);
    let rng = &mut ChaCha8Rng::seed_from_u64(7);
    let builder = Builder::random(7, Device::Cpu);
    let builder = if double { builder.double() } else { builder };
    let model = Model::new(config, builder, Precision::F32);
    // No weight stays at 0, where the ones behind it would not matter.
    let noise: Vec<f64> = (0..model.parameters.len())
        .map(|_| rng.random_range(-0.02..0.02))
        .collect();
    let mut flat = model.parameters.flat.shallow_clone();
    flat += Tensor::from_slice(&noise).to_kind(flat.kind());

    let [observation, goal, last] = [(); 3].map(|()| scene(config, rng));
    let shown = Goal {
        image: &goal,
        last: (config.conditioning == GoalConditioning::Both).then_some(&last),
        previous: (config.conditioning == GoalConditioning::Sequence).then_some(&last),
    };
    let encoding = model.encoding();
    let mut encoded = vec![0.0; encoding.channels() * observation.workspace.len()];
    encode(
        encoding,
        &observation,
        shown,
        &Warp::identity(),
        &mut encoded,
    );
    let input = tensor(encoding, [config.rows, config.cols], &encoded);
    let label = Label {
        pick_px: Point2::new(
            0.4 * config.cols as f64 + 0.13,
            0.6 * config.rows as f64 + 0.71,
        ),
        place_px: Point2::new(
            0.7 * config.cols as f64 + 0.37,
            0.3 * config.rows as f64 + 0.05,
        ),
        rotation: 3,
        done: false,
    };
    let wrong = (label.rotation + ChaCha8Rng::seed_from_u64(7).random_range(1..config.rotations))
        % config.rotations;

    let weights = model.parameters.require_gradients();
    let features = model.forward(&input);
    let turns = [(0..config.rotations).collect()];
    let place = tch::no_grad(|| {
        place_logits(
            &model.grid,
            &features,
            &[label.pick_px],
            &turns,
            config.rotations,
        )
    });
    let training = TrainingConfig {
        place_loss: loss,
        label_sigma_cells: sigma_cells,
        ..TrainingConfig::compact()
    };
    let mut losses = vec![
        pick_loss(&model.grid, sigma_cells, &features, &[label]),
        place_loss(
            &model.grid,
            &training,
            config.rotations,
            &features,
            None,
            &[label],
            &mut ChaCha8Rng::seed_from_u64(7),
        ),
    ];
    if let Some(first) = &features.first {
        losses.push(first_place_loss(&model.grid, sigma_cells, first, &[label]));
        losses.push(done_loss(first, &[label]));
    }
    // In 32 bits only the values are checked, and the weights are read from a checkpoint.
    let gradients = if double {
        let sum = Tensor::stack(&losses, 0).sum(None::<Kind>);
        Tensor::run_backward(&[sum], &weights, false, false)
    } else {
        Vec::new()
    };

    let folder = tempfile::tempdir().unwrap();
    let mut tensors: Vec<(String, Tensor)> = Vec::new();
    for (name, weight) in &model.parameters.entries {
        tensors.push((format!("weight/{name}"), weight.detach()));
    }
    for ((name, _), gradient) in model.parameters.entries.iter().zip(gradients) {
        tensors.push((format!("gradient/{name}"), gradient));
    }
    if !double {
        let path = folder.path().join("model.safetensors");
        let card = ModelCard::new();
        checkpoint::save(&path, Storage::F32, config, &model.parameters, &card).unwrap();
    }
    for (name, heightmap) in [
        ("observation", &observation),
        ("goal", &goal),
        ("last", &last),
    ] {
        let (rows, cols) = (config.rows as i64, config.cols as i64);
        let rgb = Tensor::from_slice(&heightmap.rgb).view([rows, cols, 3]);
        let height_m = Tensor::from_slice(&heightmap.height_m).view([rows, cols]);
        tensors.push((format!("{name}/rgb"), rgb));
        tensors.push((format!("{name}/height_m"), height_m));
    }
    tensors.push(("input".into(), input.squeeze_dim(0)));
    tensors.push((
        "expected/pick".into(),
        features.pick.detach().squeeze_dim(0),
    ));
    tensors.push(("expected/place".into(), place.squeeze_dim(0)));
    let losses: Vec<f64> = losses.iter().map(|loss| loss.double_value(&[])).collect();
    let case = json!({
        "network": config, "sigma_cells": sigma_cells, "place_loss": loss, "tolerance": tolerance,
        "slopes": double, "pick_px": label.pick_px, "place_px": label.place_px, "rotation": label.rotation,
        "wrong_rotation": wrong, "expected_losses": losses,
    });
    std::fs::write(folder.path().join("case.json"), case.to_string()).unwrap();
    write(&folder.path().join("case.safetensors"), &tensors);

    let python = judge.python();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join(judge.script());
    let output = Command::new(&python)
        .arg(script)
        .arg(folder.path())
        .output()
        .unwrap();
    let [out, err] =
        [output.stdout, output.stderr].map(|text| String::from_utf8_lossy(&text).into_owned());
    println!("{out}");
    assert!(
        output.status.success(),
        "{}:\n{out}\n{err}",
        python.display()
    );
}

/// All numbers as 64-bit floats.
fn write(path: &Path, tensors: &[(String, Tensor)]) {
    let data = tensors.iter().map(|(name, tensor)| {
        let tensor = tensor.to_kind(Kind::Double).contiguous();
        let mut bytes = vec![0; 8 * tensor.numel()];
        tensor.copy_data_u8(&mut bytes, tensor.numel());
        let shape: Vec<usize> = tensor.size().iter().map(|size| *size as usize).collect();
        (name, shape, bytes)
    });
    let data: Vec<_> = data.collect();
    let views = data.iter().map(|(name, shape, bytes)| {
        (
            name,
            TensorView::new(Dtype::F64, shape.clone(), bytes).unwrap(),
        )
    });
    safetensors::serialize_to_file(views, None, path).unwrap();
}

fn small(network: Network) -> NetworkConfig {
    NetworkConfig {
        rows: 32,
        cols: 16,
        rotations: 8,
        ..NetworkConfig::new(network)
    }
}

fn the_compact_network_matches_the_reference(judge: Judge) {
    let config = small(Network::Compact(Compact {
        channels: [6, 8, 12, 16],
        feature_channels: 4,
        window_cells: 9,
        ..Compact::default()
    }));
    for loss in [PlaceLoss::AllRotations, PlaceLoss::RightAndOneWrong] {
        check(judge, &config, true, loss, 0.7, 1e-9);
    }
}

fn the_matching_network_matches_the_reference(judge: Judge) {
    let config = NetworkConfig {
        conditioning: GoalConditioning::Sequence,
        ..small(Network::Matching(Matching {
            channels: [6, 8, 12, 16],
            hidden_channels: 5,
            appearance_channels: 4,
            feature_channels: 3,
            context_channels: 2,
            window_cells: 9,
            ..Matching::default()
        }))
    };
    for loss in [PlaceLoss::AllRotations, PlaceLoss::RightAndOneWrong] {
        check(judge, &config, true, loss, 0.7, 1e-9);
    }
}

fn the_matching_network_in_full_size_and_32_bits_matches_the_reference(judge: Judge) {
    let config = NetworkConfig::matching();
    let loss = PlaceLoss::RightAndOneWrong;
    check(judge, &config, false, loss, 0.7, 1e-5);
}

#[test]
#[ignore = "needs numpy: cargo xtask test runs it"]
fn the_matching_network_is_what_numpy_says() {
    the_matching_network_matches_the_reference(Judge::Numpy);
}

#[test]
#[ignore = "needs numpy: cargo xtask test runs it"]
fn the_matching_network_in_full_size_and_32_bits_is_what_numpy_says() {
    the_matching_network_in_full_size_and_32_bits_matches_the_reference(Judge::Numpy);
}

#[test]
#[ignore = "needs PyTorch: cargo xtask test runs it where there is one"]
fn the_matching_network_and_its_gradients_are_what_pytorch_says() {
    the_matching_network_matches_the_reference(Judge::PyTorch);
}

#[test]
#[ignore = "needs PyTorch: cargo xtask test runs it where there is one"]
fn the_matching_network_in_full_size_and_32_bits_is_what_pytorch_says() {
    the_matching_network_in_full_size_and_32_bits_matches_the_reference(Judge::PyTorch);
}

fn the_published_network_matches_the_reference(judge: Judge) {
    use Interpolation::{Bilinear, Nearest};
    for (rotation_sampling, sigma_cells) in [(Nearest, 0.0), (Bilinear, 1.0)] {
        let config = small(Network::Resnet43(Resnet43 {
            crop_px: 16,
            rotation_sampling,
            ..Resnet43::default()
        }));
        let loss = PlaceLoss::AllRotations;
        check(judge, &config, true, loss, sigma_cells, 1e-9);
    }
}

fn the_compact_network_in_full_size_and_32_bits_matches_the_reference(judge: Judge) {
    let config = NetworkConfig::compact();
    check(
        judge,
        &config,
        false,
        PlaceLoss::RightAndOneWrong,
        0.7,
        1e-5,
    );
}

#[test]
#[ignore = "needs numpy: cargo xtask test runs it"]
fn the_compact_network_is_what_numpy_says() {
    the_compact_network_matches_the_reference(Judge::Numpy);
}

#[test]
#[ignore = "needs numpy: cargo xtask test runs it"]
fn the_published_network_is_what_numpy_says() {
    the_published_network_matches_the_reference(Judge::Numpy);
}

#[test]
#[ignore = "needs numpy: cargo xtask test runs it"]
fn the_compact_network_in_full_size_and_32_bits_is_what_numpy_says() {
    the_compact_network_in_full_size_and_32_bits_matches_the_reference(Judge::Numpy);
}

#[test]
#[ignore = "needs PyTorch: cargo xtask test runs it where there is one"]
fn the_compact_network_and_its_gradients_are_what_pytorch_says() {
    the_compact_network_matches_the_reference(Judge::PyTorch);
}

#[test]
#[ignore = "needs PyTorch: cargo xtask test runs it where there is one"]
fn the_published_network_and_its_gradients_are_what_pytorch_says() {
    the_published_network_matches_the_reference(Judge::PyTorch);
}

#[test]
#[ignore = "needs PyTorch: cargo xtask test runs it where there is one"]
fn the_gr_convnet_and_its_gradients_are_what_pytorch_says() {
    for rotation_sampling in [Interpolation::Nearest, Interpolation::Bilinear] {
        let config = small(Network::GrConvnet(GrConvnet {
            channels: 6,
            blocks: 2,
            feature_channels: 4,
            window_cells: 9,
            rotation_sampling,
        }));
        check(
            Judge::PyTorch,
            &config,
            true,
            PlaceLoss::AllRotations,
            0.7,
            1e-9,
        );
    }
}

#[test]
#[ignore = "needs PyTorch: cargo xtask test runs it where there is one"]
fn networks_conditioned_on_both_goals_are_what_pytorch_says() {
    let compact = Network::Compact(Compact {
        channels: [6, 8, 12, 16],
        feature_channels: 4,
        window_cells: 9,
        rotation_sampling: Interpolation::Nearest,
        ..Compact::default()
    });
    let resnet43 = Network::Resnet43(Resnet43 {
        crop_px: 16,
        ..Resnet43::default()
    });
    for network in [compact, resnet43] {
        let config = NetworkConfig {
            conditioning: GoalConditioning::Both,
            ..small(network)
        };
        check(
            Judge::PyTorch,
            &config,
            true,
            PlaceLoss::AllRotations,
            0.7,
            1e-9,
        );
    }
}

#[test]
#[ignore = "needs PyTorch: cargo xtask test runs it where there is one"]
fn the_compact_network_in_full_size_and_32_bits_is_what_pytorch_says() {
    the_compact_network_in_full_size_and_32_bits_matches_the_reference(Judge::PyTorch);
}

#[test]
#[ignore = "needs PyTorch: cargo xtask test runs it where there is one"]
fn the_published_network_in_full_size_and_32_bits_is_what_pytorch_says() {
    // Fewer rotations: without Fourier transforms, each costs seconds.
    let config = NetworkConfig {
        rotations: 6,
        ..NetworkConfig::resnet43()
    };
    let loss = PlaceLoss::AllRotations;
    check(Judge::PyTorch, &config, false, loss, 0.0, 1e-5);
}
