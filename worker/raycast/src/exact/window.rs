//! Planes over small windows of the ground.

use crate::exact::tiles::{Soil, Tiles};
use crate::lanes::{Floats, Ints, Lanes, MOST};
use terrafarm_terrain::layout::{TILE_CELLS, TILE_POSTS, TILE_RING};
use terrafarm_terrain::tile::MAXIMA_LEVELS;

/// Cells along a side of a window.
pub(super) const SIDE: i32 = 7;
/// Posts along a side, and pairs of them in all.
const POSTS: usize = SIDE as usize + 1;
const PAIRS: usize = POSTS * POSTS / 2;
/// Bound of what rounds where a plane is made, as a share of its largest term.
const ROUNDING: f32 = 1.0 / (1 << 19) as f32;

/// Pairs of posts, neighbours along x: index of the first from the south-west post of the
/// window on, and where it lies.
const INDICES: [i32; PAIRS] = {
    let mut indices = [0; PAIRS];
    let mut pair = 0;
    while pair < PAIRS {
        let (row, column) = (2 * pair / POSTS, 2 * pair % POSTS);
        indices[pair] = (row * TILE_POSTS + column) as i32;
        pair += 1;
    }
    indices
};
const COLUMNS: [f32; PAIRS] = places(false);
const ROWS: [f32; PAIRS] = places(true);

const fn places(rows: bool) -> [f32; PAIRS] {
    let mut places = [0.0; PAIRS];
    let mut pair = 0;
    while pair < PAIRS {
        let place = if rows { 2 * pair / POSTS } else { 2 * pair % POSTS };
        places[pair] = place as f32;
        pair += 1;
    }
    places
}

/// Windows begin at every so many cells, so that rays share them.
pub(super) const PITCH: i32 = 2;
/// Planes that are remembered, along either axis.
const KEPT: i32 = 16;

/// A plane that no ground exceeds in a window of [`SIDE`] x [`SIDE`] cells. NaN if posts are
/// void from which it is made.
#[derive(Clone, Copy)]
pub(super) struct Plane {
    /// The south-west cell of the window.
    pub first: [i32; 2],
    /// Height above the south-west post, metres.
    pub height: f32,
    /// Rise for each cell, metres.
    pub rise: [f32; 2],
}

/// Planes that were made.
pub(super) struct Planes(Vec<Plane>);

impl Planes {
    pub(super) fn new() -> Self {
        let none = Plane { first: [-1; 2], height: 0.0, rise: [0.0; 2] };
        Planes(vec![none; (KEPT * KEPT) as usize])
    }
}

