//! The `--ros-args` of a ROS 2 node, as rcl reads them.

use std::path::PathBuf;

/// Arguments that cannot be read.
#[derive(Debug, thiserror::Error, PartialEq)]
#[allow(missing_docs, reason = "each message names its fields")]
pub enum ArgumentError {
    /// A flag stands last but needs a value.
    #[error("{flag} needs a value, as in `{example}`")]
    MissingValue { flag: String, example: &'static str },
    /// `from:=to` was expected.
    #[error("{flag} {value}: expected `{example}`")]
    Malformed {
        flag: String,
        value: String,
        example: &'static str,
    },
    /// A flag inside `--ros-args` that we do not know.
    #[error(
        "unknown ROS argument {0}; expected -r, -p, --params-file, --log-level, --enclave or --"
    )]
    Unknown(String),
}

/// `[node:]from:=to`.
#[derive(Clone, Debug, PartialEq)]
pub struct Remap {
    /// The rule holds for the node of this name only.
    pub node: Option<String>,
    /// Name to be replaced, or `__node` or `__ns`.
    pub from: String,
    /// Its replacement.
    pub to: String,
}

/// Where parameter values come from, in the order of the command line.
#[derive(Clone, Debug, PartialEq)]
pub enum ParameterSource {
    /// `--params-file`
    File(PathBuf),
    /// `-p [node:]name:=value`
    Argument {
        /// The rule holds for the node of this name only.
        node: Option<String>,
        /// Dotted name.
        name: String,
        /// YAML.
        value: String,
    },
}

/// What stands between `--ros-args` and `--`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RosArguments {
    /// `-r`, `--remap`
    pub remaps: Vec<Remap>,
    /// `-p`, `--param`, `--params-file`
    pub parameters: Vec<ParameterSource>,
    /// `--log-level`: a level, or `target:=level`.
    pub log_levels: Vec<String>,
    /// `-e`, `--enclave`: whose files of the keystore the node is protected with, where ROS_SECURITY_ENABLE asks for that.
    pub enclave: Option<String>,
}

impl RosArguments {
    /// Splits a command line (without the program's name) into ROS arguments and the others.
    pub fn parse(
        arguments: impl IntoIterator<Item = String>,
    ) -> Result<(Self, Vec<String>), ArgumentError> {
        let mut ros = Self::default();
        let mut others = Vec::new();
        let mut arguments = arguments.into_iter();
        let mut inside = false;
        while let Some(argument) = arguments.next() {
            match argument.as_str() {
                "--ros-args" => inside = true,
                "--" if inside => inside = false,
                _ if inside => ros.flag(argument, &mut arguments)?,
                _ => others.push(argument),
            }
        }
        Ok((ros, others))
    }

    fn flag(
        &mut self,
        flag: String,
        rest: &mut impl Iterator<Item = String>,
    ) -> Result<(), ArgumentError> {
        let mut value = |example| {
            rest.next().ok_or_else(|| ArgumentError::MissingValue {
                flag: flag.clone(),
                example,
            })
        };
        match flag.as_str() {
            "-r" | "--remap" => {
                let example = "-r heightmap:=cell/heightmap";
                let (node, from, to) = rule(&flag, value(example)?, example)?;
                self.remaps.push(Remap { node, from, to });
            }
            "-p" | "--param" => {
                let example = "-p tolerance_s:=0.05";
                let (node, name, value) = rule(&flag, value(example)?, example)?;
                self.parameters
                    .push(ParameterSource::Argument { node, name, value });
            }
            "--params-file" => self.parameters.push(ParameterSource::File(
                value("--params-file config/node.yaml")?.into(),
            )),
            "--log-level" => self.log_levels.push(value("--log-level debug")?),
            "-e" | "--enclave" => {
                self.enclave = Some(value("--enclave /sctn/suction_executor")?);
            }
            // Accepted because launch files pass them; they change nothing here.
            "--log-config-file" | "--log-file-name" => {
                value("--log-file-name node")?;
            }
            "--enable-rosout-logs"
            | "--disable-rosout-logs"
            | "--enable-stdout-logs"
            | "--disable-stdout-logs"
            | "--enable-external-lib-logs"
            | "--disable-external-lib-logs" => {}
            _ => return Err(ArgumentError::Unknown(flag)),
        }
        Ok(())
    }

    /// The node's name after remapping.
    pub fn node_name<'a>(&'a self, default: &'a str) -> &'a str {
        self.replacement(default, &["__node", "__name"])
            .unwrap_or(default)
    }

    /// The node's namespace, `/` unless remapped.
    pub fn namespace(&self, default_node: &str) -> &str {
        self.replacement(default_node, &["__ns"]).unwrap_or("/")
    }

