//! `GET /api/v1/events`: what the page shows, whenever it changes, as server-sent events.
//!
//! Every stream says which part of the lists it shows and gets that: `farm`, `shots` and
//! `workers`, each when it has changed and at most twice a second. Whoever reads slowly
//! misses what was in between and gets the newest.

use super::board::Window;
use super::refusal::Refusal;
use super::{Desk, shots, workers};
use axum::extract::{Query, State};
use axum::http::{StatusCode, header};
use axum::response::sse::{Event, Sse};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{OwnedSemaphorePermit, mpsc};
use tokio::time::MissedTickBehavior;
use tokio_stream::wrappers::ReceiverStream;

/// Most streams at once.
pub(super) const STREAMS_MAX: usize = 64;
/// Shortest time between two looks.
const PACE: Duration = Duration::from_millis(500);

/// Which parts of the lists a stream shows.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct Windows {
    shots_state: String,
    shots_name: String,
    shots_offset: usize,
    shots_limit: Option<usize>,
    workers_state: String,
    workers_name: String,
    workers_offset: usize,
    workers_limit: Option<usize>,
}

/// The stream.
pub(super) async fn events(
    State(desk): State<Arc<Desk>>,
    Query(windows): Query<Windows>,
) -> Result<Response, Refusal> {
    let full = "as many pages as this coordinator serves are open; close some";
    let seat = desk.streams.clone().try_acquire_owned();
    let seat = seat.map_err(|_| Refusal::new(StatusCode::SERVICE_UNAVAILABLE, full))?;
    let shots = Window {
        state: windows.shots_state,
        name: windows.shots_name,
        offset: windows.shots_offset,
        limit: windows.shots_limit,
    };
    let workers = Window {
        state: windows.workers_state,
        name: windows.workers_name,
        offset: windows.workers_offset,
        limit: windows.workers_limit,
    };
    // What is wrong with a window is said at once, and not in the stream.
    let board = desk.board();
    board.page_of_shots(&shots)?;
    board.page_of_workers(&workers)?;
    let (events, inbox) = mpsc::channel(1);
    tokio::spawn(tell(desk, shots, workers, events, seat));
    // Proxies must not save events up.
    let head = [(header::CACHE_CONTROL, "no-store"), (PROXIES, "no")];
    Ok((head, Sse::new(ReceiverStream::new(inbox))).into_response())
}

/// What a common proxy reads.
const PROXIES: header::HeaderName = header::HeaderName::from_static("x-accel-buffering");

async fn tell(
    desk: Arc<Desk>,
    shots: Window,
    workers: Window,
    events: mpsc::Sender<Result<Event, Infallible>>,
    _seat: OwnedSemaphorePermit,
) {
    let mut looks = tokio::time::interval(PACE);
    looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut told: [String; 3] = Default::default();
    loop {
        tokio::select! {
            () = desk.stop.cancelled() => return,
            () = events.closed() => return,
            _ = looks.tick() => {}
        }
        let board = desk.board();
        let farm = desk.totals(&board).to_string();
        let (Ok(shots), Ok(workers)) =
            (shots::list_json(&board, &shots), workers::list_json(&board, &workers))
        else {
            return;
        };
        let news = [("farm", farm), ("shots", shots.to_string()), ("workers", workers.to_string())];
        for ((name, data), told) in news.into_iter().zip(&mut told) {
            if *told == data {
                continue;
            }
            let event = Event::default().event(name).data(&data);
            if events.send(Ok(event)).await.is_err() {
                return;
            }
            *told = data;
        }
    }
}
