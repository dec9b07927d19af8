//! What a worker does about what happens: a pure state machine.
//!
//! [`Session::handle`] takes an [`Event`], [`Session::poll_action`] gives what is to be
//! done about it. No I/O, no clock, no thread, no pixel is looked at. One session lives
//! as long as one connection; what it held when the connection broke, the coordinator
//! grants again.
//!
//! A grant waits in the queue, then for the index of its store, then renders; when the
//! ray caster names tiles that are not in memory, it pauses for them and renders what is
//! left. At most one job is begun at a time: it is spread over all cores. A blob is
//! looked for on this PC first, then asked of the coordinator, each once however many
//! wait for it.
//!
//! Every lease is answered exactly once, by `Done`, `Failed` or `HandBack`, unless it is
//! revoked; then never.

#[cfg(test)]
mod tests;

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use terrafarm_common::id::{BlobHash, LeaseId, ShotId};
use terrafarm_wire::Message;
use terrafarm_wire::limits::{HAND_BACK_MAX, clip_reason};
use terrafarm_wire::message::{
    Blob, Done, Failed, Goodbye, Grant, HandBack, NoBlob, OpenShot, WantBlobs,
};

/// Most grants that wait; more are handed back at once.
pub const QUEUE_MAX: usize = 1024;
/// Most shots that are open; grants of others fail.
pub const SHOTS_MAX: usize = 1024;
/// Most blobs asked of the coordinator and not yet answered. Tiles have a few hundred
/// kilobytes at most, so this is what gigabit Ethernet carries in a fifth of a second.
pub const ASKED_MAX: usize = 64;

/// What can happen.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// The coordinator says something.
    Received(Message),
    /// A blob is decoded and in memory.
    Loaded(BlobHash),
    /// A blob is not on this PC.
    Absent(BlobHash),
    /// A blob is not what it should be: it cannot be used.
    Spoiled(BlobHash, String),
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
    /// A blob has come: check it, keep it, load it. Answered by `Loaded` or `Spoiled`.
    Take(Blob),
    /// Begin a job; the index of its store is loaded. Answered by `Paused`, `Rendered` or
    /// `Broken`, and also by `Stopped` after a [`Action::Stop`].
    Start(Grant, Arc<OpenShot>),
    /// Go on with the paused job. Answered like `Start`.
    Resume(LeaseId),
    /// Stop the job that runs, soon. Answered by any of its answers.
    Stop(LeaseId),
    /// Forget the paused job. Not answered.
    Discard(LeaseId),
    /// No open shot uses this store any more.
    Release(BlobHash),
    /// All is said: close the connection once it is sent.
    End,
}

/// The worker's side of one connection.
#[derive(Debug, Default)]
pub struct Session {
    shots: BTreeMap<ShotId, Arc<OpenShot>>,
    queue: VecDeque<Grant>,
    current: Option<Current>,
    blobs: BTreeMap<BlobHash, Supply>,
    wanted: VecDeque<BlobHash>,
    asked: usize,
    unsent: usize,
    leaving: Option<String>,
    ended: bool,
    actions: VecDeque<Action>,
}

