//! Memory for bodies: so many bytes of requests and answers are in it at once, over all
//! desks and HTTP connections. Who comes when they are taken waits, and is turned away after a
//! while.
//!
//! | what | at once |
//! |---|---|
//! | bodies above [`SMALL_BYTES`] | `bodies_bytes_max` of the configuration, 512 MiB, together |
//! | smaller ones by HTTP | [`SMALL_AT_ONCE`] |
//! | smaller ones over the link | one a desk, `desks_max` of the configuration |
//!
//! That is 768 MiB in all; a body that is read or parsed takes about its length once more.

use std::sync::Arc;
use std::time::Duration;
use terrafarm_wire::limits::PART_BYTES;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// Up to so many bytes, a body is small: over the link, it comes in one piece.
pub(crate) const SMALL_BYTES: usize = PART_BYTES;
/// Small bodies that are taken by HTTP at once.
const SMALL_AT_ONCE: usize = 128;

/// What bodies may take of memory. Clones share it.
#[derive(Debug, Clone)]
pub(crate) struct Budget {
    large: Arc<Semaphore>,
    small: Arc<Semaphore>,
    bytes_max: usize,
    patience: Duration,
}

/// A share of the memory, until it is dropped.
#[derive(Debug)]
pub(crate) struct Claim {
    _permit: OwnedSemaphorePermit,
}

impl Budget {
    /// So many bytes, for which a body waits for so long.
    pub fn new(bytes_max: usize, patience: Duration) -> Self {
        let bytes_max = bytes_max.min(u32::MAX as usize);
        let (large, small) = (Semaphore::new(bytes_max), Semaphore::new(SMALL_AT_ONCE));
        Budget { large: Arc::new(large), small: Arc::new(small), bytes_max, patience }
    }

    /// How long a body waits.
    pub fn patience(&self) -> Duration {
        self.patience
    }

    /// Waits for a share of so many bytes; `None` if the time is over. A body that is longer
    /// than all there is gets all there is.
    pub async fn claim(&self, bytes: usize) -> Option<Claim> {
        let (pool, permits) = match bytes {
            0..=SMALL_BYTES => (&self.small, 1),
            _ => (&self.large, bytes.min(self.bytes_max) as u32),
        };
        let turn = pool.clone().acquire_many_owned(permits);
        let permit = tokio::time::timeout(self.patience, turn).await.ok()?.ok()?;
        Some(Claim { _permit: permit })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MIB: usize = 1 << 20;

    #[tokio::test(start_paused = true)]
    async fn bodies_wait_for_their_share_and_small_ones_do_not_wait_for_large_ones() {
        let budget = Budget::new(8 * MIB, Duration::from_secs(60));
        let first = budget.claim(5 * MIB).await.expect("room");
        assert!(budget.claim(4 * MIB).await.is_none(), "3 MiB are left");
        assert!(budget.claim(3 * MIB).await.is_some());
        assert!(budget.claim(MIB).await.is_some(), "it is small");
        let (waited, ()) = tokio::join!(budget.claim(usize::MAX), async { drop(first) });
        let all = waited.expect("all of it, when it is free");
        assert!(budget.claim(2 * MIB).await.is_none());
        drop(all);
    }
}
