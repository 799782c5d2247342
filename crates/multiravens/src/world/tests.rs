//! Physics of the table top, without arm and tasks.

use super::*;
use nalgebra::Isometry2;
use std::f64::consts::TAU;

/// Tip down at a place.
fn tip(x: f64, y: f64, z: f64) -> Isometry3<f64> {
    ur5::Arm::tip_down(&Isometry2::translation(x, y), z)
}

fn seconds(world: &mut World, seconds: f64, at: &Isometry3<f64>) {
    for _ in 0..(seconds * f64::from(STEPS_PER_SECOND)) as usize {
        world.step(at);
    }
}

/// Moves the tip on a straight line; returns the worst joint error on the way.
fn drag(
    world: &mut World,
    from: &Isometry3<f64>,
    to: &Isometry3<f64>,
    speed_m_s: f64,
    chain: &BeadChain,
) -> f64 {
    let way = to.translation.vector - from.translation.vector;
    let steps = (way.norm() / speed_m_s * f64::from(STEPS_PER_SECOND)) as usize;
    let mut worst: f64 = 0.0;
    for step in 1..=steps {
        let mut at = *from;
        at.translation.vector += way * (step as f64 / steps as f64);
        world.step(&at);
        worst = worst.max(world.joint_error_m(chain));
    }
    worst
}

/// Steps down until the tip touches; returns where.
fn lower(world: &mut World, x: f64, y: f64, from: f64) -> Isometry3<f64> {
    let mut z = from;
    while z > -0.01 {
        z -= 0.1 / f64::from(STEPS_PER_SECOND);
        world.step(&tip(x, y, z));
        if world.touches() {
            break;
        }
    }
    tip(x, y, z)
}

fn line(count: usize) -> Vec<Point3<f64>> {
    let along = |i| 0.3 + i as f64 * BeadChain::PITCH_M;
    let points = (0..count).map(|i| Point3::new(along(i), 0.0, BeadChain::BEAD_RADIUS_M));
    points.collect()
}

fn ring(count: usize) -> Vec<Point3<f64>> {
    let radius = BeadChain::PITCH_M / 2.0 / (TAU / 2.0 / count as f64).sin();
    let points = (0..count).map(|i| {
        let angle = TAU * i as f64 / count as f64;
        Point3::new(
            0.5 + radius * angle.cos(),
            radius * angle.sin(),
            BeadChain::BEAD_RADIUS_M,
        )
    });
    points.collect()
}

#[test]
fn a_chain_at_rest_stays_where_it_is() {
    for (centers, closed) in [(line(25), false), (ring(35), true)] {
        let away = tip(0.5, 0.3, 0.3);
        let mut world = World::new(&away);
        let chain = world.add_bead_chain(&centers, closed, false, |_| [255; 3]);
        seconds(&mut world, 2.0, &away);
        assert!(world.fastest_m_s() < 5e-3);
        assert!(world.joint_error_m(&chain) < 5e-4);
        for (bead, center) in chain.beads.iter().zip(&centers) {
            assert!((world.position(*bead) - center).norm() < 1e-3);
        }
    }
}

#[test]
fn a_carried_bead_drags_its_chain_without_opening_joints() {
    let away = tip(0.3, 0.0, 0.1);
    let mut world = World::new(&away);
    let chain = world.add_bead_chain(&line(25), false, true, |_| [255; 3]);
    seconds(&mut world, 0.3, &away);
    let last = world.position(chain.beads[24]);
    let above = tip(last.x, last.y, 0.05);
    drag(&mut world, &away, &above, 0.3, &chain);
    let grasped = lower(&mut world, last.x, last.y, 0.05);
    assert!(world.grasp());
    assert_eq!(world.held(), Some(chain.beads[24]));
    let mut worst: f64 = 0.0;
    let lifted = tip(last.x, last.y, 0.06);
    worst = worst.max(drag(&mut world, &grasped, &lifted, 0.15, &chain));
    let aside = tip(0.45, 0.25, 0.06);
    worst = worst.max(drag(&mut world, &lifted, &aside, 0.15, &chain));
    // As a cell does: the tip catches up before it goes on.
    seconds(&mut world, 0.3, &aside);
    let down = lower(&mut world, 0.45, 0.25, 0.06);
    world.release();
    assert!(world.held().is_none());
    let up = tip(0.45, 0.25, 0.1);
    drag(&mut world, &down, &up, 0.2, &chain);
    seconds(&mut world, 1.5, &up);
    assert!(worst < 2e-3, "joint error {worst}");
    assert!(world.fastest_m_s() < 5e-3);
    let off = world.position(chain.beads[24]) - Point3::new(0.45, 0.25, 0.006);
    // It may come down on its neighbour and roll off.
    assert!(off.norm() < 2.0 * BeadChain::PITCH_M, "{off}");
}

#[test]
fn over_pulling_an_anchored_cable_lags_but_opens_no_joint() {
    let away = tip(0.3, 0.0, 0.1);
    let mut world = World::new(&away);
    let chain = world.add_bead_chain(&line(15), false, true, |_| [255; 3]);
    let last = world.position(chain.beads[14]);
    let above = tip(last.x, last.y, 0.05);
    drag(&mut world, &away, &above, 0.3, &chain);
    let grasped = lower(&mut world, last.x, last.y, 0.05);
    assert!(world.grasp());
    let far = tip(last.x + 0.06, last.y, grasped.translation.z);
    let worst = drag(&mut world, &grasped, &far, 0.15, &chain);
    assert!(world.lag_m() > 0.02, "lag {}", world.lag_m());
    assert!(worst < 2e-3, "joint error {worst}");
}

#[test]
fn a_stack_of_blocks_stands() {
    let away = tip(0.3, 0.3, 0.3);
    let mut world = World::new(&away);
    let blocks: Vec<_> = (0..3)
        .map(|level| {
            world.add(&Part {
                shape: Shape::Cuboid {
                    size_m: Vector3::repeat(0.04),
                },
                pose: Isometry3::translation(0.5, 0.0, 0.02 + 0.04 * f64::from(level)),
                mobility: Mobility::Free {
                    mass_kg: 0.01,
                    suction_force_n: 5.0,
                },
                friction: 0.5,
                rgb: [255; 3],
            })
        })
        .collect();
    seconds(&mut world, 3.0, &away);
    let top = world.position(blocks[2]);
    assert!((top - Point3::new(0.5, 0.0, 0.1)).norm() < 5e-4, "{top}");
}

#[test]
fn states_hash_by_their_bits() {
    let away = tip(0.3, 0.3, 0.3);
    let build = || {
        let mut world = World::new(&away);
        world.add_bead_chain(&ring(35), true, false, |_| [255; 3]);
        world
    };
    let (mut a, mut b) = (build(), build());
    let start = a.state_hash();
    for _ in 0..100 {
        a.step(&away);
        b.step(&away);
        assert_eq!(a.state_hash(), b.state_hash());
    }
    assert_ne!(a.state_hash(), start);
}
