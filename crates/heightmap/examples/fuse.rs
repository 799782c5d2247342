//! Three blocks before the cameras of Ravens, ray by ray, fused and drawn with a pick and a place:
//! `cargo run --release -p heightmap --example fuse -- heightmap.png`.

use heightmap::{Camera, Fusion, Heightmap, View, Workspace, picture};
use nalgebra::{Isometry3, Point2, Point3, Vector3};
use std::path::PathBuf;

/// A box standing on the table.
struct Block {
    world_from_block: Isometry3<f64>,
    size_m: Vector3<f64>,
    rgb: [u8; 3],
}

impl Block {
    fn new(x_m: f64, y_m: f64, yaw_rad: f64, size_m: [f64; 3], rgb: [u8; 3]) -> Self {
        Self {
            world_from_block: Isometry3::new(
                Vector3::new(x_m, y_m, size_m[2] / 2.0),
                Vector3::z() * yaw_rad,
            ),
            size_m: size_m.into(),
            rgb,
        }
    }

    /// Where the line from `eye` to `ahead` enters, in units of their distance.
    fn enter(&self, eye: &Point3<f64>, ahead: &Point3<f64>) -> Option<f64> {
        let eye = self.world_from_block.inverse_transform_point(eye);
        let ray = self.world_from_block.inverse_transform_point(ahead) - eye;
        let (mut enter, mut leave) = (f64::NEG_INFINITY, f64::INFINITY);
        for axis in 0..3 {
            let a = (-self.size_m[axis] / 2.0 - eye[axis]) / ray[axis];
            let b = (self.size_m[axis] / 2.0 - eye[axis]) / ray[axis];
            (enter, leave) = (enter.max(a.min(b)), leave.min(a.max(b)));
        }
        (enter < leave).then_some(enter)
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args_os().nth(1).map(PathBuf::from);
    let path = path.ok_or("expected the path of the picture")?;
    let blocks = [
        Block::new(0.35, -0.30, 0.0, [0.04, 0.04, 0.04], [225, 87, 89]),
        Block::new(0.60, 0.00, 0.5, [0.16, 0.06, 0.02], [78, 121, 167]),
        Block::new(0.40, 0.30, 0.0, [0.05, 0.15, 0.08], [89, 161, 79]),
    ];
    let cameras = Camera::ravens();
    let image = |camera: &Camera| {
        let (mut rgb, mut depth_m) = (Vec::new(), Vec::new());
        let eye = camera.back_project(&Point2::origin(), 0.0);
        for index in 0..camera.intrinsics.len() {
            let (u, v) = (
                index % camera.intrinsics.width,
                index / camera.intrinsics.width,
            );
            let ahead = camera.back_project(&Point2::new(u as f64, v as f64), 1.0);
            let mut nearest = (eye.z / (eye.z - ahead.z), [90, 80, 70]);
            for block in &blocks {
                if let Some(depth_m) = block.enter(&eye, &ahead).filter(|d| *d < nearest.0) {
                    nearest = (depth_m, block.rgb);
                }
            }
            depth_m.push(nearest.0 as f32);
            rgb.extend(nearest.1);
        }
        (rgb, depth_m)
    };
    let images = cameras.each_ref().map(image);
    let views = [0, 1, 2].map(|i| View {
        camera: &cameras[i],
        rgb: &images[i].0,
        depth_m: &images[i].1,
    });
    let mut heightmap = Heightmap::new(Workspace::RAVENS);
    let report = Fusion::default().fuse(&views, &mut heightmap)?;
    let at = |x_m: f64, y_m: f64| heightmap.workspace.pixel(&Point2::new(x_m, y_m));
    let (pick, place) = (at(0.35, -0.30), at(0.60, 0.0));
    let (pick, place) = pick.zip(place).ok_or("off the grid")?;
    let pick = heightmap.workspace.pose(pick, 0.0);
    let place = heightmap.workspace.pose(place, 0.5);
    picture::write_heightmap(&path, &heightmap, Some((&pick, &place)))?;
    println!(
        "{}: {} views, {:.1} % of the cells seen",
        path.display(),
        report.views,
        100.0 * report.coverage
    );
    Ok(())
}
