//! Gives back every message of `msgs`, and services: the peer of the tests with rclpy (docs/ros2.md).
//!
//! - Messages: what comes on `echo/PACKAGE/NAME` goes out on `echoed/PACKAGE/NAME`; `latched` to `latched_echoed`.
//! - Services: `served/PACKAGE/NAME` says on `asked/..` what it was asked and answers what came on `reply/..`; what comes on
//!   `ask/..` is asked of `answer/..`, and its answer goes out on `answered/..`. The same for our action, with `feedback/..` and
//!   `result/..`.
//! - `held/sctn_msgs/ExecutePickPlace` takes as many goals at once as come; each lasts as many tenths of a second as the step of
//!   its proposal says, or until it is cancelled.

use std::{
    process::ExitCode,
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

use msgs::{
    Action, CdrError, Interface, Service, Visitor, from_cdr,
    rcl_interfaces::{GetParameters, SetParameters},
    sctn_msgs::{
        CaptureGoal, ExecutePickPlace, ExecutePickPlaceFeedback, ExecutePickPlaceResult,
        LoadCheckpoint, LoadDemonstration, ProposeHome, ResetCell, Reward, SetStep,
    },
    to_cdr,
};
use node_kit::{
    Active, CallOptions, NoParameters, Node, NodeError, Qos, RawPublisher, RawQos, RawSubscription,
};
use tracing::warn;

const RELIABLE: RawQos = RawQos {
    reliable: true,
    transient_local: false,
    depth: 64,
};

fn main() -> ExitCode {
    node_kit::main::<NoParameters>("interface_echo", |context, arguments| {
        context.start("interface_echo", arguments, configure)
    })
}

async fn configure(_: Node, _: NoParameters) -> anyhow::Result<Echo> {
    Ok(Echo)
}

struct Echo;

impl Active for Echo {
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
        let mut messages = Messages(Vec::new());
        msgs::visit_all(&mut messages);
        for (type_name, again) in messages.0 {
            echo(node, type_name, again)?;
        }
        service::<GetParameters>(node)?;
        service::<SetParameters>(node)?;
        service::<CaptureGoal>(node)?;
        service::<LoadCheckpoint>(node)?;
        service::<LoadDemonstration>(node)?;
        service::<ProposeHome>(node)?;
        service::<ResetCell>(node)?;
        service::<SetStep>(node)?;
        carry_out::<ExecutePickPlace>(node)?;
        send::<ExecutePickPlace>(node)?;
        hold(node)?;
        echo_latched(node)?;
        node.deactivated().await;
        Ok(())
    }
}

/// Reads a message and writes it again.
type Again = fn(&[u8]) -> Result<Vec<u8>, CdrError>;

/// All messages: their type names, and how to read and write them.
struct Messages(Vec<(&'static str, Again)>);

impl Visitor for Messages {
    fn visit<T: Interface>(&mut self) {
        if T::TYPE_NAME.contains("/msg/") {
            let again: Again = |cdr| to_cdr(&from_cdr::<T>(cdr)?);
            self.0.push((T::TYPE_NAME, again));
        }
    }
}

fn echo(node: &Node, type_name: &str, again: Again) -> Result<(), NodeError> {
    let name = type_name.replace("/msg/", "/");
    let mut subscription = node.raw_subscription(&format!("echo/{name}"), type_name, RELIABLE)?;
    let publisher = node.raw_publisher(&format!("echoed/{name}"), type_name, RELIABLE)?;
    node.spawn(async move {
        loop {
            match again(&subscription.recv().await.data) {
                Ok(cdr) => {
                    publisher.publish(cdr);
                }
                Err(error) => warn!("{}: {error}", subscription.topic()),
            }
        }
    });
    Ok(())
}

fn echo_latched(node: &Node) -> Result<(), NodeError> {
    let mut subscription = node.subscription::<Reward>("latched", Qos::Latched)?;
    let publisher = node.publisher::<Reward>("latched_echoed", Qos::Latched)?;
    node.spawn(async move {
        loop {
            publisher.publish(subscription.recv().await);
        }
    });
    Ok(())
}

fn service<S: Service + 'static>(node: &Node) -> Result<(), NodeError> {
    serve::<S>(node)?;
    call::<S>(node)
}

/// The part of a service or action that came last on a topic.
struct Given<T>(Arc<Mutex<T>>);

impl<T: Interface> Given<T> {
    fn on(node: &Node, topic: &str) -> Result<Self, NodeError> {
        let newest = Arc::new(Mutex::new(T::default()));
        let mut parts = Parts::<T>::on(node, topic)?;
        let shared = Arc::clone(&newest);
        node.spawn(async move {
            loop {
                let given = parts.recv().await;
                *shared.lock().unwrap_or_else(PoisonError::into_inner) = given;
            }
        });
        Ok(Self(newest))
    }

    fn newest(&self) -> T {
        self.0
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone()
    }
}

/// Parts of services and actions as messages.
struct Parts<T> {
    subscription: RawSubscription,
    part: std::marker::PhantomData<T>,
}

impl<T: Interface> Parts<T> {
    fn on(node: &Node, topic: &str) -> Result<Self, NodeError> {
        Ok(Self {
            subscription: node.raw_subscription(topic, T::TYPE_NAME, RELIABLE)?,
            part: std::marker::PhantomData,
        })
    }

    async fn recv(&mut self) -> T {
        loop {
            match from_cdr(&self.subscription.recv().await.data) {
                Ok(part) => return part,
                Err(error) => warn!("{}: {error}", self.subscription.topic()),
            }
        }
    }
}

fn say<T: Interface>(publisher: &RawPublisher, part: &T) {
    match to_cdr(part) {
        Ok(cdr) => {
            publisher.publish(cdr);
        }
        Err(error) => warn!("{}: {error}", publisher.topic()),
    }
}

fn publisher<T: Interface>(node: &Node, topic: &str) -> Result<RawPublisher, NodeError> {
    node.raw_publisher(topic, T::TYPE_NAME, RELIABLE)
}

fn serve<S: Service + 'static>(node: &Node) -> Result<(), NodeError> {
    let name = format!("{}/{}", S::PACKAGE, S::NAME);
    let server = node.service_server::<S>(&format!("served/{name}"))?;
    let asked = publisher::<S::Request>(node, &format!("asked/{name}"))?;
    let reply = Given::<S::Response>::on(node, &format!("reply/{name}"))?;
    node.spawn(server.serve(move |request| {
        say(&asked, &request);
        reply.newest()
    }));
    Ok(())
}

