//! What the farm counts for those who look at it; nothing is decided by it.

use crate::view::{HISTORY_MAX, Sample};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use terrafarm_common::id::{FrameIndex, ShotId, WorkerId};
use terrafarm_sched::Micros;
use terrafarm_wire::message::{Status, Timesheet};

/// How long a sample of the history is, microseconds.
const SAMPLE_US: u64 = 5_000_000;
/// Frames that the rate of a shot is taken from.
const RATE_FRAMES: usize = 32;

/// All counts.
#[derive(Debug, Default)]
pub struct Tally {
    /// The workers that are connected.
    pub workers: BTreeMap<WorkerId, WorkerTally>,
    /// The shots under way.
    pub shots: BTreeMap<ShotId, ShotTally>,
    /// Frames finished since the start.
    pub frames_done: u64,
    /// Blobs that were damaged, and bytes that workers gave to each other, since the start.
    pub blobs_damaged: u64,
    pub given_bytes: u64,
    history: VecDeque<Sample>,
    now: Lap,
}

/// The sample that is being taken.
#[derive(Debug, Default)]
struct Lap {
    since: Micros,
    /// When the number of workers last changed.
    counted: Micros,
    /// Time of all workers together, microseconds.
    worker_us: u64,
    used_us: u64,
    frames: u64,
}

/// One worker.
#[derive(Debug)]
pub struct WorkerTally {
    since: Micros,
    /// Jobs whose pixels were used.
    pub jobs_done: u64,
    /// Jobs that it failed at.
    pub jobs_failed: u64,
    sheet: Timesheet,
    /// How it is off, as it said last.
    pub status: Option<Status>,
    /// Shots that it gets no more of.
    pub blocked: BTreeSet<ShotId>,
}

/// One shot.
#[derive(Debug, Default)]
pub struct ShotTally {
    /// When the last frames were finished, oldest first.
    finished: VecDeque<Micros>,
    /// The frame that was finished last.
    pub last_frame: Option<FrameIndex>,
}

impl Tally {
    /// Time passes: closes the samples that are over.
    pub fn advance(&mut self, now: Micros) {
        while now.since(self.now.since) >= SAMPLE_US {
            let end = self.now.since.after(SAMPLE_US);
            self.count_time(end);
            let lap = std::mem::take(&mut self.now);
            if self.history.len() >= HISTORY_MAX {
                self.history.pop_front();
            }
            self.history.push_back(Sample {
                at_ms: end.0 / 1000,
                // A job that began before the sample brings all of its time with it.
                efficiency: (lap.used_us as f64 / lap.worker_us.max(1) as f64).min(1.0),
                frames_per_s: lap.frames as f64 * 1e6 / SAMPLE_US as f64,
                workers: self.workers.len() as u32,
            });
            // After hours of sleep of the PC, the gap is not worth a loop over it.
            let next = if now.since(end) / SAMPLE_US > HISTORY_MAX as u64 { now } else { end };
            self.now = Lap { since: next, counted: next, ..Lap::default() };
        }
    }

    fn count_time(&mut self, now: Micros) {
        let us = now.since(self.now.counted);
        self.now.worker_us += us.saturating_mul(self.workers.len() as u64);
        self.now.counted = now;
    }

    /// A worker has joined.
    pub fn joined(&mut self, worker: WorkerId, now: Micros) {
        self.advance(now);
        self.count_time(now);
        let tally = WorkerTally {
            since: now,
            jobs_done: 0,
            jobs_failed: 0,
            sheet: Timesheet::default(),
            status: None,
            blocked: BTreeSet::new(),
        };
        self.workers.insert(worker, tally);
    }

    /// A worker has gone.
    pub fn left(&mut self, worker: WorkerId, now: Micros) {
        self.advance(now);
        self.count_time(now);
        self.workers.remove(&worker);
    }

    /// The pixels of a job were used.
    pub fn job_done(&mut self, worker: WorkerId, sheet: &Timesheet) {
        self.now.used_us = self.now.used_us.saturating_add(sheet.render_us);
        if let Some(tally) = self.workers.get_mut(&worker) {
            tally.jobs_done += 1;
            tally.sheet.add(sheet);
        }
    }

    /// A worker spent time on something that was not used.
    pub fn wasted(&mut self, worker: WorkerId, sheet: &Timesheet) {
        if let Some(tally) = self.workers.get_mut(&worker) {
            tally.sheet.add(sheet);
        }
    }

    /// A worker failed at a job.
    pub fn job_failed(&mut self, worker: WorkerId) {
        if let Some(tally) = self.workers.get_mut(&worker) {
            tally.jobs_failed += 1;
        }
    }

    /// A worker said how it is off.
    pub fn told(&mut self, worker: WorkerId, status: Status) {
        let Some(tally) = self.workers.get_mut(&worker) else { return };
        let before = tally.status.replace(status);
        let [damaged, given] = before.map_or([0; 2], |before| [before.damaged, before.given_bytes]);
        let sum = |all: &mut u64, now: u64, before: u64| {
            *all = all.saturating_add(now.saturating_sub(before));
        };
        sum(&mut self.blobs_damaged, status.damaged, damaged);
        sum(&mut self.given_bytes, status.given_bytes, given);
    }

