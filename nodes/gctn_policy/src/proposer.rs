//! When to propose: heightmaps, goals, confirmations and results in, jobs for the network and proposals out.
//! Knows neither a ROS node nor the network.

use std::{sync::Arc, time::Duration};

use gctn::Decision;
use heightmap::Heightmap;
use msgs::{
    convert::{self, ConvertError},
    sctn_msgs::{Goal, PickPlace, StepConfirmation, StepResult},
    std_msgs::Header,
};
use nalgebra::Isometry2;

/// What the network is to look at.
#[derive(Clone, Debug, PartialEq)]
pub struct Job {
    /// What is seen.
    pub observation: Arc<Heightmap>,
    /// What it should become.
    pub goal: Arc<Heightmap>,
    /// Picks that the operator has rejected for this step.
    pub exclude: Vec<Isometry2<f64>>,
}

/// What is seen, and since when.
#[derive(Clone, Debug)]
struct Observation {
    stamp: Duration,
    header: Header,
    heightmap: Arc<Heightmap>,
}

/// What is wanted.
#[derive(Clone, Debug)]
struct Wanted {
    /// Without its heightmap.
    message: Goal,
    stamp: Duration,
    heightmap: Arc<Heightmap>,
}

/// How far the present goal has come.
#[derive(Clone, Debug)]
enum Progress {
    /// Waits for a heightmap that is not older than the goal.
    Waiting,
    /// The network works; a newer goal may have made its answer useless.
    Deciding(Observation),
    /// Waits for the operator.
    Proposed(Observation, u64, Isometry2<f64>),
    /// The operator has approved; the arm may be moving before the cameras.
    Approved(Observation, u64, Isometry2<f64>),
    /// The arm has moved: the operator decides what is next, and a new goal comes.
    Moved,
    /// The network could not decide; only another observation or goal can help.
    Failed(Observation),
}

/// When an observation counts as changed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChangeRule {
    /// A cell has changed when its height differs by more.
    pub tolerance_m: f32,
    /// The observation has changed when more than this share of its cells has.
    pub fraction: f64,
}

/// Proposes once for each step and attempt, from the first heightmap that is not older than the goal, and
/// again when the observation changes before an approval.
///
/// A goal with the same step and stamp but a further attempt follows a rejection, as nothing has moved: the
/// rejected pick is then left out.
#[derive(Debug)]
pub struct Proposer {
    change: ChangeRule,
    goal: Option<Wanted>,
    newest: Option<Observation>,
    rejected: Vec<Isometry2<f64>>,
    progress: Progress,
    /// The last proposal for this goal.
    said: Option<u64>,
    /// The end of the last motion: observations from before it are no ground for another.
    moved_until: Duration,
    /// The operator has rejected somebody else's proposal for this goal.
    rejected_another: bool,
    /// The network works on an answer that nobody needs any more.
    outdated: bool,
}

impl Proposer {
    /// Knows nothing yet.
    pub fn new(change: ChangeRule) -> Self {
        Self {
            change,
            goal: None,
            newest: None,
            rejected: Vec::new(),
            progress: Progress::Waiting,
            said: None,
            moved_until: Duration::ZERO,
            rejected_another: false,
            outdated: false,
        }
    }

    /// From the next observation on.
    pub fn set_change_rule(&mut self, change: ChangeRule) {
        self.change = change;
    }

    /// A heightmap has arrived. Ones that are older than the newest are ignored, unless the clock was set
    /// back, which only a new goal with an older stamp tells.
    pub fn observed(
        &mut self,
        message: msgs::sctn_msgs::Heightmap,
    ) -> Result<Option<Job>, ConvertError> {
        let stamp = convert::time_from_msg(&message.header.stamp)?;
        if self
            .newest
            .as_ref()
            .is_some_and(|newest| stamp < newest.stamp)
        {
            return Ok(None);
        }
        let header = message.header.clone();
        let heightmap = Arc::new(convert::heightmap_from_msg(message)?);
        self.newest = Some(Observation {
            stamp,
            header,
            heightmap,
        });
        Ok(self.next())
    }

