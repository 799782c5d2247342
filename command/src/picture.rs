//! `sctn picture`: what the cameras, the fusion, the demonstrator and the policy make of a problem.

use crate::demos::demonstration;
use crate::policy::PolicyArguments;
use crate::root::Root;
use anyhow::{Context, Result};
use clap::Args;
use gctn::{Goal, Policy, ScoreMap};
use heightmap::Heightmap;
use heightmap::picture::{self, RgbImage};
use learning::goal;
use multiravens::Environment;
use std::path::PathBuf;

/// Arguments of `sctn picture`.
#[derive(Args)]
pub struct Picture {
    /// Problem to draw
    #[arg(long)]
    problem: String,
    /// Seed of the episode
    #[arg(long)]
    seed: u64,
    /// Step of the demonstration to draw, from 1
    #[arg(long, default_value_t = 1)]
    step: usize,
    #[command(flatten)]
    policy: PolicyArguments,
    /// Folder for the pictures
    #[arg(long)]
    out: PathBuf,
}

impl Picture {
    pub fn run(self, root: &Root) -> Result<()> {
        let (problem, work_cell) = (root.problem(&self.problem)?, root.work_cell()?);
        std::fs::create_dir_all(&self.out).with_context(|| self.out.display().to_string())?;
        let write = |name: &str, image: &RgbImage| -> Result<()> {
            let path = self.out.join(name);
            picture::write(&path, image)?;
            println!("{}", path.display());
            Ok(())
        };
        let mut environment = Environment::new(&problem, &work_cell);
        environment.reset(self.seed)?;
        environment.observe()?;
        for view in environment.cell().views() {
            let intrinsics = &view.camera.intrinsics;
            let image = picture::camera(intrinsics.width, intrinsics.height, view.rgb);
            write(&format!("camera_{}.png", view.camera.name), &image)?;
        }
        let shown = demonstration(&problem, &work_cell, self.seed)?;
        let count = shown.steps.len();
        let step = self
            .step
            .checked_sub(1)
            .and_then(|index| shown.steps.get(index));
        let step = step.with_context(|| format!("--step {}: expected 1 to {count}", self.step))?;
        let earned = shown.steps[..self.step - 1]
            .iter()
            .filter(|step| step.delta_reward > 0.0)
            .count();
        let goals = shown.goals();
        let image = goals
            .get(earned)
            .copied()
            .context("no reward follows this step: there is no goal")?;
        let both = |heightmap: &Heightmap| {
            picture::side_by_side(&[picture::colors(heightmap), picture::heights(heightmap)])
        };
        write("heightmap.png", &both(&step.observation))?;
        write("goal.png", &both(image))?;
        gctn::set_threads(1);
        let policy = self.policy.load(root)?;
        let conditioning = policy.config().conditioning;
        let goal = goal(shown.observation(0), &goals, earned, conditioning);
        let goal = goal.context("a demonstration without a goal")?;
        write("scores.png", &scores(&policy, &step.observation, goal)?)
    }
}

/// Pick and place scores of a policy over an observation, side by side, with the poses it decides on.
pub fn scores(policy: &Policy, observation: &Heightmap, goal: Goal<'_>) -> Result<RgbImage> {
    let decision = policy.decide(observation, goal, &[])?;
    let over = |map: &ScoreMap| {
        let mut image = picture::scores(observation, map.rows, map.cols, &map.scores);
        let (pick, place) = (&decision.pick, &decision.place);
        picture::mark(&mut image, &observation.workspace, pick, place);
        image
    };
    let maps = [over(&decision.pick_map), over(&decision.place_map)];
    Ok(picture::side_by_side(&maps))
}
