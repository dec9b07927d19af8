//! What the scheduler knows of one shot: which frames are open, and what of them is left.
//!
//! Frames before `next_frame` are done unless they are in `open`; those from it on have
//! not cost a byte yet.

use crate::config::{Config, MAX_FRAMES, MAX_FRAMES_IN_FLIGHT, MAX_JOBS_PER_FRAME, MAX_WORKERS};
use crate::event::ShotFailure;
use crate::lease::Lease;
use crate::split::{CostMap, Grid};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use terrafarm_common::camera::MAX_SIDE_PX;
use terrafarm_common::id::{FrameIndex, LeaseId, ShotId, WorkerId};
use terrafarm_common::region::Split;

/// How many runs of frames are remembered of a worker; of more, the oldest are joined.
const MAX_RUNS: usize = 64;

/// A job's place: frame and first atom. No two jobs share one, since they do not overlap.
pub(crate) type JobKey = (FrameIndex, u32);

/// Which shot is served next: highest priority, then the one that was served least.
pub(crate) type ReadyKey = (Reverse<i32>, u64, ShotId);

/// A job that has been cut and is not done.
#[derive(Debug, Clone, Default)]
pub(crate) struct Job {
    /// One past its last atom.
    pub(crate) end: u32,
    /// Who failed at it, one entry for each try.
    pub(crate) failed_on: Vec<WorkerId>,
    /// How many of its leases ran out of time.
    pub(crate) expiries: u32,
    /// The leases it is held under: none while it waits, two when hedged.
    pub(crate) leases: Vec<LeaseId>,
}

/// A frame that has been begun and is not done.
#[derive(Debug)]
pub(crate) struct OpenFrame {
    /// One bit for each atom that is accepted.
    accepted: Vec<u64>,
    /// Atoms not yet accepted.
    pub(crate) left: u32,
    /// Who rendered what is accepted: first atom, one past the last one, worker.
    by: Vec<(u32, u32, WorkerId)>,
}

impl OpenFrame {
    fn new(atoms: u32) -> Self {
        OpenFrame { accepted: vec![0; atoms.div_ceil(64) as usize], left: atoms, by: Vec::new() }
    }

    /// Whether an atom is accepted.
    pub(crate) fn has(&self, atom: u32) -> bool {
        self.accepted[atom as usize / 64] >> (atom % 64) & 1 == 1
    }

    /// Marks atoms as accepted. They must not have been.
    pub(crate) fn accept(&mut self, start: u32, end: u32, by: WorkerId) {
        for atom in start..end {
            debug_assert!(!self.has(atom), "atom {atom} accepted twice");
            self.accepted[atom as usize / 64] |= 1 << (atom % 64);
        }
        self.left -= end - start;
        self.by.push((start, end, by));
    }

    /// Marks all that a worker rendered as not accepted; the jobs that it was in.
    pub(crate) fn take_back(&mut self, worker: WorkerId) -> Vec<(u32, u32)> {
        let own = self.by.extract_if(.., |(_, _, by)| *by == worker);
        let own: Vec<(u32, u32)> = own.map(|(start, end, _)| (start, end)).collect();
        for &(start, end) in &own {
            for atom in start..end {
                self.accepted[atom as usize / 64] &= !(1 << (atom % 64));
            }
            self.left += end - start;
        }
        own
    }
}

/// The one frame that is not yet cut to its end.
#[derive(Debug)]
pub(crate) struct Cutting {
    /// Which.
    pub(crate) frame: FrameIndex,
    /// Its atoms in the order in which they are cut.
    pub(crate) order: Vec<u32>,
    /// How many are cut.
    pub(crate) cut: usize,
}

