//! What HTTP handlers and the node share: the run, the people, and what is to be said to the graph.

use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use bags::Demonstration;
use msgs::convert;
use msgs::sctn_msgs::{Heightmap, PickPlace, PrimitiveSettings, StepConfirmation, StepResult};
use serde::Serialize;
use step_protocol::StepOutcome;
use tokio::sync::{mpsc, watch};

use crate::lesson::{Lesson, LessonState};
use crate::refusal::Refusal;
use crate::run::{Decision, InvalidMessage, Phase, Pose, Run, Snapshot};
use crate::session::{Sessions, ViewerId, ViewerState};
use crate::training::TrainingState;

/// Confirmations of ours that have not come back on the topic yet.
const SENT: usize = 64;

/// What the node is to do.
#[derive(Clone, Debug, PartialEq)]
pub enum Command {
    /// Publish this confirmation; the node stamps it.
    Confirm(StepConfirmation),
    /// Publish this proposal of the operator's.
    Propose(Box<PickPlace>),
    /// Call the executor's service `home`; for whom.
    Home(String),
    /// Have the oracle latch this step again; for whom.
    SetStep(u32, String),
    /// Have the oracle load the demonstration at this path; for whom.
    Load(PathBuf, String),
    /// Have the policy load the checkpoint at this path; for whom.
    LoadCheckpoint(PathBuf, String),
}

