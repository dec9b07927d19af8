//! The made-up farm: machines, links and a queue of what happens next.

use super::fault::{self, Fault};
use super::field::Field;
use super::judge::Judge;
use super::machine::{Machine, Running, SimJob};
use super::{SimConfig, SimReport, TimeShares};
use crate::event::{Action, Event, LostReason, Micros};
use crate::rng::Rng;
use crate::scheduler::Scheduler;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use terrafarm_common::id::{FrameIndex, LeaseId, ShotId, WorkerId};

/// What a job takes on top of its pixels, microseconds.
const JOB_SETUP_US: f64 = 100.0;
/// How long the client takes to store a frame, microseconds.
const STORE_US: u64 = 500;
/// Bytes of a message without pixels.
const SMALL_BYTES: f64 = 100.0;
/// A run that takes so long has come to a stop, virtual microseconds: a month.
const GIVE_UP_US: u64 = 30 * 86_400_000_000;

/// Something that will happen.
#[derive(Debug)]
enum Happening {
    SwitchOn(usize),
    Fault(usize, Fault),
    /// A rendering ends, if it is still the one with this serial number.
    Finish(usize, u64),
    /// A message has reached the coordinator's link.
    AtHub(Event, f64),
    /// A message has reached the coordinator.
    Arrive(Event),
    /// A message has reached a worker, over this connection.
    Deliver(usize, WorkerId, Action),
    /// A client has stored a frame.
    Stored(ShotId, FrameIndex),
}

/// What the client of one shot waits for.
#[derive(Debug, Default)]
struct Client {
    next: FrameIndex,
    complete: BTreeSet<FrameIndex>,
    failed: BTreeSet<FrameIndex>,
    free_at_us: u64,
}

/// One run.
pub(crate) struct World<'a> {
    config: &'a SimConfig,
    scheduler: Scheduler,
    judge: Judge,
    field: Field,
    rng: Rng,
    now_us: u64,
    queue: BTreeMap<(u64, u64), Happening>,
    happened: u64,
    machines: Vec<Machine>,
    /// Which machine a connection belongs, or belonged, to.
    connections: BTreeMap<WorkerId, usize>,
    clients: BTreeMap<ShotId, Client>,
    hub_free_at_us: u64,
    shots_left: u32,
    frames: u64,
    failed_frames: u64,
    /// Rendering time of accepted results, at speed 1.
    useful_us: f64,
    /// What their pixels cost, without set-up and jitter.
    useful_work_us: f64,
}

impl<'a> World<'a> {
    /// Machines switched off, nothing submitted.
    pub(crate) fn new(config: &'a SimConfig) -> Self {
        let mut rng = Rng::new(config.seed);
        let size = (config.width, config.height);
        let field = Field::new(rng.next(), size, config.frame_work_s * 1e6, config.skew);
        let machines = (0..config.workers).map(|i| machine(config, i == 0, &mut rng)).collect();
        World {
            config,
            scheduler: Scheduler::new(config.scheduler.clone(), rng.next()),
            judge: Judge::default(),
            field,
            rng,
            now_us: 0,
            queue: BTreeMap::new(),
            happened: 0,
            machines,
            connections: BTreeMap::new(),
            clients: BTreeMap::new(),
            hub_free_at_us: 0,
            shots_left: config.shots,
            frames: 0,
            failed_frames: 0,
            useful_us: 0.0,
            useful_work_us: 0.0,
        }
    }

    /// Plays until every shot is over.
    pub(crate) fn run(mut self) -> SimReport {
        self.plan();
        let mut events = 0u64;
        while self.shots_left > 0 && self.now_us < GIVE_UP_US {
            let next_us = self.queue.first_key_value().map(|(&(at, _), _)| at);
            let due_us = self.scheduler.next_deadline().map(|at| at.0.max(self.now_us));
            match (next_us, due_us) {
                (None, None) => break,
                (next, Some(due)) if next.is_none_or(|next| due < next) => {
                    self.now_us = due;
                    self.tell(Event::Tick);
                }
                _ => {
                    let Some(((at, _), happening)) = self.queue.pop_first() else { break };
                    self.now_us = at;
                    self.happen(happening);
                }
            }
            events += 1;
            if self.config.check_every > 0 && events.is_multiple_of(self.config.check_every) {
                self.judge.self_checked(self.scheduler.check_invariants());
            }
        }
        self.judge.self_checked(self.scheduler.check_invariants());
        self.judge.ended(self.scheduler.account().hedged);
        self.report()
    }

