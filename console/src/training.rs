//! Training as a child process: `sctn train`, then `sctn compare` with the policy of now.

use std::path::PathBuf;
use std::process::{ExitStatus, Stdio};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde::{Deserialize, Serialize};
use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, BufReader};
use tokio::process::{Child, Command};
use tokio_util::sync::CancellationToken;
use tracing::{info, warn};

use crate::refusal::Refusal;
use crate::run::Pose;

/// Most bytes of a report that are read.
const LARGEST_REPORT: u64 = 1 << 20;
/// Last words of a child that are shown when it fails.
const WORDS: usize = 3;
/// Most held-out steps that are shown as pictures.
const EXAMPLES: usize = 24;

/// Why a training has failed.
#[derive(Debug, thiserror::Error)]
enum TrainingError {
    #[error("parameter sctn: {}: {source}, expected the program sctn", program.display())]
    NoProgram {
        program: PathBuf,
        source: std::io::Error,
    },
    #[error("{}: no output", program.display())]
    NoOutput { program: PathBuf },
    /// With its last words.
    #[error("{}: {status}: {words}", program.display())]
    Failed {
        program: PathBuf,
        status: ExitStatus,
        words: String,
    },
    #[error("sctn compare printed no report")]
    NoReport,
    #[error("the report of sctn compare: {0}")]
    Report(#[from] serde_json::Error),
    #[error("the training's files: {0}")]
    Files(#[from] std::io::Error),
}

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
    /// Median distances of the snapshots so far from the held-out steps.
    validation: Vec<Validation>,
    /// Why it failed; empty where it did not.
    reason: String,
    /// Median distances of the new policy and of that of now from the held-out steps; nothing before they are measured.
    comparison: Option<Comparison>,
}

/// A snapshot that was compared with the held-out steps.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Validation {
    /// Gradient steps before it.
    step: u64,
    #[serde(flatten)]
    distance: Distance,
}

/// Pick and place of a step, in the world frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct Action {
    pick: Pose,
    place: Pose,
}

