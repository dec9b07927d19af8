//! What is measured in a run, beside what must not happen.

use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use terrafarm_common::id::{FrameIndex, ShotId, WorkerId};

/// How some times are spread, seconds; all 0 where there are none.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Spread {
    /// How many there are.
    pub count: u64,
    /// Half of them are not longer.
    pub p50: f64,
    /// 99 of 100 are not longer.
    pub p99: f64,
    /// The longest.
    pub max: f64,
}

impl Spread {
    /// Of times in microseconds.
    fn of(mut times_us: Vec<u64>) -> Self {
        times_us.sort_unstable();
        let at = |percent: usize| {
            let rank = (times_us.len() * percent).div_ceil(100).max(1);
            times_us.get(rank - 1).map_or(0.0, |&us| us as f64 / 1e6)
        };
        Spread { count: times_us.len() as u64, p50: at(50), p99: at(99), max: at(100) }
    }
}

/// Running measurements.
#[derive(Debug, Default)]
pub(crate) struct Tally {
    /// Sum of the speeds of the machines that are there.
    present_speed: f64,
    open_shots: u32,
    since_us: u64,
    /// Work that the machines that were there could have done while a shot was open, at
    /// speed 1.
    pub(crate) able_us: f64,
    /// When the first job of each open frame was granted.
    begun: BTreeMap<(ShotId, FrameIndex), u64>,
    latencies_us: Vec<u64>,
    /// When the scheduler was told of connections.
    joined: BTreeMap<WorkerId, u64>,
    /// When connections went silent for good.
    silent_since: BTreeMap<WorkerId, u64>,
    notices_us: Vec<u64>,
    dropped: BTreeSet<WorkerId>,
    /// Results that came over connections that had been given up, and were refused.
    pub(crate) zombies: u64,
}

impl Tally {
    /// Brings the sum of what could have been done up to date.
    fn advance(&mut self, now_us: u64) {
        if self.open_shots > 0 {
            self.able_us += self.present_speed * (now_us - self.since_us) as f64;
        }
        self.since_us = now_us;
    }

    /// A machine comes, or goes: then its speed is negative.
    pub(crate) fn present(&mut self, now_us: u64, speed: f64) {
        self.advance(now_us);
        self.present_speed += speed;
    }

    /// A shot is submitted.
    pub(crate) fn shot_open(&mut self, now_us: u64) {
        self.advance(now_us);
        self.open_shots += 1;
    }

    /// A shot is over.
    pub(crate) fn shot_over(&mut self, now_us: u64) {
        self.advance(now_us);
        self.open_shots -= 1;
    }

    /// A job of a frame is granted.
    pub(crate) fn granted(&mut self, now_us: u64, shot: ShotId, frame: FrameIndex) {
        self.begun.entry((shot, frame)).or_insert(now_us);
    }

    /// A frame is complete or has failed.
    pub(crate) fn frame_over(
        &mut self,
        now_us: u64,
        shot: ShotId,
        frame: FrameIndex,
        is_complete: bool,
    ) {
        let begun_us = self.begun.remove(&(shot, frame));
        self.latencies_us.extend(begun_us.filter(|_| is_complete).map(|begun| now_us - begun));
    }

    /// The scheduler is told of a connection.
    pub(crate) fn joined(&mut self, now_us: u64, worker: WorkerId) {
        self.joined.insert(worker, now_us);
    }

    /// A connection has gone silent for good, and nobody was told.
    pub(crate) fn silent(&mut self, now_us: u64, worker: WorkerId) {
        self.silent_since.insert(worker, now_us);
    }

    /// The scheduler has given a worker up, which may have been unable to speak since then.
    pub(crate) fn dropped(&mut self, now_us: u64, worker: WorkerId, mute_us: Option<u64>) {
        // Some could not speak before anyone knew of them: their first word was held back.
        let joined_us = self.joined.remove(&worker).unwrap_or_default();
        let mute_us = mute_us.map(|since| since.max(joined_us));
        let since_us = self.silent_since(worker).or(mute_us);
        if self.dropped.insert(worker) {
            self.notices_us.extend(since_us.map(|since| now_us - since));
        }
    }

    /// When a connection went silent for good, if it did.
    pub(crate) fn silent_since(&self, worker: WorkerId) -> Option<u64> {
        self.silent_since.get(&worker).copied()
    }

    /// A result was refused.
    pub(crate) fn refused(&mut self, worker: WorkerId) {
        self.zombies += u64::from(self.dropped.contains(&worker));
    }

    /// Times from the first job of a frame to its last pixel, and from the silence of a
    /// machine to its end for the scheduler.
    pub(crate) fn spreads(&mut self) -> (Spread, Spread) {
        let take = std::mem::take;
        (Spread::of(take(&mut self.latencies_us)), Spread::of(take(&mut self.notices_us)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_spread_names_times_that_were_measured() {
        let spread = Spread::of((1..=200).rev().map(|i| i * 1_000_000).collect());
        assert_eq!(spread, Spread { count: 200, p50: 100.0, p99: 198.0, max: 200.0 });
        let one = Spread::of(vec![500_000]);
        assert_eq!(one, Spread { count: 1, p50: 0.5, p99: 0.5, max: 0.5 });
        assert_eq!(Spread::of(Vec::new()), Spread::default());
    }

    #[test]
    fn nobody_is_idle_while_there_is_no_shot() {
        let mut tally = Tally::default();
        tally.present(10, 2.0);
        tally.shot_open(100);
        tally.present(150, 1.0);
        tally.shot_over(200);
        tally.present(900, -1.0);
        assert_eq!(tally.able_us, 50.0 * 2.0 + 50.0 * 3.0);
    }
}
