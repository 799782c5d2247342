//! Whatever arrives on any topic, service or action of the graph, the nodes live on and serve.

use anyhow::{Context as _, Result, ensure};
use msgs::sctn_msgs::{Goal, Heightmap, PickPlace, StepConfirmation, StepResult};
use msgs::std_msgs::Bool;
use msgs::ur_dashboard_msgs::{RobotMode, SafetyMode};
use msgs::ur_msgs::{SetIO, SetIORequest};
use node_kit::{
    AsBytes, CallOptions, Context, Network, NoParameters, Publisher, Qos, RosArguments,
    Subscription,
};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rustdds::discovery::SubscriptionBuiltinTopicData;
use rustdds::{
    DataWriterStatus, DomainParticipant, DomainParticipantBuilder, QosPolicies, QosPolicyBuilder,
    StatusEvented as _, TopicKind, policy,
};
use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

const SEED: &str = "10006";
const PATIENCE: Duration = Duration::from_secs(60);
const DURATION: Duration = Duration::from_secs(60);
/// Messages sent at a time, then a pause: 1 kHz, all to one reader.
const VOLLEY: usize = 200;
const PAUSE: Duration = Duration::from_millis(200);
/// More topics than these have readers.
const LEAST_READERS: usize = 40;
/// Nothing new for so long: discovery is over.
const QUIET: Duration = Duration::from_secs(1);
const POLL: Duration = Duration::from_millis(10);
/// More memory than this, beyond what a node needed before, is a leak.
const MOST_GROWTH_MB: u64 = 150;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// A node as a process, killed when the test ends, however it ends.
struct Running {
    name: &'static str,
    process: Child,
    log: PathBuf,
}

impl Running {
    fn start(
        name: &'static str,
        parameters: &[(&str, String)],
        environment: &BTreeMap<&str, String>,
        logs: &Path,
    ) -> Result<Self> {
        let log = logs.join(name);
        let file = std::fs::File::create(&log)?;
        let folder = Path::new(env!("CARGO_BIN_EXE_sctn")).parent();
        let program = folder.context("folder of the program")?.join(name);
        let mut command = Command::new(&program);
        command.args(["--ros-args", "-p", "use_sim_time:=true"]);
        for (name, value) in parameters {
            command.arg("-p").arg(format!("{name}:={value}"));
        }
        let process = command
            .envs(environment)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(file)
            .spawn()
            .with_context(|| format!("{}: build the workspace first", program.display()))?;
        Ok(Self { name, process, log })
    }

    fn memory_mb(&self) -> Result<u64> {
        let path = format!("/proc/{}/status", self.process.id());
        let status = std::fs::read_to_string(path)?;
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
        let text = line.context("no VmRSS")?.trim().trim_end_matches(" kB");
        Ok(text.parse::<u64>()? / 1024)
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
        let log = std::fs::read(&self.log).unwrap_or_default();
        let log = String::from_utf8_lossy(&log);
        // What it says of single strings is long and tells nothing.
        let lines = log.lines().filter(|line| !line.contains("deserialize_str"));
        let lines: Vec<_> = lines.collect();
        for line in lines.iter().skip(lines.len().saturating_sub(6)) {
            println!("{}: {line}", self.name);
        }
    }
}

/// The policies that a reader asks for, with little room.
fn offer(asked: &QosPolicies) -> QosPolicies {
    let builder = QosPolicyBuilder::new()
        .durability(asked.durability().unwrap_or(policy::Durability::Volatile))
        .history(policy::History::KeepLast { depth: 8 })
        .resource_limits(policy::ResourceLimits {
            max_samples: 64,
            max_instances: 1,
            max_samples_per_instance: 64,
        });
    let builder = match asked.reliability() {
        Some(policy::Reliability::Reliable { .. }) => {
            builder.reliable(rustdds::Duration::from_millis(1))
        }
        _ => builder.best_effort(),
    };
    builder.build()
}

/// No message of any type, or one with nonsense in it.
fn garbage(random: &mut ChaCha8Rng) -> Vec<u8> {
    let length = match random.random_range(0..20) {
        0 => 0,
        1 => random.random_range(60_000..400_000),
        2..8 => random.random_range(1..16),
        _ => random.random_range(16..1_500),
    };
    let mut bytes = vec![0; length];
    match random.random_range(0..6) {
        // Zeros are an empty message of most types.
        0 => {}
        // The longest strings and sequences.
        1 => bytes.fill(0xff),
        2 => bytes
            .chunks_exact_mut(8)
            .for_each(|chunk| chunk.copy_from_slice(&f64::NAN.to_le_bytes())),
        // Sequences of a few gigabytes, a length that a 32-bit sum takes for small.
        3 => bytes
            .chunks_exact_mut(4)
            .for_each(|chunk| chunk.copy_from_slice(&0x7fff_fff0_u32.to_le_bytes())),
        // Short sequences of short sequences.
        4 => bytes
            .chunks_exact_mut(4)
            .for_each(|chunk| chunk.copy_from_slice(&random.random_range(0..4_u32).to_le_bytes())),
        _ => random.fill_bytes(&mut bytes),
    }
    bytes
}

