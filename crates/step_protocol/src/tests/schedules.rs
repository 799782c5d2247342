//! All machines together under random schedules: messages delayed, repeated, reordered and lost, garbage in between, any
//! party started again, two operators, each a program that answers questions or a person at a page, goals of the executor's action, stops
//! and faults.
//!
//! `SCHEDULES=1000000 SEED=7 cargo test --release -p step_protocol schedules -- --nocapture`

mod executor_side;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use heightmap::{ChangeRules, Heightmap, Workspace};
use nalgebra::{Isometry2, Point2, Vector2};
use pick_place::{PickPlace, PrimitiveSettings};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::mutation::{Mutation, plant};
use crate::{
    Change, Confirmation, ConfirmationRefusal, Coverage, Goal, GoalSequence, GoalTracker, Job,
    Judgement, Observation, Operator, OperatorDecision, PlannerRules, Prediction, Proposal,
    ProposalId, ProposalPlanner, ProposalStatus, Question, Recovery, RefusalKind, RequireApproval,
    Reward, RunPhase, ShownStep, StepJudge, StepOutcome, StepResult, goals_of,
};
use executor_side::ExecutorSide;

const WORKSPACE: Workspace = Workspace {
    origin_m: Point2::new(0.25, -0.2),
    rows: 2,
    cols: 2,
    pixel_size_m: 0.2,
    z_min_m: -0.002,
    z_max_m: 10.0,
};
const GOALS: usize = 3;
const GRACE: Duration = Duration::from_secs(1);
/// Messages on their way to one party; the oldest is lost where more come.
const INBOX: usize = 24;
/// Actions of a schedule.
const ACTIONS: usize = 48;
/// A run that has not ended after so many quiet moments hangs.
const QUIET_MOMENTS: usize = 200;

/// Who receives messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Party {
    Tracker,
    Planner,
    Executor,
    Operator(usize),
}

const PARTIES: [Party; 5] = [
    Party::Tracker,
    Party::Planner,
    Party::Executor,
    Party::Operator(0),
    Party::Operator(1),
];

#[derive(Clone, Debug)]
enum Message {
    Heightmap(Observation),
    Goal(Goal),
    /// A message of this id that cannot be read is `Err`.
    Proposal(ProposalId, Result<Proposal, String>),
    Confirmation(Confirmation),
    ConfirmationRefused(ProposalId, RefusalKind),
    Result(StepResult),
    Reward(Reward),
    /// A decision on this proposal that cannot be read.
    UnreadableConfirmation(ProposalId),
    /// Whether an operator is present.
    Presence(bool),
}

/// One thing that happens. Numbers are taken modulo what there is to choose from, so that any part of a schedule is one.
#[derive(Clone, Copy, Debug)]
enum Action {
    /// The oldest message to a party arrives.
    Deliver(usize),
    /// A message to a party arrives before older ones.
    Overtake(usize, usize),
    /// A message to a party arrives, and will once more.
    Repeat(usize, usize),
    /// A message to a party is lost.
    Lose(usize, usize),
    /// A party is killed and started again.
    Restart(usize),
    /// The executor is deactivated and activated; what moves ends so.
    Deactivate(usize),
    /// The network answers.
    Predict,
    /// The executor has rehearsed the pending proposal.
    Rehearse,
    /// The motion ends so.
    EndMotion(usize),
    /// The cameras publish: the same heightmap, a newer one, a changed one.
    Observe(usize),
    /// An operator decides without being asked, on a proposal that was published or on none.
    Decide(usize, usize, usize),
    /// The person at a page looks at it, and decides what it asks, so or so.
    Look(usize, usize),
    /// Somebody else publishes a proposal.
    Foreign(usize),
    /// Time goes by.
    Tick,
    /// Somebody sets the step.
    SetStep(usize),
    /// The robot is ready or not.
    Obstacle(bool),
    /// Somebody calls for the way home, or to put down what is held.
    Home(Recovery),
    /// A client of the executor's action sends a goal, good or not.
    SendGoal(usize),
    /// It wants its goal cancelled.
    CancelGoal,
    /// The operator comes or goes.
    Presence(bool),
    /// A decision cannot be read.
    Garble(usize),
}

