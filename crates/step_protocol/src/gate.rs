//! What may move: the approvals of an operator against what the executor knows.
//!
//! Only the newest valid proposal can be approved, once; what became of the ones before is remembered, so that a refusal can
//! say it.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use heightmap::{Change, ChangeRules, Heightmap, Workspace, largest_change};
use nalgebra::SVector;
use pick_place::{PickPlace, PrimitiveSettings};

use crate::mutation::{Mutation, planted};
use crate::{
    MotionCause, Obstacle, OperatorDecision, Proposal, ProposalId, ProposalStatus, RefusalReason,
    StepOutcome, Verdict,
};

/// Heightmaps kept, by stamp, until the proposals that were made from them arrive.
const HEIGHTMAPS: usize = 64;
/// Proposals whose status is remembered.
const PROPOSALS: usize = 1024;
/// Invalid proposals of which it is remembered why.
const INVALID: usize = 64;
/// Confirmations that wait for their proposal; more are refused at once.
const WAITING: usize = 16;
/// How long an approval waits until its motion has been rehearsed: less than a second, unless the machine is overloaded.
pub(crate) const REHEARSAL_GRACE: Duration = Duration::from_secs(5);

/// Which proposals move only when somebody approves them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum RequireApproval {
    /// Every one.
    Always,
    /// Those without a probability of success of at least `threshold`, and those whose goal looks reached already.
    Unsure {
        /// From 0 to 1.
        threshold: f32,
    },
    /// None, until a stop or a fault.
    Never,
}

impl RequireApproval {
    /// Whether this proposal needs an approval, as long as nothing was stopped.
    fn asks_for(&self, proposal: &Proposal) -> bool {
        match self {
            Self::Always => true,
            Self::Unsure { threshold } => {
                let success = proposal.success_probability;
                let is_sure = success.is_some_and(|success| success >= *threshold);
                !is_sure || proposal.verdict() == Verdict::Done
            }
            Self::Never => false,
        }
    }
}

/// Whether the executor carries proposals out by itself: as the rule says, and from a stop or a fault on not before the next
/// approval.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Unasked {
    is_on: bool,
}

impl Unasked {
    /// Nothing was stopped.
    pub fn new(rule: RequireApproval) -> Self {
        Self {
            is_on: rule != RequireApproval::Always,
        }
    }

    /// A stop or a fault has come: nothing goes on by itself.
    pub fn stop(&mut self) {
        self.is_on = false;
    }

    /// An operator has approved a proposal, and it moves: things go on.
    pub fn go_on(&mut self, rule: RequireApproval) {
        *self = Self::new(rule);
    }

    /// Whether some proposals are carried out unasked.
    pub fn is_on(&self) -> bool {
        self.is_on
    }

    /// Whether this one is.
    pub fn moves(&self, rule: RequireApproval, proposal: &Proposal) -> bool {
        self.is_on && !rule.asks_for(proposal)
    }
}

/// What a proposal must keep to.
#[derive(Clone, Debug, PartialEq)]
pub struct GateRules {
    /// Frame of proposals.
    pub frame: String,
    /// Largest heights and speeds.
    pub limits: PrimitiveSettings,
    /// When the observation has changed.
    pub changes: ChangeRules,
    /// How long a confirmation waits for its proposal or its heightmap.
    pub confirmation_grace: Duration,
    /// Which proposals move only when somebody approves them.
    pub require_approval: RequireApproval,
    /// Names of those whose approvals and rejections count; empty where everybody's do.
    pub operators: Vec<String>,
}

/// What has become of the cells of a change.
fn how(change: &Change) -> String {
    match change.height_m {
        Some(height_m) => format!("by {:.0} mm", 1e3 * height_m),
        None => "cannot be seen any more".into(),
    }
}

/// Why a message is no proposal that could be approved.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum InvalidProposal {
    /// Not readable.
    #[error("{0}")]
    Message(String),
    /// In another frame.
    #[error("proposal {id}: frame is `{actual}`, expected `{expected}`")]
    Frame {
        /// The proposal.
        id: ProposalId,
        /// Its frame.
        actual: String,
        /// That of the world.
        expected: String,
    },
    /// A pose has a coordinate that is not finite.
    #[error("proposal {id}: {which} pose x {x_m} m, y {y_m} m, yaw {yaw_rad} rad is not finite")]
    NotFinite {
        /// The proposal.
        id: ProposalId,
        /// Pick or place.
        which: &'static str,
        /// Position.
        x_m: f64,
        /// Position.
        y_m: f64,
        /// Angle.
        yaw_rad: f64,
    },
    /// A pose lies outside the heightmap.
    #[error(
        "proposal {id}: {which} pose x {x_m:.4} m, y {y_m:.4} m lies outside the workspace, x {}..{} m, y {}..{} m",
        workspace.origin_m.x,
        workspace.origin_m.x + workspace.cols as f64 * workspace.pixel_size_m,
        workspace.origin_m.y,
        workspace.origin_m.y + workspace.rows as f64 * workspace.pixel_size_m
    )]
    OutsideWorkspace {
        /// The proposal.
        id: ProposalId,
        /// Pick or place.
        which: &'static str,
        /// Position.
        x_m: f64,
        /// Position.
        y_m: f64,
        /// That of the heightmap.
        workspace: Box<Workspace>,
    },
    /// A height or speed out of range.
    #[error("proposal {id}: settings.{name} is {value}, expected above 0 and at most {limit}")]
    Settings {
        /// The proposal.
        id: ProposalId,
        /// Name of the setting.
        name: &'static str,
        /// Its value.
        value: f64,
        /// The largest allowed.
        limit: f64,
    },
    /// Two messages of one id ask for different motions.
    #[error("proposal {id} came twice with different contents")]
    DifferentContents {
        /// The proposal.
        id: ProposalId,
    },
}

