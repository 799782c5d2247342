//! Which images make one heightmap: messages in, a heightmap out, no ROS around it.

use std::{
    collections::{BTreeMap, VecDeque},
    time::Duration,
};

use heightmap::{Camera, Fusion, Heightmap, Intrinsics, View};
use msgs::{
    convert, sctn_msgs,
    sensor_msgs::{CameraInfo, Image},
    tf2_msgs::TFMessage,
};
use nalgebra::Isometry3;

use crate::{extrinsics::Transforms, parameters::CameraFusionParameters};

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
    /// Calibration of the colour image, to which depth is registered.
    Info,
}

/// Why something that arrived cannot be used.
#[derive(Clone, Debug, PartialEq)]
pub struct Complaint {
    /// Index of the camera.
    pub camera: usize,
    /// Its stream.
    pub stream: Stream,
    /// The field, what it is and what was expected.
    pub reason: String,
}

/// What has arrived of one camera.
struct CameraState {
    name: String,
    /// From the calibration file, which wins over `/tf_static`.
    fixed_pose: Option<Isometry3<f64>>,
    intrinsics: Option<Intrinsics>,
    color: VecDeque<(Duration, Image)>,
    depth: VecDeque<(Duration, Image)>,
    rgb: Vec<u8>,
    depth_m: Vec<f32>,
}

/// Collects images and fuses those that belong together.
///
/// A set of images belongs together when each camera has a colour and a depth image whose stamps are
/// within `tolerance_s` of one reference stamp. The reference is the newest colour stamp for which that
/// holds; of several images of a stream the nearest is taken. A set is fused once: it must be newer than
/// the last one.
pub struct Views {
    cameras: Vec<CameraState>,
    transforms: Transforms,
    world_frame: String,
    tolerance: Duration,
    fusion: Fusion,
    heightmap: Heightmap,
    last: Option<Duration>,
}

/// A heightmap and what it was made from.
#[derive(Clone, Debug, PartialEq)]
pub struct Fused {
    /// For the previews.
    pub heightmap: Heightmap,
    /// To be published.
    pub message: sctn_msgs::Heightmap,
}

impl Views {
    /// `poses` are those of the calibration file, by camera name.
    pub fn new(
        parameters: &CameraFusionParameters,
        mut poses: BTreeMap<String, Isometry3<f64>>,
    ) -> Self {
        let state = |name: &String| CameraState {
            name: name.clone(),
            fixed_pose: poses.remove(name),
            intrinsics: None,
            color: VecDeque::new(),
            depth: VecDeque::new(),
            rgb: Vec::new(),
            depth_m: Vec::new(),
        };
        Self {
            cameras: parameters.cameras.iter().map(state).collect(),
            transforms: Transforms::default(),
            world_frame: parameters.world_frame.clone(),
            tolerance: Duration::from_secs_f64(parameters.tolerance_s),
            fusion: Fusion::default(),
            heightmap: Heightmap::new(parameters.workspace.workspace()),
            last: None,
        }
    }

    /// Takes transforms; says which cannot be used.
    pub fn transform(&mut self, message: TFMessage) -> Vec<String> {
        let errors = self.transforms.update(message);
        errors.iter().map(ToString::to_string).collect()
    }

    /// Takes a calibration; it holds until the next. A bad one takes the last good one away.
    pub fn calibrate(&mut self, camera: usize, message: &CameraInfo) -> Result<(), Complaint> {
        let state = &mut self.cameras[camera];
        let intrinsics = convert::intrinsics_from_msg(message);
        state.intrinsics = intrinsics.as_ref().ok().copied();
        intrinsics.map(drop).map_err(|error| Complaint {
            camera,
            stream: Stream::Info,
            reason: error.to_string(),
        })
    }

    /// Takes an image. `true`: the clock was set back, and everything older is forgotten.
    pub fn image(
        &mut self,
        camera: usize,
        stream: Stream,
        image: Image,
    ) -> Result<bool, Complaint> {
        let stamp = convert::time_from_msg(&image.header.stamp).map_err(|error| Complaint {
            camera,
            stream,
            reason: format!("header.{error}"),
        })?;
        let set_back = self.last.is_some_and(|last| stamp + CLOCK_SET_BACK < last);
        if set_back {
            self.last = None;
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
            Stream::Depth => &mut state.depth,
            Stream::Color | Stream::Info => &mut state.color,
        };
        waiting.retain(|(waiting, _)| *waiting != stamp);
        waiting.push_back((stamp, image));
        if waiting.len() > WAITING_IMAGES {
            waiting.pop_front();
        }
        Ok(set_back)
    }

