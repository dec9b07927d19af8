//! Messages that move terrain: tiles and indices of stores, by hash.
//!
//! The coordinator passes blobs on without looking inside. The receiver hashes what it
//! got; a blob of another hash is as good as none.

use super::{Body, Unfit, fit_reason, own_twin};
use crate::limits::WANT_BLOBS_MAX;
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use terrafarm_common::id::BlobHash;

/// Asks for blobs. Each is answered by one [`Blob`] or one [`NoBlob`], in any order.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct WantBlobs {
    /// At least one, at most [`WANT_BLOBS_MAX`].
    pub hashes: Vec<BlobHash>,
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
