//! A small network over real DDS on loopback: heightmaps and goals in, proposals out.

use std::time::{Duration, Instant};

use gctn::{Compact, ModelCard, Network, NetworkConfig, Storage, Trainer, TrainingConfig};
use heightmap::Workspace;
use msgs::{
    convert,
    diagnostic_msgs::DiagnosticArray,
    sctn_msgs::{
        Goal, Heightmap, LoadCheckpoint, LoadCheckpointRequest, PickPlace, PrimitiveSettings,
        StepConfirmation, StepResult,
    },
    sensor_msgs::{Image, JointState},
};
use node_kit::{
    CallOptions, Context, Network as DdsNetwork, NoParameters, ParameterSource, Qos, RosArguments,
    Subscription,
};
use tokio::time::timeout;
use ur5::{Joints, WorkCell};

const LIMIT: Duration = Duration::from_secs(60);
const CELLS: usize = 32;

fn network() -> NetworkConfig {
    NetworkConfig {
        rows: CELLS,
        cols: CELLS,
        ..NetworkConfig::new(Network::Compact(Compact {
            channels: [4, 4, 8, 8],
            window_cells: 5,
            ..Compact::default()
        }))
    }
}

/// A scene with a box of 5 x 8 cells; another `salt` is a box elsewhere.
fn heightmap(cells: usize, stamp_s: u64, salt: usize) -> Heightmap {
    let workspace = Workspace {
        rows: cells,
        cols: cells,
        ..Workspace::RAVENS
    };
    let mut heightmap = heightmap::Heightmap::new(workspace);
    for (index, byte) in heightmap.rgb.iter_mut().enumerate() {
        *byte = (index * (2 * salt + 3) % 251) as u8;
    }
    for (index, height_m) in heightmap.height_m.iter_mut().enumerate() {
        let (row, col) = (index / cells, index % cells);
        let is_box = (4..12).contains(&row) && (5 * salt..5 * salt + 5).contains(&col);
        *height_m = if is_box { 0.03 } else { 0.0 };
    }
    let header = convert::header(Duration::from_secs(stamp_s), "world").unwrap();
    convert::heightmap_to_msg(heightmap, header, 3, 1.0).unwrap()
}

fn goal(attempt: u32) -> Goal {
    Goal {
        header: convert::header(Duration::from_secs(1), "world").unwrap(),
        problem: "placing".into(),
        demonstration: "placing/7".into(),
        step: 1,
        step_count: 9,
        attempt,
        settings: PrimitiveSettings {
            clearance_m: 0.1,
            lift_m: 0.1,
            travel_m_s: 0.5,
            carry_m_s: 0.25,
            descend_m_s: 0.05,
            acceleration_m_s2: 1.0,
        },
        heightmap: heightmap(CELLS, 0, 5),
        ..Goal::default()
    }
}

/// The checkpoint of a small network.
fn untrained(directory: &tempfile::TempDir) -> std::path::PathBuf {
    let checkpoint = directory.path().join("small.safetensors");
    Trainer::new(&network(), &TrainingConfig::compact())
        .unwrap()
        .save_checkpoint(&checkpoint, Storage::F32, &ModelCard::new())
        .unwrap();
    checkpoint
}

async fn next(proposals: &mut Subscription<PickPlace>) -> PickPlace {
    timeout(LIMIT, proposals.recv()).await.expect("a proposal")
}

