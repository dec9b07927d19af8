//! Jobs that come back, or do not: results, failures, leases that end.

use crate::event::{Action, FrameFailure, ShotFailure};
use crate::lease::Lease;
use crate::scheduler::{Scheduler, Timer};
use terrafarm_common::accuracy::Share;
use terrafarm_common::id::{FrameIndex, LeaseId, ShotId, WorkerId};

/// A job that fails so often fails its frame.
const MAX_TRIES: usize = 3;
/// A worker that fails at so many jobs of a shot is blocked for it.
const MAX_FAULTS: u32 = 3;
/// A shot ends when so many frames have failed and not one is complete.
const MAX_LEADING_FAILURES: u32 = 16;
/// A job that expired so often is given to anyone: those trusted with it do no better than
/// those that failed.
pub(crate) const HOPELESS_EXPIRIES: u32 = 1;
/// The largest time a result may claim, microseconds: a day.
const MAX_COST_US: u64 = 86_400_000_000;

/// How a lease ends when no result does it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum End {
    /// The worker gave it back.
    HandedBack,
    /// The worker failed at it.
    Failed,
    /// Its time ran out.
    Expired,
    /// The worker's connection ended.
    Lost,
    /// The worker has been blocked for its shot.
    Barred,
    /// An order has made something else more urgent.
    Preempted,
    /// Nobody wants the result any more: the job is not done again.
    Unwanted,
}

impl Scheduler {
    /// A result has come in.
    pub(crate) fn job_done(&mut self, worker: WorkerId, id: LeaseId, cost_us: u64, digest: u64) {
        if !self.leases.is_held_by(id, worker) {
            let why = self.leases.why_refused(id);
            self.account.refused += 1;
            self.actions.push_back(Action::Refuse { worker, lease: id, why });
            return;
        }
        let Some((lease, _)) = self.release(id) else { return };
        self.leases.remember_accepted(id);
        if lease.audit.is_some() {
            self.account.audited += 1;
            self.compare(id, &lease, digest, cost_us);
            return;
        }
        self.account.accepted += 1;
        let Some(shot) = self.shots.get_mut(&lease.shot) else { return };
        let Some(job) = shot.running.remove(&(lease.frame, lease.start)) else { return };
        let region = shot.grid.region(lease.start, job.end);
        if let Some(frame) = shot.open.get_mut(&lease.frame) {
            frame.accept(lease.start, job.end, worker);
        }
        let (shot, frame) = (lease.shot, lease.frame);
        self.actions.push_back(Action::Accept { lease: id, shot, frame, region });
        self.learn(&lease, job.end, cost_us);
        for other in job.leases {
            if other != id {
                self.end_lease(other, End::Unwanted);
            }
        }
        self.draw_audit(id, &lease, job.end, digest);
        self.finish_frame(lease.shot, lease.frame);
        self.refresh_hunger(worker);
    }

    /// Brings the estimates up to date.
    pub(crate) fn learn(&mut self, lease: &Lease, end: u32, cost_us: u64) {
        let Some(worker) = self.workers.get_mut(&lease.worker) else { return };
        // Nobody has rendered for longer than since the grant, whatever the report says.
        let turn_us = self.now.since(lease.granted_at).clamp(1, MAX_COST_US);
        let time_us = cost_us.clamp(1, turn_us) as f64;
        if lease.was_idle {
            worker.learn_overhead(turn_us as f64 - time_us);
        }
        worker.is_suspect = false;
        // A unit of cost is what the farm's average thread does in a microsecond. Speeds
        // and costs are both estimated from each other; this keeps them from drifting off
        // together.
        let speed = worker.speed.value();
        let average = self.active_speed / self.active_threads.max(1) as f64;
        let unit = if average > 0.0 { average } else { 1.0 };
        let cost = time_us * speed / unit;
        if lease.is_founded {
            worker.speed.learn(lease.cost, time_us);
            if worker.is_active() {
                self.active_speed += worker.speed.value() - speed;
            }
        }
        if let Some(shot) = self.shots.get_mut(&lease.shot) {
            shot.costs.learn(lease.frame, lease.start, end, cost);
        }
        self.charge(lease.shot, cost - lease.cost);
    }

