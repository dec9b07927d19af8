//! What is shown of a farm: to the page, to scripts, to the command line.
//!
//! A view is a copy that hides nothing and promises nothing: the driver publishes a new one
//! a few times a second. Its JSON is part of the API: keys are added, never renamed.

use serde::{Deserialize, Serialize};
use terrafarm_common::id::{FrameIndex, ShotId, WorkerId};

/// Everything at one moment.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct FarmView {
    /// When, milliseconds since the coordinator started.
    pub at_ms: u64,
    /// Who renders, by number.
    pub workers: Vec<WorkerView>,
    /// The shots under way, by number: not those that wait in the queue on disk.
    pub shots: Vec<ShotView>,
    /// Leases held now.
    pub jobs_running: u64,
    /// Jobs whose pixels were used, since the start.
    pub jobs_done: u64,
    /// Leases granted again because a worker was lost, failed or slow, since the start.
    pub jobs_repeated: u64,
    /// Results that came too late and were refused, since the start.
    pub results_refused: u64,
    /// Frames finished since the start.
    pub frames_done: u64,
    /// Blobs of terrain that came to workers, or lay there, damaged, since the start.
    pub blobs_damaged: u64,
    /// Terrain that workers gave to each other since the start, bytes.
    pub given_bytes: u64,
    /// How well the farm was used, oldest first; at most [`HISTORY_MAX`].
    pub history: Vec<Sample>,
}

/// Most samples of the history that are kept: an hour at one in five seconds.
pub const HISTORY_MAX: usize = 720;

/// How well the farm was used for a while.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Sample {
    /// Its end, milliseconds since the coordinator started.
    pub at_ms: u64,
    /// Share of the workers' time that was spent on rendering what was used, 0 to 1.
    pub efficiency: f64,
    /// Frames finished per second.
    pub frames_per_s: f64,
    /// Workers connected at its end.
    pub workers: u32,
}

/// What a worker does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum WorkerState {
    /// It holds no job.
    Idle,
    /// It holds jobs.
    Busy,
    /// It finishes what it has and leaves.
    Draining,
}

/// One worker.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct WorkerView {
    /// Number of its connection.
    pub id: WorkerId,
    /// What it calls itself.
    pub name: String,
    /// Render threads.
    pub threads: u32,
    /// How many of them may render now: fewer while it makes room for others on its PC.
    pub threads_allowed: u32,
    /// What it does.
    pub state: WorkerState,
    /// Its speed, in threads of this farm's average worker.
    pub speed: f64,
    /// What it renders now: the first of the jobs it holds.
    pub job: Option<JobView>,
    /// Jobs it holds.
    pub jobs_held: u32,
    /// Jobs of it whose pixels were used.
    pub jobs_done: u64,
    /// Jobs that it failed at.
    pub jobs_failed: u64,
    /// Time since anything was heard of it, milliseconds.
    pub heard_ms: u64,
    /// Where its time went since it joined, shares of 1: rendering.
    pub rendering: f64,
    /// Share of its time in which a job waited for terrain.
    pub terrain: f64,
    /// Shots that it gets no more of, since it failed at them too often.
    pub blocked: Vec<ShotId>,
    /// Whether it is out of the farm, since its pixels differed from those of others.
    pub distrusted: bool,
    /// What its caches hold; `None` until it has said so.
    pub cache: Option<CacheView>,
}

/// The terrain that a worker holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct CacheView {
    /// Decoded in memory, bytes.
    pub memory_bytes: u64,
    /// The most that may be there.
    pub memory_limit_bytes: u64,
    /// Packed on its disk, bytes; workers of one PC may share that.
    pub disk_bytes: u64,
    /// The most that may be there; 0 where nothing is kept.
    pub disk_limit_bytes: u64,
    /// Blobs that came or lay damaged since it joined.
    pub damaged: u64,
    /// Given to other workers since it joined, bytes.
    pub given_bytes: u64,
}

/// One job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobView {
    /// The shot.
    pub shot: ShotId,
    /// The frame.
    pub frame: FrameIndex,
    /// Columns `x` to `x + width`, rows `y` to `y + height`, pixels.
    pub region: [u32; 4],
}

/// Where a shot is on its way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ShotState {
    /// It waits in the queue for its turn.
    Waiting,
    /// Frames of it are or may be rendered.
    Running,
    /// It waits until someone resumes it.
    Paused,
    /// It waits for something to be put right, such as a full disk; see `note`.
    Stalled,
    /// Its frames are being made into a film.
    Finishing,
    /// Every frame is complete or has failed.
    Done,
    /// It was given up; see `note`.
    Failed,
    /// Someone canceled it.
    Canceled,
}

/// One shot.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ShotView {
    /// Its number on this farm.
    pub id: ShotId,
    /// What it is called.
    pub name: String,
    /// Where it is on its way.
    pub state: ShotState,
    /// Why, where that needs saying.
    pub note: String,
    /// Larger is more urgent.
    pub priority: i32,
    /// Whether it is in the queue on disk; else it ends with the client that submitted it.
    pub queued: bool,
    /// Number of the first frame within the flight; frames are named by such numbers.
    pub first_frame: FrameIndex,
    /// Number of frames.
    pub frames: u32,
    /// Frames finished.
    pub frames_done: u32,
    /// Frames given up.
    pub frames_failed: u32,
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// The method, by name.
    pub method: String,
    /// When it was submitted, seconds since 1970.
    pub submitted_s: u64,
    /// Frames finished per second, lately.
    pub frames_per_s: f64,
    /// How long it will take, seconds; `None` while nobody knows.
    pub eta_s: Option<f64>,
    /// The frame that was finished last, if any.
    pub last_frame: Option<FrameIndex>,
    /// Whether there is a film to be fetched.
    pub film: bool,
    /// What happened to it that people should know of, oldest first.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub history: Vec<Past>,
}

/// Something that happened to a shot.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Past {
    /// When, seconds since 1970.
    pub at_s: u64,
    /// What, for people.
    pub what: String,
}

impl ShotState {
    /// Every state.
    pub const ALL: [ShotState; 8] = [
        ShotState::Waiting,
        ShotState::Running,
        ShotState::Paused,
        ShotState::Stalled,
        ShotState::Finishing,
        ShotState::Done,
        ShotState::Failed,
        ShotState::Canceled,
    ];

    /// Its name, as in JSON.
    pub fn name(self) -> &'static str {
        match self {
            ShotState::Waiting => "waiting",
            ShotState::Running => "running",
            ShotState::Paused => "paused",
            ShotState::Stalled => "stalled",
            ShotState::Finishing => "finishing",
            ShotState::Done => "done",
            ShotState::Failed => "failed",
            ShotState::Canceled => "canceled",
        }
    }

    /// Whether nothing will change any more.
    pub fn is_over(self) -> bool {
        matches!(self, ShotState::Done | ShotState::Failed | ShotState::Canceled)
    }
}

impl WorkerState {
    /// Its name, as in JSON.
    pub fn name(self) -> &'static str {
        match self {
            WorkerState::Idle => "idle",
            WorkerState::Busy => "busy",
            WorkerState::Draining => "draining",
        }
    }
}
