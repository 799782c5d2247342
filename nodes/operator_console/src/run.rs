//! The run as the operator sees it: messages in, a snapshot out. No clock, no node.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use heightmap::{Change, ChangeRules, largest_change};
use msgs::builtin_interfaces::Time;
use msgs::convert;
use msgs::diagnostic_msgs::DiagnosticArray;
use msgs::geometry_msgs::Pose2D;
use msgs::sctn_msgs::{
    ConfirmationRefused, Goal, Heightmap, PickPlace, PlannedMotion, PrimitiveSettings, Reward,
    StepConfirmation, StepResult,
};
use msgs::sensor_msgs::Image;
use nalgebra::Point2;
use serde::{Deserialize, Serialize};
use step_protocol::{OperatorDecision, ProposalStatus, StepOutcome};

use crate::preview::{Motion, Scores};
use crate::refusal::{Refusal, advice, advice_for, advice_of_oracle};

/// Past steps that are shown.
const STEPS: usize = 64;
/// Refusals and faults that are shown.
const NOTICES: usize = 50;
/// Proposals whose status is remembered: one may be published again.
const PROPOSALS: usize = 256;
/// Heightmaps of which the proposals may still come.
const HEIGHTMAPS: usize = 8;
/// Nodes whose diagnostics are kept.
const NODES: usize = 64;
/// Problem and task module of what is shown in a lesson.
const LESSON: &str = "lesson";
/// Longest description of a robot that is taken (bytes).
const LONGEST_DESCRIPTION: usize = 1 << 20;

/// What an operator decides, as the API names it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Decision {
    /// Carry the proposal out.
    Approve,
    /// Do not; propose something else.
    Reject,
    /// The step succeeded: go on with the next one.
    Advance,
    /// The step failed: try it again.
    Retry,
    /// Stop what moves, and end the run.
    Stop,
}

impl Decision {
    /// All of them.
    pub const ALL: [Self; 5] = [
        Self::Approve,
        Self::Reject,
        Self::Advance,
        Self::Retry,
        Self::Stop,
    ];

    /// As `StepConfirmation` has it.
    pub fn to_msg(self) -> u8 {
        let decision = match self {
            Self::Approve => OperatorDecision::Approve,
            Self::Reject => OperatorDecision::Reject,
            Self::Advance => OperatorDecision::Advance,
            Self::Retry => OperatorDecision::Retry,
            Self::Stop => OperatorDecision::Stop,
        };
        decision.code()
    }

    fn from_msg(decision: u8) -> Option<Self> {
        Self::ALL
            .into_iter()
            .find(|known| known.to_msg() == decision)
    }
}

/// How far the run is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// No goal has come.
    NoGoal,
    /// The policy has not proposed anything for the present goal.
    AwaitingProposal,
    /// A proposal waits for the operator.
    Proposed,
    /// The approved proposal is being carried out.
    Moving,
    /// The arm has moved: the operator says whether the step succeeded.
    AwaitingConfirmation,
    /// The motion broke off by itself.
    Fault,
    /// An operator has ended the run.
    Stopped,
    /// All steps are done.
    Complete,
}

/// What became of a proposal.
#[derive(Clone, Debug, PartialEq)]
enum Status {
    Open,
    Approved,
    /// It was rejected, withdrawn or superseded: it can never be approved again.
    Closed,
    /// Carried out.
    Moved {
        fault: bool,
    },
    /// Carried out, and the operator has said whether it succeeded.
    Confirmed {
        fault: bool,
    },
}

/// A heightmap with its number: the n-th that came.
#[derive(Clone, Debug)]
pub struct View {
    /// Counts from 1.
    pub number: u64,
    /// As it came.
    pub heightmap: Arc<Heightmap>,
    /// Capture time.
    pub stamp: Duration,
    arrived: Duration,
}

#[derive(Debug)]
struct Offered {
    message: PickPlace,
    status: Status,
    /// What has changed on the table since the heightmap that it was made from; nothing where that one is not known.
    change: Option<TableChange>,
}

/// How the table differs from the heightmap that a proposal was made from.
#[derive(Clone, Copy, Debug)]
enum TableChange {
    /// The largest change.
    Blob(Change),
    /// The heightmap covers another workspace.
    Workspace,
}

/// A step that was carried out.
#[derive(Debug)]
struct PastStep {
    number: u64,
    proposal: PickPlace,
    outcome: StepOutcome,
    reason: String,
    duration: Duration,
    ended: Duration,
    decision: Option<Decision>,
    decided_by: String,
    before: Option<View>,
    after: Option<View>,
}

#[derive(Clone, Debug, Serialize)]
struct Notice {
    number: u64,
    /// Seconds since the console started.
    at_s: f64,
    /// `refusal`, `fault` or `note`.
    kind: &'static str,
    reason: String,
    advice: String,
}

/// A node's diagnostics.
#[derive(Debug, Default)]
struct NodeHealth {
    heard: Duration,
    /// Name of the state, level, message.
    states: BTreeMap<String, (u8, String)>,
    /// Age of each camera stream when the diagnostics were sent [s]; nothing where none has come.
    images: BTreeMap<String, Option<f64>>,
}

/// State of the robot as its driver says.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Robot {
    /// `ur_dashboard_msgs/RobotMode`.
    pub robot_mode: Option<i8>,
    /// `ur_dashboard_msgs/SafetyMode`.
    pub safety_mode: Option<u8>,
    /// Whether the robot program runs.
    pub program_running: Option<bool>,
    /// Whether suction is on.
    pub suction: Option<bool>,
    /// Whether the vacuum sensor feels an object.
    pub vacuum: Option<bool>,
}

