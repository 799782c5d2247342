//! Training as a child process: `sctn train`, then `sctn compare` with the policy of now.

use std::path::PathBuf;
use std::process::Stdio;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde::{Deserialize, Serialize};
use serde_json::Value;
use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, BufReader};
use tokio::process::{Child, Command};
use tokio_util::sync::CancellationToken;
use tracing::{info, warn};

use crate::refusal::Refusal;

/// Most bytes of a report that are read.
const LARGEST_REPORT: u64 = 1 << 20;
/// Last words of a child that are shown when it fails.
const WORDS: usize = 3;

/// How far a training is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum TrainingPhase {
    /// `sctn train` is at work.
    Training,
    /// `sctn compare` is at work.
    Comparing,
    /// The policy can be used.
    Done,
    /// It was cancelled.
    Cancelled,
    /// It failed.
    Failed,
}

/// A training, as JSON for the page.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TrainingState {
    name: String,
    phase: TrainingPhase,
    /// Gradient steps done, and asked for.
    step: u64,
    steps: u64,
    /// Mean losses since the last snapshot, and the time left, in the words of `sctn train`; empty before the first.
    losses: String,
    left: String,
    /// Why it failed; empty where it did not.
    reason: String,
    /// Median distances of the new policy and of that of now from the held-out steps; nothing before they are measured.
    comparison: Option<Comparison>,
}

/// Medians over held-out steps.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// Number of held-out steps.
    steps: usize,
    new: Distance,
    now: Distance,
}

/// How far a policy is from what was shown.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct Distance {
    pick_m: f64,
    place_m: f64,
    turn_rad: f64,
}

/// What is to be trained.
#[derive(Clone, Debug)]
pub struct Order {
    /// Name of the new checkpoint.
    pub name: String,
    /// Bags to learn from.
    pub learn: Vec<PathBuf>,
    /// Bags that are held out.
    pub held_out: Vec<PathBuf>,
    /// Names of the problems of `learn`.
    pub problems: Vec<String>,
    /// Gradient steps.
    pub steps: u64,
}

/// The one training.
#[derive(Debug)]
pub struct Trainings {
    /// The command `sctn`.
    program: PathBuf,
    recipe: PathBuf,
    /// Folder for states, snapshots and checkpoints.
    folder: PathBuf,
    /// The policy's checkpoint of now.
    start_from: Mutex<PathBuf>,
    state: Mutex<Option<(TrainingState, CancellationToken)>>,
}

impl Trainings {
    /// Nothing is being trained.
    pub fn new(program: PathBuf, recipe: PathBuf, folder: PathBuf, start_from: PathBuf) -> Self {
        Self {
            program,
            recipe,
            folder,
            start_from: Mutex::new(start_from),
            state: Mutex::new(None),
        }
    }

    /// The policy has been given another checkpoint.
    pub fn begin_with(&self, checkpoint: &str) {
        *self
            .start_from
            .lock()
            .unwrap_or_else(PoisonError::into_inner) = checkpoint.into();
    }

    fn lock(&self) -> MutexGuard<'_, Option<(TrainingState, CancellationToken)>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The last training.
    pub fn state(&self) -> Option<TrainingState> {
        self.lock().as_ref().map(|(state, _)| state.clone())
    }

    fn change(&self, change: impl FnOnce(&mut TrainingState)) {
        if let Some((state, _)) = &mut *self.lock() {
            change(state);
        }
    }

    /// Starts a training; it ends with the node at the latest.
    ///
    /// # Errors
    /// When one is at work.
    pub fn start(self: &Arc<Self>, order: Order) -> Result<(), Refusal> {
        let cancel = CancellationToken::new();
        {
            let mut state = self.lock();
            let at_work =
                |phase| matches!(phase, TrainingPhase::Training | TrainingPhase::Comparing);
            if let Some((running, _)) = &*state
                && at_work(running.phase)
            {
                return Err(Refusal::new(
                    format!("{} is being trained.", running.name),
                    "Wait until it is done, or cancel it.",
                ));
            }
            let new = TrainingState {
                name: order.name.clone(),
                phase: TrainingPhase::Training,
                step: 0,
                steps: order.steps,
                losses: String::new(),
                left: String::new(),
                reason: String::new(),
                comparison: None,
            };
            *state = Some((new, cancel.clone()));
        }
        let trainings = Arc::clone(self);
        tokio::spawn(async move {
            let ended = cancel.run_until_cancelled(trainings.work(&order)).await;
            trainings.change(|state| match ended {
                None => state.phase = TrainingPhase::Cancelled,
                Some(Ok(())) => state.phase = TrainingPhase::Done,
                Some(Err(error)) => {
                    warn!("training {}: {error:#}", order.name);
                    state.phase = TrainingPhase::Failed;
                    state.reason = format!("{error:#}");
                }
            });
        });
        Ok(())
    }