    /// A goal has arrived.
    pub fn wanted(&mut self, mut message: Goal) -> Result<Option<Job>, ConvertError> {
        let stamp = convert::time_from_msg(&message.header.stamp)?;
        convert::settings_from_msg(&message.settings)?;
        let heightmap = Arc::new(convert::heightmap_from_msg(std::mem::take(
            &mut message.heightmap,
        ))?);
        let wanted = Wanted {
            message,
            stamp,
            heightmap,
        };
        if let Some(before) = &self.goal {
            if before.message == wanted.message && before.heightmap == wanted.heightmap {
                return Ok(None);
            }
            let same_step = before.message.problem == wanted.message.problem
                && before.message.demonstration == wanted.message.demonstration
                && before.message.step == wanted.message.step;
            let rejected = same_step
                && before.stamp == wanted.stamp
                && before.message.attempt < wanted.message.attempt;
            match (&self.progress, same_step) {
                // Somebody else's proposal may have been rejected: that says nothing about this pick.
                (Progress::Proposed(_, _, pick) | Progress::Approved(_, _, pick), _)
                    if rejected && !self.rejected_another =>
                {
                    self.rejected.push(*pick);
                }
                (_, false) => self.rejected.clear(),
                _ => {}
            }
            if wanted.stamp < before.stamp {
                self.newest = None;
                self.moved_until = Duration::ZERO;
            }
        }
        self.said = None;
        self.rejected_another = false;
        self.outdated |= matches!(self.progress, Progress::Deciding(_));
        self.goal = Some(wanted);
        self.progress = Progress::Waiting;
        Ok(self.next())
    }

    /// The operator has spoken: an approved proposal stands while the arm moves.
    pub fn confirmed(&mut self, confirmation: &StepConfirmation) {
        if let Progress::Proposed(_, id, _) = &self.progress
            && confirmation.decision == StepConfirmation::REJECT
        {
            self.rejected_another = *id != confirmation.proposal_id;
        }
        let approves = confirmation.decision == StepConfirmation::APPROVE;
        if let Progress::Proposed(observation, id, pick) = &self.progress
            && approves
            && *id == confirmation.proposal_id
        {
            self.progress = Progress::Approved(observation.clone(), *id, *pick);
        }
    }

    /// Whether the proposal should be said again: the operator has decided on another one, which the executor refused, and
    /// may see that one in its place.
    pub fn is_overlooked(&self, result: &StepResult) -> bool {
        matches!(&self.progress, Progress::Proposed(_, id, _) if *id != result.proposal_id)
            && result.outcome == StepResult::REFUSED
    }

    /// The executor has reported: after a motion nothing more is proposed for this goal, after a refusal
    /// of the approval the proposal is open again.
    pub fn result(&mut self, result: &StepResult) -> Option<Job> {
        if result.duration != Default::default()
            && let Ok(end) = convert::time_from_msg(&result.header.stamp)
        {
            self.moved_until = end;
        }
        if self.said == Some(result.proposal_id) {
            self.progress = match (result.outcome, &self.progress) {
                // A goal that says so follows.
                (StepResult::REJECTED, _) => return None,
                (StepResult::REFUSED, Progress::Approved(observation, id, pick)) => {
                    Progress::Proposed(observation.clone(), *id, *pick)
                }
                (StepResult::REFUSED, _) => return None,
                // The heightmap after the motion may come before its result.
                (_, progress) => {
                    self.outdated |= matches!(progress, Progress::Deciding(_));
                    Progress::Moved
                }
            };
        }
        self.next()
    }

