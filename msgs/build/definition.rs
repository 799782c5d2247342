//! Reads ROS interface files: .msg, .srv and .action.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

/// The two sequence forms and the array of an element type, or the plain element.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arity {
    One,
    Array(usize),
    Sequence,
    BoundedSequence(usize),
}

/// An element type.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Element {
    Primitive(Primitive),
    /// A string, of at most so many bytes if there is a bound.
    String(Option<usize>),
    /// Another message: package and name.
    Nested(String, String),
}

/// A type of fixed size.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Primitive {
    Bool,
    Byte,
    Char,
    Int8,
    UInt8,
    Int16,
    UInt16,
    Int32,
    UInt32,
    Int64,
    UInt64,
    Float32,
    Float64,
}

/// A checked constant or default value, as Rust source.
#[derive(Clone, Debug, PartialEq)]
pub enum Literal {
    One(String),
    Many(Vec<String>),
}

#[derive(Clone, Debug, PartialEq)]
pub struct Field {
    pub name: String,
    pub element: Element,
    pub arity: Arity,
    pub default: Option<Literal>,
    pub comment: Vec<String>,
    pub line: usize,
}

impl Field {
    /// Whether recordings from before the field was added are read without it.
    pub fn is_missing_in_older_recordings(&self) -> bool {
        let comment = self.comment.join(" ");
        comment.ends_with("Missing in older recordings.")
    }
}

#[derive(Clone, Debug, PartialEq)]
pub struct Constant {
    pub name: String,
    pub element: Element,
    pub value: String,
    pub comment: Vec<String>,
}

/// One structure: a message, or one part of a service or action.
#[derive(Clone, Debug, PartialEq)]
pub struct Structure {
    pub fields: Vec<Field>,
    pub constants: Vec<Constant>,
    pub comment: Vec<String>,
    /// The source as it stands in the file.
    pub text: String,
}

/// What a file defines.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    Message,
    Service,
    Action,
}

impl Kind {
    /// Name of the folder and extension of the files.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Message => "msg",
            Self::Service => "srv",
            Self::Action => "action",
        }
    }

    /// What the parts between `---` are called, appended to the interface's name.
    pub fn parts(self) -> &'static [&'static str] {
        match self {
            Self::Message => &[""],
            Self::Service => &["_Request", "_Response"],
            Self::Action => &["_Goal", "_Result", "_Feedback"],
        }
    }
}

/// A file.
#[derive(Clone, Debug, PartialEq)]
pub struct Interface {
    pub package: String,
    pub name: String,
    pub kind: Kind,
    pub path: PathBuf,
    pub parts: Vec<Structure>,
}

/// A mistake in a file.
#[derive(Debug)]
pub struct Mistake {
    pub path: PathBuf,
    pub line: usize,
    pub what: String,
}

impl fmt::Display for Mistake {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}: {}", self.path.display(), self.line, self.what)
    }
}

impl std::error::Error for Mistake {}

/// All interfaces of one package folder, which holds msg/, srv/ and action/.
pub fn read_package(folder: &Path, package: &str) -> Result<Vec<Interface>, Mistake> {
    let mut interfaces = Vec::new();
    for kind in [Kind::Message, Kind::Service, Kind::Action] {
        let folder = folder.join(kind.extension());
        if !folder.is_dir() {
            continue;
        }
        let unreadable = |error: std::io::Error| Mistake {
            path: folder.clone(),
            line: 0,
            what: error.to_string(),
        };
        let mut paths = Vec::new();
        for entry in std::fs::read_dir(&folder).map_err(unreadable)? {
            paths.push(entry.map_err(unreadable)?.path());
        }
        paths.sort();
        for path in paths {
            if path
                .extension()
                .is_none_or(|extension| extension != kind.extension())
            {
                let what = format!("expected only .{} files in this folder", kind.extension());
                return Err(Mistake {
                    path,
                    line: 0,
                    what,
                });
            }
            let name = path
                .file_stem()
                .unwrap_or_default()
                .to_string_lossy()
                .into_owned();
            let text = std::fs::read_to_string(&path).map_err(|error| Mistake {
                path: path.clone(),
                line: 0,
                what: error.to_string(),
            })?;
            interfaces.push(parse(&path, package, &name, kind, &text)?);
        }
    }
    Ok(interfaces)
}

