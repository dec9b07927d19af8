//! The lines of N rays on the map, and how rays rise over them.

use crate::lanes::{Floats, Ints, Lanes, Mask};
use crate::relief::Relief;

/// The least part of a line's direction along an axis: what is less runs along the grid.
const ALONG_GRID: f32 = 1e-12;

/// The lines of N rays.
pub(crate) struct Lines<L: Lanes> {
    /// Cells of level 0 per metre, along x and y.
    pub rate: [L::F; 2],
    /// Metres per cell.
    pub inverse: [L::F; 2],
    /// 1 along an axis on which the index of the cell grows, else 0 ...
    pub ahead: [L::I; 2],
    /// ... the same as a yes or no ...
    pub forward: [L::M; 2],
    /// ... and as 1 or -1.
    pub sign: [L::F; 2],
    /// What to add to the place of a post to come to the next along x.
    pub next: L::I,
    /// Distance at which the line comes over the layer ...
    pub enter: L::F,
    /// ... and leaves it.
    pub leave: L::F,
}

/// How rays rise over their lines; see the module's page.
#[derive(Clone, Copy)]
pub(crate) struct Slopes<L: Lanes> {
    k1: L::F,
    k2: L::F,
    k3: L::F,
}

impl<L: Lanes> Lines<L> {
    /// Lines with a unit direction along x and y.
    #[inline(always)]
    pub(crate) fn new(relief: &Relief, direction: [L::F; 2]) -> Self {
        let mut lines: Lines<L> = Lines {
            rate: direction,
            inverse: direction,
            ahead: [L::I::splat(0); 2],
            forward: [L::M::none(); 2],
            sign: direction,
            next: L::I::splat(0),
            enter: L::F::splat(0.0),
            leave: L::F::splat(f32::INFINITY),
        };
        let least = L::F::splat(ALONG_GRID);
        for axis in 0..2 {
            let rate = direction[axis] * L::F::splat((1.0 / relief.spacing[axis]) as f32);
            let rate = L::F::select(rate.abs().lt(least), least, rate);
            lines.rate[axis] = rate;
            lines.inverse[axis] = L::F::splat(1.0).div(rate);
            let ahead = L::F::splat(0.0).lt(rate);
            lines.ahead[axis] = L::I::select(ahead, L::I::splat(1), L::I::splat(0));
            lines.forward[axis] = ahead;
            lines.sign[axis] = L::F::select(ahead, L::F::splat(1.0), L::F::splat(-1.0));
            let first = lines.crossing(relief, axis, L::I::splat(0));
            let last = lines.crossing(relief, axis, L::I::splat(relief.cells[axis]));
            lines.enter = lines.enter.max(first.min(last));
            lines.leave = lines.leave.min(first.max(last));
        }
        lines.next = lines.ahead[0] + lines.ahead[0] - L::I::splat(1);
        lines
    }

    /// Distance at which the lines cross a grid line of level 0.
    #[inline(always)]
    pub fn crossing(&self, relief: &Relief, axis: usize, line: L::I) -> L::F {
        let apart = (line - L::I::splat(relief.eye_cell[axis])).to_floats()
            - L::F::splat(relief.eye_place[axis]);
        apart * self.inverse[axis]
    }

    /// Place at a distance, in cells of level 0 from the cell of the camera.
    #[inline(always)]
    pub fn place(&self, relief: &Relief, axis: usize, s: L::F) -> L::F {
        L::F::splat(relief.eye_place[axis]) + s * self.rate[axis]
    }

    /// The cell of a level, or block of cells of level 0, just after a distance, agreeing
    /// with `crossing`; kept from `low` to `high`.
    #[inline(always)]
    pub fn cell_after(
        &self,
        relief: &Relief,
        axis: usize,
        s: L::F,
        level: L::I,
        low: L::I,
        high: L::I,
    ) -> L::I {
        let eye = L::I::splat(relief.eye_cell[axis]);
        let guess = (self.place(relief, axis, s).floor() + eye).shr(level).max(low).min(high);
        let ahead = self.ahead[axis];
        let one = L::I::splat(1);
        let back = one - ahead;
        let out = self.crossing(relief, axis, (guess + ahead).shl(level));
        let into = self.crossing(relief, axis, (guess + back).shl(level));
        let step = ahead - back;
        let later = L::I::select(out.le(s), step, L::I::splat(0));
        let earlier = L::I::select(s.lt(into), step, L::I::splat(0));
        (guess + later - earlier).max(low).min(high)
    }
}

impl<L: Lanes> Slopes<L> {
    /// Rays of a tangent of elevation at the camera.
    #[inline(always)]
    pub(crate) fn new(relief: &Relief, tangent: L::F) -> Self {
        let k = relief.curvature as f32;
        let grown = L::F::splat((1.0 + relief.curvature * relief.eye_z) as f32);
        let square = tangent * tangent;
        let k2 = (L::F::splat(0.5) + square) * L::F::splat(k);
        let k3 = tangent * (L::F::splat(5.0 / 6.0) + square) * L::F::splat(k * k);
        Slopes { k1: grown * tangent, k2: grown * k2, k3: grown * k3 }
    }

    /// Height over the camera.
    #[inline(always)]
    pub(crate) fn height(&self, s: L::F) -> L::F {
        s * (self.k1 + s * (self.k2 + s * self.k3))
    }

    /// How much the ray bends over a piece that ends at `end`: its height there is the
    /// straight line between the ends, less at most a quarter of this.
    #[inline(always)]
    pub fn bend(&self, length: L::F, end: L::F) -> L::F {
        (self.k2 + end * (self.k3 * L::F::splat(3.0)).max(L::F::splat(0.0))) * length * length
    }
}

/// Height at which the camera sees a point at map distance `s` and a height over the camera:
/// the tangent of its elevation times `s`. Over the Earth the terms left out are below 1e-8
/// of that at 300 km.
#[inline(always)]
pub(super) fn seen_height<L: Lanes>(relief: &Relief, s: L::F, height: L::F) -> L::F {
    if relief.curvature == 0.0 {
        return height;
    }
    // With r and r0 the distances of the point and of the camera from the centre of the
    // Earth, in its radii, and the angle a = s k between them, the tangent is
    // (r cos a - r0) / (r sin a).
    let k = relief.curvature;
    let grown = 1.0 + k * relief.eye_z;
    let one = L::F::splat(1.0);
    let angle = s * L::F::splat(k as f32);
    let square = angle * angle;
    let share = height * L::F::splat((k / grown) as f32);
    let rise = height * L::F::splat((1.0 / grown) as f32) * (one - share * (one - share));
    let drop = L::F::splat(0.5) * angle * s * (one - square * L::F::splat(1.0 / 12.0));
    let sine = square * (L::F::splat(1.0 / 6.0) + square * L::F::splat(7.0 / 360.0));
    (rise - drop) * (one + sine)
}
