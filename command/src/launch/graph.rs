//! Starts the nodes: in this process, or as processes of their own.

use super::operator::RequireApproval;
use crate::root::Root;
use anyhow::{Context as _, Result, bail};
use gctn::Device;
use node_kit::{Context, LifecycleClient, LifecycleError, Node, RosArguments, State, Transition};
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::time::Duration;
use tokio::process::{Child, Command};
use tokio::task::JoinHandle;

/// The nodes, and the parameters of each beside its file in config/.
pub struct Settings {
    pub problem: String,
    /// Folder of the problem's file.
    pub problems_dir: PathBuf,
    pub seed: u64,
    /// Without one, the oracle waits for one that is taught.
    pub demonstration: Option<PathBuf>,
    pub checkpoint: PathBuf,
    /// Where the policy computes.
    pub device: Device,
    /// What says which goal is next, as goal_oracle names it.
    pub goal_module: String,
    /// Checkpoint for the goal module of that name.
    pub embedding: PathBuf,
    /// Whether, with the oracle, nothing advances without an operator's decision.
    pub operated: bool,
    /// Which proposals move only with an approval.
    pub require_approval: RequireApproval,
    /// With `unsure`, the probability of success from which a proposal moves unasked.
    pub sure_probability: f32,
    /// Whether nothing moves while no operator is present.
    pub require_presence: bool,
    /// The operator's console, where there is one.
    pub console: Option<Console>,
}

/// Parameters of the operator's console.
pub struct Console {
    /// File that it writes the address of its page to.
    pub address_file: PathBuf,
    /// Folder of the demonstrations that can be repeated.
    pub library: PathBuf,
    /// This command, by which it trains.
    pub program: PathBuf,
    /// Folder of what is trained.
    pub training: PathBuf,
}

/// In the order in which they go to work: the first goal comes when all others are there.
pub const NODES: [&str; 6] = [
    "operator_console",
    "sim_workcell",
    "camera_fusion",
    "gctn_policy",
    "suction_executor",
    "goal_oracle",
];

/// How long a node may take to appear, and for each transition: the policy loads its network.
const BRING_UP: Duration = Duration::from_secs(30);

impl Settings {
    /// Those of [`NODES`] that are launched.
    fn nodes(&self) -> impl Iterator<Item = &'static str> {
        let console = self.console.is_some();
        NODES
            .into_iter()
            .filter(move |node| console || *node != "operator_console")
    }

    /// Nodes that hear what an operator says.
    pub fn listeners(&self) -> usize {
        // Policy, executor and oracle.
        3 + usize::from(self.console.is_some())
    }

    fn parameters(&self, root: &Root, node: &str) -> Vec<(&'static str, String)> {
        let path = |path: &Path| path.display().to_string();
        match node {
            "sim_workcell" => vec![
                ("problem", self.problem.clone()),
                ("seed", self.seed.to_string()),
                ("problems_dir", path(&self.problems_dir)),
                ("urdf", path(&root.join("urdf/workcell.urdf"))),
            ],
            "goal_oracle" => vec![
                ("start_empty", self.demonstration.is_none().to_string()),
                ("goal_module", self.goal_module.clone()),
                ("embedding", path(&self.embedding)),
                ("checkpoint", path(&self.checkpoint)),
                ("require_confirmation", self.operated.to_string()),
            ],
            "gctn_policy" => vec![
                ("checkpoint", path(&self.checkpoint)),
                ("device", self.device.to_string()),
            ],
            "operator_console" => match &self.console {
                Some(console) => vec![
                    // Several graphs on one machine do not take each other's port.
                    ("port", "0".to_owned()),
                    ("address_file", path(&console.address_file)),
                    ("library", path(&console.library)),
                    ("checkpoints", path(&root.join("config/checkpoints"))),
                    ("checkpoint", path(&self.checkpoint)),
                    ("recipe", path(&root.join("config/recipes/taught.yaml"))),
                    ("sctn", path(&console.program)),
                    ("training", path(&console.training)),
                ],
                None => Vec::new(),
            },
            "suction_executor" => vec![
                ("urdf", path(&root.join("urdf/workcell.urdf"))),
                ("require_approval", self.require_approval.name().to_owned()),
                ("sure_probability", self.sure_probability.to_string()),
                ("require_presence", self.require_presence.to_string()),
                // Simulated cables are pulled until they lag behind.
                ("driver.lag_rule", "true".to_owned()),
            ],
            _ => Vec::new(),
        }
    }

    /// The command line of a node, as `ros2 run` would give it.
    fn arguments(&self, root: &Root, node: &str) -> Vec<String> {
        let file = root.join(format!("config/{node}.yaml"));
        let mut arguments = vec![
            "--ros-args".to_owned(),
            "--params-file".into(),
            file.display().to_string(),
            "--enclave".into(),
            format!("/sctn/{node}"),
        ];
        let mut parameters = self.parameters(root, node);
        if let (Some(shown), "goal_oracle" | "operator_console") = (&self.demonstration, node) {
            parameters.push(("demonstration", shown.display().to_string()));
        }
        for (name, value) in parameters.iter().chain([
            &("use_sim_time", "true".to_owned()),
            &("autostart", "false".to_owned()),
        ]) {
            arguments.extend(["-p".to_owned(), format!("{name}:={value}")]);
        }
        arguments
    }
}

