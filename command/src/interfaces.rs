//! `sctn interfaces`: every topic, service, action and parameter, from the running nodes and their parameter files.

use crate::launch::graph::{self, NODES};
use crate::root::Root;
use anyhow::{Context as _, Result, bail, ensure};
use clap::Args;
use node_kit::{Context, Network, RosArguments};
use rustdds::{DomainParticipant, DomainParticipantBuilder, QosPolicies, policy};
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::net::{IpAddr, Ipv4Addr};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// The namespace in which the nodes are started: what is in it was named relatively.
const NAMESPACE: &str = "/cell/";
/// The endpoints of a node are complete when none has come for so long.
const QUIET: Duration = Duration::from_secs(3);
const PATIENCE: Duration = Duration::from_secs(60);

/// Arguments of `sctn interfaces`.
#[derive(Args)]
pub struct Interfaces {
    /// Compare with this file instead of printing, and fail where it is not the same
    #[arg(long)]
    check: Option<PathBuf>,
    /// What each node may do, for `ros2 security generate_artifacts`: config/sros2_policy.xml
    #[arg(long)]
    policy: bool,
}

impl Interfaces {
    pub fn run(self, root: &Root) -> Result<()> {
        let page = if self.policy {
            policy(&watch(root, true)?)
        } else {
            write_page(root, &watch(root, false)?)?
        };
        let Some(path) = self.check else {
            print!("{page}");
            return Ok(());
        };
        let file = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
        for (number, (found, expected)) in file.lines().zip(page.lines()).enumerate() {
            if found != expected {
                bail!(
                    "{}:{}: {found:?}, expected {expected:?}; `sctn interfaces{}` makes it anew",
                    path.display(),
                    number + 1,
                    if self.policy { " --policy" } else { "" }
                );
            }
        }
        ensure!(
            file == page,
            "{}: {} lines, expected {}; `sctn interfaces` makes it anew",
            path.display(),
            file.lines().count(),
            page.lines().count()
        );
        Ok(())
    }
}

/// What a node has to do with a name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Role {
    Publishes,
    Subscribes,
    Serves,
    Calls,
    CarriesOut,
    Sends,
}

impl Role {
    const ALL: [(Self, &str); 6] = [
        (Self::Publishes, "publishes"),
        (Self::Subscribes, "subscribes to"),
        (Self::Serves, "serves"),
        (Self::Calls, "calls"),
        (Self::CarriesOut, "carries out the action"),
        (Self::Sends, "sends goals to"),
    ];
}

#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Endpoint {
    role: Role,
    /// Relative, private (`~/`) or absolute, as the node names it.
    name: String,
    /// Full name.
    type_name: String,
    /// Only of topics.
    qos: String,
}

impl Endpoint {
    /// From what DDS shows of it. Nothing of the topics and services that make up an action, but one.
    fn new(
        node: &str,
        dds_topic: &str,
        dds_type: &str,
        is_writer: bool,
        qos: &QosPolicies,
    ) -> Option<Self> {
        let (prefix, path) = dds_topic.split_once('/')?;
        let (package, kind, name) = {
            let mut parts = dds_type.split("::");
            let (package, kind) = (parts.next()?, parts.next()?);
            (package, kind, parts.nth(1)?.trim_end_matches('_'))
        };
        let (role, path, name) = match (prefix, path.split_once("/_action/")) {
            ("rt", None) if is_writer => (Role::Publishes, path, name),
            ("rt", None) => (Role::Subscribes, path, name),
            ("rq", None) => {
                let role = if is_writer { Role::Calls } else { Role::Serves };
                (
                    role,
                    path.strip_suffix("Request")?,
                    name.strip_suffix("_Request")?,
                )
            }
            ("rq", Some((path, "send_goalRequest"))) => {
                let role = if is_writer {
                    Role::Sends
                } else {
                    Role::CarriesOut
                };
                (role, path, name.strip_suffix("_SendGoal_Request")?)
            }
            _ => return None,
        };
        let path = format!("/{path}");
        let name_in_cell = path.strip_prefix(NAMESPACE);
        let shown = match name_in_cell {
            None => path.clone(),
            Some(relative) => match relative.strip_prefix(&format!("{node}/")) {
                Some(private) => format!("~/{private}"),
                None => relative.to_owned(),
            },
        };
        let qos = match role {
            Role::Publishes | Role::Subscribes => qos_words(qos),
            _ => String::new(),
        };
        Some(Self {
            role,
            name: shown,
            type_name: format!("{package}/{kind}/{name}"),
            qos,
        })
    }
}

