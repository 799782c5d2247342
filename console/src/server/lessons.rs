//! Lessons, the library of what was taught, and repeating it.

use std::collections::BTreeMap;

use axum::extract::{Json, Path, State};
use axum::http::StatusCode;
use axum::response::Response;
use heightmap::Workspace;
use pick_place::PrimitiveSettings;
use serde::{Deserialize, Serialize};

use super::access::{Answer, Body, By, Failure};
use super::pictures::picture;
use super::{Named, Shared, on_files};
use crate::library::{Entry, Libraries};
use crate::refusal::Refusal;
use crate::run::Pose;

pub(super) async fn begin_lesson(by: By) -> Answer {
    by.change(StatusCode::NO_CONTENT, |state, _| {
        state.begin_lesson(by.viewer)
    })
}

pub(super) async fn end_lesson(by: By) -> Answer {
    by.change(StatusCode::NO_CONTENT, |state, _| {
        state.end_lesson(by.viewer)
    })
}

/// Heights and speeds that a step can be shown with.
#[derive(Serialize)]
pub(super) struct Settings {
    /// For rigid objects; for soft objects and chains.
    presets: BTreeMap<&'static str, PrimitiveSettings>,
    /// Smallest and largest value of each setting.
    ranges: BTreeMap<&'static str, [f64; 2]>,
}

pub(super) async fn settings() -> Json<Settings> {
    let ranges = PrimitiveSettings::RANGES.into_iter();
    Json(Settings {
        presets: BTreeMap::from([
            ("rigid", PrimitiveSettings::RIGID),
            ("gentle", PrimitiveSettings::BEADS),
        ]),
        ranges: ranges
            .map(|(name, low, high)| (name, [low, high]))
            .collect(),
    })
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Show {
    pick: Pose,
    place: Pose,
    settings: PrimitiveSettings,
}

pub(super) async fn show_step(by: By, Body(asked): Body<Show>) -> Answer {
    let Show {
        pick,
        place,
        settings,
    } = asked;
    settings.check().map_err(|error| {
        Refusal::new(
            format!("The motion is out of range: {error}."),
            "Choose heights and speeds within their ranges.",
        )
    })?;
    by.change(StatusCode::ACCEPTED, |state, now| {
        state.show_step(by.viewer, pick, place, settings, now)
    })
}

pub(super) async fn execute_step(by: By) -> Answer {
    by.change(StatusCode::ACCEPTED, |state, now| {
        state.execute_step(by.viewer, now)
    })
}

pub(super) async fn change_step(by: By) -> Answer {
    by.change(StatusCode::NO_CONTENT, |state, _| {
        state.change_step(by.viewer)
    })
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Judge {
    reached: bool,
}

pub(super) async fn judge_step(by: By, Body(Judge { reached }): Body<Judge>) -> Answer {
    by.change(StatusCode::NO_CONTENT, |state, _| {
        state.judge_step(by.viewer, reached)
    })
}

pub(super) async fn undo_step(by: By) -> Answer {
    by.change(StatusCode::ACCEPTED, |state, now| {
        state.undo_step(by.viewer, now)
    })
}

pub(super) async fn save_lesson(by: By, Body(Named { name }): Body<Named>) -> Answer {
    let demonstration = by
        .shared
        .page
        .console
        .change_quietly(|state, _| state.lesson_demonstration(by.viewer, &name))?;
    on_files(&by.shared, move |libraries| {
        libraries.tasks.save(&name, &demonstration)
    })
    .await??;
    by.shared
        .page
        .console
        .change(|state, _| state.lesson_saved());
    Ok(StatusCode::NO_CONTENT)
}

/// What can be repeated, and what can be learned from besides.
#[derive(Serialize)]
pub(super) struct Demonstrations {
    tasks: Vec<Entry>,
    corrections: Vec<Entry>,
}

pub(super) async fn demonstrations(
    State(shared): State<Shared>,
) -> Result<Json<Demonstrations>, Failure> {
    let list = |libraries: &Libraries| Demonstrations {
        tasks: libraries.tasks(),
        corrections: libraries.corrections.list(),
    };
    Ok(Json(on_files(&shared, list).await?))
}

pub(super) async fn demonstration_picture(
    State(shared): State<Shared>,
    Path((name, step)): Path<(String, usize)>,
) -> Result<Response, Failure> {
    let heightmap = on_files(&shared, move |libraries| {
        libraries.holding(&name).picture(&name, step)
    })
    .await??;
    let Workspace { rows, cols, .. } = heightmap.workspace;
    Ok(picture(
        step as u64,
        rows,
        cols,
        &heightmap.rgb,
        &heightmap.height_m,
    ))
}

pub(super) async fn repeat(by: By, Body(Named { name }): Body<Named>) -> Answer {
    let path = by.shared.page.libraries.tasks.path(&name)?;
    by.change(StatusCode::ACCEPTED, |state, _| {
        state.repeat(by.viewer, name, path)
    })
}
