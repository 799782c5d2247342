//! What the check finds, and what it lets pass.

use collision::{
    Carried, Clearance, CollisionChecker, Contact, Margins, Scene, Situation, Terrain, lift_out,
    rehearse,
};
use heightmap::{Heightmap, Workspace};
use nalgebra::{Isometry2, Isometry3, Point2, Point3, Vector2, Vector3};
use pick_place::{Outcome, PickPlace, PrimitiveSettings, Robot, Touchdown};
use proptest::prelude::*;
use std::convert::Infallible;
use std::sync::LazyLock;
use ur5::{Arm, JointTrajectory, Joints, Shape, WorkCell};

fn cell() -> WorkCell {
    static CELL: LazyLock<WorkCell> = LazyLock::new(|| WorkCell::builtin().unwrap());
    CELL.clone()
}

fn checker(cell: &WorkCell) -> CollisionChecker {
    CollisionChecker::new(cell, Margins::default()).unwrap()
}

fn empty_table() -> Heightmap {
    let mut heightmap = Heightmap::new(Workspace::RAVENS);
    heightmap.rgb.fill(100);
    heightmap
}

/// Remembers the motions; its tool finds the table.
struct Recorder {
    joints: Joints,
    holds: bool,
    motions: Vec<(JointTrajectory, bool)>,
}

impl Robot for Recorder {
    type Error = Infallible;
    fn joints(&mut self) -> Result<Joints, Infallible> {
        Ok(self.joints)
    }
    fn follow(&mut self, trajectory: &JointTrajectory) -> Result<bool, Infallible> {
        self.motions.push((trajectory.clone(), self.holds));
        self.joints = trajectory.last().positions_rad;
        Ok(true)
    }
    fn follow_until_contact(&mut self, trajectory: &JointTrajectory) -> Result<bool, Infallible> {
        self.follow(trajectory)
    }
    fn set_suction(&mut self, on: bool) -> Result<(), Infallible> {
        self.holds = on;
        Ok(())
    }
    fn holds(&mut self) -> Result<bool, Infallible> {
        Ok(self.holds)
    }
}

fn motions(
    arm: &Arm,
    action: &PickPlace,
    settings: &PrimitiveSettings,
) -> Option<Vec<(JointTrajectory, bool)>> {
    let mut robot = Recorder {
        joints: arm.home,
        holds: false,
        motions: Vec::new(),
    };
    pick_place::execute(&mut robot, arm, action, settings, |_| ()).ok()?;
    Some(robot.motions)
}

/// Contact at both ends of a motion that are low.
fn contacts(arm: &Arm, motion: &JointTrajectory, radius_m: f64) -> Vec<Contact> {
    [motion.points()[0], *motion.last()]
        .iter()
        .map(|point| arm.tip(&point.positions_rad).translation.vector)
        .filter(|tip| tip.z < 0.06)
        .map(|tip| Contact {
            center_m: Point2::from(tip.xy()),
            radius_m,
            above_m: f64::NEG_INFINITY,
            up_to_m: 0.02,
        })
        .collect()
}

