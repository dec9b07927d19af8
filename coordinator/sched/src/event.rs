//! What can happen, and what the scheduler may ask for.

use serde::{Deserialize, Serialize};
use terrafarm_common::id::{FrameIndex, LeaseId, ShotId, WorkerId};
use terrafarm_common::region::{Region, Split};

/// A time: microseconds since any fixed moment, the same for all events of a run.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize,
)]
pub struct Micros(pub u64);

impl Micros {
    /// This many microseconds later.
    #[must_use]
    pub fn after(self, us: u64) -> Micros {
        Micros(self.0.saturating_add(us))
    }

    /// Microseconds since an earlier time; 0 if it is not earlier.
    pub fn since(self, earlier: Micros) -> u64 {
        self.0.saturating_sub(earlier.0)
    }
}

/// Something that happened. Events about a worker or a shot that is not known, or no
/// longer, change nothing; a result from one is refused.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum Event {
    /// When a worker has finished its handshake. A second join of the same worker
    /// changes nothing.
    WorkerJoined {
        /// A connection that has not been used before.
        worker: WorkerId,
        /// Threads it renders with: the first guess of its speed, until
        /// [`Event::WorkerMeasured`].
        threads: u32,
    },
    /// When a worker has said how fast it rendered something that is the same for all: a
    /// better first guess than its threads. Changes nothing after its first job.
    WorkerMeasured {
        /// The worker.
        worker: WorkerId,
        /// Pixels in a second; only compared with those of others.
        pixels_per_s: u64,
    },
    /// When a connection has ended. What the worker held is granted anew at once.
    WorkerLost {
        /// The connection that ended.
        worker: WorkerId,
        /// How it ended; it does not change what happens next.
        why: LostReason,
    },
    /// When a worker wants to leave: it gets no new job and may finish those it has.
    WorkerDraining {
        /// The one that wants to leave.
        worker: WorkerId,
    },
    /// When a worker gives jobs back without having failed at them.
    HandedBack {
        /// The one that held them.
        worker: WorkerId,
        /// What it gives back. Leases it does not hold are passed over.
        leases: Vec<LeaseId>,
    },
    /// When a client asks for a shot. Answered by [`Action::ShotFailed`] if it breaks a
    /// limit; a number that is in use already is passed over.
    ShotSubmitted {
        /// A number that has not been used before.
        shot: ShotId,
        /// Number of frames, 1 to [`crate::MAX_FRAMES`].
        frames: u32,
        /// Width of every frame, pixels.
        width: u32,
        /// Height of every frame, pixels.
        height: u32,
        /// The shape of its jobs.
        split: Split,
        /// Shots of a higher priority get every worker they can use; equals get equal parts
        /// of what the workers can do.
        priority: i32,
        /// Frames open or finished but not yet taken, 1 to
        /// [`crate::MAX_FRAMES_IN_FLIGHT`]: the bound on the coordinator's memory.
        frames_in_flight: u32,
        /// Whether somebody waits for each of its frames: until it is over, and while it is
        /// not paused, workers that fall silent are dropped after
        /// [`crate::Config::live_silence_us`].
        live: bool,
    },
    /// When pixels of the right number have arrived. Answered by [`Action::Accept`],
    /// [`Action::Compared`] or [`Action::Refuse`] before any other action.
    JobDone {
        /// Who sent them.
        worker: WorkerId,
        /// The lease they came under.
        lease: LeaseId,
        /// How long the worker says it rendered, microseconds.
        cost_us: u64,
        /// A number that equal pixels share and others do not; compared in audits, anything
        /// where [`crate::Config::audit`] is none.
        digest: u64,
    },
    /// When a worker could not render a job, or sent pixels that cannot be right.
    JobFailed {
        /// Who failed.
        worker: WorkerId,
        /// The lease it failed under.
        lease: LeaseId,
        /// Why, in words for the user.
        reason: String,
    },
    /// When a finished frame has left the coordinator's memory.
    FrameTaken {
        /// Its shot.
        shot: ShotId,
        /// The frame.
        frame: FrameIndex,
    },
    /// When a shot is no longer wanted. Its jobs are revoked at once; nothing more is
    /// said about it.
    ShotCanceled {
        /// The one that is not wanted.
        shot: ShotId,
    },
    /// When a shot is to wait: its jobs are revoked at once and none is granted until
    /// [`Event::ShotResumed`]. What is accepted of its frames is kept.
    ShotPaused {
        /// The one that waits.
        shot: ShotId,
    },
    /// When a shot that waited may go on.
    ShotResumed {
        /// The one that goes on.
        shot: ShotId,
    },
    /// When a shot gets another priority.
    ShotPrioritised {
        /// The shot.
        shot: ShotId,
        /// Shots of a higher priority get every worker they can use; equals get equal parts
        /// of what the workers can do.
        priority: i32,
    },
    /// When an operator gives a worker that was blocked or is distrusted another chance.
    WorkerCleared {
        /// The worker.
        worker: WorkerId,
        /// The shot that it was blocked for; `None` for all.
        shot: Option<ShotId>,
    },
    /// When a worker is known to be one that is distrusted: it was, and came back.
    WorkerDistrusted {
        /// The worker.
        worker: WorkerId,
    },
    /// When any bytes have come from a worker. The other events from workers imply it.
    HeardFrom {
        /// The one that lives.
        worker: WorkerId,
    },
    /// When the time of [`crate::Scheduler::next_deadline`] has come, or at any time.
    Tick,
}