/// A reader of each topic of the graph, once none has been new for some time: nothing says that all are discovered.
fn discovered(
    participant: &DomainParticipant,
) -> Result<BTreeMap<String, SubscriptionBuiltinTopicData>> {
    let readers = || -> BTreeMap<_, _> {
        let readers = participant.discovered_readers().into_iter();
        readers
            .map(|reader| reader.subscription_topic_data)
            .filter(|reader| !reader.topic_name().starts_with("DCPS"))
            .map(|reader| (reader.topic_name().clone(), reader))
            .collect()
    };
    let begin = Instant::now();
    let (mut known, mut since) = (readers(), begin);
    while known.len() <= LEAST_READERS || since.elapsed() < QUIET {
        ensure!(begin.elapsed() < PATIENCE, "{} readers", known.len());
        std::thread::sleep(POLL);
        let found = readers();
        if found.len() != known.len() {
            (known, since) = (found, Instant::now());
        }
    }
    Ok(known)
}

/// Sends garbage to every reader of the graph in turn; how many messages to how many readers.
fn attack(
    network: Network,
    duration: Duration,
    mut check: impl FnMut() -> Result<()>,
) -> Result<(usize, usize)> {
    let participant = DomainParticipantBuilder::new(network.domain_id)
        .with_only_networks([IpAddr::V4(Ipv4Addr::LOCALHOST)])
        .build()
        .map_err(|error| anyhow::anyhow!("{error:?}"))?;
    let readers = discovered(&participant)?;
    let mut writers = Vec::new();
    for (name, reader) in &readers {
        let qos = offer(&reader.qos());
        let made = participant
            .create_topic(
                name.clone(),
                reader.type_name().clone(),
                &qos,
                TopicKind::NoKey,
            )
            .and_then(|topic| Ok((participant.create_publisher(&qos)?, topic)))
            .and_then(|(publisher, topic)| {
                publisher.create_datawriter_no_key::<Vec<u8>, AsBytes>(&topic, Some(qos.clone()))
            });
        writers.push(made.map_err(|error| anyhow::anyhow!("{name}: {error:?}"))?);
    }
    let end = Instant::now() + PATIENCE;
    for (writer, topic) in writers.iter().zip(readers.keys()) {
        while !writer
            .try_recv_status()
            .is_some_and(|status| matches!(status, DataWriterStatus::PublicationMatched { .. }))
        {
            ensure!(Instant::now() < end, "no reader of {topic} is matched");
            std::thread::sleep(POLL);
        }
    }
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut sent = 0;
    let end = Instant::now() + duration;
    while Instant::now() < end {
        for writer in &writers {
            for _ in 0..VOLLEY {
                // A reader that does not keep up is no failure: the nodes may be slow, not dead.
                sent += usize::from(writer.write(garbage(&mut random), None).is_ok());
            }
            std::thread::sleep(PAUSE);
            check()?;
        }
    }
    Ok((sent, readers.len()))
}

async fn within<T>(what: &str, future: impl Future<Output = T>) -> Result<T> {
    let limited = tokio::time::timeout(PATIENCE, future);
    limited.await.with_context(|| format!("no {what}"))
}

/// The newest proposal for a step and attempt.
async fn proposal(
    proposals: &mut Subscription<PickPlace>,
    step: u32,
    attempt: u32,
) -> Result<PickPlace> {
    within("proposal", async {
        loop {
            let proposal = proposals.recv().await;
            if (proposal.step, proposal.attempt) == (step, attempt) {
                return proposal;
            }
        }
    })
    .await
}

/// The result of a proposal.
async fn result(results: &mut Subscription<StepResult>, id: u64) -> Result<StepResult> {
    within("result", async {
        loop {
            let result = results.recv().await;
            if result.proposal_id == id {
                return result;
            }
        }
    })
    .await
}

fn decide(confirmations: &Publisher<StepConfirmation>, proposal_id: u64, decision: u8) {
    confirmations.publish(StepConfirmation {
        proposal_id,
        decision,
        operator_name: "test".into(),
        ..Default::default()
    });
}

