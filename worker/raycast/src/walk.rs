//! N rays over the level-of-detail surface, each along its own line on the map.
//!
//! A ray is held by the direction of its line and by its slope: at map distance s from the
//! camera it is `s (k1 + s (k2 + s k3))` above the camera, which over flat ground is
//! `s tan(elevation)` and over the Earth the first three terms of the straight ray's
//! height over a sphere; the next is below 0.03 px at 300 km.
//!
//! Lanes walk on their own, from cell to cell, and past blocks of cells whose maximum
//! they clear, as `exact` does. A lane remembers the cell where its last ray ended, with
//! the ground along its line there. A ray of the same line that rises more steeply meets
//! nothing before that cell (Cohen-Or et al., section 2), so it begins there.
//!
//! **What is found depends on the line and the slope alone**, not on where the lane began:
//! where a line crosses the grid is one expression, a cell's answer depends on nothing but
//! the cell, and a block is passed only with more room than all rounding takes.

use crate::lanes::{Floats, Ints, Lanes, MOST, Mask};
use crate::relief::{Relief, Soil};
use terrafarm_terrain::layout::{TILE_CELLS, TILE_POSTS, TILE_RING};
use terrafarm_terrain::tile::{Codes, Floats as Floats32, HeightTile, Heights, MAXIMA_LEVELS, VOID};

/// How far above a block's maximum a ray must stay to pass it: metres, and a share of its
/// height over or under the camera. Rounding is an eighth of that.
const CLEARANCE_M: f32 = 0.02;
const CLEARANCE_SHARE: f32 = 2e-6;
/// The least part of a line's direction along an axis: what is less runs along the grid.
const ALONG_GRID: f32 = 1e-12;
/// The plot of lanes that have left the layer.
const NOWHERE: i32 = -1;
/// Cells that a ray passes one by one before it looks at blocks of them. Measured at the
/// views of `bench core`.
const PATIENCE: i32 = 3;

/// The lines of N rays.
pub(crate) struct Lines<L: Lanes> {
    /// Cells of level 0 per metre, along x and y.
    rate: [L::F; 2],
    /// Metres per cell.
    inverse: [L::F; 2],
    /// 1 along an axis on which the index of the cell grows, else 0 ...
    ahead: [L::I; 2],
    /// ... the same as a yes or no ...
    forward: [L::M; 2],
    /// ... and as 1 or -1.
    sign: [L::F; 2],
    /// What to add to the place of a post to come to the next along an axis.
    next: [L::I; 2],
    /// Distance at which the line comes over the layer ...
    enter: L::F,
    /// ... and leaves it.
    leave: L::F,
}

/// How rays rise over their lines; see the module's page.
#[derive(Clone, Copy)]
pub(crate) struct Slopes<L: Lanes> {
    k1: L::F,
    k2: L::F,
    k3: L::F,
}

/// The rays of each line, in the order in which they rise: ray n has the tangent of
/// elevation `(rise + d higher) / (length + d longer)` with `d = first + n step`, and its
/// answer belongs at `at + n pitch`.
pub(crate) struct Rows<L: Lanes> {
    pub rise: L::F,
    pub higher: L::F,
    pub length: L::F,
    pub longer: L::F,
    pub first: f32,
    pub step: f32,
    pub count: i32,
    pub at: L::I,
    pub pitch: i32,
}

/// N lanes: their lines and rays, and where each is.
pub(crate) struct Walk<'r, 'a, L: Lanes> {
    relief: &'r Relief<'a>,
    lines: Lines<L>,
    rows: Rows<L>,
    /// The ray that each lane casts, and its slope.
    row: L::I,
    slopes: Slopes<L>,
    /// The plot, or `NOWHERE` if the lane has left the layer or cast its last ray.
    plot: L::I,
    /// How far the ray is known to be free.
    free: L::F,
    /// A tile was missing on the way.
    unsure: L::M,
    /// Blocks and cells looked at.
    pub steps: u64,
}