impl Action {
    fn random(rng: &mut impl Rng) -> Self {
        let number = |next: &mut dyn FnMut() -> u32| next() as usize % 240;
        let mut next = || rng.random::<u32>();
        let party = number(&mut next);
        let which = number(&mut next);
        let other = number(&mut next);
        match next() % 106 {
            0..45 => Self::Deliver(party),
            45..50 => Self::Overtake(party, which),
            50..54 => Self::Repeat(party, which),
            54..57 => Self::Lose(party, which),
            57..60 => Self::Restart(party),
            60 => Self::Deactivate(which),
            61..67 => Self::Predict,
            67..70 => Self::Rehearse,
            70..77 => Self::EndMotion(which),
            77..82 => Self::Observe(which),
            82..87 => Self::Look(party, which),
            87..91 => Self::Decide(party, which, other),
            91..94 => Self::Foreign(which),
            94..96 => Self::Tick,
            96 => Self::SetStep(which),
            97 => Self::Obstacle(which % 3 == 0),
            98..100 if other.is_multiple_of(2) => Self::Home(Recovery::PutDown),
            98..100 => Self::Home(Recovery::Home),
            100..103 => Self::SendGoal(which),
            103 => Self::CancelGoal,
            104 => Self::Presence(!which.is_multiple_of(4)),
            _ => Self::Garble(which),
        }
    }
}

/// What must not happen.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Violation(String);

impl fmt::Display for Violation {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.0)
    }
}

type Check = Result<(), Violation>;

fn violation<T>(text: impl Into<String>) -> Result<T, Violation> {
    Err(Violation(text.into()))
}

/// The whole graph, and what is known of it from outside.
struct World {
    tracker: GoalTracker,
    planner: ProposalPlanner,
    /// The executor's node and the arm.
    cell: ExecutorSide,
    operators: [Operator; 2],
    /// Which of them are people at a page.
    at_page: [bool; 2],
    /// The proposals that each has heard to be refused.
    refused: [BTreeSet<ProposalId>; 2],
    inboxes: [VecDeque<Message>; 5],
    job: Option<Job>,
    /// Monotonic time.
    now: Duration,
    /// Whether stamps advance while nothing moves, as on a real cell.
    clock_runs: bool,
    seen: Observation,
    /// The newest of each latched topic, for parties that start.
    latched_goal: Option<Goal>,
    latched_proposals: [Option<Proposal>; 2],
    /// Everything that was published under an id.
    published: BTreeMap<ProposalId, Vec<Proposal>>,
    foreign_count: u64,
    /// Proposals that the arm has moved for.
    moved: BTreeSet<ProposalId>,
    /// Decisions that the tracker has accepted and that have not counted yet.
    queued: BTreeMap<ProposalId, Judgement>,
    /// Decisions that have counted at this tracker.
    counted: BTreeSet<ProposalId>,
    /// The planner has heard that this proposal of its own is approved, and nothing since.
    approved_at_planner: Option<ProposalId>,
    own_proposal: Option<ProposalId>,
    /// Messages are lost no more: rewards are those of motions that succeed.
    fair: bool,
}

fn tracker() -> GoalTracker {
    let image = |height_m| heightmap(height_m);
    let shown = |index: usize| ShownStep {
        delta_reward: 1.0,
        module: "m".to_owned(),
        settings: PrimitiveSettings::RIGID,
        after: image(1.0 + index as f32),
    };
    let steps: Vec<_> = (0..GOALS).map(shown).collect();
    let sequence = goals_of("p", "p/1", image(0.0), &steps);
    let sequence = sequence.unwrap_or_else(|_| GoalSequence::default());
    GoalTracker::new(sequence, StepJudge::Operator)
}

fn planner() -> ProposalPlanner {
    ProposalPlanner::new(PlannerRules {
        changes: ChangeRules::default(),
        rejected_radius_m: 0.02,
        checkpoint: String::new(),
        author: "planner".into(),
    })
}

fn heightmap(height_m: f32) -> Arc<Heightmap> {
    let mut heightmap = Heightmap::new(WORKSPACE);
    heightmap.rgb.fill(100);
    heightmap.height_m.fill(height_m);
    Arc::new(heightmap)
}

/// What a network says that picks the first place that is not left out.
fn predict(job: &Job) -> Result<Prediction, String> {
    let candidate = |index: i32| {
        let (row, col) = (f64::from(index / 70), f64::from(index % 70));
        Point2::new(0.26 + 0.005 * col, -0.15 + 0.05 * row)
    };
    let mut candidates = (0..490).map(candidate);
    let free = |point: &Point2<f64>| {
        let mut disks = job.exclude.iter();
        disks.all(|disk| (disk.center_m - point).norm() > disk.radius_m)
    };
    let pick = candidates.find(free);
    let pick = pick.ok_or("nothing is left to pick")?;
    Ok(Prediction {
        pick: Isometry2::new(pick.coords, 0.0),
        place: Isometry2::new(Vector2::new(0.5, -0.1), 1.0),
        pick_score: 1.0,
        place_score: 1.0,
        // The policy is sure of its first thought.
        success_probability: Some(if job.exclude.is_empty() { 0.9 } else { 0.3 }),
        done_probability: None,
    })
}

