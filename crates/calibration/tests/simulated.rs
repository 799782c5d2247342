//! Calibration of the cameras of Ravens from rendered images with the noise of real cameras.

use calibration::{
    Board, CameraViews, GrayImage, View, board_pose, check_swapped, detect, gray_pixels, solve,
    table,
};
use camera_noise::{Perturbation, Rig};
use heightmap::{Camera, Distortion};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::f64::consts::PI;

const BOARD: Board = Board::A4;

fn realsense() -> Perturbation {
    let path = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../config/perturbations/realsense.yaml"
    );
    Perturbation::load(path.as_ref()).unwrap()
}

/// The cameras, each with a lens.
fn cameras() -> [Camera; 3] {
    let mut cameras = Camera::ravens();
    for (camera, k1) in cameras.iter_mut().zip([0.05, -0.04, 0.0]) {
        camera.intrinsics.distortion = Distortion::plumb_bob([k1, 0.0, 0.0005, 0.0, 0.0]);
    }
    cameras
}

/// The grey image that a camera takes of the board: lens, pixels that are areas, noise.
fn image(
    camera: &Camera,
    world_from_board: &Isometry3<f64>,
    noise: &Rig,
    index: usize,
    frame: u64,
) -> Vec<u8> {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    // A grey table with some texture.
    let mut rgb: Vec<u8> = (0..width * height)
        .flat_map(|i| [70 + ((i % width / 40 + i / width / 40) % 2 * 15) as u8; 3])
        .collect();
    BOARD.draw(camera, world_from_board, (190.0, 35.0), &mut rgb);
    let mut depth_m = vec![1.0; width * height];
    noise.apply(index, &camera.intrinsics, frame, &mut rgb, &mut depth_m);
    gray_pixels(&rgb)
}

/// The board over the table, facing up, tilted and turned.
fn board_poses(count: usize, rng: &mut ChaCha8Rng) -> Vec<Isometry3<f64>> {
    (0..count)
        .map(|_| {
            let mut within = |size: f64| rng.random_range(-size..size);
            let tilt = UnitQuaternion::from_euler_angles(within(0.35), within(0.35), within(1.2));
            let rotation = tilt * UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI);
            let middle = Vector3::new(0.42 + within(0.08), within(0.1), 0.12 + within(0.06));
            let to_middle = rotation * Vector3::new(0.14, 0.09, 0.0);
            Isometry3::from_parts(Translation3::from(middle - to_middle), rotation)
        })
        .collect()
}

fn tool_from_board() -> Isometry3<f64> {
    Isometry3::from_parts(
        Translation3::new(-0.13, 0.08, 0.015),
        UnitQuaternion::from_euler_angles(0.1, PI - 0.05, 0.4),
    )
}

/// A pose off by so much in random directions.
fn off(pose: &Isometry3<f64>, shift_m: f64, turn_rad: f64, rng: &mut ChaCha8Rng) -> Isometry3<f64> {
    let mut direction = |size: f64| {
        let mut part = || rng.random_range(-1.0..1.0f64);
        let vector = Vector3::new(part(), part(), part());
        vector.normalize() * size
    };
    let shift = direction(shift_m);
    let turn = UnitQuaternion::from_scaled_axis(direction(turn_rad));
    Isometry3::from_parts(
        Translation3::from(pose.translation.vector + shift),
        turn * pose.rotation,
    )
}

struct Recording {
    cameras: [Camera; 3],
    views: Vec<CameraViews>,
    /// As the robot says, which is right within its repeatability.
    world_from_tool: Vec<Isometry3<f64>>,
}

fn record(seed: u64, poses: usize) -> Recording {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let cameras = cameras();
    let noise = Rig::draw(&realsense(), &cameras, seed, 0);
    let boards = board_poses(poses, &mut rng);
    let views = cameras.iter().enumerate().map(|(index, camera)| {
        let views = boards.iter().enumerate().filter_map(|(pose, board)| {
            let pixels = image(camera, board, &noise, index, pose as u64);
            let image = GrayImage {
                width: camera.intrinsics.width,
                height: camera.intrinsics.height,
                pixels: &pixels,
            };
            let board = board_pose(&BOARD, &camera.intrinsics, &detect(&image))?;
            Some(View { pose, board })
        });
        CameraViews {
            name: camera.name.clone(),
            intrinsics: camera.intrinsics,
            views: views.collect(),
        }
    });
    let views = views.collect();
    // The repeatability of a UR5e, and as much for the joints' angles.
    let world_from_tool = boards
        .iter()
        .map(|board| off(&(board * tool_from_board().inverse()), 3e-5, 3e-5, &mut rng));
    let world_from_tool = world_from_tool.collect();
    Recording {
        cameras,
        views,
        world_from_tool,
    }
}

