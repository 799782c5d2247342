//! Authentication, and the responses to requests that fail.

use std::fs::OpenOptions;
use std::io::Write as _;
use std::net::SocketAddr;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::Path;
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

/// Shortest token that is accepted.
const SHORTEST_TOKEN: usize = 16;

/// Header with a viewer's key.
const SESSION: HeaderName = HeaderName::from_static("x-session");

/// A token that can be guessed, or cannot stand in an address.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("expected at least {SHORTEST_TOKEN} letters, digits, or characters of -_.~ (or nothing)")]
pub struct InvalidToken;

/// Who may ask.
#[derive(Clone, Debug)]
pub struct Access {
    token: String,
    address: SocketAddr,
    scheme: &'static str,
    /// `Host` headers by which this server is meant.
    hosts: Vec<String>,
}

impl Access {
    /// Checks a token that a person has chosen; an empty one stands for a drawn one.
    ///
    /// # Errors
    /// When it can be guessed, or cannot stand in an address.
    pub fn check(token: &str) -> Result<(), InvalidToken> {
        let good =
            |character: char| character.is_ascii_alphanumeric() || "-_.~".contains(character);
        let is_long = token.len() >= SHORTEST_TOKEN;
        match token.is_empty() || (is_long && token.chars().all(good)) {
            true => Ok(()),
            false => Err(InvalidToken),
        }
    }

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
            address,
            scheme,
            hosts,
        }
    }

    /// Where it listens.
    #[cfg(test)]
    pub(super) fn socket(&self) -> SocketAddr {
        self.address
    }

    /// Where the page is served, without the token: for logs.
    pub fn address(&self) -> String {
        format!("{}://{}/", self.scheme, self.address)
    }

    /// The page's address with the token: who opens it may decide.
    pub fn page(&self) -> String {
        format!("{}#token={}", self.address(), self.token)
    }

    /// Writes the page's address with the token to a file: whole or not at all, for the owner alone.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write_page(&self, path: &Path) -> std::io::Result<()> {
        let mut partial = path.as_os_str().to_owned();
        partial.push(".partial");
        let mut options = OpenOptions::new();
        options.write(true).create(true).truncate(true).mode(0o600);
        let mut file = options.open(&partial)?;
        writeln!(file, "{}", self.page())?;
        std::fs::rename(&partial, path)
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

/// The response to a request that failed: HTTP status, and a message for a person.
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

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    #[test]
    fn the_address_with_the_token_is_written_for_the_owner_alone() {
        let folder = tempfile::tempdir().unwrap();
        let address = "127.0.0.1:8750".parse().unwrap();
        let access = Access::new("0123456789abcdef".into(), address, &[], true);
        let path = folder.path().join("address");
        access.write_page(&path).unwrap();
        let page = "https://127.0.0.1:8750/#token=0123456789abcdef";
        assert_eq!(std::fs::read_to_string(&path).unwrap(), format!("{page}\n"));
        let mode = path.metadata().unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
        assert!(!access.address().contains("0123"));
        access
            .write_page(&folder.path().join("no/such/folder"))
            .unwrap_err();
    }

    #[test]
    fn a_token_that_can_be_guessed_or_cannot_stand_in_an_address_is_refused() {
        for token in ["secret", "sixteen characters", "sixteen#characters"] {
            assert_eq!(Access::check(token), Err(InvalidToken), "{token}");
        }
        for token in ["", "0123456789-_.~ab"] {
            assert_eq!(Access::check(token), Ok(()), "{token}");
        }
    }
}
