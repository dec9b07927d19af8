//! Whether an index can be believed when it says how far its coarser levels are from level 0.
//!
//! The fast methods rely on these deviations, and an index holds nothing that proves them.
//! But it holds what disproves them: the surface of a tile cannot rise above that of its
//! coarser one by more than the deviation, nor sink below it. An index without deviations,
//! in which all are 0, or one whose coarser levels have lost ground, is found out so. One
//! in which all are infinite is sound: everything is seen at level 0.

use terrafarm_terrain::layout::{Layer, Level, TileEntry};

/// Rounding that is no contradiction: metres, and a share of the height.
const ROUNDING_M: f64 = 1e-3;
const ROUNDING: f64 = 1e-6;

/// Lowest and highest height; the first is above the second where nothing is.
type Extent = [f32; 2];

/// Whether the deviations of a layer of heights can be believed. Single posts beside voids
/// belong to a tile's extent and not to its surface, so a few contradictions are borne: as
/// long as they are fewer than the tiles that do not contradict.
pub(crate) fn hold(layer: &Layer) -> bool {
    let Some(finest) = layer.levels.first() else { return true };
    let mut below: Vec<Extent> = finest.entries.iter().map(extent).collect();
    let mut columns = finest.tiles[0];
    let (mut sound, mut contradicting) = (0u64, 0u64);
    for level in &layer.levels[1..] {
        below = halved(&below, columns, level);
        columns = level.tiles[0];
        for (entry, ground) in level.entries.iter().zip(&below) {
            if ground[0] > ground[1] || entry.deviation == f32::INFINITY {
                continue;
            }
            if contradicts(entry, *ground) {
                contradicting += 1;
            } else {
                sound += 1;
            }
        }
    }
    contradicting <= sound
}

fn extent(entry: &TileEntry) -> Extent {
    if entry.is_empty() { [f32::INFINITY, f32::NEG_INFINITY] } else { [entry.min, entry.max] }
}

/// Extents of the ground of level 0 under the tiles of a level, from those under the finer.
fn halved(fine: &[Extent], columns: u32, level: &Level) -> Vec<Extent> {
    let mut coarse = vec![[f32::INFINITY, f32::NEG_INFINITY]; level.entries.len()];
    for (row, extents) in fine.chunks(columns.max(1) as usize).enumerate() {
        for (column, extent) in extents.iter().enumerate() {
            if let Some(parent) = coarse.get_mut(row / 2 * level.tiles[0] as usize + column / 2) {
                *parent = [parent[0].min(extent[0]), parent[1].max(extent[1])];
            }
        }
    }
    coarse
}

/// Whether ground of level 0 reaches further than a coarse tile allows.
fn contradicts(entry: &TileEntry, [low, high]: Extent) -> bool {
    let slack =
        |height: f32| f64::from(entry.deviation) + ROUNDING_M + ROUNDING * f64::from(height).abs();
    // Also of an empty tile: its highest is below everything.
    f64::from(high) - f64::from(entry.max) > slack(high)
        || f64::from(entry.min) - f64::from(low) > slack(low)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests_support::{Plan, mountains, resident};

    fn layer() -> Layer {
        let height = |i, j| mountains(i, j, 64, 300.0, 3);
        let plan = Plan::heights([0.0; 2], [10.0; 2], [1100, 700], height);
        resident(vec![plan]).index().layers[0].clone()
    }

    fn with(change: impl Fn(&mut TileEntry)) -> bool {
        let mut layer = layer();
        layer.levels[1..].iter_mut().flat_map(|level| &mut level.entries).for_each(change);
        hold(&layer)
    }

    #[test]
    fn what_a_builder_says_is_believed_and_so_is_the_infinite() {
        assert!(with(|_| ()));
        assert!(with(|entry| entry.deviation = f32::INFINITY));
    }

    #[test]
    fn deviations_that_are_left_out_and_ground_that_is_lost_are_found_out() {
        assert!(!with(|entry| entry.deviation = 0.0));
        assert!(!with(|entry| entry.deviation *= 0.01));
        assert!(!with(|entry| *entry = TileEntry::EMPTY));
    }

    #[test]
    fn a_plane_and_a_single_level_contradict_nothing() {
        for posts in [[600, 600], [40, 40]] {
            let plan = Plan::heights([0.0; 2], [10.0; 2], posts, |i, j| (i + 2 * j) as f32);
            assert!(hold(&resident(vec![plan]).index().layers[0]), "{posts:?}");
        }
    }
}
