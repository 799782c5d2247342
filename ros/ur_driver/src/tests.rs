//! The driver's edge against a simulated driver that behaves as a real one does.

use std::path::Path;

use msgs::control_msgs::FollowJointTrajectoryGoal;
use msgs::convert::pin_level;
use msgs::rcl_interfaces::{
    Parameter, ParameterType, ParameterValue, SetParameters, SetParametersRequest,
};
use msgs::ur_msgs::IOStates;
use nalgebra::{Isometry2, Vector2};
use node_kit::{Context, GoalStatus, Network, NoParameters, Qos, RosArguments, Subscription};
use pick_place::{
    ContactSign, ExecuteError, Outcome, PickPlace, PrimitiveSettings, Robot, Touchdown, execute_on,
};
use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;
use ur5::{Arm, Joints};

use super::*;

const PATIENCE: Duration = Duration::from_secs(30);

/// A simulated driver, and the executor's edge to it.
struct Bench {
    sim: Context,
    own: Context,
    /// Lives as long as the bench.
    node: Node,
    client: Arc<DriverClient>,
    /// Sets parameters of the simulated driver.
    parameters: ServiceClient<SetParameters>,
    cell: WorkCell,
}

impl Bench {
    /// `hardware`: parameters of the simulated driver.
    async fn start(hardware: &[(&str, &str)], driver: DriverParameters) -> Self {
        let bench = Self::start_disabled(hardware, driver).await;
        bench
            .until("a ready driver", |bench| bench.client.obstacle().is_none())
            .await;
        bench
    }

    /// The same where the driver may not get ready; its streams are there.
    async fn start_disabled(hardware: &[(&str, &str)], driver: DriverParameters) -> Self {
        if let Ok(level) = std::env::var("TEST_LOG_LEVEL") {
            // Once for all tests of the process.
            let _ = node_kit::logging::init(&[level]);
        }
        let network = Network::unused().unwrap();
        let (own, sim) = (Context::new(network), Context::new(network));
        let (node, _) = own
            .node::<NoParameters>("bench", &RosArguments::default())
            .unwrap();
        let cell = WorkCell::builtin().unwrap();
        let client = DriverClient::new(&node, &driver, &cell).unwrap();
        let problems = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/problems");
        let mut line = vec!["--ros-args".to_owned()];
        let mut set = |name: &str, value: &str| {
            line.extend(["-p".to_owned(), format!("{name}:={value}")]);
        };
        set("problems_dir", &problems.display().to_string());
        set("real_time_factor", "1.0");
        set("hardware.free_running", "true");
        for (name, value) in hardware {
            set(&format!("hardware.{name}"), value);
        }
        let arguments = RosArguments::parse(line).unwrap().0;
        sim_workcell::start(&sim, &arguments).unwrap();
        let parameters = node.service_client("sim_workcell/set_parameters").unwrap();
        let bench = Self {
            sim,
            own,
            node,
            client: Arc::new(client),
            parameters,
            cell,
        };
        bench
            .until("streams of the driver", |bench| {
                let status = bench.client.status.borrow();
                status.joints.is_some() && status.pins.is_some()
            })
            .await;
        bench
    }

    async fn until(&self, what: &str, condition: impl Fn(&Self) -> bool) {
        let end = Instant::now() + PATIENCE;
        while !condition(self) {
            let obstacle = self.client.obstacle();
            assert!(Instant::now() < end, "no {what}: {obstacle:?}");
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    }

    /// Has the robot do something on a thread of its own.
    fn work<T: Send + 'static>(
        &self,
        stop: &CancellationToken,
        work: impl FnOnce(&mut DriverRobot) -> T + Send + 'static,
    ) -> tokio::task::JoinHandle<T> {
        let mut robot = DriverRobot::new(Arc::clone(&self.client), Handle::current(), stop.clone());
        tokio::task::spawn_blocking(move || work(&mut robot))
    }

    /// Turns the base by an angle (rad).
    fn turn(&self, angle_rad: f64) -> JointTrajectory {
        let from = self.joints();
        let mut to = from;
        to[0] += angle_rad;
        JointTrajectory::joint_space(&self.cell.arm, &from, &to).unwrap()
    }

    /// From where the arm is, straight down to below the table, slowly.
    async fn over_the_table(&self) -> JointTrajectory {
        self.over([0.5, 0.25], -0.01).await
    }

