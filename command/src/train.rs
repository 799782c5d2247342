//! `sctn train`.

use crate::compare;
use crate::evaluate::summary;
use crate::progress;
use crate::root::Root;
use anyhow::{Context, Result, bail};
use bags::Demonstration;
use clap::Args;
use gctn::{Device, GoalConditioning, ModelCard, Policy, Precision};
use indicatif::HumanDuration;
use learning::{
    Actor, DataSet, Demonstrations, Episodes, EventFile, ImageMemory, Recipe, Start, Training,
    evaluate, recorded_run,
};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Gradient steps between lines of progress where there is no terminal.
const LOG_EVERY: u64 = 10;

/// Gradient steps between scalars for TensorBoard.
const EVENT_EVERY: u64 = 10;

/// Arguments of `sctn train`.
#[derive(Args)]
pub struct Train {
    /// Recipe
    #[arg(long)]
    recipe: PathBuf,
    /// Folder that `sctn demos` wrote; or recorded runs, each the folder of `sctn launch --record` or a bag: their
    /// steps that the operator approved and confirmed, as many runs as are given in place of the recipe's number
    #[arg(long, required = true, num_args = 1..)]
    demos: Vec<PathBuf>,
    /// Folder for state, snapshots and the policy
    #[arg(long)]
    out: PathBuf,
    /// Problems in place of the recipe's
    #[arg(long, num_args = 1..)]
    problems: Vec<String>,
    /// Bags that are not learned from, as for `sctn compare`: how far each snapshot is from their steps is told
    #[arg(long, num_args = 1..)]
    held_out: Vec<PathBuf>,
    /// Gradient steps in place of the recipe's
    #[arg(long)]
    steps: Option<u64>,
    /// Checkpoint to begin with in place of the recipe's; its network is used
    #[arg(long)]
    start_from: Option<PathBuf>,
    /// Where to compute, validation too, in place of the recipe's: cpu, cuda or cuda:N
    #[arg(long)]
    device: Option<Device>,
    /// Stop after the gradient step during which so many seconds have passed since the command began: what is there then is
    /// validated and kept as at the end, and --resume goes on from it, to the same policy as without a stop
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    deadline: Option<Duration>,
    /// Go on with the training in that folder
    #[arg(long)]
    resume: bool,
    /// Print a JSON object last
    #[arg(long)]
    json: bool,
}

/// One snapshot and how it did on validation episodes.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Snapshot {
    pub step: u64,
    pub checkpoint: PathBuf,
    /// Mean losses since the snapshot before.
    pub pick_loss: f64,
    pub place_loss: f64,
    /// Completion rate of each problem on validation episodes.
    pub completion: BTreeMap<String, f64>,
    /// Mean reward of each problem.
    pub reward: BTreeMap<String, f64>,
    /// Taken only because the deadline had passed: a training that goes on forgets it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub at_deadline: bool,
}

/// A time of 0 s or more.
fn seconds(text: &str) -> Result<Duration, String> {
    let seconds = text.parse().ok();
    let duration = seconds.and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    duration.ok_or_else(|| "expected a number of seconds, 0 or more".to_owned())
}

impl Snapshot {
    /// Better on validation first, then later.
    fn rank(&self) -> (f64, f64, u64) {
        let mean = |values: &BTreeMap<String, f64>| {
            values.values().sum::<f64>() / values.len().max(1) as f64
        };
        (mean(&self.completion), mean(&self.reward), self.step)
    }
}