/// Lanes that go from cell to cell.
#[derive(Clone, Copy)]
struct Steps<L: Lanes> {
    /// The lines by which the cell is left, in cells of level 0 from that of the camera.
    line: [L::F; 2],
    /// The distances at which these are crossed.
    crossing: [L::F; 2],
    /// Cells between this one and the border of the plot, ahead.
    rest: [L::I; 2],
    /// Place of the cell's south-west post in the tile.
    post: L::I,
    /// Cells passed since the last hit.
    passed: L::I,
}

/// The ground of a cell along a line, over the camera.
#[derive(Clone, Copy)]
struct Profile<L: Lanes> {
    /// Distance at which the line enters the cell ...
    start: L::F,
    /// ... and leaves it.
    end: L::F,
    /// Height at both.
    low: L::F,
    high: L::F,
    /// How much the ground bends in between.
    curl: L::F,
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
            next: [L::I::splat(0); 2],
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
            let stride = [1, TILE_POSTS as i32][axis];
            lines.next[axis] = L::I::select(ahead, L::I::splat(stride), L::I::splat(-stride));
            let first = lines.crossing(relief, axis, L::I::splat(0));
            let last = lines.crossing(relief, axis, L::I::splat(relief.cells[axis]));
            lines.enter = lines.enter.max(first.min(last));
            lines.leave = lines.leave.min(first.max(last));
        }
        lines
    }

    /// Distance at which the lines cross a grid line of level 0.
    #[inline(always)]
    fn crossing(&self, relief: &Relief, axis: usize, line: L::I) -> L::F {
        let apart = (line - L::I::splat(relief.eye_cell[axis])).to_floats()
            - L::F::splat(relief.eye_place[axis]);
        apart * self.inverse[axis]
    }

    /// Place at a distance, in cells of level 0 from the cell of the camera.
    #[inline(always)]
    fn place(&self, relief: &Relief, axis: usize, s: L::F) -> L::F {
        L::F::splat(relief.eye_place[axis]) + s * self.rate[axis]
    }

    /// The cell of a level, or block of cells of level 0, just after a distance, agreeing
    /// with `crossing`; kept from `low` to `high`.
    #[inline(always)]
    fn cell_after(
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
    fn bend(&self, length: L::F, end: L::F) -> L::F {
        (self.k2 + end * (self.k3 * L::F::splat(3.0)).max(L::F::splat(0.0))) * length * length
    }
}

impl<L: Lanes> Rows<L> {
    #[inline(always)]
    fn slopes(&self, relief: &Relief, row: L::I) -> Slopes<L> {
        let d = L::F::splat(self.first) + row.to_floats() * L::F::splat(self.step);
        Slopes::new(relief, (self.rise + d * self.higher).div(self.length + d * self.longer))
    }
}

impl<L: Lanes> Profile<L> {
    /// Whether and where rays meet the ground. With t from 0 to 1 through the cell, the
    /// ray is `g(t) = g0 + b t + bend t^2` above it; see `cell`.
    #[inline(always)]
    fn contact(&self, slopes: &Slopes<L>) -> (L::M, L::F) {
        let zero = L::F::splat(0.0);
        let length = self.end - self.start;
        let g0 = slopes.height(self.start) - self.low;
        let g1 = slopes.height(self.end) - self.high;
        let bend = slopes.bend(length, self.end) - self.curl;
        let b = (g1 - g0) - bend;
        let excess = bend - (g0 + g1);
        let four = L::F::splat(4.0);
        let dips = zero.lt(excess) & (four * g0 * g1).le(excess * excess);
        let root = (b * b - four * bend * g0).max(zero).sqrt();
        let falls = b.lt(zero);
        let above = L::F::select(falls, g0 + g0, b + root);
        let below = L::F::select(falls, root - b, L::F::splat(-2.0) * bend);
        let t = above.div(below).max(zero).min(L::F::splat(1.0));
        let inside = g0.le(zero);
        let t = L::F::select(inside, zero, t);
        ((inside | g1.le(zero) | dips) & self.start.lt(self.end), self.start + t * length)
    }
}