    /// Ends the training at work.
    pub fn cancel(&self) {
        if let Some((_, cancel)) = &*self.lock() {
            cancel.cancel();
        }
    }

    async fn work(&self, order: &Order) -> anyhow::Result<()> {
        let out = self.folder.join(&order.name);
        if out.exists() {
            std::fs::remove_dir_all(&out)?;
        }
        info!("training {} on {} bags", order.name, order.learn.len());
        let steps = order.steps.to_string();
        let start_from = self
            .start_from
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone();
        let mut train = self.command("train");
        train
            .arg("--recipe")
            .arg(&self.recipe)
            .arg("--out")
            .arg(&out);
        train
            .args(["--steps", &steps])
            .arg("--start-from")
            .arg(&start_from);
        train
            .arg("--problems")
            .args(&order.problems)
            .arg("--demos")
            .args(&order.learn);
        self.run(train, |line| {
            if let Some((step, losses, left)) = progress(line) {
                self.change(|state| {
                    state.step = step;
                    state.losses = losses.to_owned();
                    state.left = left.to_owned();
                });
            }
        })
        .await?;
        let policy = out.join("policy.safetensors");
        self.change(|state| {
            state.step = state.steps;
            state.phase = TrainingPhase::Comparing;
        });
        let mut compare = self.command("compare");
        compare
            .arg("--json")
            .arg("--checkpoints")
            .arg(&policy)
            .arg(&start_from);
        compare.arg("--demos").args(&order.held_out);
        let report = self.run(compare, |_| ()).await?;
        let comparison = comparison(&report)?;
        let checkpoint = self.folder.join(&order.name).with_extension("safetensors");
        std::fs::copy(&policy, &checkpoint)?;
        self.change(|state| state.comparison = Some(comparison));
        Ok(())
    }

    fn command(&self, word: &str) -> Command {
        let mut command = Command::new(&self.program);
        command.arg(word);
        command
    }

    /// Runs a child to its end, and gives what it wrote to standard output. It ends where this future is dropped.
    async fn run(
        &self,
        mut command: Command,
        mut on_line: impl FnMut(&str),
    ) -> anyhow::Result<String> {
        use anyhow::{Context as _, bail};
        command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .kill_on_drop(true);
        let shown = self.program.display();
        let mut child: Child = command
            .spawn()
            .with_context(|| format!("parameter sctn: {shown}"))?;
        let (Some(output), Some(errors)) = (child.stdout.take(), child.stderr.take()) else {
            bail!("{shown}: no output");
        };
        let mut lines = BufReader::new(errors).lines();
        let mut words = Vec::new();
        let mut report = String::new();
        let reading = async {
            let mut output = output.take(LARGEST_REPORT);
            output.read_to_string(&mut report).await
        };
        let watching = async {
            while let Some(line) = lines.next_line().await? {
                on_line(&line);
                if words.len() == WORDS {
                    words.remove(0);
                }
                words.push(line);
            }
            Ok::<_, std::io::Error>(())
        };
        let (read, watched) = tokio::join!(reading, watching);
        read?;
        watched?;
        let status = child.wait().await?;
        if !status.success() {
            bail!("{shown}: {status}: {}", words.join(" "));
        }
        Ok(report)
    }
}

/// Gradient steps, losses and time left of a line of `sctn train`.
fn progress(line: &str) -> Option<(u64, &str, &str)> {
    let (_, rest) = line.split_once("step ")?;
    let (step, rest) = rest.split_once(": ")?;
    let (losses, left) = rest.rsplit_once(", ")?;
    Some((step.parse().ok()?, losses, left.strip_suffix(" left")?))
}