/// Why a confirmation moves nothing.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// Somebody has said it who does not decide.
    #[error(
        "proposal {id}: `{name}` does not decide here, expected one of {operators:?} (parameter operators)"
    )]
    NotAnOperator {
        /// The proposal.
        id: ProposalId,
        /// Who has said it.
        name: String,
        /// Who decides.
        operators: Vec<String>,
    },
    /// No such proposal has arrived.
    #[error("proposal {id} is unknown")]
    Unknown {
        /// The proposal named.
        id: ProposalId,
    },
    /// A stop that names no known proposal, with nothing to stop.
    #[error("proposal {id} is unknown; nothing was moving")]
    NothingToStop {
        /// The proposal named.
        id: ProposalId,
    },
    /// The message of that id was no proposal.
    #[error(transparent)]
    Invalid(#[from] InvalidProposal),
    /// Something else became of it.
    #[error("proposal {id} {status}")]
    NotPending {
        /// The proposal.
        id: ProposalId,
        /// What became of it.
        status: ProposalStatus,
    },
    /// Another one is being carried out.
    #[error("proposal {id} was approved while proposal {moving} is being carried out")]
    Busy {
        /// The proposal.
        id: ProposalId,
        /// The other one.
        moving: ProposalId,
    },
    /// The arm is on its way home.
    #[error("proposal {id} was approved while the arm is on its way home")]
    Homing {
        /// The proposal.
        id: ProposalId,
    },
    /// The arm is not where the way home begins, or something else is held or seen.
    #[error(
        "proposal {id}: the arm has moved since its way home was proposed, or what is held or seen has changed: call for it again"
    )]
    HomeFromElsewhere {
        /// The proposal.
        id: ProposalId,
    },
    /// The robot is not ready, or the proposed motion is not feasible.
    #[error("proposal {id}: {obstacle}")]
    Robot {
        /// The proposal.
        id: ProposalId,
        /// The reason.
        obstacle: Obstacle,
    },
    /// Made from what was seen before the last motion ended.
    #[error(
        "proposal {id} was made from an observation at {}, before the last motion ended at {}",
        seconds(*stamp),
        seconds(*moved_until)
    )]
    OldObservation {
        /// The proposal.
        id: ProposalId,
        /// Of its heightmap.
        stamp: Duration,
        /// The end of the motion.
        moved_until: Duration,
    },
    /// The heightmap that it was made from is not known.
    #[error(
        "proposal {id}: the heightmap of {}, which it was made from, has not arrived",
        seconds(*stamp)
    )]
    NoSourceHeightmap {
        /// The proposal.
        id: ProposalId,
        /// Of its heightmap.
        stamp: Duration,
    },
    /// The cameras cover another workspace now.
    #[error(
        "proposal {id}: the heightmap of {} covers another workspace than the one that it was made from",
        seconds(*stamp)
    )]
    OtherWorkspace {
        /// The proposal.
        id: ProposalId,
        /// Of the newest heightmap.
        stamp: Duration,
    },
    /// The workspace does not look as it did.
    #[error(
        "proposal {id}: the observation has changed since: {:.0} mm^2 about ({:.3}, {:.3}) {} in the heightmap of {}",
        1e6 * change.area_m2,
        change.center_m.x,
        change.center_m.y,
        how(change),
        seconds(*stamp)
    )]
    ObservationChanged {
        /// The proposal.
        id: ProposalId,
        /// Of the newest heightmap.
        stamp: Duration,
        /// Where and how much.
        change: Change,
    },
    /// Its motion was not rehearsed from where the arm is, on what is seen.
    #[error(
        "proposal {id}: its motion has not been checked for collisions within {:?}",
        REHEARSAL_GRACE
    )]
    NotRehearsed {
        /// The proposal.
        id: ProposalId,
    },
    /// It waited for its proposal when a stop came.
    #[error("proposal {id}: a stop came before it")]
    StopCame {
        /// The proposal named.
        id: ProposalId,
    },
    /// It waited for its proposal when a motion failed.
    #[error("proposal {id}: a motion was broken off before it")]
    MotionBrokenOff {
        /// The proposal named.
        id: ProposalId,
    },
}

impl InvalidProposal {
    fn reason(&self) -> RefusalReason {
        match self {
            Self::OutsideWorkspace { .. } => RefusalReason::OutsideWorkspace,
            Self::Message(_)
            | Self::Frame { .. }
            | Self::NotFinite { .. }
            | Self::Settings { .. }
            | Self::DifferentContents { .. } => RefusalReason::InvalidProposal,
        }
    }
}