/// Something to be done, in the order given.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub enum Action {
    /// Send a job. A worker runs its jobs in the order of their grants.
    Grant {
        /// To whom.
        worker: WorkerId,
        /// The number under which the result is awaited, larger than all before.
        lease: LeaseId,
        /// The shot.
        shot: ShotId,
        /// The frame.
        frame: FrameIndex,
        /// The pixels.
        region: Region,
    },
    /// Send a job whose pixels are there already: they will be compared. The worker is not
    /// to know; the shot is not over before.
    Audit {
        /// To whom.
        worker: WorkerId,
        /// The number under which the result is awaited, larger than all before.
        lease: LeaseId,
        /// The lease under which the job was accepted.
        of: LeaseId,
        /// The shot.
        shot: ShotId,
        /// The frame; it may be complete and taken.
        frame: FrameIndex,
        /// The pixels.
        region: Region,
    },
    /// The pixels of the [`Event::JobDone`] being handled were those of an audit: throw them
    /// away.
    Compared {
        /// Who sent them.
        worker: WorkerId,
        /// The lease they came under.
        lease: LeaseId,
        /// The lease under which the job was accepted.
        of: LeaseId,
        /// Whether they are what was accepted.
        agrees: bool,
    },
    /// Forget pixels that were merged into an open frame; they will come again.
    Retract {
        /// Who sent them.
        worker: WorkerId,
        /// The shot.
        shot: ShotId,
        /// The frame.
        frame: FrameIndex,
        /// Where they are.
        region: Region,
    },
    /// Tell a worker that a job is not wanted any more. It may be done already.
    Revoke {
        /// The one that holds it.
        worker: WorkerId,
        /// The lease that has ended.
        lease: LeaseId,
    },
    /// Merge the pixels of the [`Event::JobDone`] being handled.
    Accept {
        /// The lease.
        lease: LeaseId,
        /// The shot.
        shot: ShotId,
        /// The frame.
        frame: FrameIndex,
        /// Where they belong.
        region: Region,
    },
    /// Throw the pixels of the [`Event::JobDone`] being handled away.
    Refuse {
        /// Who sent them.
        worker: WorkerId,
        /// The lease they came under.
        lease: LeaseId,
        /// Why.
        why: RefuseReason,
    },
    /// All pixels of a frame are there. Answer with [`Event::FrameTaken`].
    FrameComplete {
        /// The shot.
        shot: ShotId,
        /// The frame.
        frame: FrameIndex,
    },
    /// A frame cannot be rendered; throw away what is there. The shot goes on, and the
    /// frame does not have to be taken.
    FrameFailed {
        /// The shot.
        shot: ShotId,
        /// The frame.
        frame: FrameIndex,
        /// Why.
        reason: FrameFailure,
    },
    /// Every frame is complete or has failed: the last word on a shot.
    ShotComplete {
        /// The shot.
        shot: ShotId,
        /// How many of its frames failed.
        failed_frames: u32,
    },
    /// The shot is not begun or not continued: the last word on it. Frames of it that are
    /// not complete are thrown away.
    ShotFailed {
        /// The shot.
        shot: ShotId,
        /// Why.
        reason: ShotFailure,
    },
    /// Send something that the worker answers.
    Probe {
        /// To whom.
        worker: WorkerId,
    },
    /// Close the connection; the scheduler has forgotten the worker.
    Drop {
        /// Whose.
        worker: WorkerId,
        /// Why.
        why: DropReason,
    },
    /// A worker failed at several jobs of a shot that others may manage, and gets no more
    /// of them. For the log.
    Blocked {
        /// The worker.
        worker: WorkerId,
        /// The shot.
        shot: ShotId,
    },
    /// A worker is at fault and gets nothing more until [`Event::WorkerCleared`]; for the
    /// operator.
    Distrusted {
        /// The worker; it may have gone.
        worker: WorkerId,
        /// What it did.
        why: Distrust,
        /// Complete frames of shots under way that have pixels of it.
        sent: Vec<SentFrames>,
    },
    /// A worker that was distrusted gets jobs again. For the log.
    Trusted {
        /// The worker.
        worker: WorkerId,
    },
    /// Workers differ and nobody can tell who is right; for the operator.
    Disputed {
        /// The shot.
        shot: ShotId,
        /// The frame.
        frame: FrameIndex,
        /// The pixels.
        region: Region,
        /// Who said what differs.
        workers: Vec<WorkerId>,
    },
    /// A worker gets jobs of that shot again, since the others are gone or do no better.
    /// For the log.
    Unblocked {
        /// The worker.
        worker: WorkerId,
        /// The shot.
        shot: ShotId,
    },
}

