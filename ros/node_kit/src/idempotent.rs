//! Servers that carry each request out once: a reply can be lost, and the caller asks again.

use msgs::Service;
use msgs::sctn_msgs::{CaptureGoal, LoadCheckpoint, LoadDemonstration, ResetCell, SetStep};

use crate::{
    reply_cache::ReplyCache,
    service::{RequestId, ServiceServer},
};

/// A service that changes something: its requests carry a `request_id` of the caller's choice.
pub trait IdempotentService: Service {
    /// The `request_id`.
    fn request_id(request: &Self::Request) -> &str;
}

macro_rules! idempotent {
    ($($service:ty),*) => {$(
        impl IdempotentService for $service {
            fn request_id(request: &Self::Request) -> &str {
                &request.request_id
            }
        }
    )*};
}

idempotent!(
    CaptureGoal,
    LoadCheckpoint,
    LoadDemonstration,
    ResetCell,
    SetStep
);

/// A request that has not been carried out.
#[derive(Debug)]
pub struct NewRequest {
    id: RequestId,
    request_id: String,
}

/// Answers a service. A request that comes again gets the same answer again.
pub struct IdempotentServer<S: IdempotentService> {
    server: ServiceServer<S>,
    replies: ReplyCache<S::Response>,
}

impl<S: IdempotentService> IdempotentServer<S> {
    pub(crate) fn new(server: ServiceServer<S>, replies: &ReplyCache<S::Response>) -> Self {
        Self {
            server,
            replies: replies.clone(),
        }
    }

    /// The next request that is to be carried out. Answers on the way the known ones, and those without a valid `request_id` with a
    /// `refusal` that says so. Can be cancelled without losing a request.
    pub async fn recv(
        &mut self,
        refusal: impl Fn(String) -> S::Response,
    ) -> (NewRequest, S::Request) {
        loop {
            let (id, request) = self.server.recv().await;
            let request_id = S::request_id(&request);
            match self.replies.known(request_id, &refusal) {
                Some(answer) => self.server.respond(id, answer),
                None => {
                    let request_id = request_id.to_owned();
                    return (NewRequest { id, request_id }, request);
                }
            }
        }
    }

    /// Answers a request that was carried out, or never will be.
    pub fn respond(&self, request: NewRequest, answer: S::Response) {
        self.replies.remember(&request.request_id, answer.clone());
        self.server.respond(request.id, answer);
    }

    /// Answers a request that cannot be carried out now: it is looked at anew when it comes again.
    pub fn respond_for_now(&self, request: NewRequest, answer: S::Response) {
        self.server.respond(request.id, answer);
    }
}
