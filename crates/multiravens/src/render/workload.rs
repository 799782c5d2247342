//! A scene to measure with.

use super::{Mesh, Scene};
use nalgebra::{Isometry3, Vector3};

/// A table with 100 round things on it, about 25,000 triangles: heavier than any problem.
pub fn crowded_table() -> Scene {
    let mut scene = Scene::new([255, 255, 255]);
    let table = scene.add_mesh(Mesh::cuboid(Vector3::new(0.6, 1.1, 0.05)));
    scene.add(
        table,
        Isometry3::translation(0.5, 0.0, -0.025),
        [90, 80, 70],
    );
    let shapes = [
        scene.add_mesh(Mesh::cylinder(0.02, 0.02, 56)),
        scene.add_mesh(Mesh::sphere(0.015, 20)),
        scene.add_mesh(Mesh::capsule(0.012, 0.03, 16)),
    ];
    let colors = [[225, 87, 89], [89, 161, 79], [78, 121, 167], [237, 201, 72]];
    for index in 0..100 {
        let (row, col) = ((index / 5) as f64, (index % 5) as f64);
        let position = Vector3::new(0.3 + 0.1 * col, -0.475 + 0.05 * row, 0.025);
        let pose = Isometry3::new(position, Vector3::new(0.3 * col, 0.2 * row, 0.1 * row));
        scene.add(shapes[index % 3], pose, colors[index % 4]);
    }
    scene
}
