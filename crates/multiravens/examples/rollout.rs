//! One demonstration, with pictures: `cargo run --release -p multiravens --example rollout -- [PROBLEM] [SEED] [OUT_DIR]`.
//!
//! Writes what the front camera and the heightmap show at the start, in the middle and at the goal.

use anyhow::Context;
use heightmap::Heightmap;
use multiravens::{Environment, Problem};
use std::path::{Path, PathBuf};
use ur5::WorkCell;

fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let name = arguments.next().unwrap_or_else(|| "placing".into());
    let seed = arguments.next().unwrap_or_else(|| "0".into());
    let seed: u64 = seed.parse().context("SEED: expected a number")?;
    let out = PathBuf::from(arguments.next().unwrap_or_else(|| "target/rollout".into()));
    std::fs::create_dir_all(&out).with_context(|| format!("cannot make {}", out.display()))?;

    let problems = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/problems");
    let problem = Problem::load(&problems, &name)?;
    let mut environment = Environment::new(&problem, &WorkCell::builtin()?);
    environment.reset(seed)?;
    let middle = environment.goal_count() / 2;
    draw(&mut environment, &out, "start")?;
    while !environment.is_done() {
        let Some(action) = environment.demonstrate() else {
            println!("the demonstrator knows no further action");
            break;
        };
        let report = environment.step(&action)?;
        println!(
            "step {:2} {:8} {:?} delta {:+.3} total {:.3} settled {} t {:.2} s",
            environment.steps(),
            report.module,
            report.outcome,
            report.delta_reward,
            report.total_reward,
            report.settled,
            report.time.as_secs_f64()
        );
        if environment.steps() == middle {
            draw(&mut environment, &out, "middle")?;
        }
    }
    draw(&mut environment, &out, "goal")?;
    println!("pictures in {}", out.display());
    Ok(())
}

fn draw(environment: &mut Environment, out: &Path, when: &str) -> anyhow::Result<()> {
    let heightmap = environment.observe()?.clone();
    let (rows, cols) = (
        heightmap.workspace.rows as u32,
        heightmap.workspace.cols as u32,
    );
    let rgb = image::ColorType::Rgb8;
    image::save_buffer(
        out.join(format!("{when}_rgb.png")),
        &heightmap.rgb,
        cols,
        rows,
        rgb,
    )?;
    let grey = grey(&heightmap);
    let l8 = image::ColorType::L8;
    image::save_buffer(
        out.join(format!("{when}_height.png")),
        &grey,
        cols,
        rows,
        l8,
    )?;
    for view in environment.cell().views() {
        let (width, height) = (view.camera.intrinsics.width, view.camera.intrinsics.height);
        let file = out.join(format!("{when}_{}.png", view.camera.name));
        image::save_buffer(file, view.rgb, width as u32, height as u32, rgb)?;
    }
    Ok(())
}

/// Heights up to 6 cm as shades of grey.
fn grey(heightmap: &Heightmap) -> Vec<u8> {
    let shades = heightmap.height_m.iter().map(|z| (z / 0.06 * 255.0) as u8);
    shades.collect()
}
