//! One motion: a goal, its answer, its end, and what breaks it off.
//!
//! Cancelling and watching are part of the motion's own future: whoever waits for the motion waits for an arm at rest.

use std::future::Future;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use msgs::Action;
use node_kit::{ActionClient, CallError, CallOptions, GoalStatus, SentGoal};
use pick_place::ContactSign;
use tokio::sync::oneshot;
use tokio::time::{MissedTickBehavior, interval, sleep, timeout};
use tokio_util::sync::CancellationToken;
use tracing::{debug, info, warn};

use crate::planted::{Planted, is_planted};
use crate::{DriverClient, DriverError, DriverParameters};

/// How often a motion is looked after.
pub(crate) const WATCH_PERIOD: Duration = Duration::from_millis(20);
/// How long the answer to a cancel is waited for, and the pause before goals are cancelled again while the arm does not come to rest.
const CANCEL_PERIOD: Duration = Duration::from_millis(200);
/// A driver that answers later than this has the fault of its issue 1908: `trajectory_until_node` takes 1 to 2 s, and rejects what has
/// ended by then.
const PROMPT_ANSWER: Duration = Duration::from_millis(900);
/// After the time that an action may take to answer, an answer that is still to come is waited for by so much more.
const LATE_ANSWER: Duration = Duration::from_secs(30);

