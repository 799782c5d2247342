//! Typed node parameters from `--params-file` and `-p`.

use std::{collections::BTreeMap, fmt, fs, path::PathBuf};

use serde::{Deserialize, Serialize, de::DeserializeOwned};
use serde_yaml_ng::{Mapping, Value};

use crate::{
    arguments::ParameterSource,
    invalid_parameter::InvalidParameter,
    qos_overrides::{self, QosOverrides},
};

/// The parameters of a node: a serde struct with `#[serde(default, deny_unknown_fields)]`, whose
/// `Default` is what the node does without any.
pub trait Parameters:
    Default + Clone + Serialize + DeserializeOwned + Send + Sync + 'static
{
    /// The node's parameter file: the comment above a parameter is its description, here and in
    /// `describe_parameters`. A parameter without a comment of its own shares that of the line above.
    const DOCUMENTATION: &'static str = "";
    /// Dotted names and bounds of numbers.
    const RANGES: Ranges = &[];
    /// Bounds that stand beside the parameters of a library: what the names below begin with in this node, as `driver.`, and the bounds.
    const GROUPS: &'static [(&'static str, Ranges)] = &[];
    /// Dotted names of those that may be set while the node is configured; the others are read when it is
    /// configured. The node learns of a change by [`Node::parameters`](crate::Node::parameters).
    const CHANGEABLE: &'static [&'static str] = &[];
    /// Dotted names of those that nobody sets once the process has started, not even while the node is unconfigured: what protects
    /// people is not for the network to change.
    const FIXED: &'static [&'static str] = &[];

    /// Checks what types and ranges cannot express: names, combinations.
    fn validate(&self) -> Result<(), InvalidParameter> {
        Ok(())
    }

    /// Checks everything: ranges, then [`validate`](Self::validate).
    fn check(&self) -> Result<(), InvalidParameter> {
        for (name, value) in shown(self)? {
            if let Some(range) = range::<Self>(&name) {
                range.check(&name, &value)?;
            }
        }
        self.validate()
    }
}

/// All dotted names with bounds.
fn ranges<P: Parameters>() -> impl Iterator<Item = (String, Range)> {
    let groups = std::iter::once(&("", P::RANGES)).chain(P::GROUPS);
    groups.flat_map(|(prefix, ranges)| {
        let named = move |(name, range): &(&str, Range)| (format!("{prefix}{name}"), *range);
        ranges.iter().map(named)
    })
}

/// The bounds of a parameter.
pub(crate) fn range<P: Parameters>(name: &str) -> Option<Range> {
    let found = ranges::<P>().find(|(ranged, _)| ranged == name);
    found.map(|(_, range)| range)
}

/// No parameters but those that every node has.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NoParameters {}

impl Parameters for NoParameters {}

/// What every node has, and that is read once, when the node is made: name, description.
pub(crate) const OF_EVERY_NODE: [(&str, &str); 2] = [
    ("use_sim_time", "Whether time is that of /clock."),
    (
        "autostart",
        "Whether the node configures and activates itself. False: it waits for a lifecycle manager.",
    ),
];

/// Names and bounds of numbers.
pub type Ranges = &'static [(&'static str, Range)];

/// Bounds of a number, both included.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Range {
    /// Of an integer.
    Integer(i64, i64),
    /// Of a float, which has to be finite.
    Float(f64, f64),
}

impl Range {
    /// Above 0.
    pub const POSITIVE: Self = Self::Float(f64::MIN_POSITIVE, f64::MAX);
    /// 0 or more.
    pub const NOT_NEGATIVE: Self = Self::Float(0.0, f64::MAX);
    /// Any number but infinity and NaN.
    pub const FINITE: Self = Self::Float(f64::MIN, f64::MAX);
    /// 0 to 1.
    pub const SHARE: Self = Self::Float(0.0, 1.0);
    /// How long something may take (s): at most an hour.
    pub const DURATION_S: Self = Self::Float(0.001, 3600.0);
    /// A pin of a UR's control box or tool.
    pub const PIN: Self = Self::Integer(0, 17);
    /// The same, or -1 for none.
    pub const PIN_OR_NONE: Self = Self::Integer(-1, 17);