impl Train {
    pub fn run(self, root: &Root) -> Result<()> {
        // Where it is too far away for the clock, there is none.
        let deadline = self
            .deadline
            .and_then(|after| Instant::now().checked_add(after));
        let mut recipe = Recipe::load(&self.recipe)?;
        if !self.problems.is_empty() {
            recipe.problems.clone_from(&self.problems);
        }
        if let Some(device) = self.device {
            recipe.training.device = device;
        }
        // Before demonstrations are read.
        recipe.training.device.check()?;
        if let Some(steps) = self.steps {
            recipe.training.steps = steps;
            recipe.snapshots = recipe.snapshots.min(steps);
        }
        if let Some(checkpoint) = self.start_from {
            recipe.network = Policy::load(&checkpoint)
                .with_context(|| format!("--start-from {}", checkpoint.display()))?
                .config()
                .clone();
            recipe.start_from = Some(checkpoint);
        }
        let (average, steps) = (recipe.average as usize, recipe.training.steps);
        let shown = self.out.join("shown");
        let data = Data {
            demos: &self.demos,
            held_out: &self.held_out,
        };
        let out = &self.out;
        let snapshots = train(root, recipe, data, out, &shown, self.resume, deadline)?;
        let best = snapshots.iter().max_by(|a, b| {
            a.rank()
                .partial_cmp(&b.rank())
                .unwrap_or(std::cmp::Ordering::Equal)
        });
        let best = best.context("no snapshot was taken")?;
        let policy = self.out.join("policy.safetensors");
        if average > 1 {
            let last = snapshots.iter().rev().take(average).rev();
            let last: Vec<_> = last.map(|one| one.checkpoint.clone()).collect();
            gctn::average(&last, &policy)?;
        } else {
            std::fs::copy(&best.checkpoint, &policy)
                .with_context(|| policy.display().to_string())?;
        }
        let step = snapshots.last().map_or(0, |last| last.step);
        let stopped = if step < steps { "deadline" } else { "end" };
        if self.json {
            println!(
                "{}",
                serde_json::json!({
                    "policy": policy, "best": best, "snapshots": snapshots,
                    "stopped": stopped, "step": step, "steps": steps,
                })
            );
        } else {
            if step < steps {
                println!("stopped by the deadline after step {step} of {steps}");
            }
            let of = match average {
                1 => format!("the snapshot of step {}", best.step),
                count => format!("the mean of the last {count} snapshots"),
            };
            println!("{}: {of}", policy.display());
        }
        Ok(())
    }
}

/// The demonstrations of one folder that `sctn demos` wrote, or of recorded runs.
fn load(demos: &[PathBuf], recipe: &mut Recipe, out: &Path) -> Result<DataSet> {
    let memory = ImageMemory {
        decoded_mb: recipe.decoded_mb,
        compressed_mb: recipe.compressed_mb,
    };
    let mut data = DataSet::new(memory, out);
    let runs: Vec<PathBuf> = demos.iter().filter_map(|path| recorded_run(path)).collect();
    if runs.is_empty() {
        let [folder] = demos else {
            bail!("--demos: expected one folder of demonstrations, or recorded runs only");
        };
        let starts = recipe.network.conditioning == GoalConditioning::Sequence;
        for problem in &recipe.problems {
            let count = recipe.demonstrations.of(problem);
            let count = count.with_context(|| format!("demonstrations of {problem}: missing"))?;
            data.load(folder, problem, count, starts)?;
        }
        if recipe.generated > 0 {
            data.load_generated(folder, recipe.generated, starts)?;
        }
        return Ok(data);
    }
    if runs.len() < demos.len() {
        bail!("--demos: recorded runs and other folders cannot be mixed");
    }
    recipe.demonstrations = Demonstrations::Each(runs.len());
    for run in runs {
        data.load_bag(&run, &recipe.problems)?;
        if let Some((demonstration, left_out)) = Demonstration::read_run(&run)? {
            tracing::info!(
                "{}: {} steps, {} proposals left out",
                run.display(),
                demonstration.steps.len(),
                left_out.len()
            );
            for left_out in left_out {
                tracing::info!(
                    "  step {}, attempt {}: {}",
                    left_out.step,
                    left_out.attempt,
                    left_out.reason
                );
            }
        }
    }
    Ok(data)
}

/// What is learned from, and what is not.
#[derive(Clone, Copy)]
pub struct Data<'a> {
    /// A folder that `sctn demos` wrote, or recorded runs.
    pub demos: &'a [PathBuf],
    /// Bags with whose steps each snapshot is compared.
    pub held_out: &'a [PathBuf],
}

