//! Writes Rust source for interfaces.

use crate::definition::{
    Arity, Constant, Element, Field, Interface, Kind, Literal, Primitive, Structure,
};
use crate::type_hash::{earlier_type_hashes, type_hash, type_name};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

type Known = BTreeMap<(String, String), Interface>;

/// A module per package, and a function that visits all types.
pub fn generate(known: &Known) -> String {
    let mut packages: BTreeMap<&str, Vec<&Interface>> = BTreeMap::new();
    for interface in known.values() {
        packages
            .entry(&interface.package)
            .or_default()
            .push(interface);
    }
    let mut out = String::new();
    for (package, interfaces) in &packages {
        put(
            &mut out,
            &format!("/// Types of the ROS package {package}."),
        );
        put(&mut out, &format!("pub mod {package} {{"));
        for interface in interfaces {
            for part in 0..interface.parts.len() {
                structure(&mut out, known, interface, part);
            }
            whole(&mut out, interface);
        }
        put(&mut out, "}");
    }
    put(&mut out, "/// Shows every type of this crate to a visitor.");
    put(
        &mut out,
        "pub fn visit_all<V: crate::Visitor>(visitor: &mut V) {",
    );
    for interface in known.values() {
        for part in 0..interface.parts.len() {
            put(
                &mut out,
                &format!(
                    "visitor.visit::<{}::{}>();",
                    interface.package,
                    rust_name(interface, part)
                ),
            );
        }
    }
    put(&mut out, "}");
    out
}

fn put(out: &mut String, line: &str) {
    out.push_str(line);
    out.push('\n');
}

/// `SetIO_Request` is `SetIORequest` in Rust.
fn rust_name(interface: &Interface, part: usize) -> String {
    format!(
        "{}{}",
        interface.name,
        interface.kind.parts()[part].trim_start_matches('_')
    )
}

fn document(out: &mut String, lines: &[String], otherwise: &str) {
    if lines.iter().all(String::is_empty) {
        put(out, &format!("/// {otherwise}"));
    }
    for line in lines {
        // Comments of others are plain text, not Markdown.
        let escaped = line.replace('[', "\\[").replace('<', "\\<");
        put(out, format!("/// {escaped}").trim_end());
    }
}

fn structure(out: &mut String, known: &Known, interface: &Interface, part: usize) {
    let structure = &interface.parts[part];
    let name = rust_name(interface, part);
    let ros_name = type_name(interface, part);
    document(out, &structure.comment, "");
    put(out, "///");
    put(out, &format!("/// ROS type `{ros_name}`."));
    let traits = traits(known, structure);
    put(
        out,
        &format!(
            "#[derive(Clone, Debug, PartialEq, ::serde::Serialize, ::serde::Deserialize{traits})]"
        ),
    );
    put(out, &format!("pub struct {name} {{"));
    for field in &structure.fields {
        document(out, &field.comment, &format!("Field `{}`.", field.name));
        if let Some(attribute) = serde_attribute(field) {
            put(out, &format!("#[serde({attribute})]"));
        }
        if field.is_missing_in_older_recordings() {
            let default = format!("{name}::default_{}", field.name);
            put(out, &format!("#[serde(default = {default:?})]"));
        }
        put(
            out,
            &format!("pub {}: {},", identifier(&field.name), rust_type(field)),
        );
    }
    if structure.fields.is_empty() {
        put(out, "/// Empty structures hold one byte on the wire.");
        put(out, "pub structure_needs_at_least_one_member: u8,");
    }
    put(out, "}");

    put(
        out,
        &format!("impl ::std::default::Default for {name} {{ fn default() -> Self {{ Self {{"),
    );
    for field in &structure.fields {
        put(
            out,
            &format!("{}: {},", identifier(&field.name), default_value(field)),
        );
    }
    if structure.fields.is_empty() {
        put(out, "structure_needs_at_least_one_member: 0,");
    }
    put(out, "} } }");
    for field in &structure.fields {
        if field.is_missing_in_older_recordings() {
            let (field_name, rust_type) = (&field.name, rust_type(field));
            let value = default_value(field);
            put(
                out,
                &format!(
                    "impl {name} {{ fn default_{field_name}() -> {rust_type} {{ {value} }} }}"
                ),
            );
        }
    }

    if !structure.constants.is_empty() {
        put(out, &format!("impl {name} {{"));
        for constant in &structure.constants {
            let Constant {
                name,
                value,
                comment,
                ..
            } = constant;
            document(out, comment, &format!("Constant `{name}`."));
            let rust_type = match &constant.element {
                Element::Primitive(primitive) => primitive_type(*primitive),
                _ => "&'static str",
            };
            put(out, &format!("pub const {name}: {rust_type} = {value};"));
        }
        put(out, "}");
    }

    put(out, &format!("impl ::ros2_client::Message for {name} {{}}"));
    put(out, &format!("impl crate::Interface for {name} {{"));
    put(
        out,
        &format!("const TYPE_NAME: &'static str = {ros_name:?};"),
    );
    put(
        out,
        &format!(
            "const TYPE_HASH: &'static str = {:?};",
            type_hash(known, interface, part)
        ),
    );
    let earlier = earlier_type_hashes(known, interface, part);
    if !earlier.is_empty() {
        put(
            out,
            &format!("const EARLIER_TYPE_HASHES: &'static [&'static str] = &{earlier:?};"),
        );
    }
    put(
        out,
        &format!(
            "const DEFINITION: &'static str = {:?};",
            full_definition(known, structure)
        ),
    );
    put(out, "}");
}

