//! *chaining*: a closed chain of beads to be wrapped round two fixed pegs (paper, appendix).
//!
//! Distance and radius of the pegs give four combinations, and with them the length of the chain;
//! the line through the pegs is turned at random. The chain starts as an oval beside the pegs. A
//! peg is wrapped when the chain winds round it and has a bead beyond it, with no bead on top of
//! it; a chain that crosses itself, as a figure of eight does, wraps nothing.
//!
//! Peg frame: origin half-way between the pegs, x from one to the other, the chain starts on the
//! side of -y.

use super::{ParameterError, Task, TaskModule, at_height, check_range, read_parameters};
use crate::colors;
use crate::world::{BeadChain, Mobility, Part, STEPS_PER_SECOND, Shape, World};
use nalgebra::{Isometry2, Isometry3, Point2, Point3, Vector2};
use pick_place::{PickPlace, PrimitiveSettings};
use rand::RngExt;
use rand::seq::IndexedRandom;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use serde_yaml_ng::Value;
use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI, TAU};
use ur5::Arm;

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
/// ... or by this where such guesses fail, ...
const WIDE_ANGLE_RAD: (f64, f64) = (-0.5, 1.6);
/// ... and leaves this much room between bead and peg.
const ROOM_M: (f64, f64) = (0.01, 0.016);
/// It grips a bead within this distance of its centre along x and y.
const NOISE_M: f64 = 1e-3;
/// Moves rehearsed before the last one is taken, come what may, and how many before wide guesses.
const GUESSES: usize = 10;
const NARROW_GUESSES: usize = 4;
/// A rehearsal ends this long after the release.
const REST_STEPS: usize = STEPS_PER_SECOND as usize / 2;

const SETTINGS: PrimitiveSettings = PrimitiveSettings {
    clearance_m: 0.12,
    lift_m: 0.045,
    travel_m_s: 1.0,
    carry_m_s: 0.15,
    descend_m_s: 0.1,
    acceleration_m_s2: 1.5,
};

/// Parameters of the module in a problem file.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Parameters {
    /// Distances of the pegs' axes to choose from, in m.
    distances_m: [f64; 2],
    /// Radii of the pegs to choose from, in m.
    radii_m: [f64; 2],
    /// The pegs' line is turned from the anchor's x by at most this, in rad.
    turn_rad: f64,
    /// How far a bead may be from the point beyond each peg, in m.
    tolerance_m: f64,
}

impl Default for Parameters {
    fn default() -> Self {
        Self {
            distances_m: [0.11, 0.14],
            radii_m: [0.015, 0.02],
            turn_rad: FRAC_PI_4,
            tolerance_m: 0.02,
        }
    }
}

/// Reads the module's parameters.
pub(super) fn configure(parameters: Value) -> Result<Box<dyn TaskModule>, ParameterError> {
    let parameters: Parameters = read_parameters(parameters)?;
    for distance in parameters.distances_m {
        check_range("distances_m", distance, 0.1, 0.15)?;
    }
    for radius in parameters.radii_m {
        check_range("radii_m", radius, 0.012, 0.025)?;
    }
    check_range("turn_rad", parameters.turn_rad, 0.0, FRAC_PI_4)?;
    check_range("tolerance_m", parameters.tolerance_m, 5e-3, 0.03)?;
    Ok(Box::new(Chaining { parameters }))
}

#[derive(Debug)]
struct Chaining {
    parameters: Parameters,
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
    parameters: Parameters,
}

impl TaskModule for Chaining {
    fn footprint_m(&self) -> Vector2<f64> {
        Vector2::new(FOOTPRINT_M.0, FOOTPRINT_M.1)
    }

    fn build(
        &self,
        world: &mut World,
        anchor: &Isometry2<f64>,
        rng: &mut ChaCha8Rng,
    ) -> Box<dyn Task> {
        Box::new(self.draw(world, anchor, rng))
    }
}

