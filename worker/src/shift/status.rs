//! What a shift tells of itself, for people to see: caches, gifts to others, threads.

use super::{Shift, Site};
use crate::render::Caster;
use std::sync::atomic::Ordering;
use std::time::Duration;
use terrafarm_wire::link::Outbox;
use terrafarm_wire::message::Status;
use tokio::time::{Interval, MissedTickBehavior, interval};

/// How often the coordinator may be told how this worker is off.
const STATUS_EVERY: Duration = Duration::from_secs(1);

/// When to look at it.
pub(super) fn looks() -> Interval {
    let mut looks = interval(STATUS_EVERY);
    looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    looks
}

impl<C: Caster> Site<C> {
    /// Blobs that came or lay damaged, and bytes given to others, since the worker started.
    pub(super) fn damaged_and_given(&self) -> [u64; 2] {
        let on_disk = self.cache.as_ref().map_or(0, |cache| cache.damaged());
        let damaged = self.damaged + on_disk + self.others.damaged();
        [damaged, self.given_bytes.load(Ordering::Relaxed)]
    }
}

impl<C: Caster> Shift<'_, C> {
    /// Says how this worker is off, if that has changed. Nothing waits for it.
    pub(super) fn tell_status(&mut self, outbox: &Outbox) {
        let site = &*self.site;
        let [damaged, given_bytes] = site.damaged_and_given();
        let status = Status {
            memory_bytes: site.terrain.bytes(),
            memory_limit_bytes: site.terrain.limit_bytes(),
            disk_bytes: site.cache.as_ref().map_or(0, |cache| cache.total_bytes()),
            disk_limit_bytes: site.cache.as_ref().map_or(0, |cache| cache.limit_bytes()),
            damaged: damaged - self.before[0],
            given_bytes: given_bytes - self.before[1],
            threads_allowed: site.gate.threads().min(site.pool.current_num_threads()) as u32,
        };
        if self.told != Some(status) && outbox.try_send(status).is_ok() {
            self.told = Some(status);
        }
    }
}