    fn check(&self, name: &str, value: &Value) -> Result<(), InvalidParameter> {
        let (inside, found) = match (self, value) {
            (Self::Integer(from, to), Value::Number(number)) => (
                number
                    .as_i64()
                    .is_some_and(|number| (*from..=*to).contains(&number)),
                number.to_string(),
            ),
            (Self::Float(from, to), Value::Number(number)) => {
                let number = number.as_f64().unwrap_or(f64::NAN);
                // Not a number is in no range.
                ((*from..=*to).contains(&number), format!("{number}"))
            }
            (_, other) => (false, format!("{other:?}")),
        };
        if inside {
            return Ok(());
        }
        Err(InvalidParameter::new(
            name,
            format!("must be {self}, is {found}"),
        ))
    }
}

impl fmt::Display for Range {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::POSITIVE => write!(formatter, "above 0"),
            Self::NOT_NEGATIVE => write!(formatter, "0 or more"),
            Self::FINITE => write!(formatter, "finite"),
            Self::Integer(from, to) => write!(formatter, "{from} to {to}"),
            Self::Float(from, to) => write!(formatter, "{from} to {to}"),
        }
    }
}

/// Why a node's parameters cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ParameterError {
    /// A parameter file cannot be read.
    #[error("parameter file {path}: {source}")]
    File {
        /// The file.
        path: PathBuf,
        /// The reason.
        source: std::io::Error,
    },
    /// A parameter file is not YAML.
    #[error("{origin}: not valid YAML: {source}")]
    Yaml {
        /// File or argument.
        origin: String,
        /// Where and why.
        source: serde_yaml_ng::Error,
    },
    /// A parameter file is laid out in another way than `node: ros__parameters: {...}`.
    #[error("{origin}: at {at:?}: {reason}")]
    Layout {
        /// File or argument.
        origin: String,
        /// Keys from the top.
        at: String,
        /// What was expected.
        reason: &'static str,
    },
    /// A name is unknown or a value has the wrong type.
    #[error("parameter {name} (from {origin}): {reason}")]
    Value {
        /// Dotted name.
        name: String,
        /// File or argument.
        origin: String,
        /// The reason.
        reason: String,
    },
}

/// Parameters with what else the sources said.
#[derive(Debug)]
pub struct Loaded<P> {
    /// The node's own.
    pub parameters: P,
    /// Time is that of `/clock`.
    pub use_sim_time: bool,
    /// The node configures and activates itself.
    pub autostart: bool,
    /// What `qos_overrides` asks for.
    pub qos_overrides: QosOverrides,
}

/// Reads the parameters of one node; later sources win, and `-p` wins over files (as in rcl).
///
/// `node` is the base name, `full_name` the name with its namespace.
pub fn load<P: Parameters>(
    sources: &[ParameterSource],
    node: &str,
    full_name: &str,
) -> Result<Loaded<P>, ParameterError> {
    let mut collected = Collected::default();
    for source in sources {
        if let ParameterSource::File(path) = source {
            let origin = path.display().to_string();
            let text = fs::read_to_string(path).map_err(|source| ParameterError::File {
                path: path.clone(),
                source,
            })?;
            collected.add_file(&origin, &text, full_name)?;
        }
    }
    for source in sources {
        if let ParameterSource::Argument {
            node: only,
            name,
            value,
        } = source
            && only.as_deref().is_none_or(|only| only == node)
        {
            let origin = format!("-p {name}:={value}");
            let value = serde_yaml_ng::from_str(value).map_err(|source| ParameterError::Yaml {
                origin: origin.clone(),
                source,
            })?;
            collected.set(name, value, &origin);
        }
    }
    collected.finish()
}

/// Reads the parameters that one YAML text holds for a node, for tests of configuration files.
pub fn load_text<P: Parameters>(
    origin: &str,
    text: &str,
    full_name: &str,
) -> Result<P, ParameterError> {
    let mut collected = Collected::default();
    collected.add_file(origin, text, full_name)?;
    Ok(collected.finish()?.parameters)
}

/// Values so far, as nested mappings, and where each came from.
#[derive(Default)]
struct Collected {
    tree: Mapping,
    origins: BTreeMap<String, String>,
}

impl Collected {
    fn add_file(
        &mut self,
        origin: &str,
        text: &str,
        full_name: &str,
    ) -> Result<(), ParameterError> {
        let value: Value =
            serde_yaml_ng::from_str(text).map_err(|source| ParameterError::Yaml {
                origin: origin.to_owned(),
                source,
            })?;
        match value {
            Value::Null => Ok(()),
            value => self.add_level(origin, &value, &mut Vec::new(), full_name),
        }
    }

