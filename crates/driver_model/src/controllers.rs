//! The controller manager's controllers.

/// A loaded controller.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Controller {
    /// Its name.
    pub name: String,
    /// Its class, as `ros2 control list_controllers` shows it.
    pub class: &'static str,
    /// Whether it is active. The other state that occurs is inactive.
    pub is_active: bool,
}

/// Why controllers were not switched.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SwitchError {
    /// No such controller is loaded.
    #[error("controller `{0}` is not loaded")]
    Unknown(String),
    /// A controller refuses to become active.
    #[error("controller `{name}` cannot be activated: {reason}")]
    Refused {
        /// The controller.
        name: String,
        /// The reason.
        reason: String,
    },
}

/// The controllers of a UR arm.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Controllers {
    all: Vec<Controller>,
    software_major: u32,
}

/// Detects contact.
const TOOL_CONTACT: &str = "tool_contact_controller";
/// First major version of the robot's software that has it: e-Series.
pub const CONTACT_SINCE: u32 = 5;

impl Controllers {
    /// The controllers of the UR driver; `follow` is the one that follows trajectories. All are active but those named in `inactive`,
    /// and the one for tool contact on a robot that does not have it.
    pub fn new(follow: &str, inactive: &[String], software_major: u32) -> Self {
        let controller = |(name, class): (&str, &'static str)| Controller {
            is_active: !inactive.iter().any(|other| other == name)
                && (name != TOOL_CONTACT || software_major >= CONTACT_SINCE),
            name: name.to_owned(),
            class,
        };
        let all = [
            (
                "joint_state_broadcaster",
                "joint_state_broadcaster/JointStateBroadcaster",
            ),
            ("io_and_status_controller", "ur_controllers/GPIOController"),
            (follow, "ur_controllers/ScaledJointTrajectoryController"),
            (TOOL_CONTACT, "ur_controllers/ToolContactController"),
        ];
        Self {
            all: all.into_iter().map(controller).collect(),
            software_major,
        }
    }

    /// All that are loaded.
    pub fn list(&self) -> &[Controller] {
        &self.all
    }

    /// Whether a controller is loaded and active.
    pub fn is_active(&self, name: &str) -> bool {
        self.all
            .iter()
            .any(|controller| controller.name == name && controller.is_active)
    }

    /// Switches controllers: all of them or, where one cannot be switched, none.
    ///
    /// # Errors
    /// The first controller that is not loaded or that refuses.
    pub fn switch(
        &mut self,
        activate: &[String],
        deactivate: &[String],
    ) -> Result<(), SwitchError> {
        for name in activate.iter().chain(deactivate) {
            if !self.all.iter().any(|controller| controller.name == *name) {
                return Err(SwitchError::Unknown(name.clone()));
            }
        }
        if activate.iter().any(|name| name == TOOL_CONTACT) && self.software_major < CONTACT_SINCE {
            return Err(SwitchError::Refused {
                name: TOOL_CONTACT.to_owned(),
                reason: format!(
                    "it needs robot software {CONTACT_SINCE} or later, the robot has {}",
                    self.software_major
                ),
            });
        }
        for controller in &mut self.all {
            controller.is_active &= !deactivate.contains(&controller.name);
            controller.is_active |= activate.contains(&controller.name);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FOLLOW: &str = "scaled_joint_trajectory_controller";

    fn names(names: &[&str]) -> Vec<String> {
        names.iter().map(|name| (*name).to_owned()).collect()
    }

    #[test]
    fn an_inactive_controller_can_be_activated() {
        let mut controllers = Controllers::new(FOLLOW, &names(&[TOOL_CONTACT]), 5);
        assert!(controllers.is_active(FOLLOW) && !controllers.is_active(TOOL_CONTACT));
        controllers
            .switch(&names(&[TOOL_CONTACT]), &names(&[FOLLOW]))
            .unwrap();
        assert!(!controllers.is_active(FOLLOW) && controllers.is_active(TOOL_CONTACT));
    }

    #[test]
    fn where_one_cannot_be_switched_none_is() {
        let mut controllers = Controllers::new(FOLLOW, &[], 5);
        let before = controllers.clone();
        let error = controllers
            .switch(&names(&["nobody"]), &names(&[FOLLOW]))
            .unwrap_err();
        assert!(error.to_string().contains("nobody"), "{error}");
        assert_eq!(controllers, before);
    }

    #[test]
    fn a_cb3_has_no_tool_contact() {
        let mut controllers = Controllers::new(FOLLOW, &[], 3);
        assert!(!controllers.is_active(TOOL_CONTACT));
        let error = controllers
            .switch(&names(&[TOOL_CONTACT]), &[])
            .unwrap_err();
        assert!(error.to_string().contains("software 5"), "{error}");
    }
}