#[test]
fn corners_of_tags_are_found_to_a_tenth_of_a_pixel() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let cameras = cameras();
    let noise = Rig::draw(&realsense(), &cameras, 3, 0);
    let (mut squares, mut count, mut worst) = (0.0, 0, 0.0f64);
    for (frame, board) in board_poses(8, &mut rng).iter().enumerate() {
        for (index, camera) in cameras.iter().enumerate() {
            let pixels = image(camera, board, &noise, index, frame as u64);
            let tags = detect(&GrayImage {
                width: 640,
                height: 480,
                pixels: &pixels,
            });
            for tag in &tags {
                let corners = BOARD.corners(tag.id).expect("no other tags are there");
                for (corner, found) in corners.iter().zip(&tag.corners_px) {
                    let (expected, _) = camera.project(&(board * corner)).unwrap();
                    let error = (found - expected).norm();
                    squares += error * error;
                    worst = worst.max(error);
                    count += 1;
                }
            }
        }
    }
    let rms = (squares / f64::from(count)).sqrt();
    println!(
        "{count} corners of {}, {rms:.3} px rms, {worst:.3} px at most",
        24 * 24
    );
    assert!(count > 24 * 24 * 8 / 10, "{count}");
    assert!(rms < 0.12 && worst < 0.6, "{rms} {worst}");
}

#[test]
fn an_image_without_a_board_has_no_tags() {
    let noise = Rig::draw(&realsense(), &cameras(), 5, 0);
    let away = Isometry3::translation(9.0, 9.0, -1.0);
    let pixels = image(&cameras()[0], &away, &noise, 0, 0);
    assert_eq!(
        detect(&GrayImage {
            width: 640,
            height: 480,
            pixels: &pixels
        }),
        []
    );
}

#[test]
fn a_calibration_wrong_by_5_mm_and_half_a_degree_is_found_to_half_a_millimetre_and_a_twentieth_of_a_degree()
 {
    for seed in 0..4 {
        let recording = record(seed, 15);
        let calibration = solve(&recording.views, &recording.world_from_tool).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(100 + seed);
        for (camera, found) in recording.cameras.iter().zip(&calibration.cameras) {
            let truth = &camera.world_from_camera;
            let believed = off(truth, 5e-3, 0.5f64.to_radians(), &mut rng);
            // What is wrong with the calibration in use, as it is, and as it is found.
            let is = believed.inv_mul(truth);
            let seen = believed.inv_mul(&found.world_from_camera);
            let shift_m = (is.translation.vector - seen.translation.vector).norm();
            let turn_deg = is.rotation.angle_to(&seen.rotation).to_degrees();
            println!(
                "{seed} {}: {:.3} mm, {turn_deg:.4} degrees; {} views, {:.3} px, sigma {:.3} mm {:.4} degrees",
                camera.name,
                1e3 * shift_m,
                found.views,
                found.rms_px,
                1e3 * found.position_sigma_m,
                found.rotation_sigma_rad.to_degrees()
            );
            assert!(
                shift_m < 0.5e-3 && turn_deg < 0.05,
                "seed {seed}, {}: {shift_m} m, {turn_deg} degrees",
                camera.name
            );
            // It says how well it knows.
            assert!(
                shift_m < 6.0 * found.position_sigma_m + 1e-4,
                "{shift_m} {}",
                found.position_sigma_m
            );
        }
        let known: Vec<_> = recording
            .cameras
            .iter()
            .map(|camera| (camera.name.clone(), camera.world_from_camera))
            .collect();
        check_swapped(&calibration, &known).unwrap();
        let board = calibration.tool_from_board.inv_mul(&tool_from_board());
        assert!(
            board.translation.vector.norm() < 5e-4 && board.rotation.angle() < 1e-3,
            "{board}"
        );
    }
}

