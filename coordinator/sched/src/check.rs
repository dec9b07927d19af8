//! What always holds, said as a check that tests and the simulator run.

use crate::event::Micros;
use crate::scheduler::{Scheduler, Timer};
use crate::shot::Shot;
use std::collections::BTreeMap;
use terrafarm_common::id::ShotId;

impl Scheduler {
    /// Checks the whole state against itself; slow. An error says what does not hold.
    ///
    /// # Errors
    /// Only if the scheduler is wrong: no event can cause one.
    pub fn check_invariants(&self) -> Result<(), String> {
        let account = self.account;
        let ended = account.accepted
            + account.audited
            + account.failed
            + account.expired
            + account.handed_back
            + account.revoked
            + account.lost;
        ensure(account.granted == ended + self.leases.held.len() as u64, || {
            format!("the account does not add up: {account:?}, {} held", self.leases.held.len())
        })?;
        self.check_leases()?;
        self.check_workers()?;
        self.check_watch()?;
        self.audits.check()?;
        self.shots.keys().try_for_each(|&shot| self.check_shot(shot))
    }

    /// Every lease is known to its worker and to its job.
    fn check_leases(&self) -> Result<(), String> {
        for (id, lease) in &self.leases.held {
            let holder = self.workers.get(&lease.worker);
            ensure(holder.is_some_and(|worker| worker.held.contains(id)), || {
                format!("{id} is held by {}, who does not hold it", lease.worker)
            })?;
            if let Some(audit) = lease.audit {
                ensure(self.audits.holds(audit, *id) && lease.late_at.is_none(), || {
                    format!("{id} is for no audit, or is to be hedged")
                })?;
                continue;
            }
            let job = self.shots.get(&lease.shot).and_then(|shot| shot.job_of(lease));
            let Some(job) = job else { return Err(format!("{id} is for no running job")) };
            ensure(job.leases.contains(id), || format!("the job of {id} does not know it"))?;
            ensure((job.leases.len() == 1) == lease.late_at.is_some(), || {
                format!("{id} is wrongly among those to hedge or missing there")
            })?;
        }
        let holders: usize = self.workers.values().map(|worker| worker.held.len()).sum();
        ensure(holders == self.leases.held.len(), || "workers hold ended leases".into())
    }

    /// The sums and the sets agree with the workers.
    fn check_workers(&self) -> Result<(), String> {
        let active = self.workers.values().filter(|worker| worker.is_active());
        let speed: f64 = active.clone().map(|worker| worker.speed.value()).sum();
        ensure(active.clone().count() == self.active, || "wrong number of active workers".into())?;
        ensure(speed == self.active_speed, || {
            format!("the speeds add up to {speed}, not {}", self.active_speed)
        })?;
        for (id, worker) in &self.workers {
            let is_hungry = worker.hunger.is_some_and(|key| self.hungry.contains(&key));
            ensure(is_hungry == worker.hunger.is_some(), || format!("{id} has a stale hunger"))?;
            ensure(worker.is_active() || !is_hungry, || format!("{id} is out and hungry"))?;
            ensure(!worker.is_distrusted || worker.held.is_empty(), || {
                format!("{id} is distrusted and holds jobs")
            })?;
            let held = worker.held.len();
            ensure(held <= self.config.max_held.max(self.config.queue_depth + 1), || {
                format!("{id} holds {held} jobs")
            })?;
            ensure(worker.head_deadline.is_some() == (held > 0), || {
                format!("{id} holds {held} jobs and its timer does not agree")
            })?;
            ensure(worker.yields_at.is_none() || held > 0, || {
                format!("{id} is to make way and holds nothing")
            })?;
        }
        let hungry = self.workers.values().filter(|worker| worker.hunger.is_some()).count();
        ensure(hungry == self.hungry.len(), || "someone gone is hungry".into())
    }

    /// Somebody looks after every worker, as sharply as the shots want it.
    fn check_watch(&self) -> Result<(), String> {
        let is_live = self.shots.values().any(Shot::is_waited_for);
        ensure(self.live_since.is_some() == is_live, || {
            format!("the live rule holds since {:?}, wrongly", self.live_since)
        })?;
        for (&id, worker) in &self.workers {
            let is_watched =
                worker.beat_at.is_some_and(|at| self.timers.contains(&(at, Timer::Beat(id))));
            ensure(is_watched || self.now == Micros(u64::MAX), || {
                format!("nobody will look whether {id} is still there")
            })?;
        }
        Ok(())
    }

    /// Every atom of an open frame is in exactly one place.
    fn check_shot(&self, id: ShotId) -> Result<(), String> {
        let shot = &self.shots[&id];
        let in_flight = shot.open.len() + shot.untaken.len();
        ensure(in_flight <= shot.frames_in_flight as usize, || {
            format!("{id} has {in_flight} frames in flight")
        })?;
        ensure(shot.ready.is_some() == shot.has_work(), || format!("{id} is wrongly ready"))?;
        ensure(shot.blocked.is_empty() || shot.blocked.len() < self.active, || {
            format!("every worker is blocked for {id}")
        })?;
        ensure(shot.waiting.values().all(|job| job.leases.is_empty()), || {
            format!("a job of {id} waits under a lease")
        })?;
        ensure(shot.running.values().all(|job| matches!(job.leases.len(), 1 | 2)), || {
            format!("a job of {id} runs under no lease or more than two")
        })?;
        ensure(shot.audits as usize == self.audits.of(id), || {
            format!("{id} counts {} audits", shot.audits)
        })?;
        let mut places: BTreeMap<(u32, u32), u32> = BTreeMap::new();
        for (&(frame, start), job) in shot.waiting.iter().chain(&shot.running) {
            (start..job.end).for_each(|atom| *places.entry((frame, atom)).or_default() += 1);
        }
        if let Some(cutting) = &shot.cutting {
            for &atom in &cutting.order[cutting.cut..] {
                *places.entry((cutting.frame, atom)).or_default() += 1;
            }
        }
        let mut expected = 0;
        for (&frame, open) in &shot.open {
            for atom in 0..shot.grid.atoms() {
                let count = places.get(&(frame, atom)).copied().unwrap_or(0);
                ensure(count + u32::from(open.has(atom)) == 1, || {
                    format!("atom {atom} of frame {frame} of {id} is in {count} jobs")
                })?;
                expected += count;
            }
        }
        ensure(places.values().sum::<u32>() == expected, || {
            format!("{id} has jobs of frames that are not open")
        })
    }
}

fn ensure(holds: bool, what: impl FnOnce() -> String) -> Result<(), String> {
    if holds { Ok(()) } else { Err(what()) }
}