    /// Says that a frame is complete, and perhaps its shot, if nothing of it is left.
    fn finish_frame(&mut self, id: ShotId, frame: FrameIndex) {
        let Some(shot) = self.shots.get_mut(&id) else { return };
        if shot.open.get(&frame).is_none_or(|open| open.left > 0) {
            return;
        }
        if let Some(open) = shot.open.remove(&frame)
            && self.config.audit != Share::NONE
        {
            shot.remember_sent(frame, &open);
        }
        shot.untaken.insert(frame);
        shot.completed += 1;
        self.actions.push_back(Action::FrameComplete { shot: id, frame });
        self.finish_shot(id);
    }

    /// Says that a shot is over, if it is.
    pub(crate) fn finish_shot(&mut self, id: ShotId) {
        let Some(shot) = self.shots.get(&id).filter(|shot| shot.is_done()) else { return };
        let failed_frames = shot.failed;
        self.forget_shot(id);
        self.actions.push_back(Action::ShotComplete { shot: id, failed_frames });
    }

    /// A worker could not do a job.
    pub(crate) fn job_failed(&mut self, worker: WorkerId, id: LeaseId, reason: String) {
        if !self.leases.is_held_by(id, worker) {
            return;
        }
        let Some(lease) = self.leases.held.get(&id) else { return };
        if lease.audit.is_some() {
            self.end_lease(id, End::Failed);
            return;
        }
        let (of, key) = (lease.shot, (lease.frame, lease.start));
        let Some(shot) = self.shots.get_mut(&of) else { return };
        let Some(job) = shot.running.get_mut(&key) else { return };
        let is_new = !job.failed_on.contains(&worker);
        job.failed_on.push(worker);
        let tries = job.failed_on.len();
        let region = shot.grid.region(key.1, job.end);
        let faults = shot.faults.entry(worker).or_default();
        *faults += u32::from(is_new);
        let is_unfit = *faults >= MAX_FAULTS;
        self.end_lease(id, End::Failed);
        if tries >= MAX_TRIES {
            self.fail_frame(of, key.0, FrameFailure::JobFailed { region, tries, worker, reason });
        }
        if is_unfit {
            self.block(worker, of);
        }
    }

    /// Gives up a frame; the shot goes on.
    fn fail_frame(&mut self, id: ShotId, frame: FrameIndex, reason: FrameFailure) {
        let Some(shot) = self.shots.get_mut(&id) else { return };
        shot.failed += 1;
        let (failed, completed) = (shot.failed, shot.completed);
        for lease in shot.close_frame(frame) {
            self.end_lease(lease, End::Unwanted);
        }
        let last = reason.clone();
        self.actions.push_back(Action::FrameFailed { shot: id, frame, reason });
        self.finish_shot(id);
        if completed == 0 && failed >= MAX_LEADING_FAILURES && self.shots.contains_key(&id) {
            self.forget_shot(id);
            let reason = ShotFailure::NothingRenders { failed_frames: failed, last };
            self.actions.push_back(Action::ShotFailed { shot: id, reason });
        }
        self.refresh_ready(id);
    }

    /// Gives a worker no more of a shot, unless nobody else could do it.
    fn block(&mut self, worker: WorkerId, id: ShotId) {
        let Some(known) = self.workers.get(&worker).filter(|known| known.is_active()) else {
            return;
        };
        let held: Vec<LeaseId> = known.held.iter().copied().collect();
        let Some(shot) = self.shots.get_mut(&id) else { return };
        if shot.blocked.len() + 1 >= self.active || !shot.blocked.insert(worker) {
            return;
        }
        self.actions.push_back(Action::Blocked { worker, shot: id });
        for lease in held {
            if self.leases.held.get(&lease).is_some_and(|lease| lease.shot == id) {
                self.end_lease(lease, End::Barred);
            }
        }
    }

