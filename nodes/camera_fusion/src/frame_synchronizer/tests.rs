use super::*;
use heightmap::{Distortion, Intrinsics};
use msgs::{geometry_msgs::TransformStamped, std_msgs::Header};
use nalgebra::{Translation3, UnitQuaternion, Vector3};

const CAMERA: Intrinsics = Intrinsics {
    width: 64,
    height: 48,
    fx_px: 30.0,
    fy_px: 30.0,
    cx_px: 31.5,
    cy_px: 23.5,
    distortion: Distortion::NONE,
};

fn views() -> FrameSynchronizer {
    let parameters = CameraFusionParameters {
        cameras: vec!["front".into(), "left".into()],
        tolerance_s: 0.02,
        ..CameraFusionParameters::default()
    };
    FrameSynchronizer::new(&parameters, BTreeMap::new())
}

fn header(stamp: Duration, frame: &str) -> Header {
    convert::header(stamp, frame).unwrap()
}

/// Cameras a metre above the middle of the table, looking down.
fn extrinsics(frames: &[&str]) -> TFMessage {
    let pose = Isometry3::from_parts(
        Translation3::new(0.5, 0.0, 1.0),
        UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI),
    );
    TFMessage {
        transforms: frames
            .iter()
            .map(|frame| TransformStamped {
                header: header(Duration::ZERO, "world"),
                child_frame_id: (*frame).into(),
                transform: convert::isometry_to_msg(&pose),
            })
            .collect(),
    }
}

fn color(stamp: Duration, frame: &str) -> Image {
    let rgb = vec![100; 3 * CAMERA.width * CAMERA.height];
    convert::color_to_msg(header(stamp, frame), &CAMERA, rgb).unwrap()
}

/// A plane at this height.
fn depth(stamp: Duration, frame: &str, height_m: f32) -> Image {
    let depth_m = vec![1.0 - height_m; CAMERA.width * CAMERA.height];
    convert::depth_to_msg(header(stamp, frame), &CAMERA, &depth_m).unwrap()
}

fn calibrate(views: &mut FrameSynchronizer) {
    for camera in 0..2 {
        let info = convert::intrinsics_to_msg(Header::default(), &CAMERA);
        views.calibrate(camera, Stream::Info, &info).unwrap();
    }
}

fn ready() -> FrameSynchronizer {
    let mut views = views();
    assert!(views.transform(extrinsics(&["front", "left"])).is_empty());
    calibrate(&mut views);
    views
}

fn send(views: &mut FrameSynchronizer, camera: usize, stamp_ms: u64) {
    let frame = ["front", "left"][camera];
    let stamp = Duration::from_millis(stamp_ms);
    views
        .image(camera, Stream::Color, color(stamp, frame))
        .unwrap();
    views
        .image(camera, Stream::Depth, depth(stamp, frame, 0.05))
        .unwrap();
}

fn fused_stamp_ms(views: &mut FrameSynchronizer) -> Option<u128> {
    let (fused, complaints) = views.fuse();
    assert!(complaints.is_empty(), "{complaints:?}");
    let fused = fused?;
    Some(
        convert::time_from_msg(&fused.message.header.stamp)
            .unwrap()
            .as_millis(),
    )
}

#[test]
fn views_of_one_stamp_become_one_heightmap() {
    let mut views = ready();
    send(&mut views, 0, 1000);
    assert_eq!(views.fuse(), (None, vec![]));
    send(&mut views, 1, 1000);
    let fused = views.fuse().0.unwrap();
    assert_eq!(fused.message.views, 2);
    assert_eq!(fused.message.header.frame_id, "world");
    assert!(fused.message.coverage > 0.0);
    let top = fused.message.height_m.iter().copied().fold(0.0, f32::max);
    assert!((top - 0.05).abs() < 1e-4, "{top}");
}

#[test]
fn a_repeated_frame_is_fused_once() {
    let mut views = ready();
    for _ in 0..3 {
        send(&mut views, 0, 1000);
        send(&mut views, 1, 1000);
    }
    assert_eq!(fused_stamp_ms(&mut views), Some(1000));
    send(&mut views, 0, 1000);
    send(&mut views, 1, 1000);
    assert_eq!(fused_stamp_ms(&mut views), None);
}

#[test]
fn stamps_within_the_tolerance_match_and_others_do_not() {
    let mut views = ready();
    send(&mut views, 0, 1000);
    send(&mut views, 1, 1021);
    assert_eq!(fused_stamp_ms(&mut views), None);
    send(&mut views, 0, 1033);
    // 1021 and 1033 match; the heightmap has the stamp of its newest view.
    assert_eq!(fused_stamp_ms(&mut views), Some(1033));
    send(&mut views, 1, 1020);
    assert_eq!(fused_stamp_ms(&mut views), None);
}

