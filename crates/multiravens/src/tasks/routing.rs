//! *routing*: a cable of beads round two or three pegs, in turn on either side, then stretched
//! (paper, appendix).
//!
//! The cable's left end is anchored; the cable starts on one side of all pegs. Peg after peg, from
//! left to right, it has to be led past on the far side, the near side, the far side, and to lie
//! against the peg; on the near side, where it lies from the start, it has to bend round the peg.
//! At last the yellow end is drawn to its goal.
//!
//! Module frame: the cable runs along +x; the far side is +y, the side on which it starts -y.

use super::{
    Demonstrator, Move, ParameterError, Task, TaskModule, at_height, check_range, field, rehearsed,
};
use crate::cell::Cell;
use crate::colors;
use crate::seed::Draws;
use crate::world::{BeadChain, BodyId, Mobility, Part, Shape, World};
use nalgebra::{Isometry2, Isometry3, Point2, Vector2};
use pick_place::{PickPlace, PrimitiveSettings};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde::Deserialize;
use std::f64::consts::{PI, TAU};

const PEG_RADIUS_M: f64 = 0.012;
const PEG_HEIGHT_M: f64 = 0.03;
/// Where the cable is anchored along x; its other end is drawn as far to the other side as it goes.
const ANCHOR_X_M: f64 = -0.2;
/// About where the first peg stands.
const FIRST_X_M: f64 = -0.125;
/// Distance of the cable's start from the pegs' middle line.
const START_Y_M: f64 = -0.115;
/// In another start than the scene's own the cable reaches that side this far along x from its
/// anchor, ...
const CORNER_M: (f64, f64) = (0.015, 0.05);
/// ... lies in waves about a line this far from the middle line, ...
const WAVES_Y_M: (f64, f64) = (-0.122, -0.112);
/// ... which are at most so high, ...
const WAVE_HEIGHT_M: f64 = 0.008;
/// ... and so long.
const WAVE_LENGTH_M: (f64, f64) = (0.12, 0.24);
/// A bead's centre passes a peg's centre at this distance when it lies against the peg.
const PASS_M: f64 = PEG_RADIUS_M + BeadChain::BEAD_RADIUS_M;
/// The demonstrator leaves this much room between a bead and the peg it passes.
const ROOM_M: f64 = 0.01;
/// Cable left over when it is stretched.
const SLACK_M: f64 = 0.012;
const FOOTPRINT_M: (f64, f64) = (0.48, 0.28);
/// The demonstrator's picks keep this far from a peg's side, ...
const CUP_ROOM_M: f64 = 8e-3;
/// ... but no further than this from the bead's centre.
const MOST_ASIDE_M: f64 = 3e-3;
/// A cable goes round a peg, not only past it, if where it comes this near to the peg's middle and
/// where it leaves ...
const BEND_ABOUT_M: f64 = 0.045;
/// ... lie further to the other side than where it touches the peg, by this much.
const BEND_M: f64 = 5e-3;
/// To bend the cable round a peg that it passes, the demonstrator draws a bead to here beyond it
/// along x, and as far to the other side.
const BEYOND_M: (f64, f64) = (0.04, 0.01);
/// A lifted bead is set down at most this far beyond the peg along x.
const AHEAD_M: f64 = 0.03;
/// The first so many guesses take the bead that should do; later ones a few further along.
const NARROW_GUESSES: usize = 2;
/// The stretch is always the same move: more guesses would not help.
const STRETCHES: usize = 2;
/// A bead above this height lies on something.
const ON_TABLE_M: f64 = 1.5 * BeadChain::BEAD_RADIUS_M;

const SETTINGS: PrimitiveSettings = PrimitiveSettings {
    clearance_m: 0.09,
    lift_m: 0.05,
    travel_m_s: 1.0,
    carry_m_s: 0.15,
    descend_m_s: 0.04,
    acceleration_m_s2: 1.5,
};

/// To draw the cable along the table: lower than the pegs, or it would be lifted off them.
const DRAW: PrimitiveSettings = PrimitiveSettings {
    lift_m: 0.012,
    ..SETTINGS
};

/// The module's parameters in a problem file.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Routing {
    /// Number of pegs, at least and at most.
    pegs: (usize, usize),
    /// How far a bead may be from where the cable should pass a peg, and the end from its goal.
    tolerance_m: f64,
}

impl Default for Routing {
    fn default() -> Self {
        Self {
            pegs: (2, 3),
            tolerance_m: 0.02,
        }
    }
}

