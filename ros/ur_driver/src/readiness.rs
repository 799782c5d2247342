//! Whether the driver is one that this executor can work with: its controllers, the robot's software, the power of the pins.

use std::time::Duration;

use msgs::controller_manager_msgs::{ControllerState, ListControllers, ListControllersRequest};
use msgs::ur_msgs::{GetRobotSoftwareVersion, GetRobotSoftwareVersionRequest, ToolDataMsg};
use node_kit::{CallOptions, Node, NodeError, Qos, ServiceClient, Subscription};
use tokio::sync::watch;
use tracing::{info, warn};

use crate::{ContactSign, DriverParameters};

/// Detects contact for the action that moves until contact.
const TOOL_CONTACT: &str = "tool_contact_controller";
/// First major version of robot software that has it: e-Series.
const CONTACT_SINCE: u32 = 5;
/// Pins from this one on are at the tool.
const TOOL_PINS_FROM: u8 = 16;
/// Between checks, before and after the first that found nothing wrong.
const EAGER: Duration = Duration::from_millis(500);
const CALM: Duration = Duration::from_secs(5);

/// What the checks of the driver have found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Readiness {
    /// Nothing yet, and why.
    Unchecked(String),
    /// Everything that is needed is there.
    Ready,
    /// Something is not, by name.
    Refused(String),
}

impl Readiness {
    /// Why nothing may begin to move.
    pub(crate) fn obstacle(&self) -> Option<String> {
        match self {
            Self::Ready => None,
            Self::Unchecked(reason) | Self::Refused(reason) => Some(reason.clone()),
        }
    }
}

/// What is asked.
struct Checks {
    controllers: ServiceClient<ListControllers>,
    version: ServiceClient<GetRobotSoftwareVersion>,
    tool_data: Subscription<ToolDataMsg>,
    tool_voltage: Option<u8>,
    driver: DriverParameters,
}

/// Checks the driver now and again. An answer that does not come changes nothing once everything was found in order: the streams tell
/// whether the driver lives.
pub(crate) fn watch_readiness(
    node: &Node,
    driver: &DriverParameters,
) -> Result<watch::Receiver<Readiness>, NodeError> {
    if !driver.check_controllers {
        return Ok(watch::channel(Readiness::Ready).1);
    }
    let unchecked = Readiness::Unchecked("the driver's controllers are not checked yet".into());
    let (sender, receiver) = watch::channel(unchecked);
    let mut checks = Checks {
        controllers: node
            .service_client(&format!("{}/list_controllers", driver.controller_manager))?,
        version: node.service_client("ur_configuration_controller/get_robot_software_version")?,
        tool_data: node.subscription(&format!("{}/tool_data", driver.io_and_status), Qos::Event)?,
        tool_voltage: None,
        driver: driver.clone(),
    };
    node.spawn(async move {
        loop {
            let found = checks.check().await;
            let before = sender.borrow().clone();
            let silent = matches!(found, Readiness::Unchecked(_));
            if found != before && !(silent && before == Readiness::Ready) {
                match &found {
                    Readiness::Ready => info!("the driver has what is needed"),
                    Readiness::Unchecked(reason) | Readiness::Refused(reason) => warn!("{reason}"),
                }
                sender.send_replace(found.clone());
            }
            let pause = if found == Readiness::Ready {
                CALM
            } else {
                EAGER
            };
            tokio::time::sleep(pause).await;
        }
    });
    Ok(receiver)
}

impl Checks {
    async fn check(&mut self) -> Readiness {
        let options = CallOptions {
            attempts: 2,
            timeout: Duration::from_secs_f64(self.driver.call_timeout_s),
        };
        while let Some(message) = self.tool_data.try_recv() {
            self.tool_voltage = Some(message.tool_output_voltage);
        }
        let answer = self
            .controllers
            .call(&ListControllersRequest::default(), &options)
            .await;
        let controllers = match answer {
            Ok(answer) => answer.controller,
            Err(error) => return Readiness::Unchecked(format!("controllers not checked: {error}")),
        };
        if self.driver.contact == ContactSign::UntilAction {
            let answer = self
                .version
                .call(&GetRobotSoftwareVersionRequest::default(), &options)
                .await;
            match answer {
                Ok(version) if version.major < CONTACT_SINCE => {
                    return Readiness::Refused(format!(
                        "the robot has software {}.{}, driver.contact until_action needs {CONTACT_SINCE} or later (an e-Series): use vacuum or height",
                        version.major, version.minor
                    ));
                }
                Ok(_) => {}
                Err(error) => {
                    return Readiness::Unchecked(format!("robot software not checked: {error}"));
                }
            }
        }
        if let Some(reason) = missing_controller(&self.driver, &controllers) {
            return Readiness::Refused(reason);
        }
        powerless_pin(&self.driver, self.tool_voltage)
    }
}

/// Names a controller that is not there or not active.
fn missing_controller(
    driver: &DriverParameters,
    controllers: &[ControllerState],
) -> Option<String> {
    let of = |action: &str| {
        let name = action.trim_start_matches('/').split('/').next();
        name.unwrap_or_default().to_owned()
    };
    let mut needed = vec![of(&driver.follow_action), of(&driver.io_and_status)];
    if driver.contact == ContactSign::UntilAction {
        needed.push(TOOL_CONTACT.to_owned());
    }
    needed.into_iter().find_map(|name| {
        let found = controllers.iter().find(|controller| controller.name == name);
        match found {
            None => Some(format!("the driver has no controller `{name}`")),
            Some(found) if found.state != "active" => Some(format!(
                "controller `{name}` is {}, expected active: ros2 control switch_controllers --activate {name}",
                found.state
            )),
            Some(_) => None,
        }
    })
}

/// Names a pin at the tool that has no power.
fn powerless_pin(driver: &DriverParameters, tool_voltage: Option<u8>) -> Readiness {
    let pins = [driver.suction_pin, driver.vacuum_pin];
    let Some(pin) = pins.into_iter().find(|pin| *pin >= TOOL_PINS_FROM) else {
        return Readiness::Ready;
    };
    match tool_voltage {
        None => Readiness::Unchecked("no tool_data have arrived".into()),
        Some(0) => Readiness::Refused(format!(
            "tool_output_voltage is 0 V, expected 12 or 24 V: pin {pin} is at the tool and has no power"
        )),
        Some(_) => Readiness::Ready,
    }
}
