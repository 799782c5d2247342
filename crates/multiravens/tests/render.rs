//! The rasteriser against rays, and through the fusion.

use heightmap::{Camera, Fusion, Heightmap, Intrinsics, Pixel, Workspace};
use multiravens::render::{
    FAR_M, Instance, Mesh, MeshError, NEAR_M, Rasteriser, RenderError, RgbdImage, Scene,
    crowded_table,
};
use nalgebra::{Isometry3, Point2, Point3, Vector3};
use proptest::prelude::*;

const WHITE: [u8; 3] = [255, 255, 255];
const RED: [u8; 3] = [225, 87, 89];

fn render(scene: &Scene, camera: &Camera) -> RgbdImage {
    let mut image = RgbdImage::new(&camera.intrinsics);
    Rasteriser::new()
        .render(scene, camera, &mut image.rgb, &mut image.depth_m)
        .unwrap();
    image
}

/// One mesh at one place.
fn alone(mesh: Mesh, pose: Isometry3<f64>) -> Scene {
    let mut scene = Scene::new(WHITE);
    let mesh = scene.add_mesh(mesh);
    scene.add(mesh, pose, RED);
    scene
}

/// The image points of all pixels.
fn pixels(camera: &Camera) -> impl Iterator<Item = Point2<f64>> {
    let Intrinsics { width, height, .. } = camera.intrinsics;
    (0..width * height).map(move |i| Point2::new((i % width) as f64, (i / width) as f64))
}

/// Start and direction of the ray through an image point, in the frame of a mesh; the parameter
/// along it is the depth.
fn ray(camera: &Camera, image: &Point2<f64>, pose: &Isometry3<f64>) -> (Point3<f64>, Vector3<f64>) {
    let mesh_from_camera = pose.inverse() * camera.world_from_camera;
    (
        Point3::from(mesh_from_camera.translation.vector),
        mesh_from_camera * camera.intrinsics.ray(image),
    )
}

/// Depth at which a ray enters a box.
fn enter_cuboid(eye: &Point3<f64>, ray: &Vector3<f64>, size_m: &Vector3<f64>) -> Option<f64> {
    let (mut enter, mut leave) = (f64::NEG_INFINITY, f64::INFINITY);
    for axis in 0..3 {
        let a = (-size_m[axis] / 2.0 - eye[axis]) / ray[axis];
        let b = (size_m[axis] / 2.0 - eye[axis]) / ray[axis];
        (enter, leave) = (enter.max(a.min(b)), leave.min(a.max(b)));
    }
    (enter < leave).then_some(enter)
}

/// Depth at which a ray enters a cylinder about z.
fn enter_cylinder(
    eye: &Point3<f64>,
    ray: &Vector3<f64>,
    radius_m: f64,
    height_m: f64,
) -> Option<f64> {
    let (a, b) = (ray.xy().norm_squared(), eye.xy().coords.dot(&ray.xy()));
    let root = (b * b - a * (eye.xy().coords.norm_squared() - radius_m * radius_m)).sqrt();
    let (low, high) = (
        (-height_m / 2.0 - eye.z) / ray.z,
        (height_m / 2.0 - eye.z) / ray.z,
    );
    let enter = low.min(high).max((-b - root) / a);
    let leave = low.max(high).min((-b + root) / a);
    // No root: the ray passes by.
    (!root.is_nan() && enter < leave).then_some(enter)
}

/// How many pixels disagree with the rays, and how many see something.
fn disagreement(
    camera: &Camera,
    image: &RgbdImage,
    enter: impl Fn(&Point2<f64>) -> Option<f64>,
) -> (usize, usize) {
    let (mut wrong, mut seen) = (0, 0);
    for ((point, &depth_m), rgb) in pixels(camera).zip(&image.depth_m).zip(image.rgb.chunks(3)) {
        let expected = enter(&point).filter(|depth_m| *depth_m < FAR_M);
        assert_eq!(
            depth_m == 0.0,
            rgb == WHITE,
            "colour without depth at {point}"
        );
        seen += usize::from(expected.is_some());
        let agrees = match expected {
            Some(expected) => (f64::from(depth_m) - expected).abs() < 1e-5,
            None => depth_m == 0.0,
        };
        wrong += usize::from(!agrees);
    }
    (wrong, seen)
}

