//! *arranging*: rigid objects to be brought where a problem file says, with no Rust for the problem.
//!
//! The parameters name objects and fixtures, where the objects start, where they belong, and in which
//! order (see [`description`]). A goal counts while the right object is on it and every goal that has to
//! come before it counts. Turns that make an object look the same do not matter, and of several objects
//! of one name any will do.
//!
//! Module frame: x along the table's short side when the anchor's yaw is 0; an object's frame is at the
//! centre of its bounding box.

pub mod description;
pub mod generator;
mod solid;

use super::{Demonstrator, Move, ParameterError, Task, TaskModule, check_range, field};
use crate::cell::Cell;
use crate::seed::Draws;
use crate::world::{BodyId, Mobility, Part, World};
use description::{Arranging, Color, PALETTE, Place, Range, Start};
use nalgebra::{Isometry2, Isometry3, Point2, UnitComplex, Vector2};
use pick_place::{PickPlace, PrimitiveSettings};
use rand::RngExt;
use rand::seq::{IndexedRandom, SliceRandom};
use rand_chacha::ChaCha8Rng;
use serde_yaml_ng::Value;
use solid::{Solid, Standing};
use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};
use std::sync::Arc;
use ur5::{Arm, WorkCell};

const SUCTION_FORCE_N: f64 = 5.0;
const FRICTION: f64 = 0.5;
/// Goals stand at least so far from fixtures and from each other, or placing one would push another.
const GOAL_GAP_M: f64 = 2e-3;
/// Something this close to where an object belongs is in its way.
const IN_THE_WAY_M: f64 = 1e-3;
/// An object is on its goal if its centre is this close to the height where it should be, ...
const HEIGHT_TOLERANCE_M: f64 = 3e-3;
/// ... and it stands this upright.
const TILT_TOLERANCE_RAD: f64 = 0.1;
/// An object whose underside is this far below another's top may still lie on it.
const ON_TOP_M: f64 = 3e-3;
/// Scenes, starts of a scene, and places of an object, that are drawn before drawing is given up.
const SCENE_DRAWS: usize = 200;
const START_DRAWS: usize = 40;
const PLACE_DRAWS: usize = 200;
/// Scenes drawn to check a file, and those of them in which the goals are looked at for falling over.
const CHECKED_SCENES: u64 = 6;
const SIMULATED_SCENES: u64 = 2;
const SIMULATED_STEPS: usize = 240;
/// Nothing that stands moves further than this by itself.
const STANDS_M: f64 = 3e-3;
/// What is carried passes so far above the tallest thing there is.
const OVER_M: f64 = 0.02;
/// The arm has to reach so far above the top of an object on its goal.
const RISE_M: f64 = 0.03;

/// A number that stands for a fixture or for a goal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Support {
    Fixture(usize),
    Goal(usize),
}

/// A description that makes sense, with the names resolved.
#[derive(Clone, Debug)]
pub(super) struct Arrangement {
    description: Arranging,
    fixtures: Vec<Solid>,
    objects: Arc<[Solid]>,
    /// Of each goal: its object, what it stands on or beside, and the goals before it.
    links: Vec<(usize, Option<Support>, Vec<usize>)>,
    /// The goals, those that others need first.
    order: Vec<usize>,
}

/// Where an object belongs, in the module frame.
#[derive(Clone, Debug)]
struct Goal {
    object: usize,
    pose: Isometry2<f64>,
    base_m: f64,
    needs: Vec<usize>,
    tolerance_m: f64,
    yaw_tolerance_rad: f64,
}

/// What a scene seed draws.
struct Scene {
    fixtures: Vec<Isometry2<f64>>,
    goals: Vec<Goal>,
    object_rgb: Vec<[u8; 3]>,
    fixture_rgb: Vec<[u8; 3]>,
}

/// Reads and checks the parameters.
pub(super) fn configure(parameters: Value) -> Result<Box<dyn TaskModule>, ParameterError> {
    Ok(Box::new(Arrangement::new(super::read(parameters)?)?))
}

