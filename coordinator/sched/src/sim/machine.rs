//! One made-up machine with its worker program and its link.

use super::SimConfig;
use super::fault::{self, Fault};
use crate::rng::Rng;
use std::collections::VecDeque;
use terrafarm_common::id::{FrameIndex, LeaseId, ShotId, WorkerId};
use terrafarm_common::region::Region;

/// What a wireless link carries of what a wire does, and how much longer it takes, shortest
/// and longest, microseconds.
const WIRELESS: (f64, (u64, u64)) = (0.05, (2_000, 30_000));
/// The same over the internet.
const FROM_HOME: (f64, (u64, u64)) = (0.005, (15_000, 80_000));

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
    /// When the last cut or hang began that left it without a word.
    pub(crate) mute_since_us: u64,
    /// When its link has sent all that it was given.
    pub(crate) sent_at_us: u64,
    /// Renders nothing any more.
    pub(crate) is_stuck: bool,
    /// Fails at every job.
    pub(crate) is_unfit: bool,
    /// Leaves when the job it renders is done.
    pub(crate) is_leaving: bool,
    /// How long it rendered.
    pub(crate) rendered_us: u64,
    /// What will go wrong.
    pub(crate) faults: Vec<(u64, Fault)>,
}

impl Machine {
    /// A machine that is switched off. One that is spared is fit, and nothing will end its
    /// work for good.
    pub(crate) fn new(config: &SimConfig, is_spared: bool, rng: &mut Rng) -> Machine {
        let (slowest, fastest) = config.speeds;
        // Evenly over the logarithm, without a logarithm: the mean of a straight and a
        // reciprocal ramp is close to it, and the same on every machine.
        let at = rng.unit();
        let straight = slowest + (fastest - slowest) * at;
        let reciprocal = 1.0 / (1.0 / slowest + (1.0 / fastest - 1.0 / slowest) * at);
        let speed = 0.5 * (straight + reciprocal);
        let (latency_us, bytes_per_us) = link(config, rng);
        let faults = fault::plan(&config.faults, is_spared, rng);
        Machine {
            connection: None,
            speed,
            threads: (4.0 * speed).ceil() as u32,
            latency_us,
            bytes_per_us,
            queue: VecDeque::new(),
            running: None,
            cut_until_us: 0,
            hangs_until_us: 0,
            mute_since_us: 0,
            sent_at_us: 0,
            is_stuck: false,
            is_unfit: !is_spared && rng.unit() < config.faults.unfit,
            is_leaving: false,
            rendered_us: 0,
            faults,
        }
    }

    /// It hangs, or its link is cut, until this time; it may have been so before.
    pub(crate) fn mute(&mut self, now_us: u64, until_us: u64, is_cut: bool) {
        if self.hangs_until_us.max(self.cut_until_us) <= now_us {
            self.mute_since_us = now_us;
        }
        let until = if is_cut { &mut self.cut_until_us } else { &mut self.hangs_until_us };
        *until = until_us.max(*until);
    }

    /// Since when it hangs or is cut off, if it is now and this is its connection.
    pub(crate) fn mute_since(&self, now_us: u64, connection: WorkerId) -> Option<u64> {
        let is_mute = self.hangs_until_us.max(self.cut_until_us) > now_us;
        (is_mute && self.connection == Some(connection)).then_some(self.mute_since_us)
    }

    /// It has no jobs any more, and knows of none.
    pub(crate) fn clear(&mut self, now_us: u64) {
        if let Some(running) = self.running.take() {
            self.rendered_us += now_us.saturating_sub(running.began_us).min(running.takes_us);
        }
        self.queue.clear();
        self.is_leaving = false;
    }
}

/// The one-way delay of a link, microseconds, and the bytes that it carries in one. Half of
/// the slow ones are wireless, half come over the internet from a home.
fn link(config: &SimConfig, rng: &mut Rng) -> (u64, f64) {
    let (least_us, most_us) = config.latency_us;
    let near_us = least_us + rng.below(most_us.saturating_sub(least_us));
    let draw = rng.unit() / config.faults.slow_links;
    let (share, (least_us, most_us)) = match draw {
        ..0.5 => WIRELESS,
        ..1.0 => FROM_HOME,
        _ => return (near_us, config.link_bytes_per_us),
    };
    (near_us + least_us + rng.below(most_us - least_us), config.link_bytes_per_us * share)
}