fn pose() -> impl Strategy<Value = Isometry2<f64>> {
    (0.3..0.7f64, -0.42..0.42f64, -3.1..3.1f64)
        .prop_map(|(x, y, yaw)| Isometry2::new(Vector2::new(x, y), yaw))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    #[test]
    fn whole_primitives_over_an_empty_table_pass(pick in pose(), place in pose(), beads in any::<bool>()) {
        let cell = cell();
        let settings = if beads { PrimitiveSettings::BEADS } else { PrimitiveSettings::RIGID };
        let Some(motions) = motions(&cell.arm, &PickPlace { pick, place }, &settings) else {
            return Ok(());
        };
        let checker = checker(&cell);
        let terrain = Terrain::new(&empty_table());
        for (motion, holds) in &motions {
            // A plate below the tip, thin enough for the transfer of beads; the tool finds the table, not the plate.
            let carried = holds.then_some(Carried {
                shape: Shape::Cuboid { size_m: Vector3::new(0.04, 0.04, 0.02) },
                tip_from_shape: Isometry3::translation(0.0, 0.0, 0.01),
                yields: false,
            });
            let contacts = contacts(&cell.arm, motion, 0.06);
            let scene = Scene { terrain: Some(&terrain), carried, contacts };
            let passed = checker.check(motion, &scene);
            prop_assert!(passed.is_ok(), "{}", passed.unwrap_err());
        }
    }

    /// What passes the check keeps its distance in a slow, independent computation too.
    #[test]
    fn what_passes_keeps_its_margin_everywhere(
        from in prop::array::uniform6(-3.0..3.0f64), to in prop::array::uniform6(-3.0..3.0f64),
    ) {
        let cell = cell();
        let checker = checker(&cell);
        let (from, to) = (Joints::from(from), Joints::from(to));
        let way = JointTrajectory::joint_space(&cell.arm, &from, &to).unwrap();
        let passed = checker.check(&way, &Scene::default());
        let steps = 400;
        let mut least: (f64, String) = (f64::INFINITY, String::new());
        for step in 0..=steps {
            let joints = way.sample(way.duration() * step / steps);
            let bodies: Vec<_> = cell.posed(&cell.collisions, &joints).collect();
            for (body, pose) in bodies.iter().filter(|(body, _)| body.moving_link.is_some()) {
                for (other, other_pose) in bodies.iter().filter(|(body, _)| body.moving_link.is_none()) {
                    let distance_m = |point| other.shape.distance_m(&other_pose.inverse_transform_point(&(pose * point)));
                    // No point of the surface is nearer than this.
                    let bound_m = distance_m(Point3::origin()) - radius_m(&body.shape);
                    if other.link == "base_link_inertia" || bound_m >= least.0 {
                        continue;
                    }
                    for point in surface(&body.shape) {
                        let distance_m = distance_m(point);
                        if distance_m < least.0 {
                            least = (distance_m, format!("{} and {}", body.link, other.link));
                        }
                    }
                }
            }
        }
        match passed {
            Ok(Clearance { least_m, .. }) => {
                prop_assert!(least.0 > 0.01 - 0.002, "{least:?}");
                // Points on a surface are no nearer than the surface.
                prop_assert!(least_m < 0.06 + 0.25 || least.0 > 0.01, "{least_m} {least:?}");
            }
            // Whatever it refuses is near, or would be near with itself.
            Err(collision) => prop_assert!(
                least.0 < 0.01 + 0.03 || cell.collisions.iter().any(|body| body.link == collision.obstacle && body.moving_link.is_some()),
                "{collision}; {least:?}"
            ),
        }
    }

    #[test]
    fn a_column_on_the_way_of_the_tip_is_always_found(start in pose(), end in pose(), share in 0.1..0.9f64, height_m in 0.1..0.3f64) {
        let cell = cell();
        let checker = checker(&cell);
        let arm = &cell.arm;
        let over = |pose: &Isometry2<f64>| Arm::tip_down(&Isometry2::new(pose.translation.vector, 0.0), height_m - 0.03);
        let (Ok(from), true) = (arm.solve(&over(&start), &arm.ready), (start.translation.vector - end.translation.vector).norm() > 0.05) else {
            return Ok(());
        };
        let Ok(line) = JointTrajectory::line(arm, &from, &over(&end), 0.8, 4.0) else {
            return Ok(());
        };
        let at = start.translation.vector + (end.translation.vector - start.translation.vector) * share;
        let mut heightmap = empty_table();
        let pixel = heightmap.workspace.pixel(&Point2::from(at)).unwrap();
        let clear = checker.check(&line, &Scene { terrain: Some(&Terrain::new(&heightmap)), ..Scene::default() });
        heightmap.height_m[pixel.row * 160 + pixel.col] = height_m as f32;
        let terrain = Terrain::new(&heightmap);
        let found = checker.check(&line, &Scene { terrain: Some(&terrain), ..Scene::default() });
        prop_assert!(found.is_err(), "{found:?}");
        if clear.is_ok() {
            prop_assert!(found.unwrap_err().obstacle.starts_with("the heightmap at"));
        }
    }

    #[test]
    fn what_passes_with_a_wide_margin_passes_with_a_narrow_one(pick in pose(), to in prop::array::uniform6(-2.0..2.0f64), wide in 0.01..0.05f64) {
        let cell = cell();
        let arm = &cell.arm;
        let from = arm.solve(&Arm::tip_down(&pick, 0.15), &arm.ready);
        let Ok(from) = from else { return Ok(()) };
        let way = JointTrajectory::joint_space(arm, &from, &Joints::from(to)).unwrap();
        let check = |obstacle_m, self_m| {
            let margins = Margins { obstacle_m, self_m, ..Margins::default() };
            CollisionChecker::new(&cell, margins).unwrap().check(&way, &Scene::default()).is_ok()
        };
        prop_assert!(!check(wide, 0.004) || check(0.005, 0.0));
    }
}

