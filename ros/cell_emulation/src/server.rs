//! The driver's actions and services.

use std::convert::Infallible;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use driver_model::{CONTACT_SINCE, Controllers, Fault, HardwareSettings};
use msgs::control_msgs::FollowJointTrajectory;
use msgs::controller_manager_msgs::{
    ControllerState, ListControllers, ListControllersResponse, SwitchController,
    SwitchControllerResponse,
};
use msgs::ur_msgs::{
    FollowJointTrajectoryUntil, GetRobotSoftwareVersion, GetRobotSoftwareVersionResponse, SetIO,
    SetIORequest, SetIOResponse,
};
use node_kit::{ActionServer, NewGoal, Node, NodeError, ServiceServer, when};
use tokio::sync::{oneshot, watch};
use tracing::error;

use crate::health::{FaultChange, Health};

/// Names of the two motion actions.
#[derive(Clone, Debug)]
pub struct ActionNames {
    /// Follows a trajectory.
    pub follow: String,
    /// Follows a trajectory until the tool touches something.
    pub until: String,
}

impl ActionNames {
    /// The controller behind `follow`: the first part of its name.
    pub fn controller(&self) -> &str {
        let name = self.follow.trim_start_matches('/');
        name.split('/').next().unwrap_or("")
    }
}

/// What a client asks of the driver.
pub enum Request {
    /// A goal of the trajectory controller. Dropped, it is rejected.
    Follow(Box<NewGoal<FollowJointTrajectory>>),
    /// A goal of `trajectory_until_node`. Dropped, it is rejected.
    Until(Box<NewGoal<FollowJointTrajectoryUntil>>),
    /// A request of `set_io`, and where to say whether it was carried out. Dropped, it has failed.
    SetIo(SetIORequest, oneshot::Sender<bool>),
    /// A goal id has come twice: the driver's process ends, as rclcpp has it.
    Die,
}

/// What the driver's services and whoever moves the arm share.
pub struct DriverState {
    /// Whether the driver's process is gone.
    dead: watch::Sender<bool>,
    controllers: Mutex<Controllers>,
    health: Mutex<Health>,
}

impl DriverState {
    /// A driver that lives, with its controllers as the settings have them.
    pub fn new(actions: &ActionNames, hardware: &HardwareSettings) -> Self {
        let controllers = Controllers::new(
            actions.controller(),
            &hardware.inactive_controllers,
            hardware.software_major,
        );
        Self {
            dead: watch::channel(false).0,
            controllers: Mutex::new(controllers),
            health: Mutex::default(),
        }
    }

    /// Loads the controllers anew, as the settings have them now.
    pub fn set_controllers(&self, actions: &ActionNames, hardware: &HardwareSettings) {
        *self.controllers() = Controllers::new(
            actions.controller(),
            &hardware.inactive_controllers,
            hardware.software_major,
        );
    }

    /// Sets what is wrong with the robot. A dead driver answers nothing, and does not know of what was asked meanwhile when it is started
    /// again.
    pub fn set_fault(&self, fault: Fault) -> FaultChange {
        self.change_health(|health| health.set_fault(fault))
    }

    /// The driver's process is gone, whatever is set later.
    pub fn end(&self) {
        self.change_health(Health::end);
    }

    fn change_health<T>(&self, change: impl FnOnce(&mut Health) -> T) -> T {
        let mut health = self.health.lock().unwrap_or_else(PoisonError::into_inner);
        let changed = change(&mut health);
        self.dead.send_replace(health.is_dead());
        changed
    }

    /// What is wrong with the robot.
    pub fn fault(&self) -> Fault {
        let health = self.health.lock().unwrap_or_else(PoisonError::into_inner);
        health.fault()
    }

    /// Whether the driver's process is gone: the robot stops by itself, and nobody hears of it.
    pub fn is_dead(&self) -> bool {
        *self.dead.borrow()
    }

    /// Waits until the driver is dead.
    async fn death(&self) {
        // The sender lives as long as this.
        let _ = self.dead.subscribe().wait_for(|dead| *dead).await;
    }

    pub(crate) fn controllers(&self) -> MutexGuard<'_, Controllers> {
        self.controllers
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }
}

