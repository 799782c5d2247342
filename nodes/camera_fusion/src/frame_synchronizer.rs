//! Which images make one heightmap: messages in, a heightmap out, no ROS around it.

use std::{
    collections::{BTreeMap, VecDeque},
    time::Duration,
};

use heightmap::{
    BlobRule, Camera, ChangeRules, Fusion, FusionError, FusionReport, Heightmap, Intrinsics,
    StillFusion, StillSettings, View, has_shape_of, largest_change, register_depth, scale_depth,
};
use msgs::{
    convert, sctn_msgs,
    sensor_msgs::{CameraInfo, Image},
    tf2_msgs::TFMessage,
};
use nalgebra::Isometry3;

use crate::{
    extrinsics::{Transforms, plain},
    parameters::CameraFusionParameters,
};

/// Images of one stream that wait for their counterparts.
const WAITING_IMAGES: usize = 4;
/// A stamp this much older than the last heightmap's means that the clock was set back.
const CLOCK_SET_BACK: Duration = Duration::from_secs(1);

/// A stream of one camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stream {
    /// Colour images.
    Color,
    /// Depth images.
    Depth,
    /// Calibration of the colour image.
    Info,
    /// Calibration of the depth image, needed where it has a frame of its own.
    DepthInfo,
}

/// Why something that arrived cannot be used.
#[derive(Clone, Debug, PartialEq)]
pub struct InputError {
    /// Index of the camera.
    pub camera: usize,
    /// Its stream.
    pub stream: Stream,
    /// The field, what it is and what was expected.
    pub reason: String,
    /// Something is missing that is sent once and may still be on its way, as a transform while the cameras start: worth a word only if
    /// it stays away.
    pub pending: bool,
}

impl InputError {
    fn new(camera: usize, stream: Stream, reason: impl ToString) -> Self {
        Self {
            camera,
            stream,
            reason: reason.to_string(),
            pending: false,
        }
    }

    fn pending(camera: usize, stream: Stream, reason: impl ToString) -> Self {
        Self {
            pending: true,
            ..Self::new(camera, stream, reason)
        }
    }
}

/// A calibration as it arrived, or what is wrong with it; none before the first.
type Calibration = Option<Result<Intrinsics, String>>;

/// What has arrived of one camera.
struct CameraState {
    name: String,
    /// From the calibration file, which wins over `/tf_static`.
    fixed_pose: Option<Isometry3<f64>>,
    /// Of the colour image, from the last calibration.
    intrinsics: Calibration,
    /// Of the depth image.
    depth_intrinsics: Calibration,
    color: VecDeque<(Duration, Image)>,
    depth: VecDeque<(Duration, Image)>,
    rgb: Vec<u8>,
    /// For the pixels of the colour image.
    depth_m: Vec<f32>,
    /// As it was measured.
    measured_m: Vec<f32>,
    /// Nothing has come for a while.
    silent: bool,
}

/// Collects images and fuses those that belong together.
///
/// A set of images belongs together when each camera has a colour and a depth image whose stamps are
/// within `tolerance_s` of one reference stamp. The reference is the newest colour stamp for which that
/// holds; of several images of a stream the nearest is taken. A set is fused once: it must be newer than
/// the last one. One that cannot be used, such as of a frame without a transform, holds up no older one.
/// A silent camera is waited for, unless `fuse_without_silent`.
pub struct FrameSynchronizer {
    cameras: Vec<CameraState>,
    transforms: Transforms,
    world_frame: String,
    tolerance: Duration,
    fusion: Fusion,
    /// The median over several sets, where the parameters ask for that.
    still: Option<StillFusion>,
    heightmap: Heightmap,
    last: Option<Duration>,
    fuse_without_silent: bool,
}

/// Stamps of the images of one camera in a heightmap.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Used {
    /// Of the colour image.
    pub color: Duration,
    /// Of the depth image.
    pub depth: Duration,
}

/// A heightmap and what it was made from.
#[derive(Clone, Debug, PartialEq)]
pub struct Fused {
    /// For the previews.
    pub heightmap: Heightmap,
    /// To be published.
    pub message: sctn_msgs::Heightmap,
    /// Of the newest image.
    pub stamp: Duration,
    /// By camera; nothing where it was left out.
    pub used: Vec<Option<Used>>,
}

impl FrameSynchronizer {
    /// How far from the reference stamp images may be, from the next fusion on.
    pub fn set_tolerance_s(&mut self, tolerance_s: f64) {
        self.tolerance = Duration::from_secs_f64(tolerance_s);
    }