    /// Gives everyone another chance.
    pub(crate) fn unblock_all(&mut self, id: ShotId) {
        let Some(shot) = self.shots.get_mut(&id) else { return };
        shot.faults.clear();
        for worker in std::mem::take(&mut shot.blocked) {
            self.actions.push_back(Action::Unblocked { worker, shot: id });
        }
        self.unpark();
    }

    /// A worker has had its first job for too long: all it holds waits for others.
    pub(crate) fn head_expired(&mut self, worker: WorkerId) {
        let now = self.now;
        let Some(known) = self.workers.get_mut(&worker) else { return };
        known.head_deadline = None;
        let before = known.speed.value();
        // Only the first of several expiries in a row is a measurement. A worker that does
        // nothing at all would else seem ever slower, and its leases last ever longer.
        if !known.is_suspect
            && let Some(head) = known.held.front().and_then(|head| self.leases.held.get(head))
        {
            known.speed.learn_overdue(head.cost, now.since(known.head_since) as f64);
        }
        known.is_suspect = true;
        if known.is_active() {
            self.active_speed += known.speed.value() - before;
        }
        let held: Vec<LeaseId> = known.held.iter().copied().collect();
        for lease in held {
            self.end_lease(lease, End::Expired);
        }
    }

    /// Ends a lease without a result. The job waits for a new one unless it is held under
    /// another lease or is not wanted.
    pub(crate) fn end_lease(&mut self, id: LeaseId, end: End) {
        let Some((lease, spent)) = self.release(id) else { return };
        self.charge(lease.shot, spent - lease.cost);
        let counter = match end {
            End::HandedBack => &mut self.account.handed_back,
            End::Failed => &mut self.account.failed,
            End::Expired => &mut self.account.expired,
            End::Lost => &mut self.account.lost,
            End::Barred | End::Preempted | End::Unwanted => &mut self.account.revoked,
        };
        *counter += 1;
        self.account.preempted += u64::from(end == End::Preempted);
        if matches!(end, End::Expired | End::Barred | End::Preempted | End::Unwanted) {
            self.actions.push_back(Action::Revoke { worker: lease.worker, lease: id });
        }
        self.refresh_hunger(lease.worker);
        if let Some(audit) = lease.audit {
            self.unanswered(audit, matches!(end, End::Failed | End::Expired));
            return;
        }
        let key = (lease.frame, lease.start);
        let Some(shot) = self.shots.get_mut(&lease.shot) else { return };
        let Some(job) = shot.running.get_mut(&key) else { return };
        job.leases.retain(|&held| held != id);
        job.expiries += u32::from(end == End::Expired);
        let is_hopeless = end == End::Expired && job.expiries >= HOPELESS_EXPIRIES;
        if let Some(&other) = job.leases.first() {
            self.refresh_hedgeable(other);
        } else if let Some(job) = shot.running.remove(&key)
            && end != End::Unwanted
        {
            shot.waiting.insert(key, job);
            self.refresh_ready(lease.shot);
            self.unpark();
        }
        if is_hopeless {
            self.unblock_all(lease.shot);
        }
    }

    /// Takes a lease out of the books; the worker goes on with the next one it holds. With it,
    /// what it has cost if there is no result, cost units.
    fn release(&mut self, id: LeaseId) -> Option<(Lease, f64)> {
        let lease = self.leases.held.remove(&id)?;
        if let Some(late_at) = lease.late_at {
            self.hedgeable.remove(&(late_at, id));
        }
        let holder = self.workers.get(&lease.worker);
        let was_head = holder.is_some_and(|worker| worker.held.front() == Some(&id));
        let since_us = holder.map_or(0, |worker| self.now.since(worker.head_since));
        let spent = self.spent(&lease, was_head, since_us);
        if let Some(worker) = self.workers.get_mut(&lease.worker) {
            worker.held.retain(|&held| held != id);
            if was_head {
                if let Some(at) = worker.head_deadline.take() {
                    self.timers.remove(&(at, Timer::Head(lease.worker)));
                }
                if let Some(at) = worker.yields_at.take() {
                    self.timers.remove(&(at, Timer::Yield(lease.worker)));
                }
                self.start_head(lease.worker);
            }
        }
        Some((lease, spent))
    }
}