#[tokio::test(flavor = "multi_thread")]
async fn hostile_traffic_on_every_topic_and_service_ends_no_node() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let shown = Command::new(env!("CARGO_BIN_EXE_sctn"))
        .args([
            "demos",
            "--problem",
            "placing",
            "--episodes",
            "1",
            "--seed",
            SEED,
            "--out",
        ])
        .arg(folder.path())
        .status()?;
    ensure!(shown.success());
    let demonstration = folder.path().join("placing").join(format!("{SEED:0>6}"));
    let network = Network::unused()?;
    let environment = BTreeMap::from([
        ("ROS_DOMAIN_ID", network.domain_id.to_string()),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST".to_owned()),
    ]);
    let path = |path: &str| root().join(path).display().to_string();
    let urdf = ("urdf", path("urdf/workcell.urdf"));
    let sim = [
        ("problem", "placing".to_owned()),
        ("seed", SEED.to_owned()),
        ("problems_dir", path("config/problems")),
        urdf.clone(),
    ];
    let oracle = [("demonstration", demonstration.display().to_string())];
    let policy = [(
        "checkpoint",
        path("config/checkpoints/ten_problems.safetensors"),
    )];
    let given: [(_, &[(&str, String)]); 5] = [
        ("sim_workcell", &sim),
        ("camera_fusion", &[]),
        ("goal_oracle", &oracle),
        ("gctn_policy", &policy),
        ("suction_executor", &[urdf]),
    ];

    let context = Context::new(network);
    let (node, _) = context.node::<NoParameters>("tester", &RosArguments::default())?;
    let mut goals = node.subscription::<Goal>("goal", Qos::Latched)?;
    let mut proposals = node.subscription::<PickPlace>("pick_place", Qos::Latched)?;
    let mut heightmaps = node.subscription::<Heightmap>("heightmap", Qos::Latched)?;
    let mut results = node.subscription::<StepResult>("step_result", Qos::Event)?;
    let confirmations = node.publisher::<StepConfirmation>("step_confirmation", Qos::Event)?;
    let substitute_proposals = node.publisher::<PickPlace>("pick_place", Qos::Latched)?;
    let driver = |topic: &str| format!("io_and_status_controller/{topic}");
    let robot_mode = node.publisher::<RobotMode>(&driver("robot_mode"), Qos::Latched)?;
    let safety_mode = node.publisher::<SafetyMode>(&driver("safety_mode"), Qos::Latched)?;
    let running = node.publisher::<Bool>(&driver("robot_program_running"), Qos::Latched)?;
    let nodes = given
        .map(|(name, parameters)| Running::start(name, parameters, &environment, folder.path()));
    let mut nodes: Vec<_> = nodes.into_iter().collect::<Result<_>>()?;
    within("goal", goals.recv()).await?;
    let first = proposal(&mut proposals, 1, 0).await?;
    let (seen, view) = tokio::sync::watch::channel(first.header.clone());
    node.spawn(async move {
        loop {
            let header = heightmaps.recv().await.header;
            if header.frame_id == "world" {
                seen.send_replace(header);
            }
        }
    });

    let attacked = tokio::task::spawn_blocking(move || {
        let before: Vec<_> = nodes
            .iter()
            .map(Running::memory_mb)
            .collect::<Result<_>>()?;
        let mut most = before.clone();
        let counts = attack(network, DURATION, || {
            for (node, most) in nodes.iter_mut().zip(&mut most) {
                let ended = node.process.try_wait()?;
                ensure!(ended.is_none(), "{} ended: {ended:?}", node.name);
                *most = node.memory_mb()?.max(*most);
            }
            Ok(())
        });
        let (sent, readers) = counts?;
        println!("{sent} messages to {readers} readers");
        for ((node, before), most) in nodes.iter().zip(before).zip(most) {
            println!("{}: {before} MB, then at most {most} MB", node.name);
            ensure!(
                most < before + MOST_GROWTH_MB,
                "{} grows to {most} MB",
                node.name
            );
        }
        ensure!(
            sent > 1_000 && readers > LEAST_READERS,
            "{sent} messages to {readers} readers"
        );
        Ok(nodes)
    });
    let _nodes = attacked.await??;

    let set_io = node.service_client::<SetIO>(&driver("set_io"))?;
    let voltage = SetIORequest {
        fun: SetIORequest::FUN_SET_TOOL_VOLTAGE,
        pin: 0,
        state: 24.0,
    };
    let options = CallOptions {
        attempts: PATIENCE.as_secs() as u32,
        ..CallOptions::default()
    };
    // Garbage that can be read was the driver's state, the tool's voltage, a call of `propose_home` and a proposal in the place of
    // the one that was there. What is true is said again, and the run goes on from where it was; topics are
    // not ordered among each other, so that it may have to be said more than once.
    let mut id = first.id;
    let mut outcome = StepResult::REFUSED;
    for _ in 0..10 {
        robot_mode.publish(RobotMode {
            mode: RobotMode::RUNNING,
        });
        safety_mode.publish(SafetyMode {
            mode: SafetyMode::NORMAL,
        });
        running.publish(Bool { data: true });
        let answer = within("tool voltage", set_io.call(&voltage, &options)).await??;
        ensure!(answer.success, "the driver refuses the tool's voltage");
        tokio::time::sleep(Duration::from_secs(1)).await;
        id = id.wrapping_add(1);
        substitute_proposals.publish(PickPlace {
            id,
            header: view.borrow().clone(),
            ..first.clone()
        });
        decide(&confirmations, id, StepConfirmation::APPROVE);
        let answer = result(&mut results, id).await?;
        println!("approval: outcome {} {}", answer.outcome, answer.reason);
        outcome = answer.outcome;
        if outcome != StepResult::REFUSED {
            break;
        }
    }
    ensure!(outcome == StepResult::PLACED, "outcome {outcome}");
    decide(&confirmations, id, StepConfirmation::ADVANCE);
    proposal(&mut proposals, 2, 0).await?;
    Ok(())
}
