//! What the cameras see, with where they stand, so that a proposal can be drawn on it. Images are only asked for while
//! somebody looks at them: they are most of the traffic of a cell.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use heightmap::{Distortion, Intrinsics};
use msgs::convert;
use msgs::sensor_msgs::{CameraInfo, Image};
use msgs::tf2_msgs::TFMessage;
use nalgebra::Isometry3;
use node_kit::{Node, Qos};
use serde::Serialize;

/// Images go on for so long after somebody has looked.
const LINGER: Duration = Duration::from_secs(5);
/// How often it is looked whether somebody looks.
const POLL: Duration = Duration::from_millis(250);
/// Most transforms that are kept, and most that lead from a camera to the world.
const MOST_TRANSFORMS: usize = 1000;

/// An image, and what is needed to draw on it.
#[derive(Clone, Debug, Default)]
struct Seen {
    /// Counts from 1.
    number: u64,
    stamp: Duration,
    frame: String,
    rgb: Arc<Vec<u8>>,
    intrinsics: Option<Intrinsics>,
}

/// The cameras.
#[derive(Debug)]
pub struct Cameras {
    world_frame: String,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    wanted_until: Option<Instant>,
    seen: BTreeMap<String, Seen>,
    /// By child frame: parent frame, and pose of the child in it.
    transforms: BTreeMap<String, (String, Isometry3<f64>)>,
}

/// A camera, as the API has it.
#[derive(Debug, Serialize)]
pub struct CameraState {
    name: String,
    /// Of the newest image, which counts from 1; 0 where none has come.
    number: u64,
    width_px: usize,
    height_px: usize,
    fx_px: f64,
    fy_px: f64,
    cx_px: f64,
    cy_px: f64,
    /// Lens after plumb_bob: k1, k2, p1, p2, k3.
    distortion: [f64; 5],
    /// Pose of the optical frame in the world, row by row: rotation and translation (m); nothing where it is not known.
    pose: Option<[[f64; 4]; 3]>,
}

