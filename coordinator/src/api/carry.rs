//! The API over an encrypted link: a request of the wire is given to the same router.
//!
//! Who comes this way has proved the farm token, so nothing of `access` applies. Answers
//! are whole messages: what is longer than one is fetched by range. Long bodies, of requests
//! and of answers, have a share of the memory while they are there.

use super::budget::{Budget, Claim, SMALL_BYTES};
use super::{Desk, router};
use axum::Router;
use axum::body::{Body, to_bytes};
use axum::http::{HeaderMap, Method, StatusCode, header};
use bytes::Bytes;
use std::sync::Arc;
use terrafarm_wire::limits::DESK_BODY_MAX;
use terrafarm_wire::message::{Request, Response, Verb};
use tower::ServiceExt;

/// Longest body of one answer, bytes. More is for ranges, so that a desk that asks for a film
/// does not have the coordinator keep it in memory.
const ANSWER_BYTES_MAX: usize = 32 << 20;
const _: () = assert!(ANSWER_BYTES_MAX <= DESK_BODY_MAX);

/// Says that a body has its share of the memory.
#[derive(Debug, Clone, Copy)]
pub(super) struct Paid;

/// The API for those who come over the link. Clones answer the same.
#[derive(Clone)]
pub(crate) struct Link {
    router: Router,
    budget: Budget,
}

impl Link {
    /// The API of a desk.
    pub fn new(desk: Arc<Desk>) -> Self {
        let budget = desk.budget.clone();
        Link { router: router(desk), budget }
    }

    /// Waits for memory for a body of this length, bytes; `None` if there is none for long.
    pub async fn claim(&self, bytes: usize) -> Option<Claim> {
        self.budget.claim(bytes).await
    }

    /// Answers one request, whose body has this share of the memory. The answer has the share
    /// that is given back with it until it is sent.
    pub async fn answer(
        &self,
        request: Request,
        claim: Option<Claim>,
    ) -> (Response, Option<Claim>) {
        let number = request.number;
        let (status, content_type, total, body, claim) = match self.ask(request, claim).await {
            Ok((head, claim)) => (head.0, head.1, head.2, head.3, claim),
            Err((status, why)) => {
                let body: Bytes = serde_json::json!({ "error": why }).to_string().into();
                (status, "application/json".to_owned(), body.len() as u64, body, None)
            }
        };
        (Response { number, status: status.as_u16(), content_type, total, body }, claim)
    }

    async fn ask(
        &self,
        request: Request,
        claim: Option<Claim>,
    ) -> Result<(Answered, Option<Claim>), Refused> {
        let answered = run(&self.router, request).await?;
        // The body of the request has been read. Nobody holds a share and waits for another.
        drop(claim);
        let length = number(answered.headers(), header::CONTENT_LENGTH);
        let length = length.map_or(0, |length| usize::try_from(length).unwrap_or(usize::MAX));
        if length > ANSWER_BYTES_MAX {
            let text = format!("longer than {ANSWER_BYTES_MAX} bytes; ask for it by range");
            return Err((StatusCode::PAYLOAD_TOO_LARGE, text));
        }
        let claim = match length {
            0..=SMALL_BYTES => None,
            _ => Some(self.budget.claim(length).await.ok_or_else(|| {
                let text = "others fetch so much that there is no room for this now; try again";
                (StatusCode::SERVICE_UNAVAILABLE, text.to_owned())
            })?),
        };
        Ok((read(answered).await?, claim))
    }
}

type Refused = (StatusCode, String);
/// Status, content type, length of the whole content and body.
type Answered = (StatusCode, String, u64, Bytes);

/// Has the router answer a request.
async fn run(router: &Router, request: Request) -> Result<axum::response::Response, Refused> {
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
        .extension(Paid)
        .body(Body::from(request.body))
        .map_err(|why| (StatusCode::BAD_REQUEST, format!("that is no path: {why}")))?;
    match router.clone().oneshot(asked).await {
        Ok(answered) => Ok(answered),
        Err(never) => match never {},
    }
}

/// Reads an answer to its end.
async fn read(answered: axum::response::Response) -> Result<Answered, Refused> {
    let (head, body) = answered.into_parts();
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