impl Chaining {
    fn draw(
        &self,
        world: &mut World,
        anchor: &Isometry2<f64>,
        rng: &mut ChaCha8Rng,
    ) -> ChainingTask {
        let parameters = self.parameters;
        let pegs = Pegs {
            distance_m: parameters.distances_m[rng.random_range(0..2)],
            radius_m: parameters.radii_m[rng.random_range(0..2)],
        };
        let turn = parameters.turn_rad * rng.random_range(-1.0..=1.0);
        let frame =
            anchor * Isometry2::new(Vector2::zeros(), turn) * Isometry2::translation(0.0, OFFSET_M);
        let width = rng.random_range(OVAL_WIDTH_M.0..OVAL_WIDTH_M.1);
        let gap = rng.random_range(OVAL_GAP_M.0..OVAL_GAP_M.1);
        let middle = Vector2::new(
            rng.random_range(-OVAL_SHIFT_M..OVAL_SHIFT_M),
            -pegs.radius_m - gap - width / 2.0,
        );
        let centers: Vec<_> = oval(pegs.bead_count(), width)
            .into_iter()
            .map(|p| (p + middle, BeadChain::BEAD_RADIUS_M))
            .collect();
        ChainingTask::new(world, &frame, pegs, &centers, parameters)
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
        parameters: Parameters,
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

    /// Number of pegs wrapped.
    fn wrapped(&self, world: &World) -> usize {
        let (beads, heights) = self.beads(world);
        if self.is_twisted(&beads) {
            return 0;
        }
        let wrapped = PEGS
            .iter()
            .filter(|peg| self.is_wrapped(**peg, &beads, &heights));
        wrapped.count()
    }

    /// A move that may wrap a peg: which bead, and where it goes. A wide guess takes any side of
    /// the peg, and beads near the one that belongs there.
    fn guess(
        &self,
        peg: Peg,
        wide: bool,
        beads: &[Point2<f64>],
        rng: &mut ChaCha8Rng,
    ) -> (usize, Point2<f64>) {
        let (least, most) = if wide { WIDE_ANGLE_RAD } else { ANGLE_RAD };
        let angle = rng.random_range(least..most);
        let outward = Vector2::new(peg.side() * angle.cos(), angle.sin());
        let center = self.pegs.center(peg);
        let bead = self.bead_for(&(center + outward * self.pegs.touch_m()), beads);
        let shift = if wide { rng.random_range(-3..=3) } else { 0 };
        let bead = (bead as i32 + shift).rem_euclid(beads.len() as i32) as usize;
        let reach = self.pegs.touch_m() + rng.random_range(ROOM_M.0..ROOM_M.1);
        (bead, center + outward * reach)
    }

    /// Carries out a move on a copy of pegs and chain, in the peg frame: how many pegs are wrapped
    /// when it has come to rest.
    fn rehearse(
        &self,
        beads: &[Point2<f64>],
        heights: &[f64],
        pick: &Point2<f64>,
        place: &Point2<f64>,
    ) -> usize {
        let height = heights.iter().copied().fold(0.0, f64::max);
        let mut tip = Tip {
            at: Point3::new(pick.x, pick.y, height + 2.0 * BeadChain::BEAD_RADIUS_M),
        };
        let mut world = World::new(&tip.pose());
        let copy: Vec<_> = beads.iter().copied().zip(heights.iter().copied()).collect();
        let frame = Isometry2::identity();
        let copy = Self::new(&mut world, &frame, self.pegs, &copy, self.parameters);
        let below = |p: &Point2<f64>| Point3::new(p.x, p.y, 0.0);
        tip.travel(&mut world, below(pick), SETTINGS.descend_m_s, true);
        if !world.grasp() {
            return 0;
        }
        let lifted = tip.at.z + SETTINGS.lift_m;
        let above = |p: &Point2<f64>| Point3::new(p.x, p.y, lifted);
        tip.travel(&mut world, above(pick), SETTINGS.carry_m_s, false);
        tip.travel(&mut world, above(place), SETTINGS.carry_m_s, false);
        tip.travel(&mut world, below(place), SETTINGS.descend_m_s, true);
        world.release();
        tip.travel(&mut world, above(place), SETTINGS.carry_m_s, false);
        for _ in 0..REST_STEPS {
            world.step(&tip.pose());
        }
        copy.wrapped(&world)
    }

    /// Whether the chain crosses itself, but for kinks too short to go round a peg.
    fn is_twisted(&self, beads: &[Point2<f64>]) -> bool {
        let round_peg = TAU * self.pegs.touch_m() / BeadChain::PITCH_M;
        crosses_itself(beads, round_peg as usize)
    }

    /// Whether the chain, which does not cross itself, lies round a peg.
    fn is_wrapped(&self, peg: Peg, beads: &[Point2<f64>], heights: &[f64]) -> bool {
        let center = self.pegs.center(peg);
        // A bead against the peg, or one leaning on that, is lower than the peg's top.
        let near = self.pegs.radius_m + 2.0 * BeadChain::BEAD_RADIUS_M;
        let mut beads_and_heights = beads.iter().zip(heights);
        let none_on_top =
            beads_and_heights.all(|(p, z)| (p - center).norm() > near || *z < PEG_HEIGHT_M);
        let beyond = self.pegs.beyond(peg);
        let one_beyond = beads
            .iter()
            .any(|p| (p - beyond).norm() < self.parameters.tolerance_m);
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

    fn reached(&mut self, world: &World) -> usize {
        self.wrapped(world)
    }

    /// Two stages: lifts the bead that belongs beyond a peg over to there, for one peg, then for
    /// the other. Of a few such moves, with noise, it takes the first that succeeds in a rehearsal.
    fn demonstrate(&mut self, world: &World, rng: &mut ChaCha8Rng) -> Option<PickPlace> {
        let (beads, heights) = self.beads(world);
        let wrapped = self.wrapped(world);
        if wrapped == PEGS.len() {
            return None;
        }
        let open: Vec<_> = PEGS
            .into_iter()
            .filter(|peg| !self.is_wrapped(*peg, &beads, &heights))
            .collect();
        let open = if open.is_empty() { PEGS.to_vec() } else { open };
        let mut action = None;
        for guess in 0..GUESSES {
            let peg = *open.choose(rng)?;
            let (bead, place) = self.guess(peg, guess >= NARROW_GUESSES, &beads, rng);
            let mut noise = || rng.random_range(-NOISE_M..NOISE_M);
            let pick = beads[bead] + Vector2::new(noise(), noise());
            let reached = self.rehearse(&beads, &heights, &pick, &place);
            let pose = |p: Point2<f64>| Isometry2::new((self.frame * p).coords, 0.0);
            action = Some(PickPlace {
                pick: pose(pick),
                place: pose(place),
            });
            if reached > wrapped {
                break;
            }
        }
        action
    }
}

/// The suction tip of a rehearsal.
struct Tip {
    at: Point3<f64>,
}

impl Tip {
    fn pose(&self) -> Isometry3<f64> {
        Arm::tip_down(&Isometry2::translation(self.at.x, self.at.y), self.at.z)
    }

    /// Moves in a straight line, to its end or until contact.
    fn travel(&mut self, world: &mut World, to: Point3<f64>, speed_m_s: f64, until_contact: bool) {
        let way = to - self.at;
        let steps = (way.norm() / speed_m_s * f64::from(STEPS_PER_SECOND)).ceil();
        let start = self.at;
        for step in 1..=steps as usize {
            self.at = start + way * (step as f64 / steps);
            world.step(&self.pose());
            if until_contact && world.touches() {
                break;
            }
        }
    }
}