    /// `poses` are those of the calibration file, by camera name.
    pub fn new(
        parameters: &CameraFusionParameters,
        mut poses: BTreeMap<String, Isometry3<f64>>,
    ) -> Self {
        let state = |name: &String| CameraState {
            name: name.clone(),
            fixed_pose: poses.remove(name),
            intrinsics: None,
            depth_intrinsics: None,
            color: VecDeque::new(),
            depth: VecDeque::new(),
            rgb: Vec::new(),
            depth_m: Vec::new(),
            measured_m: Vec::new(),
            silent: false,
        };
        Self {
            cameras: parameters.cameras.iter().map(state).collect(),
            transforms: Transforms::default(),
            world_frame: parameters.world_frame.clone(),
            tolerance: Duration::from_secs_f64(parameters.tolerance_s),
            fusion: Fusion::default(),
            still: (parameters.frames > 1).then(|| {
                StillFusion::new(StillSettings {
                    frames: parameters.frames,
                    percentile: parameters.percentile,
                    edge_step_m: parameters.edge_step_m as f32,
                })
            }),
            heightmap: Heightmap::new(parameters.workspace.workspace()),
            last: None,
            fuse_without_silent: parameters.fuse_without_silent,
        }
    }

    /// Whether heightmaps go on without a silent camera.
    pub fn fuses_without_silent(&self) -> bool {
        self.fuse_without_silent
    }

    /// Says whether nothing has come from a camera for a while.
    pub fn set_silent(&mut self, camera: usize, silent: bool) {
        self.cameras[camera].silent = silent;
    }

    /// Takes transforms; says which cannot be used.
    pub fn transform(&mut self, message: TFMessage) -> Vec<String> {
        let errors = self.transforms.update(message);
        errors.iter().map(ToString::to_string).collect()
    }

    /// Takes a calibration of the colour or the depth image; it holds until the next. A bad one takes the last good one away.
    pub fn calibrate(
        &mut self,
        camera: usize,
        stream: Stream,
        message: &CameraInfo,
    ) -> Result<(), InputError> {
        let read = convert::intrinsics_from_msg(message).map_err(|error| error.to_string());
        let state = &mut self.cameras[camera];
        let known = match stream {
            Stream::DepthInfo | Stream::Depth => &mut state.depth_intrinsics,
            Stream::Info | Stream::Color => &mut state.intrinsics,
        };
        let result = match &read {
            Ok(_) => Ok(()),
            Err(reason) => Err(InputError::new(camera, stream, reason)),
        };
        *known = Some(read);
        result
    }

    /// Takes an image. `true`: the clock was set back, and everything older is forgotten.
    pub fn image(
        &mut self,
        camera: usize,
        stream: Stream,
        image: Image,
    ) -> Result<bool, InputError> {
        let stamp = convert::time_from_msg(&image.header.stamp)
            .map_err(|error| InputError::new(camera, stream, format!("header.{error}")))?;
        let set_back = self.last.is_some_and(|last| stamp + CLOCK_SET_BACK < last);
        if set_back {
            self.last = None;
            if let Some(still) = &mut self.still {
                still.forget();
            }
            for state in &mut self.cameras {
                state.color.clear();
                state.depth.clear();
            }
        }
        // The same frame again, while nothing moves.
        if self.last.is_some_and(|last| stamp <= last) {
            return Ok(false);
        }
        let state = &mut self.cameras[camera];
        let waiting = match stream {
            Stream::Depth | Stream::DepthInfo => &mut state.depth,
            Stream::Color | Stream::Info => &mut state.color,
        };
        waiting.retain(|(waiting, _)| *waiting != stamp);
        waiting.push_back((stamp, image));
        if waiting.len() > WAITING_IMAGES {
            waiting.pop_front();
        }
        Ok(set_back)
    }

    /// Fuses the newest new set that can be used, if there is one; and what is wrong with still newer ones.
    pub fn fuse(&mut self) -> (Option<Fused>, Vec<InputError>) {
        let mut complaints = Vec::new();
        let mut before = Duration::MAX;
        while let Some(reference) = self.newest_reference(before) {
            match self.fuse_at(reference) {
                Ok(fused) => return (fused, complaints),
                Err(bad) => bad.into_iter().for_each(|bad| {
                    if !complaints.contains(&bad) {
                        complaints.push(bad);
                    }
                }),
            }
            before = reference;
        }
        (None, complaints)
    }

