//! Orders: what people want of the shots, and how soon the workers obey.
//!
//! A shot that is stopped is revoked everywhere at once. A shot that an order has made
//! more urgent than what the workers hold does not wait for it either: what is queued
//! behind a running job makes room, and so does the running job, unless it is expected to
//! end within [`YIELD_US`]; one that does not keep to that is revoked then. So each worker
//! begins the urgent shot within that time and the time of one message.
//!
//! Only as many workers make room as the urgent shot has jobs for, those first that lose
//! least. Work is thrown away only for an order: one running job of a worker at most for
//! each. Later, when the urgent shot has been held up and has work again, it waits for jobs
//! to end, or two shots could take workers from each other for ever.

use crate::event::Action;
use crate::outcome::End;
use crate::scheduler::{Scheduler, Timer};
use crate::worker::Worker;
use terrafarm_common::id::{LeaseId, ShotId, WorkerId};

/// A running job that is in the way of an order may take so much longer, microseconds.
pub const YIELD_US: u64 = 100_000;

impl Scheduler {
    /// Stops a shot without forgetting anything: its jobs wait for new leases.
    pub(crate) fn pause(&mut self, shot: ShotId) {
        let Some(known) = self.shots.get_mut(&shot) else { return };
        known.is_paused = true;
        let jobs = known.running.values();
        let leases: Vec<LeaseId> = jobs.flat_map(|job| job.leases.iter().copied()).collect();
        for lease in leases {
            self.end_lease(lease, End::Barred);
        }
        self.refresh_ready(shot);
        self.refresh_live();
        self.close_audits_of(shot);
    }

    /// Lets a shot go on.
    pub(crate) fn resume(&mut self, shot: ShotId) {
        let Some(known) = self.shots.get_mut(&shot) else { return };
        if known.is_paused {
            known.is_paused = false;
            self.catch_up(shot, 0.0);
            self.refresh_live();
        }
        self.refresh_ready(shot);
    }

    /// Gives a shot another priority.
    pub(crate) fn prioritise(&mut self, shot: ShotId, priority: i32) {
        let Some(known) = self.shots.get_mut(&shot) else { return };
        if known.priority != priority {
            known.priority = priority;
            // Among its new equals it begins anew.
            known.served = 0.0;
            self.catch_up(shot, 0.0);
        }
        self.unready(shot);
        self.refresh_ready(shot);
    }

    /// Gives one worker another chance, at one shot or at all.
    pub(crate) fn clear(&mut self, worker: WorkerId, shot: Option<ShotId>) {
        self.trust(worker);
        for (&id, known) in &mut self.shots {
            if shot.is_none_or(|shot| shot == id) {
                known.faults.remove(&worker);
                if known.blocked.remove(&worker) {
                    self.actions.push_back(Action::Unblocked { worker, shot: id });
                }
            }
        }
        self.unpark();
    }

    /// Takes from the workers what is less urgent than what waits, and gives them that.
    pub(crate) fn make_way(&mut self) {
        let busy = self.workers.iter().filter(|(_, known)| known.is_active());
        let mut workers: Vec<_> = busy.map(|(&id, known)| (self.loss_us(known), id)).collect();
        workers.sort_unstable();
        for (_, worker) in workers {
            if self.ready.is_empty() {
                return;
            }
            self.make_way_at(worker);
        }
    }

    fn make_way_at(&mut self, worker: WorkerId) {
        let Some((shot, _)) = self.find(worker) else { return };
        let urgent = self.shots.get(&shot).map_or(i32::MIN, |shot| shot.priority);
        let Some(known) = self.workers.get(&worker) else { return };
        let held = known.held.iter().copied();
        let lesser: Vec<LeaseId> = held.filter(|&id| self.urgency(id) < urgent).collect();
        let head = known.held.front().copied();
        let rest_us = self.rest_us(known);
        let yields_at = self.now.after(YIELD_US);
        for lease in lesser {
            if Some(lease) != head || rest_us > YIELD_US {
                self.end_lease(lease, End::Preempted);
            } else if let Some(known) = self.workers.get_mut(&worker)
                && known.yields_at.is_none()
            {
                known.yields_at = Some(yields_at);
                self.timers.insert((yields_at, Timer::Yield(worker)));
            }
        }
        while self.workers.get(&worker).is_some_and(|known| known.hunger.is_some())
            && self.grant_next(worker)
        {}
    }

    /// A running job that was expected to end has not: it goes if something is more urgent.
    pub(crate) fn yield_head(&mut self, worker: WorkerId) {
        let Some(known) = self.workers.get_mut(&worker) else { return };
        known.yields_at = None;
        let Some(&head) = known.held.front() else { return };
        let queued: Vec<LeaseId> = known.held.iter().skip(1).copied().collect();
        let offered = self.find(worker).and_then(|(shot, _)| self.shots.get(&shot));
        let queued = queued.into_iter().map(|id| self.urgency(id));
        let most = queued.chain(offered.map(|shot| shot.priority)).max();
        if most.is_some_and(|most| most > self.urgency(head)) {
            self.end_lease(head, End::Preempted);
        }
    }

    /// The priority of the shot that a lease is for.
    fn urgency(&self, lease: LeaseId) -> i32 {
        let lease = self.leases.held.get(&lease);
        let shot = lease.and_then(|lease| self.shots.get(&lease.shot));
        shot.map_or(i32::MIN, |shot| shot.priority)
    }

    /// How much longer the job that a worker renders is expected to take, microseconds.
    fn rest_us(&self, worker: &Worker) -> u64 {
        let head = worker.held.front().and_then(|head| self.leases.held.get(head));
        head.map_or(0, |head| head.expected_at.since(self.now))
    }

    /// What would be lost if a worker began something else now, microseconds.
    fn loss_us(&self, worker: &Worker) -> u64 {
        if self.rest_us(worker) > YIELD_US { self.now.since(worker.head_since) } else { 0 }
    }
}
