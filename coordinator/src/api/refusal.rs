//! What is answered instead of what was asked for: `{"error": "..."}` and a status.

use crate::order::OrderError;
use crate::queue::QueueError;
use axum::Json;
use axum::body::{Body, to_bytes};
use axum::extract::Request;
use axum::http::{HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use serde_json::json;
use std::time::Duration;

/// Longest text of a refusal that is passed on, bytes.
const TEXT_BYTES_MAX: usize = 4 << 10;

/// Why a request is not carried out.
#[derive(Debug)]
pub(super) struct Refusal {
    status: StatusCode,
    text: String,
    /// Blobs that have to be sent first.
    missing: Vec<String>,
    /// When to try again.
    retry_after_s: Option<u64>,
}

impl Refusal {
    /// With this status and these words.
    pub fn new(status: StatusCode, text: impl Into<String>) -> Self {
        Refusal { status, text: text.into(), missing: Vec::new(), retry_after_s: None }
    }

    /// What was sent makes no sense.
    pub fn malformed(text: impl Into<String>) -> Self {
        Refusal::new(StatusCode::BAD_REQUEST, text)
    }

    /// What was asked for does not exist, or not yet.
    pub fn not_there(text: impl Into<String>) -> Self {
        Refusal::new(StatusCode::NOT_FOUND, text)
    }

    /// Unknown path.
    pub fn no_route() -> Self {
        Refusal::not_there("there is nothing at this address; docs/API.md lists what there is")
    }

    /// The coordinator has no queue.
    pub fn no_queue() -> Self {
        let text = "this coordinator keeps no queue; start it with --data FOLDER (or TERRAFARM_DATA), \
                    or have the shot rendered while you wait: terrafarm render --coordinator";
        Refusal::new(StatusCode::NOT_IMPLEMENTED, text)
    }

    /// There is no memory for its body.
    pub fn busy(waited: Duration) -> Self {
        let text = format!(
            "others send so much that there was no room for this for {} s; try again",
            waited.as_secs()
        );
        Refusal {
            retry_after_s: Some(RETRY_AFTER_S),
            ..Refusal::new(StatusCode::SERVICE_UNAVAILABLE, text)
        }
    }

    /// It took too long.
    pub fn too_slow(limit: Duration) -> Self {
        let text = format!("not done within {} s; try again", limit.as_secs());
        Refusal::new(StatusCode::REQUEST_TIMEOUT, text)
    }
}

/// When to try again after [`Refusal::busy`], seconds.
const RETRY_AFTER_S: u64 = 5;

impl IntoResponse for Refusal {
    fn into_response(self) -> Response {
        let Refusal { status, text, missing, retry_after_s } = self;
        let mut body = json!({ "error": text });
        if !missing.is_empty() {
            body["missing"] = missing.into();
        }
        let mut response = (status, Json(body)).into_response();
        if let Some(seconds) = retry_after_s {
            response.headers_mut().insert(header::RETRY_AFTER, seconds.into());
        }
        response
    }
}

impl From<OrderError> for Refusal {
    fn from(why: OrderError) -> Self {
        let status = match why {
            OrderError::Stopping => StatusCode::SERVICE_UNAVAILABLE,
            _ => StatusCode::NOT_FOUND,
        };
        Refusal::new(status, why.to_string())
    }
}

impl From<QueueError> for Refusal {
    fn from(why: QueueError) -> Self {
        let text = why.to_string();
        let status = match why {
            QueueError::Order(order) => return order.into(),
            QueueError::Missing(hashes) => {
                let missing = hashes.into_iter().map(|hash| hash.to_hex()).collect();
                return Refusal { missing, ..Refusal::new(StatusCode::CONFLICT, text) };
            }
            QueueError::NoShot(_) | QueueError::NoFrame { .. } => StatusCode::NOT_FOUND,
            QueueError::Unfit(_) | QueueError::WrongBlob { .. } => StatusCode::BAD_REQUEST,
            QueueError::TooMany(_) => StatusCode::PAYLOAD_TOO_LARGE,
            QueueError::KeyReused { .. } => StatusCode::UNPROCESSABLE_ENTITY,
            QueueError::Over { .. } => StatusCode::CONFLICT,
            QueueError::Full | QueueError::DiskFull { .. } => StatusCode::INSUFFICIENT_STORAGE,
            QueueError::Stopping => StatusCode::SERVICE_UNAVAILABLE,
            QueueError::Broken
            | QueueError::Locked { .. }
            | QueueError::Io { .. }
            | QueueError::Ledger { .. } => StatusCode::INTERNAL_SERVER_ERROR,
        };
        Refusal::new(status, text)
    }
}

/// Refusals of the framework are plain text: makes them JSON, like all others.
pub(super) async fn in_json(request: Request, next: Next) -> Response {
    let response = next.run(request).await;
    let status = response.status();
    if !(status.is_client_error() || status.is_server_error()) || is_json(&response) {
        return response;
    }
    let (parts, body) = response.into_parts();
    let text = text_of(body).await;
    let text = if text.is_empty() {
        status.canonical_reason().unwrap_or("refused").to_lowercase()
    } else {
        text
    };
    let mut refused = Refusal::new(status, text).into_response();
    // Such as which methods a route has, or what range a file has.
    for (name, value) in &parts.headers {
        if name != header::CONTENT_TYPE && name != header::CONTENT_LENGTH {
            refused.headers_mut().append(name, value.clone());
        }
    }
    refused
}

fn is_json(response: &Response) -> bool {
    let json = HeaderValue::from_static("application/json");
    response.headers().get(header::CONTENT_TYPE) == Some(&json)
}

async fn text_of(body: Body) -> String {
    let bytes = to_bytes(body, TEXT_BYTES_MAX).await.unwrap_or_default();
    String::from_utf8_lossy(&bytes).into_owned()
}
