//! Giving jobs out: which, how large, to whom, and when twice.

use crate::audit::AuditId;
use crate::config::Config;
use crate::event::Action;
use crate::lease::Lease;
use crate::outcome::HOPELESS_EXPIRIES;
use crate::scheduler::{Scheduler, Timer};
use crate::shot::{Job, JobKey, Shot};
use crate::worker::Worker;
use terrafarm_common::id::{FrameIndex, LeaseId, ShotId, WorkerId};

/// A job takes at most this share of the time that all that is left would take the whole
/// farm: one half lets every worker come twice more, so that errors of prediction level
/// out before the end.
const GUIDED_SHARE: f64 = 0.5;
/// What a worker that has not been measured gets of the longest job.
const UNMEASURED_SHARE: f64 = 0.25;
/// How many waiting jobs are looked at to find one that the worker has not failed at.
const WAITING_LOOK: usize = 8;
/// How many leases are looked at to find one to hedge.
const HEDGE_LOOK: usize = 8;
/// A copy is granted if it is expected in less than this share of the original's time.
const HEDGE_GAIN: f64 = 0.5;
/// A lease is late when it takes this share longer than predicted ...
const LATE_SHARE: f64 = 0.5;
/// ... and this time, microseconds.
const LATE_US: u64 = 50_000;
/// A lease's time doubles with every expiry of its job, at most so often.
const MAX_DOUBLINGS: u32 = 6;

impl Scheduler {
    /// Grants while there are hungry workers and something to grant, then hedges.
    pub(crate) fn dispatch(&mut self) {
        self.dispatch_audits();
        while let Some(&(_, _, worker)) = self.hungry.first() {
            if self.ready.is_empty() {
                break;
            }
            if !self.grant_next(worker) {
                self.park(worker);
            }
        }
        self.hedge();
    }

    /// Grants a worker its next job, if there is one for it.
    pub(crate) fn grant_next(&mut self, worker: WorkerId) -> bool {
        let Some((shot, again)) = self.find(worker) else { return false };
        let Some((key, job)) = self.take(worker, shot, again) else { return false };
        self.grant(worker, shot, key, job);
        self.refresh_ready(shot);
        true
    }

    /// Where the next job for a worker is: the shot, and the job if it waits there.
    pub(crate) fn find(&self, worker: WorkerId) -> Option<(ShotId, Option<JobKey>)> {
        self.ready.iter().find_map(|&(_, _, id)| {
            let shot = self.shots.get(&id).filter(|shot| !shot.blocked.contains(&worker))?;
            let again = shot.waiting.iter().take(WAITING_LOOK).find(|(_, job)| {
                let others = job.failed_on.iter().filter(|&failed| {
                    self.workers.get(failed).is_some_and(|failed| failed.is_active())
                        && !shot.blocked.contains(failed)
                });
                !job.failed_on.contains(&worker)
                    || job.expiries >= HOPELESS_EXPIRIES
                    || self.active <= shot.blocked.len() + others.count()
            });
            match again {
                Some((&key, _)) => Some((id, Some(key))),
                None => shot.has_uncut().then_some((id, None)),
            }
        })
    }

    /// Takes the next job for a worker, or a part of it, out of its shot.
    fn take(
        &mut self,
        worker: WorkerId,
        shot: ShotId,
        again: Option<JobKey>,
    ) -> Option<(JobKey, Job)> {
        let known = self.workers.get(&worker)?;
        let shot = self.shots.get_mut(&shot)?;
        let target = target_us(&self.config, shot, known, self.active_speed) * known.speed.value();
        let max_px = self.config.max_job_px;
        match again {
            Some(key) => shot.take_waiting(key, target, max_px).map(|job| (key, job)),
            None => shot.cut(target, max_px),
        }
    }

    fn park(&mut self, worker: WorkerId) {
        if let Some(known) = self.workers.get_mut(&worker)
            && let Some(key) = known.hunger.take()
        {
            self.hungry.remove(&key);
            self.parked.insert(worker);
        }
    }

