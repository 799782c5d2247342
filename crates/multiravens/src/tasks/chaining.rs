//! *chaining*: a closed chain of beads to be wrapped round two fixed pegs (paper, appendix).
//!
//! Distance and radius of the pegs give four combinations, and with them the length of the chain;
//! the line through the pegs is turned at random. The chain starts as an oval beside the pegs. A
//! peg is wrapped when the chain winds round it and has a bead beyond it, with no bead on top of
//! it; a chain that crosses itself, as a figure of eight does, wraps nothing.
//!
//! Peg frame: origin half-way between the pegs, x from one to the other, the chain starts on the
//! side of -y.

use super::{
    Care, Demonstrator, Move, ParameterError, Task, TaskModule, at_height, check_range, rehearsed,
};
use crate::cell::Cell;
use crate::colors;
use crate::seed::Draws;
use crate::world::{BeadChain, Mobility, Part, Shape, World};
use nalgebra::{Isometry2, Isometry3, Point2, Point3, Rotation2, Vector2};
use pick_place::{PickPlace, PrimitiveSettings};
use rand::RngExt;
use rand::seq::IndexedRandom;
use rand_chacha::ChaCha8Rng;
use serde::Deserialize;
use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI, TAU};

const PEG_HEIGHT_M: f64 = 0.02;
const PEG_FRICTION: f64 = 0.3;
/// Length of the chain beyond what fits tightly round both pegs, at least.
const SLACK_M: f64 = 0.08;
/// The chain starts as an oval: two straight strands this far apart, ...
const OVAL_WIDTH_M: (f64, f64) = (0.055, 0.065);
/// ... the nearer one this far from the pegs' rims, ...
const OVAL_GAP_M: (f64, f64) = (0.008, 0.013);
/// ... shifted along the pegs' line by at most this.
const OVAL_SHIFT_M: f64 = 0.008;
/// Distance of the pegs' line from the anchor, so that pegs and oval together are about it.
const OFFSET_M: f64 = 0.04;
const FOOTPRINT_M: (f64, f64) = (0.3, 0.29);

/// The demonstrator goes beyond a peg in a direction turned from outwards by this, ...
const ANGLE_RAD: (f64, f64) = (0.5, 0.85);
/// ... and leaves this much room between bead and peg.
const ROOM_M: (f64, f64) = (0.01, 0.016);
/// Where that fails, it tries other directions, ...
const WIDE_ANGLE_RAD: (f64, f64) = (-0.4, 1.3);
/// ... beads up to so many further along, ...
const BEADS_ASIDE: i32 = 4;
/// ... and beads next to the peg across it, in a direction turned by at most this.
const ACROSS_RAD: f64 = 0.8;
/// The first so many guesses are narrow.
const NARROW_GUESSES: usize = 3;

const SETTINGS: PrimitiveSettings = PrimitiveSettings {
    clearance_m: 0.09,
    lift_m: 0.045,
    travel_m_s: 1.0,
    carry_m_s: 0.15,
    descend_m_s: 0.04,
    acceleration_m_s2: 1.5,
};

/// The module's parameters in a problem file.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Chaining {
    /// Distances of the pegs' axes to choose from, in m.
    distances_m: [f64; 2],
    /// Radii of the pegs to choose from, in m.
    radii_m: [f64; 2],
    /// The pegs' line is turned from the anchor's x by at most this, in rad.
    turn_rad: f64,
    /// How far a bead may be from the point beyond each peg, in m.
    tolerance_m: f64,
}

impl Default for Chaining {
    fn default() -> Self {
        Self {
            distances_m: [0.11, 0.14],
            radii_m: [0.015, 0.02],
            turn_rad: FRAC_PI_4,
            tolerance_m: 0.02,
        }
    }
}

/// Where the pegs are; everything in the peg frame.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Pegs {
    distance_m: f64,
    radius_m: f64,
}

/// Which peg: the one at -x or at +x.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Peg {
    Left,
    Right,
}

const PEGS: [Peg; 2] = [Peg::Left, Peg::Right];

impl Peg {
    fn side(self) -> f64 {
        match self {
            Self::Left => -1.0,
            Self::Right => 1.0,
        }
    }
}

impl Pegs {
    fn center(&self, peg: Peg) -> Point2<f64> {
        Point2::new(peg.side() * self.distance_m / 2.0, 0.0)
    }

