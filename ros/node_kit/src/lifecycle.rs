//! The managed lifecycle of a node: states, transitions, their services, and who carries them out.
//!
//! Names, numbers and order are those of rcl_lifecycle, so that `ros2 lifecycle` and lifecycle managers
//! know them.

use std::{
    collections::VecDeque,
    sync::{
        Arc,
        atomic::{AtomicU8, Ordering::Relaxed},
    },
    time::Duration,
};

use msgs::lifecycle_msgs::{
    self, ChangeState, ChangeStateRequest, ChangeStateResponse, GetAvailableStates,
    GetAvailableStatesResponse, GetAvailableTransitions, GetAvailableTransitionsResponse, GetState,
    GetStateRequest, GetStateResponse, TransitionDescription, TransitionEvent,
};
use tokio::{
    sync::{mpsc, oneshot},
    time::timeout,
};
use tracing::{error, info};

use crate::{
    diagnostics::Level,
    node::{Node, NodeError},
    parameters::Parameters,
    qos::Qos,
    service::{CallError, CallOptions, ServiceClient},
    topic::Publisher,
};

/// How long a node that waits for the end of its work may take to tidy up.
const GRACE: Duration = Duration::from_secs(4);

/// Requests that wait for the transition under way.
const WAITING_REQUESTS: usize = 8;

/// What a node does while it is active. Made by its function `configure`, dropped when it is cleaned up.
pub trait Active: Send + 'static {
    /// Works until the node is deactivated: this future is then dropped, unless it waits for
    /// [`Node::deactivated`], which gives it two seconds to come to its end. An error ends the node.
    ///
    /// Subscriptions, services and tasks that are made here end with it, so that nothing that came while the
    /// node was inactive is ever acted on.
    fn run(&mut self, node: &Node) -> impl Future<Output = anyhow::Result<()>> + Send;
}

/// A state of the lifecycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum State {
    /// Only parameters and lifecycle are there.
    Unconfigured = 1,
    /// Everything is loaded; no topic is subscribed or published.
    Inactive = 2,
    /// Topics, services and actions work.
    Active = 3,
    /// The process is about to end.
    Finalized = 4,
    /// On the way.
    Configuring = 10,
    /// On the way.
    CleaningUp = 11,
    /// On the way.
    ShuttingDown = 12,
    /// On the way.
    Activating = 13,
    /// On the way.
    Deactivating = 14,
    /// After an error at work.
    ErrorProcessing = 15,
}

impl State {
    const ALL: [Self; 10] = [
        Self::Unconfigured,
        Self::Inactive,
        Self::Active,
        Self::Finalized,
        Self::Configuring,
        Self::CleaningUp,
        Self::ShuttingDown,
        Self::Activating,
        Self::Deactivating,
        Self::ErrorProcessing,
    ];

    /// As ROS names it.
    pub fn label(self) -> &'static str {
        match self {
            Self::Unconfigured => "unconfigured",
            Self::Inactive => "inactive",
            Self::Active => "active",
            Self::Finalized => "finalized",
            Self::Configuring => "configuring",
            Self::CleaningUp => "cleaningup",
            Self::ShuttingDown => "shuttingdown",
            Self::Activating => "activating",
            Self::Deactivating => "deactivating",
            Self::ErrorProcessing => "errorprocessing",
        }
    }

    fn of_id(id: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|state| *state as u8 == id)
    }

    fn to_msg(self) -> lifecycle_msgs::State {
        lifecycle_msgs::State {
            id: self as u8,
            label: self.label().to_owned(),
        }
    }
}

/// What may be asked of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Transition {
    /// Read parameters, load what is needed.
    Configure,
    /// Start to work.
    Activate,
    /// Stop to work, safely.
    Deactivate,
    /// Forget what was loaded.
    CleanUp,
    /// Stop for good.
    ShutDown,
}

impl Transition {
    /// As ROS names it.
    pub fn label(self) -> &'static str {
        match self {
            Self::Configure => "configure",
            Self::Activate => "activate",
            Self::Deactivate => "deactivate",
            Self::CleanUp => "cleanup",
            Self::ShutDown => "shutdown",
        }
    }

    fn of_id(id: u8) -> Option<Self> {
        use lifecycle_msgs::Transition as T;
        Some(match id {
            T::TRANSITION_CONFIGURE => Self::Configure,
            T::TRANSITION_ACTIVATE => Self::Activate,
            T::TRANSITION_DEACTIVATE => Self::Deactivate,
            T::TRANSITION_CLEANUP => Self::CleanUp,
            T::TRANSITION_UNCONFIGURED_SHUTDOWN
            | T::TRANSITION_INACTIVE_SHUTDOWN
            | T::TRANSITION_ACTIVE_SHUTDOWN => Self::ShutDown,
            _ => return None,
        })
    }
}