impl Refusal {
    /// What a person can do something about; its words are in the text.
    pub fn reason(&self) -> RefusalReason {
        match self {
            Self::Unknown { .. } | Self::NothingToStop { .. } => RefusalReason::Unknown,
            Self::Invalid(invalid) => invalid.reason(),
            Self::NotPending { .. } => RefusalReason::NotPending,
            Self::NotAnOperator { .. } => RefusalReason::NotAnOperator,
            Self::Busy { .. } => RefusalReason::Busy,
            Self::Homing { .. } => RefusalReason::OnItsWayHome,
            Self::HomeFromElsewhere { .. } => RefusalReason::HomeFromElsewhere,
            Self::Robot { obstacle, .. } => obstacle.reason(),
            Self::OldObservation { .. } => RefusalReason::OldObservation,
            Self::NoSourceHeightmap { .. } => RefusalReason::NoSourceHeightmap,
            Self::OtherWorkspace { .. } => RefusalReason::OtherWorkspace,
            Self::ObservationChanged { .. } => RefusalReason::ObservationChanged,
            Self::NotRehearsed { .. } => RefusalReason::NotRehearsed,
            Self::StopCame { .. } | Self::MotionBrokenOff { .. } => RefusalReason::Stopped,
        }
    }
}

/// What became of a proposal that arrived.
#[derive(Clone, Debug, PartialEq)]
pub enum Proposed {
    /// It can be approved.
    Pending,
    /// It came before; nothing has changed.
    Repeated,
    /// It cannot be approved, for this reason.
    Invalid(InvalidProposal),
}

/// The executor's word on a proposal, without motion.
#[derive(Clone, Debug, PartialEq)]
pub struct Report {
    /// The proposal.
    pub id: ProposalId,
    /// What became of it.
    pub outcome: StepOutcome,
    /// Why, for people.
    pub reason: String,
    /// Where it stands after this word.
    pub status: Option<ProposalStatus>,
}

/// What the executor is to do.
#[derive(Clone, Debug, PartialEq)]
pub enum GateAction {
    /// Move; [`ApprovalGate::finish`] has to follow.
    Move(Box<Proposal>),
    /// Bring the arm home, by this proposal; [`ApprovalGate::finish`] has to follow.
    GoHome(ProposalId),
    /// Put down what is held and bring the arm home, by this proposal; [`ApprovalGate::finish`] has to follow.
    PutDown(ProposalId),
    /// Stop the motion under way.
    Cancel,
    /// Say this.
    Report(Report),
}

/// What the gate asks about the robot, at the moment of an approval.
pub trait RobotState {
    /// Why the arm must not move now, if there is a reason.
    fn obstacle(&self) -> Option<Obstacle>;

    /// Whether the whole motion can begin: it was rehearsed from where the arm is, on what is seen. Answers at once: a stop may be waiting.
    ///
    /// # Errors
    /// Says what cannot be planned, or what would be hit; or that the motion has not been rehearsed.
    fn check_motion(&self, proposal: &Proposal) -> Result<(), CannotBegin>;

    /// The same for what brings the arm home. Returns where the arm is (rad).
    ///
    /// # Errors
    /// Says what cannot be planned, or what would be hit; or that the motion has not been rehearsed.
    fn check_recovery(&self, recovery: Recovery) -> Result<JointPositions, CannotBegin>;
}

/// Why a motion cannot begin.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CannotBegin {
    /// For this reason.
    Refused(Obstacle),
    /// It was not rehearsed, or from elsewhere or on another view.
    NotRehearsed,
}

/// The executor plans a recovery, checks it for collisions and proposes it in this time.
pub const RECOVERY_TIMEOUT: Duration = Duration::from_secs(60);

/// What brings the arm home after a stop or a fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Recovery {
    /// The way home; what is held stays held.
    Home,
    /// What is held is put down first.
    PutDown,
}

/// Positions of the arm's joints (rad).
pub type JointPositions = SVector<f64, 6>;

/// The arm is where it was when no joint is further from there (rad): encoders have noise.
pub const AT_REST_RAD: f64 = 1e-3;

/// A way home that can be approved.
#[derive(Clone, Copy, Debug)]
struct Home {
    id: ProposalId,
    recovery: Recovery,
    /// Where it begins.
    from_rad: JointPositions,
}

/// The answer to a confirmation.
enum Answer {
    Act(GateAction),
    Report(StepOutcome, String),
    Refuse(Refusal),
    /// What it needs may still be on its way: ask again a little later, then refuse for this reason.
    Wait(Refusal),
    Nothing,
}

/// The newest valid proposal.
#[derive(Debug)]
struct Newest {
    proposal: Proposal,
    /// What was found to be wrong with it since.
    invalid: Option<InvalidProposal>,
    /// The heightmap that it was made from, once it has arrived.
    source_heightmap: Option<Arc<Heightmap>>,
}

/// A confirmation that arrived before what it speaks of.
#[derive(Clone, Copy, Debug)]
struct Waiting {
    id: ProposalId,
    decision: OperatorDecision,
    since: Duration,
    until: Duration,
}

