//! Topics, services, actions, time, parameters, rosout and diagnostics over real DDS on loopback.

use std::{
    net::{IpAddr, Ipv4Addr},
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};

use msgs::{
    Action, Service,
    control_msgs::{FollowJointTrajectoryGoal, FollowJointTrajectoryResult},
    diagnostic_msgs::DiagnosticArray,
    rcl_interfaces::{
        Log, Parameter, ParameterType, ParameterValue, SetParameters, SetParametersRequest,
    },
    rosgraph_msgs::Clock,
    sensor_msgs::Image,
    std_msgs::{Float64, Header},
    ur_msgs::{SetIORequest, SetIOResponse},
};
use node_kit::{
    ActionServer, Active, AsBytes, CallOptions, Context, GoalStatus, LifecycleClient, Network,
    NoParameters, Node, Parameters, Publisher, Qos, Range, RawQos, RosArguments, State, Transition,
};
use rustdds::{DomainParticipantBuilder, QosPolicyBuilder, TopicKind, policy};
use serde::{Deserialize, Serialize};
use tokio::time::timeout;

type FollowJointTrajectory = msgs::control_msgs::FollowJointTrajectory;
type SetIO = msgs::ur_msgs::SetIO;

const LIMIT: Duration = Duration::from_secs(60);

fn node(context: &Context, name: &str, arguments: &str) -> Node {
    let words = arguments.split_whitespace().map(str::to_owned);
    let (arguments, _) = RosArguments::parse(words).expect("arguments");
    context
        .node::<NoParameters>(name, &arguments)
        .expect("node")
        .0
}

