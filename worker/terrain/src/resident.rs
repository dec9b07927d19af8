//! Decoded tiles that a render call may use, by position in the store.
//!
//! A [`Resident`] is a plain table: the ray caster looks tiles up by index, without a
//! lock or a hash. Workers keep one per store and hand out snapshots of it.

use crate::layout::{LayerKind, StoreIndex, TileKey};
use crate::tile::{HeightTile, PhotoTile};
use std::sync::Arc;

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
        Resident { index, slots }
    }

    /// The index of the store.
    pub fn index(&self) -> &Arc<StoreIndex> {
        &self.index
    }

    /// Puts a tile in its place. Returns `false`, and changes nothing, if the key names
    /// no tile or one of the other kind.
    pub fn insert(&mut self, key: TileKey, tile: Tile) -> bool {
        let Some(layer) = self.index.layers.get(usize::from(key.layer)) else { return false };
        let fits = matches!(
            (layer.kind, &tile),
            (LayerKind::Height, Tile::Height(_)) | (LayerKind::Photo, Tile::Photo(_))
        );
        match self.slot_mut(key) {
            Some(slot) if fits => {
                *slot = Slot::Loaded(tile);
                true
            }
            _ => false,
        }
    }

    /// Forgets a tile; it can be loaded again.
    pub fn remove(&mut self, key: TileKey) {
        if let Some(slot @ Slot::Loaded(_)) = self.slot_mut(key) {
            *slot = Slot::Absent;
        }
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
        let tiles = self
            .index
            .layers
            .get(usize::from(key.layer))?
            .levels
            .get(usize::from(key.level))?
            .tiles;
        if key.tx >= tiles[0] || key.ty >= tiles[1] {
            return None;
        }
        self.slots[usize::from(key.layer)][usize::from(key.level)]
            .get(key.ty as usize * tiles[0] as usize + key.tx as usize)
    }

    fn slot_mut(&mut self, key: TileKey) -> Option<&mut Slot> {
        let tiles = self
            .index
            .layers
            .get(usize::from(key.layer))?
            .levels
            .get(usize::from(key.level))?
            .tiles;
        if key.tx >= tiles[0] || key.ty >= tiles[1] {
            return None;
        }
        self.slots[usize::from(key.layer)][usize::from(key.level)]
            .get_mut(key.ty as usize * tiles[0] as usize + key.tx as usize)
    }
}
