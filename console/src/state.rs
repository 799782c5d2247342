//! What HTTP handlers and the node share: the run, the people, and what is to be said to the graph.

mod answers;
mod home;
mod learn;
mod teach;

use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use bags::Demonstration;
use serde::Serialize;
use step_protocol::{
    Confirmation, Observation, OperatorDecision, Proposal, ProposalId, Recovery, RunPhase,
    StepOutcome, StepResult,
};
use tokio::sync::{mpsc, watch};

pub use self::answers::Answer;
use self::home::Home;
use self::learn::Repetition;
use self::teach::Planning;
use crate::history::RunEvent;
use crate::lesson::{Lesson, LessonState};
use crate::preview::Motion;
use crate::refusal::Refusal;
use crate::run::{Decision, InvalidMessage, MotionState, Pose, Run, Snapshot};
use crate::session::{Sessions, ViewerId, ViewerState};
use crate::training::TrainingState;

/// Who decides where the console itself says something that no person has said.
const BY_ITSELF: &str = "operator_console";

/// What the node is to do.
#[derive(Clone, Debug, PartialEq)]
pub enum Command {
    /// Publish this confirmation; the node stamps it.
    Confirm(Confirmation),
    /// Publish at once whether the operator is present, before anything that they decide.
    Presence,
    /// Publish this proposal of the operator's.
    Propose(Box<Proposal>),
    /// Have the executor propose the way home, or to put down what is held before; for whom.
    Recover(Recovery, String),
    /// Have the oracle latch this step again; for whom.
    SetStep(u32, String),
    /// Have the oracle load the demonstration of this name in the library, at this path; for whom.
    Load(String, PathBuf, String),
    /// Have the policy load the checkpoint at this path; for whom.
    LoadCheckpoint(PathBuf, String),
    /// Write down how a run of a demonstration of the library goes.
    Record(RunEvent),
    /// Keep a correction under this name.
    Keep(Box<(String, Demonstration)>),
}

/// The state behind one lock.
pub struct State {
    /// The run as it was heard.
    pub run: Run,
    /// The people.
    pub sessions: Sessions,
    /// The lesson that is being given.
    lesson: Option<Lesson>,
    /// The motion of the lesson that the executor has not planned yet.
    planning: Option<Planning>,
    /// The way home, or the putting down, that the executor has proposed.
    home: Option<Home>,
    /// The demonstration of the library that is repeated.
    repetition: Option<Repetition>,
    /// Counts the changes of what is on disk.
    library_version: u64,
    /// The policy's checkpoint, once it was changed.
    pub policy: Option<PolicyState>,
    commands: Option<mpsc::UnboundedSender<Command>>,
}

/// Which checkpoint the policy uses, and which it used before.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PolicyState {
    /// Path on the policy's machine.
    pub checkpoint: String,
    /// The one before: to go back.
    pub previous: String,
}

/// Shared by the server and the node.
pub struct Console {
    state: Mutex<State>,
    version: watch::Sender<u64>,
    origin: Instant,
}

/// A snapshot with the people.
#[derive(Serialize)]
struct Message<'a> {
    #[serde(rename = "type")]
    kind: &'static str,
    time_s: f64,
    operator: Option<ViewerId>,
    viewers: Vec<ViewerState>,
    lesson: Option<LessonState>,
    policy: Option<PolicyState>,
    training: Option<TrainingState>,
    library: u64,
    home: Option<Home>,
    motion: Option<MotionState<'a>>,
    #[serde(flatten)]
    run: Snapshot<'a>,
}

impl Console {
    /// Nobody is there, nothing was heard.
    pub fn new(run: Run, sessions: Sessions) -> Self {
        Self {
            state: Mutex::new(State {
                run,
                sessions,
                lesson: None,
                planning: None,
                home: None,
                repetition: None,
                library_version: 0,
                policy: None,
                commands: None,
            }),
            version: watch::Sender::new(0),
            origin: Instant::now(),
        }
    }