fn qos_words(qos: &QosPolicies) -> String {
    let reliable = matches!(
        qos.reliability(),
        Some(policy::Reliability::Reliable { .. })
    );
    let latched = matches!(qos.durability(), Some(policy::Durability::TransientLocal));
    match (reliable, latched) {
        (true, true) => "reliable, transient local",
        (true, false) => "reliable, volatile",
        (false, _) => "best effort",
    }
    .to_owned()
}

/// Nodes that run only beside a real cell, and who decides at a terminal.
const BESIDE: [&str; 2] = ["motion_watchdog", "sctn_operate"];

/// A node that lives until this is dropped.
enum Running {
    Composed(Context),
    Process(Child),
}

impl Drop for Running {
    fn drop(&mut self) {
        match self {
            Self::Composed(context) => context.shutdown(),
            Self::Process(child) => {
                // It may have ended by itself.
                let _ = child.kill();
                let _ = child.wait();
            }
        }
    }
}

/// A node on a domain of its own, and somebody who looks at it.
struct Watched {
    node: &'static str,
    _running: Running,
    viewer: DomainParticipant,
}

impl Watched {
    /// With the parameters of a real cell, or as `config/` has them.
    fn start(root: &Root, node: &'static str, real_cell: bool) -> Result<Self> {
        let path = |path: &str| root.join(path).display().to_string();
        let mut words = vec![
            "--ros-args".to_owned(),
            "-r".into(),
            format!("__ns:={}", NAMESPACE.trim_end_matches('/')),
        ];
        words.extend(["--params-file".into(), path(&format!("config/{node}.yaml"))]);
        let given = match node {
            "sim_workcell" => vec![("problems_dir", path("config/problems"))],
            "goal_oracle" => vec![("start_empty", "true".to_owned())],
            "operator_console" => vec![("port", "0".to_owned())],
            "gctn_policy" => vec![
                (
                    "checkpoint",
                    root.shipped_checkpoint().display().to_string(),
                ),
                ("observation_needs_home", real_cell.to_string()),
            ],
            _ => Vec::new(),
        };
        for (name, value) in given
            .into_iter()
            .chain([("use_sim_time", "true".to_owned())])
        {
            words.extend(["-p".to_owned(), format!("{name}:={value}")]);
        }
        let network = Network::unused()?;
        let running = if BESIDE.contains(&node) {
            Running::Process(process(node, &words, network)?)
        } else {
            let context = Context::new(network);
            graph::start(&context, node, &RosArguments::parse(words)?.0)?;
            Running::Composed(context)
        };
        let viewer = DomainParticipantBuilder::new(network.domain_id)
            .with_only_networks([IpAddr::V4(Ipv4Addr::LOCALHOST)])
            .build()
            .map_err(|error| {
                anyhow::anyhow!("participant in domain {}: {error:?}", network.domain_id)
            })?;
        Ok(Self {
            node,
            _running: running,
            viewer,
        })
    }

    fn endpoints(&self) -> BTreeSet<Endpoint> {
        let writers = self.viewer.discovered_writers();
        let writers = writers.iter().map(|writer| {
            let data = &writer.publication_topic_data;
            Endpoint::new(
                self.node,
                &data.topic_name,
                &data.type_name,
                true,
                &data.qos(),
            )
        });
        let readers = self.viewer.discovered_readers();
        let readers = readers.iter().map(|reader| {
            let data = &reader.subscription_topic_data;
            Endpoint::new(
                self.node,
                data.topic_name(),
                data.type_name(),
                false,
                &data.qos(),
            )
        });
        // ros2-client has a reader of /clock with another type.
        let strange = |endpoint: &Endpoint| {
            endpoint.name == "/clock" && endpoint.type_name != "rosgraph_msgs/msg/Clock"
        };
        writers
            .chain(readers)
            .flatten()
            .filter(|endpoint| !strange(endpoint))
            .collect()
    }
}

