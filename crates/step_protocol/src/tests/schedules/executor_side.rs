//! The executor as its node drives it (`nodes/suction_executor/src/node`): the same calls in the same order, without ROS and the arm; and what
//! is known of it from outside. Nothing here moves but by [`ExecutorAction::Begin`].

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use heightmap::ChangeRules;
use pick_place::{Outcome, Phase, PrimitiveSettings};

use super::{Check, GRACE, Message, Party, Setting, World, heightmap, violation};
use crate::{
    CannotBegin, Confirmation, Executor, ExecutorAction, GateRules, InvalidProposal,
    JointPositions, Judgement, MotionCause, MotionEnd, MotionOrder, MotionTimes, Observation,
    Obstacle, OperatorDecision, Proposal, ProposalId, ProposalStatus, Proposed, Recovery,
    RefusalReason, RequireApproval, Reward, RobotState, Said, StepOutcome, StopCause, Verdict,
};

/// A sign of the operator counts for so long.
const PRESENCE_TIMEOUT: Duration = Duration::from_millis(2500);
/// Those who decide, where not everybody does.
const OPERATORS: [&str; 3] = ["operator 0", "operator 1", "terminal 0"];

/// The arm, its driver and the rehearsals.
pub(super) struct Robot {
    pub(super) is_ready: bool,
    /// Where the arm is: 0 at home, where motions begin and end, something else where one was broken off.
    joints: u32,
    holds: bool,
    /// The proposal whose motion was rehearsed from there.
    pub(super) rehearsed: Option<ProposalId>,
}

impl Robot {
    fn joints_rad(&self) -> JointPositions {
        JointPositions::repeat(f64::from(self.joints))
    }
}

impl RobotState for Robot {
    fn obstacle(&self) -> Option<Obstacle> {
        (!self.is_ready).then(|| RefusalReason::SafetyMode.because("is PROTECTIVE_STOP"))
    }

    fn check_motion(&self, proposal: &Proposal) -> Result<(), CannotBegin> {
        match self.rehearsed == Some(proposal.id) {
            true => Ok(()),
            false => Err(CannotBegin::NotRehearsed),
        }
    }

    fn check_recovery(&self, recovery: Recovery) -> Result<JointPositions, CannotBegin> {
        if recovery == Recovery::PutDown && !self.holds {
            let obstacle = RefusalReason::HoldsNothing.because("the gripper holds nothing");
            return Err(CannotBegin::Refused(obstacle));
        }
        Ok(self.joints_rad())
    }
}

/// The motion under way.
pub(super) struct Motion {
    pub(super) order: MotionOrder,
    /// When its first joint reading came, in ROS time.
    begun: Duration,
    /// What has stopped it first.
    stopped: Option<StopCause>,
}

/// The node with its executor, and what has to hold of it.
pub(super) struct ExecutorSide {
    executor: Executor,
    setting: Setting,
    pub(super) robot: Robot,
    pub(super) motion: Option<Motion>,
    /// What outlives the process.
    stop_file: Option<String>,
    /// The goal of the action that a client follows.
    client_goal: Option<ProposalId>,
    /// Whether somebody is there, in truth.
    pub(super) somebody_is_there: bool,
    /// A stop or fault has come, in this process or an earlier one, and no operator has let things go on since.
    stopped: bool,
    /// Operators' approvals that the executor has received and that still count.
    approvals: Vec<ProposalId>,
    /// Proposals that may move without one.
    unasked: Vec<ProposalId>,
    newest: Option<ProposalId>,
    /// What the executor has received first under each id.
    contents: BTreeMap<ProposalId, Proposal>,
    /// Ids under which it has received something else too.
    ambiguous: BTreeSet<ProposalId>,
    /// Goals of the action that have ended: nothing moves for them.
    ended_goals: BTreeSet<ProposalId>,
    /// Until when the last sign of the operator that has arrived counts.
    present_until: Option<Duration>,
    /// The way home that may be approved: the newest, until a stop, a motion, a deactivation or a restart.
    home: Option<(ProposalId, Recovery)>,
    /// Every way home that was proposed.
    pub(super) homes: Vec<ProposalId>,
    /// Proposals that the arm has moved for since the executor was started.
    moved: BTreeSet<ProposalId>,
}