impl Arrangement {
    fn new(description: Arranging) -> Result<Self, ParameterError> {
        check_lengths(&description)?;
        let Arranging {
            fixtures,
            objects,
            goals,
            ..
        } = &description;
        let object_names = names("objects", objects.iter().map(|object| object.name.as_str()))?;
        let goal_names = names("goals", goals.iter().map(|goal| goal.name()))?;
        let fixture_names = names("fixtures", fixtures.iter().map(|f| f.name.as_str()))?;
        let mut links = Vec::new();
        for (index, goal) in goals.iter().enumerate() {
            let at = |name: &str| format!("goals[{index}].{name}");
            let object = *object_names
                .get(goal.object.as_str())
                .ok_or_else(|| unknown(at("object"), "object", &goal.object, &object_names))?;
            let mut needs = Vec::new();
            for name in &goal.after {
                needs.push(
                    *goal_names
                        .get(name.as_str())
                        .ok_or_else(|| unknown(at("after"), "goal", name, &goal_names))?,
                );
            }
            if goal.on.is_some() && goal.beside.is_some() {
                let reason = "expected either on or beside".to_owned();
                return Err(field(at("beside"), reason));
            }
            let on = match goal.on.as_ref().or(goal.beside.as_ref()) {
                None => None,
                Some(name) => {
                    let name = name.as_str();
                    let at_name = if goal.on.is_some() { "on" } else { "beside" };
                    let fixture = fixture_names.get(name).copied().map(Support::Fixture);
                    let goal = goal_names.get(name).copied().map(Support::Goal);
                    let mut known = fixture_names.clone();
                    known.extend(goal_names.iter());
                    let found = fixture.or(goal);
                    let missing = || unknown(at(at_name), "fixture or goal", name, &known);
                    Some(found.ok_or_else(missing)?)
                }
            };
            if let Some(Support::Goal(below)) = on {
                needs.push(below);
            }
            links.push((object, on, needs));
        }
        for (index, object) in objects.iter().enumerate() {
            let wanted = links.iter().filter(|(of, ..)| *of == index).count();
            if wanted > object.count {
                let reason = format!(
                    "is {}, expected at least {wanted}: so many goals want `{}`",
                    object.count, object.name
                );
                return Err(field(format!("objects[{index}].count"), reason));
            }
            if object.start.is_none() && description.start.is_none() {
                let reason = "is missing, and so is the start of all objects".to_owned();
                return Err(field(format!("objects[{index}].start"), reason));
            }
        }
        let order = in_order(&links, |goal| goals[goal].name().to_owned())?;
        Ok(Self {
            fixtures: fixtures.iter().map(|f| Solid::new(&f.shape)).collect(),
            objects: objects.iter().map(|o| Solid::new(&o.shape)).collect(),
            links,
            order,
            description,
        })
    }

    /// Draws a scene in which nothing overlaps.
    fn draw_scene(&self, rng: &mut ChaCha8Rng) -> Result<Scene, ParameterError> {
        let mut drawn = self.try_scene(rng);
        for _ in 1..SCENE_DRAWS {
            if drawn.is_ok() {
                break;
            }
            drawn = self.try_scene(rng);
        }
        drawn
    }

    fn try_scene(&self, rng: &mut ChaCha8Rng) -> Result<Scene, ParameterError> {
        let description = &self.description;
        let (object_rgb, fixture_rgb) = self.draw_colors(rng);
        let mut fixtures: Vec<Standing<'_>> = Vec::new();
        for (index, (fixture, solid)) in description.fixtures.iter().zip(&self.fixtures).enumerate()
        {
            let standing = Standing {
                solid,
                pose: draw(&fixture.at, rng),
                base_m: 0.0,
            };
            let at = || format!("fixtures[{index}].at");
            self.check_inside(&standing, &fixture.name, at)?;
            for (other, earlier) in description.fixtures.iter().zip(&fixtures) {
                if standing.covers(earlier, 0.0) {
                    let reason =
                        format!("`{}` overlaps the fixture `{}`", fixture.name, other.name);
                    return Err(field(at(), reason));
                }
            }
            fixtures.push(standing);
        }
        let objects = self.exchanged(rng);
        let mut goals: Vec<Option<Goal>> = vec![None; self.links.len()];
        for index in &self.order {
            let goal = self.try_goal(*index, objects[*index], &fixtures, &goals, rng)?;
            goals[*index] = Some(goal);
        }
        Ok(Scene {
            fixtures: fixtures.iter().map(|standing| standing.pose).collect(),
            goals: goals.into_iter().flatten().collect(),
            object_rgb,
            fixture_rgb,
        })
    }