    fn plan(&mut self) {
        for i in 0..self.machines.len() {
            let late = i > 0 && self.rng.unit() < self.config.faults.late;
            let span_us = if late { self.config.faults.within_s * 1e6 } else { 50_000.0 };
            let at = (self.rng.unit() * span_us) as u64;
            self.later(at, Happening::SwitchOn(i));
            for (at, fault) in std::mem::take(&mut self.machines[i].faults) {
                self.later(at, Happening::Fault(i, fault));
            }
        }
        for i in 0..self.config.shots {
            let shot = ShotId(u64::from(i));
            self.clients.insert(shot, Client::default());
            self.later(
                0,
                Happening::Arrive(Event::ShotSubmitted {
                    shot,
                    frames: self.config.frames,
                    width: self.config.width,
                    height: self.config.height,
                    split: self.config.split,
                    priority: (i % 2) as i32,
                    frames_in_flight: self.config.frames_in_flight,
                }),
            );
        }
    }

    fn later(&mut self, at_us: u64, happening: Happening) {
        self.happened += 1;
        self.queue.insert((at_us.max(self.now_us), self.happened), happening);
    }

    fn happen(&mut self, happening: Happening) {
        match happening {
            Happening::SwitchOn(i) => self.switch_on(i),
            Happening::Fault(i, fault) => self.go_wrong(i, fault),
            Happening::Finish(i, serial) => self.finish(i, serial),
            Happening::AtHub(event, bytes) => {
                let begins = self.hub_free_at_us.max(self.now_us);
                self.hub_free_at_us = begins + (bytes / self.config.hub_bytes_per_us) as u64;
                self.later(self.hub_free_at_us, Happening::Arrive(event));
            }
            Happening::Arrive(event) => self.tell(event),
            Happening::Deliver(i, connection, action) => self.deliver(i, connection, action),
            Happening::Stored(shot, frame) => self.tell(Event::FrameTaken { shot, frame }),
        }
    }

    /// Tells the scheduler, and does what it asks for.
    fn tell(&mut self, event: Event) {
        self.judge.event(&event);
        let rendered = match &event {
            Event::JobDone { worker, cost_us, .. } => self.work_us(*worker, *cost_us),
            _ => 0.0,
        };
        self.scheduler.handle(Micros(self.now_us), event);
        while let Some(action) = self.scheduler.poll_action() {
            self.judge.action(&action);
            match action {
                Action::Grant { worker, .. }
                | Action::Audit { worker, .. }
                | Action::Revoke { worker, .. }
                | Action::Probe { worker }
                | Action::Drop { worker, .. } => self.send_down(worker, action),
                Action::Accept { frame, region, .. } => {
                    self.useful_us += rendered;
                    self.useful_work_us += self.field.cost_us(frame, region);
                }
                Action::FrameComplete { shot, frame } => {
                    self.frames += 1;
                    self.client(shot, |client| client.complete.insert(frame));
                }
                Action::FrameFailed { shot, frame, .. } => {
                    self.failed_frames += 1;
                    self.client(shot, |client| client.failed.insert(frame));
                }
                Action::ShotComplete { .. } | Action::ShotFailed { .. } => self.shots_left -= 1,
                Action::Refuse { .. }
                | Action::Compared { .. }
                | Action::Retract { .. }
                | Action::Distrusted { .. }
                | Action::Trusted { .. }
                | Action::Disputed { .. }
                | Action::Blocked { .. }
                | Action::Unblocked { .. } => {}
            }
        }
        self.judge.settled();
    }

    /// What a time of rendering at a worker is worth at speed 1.
    fn work_us(&self, worker: WorkerId, us: u64) -> f64 {
        self.connections.get(&worker).map_or(0.0, |&i| self.machines[i].speed * us as f64)
    }

    /// The client stores frames in their order, one after the other.
    fn client(&mut self, shot: ShotId, note: impl FnOnce(&mut Client) -> bool) {
        let Some(client) = self.clients.get_mut(&shot) else { return };
        note(client);
        let mut stored = Vec::new();
        loop {
            if client.complete.remove(&client.next) {
                client.free_at_us = client.free_at_us.max(self.now_us) + STORE_US;
                stored.push((client.free_at_us, client.next));
            } else if !client.failed.remove(&client.next) {
                break;
            }
            client.next += 1;
        }
        for (at, frame) in stored {
            self.later(at, Happening::Stored(shot, frame));
        }
    }

    fn switch_on(&mut self, i: usize) {
        let worker = WorkerId(self.connections.len() as u64 + 1);
        let machine = &mut self.machines[i];
        if machine.connection.is_some() {
            return;
        }
        self.connections.insert(worker, i);
        machine.connection = Some(worker);
        machine.present_since_us = Some(self.now_us);
        machine.sent_at_us = self.now_us;
        let joined = Event::WorkerJoined { worker, threads: machine.threads };
        self.send_up(i, joined, SMALL_BYTES, true);
    }