    /// A worker gets no more of a shot.
    pub fn blocked(&mut self, worker: WorkerId, shot: ShotId, is_blocked: bool) {
        let Some(tally) = self.workers.get_mut(&worker) else { return };
        match is_blocked {
            true => tally.blocked.insert(shot),
            false => tally.blocked.remove(&shot),
        };
    }

    /// A frame is finished.
    pub fn frame_done(&mut self, shot: ShotId, frame: FrameIndex, now: Micros) {
        self.frames_done += 1;
        self.now.frames += 1;
        let tally = self.shots.entry(shot).or_default();
        tally.last_frame = Some(frame);
        if tally.finished.len() >= RATE_FRAMES {
            tally.finished.pop_front();
        }
        tally.finished.push_back(now);
    }

    /// A shot is over.
    pub fn forget_shot(&mut self, shot: ShotId) {
        self.shots.remove(&shot);
        for worker in self.workers.values_mut() {
            worker.blocked.remove(&shot);
        }
    }

    /// The samples, oldest first.
    pub fn history(&self) -> Vec<Sample> {
        self.history.iter().copied().collect()
    }
}

impl WorkerTally {
    /// Shares of its time since it joined: rendering, and waiting for terrain.
    pub fn shares(&self, now: Micros) -> [f64; 2] {
        let total = now.since(self.since).max(1) as f64;
        let Timesheet { render_us, terrain_us, unpack_us, .. } = self.sheet;
        [render_us, terrain_us.saturating_add(unpack_us)].map(|us| (us as f64 / total).min(1.0))
    }
}

impl ShotTally {
    /// Frames finished per second, over the last [`RATE_FRAMES`] of them. It falls while
    /// none is finished.
    pub fn frames_per_s(&self, now: Micros) -> f64 {
        let Some(&first) = self.finished.front() else { return 0.0 };
        let span_us = now.since(first).max(1) as f64;
        (self.finished.len() - 1) as f64 * 1e6 / span_us
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: u64 = 1_000_000;

    fn rendered(seconds: u64) -> Timesheet {
        Timesheet { render_us: seconds * SECOND, ..Timesheet::default() }
    }

    #[test]
    fn efficiency_is_rendering_that_was_used_over_the_time_of_all_workers() {
        let mut tally = Tally::default();
        tally.joined(WorkerId(1), Micros(0));
        tally.joined(WorkerId(2), Micros(SECOND));
        tally.job_done(WorkerId(1), &rendered(3));
        tally.wasted(WorkerId(2), &rendered(1));
        tally.frame_done(ShotId(1), 0, Micros(4 * SECOND));
        tally.advance(Micros(5 * SECOND));
        tally.left(WorkerId(2), Micros(6 * SECOND));
        tally.advance(Micros(10 * SECOND));
        let history = tally.history();
        assert_eq!(history.len(), 2);
        let first = history[0];
        assert!((first.efficiency - 3.0 / 9.0).abs() < 1e-9, "5 s and 4 s of two workers");
        assert_eq!((first.at_ms, first.workers, first.frames_per_s), (5000, 2, 0.2));
        assert_eq!((history[1].workers, history[1].efficiency), (1, 0.0));
    }

    #[test]
    fn history_is_bounded_and_a_long_sleep_does_not_fill_it() {
        let mut tally = Tally::default();
        for second in 0..5000 {
            tally.advance(Micros(second * SECOND));
        }
        assert_eq!(tally.history().len(), HISTORY_MAX);
        tally.advance(Micros(u64::MAX / 2));
        assert_eq!(tally.history().len(), HISTORY_MAX);
    }

    #[test]
    fn what_workers_gave_is_summed_over_those_who_left() {
        let mut tally = Tally::default();
        let status = |damaged, given_bytes| Status {
            memory_bytes: 1,
            memory_limit_bytes: 2,
            disk_bytes: 3,
            disk_limit_bytes: 4,
            damaged,
            given_bytes,
            threads_allowed: 1,
        };
        for number in [1, 2] {
            tally.joined(WorkerId(number), Micros(0));
            tally.told(WorkerId(number), status(1, 100));
            tally.told(WorkerId(number), status(3, 400));
            tally.left(WorkerId(number), Micros(1));
        }
        assert_eq!((tally.blobs_damaged, tally.given_bytes), (6, 800));
        tally.told(WorkerId(2), status(9, 9));
        assert_eq!((tally.blobs_damaged, tally.given_bytes), (6, 800), "it has left");
    }

    #[test]
    fn a_rate_is_that_of_the_last_frames_and_falls_when_none_come() {
        let mut tally = Tally::default();
        for frame in 0..100 {
            tally.frame_done(ShotId(1), frame, Micros(u64::from(frame) * SECOND / 2));
        }
        let shot = &tally.shots[&ShotId(1)];
        let last = Micros(99 * SECOND / 2);
        assert!((shot.frames_per_s(last) - 2.0).abs() < 1e-9);
        assert!(shot.frames_per_s(last.after(100 * SECOND)) < 0.3);
        assert_eq!(shot.last_frame, Some(99));
    }
}
