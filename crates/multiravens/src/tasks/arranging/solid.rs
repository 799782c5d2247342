//! Rigid bodies of upright prisms: what they cover, whether they collide, how they may be turned.

use super::description::{Cuboid, ShapeDescription};
use crate::world::Component;
use nalgebra::{Isometry2, Isometry3, Matrix3, Point2, Rotation2, Translation3, Vector2, Vector3};
use std::f64::consts::{FRAC_PI_2, PI, TAU};
use ur5::Shape;

/// Corners of what stands for a circle, about it.
const CIRCLE_CORNERS: usize = 24;
/// The suction cup needs this much of a flat top about its middle.
const CUP_M: f64 = 6e-3;
/// Steps in which a top is searched for a place for the cup.
const GRIP_STEP_M: f64 = 2e-3;
/// Lengths that differ by less are the same.
const SAME_M: f64 = 1e-4;
/// Bodies that touch share this much of their height at most.
const TOUCH_M: f64 = 5e-4;
/// Both ways to turn a body by half of what makes it look the same are as long: up to this much
/// beyond, it is turned the positive way.
const TIE_RAD: f64 = 0.1;

/// A vertical prism.
#[derive(Clone, Debug)]
struct Prism {
    /// Convex, anticlockwise.
    outline: Vec<Point2<f64>>,
    low_m: f64,
    high_m: f64,
}

/// Turns that make a body look the same.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Symmetry {
    /// A cylinder.
    Round,
    /// A cuboid of these edge lengths: it may also lie on another side.
    Cuboid(Vector3<f64>),
    /// Looks the same so many times in a turn about z, one way up.
    Turns(u32),
}

/// A rigid body as described; its frame is at the centre of its bounding box.
#[derive(Clone, Debug)]
pub(super) struct Solid {
    /// What it is made of.
    pub(super) components: Vec<Component>,
    /// Edge lengths of the bounding box.
    pub(super) size_m: Vector3<f64>,
    /// Where the suction cup takes it: over the centre of mass, or on the flat top nearest to that.
    pub(super) grip: Point2<f64>,
    prisms: Vec<Prism>,
    symmetry: Symmetry,
}

/// A [`Solid`] that stands upright somewhere.
#[derive(Clone, Debug)]
pub(super) struct Standing<'a> {
    pub(super) solid: &'a Solid,
    /// Pose of the body's frame in the plane.
    pub(super) pose: Isometry2<f64>,
    /// Height of its underside.
    pub(super) base_m: f64,
}

impl Solid {
    /// The body of a description, whose lengths are checked.
    pub(super) fn new(description: &ShapeDescription) -> Self {
        let upright = |shape: Shape, at: [f64; 2], low_m: f64, height_m: f64, yaw_rad: f64| {
            let yaw = nalgebra::UnitQuaternion::from_euler_angles(0.0, 0.0, yaw_rad);
            let at = Translation3::new(at[0], at[1], low_m + height_m / 2.0);
            Component {
                shape,
                pose: Isometry3::from_parts(at, yaw),
            }
        };
        let cuboid = |cuboid: &Cuboid| {
            let size_m = Vector3::from(cuboid.size_m);
            let [x, y, low_m] = cuboid.at_m;
            upright(
                Shape::Cuboid { size_m },
                [x, y],
                low_m,
                size_m.z,
                cuboid.yaw_rad,
            )
        };
        let bar = |size: [f64; 2], at: [f64; 2], height_m: f64| {
            let size_m = Vector3::new(size[0], size[1], height_m);
            upright(Shape::Cuboid { size_m }, at, 0.0, height_m, 0.0)
        };
        let components = match description {
            ShapeDescription::Cuboid { size_m } => {
                vec![bar([size_m[0], size_m[1]], [0.0; 2], size_m[2])]
            }
            ShapeDescription::Cylinder { radius_m, height_m } => {
                let shape = Shape::Cylinder {
                    radius_m: *radius_m,
                    length_m: *height_m,
                };
                vec![upright(shape, [0.0; 2], 0.0, *height_m, 0.0)]
            }
            ShapeDescription::L {
                length_m,
                width_m,
                bar_m,
                height_m,
            } => vec![
                bar(
                    [*length_m, *bar_m],
                    [length_m / 2.0, bar_m / 2.0],
                    *height_m,
                ),
                bar(
                    [*bar_m, width_m - bar_m],
                    [bar_m / 2.0, (width_m + bar_m) / 2.0],
                    *height_m,
                ),
            ],
            ShapeDescription::T {
                length_m,
                width_m,
                bar_m,
                height_m,
            } => vec![
                bar([*length_m, *bar_m], [0.0, width_m - bar_m / 2.0], *height_m),
                bar(
                    [*bar_m, width_m - bar_m],
                    [0.0, (width_m - bar_m) / 2.0],
                    *height_m,
                ),
            ],
            ShapeDescription::Compound { cuboids } => cuboids.iter().map(cuboid).collect(),
        };
        Self::centred(components)
    }

