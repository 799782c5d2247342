//! Problems: task modules composed on one table, read from YAML.

use crate::tasks::{ParameterError, REGISTRY, TaskModule};
use heightmap::Workspace;
use nalgebra::{Isometry2, Point2, Vector2};
use serde::de::{self, DeserializeSeed, IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};
use serde_yaml_ng::Value;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A problem: what is built about which anchor, solved in this order.
#[derive(Clone, Debug)]
pub struct Problem {
    name: String,
    held_out: bool,
    modules: Vec<Placement>,
}

/// A task module at its place on the table.
#[derive(Clone, Debug)]
pub struct Placement {
    /// The module's name in [`crate::tasks::REGISTRY`].
    pub name: &'static str,
    /// Pose of the module's frame in the world.
    pub anchor: Isometry2<f64>,
    /// The module with its parameters.
    pub module: Arc<dyn TaskModule>,
}

/// A problem file that is not one.
#[derive(Debug, thiserror::Error)]
#[error("{file}: {reason}")]
pub struct ProblemError {
    /// The file.
    pub file: PathBuf,
    /// What is wrong, and where in the file.
    pub reason: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default)]
    held_out: bool,
    modules: Vec<Entry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    name: String,
    anchor: Anchor,
    #[serde(default)]
    parameters: Value,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Anchor {
    x_m: f64,
    y_m: f64,
    #[serde(default)]
    yaw_rad: f64,
}

impl Problem {
    /// Reads `NAME.yaml` from a directory of problems.
    pub fn load(directory: &Path, name: &str) -> Result<Self, ProblemError> {
        let file = directory.join(format!("{name}.yaml"));
        let fail = |reason: String| ProblemError {
            file: file.clone(),
            reason,
        };
        check_name(name).map_err(fail)?;
        let text = std::fs::read_to_string(&file).map_err(|error| {
            let known = Self::names(directory).unwrap_or_default();
            let known = known.join(", ");
            fail(format!("no problem `{name}` ({error}); there are: {known}"))
        })?;
        Self::parse(name, &text).map_err(fail)
    }

    /// Reads a problem file anywhere; its name without `.yaml` is that of the problem.
    pub fn load_file(file: &Path) -> Result<Self, ProblemError> {
        let fail = |reason: String| ProblemError {
            file: file.to_owned(),
            reason,
        };
        let name = file
            .file_name()
            .and_then(|name| name.to_str()?.strip_suffix(".yaml"));
        let name = name.ok_or_else(|| fail("expected a file NAME.yaml".into()))?;
        check_name(name).map_err(fail)?;
        let text = std::fs::read_to_string(file).map_err(|error| fail(error.to_string()))?;
        Self::parse(name, &text).map_err(fail)
    }

    /// Names of the problems in a directory, sorted.
    pub fn names(directory: &Path) -> std::io::Result<Vec<String>> {
        let mut names = Vec::new();
        for entry in std::fs::read_dir(directory)? {
            let path = entry?.path();
            if path.extension().is_some_and(|e| e == "yaml")
                && let Some(stem) = path.file_stem().and_then(|s| s.to_str())
            {
                names.push(stem.to_owned());
            }
        }
        names.sort();
        Ok(names)
    }

    /// Reads the text of a problem file.
    pub fn parse(name: &str, text: &str) -> Result<Self, String> {
        let file: File = serde_yaml_ng::from_str(text).map_err(|e| e.to_string())?;
        if file.modules.is_empty() {
            return Err("modules: expected at least one".into());
        }
        let mut modules: Vec<Placement> = Vec::new();
        for (index, entry) in file.modules.into_iter().enumerate() {
            let placement = entry.place().map_err(|e| {
                let at = format!("modules[{index}].{}", e.field);
                let line =
                    line_of(text, &at).map_or(String::new(), |line| format!("line {line}: "));
                format!("{line}{at}: {}", e.reason)
            })?;
            let area = placement.area();
            let workspace = Workspace::RAVENS;
            if area.iter().any(|p| workspace.pixel(p).is_none()) {
                return Err(format!(
                    "modules[{index}] ({}): takes {}, expected within the workspace, {}",
                    placement.name,
                    extent(&area),
                    extent(&corners(&workspace))
                ));
            }
            for (earlier, other) in modules.iter().enumerate() {
                if overlap(&area, &other.area()) {
                    return Err(format!(
                        "modules[{index}] ({}): takes {}, which overlaps modules[{earlier}] ({}), {}",
                        placement.name,
                        extent(&area),
                        other.name,
                        extent(&other.area())
                    ));
                }
            }
            modules.push(placement);
        }
        Ok(Self {
            name: name.to_owned(),
            held_out: file.held_out,
            modules,
        })
    }

    /// Whether no policy may be trained on it: it measures what policies do with what they never saw.
    pub fn is_held_out(&self) -> bool {
        self.held_out
    }

