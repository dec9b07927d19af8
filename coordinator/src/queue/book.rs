//! What the queue decides: which shots are in the farm, what an order does, when a shot is
//! over. Pure: it reads no clock and no disk.
//!
//! The ledger is written first, then the book changes: after a crash, the book made of the
//! ledger is the one that was acknowledged.

use super::QueueError;
use super::ledger::{Progress, Saved, ShotRecord, Stage};
use crate::order::Order;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, HashSet};
use terrafarm_common::id::{BlobHash, ShotId};

/// Shots in the farm for each that is to be there: those that were displaced or paused
/// may stay, for what they have begun.
const PRESENT_PER_ACTIVE: usize = 3;
/// Frames of all shots in the farm together. It takes twice as many, the rest are for those
/// who render at once.
const FRAMES_PRESENT_MAX: u64 = 2 << 20;
/// Pixels in flight of all shots in the farm together: 4 GiB, half of what it takes.
const PIXELS_PRESENT_MAX: u64 = (4 << 30) / 3;

/// Everything that is known of the shots.
#[derive(Debug)]
pub struct Book {
    shots: BTreeMap<ShotId, Shot>,
    /// Shots whose frames are wanted, most urgent first.
    line: BTreeSet<(Reverse<i32>, ShotId)>,
    /// Shots that are over, by number.
    over: BTreeSet<ShotId>,
    /// Shots whose manifest or film is missing.
    finishing: BTreeSet<ShotId>,
    present: BTreeSet<ShotId>,
    /// Shots that lack terrain.
    lacking: BTreeSet<ShotId>,
    active: usize,
}

/// One shot.
#[derive(Debug)]
pub struct Shot {
    /// What is kept of it.
    pub record: ShotRecord,
    /// How far it is.
    pub progress: Progress,
    /// Terrain that is damaged or missing: nothing goes on without it.
    pub lacks: Option<BlobHash>,
    /// Why the farm did not take it; it is offered again later.
    pub refused: Option<String>,
    /// Why its own folder takes no pictures, while the disk does: it alone waits.
    pub stuck: Option<QueueError>,
    /// Frames that have come and are not yet recorded: it does not enter the farm before
    /// they are, or they would be rendered twice.
    pub in_hand: usize,
}

/// What is to be done in the farm.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Move {
    /// Submit a shot.
    Enter(ShotId),
    /// Take a shot back.
    Leave(ShotId),
}

impl Shot {
    /// Memory that it takes in the farm: frames, and pixels in flight.
    fn weight(&self) -> (u64, u64) {
        let plan = &self.record.plan;
        let pixels = u64::from(plan.size[0]) * u64::from(plan.size[1]);
        // A record that was damaged may say anything; too much is too much.
        let in_flight = pixels.saturating_mul(u64::from(plan.frames_in_flight));
        (self.record.frames.into(), in_flight.min(PIXELS_PRESENT_MAX + 1))
    }

    /// Whether terrain and folder are as they should be.
    pub fn may_go_on(&self) -> bool {
        self.lacks.is_none() && self.stuck.is_none()
    }

    /// Whether no frame of it is missing.
    pub fn is_complete(&self) -> bool {
        self.progress.over() >= self.record.frames
    }
}

impl Book {
    /// What was saved; so many shots are to be in the farm at once.
    pub fn new(saved: Vec<Saved>, active: usize) -> Self {
        let mut book = Book {
            shots: BTreeMap::new(),
            line: BTreeSet::new(),
            over: BTreeSet::new(),
            finishing: BTreeSet::new(),
            present: BTreeSet::new(),
            lacking: BTreeSet::new(),
            active: active.max(1),
        };
        for shot in saved {
            book.add(shot);
        }
        book
    }

    /// A new shot.
    pub fn add(&mut self, saved: Saved) {
        let Saved { id, record, progress } = saved;
        let shot = Shot { record, progress, lacks: None, refused: None, stuck: None, in_hand: 0 };
        self.shots.insert(id, shot);
        self.file(id);
    }

    /// A shot.
    pub fn get(&self, id: ShotId) -> Option<&Shot> {
        self.shots.get(&id)
    }

    /// All shots.
    pub fn iter(&self) -> impl Iterator<Item = (ShotId, &Shot)> {
        self.shots.iter().map(|(&id, shot)| (id, shot))
    }