/// Waits until the policy has read so many messages of each of these topics, as it says once a second, and has said it once more: what it had to
/// propose for them is there then.
async fn read_by_policy(diagnostics: &mut Subscription<DiagnosticArray>, topics: &[(&str, u64)]) {
    for _ in 0..2 {
        let has_read = async {
            loop {
                let array = diagnostics.recv().await;
                let mut statuses = array.status.iter();
                let counters = statuses.find(|status| status.name == "/gctn_policy: topics");
                let has_read = |(topic, messages): &(&str, u64)| {
                    let text = format!("in messages={messages} ");
                    let mut values = counters.into_iter().flat_map(|status| &status.values);
                    values.any(|value| value.key == *topic && value.value.starts_with(&text))
                };
                if topics.iter().all(has_read) {
                    return;
                }
            }
        };
        timeout(LIMIT, has_read).await.expect("counters");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn proposals_follow_goals_rejections_and_changed_scenes() {
    let directory = tempfile::tempdir().unwrap();
    let checkpoint = untrained(&directory);
    let context = Context::new(DdsNetwork::unused().unwrap());
    let (node, _) = context
        .node::<NoParameters>("others", &RosArguments::default())
        .unwrap();
    let heightmaps = node
        .publisher::<Heightmap>("heightmap", Qos::Latched)
        .unwrap();
    let goals = node.publisher::<Goal>("goal", Qos::Latched).unwrap();
    let confirmations = node
        .publisher::<StepConfirmation>("step_confirmation", Qos::Event)
        .unwrap();
    let results = node
        .publisher::<StepResult>("step_result", Qos::Event)
        .unwrap();
    let mut proposals = node
        .subscription::<PickPlace>("pick_place", Qos::Latched)
        .unwrap();
    let mut scores = node
        .subscription::<Image>("pick_place/scores", Qos::Latched)
        .unwrap();
    let mut diagnostics = node
        .subscription::<DiagnosticArray>("/diagnostics", Qos::Event)
        .unwrap();
    let arguments = RosArguments {
        parameters: vec![ParameterSource::Argument {
            node: None,
            name: "checkpoint".into(),
            value: checkpoint.display().to_string(),
        }],
        ..RosArguments::default()
    };
    let policy = gctn_policy::start(&context, &arguments).unwrap();

    // Of another size: no proposal, and the node lives on.
    goals.publish(goal(0));
    heightmaps.publish(heightmap(CELLS / 2, 1, 0));
    read_by_policy(&mut diagnostics, &[("/goal", 1), ("/heightmap", 1)]).await;
    assert_eq!(proposals.try_recv(), None);

    heightmaps.publish(heightmap(CELLS, 2, 0));
    let first = next(&mut proposals).await;
    assert_eq!(
        (first.step, first.attempt, first.header.stamp.sec),
        (1, 0, 2)
    );
    assert_eq!(first.settings, goal(0).settings);
    let image = timeout(LIMIT, scores.recv()).await.expect("score image");
    assert_eq!(image.width as usize, 2 * CELLS);

    // Rejected: the same goal again, a further attempt, another pick.
    goals.publish(goal(1));
    let second = next(&mut proposals).await;
    assert_eq!(
        (second.step, second.attempt, second.header.stamp.sec),
        (1, 1, 2)
    );
    let distance = (first.pick.x - second.pick.x).hypot(first.pick.y - second.pick.y);
    assert!(distance > 0.02, "{distance}");

    // A changed scene supersedes it; the time is all but the small network's.
    let start = Instant::now();
    heightmaps.publish(heightmap(CELLS, 3, 1));
    let third = next(&mut proposals).await;
    println!(
        "heightmap to proposal: {:.1} ms",
        start.elapsed().as_secs_f64() * 1e3
    );
    assert_ne!(third.id, second.id);

    // Another checkpoint, while the node is at work; one that is none changes nothing.
    let load = node
        .service_client::<LoadCheckpoint>("gctn_policy/load_checkpoint")
        .unwrap();
    let other = directory.path().join("other.safetensors");
    let ask = async |id: &str, path: &std::path::Path| {
        let request = LoadCheckpointRequest {
            request_id: id.into(),
            path: path.display().to_string(),
        };
        load.call(&request, &CallOptions::default()).await.unwrap()
    };
    let refused = ask("none", &other).await;
    assert!(
        !refused.success && refused.message.contains("other"),
        "{refused:?}"
    );
    assert_eq!(refused.path, checkpoint.display().to_string());
    std::fs::copy(&checkpoint, &other).unwrap();
    let used = ask("another", &other).await;
    assert!(used.success, "{used:?}");
    assert_eq!(
        (used.path, used.previous),
        (other.display().to_string(), refused.path)
    );
    assert_eq!(third.checkpoint, "small");
    heightmaps.publish(heightmap(CELLS, 4, 3));
    let third = next(&mut proposals).await;
    assert_eq!(third.checkpoint, "other");

    // Approved and moved: what is seen then makes no proposal.
    confirmations.publish(StepConfirmation {
        proposal_id: third.id,
        decision: StepConfirmation::APPROVE,
        ..StepConfirmation::default()
    });
    results.publish(StepResult {
        proposal_id: third.id,
        outcome: StepResult::PLACED,
        ..StepResult::default()
    });
    let read = [("/step_confirmation", 1), ("/step_result", 1)];
    read_by_policy(&mut diagnostics, &read).await;
    heightmaps.publish(heightmap(CELLS, 5, 2));
    read_by_policy(&mut diagnostics, &[("/heightmap", 5)]).await;
    assert_eq!(proposals.try_recv(), None);
    context.shutdown();
    policy.await.unwrap().unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn without_a_checkpoint_the_node_refuses_to_start() {
    let context = Context::new(DdsNetwork::unused().unwrap());
    let policy = gctn_policy::start(&context, &RosArguments::default()).unwrap();
    let error = policy.await.unwrap().unwrap_err().to_string();
    assert!(error.contains("checkpoint"), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_device_that_cannot_be_used_keeps_the_node_from_starting() {
    let directory = tempfile::tempdir().unwrap();
    let checkpoint = untrained(&directory).display().to_string();
    for (device, expected) in [
        ("gpu", "device is gpu, expected cpu, cuda or cuda:N"),
        ("cuda:99", "device cuda:99 cannot be used"),
    ] {
        let argument = |name: &str, value: &str| ParameterSource::Argument {
            node: None,
            name: name.into(),
            value: value.into(),
        };
        let arguments = RosArguments {
            parameters: vec![
                argument("checkpoint", &checkpoint),
                argument("device", device),
            ],
            ..RosArguments::default()
        };
        let context = Context::new(DdsNetwork::unused().unwrap());
        let policy = gctn_policy::start(&context, &arguments);
        let error = match policy {
            Ok(policy) => format!("{:#}", policy.await.unwrap().unwrap_err()),
            Err(error) => format!("{error:#}"),
        };
        assert!(error.contains(expected), "{error}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_heightmap_that_may_show_the_arm_makes_no_proposal() {
    let directory = tempfile::tempdir().unwrap();
    let checkpoint = untrained(&directory);
    let context = Context::new(DdsNetwork::unused().unwrap());
    let (node, _) = context
        .node::<NoParameters>("others", &RosArguments::default())
        .unwrap();
    let heightmaps = node
        .publisher::<Heightmap>("heightmap", Qos::Latched)
        .unwrap();
    let goals = node.publisher::<Goal>("goal", Qos::Latched).unwrap();
    let joint_states = node
        .publisher::<JointState>("joint_states", Qos::Event)
        .unwrap();
    let mut proposals = node
        .subscription::<PickPlace>("pick_place", Qos::Latched)
        .unwrap();
    let mut diagnostics = node
        .subscription::<DiagnosticArray>("/diagnostics", Qos::Event)
        .unwrap();
    let line = [
        "--ros-args",
        "-p",
        &format!("checkpoint:={}", checkpoint.display()),
        "-p",
        "observation_needs_home:=true",
    ];
    let arguments = RosArguments::parse(line.map(String::from)).unwrap().0;
    let policy = gctn_policy::start(&context, &arguments).unwrap();
    let graph = node.graph();
    assert!(
        graph
            .wait_for_subscription(joint_states.topic(), LIMIT)
            .await
    );
    goals.publish(goal(0));
    let cell = WorkCell::builtin().unwrap();
    let arm = |stamp_s, offset_rad| {
        joint_states.publish(convert::joint_state_to_msg(
            convert::header(Duration::from_secs(stamp_s), "").unwrap(),
            &cell.joint_names,
            &cell.arm.home.add_scalar(offset_rad),
            &Joints::zeros(),
        ));
    };
    // Nobody knows where the arm is; it rests elsewhere; it came home after the heightmap was taken.
    let cases = [(2, None), (4, Some((3, 0.3))), (5, Some((6, 0.0)))];
    for (case, (stamp_s, reading)) in (0..).zip(cases) {
        if let Some((stamp_s, offset_rad)) = reading {
            arm(stamp_s, offset_rad);
            read_by_policy(&mut diagnostics, &[("/joint_states", case)]).await;
        }
        heightmaps.publish(heightmap(CELLS, stamp_s, 0));
        read_by_policy(&mut diagnostics, &[("/heightmap", case + 1)]).await;
        assert_eq!(proposals.try_recv(), None);
    }
    heightmaps.publish(heightmap(CELLS, 7, 0));
    assert_eq!(next(&mut proposals).await.header.stamp.sec, 7);
    context.shutdown();
    policy.await.unwrap().unwrap();
}
