//! What can be tuned, and the limits that cannot.

use serde::{Deserialize, Serialize};
use terrafarm_common::accuracy::Share;
use terrafarm_common::id::MAX_SHOT_FRAMES;
use terrafarm_common::region::Split;

/// The most workers connected at once; more are dropped as they join.
pub const MAX_WORKERS: usize = 16_384;
/// The most shots queued or running at once; more are refused.
pub const MAX_SHOTS: usize = 256;
/// The most frames of one shot. They cost memory only in flight.
pub const MAX_FRAMES: u32 = MAX_SHOT_FRAMES;
/// The most frames of one shot that may be open or waiting to be taken.
pub const MAX_FRAMES_IN_FLIGHT: u32 = 1024;
/// The most jobs that one frame can be cut into.
pub const MAX_JOBS_PER_FRAME: u64 = 16_384;

/// Settings of the scheduler. The defaults are for batch rendering on a local network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Config {
    /// Jobs that wait at a worker behind the running one, so that the network is hidden.
    pub queue_depth: usize,
    /// The most jobs at one worker when they are so short that `queue_depth` of them do
    /// not cover its latency. At least `queue_depth + 1`.
    pub max_held: usize,
    /// The shortest job aimed at, microseconds: at the tail of a shot. A job is never
    /// narrower than 8 columns, so that on a slow worker it may last longer.
    pub job_min_us: u64,
    /// The longest job aimed at, microseconds: what is lost when a worker vanishes, and
    /// how soon a shot of higher priority gets a worker.
    pub job_max_us: u64,
    /// The most pixels of one job: bounds the size of a result on the wire.
    pub max_job_px: u64,
    /// A lease ends unfinished after this many times its predicted duration, plus
    /// `lease_floor_us`. Every expiry of the same job doubles its time.
    pub lease_factor: f64,
    /// What is added to every lease, microseconds: for latency and for bad predictions.
    pub lease_floor_us: u64,
    /// A worker that has been silent this long is probed, microseconds.
    pub heartbeat_us: u64,
    /// A worker that has been silent this long is dropped, microseconds.
    pub silence_us: u64,
    /// The same two times while a live shot is under way, microseconds: see `watch.rs`.
    /// A probe and its answer have to fit between them.
    pub live_heartbeat_us: u64,
    /// See `live_heartbeat_us`.
    pub live_silence_us: u64,
    /// How many of the accepted jobs are rendered again by another worker and compared:
    /// this much of the farm's work. See `audit.rs`.
    pub audit: Share,
}

impl Default for Config {
    fn default() -> Self {
        Config {
            queue_depth: 1,
            max_held: 8,
            job_min_us: 20_000,
            job_max_us: 250_000,
            max_job_px: (Split::MAX_TILE_SIDE as u64).pow(2),
            lease_factor: 4.0,
            lease_floor_us: 10_000_000,
            heartbeat_us: 1_000_000,
            silence_us: 5_000_000,
            live_heartbeat_us: 125_000,
            live_silence_us: 450_000,
            audit: Share::NONE,
        }
    }
}