impl<'r, 'a, L: Lanes> Walk<'r, 'a, L> {
    /// Lanes where their lines come over the layer, or at `free` if that is later.
    #[inline(always)]
    pub(crate) fn new(
        relief: &'r Relief<'a>,
        lines: Lines<L>,
        rows: Rows<L>,
        free: L::F,
    ) -> Self {
        let free = lines.enter.max(free);
        let level = L::I::splat(MAXIMA_LEVELS as i32);
        let zero = L::I::splat(0);
        let columns = L::I::splat(relief.plots[0] - 1);
        let column = lines.cell_after(relief, 0, free, level, zero, columns);
        let last = L::I::splat(relief.plots[1] - 1);
        let row = lines.cell_after(relief, 1, free, level, zero, last);
        let plot = row.times(L::I::splat(relief.plots[0])) + column;
        let plot = L::I::select(free.lt(lines.leave), plot, L::I::splat(NOWHERE));
        let slopes = rows.slopes(relief, zero);
        Walk {
            relief,
            lines,
            rows,
            row: zero,
            slopes,
            plot,
            free,
            unsure: L::M::none(),
            steps: 0,
        }
    }

    /// Casts all rays. One over the distance on the map at which they meet the surface
    /// goes to `met`: NaN where a missing tile leaves it open, and nothing for rays that
    /// meet nothing.
    #[inline(always)]
    pub(crate) fn run(&mut self, met: &mut [f32]) {
        let nowhere = L::I::splat(NOWHERE);
        loop {
            let left = !self.plot.eq(nowhere);
            if !left.any() {
                break;
            }
            let number = self.plot_of(left.bits().trailing_zeros() as usize);
            let here = left & self.plot.eq(L::I::splat(number));
            let plot = self.relief.plot(number);
            match plot.ground {
                Soil::Tile(tile) => self.cross(number, plot.level, tile, here, met),
                Soil::Void => self.pass_plot(number, here),
                Soil::Absent => {
                    self.unsure = self.unsure | here;
                    self.pass_plot(number, here);
                }
            }
        }
        while self.unsure.any() {
            self.emit(L::F::splat(f32::NAN), self.unsure, met);
            self.unsure = self.unsure & self.row.lt(L::I::splat(self.rows.count));
        }
    }

    #[inline(always)]
    fn plot_of(&self, lane: usize) -> i32 {
        let mut plots = [0; MOST];
        self.plot.store(&mut plots);
        plots[lane & (MOST - 1)]
    }

    /// Writes the answers of lanes; these go on with their next rays.
    #[inline(always)]
    fn emit(&mut self, s: L::F, lanes: L::M, met: &mut [f32]) {
        let at = self.rows.at + self.row.times(L::I::splat(self.rows.pitch));
        let s = L::F::select(self.unsure, L::F::splat(f32::NAN), s);
        s.scatter(met, at, lanes);
        let next = self.row + L::I::splat(1);
        self.row = L::I::select(lanes, next, self.row);
    }

    /// Takes lanes past a plot in which there is nothing to hit.
    #[inline(always)]
    fn pass_plot(&mut self, number: i32, here: L::M) {
        let corner = [
            L::I::splat(number % self.relief.plots[0]),
            L::I::splat(number / self.relief.plots[0]),
        ];
        let level = L::I::splat(MAXIMA_LEVELS as i32);
        let (out, along_x) = self.exit(corner, level);
        self.enter_next(corner, out, along_x, here);
    }

