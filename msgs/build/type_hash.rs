//! RIHS01 type hashes (REP-2016): SHA-256 over a canonical JSON of a structure and all it holds.

use crate::definition::{Arity, Element, Field, Interface, Kind, Primitive, Structure};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fmt::Write;

/// `RIHS01_` and 64 hexadecimal digits for one part of an interface.
pub fn type_hash(
    known: &BTreeMap<(String, String), Interface>,
    interface: &Interface,
    part: usize,
) -> String {
    let structure = &interface.parts[part];
    let mut referenced = BTreeMap::new();
    collect(known, structure, &mut referenced);
    let referenced: Vec<String> = referenced
        .iter()
        .map(|(name, structure)| describe(name, structure))
        .collect();
    let json = format!(
        r#"{{"type_description": {}, "referenced_type_descriptions": [{}]}}"#,
        describe(&type_name(interface, part), structure),
        referenced.join(", ")
    );
    let mut hash = String::from("RIHS01_");
    for byte in Sha256::digest(json) {
        write!(hash, "{byte:02x}").expect("writing to a string");
    }
    hash
}

/// Type hashes of earlier versions of a message, which lack its last fields: one for every number of fields that may be missing.
pub fn earlier_type_hashes(
    known: &BTreeMap<(String, String), Interface>,
    interface: &Interface,
    part: usize,
) -> Vec<String> {
    let mut earlier = interface.clone();
    let mut hashes = Vec::new();
    let is_new = |structure: &Structure| {
        let last = structure.fields.last();
        last.is_some_and(Field::is_missing_in_older_recordings)
    };
    while is_new(&earlier.parts[part]) {
        earlier.parts[part].fields.pop();
        hashes.push(type_hash(known, &earlier, part));
    }
    hashes
}

/// `package/msg/Name`, `package/srv/Name_Request` and so on.
pub fn type_name(interface: &Interface, part: usize) -> String {
    let kind = interface.kind;
    format!(
        "{}/{}/{}{}",
        interface.package,
        kind.extension(),
        interface.name,
        kind.parts()[part]
    )
}

fn collect<'a>(
    known: &'a BTreeMap<(String, String), Interface>,
    structure: &Structure,
    referenced: &mut BTreeMap<String, &'a Structure>,
) {
    for field in &structure.fields {
        if let Element::Nested(package, name) = &field.element {
            let interface = &known[&(package.clone(), name.clone())];
            let structure = &interface.parts[0];
            if referenced
                .insert(type_name(interface, 0), structure)
                .is_none()
            {
                collect(known, structure, referenced);
            }
        }
    }
}

fn describe(name: &str, structure: &Structure) -> String {
    // An empty structure gets one byte, which is part of the type.
    let filler = Field {
        name: "structure_needs_at_least_one_member".into(),
        element: Element::Primitive(Primitive::UInt8),
        arity: Arity::One,
        default: None,
        comment: vec![],
        line: 0,
    };
    let fields = if structure.fields.is_empty() {
        std::slice::from_ref(&filler)
    } else {
        &structure.fields
    };
    let fields: Vec<String> = fields.iter().map(describe_field).collect();
    format!(
        r#"{{"type_name": "{name}", "fields": [{}]}}"#,
        fields.join(", ")
    )
}

/// Numbers of type_description_interfaces/msg/FieldType.
fn describe_field(field: &Field) -> String {
    use Primitive::*;
    let (base, string_capacity) = match &field.element {
        Element::Nested(..) => (1, 0),
        Element::String(None) => (17, 0),
        Element::String(Some(bound)) => (21, *bound),
        Element::Primitive(primitive) => {
            let base = match primitive {
                Int8 => 2,
                UInt8 | Char => 3,
                Int16 => 4,
                UInt16 => 5,
                Int32 => 6,
                UInt32 => 7,
                Int64 => 8,
                UInt64 => 9,
                Float32 => 10,
                Float64 => 11,
                Bool => 15,
                Byte => 16,
            };
            (base, 0)
        }
    };
    let (offset, capacity) = match field.arity {
        Arity::One => (0, 0),
        Arity::Array(size) => (48, size),
        Arity::BoundedSequence(bound) => (96, bound),
        Arity::Sequence => (144, 0),
    };
    let nested = match &field.element {
        Element::Nested(package, name) => format!("{package}/{}/{name}", Kind::Message.extension()),
        _ => String::new(),
    };
    format!(
        r#"{{"name": "{}", "type": {{"type_id": {}, "capacity": {capacity}, "string_capacity": {string_capacity}, "nested_type_name": "{nested}"}}}}"#,
        field.name,
        base + offset,
    )
}