#[test]
fn the_newest_set_is_fused_and_older_ones_are_not() {
    let mut views = ready();
    for stamp_ms in [1000, 1100, 1200] {
        send(&mut views, 0, stamp_ms);
    }
    for stamp_ms in [1000, 1200, 1100] {
        send(&mut views, 1, stamp_ms);
    }
    assert_eq!(fused_stamp_ms(&mut views), Some(1200));
    assert_eq!(fused_stamp_ms(&mut views), None);
}

#[test]
fn a_heightmap_says_which_images_it_was_made_from() {
    let mut views = ready();
    send(&mut views, 0, 1000);
    send(&mut views, 0, 1033);
    send(&mut views, 1, 1021);
    let fused = views.fuse().0.unwrap();
    let at = |stamp_ms| {
        let stamp = Duration::from_millis(stamp_ms);
        Some(Used {
            color: stamp,
            depth: stamp,
        })
    };
    assert_eq!(fused.used, [at(1033), at(1021)]);
    assert_eq!(fused.stamp, Duration::from_millis(1033));
}

#[test]
fn a_silent_camera_is_waited_for_unless_the_others_are_enough() {
    for without in [false, true] {
        let parameters = CameraFusionParameters {
            cameras: vec!["front".into(), "left".into()],
            fuse_without_silent: without,
            ..CameraFusionParameters::default()
        };
        let mut views = FrameSynchronizer::new(&parameters, BTreeMap::new());
        views.transform(extrinsics(&["front", "left"]));
        calibrate(&mut views);
        send(&mut views, 0, 1000);
        assert_eq!(views.fuse(), (None, vec![]));
        views.set_silent(1, true);
        let (fused, _) = views.fuse();
        assert_eq!(fused.is_some(), without);
        if let Some(fused) = fused {
            assert_eq!((fused.message.views, fused.used[1]), (1, None));
        }
        // It comes back: both again.
        views.set_silent(1, false);
        send(&mut views, 0, 1100);
        assert_eq!(views.fuse(), (None, vec![]));
        send(&mut views, 1, 1100);
        assert_eq!(views.fuse().0.unwrap().message.views, 2);
    }
}

#[test]
fn cameras_of_different_rates_are_fused_at_the_slowest_rate() {
    let mut views = ready();
    // 30 Hz and 10 Hz, not in step, and the slow one's images take 60 ms to arrive.
    let mut arrivals: Vec<(u64, usize, u64)> = (0..90)
        .map(|n| (1000 + n * 100 / 3, 0, 1000 + n * 100 / 3))
        .collect();
    arrivals.extend((0..30).map(|n| (1072 + n * 100, 1, 1012 + n * 100)));
    arrivals.sort_unstable();
    let mut heightmaps = 0;
    for (_, camera, stamp_ms) in arrivals {
        send(&mut views, camera, stamp_ms);
        if let Some(fused) = views.fuse().0 {
            let [front, left] = [0, 1].map(|camera| fused.used[camera].unwrap().color);
            assert!(front.abs_diff(left) <= Duration::from_millis(20));
            heightmaps += 1;
        }
    }
    assert_eq!(heightmaps, 30);
}

#[test]
fn a_clock_that_is_set_back_starts_anew() {
    let mut views = ready();
    send(&mut views, 0, 90_000);
    send(&mut views, 1, 90_000);
    assert_eq!(fused_stamp_ms(&mut views), Some(90_000));
    send(&mut views, 0, 1000);
    send(&mut views, 1, 1000);
    assert_eq!(fused_stamp_ms(&mut views), Some(1000));
}

#[test]
fn without_extrinsics_the_frame_is_named_and_later_ones_help() {
    let mut views = views();
    calibrate(&mut views);
    views.transform(extrinsics(&["front"]));
    send(&mut views, 0, 1000);
    send(&mut views, 1, 1000);
    let complaints = views.fuse().1;
    assert_eq!((complaints.len(), complaints[0].camera), (1, 1));
    assert!(complaints[0].reason.contains("\"left\""), "{complaints:?}");
    assert!(complaints[0].pending);
    views.transform(extrinsics(&["left"]));
    assert_eq!(fused_stamp_ms(&mut views), Some(1000));
}

#[test]
fn images_of_later_stamps_that_cannot_be_used_hold_up_no_others() {
    let mut views = ready();
    let later = Duration::from_secs(3);
    for camera in 0..2 {
        let (color, depth) = (color(later, ""), depth(later, "", 0.05));
        views.image(camera, Stream::Color, color).unwrap();
        views.image(camera, Stream::Depth, depth).unwrap();
    }
    for stamp_ms in [1000, 1100] {
        send(&mut views, 0, stamp_ms);
        send(&mut views, 1, stamp_ms);
        let (fused, complaints) = views.fuse();
        assert_eq!(fused.unwrap().stamp, Duration::from_millis(stamp_ms));
        assert_eq!(complaints.len(), 2, "{complaints:?}");
    }
}

