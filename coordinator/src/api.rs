//! The coordinator's JSON API and its page: one router, two carriers.
//!
//! `docs/API.md` documents every route. `serve.rs` carries it by HTTP, for the
//! page, scripts and Prometheus; `carry` over the encrypted link, for the command line.
//! Everything here reads views and passes orders on: it decides nothing about the farm.
//!
//! | module | what |
//! |---|---|
//! | `board` | the shots and workers that there are, chosen and in order |
//! | `shots`, `workers`, `files`, `live`, `metrics`, `page` | the routes |
//! | `refusal` | errors, as JSON with a status |
//! | `budget` | memory for bodies |
//! | `access` | who may ask by HTTP: hosts, origins, keys |
//! | `serve`, `carry` | the two carriers |

mod access;
mod board;
mod budget;
mod carry;
mod files;
mod live;
mod metrics;
mod page;
mod range;
mod refusal;
mod serve;
mod shots;
mod workers;

pub use access::{Access, WebKey};
pub use serve::Web;

pub(crate) use budget::Budget;
pub(crate) use carry::Link;
pub(crate) use serve::serve;

use crate::driver::FarmLine;
use crate::order::Order;
use crate::queue::{Queue, QueueError};
use crate::thumbnails::Thumbnails;
use axum::Router;
use axum::extract::{DefaultBodyLimit, Request};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post, put};
use board::Board;
use refusal::Refusal;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use terrafarm_wire::limits::{BLOB_BYTES_MAX, DESK_BODY_MAX};
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;

/// Longest body of an order, bytes.
const ORDER_BYTES_MAX: usize = 4 << 10;
/// Longest list of blobs, bytes.
const HASHES_BYTES_MAX: usize = 8 << 20;
/// Pictures that are read from the disk and made small at once: the largest takes 0.8 GB.
const PREVIEWS_AT_ONCE: usize = 2;
/// How long an order may take, its body included.
const ORDER_LIMIT: Duration = Duration::from_secs(30);
/// How long a long body may take to come.
const BULKY_LIMIT: Duration = Duration::from_secs(600);

/// What the routes know.
pub struct Desk {
    name: String,
    farm: FarmLine,
    queue: Option<Queue>,
    thumbnails: Arc<Thumbnails>,
    stop: CancellationToken,
    board: Mutex<Option<Arc<Board>>>,
    budget: Budget,
    previews: Arc<Semaphore>,
    streams: Arc<Semaphore>,
}

impl Desk {
    /// The desk of a farm, and of its queue if it has one. `stop` is cancelled when the
    /// coordinator stops.
    pub(crate) fn new(
        name: &str,
        farm: FarmLine,
        queue: Option<Queue>,
        thumbnails: Arc<Thumbnails>,
        budget: Budget,
        stop: CancellationToken,
    ) -> Arc<Self> {
        Arc::new(Desk {
            name: name.to_owned(),
            farm,
            queue,
            thumbnails,
            stop,
            board: Mutex::default(),
            budget,
            previews: Arc::new(Semaphore::new(PREVIEWS_AT_ONCE)),
            streams: Arc::new(Semaphore::new(live::STREAMS_MAX)),
        })
    }

    /// Has an order carried out: by the queue if it is about a shot of it, else by the farm.
    async fn order(&self, order: Order) -> Result<String, Refusal> {
        if let Some(queue) = &self.queue {
            match queue.order(order).await {
                Err(QueueError::NoShot(_)) => {}
                answered => return Ok(answered?),
            }
        }
        Ok(self.farm.order(order).await?)
    }

    /// The queue.
    fn queue(&self) -> Result<&Queue, Refusal> {
        self.queue.as_ref().ok_or_else(Refusal::no_queue)
    }
}

