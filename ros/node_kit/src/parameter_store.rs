//! The parameters of a running node: values, descriptions, and what may be set when.

use std::{
    any::Any,
    collections::BTreeMap,
    sync::{
        Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
};

use msgs::rcl_interfaces::{
    FloatingPointRange, IntegerRange, ListParametersRequest, ListParametersResult, Parameter,
    ParameterDescriptor, ParameterType, ParameterValue,
};
use serde_yaml_ng::Value;
use tokio::sync::watch;

use crate::{
    invalid_parameter::InvalidParameter,
    parameters::{
        Loaded, OF_EVERY_NODE, Parameters, Range, descriptions, from_values, range, shown,
    },
};

/// Dotted names and values.
type Values = Vec<(String, Value)>;

/// What is known of a parameter beside its value.
struct Declaration {
    description: String,
    range: Option<Range>,
    /// Of an empty array, the default's.
    kind: u8,
    access: Access,
}

/// When a parameter may be set.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Access {
    /// Always; the node takes it over at once.
    Always,
    /// While the node is not configured.
    Unconfigured,
    /// Read once, when the node is made.
    Never,
}

/// Takes over what was checked, or says what is wrong with it.
type TakeOver = dyn Fn(&Values) -> Result<(), InvalidParameter> + Send + Sync;

/// The parameters of one node.
pub(crate) struct ParameterStore {
    values: Mutex<Values>,
    declarations: BTreeMap<String, Declaration>,
    /// Checks all values, and makes the change known to the node.
    take_over: Box<TakeOver>,
    /// A `watch::Receiver` of the node's own type.
    newest: Box<dyn Any + Send + Sync>,
    configured: AtomicBool,
}

impl ParameterStore {
    /// Whoever is never configured (`configured`) only has parameters that may always be set.
    pub(crate) fn new<P: Parameters>(
        loaded: &Loaded<P>,
        configured: bool,
    ) -> Result<Self, InvalidParameter> {
        let described = descriptions(P::DOCUMENTATION);
        let description = |name: &str, otherwise: &str| {
            let words = described.get(name).map(String::as_str);
            words.unwrap_or(otherwise).to_owned()
        };
        let mut declarations = BTreeMap::new();
        for (name, words) in OF_EVERY_NODE {
            let declaration = Declaration {
                description: description(name, words),
                range: None,
                kind: ParameterType::PARAMETER_BOOL,
                access: Access::Never,
            };
            declarations.insert(name.to_owned(), declaration);
        }
        for (name, default) in shown(&P::default())? {
            let access = if P::FIXED.contains(&name.as_str()) {
                Access::Never
            } else if P::CHANGEABLE.contains(&name.as_str()) {
                Access::Always
            } else {
                Access::Unconfigured
            };
            let declaration = Declaration {
                description: description(&name, ""),
                range: range::<P>(&name),
                kind: kind(&default),
                access,
            };
            declarations.insert(name, declaration);
        }
        let mut values = vec![
            ("use_sim_time".to_owned(), Value::Bool(loaded.use_sim_time)),
            ("autostart".to_owned(), Value::Bool(loaded.autostart)),
        ];
        values.extend(shown(&loaded.parameters)?);
        let (sender, receiver) = watch::channel(loaded.parameters.clone());
        let take_over = move |values: &Values| {
            let own = values.iter().skip(OF_EVERY_NODE.len());
            let parameters: P = from_values(own.map(|(name, value)| (name.as_str(), value)))?;
            sender.send_replace(parameters);
            Ok(())
        };
        Ok(Self {
            values: Mutex::new(values),
            declarations,
            take_over: Box::new(take_over),
            newest: Box::new(receiver),
            configured: AtomicBool::new(configured),
        })
    }

    /// Always the newest parameters; `None` where they are of another type.
    pub(crate) fn newest<P: Parameters>(&self) -> Option<watch::Receiver<P>> {
        self.newest.downcast_ref().cloned()
    }

    /// From now on only what may always be set can be set, or everything again.
    pub(crate) fn set_configured(&self, configured: bool) {
        self.configured.store(configured, Relaxed);
    }

    fn values(&self) -> MutexGuard<'_, Values> {
        self.values.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// As rcl_interfaces/GetParameters: not set where there is no such parameter.
    pub(crate) fn get(&self, names: &[String]) -> Vec<ParameterValue> {
        let values = self.values();
        let find = |name: &String| {
            let value = values.iter().find(|(known, _)| known == name)?;
            Some(self.to_msg(name, &value.1))
        };
        names
            .iter()
            .map(|name| find(name).unwrap_or_default())
            .collect()
    }