    /// Grants a job that is in no list of its shot, or is running there already.
    fn grant(&mut self, worker: WorkerId, shot: ShotId, key: JobKey, job: Job) {
        let Some(of) = self.shots.get_mut(&shot) else { return };
        let (cost, is_founded) = (of.costs.run(key.1, job.end), of.costs.is_measured());
        let region = of.grid.region(key.1, job.end);
        of.running.insert(key, job);
        let place = (shot, key.0, key.1);
        let Some(lease) = self.lease(worker, place, cost, is_founded, None) else { return };
        let of = self.shots.get_mut(&shot);
        let Some(job) = of.and_then(|of| of.running.get_mut(&key)) else { return };
        job.leases.push(lease);
        let leases = job.leases.clone();
        self.account.hedged += u64::from(leases.len() > 1);
        for lease in leases {
            self.refresh_hedgeable(lease);
        }
        self.refresh_hunger(worker);
        let frame = key.0;
        self.actions.push_back(Action::Grant { worker, lease, shot, frame, region });
    }

    /// Puts a lease behind those that a worker holds.
    pub(crate) fn lease(
        &mut self,
        worker: WorkerId,
        (shot, frame, start): (ShotId, FrameIndex, u32),
        cost: f64,
        is_founded: bool,
        audit: Option<AuditId>,
    ) -> Option<LeaseId> {
        let known = self.workers.get(&worker)?;
        let queued = known.held.iter().filter_map(|lease| self.leases.held.get(lease));
        let ahead_us: u64 = queued.map(|lease| known.duration_us(lease.cost)).sum();
        let own_us = known.duration_us(cost).saturating_add(known.overhead_us as u64);
        let lease = self.leases.grant(Lease {
            worker,
            shot,
            frame,
            start,
            audit,
            cost,
            is_founded,
            granted_at: self.now,
            was_idle: known.held.is_empty(),
            expected_at: self.now.after(ahead_us).after(own_us),
            late_at: None,
        });
        self.account.granted += 1;
        self.charge(shot, cost);
        let known = self.workers.get_mut(&worker)?;
        known.held.push_back(lease);
        if known.held.len() == 1 {
            self.start_head(worker);
        }
        Some(lease)
    }

    /// The first job of a worker begins now: its time runs.
    pub(crate) fn start_head(&mut self, worker: WorkerId) {
        let Some(known) = self.workers.get_mut(&worker) else { return };
        if let Some(before) = known.head_deadline.take() {
            self.timers.remove(&(before, Timer::Head(worker)));
        }
        let Some(&head) = known.held.front() else { return };
        let Some(lease) = self.leases.held.get_mut(&head) else { return };
        let own_us = known.duration_us(lease.cost).saturating_add(known.overhead_us as u64);
        let job = self.shots.get(&lease.shot).and_then(|shot| shot.job_of(lease));
        let doublings = job.map_or(0, |job| job.expiries).min(MAX_DOUBLINGS);
        // A suspect's speed is a guess from doing nothing: it gets no longer than the others.
        let average = self.active_speed / self.active.max(1) as f64;
        let usual_us = if known.is_suspect { lease.cost / average } else { f64::INFINITY };
        let allowed = usual_us.min(own_us as f64) * self.config.lease_factor
            + self.config.lease_floor_us as f64;
        let allowed_us = (allowed * f64::from(1 << doublings)) as u64;
        let deadline = self.now.after(allowed_us.max(1));
        lease.expected_at = self.now.after(own_us);
        known.head_since = self.now;
        known.head_deadline = Some(deadline);
        self.timers.insert((deadline, Timer::Head(worker)));
        self.refresh_hedgeable(head);
    }

