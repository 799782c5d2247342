//! What the executor decides around its gate: the goal of its action, whether an operator has to be present, what moves, and what has
//! stopped it.

use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::sync::Arc;
use std::time::Duration;

use heightmap::Heightmap;

use crate::action_goal::ActionGoal;
use crate::mutation::{Mutation, planted};
use crate::{
    ApprovalGate, CannotBegin, GateAction, GateRules, JointPositions, MotionCause, MotionEnd,
    MotionOrder, MotionTimes, MotionWord, Obstacle, OperatorDecision, Presence, Proposal,
    ProposalId, ProposalStatus, Proposed, Recovery, RefusalReason, Report, RobotState, StepOutcome,
    StepResult, StopCause, StopRecord,
};

/// What the executor is to do, in this order.
#[derive(Clone, Debug, PartialEq)]
pub enum ExecutorAction {
    /// Move; [`Executor::on_motion_end`] has to follow.
    Begin(MotionOrder),
    /// Stop the motion under way, for this reason.
    Stop(StopCause),
    /// Publish this.
    Say(Said),
    /// Tell the client of the goal for this proposal that it waits for an approval.
    AwaitApproval(ProposalId),
}

/// The executor's word on a proposal.
#[derive(Clone, Debug, PartialEq)]
pub struct Said {
    /// What became of it.
    pub report: Report,
    /// Times of its motion, where that has ended.
    pub motion: Option<MotionTimes>,
    /// Whether the goal of the action ends with it.
    pub ends_goal: bool,
}

impl Said {
    /// The result to publish; `now` in ROS time.
    pub fn result(self, now: Duration) -> StepResult {
        let at_once = MotionTimes {
            until: now,
            duration: Duration::ZERO,
        };
        let MotionTimes { until, duration } = self.motion.unwrap_or(at_once);
        StepResult {
            stamp: until,
            proposal_id: self.report.id,
            outcome: self.report.outcome,
            reason: self.report.reason,
            duration,
            status: self.report.status,
        }
    }
}

/// A way home that was proposed.
#[derive(Clone, Debug, PartialEq)]
pub struct ProposedRecovery {
    /// Its proposal.
    pub id: ProposalId,
    /// Whether it moves only when somebody approves it.
    pub needs_approval: bool,
    /// What to do now.
    pub actions: Vec<ExecutorAction>,
}

/// The motion under way.
#[derive(Clone, Copy, Debug)]
struct Motion {
    cause: MotionCause,
    /// What has stopped it first.
    stopped: Option<StopCause>,
}

/// The robot as the gate sees it: without an operator nothing may begin to move where one has to be present.
struct Attended<'a, R> {
    robot: &'a R,
    is_absent: bool,
}

impl<R: RobotState> RobotState for Attended<'_, R> {
    fn obstacle(&self) -> Option<Obstacle> {
        let absent = "no operator is present (require_presence)";
        let absent = self
            .is_absent
            .then(|| RefusalReason::NobodyPresent.because(absent));
        absent.or_else(|| self.robot.obstacle())
    }

    fn check_motion(&self, proposal: &Proposal) -> Result<(), CannotBegin> {
        self.robot.check_motion(proposal)
    }

    fn check_recovery(&self, recovery: Recovery) -> Result<JointPositions, CannotBegin> {
        self.robot.check_recovery(recovery)
    }
}

/// Everything that the executor decides. All times are passed in: `now` is monotonic, those of motions are ROS time. What was used or
/// stopped stays so while the node is inactive.
///
/// The only way to [`ExecutorAction::Begin`] is through the [`ApprovalGate`].
#[derive(Debug)]
pub struct Executor {
    gate: ApprovalGate,
    /// A sign of the operator counts for so long; none where nobody has to be present.
    presence_timeout: Option<Duration>,
    presence: Option<Presence>,
    goal: Option<ActionGoal>,
    motion: Option<Motion>,
    stops: StopRecord,
}

impl Executor {
    /// `presence_timeout`: where an operator has to be present, a sign counts for so long. `stopped`: what has stopped the process before, where
    /// something has.
    pub fn new(
        rules: GateRules,
        presence_timeout: Option<Duration>,
        stopped: Option<String>,
    ) -> Self {
        let mut gate = ApprovalGate::new(rules);
        if stopped.is_some() {
            gate.remember_stop();
        }
        Self {
            gate,
            presence_timeout,
            presence: presence_timeout.map(Presence::new),
            goal: None,
            motion: None,
            stops: StopRecord::new(stopped),
        }
    }