/// Complete frames of a shot.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct SentFrames {
    /// The shot.
    pub shot: ShotId,
    /// The first and the last one of each run of frames. There may be other frames in between
    /// if the runs are very many.
    pub frames: Vec<(FrameIndex, FrameIndex)>,
}

/// Why a worker is distrusted.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, thiserror::Error)]
pub enum Distrust {
    /// When others agree on something else.
    #[error("its {} x {} pixels at ({}, {}) of frame {frame} of {shot} differ from those of {}, which agree",
        region.width, region.height, region.x, region.y, named(by))]
    Outvoted {
        /// The shot.
        shot: ShotId,
        /// The frame.
        frame: FrameIndex,
        /// The pixels.
        region: Region,
        /// Who agrees.
        by: Vec<WorkerId>,
    },
    /// When it rendered the same twice, and differently.
    #[error("it rendered {} x {} pixels at ({}, {}) of frame {frame} of {shot} twice, and differently",
        region.width, region.height, region.x, region.y)]
    Contradicted {
        /// The shot.
        shot: ShotId,
        /// The frame.
        frame: FrameIndex,
        /// The pixels.
        region: Region,
    },
    /// When it was distrusted on an earlier connection.
    #[error("it was at fault before it connected again")]
    Before,
}

fn named(workers: &[WorkerId]) -> String {
    let names: Vec<String> = workers.iter().map(WorkerId::to_string).collect();
    names.join(" and ")
}

/// How a connection ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum LostReason {
    /// The worker said that it leaves.
    Left,
    /// The connection broke.
    Broken,
    /// The worker broke the protocol, and the coordinator closed.
    Misbehaved,
}

/// Why pixels are thrown away. All three are part of normal work.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub enum RefuseReason {
    /// The lease has ended: it expired, or the job was revoked or granted to another.
    Stale,
    /// The lease was never granted, or is held by another worker.
    Unknown,
    /// A result under this lease was accepted a short while ago.
    Duplicate,
}

/// Why a worker is dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, thiserror::Error)]
pub enum DropReason {
    /// When no byte came for [`crate::Config::silence_us`], or for
    /// [`crate::Config::live_silence_us`] while somebody waited for frames.
    #[error("silent for {silence_us} us, probes unanswered; is the machine asleep or unplugged?")]
    Silent {
        /// How long, microseconds.
        silence_us: u64,
    },
    /// When [`crate::MAX_WORKERS`] are connected.
    #[error(
        "the farm is full: {} workers are connected; stop one to make room",
        crate::MAX_WORKERS
    )]
    FarmFull,
}

/// Why a frame failed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, thiserror::Error)]
pub enum FrameFailure {
    /// When one of its jobs failed too often.
    #[error("{} x {} pixels at ({}, {}) failed {tries} times, at last on {worker}: {reason}",
        region.width, region.height, region.x, region.y)]
    JobFailed {
        /// The job.
        region: Region,
        /// How often it was tried.
        tries: usize,
        /// Who tried last.
        worker: WorkerId,
        /// What the last worker said.
        reason: String,
    },
}

/// Why a shot failed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, thiserror::Error)]
pub enum ShotFailure {
    /// When [`crate::MAX_SHOTS`] are queued.
    #[error(
        "the queue is full: {} shots wait; submit again when one has finished",
        crate::MAX_SHOTS
    )]
    QueueFull,
    /// When a number of the shot is 0 or too large.
    #[error("{what} is {value}; choose 1 to {limit}")]
    OutOfRange {
        /// Which number.
        what: &'static str,
        /// What it is.
        value: u64,
        /// Its largest value.
        limit: u64,
    },
    /// When not one frame was finished before so many had failed.
    #[error("none of its first {failed_frames} frames could be rendered; the last one: {last}")]
    NothingRenders {
        /// How many failed.
        failed_frames: u32,
        /// Why the last one failed.
        last: FrameFailure,
    },
}