    /// Brings a lease's place among those that can be hedged up to date.
    pub(crate) fn refresh_hedgeable(&mut self, id: LeaseId) {
        let Some(lease) = self.leases.held.get_mut(&id) else { return };
        if let Some(before) = lease.late_at.take() {
            self.hedgeable.remove(&(before, id));
        }
        let Some(worker) = self.workers.get(&lease.worker) else { return };
        let job = self.shots.get(&lease.shot).and_then(|shot| shot.job_of(lease));
        if job.is_some_and(|job| job.leases.len() == 1) {
            let slack_us = (LATE_SHARE * worker.duration_us(lease.cost) as f64) as u64;
            let late_at = lease.expected_at.after(slack_us).after(LATE_US);
            lease.late_at = Some(late_at);
            self.hedgeable.insert((late_at, id));
        }
    }

    /// Gives idle workers copies of what is late, then of what will take longest.
    fn hedge(&mut self) {
        let mut looks = HEDGE_LOOK;
        while let Some(&(0, _, worker)) = self.hungry.first()
            && looks > 0
        {
            let Some(&(late_at, lease)) = self.hedgeable.first() else { return };
            if late_at > self.now {
                match self.slowest_for(worker) {
                    Some(slowest) => self.copy(worker, slowest),
                    None => return,
                }
            } else if self.may_copy(worker, lease) {
                self.copy(worker, lease);
            } else {
                looks -= 1;
                self.look_later(lease);
            }
        }
    }

    /// A lease that would be done much sooner if this worker began it now.
    fn slowest_for(&self, worker: WorkerId) -> Option<LeaseId> {
        let known = self.workers.get(&worker)?;
        let candidates = self.hedgeable.iter().rev().take(HEDGE_LOOK);
        candidates.map(|&(_, id)| id).find(|&id| {
            let Some(lease) = self.leases.held.get(&id) else { return false };
            let copy_us = known.duration_us(lease.cost) as f64 + known.overhead_us;
            let left_us = lease.expected_at.since(self.now) as f64;
            copy_us < HEDGE_GAIN * left_us && self.may_copy(worker, id)
        })
    }

    fn may_copy(&self, worker: WorkerId, lease: LeaseId) -> bool {
        let Some(lease) = self.leases.held.get(&lease) else { return false };
        let Some(shot) = self.shots.get(&lease.shot) else { return false };
        let job = shot.running.get(&(lease.frame, lease.start));
        lease.worker != worker
            && !shot.blocked.contains(&worker)
            && job.is_some_and(|job| {
                !job.failed_on.contains(&worker) || job.expiries >= HOPELESS_EXPIRIES
            })
    }

    fn copy(&mut self, worker: WorkerId, lease: LeaseId) {
        let Some(lease) = self.leases.held.get(&lease) else { return };
        let (shot, key) = (lease.shot, (lease.frame, lease.start));
        let job = self.shots.get(&shot).and_then(|shot| shot.running.get(&key)).cloned();
        if let Some(job) = job {
            self.grant(worker, shot, key, job);
        }
    }

    /// Nobody can copy this late lease at present.
    fn look_later(&mut self, id: LeaseId) {
        let Some(lease) = self.leases.held.get_mut(&id) else { return };
        if let Some(before) = lease.late_at.take() {
            self.hedgeable.remove(&(before, id));
        }
        let late_at = self.now.after(LATE_US);
        lease.late_at = Some(late_at);
        self.hedgeable.insert((late_at, id));
    }
}

/// How long the next job should take, microseconds: guided self-scheduling.
fn target_us(config: &Config, shot: &mut Shot, worker: &Worker, active_speed: f64) -> f64 {
    let (shortest, longest) = (config.job_min_us as f64, config.job_max_us as f64);
    if !shot.costs.is_measured() {
        // One atom: enough to learn what a pixel costs, whatever it turns out to be.
        return 0.0;
    }
    let left_us = shot.cost_ahead() / active_speed.max(worker.speed.value());
    let longest = if worker.speed.is_measured { longest } else { longest * UNMEASURED_SHARE };
    (left_us * GUIDED_SHARE).min(longest).max(shortest)
}
