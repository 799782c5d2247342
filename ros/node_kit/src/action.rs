//! Actions. The server answers every client at any time, with several goals at once; ros2-client's
//! `AsyncActionServer` does not, so this one is made from its three services.

use std::{
    collections::{BTreeMap, VecDeque},
    io,
    sync::{
        Arc, Mutex, MutexGuard, OnceLock, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

use futures::StreamExt as _;
use ros2_client::{
    Gid, RmwRequestId,
    action::{
        CancelGoalRequest, GetResultRequest, GetResultResponse, GoalStatusEnum, SendGoalRequest,
        SendGoalResponse,
    },
    action_msgs::{
        CancelGoalResponse, CancelGoalResponseEnum, GoalInfo, GoalStatus as StatusEntry,
        GoalStatusArray,
    },
    builtin_interfaces::Time,
};
use rustdds::mio1;
use tokio::sync::{Mutex as AsyncMutex, mpsc, watch};
use tokio_util::sync::CancellationToken;
use tracing::{debug, warn};

use msgs::Action;

use crate::{
    answerable::{Answerable, Hears},
    clock::Clock,
    graph::Graph,
    service::{CallError, CallOptions, ask, attempt},
    statistics::Statistics,
};

pub use ros2_client::action::{GoalId, GoalStatusEnum as GoalStatus};

/// Goals that wait for `recv`; further ones are rejected.
const WAITING_GOALS: usize = 16;
/// Finished goals whose results are kept for late requests.
const FINISHED_GOALS: usize = 64;
/// Requests for one goal that are kept for an answer.
const WAITING_REQUESTS: usize = 64;

/// A server that is not discovered for so long is not there.
const SERVER_LOST: Duration = Duration::from_secs(2);

type RosServer<A> =
    ros2_client::ActionServer<<A as Action>::Goal, <A as Action>::Result, <A as Action>::Feedback>;
type RosClient<A> =
    ros2_client::ActionClient<<A as Action>::Goal, <A as Action>::Result, <A as Action>::Feedback>;

/// Receives the goals of one action.
///
/// Cancel requests, result requests and repeated goal requests are answered in the background.
pub struct ActionServer<A: Action + 'static> {
    goals: mpsc::Receiver<NewGoal<A>>,
    waiting: Answerable<NewGoal<A>>,
    shared: Arc<Shared<A>>,
    waker: mio1::Waker,
}

struct Shared<A: Action + 'static> {
    server: RosServer<A>,
    clock: Clock,
    statistics: Arc<Statistics>,
    stop: AtomicBool,
    table: Mutex<Table<A>>,
    repeats: OnceLock<Repeats>,
}

/// What a repeated goal id is answered, and how many have come.
struct Repeats {
    accepted: bool,
    count: watch::Sender<u64>,
}

struct Table<A: Action + 'static> {
    goals: BTreeMap<GoalId, Entry<A>>,
    finished: VecDeque<GoalId>,
}

struct Entry<A: Action + 'static> {
    state: State<A::Result>,
    stamp: Time,
    cancel: CancellationToken,
    goal_requests: Vec<RmwRequestId>,
    result_requests: VecDeque<RmwRequestId>,
}

enum State<R> {
    /// Waits for `accept` or `reject`.
    New,
    Rejected,
    Running,
    Finished(GoalStatusEnum, R),
}

impl<R> State<R> {
    fn status(&self, cancelling: bool) -> Option<GoalStatusEnum> {
        match self {
            Self::New | Self::Rejected => None,
            Self::Running if cancelling => Some(GoalStatusEnum::Canceling),
            Self::Running => Some(GoalStatusEnum::Executing),
            Self::Finished(status, _) => Some(*status),
        }
    }
}

