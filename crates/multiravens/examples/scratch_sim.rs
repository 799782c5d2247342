//! scratch
use multiravens::*;
use std::time::Instant;
use ur5::*;
fn cpu() -> f64 {
    let s = std::fs::read_to_string("/proc/self/stat").unwrap();
    let f: Vec<&str> = s.split(' ').collect();
    (f[13].parse::<f64>().unwrap() + f[14].parse::<f64>().unwrap()) * 0.01
}
fn main() {
    let n: u64 = std::env::args().nth(1).unwrap().parse().unwrap();
    let problem = Problem::load(
        std::path::Path::new("config/problems"),
        &std::env::args().nth(2).unwrap(),
    )
    .unwrap();
    let mut env = Environment::new(&problem, &WorkCell::builtin().unwrap());
    let mut ok = 0;
    let mut steps = 0;
    let mut sim = 0.0;
    let t0 = cpu();
    let mut obs: f64 = 0.0;
    let _ = &mut obs;
    for seed in 0..n {
        env.reset(seed).unwrap();
        let o = cpu();
        env.observe().unwrap();
        obs += cpu() - o;
        while !env.is_done() {
            let Some(a) = env.demonstrate() else {
                println!("seed {seed}: none");
                break;
            };
            let r = match env.step(&a) {
                Ok(r) => r,
                Err(e) => {
                    println!("seed {seed} {e}");
                    break;
                }
            };
            steps += 1;
            let o = cpu();
            env.observe().unwrap();
            obs += cpu() - o;
            if r.delta_reward <= 0.0 || !r.settled || env.cell().world().fastest_m_s() > 0.005 {
                println!("seed {seed} step {} {r:?}", env.steps());
            }
        }
        sim += env.cell().time().as_secs_f64();
        if env.is_complete() {
            ok += 1
        } else {
            println!("seed {seed} failed")
        }
    }
    let s = cpu() - t0;
    println!(
        "{ok}/{n} steps {steps} sim {:.1} s/episode, wall {:.3} s/episode, {:.1} us/step",
        sim / n as f64,
        s / n as f64,
        s / sim / 480.0 * 1e6
    );
}