    /// Where lines leave the blocks of `1 << level` cells of level 0 that they are in, and
    /// whether by a line across x.
    #[inline(always)]
    fn exit(&self, block: [L::I; 2], level: L::I) -> (L::F, L::M) {
        let x_line = (block[0] + self.lines.ahead[0]).shl(level);
        let y_line = (block[1] + self.lines.ahead[1]).shl(level);
        let x = self.lines.crossing(self.relief, 0, x_line);
        let y = self.lines.crossing(self.relief, 1, y_line);
        (x.min(y), x.le(y))
    }

    /// Puts lanes into the plot behind the line by which they leave theirs at `s`.
    #[inline(always)]
    fn enter_next(&mut self, plot: [L::I; 2], s: L::F, along_x: L::M, lanes: L::M) {
        let (zero, one) = (L::I::splat(0), L::I::splat(1));
        let [ahead_x, ahead_y] = self.lines.ahead;
        let column = L::I::select(along_x, plot[0] + ahead_x + ahead_x - one, plot[0]);
        let row = L::I::select(along_x, plot[1], plot[1] + ahead_y + ahead_y - one);
        let columns = L::I::splat(self.relief.plots[0]);
        let rows = L::I::splat(self.relief.plots[1]);
        let inside = !column.lt(zero) & column.lt(columns) & !row.lt(zero) & row.lt(rows);
        let inside = inside & s.lt(self.lines.leave);
        let number = row.times(columns) + column;
        let next = L::I::select(inside, number, L::I::splat(NOWHERE));
        self.plot = L::I::select(lanes, next, self.plot);
        self.free = L::F::select(lanes, s, self.free);
    }

    #[inline(always)]
    fn cross(&mut self, number: i32, level: u32, tile: &HeightTile, here: L::M, met: &mut [f32]) {
        match tile.heights() {
            Heights::Codes(codes) => {
                let tile = Coded::new(codes, self.relief.eye_z);
                self.cross_tile(number, level, &tile, here, met);
            }
            Heights::Floats(floats) => {
                let tile = Plain::new(floats, self.relief.eye_z);
                self.cross_tile(number, level, &tile, here, met);
            }
        }
    }