    /// Shots that are not over.
    pub fn unfinished(&self) -> usize {
        self.shots.len() - self.over.len()
    }

    /// Shots that are over beyond this number, oldest first.
    pub fn surplus(&self, limit: usize) -> Vec<ShotId> {
        let surplus = self.over.len().saturating_sub(limit);
        self.over.iter().take(surplus).copied().collect()
    }

    /// A shot is no longer listed.
    pub fn forget(&mut self, id: ShotId) {
        self.unfile(id);
        self.over.remove(&id);
        self.lacking.remove(&id);
        self.shots.remove(&id);
    }

    /// Indices of terrain that unfinished shots need.
    pub fn terrain(&self) -> HashSet<BlobHash> {
        let unfinished = self.shots.values().filter(|shot| !shot.record.stage.is_over());
        unfinished.map(|shot| shot.record.plan.index).collect()
    }

    /// What an order makes of a shot's record; `None` if it changes nothing.
    ///
    /// # Errors
    /// If there is no such shot, or it is too late.
    pub fn ordered(&self, order: Order) -> Result<Option<ShotRecord>, QueueError> {
        let (id, wanted) = match order {
            Order::Pause(id) => (id, Some(Stage::Paused)),
            Order::Resume(id) => (id, Some(Stage::Open)),
            Order::Cancel(id) => (id, Some(Stage::Canceled)),
            Order::Prioritise(id, _) | Order::Why(id, _) | Order::Clear(_, Some(id)) => (id, None),
            Order::Clear(_, None) | Order::Drain(_) => return Ok(None),
        };
        let shot = self.shots.get(&id).ok_or(QueueError::NoShot(id))?;
        let mut record = shot.record.clone();
        match (order, wanted) {
            (Order::Prioritise(_, priority), _) => record.plan.priority = priority,
            (_, Some(stage)) => {
                record.stage = stage;
                record.note.clear();
            }
            _ => return Ok(None),
        }
        let now = shot.record.stage;
        let may = match now {
            Stage::Open | Stage::Paused => true,
            Stage::Finishing => matches!(order, Order::Cancel(_) | Order::Prioritise(..)),
            Stage::Done | Stage::Failed | Stage::Canceled => false,
        };
        let is_same = record.stage == now && record.plan.priority == shot.record.plan.priority;
        match (is_same, may) {
            (true, _) => Ok(None),
            (false, true) => Ok(Some(record)),
            (false, false) => Err(QueueError::Over { shot: id, state: state_of(now) }),
        }
    }

    /// The record of a shot has been written.
    pub fn set(&mut self, id: ShotId, record: ShotRecord) {
        self.unfile(id);
        if let Some(shot) = self.shots.get_mut(&id) {
            shot.record = record;
            shot.refused = None;
        }
        self.file(id);
    }

    /// Frames of a shot have been written.
    pub fn advance(&mut self, id: ShotId, progress: Progress) {
        if let Some(shot) = self.shots.get_mut(&id) {
            shot.progress = progress;
        }
    }

    /// Terrain of a shot is missing, or is there again.
    pub fn set_lacks(&mut self, id: ShotId, lacks: Option<BlobHash>) {
        let Some(shot) = self.shots.get_mut(&id) else { return };
        shot.lacks = lacks;
        if lacks.is_some() {
            self.lacking.insert(id);
        } else {
            self.lacking.remove(&id);
        }
    }

    /// The shots that lack a blob, and which.
    pub fn all_lacking(&self) -> Vec<(ShotId, BlobHash)> {
        let lacks = |&id: &ShotId| Some((id, self.shots.get(&id)?.lacks?));
        self.lacking.iter().filter_map(lacks).collect()
    }

    /// The shots that lack this blob.
    pub fn lacking(&self, hash: BlobHash) -> Vec<ShotId> {
        let lacks = |id: &ShotId| self.shots.get(id).is_some_and(|shot| shot.lacks == Some(hash));
        self.lacking.iter().copied().filter(lacks).collect()
    }

    /// The farm has not taken a shot.
    pub fn set_refused(&mut self, id: ShotId, why: Option<String>) {
        if let Some(shot) = self.shots.get_mut(&id) {
            shot.refused = why;
        }
    }

    /// The folder of a shot fails, or does not any more.
    pub fn set_stuck(&mut self, id: ShotId, why: Option<QueueError>) {
        if let Some(shot) = self.shots.get_mut(&id) {
            shot.stuck = why;
        }
    }

