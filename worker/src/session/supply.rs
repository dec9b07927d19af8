//! How blobs come to this PC: who waits for which, and who has been asked.
//!
//! A blob that a job waits for goes before all others: those that will be needed later are
//! asked for a few at a time, and only while no job waits. When a job comes to wait for one
//! of these, it is treated as all that jobs wait for, from where it is.

use super::Action;
use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use terrafarm_common::id::BlobHash;
use terrafarm_wire::Message;
use terrafarm_wire::message::{Blob, Elsewhere, WantBlobs};

/// Most blobs that jobs wait for and that are asked for and not yet answered. Tiles have a
/// few hundred kilobytes at most, so this is what gigabit Ethernet carries in a fifth of a
/// second.
pub const ASKED_MAX: usize = 64;
/// Most blobs on their way that will be needed later: a job that comes to wait for others
/// waits for so many more at most.
pub const EARLY_MAX: usize = 4;
/// Most blobs that are foreseen and not yet looked for.
const FORESEEN_MAX: usize = 8192;
/// Most blobs that are known to be on this PC, so that they are not looked for again.
const STOCKED_MAX: usize = 1 << 15;
/// How often a blob may come damaged before it cannot be had.
const DAMAGED_MAX: u8 = 3;

/// Blobs that are not in memory and that somebody needs.
#[derive(Debug, Default)]
pub(super) struct Supply {
    blobs: BTreeMap<BlobHash, Way>,
    /// Those that jobs wait for and that are to be asked for.
    wanted: VecDeque<BlobHash>,
    /// As many as are asked of the coordinator or of others.
    asked: usize,
    /// Those that will be needed, in the order of need; not in `blobs` yet.
    foreseen: VecDeque<BlobHash>,
    /// Those of `blobs` for which no job waits, and those of them to be asked for.
    early: usize,
    early_wanted: VecDeque<BlobHash>,
    /// There is no room for more before the next job begins.
    full: bool,
    stocked: BTreeSet<BlobHash>,
}

/// How far a blob is on its way.
#[derive(Debug, Clone, Copy)]
struct Way {
    stage: Stage,
    /// A job waits for it.
    urgent: bool,
    /// Only the coordinator is asked.
    here: bool,
    /// How often it came damaged.
    damaged: u8,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    /// Being looked for on this PC.
    Looking,
    /// To be asked for.
    Wanted,
    /// Asked of the coordinator.
    Asked,
    /// Asked of other workers.
    Elsewhere,
    /// Being checked and kept.
    Keeping,
}

/// What it means that a blob cannot be had.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Failure {
    /// A job may wait for it in vain.
    Urgent,
    /// Nobody does.
    Early,
}

impl Supply {
    /// A job waits for a blob. Whether it may be on this PC already.
    pub fn need(&mut self, hash: BlobHash, actions: &mut VecDeque<Action>) -> bool {
        match self.blobs.entry(hash) {
            Entry::Vacant(unknown) => {
                let stage = Stage::Looking;
                unknown.insert(Way { stage, urgent: true, here: false, damaged: 0 });
                actions.push_back(Action::Load(hash));
            }
            Entry::Occupied(mut known) if !known.get().urgent => {
                known.get_mut().urgent = true;
                self.early -= 1;
                if known.get().stage == Stage::Wanted {
                    self.early_wanted.retain(|other| *other != hash);
                    self.wanted.push_back(hash);
                }
            }
            Entry::Occupied(_) => {}
        }
        matches!(self.stage(hash), Some(Stage::Looking | Stage::Keeping))
    }

    /// Blobs will be needed, in this order, after those that were foreseen before.
    pub fn foresee(&mut self, hashes: Vec<BlobHash>) {
        for hash in hashes {
            let known = self.stocked.contains(&hash) || self.blobs.contains_key(&hash);
            if !known && self.foreseen.len() < FORESEEN_MAX {
                self.foreseen.push_back(hash);
            }
        }
    }

    /// Whether nothing is left of what was foreseen, so that more may be.
    pub fn sees_no_more(&self) -> bool {
        self.foreseen.is_empty() && !self.full
    }

    /// A job begins: there may be room again.
    pub fn job_begins(&mut self) {
        self.full = false;
    }

    /// Nothing is needed any more but what jobs wait for.
    pub fn forget_foreseen(&mut self) {
        self.foreseen.clear();
    }

    /// A blob is in memory.
    pub fn loaded(&mut self, hash: BlobHash) {
        self.remove(hash);
    }

    /// A blob for later is on this PC.
    pub fn stocked(&mut self, hash: BlobHash, actions: &mut VecDeque<Action>) {
        let Some(way) = self.blobs.get_mut(&hash) else { return };
        if way.urgent {
            way.stage = Stage::Looking;
            actions.push_back(Action::Load(hash));
            return;
        }
        self.remove(hash);
        if self.stocked.len() >= STOCKED_MAX {
            self.stocked.clear();
        }
        self.stocked.insert(hash);
    }

    /// There is no room for a blob for later, nor for others.
    pub fn no_room(&mut self, hash: BlobHash, actions: &mut VecDeque<Action>) {
        let Some(way) = self.blobs.get_mut(&hash) else { return };
        if way.urgent {
            way.stage = Stage::Looking;
            actions.push_back(Action::Load(hash));
            return;
        }
        self.remove(hash);
        self.full = true;
        self.foreseen.clear();
    }