/// One file.
pub fn parse(
    path: &Path,
    package: &str,
    name: &str,
    kind: Kind,
    text: &str,
) -> Result<Interface, Mistake> {
    let mistake = |line: usize, what: String| Mistake {
        path: path.into(),
        line,
        what,
    };
    let valid = name.starts_with(|c: char| c.is_ascii_uppercase())
        && name.chars().all(|c| c.is_ascii_alphanumeric());
    if !valid {
        return Err(mistake(
            0,
            format!("`{name}` is no interface name, expected CamelCase"),
        ));
    }
    let lines: Vec<&str> = text.lines().collect();
    let mut parts = Vec::new();
    let mut start = 0;
    loop {
        let end = lines[start..]
            .iter()
            .position(|line| line.trim() == "---")
            .map(|index| start + index);
        let range = start..end.unwrap_or(lines.len());
        parts.push(
            parse_part(package, &lines[range.clone()], range.start)
                .map_err(|(line, what)| mistake(line, what))?,
        );
        match end {
            Some(end) => start = end + 1,
            None => break,
        }
    }
    let expected = kind.parts().len();
    if parts.len() != expected {
        let what = format!(
            "{} parts between lines of ---, expected {expected}",
            parts.len()
        );
        return Err(mistake(lines.len(), what));
    }
    Ok(Interface {
        package: package.into(),
        name: name.into(),
        kind,
        path: path.into(),
        parts,
    })
}

type LineResult<T> = Result<T, (usize, String)>;

fn parse_part(package: &str, lines: &[&str], first: usize) -> LineResult<Structure> {
    let mut structure = Structure {
        fields: vec![],
        constants: vec![],
        comment: vec![],
        text: lines.join("\n") + "\n",
    };
    let mut pending: Vec<String> = Vec::new();
    // What an indented comment on a line of its own continues.
    enum Last {
        Nothing,
        Field,
        Constant,
    }
    let mut last = Last::Nothing;
    for (index, line) in lines.iter().enumerate() {
        let number = first + index + 1;
        let (code, comment) = match line.split_once('#') {
            Some((code, comment)) => (
                code,
                Some(comment.trim_start_matches('#').trim().to_owned()),
            ),
            None => (*line, None),
        };
        let code = code.trim();
        if code.is_empty() {
            let indented = line.starts_with(char::is_whitespace);
            match (comment, &last) {
                (Some(comment), Last::Field) if indented => {
                    structure
                        .fields
                        .last_mut()
                        .expect("a field came before")
                        .comment
                        .push(comment);
                }
                (Some(comment), Last::Constant) if indented => {
                    structure
                        .constants
                        .last_mut()
                        .expect("a constant came before")
                        .comment
                        .push(comment);
                }
                (Some(comment), _) => {
                    pending.push(comment);
                    last = Last::Nothing;
                }
                (None, _) => {
                    // A block of comments set off by an empty line, before anything else, speaks of the whole.
                    let whole = structure.fields.is_empty() && structure.constants.is_empty();
                    if whole && structure.comment.is_empty() {
                        structure.comment = std::mem::take(&mut pending);
                    }
                    pending.clear();
                    last = Last::Nothing;
                }
            }
            continue;
        }
        let mut comments = std::mem::take(&mut pending);
        comments.extend(comment);
        let at = |what: String| (number, what);
        let (type_name, rest) = code.split_once(char::is_whitespace).ok_or_else(|| {
            at(format!("`{code}` has no name, expected `type name`, `type name default` or `type NAME=value`"))
        })?;
        let (element, arity) = parse_type(package, type_name).map_err(at)?;
        let rest = rest.trim();
        let name_end = rest
            .find(|c: char| c.is_whitespace() || c == '=')
            .unwrap_or(rest.len());
        let (name, rest) = (&rest[..name_end], rest[name_end..].trim());
        let taken = structure.fields.iter().any(|field| field.name == name)
            || structure
                .constants
                .iter()
                .any(|constant| constant.name == name);
        if taken {
            return Err(at(format!("`{name}` is defined twice")));
        }
        if let Some(value) = rest.strip_prefix('=') {
            check_constant_name(name).map_err(at)?;
            if arity != Arity::One || matches!(element, Element::Nested(..)) {
                return Err(at(format!(
                    "constant `{name}` of type `{type_name}`, expected a primitive or a string"
                )));
            }
            let value = parse_literal(&element, value.trim()).map_err(at)?;
            structure.constants.push(Constant {
                name: name.into(),
                element,
                value,
                comment: comments,
            });
            last = Last::Constant;
        } else {
            check_field_name(name).map_err(at)?;
            let default = if rest.is_empty() {
                None
            } else {
                Some(parse_default(&element, arity, rest).map_err(at)?)
            };
            structure.fields.push(Field {
                name: name.into(),
                element,
                arity,
                default,
                comment: comments,
                line: number,
            });
            last = Last::Field;
        }
    }
    Ok(structure)
}

