//! Definitions of message types: ROS 2's own, and those that are installed on this machine.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// What stands between the definitions of a type and of those it depends on.
const SEPARATOR: &str =
    "================================================================================";
/// Primitive types: they have no definition.
const PRIMITIVES: [&str; 18] = [
    "bool", "byte", "char", "float32", "float64", "int8", "uint8", "int16", "uint16", "int32",
    "uint32", "int64", "uint64", "string", "wstring", "duration", "time", "octet",
];

/// ROS 2 Jazzy's own types: made by `standard_definitions.py`.
static STANDARD: &str = include_str!("standard_definitions.txt");

/// The definition of one of ROS 2's own types with all it depends on, and its RIHS01 hash.
pub fn standard_definition(type_name: &str) -> Option<(String, &'static str)> {
    static ALL: OnceLock<BTreeMap<&str, (&str, &str)>> = OnceLock::new();
    let all = ALL.get_or_init(|| {
        let block = |block: &'static str| {
            let (head, fields) = block.trim_start_matches('\n').split_once('\n')?;
            let (name, hash) = head.strip_prefix("MSG: ")?.split_once(' ')?;
            Some((name, (hash, fields)))
        };
        STANDARD.split(SEPARATOR).filter_map(block).collect()
    });
    let (hash, _) = all.get(type_name)?;
    let fields = |name: &str| Some(all.get(name)?.1.to_owned());
    Some((compose(type_name, fields)?, hash))
}

/// The definition of a type with all it depends on, as bags embed it, from the folders of AMENT_PREFIX_PATH.
pub fn installed_definition(type_name: &str) -> Option<String> {
    let prefixes = std::env::var_os("AMENT_PREFIX_PATH")?;
    let prefixes: Vec<PathBuf> = std::env::split_paths(&prefixes).collect();
    definition_in(&prefixes, type_name)
}

fn definition_in(prefixes: &[PathBuf], type_name: &str) -> Option<String> {
    compose(type_name, |name| read(prefixes, name))
}

/// A type and all it depends on, each once.
fn compose(type_name: &str, read: impl Fn(&str) -> Option<String>) -> Option<String> {
    let mut known = BTreeSet::from([type_name.to_owned()]);
    let mut whole = read(type_name)?;
    let mut open = dependencies(type_name, &whole);
    while let Some(name) = open.pop() {
        if !known.insert(name.clone()) {
            continue;
        }
        let text = read(&name)?;
        open.extend(dependencies(&name, &text));
        whole += &format!("{SEPARATOR}\nMSG: {}\n{text}", name.replace("/msg/", "/"));
    }
    Some(whole)
}

fn read(prefixes: &[PathBuf], type_name: &str) -> Option<String> {
    let (package, name) = type_name.split_once("/msg/")?;
    let is_name = |text: &str| text.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
    if !is_name(package) || !is_name(name) {
        return None;
    }
    let file = |prefix: &Path| prefix.join(format!("share/{package}/msg/{name}.msg"));
    let text = prefixes
        .iter()
        .find_map(|prefix| std::fs::read_to_string(file(prefix)).ok())?;
    Some(if text.ends_with('\n') {
        text
    } else {
        text + "\n"
    })
}

/// The types of the fields that are no primitives.
fn dependencies(type_name: &str, text: &str) -> Vec<String> {
    let package = type_name.split('/').next().unwrap_or_default();
    let mut found = Vec::new();
    for line in text.lines() {
        let line = line.split('#').next().unwrap_or_default();
        let Some(field) = line.split_whitespace().next() else {
            continue;
        };
        let base = field.split(['[', '<']).next().unwrap_or_default();
        if PRIMITIVES.contains(&base) || base.is_empty() {
            continue;
        }
        found.push(match base.split('/').collect::<Vec<_>>()[..] {
            ["Header"] => "std_msgs/msg/Header".to_owned(),
            [name] => format!("{package}/msg/{name}"),
            [package, name] => format!("{package}/msg/{name}"),
            _ => base.to_owned(),
        });
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_types_of_ros_are_known_with_the_hashes_of_ours() {
        let (definition, hash) = standard_definition("nav_msgs/msg/Odometry").unwrap();
        assert!(
            definition.starts_with("std_msgs/Header header\n"),
            "{definition}"
        );
        for part in [
            "std_msgs/Header",
            "builtin_interfaces/Time",
            "geometry_msgs/Twist",
        ] {
            assert_eq!(
                definition.matches(&format!("MSG: {part}\n")).count(),
                1,
                "{part}"
            );
        }
        assert!(hash.starts_with("RIHS01_"));
        for name in [
            "sensor_msgs/msg/Image",
            "std_msgs/msg/String",
            "tf2_msgs/msg/TFMessage",
        ] {
            let ours = msgs::description(name).unwrap();
            assert_eq!(
                standard_definition(name).unwrap().1,
                ours.type_hash,
                "{name}"
            );
        }
        assert_eq!(standard_definition("other_msgs/msg/Other"), None);
    }

    #[test]
    fn a_definition_has_all_that_it_depends_on_once() {
        let folder = tempfile::TempDir::new().unwrap();
        let write = |package: &str, name: &str, text: &str| {
            let folder = folder.path().join(format!("share/{package}/msg"));
            std::fs::create_dir_all(&folder).unwrap();
            std::fs::write(folder.join(format!("{name}.msg")), text).unwrap();
        };
        write(
            "a",
            "Outer",
            "# A comment: b/Inner\nb/Inner[] many\nNear near # and\nuint8 X=1\nstring<=5 s",
        );
        write("a", "Near", "b/Inner inner\nfloat64[3] xyz\n");
        write("b", "Inner", "uint8 x\n");
        let prefixes = [PathBuf::from("/nowhere"), folder.path().to_owned()];
        let text = definition_in(&prefixes, "a/msg/Outer").unwrap();
        assert_eq!(text.matches("MSG: b/Inner\nuint8 x\n").count(), 1);
        assert_eq!(text.matches("MSG: a/Near\n").count(), 1);
        assert!(text.starts_with("# A comment"));
        assert_eq!(definition_in(&prefixes, "a/msg/Missing"), None);
        assert_eq!(definition_in(&prefixes, "../msg/Outer"), None);
    }
}
