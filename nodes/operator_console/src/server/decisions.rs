//! The state of the run, and what the operator decides.

use axum::extract::rejection::JsonRejection;
use axum::extract::{Json, State};
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

use super::Shared;
use super::access::{Failure, Viewer};
use crate::run::{Decision, Pose};

pub(super) async fn state(State(shared): State<Shared>) -> Result<Response, Failure> {
    let snapshot = shared
        .console
        .snapshot(shared.trainings.state())
        .map_err(|error| {
            Failure::new(
                StatusCode::INTERNAL_SERVER_ERROR,
                format!("The state cannot be written as JSON: {error}."),
                "Look at the node's log.",
            )
        })?;
    Ok(([(CONTENT_TYPE, "application/json")], snapshot).into_response())
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Decide {
    proposal_id: String,
    decision: Decision,
}

pub(super) async fn decide(
    State(shared): State<Shared>,
    Viewer(viewer): Viewer,
    body: Result<Json<Decide>, JsonRejection>,
) -> Result<StatusCode, Failure> {
    let Json(Decide {
        proposal_id,
        decision,
    }) = body?;
    let id: u64 = proposal_id.parse().map_err(|_| {
        Failure::new(
            StatusCode::UNPROCESSABLE_ENTITY,
            "proposal_id: expected a number of 64 bits as a string.",
            "Take the id of the proposal from the state.",
        )
    })?;
    shared
        .console
        .change(|state, now| state.decide(viewer, id, decision, now))?;
    Ok(StatusCode::NO_CONTENT)
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Correct {
    pick: Pose,
    place: Pose,
}

#[derive(Serialize)]
pub(super) struct Corrected {
    proposal_id: String,
}

pub(super) async fn correct(
    State(shared): State<Shared>,
    Viewer(viewer): Viewer,
    body: Result<Json<Correct>, JsonRejection>,
) -> Result<Json<Corrected>, Failure> {
    let Json(Correct { pick, place }) = body?;
    let id = shared
        .console
        .change(|state, _| state.correct(viewer, pick, place))?;
    Ok(Json(Corrected {
        proposal_id: id.to_string(),
    }))
}

pub(super) async fn home(
    State(shared): State<Shared>,
    Viewer(viewer): Viewer,
) -> Result<StatusCode, Failure> {
    shared.console.change(|state, _| state.home(viewer))?;
    Ok(StatusCode::ACCEPTED)
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SetStep {
    step: u32,
}

pub(super) async fn set_step(
    State(shared): State<Shared>,
    Viewer(viewer): Viewer,
    body: Result<Json<SetStep>, JsonRejection>,
) -> Result<StatusCode, Failure> {
    let Json(SetStep { step }) = body?;
    shared
        .console
        .change(|state, _| state.set_step(viewer, step))?;
    Ok(StatusCode::ACCEPTED)
}