    /// Distance of a bead's centre from the axis of the peg it lies against.
    fn touch_m(&self) -> f64 {
        self.radius_m + BeadChain::BEAD_RADIUS_M
    }

    /// Where a bead lies against a peg on the side away from the other one.
    fn beyond(&self, peg: Peg) -> Point2<f64> {
        self.center(peg) + Vector2::new(peg.side() * self.touch_m(), 0.0)
    }

    /// Length of the tight belt round both pegs.
    fn belt_m(&self) -> f64 {
        2.0 * self.distance_m + TAU * self.touch_m()
    }

    fn bead_count(&self) -> usize {
        ((self.belt_m() + SLACK_M) / BeadChain::PITCH_M).ceil() as usize
    }

    /// The point at a share of the belt, anticlockwise from where it is beyond the right peg.
    fn on_belt(&self, share: f64) -> Point2<f64> {
        let quarter = FRAC_PI_2 * self.touch_m();
        let mut along = share.rem_euclid(1.0) * self.belt_m();
        let (half, around) = (self.distance_m / 2.0, 2.0 * quarter);
        let on_arc = |peg: Peg, angle: f64| {
            self.center(peg) + Vector2::new(angle.cos(), angle.sin()) * self.touch_m()
        };
        if along < quarter {
            return on_arc(Peg::Right, along / self.touch_m());
        }
        along -= quarter;
        if along < self.distance_m {
            return Point2::new(half - along, self.touch_m());
        }
        along -= self.distance_m;
        if along < around {
            return on_arc(Peg::Left, FRAC_PI_2 + along / self.touch_m());
        }
        along -= around;
        if along < self.distance_m {
            return Point2::new(along - half, -self.touch_m());
        }
        along -= self.distance_m;
        on_arc(Peg::Right, along / self.touch_m() - FRAC_PI_2)
    }
}

struct ChainingTask {
    /// World from peg frame.
    frame: Isometry2<f64>,
    pegs: Pegs,
    chain: BeadChain,
    parameters: Chaining,
}

