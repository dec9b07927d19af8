//! The tiles under N lanes, and what they say of posts and of blocks.

use crate::column::{TOLD, WHOLE};
use crate::lanes::{Floats, Ints, Lanes, MOST, Mask, prefetch};
use crate::relief::{Kept, Loaded};
use terrafarm_terrain::layout::{TILE_CELLS, TILE_POSTS, TILE_RING};
use terrafarm_terrain::tile::{Heights, MAXIMA_LEVELS, VOID};

/// The tiles under the lanes.
pub(super) struct Soils {
    posts: [*const u8; MOST],
    maxima: [*const u8; MOST],
    /// Place of the first post, from a post to the next in the north, and cells along a side
    /// less one; see [`Posts`].
    first: [i32; MOST],
    pub row: [i32; MOST],
    mask: [i32; MOST],
    /// Bytes of a post, of a row of them, and before the last two.
    size: [i32; MOST],
    row_bytes: [i32; MOST],
    last_bytes: [i32; MOST],
    /// Height over the camera of value 0, and what a unit adds.
    base: [f32; MOST],
    pub step: [f32; MOST],
    /// The same of maxima, which a patch may rise above by so much as the base has more.
    high_base: [f32; MOST],
    high_step: [f32; MOST],
    /// Bytes of a maximum.
    high_size: [i32; MOST],
    /// Level of the plot, and one over the side of its cells in those of level 0.
    pub level: [i32; MOST],
    pub shrink: [f32; MOST],
    /// Inverse depth from which on no post can be between rays.
    pub told: [f32; MOST],
    /// [`WHOLE`] for tiles without a void.
    pub whole: [i32; MOST],
    /// Lanes whose posts are heights as they are, and those whose maxima are.
    wide: u32,
    high_wide: u32,
    /// Height of the camera, in two parts.
    eye: [f32; 2],
}

impl Soils {
    pub fn new(eye_z: f64) -> Self {
        let high = eye_z as f32;
        Soils {
            posts: [std::ptr::null(); MOST],
            maxima: [std::ptr::null(); MOST],
            first: [0; MOST],
            row: [0; MOST],
            mask: [0; MOST],
            size: [0; MOST],
            row_bytes: [0; MOST],
            last_bytes: [0; MOST],
            base: [0.0; MOST],
            step: [0.0; MOST],
            high_base: [0.0; MOST],
            high_step: [0.0; MOST],
            high_size: [0; MOST],
            level: [0; MOST],
            shrink: [1.0; MOST],
            told: [0.0; MOST],
            whole: [0; MOST],
            wide: 0,
            high_wide: 0,
            eye: [high, (eye_z - f64::from(high)) as f32],
        }
    }

    /// Puts ground under a lane; `apart` is the distance between rays over that between
    /// posts of level 0, at a depth of 1 m. The lane may be looked at as long as the ground
    /// lives.
    #[inline(always)]
    pub fn set(&mut self, lane: usize, ground: &Loaded, level: u32, apart: f32) {
        let eye_z = f64::from(self.eye[0]) + f64::from(self.eye[1]);
        let tile = ground.tile;
        self.level[lane] = level as i32;
        let shrink = 1.0 / (1u32 << level) as f32;
        self.shrink[lane] = shrink;
        let holed = tile.has_voids();
        self.told[lane] = if holed { f32::INFINITY } else { apart * shrink };
        self.whole[lane] = if holed { 0 } else { WHOLE };
        let posts = ground.posts();
        (self.first[lane], self.row[lane]) = (posts.first, posts.row);
        self.mask[lane] = posts.mask;
        let (size, count) = match posts.kept {
            Kept::Codes(codes, base, step) => {
                self.wide &= !(1 << lane);
                self.posts[lane] = codes.as_ptr().cast();
                (self.base[lane], self.step[lane]) = ((base - eye_z) as f32, step as f32);
                (size_of::<u16>(), codes.len())
            }
            Kept::Floats(heights) => {
                self.wide |= 1 << lane;
                self.posts[lane] = heights.as_ptr().cast();
                (self.base[lane], self.step[lane]) = (0.0, 1.0);
                (size_of::<f32>(), heights.len())
            }
        };
        assert!((2..=POSTS).contains(&count), "a patch has no more posts than a tile");
        self.size[lane] = size as i32;
        self.row_bytes[lane] = posts.row * size as i32;
        self.last_bytes[lane] = ((count - 2) * size) as i32;
        let lift = ground.patch.as_ref().map_or(0.0, |patch| patch.lift);
        match tile.heights() {
            Heights::Codes(codes) => {
                self.high_wide &= !(1 << lane);
                self.high_size[lane] = size_of::<u16>() as i32;
                self.maxima[lane] = codes.maxima[..MAXIMA].as_ptr().cast();
                let base = (f64::from(codes.base) * codes.step - eye_z) as f32;
                (self.high_base[lane], self.high_step[lane]) = (base + lift, codes.step as f32);
            }
            Heights::Floats(floats) => {
                self.high_wide |= 1 << lane;
                self.high_size[lane] = size_of::<f32>() as i32;
                self.maxima[lane] = floats.maxima[..MAXIMA].as_ptr().cast();
                (self.high_base[lane], self.high_step[lane]) = (lift, 1.0);
            }
        }
    }