    /// None where more frames of the still scene are needed.
    fn fuse_at(&mut self, reference: Duration) -> Result<Option<Fused>, Vec<InputError>> {
        let (mut cameras, mut complaints) = (Vec::new(), Vec::new());
        let without = self.fuse_without_silent;
        for (index, state) in self.cameras.iter_mut().enumerate() {
            if without && state.silent {
                cameras.push(None);
                continue;
            }
            match state.view(index, reference, &self.transforms, &self.world_frame) {
                Ok(view) => cameras.push(Some(view)),
                Err(bad) => complaints.extend(bad),
            }
        }
        if !complaints.is_empty() {
            return Err(complaints);
        }
        let used: Vec<_> = cameras
            .iter()
            .map(|view| view.as_ref().map(|(_, used)| *used))
            .collect();
        let stamps = used.iter().flatten().map(|used| used.color.max(used.depth));
        let stamp = stamps.max().unwrap_or(reference);
        let views: Vec<View<'_>> = cameras
            .iter()
            .zip(&self.cameras)
            .filter_map(|(view, state)| {
                let (camera, _) = view.as_ref()?;
                Some(View {
                    camera,
                    rgb: &state.rgb,
                    depth_m: &state.depth_m,
                })
            })
            .collect();
        let general = |reason: String| vec![InputError::new(0, Stream::Color, reason)];
        self.last = Some(stamp);
        let report = match &mut self.still {
            None => self.fusion.fuse(&views, &mut self.heightmap).map(Some),
            Some(still) => fuse_still(still, &views, &mut self.heightmap),
        };
        let report = report.map_err(|error| general(error.to_string()))?;
        for state in &mut self.cameras {
            state.color.retain(|(waiting, _)| *waiting > stamp);
            state.depth.retain(|(waiting, _)| *waiting > stamp);
        }
        let Some(report) = report else {
            return Ok(None);
        };
        let message = convert::header(stamp, &self.world_frame).and_then(|header| {
            convert::heightmap_to_msg(
                self.heightmap.clone(),
                header,
                report.views,
                report.coverage,
            )
        });
        Ok(Some(Fused {
            message: message.map_err(|error| general(error.to_string()))?,
            heightmap: self.heightmap.clone(),
            stamp,
            used,
        }))
    }

    /// The newest colour stamp before another about which every camera has an image of both streams.
    fn newest_reference(&self, before: Duration) -> Option<Duration> {
        let near = |waiting: &VecDeque<(Duration, Image)>, reference: Duration| {
            waiting
                .iter()
                .any(|(stamp, _)| stamp.abs_diff(reference) <= self.tolerance)
        };
        let waited_for = |state: &&CameraState| !(self.fuse_without_silent && state.silent);
        let stamps = self
            .cameras
            .iter()
            .filter(waited_for)
            .flat_map(|state| &state.color);
        stamps
            .map(|(stamp, _)| *stamp)
            .filter(|reference| {
                let complete = |state: &CameraState| {
                    near(&state.color, *reference) && near(&state.depth, *reference)
                };
                *reference < before && self.cameras.iter().filter(waited_for).all(complete)
            })
            .max()
    }
}

/// What moves while a set of images is compared with the median of those before: an arm or a hand, not the noise of a single set.
const MOTION: ChangeRules = {
    let rule = BlobRule {
        height_m: 0.015,
        area_m2: 400e-6,
    };
    ChangeRules {
        near: rule,
        far: rule,
        near_m: 0.0,
        hidden_area_m2: f64::INFINITY,
    }
};

