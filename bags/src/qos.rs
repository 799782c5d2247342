//! Quality of service of recorded topics.

use serde::{Deserialize, Serialize};

/// What a publisher offered.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
pub struct Qos {
    /// Reliable, else best effort.
    pub reliable: bool,
    /// Transient local, else volatile.
    pub transient_local: bool,
    /// Messages kept.
    pub depth: u32,
}

impl Qos {
    /// Reliable and volatile.
    pub const RELIABLE: Self = Self {
        reliable: true,
        transient_local: false,
        depth: 10,
    };
    /// Reliable and transient local, the last message only.
    pub const LATCHED: Self = Self {
        reliable: true,
        transient_local: true,
        depth: 1,
    };
    /// Best effort and volatile.
    pub const BEST_EFFORT: Self = Self {
        reliable: false,
        transient_local: false,
        depth: 10,
    };
}

/// As `metadata.yaml` of version 9 has it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub(crate) struct Profile {
    history: Policy,
    depth: u32,
    reliability: Policy,
    durability: Policy,
    deadline: Interval,
    lifespan: Interval,
    liveliness: Policy,
    liveliness_lease_duration: Interval,
    avoid_ros_namespace_conventions: bool,
}

/// A name, or a number in older versions.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
enum Policy {
    Name(String),
    Number(i64),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Interval {
    sec: u64,
    nsec: u64,
}

/// rmw's value for "no limit".
const INFINITE: Interval = Interval {
    sec: 9_223_372_036,
    nsec: 854_775_807,
};

fn named(name: &str) -> Policy {
    Policy::Name(name.to_owned())
}

impl Default for Profile {
    fn default() -> Self {
        Qos::RELIABLE.into()
    }
}

impl From<Qos> for Profile {
    fn from(qos: Qos) -> Self {
        Self {
            history: named("keep_last"),
            depth: qos.depth,
            reliability: named(if qos.reliable {
                "reliable"
            } else {
                "best_effort"
            }),
            durability: named(if qos.transient_local {
                "transient_local"
            } else {
                "volatile"
            }),
            deadline: INFINITE,
            lifespan: INFINITE,
            liveliness: named("automatic"),
            liveliness_lease_duration: INFINITE,
            avoid_ros_namespace_conventions: false,
        }
    }
}

impl From<&Profile> for Qos {
    fn from(profile: &Profile) -> Self {
        Self {
            reliable: [named("reliable"), Policy::Number(1)].contains(&profile.reliability),
            transient_local: [named("transient_local"), Policy::Number(1)]
                .contains(&profile.durability),
            depth: profile.depth,
        }
    }
}

/// Profiles that cannot be read are left out: they are advice, not data.
pub(crate) fn from_yaml(text: &str) -> Vec<Profile> {
    serde_yaml_ng::from_str(text).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Vec<Qos> {
        from_yaml(text).iter().map(Qos::from).collect()
    }

    #[test]
    fn profiles_are_read_back() {
        let offered = [Qos::RELIABLE, Qos::LATCHED, Qos::BEST_EFFORT];
        let text = serde_yaml_ng::to_string(&offered.map(Profile::from)).unwrap();
        assert_eq!(read(&text), offered);
    }

    #[test]
    fn numbers_of_older_versions_are_read_too() {
        let text = "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n  liveliness: 1\n";
        assert_eq!(read(text), [Qos::LATCHED]);
        assert_eq!(
            read("- reliability: 2\n  durability: 2\n  depth: 10"),
            [Qos::BEST_EFFORT]
        );
        assert_eq!(read("nonsense"), []);
    }
}
