//! The executor and the simulated cell over DDS, with this test in place of fusion, policy and operator.

use std::collections::BTreeMap;
use std::future::Future;
use std::path::Path;
use std::time::{Duration, Instant};

use heightmap::{Camera, Fusion, Heightmap, View, Workspace};
use msgs::convert;
use msgs::diagnostic_msgs::{DiagnosticArray, DiagnosticStatus};
use msgs::sctn_msgs::{
    self, OperatorPresence, PlannedMotion, ProposeHome, ProposeHomeRequest, ProposeHomeResponse,
    Reward, StepConfirmation, StepResult,
};
use msgs::sensor_msgs::{CameraInfo, Image, JointState};
use msgs::tf2_msgs::TFMessage;
use msgs::ur_dashboard_msgs::SafetyMode;
use multiravens::{Environment, Problem};
use nalgebra::{Isometry2, Isometry3, Vector2};
use node_kit::{
    CallOptions, Context, LifecycleClient, Network, NoParameters, Node, Publisher, Qos,
    RosArguments, State, Subscription, Transition,
};
use pick_place::{PickPlace, PrimitiveSettings};
use tokio::task::JoinHandle;
use ur5::WorkCell;

const SEED: u64 = 10_000;
const CAMERAS: [&str; 3] = ["front", "left", "right"];
const PATIENCE: Duration = Duration::from_secs(60);

fn problems_dir() -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/problems")
}

fn arguments(parameters: &[(&str, String)]) -> RosArguments {
    let mut line = vec!["--ros-args".to_owned()];
    for (name, value) in parameters {
        line.extend(["-p".to_owned(), format!("{name}:={value}")]);
    }
    RosArguments::parse(line).unwrap().0
}

async fn within<T>(what: &str, future: impl Future<Output = T>) -> T {
    tokio::time::timeout(PATIENCE, future)
        .await
        .unwrap_or_else(|_| panic!("no {what} within {PATIENCE:?}"))
}

/// The nodes under test on a domain of their own, and everybody else.
struct Bench {
    sim: Context,
    executor: Context,
    /// Ends when the executor has ended.
    executor_life: Option<JoinHandle<anyhow::Result<()>>>,
    node: Node,
    heightmaps: Publisher<sctn_msgs::Heightmap>,
    proposals: Publisher<sctn_msgs::PickPlace>,
    confirmations: Publisher<StepConfirmation>,
    safety_mode: Publisher<SafetyMode>,
    results: Subscription<StepResult>,
    rewards: Subscription<Reward>,
    joint_states: Subscription<JointState>,
    diagnostics: Subscription<DiagnosticArray>,
    transforms: Subscription<TFMessage>,
    poses: BTreeMap<String, Isometry3<f64>>,
    color: BTreeMap<&'static str, Subscription<Image>>,
    depth: BTreeMap<&'static str, Subscription<Image>>,
    info: BTreeMap<&'static str, Subscription<CameraInfo>>,
}

