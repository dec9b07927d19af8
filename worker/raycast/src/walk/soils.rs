//! The tiles under N lanes, and what they say of posts and of blocks.

use crate::column::{TOLD, WHOLE};
use crate::lanes::{Floats, Ints, Lanes, MOST, Mask};
use terrafarm_terrain::layout::{TILE_CELLS, TILE_POSTS, TILE_RING};
use terrafarm_terrain::tile::{HeightTile, Heights, MAXIMA_LEVELS, VOID};

/// The tiles under the lanes.
pub(super) struct Soils {
    posts: [*const u8; MOST],
    maxima: [*const u8; MOST],
    /// Bytes of a value.
    size: [i32; MOST],
    /// Height over the camera of value 0, and what a unit adds.
    base: [f32; MOST],
    pub step: [f32; MOST],
    /// Level of the plot, and one over the side of its cells in those of level 0.
    pub level: [i32; MOST],
    pub shrink: [f32; MOST],
    /// Inverse depth from which on no post can be between rays.
    pub told: [f32; MOST],
    /// [`WHOLE`] for tiles without a void.
    pub whole: [i32; MOST],
    /// Lanes whose values are heights as they are.
    wide: u32,
    /// Height of the camera, in two parts.
    eye: [f32; 2],
}

impl Soils {
    pub fn new(eye_z: f64) -> Self {
        let high = eye_z as f32;
        Soils {
            posts: [std::ptr::null(); MOST],
            maxima: [std::ptr::null(); MOST],
            size: [0; MOST],
            base: [0.0; MOST],
            step: [0.0; MOST],
            level: [0; MOST],
            shrink: [1.0; MOST],
            told: [0.0; MOST],
            whole: [0; MOST],
            wide: 0,
            eye: [high, (eye_z - f64::from(high)) as f32],
        }
    }

    /// Puts a tile under a lane; `apart` is the distance between rays over that between
    /// posts of level 0, at a depth of 1 m. The lane may be looked at as long as the tile lives.
    #[inline(always)]
    pub fn set(&mut self, lane: usize, tile: &HeightTile, level: u32, apart: f32) {
        self.level[lane] = level as i32;
        let shrink = 1.0 / (1u32 << level) as f32;
        self.shrink[lane] = shrink;
        let holed = tile.has_voids();
        self.told[lane] = if holed { f32::INFINITY } else { apart * shrink };
        self.whole[lane] = if holed { 0 } else { WHOLE };
        match tile.heights() {
            Heights::Codes(codes) => {
                let eye_z = f64::from(self.eye[0]) + f64::from(self.eye[1]);
                self.wide &= !(1 << lane);
                self.size[lane] = size_of::<u16>() as i32;
                self.posts[lane] = codes.posts[..POSTS].as_ptr().cast();
                self.maxima[lane] = codes.maxima[..MAXIMA].as_ptr().cast();
                self.base[lane] = (f64::from(codes.base) * codes.step - eye_z) as f32;
                self.step[lane] = codes.step as f32;
            }
            Heights::Floats(floats) => {
                self.wide |= 1 << lane;
                self.size[lane] = size_of::<f32>() as i32;
                self.posts[lane] = floats.posts[..POSTS].as_ptr().cast();
                self.maxima[lane] = floats.maxima[..MAXIMA].as_ptr().cast();
                (self.base[lane], self.step[lane]) = (0.0, 1.0);
            }
        }
    }

    /// Inverse depths with their last bits set to [`WHOLE`] and [`TOLD`].
    #[inline(always)]
    pub fn marked<L: Lanes>(&self, answer: L::F) -> L::F {
        let told = L::F::load(&self.told).le(answer);
        let told = L::I::select(told, L::I::splat(TOLD), L::I::splat(0));
        let bits = answer.to_bits() & L::I::splat(!(WHOLE | TOLD));
        L::F::from_bits(bits + L::I::load(&self.whole) + told)
    }

    /// Height over the camera of values between posts.
    #[inline(always)]
    pub fn height<L: Lanes>(&self, value: L::F) -> L::F {
        L::F::load(&self.base) + value * L::F::load(&self.step)
    }

    /// The values at places of a table of so many, in the lanes' units.
    #[inline(always)]
    fn read<L: Lanes>(
        &self,
        bases: &[*const u8; MOST],
        count: usize,
        at: L::I,
        lanes: L::M,
    ) -> L::F {
        let size = L::I::load(&self.size);
        let last = L::I::splat(count as i32 - 2).times(size);
        // SAFETY: `set` has seen that the tables have `count` values, and `last` and four
        // bytes more are within these.
        let bits = unsafe { L::I::gather_from(bases, at.times(size), last, lanes) };
        let code = (bits & L::I::splat(0xFFFF)).to_floats();
        if self.wide == 0 {
            return code;
        }
        let height = L::F::from_bits(bits) - L::F::splat(self.eye[0]) - L::F::splat(self.eye[1]);
        L::F::select(L::M::from_bits(self.wide), height, code)
    }

    /// Highest ground of blocks, over the camera.
    #[inline(always)]
    pub fn maximum<L: Lanes>(&self, at: L::I, lanes: L::M) -> L::F {
        let value = self.read::<L>(&self.maxima, MAXIMA, at, lanes);
        self.height::<L>(value)
    }

    /// Posts at and east of, and north of both, a place in the tile, in the lanes' units;
    /// and whether all four are there.
    #[inline(always)]
    pub fn corners<L: Lanes>(&self, at: L::I, lanes: L::M) -> (L::M, [L::F; 4]) {
        let void = L::I::splat(i32::from(VOID));
        if self.wide != 0 {
            return self.wide_corners::<L>(at, lanes);
        }
        let at = at + at;
        let last = L::I::splat(2 * (POSTS as i32 - 2));
        let north = at + L::I::splat(2 * TILE_POSTS as i32);
        // SAFETY: `set` has seen that there are `POSTS` posts, of two bytes each.
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
        let one = L::I::splat(1);
        let north = at + L::I::splat(TILE_POSTS as i32);
        let values = [
            self.read::<L>(&self.posts, POSTS, at, lanes),
            self.read::<L>(&self.posts, POSTS, at + one, lanes),
            self.read::<L>(&self.posts, POSTS, north, lanes),
            self.read::<L>(&self.posts, POSTS, north + one, lanes),
        ];
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
