//! Node that fuses camera views into heightmaps.
//!
//! What belongs together and what is wrong with it is decided by the library `frame_synchronizer`.

mod image;
mod outputs;
mod parameters;

use std::{
    collections::{BTreeMap, VecDeque},
    path::Path,
    sync::Arc,
    time::{Duration, Instant},
};

use calibration::read_calibration;
use frame_synchronizer::{FrameSynchronizer, Fused, InputError, Stream, Used};
use msgs::{
    convert, sctn_msgs,
    sensor_msgs::{CameraInfo, Image},
    tf2_msgs::TFMessage,
};
use node_kit::{
    Active, Clock, ImageSubscription, Level, Node, NodeError, Publisher, Qos, Statistics,
    ns_from_stamp,
};
#[cfg(not(test))]
use node_kit::{Context, NodeLife, RosArguments};
use tokio::sync::mpsc;
use tracing::{info, warn};

use outputs::Outputs;

pub use image::ImageMessage;
pub use parameters::{CameraFusionParameters, WorkspaceParameters};

/// Messages between their subscriptions and the fusion.
const WAITING_ARRIVALS: usize = 32;
/// How often silent cameras are looked for.
const LOOK_PERIOD: Duration = Duration::from_millis(250);

/// How long transforms and calibrations may take to come after the first image without a word: the processes of a cell start one by one.
const START_PATIENCE: Duration = Duration::from_secs(5);

/// What a camera has sent.
enum Arrival {
    Image(usize, Stream, Image),
    Info(usize, Stream, Box<CameraInfo>),
}

/// Starts the node in a context. It is compiled here, once, and not anew in every program that has it; tests of this library have no use for it.
#[cfg(not(test))]
pub fn start(context: &Context, arguments: &RosArguments) -> anyhow::Result<NodeLife> {
    context.start("camera_fusion", arguments, configure)
}

/// Reads the calibration and returns the node that fuses.
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
        self.synchronizer = FrameSynchronizer::new(self.parameters.settings(), self.poses.clone());
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
                    let insert = |parent: &str, child: &str, pose| self.synchronizer.transform(parent, child, pose);
                    for invalid in convert::transforms_from_msg(&message, insert) {
                        transforms.reject(invalid);
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
    synchronizer: FrameSynchronizer<ImageMessage>,
    cameras: Vec<CameraTopics>,
    timeout: Duration,
    active_since: Instant,
    heightmap: Publisher<sctn_msgs::Heightmap>,
    outputs: Outputs,
    last_fusion: Duration,
    clock: Clock,
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
    depth_info: Arc<Statistics>,
    /// What its images wait for, and since when.
    pending: Option<Pending>,
    skew: Skew,
    color_arrival: Option<Instant>,
    depth_arrival: Option<Instant>,
    silent: bool,
}

/// Something that is sent once and has not come yet.
struct Pending {
    since: Instant,
    reason: String,
    told: bool,
}

/// How far the stamps of a camera are from the time of their arrival.
#[derive(Default)]
struct Skew {
    /// The last ones, later arrival positive [s].
    recent_s: VecDeque<f64>,
    told: bool,
}

/// Images whose skew is looked at together.
const SKEW_WINDOW: usize = 15;

impl Skew {
    /// The median of the last images, once there are enough.
    fn median_s(&self) -> Option<f64> {
        let mut sorted: Vec<f64> = self.recent_s.iter().copied().collect();
        sorted.sort_by(f64::total_cmp);
        (sorted.len() == SKEW_WINDOW).then(|| sorted[SKEW_WINDOW / 2])
    }

    /// Takes one more image; the skew, when it is to be warned about.
    fn add(&mut self, skew_s: f64, limit_s: f64) -> Option<f64> {
        self.recent_s.push_back(skew_s);
        if self.recent_s.len() > SKEW_WINDOW {
            self.recent_s.pop_front();
        }
        let skewed = self.median_s().filter(|skew_s| skew_s.abs() > limit_s);
        if skewed.is_none() && self.recent_s.len() == SKEW_WINDOW {
            self.told = false;
        }
        let new = skewed.filter(|_| !self.told);
        self.told |= new.is_some();
        new
    }
}

