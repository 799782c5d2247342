//! `sctn demos --gallery`: what the problems and their solutions look like.

use crate::root::Root;
use anyhow::{Context, Result, bail};
use heightmap::picture::{self, RgbImage};
use image::codecs::gif::{GifEncoder, Repeat};
use image::imageops::{self, FilterType};
use image::{Delay, DynamicImage, Frame};
use multiravens::world::STEPS_PER_SECOND;
use multiravens::{Cell, Environment, Problem, Watched};
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use ur5::WorkCell;

/// The camera that faces the robot.
const CAMERA: &str = "front";
/// Physics steps from one frame of the film to the next, half a second, and how long it is shown.
const FRAME_STEPS: u32 = STEPS_PER_SECOND / 2;
const FRAME_MS: u32 = 100;
/// Height of the pictures in an overview.
const OVERVIEW_PX: u32 = 240;

/// Draws a problem, or all of them: `PROBLEM.png`, an overview of start, middle and goal, and in
/// `PROBLEM/` these pictures in full, from above and by the front camera, and the film of the
/// demonstration, `rollout.gif`, five times as fast as it is.
pub fn draw(root: &Root, problem: Option<&str>, seed: u64, folder: &Path) -> Result<()> {
    let work_cell = root.work_cell()?;
    let names = match problem {
        Some(name) => vec![name.to_owned()],
        None => {
            let problems = root.join("config/problems");
            Problem::names(&problems).with_context(|| problems.display().to_string())?
        }
    };
    for name in names {
        let problem = root.problem(&name)?;
        draw_problem(&problem, &work_cell, seed, folder)
            .with_context(|| format!("{name}, seed {seed}"))?;
    }
    Ok(())
}

fn draw_problem(problem: &Problem, work_cell: &WorkCell, seed: u64, folder: &Path) -> Result<()> {
    let details = folder.join(problem.name());
    std::fs::create_dir_all(&details).with_context(|| details.display().to_string())?;
    let mut film = Film::create(&details.join("rollout.gif"))?;
    let mut environment = Environment::new(problem, work_cell);
    environment.reset(seed)?;
    let start = Still::take(&mut environment)?;
    let mut middle = None;
    let arm = &work_cell.arm;
    while let (false, Some(settings)) = (environment.is_done(), environment.settings()) {
        let Some(action) = environment.demonstrate() else {
            break;
        };
        let mut filmed = Watched {
            cell: environment.cell_mut(),
            watch: |cell: &mut Cell| film.shoot(cell),
        };
        pick_place::execute(&mut filmed, arm, &action, &settings, |_| ())?;
        environment.assess();
        if middle.is_none() && environment.total_reward() > 0.5 - 1e-9 {
            middle = Some(Still::take(&mut environment)?);
        }
    }
    let (Some(middle), true) = (middle, environment.is_complete()) else {
        bail!("the demonstrator does not complete it: choose another --seed");
    };
    let goal = Still::take(&mut environment)?;
    let stills = [("start", start), ("middle", middle), ("goal", goal)];
    for (when, still) in &stills {
        picture::write(&details.join(format!("{when}_above.png")), &still.above)?;
        let name = format!("{when}_{CAMERA}.png");
        picture::write(&details.join(name), &still.camera)?;
    }
    let above = stills.iter().map(|(_, still)| &still.above);
    let small = above.chain(stills.iter().map(|(_, still)| &still.camera));
    let small: Vec<_> = small
        .map(|image| {
            let width = image.width() * OVERVIEW_PX / image.height();
            imageops::thumbnail(image, width, OVERVIEW_PX)
        })
        .collect();
    let overview = folder.join(format!("{}.png", problem.name()));
    picture::write(&overview, &picture::side_by_side(&small))?;
    println!("{}", overview.display());
    Ok(())
}

/// What there is to see at one time.
struct Still {
    above: RgbImage,
    camera: RgbImage,
}

impl Still {
    fn take(environment: &mut Environment) -> Result<Self> {
        let above = picture::colors(environment.observe()?);
        Ok(Self {
            above,
            camera: photograph(environment.cell())?,
        })
    }
}

/// The front camera's image, as last rendered.
fn photograph(cell: &Cell) -> Result<RgbImage> {
    let view = cell.views().find(|view| view.camera.name == CAMERA);
    let view = view.with_context(|| format!("the work cell has no camera `{CAMERA}`"))?;
    let intrinsics = &view.camera.intrinsics;
    Ok(picture::camera(
        intrinsics.width,
        intrinsics.height,
        view.rgb,
    ))
}

/// An animation of the front camera's images.
struct Film {
    encoder: GifEncoder<BufWriter<File>>,
    steps: u32,
}

impl Film {
    fn create(path: &Path) -> Result<Self> {
        let file = File::create(path).with_context(|| path.display().to_string())?;
        let mut encoder = GifEncoder::new_with_speed(BufWriter::new(file), 10);
        encoder.set_repeat(Repeat::Infinite)?;
        Ok(Self { encoder, steps: 0 })
    }

    /// Called after every physics step.
    fn shoot(&mut self, cell: &mut Cell) -> Result<()> {
        if self.steps.is_multiple_of(FRAME_STEPS) {
            cell.render()?;
            let image = photograph(cell)?;
            // Nearest neighbours: no new colours, so that the palette of a frame holds them all.
            let (width, height) = (image.width() / 2, image.height() / 2);
            let image = imageops::resize(&image, width, height, FilterType::Nearest);
            let image = DynamicImage::ImageRgb8(image).into_rgba8();
            let delay = Delay::from_numer_denom_ms(FRAME_MS, 1);
            self.encoder
                .encode_frame(Frame::from_parts(image, 0, 0, delay))?;
        }
        self.steps += 1;
        Ok(())
    }
}