    /// Draws where a goal is, after those that it needs.
    fn try_goal(
        &self,
        index: usize,
        object: usize,
        fixtures: &[Standing<'_>],
        goals: &[Option<Goal>],
        rng: &mut ChaCha8Rng,
    ) -> Result<Goal, ParameterError> {
        let wanted = &self.description.goals[index];
        let (_, on, needs) = &self.links[index];
        let at = || format!("goals[{index}].at");
        let name = wanted.name();
        let support = match on {
            None => None,
            Some(Support::Fixture(fixture)) => Some(fixtures[*fixture].clone()),
            Some(Support::Goal(below)) => goals[*below].as_ref().map(|goal| self.standing(goal)),
        };
        let frame = support
            .as_ref()
            .map_or(Isometry2::identity(), |support| support.pose);
        let mut standing = Standing {
            solid: &self.objects[object],
            pose: frame * draw(&wanted.at, rng),
            base_m: 0.0,
        };
        if let Some(support) = support
            && wanted.on.is_some()
        {
            let top_m = support.top_at_m(&standing.grip());
            standing.base_m = top_m.ok_or_else(|| {
                let on = wanted.on.as_deref().unwrap_or_default();
                field(at(), format!("`{name}` is beside `{on}`, expected on it"))
            })?;
        }
        self.check_inside(&standing, name, at)?;
        for (fixture, other) in self.description.fixtures.iter().zip(fixtures) {
            if standing.collides(other, GOAL_GAP_M) {
                let reason = format!("`{name}` overlaps the fixture `{}`", fixture.name);
                return Err(field(at(), reason));
            }
        }
        for (other, goal) in self.description.goals.iter().zip(goals) {
            let goal = goal.as_ref().map(|goal| self.standing(goal));
            if goal.is_some_and(|other| standing.collides(&other, GOAL_GAP_M)) {
                let reason = format!("`{name}` overlaps the goal `{}`", other.name());
                return Err(field(at(), reason));
            }
        }
        let description = &self.description;
        Ok(Goal {
            object,
            pose: standing.pose,
            base_m: standing.base_m,
            needs: needs.clone(),
            tolerance_m: wanted.tolerance_m.unwrap_or(description.tolerance_m),
            yaw_tolerance_rad: wanted
                .yaw_tolerance_rad
                .unwrap_or(description.yaw_tolerance_rad),
        })
    }

    /// The object of each goal, after those of one group have been exchanged.
    fn exchanged(&self, rng: &mut ChaCha8Rng) -> Vec<usize> {
        let mut objects: Vec<_> = self.links.iter().map(|(object, ..)| *object).collect();
        let mut groups: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
        for (index, goal) in self.description.goals.iter().enumerate() {
            if let Some(group) = &goal.exchange {
                groups.entry(group).or_default().push(index);
            }
        }
        for goals in groups.values() {
            let mut of_group: Vec<_> = goals.iter().map(|goal| objects[*goal]).collect();
            of_group.shuffle(rng);
            for (goal, object) in goals.iter().zip(of_group) {
                objects[*goal] = object;
            }
        }
        objects
    }

    /// Colours of objects and fixtures; `any` is one that nothing else has, as long as there are some.
    fn draw_colors(&self, rng: &mut ChaCha8Rng) -> (Vec<[u8; 3]>, Vec<[u8; 3]>) {
        let (objects, fixtures) = (&self.description.objects, &self.description.fixtures);
        let given: Vec<_> = objects.iter().map(|object| object.color).collect();
        let given_fixtures: Vec<_> = fixtures.iter().map(|fixture| fixture.color).collect();
        let used = |color: [u8; 3]| {
            given
                .iter()
                .chain(&given_fixtures)
                .any(|c| *c == Color::Rgb(color))
        };
        let mut free: Vec<_> = PALETTE
            .iter()
            .map(|(_, rgb)| *rgb)
            .filter(|rgb| !used(*rgb))
            .collect();
        free.shuffle(rng);
        let mut free = free.into_iter();
        let mut rgb = |color: &Color| match color {
            Color::Rgb(rgb) => *rgb,
            Color::Any => free
                .next()
                .unwrap_or_else(|| PALETTE[rng.random_range(0..PALETTE.len())].1),
        };
        let objects = given.iter().map(&mut rgb).collect();
        (objects, given_fixtures.iter().map(&mut rgb).collect())
    }

    /// Draws where the objects start: the objects in order, each as often as there are of it.
    fn draw_starts(
        &self,
        scene: &Scene,
        rng: &mut ChaCha8Rng,
    ) -> Result<Vec<(usize, Isometry2<f64>)>, ParameterError> {
        let mut drawn = self.try_starts(scene, rng);
        for _ in 1..START_DRAWS {
            if drawn.is_ok() {
                break;
            }
            drawn = self.try_starts(scene, rng);
        }
        drawn
    }

    fn try_starts(
        &self,
        scene: &Scene,
        rng: &mut ChaCha8Rng,
    ) -> Result<Vec<(usize, Isometry2<f64>)>, ParameterError> {
        let mut taken = self.fixed(scene);
        taken.extend(scene.goals.iter().map(|goal| self.standing(goal)));
        let mut starts = Vec::new();
        for (index, object) in self.description.objects.iter().enumerate() {
            for _ in 0..object.count {
                let Some(pose) = self.free_start(index, &taken, self.description.gap_m, rng) else {
                    let reason = format!("there is no room for `{}`", object.name);
                    let own = object.start.is_some();
                    let at = if own {
                        format!("objects[{index}].start")
                    } else {
                        "start".into()
                    };
                    return Err(field(at, reason));
                };
                taken.push(Standing {
                    solid: &self.objects[index],
                    pose,
                    base_m: 0.0,
                });
                starts.push((index, pose));
            }
        }
        Ok(starts)
    }

    /// A place where an object may start, away from what is there.
    fn free_start(
        &self,
        object: usize,
        taken: &[Standing<'_>],
        gap_m: f64,
        rng: &mut ChaCha8Rng,
    ) -> Option<Isometry2<f64>> {
        let own = self.description.objects[object].start.as_ref();
        let start: &Start = own.or(self.description.start.as_ref())?;
        let is_free = |pose: &Isometry2<f64>| {
            let standing = Standing {
                solid: &self.objects[object],
                pose: *pose,
                base_m: 0.0,
            };
            self.is_inside(&standing) && !taken.iter().any(|other| standing.covers(other, gap_m))
        };
        if let Some(region) = &start.region {
            let mut poses = (0..PLACE_DRAWS).map(|_| draw(region, rng));
            return poses.find(is_free);
        }
        let mut poses: Vec<_> = start.poses.iter().collect();
        poses.shuffle(rng);
        poses.into_iter().map(|pose| draw(pose, rng)).find(is_free)
    }

    fn standing(&self, goal: &Goal) -> Standing<'_> {
        Standing {
            solid: &self.objects[goal.object],
            pose: goal.pose,
            base_m: goal.base_m,
        }
    }

    fn fixed(&self, scene: &Scene) -> Vec<Standing<'_>> {
        let fixtures = self.fixtures.iter().zip(&scene.fixtures);
        let standing = fixtures.map(|(solid, pose)| Standing {
            solid,
            pose: *pose,
            base_m: 0.0,
        });
        standing.collect()
    }

