//! The state of the run, and what the operator decides.

use axum::extract::{Json, State};
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use step_protocol::{ProposalId, Recovery};

use super::Shared;
use super::access::{Answer, Body, By, Failure};
use crate::run::{Decision, Pose};

pub(super) async fn state(State(shared): State<Shared>) -> Result<Response, Failure> {
    let snapshot = shared
        .page
        .console
        .snapshot(shared.page.trainings.state())
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

pub(super) async fn decide(by: By, Body(asked): Body<Decide>) -> Answer {
    let id: u64 = asked.proposal_id.parse().map_err(|_| {
        Failure::new(
            StatusCode::UNPROCESSABLE_ENTITY,
            "proposal_id: expected a number of 64 bits as a string.",
            "Take the id of the proposal from the state.",
        )
    })?;
    by.change(StatusCode::NO_CONTENT, |state, now| {
        state.decide(by.viewer, ProposalId(id), asked.decision, now)
    })
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
    by: By,
    Body(Correct { pick, place }): Body<Correct>,
) -> Result<Json<Corrected>, Failure> {
    let correct = |state: &mut crate::state::State, _| state.correct(by.viewer, pick, place);
    let id = by.shared.page.console.change(correct)?;
    Ok(Json(Corrected {
        proposal_id: id.to_string(),
    }))
}

pub(super) async fn home(by: By) -> Answer {
    by.change(StatusCode::ACCEPTED, |state, _| {
        state.recover(by.viewer, Recovery::Home)
    })
}

pub(super) async fn put_down(by: By) -> Answer {
    by.change(StatusCode::ACCEPTED, |state, _| {
        state.recover(by.viewer, Recovery::PutDown)
    })
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SetStep {
    step: u32,
}

pub(super) async fn set_step(by: By, Body(SetStep { step }): Body<SetStep>) -> Answer {
    by.change(StatusCode::ACCEPTED, |state, _| {
        state.set_step(by.viewer, step)
    })
}
