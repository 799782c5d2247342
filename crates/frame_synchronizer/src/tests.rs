use super::*;
use heightmap::Distortion;
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

/// An image of one colour, or of a plane at one depth.
#[derive(Clone, Debug)]
struct Picture {
    frame: String,
    size_px: (usize, usize),
    rgb: Vec<u8>,
    depth_m: Vec<f32>,
}

impl Image for Picture {
    type Error = String;

    fn frame(&self) -> &str {
        &self.frame
    }

    fn size_px(&self) -> (usize, usize) {
        self.size_px
    }

    fn read_color(&self, intrinsics: &Intrinsics, rgb: &mut Vec<u8>) -> Result<(), String> {
        if self.rgb.len() != 3 * intrinsics.len() {
            return Err(format!("data has {} bytes", self.rgb.len()));
        }
        rgb.clone_from(&self.rgb);
        Ok(())
    }

    fn read_depth(&self, depth_m: &mut Vec<f32>) -> Result<(), String> {
        depth_m.clone_from(&self.depth_m);
        Ok(())
    }
}

type Views = FrameSynchronizer<Picture>;

fn settings() -> Settings {
    Settings {
        cameras: vec!["front".into(), "left".into()],
        world_frame: "world".into(),
        tolerance: Duration::from_millis(20),
        workspace: Workspace::RAVENS,
        still: None,
        fuse_without_silent: false,
    }
}

fn views() -> Views {
    FrameSynchronizer::new(settings(), BTreeMap::new())
}

/// A camera above the middle of the table at this height, looking down.
fn pose(z_m: f64) -> Isometry3<f64> {
    Isometry3::from_parts(
        Translation3::new(0.5, 0.0, z_m),
        UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI),
    )
}

/// Cameras a metre above the table.
fn place(views: &mut Views, frames: &[&str]) {
    for frame in frames {
        views.transform("world", frame, pose(1.0)).unwrap();
    }
}

fn color(frame: &str, intrinsics: &Intrinsics) -> Picture {
    Picture {
        frame: frame.into(),
        size_px: (intrinsics.width, intrinsics.height),
        rgb: vec![100; 3 * intrinsics.len()],
        depth_m: Vec::new(),
    }
}

/// A plane at this depth.
fn depth(frame: &str, intrinsics: &Intrinsics, depth_m: f32) -> Picture {
    Picture {
        frame: frame.into(),
        size_px: (intrinsics.width, intrinsics.height),
        rgb: Vec::new(),
        depth_m: vec![depth_m; intrinsics.len()],
    }
}

fn calibrate(views: &mut Views) {
    for camera in 0..2 {
        views.calibrate(camera, Stream::Info, Ok(CAMERA)).unwrap();
    }
}

fn ready() -> Views {
    let mut views = views();
    place(&mut views, &["front", "left"]);
    calibrate(&mut views);
    views
}

fn send(views: &mut Views, camera: usize, stamp_ms: u64) {
    let frame = ["front", "left"][camera];
    let stamp = Duration::from_millis(stamp_ms);
    views.image(camera, Stream::Color, stamp, color(frame, &CAMERA));
    views.image(camera, Stream::Depth, stamp, depth(frame, &CAMERA, 0.95));
}

fn fused_stamp_ms(views: &mut Views) -> Option<u128> {
    let (fused, complaints) = views.fuse();
    assert!(complaints.is_empty(), "{complaints:?}");
    Some(fused?.stamp.as_millis())
}

#[test]
fn views_of_one_stamp_become_one_heightmap() {
    let mut views = ready();
    send(&mut views, 0, 1000);
    assert_eq!(views.fuse(), (None, vec![]));
    send(&mut views, 1, 1000);
    let fused = views.fuse().0.unwrap();
    assert_eq!(fused.report.views, 2);
    assert!(fused.report.coverage > 0.0);
    let top = fused.heightmap.height_m.iter().copied().fold(0.0, f32::max);
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
        let settings = Settings {
            fuse_without_silent: without,
            ..settings()
        };
        let mut views = FrameSynchronizer::new(settings, BTreeMap::new());
        place(&mut views, &["front", "left"]);
        calibrate(&mut views);
        send(&mut views, 0, 1000);
        assert_eq!(views.fuse(), (None, vec![]));
        views.set_silent(1, true);
        let (fused, _) = views.fuse();
        assert_eq!(fused.is_some(), without);
        if let Some(fused) = fused {
            assert_eq!((fused.report.views, fused.used[1]), (1, None));
        }
        // It comes back: both again.
        views.set_silent(1, false);
        send(&mut views, 0, 1100);
        assert_eq!(views.fuse(), (None, vec![]));
        send(&mut views, 1, 1100);
        assert_eq!(views.fuse().0.unwrap().report.views, 2);
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
    place(&mut views, &["front"]);
    send(&mut views, 0, 1000);
    send(&mut views, 1, 1000);
    let complaints = views.fuse().1;
    assert_eq!((complaints.len(), complaints[0].camera), (1, 1));
    assert!(complaints[0].reason.contains("\"left\""), "{complaints:?}");
    assert!(complaints[0].pending);
    place(&mut views, &["left"]);
    assert_eq!(fused_stamp_ms(&mut views), Some(1000));
}

