//! From the last camera frame to the proposal, over DDS through camera_fusion and gctn_policy.

use crate::demos::demonstration;
use crate::root::Root;
use anyhow::{Context as _, Result, bail};
use cell_emulation::cameras::{CameraTopics, Frame, camera_transforms};
use gctn::{Compact, ModelCard, Network, NetworkConfig, Storage, Trainer, TrainingConfig};
use msgs::convert;
use msgs::sctn_msgs::{Goal, PickPlace};
use msgs::tf2_msgs::TFMessage;
use multiravens::Environment;
use node_kit::{Context, NoParameters, Node, Publisher, Qos, RosArguments, Subscription};
use std::time::{Duration, Instant};
use tokio::runtime::Runtime;

const PATIENCE: Duration = Duration::from_secs(10);

/// The two nodes, and cameras that show them one scene again and again.
pub struct Chain {
    runtime: Runtime,
    context: Context,
    /// Its publishers are mute without it.
    _node: Node,
    cameras: Vec<CameraTopics>,
    images: Vec<(heightmap::Camera, multiravens::render::RgbdImage)>,
    goals: Publisher<Goal>,
    _transforms: Publisher<TFMessage>,
    proposals: Subscription<PickPlace>,
    goal: Goal,
    captures: u32,
    /// Sets of images that a heightmap is the median of.
    frames: u32,
}

/// Between the sets of a capture.
const PERIOD: Duration = Duration::from_millis(33);
/// By how much nearer everything is while something moves in front of the cameras.
const NEARER: f32 = 0.9;

impl Chain {
    pub fn start(root: &Root, seed: u64, frames: u32) -> Result<Self> {
        let (problem, work_cell) = (root.problem("placing")?, root.work_cell()?);
        let mut environment = Environment::new(&problem, &work_cell);
        environment.reset(seed)?;
        environment.observe()?;
        let cameras: Vec<_> = environment
            .cell()
            .views()
            .map(|view| view.camera.clone())
            .collect();
        let images: Vec<_> = cameras
            .iter()
            .cloned()
            .zip(environment.cell_mut().render()?.to_vec())
            .collect();
        let shown = demonstration(&problem, &work_cell, seed)?;
        let reached = shown
            .goals()
            .into_iter()
            .next()
            .context("a demonstration without goals")?
            .clone();
        // On the full grid, yet as good as free: what is measured is all but the network.
        let network = NetworkConfig {
            rotations: 1,
            ..NetworkConfig::new(Network::Compact(Compact {
                channels: [1; 4],
                window_cells: 3,
                ..Compact::default()
            }))
        };
        let folder = tempfile::tempdir().context("folder for the checkpoint")?;
        let checkpoint = folder.path().join("least.safetensors");
        Trainer::new(&network, &TrainingConfig::compact())?.save_checkpoint(
            &checkpoint,
            Storage::F32,
            &ModelCard::new(),
        )?;

        let runtime = tokio::runtime::Builder::new_multi_thread()
            .enable_all()
            .build()?;
        let entered = runtime.enter();
        let context = Context::new(node_kit::Network::unused()?);
        let arguments = |words: &[String]| -> Result<RosArguments> {
            Ok(RosArguments::parse(words.iter().cloned())?.0)
        };
        let file = |node: &str| {
            root.join(format!("config/{node}.yaml"))
                .display()
                .to_string()
        };
        let words = [
            "--ros-args".to_owned(),
            "--params-file".into(),
            file("camera_fusion"),
            "-p".into(),
            format!("frames:={frames}"),
        ];
        camera_fusion::start(&context, &arguments(&words)?)?;
        let given = format!("checkpoint:={}", checkpoint.display());
        let words = [
            "--ros-args".to_owned(),
            "--params-file".into(),
            file("gctn_policy"),
            "-p".into(),
            given,
        ];
        gctn_policy::start(&context, &arguments(&words)?)?;

        let (node, _) = context.node::<NoParameters>("sctn_bench", &RosArguments::default())?;
        let transforms = node.publisher::<TFMessage>("/tf_static", Qos::Latched)?;
        transforms.publish(camera_transforms(&cameras, "world", Duration::ZERO)?);
        let topics = cameras
            .iter()
            .map(|camera| CameraTopics::new(&node, &camera.name));
        let header = convert::header(Duration::ZERO, "world")?;
        let settings = shown
            .steps
            .first()
            .context("a demonstration without steps")?
            .settings;
        let goal = Goal {
            problem: "placing".into(),
            demonstration: "bench".into(),
            step: 1,
            step_count: 9,
            module: "placing".into(),
            settings: convert::settings_to_msg(&settings),
            heightmap: convert::heightmap_to_msg(reached, header.clone(), 3, 1.0)?,
            header,
            ..Goal::default()
        };
        let chain = Self {
            cameras: topics.collect::<Result<_, _>>()?,
            images,
            goals: node.publisher("goal", Qos::Latched)?,
            _transforms: transforms,
            proposals: node.subscription("pick_place", Qos::Latched)?,
            goal,
            captures: 0,
            frames,
            context,
            _node: node,
            runtime: {
                drop(entered);
                runtime
            },
        };
        Ok(chain)
    }