#[test]
fn the_depth_of_a_plane_is_exact() {
    let table = Mesh::cuboid(Vector3::new(8.0, 8.0, 0.1));
    let scene = alone(table, Isometry3::translation(0.5, 0.0, -0.05));
    for camera in &Camera::ravens() {
        let image = render(&scene, camera);
        let hits = pixels(camera)
            .zip(&image.depth_m)
            .filter(|(_, depth_m)| **depth_m > 0.0 && **depth_m < 3.0);
        let mut count = 0;
        for (point, &depth_m) in hits {
            let z_m = camera.back_project(&point, f64::from(depth_m)).z;
            // Three units in the last place of the depth.
            assert!(z_m.abs() < 7e-7, "{} {point}: {z_m}", camera.name);
            count += 1;
        }
        assert!(count > 200_000, "{count}");
    }
}

#[test]
fn a_cylinder_looks_like_the_rays_say() {
    let (radius_m, height_m) = (0.045, 0.12);
    let pose = Isometry3::new(Vector3::new(0.5, 0.0, 0.1), Vector3::new(0.4, -0.8, 0.3));
    let scene = alone(Mesh::cylinder(radius_m, height_m, 720), pose);
    for camera in &Camera::ravens() {
        let (wrong, seen) = disagreement(camera, &render(&scene, camera), |point| {
            let (eye, ray) = ray(camera, point, &pose);
            enter_cylinder(&eye, &ray, radius_m, height_m)
        });
        assert!(seen > 1000);
        // Where a ray grazes the round side the 720 flat ones are a little behind.
        assert!(wrong * 100 <= seen, "{}: {wrong} of {seen}", camera.name);
        assert!(wrong * 1000 <= camera.intrinsics.len());
    }
}

#[test]
fn what_is_nearer_hides_what_is_behind_in_either_order() {
    let camera = &Camera::ravens()[0];
    let ahead = |depth_m: f64| {
        let center = camera.back_project(&Point2::new(320.0, 240.0), depth_m);
        Isometry3::from(center.coords)
    };
    let mut scene = Scene::new(WHITE);
    let ball = scene.add_mesh(Mesh::sphere(0.03, 24));
    let near = Instance {
        mesh: ball,
        world_from_mesh: ahead(0.8),
        rgb: RED,
    };
    let far = Instance {
        world_from_mesh: ahead(1.0),
        rgb: [0, 0, 200],
        ..near.clone()
    };
    scene.instances = vec![near.clone(), far.clone()];
    let one = render(&scene, camera);
    scene.instances = vec![far, near];
    let other = render(&scene, camera);
    assert!(one == other);
    let middle = 240 * 640 + 320;
    assert!(
        one.rgb[3 * middle] > one.rgb[3 * middle + 2],
        "red is in front"
    );
    assert!((one.depth_m[middle] - 0.77).abs() < 1e-3);
    // All of the blue ball is hidden: it is as large and farther away.
    assert!(one.rgb.chunks(3).all(|rgb| rgb[0] > 0));
}

#[test]
fn a_face_is_seen_from_outside_only() {
    let camera = &Camera::ravens()[0];
    let around = alone(
        Mesh::cuboid(Vector3::new(3.0, 3.0, 3.0)),
        Isometry3::from(camera.world_from_camera.translation.vector),
    );
    assert!(render(&around, camera).depth_m.iter().all(|d| *d == 0.0));
}

