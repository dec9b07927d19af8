//! The state machine: its parts, and what workers and shots that come and go do to it.
//!
//! Jobs are given out in `grant.rs` and come back in `outcome.rs`; `watch.rs` notices who has
//! gone, `order.rs` obeys people, `share.rs` keeps equals equal, and `check.rs` states what
//! always holds.

use crate::audit::Audits;
use crate::config::{Config, MAX_SHOTS, MAX_WORKERS};
use crate::event::{Action, Distrust, DropReason, Event, Micros, ShotFailure};
use crate::lease::Leases;
use crate::outcome::End;
use crate::rng::Rng;
use crate::shot::{ReadyKey, Shot};
use crate::worker::{HungerKey, Worker};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use terrafarm_common::id::{LeaseId, ShotId, WorkerId};

/// What became of every lease so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Account {
    /// Leases granted; the seven below add up to it, together with those still held.
    pub granted: u64,
    /// Ended by a result that was merged.
    pub accepted: u64,
    /// Ended by a result that was compared with one merged before.
    pub audited: u64,
    /// Ended by a failure that the worker reported.
    pub failed: u64,
    /// Ended by their time.
    pub expired: u64,
    /// Given back.
    pub handed_back: u64,
    /// Ended because nobody wants the result any more, or not of this worker, or not now.
    pub revoked: u64,
    /// Ended because an order made something else more urgent; part of `revoked`.
    pub preempted: u64,
    /// Ended with the worker's connection.
    pub lost: u64,
    /// Granted on purpose while another worker held the same job; part of `granted`.
    pub hedged: u64,
    /// Results refused. Their leases had ended before, or never begun.
    pub refused: u64,
}

/// When the scheduler has to look at a worker again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Timer {
    /// When a worker may have been silent for too long.
    Beat(WorkerId),
    /// When the first job of a worker has run out of time.
    Head(WorkerId),
    /// When a worker should have begun what an order has made urgent.
    Yield(WorkerId),
}

/// The state machine. See the crate's documentation for how to drive it.
#[derive(Debug)]
pub struct Scheduler {
    pub(crate) config: Config,
    pub(crate) rng: Rng,
    pub(crate) now: Micros,
    pub(crate) actions: VecDeque<Action>,
    pub(crate) account: Account,
    pub(crate) workers: BTreeMap<WorkerId, Worker>,
    pub(crate) shots: BTreeMap<ShotId, Shot>,
    pub(crate) leases: Leases,
    pub(crate) audits: Audits,
    pub(crate) timers: BTreeSet<(Micros, Timer)>,
    /// Workers that can take another job.
    pub(crate) hungry: BTreeSet<HungerKey>,
    /// Workers that could, but are barred from all there is.
    pub(crate) parked: BTreeSet<WorkerId>,
    /// Shots with something to grant.
    pub(crate) ready: BTreeSet<ReadyKey>,
    /// Leases that are the only one of their job, by when they count as late.
    pub(crate) hedgeable: BTreeSet<(Micros, LeaseId)>,
    /// Since when silence counts by the live rule, if it does.
    pub(crate) live_since: Option<Micros>,
    /// Sums over the workers that are not draining: how many, threads, speed.
    pub(crate) active: usize,
    pub(crate) active_threads: u64,
    pub(crate) active_speed: f64,
}

impl Scheduler {
    /// A scheduler without workers or shots. The seed spreads the probes of workers that
    /// joined together.
    pub fn new(config: Config, seed: u64) -> Self {
        Scheduler {
            config,
            rng: Rng::new(seed),
            now: Micros(0),
            actions: VecDeque::new(),
            account: Account::default(),
            workers: BTreeMap::new(),
            shots: BTreeMap::new(),
            leases: Leases::default(),
            audits: Audits::default(),
            timers: BTreeSet::new(),
            hungry: BTreeSet::new(),
            parked: BTreeSet::new(),
            ready: BTreeSet::new(),
            hedgeable: BTreeSet::new(),
            live_since: None,
            active: 0,
            active_threads: 0,
            active_speed: 0.0,
        }
    }