/// The job that has been begun, or waits for the index of its store.
#[derive(Debug)]
struct Current {
    grant: Grant,
    shot: Arc<OpenShot>,
    phase: Phase,
    /// Whether `Start` has been given.
    begun: bool,
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

/// How a blob that is not in memory comes there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Supply {
    /// Being looked for on this PC, or being decoded.
    Loading,
    /// To be asked of the coordinator.
    Wanted,
    /// Asked of the coordinator.
    Asked,
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
                if self.blobs.get(&hash) == Some(&Supply::Loading) {
                    self.blobs.insert(hash, Supply::Wanted);
                    self.wanted.push_back(hash);
                }
            }
            Event::Spoiled(hash, why) => self.failed_supply(hash, &why),
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
            Message::OpenShot(shot)
                if self.shots.len() < SHOTS_MAX => {
                    self.shots.insert(shot.shot, Arc::new(shot));
                }
            Message::Grant(grant) => self.granted(grant),
            Message::Revoke(revoke) => self.revoke(revoke.lease),
            Message::CloseShot(close) => self.close(close.shot),
            Message::Blob(blob)
                // One that was not asked for is dropped unread.
                if self.answered(blob.hash) => {
                    self.blobs.insert(blob.hash, Supply::Loading);
                    self.actions.push_back(Action::Take(blob));
                }
            Message::NoBlob(NoBlob { hash, why })
                if self.answered(hash) => {
                    self.failed_supply(hash, &why);
                }
            Message::Drain(_) => self.leave("the coordinator asked for it".to_owned()),
            _ => {}
        }
    }

    fn granted(&mut self, grant: Grant) {
        let held = self.queue.iter().chain(self.current.as_ref().map(|job| &job.grant));
        if held.into_iter().any(|other| other.lease == grant.lease) {
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
        self.queue.push_back(grant);
    }

    fn revoke(&mut self, lease: LeaseId) {
        self.queue.retain(|grant| grant.lease != lease);
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
        let orphans: Vec<_> =
            self.queue.iter().filter(|grant| grant.shot == shot).map(|grant| grant.lease).collect();
        self.queue.retain(|grant| grant.shot != shot);
        self.hand_back(orphans);
        if !self.shots.values().any(|open| open.index == closed.index) {
            self.actions.push_back(Action::Release(closed.index));
        }
    }

    fn leave(&mut self, reason: String) {
        if self.leaving.is_none() {
            self.leaving = Some(reason);
            let unbegun = self.queue.drain(..).map(|grant| grant.lease).collect();
            self.hand_back(unbegun);
        }
    }

    /// Takes the next grant of the queue, unless one is begun or the link is behind.
    fn begin(&mut self) {
        while self.current.is_none() && self.unsent == 0 {
            let Some(grant) = self.queue.pop_front() else { return };
            let Some(shot) = self.shots.get(&grant.shot).cloned() else { continue };
            let index = shot.index;
            let phase = Phase::Waiting(BTreeSet::from([index]));
            self.current = Some(Current { grant, shot, phase, begun: false });
            self.need(index);
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
                job.phase = Phase::Waiting(missing.iter().copied().collect());
                missing.into_iter().for_each(|hash| self.need(hash));
            }
            Phase::Stopping => self.drop_waiting(),
            Phase::Waiting(_) => {}
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

    fn need(&mut self, hash: BlobHash) {
        if let Entry::Vacant(unknown) = self.blobs.entry(hash) {
            unknown.insert(Supply::Loading);
            self.actions.push_back(Action::Load(hash));
        }
    }

    fn supplied(&mut self, hash: BlobHash) {
        self.blobs.remove(&hash);
        let Some(job) = self.current.as_mut() else { return };
        let Phase::Waiting(missing) = &mut job.phase else { return };
        if missing.remove(&hash) && missing.is_empty() {
            job.phase = Phase::Rendering;
            self.actions.push_back(if std::mem::replace(&mut job.begun, true) {
                Action::Resume(job.grant.lease)
            } else {
                Action::Start(job.grant, job.shot.clone())
            });
        }
    }

    /// A blob cannot be had: the job that waits for it fails.
    fn failed_supply(&mut self, hash: BlobHash, why: &str) {
        self.blobs.remove(&hash);
        let Some(job) = &self.current else { return };
        if matches!(&job.phase, Phase::Waiting(missing) if missing.contains(&hash)) {
            let lease = job.grant.lease;
            self.drop_waiting();
            self.fail(lease, &format!("cannot get terrain blob {hash}: {why}"));
        }
    }

    /// Whether a blob was asked of the coordinator; it no longer is.
    fn answered(&mut self, hash: BlobHash) -> bool {
        let asked = self.blobs.get(&hash) == Some(&Supply::Asked);
        if asked {
            self.blobs.remove(&hash);
            self.asked -= 1;
        }
        asked
    }

    /// Asks the coordinator for blobs, many at a time, as long as someone waits for them.
    fn ask(&mut self) {
        if self.wanted.is_empty() || self.asked > ASKED_MAX / 2 {
            return;
        }
        let mut hashes = Vec::new();
        while self.asked < ASKED_MAX {
            let Some(hash) = self.wanted.pop_front() else { break };
            let waits = self.current.as_ref().is_some_and(
                |job| matches!(&job.phase, Phase::Waiting(missing) if missing.contains(&hash)),
            );
            if waits {
                self.blobs.insert(hash, Supply::Asked);
                self.asked += 1;
                hashes.push(hash);
            } else {
                self.blobs.remove(&hash);
            }
        }
        if !hashes.is_empty() {
            self.send(WantBlobs { hashes });
        }
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