/// Radius of a ball about the middle of a shape that holds all of it.
fn radius_m(shape: &Shape) -> f64 {
    let Shape::Cylinder { radius_m, length_m } = *shape else {
        panic!("the arm is made of cylinders");
    };
    radius_m.hypot(0.5 * length_m)
}

/// Points on a shape.
fn surface(shape: &Shape) -> Vec<Point3<f64>> {
    let Shape::Cylinder { radius_m, length_m } = *shape else {
        panic!("the arm is made of cylinders");
    };
    (0..12)
        .flat_map(|i| {
            let (sin, cos) = (f64::from(i) * std::f64::consts::TAU / 12.0).sin_cos();
            (0..=8).map(move |j| {
                Point3::new(
                    radius_m * cos,
                    radius_m * sin,
                    length_m * (f64::from(j) / 8.0 - 0.5),
                )
            })
        })
        .collect()
}

#[test]
fn a_post_of_the_urdf_and_a_camera_are_obstacles() {
    let cell = cell();
    let post = "<link name=\"post\"><collision><geometry><cylinder radius=\"0.02\" length=\"0.8\"/></geometry></collision></link>\
        <joint name=\"world-post\" type=\"fixed\"><parent link=\"world\"/><child link=\"post\"/><origin xyz=\"0.45 0.1 0.4\" rpy=\"0 0 0\"/></joint></robot>";
    let with = WorkCell::parse(&cell.urdf.replace("</robot>", post), "cell.urdf").unwrap();
    let arm = &cell.arm;
    let over = |y_m: f64| Arm::tip_down(&Isometry2::translation(0.45, y_m), 0.2);
    let from = arm.solve(&over(-0.3), &arm.ready).unwrap();
    let line = JointTrajectory::line(arm, &from, &over(0.4), 0.5, 2.0).unwrap();
    checker(&cell).check(&line, &Scene::default()).unwrap();
    let collision = checker(&with).check(&line, &Scene::default()).unwrap_err();
    assert_eq!(collision.obstacle, "post");
    assert!(
        collision.distance_m < 0.01 && collision.to_string().contains("post"),
        "{collision}"
    );
    // Up to the front camera, at (1, 0, 0.75).
    let camera = cell.cameras[0].1.translation.vector;
    let near = Isometry3::from_parts(
        (camera + Vector3::new(-0.35, 0.0, 0.0)).into(),
        nalgebra::UnitQuaternion::from_axis_angle(&Vector3::y_axis(), 1.4),
    );
    if let Ok(joints) = arm.solve(&near, &arm.ready) {
        let mut into = near;
        into.translation.vector = camera;
        if let Ok(line) = JointTrajectory::line(arm, &joints, &into, 0.2, 1.0) {
            let collision = checker(&cell).check(&line, &Scene::default()).unwrap_err();
            assert!(collision.obstacle.contains("front_camera"), "{collision}");
        }
    }
}

