//! Services, with retries on the client's side: the first reply may be lost while the two ends are
//! still discovering each other, so servers must be idempotent.

use std::{sync::Arc, time::Duration};

use ros2_client::{Message, ReadError, RmwRequestId, service::CallServiceError};
use tokio::{sync::Mutex, time::timeout};
use tracing::debug;

use msgs::Service;

use crate::{
    answerable::{Answerable, Hears},
    graph::Graph,
    statistics::Statistics,
};

/// How often and how long a call is tried.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CallOptions {
    /// Number of times that the request is sent.
    pub attempts: u32,
    /// Wait for the reply of one attempt.
    pub timeout: Duration,
}

impl Default for CallOptions {
    fn default() -> Self {
        Self {
            attempts: 5,
            timeout: Duration::from_secs(1),
        }
    }
}

/// Why a call brought no answer.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CallError {
    /// No server was discovered.
    #[error("{name}: no server within {waited:?}")]
    Unavailable {
        /// Service or action.
        name: String,
        /// How long.
        waited: Duration,
    },
    /// The server did not answer.
    #[error("{name}: no reply to {attempts} requests, {timeout:?} each")]
    NoReply {
        /// Service or action.
        name: String,
        /// Requests sent.
        attempts: u32,
        /// Wait for each.
        timeout: Duration,
    },
    /// The middleware refused the request, or the reply could not be read.
    #[error("{name}: {reason}")]
    Middleware {
        /// Service or action.
        name: String,
        /// The reason.
        reason: String,
    },
    /// The action server does not want this goal.
    #[error("{name}: goal rejected")]
    Rejected {
        /// Action.
        name: String,
    },
}

impl CallError {
    /// `Ok` where a server was discovered in time.
    pub(crate) fn unless_discovered(
        discovered: bool,
        name: &str,
        waited: Duration,
    ) -> Result<(), Self> {
        discovered.then_some(()).ok_or_else(|| Self::Unavailable {
            name: name.to_owned(),
            waited,
        })
    }
}

/// Sends a request once and waits for its reply. What cannot be read is skipped: anybody may have sent it, also before the request.
pub(crate) async fn ask<Q: Message + 'static, R: Message + 'static>(
    client: &ros2_client::Client<Q, R>,
    name: &str,
    request: Q,
) -> Result<R, CallServiceError<()>> {
    let id = client.async_send_request(request).await?;
    loop {
        match client.async_receive_response(id).await {
            Ok(reply) => return Ok(reply),
            Err(error) => skipped(name, &error).await,
        }
    }
}

/// Says that something was no reply.
async fn skipped(name: &str, error: &ReadError) {
    debug!("{name}: not a reply: {error}");
    // It must not keep the limit of the call from passing.
    tokio::task::yield_now().await;
}

/// Tries a call several times; each attempt has its own request id, and an answer to any earlier
/// one is ignored. One that meets something that cannot be read is made again within its time.
pub(crate) async fn attempt<T, F>(
    name: &str,
    options: &CallOptions,
    mut call: impl FnMut() -> F,
) -> Result<T, CallError>
where
    F: Future<Output = Result<T, CallServiceError<()>>>,
{
    let mut last = None;
    for number in 1..=options.attempts {
        let attempt = async {
            loop {
                match call().await {
                    Err(CallServiceError::ReadError(error)) => skipped(name, &error).await,
                    answer => return answer,
                }
            }
        };
        match timeout(options.timeout, attempt).await {
            Ok(Ok(reply)) => return Ok(reply),
            Ok(Err(error)) => last = Some(error.to_string()),
            Err(_) => debug!("{name}: no reply to request {number}"),
        }
    }
    Err(match last {
        Some(reason) => CallError::Middleware {
            name: name.to_owned(),
            reason,
        },
        None => CallError::NoReply {
            name: name.to_owned(),
            attempts: options.attempts,
            timeout: options.timeout,
        },
    })
}

/// Calls a service. One call at a time; others wait.
pub struct ServiceClient<S: Service> {
    client: Mutex<ros2_client::Client<S::Request, S::Response>>,
    graph: Graph,
    name: String,
}

impl<S: Service> ServiceClient<S> {
    pub(crate) fn new(
        client: ros2_client::Client<S::Request, S::Response>,
        graph: Graph,
        name: String,
    ) -> Self {
        Self {
            client: Mutex::new(client),
            graph,
            name,
        }
    }

    /// Waits until a server is discovered.
    pub async fn wait_for_server(&self, limit: Duration) -> Result<(), CallError> {
        let discovered = self.graph.wait_for_service(&self.name, limit).await;
        CallError::unless_discovered(discovered, &self.name, limit)
    }

    /// Sends the request, again if no reply comes.
    pub async fn call(
        &self,
        request: &S::Request,
        options: &CallOptions,
    ) -> Result<S::Response, CallError> {
        let client = self.client.lock().await;
        attempt(&self.name, options, || {
            ask(&client, &self.name, request.clone())
        })
        .await
    }

    /// Absolute name of the service.
    pub fn name(&self) -> &str {
        &self.name
    }
}

/// Answers a service.
pub struct ServiceServer<S: Service> {
    server: ros2_client::Server<S::Request, S::Response>,
    statistics: Arc<Statistics>,
    requests: Answerable<(RequestId, S::Request)>,
}

/// Which request a response answers.
#[derive(Clone, Copy, Debug)]
pub struct RequestId(RmwRequestId);

impl<S: Service> ServiceServer<S> {
    pub(crate) fn new(
        server: ros2_client::Server<S::Request, S::Response>,
        statistics: Arc<Statistics>,
        graph: Graph,
    ) -> Self {
        let answers = format!("rr{}Reply", statistics.name);
        Self {
            server,
            statistics,
            requests: Answerable::new(graph, answers, Hears::Answers),
        }
    }

    /// The next request. Requests that cannot be decoded are counted, warned about and skipped. Can be cancelled
    /// without losing a request.
    pub async fn recv(&mut self) -> (RequestId, S::Request) {
        loop {
            if let Some(request) = self.requests.pop() {
                return request;
            }
            let received = tokio::select! {
                received = self.server.async_receive_request() => received,
                () = self.requests.changed() => continue,
            };
            match received {
                Ok((id, request)) => {
                    self.statistics.count_message();
                    self.requests.push(id.writer_gid, (RequestId(id), request));
                }
                Err(error) => {
                    self.statistics.reject(error);
                    tokio::time::sleep(Duration::from_millis(1)).await;
                }
            }
        }
    }

    /// Answers a request.
    pub fn respond(&self, id: RequestId, response: S::Response) {
        if let Err(error) = self.server.send_response(id.0, response) {
            self.statistics
                .reject(format_args!("response not sent: {error}"));
        }
    }

    /// Answers all requests, one after the other, for ever. Requests may come twice: `answer` must
    /// be idempotent.
    pub async fn serve(mut self, mut answer: impl FnMut(S::Request) -> S::Response) {
        loop {
            let (id, request) = self.recv().await;
            self.respond(id, answer(request));
        }
    }

    /// The counters of this service.
    pub fn statistics(&self) -> &Arc<Statistics> {
        &self.statistics
    }
}
