//! The page and its API over HTTP and WebSocket. docs/operator_console.openapi.yaml is its description.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::rejection::JsonRejection;
use axum::extract::ws::{CloseFrame, Message, Utf8Bytes, WebSocket, WebSocketUpgrade, close_code};
use axum::extract::{DefaultBodyLimit, FromRequestParts, Json, Path, Request, State};
use axum::http::header::{
    AUTHORIZATION, CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HOST, ORIGIN,
    REFERRER_POLICY, X_CONTENT_TYPE_OPTIONS,
};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use heightmap::Workspace;
use msgs::convert;
use pick_place::PrimitiveSettings;
use serde::{Deserialize, Serialize};
use subtle::ConstantTimeEq as _;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tracing::{info, warn};

use crate::cameras::{CameraState, Cameras};
use crate::checkpoints::{Checkpoint, Checkpoints};
use crate::console::Console;
use crate::lesson::check_name;
use crate::library::{Entry, Library};
use crate::preview::Motion;
use crate::refusal::Refusal;
use crate::run::{Decision, Pose, View};
use crate::session::ViewerId;
use crate::training::{Order, Trainings};

/// Largest body of a request [bytes].
const LARGEST_BODY: usize = 16 * 1024;
/// Largest WebSocket message from a client [bytes].
const LARGEST_MESSAGE: usize = 4 * 1024;
/// A client of the WebSocket has to show its token in this time.
const GREETING_TIMEOUT: Duration = Duration::from_secs(5);
/// A viewer that takes nothing for so long is disconnected.
const SEND_TIMEOUT: Duration = Duration::from_secs(10);
/// Viewers are told of changes at most this often.
const SHORTEST_PERIOD: Duration = Duration::from_millis(40);
/// Ages are told anew this often.
const LONGEST_PERIOD: Duration = Duration::from_secs(1);
/// Most gradient steps of a training.
const MOST_TRAINING_STEPS: u64 = 100_000;
/// Header with a viewer's key.
const SESSION: HeaderName = HeaderName::from_static("x-session");