    /// The network has answered the last job: `Err` says why it could not. The proposal, if it is still
    /// wanted, and the next job.
    pub fn decided(
        &mut self,
        decision: Result<&Decision, String>,
    ) -> (Option<Result<PickPlace, String>>, Option<Job>) {
        if std::mem::take(&mut self.outdated) {
            // `progress` speaks of a newer goal.
            if let Progress::Deciding(_) = self.progress {
                self.progress = Progress::Waiting;
            }
            return (None, self.next());
        }
        let (Progress::Deciding(observation), Some(goal)) = (&self.progress, &self.goal) else {
            return (None, None);
        };
        let observation = observation.clone();
        let proposal = match decision {
            Ok(decision) => {
                let proposal = propose(&observation, goal, decision);
                self.said = Some(proposal.id);
                self.progress = Progress::Proposed(observation, proposal.id, decision.pick);
                Ok(proposal)
            }
            Err(reason) => {
                self.progress = Progress::Failed(observation);
                Err(reason)
            }
        };
        (Some(proposal), self.next())
    }

    /// Whether the network is at work.
    fn next(&mut self) -> Option<Job> {
        let (Some(goal), Some(newest)) = (&self.goal, &self.newest) else {
            return None;
        };
        if goal.message.complete || newest.stamp < goal.stamp || self.outdated {
            return None;
        }
        let due = match &self.progress {
            Progress::Waiting => true,
            Progress::Proposed(seen, ..) | Progress::Failed(seen) => {
                let moved = seen.stamp < self.moved_until && newest.stamp >= self.moved_until;
                moved || self.change.changed(seen, newest)
            }
            Progress::Deciding(_) | Progress::Approved(..) | Progress::Moved => false,
        };
        if !due {
            return None;
        }
        let job = Job {
            observation: Arc::clone(&newest.heightmap),
            goal: Arc::clone(&goal.heightmap),
            exclude: self.rejected.clone(),
        };
        self.progress = Progress::Deciding(newest.clone());
        Some(job)
    }
}

impl ChangeRule {
    fn changed(&self, before: &Observation, after: &Observation) -> bool {
        before.stamp != after.stamp
            && (before.heightmap.workspace != after.heightmap.workspace
                || before
                    .heightmap
                    .changed_fraction(&after.heightmap, self.tolerance_m)
                    > self.fraction)
    }
}

