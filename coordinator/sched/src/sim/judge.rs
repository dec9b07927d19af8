//! Watches a run from outside and counts what must not happen.
//!
//! It sees the same events and actions as any driver and keeps books of its own, so that
//! an error in the scheduler's books cannot hide itself.

use super::silence::Silence;
use crate::config::Config;
use crate::event::{Action, Event, Micros};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use terrafarm_common::id::{FrameIndex, LeaseId, ShotId, WorkerId};
use terrafarm_common::region::Region;

/// What must not happen, and how often it did. All zero in every run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Violations {
    /// Results accepted for pixels that were there already, or outside the frame.
    pub pixels_twice: u64,
    /// Frames called complete while pixels were missing.
    pub pixels_missing: u64,
    /// Frames called complete or failed more than once, or after their shot was over.
    pub frames_twice: u64,
    /// Jobs held twice other than by hedging, or granted for pixels that were there.
    pub held_twice: u64,
    /// Leases whose number was not larger than all before.
    pub lease_order: u64,
    /// Leases that ended twice, or never.
    pub lease_ends: u64,
    /// Results without exactly one verdict, or with a wrong one.
    pub verdicts: u64,
    /// Results accepted from workers that had been given up.
    pub zombie_pixels: u64,
    /// Grants to workers that were lost, draining or blocked.
    pub bad_grants: u64,
    /// Grants that put more frames in flight than allowed.
    pub in_flight: u64,
    /// Shots that ended with a wrong count of frames, or did not end.
    pub unfinished: u64,
    /// Workers still counted on after so much silence while somebody waited for frames.
    pub unnoticed: u64,
    /// Failures of the scheduler's own check.
    pub self_check: u64,
}

impl Violations {
    /// Whether nothing happened that must not.
    pub fn is_clean(&self) -> bool {
        *self == Violations::default()
    }
}

#[derive(Debug, Default)]
struct Picture {
    accepted: Vec<Region>,
    held: BTreeMap<LeaseId, Region>,
}

#[derive(Debug)]
struct Watched {
    is_live: bool,
    is_paused: bool,
    frames: u32,
    size: (u32, u32),
    limit: u32,
    open: BTreeMap<FrameIndex, Picture>,
    done: BTreeSet<FrameIndex>,
    untaken: BTreeSet<FrameIndex>,
    failed: u32,
    blocked: BTreeSet<WorkerId>,
}

/// The judge of one run.
#[derive(Debug)]
pub(crate) struct Judge {
    /// The counts.
    pub(crate) violations: Violations,
    /// The first violation in words.
    pub(crate) first: Option<String>,
    /// Grants of jobs that another worker held.
    pub(crate) copies: u64,
    /// Connected workers; whether they drain.
    workers: BTreeMap<WorkerId, bool>,
    distrusted: BTreeSet<WorkerId>,
    shots: BTreeMap<ShotId, Watched>,
    held: BTreeMap<LeaseId, (WorkerId, ShotId, FrameIndex)>,
    /// The same leases, by their holders.
    held_by: BTreeMap<WorkerId, BTreeSet<LeaseId>>,
    last_lease: u64,
    awaiting: Option<(WorkerId, LeaseId)>,
    silence: Silence,
}

impl Judge {
    /// The judge of a run that has not begun, of a scheduler with these settings.
    pub(crate) fn new(config: &Config) -> Self {
        Judge {
            violations: Violations::default(),
            first: None,
            copies: 0,
            workers: BTreeMap::new(),
            distrusted: BTreeSet::new(),
            shots: BTreeMap::new(),
            held: BTreeMap::new(),
            held_by: BTreeMap::new(),
            last_lease: 0,
            awaiting: None,
            silence: Silence::new(config.live_silence_us),
        }
    }

    /// Takes note that the owner of the scheduler comes too late to look, before it tells
    /// what happened.
    pub(crate) fn overslept(&mut self, now: Micros) {
        self.silence.overslept(now);
    }

