//! When to propose: heightmaps, goals, confirmations and results in, jobs for a network and proposals out.

use std::sync::Arc;
use std::time::Duration;

use heightmap::{ChangeRules, Disk, Heightmap, largest_change};
use nalgebra::{Isometry2, Point2};
use pick_place::PickPlace;

use crate::mutation::{Mutation, planted};
use crate::{
    Confirmation, FailedPicks, Goal, Observation, OperatorDecision, Proposal, ProposalId,
    ProposalStatus, StepOutcome, StepResult, yaw_rad,
};

/// What the network is to look at.
#[derive(Clone, Debug, PartialEq)]
pub struct Job {
    /// What is seen.
    pub observation: Arc<Heightmap>,
    /// The image to be reached, v_k.
    pub goal: Arc<Heightmap>,
    /// The image before it, v_(k-1), where there is one.
    pub previous: Option<Arc<Heightmap>>,
    /// Picks to be left out: those that the operator has rejected for this step, and those that have just failed.
    pub exclude: Vec<Disk>,
}

/// What the network answers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Prediction {
    /// Where to grasp, in the world.
    pub pick: Isometry2<f64>,
    /// Where to release, in the world.
    pub place: Isometry2<f64>,
    /// Probability of the pick cell.
    pub pick_score: f32,
    /// Probability of the place cell and rotation.
    pub place_score: f32,
    /// Probability that the step succeeds, where something estimates it.
    pub success_probability: Option<f32>,
    /// Probability that the goal is reached already, where something estimates it.
    pub done_probability: Option<f32>,
}

/// How a planner proposes.
#[derive(Clone, Debug, PartialEq)]
pub struct PlannerRules {
    /// When the observation has changed.
    pub changes: ChangeRules,
    /// Picks are left out within this distance of one that the operator rejected.
    pub rejected_radius_m: f64,
    /// Name of the checkpoint, for the proposals.
    pub checkpoint: String,
    /// Name of the node, for the proposals.
    pub author: String,
}

/// How far the present goal has come.
#[derive(Clone, Debug)]
enum Progress {
    /// Waits for a heightmap that is not older than the goal.
    Waiting,
    /// The network works; a newer goal may have made its answer useless.
    Predicting(Observation),
    /// Waits for the operator.
    Proposed(Pending),
    /// The operator has approved; the arm may be moving before the cameras.
    Approved(Pending),
    /// The arm has moved, or the proposal was withdrawn: the operator decides what is next, and a new goal comes.
    Closed,
    /// The network could not decide; only another observation or goal can help.
    Failed(Observation),
}

/// A proposal that stands.
#[derive(Clone, Debug)]
struct Pending {
    observation: Observation,
    id: ProposalId,
    pick: Isometry2<f64>,
    place: Isometry2<f64>,
    /// Its approval was refused: a newer observation gives a newer proposal, changed or not.
    refused: bool,
}

/// The last proposal that was made, until its motion's result has come.
#[derive(Clone, Debug)]
struct LastProposal {
    id: ProposalId,
    pick: Isometry2<f64>,
}

/// Proposes once for each step and attempt, from the first heightmap that is not older than the goal, and again when the
/// observation changes before an approval.
///
/// A goal with the same step and stamp but a further attempt follows a rejection, as nothing has moved: the rejected pick is
/// then left out.
#[derive(Debug)]
pub struct ProposalPlanner {
    rules: PlannerRules,
    goal: Option<Goal>,
    newest: Option<Observation>,
    rejected: Vec<Isometry2<f64>>,
    failed: FailedPicks,
    progress: Progress,
    /// The last proposal for this goal.
    last_proposal_id: Option<ProposalId>,
    /// The last proposal for this or an earlier goal whose motion has not been reported yet.
    last_proposal: Option<LastProposal>,
    /// The end of the last motion: observations from before it are no ground for another.
    moved_until: Duration,
    /// The proposal for this goal ended otherwise than by a rejection of its pick.
    is_pick_good: bool,
    /// How many proposals for this goal were superseded by somebody else's: the next one needs another id.
    revision: u64,
    /// The network works on an answer that is not needed any more.
    outdated: bool,
}

