//! Draws a scene.
use heightmap::Camera;
use multiravens::render::*;
use nalgebra::{Isometry3, Vector3};
fn main() {
    let mut scene = Scene::new([255, 255, 255]);
    let table = scene.add_mesh(Mesh::cuboid(Vector3::new(0.5, 1.0, 0.1)));
    let cube = scene.add_mesh(Mesh::cuboid(Vector3::new(0.04, 0.04, 0.04)));
    let cyl = scene.add_mesh(Mesh::cylinder(0.04, 0.02, 32));
    let ball = scene.add_mesh(Mesh::sphere(0.02, 24));
    let caps = scene.add_mesh(Mesh::capsule(0.02, 0.1, 24));
    scene.add(table, Isometry3::translation(0.5, 0.0, -0.05), [90, 80, 75]);
    scene.add(cube, Isometry3::translation(0.5, 0.1, 0.02), [255, 87, 89]);
    scene.add(cyl, Isometry3::translation(0.4, 0.1, 0.01), [89, 169, 79]);
    scene.add(
        ball,
        Isometry3::translation(0.5, -0.1, 0.02),
        [78, 121, 167],
    );
    scene.add(
        caps,
        Isometry3::new(Vector3::new(0.6, -0.2, 0.1), Vector3::new(0.5, 0.5, 0.5)),
        [237, 201, 72],
    );
    let mut r = Rasteriser::new();
    for camera in &Camera::ravens() {
        let mut image = RgbdImage::new(&camera.intrinsics);
        r.render(&scene, camera, &mut image.rgb, &mut image.depth_m)
            .unwrap();
        let hit = image.depth_m.iter().filter(|d| **d > 0.0).count();
        println!("{} {hit} {:?}", camera.name, image.depth_m[240 * 640 + 320]);
        let out = std::env::args().nth(1).unwrap();
        image::save_buffer(
            format!("{out}/{}.png", camera.name),
            &image.rgb,
            640,
            480,
            image::ColorType::Rgb8,
        )
        .unwrap();
    }
}
