//! `sctn bag import`.

use anyhow::{Context as _, Result};
use clap::Args;
use learning::demonstration_path;
use lerobot_dataset::Import as DataSet;
use multiravens::EpisodeSeed;
use std::path::PathBuf;
use std::process::ExitCode;

/// Arguments of `sctn bag import`.
#[derive(Args)]
pub struct Import {
    /// Folder of a data set in LeRobot's layout 3.0 with the columns that `sctn bag export` writes
    data: PathBuf,
    /// Folder for the bags, DIR/PROBLEM/SEED each; those already there are not replaced
    #[arg(long)]
    out: PathBuf,
    /// Print a JSON object last
    #[arg(long)]
    json: bool,
}

impl Import {
    pub fn run(self) -> Result<ExitCode> {
        let (mut episodes, mut frames) = (0, 0);
        DataSet::open(&self.data)?.read(|demonstration| {
            let seed = EpisodeSeed {
                scene: demonstration.seed,
                start: demonstration.start_seed,
            };
            let path = demonstration_path(&self.out, &demonstration.problem, seed);
            let folder = path.parent().context("the bag's folder")?;
            std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
            demonstration.write(&path)?;
            episodes += 1;
            frames += demonstration.steps.len();
            anyhow::Ok(())
        })?;
        let out = self.out;
        if self.json {
            println!(
                "{}",
                serde_json::json!({"out": out, "episodes": episodes, "frames": frames})
            );
        } else {
            println!("{}: {episodes} episodes, {frames} frames", out.display());
        }
        Ok(ExitCode::SUCCESS)
    }
}