    /// Takes lanes over a plot, until each has left it or has cast its last ray.
    ///
    /// A lane has a cell before it whose contact with its ray is to be found, or goes on to
    /// the next cell, or looks for it among blocks of cells. What most lanes wait for is
    /// done first.
    #[inline(always)]
    fn cross_tile(
        &mut self,
        number: i32,
        level: u32,
        tile: &impl Tile,
        here: L::M,
        met: &mut [f32],
    ) {
        let relief = self.relief;
        let (zero, one) = (L::I::splat(0), L::I::splat(1));
        let plain = L::F::splat(0.0);
        let plot = [
            L::I::splat(number % relief.plots[0]),
            L::I::splat(number / relief.plots[0]),
        ];
        let bits = MAXIMA_LEVELS as u32 - level;
        // Cells of the plot: the first, and how many lie behind it.
        let top = L::I::splat(bits as i32);
        let first = [plot[0].shl(top), plot[1].shl(top)];
        let side = one.shl(top) - one;
        let base = L::I::splat(level as i32);
        let mut cell = [
            self.lines.cell_after(relief, 0, self.free, base, first[0], first[0] + side),
            self.lines.cell_after(relief, 1, self.free, base, first[1], first[1] + side),
        ];
        let mut block = top;
        let mut steps = Steps::<L> {
            line: [plain; 2],
            crossing: [plain; 2],
            rest: [zero; 2],
            post: zero,
            passed: zero,
        };
        let mut profile =
            Profile::<L> { start: plain, end: plain, low: plain, high: plain, curl: plain };
        let mut left = here;
        let mut ready = L::M::none();
        let mut seeking = here;
        while left.any() {
            let walking = left & !ready & !seeking;
            let (a, b, c) = (ready.count(), walking.count(), seeking.count());
            if a >= b && a >= c {
                // Contacts.
                let (hit, s) = profile.contact(&self.slopes);
                let hit = hit & ready;
                if hit.any() {
                    let inside = hit & s.lt(self.lines.leave);
                    self.emit(L::F::splat(1.0).div(s), inside, met);
                    self.slopes = self.rows.slopes(relief, self.row);
                    let done = hit & !(inside & self.row.lt(L::I::splat(self.rows.count)));
                    self.plot = L::I::select(done, L::I::splat(NOWHERE), self.plot);
                    left = left & !done;
                    ready = ready & !done;
                    steps.passed = L::I::select(hit, zero, steps.passed);
                }
                ready = ready & hit;
            } else if b >= c {
                // To the next cells.
                let along_x = steps.crossing[0].le(steps.crossing[1]);
                let s = steps.crossing[0].min(steps.crossing[1]);
                let by_x = walking & along_x;
                let by_y = walking & !along_x;
                let rest_x = steps.rest[0] - one;
                let rest_y = steps.rest[1] - one;
                let leaving = (by_x & rest_x.lt(zero))
                    | (by_y & rest_y.lt(zero))
                    | (walking & !s.lt(self.lines.leave));
                steps.rest[0] = L::I::select(by_x, rest_x, steps.rest[0]);
                steps.rest[1] = L::I::select(by_y, rest_y, steps.rest[1]);
                if leaving.any() {
                    self.enter_next(plot, s, along_x, leaving);
                    left = left & !leaving;
                }
                let stride = L::F::splat((1u32 << level) as f32);
                let (line_x, line_y) = (
                    steps.line[0] + self.lines.sign[0] * stride,
                    steps.line[1] + self.lines.sign[1] * stride,
                );
                steps.line[0] = L::F::select(by_x, line_x, steps.line[0]);
                steps.line[1] = L::F::select(by_y, line_y, steps.line[1]);
                let across = L::I::select(along_x, self.lines.next[0], self.lines.next[1]);
                steps.post = L::I::select(walking, steps.post + across, steps.post);
                steps.passed = L::I::select(walking, steps.passed + one, steps.passed);
                let going = walking & !leaving;
                let tired = going & L::I::splat(PATIENCE).lt(steps.passed) & one.lt(top + one);
                if tired.any() {
                    self.free = L::F::select(tired, s, self.free);
                    for axis in 0..2 {
                        let ahead = self.lines.ahead[axis];
                        let low = first[axis] + steps.rest[axis];
                        let high = first[axis] + side - steps.rest[axis];
                        let at = L::I::select(ahead.eq(one), high, low);
                        cell[axis] = L::I::select(tired, at, cell[axis]);
                    }
                    block = L::I::select(tired, one.min(top), block);
                    seeking = seeking | tired;
                }
                let going = going & !tired;
                let low = profile.high;
                let solid = self.look(tile, &mut steps, level, s, going, &mut profile);
                profile.low = L::F::select(going, low, profile.low);
                ready = ready | (going & solid);
            } else {
                // Among blocks.
                let within = [cell[0].shr(block), cell[1].shr(block)];
                let found = seeking & block.eq(zero);
                let blocks = seeking & !found;
                self.steps += u64::from(blocks.count());
                let (out, along_x) = self.exit(within, base + block);
                let highest = tile.maximum::<L>(maximum::<L>(within, block), blocks);
                let lowest = self.slopes.height(self.free).min(self.slopes.height(out))
                    - L::F::splat(0.25) * self.slopes.bend(out - self.free, out);
                let room = L::F::splat(CLEARANCE_M) + lowest.abs() * L::F::splat(CLEARANCE_SHARE);
                let clear = blocks & (highest + room).lt(lowest);
                let below = blocks & !clear;
                // The cell behind the line by which the block is left; beside it, the cell
                // that the line has come to within the block.
                let side = one.shl(block) - one;
                let (low_x, low_y) = (within[0].shl(block), within[1].shl(block));
                let [ahead_x, ahead_y] = self.lines.ahead;
                let behind_x = (within[0] + ahead_x).shl(block) - one + ahead_x;
                let behind_y = (within[1] + ahead_y).shl(block) - one + ahead_y;
                let beside_x =
                    self.lines.cell_after(relief, 0, out, base, low_x, low_x + side);
                let beside_y =
                    self.lines.cell_after(relief, 1, out, base, low_y, low_y + side);
                let next_x = L::I::select(along_x, behind_x, beside_x);
                let next_y = L::I::select(along_x, beside_y, behind_y);
                let before = L::I::select(along_x, cell[0], cell[1]);
                let after = L::I::select(along_x, next_x, next_y);
                let outside = !before.shr(top).eq(after.shr(top)) | !out.lt(self.lines.leave);
                let leaving = clear & outside;
                if leaving.any() {
                    self.enter_next(plot, out, along_x, leaving);
                    left = left & !leaving;
                    seeking = seeking & !leaving;
                }
                let moving = clear & !leaving;
                cell[0] = L::I::select(moving, next_x, cell[0]);
                cell[1] = L::I::select(moving, next_y, cell[1]);
                self.free = L::F::select(moving, out, self.free);
                let parent = block + one;
                let crossed = !before.shr(parent).eq(after.shr(parent)) & block.lt(top);
                block = L::I::select(moving & crossed, parent, block);
                block = L::I::select(below, block - one, block);
                if found.any() {
                    self.arrive(tile, cell, level, first, found, &mut steps, &mut profile);
                    let solid = self.look(tile, &mut steps, level, self.free, found, &mut profile);
                    ready = ready | (found & solid);
                    seeking = seeking & !found;
                }
            }
        }
    }