    fn add_level(
        &mut self,
        origin: &str,
        value: &Value,
        keys: &mut Vec<String>,
        full_name: &str,
    ) -> Result<(), ParameterError> {
        let layout = |keys: &[String], reason| ParameterError::Layout {
            origin: origin.to_owned(),
            at: keys.join(" "),
            reason,
        };
        let Value::Mapping(level) = value else {
            return Err(layout(
                keys,
                "expected a mapping `NODE: ros__parameters: {...}`",
            ));
        };
        for (key, below) in level {
            let Value::String(key) = key else {
                return Err(layout(keys, "keys must be strings"));
            };
            if key == "ros__parameters" {
                if keys.is_empty() {
                    return Err(layout(
                        keys,
                        "ros__parameters must stand under a node name or /**",
                    ));
                }
                if !matches!(below, Value::Mapping(_) | Value::Null) {
                    return Err(layout(keys, "ros__parameters must hold a mapping"));
                }
                if matches_name(keys, full_name) {
                    self.set_nested("", below, origin);
                }
            } else {
                keys.push(key.clone());
                self.add_level(origin, below, keys, full_name)?;
                keys.pop();
            }
        }
        Ok(())
    }

    fn set_nested(&mut self, prefix: &str, value: &Value, origin: &str) {
        let Value::Mapping(level) = value else {
            return;
        };
        for (key, value) in level {
            let name = match key {
                Value::String(key) => format!("{prefix}{key}"),
                other => format!("{prefix}{other:?}"),
            };
            match value {
                Value::Mapping(_) => self.set_nested(&format!("{name}."), value, origin),
                value => self.set(&name, value.clone(), origin),
            }
        }
    }

    fn set(&mut self, name: &str, value: Value, origin: &str) {
        let mut level = &mut self.tree;
        let mut rest = name;
        while let Some((head, tail)) = rest.split_once('.') {
            let entry = level
                .entry(Value::String(head.to_owned()))
                .or_insert_with(|| Value::Mapping(Mapping::new()));
            if !entry.is_mapping() {
                *entry = Value::Mapping(Mapping::new());
            }
            let Value::Mapping(next) = entry else {
                return;
            };
            level = next;
            rest = tail;
        }
        level.insert(Value::String(rest.to_owned()), value);
        self.origins.insert(name.to_owned(), origin.to_owned());
    }

    fn finish<P: Parameters>(mut self) -> Result<Loaded<P>, ParameterError> {
        let use_sim_time = self.of_every_node("use_sim_time", false)?;
        let autostart = self.of_every_node("autostart", true)?;
        let qos_overrides = self.qos_overrides()?;
        let parameters: P =
            read(&self.tree).map_err(|invalid| self.error(&invalid.name, invalid.reason))?;
        parameters
            .check()
            .map_err(|invalid| self.error(&invalid.name, invalid.reason))?;
        Ok(Loaded {
            parameters,
            use_sim_time,
            autostart,
            qos_overrides,
        })
    }

    fn of_every_node(&mut self, name: &str, default: bool) -> Result<bool, ParameterError> {
        match self.tree.remove(name) {
            None => Ok(default),
            Some(Value::Bool(on)) => Ok(on),
            Some(other) => Err(self.error(name, format!("expected a bool, found {other:?}"))),
        }
    }

    fn qos_overrides(&mut self) -> Result<QosOverrides, ParameterError> {
        let read = match self.tree.remove(qos_overrides::PREFIX) {
            None => return Ok(QosOverrides::default()),
            Some(Value::Mapping(topics)) => QosOverrides::from_mapping(&topics),
            Some(_) => Err(InvalidParameter::new(
                qos_overrides::PREFIX,
                "expected a mapping of topics",
            )),
        };
        read.map_err(|invalid| self.error(&invalid.name, invalid.reason))
    }

    /// An error that says where the value came from.
    fn error(&self, name: &str, reason: String) -> ParameterError {
        let known = self.origins.iter().find(|(key, _)| {
            key.as_str() == name || reason.contains(&format!("unknown field `{key}`"))
        });
        let below = || {
            self.origins
                .iter()
                .find(|(key, _)| key.starts_with(name) || name.starts_with(key.as_str()))
        };
        let (name, origin) = match known.or_else(below) {
            Some((key, origin)) if name.is_empty() || name == "." => (key.as_str(), origin.clone()),
            Some((_, origin)) => (name, origin.clone()),
            None => (name, "default".to_owned()),
        };
        ParameterError::Value {
            name: name.to_owned(),
            origin,
            reason,
        }
    }
}

