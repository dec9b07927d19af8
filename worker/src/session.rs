//! What a worker does about what happens: a pure state machine.
//!
//! [`Session::handle`] takes an [`Event`], [`Session::poll_action`] gives what is to be
//! done about it. No I/O, no clock, no thread, no pixel is looked at. One session lives
//! as long as one connection; what it held when the connection broke, the coordinator
//! grants again.
//!
//! A grant waits in the queue, then for the index of its store, then renders; when the
//! ray caster names tiles that are not in memory, it pauses for them and renders what is
//! left. A job of a live shot waits only for what is on this PC: when all else is known to be
//! elsewhere it settles for what is in memory, and the rest comes for the frames after it.
//! At most one job is begun at a time: it is spread over all cores. A blob is
//! looked for on this PC first, then asked of the coordinator, each once however many
//! wait for it; the coordinator may name other workers that have it (`supply`).
//!
//! While nothing better is to be done, the views of the grants that wait and of the way
//! ahead are looked at (`outlook`), and the tiles that they will need are fetched.
//!
//! Every lease is answered exactly once, by `Done`, `Failed` or `HandBack`, unless it is
//! revoked; then never.

mod outlook;
mod supply;
#[cfg(test)]
mod tests;

pub use outlook::Glance;
pub use supply::{ASKED_MAX, EARLY_MAX, Source};

use outlook::Outlook;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use supply::{Failure, Supply};
use terrafarm_common::id::{BlobHash, LeaseId, ShotId};
use terrafarm_wire::Message;
use terrafarm_wire::limits::{HAND_BACK_MAX, clip_reason};
use terrafarm_wire::message::{
    Blob, Done, Elsewhere, Failed, Goodbye, Grant, HandBack, NoBlob, OpenShot,
};

/// Most grants that wait; more are handed back at once.
pub const QUEUE_MAX: usize = 1024;
/// Most shots that are open; grants of others fail.
pub const SHOTS_MAX: usize = 1024;

/// What can happen.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// The coordinator says something.
    Received(Message),
    /// A blob is decoded and in memory.
    Loaded(BlobHash),
    /// A blob is not on this PC.
    Absent(BlobHash),
    /// A blob is what was asked for, and yet it cannot be used.
    Spoiled(BlobHash, String),
    /// What came is not what was asked for.
    Damaged(BlobHash),
    /// A blob for later is on this PC, and in memory if there is room.
    Stocked(BlobHash),
    /// There is no room for a blob for later, neither in memory nor on disk.
    NoRoom(BlobHash),
    /// Another worker gave a blob.
    Fetched(Blob),
    /// No other worker gave it.
    Unfetched(BlobHash),
    /// The view will need these blobs that are not in memory.
    Glanced(Vec<BlobHash>),
    /// The job has done what it can without these blobs; they are at least one.
    Paused(LeaseId, Vec<BlobHash>),
    /// The job is done.
    Rendered(Done),
    /// The job cannot be done.
    Broken(LeaseId, String),
    /// The job has been stopped, as asked.
    Stopped(LeaseId),
    /// The link has taken one `Done` that waited.
    Sent,
    /// Someone asks this worker to leave, for this reason.
    Leave(String),
}

/// What is to be done.
#[derive(Debug, Clone, PartialEq)]
pub enum Action {
    /// Tell the coordinator. Each `Done` is followed by an [`Event::Sent`].
    Send(Message),
    /// Look for a blob on this PC: answered by `Loaded`, `Absent` or `Spoiled`.
    Load(BlobHash),
    /// A blob has come: check it, keep it, load it. Answered by `Loaded`, `Damaged` or
    /// `Spoiled`.
    Take(Blob),
    /// Look for a blob for later on this PC: answered by `Stocked`, `NoRoom`, `Absent` or
    /// `Spoiled`.
    Seek(BlobHash),
    /// A blob for later has come: check it and keep it. Answered by `Stocked`, `NoRoom`,
    /// `Damaged` or `Spoiled`.
    Stock(Blob),
    /// Ask other workers for a blob: answered by `Fetched` or `Unfetched`.
    Fetch(Elsewhere),
    /// Find out which tiles a view will need: answered by `Glanced`.
    Glance(Glance, Arc<OpenShot>),
    /// Begin a job; the index of its store is loaded. Answered by `Paused`, `Rendered` or
    /// `Broken`, and also by `Stopped` after a [`Action::Stop`].
    Start(Grant, Arc<OpenShot>),
    /// Go on with the paused job. Answered like `Start`.
    Resume(LeaseId),
    /// Finish the paused job with the tiles in memory. Answered like `Start`; by `Paused` only
    /// if there is nothing to show.
    Settle(LeaseId),
    /// Stop the job that runs, soon. Answered by any of its answers.
    Stop(LeaseId),
    /// Forget the paused job. Not answered.
    Discard(LeaseId),
    /// A shot is over.
    Close(ShotId),
    /// No open shot uses this store any more.
    Release(BlobHash),
    /// All is said: close the connection once it is sent.
    End,
}

