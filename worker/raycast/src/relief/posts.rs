//! Where kernels read the posts of a plot.

use super::patch::Patch;
use crate::lanes::{Floats, Ints, Lanes, as_bits};
use std::sync::Arc;
use terrafarm_terrain::layout::{TILE_CELLS, TILE_POSTS, TILE_RING};
use terrafarm_terrain::tile::{HeightTile, Heights, VOID};

/// Ground that is loaded: its tile, and posts of its own if it is between two levels.
#[derive(Clone)]
pub(crate) struct Loaded<'a> {
    pub tile: &'a HeightTile,
    pub patch: Option<Arc<Patch>>,
}

/// Posts in rows from the south-west, and their heights.
#[derive(Clone, Copy)]
pub(crate) struct Posts<'p> {
    pub kept: Kept<'p>,
    /// Place of the first.
    pub first: i32,
    /// From a post to the next one in the north.
    pub row: i32,
    /// Cells along a side, a power of two, less one.
    pub mask: i32,
}

/// Arrays of posts, with a pad at the end.
#[derive(Clone, Copy)]
pub(crate) enum Kept<'p> {
    /// Codes, the height of code 0, and what a code adds, metres.
    Codes(&'p [u16], f64, f64),
    /// Heights, metres.
    Floats(&'p [f32]),
}

impl Loaded<'_> {
    /// What is to be read of the posts.
    #[inline(always)]
    pub(crate) fn posts(&self) -> Posts<'_> {
        if let Some(patch) = &self.patch {
            let row = patch.side as i32;
            let kept = Kept::Codes(&patch.codes, patch.base, patch.step);
            return Posts { kept, first: 0, row, mask: row - 2 };
        }
        let kept = match self.tile.heights() {
            Heights::Codes(codes) => {
                Kept::Codes(codes.posts, f64::from(codes.base) * codes.step, codes.step)
            }
            Heights::Floats(floats) => Kept::Floats(floats.posts),
        };
        let row = TILE_POSTS as i32;
        let first = TILE_RING as i32 * (row + 1);
        Posts { kept, first, row, mask: TILE_CELLS as i32 - 1 }
    }
}

impl Posts<'_> {
    /// Whether cells have ground, and the heights of their corners over the camera:
    /// south-west, south-east, north-west, north-east.
    #[inline(always)]
    pub(crate) fn corners<L: Lanes>(
        &self,
        eye_z: f64,
        cell: [L::I; 2],
        lanes: L::M,
    ) -> (L::M, [L::F; 4]) {
        let (mask, row) = (L::I::splat(self.mask), L::I::splat(self.row));
        let at = (cell[1] & mask).times(row) + (cell[0] & mask) + L::I::splat(self.first);
        let north = at + row;
        match self.kept {
            Kept::Codes(posts, base, step) => {
                let base = L::F::splat((base - eye_z) as f32);
                let step = L::F::splat(step as f32);
                let (low, sixteen) = (L::I::splat(0xFFFF), L::I::splat(16));
                let south = L::I::gather_pairs(posts, at, lanes);
                let north = L::I::gather_pairs(posts, north, lanes);
                let (sw, se) = (south & low, south.shr(sixteen) & low);
                let (nw, ne) = (north & low, north.shr(sixteen) & low);
                let there = sw.max(se).max(nw.max(ne)).lt(L::I::splat(i32::from(VOID)));
                let heights = [
                    base + sw.to_floats() * step,
                    base + se.to_floats() * step,
                    base + nw.to_floats() * step,
                    base + ne.to_floats() * step,
                ];
                (there, heights)
            }
            Kept::Floats(posts) => {
                let posts = as_bits(posts);
                let high = eye_z as f32;
                let eye = [L::F::splat(high), L::F::splat((eye_z - f64::from(high)) as f32)];
                let one = L::I::splat(1);
                let [sw, se, nw, ne] = [
                    L::I::gather(posts, at, lanes),
                    L::I::gather(posts, at + one, lanes),
                    L::I::gather(posts, north, lanes),
                    L::I::gather(posts, north + one, lanes),
                ];
                let heights = [
                    L::F::from_bits(sw) - eye[0] - eye[1],
                    L::F::from_bits(se) - eye[0] - eye[1],
                    L::F::from_bits(nw) - eye[0] - eye[1],
                    L::F::from_bits(ne) - eye[0] - eye[1],
                ];
                // A void is NaN, and so is any sum with it.
                let sum = heights[0] + heights[1] + heights[2] + heights[3];
                (sum.eq(sum), heights)
            }
        }
    }
}
