//! Publishers and subscriptions as DDS sees them, and what keeps two of them apart.

use rustdds::{GUID, QosPolicies};

/// Whether a node sends or receives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Direction {
    In,
    Out,
}

/// A publisher or subscription of this node.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Endpoint {
    /// Absolute name of the topic.
    pub topic: String,
    pub direction: Direction,
    /// As DDS names it.
    pub type_name: String,
    pub policies: QosPolicies,
}

/// An endpoint of this node and one of another that do not fit together.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Conflict {
    pub topic: String,
    pub remote: GUID,
    /// Ours.
    direction: Direction,
    mismatch: Mismatch,
}

/// What does not fit.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Mismatch {
    /// Our type, and the other's.
    Type(String, String),
    /// Which policy.
    Policy(String),
}

impl Conflict {
    /// Names both ends: `ours` and `theirs` are the nodes, the other one where it is known.
    pub(crate) fn describe(&self, ours: &str, theirs: Option<&str>) -> String {
        let (own, other) = match self.direction {
            Direction::In => ("subscription", "publisher"),
            Direction::Out => ("publisher", "subscription"),
        };
        let theirs = match theirs {
            Some(name) => name.to_owned(),
            None => format!("a node that has not said its name ({:?})", self.remote),
        };
        let topic = &self.topic;
        match &self.mismatch {
            Mismatch::Type(our_type, their_type) => format!(
                "{topic}: the {own} of {ours} has type {our_type}, the {other} of {theirs} has {their_type}"
            ),
            Mismatch::Policy(policy) => format!(
                "{topic}: no messages between the {own} of {ours} and the {other} of {theirs}: the {policy} \
                 offered is less than the one requested"
            ),
        }
    }
}

impl Endpoint {
    pub(crate) fn is_on(&self, dds_topic: &str) -> bool {
        dds_topic.strip_prefix("rt") == Some(self.topic.as_str())
    }

    /// What keeps this endpoint and one of another node apart, if anything does.
    pub(crate) fn conflict(
        &self,
        remote: GUID,
        type_name: &str,
        offered: &QosPolicies,
        requested: &QosPolicies,
    ) -> Option<Conflict> {
        let mismatch = if type_name != self.type_name {
            Mismatch::Type(self.type_name.clone(), type_name.to_owned())
        } else {
            let policy = offered.compliance_failure_wrt(requested)?;
            Mismatch::Policy(format!("{policy:?}"))
        };
        Some(Conflict {
            topic: self.topic.clone(),
            remote,
            direction: self.direction,
            mismatch,
        })
    }
}