/// The worker's side of one connection.
#[derive(Debug, Default)]
pub struct Session {
    shots: BTreeMap<ShotId, Arc<OpenShot>>,
    queue: VecDeque<Queued>,
    current: Option<Current>,
    supply: Supply,
    outlook: Outlook,
    /// What the last live job did without, and the next ones will not have to.
    foregone: BTreeSet<BlobHash>,
    /// Stores whose index is in memory.
    mapped: BTreeSet<BlobHash>,
    unsent: usize,
    leaving: Option<String>,
    ended: bool,
    actions: VecDeque<Action>,
}

/// A job that waits for its turn.
#[derive(Debug)]
struct Queued {
    grant: Grant,
    /// Its view has been looked at.
    seen: bool,
}

/// The job that has been begun, or waits for the index of its store.
#[derive(Debug)]
struct Current {
    grant: Grant,
    shot: Arc<OpenShot>,
    phase: Phase,
    /// Whether `Start` has been given.
    begun: bool,
    /// It can do without what is not on this PC.
    lenient: bool,
    /// `Settle` has been given, and not `Resume` since.
    settled: bool,
}

#[derive(Debug)]
enum Phase {
    /// For these blobs.
    Waiting(BTreeSet<BlobHash>),
    Rendering,
    /// Revoked or given up; the renderer has yet to notice.
    Stopping,
}

/// What a worker does, as far as its session knows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Doing {
    /// It has no job.
    #[default]
    Idle,
    /// Its job waits for terrain.
    Waiting,
    /// Its job renders.
    Rendering,
    /// It has jobs, and pixels that the link has to take first.
    Sending,
}

impl Current {
    fn settle(&mut self, actions: &mut VecDeque<Action>) {
        self.phase = Phase::Rendering;
        self.settled = true;
        actions.push_back(Action::Settle(self.grant.lease));
    }
}

impl Session {
    /// A session that holds nothing.
    pub fn new() -> Self {
        Session::default()
    }

    /// Takes note of an event. Drain [`Session::poll_action`] afterwards.
    pub fn handle(&mut self, event: Event) {
        if self.ended {
            return;
        }
        match event {
            Event::Received(message) => self.receive(message),
            Event::Loaded(hash) => self.supplied(hash),
            Event::Absent(hash) => {
                self.supply.absent(hash);
                self.forgo(hash);
            }
            Event::Spoiled(hash, why) => {
                let failure = self.supply.lost(hash);
                self.failed_supply(hash, failure, &why);
            }
            Event::Damaged(hash) => {
                let failure = self.supply.damaged(hash);
                self.forgo(hash);
                self.failed_supply(hash, failure, "what came has another hash");
            }
            Event::Stocked(hash) => self.supply.stocked(hash, &mut self.actions),
            Event::NoRoom(hash) => self.supply.no_room(hash, &mut self.actions),
            Event::Fetched(blob) => self.supply.arrived(blob, Source::Peer, &mut self.actions),
            Event::Unfetched(hash) => self.supply.unfetched(hash),
            Event::Glanced(hashes) => {
                self.outlook.answered();
                self.supply.foresee(hashes);
            }
            Event::Paused(lease, missing) => self.pause(lease, missing),
            Event::Rendered(done) => {
                if self.leave_job(done.lease) {
                    self.unsent += 1;
                    self.send(done);
                }
            }
            Event::Broken(lease, reason) => {
                if self.leave_job(lease) {
                    self.fail(lease, &reason);
                }
            }
            Event::Stopped(lease) => {
                self.leave_job(lease);
            }
            Event::Sent => self.unsent = self.unsent.saturating_sub(1),
            Event::Leave(reason) => self.leave(reason),
        }
        self.begin();
        self.ask();
        self.look_ahead();
        self.finish();
    }

    /// What is done until the next event.
    pub fn doing(&self) -> Doing {
        match &self.current {
            Some(Current { phase: Phase::Waiting(_), .. }) => Doing::Waiting,
            Some(_) => Doing::Rendering,
            None if self.unsent > 0 && !self.queue.is_empty() => Doing::Sending,
            None => Doing::Idle,
        }
    }

    /// The next thing to do; `None` until the next event.
    pub fn poll_action(&mut self) -> Option<Action> {
        self.actions.pop_front()
    }