    /// As rcl_interfaces/ListParameters.
    pub(crate) fn list(&self, request: &ListParametersRequest) -> ListParametersResult {
        let recursive = request.depth == ListParametersRequest::DEPTH_RECURSIVE;
        let near = |rest: &str| recursive || (rest.matches('.').count() as u64) < request.depth;
        let wanted = |name: &str| {
            let below = request.prefixes.iter().any(|prefix| {
                let rest = name.strip_prefix(prefix.as_str());
                rest.is_some_and(|rest| rest.is_empty() || rest.strip_prefix('.').is_some_and(near))
            });
            below || (request.prefixes.is_empty() && near(name))
        };
        let mut result = ListParametersResult::default();
        for (name, _) in self.values().iter().filter(|(name, _)| wanted(name)) {
            if let Some((prefix, _)) = name.rsplit_once('.')
                && !result.prefixes.iter().any(|known| known == prefix)
            {
                result.prefixes.push(prefix.to_owned());
            }
            result.names.push(name.clone());
        }
        result
    }

    /// As rcl_interfaces/DescribeParameters: without type where there is no such parameter.
    pub(crate) fn describe(&self, names: &[String]) -> Vec<ParameterDescriptor> {
        let values = self.get(names);
        let describe = |(name, value): (&String, ParameterValue)| {
            let mut descriptor = ParameterDescriptor {
                name: name.clone(),
                r#type: value.r#type,
                ..ParameterDescriptor::default()
            };
            let Some(declaration) = self.declarations.get(name) else {
                return descriptor;
            };
            descriptor.description.clone_from(&declaration.description);
            descriptor.read_only = self.read_only(declaration).is_some();
            descriptor.additional_constraints = match declaration.access {
                Access::Always => "may be set at any time".to_owned(),
                Access::Unconfigured => "may be set while the node is unconfigured".to_owned(),
                Access::Never => "read when the node is started".to_owned(),
            };
            match declaration.range {
                Some(Range::Integer(from_value, to_value)) => {
                    descriptor.integer_range.push(IntegerRange {
                        from_value,
                        to_value,
                        step: 0,
                    });
                }
                Some(Range::Float(from_value, to_value)) => {
                    descriptor.floating_point_range.push(FloatingPointRange {
                        from_value,
                        to_value,
                        step: 0.0,
                    });
                }
                None => {}
            }
            descriptor
        };
        names.iter().zip(values).map(describe).collect()
    }

    /// Sets all of them or, with a reason, none; says which have changed.
    pub(crate) fn set(&self, parameters: &[Parameter]) -> Result<Vec<Parameter>, String> {
        let mut values = self.values();
        let mut new = values.clone();
        let mut changed = Vec::new();
        for Parameter { name, value } in parameters {
            let declaration = self
                .declarations
                .get(name)
                .ok_or_else(|| format!("{name} is no parameter of this node"))?;
            let found = new.iter_mut().find(|(known, _)| known == name);
            let (_, present) = found.ok_or_else(|| format!("{name} is not set"))?;
            let before = self.to_msg(name, present);
            if value.r#type != before.r#type {
                return Err(format!(
                    "{name}: expected {}, found {}",
                    kind_name(before.r#type),
                    kind_name(value.r#type)
                ));
            }
            let value = from_msg(value).ok_or_else(|| format!("{name}: no value"))?;
            if *present == value {
                continue;
            }
            if let Some(reason) = self.read_only(declaration) {
                return Err(format!("{name} {reason}"));
            }
            *present = value;
            changed.push(name.clone());
        }
        if changed.is_empty() {
            return Ok(Vec::new());
        }
        (self.take_over)(&new).map_err(|invalid| invalid.to_string())?;
        *values = new;
        drop(values);
        let values = self.get(&changed);
        let changed = changed.into_iter().zip(values);
        Ok(changed
            .map(|(name, value)| Parameter { name, value })
            .collect())
    }

    /// Why a parameter cannot be set now.
    fn read_only(&self, declaration: &Declaration) -> Option<&'static str> {
        match declaration.access {
            Access::Always => None,
            Access::Unconfigured => self.configured.load(Relaxed).then_some(
                "is read when the node is configured: clean the node up first, or restart it with another value",
            ),
            Access::Never => Some("is read when the node is started: restart it with another value"),
        }
    }

    fn to_msg(&self, name: &str, value: &Value) -> ParameterValue {
        let mut message = to_msg(value);
        if value.as_sequence().is_some_and(Vec::is_empty)
            && let Some(declaration) = self.declarations.get(name)
        {
            message.r#type = declaration.kind;
        }
        message
    }
}

/// The type with which a value is shown.
fn kind(value: &Value) -> u8 {
    to_msg(value).r#type
}