    /// The problem's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The modules, in the order in which they are solved.
    pub fn modules(&self) -> &[Placement] {
        &self.modules
    }
}

impl Entry {
    fn place(self) -> Result<Placement, ParameterError> {
        let fail = |field: &str, reason| ParameterError {
            field: field.into(),
            reason,
        };
        let known = REGISTRY.iter().find(|(name, _)| *name == self.name);
        let (name, configure) = known.ok_or_else(|| {
            let names: Vec<_> = REGISTRY.iter().map(|(name, _)| *name).collect();
            let names = names.join(", ");
            fail(
                "name",
                format!("no module `{}`; there are: {names}", self.name),
            )
        })?;
        let Anchor { x_m, y_m, yaw_rad } = self.anchor;
        for (field, value) in [("x_m", x_m), ("y_m", y_m), ("yaw_rad", yaw_rad)] {
            if !value.is_finite() {
                let reason = format!("is {value}, expected a number");
                return Err(fail(&format!("anchor.{field}"), reason));
            }
        }
        let anchor = Isometry2::new(Vector2::new(x_m, y_m), yaw_rad);
        let module = configure(self.parameters).and_then(|module| {
            module.check(&anchor)?;
            Ok(module)
        });
        let module = module.map_err(|e| {
            let dot = if e.field.is_empty() { "" } else { "." };
            fail(&format!("parameters{dot}{}", e.field), e.reason)
        })?;
        Ok(Placement {
            name,
            anchor,
            module: module.into(),
        })
    }
}

/// A problem's name is part of the paths of its demonstrations.
fn check_name(name: &str) -> Result<(), String> {
    let plain = |c: char| c.is_ascii_alphanumeric() || "_-+".contains(c);
    if name.is_empty() || !name.chars().all(plain) {
        return Err(format!(
            "`{name}` is no problem name: letters, digits, `_`, `-`, `+`"
        ));
    }
    Ok(())
}

/// The line, from 1, on which a field such as `modules[0].parameters.pegs` begins; that of the nearest
/// field around it where it is missing.
fn line_of(text: &str, field: &str) -> Option<usize> {
    let steps: Vec<&str> = field
        .split(['.', '['])
        .map(|step| step.trim_end_matches(']'))
        .collect();
    (1..=steps.len()).rev().find_map(|count| {
        let found = Seek(&steps[..count]).deserialize(serde_yaml_ng::Deserializer::from_str(text));
        found
            .err()
            .filter(|e| e.to_string().contains(FOUND))?
            .location()
            .map(|at| at.line())
    })
}

/// What [`Seek`] reports a field by: the parser adds to an error where it was.
const FOUND: &str = "the field sought";