#[test]
fn a_bad_image_is_complained_about_once_and_the_next_set_is_fused() {
    let mut views = ready();
    send(&mut views, 0, 1000);
    send(&mut views, 1, 1000);
    let mut truncated = color(Duration::from_millis(1000), "left");
    truncated.data.truncate(100);
    views.image(1, Stream::Color, truncated).unwrap();
    let complaints = views.fuse().1;
    assert_eq!(
        (complaints[0].camera, complaints[0].stream),
        (1, Stream::Color)
    );
    assert!(complaints[0].reason.contains("data"), "{complaints:?}");
    assert_eq!(views.fuse(), (None, vec![]));
    send(&mut views, 0, 1100);
    send(&mut views, 1, 1100);
    assert_eq!(fused_stamp_ms(&mut views), Some(1100));
}

#[test]
fn a_bad_calibration_is_refused_and_nothing_is_fused_until_a_good_one_arrives() {
    let mut views = ready();
    let mut info = convert::intrinsics_to_msg(Header::default(), &CAMERA);
    info.k[0] = 0.0;
    let error = views.calibrate(1, Stream::Info, &info).unwrap_err();
    assert_eq!((error.camera, error.stream), (1, Stream::Info));
    send(&mut views, 0, 1000);
    send(&mut views, 1, 1000);
    assert_eq!(views.fuse().1[0].stream, Stream::Info);
    calibrate(&mut views);
    assert_eq!(fused_stamp_ms(&mut views), Some(1000));
}

#[test]
fn holes_in_the_depth_leave_a_finite_heightmap() {
    let mut views = ready();
    let stamp = Duration::from_millis(1000);
    for (camera, frame) in ["front", "left"].into_iter().enumerate() {
        let mut depth_m = vec![0.9; CAMERA.width * CAMERA.height];
        for (index, hole) in [f32::NAN, 0.0, f32::INFINITY].into_iter().enumerate() {
            depth_m[100 + index] = hole;
        }
        let depth = convert::depth_to_msg(header(stamp, frame), &CAMERA, &depth_m).unwrap();
        views.image(camera, Stream::Depth, depth).unwrap();
        views
            .image(camera, Stream::Color, color(stamp, frame))
            .unwrap();
    }
    let fused = views.fuse().0.unwrap();
    assert!(
        fused
            .message
            .height_m
            .iter()
            .all(|height| height.is_finite())
    );
}

#[test]
fn with_several_frames_a_heightmap_is_their_median_and_waits_until_nothing_moves() {
    let parameters = CameraFusionParameters {
        cameras: vec!["front".into(), "left".into()],
        frames: 3,
        ..CameraFusionParameters::default()
    };
    let mut views = FrameSynchronizer::new(&parameters, BTreeMap::new());
    views.transform(extrinsics(&["front", "left"]));
    // A point in every cell that it sees.
    let dense = Intrinsics {
        width: 160,
        height: 120,
        fx_px: 300.0,
        fy_px: 300.0,
        cx_px: 79.5,
        cy_px: 59.5,
        ..CAMERA
    };
    let info = convert::intrinsics_to_msg(Header::default(), &dense);
    for camera in 0..2 {
        views.calibrate(camera, Stream::Info, &info).unwrap();
    }
    let mut fuse = |stamp_ms: u64, height_m: f32| {
        let stamp = Duration::from_millis(stamp_ms);
        for (camera, frame) in ["front", "left"].into_iter().enumerate() {
            let header = || header(stamp, frame);
            let rgb = vec![100; 3 * dense.len()];
            let color = convert::color_to_msg(header(), &dense, rgb).unwrap();
            views.image(camera, Stream::Color, color).unwrap();
            let depth_m = vec![1.0 - height_m; dense.len()];
            let depth = convert::depth_to_msg(header(), &dense, &depth_m).unwrap();
            views.image(camera, Stream::Depth, depth).unwrap();
        }
        let (fused, complaints) = views.fuse();
        assert_eq!(complaints, []);
        fused.map(|fused| {
            let heights = fused.message.height_m.iter().copied();
            (fused.stamp.as_millis(), heights.fold(0.0, f32::max))
        })
    };
    assert_eq!(fuse(1000, 0.050), None);
    assert_eq!(fuse(1033, 0.054), None);
    let (stamp_ms, height_m) = fuse(1066, 0.051).unwrap();
    assert_eq!(stamp_ms, 1066);
    assert!((height_m - 0.051).abs() < 1e-4, "{height_m}");
    // Something has moved: three frames of the new scene.
    assert_eq!(fuse(1100, 0.100), None);
    assert_eq!(fuse(1133, 0.101), None);
    let (stamp_ms, height_m) = fuse(1166, 0.099).unwrap();
    assert_eq!(stamp_ms, 1166);
    assert!((height_m - 0.1).abs() < 1e-4, "{height_m}");
}

