//! What peers say, and what it means for the scheduler, the shots and the terrain.

use super::{Farm, Out, Peer, PeerEvent, WorkerState};
use crate::blobs::ClientId;
use crate::shots::Adoption;
use std::collections::{BTreeMap, BTreeSet};
use terrafarm_common::id::{ShotId, WorkerId};
use terrafarm_sched::{Action, Event, LostReason, Micros};
use terrafarm_terrain::store::hash_of;
use terrafarm_wire::limits::clip_reason;
use terrafarm_wire::message::{Done, Goodbye, Message, Pong, Rejected, ShotFailed, Timesheet};

impl Farm {
    pub(super) fn handle_worker(&mut self, now: Micros, worker: WorkerId, event: PeerEvent) {
        match event {
            PeerEvent::Joined(greeting) => {
                tracing::info!(%worker, name = %greeting.name, threads = greeting.threads, "worker joined");
                let threads = greeting.threads;
                let is_distrusted = self.trust.is_distrusted(&greeting);
                let state = WorkerState {
                    greeting,
                    opened: BTreeSet::new(),
                    ahead: BTreeMap::new(),
                    shelf: None,
                    leases: BTreeSet::new(),
                };
                self.workers.insert(worker, state);
                self.tally.joined(worker, now);
                self.schedule(now, Event::WorkerJoined { worker, threads });
                if is_distrusted {
                    self.schedule(now, Event::WorkerDistrusted { worker });
                }
            }
            PeerEvent::Gone(why, how) => {
                let held = self.workers.get(&worker).map_or(0, |state| state.leases.len());
                if let Some(name) = self.forget_worker(now, worker) {
                    match why {
                        LostReason::Left => tracing::info!(%worker, %name, "worker left: {how}"),
                        // Nobody waits for it: no reason to alarm anyone.
                        _ if held == 0 => tracing::info!(%worker, %name, "worker lost: {how}"),
                        _ => tracing::warn!(%worker, %name, held, "worker lost: {how}"),
                    }
                }
                self.schedule(now, Event::WorkerLost { worker, why });
            }
            PeerEvent::Said(message) if self.workers.contains_key(&worker) => {
                self.hear_worker(now, worker, message);
            }
            PeerEvent::Stirred if self.workers.contains_key(&worker) => {
                self.schedule(now, Event::HeardFrom { worker });
            }
            // It has been dropped; what was still on its way does not count.
            PeerEvent::Said(_) | PeerEvent::Stirred | PeerEvent::Adopt(_) => {}
        }
    }

    fn hear_worker(&mut self, now: Micros, worker: WorkerId, message: Message) {
        self.schedule(now, Event::HeardFrom { worker });
        match message {
            Message::Pong(_) => {}
            Message::Ping(ping) => {
                self.send(Peer::Worker(worker), Pong { number: ping.number });
            }
            Message::Done(done) => self.take_pixels(now, worker, done),
            Message::Failed(failed) => {
                let lease = failed.lease;
                tracing::warn!(%worker, %lease, "job failed: {}", failed.reason);
                self.end_lease(worker, lease);
                self.tally.job_failed(worker);
                let reason = failed.reason;
                self.schedule(now, Event::JobFailed { worker, lease, reason });
            }
            Message::HandBack(back) => {
                for &lease in &back.leases {
                    self.end_lease(worker, lease);
                }
                self.schedule(now, Event::WorkerDraining { worker });
                self.schedule(now, Event::HandedBack { worker, leases: back.leases });
            }
            Message::Speed(speed) => {
                let pixels_per_s = speed.pixels_per_s;
                self.schedule(now, Event::WorkerMeasured { worker, pixels_per_s });
            }
            Message::Status(status) => self.tally.told(worker, status),
            Message::WantBlobs(want) => self.want_blobs(worker, &want),
            Message::Sharing(sharing) => self.shares(worker, sharing.port),
            Message::Goodbye(goodbye) => {
                tracing::debug!(%worker, "says goodbye: {}", goodbye.reason);
            }
            other => self.misbehaved(now, Peer::Worker(worker), &other),
        }
    }

    pub(super) fn handle_client(&mut self, now: Micros, client: ClientId, event: PeerEvent) {
        match event {
            PeerEvent::Joined(greeting) => {
                tracing::info!(client = client.0, name = %greeting.name, "client joined");
                self.clients.insert(client, greeting);
            }
            PeerEvent::Gone(_, how) => {
                if self.clients.remove(&client).is_some() {
                    tracing::info!(client = client.0, "client left: {how}");
                }
                for shot in self.shots.of_client(client) {
                    self.schedule(now, Event::ShotCanceled { shot });
                    self.forget_shot(shot);
                }
                let orders = self.broker.client_gone(client);
                self.carry_out(orders);
            }
            PeerEvent::Said(message) if self.clients.contains_key(&client) => {
                self.hear_client(now, client, message);
            }
            PeerEvent::Adopt(adoption) if self.clients.contains_key(&client) => {
                self.adopt(now, client, *adoption);
            }
            PeerEvent::Said(_) | PeerEvent::Stirred | PeerEvent::Adopt(_) => {}
        }
    }

