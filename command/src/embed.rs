//! `sctn embed`.

use crate::progress;
use crate::root::Root;
use anyhow::{Context, Result};
use clap::Args;
use gctn::{EmbeddingTrainer, ModelCard};
use heightmap::Heightmap;
use learning::{DataSet, EmbeddingRecipe};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::path::PathBuf;

/// Gradient steps between lines of progress.
const LOG_EVERY: u64 = 50;

/// Arguments of `sctn embed`. A training takes minutes: it cannot be resumed.
#[derive(Args)]
pub struct Embed {
    /// Recipe
    #[arg(long)]
    recipe: PathBuf,
    /// Folder that `sctn demos` wrote
    #[arg(long)]
    demos: PathBuf,
    /// File for the embedding
    #[arg(long)]
    out: PathBuf,
}

impl Embed {
    pub fn run(self, root: &Root) -> Result<()> {
        let recipe = EmbeddingRecipe::load(&self.recipe)?;
        root.check_trainable(&recipe.problems)?;
        let mut data = DataSet::default();
        for problem in &recipe.problems {
            root.problem(problem)?;
            data.load(&self.demos, problem, recipe.demonstrations, false)?;
        }
        let training = &recipe.training;
        let mut trainer = EmbeddingTrainer::new(&recipe.network, training)?;
        let bar = progress::bar(training.steps, "steps");
        let (mut loss, mut right) = (0.0, 0.0);
        let mut rng = ChaCha8Rng::seed_from_u64(training.seed);
        while trainer.step() < training.steps {
            let sequences = (0..training.batch).map(|_| data.draw_images(&mut rng));
            let sequences = sequences.collect::<Result<Vec<_>, _>>()?;
            let sequences = sequences
                .iter()
                .map(|images| images.iter().map(AsRef::as_ref));
            let sequences: Vec<Vec<&Heightmap>> = sequences.map(Iterator::collect).collect();
            let step = trainer.train_step(&sequences)?;
            loss += step.loss / LOG_EVERY as f64;
            right += step.right / LOG_EVERY as f64;
            bar.inc(1);
            if trainer.step().is_multiple_of(LOG_EVERY) {
                let percent = 100.0 * right;
                bar.suspend(|| {
                    tracing::info!(
                        "step {}: loss {loss:.3}, own image nearest {percent:.1} %",
                        trainer.step()
                    )
                });
                (loss, right) = (0.0, 0.0);
            }
        }
        bar.finish_and_clear();
        let card = ModelCard::from([
            (
                "recipe".into(),
                serde_json::to_string(&recipe).unwrap_or_default(),
            ),
            (
                "trained with".into(),
                format!("sctn {}", env!("CARGO_PKG_VERSION")),
            ),
        ]);
        if let Some(folder) = self.out.parent() {
            std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
        }
        trainer.save_checkpoint(&self.out, &card)?;
        println!("{}", self.out.display());
        Ok(())
    }
}
