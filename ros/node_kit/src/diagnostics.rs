//! `/diagnostics`: what a node is doing, once a second.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use msgs::{
    builtin_interfaces::Time,
    diagnostic_msgs::{DiagnosticArray, DiagnosticStatus, KeyValue},
    std_msgs::Header,
};

use crate::{
    endpoint::Direction,
    statistics::{Snapshot, Statistics},
};

pub(crate) const PERIOD: Duration = Duration::from_secs(1);

/// How bad a state is, with the numbers of diagnostic_msgs/DiagnosticStatus.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum Level {
    /// As it should be.
    Ok = 0,
    /// Works, but someone should look.
    Warn = 1,
    /// Does not work.
    Error = 2,
    /// What should arrive has stopped arriving.
    Stale = 3,
}

/// A node's own states, published beside the counters of its topics.
#[derive(Clone, Debug, Default)]
pub struct Diagnostics {
    states: Arc<Mutex<BTreeMap<String, State>>>,
}

#[derive(Clone, Debug, PartialEq)]
struct State {
    level: Level,
    message: String,
    values: Vec<(String, String)>,
}

impl Diagnostics {
    /// Sets one state, for instance `camera front`, until it is set again.
    pub fn set(
        &self,
        name: impl Into<String>,
        level: Level,
        message: impl Into<String>,
        values: impl IntoIterator<Item = (&'static str, String)>,
    ) {
        let state = State {
            level,
            message: message.into(),
            values: values
                .into_iter()
                .map(|(key, value)| (key.to_owned(), value))
                .collect(),
        };
        self.states().insert(name.into(), state);
    }

    /// Takes a state back.
    pub fn clear(&self, name: &str) {
        self.states().remove(name);
    }

    fn states(&self) -> MutexGuard<'_, BTreeMap<String, State>> {
        self.states.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// One status for the node's topics, one for each of its own states.
    pub(crate) fn report(
        &self,
        node: &str,
        stamp: Time,
        topics: &[Arc<Statistics>],
        previous: &mut Vec<Snapshot>,
    ) -> DiagnosticArray {
        let mut status = vec![topic_status(node, topics, previous)];
        status.extend(self.states().iter().map(|(name, state)| {
            DiagnosticStatus {
                level: state.level as u8,
                name: format!("{node}: {name}"),
                message: state.message.clone(),
                hardware_id: String::new(),
                values: state
                    .values
                    .iter()
                    .map(|(key, value)| key_value(key, value))
                    .collect(),
            }
        }));
        DiagnosticArray {
            header: Header {
                stamp,
                ..Header::default()
            },
            status,
        }
    }
}

/// Rates, ages, drops and errors; warns for a second after something went wrong.
fn topic_status(
    node: &str,
    topics: &[Arc<Statistics>],
    previous: &mut Vec<Snapshot>,
) -> DiagnosticStatus {
    previous.resize_with(topics.len(), Snapshot::default);
    let mut values = Vec::new();
    let mut troubled = Vec::new();
    for (topic, before) in topics.iter().zip(previous.iter_mut()) {
        let now = topic.snapshot();
        if topic.quiet && now.errors == 0 {
            *before = now;
            continue;
        }
        let name = &topic.name;
        let direction = match topic.direction {
            Direction::In => "in",
            Direction::Out => "out",
        };
        let rate = (now.messages - before.messages) as f64 / PERIOD.as_secs_f64();
        let age = now.age.map_or_else(
            || "never".to_owned(),
            |age| format!("{:.1}", age.as_secs_f64()),
        );
        let line = format!(
            "{direction} messages={} rate_hz={rate:.1} age_s={age} dropped={} errors={}",
            now.messages, now.dropped, now.errors
        );
        values.push(key_value(name, &line));
        if let Some(error) = &now.last_error {
            values.push(key_value(&format!("{name} last_error"), error));
        }
        if now.errors > before.errors || now.dropped > before.dropped {
            troubled.push(name.as_str());
        }
        *before = now;
    }
    let (level, message) = if troubled.is_empty() {
        (Level::Ok, "all messages arrive whole".to_owned())
    } else {
        (
            Level::Warn,
            format!(
                "errors or drops in the last second on {}",
                troubled.join(", ")
            ),
        )
    };
    DiagnosticStatus {
        level: level as u8,
        name: format!("{node}: topics"),
        message,
        hardware_id: String::new(),
        values,
    }
}

fn key_value(key: &str, value: &str) -> KeyValue {
    KeyValue {
        key: key.to_owned(),
        value: value.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_with_errors_is_a_warning_and_the_next_one_is_not() {
        let topic = Arc::new(Statistics::new("/goal", Direction::In));
        let diagnostics = Diagnostics::default();
        let mut previous = Vec::new();
        let topics = [Arc::clone(&topic)];
        let mut report = || {
            let report = diagnostics.report("/node", Time::default(), &topics, &mut previous);
            (report.status[0].level, report.status[0].message.clone())
        };
        assert_eq!(report().0, 0);
        topic.reject("step: expected 1..9, found 0");
        let (level, message) = report();
        assert_eq!(level, 1);
        assert!(message.contains("/goal"), "{message}");
        assert_eq!(report().0, 0);
    }

    #[test]
    fn own_states_are_reported_under_the_nodes_name() {
        let diagnostics = Diagnostics::default();
        diagnostics.set(
            "camera front",
            Level::Stale,
            "silent",
            [("age_s", "3.0".to_owned())],
        );
        let report = diagnostics.report("/cell/fusion", Time::default(), &[], &mut Vec::new());
        assert_eq!(report.status[1].name, "/cell/fusion: camera front");
        assert_eq!(report.status[1].level, 3);
        diagnostics.clear("camera front");
        let report = diagnostics.report("/cell/fusion", Time::default(), &[], &mut Vec::new());
        assert_eq!(report.status.len(), 1);
    }
}