    fn switch_off(&mut self, i: usize) {
        self.machines[i].switch_off(self.now_us);
        if self.config.faults.come_back {
            let at = self.now_us + self.rng.below(10_000_000);
            self.later(at, Happening::SwitchOn(i));
        }
    }

    fn go_wrong(&mut self, i: usize, fault: Fault) {
        let Some(worker) = self.machines[i].connection else { return };
        match fault {
            Fault::Crash => {
                let lost = Event::WorkerLost { worker, why: LostReason::Broken };
                self.send_up(i, lost, SMALL_BYTES, true);
                self.switch_off(i);
            }
            Fault::PowerCut => self.switch_off(i),
            Fault::Partition(us) => self.machines[i].cut_until_us = self.now_us + us,
            Fault::Hang(us) => self.machines[i].hangs_until_us = self.now_us + us,
            Fault::Stuck => self.machines[i].is_stuck = true,
            Fault::Drain => {
                self.send_up(i, Event::WorkerDraining { worker }, SMALL_BYTES, false);
                let leases = self.machines[i].queue.drain(..).map(|job| job.lease).collect();
                self.send_up(i, Event::HandedBack { worker, leases }, SMALL_BYTES, false);
                self.machines[i].is_leaving = true;
                if self.machines[i].running.is_none() {
                    self.leave(i, worker);
                }
            }
            Fault::HandBack => {
                let machine = &mut self.machines[i];
                let running = machine.running.map(|running| running.job.lease);
                let queued = machine.queue.iter().map(|job| job.lease);
                let leases: Vec<LeaseId> = running.into_iter().chain(queued).collect();
                machine.clear(self.now_us);
                self.send_up(i, Event::HandedBack { worker, leases }, SMALL_BYTES, false);
            }
        }
    }

    fn leave(&mut self, i: usize, worker: WorkerId) {
        let left = Event::WorkerLost { worker, why: LostReason::Left };
        self.send_up(i, left, SMALL_BYTES, true);
        self.switch_off(i);
    }

    /// Begins the next job of a machine that has nothing to do.
    fn begin(&mut self, i: usize) {
        let machine = &mut self.machines[i];
        if machine.running.is_some() {
            return;
        }
        let Some(job) = machine.queue.pop_front() else { return };
        let jitter = 0.95 + 0.1 * self.rng.unit();
        let cost = self.field.cost_us(job.frame, job.region) * jitter / machine.speed;
        let takes_us = (cost + JOB_SETUP_US).ceil() as u64;
        self.happened += 1;
        let serial = self.happened;
        machine.running = Some(Running { job, began_us: self.now_us, takes_us, serial });
        if !machine.is_stuck {
            self.later(self.now_us + takes_us, Happening::Finish(i, serial));
        }
    }

    fn finish(&mut self, i: usize, serial: u64) {
        let now_us = self.now_us;
        let machine = &mut self.machines[i];
        let (Some(worker), Some(running)) = (machine.connection, machine.running) else { return };
        if running.serial != serial || machine.is_stuck {
            return;
        }
        if machine.hangs_until_us > now_us {
            let at = machine.hangs_until_us;
            self.later(at, Happening::Finish(i, serial));
            return;
        }
        machine.running = None;
        machine.rendered_us += running.takes_us;
        let (lease, cost_us) = (running.job.lease, running.takes_us);
        let fails = machine.is_unfit || self.rng.unit() < self.config.faults.failures;
        if fails {
            let reason = "a made-up failure".to_owned();
            self.send_up(i, Event::JobFailed { worker, lease, reason }, SMALL_BYTES, false);
        } else {
            let bytes = running.job.region.area() as f64 * self.config.bytes_per_px;
            // Everyone renders the same.
            let digest = 0;
            self.send_up(i, Event::JobDone { worker, lease, cost_us, digest }, bytes, false);
        }
        if self.machines[i].is_leaving {
            self.leave(i, worker);
        } else {
            self.begin(i);
        }
    }