    /// Goes to 50 mm above the table; returns the way straight down to a height of the tip, slowly.
    async fn over(&self, [x_m, y_m]: [f64; 2], end_m: f64) -> JointTrajectory {
        let arm = &self.cell.arm;
        let pose = Isometry2::new(Vector2::new(x_m, y_m), 0.0);
        let above = arm.solve(&Arm::tip_down(&pose, 0.05), &arm.ready).unwrap();
        let there = JointTrajectory::joint_space(arm, &self.joints(), &above).unwrap();
        let moved = self.work(&CancellationToken::new(), move |robot| {
            (robot.follow(&there), robot.joints())
        });
        let (reached, joints) = moved.await.unwrap();
        assert_eq!(reached, Ok(true));
        let end = Arm::tip_down(&pose, end_m);
        JointTrajectory::line(arm, &joints.unwrap(), &end, 0.05, 1.0).unwrap()
    }

    /// Goes down to the disk, by height, and switches suction on.
    async fn grip_the_disk(&self) {
        let descent = self.over(DISK, DISK_HEIGHT_M - 0.003).await;
        let gripped = self.work(&CancellationToken::new(), move |robot| {
            let reached = robot.follow(&descent)?;
            robot.joints()?;
            robot.set_suction(true)?;
            Ok::<_, DriverError>(reached && robot.holds()?)
        });
        assert_eq!(gripped.await.unwrap(), Ok(true));
    }

    /// Has something picked and placed, the object being as high as the disk.
    fn pick_and_place(
        &self,
        stop: &CancellationToken,
        [pick, place]: [[f64; 2]; 2],
        touchdown: Touchdown,
    ) -> tokio::task::JoinHandle<Result<Outcome, ExecuteError<DriverError>>> {
        let pose = |[x_m, y_m]: [f64; 2]| Isometry2::new(Vector2::new(x_m, y_m), 0.0);
        let action = PickPlace {
            pick: pose(pick),
            place: pose(place),
        };
        let arm = self.cell.arm.clone();
        self.work(stop, move |robot| {
            execute_on(robot, &arm, &action, &LOW, Some(&touchdown), |_| ())
        })
    }

    fn pins(&self) -> status::Pins {
        self.client.status.borrow().pins.unwrap().value
    }

    fn is_home(&self) -> bool {
        (self.joints() - self.cell.arm.home).amax() < 1e-2
    }

    fn joints(&self) -> Joints {
        self.client
            .status
            .borrow()
            .joints
            .unwrap()
            .value
            .positions_rad
    }

    /// Waits until a goal is sent, while its answer takes time.
    async fn goal_on_its_way(&self) {
        // The motion, and its goal without an answer.
        self.until("goal on its way", |bench| {
            bench.client.heartbeat.under_way() == 2
        })
        .await;
    }

    /// Furthest that a joint goes from where it is in some seconds (rad): what rests, rests for as long as that.
    async fn travel_rad(&self, seconds: f64) -> f64 {
        let begin = self.joints();
        let end = Instant::now() + Duration::from_secs_f64(seconds);
        let mut furthest: f64 = 0.0;
        while Instant::now() < end {
            tokio::time::sleep(Duration::from_millis(5)).await;
            furthest = furthest.max((self.joints() - begin).amax());
        }
        furthest
    }

    /// Sets what is wrong with the robot.
    async fn set_fault(&self, fault: &str) {
        let value = ParameterValue {
            r#type: ParameterType::PARAMETER_STRING,
            string_value: fault.into(),
            ..Default::default()
        };
        self.set("hardware.fault", value).await;
    }

    /// Holds the enabling switch or lets it go.
    async fn enable(&self, enabled: bool) {
        let value = ParameterValue {
            r#type: ParameterType::PARAMETER_BOOL,
            bool_value: enabled,
            ..Default::default()
        };
        self.set("hardware.enabled", value).await;
    }

    /// Sets a parameter of the simulated driver.
    async fn set(&self, name: &str, value: ParameterValue) {
        self.parameters.wait_for_server(PATIENCE).await.unwrap();
        let request = SetParametersRequest {
            parameters: vec![Parameter {
                name: name.into(),
                value,
            }],
        };
        let answer = self
            .parameters
            .call(&request, &CallOptions::default())
            .await;
        assert!(answer.unwrap().results[0].successful);
    }
}

impl Drop for Bench {
    fn drop(&mut self) {
        self.sim.shutdown();
    }
}

/// Where a disk of *placing* lies with the seed that the simulated cell begins with, in the world's xy-plane (m).
const DISK: [f64; 2] = [0.4354, 0.1635];
const DISK_HEIGHT_M: f64 = 0.012;
/// Where nothing lies.
const FREE: [f64; 2] = [0.55, 0.3];
/// Slow, and no higher than needed.
const LOW: PrimitiveSettings = PrimitiveSettings {
    clearance_m: 0.1,
    lift_m: 0.04,
    travel_m_s: 0.8,
    carry_m_s: 0.1,
    descend_m_s: 0.2,
    acceleration_m_s2: 2.0,
};