    fn is_inside(&self, standing: &Standing<'_>) -> bool {
        let [x, y] = self.description.area_m;
        let mut corners = standing.corners();
        corners.all(|p| p.x.abs() <= x / 2.0 + 1e-9 && p.y.abs() <= y / 2.0 + 1e-9)
    }

    fn check_inside(
        &self,
        standing: &Standing<'_>,
        name: &str,
        at: impl Fn() -> String,
    ) -> Result<(), ParameterError> {
        if self.is_inside(standing) {
            return Ok(());
        }
        let [x, y] = self.description.area_m.map(|edge| edge / 2.0);
        let corners: Vec<_> = standing.corners().collect();
        let low = corners.iter().fold(corners[0], |low, p| low.inf(p));
        let high = corners.iter().fold(corners[0], |high, p| high.sup(p));
        let reason = format!(
            "`{name}` takes x {:.3} to {:.3}, y {:.3} to {:.3} m, expected within the area, x {:.3} to {x:.3}, y {:.3} to {y:.3} m",
            low.x, high.x, low.y, high.y, -x, -y
        );
        Err(field(at(), reason))
    }

    /// Adds what a scene and a start are made of.
    fn populate(
        &self,
        world: &mut World,
        anchor: &Isometry2<f64>,
        scene: &Scene,
        starts: &[(usize, Isometry3<f64>)],
    ) -> Vec<(usize, BodyId)> {
        for ((solid, pose), rgb) in self
            .fixtures
            .iter()
            .zip(&scene.fixtures)
            .zip(&scene.fixture_rgb)
        {
            let pose = solid.pose(&(anchor * pose), 0.0);
            add(world, solid, pose, Mobility::Fixed, *rgb);
        }
        let added = starts.iter().map(|(object, pose)| {
            let mobility = Mobility::Free {
                mass_kg: self.description.objects[*object].mass_kg,
                suction_force_n: SUCTION_FORCE_N,
            };
            let rgb = scene.object_rgb[*object];
            let body = add(world, &self.objects[*object], *pose, mobility, rgb);
            (*object, body)
        });
        added.collect()
    }