/// A peg in the module frame, and the side on which the cable has to pass it.
#[derive(Clone, Copy, Debug)]
struct Peg {
    center: Point2<f64>,
    /// 1: far side (+y), -1: near side.
    side: f64,
}

impl Peg {
    /// Where a bead passes that lies against the peg.
    fn pass(&self) -> Point2<f64> {
        self.center + Vector2::new(0.0, self.side * PASS_M)
    }
}

struct RoutingTask {
    anchor: Isometry2<f64>,
    pegs: Vec<Peg>,
    cable: BeadChain,
    /// Goal of the cable's end, in the module frame.
    end: Point2<f64>,
    /// Whether what comes next is drawn along the table, when last looked at: the cable round a peg
    /// that it passes on the right side, or its end to the goal.
    draws: bool,
    parameters: Routing,
}

impl TaskModule for Routing {
    fn check(&self, _anchor: &Isometry2<f64>) -> Result<(), ParameterError> {
        check_range("tolerance_m", self.tolerance_m, 5e-3, 0.03)?;
        let (least, most) = self.pegs;
        if !(2..=3).contains(&least) || !(least..=3).contains(&most) {
            let reason = format!("is [{least}, {most}], expected two numbers in order, of 2 and 3");
            return Err(field("pegs", reason));
        }
        Ok(())
    }

    fn footprint_m(&self) -> Vector2<f64> {
        Vector2::new(FOOTPRINT_M.0, FOOTPRINT_M.1)
    }

    fn build(
        &self,
        world: &mut World,
        anchor: &Isometry2<f64>,
        draws: &mut Draws,
    ) -> Result<Box<dyn Task>, ParameterError> {
        Ok(Box::new(self.draw(world, anchor, draws)))
    }
}

impl Routing {
    fn draw(&self, world: &mut World, anchor: &Isometry2<f64>, draws: &mut Draws) -> RoutingTask {
        let (least, most) = self.pegs;
        let count = draws.scene().random_range(least..=most);
        let spacing = if count == 2 { 0.15 } else { 0.105 };
        let rng = draws.scene();
        let pegs: Vec<_> = (0..count)
            .map(|index| {
                let side = if index % 2 == 0 { 1.0 } else { -1.0 };
                let x = FIRST_X_M + index as f64 * spacing + rng.random_range(-0.012..0.012);
                let y = side * rng.random_range(0.01..0.03);
                Peg {
                    center: Point2::new(x, y),
                    side,
                }
            })
            .collect();
        for peg in &pegs {
            world.add(&Part {
                shape: Shape::Cylinder {
                    radius_m: PEG_RADIUS_M,
                    length_m: PEG_HEIGHT_M,
                },
                pose: at_height(
                    &(anchor * Isometry2::from(peg.center.coords)),
                    PEG_HEIGHT_M / 2.0,
                ),
                mobility: Mobility::Fixed,
                friction: 0.3,
                rgb: colors::PEG,
            });
        }
        // The taut cable: from the anchor past the pegs to the right, as level as it comes.
        let start = Point2::new(ANCHOR_X_M, 0.0);
        let mut taut = vec![start];
        taut.extend(pegs.iter().map(Peg::pass));
        let to_last = length(&taut);
        let last = taut[taut.len() - 1];
        let reach = Point2::new(rng.random_range(0.185..0.205), 0.0) - last;
        let wanted = ((to_last + reach.norm() + SLACK_M) / BeadChain::PITCH_M).ceil() as usize + 1;
        // Of one scene in 2,700 with three pegs the last bead would lie beside the footprint.
        let beads = wanted.min(most_beads(start));
        let free = (beads - 1) as f64 * BeadChain::PITCH_M - to_last - SLACK_M;
        let end = last + reach.normalize() * free;
        let laid = match draws.other_start() {
            None => lay(start, beads),
            Some(rng) => lay_in_waves(start, beads, rng),
        };
        let centers: Vec<_> = laid
            .into_iter()
            .map(|p| {
                let p = anchor * p;
                nalgebra::Point3::new(p.x, p.y, BeadChain::BEAD_RADIUS_M)
            })
            .collect();
        let cable = world.add_bead_chain(&centers, false, true, |index| match index {
            0 => colors::PEG,
            i if i + 1 == beads => colors::YELLOW,
            _ => colors::GREY,
        });
        RoutingTask {
            anchor: *anchor,
            pegs,
            cable,
            end,
            draws: false,
            parameters: *self,
        }
    }
}