/// What has to be heard, and how often.
#[derive(Clone, Debug)]
pub struct Watch {
    /// Full names of the nodes that have to be at work.
    pub nodes: Vec<String>,
    /// Full name of the executor, one of them.
    pub executor: String,
    /// Age from which a stream is stale.
    pub stale_after: Duration,
    /// A proposal is stale when the table has changed by these since the heightmap that it was made from.
    pub changes: ChangeRules,
}

/// The run.
#[derive(Debug)]
pub struct Run {
    watch: Watch,
    views: VecDeque<View>,
    view_count: u64,
    goal: Option<Goal>,
    goal_view: Option<View>,
    goal_count: u64,
    /// Goals of the present demonstration that were latched, by step.
    strip: BTreeMap<u32, View>,
    /// A demonstration that was read: its name, and the goal images of its steps.
    demonstration: Option<(String, Vec<View>)>,
    offered: VecDeque<Offered>,
    /// Id of the newest proposal.
    newest: Option<u64>,
    stopped: bool,
    steps: VecDeque<PastStep>,
    step_count: u64,
    notices: VecDeque<Notice>,
    notice_count: u64,
    health: BTreeMap<String, NodeHealth>,
    robot: Robot,
    joints: Option<(Duration, Vec<String>, Vec<f64>)>,
    reward: Option<Reward>,
    /// The newest planned motion.
    motion: Option<Motion>,
    /// The newest score maps.
    scores: Option<Arc<Scores>>,
    score_count: u64,
    /// URDF of the robot.
    robot_description: Option<Arc<str>>,
}

/// Why a message cannot be shown.
pub type InvalidMessage = String;

fn duration(stamp: &Time) -> Result<Duration, InvalidMessage> {
    convert::time_from_msg(stamp).map_err(|error| format!("header.{error}"))
}

impl Run {
    /// Nothing has been heard.
    pub fn new(watch: Watch) -> Self {
        Self {
            watch,
            views: VecDeque::new(),
            view_count: 0,
            goal: None,
            goal_view: None,
            goal_count: 0,
            strip: BTreeMap::new(),
            demonstration: None,
            offered: VecDeque::new(),
            newest: None,
            stopped: false,
            steps: VecDeque::new(),
            step_count: 0,
            notices: VecDeque::new(),
            notice_count: 0,
            health: BTreeMap::new(),
            robot: Robot::default(),
            joints: None,
            reward: None,
            motion: None,
            scores: None,
            score_count: 0,
            robot_description: None,
        }
    }

    /// A heightmap has come.
    pub fn on_heightmap(
        &mut self,
        message: Heightmap,
        now: Duration,
    ) -> Result<(), InvalidMessage> {
        let stamp = duration(&message.header.stamp)?;
        check_heightmap(&message)?;
        self.view_count += 1;
        let view = View {
            number: self.view_count,
            heightmap: Arc::new(message),
            stamp,
            arrived: now,
        };
        for step in &mut self.steps {
            if step.after.is_none() && stamp >= step.ended {
                step.after = Some(view.clone());
            }
        }
        if self.views.len() == HEIGHTMAPS {
            self.views.pop_front();
        }
        self.views.push_back(view);
        self.compare();
        Ok(())
    }

    /// What has changed since the heightmap that the newest proposal was made from.
    fn compare(&mut self) {
        let (Some(id), Some(newest)) = (self.newest, self.views.back()) else {
            return;
        };
        let rules = &self.watch.changes;
        let Some(offered) = self
            .offered
            .iter_mut()
            .rfind(|known| known.message.id == id)
        else {
            return;
        };
        let source = duration(&offered.message.header.stamp).ok();
        let Some(source) = self.views.iter().rfind(|view| Some(view.stamp) == source) else {
            return;
        };
        let PickPlace { pick, place, .. } = &offered.message;
        let around = [pick, place].map(|pose| Point2::new(pose.x, pose.y));
        offered.change = table_change(source, newest, rules, &around);
    }

    /// A goal has been latched.
    pub fn on_goal(&mut self, mut message: Goal, now: Duration) -> Result<(), InvalidMessage> {
        let stamp = duration(&message.header.stamp)?;
        check_heightmap(&message.heightmap).map_err(|error| format!("heightmap.{error}"))?;
        if message.step == 0 || message.step > message.step_count {
            return Err(format!(
                "step is {}, expected 1 to step_count = {}",
                message.step, message.step_count
            ));
        }
        if self
            .goal_view
            .as_ref()
            .is_some_and(|view| *view.heightmap == message.heightmap)
            && self
                .goal
                .as_ref()
                .is_some_and(|goal| same_goal(goal, &message))
        {
            return Ok(());
        }
        if self.goal.as_ref().is_none_or(|goal| {
            goal.demonstration != message.demonstration || goal.step_count != message.step_count
        }) {
            self.strip.clear();
        }
        self.goal_count += 1;
        let view = View {
            number: self.goal_count,
            heightmap: Arc::new(std::mem::take(&mut message.heightmap)),
            stamp,
            arrived: now,
        };
        self.strip.insert(message.step, view.clone());
        self.goal_view = Some(view);
        self.goal = Some(message);
        self.stopped = false;
        Ok(())
    }