    /// Heights of the primitive: what is carried passes over all there is.
    fn settings(&self, scene: &Scene) -> PrimitiveSettings {
        let heights = |standing: &Standing<'_>| standing.top_m();
        let fixed = self.fixed(scene);
        let goals = scene.goals.iter().map(|goal| self.standing(goal).top_m());
        let objects = self.objects.iter().map(|solid| solid.size_m.z);
        let tallest_object_m = objects.clone().fold(0.0, f64::max);
        let tallest_m = fixed
            .iter()
            .map(heights)
            .chain(goals)
            .chain(objects)
            .fold(0.0, f64::max);
        PrimitiveSettings {
            clearance_m: (tallest_m + tallest_object_m + OVER_M).max(0.08),
            lift_m: tallest_m + OVER_M,
            travel_m_s: 1.2,
            carry_m_s: 0.8,
            descend_m_s: 0.2,
            acceleration_m_s2: 4.0,
        }
    }

    /// Refuses scenes whose objects do not stay where they belong by themselves.
    fn check_stands(
        &self,
        scene: &Scene,
        anchor: &Isometry2<f64>,
        away: &Isometry3<f64>,
    ) -> Result<(), ParameterError> {
        let mut world = World::new(away);
        let on_goals: Vec<_> = scene
            .goals
            .iter()
            .map(|goal| {
                let solid = &self.objects[goal.object];
                (goal.object, solid.pose(&(anchor * goal.pose), goal.base_m))
            })
            .collect();
        let bodies = self.populate(&mut world, anchor, scene, &on_goals);
        for _ in 0..SIMULATED_STEPS {
            world.step(away);
        }
        for (index, ((_, body), (_, pose))) in bodies.iter().zip(&on_goals).enumerate() {
            let moved_m = (world.position(*body).coords - pose.translation.vector).norm();
            if moved_m > STANDS_M {
                let name = self.description.goals[index].name();
                let reason = format!(
                    "`{name}` does not stay there: it moves {:.0} mm",
                    1e3 * moved_m
                );
                return Err(field(format!("goals[{index}].at"), reason));
            }
        }
        Ok(())
    }
}

fn add(
    world: &mut World,
    solid: &Solid,
    pose: Isometry3<f64>,
    mobility: Mobility,
    rgb: [u8; 3],
) -> BodyId {
    let part = Part {
        shape: solid.components[0].shape,
        pose,
        mobility,
        friction: FRICTION,
        rgb,
    };
    world.add_compound(&part, &solid.components)
}

fn draw(place: &Place, rng: &mut ChaCha8Rng) -> Isometry2<f64> {
    let mut value = |range: &Range| range.least + (range.most - range.least) * rng.random::<f64>();
    let (x, y) = (value(&place.x_m), value(&place.y_m));
    Isometry2::new(Vector2::new(x, y), value(&place.yaw_rad))
}

/// Names with their indices; a name that comes twice is refused.
fn names<'a>(
    list: &str,
    names: impl Iterator<Item = &'a str>,
) -> Result<BTreeMap<&'a str, usize>, ParameterError> {
    let mut known = BTreeMap::new();
    for (index, name) in names.enumerate() {
        if let Some(earlier) = known.insert(name, index) {
            let reason = format!("the name `{name}` is that of {list}[{earlier}], too");
            return Err(field(format!("{list}[{index}]"), reason));
        }
    }
    Ok(known)
}

fn unknown(at: String, what: &str, name: &str, known: &BTreeMap<&str, usize>) -> ParameterError {
    let known: Vec<_> = known.keys().copied().collect();
    let known = if known.is_empty() {
        "none".to_owned()
    } else {
        known.join(", ")
    };
    field(at, format!("no {what} `{name}`; there are: {known}"))
}

