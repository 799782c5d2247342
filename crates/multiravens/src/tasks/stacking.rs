//! *stacking*: six cubes in six colours, a pyramid of rows of three, two and one on a stand
//! (paper, appendix).
//!
//! The blocks start in a 2 x 3 array, in random order. The stand is turned by a multiple of an
//! eighth turn, and each goal wants a block of a colour that is drawn anew for each episode: only a
//! picture of the goal tells which. A row counts only while the rows below it are complete.
//!
//! Module frame: the stand is at -x, the array at +x.

use super::{Demonstrator, Move, ParameterError, Task, TaskModule, at_height, check_range};
use crate::cell::Cell;
use crate::colors;
use crate::seed::Draws;
use crate::world::{BodyId, Mobility, Part, Shape, World};
use nalgebra::{Isometry2, Isometry3, Matrix1x3, Point2, Point3, UnitComplex, Vector2, Vector3};
use pick_place::{PickPlace, PrimitiveSettings};
use rand::RngExt;
use rand::seq::{IndexedRandom, SliceRandom};
use rand_chacha::ChaCha8Rng;
use serde::Deserialize;
use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, TAU};

/// Edge length of a block.
const BLOCK_M: f64 = 0.04;
const BLOCK_MASS_KG: f64 = 0.01;
const SUCTION_FORCE_N: f64 = 5.0;
const FRICTION: f64 = 0.5;
/// Edge lengths of the stand; its blocks lie along its y.
const STAND_M: (f64, f64, f64) = (0.05, 0.15, 0.005);
/// Distance of the centres of neighbours in a row.
const PITCH_M: f64 = 0.05;
/// Rows of the pyramid: the first goal of each, and the one after its last, from below.
const ROWS: [(usize, usize); 3] = [(0, 3), (3, 5), (5, 6)];
/// Distance of the centres of neighbours in the array at the start.
const ARRAY_PITCH_M: f64 = 0.06;
/// Centres of stand and array in the module frame: as near to the robot as the footprint allows,
/// since the arm cannot rise much over the far corner of the table.
const STAND_AT_M: (f64, f64) = (-0.13, -0.05);
const ARRAY_AT_M: (f64, f64) = (0.06, -0.05);
const MAX_SHIFT_M: f64 = 0.01;
/// A block that is in the way is put somewhere here: x, and y, in the module frame; ...
const ASIDE_M: ((f64, f64), (f64, f64)) = ((0.0, 0.1), (-0.115, 0.015));
/// ... found by so many draws.
const ASIDE_DRAWS: usize = 200;
const FOOTPRINT_M: (f64, f64) = (0.44, 0.29);
const COLORS: [[u8; 3]; 6] = [
    colors::RED,
    colors::ORANGE,
    colors::YELLOW,
    colors::GREEN,
    colors::BLUE,
    colors::PURPLE,
];
/// A block is in its row if its centre is this close to the height where it should be, ...
const HEIGHT_TOLERANCE_M: f64 = 3e-3;
/// ... and one of its axes this close to upright.
const TILT_TOLERANCE_RAD: f64 = 0.1;
/// Both ways to turn a block by half a quarter are as long: up to this much beyond, the
/// demonstrator turns it the positive way.
const TIE_RAD: f64 = 0.1;

/// Fast, and high enough to carry a block over all but the top of the pyramid.
const SETTINGS: PrimitiveSettings = PrimitiveSettings {
    clearance_m: 0.2,
    lift_m: 0.13,
    travel_m_s: 1.5,
    carry_m_s: 0.8,
    descend_m_s: 0.25,
    acceleration_m_s2: 4.0,
};

/// The module's parameters in a problem file.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Stacking {
    /// How far a block's centre may be from its goal's in the plane, in m.
    tolerance_m: f64,
    /// How far its yaw may be from the stand's, modulo a quarter turn, in rad.
    yaw_tolerance_rad: f64,
    /// Stand and array are shifted by at most this along x and y, in m.
    shift_m: f64,
    /// The demonstrator picks within this distance of a block's centre, in m.
    pick_spread_m: f64,
}

impl Default for Stacking {
    fn default() -> Self {
        Self {
            tolerance_m: 0.01,
            yaw_tolerance_rad: 0.26,
            shift_m: MAX_SHIFT_M,
            pick_spread_m: 0.004,
        }
    }
}