    /// The node becomes active: nobody was heard yet, and goals of before have ended.
    pub fn activate(&mut self) {
        self.presence = self.presence_timeout.map(Presence::new);
        self.motion = None;
        if let Some(goal) = self.goal.take()
            && !planted(Mutation::DeactivatedGoalStaysPending)
        {
            self.gate.withdraw(goal.id);
        }
    }

    /// The node is deactivated: no approval from before may move anything later, and what moves is stopped.
    pub fn deactivate(&mut self, cause: StopCause) -> Vec<ExecutorAction> {
        self.gate.deactivate();
        self.stop(cause)
    }

    /// What the next process has to know, should this one end now.
    pub fn stop_record(&self) -> Option<String> {
        self.stops.text()
    }

    /// The proposal that can be approved, the way home apart.
    pub fn pending(&self) -> Option<&Proposal> {
        self.gate.pending()
    }

    /// Where a proposal stands.
    pub fn status(&self, id: ProposalId) -> Option<ProposalStatus> {
        self.gate.status(id)
    }

    /// What moves the arm.
    pub fn moving(&self) -> Option<MotionCause> {
        self.motion.map(|motion| motion.cause)
    }

    /// The goal of the action that has not ended.
    pub fn goal(&self) -> Option<ActionGoal> {
        self.goal
    }

    /// When [`Self::on_time`] has to be called at the latest.
    pub fn deadline(&self) -> Option<Duration> {
        let deadlines = [self.gate.deadline(), self.absence()];
        deadlines.into_iter().flatten().min()
    }

    /// Time has passed, or something has arrived that a confirmation may wait for.
    pub fn on_time(&mut self, robot: &impl RobotState, now: Duration) -> Vec<ExecutorAction> {
        let mut actions = self.stop_unattended(now);
        let answers = self.gate.on_news(&self.attended(robot, now), now);
        actions.extend(self.act(answers));
        actions
    }

    /// The console has said whether the operator is present.
    pub fn on_presence(&mut self, is_present: bool, now: Duration) -> Vec<ExecutorAction> {
        if let Some(presence) = &mut self.presence {
            presence.on_message(is_present, now);
        }
        self.stop_unattended(now)
    }

    /// Takes the newest observation; [`Self::on_time`] has to follow.
    pub fn on_heightmap(&mut self, stamp: Duration, heightmap: Arc<Heightmap>) {
        self.gate.on_heightmap(stamp, heightmap);
    }

    /// Takes a proposal, or what is wrong with the message of that id.
    pub fn on_proposal(
        &mut self,
        id: ProposalId,
        proposal: Result<Proposal, String>,
        robot: &impl RobotState,
        now: Duration,
    ) -> (Proposed, Vec<ExecutorAction>) {
        let proposed = self.gate.on_proposal(id, proposal);
        let mut actions = match &proposed {
            Proposed::Pending if self.gate.moves_unasked(id) => self.approve(id, robot, now),
            // Nobody looks at it before.
            Proposed::Invalid(reason) if self.gate.is_automatic() => {
                vec![self.say(self.refusal(id, reason.to_string()), None)]
            }
            Proposed::Pending | Proposed::Repeated | Proposed::Invalid(_) => Vec::new(),
        };
        actions.extend(self.end_refused_goal());
        actions.extend(self.on_time(robot, now));
        (proposed, actions)
    }

    /// Takes a goal of the action. It is a proposal whose way its client follows, and goes through the same gate.
    ///
    /// # Errors
    /// The goal is to be rejected, and this to be published.
    pub fn on_goal(
        &mut self,
        id: ProposalId,
        proposal: Result<Proposal, String>,
        robot: &impl RobotState,
        now: Duration,
    ) -> Result<Vec<ExecutorAction>, Said> {
        if let Err(reason) = self.accept_goal(id, proposal) {
            let reason = format!("goal for proposal {id} rejected: {reason}");
            return Err(Said {
                report: self.refusal(id, reason),
                motion: None,
                ends_goal: false,
            });
        }
        self.goal = Some(ActionGoal::new(id));
        let moves = self.gate.moves_unasked(id) || planted(Mutation::GoalMovesUnasked);
        let mut actions = match moves {
            true => self.approve(id, robot, now),
            false => vec![ExecutorAction::AwaitApproval(id)],
        };
        actions.extend(self.on_time(robot, now));
        Ok(actions)
    }

    fn accept_goal(
        &mut self,
        id: ProposalId,
        proposal: Result<Proposal, String>,
    ) -> Result<(), String> {
        if let Some(goal) = &self.goal {
            return Err(format!("a goal for proposal {} is active", goal.id));
        }
        if let Some(motion) = &self.motion {
            return Err(motion.cause.busy_text());
        }
        if let Proposed::Invalid(reason) = self.gate.on_proposal(id, proposal) {
            return Err(reason.to_string());
        }
        let pending = self.gate.check_pending(id);
        pending.map_err(|refusal| refusal.to_string())
    }

