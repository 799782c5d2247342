//! What the executor says.

use std::time::Duration;

use msgs::{convert, sctn_msgs};
use node_kit::Level;
use step_protocol::{ProposalId, Report, StepOutcome, StepResult};
use tracing::{error, info, warn};

use super::Executor;

impl Executor<'_> {
    /// A refusal with where the proposal stands.
    pub(super) fn refusal(&self, id: ProposalId, reason: String) -> Report {
        Report {
            id,
            outcome: StepOutcome::Refused,
            reason,
            status: self.gate.status(id),
        }
    }

    /// `motion`: when it ended and how long it took.
    pub(super) fn report(&mut self, report: Report, motion: Option<(Duration, Duration)>) {
        let Report {
            id,
            outcome,
            reason,
            ..
        } = &report;
        let (outcome, name) = (*outcome, outcome.name());
        match outcome {
            StepOutcome::Placed | StepOutcome::Rejected | StepOutcome::AtHome => {
                info!("proposal {id}: {name}. {reason}")
            }
            StepOutcome::Fault => error!("proposal {id}: {name}: {reason}"),
            _ => warn!("proposal {id}: {name}: {reason}"),
        }
        let result = self.result(report, motion);
        self.results.publish(result.clone());
        self.finish_goal(outcome, result, motion.is_some());
    }

    pub(super) fn result(
        &self,
        report: Report,
        motion: Option<(Duration, Duration)>,
    ) -> sctn_msgs::StepResult {
        let now = self.node.clock().time();
        let (stamp, duration) = motion.unwrap_or((now, Duration::ZERO));
        let result = StepResult {
            stamp,
            proposal_id: report.id,
            outcome: report.outcome,
            reason: report.reason,
            duration,
            status: report.status,
        };
        convert::result_to_msg(&result, &self.parameters.world_frame).unwrap_or_else(|error| {
            // A clock beyond what a stamp can hold.
            error!("the result of proposal {}: {error}", result.proposal_id);
            sctn_msgs::StepResult {
                proposal_id: result.proposal_id.0,
                outcome: result.outcome.code(),
                reason: result.reason.clone(),
                ..Default::default()
            }
        })
    }

    pub(super) fn diagnose(&self) {
        let (level, message) = match self.driver.unready() {
            None => (Level::Ok, "ready".to_owned()),
            Some(obstacle) => (Level::Warn, obstacle),
        };
        let diagnostics = self.node.diagnostics();
        diagnostics.set("driver", level, message, []);
        // What an operator's approval has led to.
        let motion = match self.motion.as_ref().map(|motion| motion.cause) {
            None => "at rest".to_owned(),
            Some(cause) => cause.text(),
        };
        diagnostics.set("motion", Level::Ok, motion, []);
    }
}
