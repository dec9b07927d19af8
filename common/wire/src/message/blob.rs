//! Messages that move terrain: tiles and indices of stores, by hash.
//!
//! The coordinator passes blobs on without looking inside. The receiver hashes what it
//! got; a blob of another hash is as good as none.
//!
//! Where the coordinator's links are the limit, workers serve each other: a worker that
//! listens says so by [`Sharing`], and the coordinator may answer a question by
//! [`Elsewhere`]. Between two workers only [`WantBlobs`], [`Blob`] and [`NoBlob`] travel.

use super::{Body, Unfit, fit_reason, own_twin};
use crate::limits::{ELSEWHERE_MAX, WANT_BLOBS_MAX};
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use std::net::SocketAddr;
use terrafarm_common::id::BlobHash;

/// Asks for blobs. Each is answered by one [`Blob`], one [`NoBlob`] or one [`Elsewhere`], in
/// any order.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct WantBlobs {
    /// At least one, at most [`WANT_BLOBS_MAX`].
    pub hashes: Vec<BlobHash>,
    /// Whether [`Elsewhere`] is an answer. It is none after other workers have failed, or if
    /// what they gave is damaged.
    pub elsewhere: bool,
}

impl Body for WantBlobs {
    own_twin!();

    fn check(&self) -> Result<(), Unfit> {
        let fits = (1..=WANT_BLOBS_MAX).contains(&self.hashes.len());
        Unfit::unless(fits, "the number of blobs asked for is out of range")
    }
}

/// One blob. The bytes travel behind the message.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Blob {
    /// What was asked for.
    pub hash: BlobHash,
    /// What was found.
    #[serde(skip)]
    pub bytes: Bytes,
}

impl Body for Blob {
    own_twin!();

    fn payload(&self) -> Bytes {
        self.bytes.clone()
    }

    fn set_payload(&mut self, payload: Bytes) {
        self.bytes = payload;
    }
}

/// There is no such blob, and asking again does not help.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct NoBlob {
    /// What was asked for.
    pub hash: BlobHash,
    /// Why there is none.
    pub why: String,
}

impl Body for NoBlob {
    own_twin!();

    fn check(&self) -> Result<(), Unfit> {
        fit_reason(&self.why)
    }
}

/// Other workers have the blob, and the coordinator's links have enough to do. Whoever gets
/// nothing there asks again, here.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Elsewhere {
    /// What was asked for.
    pub hash: BlobHash,
    /// Where to ask, best first: at least one, at most [`ELSEWHERE_MAX`]. The scope of an IPv6
    /// address means nothing on another PC and does not travel.
    pub workers: Vec<SocketAddr>,
}

impl Body for Elsewhere {
    own_twin!();

    fn check(&self) -> Result<(), Unfit> {
        let fits = (1..=ELSEWHERE_MAX).contains(&self.workers.len());
        Unfit::unless(fits, "the number of other workers is out of range")?;
        let ported = self.workers.iter().all(|worker| worker.port() != 0);
        Unfit::unless(ported, "a worker listens at no port")
    }
}

/// A worker gives its blobs to other workers of the farm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Sharing {
    /// The TCP port at which it does, on the address that it connects from; never 0.
    pub port: u16,
}

impl Body for Sharing {
    own_twin!();

    fn check(&self) -> Result<(), Unfit> {
        Unfit::unless(self.port != 0, "a worker listens at no port")
    }
}