fn kind_name(kind: u8) -> &'static str {
    match kind {
        ParameterType::PARAMETER_NOT_SET => "nothing",
        ParameterType::PARAMETER_BOOL => "a bool",
        ParameterType::PARAMETER_INTEGER => "an integer",
        ParameterType::PARAMETER_DOUBLE => "a double",
        ParameterType::PARAMETER_STRING => "a string",
        ParameterType::PARAMETER_BYTE_ARRAY => "bytes",
        ParameterType::PARAMETER_BOOL_ARRAY => "bools",
        ParameterType::PARAMETER_INTEGER_ARRAY => "integers",
        ParameterType::PARAMETER_DOUBLE_ARRAY => "doubles",
        ParameterType::PARAMETER_STRING_ARRAY => "strings",
        _ => "an unknown type",
    }
}

/// Not set where ROS has no such type.
fn to_msg(value: &Value) -> ParameterValue {
    fn all<T>(items: &[Value], read: impl Fn(&Value) -> Option<T>) -> Option<Vec<T>> {
        items.iter().map(read).collect()
    }
    let mut message = ParameterValue::default();
    match value {
        Value::Bool(on) => {
            message.r#type = ParameterType::PARAMETER_BOOL;
            message.bool_value = *on;
        }
        Value::Number(number) => match (number.as_i64(), number.as_f64()) {
            (Some(integer), _) => {
                message.r#type = ParameterType::PARAMETER_INTEGER;
                message.integer_value = integer;
            }
            (None, Some(double)) => {
                message.r#type = ParameterType::PARAMETER_DOUBLE;
                message.double_value = double;
            }
            (None, None) => {}
        },
        Value::String(text) => {
            message.r#type = ParameterType::PARAMETER_STRING;
            message.string_value.clone_from(text);
        }
        Value::Sequence(items) => {
            if let Some(texts) = all(items, |item| item.as_str().map(str::to_owned)) {
                message.r#type = ParameterType::PARAMETER_STRING_ARRAY;
                message.string_array_value = texts;
            } else if let Some(bools) = all(items, Value::as_bool) {
                message.r#type = ParameterType::PARAMETER_BOOL_ARRAY;
                message.bool_array_value = bools;
            } else if let Some(integers) = all(items, Value::as_i64) {
                message.r#type = ParameterType::PARAMETER_INTEGER_ARRAY;
                message.integer_array_value = integers;
            } else if let Some(doubles) = all(items, Value::as_f64) {
                message.r#type = ParameterType::PARAMETER_DOUBLE_ARRAY;
                message.double_array_value = doubles;
            }
        }
        _ => {}
    }
    message
}

