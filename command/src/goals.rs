//! `sctn goals`: how often goal modules name the right goal.

use crate::policy::PolicyArguments;
use crate::progress;
use crate::root::Root;
use anyhow::{Context, Result};
use clap::Args;
use gctn::Embedding;
use heightmap::Heightmap;
use learning::{Actor, Start, attempt, known_images, reached, wilson_95};
use multiravens::Environment;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use serde::Serialize;
use std::path::PathBuf;

/// Standard deviations of the cameras' noise in Ravens, of 255 and in metres.
const COLOR_NOISE: f64 = 3.0;
const HEIGHT_NOISE_M: f64 = 0.003;

/// Arguments of `sctn goals`.
#[derive(Args)]
pub struct Goals {
    /// Problem to solve
    #[arg(long)]
    problem: String,
    /// Number of episodes
    #[arg(long)]
    episodes: usize,
    /// Seed of the first episode; the next ones are seed + 2, seed + 4, ... (test: from 10,000 up)
    #[arg(long)]
    seed: u64,
    #[command(flatten)]
    policy: PolicyArguments,
    /// Checkpoint of the embedding [default: the shipped one]
    #[arg(long)]
    embedding: Option<PathBuf>,
    /// File for the report
    #[arg(long)]
    out: Option<PathBuf>,
    /// Print the report as a JSON object last
    #[arg(long)]
    json: bool,
}

/// How often each module was right after a step. The oracle is what right means.
#[derive(Clone, Copy, Debug, Default, Serialize)]
struct Count {
    /// Steps, after each of which a goal is named.
    steps: usize,
    /// Of these, how many left the number of goals reached as it was.
    without_reward: usize,
    image_distance: usize,
    embedding: usize,
    /// Episodes, and in how many of them each module was right after every step.
    episodes: usize,
    image_distance_throughout: usize,
    embedding_throughout: usize,
}

#[derive(Serialize)]
struct Report {
    problem: String,
    first_seed: u64,
    /// The demonstrator's own sequence: what is seen is what was shown, bit for bit.
    demonstrator: Count,
    /// The same with noise on colours and heights.
    demonstrator_noise: Count,
    policy: Count,
    policy_noise: Count,
}

impl Goals {
    pub fn run(self, root: &Root) -> Result<()> {
        let problem = root.problem(&self.problem)?;
        let embedding = self.embedding.unwrap_or_else(|| root.shipped_embedding());
        gctn::set_threads(1);
        let actor = Actor::from(self.policy.load(root)?);
        let embedding = Embedding::load(&embedding)?;
        let mut environment = Environment::new(&problem, &root.work_cell()?);
        let mut report = Report {
            problem: self.problem,
            first_seed: self.seed,
            demonstrator: Count::default(),
            demonstrator_noise: Count::default(),
            policy: Count::default(),
            policy_noise: Count::default(),
        };
        let bar = progress::bar(self.episodes as u64, "episodes");
        let mut seed = self.seed;
        while report.policy.episodes < self.episodes {
            // A seed that the demonstrator fails on has no sequence.
            if let Some(attempt) = attempt(&mut environment, &actor, seed, Start::Same, None)? {
                let shown = &attempt.shown;
                let known = known_images(shown);
                let rollout = &attempt.rollout.demonstration;
                let complete = attempt.rollout.complete;
                let mut rng = ChaCha8Rng::seed_from_u64(seed);
                let embedding = &embedding;
                for (rollout, complete, count, noise) in [
                    (shown, true, &mut report.demonstrator, false),
                    (shown, true, &mut report.demonstrator_noise, true),
                    (rollout, complete, &mut report.policy, false),
                    (rollout, complete, &mut report.policy_noise, true),
                ] {
                    let seen = reached(rollout, known.len() - 1, complete);
                    let seen = seen.map(|(heightmap, reached)| {
                        let mut heightmap = heightmap.clone();
                        if noise {
                            disturb(&mut heightmap, &mut rng);
                        }
                        (heightmap, reached)
                    });
                    count.add(seen, &known, embedding)?;
                }
                bar.inc(1);
            }
            seed += 2;
        }
        bar.finish_and_clear();
        if let Some(out) = &self.out {
            let text = serde_json::to_string_pretty(&report)?;
            std::fs::write(out, text + "\n").with_context(|| out.display().to_string())?;
        }
        if self.json {
            println!("{}", serde_json::to_string(&report)?);
            return Ok(());
        }
        println!(
            "{:28} {:>6} {:>8} {:>25} {:>25}",
            report.problem, "steps", "oracle", "image distance", "embedding"
        );
        for (name, count) in [
            ("demonstrator", &report.demonstrator),
            ("demonstrator, camera noise", &report.demonstrator_noise),
            ("policy", &report.policy),
            ("policy, camera noise", &report.policy_noise),
        ] {
            let rate = |right: usize| {
                let [low, high] = wilson_95(right, count.steps).map(|share| 100.0 * share);
                let percent = 100.0 * right as f64 / count.steps.max(1) as f64;
                format!("{percent:.1} % ({low:.1} to {high:.1})")
            };
            println!(
                "{name:28} {:>6} {:>8} {:>25} {:>25}",
                count.steps,
                "100 %",
                rate(count.image_distance),
                rate(count.embedding)
            );
        }
        Ok(())
    }
}

impl Count {
    /// Counts the steps of an episode: what is seen after each, and how many goals are reached then.
    fn add(
        &mut self,
        seen: impl Iterator<Item = (Heightmap, usize)>,
        known: &[&Heightmap],
        embedding: &Embedding,
    ) -> Result<()> {
        let embedded = known.iter().map(|image| embedding.embed(image));
        let embedded = embedded.collect::<Result<Vec<_>, _>>()?;
        let (mut before, mut throughout) = (0, [true; 2]);
        for (heightmap, reached) in seen {
            let by_image = heightmap.nearest(known.iter().copied());
            let by_embedding = Embedding::nearest(&embedding.embed(&heightmap)?, &embedded);
            let right = [by_image, by_embedding].map(|nearest| nearest == Some(reached));
            self.steps += 1;
            self.without_reward += usize::from(reached == before);
            self.image_distance += usize::from(right[0]);
            self.embedding += usize::from(right[1]);
            throughout = [0, 1].map(|index| throughout[index] && right[index]);
            before = reached;
        }
        self.episodes += 1;
        self.image_distance_throughout += usize::from(throughout[0]);
        self.embedding_throughout += usize::from(throughout[1]);
        Ok(())
    }
}

/// Noise of the cameras, on every cell by itself.
fn disturb(heightmap: &mut Heightmap, rng: &mut impl Rng) {
    let mut normal = || rng.sample::<f64, _>(StandardNormal);
    for byte in &mut heightmap.rgb {
        *byte = (f64::from(*byte) + COLOR_NOISE * normal()).clamp(0.0, 255.0) as u8;
    }
    for height_m in &mut heightmap.height_m {
        *height_m += (HEIGHT_NOISE_M * normal()) as f32;
    }
}