    /// Takes note of an event before it is handled.
    pub(crate) fn event(&mut self, now: Micros, event: &Event) {
        if let Some(worker) = speaker(event) {
            self.silence.heard(now, worker);
        }
        match event {
            Event::WorkerJoined { worker, .. } => {
                self.workers.entry(*worker).or_insert(false);
                self.silence.joined(now, *worker);
            }
            Event::WorkerLost { worker, .. } => self.gone(*worker),
            Event::WorkerDraining { worker } => {
                if let Some(drains) = self.workers.get_mut(worker) {
                    *drains = true;
                    self.unblock(*worker);
                }
            }
            Event::HandedBack { worker, leases } => {
                leases.iter().for_each(|&lease| self.give_up(*worker, lease));
            }
            Event::JobFailed { worker, lease, .. } => self.give_up(*worker, *lease),
            Event::ShotSubmitted {
                shot, frames, width, height, frames_in_flight, live, ..
            } => {
                self.shots.entry(*shot).or_insert_with(|| Watched {
                    is_live: *live,
                    is_paused: false,
                    frames: *frames,
                    size: (*width, *height),
                    limit: *frames_in_flight,
                    open: BTreeMap::new(),
                    done: BTreeSet::new(),
                    untaken: BTreeSet::new(),
                    failed: 0,
                    blocked: BTreeSet::new(),
                });
            }
            Event::JobDone { worker, lease, .. } => self.awaiting = Some((*worker, *lease)),
            Event::FrameTaken { shot, frame } => {
                if let Some(shot) = self.shots.get_mut(shot) {
                    shot.untaken.remove(frame);
                }
            }
            Event::WorkerCleared { worker, .. } => _ = self.distrusted.remove(worker),
            Event::ShotCanceled { shot } => _ = self.shots.remove(shot),
            Event::ShotPaused { shot } => self.set_paused(*shot, true),
            Event::ShotResumed { shot } => self.set_paused(*shot, false),
            Event::ShotPrioritised { .. }
            | Event::WorkerDistrusted { .. }
            | Event::WorkerMeasured { .. }
            | Event::HeardFrom { .. }
            | Event::Tick => {}
        }
    }

    /// Takes note of an action.
    pub(crate) fn action(&mut self, action: &Action) {
        match action {
            Action::Grant { worker, lease, shot, frame, region } => {
                self.granted(*worker, *lease, *shot, *frame, *region);
            }
            Action::Audit { worker, lease, shot, frame, .. } => {
                self.newest(*lease);
                let may_work = self.may_work(*worker, *shot);
                self.expect(may_work, |v| &mut v.bad_grants, || format!("{worker} got {lease}"));
                self.held.insert(*lease, (*worker, *shot, *frame));
                self.held_by.entry(*worker).or_default().insert(*lease);
            }
            Action::Compared { worker, lease, .. } => {
                let was_awaited = self.awaiting.take() == Some((*worker, *lease));
                let is_right = self.end(*worker, *lease).is_some() && was_awaited;
                self.expect(is_right, |v| &mut v.verdicts, || format!("{lease} wrongly compared"));
            }
            Action::Retract { shot, frame, region, .. } => {
                let shot = self.shots.get_mut(shot);
                let picture = shot.and_then(|shot| shot.open.get_mut(frame));
                let at = picture.as_ref().and_then(|picture| {
                    picture.accepted.iter().position(|accepted| accepted == region)
                });
                if let (Some(picture), Some(at)) = (picture, at) {
                    picture.accepted.swap_remove(at);
                }
                let was_there = at.is_some();
                self.expect(
                    was_there,
                    |v| &mut v.pixels_twice,
                    || format!("{region:?} taken back"),
                );
            }
            Action::Distrusted { worker, .. } => _ = self.distrusted.insert(*worker),
            Action::Revoke { worker, lease } => {
                let is_held = self.end(*worker, *lease).is_some();
                self.expect(is_held, |v| &mut v.lease_ends, || format!("{lease} ended twice"));
            }
            Action::Accept { lease, shot, frame, region } => {
                self.accepted(*lease, *shot, *frame, *region);
            }
            Action::Refuse { worker, lease, .. } => {
                let was_awaited = self.awaiting.take() == Some((*worker, *lease));
                let is_held = self.held.get(lease).is_some_and(|held| held.0 == *worker);
                let is_right = was_awaited && !is_held;
                self.expect(is_right, |v| &mut v.verdicts, || format!("{lease} wrongly refused"));
            }
            Action::FrameComplete { shot, frame } => self.frame_over(*shot, *frame, true),
            Action::FrameFailed { shot, frame, .. } => self.frame_over(*shot, *frame, false),
            Action::ShotComplete { shot, failed_frames } => {
                let watched = self.shots.remove(shot);
                let is_whole = watched.is_some_and(|watched| {
                    watched.done.len() == watched.frames as usize
                        && watched.failed == *failed_frames
                });
                self.expect(is_whole, |v| &mut v.unfinished, || format!("{shot} is not whole"));
            }
            Action::ShotFailed { shot, .. } => {
                self.shots.remove(shot);
            }
            Action::Drop { worker, .. } => self.gone(*worker),
            Action::Blocked { worker, shot } => {
                if let Some(shot) = self.shots.get_mut(shot) {
                    shot.blocked.insert(*worker);
                }
            }
            Action::Unblocked { worker, shot } => {
                if let Some(shot) = self.shots.get_mut(shot) {
                    shot.blocked.remove(worker);
                }
            }
            Action::Trusted { .. } | Action::Disputed { .. } | Action::Probe { .. } => {}
        }
    }