/// The state behind one lock.
pub struct State {
    /// The run as it was heard.
    pub run: Run,
    /// The people.
    pub sessions: Sessions,
    /// The lesson that is being given.
    lesson: Option<Lesson>,
    /// The policy's checkpoint, once it was changed.
    pub policy: Option<PolicyState>,
    /// Proposal and decision of our own confirmations: what they change was changed when they were made.
    sent: VecDeque<(u64, u8)>,
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
                policy: None,
                sent: VecDeque::new(),
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
        proposal_id: u64,
        decision: Decision,
        now: Duration,
    ) -> Result<(), Refusal> {
        if decision != Decision::Stop {
            self.sessions.check_operator(viewer)?;
            self.check_no_lesson()?;
        }
        if self.lesson.is_none() || decision != Decision::Stop {
            self.run.check(decision, now)?;
        }
        if decision != Decision::Stop && self.run.current_id() != Some(proposal_id) {
            return Err(Refusal::new(
                format!("Proposal {proposal_id} is not the present one."),
                "The view has changed since. Look at the present proposal.",
            ));
        }
        let confirmation = StepConfirmation {
            proposal_id,
            decision: decision.to_msg(),
            operator_name: self.sessions.name(viewer).to_owned(),
            ..StepConfirmation::default()
        };
        self.confirm(confirmation)
    }

    fn confirm(&mut self, confirmation: StepConfirmation) -> Result<(), Refusal> {
        self.send(Command::Confirm(confirmation.clone()))?;
        self.run.on_confirmation(&confirmation);
        if self.sent.len() == SENT {
            self.sent.pop_front();
        }
        let key = (confirmation.proposal_id, confirmation.decision);
        self.sent.push_back(key);
        Ok(())
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
    pub fn on_heightmap(
        &mut self,
        message: Heightmap,
        now: Duration,
    ) -> Result<(), InvalidMessage> {
        self.run.on_heightmap(message, now)?;
        if let (Some(lesson), Some(view)) = (&mut self.lesson, self.run.present()) {
            lesson.on_heightmap(view);
        }
        Ok(())
    }

    /// The executor has reported.
    pub fn on_result(&mut self, message: &StepResult, now: Duration) -> Result<(), InvalidMessage> {
        let result = convert::result_from_msg(message).map_err(|error| error.to_string())?;
        let by_itself =
            result.outcome == StepOutcome::Stopped && self.run.phase() != Phase::Stopped;
        self.run.on_result(message, now)?;
        if by_itself && self.lesson.is_none() && self.run.phase() == Phase::Stopped {
            // The executor has stopped by itself, for instance because the operator was gone: everybody has to know that the run
            // is stopped, or it cannot be continued. While the console is inactive there is nobody to tell.
            let _ = self.confirm(StepConfirmation {
                proposal_id: message.proposal_id,
                decision: StepConfirmation::STOP,
                operator_name: "operator_console".to_owned(),
                ..StepConfirmation::default()
            });
        }
        if let Some(lesson) = &mut self.lesson {
            lesson.on_result(&result);
            // The view may have come before the result.
            if let Some(view) = self.run.present() {
                lesson.on_heightmap(view);
            }
        }
        Ok(())
    }

    /// The operator begins a lesson.
    ///
    /// # Errors
    /// When somebody else decides, the arm moves, or a lesson is being given.
    pub fn begin_lesson(&mut self, viewer: ViewerId) -> Result<(), Refusal> {
        self.sessions.check_operator(viewer)?;
        self.check_no_lesson()?;
        if self.run.phase() == Phase::Moving {
            return Err(Refusal::new("The arm is moving.", "Wait until it is back."));
        }
        self.lesson = Some(Lesson::default());
        Ok(())
    }

    /// The operator ends the lesson; what is not saved is forgotten.
    ///
    /// # Errors
    /// When somebody else decides.
    pub fn end_lesson(&mut self, viewer: ViewerId) -> Result<(), Refusal> {
        self.sessions.check_operator(viewer)?;
        self.lesson = None;
        Ok(())
    }

    fn lesson(&mut self, viewer: ViewerId) -> Result<&mut Lesson, Refusal> {
        self.sessions.check_operator(viewer)?;
        self.lesson
            .as_mut()
            .ok_or_else(|| Refusal::new("No lesson is being given.", "Begin a lesson first."))
    }

    /// The operator shows a step: it is proposed and approved at once, and passes the executor's checks as every proposal does.
    ///
    /// # Errors
    /// When somebody else decides, the last motion is not judged, something is stale, or a pose lies outside the workspace.
    pub fn show_step(
        &mut self,
        viewer: ViewerId,
        pick: Pose,
        place: Pose,
        settings: PrimitiveSettings,
        now: Duration,
    ) -> Result<(), Refusal> {
        self.move_in_lesson(viewer, pick, place, settings, false, now)
    }

    /// The operator takes the last step of the lesson back: the arm moves the object back.
    ///
    /// # Errors
    /// As [`Self::show_step`], and when there is no step.
    pub fn undo_step(&mut self, viewer: ViewerId, now: Duration) -> Result<(), Refusal> {
        let (pick, place, shown) = self.lesson(viewer)?.undo()?;
        self.move_in_lesson(viewer, pick, place, shown.settings, true, now)
    }

    fn move_in_lesson(
        &mut self,
        viewer: ViewerId,
        pick: Pose,
        place: Pose,
        settings: PrimitiveSettings,
        undoes: bool,
        now: Duration,
    ) -> Result<(), Refusal> {
        let number = self.lesson(viewer)?.next();
        let author = self.sessions.name(viewer);
        let (proposal, view) = self
            .run
            .lesson_step(pick, place, settings, number, author, now)?;
        let view = view.clone();
        let id = proposal.id;
        self.lesson(viewer)?
            .begin(proposal.clone(), &view, undoes)?;
        self.send(Command::Propose(Box::new(proposal.clone())))?;
        // Its poses and settings were checked.
        let _ = self.run.on_proposal(proposal);
        self.confirm(StepConfirmation {
            proposal_id: id,
            decision: Decision::Approve.to_msg(),
            operator_name: self.sessions.name(viewer).to_owned(),
            ..StepConfirmation::default()
        })
    }

    /// The operator says whether the step that was shown is as it should be.
    ///
    /// # Errors
    /// When somebody else decides, or there is nothing to judge.
    pub fn judge_step(&mut self, viewer: ViewerId, reached: bool) -> Result<(), Refusal> {
        self.lesson(viewer)?.judge(reached)
    }

    /// The lesson as a demonstration.
    ///
    /// # Errors
    /// When somebody else decides, the name cannot be one, or there is no step.
    pub fn lesson_demonstration(
        &mut self,
        viewer: ViewerId,
        name: &str,
    ) -> Result<Demonstration, Refusal> {
        self.lesson(viewer)?.demonstration(name)
    }

    /// The lesson is on disk.
    pub fn lesson_saved(&mut self) {
        if let Some(lesson) = &mut self.lesson {
            lesson.saved();
        }
    }

    /// The operator has a demonstration repeated.
    ///
    /// # Errors
    /// When somebody else decides, a lesson is being given, or the arm moves.
    pub fn repeat(&mut self, viewer: ViewerId, path: PathBuf) -> Result<(), Refusal> {
        self.sessions.check_operator(viewer)?;
        self.check_no_lesson()?;
        if self.run.phase() == Phase::Moving {
            return Err(Refusal::new("The arm is moving.", "Wait until it is back."));
        }
        let name = self.sessions.name(viewer).to_owned();
        self.send(Command::Load(path, name))
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
    pub fn correct(&mut self, viewer: ViewerId, pick: Pose, place: Pose) -> Result<u64, Refusal> {
        self.sessions.check_operator(viewer)?;
        let author = self.sessions.name(viewer);
        let proposal = self.run.correction(pick, place, author)?;
        let id = proposal.id;
        self.send(Command::Propose(Box::new(proposal.clone())))?;
        self.run
            .on_proposal(proposal)
            .map_err(|reason| Refusal::new(reason, "Choose other places on the picture."))?;
        Ok(id)
    }

    /// The operator brings the arm home.
    ///
    /// # Errors
    /// When somebody else decides.
    pub fn home(&mut self, viewer: ViewerId) -> Result<(), Refusal> {
        self.sessions.check_operator(viewer)?;
        let name = self.sessions.name(viewer).to_owned();
        self.send(Command::Home(name))
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

    /// A confirmation has come on the topic; one of ours is known already.
    pub fn on_confirmation(&mut self, message: &StepConfirmation) {
        let key = (message.proposal_id, message.decision);
        match self.sent.iter().position(|sent| *sent == key) {
            Some(index) => {
                self.sent.remove(index);
            }
            None => self.run.on_confirmation(message),
        }
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
pub(crate) mod tests {
    use super::*;
    use crate::run::Watch;
    use msgs::sctn_msgs::Goal;

    fn heightmap() -> Heightmap {
        Heightmap {
            rows: 1,
            cols: 1,
            pixel_size_m: 1.0,
            z_max_m: 1.0,
            rgb: vec![0; 3].into(),
            height_m: vec![0.0],
            ..Heightmap::default()
        }
    }

    /// An active console with an open proposal 7 and an operator, and what it commands.
    fn proposed() -> (Console, ViewerId, mpsc::UnboundedReceiver<Command>) {
        let watch = Watch {
            nodes: Vec::new(),
            executor: "/suction_executor".into(),
            stale_after: Duration::from_secs(3),
            changes: heightmap::ChangeRules::default(),
        };
        let sessions = Sessions::new(4, Duration::from_secs(60));
        let console = Console::new(Run::new(watch), sessions);
        let commands = console.connect();
        let ada = console.change(|state, now| {
            let ada = state.sessions.join("Ada", "key".into(), now).unwrap();
            state.sessions.take(ada, None).unwrap();
            state.run.on_joints(Vec::new(), Vec::new(), now);
            state.on_heightmap(heightmap(), now).unwrap();
            let goal = Goal {
                step: 1,
                step_count: 1,
                heightmap: heightmap(),
                ..Goal::default()
            };
            state.run.on_goal(goal, now).unwrap();
            let settings = PrimitiveSettings {
                clearance_m: 0.1,
                lift_m: 0.1,
                travel_m_s: 1.0,
                carry_m_s: 1.0,
                descend_m_s: 0.1,
                acceleration_m_s2: 1.0,
            };
            let proposal = PickPlace {
                id: 7,
                step: 1,
                settings,
                ..PickPlace::default()
            };
            state.run.on_proposal(proposal).unwrap();
            ada
        });
        (console, ada, commands)
    }

    /// A console whose state has something in every field.
    pub(crate) fn with_everything() -> Console {
        let (console, ada, commands) = proposed();
        decide(&console, ada, 7, Decision::Approve).unwrap();
        let mut result = StepResult {
            proposal_id: 7,
            outcome: StepResult::FAULT,
            reason: "protective stop".into(),
            ..StepResult::default()
        };
        result.duration.sec = 1;
        console.change(|state, now| {
            state.on_result(&result, now).unwrap();
            state.on_heightmap(heightmap(), now).unwrap();
            state.run.on_reward(Default::default());
            let planned = crate::preview::tests::planned(7);
            state.run.on_planned_motion(planned).unwrap();
            let scores = msgs::sensor_msgs::Image {
                height: 1,
                width: 2,
                step: 6,
                encoding: "rgb8".into(),
                data: vec![0; 6].into(),
                ..Default::default()
            };
            state.run.on_scores(scores).unwrap();
            let status = msgs::diagnostic_msgs::DiagnosticStatus {
                name: "/gctn_policy: policy".into(),
                ..Default::default()
            };
            let diagnostics = msgs::diagnostic_msgs::DiagnosticArray {
                status: vec![status],
                ..Default::default()
            };
            state.run.on_diagnostics(diagnostics, now);
            state
                .run
                .on_joints(vec!["elbow_joint".into()], vec![1.0], now);
            state.policy = Some(PolicyState {
                checkpoint: "new.safetensors".into(),
                previous: "old.safetensors".into(),
            });
            state.begin_lesson(ada).unwrap();
        });
        drop(commands);
        console
    }

    fn decide(
        console: &Console,
        viewer: ViewerId,
        id: u64,
        decision: Decision,
    ) -> Result<(), Refusal> {
        console.change(|state, now| state.decide(viewer, id, decision, now))
    }

    #[test]
    fn an_approval_is_sent_once_with_the_name_of_who_decides() {
        let (console, ada, mut commands) = proposed();
        decide(&console, ada, 7, Decision::Approve).unwrap();
        let Ok(Command::Confirm(confirmation)) = commands.try_recv() else {
            panic!("expected a confirmation");
        };
        assert_eq!(confirmation.operator_name, "Ada");
        assert_eq!(
            (confirmation.proposal_id, confirmation.decision),
            (7, StepConfirmation::APPROVE)
        );
        // A second click, or a replayed request.
        let refusal = decide(&console, ada, 7, Decision::Approve).unwrap_err();
        assert!(refusal.reason.contains("moving"), "{refusal:?}");
        assert!(commands.try_recv().is_err());
    }

    #[test]
    fn the_operator_changes_the_policy_and_goes_back() {
        let (console, ada, mut commands) = proposed();
        let back = || console.change(|state, _| state.use_previous_checkpoint(ada));
        assert!(back().unwrap_err().reason.contains("not changed"));
        let bob = console.change(|state, now| state.sessions.join("Bob", "b".into(), now).unwrap());
        let load = |viewer| {
            console.change(|state, _| state.use_checkpoint(viewer, "new.safetensors".into()))
        };
        load(bob).unwrap_err();
        load(ada).unwrap();
        let expected = Command::LoadCheckpoint("new.safetensors".into(), "Ada".into());
        assert_eq!(commands.try_recv().unwrap(), expected);
        console.change(|state, _| {
            state.policy = Some(PolicyState {
                checkpoint: "new.safetensors".into(),
                previous: "old.safetensors".into(),
            });
        });
        back().unwrap();
        let expected = Command::LoadCheckpoint("old.safetensors".into(), "Ada".into());
        assert_eq!(commands.try_recv().unwrap(), expected);
    }

    #[test]
    fn a_decision_on_another_proposal_than_the_present_one_is_refused() {
        let (console, ada, mut commands) = proposed();
        let refusal = decide(&console, ada, 6, Decision::Approve).unwrap_err();
        assert!(refusal.reason.contains("Proposal 6"), "{refusal:?}");
        assert!(commands.try_recv().is_err());
    }

    #[test]
    fn everybody_may_stop_and_only_the_operator_does_anything_else() {
        let (console, _, mut commands) = proposed();
        let bob = console.change(|state, now| state.sessions.join("Bob", "b".into(), now).unwrap());
        assert!(decide(&console, bob, 7, Decision::Approve).is_err());
        assert!(console.change(|state, _| state.home(bob)).is_err());
        assert!(console.change(|state, _| state.set_step(bob, 1)).is_err());
        assert!(commands.try_recv().is_err());
        decide(&console, bob, 0, Decision::Stop).unwrap();
        assert!(matches!(commands.try_recv(), Ok(Command::Confirm(_))));
    }

    #[test]
    fn our_own_confirmation_that_comes_back_late_changes_nothing() {
        let (console, ada, mut commands) = proposed();
        decide(&console, ada, 7, Decision::Approve).unwrap();
        let Ok(Command::Confirm(confirmation)) = commands.try_recv() else {
            panic!("expected a confirmation");
        };
        let refused = StepResult {
            proposal_id: 7,
            outcome: StepResult::REFUSED,
            proposal_status: StepResult::PROPOSAL_PENDING,
            ..Default::default()
        };
        console
            .change(|state, now| state.on_result(&refused, now))
            .unwrap();
        console.change(|state, _| state.on_confirmation(&confirmation));
        decide(&console, ada, 7, Decision::Approve).unwrap();
    }

    #[test]
    fn a_motion_that_stops_by_itself_stops_the_run_for_everybody() {
        let (console, ada, mut commands) = proposed();
        decide(&console, ada, 7, Decision::Approve).unwrap();
        commands.try_recv().unwrap();
        let mut stopped = StepResult {
            proposal_id: 7,
            outcome: StepResult::STOPPED,
            ..StepResult::default()
        };
        stopped.duration.sec = 1;
        console
            .change(|state, now| state.on_result(&stopped, now))
            .unwrap();
        let Ok(Command::Confirm(stop)) = commands.try_recv() else {
            panic!("expected a stop");
        };
        assert_eq!(stop.decision, StepConfirmation::STOP);
        // One stop is enough, and an operator's own needs no other.
        console
            .change(|state, now| state.on_result(&stopped, now))
            .unwrap();
        assert!(commands.try_recv().is_err());
    }

    #[test]
    fn an_inactive_console_refuses_what_it_could_not_pass_on() {
        let (console, ada, commands) = proposed();
        drop(commands);
        let refusal = decide(&console, ada, 7, Decision::Approve).unwrap_err();
        assert!(refusal.reason.contains("not active"), "{refusal:?}");
    }

    #[test]
    fn a_lesson_is_shown_judged_taken_back_and_becomes_a_demonstration() {
        let (console, ada, mut commands) = proposed();
        let pose = |x_m| Pose {
            x_m,
            y_m: 0.5,
            yaw_rad: 0.0,
        };
        let settings = convert::settings_to_msg(&pick_place::PrimitiveSettings::RIGID);
        let show = |console: &Console| {
            console.change(|state, now| state.show_step(ada, pose(0.2), pose(0.8), settings, now))
        };
        show(&console).unwrap_err();
        console.change(|state, _| state.begin_lesson(ada)).unwrap();
        let refusal = decide(&console, ada, 7, Decision::Approve).unwrap_err();
        assert!(refusal.reason.contains("lesson"), "{refusal:?}");
        // Moves once, and says how it went.
        let mut finish = |console: &Console, sec: i32| {
            let Ok(Command::Propose(proposal)) = commands.try_recv() else {
                panic!("expected a proposal");
            };
            let Ok(Command::Confirm(approval)) = commands.try_recv() else {
                panic!("expected its approval");
            };
            let approved = (approval.proposal_id, approval.decision);
            assert_eq!(approved, (proposal.id, StepConfirmation::APPROVE));
            let mut result = StepResult {
                proposal_id: proposal.id,
                outcome: StepResult::PLACED,
                ..StepResult::default()
            };
            result.header.stamp.sec = sec;
            result.duration.sec = 1;
            let mut after = heightmap();
            after.header.stamp.sec = sec;
            after.height_m = vec![sec as f32];
            console.change(|state, now| {
                state.on_result(&result, now).unwrap();
                state.judge_step(ada, true).unwrap_err();
                state.on_heightmap(after, now).unwrap();
            });
            *proposal
        };
        let judge = |console: &Console, reached| {
            console
                .change(|state, _| state.judge_step(ada, reached))
                .unwrap();
        };
        show(&console).unwrap();
        finish(&console, 1);
        show(&console).unwrap_err();
        judge(&console, true);
        // Missed: not kept.
        show(&console).unwrap();
        finish(&console, 2);
        judge(&console, false);
        show(&console).unwrap();
        finish(&console, 3);
        judge(&console, true);
        // Taken back: the arm moves the other way.
        console
            .change(|state, now| state.undo_step(ada, now))
            .unwrap();
        let back = finish(&console, 4);
        assert_eq!((back.pick.x, back.place.x), (0.8, 0.2));
        judge(&console, true);
        let save = |name: &str| console.change(|state, _| state.lesson_demonstration(ada, name));
        for name in ["", "../up", "a name", "x/y"] {
            assert!(save(name).is_err(), "{name:?}");
        }
        let demonstration = save("three_blocks").unwrap();
        assert_eq!(demonstration.problem, "three_blocks");
        assert_eq!(demonstration.steps.len(), 1);
        assert_eq!(demonstration.steps[0].delta_reward, 1.0);
        assert_eq!(demonstration.steps[0].action.place.translation.x, 0.8);
        assert_eq!(demonstration.last.height_m, [1.0]);

        let folder = tempfile::tempdir().unwrap();
        let library = crate::library::Library::new(folder.path().join("library"));
        assert!(library.list().is_empty());
        library.save("three_blocks", &demonstration).unwrap();
        let taken = library.save("three_blocks", &demonstration).unwrap_err();
        assert!(taken.reason.contains("already"), "{taken:?}");
        let listed = library.list();
        assert_eq!(listed.len(), 1);
        assert_eq!(
            (listed[0].name.as_str(), listed[0].step_count),
            ("three_blocks", 1)
        );
        assert_eq!(library.picture("three_blocks", 1).unwrap().height_m, [1.0]);
        assert!(library.picture("three_blocks", 2).is_err());
        assert!(library.picture("../three_blocks", 0).is_err());
    }
}
