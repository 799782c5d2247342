//! The reader of interface files: what it refuses and how it says so, and what the files of this crate say.

#[allow(dead_code)]
#[path = "../build/definition.rs"]
mod definition;

use definition::{Kind, parse, read_package};
use msgs::{Interface, Visitor, description};
use std::collections::BTreeMap;
use std::path::Path;

fn mistake(kind: Kind, text: &str) -> String {
    match parse(
        Path::new("msg/Sample.msg"),
        "sample_msgs",
        "Sample",
        kind,
        text,
    ) {
        Ok(_) => panic!("no mistake found in {text:?}"),
        Err(mistake) => mistake.to_string(),
    }
}

#[test]
fn mistakes_name_the_file_and_the_line() {
    let message = |text| mistake(Kind::Message, text);
    assert_eq!(
        message("# Fine.\nuint8 a\nfloat8 b"),
        "msg/Sample.msg:3: `float8` is no type, expected a primitive, `string`, `Name` or `package/Name`"
    );
    assert_eq!(
        message("uint8 a\nuint8 a"),
        "msg/Sample.msg:2: `a` is defined twice"
    );
    assert_eq!(
        message("uint8 MAX=256"),
        "msg/Sample.msg:1: 256 is out of range, expected 0 to 255"
    );
    assert_eq!(
        message("uint8 Max=2"),
        "msg/Sample.msg:1: `Max` is no constant name, expected UPPER_CASE"
    );
    assert_eq!(
        message("uint8 maxSize"),
        "msg/Sample.msg:1: `maxSize` is no field name, expected snake_case"
    );
    assert_eq!(
        message("uint8[0] a"),
        "msg/Sample.msg:1: `0` in `uint8[0]` is no size, expected a positive integer"
    );
    assert!(message("uint8").starts_with("msg/Sample.msg:1: `uint8` has no name"));
    assert!(message("wstring a").contains("`wstring` is not supported"));
    assert!(message("float64 a x").ends_with("`x` is no number"));
    assert!(message("uint8[2] a [1]").contains("default with 1 elements, expected 2 to 2"));
    assert!(message("string<=2 a \"abc\"").contains("longer than 2 bytes"));
    assert_eq!(
        mistake(Kind::Service, "uint8 a"),
        "msg/Sample.msg:1: 1 parts between lines of ---, expected 2"
    );
    assert!(mistake(Kind::Action, "uint8 a\n---\nuint8 b\n---\nuint8 C").contains("Sample.msg:5:"));
}

#[test]
fn a_field_of_an_unknown_or_circular_type_is_a_mistake() {
    let read =
        |name, text| parse(Path::new(name), "sample_msgs", name, Kind::Message, text).unwrap();
    let unknown = definition::link(vec![read("Sample", "uint8 a\n\nOther b")]).unwrap_err();
    assert_eq!(
        unknown.to_string(),
        "Sample:3: field `b` has the unknown message type sample_msgs/Other"
    );
    let circle = [read("One", "Two[] other"), read("Two", "One other")];
    assert!(
        definition::link(circle.into())
            .unwrap_err()
            .to_string()
            .contains("cannot hold itself")
    );
    let twice = definition::link(vec![read("One", "uint8 a"), read("One", "uint8 a")]).unwrap_err();
    assert!(twice.to_string().contains("this name is taken by One"));
}

#[test]
fn bounds_arrays_defaults_and_constants_are_read() {
    let text =
        "string<=5 a \"ab\"\nuint8[3] b [1, 0x10, 3]\nfloat32[<=2] c\nstring D = x=y\nbool e true";
    let sample = parse(
        Path::new("Sample.msg"),
        "sample_msgs",
        "Sample",
        Kind::Message,
        text,
    )
    .unwrap();
    let part = &sample.parts[0];
    use definition::{Arity, Element, Literal, Primitive};
    assert_eq!(part.fields[0].element, Element::String(Some(5)));
    assert_eq!(part.fields[0].default, Some(Literal::One("\"ab\"".into())));
    assert_eq!(part.fields[1].arity, Arity::Array(3));
    assert_eq!(
        part.fields[1].default,
        Some(Literal::Many(vec!["1".into(), "16".into(), "3".into()]))
    );
    assert_eq!(part.fields[2].arity, Arity::BoundedSequence(2));
    assert_eq!(part.constants[0].value, "\"x=y\"");
    assert_eq!(part.fields[3].element, Element::Primitive(Primitive::Bool));
}

