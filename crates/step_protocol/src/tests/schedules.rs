//! All four machines together under random schedules: messages delayed, repeated, reordered and lost, garbage in between, any
//! party started again, two operators, each a program that answers questions or a person at a page, stops and faults.
//!
//! `SCHEDULES=1000000 SEED=7 cargo test --release -p step_protocol schedules -- --nocapture`

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
    ApprovalGate, CannotBegin, Change, Confirmation, ConfirmationRefusal, Coverage, GateAction,
    GateRules, Goal, GoalSequence, GoalTracker, Job, JointPositions, Judgement, Observation,
    Obstacle, Operator, OperatorDecision, PlannerRules, Prediction, Proposal, ProposalId,
    ProposalPlanner, ProposalStatus, Proposed, Question, Recovery, RefusalKind, RefusalReason,
    RequireApproval, Reward, RobotState, RunPhase, ShownStep, StepJudge, StepOutcome, StepResult,
    goals_of,
};

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
    Gate,
    Operator(usize),
}

const PARTIES: [Party; 5] = [
    Party::Tracker,
    Party::Planner,
    Party::Gate,
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
    /// The executor is deactivated and activated.
    Deactivate,
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
    /// Somebody calls for the way home.
    Home,
}

impl Action {
    fn random(rng: &mut impl Rng) -> Self {
        let number = |next: &mut dyn FnMut() -> u32| next() as usize % 240;
        let mut next = || rng.random::<u32>();
        let party = number(&mut next);
        let which = number(&mut next);
        let other = number(&mut next);
        match next() % 100 {
            0..45 => Self::Deliver(party),
            45..50 => Self::Overtake(party, which),
            50..54 => Self::Repeat(party, which),
            54..57 => Self::Lose(party, which),
            57..60 => Self::Restart(party),
            60 => Self::Deactivate,
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
            _ => Self::Home,
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

struct Robot {
    ready: bool,
    /// Where the arm is: 0 at home, where motions begin and end, something else where one was broken off.
    joints: u32,
    /// The proposal whose motion was rehearsed from there.
    rehearsed: Option<ProposalId>,
}

impl RobotState for Robot {
    fn obstacle(&self) -> Option<Obstacle> {
        (!self.ready).then(|| RefusalReason::SafetyMode.because("is PROTECTIVE_STOP"))
    }

    fn check_motion(&self, proposal: &Proposal) -> Result<(), CannotBegin> {
        match self.rehearsed == Some(proposal.id) {
            true => Ok(()),
            false => Err(CannotBegin::NotRehearsed),
        }
    }

    fn check_recovery(&self, _: Recovery) -> Result<JointPositions, CannotBegin> {
        Ok(JointPositions::repeat(f64::from(self.joints)))
    }
}

/// What moves the arm.
#[derive(Clone, Debug, PartialEq)]
enum Motion {
    Proposal(Box<Proposal>),
    Home(ProposalId),
}

/// The whole graph, and what is known of it from outside.
struct World {
    tracker: GoalTracker,
    planner: ProposalPlanner,
    gate: ApprovalGate,
    operators: [Operator; 2],
    /// Which of them are people at a page.
    at_page: [bool; 2],
    /// The proposals that each has heard to be refused.
    refused: [BTreeSet<ProposalId>; 2],
    inboxes: [VecDeque<Message>; 5],
    job: Option<Job>,
    robot: Robot,
    /// Monotonic time.
    now: Duration,
    /// Whether stamps advance while nothing moves, as on a real cell.
    clock_runs: bool,
    seen: Observation,
    /// The newest of each latched topic, for parties that start.
    latched_goal: Option<Goal>,
    latched_proposals: [Option<Proposal>; 2],
    motion: Option<Motion>,
    cancelled: bool,
    /// The way home that may be approved: the newest, until a stop, a motion, a deactivation or a restart.
    home: Option<ProposalId>,
    /// Every way home that was proposed.
    homes: Vec<ProposalId>,
    /// Everything that was published under an id.
    published: BTreeMap<ProposalId, Vec<Proposal>>,
    foreign_count: u64,
    /// Proposals that the arm has moved for.
    moved: BTreeSet<ProposalId>,
    /// Of these, those since the executor was started.
    moved_since_start: BTreeSet<ProposalId>,
    /// Approvals that the executor has received and that still count.
    approvals: Vec<ProposalId>,
    newest_at_gate: Option<ProposalId>,
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

fn gate() -> ApprovalGate {
    ApprovalGate::new(GateRules {
        frame: "world".into(),
        limits: PrimitiveSettings::RIGID,
        changes: ChangeRules::default(),
        confirmation_grace: GRACE,
        require_approval: RequireApproval::Always,
        operators: Vec::new(),
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
        success_probability: None,
        done_probability: None,
    })
}

impl World {
    fn new(
        Setting {
            clock_runs,
            at_page,
        }: Setting,
    ) -> Self {
        let mut world = Self {
            tracker: tracker(),
            planner: planner(),
            gate: gate(),
            operators: at_page.map(|at_page| Operator::new(!at_page)),
            at_page,
            refused: Default::default(),
            inboxes: Default::default(),
            job: None,
            robot: Robot {
                ready: true,
                joints: 0,
                rehearsed: None,
            },
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
            motion: None,
            cancelled: false,
            home: None,
            homes: Vec::new(),
            published: BTreeMap::new(),
            foreign_count: 0,
            moved: BTreeSet::new(),
            moved_since_start: BTreeSet::new(),
            approvals: Vec::new(),
            newest_at_gate: None,
            queued: BTreeMap::new(),
            counted: BTreeSet::new(),
            approved_at_planner: None,
            own_proposal: None,
            fair: false,
        };
        world.publish_goal();
        world.publish(Message::Heightmap(world.seen.clone()));
        world
    }

    fn publish(&mut self, message: Message) {
        use Party::{Gate, Operator, Planner, Tracker};
        let to: &[Party] = match &message {
            Message::Heightmap(_) => &[Planner, Gate],
            Message::Goal(_) => &[Planner, Operator(0), Operator(1)],
            Message::Proposal(..) => &[Tracker, Gate, Operator(0), Operator(1)],
            Message::Confirmation(_) => &[Tracker, Planner, Gate, Operator(0), Operator(1)],
            Message::ConfirmationRefused(..) => &[Operator(0), Operator(1)],
            Message::Result(_) => &[Tracker, Planner, Operator(0), Operator(1)],
            Message::Reward(_) => &[Operator(0), Operator(1)],
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
            Party::Gate => proposals
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
            Party::Gate => {
                // The watchdog stops the arm; nobody reports a result.
                self.gate = gate();
                self.robot.rehearsed = None;
                self.moved_since_start.clear();
                self.approvals.clear();
                self.newest_at_gate = None;
                self.home = None;
                if self.motion.take().is_some() {
                    self.robot.joints += 1;
                    self.move_scene(0.0);
                }
            }
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
            Party::Gate => self.gate_receives(message),
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
        if self.motion.is_some() {
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
        let is_planned = self.robot.rehearsed == Some(id) && is_good;
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
            let moving = match &self.motion {
                Some(Motion::Proposal(proposal)) => Some(proposal.id),
                _ => None,
            };
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

    fn gate_receives(&mut self, message: Message) -> Check {
        match message {
            Message::Heightmap(observation) => {
                let Observation {
                    stamp, heightmap, ..
                } = observation;
                self.gate.on_heightmap(stamp, heightmap);
                self.ask_gate()
            }
            Message::Proposal(id, proposal) => {
                if self.gate.on_proposal(id, proposal) == Proposed::Pending {
                    // No approval survives a supersession.
                    let superseded = self.newest_at_gate.replace(id);
                    self.approvals
                        .retain(|approved| Some(*approved) != superseded);
                }
                self.ask_gate()
            }
            Message::Confirmation(confirmation) => {
                let id = confirmation.proposal_id;
                match confirmation.decision {
                    OperatorDecision::Approve => self.approvals.push(id),
                    OperatorDecision::Stop => {
                        self.approvals.clear();
                        self.home = None;
                    }
                    OperatorDecision::Reject => {
                        self.home.take_if(|home| *home == id);
                    }
                    _ => {}
                }
                let decision = confirmation.decision;
                let gate = &mut self.gate;
                let actions = gate.on_confirmation(id, decision, &self.robot, self.now);
                self.act(actions)
            }
            _ => Ok(()),
        }
    }

    fn ask_gate(&mut self) -> Check {
        let actions = self.gate.on_news(&self.robot, self.now);
        self.act(actions)
    }

    fn act(&mut self, actions: Vec<GateAction>) -> Check {
        for action in actions {
            match action {
                GateAction::Move(proposal) => {
                    let id = proposal.id;
                    if self.motion.is_some() {
                        return violation(format!("{id} moves while the arm moves"));
                    }
                    let approval = self.approvals.iter().position(|approved| *approved == id);
                    match approval {
                        Some(index) => drop(self.approvals.swap_remove(index)),
                        None => return violation(format!("{id} moves without an approval")),
                    }
                    let published = self.published.get(&id);
                    if !published.is_some_and(|published| published.contains(&proposal)) {
                        return violation(format!("{id} moves otherwise than it was published"));
                    }
                    if self.robot.rehearsed != Some(id) {
                        return violation(format!("{id} moves and was not rehearsed"));
                    }
                    if !self.moved_since_start.insert(id) {
                        return violation(format!("{id} moves twice"));
                    }
                    self.moved.insert(id);
                    self.home = None;
                    self.cancelled = false;
                    self.motion = Some(Motion::Proposal(proposal));
                }
                GateAction::GoHome(id) | GateAction::PutDown(id) => {
                    if self.motion.is_some() {
                        return violation(format!("{id} moves the arm home while it moves"));
                    }
                    let approval = self.approvals.iter().position(|approved| *approved == id);
                    match approval {
                        Some(index) => drop(self.approvals.swap_remove(index)),
                        None => return violation(format!("{id} moves home without an approval")),
                    }
                    if self.home.take() != Some(id) {
                        return violation(format!("{id} moves home after it was withdrawn"));
                    }
                    self.cancelled = false;
                    self.motion = Some(Motion::Home(id));
                }
                GateAction::Cancel => {
                    if self.motion.is_none() {
                        return violation("a cancel while nothing moves");
                    }
                    self.cancelled = true;
                }
                GateAction::Report(report) => {
                    let mut approvals = self.approvals.iter();
                    let answered = approvals.position(|approved| *approved == report.id);
                    if let Some(index) = answered.filter(|_| report.outcome == StepOutcome::Refused)
                    {
                        self.approvals.swap_remove(index);
                    }
                    let result = StepResult {
                        stamp: self.seen.stamp,
                        proposal_id: report.id,
                        outcome: report.outcome,
                        reason: report.reason,
                        duration: Duration::ZERO,
                        status: report.status,
                    };
                    self.publish(Message::Result(result));
                }
            }
        }
        Ok(())
    }

    /// The scene after a motion: time has gone on, and something may have changed.
    fn move_scene(&mut self, change_m: f32) {
        self.seen.stamp += Duration::from_secs(1);
        if change_m != 0.0 {
            self.seen.heightmap = heightmap(self.seen.heightmap.height_m[0] + change_m);
        }
    }

    fn end_motion(&mut self, outcome: StepOutcome, delta_reward: f64) -> Check {
        let Some(motion) = self.motion.take() else {
            return Ok(());
        };
        let outcome = match self.cancelled {
            true => StepOutcome::Stopped,
            false => outcome,
        };
        self.robot.rehearsed = None;
        let changes = outcome == StepOutcome::Placed || delta_reward != 0.0;
        self.move_scene(if changes { 0.1 } else { 0.0 });
        let end = self.seen.stamp;
        let broken_off = matches!(outcome, StepOutcome::Stopped | StepOutcome::Fault);
        if broken_off {
            self.approvals.clear();
            self.robot.joints += 1;
        } else {
            self.robot.joints = 0;
        }
        let actions = self.gate.finish(end, broken_off);
        if let Motion::Home(id) = motion {
            let outcome = match broken_off {
                true => StepOutcome::NotHome,
                false => StepOutcome::AtHome,
            };
            let status = self.gate.status(id);
            self.publish(Message::Result(StepResult {
                stamp: end,
                proposal_id: id,
                outcome,
                reason: String::new(),
                duration: Duration::from_secs(1),
                status,
            }));
        } else if let Motion::Proposal(proposal) = motion {
            let status = self.gate.status(proposal.id);
            self.publish(Message::Result(StepResult {
                stamp: end,
                proposal_id: proposal.id,
                outcome,
                reason: String::new(),
                duration: Duration::from_secs(1),
                status,
            }));
            if outcome.motion().is_some() {
                let complete = self.fair && proposal.step as usize == GOALS;
                self.publish(Message::Reward(Reward {
                    stamp: end,
                    delta: delta_reward,
                    total: 0.0,
                    complete,
                }));
            }
        }
        self.publish(Message::Heightmap(self.seen.clone()));
        self.act(actions)?;
        self.ask_gate()
    }

    /// Somebody else's proposal: for this goal or another one, good or not.
    fn foreign(&mut self, kind: usize) {
        self.foreign_count += 1;
        let (step, _, attempt) = self.tracker.progress();
        let template = Proposal {
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
        };
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
                // The planner's id for another motion.
                if let Some(own) = self.latched_proposals[0].clone() {
                    let mut other = own;
                    other.action.pick = template.action.pick;
                    self.published
                        .entry(other.id)
                        .or_default()
                        .push(other.clone());
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
            Action::Deactivate => {
                self.gate.deactivate();
                self.approvals.clear();
                self.home = None;
                if self.motion.is_some() {
                    self.cancelled = true;
                    self.end_motion(StepOutcome::Stopped, 0.0)?;
                }
                // Subscriptions are made anew.
                self.inbox(Party::Gate).clear();
                self.send_latched(Party::Gate);
            }
            Action::Predict => return self.predict(),
            Action::Rehearse => return self.rehearse(),
            Action::EndMotion(which) => {
                let ends = [
                    (StepOutcome::Placed, 1.0),
                    (StepOutcome::Placed, 0.0),
                    (StepOutcome::Placed, -1.0),
                    (StepOutcome::GraspFailed, 0.0),
                    (StepOutcome::NoContact, 0.0),
                    (StepOutcome::Dropped, 0.0),
                    (StepOutcome::LagAborted, 0.0),
                    (StepOutcome::Fault, 0.0),
                ];
                let (outcome, delta_reward) = ends[which % ends.len()];
                return self.end_motion(outcome, delta_reward);
            }
            Action::Observe(kind) => {
                if self.motion.is_none() || kind % 2 == 0 {
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
                let home = self.homes.iter().rev().nth(which / 2 % 2).copied();
                let id = home.filter(|_| which % 2 == 0).or(id);
                let decision = OperatorDecision::ALL[decision % 6];
                // At a terminal: who sits at a page hears of it.
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
                self.now += GRACE;
                for index in 0..2 {
                    if self.at_page[index] {
                        self.refresh(index);
                    }
                }
                return self.ask_gate();
            }
            Action::SetStep(step) => {
                if let Ok(change) = self.tracker.set_step((step % GOALS) as u32 + 1) {
                    return self.after_tracker(change, None);
                }
            }
            Action::Obstacle(obstacle) => self.robot.ready = !obstacle,
            Action::Home => {
                let new = ProposalId(1_000_000 + self.homes.len() as u64);
                let Ok(id) = self.gate.propose_home(new, Recovery::Home, &self.robot) else {
                    return Ok(());
                };
                if self.motion.is_some() {
                    return violation(format!("{id} is proposed while the arm moves"));
                }
                if id == new {
                    self.homes.push(id);
                    self.home = Some(id);
                } else if self.home != Some(id) {
                    return violation(format!("{id} is proposed again after it was withdrawn"));
                }
                if self.gate.moves_unasked(id) {
                    let approve = OperatorDecision::Approve;
                    let actions = self
                        .gate
                        .on_confirmation(id, approve, &self.robot, self.now);
                    return self.act(actions);
                }
            }
        }
        Ok(())
    }

    /// Messages get through at last, and motions succeed: the run has to end.
    fn must_end(&mut self) -> Check {
        self.fair = true;
        self.robot.ready = true;
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
            self.now += GRACE;
            self.ask_gate()?;
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

    /// The pending proposal, where it is to be rehearsed.
    fn unrehearsed(&self) -> Option<ProposalId> {
        let pending = self.gate.pending().map(|pending| pending.id);
        pending.filter(|_| pending != self.robot.rehearsed)
    }

    fn rehearse(&mut self) -> Check {
        self.robot.rehearsed = self.unrehearsed().or(self.robot.rehearsed);
        self.ask_gate()
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
            if quiet && self.motion.is_some() {
                quiet = false;
                self.end_motion(StepOutcome::Placed, 1.0)?;
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