impl Cameras {
    /// Cameras of these names, of which nothing is known.
    pub fn new(names: &[String], world_frame: &str) -> Self {
        let names = names.iter().filter(|name| !name.is_empty());
        Self {
            world_frame: world_frame.to_owned(),
            state: Mutex::new(State {
                wanted_until: None,
                seen: names.map(|name| (name.clone(), Seen::default())).collect(),
                transforms: BTreeMap::new(),
            }),
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn is_wanted(&self) -> bool {
        let until = self.lock().wanted_until;
        until.is_some_and(|until| until > Instant::now())
    }

    /// Somebody looks: all cameras, and where they stand.
    pub fn look(&self) -> Vec<CameraState> {
        let mut state = self.lock();
        state.wanted_until = Some(Instant::now() + LINGER);
        let camera = |(name, seen): (&String, &Seen)| {
            let Intrinsics {
                width,
                height,
                fx_px,
                fy_px,
                cx_px,
                cy_px,
                distortion: Distortion { k1, k2, p1, p2, k3 },
            } = seen.intrinsics?;
            let pose = state.pose(&seen.frame, &self.world_frame).map(|pose| {
                let matrix = pose.to_homogeneous();
                std::array::from_fn(|row| std::array::from_fn(|col| matrix[(row, col)]))
            });
            Some(CameraState {
                name: name.clone(),
                number: seen.number,
                width_px: width,
                height_px: height,
                fx_px,
                fy_px,
                cx_px,
                cy_px,
                distortion: [k1, k2, p1, p2, k3],
                pose,
            })
        };
        state.seen.iter().filter_map(camera).collect()
    }

    /// Number, width, height, and red, green and blue of each pixel of a camera's newest image.
    pub fn image(&self, name: &str) -> Option<(u64, usize, usize, Arc<Vec<u8>>)> {
        let state = self.lock();
        let seen = state.seen.get(name).filter(|seen| seen.number > 0)?;
        let Intrinsics { width, height, .. } = seen.intrinsics?;
        Some((seen.number, width, height, Arc::clone(&seen.rgb)))
    }

    fn on_info(&self, name: &str, message: &CameraInfo) -> Result<(), String> {
        let intrinsics =
            convert::intrinsics_from_msg(message).map_err(|error| error.to_string())?;
        if let Some(seen) = self.lock().seen.get_mut(name) {
            seen.intrinsics = Some(intrinsics);
        }
        Ok(())
    }

    /// An image before its camera's calibration is not shown.
    fn on_image(&self, name: &str, message: &Image) -> Result<(), String> {
        let stamp = convert::time_from_msg(&message.header.stamp);
        let stamp = stamp.map_err(|error| format!("header.{error}"))?;
        let mut state = self.lock();
        let Some(seen) = state.seen.get_mut(name) else {
            return Ok(());
        };
        let Some(intrinsics) = seen.intrinsics else {
            return Ok(());
        };
        // The same image, sent again.
        if seen.number > 0 && seen.stamp == stamp {
            return Ok(());
        }
        let mut rgb = Vec::new();
        convert::color_from_msg(message, &intrinsics, &mut rgb)
            .map_err(|error| error.to_string())?;
        seen.number += 1;
        seen.stamp = stamp;
        seen.frame.clone_from(&message.header.frame_id);
        seen.rgb = Arc::new(rgb);
        Ok(())
    }

    fn on_transforms(&self, message: &TFMessage) -> Result<(), String> {
        let mut state = self.lock();
        for transform in &message.transforms {
            let pose = convert::isometry_from_msg(&transform.transform);
            let pose = pose.map_err(|error| format!("{}: {error}", transform.child_frame_id))?;
            if state.transforms.len() < MOST_TRANSFORMS {
                let parent = transform.header.frame_id.clone();
                let child = transform.child_frame_id.clone();
                state.transforms.insert(child, (parent, pose));
            }
        }
        Ok(())
    }
}

impl State {
    /// Pose of a frame in the world.
    fn pose(&self, frame: &str, world_frame: &str) -> Option<Isometry3<f64>> {
        let mut pose = Isometry3::identity();
        let mut frame = frame;
        for _ in 0..MOST_TRANSFORMS {
            if frame == world_frame {
                return Some(pose);
            }
            let (parent, of_child) = self.transforms.get(frame)?;
            pose = of_child * pose;
            frame = parent;
        }
        None
    }
}

/// Keeps the transforms, for as long as the node is active.
pub async fn follow_transforms(node: Node, cameras: Arc<Cameras>) -> anyhow::Result<()> {
    let mut transforms = node.subscription::<TFMessage>("/tf_static", Qos::Latched)?;
    loop {
        let message = transforms.recv().await;
        if let Err(reason) = cameras.on_transforms(&message) {
            transforms.reject(reason);
        }
    }
}

/// Keeps the newest image of a camera while somebody looks, for as long as the node is active.
pub async fn follow(node: Node, cameras: Arc<Cameras>, name: String) -> anyhow::Result<()> {
    let mut poll = tokio::time::interval(POLL);
    loop {
        poll.tick().await;
        if !cameras.is_wanted() {
            continue;
        }
        let topic = |part| format!("{name}/color/{part}");
        let mut infos = node.subscription::<CameraInfo>(&topic("camera_info"), Qos::Image)?;
        let mut images = node.subscription::<Image>(&topic("image_raw"), Qos::Image)?;
        while cameras.is_wanted() {
            tokio::select! {
                message = infos.recv() => {
                    if let Err(reason) = cameras.on_info(&name, &message) {
                        infos.reject(reason);
                    }
                }
                message = images.recv() => {
                    if let Err(reason) = cameras.on_image(&name, &message) {
                        images.reject(reason);
                    }
                }
                _ = poll.tick() => {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use msgs::geometry_msgs::TransformStamped;

    fn transform(parent: &str, child: &str, x: f64) -> TransformStamped {
        let mut transform = TransformStamped {
            child_frame_id: child.into(),
            ..Default::default()
        };
        transform.header.frame_id = parent.into();
        transform.transform.translation.x = x;
        transform
    }

    fn image(sec: i32, value: u8) -> Image {
        let mut image = Image {
            height: 2,
            width: 3,
            step: 9,
            encoding: "bgr8".into(),
            data: [value, 0, 0].repeat(6).into(),
            ..Default::default()
        };
        image.header.frame_id = "optical".into();
        image.header.stamp.sec = sec;
        image
    }

    #[test]
    fn an_image_is_shown_with_calibration_and_pose_and_once_for_each_stamp() {
        let cameras = Cameras::new(&["front".into(), String::new()], "world");
        assert!(!cameras.is_wanted());
        assert!(cameras.look().is_empty());
        assert!(cameras.is_wanted());
        cameras.on_image("front", &image(1, 5)).unwrap();
        assert!(cameras.image("front").is_none());
        let intrinsics = Intrinsics {
            width: 3,
            height: 2,
            ..Intrinsics::RAVENS
        };
        let info = convert::intrinsics_to_msg(Default::default(), &intrinsics);
        cameras.on_info("front", &info).unwrap();
        cameras.on_image("front", &image(1, 5)).unwrap();
        cameras.on_image("front", &image(1, 6)).unwrap();
        let (number, width, height, rgb) = cameras.image("front").unwrap();
        assert_eq!((number, width, height, rgb[2]), (1, 3, 2, 5));
        cameras.on_image("front", &image(2, 6)).unwrap();
        assert_eq!(cameras.image("front").unwrap().0, 2);
        assert!(cameras.image("left").is_none());

        assert!(cameras.look()[0].pose.is_none());
        let transforms = vec![
            transform("world", "link", 1.0),
            transform("link", "optical", 2.0),
        ];
        cameras.on_transforms(&TFMessage { transforms }).unwrap();
        let pose = cameras.look()[0].pose.unwrap();
        assert_eq!(
            pose,
            [
                [1.0, 0.0, 0.0, 3.0],
                [0.0, 1.0, 0.0, 0.0],
                [0.0, 0.0, 1.0, 0.0]
            ]
        );
        // A circle of frames leads nowhere.
        let transforms = vec![transform("optical", "link", 1.0)];
        cameras.on_transforms(&TFMessage { transforms }).unwrap();
        assert!(cameras.look()[0].pose.is_none());
    }

    #[test]
    fn an_image_of_another_size_than_its_calibration_is_refused() {
        let cameras = Cameras::new(&["front".into()], "world");
        let info = convert::intrinsics_to_msg(Default::default(), &Intrinsics::RAVENS);
        cameras.on_info("front", &info).unwrap();
        let error = cameras.on_image("front", &image(1, 5)).unwrap_err();
        assert!(
            error.contains("width") || error.contains("size") || error.contains("640"),
            "{error}"
        );
    }
}
