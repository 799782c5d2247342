//! scratch
use multiravens::*;
use nalgebra::*;
use pick_place::*;
use rand::*;
use rand_chacha::*;
use std::collections::BTreeMap;
use ur5::*;
fn cpu() -> f64 {
    let s = std::fs::read_to_string("/proc/self/schedstat").unwrap();
    s.split(' ').next().unwrap().parse::<f64>().unwrap() * 1e-9
}
fn main() {
    let c0 = cpu();
    let n: u64 = std::env::args().nth(1).unwrap().parse().unwrap();
    let problem = Problem::load(std::path::Path::new("config/problems"), "placing").unwrap();
    let mut env = Environment::new(&problem, &WorkCell::builtin().unwrap());
    let mut outcomes = BTreeMap::new();
    let mut complete = 0;
    let mut maxr = 0.0f64;
    for seed in 0..n {
        env.reset(seed).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        while !env.is_done() {
            let mut p = || {
                Isometry2::new(
                    Vector2::new(rng.random_range(0.25..0.75), rng.random_range(-0.5..0.5)),
                    rng.random_range(-3.1..3.1),
                )
            };
            let mut a = PickPlace {
                pick: p(),
                place: p(),
            };
            if rng.random_bool(0.6) {
                let bs: Vec<_> = env.cell().world().bodies().collect();
                let b = bs[1 + rng.random_range(0..9usize)];
                let q = env.cell().world().position(b);
                a.pick = Isometry2::new(
                    Vector2::new(
                        q.x + rng.random_range(-0.02..0.02),
                        q.y + rng.random_range(-0.02..0.02),
                    ),
                    0.3,
                );
                let b = bs[rng.random_range(0..10usize)];
                let q = env.cell().world().position(b);
                a.place = Isometry2::new(
                    Vector2::new(
                        q.x + rng.random_range(-0.04..0.04),
                        q.y + rng.random_range(-0.04..0.04),
                    ),
                    0.3,
                );
                if heightmap::Workspace::RAVENS
                    .pixel(&a.pick.translation.vector.into())
                    .is_none()
                    || heightmap::Workspace::RAVENS
                        .pixel(&a.place.translation.vector.into())
                        .is_none()
                {
                    continue;
                }
            }
            match env.step(&a) {
                Ok(r) => {
                    *outcomes
                        .entry(format!("{:?} settled {}", r.outcome, r.settled))
                        .or_insert(0) += 1;
                    maxr = maxr.max(r.total_reward);
                    if false {
                        println!(
                            "seed {seed} step {} unsettled speed {}",
                            env.steps(),
                            env.cell().world().fastest_m_s()
                        );
                        for b in env.cell().world().bodies() {
                            let v = env.cell().world().velocity_m_s(b).norm();
                            if v > 0.003 {
                                println!(
                                    "   {b:?} {:?} v {v}",
                                    env.cell().world().pose(b).translation.vector
                                );
                            }
                        }
                    }
                }
                Err(e) => {
                    println!("seed {seed} step {} {a:?} {e}", env.steps());
                    break;
                }
            }
        }
        if env.is_complete() {
            complete += 1;
        }
    }
    println!("cpu {:.2} sim", cpu() - c0);
    println!("{outcomes:?} complete {complete} max reward {maxr}");
}