/// The comparison that `sctn compare --json` prints last: of the new policy, and of the one of now.
fn comparison(report: &str) -> anyhow::Result<Comparison> {
    use anyhow::Context as _;
    let line = report
        .lines()
        .last()
        .context("sctn compare has said nothing")?;
    let report: Value = serde_json::from_str(line).context("the report of sctn compare")?;
    let distance = |index: usize| -> anyhow::Result<Distance> {
        let value = report["median"][index].clone();
        serde_json::from_value(value)
            .with_context(|| format!("the report of sctn compare: median[{index}]"))
    };
    Ok(Comparison {
        steps: report["steps"].as_array().map_or(0, Vec::len),
        new: distance(0)?,
        now: distance(1)?,
    })
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Something in every field.
    pub(crate) fn state() -> TrainingState {
        let distance = Distance {
            pick_m: 0.01,
            place_m: 0.02,
            turn_rad: 0.3,
        };
        TrainingState {
            name: "taught".into(),
            phase: TrainingPhase::Done,
            step: 20,
            steps: 20,
            losses: "pick loss 0.1".into(),
            left: "1 second".into(),
            reason: String::new(),
            comparison: Some(Comparison {
                steps: 2,
                new: distance,
                now: distance,
            }),
        }
    }

    use std::os::unix::fs::PermissionsExt as _;
    use std::path::Path;
    use std::time::Duration;

    const TRAIN: &str = r#"#!/bin/sh
if [ "$1" = train ]; then
  echo "INFO step 10: pick loss 1.250, place loss 0.500, 3 seconds left" >&2
  while [ "$1" != --out ]; do shift; done
  mkdir -p "$2"; echo weights > "$2/policy.safetensors"
  [ "$FAIL" = 1 ] && { echo "no memory" >&2; exit 1; }
  [ -e "$2/../wait" ] && sleep 60
  exit 0
fi
echo '{"median": [{"pick_m": 0.01, "place_m": 0.02, "turn_rad": 0.1}, {"pick_m": 0.03, "place_m": 0.04, "turn_rad": 0.2}], "steps": [{}, {}]}'
"#;

    fn made(folder: &Path, script: &str) -> (Arc<Trainings>, Order) {
        let program = folder.join("sctn");
        std::fs::write(&program, script).unwrap();
        std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
        let order = Order {
            name: "taught".into(),
            learn: vec!["a".into()],
            held_out: vec!["b".into()],
            problems: vec!["a".into()],
            steps: 20,
        };
        let training = folder.join("training");
        let trainings = Trainings::new(program, "recipe.yaml".into(), training, "old".into());
        (Arc::new(trainings), order)
    }

    async fn end(trainings: &Trainings) -> TrainingState {
        loop {
            let state = trainings.state().unwrap();
            if !matches!(
                state.phase,
                TrainingPhase::Training | TrainingPhase::Comparing
            ) {
                return state;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    }

    #[tokio::test]
    async fn a_training_shows_its_progress_is_compared_fails_with_words_and_is_cancelled() {
        let folder = tempfile::tempdir().unwrap();
        let (trainings, order) = made(folder.path(), TRAIN);
        trainings.start(order).unwrap();
        let state = end(&trainings).await;
        assert_eq!(
            (state.phase, state.reason.as_str()),
            (TrainingPhase::Done, "")
        );
        assert_eq!(
            (state.losses.as_str(), state.left.as_str()),
            ("pick loss 1.250, place loss 0.500", "3 seconds")
        );
        let comparison = state.comparison.unwrap();
        assert_eq!(
            (
                comparison.steps,
                comparison.new.pick_m,
                comparison.now.pick_m
            ),
            (2, 0.01, 0.03)
        );
        assert!(folder.path().join("training/taught.safetensors").is_file());

        let (failing, order) = made(folder.path(), &TRAIN.replace("\"$FAIL\"", "1"));
        failing.start(order).unwrap();
        let state = end(&failing).await;
        assert_eq!(state.phase, TrainingPhase::Failed);
        assert!(state.reason.contains("no memory"), "{}", state.reason);

        std::fs::remove_file(folder.path().join("training/taught.safetensors")).unwrap();
        let (waiting, order) = made(folder.path(), TRAIN);
        std::fs::write(folder.path().join("training/wait"), "").unwrap();
        waiting.start(order.clone()).unwrap();
        let refusal = waiting.start(order.clone()).unwrap_err();
        assert!(refusal.reason.contains("taught"), "{refusal:?}");
        waiting.cancel();
        assert_eq!(end(&waiting).await.phase, TrainingPhase::Cancelled);
        assert!(!folder.path().join("training/taught.safetensors").exists());
    }
}