#[test]
fn what_is_carried_counts_and_contact_is_allowed_only_where_it_is_wanted() {
    let cell = cell();
    let checker = checker(&cell);
    let arm = &cell.arm;
    let over = |y_m: f64, z_m: f64| Arm::tip_down(&Isometry2::translation(0.5, y_m), z_m);
    let from = arm.solve(&over(-0.2, 0.12), &arm.ready).unwrap();
    let line = JointTrajectory::line(arm, &from, &over(0.2, 0.12), 0.5, 2.0).unwrap();
    let mut heightmap = empty_table();
    for row in 155..165 {
        heightmap.height_m[row * 160 + 75..row * 160 + 85].fill(0.08);
    }
    let terrain = Terrain::new(&heightmap);
    let carried = Carried {
        shape: Shape::Cuboid {
            size_m: Vector3::new(0.03, 0.03, 0.05),
        },
        tip_from_shape: Isometry3::translation(0.0, 0.0, 0.025),
        yields: false,
    };
    let scene = |carried, contacts| Scene {
        terrain: Some(&terrain),
        carried,
        contacts,
    };
    checker.check(&line, &scene(None, vec![])).unwrap();
    let collision = checker
        .check(&line, &scene(Some(carried), vec![]))
        .unwrap_err();
    assert_eq!(collision.body, "the carried object");
    // Down onto the block: only with contact wanted there, and up to that height.
    let above = arm.solve(&over(0.0, 0.2), &arm.ready).unwrap();
    let descent = JointTrajectory::line(arm, &above, &over(0.0, 0.07), 0.3, 2.0).unwrap();
    let contact = |up_to_m| Contact {
        center_m: Point2::new(0.5, 0.0),
        radius_m: 0.06,
        above_m: f64::NEG_INFINITY,
        up_to_m,
    };
    let collision = checker.check(&descent, &scene(None, vec![])).unwrap_err();
    assert!(collision.obstacle.contains("heightmap"), "{collision}");
    assert!(
        checker
            .check(&descent, &scene(None, vec![contact(0.05)]))
            .is_err()
    );
    checker
        .check(&descent, &scene(None, vec![contact(0.1)]))
        .unwrap();
    // Into the table.
    let down = JointTrajectory::line(arm, &from, &over(-0.2, -0.01), 0.3, 2.0).unwrap();
    let collision = checker.check(&down, &Scene::default()).unwrap_err();
    assert_eq!(
        (collision.body.as_str(), collision.obstacle.as_str()),
        ("suction_gripper", "table")
    );
    let here = Contact {
        center_m: Point2::new(0.5, -0.2),
        radius_m: 0.05,
        above_m: f64::NEG_INFINITY,
        up_to_m: 0.02,
    };
    let allowed = Scene {
        contacts: vec![here],
        ..Scene::default()
    };
    checker.check(&down, &allowed).unwrap();
}

#[test]
fn a_slow_tool_passes_closer_to_what_stands_on_the_table_than_a_fast_one() {
    let cell = cell();
    let checker = checker(&cell);
    let arm = &cell.arm;
    let over = |y_m: f64| Arm::tip_down(&Isometry2::translation(0.5, y_m), 0.05);
    let from = arm.solve(&over(-0.2), &arm.ready).unwrap();
    let check = |gap_m: f64, speed_m_s: f64| {
        let line = JointTrajectory::line(arm, &from, &over(0.2), speed_m_s, 1.0).unwrap();
        // A wall beside the way of the cup, whose radius is 10 mm.
        let mut heightmap = empty_table();
        let first = heightmap
            .workspace
            .pixel(&Point2::new(0.5 + 0.01 + gap_m, 0.0))
            .unwrap();
        for row in 0..320 {
            heightmap.height_m[row * 160 + first.col..row * 160 + 160].fill(0.06);
        }
        let terrain = Terrain::new(&heightmap);
        let found = checker.check(
            &line,
            &Scene {
                terrain: Some(&terrain),
                ..Scene::default()
            },
        );
        found.map(|found| found.least_m)
    };
    // Cells are 3 mm wide.
    for (gap_m, slow, fast) in [
        (0.002, false, false),
        (0.009, true, false),
        (0.016, true, true),
    ] {
        assert_eq!(
            check(gap_m, 0.15).is_ok(),
            slow,
            "{gap_m}: {:?}",
            check(gap_m, 0.15)
        );
        assert_eq!(
            check(gap_m, 0.5).is_ok(),
            fast,
            "{gap_m}: {:?}",
            check(gap_m, 0.5)
        );
    }
}