/// Decides what may move. All times are passed in: `now` is monotonic, stamps are ROS time.
#[derive(Debug)]
pub struct ApprovalGate {
    rules: GateRules,
    /// The first of each stamp, oldest first.
    heightmaps: VecDeque<(Duration, Arc<Heightmap>)>,
    /// The newest observation.
    latest: Option<(Duration, Arc<Heightmap>)>,
    newest: Option<Newest>,
    /// Oldest first; the last is the newest proposal's.
    statuses: VecDeque<(ProposalId, ProposalStatus)>,
    /// Invalid proposals, and why. Kept apart: no number of them takes anything from a valid one.
    invalid: VecDeque<(ProposalId, InvalidProposal)>,
    waiting: VecDeque<Waiting>,
    moving: Option<ProposalId>,
    /// The way home that can be approved. Other proposals do not supersede it; a stop and any motion withdraw it.
    home: Option<Home>,
    /// The way home that the arm is on.
    homing: Option<ProposalId>,
    /// Heightmaps from before the end of the last motion are no ground to move on.
    moved_until: Option<Duration>,
    /// Whether new proposals move by themselves.
    unasked: Unasked,
}

impl ApprovalGate {
    /// A gate that has received nothing yet.
    pub fn new(rules: GateRules) -> Self {
        Self {
            heightmaps: VecDeque::new(),
            latest: None,
            newest: None,
            statuses: VecDeque::new(),
            invalid: VecDeque::new(),
            waiting: VecDeque::new(),
            moving: None,
            home: None,
            homing: None,
            moved_until: None,
            unasked: Unasked::new(rules.require_approval),
            rules,
        }
    }

    /// Nothing moves by itself before the next approval: a stop or fault came before this gate was made.
    pub fn remember_stop(&mut self) {
        self.unasked.stop();
    }

    /// The proposal that is being carried out.
    pub fn moving(&self) -> Option<ProposalId> {
        self.moving
    }

    /// Whether the executor approves some new proposals itself: approval is not always required, and no stop or fault has come
    /// since the last approval.
    pub fn is_automatic(&self) -> bool {
        self.unasked.is_on()
    }

    /// Whether the executor approves this proposal itself: it is the newest one, and the rules do not ask for an approval of it. A way
    /// home has no probability of success.
    pub fn moves_unasked(&self, id: ProposalId) -> bool {
        if self.home.is_some_and(|home| home.id == id) {
            if planted(Mutation::HomeMovesUnasked) {
                return true;
            }
            return self.unasked.is_on() && self.rules.require_approval == RequireApproval::Never;
        }
        let newest = self.newest.as_ref();
        let newest = newest.filter(|newest| newest.proposal.id == id);
        let rule = self.rules.require_approval;
        newest.is_some_and(|newest| self.unasked.moves(rule, &newest.proposal))
    }

    /// Takes the newest observation.
    pub fn on_heightmap(&mut self, stamp: Duration, heightmap: Arc<Heightmap>) {
        let known = self.heightmaps.iter().find(|(known, _)| *known == stamp);
        let heightmap = match known {
            // The same frame may come again; another of the same stamp is a change.
            Some((_, known)) if *known == heightmap => Arc::clone(known),
            Some(_) => heightmap,
            None => {
                if self.heightmaps.len() == HEIGHTMAPS {
                    self.heightmaps.pop_front();
                }
                self.heightmaps.push_back((stamp, Arc::clone(&heightmap)));
                heightmap
            }
        };
        self.latest = Some((stamp, heightmap));
        self.find_source();
    }

    /// Keeps the heightmap of the newest proposal, however many come after it.
    fn find_source(&mut self) {
        if let Some(Newest {
            proposal,
            source_heightmap: source @ None,
            ..
        }) = &mut self.newest
        {
            let mut known = self.heightmaps.iter();
            let known = known.find(|(stamp, _)| *stamp == proposal.stamp);
            *source = known.map(|(_, heightmap)| Arc::clone(heightmap));
        }
    }

    /// Takes a proposal, or what is wrong with the message of that id. A valid one supersedes the one before; an invalid
    /// message never supersedes the pending proposal.
    pub fn on_proposal(&mut self, id: ProposalId, proposal: Result<Proposal, String>) -> Proposed {
        if self.status(id).is_some() {
            if let Some(newest) = &mut self.newest
                && newest.proposal.id == id
                && newest.invalid.is_none()
                && !proposal.is_ok_and(|proposal| newest.proposal.is_same_motion(&proposal))
            {
                let reason = InvalidProposal::DifferentContents { id };
                newest.invalid = Some(reason.clone());
                return Proposed::Invalid(reason);
            }
            return Proposed::Repeated;
        }
        if self.why_invalid(id).is_some() {
            return Proposed::Repeated;
        }
        let workspace = self.latest.as_ref().map(|(_, latest)| latest.workspace);
        let checked = proposal.map_err(InvalidProposal::Message);
        let checked = checked.and_then(|proposal| {
            self.rules.check(&proposal)?;
            check_inside(&proposal, workspace)?;
            Ok(proposal)
        });
        let proposal = match checked {
            Ok(proposal) => proposal,
            Err(reason) => {
                if self.invalid.len() == INVALID {
                    self.invalid.pop_front();
                }
                self.invalid.push_back((id, reason.clone()));
                return Proposed::Invalid(reason);
            }
        };
        if !planted(Mutation::SupersededStaysPending) {
            self.close_pending(ProposalStatus::Superseded);
        }
        self.remember(id);
        self.newest = Some(Newest {
            proposal,
            invalid: None,
            source_heightmap: None,
        });
        self.find_source();
        Proposed::Pending
    }