fn executor(setting: Setting, stopped: Option<String>) -> Executor {
    let rules = GateRules {
        frame: "world".into(),
        limits: PrimitiveSettings::RIGID,
        changes: ChangeRules::default(),
        confirmation_grace: GRACE,
        require_approval: setting.require_approval,
        operators: match setting.names_operators {
            true => OPERATORS.map(str::to_owned).to_vec(),
            false => Vec::new(),
        },
    };
    let presence_timeout = setting.require_presence.then_some(PRESENCE_TIMEOUT);
    let mut executor = Executor::new(rules, presence_timeout, stopped);
    executor.activate();
    executor
}

impl ExecutorSide {
    pub(super) fn new(setting: Setting) -> Self {
        Self {
            executor: executor(setting, None),
            setting,
            robot: Robot {
                is_ready: true,
                joints: 0,
                holds: false,
                rehearsed: None,
            },
            motion: None,
            stop_file: None,
            client_goal: None,
            somebody_is_there: true,
            stopped: false,
            approvals: Vec::new(),
            unasked: Vec::new(),
            newest: None,
            contents: BTreeMap::new(),
            ambiguous: BTreeSet::new(),
            ended_goals: BTreeSet::new(),
            present_until: None,
            home: None,
            homes: Vec::new(),
            moved: BTreeSet::new(),
        }
    }

    /// The proposal that the arm moves for.
    pub(super) fn moving(&self) -> Option<ProposalId> {
        match &self.motion.as_ref()?.order {
            MotionOrder::Proposal(proposal) => Some(proposal.id),
            MotionOrder::Home(_) | MotionOrder::PutDown(_) => None,
        }
    }

    /// Nothing that was said before a stop, a fault or a deactivation moves anything.
    fn forget_approvals(&mut self) {
        self.approvals.clear();
        self.unasked.clear();
    }

    fn forget_approvals_of(&mut self, id: ProposalId) {
        self.approvals.retain(|approved| *approved != id);
        self.unasked.retain(|unasked| *unasked != id);
    }

    /// Whether a proposal that has just arrived moves by itself.
    fn moves_unasked(&self, proposal: &Proposal) -> bool {
        let is_allowed = match self.setting.require_approval {
            RequireApproval::Always => false,
            RequireApproval::Never => true,
            RequireApproval::Unsure { threshold } => {
                let success = proposal.success_probability;
                success >= Some(threshold) && proposal.verdict() != Verdict::Done
            }
        };
        is_allowed && !self.stopped
    }

    /// The executor can approve a new proposal: no approval survives a supersession.
    fn note_pending(&mut self, id: ProposalId, proposal: &Proposal) {
        if let Some(superseded) = self.newest.replace(id) {
            self.forget_approvals_of(superseded);
        }
        self.contents.insert(id, proposal.clone());
        if self.moves_unasked(proposal) {
            self.unasked.push(id);
        }
    }

    fn note_again(&mut self, id: ProposalId, proposal: &Result<Proposal, String>) {
        let first = self.contents.get(&id);
        let is_other = first.is_some_and(|first| {
            let again = proposal.as_ref();
            !again.is_ok_and(|again| first.is_same_motion(again))
        });
        if is_other {
            self.ambiguous.insert(id);
        }
    }

    fn counts(&self, confirmation: &Confirmation) -> bool {
        let name = confirmation.operator_name.as_str();
        !self.setting.names_operators || OPERATORS.contains(&name)
    }

    fn is_attended(&self, now: Duration) -> bool {
        !self.setting.require_presence || self.present_until.is_some_and(|until| now < until)
    }