impl World {
    fn new(setting: Setting) -> Self {
        let Setting {
            clock_runs,
            at_page,
            ..
        } = setting;
        let mut world = Self {
            tracker: tracker(),
            planner: planner(),
            cell: ExecutorSide::new(setting),
            operators: at_page.map(|at_page| Operator::new(!at_page)),
            at_page,
            refused: Default::default(),
            inboxes: Default::default(),
            job: None,
            now: Duration::ZERO,
            clock_runs,
            seen: Observation {
                stamp: Duration::from_secs(1),
                frame: "world".into(),
                heightmap: heightmap(0.0),
                coverage: Coverage::default(),
            },
            latched_goal: None,
            latched_proposals: [None, None],
            published: BTreeMap::new(),
            foreign_count: 0,
            moved: BTreeSet::new(),
            queued: BTreeMap::new(),
            counted: BTreeSet::new(),
            approved_at_planner: None,
            own_proposal: None,
            fair: false,
        };
        world.publish_goal();
        world.publish(Message::Heightmap(world.seen.clone()));
        world.publish(Message::Presence(true));
        world
    }

    fn publish(&mut self, message: Message) {
        use Party::{Executor, Operator, Planner, Tracker};
        let to: &[Party] = match &message {
            Message::Heightmap(_) => &[Planner, Executor],
            Message::Goal(_) => &[Planner, Operator(0), Operator(1)],
            Message::Proposal(..) => &[Tracker, Executor, Operator(0), Operator(1)],
            Message::Confirmation(_) => &[Tracker, Planner, Executor, Operator(0), Operator(1)],
            Message::ConfirmationRefused(..) => &[Operator(0), Operator(1)],
            Message::Result(_) => &[Tracker, Planner, Operator(0), Operator(1)],
            Message::Reward(_) => &[Operator(0), Operator(1)],
            Message::UnreadableConfirmation(_) | Message::Presence(_) => &[Executor],
        };
        for party in to {
            self.send(*party, message.clone());
        }
    }

    fn inbox(&mut self, party: Party) -> &mut VecDeque<Message> {
        let index = PARTIES.iter().position(|one| *one == party);
        &mut self.inboxes[index.unwrap_or_default()]
    }

    fn send(&mut self, party: Party, message: Message) {
        let fair = self.fair;
        let inbox = self.inbox(party);
        if inbox.len() == INBOX && !fair {
            inbox.pop_front();
        }
        inbox.push_back(message);
    }

    fn publish_goal(&mut self) {
        self.latched_goal = self.tracker.goal();
        if let Some(goal) = self.latched_goal.clone() {
            self.publish(Message::Goal(goal));
        }
    }

    /// What latched topics hold, for a party that starts.
    fn send_latched(&mut self, party: Party) {
        let proposals = self.latched_proposals.clone().into_iter().flatten();
        let proposals = proposals.map(|proposal| Message::Proposal(proposal.id, Ok(proposal)));
        let goal = self.latched_goal.clone().map(Message::Goal);
        let heightmap = Message::Heightmap(self.seen.clone());
        match party {
            Party::Tracker => proposals.for_each(|message| self.send(party, message)),
            Party::Planner => goal
                .into_iter()
                .chain([heightmap])
                .for_each(|message| self.send(party, message)),
            Party::Executor => proposals
                .chain([heightmap])
                .for_each(|message| self.send(party, message)),
            Party::Operator(_) => goal
                .into_iter()
                .chain(proposals)
                .for_each(|message| self.send(party, message)),
        }
    }

    fn restart(&mut self, party: Party) {
        self.inbox(party).clear();
        match party {
            Party::Tracker => {
                self.tracker = tracker();
                self.queued.clear();
                self.counted.clear();
                self.publish_goal();
            }
            Party::Planner => {
                self.planner = planner();
                self.job = None;
                self.approved_at_planner = None;
                self.own_proposal = None;
            }
            Party::Executor => self.restart_executor(),
            Party::Operator(index) => {
                self.operators[index] = Operator::new(!self.at_page[index]);
                self.refused[index].clear();
            }
        }
        self.send_latched(party);
    }

