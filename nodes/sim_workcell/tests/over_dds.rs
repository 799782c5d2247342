//! The simulated cell as a client of the UR driver and a viewer of the cameras sees it.

use std::future::Future;
use std::path::Path;
use std::time::Duration;

use msgs::control_msgs::{
    FollowJointTrajectory, FollowJointTrajectoryGoal, FollowJointTrajectoryResult,
};
use msgs::convert;
use msgs::rcl_interfaces::{
    Parameter, ParameterType, ParameterValue, SetParameters, SetParametersRequest,
};
use msgs::sensor_msgs::{Image, JointState};
use msgs::std_msgs::Header;
use msgs::ur_dashboard_msgs::{RobotMode, SafetyMode};
use msgs::ur_msgs::{IOStates, SetIO, SetIORequest};
use node_kit::{
    CallError, CallOptions, Context, GoalStatus, Network, NoParameters, Node, Qos, RosArguments,
    Subscription,
};
use ur5::{JointTrajectory, Joints, TrajectoryPoint, WorkCell};

const FOLLOW: &str = "scaled_joint_trajectory_controller/follow_joint_trajectory";
const SET_IO: &str = "io_and_status_controller/set_io";
const PATIENCE: Duration = Duration::from_secs(60);

async fn within<T>(what: &str, future: impl Future<Output = T>) -> T {
    tokio::time::timeout(PATIENCE, future)
        .await
        .unwrap_or_else(|_| panic!("no {what} within {PATIENCE:?}"))
}

/// Starts the node on a domain of its own; gives a node beside it.
fn start(parameters: &[(&str, &str)]) -> (Context, Context, Node) {
    let network = Network::unused().unwrap();
    let problems_dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/problems");
    let mut line = vec!["--ros-args".to_owned()];
    line.extend([
        "-p".into(),
        format!("problems_dir:={}", problems_dir.display()),
    ]);
    for (name, value) in parameters {
        line.extend(["-p".to_owned(), format!("{name}:={value}")]);
    }
    let own = Context::new(network);
    let (node, _) = own
        .node::<NoParameters>("viewer", &RosArguments::default())
        .unwrap();
    let sim = Context::new(network);
    let arguments = RosArguments::parse(line).unwrap().0;
    sim_workcell::start(&sim, &arguments).unwrap();
    (sim, own, node)
}

/// Turns the base by an angle within a time, from joint positions.
fn turn(
    cell: &WorkCell,
    from: Joints,
    angle_rad: f64,
    time: Duration,
) -> FollowJointTrajectoryGoal {
    let mut to = from;
    to[0] += angle_rad;
    let point = |time, positions_rad| TrajectoryPoint {
        time,
        positions_rad,
        velocities_rad_s: Joints::zeros(),
    };
    let points = vec![point(Duration::ZERO, from), point(time, to)];
    let trajectory = JointTrajectory::new(points).unwrap();
    FollowJointTrajectoryGoal {
        trajectory: convert::joint_trajectory_to_msg(&trajectory, &cell.joint_names).unwrap(),
        ..Default::default()
    }
}

fn time_of(header: &Header) -> Duration {
    convert::time_from_msg(&header.stamp).unwrap()
}

async fn newest(subscription: &mut Subscription<JointState>) -> JointState {
    while subscription.try_recv().is_some() {}
    within("joint_states", subscription.recv()).await
}