    /// Takes in what happened. `now` should not go back between calls; an earlier time is
    /// taken for the latest one seen. Drain [`Self::poll_action`] afterwards.
    pub fn handle(&mut self, now: Micros, event: Event) {
        self.wake(now);
        let may_urge = matches!(
            event,
            Event::ShotSubmitted { .. } | Event::ShotResumed { .. } | Event::ShotPrioritised { .. }
        );
        match event {
            Event::WorkerJoined { worker, threads } => self.join(worker, threads),
            Event::WorkerMeasured { worker, pixels_per_s } => {
                self.hear(worker);
                self.measure(worker, pixels_per_s);
            }
            Event::WorkerLost { worker, why: _ } => self.forget_worker(worker),
            Event::WorkerDraining { worker } => {
                self.hear(worker);
                self.drain(worker);
            }
            Event::HandedBack { worker, leases } => {
                self.hear(worker);
                for lease in leases {
                    if self.leases.is_held_by(lease, worker) {
                        self.end_lease(lease, End::HandedBack);
                    }
                }
            }
            Event::ShotSubmitted {
                shot,
                frames,
                width,
                height,
                split,
                priority,
                frames_in_flight,
                live,
            } => {
                let size = (width, height);
                let made = Shot::new(&self.config, frames, size, split, priority, frames_in_flight);
                self.submit(shot, made.map(|made| made.lively(live)));
            }
            Event::JobDone { worker, lease, cost_us, digest } => {
                self.hear(worker);
                self.job_done(worker, lease, cost_us, digest);
            }
            Event::JobFailed { worker, lease, reason } => {
                self.hear(worker);
                self.job_failed(worker, lease, reason);
            }
            Event::FrameTaken { shot, frame } => {
                if let Some(known) = self.shots.get_mut(&shot) {
                    known.untaken.remove(&frame);
                    self.refresh_ready(shot);
                }
            }
            Event::ShotCanceled { shot } => self.forget_shot(shot),
            Event::ShotPaused { shot } => self.pause(shot),
            Event::ShotResumed { shot } => self.resume(shot),
            Event::ShotPrioritised { shot, priority } => self.prioritise(shot, priority),
            Event::WorkerCleared { worker, shot } => self.clear(worker, shot),
            Event::WorkerDistrusted { worker } => {
                if self.workers.contains_key(&worker) {
                    self.distrust(worker, Distrust::Before);
                }
            }
            Event::HeardFrom { worker } => self.hear(worker),
            Event::Tick => {}
        }
        self.fire_timers();
        self.dispatch();
        if may_urge {
            self.make_way();
            self.dispatch();
        }
    }

    /// The next thing to be done; `None` when all is said. Call it until then after each
    /// [`Self::handle`].
    #[must_use]
    pub fn poll_action(&mut self) -> Option<Action> {
        self.actions.pop_front()
    }

    /// When to send [`Event::Tick`] if nothing else happens before; `None` if nothing will
    /// ever be due. May change with every [`Self::handle`], and only with it. May lie in
    /// the past: then send the tick at once.
    #[must_use]
    pub fn next_deadline(&self) -> Option<Micros> {
        let timer = self.timers.first().map(|&(at, _)| at);
        let someone_idle = self.hungry.first().is_some_and(|&(held, _, _)| held == 0);
        let late = self.hedgeable.first().map(|&(at, _)| at).filter(|_| someone_idle);
        timer.into_iter().chain(late).min()
    }

    /// What became of every lease so far.
    pub fn account(&self) -> Account {
        self.account
    }

    /// Workers connected, draining ones included.
    pub fn workers(&self) -> usize {
        self.workers.len()
    }

    /// Leases held at present.
    pub fn leases_held(&self) -> usize {
        self.leases.held.len()
    }

    fn join(&mut self, worker: WorkerId, threads: u32) {
        if self.workers.contains_key(&worker) {
            return;
        }
        if self.workers.len() >= MAX_WORKERS {
            self.actions.push_back(Action::Drop { worker, why: DropReason::FarmFull });
            return;
        }
        let joined = Worker::new(threads, self.now);
        self.workers.insert(worker, joined);
        self.enter_active(worker);
        self.watch(worker);
        self.refresh_hunger(worker);
    }

    /// Guesses the speed of a new worker: it is to that of the others as its measurement is
    /// to theirs. The median, so that one odd measurement does not spoil all guesses.
    fn measure(&mut self, worker: WorkerId, pixels_per_s: u64) {
        let measured = pixels_per_s.max(1) as f64;
        let others = self.workers.iter().filter(|&(&id, known)| id != worker && known.is_active());
        let mut ratios: Vec<f64> =
            others.filter_map(|(_, known)| Some(known.speed.value() / known.measured?)).collect();
        ratios.sort_unstable_by(f64::total_cmp);
        let average = self.active_speed / self.active_threads.max(1) as f64;
        let Some(known) = self.workers.get_mut(&worker).filter(|known| known.measured.is_none())
        else {
            return;
        };
        known.measured = Some(measured);
        if let Some(ratio) = ratios.get(ratios.len() / 2) {
            let before = known.speed.value();
            known.guess(ratio * measured, average);
            let change = known.speed.value() - before;
            if known.is_active() {
                self.active_speed += change;
            }
            self.refresh_hunger(worker);
        }
    }

    fn drain(&mut self, worker: WorkerId) {
        let Some(known) = self.workers.get_mut(&worker) else { return };
        let was_active = known.is_active();
        known.is_draining = true;
        if was_active {
            self.leave_active(worker);
            self.refresh_hunger(worker);
        }
    }