impl<A: Action + 'static> ActionServer<A> {
    pub(crate) fn new(
        mut server: RosServer<A>,
        clock: Clock,
        graph: Graph,
        statistics: Arc<Statistics>,
    ) -> io::Result<Self> {
        // The low-level server can be waited for with mio only.
        let poll = mio1::Poll::new()?;
        let readable = mio1::Interest::READABLE;
        poll.registry()
            .register(server.goal_server(), mio1::Token(0), readable)?;
        poll.registry()
            .register(server.cancel_server(), mio1::Token(1), readable)?;
        poll.registry()
            .register(server.result_server(), mio1::Token(2), readable)?;
        let waker = mio1::Waker::new(poll.registry(), mio1::Token(3))?;
        let (sender, goals) = mpsc::channel(WAITING_GOALS);
        let feedback = format!("rt{}/_action/feedback", statistics.name);
        let shared = Arc::new(Shared {
            server,
            clock,
            statistics,
            stop: AtomicBool::new(false),
            table: Mutex::new(Table {
                goals: BTreeMap::new(),
                finished: VecDeque::new(),
            }),
            repeats: OnceLock::new(),
        });
        let receiving = Arc::clone(&shared);
        let span = tracing::Span::current();
        thread::Builder::new()
            .name("action_server".into())
            .spawn(move || span.in_scope(|| receiving.receive(poll, sender)))?;
        Ok(Self {
            goals,
            waiting: Answerable::new(graph, feedback, Hears::Feedback),
            shared,
            waker,
        })
    }

    /// The next goal, to be accepted or rejected. Can be cancelled without losing a goal.
    ///
    /// A client's first goal may come before its reader of feedback is discovered, and what is sent to nobody is lost.
    pub async fn recv(&mut self) -> NewGoal<A> {
        loop {
            if let Some(goal) = self.waiting.pop() {
                return goal;
            }
            tokio::select! {
                goal = self.goals.recv() => match goal {
                    Some(goal) => self.waiting.push(goal.client, goal),
                    // The receiving thread has gone, which only happens on shutdown.
                    None => std::future::pending().await,
                },
                () = self.waiting.changed() => {}
            }
        }
    }

    /// From now on a request with the id of an earlier goal is not taken for a repetition by a client that has missed the answer: it
    /// is answered with `accepted`, and counted. For servers that emulate rclcpp's, which do not allow it.
    pub fn count_repeats(&self, accepted: bool) -> watch::Receiver<u64> {
        let repeats = self.shared.repeats.get_or_init(|| Repeats {
            accepted,
            count: watch::channel(0).0,
        });
        repeats.count.subscribe()
    }

    /// The counters of this action's goals.
    pub fn statistics(&self) -> &Arc<Statistics> {
        &self.shared.statistics
    }
}

impl<A: Action + 'static> Drop for ActionServer<A> {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        if let Err(error) = self.waker.wake() {
            warn!("action server thread not woken: {error}");
        }
    }
}

