//! Motions: start, end, reported result.

use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use node_kit::Level;
use pick_place::{ExecuteError, Outcome, Phase, go_home, put_down};
use rehearsal::{HOME_SETTINGS, Picked, touchdown};
use step_protocol::{
    MotionCause, MotionEnd, MotionWord, Proposal, ProposalId, Report, StepOutcome, StopCause,
};
use tokio::runtime::Handle;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tracing::info;
use ur_driver::{DriverError, DriverRobot};

use super::Executor;

/// A primitive, or the way home, under way.
pub(super) struct Motion {
    pub(super) cause: MotionCause,
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
        let motion = format!("the motion of proposal {}", proposal.id);
        self.stop_memory.begin(&motion, true);
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
        self.picked = seen.as_ref().map(|(seen, _)| Picked {
            tip: proposal.action.tips().0,
            seen: Arc::clone(seen),
        });
        self.start(MotionCause::Proposal(id), move |robot| {
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

    /// An id for a way home: of the present time and place.
    pub(super) fn home_id(&self) -> ProposalId {
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
        self.stop_memory.begin("the way home", false);
        let arm = self.work_cell.arm.clone();
        self.start(MotionCause::Home(id), move |robot| {
            go_home(robot, &arm, &HOME_SETTINGS).map(|()| None)
        });
    }

    /// Puts down what is held where it was picked, and brings the arm home.
    pub(super) fn begin_put_down(&mut self, id: ProposalId) {
        info!("proposal {id}: putting down what is held");
        self.stop_memory.begin("putting down what is held", false);
        let arm = self.work_cell.arm.clone();
        // The gate has asked for it before.
        let what = self.robot().put_down();
        self.start(MotionCause::PutDown(id), move |robot| {
            let what = what.map_err(|reason| ExecuteError::Robot {
                phase: Phase::Retreat,
                error: DriverError::Fault(reason),
            })?;
            put_down(robot, &arm, &what, &HOME_SETTINGS).map(|()| None)
        });
    }

    /// Moves the arm on a thread of its own.
    pub(super) fn start(
        &mut self,
        cause: MotionCause,
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
        cause: MotionCause,
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
        let end = match result {
            Ok(Ok(outcome)) => MotionEnd::Done(outcome),
            Ok(Err(ExecuteError::Robot {
                phase,
                error: DriverError::Stopped,
            })) => MotionEnd::Stopped(phase),
            Ok(Err(error)) => MotionEnd::Failed(error.to_string()),
            Err(error) => MotionEnd::Failed(format!("{error:#}")),
        };
        let MotionWord {
            outcome,
            reason,
            broken_off,
        } = end.word(cause, stopped);
        if let Some(reason) = &broken_off {
            self.stop_memory.remember(reason);
        }
        self.stop_memory.end();
        let level = match outcome {
            StepOutcome::Fault => Level::Error,
            _ => Level::Ok,
        };
        self.node.diagnostics().set("motion", level, &reason, []);
        // Observations from then on show the result. Simulated time may still be on its way.
        let now = self.node.clock().time();
        let end = stamps.map_or(now, |(_, last)| last.max(now));
        let duration = stamps.map_or(Duration::ZERO, |(first, last)| last - first.min(last));
        let actions = self.gate.finish(end, broken_off.is_some());
        let id = cause.id();
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
        self.rehearse_next();
    }
}

/// Waits for the end of a motion, and takes it; for ever when there is none.
pub(super) async fn end_of(
    motion: &mut Option<Motion>,
) -> (MotionCause, Option<StopCause>, anyhow::Result<Ended>) {
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