impl Bench {
    async fn start(sim: &[(&str, String)], executor: &[(&str, String)]) -> Self {
        if let Ok(level) = std::env::var("TEST_LOG_LEVEL") {
            // Once for all tests of the process.
            let _ = node_kit::logging::init(&[level]);
        }
        let network = Network::unused().unwrap();
        let own = Context::new(network);
        let (node, _) = own
            .node::<NoParameters>("bench", &RosArguments::default())
            .unwrap();
        let per_camera = |topic: &str| CAMERAS.map(|camera| (camera, format!("{camera}/{topic}")));
        let images = |topic| {
            let topics = per_camera(topic).into_iter();
            topics
                .map(|(camera, topic)| (camera, node.subscription(&topic, Qos::Image).unwrap()))
                .collect()
        };
        let mut bench = Self {
            heightmaps: node.publisher("heightmap", Qos::Latched).unwrap(),
            proposals: node.publisher("pick_place", Qos::Latched).unwrap(),
            confirmations: node.publisher("step_confirmation", Qos::Event).unwrap(),
            safety_mode: node
                .publisher("io_and_status_controller/safety_mode", Qos::Latched)
                .unwrap(),
            results: node.subscription("step_result", Qos::Event).unwrap(),
            rewards: node.subscription("reward", Qos::Event).unwrap(),
            joint_states: node.subscription("joint_states", Qos::Event).unwrap(),
            diagnostics: node.subscription("/diagnostics", Qos::Event).unwrap(),
            transforms: node.subscription("/tf_static", Qos::Latched).unwrap(),
            poses: BTreeMap::new(),
            color: images("color/image_raw"),
            depth: images("depth/image_rect_raw"),
            info: per_camera("color/camera_info")
                .into_iter()
                .map(|(camera, topic)| (camera, node.subscription(&topic, Qos::Event).unwrap()))
                .collect(),
            sim: Context::new(network),
            executor: Context::new(network),
            executor_life: None,
            node,
        };
        let common = |more: &[(&'static str, String)], given: &[(&str, String)]| {
            let mut all = vec![("use_sim_time", "true".to_owned())];
            all.extend_from_slice(more);
            let mut all: Vec<(String, String)> =
                all.into_iter().map(|(n, v)| (n.to_owned(), v)).collect();
            all.extend(given.iter().map(|(n, v)| ((*n).to_owned(), v.clone())));
            let all: Vec<(&str, String)> =
                all.iter().map(|(n, v)| (n.as_str(), v.clone())).collect();
            arguments(&all)
        };
        let scene = [
            ("problems_dir", problems_dir().display().to_string()),
            ("seed", SEED.to_string()),
        ];
        sim_workcell::start(&bench.sim, &common(&scene, sim)).unwrap();
        let life = suction_executor::start(&bench.executor, &common(&[], executor)).unwrap();
        bench.executor_life = Some(life);
        let graph = bench.node.graph();
        for topic in [
            bench.proposals.topic(),
            bench.confirmations.topic(),
            bench.heightmaps.topic(),
        ] {
            assert!(
                graph.wait_for_subscription(topic, PATIENCE).await,
                "nobody listens to {topic}"
            );
        }
        assert!(graph.wait_for_publisher("/step_result", PATIENCE).await);
        // Discovery tells of endpoints in the order in which they were made: who answers a client that was made last knows all those above.
        for name in ["/sim_workcell", "/suction_executor"] {
            let life = LifecycleClient::new(&bench.node, name).unwrap();
            life.wait(PATIENCE).await.unwrap();
            let is_active = async || matches!(life.state().await, Ok(Some(State::Active)));
            within("active node", async { while !is_active().await {} }).await;
        }
        let ready = |status: &DiagnosticStatus| status.message == "ready";
        bench.diagnosed("/suction_executor: driver", ready).await;
        bench
    }

    async fn stop(self) {
        self.executor.shutdown();
        self.sim.shutdown();
        self.node.stop();
        tokio::time::sleep(Duration::from_millis(100)).await;
    }

    /// What the cameras show at a time.
    async fn look(&mut self, time: Duration) -> Heightmap {
        let stamp = convert::time_to_msg(time).unwrap();
        if self.poses.is_empty() {
            let message = within("tf_static", self.transforms.recv()).await;
            let pose = |t: &msgs::geometry_msgs::TransformStamped| {
                convert::isometry_from_msg(&t.transform).unwrap()
            };
            self.poses = message
                .transforms
                .iter()
                .map(|t| (t.child_frame_id.clone(), pose(t)))
                .collect();
        }
        let mut views = Vec::new();
        for name in CAMERAS {
            let info = within(
                "camera_info",
                newest(self.info.get_mut(name).unwrap(), |m| {
                    m.header.stamp == stamp
                }),
            )
            .await;
            let color = within(
                "colour",
                newest(self.color.get_mut(name).unwrap(), |m| {
                    m.header.stamp == stamp
                }),
            )
            .await;
            let depth = within(
                "depth",
                newest(self.depth.get_mut(name).unwrap(), |m| {
                    m.header.stamp == stamp
                }),
            )
            .await;
            let intrinsics = convert::intrinsics_from_msg(&info).unwrap();
            let (mut rgb, mut depth_m) = (Vec::new(), Vec::new());
            convert::color_from_msg(&color, &intrinsics, &mut rgb).unwrap();
            convert::depth_from_msg(&depth, &mut depth_m).unwrap();
            let world_from_camera = self.poses[&info.header.frame_id];
            views.push((
                Camera {
                    name: name.into(),
                    intrinsics,
                    world_from_camera,
                },
                rgb,
                depth_m,
            ));
        }
        let views: Vec<View<'_>> = views
            .iter()
            .map(|(camera, rgb, depth_m)| View {
                camera,
                rgb,
                depth_m,
            })
            .collect();
        let mut heightmap = Heightmap::new(Workspace::RAVENS);
        Fusion::default().fuse(&views, &mut heightmap).unwrap();
        heightmap
    }

    fn observe(&self, heightmap: &Heightmap, time: Duration) {
        let header = convert::header(time, "world").unwrap();
        self.heightmaps
            .publish(convert::heightmap_to_msg(heightmap.clone(), header, 3, 1.0).unwrap());
    }

    fn propose(&self, id: u64, time: Duration, action: &PickPlace, settings: &PrimitiveSettings) {
        self.proposals.publish(sctn_msgs::PickPlace {
            header: convert::header(time, "world").unwrap(),
            id,
            pick: convert::pose2d_to_msg(&action.pick),
            place: convert::pose2d_to_msg(&action.place),
            settings: convert::settings_to_msg(settings),
            ..Default::default()
        });
    }

    fn decide(&self, proposal_id: u64, decision: u8) {
        self.confirmations.publish(StepConfirmation {
            proposal_id,
            decision,
            operator_name: "test".into(),
            ..Default::default()
        });
    }

    async fn result(&mut self) -> StepResult {
        within("step_result", self.results.recv()).await
    }

    /// The next result, of this proposal and with this outcome.
    async fn ended(&mut self, id: u64, outcome: u8) -> StepResult {
        let result = self.result().await;
        let reason = &result.reason;
        assert_eq!(
            (result.proposal_id, result.outcome),
            (id, outcome),
            "{reason}"
        );
        result
    }

    async fn next_joints(&mut self) -> JointState {
        within("joint_states", self.joint_states.recv()).await
    }

    /// Where the arm stands: with it simulated time stands still, and the joint states are the same again. Those of a
    /// motion may come after its result.
    async fn joints(&mut self) -> JointState {
        while self.joint_states.try_recv().is_some() {}
        let mut last = self.next_joints().await;
        loop {
            let next = self.next_joints().await;
            if next == last {
                return next;
            }
            last = next;
        }
    }

    /// The hash of the final state, as the simulation's diagnostics show it after so many steps.
    async fn state_hash(&mut self, steps: &str) -> String {
        loop {
            for status in self.diagnostics.recv().await.status {
                let value = |key: &str| {
                    let mut values = status.values.iter();
                    values
                        .find(|value| value.key == key)
                        .map(|value| value.value.clone())
                };
                if value("steps").is_some_and(|value| value == steps)
                    && let Some(hash) = value("state_hash")
                {
                    return hash;
                }
            }
        }
    }

    /// A state in the diagnostics that is as a test needs it.
    async fn diagnosed(&mut self, name: &str, accept: impl Fn(&DiagnosticStatus) -> bool) {
        let found = async {
            loop {
                let array = self.diagnostics.recv().await;
                let mut statuses = array.status.iter();
                if statuses.any(|status| status.name == name && accept(status)) {
                    return;
                }
            }
        };
        within(name, found).await;
    }

    /// Waits until the executor has read so many messages of a topic.
    async fn read_by_executor(&mut self, topic: &str, messages: u64) {
        let text = format!("in messages={messages} ");
        let has_read = |status: &DiagnosticStatus| {
            let mut values = status.values.iter();
            values.any(|value| value.key == topic && value.value.starts_with(&text))
        };
        self.diagnosed("/suction_executor: topics", has_read).await;
    }

    /// The arm stands where it stood, and nothing has moved since: simulated time has not gone on either.
    async fn stands_since(&mut self, stood: &JointState) {
        assert_eq!(self.joints().await, *stood);
    }

    /// Waits until the arm leaves where it stands. It does so at once in simulated time: nothing has moved before.
    async fn leaves(&mut self, stood: &JointState) {
        let left = within("motion", async {
            loop {
                let state = self.joint_states.recv().await;
                if state.position != stood.position {
                    return state;
                }
            }
        });
        let passed = time_of(&left.await) - time_of(stood);
        assert!(passed < Duration::from_millis(100), "{passed:?}");
    }

    /// Proposes the way home once the executor is ready for it.
    async fn propose_home(&mut self) -> ProposeHomeResponse {
        let client = self
            .node
            .service_client::<ProposeHome>("/suction_executor/propose_home")
            .unwrap();
        client.wait_for_server(PATIENCE).await.unwrap();
        // A call may be lost while the two ends are still discovering each other.
        let patient = CallOptions {
            attempts: 12,
            timeout: PATIENCE / 12,
        };
        let call = ProposeHomeRequest::default();
        client.call(&call, &patient).await.unwrap()
    }

    /// Brings the arm home by a way home that was proposed. Nothing else has moved since it stood still.
    async fn goes_home_since(&mut self, stood: &JointState, proposal_id: u64) {
        self.decide(proposal_id, StepConfirmation::APPROVE);
        let result = self.ended(proposal_id, StepResult::AT_HOME).await;
        let end = convert::time_from_msg(&result.header.stamp).unwrap();
        let took = convert::duration_from_msg(&result.duration).unwrap();
        assert_eq!(end - time_of(stood), took);
    }

    /// Waits until simulated time has gone on by so much.
    async fn until_passed(&mut self, time: Duration) {
        let begin = time_of(&self.next_joints().await);
        while time_of(&self.next_joints().await) < begin + time {}
    }

    /// Waits until the arm has left where it was.
    async fn until_moving(&mut self) {
        while self.joint_states.try_recv().is_some() {}
        let before = self.next_joints().await;
        while self.next_joints().await.position == before.position {}
    }
}

async fn newest<M: msgs::Interface>(
    subscription: &mut Subscription<M>,
    accept: impl Fn(&M) -> bool,
) -> M {
    loop {
        let message = subscription.recv().await;
        if accept(&message) {
            return message;
        }
    }
}

fn time_of(state: &JointState) -> Duration {
    convert::time_from_msg(&state.header.stamp).unwrap()
}

fn reference() -> Environment {
    reference_of("placing")
}

fn reference_of(problem: &str) -> Environment {
    let problem = Problem::load(&problems_dir(), problem).unwrap();
    let mut environment = Environment::new(&problem, &WorkCell::builtin().unwrap());
    environment.reset(SEED).unwrap();
    environment
}

/// A bench that has seen the start of the episode, with the demonstrator's first action as proposal 1.
async fn proposed(
    sim: &[(&str, String)],
    executor: &[(&str, String)],
) -> (Bench, Environment, Heightmap) {
    let mut environment = reference();
    let mut bench = Bench::start(sim, executor).await;
    let time = environment.cell().time();
    let heightmap = bench.look(time).await;
    bench.observe(&heightmap, time);
    let action = environment.demonstrate().unwrap();
    bench.propose(1, time, &action, &environment.settings().unwrap());
    (bench, environment, heightmap)
}

/// A second of wall time in which the arm takes its time.
fn slow() -> Vec<(&'static str, String)> {
    vec![("real_time_factor", "1.0".to_owned())]
}

#[tokio::test(flavor = "multi_thread")]
async fn an_episode_over_dds_is_the_episode_in_process_bit_for_bit() {
    let environment = episode("placing").await;
    assert!(environment.is_complete());
}

#[tokio::test(flavor = "multi_thread")]
async fn so_is_one_with_a_chain_that_takes_long_to_settle() {
    episode("routing").await;
}

/// Plays an episode in process and over DDS side by side.
async fn episode(problem: &str) -> Environment {
    let mut environment = reference_of(problem);
    let mut bench = Bench::start(&[("problem", problem.to_owned())], &[]).await;
    let begin = Instant::now();
    for id in 1.. {
        let time = environment.cell().time();
        let seen = bench.look(time).await;
        assert!(
            seen == *environment.observe().unwrap(),
            "heightmap of step {id} differs"
        );
        let action = match environment.demonstrate() {
            _ if environment.is_done() => break,
            None => break,
            // Nothing to pick there, and nothing in the way: what fails, fails alike.
            Some(_) if id == 3 => PickPlace {
                pick: Isometry2::new(Vector2::new(0.3, 0.3), 0.0),
                place: Isometry2::new(Vector2::new(0.6, 0.45), 1.0),
            },
            Some(action) => action,
        };
        let settings = environment.settings().unwrap();
        bench.observe(&seen, time);
        bench.propose(id, time, &action, &settings);
        bench.decide(id, StepConfirmation::APPROVE);
        let expected = environment.step(&action).unwrap();

        let outcome = convert::outcome_to_msg(expected.outcome);
        let result = bench.ended(id, outcome).await;
        assert!(outcome != StepResult::PLACED || id != 3);
        assert_eq!(
            convert::time_from_msg(&result.header.stamp).unwrap(),
            expected.time
        );
        assert_eq!(
            convert::duration_from_msg(&result.duration).unwrap(),
            expected.time - time
        );
        let reward = within("reward", bench.rewards.recv()).await;
        assert_eq!(
            convert::time_from_msg(&reward.header.stamp).unwrap(),
            expected.time
        );
        assert_eq!(reward.delta.to_bits(), expected.delta_reward.to_bits());
        assert_eq!(reward.total.to_bits(), expected.total_reward.to_bits());
        assert_eq!(reward.complete, expected.complete);
        println!(
            "step {id}: {:?} of simulated time, {:?} in all",
            expected.time - time,
            begin.elapsed()
        );
    }
    let steps = environment.steps().to_string();
    let state = within("state hash", bench.state_hash(&steps)).await;
    assert_eq!(state, format!("{:016x}", environment.state_hash()));
    bench.stop().await;
    environment
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stop_stops_the_arm_and_it_goes_on_neither_by_itself_nor_on_the_old_approval() {
    let (mut bench, environment, _) = proposed(&slow(), &[]).await;
    bench.decide(1, StepConfirmation::APPROVE);
    bench.until_moving().await;
    bench.decide(1, StepConfirmation::STOP);
    bench.ended(1, StepResult::STOPPED).await;
    let stopped = bench.joints().await;
    let home = environment.cell().work_cell().arm.home;
    assert!(stopped.position != home.iter().copied().collect::<Vec<_>>());
    bench.decide(1, StepConfirmation::APPROVE);
    let result = bench.result().await;
    assert_eq!(result.outcome, StepResult::REFUSED);
    assert!(
        result.reason.contains("already carried out"),
        "{}",
        result.reason
    );
    // Called home, it can see and be told again. The call alone moves nothing.
    let proposed = bench.propose_home().await;
    assert!(
        proposed.success && proposed.needs_approval,
        "{}",
        proposed.message
    );
    let again = bench.propose_home().await;
    assert_eq!(again.proposal_id, proposed.proposal_id);
    bench.decide(1, StepConfirmation::APPROVE);
    bench.ended(1, StepResult::REFUSED).await;
    bench.stands_since(&stopped).await;
    bench.goes_home_since(&stopped, proposed.proposal_id).await;
    let at_home = bench.joints().await;
    assert_eq!(
        convert::joints_from_msg(&at_home, &environment.cell().work_cell().joint_names).unwrap(),
        home
    );
    let time = convert::time_from_msg(&at_home.header.stamp).unwrap();
    let seen = bench.look(time).await;
    bench.observe(&seen, time);
    let action = reference().demonstrate().unwrap();
    bench.propose(2, time, &action, &environment.settings().unwrap());
    bench.decide(2, StepConfirmation::APPROVE);
    bench.until_moving().await;
    bench.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn deactivating_during_a_motion_stops_the_arm_and_nothing_moves_until_a_new_approval() {
    let (mut bench, ..) = proposed(&slow(), &[]).await;
    let executor = LifecycleClient::new(&bench.node, "/suction_executor").unwrap();
    executor.wait(PATIENCE).await.unwrap();
    bench.decide(1, StepConfirmation::APPROVE);
    bench.until_moving().await;
    executor
        .lead(
            Transition::Deactivate,
            State::Active,
            State::Inactive,
            PATIENCE,
        )
        .await
        .unwrap();
    bench.ended(1, StepResult::STOPPED).await;
    let stopped = bench.joints().await;
    // Nobody hears this.
    bench.decide(1, StepConfirmation::APPROVE);
    executor
        .lead(
            Transition::Activate,
            State::Inactive,
            State::Active,
            PATIENCE,
        )
        .await
        .unwrap();
    assert!(
        bench
            .node
            .graph()
            .wait_for_subscription(bench.confirmations.topic(), PATIENCE)
            .await
    );
    // Both ends may still be discovering each other: the answer about an unknown one says that the executor hears.
    let answer = async {
        loop {
            bench.decide(50, StepConfirmation::APPROVE);
            let answer = tokio::time::timeout(Duration::from_secs(2), bench.results.recv());
            let Ok(result) = answer.await else {
                continue;
            };
            // Neither of the approvals of before is heard now.
            assert_eq!(
                (result.proposal_id, result.outcome),
                (50, StepResult::REFUSED),
                "{}",
                result.reason
            );
            return;
        }
    };
    within("answer", answer).await;
    bench.decide(1, StepConfirmation::APPROVE);
    // That of the unknown one may have been heard more than once.
    let known = newest(&mut bench.results, |result| result.proposal_id != 50);
    let result = within("step_result", known).await;
    assert_eq!(
        (result.proposal_id, result.outcome),
        (1, StepResult::REFUSED),
        "{}",
        result.reason
    );
    assert!(
        result.reason.contains("already carried out"),
        "{}",
        result.reason
    );
    bench.stands_since(&stopped).await;
    let home = bench.propose_home().await;
    assert!(home.success, "{}", home.message);
    bench.goes_home_since(&stopped, home.proposal_id).await;
    bench.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_executor_that_is_told_to_end_during_a_motion_stops_the_arm_first() {
    let (mut bench, ..) = proposed(&slow(), &[]).await;
    bench.decide(1, StepConfirmation::APPROVE);
    bench.until_moving().await;
    bench.executor.shutdown();
    bench.ended(1, StepResult::STOPPED).await;
    let stopped = bench.joints().await;
    let life = bench.executor_life.take().unwrap();
    let ended = within("end of the executor", life).await;
    ended.unwrap().unwrap();
    bench.stands_since(&stopped).await;
    bench.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_protective_stop_is_a_fault_and_nothing_moves_until_it_is_over() {
    let (mut bench, environment, heightmap) = proposed(&slow(), &[]).await;
    bench.decide(1, StepConfirmation::APPROVE);
    bench.until_moving().await;
    bench.safety_mode.publish(SafetyMode {
        mode: SafetyMode::PROTECTIVE_STOP,
    });
    let result = bench.ended(1, StepResult::FAULT).await;
    assert!(
        result.reason.contains("PROTECTIVE_STOP"),
        "{}",
        result.reason
    );
    let stopped = bench.joints().await;
    // A new observation and approval are not enough while it lasts, ...
    let time = convert::time_from_msg(&result.header.stamp).unwrap() + Duration::from_secs(1);
    bench.observe(&heightmap, time);
    bench.propose(
        2,
        time,
        &reference().demonstrate().unwrap(),
        &environment.settings().unwrap(),
    );
    bench.decide(2, StepConfirmation::APPROVE);
    let result = bench.ended(2, StepResult::REFUSED).await;
    assert!(
        result.reason.contains("PROTECTIVE_STOP"),
        "{}",
        result.reason
    );
    bench.stands_since(&stopped).await;
    // ... and when it is over, which the executor knows when it proposes the way home, the arm waits for a word.
    bench.safety_mode.publish(SafetyMode {
        mode: SafetyMode::NORMAL,
    });
    loop {
        let home = bench.propose_home().await;
        if home.success {
            break;
        }
        assert!(home.message.contains("PROTECTIVE_STOP"), "{}", home.message);
    }
    bench.stands_since(&stopped).await;
    bench.decide(2, StepConfirmation::APPROVE);
    bench.leaves(&stopped).await;
    bench.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_lost_driver_is_a_fault() {
    let status_max_age = vec![("driver.status_max_age_s", "1.0".to_owned())];
    let (mut bench, _, _) = proposed(&slow(), &status_max_age).await;
    bench.decide(1, StepConfirmation::APPROVE);
    bench.until_moving().await;
    bench.sim.shutdown();
    let result = bench.ended(1, StepResult::FAULT).await;
    assert!(!result.reason.is_empty());
    bench.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn when_no_approval_is_required_a_proposal_moves_once_by_itself_until_a_stop() {
    let automatic = vec![("require_approval", "never".to_owned())];
    let (mut bench, mut environment, _) = proposed(&[], &automatic).await;
    let mut planned = bench
        .node
        .subscription::<PlannedMotion>("planned_motion", Qos::Latched)
        .unwrap();
    let action = reference().demonstrate().unwrap();
    let (time, settings) = (environment.cell().time(), environment.settings().unwrap());
    let expected = environment.step(&action).unwrap();
    let result = bench.ended(1, StepResult::PLACED).await;
    assert_eq!(
        convert::time_from_msg(&result.header.stamp).unwrap(),
        expected.time
    );
    // The same message once more moves nothing.
    let before = bench.joints().await;
    bench.propose(1, time, &action, &settings);
    bench.read_by_executor("/pick_place", 2).await;
    bench.stands_since(&before).await;
    // Nor does anything by itself after a stop; confirmations are read one after the other.
    bench.decide(1, StepConfirmation::STOP);
    bench.decide(1, StepConfirmation::APPROVE);
    bench.ended(1, StepResult::REFUSED).await;
    let seen = bench.look(expected.time).await;
    bench.observe(&seen, expected.time);
    let action = environment.demonstrate().unwrap();
    let settings = environment.settings().unwrap();
    bench.propose(2, expected.time, &action, &settings);
    // Once it was rehearsed it could move.
    let of_second = newest(&mut planned, |m| m.proposal_id == 2);
    within("planned motion", of_second).await;
    // An approval that is refused changes nothing about that, one that holds lets it go on.
    bench.decide(99, StepConfirmation::APPROVE);
    bench.ended(99, StepResult::REFUSED).await;
    bench.stands_since(&before).await;
    bench.decide(2, StepConfirmation::APPROVE);
    let result = bench.ended(2, StepResult::PLACED).await;
    // Nothing else has moved: simulated time would have gone on.
    assert_eq!(
        convert::time_from_msg(&result.header.stamp).unwrap(),
        environment.step(&action).unwrap().time
    );
    bench.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn with_require_presence_nothing_moves_unattended_and_a_motion_stops_when_the_operator_falls_silent()
 {
    let required = [("require_presence", "true".to_owned())];
    let (mut bench, environment, _) = proposed(&slow(), &required).await;
    bench.decide(1, StepConfirmation::APPROVE);
    let result = bench.ended(1, StepResult::REFUSED).await;
    assert!(
        result.reason.contains("no operator is present"),
        "{}",
        result.reason
    );
    let presence = bench
        .node
        .publisher("operator_presence", Qos::Event)
        .unwrap();
    let graph = bench.node.graph();
    assert!(
        graph
            .wait_for_subscription(presence.topic(), PATIENCE)
            .await
    );
    let present = || {
        presence.publish(OperatorPresence {
            is_present: true,
            ..OperatorPresence::default()
        });
    };
    // The operator is there until the arm moves, and then nothing more is heard. The executor may hear of the approval first.
    let at_home = bench.joints().await.position;
    let mut beat = tokio::time::interval(Duration::from_millis(200));
    let moving = async {
        present();
        bench.decide(1, StepConfirmation::APPROVE);
        loop {
            tokio::select! {
                state = bench.joint_states.recv() => if state.position != at_home {
                    return;
                },
                result = bench.results.recv() => {
                    assert!(result.reason.contains("no operator is present"), "{}", result.reason);
                    present();
                    bench.decide(1, StepConfirmation::APPROVE);
                }
                _ = beat.tick() => present(),
            }
        }
    };
    within("motion", moving).await;
    let result = bench.ended(1, StepResult::STOPPED).await;
    assert_eq!(result.proposal_id, 1);
    let stopped = bench.joints().await;
    let home = environment.cell().work_cell().arm.home;
    assert!(stopped.position != home.iter().copied().collect::<Vec<_>>());
    bench.stop().await;
}

/// Largest acceleration (rad/s^2) and jerk (rad/s^3) of a joint in a planned motion, each part of which begins and ends at rest.
fn planned_peaks(motion: &PlannedMotion) -> (f64, f64) {
    let points = &motion.trajectory.points;
    assert!(points.len() > 2, "{}", motion.reason);
    let time_s = |index: usize| {
        let time = convert::duration_from_msg(&points[index].time_from_start).unwrap();
        time.as_secs_f64()
    };
    let rests = |index: usize| points[index].velocities.iter().all(|speed| *speed == 0.0);
    let (mut most, mut most_jerk) = (0.0f64, 0.0f64);
    let mut before: Option<Vec<f64>> = None;
    for index in 1..points.len() {
        let step_s = time_s(index) - time_s(index - 1);
        let pairs = points[index]
            .velocities
            .iter()
            .zip(&points[index - 1].velocities);
        let now: Vec<f64> = pairs
            .map(|(after, before)| (after - before) / step_s)
            .collect();
        most = now.iter().fold(most, |most, one| most.max(one.abs()));
        if let Some(before) = before.take() {
            let jerks = now
                .iter()
                .zip(&before)
                .map(|(now, before)| (now - before).abs() / step_s);
            most_jerk = jerks.fold(most_jerk, f64::max);
        }
        before = (!rests(index)).then_some(now);
    }
    (most, most_jerk)
}

/// Largest acceleration (rad/s^2) of a joint in what the arm does until a result is said.
async fn moved_until_result(bench: &mut Bench) -> (StepResult, f64) {
    let mut states: Vec<JointState> = Vec::new();
    let result = loop {
        tokio::select! {
            state = bench.joint_states.recv() => states.push(state),
            result = bench.results.recv() => break result,
        }
    };
    let time_s = |state: &JointState| {
        convert::time_from_msg(&state.header.stamp)
            .unwrap()
            .as_secs_f64()
    };
    let mut most = 0.0f64;
    for pair in states.windows(2) {
        let step_s = time_s(&pair[1]) - time_s(&pair[0]);
        if step_s <= 0.0 {
            continue;
        }
        for (after, before) in pair[1].velocity.iter().zip(&pair[0].velocity) {
            most = most.max((after - before).abs() / step_s);
        }
    }
    (result, most)
}

#[tokio::test(flavor = "multi_thread")]
async fn every_planned_motion_keeps_to_the_limits_of_the_joints_and_so_does_the_arm() {
    const ACCELERATION_RAD_S2: f64 = 0.5;
    const JERK_RAD_S3: f64 = 4.0;
    let limits = [
        (
            "joints.acceleration_rad_s2",
            ACCELERATION_RAD_S2.to_string(),
        ),
        ("joints.jerk_rad_s3", JERK_RAD_S3.to_string()),
    ];
    // Without limits as with them: the limits are what makes the difference.
    for (limits, keeps) in [(&[][..], false), (&limits[..], true)] {
        let (mut bench, ..) = proposed(&slow(), limits).await;
        let mut planned = bench
            .node
            .subscription::<PlannedMotion>("planned_motion", Qos::Latched)
            .unwrap();
        let of_proposal = within(
            "planned motion",
            newest(&mut planned, |m| m.proposal_id == 1),
        )
        .await;
        bench.decide(1, StepConfirmation::APPROVE);
        bench.until_moving().await;
        bench.until_passed(Duration::from_secs(1)).await;
        bench.decide(1, StepConfirmation::STOP);
        bench.ended(1, StepResult::STOPPED).await;
        let home = bench.propose_home().await;
        assert!(home.success, "{}", home.message);
        let of_home = newest(&mut planned, |m| m.proposal_id == home.proposal_id);
        let of_home = within("planned way home", of_home).await;
        while bench.joint_states.try_recv().is_some() {}
        bench.decide(home.proposal_id, StepConfirmation::APPROVE);
        let (result, moved) = within("way home", moved_until_result(&mut bench)).await;
        assert_eq!(result.outcome, StepResult::AT_HOME, "{}", result.reason);
        for (name, motion) in [("proposal", &of_proposal), ("way home", &of_home)] {
            let (most, most_jerk) = planned_peaks(motion);
            println!("{name}, limits {keeps}: {most:.2} rad/s^2, {most_jerk:.1} rad/s^3");
            assert_eq!(
                most <= ACCELERATION_RAD_S2 * 1.001,
                keeps,
                "{name}: {most} rad/s^2"
            );
            assert_eq!(
                most_jerk <= JERK_RAD_S3 * 1.001,
                keeps,
                "{name}: {most_jerk} rad/s^3"
            );
        }
        println!("limits {keeps}: the arm moved with up to {moved:.2} rad/s^2");
        // Between two points of a trajectory the controller's cubic is a little above the mean.
        assert_eq!(moved <= 1.2 * ACCELERATION_RAD_S2, keeps, "{moved} rad/s^2");
        bench.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_arm_is_planned_with_its_calibration() {
    // A UR5 whose joints sit as a factory leaves them.
    let calibration = "
kinematics:
  shoulder: {x: 0, y: 0, z: 0.0893, roll: 0, pitch: 0, yaw: 1.0e-05}
  upper_arm: {x: 0.0001, y: 0, z: 0, roll: 1.5713, pitch: 0, yaw: 1.1e-06}
  forearm: {x: -0.4252, y: 0, z: 0, roll: 0.0015, pitch: 0.0004, yaw: 0}
  wrist_1: {x: -0.3927, y: -0.0004, z: 0.1092, roll: 0.003, pitch: -0.0012, yaw: 0}
  wrist_2: {x: 0, y: -0.0947, z: 0, roll: 1.5708, pitch: 0, yaw: 0}
  wrist_3: {x: 0, y: 0.0824, z: 0, roll: 1.5717, pitch: 3.141592653589793, yaw: 3.141592653589793}
";
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("my_robot_calibration.yaml");
    std::fs::write(&path, calibration).unwrap();
    let nominal = WorkCell::builtin().unwrap();
    let calibrated = nominal.clone().with_calibration_file(&path).unwrap();
    let given = [("arm_calibration", path.display().to_string())];
    let (bench, ..) = proposed(&[], &given).await;
    let mut planned = bench
        .node
        .subscription::<PlannedMotion>("planned_motion", Qos::Latched)
        .unwrap();
    let motion = within(
        "planned motion",
        newest(&mut planned, |m| m.proposal_id == 1),
    )
    .await;
    // Where suction goes on the tip stands over the pick, turned by half of the turn.
    let pick = reference().demonstrate().unwrap().pick.translation.vector;
    let on = &motion.suction_on;
    let mut points = motion.trajectory.points.iter();
    let point = points.find(|point| point.time_from_start == *on).unwrap();
    let mut joints = ur5::Joints::zeros();
    joints.copy_from_slice(&point.positions);
    let off_m = |cell: &WorkCell| (cell.arm.tip(&joints).translation.vector.xy() - pick).norm();
    println!(
        "off by {:.6} m, by the drawing {:.6} m",
        off_m(&calibrated),
        off_m(&nominal)
    );
    assert!(off_m(&calibrated) < 1e-5, "{} m", off_m(&calibrated));
    assert!(off_m(&nominal) > 3e-4, "{} m", off_m(&nominal));
    bench.stop().await;
}