    /// So many more frames of a shot have come, or so many fewer are still to be recorded.
    pub fn count_in_hand(&mut self, id: ShotId, change: isize) {
        if let Some(shot) = self.shots.get_mut(&id) {
            shot.in_hand = shot.in_hand.saturating_add_signed(change);
        }
    }

    /// The shot that is to get its manifest and film next.
    pub fn to_finish(&self) -> Option<ShotId> {
        let is_free = |id: &&ShotId| self.shots.get(id).is_some_and(|shot| shot.stuck.is_none());
        self.finishing.iter().find(is_free).copied()
    }

    /// A shot went to the farm, or came back.
    pub fn set_present(&mut self, id: ShotId, is_present: bool) {
        if is_present {
            self.present.insert(id);
        } else {
            self.present.remove(&id);
        }
    }

    /// What the farm should do next; empty when all is as it should be.
    pub fn moves(&self) -> Vec<Move> {
        let may_run = |id: &ShotId| {
            let shot = &self.shots[id];
            let may_enter = shot.refused.is_none() && shot.in_hand == 0 && !shot.is_complete();
            shot.may_go_on() && (may_enter || self.present.contains(id))
        };
        let wanted: Vec<_> =
            self.line.iter().map(|(_, id)| *id).filter(may_run).take(self.active).collect();
        let mut moves = Vec::new();
        let mut present = self.present.clone();
        let (mut frames, mut pixels) = self.present.iter().fold((0, 0), |sum, id| {
            let weight = self.shots.get(id).map_or((0, 0), Shot::weight);
            (sum.0 + weight.0, sum.1 + weight.1)
        });
        // Those that nobody would miss: paused ones first, then the least urgent.
        let mut idle: Vec<_> =
            self.present.iter().copied().filter(|id| !wanted.contains(id)).collect();
        idle.sort_by_key(|id| self.shots.get(id).map(|shot| rank(*id, shot)));
        for id in wanted {
            if present.contains(&id) {
                continue;
            }
            let weight = self.shots[&id].weight();
            let has_room = |present: &BTreeSet<_>, frames: u64, pixels: u64| {
                present.is_empty()
                    || (present.len() < PRESENT_PER_ACTIVE * self.active
                        && frames + weight.0 <= FRAMES_PRESENT_MAX
                        && pixels + weight.1 <= PIXELS_PRESENT_MAX)
            };
            while !has_room(&present, frames, pixels) {
                let Some(leaver) = idle.pop() else { return moves };
                let weight = self.shots.get(&leaver).map_or((0, 0), Shot::weight);
                frames -= weight.0;
                pixels -= weight.1;
                present.remove(&leaver);
                moves.push(Move::Leave(leaver));
            }
            frames += weight.0;
            pixels += weight.1;
            present.insert(id);
            moves.push(Move::Enter(id));
        }
        moves
    }

    fn file(&mut self, id: ShotId) {
        let Some(shot) = self.shots.get(&id) else { return };
        match shot.record.stage {
            Stage::Open => {
                self.line.insert((Reverse(shot.record.plan.priority), id));
            }
            stage if stage.is_over() => {
                self.over.insert(id);
            }
            Stage::Finishing => {
                self.finishing.insert(id);
            }
            _ => {}
        }
    }

    fn unfile(&mut self, id: ShotId) {
        if let Some(shot) = self.shots.get(&id) {
            self.line.remove(&(Reverse(shot.record.plan.priority), id));
        }
        self.finishing.remove(&id);
    }

    /// How many shots are before this one.
    pub fn before(&self, id: ShotId) -> usize {
        self.line.iter().take_while(|(_, other)| *other != id).count()
    }
}

/// Larger for those that leave the farm sooner.
fn rank(id: ShotId, shot: &Shot) -> (bool, Reverse<i32>, ShotId) {
    (shot.record.stage != Stage::Open, Reverse(shot.record.plan.priority), id)
}

/// What is shown of a stage, when nothing else counts.
pub fn state_of(stage: Stage) -> crate::view::ShotState {
    use crate::view::ShotState;
    match stage {
        Stage::Open => ShotState::Waiting,
        Stage::Paused => ShotState::Paused,
        Stage::Finishing => ShotState::Finishing,
        Stage::Done => ShotState::Done,
        Stage::Failed => ShotState::Failed,
        Stage::Canceled => ShotState::Canceled,
    }
}