    /// A new proposal is pending.
    fn remember(&mut self, id: ProposalId) {
        if self.statuses.len() == PROPOSALS {
            self.statuses.pop_front();
        }
        self.statuses.push_back((id, ProposalStatus::Pending));
    }

    fn why_invalid(&self, id: ProposalId) -> Option<&InvalidProposal> {
        let mut known = self.invalid.iter().rev();
        known
            .find(|(known, _)| *known == id)
            .map(|(_, reason)| reason)
    }

    /// The answer about an id without a status.
    fn unknown(&self, id: ProposalId) -> Answer {
        match self.why_invalid(id) {
            Some(reason) => Answer::Refuse(reason.clone().into()),
            None => Answer::Wait(Refusal::Unknown { id }),
        }
    }

    /// Checks that somebody's decision on a proposal counts: where the rules name operators, approvals and rejections of these alone. A stop is
    /// taken from everybody. To be asked before [`Self::on_confirmation`]; names are no authentication.
    ///
    /// # Errors
    /// The name is none of the operators'.
    pub fn check_operator(
        &self,
        id: ProposalId,
        decision: OperatorDecision,
        name: &str,
    ) -> Result<(), Refusal> {
        let operators = &self.rules.operators;
        let decides = operators.is_empty() || operators.iter().any(|operator| operator == name);
        if decides || decision == OperatorDecision::Stop {
            return Ok(());
        }
        Err(Refusal::NotAnOperator {
            id,
            name: name.to_owned(),
            operators: operators.clone(),
        })
    }

    /// Takes a confirmation. Decisions that speak of a motion that was carried out are for the goal tracker.
    pub fn on_confirmation(
        &mut self,
        id: ProposalId,
        decision: OperatorDecision,
        robot: &impl RobotState,
        now: Duration,
    ) -> Vec<GateAction> {
        self.confirm(id, decision, robot, now, now)
    }

    /// Answers the confirmations that wait, where what they wait for has arrived or their time is up.
    pub fn on_news(&mut self, robot: &impl RobotState, now: Duration) -> Vec<GateAction> {
        let waiting = std::mem::take(&mut self.waiting);
        let again = |waiting: Waiting| {
            let Waiting {
                id,
                decision,
                since,
                ..
            } = waiting;
            self.confirm(id, decision, robot, now, since)
        };
        waiting.into_iter().flat_map(again).collect()
    }

    /// When [`Self::on_news`] has to be called at the latest.
    pub fn deadline(&self) -> Option<Duration> {
        self.waiting.iter().map(|waiting| waiting.until).min()
    }

    /// `since`: when it arrived.
    fn confirm(
        &mut self,
        id: ProposalId,
        decision: OperatorDecision,
        robot: &impl RobotState,
        now: Duration,
        since: Duration,
    ) -> Vec<GateAction> {
        let mut actions = Vec::new();
        if decision == OperatorDecision::Stop {
            // Nothing goes on by itself after a stop.
            self.unasked.stop();
            if !planted(Mutation::WaitingSurvivesStop) {
                actions.extend(self.refuse_waiting(|id| Refusal::StopCame { id }));
            }
        }
        let verdict = match decision {
            OperatorDecision::Approve => self.approve(id, robot),
            OperatorDecision::Reject => self.reject(id),
            OperatorDecision::Stop => self.stop(id),
            OperatorDecision::Advance | OperatorDecision::Retry | OperatorDecision::StepBack => {
                Answer::Nothing
            }
        };
        match verdict {
            Answer::Act(action) => actions.push(action),
            Answer::Report(outcome, reason) => actions.push(self.report(id, outcome, reason)),
            Answer::Refuse(refusal) => actions.push(self.refuse(id, &refusal)),
            Answer::Wait(refusal) => {
                let grace = match refusal {
                    Refusal::NotRehearsed { .. } => REHEARSAL_GRACE,
                    _ => self.rules.confirmation_grace,
                };
                let until = since + grace;
                if now >= until || self.waiting.len() >= WAITING {
                    actions.push(self.refuse(id, &refusal));
                } else {
                    self.waiting.push_back(Waiting {
                        id,
                        decision,
                        since,
                        until,
                    });
                }
            }
            Answer::Nothing => {}
        }
        actions
    }

    fn report(&self, id: ProposalId, outcome: StepOutcome, reason: String) -> GateAction {
        GateAction::Report(Report {
            id,
            outcome,
            reason,
            status: self.final_status(id),
        })
    }