/// How a step of the way ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum End {
    Success,
    Failure,
    Error,
}

/// The whole graph: number, label, from, to.
const GRAPH: [(u8, &str, State, State); 25] = {
    use State::*;
    let (success, failure, error) = (
        "transition_success",
        "transition_failure",
        "transition_error",
    );
    [
        (1, "configure", Unconfigured, Configuring),
        (10, success, Configuring, Inactive),
        (11, failure, Configuring, Unconfigured),
        (12, error, Configuring, ErrorProcessing),
        (2, "cleanup", Inactive, CleaningUp),
        (20, success, CleaningUp, Unconfigured),
        (21, failure, CleaningUp, Inactive),
        (22, error, CleaningUp, ErrorProcessing),
        (3, "activate", Inactive, Activating),
        (30, success, Activating, Active),
        (31, failure, Activating, Inactive),
        (32, error, Activating, ErrorProcessing),
        (4, "deactivate", Active, Deactivating),
        (40, success, Deactivating, Inactive),
        (41, failure, Deactivating, Active),
        (42, error, Deactivating, ErrorProcessing),
        (5, "shutdown", Unconfigured, ShuttingDown),
        (6, "shutdown", Inactive, ShuttingDown),
        (7, "shutdown", Active, ShuttingDown),
        (50, success, ShuttingDown, Finalized),
        (51, failure, ShuttingDown, Finalized),
        (52, error, ShuttingDown, ErrorProcessing),
        (60, success, ErrorProcessing, Unconfigured),
        (61, failure, ErrorProcessing, Finalized),
        (62, error, ErrorProcessing, Finalized),
    ]
};

type Edge = (u8, &'static str, State, State);

fn edges_from(state: State) -> impl Iterator<Item = &'static Edge> {
    GRAPH.iter().filter(move |(_, _, from, _)| *from == state)
}

fn describe(edge: &Edge) -> TransitionDescription {
    let (id, label, from, to) = *edge;
    TransitionDescription {
        transition: lifecycle_msgs::Transition {
            id,
            label: label.to_owned(),
        },
        start_state: from.to_msg(),
        goal_state: to.to_msg(),
    }
}

/// The edge that a request stands for: its label wins over its number, as in rclcpp.
fn requested(state: State, wanted: &lifecycle_msgs::Transition) -> Option<Transition> {
    let edge = edges_from(state).find(|(id, label, ..)| match wanted.label.as_str() {
        "" => *id == wanted.id,
        wanted => *label == wanted,
    })?;
    Transition::of_id(edge.0)
}

/// A request, and whom to tell how it went; nobody where the node asks itself.
struct Request {
    transition: Transition,
    answer: Option<oneshot::Sender<bool>>,
}

impl Request {
    fn answer(self, success: bool) {
        if let Some(answer) = self.answer {
            // Whoever asked may have gone.
            let _ = answer.send(success);
        }
    }
}

/// What goes on after a state was left.
enum Next {
    Unconfigured,
    Finalized,
}

/// Carries out the transitions of one node.
pub(crate) struct Lifecycle {
    node: Node,
    state: Arc<AtomicU8>,
    events: Publisher<TransitionEvent>,
    requests: mpsc::Receiver<Request>,
    /// What the node asks of itself.
    autostart: VecDeque<Transition>,
}