    /// The client of the goal wants it cancelled.
    pub fn on_goal_cancel(&mut self) -> Vec<ExecutorAction> {
        let Some(goal) = &mut self.goal else {
            return Vec::new();
        };
        goal.is_cancelled = true;
        let ActionGoal { id, is_moving, .. } = *goal;
        if is_moving && self.motion.is_some() {
            if planted(Mutation::CancelStopsNothing) {
                return Vec::new();
            }
            return self.stop(StopCause::GoalCancelled);
        }
        self.gate.withdraw(id);
        let reason = "the goal was cancelled; nothing was moving".to_owned();
        let stopped = Report {
            outcome: StepOutcome::Stopped,
            ..self.refusal(id, reason)
        };
        vec![self.say(stopped, None)]
    }

    /// Takes somebody's decision on a proposal.
    pub fn on_confirmation(
        &mut self,
        id: ProposalId,
        decision: OperatorDecision,
        operator_name: &str,
        robot: &impl RobotState,
        now: Duration,
    ) -> Vec<ExecutorAction> {
        if let Err(refusal) = self.gate.check_operator(id, decision, operator_name)
            && !planted(Mutation::StrangerDecides)
        {
            return self.refuse(id, refusal.to_string());
        }
        self.confirm(id, decision, robot, now)
    }

    /// Refuses what was said of a proposal. It counts for nothing: no goal ends with it.
    pub fn refuse(&mut self, id: ProposalId, reason: String) -> Vec<ExecutorAction> {
        let report = self.refusal(id, reason);
        if planted(Mutation::UncountedDecisionEndsGoal) {
            return vec![self.say(report, None)];
        }
        vec![ExecutorAction::Say(Said {
            report,
            motion: None,
            ends_goal: false,
        })]
    }

    /// Proposes what brings the arm home; `new` is for a new proposal.
    ///
    /// # Errors
    /// Says why there is no way home now, or that it has to be rehearsed first.
    pub fn propose_recovery(
        &mut self,
        new: ProposalId,
        recovery: Recovery,
        robot: &impl RobotState,
        now: Duration,
    ) -> Result<ProposedRecovery, CannotBegin> {
        let attended = self.attended(robot, now);
        let id = self.gate.propose_home(new, recovery, &attended)?;
        let needs_approval = !self.gate.moves_unasked(id);
        let actions = match needs_approval {
            true => Vec::new(),
            false => self.approve(id, robot, now),
        };
        Ok(ProposedRecovery {
            id,
            needs_approval,
            actions,
        })
    }

    /// A motion begins. [`ExecutorAction::Begin`] is noted here already; a planted fault, which moves past the gate, calls it itself.
    pub fn on_motion_begin(&mut self, cause: MotionCause) {
        let is_proposal = matches!(cause, MotionCause::Proposal(_));
        if is_proposal && let Some(goal) = &mut self.goal {
            goal.is_moving = goal.id == cause.id();
        }
        let lets_go_on = is_proposal || planted(Mutation::HomeClearsStop);
        self.stops.begin(cause.name(), lets_go_on);
        self.motion = Some(Motion {
            cause,
            stopped: None,
        });
    }

    /// The motion under way has ended.
    pub fn on_motion_end(
        &mut self,
        end: MotionEnd,
        times: MotionTimes,
        robot: &impl RobotState,
        now: Duration,
    ) -> Vec<ExecutorAction> {
        let Some(Motion { cause, stopped }) = self.motion.take() else {
            return Vec::new();
        };
        let MotionWord {
            outcome,
            reason,
            broken_off,
        } = end.word(cause, stopped);
        let is_broken_off = broken_off.is_some();
        if let Some(reason) = broken_off {
            self.stops.stop(reason);
        }
        self.stops.end();
        let is_stop = is_broken_off && !planted(Mutation::FaultIsNoStop);
        let answers = self.gate.finish(times.until, is_stop);
        let id = cause.id();
        let report = Report {
            id,
            outcome,
            reason,
            status: self.gate.status(id),
        };
        let mut actions = vec![self.say(report, Some(times))];
        actions.extend(self.act(answers));
        actions.extend(self.on_time(robot, now));
        actions
    }

