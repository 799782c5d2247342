//! Problems of *arranging* at random: the training ground for tasks that nobody has described yet.

use super::Arrangement;
use super::description::{
    Arranging, Color, Fixture, Goal, Object, PALETTE, Place, Range, ShapeDescription, Start,
};
use crate::colors;
use crate::seed::stream;
use crate::tasks::{ParameterError, TaskModule, check_range, field, read};
use nalgebra::{Isometry2, Vector2};
use rand::RngExt;
use rand::seq::IndexedRandom as _;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use serde_yaml_ng::Value;
use std::f64::consts::PI;
use std::path::Path;

/// Stream of the seed's random numbers that problems are drawn from.
const STREAM: u64 = 1 << 34;
/// Problems drawn before none is found that can be solved.
const DRAWS: usize = 400;
/// A tower is at most so high.
const TOWER_M: f64 = 0.13;
/// A fixture that objects stand on keeps this free along its edge.
const EDGE_M: f64 = 0.03;
/// Where fixtures and goals on the table are drawn from for each scene: so far about a place, ...
const JITTER_M: f64 = 0.015;
/// ... and turned by at most this.
const JITTER_RAD: f64 = 0.25;
/// Objects of one colour and kind differ by this in at least one edge, ...
const APART_M: f64 = 0.006;
/// ... if so many draws find one that does.
const SHAPE_DRAWS: usize = 50;

/// What problems are drawn from; ranges are `[least, most]`.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ranges {
    /// Place of the area's middle on the table, in m.
    pub anchor_m: [f64; 2],
    /// Edge lengths of the area along x and y, in m.
    pub area_m: [f64; 2],
    /// Number of goals.
    pub goals: [usize; 2],
    /// Objects more than there are goals for.
    pub extra_objects: [usize; 2],
    /// Number of fixtures.
    pub fixtures: [usize; 2],
    /// How often each kind of shape comes, relative to the others.
    pub kinds: Kinds,
    /// Edge lengths and diameters in the plane, in m.
    pub size_m: [f64; 2],
    /// Heights, in m.
    pub height_m: [f64; 2],
    /// Edge lengths of fixtures in the plane, in m.
    pub fixture_m: [f64; 2],
    /// Share of objects that come twice or three times.
    pub repeated: f64,
    /// Share of goals on a fixture, where there is one.
    pub on_fixture: f64,
    /// Share of goals on another object, where one has room.
    pub stacked: f64,
    /// Share of goals that have to come after another one.
    pub ordered: f64,
    /// Share of problems in which the objects of the goals change places from scene to scene.
    pub exchanged: f64,
    /// Share of problems whose objects have one to three colours between them, so that shape and size tell them apart.
    pub shared_colors: f64,
}

/// Relative frequencies of kinds of shapes.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct Kinds {
    pub cuboid: f64,
    pub cylinder: f64,
    pub l: f64,
    pub t: f64,
}

/// Why no problem comes of ranges.
#[derive(Debug, thiserror::Error)]
pub enum GenerateError {
    /// The file of ranges cannot be read.
    #[error("{file}: {reason}")]
    File {
        /// The file.
        file: String,
        /// The reason.
        reason: String,
    },
    /// Ranges that nothing fits in.
    #[error("seed {seed}: none of {DRAWS} problems drawn can be solved; the last one: {source}")]
    Crowded {
        /// The seed.
        seed: u64,
        /// What was wrong with the last one.
        source: ParameterError,
    },
    /// The problem cannot be written as YAML.
    #[error(transparent)]
    Yaml(#[from] serde_yaml_ng::Error),
}

#[derive(Serialize)]
struct File<'a> {
    modules: [Entry<'a>; 1],
}

#[derive(Serialize)]
struct Entry<'a> {
    name: &'static str,
    anchor: Anchor,
    parameters: &'a Arranging,
}

#[derive(Serialize)]
struct Anchor {
    x_m: f64,
    y_m: f64,
}

impl Ranges {
    /// Reads a YAML file.
    ///
    /// # Errors
    /// When it cannot be read, or a value is out of range: named with its field.
    pub fn load(file: &Path) -> Result<Self, GenerateError> {
        let fail = |reason: String| GenerateError::File {
            file: file.display().to_string(),
            reason,
        };
        let text = std::fs::read_to_string(file).map_err(|error| fail(error.to_string()))?;
        let value: Value = serde_yaml_ng::from_str(&text).map_err(|e| fail(e.to_string()))?;
        let ranges: Self = read(value).map_err(|error| fail(error.to_string()))?;
        ranges.check().map_err(|error| fail(error.to_string()))?;
        Ok(ranges)
    }

