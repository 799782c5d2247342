//! The driver's edge against a simulated driver that behaves as a real one does.

use std::path::Path;

use msgs::control_msgs::FollowJointTrajectoryGoal;
use msgs::rcl_interfaces::{
    Parameter, ParameterType, ParameterValue, SetParameters, SetParametersRequest,
};
use nalgebra::{Isometry2, Vector2};
use node_kit::{Context, GoalStatus, Network, NoParameters, RosArguments};
use pick_place::Robot;
use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;
use ur5::{Arm, Joints};

use super::*;

const PATIENCE: Duration = Duration::from_secs(30);

/// A simulated driver, and the executor's edge to it.
struct Bench {
    sim: Context,
    own: Context,
    node: Node,
    client: Arc<DriverClient>,
    cell: WorkCell,
}

impl Bench {
    /// `hardware`: parameters of the simulated driver.
    async fn start(hardware: &[(&str, &str)], driver: DriverParameters) -> Self {
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
        sim.start("sim_workcell", &arguments, sim_workcell::configure)
            .unwrap();
        let bench = Self {
            sim,
            own,
            node,
            client: Arc::new(client),
            cell,
        };
        bench
            .until("a ready driver", |bench| bench.client.obstacle().is_none())
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
        let arm = &self.cell.arm;
        let pose = Isometry2::new(Vector2::new(0.5, 0.25), 0.0);
        let above = arm.solve(&Arm::tip_down(&pose, 0.05), &arm.ready).unwrap();
        let there = JointTrajectory::joint_space(arm, &self.joints(), &above).unwrap();
        let moved = self.work(&CancellationToken::new(), move |robot| {
            (robot.follow(&there), robot.joints())
        });
        let (reached, joints) = moved.await.unwrap();
        assert_eq!(reached, Ok(true));
        let end = Arm::tip_down(&pose, -0.01);
        JointTrajectory::line(arm, &joints.unwrap(), &end, 0.05, 1.0).unwrap()
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

    /// Furthest that a joint goes from where it is in some seconds (rad).
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

    /// Sets a parameter of the simulated driver.
    async fn set_fault(&self, fault: &str) {
        let client = self
            .node
            .service_client::<SetParameters>("sim_workcell/set_parameters")
            .unwrap();
        client.wait_for_server(PATIENCE).await.unwrap();
        let request = SetParametersRequest {
            parameters: vec![Parameter {
                name: "hardware.fault".into(),
                value: ParameterValue {
                    r#type: ParameterType::PARAMETER_STRING,
                    string_value: fault.into(),
                    ..Default::default()
                },
            }],
        };
        let answer = client.call(&request, &CallOptions::default()).await;
        assert!(answer.unwrap().results[0].successful);
    }
}

impl Drop for Bench {
    fn drop(&mut self) {
        self.sim.shutdown();
    }
}

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
    tokio::time::sleep(Duration::from_millis(300)).await;
    let said = Instant::now();
    stop.cancel();
    assert_eq!(descended.await.unwrap(), Err(DriverError::Stopped));
    let took = said.elapsed();
    assert!(took < Duration::from_millis(500), "{took:?}");
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
    bench.own.shutdown();
    tokio::time::sleep(Duration::from_millis(50)).await;
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
    tokio::time::sleep(Duration::from_millis(300)).await;
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
        ("emergency_stop", "robot mode is 3"),
        ("program_stopped", "program is not running"),
        ("driver_dead", "expected at most 0.3 s"),
    ] {
        let driver = DriverParameters {
            status_max_age_s: 0.3,
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
        // The controller's own end of the goal may be heard of first.
        let ended = reason.contains("the robot has stopped");
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
    for (hardware, driver, expected) in [
        (
            (
                "inactive_controllers",
                "[scaled_joint_trajectory_controller]",
            ),
            DriverParameters::default(),
            "scaled_joint_trajectory_controller",
        ),
        (
            ("inactive_controllers", "[tool_contact_controller]"),
            DriverParameters::default(),
            "tool_contact_controller",
        ),
        (
            ("software_major", "3"),
            DriverParameters::default(),
            "software",
        ),
        (("tool_voltage", "0"), DriverParameters::default(), "pin 16"),
        (
            ("tool_voltage", "0"),
            DriverParameters {
                suction_pin: 3,
                vacuum_pin: 4,
                ..DriverParameters::default()
            },
            "",
        ),
    ] {
        let bench = Bench::start(&[hardware], driver).await;
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
    // It is dead by then, and not known to be.
    tokio::time::sleep(Duration::from_millis(300)).await;
    let released = bench.work(&stop, |robot| robot.set_suction(false));
    tokio::time::sleep(Duration::from_millis(2500)).await;
    bench.set_fault("none").await;
    let reason = reason(released.await.unwrap());
    assert!(reason.contains("expected at most 1.0 s"), "{reason}");
    bench
        .until("driver that is back", |bench| {
            bench.client.obstacle().is_none()
        })
        .await;
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
