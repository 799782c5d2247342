//! How long the check of a motion takes.

use collision::{CollisionChecker, Contact, Margins, Scene, Situation, Terrain, rehearse};
use criterion::{Criterion, criterion_group, criterion_main};
use heightmap::{Heightmap, Workspace};
use nalgebra::{Isometry2, Point2, Vector2};
use pick_place::{PickPlace, PrimitiveSettings};
use ur5::{Arm, JointTrajectory, WorkCell};

fn check(criterion: &mut Criterion) {
    let cell = WorkCell::builtin().expect("the cell is in order");
    let checker = CollisionChecker::new(&cell, Margins::default()).expect("margins are in order");
    let mut heightmap = Heightmap::new(Workspace::RAVENS);
    heightmap.rgb.fill(100);
    for (i, height_m) in heightmap.height_m.iter_mut().enumerate() {
        // Blocks of 16 x 16 cells, 40 mm high, all over the table.
        if (i / 160) % 40 < 16 && (i % 160) % 40 < 16 {
            *height_m = 0.04;
        }
    }
    let arm = &cell.arm;
    let over = |x, y, z| Arm::tip_down(&Isometry2::new(Vector2::new(x, y), 0.4), z);
    let above = arm
        .solve(&over(0.45, -0.2, 0.24), &arm.ready)
        .expect("in reach");
    let approach = JointTrajectory::joint_space(arm, &arm.home, &above).expect("in reach");
    let descent =
        JointTrajectory::line(arm, &above, &over(0.45, -0.2, 0.0), 0.35, 4.0).expect("in reach");
    let carry =
        JointTrajectory::line(arm, &above, &over(0.55, 0.3, 0.2), 0.8, 4.0).expect("in reach");
    let terrain = Terrain::new(&heightmap);
    let contacts = vec![Contact {
        center_m: Point2::new(0.45, -0.2),
        radius_m: 0.05,
        above_m: f64::NEG_INFINITY,
        up_to_m: 0.06,
    }];
    let scene = Scene {
        terrain: Some(&terrain),
        contacts,
        ..Scene::default()
    };
    for (name, trajectory) in [
        ("approach", &approach),
        ("descent", &descent),
        ("transfer", &carry),
    ] {
        criterion.bench_function(name, |bencher| {
            bencher.iter(|| checker.check(trajectory, &scene).expect("free"))
        });
    }
    let pose = |x, y| Isometry2::new(Vector2::new(x, y), 0.4);
    let action = PickPlace {
        pick: pose(0.45, -0.2),
        place: pose(0.55, 0.3),
    };
    let situation = Situation {
        joints: &arm.home,
        holds: false,
        heightmap: Some(&heightmap),
        touchdown: None,
    };
    let settings = PrimitiveSettings::RIGID;
    criterion.bench_function("whole pick and place with every way home", |bencher| {
        bencher.iter(|| rehearse(&checker, arm, &action, &settings, &situation).expect("free"))
    });
    criterion.bench_function("terrain of a heightmap", |bencher| {
        bencher.iter(|| Terrain::new(&heightmap))
    });
}

criterion_group!(benches, check);
criterion_main!(benches);