/// Index of the bead nearest to a point.
fn nearest(point: &Point2<f64>, beads: &[(Point2<f64>, f64)]) -> usize {
    let distances = beads.iter().map(|(p, _)| (p - point).norm());
    let nearest = distances.enumerate().min_by(|a, b| a.1.total_cmp(&b.1));
    nearest.map_or(0, |(index, _)| index)
}

/// Length of a polyline.
fn length(points: &[Point2<f64>]) -> f64 {
    points
        .windows(2)
        .map(|pair| (pair[1] - pair[0]).norm())
        .sum()
}

/// Where a cable that is laid from its anchor reaches its start side.
fn corner(start: Point2<f64>) -> Point2<f64> {
    Point2::new(start.x + 0.05, START_Y_M)
}

/// How many beads of a cable that is laid as in [`lay`] are in the footprint, with a little room for the first steps at rest.
fn most_beads(start: Point2<f64>) -> usize {
    let corner = corner(start);
    let along_x = FOOTPRINT_M.0 / 2.0 - 1e-4 - corner.x;
    (((corner - start).norm() + along_x) / BeadChain::PITCH_M) as usize + 1
}

/// Beads at their pitch, from the anchor aslant to the cable's start side and on along x.
fn lay(start: Point2<f64>, beads: usize) -> Vec<Point2<f64>> {
    let corner = corner(start);
    let slant = (corner - start).norm();
    let at = |index: usize| {
        let along = index as f64 * BeadChain::PITCH_M;
        if along < slant {
            start + (corner - start) * (along / slant)
        } else {
            corner + Vector2::new(along - slant, 0.0)
        }
    };
    // Cutting the corner shortens one link a little; the solver closes that within a step.
    (0..beads).map(at).collect()
}

/// Beads at their pitch, from the anchor aslant to the cable's start side and on in waves along x.
fn lay_in_waves(start: Point2<f64>, beads: usize, rng: &mut ChaCha8Rng) -> Vec<Point2<f64>> {
    let corner_x = start.x + rng.random_range(CORNER_M.0..CORNER_M.1);
    let middle = rng.random_range(WAVES_Y_M.0..WAVES_Y_M.1);
    let height = rng.random_range(0.0..WAVE_HEIGHT_M);
    let length = rng.random_range(WAVE_LENGTH_M.0..WAVE_LENGTH_M.1);
    let phase = rng.random_range(0.0..TAU);
    let on_wave = |x: f64| Point2::new(x, middle + height * (TAU * x / length + phase).sin());
    let corner = on_wave(corner_x);
    let mut at = start;
    let mut laid = vec![start];
    while laid.len() < beads {
        let is_slanted = (corner - at).norm() > BeadChain::PITCH_M && at.x < corner_x;
        let ahead = if is_slanted {
            corner
        } else {
            on_wave(at.x + BeadChain::PITCH_M)
        };
        at += (ahead - at).normalize() * BeadChain::PITCH_M;
        laid.push(at);
    }
    laid
}

impl RoutingTask {
    /// The beads' centres in the module frame, with their heights.
    fn beads(&self, world: &World) -> Vec<(Point2<f64>, f64)> {
        let local = |bead: &BodyId| {
            let p = world.position(*bead);
            (self.anchor.inverse_transform_point(&p.xy()), p.z)
        };
        self.cable.beads.iter().map(local).collect()
    }

    /// Whether the cable is led past a peg on its side, and lies on the table against it. On the
    /// near side, where it lies from the start, it has to bend round the peg.
    fn is_routed(&self, peg: &Peg, beads: &[(Point2<f64>, f64)]) -> bool {
        let led = peg.side > 0.0 || self.bends(peg, beads);
        led && self.passes(peg, beads) && self.is_against(peg, beads)
    }

    /// Whether the cable is led past a peg on its side.
    fn passes(&self, peg: &Peg, beads: &[(Point2<f64>, f64)]) -> bool {
        // Seen from the peg, a cable that passes on the far side sweeps about half a turn
        // clockwise, on the near side anticlockwise; one that loops round it, or ends before it,
        // sweeps more or less.
        let sweep: f64 = beads
            .windows(2)
            .map(|pair| {
                let (a, b) = (pair[0].0 - peg.center, pair[1].0 - peg.center);
                a.perp(&b).atan2(a.dot(&b))
            })
            .sum();
        (0.5 * PI..1.75 * PI).contains(&(-peg.side * sweep))
    }

