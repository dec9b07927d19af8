//! Posts close to the rays of a vector, held where lanes pick from them.
//!
//! Rays of neighbouring pixels come down to the same few cells and take their last steps
//! there. Eight rows of eight posts have what nearly all of them need; where lanes can pick
//! from vectors, this costs a fraction of reading the corners of each cell from its tile.

use super::tiles::{Corners, Rough, Soil, Tiles, heights};
use crate::lanes::{Floats, Ints, Lanes, Mask};
use terrafarm_terrain::layout::{TILE_CELLS, TILE_POSTS, TILE_RING};
use terrafarm_terrain::tile::VOID;

/// Posts along a side.
const SIDE: usize = 8;
/// The last cell of a side, counted from 0.
const LAST: i32 = SIDE as i32 - 2;
/// Cells that are kept free in front of the rays, where there is room, so that they have some
/// way to go.
const AHEAD: i32 = 2;

/// The posts around the lanes of an approach: codes of one tile, around cells of it.
#[derive(Clone, Copy)]
pub(super) struct Nearby<L: Lanes> {
    /// By rows.
    posts: Posts,
    /// The cell in the south-west.
    first: [i32; 2],
    /// From there to the cells in which the rays began.
    from: [L::F; 2],
    has_voids: bool,
    /// Metres.
    step: f64,
    /// Steps to code 0.
    base: i32,
    state: State,
}

#[derive(Clone, Copy)]
#[repr(align(64))]
struct Posts([u16; SIDE * SIDE]);

#[derive(Clone, Copy, PartialEq, Eq)]
enum State {
    /// Not looked for yet.
    New,
    Held,
    /// The rays are too far apart, or over ground of another kind.
    Apart,
}

/// Where lanes are.
pub(super) struct Places<L: Lanes> {
    /// The cells in which the rays began ...
    pub base: [L::I; 2],
    /// ... and those that they are in, counted from there.
    pub place: [L::F; 2],
    /// 1 along an axis on which the index of the cell grows, else 0.
    pub ahead: [L::I; 2],
}

impl<L: Lanes> Nearby<L> {
    #[inline(always)]
    pub(super) fn none() -> Self {
        Nearby {
            posts: Posts([0; SIDE * SIDE]),
            first: [0; 2],
            from: [L::F::splat(0.0); 2],
            has_voids: false,
            step: 0.0,
            base: 0,
            state: State::Apart,
        }
    }

    /// Nothing is held, and what is needed is to be looked for.
    #[inline(always)]
    pub(super) fn forget(&mut self) {
        self.state = if L::I::PICKS { State::New } else { State::Apart };
    }

    /// Whether the posts around the cells of all `lanes` are held, after they were looked for
    /// if they had to be.
    #[inline(always)]
    pub(super) fn reach(&mut self, tiles: &mut Tiles, at: &Places<L>, lanes: L::M) -> bool {
        if self.state == State::Apart {
            return false;
        }
        if self.state == State::Held && self.has(at.place, lanes) {
            return true;
        }
        let holds = self.read(tiles, at, lanes) && self.has(at.place, lanes);
        self.state = if holds { State::Held } else { State::Apart };
        holds
    }

    #[inline(always)]
    fn has(&self, place: [L::F; 2], lanes: L::M) -> bool {
        let (x, y) = (place[0] + self.from[0], place[1] + self.from[1]);
        let inside = L::F::splat(0.0).le(x.min(y)) & x.max(y).le(L::F::splat(LAST as f32));
        !(lanes & !inside).any()
    }