#[test]
fn wrong_poses_of_the_tool_are_left_out_and_named() {
    let mut recording = record(7, 15);
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    for pose in [2, 9, 13] {
        recording.world_from_tool[pose] =
            off(&recording.world_from_tool[pose], 0.03, 0.05, &mut rng);
    }
    let calibration = solve(&recording.views, &recording.world_from_tool).unwrap();
    for (camera, found) in recording.cameras.iter().zip(&calibration.cameras) {
        let off = camera.world_from_camera.inv_mul(&found.world_from_camera);
        assert!(off.translation.vector.norm() < 0.5e-3, "{off}");
        let seen = |pose: &usize| {
            recording
                .views
                .iter()
                .any(|camera| camera.views.iter().any(|view| view.pose == *pose))
        };
        assert!(
            found.left_out.iter().all(|pose| [2, 9, 13].contains(pose)),
            "{:?}",
            found.left_out
        );
        assert!(!found.left_out.is_empty() && [2, 9, 13].iter().any(seen));
    }
}

#[test]
fn what_cannot_be_a_calibration_is_refused_by_name() {
    let recording = record(11, 12);
    let refusal = |views: &[CameraViews], poses: &[Isometry3<f64>]| {
        solve(views, poses).unwrap_err().to_string()
    };
    // A board that one camera alone sees.
    let mut views = recording.views.clone();
    views[1].views.truncate(2);
    views[2].views.clear();
    let error = refusal(&views, &recording.world_from_tool);
    assert!(
        error.contains("seen by front only") && error.contains("left"),
        "{error}"
    );
    // Poses by the kinematics of an arm whose links are longer.
    let longer: Vec<_> = recording
        .world_from_tool
        .iter()
        .map(|pose| {
            let mut pose = *pose;
            let reach = pose.translation.vector;
            pose.translation.vector = reach * 1.2 + Vector3::new(0.0, 0.0, 0.1 * reach.x * reach.x);
            pose
        })
        .collect();
    let error = refusal(&recording.views, &longer);
    assert!(
        error.contains("another robot") && error.contains("camera"),
        "{error}"
    );
    // The board is turned about one axis only.
    let still: Vec<_> = recording
        .world_from_tool
        .iter()
        .enumerate()
        .map(|(i, pose)| {
            let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.1 * i as f64);
            Isometry3::from_parts(
                pose.translation,
                turn * recording.world_from_tool[0].rotation,
            )
        })
        .collect();
    let error = refusal(&recording.views, &still);
    assert!(error.contains("second axis"), "{error}");
    // Cameras that were swapped.
    let mut swapped = recording.views.clone();
    let left = swapped[1].name.clone();
    swapped[1].name = std::mem::replace(&mut swapped[2].name, left);
    let calibration = solve(&swapped, &recording.world_from_tool).unwrap();
    let known: Vec<_> = recording
        .cameras
        .iter()
        .map(|camera| (camera.name.clone(), camera.world_from_camera))
        .collect();
    let error = check_swapped(&calibration, &known).unwrap_err().to_string();
    assert!(
        error.contains("left") && error.contains("right") && error.contains("swapped"),
        "{error}"
    );
}

#[test]
fn a_tilted_table_is_refused_and_a_level_one_measured() {
    let cameras = cameras();
    let noise = Rig::draw(&realsense(), &cameras, 21, 0);
    let views = |tilt_rad: f64| {
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), tilt_rad)
            * UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI);
        let board = Isometry3::from_parts(Translation3::new(0.3, 0.1, 0.002), rotation);
        let views = cameras.iter().enumerate().filter_map(|(index, camera)| {
            let pixels = image(camera, &board, &noise, index, 0);
            let tags = detect(&GrayImage {
                width: 640,
                height: 480,
                pixels: &pixels,
            });
            Some((
                camera.world_from_camera,
                board_pose(&BOARD, &camera.intrinsics, &tags)?,
            ))
        });
        views.collect::<Vec<_>>()
    };
    let most_rad = 0.5f64.to_radians();
    let level = views(0.0);
    assert_eq!(level.len(), 3);
    let pairs: Vec<_> = level.iter().map(|(pose, view)| (*pose, view)).collect();
    let found = table(&pairs, most_rad).unwrap().unwrap();
    assert!(
        found.tilt_rad < 0.2f64.to_radians() && (found.height_m - 0.002).abs() < 1e-3,
        "{found:?}"
    );
    let tilted = views(0.02);
    let pairs: Vec<_> = tilted.iter().map(|(pose, view)| (*pose, view)).collect();
    let error = table(&pairs, most_rad).unwrap_err().to_string();
    assert!(error.contains("table is tilted by 1."), "{error}");
    assert_eq!(table(&[], most_rad), Ok(None));
}