    fn set_paused(&mut self, shot: ShotId, is_paused: bool) {
        if let Some(shot) = self.shots.get_mut(&shot) {
            shot.is_paused = is_paused;
        }
    }

    /// Takes note that all actions of an event have been seen.
    pub(crate) fn settled(&mut self, now: Micros) {
        let is_live = self.shots.values().any(|shot| shot.is_live && !shot.is_paused);
        self.silence.live(now, is_live);
        if let Some((worker, us)) = self.silence.overdue(now) {
            let words = || format!("{worker} was silent for {us} us and nobody noticed");
            self.expect(false, |v| &mut v.unnoticed, words);
        }
        let forgotten = self.awaiting.take();
        self.expect(
            forgotten.is_none(),
            |v| &mut v.verdicts,
            || format!("no verdict on {forgotten:?}"),
        );
    }

    /// Takes note of the scheduler's own check.
    pub(crate) fn self_checked(&mut self, outcome: Result<(), String>) {
        let words = outcome.as_ref().err().cloned().unwrap_or_default();
        self.expect(outcome.is_ok(), |v| &mut v.self_check, || words);
    }

    /// Takes note of the end of the run.
    pub(crate) fn ended(&mut self, hedged: u64) {
        for shot in self.shots.keys().copied().collect::<Vec<_>>() {
            self.expect(false, |v| &mut v.unfinished, || format!("{shot} did not end"));
        }
        let held = self.held.len();
        self.expect(held == 0, |v| &mut v.lease_ends, || format!("{held} leases never ended"));
        let copies = self.copies;
        self.expect(
            copies == hedged,
            |v| &mut v.held_twice,
            || format!("{copies} copies granted, {hedged} on purpose"),
        );
    }

    fn granted(
        &mut self,
        worker: WorkerId,
        lease: LeaseId,
        id: ShotId,
        frame: u32,
        region: Region,
    ) {
        self.newest(lease);
        let may_work = self.may_work(worker, id);
        self.expect(may_work, |v| &mut v.bad_grants, || format!("{worker} got {lease}"));
        self.held.insert(lease, (worker, id, frame));
        self.held_by.entry(worker).or_default().insert(lease);
        let Some(shot) = self.shots.get_mut(&id) else { return };
        let is_open = !shot.done.contains(&frame) && frame < shot.frames;
        let picture = shot.open.entry(frame).or_default();
        let holders: Vec<Region> =
            picture.held.values().copied().filter(|&other| overlap(other, region)).collect();
        let is_free = holders.len() <= 1
            && holders.iter().all(|&other| other == region)
            && !picture.accepted.iter().any(|&other| overlap(other, region));
        picture.held.insert(lease, region);
        let in_flight = shot.open.len() + shot.untaken.len();
        let fits = in_flight <= shot.limit as usize;
        self.copies += holders.len() as u64;
        self.expect(
            is_free && is_open,
            |v| &mut v.held_twice,
            || format!("{lease} of frame {frame} granted for {region:?}, also held or there"),
        );
        self.expect(fits, |v| &mut v.in_flight, || format!("{in_flight} frames in flight"));
    }

    fn newest(&mut self, lease: LeaseId) {
        let is_newer = lease.0 > self.last_lease;
        self.expect(is_newer, |v| &mut v.lease_order, || format!("{lease} is not the largest"));
        self.last_lease = self.last_lease.max(lease.0);
    }

    fn may_work(&self, worker: WorkerId, id: ShotId) -> bool {
        self.workers.get(&worker) == Some(&false)
            && !self.distrusted.contains(&worker)
            && self.shots.get(&id).is_some_and(|shot| !shot.blocked.contains(&worker))
    }

