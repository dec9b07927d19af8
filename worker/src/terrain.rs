//! Decoded terrain in memory: stores, their tiles, and a limit.
//!
//! When the limit is exceeded, the tiles that no job has looked at for longest are
//! forgotten first; the ray caster leaves a trace of what it looks at. Tiles that the
//! present job has asked for stay until it ends: so a job always gets further. A tile that
//! was wrongly forgotten comes back from the cache on disk in about a millisecond.
//!
//! Tiles that were fetched before their turn lie in the pantry, within an eighth of the
//! limit, until the job that is due begins. Room for them is made by tiles that no job has
//! looked at for long, never by what jobs use; where there is none they stay packed on disk.
//!
//! The roots of a store, a tile or a few for each layer, are loaded with the first tiles
//! that a job asks for and stay as long as the store does: whoever cannot wait for a tile
//! finds some ground there (`terrafarm_raycast::depths_at_hand`).

mod pantry;

use crate::render::Scene;
use pantry::{Due, Pantry};
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use terrafarm_common::id::{BlobHash, FrameIndex, ShotId};
use terrafarm_terrain::layout::TileKey;
use terrafarm_terrain::resident::{Resident, Tile};
use terrafarm_terrain::tile::{HEIGHT_TILE_BYTES, PHOTO_TILE_BYTES};

/// Most stores whose index stays in memory although no shot uses it.
const IDLE_STORES_MAX: usize = 4;

/// Part of the limit that the roots of a store may take: more are ordinary tiles.
const ROOTS_PART: u64 = 8;

/// Part of the limit that tiles before their turn may take.
const PANTRY_PART: u64 = 8;

/// Part of the limit that is freed beyond need, so that not every tile costs a look at all.
const SLACK_PART: u64 = 16;

/// Jobs that have not looked at a tile before it makes room for one before its turn: as
/// many as a frame may have for one worker.
const UNUSED_JOBS: u32 = 64;

/// All terrain in memory. `P` is what the ray caster works out for each store.
pub struct Terrain<P> {
    stores: BTreeMap<BlobHash, Store<P>>,
    /// Places that wait for a tile, by its hash. The same tile may lie at many: sea does.
    awaited: BTreeMap<BlobHash, Vec<Place>>,
    /// Where the job before it awaited tiles: what comes late is kept for those that follow.
    awaited_before: BTreeMap<BlobHash, Vec<Place>>,
    /// Tiles in memory, in the order in which they came.
    loaded: Vec<Loaded>,
    bytes: u64,
    limit_bytes: u64,
    pantry: Pantry,
    /// Stores that no shot uses, oldest first.
    idle: VecDeque<BlobHash>,
}

struct Store<P> {
    resident: Arc<Resident>,
    prepared: Arc<P>,
    /// Tiles that stay as long as the store does, sorted ...
    roots: Vec<TileKey>,
    /// ... and the bytes of those that are loaded.
    root_bytes: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Place {
    store: BlobHash,
    key: TileKey,
}

/// One tile in memory, and where it lies.
#[derive(Debug)]
struct Loaded {
    places: Vec<Place>,
    bytes: u64,
    /// The present job has asked for it.
    pinned: bool,
}

impl<P> Terrain<P> {
    /// Nothing yet; decoded tiles may take this many bytes.
    pub fn new(limit_bytes: u64) -> Self {
        Terrain {
            stores: BTreeMap::new(),
            awaited: BTreeMap::new(),
            awaited_before: BTreeMap::new(),
            loaded: Vec::new(),
            bytes: 0,
            limit_bytes,
            pantry: Pantry::new(limit_bytes / PANTRY_PART),
            idle: VecDeque::new(),
        }
    }

    /// Bytes that decoded tiles take, those before their turn included.
    pub fn bytes(&self) -> u64 {
        self.bytes + self.pantry.bytes()
    }

    /// The most they may take.
    pub fn limit_bytes(&self) -> u64 {
        self.limit_bytes
    }

    /// Whether the index of this store is in memory. Marks it as used.
    pub fn has_store(&mut self, store: BlobHash) -> bool {
        self.idle.retain(|idle| *idle != store);
        self.stores.contains_key(&store)
    }

    /// Takes a store whose index has passed its check.
    pub fn add_store(&mut self, store: BlobHash, resident: Resident, prepared: P) {
        let mut roots = resident.index().roots();
        let most = HEIGHT_TILE_BYTES.max(PHOTO_TILE_BYTES) as u64;
        if roots.len() as u64 > self.limit_bytes / ROOTS_PART / most {
            roots.clear();
        }
        let (resident, prepared) = (Arc::new(resident), Arc::new(prepared));
        self.stores.insert(store, Store { resident, prepared, roots, root_bytes: 0 });
    }