    fn deliver(&mut self, party: Party, index: usize) -> Check {
        match self.inbox(party).remove(index) {
            Some(message) => self.receive(party, message),
            None => Ok(()),
        }
    }

    fn receive(&mut self, party: Party, message: Message) -> Check {
        match party {
            Party::Tracker => self.tracker_receives(message),
            Party::Planner => self.planner_receives(message),
            Party::Executor => self.executor_receives(message),
            Party::Operator(index) => {
                if let Message::Result(result) = &message
                    && result.outcome == StepOutcome::Refused
                {
                    self.refused[index].insert(result.proposal_id);
                }
                let operator = &mut self.operators[index];
                let question = match message {
                    Message::Goal(goal) => {
                        operator.on_goal(&goal);
                        None
                    }
                    Message::Proposal(_, Ok(proposal)) => operator.on_proposal(proposal),
                    Message::Result(result) => operator.on_result(result),
                    Message::Reward(reward) => operator.on_reward(reward),
                    Message::Confirmation(confirmation) => {
                        operator.on_confirmation(&confirmation, self.now);
                        None
                    }
                    Message::ConfirmationRefused(id, kind) => {
                        operator.on_confirmation_refused(id, Some(kind));
                        None
                    }
                    _ => None,
                };
                if let Some(question) = question
                    && !self.at_page[index]
                {
                    self.answer(index, &question);
                }
                Ok(())
            }
        }
    }

    fn answer(&mut self, operator: usize, question: &Question) {
        self.decide(
            operator,
            question.proposal_id(),
            question.automatic_answer(),
        );
    }

    fn decide(&mut self, operator: usize, id: ProposalId, decision: OperatorDecision) {
        let confirmation = Confirmation {
            stamp: self.now,
            proposal_id: id,
            decision,
            operator_name: format!("operator {operator}"),
        };
        self.operators[operator].decide(&confirmation, self.now);
        self.publish(Message::Confirmation(confirmation));
    }

    /// The page asks again by itself what was not answered.
    fn refresh(&mut self, index: usize) {
        let operator = &mut self.operators[index];
        if self.cell.motion.is_some() {
            operator.on_motion(self.now);
        }
        operator.ask_again(self.now);
        if let Some(id) = operator.probe(self.now) {
            self.decide(index, id, OperatorDecision::Reject);
        }
    }

    /// The person at the page decides what it asks: as it should be, or on a whim.
    fn look(&mut self, index: usize, whim: usize) -> Check {
        let operator = &self.operators[index];
        let Some(id) = operator.current().map(|proposal| proposal.id) else {
            return self.continue_run(index);
        };
        // In the end the person wants another one than one that was refused.
        let is_good = !(self.fair && self.refused[index].contains(&id));
        let is_planned = self.cell.robot.rehearsed == Some(id) && is_good;
        let decision = match (operator.phase(), whim % 8) {
            (RunPhase::Proposed, 1) => OperatorDecision::Reject,
            (RunPhase::Proposed | RunPhase::Moving, 2) => OperatorDecision::Stop,
            (RunPhase::Proposed, _) if is_planned => OperatorDecision::Approve,
            // Its motion is shown soon, or never.
            (RunPhase::Proposed, _) if self.fair => OperatorDecision::Reject,
            (RunPhase::AwaitingConfirmation | RunPhase::Fault, 1..4) => OperatorDecision::Retry,
            (RunPhase::AwaitingConfirmation | RunPhase::Fault, _) => OperatorDecision::Advance,
            _ => return self.continue_run(index),
        };
        self.decide(index, id, decision);
        Ok(())
    }

    /// The person has a run that the page shows as stopped go on with the present step.
    fn continue_run(&mut self, index: usize) -> Check {
        if self.operators[index].phase() != RunPhase::Stopped {
            return Ok(());
        }
        let (step, _, _) = self.tracker.progress();
        if let Ok(change) = self.tracker.set_step(step) {
            self.operators[index].on_continued();
            self.after_tracker(change, None)?;
        }
        Ok(())
    }

