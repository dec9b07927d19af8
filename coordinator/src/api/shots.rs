//! Routes about shots: lists, submissions, orders.

use super::Desk;
use super::board::{Board, Page, Window};
use super::carry::Paid;
use super::refusal::Refusal;
use crate::order::Order;
use crate::queue::{ShotPlan, SubmissionKey, parse_hash};
use crate::view::ShotView;
use axum::Json;
use axum::body::{Bytes, HttpBody};
use axum::extract::{Path, Query, Request, State};
use axum::http::HeaderMap;
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use serde_json::{Value, json};
use std::sync::Arc;
use terrafarm_common::id::{BlobHash, FrameIndex, ShotId, WorkerId};
use terrafarm_wire::limits::DESK_BODY_MAX;

/// Says that a submission is the same one when it is sent again.
const KEY_HEADER: &str = "idempotency-key";

/// Answers of handlers.
pub(super) type Answer = Result<Json<Value>, Refusal>;

/// A shot by its number, `17` or `shot-17`.
pub(super) fn shot_id(text: &str) -> Result<ShotId, Refusal> {
    let number = text.strip_prefix("shot-").unwrap_or(text).parse();
    number.map(ShotId).map_err(|_| Refusal::malformed(format!("{text:?} is no number of a shot")))
}

/// A worker by its number, `17` or `worker-17`.
pub(super) fn worker_id(text: &str) -> Result<WorkerId, Refusal> {
    let number = text.strip_prefix("worker-").unwrap_or(text).parse();
    let malformed = |_| Refusal::malformed(format!("{text:?} is no number of a worker"));
    number.map(WorkerId).map_err(malformed)
}

/// A frame by its number.
pub(super) fn frame_number(text: &str) -> Result<FrameIndex, Refusal> {
    text.parse().map_err(|_| Refusal::malformed(format!("{text:?} is no number of a frame")))
}

/// `GET /api/v1/shots`
pub(super) async fn list(State(desk): State<Arc<Desk>>, Query(window): Query<Window>) -> Answer {
    let board = desk.board();
    Ok(Json(list_json(&board, &window)?))
}

/// A page of the list of shots, as JSON.
pub(super) fn list_json(board: &Board, window: &Window) -> Result<Value, Refusal> {
    let Page { total, offset, entries } = board.page_of_shots(window)?;
    let entries: Vec<&ShotView> = entries.iter().map(Arc::as_ref).collect();
    Ok(json!({"total": total, "offset": offset, "shots": entries}))
}

/// `GET /api/v1/shots/{shot}`
pub(super) async fn one(State(desk): State<Arc<Desk>>, Path(shot): Path<String>) -> Answer {
    let board = desk.board();
    let shot = board.shot(shot_id(&shot)?)?;
    Ok(Json(json!(shot.as_ref())))
}

/// A key in the address, where there are no headers.
#[derive(Deserialize)]
pub(super) struct Keyed {
    idempotency_key: Option<String>,
}

impl Keyed {
    /// The key of a submission, by header or by address.
    fn key(self, headers: &HeaderMap) -> Result<Option<String>, Refusal> {
        let Some(header) = headers.get(KEY_HEADER) else { return Ok(self.idempotency_key) };
        let text = header.to_str().map_err(|_| Refusal::malformed("the Idempotency-Key is odd"))?;
        // Some write it as a string of structured headers.
        let bare = text.strip_prefix('"').and_then(|text| text.strip_suffix('"'));
        let key = bare.unwrap_or(text).to_owned();
        match self.idempotency_key {
            Some(other) if other != key => {
                Err(Refusal::malformed("the header and the address have different keys"))
            }
            _ => Ok(Some(key)),
        }
    }
}

/// `POST /api/v1/shots`
pub(super) async fn submit(
    State(desk): State<Arc<Desk>>,
    Query(keyed): Query<Keyed>,
    headers: HeaderMap,
    body: Bytes,
) -> Answer {
    let queue = desk.queue()?;
    let key = keyed.key(&headers)?;
    // A million cameras take a second to read: not on a thread that others wait for.
    let read = tokio::task::spawn_blocking(move || {
        let key = key.map(|key| SubmissionKey::new(&key, &body)).transpose()?;
        let plan = serde_json::from_slice::<ShotPlan>(&body);
        let plan = plan.map_err(|why| Refusal::malformed(format!("this is no shot: {why}")))?;
        Ok::<_, Refusal>((plan, key))
    });
    let read = read.await.map_err(|_| Refusal::malformed("the shot cannot be read"))?;
    let shot = match read? {
        (plan, Some(key)) => queue.submit_once(plan, key).await?,
        (plan, None) => queue.submit(plan).await?,
    };
    Ok(Json(json!({ "shot": shot })))
}