impl ProposalPlanner {
    /// A planner that has received nothing yet.
    pub fn new(rules: PlannerRules) -> Self {
        Self {
            rules,
            goal: None,
            newest: None,
            rejected: Vec::new(),
            failed: FailedPicks::default(),
            progress: Progress::Waiting,
            last_proposal_id: None,
            last_proposal: None,
            moved_until: Duration::ZERO,
            is_pick_good: false,
            revision: 0,
            outdated: false,
        }
    }

    /// From the next observation on.
    pub fn set_rules(&mut self, rules: PlannerRules) {
        self.rules = rules;
    }

    /// A heightmap has arrived. Ones that are older than the newest are ignored, unless the clock was set back, which only a
    /// new goal with an older stamp tells.
    pub fn on_heightmap(&mut self, observation: Observation) -> Option<Job> {
        let newest = self.newest.as_ref();
        if newest.is_some_and(|newest| observation.stamp < newest.stamp) {
            return None;
        }
        self.newest = Some(observation);
        self.next_job()
    }

    /// A goal has arrived.
    pub fn on_goal(&mut self, goal: Goal) -> Option<Job> {
        if let Some(before) = &self.goal {
            if *before == goal {
                return None;
            }
            let same_step = before.problem == goal.problem
                && before.demonstration == goal.demonstration
                && before.step == goal.step;
            let rejected = same_step && before.stamp == goal.stamp && before.attempt < goal.attempt;
            match &self.progress {
                // Somebody else's proposal may have been rejected: that says nothing about this pick.
                Progress::Proposed(pending) | Progress::Approved(pending)
                    if rejected && !self.is_pick_good =>
                {
                    self.rejected.push(pending.pick);
                }
                _ if !same_step => {
                    self.rejected.clear();
                    self.failed.forget();
                }
                _ => {}
            }
            if goal.stamp < before.stamp {
                self.newest = None;
                self.moved_until = Duration::ZERO;
            }
        }
        self.last_proposal_id = None;
        self.is_pick_good = false;
        self.revision = 0;
        self.goal = Some(goal);
        self.start_again();
        self.next_job()
    }

    /// Waits for an observation; what the network works on is not needed any more.
    fn start_again(&mut self) {
        self.outdated |= matches!(self.progress, Progress::Predicting(_));
        self.progress = Progress::Waiting;
    }

    /// The operator has decided: an approved proposal stands while the arm moves.
    pub fn on_confirmation(&mut self, confirmation: &Confirmation) {
        let Progress::Proposed(pending) = &self.progress else {
            return;
        };
        let own = pending.id == confirmation.proposal_id;
        match confirmation.decision {
            OperatorDecision::Approve if own => {
                self.progress = Progress::Approved(pending.clone());
            }
            OperatorDecision::Reject => self.is_pick_good = !own,
            _ => {}
        }
    }

    /// Whether the proposal should be published again: the operator has decided on another one, which came to nothing, and may
    /// see that one in its place; or the executor does not know it.
    pub fn needs_republish(&self, result: &StepResult) -> bool {
        let pending = match &self.progress {
            Progress::Proposed(pending) | Progress::Approved(pending) => pending,
            _ => return false,
        };
        let refused = result.outcome == StepOutcome::Refused;
        if pending.id == result.proposal_id {
            refused && result.status.is_none()
        } else {
            matches!(self.progress, Progress::Proposed(_)) && !result.arm_moved()
        }
    }