    fn tracker_receives(&mut self, message: Message) -> Check {
        let before = self.reached();
        match message {
            Message::Proposal(_, Ok(proposal)) => self.tracker.on_proposal(&proposal),
            Message::Result(result) => {
                let id = result.proposal_id;
                let change = self.tracker.on_result(&result);
                let waited = self.queued.get(&id).copied();
                match (&change, waited) {
                    (Change::Goal(_), Some(judgement))
                        if result.was_carried_out()
                            && self.reached() == judgement.apply(before, GOALS)
                            && self.moved.contains(&id) =>
                    {
                        self.queued.remove(&id);
                        self.count(id)?;
                    }
                    (Change::Goal(_), _) if self.reached() != before => {
                        return violation(format!(
                            "the result of {id} took the tracker from {before} to {}",
                            self.reached()
                        ));
                    }
                    _ => {}
                }
                let moved = Some(id).filter(|_| result.arm_moved());
                self.after_tracker(change, moved)?;
            }
            Message::Confirmation(confirmation) => {
                let id = confirmation.proposal_id;
                let judgement = Judgement::from_decision(confirmation.decision);
                let change = match self.tracker.on_confirmation(&confirmation) {
                    Ok(change) => change,
                    Err(refusal) => {
                        self.publish_refusal(id, &refusal);
                        return self.after_tracker(Change::None, None);
                    }
                };
                match (judgement, &change) {
                    (Some(judgement), Change::Goal(_)) => {
                        if self.reached() != judgement.apply(before, GOALS) {
                            return violation(format!("{judgement:?} of {id} did not count"));
                        }
                        self.count(id)?;
                        // Its own wait, if there was one, is over.
                        self.queued.remove(&id);
                    }
                    (Some(judgement), Change::None) => {
                        let waited = self.queued.insert(id, judgement);
                        if waited.is_some() {
                            return violation(format!("a second decision on {id} waits"));
                        }
                    }
                    (None, Change::Goal(_)) => {
                        return violation("a goal came from a decision that is not about a motion");
                    }
                    _ => {}
                }
                self.after_tracker(change, None)?;
            }
            _ => {}
        }
        Ok(())
    }

    fn reached(&self) -> usize {
        let (step, count, _) = self.tracker.progress();
        match self.tracker.is_complete() {
            true => count as usize,
            false => step as usize - 1,
        }
    }

    fn count(&mut self, id: ProposalId) -> Check {
        if !self.moved.contains(&id) {
            return violation(format!(
                "a decision on {id} counted, which the arm never moved for"
            ));
        }
        if !self.counted.insert(id) {
            return violation(format!("a decision on {id} counted twice"));
        }
        Ok(())
    }

    /// `moved`: the tracker has been told of the motion for this proposal.
    fn after_tracker(&mut self, change: Change, moved: Option<ProposalId>) -> Check {
        for (id, refusal) in self.tracker.take_refused() {
            self.publish_refusal(id, &refusal);
            if self.queued.remove(&id).is_none() {
                return violation(format!("a decision on {id} was refused that did not wait"));
            }
        }
        let goal_changed = matches!(change, Change::Goal(_));
        let lost = self.queued.keys().find(|id| {
            goal_changed || self.tracker.is_stopped() || moved.is_some_and(|moved| moved == **id)
        });
        if let Some(id) = lost {
            return violation(format!("the decision on {id} is lost"));
        }
        if goal_changed {
            self.publish_goal();
        }
        Ok(())
    }

    fn publish_refusal(&mut self, id: ProposalId, refusal: &ConfirmationRefusal) {
        self.publish(Message::ConfirmationRefused(id, refusal.kind()));
    }

    fn planner_receives(&mut self, message: Message) -> Check {
        let mut republish = false;
        let job = match message {
            Message::Heightmap(observation) => self.planner.on_heightmap(observation),
            Message::Goal(goal) => {
                self.approved_at_planner = None;
                self.planner.on_goal(goal)
            }
            Message::Confirmation(confirmation) => {
                self.planner.on_confirmation(&confirmation);
                let id = Some(confirmation.proposal_id);
                if confirmation.decision == OperatorDecision::Approve
                    && self.job.is_none()
                    && self.own_proposal == id
                {
                    self.approved_at_planner = id;
                }
                None
            }
            Message::Result(result) => {
                let still_moves = result.outcome == StepOutcome::Refused
                    && result.status == Some(ProposalStatus::Moving);
                if self.approved_at_planner == Some(result.proposal_id) && !still_moves {
                    self.approved_at_planner = None;
                }
                republish = self.planner.needs_republish(&result);
                self.planner.on_result(&result)
            }
            _ => None,
        };
        if republish && let Some(proposal) = self.latched_proposals[0].clone() {
            self.publish(Message::Proposal(proposal.id, Ok(proposal)));
        }
        self.take_job(job)
    }

