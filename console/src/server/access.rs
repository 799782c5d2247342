//! Who may ask, and what an answer is that is none.

use std::net::SocketAddr;
use std::time::Duration;

use axum::extract::rejection::JsonRejection;
use axum::extract::{self, FromRequest, FromRequestParts, Json, Request};
use axum::http::header::{
    AUTHORIZATION, CACHE_CONTROL, CONTENT_SECURITY_POLICY, HOST, ORIGIN, REFERRER_POLICY,
    X_CONTENT_TYPE_OPTIONS,
};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use serde::de::DeserializeOwned;
use subtle::ConstantTimeEq as _;

use super::Shared;
use crate::refusal::Refusal;
use crate::session::ViewerId;
use crate::state::State;

/// Header with a viewer's key.
const SESSION: HeaderName = HeaderName::from_static("x-session");

/// Who may ask.
#[derive(Clone, Debug)]
pub struct Access {
    token: String,
    scheme: &'static str,
    /// `Host` headers by which this server is meant.
    hosts: Vec<String>,
}

impl Access {
    /// For a server on `address`, reached as its IP address, as localhost where it is a loopback one, and by `names`.
    pub fn new(token: String, address: SocketAddr, names: &[String], tls: bool) -> Self {
        let port = address.port();
        let mut hosts = vec![address.to_string()];
        if address.ip().is_loopback() || address.ip().is_unspecified() {
            hosts.extend(["localhost", "127.0.0.1", "[::1]"].map(|name| format!("{name}:{port}")));
        }
        let names = names.iter().filter(|name| !name.is_empty());
        hosts.extend(names.map(|name| format!("{name}:{port}")));
        let (scheme, default) = if tls { ("https", 443) } else { ("http", 80) };
        if port == default {
            let short: Vec<_> = hosts
                .iter()
                .filter_map(|host| host.rsplit_once(':').map(|(name, _)| name.to_owned()))
                .collect();
            hosts.extend(short);
        }
        Self {
            token,
            scheme,
            hosts,
        }
    }

    fn knows_host(&self, host: &str) -> bool {
        self.hosts
            .iter()
            .any(|known| known.eq_ignore_ascii_case(host))
    }

    /// A page of another origin must not use the token of somebody who looks at it, nor a name that leads here.
    fn check_origin(&self, headers: &HeaderMap) -> Result<(), Failure> {
        let text = |name| headers.get(name).map(|value| value.to_str().unwrap_or(""));
        let host = text(HOST).unwrap_or("");
        if !self.knows_host(host) {
            return Err(Failure::new(
                StatusCode::MISDIRECTED_REQUEST,
                "This console is not reached under that name.",
                "Use the address that was printed, or add the name to the parameter host_names.",
            ));
        }
        let Some(origin) = text(ORIGIN) else {
            return Ok(());
        };
        let ours = origin
            .strip_prefix(self.scheme)
            .and_then(|rest| rest.strip_prefix("://"));
        if ours.is_some_and(|host| self.knows_host(host)) {
            return Ok(());
        }
        Err(Failure::new(
            StatusCode::FORBIDDEN,
            "The request comes from another site's page.",
            "Use the console's own page, or a program that sends no Origin.",
        ))
    }

    pub(super) fn knows_token(&self, token: &str) -> bool {
        self.token.as_bytes().ct_eq(token.as_bytes()).into()
    }

    fn check_token(&self, headers: &HeaderMap) -> Result<(), Failure> {
        let given = headers
            .get(AUTHORIZATION)
            .and_then(|value| value.to_str().ok());
        match given.and_then(|value| value.strip_prefix("Bearer ")) {
            Some(token) if self.knows_token(token) => Ok(()),
            _ => Err(Failure::new(
                StatusCode::UNAUTHORIZED,
                "The token is missing or wrong.",
                "Open the address that was printed when the console was started: it contains the token.",
            )),
        }
    }
}

/// An answer that is none: status, and words for a person.
#[derive(Debug)]
pub(super) struct Failure {
    status: StatusCode,
    refusal: Refusal,
}