    /// Whether the cable bends round a peg: comes from the other side and goes back there.
    fn bends(&self, peg: &Peg, beads: &[(Point2<f64>, f64)]) -> bool {
        let at = nearest(&peg.pass(), beads);
        let away = |(p, _): &&(Point2<f64>, f64)| (p - peg.center).norm() > BEND_ABOUT_M;
        let before = beads[..at].iter().rev().find(away).or(beads.first());
        let after = beads[at..].iter().find(away).or(beads.last());
        let (Some((before, _)), Some((after, _))) = (before, after) else {
            return false;
        };
        let inner = |p: &Point2<f64>| peg.side * (peg.pass().y - p.y) > BEND_M;
        inner(before) && inner(after)
    }

    /// Whether a bead lies on the table where the cable should pass a peg.
    fn is_against(&self, peg: &Peg, beads: &[(Point2<f64>, f64)]) -> bool {
        beads
            .iter()
            .any(|(p, z)| *z < ON_TABLE_M && (p - peg.pass()).norm() < self.parameters.tolerance_m)
    }

    /// Number of pegs routed, strictly in order.
    fn routed(&self, beads: &[(Point2<f64>, f64)]) -> usize {
        let routed = self
            .pegs
            .iter()
            .take_while(|peg| self.is_routed(peg, beads));
        routed.count()
    }

    /// Number of goals reached: the pegs in order, the stretch after all of them.
    fn count(&self, beads: &[(Point2<f64>, f64)]) -> usize {
        let routed = self.routed(beads);
        routed + usize::from(routed == self.pegs.len() && self.is_stretched(beads))
    }

    /// A move that may reach the next goal: which bead, and where it goes.
    fn guess(
        &self,
        index: usize,
        beads: &[(Point2<f64>, f64)],
        rng: &mut ChaCha8Rng,
    ) -> Option<(usize, Point2<f64>)> {
        let next = self.routed(beads);
        let Some(peg) = self.pegs.get(next) else {
            return (index < STRETCHES).then_some((beads.len() - 1, self.end));
        };
        // The bead at the peg before, or the anchor; then the way of the cable from there.
        let held = next
            .checked_sub(1)
            .map_or(0, |last| nearest(&self.pegs[last].pass(), beads));
        let (goal, way) = if self.draws {
            let (along, across) = BEYOND_M;
            let goal = peg.center + Vector2::new(along, -peg.side * across);
            let way = length(&[beads[held].0, peg.pass(), goal]);
            (goal, way)
        } else {
            let along = if index < NARROW_GUESSES {
                0.0
            } else {
                rng.random_range(0.0..AHEAD_M)
            };
            let goal = peg.pass() + Vector2::new(along, peg.side * ROOM_M);
            // While the bead is lifted, the cable has to reach up to it.
            (goal, SETTINGS.lift_m.hypot((goal - beads[held].0).norm()))
        };
        let bead = held + (way / BeadChain::PITCH_M).ceil() as usize + rng.random_range(0..2);
        let off = if index < NARROW_GUESSES {
            0
        } else {
            rng.random_range(-3i32..=4)
        };
        let wished = bead.saturating_add_signed(off as isize);
        let near = [0, 1, -1, 2, -2, 3].map(|off| wished.saturating_add_signed(off));
        let bead = near
            .into_iter()
            .find(|bead| (1..beads.len()).contains(bead) && self.can_pick(*bead, beads));
        // Nothing else is left to do but to draw on an end that has folded back.
        Some(bead.map_or((beads.len() - 1, self.end), |bead| (bead, goal)))
    }

    fn is_stretched(&self, beads: &[(Point2<f64>, f64)]) -> bool {
        let end = beads.last();
        end.is_some_and(|(p, _)| (p - self.end).norm() < self.parameters.tolerance_m)
    }

    /// Whether the suction cup can come down on a bead: nothing above it, no peg in the way.
    fn can_pick(&self, index: usize, beads: &[(Point2<f64>, f64)]) -> bool {
        let (p, z) = beads[index];
        let free = |(i, (other, height)): (usize, &(Point2<f64>, f64))| {
            i == index || *height < z + 2e-3 || (other - p).norm() > BeadChain::PITCH_M
        };
        let clear = |peg: &Peg| (peg.center - p).norm() > PEG_RADIUS_M + 5e-3;
        beads.iter().enumerate().all(free) && self.pegs.iter().all(clear)
    }
}

impl Task for RoutingTask {
    fn goal_count(&self) -> usize {
        self.pegs.len() + 1
    }

    fn max_steps(&self) -> usize {
        self.pegs.len() + 4
    }