/// The type that stands for a whole service or action.
fn whole(out: &mut String, interface: &Interface) {
    let Interface {
        package,
        name,
        kind,
        ..
    } = interface;
    let (trait_name, types): (_, &[&str]) = match kind {
        Kind::Message => return,
        Kind::Service => ("Service", &["Request", "Response"]),
        Kind::Action => ("Action", &["Goal", "Result", "Feedback"]),
    };
    put(
        out,
        &format!(
            "/// The {} `{package}/{}/{name}`.",
            trait_name.to_lowercase(),
            kind.extension()
        ),
    );
    put(
        out,
        &format!("#[derive(Clone, Copy, Debug)] pub struct {name};"),
    );
    put(out, &format!("impl crate::{trait_name} for {name} {{"));
    put(out, &format!("const PACKAGE: &'static str = {package:?};"));
    put(out, &format!("const NAME: &'static str = {name:?};"));
    for part in types {
        put(out, &format!("type {part} = {name}{part};"));
    }
    put(out, "}");
}

/// The definition with all it depends on, as rosbag2 and MCAP embed it.
fn full_definition(known: &Known, structure: &Structure) -> String {
    fn append(
        known: &Known,
        structure: &Structure,
        seen: &mut BTreeSet<(String, String)>,
        out: &mut String,
    ) {
        for field in &structure.fields {
            let Element::Nested(package, name) = &field.element else {
                continue;
            };
            let key = (package.clone(), name.clone());
            if !seen.insert(key.clone()) {
                continue;
            }
            let nested = &known[&key].parts[0];
            write!(
                out,
                "{}\nMSG: {package}/{name}\n{}",
                "=".repeat(80),
                nested.text
            )
            .expect("writing to a string");
            append(known, nested, seen, out);
        }
    }
    let mut out = structure.text.clone();
    append(known, structure, &mut BTreeSet::new(), &mut out);
    out
}

/// Small plain values can be copied, and compared where they hold no floating point number.
fn traits(known: &Known, structure: &Structure) -> &'static str {
    fn all(known: &Known, structure: &Structure, holds: fn(&Field) -> bool) -> bool {
        structure.fields.iter().all(|field| match &field.element {
            Element::Nested(package, name) => {
                holds(field)
                    && all(
                        known,
                        &known[&(package.clone(), name.clone())].parts[0],
                        holds,
                    )
            }
            _ => holds(field),
        })
    }
    let plain = |field: &Field| {
        !matches!(field.element, Element::String(_))
            && matches!(field.arity, Arity::One | Arity::Array(..=32))
    };
    let exact = |field: &Field| {
        !matches!(
            field.element,
            Element::Primitive(Primitive::Float32 | Primitive::Float64)
        )
    };
    match (all(known, structure, plain), all(known, structure, exact)) {
        (true, true) => ", Copy, Eq, PartialOrd, Ord, Hash",
        (true, false) => ", Copy",
        (false, true) => ", Eq",
        (false, false) => "",
    }
}