    /// Readies lanes to walk from the cells that they have found.
    #[inline(always)]
    #[allow(clippy::too_many_arguments)]
    fn arrive(
        &self,
        tile: &impl Tile,
        cell: [L::I; 2],
        level: u32,
        first: [L::I; 2],
        lanes: L::M,
        steps: &mut Steps<L>,
        profile: &mut Profile<L>,
    ) {
        let one = L::I::splat(1);
        let base = L::I::splat(level as i32);
        let side = L::I::splat((TILE_CELLS as i32 >> level) - 1);
        let mut from = [L::F::splat(0.0); 2];
        for axis in 0..2 {
            let ahead = self.lines.ahead[axis];
            let eye = L::I::splat(self.relief.eye_cell[axis]);
            let line = ((cell[axis] + ahead).shl(base) - eye).to_floats();
            steps.line[axis] = L::F::select(lanes, line, steps.line[axis]);
            let done = cell[axis] - first[axis];
            let rest = L::I::select(ahead.eq(one), side - done, done);
            steps.rest[axis] = L::I::select(lanes, rest, steps.rest[axis]);
            let corner = (cell[axis].shl(base) - eye).to_floats();
            let share = (self.lines.place(self.relief, axis, self.free) - corner)
                * L::F::splat(1.0 / (1u32 << level) as f32);
            from[axis] = share.max(L::F::splat(0.0)).min(L::F::splat(1.0));
            // On the line by which the cell was entered the share is known.
            let entry = (cell[axis] + one - ahead).shl(base);
            let on = self.lines.crossing(self.relief, axis, entry).eq(self.free);
            from[axis] = L::F::select(on, (one - ahead).to_floats(), from[axis]);
        }
        steps.post = L::I::select(lanes, post::<L>(cell), steps.post);
        steps.passed = L::I::select(lanes, L::I::splat(0), steps.passed);
        let (_, [sw, se, nw, ne]) = tile.corners::<L>(steps.post, lanes);
        // Exact on the edges: between two posts, as seen from either side.
        let low = sw + (se - sw) * from[0];
        let high = nw + (ne - nw) * from[0];
        let inner = low + (high - low) * from[1];
        let west = sw + (nw - sw) * from[1];
        let east = se + (ne - se) * from[1];
        let zero = L::F::splat(0.0);
        let full = L::F::splat(1.0);
        let value = L::F::select(from[1].eq(zero), low, inner);
        let value = L::F::select(from[1].eq(full), high, value);
        let value = L::F::select(from[0].eq(zero), west, value);
        let value = L::F::select(from[0].eq(full), east, value);
        profile.low = L::F::select(lanes, tile.height::<L>(value), profile.low);
    }

