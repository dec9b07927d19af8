//! Identities. All are plain numbers on the wire; none is ever reused within a run.

use serde::{Deserialize, Serialize};
use std::fmt;

macro_rules! number_id {
    ($(#[$doc:meta])* $name:ident, $letter:literal) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        pub struct $name(pub u64);

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, concat!($letter, "{}"), self.0)
            }
        }
    };
}

number_id!(
    /// One submitted flight or live session.
    ShotId,
    "shot-"
);
number_id!(
    /// One connection of a worker; a worker that comes back gets a new one.
    WorkerId,
    "worker-"
);
number_id!(
    /// One job granted to one worker. A number is used once, so it doubles as the
    /// fencing epoch: a result under a lease that is no longer held is refused.
    LeaseId,
    "lease-"
);

/// Index of a frame within its shot, from 0.
pub type FrameIndex = u32;

/// The most frames of one shot: twelve hours at 24 a second. A longer flight is rendered in
/// parts.
pub const MAX_SHOT_FRAMES: u32 = 1 << 20;

/// SHA-256 of a blob: the identity of a terrain tile or of a store's index.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct BlobHash(pub [u8; 32]);

impl BlobHash {
    /// Lower-case hexadecimal, 64 characters: also the file name in a worker's cache.
    pub fn to_hex(self) -> String {
        self.0.iter().map(|byte| format!("{byte:02x}")).collect()
    }
}

impl fmt::Debug for BlobHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl fmt::Display for BlobHash {
    /// The first 12 hexadecimal digits: enough to tell blobs apart in a message.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for byte in &self.0[..6] {
            write!(f, "{byte:02x}")?;
        }
        Ok(())
    }
}