fn check_field_name(name: &str) -> Result<(), String> {
    let valid = name.starts_with(|c: char| c.is_ascii_lowercase())
        && name
            .chars()
            .all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
        && !name.ends_with('_')
        && !name.contains("__");
    if valid {
        Ok(())
    } else {
        Err(format!("`{name}` is no field name, expected snake_case"))
    }
}

fn check_constant_name(name: &str) -> Result<(), String> {
    let valid = name.starts_with(|c: char| c.is_ascii_uppercase())
        && name
            .chars()
            .all(|c| c.is_ascii_uppercase() || c.is_ascii_digit() || c == '_')
        && !name.ends_with('_');
    if valid {
        Ok(())
    } else {
        Err(format!("`{name}` is no constant name, expected UPPER_CASE"))
    }
}

fn parse_type(package: &str, text: &str) -> Result<(Element, Arity), String> {
    let (element, arity) = match text.strip_suffix(']') {
        None => (text, Arity::One),
        Some(inner) => {
            let (element, size) = inner
                .split_once('[')
                .ok_or_else(|| format!("`{text}` has a `]` without a `[`"))?;
            let number = |digits: &str| match digits.parse::<usize>() {
                Ok(number) if number > 0 => Ok(number),
                _ => Err(format!(
                    "`{digits}` in `{text}` is no size, expected a positive integer"
                )),
            };
            let arity = match size.strip_prefix("<=") {
                _ if size.is_empty() => Arity::Sequence,
                Some(bound) => Arity::BoundedSequence(number(bound)?),
                None => Arity::Array(number(size)?),
            };
            (element, arity)
        }
    };
    Ok((parse_element(package, element)?, arity))
}

fn parse_element(package: &str, text: &str) -> Result<Element, String> {
    use Primitive::*;
    let primitive = match text {
        "bool" => Bool,
        "byte" => Byte,
        "char" => Char,
        "int8" => Int8,
        "uint8" => UInt8,
        "int16" => Int16,
        "uint16" => UInt16,
        "int32" => Int32,
        "uint32" => UInt32,
        "int64" => Int64,
        "uint64" => UInt64,
        "float32" => Float32,
        "float64" => Float64,
        "string" => return Ok(Element::String(None)),
        "wstring" => return Err("`wstring` is not supported, use `string`".into()),
        _ => {
            if let Some(bound) = text.strip_prefix("string<=") {
                let bound = bound
                    .parse()
                    .map_err(|_| format!("`{bound}` is no length of a string"))?;
                return Ok(Element::String(Some(bound)));
            }
            let (package, name) = match text.split_once('/') {
                Some((package, name)) => (package, name.strip_prefix("msg/").unwrap_or(name)),
                None => (package, text),
            };
            let valid = name.starts_with(|c: char| c.is_ascii_uppercase())
                && name.chars().all(|c| c.is_ascii_alphanumeric())
                && package
                    .chars()
                    .all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_');
            if !valid {
                return Err(format!(
                    "`{text}` is no type, expected a primitive, `string`, `Name` or `package/Name`"
                ));
            }
            return Ok(Element::Nested(package.into(), name.into()));
        }
    };
    Ok(Element::Primitive(primitive))
}

fn parse_default(element: &Element, arity: Arity, text: &str) -> Result<Literal, String> {
    let bound = match arity {
        Arity::One => return parse_literal(element, text).map(Literal::One),
        Arity::Array(size) => size..=size,
        Arity::Sequence => 0..=usize::MAX,
        Arity::BoundedSequence(bound) => 0..=bound,
    };
    let inner = text
        .strip_prefix('[')
        .and_then(|text| text.strip_suffix(']'))
        .ok_or_else(|| format!("default `{text}`, expected a list in brackets"))?;
    let items = inner
        .split(',')
        .map(str::trim)
        .filter(|item| !item.is_empty());
    let values: Vec<String> = items
        .map(|item| parse_literal(element, item))
        .collect::<Result<_, _>>()?;
    if !bound.contains(&values.len()) {
        return Err(format!(
            "default with {} elements, expected {} to {}",
            values.len(),
            bound.start(),
            bound.end()
        ));
    }
    Ok(Literal::Many(values))
}