    /// Time since the console was made.
    pub fn now(&self) -> Duration {
        self.origin.elapsed()
    }

    /// Commands go here from now on; what is decided while nobody takes them is refused.
    pub fn connect(&self) -> mpsc::UnboundedReceiver<Command> {
        let (sender, receiver) = mpsc::unbounded_channel();
        self.lock().commands = Some(sender);
        receiver
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Looks at the state.
    pub fn read<T>(&self, look: impl FnOnce(&State, Duration) -> T) -> T {
        let now = self.now();
        look(&self.lock(), now)
    }

    /// Changes the state without telling the viewers.
    pub fn change_quietly<T>(&self, change: impl FnOnce(&mut State, Duration) -> T) -> T {
        let now = self.now();
        change(&mut self.lock(), now)
    }

    /// Changes the state; viewers are told.
    pub fn change<T>(&self, change: impl FnOnce(&mut State, Duration) -> T) -> T {
        let result = self.change_quietly(change);
        self.version.send_modify(|version| *version += 1);
        result
    }

    /// Takes in what was heard; viewers are told where it returns true.
    pub fn hear(&self, change: impl FnOnce(&mut State, Duration) -> bool) {
        if self.change_quietly(change) {
            self.version.send_modify(|version| *version += 1);
        }
    }

    /// Counts the changes.
    pub fn version(&self) -> watch::Receiver<u64> {
        self.version.subscribe()
    }

    /// The state as JSON, with the training's.
    ///
    /// # Errors
    /// When it cannot be written as JSON.
    pub fn snapshot(&self, training: Option<TrainingState>) -> serde_json::Result<String> {
        self.read(|state, now| {
            serde_json::to_string(&Message {
                kind: "state",
                time_s: now.as_secs_f64(),
                operator: state.sessions.operator(),
                viewers: state.sessions.states(now),
                lesson: state.lesson.as_ref().map(Lesson::state),
                policy: state.policy.clone(),
                training,
                library: state.library_version,
                home: state.home,
                motion: state.pending_motion().map(MotionState::from),
                run: state.run.snapshot(now),
            })
        })
    }
}

impl State {
    /// A viewer decides on the proposal of this id. Who decides has to be the operator; a stop is taken from everybody and
    /// whatever proposal it names.
    ///
    /// # Errors
    /// Says why nothing was decided.
    pub fn decide(
        &mut self,
        viewer: ViewerId,
        proposal_id: ProposalId,
        decision: Decision,
        now: Duration,
    ) -> Result<(), Refusal> {
        if let Some(home) = self.home
            && home.proposal_id == proposal_id
            && !home.approved
            && decision != Decision::Stop
        {
            return self.decide_home(viewer, home, decision, now);
        }
        if decision != Decision::Stop {
            self.sessions.check_operator(viewer)?;
            self.check_no_lesson()?;
        }
        let current = self.run.current_id();
        let not_present = || {
            Refusal::new(
                format!("Proposal {proposal_id} is not the present one."),
                "The view has changed since. Look at the present proposal.",
            )
        };
        if decision != Decision::Stop && current.is_some_and(|current| current != proposal_id) {
            return Err(not_present());
        }
        if self.lesson.is_none() || decision != Decision::Stop {
            self.run.check(decision, now)?;
        }
        if decision == Decision::Stop {
            self.drop_planning();
        } else {
            current.ok_or_else(not_present)?;
        }
        let name = self.sessions.name(viewer).to_owned();
        self.confirm(proposal_id, decision.into(), name, now)
    }

    fn confirm(
        &mut self,
        proposal_id: ProposalId,
        decision: OperatorDecision,
        operator_name: String,
        now: Duration,
    ) -> Result<(), Refusal> {
        let confirmation = Confirmation {
            stamp: Duration::ZERO,
            proposal_id,
            decision,
            operator_name,
        };
        self.send(Command::Confirm(confirmation.clone()))?;
        self.run.decide(&confirmation, now);
        self.after_decision(&confirmation);
        Ok(())
    }