/// One of [`BESIDE`], with ROS arguments as after the program's name.
fn process(node: &str, words: &[String], network: Network) -> Result<Child> {
    let own = std::env::current_exe().context("path of sctn")?;
    let mut command = match node {
        "sctn_operate" => {
            let mut command = Command::new(own);
            command.args(["operate", "--", "-r"]).arg(&words[2]);
            command
        }
        node => {
            let mut command = Command::new(own.with_file_name(node));
            command.args(words);
            command
        }
    };
    command
        .env("ROS_DOMAIN_ID", network.domain_id.to_string())
        .env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        .env_remove("ROS_SECURITY_ENABLE")
        .env("NODE_KIT_EXIT_WITH_PARENT", "1")
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .with_context(|| format!("cannot start {:?}", command.get_program()))
}

/// Each node and what it has: those of the simulated cell, or those of a real one.
fn watch(root: &Root, real_cell: bool) -> Result<Vec<(&'static str, BTreeSet<Endpoint>)>> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()?;
    let _entered = runtime.enter();
    let beside = BESIDE.iter().filter(|_| real_cell);
    let watched = NODES
        .iter()
        .chain(beside)
        .map(|node| Watched::start(root, node, real_cell))
        .collect::<Result<Vec<_>>>()?;
    let begin = Instant::now();
    let mut seen: Vec<BTreeSet<Endpoint>> = vec![BTreeSet::new(); watched.len()];
    let mut changed = begin;
    while changed.elapsed() < QUIET {
        ensure!(
            begin.elapsed() < PATIENCE,
            "the nodes' endpoints still change after {PATIENCE:?}"
        );
        std::thread::sleep(Duration::from_millis(100));
        for (seen, node) in seen.iter_mut().zip(&watched) {
            // What a node has shown once belongs to it.
            let before = seen.len();
            seen.extend(node.endpoints());
            if seen.len() != before {
                changed = Instant::now();
            }
        }
        if seen.iter().any(BTreeSet::is_empty) {
            changed = Instant::now();
        }
    }
    let nodes = watched.iter().map(|node| node.node).zip(seen).collect();
    drop(watched);
    runtime.shutdown_timeout(Duration::from_millis(500));
    Ok(nodes)
}

/// What each node may do, in the words of sros2.
fn policy(nodes: &[(&str, BTreeSet<Endpoint>)]) -> String {
    let mut text = String::from(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n\
         <!-- What each node may do where ROS_SECURITY_ENABLE is true, for `ros2 security generate_artifacts` (docs/guide/security.md). Made by\n     \
         `sctn interfaces` with its option `policy` from the running nodes; a test holds it current. Names follow the namespace `ns`: change\n     \
         that where the cell has one, and topics where you remap them or the cameras and the driver have other names. -->\n\
         <policy version=\"0.2.0\">\n  <enclaves>\n",
    );
    let cameras = nodes.iter().find(|(node, _)| *node == "camera_fusion");
    for (node, endpoints) in nodes {
        let mut endpoints = endpoints.clone();
        // ros2-client reads it whatever the node's time is.
        endpoints.insert(Endpoint {
            role: Role::Subscribes,
            name: "/clock".to_owned(),
            type_name: "rosgraph_msgs/msg/Clock".to_owned(),
            qos: "best effort".to_owned(),
        });
        if let (&"operator_console", Some((_, of_cameras))) = (node, cameras) {
            // It asks for their images only while somebody looks at them.
            let read = of_cameras
                .iter()
                .filter(|endpoint| endpoint.role == Role::Subscribes);
            endpoints.extend(read.cloned());
        }
        text += &format!(
            "    <enclave path=\"/sctn/{node}\">\n      <profiles>\n        <profile ns=\"/\" node=\"{node}\">\n"
        );
        for (role, _) in Role::ALL {
            let (kind, right) = match role {
                Role::Publishes => ("topic", "publish"),
                Role::Subscribes => ("topic", "subscribe"),
                Role::Serves => ("service", "reply"),
                Role::Calls => ("service", "request"),
                Role::CarriesOut => ("action", "execute"),
                Role::Sends => ("action", "call"),
            };
            let names: BTreeSet<&str> = endpoints
                .iter()
                .filter(|endpoint| endpoint.role == role)
                .map(|endpoint| endpoint.name.as_str())
                .collect();
            if names.is_empty() {
                continue;
            }
            text += &format!("          <{kind}s {right}=\"ALLOW\">\n");
            for name in names {
                text += &format!("            <{kind}>{name}</{kind}>\n");
            }
            text += &format!("          </{kind}s>\n");
        }
        text += "        </profile>\n      </profiles>\n    </enclave>\n";
    }
    text + "  </enclaves>\n</policy>\n"
}