#[test]
fn a_floor_that_passes_below_the_camera_is_clipped_at_the_near_and_the_far_plane() {
    // Level, 5 mm above a floor that runs from behind the camera to beyond the far plane.
    let mut camera = Camera::ravens()[0].clone();
    let eye = Point3::new(0.0, 0.0, 0.005);
    camera.world_from_camera =
        Isometry3::face_towards(&eye, &Point3::new(1.0, 0.0, 0.005), &-Vector3::z());
    let size_m = Vector3::new(40.0, 40.0, 1.0);
    let pose = Isometry3::translation(0.0, 0.0, -0.5);
    let image = render(&alone(Mesh::cuboid(size_m), pose), &camera);
    let mut nearest_m = f32::INFINITY;
    for (point, &depth_m) in pixels(&camera).zip(&image.depth_m) {
        let (eye, ray) = ray(&camera, &point, &pose);
        let expected_m = (0.5 - eye.z) / ray.z;
        let visible = (NEAR_M..FAR_M).contains(&expected_m);
        assert_eq!(depth_m > 0.0, visible, "{point}: {depth_m}, {expected_m}");
        if visible {
            let error = (f64::from(depth_m) / expected_m - 1.0).abs();
            assert!(error < 1e-6, "{point}: {depth_m}, {expected_m}");
            nearest_m = nearest_m.min(depth_m);
        }
    }
    assert!(f64::from(nearest_m) < 1.01 * NEAR_M, "{nearest_m}");
}

#[test]
fn neighbouring_faces_leave_no_gap() {
    // Rows of a convex body's image are without holes, and so are its columns.
    let pose = Isometry3::new(Vector3::new(0.5, 0.02, 0.1), Vector3::new(0.3, 0.2, 0.9));
    for mesh in [
        Mesh::sphere(0.08, 100),
        Mesh::cylinder(0.06, 0.1, 77),
        Mesh::capsule(0.05, 0.1, 50),
        Mesh::cuboid(Vector3::new(0.1, 0.2, 0.05)),
    ] {
        let scene = alone(mesh, pose);
        for camera in &Camera::ravens() {
            let image = render(&scene, camera);
            let hit = |u: usize, v: usize| image.depth_m[v * 640 + u] > 0.0;
            let runs = |line: Vec<bool>| line.windows(2).filter(|pair| !pair[0] && pair[1]).count();
            for v in 0..480 {
                assert!(runs((0..640).map(|u| hit(u, v)).collect()) <= 1, "row {v}");
            }
            for u in 0..640 {
                assert!(
                    runs((0..480).map(|v| hit(u, v)).collect()) <= 1,
                    "column {u}"
                );
            }
        }
    }
}

#[test]
fn a_face_that_looks_up_has_the_color_of_its_instance() {
    let mut scene = Scene::new(WHITE);
    let block = scene.add_mesh(Mesh::cuboid(Vector3::new(0.2, 0.2, 0.1)));
    // A little askew, as a settled body is.
    let pose = Isometry3::new(Vector3::new(0.5, 0.0, 0.05), Vector3::new(0.01, -0.01, 0.4));
    scene.add(block, pose, [78, 121, 167]);
    let camera = &Camera::ravens()[0];
    let image = render(&scene, camera);
    for (point, (&depth_m, rgb)) in
        pixels(camera).zip(image.depth_m.iter().zip(image.rgb.chunks(3)))
    {
        if depth_m == 0.0 {
            continue;
        }
        let hit = pose.inverse() * camera.back_project(&point, f64::from(depth_m));
        if (hit.z - 0.05).abs() < 1e-6 {
            assert_eq!(rgb, [78, 121, 167]);
        } else {
            // The sides are darker and still blue.
            assert!(
                rgb[2] < 150 && rgb[2] > rgb[1] && rgb[1] > rgb[0],
                "{rgb:?}"
            );
        }
    }
}

/// FNV-1a over the bits of an image.
fn hash(image: &RgbdImage) -> u64 {
    let depths = image.depth_m.iter().flat_map(|d| d.to_bits().to_le_bytes());
    let bytes = image.rgb.iter().copied().chain(depths);
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}

#[test]
fn images_have_the_same_bits_in_every_build() {
    let scene = crowded_table();
    let hashes = Camera::ravens().map(|camera| hash(&render(&scene, &camera)));
    assert_eq!(hashes, GOLDEN, "{hashes:#x?}");
}
const GOLDEN: [u64; 3] = [
    0x7b24_b824_517d_3b74,
    0x396b_780e_9086_dc51,
    0x520e_e535_4049_ee65,
];

