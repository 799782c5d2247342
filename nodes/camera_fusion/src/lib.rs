//! Node that fuses camera views into heightmaps.
//!
//! What belongs together and what is wrong with it is decided in [`Views`], which knows no ROS node.

mod extrinsics;
mod outputs;
mod parameters;
mod views;

use std::{
    collections::BTreeMap,
    path::Path,
    sync::Arc,
    time::{Duration, Instant},
};

use msgs::{
    sctn_msgs,
    sensor_msgs::{CameraInfo, Image},
    tf2_msgs::TFMessage,
};
use node_kit::{Active, Level, Node, NodeError, Publisher, Qos, Statistics};
use tokio::sync::mpsc;
use tracing::{info, warn};

use outputs::Outputs;

pub use extrinsics::{CalibrationError, TransformError, Transforms, Unconnected, read_calibration};
pub use parameters::{CameraFusionParameters, WorkspaceParameters};
pub use views::{Complaint, Fused, Stream, Used, Views};

/// Messages between their subscriptions and the fusion.
const WAITING_ARRIVALS: usize = 32;
/// How often silent cameras are looked for.
const LOOK_PERIOD: Duration = Duration::from_millis(250);

/// What a camera has sent.
enum Arrival {
    Image(usize, Stream, Image),
    Info(usize, Box<CameraInfo>),
}

/// Reads the calibration; what it returns fuses.
pub async fn configure(
    node: Node,
    parameters: CameraFusionParameters,
) -> anyhow::Result<FusionNode> {
    let poses = if parameters.calibration == Path::new("") {
        BTreeMap::new()
    } else {
        read_calibration(&parameters.calibration)?
    };
    if let Some(stranger) = poses.keys().find(|name| !parameters.cameras.contains(name)) {
        warn!("calibration: camera {stranger} is not among the parameter cameras");
    }
    Ok(FusionNode::new(&node, parameters, poses)?)
}

impl Active for FusionNode {
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
        let mut changes = node.parameters::<CameraFusionParameters>();
        self.take_over(changes.borrow_and_update().clone());
        self.views = Views::new(&self.parameters, self.poses.clone());
        self.cameras.clear();
        self.active_since = Instant::now();
        let mut transforms = node.subscription::<TFMessage>("/tf_static", Qos::Latched)?;
        let (sender, mut arrivals) = mpsc::channel(WAITING_ARRIVALS);
        for (index, camera) in self.parameters.cameras.clone().iter().enumerate() {
            self.listen(node, index, camera, &sender)?;
        }
        drop(sender);
        let mut look = tokio::time::interval(LOOK_PERIOD);
        loop {
            tokio::select! {
                arrival = arrivals.recv() => match arrival {
                    Some(arrival) => self.arrived(arrival),
                    None => return Ok(()),
                },
                message = transforms.recv() => {
                    for reason in self.views.transform(message) {
                        transforms.reject(reason);
                    }
                    self.fuse();
                }
                _ = look.tick() => self.look_for_silent_cameras(node),
                Ok(()) = changes.changed() => self.take_over(changes.borrow_and_update().clone()),
            }
        }
    }
}

/// The configured node.
pub struct FusionNode {
    parameters: CameraFusionParameters,
    poses: BTreeMap<String, nalgebra::Isometry3<f64>>,
    views: Views,
    cameras: Vec<CameraTopics>,
    timeout: Duration,
    active_since: Instant,
    heightmap: Publisher<sctn_msgs::Heightmap>,
    outputs: Outputs,
    last_fusion: Duration,
    /// What the last heightmap was made from, by camera.
    used: Vec<Option<Used>>,
    last: Option<(Duration, u32, f32)>,
    fused: u64,
}

/// Counters and ages of one camera.
struct CameraTopics {
    name: String,
    color: Arc<Statistics>,
    depth: Arc<Statistics>,
    info: Arc<Statistics>,
    color_arrival: Option<Instant>,
    depth_arrival: Option<Instant>,
    silent: bool,
}