    fn take_job(&mut self, job: Option<Job>) -> Check {
        if let Some(job) = job {
            let moving = self.cell.moving();
            if moving.is_some() && moving == self.approved_at_planner {
                return violation("the planner plans anew while its approved proposal moves");
            }
            if self.job.replace(job).is_some() {
                return violation("two jobs at a time");
            }
        }
        Ok(())
    }

    fn predict(&mut self) -> Check {
        let Some(job) = self.job.take() else {
            return Ok(());
        };
        let answer = predict(&job);
        let (proposal, job) = self
            .planner
            .on_prediction(answer.as_ref().map_err(Clone::clone));
        if let Some(Ok(proposal)) = proposal {
            self.own_proposal = Some(proposal.id);
            self.approved_at_planner = None;
            self.publish_proposal(0, proposal);
        }
        self.take_job(job)
    }

    fn publish_proposal(&mut self, author: usize, proposal: Proposal) {
        let of_id = self.published.entry(proposal.id).or_default();
        of_id.push(proposal.clone());
        self.latched_proposals[author] = Some(proposal.clone());
        self.publish(Message::Proposal(proposal.id, Ok(proposal)));
    }

    /// A good proposal of somebody else.
    fn proposal_of_somebody(&mut self) -> Proposal {
        self.foreign_count += 1;
        let (step, _, attempt) = self.tracker.progress();
        Proposal {
            id: ProposalId(1000 + self.foreign_count),
            frame: "world".into(),
            stamp: self.seen.stamp,
            problem: "p".into(),
            step,
            attempt,
            module: "m".into(),
            action: PickPlace {
                pick: Isometry2::new(Vector2::new(0.5, 0.0), 0.0),
                place: Isometry2::new(Vector2::new(0.5, -0.1), 0.0),
            },
            settings: PrimitiveSettings::RIGID,
            pick_score: 1.0,
            place_score: 1.0,
            success_probability: None,
            done_probability: None,
            checkpoint: String::new(),
            author: "somebody".into(),
        }
    }

    /// The planner's proposal again, of another motion.
    fn proposal_of_same_id(&self) -> Option<Proposal> {
        let mut other = self.latched_proposals[0].clone()?;
        other.action.pick = Isometry2::new(Vector2::new(0.5, 0.0), 0.0);
        Some(other)
    }

    /// A client of the executor's action asks for a motion: its own, that of the planner's proposal, or a bad one.
    fn send_goal_of_kind(&mut self, kind: usize) -> Check {
        let mut goal = self.proposal_of_somebody();
        match kind % 6 {
            0 => goal.action.place = Isometry2::new(Vector2::new(7.0, 0.0), 0.0),
            1 | 2 => goal = self.latched_proposals[0].clone().unwrap_or(goal),
            3 if kind.is_multiple_of(4) => goal = self.proposal_of_same_id().unwrap_or(goal),
            _ => goal.success_probability = Some(0.9).filter(|_| kind.is_multiple_of(2)),
        }
        self.send_goal(goal)
    }

    /// Somebody else's proposal: for this goal or another one, good or not.
    fn foreign(&mut self, kind: usize) {
        let template = self.proposal_of_somebody();
        let step = template.step;
        let outside = Isometry2::new(Vector2::new(7.0, 0.0), 0.0);
        match kind % 6 {
            0 => self.publish_proposal(1, template),
            1 => {
                let other_goal = Proposal {
                    step: step + 1,
                    ..template
                };
                self.publish_proposal(1, other_goal);
            }
            2 => {
                let mut bad = template;
                bad.action.place = outside;
                self.publish(Message::Proposal(bad.id, Ok(bad)));
            }
            3 => self.publish(Message::Proposal(template.id, Err("cut off".into()))),
            4 => {
                if let Some(other) = self.proposal_of_same_id() {
                    let of_id = self.published.entry(other.id).or_default();
                    of_id.push(other.clone());
                    self.publish(Message::Proposal(other.id, Ok(other)));
                }
            }
            _ => {
                let old = Proposal {
                    stamp: Duration::from_millis(500),
                    ..template
                };
                self.publish_proposal(1, old);
            }
        }
    }

