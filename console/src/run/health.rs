//! Whether everything that has to be heard is heard, and what nodes and robot say of themselves.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Serialize;

use super::Run;

/// Nodes whose diagnostics are kept.
const NODES: usize = 64;

/// A node's diagnostics.
#[derive(Debug, Default)]
pub(super) struct NodeHealth {
    pub(super) heard: Duration,
    /// Name of the state, level, message.
    pub(super) states: BTreeMap<String, (u8, String)>,
    /// Age of each camera stream when the diagnostics were sent [s]; nothing where none has come.
    pub(super) images: BTreeMap<String, Option<f64>>,
}

/// What a node says of a part of itself.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NodeReport {
    /// Full name of the node.
    pub node: String,
    /// The part; `topics` tells what it hears.
    pub state: String,
    /// 0 well, 1 warning, 2 error, 3 stale.
    pub level: u8,
    /// How it is, for people.
    pub message: String,
    /// Keys and values; of `topics`, each topic and how it is heard.
    pub values: Vec<(String, String)>,
}

/// State of the robot as its driver says.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Robot {
    /// `ur_dashboard_msgs/RobotMode`.
    pub robot_mode: Option<i8>,
    /// `ur_dashboard_msgs/SafetyMode`.
    pub safety_mode: Option<u8>,
    /// Whether the robot program runs.
    pub program_running: Option<bool>,
    /// Share of the planned speed that the arm moves with.
    pub speed_scaling: Option<f64>,
    /// Whether suction is on.
    pub suction: Option<bool>,
    /// Whether the vacuum sensor feels an object.
    pub vacuum: Option<bool>,
}

impl Run {
    /// A node has said how it is.
    pub fn on_report(&mut self, report: NodeReport, now: Duration) {
        let NodeReport {
            node,
            state,
            level,
            message,
            values,
        } = report;
        if !self.health.contains_key(&node) && self.health.len() >= NODES {
            return;
        }
        let health = self.health.entry(node).or_default();
        health.heard = now;
        if state == "topics" {
            // What has been deactivated says nothing any more.
            health.states.clear();
            health.images.clear();
            for (topic, line) in values {
                if let Some(age_s) = image_age(&topic, &line) {
                    health.images.insert(topic, age_s);
                }
            }
        }
        health.states.insert(state, (level, message));
    }

    /// The joints have been read.
    pub fn on_joints(&mut self, names: Vec<String>, positions_rad: Vec<f64>, now: Duration) {
        self.joints = Some((now, names, positions_rad));
    }

    /// The driver has said something of the robot.
    pub fn on_robot(&mut self, change: impl FnOnce(&mut Robot)) {
        change(&mut self.robot);
    }

    /// The age of all that should come regularly.
    pub(super) fn streams(&self, now: Duration) -> Vec<Stream> {
        let limit_s = self.watch.stale_after.as_secs_f64();
        let stream = |name: String, age_s: Option<f64>, required| Stream {
            name,
            age_s,
            stale: age_s.is_none_or(|age_s| age_s > limit_s),
            required,
        };
        let since = |heard: Duration| now.saturating_sub(heard).as_secs_f64();
        let mut streams = Vec::new();
        for node in &self.watch.nodes {
            let heard = self.health.get(node).map(|health| since(health.heard));
            streams.push(stream(node.trim_start_matches('/').to_owned(), heard, true));
        }
        let watched = self
            .health
            .iter()
            .filter(|(node, _)| self.watch.nodes.contains(*node));
        for (_, health) in watched {
            for (topic, age_s) in &health.images {
                let age_s = age_s.map(|age_s| age_s + since(health.heard));
                streams.push(stream(
                    topic.trim_start_matches('/').to_owned(),
                    age_s,
                    true,
                ));
            }
        }
        let joints = self.joints.as_ref().map(|(heard, ..)| since(*heard));
        streams.push(stream("joint_states".to_owned(), joints, true));
        streams
    }
}

/// The age that a node's diagnostics give for an image topic that it hears.
fn image_age(topic: &str, line: &str) -> Option<Option<f64>> {
    if !(topic.ends_with("/image_raw") || topic.ends_with("/image_rect_raw")) {
        return None;
    }
    let words = line.strip_prefix("in ")?.split_whitespace();
    let age = words
        .filter_map(|word| word.strip_prefix("age_s="))
        .next()?;
    Some(age.parse().ok())
}

/// The worst thing that a node says of itself. Drops of single messages are no news to an operator.
pub(super) fn worst(health: &NodeHealth) -> NodeState<'_> {
    let states = health.states.iter().filter(|(state, _)| *state != "topics");
    let worst = states.max_by_key(|(_, (level, _))| *level);
    let (state, (level, message)) = match worst {
        Some((state, said)) => (state.as_str(), said),
        None => ("", &(0, String::new())),
    };
    NodeState {
        level: *level,
        state,
        message: message.clone(),
    }
}

#[derive(Debug, Serialize)]
pub(super) struct Stream {
    pub(super) name: String,
    pub(super) age_s: Option<f64>,
    pub(super) stale: bool,
    pub(super) required: bool,
}

#[derive(Debug, Serialize)]
pub(super) struct NodeState<'a> {
    level: u8,
    state: &'a str,
    message: String,
}