    fn centred(mut components: Vec<Component>) -> Self {
        let mut prisms: Vec<Prism> = components.iter().map(Prism::new).collect();
        let corners = || prisms.iter().flat_map(|prism| &prism.outline);
        let low = corners().fold(Vector2::repeat(f64::INFINITY), |low, p| low.inf(&p.coords));
        let high = corners().fold(Vector2::repeat(f64::NEG_INFINITY), |high, p| {
            high.sup(&p.coords)
        });
        let low_m = prisms.iter().map(|p| p.low_m).fold(f64::INFINITY, f64::min);
        let high_m = prisms
            .iter()
            .map(|p| p.high_m)
            .fold(f64::NEG_INFINITY, f64::max);
        let centre = (low + high) / 2.0;
        for prism in &mut prisms {
            prism.outline.iter_mut().for_each(|p| *p -= centre);
            prism.low_m -= low_m;
            prism.high_m -= low_m;
        }
        let middle = Vector3::new(centre.x, centre.y, (low_m + high_m) / 2.0);
        for component in &mut components {
            component.pose.translation.vector -= middle;
        }
        let mut span = high - low;
        if let [single] = &mut components[..]
            && let Shape::Cylinder { radius_m, .. } = single.shape
        {
            // Not of the corners of what stands for a circle.
            span = Vector2::repeat(2.0 * radius_m);
            single.pose = Isometry3::identity();
        }
        let size_m = Vector3::new(span.x, span.y, high_m - low_m);
        let symmetry = match components[..] {
            [
                Component {
                    shape: Shape::Cylinder { .. },
                    ..
                },
            ] => Symmetry::Round,
            [
                Component {
                    shape: Shape::Cuboid { size_m },
                    pose,
                },
            ] if pose.rotation.angle() < 1e-9 => Symmetry::Cuboid(size_m),
            _ => Symmetry::Turns(
                [4, 2]
                    .into_iter()
                    .find(|n| looks_same(&prisms, *n))
                    .unwrap_or(1),
            ),
        };
        let grip = grip(&components, &prisms);
        Self {
            components,
            size_m,
            grip,
            prisms,
            symmetry,
        }
    }

    /// Pose of the body's frame when it stands upright.
    pub(super) fn pose(&self, at: &Isometry2<f64>, base_m: f64) -> Isometry3<f64> {
        crate::tasks::at_height(at, base_m + self.size_m.z / 2.0)
    }

    /// Whether the body, turned by a rotation, looks as it does upright with no yaw.
    pub(super) fn looks_upright(&self, turned: &Matrix3<f64>, tilt_rad: f64, yaw_rad: f64) -> bool {
        let (up, along) = (turned.row(2), turned.row(0));
        match self.symmetry {
            Symmetry::Round => up[2].abs() > tilt_rad.cos(),
            Symmetry::Turns(count) => {
                let part = TAU / f64::from(count);
                let yaw = turned[(1, 0)].atan2(turned[(0, 0)]);
                let off = (yaw + part / 2.0).rem_euclid(part) - part / 2.0;
                up[2] > tilt_rad.cos() && off.abs() < yaw_rad
            }
            Symmetry::Cuboid(size_m) => {
                let same =
                    |axis: usize, as_axis: usize| (size_m[axis] - size_m[as_axis]).abs() < SAME_M;
                let vertical = up.iter().map(|c| c.abs()).enumerate();
                let vertical = vertical.max_by(|a, b| a.1.total_cmp(&b.1));
                let Some((vertical, cosine)) = vertical else {
                    return false;
                };
                let mut others = (0..3).filter(|axis| *axis != vertical && same(*axis, 0));
                cosine > tilt_rad.cos()
                    && same(vertical, 2)
                    && others.any(|axis| along[axis].abs() > yaw_rad.cos())
            }
        }
    }