    /// Where a proposal stands for others: one whose id stands for two contents cannot be approved any more.
    pub fn final_status(&self, id: ProposalId) -> Option<ProposalStatus> {
        let status = self.status(id)?;
        let newest = self.newest.as_ref();
        let is_invalid =
            newest.is_some_and(|newest| newest.proposal.id == id && newest.invalid.is_some());
        Some(match status {
            ProposalStatus::Pending if is_invalid => ProposalStatus::Superseded,
            status => status,
        })
    }

    fn refuse(&self, id: ProposalId, refusal: &Refusal) -> GateAction {
        self.report(id, StepOutcome::Refused, refusal.to_string())
    }

    fn refuse_waiting(&mut self, refusal: impl Fn(ProposalId) -> Refusal) -> Vec<GateAction> {
        let waiting = std::mem::take(&mut self.waiting);
        let refuse = |waiting: Waiting| self.refuse(waiting.id, &refusal(waiting.id));
        waiting.into_iter().map(refuse).collect()
    }

    /// Says why a proposal cannot be approved any more; whether it can be now, only [`Self::on_confirmation`] knows.
    ///
    /// # Errors
    /// It is not pending.
    pub fn check_pending(&self, id: ProposalId) -> Result<(), Refusal> {
        match (self.status(id), &self.newest) {
            (None, _) => Err(match self.why_invalid(id) {
                Some(reason) => reason.clone().into(),
                None => Refusal::Unknown { id },
            }),
            (Some(ProposalStatus::Pending), Some(newest)) if newest.proposal.id == id => {
                match &newest.invalid {
                    Some(reason) => Err(reason.clone().into()),
                    None => Ok(()),
                }
            }
            (Some(status), _) => Err(Refusal::NotPending { id, status }),
        }
    }

    /// The proposal that can be approved, the way home apart.
    pub fn pending(&self) -> Option<&Proposal> {
        let newest = self.newest.as_ref()?;
        let id = newest.proposal.id;
        self.check_pending(id).ok().map(|()| &newest.proposal)
    }

    /// Takes a proposal back that nobody has approved yet.
    pub fn withdraw(&mut self, id: ProposalId) {
        if self.status(id) == Some(ProposalStatus::Pending) {
            self.set_status(id, ProposalStatus::Withdrawn);
        }
    }

    /// Proposes the way home from where the arm is, maybe after what is held is put down; `id` is for a new proposal. Returns the id of the one
    /// that can be approved now: the one before where the arm has not moved since.
    ///
    /// # Errors
    /// Says why there is no way home now, or that it has to be rehearsed first.
    pub fn propose_home(
        &mut self,
        id: ProposalId,
        recovery: Recovery,
        robot: &impl RobotState,
    ) -> Result<ProposalId, CannotBegin> {
        let refuse = |obstacle| Err(CannotBegin::Refused(obstacle));
        if let Some(id) = self.moving {
            let busy = MotionCause::Proposal(id).busy_text();
            return refuse(RefusalReason::Busy.because(busy));
        }
        if let Some(id) = self.homing {
            let busy = MotionCause::Home(id).busy_text();
            return refuse(RefusalReason::OnItsWayHome.because(busy));
        }
        if let Some(obstacle) = robot.obstacle() {
            return refuse(obstacle);
        }
        let from_rad = robot.check_recovery(recovery)?;
        if let Some(home) = &self.home
            && home.recovery == recovery
            && home.is_from(&from_rad)
        {
            return Ok(home.id);
        }
        if self.status(id).is_some() {
            let text = format!("the id {id} is that of another proposal");
            return refuse(RefusalReason::Other.because(text));
        }
        self.close_home(ProposalStatus::Superseded);
        self.remember(id);
        self.home = Some(Home {
            id,
            recovery,
            from_rad,
        });
        Ok(id)
    }

    /// The motion of [`GateAction::Move`] or [`GateAction::GoHome`] has ended; `until` is the ROS time from which on heightmaps
    /// show its result. `broken_off`: by a stop or a fault, after which nothing goes on by itself.
    pub fn finish(&mut self, until: Duration, broken_off: bool) -> Vec<GateAction> {
        let moved = self.moving.take();
        if let Some(id) = moved {
            let done = match planted(Mutation::ApprovalMovesTwice) {
                true => ProposalStatus::Pending,
                false => ProposalStatus::Done,
            };
            self.set_status(id, done);
        }
        let homed = self.homing.take();
        if let Some(id) = homed {
            self.set_status(id, ProposalStatus::Done);
        }
        if moved.is_some() || homed.is_some() {
            self.moved_until = Some(until).filter(|_| !planted(Mutation::ApprovalMovesTwice));
        }
        if !broken_off {
            return Vec::new();
        }
        self.unasked.stop();
        self.refuse_waiting(|id| Refusal::MotionBrokenOff { id })
    }

    /// The node is deactivated: no approval from before may move anything later.
    pub fn deactivate(&mut self) {
        if !planted(Mutation::WaitingSurvivesDeactivation) {
            self.waiting.clear();
        }
        self.close_home(ProposalStatus::Withdrawn);
    }

