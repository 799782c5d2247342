//! What `sctn launch` records of a run.

use crate::launch::graph::Settings;
use anyhow::Result;
use bag_transport::{RECORDED_SUFFIX, Recorder, RecorderOptions, Recording};
use bags::Qos;
use msgs::Interface;
use msgs::rosgraph_msgs::Clock;
use msgs::sctn_msgs::{
    ConfirmationRefused, Goal, Heightmap, PickPlace, PlannedMotion, Reward, StepConfirmation,
    StepResult,
};
use msgs::sensor_msgs::{CameraInfo, Image, JointState};
use msgs::tf2_msgs::TFMessage;
use node_kit::plain_node;
use node_kit::{Context, Node};
use std::path::Path;
use std::time::Duration;

const CAMERAS: [&str; 3] = ["front", "left", "right"];
/// What was sent last may still be on its way, or have to be sent again: who sent it must live so long.
pub const LAST_WORDS: Duration = Duration::from_millis(500);
/// The same where the operator is a program of others: Fast DDS drops what its reader has not taken yet when the writer leaves, and a program on
/// a busy machine may be late.
pub const LAST_WORDS_ELSEWHERE: Duration = Duration::from_secs(2);
/// How long the desk may take to find the recorder.
const DISCOVERY: Duration = Duration::from_secs(20);
/// How long what shows the end of the run may take: images are best effort, and said again twice a second.
pub const LAST_HEIGHTMAP: Duration = Duration::from_secs(20);

const TOPICS: [(&str, &str, Qos); 12] = [
    ("heightmap", Heightmap::TYPE_NAME, Qos::LATCHED),
    ("goal", Goal::TYPE_NAME, Qos::LATCHED),
    ("pick_place", PickPlace::TYPE_NAME, Qos::LATCHED),
    ("pick_place_goal", PickPlace::TYPE_NAME, Qos::RELIABLE),
    ("planned_motion", PlannedMotion::TYPE_NAME, Qos::LATCHED),
    (
        "step_confirmation",
        StepConfirmation::TYPE_NAME,
        Qos::RELIABLE,
    ),
    ("step_result", StepResult::TYPE_NAME, Qos::RELIABLE),
    (
        "confirmation_refused",
        ConfirmationRefused::TYPE_NAME,
        Qos::RELIABLE,
    ),
    ("reward", Reward::TYPE_NAME, Qos::RELIABLE),
    ("joint_states", JointState::TYPE_NAME, Qos::RELIABLE),
    ("/tf_static", TFMessage::TYPE_NAME, Qos::LATCHED),
    ("/clock", Clock::TYPE_NAME, Qos::BEST_EFFORT),
];

/// A run that is being recorded, by a node of its own: so it hears the operator of this command too.
pub struct RunRecorder {
    context: Context,
    node: Node,
    recorder: Recorder,
}

impl RunRecorder {
    /// Begins a bag; `images` also records what the cameras send.
    pub fn start(path: &Path, settings: &Settings, images: bool) -> Result<Self> {
        let (context, node) = plain_node("sctn_recorder", &[])?;
        let mut recorder = Recorder::start(&node, path, RecorderOptions::default())?;
        recorder.note("problem", &settings.problem);
        recorder.note("seed", settings.seed);
        recorder.note("goal_module", &settings.goal_module);
        for (topic, type_name, offered) in TOPICS {
            recorder.expect(topic, type_name, offered)?;
        }
        for camera in CAMERAS.into_iter().filter(|_| images) {
            for (topic, type_name) in [
                ("color/image_raw", Image::TYPE_NAME),
                ("depth/image_rect_raw", Image::TYPE_NAME),
                ("color/camera_info", CameraInfo::TYPE_NAME),
            ] {
                recorder.expect(&format!("{camera}/{topic}"), type_name, Qos::BEST_EFFORT)?;
            }
        }
        Ok(Self {
            context,
            node,
            recorder,
        })
    }

    /// Topic on which a step result is said once the bag holds it: a step goes on from what cannot be lost any more.
    pub fn kept_results() -> String {
        format!("step_result/{RECORDED_SUFFIX}")
    }

    /// Waits until somebody listens to [`Self::kept_results`].
    pub async fn wait_for_desk(&self) {
        let topic = self.node.resolve(&Self::kept_results());
        let graph = self.node.graph();
        for topic in graph.wait_for_subscriptions(&[topic], DISCOVERY).await {
            tracing::warn!("nobody listens to {topic}");
        }
    }

    /// Waits for a heightmap that is not older than `measured_ns`, if there is one to come;
    /// to be called before the nodes end.
    pub async fn last_words(&self, measured_ns: Option<i64>) {
        let shown = async {
            while self.recorder.last_stamp_ns("heightmap") < measured_ns {
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        };
        if tokio::time::timeout(LAST_HEIGHTMAP, shown).await.is_err() {
            tracing::warn!("the bag has no heightmap of after the last step");
        }
    }

    /// Waits until the recording has ended by itself.
    pub async fn ended(&self) {
        self.recorder.ended().await;
    }

    /// Completes the bag.
    pub async fn finish(self) -> Result<Recording> {
        let recording = self.recorder.finish().await;
        self.context.shutdown();
        Ok(recording?)
    }
}
