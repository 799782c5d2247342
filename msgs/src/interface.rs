//! What all generated types have in common.

use ros2_client::{ActionTypeName, Message, MessageTypeName, ServiceTypeName};
use std::collections::BTreeMap;
use std::sync::OnceLock;

/// A type made from an interface file: a message, or a part of a service or action.
pub trait Interface:
    Message + Clone + Default + PartialEq + std::fmt::Debug + Send + Sync + 'static
{
    /// Full name, for instance `sensor_msgs/msg/Image`.
    const TYPE_NAME: &'static str;
    /// Definition with all it depends on, as rosbag2 and MCAP embed it (schema encoding `ros2msg`).
    const DEFINITION: &'static str;
    /// RIHS01 hash of the type (REP-2016).
    const TYPE_HASH: &'static str;
    /// Hashes of the type before fields were added at its end: recordings of these are read with defaults in their place.
    const EARLIER_TYPE_HASHES: &'static [&'static str] = &[];
}

/// A service.
pub trait Service {
    /// Package, for instance `ur_msgs`.
    const PACKAGE: &'static str;
    /// Name, for instance `SetIO`.
    const NAME: &'static str;
    /// What is asked.
    type Request: Interface;
    /// What is answered.
    type Response: Interface;

    /// The name as ros2-client wants it.
    fn type_name() -> ServiceTypeName {
        ServiceTypeName::new(Self::PACKAGE, Self::NAME)
    }
}

/// An action.
pub trait Action {
    /// Package, for instance `control_msgs`.
    const PACKAGE: &'static str;
    /// Name, for instance `FollowJointTrajectory`.
    const NAME: &'static str;
    /// What is asked.
    type Goal: Interface;
    /// How it ended.
    type Result: Interface;
    /// How it goes on.
    type Feedback: Interface;

    /// The name as ros2-client wants it.
    fn type_name() -> ActionTypeName {
        ActionTypeName::new(Self::PACKAGE, Self::NAME)
    }
}

/// The type name of a message as ros2-client wants it for topics.
pub fn message_type_name<T: Interface>() -> MessageTypeName {
    let mut parts = T::TYPE_NAME.split('/');
    let package = parts.next().unwrap_or_default();
    MessageTypeName::new(package, parts.next_back().unwrap_or_default())
}

/// Sees each type once: [`visit_all`](crate::visit_all).
pub trait Visitor {
    /// Called for each type.
    fn visit<T: Interface>(&mut self);
}

/// What is known of a type by its name alone.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Description {
    /// See [`Interface::TYPE_NAME`].
    pub type_name: &'static str,
    /// See [`Interface::DEFINITION`].
    pub definition: &'static str,
    /// See [`Interface::TYPE_HASH`].
    pub type_hash: &'static str,
}

/// Looks a type up by its full name, for instance `sensor_msgs/msg/Image`.
pub fn description(type_name: &str) -> Option<Description> {
    struct Collect(BTreeMap<&'static str, Description>);
    impl Visitor for Collect {
        fn visit<T: Interface>(&mut self) {
            let description = Description {
                type_name: T::TYPE_NAME,
                definition: T::DEFINITION,
                type_hash: T::TYPE_HASH,
            };
            self.0.insert(T::TYPE_NAME, description);
        }
    }
    static ALL: OnceLock<BTreeMap<&'static str, Description>> = OnceLock::new();
    let all = ALL.get_or_init(|| {
        let mut collect = Collect(BTreeMap::new());
        crate::visit_all(&mut collect);
        collect.0
    });
    all.get(type_name).copied()
}
