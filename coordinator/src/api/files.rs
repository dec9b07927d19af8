//! Routes to pictures, manifests and films: files of the queue, whole or by range, read
//! as fast as they are taken.

use super::Desk;
use super::range::{Wanted, wanted};
use super::refusal::Refusal;
use super::shots::{frame_number, shot_id};
use crate::queue::ShotFiles;
use axum::body::{Body, Bytes};
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use std::io::{ErrorKind, SeekFrom};
use std::path::PathBuf;
use std::sync::Arc;
use tokio::fs::File;
use tokio::io::{AsyncReadExt, AsyncSeekExt};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;

/// Bytes that are read at once.
const PIECE_BYTES: usize = 256 << 10;
/// Pieces that wait for a reader who is slower than the disk.
const PIECES: usize = 2;

/// `GET /api/v1/shots/{shot}/frames/{frame}.png`
pub(super) async fn frame(
    State(desk): State<Arc<Desk>>,
    Path((shot, name)): Path<(String, String)>,
    headers: HeaderMap,
) -> Result<Response, Refusal> {
    let number = name.strip_suffix(".png").ok_or_else(Refusal::no_route)?;
    let number = frame_number(number)?;
    let files = files(&desk, &shot)?;
    let last = u64::from(files.first_frame) + u64::from(files.frames.saturating_sub(1));
    let path = files.frame(number).ok_or_else(|| {
        let first = files.first_frame;
        Refusal::not_there(format!("the shot has the frames {first} to {last}, and no {number}"))
    })?;
    let missing = "that frame is not there; frames/NUMBER/why says why";
    send(path, "image/png", missing, &headers).await
}

/// `GET /api/v1/shots/{shot}/manifest.json`
pub(super) async fn manifest(
    State(desk): State<Arc<Desk>>,
    Path(shot): Path<String>,
    headers: HeaderMap,
) -> Result<Response, Refusal> {
    let path = files(&desk, &shot)?.manifest();
    send(path, "application/json", "there is no manifest before the shot is done", &headers).await
}

/// `GET /api/v1/shots/{shot}/film.mp4`
pub(super) async fn film(
    State(desk): State<Arc<Desk>>,
    Path(shot): Path<String>,
    headers: HeaderMap,
) -> Result<Response, Refusal> {
    let path = files(&desk, &shot)?.film();
    let missing = "there is no film: the shot is not done, or was submitted without one";
    send(path, "video/mp4", missing, &headers).await
}

/// `GET /api/v1/shots/{shot}/last.jpg`: the newest frame, small.
pub(super) async fn last(
    State(desk): State<Arc<Desk>>,
    Path(shot): Path<String>,
) -> Result<Response, Refusal> {
    let id = shot_id(&shot)?;
    let shot = desk.board().shot(id)?.clone();
    let none = || Refusal::not_there("no frame of it is finished yet");
    let kept = desk.thumbnails.get(id);
    let file = desk.queue.as_ref().and_then(|queue| queue.files(id));
    let jpeg = match (kept, shot.last_frame, file) {
        // In the middle of a shot the picture may be a few frames old.
        (Some((frame, jpeg)), newest, _)
            if !shot.state.is_over() || newest.is_none_or(|newest| newest == frame) =>
        {
            jpeg
        }
        (kept, Some(newest), Some(files)) => {
            let path = files.frame(newest).ok_or_else(none)?;
            let thumbnails = desk.thumbnails.clone();
            let turn = desk.previews.clone().acquire_owned().await;
            // Whoever asked may go; the picture is in memory until it is made.
            let read = move || {
                let _turn = turn;
                thumbnails.read(&shot, newest, &path)
            };
            match tokio::task::spawn_blocking(read).await {
                Ok(Ok(jpeg)) => jpeg,
                _ => kept.map(|(_, jpeg)| jpeg).ok_or_else(none)?,
            }
        }
        (kept, ..) => kept.map(|(_, jpeg)| jpeg).ok_or_else(none)?,
    };
    let head = [(header::CONTENT_TYPE, "image/jpeg"), (header::CACHE_CONTROL, "no-store")];
    Ok((head, jpeg).into_response())
}

fn files(desk: &Desk, shot: &str) -> Result<ShotFiles, Refusal> {
    let id = shot_id(shot)?;
    if let Some(files) = desk.queue.as_ref().and_then(|queue| queue.files(id)) {
        return Ok(files);
    }
    desk.board().shot(id)?;
    Err(Refusal::not_there(format!(
        "{id} is rendered for a client, which writes its frames itself"
    )))
}

/// A file or a part of it. Files of the queue are renamed into place and never change, so
/// what is open stays whole.
async fn send(
    path: PathBuf,
    content_type: &'static str,
    missing: &str,
    headers: &HeaderMap,
) -> Result<Response, Refusal> {
    let unreadable = |error: std::io::Error| match error.kind() {
        ErrorKind::NotFound => Refusal::not_there(missing),
        _ => Refusal::new(StatusCode::INTERNAL_SERVER_ERROR, format!("cannot read it: {error}")),
    };
    let mut file = File::open(&path).await.map_err(unreadable)?;
    let total = file.metadata().await.map_err(unreadable)?.len();
    let range = headers.get(header::RANGE).and_then(|value| value.to_str().ok());
    let answer = Response::builder()
        .header(header::CONTENT_TYPE, content_type)
        .header(header::ACCEPT_RANGES, "bytes")
        .header(header::CACHE_CONTROL, "no-cache");
    let (answer, length) = match wanted(range, total) {
        Wanted::All => (answer, total),
        Wanted::Part { first, length } => {
            file.seek(SeekFrom::Start(first)).await.map_err(unreadable)?;
            let place = format!("bytes {first}-{}/{total}", first + length - 1);
            (
                answer.status(StatusCode::PARTIAL_CONTENT).header(header::CONTENT_RANGE, place),
                length,
            )
        }
        Wanted::Nothing => {
            let place = format!("bytes */{total}");
            let text = format!("the range lies outside of its {total} bytes");
            let refused = Refusal::new(StatusCode::RANGE_NOT_SATISFIABLE, text);
            return Ok(([(header::CONTENT_RANGE, place)], refused).into_response());
        }
    };
    let (pieces, body) = mpsc::channel(PIECES);
    tokio::spawn(read(file, length, pieces));
    let body = Body::from_stream(ReceiverStream::new(body));
    let answer = answer.header(header::CONTENT_LENGTH, length).body(body);
    answer.map_err(|why| Refusal::new(StatusCode::INTERNAL_SERVER_ERROR, why.to_string()))
}

/// Reads so many bytes, as long as someone takes them.
async fn read(file: File, length: u64, pieces: mpsc::Sender<std::io::Result<Bytes>>) {
    let mut file = file.take(length);
    let mut left = length;
    while left > 0 {
        let mut piece = Vec::with_capacity(PIECE_BYTES.min(left as usize));
        let read = match (&mut file).take(PIECE_BYTES as u64).read_to_end(&mut piece).await {
            Ok(0) => Err(ErrorKind::UnexpectedEof.into()),
            Ok(count) => {
                left -= count as u64;
                Ok(piece.into())
            }
            Err(error) => Err(error),
        };
        let failed = read.is_err();
        if pieces.send(read).await.is_err() || failed {
            return;
        }
    }
}