    /// Reads the ground of the cells that lanes have come to at `start`, but for its height
    /// there. Returns which have any.
    #[inline(always)]
    fn look(
        &mut self,
        tile: &impl Tile,
        steps: &mut Steps<L>,
        level: u32,
        start: L::F,
        lanes: L::M,
        profile: &mut Profile<L>,
    ) -> L::M {
        self.steps += u64::from(lanes.count());
        let (zero, one) = (L::F::splat(0.0), L::F::splat(1.0));
        let [eye_x, eye_y] = self.relief.eye_place.map(L::F::splat);
        let x = (steps.line[0] - eye_x) * self.lines.inverse[0];
        let y = (steps.line[1] - eye_y) * self.lines.inverse[1];
        steps.crossing[0] = L::F::select(lanes, x, steps.crossing[0]);
        steps.crossing[1] = L::F::select(lanes, y, steps.crossing[1]);
        let along_x = x.le(y);
        let end = x.min(y);
        let (solid, [sw, se, nw, ne]) = tile.corners::<L>(steps.post, lanes);
        // Where on the far edge: the share of the axis that is not crossed.
        let rate = L::F::select(along_x, self.lines.rate[1], self.lines.rate[0]);
        let eye = L::F::select(along_x, eye_y, eye_x);
        let line = L::F::select(along_x, steps.line[1], steps.line[0]);
        let [ahead_x, ahead_y] = self.lines.forward;
        let forward = L::M::select(along_x, ahead_y, ahead_x);
        let shrink = L::F::splat(1.0 / (1u32 << level) as f32);
        let share = (eye + end * rate - line) * shrink + L::F::select(forward, one, zero);
        let share = share.max(zero).min(one);
        let east = [L::F::select(ahead_x, se, sw), L::F::select(ahead_x, ne, nw)];
        let north = [L::F::select(ahead_y, nw, sw), L::F::select(ahead_y, ne, se)];
        let near = L::F::select(along_x, east[0], north[0]);
        let far = L::F::select(along_x, east[1], north[1]);
        let high = tile.height::<L>(near + (far - near) * share);
        let length = (end - start) * shrink;
        let twist = tile.scale::<L>((ne - nw) - (se - sw));
        let curl = twist * (length * self.lines.rate[0]) * (length * self.lines.rate[1]);
        profile.start = L::F::select(lanes, start, profile.start);
        profile.end = L::F::select(lanes, end, profile.end);
        profile.high = L::F::select(lanes, high, profile.high);
        profile.curl = L::F::select(lanes, curl, profile.curl);
        solid & lanes
    }
}

/// A tile as kernels read it; heights are over the camera.
trait Tile {
    /// Highest ground of blocks, 0 being the first block of their level; level from 1.
    fn maximum<L: Lanes>(&self, at: L::I, lanes: L::M) -> L::F;
    /// Posts at and east of, and north of both, a place in the tile, in units of the
    /// tile; and whether all four are there.
    fn corners<L: Lanes>(&self, at: L::I, lanes: L::M) -> (L::M, [L::F; 4]);
    /// Height of a value between posts, metres over the camera.
    fn height<L: Lanes>(&self, value: L::F) -> L::F;
    /// A difference of values in metres.
    fn scale<L: Lanes>(&self, difference: L::F) -> L::F;
}

/// A tile of codes.
struct Coded<'a> {
    posts: &'a [u16],
    maxima: &'a [u16],
    base: f32,
    step: f32,
}

/// A tile of heights as they are, as bits.
struct Plain<'a> {
    posts: &'a [u32],
    maxima: &'a [u32],
    /// Height of the camera, in two parts.
    eye: [f32; 2],
}