    /// A proposal has come.
    pub fn on_proposal(&mut self, message: PickPlace) -> Result<(), InvalidMessage> {
        duration(&message.header.stamp)?;
        convert::settings_from_msg(&message.settings)
            .map_err(|error| format!("settings.{error}"))?;
        for (field, pose) in [("pick", &message.pick), ("place", &message.place)] {
            convert::pose2d_from_msg(pose).map_err(|error| format!("{field}.{error}"))?;
            if let Some(view) = self.views.back()
                && !contains(&view.heightmap, pose.x, pose.y)
            {
                return Err(format!(
                    "{field} is ({:.3}, {:.3}), expected a place in the workspace",
                    pose.x, pose.y
                ));
            }
        }
        if let Some(known) = self.offered(message.id) {
            if known.status != Status::Closed {
                self.newest = Some(message.id);
            }
            return Ok(());
        }
        self.newest = Some(message.id);
        if self.offered.len() == PROPOSALS {
            self.offered.pop_front();
        }
        self.offered.push_back(Offered {
            message,
            status: Status::Open,
            change: None,
        });
        self.compare();
        Ok(())
    }

    /// An operator has decided, here or elsewhere.
    pub fn on_confirmation(&mut self, message: &StepConfirmation) {
        let Some(decision) = Decision::from_msg(message.decision) else {
            return;
        };
        if decision == Decision::Stop {
            self.stopped = self.goal.as_ref().is_some_and(|goal| !goal.complete);
            return;
        }
        if let (Decision::Advance | Decision::Retry, Some(step)) = (
            decision,
            self.steps
                .iter_mut()
                .rfind(|step| step.proposal.id == message.proposal_id),
        ) {
            step.decision = Some(decision);
            step.decided_by.clone_from(&message.operator_name);
        }
        if let Some(offered) = self.offered(message.proposal_id) {
            offered.status = match (decision, &offered.status) {
                (Decision::Approve, Status::Open) => Status::Approved,
                (Decision::Reject, Status::Open) => Status::Closed,
                (Decision::Advance | Decision::Retry, Status::Moved { fault }) => {
                    Status::Confirmed { fault: *fault }
                }
                (_, status) => status.clone(),
            };
        }
    }

    /// The executor has reported.
    pub fn on_result(&mut self, message: &StepResult, now: Duration) -> Result<(), InvalidMessage> {
        let result = convert::result_from_msg(message).map_err(|error| error.to_string())?;
        let id = message.proposal_id;
        match result.outcome {
            StepOutcome::Refused => {
                let carried_out = result.was_carried_out();
                if let Some(offered) = self.offered(id) {
                    offered.status = match (&offered.status, result.status) {
                        // The result was lost, for instance while the console was not there.
                        (Status::Approved, _) if carried_out => Status::Moved { fault: false },
                        (Status::Open | Status::Approved, Some(status)) => match status {
                            ProposalStatus::Moving => Status::Approved,
                            ProposalStatus::Superseded
                            | ProposalStatus::Rejected
                            | ProposalStatus::Withdrawn => Status::Closed,
                            ProposalStatus::Pending | ProposalStatus::Done => Status::Open,
                        },
                        (Status::Approved, None) => Status::Open,
                        (status, _) => (*status).clone(),
                    };
                }
                // A stop that found nothing to stop has stopped the run all the same.
                if self.stopped && self.offered(id).is_none() {
                    return Ok(());
                }
                let advice = advice_for(result.status, &result.reason);
                self.note("refusal", sentence(&result.reason), advice, now);
                return Ok(());
            }
            StepOutcome::Rejected => {
                if let Some(offered) = self.offered(id) {
                    offered.status = Status::Closed;
                }
                return Ok(());
            }
            StepOutcome::Stopped => {
                self.stopped = true;
                self.note(
                    "note",
                    "The run was stopped.",
                    "Look at the cell. When it is safe, bring the arm home, then continue with the present step.",
                    now,
                );
            }
            StepOutcome::Fault => self.note(
                "fault",
                format!(
                    "The robot broke the motion off: {}",
                    sentence(&result.reason)
                ),
                "Look at the cell. When it is safe, bring the arm home, then try the step again.",
                now,
            ),
            StepOutcome::Placed
            | StepOutcome::NoContact
            | StepOutcome::GraspFailed
            | StepOutcome::Dropped
            | StepOutcome::LagAborted => {}
        }
        let Some(offered) = self.offered(message.proposal_id) else {
            return Ok(());
        };
        if !result.arm_moved() {
            offered.status = Status::Closed;
            return Ok(());
        }
        offered.status = Status::Moved {
            fault: result.outcome == StepOutcome::Fault,
        };
        let proposal = offered.message.clone();
        let before = duration(&proposal.header.stamp)?;
        let before = self
            .views
            .iter()
            .rfind(|view| view.stamp == before)
            .cloned();
        self.step_count += 1;
        if self.steps.len() == STEPS {
            self.steps.pop_front();
        }
        let ended = result.stamp;
        self.steps.push_back(PastStep {
            number: self.step_count,
            proposal,
            outcome: result.outcome,
            reason: result.reason,
            duration: result.duration,
            ended,
            decision: None,
            decided_by: String::new(),
            before,
            after: self.views.iter().find(|view| view.stamp >= ended).cloned(),
        });
        Ok(())
    }

    /// The oracle has refused a decision on a step that was carried out: it has changed nothing.
    pub fn on_confirmation_refused(&mut self, message: &ConfirmationRefused, now: Duration) {
        match message.reason {
            // The question is still open.
            ConfirmationRefused::UNKNOWN => {
                if let Some(offered) = self.offered(message.proposal_id)
                    && let Status::Confirmed { fault } = offered.status
                {
                    offered.status = Status::Moved { fault };
                }
            }
            ConfirmationRefused::STOPPED => {
                self.stopped = self.goal.as_ref().is_some_and(|goal| !goal.complete);
            }
            _ => {}
        }
        let advice = advice_of_oracle(message.reason);
        self.note("refusal", sentence(&message.message), advice, now);
    }

    /// The simulator has measured.
    pub fn on_reward(&mut self, message: Reward) {
        self.reward = Some(message);
    }

