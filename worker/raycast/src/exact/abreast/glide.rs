//! The beginning of an approach: down to a plane over the ground.
//!
//! Beams end above the maxima of blocks, which are flat. Where the ground slopes, a plane
//! that slopes as it does lies closer, and rays of neighbouring pixels begin above the same
//! few cells. Between posts the surface of a cell is nowhere above a plane that its four
//! posts do not exceed, so a ray is free as long as it is above the plane and within the
//! window that the plane is for.
//!
//! Bounds are those of `approach`. The height of a ray's tangent above a plane is linear, so
//! it is enough to know it at both ends, with positions off by [`BLUR`]. The way ends before
//! the line could be crossed by which the ray leaves the window. It ends inside a cell, by
//! more than [`BLUR`] from its lines: so the ray goes through this cell, and the approach
//! goes on there.

use super::Sight;
use super::approach::{Approach, BLUR};
use crate::exact::tiles::Tiles;
use crate::exact::window::{PITCH, SIDE};
use crate::lanes::{Floats, Ints, Lanes, MOST, Mask};

/// Steepest fall of rays for which planes are made, metres for each metre: steeper ones go
/// through few cells.
const STEEPEST: f32 = 1.5;
/// The most windows, one after another.
const WINDOWS: usize = 5;
/// Share of the way to the plane that is gone.
const NEARLY: f32 = 0.999;

impl<L: Lanes> Approach<L> {
    /// Brings lanes as near to the ground as planes let them.
    #[inline(always)]
    pub(super) fn glide(&mut self, sight: &Sight, tiles: &mut Tiles) {
        let scale = sight.scale[0].max(sight.scale[1]) as f32;
        let flat = (self.slope.abs() * L::F::splat(scale)).lt(L::F::splat(STEEPEST));
        if L::N == 1 {
            return;
        }
        for _ in 0..WINDOWS {
            let lanes = self.active & flat;
            if lanes.count() as usize * 2 < L::N {
                return;
            }
            let far = self.glide_over_window(tiles, lanes);
            if far.count() as usize * 2 < L::N {
                return;
            }
        }
    }

    /// Brings lanes as near to the ground as one plane lets them. Returns those that have
    /// come to the end of its window.
    #[inline(always)]
    fn glide_over_window(&mut self, tiles: &mut Tiles, lanes: L::M) -> L::M {
        let bits = lanes.bits();
        let (first, last) = (bits.trailing_zeros(), 31 - bits.leading_zeros());
        let (mut corner, cell) = ([0; 2], self.cell());
        for axis in 0..2 {
            let (mut cells, mut ahead) = ([0; MOST], [0; MOST]);
            cell[axis].store(&mut cells);
            self.ahead[axis].store(&mut ahead);
            let (first, last) = (first as usize % MOST, last as usize % MOST);
            corner[axis] = if ahead[first] == 1 {
                cells[first].min(cells[last]) & -PITCH
            } else {
                (cells[first].max(cells[last]) - SIDE + PITCH) & -PITCH
            };
        }
        let Some(plane) = tiles.plane::<L>(corner) else { return L::M::none() };
        let (zero, side) = (L::I::splat(0), L::I::splat(SIDE));
        let blur = L::F::splat(BLUR);
        let most = L::F::splat(1.0) - blur;
        let mut inside = lanes;
        let mut end = self.reach;
        let mut height = L::F::splat(plane.height);
        let mut rise = L::F::splat(0.0);
        for axis in 0..2 {
            let first = L::I::splat(plane.first[axis]);
            let cell = cell[axis] - first;
            inside = inside & !cell.lt(zero) & cell.lt(side);
            // From the window's south-west post to where the ray began.
            let from = (self.base[axis] - first).to_floats() + self.from[axis];
            let line = L::I::select(zero.lt(self.ahead[axis]), side, zero).to_floats();
            end = end.min((line - from) * self.inverse[axis] - self.tie);
            let slope = L::F::splat(plane.rise[axis]);
            height = height + slope * from + blur * slope.abs();
            rise = rise + slope * self.rate[axis];
        }
        let above = self.low(self.v) - (height + rise * self.v);
        let closing = rise - self.slope;
        let falls = L::F::splat(0.0).lt(closing);
        let down = self.v + above.div(closing) * L::F::splat(NEARLY);
        let v = L::F::select(falls, down.min(end), end);
        let clear = L::F::splat(0.0).lt(above) & (height + rise * v).lt(self.low(v));
        let mut moving = inside & clear & self.v.lt(v);
        let mut places = self.place;
        for axis in 0..2 {
            let place = self.from[axis] + v * self.rate[axis];
            places[axis] = place.floor().to_floats();
            let part = place - places[axis];
            moving = moving & blur.lt(part) & part.lt(most);
        }
        self.v = L::F::select(moving, v, self.v);
        for axis in 0..2 {
            self.place[axis] = L::F::select(moving, places[axis], self.place[axis]);
        }
        moving & end.le(v)
    }
}