    /// The smallest turn about z after which the body has the yaw of a goal, or looks as if it had.
    pub(super) fn turn_rad(&self, turned: &Matrix3<f64>, goal_yaw_rad: f64) -> f64 {
        let (yaw_rad, part) = match self.symmetry {
            Symmetry::Round => return 0.0,
            Symmetry::Turns(count) => {
                (turned[(1, 0)].atan2(turned[(0, 0)]), TAU / f64::from(count))
            }
            Symmetry::Cuboid(size_m) => {
                // Of the axes that lie flat, one that is as long as x.
                let flat = (0..3).filter(|axis| (size_m[*axis] - size_m.x).abs() < SAME_M);
                let flat = flat.min_by(|a, b| {
                    let rise = |axis: usize| turned[(2, axis)].abs();
                    rise(*a).total_cmp(&rise(*b))
                });
                let axis = turned.column(flat.unwrap_or(0));
                let square = (size_m.x - size_m.y).abs() < SAME_M;
                (axis[1].atan2(axis[0]), if square { FRAC_PI_2 } else { PI })
            }
        };
        let half = part / 2.0;
        (goal_yaw_rad - yaw_rad + half - TIE_RAD).rem_euclid(part) - half + TIE_RAD
    }
}

impl Standing<'_> {
    /// Height of its top.
    pub(super) fn top_m(&self) -> f64 {
        self.base_m + self.solid.size_m.z
    }

    /// Corners of all its outlines.
    pub(super) fn corners(&self) -> impl Iterator<Item = Point2<f64>> + '_ {
        let corners = self.solid.prisms.iter().flat_map(|prism| &prism.outline);
        corners.map(move |p| self.pose * p)
    }

    /// Where the suction cup takes it.
    pub(super) fn grip(&self) -> Point2<f64> {
        self.pose * self.solid.grip
    }

    /// Height of its top at a point; none beside it.
    pub(super) fn top_at_m(&self, point: &Point2<f64>) -> Option<f64> {
        let local = self.pose.inverse_transform_point(point);
        let under = self.solid.prisms.iter().filter(|p| p.holds(&local, 0.0));
        under
            .map(|prism| self.base_m + prism.high_m)
            .reduce(f64::max)
    }

    /// Whether two bodies come closer than a gap beside each other. Bodies on top of each other do not.
    pub(super) fn collides(&self, other: &Standing<'_>, gap_m: f64) -> bool {
        self.meets(other, gap_m, |a, b| {
            a.0 < b.1 - TOUCH_M && b.0 < a.1 - TOUCH_M
        })
    }

    /// Whether two bodies come closer than a gap, seen from above.
    pub(super) fn covers(&self, other: &Standing<'_>, gap_m: f64) -> bool {
        self.meets(other, gap_m, |_, _| true)
    }

    fn meets(
        &self,
        other: &Standing<'_>,
        gap_m: f64,
        share_height: impl Fn((f64, f64), (f64, f64)) -> bool,
    ) -> bool {
        let outlines = |standing: &Standing<'_>| -> Vec<_> {
            let prisms = standing.solid.prisms.iter();
            let placed = prisms.map(|prism| {
                let outline: Vec<_> = prism.outline.iter().map(|p| standing.pose * p).collect();
                let heights = (
                    standing.base_m + prism.low_m,
                    standing.base_m + prism.high_m,
                );
                (outline, heights)
            });
            placed.collect()
        };
        let others = outlines(other);
        outlines(self).iter().any(|(outline, heights)| {
            others.iter().any(|(other, other_heights)| {
                share_height(*heights, *other_heights) && !apart(outline, other, gap_m)
            })
        })
    }
}

impl Prism {
    fn new(component: &Component) -> Self {
        let (_, _, yaw_rad) = component.pose.rotation.euler_angles();
        let at = component.pose.translation.vector;
        let pose = Isometry2::new(at.xy(), yaw_rad);
        let (outline, height_m): (Vec<_>, _) = match component.shape {
            Shape::Cuboid { size_m } => {
                let half = size_m / 2.0;
                let corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];
                let corners = corners.map(|(x, y)| Point2::new(x * half.x, y * half.y));
                (corners.to_vec(), size_m.z)
            }
            Shape::Cylinder { radius_m, length_m } => (circle(radius_m), length_m),
            Shape::Sphere { radius_m } => (circle(radius_m), 2.0 * radius_m),
        };
        Self {
            outline: outline.iter().map(|p| pose * p).collect(),
            low_m: at.z - height_m / 2.0,
            high_m: at.z + height_m / 2.0,
        }
    }

    /// Whether a point lies this far within the outline.
    fn holds(&self, point: &Point2<f64>, margin_m: f64) -> bool {
        edges(&self.outline).all(|(from, outward)| (point - from).dot(&outward) <= -margin_m)
    }
}

