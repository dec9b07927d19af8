//! What the scheduler knows of one worker.

use crate::event::Micros;
use std::cmp::Reverse;
use std::collections::VecDeque;
use terrafarm_common::id::{LeaseId, WorkerId};

/// The most threads of a worker that are believed.
const MAX_THREADS: u32 = 4096;
/// Time that the first guess of a speed stands for, microseconds: one job outweighs it.
const PRIOR_TIME_US: f64 = 20_000.0;
/// A thread is taken to be at most so many times faster or slower than the others before
/// its first job.
const GUESS_RANGE: f64 = 32.0;
/// How much of what is known about a speed is kept when a job comes in.
const SPEED_MEMORY: f64 = 0.7;
/// Speeds are whole multiples of this, so that sums of thousands are exact in f64 and do
/// not depend on who came and went. Also the least speed.
const SPEED_STEP: f64 = 1.0 / 1_048_576.0;
/// The largest speed, cost units a microsecond.
const MAX_SPEED: f64 = 1e6;

/// Cost units a microsecond: work and time of the recent jobs, older ones fading.
#[derive(Debug, Clone)]
pub(crate) struct Speed {
    work: f64,
    time_us: f64,
    /// Whether a job has been measured.
    pub(crate) is_measured: bool,
}

impl Speed {
    fn guess(speed: f64) -> Self {
        Speed { work: speed * PRIOR_TIME_US, time_us: PRIOR_TIME_US, is_measured: false }
    }

    /// The estimate.
    pub(crate) fn value(&self) -> f64 {
        let speed = (self.work / self.time_us).clamp(SPEED_STEP, MAX_SPEED);
        (speed / SPEED_STEP).round() * SPEED_STEP
    }

    /// Takes in a job: its cost and how long it took.
    pub(crate) fn learn(&mut self, cost: f64, time_us: f64) {
        self.work = self.work * SPEED_MEMORY + cost;
        self.time_us = self.time_us * SPEED_MEMORY + time_us.max(1.0);
        self.is_measured = true;
    }

    /// Takes in that a job was not done after some time: lowers the estimate, or nothing.
    pub(crate) fn learn_overdue(&mut self, cost: f64, time_us: f64) {
        if cost < self.value() * time_us {
            self.learn(cost, time_us);
        }
    }
}

/// Who gets the next job: fewest jobs first, then the fastest.
pub(crate) type HungerKey = (usize, Reverse<u64>, WorkerId);

/// One connected worker.
#[derive(Debug)]
pub(crate) struct Worker {
    /// Threads it says it has, at least 1.
    pub(crate) threads: u32,
    /// How fast it renders.
    pub(crate) speed: Speed,
    /// How fast it rendered what is the same for all, pixels a second, if it has said so.
    pub(crate) measured: Option<f64>,
    /// What a job takes at an idle worker beyond rendering, microseconds: the way there
    /// and back. Decaying mean.
    pub(crate) overhead_us: f64,
    /// Its leases in the order of their grants; the first one is being rendered.
    pub(crate) held: VecDeque<LeaseId>,
    /// When the first of `held` began, as far as is known.
    pub(crate) head_since: Micros,
    /// When the first of `held` expires.
    pub(crate) head_deadline: Option<Micros>,
    /// When the first of `held` has to have made way for something more urgent.
    pub(crate) yields_at: Option<Micros>,
    /// Wants to leave.
    pub(crate) is_draining: bool,
    /// Was at fault in an audit: gets nothing.
    pub(crate) is_distrusted: bool,
    /// Let a lease expire and has done nothing since: gets one job at a time.
    pub(crate) is_suspect: bool,
    /// When the last byte came.
    pub(crate) heard_at: Micros,
    /// When it is looked at next; `None` at the end of time.
    pub(crate) beat_at: Option<Micros>,
    /// Where it stands among the hungry, if it does.
    pub(crate) hunger: Option<HungerKey>,
}

impl Worker {
    /// A worker that has just joined.
    pub(crate) fn new(threads: u32, now: Micros) -> Self {
        let threads = threads.clamp(1, MAX_THREADS);
        Worker {
            threads,
            speed: Speed::guess(f64::from(threads)),
            measured: None,
            overhead_us: 0.0,
            held: VecDeque::new(),
            head_since: now,
            head_deadline: None,
            yields_at: None,
            is_draining: false,
            is_distrusted: false,
            is_suspect: false,
            heard_at: now,
            beat_at: None,
            hunger: None,
        }
    }

    /// Takes a better guess of its speed than its threads, unless a job has been measured.
    /// `average` is what a thread of the farm does. A measurement is believed within
    /// [`GUESS_RANGE`] of that.
    pub(crate) fn guess(&mut self, speed: f64, average: f64) {
        let usual = f64::from(self.threads) * if average > 0.0 { average } else { 1.0 };
        if !self.speed.is_measured {
            self.speed = Speed::guess(speed.clamp(usual / GUESS_RANGE, usual * GUESS_RANGE));
        }
    }

    /// Whether it may get jobs.
    pub(crate) fn is_active(&self) -> bool {
        !self.is_draining && !self.is_distrusted
    }

    /// Expected time for a cost, microseconds.
    pub(crate) fn duration_us(&self, cost: f64) -> u64 {
        (cost / self.speed.value()).ceil() as u64
    }

    /// Takes in how long the way there and back took for one job.
    pub(crate) fn learn_overhead(&mut self, us: f64) {
        self.overhead_us =
            if self.overhead_us == 0.0 { us } else { 0.7 * self.overhead_us + 0.3 * us };
    }

    /// The key for the hungry set.
    pub(crate) fn hunger_key(&self, id: WorkerId) -> HungerKey {
        (self.held.len(), Reverse((self.speed.value() / SPEED_STEP) as u64), id)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_job_outweighs_the_guess() {
        let mut speed = Speed::guess(8.0);
        assert_eq!(speed.value(), 8.0);
        speed.learn(200_000.0, 100_000.0);
        assert!((speed.value() - 2.74).abs() < 0.1, "{}", speed.value());
        for _ in 0..10 {
            speed.learn(200_000.0, 100_000.0);
        }
        assert!((speed.value() - 2.0).abs() < 0.02);
    }

    #[test]
    fn an_overdue_job_never_makes_a_worker_faster() {
        let mut speed = Speed::guess(1.0);
        speed.learn_overdue(1e9, 10.0);
        assert_eq!(speed.value(), 1.0);
        speed.learn_overdue(1000.0, 1e6);
        assert!(speed.value() < 0.1);
    }

    #[test]
    fn absurd_measurements_stay_in_range() {
        let mut speed = Speed::guess(f64::from(u32::MAX));
        speed.learn(1e18, 0.0);
        assert!(speed.value() <= MAX_SPEED);
        for _ in 0..200 {
            speed.learn(0.0, 1e18);
        }
        assert_eq!(speed.value(), SPEED_STEP);
    }
}
