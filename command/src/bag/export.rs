//! `sctn bag export`.

use anyhow::{Context as _, Result};
use bags::Demonstration;
use clap::Args;
use lerobot_dataset::DataSet;
use std::path::PathBuf;
use std::process::ExitCode;

/// Arguments of `sctn bag export`.
#[derive(Args)]
pub struct Export {
    /// Bags of demonstrations or of recorded runs
    #[arg(required = true)]
    bags: Vec<PathBuf>,
    /// Folder for the data set; it must not exist
    #[arg(long)]
    out: PathBuf,
    /// Print a JSON object last
    #[arg(long)]
    json: bool,
}

impl Export {
    pub fn run(self) -> Result<ExitCode> {
        let mut set = DataSet::create(&self.out)?;
        for bag in &self.bags {
            let demonstration = Demonstration::read(bag)?;
            set.add(&demonstration)
                .with_context(|| format!("export {}", bag.display()))?;
        }
        let (episodes, frames) = (set.episodes(), set.frames());
        set.finish()?;
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