/// One shot.
#[derive(Debug)]
pub(crate) struct Shot {
    /// How its frames are divided.
    pub(crate) grid: Grid,
    /// Number of frames.
    pub(crate) frames: u32,
    /// Larger is more urgent.
    pub(crate) priority: i32,
    /// Whether it waits until someone resumes it.
    pub(crate) is_paused: bool,
    /// Whether somebody waits for each of its frames.
    pub(crate) is_live: bool,
    /// Work charged to it, cost units; only differences between equals mean anything.
    pub(crate) served: f64,
    /// The most frames open or untaken.
    pub(crate) frames_in_flight: u32,
    /// The first frame not yet begun.
    pub(crate) next_frame: FrameIndex,
    /// Frames begun and not done.
    pub(crate) open: BTreeMap<FrameIndex, OpenFrame>,
    /// Frames done and not taken.
    pub(crate) untaken: BTreeSet<FrameIndex>,
    /// The last of `open`, while parts of it are in no job.
    pub(crate) cutting: Option<Cutting>,
    /// Jobs that are held under at least one lease.
    pub(crate) running: BTreeMap<JobKey, Job>,
    /// Jobs that wait for a new lease: the head of the list of what is to do.
    pub(crate) waiting: BTreeMap<JobKey, Job>,
    /// What the atoms cost.
    pub(crate) costs: CostMap,
    /// What a frame costs, as far as was known when the last one was begun.
    frame_cost: f64,
    /// Frames complete.
    pub(crate) completed: u32,
    /// Frames failed.
    pub(crate) failed: u32,
    /// Workers that get no more of it.
    pub(crate) blocked: BTreeSet<WorkerId>,
    /// Audits of its jobs that are not decided.
    pub(crate) audits: u32,
    /// Runs of complete frames that have pixels of a worker; kept where jobs are audited.
    sent: BTreeMap<WorkerId, Vec<(FrameIndex, FrameIndex)>>,
    /// How many jobs each worker failed at.
    pub(crate) faults: BTreeMap<WorkerId, u32>,
    /// Where it stands among the shots with something to grant, if it does.
    pub(crate) ready: Option<ReadyKey>,
}

impl Shot {
    /// A shot of which nothing is begun; refused if one of its numbers is out of range.
    pub(crate) fn new(
        config: &Config,
        frames: u32,
        (width, height): (u32, u32),
        split: Split,
        priority: i32,
        frames_in_flight: u32,
    ) -> Result<Self, ShotFailure> {
        let in_range = |what, value: u64, limit: u64| {
            let error = ShotFailure::OutOfRange { what, value, limit };
            if (1..=limit).contains(&value) { Ok(()) } else { Err(error) }
        };
        in_range("the number of frames", frames.into(), MAX_FRAMES.into())?;
        in_range("the width", width.into(), MAX_SIDE_PX.into())?;
        in_range("the height", height.into(), MAX_SIDE_PX.into())?;
        let limit = MAX_FRAMES_IN_FLIGHT.into();
        in_range("the number of frames in flight", frames_in_flight.into(), limit)?;
        if let Split::Tiles(side) = split {
            let limit = u64::from(MAX_SIDE_PX).min(config.max_job_px.isqrt());
            in_range("the side of a tile", side.into(), limit)?;
            let tiles = u64::from(width.div_ceil(side)) * u64::from(height.div_ceil(side));
            in_range("the number of tiles in a frame", tiles, MAX_JOBS_PER_FRAME)?;
        }
        let grid = Grid::new(width, height, split);
        Ok(Shot {
            grid,
            frames,
            priority,
            is_paused: false,
            is_live: false,
            served: 0.0,
            frames_in_flight,
            next_frame: 0,
            open: BTreeMap::new(),
            untaken: BTreeSet::new(),
            cutting: None,
            running: BTreeMap::new(),
            waiting: BTreeMap::new(),
            costs: CostMap::new(grid),
            frame_cost: 0.0,
            completed: 0,
            failed: 0,
            blocked: BTreeSet::new(),
            audits: 0,
            sent: BTreeMap::new(),
            faults: BTreeMap::new(),
            ready: None,
        })
    }

    /// The same, and whether somebody waits for each of its frames.
    pub(crate) fn lively(self, is_live: bool) -> Self {
        Shot { is_live, ..self }
    }

    /// The job that a lease is for; `None` for that of an audit.
    pub(crate) fn job_of(&self, lease: &Lease) -> Option<&Job> {
        let job = self.running.get(&(lease.frame, lease.start));
        job.filter(|_| lease.audit.is_none())
    }

    /// Frames that may be begun now.
    fn frames_to_open(&self) -> u32 {
        let in_flight = self.open.len() + self.untaken.len();
        let room = (self.frames_in_flight as usize).saturating_sub(in_flight) as u32;
        room.min(self.frames - self.next_frame)
    }

    /// Whether there is anything to grant.
    pub(crate) fn has_work(&self) -> bool {
        (!self.waiting.is_empty() || self.has_uncut()) && !self.is_paused
    }

    /// Whether somebody waits for a frame of it now.
    pub(crate) fn is_waited_for(&self) -> bool {
        self.is_live && !self.is_paused
    }

    /// Whether there is anything that no job has been cut from.
    pub(crate) fn has_uncut(&self) -> bool {
        self.cutting.is_some() || self.frames_to_open() > 0
    }