/// The driver's actions and services on the network.
pub struct DriverServer {
    follow: ActionServer<FollowJointTrajectory>,
    /// Nothing on a CB3.
    until: Option<ActionServer<FollowJointTrajectoryUntil>>,
    set_io: ServiceServer<SetIO>,
    list: ServiceServer<ListControllers>,
    switch: ServiceServer<SwitchController>,
    version: ServiceServer<GetRobotSoftwareVersion>,
    /// Goal ids that have come twice, where the trajectory controller minds.
    repeats: Option<watch::Receiver<u64>>,
    software_major: u32,
    state: Arc<DriverState>,
}

impl DriverServer {
    /// Offers the driver's names on the network, until it is dropped.
    ///
    /// # Errors
    /// A name is not a ROS name, or the middleware refuses.
    pub fn new(
        node: &Node,
        actions: &ActionNames,
        hardware: &HardwareSettings,
        state: Arc<DriverState>,
    ) -> Result<Self, NodeError> {
        let follow = node.action_server(&actions.follow)?;
        let until = match hardware.software_major >= CONTACT_SINCE {
            true => Some(node.action_server(&actions.until)?),
            false => None,
        };
        let repeats = hardware.strict_actions.then(|| {
            // rclcpp answers, and throws where it adds the goal to those that it has.
            if let Some(until) = &until {
                until.count_repeats(false);
            }
            follow.count_repeats(true)
        });
        Ok(Self {
            follow,
            until,
            set_io: node.service_server("io_and_status_controller/set_io")?,
            list: node.service_server("controller_manager/list_controllers")?,
            switch: node.service_server("controller_manager/switch_controller")?,
            version: node
                .service_server("ur_configuration_controller/get_robot_software_version")?,
            repeats,
            software_major: hardware.software_major,
            state,
        })
    }

    /// Passes on what is asked, and answers what the state of the controllers alone decides.
    pub async fn serve(&mut self, pass_on: impl Fn(Request)) -> Infallible {
        let state = &self.state;
        loop {
            tokio::select! {
                goal = self.follow.recv() => pass_on(Request::Follow(Box::new(goal))),
                goal = when(self.until.as_mut().map(ActionServer::recv)) => pass_on(Request::Until(Box::new(goal))),
                () = repeated(&mut self.repeats) => {
                    error!("a goal id has come twice: the trajectory controller's process is gone");
                    pass_on(Request::Die);
                }
                (id, request) = self.set_io.recv() => if !state.is_dead() {
                    let (reply, replied) = oneshot::channel();
                    pass_on(Request::SetIo(request, reply));
                    tokio::select! {
                        // Dropped where the request was not taken.
                        success = replied => {
                            let success = success.unwrap_or(false);
                            self.set_io.respond(id, SetIOResponse { success });
                        }
                        () = state.death() => {}
                    }
                },
                (id, _) = self.list.recv() => if !state.is_dead() {
                    self.list.respond(id, controllers_to_msg(&state.controllers()));
                },
                (id, request) = self.switch.recv() => if !state.is_dead() {
                    let (activate, deactivate) =
                        (&request.activate_controllers, &request.deactivate_controllers);
                    let switched = state.controllers().switch(activate, deactivate);
                    self.switch.respond(id, SwitchControllerResponse {
                        ok: switched.is_ok(),
                        message: switched.err().map_or_else(String::new, |error| error.to_string()),
                    });
                },
                (id, _) = self.version.recv() => if !state.is_dead() {
                    self.version.respond(id, GetRobotSoftwareVersionResponse {
                        major: self.software_major,
                        ..Default::default()
                    });
                },
            }
        }
    }
}

/// Waits for a goal id that has come before; for ever where they are not counted.
async fn repeated(repeats: &mut Option<watch::Receiver<u64>>) {
    if let Some(repeats) = repeats
        && repeats.changed().await.is_ok()
    {
        return;
    }
    std::future::pending().await
}

fn controllers_to_msg(controllers: &Controllers) -> ListControllersResponse {
    let state = |controller: &driver_model::Controller| ControllerState {
        name: controller.name.clone(),
        state: if controller.is_active {
            "active"
        } else {
            "inactive"
        }
        .to_owned(),
        r#type: controller.class.to_owned(),
        ..Default::default()
    };
    ListControllersResponse {
        controller: controllers.list().iter().map(state).collect(),
    }
}