impl TaskModule for Chaining {
    fn check(&self, _anchor: &Isometry2<f64>) -> Result<(), ParameterError> {
        // Within these a chain has 31 to 37 beads and all keeps to the footprint.
        for distance in self.distances_m {
            check_range("distances_m", distance, 0.11, 0.14)?;
        }
        for radius in self.radii_m {
            check_range("radii_m", radius, 0.015, 0.02)?;
        }
        check_range("turn_rad", self.turn_rad, 0.0, FRAC_PI_4)?;
        check_range("tolerance_m", self.tolerance_m, 5e-3, 0.03)
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

impl Chaining {
    fn draw(&self, world: &mut World, anchor: &Isometry2<f64>, draws: &mut Draws) -> ChainingTask {
        let pegs = Pegs {
            distance_m: self.distances_m[draws.scene().random_range(0..2)],
            radius_m: self.radii_m[draws.scene().random_range(0..2)],
        };
        let turn = self.turn_rad * draws.scene().random_range(-1.0..=1.0);
        let frame =
            anchor * Isometry2::new(Vector2::zeros(), turn) * Isometry2::translation(0.0, OFFSET_M);
        let (width, middle) = draws.start(|rng| {
            let width = rng.random_range(OVAL_WIDTH_M.0..OVAL_WIDTH_M.1);
            let gap = rng.random_range(OVAL_GAP_M.0..OVAL_GAP_M.1);
            let shift = rng.random_range(-OVAL_SHIFT_M..OVAL_SHIFT_M);
            (
                width,
                Vector2::new(shift, -pegs.radius_m - gap - width / 2.0),
            )
        });
        let centers: Vec<_> = oval(pegs.bead_count(), width)
            .into_iter()
            .map(|p| (p + middle, BeadChain::BEAD_RADIUS_M))
            .collect();
        ChainingTask::new(world, &frame, pegs, &centers, *self)
    }
}

/// A closed chain laid as two straight strands and two half circles, anticlockwise about the origin.
fn oval(beads: usize, width_m: f64) -> Vec<Point2<f64>> {
    let radius = width_m / 2.0;
    let around = beads as f64 * BeadChain::PITCH_M;
    // The belt round two pegs of that radius.
    let belt = Pegs {
        distance_m: around / 2.0 - PI * radius,
        radius_m: radius - BeadChain::BEAD_RADIUS_M,
    };
    (0..beads)
        .map(|bead| belt.on_belt(bead as f64 / beads as f64))
        .collect()
}

/// How often a closed polygon winds anticlockwise round a point.
fn winding(polygon: &[Point2<f64>], about: &Point2<f64>) -> i32 {
    let turns = edges(polygon).map(|(a, b)| {
        let (a, b) = (a - about, b - about);
        a.perp(&b).atan2(a.dot(&b))
    });
    (turns.sum::<f64>() / TAU).round() as i32
}

/// Whether edges of a closed polygon cross that are at least `apart` edges apart, either way round.
fn crosses_itself(polygon: &[Point2<f64>], apart: usize) -> bool {
    let edges: Vec<_> = edges(polygon).collect();
    let side =
        |from: Point2<f64>, to: Point2<f64>, p: Point2<f64>| (to - from).perp(&(p - from)) > 0.0;
    let cross = |(a, b): (Point2<f64>, Point2<f64>), (c, d): (Point2<f64>, Point2<f64>)| {
        side(a, b, c) != side(a, b, d) && side(c, d, a) != side(c, d, b)
    };
    edges.iter().enumerate().any(|(index, edge)| {
        let others = edges.iter().enumerate().skip(index + apart);
        others
            .take_while(|(other, _)| index + edges.len() - other >= apart)
            .any(|(_, other)| cross(*edge, *other))
    })
}

/// Edges of a closed polygon.
fn edges(polygon: &[Point2<f64>]) -> impl Iterator<Item = (Point2<f64>, Point2<f64>)> + '_ {
    let next = polygon.iter().cycle().skip(1);
    polygon.iter().copied().zip(next.copied())
}

impl ChainingTask {
    /// Pegs and a chain with these centres, in the peg frame, and heights.
    fn new(
        world: &mut World,
        frame: &Isometry2<f64>,
        pegs: Pegs,
        beads: &[(Point2<f64>, f64)],
        parameters: Chaining,
    ) -> Self {
        for peg in PEGS {
            let pose = frame * Isometry2::from(pegs.center(peg).coords);
            world.add(&Part {
                shape: Shape::Cylinder {
                    radius_m: pegs.radius_m,
                    length_m: PEG_HEIGHT_M,
                },
                pose: at_height(&pose, PEG_HEIGHT_M / 2.0),
                mobility: Mobility::Fixed,
                friction: PEG_FRICTION,
                rgb: colors::PEG,
            });
        }
        let centers: Vec<_> = beads
            .iter()
            .map(|(p, z)| {
                let p = frame * p;
                Point3::new(p.x, p.y, *z)
            })
            .collect();
        let chain = world.add_bead_chain(&centers, true, false, |_| colors::GREY);
        Self {
            frame: *frame,
            pegs,
            chain,
            parameters,
        }
    }

    /// The beads' centres in the peg frame, and their heights.
    fn beads(&self, world: &World) -> (Vec<Point2<f64>>, Vec<f64>) {
        let centers = self.chain.beads.iter().map(|bead| world.position(*bead));
        centers
            .map(|p| (self.frame.inverse_transform_point(&p.xy()), p.z))
            .unzip()
    }

    /// Indices in [`PEGS`] of those that are wrapped.
    fn wrapped(&self, world: &World) -> Vec<usize> {
        let (beads, heights) = self.beads(world);
        if self.is_twisted(&beads) {
            return Vec::new();
        }
        let pegs = PEGS.iter().enumerate();
        let wrapped = pegs.filter(|(_, peg)| self.is_wrapped(**peg, &beads, &heights));
        wrapped.map(|(index, _)| index).collect()
    }

    /// The bead that belongs beyond a peg, in a direction turned from outwards by an angle, and a place so far from the peg's axis.
    fn beyond_peg(
        &self,
        peg: Peg,
        beads: &[Point2<f64>],
        angle_rad: f64,
        reach_m: f64,
    ) -> (usize, Point2<f64>) {
        let center = self.pegs.center(peg);
        let outward = Vector2::new(peg.side() * angle_rad.cos(), angle_rad.sin());
        let bead = self.bead_for(&(center + outward * self.pegs.touch_m()), beads);
        (bead, center + outward * reach_m)
    }

