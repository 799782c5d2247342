//! Time of one physics step, on one thread.

use criterion::{Criterion, criterion_group, criterion_main};
use multiravens::world::{BeadChain, Mobility, Part, Shape, World};
use nalgebra::{Isometry2, Isometry3, Point3, Vector3};
use std::f64::consts::TAU;
use std::hint::black_box;

fn away() -> Isometry3<f64> {
    ur5::Arm::tip_down(&Isometry2::translation(0.5, 0.3), 0.3)
}

/// A world after some steps, the first body pushed so that what touches it stays awake.
fn bench(c: &mut Criterion, name: &str, mut world: World) {
    let (tip, first) = (away(), world.bodies().next());
    for _ in 0..100 {
        world.step(&tip);
    }
    c.bench_function(name, |b| {
        b.iter(|| {
            if let Some(first) = first {
                let pose = world.pose(first);
                world.place(first, &pose);
            }
            world.step(black_box(&tip));
        });
    });
}

fn disks() -> World {
    let mut world = World::new(&away());
    for i in 0..9 {
        let (row, col) = (f64::from(i / 3), f64::from(i % 3));
        world.add(&Part {
            shape: Shape::Cylinder {
                radius_m: 0.026,
                length_m: 0.012,
            },
            pose: Isometry3::translation(0.4 + 0.07 * col, 0.07 * row, 0.006),
            mobility: Mobility::Free {
                mass_kg: 0.02,
                suction_force_n: 5.0,
            },
            friction: 0.5,
            rgb: [255; 3],
        });
    }
    world
}

fn pyramid() -> World {
    let mut world = World::new(&away());
    for (row, count) in [(0, 3), (1, 2), (2, 1)] {
        for i in 0..count {
            let y = 0.045 * (f64::from(i) - f64::from(count - 1) / 2.0);
            world.add(&Part {
                shape: Shape::Cuboid {
                    size_m: Vector3::repeat(0.04),
                },
                pose: Isometry3::translation(0.5, y, 0.02 + 0.04 * f64::from(row)),
                mobility: Mobility::Free {
                    mass_kg: 0.01,
                    suction_force_n: 5.0,
                },
                friction: 0.5,
                rgb: [255; 3],
            });
        }
    }
    world
}

fn ring() -> World {
    let mut world = World::new(&away());
    let radius = BeadChain::PITCH_M / 2.0 / (TAU / 70.0).sin();
    let centers: Vec<_> = (0..35)
        .map(|i| {
            let (sin, cos) = (TAU * f64::from(i) / 35.0).sin_cos();
            let z = BeadChain::BEAD_RADIUS_M;
            Point3::new(0.5 + radius * cos, radius * sin, z)
        })
        .collect();
    world.add_bead_chain(&centers, true, false, |_| [255; 3]);
    world
}

fn physics(c: &mut Criterion) {
    bench(c, "physics_step/empty", World::new(&away()));
    bench(c, "physics_step/disks", disks());
    bench(c, "physics_step/pyramid", pyramid());
    bench(c, "physics_step/ring_of_35_beads", ring());
}

criterion_group!(benches, physics);
criterion_main!(benches);
