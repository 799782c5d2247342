//! The policy's checkpoints, and training.

use std::collections::BTreeSet;
use std::sync::Arc;

use axum::extract::{Json, State};
use axum::http::StatusCode;
use serde::Deserialize;

use super::access::{Answer, Body, By, Failure};
use super::{Named, Shared, off_thread, on_files};
use crate::checkpoints::Checkpoint;
use crate::lesson::check_name;
use crate::refusal::Refusal;
use crate::training::{Example, Order};

/// Most gradient steps of a training.
const MOST_TRAINING_STEPS: u64 = 100_000;

/// The checkpoints that the policy can be given.
pub(super) async fn list_checkpoints(
    State(shared): State<Shared>,
) -> Result<Json<Vec<Checkpoint>>, Failure> {
    let checkpoints = Arc::clone(&shared.page.checkpoints);
    Ok(Json(off_thread(move || checkpoints.list()).await?))
}

pub(super) async fn use_checkpoint(by: By, Body(Named { name }): Body<Named>) -> Answer {
    let checkpoints = Arc::clone(&by.shared.page.checkpoints);
    let path = off_thread(move || checkpoints.path(&name)).await??;
    by.change(StatusCode::ACCEPTED, |state, _| {
        state.use_checkpoint(by.viewer, path)
    })
}

pub(super) async fn use_previous_checkpoint(by: By) -> Answer {
    by.change(StatusCode::ACCEPTED, |state, _| {
        state.use_previous_checkpoint(by.viewer)
    })
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct StartTraining {
    name: String,
    /// Demonstrations and corrections to learn from, and those that are held out.
    learn: Vec<String>,
    held_out: Vec<String>,
    steps: u64,
}

pub(super) async fn start_training(by: By, Body(asked): Body<StartTraining>) -> Answer {
    by.check_operator()?;
    let StartTraining {
        name,
        learn,
        held_out,
        steps,
    } = asked;
    check_name(&name)?;
    if !(1..=MOST_TRAINING_STEPS).contains(&steps) {
        return Err(Refusal::new(
            format!("{steps} steps cannot be trained."),
            "Choose 1 to 100000 steps.",
        )
        .into());
    }
    if learn.is_empty() || held_out.is_empty() || learn.iter().any(|name| held_out.contains(name)) {
        return Err(Refusal::new(
            "What to learn from and what is held out is not said.",
            "Choose at least one demonstration to learn from, and another one that is held out.",
        )
        .into());
    }
    let order = on_files(&by.shared, move |libraries| {
        let entries = [libraries.tasks.list(), libraries.corrections.list()].concat();
        let chosen = |names: &[String]| {
            let entry = |name: &String| {
                let mut entries = entries.iter();
                let found = entries.find(|entry| entry.name == *name);
                let entry = found.ok_or_else(|| {
                    Refusal::new(
                        format!("There is no demonstration {name}."),
                        "Choose another one.",
                    )
                })?;
                Ok((libraries.holding(name).path(name)?, entry.problem.clone()))
            };
            names.iter().map(entry).collect::<Result<Vec<_>, Refusal>>()
        };
        let (learn, problems): (_, BTreeSet<_>) = chosen(&learn)?.into_iter().unzip();
        let held_out = chosen(&held_out)?.into_iter();
        Ok::<_, Refusal>(Order {
            name,
            learn,
            problems: problems.into_iter().collect(),
            held_out: held_out.map(|(path, _)| path).collect(),
            steps,
        })
    });
    by.shared.page.trainings.start(order.await??)?;
    Ok(StatusCode::ACCEPTED)
}

pub(super) async fn cancel_training(by: By) -> Answer {
    by.check_operator()?;
    by.shared.page.trainings.cancel();
    Ok(StatusCode::NO_CONTENT)
}

/// The held-out steps of the last comparison: as shown, and as both policies propose them.
pub(super) async fn comparison(State(shared): State<Shared>) -> Json<Vec<Example>> {
    Json(shared.page.trainings.examples())
}
