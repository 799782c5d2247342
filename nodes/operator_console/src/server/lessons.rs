//! Lessons, the library of what was taught, and repeating it.

use axum::extract::rejection::JsonRejection;
use axum::extract::{Json, Path, State};
use axum::http::StatusCode;
use axum::response::Response;
use heightmap::Workspace;
use msgs::convert;
use pick_place::PrimitiveSettings;
use serde::Deserialize;

use super::access::{Failure, Viewer};
use super::pictures::picture;
use super::{Named, Shared, on_files};
use crate::library::{Entry, Library};
use crate::run::Pose;

pub(super) async fn begin_lesson(
    State(shared): State<Shared>,
    Viewer(viewer): Viewer,
) -> Result<StatusCode, Failure> {
    shared
        .console
        .change(|state, _| state.begin_lesson(viewer))?;
    Ok(StatusCode::NO_CONTENT)
}

pub(super) async fn end_lesson(
    State(shared): State<Shared>,
    Viewer(viewer): Viewer,
) -> Result<StatusCode, Failure> {
    shared.console.change(|state, _| state.end_lesson(viewer))?;
    Ok(StatusCode::NO_CONTENT)
}

/// Heights and speeds of a step that is shown.
#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Preset {
    /// High and fast.
    Rigid,
    /// Low and slow.
    Gentle,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Show {
    pick: Pose,
    place: Pose,
    preset: Preset,
}

pub(super) async fn show_step(
    State(shared): State<Shared>,
    Viewer(viewer): Viewer,
    body: Result<Json<Show>, JsonRejection>,
) -> Result<StatusCode, Failure> {
    let Json(Show {
        pick,
        place,
        preset,
    }) = body?;
    let settings = convert::settings_to_msg(&match preset {
        Preset::Rigid => PrimitiveSettings::RIGID,
        Preset::Gentle => PrimitiveSettings::BEADS,
    });
    shared
        .console
        .change(|state, now| state.show_step(viewer, pick, place, settings, now))?;
    Ok(StatusCode::ACCEPTED)
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Judge {
    reached: bool,
}

pub(super) async fn judge_step(
    State(shared): State<Shared>,
    Viewer(viewer): Viewer,
    body: Result<Json<Judge>, JsonRejection>,
) -> Result<StatusCode, Failure> {
    let Json(Judge { reached }) = body?;
    shared
        .console
        .change(|state, _| state.judge_step(viewer, reached))?;
    Ok(StatusCode::NO_CONTENT)
}

pub(super) async fn undo_step(
    State(shared): State<Shared>,
    Viewer(viewer): Viewer,
) -> Result<StatusCode, Failure> {
    shared
        .console
        .change(|state, now| state.undo_step(viewer, now))?;
    Ok(StatusCode::ACCEPTED)
}

pub(super) async fn save_lesson(
    State(shared): State<Shared>,
    Viewer(viewer): Viewer,
    body: Result<Json<Named>, JsonRejection>,
) -> Result<StatusCode, Failure> {
    let Json(Named { name }) = body?;
    let demonstration = shared
        .console
        .change_quietly(|state, _| state.lesson_demonstration(viewer, &name))?;
    on_files(&shared, move |library| library.save(&name, &demonstration)).await??;
    shared.console.change(|state, _| state.lesson_saved());
    Ok(StatusCode::NO_CONTENT)
}

pub(super) async fn demonstrations(
    State(shared): State<Shared>,
) -> Result<Json<Vec<Entry>>, Failure> {
    Ok(Json(on_files(&shared, Library::list).await?))
}

pub(super) async fn demonstration_picture(
    State(shared): State<Shared>,
    Path((name, step)): Path<(String, usize)>,
) -> Result<Response, Failure> {
    let heightmap = on_files(&shared, move |library| library.picture(&name, step)).await??;
    let Workspace { rows, cols, .. } = heightmap.workspace;
    Ok(picture(
        step as u64,
        rows,
        cols,
        &heightmap.rgb,
        &heightmap.height_m,
    ))
}

pub(super) async fn repeat(
    State(shared): State<Shared>,
    Viewer(viewer): Viewer,
    body: Result<Json<Named>, JsonRejection>,
) -> Result<StatusCode, Failure> {
    let Json(Named { name }) = body?;
    let path = shared.library.path(&name)?;
    shared
        .console
        .change(|state, _| state.repeat(viewer, path))?;
    Ok(StatusCode::ACCEPTED)
}