/// How the disk is picked and put on the table, by such a sign of contact.
fn onto_the_disk(sign: ContactSign) -> Touchdown {
    Touchdown {
        pick_m: DISK_HEIGHT_M,
        pick_ground_m: 0.0,
        place_m: 0.0,
        slow_from_m: 0.03,
        slow_m_s: 0.05,
        window_m: 0.015,
        press_m: match sign {
            ContactSign::Height => 0.003,
            ContactSign::UntilAction | ContactSign::Vacuum => 0.0,
        },
        senses_pick: sign != ContactSign::Height,
        senses_place: sign == ContactSign::UntilAction,
    }
}

/// A robot that senses contact so, and gives vacuum its time.
fn sensing(contact: ContactSign) -> DriverParameters {
    DriverParameters {
        contact,
        grasp_wait_s: 1.0,
        release_wait_s: 1.0,
        ..DriverParameters::default()
    }
}

/// An arm that brakes, with an ejector.
const EJECTOR: [(&str, &str); 3] = [
    ("braking_time_s", "0.1"),
    ("vacuum_build_s", "0.15"),
    ("vacuum_release_s", "0.1"),
];

fn reason<T: std::fmt::Debug>(result: Result<T, DriverError>) -> String {
    match result {
        Err(DriverError::Fault(reason)) => reason,
        other => panic!("expected a fault, got {other:?}"),
    }
}

const LATE: &[(&str, &str)] = &[
    ("strict_actions", "true"),
    ("until_answer_min_s", "1.5"),
    ("until_answer_max_s", "1.5"),
];