impl Lifecycle {
    /// Offers the services. With `autostart` the node goes to work by itself, and a failure on that way ends it.
    pub(crate) fn new(node: &Node, autostart: bool) -> Result<Self, NodeError> {
        let state = Arc::new(AtomicU8::new(State::Unconfigured as u8));
        let present = {
            let state = Arc::clone(&state);
            move || State::of_id(state.load(Relaxed)).unwrap_or(State::ErrorProcessing)
        };
        let (sender, requests) = mpsc::channel(WAITING_REQUESTS);
        let mut server = node.own_service::<ChangeState>("change_state")?;
        let now = present.clone();
        node.spawn(async move {
            loop {
                let (id, request) = server.recv().await;
                let success = match requested(now(), &request.transition) {
                    Some(transition) => {
                        let (answer, answered) = oneshot::channel();
                        let answer = Some(answer);
                        let sent = sender.send(Request { transition, answer }).await;
                        sent.is_ok() && answered.await.unwrap_or(false)
                    }
                    None => {
                        let wanted = &request.transition;
                        info!(
                            "no transition {} {:?} in state {}",
                            wanted.id,
                            wanted.label,
                            now().label()
                        );
                        false
                    }
                };
                server.respond(id, ChangeStateResponse { success });
            }
        });
        let server = node.own_service::<GetState>("get_state")?;
        let now = present.clone();
        node.spawn(server.serve(move |_| GetStateResponse {
            current_state: now().to_msg(),
        }));
        let server = node.own_service::<GetAvailableStates>("get_available_states")?;
        let unknown = lifecycle_msgs::State {
            id: lifecycle_msgs::State::PRIMARY_STATE_UNKNOWN,
            label: "unknown".to_owned(),
        };
        node.spawn(server.serve(move |_| {
            GetAvailableStatesResponse {
                available_states: std::iter::once(unknown.clone())
                    .chain(State::ALL.map(State::to_msg))
                    .collect(),
            }
        }));
        let server = node.own_service::<GetAvailableTransitions>("get_available_transitions")?;
        node.spawn(server.serve(move |_| GetAvailableTransitionsResponse {
            available_transitions: edges_from(present()).map(describe).collect(),
        }));
        let server = node.own_service::<GetAvailableTransitions>("get_transition_graph")?;
        node.spawn(server.serve(|_| GetAvailableTransitionsResponse {
            available_transitions: GRAPH.iter().map(describe).collect(),
        }));
        let lifecycle = Self {
            node: node.clone(),
            state,
            events: node.publisher("~/transition_event", Qos::Event)?,
            requests,
            autostart: match autostart {
                true => VecDeque::from([Transition::Configure, Transition::Activate]),
                false => VecDeque::new(),
            },
        };
        lifecycle.report(Level::Ok, State::Unconfigured.label());
        Ok(lifecycle)
    }

    /// Runs until the node is asked to end, or fails.
    pub(crate) async fn live<P, A, F>(
        mut self,
        configure: impl Fn(Node, P) -> F + Send,
    ) -> anyhow::Result<()>
    where
        P: Parameters,
        A: Active,
        F: Future<Output = anyhow::Result<A>> + Send,
    {
        let parameters = self.node.parameters::<P>();
        loop {
            let Some(request) = self.request().await else {
                self.shut_down();
                return Ok(());
            };
            self.begin(request.transition);
            if request.transition == Transition::ShutDown {
                return self.finalized(request).await;
            }
            self.node.parameter_store().set_configured(true);
            let scope = self.node.scope();
            let present = parameters.borrow().clone();
            let end = self.node.end().clone();
            let configured = tokio::select! {
                configured = configure(scope.clone(), present) => configured,
                () = end.cancelled() => {
                    scope.leave();
                    self.end(End::Failure);
                    self.shut_down();
                    return Ok(());
                }
            };
            match configured {
                Ok(active) => {
                    self.end(End::Success);
                    request.answer(true);
                    match self.configured(&scope, active).await? {
                        Next::Unconfigured => {}
                        Next::Finalized => return Ok(()),
                    }
                }
                Err(failure) => {
                    scope.leave();
                    self.node.parameter_store().set_configured(false);
                    self.end(End::Failure);
                    if request.answer.is_none() {
                        return Err(failure);
                    }
                    error!("not configured: {failure:#}");
                    self.report(Level::Error, format!("not configured: {failure:#}"));
                    request.answer(false);
                }
            }
        }
    }

    /// From inactive, until cleaned up or ended.
    async fn configured<A: Active>(&mut self, scope: &Node, mut active: A) -> anyhow::Result<Next> {
        loop {
            let Some(request) = self.request().await else {
                self.shut_down();
                return Ok(Next::Finalized);
            };
            self.begin(request.transition);
            match request.transition {
                Transition::Activate => {
                    let inner = scope.scope();
                    if let Some(next) = self.active(&inner, &mut active, request).await? {
                        return Ok(next);
                    }
                }
                Transition::ShutDown => {
                    drop(active);
                    scope.leave();
                    self.finalized(request).await?;
                    return Ok(Next::Finalized);
                }
                _ => {
                    drop(active);
                    scope.leave();
                    self.node.parameter_store().set_configured(false);
                    self.end(End::Success);
                    request.answer(true);
                    return Ok(Next::Unconfigured);
                }
            }
        }
    }