/// Where the arm stands: with it simulated time stands still, and the joint states are the same again. Those of a motion
/// may come after its result.
async fn at_rest(subscription: &mut Subscription<JointState>) -> JointState {
    let mut last = newest(subscription).await;
    loop {
        let next = within("joint_states", subscription.recv()).await;
        if next == last {
            return next;
        }
        last = next;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn goals_are_checked_carried_out_one_at_a_time_and_cancelled() {
    let cell = WorkCell::builtin().unwrap();
    let (sim, _own, node) = start(&[("real_time_factor", "1.0")]);
    let client = node.action_client::<FollowJointTrajectory>(FOLLOW).unwrap();
    let mut joint_states = node
        .subscription::<JointState>("joint_states", Qos::Event)
        .unwrap();
    client.wait_for_server(PATIENCE).await.unwrap();
    let options = CallOptions::default();
    let at_home = at_rest(&mut joint_states).await;

    let mut wrong = turn(&cell, cell.arm.home, 0.1, Duration::from_secs(1));
    wrong.trajectory.joint_names[2] = "tail".into();
    let elsewhere = turn(
        &cell,
        cell.arm.home.add_scalar(0.1),
        0.1,
        Duration::from_secs(1),
    );
    let fast = turn(&cell, cell.arm.home, 2.0, Duration::from_millis(10));
    for (goal, code, expected) in [
        (wrong, FollowJointTrajectoryResult::INVALID_JOINTS, "tail"),
        (
            elsewhere,
            FollowJointTrajectoryResult::INVALID_GOAL,
            "the arm is at",
        ),
        (fast, FollowJointTrajectoryResult::INVALID_GOAL, "rad/s"),
    ] {
        let sent = client.send_goal(&goal, &options).await.unwrap();
        let (status, result) = within("result", sent.result()).await.unwrap();
        assert_eq!((status, result.error_code), (GoalStatus::Aborted, code));
        assert!(
            result.error_string.contains(expected),
            "{}",
            result.error_string
        );
    }
    assert_eq!(newest(&mut joint_states).await, at_home);

    let slow = turn(&cell, cell.arm.home, 0.5, Duration::from_secs(5));
    let sent = client.send_goal(&slow, &options).await.unwrap();
    while newest(&mut joint_states).await.position == at_home.position {}
    let second = client.send_goal(&slow, &options).await;
    assert!(matches!(second, Err(CallError::Rejected { .. })));
    sent.cancel(&options).await.unwrap();
    let (status, _) = within("result", sent.result()).await.unwrap();
    assert_eq!(status, GoalStatus::Canceled);
    let stopped = at_rest(&mut joint_states).await;
    assert!(stopped.velocity.iter().all(|velocity| *velocity == 0.0));

    // From there it can be sent on, and until then it stands there.
    let at = convert::joints_from_msg(&stopped, &cell.joint_names).unwrap();
    let on = turn(&cell, at, 0.1, Duration::from_millis(500));
    let sent = client.send_goal(&on, &options).await.unwrap();
    let mut next = stopped.clone();
    while next == stopped {
        next = within("joint_states", joint_states.recv()).await;
    }
    let passed = time_of(&next.header) - time_of(&stopped.header);
    assert!(passed < Duration::from_millis(100), "{passed:?}");
    let (status, result) = within("result", sent.result()).await.unwrap();
    assert_eq!(
        (status, result.error_code),
        (GoalStatus::Succeeded, 0),
        "{}",
        result.error_string
    );
    let reached =
        convert::joints_from_msg(&at_rest(&mut joint_states).await, &cell.joint_names).unwrap();
    assert!((reached[0] - at[0] - 0.1).abs() < 1e-9);
    sim.shutdown();
}

#[tokio::test(flavor = "multi_thread")]
async fn who_comes_late_hears_the_status_and_sees_the_frames_and_nothing_while_the_arm_is_out() {
    let cell = WorkCell::builtin().unwrap();
    let (sim, _own, node) = start(&[("frames_period_s", "0.1")]);
    let client = node.action_client::<FollowJointTrajectory>(FOLLOW).unwrap();
    client.wait_for_server(PATIENCE).await.unwrap();
    let status = |name| format!("io_and_status_controller/{name}");
    let robot_mode = || {
        let topic = status("robot_mode");
        node.subscription::<RobotMode>(&topic, Qos::Latched)
            .unwrap()
    };
    let color = || {
        let topic = "left/color/image_raw";
        node.subscription::<Image>(topic, Qos::Image).unwrap()
    };
    // Somebody has heard and seen it before.
    within("robot_mode", robot_mode().recv()).await;
    within("frame", color().recv()).await;

    let mut robot_mode = robot_mode();
    let mut safety_mode = node
        .subscription::<SafetyMode>(&status("safety_mode"), Qos::Latched)
        .unwrap();
    let mut io_states = node
        .subscription::<IOStates>(&status("io_states"), Qos::Event)
        .unwrap();
    let mut color = color();
    let mut joint_states = node
        .subscription::<JointState>("joint_states", Qos::Event)
        .unwrap();
    assert_eq!(
        within("robot_mode", robot_mode.recv()).await.mode,
        RobotMode::RUNNING
    );
    assert_eq!(
        within("safety_mode", safety_mode.recv()).await.mode,
        SafetyMode::NORMAL
    );
    let first = within("frame", color.recv()).await;
    let second = within("frame", color.recv()).await;
    assert!(first == second, "a repeated frame differs");
    assert_eq!(
        (first.width, first.height, first.encoding.as_str()),
        (640, 480, "rgb8")
    );
    assert!(first.data.iter().any(|byte| *byte != first.data[0]));

    let set_io = node.service_client::<SetIO>(SET_IO).unwrap();
    set_io.wait_for_server(PATIENCE).await.unwrap();
    let mut request = SetIORequest {
        fun: SetIORequest::FUN_SET_DIGITAL_OUT,
        pin: 3,
        state: 1.0,
    };
    assert!(
        set_io
            .call(&request, &CallOptions::default())
            .await
            .unwrap()
            .success
    );
    let is_high = |states: &IOStates| {
        states
            .digital_out_states
            .iter()
            .any(|pin| pin.pin == 3 && pin.state)
    };
    while !is_high(&within("io_states", io_states.recv()).await) {}
    request.pin = 99;
    assert!(
        !set_io
            .call(&request, &CallOptions::default())
            .await
            .unwrap()
            .success
    );

    let out = turn(&cell, cell.arm.home, 0.3, Duration::from_secs(1));
    let sent = client
        .send_goal(&out, &CallOptions::default())
        .await
        .unwrap();
    assert_eq!(
        within("result", sent.result()).await.unwrap().0,
        GoalStatus::Succeeded
    );
    let there = time_of(&at_rest(&mut joint_states).await.header);
    // Half a second: frames come every 0.1 s.
    for _ in 0..25 {
        within("joint_states", joint_states.recv()).await;
    }
    let mut at = cell.arm.home;
    at[0] += 0.3;
    let back = turn(&cell, at, -0.3, Duration::from_secs(1));
    let sent = client
        .send_goal(&back, &CallOptions::default())
        .await
        .unwrap();
    assert_eq!(
        within("result", sent.result()).await.unwrap().0,
        GoalStatus::Succeeded
    );
    loop {
        let frame = within("frame", color.recv()).await;
        if frame.header.stamp != first.header.stamp {
            let taken = time_of(&frame.header);
            // Back home, a second later.
            assert!(taken > there, "a frame while the arm is out");
            break;
        }
    }
    sim.shutdown();
}

/// Sets the parameter `hardware.fault` of the node.
async fn set_fault(node: &Node, fault: &str) {
    let client = node
        .service_client::<SetParameters>("sim_workcell/set_parameters")
        .unwrap();
    client.wait_for_server(PATIENCE).await.unwrap();
    let value = ParameterValue {
        r#type: ParameterType::PARAMETER_STRING,
        string_value: fault.to_owned(),
        ..Default::default()
    };
    let parameter = Parameter {
        name: "hardware.fault".to_owned(),
        value,
    };
    let request = SetParametersRequest {
        parameters: vec![parameter],
    };
    let answer = client.call(&request, &CallOptions::default()).await;
    assert!(answer.unwrap().results[0].successful);
}

#[tokio::test(flavor = "multi_thread")]
async fn what_was_asked_of_a_dead_driver_is_not_done_once_it_is_started_again() {
    let (_sim, _own, node) = start(&[]);
    let mut io_states = node
        .subscription::<IOStates>("io_and_status_controller/io_states", Qos::Event)
        .unwrap();
    let set_io = node.service_client::<SetIO>(SET_IO).unwrap();
    set_io.wait_for_server(PATIENCE).await.unwrap();
    within("io_states", io_states.recv()).await;
    let request = |pin| SetIORequest {
        fun: SetIORequest::FUN_SET_DIGITAL_OUT,
        pin,
        state: 1.0,
    };
    set_fault(&node, "driver_dead").await;
    // Each waits behind the one before, as repeated calls do.
    let impatient = CallOptions {
        attempts: 3,
        timeout: Duration::from_millis(200),
    };
    while set_io.call(&request(2), &impatient).await.is_ok() {}
    for pin in [3, 4] {
        assert!(set_io.call(&request(pin), &impatient).await.is_err());
    }
    set_fault(&node, "none").await;
    let answer = set_io.call(&request(5), &CallOptions::default()).await;
    assert!(answer.unwrap().success);
    let is_high = |states: &IOStates, number| {
        let mut pins = states.digital_out_states.iter();
        pins.any(|pin| pin.pin == number && pin.state)
    };
    loop {
        let states = within("io_states", io_states.recv()).await;
        assert!(!is_high(&states, 3) && !is_high(&states, 4), "{states:?}");
        if is_high(&states, 5) {
            break;
        }
    }
}
