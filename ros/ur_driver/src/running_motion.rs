//! A motion on a thread of its own: it tells its phases, and can be stopped at any time.

use std::sync::Arc;
use std::time::Duration;

use node_kit::Node;
use pick_place::{ExecuteError, Outcome, Phase};
use step_protocol::MotionEnd;
use tokio::runtime::Handle;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use crate::{DriverClient, DriverError, DriverRobot};

/// What a primitive, or a way home, has come to.
type MotionResult = Result<Option<Outcome>, ExecuteError<DriverError>>;
/// Stamps of the first and the last joint reading.
type Stamps = Option<(Duration, Duration)>;

/// A motion under way.
pub struct RunningMotion {
    stop: CancellationToken,
    phases: mpsc::UnboundedReceiver<Phase>,
    thread: JoinHandle<(MotionResult, Stamps)>,
}

/// What a motion tells.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum MotionEvent {
    /// A phase begins.
    Phase(Phase),
    /// The last of it.
    Ended {
        /// How.
        end: MotionEnd,
        /// Stamps of the first and the last joint reading.
        stamps: Option<(Duration, Duration)>,
    },
}

impl RunningMotion {
    /// Moves the arm by `work`, which calls its second argument with each phase as it begins.
    pub fn begin(
        node: &Node,
        driver: &Arc<DriverClient>,
        work: impl FnOnce(&mut DriverRobot, &mut dyn FnMut(Phase)) -> MotionResult + Send + 'static,
    ) -> Self {
        let stop = CancellationToken::new();
        let (sender, phases) = mpsc::unbounded_channel();
        let mut robot = DriverRobot::new(Arc::clone(driver), Handle::current(), stop.clone());
        let thread = node.spawn_blocking(move || {
            let mut observe = |phase| {
                // An error: nobody listens any more.
                let _ = sender.send(phase);
            };
            let result = work(&mut robot, &mut observe);
            (result, robot.stamps)
        });
        Self {
            stop,
            phases,
            thread,
        }
    }

    /// Has the arm stopped; the end still has to be waited for.
    pub fn stop(&self) {
        self.stop.cancel();
    }

    /// Waits for what the motion tells next. Not to be called after its end.
    pub async fn next(&mut self) -> MotionEvent {
        // The thread drops its sender when all phases are told.
        if let Some(phase) = self.phases.recv().await {
            return MotionEvent::Phase(phase);
        }
        match (&mut self.thread).await {
            Ok((result, stamps)) => MotionEvent::Ended {
                end: end_of(result),
                stamps,
            },
            Err(error) => MotionEvent::Ended {
                end: MotionEnd::Failed(format!("the motion's thread panicked: {error}")),
                stamps: None,
            },
        }
    }
}

fn end_of(result: MotionResult) -> MotionEnd {
    match result {
        Ok(outcome) => MotionEnd::Done(outcome),
        Err(ExecuteError::Robot {
            phase,
            error: DriverError::Stopped,
        }) => MotionEnd::Stopped(phase),
        Err(error) => MotionEnd::Failed(error.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A motion that moves nothing.
    fn motion(
        work: impl FnOnce(mpsc::UnboundedSender<Phase>) -> MotionResult + Send + 'static,
    ) -> RunningMotion {
        let (sender, phases) = mpsc::unbounded_channel();
        RunningMotion {
            stop: CancellationToken::new(),
            phases,
            thread: tokio::task::spawn_blocking(move || (work(sender), None)),
        }
    }

    fn ended(end: MotionEnd) -> MotionEvent {
        MotionEvent::Ended { end, stamps: None }
    }

    #[tokio::test]
    async fn all_phases_are_told_before_the_end() {
        let mut motion = motion(|phases| {
            phases.send(Phase::Approach).unwrap();
            phases.send(Phase::Home).unwrap();
            Ok(Some(Outcome::NoContact))
        });
        assert_eq!(motion.next().await, MotionEvent::Phase(Phase::Approach));
        assert_eq!(motion.next().await, MotionEvent::Phase(Phase::Home));
        let done = ended(MotionEnd::Done(Some(Outcome::NoContact)));
        assert_eq!(motion.next().await, done);
    }

    #[tokio::test]
    async fn a_stop_is_no_fault_and_a_panic_is_one() {
        let stopped = motion(|_| {
            Err(ExecuteError::Robot {
                phase: Phase::Lift,
                error: DriverError::Stopped,
            })
        })
        .next()
        .await;
        assert_eq!(stopped, ended(MotionEnd::Stopped(Phase::Lift)));
        let lost = motion(|_| {
            Err(ExecuteError::Robot {
                phase: Phase::Lift,
                error: DriverError::Fault("lost".to_owned()),
            })
        })
        .next()
        .await;
        let fault = MotionEnd::Failed("Lift: lost".to_owned());
        assert_eq!(lost, ended(fault));
        let panicked = motion(|_| panic!("on purpose")).next().await;
        let MotionEvent::Ended {
            end: MotionEnd::Failed(reason),
            stamps: None,
        } = panicked
        else {
            panic!("expected a fault, found {panicked:?}");
        };
        assert!(
            reason.starts_with("the motion's thread panicked"),
            "{reason}"
        );
    }
}
