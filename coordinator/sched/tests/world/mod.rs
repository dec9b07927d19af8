//! A small farm on a virtual clock: workers that render what they are granted in its
//! order, a wire that takes time, and no faults. Whatever a test watches for, it sees after
//! every event.

#![allow(dead_code, reason = "every test uses another part of it")]

use std::collections::{BTreeMap, VecDeque};
use terrafarm_common::id::{FrameIndex, LeaseId, ShotId, WorkerId};
use terrafarm_common::region::{Region, Split};
use terrafarm_sched::*;

pub const SECOND: u64 = 1_000_000;
/// Size of every frame, pixels.
pub const SIZE: (u32, u32) = (1920, 100);

/// What a machine makes of its jobs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Pixels {
    /// What everyone does.
    #[default]
    Right,
    /// Something else, the same each time.
    Wrong,
    /// Something else each time, of every so many jobs.
    Unsteady(u64),
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Job {
    pub lease: LeaseId,
    pub shot: ShotId,
    pub frame: FrameIndex,
    pub region: Region,
}

/// One machine.
#[derive(Debug, Default)]
pub struct Machine {
    /// Work of a microsecond.
    pub speed: f64,
    /// What it makes of them.
    pub pixels: Pixels,
    /// Jobs that wait.
    pub queue: VecDeque<Job>,
    /// What it renders: the job, when it began, when it ends.
    pub running: Option<(Job, u64, u64)>,
    /// Work done for each shot, thrown away or not.
    pub worked: BTreeMap<ShotId, f64>,
    /// Work thrown away.
    pub wasted: f64,
}

enum Happening {
    ToWorker(Action),
    ToScheduler(Event),
    Finish(WorkerId, LeaseId),
}

pub struct World {
    pub scheduler: Scheduler,
    pub now: u64,
    pub machines: BTreeMap<WorkerId, Machine>,
    /// What a pixel of each shot costs a worker of speed 1, microseconds.
    pub px_us: BTreeMap<ShotId, f64>,
    /// One way, microseconds.
    pub wire_us: u64,
    /// Complete frames of each shot.
    pub frames: BTreeMap<ShotId, u32>,
    /// What the scheduler asked for besides, and when.
    pub said: Vec<(u64, Action)>,
    ahead: BTreeMap<(u64, u64), Happening>,
    happened: u64,
}

impl World {
    pub fn new(config: Config) -> Self {
        World {
            scheduler: Scheduler::new(config, 1),
            now: 0,
            machines: BTreeMap::new(),
            px_us: BTreeMap::new(),
            wire_us: 500,
            frames: BTreeMap::new(),
            said: Vec::new(),
            ahead: BTreeMap::new(),
            happened: 0,
        }
    }

    /// A worker joins that says it has so many threads.
    pub fn join(&mut self, worker: u64, threads: u32, speed: f64) {
        let worker = WorkerId(worker);
        self.machines.insert(worker, Machine { speed, ..Machine::default() });
        self.tell(Event::WorkerJoined { worker, threads });
    }

    /// A shot whose frames take a worker of speed 1 so long, microseconds.
    pub fn submit(&mut self, shot: u64, frames: u32, priority: i32, frame_us: f64) {
        let shot = ShotId(shot);
        let (width, height) = SIZE;
        self.px_us.insert(shot, frame_us / f64::from(width * height));
        self.tell(Event::ShotSubmitted {
            shot,
            frames,
            width,
            height,
            split: Split::Columns,
            priority,
            frames_in_flight: 64,
            live: false,
        });
    }

    /// Plays until a time; `watch` sees the world after everything that happens.
    pub fn play(&mut self, until: u64, mut watch: impl FnMut(&World)) {
        loop {
            let next = self.ahead.first_key_value().map(|(&(at, _), _)| at);
            let due = self.scheduler.next_deadline().map(|at| at.0.max(self.now));
            let at = next.into_iter().chain(due).min();
            let Some(at) = at.filter(|&at| at < until) else { break };
            self.now = at;
            if next == Some(at) {
                let (_, happening) = self.ahead.pop_first().unwrap();
                self.happen(happening);
            } else {
                self.tell(Event::Tick);
            }
            watch(self);
        }
        self.now = until;
    }

