//! Audits: a share of what is accepted is rendered again by another worker.
//!
//! Pixels depend on nothing but the shot and the frame, to the bit. So where two workers
//! differ, one of them is at fault, and it is found so:
//!
//! 1. An accepted job is chosen by a seeded draw ([`crate::Config::audit`]) and granted to a
//!    worker that has not rendered it. Nothing waits for that: the job is part of its frame.
//! 2. If both agree, that is all. If not, others are asked, one after the other, each once.
//! 3. What two different workers agree on is right. Whoever said something else is
//!    *distrusted*.
//! 4. If nobody is left who has not been asked, each is asked once more. One who contradicts
//!    itself is distrusted, whoever is right. If all keep to what they said, nobody knows:
//!    that is reported, and nobody is distrusted.
//!
//! A distrusted worker gets nothing more of any shot until an operator clears it. All that
//! was accepted of it in frames that are open is taken back and rendered again; frames that
//! are complete have left, and are named.
//!
//! An audit is the first thing that a worker gets, and takes that much from the shot's part
//! of the farm. The last word on a shot waits for its audits; its frames do not. Of the
//! farm's first and only worker nothing is audited.

use crate::event::{Action, Distrust, SentFrames};
use crate::lease::Lease;
use crate::outcome::End;
use crate::scheduler::Scheduler;
use crate::shot::Job;
use std::collections::{BTreeMap, BTreeSet};
use terrafarm_common::accuracy::Share;
use terrafarm_common::id::{FrameIndex, LeaseId, ShotId, WorkerId};

/// Most audits at once; jobs that would be one more are not audited.
const MAX_AUDITS: usize = 1024;
/// How many audits are looked at to find one for a hungry worker.
const AUDIT_LOOK: usize = 8;
/// An audit that so many workers were asked for in vain, since they failed or took too long, is
/// given up.
const MAX_UNANSWERED: u32 = 2;

/// Number of an audit.
pub(crate) type AuditId = u64;

/// What one worker made of a job.
#[derive(Debug, Clone, Copy)]
struct Opinion {
    worker: WorkerId,
    digest: u64,
}

/// One job that is rendered again.
#[derive(Debug, Clone)]
pub(crate) struct Audit {
    /// The lease under which it was accepted.
    of: LeaseId,
    shot: ShotId,
    frame: FrameIndex,
    start: u32,
    end: u32,
    /// The first one is that of the pixels that were accepted.
    opinions: Vec<Opinion>,
    /// Under which it is being rendered again, if it is.
    lease: Option<LeaseId>,
    unanswered: u32,
}

/// All audits.
#[derive(Debug, Default)]
pub(crate) struct Audits {
    begun: AuditId,
    open: BTreeMap<AuditId, Audit>,
    /// Those that wait for a worker.
    asking: BTreeSet<AuditId>,
}

impl Audits {
    /// Whether an audit is being rendered under a lease.
    pub(crate) fn holds(&self, id: AuditId, lease: LeaseId) -> bool {
        self.open.get(&id).is_some_and(|audit| audit.lease == Some(lease))
    }

    /// How many there are of a shot.
    pub(crate) fn of(&self, shot: ShotId) -> usize {
        self.open.values().filter(|audit| audit.shot == shot).count()
    }

    /// Each is being rendered or waits for a worker.
    pub(crate) fn check(&self) -> Result<(), String> {
        let waits = |(id, audit): (&AuditId, &Audit)| {
            audit.lease.is_none() == self.asking.contains(id) && !audit.opinions.is_empty()
        };
        let idle = self.open.iter().all(waits);
        let known = self.asking.iter().all(|id| self.open.contains_key(id));
        if idle && known { Ok(()) } else { Err("an audit waits for nothing".into()) }
    }
}

impl Audit {
    /// The digest that two different workers came to.
    fn agreed(&self) -> Option<u64> {
        let others = |one: &Opinion| {
            let same = |other: &&Opinion| other.digest == one.digest && other.worker != one.worker;
            self.opinions.iter().find(same).is_some()
        };
        self.opinions.iter().find(|one| others(one)).map(|one| one.digest)
    }

    /// A worker that said two different things.
    fn contradicted(&self) -> Option<WorkerId> {
        let twice = |one: &&Opinion| {
            self.opinions
                .iter()
                .any(|other| other.worker == one.worker && other.digest != one.digest)
        };
        self.opinions.iter().find(twice).map(|one| one.worker)
    }

    fn said(&self, worker: WorkerId) -> usize {
        self.opinions.iter().filter(|one| one.worker == worker).count()
    }

    fn is_disputed(&self) -> bool {
        self.opinions.len() > 1
    }
}