impl DriverClient {
    /// Has a goal carried out, under watch.
    ///
    /// # Errors
    /// The motion was broken off; the arm rests, or the error says that it may still be moving.
    pub(crate) async fn carry_out<A: Action + 'static>(
        &self,
        client: &Arc<ActionClient<A>>,
        goal: A::Goal,
        planned: Duration,
        stop: &CancellationToken,
    ) -> Result<(GoalStatus, A::Result), DriverError> {
        // Until the end, breaking off included.
        let _moving = self.heartbeat.moving();
        let begin = Instant::now();
        let trouble = self.trouble(planned, stop);
        tokio::pin!(trouble);
        let limit = Duration::from_secs_f64(self.parameters.answer_timeout_s);
        let answer = self.send(client, goal);
        let answered = tokio::select! {
            trouble = &mut trouble => Err(trouble),
            answer = timeout(limit, answer) => match answer {
                Ok(Ok(answer)) => answer.map_err(DriverError::fault),
                Ok(Err(_)) | Err(_) => Err(DriverError::Fault(format!(
                    "{} has not answered a goal within {:.1} s",
                    client.name(),
                    limit.as_secs_f64()
                ))),
            },
        };
        let sent = match answered {
            Ok(sent) => sent,
            Err(error) => return Err(self.break_off(error).await),
        };
        let accepted = begin.elapsed();
        if accepted > PROMPT_ANSWER && !self.is_late.swap(true, Ordering::Relaxed) {
            warn!(
                "{} has taken {:.1} s to accept a goal. UR's driver takes 1 to 2 s before the fix of its issue 1908, and may reject short descents: docs/guide/deploy.md",
                client.name(),
                accepted.as_secs_f64()
            );
        }
        let ended = tokio::select! {
            end = sent.result() => end.map_err(DriverError::fault),
            trouble = trouble => Err(trouble),
        };
        match ended {
            Ok(end) => {
                debug!(
                    "motion of {planned:?}: accepted after {accepted:?}, ended after {:?}",
                    begin.elapsed()
                );
                Ok(end)
            }
            Err(error) => Err(self.break_off(error).await),
        }
    }

    /// Sends a goal once. Where nobody waits for the answer any more when it comes, the goal is cancelled. Until it has come a motion
    /// counts as under way: no other begins, and where this process ends the watchdog cancels the goal.
    fn send<A: Action + 'static>(
        &self,
        client: &Arc<ActionClient<A>>,
        goal: A::Goal,
    ) -> oneshot::Receiver<Result<SentGoal<A>, CallError>> {
        let (sender, answer) = oneshot::channel();
        let (client, options) = (Arc::clone(client), self.options());
        let limit = Duration::from_secs_f64(self.parameters.answer_timeout_s) + LATE_ANSWER;
        let unanswered = self.heartbeat.moving();
        self.tasks.spawn(async move {
            let _unanswered = unanswered;
            let Ok(answer) = timeout(limit, client.send_goal_once(&goal)).await else {
                warn!(
                    "{}: a goal counts as lost after {limit:?} without an answer",
                    client.name()
                );
                return;
            };
            let Err(Ok(sent)) = sender.send(answer) else {
                return;
            };
            warn!(
                "{}: accepted after the motion was broken off: cancelled",
                client.name()
            );
            let (one, all) = tokio::join!(sent.cancel(&options), client.cancel_all(&options));
            if let Err(error) = one.and(all) {
                warn!("{}: {error}", client.name());
            }
        });
        answer
    }

    /// Breaks a motion off. Returns the reason, with what could not be made sure of.
    pub(crate) async fn break_off(&self, reason: DriverError) -> DriverError {
        if is_planted(Planted::AnswersWithoutCancel) {
            return reason;
        }
        let stopped = self.stop_arm().await;
        let reason = match (reason, self.status.borrow().safety_stop()) {
            // The driver tells its modes one by one: the power that is off before the emergency stop that has switched it off.
            (DriverError::Fault(reason), Some(stop)) if !reason.contains(&stop) => {
                DriverError::Fault(format!("{stop}; {reason}"))
            }
            (reason, _) => reason,
        };
        match stopped {
            Ok(()) => {
                info!("broken off, the arm rests: {reason}");
                reason
            }
            Err(unsure) => DriverError::Fault(format!("{reason}; {unsure}")),
        }
    }

    /// Cancels both actions and watches the arm until it rests.
    ///
    /// # Errors
    /// The arm was not seen to come to rest.
    pub(crate) async fn stop_arm(&self) -> Result<(), String> {
        let called = self.origin.elapsed();
        let limit = Duration::from_secs_f64(self.parameters.stop_timeout_s);
        let mut status = self.status.clone();
        let resting = async {
            while !self.rests_since(&status.borrow_and_update(), called) {
                if status.changed().await.is_err() {
                    std::future::pending::<()>().await;
                }
            }
        };
        let stopped = async {
            tokio::pin!(resting);
            // Once at least, also where the arm rests already: a goal may be on its way.
            self.cancel_everything().await;
            loop {
                tokio::select! {
                    () = &mut resting => return,
                    () = sleep(CANCEL_PERIOD) => {}
                }
                tokio::select! {
                    () = &mut resting => return,
                    () = self.cancel_everything() => {}
                }
            }
        };
        timeout(limit, stopped).await.map_err(|_| {
            format!(
                "the arm was not seen to come to rest within {:.1} s: it may still be moving",
                limit.as_secs_f64()
            )
        })
    }

    /// Asks both actions to cancel all their goals, and waits a little for the answers.
    async fn cancel_everything(&self) {
        let options = CallOptions {
            attempts: 1,
            timeout: CANCEL_PERIOD,
        };
        let until = async {
            if self.parameters.contact == ContactSign::UntilAction {
                answered(self.until.cancel_all(&options)).await;
            }
        };
        tokio::join!(answered(self.follow.cancel_all(&options)), until);
    }

    /// Waits for a reason to break a motion off.
    async fn trouble(&self, planned: Duration, stop: &CancellationToken) -> DriverError {
        let DriverParameters {
            motion_time_factor,
            motion_time_margin_s,
            ..
        } = self.parameters;
        let margin = Duration::from_secs_f64(motion_time_margin_s);
        let limit = planned.mul_f64(motion_time_factor) + margin;
        let begin_ns = self.clock.now_ns();
        let since = self.origin.elapsed();
        let mut ticks = interval(WATCH_PERIOD);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                () = stop.cancelled() => return DriverError::Stopped,
                _ = ticks.tick() => {}
            }
            if self.is_disabled_since(since) {
                return DriverError::Stopped;
            }
            if let Some(obstacle) = self.obstacle() {
                return DriverError::Fault(obstacle);
            }
            let elapsed_ns = self.clock.now_ns() - begin_ns;
            if u128::try_from(elapsed_ns).is_ok_and(|elapsed| elapsed > limit.as_nanos()) {
                return DriverError::Fault(format!(
                    "a motion of {:.1} s has not ended after {:.1} s",
                    planned.as_secs_f64(),
                    limit.as_secs_f64()
                ));
            }
        }
    }
}

/// Waits for an answer, which another call of the same service may hold up.
async fn answered(call: impl Future<Output = Result<(), CallError>>) {
    match timeout(CANCEL_PERIOD, call).await {
        Ok(Ok(())) => {}
        Ok(Err(error)) => debug!("{error}"),
        Err(_) => debug!("no answer to a cancel within {CANCEL_PERIOD:?}"),
    }
}