    fn receive(&mut self, message: Message) {
        match message {
            Message::OpenShot(shot) if self.shots.len() < SHOTS_MAX => {
                self.shots.insert(shot.shot, Arc::new(shot));
            }
            Message::Grant(grant) => self.granted(grant),
            Message::Revoke(revoke) => self.revoke(revoke.lease),
            Message::CloseShot(close) => self.close(close.shot),
            Message::Ahead(ahead) if self.shots.contains_key(&ahead.shot) => {
                self.outlook.hear(ahead);
            }
            Message::Blob(blob) => {
                self.supply.arrived(blob, Source::Coordinator, &mut self.actions);
            }
            Message::Elsewhere(elsewhere) => {
                self.supply.redirected(elsewhere, &mut self.actions);
            }
            Message::NoBlob(NoBlob { hash, why }) => {
                let failure = self.supply.refused(hash);
                self.failed_supply(hash, failure, &why);
            }
            Message::Drain(_) => self.leave("the coordinator asked for it".to_owned()),
            _ => {}
        }
    }

    fn granted(&mut self, grant: Grant) {
        let queued = self.queue.iter().map(|queued| &queued.grant);
        let mut held = queued.chain(self.current.as_ref().map(|job| &job.grant));
        if held.any(|other| other.lease == grant.lease) {
            return;
        }
        let Some(shot) = self.shots.get(&grant.shot) else {
            return self.fail(grant.lease, &format!("{} has not been opened here", grant.shot));
        };
        if (grant.camera.width, grant.camera.height) != (shot.width, shot.height) {
            let size = format!("{} x {}", grant.camera.width, grant.camera.height);
            return self.fail(grant.lease, &format!("the camera has {size} pixels, the shot not"));
        }
        if self.leaving.is_some() || self.queue.len() >= QUEUE_MAX {
            return self.send(HandBack { leases: vec![grant.lease] });
        }
        self.queue.push_back(Queued { grant, seen: false });
    }

    fn revoke(&mut self, lease: LeaseId) {
        self.queue.retain(|queued| queued.grant.lease != lease);
        if let Some(job) = self.current.as_mut().filter(|job| job.grant.lease == lease) {
            match job.phase {
                Phase::Rendering => {
                    job.phase = Phase::Stopping;
                    self.actions.push_back(Action::Stop(lease));
                }
                Phase::Waiting(_) => self.drop_waiting(),
                Phase::Stopping => {}
            }
        }
    }

    fn close(&mut self, shot: ShotId) {
        let Some(closed) = self.shots.remove(&shot) else { return };
        let of_shot = |queued: &Queued| queued.grant.shot == shot;
        let orphans: Vec<_> =
            self.queue.iter().filter(|q| of_shot(q)).map(|q| q.grant.lease).collect();
        self.queue.retain(|queued| !of_shot(queued));
        self.hand_back(orphans);
        self.outlook.close(shot);
        self.supply.forget_foreseen();
        self.foregone.clear();
        self.actions.push_back(Action::Close(shot));
        if !self.shots.values().any(|open| open.index == closed.index) {
            self.mapped.remove(&closed.index);
            self.actions.push_back(Action::Release(closed.index));
        }
    }

    fn leave(&mut self, reason: String) {
        if self.leaving.is_none() {
            self.leaving = Some(reason);
            let unbegun = self.queue.drain(..).map(|queued| queued.grant.lease).collect();
            self.hand_back(unbegun);
        }
    }

    /// Takes the next grant of the queue, unless one is begun or the link is behind.
    fn begin(&mut self) {
        while self.current.is_none() && self.unsent == 0 {
            let Some(Queued { grant, .. }) = self.queue.pop_front() else { return };
            let Some(shot) = self.shots.get(&grant.shot).cloned() else { continue };
            let index = shot.index;
            let phase = Phase::Waiting(BTreeSet::from([index]));
            self.current =
                Some(Current { grant, shot, phase, begun: false, lenient: false, settled: false });
            self.supply.need(index, &mut self.actions);
        }
    }

    /// Says goodbye when the last job is answered.
    fn finish(&mut self) {
        if self.current.is_none()
            && self.queue.is_empty()
            && self.unsent == 0
            && let Some(reason) = self.leaving.take()
        {
            self.send(Goodbye { reason: clip_reason(&reason) });
            self.actions.push_back(Action::End);
            self.ended = true;
        }
    }