    /// Takes a worker into the sums.
    pub(crate) fn enter_active(&mut self, worker: WorkerId) {
        let Some(known) = self.workers.get(&worker) else { return };
        self.active += 1;
        self.active_threads += u64::from(known.threads);
        self.active_speed += known.speed.value();
    }

    /// Takes a worker out of the sums, and of what the shots know of it.
    pub(crate) fn leave_active(&mut self, worker: WorkerId) {
        let Some(known) = self.workers.get(&worker) else { return };
        self.active -= 1;
        self.active_threads -= u64::from(known.threads);
        self.active_speed -= known.speed.value();
        let mut alone = Vec::new();
        for (&id, shot) in &mut self.shots {
            shot.faults.remove(&worker);
            shot.blocked.remove(&worker);
            if shot.blocked.len() >= self.active {
                alone.push(id);
            }
        }
        // A block holds only while somebody else is there to do better.
        alone.into_iter().for_each(|id| self.unblock_all(id));
        self.unpark();
    }

    /// Removes a worker; what it held waits for a new lease.
    pub(crate) fn forget_worker(&mut self, worker: WorkerId) {
        let Some(known) = self.workers.get(&worker) else { return };
        let held: Vec<LeaseId> = known.held.iter().copied().collect();
        if known.is_active() {
            self.leave_active(worker);
        }
        for lease in held {
            self.end_lease(lease, End::Lost);
        }
        if let Some(gone) = self.workers.remove(&worker) {
            self.parked.remove(&worker);
            if let Some(key) = gone.hunger {
                self.hungry.remove(&key);
            }
            if let Some(at) = gone.head_deadline {
                self.timers.remove(&(at, Timer::Head(worker)));
            }
            if let Some(at) = gone.yields_at {
                self.timers.remove(&(at, Timer::Yield(worker)));
            }
        }
    }

    fn submit(&mut self, shot: ShotId, made: Result<Shot, ShotFailure>) {
        if self.shots.contains_key(&shot) {
            return;
        }
        let made = if self.shots.len() < MAX_SHOTS { made } else { Err(ShotFailure::QueueFull) };
        match made {
            Ok(made) => {
                self.shots.insert(shot, made);
                self.catch_up(shot, 0.0);
                self.refresh_ready(shot);
                self.refresh_live();
            }
            Err(reason) => self.actions.push_back(Action::ShotFailed { shot, reason }),
        }
    }

    /// Removes a shot and revokes its leases.
    pub(crate) fn forget_shot(&mut self, shot: ShotId) {
        let Some(known) = self.shots.get(&shot) else { return };
        let jobs = known.running.values();
        let leases: Vec<LeaseId> = jobs.flat_map(|job| job.leases.iter().copied()).collect();
        self.unready(shot);
        for lease in leases {
            self.end_lease(lease, End::Unwanted);
        }
        self.shots.remove(&shot);
        self.refresh_live();
        self.close_audits_of(shot);
    }

    fn fire_timers(&mut self) {
        while let Some(&(at, timer)) = self.timers.first() {
            if at > self.now {
                return;
            }
            self.timers.pop_first();
            match timer {
                Timer::Beat(worker) => self.beat(worker, at),
                Timer::Head(worker) => self.head_expired(worker),
                Timer::Yield(worker) => self.yield_head(worker),
            }
        }
    }

    /// Brings a worker's place among the hungry ones up to date.
    pub(crate) fn refresh_hunger(&mut self, worker: WorkerId) {
        let Some(known) = self.workers.get(&worker) else { return };
        let key = self.wants_more(known).then(|| known.hunger_key(worker));
        self.parked.remove(&worker);
        let Some(known) = self.workers.get_mut(&worker) else { return };
        if known.hunger != key {
            let before = std::mem::replace(&mut known.hunger, key);
            if let Some(before) = before {
                self.hungry.remove(&before);
            }
        }
        if let Some(key) = key {
            self.hungry.insert(key);
        }
    }

    fn wants_more(&self, worker: &Worker) -> bool {
        let held = worker.held.len();
        if !worker.is_active() || held == 0 || worker.is_suspect {
            return worker.is_active() && held == 0;
        }
        if held <= self.config.queue_depth {
            return true;
        }
        // Jobs so short that they do not cover the way there and back: send more.
        let costs = worker.held.iter().skip(1).filter_map(|lease| self.leases.held.get(lease));
        let queued_us: u64 = costs.map(|lease| worker.duration_us(lease.cost)).sum();
        held < self.config.max_held && (queued_us as f64) < 2.0 * worker.overhead_us
    }

    /// Lets the parked ones ask again, since something has changed for them.
    pub(crate) fn unpark(&mut self) {
        for worker in std::mem::take(&mut self.parked) {
            self.refresh_hunger(worker);
        }
    }
}
