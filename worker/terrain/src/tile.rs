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
        let cell_max = |tile: &Self, i: usize, j: usize| {
            let corners = tile.corners(i, j);
            if corners.iter().any(|height| height.is_nan()) {
                f32::NEG_INFINITY
            } else {
                corners.into_iter().fold(f32::NEG_INFINITY, f32::max)
            }
        };
        for level in 1..=MAXIMA_LEVELS {
            let side = TILE_CELLS >> level;
            let mut blocks = Vec::with_capacity(side * side);
            for bj in 0..side {
                for bi in 0..side {
                    let children = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(di, dj)| {
                        let (i, j) = (2 * bi + di, 2 * bj + dj);
                        if level == 1 {
                            cell_max(self, i, j)
                        } else {
                            self.block_max(level - 1, i, j)
                        }
                    });
                    blocks.push(children.into_iter().fold(f32::NEG_INFINITY, f32::max));
                }
            }
            self.maxima[level - 1] = blocks.into_boxed_slice();
        }
    }
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