/// Trains by a recipe in a folder, or goes on with what the folder holds; gives all snapshots. The demonstrations that validation
/// shows are kept in the folder `shown`. Stops after the step during which a deadline passes, with a snapshot of it.
pub fn train(
    root: &Root,
    mut recipe: Recipe,
    data: Data<'_>,
    out: &Path,
    shown: &Path,
    resume: bool,
    deadline: Option<Instant>,
) -> Result<Vec<Snapshot>> {
    root.check_trainable(&recipe.problems)?;
    let Data { demos, held_out } = data;
    let data = load(demos, &mut recipe, out)?;
    let [memory, file] = data.image_bytes().map(|bytes| bytes as f64 / 1e6);
    tracing::info!(
        "{} demonstrations of {} scenes, {} steps, {memory:.0} MB of images in memory, {file:.0} MB in a file",
        data.len(),
        data.scene_count(),
        data.step_count(),
    );
    let asked = recipe.training.precision;
    let precision = asked.on(recipe.training.device);
    if precision != asked {
        tracing::warn!("this processor has no instructions for {asked}: training in {precision}");
    }
    let mut training = Training::open(recipe, data, out, resume)?;
    let log = out.join("snapshots.jsonl");
    let (mut snapshots, stopped) = resume_log(&log, training.step())?;
    let board = out.join("tensorboard");
    let written = || board.display().to_string();
    let mut events = EventFile::create(&board).with_context(written)?;
    let bar = progress::bar(training.recipe().training.steps, "steps");
    bar.set_position(training.step());
    let (mut pick, mut place, mut count) = (0.0, 0.0, 0u32);
    if let Some(stopped) = stopped {
        // Its means are of the first of the steps before the next snapshot.
        let before = snapshots.last().map_or(0, |snapshot| snapshot.step);
        count = (stopped.step - before) as u32;
        (pick, place) = (
            stopped.pick_loss * f64::from(count),
            stopped.place_loss * f64::from(count),
        );
    }
    while !training.is_done() {
        let learning_rate = training.learning_rate();
        let losses = training.advance()?;
        pick += losses.pick;
        place += losses.place;
        count += 1;
        bar.inc(1);
        bar.set_message(format!(
            "pick loss {:.3}, place loss {:.3}",
            pick / f64::from(count),
            place / f64::from(count)
        ));
        if training.step().is_multiple_of(EVENT_EVERY) {
            let scalars = [
                ("loss/pick", losses.pick),
                ("loss/place", losses.place),
                ("loss/done", losses.done),
                ("gradient_norm", losses.gradient_norm),
                ("learning_rate", learning_rate),
            ];
            events
                .scalars(training.step(), &scalars)
                .with_context(written)?;
        }
        // Where there is no terminal to draw a bar on, a line now and then.
        if bar.is_hidden() && training.step().is_multiple_of(LOG_EVERY) {
            let done = match losses.done > 0.0 {
                true => format!(", done loss {:.3}", losses.done),
                false => String::new(),
            };
            tracing::info!(
                "step {}: {}{done}, {} left",
                training.step(),
                bar.message(),
                HumanDuration(bar.eta())
            );
        }
        let is_due = training.is_snapshot_due();
        let is_late = deadline.is_some_and(|deadline| deadline <= Instant::now());
        if is_due || is_late {
            let checkpoint = training.save_snapshot(&card(&training))?;
            let mut snapshot = Snapshot {
                step: training.step(),
                checkpoint,
                pick_loss: rounded(pick / f64::from(count)),
                place_loss: rounded(place / f64::from(count)),
                completion: BTreeMap::new(),
                reward: BTreeMap::new(),
                at_deadline: !is_due,
            };
            (pick, place, count) = (0.0, 0.0, 0);
            bar.suspend(|| validate(root, training.recipe(), shown, &mut snapshot))?;
            if !held_out.is_empty() {
                gctn::set_threads(1);
                let policy = decider(&snapshot.checkpoint, training.recipe())?;
                let (distance, steps) = compare::held_out(policy, held_out)?;
                tracing::info!(
                    "step {}: held out: {distance} from {steps} steps (median)",
                    snapshot.step
                );
                gctn::set_threads(training.recipe().training.threads);
            }
            for (problem, completion) in &snapshot.completion {
                let tag = format!("validation/{problem}");
                let scalars = [(tag.as_str(), *completion)];
                events
                    .scalars(snapshot.step, &scalars)
                    .with_context(written)?;
            }
            append(&log, &snapshot)?;
            snapshots.push(snapshot);
            // Last: a training that is killed before this goes on from the snapshot before, and validates this one again.
            training.save_state()?;
        }
        if is_late {
            break;
        }
    }
    bar.finish_and_clear();
    Ok(snapshots)
}

/// Says how the checkpoint was made.
fn card(training: &Training) -> ModelCard {
    let recipe = training.recipe();
    ModelCard::from([
        (
            "recipe".into(),
            serde_json::to_string(recipe).unwrap_or_default(),
        ),
        ("step".into(), training.step().to_string()),
        (
            "trained with".into(),
            format!("sctn {}", env!("CARGO_PKG_VERSION")),
        ),
    ])
}

/// A snapshot that decides where it was trained, in 32-bit floats.
pub fn decider(checkpoint: &Path, recipe: &Recipe) -> Result<Policy> {
    let device = recipe.training.device;
    Ok(Policy::load_for(checkpoint, device, Precision::F32)?)
}

