//! What the made-up machines do, and what goes wrong with them.

use super::fault::Fault;
use super::machine::{Running, SimJob};
use super::world::{Happening, World};
use crate::event::{Action, Event, LostReason};
use terrafarm_common::id::{LeaseId, WorkerId};

/// What a job takes on top of its pixels, microseconds.
const JOB_SETUP_US: f64 = 100.0;
/// Bytes of a message without pixels.
const SMALL_BYTES: f64 = 100.0;
/// The coordinator hears of a message that is on its way every so many microseconds.
const HEARD_EVERY_US: u64 = 50_000;
/// A machine that went off comes back after at most this time, microseconds.
const BACK_WITHIN_US: u64 = 10_000_000;

impl World<'_> {
    pub(super) fn switch_on(&mut self, i: usize) {
        let worker = WorkerId(self.connections.len() as u64 + 1);
        let machine = &mut self.machines[i];
        if machine.connection.is_some() {
            return;
        }
        self.connections.insert(worker, i);
        machine.connection = Some(worker);
        machine.sent_at_us = self.now_us;
        let joined = Event::WorkerJoined { worker, threads: machine.threads };
        self.tally.present(self.now_us, machine.speed);
        self.send_up(i, joined, SMALL_BYTES, true);
        let stay_s = self.config.faults.stay_s;
        if stay_s > 0.0 && i > 0 {
            let stay_us = self.rng.unit() * 2.0 * stay_s * 1e6;
            self.later(self.now_us + stay_us as u64, Happening::Depart(i, worker));
        }
    }

    /// The machine's connection ends, at its side at least.
    fn disconnect(&mut self, i: usize) {
        self.machines[i].clear(self.now_us);
        if self.machines[i].connection.take().is_some() {
            self.tally.present(self.now_us, -self.machines[i].speed);
        }
    }

    fn switch_off(&mut self, i: usize) {
        self.disconnect(i);
        if self.config.faults.come_back {
            let at = self.now_us + self.rng.below(BACK_WITHIN_US);
            self.later(at, Happening::SwitchOn(i));
        }
    }

    /// The stay of a machine ends in one of the ways that there are.
    pub(super) fn depart(&mut self, i: usize, connection: WorkerId) {
        let way = [Fault::Drain, Fault::Crash, Fault::PowerCut][self.rng.below(3) as usize];
        if self.machines[i].connection == Some(connection) {
            self.go_wrong(i, way);
        }
    }

    pub(super) fn go_wrong(&mut self, i: usize, fault: Fault) {
        if let Fault::Partition(us) = fault {
            self.machines[i].mute(self.now_us, self.now_us + us, true);
        }
        let Some(worker) = self.machines[i].connection else { return };
        match fault {
            Fault::Crash => {
                let lost = Event::WorkerLost { worker, why: LostReason::Broken };
                self.send_up(i, lost, SMALL_BYTES, true);
                self.switch_off(i);
            }
            Fault::PowerCut => {
                self.tally.silent(self.now_us, worker);
                self.switch_off(i);
            }
            // The link is cut, whether or not anybody uses it.
            Fault::Partition(_) => {}
            Fault::Hang(us) => self.machines[i].mute(self.now_us, self.now_us + us, false),
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
        self.serial += 1;
        let serial = self.serial;
        machine.running = Some(Running { job, began_us: self.now_us, takes_us, serial });
        if !machine.is_stuck {
            self.later(self.now_us + takes_us, Happening::Finish(i, serial));
        }
    }

    pub(super) fn finish(&mut self, i: usize, serial: u64) {
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

    pub(super) fn deliver(&mut self, i: usize, connection: WorkerId, action: Action) {
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
                self.disconnect(i);
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
        let Some(sender) = machine.connection else { return };
        let begins = machine.sent_at_us.max(self.now_us);
        machine.sent_at_us = begins + (bytes / machine.bytes_per_us) as u64;
        let (latency_us, cut_until_us) = (machine.latency_us, machine.cut_until_us);
        let at = (machine.sent_at_us + latency_us).max(cut_until_us);
        for _ in 0..copies {
            let underway = (begins + latency_us..at).step_by(HEARD_EVERY_US as usize).skip(1);
            for at in underway.filter(|&at| at >= cut_until_us) {
                self.later(at, Happening::AtHub(sender, Event::HeardFrom { worker: sender }, 0.0));
            }
            self.later(at, Happening::AtHub(sender, event.clone(), bytes));
        }
    }

    pub(super) fn send_down(&mut self, worker: WorkerId, action: Action) {
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
}