    /// The executor has reported: after a motion nothing more is proposed for this goal, after a refusal of the approval the
    /// proposal is pending again.
    pub fn on_result(&mut self, result: &StepResult) -> Option<Job> {
        if result.arm_moved() {
            self.moved_until = result.stamp;
            self.record_motion(result);
        }
        if self.last_proposal_id == Some(result.proposal_id) {
            if result.was_carried_out() {
                self.moved_until = result.stamp;
                // The heightmap after the motion may come before its result.
                self.start_again();
                self.progress = Progress::Closed;
            } else if result.outcome == StepOutcome::Refused {
                self.on_refusal(result.status);
            } else if result.outcome == StepOutcome::Stopped {
                // Withdrawn: only another goal lets things go on.
                self.start_again();
                self.progress = Progress::Closed;
            } else {
                // A goal that says so follows.
                return None;
            }
        }
        self.next_job()
    }

    /// The approval of the present proposal was refused.
    fn on_refusal(&mut self, status: Option<ProposalStatus>) {
        // The executor has forgotten the motion or the stop, as it was started again, and may be the only one that could tell of it.
        let forgotten = [ProposalStatus::Pending, ProposalStatus::Superseded];
        if matches!(self.progress, Progress::Closed)
            && status.is_some_and(|status| forgotten.contains(&status))
        {
            self.revision += 1;
            self.progress = Progress::Waiting;
            return;
        }
        let (Progress::Proposed(pending) | Progress::Approved(pending)) = &mut self.progress else {
            return;
        };
        match status {
            // Another approval moves the arm already.
            Some(ProposalStatus::Moving) if !planted(Mutation::RefusalReopensMoving) => {
                self.progress = Progress::Approved(pending.clone());
            }
            // The executor will not accept this id any more.
            Some(ProposalStatus::Superseded) if !planted(Mutation::RefusedIsNotRenewed) => {
                self.revision += 1;
                self.progress = Progress::Waiting;
            }
            // The goal tracker publishes a goal with another attempt.
            Some(status @ (ProposalStatus::Rejected | ProposalStatus::Withdrawn)) => {
                self.is_pick_good = status == ProposalStatus::Withdrawn;
                self.progress = Progress::Proposed(pending.clone());
            }
            _ => {
                pending.refused = !planted(Mutation::RefusedIsNotRenewed);
                self.progress = Progress::Proposed(pending.clone());
            }
        }
    }

    /// Keeps what a failed motion says about picks. Its result may come after the goal of the next attempt: then what was
    /// made without it is made anew.
    fn record_motion(&mut self, result: &StepResult) {
        let last = self
            .last_proposal
            .take_if(|last| last.id == result.proposal_id);
        let Some(LastProposal { id, pick }) = last else {
            // Somebody else's pick is not known; where it held something, the scene has changed.
            let failed = [StepOutcome::NoContact, StepOutcome::GraspFailed];
            if !failed.contains(&result.outcome) {
                self.failed.forget();
            }
            return;
        };
        let before = self.failed.exclusions().count();
        self.failed.record(&pick, result.outcome);
        let is_late = self.last_proposal_id != Some(id);
        if is_late
            && self.failed.exclusions().count() > before
            && matches!(
                self.progress,
                Progress::Predicting(_) | Progress::Proposed(_)
            )
        {
            self.start_again();
        }
    }

    /// The network has answered the last job: `Err` says why it could not. The proposal, if it is still needed, and the next
    /// job.
    pub fn on_prediction(
        &mut self,
        prediction: Result<&Prediction, String>,
    ) -> (Option<Result<Proposal, String>>, Option<Job>) {
        if std::mem::take(&mut self.outdated) {
            // `progress` speaks of a newer goal.
            if let Progress::Predicting(_) = self.progress {
                self.progress = Progress::Waiting;
            }
            return (None, self.next_job());
        }
        let (Progress::Predicting(observation), Some(goal)) = (&self.progress, &self.goal) else {
            return (None, None);
        };
        let observation = observation.clone();
        let proposal = match prediction {
            Ok(prediction) => {
                let proposal = propose(&observation, goal, prediction, &self.rules, self.revision);
                self.last_proposal_id = Some(proposal.id);
                self.last_proposal = Some(LastProposal {
                    id: proposal.id,
                    pick: prediction.pick,
                });
                self.progress = Progress::Proposed(Pending {
                    observation,
                    id: proposal.id,
                    pick: prediction.pick,
                    place: prediction.place,
                    refused: false,
                });
                Ok(proposal)
            }
            Err(reason) => {
                self.progress = Progress::Failed(observation);
                Err(reason)
            }
        };
        (Some(proposal), self.next_job())
    }

