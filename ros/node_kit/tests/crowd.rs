//! Nodes that start all at once, with many endpoints each: RustDDS as published locks up within some
//! rounds of this (third_party/README.md).

use std::{
    collections::BTreeSet,
    time::{Duration, Instant},
};

use msgs::sctn_msgs::StepConfirmation;
use node_kit::{Context, Network, NoParameters, Node, Publisher, Qos, RosArguments, Subscription};

const NODES: usize = 8;
const TOPICS: usize = 24;
const ROUNDS: usize = 12;
const PATIENCE: Duration = Duration::from_secs(120);

/// A node that speaks and listens on all topics.
struct Member {
    _node: Node,
    publishers: Vec<Publisher<StepConfirmation>>,
    subscriptions: Vec<Subscription<StepConfirmation>>,
}

impl Member {
    fn join(context: &Context, round: usize, number: usize) -> Self {
        let (node, _) = context
            .node::<NoParameters>(
                &format!("member_{round}_{number}"),
                &RosArguments::default(),
            )
            .unwrap();
        let topics = (0..TOPICS).map(|topic| format!("crowd_{round}_{topic}"));
        let (publishers, subscriptions) = topics
            .map(|topic| {
                (
                    node.publisher(&topic, Qos::Latched).unwrap(),
                    node.subscription(&topic, Qos::Latched).unwrap(),
                )
            })
            .unzip();
        Self {
            _node: node,
            publishers,
            subscriptions,
        }
    }

    /// Says its number on all topics and waits for those of all others.
    async fn meet(mut self, number: usize) -> Self {
        for publisher in &self.publishers {
            publisher.publish(StepConfirmation {
                proposal_id: number as u64,
                ..Default::default()
            });
        }
        for subscription in &mut self.subscriptions {
            let mut heard = BTreeSet::new();
            while heard.len() < NODES - 1 {
                let message = subscription.recv().await;
                if message.proposal_id != number as u64 {
                    heard.insert(message.proposal_id);
                }
            }
        }
        self
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn nodes_that_start_at_once_all_hear_each_other() {
    for round in 0..ROUNDS {
        let start = Instant::now();
        let network = Network::unused().unwrap();
        let members = (0..NODES).map(|number| {
            tokio::task::spawn_blocking(move || {
                let context = Context::new(network);
                let member = Member::join(&context, round, number);
                (context, member)
            })
        });
        let members: Vec<_> = members.collect();
        let mut meetings = Vec::new();
        for (number, member) in members.into_iter().enumerate() {
            let (context, member) = tokio::time::timeout(PATIENCE, member)
                .await
                .expect("a node does not come up")
                .unwrap();
            meetings.push((number, context, tokio::spawn(member.meet(number))));
        }
        let mut contexts = Vec::new();
        for (number, context, meeting) in meetings {
            let met = tokio::time::timeout(PATIENCE, meeting).await;
            assert!(met.is_ok(), "round {round}: node {number} misses somebody");
            contexts.push((context, met));
        }
        println!("round {round}: {:?}", start.elapsed());
        for (context, _) in &contexts {
            context.shutdown();
        }
    }
}