    /// Reads posts where they are likely to do for `lanes`, if these are over one tile of
    /// codes.
    #[inline(always)]
    fn read(&mut self, tiles: &mut Tiles, at: &Places<L>, lanes: L::M) -> bool {
        const INSIDE: i32 = TILE_CELLS as i32 - 1;
        /// The last corner whose cells are all in the tile.
        const LIMIT: i32 = INSIDE - LAST + AHEAD;
        let Places { base, place, ahead } = at;
        let cell = [base[0] + place[0].truncate(), base[1] + place[1].truncate()];
        let (true, Soil::Codes(codes)) = (tiles.has_all::<L>(cell, lanes), tiles.last.1) else {
            return false;
        };
        // Columns, and from bit 16 on rows, counted from `AHEAD` cells before the tile on.
        let (inside, sixteen) = (L::I::splat(INSIDE), L::I::splat(16));
        let low = (cell[1] & inside).shl(sixteen) + (cell[0] & inside);
        let both = L::I::splat(1 << 16 | 1);
        let toward = (ahead[1].shl(sixteen) + ahead[0]).times(L::I::splat(AHEAD));
        let margin = both.times(L::I::splat(AHEAD));
        let limit = LIMIT << 16 | LIMIT;
        let (mut corner, fits) =
            L::I::corner(low + toward, low + toward + margin + both, limit, lanes);
        if !fits {
            corner = L::I::corner(low + margin, low + margin + both, limit, lanes).0;
        }
        let column = ((corner & 0xFFFF) - AHEAD).max(0);
        let row = ((corner >> 16) - AHEAD).max(0);
        let tile = tiles.first_cell();
        self.first = [tile[0] + column, tile[1] + row];
        for axis in 0..2 {
            self.from[axis] = (base[axis] - L::I::splat(self.first[axis])).to_floats();
        }
        let first = (row as usize + TILE_RING) * TILE_POSTS + column as usize + TILE_RING;
        for row in 0..SIDE {
            let posts = &codes.posts[first + row * TILE_POSTS..][..SIDE];
            self.posts.0[SIDE * row..][..SIDE].copy_from_slice(posts);
        }
        let mut highest = 0;
        for &post in &self.posts.0 {
            highest = post.max(highest);
        }
        self.has_voids = highest == VOID;
        (self.step, self.base) = (codes.step, codes.base);
        true
    }

    /// Codes of the corners of cells, given by their first post's place among those held, and
    /// those of `lanes` that have a surface.
    #[inline(always)]
    fn codes(&self, at: L::I, lanes: L::M) -> ([L::I; 4], L::M) {
        let (low, sixteen) = (L::I::splat(0xFFFF), L::I::splat(16));
        let south = L::I::pick_pairs(&self.posts.0, at);
        let north = L::I::pick_pairs(&self.posts.0, at + L::I::splat(SIDE as i32));
        let read = [south & low, south.shr(sixteen) & low, north & low, north.shr(sixteen) & low];
        if !self.has_voids {
            return (read, lanes);
        }
        let highest = read[0].max(read[1]).max(read[2].max(read[3]));
        (read, lanes & highest.lt(L::I::splat(i32::from(VOID))))
    }

    /// What f32 can tell of the corners of cells. Those of `lanes` must be held.
    #[inline(always)]
    pub(super) fn rough(&self, place: [L::F; 2], lanes: L::M) -> Rough<L> {
        let (x, y) = (place[0] + self.from[0], place[1] + self.from[1]);
        let at = (y * L::F::splat(SIDE as f32) + x).truncate();
        let (read, solid) = self.codes(at, lanes);
        Rough::of_read(read, self.base, self.step, solid)
    }