/// A goal, and the block of the colour that it wants.
#[derive(Clone, Copy, Debug)]
struct Goal {
    center: Point3<f64>,
    block: BodyId,
}

struct StackingTask {
    /// From the lowest row to the top, see [`ROWS`].
    goals: Vec<Goal>,
    /// Pose of the module.
    anchor: Isometry2<f64>,
    /// Pose of the stand.
    stand: Isometry2<f64>,
    parameters: Stacking,
}

impl TaskModule for Stacking {
    fn check(&self, _anchor: &Isometry2<f64>) -> Result<(), ParameterError> {
        check_range("tolerance_m", self.tolerance_m, 1e-3, PITCH_M / 4.0)?;
        check_range("yaw_tolerance_rad", self.yaw_tolerance_rad, 0.01, FRAC_PI_4)?;
        check_range("shift_m", self.shift_m, 0.0, MAX_SHIFT_M)?;
        check_range("pick_spread_m", self.pick_spread_m, 0.0, BLOCK_M / 4.0)?;
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

impl Stacking {
    fn draw(&self, world: &mut World, anchor: &Isometry2<f64>, draws: &mut Draws) -> StackingTask {
        let shift = self.shift_m;
        let near = |(x, y): (f64, f64), rng: &mut ChaCha8Rng| {
            let mut off = || rng.random_range(-shift..=shift);
            Vector2::new(x + off(), y + off())
        };
        let stand_at = near(STAND_AT_M, draws.scene());
        let array_at = draws.start(|rng| near(ARRAY_AT_M, rng));
        let yaw_rad = f64::from(draws.scene().random_range(0..8)) * FRAC_PI_4;
        let stand = anchor * Isometry2::new(stand_at, yaw_rad);
        world.add(&Part {
            shape: Shape::Cuboid {
                size_m: Vector3::new(STAND_M.0, STAND_M.1, STAND_M.2),
            },
            pose: at_height(&stand, STAND_M.2 / 2.0),
            mobility: Mobility::Fixed,
            friction: FRICTION,
            rgb: colors::PLATE,
        });
        let mut colors = COLORS;
        colors.shuffle(draws.scene());
        // Place of each block in the array: in another start the colours lie in other places.
        let mut slots = [0, 1, 2, 3, 4, 5];
        if let Some(rng) = draws.other_start() {
            slots.shuffle(rng);
        }
        let blocks = colors.iter().zip(slots).map(|(rgb, slot)| {
            let (row, col) = (slot / 3, slot % 3);
            let at = Vector2::new(row as f64 - 0.5, col as f64 - 1.0) * ARRAY_PITCH_M + array_at;
            world.add(&Part {
                shape: Shape::Cuboid {
                    size_m: Vector3::repeat(BLOCK_M),
                },
                pose: at_height(&(anchor * Isometry2::new(at, 0.0)), BLOCK_M / 2.0),
                mobility: Mobility::Free {
                    mass_kg: BLOCK_MASS_KG,
                    suction_force_n: SUCTION_FORCE_N,
                },
                friction: FRICTION,
                rgb: *rgb,
            })
        });
        let mut blocks: Vec<BodyId> = blocks.collect();
        // The array must not tell where its blocks go.
        blocks.shuffle(draws.scene());
        let rows = ROWS.iter().enumerate();
        let centers = rows.flat_map(|(row, (first, end))| {
            let z = STAND_M.2 + (row as f64 + 0.5) * BLOCK_M;
            let middle = (end - first - 1) as f64 / 2.0;
            (0..end - first).map(move |col| (PITCH_M * (col as f64 - middle), z))
        });
        let goals = centers.zip(blocks).map(|((along, z), block)| {
            let center = stand * Point2::new(0.0, along);
            Goal {
                center: Point3::new(center.x, center.y, z),
                block,
            }
        });
        StackingTask {
            goals: goals.collect(),
            anchor: *anchor,
            stand,
            parameters: *self,
        }
    }
}

impl StackingTask {
    /// Whether the right block stands on a goal, square to the stand.
    fn is_reached(&self, goal: &Goal, world: &World) -> bool {
        let pose = world.pose(goal.block);
        let off = pose.translation.vector - goal.center.coords;
        // A cube looks the same from all its sides: any of its axes may point up, any along x.
        let axes = (at_height(&self.stand, 0.0).rotation.inverse() * pose.rotation)
            .to_rotation_matrix()
            .into_inner();
        let aligned = |row: Matrix1x3<f64>, tolerance_rad: f64| row.amax() > tolerance_rad.cos();
        off.xy().norm() < self.parameters.tolerance_m
            && off.z.abs() < HEIGHT_TOLERANCE_M
            && aligned(axes.row(2).into(), TILT_TOLERANCE_RAD)
            && aligned(axes.row(0).into(), self.parameters.yaw_tolerance_rad)
    }

    /// Goals of the lowest row that is not complete, with their places in [`Self::goals`].
    fn row(&self, world: &World) -> Option<&[Goal]> {
        let mut rows = ROWS.iter().map(|(first, end)| &self.goals[*first..*end]);
        rows.find(|row| !row.iter().all(|goal| self.is_reached(goal, world)))
    }

    /// Puts aside the topmost block that covers one that is needed, or stands where it belongs.
    fn put_aside(&self, next: Option<BodyId>, world: &World, rng: &mut ChaCha8Rng) -> Option<Move> {
        let wanted = self.row(world)?.iter().filter(|goal| {
            next.is_none_or(|next| next == goal.block) && !self.is_reached(goal, world)
        });
        let mut in_the_way = Vec::new();
        for goal in wanted {
            let block = world.position(goal.block);
            for (at, above_m) in [
                (block.xy(), block.z),
                (goal.center.xy(), goal.center.z - BLOCK_M / 2.0),
            ] {
                let blocks = self.goals.iter().map(|goal| goal.block);
                let over = blocks.filter(|other| {
                    let center = world.position(*other);
                    *other != goal.block
                        && center.z > above_m
                        && (center.xy() - at).norm() < BLOCK_M
                });
                let height = |block: &BodyId| world.position(*block).z;
                in_the_way.extend(over.max_by(|a, b| height(a).total_cmp(&height(b))));
            }
        }
        let block = *in_the_way.choose(rng)?;
        let mut spots = (0..ASIDE_DRAWS).map(|_| {
            let x = rng.random_range(ASIDE_M.0.0..ASIDE_M.0.1);
            let y = rng.random_range(ASIDE_M.1.0..ASIDE_M.1.1);
            self.anchor * Point2::new(x, y)
        });
        let spot = spots.find(|spot| {
            let mut others = self.goals.iter().filter(|goal| goal.block != block);
            others.all(|goal| (world.position(goal.block).xy() - spot).norm() > 1.5 * BLOCK_M)
        })?;
        let action = PickPlace {
            pick: Isometry2::new(world.position(block).xy().coords, 0.0),
            place: Isometry2::new(spot.coords, 0.0),
        };
        Some(action.into())
    }

    /// Whether something lies where a column of one block's edge length stands, above a height.
    fn is_occupied(&self, at: Point2<f64>, above_m: f64, but: BodyId, world: &World) -> bool {
        let blocks = self.goals.iter().map(|goal| goal.block);
        blocks.filter(|block| *block != but).any(|block| {
            let center = world.position(block);
            center.z > above_m && (center.xy() - at).norm() < BLOCK_M
        })
    }

    /// The smallest turn that makes a block square to the stand.
    fn turn_rad(&self, block: BodyId, world: &World) -> f64 {
        let axes = world.pose(block).rotation.to_rotation_matrix();
        // Of the axes that lie flat, the one nearest to the plane.
        let axes = axes.matrix().column_iter();
        let flat = axes.min_by(|a, b| a.z.abs().total_cmp(&b.z.abs()));
        let yaw_rad = flat.map_or(0.0, |axis| axis.y.atan2(axis.x));
        let turn_rad = self.stand.rotation.angle() - yaw_rad;
        (turn_rad + FRAC_PI_4 - TIE_RAD).rem_euclid(FRAC_PI_2) - FRAC_PI_4 + TIE_RAD
    }
}

impl Task for StackingTask {
    fn goal_count(&self) -> usize {
        self.goals.len()
    }

    fn max_steps(&self) -> usize {
        self.goals.len() + 2
    }

    fn settings(&self) -> PrimitiveSettings {
        SETTINGS
    }

    fn goal_poses(&self) -> Vec<Isometry3<f64>> {
        let yaw_rad = self.stand.rotation.angle();
        let poses = self.goals.iter().map(|goal| {
            let planar = Isometry2::new(goal.center.xy().coords, yaw_rad);
            at_height(&planar, goal.center.z)
        });
        poses.collect()
    }

    fn goals_reached(&mut self, world: &World) -> Vec<usize> {
        let mut reached = Vec::new();
        for (first, end) in ROWS {
            reached.extend((first..end).filter(|goal| self.is_reached(&self.goals[*goal], world)));
            if reached.len() < end {
                break;
            }
        }
        reached
    }

    /// A random block of the lowest row that is not complete, to its goal: gripped near the centre
    /// of its top, and turned no further than it takes. Where none can be moved, what is in the way is put
    /// aside.
    fn demonstrate(
        &mut self,
        cell: &Cell,
        demonstrator: &mut Demonstrator,
        next: Option<usize>,
    ) -> Option<Move> {
        let rng = &mut demonstrator.rng;
        let world = cell.world();
        let next = next.map(|next| self.goals[next].block);
        let row = self.row(world)?.iter().filter(|goal| {
            let block = world.position(goal.block);
            let covered = self.is_occupied(block.xy(), block.z, goal.block, world);
            let wanted = goal.center.z - BLOCK_M / 2.0;
            let occupied = self.is_occupied(goal.center.xy(), wanted, goal.block, world);
            next.is_none_or(|next| next == goal.block)
                && !self.is_reached(goal, world)
                && !covered
                && !occupied
        });
        let row: Vec<_> = row.collect();
        let Some(goal) = row.choose(rng) else {
            return self.put_aside(next, world, rng);
        };
        // Uniform over a small circle.
        let radius = self.parameters.pick_spread_m * rng.random_range(0.0..1.0f64).sqrt();
        let angle = rng.random_range(0.0..TAU);
        let offset = Vector2::new(angle.cos(), angle.sin()) * radius;
        let turn = UnitComplex::new(self.turn_rad(goal.block, world));
        let center = world.position(goal.block).xy();
        let action = PickPlace {
            pick: Isometry2::new(center.coords + offset, 0.0),
            place: Isometry2::new(goal.center.xy().coords + turn * offset, turn.angle()),
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

    fn anchor() -> Isometry2<f64> {
        Isometry2::new(Vector2::new(0.5, 0.3), 0.2)
    }

    fn scene(seed: impl Into<EpisodeSeed>) -> (World, StackingTask) {
        let mut world = World::new(&away());
        let stacking = Stacking::default();
        let task = stacking.draw(&mut world, &anchor(), &mut Draws::new(seed.into(), 0));
        (world, task)
    }

    /// Puts the block that belongs on goal `of` near the goal `at`: `along` metres further along the
    /// stand's y, `up` metres higher, turned by `yaw_rad` against the stand.
    fn put(world: &mut World, task: &StackingTask, of: usize, at: usize, by: (f64, f64, f64)) {
        let (along, up, yaw_rad) = by;
        let center = task.goals[at].center;
        let planar = Isometry2::new(
            center.xy().coords + task.stand.rotation * Vector2::new(0.0, along),
            task.stand.rotation.angle() + yaw_rad,
        );
        let pose = at_height(&planar, center.z + up + 1e-4);
        world.place(task.goals[of].block, &pose);
    }

    const EXACT: (f64, f64, f64) = (0.0, 0.0, 0.0);

    fn rest(world: &mut World) {
        for _ in 0..480 {
            world.step(&away());
        }
        assert!(world.fastest_m_s() < 5e-3);
    }

    #[test]
    fn a_pyramid_of_the_right_colors_earns_everything() {
        let (mut world, mut task) = scene(3);
        assert_eq!(task.reached(&world), 0);
        for goal in 0..6 {
            // Which of the four sides is in front does not matter.
            put(&mut world, &task, goal, goal, (0.002, 0.0, FRAC_PI_2));
            rest(&mut world);
            assert_eq!(task.reached(&world), goal + 1);
        }
        let rng = ChaCha8Rng::seed_from_u64(0);
        let next = task.demonstrate(&Cell::around(&world), &mut rng.into(), None);
        assert!(next.is_none());
    }

    #[test]
    fn a_block_of_the_wrong_color_earns_nothing() {
        let (mut world, mut task) = scene(3);
        for (block, goal) in [(1, 0), (2, 1), (0, 2)] {
            put(&mut world, &task, block, goal, EXACT);
        }
        rest(&mut world);
        assert_eq!(task.reached(&world), 0);
    }

    #[test]
    fn an_upper_row_counts_only_on_a_complete_lower_one() {
        let (mut world, mut task) = scene(3);
        // The third of the lowest row is one of the wrong colour: what stands on it earns nothing.
        for (block, goal) in [(0, 0), (1, 1), (5, 2), (3, 3), (4, 4)] {
            put(&mut world, &task, block, goal, EXACT);
        }
        rest(&mut world);
        assert_eq!(task.reached(&world), 2);
        // There is no way to go on but to take the tower down, from its top.
        let rng = ChaCha8Rng::seed_from_u64(0);
        let next = task.demonstrate(&Cell::around(&world), &mut rng.into(), None);
        let pick = next.unwrap().action.pick.translation.vector;
        let top = world.position(task.goals[4].block).xy();
        assert!((pick - top.coords).norm() < 1e-6);
        // Floating where it should be, with nothing below.
        let (mut world, mut task) = scene(4);
        put(&mut world, &task, 5, 5, EXACT);
        assert_eq!(task.reached(&world), 0);
    }

    #[test]
    fn a_block_at_the_wrong_height_earns_nothing() {
        let (mut world, mut task) = scene(3);
        put(&mut world, &task, 1, 0, EXACT);
        put(&mut world, &task, 0, 0, (0.0, BLOCK_M, 0.0));
        rest(&mut world);
        assert_eq!(task.reached(&world), 0);
    }

    #[test]
    fn a_block_too_far_or_turned_too_far_or_tilted_earns_nothing() {
        let (mut world, mut task) = scene(3);
        let cases = [
            ((0.011, 0.0, 0.0), 0),
            ((0.009, 0.0, 0.0), 1),
            ((0.0, 0.0, 0.3), 0),
            ((0.0, 0.0, FRAC_PI_4), 0),
            ((0.0, 0.0, 0.2), 1),
        ];
        for (by, expected) in cases {
            put(&mut world, &task, 0, 0, by);
            rest(&mut world);
            assert_eq!(task.reached(&world), expected, "{by:?}");
        }
        let mut tilted = at_height(&task.stand, 0.0);
        tilted.translation = task.goals[0].center.into();
        tilted.rotation *= nalgebra::UnitQuaternion::from_euler_angles(0.15, 0.0, 0.0);
        world.place(task.goals[0].block, &tilted);
        assert_eq!(task.reached(&world), 0);
        // On another side it looks the same.
        tilted.rotation *= nalgebra::UnitQuaternion::from_euler_angles(FRAC_PI_2 - 0.15, 0.0, 0.0);
        world.place(task.goals[0].block, &tilted);
        assert_eq!(task.reached(&world), 1);
    }

    #[test]
    fn a_block_on_its_edge_earns_nothing() {
        let (mut world, mut task) = scene(3);
        for goal in [0, 2] {
            put(&mut world, &task, goal, goal, EXACT);
        }
        // Between its neighbours there is room for it on its edge: it leans on one of them.
        let goal = task.goals[1];
        let up_m = BLOCK_M * (0.5f64.sqrt() - 0.5) + 1e-3;
        let mut pose = at_height(&task.stand, goal.center.z + up_m);
        pose.rotation *= nalgebra::UnitQuaternion::from_euler_angles(FRAC_PI_4, 0.0, 0.0);
        world.place(goal.block, &pose);
        rest(&mut world);
        let rests = world.pose(goal.block);
        let tilt_rad = (rests.rotation * Vector3::z()).angle(&Vector3::z());
        assert!((FRAC_PI_4 - tilt_rad).abs() < 0.3, "it fell: {tilt_rad}");
        let off = (rests.translation.vector - goal.center.coords).xy();
        assert!(off.norm() < task.parameters.tolerance_m, "{off}");
        assert_eq!(task.reached(&world), 2);
    }

    #[test]
    fn another_start_wants_the_same_colors_which_lie_in_other_slots() {
        let drawn = |start| {
            let (world, task) = scene(EpisodeSeed { scene: 3, start });
            let rgb: Vec<_> = task.goals.iter().map(|g| world.rgb(g.block)).collect();
            let at = task.goals.iter().map(|g| world.position(g.block));
            (rgb, at.collect::<Vec<_>>())
        };
        let (rgb, own) = drawn(3);
        for start in 4..10 {
            let (other_rgb, other) = drawn(start);
            assert_eq!(other_rgb, rgb, "start {start}");
            let moved = own
                .iter()
                .zip(&other)
                .filter(|(a, b)| (*a - *b).norm() > BLOCK_M);
            assert!(moved.count() >= 2, "start {start}");
        }
    }

    #[test]
    fn every_stand_yaw_and_many_color_orders_occur() {
        let drawn = (0..100).map(|seed| {
            let (world, task) = scene(seed);
            let yaw = task.stand.rotation.angle() - anchor().rotation.angle();
            let eighth = (yaw / FRAC_PI_4).round();
            assert!((yaw - eighth * FRAC_PI_4).abs() < 1e-9);
            let colors: Vec<_> = task.goals.iter().map(|g| world.rgb(g.block)).collect();
            let mut places: Vec<_> = task.goals.iter().map(|g| g.block).collect();
            places.sort();
            places.dedup();
            assert_eq!(places.len(), 6);
            (eighth.rem_euclid(8.0) as u8, colors)
        });
        let (yaws, colors): (std::collections::BTreeSet<_>, std::collections::BTreeSet<_>) =
            drawn.unzip();
        assert_eq!(yaws.len(), 8);
        assert!(colors.len() > 80, "{}", colors.len());
    }

    proptest! {
        #[test]
        fn blocks_start_apart_within_the_footprint_and_do_not_move(
            scene_seed in 0u64..1_000_000,
            start_after in 0u64..2,
        ) {
            let start = scene_seed + start_after;
            let (mut world, task) = scene(EpisodeSeed { scene: scene_seed, start });
            let half = Vector2::new(FOOTPRINT_M.0, FOOTPRINT_M.1) / 2.0;
            let starts: Vec<_> = task.goals.iter().map(|g| world.position(g.block)).collect();
            let reach = BLOCK_M / 2f64.sqrt();
            for (i, start) in starts.iter().enumerate() {
                let p = anchor().inverse_transform_point(&start.xy());
                prop_assert!(p.x.abs() + BLOCK_M / 2.0 < half.x + 1e-6);
                prop_assert!(p.y.abs() + BLOCK_M / 2.0 < half.y + 1e-6);
                for other in &starts[i + 1..] {
                    prop_assert!((start - other).norm() > ARRAY_PITCH_M - 1e-6);
                }
                for goal in &task.goals {
                    prop_assert!((start.xy() - goal.center.xy()).norm() > 2.0 * reach);
                    let p = anchor().inverse_transform_point(&goal.center.xy());
                    prop_assert!(p.x.abs() + reach < half.x + 1e-6 && p.y.abs() + reach < half.y + 1e-6);
                }
            }
            rest(&mut world);
            for (goal, start) in task.goals.iter().zip(&starts) {
                prop_assert!((world.position(goal.block) - start).norm() < 1e-3);
            }
        }

        #[test]
        fn the_demonstrator_turns_a_block_of_the_lowest_row_square_to_the_stand(seed in 0u64..1_000_000) {
            let (mut world, mut task) = scene(seed);
            let rng = ChaCha8Rng::seed_from_u64(seed);
            let cell = Cell::around(&world);
            let action = task.demonstrate(&cell, &mut rng.into(), None).unwrap().action;
            let turn = action.place.rotation.angle();
            prop_assert!(turn.abs() < FRAC_PI_4 + 0.01);
            let goal = task.goals[..3].iter().find(|goal| {
                let off = world.position(goal.block).xy().coords - action.pick.translation.vector;
                off.norm() <= 0.004 + 1e-9
            });
            let goal = goal.expect("picks a block of the lowest row near its centre");
            // The primitive, without a robot: the block turns about the grip.
            let start = world.pose(goal.block);
            let moved = action.place * action.pick.inverse();
            let planar = moved * Isometry2::new(start.translation.vector.xy(), anchor().rotation.angle());
            world.place(goal.block, &at_height(&planar, goal.center.z));
            prop_assert_eq!(task.reached(&world), 1);
        }
    }
}
