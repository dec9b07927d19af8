//! Decoded tiles that a render call may use, by position in the store.
//!
//! A [`Resident`] is a plain table: the ray caster looks tiles up by index, without a
//! lock or a hash. Workers keep one per store and hand out snapshots of it: a clone shares
//! the tiles and the record of their use, so that what a render call touches in its
//! snapshot is young in the original, too.

use crate::layout::{LayerKind, StoreIndex, TileKey};
use crate::tile::{HeightTile, PhotoTile};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

/// A decoded tile of either kind.
#[derive(Clone)]
pub enum Tile {
    /// Of a height layer.
    Height(Arc<HeightTile>),
    /// Of a photo layer.
    Photo(Arc<PhotoTile>),
}

impl Tile {
    /// Heights or photo.
    pub fn kind(&self) -> LayerKind {
        match self {
            Tile::Height(_) => LayerKind::Height,
            Tile::Photo(_) => LayerKind::Photo,
        }
    }

    /// Bytes the tile takes in memory.
    pub fn memory_bytes(&self) -> usize {
        match self {
            Tile::Height(tile) => tile.memory_bytes(),
            Tile::Photo(tile) => tile.memory_bytes(),
        }
    }
}

/// What is known of one tile.
#[derive(Clone)]
enum Slot {
    /// The index says that nothing in it is valid: there is nothing to load.
    Empty,
    /// Not loaded.
    Absent,
    Loaded(Tile),
}

/// The answer to "may I use this tile".
pub enum Lookup<'a, T> {
    /// Here it is.
    Found(&'a T),
    /// It has no valid post, or lies outside the grid.
    Empty,
    /// It exists but is not loaded: the caller must ask for it.
    Absent,
}

/// The tiles of a store that are in memory.
#[derive(Clone)]
pub struct Resident {
    index: Arc<StoreIndex>,
    /// Per layer, per level, row by row from the south-west.
    slots: Vec<Vec<Vec<Slot>>>,
    /// Sum over the loaded tiles.
    bytes: usize,
    uses: Arc<Uses>,
}

/// When each tile was last used, shared by all snapshots.
struct Uses {
    /// The present, in rounds: see [`Resident::next_round`].
    round: AtomicU32,
    /// In the order of the slots.
    last: Vec<Vec<Box<[AtomicU32]>>>,
}

impl Resident {
    /// Knows the index, holds no tile yet. The index must have passed
    /// [`StoreIndex::check`].
    pub fn new(index: Arc<StoreIndex>) -> Self {
        let slots = index.layers.iter().map(|layer| {
            let levels = layer.levels.iter().map(|level| {
                let slot = |empty| if empty { Slot::Empty } else { Slot::Absent };
                level.entries.iter().map(|entry| slot(entry.is_empty())).collect()
            });
            levels.collect()
        });
        let slots = slots.collect();
        let last = index.layers.iter().map(|layer| {
            let levels = layer.levels.iter();
            levels.map(|level| level.entries.iter().map(|_| AtomicU32::new(0)).collect()).collect()
        });
        let uses = Uses { round: AtomicU32::new(0), last: last.collect() };
        Resident { index, slots, bytes: 0, uses: Arc::new(uses) }
    }

    /// The index of the store.
    pub fn index(&self) -> &Arc<StoreIndex> {
        &self.index
    }

    /// Puts a tile in its place; it counts as used now. Returns `false`, and changes
    /// nothing, if the key names no tile or one of the other kind.
    pub fn insert(&mut self, key: TileKey, tile: Tile) -> bool {
        let Some(layer) = self.index.layers.get(usize::from(key.layer)) else { return false };
        if layer.kind != tile.kind() {
            return false;
        }
        let added = tile.memory_bytes();
        let Some(slot) = self.slot_mut(key) else { return false };
        let replaced = std::mem::replace(slot, Slot::Loaded(tile)).memory_bytes();
        self.bytes = self.bytes + added - replaced;
        self.touch(key);
        true
    }

    /// Forgets a tile; it can be loaded again.
    pub fn remove(&mut self, key: TileKey) {
        if let Some(slot @ Slot::Loaded(_)) = self.slot_mut(key) {
            let freed = std::mem::replace(slot, Slot::Absent).memory_bytes();
            self.bytes -= freed;
        }
    }

