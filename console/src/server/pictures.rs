//! What is shown: heightmaps, the cameras' images, score maps, the robot and its planned motion.

use std::sync::Arc;

use axum::body::{Body, Bytes};
use axum::extract::{Json, Path, State};
use axum::http::header::CONTENT_TYPE;
use axum::http::{HeaderName, StatusCode};
use axum::response::{IntoResponse, Response};

use super::Shared;
use super::access::Failure;
use crate::cameras::CameraState;
use crate::run::View;

/// Colours (red, green, blue of each cell), then heights (32-bit little-endian floats, in metres).
pub(super) async fn heightmap(
    State(shared): State<Shared>,
    Path(which): Path<String>,
) -> Result<Response, Failure> {
    let view = shared.page.console.read(|state, _| {
        let run = &state.run;
        let (kind, number) = which.split_once('-').unwrap_or((&which, ""));
        let number = number.parse::<u64>().ok();
        let found: Option<&View> = match (kind, number) {
            ("present", None) => run.present(),
            ("goal", None) => run.goal_view(),
            ("goal", Some(step)) => run.strip(u32::try_from(step).ok()?),
            ("before", Some(step)) => run.past_step(step)?.0,
            ("after", Some(step)) => run.past_step(step)?.1,
            _ => None,
        };
        found.cloned()
    });
    let view = view.ok_or_else(|| {
        Failure::new(
            StatusCode::NOT_FOUND,
            "There is no such heightmap.",
            "Ask for present, goal, goal-STEP, before-NUMBER or after-NUMBER of the state.",
        )
    })?;
    let heightmap = &view.heightmap;
    Ok(picture(
        view.number,
        heightmap.workspace.rows,
        heightmap.workspace.cols,
        &heightmap.rgb,
        &heightmap.height_m,
    ))
}

/// The cameras; their images come while somebody asks for this.
pub(super) async fn list_cameras(State(shared): State<Shared>) -> Json<Vec<CameraState>> {
    Json(shared.page.cameras.look())
}

/// Red, green and blue of each pixel of a camera's newest image.
pub(super) async fn camera_image(
    State(shared): State<Shared>,
    Path(name): Path<String>,
) -> Result<Response, Failure> {
    let (number, width, height, rgb) = shared.page.cameras.image(&name).ok_or_else(|| {
        Failure::new(
            StatusCode::NOT_FOUND,
            "There is no image of that camera.",
            "Ask for a camera of /api/v1/cameras whose number is not 0.",
        )
    })?;
    Ok(picture(number, height, width, &rgb, &[]))
}

/// The planned motion of what waits for an approval: of the way home, of the step of a lesson, or of the present proposal. No content
/// where nothing waits, as when it was decided on while a page asked.
pub(super) async fn motion(State(shared): State<Shared>) -> Response {
    let motion = shared
        .page
        .console
        .read(|state, _| state.pending_motion().cloned());
    match motion {
        Some(motion) => Json(motion).into_response(),
        None => StatusCode::NO_CONTENT.into_response(),
    }
}

/// Red, green and blue of each cell of the two score maps; no content where there are none of the present proposal.
pub(super) async fn scores(State(shared): State<Shared>) -> Response {
    let scores = shared.page.console.read(|state, _| {
        let (number, scores) = state.run.scores()?;
        Some((number, Arc::clone(scores)))
    });
    match scores {
        Some((number, scores)) => picture(number, scores.rows, scores.cols, &scores.rgb, &[]),
        None => StatusCode::NO_CONTENT.into_response(),
    }
}

pub(super) async fn robot_description(State(shared): State<Shared>) -> Result<Response, Failure> {
    let urdf = shared
        .page
        .console
        .read(|state, _| state.run.robot_description());
    let urdf = urdf.ok_or_else(|| {
        Failure::new(
            StatusCode::NOT_FOUND,
            "Nobody has described the robot.",
            "Look whether robot_description is published.",
        )
    })?;
    let headers = [(CONTENT_TYPE, "application/xml")];
    Ok((headers, urdf.to_string()).into_response())
}

pub(super) fn picture(
    number: u64,
    rows: usize,
    cols: usize,
    rgb: &[u8],
    height_m: &[f32],
) -> Response {
    let mut bytes = Vec::with_capacity(rgb.len() + 4 * height_m.len());
    bytes.extend_from_slice(rgb);
    for height in height_m {
        bytes.extend_from_slice(&height.to_le_bytes());
    }
    let headers = [
        (CONTENT_TYPE, "application/octet-stream".to_owned()),
        (HeaderName::from_static("x-number"), number.to_string()),
        (HeaderName::from_static("x-rows"), rows.to_string()),
        (HeaderName::from_static("x-cols"), cols.to_string()),
    ];
    (headers, Body::from(Bytes::from(bytes))).into_response()
}
