//! What the parameters of *arranging* in a problem file say.

use crate::colors;
use serde::de::{Error, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::f64::consts::PI;
use std::fmt;

/// The module's parameters: which objects there are, where they start, and where they belong.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Arranging {
    /// Edge lengths along x and y of the area about the anchor that everything keeps to, in m.
    pub area_m: [f64; 2],
    /// What is bolted to the table.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub fixtures: Vec<Fixture>,
    /// What is to be moved.
    pub objects: Vec<Object>,
    /// Where objects start that do not say so themselves.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<Start>,
    /// Where objects belong, one reward each. Without goals the scene is one to be taught in: it is never complete.
    #[serde(default)]
    pub goals: Vec<Goal>,
    /// How far an object may be from its goal in the plane, in m.
    #[serde(default = "tolerance_m")]
    pub tolerance_m: f64,
    /// How far it may be turned from its goal, in rad. Turns that make it look the same do not count.
    #[serde(default = "yaw_tolerance_rad")]
    pub yaw_tolerance_rad: f64,
    /// The demonstrator picks within this distance of the middle of an object's top, in m.
    #[serde(default = "pick_spread_m")]
    pub pick_spread_m: f64,
    /// Objects start at least so far from each other, from fixtures and from goals, in m.
    #[serde(default = "gap_m")]
    pub gap_m: f64,
}

fn tolerance_m() -> f64 {
    0.01
}

fn yaw_tolerance_rad() -> f64 {
    0.26
}

fn pick_spread_m() -> f64 {
    0.003
}

fn gap_m() -> f64 {
    0.012
}

/// Something bolted to the table.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Fixture {
    /// Its name.
    pub name: String,
    /// Its geometry.
    pub shape: ShapeDescription,
    /// Its colour.
    #[serde(default = "plate")]
    pub color: Color,
    /// Where it stands in the module's frame.
    pub at: Place,
}

fn plate() -> Color {
    Color::Rgb(colors::PLATE)
}

/// One object, or several of which any will do.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Object {
    /// Its name.
    pub name: String,
    /// Its geometry.
    pub shape: ShapeDescription,
    /// Its colour.
    pub color: Color,
    /// Its mass.
    #[serde(default = "mass_kg")]
    pub mass_kg: f64,
    /// How many there are; any of them will do for a goal.
    #[serde(default = "one")]
    pub count: usize,
    /// Where it starts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<Start>,
}

fn mass_kg() -> f64 {
    0.02
}

fn one() -> usize {
    1
}

/// Where objects start: anywhere in a region, or on some of a number of poses.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Start {
    /// A region of the module's frame.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub region: Option<Place>,
    /// Poses in the module's frame.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub poses: Vec<Place>,
}

/// Where an object belongs.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Goal {
    /// Its name [default: that of the object].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// The object that belongs here.
    pub object: String,
    /// The fixture, or the goal of another object, that it stands on [default: the table].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub on: Option<String>,
    /// The fixture or goal beside which it stands on the table, instead of on it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub beside: Option<String>,
    /// Where, in the frame of what it stands on or beside.
    #[serde(default)]
    pub at: Place,
    /// Goals that have to be reached before; the one that it stands on or beside always has to be.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub after: Vec<String>,
    /// Goals of the same group exchange their objects at random in each scene.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exchange: Option<String>,
    /// Instead of the module's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tolerance_m: Option<f64>,
    /// Instead of the module's; more than half a turn: any yaw will do.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub yaw_tolerance_rad: Option<f64>,
}

impl Goal {
    /// Its name.
    pub fn name(&self) -> &str {
        self.name.as_deref().unwrap_or(&self.object)
    }
}

/// Geometry of a body; lengths in m.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum ShapeDescription {
    /// A box.
    Cuboid {
        /// Edge lengths along x, y and z.
        size_m: [f64; 3],
    },
    /// An upright cylinder.
    Cylinder {
        /// Radius.
        radius_m: f64,
        /// Height.
        height_m: f64,
    },
    /// A bar along x with another one at its lower end along y.
    L {
        /// Along x.
        length_m: f64,
        /// Along y.
        width_m: f64,
        /// Width of the bars.
        bar_m: f64,
        /// Height.
        height_m: f64,
    },
    /// A bar along x with another one at its middle along -y.
    T {
        /// Along x.
        length_m: f64,
        /// Along y.
        width_m: f64,
        /// Width of the bars.
        bar_m: f64,
        /// Height.
        height_m: f64,
    },
    /// Boxes that are one body.
    Compound {
        /// The boxes.
        cuboids: Vec<Cuboid>,
    },
}

/// A box of a compound body.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Cuboid {
    /// Edge lengths.
    pub size_m: [f64; 3],
    /// Middle of its underside.
    pub at_m: [f64; 3],
    /// Its turn about z.
    #[serde(default)]
    pub yaw_rad: f64,
}

/// A pose in the plane; each coordinate a number or a range to draw from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct Place {
    /// Along x.
    pub x_m: Range,
    /// Along y.
    pub y_m: Range,
    /// Turn about z.
    pub yaw_rad: Range,
}

/// A number, or what it is drawn from: `[least, most]`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Range {
    /// Least.
    pub least: f64,
    /// Most.
    pub most: f64,
}

impl From<f64> for Range {
    fn from(value: f64) -> Self {
        Self {
            least: value,
            most: value,
        }
    }
}

impl Serialize for Range {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if self.least == self.most {
            serializer.serialize_f64(self.least)
        } else {
            [self.least, self.most].serialize(serializer)
        }
    }
}

impl<'de> Deserialize<'de> for Range {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Bounds;

