//! The judge's own books of who has said something, and when somebody waits for it.

use crate::event::Micros;
use std::collections::BTreeSet;
use std::collections::btree_map::{BTreeMap, Entry};
use terrafarm_common::id::WorkerId;

/// Who was heard when, and since when the live rule holds.
#[derive(Debug)]
pub(crate) struct Silence {
    /// How long the live rule lets a worker be silent, microseconds.
    allowed_us: u64,
    live_since: Option<Micros>,
    heard: BTreeMap<WorkerId, Micros>,
    /// The same, those that were silent longest first.
    by_time: BTreeSet<(Micros, WorkerId)>,
}

impl Silence {
    /// Nobody is there, and nobody waits. No silence is over before a microsecond.
    pub(crate) fn new(allowed_us: u64) -> Self {
        let allowed_us = allowed_us.max(1);
        Silence { allowed_us, live_since: None, heard: BTreeMap::new(), by_time: BTreeSet::new() }
    }

    /// A worker has come.
    pub(crate) fn joined(&mut self, now: Micros, worker: WorkerId) {
        if let Entry::Vacant(unknown) = self.heard.entry(worker) {
            unknown.insert(now);
            self.by_time.insert((now, worker));
        }
    }

    /// A worker that is there has said something.
    pub(crate) fn heard(&mut self, now: Micros, worker: WorkerId) {
        if let Some(heard_at) = self.heard.get_mut(&worker) {
            self.by_time.remove(&(std::mem::replace(heard_at, now), worker));
            self.by_time.insert((now, worker));
        }
    }

    /// A worker is no longer there.
    pub(crate) fn gone(&mut self, worker: WorkerId) {
        if let Some(heard_at) = self.heard.remove(&worker) {
            self.by_time.remove(&(heard_at, worker));
        }
    }

    /// Whether somebody waits now for frames.
    pub(crate) fn live(&mut self, now: Micros, is_live: bool) {
        self.live_since = is_live.then(|| self.live_since.unwrap_or(now));
    }

    /// Whoever owns the scheduler came too late to look: silence counts anew.
    pub(crate) fn overslept(&mut self, now: Micros) {
        self.live_since = self.live_since.map(|_| now);
    }

    /// A worker that should be there no longer, and how long it has been silent by the live
    /// rule, microseconds. It is named once.
    pub(crate) fn overdue(&mut self, now: Micros) -> Option<(WorkerId, u64)> {
        let &(heard_at, worker) = self.by_time.first()?;
        let silent_us = now.since(self.live_since?.max(heard_at));
        if silent_us < self.allowed_us {
            return None;
        }
        self.gone(worker);
        Some((worker, silent_us))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ONE: WorkerId = WorkerId(1);

    #[test]
    fn silence_counts_from_the_last_word_while_somebody_waits() {
        let mut silence = Silence::new(100);
        silence.joined(Micros(0), ONE);
        silence.joined(Micros(50), ONE);
        assert_eq!(silence.overdue(Micros(1000)), None, "nobody waits");
        silence.live(Micros(1000), true);
        silence.live(Micros(1050), true);
        assert_eq!(silence.overdue(Micros(1099)), None);
        silence.heard(Micros(1099), ONE);
        assert_eq!(silence.overdue(Micros(1198)), None);
        silence.overslept(Micros(1200));
        assert_eq!(silence.overdue(Micros(1299)), None);
        assert_eq!(silence.overdue(Micros(1305)), Some((ONE, 105)));
        assert_eq!(silence.overdue(Micros(1305)), None, "named once");
    }

    #[test]
    fn nobody_is_overdue_who_has_gone_or_for_whom_nobody_waits_any_more() {
        let mut silence = Silence::new(100);
        silence.joined(Micros(0), ONE);
        silence.joined(Micros(0), WorkerId(2));
        silence.live(Micros(0), true);
        silence.gone(ONE);
        assert_eq!(silence.overdue(Micros(100)), Some((WorkerId(2), 100)));
        silence.joined(Micros(100), ONE);
        silence.live(Micros(150), false);
        assert_eq!(silence.overdue(Micros(500)), None);
        silence.live(Micros(500), true);
        assert_eq!(silence.overdue(Micros(599)), None);
    }
}