/// Goes down a document to a field, and fails there.
struct Seek<'a>(&'a [&'a str]);

impl<'de> DeserializeSeed<'de> for Seek<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Seek<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a field")
    }

    fn visit_bool<E: de::Error>(self, _: bool) -> Result<(), E> {
        Err(E::custom(FOUND))
    }

    fn visit_i64<E: de::Error>(self, _: i64) -> Result<(), E> {
        Err(E::custom(FOUND))
    }

    fn visit_u64<E: de::Error>(self, _: u64) -> Result<(), E> {
        Err(E::custom(FOUND))
    }

    fn visit_f64<E: de::Error>(self, _: f64) -> Result<(), E> {
        Err(E::custom(FOUND))
    }

    fn visit_str<E: de::Error>(self, _: &str) -> Result<(), E> {
        Err(E::custom(FOUND))
    }

    fn visit_unit<E: de::Error>(self) -> Result<(), E> {
        Err(E::custom(FOUND))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<(), A::Error> {
        let Some((first, rest)) = self.0.split_first() else {
            return Err(de::Error::custom(FOUND));
        };
        while let Some(key) = map.next_key::<String>()? {
            if key == *first {
                return map.next_value_seed(Seek(rest));
            }
            map.next_value::<IgnoredAny>()?;
        }
        Ok(())
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<(), A::Error> {
        let Some((first, rest)) = self.0.split_first() else {
            return Err(de::Error::custom(FOUND));
        };
        let index: usize = first.parse().unwrap_or(usize::MAX);
        for _ in 0..index {
            if seq.next_element::<IgnoredAny>()?.is_none() {
                return Ok(());
            }
        }
        seq.next_element_seed(Seek(rest)).map(|_| ())
    }
}

impl Placement {
    /// Corners of the module's footprint in the world, in order round it.
    pub fn area(&self) -> [Point2<f64>; 4] {
        let half = self.module.footprint_m() / 2.0;
        [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
            .map(|(x, y)| self.anchor * Point2::new(x * half.x, y * half.y))
    }
}

fn corners(workspace: &Workspace) -> [Point2<f64>; 4] {
    let size = Vector2::new(workspace.cols as f64, workspace.rows as f64) * workspace.pixel_size_m;
    let (from, to) = (workspace.origin_m, workspace.origin_m + size);
    [
        (from.x, from.y),
        (to.x, from.y),
        (to.x, to.y),
        (from.x, to.y),
    ]
    .map(|(x, y)| Point2::new(x, y))
}

/// For people: how far a rectangle goes along x and y.
fn extent(area: &[Point2<f64>; 4]) -> String {
    let low = area.iter().fold(area[0], |low, p| low.inf(p));
    let high = area.iter().fold(area[0], |high, p| high.sup(p));
    format!(
        "x {:.3} to {:.3}, y {:.3} to {:.3} m",
        low.x, high.x, low.y, high.y
    )
}

/// Whether two rectangles overlap: no edge of either separates them.
fn overlap(a: &[Point2<f64>; 4], b: &[Point2<f64>; 4]) -> bool {
    // Neighbours may touch; rounding must not make that an overlap.
    const TOUCHING_M: f64 = 1e-9;
    let separated = |a: &[Point2<f64>; 4], b: &[Point2<f64>; 4]| {
        (0..4).any(|i| {
            let (from, to) = (a[i], a[(i + 1) % 4]);
            let outward = Vector2::new(to.y - from.y, from.x - to.x).normalize();
            b.iter().all(|p| (p - from).dot(&outward) >= -TOUCHING_M)
        })
    };
    !separated(a, b) && !separated(b, a)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn error(text: &str) -> String {
        Problem::parse("test", text).unwrap_err()
    }

    #[test]
    fn an_error_names_the_module_and_the_field() {
        assert!(error("modules: []").contains("at least one"));
        assert!(error("modules: 3").contains("modules"));
        let e = error("modules: [{name: placing, anchor: {x_m: 0.5}}]");
        assert!(e.contains("modules[0].anchor") && e.contains("y_m"), "{e}");
        let e = error("modules: [{name: juggling, anchor: {x_m: 0.5, y_m: 0}}]");
        assert!(e.contains("juggling") && e.contains("placing"), "{e}");
        let e = error("modules: [{name: placing, anchor: {x_m: .nan, y_m: 0}}]");
        assert!(e.contains("anchor.x_m"), "{e}");
        let e = error("modules: [{name: placing, anchor: {x_m: 0.5, y_m: 0}, colour: red}]");
        assert!(e.contains("colour"), "{e}");
        let e = error(
            "modules: [{name: placing, anchor: {x_m: 0.5, y_m: 0}, parameters: {tolerance: 1}}]",
        );
        assert!(
            e.contains("modules[0].parameters") && e.contains("tolerance"),
            "{e}"
        );
        let e =
            error("modules: [{name: routing, anchor: {x_m: 0.5, y_m: 0}, parameters: {pegs: 3}}]");
        assert!(e.contains("parameters.pegs: "), "{e}");
        let e = error(
            "modules: [{name: placing, anchor: {x_m: 0.5, y_m: 0}, parameters: {tolerance_m: 0.5}}]",
        );
        assert!(e.contains("tolerance_m") && e.contains("0.03"), "{e}");
    }

    #[test]
    fn modules_stay_on_the_table_and_off_each_other() {
        let e = error("modules: [{name: placing, anchor: {x_m: 0.3, y_m: 0}}]");
        assert!(
            e.contains("takes x 0.090 to 0.510, y -0.200 to 0.200 m")
                && e.contains("workspace, x 0.250 to 0.750, y -0.500 to 0.500 m"),
            "{e}"
        );
        let two = |y: f64| {
            format!(
                "modules: [{{name: placing, anchor: {{x_m: 0.5, y_m: 0}}}},
                           {{name: placing, anchor: {{x_m: 0.5, y_m: {y}, yaw_rad: 0.1}}}}]"
            )
        };
        let e = error(&two(0.2));
        assert!(
            e.contains("modules[1] (placing): takes")
                && e.contains("overlaps modules[0] (placing), x 0.290 to 0.710"),
            "{e}"
        );
    }

    #[test]
    fn rectangles_that_touch_do_not_overlap() {
        let square = |x: f64, yaw: f64| {
            let pose = Isometry2::new(Vector2::new(x, 0.0), yaw);
            [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
                .map(|(x, y)| pose * Point2::new(x, y))
        };
        assert!(overlap(&square(0.0, 0.0), &square(1.9, 0.0)));
        assert!(!overlap(&square(0.0, 0.0), &square(2.0, 0.0)));
        let eighth = std::f64::consts::FRAC_PI_4;
        assert!(overlap(&square(0.0, 0.0), &square(2.3, eighth)));
        assert!(!overlap(&square(0.0, 0.0), &square(2.45, eighth)));
    }

    #[test]
    fn a_problem_name_is_no_path() {
        let e = Problem::load(Path::new("."), "../placing").unwrap_err();
        assert!(e.to_string().contains("no problem name"), "{e}");
    }
}
