//! The coordinator's mind: what each message means, and what is to be sent.
//!
//! [`Farm`] joins the scheduler, the shots with their film, and the blob broker. It takes events of peers
//! and a time, and leaves messages in a queue; it reads no clock and knows no socket. The
//! driver task (`driver.rs`) owns it and carries the messages.

mod desk;
mod hear;
mod tally;
mod terrain;
mod trust;

use crate::blobs::{Broker, ClientId};
use crate::journal::Journal;
use crate::shots::{Adoption, FrameHead, Granted, Shots};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use terrafarm_common::accuracy::Share;
use terrafarm_common::id::{FrameIndex, LeaseId, ShotId, WorkerId};
use terrafarm_common::image::Rgb8;
use terrafarm_sched::{Action, Event, LostReason, Micros, Scheduler};
use terrafarm_wire::limits::clip_reason;
use terrafarm_wire::message::{
    CloseShot, FrameFailed, Grant, Message, OpenShot, Ping, Progress, Revoke, ShotFailed,
};

/// Shortest time between two progress messages of a shot, microseconds.
const PROGRESS_US: u64 = 200_000;

/// Who a message is from or for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Peer {
    /// Renders.
    Worker(WorkerId),
    /// Submits and takes frames.
    Client(ClientId),
}

/// Something that happened at a connection.
#[derive(Debug)]
#[expect(clippy::large_enum_variant, reason = "nearly every event is a message")]
pub enum PeerEvent {
    /// The handshake is over.
    Joined(Greeting),
    /// A message came.
    Said(Message),
    /// More came of a message that is not whole yet.
    Stirred,
    /// The queue on disk submits a shot.
    Adopt(Box<Adoption>),
    /// The connection has ended; why, in words.
    Gone(LostReason, String),
}

/// What a peer said of itself.
#[derive(Debug, Clone)]
pub struct Greeting {
    /// What to call it.
    pub name: String,
    /// Render threads; 0 for a client.
    pub threads: u32,
    /// A number of a worker's PC; 0 if it gave none.
    pub identity: u128,
    /// Where it connects from; `None` inside this process.
    pub address: Option<IpAddr>,
}

/// Something to be done by the driver.
#[derive(Debug)]
pub enum Out {
    /// Send a message.
    Send(Peer, Message),
    /// Pack a finished frame's pixels into its message and send it: packing takes time
    /// that the driver does not have.
    SendFrame(ClientId, FrameHead, Rgb8),
    /// Close a connection, after what was sent before.
    Close(Peer, String),
}

/// Everything the coordinator knows.
pub struct Farm {
    scheduler: Scheduler,
    /// Where all that the scheduler is told is recorded.
    journal: Option<Journal>,
    broker: Broker,
    workers: BTreeMap<WorkerId, WorkerState>,
    clients: BTreeMap<ClientId, Greeting>,
    shots: Shots,
    /// Leases that are held, and those whose end a worker may not have heard of: only the
    /// scheduler judges, this knows where their pixels belong.
    granted: BTreeMap<LeaseId, Granted>,
    out: VecDeque<Out>,
    pings: u64,
    /// For those who look at the farm.
    tally: tally::Tally,
    trust: trust::Trust,
    /// Bytes of terrain that wait for links to workers, and from how many on workers are sent
    /// to each other.
    unsent_bytes: u64,
    redirect_above_bytes: u64,
}

#[derive(Debug)]
struct WorkerState {
    greeting: Greeting,
    /// Shots it has been told of.
    opened: BTreeSet<ShotId>,
    /// At which frame of a shot it is to be told anew what lies ahead.
    ahead: BTreeMap<ShotId, FrameIndex>,
    /// Where it gives blobs to others.
    shelf: Option<SocketAddr>,
    leases: BTreeSet<LeaseId>,
}

impl Farm {
    /// A farm without peers.
    pub fn new(scheduler: terrafarm_sched::Config, seed: u64, blob_memory_bytes: usize) -> Self {
        let is_auditing = scheduler.audit != Share::NONE;
        Farm {
            scheduler: Scheduler::new(scheduler, seed),
            journal: None,
            broker: Broker::new(blob_memory_bytes),
            workers: BTreeMap::new(),
            clients: BTreeMap::new(),
            shots: Shots::default(),
            granted: BTreeMap::new(),
            out: VecDeque::new(),
            pings: 0,
            tally: tally::Tally::default(),
            trust: trust::Trust::new(is_auditing),
            unsent_bytes: 0,
            redirect_above_bytes: u64::MAX,
        }
    }

    /// Numbers shots with a counter that the queue on disk shares.
    pub fn counted_by(mut self, last_shot: Arc<AtomicU64>) -> Self {
        self.shots = Shots::counted_by(last_shot);
        self
    }