impl<A: Action + 'static> Shared<A> {
    fn table(&self) -> MutexGuard<'_, Table<A>> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn receive(self: Arc<Self>, mut poll: mio1::Poll, goals: mpsc::Sender<NewGoal<A>>) {
        let mut events = mio1::Events::with_capacity(8);
        while !self.stop.load(Ordering::Acquire) {
            // Edges can be missed while a middleware thread adds samples: look at least this often.
            if let Err(error) = poll.poll(&mut events, Some(Duration::from_millis(250)))
                && error.kind() != io::ErrorKind::Interrupted
            {
                warn!("{}: {error}", self.statistics.name);
                return;
            }
            while let Some((id, request)) = self.read(self.server.receive_goal()) {
                self.on_goal(id, request, &goals);
            }
            while let Some((id, request)) = self.read(self.server.receive_cancel_request()) {
                self.on_cancel(id, &request);
            }
            while let Some((id, request)) = self.read(self.server.receive_result_request()) {
                self.on_result_request(id, request);
            }
        }
    }

    /// `None` when nothing is left; what cannot be decoded is counted and skipped.
    fn read<T>(&self, received: ros2_client::ReadResult<Option<T>>) -> Option<T> {
        received.unwrap_or_else(|error| {
            self.statistics.reject(error);
            None
        })
    }

    fn on_goal(
        self: &Arc<Self>,
        request_id: RmwRequestId,
        request: SendGoalRequest<A::Goal>,
        goals: &mpsc::Sender<NewGoal<A>>,
    ) {
        let id = request.goal_id;
        let mut table = self.table();
        if let Some(entry) = table.goals.get_mut(&id) {
            if let Some(repeats) = self.repeats.get() {
                repeats.count.send_modify(|count| *count += 1);
                return self.answer_goal(request_id, repeats.accepted, entry.stamp);
            }
            // The client asks again because our answer was lost.
            match entry.state {
                State::New => entry.goal_requests.push(request_id),
                State::Rejected => self.answer_goal(request_id, false, entry.stamp),
                _ => self.answer_goal(request_id, true, entry.stamp),
            }
            return;
        }
        let Ok(permit) = goals.try_reserve() else {
            drop(table);
            self.statistics
                .reject(format_args!("goal rejected: {WAITING_GOALS} others wait"));
            self.answer_goal(request_id, false, self.clock.ros_time());
            return;
        };
        self.statistics.count_message();
        table.goals.insert(
            id,
            Entry {
                state: State::New,
                stamp: self.clock.ros_time(),
                cancel: CancellationToken::new(),
                goal_requests: vec![request_id],
                result_requests: VecDeque::new(),
            },
        );
        drop(table);
        permit.send(NewGoal {
            goal: request.goal,
            client: request_id.writer_gid,
            handle: Unanswered {
                id,
                shared: Some(Arc::clone(self)),
            },
        });
    }

    fn on_cancel(&self, request_id: RmwRequestId, request: &CancelGoalRequest) {
        let GoalInfo { goal_id: id, stamp } = match goal_info(request) {
            Ok(info) => info,
            Err(error) => return self.statistics.reject(error),
        };
        // As action_msgs/CancelGoal says: no id and no stamp means all goals, a stamp adds all
        // goals accepted up to it.
        let all = id == GoalId::ZERO && stamp == Time::ZERO;
        let mut goals_canceling = Vec::new();
        let mut return_code = CancelGoalResponseEnum::None;
        let table = self.table();
        for (goal_id, entry) in &table.goals {
            let named = *goal_id == id;
            let before = stamp != Time::ZERO && entry.stamp <= stamp;
            if !(all || named || before) {
                continue;
            }
            match entry.state {
                State::Running => {
                    entry.cancel.cancel();
                    goals_canceling.push(GoalInfo {
                        goal_id: *goal_id,
                        stamp: entry.stamp,
                    });
                }
                State::Finished(..) if named => {
                    return_code = CancelGoalResponseEnum::GoalTerminated;
                }
                _ => {}
            }
        }
        let known = id == GoalId::ZERO || table.goals.contains_key(&id);
        drop(table);
        if !known {
            return_code = CancelGoalResponseEnum::UnknownGoal;
        } else if goals_canceling.is_empty() && return_code == CancelGoalResponseEnum::None {
            return_code = CancelGoalResponseEnum::Rejected;
        }
        let response = CancelGoalResponse {
            return_code,
            goals_canceling,
        };
        if let Err(error) = self.server.send_cancel_response(request_id, response) {
            self.statistics
                .reject(format_args!("cancel response not sent: {error}"));
        }
        self.publish_statuses();
    }

    fn on_result_request(&self, request_id: RmwRequestId, request: GetResultRequest) {
        let mut table = self.table();
        match table.goals.get_mut(&request.goal_id) {
            Some(Entry {
                state: State::Finished(status, result),
                ..
            }) => self.answer_result(request_id, *status, result.clone()),
            Some(entry) if !matches!(entry.state, State::Rejected) => {
                if entry.result_requests.len() == WAITING_REQUESTS {
                    entry.result_requests.pop_front();
                }
                entry.result_requests.push_back(request_id);
            }
            _ => self.answer_result(request_id, GoalStatusEnum::Unknown, A::Result::default()),
        }
    }

    fn decide(&self, id: GoalId, accepted: bool) -> CancellationToken {
        let mut table = self.table();
        let mut cancel = CancellationToken::new();
        if let Some(entry) = table.goals.get_mut(&id) {
            entry.stamp = self.clock.ros_time();
            entry.state = if accepted {
                State::Running
            } else {
                State::Rejected
            };
            cancel = entry.cancel.clone();
            for request_id in entry.goal_requests.drain(..) {
                self.answer_goal(request_id, accepted, entry.stamp);
            }
            if !accepted {
                for request_id in entry.result_requests.drain(..) {
                    self.answer_result(request_id, GoalStatusEnum::Unknown, A::Result::default());
                }
                table.retire(id);
            }
        }
        drop(table);
        self.publish_statuses();
        cancel
    }

    fn finish(&self, id: GoalId, status: GoalStatusEnum, result: A::Result) {
        let mut table = self.table();
        if let Some(entry) = table.goals.get_mut(&id) {
            for request_id in std::mem::take(&mut entry.result_requests) {
                self.answer_result(request_id, status, result.clone());
            }
            entry.state = State::Finished(status, result);
            table.retire(id);
        }
        drop(table);
        self.publish_statuses();
    }

    fn answer_goal(&self, request_id: RmwRequestId, accepted: bool, stamp: Time) {
        let response = SendGoalResponse { accepted, stamp };
        if let Err(error) = self.server.send_goal_response(request_id, response) {
            self.statistics
                .reject(format_args!("goal response not sent: {error}"));
        }
    }

    fn answer_result(&self, request_id: RmwRequestId, status: GoalStatusEnum, result: A::Result) {
        let response = GetResultResponse { status, result };
        if let Err(error) = self.server.send_result(request_id, response) {
            self.statistics
                .reject(format_args!("result not sent: {error}"));
        }
    }

    fn publish_statuses(&self) {
        let status_list = self
            .table()
            .goals
            .iter()
            .filter_map(|(goal_id, entry)| {
                Some(StatusEntry {
                    goal_info: GoalInfo {
                        goal_id: *goal_id,
                        stamp: entry.stamp,
                    },
                    status: entry.state.status(entry.cancel.is_cancelled())?,
                })
            })
            .collect();
        if let Err(error) = self
            .server
            .send_goal_statuses(GoalStatusArray { status_list })
        {
            self.statistics
                .reject(format_args!("status not sent: {}", error.forget_data()));
        }
    }
}

