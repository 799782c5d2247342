//! Requests that wait until their client can hear the answer.

use std::{
    collections::{BTreeSet, VecDeque},
    time::{Duration, Instant},
};

use ros2_client::Gid;
use rustdds::GUID;

use crate::graph::{Graph, POLL_PERIOD};

/// How long a request waits for its client to be able to hear the answer.
const DISCOVERY_TIMEOUT: Duration = Duration::from_millis(500);
/// Clients that are remembered as able to.
const MAX_CLIENTS: usize = 1024;
/// Requests that wait at a time. One more, and the oldest waits no longer.
const MAX_WAITING: usize = 64;

/// Which reader hears the answers to a client.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Hears {
    /// The client's reader of answers. rmw names that reader itself in its requests, ros2-client its writer of requests.
    Answers,
    /// Any reader of the client's participant: what goes to all clients of an action.
    Feedback,
}

/// A client's request may come before its reader of answers is discovered, and what is sent to nobody is lost: rclpy's first call after
/// `wait_for_service` would have no answer. Such a request waits; those of other clients do not wait for it.
pub(crate) struct Answerable<T> {
    graph: Graph,
    topic: String,
    hears: Hears,
    /// Clients whose reader is discovered.
    known: BTreeSet<Gid>,
    waiting: VecDeque<Waiting<T>>,
}

struct Waiting<T> {
    client: Gid,
    request: T,
    since: Instant,
    /// Since when the client's reader is discovered. Matching follows discovery.
    discovered: Option<Instant>,
}

impl<T> Answerable<T> {
    /// `topic`: of the answers, as DDS names it.
    pub(crate) fn new(graph: Graph, topic: String, hears: Hears) -> Self {
        Self {
            graph,
            topic,
            hears,
            known: BTreeSet::new(),
            waiting: VecDeque::new(),
        }
    }

    /// A request that has come.
    pub(crate) fn push(&mut self, client: Gid, request: T) {
        let now = Instant::now();
        if !self.known.contains(&client) && self.can_hear(client, &self.readers()) {
            self.know(client);
        }
        self.waiting.push_back(Waiting {
            client,
            request,
            since: now,
            discovered: None,
        });
    }

    /// The oldest request whose client can hear the answer, or that has waited long enough.
    pub(crate) fn pop(&mut self) -> Option<T> {
        let now = Instant::now();
        self.discover(now);
        let waited = |request: &Waiting<T>| {
            self.known.contains(&request.client)
                || request
                    .discovered
                    .is_some_and(|at| now.duration_since(at) >= POLL_PERIOD)
                || now.duration_since(request.since) >= DISCOVERY_TIMEOUT
        };
        let ready = self.waiting.iter().position(waited);
        let index = ready.or_else(|| (self.waiting.len() > MAX_WAITING).then_some(0))?;
        let request = self.waiting.remove(index)?;
        if request.discovered.is_some() {
            self.know(request.client);
        }
        Some(request.request)
    }

    /// Waits until it is worth to [`Self::pop`] again; for ever where nothing waits.
    pub(crate) async fn changed(&self) {
        match self.waiting.is_empty() {
            true => std::future::pending().await,
            false => tokio::time::sleep(POLL_PERIOD).await,
        }
    }

    fn know(&mut self, client: Gid) {
        if self.known.len() == MAX_CLIENTS {
            self.known.clear();
        }
        self.known.insert(client);
    }

    /// Marks the requests whose clients' readers have been discovered.
    fn discover(&mut self, now: Instant) {
        let new = |request: &Waiting<T>| {
            request.discovered.is_none() && !self.known.contains(&request.client)
        };
        if !self.waiting.iter().any(new) {
            return;
        }
        let readers = self.readers();
        for index in 0..self.waiting.len() {
            let client = self.waiting[index].client;
            if self.waiting[index].discovered.is_none() && self.can_hear(client, &readers) {
                self.waiting[index].discovered = Some(now);
            }
        }
    }

    fn readers(&self) -> Vec<GUID> {
        self.graph.reader_ids(&self.topic)
    }

    fn can_hear(&self, client: Gid, readers: &[GUID]) -> bool {
        let client = GUID::from(client);
        let one = matches!(self.hears, Hears::Answers) && client.entity_id.entity_kind.is_reader();
        self.graph.is_own(client)
            || readers.iter().any(|reader| match one {
                true => *reader == client,
                false => reader.prefix == client.prefix,
            })
    }
}
