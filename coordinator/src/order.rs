//! Orders to a farm, and what becomes of them.

use terrafarm_common::id::{FrameIndex, ShotId, WorkerId};

/// Something that a person or a script wants of the farm. It takes effect at once, within
/// the time of one message to the workers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// A shot waits; jobs that run are stopped.
    Pause(ShotId),
    /// It goes on.
    Resume(ShotId),
    /// It is given up.
    Cancel(ShotId),
    /// Its priority is another one.
    Prioritise(ShotId, i32),
    /// A worker is believed again, and gets jobs again that it was blocked for: of one shot,
    /// or of all, and then none needs to be under way.
    Clear(WorkerId, Option<ShotId>),
    /// A worker finishes what it renders, hands back the rest, and leaves.
    Drain(WorkerId),
    /// Says why a frame is not done.
    Why(ShotId, FrameIndex),
}

/// Why an order could not be carried out.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum OrderError {
    /// There is no such shot, or it is over.
    #[error("{0} is not under way on this farm; \"terrafarm shots\" lists those that are")]
    NoShot(ShotId),
    /// There is no such worker.
    #[error("{0} is not connected; \"terrafarm workers\" lists those that are")]
    NoWorker(WorkerId),
    /// The shot has fewer frames.
    #[error("{shot} has {frames} frames, 0 to {}; {frame} is none of them", frames - 1)]
    NoFrame {
        /// The shot.
        shot: ShotId,
        /// How many frames it has.
        frames: u32,
        /// What was asked for.
        frame: FrameIndex,
    },
    /// The coordinator is stopping.
    #[error("the coordinator stops")]
    Stopping,
}