impl FusionNode {
    fn new(
        node: &Node,
        parameters: CameraFusionParameters,
        poses: BTreeMap<String, nalgebra::Isometry3<f64>>,
    ) -> Result<Self, NodeError> {
        Ok(Self {
            views: Views::new(&parameters, poses.clone()),
            cameras: Vec::new(),
            timeout: Duration::from_secs_f64(parameters.camera_timeout_s),
            active_since: Instant::now(),
            heightmap: node.publisher("heightmap", Qos::Latched)?,
            outputs: Outputs::new(node)?,
            last_fusion: Duration::ZERO,
            used: vec![None; parameters.cameras.len()],
            last: None,
            fused: 0,
            parameters,
            poses,
        })
    }

    /// Those that may be set at run time.
    fn take_over(&mut self, parameters: CameraFusionParameters) {
        self.timeout = Duration::from_secs_f64(parameters.camera_timeout_s);
        self.views.set_tolerance_s(parameters.tolerance_s);
        self.parameters = parameters;
    }

    /// Subscribes to one camera; each stream is decoded in a task of its own.
    fn listen(
        &mut self,
        node: &Node,
        index: usize,
        camera: &str,
        arrivals: &mpsc::Sender<Arrival>,
    ) -> anyhow::Result<()> {
        let color = format!("{camera}/color/image_raw");
        let depth = format!("{camera}/depth/image_rect_raw");
        let mut images = Vec::new();
        for (topic, stream) in [(color, Stream::Color), (depth, Stream::Depth)] {
            let mut subscription = node.subscription::<Image>(&topic, Qos::Image)?;
            images.push(Arc::clone(subscription.statistics()));
            let arrivals = arrivals.clone();
            node.spawn(async move {
                loop {
                    let image = subscription.recv().await;
                    if arrivals
                        .send(Arrival::Image(index, stream, image))
                        .await
                        .is_err()
                    {
                        return;
                    }
                }
            });
        }
        let topic = format!("{camera}/color/camera_info");
        let mut subscription = node.subscription::<CameraInfo>(&topic, Qos::Image)?;
        self.cameras.push(CameraTopics {
            name: camera.to_owned(),
            depth: images.remove(1),
            color: images.remove(0),
            info: Arc::clone(subscription.statistics()),
            color_arrival: None,
            depth_arrival: None,
            silent: false,
        });
        let arrivals = arrivals.clone();
        node.spawn(async move {
            loop {
                let info = subscription.recv().await;
                if arrivals
                    .send(Arrival::Info(index, Box::new(info)))
                    .await
                    .is_err()
                {
                    return;
                }
            }
        });
        Ok(())
    }

    fn arrived(&mut self, arrival: Arrival) {
        let taken = match arrival {
            Arrival::Info(camera, info) => self.views.calibrate(camera, &info).map(|()| false),
            Arrival::Image(camera, stream, image) => {
                let topics = &mut self.cameras[camera];
                let arrival = match stream {
                    Stream::Depth => &mut topics.depth_arrival,
                    Stream::Color | Stream::Info => &mut topics.color_arrival,
                };
                *arrival = Some(Instant::now());
                self.views.image(camera, stream, image)
            }
        };
        match taken {
            Ok(set_back) => {
                if set_back {
                    info!("the clock was set back: older images are forgotten");
                }
                self.fuse();
            }
            Err(complaint) => self.complain(&complaint),
        }
    }

    fn fuse(&mut self) {
        let start = Instant::now();
        let (fused, complaints) = self.views.fuse();
        complaints.iter().for_each(|bad| self.complain(bad));
        if let Some(fused) = fused {
            self.publish(fused, start);
        }
    }

    /// A camera that has fallen silent may have been all that was waited for.
    fn fuse_what_is_left(&mut self) {
        if self.views.fuses_without_silent() && self.cameras.iter().any(|camera| camera.silent) {
            self.fuse();
        }
    }