    fn check(&self) -> Result<(), ParameterError> {
        let lengths = [
            ("size_m", self.size_m, 0.015, 0.12),
            ("height_m", self.height_m, 5e-3, 0.08),
            ("fixture_m", self.fixture_m, 0.04, 0.3),
            ("area_m", self.area_m, 0.1, 1.0),
        ];
        for (name, values, least, most) in lengths {
            for value in values {
                check_range(name, value, least, most)?;
            }
        }
        let counts = [
            ("goals", self.goals, 1),
            ("extra_objects", self.extra_objects, 0),
            ("fixtures", self.fixtures, 0),
        ];
        let ordered = [
            ("size_m", self.size_m),
            ("height_m", self.height_m),
            ("fixture_m", self.fixture_m),
        ];
        for (name, [least, most]) in ordered {
            if least > most {
                return Err(field(
                    name,
                    format!("is [{least}, {most}], expected [least, most]"),
                ));
            }
        }
        for (name, [least, most], at_least) in counts {
            check_range(name, least as f64, f64::from(at_least), 20.0)?;
            check_range(name, most as f64, least as f64, 20.0)?;
        }
        let shares = [
            ("repeated", self.repeated),
            ("on_fixture", self.on_fixture),
            ("stacked", self.stacked),
            ("ordered", self.ordered),
            ("exchanged", self.exchanged),
            ("shared_colors", self.shared_colors),
        ];
        for (name, share) in shares {
            check_range(name, share, 0.0, 1.0)?;
        }
        let Kinds {
            cuboid,
            cylinder,
            l,
            t,
        } = self.kinds;
        for (name, weight) in [
            ("cuboid", cuboid),
            ("cylinder", cylinder),
            ("l", l),
            ("t", t),
        ] {
            check_range(&format!("kinds.{name}"), weight, 0.0, 1e3)?;
        }
        check_range("kinds: sum", cuboid + cylinder + l + t, 1e-3, 1e4)
    }

    /// The text of the problem file of a seed. Every problem can be drawn, stands and is within the arm's
    /// reach.
    ///
    /// # Errors
    /// When no such problem is found.
    pub fn generate(&self, seed: u64) -> Result<String, GenerateError> {
        let mut rng = stream(seed, STREAM);
        let [x_m, y_m] = self.anchor_m;
        let anchor = Isometry2::new(Vector2::new(x_m, y_m), 0.0);
        let mut last = field("", "nothing was drawn".into());
        for _ in 0..DRAWS {
            let drawn = self.draw(&mut rng);
            match Arrangement::new(drawn.clone()).and_then(|problem| problem.check(&anchor)) {
                Ok(()) => {
                    let modules = [Entry {
                        name: "arranging",
                        anchor: Anchor { x_m, y_m },
                        parameters: &drawn,
                    }];
                    return Ok(serde_yaml_ng::to_string(&File { modules })?);
                }
                Err(error) => last = error,
            }
        }
        Err(GenerateError::Crowded { seed, source: last })
    }