#[test]
fn the_arm_does_not_fold_into_itself() {
    let mut cell = cell();
    // Its hand would touch that first.
    cell.collisions.retain(|body| body.link != "table");
    let arm = &cell.arm;
    // The elbow closes until the wrist meets the upper arm.
    let mut folded = arm.ready;
    folded[2] = 3.0;
    let way = JointTrajectory::joint_space(arm, &arm.ready, &folded).unwrap();
    let collision = checker(&cell).check(&way, &Scene::default()).unwrap_err();
    let links = [collision.body.as_str(), collision.obstacle.as_str()];
    assert!(
        links.iter().all(|link| link.contains("link")),
        "{collision}"
    );
}

#[test]
fn margins_without_sense_are_refused_by_name() {
    let cell = cell();
    for (obstacle_m, self_m, name) in [
        (-0.01, 0.0, "obstacles"),
        (f64::NAN, 0.0, "obstacles"),
        (0.01, 0.5, "links"),
    ] {
        let error = CollisionChecker::new(
            &cell,
            Margins {
                obstacle_m,
                self_m,
                ..Margins::default()
            },
        )
        .unwrap_err()
        .to_string();
        assert!(error.contains(name), "{error}");
    }
}

#[test]
fn the_ways_home_of_every_shipped_arm_are_free() {
    let folder = std::path::Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../urdf"));
    for file in [
        "workcell.urdf",
        "workcell_ur3e.urdf",
        "workcell_ur5e.urdf",
        "workcell_ur10e.urdf",
    ] {
        let cell = WorkCell::load(&folder.join(file)).unwrap();
        let arm = &cell.arm;
        let checker = checker(&cell);
        let (mut free, mut blocked) = (0, Vec::new());
        for step in 0..40 {
            let at = Isometry2::translation(
                0.3 + 0.1 * f64::from(step % 5),
                -0.35 + 0.1 * f64::from(step / 5),
            );
            let Ok(joints) = arm.solve(&Arm::tip_down(&at, 0.15), &arm.ready) else {
                continue;
            };
            let way = JointTrajectory::joint_space(arm, &joints, &arm.home).unwrap();
            match checker.check(&way, &Scene::default()) {
                Ok(_) => free += 1,
                Err(collision) => blocked.push(collision.to_string()),
            }
        }
        println!("{file}: {free} free");
        assert!(
            blocked.is_empty() && free > 8,
            "{file}: {free} free, {blocked:#?}"
        );
    }
}

#[test]
fn a_cable_of_which_a_peg_hides_a_part_is_a_cable_still() {
    // 12 mm, 0.5 m long; a peg of 30 mm stands against it 30 mm from the pick, and hides it where it stands.
    let mut heightmap = empty_table();
    for row in 80..240 {
        heightmap.height_m[row * 160 + 78..row * 160 + 82].fill(0.012);
    }
    for row in 170..178 {
        heightmap.height_m[row * 160 + 80..row * 160 + 88].fill(0.03);
        let hidden = row * 160 + 78;
        heightmap.height_m[hidden..hidden + 2].fill(0.0);
    }
    let lift = |heightmap: &Heightmap, row: f64| {
        let at = heightmap.workspace.point_m(&Point2::new(80.0, row));
        let pick = Isometry2::translation(at.x, at.y);
        lift_out(heightmap, &Arm::tip_down(&pick, 0.012)).unwrap().0
    };
    // The part on this side of the peg is short, its other end lies 25 cells away.
    for row in 80..135 {
        heightmap.height_m[row * 160 + 78..row * 160 + 82].fill(0.0);
    }
    let mut bead = heightmap.clone();
    // Beside the peg one row of cells of the cable is seen now and then.
    for row in (170..178).step_by(2) {
        bead.height_m[row * 160 + 78..row * 160 + 80].fill(0.011);
    }
    let cable = lift(&bead, 150.0);
    assert!(cable.yields && cable.radius_m() < 0.04, "{cable:?}");
    // Where nothing leads past the peg, it is a stick.
    let stick = lift(&heightmap, 150.0);
    assert!(!stick.yields, "{stick:?}");
    // So is one beside a block of its own height.
    for row in 178..240 {
        heightmap.height_m[row * 160 + 60..row * 160 + 100].fill(0.012);
    }
    let stick = lift(&heightmap, 150.0);
    assert!(!stick.yields, "{stick:?}");
}