    /// A node has said how it is.
    pub fn on_diagnostics(&mut self, message: DiagnosticArray, now: Duration) {
        for status in message.status {
            let Some((node, state)) = status.name.split_once(": ") else {
                continue;
            };
            if !self.health.contains_key(node) && self.health.len() >= NODES {
                continue;
            }
            let health = self.health.entry(node.to_owned()).or_default();
            health.heard = now;
            if state == "topics" {
                // What has been deactivated says nothing any more.
                health.states.clear();
                health.images.clear();
                for value in &status.values {
                    if let Some(age_s) = image_age(&value.key, &value.value) {
                        health.images.insert(value.key.clone(), age_s);
                    }
                }
            }
            health
                .states
                .insert(state.to_owned(), (status.level, status.message));
        }
    }

    /// The executor has planned the motion of a proposal.
    pub fn on_planned_motion(&mut self, message: PlannedMotion) -> Result<(), InvalidMessage> {
        self.motion = Some(Motion::from_msg(message)?);
        Ok(())
    }

    /// The policy has drawn its scores.
    pub fn on_scores(&mut self, message: Image) -> Result<(), InvalidMessage> {
        self.score_count += 1;
        self.scores = Some(Arc::new(Scores::from_msg(message, self.score_count)?));
        Ok(())
    }

    /// The robot has been described, as URDF.
    pub fn on_robot_description(&mut self, urdf: String) -> Result<(), InvalidMessage> {
        if urdf.len() > LONGEST_DESCRIPTION {
            let found = urdf.len();
            return Err(format!(
                "data has {found} bytes, expected at most {LONGEST_DESCRIPTION}"
            ));
        }
        self.robot_description = Some(urdf.into());
        Ok(())
    }

    /// URDF of the robot.
    pub fn robot_description(&self) -> Option<Arc<str>> {
        self.robot_description.clone()
    }

    /// The planned motion of the present proposal.
    pub fn motion(&self) -> Option<&Motion> {
        let id = self.current_id()?;
        self.motion
            .as_ref()
            .filter(|motion| motion.proposal_id == id)
    }

    /// The scores of the heightmap that the present proposal was made from.
    pub fn scores(&self) -> Option<&Arc<Scores>> {
        let stamp = duration(&self.current()?.message.header.stamp).ok()?;
        self.scores.as_ref().filter(|scores| scores.stamp == stamp)
    }

    /// The joints have been read.
    pub fn on_joints(&mut self, names: Vec<String>, positions_rad: Vec<f64>, now: Duration) {
        self.joints = Some((now, names, positions_rad));
    }

    /// The driver has said something of the robot.
    pub fn on_robot(&mut self, change: impl FnOnce(&mut Robot)) {
        change(&mut self.robot);
    }

    /// Something that the operator should read.
    pub fn note(
        &mut self,
        kind: &'static str,
        reason: impl Into<String>,
        advice: impl Into<String>,
        now: Duration,
    ) {
        self.notice_count += 1;
        if self.notices.len() == NOTICES {
            self.notices.pop_front();
        }
        self.notices.push_back(Notice {
            number: self.notice_count,
            at_s: now.as_secs_f64(),
            kind,
            reason: reason.into(),
            advice: advice.into(),
        });
    }

    fn offered(&mut self, id: u64) -> Option<&mut Offered> {
        self.offered
            .iter_mut()
            .rfind(|known| known.message.id == id)
    }

    /// The proposal for the present goal that the arm moves or has moved for; else the newest, if it is for this goal.
    fn current(&self) -> Option<&Offered> {
        let goal = self.goal.as_ref()?;
        let of_this_goal = |known: &&Offered| {
            let PickPlace {
                step,
                attempt,
                problem,
                ..
            } = &known.message;
            (*step, *attempt, problem) == (goal.step, goal.attempt, &goal.problem)
        };
        let offered = || self.offered.iter().rev().filter(of_this_goal);
        let at_work = |known: &&Offered| !matches!(known.status, Status::Open | Status::Closed);
        offered()
            .find(at_work)
            .or_else(|| offered().find(|known| Some(known.message.id) == self.newest))
    }

    /// A proposal of the operator's for the present goal, made from the newest heightmap.
    ///
    /// # Errors
    /// When nothing can be proposed now, or a pose lies outside the workspace.
    pub fn correction(&self, pick: Pose, place: Pose, author: &str) -> Result<PickPlace, Refusal> {
        let phase = self.phase();
        if !matches!(phase, Phase::Proposed | Phase::AwaitingProposal) {
            return Err(out_of_phase(phase));
        }
        let (Some(goal), Some(view)) = (&self.goal, self.views.back()) else {
            return Err(no_picture());
        };
        if duration(&goal.header.stamp).is_ok_and(|since| view.stamp < since) {
            return Err(Refusal::new(
                "The picture is from before the last motion.",
                "Wait for the next one.",
            ));
        }
        let proposal = from_view(
            view,
            PickPlace {
                problem: goal.problem.clone(),
                step: goal.step,
                attempt: goal.attempt,
                pick: pick.to_msg(),
                place: place.to_msg(),
                settings: goal.settings,
                module: goal.module.clone(),
                author: author.to_owned(),
                ..PickPlace::default()
            },
        )?;
        if self
            .offered
            .iter()
            .any(|known| known.message.id == proposal.id)
        {
            return Err(Refusal::new(
                "The same correction was made before.",
                "Approve it, or move pick, place or turn.",
            ));
        }
        Ok(proposal)
    }