fn propose(observation: &Observation, goal: &Wanted, decision: &Decision) -> PickPlace {
    let (pick, place) = (
        convert::pose2d_to_msg(&decision.pick),
        convert::pose2d_to_msg(&decision.place),
    );
    let mut hash = Fnv1a::new();
    hash.write(observation.stamp.as_nanos() as u64);
    hash.write(goal.message.step.into());
    hash.write(goal.message.attempt.into());
    for value in [pick.x, pick.y, pick.theta, place.x, place.y, place.theta] {
        hash.write(value.to_bits());
    }
    PickPlace {
        header: observation.header.clone(),
        id: hash.finish(),
        problem: goal.message.problem.clone(),
        step: goal.message.step,
        attempt: goal.message.attempt,
        pick,
        place,
        pick_score: decision.pick_score as f32,
        place_score: decision.place_score as f32,
        settings: goal.message.settings,
        module: goal.message.module.clone(),
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

#[cfg(test)]
mod tests {
    use super::*;
    use gctn::{Evidence, ScoreMap};
    use heightmap::Workspace;
    use msgs::sctn_msgs::PrimitiveSettings;
    use nalgebra::Vector2;

    const CHANGE: ChangeRule = ChangeRule {
        tolerance_m: 0.005,
        fraction: 0.001,
    };

    fn heightmap(stamp_s: u64, height_m: f32) -> msgs::sctn_msgs::Heightmap {
        let mut heightmap = Heightmap::new(Workspace {
            rows: 4,
            cols: 3,
            ..Workspace::RAVENS
        });
        heightmap.height_m.fill(height_m);
        let header = convert::header(Duration::from_secs(stamp_s), "world").unwrap();
        convert::heightmap_to_msg(heightmap, header, 3, 1.0).unwrap()
    }

    fn goal(step: u32, attempt: u32, stamp_s: u64) -> Goal {
        Goal {
            header: convert::header(Duration::from_secs(stamp_s), "world").unwrap(),
            problem: "placing".into(),
            demonstration: "placing/10000".into(),
            step,
            step_count: 9,
            attempt,
            settings: PrimitiveSettings {
                clearance_m: 0.1,
                lift_m: 0.1,
                travel_m_s: 0.1,
                carry_m_s: 0.1,
                descend_m_s: 0.1,
                acceleration_m_s2: 0.1,
            },
            heightmap: heightmap(0, 0.01 * step as f32),
            ..Goal::default()
        }
    }

    fn decision(x: f64) -> Decision {
        let map = ScoreMap {
            rows: 1,
            cols: 1,
            scores: vec![1.0],
        };
        Decision {
            done: None,
            success: None,
            evidence: Evidence {
                pick: 0.0,
                place: 0.0,
                done: 0.0,
            },
            pick: Isometry2::new(Vector2::new(x, 0.1), 0.0),
            place: Isometry2::new(Vector2::new(0.5, -0.1), 1.0),
            pick_score: 0.9,
            place_score: 0.8,
            pick_map: map.clone(),
            place_map: map,
        }
    }

    fn confirmation(decision: u8, proposal_id: u64) -> StepConfirmation {
        StepConfirmation {
            proposal_id,
            decision,
            ..StepConfirmation::default()
        }
    }

    fn result(proposal_id: u64, outcome: u8) -> StepResult {
        StepResult {
            proposal_id,
            outcome,
            ..StepResult::default()
        }
    }

    /// A proposer that has proposed for step 1 from the observation of second 5.
    fn proposed() -> (Proposer, PickPlace) {
        let mut proposer = Proposer::new(CHANGE);
        assert_eq!(proposer.wanted(goal(1, 0, 0)).unwrap(), None);
        assert!(proposer.observed(heightmap(5, 0.0)).unwrap().is_some());
        let (proposal, job) = proposer.decided(Ok(&decision(0.4)));
        assert_eq!(job, None);
        (proposer, proposal.unwrap().unwrap())
    }

    #[test]
    fn a_proposal_carries_its_observation_and_goal() {
        let (_, proposal) = proposed();
        assert_eq!(proposal.header.stamp.sec, 5);
        assert_eq!((proposal.step, proposal.attempt), (1, 0));
        assert_eq!(proposal.problem, "placing");
        assert_eq!(proposal.settings, goal(1, 0, 0).settings);
        assert_eq!(proposal.pick.x, 0.4);
    }

    #[test]
    fn the_id_depends_on_contents_alone() {
        let ids = |step, attempt, stamp_s, x| {
            let mut proposer = Proposer::new(CHANGE);
            proposer.wanted(goal(step, attempt, 0)).unwrap();
            proposer.observed(heightmap(stamp_s, 0.0)).unwrap();
            proposer.decided(Ok(&decision(x))).0.unwrap().unwrap().id
        };
        let id = ids(1, 0, 5, 0.4);
        assert_eq!(id, ids(1, 0, 5, 0.4));
        for other in [
            ids(2, 0, 5, 0.4),
            ids(1, 1, 5, 0.4),
            ids(1, 0, 6, 0.4),
            ids(1, 0, 5, 0.41),
        ] {
            assert_ne!(id, other);
        }
    }

    #[test]
    fn a_heightmap_older_than_the_goal_is_not_acted_on() {
        let mut proposer = Proposer::new(CHANGE);
        assert_eq!(proposer.observed(heightmap(5, 0.0)).unwrap(), None);
        assert_eq!(proposer.wanted(goal(1, 0, 6)).unwrap(), None);
        assert_eq!(proposer.observed(heightmap(5, 0.0)).unwrap(), None);
        assert!(proposer.observed(heightmap(6, 0.0)).unwrap().is_some());
    }

    #[test]
    fn one_proposal_is_made_while_nothing_changes() {
        let (mut proposer, _) = proposed();
        assert_eq!(proposer.observed(heightmap(6, 0.001)).unwrap(), None);
        assert_eq!(proposer.wanted(goal(1, 0, 0)).unwrap(), None);
    }

    #[test]
    fn a_changed_observation_supersedes_a_proposal_that_nobody_has_approved() {
        let (mut proposer, first) = proposed();
        assert!(proposer.observed(heightmap(6, 0.1)).unwrap().is_some());
        let second = proposer.decided(Ok(&decision(0.4))).0.unwrap().unwrap();
        assert_ne!(first.id, second.id);
        assert_eq!(second.header.stamp.sec, 6);
    }

    #[test]
    fn what_the_cameras_see_during_and_after_the_motion_makes_no_proposal() {
        let (mut proposer, proposal) = proposed();
        proposer.confirmed(&confirmation(StepConfirmation::APPROVE, proposal.id));
        assert_eq!(proposer.observed(heightmap(6, 0.1)).unwrap(), None);
        assert_eq!(
            proposer.result(&result(proposal.id, StepResult::PLACED)),
            None
        );
        assert_eq!(proposer.observed(heightmap(7, 0.2)).unwrap(), None);
        // A second approval is refused; that opens nothing.
        proposer.confirmed(&confirmation(StepConfirmation::APPROVE, proposal.id));
        assert_eq!(
            proposer.result(&result(proposal.id, StepResult::REFUSED)),
            None
        );
        assert!(proposer.wanted(goal(2, 0, 7)).unwrap().is_some());
    }

    /// Where proposals are carried out without an approval.
    #[test]
    fn the_heightmap_after_a_motion_that_comes_before_its_result_makes_no_proposal() {
        let (mut proposer, proposal) = proposed();
        assert!(proposer.observed(heightmap(6, 0.1)).unwrap().is_some());
        let moved = result(proposal.id, StepResult::PLACED);
        assert_eq!(proposer.result(&moved), None);
        assert_eq!(proposer.decided(Ok(&decision(0.6))), (None, None));
        assert!(proposer.wanted(goal(2, 0, 6)).unwrap().is_some());
    }

    #[test]
    fn after_the_motion_of_another_proposal_ours_is_made_anew() {
        let (mut proposer, proposal) = proposed();
        let mut moved = result(proposal.id ^ 1, StepResult::GRASP_FAILED);
        moved.header.stamp.sec = 7;
        moved.duration.sec = 2;
        assert_eq!(proposer.result(&moved), None);
        assert_eq!(proposer.observed(heightmap(6, 0.0)).unwrap(), None);
        assert!(proposer.observed(heightmap(7, 0.0)).unwrap().is_some());
        proposer.decided(Ok(&decision(0.4)));
        assert_eq!(proposer.observed(heightmap(8, 0.0)).unwrap(), None);
    }

    #[test]
    fn a_refused_approval_opens_the_proposal_again() {
        let (mut proposer, proposal) = proposed();
        proposer.confirmed(&confirmation(StepConfirmation::APPROVE, proposal.id));
        assert_eq!(proposer.observed(heightmap(6, 0.1)).unwrap(), None);
        let job = proposer.result(&result(proposal.id, StepResult::REFUSED));
        assert!(job.is_some());
    }

    #[test]
    fn after_a_rejection_the_pick_is_left_out_and_after_the_step_no_more() {
        let (mut proposer, _) = proposed();
        let job = proposer.wanted(goal(1, 1, 0)).unwrap().unwrap();
        assert_eq!(job.exclude, [decision(0.4).pick]);
        proposer.decided(Ok(&decision(0.6)));
        let job = proposer.wanted(goal(1, 2, 0)).unwrap().unwrap();
        assert_eq!(job.exclude, [decision(0.4).pick, decision(0.6).pick]);
        proposer.decided(Ok(&decision(0.7)));
        let job = proposer.wanted(goal(2, 0, 5)).unwrap().unwrap();
        assert!(job.exclude.is_empty());
    }

    #[test]
    fn somebody_elses_proposal_hides_ours_only_until_the_operators_word_on_it_is_refused() {
        let (mut proposer, proposal) = proposed();
        let theirs = proposal.id ^ 1;
        proposer.confirmed(&confirmation(StepConfirmation::APPROVE, theirs));
        assert!(proposer.is_overlooked(&result(theirs, StepResult::REFUSED)));
        assert_eq!(proposer.result(&result(theirs, StepResult::REFUSED)), None);
        assert!(!proposer.is_overlooked(&result(proposal.id, StepResult::REFUSED)));
        assert!(!proposer.is_overlooked(&result(theirs, StepResult::PLACED)));
        // Its rejection says nothing about our pick.
        proposer.confirmed(&confirmation(StepConfirmation::REJECT, theirs));
        let job = proposer.wanted(goal(1, 1, 0)).unwrap().unwrap();
        assert!(job.exclude.is_empty());
        proposer.decided(Ok(&decision(0.6)));
        proposer.confirmed(&confirmation(StepConfirmation::REJECT, 1));
        proposer.wanted(goal(2, 0, 7)).unwrap();
        assert!(!proposer.is_overlooked(&result(theirs, StepResult::REFUSED)));
    }

    #[test]
    fn a_retry_after_a_motion_leaves_nothing_out() {
        let (mut proposer, proposal) = proposed();
        proposer.confirmed(&confirmation(StepConfirmation::APPROVE, proposal.id));
        proposer.result(&result(proposal.id, StepResult::NO_CONTACT));
        assert_eq!(proposer.wanted(goal(1, 1, 8)).unwrap(), None);
        let job = proposer.observed(heightmap(8, 0.0)).unwrap().unwrap();
        assert!(job.exclude.is_empty());
    }

    #[test]
    fn an_answer_for_a_goal_that_has_gone_is_dropped() {
        let mut proposer = Proposer::new(CHANGE);
        proposer.wanted(goal(1, 0, 0)).unwrap();
        assert!(proposer.observed(heightmap(5, 0.0)).unwrap().is_some());
        assert_eq!(proposer.wanted(goal(2, 0, 0)).unwrap(), None);
        let (proposal, job) = proposer.decided(Ok(&decision(0.4)));
        assert_eq!(proposal, None);
        assert_eq!(
            *job.unwrap().goal,
            convert::heightmap_from_msg(goal(2, 0, 0).heightmap).unwrap()
        );
        let (proposal, _) = proposer.decided(Ok(&decision(0.4)));
        assert_eq!(proposal.unwrap().unwrap().step, 2);
    }

    #[test]
    fn a_network_that_cannot_decide_is_asked_again_when_something_changes() {
        let mut proposer = Proposer::new(CHANGE);
        proposer.wanted(goal(1, 0, 0)).unwrap();
        proposer.observed(heightmap(5, 0.0)).unwrap().unwrap();
        let (proposal, job) = proposer.decided(Err("other size".into()));
        assert_eq!((proposal, job), (Some(Err("other size".into())), None));
        assert_eq!(proposer.observed(heightmap(6, 0.0)).unwrap(), None);
        assert!(proposer.observed(heightmap(7, 0.1)).unwrap().is_some());
    }

    #[test]
    fn when_all_steps_are_done_nothing_is_proposed() {
        let (mut proposer, _) = proposed();
        let complete = Goal {
            complete: true,
            ..goal(9, 0, 5)
        };
        assert_eq!(proposer.wanted(complete).unwrap(), None);
        assert_eq!(proposer.observed(heightmap(9, 0.3)).unwrap(), None);
    }

    #[test]
    fn bad_messages_are_refused_and_change_nothing() {
        let mut proposer = Proposer::new(CHANGE);
        proposer.wanted(goal(1, 0, 0)).unwrap();
        let mut short = heightmap(5, 0.0);
        short.height_m.pop();
        assert!(
            proposer
                .observed(short)
                .unwrap_err()
                .to_string()
                .starts_with("height_m")
        );
        let mut unsettled = goal(2, 0, 0);
        unsettled.settings.lift_m = f64::NAN;
        assert!(
            proposer
                .wanted(unsettled)
                .unwrap_err()
                .to_string()
                .starts_with("lift_m")
        );
        assert!(proposer.observed(heightmap(5, 0.0)).unwrap().is_some());
        assert_eq!(
            proposer
                .decided(Ok(&decision(0.4)))
                .0
                .unwrap()
                .unwrap()
                .step,
            1
        );
    }
}