/// Takes one more set; the median once there are as many as asked for in which nothing has moved.
fn fuse_still(
    still: &mut StillFusion,
    views: &[View<'_>],
    heightmap: &mut Heightmap,
) -> Result<Option<FusionReport>, FusionError> {
    let before = (!still.is_empty()).then(|| {
        let mut before = Heightmap::new(heightmap.workspace);
        still.median(&mut before);
        before
    });
    still.push(views, &heightmap.workspace)?;
    if let Some(before) = before {
        still.last(heightmap);
        if !matches!(largest_change(&before, heightmap, &MOTION, &[]), Ok(None)) {
            still.forget();
            still.push(views, &heightmap.workspace)?;
        }
    }
    Ok(still.is_full().then(|| still.median(heightmap)))
}

impl CameraState {
    /// Converts the images nearest to a stamp. Images that cannot be used are dropped, so that they are
    /// complained about once.
    fn view(
        &mut self,
        index: usize,
        reference: Duration,
        transforms: &Transforms,
        world_frame: &str,
    ) -> Result<(Camera, Used), Vec<InputError>> {
        let invalid = |stream, reason: String| InputError::new(index, stream, reason);
        let nearest = |waiting: &VecDeque<(Duration, Image)>| {
            let stamps = waiting.iter().map(|(stamp, _)| stamp.abs_diff(reference));
            let nearest = stamps.enumerate().min_by_key(|(_, distance)| *distance);
            nearest.map(|(position, _)| position)
        };
        let (Some(color), Some(depth)) = (nearest(&self.color), nearest(&self.depth)) else {
            return Err(vec![invalid(Stream::Color, "no image".into())]);
        };
        let intrinsics = match &self.intrinsics {
            Some(Ok(intrinsics)) => *intrinsics,
            Some(Err(reason)) => {
                return Err(vec![invalid(
                    Stream::Info,
                    format!("images cannot be used without a valid calibration: {reason}"),
                )]);
            }
            None => {
                let reason = "images cannot be used without a calibration, none has arrived";
                return Err(vec![InputError::pending(index, Stream::Info, reason)]);
            }
        };
        let frame = &self.color[color].1.header.frame_id;
        let pose = match self.fixed_pose {
            Some(pose) => Ok(pose),
            None => transforms.world_from(frame, world_frame),
        };
        let world_from_camera = match pose {
            Ok(pose) => pose,
            Err(error) => {
                let reason = format!("header.frame_id: {error}");
                return Err(vec![InputError::pending(index, Stream::Color, reason)]);
            }
        };
        let camera = Camera {
            name: self.name.clone(),
            intrinsics,
            world_from_camera,
        };
        if let Err(error) = camera.check() {
            return Err(vec![invalid(Stream::Info, error.to_string())]);
        }
        let used = Used {
            color: self.color[color].0,
            depth: self.depth[depth].0,
        };
        let mut bad = Vec::new();
        if let Err(error) =
            convert::color_from_msg(&self.color[color].1, &intrinsics, &mut self.rgb)
        {
            bad.push(invalid(Stream::Color, error.to_string()));
            self.color.remove(color);
        }
        match self.register(index, color, depth, &camera, transforms) {
            Ok(()) => {}
            // It can be used when what is missing comes.
            Err(missing) if missing.pending => bad.push(missing),
            Err(refused) => {
                bad.push(refused);
                self.depth.remove(depth);
            }
        }
        if bad.is_empty() {
            Ok((camera, used))
        } else {
            Err(bad)
        }
    }

    /// Fills `depth_m` from a depth image: as it is where it is of the colour image's frame and size, scaled where only the size differs,
    /// registered where the frame differs, by way of the transform between both frames and the depth image's own calibration.
    fn register(
        &mut self,
        index: usize,
        color: usize,
        depth: usize,
        camera: &Camera,
        transforms: &Transforms,
    ) -> Result<(), InputError> {
        let refuse = |stream, reason: String| InputError::new(index, stream, reason);
        let image = &self.depth[depth].1;
        let size_px = (image.width as usize, image.height as usize);
        // A colour image that was refused has left the queue.
        let color_frame = match self.color.get(color) {
            Some((_, image)) => image.header.frame_id.as_str(),
            None => image.header.frame_id.as_str(),
        };
        let depth_frame = image.header.frame_id.as_str();
        let expected = &camera.intrinsics;
        let read = convert::depth_from_msg(image, &mut self.measured_m);
        read.map_err(|error| refuse(Stream::Depth, error.to_string()))?;
        if plain(depth_frame) == plain(color_frame) {
            if size_px == (expected.width, expected.height) {
                std::mem::swap(&mut self.depth_m, &mut self.measured_m);
            } else if has_shape_of(expected, size_px.0, size_px.1) {
                scale_depth(&self.measured_m, size_px, expected, &mut self.depth_m);
            } else {
                return Err(refuse(
                    Stream::Depth,
                    format!(
                        "width and height are {} and {}, expected those of the colour image, {} and {}, or the same shape in another \
                         size",
                        size_px.0, size_px.1, expected.width, expected.height
                    ),
                ));
            }
            return Ok(());
        }
        let differ = format!(
            "header.frame_id is {depth_frame:?}, expected that of the colour image, {color_frame:?}, since depth must be registered to it"
        );
        let Some(color_from_depth) = transforms.between(color_frame, depth_frame) else {
            let reason = format!("{differ}, or transforms between the two frames");
            return Err(InputError::pending(index, Stream::Depth, reason));
        };
        let intrinsics = match &self.depth_intrinsics {
            Some(Ok(intrinsics)) => *intrinsics,
            Some(Err(reason)) => {
                let reason =
                    format!("{differ}, or a valid calibration of the depth image: {reason}");
                return Err(refuse(Stream::DepthInfo, reason));
            }
            None => {
                let reason =
                    format!("{differ}, or a calibration of the depth image, none has arrived");
                return Err(InputError::pending(index, Stream::DepthInfo, reason));
            }
        };
        let depth_camera = Camera {
            name: format!("{} depth", camera.name),
            intrinsics,
            world_from_camera: camera.world_from_camera * color_from_depth,
        };
        let checked = depth_camera.check();
        checked.map_err(|error| refuse(Stream::DepthInfo, error.to_string()))?;
        if size_px != (intrinsics.width, intrinsics.height) {
            return Err(refuse(
                Stream::Depth,
                format!(
                    "width and height are {} and {}, expected those of its calibration, {} and {}",
                    size_px.0, size_px.1, intrinsics.width, intrinsics.height
                ),
            ));
        }
        register_depth(&self.measured_m, &depth_camera, camera, &mut self.depth_m);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use heightmap::Distortion;
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
}