    pub fn tell(&mut self, event: Event) {
        self.scheduler.handle(Micros(self.now), event);
        let mut taken = Vec::new();
        while let Some(action) = self.scheduler.poll_action() {
            match action {
                Action::Grant { .. }
                | Action::Audit { .. }
                | Action::Revoke { .. }
                | Action::Probe { .. } => {
                    self.said.extend(
                        matches!(action, Action::Audit { .. }).then(|| (self.now, action.clone())),
                    );
                    self.later(self.wire_us, Happening::ToWorker(action));
                }
                Action::FrameComplete { shot, frame } => {
                    *self.frames.entry(shot).or_default() += 1;
                    taken.push(Event::FrameTaken { shot, frame });
                }
                action => self.said.push((self.now, action)),
            }
        }
        self.scheduler.check_invariants().unwrap();
        taken.into_iter().for_each(|event| self.tell(event));
    }

    fn later(&mut self, us: u64, happening: Happening) {
        self.happened += 1;
        self.ahead.insert((self.now + us, self.happened), happening);
    }

    fn happen(&mut self, happening: Happening) {
        match happening {
            Happening::ToScheduler(event) => self.tell(event),
            Happening::ToWorker(
                Action::Grant { worker, lease, shot, frame, region }
                | Action::Audit { worker, lease, shot, frame, region, .. },
            ) => {
                let machine = self.machines.get_mut(&worker).unwrap();
                machine.queue.push_back(Job { lease, shot, frame, region });
                self.begin(worker);
            }
            Happening::ToWorker(Action::Revoke { worker, lease }) => {
                let machine = self.machines.get_mut(&worker).unwrap();
                machine.queue.retain(|job| job.lease != lease);
                if let Some((job, began, _)) = machine.running.take_if(|job| job.0.lease == lease) {
                    let work = (self.now - began) as f64 * machine.speed;
                    *machine.worked.entry(job.shot).or_default() += work;
                    machine.wasted += work;
                    self.begin(worker);
                }
            }
            Happening::ToWorker(Action::Probe { worker }) => {
                self.later(self.wire_us, Happening::ToScheduler(Event::HeardFrom { worker }));
            }
            Happening::ToWorker(_) => {}
            Happening::Finish(worker, lease) => self.finish(worker, lease),
        }
    }

    fn begin(&mut self, worker: WorkerId) {
        let machine = self.machines.get_mut(&worker).unwrap();
        if machine.running.is_some() {
            return;
        }
        let Some(job) = machine.queue.pop_front() else { return };
        let work = self.px_us[&job.shot] * job.region.area() as f64;
        let takes = (work / machine.speed).ceil() as u64 + 1;
        machine.running = Some((job, self.now, self.now + takes));
        self.later(takes, Happening::Finish(worker, job.lease));
    }

    fn finish(&mut self, worker: WorkerId, lease: LeaseId) {
        let machine = self.machines.get_mut(&worker).unwrap();
        let Some((job, began, ends)) = machine.running.take_if(|job| job.0.lease == lease) else {
            return;
        };
        let cost_us = ends - began;
        *machine.worked.entry(job.shot).or_default() += cost_us as f64 * machine.speed;
        let digest = match machine.pixels {
            Pixels::Right => 0,
            Pixels::Wrong => worker.0,
            Pixels::Unsteady(jobs) if lease.0.is_multiple_of(jobs) => u64::MAX - lease.0,
            Pixels::Unsteady(_) => 0,
        };
        let done = Event::JobDone { worker, lease, cost_us, digest };
        self.later(self.wire_us, Happening::ToScheduler(done));
        self.begin(worker);
    }
}