fn image(number: u32) -> Image {
    Image {
        header: Header {
            frame_id: "front".into(),
            ..Header::default()
        },
        height: 480,
        width: 640,
        encoding: "rgb8".into(),
        step: 1920,
        data: vec![number as u8; 480 * 1920].into(),
        ..Image::default()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_arrived_before_its_sender_ended_can_be_read_after_that() {
    let network = Network::unused().unwrap();
    let (sending, receiving) = (Context::new(network), Context::new(network));
    let sender = node(&sending, "sender", "");
    let receiver = node(&receiving, "receiver", "");
    let mut subscription = receiver
        .subscription::<Float64>("last_words", Qos::Event)
        .unwrap();
    let qos = RawQos {
        reliable: true,
        transient_local: false,
        depth: 10,
    };
    let publisher = sender
        .raw_publisher("last_words", "std_msgs/msg/Float64", qos)
        .unwrap();
    let heard = async {
        while receiver.graph().publishers("/last_words") == 0
            || sender.graph().subscriptions("/last_words") == 0
        {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(LIMIT, heard).await.expect("both know each other");
    publisher.publish(msgs::to_cdr(&Float64 { data: 7.0 }).unwrap());
    let published = tokio::task::spawn_blocking(move || {
        assert!(publisher.wait_until_heard(LIMIT));
    });
    published.await.unwrap();
    sender.stop();
    drop((sender, sending));
    let gone = async {
        while receiver.graph().publishers("/last_words") > 0 {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(LIMIT, gone).await.expect("the sender is gone");
    let received = timeout(LIMIT, subscription.recv()).await;
    assert_eq!(received.expect("last words").data, 7.0);
}

/// Names the domain of [`subscriber_until_it_is_killed`].
const DOMAIN: &str = "NODE_KIT_TEST_DOMAIN";

/// Run by the test below, as a process that can be killed.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "a part of the test below"]
async fn subscriber_until_it_is_killed() {
    let domain_id = std::env::var(DOMAIN).unwrap().parse().unwrap();
    let context = Context::new(Network {
        domain_id,
        localhost_only: true,
    });
    let node = node(&context, "killed", "");
    let mut subscription = node.subscription::<Float64>("state", Qos::Latched).unwrap();
    loop {
        subscription.recv().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_subscriber_that_was_killed_holds_back_no_latched_message() {
    let network = Network::unused().unwrap();
    let context = Context::new(network);
    let sender = node(&context, "sender", "");
    let receiver = node(&context, "receiver", "");
    let mut subscription = receiver
        .subscription::<Float64>("state", Qos::Latched)
        .unwrap();
    let publisher = sender.publisher::<Float64>("state", Qos::Latched).unwrap();
    let mut killed = std::process::Command::new(std::env::current_exe().unwrap())
        .args(["--ignored", "--exact", "subscriber_until_it_is_killed"])
        .env(DOMAIN, network.domain_id.to_string())
        .stdout(std::process::Stdio::null())
        .spawn()
        .unwrap();
    let heard = async {
        while sender.graph().subscriptions("/state") < 2 {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    let heard = timeout(LIMIT, heard).await;
    killed.kill().unwrap();
    killed.wait().unwrap();
    heard.expect("both subscribe");
    // Far fewer than come in the 50 s in which the killed one still counts as alive.
    for number in 0..40 {
        publisher.publish(Float64 {
            data: f64::from(number),
        });
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    let last = async { while subscription.recv().await.data < 39.0 {} };
    timeout(LIMIT, last).await.expect("the newest message");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_node_that_publishes_a_topic_keeps_no_more_of_what_it_receives_there() {
    const SENT: u32 = 1000;
    // A subscription's own limit, and what may arrive before the oldest are dropped.
    const KEPT: usize = 256 + 64;
    let network = Network::unused().unwrap();
    let (sending, receiving) = (Context::new(network), Context::new(network));
    let sender = node(&sending, "sender", "");
    let receiver = node(&receiving, "receiver", "");
    // A publisher may keep up to 4,096 messages of its own.
    let _publisher = receiver
        .publisher::<Float64>("readings", Qos::Event)
        .unwrap();
    let mut subscription = receiver
        .subscription::<Float64>("readings", Qos::Event)
        .unwrap();
    let qos = RawQos {
        reliable: true,
        transient_local: false,
        depth: SENT,
    };
    let publisher = sender
        .raw_publisher("readings", "std_msgs/msg/Float64", qos)
        .unwrap();
    let known = async {
        while receiver.graph().publishers("/readings") == 0
            || sender.graph().subscriptions("/readings") == 0
        {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(LIMIT, known).await.expect("both know each other");
    for number in 0..SENT {
        let reading = Float64 {
            data: f64::from(number),
        };
        publisher.publish(msgs::to_cdr(&reading).unwrap());
    }
    let published = tokio::task::spawn_blocking(move || {
        assert!(publisher.wait_until_heard(LIMIT));
    });
    published.await.unwrap();
    let kept: Vec<f64> = std::iter::from_fn(|| subscription.try_recv())
        .map(|reading| reading.data)
        .collect();
    assert_eq!(kept.last(), Some(&f64::from(SENT - 1)));
    assert!(kept.len() <= KEPT, "{} are kept", kept.len());
}

/// On a network whose datagrams hold 1400 bytes, as many tunnels and containers have, a message just below the size of a fragment
/// (1280 bytes) does not fit one with what goes before it.
#[tokio::test(flavor = "multi_thread")]
async fn a_message_of_every_size_around_that_of_a_fragment_arrives() {
    let network = Network {
        localhost_only: false,
        ..Network::unused().unwrap()
    };
    let (sending, receiving) = (Context::new(network), Context::new(network));
    let sender = node(&sending, "sender", "");
    let receiver = node(&receiving, "receiver", "");
    let publisher = sender.publisher::<Header>("names", Qos::Event).unwrap();
    let mut subscription = receiver
        .subscription::<Header>("names", Qos::Event)
        .unwrap();
    let known = async {
        while receiver.graph().publishers("/names") == 0
            || sender.graph().subscriptions("/names") == 0
        {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(LIMIT, known).await.expect("both know each other");
    for length in 1180..1300 {
        publisher.publish(Header {
            frame_id: "n".repeat(length),
            ..Header::default()
        });
        let received = timeout(Duration::from_secs(10), subscription.recv()).await;
        let received = received.unwrap_or_else(|_| panic!("a name of {length} bytes"));
        assert_eq!(received.frame_id.len(), length);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn images_arrive() {
    let context = Context::new(Network::unused().unwrap());
    let sender = node(&context, "sender", "");
    let receiver = node(&context, "receiver", "");
    let publisher = sender.publisher::<Image>("color", Qos::Image).unwrap();
    let mut subscription = receiver.subscription::<Image>("color", Qos::Image).unwrap();
    let sending = tokio::spawn(async move {
        for number in 0..1800 {
            publisher.publish(image(number));
            tokio::time::sleep(Duration::from_millis(33)).await;
        }
    });
    for _ in 0..5 {
        let image = timeout(LIMIT, subscription.recv()).await.expect("an image");
        assert_eq!(image.data.len(), 480 * 1920);
    }
    sending.abort();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_latched_message_reaches_a_late_joiner() {
    let context = Context::new(Network::unused().unwrap());
    let sender = node(&context, "sender", "");
    let receiver = node(&context, "receiver", "");
    let publisher = sender.publisher::<Header>("goal", Qos::Latched).unwrap();
    for frame_id in ["old", "new"] {
        publisher.publish(Header {
            frame_id: frame_id.into(),
            ..Header::default()
        });
    }
    // The second joiner is late: the first one has heard it before.
    for _ in 0..2 {
        let mut subscription = receiver
            .subscription::<Header>("goal", Qos::Latched)
            .unwrap();
        timeout(LIMIT, async {
            while subscription.recv().await.frame_id != "new" {}
        })
        .await
        .expect("the newest latched message");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_message_of_another_type_is_counted_and_the_next_one_is_read() {
    let context = Context::new(Network::unused().unwrap());
    let (sender, receiver) = (node(&context, "sender", ""), node(&context, "receiver", ""));
    // Another type on the same topic: its bytes cannot be an image.
    let wrong = sender.publisher::<Float64>("x", Qos::Event).unwrap();
    let right = sender.publisher::<Image>("x", Qos::Event).unwrap();
    let mut subscription = receiver.subscription::<Image>("x", Qos::Event).unwrap();
    assert!(sender.graph().wait_for_subscription("/x", LIMIT).await);
    let statistics = subscription.statistics().clone();
    let sending = tokio::spawn(async move {
        loop {
            wrong.publish(Float64 { data: 1e300 });
            right.publish(image(1));
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    });
    timeout(LIMIT, async {
        while statistics.snapshot().errors == 0 || statistics.snapshot().messages < 3 {
            subscription.recv().await;
        }
    })
    .await
    .expect("errors counted and images read");
    sending.abort();
}

#[tokio::test(flavor = "multi_thread")]
async fn services_answer_two_clients() {
    let context = Context::new(Network::unused().unwrap());
    let server = node(&context, "server", "");
    let service = server.service_server::<SetIO>("set_io").unwrap();
    let serving = server.spawn(service.serve(|request: SetIORequest| SetIOResponse {
        success: request.pin == 16,
    }));
    for client in [node(&context, "one", ""), node(&context, "two", "")] {
        let client = client.service_client::<SetIO>("set_io").unwrap();
        client.wait_for_server(LIMIT).await.unwrap();
        for pin in [16, 3, 16] {
            let request = SetIORequest {
                fun: 1,
                pin,
                state: 1.0,
            };
            let reply = client
                .call(&request, &CallOptions::default())
                .await
                .unwrap();
            assert_eq!(reply.success, pin == 16);
        }
    }
    drop(serving);
    assert_eq!(SetIO::NAME, "SetIO");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_new_subscription_gets_nothing_that_came_before_it() {
    let network = Network::unused().unwrap();
    let (speaking, hearing) = (Context::new(network), Context::new(network));
    let speaker = node(&speaking, "speaker", "");
    let hearer = node(&hearing, "hearer", "");
    let publisher = speaker
        .publisher::<Float64>("approvals", Qos::Event)
        .unwrap();
    let say = |data: f64| publisher.publish(Float64 { data });
    let subscribe = || {
        hearer
            .subscription::<Float64>("approvals", Qos::Event)
            .unwrap()
    };
    let other = hearer
        .subscription::<Float64>("approvals", Qos::Event)
        .unwrap();
    let mut first = subscribe();
    let graph = speaker.graph();
    assert!(graph.wait_for_subscription("/approvals", LIMIT).await);
    timeout(LIMIT, async {
        say(1.0);
        while first.recv().await.data != 1.0 {}
    })
    .await
    .unwrap();
    drop(first);
    let mut second = subscribe();
    // Both ends may still be discovering each other.
    let heard = timeout(LIMIT, async {
        loop {
            say(2.0);
            if let Ok(heard) = timeout(Duration::from_millis(200), second.recv()).await {
                return heard.data;
            }
        }
    });
    assert_eq!(heard.await.unwrap(), 2.0);
    drop(other);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_client_that_cannot_hear_answers_delays_no_other_client() {
    const UNHEARD: usize = 30;
    let network = Network::unused().unwrap();
    let (serving, calling) = (Context::new(network), Context::new(network));
    let server = node(&serving, "server", "");
    let service = server.service_server::<SetIO>("set_io").unwrap();
    let statistics = Arc::clone(service.statistics());
    let _serving = server.spawn(service.serve(|_| SetIOResponse { success: true }));
    let client = node(&calling, "client", "")
        .service_client::<SetIO>("set_io")
        .unwrap();
    client.wait_for_server(LIMIT).await.unwrap();
    client
        .call(&SetIORequest::default(), &CallOptions::default())
        .await
        .unwrap();
    // A writer of requests alone.
    let qos = QosPolicyBuilder::new()
        .reliable(rustdds::Duration::from_secs(1))
        .history(policy::History::KeepAll)
        .build();
    let participant = DomainParticipantBuilder::new(network.domain_id)
        .with_only_networks([IpAddr::V4(Ipv4Addr::LOCALHOST)])
        .build()
        .unwrap();
    let topic = participant
        .create_topic(
            "rq/set_ioRequest".into(),
            "ur_msgs::srv::dds_::SetIO_Request_".into(),
            &qos,
            TopicKind::NoKey,
        )
        .unwrap();
    let publisher = participant.create_publisher(&qos).unwrap();
    let writer = publisher
        .create_datawriter_no_key::<Vec<u8>, AsBytes>(&topic, Some(qos))
        .unwrap();
    let before = statistics.snapshot().messages;
    timeout(LIMIT, async {
        while statistics.snapshot().messages == before {
            writer.write(vec![0; 8], None).unwrap();
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    })
    .await
    .expect("requests arrive");
    for _ in 0..UNHEARD {
        writer.write(vec![0; 8], None).unwrap();
    }
    let one = CallOptions {
        attempts: 1,
        timeout: Duration::from_secs(5),
    };
    client.call(&SetIORequest::default(), &one).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_call_without_server_says_so() {
    let context = Context::new(Network::unused().unwrap());
    let client = node(&context, "client", "")
        .service_client::<SetIO>("set_io")
        .unwrap();
    let error = client
        .wait_for_server(Duration::from_millis(100))
        .await
        .unwrap_err();
    assert!(error.to_string().contains("/set_io: no server"), "{error}");
}

/// Goals of tolerance 1 succeed, of tolerance 2 are rejected, others run until cancelled.
async fn carry_out(mut server: ActionServer<FollowJointTrajectory>) {
    loop {
        let goal = server.recv().await;
        match goal.goal.goal_time_tolerance.sec {
            1 => {
                let (_, running) = goal.accept();
                running.succeed(FollowJointTrajectoryResult {
                    error_string: "done".into(),
                    ..Default::default()
                });
            }
            2 => goal.reject("tolerance 2"),
            _ => {
                let (_, running) = goal.accept();
                tokio::spawn(async move {
                    running.cancel_requested().await;
                    running.cancelled(FollowJointTrajectoryResult::default());
                });
            }
        }
    }
}

fn trajectory(kind: i32) -> FollowJointTrajectoryGoal {
    let mut goal = FollowJointTrajectoryGoal::default();
    goal.goal_time_tolerance.sec = kind;
    goal
}

#[tokio::test(flavor = "multi_thread")]
async fn a_goal_that_is_sent_once_gets_its_late_answer_and_repeats_are_counted_where_asked_for() {
    let context = Context::new(Network::unused().unwrap());
    let server_node = node(&context, "server", "");
    let mut server = server_node
        .action_server::<FollowJointTrajectory>("controller/follow")
        .unwrap();
    let repeats = server.count_repeats(false);
    let answering = tokio::spawn(async move {
        for _ in 0..2 {
            let goal = server.recv().await;
            tokio::time::sleep(Duration::from_millis(1500)).await;
            goal.accept()
                .1
                .succeed(FollowJointTrajectoryResult::default());
        }
        server
    });
    let client = node(&context, "client", "")
        .action_client::<FollowJointTrajectory>("controller/follow")
        .unwrap();
    client.wait_for_server(LIMIT).await.unwrap();
    let sent = timeout(LIMIT, client.send_goal_once(&trajectory(1))).await;
    let end = timeout(LIMIT, sent.unwrap().unwrap().result()).await;
    assert_eq!(end.unwrap().unwrap().0, GoalStatus::Succeeded);
    assert_eq!(*repeats.borrow(), 0);
    // One that repeats its goal meets a server that does not want that.
    let impatient = CallOptions {
        attempts: 3,
        timeout: Duration::from_millis(400),
    };
    let answer = timeout(LIMIT, client.send_goal(&trajectory(1), &impatient)).await;
    assert!(answer.unwrap().is_err());
    assert!(*repeats.borrow() >= 1);
    timeout(LIMIT, answering).await.unwrap().unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn actions_run_side_by_side_and_end_as_they_should() {
    let context = Context::new(Network::unused().unwrap());
    let server_node = node(&context, "server", "");
    let server = server_node
        .action_server::<FollowJointTrajectory>("controller/follow")
        .unwrap();
    server_node.spawn(carry_out(server));
    let options = CallOptions::default();
    for client_node in [node(&context, "one", ""), node(&context, "two", "")] {
        let client = client_node
            .action_client::<FollowJointTrajectory>("controller/follow")
            .unwrap();
        client.wait_for_server(LIMIT).await.unwrap();

        // Three at once: the long ones do not block the short one.
        let long = client.send_goal(&trajectory(3), &options).await.unwrap();
        let longer = client.send_goal(&trajectory(3), &options).await.unwrap();
        let short = client.send_goal(&trajectory(1), &options).await.unwrap();
        let (status, result) = timeout(LIMIT, short.result()).await.unwrap().unwrap();
        assert_eq!(status, GoalStatus::Succeeded);
        assert_eq!(result.error_string, "done");

        let (_, cancelled) = tokio::join!(
            async {
                tokio::time::sleep(Duration::from_millis(200)).await;
                long.cancel(&options).await.unwrap();
            },
            timeout(LIMIT, long.result())
        );
        assert_eq!(cancelled.unwrap().unwrap().0, GoalStatus::Canceled);
        longer.cancel(&options).await.unwrap();
        let (status, _) = timeout(LIMIT, longer.result()).await.unwrap().unwrap();
        assert_eq!(status, GoalStatus::Canceled);
        // A late request for a result still gets it.
        let (status, _) = timeout(LIMIT, short.result()).await.unwrap().unwrap();
        assert_eq!(status, GoalStatus::Succeeded);

        let Err(error) = client.send_goal(&trajectory(2), &options).await else {
            panic!("accepted");
        };
        assert!(error.to_string().contains("rejected"), "{error}");
    }
    assert_eq!(FollowJointTrajectory::NAME, "FollowJointTrajectory");
}

#[tokio::test(flavor = "multi_thread")]
async fn simulated_time_comes_from_the_clock_topic() {
    let context = Context::new(Network::unused().unwrap());
    let simulator = node(&context, "simulator", "");
    let follower = node(&context, "follower", "--ros-args -p use_sim_time:=true");
    let clock = simulator.publisher::<Clock>("/clock", Qos::Event).unwrap();
    assert_eq!(follower.clock().now_ns(), 0);
    timeout(LIMIT, async {
        while follower.clock().now_ns() != 12_500_000_000 {
            clock.publish(Clock {
                clock: node_kit::stamp_from_ns(12_500_000_000),
            });
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    })
    .await
    .expect("simulated time");
    assert!(!simulator.clock().is_simulated());
}

#[tokio::test(flavor = "multi_thread")]
async fn logs_reach_rosout_and_diagnostics_name_the_topics() {
    node_kit::logging::init(&[]).unwrap();
    let context = Context::new(Network::unused().unwrap());
    let speaker = node(&context, "speaker", "--ros-args -r __ns:=/cell -r a:=b");
    let listener = node(&context, "listener", "");
    let _topic = speaker.publisher::<Header>("a", Qos::Event).unwrap();
    let mut logs = listener.subscription::<Log>("/rosout", Qos::Event).unwrap();
    let mut diagnostics = listener
        .subscription::<DiagnosticArray>("/diagnostics", Qos::Event)
        .unwrap();
    let speaking = speaker.spawn(async {
        loop {
            tracing::warn!(step = 3, "hello");
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    });
    timeout(LIMIT, async {
        loop {
            let log = logs.recv().await;
            if log.name == "cell.speaker" && log.msg == "hello step=3" && log.level == Log::WARN {
                break;
            }
        }
    })
    .await
    .expect("the log");
    timeout(LIMIT, async {
        loop {
            let array = diagnostics.recv().await;
            let mine = array
                .status
                .iter()
                .find(|s| s.name == "/cell/speaker: topics");
            if mine.is_some_and(|s| s.values.iter().any(|value| value.key == "/cell/b")) {
                break;
            }
        }
    })
    .await
    .expect("diagnostics");
    speaking.abort();
}

#[tokio::test(flavor = "multi_thread")]
async fn endpoints_that_cannot_talk_are_named_in_diagnostics() {
    let context = Context::new(Network::unused().unwrap());
    let sender = node(&context, "sender", "");
    let receiver = node(&context, "receiver", "");
    let _best_effort = sender.publisher::<Header>("x", Qos::Image).unwrap();
    let _reliable = receiver.subscription::<Header>("x", Qos::Event).unwrap();
    let _volatile = sender.publisher::<Header>("y", Qos::Event).unwrap();
    let _latched = receiver.subscription::<Header>("y", Qos::Latched).unwrap();
    let _image = sender.publisher::<Image>("z", Qos::Event).unwrap();
    let _header = receiver.subscription::<Header>("z", Qos::Event).unwrap();
    let mut diagnostics = sender
        .subscription::<DiagnosticArray>("/diagnostics", Qos::Event)
        .unwrap();
    timeout(LIMIT, async {
        loop {
            let array = diagnostics.recv().await;
            let graph = array.status.iter().find(|s| s.name == "/receiver: graph");
            if graph.is_some_and(|s| s.level == 2 && s.values[0].value == "3") {
                break;
            }
        }
    })
    .await
    .expect("three conflicts");
}

/// Speaks while it is active; a `period_ms` of 13 cannot be configured, and 17 fails at work.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct SpeakerParameters {
    period_ms: u64,
    volume: f64,
}

impl Default for SpeakerParameters {
    fn default() -> Self {
        Self {
            period_ms: 20,
            volume: 0.5,
        }
    }
}

impl Parameters for SpeakerParameters {
    const DOCUMENTATION: &'static str =
        "speaker:\n  ros__parameters:\n    # How loud.\n    volume: 0.5\n";
    const RANGES: &'static [(&'static str, Range)] = &[("volume", Range::SHARE)];
    const CHANGEABLE: &'static [&'static str] = &["volume"];
}

struct Speaker {
    said: Publisher<Float64>,
    period: Duration,
}

/// What all speakers of this process have said; one test has them.
static SAID: AtomicUsize = AtomicUsize::new(0);

async fn configure(node: Node, parameters: SpeakerParameters) -> anyhow::Result<Speaker> {
    anyhow::ensure!(parameters.period_ms != 13, "13 brings bad luck");
    Ok(Speaker {
        said: node.publisher("said", Qos::Event)?,
        period: Duration::from_millis(parameters.period_ms),
    })
}

impl Active for Speaker {
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
        let parameters = node.parameters::<SpeakerParameters>();
        loop {
            tokio::time::sleep(self.period).await;
            anyhow::ensure!(self.period.as_millis() != 17, "17 fails");
            let data = parameters.borrow().volume;
            SAID.fetch_add(1, Ordering::SeqCst);
            self.said.publish(Float64 { data });
        }
    }
}

fn set(name: &str, value: ParameterValue) -> SetParametersRequest {
    SetParametersRequest {
        parameters: vec![Parameter {
            name: name.into(),
            value,
        }],
    }
}

fn integer(integer_value: i64) -> ParameterValue {
    ParameterValue {
        r#type: ParameterType::PARAMETER_INTEGER,
        integer_value,
        ..ParameterValue::default()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_node_is_led_through_its_life() {
    let network = Network::unused().unwrap();
    let context = Context::new(network);
    let (leader, other) = (node(&context, "leader", ""), Context::new(network));
    let words = "--ros-args -p autostart:=false -p period_ms:=13";
    let (arguments, _) = RosArguments::parse(words.split_whitespace().map(str::to_owned)).unwrap();
    let life = other.start("speaker", &arguments, configure).unwrap();
    let speaker = LifecycleClient::new(&leader, "/speaker").unwrap();
    speaker.wait(LIMIT).await.unwrap();
    let parameters = leader
        .service_client::<SetParameters>("/speaker/set_parameters")
        .unwrap();
    let mut said = leader.subscription::<Float64>("said", Qos::Event).unwrap();
    let lead = |transition, from, to| speaker.lead(transition, from, to, LIMIT);
    let ask = async |request| {
        let options = CallOptions::default();
        parameters
            .call(&request, &options)
            .await
            .unwrap()
            .results
            .remove(0)
    };

    // An active node speaks once a millisecond: it would have spoken between so many answers.
    let is_silent_since = async |said| {
        for _ in 0..50 {
            assert_eq!(speaker.state().await.unwrap(), Some(State::Inactive));
        }
        SAID.load(Ordering::SeqCst) == said
    };

    let refused = lead(Transition::Configure, State::Unconfigured, State::Inactive).await;
    let refused = refused.unwrap_err().to_string();
    assert_eq!(refused, "/speaker refuses to configure: it is unconfigured");
    assert!(ask(set("period_ms", integer(1))).await.successful);
    lead(Transition::Configure, State::Unconfigured, State::Inactive)
        .await
        .unwrap();
    let fixed = ask(set("period_ms", integer(30))).await;
    assert!(
        fixed.reason.contains("clean the node up"),
        "{}",
        fixed.reason
    );
    assert!(is_silent_since(0).await, "speaks while it is inactive");

    lead(Transition::Activate, State::Inactive, State::Active)
        .await
        .unwrap();
    assert_eq!(timeout(LIMIT, said.recv()).await.unwrap().data, 0.5);
    let louder = ParameterValue {
        r#type: ParameterType::PARAMETER_DOUBLE,
        double_value: 0.75,
        ..ParameterValue::default()
    };
    assert!(ask(set("volume", louder)).await.successful);
    timeout(LIMIT, async { while said.recv().await.data != 0.75 {} })
        .await
        .unwrap();
    lead(Transition::Deactivate, State::Active, State::Inactive)
        .await
        .unwrap();
    let before = SAID.load(Ordering::SeqCst);
    assert!(is_silent_since(before).await, "speaks while it is inactive");

    // What fails at work ends the node.
    lead(Transition::CleanUp, State::Inactive, State::Unconfigured)
        .await
        .unwrap();
    assert!(ask(set("period_ms", integer(17))).await.successful);
    lead(Transition::Configure, State::Unconfigured, State::Inactive)
        .await
        .unwrap();
    lead(Transition::Activate, State::Inactive, State::Active)
        .await
        .unwrap();
    let end = timeout(LIMIT, life).await.unwrap().unwrap();
    assert_eq!(end.unwrap_err().to_string(), "17 fails");
}