    /// A blob is not on this PC.
    pub fn absent(&mut self, hash: BlobHash) {
        if let Some(Stage::Looking | Stage::Keeping) = self.stage(hash) {
            // It may have been here, and have made room for others.
            self.stocked.remove(&hash);
            self.want(hash);
        }
    }

    /// A blob has come, from where it was asked for.
    pub fn arrived(&mut self, blob: Blob, from: Source, actions: &mut VecDeque<Action>) {
        // One that was not asked for is dropped unread.
        if self.stage(blob.hash) != Some(from.stage()) {
            return;
        }
        self.asked -= 1;
        let Some(way) = self.blobs.get_mut(&blob.hash) else { return };
        way.stage = Stage::Keeping;
        actions.push_back(if way.urgent { Action::Take(blob) } else { Action::Stock(blob) });
    }

    /// Others have a blob.
    pub fn redirected(&mut self, elsewhere: Elsewhere, actions: &mut VecDeque<Action>) {
        let Some(way) = self.blobs.get_mut(&elsewhere.hash) else { return };
        if way.stage == Stage::Asked {
            way.stage = Stage::Elsewhere;
            actions.push_back(Action::Fetch(elsewhere));
        }
    }

    /// The others did not give it.
    pub fn unfetched(&mut self, hash: BlobHash) {
        if self.stage(hash) == Some(Stage::Elsewhere) {
            self.asked -= 1;
            self.want_here(hash);
        }
    }

    /// What came is not what was asked for: it is asked for again, of the coordinator.
    /// `Some` if that has happened too often.
    pub fn damaged(&mut self, hash: BlobHash) -> Option<Failure> {
        let way = self.blobs.get_mut(&hash)?;
        way.damaged += 1;
        if way.damaged >= DAMAGED_MAX {
            return self.lost(hash);
        }
        self.want_here(hash);
        None
    }

    /// The coordinator says that there is no such blob.
    pub fn refused(&mut self, hash: BlobHash) -> Option<Failure> {
        if self.stage(hash) != Some(Stage::Asked) {
            return None;
        }
        self.asked -= 1;
        self.lost(hash)
    }

    /// A blob cannot be had.
    pub fn lost(&mut self, hash: BlobHash) -> Option<Failure> {
        let way = self.remove(hash)?;
        Some(if way.urgent { Failure::Urgent } else { Failure::Early })
    }

    /// Asks for what is wanted, many at a time: for what a job waits for, if `waits` says
    /// that it does; what nobody waits for any more is dropped. While no job waits at all
    /// (`calm`), some of what was foreseen is looked for, and asked for.
    pub fn ask(
        &mut self,
        waits: impl Fn(BlobHash) -> bool,
        calm: bool,
        actions: &mut VecDeque<Action>,
    ) {
        let mut asked = Vec::new();
        if self.asked <= ASKED_MAX / 2 {
            while self.asked + asked.len() < ASKED_MAX {
                let Some(hash) = self.wanted.pop_front() else { break };
                if waits(hash) {
                    asked.push(hash);
                } else {
                    self.remove(hash);
                }
            }
        }
        if calm && self.wanted.is_empty() {
            while self.early < EARLY_MAX
                && let Some(hash) = self.foreseen.pop_front()
            {
                if let Entry::Vacant(unknown) = self.blobs.entry(hash) {
                    let stage = Stage::Looking;
                    unknown.insert(Way { stage, urgent: false, here: false, damaged: 0 });
                    self.early += 1;
                    actions.push_back(Action::Seek(hash));
                }
            }
            asked.extend(self.early_wanted.drain(..));
        }
        self.send(asked, actions);
    }

    fn send(&mut self, hashes: Vec<BlobHash>, actions: &mut VecDeque<Action>) {
        let mut by_way = [Vec::new(), Vec::new()];
        for hash in hashes {
            if let Some(way) = self.blobs.get_mut(&hash) {
                way.stage = Stage::Asked;
                by_way[usize::from(way.here)].push(hash);
                self.asked += 1;
            }
        }
        for (hashes, elsewhere) in by_way.into_iter().zip([true, false]) {
            if !hashes.is_empty() {
                let want: Message = WantBlobs { hashes, elsewhere }.into();
                actions.push_back(Action::Send(want));
            }
        }
    }

    fn want_here(&mut self, hash: BlobHash) {
        if let Some(way) = self.blobs.get_mut(&hash) {
            way.here = true;
            self.want(hash);
        }
    }

    fn want(&mut self, hash: BlobHash) {
        let Some(way) = self.blobs.get_mut(&hash) else { return };
        way.stage = Stage::Wanted;
        let queue = if way.urgent { &mut self.wanted } else { &mut self.early_wanted };
        queue.push_back(hash);
    }

    fn stage(&self, hash: BlobHash) -> Option<Stage> {
        self.blobs.get(&hash).map(|way| way.stage)
    }

    fn remove(&mut self, hash: BlobHash) -> Option<Way> {
        let way = self.blobs.remove(&hash)?;
        self.early -= usize::from(!way.urgent);
        Some(way)
    }
}

/// Where a blob comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Source {
    /// From the coordinator.
    Coordinator,
    /// From another worker.
    Peer,
}

impl Source {
    fn stage(self) -> Stage {
        match self {
            Source::Coordinator => Stage::Asked,
            Source::Peer => Stage::Elsewhere,
        }
    }
}