fn write_page(root: &Root, nodes: &[(&str, BTreeSet<Endpoint>)]) -> Result<String> {
    let mut page = String::from(
        "# Interfaces\n\n\
         Every topic, service, action and parameter. Made by `sctn interfaces > docs/interfaces.md` from the running nodes and their files in \
         `config/`; a test holds it current.\n\n\
         Names are as the nodes have them: relative ones follow a namespace, `~/` stands for the node's name, and all can be remapped.\n\n\
         Services that change something carry a `request_id`, or change nothing when called twice: a reply can be lost, and the call be made again.\n",
    );
    let common = nodes
        .iter()
        .map(|(_, endpoints)| endpoints.clone())
        .reduce(|all, endpoints| &all & &endpoints)
        .unwrap_or_default();
    page += "\n## Every node\n";
    write_endpoints(root, &mut page, &common)?;
    for (node, endpoints) in nodes {
        write!(page, "\n## {node}\n")?;
        write_endpoints(root, &mut page, &(endpoints - &common))?;
        write_parameters(root, &mut page, node)?;
    }
    Ok(page)
}

fn write_endpoints(root: &Root, page: &mut String, endpoints: &BTreeSet<Endpoint>) -> Result<()> {
    for (role, words) in Role::ALL {
        let of_role: Vec<_> = endpoints
            .iter()
            .filter(|endpoint| endpoint.role == role)
            .collect();
        if of_role.is_empty() {
            continue;
        }
        match role {
            Role::Publishes | Role::Subscribes => {
                write!(page, "\n| {words} | type | QoS |\n|---|---|---|\n")?;
                for endpoint in of_role {
                    let type_name = linked(root, &endpoint.type_name);
                    writeln!(
                        page,
                        "| `{}` | {type_name} | {} |",
                        endpoint.name, endpoint.qos
                    )?;
                }
            }
            _ => {
                write!(page, "\n| {words} | type |\n|---|---|\n")?;
                for endpoint in of_role {
                    let type_name = linked(root, &endpoint.type_name);
                    writeln!(page, "| `{}` | {type_name} |", endpoint.name)?;
                }
            }
        }
    }
    Ok(())
}

/// Our own types lead to their definitions.
fn linked(root: &Root, type_name: &str) -> String {
    let mut parts = type_name.split('/');
    let (package, kind, name) = (parts.next(), parts.next(), parts.next());
    if let (Some("sctn_msgs"), Some(kind), Some(name)) = (package, kind, name) {
        let file = format!("msgs/{kind}/{name}.{kind}");
        if root.join(&file).is_file() {
            return format!("[{type_name}](../{file})");
        }
    }
    type_name.to_owned()
}