impl Scheduler {
    /// A job has been accepted: perhaps it is audited.
    pub(crate) fn draw_audit(&mut self, of: LeaseId, lease: &Lease, end: u32, digest: u64) {
        if self.config.audit == Share::NONE
            || !self.config.audit.takes((self.rng.next() >> 32) as u32)
            || self.audits.open.len() >= MAX_AUDITS
        {
            return;
        }
        // A live frame shows the terrain that its worker has: others may have more of it.
        if self.shots.get(&lease.shot).is_none_or(|shot| shot.is_live) {
            return;
        }
        let audit = Audit {
            of,
            shot: lease.shot,
            frame: lease.frame,
            start: lease.start,
            end,
            opinions: vec![Opinion { worker: lease.worker, digest }],
            lease: None,
            unanswered: 0,
        };
        if !self.workers.keys().any(|&worker| self.may_audit(&audit, worker)) {
            return;
        }
        if let Some(shot) = self.shots.get_mut(&lease.shot) {
            shot.audits += 1;
        }
        self.audits.begun += 1;
        self.audits.asking.insert(self.audits.begun);
        self.audits.open.insert(self.audits.begun, audit);
        self.unpark();
    }

    /// Whether a worker may be asked for an audit: at first those that have not said
    /// anything; in a dispute, if there are none, those that have said something once.
    fn may_audit(&self, audit: &Audit, worker: WorkerId) -> bool {
        let can = |worker: &WorkerId| {
            self.workers.get(worker).is_some_and(|known| known.is_active())
                && self.shots.get(&audit.shot).is_some_and(|shot| !shot.blocked.contains(worker))
        };
        if !can(&worker) {
            return false;
        }
        match audit.said(worker) {
            0 => true,
            1 if audit.is_disputed() => {
                !self.workers.keys().any(|other| audit.said(*other) == 0 && can(other))
            }
            _ => false,
        }
    }

    /// Grants audits to hungry workers, and gives up those that nobody can do.
    pub(crate) fn dispatch_audits(&mut self) {
        let asking: Vec<AuditId> = self.audits.asking.iter().take(AUDIT_LOOK).copied().collect();
        for id in asking {
            let Some(audit) = self.audits.open.get(&id) else { continue };
            let hungry = self.hungry.iter().map(|&(_, _, worker)| worker);
            if let Some(worker) = hungry.into_iter().find(|&worker| self.may_audit(audit, worker)) {
                self.grant_audit(worker, id);
            } else if !self.workers.keys().any(|&worker| self.may_audit(audit, worker)) {
                self.close_audit(id);
            }
        }
    }

    fn grant_audit(&mut self, worker: WorkerId, id: AuditId) {
        let Some(audit) = self.audits.open.get(&id) else { return };
        let Some(shot) = self.shots.get(&audit.shot) else { return };
        let cost = shot.costs.run(audit.start, audit.end);
        let region = shot.grid.region(audit.start, audit.end);
        let is_founded = shot.costs.is_measured();
        let (of, shot, frame, start) = (audit.of, audit.shot, audit.frame, audit.start);
        let place = (shot, frame, start);
        let Some(lease) = self.lease(worker, place, cost, is_founded, Some(id)) else { return };
        self.audits.asking.remove(&id);
        if let Some(audit) = self.audits.open.get_mut(&id) {
            audit.lease = Some(lease);
        }
        self.refresh_hunger(worker);
        self.actions.push_back(Action::Audit { worker, lease, of, shot, frame, region });
    }

    /// The pixels of an audit have come.
    pub(crate) fn compare(&mut self, id: LeaseId, lease: &Lease, digest: u64, cost_us: u64) {
        let audit = lease.audit.and_then(|audit| self.audits.open.get_mut(&audit));
        let Some(audit) = audit else { return };
        let agrees = audit.opinions.first().is_some_and(|first| first.digest == digest);
        audit.opinions.push(Opinion { worker: lease.worker, digest });
        audit.lease = None;
        let (of, end) = (audit.of, audit.end);
        self.actions.push_back(Action::Compared { worker: lease.worker, lease: id, of, agrees });
        self.learn(lease, end, cost_us);
        if let Some(audit) = lease.audit {
            self.decide(audit);
        }
        self.refresh_hunger(lease.worker);
    }

    /// Finds out who is at fault, or asks on.
    fn decide(&mut self, id: AuditId) {
        let Some(audit) = self.audits.open.get(&id) else { return };
        let Some(shot) = self.shots.get(&audit.shot) else { return };
        let region = shot.grid.region(audit.start, audit.end);
        let (shot, frame) = (audit.shot, audit.frame);
        if let Some(right) = audit.agreed() {
            let (agree, differ): (Vec<Opinion>, Vec<Opinion>) =
                audit.opinions.iter().partition(|one| one.digest == right);
            let differ: BTreeSet<WorkerId> = differ.iter().map(|one| one.worker).collect();
            let by: Vec<WorkerId> = agree.iter().map(|one| one.worker).collect();
            self.forget_audit(id);
            for worker in differ {
                let by = by.iter().copied().filter(|&other| other != worker).collect();
                self.distrust(worker, Distrust::Outvoted { shot, frame, region, by });
            }
            self.finish_shot(shot);
        } else if let Some(worker) = audit.contradicted() {
            self.forget_audit(id);
            self.distrust(worker, Distrust::Contradicted { shot, frame, region });
            self.finish_shot(shot);
        } else {
            self.audits.asking.insert(id);
            self.unpark();
        }
    }

