//! The run as the operator sees it: messages in, a snapshot out. No clock, no node.

mod answer;
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

use heightmap::ChangeRules;
use msgs::builtin_interfaces::Time;
use msgs::convert;
use msgs::sctn_msgs::{Goal, Heightmap, PickPlace, PlannedMotion, Reward};
use msgs::sensor_msgs::Image;
use serde::Serialize;
use step_protocol::StepOutcome;

use self::answer::Unanswered;
use self::health::{NodeHealth, Robot};
use self::view::{TableChange, check_heightmap, contains};
use crate::preview::{Motion, Scores};

pub use self::decide::{Decision, Phase};
pub(crate) use self::outcome::outcome_words;
pub use self::propose::Pose;
pub use self::snapshot::{MotionState, Snapshot};
pub use self::view::View;

/// Past steps that are shown.
const STEPS: usize = 64;
/// Refusals and faults that are shown.
const NOTICES: usize = 50;
/// Proposals whose status is remembered: one may be published again.
const PROPOSALS: usize = 256;
/// Heightmaps of which the proposals may still come, and planned motions of which they may.
const HEIGHTMAPS: usize = 8;
/// Longest description of a robot that is taken (bytes).
const LONGEST_DESCRIPTION: usize = 1 << 20;

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

#[derive(Debug)]
struct Offered {
    message: PickPlace,
    status: Status,
    /// What has changed on the table since the heightmap that it was made from; nothing where that one is not known.
    change: Option<TableChange>,
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
    /// The newest planned motions, one for each proposal.
    motions: VecDeque<Motion>,
    /// The newest decision that nothing has come of yet.
    unanswered: Option<Unanswered>,
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
            motions: VecDeque::new(),
            unanswered: None,
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
        self.unanswered = None;
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

    /// The simulator has measured.
    pub fn on_reward(&mut self, message: Reward) {
        self.reward = Some(message);
    }

    /// The executor has planned the motion of a proposal.
    pub fn on_planned_motion(&mut self, message: PlannedMotion) -> Result<(), InvalidMessage> {
        let motion = Motion::from_msg(message)?;
        self.motions
            .retain(|known| known.proposal_id != motion.proposal_id);
        if self.motions.len() == HEIGHTMAPS {
            self.motions.pop_front();
        }
        self.motions.push_back(motion);
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
        self.motion_of(self.current_id()?)
    }

    /// The planned motion of a proposal.
    pub fn motion_of(&self, proposal_id: u64) -> Option<&Motion> {
        self.motions
            .iter()
            .find(|motion| motion.proposal_id == proposal_id)
    }

    /// The scores of the heightmap that the present proposal was made from.
    pub fn scores(&self) -> Option<&Arc<Scores>> {
        let stamp = duration(&self.current()?.message.header.stamp).ok()?;
        self.scores.as_ref().filter(|scores| scores.stamp == stamp)
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
    pub fn proposal(&self, id: u64) -> Option<&PickPlace> {
        let mut offered = self.offered.iter();
        let found = offered.rfind(|known| known.message.id == id);
        found.map(|known| &known.message)
    }

    fn offered(&mut self, id: u64) -> Option<&mut Offered> {
        self.offered
            .iter_mut()
            .rfind(|known| known.message.id == id)
    }

    /// The proposal for the present goal that the arm moves or has moved for; else the newest, if it is for this goal.
    fn current(&self) -> Option<&Offered> {
        let goal = self.goal.as_ref()?;
        let since = duration(&goal.header.stamp).ok();
        // A demonstration that is repeated has the same steps again: what was seen before its goal is of the time before.
        let of_this_goal = |known: &&Offered| {
            let PickPlace {
                step,
                attempt,
                problem,
                ..
            } = &known.message;
            (*step, *attempt, problem) == (goal.step, goal.attempt, &goal.problem)
                && duration(&known.message.header.stamp).ok() >= since
        };
        let offered = || self.offered.iter().rev().filter(of_this_goal);
        let at_work = |known: &&Offered| !matches!(known.status, Status::Open | Status::Closed);
        offered()
            .find(at_work)
            .or_else(|| offered().find(|known| Some(known.message.id) == self.newest))
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

#[cfg(test)]
mod tests;