    /// No shot uses a store any more: keeps it for a while, for the next shot.
    pub fn release(&mut self, store: BlobHash) {
        if !self.stores.contains_key(&store) || self.idle.contains(&store) {
            return;
        }
        self.idle.push_back(store);
        if self.idle.len() > IDLE_STORES_MAX
            && let Some(oldest) = self.idle.pop_front()
        {
            self.bytes -= self.stores.remove(&oldest).map_or(0, |store| store.root_bytes);
            self.pantry.forget_store(oldest);
            let bytes = &mut self.bytes;
            self.loaded.retain_mut(|loaded| {
                loaded.places.retain(|place| place.store != oldest);
                if loaded.places.is_empty() {
                    *bytes -= loaded.bytes;
                }
                !loaded.places.is_empty()
            });
        }
    }

    /// A shot is over: what was fetched before its turn for it has none.
    pub fn close_shot(&mut self, shot: ShotId) {
        self.pantry.forget_shot(shot);
    }

    /// A new job begins: no tile has to stay for the one before it, and the tiles come in that
    /// were fetched for it or for frames before.
    pub fn begin_job(&mut self, shot: ShotId, frame: FrameIndex) {
        self.awaited_before = std::mem::take(&mut self.awaited);
        self.loaded.iter_mut().for_each(|loaded| loaded.pinned = false);
        self.stores.values().for_each(|store| store.resident.next_round());
        for (places, tile) in self.pantry.take_due(Due { shot, frame }) {
            // A tile that is no good there is found out when a job asks for it.
            let _unfit = self.insert(places, &tile, false);
        }
        self.trim();
        if self.pantry.lacks_room() {
            self.make_room_ahead();
        }
    }

    /// The terrain as a job sees it now.
    pub fn scene(&self, store: BlobHash) -> Option<Scene<P>> {
        let store = self.stores.get(&store)?;
        Some(Scene { resident: store.resident.clone(), prepared: store.prepared.clone() })
    }

    /// Notes that a job waits for tiles; their hashes, each once. Roots of the store that are
    /// not in memory are among them.
    pub fn await_tiles(&mut self, store: BlobHash, keys: &[TileKey]) -> Vec<BlobHash> {
        let Some(known) = self.stores.get(&store) else { return Vec::new() };
        let mut hashes = Vec::new();
        let absent = |key: &TileKey| !known.resident.is_loaded(*key);
        let roots = known.roots.iter().copied().filter(absent);
        for key in roots.chain(keys.iter().copied()) {
            let Some(entry) = known.resident.index().entry(key) else { continue };
            let places = self.awaited.entry(entry.hash).or_default();
            let place = Place { store, key };
            if !places.contains(&place) {
                places.push(place);
            }
            hashes.push(entry.hash);
        }
        hashes.sort_unstable();
        hashes.dedup();
        hashes
    }

    /// Notes that tiles will be needed by a frame of a shot; the hashes of those that are
    /// not in memory, each once.
    pub fn foresee_tiles(
        &mut self,
        store: BlobHash,
        (shot, frame): (ShotId, FrameIndex),
        keys: &[TileKey],
    ) -> Vec<BlobHash> {
        let Some(known) = self.stores.get(&store) else { return Vec::new() };
        let mut hashes = Vec::new();
        for &key in keys.iter().filter(|key| !known.resident.is_loaded(**key)) {
            let Some(entry) = known.resident.index().entry(key) else { continue };
            if self.pantry.foresee(entry.hash, Place { store, key }, Due { shot, frame }) {
                hashes.push(entry.hash);
            }
        }
        hashes.sort_unstable();
        hashes.dedup();
        hashes
    }

    /// Whether there is room for one more tile before its turn.
    pub fn has_room_ahead(&mut self) -> bool {
        let free = self.limit_bytes.saturating_sub(self.bytes);
        self.pantry.has_room(free)
    }

    /// Keeps a tile until its turn; drops it if there is no room, or if nobody foresaw it.
    pub fn stow(&mut self, hash: BlobHash, tile: Tile) {
        let free = self.limit_bytes.saturating_sub(self.bytes);
        self.pantry.stow(hash, tile, free);
    }

    /// A tile that a job waits for and that was fetched before its turn.
    pub fn take_stowed(&mut self, hash: BlobHash) -> Option<Tile> {
        self.pantry.take(hash)
    }

    /// A tile that was foreseen is on disk, and stays there until its turn.
    pub fn leave_on_disk(&mut self, hash: BlobHash) {
        self.pantry.give_up(hash);
    }

    /// Whether a tile lies wherever it is awaited: it has come while the job rendered that
    /// says that it waits for it, as tiles do that a live job did without. It is not awaited
    /// any more then.
    pub fn has_come(&mut self, hash: BlobHash) -> bool {
        let is_here = |place: &Place| {
            let store = self.stores.get(&place.store);
            store.is_some_and(|store| store.resident.is_loaded(place.key))
        };
        let has_come = self.awaited.get(&hash).is_some_and(|places| places.iter().all(is_here));
        if has_come {
            self.awaited.remove(&hash);
        }
        has_come
    }

