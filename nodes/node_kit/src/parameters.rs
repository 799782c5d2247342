//! Typed node parameters from `--params-file` and `-p`.

use std::{collections::BTreeMap, fs, path::PathBuf};

use ros2_client::ParameterValue;
use serde::{Serialize, de::DeserializeOwned};
use serde_yaml_ng::{Mapping, Value};

use crate::arguments::ParameterSource;

/// The parameters of a node: a serde struct with `#[serde(default, deny_unknown_fields)]`, whose
/// `Default` is what the node does without any.
pub trait Parameters: Default + Serialize + DeserializeOwned + Send + 'static {
    /// Checks what types cannot express: ranges, names, combinations.
    fn validate(&self) -> Result<(), InvalidParameter> {
        Ok(())
    }
}

/// A value that a node cannot work with.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("parameter {name}: {reason}")]
pub struct InvalidParameter {
    /// Dotted name.
    pub name: String,
    /// What was expected, and what was found.
    pub reason: String,
}

impl InvalidParameter {
    /// `name` is dotted; `reason` says what was expected and what was found.
    pub fn new(name: impl Into<String>, reason: impl Into<String>) -> Self {
        Self {
            name: name.into(),
            reason: reason.into(),
        }
    }

    /// Refuses numbers that are not finite and above zero.
    pub fn unless_positive(name: &str, value: f64) -> Result<(), Self> {
        if value.is_finite() && value > 0.0 {
            return Ok(());
        }
        Err(Self::new(name, format!("must be above 0, is {value}")))
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
        /// Why.
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
        /// Why.
        reason: String,
    },
}

/// Parameters with what else the sources said.
#[derive(Debug)]
pub struct Loaded<P> {
    /// The node's own.
    pub parameters: P,
    /// The parameter that every ROS node has.
    pub use_sim_time: bool,
    /// All of them with dotted names, defaults included, as the parameter services show them.
    pub declared: Vec<(String, ParameterValue)>,
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
        let use_sim_time = match self.tree.remove("use_sim_time") {
            None => false,
            Some(Value::Bool(on)) => on,
            Some(other) => {
                return Err(self.error("use_sim_time", format!("expected a bool, found {other:?}")));
            }
        };
        let tree = Value::Mapping(std::mem::take(&mut self.tree));
        let parameters: P = serde_path_to_error::deserialize(tree).map_err(|error| {
            let path = error.path().to_string();
            self.error(&path, error.inner().to_string())
        })?;
        parameters
            .validate()
            .map_err(|invalid| self.error(&invalid.name, invalid.reason))?;
        let mut declared = vec![(
            "use_sim_time".to_owned(),
            ParameterValue::Boolean(use_sim_time),
        )];
        let shown = serde_yaml_ng::to_value(&parameters)
            .map_err(|error| self.error("", format!("cannot be shown: {error}")))?;
        flatten("", &shown, &mut declared);
        Ok(Loaded {
            parameters,
            use_sim_time,
            declared,
        })
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

/// Dotted names for the parameter services, which know no nesting.
fn flatten(prefix: &str, value: &Value, out: &mut Vec<(String, ParameterValue)>) {
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
            value => out.extend(scalar_or_array(value).map(|value| (name, value))),
        }
    }
}

fn scalar_or_array(value: &Value) -> Option<ParameterValue> {
    fn all<T>(items: &[Value], read: impl Fn(&Value) -> Option<T>) -> Option<Vec<T>> {
        items.iter().map(read).collect()
    }
    match value {
        Value::Bool(on) => Some(ParameterValue::Boolean(*on)),
        Value::Number(number) => Some(match number.as_i64() {
            Some(integer) => ParameterValue::Integer(integer),
            None => ParameterValue::Double(number.as_f64()?),
        }),
        Value::String(text) => Some(ParameterValue::String(text.clone())),
        Value::Sequence(items) => all(items, Value::as_bool)
            .map(ParameterValue::BooleanArray)
            .or_else(|| all(items, Value::as_i64).map(ParameterValue::IntegerArray))
            .or_else(|| all(items, Value::as_f64).map(ParameterValue::DoubleArray))
            .or_else(|| {
                all(items, |item| item.as_str().map(str::to_owned)).map(ParameterValue::StringArray)
            }),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde::Deserialize;

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
        fn validate(&self) -> Result<(), InvalidParameter> {
            InvalidParameter::unless_positive("tolerance_s", self.tolerance_s)
        }
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
        let names: Vec<_> = loaded
            .declared
            .iter()
            .map(|(name, _)| name.as_str())
            .collect();
        assert_eq!(
            names,
            ["use_sim_time", "tolerance_s", "cameras", "grid.rows"]
        );
    }
}
