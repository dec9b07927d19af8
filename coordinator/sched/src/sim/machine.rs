//! One made-up machine with its worker program and its link.

use super::fault::Fault;
use std::collections::VecDeque;
use terrafarm_common::id::{FrameIndex, LeaseId, ShotId, WorkerId};
use terrafarm_common::region::Region;

/// A job as a worker sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct SimJob {
    pub(crate) lease: LeaseId,
    pub(crate) shot: ShotId,
    pub(crate) frame: FrameIndex,
    pub(crate) region: Region,
}

/// The job that is being rendered.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Running {
    pub(crate) job: SimJob,
    pub(crate) began_us: u64,
    pub(crate) takes_us: u64,
    /// Tells this rendering from others when its end comes up in the queue.
    pub(crate) serial: u64,
}

/// One machine.
#[derive(Debug)]
pub(crate) struct Machine {
    /// Its present connection; `None` while it is off.
    pub(crate) connection: Option<WorkerId>,
    /// Work of one microsecond, in microseconds of a machine of speed 1.
    pub(crate) speed: f64,
    pub(crate) threads: u32,
    pub(crate) latency_us: u64,
    pub(crate) bytes_per_us: f64,
    pub(crate) queue: VecDeque<SimJob>,
    pub(crate) running: Option<Running>,
    /// Its link carries nothing before this time.
    pub(crate) cut_until_us: u64,
    /// Its program does nothing before this time.
    pub(crate) hangs_until_us: u64,
    /// When its link has sent all that it was given.
    pub(crate) sent_at_us: u64,
    /// Renders nothing any more.
    pub(crate) is_stuck: bool,
    /// Fails at every job.
    pub(crate) is_unfit: bool,
    /// Leaves when the job it renders is done.
    pub(crate) is_leaving: bool,
    /// Since when it has been there, if it is.
    pub(crate) present_since_us: Option<u64>,
    /// How long it was there before that.
    pub(crate) present_us: u64,
    /// How long it rendered.
    pub(crate) rendered_us: u64,
    /// What will go wrong.
    pub(crate) faults: Vec<(u64, Fault)>,
}

impl Machine {
    /// Switched off, or cut off for good as far as the program is concerned.
    pub(crate) fn clear(&mut self, now_us: u64) {
        if let Some(running) = self.running.take() {
            self.rendered_us += now_us.saturating_sub(running.began_us).min(running.takes_us);
        }
        self.queue.clear();
        self.is_leaving = false;
    }

    /// Switches it off.
    pub(crate) fn switch_off(&mut self, now_us: u64) {
        self.clear(now_us);
        self.connection = None;
        if let Some(since) = self.present_since_us.take() {
            self.present_us += now_us - since;
        }
    }
}
