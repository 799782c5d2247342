//! A node without parameters of its own, for commands that join a running graph.

use crate::{Context, NoParameters, Node, RosArguments};

/// Makes a node on a DDS participant of its own; `arguments` as after `--ros-args`. Its enclave is `/sctn/NAME` unless they name
/// one, since whoever types a command names none.
pub fn plain_node(name: &str, arguments: &[String]) -> anyhow::Result<(Context, Node)> {
    let context = Context::from_environment()?;
    let all = std::iter::once("--ros-args".to_owned()).chain(arguments.iter().cloned());
    let (mut arguments, _) = RosArguments::parse(all)?;
    arguments
        .enclave
        .get_or_insert_with(|| format!("/sctn/{name}"));
    let (node, _) = context.node::<NoParameters>(name, &arguments)?;
    Ok((context, node))
}