    fn pause(&mut self, lease: LeaseId, missing: Vec<BlobHash>) {
        let Some(job) = self.current.as_mut().filter(|job| job.grant.lease == lease) else {
            return;
        };
        match job.phase {
            Phase::Rendering => {
                job.lenient = job.shot.live && !job.settled;
                if job.lenient {
                    self.foregone.clear();
                }
                let mut waits = BTreeSet::new();
                for hash in missing {
                    let may_be_here = self.supply.need(hash, &mut self.actions);
                    let set = match job.lenient && !may_be_here {
                        true => &mut self.foregone,
                        false => &mut waits,
                    };
                    set.insert(hash);
                }
                if waits.is_empty() {
                    job.settle(&mut self.actions);
                } else {
                    job.phase = Phase::Waiting(waits);
                }
            }
            Phase::Stopping => self.drop_waiting(),
            Phase::Waiting(_) => {}
        }
    }

    /// A blob is not on this PC: a job that can do without it does.
    fn forgo(&mut self, hash: BlobHash) {
        let Some(job) = self.current.as_mut().filter(|job| job.lenient) else { return };
        let Phase::Waiting(missing) = &mut job.phase else { return };
        if missing.remove(&hash) {
            self.foregone.insert(hash);
            if missing.is_empty() {
                job.settle(&mut self.actions);
            }
        }
    }

    /// Ends the rendering of a job; whether its lease is still held.
    fn leave_job(&mut self, lease: LeaseId) -> bool {
        match self.current.take_if(|job| job.grant.lease == lease) {
            Some(job) => matches!(job.phase, Phase::Rendering),
            None => false,
        }
    }

    /// Gives up a job that does not render at the moment.
    fn drop_waiting(&mut self) {
        if let Some(job) = self.current.take().filter(|job| job.begun) {
            self.actions.push_back(Action::Discard(job.grant.lease));
        }
    }

    fn supplied(&mut self, hash: BlobHash) {
        self.supply.loaded(hash);
        let Some(job) = self.current.as_mut() else { return };
        let Phase::Waiting(missing) = &mut job.phase else { return };
        if missing.remove(&hash) && missing.is_empty() {
            job.phase = Phase::Rendering;
            job.settled = false;
            self.actions.push_back(if std::mem::replace(&mut job.begun, true) {
                Action::Resume(job.grant.lease)
            } else {
                self.mapped.insert(job.shot.index);
                self.supply.job_begins();
                Action::Start(job.grant, job.shot.clone())
            });
        }
    }

    /// If a blob cannot be had, the job that waits for it fails.
    fn failed_supply(&mut self, hash: BlobHash, failure: Option<Failure>, why: &str) {
        if failure == Some(Failure::Urgent) && self.waits_for(hash) {
            let Some(lease) = self.current.as_ref().map(|job| job.grant.lease) else { return };
            self.drop_waiting();
            self.fail(lease, &format!("cannot get terrain blob {hash}: {why}"));
        }
    }

    fn waits_for(&self, hash: BlobHash) -> bool {
        let phase = self.current.as_ref().map(|job| &job.phase);
        matches!(phase, Some(Phase::Waiting(missing)) if missing.contains(&hash))
    }

    /// Looks at a view of what comes, when all that was foreseen before is under way.
    fn look_ahead(&mut self) {
        if self.leaving.is_some() || !self.supply.sees_no_more() {
            return;
        }
        let (shots, mapped) = (&self.shots, &self.mapped);
        let ready = |shot| shots.get(&shot).is_some_and(|open| mapped.contains(&open.index));
        let grants = self.queue.iter_mut().map(|queued| (&queued.grant, &mut queued.seen));
        if let Some(glance) = self.outlook.next(grants, ready)
            && let Some(shot) = self.shots.get(&glance.shot)
        {
            self.actions.push_back(Action::Glance(glance, shot.clone()));
        }
    }

    /// Asks for blobs: those that the job waits for, or, if it waits for none, a few of
    /// those that will be needed.
    fn ask(&mut self) {
        let phase = self.current.as_ref().map(|job| &job.phase);
        let missing = match phase {
            Some(Phase::Waiting(missing)) => Some(missing),
            _ => None,
        };
        let foregone = &self.foregone;
        let waits = |hash| {
            foregone.contains(&hash) || missing.is_some_and(|missing| missing.contains(&hash))
        };
        let calm = missing.is_none() && self.leaving.is_none();
        self.supply.ask(waits, calm, &mut self.actions);
    }

    fn hand_back(&mut self, leases: Vec<LeaseId>) {
        for leases in leases.chunks(HAND_BACK_MAX) {
            self.send(HandBack { leases: leases.to_vec() });
        }
    }

    fn fail(&mut self, lease: LeaseId, reason: &str) {
        self.send(Failed { lease, reason: clip_reason(reason) });
    }

    fn send(&mut self, message: impl Into<Message>) {
        self.actions.push_back(Action::Send(message.into()));
    }
}