#[test]
fn images_of_later_stamps_that_cannot_be_used_hold_up_no_others() {
    let mut views = ready();
    let later = Duration::from_secs(3);
    for camera in 0..2 {
        views.image(camera, Stream::Color, later, color("", &CAMERA));
        views.image(camera, Stream::Depth, later, depth("", &CAMERA, 0.95));
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
    let mut truncated = color("left", &CAMERA);
    truncated.rgb.truncate(100);
    let stamp = Duration::from_millis(1000);
    views.image(1, Stream::Color, stamp, truncated);
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
    let bad = Err("k[0] is 0".to_owned());
    let error = views.calibrate(1, Stream::Info, bad).unwrap_err();
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
        let mut depth = depth(frame, &CAMERA, 0.9);
        for (index, hole) in [f32::NAN, 0.0, f32::INFINITY].into_iter().enumerate() {
            depth.depth_m[100 + index] = hole;
        }
        views.image(camera, Stream::Depth, stamp, depth);
        views.image(camera, Stream::Color, stamp, color(frame, &CAMERA));
    }
    let fused = views.fuse().0.unwrap();
    let mut heights = fused.heightmap.height_m.iter();
    assert!(heights.all(|height| height.is_finite()));
}

#[test]
fn with_several_frames_a_heightmap_is_their_median_and_waits_until_nothing_moves() {
    let settings = Settings {
        still: Some(StillSettings {
            frames: 3,
            ..StillSettings::default()
        }),
        ..settings()
    };
    let mut views = FrameSynchronizer::new(settings, BTreeMap::new());
    place(&mut views, &["front", "left"]);
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
    for camera in 0..2 {
        views.calibrate(camera, Stream::Info, Ok(dense)).unwrap();
    }
    let mut fuse = |stamp_ms: u64, height_m: f32| {
        let stamp = Duration::from_millis(stamp_ms);
        for (camera, frame) in ["front", "left"].into_iter().enumerate() {
            let plane = depth(frame, &dense, 1.0 - height_m);
            views.image(camera, Stream::Color, stamp, color(frame, &dense));
            views.image(camera, Stream::Depth, stamp, plane);
        }
        let (fused, complaints) = views.fuse();
        assert_eq!(complaints, []);
        fused.map(|fused| {
            let heights = fused.heightmap.height_m.iter().copied();
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
    // A disk of 12 mm, which is lower than a motion that is noticed, was carried away while no camera took images.
    assert_eq!(fuse(9000, 0.088), None);
    assert_eq!(fuse(9033, 0.088), None);
    let (stamp_ms, height_m) = fuse(9066, 0.088).unwrap();
    assert_eq!(stamp_ms, 9066);
    assert!((height_m - 0.088).abs() < 1e-4, "{height_m}");
}

/// Both cameras, with this depth image of the second one.
fn fuse_with_depth(views: &mut Views, depth: Picture) -> (Option<Fused>, Vec<InputError>) {
    send(views, 0, 1000);
    send(views, 1, 1000);
    views.image(1, Stream::Depth, Duration::from_millis(1000), depth);
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

fn half_depth(frame: &str) -> Picture {
    depth(frame, &HALF, 0.95)
}

#[test]
fn depth_of_another_size_in_the_color_frame_is_scaled() {
    let (fused, complaints) = fuse_with_depth(&mut ready(), half_depth("left"));
    assert_eq!(complaints, []);
    let whole = fuse_with_depth(&mut ready(), depth("left", &CAMERA, 0.95));
    assert_eq!(fused, whole.0);
    assert!(fused.is_some());
    // A crop shows something else.
    let crop = Intrinsics {
        width: 48,
        ..CAMERA
    };
    let (fused, complaints) = fuse_with_depth(&mut ready(), depth("left", &crop, 0.95));
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
    let placed = views.transform("world", "left_depth", pose(1.1));
    placed.unwrap();
    let (fused, complaints) = views.fuse();
    assert_eq!((fused, complaints[0].stream), (None, Stream::DepthInfo));
    assert!(complaints[0].pending, "{complaints:?}");
    views.calibrate(1, Stream::DepthInfo, Ok(HALF)).unwrap();
    let (fused, complaints) = views.fuse();
    assert_eq!(complaints, []);
    // 0.95 m below 1.1 m.
    let height_m = fused.unwrap().heightmap.height_m;
    let top = height_m.iter().copied().fold(0.0, f32::max);
    assert!((top - 0.15).abs() < 1e-4, "{top}");
    // A calibration of another size is refused by name.
    views.calibrate(1, Stream::DepthInfo, Ok(CAMERA)).unwrap();
    send(&mut views, 0, 1100);
    send(&mut views, 1, 1100);
    let stamp = Duration::from_millis(1100);
    views.image(1, Stream::Depth, stamp, half_depth("left_depth"));
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
