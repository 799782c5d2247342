//! Motions are rehearsed on a thread of their own, one at a time: the check for collisions takes some tenths of a second, and a stop must not wait
//! for it.

use std::collections::VecDeque;
use std::sync::Arc;

use anyhow::Context as _;
use msgs::convert::{self, ConvertError};
use msgs::sctn_msgs::{self, ProposeHomeResponse};
use msgs::std_msgs;
use node_kit::RequestId;
use rehearsal::{PlannedPrimitive, Rehearsed, Subject};
use step_protocol::{CannotBegin, OperatorDecision, ProposalId, Recovery};
use tokio::task::JoinHandle;
use tracing::{info, warn};
use ur_driver::planted::{Planted, is_planted};

use super::Executor;

/// Finished, running and waiting rehearsals.
#[derive(Default)]
pub(super) struct Rehearsals {
    task: Option<JoinHandle<Rehearsed>>,
    /// Calls that wait for the rehearsal of a recovery.
    calls: VecDeque<(Recovery, RequestId)>,
    /// The last one of a proposal.
    pub(super) proposal: Option<Arc<Rehearsed>>,
    /// The last one of a recovery.
    pub(super) recovery: Option<Arc<Rehearsed>>,
}

impl Rehearsals {
    /// Waits for the end of the rehearsal under way, and takes it; for ever when there is none.
    pub(super) async fn ended(&mut self) -> anyhow::Result<Rehearsed> {
        match &mut self.task {
            Some(task) => {
                let rehearsed = task.await;
                self.task = None;
                rehearsed.context("the thread of a rehearsal panicked")
            }
            None => std::future::pending().await,
        }
    }
}

impl Executor<'_> {
    /// Begins the next rehearsal that is due. None is while the arm moves: it would begin elsewhere.
    pub(super) fn rehearse_next(&mut self) {
        if self.rehearsals.task.is_some() || self.motion.is_some() {
            return;
        }
        let robot = self.robot();
        let subject = match (self.rehearsals.calls.front(), self.gate.pending()) {
            (Some((recovery, _)), _) => Subject::Recovery(*recovery),
            (None, Some(pending)) if robot.rehearsal_of(pending.id).is_none() => {
                Subject::Proposal(Box::new(pending.clone()))
            }
            (None, _) => return,
        };
        let task = self.node.spawn_blocking(move || robot.rehearse(subject));
        self.rehearsals.task = Some(task);
    }

    /// The first heightmap may come after the first proposal.
    pub(super) fn rehearse_what_was_unseen(&mut self) {
        let rehearsed = self.rehearsals.proposal.as_ref();
        if rehearsed.is_none_or(|rehearsed| !rehearsed.was_seen()) {
            self.rehearse_next();
        }
    }

    pub(super) fn on_rehearsed(&mut self, rehearsed: anyhow::Result<Rehearsed>) {
        let rehearsed = match rehearsed {
            Ok(rehearsed) => Arc::new(rehearsed),
            Err(error) => {
                // A call is answered at the next tick, from what is known then.
                warn!("{error:#}");
                return self.answer_calls(None);
            }
        };
        match &rehearsed.subject {
            Subject::Proposal(proposal) => {
                let id = proposal.id;
                self.rehearsals.proposal = Some(Arc::clone(&rehearsed));
                if self.gate.check_pending(id).is_ok() {
                    self.publish_plan(rehearsed.planned.clone(), id);
                }
                self.answer_calls(None);
            }
            Subject::Recovery(recovery) => {
                self.rehearsals.recovery = Some(Arc::clone(&rehearsed));
                self.answer_calls(Some(*recovery));
            }
        }
        self.ask_again();
        self.rehearse_next();
    }

    /// Somebody asks for the way home, or for what is held to be put down before. The call may come again because its answer was lost.
    pub(super) fn on_recovery_call(&mut self, recovery: Recovery, call: RequestId) {
        self.rehearsals.calls.push_back((recovery, call));
        self.answer_calls(None);
        self.rehearse_next();
    }

    /// Answers the calls that need not wait: nothing can be proposed now, or it was rehearsed. `rehearsed`: where that is not valid any more,
    /// the caller has to call again.
    fn answer_calls(&mut self, rehearsed: Option<Recovery>) {
        for (recovery, call) in std::mem::take(&mut self.rehearsals.calls) {
            let answer = match self.propose_recovery(recovery) {
                Ok(answer) => answer,
                Err(CannotBegin::NotRehearsed) if rehearsed != Some(recovery) => {
                    self.rehearsals.calls.push_back((recovery, call));
                    continue;
                }
                Err(cannot) => {
                    let reason = match cannot {
                        CannotBegin::Refused(obstacle) => obstacle.into(),
                        CannotBegin::NotRehearsed => {
                            "the arm, what is held or what is seen has changed meanwhile: call again".to_owned()
                        }
                    };
                    warn!("{recovery:?}: {reason}");
                    ProposeHomeResponse {
                        success: false,
                        message: reason,
                        ..Default::default()
                    }
                }
            };
            match recovery {
                Recovery::Home => self.home.respond(call, answer),
                Recovery::PutDown => self.put_down.respond(call, answer),
            }
        }
    }

    fn propose_recovery(&mut self, recovery: Recovery) -> Result<ProposeHomeResponse, CannotBegin> {
        let (new, robot) = (self.home_id(), self.robot());
        let id = self.gate.propose_home(new, recovery, &robot)?;
        info!("proposal {id}: {recovery:?}");
        if let Some(rehearsed) = &self.rehearsals.recovery {
            self.publish_plan(rehearsed.planned.clone(), id);
        }
        let unasked = self.gate.moves_unasked(id) || is_planted(Planted::HomeUnasked);
        if unasked {
            self.confirm(id, OperatorDecision::Approve);
        }
        Ok(ProposeHomeResponse {
            success: true,
            message: String::new(),
            proposal_id: id.0,
            needs_approval: !unasked,
        })
    }

    pub(super) fn publish_plan(&self, planned: Result<PlannedPrimitive, String>, id: ProposalId) {
        let header = std_msgs::Header {
            stamp: self.node.now(),
            frame_id: self.parameters.world_frame.clone(),
        };
        match planned_motion(planned, id, &self.work_cell.joint_names, header) {
            Ok(motion) => self.planned.publish(motion),
            Err(error) => warn!("the motion of proposal {id}: {error}"),
        }
    }
}

/// The message that shows a motion, or why there is none.
fn planned_motion(
    planned: Result<PlannedPrimitive, String>,
    id: ProposalId,
    joint_names: &[String; 6],
    header: std_msgs::Header,
) -> Result<sctn_msgs::PlannedMotion, ConvertError> {
    let (motion, reason) = match planned {
        Ok(motion) => (motion, String::new()),
        Err(reason) => (PlannedPrimitive::default(), reason),
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
