//! The way of rays up to where f64 must tell: over cells and blocks, in f32.
//!
//! It decides nothing: an approach ends at the latest in the first cell that the ray is not
//! seen to clear, and what is done in f64 begins there.
//!
//! **What is to be shown.** The approach leaves cells behind. The rest may begin where the
//! ray enters the last cell, if the ray goes through just these cells, in the twin's order,
//! and meets nothing in any of those left behind.
//!
//! **Places.** With the ray's larger rate as the unit, `v` counts cells along that axis
//! from the start. Positions are `from + v rate`, relative to the first cell, with
//! `|rate| <= 1`, `from` in [0, 1] and `v <= FARTHEST`; lines are crossed at
//! `v = (line - from) inverse`. `from` rounds by at most 2^-24 cells. The difference, `inverse`
//! and their product, `rate`, its product with v and the sum round once each, by at most
//! 2^-24 of something that is no larger than `FARTHEST + 1` cells, and the way to the first
//! line by 2^-24 of a cell: together less than [`BLUR`]. The twin's own rounding is below [`SURE_SLACK`], a thousandth of that; else
//! there is no approach.
//!
//! **The same cells.** A crossing is off by at most `BLUR` across its line, hence by
//! `BLUR |inverse|` in v, and its place along the line by `doubt = BLUR (1 + |inverse|)`. A
//! block is left by the line that is crossed first; where that place is further than
//! `doubt` from every line across it, the ray crosses between the same two lines, and
//! enters the same cell. A ray that is in a cell goes on to the next along the axis whose
//! line it crosses first; which one that is, is sure if both crossings are further apart
//! than `tie`, more than both may be off together. Where it is not, the approach ends. It
//! also ends by `tie` before the course does: so the line was crossed on the course, and
//! there is a cell behind it.
//!
//! **Nothing is met in a block.** The ray's height is replaced by its tangent at the start,
//! which is nowhere above it within a span (`path`), but for rounding. So in a block it is at least
//! the lesser of those at both ends; these are off by up to `doubt` in v, so
//! `doubt |slope|` is taken off, from the start on.
//!
//! **Nor in a cell.** There the height of the tangent above the surface is a parabola,
//! which hangs below the line through its ends by a quarter of its bend at most. Places
//! are off by `doubt` along each axis, the ends by as much again, and the surface is no
//! steeper than the cell's range of heights for each cell: that is six times
//! `doubt range`; eight are asked for. The gap where a cell is entered is the one where the
//! last was left, which the surface does not change on their line: it is taken over, less the
//! eight of the last cell, unless that has no surface.
//!
//! **Heights.** Those of posts round four times, the ray's and the surface's and what is
//! made of them less than twenty times, by 2^-24 of twice the largest height or less. That
//! holds too where they are counted in steps above the lowest of their tile. [`ROUGHNESS`]
//! is 64 times 2^-24; it is taken off at the start, with the twin's own clearance.
//!
//! What overflows becomes infinite or NaN, which clears nothing.

use super::walk::cell_at;
use super::{Sight, Start};
use crate::exact::nearby::{Nearby, Places};
use crate::exact::tiles::{Rough, Tiles};
use crate::exact::{CLEARANCE_M, FIRST_LEVEL};
use crate::lanes::{Doubles, Floats, Ints, Lanes, Mask};
use terrafarm_terrain::tile::MAXIMA_LEVELS;

/// The longest approach, cells along the axis of the larger rate.
pub(super) const FARTHEST: f64 = 250.0;
/// Bound of all rounding in positions, cells: more than 6 x 251 x 2^-24.
pub(super) const BLUR: f32 = 1.0 / 8192.0;
/// Bound of the twin's own rounding, cells.
pub(super) const SURE_SLACK: f64 = 1.0 / (1 << 22) as f64;
/// Share by which heights may differ in f32, that of the ray and those of posts together.
const ROUGHNESS: f64 = 1.0 / (1 << 18) as f64;
/// The steepest slope, metres a cell along the axis of the larger rate: far from what
/// overflows.
const STEEPEST: f32 = 1e30;