    /// From activating, until inactive again (nothing) or ended.
    async fn active<A: Active>(
        &mut self,
        scope: &Node,
        active: &mut A,
        request: Request,
    ) -> anyhow::Result<Option<Next>> {
        let mut work = Box::pin(active.run(scope));
        // What it sets up before it first waits is part of the activation.
        if let std::task::Poll::Ready(result) = futures::poll!(work.as_mut()) {
            drop(work);
            scope.leave();
            let Err(failure) = result else {
                self.end(End::Failure);
                self.shut_down();
                return Ok(Some(Next::Finalized));
            };
            self.end(End::Failure);
            if request.answer.is_none() {
                return Err(failure);
            }
            error!("not activated: {failure:#}");
            self.report(Level::Error, format!("not activated: {failure:#}"));
            request.answer(false);
            return Ok(None);
        }
        self.end(End::Success);
        request.answer(true);
        let request = tokio::select! {
            result = work.as_mut() => {
                scope.leave();
                return match result {
                    Ok(()) => {
                        self.shut_down();
                        Ok(Some(Next::Finalized))
                    }
                    Err(failure) => {
                        self.set(State::ErrorProcessing);
                        self.end(End::Failure);
                        Err(failure)
                    }
                };
            }
            request = self.request() => request,
        };
        if let Some(request) = &request {
            self.begin(request.transition);
        }
        scope.leave();
        let ended = if scope.observes_its_end() {
            timeout(GRACE, work.as_mut())
                .await
                .unwrap_or_else(|_| Err(anyhow::anyhow!("still at work {GRACE:?} after its end")))
        } else {
            Ok(())
        };
        drop(work);
        let Some(request) = request else {
            self.shut_down();
            return ended.map(|()| Some(Next::Finalized));
        };
        if let Err(failure) = ended {
            self.end(End::Error);
            self.end(End::Failure);
            request.answer(false);
            return Err(failure);
        }
        if request.transition == Transition::ShutDown {
            self.finalized(request).await?;
            return Ok(Some(Next::Finalized));
        }
        self.end(End::Success);
        request.answer(true);
        Ok(None)
    }

    /// The next request that fits the present state; `None` when the node is asked to end.
    async fn request(&mut self) -> Option<Request> {
        if let Some(transition) = self.autostart.pop_front() {
            let answer = None;
            return Some(Request { transition, answer });
        }
        let end = self.node.end().clone();
        loop {
            let request = tokio::select! {
                request = self.requests.recv() => request?,
                () = end.cancelled() => return None,
            };
            // The one before it may have changed the state.
            if edges_from(self.state())
                .any(|edge| Transition::of_id(edge.0) == Some(request.transition))
            {
                return Some(request);
            }
            request.answer(false);
        }
    }

    /// Ends a requested shutdown, and goes on answering requests for the state.
    async fn finalized(&mut self, request: Request) -> anyhow::Result<()> {
        self.end(End::Success);
        request.answer(true);
        while let Some(request) = self.request().await {
            request.answer(false);
        }
        Ok(())
    }

    /// The way to the end from wherever the node is.
    fn shut_down(&self) {
        if edges_from(self.state()).any(|(_, label, ..)| *label == Transition::ShutDown.label()) {
            self.begin(Transition::ShutDown);
            self.end(End::Success);
        }
    }

    fn state(&self) -> State {
        State::of_id(self.state.load(Relaxed)).unwrap_or(State::ErrorProcessing)
    }

    fn begin(&self, transition: Transition) {
        let label = transition.label();
        self.go(|edge| edge.1 == label);
    }

    fn end(&self, end: End) {
        // As numbered by lifecycle_msgs: success, failure, error.
        self.go(|edge| edge.0 >= 10 && edge.0 % 10 == end as u8);
    }

    fn go(&self, wanted: impl Fn(&Edge) -> bool) {
        let Some(edge) = edges_from(self.state()).find(|edge| wanted(edge)) else {
            return;
        };
        self.set(edge.3);
        let TransitionDescription {
            transition,
            start_state,
            goal_state,
        } = describe(edge);
        self.events.publish(TransitionEvent {
            timestamp: self.node.clock().now_ns().max(0) as u64,
            transition,
            start_state,
            goal_state,
        });
    }

    fn set(&self, state: State) {
        self.state.store(state as u8, Relaxed);
        self.report(Level::Ok, state.label());
        info!("{}", state.label());
    }