#[test]
fn one_rasteriser_draws_images_of_any_size_in_turn() {
    let mut rasteriser = Rasteriser::new();
    let scene = crowded_table();
    let mut small = Camera::ravens()[1].clone();
    small.intrinsics = Intrinsics {
        width: 33,
        height: 17,
        fx_px: 23.0,
        fy_px: 25.0,
        cx_px: 16.0,
        cy_px: 8.0,
        ..Intrinsics::RAVENS
    };
    for camera in [&Camera::ravens()[0], &small, &Camera::ravens()[2]] {
        let mut image = RgbdImage::new(&camera.intrinsics);
        // Whatever was there before is gone.
        image.rgb.fill(77);
        image.depth_m.fill(f32::NAN);
        rasteriser
            .render(&scene, camera, &mut image.rgb, &mut image.depth_m)
            .unwrap();
        assert!(image == render(&scene, camera));
        assert!(image.depth_m.iter().any(|d| *d > 0.0));
    }
}

#[test]
fn a_cube_on_the_table_is_found_in_its_cells_of_the_heightmap() {
    let workspace = Workspace::RAVENS;
    let mut scene = Scene::new(WHITE);
    let table = scene.add_mesh(Mesh::cuboid(Vector3::new(0.6, 1.1, 0.05)));
    scene.add(
        table,
        Isometry3::translation(0.5, 0.0, -0.025),
        [90, 80, 70],
    );
    // Cells 200..213 along y and 40..53 along x, 40.6 mm; off both axes of symmetry.
    let size_m = 13.0 * workspace.pixel_size_m;
    let cube = scene.add_mesh(Mesh::cuboid(Vector3::new(size_m, size_m, 0.04)));
    let center = workspace.center(Pixel { row: 206, col: 46 });
    scene.add(cube, Isometry3::translation(center.x, center.y, 0.02), RED);
    let cameras = Camera::ravens();
    let images = cameras.each_ref().map(|camera| render(&scene, camera));
    let views = [0, 1, 2].map(|i| images[i].view(&cameras[i]));
    let mut heightmap = Heightmap::new(workspace);
    let report = Fusion::default().fuse(&views, &mut heightmap).unwrap();
    assert!(report.coverage > 0.98, "{}", report.coverage);
    let mut top = 0;
    for row in 0..workspace.rows {
        for col in 0..workspace.cols {
            let height_m = heightmap.height_at_m(Pixel { row, col });
            let inside = (200..213).contains(&row) && (40..53).contains(&col);
            let near = (199..214).contains(&row) && (39..54).contains(&col);
            if inside && (height_m - 0.04).abs() < 1e-6 {
                top += 1;
                let rgb = &heightmap.rgb[3 * (row * workspace.cols + col)..][..3];
                assert!(rgb[0] > rgb[1] && rgb[0] > rgb[2], "{rgb:?}");
            }
            // The next cells may see a side of the cube; beyond is the table.
            assert!(near || height_m.abs() < 1e-6, "{row}, {col}: {height_m}");
        }
    }
    assert_eq!(top, 13 * 13);
}

#[test]
fn what_does_not_fit_is_refused_by_name() {
    let mut scene = alone(Mesh::sphere(0.02, 12), Isometry3::identity());
    let mut camera = Camera::ravens()[1].clone();
    let mut image = RgbdImage::new(&camera.intrinsics);
    let mut rasteriser = Rasteriser::new();
    let mut refusal = |scene: &Scene, camera: &Camera, rgb: usize, depth: usize| {
        let (rgb, depth_m) = (&mut image.rgb[rgb..], &mut image.depth_m[depth..]);
        rasteriser.render(scene, camera, rgb, depth_m).unwrap_err()
    };
    let text = refusal(&scene, &camera, 1, 0).to_string();
    assert!(
        text.contains("left") && text.contains("colour") && text.contains("921599"),
        "{text}"
    );
    let text = refusal(&scene, &camera, 0, 3).to_string();
    assert!(
        text.contains("left") && text.contains("depth") && text.contains("307197"),
        "{text}"
    );
    camera.intrinsics.fx_px = f64::NAN;
    assert!(matches!(
        refusal(&scene, &camera, 0, 0),
        RenderError::Camera(_)
    ));
    camera.intrinsics.fx_px = 450.0;
    scene.instances[0].world_from_mesh.translation.x = f64::NAN;
    assert_eq!(
        refusal(&scene, &camera, 0, 0),
        RenderError::Pose { instance: 0 }
    );
    scene.instances[0].world_from_mesh = Isometry3::identity();
    scene.instances[0].mesh = crowded_table().instances[2].mesh;
    assert_eq!(
        refusal(&scene, &camera, 0, 0),
        RenderError::Mesh { instance: 0 }
    );
}