/// Lanes on their way.
#[derive(Clone, Copy)]
pub(super) struct Approach<L: Lanes> {
    pub(super) active: L::M,
    /// The cell in which the ray began.
    pub(super) base: [L::I; 2],
    /// The cell that it is in, from `base` on.
    pub(super) place: [L::F; 2],
    /// Of the block that is looked at, once blocks are.
    level: L::I,
    /// How far the ray has come.
    pub(super) v: L::F,
    /// How far the ray is above the surface there, at least ...
    gap: L::F,
    /// ... but for lanes that come from a block, or from where there is no surface.
    pub(super) fresh: L::M,
    pub(super) from: [L::F; 2],
    pub(super) rate: [L::F; 2],
    pub(super) inverse: [L::F; 2],
    /// From a cell to the next along an axis: 1 or -1.
    stride: [L::F; 2],
    /// 1 along an axis on which the index of the cell grows, else 0 ...
    pub(super) ahead: [L::I; 2],
    /// ... and the way from `from` to the line ahead of the first cell.
    toward: [L::F; 2],
    /// Within which crossings of the lines of an axis are known, along them ...
    doubt: [L::F; 2],
    /// ... which counts so much in heights, for each metre of range ...
    blur: L::F,
    /// ... and within which the crossings of both are, as v.
    pub(super) tie: L::F,
    /// Minus 1/4 of the product of the rates.
    turn: L::F,
    height: L::F,
    pub(super) slope: L::F,
    pub(super) reach: L::F,
    pub(super) nearby: Nearby<L>,
}

/// Where lanes leave their blocks.
struct Exits<L: Lanes> {
    /// Where lines of either axis are crossed.
    lines: [L::F; 2],
    /// Where the first is.
    v: L::F,
    low: L::F,
    north: L::M,
}

impl<L: Lanes> Approach<L> {
    /// Nothing under way.
    #[inline(always)]
    pub(super) fn none() -> Self {
        let (none, zero, lanes) = (L::F::splat(0.0), L::I::splat(0), L::M::none());
        Approach {
            active: lanes,
            base: [zero; 2],
            place: [none; 2],
            level: zero,
            v: none,
            gap: none,
            fresh: lanes,
            from: [none; 2],
            rate: [none; 2],
            inverse: [none; 2],
            stride: [none; 2],
            ahead: [zero; 2],
            toward: [none; 2],
            doubt: [none; 2],
            blur: none,
            tie: none,
            turn: none,
            height: none,
            slope: none,
            reach: none,
            nearby: Nearby::none(),
        }
    }

    /// Puts rays at the start of their approach.
    #[inline(always)]
    pub(super) fn begin(&mut self, sight: &Sight, start: &Start<L>, lanes: L::M) {
        let Start { begin, last, rate, inverse, z, fall } = *start;
        let along = inverse[0].abs().min(inverse[1].abs());
        let pace = rate[0].abs().max(rate[1].abs());
        let slope = (fall * along).to_floats();
        let reach = ((last - begin) * pace).min(L::D::splat(FARTHEST)).to_floats();
        let may = lanes & begin.lt(last) & slope.abs().lt(L::F::splat(STEEPEST));
        let sure = sight.slack[0].max(sight.slack[1]) < SURE_SLACK;
        self.active = if sure { may } else { L::M::none() };
        self.fresh = self.active;
        self.level = L::I::splat(FIRST_LEVEL as i32);
        let size = z.abs() + L::D::splat(sight.largest);
        let room = L::D::splat(CLEARANCE_M) + L::D::splat(ROUGHNESS) * size;
        let low = (z - room).to_floats();
        let blur = L::F::splat(BLUR);
        for axis in 0..2 {
            let position = L::D::splat(sight.start[axis]) + begin * rate[axis];
            let slack = L::D::splat(sight.slack[axis]);
            let ahead = L::D::splat(0.0).lt(rate[axis]);
            let last = L::I::splat(sight.cells[axis] - 1);
            let cell = cell_at::<L>(position, slack, ahead, last);
            let inverse = (inverse[axis] * pace).to_floats();
            let from = (position - L::D::from_ints(cell)).to_floats();
            self.base[axis] = cell;
            self.place[axis] = L::F::splat(0.0);
            self.from[axis] = from;
            self.rate[axis] = (rate[axis] * along).to_floats();
            self.inverse[axis] = inverse;
            self.ahead[axis] = L::I::select(ahead, L::I::splat(1), L::I::splat(0));
            let line: L::F = self.ahead[axis].to_floats();
            self.stride[axis] = line + line - L::F::splat(1.0);
            self.toward[axis] = line - from;
            self.doubt[axis] = blur * (L::F::splat(1.0) + inverse.abs());
        }
        let doubt = self.doubt[0].max(self.doubt[1]);
        self.v = L::F::splat(0.0);
        self.blur = L::F::splat(8.0) * doubt;
        self.tie = self.doubt[0] + self.doubt[1];
        self.reach = reach - self.tie;
        self.slope = slope;
        self.height = low - doubt * slope.abs();
        self.turn = L::F::splat(-0.25) * self.rate[0] * self.rate[1];
        self.nearby.forget();
    }