    /// A step of a lesson, made from the newest heightmap; and that heightmap.
    ///
    /// # Errors
    /// When the robot or a stream is not ready, or a pose lies outside the workspace.
    pub fn lesson_step(
        &self,
        pick: Pose,
        place: Pose,
        settings: PrimitiveSettings,
        (step, attempt): (u32, u32),
        author: &str,
        now: Duration,
    ) -> Result<(PickPlace, &View), Refusal> {
        if let Some(refusal) = self.obstacle(now) {
            return Err(refusal);
        }
        let view = self.views.back().ok_or_else(no_picture)?;
        let proposal = PickPlace {
            problem: LESSON.to_owned(),
            module: LESSON.to_owned(),
            step,
            attempt,
            pick: pick.to_msg(),
            place: place.to_msg(),
            settings,
            author: author.to_owned(),
            ..PickPlace::default()
        };
        Ok((from_view(view, proposal)?, view))
    }

    /// How far the run is.
    pub fn phase(&self) -> Phase {
        match &self.goal {
            None => return Phase::NoGoal,
            Some(goal) if goal.complete => return Phase::Complete,
            Some(_) if self.stopped => return Phase::Stopped,
            Some(_) => {}
        }
        match self.current().map(|offered| &offered.status) {
            None | Some(Status::Closed | Status::Confirmed { .. }) => Phase::AwaitingProposal,
            Some(Status::Open) => Phase::Proposed,
            Some(Status::Approved) => Phase::Moving,
            Some(Status::Moved { fault: false }) => Phase::AwaitingConfirmation,
            Some(Status::Moved { fault: true }) => Phase::Fault,
        }
    }

    /// Id of the proposal that a decision would be about.
    pub fn current_id(&self) -> Option<u64> {
        self.current().map(|offered| offered.message.id)
    }

    /// The present goal, without its heightmap.
    pub fn goal(&self) -> Option<&Goal> {
        self.goal.as_ref()
    }

    /// The newest heightmap.
    pub fn present(&self) -> Option<&View> {
        self.views.back()
    }

    /// The heightmap of the present goal.
    pub fn goal_view(&self) -> Option<&View> {
        self.goal_view.as_ref()
    }

    /// A demonstration was read: its images are shown before they are latched, where it is the present one.
    pub fn on_demonstration(&mut self, name: String, images: Vec<Heightmap>, now: Duration) {
        let views = images.into_iter().map(|heightmap| View {
            // Goals that were latched count from 1.
            number: 0,
            heightmap: Arc::new(heightmap),
            stamp: Duration::ZERO,
            arrived: now,
        });
        self.demonstration = Some((name, views.collect()));
    }

    /// The goal image of a step of the present demonstration, where it is known.
    pub fn strip(&self, step: u32) -> Option<&View> {
        self.strip.get(&step).or_else(|| {
            let goal = self.goal.as_ref()?;
            let (name, images) = self.demonstration.as_ref()?;
            let same = *name == goal.demonstration && images.len() == goal.step_count as usize;
            images.get(step.checked_sub(1)? as usize).filter(|_| same)
        })
    }

    /// The views before and after a past step, by its number.
    pub fn past_step(&self, number: u64) -> Option<(Option<&View>, Option<&View>)> {
        let step = self.steps.iter().find(|step| step.number == number)?;
        Some((step.before.as_ref(), step.after.as_ref()))
    }

    /// Whether a decision would be taken now; else why not.
    ///
    /// # Errors
    /// The words for the operator.
    pub fn check(&self, decision: Decision, now: Duration) -> Result<(), Refusal> {
        let phase = self.phase();
        let allowed = match decision {
            Decision::Approve | Decision::Reject => phase == Phase::Proposed,
            Decision::Advance | Decision::Retry => {
                matches!(phase, Phase::AwaitingConfirmation | Phase::Fault)
            }
            Decision::Stop => !matches!(phase, Phase::Complete | Phase::NoGoal),
        };
        if !allowed {
            return Err(out_of_phase(phase));
        }
        if decision == Decision::Approve
            && let Some(refusal) = self.obstacle(now).or_else(|| self.change())
        {
            return Err(refusal);
        }
        Ok(())
    }

    /// Why the present proposal is stale: the table has changed since the heightmap that it was made from.
    fn change(&self) -> Option<Refusal> {
        let reason = match self.current()?.change? {
            TableChange::Blob(change) => format!(
                "The proposal is stale: the table has changed about ({:.3}, {:.3}) m since the picture that it was made from.",
                change.center_m.x, change.center_m.y
            ),
            TableChange::Workspace => {
                "The proposal is stale: the picture that it was made from shows another workspace."
                    .to_owned()
            }
        };
        Some(Refusal::new(reason, "Wait for the new proposal."))
    }

    /// Why nothing can be approved: something is stale, or the robot is not ready.
    fn obstacle(&self, now: Duration) -> Option<Refusal> {
        for stream in self.streams(now) {
            if stream.required && stream.stale {
                let reason = match stream.age_s {
                    Some(age_s) => format!(
                        "{} is stale: the newest is {age_s:.1} s old, expected at most {:.1} s.",
                        stream.name,
                        self.watch.stale_after.as_secs_f64()
                    ),
                    None => format!("Nothing has come from {} yet.", stream.name),
                };
                return Some(Refusal::new(
                    reason,
                    "What you see may not be what is there. Look at that node or camera; the buttons come back by themselves.",
                ));
            }
        }
        let executor = self.health.get(&self.watch.executor)?;
        let (_, message) = executor.states.get("driver")?;
        (message != "ready").then(|| {
            Refusal::new(
                format!("The robot is not ready: {}", sentence(message)),
                advice(message),
            )
        })
    }

