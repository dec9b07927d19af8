//! Decoded tiles before their turn, within a limit.

use super::Place;
use std::collections::BTreeMap;
use terrafarm_common::id::{BlobHash, FrameIndex, ShotId};
use terrafarm_terrain::resident::Tile;
use terrafarm_terrain::tile::{HEIGHT_TILE_BYTES, PHOTO_TILE_BYTES};

/// Most tiles whose place is remembered before they are there. Others are not kept decoded.
const FORESEEN_MAX: usize = 4096;

/// Most bytes that one tile takes.
const TILE_BYTES: u64 =
    if HEIGHT_TILE_BYTES > PHOTO_TILE_BYTES { HEIGHT_TILE_BYTES } else { PHOTO_TILE_BYTES } as u64;

/// From which frame of which shot on a tile is needed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Due {
    pub shot: ShotId,
    pub frame: FrameIndex,
}

/// The tiles, and where they will lie.
pub(super) struct Pantry {
    foreseen: BTreeMap<BlobHash, (Due, Vec<Place>)>,
    stowed: BTreeMap<BlobHash, Stowed>,
    bytes: u64,
    limit_bytes: u64,
    /// A tile was turned away since this was last asked.
    lacks_room: bool,
}

struct Stowed {
    due: Due,
    places: Vec<Place>,
    tile: Tile,
}

impl Pantry {
    pub fn new(limit_bytes: u64) -> Self {
        Pantry {
            foreseen: BTreeMap::new(),
            stowed: BTreeMap::new(),
            bytes: 0,
            limit_bytes,
            lacks_room: false,
        }
    }

    /// Bytes of the tiles.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Notes where a tile will lie; whether it is still to come.
    pub fn foresee(&mut self, hash: BlobHash, place: Place, due: Due) -> bool {
        if let Some(stowed) = self.stowed.get_mut(&hash) {
            add_place(&mut stowed.places, place);
            return false;
        }
        if let Some((earliest, places)) = self.foreseen.get_mut(&hash) {
            // Another shot's frames are later or sooner: nobody knows.
            *earliest = due.min(*earliest);
            add_place(places, place);
            return true;
        }
        if self.foreseen.len() >= FORESEEN_MAX {
            self.foreseen.pop_first();
        }
        self.foreseen.insert(hash, (due, vec![place]));
        true
    }

    /// Whether one more tile fits, with so many bytes free in all of the memory.
    pub fn has_room(&mut self, free: u64) -> bool {
        let room = self.bytes + TILE_BYTES <= self.limit_bytes.min(free);
        self.lacks_room |= !room;
        room
    }

    /// Whether a tile was turned away since this was last asked.
    pub fn lacks_room(&mut self) -> bool {
        std::mem::take(&mut self.lacks_room)
    }

    /// Keeps a tile that was foreseen, if it fits.
    pub fn stow(&mut self, hash: BlobHash, tile: Tile, free: u64) {
        let Some((due, places)) = self.foreseen.remove(&hash) else { return };
        if self.has_room(free) {
            self.bytes += tile.memory_bytes() as u64;
            self.stowed.insert(hash, Stowed { due, places, tile });
        }
    }

    /// Takes one tile out.
    pub fn take(&mut self, hash: BlobHash) -> Option<Tile> {
        let stowed = self.stowed.remove(&hash)?;
        self.bytes -= stowed.tile.memory_bytes() as u64;
        Some(stowed.tile)
    }

    /// Takes out all that is needed by a frame or by one before it.
    pub fn take_due(&mut self, now: Due) -> Vec<(Vec<Place>, Tile)> {
        let is_due = |stowed: &Stowed| stowed.due.shot == now.shot && stowed.due.frame <= now.frame;
        self.extract(is_due).into_iter().map(|stowed| (stowed.places, stowed.tile)).collect()
    }

    /// Drops the tile that is needed last; whether there was one.
    pub fn drop_last(&mut self) -> bool {
        let last = self.stowed.iter().max_by_key(|(_, stowed)| stowed.due).map(|(hash, _)| *hash);
        last.is_some_and(|hash| self.take(hash).is_some())
    }

    /// A tile will not come, or not to be kept here.
    pub fn give_up(&mut self, hash: BlobHash) {
        self.foreseen.remove(&hash);
    }

    /// Nothing is needed for a shot any more.
    pub fn forget_shot(&mut self, shot: ShotId) {
        self.foreseen.retain(|_, (due, _)| due.shot != shot);
        self.extract(|stowed| stowed.due.shot == shot);
    }

    /// A store is gone.
    pub fn forget_store(&mut self, store: BlobHash) {
        let elsewhere = |places: &[Place]| places.iter().any(|place| place.store != store);
        self.foreseen.retain(|_, (_, places)| elsewhere(places));
        self.extract(|stowed| !elsewhere(&stowed.places));
    }

    fn extract(&mut self, which: impl Fn(&Stowed) -> bool) -> Vec<Stowed> {
        let taken: Vec<_> = self
            .stowed
            .extract_if(.., |_, stowed| which(stowed))
            .map(|(_, stowed)| stowed)
            .collect();
        self.bytes -= taken.iter().map(|stowed| stowed.tile.memory_bytes() as u64).sum::<u64>();
        taken
    }
}

fn add_place(places: &mut Vec<Place>, place: Place) {
    if !places.contains(&place) {
        places.push(place);
    }
}