    fn settings(&self) -> PrimitiveSettings {
        if self.draws { DRAW } else { SETTINGS }
    }

    fn goal_poses(&self) -> Vec<Isometry3<f64>> {
        let points = self.pegs.iter().map(Peg::pass).chain([self.end]);
        let poses = points.map(|p| {
            let pose = self.anchor * Isometry2::from(p.coords);
            at_height(&pose, BeadChain::BEAD_RADIUS_M)
        });
        poses.collect()
    }

    fn goals_reached(&mut self, world: &World) -> Vec<usize> {
        let beads = self.beads(world);
        let routed = self.routed(&beads);
        let next = self.pegs.get(routed);
        self.draws = next.is_none_or(|peg| self.passes(peg, &beads));
        (0..self.count(&beads)).collect()
    }

    /// Lifts the bead that belongs against the next peg over to its side of the peg, or draws the
    /// cable round a peg that it passes already; when all pegs are done, draws the end to its goal.
    /// Of a few such moves it takes the first that succeeds in rehearsals. There is but one order.
    fn demonstrate(
        &mut self,
        cell: &Cell,
        demonstrator: &mut Demonstrator,
        next: Option<usize>,
    ) -> Option<Move> {
        let beads = self.beads(cell.world());
        if self.count(&beads) == self.goal_count() {
            return None;
        }
        let guess = |index: usize, rng: &mut ChaCha8Rng| {
            let (bead, goal) = self.guess(index, &beads, rng)?;
            // The cup has to come down beside a peg, not on it.
            let aside = self.pegs.iter().map(|peg| {
                let off = beads[bead].0 - peg.center;
                let missing = (PEG_RADIUS_M + CUP_ROOM_M - off.norm()).clamp(0.0, MOST_ASIDE_M);
                off.normalize() * missing
            });
            let aside = aside.sum::<Vector2<f64>>();
            let pose = |p: Point2<f64>| Isometry2::new((self.anchor * p).coords, 0.0);
            Some(PickPlace {
                pick: pose(beads[bead].0 + aside),
                place: pose(goal + aside),
            })
        };
        let reached = |world: &World| (0..self.count(&self.beads(world))).collect();
        rehearsed(cell, &self.settings(), demonstrator, guess, next, reached)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::seed::EpisodeSeed;
    use proptest::prelude::*;

    fn away() -> Isometry3<f64> {
        Isometry3::translation(0.0, 0.0, 0.5)
    }

    fn scene(seed: impl Into<EpisodeSeed>, pegs: usize) -> (World, RoutingTask) {
        let mut world = World::new(&away());
        let routing = Routing {
            pegs: (pegs, pegs),
            ..Routing::default()
        };
        let anchor = Isometry2::new(Vector2::new(0.5, -0.3), 0.2);
        let task = routing.draw(&mut world, &anchor, &mut Draws::new(seed.into(), 0));
        (world, task)
    }

    /// Lays the cable along a polyline from its anchor; what is left over goes straight on.
    fn lie(world: &mut World, task: &RoutingTask, via: &[Point2<f64>], z: f64) {
        let mut at = Point2::new(ANCHOR_X_M, 0.0);
        let mut direction = Vector2::x();
        let mut via = via.iter().copied().peekable();
        for bead in &task.cable.beads[1..] {
            let mut left = BeadChain::PITCH_M;
            while let Some(next) = via.peek() {
                let way = next - at;
                if way.norm() > 0.0 {
                    direction = way.normalize();
                }
                if way.norm() > left {
                    break;
                }
                left -= way.norm();
                at = *next;
                via.next();
            }
            at += direction * left;
            let p = task.anchor * at;
            world.place(*bead, &Isometry3::translation(p.x, p.y, z));
        }
    }

    /// Past the pegs on the given sides, then to the end's goal.
    fn past(task: &RoutingTask, sides: &[f64]) -> Vec<Point2<f64>> {
        let passes = task.pegs.iter().zip(sides).map(|(peg, side)| {
            let off = Vector2::new(0.0, peg.side * side * (PASS_M + 2e-3));
            peg.center + off
        });
        passes.chain([task.end]).collect()
    }

    const ON_TABLE_Z_M: f64 = BeadChain::BEAD_RADIUS_M;

    #[test]
    fn a_cable_past_all_pegs_and_stretched_earns_everything() {
        for pegs in [2, 3] {
            for seed in 0..20 {
                let (mut world, mut task) = scene(seed, pegs);
                assert_eq!(task.goal_count(), pegs + 1);
                assert_eq!(task.max_steps(), pegs + 4);
                let path = past(&task, &[1.0; 3]);
                lie(&mut world, &task, &path, ON_TABLE_Z_M);
                assert_eq!(task.reached(&world), pegs + 1, "seed {seed}");
            }
        }
    }

    #[test]
    fn a_skipped_peg_ends_the_count() {
        let (mut world, mut task) = scene(1, 3);
        for (sides, expected) in [
            ([-1.0, 1.0, 1.0], 0),
            ([1.0, -1.0, 1.0], 1),
            ([1.0, 1.0, -1.0], 2),
        ] {
            let path = past(&task, &sides);
            lie(&mut world, &task, &path, ON_TABLE_Z_M);
            assert_eq!(task.reached(&world), expected, "{sides:?}");
        }
    }

    #[test]
    fn a_cable_that_only_passes_a_near_peg_is_not_led_round_it() {
        let (mut world, mut task) = scene(1, 2);
        // Past both pegs on the right sides and against them, but on from the second one it goes
        // where the cable started.
        let mut path = past(&task, &[1.0; 2]);
        let last = path.len() - 1;
        path[last] = path[last - 1] + Vector2::new(0.1, -0.05);
        lie(&mut world, &task, &path, ON_TABLE_Z_M);
        let beads = task.beads(&world);
        assert!(task.passes(&task.pegs[1], &beads) && task.is_against(&task.pegs[1], &beads));
        assert_eq!(task.reached(&world), 1);
    }

    #[test]
    fn a_cable_drawn_straight_to_the_goal_earns_nothing() {
        let (mut world, mut task) = scene(1, 3);
        // Round all pegs on the side where it started, the end where it should be.
        let below = Point2::new(0.0, START_Y_M);
        let path = [below, task.end];
        lie(&mut world, &task, &path, ON_TABLE_Z_M);
        assert_eq!(task.reached(&world), 0);
    }

    #[test]
    fn a_cable_on_top_of_the_pegs_earns_nothing() {
        let (mut world, mut task) = scene(1, 3);
        let path = past(&task, &[1.0; 3]);
        lie(&mut world, &task, &path, PEG_HEIGHT_M + ON_TABLE_Z_M);
        assert_eq!(task.reached(&world), 0);
    }

    #[test]
    fn a_cable_far_from_its_pegs_earns_nothing() {
        let (mut world, mut task) = scene(1, 2);
        let far = task
            .pegs
            .iter()
            .map(|peg| peg.pass() + Vector2::new(0.0, 0.03 * peg.side));
        let path: Vec<_> = far.collect();
        lie(&mut world, &task, &path, ON_TABLE_Z_M);
        assert_eq!(task.reached(&world), 0);
    }

    #[test]
    fn a_loop_round_a_peg_is_no_route() {
        let (mut world, mut task) = scene(1, 3);
        let center = task.pegs[0].center;
        let round = (0..=12).map(|i| {
            let angle = PI - 3.0 * PI * f64::from(i) / 12.0;
            center + Vector2::new(angle.cos(), angle.sin()) * (PASS_M + 4e-3)
        });
        let path: Vec<_> = round.collect();
        lie(&mut world, &task, &path, ON_TABLE_Z_M);
        assert_eq!(task.reached(&world), 0);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn a_scene_fits_its_footprint_comes_to_rest_and_earns_nothing(
            scene_seed in 0u64..1_000_000,
            start_after in 0u64..2,
            pegs in 2usize..=3,
        ) {
            let start = scene_seed + start_after;
            let (mut world, mut task) = scene(EpisodeSeed { scene: scene_seed, start }, pegs);
            for _ in 0..480 {
                world.step(&away());
            }
            prop_assert!(world.fastest_m_s() < 5e-3);
            prop_assert!(world.joint_error_m(&task.cable) < 1e-3);
            prop_assert_eq!(task.reached(&world), 0);
            for body in world.bodies() {
                let p = task.anchor.inverse_transform_point(&world.position(body).xy());
                prop_assert!(p.x.abs() < FOOTPRINT_M.0 / 2.0 && p.y.abs() < FOOTPRINT_M.1 / 2.0);
            }
            let end = task.end;
            prop_assert!(end.x.abs() < FOOTPRINT_M.0 / 2.0 && end.y.abs() < FOOTPRINT_M.1 / 2.0);
            for pose in task.goal_poses() {
                prop_assert!(pose.translation.vector.iter().all(|v| v.is_finite()));
            }
        }
    }
}