    /// Records all that the scheduler is told; the journal has to be one of its settings and
    /// seed, and nothing must have happened yet.
    pub fn recorded_in(mut self, journal: Journal) -> Self {
        self.journal = Some(journal);
        self
    }

    /// Writes the rest of the journal. Nothing may happen afterwards.
    pub fn finish_journal(&mut self) {
        if let Some(Err(why)) = self.journal.as_mut().map(Journal::finish) {
            tracing::warn!("{why}");
        }
    }

    /// Sends workers to each other for terrain when more than so many bytes of it wait for
    /// links. It never does unless this is called.
    pub fn redirect_above(&mut self, bytes: u64) {
        self.redirect_above_bytes = bytes;
    }

    /// So many bytes wait for links to workers now.
    pub fn set_unsent(&mut self, bytes: u64) {
        self.unsent_bytes = bytes;
    }

    /// What to do next; `None` when all is said. Call until then after every other call.
    pub fn poll_out(&mut self) -> Option<Out> {
        self.out.pop_front()
    }

    /// When [`Farm::tick`] is due.
    pub fn next_deadline(&self) -> Option<Micros> {
        self.scheduler.next_deadline()
    }

    /// The time of [`Farm::next_deadline`] has come.
    pub fn tick(&mut self, now: Micros) {
        self.schedule(now, Event::Tick);
    }

    /// Something happened at a connection.
    pub fn handle(&mut self, now: Micros, peer: Peer, event: PeerEvent) {
        match (peer, event) {
            (Peer::Worker(worker), event) => self.handle_worker(now, worker, event),
            (Peer::Client(client), event) => self.handle_client(now, client, event),
        }
    }

    fn schedule(&mut self, now: Micros, event: Event) {
        self.tell(now, event);
        self.obey(now);
    }

    /// The only way of an event to the scheduler: a journal has to have all of them.
    fn tell(&mut self, now: Micros, event: Event) {
        match &mut self.journal {
            Some(journal) => {
                if let Err(why) = journal.handle(&mut self.scheduler, now, event) {
                    tracing::warn!("{why}");
                }
            }
            None => self.scheduler.handle(now, event),
        }
    }

    /// Carries out what the scheduler asks for.
    fn obey(&mut self, now: Micros) {
        while let Some(action) = self.scheduler.poll_action() {
            match action {
                Action::Grant { worker, lease, shot, frame, region } => {
                    self.grant(now, Granted { worker, shot, frame, region }, lease);
                }
                Action::Audit { worker, lease, shot, frame, region, .. } => {
                    self.send_job(now, Granted { worker, shot, frame, region }, lease);
                }
                Action::Retract { shot, frame, region, .. } => {
                    self.shots.retract(shot, frame, region);
                }
                Action::Distrusted { worker, why, sent } => self.distrust(worker, &why, &sent),
                Action::Trusted { worker } => self.trust_again(worker),
                Action::Disputed { shot, frame, region, workers } => {
                    self.report_dispute(shot, frame, region, &workers);
                }
                Action::Revoke { worker, lease } => {
                    self.end_lease(worker, lease);
                    self.send(Peer::Worker(worker), Revoke { lease });
                }
                Action::FrameComplete { shot, frame } => self.finish_frame(now, shot, frame),
                Action::FrameFailed { shot, frame, reason } => {
                    tracing::warn!(%shot, frame = self.number(shot, frame), "frame failed: {reason}");
                    if let Some(state) = self.shots.frame_failed(shot, frame) {
                        let peer = Peer::Client(state.client);
                        let reason = clip_reason(&reason.to_string());
                        self.send(peer, FrameFailed { shot, frame, reason });
                    }
                }
                Action::ShotComplete { shot, .. } => {
                    if let Some((client, done)) = self.shots.summary(shot, now) {
                        self.send(Peer::Client(client), done);
                    }
                    self.forget_shot(shot);
                }
                Action::ShotFailed { shot, reason } => {
                    if let Some(state) = self.shots.get(shot) {
                        let peer = Peer::Client(state.client);
                        let reason = clip_reason(&reason.to_string());
                        self.send(peer, ShotFailed { shot, reason });
                    }
                    self.forget_shot(shot);
                }
                Action::Probe { worker } => {
                    self.pings += 1;
                    let number = self.pings;
                    self.send(Peer::Worker(worker), Ping { number });
                }
                Action::Drop { worker, why } => {
                    let name = self.forget_worker(now, worker).unwrap_or_default();
                    tracing::warn!(%worker, %name, "worker dropped: {why}");
                    self.out.push_back(Out::Close(Peer::Worker(worker), why.to_string()));
                }
                Action::Blocked { worker, shot } => {
                    self.tally.blocked(worker, shot, true);
                    tracing::warn!(%worker, %shot, "worker failed too often and gets no more of this shot");
                }
                Action::Unblocked { worker, shot } => {
                    self.tally.blocked(worker, shot, false);
                    tracing::info!(%worker, %shot, "worker gets jobs of this shot again");
                }
                Action::Accept { .. } | Action::Compared { .. } | Action::Refuse { .. } => {
                    tracing::error!(?action, "a verdict without a result");
                }
            }
        }
    }

