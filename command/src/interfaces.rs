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
}

impl Interfaces {
    pub fn run(self, root: &Root) -> Result<()> {
        let page = page(root)?;
        let Some(path) = self.check else {
            print!("{page}");
            return Ok(());
        };
        let file = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
        for (number, (found, expected)) in file.lines().zip(page.lines()).enumerate() {
            if found != expected {
                bail!(
                    "{}:{}: {found:?}, expected {expected:?}; `sctn interfaces` makes it anew",
                    path.display(),
                    number + 1
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

/// A node on a domain of its own, and somebody who looks at it.
struct Watched {
    node: &'static str,
    context: Context,
    viewer: DomainParticipant,
}

impl Watched {
    fn start(root: &Root, node: &'static str) -> Result<Self> {
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
            "gctn_policy" => vec![(
                "checkpoint",
                root.shipped_checkpoint().display().to_string(),
            )],
            _ => Vec::new(),
        };
        for (name, value) in given
            .into_iter()
            .chain([("use_sim_time", "true".to_owned())])
        {
            words.extend(["-p".to_owned(), format!("{name}:={value}")]);
        }
        let (arguments, _) = RosArguments::parse(words)?;
        let network = Network::unused()?;
        let context = Context::new(network);
        graph::start(&context, node, &arguments)?;
        let viewer = DomainParticipantBuilder::new(network.domain_id)
            .with_only_networks([IpAddr::V4(Ipv4Addr::LOCALHOST)])
            .build()
            .map_err(|error| {
                anyhow::anyhow!("participant in domain {}: {error:?}", network.domain_id)
            })?;
        Ok(Self {
            node,
            context,
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

fn page(root: &Root) -> Result<String> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()?;
    let _entered = runtime.enter();
    let watched = NODES
        .iter()
        .map(|node| Watched::start(root, node))
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
    for node in &watched {
        node.context.shutdown();
    }
    let nodes: Vec<(&str, BTreeSet<Endpoint>)> =
        watched.iter().map(|node| node.node).zip(seen).collect();
    runtime.shutdown_timeout(Duration::from_millis(500));
    write_page(root, &nodes)
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