    fn after_decision(&mut self, confirmation: &Confirmation) {
        // The executor withdraws the way home at a stop and at any other motion.
        self.home.take_if(|home| match confirmation.decision {
            OperatorDecision::Stop => true,
            OperatorDecision::Approve => home.proposal_id != confirmation.proposal_id,
            _ => false,
        });
        self.keep_corrections();
    }

    /// The planned motion of what waits for an approval: of the way home, of the step of a lesson, or of the present proposal.
    pub fn pending_motion(&self) -> Option<&Motion> {
        let id = if let Some(home) = self.home.filter(|home| !home.approved) {
            home.proposal_id
        } else if let Some(lesson) = &self.lesson {
            lesson.pending()?.id
        } else if self.run.phase() == RunPhase::Proposed {
            self.run.current_id()?
        } else {
            return None;
        };
        self.run.motion_of(id)
    }

    fn check_no_lesson(&self) -> Result<(), Refusal> {
        match self.lesson {
            None => Ok(()),
            Some(_) => Err(Refusal::new(
                "A lesson is being given.",
                "Save it or end it first.",
            )),
        }
    }

    /// A heightmap has come.
    pub fn on_heightmap(&mut self, seen: Observation, now: Duration) {
        self.run.on_heightmap(seen, now);
        if let (Some(lesson), Some(view)) = (&mut self.lesson, self.run.present()) {
            lesson.on_heightmap(view);
        }
        self.keep_corrections();
    }

    /// A proposal has come.
    ///
    /// # Errors
    /// When a pose lies outside the workspace.
    pub fn on_proposal(&mut self, proposal: Proposal, now: Duration) -> Result<(), InvalidMessage> {
        let is_new = self.run.proposal(proposal.id).is_none();
        self.run.on_proposal(proposal)?;
        if is_new {
            self.propose_again(now);
        }
        Ok(())
    }

    /// The executor has reported.
    pub fn on_result(&mut self, result: &StepResult, now: Duration) {
        let id = result.proposal_id;
        let by_itself =
            result.outcome == StepOutcome::Stopped && self.run.phase() != RunPhase::Stopped;
        self.run.on_result(result, now);
        let is_of_home = result.outcome.is_of_home();
        self.home
            .take_if(|home| is_of_home || home.proposal_id == id);
        if result.outcome.motion().is_some() {
            self.count_run(id);
        }
        if by_itself && self.lesson.is_none() && self.run.phase() == RunPhase::Stopped {
            // The executor has stopped by itself, for instance because the operator was gone: everybody has to know that the run
            // is stopped, or it cannot be continued. While the console is inactive there is nobody to tell.
            let _ = self.confirm(id, OperatorDecision::Stop, BY_ITSELF.to_owned(), now);
        }
        if let Some(lesson) = &mut self.lesson {
            lesson.on_result(result);
            // The view may have come before the result.
            if let Some(view) = self.run.present() {
                lesson.on_heightmap(view);
            }
        }
    }

    /// The operator has a demonstration repeated.
    ///
    /// # Errors
    /// When somebody else decides, a lesson is being given, or the arm moves.
    pub fn repeat(
        &mut self,
        viewer: ViewerId,
        demonstration: String,
        path: PathBuf,
    ) -> Result<(), Refusal> {
        self.sessions.check_operator(viewer)?;
        self.check_no_lesson()?;
        if self.run.phase() == RunPhase::Moving {
            return Err(Refusal::new("The arm is moving.", "Wait until it is back."));
        }
        let name = self.sessions.name(viewer).to_owned();
        self.send(Command::Load(demonstration, path, name))
    }

    /// The operator gives the policy another checkpoint, from the next proposal on.
    ///
    /// # Errors
    /// When somebody else decides.
    pub fn use_checkpoint(&mut self, viewer: ViewerId, path: PathBuf) -> Result<(), Refusal> {
        self.sessions.check_operator(viewer)?;
        let name = self.sessions.name(viewer).to_owned();
        self.send(Command::LoadCheckpoint(path, name))
    }

