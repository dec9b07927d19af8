//! What can be asked of the scheduler: about its workers, its shots, and why a frame is
//! not done.

use crate::event::Micros;
use crate::scheduler::Scheduler;
use crate::shot::Shot;
use std::collections::BTreeSet;
use std::fmt;
use terrafarm_common::id::{FrameIndex, ShotId, WorkerId};

/// How many workers a sentence names; of more it gives the number.
const NAMED: usize = 8;

/// Why a frame is not done: the first reason that holds, in the order of this list.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Why {
    /// The shot is over, or not all of it has been submitted.
    NotUnderWay,
    /// The shot has fewer frames.
    NoSuchFrame,
    /// It is over: complete and taken, or given up.
    Over,
    /// It is complete, and whoever submitted the shot has not taken it yet.
    NotTaken,
    /// The shot waits until someone resumes it.
    Paused,
    /// No worker is connected, or all of them are leaving.
    NoWorker,
    /// Jobs of it are held; `waiting` more wait for a worker.
    Running {
        /// Jobs that are held.
        jobs: usize,
        /// Who holds them.
        workers: Vec<WorkerId>,
        /// Jobs that wait for a new lease.
        waiting: usize,
    },
    /// Every worker is blocked for the shot.
    AllBlocked {
        /// How many.
        workers: usize,
    },
    /// A shot of higher priority has work for every worker.
    Outranked {
        /// That shot.
        by: ShotId,
    },
    /// Jobs of it wait after workers failed at them.
    Retrying {
        /// How many.
        jobs: usize,
        /// Who failed.
        failed_on: Vec<WorkerId>,
    },
    /// It is not begun, and as many frames as may be are open or not yet taken.
    WindowFull {
        /// Frames that are open.
        open: usize,
        /// Frames that are complete and not taken.
        untaken: usize,
        /// How many both may be together.
        limit: u32,
    },
    /// Its turn comes when workers have done what they hold.
    Waiting {
        /// Earlier frames of the shot that are not done.
        earlier: usize,
    },
}

impl fmt::Display for Why {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Why::NotUnderWay => write!(f, "its shot is over, or has not been submitted to its end"),
            Why::NoSuchFrame => write!(f, "its shot has fewer frames"),
            Why::Over => write!(f, "it is over"),
            Why::NotTaken => write!(f, "it is complete and has not been taken yet"),
            Why::Paused => write!(f, "its shot is paused"),
            Why::NoWorker => write!(f, "no worker is there that takes jobs"),
            Why::Running { jobs, workers, waiting } => {
                let verb = if *jobs == 1 { "job runs" } else { "jobs run" };
                write!(f, "{jobs} {verb} on {}", Named(workers))?;
                match waiting {
                    0 => Ok(()),
                    waiting => write!(f, "; {waiting} wait for a worker"),
                }
            }
            Why::AllBlocked { workers } => {
                write!(f, "all {workers} workers are blocked for its shot")
            }
            Why::Outranked { by } => write!(f, "{by} has a higher priority and goes first"),
            Why::Retrying { jobs, failed_on } => {
                let verb = if *jobs == 1 { "job waits" } else { "jobs wait" };
                write!(f, "{jobs} {verb} after failing on {}", Named(failed_on))
            }
            Why::WindowFull { open, untaken, limit } => write!(
                f,
                "not begun: {open} earlier frames are under way and {untaken} are not taken, and \
                 {limit} may be in flight"
            ),
            Why::Waiting { earlier } => {
                write!(f, "it waits for its turn, with {earlier} earlier frames not done")
            }
        }
    }
}

/// Some workers in a sentence.
struct Named<'a>(&'a [WorkerId]);

impl fmt::Display for Named<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0.len() > NAMED {
            return write!(f, "{} workers", self.0.len());
        }
        let names: Vec<String> = self.0.iter().map(WorkerId::to_string).collect();
        f.write_str(&names.join(", "))
    }
}

impl Scheduler {
    /// How fast a worker is, in threads of the farm's average worker; `None` if it is not
    /// connected. Before its first job it is a guess.
    pub fn speed_of(&self, worker: WorkerId) -> Option<f64> {
        let speed = self.workers.get(&worker)?.speed.value();
        let average = self.active_speed / self.active_threads.max(1) as f64;
        Some(if average > 0.0 { speed / average } else { speed })
    }