    fn approve(&mut self, id: ProposalId, robot: &impl RobotState) -> Answer {
        let id = match &self.newest {
            Some(newest) if planted(Mutation::AnyApprovalMovesNewest) => newest.proposal.id,
            _ => id,
        };
        match self.status(id) {
            None => return self.unknown(id),
            Some(ProposalStatus::Pending) => {}
            Some(status) => return Answer::Refuse(Refusal::NotPending { id, status }),
        }
        if let Some(moving) = self.moving
            && !planted(Mutation::MovesWhileMoving)
        {
            return Answer::Refuse(Refusal::Busy { id, moving });
        }
        if self.homing.is_some() {
            return Answer::Refuse(Refusal::Homing { id });
        }
        if let Some(home) = self.home
            && (home.id == id || planted(Mutation::AnyApprovalMovesHome))
        {
            return self.approve_home(home, robot);
        }
        // Only the newest proposal is pending.
        let newest = match &self.newest {
            Some(newest)
                if newest.proposal.id == id || planted(Mutation::SupersededStaysPending) =>
            {
                newest
            }
            _ => {
                let status = ProposalStatus::Superseded;
                return Answer::Refuse(Refusal::NotPending { id, status });
            }
        };
        if let Some(reason) = &newest.invalid {
            return Answer::Refuse(reason.clone().into());
        }
        let proposal = &newest.proposal;
        if let Some(obstacle) = robot.obstacle() {
            return Answer::Refuse(Refusal::Robot { id, obstacle });
        }
        if let Some(moved_until) = self.moved_until
            && proposal.stamp < moved_until
        {
            return Answer::Refuse(Refusal::OldObservation {
                id,
                stamp: proposal.stamp,
                moved_until,
            });
        }
        if let Err(verdict) = self.check_unchanged(newest) {
            return verdict;
        }
        match robot.check_motion(proposal) {
            Ok(()) => {}
            Err(CannotBegin::Refused(obstacle)) => {
                return Answer::Refuse(Refusal::Robot { id, obstacle });
            }
            Err(CannotBegin::NotRehearsed) if planted(Mutation::MovesUnrehearsed) => {}
            Err(CannotBegin::NotRehearsed) => {
                return Answer::Wait(Refusal::NotRehearsed { id });
            }
        }
        let proposal = Box::new(proposal.clone());
        if !planted(Mutation::HomeSurvivesMotion) {
            self.close_home(ProposalStatus::Withdrawn);
        }
        self.set_status(id, ProposalStatus::Moving);
        self.moving = Some(id);
        // After a stop or a fault an approval lets things go on.
        self.unasked.go_on(self.rules.require_approval);
        Answer::Act(GateAction::Move(proposal))
    }

    /// Approves a way home. It lets nothing else go on after a stop or a fault.
    fn approve_home(&mut self, home: Home, robot: &impl RobotState) -> Answer {
        let id = home.id;
        if let Some(obstacle) = robot.obstacle() {
            return Answer::Refuse(Refusal::Robot { id, obstacle });
        }
        match robot.check_recovery(home.recovery) {
            Ok(from_rad) if home.is_from(&from_rad) => {}
            Ok(_) | Err(CannotBegin::NotRehearsed) => {
                self.close_home(ProposalStatus::Withdrawn);
                return Answer::Refuse(Refusal::HomeFromElsewhere { id });
            }
            Err(CannotBegin::Refused(obstacle)) => {
                return Answer::Refuse(Refusal::Robot { id, obstacle });
            }
        }
        self.home = None;
        self.set_status(id, ProposalStatus::Moving);
        self.homing = Some(id);
        Answer::Act(match home.recovery {
            Recovery::Home => GateAction::GoHome(id),
            Recovery::PutDown => GateAction::PutDown(id),
        })
    }

    fn reject(&mut self, id: ProposalId) -> Answer {
        match self.status(id) {
            None => self.unknown(id),
            Some(ProposalStatus::Pending) => {
                self.home.take_if(|home| home.id == id);
                self.set_status(id, ProposalStatus::Rejected);
                Answer::Report(StepOutcome::Rejected, "rejected by the operator".into())
            }
            Some(status) => Answer::Refuse(Refusal::NotPending { id, status }),
        }
    }

    /// A stop is honoured whatever proposal it names.
    fn stop(&mut self, id: ProposalId) -> Answer {
        let mut withdrawn = self.close_pending(ProposalStatus::Withdrawn);
        if !planted(Mutation::HomeSurvivesStop) {
            withdrawn |= self.close_home(ProposalStatus::Withdrawn);
        }
        if self.moving.is_some() || self.homing.is_some() {
            return Answer::Act(GateAction::Cancel);
        }
        match self.status(id) {
            None => Answer::Refuse(Refusal::NothingToStop { id }),
            Some(ProposalStatus::Withdrawn) if withdrawn => Answer::Report(
                StepOutcome::Stopped,
                "stopped by the operator; nothing was moving".into(),
            ),
            // After its result it concerns only the goal tracker.
            Some(_) => Answer::Nothing,
        }
    }