#[test]
fn every_field_and_constant_of_ours_is_explained() {
    for interface in read_package(Path::new(env!("CARGO_MANIFEST_DIR")), "sctn_msgs").unwrap() {
        for part in &interface.parts {
            let fields = part
                .fields
                .iter()
                .map(|field| (&field.name, &field.comment));
            let constants = part
                .constants
                .iter()
                .map(|constant| (&constant.name, &constant.comment));
            for (name, comment) in fields.chain(constants) {
                assert!(
                    !comment.is_empty(),
                    "{}: {name} has no comment",
                    interface.path.display()
                );
            }
        }
    }
}

/// The hashes are those that ROS 2 Jazzy installs beside its definitions.
#[test]
fn type_hashes_are_those_of_ros() {
    struct Collect(BTreeMap<&'static str, &'static str>);
    impl Visitor for Collect {
        fn visit<T: Interface>(&mut self) {
            self.0.insert(T::TYPE_NAME, T::TYPE_HASH);
        }
    }
    let mut ours = Collect(BTreeMap::new());
    msgs::visit_all(&mut ours);
    let golden = include_str!("golden/type_hashes.txt")
        .lines()
        .map(|line| line.split_once(' ').unwrap());
    for (type_name, hash) in golden {
        assert_eq!(ours.0.get(type_name), Some(&hash), "{type_name}");
    }
}

#[test]
fn a_definition_holds_all_it_depends_on_once() {
    let separator = format!("{}\n", "=".repeat(80));
    let parts: Vec<&str> = msgs::sctn_msgs::Goal::DEFINITION
        .split(&separator)
        .collect();
    let names: Vec<&str> = parts[1..]
        .iter()
        .map(|part| part.lines().next().unwrap())
        .collect();
    let expected = [
        "MSG: std_msgs/Header",
        "MSG: builtin_interfaces/Time",
        "MSG: sctn_msgs/PrimitiveSettings",
        "MSG: sctn_msgs/Heightmap",
        "MSG: geometry_msgs/Point",
    ];
    assert_eq!(names, expected);
    assert_eq!(
        description("sctn_msgs/msg/Goal").unwrap().definition,
        msgs::sctn_msgs::Goal::DEFINITION
    );
    assert_eq!(description("sctn_msgs/msg/None"), None);
}

#[test]
fn values_beyond_a_bound_are_refused_both_ways() {
    #[derive(serde::Serialize, serde::Deserialize)]
    struct Sample {
        #[serde(
            serialize_with = "msgs::bounded::serialize::<_, _, 2>",
            deserialize_with = "msgs::bounded::deserialize::<_, _, 2>"
        )]
        values: Vec<u16>,
    }
    let cdr = |length: u32| {
        let mut bytes = vec![0, 1, 0, 0];
        bytes.extend(length.to_le_bytes());
        bytes.extend(vec![0; 2 * length as usize]);
        bytes
    };
    assert_eq!(msgs::from_cdr::<Sample>(&cdr(2)).unwrap().values, [0, 0]);
    assert!(msgs::from_cdr::<Sample>(&cdr(3)).is_err());
    assert_eq!(
        msgs::to_cdr(&Sample { values: vec![0; 2] }).unwrap(),
        cdr(2)
    );
    assert!(msgs::to_cdr(&Sample { values: vec![0; 3] }).is_err());
}