/// A held-out step: as it was shown, and as the two policies propose it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Example {
    /// Name of the demonstration.
    demonstration: String,
    /// Number of the step, from 1.
    step: usize,
    shown: Action,
    new: Action,
    now: Action,
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
    /// The held-out steps of the last comparison.
    examples: Mutex<Vec<Example>>,
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
            examples: Mutex::default(),
        }
    }

    /// The held-out steps of the last comparison, at most 24.
    pub fn examples(&self) -> Vec<Example> {
        let examples = self.examples.lock();
        examples.unwrap_or_else(PoisonError::into_inner).clone()
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
                validation: Vec::new(),
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
                    warn!("training {}: {error}", order.name);
                    state.phase = TrainingPhase::Failed;
                    state.reason = error.to_string();
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

    async fn work(&self, order: &Order) -> Result<(), TrainingError> {
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
            .args(&order.learn)
            .arg("--held-out")
            .args(&order.held_out);
        self.run(train, |line| {
            if let Some(validation) = validation(line) {
                self.change(|state| state.validation.push(validation));
            }
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
        let (comparison, examples) = comparison(&report)?;
        *self.examples.lock().unwrap_or_else(PoisonError::into_inner) = examples;
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
    ) -> Result<String, TrainingError> {
        command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .kill_on_drop(true);
        let program = || self.program.clone();
        let mut child: Child = command.spawn().map_err(|source| TrainingError::NoProgram {
            program: program(),
            source,
        })?;
        let (Some(output), Some(errors)) = (child.stdout.take(), child.stderr.take()) else {
            return Err(TrainingError::NoOutput { program: program() });
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
            return Err(TrainingError::Failed {
                program: program(),
                status,
                words: words.join(" "),
            });
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

/// The snapshot that a line of `sctn train` compares with the held-out steps.
fn validation(line: &str) -> Option<Validation> {
    let (_, rest) = line.split_once("step ")?;
    let (step, rest) = rest.split_once(": held out: pick ")?;
    let (pick_mm, rest) = rest.split_once(" mm, place ")?;
    let (place_mm, rest) = rest.split_once(" mm, turn ")?;
    let (turn_deg, _) = rest.split_once(" degrees")?;
    let number = |text: &str| text.parse::<f64>().ok();
    Some(Validation {
        step: step.parse().ok()?,
        distance: Distance {
            pick_m: 1e-3 * number(pick_mm)?,
            place_m: 1e-3 * number(place_mm)?,
            turn_rad: number(turn_deg)?.to_radians(),
        },
    })
}

/// What `sctn compare --json` prints last.
#[derive(Deserialize)]
struct Report {
    /// Of the new policy, and of the one of now.
    median: [Distance; 2],
    steps: Vec<ReportedStep>,
}

#[derive(Deserialize)]
struct ReportedStep {
    demonstration: PathBuf,
    step: usize,
    shown: Action,
    proposed: [Action; 2],
}

/// The comparison that `sctn compare --json` prints last, and the first of its steps.
fn comparison(report: &str) -> Result<(Comparison, Vec<Example>), TrainingError> {
    let line = report.lines().last().ok_or(TrainingError::NoReport)?;
    let report: Report = serde_json::from_str(line)?;
    let [new, now] = report.median;
    let comparison = Comparison {
        steps: report.steps.len(),
        new,
        now,
    };
    let examples = report.steps.into_iter().take(EXAMPLES).map(|step| {
        let name = step.demonstration.file_name().unwrap_or_default();
        let [new, now] = step.proposed;
        Example {
            demonstration: name.to_string_lossy().into_owned(),
            step: step.step,
            shown: step.shown,
            new,
            now,
        }
    });
    Ok((comparison, examples.collect()))
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
            validation: vec![Validation { step: 20, distance }],
            reason: String::new(),
            comparison: Some(Comparison {
                steps: 2,
                new: distance,
                now: distance,
            }),
        }
    }

    /// A held-out step of a comparison.
    pub(crate) fn give_example(trainings: &Trainings) {
        let pose = Pose {
            x_m: 0.5,
            y_m: 0.1,
            yaw_rad: 0.2,
        };
        let action = Action {
            pick: pose,
            place: pose,
        };
        let example = Example {
            demonstration: "blocks".into(),
            step: 1,
            shown: action,
            new: action,
            now: action,
        };
        *trainings.examples.lock().unwrap() = vec![example];
    }

    use std::os::unix::fs::PermissionsExt as _;
    use std::path::Path;
    use std::time::Duration;

    const TRAIN: &str = r#"#!/bin/sh
if [ "$1" = train ]; then
  echo "INFO step 10: pick loss 1.250, place loss 0.500, 3 seconds left" >&2
  echo "INFO step 20: held out: pick 12.5 mm, place 40.0 mm, turn 0.0 degrees from 2 steps (median)" >&2
  while [ "$1" != --out ]; do shift; done
  mkdir -p "$2"; echo weights > "$2/policy.safetensors"
  [ "$FAIL" = 1 ] && { echo "no memory" >&2; exit 1; }
  [ -e "$2/../wait" ] && sleep 60
  exit 0
fi
echo '{"median": [{"pick_m": 0.01, "place_m": 0.02, "turn_rad": 0.1}, {"pick_m": 0.03, "place_m": 0.04, "turn_rad": 0.2}], "steps": [{"demonstration": "library/b", "step": 1, "shown": @, "proposed": [@, @], "distances": []}]}' | \
  sed 's/@/{"pick": {"x_m": 0.5, "y_m": 0, "yaw_rad": 0}, "place": {"x_m": 0.6, "y_m": 0, "yaw_rad": 0}}/g'
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
            (1, 0.01, 0.03)
        );
        let [validation] = &state.validation[..] else {
            panic!("{:?}", state.validation);
        };
        assert_eq!((validation.step, validation.distance.pick_m), (20, 0.0125));
        let [example] = &trainings.examples()[..] else {
            panic!("{:?}", trainings.examples());
        };
        assert_eq!((example.demonstration.as_str(), example.step), ("b", 1));
        assert_eq!(example.now.place.x_m, 0.6);
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
