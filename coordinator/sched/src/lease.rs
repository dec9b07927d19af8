//! Leases: a job granted to one worker until a time.

use crate::audit::AuditId;
use crate::event::{Micros, RefuseReason};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use terrafarm_common::id::{FrameIndex, LeaseId, ShotId, WorkerId};

/// How many accepted leases are remembered, to tell a repeated result from a late one.
const REMEMBERED: usize = 8192;

/// One lease that is held.
#[derive(Debug, Clone)]
pub(crate) struct Lease {
    /// Who holds it.
    pub(crate) worker: WorkerId,
    /// The shot.
    pub(crate) shot: ShotId,
    /// The frame.
    pub(crate) frame: FrameIndex,
    /// First atom of the job.
    pub(crate) start: u32,
    /// What it is an audit for, if it is one; then it is for no job of the shot.
    pub(crate) audit: Option<AuditId>,
    /// Expected cost when it was granted, cost units.
    pub(crate) cost: f64,
    /// Whether the cost was founded on results of the shot.
    pub(crate) is_founded: bool,
    /// When it was granted.
    pub(crate) granted_at: Micros,
    /// Whether the worker had nothing else to do then.
    pub(crate) was_idle: bool,
    /// When its result is expected.
    pub(crate) expected_at: Micros,
    /// From when it counts as late, and where it stands among those that can be hedged.
    pub(crate) late_at: Option<Micros>,
}

/// All leases that are held, and what is remembered of those that were.
#[derive(Debug, Default)]
pub(crate) struct Leases {
    /// Those that are held.
    pub(crate) held: BTreeMap<LeaseId, Lease>,
    granted: u64,
    accepted: BTreeSet<LeaseId>,
    accepted_order: VecDeque<LeaseId>,
}

impl Leases {
    /// A number larger than all before.
    pub(crate) fn grant(&mut self, lease: Lease) -> LeaseId {
        self.granted += 1;
        let id = LeaseId(self.granted);
        self.held.insert(id, lease);
        id
    }

    /// Whether a worker holds a lease.
    pub(crate) fn is_held_by(&self, lease: LeaseId, worker: WorkerId) -> bool {
        self.held.get(&lease).is_some_and(|held| held.worker == worker)
    }

    /// Remembers that a result was accepted.
    pub(crate) fn remember_accepted(&mut self, lease: LeaseId) {
        self.accepted.insert(lease);
        self.accepted_order.push_back(lease);
        if self.accepted_order.len() > REMEMBERED
            && let Some(oldest) = self.accepted_order.pop_front()
        {
            self.accepted.remove(&oldest);
        }
    }

    /// Why a result under a lease that its sender does not hold is refused.
    pub(crate) fn why_refused(&self, lease: LeaseId) -> RefuseReason {
        if lease.0 == 0 || lease.0 > self.granted || self.held.contains_key(&lease) {
            RefuseReason::Unknown
        } else if self.accepted.contains(&lease) {
            RefuseReason::Duplicate
        } else {
            RefuseReason::Stale
        }
    }
}
