//! Motions: their start, their end, and what is said of it.

use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use msgs::std_srvs::TriggerResponse;
use node_kit::{Level, RequestId};
use pick_place::{ExecuteError, Outcome, Phase};
use step_protocol::{Proposal, ProposalId, Report, StepOutcome};
use tokio::runtime::Handle;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tracing::{info, warn};

use super::Executor;
use crate::driver::{DriverError, DriverRobot};
use crate::home::go_home;
use crate::surface::touchdown;

/// Calls of `home` that are answered when the arm is there; more fail at once.
const WAITING_CALLS: usize = 16;

/// What moves the arm.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Cause {
    /// An approved proposal.
    Proposal(ProposalId),
    /// A call of the service `home`.
    Home,
}

/// A primitive, or the way home, under way.
pub(super) struct Motion {
    pub(super) cause: Cause,
    pub(super) stop: CancellationToken,
    pub(super) task: JoinHandle<Ended>,
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

    /// Brings the arm home, for after a stop or a fault. The call may come again because its
    /// answer was lost.
    pub(super) fn on_home(&mut self, call: RequestId) {
        let at_work = self
            .motion
            .as_ref()
            .is_some_and(|motion| motion.cause == Cause::Home);
        if !at_work {
            if let Err(reason) = self.gate.go_home(&self.robot()) {
                warn!("home: {reason}");
                self.home.respond(
                    call,
                    TriggerResponse {
                        success: false,
                        message: reason,
                    },
                );
                return;
            }
            info!("home: moving");
            let arm = self.work_cell.arm.clone();
            self.start(Cause::Home, move |robot| {
                go_home(robot, &arm).map(|()| None)
            });
        }
        if self.home_calls.len() < WAITING_CALLS {
            self.home_calls.push(call);
        } else {
            let message = format!("{WAITING_CALLS} other calls wait");
            self.home.respond(
                call,
                TriggerResponse {
                    success: false,
                    message,
                },
            );
        }
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
        self.motion = Some(Motion { cause, stop, task });
    }

    pub(super) fn on_end(&mut self, cause: Cause, stopped: bool, ended: anyhow::Result<Ended>) {
        while let Ok(phase) = self.phases.try_recv() {
            self.say_phase(phase);
        }
        let (result, stamps) = match ended {
            Ok(ended) => (Ok(ended.result), ended.stamps),
            Err(error) => (Err(error), None),
        };
        let (outcome, mut reason) = match result {
            Ok(Ok(Some(outcome))) => (StepOutcome::from(outcome), why(outcome).to_owned()),
            Ok(Ok(None)) => (StepOutcome::Placed, "at home".to_owned()),
            Ok(Err(ExecuteError::Robot {
                phase,
                error: DriverError::Stopped,
            })) => (
                StepOutcome::Stopped,
                format!("{phase:?}: {}", DriverError::Stopped),
            ),
            Ok(Err(error)) => (StepOutcome::Fault, one_line(&error.to_string())),
            Err(error) => (StepOutcome::Fault, format!("{error:#}")),
        };
        let broken_off = matches!(outcome, StepOutcome::Stopped | StepOutcome::Fault);
        if broken_off {
            self.stop_memory.remember(&reason);
            reason += "; the arm stands where it is, suction is as it was; a new observation and approval are needed";
        } else if stopped {
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
        match cause {
            Cause::Proposal(id) => {
                let report = Report {
                    id,
                    outcome,
                    reason,
                    status: self.gate.status(id),
                };
                self.report(report, Some((end, duration)));
            }
            Cause::Home => {
                info!("home: {reason}");
                for call in std::mem::take(&mut self.home_calls) {
                    let response = TriggerResponse {
                        success: !broken_off,
                        message: reason.clone(),
                    };
                    self.home.respond(call, response);
                }
            }
        }
        self.act(actions);
        self.ask_again();
    }
}

/// Waits for the end of a motion, and takes it; for ever when there is none.
pub(super) async fn end_of(motion: &mut Option<Motion>) -> (Cause, bool, anyhow::Result<Ended>) {
    match motion {
        Some(running) => {
            let ended = (&mut running.task).await;
            let ended = ended.context("the motion's thread panicked");
            let (cause, stopped) = (running.cause, running.stop.is_cancelled());
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

/// Poses print themselves over several lines.
fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}