#[test]
fn faces_that_are_none_are_refused() {
    let corners = || {
        [
            (0.0, 0.0, 0.0),
            (1.0, 0.0, 0.0),
            (1.0, 1.0, 0.0),
            (0.0, 1.0, 0.0),
            (0.0, 0.0, 1.0),
        ]
        .map(|(x, y, z)| Point3::new(x, y, z))
        .to_vec()
    };
    let refusal = |face: &[usize]| Mesh::new(corners(), [face]).unwrap_err();
    assert!(Mesh::new(corners(), [[0, 1, 2, 3]]).is_ok());
    assert!(matches!(
        refusal(&[0, 1, 5]),
        MeshError::Index { vertex: 5, .. }
    ));
    for face in [
        &[][..],
        &[0],
        &[0, 1],
        &[0, 1, 1],
        &[0, 1, 2, 4],
        &[0, 2, 1, 3],
    ] {
        assert!(
            matches!(refusal(face), MeshError::Face { face: 0, .. }),
            "{face:?}"
        );
    }
    let mut bent = corners();
    bent[4].x = f64::INFINITY;
    assert_eq!(
        Mesh::new(bent, [[0, 1, 2]]).unwrap_err(),
        MeshError::NotFinite { vertex: 4 }
    );
}

/// A small camera, so that a case is quick.
fn quick() -> Camera {
    let mut camera = Camera::ravens()[0].clone();
    camera.intrinsics = Intrinsics {
        width: 160,
        height: 120,
        fx_px: 112.5,
        fy_px: 112.5,
        cx_px: 80.0,
        cy_px: 60.0,
        ..Intrinsics::RAVENS
    };
    camera
}

proptest! {
    #[test]
    fn a_box_looks_like_the_rays_say(
        size_m in prop::array::uniform3(0.02..0.3),
        position in prop::array::uniform3(-0.15..0.15),
        rotation in prop::array::uniform3(-3.0..3.0),
    ) {
        let (camera, size_m) = (quick(), Vector3::from(size_m));
        let pose = Isometry3::new(Vector3::from(position) + Vector3::new(0.4, 0.0, 0.1), rotation.into());
        let image = render(&alone(Mesh::cuboid(size_m), pose), &camera);
        let (wrong, _) = disagreement(&camera, &image, |point| {
            let (eye, ray) = ray(&camera, point, &pose);
            enter_cuboid(&eye, &ray, &size_m)
        });
        // Only where a ray meets an edge.
        prop_assert!(wrong <= 2, "{wrong}");
    }

    #[test]
    fn nothing_breaks_however_wild_the_scene(
        size_m in prop::array::uniform3(prop::sample::select(vec![1e-9, 0.01, 0.5, 30.0, 1e6])),
        position in prop::array::uniform3(prop::sample::select(vec![-1e300, -1e6, -1.0, 0.0, 0.3, 1.0, 1e12])),
        rotation in prop::array::uniform3(-3.0..3.0),
    ) {
        let pose = Isometry3::new(position.into(), rotation.into());
        let mut scene = alone(Mesh::cuboid(size_m.into()), pose);
        let round = scene.add_mesh(Mesh::capsule(size_m[0], size_m[1], 16));
        scene.add(round, pose, RED);
        let image = render(&scene, &quick());
        let good = |depth_m: f32| depth_m == 0.0 || (NEAR_M as f32 * 0.999..=FAR_M as f32).contains(&depth_m);
        prop_assert!(image.depth_m.iter().all(|d| good(*d)));
    }
}
