//! The made-up farm: a queue of what happens next, the coordinator and its clients.
//! `workers.rs` says what its machines do.

use super::fault::{Fault, SWITCH_CUT_US, SWITCH_SHARE};
use super::field::Field;
use super::judge::Judge;
use super::machine::Machine;
use super::tally::Tally;
use super::{SimConfig, SimReport, TimeShares};
use crate::event::{Action, Event, Micros};
use crate::journal::{Recorder, Stopped};
use crate::rng::Rng;
use crate::scheduler::Scheduler;
use std::collections::{BTreeMap, BTreeSet};
use std::io::Write;
use terrafarm_common::id::{FrameIndex, ShotId, WorkerId};

/// How long the client takes to store a frame, microseconds.
const STORE_US: u64 = 500;
/// A run that takes so long has come to a stop, virtual microseconds: a month.
const GIVE_UP_US: u64 = 30 * 86_400_000_000;

/// Something that will happen.
#[derive(Debug)]
pub(super) enum Happening {
    SwitchOn(usize),
    Fault(usize, Fault),
    /// The stay of a machine ends, if it is still connected like this.
    Depart(usize, WorkerId),
    /// A rendering ends, if it is still the one with this serial number.
    Finish(usize, u64),
    /// A message has reached the coordinator's link.
    AtHub(WorkerId, Event, f64),
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
    pub(super) config: &'a SimConfig,
    scheduler: Scheduler,
    journal: Option<Recorder<&'a mut dyn Write>>,
    stopped: Option<Stopped>,
    judge: Judge,
    pub(super) field: Field,
    pub(super) rng: Rng,
    pub(super) now_us: u64,
    queue: BTreeMap<(u64, u64), Happening>,
    /// Numbers what is put into the queue, and renderings.
    pub(super) serial: u64,
    pub(super) machines: Vec<Machine>,
    /// Which machine a connection belongs, or belonged, to.
    pub(super) connections: BTreeMap<WorkerId, usize>,
    clients: BTreeMap<ShotId, Client>,
    hub_free_at_us: u64,
    shots_left: u32,
    events: u64,
    frames: u64,
    failed_frames: u64,
    pub(super) tally: Tally,
    /// Rendering time of accepted results, at speed 1.
    useful_us: f64,
    /// What their pixels cost, without set-up and jitter.
    useful_work_us: f64,
}

impl<'a> World<'a> {
    /// Machines switched off, nothing submitted. What the scheduler is told goes on record
    /// if there is somewhere to write it and a limit for its size, bytes.
    ///
    /// # Errors
    /// If the record cannot be begun.
    pub(crate) fn new(
        config: &'a SimConfig,
        record: Option<(&'a mut dyn Write, u64)>,
    ) -> Result<Self, Stopped> {
        let mut rng = Rng::new(config.seed);
        let size = (config.width, config.height);
        let field = Field::new(rng.next(), size, config);
        let machines =
            (0..config.workers).map(|i| Machine::new(config, i == 0, &mut rng)).collect();
        let seed = rng.next();
        let begin = |(out, limit)| Recorder::begin(out, &config.scheduler, seed, limit);
        Ok(World {
            config,
            scheduler: Scheduler::new(config.scheduler.clone(), seed),
            journal: record.map(begin).transpose()?,
            stopped: None,
            judge: Judge::new(&config.scheduler),
            field,
            rng,
            now_us: 0,
            queue: BTreeMap::new(),
            serial: 0,
            machines,
            connections: BTreeMap::new(),
            clients: BTreeMap::new(),
            hub_free_at_us: 0,
            shots_left: config.shots,
            events: 0,
            frames: 0,
            failed_frames: 0,
            tally: Tally::default(),
            useful_us: 0.0,
            useful_work_us: 0.0,
        })
    }

    /// Plays until every shot is over.
    ///
    /// # Errors
    /// If the record could not be kept to the end.
    pub(crate) fn run(mut self) -> Result<SimReport, Stopped> {
        self.plan();
        let mut steps = 0u64;
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
            steps += 1;
            if self.config.check_every > 0 && steps.is_multiple_of(self.config.check_every) {
                self.judge.self_checked(self.scheduler.check_invariants());
            }
        }
        self.judge.self_checked(self.scheduler.check_invariants());
        self.judge.ended(self.scheduler.account().hedged);
        if let Some(mut journal) = self.journal.take() {
            journal.finish()?;
        }
        match self.stopped.take() {
            Some(stopped) => Err(stopped),
            None => Ok(self.report()),
        }
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
        for _ in 0..self.config.faults.switch_cuts {
            self.plan_switch_cut();
        }
        for i in 0..self.config.shots {
            let shot = ShotId(u64::from(i));
            self.clients.insert(shot, Client::default());
            let within_us = self.config.arrive_within_s * 1e6;
            let at = if i == 0 { 0 } else { (self.rng.unit() * within_us) as u64 };
            self.later(
                at,
                Happening::Arrive(Event::ShotSubmitted {
                    shot,
                    frames: self.config.frames,
                    width: self.config.width,
                    height: self.config.height,
                    split: self.config.split,
                    priority: (i % 3) as i32,
                    frames_in_flight: self.config.frames_in_flight,
                    live: i < self.config.live,
                }),
            );
        }
    }