    /// Whether an approval of this one has come, or none is needed; each counts once.
    fn take_approval(&mut self, id: ProposalId) -> Option<ApprovedBy> {
        let mut take = |from: fn(&mut Self) -> &mut Vec<ProposalId>| {
            let from = from(self);
            let index = from.iter().position(|known| *known == id)?;
            Some(from.swap_remove(index))
        };
        if take(|side| &mut side.approvals).is_some() {
            return Some(ApprovedBy::Operator);
        }
        take(|side| &mut side.unasked).map(|_| ApprovedBy::Nobody)
    }

    /// The arm begins to move.
    fn check_begin(&mut self, order: &MotionOrder, now: Duration) -> Check {
        let id = order.cause().id();
        if self.motion.is_some() {
            return violation(format!("{id} moves while the arm moves"));
        }
        if !self.robot.is_ready {
            return violation(format!("{id} moves and the robot is not ready"));
        }
        if !self.is_attended(now) {
            return violation(format!("{id} moves and no operator is present"));
        }
        let Some(by) = self.take_approval(id) else {
            return violation(format!("{id} moves without an approval"));
        };
        let proposal = match order {
            MotionOrder::Proposal(proposal) => proposal,
            MotionOrder::Home(_) => return self.check_home(id, Recovery::Home),
            MotionOrder::PutDown(_) => return self.check_home(id, Recovery::PutDown),
        };
        if self.newest != Some(id) {
            return violation(format!("{id} moves and is not the newest"));
        }
        if self.contents.get(&id) != Some(proposal) || self.ambiguous.contains(&id) {
            return violation(format!("{id} moves otherwise than it was published"));
        }
        if self.robot.rehearsed != Some(id) {
            return violation(format!("{id} moves and was not rehearsed"));
        }
        if self.ended_goals.contains(&id) {
            return violation(format!("{id} moves after its goal has ended"));
        }
        if !self.moved.insert(id) {
            return violation(format!("{id} moves twice"));
        }
        if by == ApprovedBy::Operator {
            self.stopped = false;
        }
        self.home = None;
        Ok(())
    }

    fn check_home(&mut self, id: ProposalId, recovery: Recovery) -> Check {
        match self.home.take() == Some((id, recovery)) {
            true => Ok(()),
            false => violation(format!(
                "{id} moves home after it was withdrawn, or otherwise"
            )),
        }
    }