/// Every route that both carriers have.
pub(crate) fn router(desk: Arc<Desk>) -> Router {
    let orders = Router::new()
        .route("/healthz", get(metrics::health))
        .route("/metrics", get(metrics::metrics))
        .route("/api/v1/farm", get(workers::farm))
        .route("/api/v1/workers", get(workers::list))
        .route("/api/v1/workers/{worker}/drain", post(workers::drain))
        .route("/api/v1/workers/{worker}/clear", post(workers::clear))
        .route("/api/v1/shots", get(shots::list))
        .route("/api/v1/shots/{shot}", get(shots::one))
        .route("/api/v1/shots/{shot}/pause", post(shots::pause))
        .route("/api/v1/shots/{shot}/resume", post(shots::resume))
        .route("/api/v1/shots/{shot}/cancel", post(shots::cancel))
        .route("/api/v1/shots/{shot}/priority", put(shots::priority))
        .route("/api/v1/shots/{shot}/workers/{worker}/unblock", post(shots::unblock))
        .route("/api/v1/shots/{shot}/frames/{frame}", get(files::frame))
        .route("/api/v1/shots/{shot}/frames/{frame}/why", get(shots::why))
        .route("/api/v1/shots/{shot}/last.jpg", get(files::last))
        .route("/api/v1/shots/{shot}/manifest.json", get(files::manifest))
        .route("/api/v1/shots/{shot}/film.mp4", get(files::film))
        .layer(DefaultBodyLimit::max(ORDER_BYTES_MAX))
        .layer(middleware::from_fn(|request, next| in_time(ORDER_LIMIT, request, next)));
    let bulky = Router::new()
        .route(
            "/api/v1/blobs/missing",
            post(shots::missing_blobs).layer(DefaultBodyLimit::max(HASHES_BYTES_MAX)),
        )
        .route(
            "/api/v1/blobs/{hash}",
            put(shots::put_blob).layer(DefaultBodyLimit::max(BLOB_BYTES_MAX)),
        )
        .route("/api/v1/shots", post(shots::submit).layer(DefaultBodyLimit::max(DESK_BODY_MAX)))
        .layer(middleware::from_fn_with_state(desk.clone(), shots::within_budget))
        .layer(middleware::from_fn(|request, next| in_time(BULKY_LIMIT, request, next)));
    orders
        .merge(bulky)
        .fallback(|| async { Refusal::no_route() })
        .with_state(desk)
        .layer(middleware::from_fn(refusal::in_json))
}

/// Ends a request that takes too long. Bodies of answers may take as long as they like.
async fn in_time(limit: Duration, request: Request, next: Next) -> Response {
    let answered = tokio::time::timeout(limit, next.run(request)).await;
    answered.unwrap_or_else(|_| Refusal::too_slow(limit).into_response())
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::body::Body;
    use axum::http::{StatusCode, header};
    use tower::ServiceExt;

    #[tokio::test(start_paused = true)]
    async fn a_long_body_for_which_there_is_no_memory_is_refused_with_when_to_come_back() {
        let budget = Budget::new(4 << 20, Duration::from_secs(60));
        let (farm, stop) = (FarmLine::to_nobody(), CancellationToken::new());
        let desk = Desk::new("test", farm, None, Arc::default(), budget.clone(), stop);
        let routes = router(desk);
        let post = async |length: usize| {
            let body = Body::from(vec![b' '; length]);
            let request = Request::post("/api/v1/shots").body(body).expect("a request");
            routes.clone().oneshot(request).await.expect("an answer")
        };
        let others = budget.claim(3 << 20).await.expect("room");
        let refused = post(2 << 20).await;
        assert_eq!(refused.status(), StatusCode::SERVICE_UNAVAILABLE);
        assert_eq!(refused.headers()[header::RETRY_AFTER], "5");
        // There is no queue: that is an answer.
        assert_eq!(post(1000).await.status(), StatusCode::NOT_IMPLEMENTED);
        drop(others);
        assert_eq!(post(2 << 20).await.status(), StatusCode::NOT_IMPLEMENTED);
    }
}
