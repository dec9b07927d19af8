//! Messages of the front desk: requests to the coordinator's JSON API over an encrypted
//! link, so that orders need no second address and no second secret.
//!
//! A [`Request`] is what a browser would send by HTTP, a [`Response`] what it would get;
//! the same router answers both. Bodies travel behind the messages.

use super::{Body, Unfit, own_twin};
use crate::limits::{CONTENT_TYPE_BYTES_MAX, PATH_BYTES_MAX};
use bytes::Bytes;
use serde::{Deserialize, Serialize};

/// What a request wants to do. Numbers on the wire: append only.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Verb {
    /// Read.
    Get,
    /// Do or create.
    Post,
    /// Set.
    Put,
}

/// Asks the coordinator for something. Answered by one [`Response`] of the same number;
/// requests of one connection are answered in their order.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Request {
    /// The asker's own number for it.
    pub number: u32,
    /// What to do.
    pub verb: Verb,
    /// Path and query, as after the host name of an address: `/api/v1/shots?limit=10`.
    pub path: String,
    /// The bytes of the answer's content that are wanted: the first, and how many. All if
    /// `None`.
    pub range: Option<(u64, u64)>,
    /// The body: JSON, or a blob.
    #[serde(skip)]
    pub body: Bytes,
}

impl Body for Request {
    own_twin!();

    fn check(&self) -> Result<(), Unfit> {
        let fits = self.path.len() <= PATH_BYTES_MAX && self.path.starts_with('/');
        Unfit::unless(fits, "a path is too long or does not begin with /")?;
        let some = self.range.is_none_or(|(_, length)| length > 0);
        Unfit::unless(some, "a range is empty")
    }

    fn payload(&self) -> Bytes {
        self.body.clone()
    }

    fn set_payload(&mut self, payload: Bytes) {
        self.body = payload;
    }
}

/// The answer to a [`Request`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Response {
    /// The number of the request.
    pub number: u32,
    /// Status as in HTTP: 200 for what is well.
    pub status: u16,
    /// What the body is, as in HTTP.
    pub content_type: String,
    /// How long the whole content is, bytes, of which the body may be a range.
    pub total: u64,
    /// The body.
    #[serde(skip)]
    pub body: Bytes,
}

impl Body for Response {
    own_twin!();

    fn check(&self) -> Result<(), Unfit> {
        Unfit::unless((100..600).contains(&self.status), "a status is out of range")?;
        let fits = self.content_type.len() <= CONTENT_TYPE_BYTES_MAX;
        Unfit::unless(fits, "a content type is too long")
    }

    fn payload(&self) -> Bytes {
        self.body.clone()
    }

    fn set_payload(&mut self, payload: Bytes) {
        self.body = payload;
    }
}