    /// The age of all that should come regularly.
    fn streams(&self, now: Duration) -> Vec<Stream> {
        let limit_s = self.watch.stale_after.as_secs_f64();
        let stream = |name: String, age_s: Option<f64>, required| Stream {
            name,
            age_s,
            stale: age_s.is_none_or(|age_s| age_s > limit_s),
            required,
        };
        let since = |heard: Duration| now.saturating_sub(heard).as_secs_f64();
        let mut streams = Vec::new();
        for node in &self.watch.nodes {
            let heard = self.health.get(node).map(|health| since(health.heard));
            streams.push(stream(node.trim_start_matches('/').to_owned(), heard, true));
        }
        let watched = self
            .health
            .iter()
            .filter(|(node, _)| self.watch.nodes.contains(*node));
        for (_, health) in watched {
            for (topic, age_s) in &health.images {
                let age_s = age_s.map(|age_s| age_s + since(health.heard));
                streams.push(stream(
                    topic.trim_start_matches('/').to_owned(),
                    age_s,
                    true,
                ));
            }
        }
        let joints = self.joints.as_ref().map(|(heard, ..)| since(*heard));
        streams.push(stream("joint_states".to_owned(), joints, true));
        streams
    }

    /// All of it, for the page.
    pub fn snapshot(&self, now: Duration) -> Snapshot<'_> {
        let since = |heard: Duration| now.saturating_sub(heard).as_secs_f64();
        let phase = self.phase();
        let current = self.current();
        let (headline, advice) = self.headline(phase);
        let refusals = Decision::ALL
            .into_iter()
            .filter_map(|decision| Some((decision, self.check(decision, now).err()?)));
        Snapshot {
            phase,
            headline,
            advice,
            refused: refusals.collect(),
            heightmap: self.present().map(|view| ViewState {
                age_s: since(view.arrived),
                ..ViewState::of(view)
            }),
            goal: self.goal.as_ref().map(|goal| GoalState {
                problem: &goal.problem,
                demonstration: &goal.demonstration,
                step: goal.step,
                step_count: goal.step_count,
                attempt: goal.attempt,
                complete: goal.complete,
                module: &goal.module,
                heightmap: self.goal_view.as_ref().map(ViewState::of),
                strip: (1..=goal.step_count)
                    .filter_map(|step| Some((step, self.strip(step)?.number)))
                    .collect(),
            }),
            proposal: current.map(|offered| ProposalState::of(&offered.message)),
            steps: self.steps.iter().map(StepState::of).collect(),
            notices: &self.notices,
            streams: self.streams(now),
            nodes: self
                .health
                .iter()
                .map(|(node, health)| (node.as_str(), worst(health)))
                .collect(),
            robot: &self.robot,
            joints: self.joints.as_ref().map(|(_, names, positions)| {
                names
                    .iter()
                    .map(String::as_str)
                    .zip(positions.iter().copied())
                    .collect()
            }),
            reward: self.reward.as_ref().map(|reward| reward.total),
            motion: self.motion().map(|motion| MotionState {
                duration_s: motion.duration_s(),
                reason: &motion.reason,
            }),
            scores: self.scores().map(|scores| scores.number),
            robot_description: self.robot_description.is_some(),
        }
    }

    fn headline(&self, phase: Phase) -> (String, &'static str) {
        let step = match &self.goal {
            Some(goal) if goal.attempt > 0 => format!(
                "Step {} of {}, attempt {}",
                goal.step,
                goal.step_count,
                goal.attempt + 1
            ),
            Some(goal) => format!("Step {} of {}", goal.step, goal.step_count),
            None => String::new(),
        };
        match phase {
            Phase::NoGoal => (
                "No goal yet".into(),
                "The goal oracle has no demonstration. Load one, or start it with one.",
            ),
            Phase::AwaitingProposal => (
                format!("{step}: waiting for a proposal"),
                "The policy looks at the table.",
            ),
            Phase::Proposed => (
                format!("{step}: the policy proposes a move"),
                "Look at pick and place in the picture. Approve it if it brings the table closer to the goal, else reject it.",
            ),
            Phase::Moving => (
                format!("{step}: the arm moves"),
                "Watch the cell. Stop if anything is wrong.",
            ),
            Phase::AwaitingConfirmation => (
                format!("{step}: did it succeed?"),
                "Compare the present view with the goal. Next step if it succeeded, try again if not.",
            ),
            Phase::Fault => (
                format!("{step}: the robot broke the motion off"),
                "Look at the cell. When it is safe, bring the arm home, then try the step again.",
            ),
            Phase::Stopped => (
                format!("{step}: stopped"),
                "Look at the cell. When it is safe, bring the arm home, then continue.",
            ),
            Phase::Complete => ("All steps are done".into(), "Nothing is left to do."),
        }
    }
}

fn out_of_phase(phase: Phase) -> Refusal {
    let (reason, advice) = match phase {
        Phase::NoGoal => ("There is no goal.", "Load a demonstration first."),
        Phase::AwaitingProposal => (
            "There is no proposal to decide on.",
            "Wait for the policy's next proposal.",
        ),
        Phase::Proposed => (
            "The proposal has not been carried out.",
            "Approve it or reject it first.",
        ),
        Phase::Moving => ("The arm is moving.", "Wait until it is back, or stop it."),
        Phase::AwaitingConfirmation => (
            "The proposal was already carried out.",
            "Say whether the step succeeded.",
        ),
        Phase::Fault => (
            "The robot broke the motion off.",
            "Bring the arm home, then try the step again.",
        ),
        Phase::Stopped => (
            "The run is stopped.",
            "Continue the run with the present step.",
        ),
        Phase::Complete => ("All steps are done.", "Nothing is left to do."),
    };
    Refusal::new(reason, advice)
}