#[tokio::test(flavor = "multi_thread")]
async fn a_descent_that_is_accepted_late_is_carried_out_once() {
    let bench = Bench::start(LATE, DriverParameters::default()).await;
    let descent = bench.over_the_table().await;
    let descended = bench.work(&CancellationToken::new(), move |robot| {
        robot.follow_until_contact(&descent)
    });
    assert_eq!(descended.await.unwrap(), Ok(true));
    // Alive: a goal id that comes twice ends the driver.
    assert!(bench.client.obstacle().is_none());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stop_acts_while_a_descent_is_unanswered_and_what_is_accepted_later_does_not_move() {
    let bench = Bench::start(LATE, DriverParameters::default()).await;
    let descent = bench.over_the_table().await;
    let stop = CancellationToken::new();
    let descended = bench.work(&stop, move |robot| robot.follow_until_contact(&descent));
    bench.goal_on_its_way().await;
    let said = Instant::now();
    stop.cancel();
    assert_eq!(descended.await.unwrap(), Err(DriverError::Stopped));
    let took = said.elapsed();
    assert!(took < Duration::from_millis(500), "{took:?}");
    // Twice as long as the answer takes.
    let travel_rad = bench.travel_rad(3.0).await;
    // Accepted, and cancelled at once.
    assert!(travel_rad < 2e-3, "{travel_rad}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_rejected_goal_cancels_everything_and_the_arm_comes_to_rest() {
    // Somebody else moves the arm, and the controller for contact is not active.
    let hardware = [
        ("inactive_controllers", "[tool_contact_controller]"),
        ("braking_time_s", "0.1"),
    ];
    let driver = DriverParameters {
        check_controllers: false,
        ..DriverParameters::default()
    };
    let bench = Bench::start(&hardware, driver).await;
    let descent = bench.over_the_table().await;
    let other = bench.client.follow.clone();
    let goal = FollowJointTrajectoryGoal {
        trajectory: bench.client.trajectory(&bench.turn(2.0)).unwrap(),
        ..Default::default()
    };
    let sent = other
        .send_goal(&goal, &CallOptions::default())
        .await
        .unwrap();
    let descended = bench.work(&CancellationToken::new(), move |robot| {
        robot.follow_until_contact(&descent)
    });
    let reason = reason(descended.await.unwrap());
    assert!(reason.contains("rejected"), "{reason}");
    let travel_rad = bench.travel_rad(0.5).await;
    assert!(travel_rad < 1e-3, "{travel_rad}");
    let end = tokio::time::timeout(PATIENCE, sent.result()).await.unwrap();
    assert_eq!(end.unwrap().0, GoalStatus::Canceled);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_tolerance_violation_is_a_fault_and_only_the_lag_rule_makes_it_an_outcome() {
    for lag_rule in [false, true] {
        let driver = DriverParameters {
            path_tolerance_rad: 0.05,
            lag_rule,
            ..DriverParameters::default()
        };
        let hardware = [("servo_delay_s", "0.2"), ("braking_time_s", "0.1")];
        let bench = Bench::start(&hardware, driver).await;
        let turn = bench.turn(1.0);
        let moved = bench.work(&CancellationToken::new(), move |robot| robot.follow(&turn));
        match (lag_rule, moved.await.unwrap()) {
            (true, followed) => assert_eq!(followed, Ok(false)),
            (false, followed) => {
                let reason = reason(followed);
                assert!(reason.contains("path tolerance"), "{reason}");
                let travel_rad = bench.travel_rad(0.3).await;
                assert!(travel_rad < 1e-3, "{travel_rad}");
            }
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_usual_lag_of_a_servo_loop_is_no_violation() {
    let hardware = [
        ("servo_delay_s", "0.03"),
        ("braking_time_s", "0.1"),
        ("encoder_noise_rad", "2e-5"),
    ];
    let bench = Bench::start(&hardware, DriverParameters::default()).await;
    // As fast as the arm can.
    let turn = bench.turn(2.0);
    let end = *turn.last();
    let moved = bench.work(&CancellationToken::new(), move |robot| {
        (robot.follow(&turn), robot.joints())
    });
    let (followed, joints) = moved.await.unwrap();
    assert_eq!(followed, Ok(true));
    assert!((joints.unwrap() - end.positions_rad).amax() < 1e-3);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stop_in_mid_motion_is_told_when_the_arm_rests() {
    let bench = Bench::start(&[("braking_time_s", "0.15")], DriverParameters::default()).await;
    let turn = bench.turn(2.0);
    let stop = CancellationToken::new();
    let moved = bench.work(&stop, move |robot| robot.follow(&turn));
    let begin = bench.joints();
    bench
        .until("motion", |bench| (bench.joints() - begin).amax() > 0.2)
        .await;
    stop.cancel();
    assert_eq!(moved.await.unwrap(), Err(DriverError::Stopped));
    let travel_rad = bench.travel_rad(0.5).await;
    assert!(travel_rad < 1e-3, "{travel_rad}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_motion_that_is_stopped_because_the_node_ends_is_watched_until_the_arm_rests() {
    let bench = Bench::start(&[("braking_time_s", "0.15")], DriverParameters::default()).await;
    let turn = bench.turn(2.0);
    let stop = CancellationToken::new();
    let moved = bench.work(&stop, move |robot| robot.follow(&turn));
    let begin = bench.joints();
    bench
        .until("motion", |bench| (bench.joints() - begin).amax() > 0.2)
        .await;
    // As on SIGTERM: the node's own tasks are dropped, then the motion is told to stop.
    let own_task = bench.node.spawn(std::future::pending::<()>());
    bench.own.shutdown();
    assert_eq!(own_task.await.unwrap(), None);
    stop.cancel();
    assert_eq!(moved.await.unwrap(), Err(DriverError::Stopped));
    let travel_rad = bench.travel_rad(0.5).await;
    assert!(travel_rad < 1e-3, "{travel_rad}");
    bench.client.heartbeat.quiet().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn no_motion_begins_before_it_is_known_what_became_of_the_last_goal() {
    let bench = Bench::start(LATE, DriverParameters::default()).await;
    let descent = bench.over_the_table().await;
    let stop = CancellationToken::new();
    let descended = bench.work(&stop, move |robot| robot.follow_until_contact(&descent));
    bench.goal_on_its_way().await;
    stop.cancel();
    assert_eq!(descended.await.unwrap(), Err(DriverError::Stopped));
    let begin = Instant::now();
    let turn = bench.turn(0.2);
    let moved = bench.work(&CancellationToken::new(), move |robot| robot.follow(&turn));
    assert_eq!(moved.await.unwrap(), Ok(true));
    // The answer came 1.5 s after the goal, the turn takes about as long as it takes.
    assert!(begin.elapsed() > Duration::from_millis(1000));
}

#[tokio::test(flavor = "multi_thread")]
async fn every_fault_of_the_robot_ends_a_motion_with_its_name() {
    for (fault, name) in [
        ("protective_stop", "PROTECTIVE_STOP"),
        ("emergency_stop", "ROBOT_EMERGENCY_STOP"),
        ("program_stopped", "program is not running"),
        ("driver_dead", "expected at most 1.0 s"),
    ] {
        let driver = DriverParameters {
            status_max_age_s: 1.0,
            ..DriverParameters::default()
        };
        let hardware = [("braking_time_s", "0.1"), ("speed_scaling", "0.2")];
        let bench = Bench::start(&hardware, driver).await;
        let turn = bench.turn(2.0);
        let begin = bench.joints();
        let moved = bench.work(&CancellationToken::new(), move |robot| robot.follow(&turn));
        bench
            .until("motion", |bench| (bench.joints() - begin).amax() > 0.1)
            .await;
        bench.set_fault(fault).await;
        let reason = reason(moved.await.unwrap());
        // The controller's own end of the goal may be heard of first; a safety mode is named all the same.
        let ended = reason.contains("the robot has stopped") && !name.ends_with("_STOP");
        assert!(reason.contains(name) || ended, "{fault}: {reason}");
        let again = bench.work(&CancellationToken::new(), |robot| robot.set_suction(true));
        let refused = super::tests::reason(again.await.unwrap());
        assert!(refused.contains(name), "{fault}: {refused}");
        bench.set_fault("none").await;
        bench
            .until("released robot", |bench| bench.client.obstacle().is_none())
            .await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_the_driver_lacks_is_refused_by_name() {
    // Suction and vacuum are at the control box.
    let at_the_box = DriverParameters {
        suction_pin: 3,
        vacuum_pin: 4,
        ..DriverParameters::default()
    };
    let unpowered = ("tool_voltage", "0");
    for (hardware, driver, expected) in [
        (
            vec![(
                "inactive_controllers",
                "[scaled_joint_trajectory_controller]",
            )],
            DriverParameters::default(),
            "scaled_joint_trajectory_controller",
        ),
        (
            vec![("inactive_controllers", "[tool_contact_controller]")],
            DriverParameters::default(),
            "tool_contact_controller",
        ),
        (
            vec![("software_major", "3")],
            DriverParameters::default(),
            "software",
        ),
        (
            vec![],
            DriverParameters {
                until_action: "nobody/execute".into(),
                ..DriverParameters::default()
            },
            "nobody serves the action /nobody/execute",
        ),
        (vec![unpowered], DriverParameters::default(), "pin 16"),
        (vec![unpowered], at_the_box.clone(), ""),
        (
            vec![unpowered],
            DriverParameters {
                blow_off_pin: 17,
                ..at_the_box.clone()
            },
            "pin 17 (driver.blow_off_pin)",
        ),
        (
            vec![unpowered, ("enable_pin", "16")],
            DriverParameters {
                enable_pin: 16,
                ..at_the_box
            },
            "pin 16 (driver.enable_pin)",
        ),
    ] {
        let bench = Bench::start(&hardware, driver).await;
        let checked = |bench: &Bench| match &*bench.client.readiness.borrow() {
            Readiness::Unchecked(_) => None,
            Readiness::Ready => Some(String::new()),
            Readiness::Refused(reason) => Some(reason.clone()),
        };
        bench
            .until("answer of the checks", |bench| checked(bench).is_some())
            .await;
        let found = checked(&bench).unwrap();
        assert_eq!(expected.is_empty(), found.is_empty(), "{found}");
        assert!(found.contains(expected), "{found}");
        if !expected.is_empty() {
            let turn = bench.turn(0.1);
            let moved = bench.work(&CancellationToken::new(), move |robot| robot.follow(&turn));
            let refused = reason(moved.await.unwrap());
            assert!(refused.contains(expected), "{refused}");
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_driver_that_comes_back_is_not_asked_again_for_what_it_was_asked_before() {
    let driver = DriverParameters {
        status_max_age_s: 1.0,
        ..DriverParameters::default()
    };
    let bench = Bench::start(&[], driver).await;
    let suction = |bench: &Bench| bench.client.status.borrow().pins.unwrap().value.suction;
    let stop = CancellationToken::new();
    bench
        .work(&stop, |robot| robot.set_suction(true))
        .await
        .unwrap()
        .unwrap();
    bench.set_fault("driver_dead").await;
    // Dead, and not known to be: it says everything several times in so long.
    bench
        .until("silence of the driver", |bench| {
            let status = bench.client.status.borrow();
            let last = status.joints.unwrap().at.max(status.pins.unwrap().at);
            bench.client.origin.elapsed() > last + Duration::from_millis(300)
        })
        .await;
    let released = bench.work(&stop, |robot| robot.set_suction(false));
    let reason = reason(released.await.unwrap());
    assert!(reason.contains("expected at most 1.0 s"), "{reason}");
    bench.set_fault("none").await;
    bench
        .until("driver that is back", |bench| {
            bench.client.obstacle().is_none()
        })
        .await;
    // A call is made again when an attempt has taken 1 s.
    tokio::time::sleep(Duration::from_millis(1500)).await;
    assert!(suction(&bench), "suction was switched off");
}

#[tokio::test(flavor = "multi_thread")]
async fn suction_waits_for_the_vacuum_and_the_release_is_verified() {
    let hardware = [
        ("vacuum_build_s", "0.3"),
        ("vacuum_release_s", "0.2"),
        ("braking_time_s", "0.1"),
    ];
    let driver = DriverParameters {
        grasp_wait_s: 1.0,
        release_wait_s: 1.0,
        ..DriverParameters::default()
    };
    let bench = Bench::start(&hardware, driver).await;
    // Nothing is there to grip: the wait ends, and the sensor says so.
    let gripped = bench.work(&CancellationToken::new(), |robot| {
        let begin = Instant::now();
        robot.set_suction(true).unwrap();
        let took = begin.elapsed();
        let holds = robot.holds().unwrap();
        robot.set_suction(false).unwrap();
        (took, holds)
    });
    let (took, holds) = gripped.await.unwrap();
    assert!(took >= Duration::from_secs(1) && !holds, "{took:?} {holds}");
}

#[tokio::test(flavor = "multi_thread")]
async fn nothing_moves_without_the_enabling_switch_and_letting_it_go_stops_a_motion() {
    let driver = DriverParameters {
        enable_pin: 3,
        ..DriverParameters::default()
    };
    let hardware = [
        ("enable_pin", "3"),
        ("enabled", "false"),
        ("braking_time_s", "0.1"),
    ];
    let bench = Bench::start_disabled(&hardware, driver).await;
    let turn = bench.turn(2.0);
    let same = turn.clone();
    let moved = bench.work(&CancellationToken::new(), move |robot| robot.follow(&same));
    assert_eq!(moved.await.unwrap(), Err(DriverError::Stopped));
    assert!(bench.travel_rad(0.3).await < 1e-3);
    bench.enable(true).await;
    bench
        .until("held switch", |bench| bench.client.obstacle().is_none())
        .await;
    let begin = bench.joints();
    let moved = bench.work(&CancellationToken::new(), move |robot| robot.follow(&turn));
    bench
        .until("motion", |bench| (bench.joints() - begin).amax() > 0.2)
        .await;
    bench.enable(false).await;
    assert_eq!(moved.await.unwrap(), Err(DriverError::Stopped));
    assert!(bench.travel_rad(0.3).await < 1e-3);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_whole_pick_and_place_needs_no_tool_contact_where_vacuum_or_height_is_its_sign() {
    for (contact, software) in [(ContactSign::Vacuum, "5"), (ContactSign::Height, "3")] {
        let hardware = [&EJECTOR[..], &[("software_major", software)]].concat();
        let bench = Bench::start(&hardware, sensing(contact)).await;
        // What was placed there can be picked there.
        for way in [[DISK, FREE], [FREE, DISK]] {
            let stop = CancellationToken::new();
            let ended = bench.pick_and_place(&stop, way, onto_the_disk(contact));
            assert_eq!(ended.await.unwrap(), Ok(Outcome::Placed), "{contact:?}");
            let pins = bench.pins();
            assert!(bench.is_home() && !pins.suction && !pins.vacuum, "{pins:?}");
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn vacuum_that_builds_up_after_the_end_of_the_way_down_is_waited_for() {
    let hardware = [("braking_time_s", "0.1"), ("vacuum_build_s", "1.5")];
    let driver = DriverParameters {
        grasp_wait_s: 3.0,
        ..sensing(ContactSign::Vacuum)
    };
    let bench = Bench::start(&hardware, driver).await;
    let touchdown = onto_the_disk(ContactSign::Vacuum);
    let ended = bench.pick_and_place(&CancellationToken::new(), [DISK, FREE], touchdown);
    assert_eq!(ended.await.unwrap(), Ok(Outcome::Placed));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_cup_that_meets_nothing_and_gets_no_vacuum_goes_home_with_suction_off() {
    let bench = Bench::start(&EJECTOR, sensing(ContactSign::Vacuum)).await;
    // There is nothing as high as that.
    let touchdown = Touchdown {
        pick_m: 0.05,
        ..onto_the_disk(ContactSign::Vacuum)
    };
    let ended = bench.pick_and_place(&CancellationToken::new(), [FREE, DISK], touchdown);
    bench
        .until("suction on the way down", |bench| bench.pins().suction)
        .await;
    assert_eq!(ended.await.unwrap(), Ok(Outcome::NoContact));
    assert!(bench.is_home());
    bench
        .until("suction off", |bench| !bench.pins().suction)
        .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stop_on_the_way_down_with_suction_on_keeps_the_arm_where_it_is() {
    let bench = Bench::start(&EJECTOR, sensing(ContactSign::Vacuum)).await;
    let descent = bench.over(FREE, -0.01).await;
    let stop = CancellationToken::new();
    let begin = bench.joints();
    let descended = bench.work(&stop, move |robot| robot.follow_until_contact(&descent));
    bench
        .until("a descent with suction on", |bench| {
            bench.pins().suction && (bench.joints() - begin).amax() > 0.01
        })
        .await;
    stop.cancel();
    assert_eq!(descended.await.unwrap(), Err(DriverError::Stopped));
    let travel_rad = bench.travel_rad(0.5).await;
    assert!(travel_rad < 1e-3, "{travel_rad}");
    // As on every stop suction is as it was.
    assert!(bench.pins().suction);
}

#[tokio::test(flavor = "multi_thread")]
async fn with_something_held_the_end_of_the_way_is_no_contact_and_it_stays_held() {
    let bench = Bench::start(&EJECTOR, sensing(ContactSign::Vacuum)).await;
    let descent = bench.over(DISK, -0.003).await;
    let arm = bench.cell.arm.clone();
    let done = bench.work(&CancellationToken::new(), move |robot| {
        let touched = robot.follow_until_contact(&descent)?;
        let low = robot.joints()?;
        let mut up = arm.tip(&low);
        up.translation.z = 0.08;
        let rise = JointTrajectory::line(&arm, &low, &up, 0.1, 1.0).unwrap();
        robot.follow(&rise)?;
        let high = robot.joints()?;
        up.translation.z = 0.05;
        let down = JointTrajectory::line(&arm, &high, &up, 0.05, 1.0).unwrap();
        let again = robot.follow_until_contact(&down)?;
        let end = robot.joints()?;
        let off_m = (arm.tip(&end).translation.z - 0.05).abs();
        Ok::<_, DriverError>((touched, again, off_m, robot.holds()?))
    });
    let (touched, again, off_m, holds) = done.await.unwrap().unwrap();
    assert!(touched && !again && holds && off_m < 1e-3, "{off_m}");
    assert!(bench.pins().suction);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_object_that_is_lost_in_mid_air_ends_as_dropped_at_home() {
    let hardware = [
        ("braking_time_s", "0.1"),
        ("vacuum_build_s", "0.1"),
        // Long after the lift, and long before the end of a transfer of 0.4 m at 0.1 m/s.
        ("vacuum_leak_s", "2.3"),
    ];
    let bench = Bench::start(&hardware, sensing(ContactSign::Height)).await;
    let touchdown = onto_the_disk(ContactSign::Height);
    let far = [0.5, -0.25];
    let ended = bench.pick_and_place(&CancellationToken::new(), [DISK, far], touchdown);
    assert_eq!(ended.await.unwrap(), Ok(Outcome::Dropped));
    let pins = bench.pins();
    assert!(bench.is_home() && !pins.suction && !pins.vacuum, "{pins:?}");
}

/// A part that stays at the cup when suction is off.
const STICKS: [(&str, &str); 3] = [
    ("braking_time_s", "0.1"),
    ("vacuum_build_s", "0.1"),
    ("vacuum_release_s", "60.0"),
];
/// Blows off.
const BLOW_OFF_PIN: u8 = 4;

/// Whether an output is on in the newest of the states that have arrived, and whether it ever was.
fn was_on(states: &mut Subscription<IOStates>, pin: u8) -> (bool, bool) {
    let (mut now, mut ever) = (false, false);
    while let Some(state) = states.try_recv() {
        now = output(&state, pin);
        ever |= now;
    }
    (now, ever)
}

fn output(state: &IOStates, pin: u8) -> bool {
    pin_level(&state.digital_out_states, pin).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_part_that_sticks_is_a_fault_and_nothing_moves() {
    let driver = DriverParameters {
        release_wait_s: 0.5,
        ..sensing(ContactSign::Height)
    };
    let bench = Bench::start(&STICKS, driver).await;
    bench.grip_the_disk().await;
    let released = bench.work(&CancellationToken::new(), |robot| robot.set_suction(false));
    let reason = reason(released.await.unwrap());
    assert!(
        reason.contains("something is held 0.5 s after suction was switched off"),
        "{reason}"
    );
    assert!(bench.travel_rad(0.3).await < 1e-3);
    let pins = bench.pins();
    assert!(!pins.suction && pins.vacuum, "{pins:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_part_that_sticks_is_blown_off_and_the_output_is_off_again() {
    let pin = BLOW_OFF_PIN.to_string();
    let hardware = [&STICKS[..], &[("blow_off_pin", pin.as_str())]].concat();
    let driver = DriverParameters {
        blow_off_pin: BLOW_OFF_PIN as i8,
        ..sensing(ContactSign::Height)
    };
    let bench = Bench::start(&hardware, driver).await;
    let topic = "io_and_status_controller/io_states";
    let mut states = bench.node.subscription(topic, Qos::Event).unwrap();
    bench.grip_the_disk().await;
    assert!(!was_on(&mut states, BLOW_OFF_PIN).1);
    let released = bench.work(&CancellationToken::new(), |robot| {
        robot.set_suction(false)?;
        robot.holds()
    });
    assert_eq!(released.await.unwrap(), Ok(false));
    let (mut is_on, mut ever) = was_on(&mut states, BLOW_OFF_PIN);
    let switched_off = tokio::time::timeout(PATIENCE, async {
        // The state after the switch may still be on its way.
        while is_on || !ever {
            is_on = output(&states.recv().await, BLOW_OFF_PIN);
            ever |= is_on;
        }
    });
    assert!(switched_off.await.is_ok(), "is on: {is_on}, was: {ever}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stop_while_a_part_is_blown_off_leaves_the_output_off() {
    // Nothing blows in truth: the part sticks until the stop comes.
    let driver = DriverParameters {
        blow_off_pin: BLOW_OFF_PIN as i8,
        release_wait_s: 20.0,
        ..sensing(ContactSign::Height)
    };
    let bench = Bench::start(&STICKS, driver).await;
    let topic = "io_and_status_controller/io_states";
    let mut states = bench.node.subscription(topic, Qos::Event).unwrap();
    bench.grip_the_disk().await;
    let stop = CancellationToken::new();
    let released = bench.work(&stop, |robot| robot.set_suction(false));
    let end = Instant::now() + PATIENCE;
    while !was_on(&mut states, BLOW_OFF_PIN).1 {
        assert!(Instant::now() < end, "nothing blows off");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let said = Instant::now();
    stop.cancel();
    assert_eq!(released.await.unwrap(), Err(DriverError::Stopped));
    assert!(
        said.elapsed() < Duration::from_secs(1),
        "{:?}",
        said.elapsed()
    );
    let _ = was_on(&mut states, BLOW_OFF_PIN);
    let next = tokio::time::timeout(PATIENCE, states.recv()).await.unwrap();
    assert!(!output(&next, BLOW_OFF_PIN));
}

/// An executor's edge without a driver.
async fn executor(network: Network) -> (Context, Node, DriverClient) {
    let context = Context::new(network);
    let (node, _) = context
        .node::<NoParameters>("executor", &RosArguments::default())
        .unwrap();
    let cell = WorkCell::builtin().unwrap();
    let client = DriverClient::new(&node, &DriverParameters::default(), &cell).unwrap();
    (context, node, client)
}

#[tokio::test(flavor = "multi_thread")]
async fn of_two_executors_that_start_at_once_one_becomes_active() {
    for round in 0..10 {
        let network = Network::unused().unwrap();
        let begin = Instant::now();
        let ((_one, one_node, one), (_other, other_node, other)) =
            tokio::join!(executor(network), executor(network));
        let activated = tokio::join!(one.activate(&one_node), other.activate(&other_node));
        let took = begin.elapsed();
        let one_of_them = |one_is_active: bool| match one_is_active {
            true => (&other, &other_node),
            false => (&one, &one_node),
        };
        let (active, (loser, loser_node)) = match activated {
            (Ok(active), Err(ActivateError::AnotherIsActive)) => (active, one_of_them(true)),
            (Err(ActivateError::AnotherIsActive), Ok(active)) => (active, one_of_them(false)),
            // On a busy machine they may not hear each other in time: once they do, one of them yields.
            (Ok(one), Ok(other)) => {
                let one_yields = tokio::time::timeout(PATIENCE, async {
                    tokio::select! {
                        () = one.deposed() => true,
                        () = other.deposed() => false,
                    }
                });
                match one_yields.await {
                    Ok(true) => (other, one_of_them(false)),
                    Ok(false) => (one, one_of_them(true)),
                    Err(_) => panic!("round {round}: both are active"),
                }
            }
            (one, other) => panic!("round {round}: {:?} {:?}", one.err(), other.err()),
        };
        println!("round {round}: one was active after {took:?}");
        // It is not deposed by the other one, which still cannot become active.
        let refused = tokio::select! {
            () = active.deposed() => panic!("round {round}: the active one was deposed"),
            again = loser.activate(loser_node) => again,
        };
        assert!(matches!(refused, Err(ActivateError::AnotherIsActive)));
        // Once the first one ends, the other one may.
        drop(active);
        let last = loser.activate(loser_node).await;
        assert!(last.is_ok(), "round {round}");
    }
}