    fn draw(&self, rng: &mut ChaCha8Rng) -> Arranging {
        let fixtures = self.draw_fixtures(rng);
        let wanted = count(self.goals, rng);
        let total = wanted + count(self.extra_objects, rng);
        let colors = self.draw_colors(rng);
        let mut objects: Vec<Object> = Vec::new();
        let mut names = Vec::new();
        while names.len() < total {
            let more = if rng.random_bool(self.repeated) {
                rng.random_range(1..3)
            } else {
                0
            };
            let count = (1 + more).min(total - names.len());
            let color = colors[rng.random_range(0..colors.len())];
            let object = Object {
                name: format!("object {}", objects.len() + 1),
                shape: self.draw_other_shape(&objects, &color, rng),
                color,
                mass_kg: 0.02,
                count,
                start: None,
            };
            names.extend(std::iter::repeat_n(objects.len(), count));
            objects.push(object);
        }
        let exchange = rng.random_bool(self.exchanged).then(|| "all".to_owned());
        let mut goals: Vec<Goal> = Vec::new();
        // Height of the top of each goal so far, and whether something stands on it.
        let mut tops: Vec<(f64, bool)> = Vec::new();
        // Extra objects come last: those of the last names have no goal.
        for (index, object) in names.into_iter().take(wanted).enumerate() {
            let shape = &objects[object].shape;
            let below = (0..index).find(|below| {
                let (top_m, taken) = tops[*below];
                let support = objects.iter().find(|o| o.name == goals[*below].object);
                let wide = support.is_some_and(|support| carries(&support.shape, shape));
                !taken && wide && exchange.is_none() && top_m + height_m(shape) < TOWER_M
            });
            let below = below.filter(|_| rng.random_bool(self.stacked));
            let fixture = (!fixtures.is_empty() && rng.random_bool(self.on_fixture))
                .then(|| rng.random_range(0..fixtures.len()));
            let yaw_rad = Range::from(rounded(rng.random_range(-PI..PI)));
            let mut base_m = 0.0;
            let (on, at) = match (below, fixture) {
                (Some(below), _) => {
                    base_m = tops[below].0;
                    tops[below].1 = true;
                    let at = Place {
                        yaw_rad,
                        ..Place::default()
                    };
                    (Some(goals[below].name().to_owned()), at)
                }
                (None, Some(fixture)) => {
                    let size_m = size_m(&fixtures[fixture].shape);
                    base_m = size_m[2];
                    let mut along = |edge_m: f64| {
                        let most = (edge_m / 2.0 - EDGE_M).max(0.0);
                        Range::from(rounded(rng.random_range(-1.0..1.0) * most))
                    };
                    let at = Place {
                        x_m: along(size_m[0]),
                        y_m: along(size_m[1]),
                        yaw_rad,
                    };
                    (Some(fixtures[fixture].name.clone()), at)
                }
                (None, None) => (None, self.on_table(rng)),
            };
            tops.push((base_m + height_m(shape), false));
            let after = (index > 0 && rng.random_bool(self.ordered))
                .then(|| goals[rng.random_range(0..index)].name().to_owned());
            goals.push(Goal {
                name: Some(format!("goal {}", index + 1)),
                object: objects[object].name.clone(),
                on,
                beside: None,
                at,
                after: after.into_iter().collect(),
                exchange: exchange.clone(),
                tolerance_m: None,
                yaw_tolerance_rad: None,
            });
        }
        let [x, y] = self.area_m.map(|edge| edge / 2.0 - 0.02);
        let region = Place {
            x_m: Range { least: -x, most: x },
            y_m: Range { least: -y, most: y },
            yaw_rad: Range {
                least: -rounded(PI),
                most: rounded(PI),
            },
        };
        Arranging {
            area_m: self.area_m,
            fixtures,
            objects,
            start: Some(Start {
                region: Some(region),
                poses: Vec::new(),
            }),
            goals,
            tolerance_m: 0.01,
            yaw_tolerance_rad: 0.26,
            pick_spread_m: 0.003,
            gap_m: 0.012,
        }
    }

    fn draw_fixtures(&self, rng: &mut ChaCha8Rng) -> Vec<Fixture> {
        let fixtures = count(self.fixtures, rng);
        let fixture = |index: usize| {
            let [x, y] = [(); 2].map(|()| within(self.fixture_m, rng));
            let height_m = rounded(rng.random_range(3e-3..8e-3));
            let color = if rng.random_bool(0.5) {
                Color::Any
            } else {
                Color::Rgb(colors::PLATE)
            };
            Fixture {
                name: format!("fixture {}", index + 1),
                shape: ShapeDescription::Cuboid {
                    size_m: [x, y, height_m],
                },
                color,
                at: self.on_table(rng),
            }
        };
        (0..fixtures).map(fixture).collect()
    }

    /// Colours that the objects of a problem are drawn from.
    fn draw_colors(&self, rng: &mut ChaCha8Rng) -> Vec<Color> {
        if !rng.random_bool(self.shared_colors) {
            return vec![Color::Any];
        }
        let count = rng.random_range(1..=3);
        let colors = PALETTE.sample(rng, count);
        colors.map(|(_, rgb)| Color::Rgb(*rgb)).collect()
    }

    /// A shape that is told apart from those of the objects of the same colour.
    fn draw_other_shape(
        &self,
        objects: &[Object],
        color: &Color,
        rng: &mut ChaCha8Rng,
    ) -> ShapeDescription {
        let mut shape = self.draw_shape(rng);
        for _ in 0..SHAPE_DRAWS {
            let looks_like = |other: &Object| {
                *color != Color::Any && other.color == *color && are_alike(&shape, &other.shape)
            };
            if !objects.iter().any(looks_like) {
                break;
            }
            shape = self.draw_shape(rng);
        }
        shape
    }