/// ros2-client keeps the field private, so it is read through its serialisation.
fn goal_info(request: &CancelGoalRequest) -> Result<GoalInfo, serde_yaml_ng::Error> {
    #[derive(serde::Deserialize)]
    struct Public {
        goal_info: GoalInfo,
    }
    let public: Public = serde_yaml_ng::from_value(serde_yaml_ng::to_value(request)?)?;
    Ok(public.goal_info)
}

impl<A: Action + 'static> Table<A> {
    fn retire(&mut self, id: GoalId) {
        self.finished.push_back(id);
        if self.finished.len() > FINISHED_GOALS
            && let Some(oldest) = self.finished.pop_front()
        {
            self.goals.remove(&oldest);
        }
    }
}

/// A goal that a client wants; rejected unless `accept` is called.
pub struct NewGoal<A: Action + 'static> {
    /// What is asked for; unchecked.
    pub goal: A::Goal,
    client: Gid,
    handle: Unanswered<A>,
}

struct Unanswered<A: Action + 'static> {
    id: GoalId,
    shared: Option<Arc<Shared<A>>>,
}

impl<A: Action + 'static> Drop for Unanswered<A> {
    fn drop(&mut self) {
        if let Some(shared) = self.shared.take() {
            shared.decide(self.id, false);
        }
    }
}

impl<A: Action + 'static> NewGoal<A> {
    /// Tells the client that the goal is accepted; it is executing from now on.
    pub fn accept(mut self) -> (A::Goal, RunningGoal<A>) {
        let id = self.handle.id;
        let shared = self.handle.shared.take();
        let cancel = match &shared {
            Some(shared) => shared.decide(id, true),
            None => CancellationToken::new(),
        };
        (self.goal, RunningGoal { id, shared, cancel })
    }

    /// Tells the client that the goal is refused, and says why in the log.
    pub fn reject(self, reason: impl std::fmt::Display) {
        if let Some(shared) = &self.handle.shared {
            shared
                .statistics
                .reject(format_args!("goal rejected: {reason}"));
        }
    }
}

/// An accepted goal. Ends with `succeed`, `abort` or `cancelled`; dropped otherwise, it is aborted
/// with a default result.
pub struct RunningGoal<A: Action + 'static> {
    id: GoalId,
    shared: Option<Arc<Shared<A>>>,
    cancel: CancellationToken,
}

