//! Records the topics of a run as a bag.

use anyhow::{Context, Result};
use bags::{BagWriter, Compression, TopicHandle};
use msgs::sctn_msgs::{Goal, Heightmap, PickPlace, Reward, StepConfirmation, StepResult};
use msgs::sensor_msgs::{CameraInfo, Image, JointState};
use msgs::tf2_msgs::TFMessage;
use msgs::{Interface, rosgraph_msgs::Clock};
use node_kit::{Node, Qos};
use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::thread::JoinHandle;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

const CAMERAS: [&str; 3] = ["front", "left", "right"];

/// A message on its way to the bag.
type Write = Box<dyn FnOnce(&mut BagWriter) -> Result<()> + Send>;

/// Subscribes to the topics of a run; one thread writes what arrives.
pub struct Recorder {
    path: PathBuf,
    queue: mpsc::Sender<Write>,
    writer: JoinHandle<Result<BagWriter>>,
}

/// Everything that is said of one topic goes this way.
struct Topics<'a> {
    node: &'a Node,
    bag: BagWriter,
    started: Vec<Box<dyn FnOnce(mpsc::Sender<Write>)>>,
}

impl Recorder {
    /// Begins a bag; `images` also records what the cameras send.
    pub fn start(node: &Node, path: &Path, images: bool) -> Result<Self> {
        let bag = BagWriter::create(path, Compression::default()).context("begin the bag")?;
        let mut topics = Topics {
            node,
            bag,
            started: Vec::new(),
        };
        topics.record::<Heightmap>("heightmap", Qos::Latched, false)?;
        topics.record::<Goal>("goal", Qos::Latched, false)?;
        topics.record::<PickPlace>("pick_place", Qos::Latched, false)?;
        topics.record::<StepConfirmation>("step_confirmation", Qos::Event, false)?;
        // A step's result is the moment after which a crash must lose nothing of the step.
        topics.record::<StepResult>("step_result", Qos::Event, true)?;
        topics.record::<Reward>("reward", Qos::Event, true)?;
        topics.record::<JointState>("joint_states", Qos::Event, false)?;
        topics.record::<TFMessage>("/tf_static", Qos::Latched, false)?;
        topics.record::<Clock>("/clock", Qos::Image, false)?;
        for camera in CAMERAS.into_iter().filter(|_| images) {
            topics.record::<Image>(&format!("{camera}/color/image_raw"), Qos::Image, false)?;
            topics.record::<Image>(&format!("{camera}/depth/image_rect_raw"), Qos::Image, false)?;
            topics.record::<CameraInfo>(
                &format!("{camera}/color/camera_info"),
                Qos::Image,
                false,
            )?;
        }
        let Topics {
            mut bag, started, ..
        } = topics;
        let (queue, arrivals) = mpsc::channel::<Write>();
        let writer = std::thread::Builder::new()
            .name("recorder".into())
            .spawn(move || {
                for write in arrivals {
                    write(&mut bag)?;
                }
                Ok(bag)
            })?;
        for start in started {
            start(queue.clone());
        }
        Ok(Self {
            path: path.to_owned(),
            queue,
            writer,
        })
    }

    /// Completes the bag, once the node's tasks have ended; gives its path.
    pub async fn finish(self) -> Result<PathBuf> {
        let Self {
            path,
            queue,
            writer,
        } = self;
        drop(queue);
        let bag = tokio::task::spawn_blocking(move || writer.join()).await?;
        let bag = bag
            .map_err(|_| anyhow::anyhow!("the recorder's thread panicked"))?
            .context("record the run")?;
        bag.finish().context("complete the bag")?;
        Ok(path)
    }
}

impl Topics<'_> {
    /// Writes every message of a topic, at the time it arrives.
    fn record<M: Interface + Send + 'static>(
        &mut self,
        name: &str,
        qos: Qos,
        flush: bool,
    ) -> Result<()> {
        let offered = match qos {
            Qos::Image => bags::Qos::BEST_EFFORT,
            Qos::Latched => bags::Qos::LATCHED,
            _ => bags::Qos::RELIABLE,
        };
        let mut subscription = self.node.subscription::<M>(name, qos)?;
        let topic: TopicHandle = self.bag.add::<M>(&self.node.resolve(name), offered)?;
        let node = self.node.clone();
        self.started.push(Box::new(move |queue| {
            node.spawn(async move {
                loop {
                    let message = subscription.recv().await;
                    let time = SystemTime::now()
                        .duration_since(UNIX_EPOCH)
                        .unwrap_or(Duration::ZERO);
                    let write: Write = Box::new(move |bag| {
                        bag.write(topic, time, &message)?;
                        if flush {
                            bag.flush()?;
                        }
                        Ok(())
                    });
                    // The writer has failed: its error comes out at the end.
                    if queue.send(write).is_err() {
                        return;
                    }
                }
            });
        }));
        Ok(())
    }
}
