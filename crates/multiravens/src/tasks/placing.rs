//! *placing*: nine disks onto a 3 x 3 grid on a dark grey square plate (paper, appendix).
//!
//! Five "even" disks start left of the plate, four "odd" ones right of it. Cells are numbered row
//! by row; even disks belong on cells of even number, odd ones on the others. The disks of a
//! parity are big or small, which gives four goal configurations. Any disk of the right parity
//! will do for a cell.
//!
//! Module frame: x along the table's short side when the anchor's yaw is 0; left is +y.

use super::{Demonstrator, Move, ParameterError, Task, TaskModule, at_height, check_range};
use crate::colors;
use crate::seed::Draws;
use crate::world::{BodyId, Mobility, Part, Shape, World};
use nalgebra::{Isometry2, Isometry3, Point2, Vector2, Vector3};
use pick_place::{PickPlace, PrimitiveSettings};
use rand::RngExt;
use rand::seq::IndexedRandom;
use rand_chacha::ChaCha8Rng;
use serde::Deserialize;
use std::f64::consts::TAU;

/// Edge length of the plate, and its height.
const PLATE_M: f64 = 0.22;
const PLATE_HEIGHT_M: f64 = 0.004;
/// Distance of neighbouring cells' centres.
const PITCH_M: f64 = 0.07;
const BIG_RADIUS_M: f64 = 0.026;
const SMALL_RADIUS_M: f64 = 0.019;
const DISK_HEIGHT_M: f64 = 0.012;
const DISK_MASS_KG: f64 = 0.02;
const SUCTION_FORCE_N: f64 = 5.0;
const FRICTION: f64 = 0.5;
/// Disks start in a strip on either side of the plate: from here to there along |y|, ...
const STRIP_M: (f64, f64) = (0.12, 0.2);
/// ... and as long as this along x, ...
const STRIP_LENGTH_M: f64 = 0.42;
/// ... with at least this gap.
const START_GAP_M: f64 = 0.01;
/// Places drawn for a disk that is in the way.
const ASIDE_DRAWS: usize = 200;
/// A disk lies on the plate if its centre is this close to the height where it should be, ...
const HEIGHT_TOLERANCE_M: f64 = 2e-3;
/// ... and its axis this close to upright.
const TILT_TOLERANCE_RAD: f64 = 0.1;

const SETTINGS: PrimitiveSettings = PrimitiveSettings {
    clearance_m: 0.08,
    lift_m: 0.05,
    travel_m_s: 1.2,
    carry_m_s: 0.8,
    descend_m_s: 0.2,
    acceleration_m_s2: 4.0,
};

/// The module's parameters in a problem file.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Placing {
    /// How far a disk's centre may be from its cell's, in m.
    tolerance_m: f64,
    /// Size of the even disks: `big`, `small`, or `random`.
    even: Size,
    /// Size of the odd disks.
    odd: Size,
    /// The demonstrator picks within this share of a disk's radius about its centre.
    pick_spread: f64,
}

#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Size {
    Random,
    Big,
    Small,
}

impl Default for Placing {
    fn default() -> Self {
        Self {
            tolerance_m: 0.01,
            even: Size::Random,
            odd: Size::Random,
            pick_spread: 0.25,
        }
    }
}

/// A disk, and whether it is an even one.
#[derive(Clone, Copy, Debug)]
struct Disk {
    body: BodyId,
    even: bool,
    radius_m: f64,
}

/// A goal.
#[derive(Clone, Copy, Debug)]
struct Cell {
    center: Point2<f64>,
    even: bool,
}

struct PlacingTask {
    disks: Vec<Disk>,
    cells: Vec<Cell>,
    yaw_rad: f64,
    parameters: Placing,
}

impl TaskModule for Placing {
    fn check(&self, _anchor: &Isometry2<f64>) -> Result<(), ParameterError> {
        // Beyond half the pitch a disk would be near two cells.
        check_range("tolerance_m", self.tolerance_m, 1e-3, 0.03)?;
        check_range("pick_spread", self.pick_spread, 0.0, 0.8)
    }

