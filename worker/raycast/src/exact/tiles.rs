//! The tiles of a layer as kernels read them, by number.

use super::window::Planes;
use crate::field::{Field, Ground, tile_key};
use crate::lanes::as_bits;
use crate::lanes::{Doubles, Floats, Ints, Lanes, Mask};
use crate::walk::{maximum, post};
use terrafarm_terrain::layout::TILE_POSTS;
use terrafarm_terrain::tile::{Codes, Heights, MAXIMA_LEVELS, VOID};

/// Tiles that are remembered: a few rows of a region come over no more.
const SLOTS: usize = 64;
/// The number of no tile.
const NONE: i32 = -1;

/// Looks tiles of level 0 of one layer up and remembers them.
pub(crate) struct Tiles<'a> {
    field: Field<'a>,
    layer: usize,
    /// Tiles along x.
    pub(super) columns: i32,
    slots: Vec<(i32, Soil<'a>)>,
    /// The tile that was read last.
    pub(super) last: (i32, Soil<'a>),
    pub(super) planes: Planes,
}

/// What a tile holds.
#[derive(Clone, Copy)]
pub(super) enum Soil<'a> {
    Codes(Codes<'a>),
    /// Heights as they are, as bits.
    Floats {
        posts: &'a [u32],
        maxima: &'a [u32],
    },
    /// No surface at all.
    Void,
    /// It is not loaded; the index knows its maximum.
    Absent {
        highest: f32,
    },
}

/// The corners of cells.
pub(super) struct Corners<L: Lanes> {
    /// South-west, south-east, north-west, north-east, metres.
    pub heights: [L::D; 4],
    /// The cells that have a surface.
    pub solid: L::M,
    /// The cells whose tile is not loaded.
    pub absent: L::M,
}

/// The ground as f32 tells it: each height within four roundings.
pub(super) struct Rough<L: Lanes> {
    /// Of blocks: -infinity where no cell has a surface.
    pub highest: L::F,
    /// The corners of cells, in the order of [`Corners`]: metres above `base`, by `scale`.
    pub heights: [L::F; 4],
    pub scale: L::F,
    pub base: L::F,
    /// The cells that have a surface.
    pub solid: L::M,
    /// The lanes whose tile is not loaded.
    pub absent: L::M,
}

impl<L: Lanes> Rough<L> {
    #[inline(always)]
    fn none() -> Self {
        Rough {
            highest: L::F::splat(f32::NEG_INFINITY),
            heights: [L::F::splat(0.0); 4],
            scale: L::F::splat(1.0),
            base: L::F::splat(0.0),
            solid: L::M::none(),
            absent: L::M::none(),
        }
    }

    /// Cells of one tile.
    #[inline(always)]
    fn of_codes(codes: &Codes, at: L::I, lanes: L::M) -> Self {
        let (read, solid) = read_pairs::<L>(codes, at, lanes);
        Rough::of_read(read, codes.base, codes.step, solid)
    }

    /// Cells the codes of whose corners are given, and the base and the step of these.
    #[inline(always)]
    pub(super) fn of_read(read: [L::I; 4], base: i32, step: f64, solid: L::M) -> Self {
        Rough {
            heights: [
                read[0].to_floats(),
                read[1].to_floats(),
                read[2].to_floats(),
                read[3].to_floats(),
            ],
            scale: L::F::splat(step as f32),
            base: L::F::splat((f64::from(base) * step) as f32),
            solid,
            ..Rough::none()
        }
    }

    #[inline(always)]
    fn read_codes(&mut self, codes: &Codes, at: L::I, lanes: L::M) {
        let (read, solid) = read_pairs::<L>(codes, at, lanes);
        self.solid = self.solid | solid;
        for n in 0..4 {
            let height = rough_heights::<L>(codes, read[n]);
            self.heights[n] = L::F::select(lanes, height, self.heights[n]);
        }
    }

    #[inline(always)]
    fn read_floats(&mut self, posts: &[u32], at: L::I, lanes: L::M) {
        let south = L::I::gather_twos(posts, at, lanes);
        let north = L::I::gather_twos(posts, at + L::I::splat(TILE_POSTS as i32), lanes);
        let read = [south.0, south.1, north.0, north.1];
        let mut solid = lanes;
        for n in 0..4 {
            let height = L::F::from_bits(read[n]);
            // A void is NaN.
            solid = solid & height.eq(height);
            self.heights[n] = L::F::select(lanes, height, self.heights[n]);
        }
        self.solid = self.solid | solid;
    }
}

impl<'a> Tiles<'a> {
    pub(crate) fn new(field: Field<'a>, layer: usize) -> Self {
        let levels = &field.index().layers[layer].levels;
        let columns = levels.first().map_or(0, |level| level.tiles[0] as i32);
        let none = (NONE, Soil::Void);
        Tiles { field, layer, columns, slots: vec![none; SLOTS], last: none, planes: Planes::new() }
    }

    /// Makes `last` the tile with a number.
    #[inline(always)]
    pub(super) fn turn_to(&mut self, number: i32) {
        let slot = self.slots[number as usize % SLOTS];
        if slot.0 == number { self.last = slot } else { self.fetch(number) }
    }

    #[cold]
    fn fetch(&mut self, number: i32) {
        let columns = self.columns.max(1);
        let cell = [number % columns, number / columns].map(|tile| tile << MAXIMA_LEVELS);
        let key = tile_key(self.layer, cell);
        self.field.resident.touch(key);
        let soil = match self.field.ground(key) {
            Ground::Loaded(tile) => match tile.heights() {
                Heights::Codes(codes) => Soil::Codes(codes),
                Heights::Floats(floats) => {
                    let (posts, maxima) = (as_bits(floats.posts), as_bits(floats.maxima));
                    Soil::Floats { posts, maxima }
                }
            },
            Ground::Void => Soil::Void,
            Ground::Absent => {
                let entry = self.field.index().entry(key);
                Soil::Absent { highest: entry.map_or(f32::INFINITY, |entry| entry.max) }
            }
        };
        self.last = (number, soil);
        self.slots[number as usize % SLOTS] = self.last;
    }

    #[inline(always)]
    fn numbers<L: Lanes>(&self, cell: [L::I; 2]) -> L::I {
        let levels = L::I::splat(MAXIMA_LEVELS as i32);
        cell[1].shr(levels).times(L::I::splat(self.columns)) + cell[0].shr(levels)
    }

    /// Those of `lanes` that are over one tile, which becomes `last`.
    #[inline(always)]
    fn alike<L: Lanes>(&mut self, numbers: L::I, lanes: L::M) -> L::M {
        let here = lanes & numbers.eq(L::I::splat(self.last.0));
        if here.any() {
            return here;
        }
        let mut values = [0; crate::lanes::MOST];
        numbers.store(&mut values);
        let first = lanes.bits().trailing_zeros() as usize % crate::lanes::MOST;
        self.turn_to(values[first]);
        lanes & numbers.eq(L::I::splat(self.last.0))
    }

    /// Whether `lanes` are over one tile, which then is `last`.
    #[inline(always)]
    pub(super) fn has_all<L: Lanes>(&mut self, cell: [L::I; 2], lanes: L::M) -> bool {
        let numbers = self.numbers::<L>(cell);
        self.alike::<L>(numbers, lanes).bits() == lanes.bits()
    }

    /// The cell in the south-west of `last`.
    #[inline(always)]
    pub(super) fn first_cell(&self) -> [i32; 2] {
        let columns = self.columns.max(1);
        [self.last.0 % columns, self.last.0 / columns].map(|tile| tile << MAXIMA_LEVELS)
    }

    /// Maxima over blocks of `1 << level` cells, metres, for `lanes`: -infinity where no
    /// cell has a surface, that of the whole tile where it is not loaded. Also these lanes.
    #[inline(always)]
    pub(crate) fn maxima<L: Lanes>(
        &mut self,
        cell: [L::I; 2],
        level: L::I,
        lanes: L::M,
    ) -> (L::D, L::M) {
        let at = maximum::<L>([cell[0].shr(level), cell[1].shr(level)], level);
        let numbers = self.numbers::<L>(cell);
        let mut highest = L::D::splat(f64::NEG_INFINITY);
        let mut absent = L::M::none();
        let mut rest = lanes;
        while rest.any() {
            let here = self.alike::<L>(numbers, rest);
            match self.last.1 {
                Soil::Codes(codes) => {
                    let code = L::I::gather_pairs(codes.maxima, at, here) & L::I::splat(0xFFFF);
                    let any = here & !code.eq(L::I::splat(0));
                    highest =
                        L::D::select(any, heights::<L>(codes.base, codes.step, code), highest);
                }
                Soil::Floats { maxima, .. } => {
                    highest = L::D::select(here, read_float::<L>(maxima, at, here), highest);
                }
                Soil::Void => {}
                Soil::Absent { highest: all } => {
                    highest = L::D::select(here, L::D::splat(f64::from(all)), highest);
                    absent = absent | here;
                }
            }
            rest = rest & !here;
        }
        (highest, absent)
    }

    /// What f32 can tell of the corners of cells.
    #[inline(always)]
    pub(super) fn rough_corners<L: Lanes>(&mut self, cell: [L::I; 2], lanes: L::M) -> Rough<L> {
        let at = post::<L>(cell);
        let numbers = self.numbers::<L>(cell);
        let here = self.alike::<L>(numbers, lanes);
        if let (true, Soil::Codes(codes)) = (here.bits() == lanes.bits(), self.last.1) {
            return Rough::of_codes(&codes, at, lanes);
        }
        let mut rough = Rough::none();
        let mut rest = lanes;
        while rest.any() {
            let here = self.alike::<L>(numbers, rest);
            match self.last.1 {
                Soil::Codes(codes) => rough.read_codes(&codes, at, here),
                Soil::Floats { posts, .. } => rough.read_floats(posts, at, here),
                Soil::Void => {}
                Soil::Absent { .. } => rough.absent = rough.absent | here,
            }
            rest = rest & !here;
        }
        rough
    }

    /// What f32 can tell of the ground: the maxima of `blocks` and the corners of `cells`.
    #[inline(always)]
    pub(super) fn rough<L: Lanes>(
        &mut self,
        cell: [L::I; 2],
        level: L::I,
        blocks: L::M,
        cells: L::M,
    ) -> Rough<L> {
        let at = maximum::<L>([cell[0].shr(level), cell[1].shr(level)], level);
        let corner = post::<L>(cell);
        let numbers = self.numbers::<L>(cell);
        let mut rough = Rough::none();
        let mut rest = blocks | cells;
        while rest.any() {
            let here = self.alike::<L>(numbers, rest);
            match self.last.1 {
                Soil::Codes(codes) => {
                    if (here & blocks).any() {
                        let code = L::I::gather_pairs(codes.maxima, at, here & blocks);
                        let code = code & L::I::splat(0xFFFF);
                        let any = here & blocks & !code.eq(L::I::splat(0));
                        let highest = rough_heights::<L>(&codes, code);
                        rough.highest = L::F::select(any, highest, rough.highest);
                    }
                    if (here & cells).any() {
                        rough.read_codes(&codes, corner, here & cells);
                    }
                }
                Soil::Floats { posts, maxima } => {
                    let read = L::F::from_bits(L::I::gather(maxima, at, here & blocks));
                    rough.highest = L::F::select(here & blocks, read, rough.highest);
                    rough.read_floats(posts, corner, here & cells);
                }
                Soil::Void => {}
                Soil::Absent { .. } => rough.absent = rough.absent | here,
            }
            rest = rest & !here;
        }
        rough
    }

    /// The corners of cells, for `lanes`.
    #[inline(always)]
    pub(super) fn corners<L: Lanes>(&mut self, cell: [L::I; 2], lanes: L::M) -> Corners<L> {
        let at = post::<L>(cell);
        let north = at + L::I::splat(TILE_POSTS as i32);
        let numbers = self.numbers::<L>(cell);
        let none = L::D::splat(0.0);
        let mut corners = Corners { heights: [none; 4], solid: L::M::none(), absent: L::M::none() };
        let mut rest = lanes;
        while rest.any() {
            let here = self.alike::<L>(numbers, rest);
            match self.last.1 {
                Soil::Codes(codes) => {
                    let (read, solid) = read_pairs::<L>(&codes, at, here);
                    corners.solid = corners.solid | solid;
                    for n in 0..4 {
                        let height = heights::<L>(codes.base, codes.step, read[n]);
                        corners.heights[n] = L::D::select(here, height, corners.heights[n]);
                    }
                }
                Soil::Floats { posts, .. } => {
                    let one = L::I::splat(1);
                    let read = [
                        read_float::<L>(posts, at, here),
                        read_float::<L>(posts, at + one, here),
                        read_float::<L>(posts, north, here),
                        read_float::<L>(posts, north + one, here),
                    ];
                    // A void is NaN, and so is the sum.
                    let sum = read[0] + read[1] + read[2] + read[3];
                    let solid = sum.abs().lt(L::D::splat(f64::INFINITY));
                    corners.solid = corners.solid | (here & solid);
                    for n in 0..4 {
                        corners.heights[n] = L::D::select(here, read[n], corners.heights[n]);
                    }
                }
                Soil::Void => {}
                Soil::Absent { .. } => corners.absent = corners.absent | here,
            }
            rest = rest & !here;
        }
        corners
    }
}

/// Codes of the corners of cells, and those that have a surface.
#[inline(always)]
fn read_pairs<L: Lanes>(codes: &Codes, at: L::I, lanes: L::M) -> ([L::I; 4], L::M) {
    let (low, sixteen) = (L::I::splat(0xFFFF), L::I::splat(16));
    let south = L::I::gather_pairs(codes.posts, at, lanes);
    let north = L::I::gather_pairs(codes.posts, at + L::I::splat(TILE_POSTS as i32), lanes);
    let read = [south & low, south.shr(sixteen) & low, north & low, north.shr(sixteen) & low];
    let highest = read[0].max(read[1]).max(read[2].max(read[3]));
    (read, lanes & highest.lt(L::I::splat(i32::from(VOID))))
}

/// Heights of codes, metres, within four roundings.
#[inline(always)]
fn rough_heights<L: Lanes>(codes: &Codes, code: L::I) -> L::F {
    (L::I::splat(codes.base) + code).to_floats() * L::F::splat(codes.step as f32)
}

/// Heights of codes, metres: what the tile gives back for each, to the bit.
#[inline(always)]
pub(super) fn heights<L: Lanes>(base: i32, step: f64, code: L::I) -> L::D {
    let steps = L::D::from_ints(L::I::splat(base) + code);
    (steps * L::D::splat(step)).to_single()
}

#[inline(always)]
fn read_float<L: Lanes>(table: &[u32], at: L::I, lanes: L::M) -> L::D {
    L::D::from_floats(L::F::from_bits(L::I::gather(table, at, lanes)))
}