    /// Whether every frame is complete or has failed, and every audit is decided.
    pub(crate) fn is_done(&self) -> bool {
        self.completed + self.failed == self.frames && self.audits == 0
    }

    /// Remembers who rendered parts of a frame that is complete.
    pub(crate) fn remember_sent(&mut self, frame: FrameIndex, open: &OpenFrame) {
        for &(_, _, worker) in &open.by {
            if self.sent.len() >= MAX_WORKERS && !self.sent.contains_key(&worker) {
                continue;
            }
            let runs = self.sent.entry(worker).or_default();
            // Frames are complete in nearly their order: look from the end.
            let near = |run: &&mut (u32, u32)| {
                run.0 <= frame.saturating_add(1) && frame <= run.1.saturating_add(1)
            };
            match runs.iter_mut().rev().find(near) {
                Some(run) => *run = (run.0.min(frame), run.1.max(frame)),
                None => runs.push((frame, frame)),
            }
            if runs.len() > MAX_RUNS {
                runs.sort_unstable();
                let (first, second) = (runs.remove(0), &mut runs[0]);
                *second = (first.0, second.1.max(first.1));
            }
        }
    }

    /// Runs of complete frames that have pixels of a worker, in their order.
    pub(crate) fn sent_of(&self, worker: WorkerId) -> Vec<(FrameIndex, FrameIndex)> {
        let mut runs = self.sent.get(&worker).cloned().unwrap_or_default();
        runs.sort_unstable();
        let mut joined: Vec<(FrameIndex, FrameIndex)> = Vec::new();
        for run in runs {
            match joined.last_mut() {
                Some(last) if run.0 <= last.1.saturating_add(1) => last.1 = last.1.max(run.1),
                _ => joined.push(run),
            }
        }
        joined
    }

    /// Expected cost of all that may be granted now, without the jobs that wait again.
    pub(crate) fn cost_ahead(&mut self) -> f64 {
        self.open_frame();
        let rest = self.cutting.as_ref().map_or(0.0, |cutting| {
            let share = 1.0 - cutting.cut as f64 / cutting.order.len() as f64;
            share * self.frame_cost
        });
        rest + f64::from(self.frames_to_open()) * self.frame_cost
    }

    /// Begins the next frame if the last one is cut to its end and there is room.
    fn open_frame(&mut self) {
        if self.cutting.is_none() && self.frames_to_open() > 0 {
            let frame = self.next_frame;
            let atoms = self.grid.atoms();
            self.next_frame += 1;
            self.open.insert(frame, OpenFrame::new(atoms));
            self.cutting = Some(Cutting { frame, order: self.costs.order(), cut: 0 });
            self.frame_cost = self.costs.run(0, atoms);
        }
    }

    /// Cuts a job of about this cost from the lowest frame that has something left.
    pub(crate) fn cut(&mut self, target: f64, max_px: u64) -> Option<(JobKey, Job)> {
        self.open_frame();
        let cutting = self.cutting.as_mut()?;
        let start = cutting.order[cutting.cut];
        let atoms = cutting.order.len() as u32;
        let end = self.costs.cut(start, atoms, target, max_px);
        let key = (cutting.frame, start);
        cutting.cut += (end - start) as usize;
        if cutting.cut == cutting.order.len() {
            self.cutting = None;
        }
        Some((key, Job { end, ..Job::default() }))
    }

    /// Takes a waiting job, or a part of it of about this cost; the rest goes on waiting.
    pub(crate) fn take_waiting(&mut self, key: JobKey, target: f64, max_px: u64) -> Option<Job> {
        let mut job = self.waiting.remove(&key)?;
        let end = self.costs.cut(key.1, job.end, target, max_px);
        if end < job.end {
            self.waiting.insert((key.0, end), job.clone());
            job.end = end;
        }
        Some(job)
    }

    /// Forgets a frame; returns the leases its jobs are held under.
    pub(crate) fn close_frame(&mut self, frame: FrameIndex) -> Vec<LeaseId> {
        self.open.remove(&frame);
        if self.cutting.as_ref().is_some_and(|cutting| cutting.frame == frame) {
            self.cutting = None;
        }
        let of_frame = (frame, 0)..=(frame, u32::MAX);
        let waiting: Vec<JobKey> =
            self.waiting.range(of_frame.clone()).map(|(&key, _)| key).collect();
        for key in waiting {
            self.waiting.remove(&key);
        }
        self.running.range(of_frame).flat_map(|(_, job)| job.leases.iter().copied()).collect()
    }
}