/// Lets a snapshot act on the validation episodes of every problem.
fn validate(root: &Root, recipe: &Recipe, shown: &Path, snapshot: &mut Snapshot) -> Result<()> {
    if recipe.validation.episodes == 0 {
        return Ok(());
    }
    let work_cell = root.work_cell()?;
    // One episode on one thread: `training.threads` of libtorch for each of as many episodes would be their square.
    gctn::set_threads(1);
    let mut actors: Vec<_> = (0..recipe.training.threads)
        .map(|_| Ok(Actor::from(decider(&snapshot.checkpoint, recipe)?)))
        .collect::<Result<_>>()?;
    let start = match recipe.network.conditioning {
        GoalConditioning::Sequence => Start::Other,
        GoalConditioning::NextStep | GoalConditioning::Final | GoalConditioning::Both => {
            Start::Same
        }
    };
    let plan = Episodes {
        first_seed: recipe.validation.seed,
        count: recipe.validation.episodes,
        start,
    };
    for name in &recipe.problems {
        let problem = root.problem(name)?;
        let report = evaluate(
            &problem,
            &work_cell,
            &mut actors,
            &plan,
            None,
            Some(shown),
            |_, _| (),
        )?;
        tracing::info!("step {}: {}", snapshot.step, summary(&report));
        snapshot.completion.insert(name.clone(), report.completion);
        snapshot.reward.insert(name.clone(), rounded(report.reward));
    }
    gctn::set_threads(recipe.training.threads);
    Ok(())
}

/// To 1e-6: numbers of few digits are read back from JSON bit for bit.
fn rounded(value: f64) -> f64 {
    (1e6 * value).round() / 1e6
}

/// The snapshots of a training that goes on after `step`, and the one that a deadline left there. Later ones are taken again: they are
/// removed from the log, as are those of deadlines and a line that was not written to its end.
fn resume_log(path: &Path, step: u64) -> Result<(Vec<Snapshot>, Option<Snapshot>)> {
    let what = || path.display().to_string();
    if !path.exists() {
        return Ok((Vec::new(), None));
    }
    let text = std::fs::read_to_string(path).with_context(what)?;
    let whole = text.rsplit_once('\n').map_or("", |(whole, _)| whole);
    let snapshots = whole.lines().map(serde_json::from_str::<Snapshot>);
    let mut snapshots: Vec<_> = snapshots.collect::<Result<_, _>>().with_context(what)?;
    let stopped = snapshots
        .iter()
        .find(|snapshot| snapshot.at_deadline && snapshot.step == step)
        .cloned();
    snapshots.retain(|snapshot| snapshot.step <= step && !snapshot.at_deadline);
    std::fs::remove_file(path).with_context(what)?;
    for snapshot in &snapshots {
        append(path, snapshot)?;
    }
    Ok((snapshots, stopped))
}

fn append(path: &Path, snapshot: &Snapshot) -> Result<()> {
    let open = std::fs::OpenOptions::new()
        .create(true)
        .append(true)
        .open(path);
    let mut file = open.with_context(|| path.display().to_string())?;
    let line = serde_json::to_string(snapshot)? + "\n";
    file.write_all(line.as_bytes())
        .with_context(|| path.display().to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_resumed_log_has_the_snapshots_before_the_state_alone() {
        let folder = tempfile::tempdir().unwrap();
        let log = folder.path().join("snapshots.jsonl");
        for step in [2, 4, 5] {
            let snapshot = Snapshot {
                step,
                checkpoint: PathBuf::new(),
                pick_loss: 0.1,
                place_loss: 0.2,
                completion: BTreeMap::new(),
                reward: BTreeMap::new(),
                at_deadline: step == 5,
            };
            append(&log, &snapshot).unwrap();
        }
        let whole = std::fs::read_to_string(&log).unwrap();
        // Stopped by a deadline at step 5. Killed after the line of step 4 or 5, before its state; and in the middle of a line.
        std::fs::write(&log, whole.clone() + "{\"step\": 6, \"che").unwrap();
        let steps = |(snapshots, stopped): (Vec<Snapshot>, Option<Snapshot>)| {
            let steps = snapshots.iter().map(|snapshot| snapshot.step);
            (steps.collect::<Vec<_>>(), stopped.map(|one| one.step))
        };
        let copy = folder.path().join("copy.jsonl");
        std::fs::copy(&log, &copy).unwrap();
        assert_eq!(steps(resume_log(&copy, 5).unwrap()), (vec![2, 4], Some(5)));
        assert_eq!(steps(resume_log(&copy, 5).unwrap()), (vec![2, 4], None));
        assert_eq!(steps(resume_log(&log, 2).unwrap()), (vec![2], None));
        let left = std::fs::read_to_string(&log).unwrap();
        assert_eq!(left.lines().next(), whole.lines().next());
        assert_eq!(left.lines().count(), 1);
        assert_eq!(steps(resume_log(&log, 0).unwrap()), (vec![], None));
        assert!(!log.exists());
    }
}