/// The goals, those that others need first; refuses a circle.
fn in_order(
    links: &[(usize, Option<Support>, Vec<usize>)],
    name: impl Fn(usize) -> String,
) -> Result<Vec<usize>, ParameterError> {
    let mut order: Vec<usize> = Vec::new();
    while order.len() < links.len() {
        let ready = (0..links.len()).find(|goal| {
            let needs = &links[*goal].2;
            !order.contains(goal) && needs.iter().all(|need| order.contains(need))
        });
        if let Some(goal) = ready {
            order.push(goal);
            continue;
        }
        // Every goal that is left needs one that is left: follow them until one comes again.
        let mut path: Vec<usize> = Vec::new();
        let left = |goal: &usize| !order.contains(goal);
        let mut next = (0..links.len()).find(left);
        while let Some(goal) = next.filter(|goal| !path.contains(goal)) {
            path.push(goal);
            next = links[goal].2.iter().copied().find(left);
        }
        let circle = path.iter().skip_while(|goal| Some(**goal) != next).copied();
        let circle: Vec<_> = circle.chain(next).map(&name).collect();
        let at = next.map_or("goals".into(), |goal| format!("goals[{goal}]"));
        let reason = format!("the order goes in a circle: {}", circle.join(" after "));
        return Err(field(at, reason));
    }
    Ok(order)
}

fn check_lengths(description: &Arranging) -> Result<(), ParameterError> {
    for (axis, edge) in description.area_m.iter().enumerate() {
        check_range(&format!("area_m[{axis}]"), *edge, 0.05, 1.0)?;
    }
    check_range("tolerance_m", description.tolerance_m, 1e-3, 0.05)?;
    check_range(
        "yaw_tolerance_rad",
        description.yaw_tolerance_rad,
        0.01,
        TAU,
    )?;
    check_range("pick_spread_m", description.pick_spread_m, 0.0, 0.02)?;
    check_range("gap_m", description.gap_m, 0.0, 0.1)?;
    if description.objects.is_empty() {
        let reason = "is empty, expected at least one";
        return Err(field("objects", reason.into()));
    }
    let fixtures = description.fixtures.iter().enumerate();
    let shapes = fixtures.map(|(index, fixture)| (format!("fixtures[{index}]"), &fixture.shape));
    let objects = description.objects.iter().enumerate();
    let shapes = shapes.chain(objects.map(|(i, object)| (format!("objects[{i}]"), &object.shape)));
    for (of, shape) in shapes {
        for (name, value, least, most) in shape.lengths() {
            check_range(&format!("{of}.shape.{name}"), value, least, most)?;
        }
    }
    for (index, object) in description.objects.iter().enumerate() {
        check_range(
            &format!("objects[{index}].mass_kg"),
            object.mass_kg,
            1e-3,
            0.3,
        )?;
        check_range(
            &format!("objects[{index}].count"),
            object.count as f64,
            1.0,
            50.0,
        )?;
        if let Some(start) = &object.start {
            check_start(&format!("objects[{index}].start"), start)?;
        }
    }
    if let Some(start) = &description.start {
        check_start("start", start)?;
    }
    for (index, goal) in description.goals.iter().enumerate() {
        if let Some(tolerance_m) = goal.tolerance_m {
            check_range(
                &format!("goals[{index}].tolerance_m"),
                tolerance_m,
                1e-3,
                0.05,
            )?;
        }
        if let Some(yaw_rad) = goal.yaw_tolerance_rad {
            check_range(
                &format!("goals[{index}].yaw_tolerance_rad"),
                yaw_rad,
                0.01,
                TAU,
            )?;
        }
    }
    Ok(())
}

fn check_start(at: &str, start: &Start) -> Result<(), ParameterError> {
    if start.region.is_some() == start.poses.is_empty() {
        return Ok(());
    }
    Err(field(at, "expected either a region or poses".into()))
}

impl TaskModule for Arrangement {
    fn check(&self, anchor: &Isometry2<f64>) -> Result<(), ParameterError> {
        let cell = WorkCell::builtin().map_err(|e| field("", format!("the work cell: {e}")))?;
        let arm = &cell.arm;
        let home = arm.tip(&arm.home);
        for seed in 0..CHECKED_SCENES {
            let mut draws = Draws::new(seed.into(), 0);
            let scene = self.draw_scene(draws.scene())?;
            for (index, goal) in scene.goals.iter().enumerate() {
                let standing = self.standing(goal);
                let grip = anchor * standing.grip();
                let tip = Isometry2::new(grip.coords, 0.0);
                let above = Arm::tip_down(&tip, standing.top_m() + RISE_M);
                arm.solve(&above, &arm.ready).map_err(|reason| {
                    let name = self.description.goals[index].name();
                    let reason = format!("the arm cannot put `{name}` there: {reason}");
                    field(format!("goals[{index}].at"), reason)
                })?;
            }
            draws.start(|rng| self.draw_starts(&scene, rng))?;
            if seed < SIMULATED_SCENES {
                self.check_stands(&scene, anchor, &home)?;
            }
        }
        Ok(())
    }

