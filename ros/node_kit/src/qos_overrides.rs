//! The standard parameters `qos_overrides.TOPIC.publisher.POLICY`, within what keeps the protocol of a step safe.

use std::collections::BTreeMap;

use serde_yaml_ng::{Mapping, Value};

use crate::{
    endpoint::Direction,
    invalid_parameter::InvalidParameter,
    qos::{Qos, QosOverride},
};

/// First part of the names of these parameters.
pub(crate) const PREFIX: &str = "qos_overrides";
/// As rcl writes "no limit" [ns].
const INFINITE_NS: i64 = i64::MAX;
/// Deeper histories of a topic take more memory than any use of them is worth.
const MAX_DEPTH: i64 = 4096;

/// What a node's parameters ask for, by topic and direction.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct QosOverrides(BTreeMap<(String, Direction), QosOverride>);

impl QosOverrides {
    /// Reads the mapping below `qos_overrides`.
    pub(crate) fn from_mapping(topics: &Mapping) -> Result<Self, InvalidParameter> {
        let mut overrides = BTreeMap::new();
        for (topic, entities) in topics {
            let topic = text(topic);
            let name = format!("{PREFIX}.{topic}");
            if !topic.starts_with('/') {
                return Err(InvalidParameter::new(
                    name,
                    "expected the full name of a topic, which begins with /",
                ));
            }
            for (entity, policies) in mapping(&name, entities)? {
                let name = format!("{name}.{}", text(entity));
                let direction = match text(entity).as_str() {
                    "publisher" => Direction::Out,
                    "subscription" => Direction::In,
                    _ => {
                        return Err(InvalidParameter::new(
                            name,
                            "expected publisher or subscription, without an id",
                        ));
                    }
                };
                let mut wish = QosOverride::default();
                for (policy, value) in mapping(&name, policies)? {
                    wish.read(&name, &text(policy), value)?;
                }
                overrides.insert((topic.clone(), direction), wish);
            }
        }
        Ok(Self(overrides))
    }

    /// What is asked for an endpoint of this profile on a topic (full name), if the profile's purpose allows it.
    pub(crate) fn of(
        &self,
        topic: &str,
        direction: Direction,
        qos: Qos,
    ) -> Result<QosOverride, InvalidParameter> {
        let Some(wish) = self.0.get(&(topic.to_owned(), direction)) else {
            return Ok(QosOverride::default());
        };
        let entity = match direction {
            Direction::In => "subscription",
            Direction::Out => "publisher",
        };
        let refuse = |policy: &str, reason: String| {
            let name = format!("{PREFIX}.{topic}.{entity}.{policy}");
            Err(InvalidParameter::new(name, reason))
        };
        let depths = qos.depths();
        if let Some(depth) = wish.depth
            && !depths.contains(&depth)
        {
            let (from, to) = depths.into_inner();
            return refuse(
                "depth",
                format!("must be {from} to {to} for this topic, is {depth}"),
            );
        }
        if wish.reliable == Some(false) && qos != Qos::Image {
            return refuse(
                "reliability",
                "must stay reliable: a lost message of this topic would not be sent again"
                    .to_owned(),
            );
        }
        let latched = qos == Qos::Latched;
        if wish.transient_local.is_some_and(|wanted| wanted != latched) {
            let reason = match latched {
                true => "must stay transient_local: late subscribers need the last message",
                false => {
                    "must stay volatile: a message of this topic must not be replayed to late subscribers"
                }
            };
            return refuse("durability", reason.to_owned());
        }
        Ok(*wish)
    }
}

impl QosOverride {
    fn read(&mut self, above: &str, policy: &str, value: &Value) -> Result<(), InvalidParameter> {
        let refuse = |expected: &str| {
            let name = format!("{above}.{policy}");
            let shown = text(value);
            Err(InvalidParameter::new(
                name,
                format!("expected {expected}, found {shown}"),
            ))
        };
        let word = value.as_str();
        match policy {
            "depth" => match value.as_i64() {
                Some(depth) if (1..=MAX_DEPTH).contains(&depth) => self.depth = Some(depth),
                _ => return refuse(&format!("an integer from 1 to {MAX_DEPTH}")),
            },
            "history" => match word {
                Some("keep_last" | "system_default") => {}
                _ => return refuse("keep_last: what is kept of a topic is bounded"),
            },
            "reliability" => match word {
                Some("reliable") => self.reliable = Some(true),
                Some("best_effort") => self.reliable = Some(false),
                Some("system_default") => {}
                _ => return refuse("reliable or best_effort"),
            },
            "durability" => match word {
                Some("transient_local") => self.transient_local = Some(true),
                Some("volatile") => self.transient_local = Some(false),
                Some("system_default") => {}
                _ => return refuse("volatile or transient_local"),
            },
            "liveliness" => match word {
                Some("automatic" | "system_default") => {}
                _ => return refuse("automatic"),
            },
            "deadline" | "lifespan" | "liveliness_lease_duration" => match value.as_i64() {
                Some(INFINITE_NS) => {}
                _ => return refuse("no limit (9223372036854775807 ns), the only one supported"),
            },
            _ => {
                return Err(InvalidParameter::new(
                    format!("{above}.{policy}"),
                    "expected history, depth, reliability, durability, deadline, lifespan, liveliness or \
                     liveliness_lease_duration",
                ));
            }
        }
        Ok(())
    }
}