    fn footprint_m(&self) -> Vector2<f64> {
        Vector2::new(STRIP_LENGTH_M, 2.0 * STRIP_M.1)
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

impl Placing {
    fn draw(&self, world: &mut World, anchor: &Isometry2<f64>, draws: &mut Draws) -> PlacingTask {
        world.add(&Part {
            shape: Shape::Cuboid {
                size_m: Vector3::new(PLATE_M, PLATE_M, PLATE_HEIGHT_M),
            },
            pose: at_height(anchor, PLATE_HEIGHT_M / 2.0),
            mobility: Mobility::Fixed,
            friction: FRICTION,
            rgb: colors::PLATE,
        });
        let mut disks = Vec::with_capacity(9);
        let parities = [
            (true, 5, 1.0, self.even, colors::RED),
            (false, 4, -1.0, self.odd, colors::BLUE),
        ];
        for (even, count, side, size, rgb) in parities {
            let big = match size {
                Size::Random => draws.scene().random_bool(0.5),
                Size::Big => true,
                Size::Small => false,
            };
            let radius_m = if big { BIG_RADIUS_M } else { SMALL_RADIUS_M };
            for start in draws.start(|rng| starts(count, radius_m, rng)) {
                let pose = anchor * Isometry2::translation(start.x, side * start.y);
                let body = world.add(&Part {
                    shape: Shape::Cylinder {
                        radius_m,
                        length_m: DISK_HEIGHT_M,
                    },
                    pose: at_height(&pose, DISK_HEIGHT_M / 2.0),
                    mobility: Mobility::Free {
                        mass_kg: DISK_MASS_KG,
                        suction_force_n: SUCTION_FORCE_N,
                    },
                    friction: FRICTION,
                    rgb,
                });
                disks.push(Disk {
                    body,
                    even,
                    radius_m,
                });
            }
        }
        let cells = (0..9).map(|index| {
            let (row, col) = (f64::from(index / 3) - 1.0, f64::from(index % 3) - 1.0);
            Cell {
                center: anchor * Point2::new(col * PITCH_M, row * PITCH_M),
                even: index % 2 == 0,
            }
        });
        PlacingTask {
            disks,
            cells: cells.collect(),
            yaw_rad: anchor.rotation.angle(),
            parameters: *self,
        }
    }
}

/// Random positions in the strip on the side of +y, none closer than a gap to another: uniform
/// over all such rows of disks along x.
fn starts(count: usize, radius_m: f64, rng: &mut ChaCha8Rng) -> Vec<Point2<f64>> {
    let spacing = 2.0 * radius_m + START_GAP_M;
    let slack = STRIP_LENGTH_M - 2.0 * radius_m - (count - 1) as f64 * spacing;
    let mut along: Vec<f64> = (0..count).map(|_| rng.random_range(0.0..slack)).collect();
    along.sort_by(f64::total_cmp);
    let rows = along.iter().enumerate().map(|(index, along)| {
        let x = along + index as f64 * spacing + radius_m - STRIP_LENGTH_M / 2.0;
        let y = rng.random_range(STRIP_M.0 + radius_m..STRIP_M.1 - radius_m);
        Point2::new(x, y)
    });
    rows.collect()
}

impl PlacingTask {
    /// Whether a disk lies flat on the plate, centred on a cell.
    fn lies_on(&self, cell: &Cell, disk: &Disk, world: &World) -> bool {
        let pose = world.pose(disk.body);
        let off = pose.translation.vector.xy() - cell.center.coords;
        let height = PLATE_HEIGHT_M + DISK_HEIGHT_M / 2.0;
        let up = pose.rotation * Vector3::z();
        off.norm() < self.parameters.tolerance_m
            && (pose.translation.z - height).abs() < HEIGHT_TOLERANCE_M
            && up.z.abs() > TILT_TOLERANCE_RAD.cos()
    }

    fn holds_goal(&self, cell: &Cell, world: &World) -> bool {
        let mut right = self.disks.iter().filter(|disk| disk.even == cell.even);
        right.any(|disk| self.lies_on(cell, disk, world))
    }

    /// Whether a disk is where it belongs.
    fn is_placed(&self, disk: &Disk, world: &World) -> bool {
        let mut right = self.cells.iter().filter(|cell| cell.even == disk.even);
        right.any(|cell| self.lies_on(cell, disk, world))
    }

    /// Whether no other disk is in the way of one put on a cell.
    fn is_free(&self, cell: &Cell, disk: &Disk, world: &World) -> bool {
        self.disks
            .iter()
            .filter(|other| other.body != disk.body)
            .all(|other| {
                let center = world.position(other.body).xy();
                (center - cell.center).norm() > other.radius_m + disk.radius_m
            })
    }

    /// Puts aside a disk that is in the way where another one belongs, to where it could start.
    fn put_aside(&self, next: Option<usize>, world: &World, rng: &mut ChaCha8Rng) -> Option<Move> {
        let open = self.cells.iter().enumerate().filter(|(index, cell)| {
            next.is_none_or(|next| next == *index) && !self.holds_goal(cell, world)
        });
        let open: Vec<_> = open.map(|(_, cell)| cell.center).collect();
        let in_the_way = self.disks.iter().filter(|disk| {
            let center = world.position(disk.body).xy();
            let near = |cell: &Point2<f64>| (center - cell).norm() < disk.radius_m + BIG_RADIUS_M;
            !self.is_placed(disk, world) && !self.is_covered(disk, world) && open.iter().any(near)
        });
        let in_the_way: Vec<_> = in_the_way.collect();
        let disk = in_the_way.choose(rng)?;
        let anchor = Isometry2::new(self.cells[4].center.coords, self.yaw_rad);
        let along = STRIP_LENGTH_M / 2.0 - disk.radius_m;
        let mut spots = (0..ASIDE_DRAWS).map(|_| {
            let x = rng.random_range(-along..along);
            let y = rng.random_range(STRIP_M.0 + disk.radius_m..STRIP_M.1 - disk.radius_m);
            let side = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
            anchor * Point2::new(x, side * y)
        });
        let spot = spots.find(|spot| {
            let mut others = self.disks.iter().filter(|other| other.body != disk.body);
            others.all(|other| {
                let off = (world.position(other.body).xy() - spot).norm();
                off > disk.radius_m + other.radius_m + START_GAP_M / 2.0
            })
        })?;
        let action = PickPlace {
            pick: Isometry2::new(world.position(disk.body).xy().coords, 0.0),
            place: Isometry2::new(spot.coords, 0.0),
        };
        Some(action.into())
    }

    fn is_covered(&self, disk: &Disk, world: &World) -> bool {
        let center = world.position(disk.body);
        self.disks.iter().any(|other| {
            let other_center = world.position(other.body);
            other.body != disk.body
                && other_center.z > center.z + DISK_HEIGHT_M / 2.0
                && (other_center.xy() - center.xy()).norm() < disk.radius_m + other.radius_m
        })
    }
}

impl Task for PlacingTask {
    fn goal_count(&self) -> usize {
        self.cells.len()
    }

    fn max_steps(&self) -> usize {
        self.cells.len() + 2
    }

    fn settings(&self) -> PrimitiveSettings {
        SETTINGS
    }

    fn goal_poses(&self) -> Vec<Isometry3<f64>> {
        let height = PLATE_HEIGHT_M + DISK_HEIGHT_M / 2.0;
        let poses = self
            .cells
            .iter()
            .map(|cell| at_height(&Isometry2::new(cell.center.coords, self.yaw_rad), height));
        poses.collect()
    }

    fn goals_reached(&mut self, world: &World) -> Vec<usize> {
        let cells = self.cells.iter().enumerate();
        let reached = cells.filter(|(_, cell)| self.holds_goal(cell, world));
        reached.map(|(index, _)| index).collect()
    }

    /// A random disk that is not placed yet and nothing lies on, to a random free cell of its
    /// parity, or to the next one. The disk is gripped near its centre and set down so that its centre
    /// meets the cell's. Where there is none, a disk in the way is put aside.
    fn demonstrate(
        &mut self,
        cell: &crate::Cell,
        demonstrator: &mut Demonstrator,
        next: Option<usize>,
    ) -> Option<Move> {
        let rng = &mut demonstrator.rng;
        let world = cell.world();
        let mut moves = Vec::new();
        for disk in &self.disks {
            if self.is_placed(disk, world) || self.is_covered(disk, world) {
                continue;
            }
            let cells = self.cells.iter().enumerate().filter(|(index, cell)| {
                next.is_none_or(|next| next == *index)
                    && cell.even == disk.even
                    && self.is_free(cell, disk, world)
            });
            let cells: Vec<_> = cells.map(|(_, cell)| cell).collect();
            if !cells.is_empty() {
                moves.push((disk, cells));
            }
        }
        let Some((disk, cells)) = moves.choose(rng) else {
            return self.put_aside(next, world, rng);
        };
        let cell = cells.choose(rng)?;
        // Uniform over a small circle.
        let radius =
            self.parameters.pick_spread * disk.radius_m * rng.random_range(0.0..1.0f64).sqrt();
        let angle = rng.random_range(0.0..TAU);
        let offset = Vector2::new(angle.cos(), angle.sin()) * radius;
        let center = world.position(disk.body).xy();
        let action = PickPlace {
            pick: Isometry2::new(center.coords + offset, 0.0),
            place: Isometry2::new(cell.center.coords + offset, 0.0),
        };
        Some(action.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::seed::EpisodeSeed;
    use proptest::prelude::*;
    use rand::SeedableRng;

    const TIP_AWAY_M: f64 = 0.5;

    fn away() -> Isometry3<f64> {
        Isometry3::translation(0.0, 0.0, TIP_AWAY_M)
    }

    fn scene(seed: impl Into<EpisodeSeed>) -> (World, PlacingTask) {
        let mut world = World::new(&away());
        let placing = Placing::default();
        let anchor = Isometry2::new(Vector2::new(0.5, 0.05), 0.3);
        let task = placing.draw(&mut world, &anchor, &mut Draws::new(seed.into(), 0));
        (world, task)
    }

    /// Puts a disk's centre at a height over the point `off` metres from a cell's centre.
    fn put(world: &mut World, task: &PlacingTask, disk: usize, cell: usize, off: f64, z: f64) {
        let at = task.cells[cell].center + Vector2::new(off, 0.0);
        world.place(
            task.disks[disk].body,
            &Isometry3::translation(at.x, at.y, z),
        );
    }

    fn rest(world: &mut World) {
        for _ in 0..480 {
            world.step(&away());
        }
        assert!(world.fastest_m_s() < 5e-3);
    }

    const ON_PLATE_M: f64 = PLATE_HEIGHT_M + DISK_HEIGHT_M / 2.0 + 1e-4;
    /// Disks 0 to 4 are even, 5 to 8 odd: a cell for each.
    const SOLUTION: [usize; 9] = [0, 2, 4, 6, 8, 1, 3, 5, 7];

    #[test]
    fn nine_disks_on_their_cells_earn_everything() {
        let (mut world, mut task) = scene(3);
        assert_eq!(task.reached(&world), 0);
        for (count, (disk, cell)) in SOLUTION.iter().enumerate().enumerate() {
            put(&mut world, &task, disk, *cell, 0.003, ON_PLATE_M);
            rest(&mut world);
            assert_eq!(task.reached(&world), count + 1);
        }
        let rng = ChaCha8Rng::seed_from_u64(0);
        let next = task.demonstrate(&crate::Cell::around(&world), &mut rng.into(), None);
        assert!(next.is_none());
    }

    #[test]
    fn a_disk_on_a_disk_earns_nothing() {
        let (mut world, mut task) = scene(3);
        put(&mut world, &task, 0, 0, 0.0, ON_PLATE_M);
        put(
            &mut world,
            &task,
            1,
            0,
            0.0,
            ON_PLATE_M + DISK_HEIGHT_M + 1e-4,
        );
        rest(&mut world);
        assert_eq!(task.reached(&world), 1);
        // An even disk on an odd one covers an even cell without lying on it.
        put(&mut world, &task, 5, 4, 0.0, ON_PLATE_M);
        put(
            &mut world,
            &task,
            2,
            4,
            0.0,
            ON_PLATE_M + DISK_HEIGHT_M + 1e-4,
        );
        rest(&mut world);
        assert_eq!(task.reached(&world), 1);
    }

    #[test]
    fn a_disk_of_the_wrong_parity_earns_nothing() {
        let (mut world, mut task) = scene(3);
        put(&mut world, &task, 0, 1, 0.0, ON_PLATE_M);
        put(&mut world, &task, 5, 0, 0.0, ON_PLATE_M);
        rest(&mut world);
        assert_eq!(task.reached(&world), 0);
    }

    #[test]
    fn a_disk_too_far_from_its_cell_earns_nothing() {
        let (mut world, mut task) = scene(3);
        put(&mut world, &task, 0, 0, 0.011, ON_PLATE_M);
        rest(&mut world);
        assert_eq!(task.reached(&world), 0);
        put(&mut world, &task, 0, 0, 0.009, ON_PLATE_M);
        rest(&mut world);
        assert_eq!(task.reached(&world), 1);
    }

    #[test]
    fn disks_beside_the_plate_or_in_the_air_earn_nothing() {
        let (mut world, mut task) = scene(3);
        let beside = task.cells[0].center - Vector2::new(0.12, 0.0);
        let z = DISK_HEIGHT_M / 2.0;
        world.place(
            task.disks[0].body,
            &Isometry3::translation(beside.x, beside.y, z),
        );
        rest(&mut world);
        put(&mut world, &task, 1, 2, 0.0, 0.1);
        assert_eq!(task.reached(&world), 0);
    }

    #[test]
    fn a_disk_on_its_edge_earns_nothing() {
        let (mut world, mut task) = scene(3);
        let at = task.cells[0].center;
        let tilt = nalgebra::Vector3::new(std::f64::consts::FRAC_PI_2, 0.0, 0.0);
        let pose = Isometry3::new(Vector3::new(at.x, at.y, ON_PLATE_M), tilt);
        world.place(task.disks[0].body, &pose);
        assert_eq!(task.reached(&world), 0);
    }

    #[test]
    fn the_sizes_make_four_goal_configurations() {
        let sizes = (0..40).map(|seed| {
            let (_, task) = scene(seed);
            [0, 8].map(|disk| task.disks[disk].radius_m == BIG_RADIUS_M)
        });
        let sizes: std::collections::BTreeSet<_> = sizes.collect();
        assert_eq!(sizes.len(), 4);
    }

    proptest! {
        #[test]
        fn disks_start_apart_on_their_side_and_do_not_move(
            scene_seed in 0u64..1_000_000,
            start_after in 0u64..2,
        ) {
            let start = scene_seed + start_after;
            let (mut world, task) = scene(EpisodeSeed { scene: scene_seed, start });
            let anchor = Isometry2::new(Vector2::new(0.5, 0.05), 0.3);
            let starts: Vec<_> = task.disks.iter().map(|d| world.position(d.body)).collect();
            for (i, a) in task.disks.iter().enumerate() {
                let local = anchor.inverse_transform_point(&starts[i].xy());
                let side = if a.even { 1.0 } else { -1.0 };
                prop_assert!(side * local.y > PLATE_M / 2.0 + a.radius_m);
                prop_assert!(side * local.y + a.radius_m <= STRIP_M.1 + 1e-6);
                prop_assert!(local.x.abs() + a.radius_m <= STRIP_LENGTH_M / 2.0 + 1e-6);
                for (j, b) in task.disks.iter().enumerate().skip(i + 1) {
                    let apart = (starts[i] - starts[j]).norm();
                    prop_assert!(apart > a.radius_m + b.radius_m + 0.9 * START_GAP_M);
                }
            }
            rest(&mut world);
            for (disk, start) in task.disks.iter().zip(&starts) {
                prop_assert!((world.position(disk.body) - start).norm() < 1e-3);
            }
        }

        #[test]
        fn the_demonstrator_brings_a_disk_onto_a_free_cell_of_its_parity(seed in 0u64..1_000_000) {
            let (world, mut task) = scene(seed);
            let rng = ChaCha8Rng::seed_from_u64(seed);
            let cell = crate::Cell::around(&world);
            let action = task.demonstrate(&cell, &mut rng.into(), None).unwrap().action;
            let pick = Point2::from(action.pick.translation.vector);
            let disk = task.disks.iter().find(|d| {
                (world.position(d.body).xy() - pick).norm() <= 0.25 * d.radius_m + 1e-9
            });
            let disk = disk.expect("picks near a disk's centre");
            let center = world.position(disk.body).xy()
                + (action.place.translation.vector - action.pick.translation.vector);
            let cell = task.cells.iter().find(|c| (c.center - center).norm() < 1e-6);
            prop_assert_eq!(cell.expect("places on a cell").even, disk.even);
        }
    }
}
