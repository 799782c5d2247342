//! Whether everything that has to be heard is heard, and what nodes and robot say of themselves.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Serialize;

use step_protocol::RunPhase;

use super::Run;
use crate::preview::MOST_JOINTS;

/// Nodes whose diagnostics are kept.
const NODES: usize = 64;
/// Joint positions are taken over at most this often: a UR5 sends 500 a second.
const JOINTS_PERIOD: Duration = Duration::from_millis(100);

/// A node's diagnostics.
#[derive(Debug, Default)]
pub(super) struct NodeHealth {
    pub(super) heard: Duration,
    /// Name of the state, level, message.
    pub(super) states: BTreeMap<String, (u8, String)>,
    /// Age of each camera stream when the diagnostics were sent [s]; `None` where none has come.
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

impl NodeReport {
    /// Of a diagnostic status; `None` where its name is not `NODE: PART`.
    pub fn of_status(
        name: &str,
        level: u8,
        message: String,
        values: impl IntoIterator<Item = (String, String)>,
    ) -> Option<Self> {
        let (node, state) = name.split_once(": ")?;
        Some(Self {
            node: node.to_owned(),
            state: state.to_owned(),
            level,
            message,
            values: values.into_iter().collect(),
        })
    }
}

/// Where the joints are.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Joints {
    names: Vec<String>,
    positions_rad: Vec<f64>,
}

/// Joints that make no sense.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{names} names and {positions} positions, expected as many of each, at most {MOST_JOINTS}")]
pub struct InvalidJoints {
    names: usize,
    positions: usize,
}

impl Joints {
    /// Their names, and a position (rad) for each.
    ///
    /// # Errors
    /// When there are not as many positions as names, or too many.
    pub fn new(names: Vec<String>, positions_rad: Vec<f64>) -> Result<Self, InvalidJoints> {
        if names.len() != positions_rad.len() || names.len() > MOST_JOINTS {
            return Err(InvalidJoints {
                names: names.len(),
                positions: positions_rad.len(),
            });
        }
        Ok(Self {
            names,
            positions_rad,
        })
    }
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
                let mut endings = self.watch.image_topics.iter();
                if endings.any(|ending| topic.ends_with(ending))
                    && let Some(age_s) = heard_age(&line)
                {
                    health.images.insert(topic, age_s);
                }
            }
        }
        health.states.insert(state, (level, message));
    }

    /// The joints have been read. Returns whether viewers are to be told: they see the arm move.
    pub fn on_joints(&mut self, joints: Joints, now: Duration) -> bool {
        let last = self.joints.as_ref().map(|(heard, ..)| *heard);
        if last.is_some_and(|last| now.saturating_sub(last) < JOINTS_PERIOD) {
            return false;
        }
        self.joints = Some((now, joints.names, joints.positions_rad));
        self.phase() == RunPhase::Moving
    }

    /// The driver has said whether suction is on and whether the vacuum sensor feels an object, where it has those pins. Returns
    /// whether viewers are to be told: what is held can be put down.
    pub fn on_pins(&mut self, suction: Option<bool>, vacuum: Option<bool>) -> bool {
        let held = self.holds();
        (self.robot.suction, self.robot.vacuum) = (suction, vacuum);
        self.holds() != held
    }

    /// The driver has said in which mode the robot is.
    pub fn on_robot_mode(&mut self, mode: i8) {
        self.robot.robot_mode = Some(mode);
    }

    /// The driver has said in which mode the robot's safety system is.
    pub fn on_safety_mode(&mut self, mode: u8) {
        self.robot.safety_mode = Some(mode);
    }

    /// The driver has said whether the robot program runs.
    pub fn on_program(&mut self, runs: bool) {
        self.robot.program_running = Some(runs);
    }

    /// The driver has said with how many percent of the planned speed the arm moves.
    pub fn on_speed_scaling(&mut self, percent: f64) {
        self.robot.speed_scaling = percent.is_finite().then_some(percent / 100.0);
    }

    /// Whether the vacuum sensor feels an object.
    pub fn holds(&self) -> bool {
        self.robot.vacuum == Some(true)
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

/// The age that a node's diagnostics give for a topic that it hears.
fn heard_age(line: &str) -> Option<Option<f64>> {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joints_without_positions_are_refused() {
        let names = |count| vec!["elbow_joint".to_owned(); count];
        let error = Joints::new(names(1), Vec::new()).unwrap_err().to_string();
        assert!(error.starts_with("1 names and 0 positions"), "{error}");
        assert!(Joints::new(names(MOST_JOINTS), vec![0.0; MOST_JOINTS]).is_ok());
        let many = MOST_JOINTS + 1;
        assert!(Joints::new(names(many), vec![0.0; many]).is_err());
    }

    #[test]
    fn a_status_without_a_node_in_its_name_is_no_report() {
        let of = |name| NodeReport::of_status(name, 0, String::new(), []);
        assert_eq!(of("motors"), None);
        let report = of("/camera_fusion: topics").unwrap();
        assert_eq!(
            (&*report.node, &*report.state),
            ("/camera_fusion", "topics")
        );
    }
}