/// Starts one of [`NODES`] in this process.
pub fn start(
    context: &Context,
    node: &str,
    arguments: &RosArguments,
) -> Result<JoinHandle<Result<()>>> {
    match node {
        "sim_workcell" => sim_workcell::start(context, arguments),
        "camera_fusion" => camera_fusion::start(context, arguments),
        "goal_oracle" => goal_oracle::start(context, arguments),
        "gctn_policy" => gctn_policy::start(context, arguments),
        "operator_console" => operator_console::start(context, arguments),
        _ => suction_executor::start(context, arguments),
    }
}

/// The running nodes.
pub enum Graph {
    Composed(Vec<(&'static str, JoinHandle<Result<()>>)>),
    Processes {
        children: Vec<(&'static str, Child)>,
        logs: PathBuf,
    },
}

impl Graph {
    fn names(&self) -> Vec<&'static str> {
        match self {
            Self::Composed(tasks) => tasks.iter().map(|(name, _)| *name).collect(),
            Self::Processes { children, .. } => children.iter().map(|(name, _)| *name).collect(),
        }
    }

    /// All nodes in this process.
    pub fn compose(root: &Root, settings: &Settings, context: &Context) -> Result<Self> {
        let mut tasks = Vec::new();
        for node in settings.nodes() {
            let (arguments, _) = RosArguments::parse(settings.arguments(root, node))?;
            tasks.push((node, start(context, node, &arguments)?));
        }
        Ok(Self::Composed(tasks))
    }

    /// Each node a process; their output goes to files.
    pub fn spawn(root: &Root, settings: &Settings, logs: &Path) -> Result<Self> {
        let program = std::env::current_exe().context("path of the program")?;
        let folder = program.parent().context("folder of the program")?;
        std::fs::create_dir_all(logs).with_context(|| logs.display().to_string())?;
        let mut children = Vec::new();
        for node in settings.nodes() {
            let executable = folder.join(node);
            if !executable.is_file() {
                bail!(
                    "{}: no such executable; build the workspace first",
                    executable.display()
                );
            }
            let log = logs.join(format!("{node}.log"));
            let file = std::fs::File::create(&log).with_context(|| log.display().to_string())?;
            let child = Command::new(&executable)
                .args(settings.arguments(root, node))
                .env("NODE_KIT_EXIT_WITH_PARENT", "1")
                .stdin(Stdio::null())
                .stdout(file.try_clone()?)
                .stderr(file)
                .kill_on_drop(true)
                .spawn()
                .with_context(|| executable.display().to_string())?;
            children.push((node, child));
        }
        Ok(Self::Processes {
            children,
            logs: logs.to_owned(),
        })
    }

    /// Configures all nodes, then activates one after the other, and waits until `listeners` hear what the operator
    /// says. `node` asks them to.
    pub async fn bring_up(&mut self, node: &Node, listeners: usize) -> Result<()> {
        let names = self.names();
        let bringing_up = async {
            let led = names.into_iter().map(|name| async move {
                let client = LifecycleClient::new(node, &node.resolve(name))?;
                client.wait(BRING_UP).await?;
                let (from, to) = (State::Unconfigured, State::Inactive);
                client
                    .lead(Transition::Configure, from, to, BRING_UP)
                    .await?;
                anyhow::Ok(client)
            });
            for client in futures::future::try_join_all(led).await? {
                let (from, to) = (State::Inactive, State::Active);
                client
                    .lead(Transition::Activate, from, to, BRING_UP)
                    .await?;
            }
            let (graph, topic) = (node.graph(), node.resolve("step_confirmation"));
            let heard = async {
                while graph.subscriptions(&topic) < listeners {
                    tokio::time::sleep(Duration::from_millis(20)).await;
                }
            };
            tokio::time::timeout(BRING_UP, heard)
                .await
                .with_context(|| format!("{topic}: fewer than {listeners} nodes listen"))
        };
        let brought_up = tokio::select! {
            error = self.failure() => return Err(error),
            brought_up = bringing_up => brought_up,
        };
        brought_up.map_err(|error| match (self, error.downcast_ref()) {
            (Self::Processes { logs, .. }, Some(LifecycleError::Refused { node, .. })) => {
                let said = last_words(logs, node.trim_start_matches('/'));
                error.context(said)
            }
            _ => error,
        })
    }

    /// Waits until a node ends, which none should while a run lasts; says which and why.
    pub async fn failure(&mut self) -> anyhow::Error {
        match self {
            Self::Composed(tasks) => {
                let ends = tasks
                    .iter_mut()
                    .map(|(node, task)| Box::pin(async move { (*node, task.await) }));
                let ((node, end), _, _) = futures::future::select_all(ends).await;
                match end {
                    Ok(Ok(())) => anyhow::anyhow!("{node} ended"),
                    Ok(Err(error)) => error.context(format!("{node} failed")),
                    Err(error) => anyhow::anyhow!("{node} failed: {error}"),
                }
            }
            Self::Processes { children, logs } => {
                let ends = children
                    .iter_mut()
                    .map(|(node, child)| Box::pin(async move { (*node, child.wait().await) }));
                let ((node, status), _, _) = futures::future::select_all(ends).await;
                let status = status.map_or_else(
                    |error| error.to_string(),
                    |status: ExitStatus| status.to_string(),
                );
                anyhow::anyhow!("{node} ended ({status}), {}", last_words(logs, node))
            }
        }
    }

    /// Ends all nodes: SIGTERM, two seconds' grace, then SIGKILL.
    pub async fn stop(self, context: &Context) {
        context.shutdown();
        match self {
            Self::Composed(tasks) => {
                for (node, task) in tasks {
                    if let Ok(Err(error)) = task.await {
                        tracing::warn!("{node}: {error:#}");
                    }
                }
            }
            Self::Processes { mut children, .. } => {
                for (_, child) in &children {
                    let pid = child
                        .id()
                        .and_then(|id| rustix::process::Pid::from_raw(id as i32));
                    // A child that has ended has no id: nothing to signal.
                    if let Some(pid) = pid {
                        let _ = rustix::process::kill_process(pid, rustix::process::Signal::TERM);
                    }
                }
                for (node, child) in &mut children {
                    let grace = Duration::from_secs(4);
                    if tokio::time::timeout(grace, child.wait()).await.is_err() {
                        tracing::warn!("{node} did not end on SIGTERM: killed");
                        let _ = child.kill().await;
                    }
                }
            }
        }
    }
}

/// The end of a process's log.
fn last_words(logs: &Path, node: &str) -> String {
    let log = logs.join(format!("{node}.log"));
    let text = std::fs::read_to_string(&log).unwrap_or_default();
    let mut last: Vec<_> = text.lines().rev().take(5).collect();
    last.reverse();
    format!("see {}:\n{}", log.display(), last.join("\n"))
}