    /// A switch fails for a while: its machines are neighbours in the list.
    fn plan_switch_cut(&mut self) {
        let at = (self.rng.unit() * self.config.faults.within_s * 1e6) as u64;
        let machines = self.machines.len() as u64;
        let size = ((machines as f64 * SWITCH_SHARE) as u64).clamp(1, machines.max(1));
        let first = self.rng.below(machines + 1 - size.min(machines));
        let us = SWITCH_CUT_US.0 + self.rng.below(SWITCH_CUT_US.1 - SWITCH_CUT_US.0);
        for i in first..(first + size).min(machines) {
            self.later(at, Happening::Fault(i as usize, Fault::Partition(us)));
        }
    }

    pub(super) fn later(&mut self, at_us: u64, happening: Happening) {
        self.serial += 1;
        self.queue.insert((at_us.max(self.now_us), self.serial), happening);
    }

    fn happen(&mut self, happening: Happening) {
        match happening {
            Happening::SwitchOn(i) => self.switch_on(i),
            Happening::Fault(i, fault) => self.go_wrong(i, fault),
            Happening::Depart(i, connection) => self.depart(i, connection),
            Happening::Finish(i, serial) => self.finish(i, serial),
            Happening::AtHub(sender, event, bytes) => {
                if self.died_with_it(sender) {
                    return;
                }
                let begins = self.hub_free_at_us.max(self.now_us);
                self.hub_free_at_us = begins + (bytes / self.config.hub_bytes_per_us) as u64;
                self.later(self.hub_free_at_us, Happening::Arrive(event));
            }
            Happening::Arrive(event) => self.tell(event),
            Happening::Deliver(i, connection, action) => self.deliver(i, connection, action),
            Happening::Stored(shot, frame) => self.tell(Event::FrameTaken { shot, frame }),
        }
    }

    /// Whether a message that arrives now was still at its sender when that lost power.
    fn died_with_it(&self, sender: WorkerId) -> bool {
        let latency_us = self.connections.get(&sender).map_or(0, |&i| self.machines[i].latency_us);
        self.tally.silent_since(sender).is_some_and(|since| self.now_us > since + latency_us)
    }

    /// Tells the scheduler, and does what it asks for.
    fn tell(&mut self, event: Event) {
        self.judge.event(Micros(self.now_us), &event);
        let rendered = match &event {
            Event::JobDone { worker, cost_us, .. } => self.work_us(*worker, *cost_us),
            _ => 0.0,
        };
        match event {
            Event::ShotSubmitted { .. } => self.tally.shot_open(self.now_us),
            Event::WorkerJoined { worker, .. } => self.tally.joined(self.now_us, worker),
            _ => {}
        }
        self.events += 1;
        let now = Micros(self.now_us);
        match &mut self.journal {
            Some(journal) => {
                let stopped = journal.handle(&mut self.scheduler, now, event).err();
                self.stopped = self.stopped.take().or(stopped);
            }
            None => self.scheduler.handle(now, event),
        }
        while let Some(action) = self.scheduler.poll_action() {
            self.judge.action(&action);
            self.obey(action, rendered);
        }
        self.judge.settled(now);
    }

    /// Does what the scheduler asks for. `rendered` is what the result at hand took, at
    /// speed 1.
    fn obey(&mut self, action: Action, rendered: f64) {
        let now_us = self.now_us;
        match action {
            Action::Grant { worker, shot, frame, .. } => {
                self.tally.granted(now_us, shot, frame);
                self.send_down(worker, action);
            }
            Action::Drop { worker, .. } => {
                let machine = self.connections.get(&worker).map(|&i| &self.machines[i]);
                let mute_us = machine.and_then(|machine| machine.mute_since(now_us, worker));
                self.tally.dropped(now_us, worker, mute_us);
                self.send_down(worker, action);
            }
            Action::Audit { worker, .. }
            | Action::Revoke { worker, .. }
            | Action::Probe { worker } => {
                self.send_down(worker, action);
            }
            Action::Accept { frame, region, .. } => {
                self.useful_us += rendered;
                self.useful_work_us += self.field.cost_us(frame, region);
            }
            Action::Refuse { worker, .. } => self.tally.refused(worker),
            Action::FrameComplete { shot, frame } => {
                self.frames += 1;
                self.tally.frame_over(now_us, shot, frame, true);
                self.client(shot, |client| client.complete.insert(frame));
            }
            Action::FrameFailed { shot, frame, .. } => {
                self.failed_frames += 1;
                self.tally.frame_over(now_us, shot, frame, false);
                self.client(shot, |client| client.failed.insert(frame));
            }
            Action::ShotComplete { .. } | Action::ShotFailed { .. } => {
                self.shots_left -= 1;
                self.tally.shot_over(now_us);
            }
            Action::Compared { .. }
            | Action::Retract { .. }
            | Action::Distrusted { .. }
            | Action::Trusted { .. }
            | Action::Disputed { .. }
            | Action::Blocked { .. }
            | Action::Unblocked { .. } => {}
        }
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

    fn report(mut self) -> SimReport {
        let account = self.scheduler.account();
        let now_us = self.now_us;
        self.tally.present(now_us, 0.0);
        let mut rendered_us = 0.0;
        for machine in &mut self.machines {
            machine.clear(now_us);
            rendered_us += machine.rendered_us as f64 * machine.speed;
        }
        let able_us = self.tally.able_us;
        let (frame_latency_s, notice_s) = self.tally.spreads();
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
                waiting: (1.0 - share(rendered_us)).max(0.0),
            },
            frame_latency_s,
            notice_s,
            zombies: self.tally.zombies,
            events: self.events,
            account,
            invariants: self.judge.violations,
            first_violation: self.judge.first,
        }
    }
}