impl<A: Action + 'static> RunningGoal<A> {
    /// The goal's id.
    pub fn id(&self) -> GoalId {
        self.id
    }

    /// Whether a client has asked to cancel this goal.
    pub fn is_cancel_requested(&self) -> bool {
        self.cancel.is_cancelled()
    }

    /// Waits until a client asks to cancel this goal.
    pub async fn cancel_requested(&self) {
        self.cancel.cancelled().await;
    }

    /// Publishes feedback.
    pub fn feedback(&self, feedback: A::Feedback) {
        if let Some(shared) = &self.shared
            && let Err(error) = shared.server.send_feedback(self.id, feedback)
        {
            shared
                .statistics
                .reject(format_args!("feedback not sent: {}", error.forget_data()));
        }
    }

    /// Ends the goal as reached.
    pub fn succeed(self, result: A::Result) {
        self.finish(GoalStatusEnum::Succeeded, result);
    }

    /// Ends the goal as failed.
    pub fn abort(self, result: A::Result) {
        self.finish(GoalStatusEnum::Aborted, result);
    }

    /// Ends the goal as cancelled.
    pub fn cancelled(self, result: A::Result) {
        self.finish(GoalStatusEnum::Canceled, result);
    }

    fn finish(mut self, status: GoalStatusEnum, result: A::Result) {
        if let Some(shared) = self.shared.take() {
            shared.finish(self.id, status, result);
        }
    }
}

impl<A: Action + 'static> Drop for RunningGoal<A> {
    fn drop(&mut self) {
        if let Some(shared) = self.shared.take() {
            shared.finish(self.id, GoalStatusEnum::Aborted, A::Result::default());
        }
    }
}

/// Sends goals to an action server.
pub struct ActionClient<A: Action + 'static> {
    client: Arc<RosClient<A>>,
    goal_call: AsyncMutex<()>,
    calls: Arc<Calls>,
    graph: Graph,
    name: String,
}

/// One call at a time per service: ros2-client drops replies to others.
#[derive(Default)]
struct Calls {
    cancel: AsyncMutex<()>,
    result: AsyncMutex<()>,
}

impl<A: Action + 'static> ActionClient<A> {
    pub(crate) fn new(client: RosClient<A>, graph: Graph, name: String) -> Self {
        Self {
            client: Arc::new(client),
            goal_call: AsyncMutex::default(),
            calls: Arc::default(),
            graph,
            name,
        }
    }

    /// Waits until a server is discovered.
    pub async fn wait_for_server(&self, limit: Duration) -> Result<(), CallError> {
        let discovered = self.graph.wait_for_action(&self.name, limit).await;
        CallError::unless_discovered(discovered, &self.name, limit)
    }

    /// Sends a goal, again under the same id if no reply comes, so that it is executed once.
    pub async fn send_goal(
        &self,
        goal: &A::Goal,
        options: &CallOptions,
    ) -> Result<SentGoal<A>, CallError> {
        let goal_id = GoalId::new_random();
        let _one_at_a_time = self.goal_call.lock().await;
        let reply = attempt(&self.name, options, || {
            let goal = goal.clone();
            let request = SendGoalRequest { goal_id, goal };
            ask(self.client.goal_client(), &self.name, request)
        })
        .await?;
        if !reply.accepted {
            return Err(CallError::Rejected {
                name: self.name.clone(),
            });
        }
        Ok(self.sent(goal_id))
    }

    /// Sends a goal once and waits for the answer for as long as the server is there: for servers that do not allow the same goal
    /// twice, as rclcpp's. Where the future is dropped, the answer is lost and the goal may still be accepted.
    pub async fn send_goal_once(&self, goal: &A::Goal) -> Result<SentGoal<A>, CallError> {
        let _one_at_a_time = self.goal_call.lock().await;
        self.wait_for_server(SERVER_LOST).await?;
        let goal_id = GoalId::new_random();
        let request = SendGoalRequest {
            goal_id,
            goal: goal.clone(),
        };
        let answer = ask(self.client.goal_client(), &self.name, request);
        futures::pin_mut!(answer);
        let reply = loop {
            match tokio::time::timeout(SERVER_LOST, answer.as_mut()).await {
                Ok(Ok(reply)) => break reply,
                Ok(Err(error)) => {
                    return Err(CallError::Middleware {
                        name: self.name.clone(),
                        reason: error.to_string(),
                    });
                }
                Err(_) if self.graph.has_action(&self.name) => {}
                Err(_) => {
                    return Err(CallError::Unavailable {
                        name: self.name.clone(),
                        waited: SERVER_LOST,
                    });
                }
            }
        };
        if !reply.accepted {
            return Err(CallError::Rejected {
                name: self.name.clone(),
            });
        }
        Ok(self.sent(goal_id))
    }

    fn sent(&self, id: GoalId) -> SentGoal<A> {
        SentGoal {
            id,
            client: Arc::clone(&self.client),
            calls: Arc::clone(&self.calls),
            graph: self.graph.clone(),
            name: self.name.clone(),
        }
    }

    /// Asks the server to cancel all its goals: where the reply to a goal was lost, its state is
    /// not known.
    pub async fn cancel_all(&self, options: &CallOptions) -> Result<(), CallError> {
        let _one_at_a_time = self.calls.cancel.lock().await;
        attempt(&self.name, options, || {
            self.client.async_cancel_goal(GoalId::ZERO, Time::ZERO)
        })
        .await
        .map(|_| ())
    }

    /// Absolute name of the action.
    pub fn name(&self) -> &str {
        &self.name
    }
}

