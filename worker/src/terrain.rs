//! Decoded terrain in memory: stores, their tiles, and a limit.
//!
//! Tiles are forgotten in the order in which they were loaded, oldest first, when the
//! limit is exceeded; the ray caster leaves no trace of what it looks at, and a tile that
//! was wrongly forgotten comes back from the cache on disk in about a millisecond. Tiles
//! that the present job has asked for stay until it ends: so a job always gets further.
//!
//! The roots of a store, a tile or a few for each layer, are loaded with the first tiles
//! that a job asks for and stay as long as the store does: whoever cannot wait for a tile
//! finds some ground there (`terrafarm_raycast::depths_at_hand`).

use crate::render::Scene;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use terrafarm_common::id::BlobHash;
use terrafarm_terrain::layout::TileKey;
use terrafarm_terrain::resident::{Resident, Tile};
use terrafarm_terrain::tile::{HEIGHT_TILE_BYTES, PHOTO_TILE_BYTES};

/// Most stores whose index stays in memory although no shot uses it.
const IDLE_STORES_MAX: usize = 4;

/// Part of the limit that the roots of a store may take: more are ordinary tiles.
const ROOTS_PART: u64 = 8;

/// All terrain in memory. `P` is what the ray caster works out for each store.
pub struct Terrain<P> {
    stores: BTreeMap<BlobHash, Store<P>>,
    /// Places that wait for a tile, by its hash. The same tile may lie at many: sea does.
    awaited: BTreeMap<BlobHash, Vec<Place>>,
    /// Tiles in memory, oldest first.
    loaded: VecDeque<Loaded>,
    /// How many of the newest of them the present job has asked for.
    pinned: usize,
    bytes: u64,
    limit_bytes: u64,
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

#[derive(Debug)]
struct Loaded {
    place: Place,
    bytes: u64,
}

impl<P> Terrain<P> {
    /// Nothing yet; decoded tiles may take this many bytes.
    pub fn new(limit_bytes: u64) -> Self {
        Terrain {
            stores: BTreeMap::new(),
            awaited: BTreeMap::new(),
            loaded: VecDeque::new(),
            pinned: 0,
            bytes: 0,
            limit_bytes,
            idle: VecDeque::new(),
        }
    }

    /// Bytes that decoded tiles take.
    pub fn bytes(&self) -> u64 {
        self.bytes
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
            let roots = self.stores.remove(&oldest).map_or(0, |store| store.root_bytes);
            self.bytes -= roots;
            let gone = |loaded: &Loaded| loaded.place.store == oldest;
            self.bytes -= self.loaded.iter().filter(|l| gone(l)).map(|l| l.bytes).sum::<u64>();
            self.loaded.retain(|loaded| !gone(loaded));
            self.pinned = self.pinned.min(self.loaded.len());
        }
    }

