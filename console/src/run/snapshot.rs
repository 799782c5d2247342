//! The run as JSON for the page: docs/operator_console.openapi.yaml explains each field.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use heightmap::Workspace;
use serde::{Serialize, Serializer};
use step_protocol::{Proposal, RunPhase};

use super::health::{NodeState, Robot, Stream, worst};
use super::{Decision, Notice, PastStep, Pose, Run, View, outcome_words};
use crate::preview::Motion;
use crate::refusal::Refusal;

/// The run, as JSON for the page: docs/operator_console.openapi.yaml explains each field.
#[derive(Debug, Serialize)]
#[allow(missing_docs)]
pub struct Snapshot<'a> {
    #[serde(serialize_with = "as_name")]
    pub phase: RunPhase,
    pub headline: String,
    pub advice: &'static str,
    /// What is shown may not be what is there.
    pub stale: bool,
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
    scores: Option<u64>,
    robot_description: bool,
}

fn as_name<S: Serializer>(phase: &RunPhase, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(phase.name())
}

/// A planned motion that waits for an approval.
#[derive(Debug, Serialize)]
pub struct MotionState<'a> {
    proposal_id: String,
    duration_s: f64,
    /// Why it cannot be planned; empty where it can be.
    reason: &'a str,
}

impl<'a> From<&'a Motion> for MotionState<'a> {
    fn from(motion: &'a Motion) -> Self {
        Self {
            proposal_id: motion.proposal_id.to_string(),
            duration_s: motion.duration_s(),
            reason: &motion.reason,
        }
    }
}

/// Where a heightmap lies.
#[derive(Debug, Serialize)]
#[allow(missing_docs)]
pub struct ViewState {
    pub number: u64,
    pub stamp_s: f64,
    pub age_s: f64,
    pub rows: usize,
    pub cols: usize,
    pub pixel_size_m: f64,
    pub origin_x_m: f64,
    pub origin_y_m: f64,
    pub coverage: f32,
}

impl ViewState {
    fn of(view: &View) -> Self {
        let Workspace {
            origin_m,
            rows,
            cols,
            pixel_size_m,
            ..
        } = view.heightmap.workspace;
        Self {
            number: view.number,
            stamp_s: view.stamp.as_secs_f64(),
            age_s: 0.0,
            rows,
            cols,
            pixel_size_m,
            origin_x_m: origin_m.x,
            origin_y_m: origin_m.y,
            coverage: view.coverage.fraction,
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
    /// Nothing where nothing estimates it.
    done_probability: Option<f32>,
    /// What the estimates say against carrying it out, for people; empty where nothing.
    verdict: &'static str,
    checkpoint: &'a str,
    author: &'a str,
    stamp_s: f64,
}

impl<'a> ProposalState<'a> {
    fn of(proposal: &'a Proposal) -> Self {
        Self {
            id: proposal.id.to_string(),
            step: proposal.step,
            attempt: proposal.attempt,
            module: &proposal.module,
            pick: Pose::from(&proposal.action.pick),
            place: Pose::from(&proposal.action.place),
            pick_score: proposal.pick_score,
            place_score: proposal.place_score,
            success_probability: proposal.success_probability,
            done_probability: proposal.done_probability,
            verdict: proposal.verdict().text(),
            checkpoint: &proposal.checkpoint,
            author: &proposal.author,
            stamp_s: proposal.stamp.as_secs_f64(),
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

impl Run {
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
            stale: self.staleness(now).is_some(),
            refused: refusals.collect(),
            heightmap: self.present().map(|view| ViewState {
                age_s: since(view.arrived),
                ..ViewState::of(view)
            }),
            goal: self.goal().map(|goal| GoalState {
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
            proposal: current.map(ProposalState::of),
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
            reward: self.operator.reward().map(|reward| reward.total),
            scores: self.scores().map(|(number, _)| number),
            robot_description: self.robot_description.is_some(),
        }
    }
}
