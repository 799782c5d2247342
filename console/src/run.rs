//! The run as the operator sees it: messages in, a snapshot out. No clock, no node.

mod correction;
mod decide;
mod health;
mod outcome;
mod propose;
mod snapshot;
mod view;

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use heightmap::{ChangeRules, Heightmap};
use nalgebra::Point2;
use serde::Serialize;
use step_protocol::{
    Coverage, Goal, Observation, Operator, Proposal, ProposalId, Reward, RunPhase, StepOutcome,
};

use self::health::{NodeHealth, Robot};
use self::view::Compared;
use crate::preview::{Motion, ScoreMaps};

pub use self::decide::Decision;
pub use self::health::{InvalidJoints, Joints, NodeReport};
pub(crate) use self::outcome::outcome_words;
pub use self::propose::Pose;
pub use self::snapshot::{MotionState, Snapshot};
pub use self::view::View;

/// Past steps that are shown.
const STEPS: usize = 64;
/// Refusals and faults that are shown.
const NOTICES: usize = 50;
/// Heightmaps of which the proposals may still come, and planned motions of which they may.
const HEIGHTMAPS: usize = 8;
/// Longest description of a robot that is taken (bytes).
const LONGEST_DESCRIPTION: usize = 1 << 20;

/// A step that was carried out.
#[derive(Debug)]
struct PastStep {
    number: u64,
    proposal: Proposal,
    outcome: StepOutcome,
    reason: String,
    duration: Duration,
    ended: Duration,
    decision: Option<Decision>,
    decided_by: String,
    before: Option<View>,
    after: Option<View>,
    /// It was looked at whether it is a correction to learn from.
    is_kept: bool,
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

/// What has to be heard, and how often.
#[derive(Clone, Debug)]
pub struct Watch {
    /// Full names of the nodes that have to be at work.
    pub nodes: Vec<String>,
    /// Full name of the executor, one of them.
    pub executor: String,
    /// Endings of the topics of the cameras' images.
    pub image_topics: Vec<String>,
    /// Age from which a stream is stale.
    pub stale_after: Duration,
    /// A proposal is stale when the table has changed by these since the heightmap that it was made from.
    pub changes: ChangeRules,
}

/// The run.
#[derive(Debug)]
pub struct Run {
    watch: Watch,
    /// How far the run is, and what has to be decided.
    operator: Operator,
    views: VecDeque<View>,
    view_count: u64,
    goal_view: Option<View>,
    goal_count: u64,
    /// Goals of the present demonstration that were latched, by step.
    strip: BTreeMap<u32, View>,
    /// A demonstration that was read: its name, and the goal images of its steps.
    demonstration: Option<(String, Vec<View>)>,
    /// How the table differs from what the present proposal was made from.
    compared: Option<Compared>,
    /// The proposal whose rejection the console has repeated by itself: its refusal is no news for a person.
    probed: Option<ProposalId>,
    steps: VecDeque<PastStep>,
    step_count: u64,
    notices: VecDeque<Notice>,
    notice_count: u64,
    health: BTreeMap<String, NodeHealth>,
    robot: Robot,
    joints: Option<(Duration, Vec<String>, Vec<f64>)>,
    /// The newest planned motions, one for each proposal.
    motions: VecDeque<Motion>,
    /// The newest score maps.
    scores: Option<Arc<ScoreMaps>>,
    score_count: u64,
    /// URDF of the robot.
    robot_description: Option<Arc<str>>,
}

/// Why something cannot be shown.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum InvalidMessage {
    /// A goal of a step that there is not.
    #[error("step is {step}, expected 1 to step_count = {step_count}")]
    Step {
        /// The step.
        step: u32,
        /// Number of steps.
        step_count: u32,
    },
    /// A proposal that is not on the table.
    #[error("{field} is ({x_m:.3}, {y_m:.3}), expected a place in the workspace")]
    Outside {
        /// `pick` or `place`.
        field: &'static str,
        /// Position along x.
        x_m: f64,
        /// Position along y.
        y_m: f64,
    },
    /// A description of a robot that is too long.
    #[error("data has {found} bytes, expected at most {LONGEST_DESCRIPTION}")]
    Description {
        /// Its length (bytes).
        found: usize,
    },
}

impl Run {
    /// Nothing has been heard.
    pub fn new(watch: Watch) -> Self {
        Self {
            watch,
            operator: Operator::new(false),
            views: VecDeque::new(),
            view_count: 0,
            goal_view: None,
            goal_count: 0,
            strip: BTreeMap::new(),
            demonstration: None,
            compared: None,
            probed: None,
            steps: VecDeque::new(),
            step_count: 0,
            notices: VecDeque::new(),
            notice_count: 0,
            health: BTreeMap::new(),
            robot: Robot::default(),
            joints: None,
            motions: VecDeque::new(),
            scores: None,
            score_count: 0,
            robot_description: None,
        }
    }