    /// One job at a time: the next when the network has answered.
    fn next_job(&mut self) -> Option<Job> {
        let (Some(goal), Some(newest)) = (&self.goal, &self.newest) else {
            return None;
        };
        if goal.complete || newest.stamp < goal.stamp || self.outdated {
            return None;
        }
        let is_due = |seen: &Observation, around: &[Point2<f64>]| {
            let moved = seen.stamp < self.moved_until && newest.stamp >= self.moved_until;
            moved || self.rules.has_changed(seen, newest, around)
        };
        let due = match &self.progress {
            Progress::Waiting => true,
            Progress::Proposed(pending) => {
                let seen = &pending.observation;
                let poses = [pending.pick, pending.place];
                let around = poses.map(|pose| pose.translation.vector.into());
                is_due(seen, &around) || (pending.refused && newest.stamp > seen.stamp)
            }
            Progress::Failed(seen) => is_due(seen, &[]),
            Progress::Predicting(_) | Progress::Approved(_) | Progress::Closed => false,
        };
        if !due {
            return None;
        }
        let rejected = self.rejected.iter().map(|pick| Disk {
            center_m: pick.translation.vector.into(),
            radius_m: self.rules.rejected_radius_m,
        });
        let job = Job {
            observation: Arc::clone(&newest.heightmap),
            goal: Arc::clone(&goal.image),
            previous: goal.previous.clone(),
            exclude: rejected.chain(self.failed.exclusions()).collect(),
        };
        self.progress = Progress::Predicting(newest.clone());
        Some(job)
    }
}

impl PlannerRules {
    fn has_changed(
        &self,
        before: &Observation,
        after: &Observation,
        around: &[Point2<f64>],
    ) -> bool {
        let (old, new) = (&before.heightmap, &after.heightmap);
        // Another workspace is a change too.
        before.stamp != after.stamp
            && !matches!(largest_change(old, new, &self.changes, around), Ok(None))
    }
}

fn propose(
    observation: &Observation,
    goal: &Goal,
    prediction: &Prediction,
    rules: &PlannerRules,
    revision: u64,
) -> Proposal {
    let mut hash = Fnv1a::new();
    hash.write(observation.stamp.as_nanos() as u64);
    hash.write(goal.step.into());
    hash.write(goal.attempt.into());
    for pose in [&prediction.pick, &prediction.place] {
        for value in [
            pose.translation.x,
            pose.translation.y,
            yaw_rad(&pose.rotation),
        ] {
            hash.write(value.to_bits());
        }
    }
    if revision > 0 {
        hash.write(revision);
    }
    Proposal {
        id: ProposalId(hash.finish()),
        frame: observation.frame.clone(),
        stamp: observation.stamp,
        problem: goal.problem.clone(),
        step: goal.step,
        attempt: goal.attempt,
        module: goal.module.clone(),
        action: PickPlace {
            pick: prediction.pick,
            place: prediction.place,
        },
        settings: goal.settings,
        pick_score: prediction.pick_score,
        place_score: prediction.place_score,
        success_probability: prediction.success_probability,
        checkpoint: rules.checkpoint.clone(),
        author: rules.author.clone(),
        done_probability: prediction.done_probability,
    }
}

/// FNV-1a of 64 bits: the same contents have the same id in every run and version of Rust.
struct Fnv1a(u64);

impl Fnv1a {
    fn new() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }

    fn write(&mut self, value: u64) {
        for byte in value.to_le_bytes() {
            self.0 = (self.0 ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
    }

    fn finish(self) -> u64 {
        self.0
    }
}