    /// Waits until the nodes have found each other and the first proposal comes.
    pub fn warm_up(&mut self) -> Result<()> {
        let deadline = Instant::now() + PATIENCE;
        while Instant::now() < deadline {
            if self.capture(Duration::from_secs(1)).is_ok() {
                return Ok(());
            }
        }
        bail!("camera_fusion and gctn_policy made no proposal within {PATIENCE:?}")
    }

    /// Time from the last frame of a new capture to its proposal. Where a heightmap is the median of several sets, something moves before, and
    /// as many sets are sent as the median takes.
    pub fn measure(&mut self) -> Result<Duration> {
        self.capture(PATIENCE)
    }

    fn capture(&mut self, limit: Duration) -> Result<Duration> {
        self.captures += 1;
        let stamp = Duration::from_secs(u64::from(self.captures));
        self.goal.attempt = self.captures;
        self.goal.header = convert::header(stamp, "world")?;
        let moving = self.images.iter().map(|(camera, image)| {
            let mut image = image.clone();
            image.depth_m.iter_mut().for_each(|depth| *depth *= NEARER);
            (camera.clone(), image)
        });
        let moving: Vec<_> = match self.frames {
            1 => Vec::new(),
            _ => moving.collect(),
        };
        let still = (0..self.frames).map(|_| &self.images);
        let sets = (self.frames > 1)
            .then_some(&moving)
            .into_iter()
            .chain(still);
        let sets: Vec<_> = sets.collect();
        let mut captured = Vec::new();
        for (index, set) in sets.iter().enumerate() {
            let before = PERIOD * (sets.len() - 1 - index) as u32;
            let frames = set
                .iter()
                .map(|(camera, image)| Frame::new(camera, image, stamp - before));
            captured.push(frames.collect::<Result<Vec<_>, _>>()?);
        }
        let Self {
            runtime,
            cameras,
            goals,
            goal,
            proposals,
            ..
        } = self;
        runtime.block_on(async {
            goals.publish(goal.clone());
            // The goal is there before the picture, as in a run.
            tokio::time::sleep(Duration::from_millis(30)).await;
            let mut start = Instant::now();
            let last = captured.len() - 1;
            for (index, frames) in captured.into_iter().enumerate() {
                for (camera, frame) in cameras.iter().zip(frames) {
                    start = Instant::now();
                    camera.publish(frame);
                }
                if index < last {
                    tokio::time::sleep(PERIOD).await;
                }
            }
            let sought = convert::time_to_msg(stamp)?;
            let proposal = async { while proposals.recv().await.header.stamp != sought {} };
            tokio::time::timeout(limit, proposal)
                .await
                .context("no proposal")?;
            Ok(start.elapsed())
        })
    }
}

impl Drop for Chain {
    fn drop(&mut self) {
        self.context.shutdown();
    }
}