    /// A move that may wrap a peg: which bead, and where it goes. The bead that belongs beyond the
    /// peg goes there; a wide guess takes one near it, in a direction that is further off, or one
    /// next to the peg across it.
    fn guess(
        &self,
        peg: Peg,
        wide: bool,
        beads: &[Point2<f64>],
        rng: &mut ChaCha8Rng,
    ) -> Option<(usize, Point2<f64>)> {
        let center = self.pegs.center(peg);
        let reach = self.pegs.touch_m() + rng.random_range(ROOM_M.0..ROOM_M.1);
        let aside = rng.random_range(-BEADS_ASIDE..=BEADS_ASIDE);
        let near = |bead: usize| (bead as i32 + aside).rem_euclid(beads.len() as i32) as usize;
        if wide && rng.random_bool(0.5) {
            let off = |bead: &usize| (beads[*bead] - center).norm();
            let nearest = (0..beads.len()).min_by(|a, b| off(a).total_cmp(&off(b)))?;
            let turn = Rotation2::new(rng.random_range(-ACROSS_RAD..ACROSS_RAD));
            let across = (center - beads[nearest]).try_normalize(1e-9)?;
            return Some((near(nearest), center + turn * across * reach));
        }
        let (least, most) = if wide { WIDE_ANGLE_RAD } else { ANGLE_RAD };
        let angle = rng.random_range(least..most);
        let (bead, place) = self.beyond_peg(peg, beads, angle, reach);
        let bead = if wide { near(bead) } else { bead };
        Some((bead, place))
    }

    /// The move in the middle of what narrow guesses are drawn from.
    fn middle(&self, peg: Peg, beads: &[Point2<f64>]) -> (usize, Point2<f64>) {
        let [angle, room] = [ANGLE_RAD, ROOM_M].map(|(least, most)| (least + most) / 2.0);
        self.beyond_peg(peg, beads, angle, self.pegs.touch_m() + room)
    }

    /// Whether the chain crosses itself, but for kinks too short to go round a peg.
    fn is_twisted(&self, beads: &[Point2<f64>]) -> bool {
        let round_peg = TAU * self.pegs.touch_m() / BeadChain::PITCH_M;
        crosses_itself(beads, round_peg as usize)
    }

    /// Whether the chain, which does not cross itself, lies round a peg.
    fn is_wrapped(&self, peg: Peg, beads: &[Point2<f64>], heights: &[f64]) -> bool {
        let center = self.pegs.center(peg);
        let low = |z: f64| z < PEG_HEIGHT_M;
        let near = self.pegs.touch_m() + BeadChain::PITCH_M;
        let mut all = beads.iter().zip(heights);
        let none_on_top = all.all(|(p, z)| low(*z) || (p - center).norm() > near);
        let beyond = self.pegs.beyond(peg);
        let mut all = beads.iter().zip(heights);
        let one_beyond =
            all.any(|(p, z)| low(*z) && (p - beyond).norm() < self.parameters.tolerance_m);
        winding(beads, &center).abs() == 1 && none_on_top && one_beyond
    }

    /// The bead that belongs to a point of the belt, when the chain is laid along the belt with
    /// beads as near as possible to where they are.
    fn bead_for(&self, goal: &Point2<f64>, beads: &[Point2<f64>]) -> usize {
        let count = beads.len();
        let area: f64 = edges(beads).map(|(a, b)| a.coords.perp(&b.coords)).sum();
        let direction = if area > 0.0 { 1.0 } else { -1.0 };
        let belt = |bead: usize, shift: usize| {
            let share = (bead as f64 + shift as f64) / count as f64;
            self.pegs.on_belt(direction * share)
        };
        let cost = |shift: usize| {
            let off = beads.iter().enumerate();
            off.map(|(bead, p)| (p - belt(bead, shift)).norm_squared())
                .sum::<f64>()
        };
        let shift = (0..count).min_by(|a, b| cost(*a).total_cmp(&cost(*b)));
        let shift = shift.unwrap_or_default();
        let off = |bead: &usize| (belt(*bead, shift) - goal).norm_squared();
        let nearest = (0..count).min_by(|a, b| off(a).total_cmp(&off(b)));
        nearest.unwrap_or_default()
    }
}

impl Task for ChainingTask {
    fn goal_count(&self) -> usize {
        PEGS.len()
    }