    fn publish(&mut self, fused: Fused, start: Instant) {
        let Fused {
            heightmap,
            message,
            stamp,
            used,
        } = fused;
        let header = message.header.clone();
        self.last = Some((stamp, message.views, message.coverage));
        self.used = used;
        self.heightmap.publish(message);
        self.last_fusion = start.elapsed();
        self.fused += 1;
        self.outputs.take(heightmap, header);
    }

    fn complain(&self, complaint: &Complaint) {
        let topics = &self.cameras[complaint.camera];
        let statistics = match complaint.stream {
            Stream::Color => &topics.color,
            Stream::Depth => &topics.depth,
            Stream::Info => &topics.info,
        };
        statistics.reject(&complaint.reason);
    }

    /// A camera is silent when nothing has come from it for the timeout while something has from
    /// another. When nothing comes from any, the cell is moving, or gone.
    fn look_for_silent_cameras(&mut self, node: &Node) {
        self.outputs.look(node);
        let (timeout, since) = (self.timeout, self.active_since);
        let recent = |arrival: Option<Instant>| arrival.is_some_and(|at| at.elapsed() <= timeout);
        // A camera that has not sent yet is given as long to begin.
        let missed = |arrival: Option<Instant>| arrival.unwrap_or(since).elapsed() > timeout;
        let any = self
            .cameras
            .iter()
            .any(|camera| recent(camera.color_arrival) || recent(camera.depth_arrival));
        for (index, camera) in self.cameras.iter_mut().enumerate() {
            let missing: Vec<&str> = [
                ("colour", camera.color_arrival),
                ("depth", camera.depth_arrival),
            ]
            .into_iter()
            .filter(|(_, arrival)| missed(*arrival))
            .map(|(stream, _)| stream)
            .collect();
            let silent = any && !missing.is_empty();
            if silent && !camera.silent {
                let then = if self.views.fuses_without_silent() {
                    "heightmaps are made without it"
                } else {
                    "no heightmap without it"
                };
                warn!(
                    "camera {}: no {} image for {timeout:?} while other images arrive; {then}",
                    camera.name,
                    missing.join(" and ")
                );
            } else if camera.silent && missing.is_empty() {
                info!("camera {}: images arrive again", camera.name);
            }
            camera.silent = silent || (camera.silent && !missing.is_empty());
            self.views.set_silent(index, camera.silent);
            let arrive = recent(camera.color_arrival) && recent(camera.depth_arrival);
            let (level, message) = match (missing.is_empty(), any) {
                (true, _) if arrive => (Level::Ok, "images arrive".to_owned()),
                (true, _) => (Level::Stale, "no image yet".to_owned()),
                (false, true) => (Level::Error, format!("no {} image", missing.join(" and "))),
                (false, false) => (Level::Stale, "no camera sends images".to_owned()),
            };
            let seconds = |stamp: Duration| format!("{:.9}", stamp.as_secs_f64());
            let used = self.used[index].map(|used| {
                [
                    ("last_used_color_stamp_s", seconds(used.color)),
                    ("last_used_depth_stamp_s", seconds(used.depth)),
                ]
            });
            node.diagnostics().set(
                format!("camera {}", camera.name),
                level,
                message,
                used.into_iter().flatten(),
            );
        }
        let took_ms = format!("{:.2}", self.last_fusion.as_secs_f64() * 1e3);
        let last = self.last.map(|(stamp, views, coverage)| {
            [
                ("stamp_s", format!("{:.9}", stamp.as_secs_f64())),
                ("views", views.to_string()),
                ("coverage", format!("{coverage:.4}")),
                ("last_image_to_heightmap_ms", took_ms),
            ]
        });
        node.diagnostics().set(
            "fusion",
            Level::Ok,
            format!("{} heightmaps", self.fused),
            last.into_iter().flatten(),
        );
        self.fuse_what_is_left();
    }
}