impl Failure {
    pub(super) fn new(status: StatusCode, reason: impl Into<String>, advice: &str) -> Self {
        Self {
            status,
            refusal: Refusal::new(reason, advice),
        }
    }
}

impl From<Refusal> for Failure {
    fn from(refusal: Refusal) -> Self {
        Self {
            status: StatusCode::CONFLICT,
            refusal,
        }
    }
}

impl From<JsonRejection> for Failure {
    fn from(rejection: JsonRejection) -> Self {
        Self::new(
            rejection.status(),
            rejection.body_text(),
            "docs/operator_console.openapi.yaml says what is expected.",
        )
    }
}

impl IntoResponse for Failure {
    fn into_response(self) -> Response {
        (self.status, Json(self.refusal)).into_response()
    }
}

/// Every request: the right host and origin; every answer: what a browser may do with it.
pub(super) async fn guard(
    extract::State(shared): extract::State<Shared>,
    request: Request,
    next: Next,
) -> Response {
    let mut response = match shared.access.check_origin(request.headers()) {
        Ok(()) => next.run(request).await,
        Err(failure) => failure.into_response(),
    };
    let headers = response.headers_mut();
    for (name, value) in [
        (
            CONTENT_SECURITY_POLICY,
            "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; \
             base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
        ),
        (X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (REFERRER_POLICY, "no-referrer"),
        (CACHE_CONTROL, "no-store"),
        (
            HeaderName::from_static("cross-origin-opener-policy"),
            "same-origin",
        ),
        (
            HeaderName::from_static("cross-origin-resource-policy"),
            "same-origin",
        ),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}

pub(super) async fn require_token(
    extract::State(shared): extract::State<Shared>,
    request: Request,
    next: Next,
) -> Result<Response, Failure> {
    shared.access.check_token(request.headers())?;
    Ok(next.run(request).await)
}

pub(super) async fn not_found() -> Failure {
    Failure::new(
        StatusCode::NOT_FOUND,
        "There is nothing under this path.",
        "docs/operator_console.openapi.yaml lists what there is.",
    )
}

/// What most requests are answered with: nothing but a status.
pub(super) type Answer = Result<StatusCode, Failure>;

/// The viewer that asks, by its key, and what handlers share.
pub(super) struct By {
    pub(super) viewer: ViewerId,
    pub(super) shared: Shared,
}

impl By {
    /// Changes the state; other viewers are told.
    pub(super) fn change(
        &self,
        done: StatusCode,
        change: impl FnOnce(&mut State, Duration) -> Result<(), Refusal>,
    ) -> Answer {
        self.shared.page.console.change(change)?;
        Ok(done)
    }

    /// Checks that the viewer decides.
    pub(super) fn check_operator(&self) -> Result<(), Refusal> {
        let check = |state: &State, _| state.sessions.check_operator(self.viewer);
        self.shared.page.console.read(check)
    }
}

/// The body of a request, as JSON.
pub(super) struct Body<T>(pub(super) T);

impl<T: DeserializeOwned> FromRequest<Shared> for Body<T> {
    type Rejection = Failure;

    async fn from_request(request: Request, shared: &Shared) -> Result<Self, Failure> {
        let Json(body) = Json::from_request(request, shared).await?;
        Ok(Self(body))
    }
}

impl FromRequestParts<Shared> for By {
    type Rejection = Failure;

    async fn from_request_parts(parts: &mut Parts, shared: &Shared) -> Result<Self, Failure> {
        let key = parts
            .headers
            .get(SESSION)
            .and_then(|value| value.to_str().ok());
        let found = shared.page.console.change_quietly(|state, now| {
            let id = state.sessions.find(key?)?;
            state.sessions.heard(id, true, now);
            Some(id)
        });
        let shared = shared.clone();
        let by = |viewer| Self { viewer, shared };
        found.map(by).ok_or_else(|| {
            Failure::new(
                StatusCode::UNAUTHORIZED,
                "Your session is over.",
                "Join again with your name.",
            )
        })
    }
}