impl FusionNode {
    fn new(
        node: &Node,
        parameters: CameraFusionParameters,
        poses: BTreeMap<String, nalgebra::Isometry3<f64>>,
    ) -> Result<Self, NodeError> {
        Ok(Self {
            synchronizer: FrameSynchronizer::new(parameters.settings(), poses.clone()),
            cameras: Vec::new(),
            timeout: Duration::from_secs_f64(parameters.camera_timeout_s),
            active_since: Instant::now(),
            heightmap: node.publisher("heightmap", Qos::Latched)?,
            outputs: Outputs::new(node)?,
            last_fusion: Duration::ZERO,
            clock: node.clock().clone(),
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
        self.synchronizer.set_tolerance(parameters.tolerance());
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
        let topics = self.parameters.camera_preset.topics(camera);
        let mut images = Vec::new();
        for (topic, stream) in [(topics.color, Stream::Color), (topics.depth, Stream::Depth)] {
            let mut subscription = ImageSubscription::<Image>::new(node, &topic)?;
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
        let mut infos = Vec::new();
        for (topic, stream) in [
            (topics.color_info, Stream::Info),
            (topics.depth_info, Stream::DepthInfo),
        ] {
            let mut subscription = node.subscription::<CameraInfo>(&topic, Qos::Image)?;
            infos.push(Arc::clone(subscription.statistics()));
            let arrivals = arrivals.clone();
            node.spawn(async move {
                loop {
                    let info = Box::new(subscription.recv().await);
                    let arrival = Arrival::Info(index, stream, info);
                    if arrivals.send(arrival).await.is_err() {
                        return;
                    }
                }
            });
        }
        self.cameras.push(CameraTopics {
            name: camera.to_owned(),
            depth: images.remove(1),
            color: images.remove(0),
            depth_info: infos.remove(1),
            info: infos.remove(0),
            pending: None,
            skew: Skew::default(),
            color_arrival: None,
            depth_arrival: None,
            silent: false,
        });
        Ok(())
    }

    fn arrived(&mut self, arrival: Arrival) {
        let taken = match arrival {
            Arrival::Info(camera, stream, info) => {
                let read = convert::intrinsics_from_msg(&info).map_err(|error| error.to_string());
                let taken = self.synchronizer.calibrate(camera, stream, read);
                taken.map(|()| false)
            }
            Arrival::Image(camera, stream, image) => {
                let topics = &mut self.cameras[camera];
                let arrival = match stream {
                    Stream::Depth | Stream::DepthInfo => &mut topics.depth_arrival,
                    Stream::Color | Stream::Info => &mut topics.color_arrival,
                };
                *arrival = Some(Instant::now());
                let now_ns = ns_from_stamp(&self.clock.now());
                let skew_s = (now_ns - ns_from_stamp(&image.header.stamp)) as f64 * 1e-9;
                // A simulated clock that has not been heard yet says 0.
                if now_ns != 0
                    && let Some(skew_s) =
                        topics.skew.add(skew_s, self.parameters.clock_skew_limit_s)
                {
                    let direction = if skew_s > 0.0 { "before" } else { "after" };
                    warn!(
                        "camera {}: its images arrive with stamps {:.3} s {direction} this host's time, expected at most {} s: synchronise \
                         the clocks",
                        topics.name,
                        skew_s.abs(),
                        self.parameters.clock_skew_limit_s
                    );
                }
                convert::time_from_msg(&image.header.stamp)
                    .map(|stamp| {
                        let image = ImageMessage(image);
                        self.synchronizer.image(camera, stream, stamp, image)
                    })
                    .map_err(|error| InputError::new(camera, stream, format!("header.{error}")))
            }
        };
        match taken {
            Ok(set_back) => {
                if set_back {
                    info!("the clock was set back: older images are forgotten");
                }
                self.fuse();
            }
            Err(error) => self.complain(&error),
        }
    }

    fn fuse(&mut self) {
        let start = Instant::now();
        let (fused, errors) = self.synchronizer.fuse();
        if fused.is_some() || !errors.is_empty() {
            for (index, camera) in self.cameras.iter_mut().enumerate() {
                let mut errors = errors.iter();
                if !errors.any(|bad| bad.camera == index && bad.pending) {
                    camera.pending = None;
                }
            }
        }
        errors.iter().for_each(|bad| self.complain(bad));
        if let Some(fused) = fused {
            self.publish(fused, start);
        }
    }

    /// A camera that has fallen silent may have been all that was waited for.
    fn fuse_what_is_left(&mut self) {
        if self.synchronizer.fuses_without_silent()
            && self.cameras.iter().any(|camera| camera.silent)
        {
            self.fuse();
        }
    }

    fn publish(&mut self, fused: Fused, start: Instant) {
        let Fused {
            heightmap,
            report,
            stamp,
            used,
        } = fused;
        let header = convert::header(stamp, &self.parameters.world_frame);
        let message = header.and_then(|header| {
            let heightmap = heightmap.clone();
            convert::heightmap_to_msg(heightmap, header, report.views, report.coverage)
        });
        let message = match message {
            Ok(message) => message,
            Err(error) => return self.heightmap.statistics().reject(error),
        };
        let header = message.header.clone();
        self.last = Some((stamp, message.views, message.coverage));
        self.used = used;
        self.heightmap.publish(message);
        self.last_fusion = start.elapsed();
        self.fused += 1;
        self.outputs.take(heightmap, header);
    }

    fn complain(&mut self, error: &InputError) {
        let topics = &mut self.cameras[error.camera];
        let statistics = match error.stream {
            Stream::Color => &topics.color,
            Stream::Depth => &topics.depth,
            Stream::Info => &topics.info,
            Stream::DepthInfo => &topics.depth_info,
        };
        if !error.pending {
            statistics.reject(&error.reason);
            return;
        }
        let pending = topics.pending.get_or_insert_with(|| Pending {
            since: Instant::now(),
            reason: String::new(),
            told: false,
        });
        if pending.reason != error.reason {
            pending.reason.clone_from(&error.reason);
            pending.told = false;
        }
        if !pending.told && pending.since.elapsed() >= START_PATIENCE {
            pending.told = true;
            warn!(
                "{}: {}; waited for it for {START_PATIENCE:?}, images of camera {} are not used",
                statistics.name(),
                error.reason,
                topics.name
            );
        }
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
                let then = if self.synchronizer.fuses_without_silent() {
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
            self.synchronizer.set_silent(index, camera.silent);
            let arrive = recent(camera.color_arrival) && recent(camera.depth_arrival);
            let (level, message) = match (missing.is_empty(), any) {
                (true, _) if camera.pending.is_some() => {
                    let reason = camera
                        .pending
                        .as_ref()
                        .map_or("", |pending| &pending.reason);
                    (Level::Warn, format!("waits: {reason}"))
                }
                (true, _) if arrive => (Level::Ok, "images arrive".to_owned()),
                (true, _) => (Level::Stale, "no image yet".to_owned()),
                (false, true) => (Level::Error, format!("no {} image", missing.join(" and "))),
                (false, false) => (Level::Stale, "no camera sends images".to_owned()),
            };
            let seconds = |stamp: Duration| format!("{:.9}", stamp.as_secs_f64());
            let skew = camera.skew.median_s();
            let skew = skew.map(|skew_s| ("clock_skew_s", format!("{skew_s:.3}")));
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
                used.into_iter().flatten().chain(skew),
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_that_is_off_is_warned_about_once_and_a_single_late_image_is_not() {
        let mut skew = Skew::default();
        let mut warnings = |values: &[f64]| {
            let new = values.iter().filter_map(|value| skew.add(*value, 1.0));
            new.collect::<Vec<_>>()
        };
        assert_eq!(warnings(&[0.05; 20]), []);
        assert_eq!(warnings(&[3.0]), []);
        assert_eq!(warnings(&[0.05; 20]), []);
        // Three seconds ahead of the host.
        assert_eq!(warnings(&[-3.0; 30]), [-3.0]);
        assert_eq!(warnings(&[0.1; 30]), []);
        assert_eq!(warnings(&[5.0; 30]), [5.0]);
    }
}
