//! `sctn table`.

use crate::curves;
use crate::root::Root;
use anyhow::{Context, Result, ensure};
use clap::Args;
use learning::{RunResult, Table};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Arguments of `sctn table`.
#[derive(Args)]
pub struct TableCommand {
    /// Folder with the JSON files of `sctn sweep`
    results: PathBuf,
    /// Folder to draw the learning curves into, one PNG for each problem
    #[arg(long)]
    curves: Option<PathBuf>,
}

impl TableCommand {
    pub fn run(self, root: &Root) -> Result<()> {
        let shown = || self.results.display().to_string();
        let mut paths = Vec::new();
        for entry in std::fs::read_dir(&self.results).with_context(shown)? {
            let path = entry.with_context(shown)?.path();
            if path
                .extension()
                .is_some_and(|extension| extension == "json")
            {
                paths.push(path);
            }
        }
        ensure!(
            !paths.is_empty(),
            "{}: holds no results, expected JSON files of sctn sweep",
            shown()
        );
        paths.sort();
        let mut results: Vec<RunResult> = Vec::new();
        for path in paths {
            let name = || path.display().to_string();
            let text = std::fs::read_to_string(&path).with_context(name)?;
            results.push(serde_json::from_str(&text).with_context(name)?);
        }
        let mut modules: BTreeMap<String, Vec<String>> = BTreeMap::new();
        for result in &results {
            let problem = root.problem(&result.problem)?;
            let names = problem
                .modules()
                .iter()
                .map(|placed| placed.name.to_owned());
            modules.insert(result.problem.clone(), names.collect());
        }
        let table = Table::new(&results, |problem| modules[problem].clone());
        print!("{table}");
        println!(
            "\n† more than 10 points above what is expected of single-task agents. Best: the snapshot with the best mean over seeds on the \
             test episodes, as the paper reports it; chosen: of each seed the snapshot that is best on validation episodes."
        );
        if let Some(folder) = self.curves {
            for path in curves::draw(&table, &folder)? {
                eprintln!("{}", path.display());
            }
        }
        Ok(())
    }
}