    /// What is known of ground whose inverse depth is no less: [`WHOLE`] and [`TOLD`].
    #[inline(always)]
    pub fn marks<L: Lanes>(&self, inverse: L::F) -> L::I {
        let told = L::F::load(&self.told).le(inverse);
        L::I::load(&self.whole) + L::I::select(told, L::I::splat(TOLD), L::I::splat(0))
    }

    /// What to add to the place of a post to come to the next row, forward or back.
    #[inline(always)]
    pub fn row<L: Lanes>(&self, forward: L::M) -> L::I {
        let row = L::I::load(&self.row);
        L::I::select(forward, row, L::I::splat(0) - row)
    }

    /// Place of cells among the posts of their plots.
    #[inline(always)]
    pub fn post<L: Lanes>(&self, cell: [L::I; 2]) -> L::I {
        let mask = L::I::load(&self.mask);
        let row = (cell[1] & mask).times(L::I::load(&self.row));
        row + (cell[0] & mask) + L::I::load(&self.first)
    }

    /// Height over the camera of values between posts.
    #[inline(always)]
    pub fn height<L: Lanes>(&self, value: L::F) -> L::F {
        L::F::load(&self.base) + value * L::F::load(&self.step)
    }

    /// Values of four bytes as heights over the camera in the lanes that have such, and as
    /// codes in the others.
    #[inline(always)]
    fn values<L: Lanes>(&self, bits: L::I, wide: u32) -> L::F {
        let code = (bits & L::I::splat(0xFFFF)).to_floats();
        if wide == 0 {
            return code;
        }
        let height = L::F::from_bits(bits) - L::F::splat(self.eye[0]) - L::F::splat(self.eye[1]);
        L::F::select(L::M::from_bits(wide), height, code)
    }

    /// Highest ground of blocks, over the camera.
    #[inline(always)]
    pub fn maximum<L: Lanes>(&self, at: L::I, lanes: L::M) -> L::F {
        let size = L::I::load(&self.high_size);
        let last = L::I::splat(MAXIMA as i32 - 2).times(size);
        // SAFETY: `set` has seen that there are `MAXIMA` values of that size, and `last` and
        // four bytes more are within these.
        let bits = unsafe { L::I::gather_from(&self.maxima, at.times(size), last, lanes) };
        let value = self.values::<L>(bits, self.high_wide);
        L::F::load(&self.high_base) + value * L::F::load(&self.high_step)
    }

    /// Asks for the maxima of blocks that will be looked at.
    #[inline(always)]
    pub fn expect_maximum<L: Lanes>(&self, at: L::I, lanes: L::M) {
        prefetch::<L>(&self.maxima, at.times(L::I::load(&self.high_size)), lanes);
    }

    /// Asks for posts that will be looked at.
    #[inline(always)]
    pub fn expect_post<L: Lanes>(&self, at: L::I, lanes: L::M) {
        prefetch::<L>(&self.posts, at.times(L::I::load(&self.size)), lanes);
    }