    /// A heightmap has come.
    pub fn on_heightmap(&mut self, seen: Observation, now: Duration) {
        self.view_count += 1;
        let view = View::new(self.view_count, seen, now);
        for step in &mut self.steps {
            if step.after.is_none() && view.stamp >= step.ended {
                step.after = Some(view.clone());
            }
        }
        if self.views.len() == HEIGHTMAPS {
            self.views.pop_front();
        }
        self.views.push_back(view);
        self.compare();
    }

    /// A goal has been latched.
    ///
    /// # Errors
    /// When there is no such step.
    pub fn on_goal(&mut self, goal: Goal, now: Duration) -> Result<(), InvalidMessage> {
        let Goal {
            step, step_count, ..
        } = goal;
        if step == 0 || step > step_count {
            return Err(InvalidMessage::Step { step, step_count });
        }
        // The same one, latched again.
        if self.goal() == Some(&goal) {
            return Ok(());
        }
        if self.goal().is_none_or(|known| {
            known.demonstration != goal.demonstration || known.step_count != step_count
        }) {
            self.strip.clear();
        }
        self.goal_count += 1;
        let view = View::of_goal(
            self.goal_count,
            Arc::clone(&goal.image),
            goal.coverage,
            goal.stamp,
            now,
        );
        self.strip.insert(step, view.clone());
        self.goal_view = Some(view);
        self.operator.on_goal(&goal);
        self.compare();
        Ok(())
    }

    /// A proposal has come.
    ///
    /// # Errors
    /// When a pose lies outside the workspace.
    pub fn on_proposal(&mut self, proposal: Proposal) -> Result<(), InvalidMessage> {
        let action = &proposal.action;
        for (field, pose) in [("pick", &action.pick), ("place", &action.place)] {
            let point = Point2::from(pose.translation.vector);
            if let Some(view) = self.views.back()
                && view.heightmap.workspace.pixel(&point).is_none()
            {
                return Err(InvalidMessage::Outside {
                    field,
                    x_m: point.x,
                    y_m: point.y,
                });
            }
        }
        self.operator.on_proposal(proposal);
        self.compare();
        Ok(())
    }

    /// The simulator has measured.
    pub fn on_reward(&mut self, reward: Reward) {
        self.operator.on_reward(reward);
    }

    /// The executor has planned the motion of a proposal.
    pub fn on_planned_motion(&mut self, motion: Motion) {
        self.motions
            .retain(|known| known.proposal_id != motion.proposal_id);
        if self.motions.len() == HEIGHTMAPS {
            self.motions.pop_front();
        }
        self.motions.push_back(motion);
    }

    /// The policy has drawn its scores.
    pub fn on_scores(&mut self, scores: ScoreMaps) {
        self.score_count += 1;
        self.scores = Some(Arc::new(scores));
    }

    /// The robot has been described, as URDF.
    ///
    /// # Errors
    /// When it is too long.
    pub fn on_robot_description(&mut self, urdf: String) -> Result<(), InvalidMessage> {
        if urdf.len() > LONGEST_DESCRIPTION {
            return Err(InvalidMessage::Description { found: urdf.len() });
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
        self.motion_of(self.current_id()?)
    }

    /// The planned motion of a proposal.
    pub fn motion_of(&self, proposal_id: ProposalId) -> Option<&Motion> {
        self.motions
            .iter()
            .find(|motion| motion.proposal_id == proposal_id)
    }

    /// The scores of the heightmap that the present proposal was made from, and their number.
    pub fn scores(&self) -> Option<(u64, &Arc<ScoreMaps>)> {
        let stamp = self.current()?.stamp;
        let scores = self
            .scores
            .as_ref()
            .filter(|scores| scores.stamp == stamp)?;
        Some((self.score_count, scores))
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

    /// A proposal that has come, by its id.
    pub fn proposal(&self, id: ProposalId) -> Option<&Proposal> {
        self.operator.proposal(id)
    }

    /// How far the run is.
    pub fn phase(&self) -> RunPhase {
        self.operator.phase()
    }

    fn current(&self) -> Option<&Proposal> {
        self.operator.current()
    }

    /// Id of the proposal that a decision would be about.
    pub fn current_id(&self) -> Option<ProposalId> {
        self.current().map(|proposal| proposal.id)
    }

    /// The present goal.
    pub fn goal(&self) -> Option<&Goal> {
        self.operator.goal()
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
        // Goals that were latched count from 1.
        let view = |image| {
            let image = Arc::new(image);
            View::of_goal(0, image, Coverage::default(), Duration::ZERO, now)
        };
        let views = images.into_iter().map(view);
        self.demonstration = Some((name, views.collect()));
    }

    /// The goal image of a step of the present demonstration, where it is known.
    pub fn strip(&self, step: u32) -> Option<&View> {
        self.strip.get(&step).or_else(|| {
            let goal = self.goal()?;
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
}

#[cfg(test)]
mod tests;
