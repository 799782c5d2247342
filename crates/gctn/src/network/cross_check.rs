//! Against an independent implementation in numpy, written from the definitions: `tests/cross_check.py`.

use heightmap::{Heightmap, Workspace};
use nalgebra::Point2;
use rand::RngExt;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use safetensors::tensor::{Dtype, TensorView};
use serde_json::json;
use std::path::Path;
use std::process::Command;
use tch::{Device, Kind, Tensor};

use super::{Builder, Model};
use crate::augment::Warp;
use crate::input::{Label, encode, tensor};
use crate::losses::{pick_loss, place_logits, place_loss};
use crate::{Compact, Network, NetworkConfig, PlaceLoss, Precision, Resnet43};

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
fn check(config: &NetworkConfig, double: bool, loss: PlaceLoss, sigma_cells: f64, tolerance: f64) {
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

    let [observation, goal] = [(); 2].map(|()| scene(config, rng));
    let encoding = model.encoding();
    let mut encoded = vec![0.0; encoding.channels() * observation.workspace.len()];
    encode(
        encoding,
        &observation,
        &goal,
        &Warp::identity(),
        &mut encoded,
    );
    let input = tensor(encoding, config, &encoded);
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
    let losses = [
        pick_loss(&model.grid, sigma_cells, &features, &[label]),
        place_loss(
            &model.grid,
            loss,
            sigma_cells,
            config.rotations,
            &features,
            &[label],
            &mut ChaCha8Rng::seed_from_u64(7),
        ),
    ];
    let gradients = Tensor::run_backward(&[&losses[0] + &losses[1]], &weights, false, false);

    let folder = tempfile::tempdir().unwrap();
    let mut tensors: Vec<(String, Tensor)> = Vec::new();
    for ((name, weight), gradient) in model.parameters.entries.iter().zip(gradients) {
        tensors.push((format!("weight/{name}"), weight.detach()));
        tensors.push((format!("gradient/{name}"), gradient));
    }
    for (name, heightmap) in [("observation", &observation), ("goal", &goal)] {
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
    let [pick_loss, place_loss] = losses.map(|loss| loss.double_value(&[]));
    let case = json!({
        "network": config, "sigma_cells": sigma_cells, "place_loss": loss, "tolerance": tolerance,
        "slopes": double, "pick_px": label.pick_px, "place_px": label.place_px, "rotation": label.rotation,
        "wrong_rotation": wrong, "expected_losses": [pick_loss, place_loss],
    });
    std::fs::write(folder.path().join("case.json"), case.to_string()).unwrap();
    write(&folder.path().join("case.safetensors"), &tensors);

    let package = Path::new(env!("CARGO_MANIFEST_DIR"));
    let environment = package.join("../../.venv/bin/python3");
    let python = if environment.exists() {
        environment
    } else {
        "python3".into()
    };
    let script = package.join("tests/cross_check.py");
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

#[test]
#[ignore = "needs numpy: cargo xtask test runs it"]
fn the_compact_network_is_what_numpy_says() {
    let config = small(Network::Compact(Compact {
        channels: [6, 8, 12, 16],
        feature_channels: 4,
        window_cells: 9,
        ..Compact::default()
    }));
    for loss in [PlaceLoss::AllRotations, PlaceLoss::RightAndOneWrong] {
        check(&config, true, loss, 0.7, 1e-9);
    }
}

#[test]
#[ignore = "needs numpy: cargo xtask test runs it"]
fn the_published_network_is_what_numpy_says() {
    use crate::Interpolation::{Bilinear, Nearest};
    for (rotation_sampling, sigma_cells) in [(Nearest, 0.0), (Bilinear, 1.0)] {
        let config = small(Network::Resnet43(Resnet43 {
            crop_px: 16,
            rotation_sampling,
            ..Resnet43::default()
        }));
        check(&config, true, PlaceLoss::AllRotations, sigma_cells, 1e-9);
    }
}

#[test]
#[ignore = "needs numpy: cargo xtask test runs it"]
fn the_compact_network_in_full_size_and_32_bits_is_what_numpy_says() {
    let config = NetworkConfig::compact();
    check(&config, false, PlaceLoss::RightAndOneWrong, 0.7, 1e-5);
}
