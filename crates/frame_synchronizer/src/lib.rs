//! Which images of several cameras make one heightmap: images in, a heightmap out. It knows no ROS: an [`Image`] is
//! whatever a driver sends, and is decoded only when it is fused.

mod camera_state;
mod depth_reader;

use std::collections::{BTreeMap, VecDeque};
use std::fmt::Display;
use std::time::Duration;

use heightmap::{
    BlobRule, ChangeRules, Fusion, FusionError, FusionReport, Heightmap, Intrinsics, StillFusion,
    StillSettings, TransformError, Transforms, View, Workspace, largest_change,
};
use nalgebra::Isometry3;

use self::camera_state::CameraState;

pub use self::depth_reader::{Calibration, ColorImage, DepthReader};

/// Images of one stream that wait for their counterparts.
const WAITING_IMAGES: usize = 4;
/// A stamp this much older than the last heightmap's means that the clock was set back.
const CLOCK_SET_BACK: Duration = Duration::from_secs(1);
/// After so long without a set of images the scene may be another one, also where what has moved is lower than a motion that is noticed.
const UNSEEN: Duration = Duration::from_secs(2);

/// An image as a driver sends it: colour or depth.
pub trait Image {
    /// Why it cannot be read: the field, what it is and what was expected.
    type Error: Display;

    /// Name of its optical frame.
    fn frame(&self) -> &str;

    /// Width and height.
    fn size_px(&self) -> (usize, usize);

    /// Reads red, green and blue of each pixel of a colour image.
    ///
    /// # Errors
    /// When it is no colour image of this calibration.
    fn read_color(&self, intrinsics: &Intrinsics, rgb: &mut Vec<u8>) -> Result<(), Self::Error>;

    /// Reads the depth of each pixel, in metres; 0 where nothing was measured.
    ///
    /// # Errors
    /// When it is no depth image.
    fn read_depth(&self, depth_m: &mut Vec<f32>) -> Result<(), Self::Error>;
}

/// What is fused, and how.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Names of the cameras.
    pub cameras: Vec<String>,
    /// Frame of the heightmap.
    pub world_frame: String,
    /// How far from the reference stamp images may be.
    pub tolerance: Duration,
    /// Volume and grid of the heightmap.
    pub workspace: Workspace,
    /// The median over several sets of images, where it is asked for.
    pub still: Option<StillSettings>,
    /// Whether heightmaps go on without a silent camera.
    pub fuse_without_silent: bool,
}

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
    /// What is wrong with what has arrived on a stream.
    pub fn new(camera: usize, stream: Stream, reason: impl ToString) -> Self {
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

/// Collects images and fuses those that belong together.
///
/// A set of images belongs together when each camera has a colour and a depth image whose stamps are
/// within `tolerance_s` of one reference stamp. The reference is the newest colour stamp for which that
/// holds; of several images of a stream the nearest is taken. A set is fused once: it must be newer than
/// the last one. One that cannot be used, such as of a frame without a transform, holds up no older one.
/// A silent camera is waited for, unless `fuse_without_silent`. A median is of sets between which the scene was seen all the time.
pub struct FrameSynchronizer<I> {
    cameras: Vec<CameraState<I>>,
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
    /// What was seen.
    pub heightmap: Heightmap,
    /// How much of it was seen.
    pub report: FusionReport,
    /// Of the newest image.
    pub stamp: Duration,
    /// By camera; `None` where it was left out.
    pub used: Vec<Option<Used>>,
}

impl<I: Image> FrameSynchronizer<I> {
    /// How far from the reference stamp images may be, from the next fusion on.
    pub fn set_tolerance(&mut self, tolerance: Duration) {
        self.tolerance = tolerance;
    }

    /// `poses` are those of the calibration file, by camera name.
    pub fn new(settings: Settings, mut poses: BTreeMap<String, Isometry3<f64>>) -> Self {
        let state = |name: &String| CameraState::new(name, poses.remove(name));
        Self {
            cameras: settings.cameras.iter().map(state).collect(),
            transforms: Transforms::default(),
            world_frame: settings.world_frame,
            tolerance: settings.tolerance,
            fusion: Fusion::default(),
            still: settings.still.map(StillFusion::new),
            heightmap: Heightmap::new(settings.workspace),
            last: None,
            fuse_without_silent: settings.fuse_without_silent,
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

    /// Takes the pose of a frame in its parent.
    ///
    /// # Errors
    /// When the frame has no name, or there are too many.
    pub fn transform(
        &mut self,
        parent: &str,
        child: &str,
        pose: Isometry3<f64>,
    ) -> Result<(), TransformError> {
        self.transforms.insert(parent, child, pose)
    }

    /// Takes a calibration of the colour or the depth image, or what is wrong with it; it holds until the next. A bad one
    /// takes the last good one away.
    ///
    /// # Errors
    /// When it is a bad one.
    pub fn calibrate(
        &mut self,
        camera: usize,
        stream: Stream,
        read: Result<Intrinsics, String>,
    ) -> Result<(), InputError> {
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
    pub fn image(&mut self, camera: usize, stream: Stream, stamp: Duration, image: I) -> bool {
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
            return false;
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
        set_back
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
        let unseen = self.last.is_some_and(|last| stamp > last + UNSEEN);
        if let Some(still) = self.still.as_mut().filter(|_| unseen) {
            still.forget();
        }
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
        Ok(Some(Fused {
            heightmap: self.heightmap.clone(),
            report,
            stamp,
            used,
        }))
    }

    /// The newest colour stamp before another about which every camera has an image of both streams.
    fn newest_reference(&self, before: Duration) -> Option<Duration> {
        let near = |waiting: &VecDeque<(Duration, I)>, reference: Duration| {
            waiting
                .iter()
                .any(|(stamp, _)| stamp.abs_diff(reference) <= self.tolerance)
        };
        let waited_for = |state: &&CameraState<I>| !(self.fuse_without_silent && state.silent);
        let stamps = self
            .cameras
            .iter()
            .filter(waited_for)
            .flat_map(|state| &state.color);
        stamps
            .map(|(stamp, _)| *stamp)
            .filter(|reference| {
                let complete = |state: &CameraState<I>| {
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

#[cfg(test)]
mod tests;
