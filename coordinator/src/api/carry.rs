//! The API over an encrypted link: a request of the wire is given to the same router.
//!
//! Who comes this way has proved the farm token, so nothing of `access` applies. Answers
//! are whole messages: what is longer than one is fetched by range.

use axum::Router;
use axum::body::{Body, to_bytes};
use axum::http::{HeaderMap, Method, StatusCode, header};
use bytes::Bytes;
use terrafarm_wire::limits::DESK_BODY_MAX;
use terrafarm_wire::message::{Request, Response, Verb};
use tower::ServiceExt;

/// Longest body of one answer, bytes. More is for ranges, so that a desk that asks for a film
/// does not have the coordinator keep it in memory.
const ANSWER_BYTES_MAX: usize = 32 << 20;
const _: () = assert!(ANSWER_BYTES_MAX <= DESK_BODY_MAX);

/// Answers one request.
pub(crate) async fn answer(router: &Router, request: Request) -> Response {
    let number = request.number;
    let (status, content_type, total, body) = match ask(router, request).await {
        Ok(answered) => answered,
        Err((status, why)) => {
            let body: Bytes = serde_json::json!({ "error": why }).to_string().into();
            (status, "application/json".to_owned(), body.len() as u64, body)
        }
    };
    Response { number, status: status.as_u16(), content_type, total, body }
}

type Refused = (StatusCode, String);

async fn ask(
    router: &Router,
    request: Request,
) -> Result<(StatusCode, String, u64, Bytes), Refused> {
    let method = match request.verb {
        Verb::Get => Method::GET,
        Verb::Post => Method::POST,
        Verb::Put => Method::PUT,
    };
    let mut asked = axum::http::Request::builder().method(method).uri(&request.path);
    if let Some((first, length)) = request.range {
        let last = first.saturating_add(length - 1);
        asked = asked.header(header::RANGE, format!("bytes={first}-{last}"));
    }
    let asked = asked
        .header(header::CONTENT_LENGTH, request.body.len())
        .body(Body::from(request.body))
        .map_err(|why| (StatusCode::BAD_REQUEST, format!("that is no path: {why}")))?;
    let answered = match router.clone().oneshot(asked).await {
        Ok(answered) => answered,
        Err(never) => match never {},
    };
    let (head, body) = answered.into_parts();
    let length = number(&head.headers, header::CONTENT_LENGTH);
    if length.is_some_and(|length| length > ANSWER_BYTES_MAX as u64) {
        let text = format!("longer than {ANSWER_BYTES_MAX} bytes; ask for it by range");
        return Err((StatusCode::PAYLOAD_TOO_LARGE, text));
    }
    let body = to_bytes(body, ANSWER_BYTES_MAX)
        .await
        .map_err(|why| (StatusCode::INTERNAL_SERVER_ERROR, format!("cannot be read: {why}")))?;
    let content_type = text(&head.headers, header::CONTENT_TYPE).unwrap_or_default().to_owned();
    let total = text(&head.headers, header::CONTENT_RANGE)
        .and_then(|place| place.rsplit_once('/'))
        .and_then(|(_, total)| total.parse().ok());
    Ok((head.status, content_type, total.unwrap_or(body.len() as u64), body))
}

fn text(headers: &HeaderMap, name: header::HeaderName) -> Option<&str> {
    headers.get(name).and_then(|value| value.to_str().ok())
}

fn number(headers: &HeaderMap, name: header::HeaderName) -> Option<u64> {
    text(headers, name)?.parse().ok()
}
