//! Draws the work cell with the arm at home, ready, and at the near and far end of its reach:
//! `cargo run --release -p multiravens --example cell -- cell.png`
use heightmap::{Camera, Intrinsics};
use multiravens::render::{Mesh, Rasteriser, RgbdImage, Scene};
use nalgebra::{Isometry2, Isometry3, Point3, UnitQuaternion, Vector2, Vector3};
use ur5::{Arm, Shape, WorkCell};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args()
        .nth(1)
        .ok_or("expected the name of a PNG file to write")?;
    let cell = WorkCell::builtin()?;
    let arm = &cell.arm;
    let over = |x, y| {
        arm.solve(
            &Arm::tip_down(&Isometry2::new(Vector2::new(x, y), 0.0), 0.0),
            &arm.ready,
        )
    };
    let (eye, target) = (Point3::new(1.4, 1.3, 1.1), Point3::new(0.2, 0.0, 0.25));
    // Image y is down.
    let rotation = UnitQuaternion::face_towards(&(target - eye), &-Vector3::z());
    let camera = Camera {
        name: "visitor".into(),
        intrinsics: Intrinsics {
            fx_px: 600.0,
            fy_px: 600.0,
            ..Intrinsics::RAVENS
        },
        world_from_camera: Isometry3::from_parts(eye.into(), rotation),
    };
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let mut picture = image::RgbImage::new(2 * width as u32, 2 * height as u32);
    for (i, joints) in [arm.home, arm.ready, over(0.25, 0.0)?, over(0.75, 0.5)?]
        .iter()
        .enumerate()
    {
        let mut scene = Scene::new([255, 255, 255]);
        for (body, pose) in cell.shapes(joints) {
            let mesh = scene.add_mesh(match body.shape {
                Shape::Cuboid { size_m } => Mesh::cuboid(size_m),
                Shape::Cylinder { radius_m, length_m } => Mesh::cylinder(radius_m, length_m, 32),
                Shape::Sphere { radius_m } => Mesh::sphere(radius_m, 24),
            });
            scene.add(mesh, pose, body.rgb);
        }
        let mut view = RgbdImage::new(&camera.intrinsics);
        Rasteriser::new().render(&scene, &camera, &mut view.rgb, &mut view.depth_m)?;
        let view = image::RgbImage::from_raw(width as u32, height as u32, view.rgb)
            .ok_or("the view has another size")?;
        let (left, top) = ((i % 2 * width) as i64, (i / 2 * height) as i64);
        image::imageops::replace(&mut picture, &view, left, top);
    }
    picture.save(path)?;
    Ok(())
}