    fn accepted(&mut self, lease: LeaseId, id: ShotId, frame: FrameIndex, region: Region) {
        let awaited = self.awaiting.take();
        let is_alive = awaited.is_none_or(|(worker, _)| self.workers.contains_key(&worker));
        self.expect(is_alive, |v| &mut v.zombie_pixels, || format!("{lease} of a zombie accepted"));
        let ended = awaited.and_then(|(worker, _)| self.end(worker, lease));
        let is_right = awaited.is_some_and(|(_, awaited)| awaited == lease)
            && ended == Some((id, frame, Some(region)));
        self.expect(is_right, |v| &mut v.verdicts, || format!("{lease} wrongly accepted"));
        let Some(shot) = self.shots.get_mut(&id) else { return };
        let fits = region.fits(shot.size.0, shot.size.1);
        let picture = shot.open.entry(frame).or_default();
        let is_new = !picture.accepted.iter().any(|&other| overlap(other, region));
        picture.accepted.push(region);
        self.expect(
            fits && is_new,
            |v| &mut v.pixels_twice,
            || format!("{region:?} of frame {frame} accepted twice"),
        );
    }

    fn frame_over(&mut self, id: ShotId, frame: FrameIndex, is_complete: bool) {
        let mut is_first = false;
        let mut is_whole = true;
        if let Some(shot) = self.shots.get_mut(&id) {
            is_first = shot.done.insert(frame);
            let picture = shot.open.remove(&frame).unwrap_or_default();
            if is_complete {
                shot.untaken.insert(frame);
                let area: u64 = picture.accepted.iter().map(Region::area).sum();
                is_whole = area == u64::from(shot.size.0) * u64::from(shot.size.1);
            } else {
                shot.failed += 1;
            }
        }
        self.expect(is_first, |v| &mut v.frames_twice, || format!("frame {frame} is over twice"));
        self.expect(is_whole, |v| &mut v.pixels_missing, || format!("frame {frame} has holes"));
    }

    /// Ends a lease that this worker holds.
    fn end(
        &mut self,
        worker: WorkerId,
        lease: LeaseId,
    ) -> Option<(ShotId, FrameIndex, Option<Region>)> {
        let &(holder, id, frame) = self.held.get(&lease)?;
        if holder != worker {
            return None;
        }
        self.held.remove(&lease);
        if let Some(of_worker) = self.held_by.get_mut(&worker) {
            of_worker.remove(&lease);
        }
        let picture = self.shots.get_mut(&id).and_then(|shot| shot.open.get_mut(&frame));
        Some((id, frame, picture.and_then(|picture| picture.held.remove(&lease))))
    }

    fn give_up(&mut self, worker: WorkerId, lease: LeaseId) {
        // What it does not hold any more is passed over, as the scheduler does.
        let _ = self.end(worker, lease);
    }

    fn gone(&mut self, worker: WorkerId) {
        // Another connection of the same number is another worker.
        self.distrusted.remove(&worker);
        self.silence.gone(worker);
        if self.workers.remove(&worker).is_none() {
            return;
        }
        for lease in self.held_by.remove(&worker).unwrap_or_default() {
            self.give_up(worker, lease);
        }
        self.unblock(worker);
    }

    /// A worker is no longer there to be blocked.
    fn unblock(&mut self, worker: WorkerId) {
        self.shots.values_mut().for_each(|shot| _ = shot.blocked.remove(&worker));
    }

    fn expect(
        &mut self,
        holds: bool,
        counter: impl FnOnce(&mut Violations) -> &mut u64,
        words: impl FnOnce() -> String,
    ) {
        if !holds {
            *counter(&mut self.violations) += 1;
            self.first.get_or_insert_with(words);
        }
    }
}

/// The worker that an event is a word of.
fn speaker(event: &Event) -> Option<WorkerId> {
    match event {
        Event::WorkerMeasured { worker, .. }
        | Event::WorkerDraining { worker }
        | Event::HandedBack { worker, .. }
        | Event::JobDone { worker, .. }
        | Event::JobFailed { worker, .. }
        | Event::HeardFrom { worker } => Some(*worker),
        _ => None,
    }
}

fn overlap(a: Region, b: Region) -> bool {
    a.x < b.x + b.width && b.x < a.x + a.width && a.y < b.y + b.height && b.y < a.y + a.height
}

#[cfg(test)]
mod tests;