    /// Memory of the loaded tiles, bytes. What snapshots still hold after a tile was
    /// evicted here is not counted.
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    /// Marks a tile as used in this round: one relaxed store, from any thread.
    #[inline]
    pub fn touch(&self, key: TileKey) {
        if let Some(at) = self.position(key) {
            let round = self.uses.round.load(Ordering::Relaxed);
            self.uses.last[usize::from(key.layer)][usize::from(key.level)][at]
                .store(round, Ordering::Relaxed);
        }
    }

    /// Begins a new round, typically with each job: tiles touched from now on are younger
    /// than those touched before.
    pub fn next_round(&self) {
        self.uses.round.fetch_add(1, Ordering::Relaxed);
    }

    /// For how many rounds a tile has not been used; 0 if it was in this one.
    pub fn age(&self, key: TileKey) -> u32 {
        let round = self.uses.round.load(Ordering::Relaxed);
        let last = self.position(key).map_or(0, |at| {
            let last = &self.uses.last[usize::from(key.layer)][usize::from(key.level)][at];
            last.load(Ordering::Relaxed)
        });
        round.wrapping_sub(last)
    }

    /// Forgets the tiles unused for most rounds until the rest takes at most so many
    /// bytes; of equal age, those first in the order of keys. Returns what went.
    pub fn evict_to(&mut self, bytes: usize) -> Vec<TileKey> {
        if self.bytes <= bytes {
            return Vec::new();
        }
        let mut loaded: Vec<(u32, TileKey)> =
            self.loaded().map(|key| (self.age(key), key)).collect();
        loaded.sort_unstable_by(|(age_a, a), (age_b, b)| age_b.cmp(age_a).then(a.cmp(b)));
        let mut evicted = Vec::new();
        for (_, key) in loaded {
            if self.bytes <= bytes {
                break;
            }
            self.remove(key);
            evicted.push(key);
        }
        evicted
    }

    /// Whether a tile is loaded.
    pub fn is_loaded(&self, key: TileKey) -> bool {
        matches!(self.slot(key), Some(Slot::Loaded(_)))
    }

    /// The loaded tiles, in the order of keys within each row.
    pub fn loaded(&self) -> impl Iterator<Item = TileKey> + '_ {
        self.slots.iter().enumerate().flat_map(move |(layer, levels)| {
            levels.iter().enumerate().flat_map(move |(level, slots)| {
                let columns = self.index.layers[layer].levels[level].tiles[0] as usize;
                let loaded =
                    slots.iter().enumerate().filter(|(_, slot)| matches!(slot, Slot::Loaded(_)));
                loaded.map(move |(at, _)| TileKey {
                    layer: layer as u16,
                    level: level as u16,
                    tx: (at % columns) as u32,
                    ty: (at / columns) as u32,
                })
            })
        })
    }

    /// A tile of a height layer.
    #[inline]
    pub fn height(&self, key: TileKey) -> Lookup<'_, HeightTile> {
        match self.slot(key) {
            Some(Slot::Loaded(Tile::Height(tile))) => Lookup::Found(tile),
            Some(Slot::Absent) => Lookup::Absent,
            _ => Lookup::Empty,
        }
    }

    /// A tile of a photo layer.
    #[inline]
    pub fn photo(&self, key: TileKey) -> Lookup<'_, PhotoTile> {
        match self.slot(key) {
            Some(Slot::Loaded(Tile::Photo(tile))) => Lookup::Found(tile),
            Some(Slot::Absent) => Lookup::Absent,
            _ => Lookup::Empty,
        }
    }

    #[inline]
    fn slot(&self, key: TileKey) -> Option<&Slot> {
        let at = self.position(key)?;
        self.slots[usize::from(key.layer)][usize::from(key.level)].get(at)
    }

    fn slot_mut(&mut self, key: TileKey) -> Option<&mut Slot> {
        let at = self.position(key)?;
        self.slots[usize::from(key.layer)][usize::from(key.level)].get_mut(at)
    }

    /// Place of a tile within its level; `None` if there is no such tile.
    #[inline]
    fn position(&self, key: TileKey) -> Option<usize> {
        let layer = self.index.layers.get(usize::from(key.layer))?;
        let tiles = layer.levels.get(usize::from(key.level))?.tiles;
        let inside = key.tx < tiles[0] && key.ty < tiles[1];
        inside.then(|| key.ty as usize * tiles[0] as usize + key.tx as usize)
    }
}