/// `POST /api/v1/blobs/missing`
pub(super) async fn missing_blobs(State(desk): State<Arc<Desk>>, body: Bytes) -> Answer {
    let queue = desk.queue()?;
    let texts: Vec<String> = serde_json::from_slice(&body)
        .map_err(|why| Refusal::malformed(format!("this is no list of hashes: {why}")))?;
    let hashes = texts.iter().map(|text| hash(text)).collect::<Result<Vec<_>, _>>()?;
    let missing = queue.missing_blobs(hashes).await?;
    let missing: Vec<_> = missing.into_iter().map(BlobHash::to_hex).collect();
    Ok(Json(json!({ "missing": missing })))
}

/// `PUT /api/v1/blobs/{hash}`
pub(super) async fn put_blob(
    State(desk): State<Arc<Desk>>,
    Path(name): Path<String>,
    body: Bytes,
) -> Answer {
    let (hash, bytes) = (hash(&name)?, body.len());
    desk.queue()?.put_blob(hash, body).await?;
    Ok(Json(json!({ "bytes": bytes })))
}

fn hash(text: &str) -> Result<BlobHash, Refusal> {
    parse_hash(text).ok_or_else(|| Refusal::malformed("a hash has 64 hexadecimal digits"))
}

/// Has a body wait until there is memory for it. What came over the link has its share already.
pub(super) async fn within_budget(
    State(desk): State<Arc<Desk>>,
    request: Request,
    next: Next,
) -> Response {
    if request.extensions().get::<Paid>().is_some() {
        return next.run(request).await;
    }
    // A body of which nobody says how long it is may be as long as any.
    let length = request.body().size_hint().upper().unwrap_or(u64::MAX);
    let length = usize::try_from(length).unwrap_or(usize::MAX).min(DESK_BODY_MAX);
    match desk.budget.claim(length).await {
        Some(_claim) => next.run(request).await,
        None => Refusal::busy(desk.budget.patience()).into_response(),
    }
}

/// What came of an order, as JSON.
async fn done(desk: &Desk, order: Order) -> Answer {
    Ok(Json(json!({"done": desk.order(order).await?})))
}

/// `POST /api/v1/shots/{shot}/pause`
pub(super) async fn pause(State(desk): State<Arc<Desk>>, Path(shot): Path<String>) -> Answer {
    done(&desk, Order::Pause(shot_id(&shot)?)).await
}

/// `POST /api/v1/shots/{shot}/resume`
pub(super) async fn resume(State(desk): State<Arc<Desk>>, Path(shot): Path<String>) -> Answer {
    done(&desk, Order::Resume(shot_id(&shot)?)).await
}

/// `POST /api/v1/shots/{shot}/cancel`
pub(super) async fn cancel(State(desk): State<Arc<Desk>>, Path(shot): Path<String>) -> Answer {
    done(&desk, Order::Cancel(shot_id(&shot)?)).await
}

/// The body of a change of priority.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Priority {
    priority: i32,
}

/// `PUT /api/v1/shots/{shot}/priority`
pub(super) async fn priority(
    State(desk): State<Arc<Desk>>,
    Path(shot): Path<String>,
    body: Bytes,
) -> Answer {
    let Priority { priority } = serde_json::from_slice(&body).map_err(|why| {
        Refusal::malformed(format!("a priority is written {{\"priority\": 5}}: {why}"))
    })?;
    done(&desk, Order::Prioritise(shot_id(&shot)?, priority)).await
}

/// `POST /api/v1/shots/{shot}/workers/{worker}/unblock`
pub(super) async fn unblock(
    State(desk): State<Arc<Desk>>,
    Path((shot, worker)): Path<(String, String)>,
) -> Answer {
    done(&desk, Order::Clear(worker_id(&worker)?, Some(shot_id(&shot)?))).await
}

/// `GET /api/v1/shots/{shot}/frames/{frame}/why`
pub(super) async fn why(
    State(desk): State<Arc<Desk>>,
    Path((shot, frame)): Path<(String, String)>,
) -> Answer {
    let (shot, frame) = (shot_id(&shot)?, frame_number(&frame)?);
    let why = desk.order(Order::Why(shot, frame)).await?;
    Ok(Json(json!({"shot": shot, "frame": frame, "why": why})))
}
