//! Who renders what, and when: a pure state machine, with its simulator.
//!
//! The machine reads no clock, does no input or output and sees no pixels. Whoever owns
//! it (the coordinator's driver task, or [`sim`]) tells it what happened and when, and
//! carries out what it asks for:
//!
//! ```
//! use terrafarm_common::id::{ShotId, WorkerId};
//! use terrafarm_common::region::Split;
//! use terrafarm_sched::{Action, Config, Event, Micros, Scheduler};
//!
//! let mut scheduler = Scheduler::new(Config::default(), 7);
//! let now = Micros(0);
//! scheduler.handle(now, Event::WorkerJoined { worker: WorkerId(1), threads: 8 });
//! scheduler.handle(now, Event::ShotSubmitted {
//!     shot: ShotId(1), frames: 1, width: 640, height: 360,
//!     split: Split::Columns, priority: 0, frames_in_flight: 2, live: false,
//! });
//! while let Some(action) = scheduler.poll_action() {
//!     if let Action::Grant { worker, lease, region, .. } = action {
//!         println!("{worker} renders {region:?} under {lease}");
//!     }
//! }
//! let wake_at = scheduler.next_deadline();
//! # assert!(wake_at.is_some());
//! ```
//!
//! After each [`Scheduler::handle`], drain [`Scheduler::poll_action`] until it is `None`,
//! then sleep until the next event or [`Scheduler::next_deadline`], and send
//! [`Event::Tick`] at the latter. Same configuration, seed and events: same actions.
//!
//! A frame is cut lazily, one job for each hungry worker: large jobs while much is left,
//! small ones at the end (guided self-scheduling), each as long as its worker is fast.
//! Frame n + 1 starts before n is done, as in section 3 of the flythrough paper.

mod audit;
mod check;
mod config;
mod event;
mod grant;
pub mod journal;
mod lease;
mod order;
mod outcome;
mod rng;
mod scheduler;
mod share;
mod shot;
pub mod sim;
mod split;
mod watch;
mod why;
mod worker;

pub use config::{
    Config, MAX_FRAMES, MAX_FRAMES_IN_FLIGHT, MAX_JOBS_PER_FRAME, MAX_SHOTS, MAX_WORKERS,
};
pub use event::{
    Action, Distrust, DropReason, Event, FrameFailure, LostReason, Micros, RefuseReason,
    SentFrames, ShotFailure,
};
pub use order::YIELD_US;
pub use scheduler::{Account, Scheduler};
pub use why::Why;
