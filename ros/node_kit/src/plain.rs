//! A node without parameters of its own, for commands that join a running graph.

use crate::{Context, Network, NoParameters, Node, RosArguments};

/// Makes a node on a DDS participant of its own; `arguments` as after `--ros-args`.
pub fn plain_node(name: &str, arguments: &[String]) -> anyhow::Result<(Context, Node)> {
    let context = Context::new(Network::from_environment()?);
    let all = std::iter::once("--ros-args".to_owned()).chain(arguments.iter().cloned());
    let (arguments, _) = RosArguments::parse(all)?;
    let (node, _) = context.node::<NoParameters>(name, &arguments)?;
    Ok((context, node))
}
