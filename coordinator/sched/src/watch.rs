//! Who is still there: probes, silence, and how soon it is noticed.
//!
//! Two rules. A worker that has been silent for [`crate::Config::heartbeat_us`] is probed,
//! and dropped after [`crate::Config::silence_us`]: a night loses nothing by five seconds,
//! and a PC that stutters keeps its jobs. While a live shot is under way, somebody waits for
//! each of its frames, and whoever holds a part of one must be there: then the live times
//! hold for all workers, since every worker may be the next to hold one.
//!
//! The live silence counts from the last word, but not from before the live rule began: a
//! worker that nobody has asked for a second has a probe and its time to answer. Nor from
//! before the owner of the machine came late to look, by more than [`OVERSLEPT_US`]: what
//! waited at its door meanwhile has not been read, and a coordinator that stutters must not
//! take its own silence for that of the workers. So a worker that dies is dropped within
//! [`crate::Config::live_silence_us`] and [`OVERSLEPT_US`] after its last word, half a
//! second by default, or the coordinator was later than that itself; the batch rule holds
//! in any case.

use crate::event::{Action, DropReason, Micros};
use crate::scheduler::{Scheduler, Timer};
use crate::shot::Shot;
use terrafarm_common::id::WorkerId;

/// An owner that looks so much later than it was asked to has overslept, microseconds.
pub(crate) const OVERSLEPT_US: u64 = 50_000;

impl Scheduler {
    /// Takes note that a worker lives.
    pub(crate) fn hear(&mut self, worker: WorkerId) {
        if let Some(known) = self.workers.get_mut(&worker) {
            known.heard_at = self.now;
        }
    }

    /// Begins to look after a worker that has just joined. The times are spread, so that
    /// those that joined together are not all probed in one moment.
    pub(crate) fn watch(&mut self, worker: WorkerId) {
        let heartbeat_us = self.heartbeat_us();
        let spread = self.rng.below(heartbeat_us / 4);
        self.look_at(worker, self.now.after(heartbeat_us - spread));
    }

    /// A live shot may have come, ended, been stopped or let go on.
    pub(crate) fn refresh_live(&mut self) {
        let is_live = self.shots.values().any(Shot::is_waited_for);
        match self.live_since {
            // Timers that are too early now find that out by themselves.
            Some(_) if !is_live => self.live_since = None,
            None if is_live => {
                self.live_since = Some(self.now);
                let heard = self.workers.iter().map(|(&id, known)| (id, known.heard_at));
                for (worker, heard_at) in heard.collect::<Vec<_>>() {
                    let at = heard_at.after(self.heartbeat_us()).max(self.now);
                    let before = self.workers.get(&worker).and_then(|known| known.beat_at);
                    self.look_at(worker, before.map_or(at, |before| at.min(before)));
                }
            }
            _ => {}
        }
    }

    /// Whether the owner comes later than it was asked to, and what happened while it did
    /// not look may still wait at its door.
    pub(crate) fn overslept(&self, now: Micros) -> bool {
        self.timers.first().is_some_and(|&(at, _)| now.since(at) > OVERSLEPT_US)
    }

    /// Takes note of the time at which the owner looks.
    pub(crate) fn wake(&mut self, now: Micros) {
        let now = self.now.max(now);
        if self.live_since.is_some() && self.overslept(now) {
            self.live_since = Some(now);
        }
        self.now = now;
    }

    /// Looks whether a worker is still there. A worker that has gone is passed over, so
    /// that nobody has to look for its timer when it goes.
    pub(crate) fn beat(&mut self, worker: WorkerId, at: Micros) {
        let Some(known) = self.workers.get_mut(&worker) else { return };
        if known.beat_at.take_if(|beat_at| *beat_at == at).is_none() {
            return;
        }
        let heard_at = known.heard_at;
        let silence_us = self.now.since(heard_at);
        let (allowed_us, live_us) = (self.config.silence_us, self.config.live_silence_us);
        let live_from = self.live_since.map(|since| since.max(heard_at));
        let is_live_over = live_from.is_some_and(|from| self.now.since(from) >= live_us);
        if silence_us >= allowed_us || is_live_over {
            self.forget_worker(worker);
            let why = DropReason::Silent { silence_us };
            self.actions.push_back(Action::Drop { worker, why });
            return;
        }
        let heartbeat_us = self.heartbeat_us();
        let next_at = if silence_us < heartbeat_us {
            heard_at.after(heartbeat_us)
        } else {
            self.actions.push_back(Action::Probe { worker });
            self.now.after(heartbeat_us)
        };
        let over_at = heard_at.after(allowed_us);
        let over_at = live_from.map_or(over_at, |from| over_at.min(from.after(live_us)));
        // One microsecond at least, so that a heartbeat of 0 cannot hold the clock; and at
        // the end of time nothing is due any more.
        let next_at = next_at.min(over_at).max(self.now.after(1));
        if next_at > self.now {
            self.look_at(worker, next_at);
        }
    }

    /// After so much silence a worker is looked at now, microseconds: probed, or dropped where
    /// the settings let it be silent for no longer than that.
    fn heartbeat_us(&self) -> u64 {
        let config = &self.config;
        let usual_us = config.heartbeat_us.min(config.silence_us);
        match self.live_since {
            Some(_) => usual_us.min(config.live_heartbeat_us).min(config.live_silence_us),
            None => usual_us,
        }
    }

    /// Looks at a worker then, and not when it was meant to before.
    fn look_at(&mut self, worker: WorkerId, at: Micros) {
        let Some(known) = self.workers.get_mut(&worker) else { return };
        if let Some(before) = known.beat_at.replace(at) {
            self.timers.remove(&(before, Timer::Beat(worker)));
        }
        self.timers.insert((at, Timer::Beat(worker)));
    }
}