    fn perform(&mut self, action: Action) -> Check {
        let party = |number: usize| PARTIES[number % PARTIES.len()];
        let index = |world: &mut Self, party: Party, which: usize| {
            let count = world.inbox(party).len();
            (count > 0).then(|| which % count)
        };
        match action {
            Action::Deliver(number) => return self.deliver(party(number), 0),
            Action::Overtake(number, which) => {
                let to = party(number);
                if let Some(index) = index(self, to, which) {
                    return self.deliver(to, index);
                }
            }
            Action::Repeat(number, which) => {
                let to = party(number);
                if let Some(index) = index(self, to, which) {
                    let message = self.inbox(to)[index].clone();
                    self.send(to, message);
                    return self.deliver(to, index);
                }
            }
            Action::Lose(number, which) => {
                let to = party(number);
                if let Some(index) = index(self, to, which) {
                    self.inbox(to).remove(index);
                }
            }
            Action::Restart(number) => self.restart(party(number)),
            Action::Deactivate(way) => return self.deactivate(way),
            Action::Predict => return self.predict(),
            Action::Rehearse => return self.rehearse(),
            Action::EndMotion(way) => return self.end_motion(way),
            Action::Observe(kind) => {
                if self.cell.motion.is_none() || kind % 2 == 0 {
                    match kind % 3 {
                        0 => {}
                        1 => self.seen.stamp += Duration::from_millis(100),
                        _ => self.move_scene(0.1),
                    }
                    self.publish(Message::Heightmap(self.seen.clone()));
                }
            }
            Action::Decide(number, which, decision) => {
                let unknown = ProposalId(which as u64);
                let count = self.published.len() + 1;
                let id = self.published.keys().rev().nth(which % count).copied();
                // Of a way home, as often as of another one.
                let home = self.cell.homes.iter().rev().nth(which / 2 % 2).copied();
                let id = home.filter(|_| which % 2 == 0).or(id);
                let decision = OperatorDecision::ALL[decision % 6];
                // At a terminal: who sits at a page hears of it. Only who sits at the first one is an operator.
                self.publish(Message::Confirmation(Confirmation {
                    stamp: self.now,
                    proposal_id: id.unwrap_or(unknown),
                    decision,
                    operator_name: format!("terminal {}", number % 2),
                }));
            }
            Action::Look(number, whim) => {
                if self.at_page[number % 2] {
                    return self.look(number % 2, whim);
                }
            }
            Action::Foreign(kind) => self.foreign(kind),
            Action::Tick => {
                self.publish(Message::Presence(self.cell.somebody_is_there));
                self.pass_time(GRACE)?;
                for index in 0..2 {
                    if self.at_page[index] {
                        self.refresh(index);
                    }
                }
            }
            Action::SetStep(step) => {
                if let Ok(change) = self.tracker.set_step((step % GOALS) as u32 + 1) {
                    return self.after_tracker(change, None);
                }
            }
            Action::Obstacle(obstacle) => self.cell.robot.is_ready = !obstacle,
            Action::Home(recovery) => return self.call_home(recovery),
            Action::SendGoal(kind) => return self.send_goal_of_kind(kind),
            Action::CancelGoal => return self.cancel_goal(),
            Action::Presence(is_present) => {
                self.cell.somebody_is_there = is_present;
                self.publish(Message::Presence(is_present));
            }
            Action::Garble(which) => {
                let count = self.published.len();
                let mut ids = self.published.keys().rev();
                let id = ids.nth(which % count.max(1)).copied();
                let id = id.unwrap_or_default();
                self.publish(Message::UnreadableConfirmation(id));
            }
        }
        Ok(())
    }

    /// Messages get through at last, and motions succeed: the run has to end.
    fn must_end(&mut self) -> Check {
        self.fair = true;
        self.cell.robot.is_ready = true;
        self.cell.somebody_is_there = true;
        self.publish(Message::Presence(true));
        for party in PARTIES {
            self.send_latched(party);
        }
        for _ in 0..QUIET_MOMENTS {
            self.settle()?;
            if self.tracker.is_complete() {
                return Ok(());
            }
            // Somebody lets a stopped run go on.
            if self.tracker.is_stopped() {
                let (step, _, _) = self.tracker.progress();
                if let Ok(change) = self.tracker.set_step(step) {
                    self.after_tracker(change, None)?;
                }
            }
            self.publish(Message::Presence(true));
            self.settle()?;
            self.pass_time(GRACE)?;
            if self.clock_runs {
                self.seen.stamp += Duration::from_millis(100);
            }
            self.publish(Message::Heightmap(self.seen.clone()));
            self.settle()?;
            for index in 0..2 {
                if self.at_page[index] {
                    self.refresh(index);
                    self.look(index, 0)?;
                    continue;
                }
                for question in self.operators[index].on_silence() {
                    self.answer(index, &question);
                }
            }
        }
        let (step, count, attempt) = self.tracker.progress();
        violation(format!(
            "the run hangs at step {step} of {count}, attempt {attempt}"
        ))
    }