    fn deliver(&mut self, i: usize, connection: WorkerId, action: Action) {
        let machine = &mut self.machines[i];
        if machine.connection != Some(connection) {
            return;
        }
        let blocked_until = machine.hangs_until_us.max(machine.cut_until_us);
        if blocked_until > self.now_us {
            self.later(blocked_until, Happening::Deliver(i, connection, action));
            return;
        }
        match action {
            Action::Grant { lease, shot, frame, region, .. }
            | Action::Audit { lease, shot, frame, region, .. } => {
                let running = machine.running.map(|running| running.job.lease);
                let has_it = machine.queue.iter().any(|job| job.lease == lease);
                if machine.is_leaving {
                    let worker = connection;
                    let back = Event::HandedBack { worker, leases: vec![lease] };
                    self.send_up(i, back, SMALL_BYTES, false);
                } else if !has_it && running != Some(lease) {
                    machine.queue.push_back(SimJob { lease, shot, frame, region });
                    self.begin(i);
                }
            }
            Action::Revoke { lease, .. } => {
                machine.queue.retain(|job| job.lease != lease);
                if let Some(running) = machine.running.take_if(|r| r.job.lease == lease) {
                    machine.rendered_us += self.now_us - running.began_us;
                    if machine.is_leaving {
                        self.leave(i, connection);
                    } else {
                        self.begin(i);
                    }
                }
            }
            Action::Probe { .. } => {
                let alive = Event::HeardFrom { worker: connection };
                self.send_up(i, alive, SMALL_BYTES, false);
            }
            Action::Drop { .. } => {
                machine.switch_off(self.now_us);
                let at = self.now_us + 100_000 + self.rng.below(1_000_000);
                self.later(at, Happening::SwitchOn(i));
            }
            _ => {}
        }
    }

    /// Sends a message to the coordinator. One that TCP itself stands for is never lost.
    fn send_up(&mut self, i: usize, event: Event, bytes: f64, is_certain: bool) {
        let copies = if is_certain { 1 } else { self.copies() };
        let machine = &mut self.machines[i];
        machine.sent_at_us =
            machine.sent_at_us.max(self.now_us) + (bytes / machine.bytes_per_us) as u64;
        let at = (machine.sent_at_us + machine.latency_us).max(machine.cut_until_us);
        for _ in 0..copies {
            self.later(at, Happening::AtHub(event.clone(), bytes));
        }
    }

    fn send_down(&mut self, worker: WorkerId, action: Action) {
        let Some(&i) = self.connections.get(&worker) else { return };
        let copies = if matches!(action, Action::Drop { .. }) { 1 } else { self.copies() };
        let at = self.now_us + self.machines[i].latency_us;
        for _ in 0..copies {
            self.later(at, Happening::Deliver(i, worker, action.clone()));
        }
    }

    /// How often a message arrives.
    fn copies(&mut self) -> u32 {
        let faults = &self.config.faults;
        let draw = self.rng.unit();
        if draw < faults.loss {
            0
        } else if draw < faults.loss + faults.duplicates {
            2
        } else {
            1
        }
    }

    fn report(mut self) -> SimReport {
        let account = self.scheduler.account();
        let (mut able_us, mut rendered_us) = (0.0, 0.0);
        for machine in &mut self.machines {
            machine.switch_off(self.now_us);
            able_us += machine.present_us as f64 * machine.speed;
            rendered_us += machine.rendered_us as f64 * machine.speed;
        }
        let useful_us = self.useful_us;
        let share = |part: f64| if able_us > 0.0 { part / able_us } else { 0.0 };
        SimReport {
            workers: self.config.workers,
            seed: self.config.seed,
            efficiency: share(self.useful_work_us),
            makespan_s: self.now_us as f64 / 1e6,
            jobs: account.granted,
            frames: self.frames,
            failed_frames: self.failed_frames,
            redo_share: (1.0 - useful_us / rendered_us.max(1.0)).max(0.0),
            time: TimeShares {
                useful: share(useful_us),
                redone: share((rendered_us - useful_us).max(0.0)),
                waiting: 1.0 - share(rendered_us),
            },
            account,
            invariants: self.judge.violations,
            first_violation: self.judge.first,
        }
    }
}

fn machine(config: &SimConfig, is_spared: bool, rng: &mut Rng) -> Machine {
    let (slowest, fastest) = config.speeds;
    // Evenly over the logarithm, without a logarithm: the mean of a straight and a
    // reciprocal ramp is close to it, and the same on every machine.
    let at = rng.unit();
    let straight = slowest + (fastest - slowest) * at;
    let reciprocal = 1.0 / (1.0 / slowest + (1.0 / fastest - 1.0 / slowest) * at);
    let speed = 0.5 * (straight + reciprocal);
    let (least_us, most_us) = config.latency_us;
    let is_slow = rng.unit() < config.faults.slow_links;
    let faults = fault::plan(&config.faults, is_spared, rng);
    Machine {
        connection: None,
        speed,
        threads: (4.0 * speed).ceil() as u32,
        latency_us: least_us + rng.below(most_us.saturating_sub(least_us)),
        bytes_per_us: config.link_bytes_per_us / if is_slow { 50.0 } else { 1.0 },
        queue: VecDeque::new(),
        running: None,
        cut_until_us: 0,
        hangs_until_us: 0,
        sent_at_us: 0,
        is_stuck: false,
        is_unfit: !is_spared && rng.unit() < config.faults.unfit,
        is_leaving: false,
        present_since_us: None,
        present_us: 0,
        rendered_us: 0,
        faults,
    }
}
