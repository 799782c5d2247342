//! The page and its API over HTTP and WebSocket. docs/operator_console.openapi.yaml is its description.

mod access;
mod decisions;
mod lessons;
mod live;
mod people;
mod pictures;
mod policies;
mod serving;

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::extract::ws::Utf8Bytes;
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::middleware;
use axum::routing::{get, post};
use serde::{Deserialize, Serialize};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tracing::warn;

use self::access::{Failure, guard, not_found, require_token};
use crate::cameras::Cameras;
use crate::checkpoints::Checkpoints;
use crate::library::Libraries;
use crate::run::{Run, Watch};
use crate::session::Sessions;
use crate::state::Console;
use crate::training::Trainings;

pub use self::access::{Access, InvalidToken};
pub use self::serving::{
    AddressFileError, InvalidServer, ListenError, Listening, Server, ServerSettings, TlsFiles,
};

/// Largest body of a request [bytes].
const LARGEST_BODY: usize = 16 * 1024;
/// Viewers are told of changes at most this often.
const SHORTEST_PERIOD: Duration = Duration::from_millis(20);
/// Ages are told anew this often.
const LONGEST_PERIOD: Duration = Duration::from_secs(1);

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

/// What the page shows, and where it finds and keeps it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct PageSettings {
    /// Most people who watch at once.
    pub max_viewers: usize,
    /// Who has shown no sign for this long has left (s).
    pub session_timeout_s: f64,
    /// Folder of what was taught.
    pub library: PathBuf,
    /// Folder of the checkpoints that the policy can be given.
    pub checkpoints: PathBuf,
    /// Checkpoint that the policy begins with.
    pub checkpoint: PathBuf,
    /// The command `sctn`, which trains.
    pub sctn: PathBuf,
    /// Recipe that it trains with.
    pub recipe: PathBuf,
    /// Folder of what is trained.
    pub training: PathBuf,
    /// Names of the cameras whose views are shown; empty ones count as none.
    pub cameras: Vec<String>,
    /// Frame of proposals.
    pub world_frame: String,
}

impl Default for PageSettings {
    fn default() -> Self {
        Self {
            max_viewers: 16,
            session_timeout_s: 60.0,
            library: "out/library".into(),
            checkpoints: "config/checkpoints".into(),
            checkpoint: "config/checkpoints/ten_problems.safetensors".into(),
            sctn: "sctn".into(),
            recipe: "config/recipes/taught.yaml".into(),
            training: "out/training".into(),
            cameras: ["front", "left", "right"].map(str::to_owned).into(),
            world_frame: "world".into(),
        }
    }
}

/// What the page shows and changes.
#[derive(Clone)]
pub struct Page {
    /// The run and the people.
    pub console: Arc<Console>,
    /// What was taught.
    pub libraries: Arc<Libraries>,
    /// The policies that there are.
    pub checkpoints: Arc<Checkpoints>,
    /// The training that is at work.
    pub trainings: Arc<Trainings>,
    /// What the cameras see.
    pub cameras: Arc<Cameras>,
}

impl Page {
    /// A page of which nothing was heard and nobody looks at.
    pub fn new(settings: &PageSettings, watch: Watch) -> Self {
        let timeout = Duration::from_secs_f64(settings.session_timeout_s);
        let sessions = Sessions::new(settings.max_viewers, timeout);
        let checkpoints = [settings.checkpoints.clone(), settings.training.clone()];
        let trainings = Trainings::new(
            settings.sctn.clone(),
            settings.recipe.clone(),
            settings.training.clone(),
            settings.checkpoint.clone(),
        );
        Self {
            console: Arc::new(Console::new(Run::new(watch), sessions)),
            libraries: Arc::new(Libraries::new(&settings.library)),
            checkpoints: Arc::new(Checkpoints::new(checkpoints)),
            trainings: Arc::new(trainings),
            cameras: Arc::new(Cameras::new(&settings.cameras, &settings.world_frame)),
        }
    }
}

/// What handlers share.
#[derive(Clone)]
struct Shared {
    page: Page,
    access: Arc<Access>,
    /// The newest snapshot as JSON; each WebSocket subscribes.
    snapshots: Arc<watch::Sender<Utf8Bytes>>,
    end: CancellationToken,
}

/// The page and the API. Snapshots are made and WebSockets live until `end` is cancelled.
pub fn router(page: Page, access: Access, end: CancellationToken) -> Router {
    let snapshots = Arc::new(watch::Sender::new(Utf8Bytes::default()));
    let making = make_snapshots(
        Arc::clone(&page.console),
        Arc::clone(&page.trainings),
        Arc::clone(&snapshots),
    );
    tokio::spawn(end.clone().run_until_cancelled_owned(making));
    let shared = Shared {
        page,
        access: Arc::new(access),
        snapshots,
        end,
    };
    let api = Router::new()
        .route("/sessions", post(people::join))
        .route("/sessions/leave", post(people::leave))
        .route("/presence", post(people::presence))
        .route("/operator", post(people::change_operator))
        .route("/state", get(decisions::state))
        .route("/decisions", post(decisions::decide))
        .route("/proposals", post(decisions::correct))
        .route("/home", post(decisions::home))
        .route("/put_down", post(decisions::put_down))
        .route("/step", post(decisions::set_step))
        .route("/heightmaps/{which}", get(pictures::heightmap))
        .route("/cameras", get(pictures::list_cameras))
        .route("/cameras/{name}", get(pictures::camera_image))
        .route("/motion", get(pictures::motion))
        .route("/scores", get(pictures::scores))
        .route("/robot_description", get(pictures::robot_description))
        .route("/lesson/begin", post(lessons::begin_lesson))
        .route("/lesson/settings", get(lessons::settings))
        .route("/lesson/show", post(lessons::show_step))
        .route("/lesson/execute", post(lessons::execute_step))
        .route("/lesson/change", post(lessons::change_step))
        .route("/lesson/judge", post(lessons::judge_step))
        .route("/lesson/undo", post(lessons::undo_step))
        .route("/lesson/save", post(lessons::save_lesson))
        .route("/lesson/end", post(lessons::end_lesson))
        .route("/checkpoints", get(policies::list_checkpoints))
        .route("/checkpoints/use", post(policies::use_checkpoint))
        .route("/checkpoints/back", post(policies::use_previous_checkpoint))
        .route("/training/start", post(policies::start_training))
        .route("/training/cancel", post(policies::cancel_training))
        .route("/training/comparison", get(policies::comparison))
        .route("/demonstrations", get(lessons::demonstrations))
        .route(
            "/demonstrations/{name}/{step}",
            get(lessons::demonstration_picture),
        )
        .route("/demonstrations/repeat", post(lessons::repeat))
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
        .route("/api/v1/live", get(live::live))
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
        console.change_quietly(|state, now| {
            state.sessions.expire(now);
            state.ask_again(now);
        });
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Named {
    name: String,
}

/// Work on the files of the libraries.
async fn on_files<T: Send + 'static>(
    shared: &Shared,
    work: impl FnOnce(&Libraries) -> T + Send + 'static,
) -> Result<T, Failure> {
    let libraries = Arc::clone(&shared.page.libraries);
    off_thread(move || work(&libraries)).await
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

#[cfg(test)]
pub(crate) mod tests;