fn mapping<'a>(name: &str, value: &'a Value) -> Result<&'a Mapping, InvalidParameter> {
    value
        .as_mapping()
        .ok_or_else(|| InvalidParameter::new(name, "expected a mapping"))
}

fn text(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        other => serde_yaml_ng::to_string(other)
            .unwrap_or_default()
            .trim()
            .to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn overrides(yaml: &str) -> Result<QosOverrides, InvalidParameter> {
        QosOverrides::from_mapping(&serde_yaml_ng::from_str(yaml).unwrap())
    }

    #[test]
    fn depth_and_reliability_are_read_for_one_direction_of_one_topic() {
        let given = overrides(
            "/parameter_events: {publisher: {depth: 10, history: keep_last, reliability: reliable, \
             durability: volatile, liveliness: automatic, deadline: 9223372036854775807}}",
        )
        .unwrap();
        let wish = given
            .of("/parameter_events", Direction::Out, Qos::Event)
            .unwrap();
        assert_eq!((wish.depth, wish.reliable), (Some(10), Some(true)));
        for (topic, direction) in [
            ("/parameter_events", Direction::In),
            ("/goal", Direction::Out),
        ] {
            let other = given.of(topic, direction, Qos::Event).unwrap();
            assert_eq!(other, QosOverride::default());
        }
    }

    #[test]
    fn what_would_break_the_protocol_is_refused_by_the_name_of_the_parameter() {
        for (policy, qos, expected) in [
            ("reliability: best_effort", Qos::Event, "must stay reliable"),
            (
                "reliability: best_effort",
                Qos::Latched,
                "must stay reliable",
            ),
            (
                "durability: transient_local",
                Qos::Event,
                "must stay volatile",
            ),
            (
                "durability: volatile",
                Qos::Latched,
                "must stay transient_local",
            ),
            ("depth: 1", Qos::Event, "must be 10 to"),
            ("depth: 10", Qos::Latched, "must be 1 to 1"),
        ] {
            let given = overrides(&format!("/x: {{subscription: {{{policy}}}}}")).unwrap();
            let refusal = given.of("/x", Direction::In, qos).unwrap_err().to_string();
            let name = policy.split(':').next().unwrap();
            let start = format!("parameter qos_overrides./x.subscription.{name}: {expected}");
            assert!(refusal.starts_with(&start), "{refusal}");
        }
        let images = overrides("/x: {subscription: {reliability: best_effort, depth: 2}}").unwrap();
        assert!(images.of("/x", Direction::In, Qos::Image).is_ok());
    }

    #[test]
    fn unknown_policies_entities_and_values_are_refused_by_name() {
        for (yaml, name) in [
            ("/x: {publisher: {depht: 10}}", "/x.publisher.depht"),
            ("/x: {publisher_left: {depth: 10}}", "/x.publisher_left"),
            ("x: {publisher: {depth: 10}}", "x"),
            ("/x: {publisher: {depth: ten}}", "/x.publisher.depth"),
            ("/x: {publisher: {depth: 0}}", "/x.publisher.depth"),
            (
                "/x: {publisher: {history: keep_all}}",
                "/x.publisher.history",
            ),
            (
                "/x: {publisher: {deadline: 1000000}}",
                "/x.publisher.deadline",
            ),
            (
                "/x: {publisher: {liveliness: manual_by_topic}}",
                "/x.publisher.liveliness",
            ),
            ("/x: {publisher: 3}", "/x.publisher"),
        ] {
            let refusal = overrides(yaml).unwrap_err();
            assert_eq!(refusal.name, format!("qos_overrides.{name}"));
        }
    }
}