impl Tiles<'_> {
    /// A plane over the window that begins with a cell, a multiple of [`PITCH`] along each
    /// axis, or as near to it as its tile allows.
    #[inline(always)]
    pub(super) fn plane<L: Lanes>(&mut self, cell: [i32; 2]) -> Option<Plane> {
        const INSIDE: i32 = TILE_CELLS as i32 - 1;
        const LAST: i32 = (TILE_CELLS as i32 - SIDE) / PITCH * PITCH;
        let [x, y] = [cell[0].max(0), cell[1].max(0)];
        let first =
            [(x & !INSIDE) + (x & INSIDE).min(LAST), (y & !INSIDE) + (y & INSIDE).min(LAST)];
        let [column, row] = [first[0] / PITCH % KEPT, first[1] / PITCH % KEPT];
        let slot = (row * KEPT + column) as usize;
        if self.planes.0[slot].first != first {
            self.planes.0[slot] = self.new_plane::<L>(first)?;
        }
        Some(self.planes.0[slot])
    }

    #[inline(always)]
    fn new_plane<L: Lanes>(&mut self, first: [i32; 2]) -> Option<Plane> {
        let [x, y] = first;
        self.turn_to((y >> MAXIMA_LEVELS) * self.columns + (x >> MAXIMA_LEVELS));
        let (mask, ring) = (TILE_CELLS as i32 - 1, TILE_RING as i32);
        let at = ((y & mask) + ring) * TILE_POSTS as i32 + (x & mask) + ring;
        let corner = |column: usize, row: usize| at as usize + row * TILE_POSTS + column;
        let far = POSTS - 1;
        let corners = [corner(0, 0), corner(far, 0), corner(0, far), corner(far, far)];
        let (mut heights, scale, base);
        match self.last.1 {
            Soil::Codes(codes) => {
                heights = corners.map(|at| f32::from(codes.posts[at]));
                scale = codes.step as f32;
                base = (f64::from(codes.base) * codes.step) as f32;
            }
            Soil::Floats { posts, .. } => {
                heights = corners.map(|at| f32::from_bits(posts[at]));
                (scale, base) = (1.0, 0.0);
            }
            Soil::Void | Soil::Absent { .. } => return None,
        }
        let [sw, se, nw, ne] = &mut heights;
        let share = 0.5 / SIDE as f32;
        let rise = [((*se - *sw) + (*ne - *nw)) * share, ((*nw - *sw) + (*ne - *se)) * share];
        let mut top = L::F::splat(f32::NEG_INFINITY);
        let all = L::I::splat(0).eq(L::I::splat(0));
        let (x_rise, y_rise) = (L::F::splat(rise[0]), L::F::splat(rise[1]));
        let mut pair = 0;
        while pair < PAIRS {
            let index = L::I::splat(at) + L::I::load(&INDICES[pair..]);
            let (west, east): (L::F, L::F) = match self.last.1 {
                Soil::Codes(codes) => {
                    let read = L::I::gather_pairs(codes.posts, index, all);
                    let (low, sixteen) = (L::I::splat(0xFFFF), L::I::splat(16));
                    ((read & low).to_floats(), (read.shr(sixteen) & low).to_floats())
                }
                Soil::Floats { posts, .. } => {
                    let (west, east) = L::I::gather_twos(posts, index, all);
                    (L::F::from_bits(west), L::F::from_bits(east))
                }
                Soil::Void | Soil::Absent { .. } => return None,
            };
            let plane = L::F::load(&COLUMNS[pair..]) * x_rise + L::F::load(&ROWS[pair..]) * y_rise;
            let (west, east) = (west - plane, east - plane - x_rise);
            // A void, which has no surface, may be NaN: that is not greater.
            top = west.max(top);
            top = east.max(top);
            pair += L::N;
        }
        let mut tops = [f32::NEG_INFINITY; MOST];
        top.store(&mut tops);
        let mut top = f32::NEG_INFINITY;
        for value in tops {
            top = if value > top { value } else { top };
        }
        let side = SIDE as f32;
        let largest = top.abs() + side * (rise[0].abs() + rise[1].abs());
        let height = base + scale * (top + ROUNDING * largest);
        Some(Plane { first, height, rise: [scale * rise[0], scale * rise[1]] })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::{Field, Ground, tile_key};
    use crate::grid::cells_of;
    use crate::lanes::{self, Kernel, Width};
    use crate::oracle::{Dice, lands};

    struct Look<'t, 'a>(&'t mut Tiles<'a>, [i32; 2]);

    impl Kernel for Look<'_, '_> {
        type Output = Option<Plane>;

        #[inline(always)]
        fn run<L: Lanes>(self) -> Option<Plane> {
            self.0.plane::<L>(self.1)
        }
    }

    #[test]
    fn no_post_of_a_window_is_above_its_plane() {
        let (mut posts, mut close) = (0, 0);
        for (number, land) in lands().iter().enumerate() {
            let field = Field { resident: &land.resident, pyramid: &land.pyramid };
            let cells = cells_of(&land.resident.index().layers[0]);
            let mut dice = Dice::new(9 + number as u64);
            for width in Width::available() {
                let mut tiles = Tiles::new(field, 0);
                for _ in 0..300 {
                    let cell =
                        cells.map(|count| dice.below(count.max(1) as u64) as i32 / PITCH * PITCH);
                    let Some(plane) = lanes::run(Look(&mut tiles, cell), width) else { continue };
                    let key = tile_key(0, plane.first);
                    assert_eq!(key, tile_key(0, cell));
                    let Ground::Loaded(tile) = field.ground(key) else { panic!("it was read") };
                    for (j, i) in (0..SIDE).flat_map(|j| (0..SIDE).map(move |i| (j, i))) {
                        let at = [i, j].map(|index| index as usize);
                        let inside = plane.first.map(|index| index as usize & (TILE_CELLS - 1));
                        let corners = tile.corners(inside[0] + at[0], inside[1] + at[1]);
                        for (n, post) in corners.into_iter().enumerate() {
                            let (i, j) = (i + (n as i32 & 1), j + (n as i32 >> 1));
                            let rise = f64::from(plane.rise[0]) * f64::from(i)
                                + f64::from(plane.rise[1]) * f64::from(j);
                            let room = f64::from(plane.height) + rise - f64::from(post);
                            let least = -1e-6 * f64::from(post.abs());
                            assert!(room.is_nan() || room >= least, "{} {room}", land.name);
                            posts += 1;
                            close += u32::from(room < 1.0);
                        }
                    }
                }
            }
        }
        assert!(posts > 100_000 && close > 1000, "{posts} posts, {close} close");
    }
}