    fn footprint_m(&self) -> Vector2<f64> {
        self.description.area_m.into()
    }

    fn build(
        &self,
        world: &mut World,
        anchor: &Isometry2<f64>,
        draws: &mut Draws,
    ) -> Result<Box<dyn Task>, ParameterError> {
        let scene = self.draw_scene(draws.scene())?;
        let starts = draws.start(|rng| self.draw_starts(&scene, rng))?;
        let starts: Vec<_> = starts
            .into_iter()
            .map(|(object, pose)| (object, self.objects[object].pose(&(anchor * pose), 0.0)))
            .collect();
        let bodies = self.populate(world, anchor, &scene, &starts);
        let settings = self.settings(&scene);
        Ok(Box::new(ArrangingTask {
            module: self.clone(),
            anchor: *anchor,
            scene,
            bodies,
            settings,
        }))
    }
}

struct ArrangingTask {
    module: Arrangement,
    anchor: Isometry2<f64>,
    scene: Scene,
    /// What each body is, and the body.
    bodies: Vec<(usize, BodyId)>,
    settings: PrimitiveSettings,
}

impl ArrangingTask {
    /// Whether an object is where a goal wants one like it.
    fn is_on(&self, goal: &Goal, body: BodyId, world: &World) -> bool {
        let solid = &self.module.objects[goal.object];
        let wanted = solid.pose(&(self.anchor * goal.pose), goal.base_m);
        let pose = world.pose(body);
        let off = pose.translation.vector - wanted.translation.vector;
        let turned = (wanted.rotation.inverse() * pose.rotation).to_rotation_matrix();
        off.xy().norm() < goal.tolerance_m
            && off.z.abs() < HEIGHT_TOLERANCE_M
            && solid.looks_upright(turned.matrix(), TILT_TOLERANCE_RAD, goal.yaw_tolerance_rad)
    }

    /// The object on each goal that is reached.
    fn on_goals(&self, world: &World) -> Vec<Option<BodyId>> {
        let goals = &self.scene.goals;
        let mut reached: Vec<Option<BodyId>> = vec![None; goals.len()];
        for index in &self.module.order {
            let goal = &goals[*index];
            if goal.needs.iter().all(|need| reached[*need].is_some()) {
                let mut bodies = self
                    .bodies
                    .iter()
                    .filter(|(object, _)| *object == goal.object);
                let on = bodies.find(|(_, body)| self.is_on(goal, *body, world));
                reached[*index] = on.map(|(_, body)| *body);
            }
        }
        reached
    }

    /// An object as it is now, in the module frame, taken for upright.
    fn now(&self, object: usize, body: BodyId, world: &World) -> Standing<'_> {
        let solid = &self.module.objects[object];
        let pose = world.pose(body);
        let along = pose.rotation * nalgebra::Vector3::x();
        let planar = Isometry2::new(pose.translation.vector.xy(), along.y.atan2(along.x));
        Standing {
            solid,
            pose: self.anchor.inverse() * planar,
            base_m: pose.translation.z - solid.size_m.z / 2.0,
        }
    }

    /// An object that lies on another one, itself covered by none.
    fn on_top(&self, of: &Standing<'_>, but: BodyId, world: &World) -> Option<(usize, BodyId)> {
        let mut on_top: Vec<_> = self
            .bodies
            .iter()
            .filter(|(_, body)| *body != but)
            .map(|(object, body)| (self.now(*object, *body, world), (*object, *body)))
            .filter(|(now, _)| now.base_m > of.top_m() - ON_TOP_M && now.covers(of, 0.0))
            .collect();
        on_top.sort_by(|a, b| a.0.base_m.total_cmp(&b.0.base_m));
        on_top.pop().map(|(_, found)| found)
    }

    /// An object in the way of one that belongs on a goal.
    fn in_the_way(&self, goal: &Goal, but: BodyId, world: &World) -> Option<(usize, BodyId)> {
        let wanted = self.module.standing(goal);
        let mut others = self.bodies.iter().filter(|(_, body)| *body != but);
        let found = others.find(|(object, body)| {
            let now = self.now(*object, *body, world);
            now.collides(&wanted, IN_THE_WAY_M)
                || now.base_m >= wanted.base_m && now.covers(&wanted, 0.0)
        });
        found.copied()
    }

    /// Carries a body so that its frame comes to a place, turned.
    fn carry(
        &self,
        (object, body): (usize, BodyId),
        to: &Point2<f64>,
        turn_rad: f64,
        world: &World,
        rng: &mut ChaCha8Rng,
    ) -> PickPlace {
        let now = self.now(object, body, world);
        let (spread_m, angle) = (
            self.module.description.pick_spread_m,
            rng.random_range(0.0..TAU),
        );
        let radius = spread_m * rng.random_range(0.0..1.0f64).sqrt();
        let spread = Vector2::new(angle.cos(), angle.sin()) * radius;
        let grip = self.anchor * now.grip() + spread;
        let turn = UnitComplex::new(turn_rad);
        let from = world.position(body).xy();
        let place = self.anchor * to + turn * (grip - from);
        PickPlace {
            pick: Isometry2::new(grip.coords, 0.0),
            place: Isometry2::new(place.coords, turn_rad),
        }
    }

    /// Puts a body aside, to where it could start.
    fn put_aside(
        &self,
        (object, body): (usize, BodyId),
        world: &World,
        rng: &mut ChaCha8Rng,
    ) -> Option<PickPlace> {
        let mut taken = self.module.fixed(&self.scene);
        taken.extend(
            self.scene
                .goals
                .iter()
                .map(|goal| self.module.standing(goal)),
        );
        let others = self.bodies.iter().filter(|(_, other)| *other != body);
        taken.extend(others.map(|(object, other)| self.now(*object, *other, world)));
        let to = self.module.free_start(object, &taken, IN_THE_WAY_M, rng)?;
        let to = Point2::from(to.translation.vector);
        Some(self.carry((object, body), &to, 0.0, world, rng))
    }
}

