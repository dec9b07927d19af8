//! Maxima over blocks of cells: what lets a ray pass over ground that it cannot touch.
//!
//! Codes and floats sort alike, so one piece of code serves both.

use crate::layout::{TILE_CELLS, TILE_POSTS, TILE_RING};

/// Number of levels of maxima within a tile: blocks of 2^1 ..= 2^8 cells.
pub const MAXIMA_LEVELS: usize = TILE_CELLS.ilog2() as usize;

/// Where the maxima of a level (1 ..= [`MAXIMA_LEVELS`]) begin in the maxima of a tile;
/// index 0 is unused. A level is row-major from the south-west, `256 >> level` a side.
pub const MAXIMA_START: [usize; MAXIMA_LEVELS + 1] = {
    let mut starts = [0; MAXIMA_LEVELS + 1];
    let mut level = 1;
    while level < MAXIMA_LEVELS {
        let side = TILE_CELLS >> level;
        starts[level + 1] = starts[level] + side * side;
        level += 1;
    }
    starts
};

/// Maxima of a tile, all levels together.
pub(super) const MAXIMA_COUNT: usize = MAXIMA_START[MAXIMA_LEVELS] + 1;

/// A height in whatever form it is kept.
pub(super) trait Sample: Copy + PartialOrd {
    /// Below every valid height: the maximum over nothing, and the pad.
    const NOTHING: Self;

    fn is_void(self) -> bool;
}

/// All maxima of a tile, and the pad. Over the corners of valid cells alone.
pub(super) fn maxima_of<S: Sample>(posts: &[S], has_voids: bool) -> Box<[S]> {
    let mut maxima = Vec::with_capacity(MAXIMA_COUNT + 1);
    if has_voids {
        finest_with_voids(posts, &mut maxima)
    } else {
        finest(posts, &mut maxima)
    }
    for level in 2..=MAXIMA_LEVELS {
        let finer_side = TILE_CELLS >> (level - 1);
        let start = MAXIMA_START[level - 1];
        for bj in 0..finer_side / 2 {
            for bi in 0..finer_side / 2 {
                let at = start + 2 * bj * finer_side + 2 * bi;
                let south = greater(maxima[at], maxima[at + 1]);
                let north = greater(maxima[at + finer_side], maxima[at + finer_side + 1]);
                maxima.push(greater(south, north));
            }
        }
    }
    maxima.push(S::NOTHING);
    maxima.into_boxed_slice()
}

/// Maxima over 2 x 2 cells: of the nine posts, where all are valid.
fn finest<S: Sample>(posts: &[S], maxima: &mut Vec<S>) {
    let side = TILE_CELLS / 2;
    for bj in 0..side {
        let row = |j: usize| {
            let start = (2 * bj + j + TILE_RING) * TILE_POSTS + TILE_RING;
            &posts[start..start + TILE_CELLS + 1]
        };
        let (a, b, c) = (row(0), row(1), row(2));
        let highest = |i: usize| greater(greater(a[i], b[i]), c[i]);
        maxima.extend(
            (0..side).map(|bi| {
                greater(greater(highest(2 * bi), highest(2 * bi + 1)), highest(2 * bi + 2))
            }),
        );
    }
}

/// The same with void posts: only the corners of valid cells count.
fn finest_with_voids<S: Sample>(posts: &[S], maxima: &mut Vec<S>) {
    let cell_max = |i: usize, j: usize| {
        let at = (j + TILE_RING) * TILE_POSTS + i + TILE_RING;
        let corners =
            [posts[at], posts[at + 1], posts[at + TILE_POSTS], posts[at + TILE_POSTS + 1]];
        if corners.iter().any(|post| post.is_void()) {
            S::NOTHING
        } else {
            corners.into_iter().fold(S::NOTHING, greater)
        }
    };
    let side = TILE_CELLS / 2;
    maxima.extend((0..side * side).map(|at| {
        let (i, j) = (2 * (at % side), 2 * (at / side));
        let cells =
            [cell_max(i, j), cell_max(i + 1, j), cell_max(i, j + 1), cell_max(i + 1, j + 1)];
        cells.into_iter().fold(S::NOTHING, greater)
    }));
}

/// The greater of two heights, neither of them void: one instruction, unlike `f32::max`.
#[inline]
fn greater<S: Sample>(a: S, b: S) -> S {
    if a > b { a } else { b }
}