/// A goal that its server has accepted.
pub struct SentGoal<A: Action + 'static> {
    id: GoalId,
    client: Arc<RosClient<A>>,
    calls: Arc<Calls>,
    graph: Graph,
    name: String,
}

impl<A: Action + 'static> SentGoal<A> {
    /// The goal's id.
    pub fn id(&self) -> GoalId {
        self.id
    }

    /// Waits for the end of the goal, however long it takes, while the server is there. Results of
    /// several goals of one client are waited for one after the other.
    pub async fn result(&self) -> Result<(GoalStatus, A::Result), CallError> {
        let one = CallOptions {
            attempts: 1,
            timeout: Duration::from_secs(2),
        };
        let _one_at_a_time = self.calls.result.lock().await;
        loop {
            let reply = attempt(&self.name, &one, || {
                self.client.async_request_result(self.id)
            })
            .await;
            match reply {
                // The server forgets a goal only long after it has ended, or by a restart.
                Ok((GoalStatusEnum::Unknown, _)) => {
                    return Err(CallError::Middleware {
                        name: self.name.clone(),
                        reason: "the server does not know the goal (was it restarted?)".into(),
                    });
                }
                Ok(end) => return Ok(end),
                Err(CallError::NoReply { .. }) if self.graph.has_action(&self.name) => {
                    debug!("{}: goal {:?} still running", self.name, self.id);
                }
                Err(CallError::NoReply { timeout, .. }) => {
                    return Err(CallError::Unavailable {
                        name: self.name.clone(),
                        waited: timeout,
                    });
                }
                Err(error) => return Err(error),
            }
        }
    }

    /// The next feedback on this goal; for ever where there is none. What comes while nobody waits may be lost to
    /// another goal of the same client.
    pub async fn feedback(&self) -> A::Feedback {
        loop {
            let stream = self.client.feedback_stream(self.id);
            futures::pin_mut!(stream);
            match stream.next().await {
                Some(Ok(feedback)) => return feedback,
                Some(Err(error)) => debug!("{}: feedback not read: {error}", self.name),
                None => std::future::pending().await,
            }
        }
    }

    /// Asks the server to cancel the goal; its end still comes through `result`.
    pub async fn cancel(&self, options: &CallOptions) -> Result<(), CallError> {
        let _one_at_a_time = self.calls.cancel.lock().await;
        let response = attempt(&self.name, options, || {
            self.client.async_cancel_goal(self.id, Time::ZERO)
        })
        .await?;
        match response.return_code {
            CancelGoalResponseEnum::None | CancelGoalResponseEnum::GoalTerminated => Ok(()),
            code => Err(CallError::Middleware {
                name: self.name.clone(),
                reason: format!("cancel refused: {code:?}"),
            }),
        }
    }
}