/// Both cameras, with this depth image of the second one.
fn fuse_with_depth(
    views: &mut FrameSynchronizer,
    depth: Image,
) -> (Option<Fused>, Vec<InputError>) {
    send(views, 0, 1000);
    send(views, 1, 1000);
    views.image(1, Stream::Depth, depth).unwrap();
    views.fuse()
}

const HALF: Intrinsics = Intrinsics {
    width: 32,
    height: 24,
    fx_px: 15.0,
    fy_px: 15.0,
    cx_px: 15.5,
    cy_px: 11.5,
    distortion: Distortion::NONE,
};

fn half_depth(frame: &str) -> Image {
    let stamp = Duration::from_millis(1000);
    let depth_m = vec![0.95; HALF.len()];
    convert::depth_to_msg(header(stamp, frame), &HALF, &depth_m).unwrap()
}

#[test]
fn depth_of_another_size_in_the_colour_frame_is_scaled() {
    let (fused, complaints) = fuse_with_depth(&mut ready(), half_depth("left"));
    assert_eq!(complaints, []);
    let whole = fuse_with_depth(
        &mut ready(),
        depth(Duration::from_millis(1000), "left", 0.05),
    );
    assert_eq!(fused.unwrap().message, whole.0.unwrap().message);
    // A crop shows something else.
    let crop = Intrinsics {
        width: 48,
        ..CAMERA
    };
    let stamp = Duration::from_millis(1000);
    let image = convert::depth_to_msg(header(stamp, "left"), &crop, &vec![0.95; crop.len()]);
    let (fused, complaints) = fuse_with_depth(&mut ready(), image.unwrap());
    assert_eq!((fused, complaints.len()), (None, 1));
    let reason = &complaints[0].reason;
    assert!(
        reason.contains("48 and 48, expected") && reason.contains("64 and 48"),
        "{reason}"
    );
}

#[test]
fn depth_of_a_frame_of_its_own_is_registered_when_transforms_and_its_calibration_are_there() {
    let mut views = ready();
    let (fused, complaints) = fuse_with_depth(&mut views, half_depth("left_depth"));
    assert_eq!((fused, complaints.len()), (None, 1));
    assert!(complaints[0].pending);
    for word in ["\"left_depth\"", "\"left\"", "registered"] {
        assert!(complaints[0].reason.contains(word), "{complaints:?}");
    }
    // Its camera is 10 cm further up than the colour camera.
    let mut pose = extrinsics(&["left_depth"]);
    pose.transforms[0].transform.translation.z = 1.1;
    views.transform(pose);
    let (fused, complaints) = views.fuse();
    assert_eq!((fused, complaints[0].stream), (None, Stream::DepthInfo));
    assert!(complaints[0].pending, "{complaints:?}");
    let info = convert::intrinsics_to_msg(Header::default(), &HALF);
    views.calibrate(1, Stream::DepthInfo, &info).unwrap();
    let (fused, complaints) = views.fuse();
    assert_eq!(complaints, []);
    // 0.95 m below 1.1 m.
    let height_m = fused.unwrap().message.height_m;
    let top = height_m.iter().copied().fold(0.0, f32::max);
    assert!((top - 0.15).abs() < 1e-4, "{top}");
    // A calibration of another size is refused by name.
    let other = convert::intrinsics_to_msg(Header::default(), &CAMERA);
    views.calibrate(1, Stream::DepthInfo, &other).unwrap();
    send(&mut views, 0, 1100);
    send(&mut views, 1, 1100);
    let mut late = half_depth("left_depth");
    late.header = header(Duration::from_millis(1100), "left_depth");
    views.image(1, Stream::Depth, late).unwrap();
    let complaints = views.fuse().1;
    assert!(
        complaints[0].reason.contains("calibration"),
        "{complaints:?}"
    );
}

#[test]
fn a_flood_of_unmatched_images_takes_no_more_memory_than_a_few() {
    let mut views = ready();
    for stamp_ms in 0..1000 {
        send(&mut views, 0, 100 * stamp_ms);
    }
    assert!(views.cameras[0].color.len() <= WAITING_IMAGES);
    assert!(views.cameras[0].depth.len() <= WAITING_IMAGES);
}

#[test]
fn a_stamp_that_is_none_is_refused() {
    let mut views = ready();
    let mut image = color(Duration::ZERO, "front");
    image.header.stamp.nanosec = u32::MAX;
    let error = views.image(0, Stream::Color, image).unwrap_err();
    assert!(error.reason.starts_with("header.stamp"), "{error:?}");
}