/// Nothing where no value is set.
fn from_msg(message: &ParameterValue) -> Option<Value> {
    fn list<T: Clone + Into<Value>>(items: &[T]) -> Value {
        Value::Sequence(items.iter().cloned().map(Into::into).collect())
    }
    Some(match message.r#type {
        ParameterType::PARAMETER_BOOL => Value::Bool(message.bool_value),
        ParameterType::PARAMETER_INTEGER => message.integer_value.into(),
        ParameterType::PARAMETER_DOUBLE => message.double_value.into(),
        ParameterType::PARAMETER_STRING => message.string_value.as_str().into(),
        ParameterType::PARAMETER_BYTE_ARRAY => list(&message.byte_array_value),
        ParameterType::PARAMETER_BOOL_ARRAY => list(&message.bool_array_value),
        ParameterType::PARAMETER_INTEGER_ARRAY => list(&message.integer_array_value),
        ParameterType::PARAMETER_DOUBLE_ARRAY => list(&message.double_array_value),
        ParameterType::PARAMETER_STRING_ARRAY => list(&message.string_array_value),
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde::{Deserialize, Serialize};

    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    struct Example {
        tolerance_s: f64,
        cameras: Vec<String>,
        grid: Grid,
    }

    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    struct Grid {
        rows: usize,
        cell: Cell,
    }

    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    struct Cell {
        size_m: f64,
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
        const DOCUMENTATION: &'static str =
            "n:\n  ros__parameters:\n    # How far apart [s].\n    tolerance_s: 0.5\n";
        const RANGES: &'static [(&'static str, Range)] = &[
            ("tolerance_s", Range::POSITIVE),
            ("grid.rows", Range::Integer(0, 10)),
        ];
        const CHANGEABLE: &'static [&'static str] = &["tolerance_s", "grid.rows"];
    }

    fn store() -> ParameterStore {
        let loaded = Loaded {
            parameters: Example::default(),
            use_sim_time: true,
            autostart: true,
            qos_overrides: Default::default(),
        };
        ParameterStore::new(&loaded, true).unwrap()
    }

    fn parameter(name: &str, value: impl Into<Value>) -> Parameter {
        Parameter {
            name: name.into(),
            value: to_msg(&value.into()),
        }
    }

    fn names(names: &[&str]) -> Vec<String> {
        names.iter().map(|name| (*name).to_owned()).collect()
    }

    #[test]
    fn what_is_set_is_shown_and_reaches_the_node() {
        let store = store();
        let newest = store.newest::<Example>().unwrap();
        let set = [parameter("tolerance_s", 0.25), parameter("grid.rows", 3)];
        assert_eq!(store.set(&set).unwrap(), set);
        assert_eq!(newest.borrow().tolerance_s, 0.25);
        assert_eq!(newest.borrow().grid.rows, 3);
        assert_eq!(store.get(&names(&["tolerance_s"]))[0].double_value, 0.25);
        assert_eq!(store.set(&set).unwrap(), []);
    }

    #[test]
    fn one_wrong_value_changes_nothing() {
        let store = store();
        for (wrong, reason) in [
            (parameter("tolerance_s", -1.0), "must be above 0, is -1"),
            (parameter("tolerance_s", f64::NAN), "must be above 0"),
            (
                parameter("tolerance_s", 1),
                "expected a double, found an integer",
            ),
            (parameter("grid.rows", 11), "must be 0 to 10, is 11"),
            (parameter("tolerance", 1.0), "is no parameter"),
            (parameter("use_sim_time", false), "restart"),
            (parameter("grid.cell.size_m", 1.0), "clean the node up"),
            (parameter("tolerance_s", Value::Null), "found nothing"),
        ] {
            let refused = store.set(&[parameter("tolerance_s", 0.25), wrong]);
            let refused = refused.unwrap_err();
            assert!(refused.contains(reason), "{refused}");
        }
        assert_eq!(store.get(&names(&["tolerance_s"]))[0].double_value, 0.5);
    }

    #[test]
    fn everything_may_be_set_before_the_node_is_configured() {
        let store = store();
        let set = [parameter("grid.cell.size_m", 1.0)];
        assert!(store.describe(&names(&["grid.cell.size_m"]))[0].read_only);
        assert!(store.set(&set).is_err());
        store.set_configured(false);
        assert!(!store.describe(&names(&["grid.cell.size_m"]))[0].read_only);
        assert!(store.set(&set).is_ok());
        let empty = parameter("cameras", Value::Sequence(vec![]));
        assert!(store.set(&[empty]).is_ok());
        let kind = store.get(&names(&["cameras"]))[0].r#type;
        assert_eq!(kind, ParameterType::PARAMETER_STRING_ARRAY);
    }

    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    struct Guarded {
        require_approval: bool,
    }

    impl Parameters for Guarded {
        const FIXED: &'static [&'static str] = &["require_approval"];
    }

    #[test]
    fn what_protects_people_is_fixed_also_before_the_node_is_configured() {
        let loaded = Loaded {
            parameters: Guarded {
                require_approval: true,
            },
            use_sim_time: true,
            autostart: true,
            qos_overrides: Default::default(),
        };
        let store = ParameterStore::new(&loaded, false).unwrap();
        let refused = store
            .set(&[parameter("require_approval", false)])
            .unwrap_err();
        assert!(refused.contains("restart"), "{refused}");
        assert!(store.newest::<Guarded>().unwrap().borrow().require_approval);
        assert!(store.describe(&names(&["require_approval"]))[0].read_only);
    }

    #[test]
    fn lists_know_prefixes_and_depth() {
        let store = store();
        let list = |prefixes: &[&str], depth| {
            let result = store.list(&ListParametersRequest {
                prefixes: names(prefixes),
                depth,
            });
            (result.names.join(" "), result.prefixes.join(" "))
        };
        let all = "use_sim_time autostart tolerance_s cameras grid.rows grid.cell.size_m";
        assert_eq!(list(&[], 0), (all.into(), "grid grid.cell".into()));
        let (top, _) = list(&[], 1);
        assert_eq!(top, "use_sim_time autostart tolerance_s cameras");
        assert_eq!(list(&["grid"], 1).0, "grid.rows");
        assert_eq!(list(&["grid"], 0).0, "grid.rows grid.cell.size_m");
        assert_eq!(list(&["cameras"], 1).0, "cameras");
        assert_eq!(list(&["gri"], 0).0, "");
    }

    #[test]
    fn descriptions_and_ranges_are_told() {
        let described = store().describe(&names(&["tolerance_s", "grid.rows", "nothing"]));
        assert_eq!(described[0].description, "How far apart [s].");
        assert_eq!(described[0].floating_point_range[0].to_value, f64::MAX);
        assert_eq!(described[1].integer_range[0].to_value, 10);
        assert_eq!(described[2].r#type, ParameterType::PARAMETER_NOT_SET);
    }
}
