//! Motions: their start, their end, and what is said of it.

use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use msgs::sctn_msgs::ProposeHomeResponse;
use node_kit::{Level, RequestId};
use pick_place::{ExecuteError, Outcome, Phase, go_home};
use step_protocol::{OperatorDecision, Proposal, ProposalId, Report, StepOutcome};
use tokio::runtime::Handle;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tracing::{info, warn};
use ur_driver::planted::{Planted, is_planted};
use ur_driver::{DriverError, DriverRobot};

use super::Executor;
use crate::dry_run::HOME_SETTINGS;
use crate::surface::touchdown;

/// What moves the arm.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Cause {
    /// An approved proposal.
    Proposal(ProposalId),
    /// An approved way home.
    Home(ProposalId),
}

/// Why a motion is stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum StopCause {
    Operator,
    GoalCancelled,
    NobodyPresent,
    Deactivated,
    Shutdown,
}

impl StopCause {
    pub(super) const fn text(self) -> &'static str {
        match self {
            Self::Operator => "stopped by the operator",
            Self::GoalCancelled => "stopped because its goal was cancelled",
            Self::NobodyPresent => "stopped because no operator is present",
            Self::Deactivated => "stopped because the executor was deactivated",
            Self::Shutdown => "stopped because the executor was told to end",
        }
    }
}

/// A primitive, or the way home, under way.
pub(super) struct Motion {
    pub(super) cause: Cause,
    stop: CancellationToken,
    /// What has stopped it first.
    stopped: Option<StopCause>,
    task: JoinHandle<Ended>,
}

impl Motion {
    pub(super) fn stop(&mut self, cause: StopCause) {
        self.stopped.get_or_insert(cause);
        self.stop.cancel();
    }

    pub(super) fn is_stopped(&self) -> bool {
        self.stopped.is_some()
    }
}

/// How a motion ended.
pub(super) struct Ended {
    /// Nothing at home without a primitive.
    result: Result<Option<Outcome>, ExecuteError<DriverError>>,
    /// Stamps of the first and the last joint reading.
    stamps: Option<(Duration, Duration)>,
}