/// A regular polygon about a circle round the origin.
fn circle(radius_m: f64) -> Vec<Point2<f64>> {
    let step = TAU / CIRCLE_CORNERS as f64;
    let out = radius_m / (step / 2.0).cos();
    let corner = |index: usize| Rotation2::new(index as f64 * step) * Point2::new(out, 0.0);
    (0..CIRCLE_CORNERS).map(corner).collect()
}

/// The edges of a convex polygon: a point on each, and its outward unit normal.
fn edges(outline: &[Point2<f64>]) -> impl Iterator<Item = (Point2<f64>, Vector2<f64>)> + '_ {
    let next = outline.iter().cycle().skip(1);
    outline.iter().zip(next).map(|(from, to)| {
        let along = to - from;
        (*from, Vector2::new(along.y, -along.x).normalize())
    })
}

/// Whether an edge of one of two convex polygons separates them by a gap.
fn apart(a: &[Point2<f64>], b: &[Point2<f64>], gap_m: f64) -> bool {
    let separates = |a: &[Point2<f64>], b: &[Point2<f64>]| {
        // Neighbours may touch; rounding must not make that a collision.
        edges(a).any(|(from, outward)| b.iter().all(|p| (p - from).dot(&outward) >= gap_m - 1e-9))
    };
    separates(a, b) || separates(b, a)
}

/// Whether prisms look the same after a part of a turn about the origin.
fn looks_same(prisms: &[Prism], parts: u32) -> bool {
    let turn = Rotation2::new(TAU / f64::from(parts));
    let same = |a: &Prism, b: &Prism| {
        let near = |p: &Point2<f64>| b.outline.iter().any(|q| (turn * p - q).norm() < SAME_M);
        (a.low_m - b.low_m).abs() < SAME_M
            && (a.high_m - b.high_m).abs() < SAME_M
            && a.outline.len() == b.outline.len()
            && a.outline.iter().all(near)
    };
    prisms.iter().all(|a| prisms.iter().any(|b| same(a, b)))
}

/// The point of a flat top, with room for the cup, that is nearest to the centre of mass.
fn grip(components: &[Component], prisms: &[Prism]) -> Point2<f64> {
    let volume = |component: &Component| match component.shape {
        Shape::Cuboid { size_m } => size_m.product(),
        Shape::Cylinder { radius_m, length_m } => PI * radius_m * radius_m * length_m,
        Shape::Sphere { radius_m } => 4.0 / 3.0 * PI * radius_m.powi(3),
    };
    let total: f64 = components.iter().map(volume).sum();
    let weighted = components
        .iter()
        .map(|c| c.pose.translation.vector * volume(c));
    let mass = weighted.sum::<Vector3<f64>>().xy() / total;
    // With room for the cup on this prism, and nothing higher near it.
    let is_top = |p: &Point2<f64>| {
        prisms.iter().any(|top| {
            top.holds(p, CUP_M)
                && prisms
                    .iter()
                    .all(|other| other.high_m <= top.high_m + SAME_M || !other.holds(p, -CUP_M))
        })
    };
    let mut near: Option<(f64, Point2<f64>)> = None;
    let mut consider = |p: Point2<f64>| {
        let off = (p.coords - mass).norm();
        if near.is_none_or(|(least, _)| off < least) && is_top(&p) {
            near = Some((off, p));
        }
    };
    consider(mass.into());
    for prism in prisms {
        let low = prism
            .outline
            .iter()
            .fold(prism.outline[0], |low, p| low.inf(p));
        let high = prism
            .outline
            .iter()
            .fold(prism.outline[0], |high, p| high.sup(p));
        let counts = ((high - low) / GRIP_STEP_M).map(|count| count.ceil() as usize);
        for col in 0..=counts.x {
            for row in 0..=counts.y {
                consider(low + Vector2::new(col as f64, row as f64) * GRIP_STEP_M);
            }
        }
    }
    // No top has room for the cup: over the centre of mass as well as anywhere.
    near.map_or(mass.into(), |(_, p)| p)
}