#[test]
fn only_something_long_and_thin_yields() {
    let strip = |rows: std::ops::Range<usize>, cols: std::ops::Range<usize>| {
        let rows_of_sides = if cols.start == 78 { rows.clone() } else { 0..0 };
        let mut heightmap = empty_table();
        for row in rows {
            heightmap.height_m[row * 160 + cols.start..row * 160 + cols.end].fill(0.012);
        }
        // Sides that seem to slope, and gaps.
        for row in rows_of_sides {
            heightmap.height_m[row * 160 + 77] = 0.005;
            if row % 5 == 2 {
                heightmap.height_m[row * 160 + 77..row * 160 + 82].fill(0.0055);
            }
        }
        let at = heightmap.workspace.point_m(&Point2::new(80.0, 160.0));
        lift_out(
            &heightmap,
            &Arm::tip_down(&Isometry2::translation(at.x, at.y), 0.012),
        )
        .unwrap()
    };
    // A cable of 12 mm, 0.5 m long.
    let (cable, rest) = strip(80..240, 78..82);
    assert!(cable.yields && cable.radius_m() < 0.04, "{cable:?}");
    // Most of it still lies there.
    assert_eq!(rest.height_m[160 * 160 + 80], 0.0);
    assert_eq!(rest.height_m[180 * 160 + 80], 0.012);
    // A stick of 0.1 m, and a sheet.
    let (stick, _) = strip(144..176, 78..82);
    assert!(!stick.yields && stick.radius_m() > 0.04, "{stick:?}");
    let (sheet, _) = strip(80..240, 60..100);
    assert!(!sheet.yields, "{sheet:?}");
    // The bare table.
    let (nothing, _) = strip(0..0, 0..0);
    assert!(!nothing.yields, "{nothing:?}");
}

/// A block of 30 x 30 x 100 mm, and a wall of 6 mm beside it with a gap, across the way to the place.
fn block_beside_a_wall(gap_m: f64, wall_m: f32) -> (Heightmap, PickPlace) {
    let mut heightmap = empty_table();
    let workspace = heightmap.workspace;
    let pick = Vector2::new(0.5, -0.15);
    for index in 0..workspace.len() {
        let (row, col) = (index / workspace.cols, index % workspace.cols);
        let at = workspace.center(heightmap::Pixel { row, col }).coords - pick;
        let beyond_m = at.y - 0.015 - gap_m;
        if at.amax() < 0.015 {
            heightmap.height_m[index] = 0.1;
        } else if (0.0..0.006).contains(&beyond_m) {
            heightmap.height_m[index] = wall_m;
        }
    }
    let pose = |at| Isometry2::new(at, 0.0);
    let action = PickPlace {
        pick: pose(pick),
        place: pose(Vector2::new(0.5, 0.2)),
    };
    (heightmap, action)
}

#[test]
fn what_stands_beside_an_object_is_passed_on_its_way_straight_up_and_not_after_it() {
    let cell = cell();
    let checker = checker(&cell);
    // Lifted by 60 mm, at 0.15 m/s.
    let settings = PrimitiveSettings::BEADS;
    let slow = Touchdown {
        pick_m: 0.1,
        pick_ground_m: 0.0,
        place_m: 0.0,
        slow_from_m: 0.03,
        slow_m_s: 0.05,
        window_m: 0.015,
        press_m: 0.003,
        senses_pick: true,
        senses_place: true,
    };
    let rehearsed = |gap_m: f64, wall_m: f32, touchdown| {
        let (heightmap, action) = block_beside_a_wall(gap_m, wall_m);
        let (arm, home) = (&cell.arm, &cell.arm.home);
        let situation = Situation {
            joints: home,
            holds: false,
            heightmap: Some(&heightmap),
            touchdown,
        };
        rehearse(&checker, arm, &action, &settings, &situation)
    };
    for (gap_m, touchdown) in [
        (0.005, None),
        (0.005, Some(&slow)),
        (0.02, None),
        (0.02, Some(&slow)),
    ] {
        // The block hangs over a wall that is as low as that.
        rehearsed(gap_m, 0.05, touchdown).unwrap();
        // A wall of 90 mm is higher than the block was lifted, and lower than the cup.
        let refused = rehearsed(gap_m, 0.09, touchdown).unwrap_err().to_string();
        assert!(
            refused.contains("Transfer") && refused.contains("the carried object"),
            "{gap_m}: {refused}"
        );
    }
}

