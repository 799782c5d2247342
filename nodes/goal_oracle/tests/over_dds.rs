//! A demonstration bag walked through over real DDS on loopback.

use std::time::Duration;

use bags::{Demonstration, DemonstrationStep};
use heightmap::{Heightmap, Workspace};
use msgs::convert;
use msgs::diagnostic_msgs::{DiagnosticArray, DiagnosticStatus};
use msgs::sctn_msgs::{ConfirmationRefused, Goal, PickPlace, StepConfirmation, StepResult};
use nalgebra::Isometry2;
use node_kit::{Context, Network, NoParameters, ParameterSource, Qos, RosArguments, Subscription};
use pick_place::{Outcome, PrimitiveSettings};
use tokio::time::timeout;

const LIMIT: Duration = Duration::from_secs(60);

fn heightmap(height_m: f32) -> Heightmap {
    let mut heightmap = Heightmap::new(Workspace::RAVENS);
    heightmap.height_m.fill(height_m);
    heightmap
}

/// Two steps with a reward, and one without between them.
fn demonstration() -> Demonstration {
    let step = |height_m, delta_reward| DemonstrationStep {
        observation: heightmap(height_m),
        action: pick_place::PickPlace {
            pick: Isometry2::identity(),
            place: Isometry2::identity(),
        },
        settings: PrimitiveSettings {
            clearance_m: 0.1,
            lift_m: 0.1,
            travel_m_s: 0.5,
            carry_m_s: 0.25,
            descend_m_s: 0.05,
            acceleration_m_s2: 1.0,
        },
        module: "placing".into(),
        delta_reward,
        outcome: Outcome::Placed,
    };
    Demonstration {
        problem: "placing".into(),
        seed: 7,
        start_seed: 7,
        steps: vec![step(0.0, 0.5), step(0.01, 0.0), step(0.02, 0.5)],
        last: heightmap(0.03),
    }
}

async fn next_goal(
    goals: &mut Subscription<Goal>,
    step: u32,
    attempt: u32,
    complete: bool,
) -> Goal {
    timeout(LIMIT, async {
        loop {
            let goal = goals.recv().await;
            if (goal.step, goal.attempt, goal.complete) == (step, attempt, complete) {
                return goal;
            }
        }
    })
    .await
    .unwrap_or_else(|_| panic!("no goal of step {step}, attempt {attempt}, complete {complete}"))
}

fn result(id: u64, outcome: u8, sec: i32) -> StepResult {
    let mut result = StepResult {
        proposal_id: id,
        outcome,
        ..StepResult::default()
    };
    result.header.stamp.sec = sec;
    result
}

