//! The WebSocket: each viewer is sent the newest state, and says that it is there.

use std::time::Duration;

use axum::extract;
use axum::extract::ws::{CloseFrame, Message, Utf8Bytes, WebSocket, WebSocketUpgrade, close_code};
use axum::response::Response;
use serde::Deserialize;

use super::Shared;
use crate::state::State;

/// Largest WebSocket message from a client [bytes].
const LARGEST_MESSAGE: usize = 4 * 1024;

/// A client of the WebSocket has to show its token in this time.
const GREETING_TIMEOUT: Duration = Duration::from_secs(5);

/// A viewer that takes nothing for so long is disconnected.
const SEND_TIMEOUT: Duration = Duration::from_secs(10);

/// What a client says over the WebSocket.
#[derive(Deserialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub(super) enum Said {
    /// The first message: the token, and the session where there is one.
    Hello {
        token: String,
        session: Option<String>,
    },
    /// Five times a second: the page is there, and visible or not.
    Present { visible: bool },
}

pub(super) async fn live(
    extract::State(shared): extract::State<Shared>,
    upgrade: WebSocketUpgrade,
) -> Response {
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
    let find = |session: &str| {
        shared
            .page
            .console
            .read(|state, _| state.sessions.find(session))
    };
    let viewer = session.as_deref().and_then(find);
    if session.is_some() && viewer.is_none() {
        return close(socket, close_code::POLICY, "the session is over").await;
    }
    let heard = |visible| {
        if let Some(viewer) = viewer {
            // Others see who is present.
            let before = shared
                .page
                .console
                .read(|state, now| state.sessions.presence(now).map(|(_, present)| present));
            let after = shared.page.console.change_quietly(|state, now| {
                state.sessions.heard(viewer, visible, now);
                state.sessions.presence(now).map(|(_, present)| present)
            });
            if before != after {
                let tell = |state: &mut State, _| state.presence_changed();
                shared.page.console.change(tell);
            }
        }
    };
    heard(true);
    let mut snapshots = shared.snapshots.subscribe();
    let first = match shared.page.console.snapshot(shared.page.trainings.state()) {
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