    /// Fuses the newest set, if there is a new one.
    pub fn fuse(&mut self) -> Result<Option<Fused>, Vec<Complaint>> {
        let Some(reference) = self.reference() else {
            return Ok(None);
        };
        let (mut cameras, mut complaints) = (Vec::new(), Vec::new());
        let mut stamp = Duration::ZERO;
        for (index, state) in self.cameras.iter_mut().enumerate() {
            match state.view(index, reference, &self.transforms, &self.world_frame) {
                Ok((camera, newest)) => {
                    cameras.push(camera);
                    stamp = stamp.max(newest);
                }
                Err(bad) => complaints.extend(bad),
            }
        }
        if !complaints.is_empty() {
            return Err(complaints);
        }
        let views: Vec<View<'_>> = cameras
            .iter()
            .zip(&self.cameras)
            .map(|(camera, state)| View {
                camera,
                rgb: &state.rgb,
                depth_m: &state.depth_m,
            })
            .collect();
        let general = |reason: String| {
            vec![Complaint {
                camera: 0,
                stream: Stream::Color,
                reason,
            }]
        };
        self.last = Some(stamp);
        let report = self
            .fusion
            .fuse(&views, &mut self.heightmap)
            .map_err(|error| general(error.to_string()))?;
        for state in &mut self.cameras {
            state.color.retain(|(waiting, _)| *waiting > stamp);
            state.depth.retain(|(waiting, _)| *waiting > stamp);
        }
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
        }))
    }

    /// The newest colour stamp about which every camera has an image of both streams.
    fn reference(&self) -> Option<Duration> {
        let near = |waiting: &VecDeque<(Duration, Image)>, reference: Duration| {
            waiting
                .iter()
                .any(|(stamp, _)| stamp.abs_diff(reference) <= self.tolerance)
        };
        let stamps = self.cameras.iter().flat_map(|state| &state.color);
        stamps
            .map(|(stamp, _)| *stamp)
            .filter(|reference| {
                self.cameras
                    .iter()
                    .all(|state| near(&state.color, *reference) && near(&state.depth, *reference))
            })
            .max()
    }
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
    ) -> Result<(Camera, Duration), Vec<Complaint>> {
        let complaint = |stream, reason: String| Complaint {
            camera: index,
            stream,
            reason,
        };
        let nearest = |waiting: &VecDeque<(Duration, Image)>| {
            let stamps = waiting.iter().map(|(stamp, _)| stamp.abs_diff(reference));
            let nearest = stamps.enumerate().min_by_key(|(_, distance)| *distance);
            nearest.map(|(position, _)| position)
        };
        let (Some(color), Some(depth)) = (nearest(&self.color), nearest(&self.depth)) else {
            return Err(vec![complaint(Stream::Color, "no image".into())]);
        };
        let Some(intrinsics) = self.intrinsics else {
            return Err(vec![complaint(
                Stream::Info,
                "no valid calibration has arrived, so images cannot be used".into(),
            )]);
        };
        let frame = &self.color[color].1.header.frame_id;
        let pose = match self.fixed_pose {
            Some(pose) => Ok(pose),
            None => transforms.world_from(frame, world_frame),
        };
        let world_from_camera = match pose {
            Ok(pose) => pose,
            Err(error) => {
                return Err(vec![complaint(
                    Stream::Color,
                    format!("header.frame_id: {error}"),
                )]);
            }
        };
        let camera = Camera {
            name: self.name.clone(),
            intrinsics,
            world_from_camera,
        };
        if let Err(error) = camera.check() {
            return Err(vec![complaint(Stream::Info, error.to_string())]);
        }
        let newest = self.color[color].0.max(self.depth[depth].0);
        let mut bad = Vec::new();
        if let Err(error) =
            convert::color_from_msg(&self.color[color].1, &intrinsics, &mut self.rgb)
        {
            bad.push(complaint(Stream::Color, error.to_string()));
            self.color.remove(color);
        }
        if let Err(error) =
            convert::depth_from_msg(&self.depth[depth].1, &intrinsics, &mut self.depth_m)
        {
            bad.push(complaint(Stream::Depth, error.to_string()));
            self.depth.remove(depth);
        }
        if bad.is_empty() {
            Ok((camera, newest))
        } else {
            Err(bad)
        }
    }
}