    fn max_steps(&self) -> usize {
        PEGS.len() + 2
    }

    fn settings(&self) -> PrimitiveSettings {
        SETTINGS
    }

    fn goal_poses(&self) -> Vec<Isometry3<f64>> {
        let poses = PEGS.map(|peg| {
            let beyond = self.frame * Isometry2::from(self.pegs.beyond(peg).coords);
            at_height(&beyond, BeadChain::BEAD_RADIUS_M)
        });
        poses.to_vec()
    }

    fn goals_reached(&mut self, world: &World) -> Vec<usize> {
        self.wrapped(world)
    }

    /// Two stages: lifts the bead that belongs beyond a peg over to there, for one peg, then for
    /// the other. Of a few such moves it takes the first that succeeds in rehearsals.
    fn demonstrate(
        &mut self,
        cell: &Cell,
        demonstrator: &mut Demonstrator,
        next: Option<usize>,
    ) -> Option<Move> {
        let world = cell.world();
        let (beads, heights) = self.beads(world);
        if self.wrapped(world).len() == PEGS.len() {
            return None;
        }
        let candidates = next.map_or(PEGS.to_vec(), |next| vec![PEGS[next]]);
        let open = candidates
            .iter()
            .filter(|peg| !self.is_wrapped(**peg, &beads, &heights));
        let open: Vec<_> = open.copied().collect();
        let open = if open.is_empty() { candidates } else { open };
        let pose = |p: Point2<f64>| Isometry2::new((self.frame * p).coords, 0.0);
        let begins_in_the_middle = demonstrator.care == Care::Careful;
        let guess = |index: usize, rng: &mut ChaCha8Rng| {
            let peg = *open.choose(rng)?;
            let (bead, place) = if begins_in_the_middle && index == 0 {
                self.middle(peg, &beads)
            } else {
                self.guess(peg, index >= NARROW_GUESSES, &beads, rng)?
            };
            Some(PickPlace {
                pick: pose(beads[bead]),
                place: pose(place),
            })
        };
        rehearsed(cell, &SETTINGS, demonstrator, guess, next, |world| {
            self.wrapped(world)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::seed::EpisodeSeed;
    use crate::world::STEPS_PER_SECOND;
    use rand::SeedableRng;
    use std::collections::BTreeSet;

    const ON_TABLE_M: f64 = BeadChain::BEAD_RADIUS_M;

    fn away() -> Isometry3<f64> {
        Isometry3::translation(0.0, 0.0, 0.5)
    }

    fn drawn(seed: impl Into<EpisodeSeed>) -> (World, ChainingTask) {
        let mut world = World::new(&away());
        let module = Chaining::default();
        let anchor = Isometry2::new(Vector2::new(0.5, 0.35), 0.0);
        let task = module.draw(&mut world, &anchor, &mut Draws::new(seed.into(), 0));
        (world, task)
    }

    fn pegs() -> Pegs {
        Pegs {
            distance_m: 0.14,
            radius_m: 0.015,
        }
    }

    /// Pegs with a chain laid like this, in the peg frame.
    fn laid(beads: &[(Point2<f64>, f64)]) -> (World, ChainingTask) {
        let mut world = World::new(&away());
        let frame = Isometry2::new(Vector2::new(0.5, 0.3), 0.4);
        let task = ChainingTask::new(&mut world, &frame, pegs(), beads, Chaining::default());
        (world, task)
    }

    fn rest(world: &mut World) {
        for _ in 0..STEPS_PER_SECOND {
            world.step(&away());
        }
        assert!(world.fastest_m_s() < 5e-3);
    }

    /// An oval round both pegs, moved by `off`.
    fn round_both(off: Vector2<f64>) -> Vec<(Point2<f64>, f64)> {
        let width = 2.0 * pegs().touch_m() + 0.016;
        let oval = oval(pegs().bead_count(), width);
        oval.into_iter().map(|p| (p + off, ON_TABLE_M)).collect()
    }

    /// A figure of eight round both pegs, one strand above the other where they cross.
    fn figure_of_eight() -> Vec<(Point2<f64>, f64)> {
        let at = |t: f64| Point2::new(0.105 * t.cos(), 0.066 * t.sin() * t.cos());
        let (mut beads, mut last) = (Vec::new(), at(0.0));
        for step in 0..100_000 {
            let t = TAU * f64::from(step) / 1e5;
            if beads.is_empty() || (at(t) - last).norm() >= BeadChain::PITCH_M {
                last = at(t);
                let above = (t - FRAC_PI_2).abs() < 0.4;
                let z = if above { 2.5 * ON_TABLE_M } else { ON_TABLE_M };
                beads.push((last, z));
            }
        }
        beads
    }

    #[test]
    fn a_chain_round_both_pegs_earns_everything() {
        let (mut world, mut task) = laid(&round_both(Vector2::zeros()));
        rest(&mut world);
        assert_eq!(task.reached(&world), 2);
        let rng = ChaCha8Rng::seed_from_u64(0);
        let next = task.demonstrate(&Cell::around(&world), &mut rng.into(), None);
        assert!(next.is_none());
    }

    #[test]
    fn a_figure_of_eight_earns_nothing() {
        let (mut world, mut task) = laid(&figure_of_eight());
        rest(&mut world);
        let (beads, heights) = task.beads(&world);
        // Each peg for itself is wrapped, in opposite directions.
        let turns = PEGS.map(|peg| winding(&beads, &task.pegs.center(peg)));
        assert_eq!(turns[0] * turns[1], -1);
        assert!(
            PEGS.iter()
                .all(|peg| task.is_wrapped(*peg, &beads, &heights))
        );
        assert_eq!(task.reached(&world), 0);
    }

    #[test]
    fn a_chain_round_one_peg_earns_half() {
        // A circle.
        let (count, shift) = (28, Vector2::new(-0.037, 0.0));
        let around: Vec<_> = oval(count, count as f64 * BeadChain::PITCH_M / PI)
            .into_iter()
            .map(|p| (p + shift, ON_TABLE_M))
            .collect();
        let (mut world, mut task) = laid(&around);
        let beads = task.beads(&world).0;
        assert_eq!(winding(&beads, &pegs().center(Peg::Left)), 1);
        assert_eq!(winding(&beads, &pegs().center(Peg::Right)), 0);
        rest(&mut world);
        assert_eq!(task.reached(&world), 1);
    }

    #[test]
    fn a_chain_beside_or_between_the_pegs_earns_nothing() {
        for off in [-0.06, 0.06] {
            let (mut world, mut task) = laid(&round_both(Vector2::new(0.0, off)));
            rest(&mut world);
            assert_eq!(task.reached(&world), 0);
        }
        // Folded up between the pegs, as far as it goes.
        let zigzag: Vec<_> = (0..24)
            .map(|bead| {
                let (column, row) = (f64::from(bead % 12) - 5.5, f64::from(bead / 12) - 0.5);
                let x = if row < 0.0 { column } else { -column };
                let p = Point2::new(x, row) * 0.6 * BeadChain::PITCH_M;
                (p, ON_TABLE_M)
            })
            .collect();
        let (world, mut task) = laid(&zigzag);
        assert_eq!(task.reached(&world), 0);
    }

    #[test]
    fn a_chain_on_top_of_a_peg_has_not_wrapped_it() {
        // The end goes across the right peg, the other goes round the left one.
        let width = 2.0 * pegs().touch_m() + 0.016;
        let right = pegs().center(Peg::Right);
        let beads: Vec<_> = oval(31, width)
            .into_iter()
            .map(|p| {
                let p = p - Vector2::new(0.011, 0.0);
                let on_top = (p - right).norm() < pegs().touch_m();
                (p, if on_top { PEG_HEIGHT_M } else { 0.0 } + ON_TABLE_M)
            })
            .collect();
        let (world, mut task) = laid(&beads);
        let (positions, heights) = task.beads(&world);
        assert_eq!(winding(&positions, &right), 1);
        assert!(heights.iter().any(|z| *z > PEG_HEIGHT_M));
        assert!(!task.is_wrapped(Peg::Right, &positions, &heights));
        assert_eq!(task.reached(&world), 1);
    }

    #[test]
    fn a_chain_held_above_the_pegs_earns_nothing() {
        let above: Vec<_> = round_both(Vector2::zeros())
            .into_iter()
            .map(|(p, _)| (p, 0.04))
            .collect();
        let (world, mut task) = laid(&above);
        assert_eq!(task.reached(&world), 0);
    }

    #[test]
    fn crossings_count_where_both_parts_are_long_enough() {
        let square = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)];
        let bow_tie = [(0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.0)];
        let points = |p: [(f64, f64); 4]| p.map(|(x, y)| Point2::new(x, y));
        assert!(!crosses_itself(&points(square), 2));
        assert!(crosses_itself(&points(bow_tie), 2));
        assert!(!crosses_itself(&points(bow_tie), 3));
        // A kink of a few beads is no twist.
        let mut beads = round_both(Vector2::zeros());
        beads.swap(4, 5);
        let (world, task) = laid(&beads);
        let positions = task.beads(&world).0;
        assert!(crosses_itself(&positions, 2));
        assert!(!task.is_twisted(&positions));
    }

    #[test]
    fn tasks_start_unsolved_at_rest_within_the_footprint() {
        let mut combinations = BTreeSet::new();
        let mut turns: Vec<f64> = Vec::new();
        for seed in 0..60 {
            let (mut world, mut task) = drawn(seed);
            let half = Vector2::new(FOOTPRINT_M.0, FOOTPRINT_M.1) / 2.0;
            let keeps_in = |p: Point2<f64>, radius: f64| {
                let off = p - Point2::new(0.5, 0.35);
                off.abs() < half - Vector2::repeat(radius)
            };
            let pegs = task.pegs;
            for bead in &task.chain.beads {
                let p = world.position(*bead);
                assert!(
                    keeps_in(p.xy(), BeadChain::BEAD_RADIUS_M),
                    "seed {seed}: {p}"
                );
            }
            for share in 0..40 {
                let p = task.frame * pegs.on_belt(f64::from(share) / 40.0);
                // The slack lies somewhere about the belt.
                assert!(keeps_in(p, 0.02), "seed {seed}: {p}");
            }
            assert!((30..=40).contains(&pegs.bead_count()));
            combinations.insert((
                (pegs.distance_m * 1e3) as u32,
                (pegs.radius_m * 1e3) as u32,
                pegs.bead_count(),
            ));
            turns.push(task.frame.rotation.angle());
            if seed < 8 {
                let before = task.beads(&world).0;
                rest(&mut world);
                let after = task.beads(&world).0;
                let moved = before.iter().zip(&after).map(|(a, b)| (a - b).norm());
                assert!(moved.fold(0.0, f64::max) < 2e-3);
                assert_eq!(task.reached(&world), 0);
            }
        }
        assert_eq!(combinations.len(), 4, "{combinations:?}");
        assert!(turns.iter().all(|turn| turn.abs() <= FRAC_PI_4));
        assert!(turns.iter().any(|turn| *turn > 0.6) && turns.iter().any(|turn| *turn < -0.6));
    }

    #[test]
    fn a_rehearsal_leaves_the_world_as_it_is_and_repeats() {
        let (world, mut task) = drawn(3);
        let before = world.state_hash();
        let actions = [0, 0, 1].map(|seed| {
            let rng = ChaCha8Rng::seed_from_u64(seed);
            task.demonstrate(&Cell::around(&world), &mut rng.into(), None)
                .map(|next| next.action)
        });
        assert_eq!(actions[0], actions[1]);
        assert_ne!(actions[0], actions[2]);
        assert_eq!(world.state_hash(), before);
    }

    #[test]
    fn parameters_out_of_range_are_refused_by_name() {
        for (text, name) in [
            ("{distances_m: [0.11, 0.3]}", "distances_m"),
            ("{radii_m: [0.0, 0.02]}", "radii_m"),
            ("{turn_rad: 1.0}", "turn_rad"),
            ("{tolerance_m: .nan}", "tolerance_m"),
            ("{beads: 12}", "beads"),
        ] {
            let value = serde_yaml_ng::from_str(text).unwrap();
            let module = crate::tasks::configure::<Chaining>(value);
            let checked = module.and_then(|module| module.check(&Isometry2::identity()));
            let error = checked.unwrap_err();
            assert!(error.to_string().contains(name), "{error}");
        }
    }
}