#[test]
fn a_low_way_over_a_cable_is_refused_also_where_nothing_is_seen_that_would_be_carried() {
    let cell = cell();
    let checker = checker(&cell);
    // A cable of 12 mm across the way, between its ends.
    let mut cable = empty_table();
    for row in 158..162 {
        cable.height_m[row * 160 + 40..row * 160 + 120].fill(0.012);
    }
    let pose = |y_m| Isometry2::new(Vector2::new(0.5, y_m), 0.0);
    let action = PickPlace {
        pick: pose(-0.2),
        place: pose(0.2),
    };
    let rehearsed = |heightmap: &Heightmap, lift_m: f64| {
        let settings = PrimitiveSettings {
            lift_m,
            ..PrimitiveSettings::BEADS
        };
        let situation = Situation {
            joints: &cell.arm.home,
            holds: false,
            heightmap: Some(heightmap),
            touchdown: None,
        };
        rehearse(&checker, &cell.arm, &action, &settings, &situation)
    };
    // The cup alone would graze it, with whatever flat thing it may hold.
    let refused = rehearsed(&cable, 0.012).unwrap_err().to_string();
    assert!(
        refused.contains("Transfer") && refused.contains("the heightmap"),
        "{refused}"
    );
    rehearsed(&cable, 0.05).unwrap();
    rehearsed(&empty_table(), 0.012).unwrap();
}

/// A block of 30 x 30 mm, as high as that, and something of other cells beside the place: what a rehearsal of its way there says, with the heights
/// of the surfaces known.
fn rehearsed_beside(
    object_m: f32,
    place: Vector2<f64>,
    (rows, cols, beside_m): (std::ops::Range<usize>, std::ops::Range<usize>, f32),
) -> Result<Outcome, String> {
    let cell = cell();
    let (mut heightmap, mut action) = block_beside_a_wall(0.005, 0.0);
    for height_m in heightmap.height_m.iter_mut().filter(|m| **m > 0.0) {
        *height_m = object_m;
    }
    for row in rows {
        heightmap.height_m[row * 160 + cols.start..row * 160 + cols.end].fill(beside_m);
    }
    action.place = Isometry2::new(place, 0.0);
    let touchdown = Touchdown {
        pick_m: object_m.into(),
        pick_ground_m: 0.0,
        place_m: 0.0,
        slow_from_m: 0.03,
        slow_m_s: 0.05,
        window_m: 0.015,
        press_m: 0.0,
        senses_pick: true,
        senses_place: true,
    };
    let situation = Situation {
        joints: &cell.arm.home,
        holds: false,
        heightmap: Some(&heightmap),
        touchdown: Some(&touchdown),
    };
    let settings = PrimitiveSettings::RIGID;
    let rehearsed = rehearse(&checker(&cell), &cell.arm, &action, &settings, &situation);
    rehearsed
        .map(|(outcome, _)| outcome)
        .map_err(|error| error.to_string())
}