    /// Everything on its way arrives, the network answers, motions are rehearsed and end.
    fn settle(&mut self) -> Check {
        for _ in 0..10_000 {
            let mut quiet = true;
            for party in PARTIES {
                if !self.inbox(party).is_empty() {
                    quiet = false;
                    self.deliver(party, 0)?;
                }
            }
            if self.job.is_some() {
                quiet = false;
                self.predict()?;
            }
            if self.unrehearsed().is_some() {
                quiet = false;
                self.rehearse()?;
            }
            if quiet && self.cell.motion.is_some() {
                quiet = false;
                self.end_motion(0)?;
            }
            if quiet {
                return Ok(());
            }
        }
        violation("messages go round without an end")
    }
}

fn schedule(seed: u64) -> Vec<Action> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let count = rng.random_range(0..=ACTIONS);
    (0..count).map(|_| Action::random(&mut rng)).collect()
}

/// What is the same all through a schedule.
#[derive(Clone, Copy, Debug)]
struct Setting {
    clock_runs: bool,
    at_page: [bool; 2],
    require_approval: RequireApproval,
    require_presence: bool,
    /// Whether only those decide who are named.
    names_operators: bool,
}

impl Setting {
    fn of(seed: u64) -> Self {
        Self {
            clock_runs: seed.is_multiple_of(2),
            at_page: match seed / 2 % 4 {
                0 | 1 => [false, false],
                2 => [false, true],
                _ => [true, true],
            },
            require_approval: match seed / 8 % 5 {
                0..3 => RequireApproval::Always,
                3 => RequireApproval::Unsure { threshold: 0.8 },
                _ => RequireApproval::Never,
            },
            require_presence: seed / 40 % 3 == 1,
            names_operators: seed / 120 % 3 == 1,
        }
    }
}

fn run(actions: &[Action], setting: Setting) -> Check {
    let mut world = World::new(setting);
    for action in actions {
        world.perform(*action)?;
    }
    world.must_end()
}

/// The shortest part of a schedule, found by leaving out ever smaller pieces, that still goes wrong.
fn shrunk(mut actions: Vec<Action>, setting: Setting) -> (Vec<Action>, Violation) {
    let mut found = Violation(String::new());
    let mut piece = actions.len().max(1);
    loop {
        let mut start = 0;
        while start < actions.len() {
            let end = (start + piece).min(actions.len());
            let shorter = [&actions[..start], &actions[end..]].concat();
            match run(&shorter, setting) {
                Err(violation) => {
                    found = violation;
                    actions = shorter;
                }
                Ok(()) => start = end,
            }
        }
        if piece == 1 {
            break;
        }
        piece /= 2;
    }
    if let Err(violation) = run(&actions, setting) {
        found = violation;
    }
    (actions, found)
}

/// The first of `count` schedules, from a seed on, that goes wrong, and how.
fn first_violation(seed: u64, count: u64) -> Option<(u64, String)> {
    (seed..seed + count).find_map(|seed| {
        let actions = schedule(seed);
        let setting = Setting::of(seed);
        run(&actions, setting).err()?;
        let (actions, violation) = shrunk(actions, setting);
        let actions: Vec<_> = actions.iter().map(|action| format!("{action:?}")).collect();
        let actions = actions.join("\n    ");
        let text = format!("seed {seed}, {setting:?}: {violation}\n    {actions}");
        Some((seed, text))
    })
}

fn number(variable: &str, default: u64) -> u64 {
    let text = std::env::var(variable);
    text.map_or(default, |text| text.parse().expect("a number"))
}

#[test]
fn under_random_schedules_nothing_moves_unapproved_no_decision_is_lost_and_no_run_hangs() {
    let (seed, count) = (number("SEED", 0), number("SCHEDULES", 100_000));
    println!("{count} schedules from SEED={seed} on");
    if let Some((_, text)) = first_violation(seed, count) {
        panic!("{text}");
    }
}

#[test]
fn every_mutation_is_found() {
    let mut missed = Vec::new();
    for mutation in Mutation::ALL {
        plant(Some(mutation));
        let found = first_violation(0, number("SCHEDULES", 100_000));
        plant(None);
        match found {
            Some((seed, text)) => {
                let how = text.lines().next().unwrap_or_default();
                println!("{mutation:?}: found after {} schedules: {how}", seed + 1);
            }
            None => missed.push(mutation),
        }
    }
    assert_eq!(missed, []);
}