    fn grant(&mut self, now: Micros, granted: Granted, lease: LeaseId) {
        let Granted { worker, shot, frame, .. } = granted;
        if self.shots.begin_frame(shot, frame, now).is_none() {
            tracing::error!(%shot, %worker, "a job for nobody");
            return;
        }
        self.send_job(now, granted, lease);
    }

    /// Sends a job to its worker, which is told of the shot first.
    fn send_job(&mut self, now: Micros, granted: Granted, lease: LeaseId) {
        let Granted { worker, shot, frame, region } = granted;
        let (Some(state), Some(worker_state)) =
            (self.shots.get(shot), self.workers.get_mut(&worker))
        else {
            tracing::error!(%shot, %worker, "a job for nobody");
            return;
        };
        let Some(&camera) = state.cameras.get(frame as usize) else {
            tracing::error!(%shot, frame, "a job without a camera");
            return;
        };
        let open = worker_state.opened.insert(shot).then(|| OpenShot {
            shot,
            index: state.submit.index,
            shading: state.submit.shading.clone(),
            quality: state.submit.quality,
            check: state.submit.check,
            width: state.submit.width,
            height: state.submit.height,
            live: state.submit.live,
        });
        worker_state.leases.insert(lease);
        self.granted.insert(lease, granted);
        if let Some(open) = open {
            if let Some(state) = self.workers.get(&worker) {
                self.shots.begin_share(shot, &state.greeting.name, now);
            }
            self.send(Peer::Worker(worker), open);
        }
        self.send(Peer::Worker(worker), Grant { lease, shot, frame, region, camera });
        self.tell_ahead(worker, shot, frame);
    }

    fn finish_frame(&mut self, now: Micros, shot: ShotId, frame: u32) {
        self.tally.frame_done(shot, frame, now);
        match self.shots.finish_frame(shot, frame, now) {
            Some((client, head, picture)) => {
                self.out.push_back(Out::SendFrame(client, head, picture));
            }
            None => tracing::error!(%shot, frame, "a complete frame without a picture"),
        }
    }

    fn report_progress(&mut self, now: Micros, shot: Option<ShotId>) {
        let Some(shot) = shot else { return };
        let jobs_running = self.granted.len() as u32;
        let workers = self.workers.len() as u32;
        let Some(state) = self.shots.get_mut(shot) else { return };
        if now.since(state.progress_at) < PROGRESS_US {
            return;
        }
        state.progress_at = now;
        let (frames_done, frames_failed) = (state.frames_done, state.frames_failed);
        let peer = Peer::Client(state.client);
        self.send(peer, Progress { shot, frames_done, frames_failed, jobs_running, workers });
    }

    fn end_lease(&mut self, worker: WorkerId, lease: LeaseId) {
        if self.granted.get(&lease).is_some_and(|granted| granted.worker == worker) {
            self.granted.remove(&lease);
        }
        if let Some(state) = self.workers.get_mut(&worker) {
            state.leases.remove(&lease);
        }
    }

    /// Returns the worker's name if it was known.
    fn forget_worker(&mut self, now: Micros, worker: WorkerId) -> Option<String> {
        self.broker.worker_gone(worker);
        self.tally.left(worker, now);
        let state = self.workers.remove(&worker)?;
        for lease in &state.leases {
            self.granted.remove(lease);
        }
        Some(state.greeting.name)
    }

    fn forget_shot(&mut self, shot: ShotId) {
        self.tally.forget_shot(shot);
        if self.shots.remove(shot).is_none() {
            return;
        }
        let told: Vec<_> = self
            .workers
            .iter_mut()
            .filter_map(|(worker, state)| {
                state.ahead.remove(&shot);
                state.opened.remove(&shot).then_some(*worker)
            })
            .collect();
        for worker in told {
            self.send(Peer::Worker(worker), CloseShot { shot });
        }
    }

    fn send(&mut self, peer: Peer, message: impl Into<Message>) {
        self.out.push_back(Out::Send(peer, message.into()));
    }
}

#[cfg(test)]
mod tests;
