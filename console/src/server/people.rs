//! Who watches and who decides.

use axum::extract::{Json, State};
use axum::http::StatusCode;
use serde::{Deserialize, Serialize};
use tracing::info;

use super::Shared;
use super::access::{Answer, Body, By, Failure};
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
    Body(Join { name }): Body<Join>,
) -> Result<Json<Joined>, Failure> {
    let session = crate::secret();
    let key = session.clone();
    let viewer = shared
        .page
        .console
        .change(|state, now| state.sessions.join(&name, key, now))?;
    info!("viewer {viewer} `{}` has joined", name.trim());
    Ok(Json(Joined { viewer, session }))
}

pub(super) async fn leave(by: By) -> StatusCode {
    by.shared
        .page
        .console
        .change(|state, _| state.sessions.leave(by.viewer));
    StatusCode::NO_CONTENT
}

/// A sign of life of a program without a WebSocket.
pub(super) async fn presence(_: By) -> StatusCode {
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

pub(super) async fn change_operator(by: By, Body(change): Body<ChangeOperator>) -> Answer {
    let operator = by.shared.page.console.change(|state, _| {
        match change {
            ChangeOperator::Take { from } => state.sessions.take(by.viewer, from),
            ChangeOperator::HandOver { to } => state.sessions.hand_over(by.viewer, to),
        }?;
        state.presence_changed();
        let operator = state.sessions.operator();
        Ok::<_, Refusal>(operator.map(|id| state.sessions.name(id).to_owned()))
    })?;
    match operator {
        Some(name) => info!("`{name}` decides now"),
        None => info!("nobody decides now"),
    }
    Ok(StatusCode::NO_CONTENT)
}
