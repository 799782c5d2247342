//! Whether the driver is one that this executor can work with: its controllers and actions, the robot's software, the power of the pins.

use std::time::{Duration, Instant};

use msgs::controller_manager_msgs::{ControllerState, ListControllers, ListControllersRequest};
use msgs::ur_msgs::{GetRobotSoftwareVersion, GetRobotSoftwareVersionRequest, ToolDataMsg};
use node_kit::{CallOptions, Graph, Node, NodeError, Qos, ServiceClient, Subscription};
use pick_place::ContactSign;
use tokio::sync::watch;
use tracing::{info, warn};

use crate::DriverParameters;

/// Detects contact for the action that moves until contact.
const TOOL_CONTACT: &str = "tool_contact_controller";
/// First major version of robot software that has it: e-Series.
const CONTACT_SINCE: u32 = 5;
/// Pins from this one on are at the tool.
const TOOL_PINS_FROM: u8 = 16;
/// Between checks, before and after the first that found nothing wrong.
const EAGER: Duration = Duration::from_millis(500);
const CALM: Duration = Duration::from_secs(5);
/// Once the driver has answered, its action servers are discovered within this time.
const DISCOVERY: Duration = Duration::from_secs(5);

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
    /// Parameter and name of the actions whose server was not found yet.
    actions: Vec<(&'static str, String)>,
    /// When the driver answered first.
    answered: Option<Instant>,
    graph: Graph,
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
    let mut actions = vec![("driver.follow_action", node.resolve(&driver.follow_action))];
    if driver.contact == ContactSign::UntilAction {
        actions.push(("driver.until_action", node.resolve(&driver.until_action)));
    }
    let mut checks = Checks {
        controllers: node
            .service_client(&format!("{}/list_controllers", driver.controller_manager))?,
        version: node.service_client("ur_configuration_controller/get_robot_software_version")?,
        tool_data: node.subscription(&format!("{}/tool_data", driver.io_and_status), Qos::Event)?,
        tool_voltage: None,
        actions,
        answered: None,
        graph: node.graph(),
        driver: driver.clone(),
    };
    node.spawn(async move {
        loop {
            let found = checks.check().await;
            let before = sender.borrow().clone();
            let silent = matches!(found, Readiness::Unchecked(_));
            if found != before && !(silent && before == Readiness::Ready) {
                match &found {
                    Readiness::Ready => info!("the driver is ready"),
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

/// Asks the driver whether it has what the executor needs: what is missing, by name; nothing where all is there. A driver that does not answer
/// within `patience` is asked no more.
///
/// # Errors
/// A name in the parameters is not a ROS name, or the middleware refuses.
pub async fn driver_obstacle(
    node: &Node,
    driver: &DriverParameters,
    patience: Duration,
) -> Result<Option<String>, NodeError> {
    let mut readiness = watch_readiness(node, driver)?;
    let checked = readiness.wait_for(|found| !matches!(found, Readiness::Unchecked(_)));
    if let Ok(Ok(found)) = tokio::time::timeout(patience, checked).await {
        return Ok(found.obstacle());
    }
    Ok(readiness.borrow().obstacle())
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
        if let Some(reason) = self.missing_action() {
            let answered = *self.answered.get_or_insert_with(Instant::now);
            return match answered.elapsed() > DISCOVERY {
                true => Readiness::Refused(reason),
                false => Readiness::Unchecked(reason),
            };
        }
        powerless_pin(&self.driver, self.tool_voltage)
    }

    /// Names an action that nobody serves. What was found once is not looked for again: the streams tell whether the driver lives.
    fn missing_action(&mut self) -> Option<String> {
        let graph = &self.graph;
        self.actions.retain(|(_, name)| !graph.has_action(name));
        let (parameter, name) = self.actions.first()?;
        let instead = match *parameter {
            "driver.until_action" => {
                ": start the driver's trajectory_until_node, or use driver.contact vacuum or height"
            }
            _ => "",
        };
        Some(format!(
            "nobody serves the action {name} ({parameter}){instead}"
        ))
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
    let pins = [
        ("driver.suction_pin", Some(driver.suction_pin)),
        ("driver.vacuum_pin", Some(driver.vacuum_pin)),
        ("driver.enable_pin", u8::try_from(driver.enable_pin).ok()),
        (
            "driver.blow_off_pin",
            u8::try_from(driver.blow_off_pin).ok(),
        ),
    ];
    let at_tool = pins
        .into_iter()
        .find_map(|(name, pin)| Some((name, pin.filter(|pin| *pin >= TOOL_PINS_FROM)?)));
    let Some((name, pin)) = at_tool else {
        return Readiness::Ready;
    };
    match tool_voltage {
        None => Readiness::Unchecked("no tool_data have arrived".into()),
        Some(0) => Readiness::Refused(format!(
            "tool_output_voltage is 0 V, expected 12 or 24 V: pin {pin} ({name}) is at the tool and has no power"
        )),
        Some(_) => Readiness::Ready,
    }
}