impl Slot {
    fn memory_bytes(&self) -> usize {
        match self {
            Slot::Loaded(tile) => tile.memory_bytes(),
            Slot::Empty | Slot::Absent => 0,
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::fixture::{Ground, height_layer, hills};
    use crate::store::StoreReader;

    /// All tiles of a store of 3 x 2 tiles (the last one void), one of a photo, and none
    /// of them loaded.
    fn tiles() -> (Resident, Vec<(TileKey, Tile)>) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.terrain");
        let holed = |i: u64, j: u64| if i >= 512 && j >= 256 { f32::NAN } else { hills(i, j) };
        Ground::new()
            .heights(height_layer([760, 500]), holed)
            .colors(height_layer([9, 9]), |_, _| [1, 2, 3, 255])
            .build(&path)
            .unwrap();
        let store = StoreReader::open(&path).unwrap();
        let photo = TileKey { layer: 1, level: 0, tx: 0, ty: 0 };
        let keys = (0..6).map(|at| TileKey { layer: 0, level: 0, tx: at % 3, ty: at / 3 });
        let tiles = keys
            .chain([photo])
            .filter_map(|key| store.read_tile(key).unwrap().map(|tile| (key, tile)))
            .collect();
        (Resident::new(store.index().clone()), tiles)
    }

    #[test]
    fn found_empty_and_absent_are_told_apart() {
        let (mut resident, tiles) = tiles();
        assert_eq!(tiles.len(), 6);
        let (key, tile) = tiles[1].clone();
        assert!(matches!(resident.height(key), Lookup::Absent));
        assert!(resident.insert(key, tile.clone()));
        assert!(
            matches!(resident.height(key), Lookup::Found(tile) if tile.post(0, 0) == hills(256, 0))
        );
        let void = TileKey { layer: 0, level: 0, tx: 2, ty: 1 };
        assert!(matches!(resident.height(void), Lookup::Empty));
        assert!(matches!(resident.height(TileKey { tx: 3, ..void }), Lookup::Empty));
        let photo = tiles[5].0;
        assert!(!resident.insert(photo, tile.clone()), "heights are no photo");
        assert!(!resident.insert(TileKey { level: 9, ..key }, tile), "no such level");
        assert!(matches!(resident.photo(photo), Lookup::Absent));
        assert!(resident.insert(photo, tiles[5].1.clone()));
        assert!(matches!(resident.photo(photo), Lookup::Found(_)));
    }

    #[test]
    fn bytes_follow_every_change() {
        let (mut resident, tiles) = tiles();
        for (key, tile) in &tiles {
            resident.insert(*key, tile.clone());
            resident.insert(*key, tile.clone());
        }
        let expected: usize = tiles.iter().map(|(_, tile)| tile.memory_bytes()).sum();
        assert_eq!(resident.bytes(), expected);
        assert!(resident.loaded().eq(tiles.iter().map(|(key, _)| *key)));
        for (key, _) in &tiles {
            resident.remove(*key);
            resident.remove(*key);
        }
        assert_eq!((resident.bytes(), resident.loaded().count()), (0, 0));
    }

    #[test]
    fn what_is_unused_longest_goes_first_even_if_a_snapshot_used_it() {
        let (mut resident, tiles) = tiles();
        let keys: Vec<_> = tiles.iter().take(5).map(|(key, _)| *key).collect();
        for (key, tile) in &tiles[..5] {
            resident.insert(*key, tile.clone());
            resident.next_round();
        }
        let one = tiles[0].1.memory_bytes();
        let snapshot = resident.clone();
        snapshot.touch(keys[0]);
        assert_eq!(resident.evict_to(5 * one), []);
        assert_eq!(resident.evict_to(3 * one), [keys[1], keys[2]]);
        assert!(matches!(resident.height(keys[1]), Lookup::Absent));
        assert!(matches!(snapshot.height(keys[1]), Lookup::Found(_)), "a snapshot keeps its own");
        assert_eq!(resident.evict_to(one + 1), [keys[3], keys[4]]);
        assert_eq!(resident.evict_to(0), [keys[0]]);
        assert_eq!(resident.bytes(), 0);
    }

    #[test]
    fn age_survives_the_wrap_of_the_counter() {
        let (mut resident, tiles) = tiles();
        resident.uses.round.store(u32::MAX, Ordering::Relaxed);
        resident.insert(tiles[1].0, tiles[1].1.clone());
        resident.next_round();
        resident.insert(tiles[0].0, tiles[0].1.clone());
        assert_eq!(resident.evict_to(tiles[0].1.memory_bytes()), [tiles[1].0]);
    }
}