/// The goal is the same one, latched again.
fn same_goal(known: &Goal, message: &Goal) -> bool {
    let key = |goal: &Goal| {
        (
            goal.header.stamp.sec,
            goal.header.stamp.nanosec,
            goal.step,
            goal.attempt,
            goal.complete,
            goal.step_count,
        )
    };
    key(known) == key(message) && known.demonstration == message.demonstration
}

fn check_heightmap(message: &Heightmap) -> Result<(), InvalidMessage> {
    let cells = u64::from(message.rows) * u64::from(message.cols);
    let sizes = [
        ("rgb", message.rgb.len() as u64, cells.checked_mul(3)),
        ("height_m", message.height_m.len() as u64, Some(cells)),
    ];
    for (field, found, expected) in sizes {
        if cells == 0 || Some(found) != expected {
            return Err(format!(
                "{field} has {found} values, expected those of {} x {} cells",
                message.rows, message.cols
            ));
        }
    }
    if !(message.pixel_size_m.is_finite() && message.pixel_size_m > 0.0) {
        return Err(format!(
            "pixel_size_m is {}, expected a positive number",
            message.pixel_size_m
        ));
    }
    for (field, value) in [
        ("origin.x", message.origin.x),
        ("origin.y", message.origin.y),
    ] {
        if !value.is_finite() {
            return Err(format!("{field} is {value}, expected a finite number"));
        }
    }
    Ok(())
}

/// How the newest heightmap differs from the one that a proposal was made from, as the executor's gate has it.
fn table_change(
    source: &View,
    newest: &View,
    rules: &ChangeRules,
    around: &[Point2<f64>],
) -> Option<TableChange> {
    if source.stamp == newest.stamp {
        return None;
    }
    // The gate refuses a heightmap that cannot be converted.
    let convert = |view: &View| convert::heightmap_from_msg(Heightmap::clone(&view.heightmap)).ok();
    match largest_change(&convert(source)?, &convert(newest)?, rules, around) {
        Ok(change) => change.map(TableChange::Blob),
        Err(_) => Some(TableChange::Workspace),
    }
}

fn contains(heightmap: &Heightmap, x_m: f64, y_m: f64) -> bool {
    let inside = |value: f64, origin: f64, cells: u32| {
        (0.0..f64::from(cells) * heightmap.pixel_size_m).contains(&(value - origin))
    };
    inside(x_m, heightmap.origin.x, heightmap.cols)
        && inside(y_m, heightmap.origin.y, heightmap.rows)
}

/// The age that a node's diagnostics give for an image topic that it hears.
fn image_age(topic: &str, line: &str) -> Option<Option<f64>> {
    if !(topic.ends_with("/image_raw") || topic.ends_with("/image_rect_raw")) {
        return None;
    }
    let words = line.strip_prefix("in ")?.split_whitespace();
    let age = words
        .filter_map(|word| word.strip_prefix("age_s="))
        .next()?;
    Some(age.parse().ok())
}

/// The worst thing that a node says of itself. Drops of single messages are no news to an operator.
fn worst(health: &NodeHealth) -> NodeState<'_> {
    let states = health.states.iter().filter(|(state, _)| *state != "topics");
    let worst = states.max_by_key(|(_, (level, _))| *level);
    let (state, (level, message)) = match worst {
        Some((state, said)) => (state.as_str(), said),
        None => ("", &(0, String::new())),
    };
    NodeState {
        level: *level,
        state,
        message: message.clone(),
    }
}

/// First letter large, full stop at the end.
fn sentence(text: &str) -> String {
    let text = text.trim();
    let mut characters = text.chars();
    let mut sentence: String = characters.next().map_or(String::new(), |first| {
        first.to_uppercase().chain(characters).collect()
    });
    if !sentence.ends_with(['.', '!', '?']) {
        sentence.push('.');
    }
    sentence
}

/// The run, as JSON for the page: docs/operator_console.openapi.yaml explains each field.
#[derive(Debug, Serialize)]
#[allow(missing_docs)]
pub struct Snapshot<'a> {
    pub phase: Phase,
    pub headline: String,
    pub advice: &'static str,
    pub refused: BTreeMap<Decision, Refusal>,
    pub heightmap: Option<ViewState>,
    pub goal: Option<GoalState<'a>>,
    pub proposal: Option<ProposalState<'a>>,
    steps: Vec<StepState<'a>>,
    notices: &'a VecDeque<Notice>,
    streams: Vec<Stream>,
    nodes: BTreeMap<&'a str, NodeState<'a>>,
    robot: &'a Robot,
    joints: Option<BTreeMap<&'a str, f64>>,
    reward: Option<f64>,
    motion: Option<MotionState<'a>>,
    scores: Option<u64>,
    robot_description: bool,
}

/// The planned motion of the present proposal.
#[derive(Debug, Serialize)]
struct MotionState<'a> {
    duration_s: f64,
    /// Why it cannot be planned; empty where it can be.
    reason: &'a str,
}

/// Where a heightmap lies.
#[derive(Debug, Serialize)]
#[allow(missing_docs)]
pub struct ViewState {
    pub number: u64,
    pub stamp_s: f64,
    pub age_s: f64,
    pub rows: u32,
    pub cols: u32,
    pub pixel_size_m: f64,
    pub origin_x_m: f64,
    pub origin_y_m: f64,
    pub coverage: f32,
}

impl ViewState {
    fn of(view: &View) -> Self {
        let Heightmap {
            rows,
            cols,
            pixel_size_m,
            coverage,
            ..
        } = *view.heightmap;
        Self {
            number: view.number,
            stamp_s: view.stamp.as_secs_f64(),
            age_s: 0.0,
            rows,
            cols,
            pixel_size_m,
            origin_x_m: view.heightmap.origin.x,
            origin_y_m: view.heightmap.origin.y,
            coverage,
        }
    }
}