/// Whether the keys above `ros__parameters`, with `*` for one token and `**` for any number, name
/// the node.
fn matches_name(keys: &[String], full_name: &str) -> bool {
    fn tokens(text: &str) -> impl Iterator<Item = &str> {
        text.split('/').filter(|token| !token.is_empty())
    }
    fn matches(pattern: &[&str], name: &[&str]) -> bool {
        match (pattern, name) {
            ([], []) => true,
            (["**", rest @ ..], _) => {
                matches(rest, name) || (!name.is_empty() && matches(pattern, &name[1..]))
            }
            ([first, rest @ ..], [token, others @ ..]) => {
                (*first == "*" || first == token) && matches(rest, others)
            }
            _ => false,
        }
    }
    let pattern: Vec<&str> = keys.iter().flat_map(|key| tokens(key)).collect();
    let name: Vec<&str> = tokens(full_name).collect();
    matches(&pattern, &name)
}

/// All parameters with dotted names, defaults included.
pub(crate) fn shown<P: Parameters>(
    parameters: &P,
) -> Result<Vec<(String, Value)>, InvalidParameter> {
    let tree = serde_yaml_ng::to_value(parameters)
        .map_err(|error| InvalidParameter::new("", format!("cannot be shown: {error}")))?;
    let mut flat = Vec::new();
    flatten("", tree, &mut flat);
    Ok(flat)
}

/// The parameter services know no nesting.
fn flatten(prefix: &str, value: Value, out: &mut Vec<(String, Value)>) {
    let Value::Mapping(level) = value else {
        return;
    };
    for (key, value) in level {
        let Value::String(key) = key else {
            continue;
        };
        let name = format!("{prefix}{key}");
        match value {
            Value::Mapping(_) => flatten(&format!("{name}."), value, out),
            value => out.push((name, value)),
        }
    }
}

/// The parameters that these values, with dotted names, stand for; checked.
pub(crate) fn from_values<'a, P: Parameters>(
    values: impl IntoIterator<Item = (&'a str, &'a Value)>,
) -> Result<P, InvalidParameter> {
    let mut collected = Collected::default();
    for (name, value) in values {
        collected.set(name, value.clone(), "");
    }
    let parameters: P = read(&collected.tree)?;
    parameters.check()?;
    Ok(parameters)
}

/// The parameters of a tree of values.
fn read<P: Parameters>(tree: &Mapping) -> Result<P, InvalidParameter> {
    serde_path_to_error::deserialize(Value::Mapping(tree.clone())).map_err(|error| {
        let path = error.path().to_string();
        // serde loses the way to a parameter that stands in a struct with `#[serde(flatten)]`.
        let lost = || unreadable::<P>(tree).filter(|_| path == ".");
        InvalidParameter::new(lost().unwrap_or(path), error.inner().to_string())
    })
}

/// The first parameter of a tree that cannot be read alone either.
fn unreadable<P: Parameters>(tree: &Mapping) -> Option<String> {
    let mut values = Vec::new();
    flatten("", Value::Mapping(tree.clone()), &mut values);
    let found = values.into_iter().find(|(name, value)| {
        let mut alone = Collected::default();
        alone.set(name, value.clone(), "");
        serde_yaml_ng::from_value::<P>(Value::Mapping(alone.tree)).is_err()
    });
    found.map(|(name, _)| name)
}

/// The description of each parameter in a parameter file: the comment above it, or above the line
/// before it where nothing separates the two; dotted names.
pub(crate) fn descriptions(file: &str) -> BTreeMap<String, String> {
    let mut descriptions = BTreeMap::new();
    // Open levels: indentation and key.
    let mut levels: Vec<(usize, &str)> = Vec::new();
    let mut comment: Vec<&str> = Vec::new();
    let mut words = String::new();
    for line in file.lines() {
        let text = line.trim();
        if text.is_empty() {
            comment.clear();
            words.clear();
        } else if let Some(said) = text.strip_prefix('#') {
            comment.push(said.trim());
        } else if let Some((key, _)) = text.split_once(':').filter(|_| !text.starts_with('-')) {
            if !comment.is_empty() {
                words = comment.join(" ");
                comment.clear();
            }
            let indentation = line.len() - line.trim_start().len();
            levels.retain(|(outer, _)| *outer < indentation);
            levels.push((indentation, key));
            // Below the node's name and `ros__parameters`.
            let path: Vec<&str> = levels.iter().skip(2).map(|(_, key)| *key).collect();
            if !path.is_empty() && !words.is_empty() {
                descriptions.insert(path.join("."), words.clone());
            }
        }
    }
    descriptions
}