        impl<'de> Visitor<'de> for Bounds {
            type Value = Range;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a number, or [least, most]")
            }

            fn visit_f64<E: Error>(self, value: f64) -> Result<Range, E> {
                if !value.is_finite() {
                    return Err(E::custom(format!("is {value}, expected a number")));
                }
                Ok(value.into())
            }

            fn visit_i64<E: Error>(self, value: i64) -> Result<Range, E> {
                self.visit_f64(value as f64)
            }

            fn visit_u64<E: Error>(self, value: u64) -> Result<Range, E> {
                self.visit_f64(value as f64)
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<Range, A::Error> {
                let mut bounds = Vec::new();
                while let Some(bound) = seq.next_element::<f64>()? {
                    bounds.push(bound);
                }
                match bounds[..] {
                    [least, most] if least <= most && (most - least).is_finite() => {
                        Ok(Range { least, most })
                    }
                    _ => Err(A::Error::custom(format!(
                        "is {bounds:?}, expected two numbers in order"
                    ))),
                }
            }
        }
        deserializer.deserialize_any(Bounds)
    }
}

/// A colour: a name, `[red, green, blue]`, or `any`: one that nothing else in the scene has.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Color {
    /// This colour.
    Rgb([u8; 3]),
    /// Drawn anew for each scene.
    Any,
}

/// Colours that `any` draws from.
pub(super) const PALETTE: [(&str, [u8; 3]); 10] = [
    ("red", colors::RED),
    ("orange", colors::ORANGE),
    ("yellow", colors::YELLOW),
    ("green", colors::GREEN),
    ("blue", colors::BLUE),
    ("purple", colors::PURPLE),
    ("cyan", colors::CYAN),
    ("pink", colors::PINK),
    ("white", colors::WHITE),
    ("brown", colors::PEG),
];
/// Other names.
const NAMED: [(&str, [u8; 3]); 2] = [("grey", colors::GREY), ("plate", colors::PLATE)];

impl Serialize for Color {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let Self::Rgb(rgb) = self else {
            return serializer.serialize_str("any");
        };
        let name = PALETTE.iter().chain(&NAMED).find(|(_, known)| known == rgb);
        match name {
            Some((name, _)) => serializer.serialize_str(name),
            None => rgb.serialize(serializer),
        }
    }
}

impl<'de> Deserialize<'de> for Color {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Name;

        impl<'de> Visitor<'de> for Name {
            type Value = Color;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("the name of a colour, [red, green, blue] of 0 to 255, or any")
            }

            fn visit_str<E: Error>(self, name: &str) -> Result<Color, E> {
                if name == "any" {
                    return Ok(Color::Any);
                }
                let known = PALETTE.iter().chain(&NAMED);
                let found = known.clone().find(|(known, _)| *known == name);
                found.map(|(_, rgb)| Color::Rgb(*rgb)).ok_or_else(|| {
                    let names: Vec<_> = known.map(|(name, _)| *name).collect();
                    let names = names.join(", ");
                    E::custom(format!("no colour `{name}`; there are: {names}, any"))
                })
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<Color, A::Error> {
                let mut rgb = Vec::new();
                while let Some(value) = seq.next_element::<u8>()? {
                    rgb.push(value);
                }
                let rgb = <[u8; 3]>::try_from(rgb);
                rgb.map(Color::Rgb).map_err(|rgb| {
                    A::Error::custom(format!("is {rgb:?}, expected three numbers of 0 to 255"))
                })
            }
        }
        deserializer.deserialize_any(Name)
    }
}

impl ShapeDescription {
    /// Every length with its name, its least and its most.
    pub(super) fn lengths(&self) -> Vec<(String, f64, f64, f64)> {
        let size = |prefix: &str, size_m: &[f64; 3], most: f64| -> Vec<(String, f64, f64, f64)> {
            let edges = size_m.iter().enumerate();
            let lengths =
                edges.map(|(axis, edge)| (format!("{prefix}size_m[{axis}]"), *edge, 1e-3, most));
            lengths.collect()
        };
        match self {
            Self::Cuboid { size_m } => size("", size_m, 0.5),
            Self::Cylinder { radius_m, height_m } => vec![
                ("radius_m".into(), *radius_m, 5e-3, 0.25),
                ("height_m".into(), *height_m, 1e-3, 0.2),
            ],
            Self::L {
                length_m,
                width_m,
                bar_m,
                height_m,
            }
            | Self::T {
                length_m,
                width_m,
                bar_m,
                height_m,
            } => vec![
                ("bar_m".into(), *bar_m, 5e-3, length_m.min(*width_m) - 1e-3),
                ("length_m".into(), *length_m, 0.01, 0.3),
                ("width_m".into(), *width_m, 0.01, 0.3),
                ("height_m".into(), *height_m, 1e-3, 0.2),
            ],
            Self::Compound { cuboids } => {
                let mut all = vec![("cuboids: number".into(), cuboids.len() as f64, 1.0, 20.0)];
                for (index, cuboid) in cuboids.iter().enumerate() {
                    all.extend(size(&format!("cuboids[{index}]."), &cuboid.size_m, 0.5));
                    let at = cuboid.at_m.iter().enumerate();
                    all.extend(at.map(|(axis, at)| {
                        let least = if axis == 2 { 0.0 } else { -0.3 };
                        (format!("cuboids[{index}].at_m[{axis}]"), *at, least, 0.3)
                    }));
                    let yaw = (format!("cuboids[{index}].yaw_rad"), cuboid.yaw_rad, -PI, PI);
                    all.push(yaw);
                }
                all
            }
        }
    }
}
