//! `sctn publish`.

use crate::root::Root;
use anyhow::{Context as _, Result, bail};
use clap::Args;
use gctn::Policy;
use serde::Deserialize;
use serde_json::json;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

/// Arguments of `sctn publish`.
#[derive(Args)]
pub struct Publish {
    /// Folder to write; it must not exist
    folder: PathBuf,
    /// Checkpoint to publish [default: the shipped one]
    #[arg(long)]
    checkpoint: Option<PathBuf>,
    /// Evaluations of it, as `sctn evaluate --out FILE` writes them
    #[arg(long, num_args = 1..)]
    results: Vec<PathBuf>,
    /// Name of the model [default: the folder's]
    #[arg(long)]
    name: Option<String>,
}

/// What is read of an evaluation.
#[derive(Deserialize)]
struct Evaluation {
    problem: String,
    start: Option<String>,
    perturb: Option<String>,
    episodes: usize,
    completion: f64,
    reward: f64,
    interval_95: [f64; 2],
}

impl Evaluation {
    fn read(path: &Path) -> Result<Self> {
        let text = fs::read_to_string(path).with_context(|| path.display().to_string())?;
        serde_json::from_str(&text).with_context(|| {
            format!(
                "{}: expected what `sctn evaluate --out` writes",
                path.display()
            )
        })
    }

    /// Which episodes these were.
    fn task(&self) -> String {
        let mut task = format!("{}, {} start", self.problem, self.start());
        if let Some(perturb) = &self.perturb {
            let _ = write!(task, ", cameras of {perturb}");
        }
        task
    }

    fn start(&self) -> &str {
        // Of before there were other starts.
        self.start.as_deref().unwrap_or("same")
    }
}

impl Publish {
    pub fn run(self, root: &Root) -> Result<()> {
        let checkpoint = self.checkpoint.unwrap_or_else(|| root.shipped_checkpoint());
        let policy = Policy::load(&checkpoint)?;
        let name = match self.name {
            Some(name) => name,
            None => {
                let name = self.folder.file_name().and_then(|name| name.to_str());
                name.context("--name: expected the name of the model")?
                    .to_owned()
            }
        };
        let evaluations: Vec<Evaluation> = self
            .results
            .iter()
            .map(|path| Evaluation::read(path))
            .collect::<Result<_>>()?;
        let mut copies: Vec<(PathBuf, PathBuf)> = Vec::new();
        for path in &self.results {
            let file = path.file_name().context("--results: expected files")?;
            let copy = self.folder.join("results").join(file);
            if copies.iter().any(|(_, other)| *other == copy) {
                bail!("--results: two files are called {}", file.display());
            }
            copies.push((path.clone(), copy));
        }
        copies.push((checkpoint, self.folder.join("model.safetensors")));
        let config = json!({
            "model_type": "sctn",
            "network": policy.config(),
            "card": policy.card(),
            "calibration": policy.calibration(),
        });
        let text = readme(&name, &policy, &evaluations)?;

        let made = |path: &Path| path.display().to_string();
        fs::create_dir(&self.folder).with_context(|| made(&self.folder))?;
        if !self.results.is_empty() {
            fs::create_dir(self.folder.join("results"))?;
        }
        for (from, to) in &copies {
            fs::copy(from, to).with_context(|| made(to))?;
        }
        for (file, contents) in [
            ("README.md", text),
            ("config.json", format!("{config:#}\n")),
        ] {
            let path = self.folder.join(file);
            fs::write(&path, contents).with_context(|| made(&path))?;
        }
        println!("{}", made(&self.folder));
        Ok(())
    }
}

/// The model card: a YAML header as the Hugging Face hub reads it, then a page for people. The header is JSON, which is YAML.
fn readme(name: &str, policy: &Policy, evaluations: &[Evaluation]) -> Result<String> {
    let results: Vec<_> = evaluations
        .iter()
        .map(|evaluation| {
            json!({
                "task": {"type": "robotics", "name": "multi-step pick and place"},
                "dataset": {"type": "multiravens", "name": format!("MultiRavens {}", evaluation.task())},
                "metrics": [
                    {"type": "completion", "name": "completion", "value": evaluation.completion,
                     "args": {"episodes": evaluation.episodes, "interval_95": evaluation.interval_95}},
                    {"type": "reward", "name": "reward", "value": evaluation.reward},
                ],
            })
        })
        .collect();
    let model = json!([{"name": name, "results": results}]);
    let config = policy.config();
    let network = serde_json::to_value(&config.network)?;
    let kind = network["kind"].as_str().unwrap_or_default();
    let mut text = format!(
        "---
license: apache-2.0
library_name: multiravens
pipeline_tag: robotics
tags: [robotics, imitation-learning, pick-and-place, transporter-networks, sctn]
model-index: {model}
---

# {name}

A policy of SCTN (Multi-Task Learning with Sequence-Conditioned Transporter Networks): from a heightmap and images of a demonstration it decides
where a suction gripper picks and places.

| | |
|---|---|
| network | `{kind}`, {} x {} cells of {} mm, {} rotations |
| shown as its goal | `{}` |
",
        config.rows,
        config.cols,
        1e3 * config.pixel_size_m,
        config.rotations,
        config.conditioning,
    );
    if !evaluations.is_empty() {
        text += "\n| evaluated on | episodes | completion, 95 % interval | reward |\n|---|---|---|---|\n";
        for evaluation in evaluations {
            let [low, high] = evaluation.interval_95.map(|rate| 100.0 * rate);
            writeln!(
                text,
                "| {} | {} | {:.1} % ({low:.0} to {high:.0}) | {:.3} |",
                evaluation.task(),
                evaluation.episodes,
                100.0 * evaluation.completion,
                evaluation.reward
            )?;
        }
    }
    text += "
`model.safetensors` holds the weights, and in its metadata all of `config.json`; `results/` what was measured.

```python
from multiravens.network import Policy

policy = Policy.load(\"model.safetensors\")
action = policy.decide(observation).action  # observation of a MultiRavens environment: x, y, yaw of pick and place
```
";
    Ok(text)
}