    /// A new job begins: nothing is kept for the one before it.
    pub fn begin_job(&mut self) {
        self.pinned = 0;
        self.awaited.clear();
        self.trim();
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

    /// Puts a tile wherever it is awaited; one that nobody awaits is dropped. Says what is wrong if it does not belong there.
    pub fn add_tile(&mut self, hash: BlobHash, tile: &Tile) -> Result<(), String> {
        let mut bytes = tile.memory_bytes() as u64;
        for place in self.awaited.remove(&hash).unwrap_or_default() {
            let Some(store) = self.stores.get_mut(&place.store) else { continue };
            // No job looks at the tiles now, so nothing is copied here, except after a
            // lost connection while its last job winds up.
            if !Arc::make_mut(&mut store.resident).insert(place.key, tile.clone()) {
                return Err(format!("it is no tile for {:?}", place.key));
            }
            // The places share one tile.
            let bytes = std::mem::take(&mut bytes);
            self.bytes += bytes;
            if store.roots.binary_search(&place.key).is_ok() {
                store.root_bytes += bytes;
            } else {
                self.loaded.push_back(Loaded { place, bytes });
                self.pinned += 1;
            }
        }
        self.trim();
        Ok(())
    }

    /// A tile cannot be had.
    pub fn give_up(&mut self, hash: BlobHash) {
        self.awaited.remove(&hash);
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

    /// Forgets the oldest tiles that the present job has not asked for.
    fn trim(&mut self) {
        while self.bytes > self.limit_bytes && self.loaded.len() > self.pinned {
            let Some(oldest) = self.loaded.pop_front() else { return };
            self.bytes -= oldest.bytes;
            if let Some(store) = self.stores.get_mut(&oldest.place.store) {
                Arc::make_mut(&mut store.resident).remove(oldest.place.key);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use terrafarm_terrain::layout::*;
    use terrafarm_terrain::resident::Lookup;
    use terrafarm_terrain::tile::HeightTile;

    const STORE: BlobHash = BlobHash([1; 32]);

    /// A store of a row of tiles; the last one is the same as the first.
    fn resident() -> Resident {
        let count = 6;
        let entry = |number: u32| TileEntry {
            hash: BlobHash([10 + (number % (count - 1)) as u8; 32]),
            length: 1,
            min: 0.0,
            max: 0.0,
            ..TileEntry::EMPTY
        };
        let level = |count| Level { tiles: [count, 1], entries: (0..count).map(entry).collect() };
        let layer = Layer {
            kind: LayerKind::Height,
            origin: [0.0; 2],
            spacing: [1.0; 2],
            posts: [u64::from(count) * TILE_CELLS as u64 + 1, 2],
            levels: [6, 3, 2, 1].map(level).into(),
        };
        let index = StoreIndex {
            version: STORE_VERSION,
            crs: "LOCAL".to_owned(),
            height_datum: HeightDatum::Unknown,
            earth_radius_m: None,
            layers: vec![layer],
            report: ImportReport::default(),
        };
        index.check().expect("a sound index");
        Resident::new(Arc::new(index))
    }

    fn tile() -> Tile {
        let posts = vec![0.0; TILE_POSTS * TILE_POSTS].into_boxed_slice();
        Tile::Height(Arc::new(HeightTile::new(posts).expect("the right number of posts")))
    }

    fn key(tx: u32) -> TileKey {
        TileKey { layer: 0, level: 0, tx, ty: 0 }
    }

    /// Room for this many tiles.
    fn terrain(tiles: usize) -> Terrain<()> {
        let mut terrain = Terrain::new((tiles * tile().memory_bytes()) as u64);
        terrain.add_store(STORE, resident(), ());
        terrain
    }

    fn load(terrain: &mut Terrain<()>, keys: &[TileKey]) {
        for hash in terrain.await_tiles(STORE, keys) {
            terrain.add_tile(hash, &tile()).expect("it belongs there");
        }
    }

    fn in_memory(terrain: &Terrain<()>) -> Vec<u32> {
        let scene = terrain.scene(STORE).expect("the store is there");
        let found = |tx: &u32| matches!(scene.resident.height(key(*tx)), Lookup::Found(_));
        (0..6).filter(found).collect()
    }

    #[test]
    fn the_oldest_tiles_go_when_the_next_job_needs_room() {
        let mut terrain = terrain(3);
        load(&mut terrain, &[key(0), key(1)]);
        terrain.begin_job();
        load(&mut terrain, &[key(2), key(3)]);
        assert_eq!(in_memory(&terrain), [1, 2, 3]);
        assert_eq!(terrain.bytes(), 3 * tile().memory_bytes() as u64);
        assert_eq!(terrain.over_limit(), None);
    }

    #[test]
    fn the_tiles_of_the_present_job_stay_and_too_many_of_them_are_told() {
        let mut terrain = terrain(2);
        load(&mut terrain, &[key(0), key(1), key(2)]);
        assert_eq!(in_memory(&terrain), [0, 1, 2]);
        assert!(terrain.over_limit().is_some_and(|why| why.contains("limit is 1 MB")));
        terrain.begin_job();
        assert_eq!(in_memory(&terrain), [1, 2]);
        assert_eq!(terrain.over_limit(), None);
    }

    #[test]
    fn a_tile_that_lies_at_two_places_is_fetched_and_counted_once() {
        let mut terrain = terrain(9);
        assert_eq!(terrain.await_tiles(STORE, &[key(0), key(5), key(0)]).len(), 1);
        load(&mut terrain, &[]);
        assert!(in_memory(&terrain).is_empty());
        terrain.add_tile(BlobHash([10; 32]), &tile()).expect("it belongs there");
        assert_eq!(in_memory(&terrain), [0, 5]);
        assert_eq!(terrain.bytes(), tile().memory_bytes() as u64);
    }

    #[test]
    fn the_root_is_loaded_with_the_first_tile_and_stays() {
        let least = ROOTS_PART as usize * HEIGHT_TILE_BYTES.max(PHOTO_TILE_BYTES);
        let mut terrain: Terrain<()> = Terrain::new(least as u64);
        terrain.add_store(STORE, resident(), ());
        let root = TileKey { layer: 0, level: 3, tx: 0, ty: 0 };
        let is_there = |terrain: &Terrain<()>| {
            let scene = terrain.scene(STORE).expect("the store is there");
            matches!(scene.resident.height(root), Lookup::Found(_))
        };
        load(&mut terrain, &[key(1)]);
        assert!(is_there(&terrain));
        assert_eq!(terrain.bytes(), 2 * tile().memory_bytes() as u64);
        assert_eq!(terrain.await_tiles(STORE, &[key(2)]).len(), 1, "it is not asked for again");
        terrain.limit_bytes = 1;
        terrain.begin_job();
        assert!(in_memory(&terrain).is_empty() && is_there(&terrain));
        assert_eq!(terrain.bytes(), tile().memory_bytes() as u64);
        terrain.release(STORE);
        for number in 0..IDLE_STORES_MAX {
            let other = BlobHash([100 + number as u8; 32]);
            terrain.add_store(other, resident(), ());
            terrain.release(other);
        }
        assert_eq!(terrain.bytes(), 0);
    }

    #[test]
    fn a_tile_that_nobody_awaits_changes_nothing() {
        let mut terrain = terrain(9);
        terrain.await_tiles(STORE, &[key(0)]);
        terrain.begin_job();
        terrain.add_tile(BlobHash([10; 32]), &tile()).expect("it is dropped");
        assert!(in_memory(&terrain).is_empty());
        assert_eq!(terrain.bytes(), 0);
    }

    #[test]
    fn released_stores_stay_for_a_while_and_take_their_tiles_along_when_they_go() {
        let mut terrain = terrain(9);
        load(&mut terrain, &[key(0)]);
        terrain.release(STORE);
        assert!(terrain.has_store(STORE), "still there, and in use again");
        terrain.release(STORE);
        for number in 0..IDLE_STORES_MAX {
            let other = BlobHash([100 + number as u8; 32]);
            terrain.add_store(other, resident(), ());
            terrain.release(other);
        }
        assert!(!terrain.has_store(STORE));
        assert_eq!(terrain.bytes(), 0);
        assert!(terrain.await_tiles(STORE, &[key(0)]).is_empty());
    }
}
