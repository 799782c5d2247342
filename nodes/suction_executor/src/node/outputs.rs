//! What the executor says.

use msgs::convert::{self, ConvertError};
use msgs::sctn_msgs::{self, ExecutePickPlaceFeedback, ExecutePickPlaceResult};
use msgs::std_msgs;
use node_kit::Level;
use rehearsal::PlannedPrimitive;
use step_protocol::{GoalEnd, ProposalId, Said, StepOutcome};
use tracing::{error, info, warn};

use super::ActiveNode;

impl ActiveNode<'_> {
    /// Says what has become of a proposal, in the log too, and ends the goal that ends with it.
    pub(super) fn say(&mut self, said: Said) {
        let report = &said.report;
        let (id, outcome, reason) = (report.id, report.outcome, &report.reason);
        let name = outcome.name();
        match outcome {
            StepOutcome::Placed | StepOutcome::Rejected | StepOutcome::AtHome => {
                info!("proposal {id}: {name}. {reason}");
            }
            StepOutcome::Fault => error!("proposal {id}: {name}: {reason}"),
            _ => warn!("proposal {id}: {name}: {reason}"),
        }
        if said.motion.is_some() {
            let level = match outcome {
                StepOutcome::Fault => Level::Error,
                _ => Level::Ok,
            };
            self.node.diagnostics().set("motion", level, reason, []);
        }
        let ends_goal = said.ends_goal;
        let result = self.publish_result(said);
        let Some(goal) = self.goal.take_if(|_| ends_goal) else {
            return;
        };
        let result = ExecutePickPlaceResult { result };
        match GoalEnd::of(outcome, goal.is_cancel_requested()) {
            GoalEnd::Succeeded => goal.succeed(result),
            GoalEnd::Cancelled => goal.cancelled(result),
            GoalEnd::Aborted => goal.abort(result),
        }
    }

    pub(super) fn publish_result(&self, said: Said) -> sctn_msgs::StepResult {
        let result = said.result(self.time());
        let frame = &self.configured.parameters.world_frame;
        let message = convert::result_to_msg(&result, frame).unwrap_or_else(|error| {
            // A clock beyond what a stamp can hold.
            error!("the result of proposal {}: {error}", result.proposal_id);
            sctn_msgs::StepResult {
                proposal_id: result.proposal_id.0,
                outcome: result.outcome.code(),
                reason: result.reason.clone(),
                ..Default::default()
            }
        });
        self.configured.results.publish(message.clone());
        message
    }

    /// Shows how a proposal would be carried out, or why it cannot be.
    pub(super) fn publish_plan(&self, planned: Result<&PlannedPrimitive, &String>, id: ProposalId) {
        match planned_motion(planned, id, &self.configured.joint_names, self.header()) {
            Ok(motion) => self.configured.planned.publish(motion),
            Err(error) => warn!("the motion of proposal {id}: {error}"),
        }
    }

    /// Tells the client of the goal for a proposal how far that is.
    pub(super) fn feedback(&self, id: ProposalId, phase: u8) {
        if let Some(goal) = &self.goal {
            goal.feedback(ExecutePickPlaceFeedback {
                header: self.header(),
                proposal_id: id.0,
                phase,
            });
        }
    }

    fn header(&self) -> std_msgs::Header {
        std_msgs::Header {
            stamp: self.node.now(),
            frame_id: self.configured.parameters.world_frame.clone(),
        }
    }

    pub(super) fn diagnose(&self) {
        let (level, message) = match self.configured.driver.unready() {
            None => (Level::Ok, "ready".to_owned()),
            Some(obstacle) => (Level::Warn, obstacle),
        };
        let diagnostics = self.node.diagnostics();
        diagnostics.set("driver", level, message, []);
        // What an operator's approval has led to.
        let moving = self.configured.protocol.moving();
        let motion = moving.map_or_else(|| "at rest".to_owned(), |cause| cause.text());
        diagnostics.set("motion", Level::Ok, motion, []);
    }
}

/// The message that shows a motion, or why there is none.
fn planned_motion(
    planned: Result<&PlannedPrimitive, &String>,
    id: ProposalId,
    joint_names: &[String; 6],
    header: std_msgs::Header,
) -> Result<sctn_msgs::PlannedMotion, ConvertError> {
    let none = PlannedPrimitive::default();
    let (motion, reason) = match planned {
        Ok(motion) => (motion, String::new()),
        Err(reason) => (&none, reason.clone()),
    };
    let mut trajectory = convert::trajectory_points_to_msg(motion.points(), joint_names)?;
    trajectory.header = header.clone();
    let [on, off] = motion.suction();
    Ok(sctn_msgs::PlannedMotion {
        trajectory,
        header,
        proposal_id: id.0,
        suction_on: convert::duration_to_msg(on)?,
        suction_off: convert::duration_to_msg(off)?,
        reason,
    })
}