#[test]
fn a_tool_that_has_lost_its_object_goes_on_down_beside_what_it_stood_beside_and_no_further() {
    // 2 mm from the cup, whose radius is 10 mm.
    let place = Vector2::new(0.25 + 84.0 * 0.003125 - 0.012, 0.2);
    let beside =
        |object_m, beside_m| rehearsed_beside(object_m, place, (216..232, 84..90, beside_m));
    // With the object the tip comes to 12 mm, beside something of 25 mm; without it to the table.
    assert_eq!(beside(0.012, 0.025), Ok(Outcome::Placed));
    // Here it would have stayed above that.
    let refused = beside(0.04, 0.03).unwrap_err();
    assert!(
        refused.starts_with("if the object is lost on its way: DescendToPlace"),
        "{refused}"
    );
}

#[test]
fn where_the_surfaces_are_known_a_wrong_cell_beside_the_place_is_not_taken_for_the_contact() {
    let place = Vector2::new(0.25 + 84.0 * 0.003125 - 0.008, 0.2);
    let row = Workspace::RAVENS.pixel(&Point2::from(place)).unwrap().row;
    let found = rehearsed_beside(0.012, place, (row..row + 1, 84..85, 0.03));
    assert_eq!(found, Ok(Outcome::Placed));
}

/// The built-in cell with a ball of 20 mm that hangs in the air.
fn cell_with_ball(at: Vector3<f64>) -> WorkCell {
    let ball = format!(
        "<link name=\"ball\"><collision><geometry><sphere radius=\"0.02\"/></geometry></collision></link>\
        <joint name=\"world-ball\" type=\"fixed\"><parent link=\"world\"/><child link=\"ball\"/>\
        <origin xyz=\"{} {} {}\" rpy=\"0 0 0\"/></joint></robot>",
        at.x, at.y, at.z
    );
    WorkCell::parse(&cell().urdf.replace("</robot>", &ball), "cell.urdf").unwrap()
}

#[test]
fn what_only_a_way_home_after_a_failure_would_hit_is_refused_and_named() {
    let arm = &cell().arm;
    let pose = |y_m| Isometry2::new(Vector2::new(0.5, y_m), 0.0);
    let over = |y_m, height_m| {
        let above = Arm::tip_down(&pose(y_m), height_m);
        arm.solve(&above, &arm.ready).unwrap()
    };
    // Lifted much higher than the clearance: a failure is noticed where nothing else leads home from.
    let (low_m, high_m) = (0.05, 0.45);
    let settings = PrimitiveSettings {
        clearance_m: low_m,
        lift_m: high_m,
        ..PrimitiveSettings::RIGID
    };
    let (right_m, left_m) = (-0.25, 0.25);
    let home_from = |from: Joints, share: f64| from + (arm.home - from) * share;
    let tip = |joints| arm.tip(&joints).translation.vector;
    let wrist = |joints| arm.links(&joints)[3].translation.vector;
    // How it ends, where it begins, picks and places, and where a ball hangs on the way home from there.
    let cases = [
        (
            Outcome::NoContact,
            (over(left_m, high_m), right_m, left_m),
            tip(home_from(over(right_m, low_m), 0.4)),
            "if there is nothing to pick: Home",
        ),
        (
            Outcome::GraspFailed,
            (arm.home, left_m, right_m),
            wrist(home_from(over(left_m, high_m), 0.3)),
            "if suction holds nothing: Home",
        ),
        (
            Outcome::Dropped,
            (arm.home, right_m, left_m),
            wrist(home_from(over(left_m, high_m), 0.4)),
            "if the object is lost on its way: Home",
        ),
    ];
    for (ends, (start, pick_m, place_m), ball_at, reason) in cases {
        let action = PickPlace {
            pick: pose(pick_m),
            place: pose(place_m),
        };
        let rehearsed = |cell: &WorkCell| {
            let situation = Situation {
                joints: &start,
                holds: false,
                heightmap: Some(&empty_table()),
                touchdown: None,
            };
            rehearse(&checker(cell), arm, &action, &settings, &situation)
        };
        rehearsed(&cell()).unwrap();
        let refused = rehearsed(&cell_with_ball(ball_at)).unwrap_err();
        let text = refused.to_string();
        // What is expected is looked at first: it is free.
        assert_eq!(refused.ends, ends, "{text}");
        assert!(text.starts_with(reason) && text.contains("ball"), "{text}");
    }
}