fn call<S: Service + 'static>(node: &Node) -> Result<(), NodeError> {
    let name = format!("{}/{}", S::PACKAGE, S::NAME);
    let mut asks = Parts::<S::Request>::on(node, &format!("ask/{name}"))?;
    let client = node.service_client::<S>(&format!("answer/{name}"))?;
    let answered = publisher::<S::Response>(node, &format!("answered/{name}"))?;
    node.spawn(async move {
        loop {
            let request = asks.recv().await;
            match client.call(&request, &CallOptions::default()).await {
                Ok(response) => say(&answered, &response),
                Err(error) => warn!("{error}"),
            }
        }
    });
    Ok(())
}

/// An action: `served/..` says on `asked/..` what its goal is, on its feedback what came on `feedback/..`, and
/// succeeds with what came on `result/..`.
fn carry_out<A: Action + 'static>(node: &Node) -> Result<(), NodeError> {
    let name = format!("{}/{}", A::PACKAGE, A::NAME);
    let mut server = node.action_server::<A>(&format!("served/{name}"))?;
    let asked = publisher::<A::Goal>(node, &format!("asked/{name}"))?;
    let feedback = Given::<A::Feedback>::on(node, &format!("feedback/{name}"))?;
    let result = Given::<A::Result>::on(node, &format!("result/{name}"))?;
    node.spawn(async move {
        loop {
            let goal = server.recv().await;
            say(&asked, &goal.goal);
            let (_, running) = goal.accept();
            running.feedback(feedback.newest());
            running.succeed(result.newest());
        }
    });
    Ok(())
}

/// Goals side by side, each as long as it says.
fn hold(node: &Node) -> Result<(), NodeError> {
    let mut server = node.action_server::<ExecutePickPlace>("held/sctn_msgs/ExecutePickPlace")?;
    let keeper = node.clone();
    node.spawn(async move {
        loop {
            let (goal, running) = server.recv().await.accept();
            let id = goal.proposal.id;
            keeper.spawn(async move {
                running.feedback(ExecutePickPlaceFeedback {
                    proposal_id: id,
                    ..Default::default()
                });
                let mut result = ExecutePickPlaceResult::default();
                result.result.proposal_id = id;
                let lasting = Duration::from_millis(100) * goal.proposal.step;
                tokio::select! {
                    () = tokio::time::sleep(lasting) => running.succeed(result),
                    () = running.cancel_requested() => running.cancelled(result),
                }
            });
        }
    });
    Ok(())
}

/// What comes on `ask/..` is sent as a goal to `answer/..`, and its result said on `answered/..`.
fn send<A: Action + 'static>(node: &Node) -> Result<(), NodeError> {
    let name = format!("{}/{}", A::PACKAGE, A::NAME);
    let mut asks = Parts::<A::Goal>::on(node, &format!("ask/{name}"))?;
    let client = node.action_client::<A>(&format!("answer/{name}"))?;
    let answered = publisher::<A::Result>(node, &format!("answered/{name}"))?;
    node.spawn(async move {
        loop {
            let goal = asks.recv().await;
            let end = match client.send_goal(&goal, &CallOptions::default()).await {
                Ok(sent) => sent.result().await,
                Err(error) => Err(error),
            };
            match end {
                Ok((_, result)) => say(&answered, &result),
                Err(error) => warn!("{error}"),
            }
        }
    });
    Ok(())
}
