//! The real scheduler on a virtual clock: workers, links and faults are made up, every
//! decision is not.
//!
//! A run is a discrete-event simulation: one queue, ordered by time, then by insertion.
//! It depends on its [`SimConfig`] alone, so that a bad night can be played again from
//! its seed. A judge that knows nothing of the scheduler's insides watches every event
//! and action and counts what must not happen ([`Violations`]).

mod fault;
mod field;
pub(crate) mod judge;
mod machine;
mod silence;
mod tally;
mod workers;
mod world;

pub use fault::Faults;
pub use judge::Violations;
pub use tally::Spread;

use crate::config::Config;
use crate::journal::Stopped;
use crate::scheduler::Account;
use serde::Serialize;
use std::io::Write;
use terrafarm_common::region::Split;

/// Mean speed of workers between the default bounds.
const MEAN_SPEED: f64 = 1.68;
/// Work of the whole farm that is in flight, seconds. Frames are stored in their order: if
/// a worker dies, the others can go on for so long until a copy of its job is done.
const AHEAD_S: f64 = 1.2;

/// What is simulated.
#[derive(Debug, Clone)]
pub struct SimConfig {
    /// Number of workers.
    pub workers: u32,
    /// Everything random follows from it.
    pub seed: u64,
    /// Shots, all alike but for their priority: 0, 1, 2, and again.
    pub shots: u32,
    /// How many of the shots, the first ones, are live: somebody waits for each frame.
    pub live: u32,
    /// The first shot is submitted at once, the others within this time, seconds.
    pub arrive_within_s: f64,
    /// Frames of each shot.
    pub frames: u32,
    /// Width of the frames, pixels.
    pub width: u32,
    /// Height of the frames, pixels.
    pub height: u32,
    /// Shape of the jobs.
    pub split: Split,
    /// Bound on the frames in the coordinator's memory, for each shot.
    pub frames_in_flight: u32,
    /// What a frame takes a worker of speed 1, on average, seconds.
    pub frame_work_s: f64,
    /// How uneven the columns of a frame are: the costliest take about `1 + skew` times
    /// as long as the cheapest.
    pub skew: f64,
    /// How uneven the scenes of a shot are: frames after a cut of the film take up to
    /// `1 + frame_skew` times as long as those before it.
    pub frame_skew: f64,
    /// Slowest and fastest worker; speeds are spread evenly over the ratio between them.
    pub speeds: (f64, f64),
    /// Shortest and longest one-way delay of the links, microseconds.
    pub latency_us: (u64, u64),
    /// Bytes that a worker's link carries in a microsecond: 118 is Gigabit Ethernet.
    pub link_bytes_per_us: f64,
    /// The same for the coordinator's link, which all workers share.
    pub hub_bytes_per_us: f64,
    /// Size of a result, bytes a pixel.
    pub bytes_per_px: f64,
    /// What goes wrong.
    pub faults: Faults,
    /// Settings of the scheduler.
    pub scheduler: Config,
    /// The scheduler's own check runs after every so many events; 0 for never (it is
    /// slow).
    pub check_every: u64,
}

impl Default for SimConfig {
    fn default() -> Self {
        SimConfig {
            workers: 31,
            seed: 1,
            shots: 1,
            live: 0,
            arrive_within_s: 0.0,
            frames: 600,
            width: 1920,
            height: 1080,
            split: Split::Columns,
            frames_in_flight: 16,
            frame_work_s: 4.0,
            skew: 4.0,
            frame_skew: 0.0,
            speeds: (0.5, 4.0),
            latency_us: (100, 1000),
            link_bytes_per_us: 118.0,
            hub_bytes_per_us: 1180.0,
            bytes_per_px: 1.5,
            faults: Faults::default(),
            scheduler: Config::default(),
            check_every: 0,
        }
    }
}

impl SimConfig {
    /// A farm of this size with enough to do for it: about a minute of fault-free work,
    /// and as many frames in flight as its workers need.
    pub fn for_workers(workers: u32, seed: u64) -> Self {
        let base = SimConfig::default();
        let frame_work_s = base.frame_work_s.max(f64::from(workers) / 50.0);
        let speed = MEAN_SPEED * f64::from(workers.max(1));
        let ahead = (AHEAD_S * speed / frame_work_s).ceil() as u32;
        SimConfig {
            workers,
            seed,
            frames: (60.0 * speed / frame_work_s).ceil() as u32,
            frame_work_s,
            frames_in_flight: base.frames_in_flight.max(workers / 10).max(ahead),
            ..base
        }
    }
}

/// How a run went.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SimReport {
    /// Number of workers.
    pub workers: u32,
    /// The seed.
    pub seed: u64,
    /// Work that was asked for over the work that the workers could have done while they
    /// were there and a shot was open: the ideal time over the makespan.
    pub efficiency: f64,
    /// From the first submission to the last frame, virtual seconds.
    pub makespan_s: f64,
    /// Leases granted.
    pub jobs: u64,
    /// Frames complete.
    pub frames: u64,
    /// Frames that failed with a reason.
    pub failed_frames: u64,
    /// Rendering time thrown away over all rendering time.
    pub redo_share: f64,
    /// Where the workers' time went.
    pub time: TimeShares,
    /// From the first job of a frame to its last pixel.
    pub frame_latency_s: Spread,
    /// From the moment in which a machine lost power, hung or was cut off to that in which
    /// the scheduler gave it up. Those that it did not give up are not counted.
    pub notice_s: Spread,
    /// Results of workers that had been given up, all refused.
    pub zombies: u64,
    /// Events that the scheduler was told.
    pub events: u64,
    /// What became of the leases.
    pub account: Account,
    /// What must not happen, and did: all zero.
    pub invariants: Violations,
    /// The first violation in words.
    pub first_violation: Option<String>,
}

/// Where the time of the workers that were there went; weighted by speed, adds up to 1.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct TimeShares {
    /// Rendering what was merged.
    pub useful: f64,
    /// Rendering what was thrown away.
    pub redone: f64,
    /// Waiting for a job, or hanging.
    pub waiting: f64,
}

/// Plays one run.
pub fn simulate(config: &SimConfig) -> SimReport {
    let played = world::World::new(config, None).and_then(world::World::run);
    played.expect("only a record can stop, and there is none")
}

/// Plays one run, and writes all that the scheduler is told into a [`crate::journal`] of at
/// most so many bytes.
///
/// # Errors
/// If the journal could not be kept to the end.
pub fn record(
    config: &SimConfig,
    journal: &mut dyn Write,
    limit_bytes: u64,
) -> Result<SimReport, Stopped> {
    world::World::new(config, Some((journal, limit_bytes)))?.run()
}