    /// Where the rays cross lines, by how far these are from the lines ahead of the first
    /// cells.
    #[inline(always)]
    fn exits(&self, lines: [L::F; 2]) -> Exits<L> {
        let x = (lines[0] + self.toward[0]) * self.inverse[0];
        let y = (lines[1] + self.toward[1]) * self.inverse[1];
        let v = y.min(x);
        Exits { lines: [x, y], v, low: self.low(v), north: y.lt(x) }
    }

    /// Bounds of the heights of rays.
    #[inline(always)]
    pub(super) fn low(&self, v: L::F) -> L::F {
        self.height + v * self.slope
    }

    /// Takes lanes, all of which are at a cell, a step further. Returns how many.
    #[inline(always)]
    pub(super) fn step_cells(&mut self, tiles: &mut Tiles) -> u64 {
        let taken = self.active;
        let exits = self.exits(self.place);
        let (clear, solid) = if self.reach_nearby(tiles) {
            let rough = self.nearby.rough(self.place, taken);
            (self.misses(&rough, &exits, self.fresh) | !rough.solid, rough.solid)
        } else {
            let rough = tiles.rough_corners::<L>(self.cell(), taken);
            let missed = self.misses(&rough, &exits, self.fresh);
            ((missed | !rough.solid) & !rough.absent, rough.solid)
        };
        let [x, y] = exits.lines;
        let sure = self.tie.lt(x.max(y) - exits.v);
        let moving = taken & clear & sure & exits.v.lt(self.reach);
        self.go(0, moving & !exits.north);
        self.go(1, moving & exits.north);
        self.v = exits.v;
        self.fresh = moving & !solid;
        self.active = moving;
        u64::from(taken.count())
    }

    /// Sees to it that the posts around the cells are at hand, if they can be.
    #[inline(always)]
    pub(super) fn reach_nearby(&mut self, tiles: &mut Tiles) -> bool {
        let at = Places { base: self.base, place: self.place, ahead: self.ahead };
        self.nearby.reach(tiles, &at, self.active)
    }

    /// Goes on to the next cell along an axis.
    #[inline(always)]
    fn go(&mut self, axis: usize, lanes: L::M) {
        let next = self.place[axis] + self.stride[axis];
        self.place[axis] = L::F::select(lanes, next, self.place[axis]);
    }

    /// The cells that the rays are in.
    #[inline(always)]
    pub(super) fn cell(&self) -> [L::I; 2] {
        [self.base[0] + self.place[0].truncate(), self.base[1] + self.place[1].truncate()]
    }