impl Executor<'_> {
    pub(super) fn begin(&mut self, proposal: Proposal) {
        info!("proposal {}: moving", proposal.id);
        self.stop_memory.forget();
        if let Some(goal) = &mut self.goal {
            goal.moving = goal.id == proposal.id;
        }
        let phases = self.phase_sender.clone();
        let arm = self.work_cell.arm.clone();
        let diagnostics = self.node.diagnostics().clone();
        let id = proposal.id;
        let (contact, sign) = (self.parameters.contact, self.parameters.driver.contact);
        let seen = self.seen.clone();
        let observe = move |phase: Phase| {
            let values = [("proposal_id", id.to_string())];
            diagnostics.set("motion", Level::Ok, format!("{phase:?}"), values);
            // The receiver lives as long as the node.
            let _ = phases.send(phase);
        };
        self.picked = Some(proposal.action.pick);
        self.start(Cause::Proposal(id), move |robot| {
            let Proposal {
                action, settings, ..
            } = &proposal;
            // The gate has asked for it before: it is there.
            let touchdown = seen.map(|(seen, _)| touchdown(&seen, action, &contact, sign));
            let touchdown = touchdown
                .transpose()
                .map_err(|reason| ExecuteError::Robot {
                    phase: Phase::Approach,
                    error: DriverError::Fault(reason),
                })?;
            let touchdown = touchdown.flatten();
            pick_place::execute_on(robot, &arm, action, settings, touchdown.as_ref(), observe)
                .map(Some)
        });
    }

    /// Proposes the way home, for after a stop or a fault. The call may come again because its answer was lost.
    pub(super) fn on_propose_home(&mut self, call: RequestId) {
        let robot = self.robot();
        let id = self.home_id();
        let answer = match self.gate.propose_home(id, &robot) {
            Ok(id) => {
                info!("proposal {id}: the way home");
                self.publish_plan(robot.dry_run_home(), id);
                let unasked = self.gate.moves_unasked(id) || is_planted(Planted::HomeUnasked);
                if unasked {
                    self.confirm(id, OperatorDecision::Approve);
                }
                ProposeHomeResponse {
                    success: true,
                    message: String::new(),
                    proposal_id: id.0,
                    needs_approval: !unasked,
                }
            }
            Err(reason) => {
                warn!("home: {reason}");
                ProposeHomeResponse {
                    success: false,
                    message: reason,
                    ..Default::default()
                }
            }
        };
        self.home.respond(call, answer);
    }

    /// An id for a way home: of the present time and place.
    fn home_id(&self) -> ProposalId {
        let mut hash = DefaultHasher::new();
        self.node.clock().now_ns().hash(&mut hash);
        self.origin.elapsed().hash(&mut hash);
        if let Some(joints) = &self.status.borrow().joints {
            for position_rad in &joints.value.positions_rad {
                position_rad.to_bits().hash(&mut hash);
            }
        }
        ProposalId(hash.finish())
    }

    /// Brings the arm home, straight up first; suction stays as it is.
    pub(super) fn begin_home(&mut self, id: ProposalId) {
        info!("proposal {id}: moving home");
        let arm = self.work_cell.arm.clone();
        self.start(Cause::Home(id), move |robot| {
            go_home(robot, &arm, &HOME_SETTINGS).map(|()| None)
        });
    }

    /// Moves the arm on a thread of its own.
    pub(super) fn start(
        &mut self,
        cause: Cause,
        work: impl FnOnce(&mut DriverRobot) -> Result<Option<Outcome>, ExecuteError<DriverError>>
        + Send
        + 'static,
    ) {
        let stop = CancellationToken::new();
        let mut robot = DriverRobot::new(Arc::clone(&self.driver), Handle::current(), stop.clone());
        let task = self.node.spawn_blocking(move || Ended {
            result: work(&mut robot),
            stamps: robot.stamps,
        });
        self.motion = Some(Motion {
            cause,
            stop,
            stopped: None,
            task,
        });
    }

    pub(super) fn on_end(
        &mut self,
        cause: Cause,
        stopped: Option<StopCause>,
        ended: anyhow::Result<Ended>,
    ) {
        while let Ok(phase) = self.phases.try_recv() {
            self.say_phase(phase);
        }
        let (result, stamps) = match ended {
            Ok(ended) => (Ok(ended.result), ended.stamps),
            Err(error) => (Err(error), None),
        };
        let (outcome, mut reason) = match result {
            Ok(Ok(Some(outcome))) => (StepOutcome::from(outcome), why(outcome).to_owned()),
            Ok(Ok(None)) => (StepOutcome::AtHome, String::new()),
            Ok(Err(ExecuteError::Robot {
                phase,
                error: DriverError::Stopped,
            })) => (
                StepOutcome::Stopped,
                format!("{phase:?}: {}", stopped.map_or("stopped", StopCause::text)),
            ),
            Ok(Err(error)) => (StepOutcome::Fault, error.to_string()),
            Err(error) => (StepOutcome::Fault, format!("{error:#}")),
        };
        let broken_off = matches!(outcome, StepOutcome::Stopped | StepOutcome::Fault);
        if broken_off {
            self.stop_memory.remember(&reason);
            reason += "; the arm stands where it is, suction is as it was; a new observation and approval are needed";
        } else if stopped.is_some() {
            reason = format!("the stop came after the end. {reason}")
                .trim()
                .to_owned();
        }
        let level = if outcome == StepOutcome::Fault {
            Level::Error
        } else {
            Level::Ok
        };
        self.node.diagnostics().set("motion", level, &reason, []);
        // Observations from then on show the result. Simulated time may still be on its way.
        let now = Duration::from_nanos(self.node.clock().now_ns().max(0) as u64);
        let end = stamps.map_or(now, |(_, last)| last.max(now));
        let duration = stamps.map_or(Duration::ZERO, |(first, last)| last - first.min(last));
        let actions = self.gate.finish(end, broken_off);
        let (id, outcome) = match cause {
            Cause::Proposal(id) => (id, outcome),
            Cause::Home(id) if broken_off => (id, StepOutcome::NotHome),
            Cause::Home(id) => (id, StepOutcome::AtHome),
        };
        let report = Report {
            id,
            outcome,
            reason,
            status: self.gate.status(id),
        };
        self.report(report, Some((end, duration)));
        #[cfg(feature = "planted_faults")]
        self.plant_at_end(outcome);
        self.act(actions);
        self.ask_again();
    }
}

/// Waits for the end of a motion, and takes it; for ever when there is none.
pub(super) async fn end_of(
    motion: &mut Option<Motion>,
) -> (Cause, Option<StopCause>, anyhow::Result<Ended>) {
    match motion {
        Some(running) => {
            let ended = (&mut running.task).await;
            let ended = ended.context("the motion's thread panicked");
            let (cause, stopped) = (running.cause, running.stopped);
            *motion = None;
            (cause, stopped, ended)
        }
        None => std::future::pending().await,
    }
}

fn why(outcome: Outcome) -> &'static str {
    match outcome {
        Outcome::Placed => "",
        Outcome::NoContact => "the descent met nothing to pick",
        Outcome::GraspFailed => "suction held nothing",
        Outcome::Dropped => "the object was lost on the way",
        Outcome::LagAborted => "the tip lagged too far behind; the object was released",
    }
}