impl Task for ArrangingTask {
    fn goal_count(&self) -> usize {
        self.scene.goals.len()
    }

    fn max_steps(&self) -> usize {
        self.scene.goals.len() + 2
    }

    fn settings(&self) -> PrimitiveSettings {
        self.settings
    }

    fn goal_poses(&self) -> Vec<Isometry3<f64>> {
        let poses = self.scene.goals.iter().map(|goal| {
            let solid = &self.module.objects[goal.object];
            solid.pose(&(self.anchor * goal.pose), goal.base_m)
        });
        poses.collect()
    }

    fn goals_reached(&mut self, world: &World) -> Vec<usize> {
        let on_goals = self.on_goals(world);
        let reached = on_goals.iter().enumerate().filter(|(_, on)| on.is_some());
        reached.map(|(index, _)| index).collect()
    }

    /// A random goal that may come next, or the one that has to: a random object that will do for it,
    /// gripped near the middle of its top and turned no further than it takes. What lies on the object, or
    /// is in the way on the goal, is put aside first.
    fn demonstrate(
        &mut self,
        cell: &Cell,
        demonstrator: &mut Demonstrator,
        next: Option<usize>,
    ) -> Option<Move> {
        let rng = &mut demonstrator.rng;
        let world = cell.world();
        let on_goals = self.on_goals(world);
        let mut moves = Vec::new();
        let mut obstacles = Vec::new();
        for (index, goal) in self.scene.goals.iter().enumerate() {
            let waits = goal.needs.iter().any(|need| on_goals[*need].is_none());
            if on_goals[index].is_some() || waits || next.is_some_and(|next| next != index) {
                continue;
            }
            let like = self
                .bodies
                .iter()
                .filter(|(object, _)| *object == goal.object);
            for found in like.filter(|(_, body)| !on_goals.contains(&Some(*body))) {
                let now = self.now(found.0, found.1, world);
                let obstacle = self
                    .on_top(&now, found.1, world)
                    .or_else(|| self.in_the_way(goal, found.1, world));
                match obstacle {
                    None => moves.push((goal, *found)),
                    Some(obstacle) => obstacles.push(obstacle),
                }
            }
        }
        if let Some((goal, found)) = moves.choose(rng) {
            let solid = &self.module.objects[goal.object];
            let rotation = world.pose(found.1).rotation.to_rotation_matrix();
            let wanted_rad = (self.anchor * goal.pose).rotation.angle();
            let turn_rad = if goal.yaw_tolerance_rad > PI {
                0.0
            } else {
                solid.turn_rad(rotation.matrix(), wanted_rad)
            };
            let to = Point2::from(goal.pose.translation.vector);
            return Some(self.carry(*found, &to, turn_rad, world, rng).into());
        }
        let obstacle = *obstacles.choose(rng)?;
        let now = self.now(obstacle.0, obstacle.1, world);
        let topmost = self.on_top(&now, obstacle.1, world).unwrap_or(obstacle);
        self.put_aside(topmost, world, rng).map(Move::from)
    }
}