    fn attended<'a, R: RobotState>(&self, robot: &'a R, now: Duration) -> Attended<'a, R> {
        let presence = self.presence.as_ref();
        let is_absent = presence.is_some_and(|presence| !presence.is_present(now));
        Attended {
            robot,
            is_absent: is_absent && !planted(Mutation::MovesUnattended),
        }
    }

    /// When the motion under way is to stop because nobody is present.
    fn absence(&self) -> Option<Duration> {
        let presence = self.presence.as_ref()?;
        let is_watched = self.motion?.stopped.is_none() && !planted(Mutation::AbsenceStopsNothing);
        is_watched.then(|| presence.deadline().unwrap_or(Duration::ZERO))
    }

    fn stop_unattended(&mut self, now: Duration) -> Vec<ExecutorAction> {
        match self.absence().is_some_and(|absence| absence <= now) {
            true => self.stop(StopCause::NobodyPresent),
            false => Vec::new(),
        }
    }

    /// Stops the motion under way, if there is one.
    fn stop(&mut self, cause: StopCause) -> Vec<ExecutorAction> {
        let motion = self.motion.as_mut();
        let stopped = motion.map(|motion| *motion.stopped.get_or_insert(cause));
        stopped.map(ExecutorAction::Stop).into_iter().collect()
    }

    fn approve(
        &mut self,
        id: ProposalId,
        robot: &impl RobotState,
        now: Duration,
    ) -> Vec<ExecutorAction> {
        self.confirm(id, OperatorDecision::Approve, robot, now)
    }

    fn confirm(
        &mut self,
        id: ProposalId,
        decision: OperatorDecision,
        robot: &impl RobotState,
        now: Duration,
    ) -> Vec<ExecutorAction> {
        if decision == OperatorDecision::Stop && !planted(Mutation::StopIsNotRecorded) {
            self.stops
                .stop(format!("{} of proposal {id}", decision.name()));
        }
        let attended = self.attended(robot, now);
        let answers = self.gate.on_confirmation(id, decision, &attended, now);
        self.act(answers)
    }

    fn act(&mut self, answers: Vec<GateAction>) -> Vec<ExecutorAction> {
        let mut actions = Vec::new();
        for answer in answers {
            match answer {
                GateAction::Move(proposal) => {
                    actions.push(self.begin(MotionOrder::Proposal(proposal)));
                }
                GateAction::GoHome(id) => actions.push(self.begin(MotionOrder::Home(id))),
                GateAction::PutDown(id) if planted(Mutation::PutDownGoesHome) => {
                    actions.push(self.begin(MotionOrder::Home(id)));
                }
                GateAction::PutDown(id) => actions.push(self.begin(MotionOrder::PutDown(id))),
                GateAction::Cancel => actions.extend(self.stop(StopCause::Operator)),
                GateAction::Report(report) => actions.push(self.say(report, None)),
            }
        }
        actions.extend(self.end_refused_goal());
        actions
    }

    fn begin(&mut self, order: MotionOrder) -> ExecutorAction {
        self.on_motion_begin(order.cause());
        ExecutorAction::Begin(order)
    }

    /// A refusal with where the proposal stands.
    fn refusal(&self, id: ProposalId, reason: String) -> Report {
        Report {
            id,
            outcome: StepOutcome::Refused,
            reason,
            status: self.gate.final_status(id),
        }
    }

    fn say(&mut self, mut report: Report, motion: Option<MotionTimes>) -> ExecutorAction {
        let is_of_motion = motion.is_some();
        let ended = self
            .goal
            .take_if(|goal| goal.ends_with(report.id, is_of_motion));
        if let Some(goal) = ended
            && !planted(Mutation::EndedGoalStaysPending)
        {
            // Nothing moves for a goal that has ended.
            self.gate.withdraw(goal.id);
        }
        // What came after this word, in the gate's answer too, may have changed it.
        if !planted(Mutation::StatusIsOutdated) {
            report.status = self.gate.final_status(report.id);
        }
        ExecutorAction::Say(Said {
            report,
            motion,
            ends_goal: ended.is_some(),
        })
    }

    /// Ends a goal whose proposal can no longer be approved.
    fn end_refused_goal(&mut self) -> Option<ExecutorAction> {
        let goal = self.goal.filter(|goal| !goal.is_moving)?;
        let refusal = self.gate.check_pending(goal.id).err()?;
        Some(self.say(self.refusal(goal.id, refusal.to_string()), None))
    }
}

impl ProposalId {
    /// An id for a new way home: of the time, of ROS and monotonic, and of where the arm stands (rad).
    pub fn of_recovery(time: Duration, now: Duration, joints_rad: Option<&JointPositions>) -> Self {
        let mut hash = DefaultHasher::new();
        (time, now).hash(&mut hash);
        for position_rad in joints_rad.into_iter().flatten() {
            position_rad.to_bits().hash(&mut hash);
        }
        Self(hash.finish())
    }
}