    fn report(&self, level: Level, message: impl Into<String>) {
        self.node.diagnostics().set("lifecycle", level, message, []);
    }
}

/// Leads another node through its lifecycle.
pub struct LifecycleClient {
    change_state: ServiceClient<ChangeState>,
    get_state: ServiceClient<GetState>,
    node: String,
}

/// Why a node did not go where it was led.
#[derive(Debug, thiserror::Error)]
pub enum LifecycleError {
    /// It does not answer.
    #[error(transparent)]
    Call(#[from] CallError),
    /// It says no; its log and `/diagnostics` say why.
    #[error("{node} refuses to {transition}: it is {state}")]
    Refused {
        /// Its full name.
        node: String,
        /// What it was to do.
        transition: &'static str,
        /// Where it is.
        state: String,
    },
}

impl LifecycleClient {
    /// `led`: the other node's full name.
    pub fn new(node: &Node, led: &str) -> Result<Self, NodeError> {
        Ok(Self {
            change_state: node.service_client(&format!("{led}/change_state"))?,
            get_state: node.service_client(&format!("{led}/get_state"))?,
            node: led.to_owned(),
        })
    }

    /// Waits until the node answers.
    pub async fn wait(&self, limit: Duration) -> Result<(), LifecycleError> {
        self.change_state.wait_for_server(limit).await?;
        self.get_state.wait_for_server(limit).await?;
        Ok(())
    }

    /// The node's state; `None` where its number stands for no state.
    pub async fn state(&self) -> Result<Option<State>, LifecycleError> {
        let request = GetStateRequest::default();
        let response = self
            .get_state
            .call(&request, &CallOptions::default())
            .await?;
        Ok(State::of_id(response.current_state.id))
    }

    /// Leads the node from `from` to `to`, which takes at most `limit`; nothing is done where it is there already.
    pub async fn lead(
        &self,
        transition: Transition,
        from: State,
        to: State,
        limit: Duration,
    ) -> Result<(), LifecycleError> {
        let request = ChangeStateRequest {
            transition: lifecycle_msgs::Transition {
                label: transition.label().to_owned(),
                ..Default::default()
            },
        };
        let once = CallOptions {
            attempts: 1,
            timeout: limit,
        };
        let state = self.state().await?;
        if state == Some(from) {
            match self.change_state.call(&request, &once).await {
                Ok(response) if response.success => return Ok(()),
                // The reply may have been lost: its state says.
                Ok(_) | Err(CallError::NoReply { .. }) => {}
                Err(error) => return Err(error.into()),
            }
        }
        let state = self.state().await?;
        if state == Some(to) {
            return Ok(());
        }
        Err(LifecycleError::Refused {
            node: self.node.clone(),
            transition: transition.label(),
            state: state.map_or_else(
                || "in an unknown state".to_owned(),
                |state| state.label().to_owned(),
            ),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wanted(id: u8, label: &str) -> lifecycle_msgs::Transition {
        lifecycle_msgs::Transition {
            id,
            label: label.to_owned(),
        }
    }

    #[test]
    fn only_what_leads_out_of_the_present_state_may_be_asked_for() {
        let asked = |state, id, label| requested(state, &wanted(id, label));
        assert_eq!(
            asked(State::Unconfigured, 1, ""),
            Some(Transition::Configure)
        );
        assert_eq!(asked(State::Active, 7, ""), Some(Transition::ShutDown));
        assert_eq!(
            asked(State::Active, 0, "shutdown"),
            Some(Transition::ShutDown)
        );
        // The label wins.
        assert_eq!(
            asked(State::Inactive, 2, "activate"),
            Some(Transition::Activate)
        );
        assert_eq!(asked(State::Inactive, 1, ""), None);
        assert_eq!(asked(State::Inactive, 7, ""), None);
        assert_eq!(asked(State::Finalized, 5, ""), None);
        // How a step ends is not for others to say.
        assert_eq!(asked(State::Configuring, 10, ""), None);
    }

    #[test]
    fn the_graph_has_no_number_twice_and_every_state_can_be_reached() {
        let mut numbers: Vec<u8> = GRAPH.iter().map(|edge| edge.0).collect();
        numbers.sort_unstable();
        numbers.dedup();
        assert_eq!(numbers.len(), GRAPH.len());
        for state in State::ALL {
            assert!(GRAPH.iter().any(|edge| edge.3 == state), "{state:?}");
        }
    }
}