    /// The corners of cells, if those of all `lanes` are held.
    #[inline(always)]
    pub(super) fn corners(&self, cell: [L::I; 2], lanes: L::M) -> Option<Corners<L>> {
        if self.state != State::Held {
            return None;
        }
        let x = cell[0] - L::I::splat(self.first[0]);
        let y = cell[1] - L::I::splat(self.first[1]);
        let (zero, last) = (L::I::splat(0), L::I::splat(LAST));
        let outside = x.min(y).lt(zero) | last.lt(x.max(y));
        if (lanes & outside).any() {
            return None;
        }
        let (read, solid) = self.codes(y.times(L::I::splat(SIDE as i32)) + x, lanes);
        let heights = [
            heights::<L>(self.base, self.step, read[0]),
            heights::<L>(self.base, self.step, read[1]),
            heights::<L>(self.base, self.step, read[2]),
            heights::<L>(self.base, self.step, read[3]),
        ];
        Some(Corners { heights, solid, absent: L::M::none() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::exact::tests::more_lands;
    use crate::field::Field;
    use crate::grid::cells_of;
    use crate::lanes::{self, Doubles, Kernel, MOST, Width};
    use crate::oracle::Dice;

    /// Looks at the corners of cells among those held and in their tiles, after rays moved on
    /// from `began` to `cells`. Says whether they were held.
    struct Look<'t, 'a> {
        tiles: &'t mut Tiles<'a>,
        began: [[i32; MOST]; 2],
        cells: [[i32; MOST]; 2],
        ahead: [i32; 2],
        lanes: u32,
    }

    impl Kernel for Look<'_, '_> {
        type Output = bool;

        #[inline(always)]
        fn run<L: Lanes>(self) -> bool {
            let Look { tiles, began, cells, ahead, lanes } = self;
            let lanes = L::M::from_bits(lanes);
            let base = [L::I::load(&began[0]), L::I::load(&began[1])];
            let cell = [L::I::load(&cells[0]), L::I::load(&cells[1])];
            let mut at = Places::<L> {
                base,
                place: [L::F::splat(0.0); 2],
                ahead: [L::I::splat(ahead[0]), L::I::splat(ahead[1])],
            };
            let mut nearby = Nearby::<L>::none();
            nearby.forget();
            let begins = nearby.reach(tiles, &at, lanes);
            at.place = [(cell[0] - base[0]).to_floats(), (cell[1] - base[1]).to_floats()];
            if !begins || !nearby.reach(tiles, &at, lanes) {
                return false;
            }
            let found = nearby.corners(cell, lanes).expect("they are held");
            let truth = tiles.corners::<L>(cell, lanes);
            assert_eq!(found.solid.bits(), truth.solid.bits());
            let rough = nearby.rough(at.place, lanes);
            let other = tiles.rough_corners::<L>(cell, lanes);
            assert_eq!(rough.solid.bits(), other.solid.bits());
            for n in 0..4 {
                let (mut exact, mut near) = ([[0.0; MOST]; 2], [[0.0; MOST]; 2]);
                found.heights[n].store(&mut exact[0]);
                truth.heights[n].store(&mut exact[1]);
                (rough.base + rough.scale * rough.heights[n]).store(&mut near[0]);
                (other.base + other.scale * other.heights[n]).store(&mut near[1]);
                let solid = truth.solid.bits();
                for lane in (0..MOST).filter(|lane| solid >> lane & 1 == 1) {
                    assert_eq!(exact[0][lane].to_bits(), exact[1][lane].to_bits());
                    assert_eq!(f32::to_bits(near[0][lane]), f32::to_bits(near[1][lane]));
                }
            }
            true
        }
    }

    #[test]
    fn corners_held_are_those_of_their_tile() {
        let (mut held, mut looked) = (0, 0);
        for (number, land) in more_lands().iter().enumerate() {
            let field = Field { resident: &land.resident, pyramid: &land.pyramid };
            let cells = cells_of(&land.resident.index().layers[0]);
            let mut dice = Dice::new(77 + number as u64);
            for _ in 0..crate::oracle::count(600) {
                let corner = cells.map(|count| dice.below(count.max(1) as u64) as i32);
                let reach = dice.below(8) + 1;
                let mut near = |axis: usize, from: i32| {
                    (from + dice.below(reach) as i32).clamp(0, cells[axis].max(1) - 1)
                };
                let began = [0, 1].map(|axis| [0; MOST].map(|_| near(axis, corner[axis])));
                let moved = [0, 1].map(|axis| began[axis].map(|cell| near(axis, cell - 1)));
                let ahead = [0, 1].map(|_| dice.below(2) as i32);
                let lanes = dice.below(1 << MOST) as u32 | 1;
                for width in Width::available() {
                    let mut tiles = Tiles::new(field, 0);
                    let count = [1, 8, MOST][width as usize];
                    let lanes = lanes & ((1 << count) - 1);
                    let look = Look { tiles: &mut tiles, began, cells: moved, ahead, lanes };
                    let is_held = lanes::run(look, width);
                    looked += u64::from(width == Width::Sixteen);
                    held += u64::from(is_held);
                }
            }
        }
        assert!(looked == 0 || held > looked / 10, "{held} of {looked}");
    }
}
