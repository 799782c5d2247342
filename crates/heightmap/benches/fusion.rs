//! Fusion of the three cameras of Ravens over a table with blocks on it.

use criterion::{Criterion, criterion_group, criterion_main};
use heightmap::{Camera, Fusion, Heightmap, View, Workspace};
use nalgebra::Point2;
use std::hint::black_box;

/// Depth of a chequered table of 0 and 4 cm height, ray by ray.
fn image(camera: &Camera) -> (Vec<u8>, Vec<f32>) {
    let intrinsics = &camera.intrinsics;
    let (mut rgb, mut depth_m) = (Vec::new(), Vec::new());
    for index in 0..intrinsics.len() {
        let image = Point2::new(
            (index % intrinsics.width) as f64,
            (index / intrinsics.width) as f64,
        );
        let one = camera.back_project(&image, 1.0);
        let eye = camera.world_from_camera.translation.vector;
        let at = |z_m: f64| (z_m - eye.z) / (one.z - eye.z);
        let on_block = |depth: f64| {
            let point = eye.xy() + depth * (one.coords - eye).xy();
            ((point.x * 12.0).floor() + (point.y * 12.0).floor()) as i64 % 2 == 0
        };
        let raised = on_block(at(0.04));
        depth_m.push(at(if raised { 0.04 } else { 0.0 }) as f32);
        rgb.extend(if raised { [220, 60, 40] } else { [90, 80, 70] });
    }
    (rgb, depth_m)
}

fn fusion(criterion: &mut Criterion) {
    let cameras = Camera::ravens();
    let images = cameras.each_ref().map(image);
    let views = [0, 1, 2].map(|i| View {
        camera: &cameras[i],
        rgb: &images[i].0,
        depth_m: &images[i].1,
    });
    let (mut fusion, mut out) = (Fusion::default(), Heightmap::new(Workspace::RAVENS));
    criterion.bench_function("fuse 3 x 640x480", |b| {
        b.iter(|| fusion.fuse(black_box(&views), &mut out))
    });
}

criterion_group!(benches, fusion);
criterion_main!(benches);