/// The page: path, type, contents.
const PAGE: [(&str, &str, &[u8]); 8] = [
    (
        "/",
        "text/html; charset=utf-8",
        include_bytes!("../page/index.html"),
    ),
    (
        "/style.css",
        "text/css; charset=utf-8",
        include_bytes!("../page/style.css"),
    ),
    (
        "/console.js",
        "text/javascript; charset=utf-8",
        include_bytes!("../page/console.js"),
    ),
    (
        "/api.js",
        "text/javascript; charset=utf-8",
        include_bytes!("../page/api.js"),
    ),
    (
        "/view.js",
        "text/javascript; charset=utf-8",
        include_bytes!("../page/view.js"),
    ),
    (
        "/cameras.js",
        "text/javascript; charset=utf-8",
        include_bytes!("../page/cameras.js"),
    ),
    (
        "/arm.js",
        "text/javascript; charset=utf-8",
        include_bytes!("../page/arm.js"),
    ),
    (
        "/icon.svg",
        "image/svg+xml",
        include_bytes!("../page/icon.svg"),
    ),
];

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

    fn knows_token(&self, token: &str) -> bool {
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
struct Failure {
    status: StatusCode,
    refusal: Refusal,
}

impl Failure {
    fn new(status: StatusCode, reason: impl Into<String>, advice: &str) -> Self {
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

/// What handlers share.
#[derive(Clone)]
struct Shared {
    console: Arc<Console>,
    library: Arc<Library>,
    checkpoints: Arc<Checkpoints>,
    trainings: Arc<Trainings>,
    cameras: Arc<Cameras>,
    access: Arc<Access>,
    /// The newest snapshot as JSON; each WebSocket subscribes.
    snapshots: Arc<watch::Sender<Utf8Bytes>>,
    end: CancellationToken,
}

/// The page and the API. Snapshots are made and WebSockets live until `end` is cancelled.
pub fn router(
    console: Arc<Console>,
    library: Arc<Library>,
    checkpoints: Arc<Checkpoints>,
    trainings: Arc<Trainings>,
    cameras: Arc<Cameras>,
    access: Access,
    end: CancellationToken,
) -> Router {
    let snapshots = Arc::new(watch::Sender::new(Utf8Bytes::default()));
    let making = make_snapshots(
        Arc::clone(&console),
        Arc::clone(&trainings),
        Arc::clone(&snapshots),
    );
    tokio::spawn(end.clone().run_until_cancelled_owned(making));
    let shared = Shared {
        console,
        library,
        checkpoints,
        trainings,
        cameras,
        access: Arc::new(access),
        snapshots,
        end,
    };
    let api = Router::new()
        .route("/sessions", post(join))
        .route("/sessions/leave", post(leave))
        .route("/presence", post(presence))
        .route("/operator", post(change_operator))
        .route("/state", get(state))
        .route("/decisions", post(decide))
        .route("/proposals", post(correct))
        .route("/home", post(home))
        .route("/step", post(set_step))
        .route("/heightmaps/{which}", get(heightmap))
        .route("/cameras", get(list_cameras))
        .route("/cameras/{name}", get(camera_image))
        .route("/motion", get(motion))
        .route("/scores", get(scores))
        .route("/robot_description", get(robot_description))
        .route("/lesson/begin", post(begin_lesson))
        .route("/lesson/show", post(show_step))
        .route("/lesson/judge", post(judge_step))
        .route("/lesson/undo", post(undo_step))
        .route("/lesson/save", post(save_lesson))
        .route("/lesson/end", post(end_lesson))
        .route("/checkpoints", get(list_checkpoints))
        .route("/checkpoints/use", post(use_checkpoint))
        .route("/checkpoints/back", post(use_previous_checkpoint))
        .route("/training/start", post(start_training))
        .route("/training/cancel", post(cancel_training))
        .route("/demonstrations", get(demonstrations))
        .route("/demonstrations/{name}/{step}", get(demonstration_picture))
        .route("/demonstrations/repeat", post(repeat))
        .layer(middleware::from_fn_with_state(
            shared.clone(),
            require_token,
        ));
    let mut pages = Router::new();
    for (path, content_type, contents) in PAGE {
        let page = move || async move { ([(CONTENT_TYPE, content_type)], contents) };
        pages = pages.route(path, get(page));
    }
    Router::new()
        .merge(pages)
        .nest("/api/v1", api)
        // Shows its token in its first message, since a browser cannot send a header here.
        .route("/api/v1/live", get(live))
        .fallback(not_found)
        .layer(DefaultBodyLimit::max(LARGEST_BODY))
        .layer(middleware::from_fn_with_state(shared.clone(), guard))
        .with_state(shared)
}

async fn make_snapshots(
    console: Arc<Console>,
    trainings: Arc<Trainings>,
    sender: Arc<watch::Sender<Utf8Bytes>>,
) {
    let mut version = console.version();
    loop {
        // Without viewers nothing is made; the next one has its first snapshot made for it.
        if sender.receiver_count() > 0 {
            match console.snapshot(trainings.state()) {
                Ok(snapshot) => {
                    sender.send_replace(snapshot.into());
                }
                Err(error) => warn!("the state cannot be written as JSON: {error}"),
            }
        }
        tokio::time::sleep(SHORTEST_PERIOD).await;
        let _ = tokio::time::timeout(LONGEST_PERIOD, version.changed()).await;
        console.change_quietly(|state, now| state.sessions.expire(now));
    }
}

/// Every request: the right host and origin; every answer: what a browser may do with it.
async fn guard(State(shared): State<Shared>, request: Request, next: Next) -> Response {
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

async fn require_token(
    State(shared): State<Shared>,
    request: Request,
    next: Next,
) -> Result<Response, Failure> {
    shared.access.check_token(request.headers())?;
    Ok(next.run(request).await)
}

async fn not_found() -> Failure {
    Failure::new(
        StatusCode::NOT_FOUND,
        "There is nothing under this path.",
        "docs/operator_console.openapi.yaml lists what there is.",
    )
}

/// The viewer that asks, by its key.
struct Viewer(ViewerId);

impl FromRequestParts<Shared> for Viewer {
    type Rejection = Failure;

    async fn from_request_parts(parts: &mut Parts, shared: &Shared) -> Result<Self, Failure> {
        let key = parts
            .headers
            .get(SESSION)
            .and_then(|value| value.to_str().ok());
        let found = shared.console.change_quietly(|state, now| {
            let id = state.sessions.find(key?)?;
            state.sessions.heard(id, true, now);
            Some(id)
        });
        found.map(Self).ok_or_else(|| {
            Failure::new(
                StatusCode::UNAUTHORIZED,
                "Your session is over.",
                "Join again with your name.",
            )
        })
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Join {
    name: String,
}

#[derive(Serialize)]
struct Joined {
    viewer: ViewerId,
    session: String,
}

async fn join(
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

async fn leave(State(shared): State<Shared>, Viewer(viewer): Viewer) -> StatusCode {
    shared
        .console
        .change(|state, _| state.sessions.leave(viewer));
    StatusCode::NO_CONTENT
}

/// A sign of life of a program without a WebSocket.
async fn presence(Viewer(_): Viewer) -> StatusCode {
    StatusCode::NO_CONTENT
}

#[derive(Deserialize)]
#[serde(tag = "action", rename_all = "snake_case", deny_unknown_fields)]
enum ChangeOperator {
    /// `from`: who decides now, as the one who takes has seen it.
    Take { from: Option<ViewerId> },
    /// `to`: who shall decide; nobody where it is left out.
    HandOver { to: Option<ViewerId> },
}

async fn change_operator(
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

async fn state(State(shared): State<Shared>) -> Result<Response, Failure> {
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
struct Decide {
    proposal_id: String,
    decision: Decision,
}

async fn decide(
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
struct Correct {
    pick: Pose,
    place: Pose,
}

#[derive(Serialize)]
struct Corrected {
    proposal_id: String,
}

async fn correct(
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

async fn home(State(shared): State<Shared>, Viewer(viewer): Viewer) -> Result<StatusCode, Failure> {
    shared.console.change(|state, _| state.home(viewer))?;
    Ok(StatusCode::ACCEPTED)
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SetStep {
    step: u32,
}

async fn set_step(
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

/// Colours (red, green, blue of each cell), then heights (32-bit little-endian floats, in metres).
async fn heightmap(
    State(shared): State<Shared>,
    Path(which): Path<String>,
) -> Result<Response, Failure> {
    let view = shared.console.read(|state, _| {
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
        heightmap.rows as usize,
        heightmap.cols as usize,
        &heightmap.rgb,
        &heightmap.height_m,
    ))
}

/// The checkpoints that the policy can be given.
async fn list_checkpoints(State(shared): State<Shared>) -> Result<Json<Vec<Checkpoint>>, Failure> {
    let checkpoints = Arc::clone(&shared.checkpoints);
    Ok(Json(off_thread(move || checkpoints.list()).await?))
}

async fn use_checkpoint(
    State(shared): State<Shared>,
    Viewer(viewer): Viewer,
    body: Result<Json<Named>, JsonRejection>,
) -> Result<StatusCode, Failure> {
    let Json(Named { name }) = body?;
    let checkpoints = Arc::clone(&shared.checkpoints);
    let path = off_thread(move || checkpoints.path(&name)).await??;
    shared
        .console
        .change(|state, _| state.use_checkpoint(viewer, path))?;
    Ok(StatusCode::ACCEPTED)
}

async fn use_previous_checkpoint(
    State(shared): State<Shared>,
    Viewer(viewer): Viewer,
) -> Result<StatusCode, Failure> {
    shared
        .console
        .change(|state, _| state.use_previous_checkpoint(viewer))?;
    Ok(StatusCode::ACCEPTED)
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct StartTraining {
    name: String,
    /// Demonstrations of the library to learn from, and those that are held out.
    learn: Vec<String>,
    held_out: Vec<String>,
    steps: u64,
}

async fn start_training(
    State(shared): State<Shared>,
    Viewer(viewer): Viewer,
    body: Result<Json<StartTraining>, JsonRejection>,
) -> Result<StatusCode, Failure> {
    let Json(asked) = body?;
    shared
        .console
        .read(|state, _| state.sessions.check_operator(viewer))?;
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
    let order = on_files(&shared, move |library| {
        let entries = library.list();
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
                Ok((library.path(name)?, entry.problem.clone()))
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
    shared.trainings.start(order.await??)?;
    Ok(StatusCode::ACCEPTED)
}

async fn cancel_training(
    State(shared): State<Shared>,
    Viewer(viewer): Viewer,
) -> Result<StatusCode, Failure> {
    shared
        .console
        .read(|state, _| state.sessions.check_operator(viewer))?;
    shared.trainings.cancel();
    Ok(StatusCode::NO_CONTENT)
}

/// The cameras; their images come while somebody asks for this.
async fn list_cameras(State(shared): State<Shared>) -> Json<Vec<CameraState>> {
    Json(shared.cameras.look())
}

/// Red, green and blue of each pixel of a camera's newest image.
async fn camera_image(
    State(shared): State<Shared>,
    Path(name): Path<String>,
) -> Result<Response, Failure> {
    let (number, width, height, rgb) = shared.cameras.image(&name).ok_or_else(|| {
        Failure::new(
            StatusCode::NOT_FOUND,
            "There is no image of that camera.",
            "Ask for a camera of /api/v1/cameras whose number is not 0.",
        )
    })?;
    Ok(picture(number, height, width, &rgb, &[]))
}

/// The planned motion of the present proposal.
async fn motion(State(shared): State<Shared>) -> Result<Json<Motion>, Failure> {
    let motion = shared.console.read(|state, _| state.run.motion().cloned());
    motion.map(Json).ok_or_else(|| {
        Failure::new(
            StatusCode::NOT_FOUND,
            "The executor has not planned the motion of the present proposal.",
            "Wait a moment.",
        )
    })
}

/// Red, green and blue of each cell of the two score maps.
async fn scores(State(shared): State<Shared>) -> Result<Response, Failure> {
    let scores = shared.console.read(|state, _| state.run.scores().cloned());
    let scores = scores.ok_or_else(|| {
        Failure::new(
            StatusCode::NOT_FOUND,
            "There are no scores of the present proposal.",
            "Wait a moment.",
        )
    })?;
    let image = &scores.image;
    let (rows, cols) = (image.height as usize, image.width as usize);
    Ok(picture(scores.number, rows, cols, &image.data, &[]))
}

async fn robot_description(State(shared): State<Shared>) -> Result<Response, Failure> {
    let urdf = shared
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

fn picture(number: u64, rows: usize, cols: usize, rgb: &[u8], height_m: &[f32]) -> Response {
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

async fn begin_lesson(
    State(shared): State<Shared>,
    Viewer(viewer): Viewer,
) -> Result<StatusCode, Failure> {
    shared
        .console
        .change(|state, _| state.begin_lesson(viewer))?;
    Ok(StatusCode::NO_CONTENT)
}

async fn end_lesson(
    State(shared): State<Shared>,
    Viewer(viewer): Viewer,
) -> Result<StatusCode, Failure> {
    shared.console.change(|state, _| state.end_lesson(viewer))?;
    Ok(StatusCode::NO_CONTENT)
}

/// Heights and speeds of a step that is shown.
#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Preset {
    /// High and fast.
    Rigid,
    /// Low and slow.
    Gentle,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Show {
    pick: Pose,
    place: Pose,
    preset: Preset,
}

async fn show_step(
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
struct Judge {
    reached: bool,
}

async fn judge_step(
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

async fn undo_step(
    State(shared): State<Shared>,
    Viewer(viewer): Viewer,
) -> Result<StatusCode, Failure> {
    shared
        .console
        .change(|state, now| state.undo_step(viewer, now))?;
    Ok(StatusCode::ACCEPTED)
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Named {
    name: String,
}

/// Work on the library's files.
async fn on_files<T: Send + 'static>(
    shared: &Shared,
    work: impl FnOnce(&Library) -> T + Send + 'static,
) -> Result<T, Failure> {
    let library = Arc::clone(&shared.library);
    off_thread(move || work(&library)).await
}

/// Work on files, off the threads that serve.
async fn off_thread<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, Failure> {
    let done = tokio::task::spawn_blocking(work).await;
    done.map_err(|_| {
        Failure::new(
            StatusCode::INTERNAL_SERVER_ERROR,
            "The files could not be read.",
            "Look at the node's log.",
        )
    })
}

async fn save_lesson(
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

async fn demonstrations(State(shared): State<Shared>) -> Result<Json<Vec<Entry>>, Failure> {
    Ok(Json(on_files(&shared, Library::list).await?))
}

async fn demonstration_picture(
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

async fn repeat(
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

/// What a client says over the WebSocket.
#[derive(Deserialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
enum Said {
    /// The first message: the token, and the session where there is one.
    Hello {
        token: String,
        session: Option<String>,
    },
    /// Five times a second: the page is there, and visible or not.
    Present { visible: bool },
}

async fn live(State(shared): State<Shared>, upgrade: WebSocketUpgrade) -> Response {
    upgrade
        .max_message_size(LARGEST_MESSAGE)
        .max_frame_size(LARGEST_MESSAGE)
        .on_upgrade(move |socket| async move {
            let end = shared.end.clone();
            let _ = end.run_until_cancelled(follow(shared, socket)).await;
        })
}

async fn follow(shared: Shared, mut socket: WebSocket) {
    let greeting = tokio::time::timeout(GREETING_TIMEOUT, socket.recv()).await;
    let said = match &greeting {
        Ok(Some(Ok(Message::Text(text)))) => serde_json::from_str(text).ok(),
        _ => None,
    };
    let session = match said {
        Some(Said::Hello { token, session }) if shared.access.knows_token(&token) => session,
        _ => {
            let reason = "expected a hello with the right token";
            return close(socket, close_code::POLICY, reason).await;
        }
    };
    let find = |session: &str| shared.console.read(|state, _| state.sessions.find(session));
    let viewer = session.as_deref().and_then(find);
    if session.is_some() && viewer.is_none() {
        return close(socket, close_code::POLICY, "the session is over").await;
    }
    let heard = |visible| {
        if let Some(viewer) = viewer {
            // Others see who is present.
            let before = shared
                .console
                .read(|state, now| state.sessions.presence(now).map(|(_, present)| present));
            let after = shared.console.change_quietly(|state, now| {
                state.sessions.heard(viewer, visible, now);
                state.sessions.presence(now).map(|(_, present)| present)
            });
            if before != after {
                shared.console.change(|_, _| ());
            }
        }
    };
    heard(true);
    let mut snapshots = shared.snapshots.subscribe();
    let first = match shared.console.snapshot(shared.trainings.state()) {
        Ok(first) => Utf8Bytes::from(first),
        Err(_) => return close(socket, close_code::ERROR, "no state").await,
    };
    let mut next = Some(first);
    loop {
        if let Some(snapshot) = next.take() {
            let sent = socket.send(Message::Text(snapshot));
            if !matches!(tokio::time::timeout(SEND_TIMEOUT, sent).await, Ok(Ok(()))) {
                break;
            }
        }
        tokio::select! {
            changed = snapshots.changed() => match changed {
                Ok(()) => next = Some(snapshots.borrow_and_update().clone()),
                Err(_) => break,
            },
            message = socket.recv() => match message {
                Some(Ok(Message::Text(text))) => match serde_json::from_str(&text) {
                    Ok(Said::Present { visible }) => heard(visible),
                    _ => {
                        close(socket, close_code::INVALID, "expected a message of type present").await;
                        break;
                    }
                },
                Some(Ok(Message::Ping(_) | Message::Pong(_))) => {}
                Some(Ok(Message::Binary(_))) => {
                    close(socket, close_code::UNSUPPORTED, "expected text").await;
                    break;
                }
                Some(Ok(Message::Close(_)) | Err(_)) | None => break,
            },
        }
    }
    heard(false);
}

async fn close(mut socket: WebSocket, code: u16, reason: &'static str) {
    let frame = CloseFrame {
        code,
        reason: Utf8Bytes::from_static(reason),
    };
    // It may be gone already.
    let _ = tokio::time::timeout(SEND_TIMEOUT, socket.send(Message::Close(Some(frame)))).await;
}

#[cfg(test)]
mod tests;