    /// What has to hold whenever the node waits.
    fn check(&self, now: Duration) -> Check {
        let (executor, motion) = (&self.executor, self.motion.as_ref());
        let goal = executor.goal().map(|goal| goal.id);
        if goal != self.client_goal {
            let client = self.client_goal;
            return violation(format!(
                "the goal is {goal:?}, its client follows {client:?}"
            ));
        }
        let moving = executor.moving();
        if moving != motion.map(|motion| motion.order.cause()) {
            return violation(format!("the executor takes {moving:?} for the motion"));
        }
        if self.stop_file != executor.stop_record() {
            return violation("what the next process has to know is not kept");
        }
        if self.stop_file.is_some() != (self.stopped || motion.is_some()) {
            let text = &self.stop_file;
            let stopped = self.stopped;
            return violation(format!(
                "the next process would be told {text:?}, stopped: {stopped}"
            ));
        }
        if executor.deadline().is_some_and(|deadline| deadline <= now) {
            return violation("the node is woken for nothing, again and again");
        }
        if motion.is_some_and(|motion| motion.stopped.is_none()) && !self.is_attended(now) {
            return violation("the arm moves on, and no operator is present");
        }
        Ok(())
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ApprovedBy {
    Operator,
    Nobody,
}

/// What arrives at the node, and what the node does then.
impl World {
    /// ROS time.
    fn time(&self) -> Duration {
        self.seen.stamp
    }

    pub(super) fn executor_receives(&mut self, message: Message) -> Check {
        match message {
            Message::Heightmap(observation) => {
                let Observation {
                    stamp, heightmap, ..
                } = observation;
                self.cell.executor.on_heightmap(stamp, heightmap);
                self.wake_executor()?;
            }
            Message::Proposal(id, proposal) => self.executor_receives_proposal(id, proposal)?,
            Message::Confirmation(confirmation) => self.confirm(&confirmation)?,
            Message::UnreadableConfirmation(id) => {
                let reason = "decision is 77".to_owned();
                let actions = self.cell.executor.refuse(id, reason);
                self.act_unchanged(actions)?;
            }
            Message::Presence(is_present) => {
                let until = self.now + PRESENCE_TIMEOUT;
                self.cell.present_until = is_present.then_some(until);
                let actions = self.cell.executor.on_presence(is_present, self.now);
                self.act(actions)?;
            }
            _ => {}
        }
        self.check_executor()
    }

    fn executor_receives_proposal(
        &mut self,
        id: ProposalId,
        proposal: Result<Proposal, String>,
    ) -> Check {
        let (cell, now) = (&mut self.cell, self.now);
        let received = proposal.clone();
        let executor = &mut cell.executor;
        let (proposed, actions) = executor.on_proposal(id, proposal, &cell.robot, now);
        match (proposed, &received) {
            (Proposed::Pending, Ok(received)) => cell.note_pending(id, received),
            (Proposed::Pending, Err(_)) => return violation("garbage can be approved"),
            (
                Proposed::Repeated | Proposed::Invalid(InvalidProposal::DifferentContents { .. }),
                _,
            ) => cell.note_again(id, &received),
            (Proposed::Invalid(_), _) => {}
        }
        self.act(actions)
    }

    fn confirm(&mut self, confirmation: &Confirmation) -> Check {
        let (id, decision) = (confirmation.proposal_id, confirmation.decision);
        if Judgement::from_decision(decision).is_some() {
            // For the goal tracker.
            return Ok(());
        }
        let cell = &mut self.cell;
        let counts = cell.counts(confirmation);
        match decision {
            OperatorDecision::Approve if counts => cell.approvals.push(id),
            OperatorDecision::Reject if counts => {
                // One that is not known yet waits behind what came before it.
                if cell.executor.status(id).is_some() {
                    cell.forget_approvals_of(id);
                }
                cell.home.take_if(|(home, _)| *home == id);
            }
            OperatorDecision::Stop => {
                cell.forget_approvals();
                cell.home = None;
                cell.stopped = true;
            }
            _ => {}
        }
        let name = &confirmation.operator_name;
        let executor = &mut cell.executor;
        let actions = executor.on_confirmation(id, decision, name, &cell.robot, self.now);
        if !counts && decision != OperatorDecision::Stop {
            return self.act_unchanged(actions);
        }
        self.act(actions)?;
        match decision {
            OperatorDecision::Stop => self.check_stopping("a stop"),
            _ => Ok(()),
        }
    }

    /// A decision that does not count changes nothing.
    fn act_unchanged(&mut self, actions: Vec<ExecutorAction>) -> Check {
        let (approvals, unasked) = (self.cell.approvals.clone(), self.cell.unasked.clone());
        let goal = self.cell.client_goal;
        self.act(actions)?;
        if self.cell.client_goal != goal {
            return violation("a decision that does not count ends a goal");
        }
        self.cell.approvals = approvals;
        self.cell.unasked = unasked;
        Ok(())
    }

    fn check_stopping(&self, what: &str) -> Check {
        let motion = self.cell.motion.as_ref();
        match motion.is_some_and(|motion| motion.stopped.is_none()) {
            true => violation(format!("{what} does not stop the arm")),
            false => Ok(()),
        }
    }

    /// Time has passed, or something has arrived that a confirmation may wait for.
    fn wake_executor(&mut self) -> Check {
        let cell = &mut self.cell;
        let actions = cell.executor.on_time(&cell.robot, self.now);
        self.act(actions)
    }

    fn check_executor(&mut self) -> Check {
        let deadline = self.cell.executor.deadline();
        if deadline.is_some_and(|deadline| deadline <= self.now) {
            self.wake_executor()?;
        }
        self.cell.check(self.now)
    }

    /// Time goes by; the node wakes when it has asked to.
    pub(super) fn pass_time(&mut self, time: Duration) -> Check {
        let until = self.now + time;
        while let Some(deadline) = self.cell.executor.deadline()
            && deadline <= until
        {
            self.now = self.now.max(deadline);
            self.check_executor()?;
        }
        self.now = until;
        self.wake_executor()?;
        self.check_executor()
    }

    /// A client of the action sends a goal.
    pub(super) fn send_goal(&mut self, proposal: Proposal) -> Check {
        let id = proposal.id;
        let of_id = self.published.entry(id).or_default();
        of_id.push(proposal.clone());
        let cell = &mut self.cell;
        let pending = cell.executor.pending().map(|pending| pending.id);
        let is_known = cell.executor.status(id).is_some();
        let goal = Ok(proposal.clone());
        match cell.executor.on_goal(id, goal, &cell.robot, self.now) {
            Ok(actions) => {
                match is_known {
                    true => cell.note_again(id, &Ok(proposal.clone())),
                    false => cell.note_pending(id, &proposal),
                }
                if is_known && cell.moves_unasked(&proposal) {
                    cell.unasked.push(id);
                }
                if cell.client_goal.replace(id).is_some() {
                    return violation("two goals at a time");
                }
                // The executor does not listen to what it has accepted.
                let message = Message::Proposal(id, Ok(proposal));
                for party in [Party::Tracker, Party::Operator(0), Party::Operator(1)] {
                    self.send(party, message.clone());
                }
                self.act(actions)?;
            }
            Err(said) => {
                cell.note_again(id, &Ok(proposal));
                let after = cell.executor.pending().map(|pending| pending.id);
                if after != pending && !(pending == Some(id) && cell.ambiguous.contains(&id)) {
                    return violation(format!("the rejected goal {id} supersedes another one"));
                }
                let result = said.result(self.time());
                self.publish(Message::Result(result));
            }
        }
        self.check_executor()
    }

    /// The client wants its goal cancelled.
    pub(super) fn cancel_goal(&mut self) -> Check {
        let cell = &mut self.cell;
        let Some(goal) = cell.executor.goal().filter(|goal| !goal.is_cancelled) else {
            return Ok(());
        };
        let actions = cell.executor.on_goal_cancel();
        self.act(actions)?;
        let cell = &self.cell;
        if cell.moving() == Some(goal.id) {
            self.check_stopping("the cancel of its goal")?;
        } else if cell.client_goal.is_some() {
            return violation(format!("goal {} outlives its cancel", goal.id));
        }
        self.check_executor()
    }

    /// Somebody calls for the way home.
    pub(super) fn call_home(&mut self, recovery: Recovery) -> Check {
        // No two calls come at the same time.
        self.now += Duration::from_nanos(1);
        let (time, cell) = (self.time(), &mut self.cell);
        let joints_rad = cell.robot.joints_rad();
        let new = ProposalId::of_recovery(time, self.now, Some(&joints_rad));
        let executor = &mut cell.executor;
        let Ok(proposed) = executor.propose_recovery(new, recovery, &cell.robot, self.now) else {
            return self.check_executor();
        };
        let id = proposed.id;
        if cell.motion.is_some() {
            return violation(format!("{id} is proposed while the arm moves"));
        }
        if id == new {
            cell.homes.push(id);
            cell.home = Some((id, recovery));
        } else if cell.home != Some((id, recovery)) {
            return violation(format!("{id} is proposed again after it was withdrawn"));
        }
        let moves_unasked =
            cell.setting.require_approval == RequireApproval::Never && !cell.stopped;
        if proposed.needs_approval == moves_unasked {
            return violation(format!("{id} needs an approval: {}", !moves_unasked));
        }
        if moves_unasked {
            cell.unasked.push(id);
        }
        self.act(proposed.actions)?;
        self.check_executor()
    }

    fn act(&mut self, actions: Vec<ExecutorAction>) -> Check {
        self.cell.stop_file = self.cell.executor.stop_record();
        let mut pending = BTreeMap::new();
        for action in actions {
            match action {
                ExecutorAction::Begin(order) => {
                    self.cell.check_begin(&order, self.now)?;
                    if let MotionCause::Proposal(id) = order.cause() {
                        self.moved.insert(id);
                    }
                    self.cell.motion = Some(Motion {
                        order,
                        begun: self.time(),
                        stopped: None,
                    });
                }
                ExecutorAction::Stop(cause) => match &mut self.cell.motion {
                    Some(motion) => drop(motion.stopped.get_or_insert(cause)),
                    None => return violation("a stop while nothing moves"),
                },
                ExecutorAction::Say(said) => {
                    let report = &said.report;
                    pending.insert(report.id, report.status == Some(ProposalStatus::Pending));
                    self.say(said)?;
                }
                ExecutorAction::AwaitApproval(id) => {
                    if self.cell.client_goal != Some(id) || self.cell.unasked.contains(&id) {
                        return violation(format!("the client of {id} waits for nothing"));
                    }
                }
            }
        }
        let cell = &self.cell;
        let can_be_approved = |id: ProposalId| {
            let newest = cell.executor.pending().map(|pending| pending.id);
            let home = cell.home.map(|(home, _)| home);
            let moving = cell.executor.moving().map(MotionCause::id);
            [newest, home, moving].contains(&Some(id))
        };
        let mut pending = pending.into_iter().filter(|(_, is_pending)| *is_pending);
        match pending.find(|(id, _)| !can_be_approved(*id)) {
            Some((id, _)) => violation(format!("{id} is said to be pending and is not")),
            None => Ok(()),
        }
    }

    fn say(&mut self, said: Said) -> Check {
        let (time, cell) = (self.time(), &mut self.cell);
        let id = said.report.id;
        // One word answers one approval.
        if said.report.outcome == StepOutcome::Refused {
            cell.take_approval(id);
        }
        if said.ends_goal {
            if cell.client_goal.take() != Some(id) {
                return violation(format!("the word on {id} ends another goal"));
            }
            cell.ended_goals.insert(id);
            cell.forget_approvals_of(id);
        }
        self.publish(Message::Result(said.result(time)));
        Ok(())
    }

    /// The scene after a motion: time has gone on, and something may have changed.
    pub(super) fn move_scene(&mut self, change_m: f32) {
        self.seen.stamp += Duration::from_secs(1);
        if change_m != 0.0 {
            self.seen.heightmap = heightmap(self.seen.heightmap.height_m[0] + change_m);
        }
    }

    /// The motion ends in this way, or where it was stopped, mostly by that.
    pub(super) fn end_motion(&mut self, way: usize) -> Check {
        let ways = [
            (Outcome::Placed, 1.0),
            (Outcome::Placed, 0.0),
            (Outcome::Placed, -1.0),
            (Outcome::GraspFailed, 0.0),
            (Outcome::NoContact, 0.0),
            (Outcome::Dropped, 0.0),
            (Outcome::LagAborted, 0.0),
        ];
        let Some(Motion {
            order,
            begun,
            stopped,
        }) = self.cell.motion.take()
        else {
            return Ok(());
        };
        let is_proposal = matches!(order, MotionOrder::Proposal(_));
        let stopped_late = way / 16 % 4 == 3;
        let (end, delta_reward) = match ways.get(way % 9) {
            _ if stopped.is_some() && !stopped_late => (MotionEnd::Stopped(Phase::Lift), 0.0),
            Some((outcome, delta)) if is_proposal => (MotionEnd::Done(Some(*outcome)), *delta),
            Some(_) => (MotionEnd::Done(None), 0.0),
            // By the enabling input.
            None if way % 9 == 7 => (MotionEnd::Stopped(Phase::Transfer), 0.0),
            None => (MotionEnd::Failed("lost".to_owned()), 0.0),
        };
        let is_placed = end == MotionEnd::Done(Some(Outcome::Placed));
        let is_measured = matches!(end, MotionEnd::Done(Some(_)));
        let is_broken_off = !matches!(end, MotionEnd::Done(_));
        self.move_scene(if is_placed || delta_reward != 0.0 {
            0.1
        } else {
            0.0
        });
        let until = self.time();
        let cell = &mut self.cell;
        cell.robot.rehearsed = None;
        if is_broken_off {
            cell.forget_approvals();
            cell.stopped = true;
            cell.robot.joints += 1;
            cell.robot.holds = true;
        } else {
            cell.robot.joints = 0;
            cell.robot.holds &= matches!(order, MotionOrder::Home(_));
        }
        let times = MotionTimes::new(Some((begun, until)), until);
        let executor = &mut cell.executor;
        let actions = executor.on_motion_end(end, times, &cell.robot, self.now);
        self.act(actions)?;
        if let MotionOrder::Proposal(proposal) = &order
            && is_measured
        {
            let complete = self.fair && proposal.step as usize == super::GOALS;
            self.publish(Message::Reward(Reward {
                stamp: until,
                delta: delta_reward,
                total: 0.0,
                complete,
            }));
        }
        self.publish(Message::Heightmap(self.seen.clone()));
        self.check_executor()
    }

    /// The node is deactivated, which stops what moves, and activated.
    pub(super) fn deactivate(&mut self, way: usize) -> Check {
        let cause = match way % 2 {
            0 => StopCause::Deactivated,
            _ => StopCause::Shutdown,
        };
        let cell = &mut self.cell;
        cell.forget_approvals();
        cell.home = None;
        let actions = cell.executor.deactivate(cause);
        self.act(actions)?;
        self.check_stopping("a deactivation")?;
        self.end_motion(way)?;
        // While it is inactive the action is not served.
        let cell = &mut self.cell;
        cell.ended_goals.extend(cell.client_goal.take());
        cell.present_until = None;
        cell.executor.activate();
        // Subscriptions are made anew.
        self.inbox(Party::Executor).clear();
        self.send_latched(Party::Executor);
        self.check_executor()
    }

    /// The process is killed and started again. The watchdog stops the arm; nobody reports a result.
    pub(super) fn restart_executor(&mut self) {
        let cell = &mut self.cell;
        cell.executor = executor(cell.setting, cell.stop_file.clone());
        cell.robot.rehearsed = None;
        cell.client_goal = None;
        cell.forget_approvals();
        cell.newest = None;
        cell.contents.clear();
        cell.ambiguous.clear();
        cell.ended_goals.clear();
        cell.present_until = None;
        cell.home = None;
        cell.moved.clear();
        if cell.motion.take().is_some() {
            cell.stopped = true;
            cell.robot.joints += 1;
            self.move_scene(0.0);
        }
    }

    /// The pending proposal, where it is to be rehearsed. A rehearsal may end while the arm moves for what was pending before.
    pub(super) fn unrehearsed(&self) -> Option<ProposalId> {
        let cell = &self.cell;
        let pending = cell.executor.pending().map(|pending| pending.id);
        pending.filter(|_| pending != cell.robot.rehearsed)
    }

    pub(super) fn rehearse(&mut self) -> Check {
        let rehearsed = self.unrehearsed().or(self.cell.robot.rehearsed);
        self.cell.robot.rehearsed = rehearsed;
        self.wake_executor()?;
        self.check_executor()
    }
}