/// A value as Rust source, checked against the range of its type.
fn parse_literal(element: &Element, text: &str) -> Result<String, String> {
    let primitive = match element {
        Element::Nested(package, name) => {
            return Err(format!("a value `{text}` for the message {package}/{name}"));
        }
        Element::String(bound) => {
            let quoted = |quote: char| {
                text.strip_prefix(quote)
                    .and_then(|text| text.strip_suffix(quote))
            };
            let value = quoted('"').or_else(|| quoted('\'')).unwrap_or(text);
            return match bound {
                Some(bound) if value.len() > *bound => {
                    Err(format!("`{value}` is longer than {bound} bytes"))
                }
                _ => Ok(format!("{value:?}")),
            };
        }
        Element::Primitive(primitive) => *primitive,
    };
    let range: (i128, i128) = match primitive {
        Primitive::Bool => {
            return match text {
                "true" | "True" | "1" => Ok("true".into()),
                "false" | "False" | "0" => Ok("false".into()),
                _ => Err(format!("`{text}` is no bool")),
            };
        }
        Primitive::Float32 | Primitive::Float64 => {
            let value: f64 = text.parse().map_err(|_| format!("`{text}` is no number"))?;
            return if value.is_finite() {
                Ok(format!("{value:?}"))
            } else {
                Err(format!("`{text}` is not finite"))
            };
        }
        Primitive::Byte | Primitive::Char | Primitive::UInt8 => (0, u8::MAX.into()),
        Primitive::Int8 => (i8::MIN.into(), i8::MAX.into()),
        Primitive::Int16 => (i16::MIN.into(), i16::MAX.into()),
        Primitive::UInt16 => (0, u16::MAX.into()),
        Primitive::Int32 => (i32::MIN.into(), i32::MAX.into()),
        Primitive::UInt32 => (0, u32::MAX.into()),
        Primitive::Int64 => (i64::MIN.into(), i64::MAX.into()),
        Primitive::UInt64 => (0, u64::MAX.into()),
    };
    let value: i128 = match text.strip_prefix("0x") {
        Some(digits) => i128::from_str_radix(digits, 16).ok(),
        None => text.parse().ok(),
    }
    .ok_or_else(|| format!("`{text}` is no integer"))?;
    if value < range.0 || value > range.1 {
        return Err(format!(
            "{value} is out of range, expected {} to {}",
            range.0, range.1
        ));
    }
    Ok(value.to_string())
}

/// All interfaces by package and name, with every nested type known.
pub fn link(interfaces: Vec<Interface>) -> Result<BTreeMap<(String, String), Interface>, Mistake> {
    let mut known = BTreeMap::new();
    for interface in interfaces {
        let key = (interface.package.clone(), interface.name.clone());
        if let Some(other) = known.insert(key, interface.clone()) {
            let what = format!("this name is taken by {}", other.path.display());
            return Err(Mistake {
                path: interface.path,
                line: 0,
                what,
            });
        }
    }
    for interface in known.values() {
        for field in interface.parts.iter().flat_map(|part| &part.fields) {
            let Element::Nested(package, name) = &field.element else {
                continue;
            };
            let found = known.get(&(package.clone(), name.clone()));
            if found.is_none_or(|found| found.kind != Kind::Message) {
                let what = format!(
                    "field `{}` has the unknown message type {package}/{name}",
                    field.name
                );
                return Err(Mistake {
                    path: interface.path.clone(),
                    line: field.line,
                    what,
                });
            }
        }
    }
    for interface in known.values() {
        check_no_cycle(&known, interface, &mut Vec::new())?;
    }
    Ok(known)
}

fn check_no_cycle<'a>(
    known: &'a BTreeMap<(String, String), Interface>,
    interface: &'a Interface,
    above: &mut Vec<(&'a str, &'a str)>,
) -> Result<(), Mistake> {
    let key = (interface.package.as_str(), interface.name.as_str());
    if above.contains(&key) {
        let what = "a message cannot hold itself".to_owned();
        return Err(Mistake {
            path: interface.path.clone(),
            line: 0,
            what,
        });
    }
    above.push(key);
    for field in interface.parts.iter().flat_map(|part| &part.fields) {
        if let Element::Nested(package, name) = &field.element {
            check_no_cycle(known, &known[&(package.clone(), name.clone())], above)?;
        }
    }
    above.pop();
    Ok(())
}