    /// The operator gives the policy the checkpoint that it had before.
    ///
    /// # Errors
    /// When somebody else decides, or the checkpoint was not changed.
    pub fn use_previous_checkpoint(&mut self, viewer: ViewerId) -> Result<(), Refusal> {
        let policy = self.policy.as_ref().ok_or_else(|| {
            Refusal::new(
                "The policy's checkpoint was not changed here.",
                "Choose a checkpoint.",
            )
        })?;
        self.use_checkpoint(viewer, PathBuf::from(&policy.previous))
    }

    /// The operator proposes another pick and place for the present goal. It needs an approval as every proposal does.
    ///
    /// # Errors
    /// When somebody else decides, nothing can be proposed now, or the poses lie outside the workspace.
    pub fn correct(
        &mut self,
        viewer: ViewerId,
        pick: Pose,
        place: Pose,
    ) -> Result<ProposalId, Refusal> {
        self.sessions.check_operator(viewer)?;
        let author = self.sessions.name(viewer);
        let proposal = self.run.correction(pick, place, author)?;
        let id = proposal.id;
        self.send(Command::Propose(Box::new(proposal.clone())))?;
        self.run.on_proposal(proposal).map_err(|error| {
            Refusal::new(error.to_string(), "Choose other places on the picture.")
        })?;
        Ok(id)
    }

    /// The operator continues the run with a step, the present one or another.
    ///
    /// # Errors
    /// When somebody else decides, or there is no such step.
    pub fn set_step(&mut self, viewer: ViewerId, step: u32) -> Result<(), Refusal> {
        self.sessions.check_operator(viewer)?;
        let count = self.run.goal().map_or(0, |goal| goal.step_count);
        if !(1..=count).contains(&step) {
            return Err(Refusal::new(
                format!("There is no step {step}: the demonstration has {count}."),
                "Choose a step of the demonstration.",
            ));
        }
        let name = self.sessions.name(viewer).to_owned();
        self.send(Command::SetStep(step, name))
    }

    /// Asks again what was not heard. Returns whether anything was not.
    pub fn ask_again(&mut self, now: Duration) -> bool {
        let is_unplanned = self.give_planning_up(now);
        let unanswered = self.run.ask_again(now);
        if let Some(id) = unanswered {
            if let Some(lesson) = &mut self.lesson {
                lesson.forget_motion();
            }
            // It is shown for approval again.
            if let Some(home) = self.home.as_mut().filter(|home| home.proposal_id == id) {
                home.approved = false;
            }
        }
        // What lets things go on was lost: see `Operator::probe`. A console without an operator decides nothing.
        let is_operated = self.sessions.operator().is_some() && self.lesson.is_none();
        if is_operated && let Some(id) = self.run.probe(now) {
            // While the console is inactive there is nobody to tell.
            let _ = self.confirm(id, OperatorDecision::Reject, BY_ITSELF.to_owned(), now);
        }
        is_unplanned || unanswered.is_some()
    }

    /// A confirmation has come on the topic; one of ours is known already.
    pub fn on_confirmation(&mut self, confirmation: &Confirmation, now: Duration) {
        if self.run.on_confirmation(confirmation, now) {
            self.after_decision(confirmation);
        }
    }

    /// Whether the operator is present has changed. An executor that requires it has to hear so before their first decision.
    pub fn presence_changed(&self) {
        // An inactive console says nothing.
        let _ = self.send(Command::Presence);
    }

    fn send(&self, command: Command) -> Result<(), Refusal> {
        let sent = self
            .commands
            .as_ref()
            .map(|commands| commands.send(command));
        match sent {
            Some(Ok(())) => Ok(()),
            Some(Err(_)) | None => Err(Refusal::new(
                "The console is not active.",
                "Activate the node operator_console, then try again.",
            )),
        }
    }
}

#[cfg(test)]
pub(crate) mod tests;