    /// Checks that the newest heightmap shows what the proposal's own does.
    fn check_unchanged(&self, newest: &Newest) -> Result<(), Answer> {
        let Proposal { id, stamp, .. } = newest.proposal;
        let (Some(source), Some((latest_stamp, latest))) = (&newest.source_heightmap, &self.latest)
        else {
            return Err(Answer::Wait(Refusal::NoSourceHeightmap { id, stamp }));
        };
        let stamp = *latest_stamp;
        // The first heightmap may have come after the proposal.
        check_inside(&newest.proposal, Some(source.workspace))
            .map_err(|reason| Answer::Refuse(reason.into()))?;
        let PickPlace { pick, place } = newest.proposal.action;
        let around = [pick, place].map(|pose| pose.translation.vector.into());
        match largest_change(source, latest, &self.rules.changes, &around) {
            Ok(None) => Ok(()),
            Ok(Some(change)) => Err(Answer::Refuse(Refusal::ObservationChanged {
                id,
                stamp,
                change,
            })),
            Err(_) => Err(Answer::Refuse(Refusal::OtherWorkspace { id, stamp })),
        }
    }

    /// Where a proposal stands; none if it is unknown or invalid.
    pub fn status(&self, id: ProposalId) -> Option<ProposalStatus> {
        let mut known = self.statuses.iter().rev();
        known
            .find(|(known, _)| *known == id)
            .map(|(_, status)| *status)
    }

    fn set_status(&mut self, id: ProposalId, status: ProposalStatus) {
        let mut known = self.statuses.iter_mut().rev();
        if let Some((_, known)) = known.find(|(known, _)| *known == id) {
            *known = status;
        }
    }

    /// Says whether a proposal was pending, the way home apart.
    fn close_pending(&mut self, status: ProposalStatus) -> bool {
        let home = self.home.map(|home| home.id);
        let mut known = self.statuses.iter_mut().rev();
        let pending =
            known.find(|(id, known)| *known == ProposalStatus::Pending && Some(*id) != home);
        match pending {
            Some((_, pending)) => {
                *pending = status;
                true
            }
            None => false,
        }
    }

    /// Says whether a way home was proposed.
    fn close_home(&mut self, status: ProposalStatus) -> bool {
        let home = self.home.take();
        if let Some(home) = home {
            self.set_status(home.id, status);
        }
        home.is_some()
    }
}

impl Home {
    fn is_from(&self, joints_rad: &JointPositions) -> bool {
        (self.from_rad - joints_rad).amax() <= AT_REST_RAD
    }
}

impl GateRules {
    /// Checks what can be checked of a proposal by itself.
    fn check(&self, proposal: &Proposal) -> Result<(), InvalidProposal> {
        let id = proposal.id;
        if proposal.frame != self.frame {
            return Err(InvalidProposal::Frame {
                id,
                actual: proposal.frame.clone(),
                expected: self.frame.clone(),
            });
        }
        let PickPlace { pick, place } = &proposal.action;
        for (which, pose) in [("pick", pick), ("place", place)] {
            let (x_m, y_m) = (pose.translation.x, pose.translation.y);
            let yaw_rad = pose.rotation.angle();
            if !(x_m.is_finite() && y_m.is_finite() && yaw_rad.is_finite()) {
                return Err(InvalidProposal::NotFinite {
                    id,
                    which,
                    x_m,
                    y_m,
                    yaw_rad,
                });
            }
        }
        let (settings, limits) = (&proposal.settings, &self.limits);
        let ranges = [
            ("clearance_m", settings.clearance_m, limits.clearance_m),
            ("lift_m", settings.lift_m, limits.lift_m),
            ("travel_m_s", settings.travel_m_s, limits.travel_m_s),
            ("carry_m_s", settings.carry_m_s, limits.carry_m_s),
            ("descend_m_s", settings.descend_m_s, limits.descend_m_s),
            (
                "acceleration_m_s2",
                settings.acceleration_m_s2,
                limits.acceleration_m_s2,
            ),
        ];
        // Not a number fails both comparisons.
        let mut ranges = ranges.into_iter();
        match ranges.find(|(_, value, limit)| !(*value > 0.0 && value <= limit)) {
            Some((name, value, limit)) => Err(InvalidProposal::Settings {
                id,
                name,
                value,
                limit,
            }),
            None => Ok(()),
        }
    }
}

/// Checks that both poses lie on the heightmap, once one is known.
fn check_inside(proposal: &Proposal, workspace: Option<Workspace>) -> Result<(), InvalidProposal> {
    let Some(workspace) = workspace else {
        return Ok(());
    };
    let PickPlace { pick, place } = &proposal.action;
    let mut poses = [("pick", pick), ("place", place)].into_iter();
    let outside = poses.find(|(_, pose)| {
        let position = pose.translation.vector.into();
        workspace.pixel(&position).is_none()
    });
    match outside {
        Some((which, pose)) => Err(InvalidProposal::OutsideWorkspace {
            id: proposal.id,
            which,
            x_m: pose.translation.x,
            y_m: pose.translation.y,
            workspace: Box::new(workspace),
        }),
        None => Ok(()),
    }
}

fn seconds(stamp: Duration) -> String {
    format!("{:.3} s", stamp.as_secs_f64())
}