#[derive(Debug, Serialize)]
#[allow(missing_docs)]
pub struct GoalState<'a> {
    problem: &'a str,
    demonstration: &'a str,
    step: u32,
    step_count: u32,
    attempt: u32,
    complete: bool,
    module: &'a str,
    heightmap: Option<ViewState>,
    /// Steps whose image is known, with the number of the image.
    strip: BTreeMap<u32, u64>,
}

/// Where to pick or place, in the world frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pose {
    /// Position along x.
    pub x_m: f64,
    /// Position along y.
    pub y_m: f64,
    /// Turn about z.
    pub yaw_rad: f64,
}

impl Pose {
    fn to_msg(self) -> Pose2D {
        Pose2D {
            x: self.x_m,
            y: self.y_m,
            theta: self.yaw_rad,
        }
    }
}

/// Completes a proposal of the operator's that is made from this heightmap.
fn from_view(view: &View, mut proposal: PickPlace) -> Result<PickPlace, Refusal> {
    for (which, pose) in [("pick", &proposal.pick), ("place", &proposal.place)] {
        let finite = [pose.x, pose.y, pose.theta].into_iter().all(f64::is_finite);
        if !finite || !contains(&view.heightmap, pose.x, pose.y) {
            return Err(Refusal::new(
                format!("The {which} lies outside the workspace."),
                "Choose a place on the picture.",
            ));
        }
    }
    proposal.header = view.heightmap.header.clone();
    proposal.id = correction_id(&proposal, view.stamp);
    Ok(proposal)
}

fn no_picture() -> Refusal {
    Refusal::new(
        "There is no picture of the table yet.",
        "Wait for the cameras.",
    )
}

/// FNV-1a of 64 bits over what makes the proposal what it is, and over a word that no policy's proposal has.
fn correction_id(proposal: &PickPlace, stamp: Duration) -> u64 {
    let PickPlace {
        step,
        attempt,
        pick,
        place,
        ..
    } = proposal;
    let poses = [pick.x, pick.y, pick.theta, place.x, place.y, place.theta];
    let words = [stamp.as_nanos() as u64, (*step).into(), (*attempt).into()]
        .into_iter()
        .chain(poses.map(f64::to_bits))
        .flat_map(u64::to_le_bytes);
    b"operator"
        .iter()
        .copied()
        .chain(words)
        .fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
            (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
        })
}

#[derive(Debug, Serialize)]
#[allow(missing_docs)]
pub struct ProposalState<'a> {
    /// A 64-bit number, which JavaScript's numbers cannot hold.
    id: String,
    step: u32,
    attempt: u32,
    module: &'a str,
    pick: Pose,
    place: Pose,
    pick_score: f32,
    place_score: f32,
    /// Nothing where nothing estimates it.
    success_probability: Option<f32>,
    checkpoint: &'a str,
    author: &'a str,
    stamp_s: f64,
}

impl<'a> ProposalState<'a> {
    fn of(message: &'a PickPlace) -> Self {
        let pose = |pose: &Pose2D| Pose {
            x_m: pose.x,
            y_m: pose.y,
            yaw_rad: pose.theta,
        };
        Self {
            id: message.id.to_string(),
            step: message.step,
            attempt: message.attempt,
            module: &message.module,
            pick: pose(&message.pick),
            place: pose(&message.place),
            pick_score: message.pick_score,
            place_score: message.place_score,
            success_probability: Some(message.success_probability)
                .filter(|probability| (0.0..=1.0).contains(probability)),
            checkpoint: &message.checkpoint,
            author: &message.author,
            stamp_s: duration(&message.header.stamp).map_or(0.0, |stamp| stamp.as_secs_f64()),
        }
    }
}

#[derive(Debug, Serialize)]
struct StepState<'a> {
    number: u64,
    proposal: ProposalState<'a>,
    outcome: &'static str,
    reason: &'a str,
    duration_s: f64,
    decision: Option<Decision>,
    decided_by: &'a str,
    before: Option<u64>,
    after: Option<u64>,
}

impl<'a> StepState<'a> {
    fn of(step: &'a PastStep) -> Self {
        Self {
            number: step.number,
            proposal: ProposalState::of(&step.proposal),
            outcome: outcome_words(step.outcome),
            reason: &step.reason,
            duration_s: step.duration.as_secs_f64(),
            decision: step.decision,
            decided_by: &step.decided_by,
            before: step.before.as_ref().map(|view| view.number),
            after: step.after.as_ref().map(|view| view.number),
        }
    }
}

pub(crate) fn outcome_words(outcome: StepOutcome) -> &'static str {
    match outcome {
        StepOutcome::Placed => "placed",
        StepOutcome::NoContact => "found nothing to pick",
        StepOutcome::GraspFailed => "suction held nothing",
        StepOutcome::Dropped => "lost the object on the way",
        StepOutcome::LagAborted => "stopped: the arm lagged behind",
        StepOutcome::Fault => "broke off by a fault",
        StepOutcome::Stopped => "stopped by the operator",
        StepOutcome::Refused => "refused",
        StepOutcome::Rejected => "rejected",
    }
}

#[derive(Debug, Serialize)]
struct Stream {
    name: String,
    age_s: Option<f64>,
    stale: bool,
    required: bool,
}

#[derive(Debug, Serialize)]
struct NodeState<'a> {
    level: u8,
    state: &'a str,
    message: String,
}

#[cfg(test)]
mod tests;