fn says(decision: u8, proposal_id: u64) -> StepConfirmation {
    StepConfirmation {
        proposal_id,
        decision,
        ..StepConfirmation::default()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn results_and_confirmations_walk_through_a_demonstration() {
    let directory = tempfile::tempdir().unwrap();
    let bag = directory.path().join("demonstration");
    demonstration().write(&bag).unwrap();
    let context = Context::new(Network::unused().unwrap());
    let (node, _) = context
        .node::<NoParameters>("others", &RosArguments::default())
        .unwrap();
    let proposals = node
        .publisher::<PickPlace>("pick_place", Qos::Latched)
        .unwrap();
    let results = node
        .publisher::<StepResult>("step_result", Qos::Event)
        .unwrap();
    let confirmations = node
        .publisher::<StepConfirmation>("step_confirmation", Qos::Event)
        .unwrap();
    let mut answers = node
        .subscription::<ConfirmationRefused>("confirmation_refused", Qos::Event)
        .unwrap();
    let mut goals = node.subscription::<Goal>("goal", Qos::Latched).unwrap();
    let mut diagnostics = node
        .subscription::<DiagnosticArray>("/diagnostics", Qos::Event)
        .unwrap();
    let arguments = RosArguments {
        parameters: vec![ParameterSource::Argument {
            node: None,
            name: "demonstration".into(),
            value: bag.display().to_string(),
        }],
        ..RosArguments::default()
    };
    let oracle = goal_oracle::start(&context, &arguments).unwrap();

    let first = next_goal(&mut goals, 1, 0, false).await;
    assert_eq!((first.step_count, first.problem.as_str()), (2, "placing"));
    assert_eq!(first.heightmap.height_m[0], 0.01);
    assert!(
        node.graph()
            .wait_for_subscription("/step_confirmation", LIMIT)
            .await
    );

    // An operator looks before speaking, and a motion takes its time: the proposal is there before its result.
    let mut proposed = 0;
    let mut propose = async |id, step, attempt| {
        proposals.publish(PickPlace {
            id,
            problem: "placing".into(),
            step,
            attempt,
            settings: convert::settings_to_msg(&PrimitiveSettings::RIGID),
            ..PickPlace::default()
        });
        proposed += 1;
        let text = format!("in messages={proposed} ");
        let has_read = |status: &DiagnosticStatus| {
            let values = status.values.iter();
            let mut values = values.filter(|value| value.key == "/pick_place");
            status.name == "/goal_oracle: topics"
                && values.any(|value| value.value.starts_with(&text))
        };
        let read = async { while !diagnostics.recv().await.status.iter().any(has_read) {} };
        timeout(LIMIT, read).await.expect("counters");
    };
    propose(11, 1, 0).await;
    results.publish(result(11, StepResult::REJECTED, 3));
    let again = next_goal(&mut goals, 1, 1, false).await;
    assert_eq!(again.header.stamp.sec, 0);

    propose(12, 1, 1).await;
    results.publish(result(12, StepResult::DROPPED, 4));
    confirmations.publish(says(StepConfirmation::RETRY, 12));
    let again = next_goal(&mut goals, 1, 2, false).await;
    assert_eq!(again.header.stamp.sec, 4);

    // The confirmation of before once more: refused, with the reason.
    confirmations.publish(says(StepConfirmation::ADVANCE, 12));
    let refusal = timeout(LIMIT, answers.recv()).await.expect("a refusal");
    assert_eq!(
        (refusal.proposal_id, refusal.reason),
        (12, ConfirmationRefused::STALE)
    );
    assert!(
        refusal.message.contains("earlier goal"),
        "{}",
        refusal.message
    );

    propose(13, 1, 2).await;
    results.publish(result(13, StepResult::PLACED, 5));
    confirmations.publish(says(StepConfirmation::ADVANCE, 13));
    let second = next_goal(&mut goals, 2, 0, false).await;
    assert_eq!(
        (second.header.stamp.sec, second.heightmap.height_m[0]),
        (5, 0.03)
    );

    propose(14, 2, 0).await;
    results.publish(result(14, StepResult::PLACED, 6));
    confirmations.publish(says(StepConfirmation::ADVANCE, 14));
    next_goal(&mut goals, 2, 0, true).await;
    context.shutdown();
    oracle.await.unwrap().unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn by_image_distance_what_is_seen_after_a_motion_says_which_goal_is_next() {
    let directory = tempfile::tempdir().unwrap();
    let bag = directory.path().join("demonstration");
    demonstration().write(&bag).unwrap();
    let context = Context::new(Network::unused().unwrap());
    let (node, _) = context
        .node::<NoParameters>("others", &RosArguments::default())
        .unwrap();
    let results = node
        .publisher::<StepResult>("step_result", Qos::Event)
        .unwrap();
    let heightmaps = node
        .publisher::<msgs::sctn_msgs::Heightmap>("heightmap", Qos::Latched)
        .unwrap();
    let mut goals = node.subscription::<Goal>("goal", Qos::Latched).unwrap();
    let parameter = |name: &str, value: String| ParameterSource::Argument {
        node: None,
        name: name.into(),
        value,
    };
    let arguments = RosArguments {
        parameters: vec![
            parameter("demonstration", bag.display().to_string()),
            parameter("goal_module", "image_distance".into()),
        ],
        ..RosArguments::default()
    };
    let oracle = goal_oracle::start(&context, &arguments).unwrap();
    let see = |height_m: f32, sec: i32| {
        let mut header = msgs::std_msgs::Header::default();
        header.stamp.sec = sec;
        header.frame_id = "world".into();
        let message = msgs::convert::heightmap_to_msg(heightmap(height_m), header, 3, 1.0);
        heightmaps.publish(message.unwrap());
    };
    next_goal(&mut goals, 1, 0, false).await;
    assert!(
        node.graph()
            .wait_for_subscription("/heightmap", LIMIT)
            .await
    );
    assert!(
        node.graph()
            .wait_for_subscription("/step_result", LIMIT)
            .await
    );

    // Seen before the motion's end, it does not count, though it shows the last goal.
    see(0.03, 4);
    results.publish(result(11, StepResult::PLACED, 5));
    // Most like the first observation: nothing is reached.
    see(0.002, 6);
    let again = next_goal(&mut goals, 1, 1, false).await;
    assert_eq!(again.header.stamp.sec, 5);
    // Here the heightmap comes before the result. It is most like the first goal, of height 0.01.
    see(0.012, 8);
    results.publish(result(12, StepResult::GRASP_FAILED, 7));
    let second = next_goal(&mut goals, 2, 0, false).await;
    assert_eq!(
        (second.header.stamp.sec, second.heightmap.height_m[0]),
        (7, 0.03)
    );
    results.publish(result(13, StepResult::PLACED, 9));
    see(0.029, 10);
    next_goal(&mut goals, 2, 0, true).await;
    context.shutdown();
    oracle.await.unwrap().unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn without_a_demonstration_the_node_refuses_to_start() {
    let context = Context::new(Network::unused().unwrap());
    let oracle = goal_oracle::start(&context, &RosArguments::default()).unwrap();
    let error = oracle.await.unwrap().unwrap_err().to_string();
    assert!(error.contains("demonstration"), "{error}");
}
