//! Equals get equal parts of the farm.
//!
//! Of the shots of one priority that have something to grant, the one that has been served
//! least is next: start-time fair queuing (Goyal, Vin, Cheng, SIGCOMM 1996), with work in
//! the place of bytes. A job is charged to its shot as it is granted, by what it is expected
//! to cost, and put right when it ends. So shares are of what the workers can do, not of
//! the number of jobs or frames: a shot of costly frames gets fewer of them.
//!
//! A shot that could not take its share (new, paused, its frames not taken) does not get it
//! afterwards, but for a moment: [`LAG_US`].
//!
//! Priorities are strict. A shot of a higher one gets every worker that it can use, and
//! one of a lower one starves for as long as that takes: that is what priorities are for.

use crate::lease::Lease;
use crate::scheduler::Scheduler;
use crate::shot::{ReadyKey, Shot};
use std::cmp::Reverse;
use terrafarm_common::id::ShotId;

/// What a shot may be owed that has had nothing to grant for a moment: the work of the whole
/// farm in so many microseconds.
const LAG_US: f64 = 1e6;

impl Scheduler {
    /// Brings a shot's place among the ready ones up to date.
    pub(crate) fn refresh_ready(&mut self, shot: ShotId) {
        let Some(known) = self.shots.get(&shot) else { return };
        match (known.ready.is_some(), known.has_work()) {
            (false, true) => {
                self.catch_up(shot, LAG_US * self.active_speed);
                if let Some(known) = self.shots.get_mut(&shot) {
                    let key = key(shot, known);
                    known.ready = Some(key);
                    self.ready.insert(key);
                }
                self.unpark();
            }
            (true, false) => self.unready(shot),
            _ => {}
        }
    }

    /// Takes a shot out of the ready ones.
    pub(crate) fn unready(&mut self, shot: ShotId) {
        let key = self.shots.get_mut(&shot).and_then(|known| known.ready.take());
        if let Some(key) = key {
            self.ready.remove(&key);
        }
    }

    /// Lets a shot count as served like the least served of its equals, but for `credit`:
    /// what it did not take before is not owed to it.
    pub(crate) fn catch_up(&mut self, shot: ShotId, credit: f64) {
        let Some(priority) = self.shots.get(&shot).map(|known| known.priority) else { return };
        let others = self
            .shots
            .iter()
            .filter(|&(&id, other)| id != shot && other.priority == priority && !other.is_paused);
        let least = others.map(|(_, other)| other.served).reduce(f64::min);
        if let (Some(least), Some(known)) = (least, self.shots.get_mut(&shot)) {
            known.served = known.served.max(least - credit);
        }
    }

    /// Charges work to a shot, cost units; gives it back if negative.
    pub(crate) fn charge(&mut self, shot: ShotId, work: f64) {
        let Some(known) = self.shots.get_mut(&shot) else { return };
        known.served = (known.served + work).max(0.0);
        if let Some(before) = known.ready {
            let key = key(shot, known);
            known.ready = Some(key);
            self.ready.remove(&before);
            self.ready.insert(key);
        }
    }

    /// What a lease has cost that ends without a result, cost units. Nobody pays for a
    /// worker that hangs.
    pub(crate) fn spent(&self, lease: &Lease, was_begun: bool, since_us: u64) -> f64 {
        let speed = self.workers.get(&lease.worker).map_or(0.0, |worker| worker.speed.value());
        let spent = if was_begun { since_us as f64 * speed } else { 0.0 };
        spent.min(lease.cost)
    }
}

fn key(id: ShotId, shot: &Shot) -> ReadyKey {
    // Whole microseconds of a thread are fine enough.
    (Reverse(shot.priority), shot.served as u64, id)
}
