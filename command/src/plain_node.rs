//! A node without parameters of its own, for commands that join a graph.

use anyhow::Result;
use node_kit::{Context, Network, NoParameters, Node, RosArguments};

/// Makes the node on a participant of its own; `arguments` as after `--ros-args`.
pub fn plain_node(name: &str, arguments: &[String]) -> Result<(Context, Node)> {
    let context = Context::new(Network::from_environment()?);
    let all = std::iter::once("--ros-args".to_owned()).chain(arguments.iter().cloned());
    let (arguments, _) = RosArguments::parse(all)?;
    let (node, _) = context.node::<NoParameters>(name, &arguments)?;
    Ok((context, node))
}