    fn draw_shape(&self, rng: &mut ChaCha8Rng) -> ShapeDescription {
        let Kinds {
            cuboid,
            cylinder,
            l,
            t,
        } = self.kinds;
        let mut at = rng.random_range(0.0..cuboid + cylinder + l + t);
        let height_m = within(self.height_m, rng);
        let [a, b] = [(); 2].map(|()| within(self.size_m, rng));
        at -= cuboid;
        if at < 0.0 {
            // Half of them square.
            let b = if rng.random_bool(0.5) { a } else { b };
            return ShapeDescription::Cuboid {
                size_m: [a, b, height_m],
            };
        }
        at -= cylinder;
        if at < 0.0 {
            return ShapeDescription::Cylinder {
                radius_m: a / 2.0,
                height_m,
            };
        }
        // Bars wide enough for the suction cup.
        let bar_m = rounded((0.35 * a.min(b)).max(0.016));
        let (length_m, width_m) = (a.max(2.2 * bar_m), b.max(2.2 * bar_m));
        let (length_m, width_m) = (rounded(length_m), rounded(width_m));
        let height_m = height_m.min(0.025);
        if at < l {
            ShapeDescription::L {
                length_m,
                width_m,
                bar_m,
                height_m,
            }
        } else {
            ShapeDescription::T {
                length_m,
                width_m,
                bar_m,
                height_m,
            }
        }
    }

    /// A place on the table that each scene draws anew, nearby.
    fn on_table(&self, rng: &mut ChaCha8Rng) -> Place {
        let mut about = |most: f64, jitter: f64| {
            let middle = rounded(rng.random_range(-1.0..1.0) * most);
            Range {
                least: rounded(middle - jitter),
                most: rounded(middle + jitter),
            }
        };
        let [x, y] = self.area_m.map(|edge| (edge / 2.0 - 0.06).max(0.0));
        Place {
            x_m: about(x, JITTER_M),
            y_m: about(y, JITTER_M),
            yaw_rad: about(PI, JITTER_RAD),
        }
    }
}

/// To a tenth of a millimetre or milliradian: files that a person can read.
fn rounded(value: f64) -> f64 {
    (value * 1e4).round() / 1e4
}

fn within([least, most]: [f64; 2], rng: &mut ChaCha8Rng) -> f64 {
    rounded(least + (most - least) * rng.random::<f64>())
}

fn count([least, most]: [usize; 2], rng: &mut ChaCha8Rng) -> usize {
    rng.random_range(least..=most)
}

/// Whether two shapes are of one kind and nearly one size.
fn are_alike(one: &ShapeDescription, other: &ShapeDescription) -> bool {
    let same_kind = std::mem::discriminant(one) == std::mem::discriminant(other);
    let sizes = size_m(one).into_iter().zip(size_m(other));
    same_kind
        && sizes
            .into_iter()
            .all(|(one, other)| (one - other).abs() < APART_M)
}

/// Whether an object may stand on the middle of another one.
fn carries(below: &ShapeDescription, above: &ShapeDescription) -> bool {
    let flat = matches!(
        below,
        ShapeDescription::Cuboid { .. } | ShapeDescription::Cylinder { .. }
    );
    let (below, above) = (size_m(below), size_m(above));
    flat && below[0].min(below[1]) > 0.8 * above[0].max(above[1])
}

fn height_m(shape: &ShapeDescription) -> f64 {
    size_m(shape)[2]
}

/// Edge lengths of the bounding box; compounds are not drawn.
fn size_m(shape: &ShapeDescription) -> [f64; 3] {
    match shape {
        ShapeDescription::Cuboid { size_m } => *size_m,
        ShapeDescription::Cylinder { radius_m, height_m } => {
            [2.0 * radius_m, 2.0 * radius_m, *height_m]
        }
        ShapeDescription::L {
            length_m,
            width_m,
            height_m,
            ..
        }
        | ShapeDescription::T {
            length_m,
            width_m,
            height_m,
            ..
        } => [*length_m, *width_m, *height_m],
        ShapeDescription::Compound { .. } => [0.0; 3],
    }
}