    /// Puts a tile wherever it is awaited; one that nobody awaits is dropped. Says what is
    /// wrong if it does not belong there.
    pub fn add_tile(&mut self, hash: BlobHash, tile: &Tile) -> Result<(), String> {
        let before = self.awaited_before.remove(&hash);
        let added = match self.awaited.remove(&hash) {
            Some(places) => self.insert(places, tile, true),
            None => self.insert(before.unwrap_or_default(), tile, false),
        };
        self.trim();
        added
    }

    fn insert(&mut self, places: Vec<Place>, tile: &Tile, pinned: bool) -> Result<(), String> {
        // The places share one tile.
        let bytes = tile.memory_bytes() as u64;
        let mut loaded = Loaded { places: Vec::new(), bytes, pinned };
        let mut outcome = Ok(());
        let mut is_root = false;
        for place in places {
            let Some(store) = self.stores.get_mut(&place.store) else { continue };
            if store.resident.is_loaded(place.key) {
                continue;
            }
            // No job looks at the tiles now, so nothing is copied here, except while a
            // scout does, or after a lost connection while its last job winds up.
            if !Arc::make_mut(&mut store.resident).insert(place.key, tile.clone()) {
                outcome = Err(format!("it is no tile for {:?}", place.key));
                break;
            }
            if store.roots.binary_search(&place.key).is_ok() {
                if !std::mem::replace(&mut is_root, true) {
                    store.root_bytes += bytes;
                }
            } else {
                loaded.places.push(place);
            }
        }
        if is_root || !loaded.places.is_empty() {
            self.bytes += bytes;
        }
        if !loaded.places.is_empty() {
            // A root's bytes are counted with its store.
            loaded.bytes = if is_root { 0 } else { bytes };
            self.loaded.push(loaded);
        }
        outcome
    }

    /// A tile cannot be had.
    pub fn give_up(&mut self, hash: BlobHash) {
        self.awaited.remove(&hash);
        self.awaited_before.remove(&hash);
        self.pantry.give_up(hash);
    }

    /// Whether the tiles of the present job alone take more than the limit, in words.
    pub fn over_limit(&self) -> Option<String> {
        (self.bytes > self.limit_bytes).then(|| {
            let megabytes = |bytes: u64| bytes.div_ceil(1 << 20);
            format!(
                "the job needs {} MB of decoded terrain, the worker's limit is {} MB; \
                 raise it, or cut frames into smaller jobs",
                megabytes(self.bytes),
                megabytes(self.limit_bytes)
            )
        })
    }

    /// Forgets the tiles unused longest that the present job has not asked for, until the
    /// rest is within the limit. Tiles before their turn go before those that jobs use.
    fn trim(&mut self) {
        if self.bytes() <= self.limit_bytes {
            return;
        }
        let goal = self.limit_bytes - self.limit_bytes / SLACK_PART;
        for (age, number) in self.by_age() {
            while age < UNUSED_JOBS && self.bytes() > self.limit_bytes && self.pantry.drop_last() {}
            let enough = if age < UNUSED_JOBS { self.limit_bytes } else { goal };
            if self.bytes() <= enough {
                break;
            }
            self.forget(number);
        }
        while self.bytes() > self.limit_bytes && self.pantry.drop_last() {}
        self.loaded.retain(|loaded| !loaded.places.is_empty());
    }

    /// Forgets tiles that no job has looked at for long, until tiles before their turn have
    /// the room that they may take.
    fn make_room_ahead(&mut self) {
        let goal = self.limit_bytes - self.limit_bytes / PANTRY_PART;
        if self.bytes <= goal {
            return;
        }
        for (_, number) in self.by_age().into_iter().take_while(|(age, _)| *age >= UNUSED_JOBS) {
            if self.bytes <= goal {
                break;
            }
            self.forget(number);
        }
        self.loaded.retain(|loaded| !loaded.places.is_empty());
    }

    /// The tiles that the present job has not asked for: jobs since they were used and
    /// place in the list, those unused longest first.
    fn by_age(&self) -> Vec<(u32, usize)> {
        let age = |place: &Place| {
            self.stores.get(&place.store).map_or(u32::MAX, |store| store.resident.age(place.key))
        };
        let free = self.loaded.iter().enumerate().filter(|(_, loaded)| !loaded.pinned);
        let mut aged: Vec<_> = free
            .map(|(number, loaded)| (loaded.places.iter().map(age).min().unwrap_or(0), number))
            .collect();
        aged.sort_unstable_by(|(age_a, a), (age_b, b)| age_b.cmp(age_a).then(a.cmp(b)));
        aged
    }

    /// Forgets one tile of the list, and leaves an entry without a place there.
    fn forget(&mut self, number: usize) {
        let loaded = &mut self.loaded[number];
        self.bytes -= loaded.bytes;
        for place in loaded.places.drain(..) {
            if let Some(store) = self.stores.get_mut(&place.store) {
                Arc::make_mut(&mut store.resident).remove(place.key);
            }
        }
    }
}

#[cfg(test)]
mod tests;
