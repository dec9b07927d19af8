//! One tile: as bytes in a store, and decoded for use.

use crate::layout::{TILE_CELLS, TILE_POSTS, TILE_RING};

/// Heights of one tile with the maxima that let a ray skip ground it cannot touch.
///
/// Posts are addressed relative to the tile's south-west post, −1 ..= 257 along each
/// axis (see [`TILE_RING`]). A void post is NaN.
pub struct HeightTile {
    posts: Box<[f32]>,
    /// Maxima over blocks of 2, 4, ... 256 cells a side, finest first, row-major: over
    /// the corners of the valid cells in the block; −infinity where none is valid.
    maxima: [Box<[f32]>; MAXIMA_LEVELS],
    has_voids: bool,
}

/// Number of levels of maxima within a tile: blocks of 2^1 ..= 2^8 cells.
pub const MAXIMA_LEVELS: usize = TILE_CELLS.ilog2() as usize;

/// Bytes of a [`HeightTile`] in memory: posts, and a third of them for the maxima.
pub const HEIGHT_TILE_BYTES: usize = size_of::<HeightTile>()
    + size_of::<f32>() * (TILE_POSTS * TILE_POSTS + (TILE_CELLS * TILE_CELLS - 1) / 3);
/// Bytes of a [`PhotoTile`] in memory.
pub const PHOTO_TILE_BYTES: usize =
    size_of::<PhotoTile>() + size_of::<[u16; 4]>() * TILE_POSTS * TILE_POSTS;

impl HeightTile {
    /// A tile from its posts, row by row from the south-west, ring included.
    /// `None` if their number is not [`TILE_POSTS`] squared.
    pub fn new(posts: Box<[f32]>) -> Option<Self> {
        if posts.len() != TILE_POSTS * TILE_POSTS {
            return None;
        }
        let has_voids = posts.iter().any(|height| height.is_nan());
        let mut tile = HeightTile { posts, maxima: Default::default(), has_voids };
        tile.build_maxima();
        Some(tile)
    }

    /// Height of a post, metres; NaN for a void. `i` and `j` from −1 to 257.
    #[inline]
    pub fn post(&self, i: isize, j: isize) -> f32 {
        let column = (i + TILE_RING as isize) as usize;
        let row = (j + TILE_RING as isize) as usize;
        self.posts[row * TILE_POSTS + column]
    }

    /// The corners of a cell: south-west, south-east, north-west, north-east.
    /// `i` and `j` from 0 to 255.
    #[inline]
    pub fn corners(&self, i: usize, j: usize) -> [f32; 4] {
        let at = (j + TILE_RING) * TILE_POSTS + i + TILE_RING;
        let posts = &self.posts[at..at + TILE_POSTS + 2];
        [posts[0], posts[1], posts[TILE_POSTS], posts[TILE_POSTS + 1]]
    }

    /// Highest corner of the valid cells in a block of `1 << level` cells a side, level 1
    /// to 8; block (0, 0) is the south-west one. −infinity where no cell is valid.
    #[inline]
    pub fn block_max(&self, level: usize, bi: usize, bj: usize) -> f32 {
        self.maxima[level - 1][bj * (TILE_CELLS >> level) + bi]
    }

    /// Whether any post of the tile, ring included, is void.
    pub fn has_voids(&self) -> bool {
        self.has_voids
    }

    /// All posts, row by row from the south-west, ring included.
    pub fn posts(&self) -> &[f32] {
        &self.posts
    }

    /// Bytes this tile takes in memory.
    pub fn memory_bytes(&self) -> usize {
        let floats = self.posts.len() + self.maxima.iter().map(|level| level.len()).sum::<usize>();
        floats * size_of::<f32>() + size_of::<Self>()
    }

    fn build_maxima(&mut self) {
        self.maxima[0] =
            if self.has_voids { self.finest_maxima_with_voids() } else { self.finest_maxima() };
        for level in 1..MAXIMA_LEVELS {
            let side = TILE_CELLS >> (level + 1);
            let finer = &self.maxima[level - 1];
            let mut blocks = Vec::with_capacity(side * side);
            for rows in finer.chunks_exact(4 * side) {
                let (south, north) = rows.split_at(2 * side);
                let pairs = south.chunks_exact(2).zip(north.chunks_exact(2));
                blocks
                    .extend(pairs.map(|(s, n)| greater(greater(s[0], s[1]), greater(n[0], n[1]))));
            }
            self.maxima[level] = blocks.into_boxed_slice();
        }
    }

    /// Maxima over 2 x 2 cells: of the nine posts, where all are valid.
    fn finest_maxima(&self) -> Box<[f32]> {
        let side = TILE_CELLS / 2;
        let mut blocks = Vec::with_capacity(side * side);
        for bj in 0..side {
            let row = |j: usize| {
                let start = (2 * bj + j + TILE_RING) * TILE_POSTS + TILE_RING;
                &self.posts[start..start + TILE_CELLS + 1]
            };
            let (a, b, c) = (row(0), row(1), row(2));
            let highest = |i: usize| greater(greater(a[i], b[i]), c[i]);
            blocks.extend((0..side).map(|bi| {
                greater(greater(highest(2 * bi), highest(2 * bi + 1)), highest(2 * bi + 2))
            }));
        }
        blocks.into_boxed_slice()
    }