    fn hear_client(&mut self, now: Micros, client: ClientId, message: Message) {
        match message {
            Message::Pong(_) => {}
            Message::Ping(ping) => {
                self.send(Peer::Client(client), Pong { number: ping.number });
            }
            Message::Submit(submit) => {
                let number = submit.number;
                if let Err(why) = self.shots.submit(client, submit, now) {
                    let rejected = Rejected { number, reason: clip_reason(&why) };
                    self.send(Peer::Client(client), rejected);
                }
            }
            Message::Cameras(cameras) => match self.shots.add_cameras(client, &cameras) {
                Ok(Some((accepted, event))) => {
                    let frames = self.shots.get(accepted.shot).map_or(0, |shot| shot.submit.frames);
                    let live = self.shots.get(accepted.shot).is_some_and(|shot| shot.submit.live);
                    tracing::info!(shot = %accepted.shot, frames, live, "shot submitted");
                    self.send(Peer::Client(client), accepted);
                    self.schedule(now, event);
                }
                Ok(None) => {}
                Err(reason) => {
                    let number = cameras.number;
                    self.send(Peer::Client(client), Rejected { number, reason });
                }
            },
            Message::FrameTaken(taken) => {
                if self.shots.belongs_to(taken.shot, client) {
                    let (shot, frame) = (taken.shot, taken.frame);
                    self.schedule(now, Event::FrameTaken { shot, frame });
                }
            }
            Message::Cancel(cancel) => {
                let shot = cancel.shot;
                if self.shots.belongs_to(shot, client) {
                    self.schedule(now, Event::ShotCanceled { shot });
                    self.forget_shot(shot);
                    let reason = "canceled by the client".into();
                    self.send(Peer::Client(client), ShotFailed { shot, reason });
                }
            }
            Message::Blob(blob) => {
                // A wrong blob must not get into the memory that serves every shot.
                let orders = if hash_of(&blob.bytes) == blob.hash {
                    self.broker.arrived(blob.hash, blob.bytes)
                } else {
                    self.broker.missing(client, blob.hash, "the client sent something else")
                };
                self.carry_out(orders);
            }
            Message::NoBlob(missing) => {
                let orders = self.broker.missing(client, missing.hash, &missing.why);
                self.carry_out(orders);
            }
            Message::Goodbye(_) => {}
            other => self.misbehaved(now, Peer::Client(client), &other),
        }
    }

    fn adopt(&mut self, now: Micros, client: ClientId, adoption: Adoption) {
        let number = adoption.submit.number;
        match self.shots.adopt(client, adoption, now) {
            Ok((accepted, event)) => {
                self.send(Peer::Client(client), accepted);
                self.schedule(now, event);
            }
            Err(why) => {
                let reason = clip_reason(&why);
                self.send(Peer::Client(client), Rejected { number, reason });
            }
        }
    }

    /// Pixels came: are they what was asked for, does the lease still hold, and is that
    /// the last piece of its frame?
    fn take_pixels(&mut self, now: Micros, worker: WorkerId, done: Done) {
        let lease = done.lease;
        let granted = self.granted.get(&lease).filter(|granted| granted.worker == worker).copied();
        let pixels = match granted {
            Some(granted) => {
                let expected = granted.region.area() as usize * 3;
                match done.pixels.unpack(expected) {
                    Ok(pixels) => Some(pixels),
                    Err(why) => {
                        self.end_lease(worker, lease);
                        self.tally.job_failed(worker);
                        let reason = format!("unusable result: {why}");
                        self.schedule(now, Event::JobFailed { worker, lease, reason });
                        return;
                    }
                }
            }
            // Not held any more: the scheduler will say so.
            None => None,
        };
        let cost_us = done.report.cost_us;
        let digest = pixels.as_deref().map_or(0, |pixels| self.trust.digest(pixels));
        self.tell(now, Event::JobDone { worker, lease, cost_us, digest });
        let verdict = self.scheduler.poll_action();
        match (verdict, pixels) {
            (Some(Action::Accept { shot, frame, region, .. }), Some(pixels)) => {
                let name =
                    self.workers.get(&worker).map_or("", |state| state.greeting.name.as_str());
                self.shots.count_time(shot, name, &done.timesheet, now);
                self.tally.job_done(worker, &done.timesheet);
                let (report, check) = (&done.report, done.check.as_ref());
                self.shots.count_job(shot, frame, name, report, check);
                if let Err(why) = self.shots.merge(shot, frame, region, &pixels) {
                    tracing::error!(%shot, "cannot merge pixels: {why}");
                }
            }
            (Some(Action::Compared { agrees, .. }), _) => {
                let shot = granted.map(|granted| granted.shot);
                self.count_audit(now, worker, shot, agrees, &done.timesheet);
            }
            (Some(Action::Refuse { why, .. }), _) => {
                tracing::info!(%worker, %lease, ?why, "late result refused");
                let shot = granted.map(|granted| granted.shot);
                self.count_waste(now, worker, shot, &done.timesheet);
            }
            (other, _) => tracing::error!(%lease, ?other, "no verdict on a result"),
        }
        self.end_lease(worker, lease);
        self.obey(now);
        self.report_progress(now, granted.map(|granted| granted.shot));
    }

    /// Counts the time of a refused result. Where its lease is forgotten, it belongs to the
    /// only shot that the worker was told of, if there is only one.
    pub(super) fn count_waste(
        &mut self,
        now: Micros,
        worker: WorkerId,
        shot: Option<ShotId>,
        sheet: &Timesheet,
    ) {
        self.tally.wasted(worker, &sheet.wasted());
        let Some(state) = self.workers.get(&worker) else { return };
        let mut opened = state.opened.iter().copied();
        let only = opened.next().filter(|_| opened.next().is_none());
        if let Some(shot) = shot.or(only) {
            self.shots.count_time(shot, &state.greeting.name, &sheet.wasted(), now);
        }
    }

    fn misbehaved(&mut self, now: Micros, peer: Peer, message: &Message) {
        let kind = terrafarm_wire::message::kind_name(message.kind());
        let reason = format!("sent a {kind} message, which is not for this side");
        tracing::warn!(?peer, "{reason}");
        self.send(peer, Goodbye { reason: reason.clone() });
        self.out.push_back(Out::Close(peer, reason.clone()));
        self.handle(now, peer, PeerEvent::Gone(LostReason::Misbehaved, reason));
    }
}