impl<'a> Coded<'a> {
    fn new(codes: Codes<'a>, eye_z: f64) -> Self {
        Coded {
            posts: codes.posts,
            maxima: codes.maxima,
            base: (f64::from(codes.base) * codes.step - eye_z) as f32,
            step: codes.step as f32,
        }
    }
}

impl Tile for Coded<'_> {
    #[inline(always)]
    fn maximum<L: Lanes>(&self, at: L::I, lanes: L::M) -> L::F {
        let code = L::I::gather_pairs(self.maxima, at, lanes) & L::I::splat(0xFFFF);
        self.height::<L>(code.to_floats())
    }

    #[inline(always)]
    fn corners<L: Lanes>(&self, at: L::I, lanes: L::M) -> (L::M, [L::F; 4]) {
        let width = L::I::splat(TILE_POSTS as i32);
        let south = L::I::gather_pairs(self.posts, at, lanes);
        let north = L::I::gather_pairs(self.posts, at + width, lanes);
        let (low, sixteen) = (L::I::splat(0xFFFF), L::I::splat(16));
        let (sw, se) = (south & low, south.shr(sixteen) & low);
        let (nw, ne) = (north & low, north.shr(sixteen) & low);
        let highest = sw.max(se).max(nw.max(ne));
        let values = [sw.to_floats(), se.to_floats(), nw.to_floats(), ne.to_floats()];
        (highest.lt(L::I::splat(i32::from(VOID))), values)
    }

    #[inline(always)]
    fn height<L: Lanes>(&self, value: L::F) -> L::F {
        L::F::splat(self.base) + value * L::F::splat(self.step)
    }

    #[inline(always)]
    fn scale<L: Lanes>(&self, difference: L::F) -> L::F {
        difference * L::F::splat(self.step)
    }
}

impl<'a> Plain<'a> {
    fn new(floats: Floats32<'a>, eye_z: f64) -> Self {
        let high = eye_z as f32;
        Plain {
            posts: as_bits(floats.posts),
            maxima: as_bits(floats.maxima),
            eye: [high, (eye_z - f64::from(high)) as f32],
        }
    }

    #[inline(always)]
    fn read<L: Lanes>(&self, table: &[u32], at: L::I, lanes: L::M) -> L::F {
        let height = L::F::from_bits(L::I::gather(table, at, lanes));
        height - L::F::splat(self.eye[0]) - L::F::splat(self.eye[1])
    }
}

impl Tile for Plain<'_> {
    #[inline(always)]
    fn maximum<L: Lanes>(&self, at: L::I, lanes: L::M) -> L::F {
        self.read::<L>(self.maxima, at, lanes)
    }

    #[inline(always)]
    fn corners<L: Lanes>(&self, at: L::I, lanes: L::M) -> (L::M, [L::F; 4]) {
        let one = L::I::splat(1);
        let north = at + L::I::splat(TILE_POSTS as i32);
        let sw = self.read::<L>(self.posts, at, lanes);
        let se = self.read::<L>(self.posts, at + one, lanes);
        let nw = self.read::<L>(self.posts, north, lanes);
        let ne = self.read::<L>(self.posts, north + one, lanes);
        // A void is NaN, and so is the sum.
        let sum = sw + se + nw + ne;
        (sum.le(sum), [sw, se, nw, ne])
    }

    #[inline(always)]
    fn height<L: Lanes>(&self, value: L::F) -> L::F {
        value
    }

    #[inline(always)]
    fn scale<L: Lanes>(&self, difference: L::F) -> L::F {
        difference
    }
}

/// Floats as the bits that they are.
pub(crate) fn as_bits(values: &[f32]) -> &[u32] {
    // SAFETY: u32 has the size and alignment of f32, and every bit pattern is a u32.
    unsafe { std::slice::from_raw_parts(values.as_ptr().cast(), values.len()) }
}

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