    /// Whether a worker finishes what it has and gets nothing new.
    pub fn is_draining(&self, worker: WorkerId) -> bool {
        self.workers.get(&worker).is_some_and(|known| known.is_draining)
    }

    /// Whether a worker was at fault in an audit and gets nothing until it is cleared.
    pub fn is_distrusted(&self, worker: WorkerId) -> bool {
        self.workers.get(&worker).is_some_and(|known| known.is_distrusted)
    }

    /// When the last byte of a worker came.
    pub fn heard_at(&self, worker: WorkerId) -> Option<Micros> {
        self.workers.get(&worker).map(|known| known.heard_at)
    }

    /// The shots that a worker is blocked for.
    pub fn blocked(&self, worker: WorkerId) -> Vec<ShotId> {
        let blocked = self.shots.iter().filter(|(_, shot)| shot.blocked.contains(&worker));
        blocked.map(|(&id, _)| id).collect()
    }

    /// A shot's priority, if it is under way.
    pub fn priority(&self, shot: ShotId) -> Option<i32> {
        self.shots.get(&shot).map(|known| known.priority)
    }

    /// Whether a shot waits until someone resumes it.
    pub fn is_paused(&self, shot: ShotId) -> bool {
        self.shots.get(&shot).is_some_and(|known| known.is_paused)
    }

    /// Why a frame is not done.
    pub fn why(&self, id: ShotId, frame: FrameIndex) -> Why {
        let Some(shot) = self.shots.get(&id) else { return Why::NotUnderWay };
        if frame >= shot.frames {
            return Why::NoSuchFrame;
        }
        if shot.untaken.contains(&frame) {
            return Why::NotTaken;
        }
        let is_open = shot.open.contains_key(&frame);
        if frame < shot.next_frame && !is_open {
            return Why::Over;
        }
        if shot.is_paused {
            return Why::Paused;
        }
        if self.active == 0 {
            return Why::NoWorker;
        }
        if let Some(running) = self.running(shot, frame) {
            return running;
        }
        if shot.blocked.len() >= self.active {
            return Why::AllBlocked { workers: self.active };
        }
        let first = self.ready.first().filter(|&&(priority, ..)| priority.0 > shot.priority);
        if let Some(&(_, _, by)) = first {
            return Why::Outranked { by };
        }
        if let Some(retrying) = retrying(shot, frame) {
            return retrying;
        }
        let (open, untaken) = (shot.open.len(), shot.untaken.len());
        if !is_open && open + untaken >= shot.frames_in_flight as usize {
            return Why::WindowFull { open, untaken, limit: shot.frames_in_flight };
        }
        let earlier = shot.open.range(..frame).count();
        let unopened = frame.saturating_sub(shot.next_frame) as usize;
        Why::Waiting { earlier: earlier + unopened }
    }

    /// The jobs of a frame that are held, if any are.
    fn running(&self, shot: &Shot, frame: FrameIndex) -> Option<Why> {
        let held = shot.running.range((frame, 0)..=(frame, u32::MAX));
        let jobs = held.clone().count();
        let leases = held.flat_map(|(_, job)| &job.leases);
        let workers: BTreeSet<_> =
            leases.filter_map(|id| self.leases.held.get(id)).map(|lease| lease.worker).collect();
        let waiting = shot.waiting.range((frame, 0)..=(frame, u32::MAX)).count();
        let workers = workers.into_iter().collect();
        (jobs > 0).then_some(Why::Running { jobs, workers, waiting })
    }
}

/// The jobs of a frame that wait after a failure, if any do.
fn retrying(shot: &Shot, frame: FrameIndex) -> Option<Why> {
    let waiting = shot.waiting.range((frame, 0)..=(frame, u32::MAX)).map(|(_, job)| job);
    let tried: Vec<_> = waiting.filter(|job| !job.failed_on.is_empty()).collect();
    let failed_on: BTreeSet<_> = tried.iter().flat_map(|job| &job.failed_on).copied().collect();
    let (jobs, failed_on) = (tried.len(), failed_on.into_iter().collect());
    (jobs > 0).then_some(Why::Retrying { jobs, failed_on })
}
