//! The executor's heartbeat: the watchdog hears that this process lives while a motion is under way.

use std::time::Duration;

use msgs::std_msgs::Bool;
use node_kit::{Node, NodeError, Publisher, Qos, TaskGroup};
use tokio::sync::watch;
use tokio::time::timeout;

use crate::planted::{Planted, is_planted};

/// Topic of the heartbeat: whether a motion is under way.
const TOPIC: &str = "motion_heartbeat";
/// How often the watchdog hears that a motion is under way.
const PERIOD: Duration = Duration::from_millis(50);

/// Says on a topic what this executor is at.
pub struct Heartbeat {
    /// How many motions are under way, goals that are not answered yet included.
    moving: watch::Sender<usize>,
    /// Whether the last heartbeat said that a motion is under way.
    said: watch::Receiver<bool>,
}

/// A motion is under way until this is dropped.
pub(crate) struct Moving(watch::Sender<usize>);

impl Drop for Moving {
    fn drop(&mut self) {
        self.0.send_modify(|moving| *moving -= 1);
    }
}

impl Heartbeat {
    pub(crate) fn new(node: &Node, tasks: &TaskGroup) -> Result<Self, NodeError> {
        let moving = watch::Sender::new(0);
        let (saying, said) = watch::channel(false);
        let heartbeats = node.publisher::<Bool>(TOPIC, Qos::Event)?;
        tasks.spawn(beat(heartbeats, moving.subscribe(), saying));
        Ok(Self { moving, said })
    }

    /// A motion begins.
    pub(crate) fn moving(&self) -> Moving {
        self.moving.send_modify(|moving| *moving += 1);
        Moving(self.moving.clone())
    }

    /// How many motions are under way and goals unanswered.
    #[cfg(test)]
    pub(crate) fn under_way(&self) -> usize {
        *self.moving.borrow()
    }

    /// Waits until no motion is under way and no goal is unanswered.
    pub(crate) async fn idle(&self) {
        let mut moving = self.moving.subscribe();
        // The sender lives as long as this.
        let _ = moving.wait_for(|moving| *moving == 0).await;
    }

    /// The same, and until the watchdog was told so.
    pub async fn quiet(&self) {
        self.idle().await;
        let mut said = self.said.clone();
        // An error: nothing is said any more.
        let _ = said.wait_for(|moving| !moving).await;
    }
}

async fn beat(
    heartbeats: Publisher<Bool>,
    mut moving: watch::Receiver<usize>,
    saying: watch::Sender<bool>,
) {
    let mut silent = true;
    loop {
        let is_moving = *moving.borrow_and_update() > 0;
        // Once more after the last motion.
        if (is_moving || !silent) && !is_planted(Planted::NoHeartbeat) {
            heartbeats.publish(Bool { data: is_moving });
        }
        saying.send_replace(is_moving);
        silent = !is_moving;
        let pause = match is_moving {
            true => PERIOD,
            false => Duration::MAX,
        };
        if let Ok(Err(_)) = timeout(pause, moving.changed()).await {
            return;
        }
    }
}