    fn replacement(&self, node: &str, keys: &[&str]) -> Option<&str> {
        self.remaps
            .iter()
            .find(|remap| remap.applies_to(node) && keys.contains(&remap.from.as_str()))
            .map(|remap| remap.to.as_str())
    }

    /// The fully qualified name of a topic, service or action: expands `~`, applies the first
    /// matching remap, resolves relative names against the namespace. `node` is the name before
    /// remapping, which rules refer to, `full_name` the one after it, with its namespace.
    pub fn resolve(&self, node: &str, full_name: &str, name: &str) -> String {
        let full = expand(full_name, name);
        self.remaps
            .iter()
            .filter(|remap| remap.applies_to(node) && !remap.from.starts_with("__"))
            .find(|remap| expand(full_name, &remap.from) == full)
            .map(|remap| expand(full_name, &remap.to))
            .unwrap_or(full)
    }
}

impl Remap {
    fn applies_to(&self, node: &str) -> bool {
        self.node.as_deref().is_none_or(|only| only == node)
    }
}

/// Reads `[node:]left:=right`.
fn rule(
    flag: &str,
    value: String,
    example: &'static str,
) -> Result<(Option<String>, String, String), ArgumentError> {
    let split = value.split_once(":=").and_then(|(left, right)| {
        let (node, left) = match left.split_once(':') {
            Some((node, left)) => (Some(node.to_owned()), left),
            None => (None, left),
        };
        let complete = !left.is_empty() && !right.is_empty();
        complete.then(|| (node, left.to_owned(), right.to_owned()))
    });
    split.ok_or_else(|| ArgumentError::Malformed {
        flag: flag.to_owned(),
        value,
        example,
    })
}

/// Absolute name of `name` as the node sees it.
fn expand(full_name: &str, name: &str) -> String {
    let namespace = full_name.rsplit_once('/').map_or("", |(above, _)| above);
    if name.starts_with('/') {
        name.to_owned()
    } else if let Some(private) = name.strip_prefix("~/") {
        format!("{full_name}/{private}")
    } else {
        format!("{namespace}/{name}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(line: &str) -> Result<(RosArguments, Vec<String>), ArgumentError> {
        RosArguments::parse(line.split_whitespace().map(str::to_owned))
    }

    #[test]
    fn ros_arguments_are_separated_from_the_others() {
        let (ros, others) =
            parse("--loud --ros-args -r a:=b -p x.y:=3 --params-file f.yaml -- file").unwrap();
        assert_eq!(others, ["--loud", "file"]);
        assert_eq!(ros.remaps[0].to, "b");
        assert_eq!(ros.parameters.len(), 2);
    }

    #[test]
    fn name_and_namespace_are_remapped_for_the_named_node_only() {
        let (ros, _) =
            parse("--ros-args -r __ns:=/cell -r other:__node:=x -r me:__node:=y").unwrap();
        assert_eq!(ros.node_name("me"), "y");
        assert_eq!(ros.node_name("third"), "third");
        assert_eq!(ros.namespace("me"), "/cell");
    }

    #[test]
    fn names_resolve_as_in_rcl() {
        let (ros, _) = parse("--ros-args -r goal:=/far/goal -r ~/state:=state").unwrap();
        assert_eq!(ros.resolve("n", "/n", "heightmap"), "/heightmap");
        assert_eq!(ros.resolve("n", "/n", "~/other"), "/n/other");
        let in_cell = |name| ros.resolve("n", "/cell/renamed", name);
        assert_eq!(in_cell("heightmap"), "/cell/heightmap");
        assert_eq!(in_cell("/clock"), "/clock");
        assert_eq!(in_cell("goal"), "/far/goal");
        assert_eq!(in_cell("~/state"), "/cell/state");
        assert_eq!(in_cell("~/other"), "/cell/renamed/other");
    }

    #[test]
    fn the_enclave_is_the_one_that_was_named_last() {
        assert_eq!(parse("--ros-args -r a:=b").unwrap().0.enclave, None);
        let (ros, _) = parse("--ros-args -e /first --enclave /sctn/node").unwrap();
        assert_eq!(ros.enclave.as_deref(), Some("/sctn/node"));
    }

    #[test]
    fn bad_arguments_are_refused_with_an_example() {
        assert!(matches!(
            parse("--ros-args -r"),
            Err(ArgumentError::MissingValue { .. })
        ));
        assert!(matches!(
            parse("--ros-args -p tolerance"),
            Err(ArgumentError::Malformed { .. })
        ));
        assert_eq!(
            parse("--ros-args --verbose"),
            Err(ArgumentError::Unknown("--verbose".into()))
        );
    }
}
