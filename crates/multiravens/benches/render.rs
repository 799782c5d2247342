//! Three 640x480 RGB-D images of a crowded table, and their fusion, on one thread.

use criterion::{Criterion, criterion_group, criterion_main};
use heightmap::{Camera, Fusion, Heightmap, Workspace};
use multiravens::render::{Rasteriser, RgbdImage, crowded_table};
use std::hint::black_box;

fn render(criterion: &mut Criterion) {
    let scene = crowded_table();
    let cameras = Camera::ravens();
    let mut images = cameras.each_ref().map(|c| RgbdImage::new(&c.intrinsics));
    let mut rasteriser = Rasteriser::new();
    let name = format!(
        "render 3 x 640x480, {} objects, {} triangles",
        scene.instances.len(),
        scene.triangle_count()
    );
    criterion.bench_function(&name, |b| {
        b.iter(|| {
            for (camera, image) in cameras.iter().zip(&mut images) {
                rasteriser
                    .render(
                        black_box(&scene),
                        camera,
                        &mut image.rgb,
                        &mut image.depth_m,
                    )
                    .expect("images of the cameras' size");
            }
        });
    });
    let views = [0, 1, 2].map(|i| images[i].view(&cameras[i]));
    let (mut fusion, mut heightmap) = (Fusion::default(), Heightmap::new(Workspace::RAVENS));
    criterion.bench_function("fuse these", |b| {
        b.iter(|| fusion.fuse(black_box(&views), &mut heightmap))
    });
}

criterion_group!(benches, render);
criterion_main!(benches);