/// What is wrong with a node's parameter file and its declarations, for the node's tests: nothing where the
/// file shows every parameter with its default and explains it, and ranges and changeable names are those of
/// parameters.
pub fn mistakes_in_documentation<P: Parameters>(node: &str) -> Vec<String> {
    let mut mistakes = Vec::new();
    let file = format!("{node}.yaml");
    match load_text::<P>(&file, P::DOCUMENTATION, &format!("/{node}")) {
        Ok(read) => {
            let (read, default) = (shown(&read), shown(&P::default()));
            if read != default {
                mistakes.push(format!("{file} shows {read:?}, defaults are {default:?}"));
            }
        }
        Err(error) => mistakes.push(error.to_string()),
    }
    let names: Vec<String> = match shown(&P::default()) {
        Ok(values) => values.into_iter().map(|(name, _)| name).collect(),
        Err(error) => return vec![error.to_string()],
    };
    let every_node = OF_EVERY_NODE.iter().map(|(name, _)| *name);
    let described = descriptions(P::DOCUMENTATION);
    for name in names.iter().map(String::as_str).chain(every_node) {
        if !described.contains_key(name) {
            mistakes.push(format!("{file} does not explain {name}"));
        }
    }
    let ranged = ranges::<P>().map(|(name, _)| name);
    let accessed = P::CHANGEABLE.iter().chain(P::FIXED);
    for name in ranged.chain(accessed.map(|name| (*name).to_owned())) {
        if !names.contains(&name) {
            mistakes.push(format!("{name} is no parameter of {node}"));
        }
    }
    mistakes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    struct Example {
        tolerance_s: f64,
        cameras: Vec<String>,
        grid: Grid,
    }

    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    struct Grid {
        rows: usize,
    }

    impl Grid {
        const RANGES: Ranges = &[("rows", Range::Integer(1, 1000))];
    }

    impl Default for Grid {
        fn default() -> Self {
            Self { rows: 320 }
        }
    }

    impl Default for Example {
        fn default() -> Self {
            Self {
                tolerance_s: 0.5,
                cameras: vec!["front".into()],
                grid: Grid::default(),
            }
        }
    }

    impl Parameters for Example {
        const DOCUMENTATION: &'static str = "
fusion:
  ros__parameters:
    # Time.
    use_sim_time: false
    autostart: true

    # How far apart
    # stamps may be [s].
    tolerance_s: 0.5
    cameras: [front]

    # The grid.
    grid:
      rows: 320
";
        const RANGES: &'static [(&'static str, Range)] = &[("tolerance_s", Range::POSITIVE)];
        const GROUPS: &'static [(&'static str, Ranges)] = &[("grid.", Grid::RANGES)];
        const CHANGEABLE: &'static [&'static str] = &["tolerance_s"];
    }

    #[test]
    fn comments_of_the_file_describe_the_parameters() {
        assert_eq!(mistakes_in_documentation::<Example>("fusion"), [""; 0]);
        let described = descriptions(Example::DOCUMENTATION);
        assert_eq!(described["tolerance_s"], "How far apart stamps may be [s].");
        assert_eq!(described["cameras"], described["tolerance_s"]);
        assert_eq!(described["grid.rows"], "The grid.");
    }

    #[test]
    fn values_with_dotted_names_make_parameters_again() {
        let mut values = shown(&Example::default()).unwrap();
        values[0].1 = Value::from(2.0);
        let pairs = || values.iter().map(|(name, value)| (name.as_str(), value));
        let read: Example = from_values(pairs()).unwrap();
        assert_eq!(read.tolerance_s, 2.0);
        assert_eq!(read.cameras, ["front"]);
        values[0].1 = Value::from(f64::NAN);
        let pairs = || values.iter().map(|(name, value)| (name.as_str(), value));
        let error = from_values::<Example>(pairs()).unwrap_err();
        assert_eq!(
            error.to_string(),
            "parameter tolerance_s: must be above 0, is NaN"
        );
    }

    fn from_text(text: &str) -> Result<Example, ParameterError> {
        load_text("node.yaml", text, "/cell/fusion")
    }

    #[test]
    fn wildcards_and_names_select_the_node() {
        for key in [
            "/**",
            "/*/fusion",
            "/cell/fusion",
            "cell/fusion",
            "/**/fusion",
        ] {
            let text = format!("{key}:\n  ros__parameters:\n    grid.rows: 7\n");
            assert_eq!(from_text(&text).unwrap().grid.rows, 7, "{key}");
        }
        for key in ["fusion", "/cell/other", "/*"] {
            let text = format!("{key}:\n  ros__parameters:\n    grid: {{rows: 7}}\n");
            assert_eq!(from_text(&text).unwrap().grid.rows, 320, "{key}");
        }
        let nested = "cell:\n  fusion:\n    ros__parameters:\n      tolerance_s: 1\n";
        assert_eq!(from_text(nested).unwrap().tolerance_s, 1.0);
    }

    #[test]
    fn an_unknown_name_is_refused_with_its_file() {
        let error = from_text("/**:\n  ros__parameters:\n    tolerance: 1\n").unwrap_err();
        let text = error.to_string();
        assert!(
            text.contains("node.yaml") && text.contains("`tolerance`"),
            "{text}"
        );
    }

    #[test]
    fn a_wrong_type_is_refused_with_its_name_and_file() {
        let text = from_text("/**:\n  ros__parameters:\n    grid: {rows: many}\n")
            .unwrap_err()
            .to_string();
        assert!(
            text.contains("grid.rows") && text.contains("node.yaml"),
            "{text}"
        );
    }

    #[test]
    fn a_value_out_of_range_is_refused_with_its_name_and_file() {
        let text = from_text("/**:\n  ros__parameters:\n    tolerance_s: -1.0\n")
            .unwrap_err()
            .to_string();
        assert_eq!(
            text,
            "parameter tolerance_s (from node.yaml): must be above 0, is -1"
        );
    }

    #[test]
    fn the_bounds_of_a_group_are_those_of_its_names_in_the_node() {
        assert_eq!(range::<Example>("grid.rows"), Some(Range::Integer(1, 1000)));
        assert_eq!(range::<Example>("rows"), None);
        let text = from_text("/**:\n  ros__parameters:\n    grid: {rows: 0}\n")
            .unwrap_err()
            .to_string();
        assert_eq!(
            text,
            "parameter grid.rows (from node.yaml): must be 1 to 1000, is 0"
        );
    }

    #[test]
    fn a_file_of_another_layout_is_refused() {
        let error = from_text("/**:\n  parameters:\n    tolerance_s: 1\n").unwrap_err();
        assert!(matches!(error, ParameterError::Layout { .. }), "{error}");
        let error = from_text("ros__parameters:\n  tolerance_s: 1\n").unwrap_err();
        assert!(matches!(error, ParameterError::Layout { .. }), "{error}");
    }

    #[test]
    fn arguments_win_over_files_and_all_parameters_are_declared() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("p.yaml");
        fs::write(&file, "/**:\n  ros__parameters:\n    tolerance_s: 2.0\n").unwrap();
        let sources = [
            ParameterSource::Argument {
                node: None,
                name: "tolerance_s".into(),
                value: "3.0".into(),
            },
            ParameterSource::Argument {
                node: Some("other".into()),
                name: "grid.rows".into(),
                value: "1".into(),
            },
            ParameterSource::Argument {
                node: None,
                name: "use_sim_time".into(),
                value: "true".into(),
            },
            ParameterSource::File(file),
        ];
        let loaded: Loaded<Example> = load(&sources, "fusion", "/cell/fusion").unwrap();
        assert_eq!(loaded.parameters.tolerance_s, 3.0);
        assert_eq!(loaded.parameters.grid.rows, 320);
        assert!(loaded.use_sim_time);
        assert!(loaded.autostart);
        let names: Vec<_> = shown(&loaded.parameters).unwrap();
        let names: Vec<_> = names.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(names, ["tolerance_s", "cameras", "grid.rows"]);
    }
}
