//! Who watches and who decides.

use axum::extract::rejection::JsonRejection;
use axum::extract::{Json, State};
use axum::http::StatusCode;
use serde::{Deserialize, Serialize};
use tracing::info;

use super::Shared;
use super::access::{Failure, Viewer};
use crate::refusal::Refusal;
use crate::session::ViewerId;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Join {
    name: String,
}

#[derive(Serialize)]
pub(super) struct Joined {
    viewer: ViewerId,
    session: String,
}

pub(super) async fn join(
    State(shared): State<Shared>,
    body: Result<Json<Join>, JsonRejection>,
) -> Result<Json<Joined>, Failure> {
    let Json(Join { name }) = body?;
    let session = crate::secret();
    let key = session.clone();
    let viewer = shared
        .console
        .change(|state, now| state.sessions.join(&name, key, now))?;
    info!("viewer {viewer} `{}` has joined", name.trim());
    Ok(Json(Joined { viewer, session }))
}

pub(super) async fn leave(State(shared): State<Shared>, Viewer(viewer): Viewer) -> StatusCode {
    shared
        .console
        .change(|state, _| state.sessions.leave(viewer));
    StatusCode::NO_CONTENT
}

/// A sign of life of a program without a WebSocket.
pub(super) async fn presence(Viewer(_): Viewer) -> StatusCode {
    StatusCode::NO_CONTENT
}

#[derive(Deserialize)]
#[serde(tag = "action", rename_all = "snake_case", deny_unknown_fields)]
pub(super) enum ChangeOperator {
    /// `from`: who decides now, as the one who takes has seen it.
    Take { from: Option<ViewerId> },
    /// `to`: who shall decide; nobody where it is left out.
    HandOver { to: Option<ViewerId> },
}

pub(super) async fn change_operator(
    State(shared): State<Shared>,
    Viewer(viewer): Viewer,
    body: Result<Json<ChangeOperator>, JsonRejection>,
) -> Result<StatusCode, Failure> {
    let Json(change) = body?;
    let operator = shared.console.change(|state, _| {
        match change {
            ChangeOperator::Take { from } => state.sessions.take(viewer, from),
            ChangeOperator::HandOver { to } => state.sessions.hand_over(viewer, to),
        }?;
        let operator = state.sessions.operator();
        Ok::<_, Refusal>(operator.map(|id| state.sessions.name(id).to_owned()))
    })?;
    match operator {
        Some(name) => info!("`{name}` decides now"),
        None => info!("nobody decides now"),
    }
    Ok(StatusCode::NO_CONTENT)
}