    /// Posts at and east of, and north of both, a place among them, in the lanes' units;
    /// and whether all four are there.
    #[inline(always)]
    pub fn corners<L: Lanes>(&self, at: L::I, lanes: L::M) -> (L::M, [L::F; 4]) {
        let void = L::I::splat(i32::from(VOID));
        if self.wide != 0 {
            return self.wide_corners::<L>(at, lanes);
        }
        let at = at + at;
        let last = L::I::load(&self.last_bytes);
        let north = at + L::I::load(&self.row_bytes);
        // SAFETY: `set` has taken the length of the posts, and `last` and four bytes more are
        // within it.
        let (south, north) = unsafe {
            let south = L::I::gather_from(&self.posts, at, last, lanes);
            (south, L::I::gather_from(&self.posts, north, last, lanes))
        };
        let (low, sixteen) = (L::I::splat(0xFFFF), L::I::splat(16));
        let (sw, se) = (south & low, south.shr(sixteen) & low);
        let (nw, ne) = (north & low, north.shr(sixteen) & low);
        let highest = sw.max(se).max(nw.max(ne));
        let values = [sw.to_floats(), se.to_floats(), nw.to_floats(), ne.to_floats()];
        (highest.lt(void), values)
    }

    /// The same if some lanes have heights as they are.
    #[inline(always)]
    fn wide_corners<L: Lanes>(&self, at: L::I, lanes: L::M) -> (L::M, [L::F; 4]) {
        let size = L::I::load(&self.size);
        let last = L::I::load(&self.last_bytes);
        let south = at.times(size);
        let north = south + L::I::load(&self.row_bytes);
        // Closures of `map` are compiled without the kernel's features.
        let mut values = [L::F::splat(0.0); 4];
        for (value, at) in values.iter_mut().zip([south, south + size, north, north + size]) {
            // SAFETY: as above.
            let bits = unsafe { L::I::gather_from(&self.posts, at, last, lanes) };
            *value = self.values::<L>(bits, self.wide);
        }
        let [sw, se, nw, ne] = values;
        // A void is the highest code, or NaN, which no comparison finds to be below.
        let void = L::F::splat(f32::from(VOID));
        let wide = L::M::from_bits(self.wide);
        let ceiling = L::F::select(wide, L::F::splat(f32::INFINITY), void);
        let solid = sw.lt(ceiling) & se.lt(ceiling) & nw.lt(ceiling) & ne.lt(ceiling);
        (solid, values)
    }
}

/// Values of a table of posts, and of one of maxima, the last being a pad.
const POSTS: usize = TILE_POSTS * TILE_POSTS + 1;
const MAXIMA: usize = (TILE_CELLS * TILE_CELLS - 1) / 3 + 1;

/// Place of cells among the posts of their tile.
#[inline(always)]
pub(crate) fn post<L: Lanes>(cell: [L::I; 2]) -> L::I {
    let mask = L::I::splat(TILE_CELLS as i32 - 1);
    let ring = L::I::splat(TILE_RING as i32);
    let row = (cell[1] & mask) + ring;
    row.times(L::I::splat(TILE_POSTS as i32)) + (cell[0] & mask) + ring
}

/// Place of blocks of `1 << level` cells among the maxima of their tile; level from 1.
#[inline(always)]
pub(crate) fn maximum<L: Lanes>(block: [L::I; 2], level: L::I) -> L::I {
    // A tile has `1 << bits` blocks along a side. The levels of maxima lie one after
    // another, so those of this one begin behind (4^8 - 4^(bits + 1)) / 3 others; the
    // product is that third to the last unit.
    let (one, bits) = (L::I::splat(1), L::I::splat(MAXIMA_LEVELS as i32) - level);
    let mask = one.shl(bits) - one;
    let before = L::I::splat(1 << (2 * MAXIMA_LEVELS)) - one.shl(bits + bits + one + one);
    let start = before.times(L::I::splat(0x5556)).shr(L::I::splat(16));
    start + (block[1] & mask).shl(bits) + (block[0] & mask)
}