fn identifier(name: &str) -> String {
    const KEYWORDS: [&str; 24] = [
        "abstract", "as", "async", "await", "box", "break", "const", "continue", "do", "dyn",
        "else", "enum", "extern", "final", "fn", "for", "impl", "loop", "match", "mod", "move",
        "ref", "type", "yield",
    ];
    if KEYWORDS.contains(&name) {
        format!("r#{name}")
    } else {
        name.into()
    }
}

fn primitive_type(primitive: Primitive) -> &'static str {
    use Primitive::*;
    match primitive {
        Bool => "bool",
        Byte | Char | UInt8 => "u8",
        Int8 => "i8",
        Int16 => "i16",
        UInt16 => "u16",
        Int32 => "i32",
        UInt32 => "u32",
        Int64 => "i64",
        UInt64 => "u64",
        Float32 => "f32",
        Float64 => "f64",
    }
}

fn element_type(element: &Element) -> String {
    match element {
        Element::Primitive(primitive) => primitive_type(*primitive).into(),
        Element::String(_) => "::std::string::String".into(),
        Element::Nested(package, name) => format!("crate::{package}::{name}"),
    }
}

/// Sequences of bytes are written and read as a whole.
fn is_bytes(field: &Field) -> bool {
    let byte = matches!(
        field.element,
        Element::Primitive(Primitive::Byte | Primitive::Char | Primitive::UInt8)
    );
    byte && matches!(field.arity, Arity::Sequence | Arity::BoundedSequence(_))
}

fn rust_type(field: &Field) -> String {
    let element = element_type(&field.element);
    match field.arity {
        _ if is_bytes(field) => "::serde_bytes::ByteBuf".into(),
        Arity::One => element,
        Arity::Array(size) => format!("[{element}; {size}]"),
        Arity::Sequence | Arity::BoundedSequence(_) => format!("::std::vec::Vec<{element}>"),
    }
}

fn serde_attribute(field: &Field) -> Option<String> {
    let bound = match (field.arity, &field.element) {
        // Serde itself knows arrays of up to 32 elements.
        (Arity::Array(33..), _) => return Some(r#"with = "::serde_big_array::BigArray""#.into()),
        (Arity::BoundedSequence(bound), _) => bound,
        (Arity::One, Element::String(Some(bound))) => *bound,
        _ => return None,
    };
    let module = "crate::bounded";
    Some(format!(
        r#"serialize_with = "{module}::serialize::<_, _, {bound}>", deserialize_with = "{module}::deserialize::<_, _, {bound}>""#
    ))
}

fn default_value(field: &Field) -> String {
    let one = |value: &str| match field.element {
        Element::String(_) => format!("{value}.to_owned()"),
        _ => value.to_owned(),
    };
    let plain = match &field.element {
        Element::Primitive(Primitive::Bool) => "false".to_owned(),
        Element::Primitive(Primitive::Float32 | Primitive::Float64) => "0.0".to_owned(),
        Element::Primitive(_) => "0".to_owned(),
        Element::String(_) | Element::Nested(..) => "::std::default::Default::default()".to_owned(),
    };
    match (&field.default, field.arity) {
        (None, Arity::One) => plain,
        (None, Arity::Array(size)) if matches!(field.element, Element::Primitive(_)) => {
            format!("[{plain}; {size}]")
        }
        (None, Arity::Array(_)) => {
            "::std::array::from_fn(|_| ::std::default::Default::default())".into()
        }
        (None, _) => "::std::default::Default::default()".into(),
        (Some(Literal::One(value)), _) => one(value),
        (Some(Literal::Many(values)), arity) => {
            let values: Vec<String> = values.iter().map(|value| one(value)).collect();
            let list = format!("[{}]", values.join(", "));
            match arity {
                Arity::Array(_) => list,
                _ if is_bytes(field) => format!("::serde_bytes::ByteBuf::from(vec!{list})"),
                _ => format!("vec!{list}"),
            }
        }
    }
}