    /// The same with void posts: only the corners of valid cells count.
    fn finest_maxima_with_voids(&self) -> Box<[f32]> {
        let cell_max = |i: usize, j: usize| {
            let corners = self.corners(i, j);
            if corners.iter().any(|height| height.is_nan()) {
                f32::NEG_INFINITY
            } else {
                corners.into_iter().fold(f32::NEG_INFINITY, greater)
            }
        };
        let side = TILE_CELLS / 2;
        let blocks = (0..side * side).map(|at| {
            let (i, j) = (2 * (at % side), 2 * (at / side));
            let cells =
                [cell_max(i, j), cell_max(i + 1, j), cell_max(i, j + 1), cell_max(i + 1, j + 1)];
            cells.into_iter().fold(f32::NEG_INFINITY, greater)
        });
        blocks.collect()
    }
}

/// The greater of two numbers, neither of them NaN: one instruction, unlike `f32::max`.
#[inline]
fn greater(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// Colours of one tile of a photo, ready to be filtered: linear light, premultiplied by
/// coverage, 65535 = 1.
pub struct PhotoTile {
    texels: Box<[[u16; 4]]>,
}

impl PhotoTile {
    /// A tile from its texels (linear red, green, blue, coverage; premultiplied), row by
    /// row from the south-west, ring included. `None` if their number is wrong.
    pub fn new(texels: Box<[[u16; 4]]>) -> Option<Self> {
        (texels.len() == TILE_POSTS * TILE_POSTS).then_some(PhotoTile { texels })
    }

    /// One texel. `i` and `j` from −1 to 257.
    #[inline]
    pub fn texel(&self, i: isize, j: isize) -> [u16; 4] {
        let column = (i + TILE_RING as isize) as usize;
        let row = (j + TILE_RING as isize) as usize;
        self.texels[row * TILE_POSTS + column]
    }

    /// Bytes this tile takes in memory.
    pub fn memory_bytes(&self) -> usize {
        self.texels.len() * size_of::<[u16; 4]>() + size_of::<Self>()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn tile(rule: impl Fn(isize, isize) -> f32) -> HeightTile {
        let side = TILE_POSTS as isize;
        let posts = (0..side * side).map(|at| rule(at % side - 1, at / side - 1)).collect();
        HeightTile::new(posts).unwrap()
    }

    #[test]
    fn posts_are_addressed_from_the_south_west_with_a_ring() {
        let tile = tile(|i, j| (1000 * j + i) as f32);
        assert_eq!(tile.post(-1, -1), -1001.0);
        assert_eq!(tile.post(257, 257), 257_257.0);
        assert_eq!(tile.corners(255, 0), [255.0, 256.0, 1255.0, 1256.0]);
        assert_eq!(tile.memory_bytes(), HEIGHT_TILE_BYTES);
        let photo = PhotoTile::new(vec![[0; 4]; TILE_POSTS * TILE_POSTS].into()).unwrap();
        assert_eq!(photo.memory_bytes(), PHOTO_TILE_BYTES);
    }

    #[test]
    fn maxima_bound_valid_cells_and_no_others() {
        let rough = |i: isize, j: isize| ((i * 7919 + j * 104_729) % 1009) as f32 - 300.0;
        let holed = |i: isize, j: isize| if (i * j) % 97 == 5 { f32::NAN } else { rough(i, j) };
        assert!(!tile(rough).has_voids() && tile(holed).has_voids());
        check_maxima(&tile(rough));
        check_maxima(&tile(holed));
        check_maxima(&tile(|_, _| f32::NAN));
    }

    #[track_caller]
    fn check_maxima(tile: &HeightTile) {
        for level in 1..=MAXIMA_LEVELS {
            let side = 1 << level;
            for bj in 0..TILE_CELLS / side {
                for bi in 0..TILE_CELLS / side {
                    let cells = (bj * side..(bj + 1) * side)
                        .flat_map(|j| (bi * side..(bi + 1) * side).map(move |i| (i, j)));
                    let expected = cells
                        .map(|(i, j)| tile.corners(i, j))
                        .filter(|corners| corners.iter().all(|height| !height.is_nan()))
                        .flatten()
                        .fold(f32::NEG_INFINITY, f32::max);
                    assert_eq!(tile.block_max(level, bi, bj), expected);
                }
            }
        }
    }

    #[test]
    fn a_wrong_number_of_posts_is_no_tile() {
        assert!(HeightTile::new(vec![0.0; 10].into()).is_none());
        assert!(PhotoTile::new(vec![[0; 4]; 10].into()).is_none());
    }
}