/// The parameters of a node with their defaults and what the file in `config/` says of them.
fn write_parameters(root: &Root, page: &mut String, node: &str) -> Result<()> {
    let path = root.join(format!("config/{node}.yaml"));
    let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    write!(page, "\n| parameter | default | |\n|---|---|---|\n")?;
    let mut comment = String::new();
    let mut above: Vec<(usize, &str)> = Vec::new();
    for line in text
        .lines()
        .skip_while(|line| line.trim() != "ros__parameters:")
        .skip(1)
    {
        let trimmed = line.trim();
        if let Some(text) = trimmed.strip_prefix('#') {
            if !comment.is_empty() {
                comment.push(' ');
            }
            comment += text.trim();
            continue;
        }
        let Some((name, value)) = trimmed.split_once(':') else {
            comment.clear();
            continue;
        };
        let indent = line.len() - line.trim_start().len();
        above.retain(|(outer, _)| *outer < indent);
        above.push((indent, name));
        if value.trim().is_empty() {
            // What it says is of all that follows.
            continue;
        }
        let names: Vec<_> = above.iter().map(|(_, name)| *name).collect();
        writeln!(
            page,
            "| `{}` | `{}` | {} |",
            names.join("."),
            value.trim().replace('|', "\\|"),
            std::mem::take(&mut comment).replace('|', "\\|")
        )?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustdds::QosPolicyBuilder;

    fn endpoint(topic: &str, type_name: &str, is_writer: bool) -> Option<(Role, String, String)> {
        let qos = QosPolicyBuilder::new().best_effort().build();
        let endpoint = Endpoint::new("goal_oracle", topic, type_name, is_writer, &qos)?;
        Some((endpoint.role, endpoint.name, endpoint.type_name))
    }

    #[test]
    fn a_policy_allows_what_nodes_have_and_no_more() {
        let made = |role, name: &str| Endpoint {
            role,
            name: name.to_owned(),
            type_name: "sctn_msgs/msg/Goal".to_owned(),
            qos: String::new(),
        };
        let fusion = BTreeSet::from([made(Role::Subscribes, "front/color/image_raw")]);
        let console = BTreeSet::from([
            made(Role::Publishes, "step_confirmation"),
            made(Role::Serves, "~/get_parameters"),
            made(Role::Sends, "execute_pick_place"),
        ]);
        let text = policy(&[("camera_fusion", fusion), ("operator_console", console)]);
        let (_, console) = text.split_once("/sctn/operator_console").unwrap();
        let lines: Vec<&str> = console.lines().map(str::trim).collect();
        for (right, name) in [
            (
                "<topics publish=\"ALLOW\">",
                "<topic>step_confirmation</topic>",
            ),
            ("<topics subscribe=\"ALLOW\">", "<topic>/clock</topic>"),
            (
                "<services reply=\"ALLOW\">",
                "<service>~/get_parameters</service>",
            ),
            (
                "<actions call=\"ALLOW\">",
                "<action>execute_pick_place</action>",
            ),
        ] {
            let at = lines.iter().position(|line| *line == right);
            assert_eq!(lines[at.expect(right) + 1], name);
        }
        // It looks at the cameras where somebody looks at it.
        assert!(lines.contains(&"<topic>front/color/image_raw</topic>"));
        let (fusion, _) = text.split_once("/sctn/operator_console").unwrap();
        assert!(!fusion.contains("publish"), "{fusion}");
    }

    #[test]
    fn names_and_types_are_those_of_ros() {
        let some =
            |role, name: &str, type_name: &str| Some((role, name.to_owned(), type_name.to_owned()));
        assert_eq!(
            endpoint("rt/cell/goal", "sctn_msgs::msg::dds_::Goal_", true),
            some(Role::Publishes, "goal", "sctn_msgs/msg/Goal")
        );
        assert_eq!(
            endpoint("rt/tf_static", "tf2_msgs::msg::dds_::TFMessage_", false),
            some(Role::Subscribes, "/tf_static", "tf2_msgs/msg/TFMessage")
        );
        let set_step = "sctn_msgs::srv::dds_::SetStep_Request_";
        assert_eq!(
            endpoint("rq/cell/goal_oracle/set_stepRequest", set_step, false),
            some(Role::Serves, "~/set_step", "sctn_msgs/srv/SetStep")
        );
        assert_eq!(
            endpoint("rr/cell/goal_oracle/set_stepReply", set_step, true),
            None
        );
        let goal = "sctn_msgs::action::dds_::ExecutePickPlace_SendGoal_Request_";
        assert_eq!(
            endpoint(
                "rq/cell/execute_pick_place/_action/send_goalRequest",
                goal,
                true
            ),
            some(
                Role::Sends,
                "execute_pick_place",
                "sctn_msgs/action/ExecutePickPlace"
            )
        );
        assert_eq!(
            endpoint("rt/cell/execute_pick_place/_action/feedback", goal, true),
            None
        );
    }
}
