//! `sctn problems`: problems of the module *arranging*, drawn at random.

use crate::root::Root;
use anyhow::{Context, Result, ensure};
use clap::Args;
use learning::GENERATED;
use multiravens::tasks::arranging::generator::Ranges;
use std::path::PathBuf;

/// Arguments of `sctn problems`.
#[derive(Args)]
pub struct Problems {
    /// Ranges to draw from [default: config/arrangements.yaml]
    #[arg(long)]
    ranges: Option<PathBuf>,
    /// Number of problems
    #[arg(long)]
    count: u64,
    /// Seed of the first problem; the next ones are seed + 2, seed + 4, ... (training even, validation odd, test from 10,000 up)
    #[arg(long)]
    seed: u64,
    /// Folder for the problem files, arranged_SEED.yaml each; those already there are replaced
    #[arg(long)]
    out: PathBuf,
    /// Print a JSON object last
    #[arg(long)]
    json: bool,
}

impl Problems {
    pub fn run(self, root: &Root) -> Result<()> {
        ensure!(self.count > 0, "--count is 0, expected at least 1");
        let file = self
            .ranges
            .unwrap_or_else(|| root.join("config/arrangements.yaml"));
        let ranges = Ranges::load(&file)?;
        std::fs::create_dir_all(&self.out).with_context(|| self.out.display().to_string())?;
        for index in 0..self.count {
            let seed = self.seed + 2 * index;
            let path = self.out.join(format!("{GENERATED}{seed:06}.yaml"));
            let text = ranges
                .generate(seed)
                .with_context(|| file.display().to_string())?;
            let text = format!("# Drawn by `sctn problems --seed {seed}`.\n{text}");
            std::fs::write(&path, text).with_context(|| path.display().to_string())?;
        }
        if self.json {
            let report = serde_json::json!({"problems": self.count, "folder": self.out});
            println!("{report}");
        } else {
            println!("{} problems in {}", self.count, self.out.display());
        }
        Ok(())
    }
}
