//! Which vectors find all that they read in one small square of one tile.
//!
//! Neighbouring pixels mostly read posts that are close together. Where the lanes can pick from
//! vectors, eight whole loads then have what all of them need, and that is known one step
//! before it is read: a guess of the processor that fails costs little there.

use super::level::first;
use crate::lanes::{Ints, Lanes, Mask};
use terrafarm_terrain::layout::TILE_POSTS;

/// The last place of a square of eight by eight in a tile.
const LAST: i32 = ((TILE_POSTS - 8) << 16 | (TILE_POSTS - 8)) as i32;

/// Where a vector reads.
#[derive(Clone, Copy)]
pub(super) struct Square {
    /// The corner of the square in the tile, column, and from bit 16 on the row; if there is
    /// one that has all.
    pub corner: Option<i32>,
    /// Level and number of the tile.
    pub tile: [i32; 2],
}

impl Square {
    pub(super) const NONE: Square = Square { corner: None, tile: [0; 2] };

    /// The square of the lanes in a mask, one at least, whose tiles have these levels and
    /// numbers, and that read from `low` to `high` in it (columns, and from bit 16 on rows).
    #[inline(always)]
    pub(super) fn of<L: Lanes>(
        [levels, numbers]: [L::I; 2],
        [low, high]: [L::I; 2],
        lanes: L::M,
    ) -> Square {
        let (level, number) = (first::<L>(levels, lanes), first::<L>(numbers, lanes));
        let one = levels.eq(L::I::splat(level)) & numbers.eq(L::I::splat(number));
        let (corner, fits) = L::I::corner(low, high, LAST, lanes);
        let is_whole = fits & !(lanes & !one).any();
        Square { corner: is_whole.then_some(corner), tile: [level, number] }
    }

    /// A tile that lanes in a mask, of which there is one at least, read; and those that do.
    /// Levels and numbers of the tiles are given.
    #[inline(always)]
    pub(super) fn next<L: Lanes>(
        &self,
        [levels, numbers]: [L::I; 2],
        left: L::M,
    ) -> ([i32; 2], L::M) {
        if self.corner.is_some() {
            return (self.tile, left);
        }
        let tile = [first::<L>(levels, left), first::<L>(numbers, left)];
        let here = left & levels.eq(L::I::splat(tile[0])) & numbers.eq(L::I::splat(tile[1]));
        (tile, here)
    }
}

/// The number of a corner's element.
#[inline(always)]
pub(super) fn first_of(corner: i32) -> usize {
    (corner >> 16) as usize * TILE_POSTS + (corner & 0xFFFF) as usize
}