    /// Takes lanes, at blocks and cells, a step further. Returns how many.
    #[inline(always)]
    pub(super) fn step(&mut self, sight: &Sight, tiles: &mut Tiles) -> u64 {
        let (zero, one) = (L::I::splat(0), L::I::splat(1));
        let taken = self.active;
        let cells = taken & self.level.eq(zero);
        let blocks = taken & !cells;
        let before = self.cell();
        let lines = [
            (before[0].shr(self.level) + self.ahead[0]).shl(self.level) - self.ahead[0],
            (before[1].shr(self.level) + self.ahead[1]).shl(self.level) - self.ahead[1],
        ];
        let exits = self
            .exits([(lines[0] - self.base[0]).to_floats(), (lines[1] - self.base[1]).to_floats()]);
        let rough = tiles.rough::<L>(before, self.level, blocks, cells);
        let passed = rough.highest.lt(self.low(self.v).min(exits.low));
        let mut clear = blocks & passed & !rough.absent;
        if cells.any() {
            let missed = self.misses(&rough, &exits, cells) | !rough.solid;
            clear = clear | (cells & missed & !rough.absent);
        }
        let down = blocks & !clear & !rough.absent;
        self.level = L::I::select(down, self.level - one, self.level);
        let moved = self.pass(sight, lines, &exits, clear);
        let (after, parent) = (self.cell(), self.level + one);
        let same_x = before[0].shr(parent).eq(after[0].shr(parent));
        let same_y = before[1].shr(parent).eq(after[1].shr(parent));
        let up = moved & !(same_x & same_y) & self.level.lt(L::I::splat(MAXIMA_LEVELS as i32));
        self.level = L::I::select(up, parent, self.level);
        self.active = down | moved;
        u64::from(taken.count())
    }

    /// Which lanes are seen to be above the surface all through their cells.
    #[inline(always)]
    fn misses(&mut self, rough: &Rough<L>, exits: &Exits<L>, fresh: L::M) -> L::M {
        let [sw, se, nw, ne] = rough.heights;
        if fresh.any() {
            let gap = self.low(self.v) - self.surface(rough, self.v);
            self.gap = L::F::select(fresh, gap, self.gap);
        }
        let gap = exits.low - self.surface(rough, exits.v);
        let length = exits.v - self.v;
        let twist = (ne - nw) - (se - sw);
        let sag = twist * self.turn * (length * length);
        let range = sw.max(se).max(nw.max(ne)) - sw.min(se).min(nw.min(ne));
        let blur = self.blur * range;
        let room = rough.scale * (blur + sag.max(L::F::splat(0.0)));
        let missed = room.lt(self.gap.min(gap));
        self.gap = gap - rough.scale * blur;
        missed
    }

    /// Heights of the surface where rays are within their cells.
    #[inline(always)]
    fn surface(&self, rough: &Rough<L>, v: L::F) -> L::F {
        let [sw, se, nw, ne] = rough.heights;
        let x = (self.from[0] - self.place[0]) + v * self.rate[0];
        let y = (self.from[1] - self.place[1]) + v * self.rate[1];
        let (south, north) = (sw + (se - sw) * x, nw + (ne - nw) * x);
        rough.base + rough.scale * (south + (north - south) * y)
    }

    /// Goes on behind blocks; returns the lanes that may.
    #[inline(always)]
    fn pass(&mut self, sight: &Sight, lines: [L::I; 2], exits: &Exits<L>, lanes: L::M) -> L::M {
        let (zero, one) = (L::I::splat(0), L::I::splat(1));
        let north = exits.north;
        let line = L::I::select(north, lines[1], lines[0]);
        let ahead = L::I::select(north, self.ahead[1], self.ahead[0]);
        let after = line + ahead + ahead - one;
        let (columns, rows) = (L::I::splat(sight.cells[0]), L::I::splat(sight.cells[1]));
        let counts = L::I::select(north, rows, columns);
        let outside = after.lt(zero) | !after.lt(counts);
        // Where along the line, in cells.
        let from = L::F::select(north, self.from[0], self.from[1]);
        let rate = L::F::select(north, self.rate[0], self.rate[1]);
        let place = from + exits.v * rate;
        let floor = place.floor();
        let part = place - floor.to_floats();
        let doubt = L::F::select(north, self.doubt[1], self.doubt[0]);
        let sure = doubt.lt(part) & part.lt(L::F::splat(1.0) - doubt);
        let near = exits.v.lt(self.reach);
        let after = after - L::I::select(north, self.base[1], self.base[0]);
        let (after, beside): (L::F, L::F) = (after.to_floats(), floor.to_floats());
        let moving = lanes & sure & near & !outside;
        self.v = L::F::select(moving, exits.v, self.v);
        let places = [L::F::select(north, beside, after), L::F::select(north, after, beside)];
        for axis in 0..2 {
            self.place[axis] = L::F::select(moving, places[axis], self.place[axis]);
        }
        moving
    }
}
