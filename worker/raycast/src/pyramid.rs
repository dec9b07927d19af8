//! What the index alone tells of the heights: maxima over tiles and groups of tiles.
//!
//! Within a tile the maxima come with the tile; these begin where those end and let a
//! ray pass over ground of which not a single tile is loaded.

use crate::claims;
use crate::relief::patches::Patches;
use std::sync::Arc;
use terrafarm_terrain::layout::{Layer, LayerKind, StoreIndex};
use terrafarm_terrain::tile::MAXIMA_LEVELS;

/// What rays need to know of a store's index: maxima above the tiles, for every height
/// layer, and whether its deviations can be believed. Built once for a store; clones
/// share what was worked out of its tiles for one picture and may serve the next, at most
/// 64 MiB.
#[derive(Debug, Clone)]
pub struct Pyramid {
    /// As the layers of the index; photo layers have no levels.
    layers: Vec<LayerMaxima>,
    lowest: f64,
    highest: f64,
    /// Whether the deviations of the first height layer can be believed.
    pub(crate) deviations_hold: bool,
    patches: Arc<Patches>,
}

/// Maxima above the tiles of one layer.
#[derive(Debug, Clone, Default)]
pub(crate) struct LayerMaxima {
    /// Level 0 has a value a tile, each further one a quarter of that; the last has one.
    levels: Vec<MaximaLevel>,
}

#[derive(Debug, Clone)]
struct MaximaLevel {
    columns: usize,
    values: Box<[f32]>,
}

impl Pyramid {
    /// Reads the bounds of all tiles of level 0. The index must have passed
    /// [`StoreIndex::check`].
    pub fn new(index: &StoreIndex) -> Self {
        let layers = index.layers.iter().map(LayerMaxima::new).collect();
        let entries = index
            .layers_of(LayerKind::Height)
            .flat_map(|(_, layer)| layer.levels.first())
            .flat_map(|level| &level.entries)
            .filter(|entry| !entry.is_empty());
        let (mut lowest, mut highest) = (f64::INFINITY, f64::NEG_INFINITY);
        for entry in entries {
            lowest = lowest.min(f64::from(entry.min));
            highest = highest.max(f64::from(entry.max));
        }
        if lowest > highest {
            (lowest, highest) = (0.0, 0.0);
        }
        let first = index.layers_of(LayerKind::Height).next();
        let deviations_hold = first.is_none_or(|(_, layer)| claims::hold(layer));
        Pyramid { layers, lowest, highest, deviations_hold, patches: Arc::new(Patches::new()) }
    }

    /// Lowest height of the terrain, metres.
    pub fn lowest(&self) -> f64 {
        self.lowest
    }

    /// Highest height of the terrain, metres.
    pub fn highest(&self) -> f64 {
        self.highest
    }

    /// Plots between two levels.
    pub(crate) fn patches(&self) -> &Patches {
        &self.patches
    }

    pub(crate) fn layer(&self, layer: usize) -> &LayerMaxima {
        &self.layers[layer]
    }
}

impl LayerMaxima {
    fn new(layer: &Layer) -> Self {
        let (LayerKind::Height, Some(finest)) = (layer.kind, layer.levels.first()) else {
            return LayerMaxima::default();
        };
        let tile_max = |entry: &terrafarm_terrain::layout::TileEntry| {
            if entry.is_empty() { f32::NEG_INFINITY } else { entry.max }
        };
        let mut level = MaximaLevel {
            columns: finest.tiles[0] as usize,
            values: finest.entries.iter().map(tile_max).collect(),
        };
        let mut levels = Vec::new();
        while level.values.len() > 1 {
            let coarser = level.halved();
            levels.push(std::mem::replace(&mut level, coarser));
        }
        levels.push(level);
        LayerMaxima { levels }
    }

    /// The coarsest level, counted as the maxima of a tile are: block sides are
    /// `1 << level` cells.
    #[inline]
    pub(crate) fn top(&self) -> usize {
        MAXIMA_LEVELS + self.levels.len() - 1
    }

    /// Maximum over block (bi, bj) of a level from [`MAXIMA_LEVELS`] to [`Self::top`].
    #[inline]
    pub(crate) fn block_max(&self, level: usize, bi: usize, bj: usize) -> f32 {
        let level = &self.levels[level - MAXIMA_LEVELS];
        level.values[bj * level.columns + bi]
    }
}

impl MaximaLevel {
    fn halved(&self) -> Self {
        let rows = self.values.len() / self.columns;
        let columns = self.columns.div_ceil(2);
        let mut values = vec![f32::NEG_INFINITY; columns * rows.div_ceil(2)].into_boxed_slice();
        for (at, &value) in self.values.iter().enumerate() {
            let (column, row) = (at % self.columns, at / self.columns);
            let parent = &mut values[row / 2 * columns + column / 2];
            *parent = parent.max(value);
        }
        MaximaLevel { columns, values }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halving_keeps_every_maximum_at_odd_sizes() {
        let level = MaximaLevel { columns: 3, values: (0..9).map(|n| n as f32).collect() };
        let coarser = level.halved();
        assert_eq!(coarser.columns, 2);
        assert_eq!(&*coarser.values, &[4.0, 5.0, 7.0, 8.0]);
        assert_eq!(&*coarser.halved().values, &[8.0]);
    }
}