    /// A lease of an audit has ended without pixels; whether its worker is to blame.
    pub(crate) fn unanswered(&mut self, id: AuditId, is_in_vain: bool) {
        let Some(audit) = self.audits.open.get_mut(&id) else { return };
        audit.lease = None;
        audit.unanswered += u32::from(is_in_vain);
        if audit.unanswered >= MAX_UNANSWERED {
            self.close_audit(id);
        } else {
            self.audits.asking.insert(id);
            self.unpark();
        }
    }

    /// Gives an audit up; says so if there was something to decide.
    fn close_audit(&mut self, id: AuditId) {
        let Some(audit) = self.forget_audit(id) else { return };
        let (shot, frame) = (audit.shot, audit.frame);
        if audit.is_disputed()
            && let Some(known) = self.shots.get(&shot)
        {
            let region = known.grid.region(audit.start, audit.end);
            let workers: BTreeSet<_> = audit.opinions.iter().map(|one| one.worker).collect();
            let workers = workers.into_iter().collect();
            self.actions.push_back(Action::Disputed { shot, frame, region, workers });
        }
        self.finish_shot(shot);
    }

    /// Gives up all audits of a shot.
    pub(crate) fn close_audits_of(&mut self, shot: ShotId) {
        let open = self.audits.open.iter().filter(|(_, audit)| audit.shot == shot);
        let open: Vec<AuditId> = open.map(|(&id, _)| id).collect();
        open.into_iter().for_each(|id| self.close_audit(id));
    }

    /// Takes an audit out of the books, and back from whoever renders it.
    fn forget_audit(&mut self, id: AuditId) -> Option<Audit> {
        let audit = self.audits.open.remove(&id)?;
        self.audits.asking.remove(&id);
        if let Some(shot) = self.shots.get_mut(&audit.shot) {
            shot.audits -= 1;
        }
        if let Some(lease) = audit.lease {
            self.end_lease(lease, End::Unwanted);
        }
        Some(audit)
    }

    /// Gives a worker nothing more, and takes back what can be taken back.
    pub(crate) fn distrust(&mut self, worker: WorkerId, why: Distrust) {
        let mut held = Vec::new();
        if let Some(known) = self.workers.get_mut(&worker) {
            if known.is_distrusted {
                return;
            }
            let was_active = known.is_active();
            known.is_distrusted = true;
            held.extend(known.held.iter().copied());
            if was_active {
                self.leave_active(worker);
            }
        }
        let sent = |(&shot, known): (&ShotId, &crate::shot::Shot)| {
            let frames = known.sent_of(worker);
            (!frames.is_empty()).then_some(SentFrames { shot, frames })
        };
        let sent = self.shots.iter().filter_map(sent).collect();
        self.actions.push_back(Action::Distrusted { worker, why, sent });
        for lease in held {
            self.end_lease(lease, End::Barred);
        }
        self.strike_opinions(worker);
        for shot in self.shots.keys().copied().collect::<Vec<_>>() {
            self.take_back(worker, shot);
        }
        self.refresh_hunger(worker);
    }

    /// What a distrusted worker says of others counts for nothing, and what it rendered
    /// needs no audit.
    fn strike_opinions(&mut self, worker: WorkerId) {
        let mut idle = Vec::new();
        for (&id, audit) in &mut self.audits.open {
            let is_author = audit.opinions.first().is_some_and(|first| first.worker == worker);
            audit.opinions.retain(|one| one.worker != worker);
            if is_author {
                audit.opinions.clear();
                idle.push(id);
            }
        }
        idle.into_iter().for_each(|id| self.close_audit(id));
    }

    /// Has all that a worker rendered of the open frames of a shot rendered again.
    fn take_back(&mut self, worker: WorkerId, id: ShotId) {
        let Some(shot) = self.shots.get_mut(&id) else { return };
        for (&frame, open) in &mut shot.open {
            for (start, end) in open.take_back(worker) {
                let region = shot.grid.region(start, end);
                self.actions.push_back(Action::Retract { worker, shot: id, frame, region });
                shot.waiting.insert((frame, start), Job { end, ..Job::default() });
            }
        }
        self.refresh_ready(id);
        self.unpark();
    }

    /// Gives a distrusted worker another chance.
    pub(crate) fn trust(&mut self, worker: WorkerId) {
        let Some(known) = self.workers.get_mut(&worker) else { return };
        if std::mem::take(&mut known.is_distrusted) {
            if known.is_active() {
                self.enter_active(worker);
            }
            self.actions.push_back(Action::Trusted { worker });
            self.refresh_hunger(worker);
        }
    }
}
