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
use terrafarm_terrain::tile::{HeightTile, Heights, MAXIMA_LEVELS, VOID};

/// How far above a block's maximum a ray must stay to pass it: metres, and a share of its
/// height over or under the camera. Rounding is an eighth of that.
const CLEARANCE_M: f32 = 0.02;
const CLEARANCE_SHARE: f32 = 2e-6;
/// The least part of a line's direction along an axis: what is less runs along the grid.
const ALONG_GRID: f32 = 1e-12;
/// The plot of lanes that have left the layer.
const NOWHERE: i32 = -1;
/// Rounds of which one each is for the lanes that seek, that walk and that come to a plot,
/// however few.
const TURNS: u32 = 8;
/// Cells that a ray passes one by one before it looks at blocks of them. Measured at the
/// views of `bench core`.
const PATIENCE: i32 = 6;

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
/// answer belongs at `at + n pitch`. The answer is the inverse depth: the ray's length
/// along the map, `length + d longer`, over the distance at which it meets the ground. Of
/// flat ground it is a plane over the picture.
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
    /// The ray that each lane casts, its slope, and its length along the map.
    row: L::I,
    slopes: Slopes<L>,
    across: L::F,
    /// The plot, or `NOWHERE` if the lane has left the layer or cast its last ray ...
    plot: L::I,
    /// ... and its column and row.
    corner: [L::I; 2],
    /// How far the ray is known to be free.
    free: L::F,
    /// The cell of the plot's level that a lane seeks from, and the block around it.
    cell: [L::I; 2],
    block: L::I,
    steps: Steps<L>,
    profile: Profile<L>,
    /// A tile was missing on the way.
    unsure: L::M,
    /// Blocks and cells looked at.
    pub looked: u64,
}

/// The tiles under the lanes.
struct Soils {
    posts: [*const u8; MOST],
    maxima: [*const u8; MOST],
    /// Bytes of a value.
    size: [i32; MOST],
    /// Height over the camera of value 0, and what a unit adds.
    base: [f32; MOST],
    step: [f32; MOST],
    /// Level of the plot, and one over the side of its cells in those of level 0.
    level: [i32; MOST],
    shrink: [f32; MOST],
    /// Lanes whose values are heights as they are.
    wide: u32,
    /// Height of the camera, in two parts.
    eye: [f32; 2],
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
    /// The slope of a ray, and its length along the map.
    #[inline(always)]
    fn ray(&self, relief: &Relief, row: L::I) -> (Slopes<L>, L::F) {
        let d = L::F::splat(self.first) + row.to_floats() * L::F::splat(self.step);
        let across = self.length + d * self.longer;
        (Slopes::new(relief, (self.rise + d * self.higher).div(across)), across)
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
        block: i32,
    ) -> Self {
        let free = lines.enter.max(free);
        let level = L::I::splat(MAXIMA_LEVELS as i32);
        let zero = L::I::splat(0);
        let last_column = L::I::splat(relief.plots[0] - 1);
        let column = lines.cell_after(relief, 0, free, level, zero, last_column);
        let last_row = L::I::splat(relief.plots[1] - 1);
        let row = lines.cell_after(relief, 1, free, level, zero, last_row);
        let plot = row.times(L::I::splat(relief.plots[0])) + column;
        let plot = L::I::select(free.lt(lines.leave), plot, L::I::splat(NOWHERE));
        let (slopes, across) = rows.ray(relief, zero);
        let none = L::F::splat(0.0);
        Walk {
            relief,
            lines,
            rows,
            row: zero,
            slopes,
            across,
            plot,
            corner: [column, row],
            free,
            cell: [zero; 2],
            block: L::I::splat(block),
            steps: Steps {
                line: [none; 2],
                crossing: [none; 2],
                rest: [zero; 2],
                post: zero,
                passed: zero,
            },
            profile: Profile { start: none, end: none, low: none, high: none, curl: none },
            unsure: L::M::none(),
            looked: 0,
        }
    }

    /// Casts all rays. The answers go to `met`: NaN where a missing tile leaves them open,
    /// and nothing for rays that meet nothing.
    ///
    /// A lane has a cell before it whose contact with its ray is to be found, or goes on to
    /// the next cell, or looks for it among blocks of cells. What most lanes wait for is
    /// done first.
    #[inline(always)]
    pub(crate) fn run(&mut self, met: &mut [f32]) {
        let nowhere = L::I::splat(NOWHERE);
        // Apart from the rest, which is to stay in registers.
        let mut soil = Soils::new(self.relief.eye_z);
        let mut left = !self.plot.eq(nowhere);
        let mut entering = left;
        let mut ready = L::M::none();
        let mut seeking = L::M::none();
        let mut turn = 0;
        loop {
            left = left & !self.plot.eq(nowhere);
            entering = entering & left;
            if !left.any() {
                break;
            }
            let walking = left & !ready & !seeking & !entering;
            let (a, b, c) = (ready.count(), walking.count(), seeking.count());
            let e = entering.count();
            // Now and then it is the turn of the few, or they would starve.
            turn = (turn + 1) % TURNS;
            let to_enter = e > 0 && (turn == 2 || e > a.max(b).max(c));
            let to_seek = c > 0 && (turn == 0 || c > a && c > b);
            let to_walk = b > 0 && (turn == 1 || b > a);
            if to_enter {
                let inside = self.enter(&mut soil, entering);
                seeking = seeking | inside;
                entering = entering & !inside;
            } else if to_seek {
                let (solid, found) = self.seek(&soil, seeking, &mut entering);
                ready = ready | solid;
                seeking = seeking & !found & !entering;
            } else if to_walk {
                let (solid, tired) = self.advance(&soil, walking, &mut entering);
                ready = ready | solid;
                seeking = seeking | tired;
            } else {
                let (hit, done) = self.contact(ready, met);
                left = left & !done;
                ready = hit & !done;
            }
        }
        while self.unsure.any() {
            self.emit(L::F::splat(f32::NAN), self.unsure, met);
            self.unsure = self.unsure & self.row.lt(L::I::splat(self.rows.count));
        }
    }

    /// Writes the answers of lanes; these go on with their next rays.
    #[inline(always)]
    fn emit(&mut self, answer: L::F, lanes: L::M, met: &mut [f32]) {
        let at = self.rows.at + self.row.times(L::I::splat(self.rows.pitch));
        let answer = L::F::select(self.unsure, L::F::splat(f32::NAN), answer);
        answer.scatter(met, at, lanes);
        let next = self.row + L::I::splat(1);
        self.row = L::I::select(lanes, next, self.row);
    }

    /// Finds the tiles of plots that lanes have come to. Returns the lanes that now seek in
    /// theirs; those of plots without a tile have gone on to the next plot.
    #[inline(always)]
    fn enter(&mut self, soil: &mut Soils, lanes: L::M) -> L::M {
        let mut plots = [NOWHERE; MOST];
        self.plot.store(&mut plots);
        let (mut bits, mut inside, mut unsure) = (lanes.bits(), 0, 0);
        while bits != 0 {
            let lane = bits.trailing_zeros() as usize % MOST;
            bits &= bits - 1;
            let plot = self.relief.plot(plots[lane]);
            match plot.ground {
                Soil::Tile(tile) => {
                    inside |= 1 << lane;
                    soil.set(lane, tile, plot.level);
                }
                Soil::Void => {}
                Soil::Absent => unsure |= 1 << lane,
            }
        }
        self.unsure = self.unsure | L::M::from_bits(unsure);
        let inside = L::M::from_bits(inside);
        let passing = lanes & !inside;
        if passing.any() {
            let level = L::I::splat(MAXIMA_LEVELS as i32);
            let (out, along_x) = self.exit(self.corner, level);
            self.enter_next(out, along_x, passing);
        }
        let level = L::I::load(&soil.level);
        let top = L::I::splat(MAXIMA_LEVELS as i32) - level;
        let first = self.first(top);
        let side = L::I::splat(1).shl(top) - L::I::splat(1);
        for axis in 0..2 {
            let (low, high) = (first[axis], first[axis] + side);
            let cell = self.lines.cell_after(self.relief, axis, self.free, level, low, high);
            self.cell[axis] = L::I::select(inside, cell, self.cell[axis]);
        }
        self.block = L::I::select(inside, self.block.min(top), self.block);
        inside
    }

    /// The first cells of the plots; `top` as below.
    #[inline(always)]
    fn first(&self, top: L::I) -> [L::I; 2] {
        [self.corner[0].shl(top), self.corner[1].shl(top)]
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
    fn enter_next(&mut self, s: L::F, along_x: L::M, lanes: L::M) {
        let (zero, one) = (L::I::splat(0), L::I::splat(1));
        let [ahead_x, ahead_y] = self.lines.ahead;
        let [x, y] = self.corner;
        let column = L::I::select(along_x, x + ahead_x + ahead_x - one, x);
        let row = L::I::select(along_x, y, y + ahead_y + ahead_y - one);
        let columns = L::I::splat(self.relief.plots[0]);
        let rows = L::I::splat(self.relief.plots[1]);
        let inside = !column.lt(zero) & column.lt(columns) & !row.lt(zero) & row.lt(rows);
        let inside = inside & s.lt(self.lines.leave);
        let number = row.times(columns) + column;
        let next = L::I::select(inside, number, L::I::splat(NOWHERE));
        self.plot = L::I::select(lanes, next, self.plot);
        self.corner[0] = L::I::select(lanes, column, x);
        self.corner[1] = L::I::select(lanes, row, y);
        self.free = L::F::select(lanes, s, self.free);
    }

    /// Finds the contacts of rays with the cells before them. Returns the lanes that have
    /// hit, and those of them that are done.
    #[inline(always)]
    fn contact(&mut self, ready: L::M, met: &mut [f32]) -> (L::M, L::M) {
        let (hit, s) = self.profile.contact(&self.slopes);
        let hit = hit & ready;
        let mut done = L::M::none();
        if hit.any() {
            let inside = hit & s.lt(self.lines.leave);
            self.emit(self.across.div(s), inside, met);
            (self.slopes, self.across) = self.rows.ray(self.relief, self.row);
            done = hit & !(inside & self.row.lt(L::I::splat(self.rows.count)));
            self.plot = L::I::select(done, L::I::splat(NOWHERE), self.plot);
            self.steps.passed = L::I::select(hit, L::I::splat(0), self.steps.passed);
        }
        (hit, done)
    }

    /// Takes lanes to their next cells. Returns those that stand before a cell with ground,
    /// and those that are to seek; those that leave their plot are added to `entering`.
    #[inline(always)]
    fn advance(&mut self, soil: &Soils, walking: L::M, entering: &mut L::M) -> (L::M, L::M) {
        let (zero, one) = (L::I::splat(0), L::I::splat(1));
        let steps = &mut self.steps;
        let along_x = steps.crossing[0].le(steps.crossing[1]);
        let s = steps.crossing[0].min(steps.crossing[1]);
        let (by_x, by_y) = (walking & along_x, walking & !along_x);
        let (rest_x, rest_y) = (steps.rest[0] - one, steps.rest[1] - one);
        let outside = (by_x & rest_x.lt(zero)) | (by_y & rest_y.lt(zero));
        let leaving = outside | (walking & !s.lt(self.lines.leave));
        steps.rest[0] = L::I::select(by_x, rest_x, steps.rest[0]);
        steps.rest[1] = L::I::select(by_y, rest_y, steps.rest[1]);
        let side = L::I::splat(1).shl(L::I::load(&soil.level)).to_floats();
        let line_x = steps.line[0] + self.lines.sign[0] * side;
        let line_y = steps.line[1] + self.lines.sign[1] * side;
        steps.line[0] = L::F::select(by_x, line_x, steps.line[0]);
        steps.line[1] = L::F::select(by_y, line_y, steps.line[1]);
        let next = steps.post + L::I::select(along_x, self.lines.next[0], self.lines.next[1]);
        steps.post = L::I::select(walking, next, steps.post);
        steps.passed = L::I::select(walking, steps.passed + one, steps.passed);
        let mut tired = walking & !leaving & L::I::splat(PATIENCE).lt(steps.passed);
        if (leaving | tired).any() {
            if leaving.any() {
                self.enter_next(s, along_x, leaving);
                *entering = *entering | leaving;
            }
            let top = L::I::splat(MAXIMA_LEVELS as i32) - L::I::load(&soil.level);
            tired = tired & zero.lt(top);
            let first = self.first(top);
            let side = one.shl(top) - one;
            for axis in 0..2 {
                let low = first[axis] + self.steps.rest[axis];
                let high = first[axis] + side - self.steps.rest[axis];
                let cell = L::I::select(self.lines.forward[axis], high, low);
                self.cell[axis] = L::I::select(tired, cell, self.cell[axis]);
            }
            self.free = L::F::select(tired, s, self.free);
            self.block = L::I::select(tired, one, self.block);
        }
        let going = walking & !leaving & !tired;
        let low = self.profile.high;
        let solid = self.look(soil, s, going);
        self.profile.low = L::F::select(going, low, self.profile.low);
        (solid, tired)
    }

    /// Looks for the next cells of lanes among blocks of cells. Returns those that stand
    /// before a cell with ground, and those that have found a cell; those that leave their
    /// plot are added to `entering`.
    #[inline(always)]
    fn seek(&mut self, soil: &Soils, seeking: L::M, entering: &mut L::M) -> (L::M, L::M) {
        let (zero, one) = (L::I::splat(0), L::I::splat(1));
        let (cell, block) = (self.cell, self.block);
        let level = L::I::load(&soil.level);
        let top = L::I::splat(MAXIMA_LEVELS as i32) - level;
        let within = [cell[0].shr(block), cell[1].shr(block)];
        let found = seeking & block.eq(zero);
        let blocks = seeking & !found;
        self.looked += u64::from(blocks.count());
        let (out, along_x) = self.exit(within, level + block);
        let highest = soil.maximum::<L>(maximum::<L>(within, block), blocks);
        let lowest = self.slopes.height(self.free).min(self.slopes.height(out))
            - L::F::splat(0.25) * self.slopes.bend(out - self.free, out);
        let room = L::F::splat(CLEARANCE_M) + lowest.abs() * L::F::splat(CLEARANCE_SHARE);
        let clear = blocks & (highest + room).lt(lowest);
        // The cell behind the line by which the block is left; beside it, the cell that the
        // line has come to within the block.
        let side = one.shl(block) - one;
        let (low_x, low_y) = (within[0].shl(block), within[1].shl(block));
        let [ahead_x, ahead_y] = self.lines.ahead;
        let behind_x = (within[0] + ahead_x).shl(block) - one + ahead_x;
        let behind_y = (within[1] + ahead_y).shl(block) - one + ahead_y;
        let (high_x, high_y) = (low_x + side, low_y + side);
        let beside_x = self.lines.cell_after(self.relief, 0, out, level, low_x, high_x);
        let beside_y = self.lines.cell_after(self.relief, 1, out, level, low_y, high_y);
        let next_x = L::I::select(along_x, behind_x, beside_x);
        let next_y = L::I::select(along_x, beside_y, behind_y);
        let before = L::I::select(along_x, cell[0], cell[1]);
        let after = L::I::select(along_x, next_x, next_y);
        let outside = !before.shr(top).eq(after.shr(top)) | !out.lt(self.lines.leave);
        let leaving = clear & outside;
        if leaving.any() {
            self.enter_next(out, along_x, leaving);
            *entering = *entering | leaving;
        }
        let moving = clear & !leaving;
        self.cell[0] = L::I::select(moving, next_x, cell[0]);
        self.cell[1] = L::I::select(moving, next_y, cell[1]);
        self.free = L::F::select(moving, out, self.free);
        let parent = block + one;
        let crossed = !before.shr(parent).eq(after.shr(parent)) & block.lt(top);
        let wider = L::I::select(leaving | (moving & crossed), parent, block);
        self.block = L::I::select(blocks & !clear, block - one, wider);
        let mut solid = L::M::none();
        if found.any() {
            let start = self.arrive(soil, found);
            solid = self.look(soil, start, found);
        }
        (solid, found)
    }

    /// Readies lanes to walk from the cells that they have found. Returns where their lines
    /// enter these: not where the ray is free from, or the answer would depend on that.
    #[inline(always)]
    fn arrive(&mut self, soil: &Soils, lanes: L::M) -> L::F {
        let one = L::I::splat(1);
        let level = L::I::load(&soil.level);
        let shrink = L::F::load(&soil.shrink);
        let top = L::I::splat(MAXIMA_LEVELS as i32) - level;
        let first = self.first(top);
        let side = one.shl(top) - one;
        let (none, full) = (L::F::splat(0.0), L::F::splat(1.0));
        let mut entries = [none; 2];
        for axis in 0..2 {
            let line = (self.cell[axis] + one - self.lines.ahead[axis]).shl(level);
            entries[axis] = self.lines.crossing(self.relief, axis, line);
        }
        let start = entries[0].max(entries[1]).max(self.lines.enter);
        let mut from = [none; 2];
        for axis in 0..2 {
            let cell = self.cell[axis];
            let ahead = self.lines.ahead[axis];
            let eye = L::I::splat(self.relief.eye_cell[axis]);
            let line = ((cell + ahead).shl(level) - eye).to_floats();
            self.steps.line[axis] = L::F::select(lanes, line, self.steps.line[axis]);
            let done = cell - first[axis];
            let rest = L::I::select(self.lines.forward[axis], side - done, done);
            self.steps.rest[axis] = L::I::select(lanes, rest, self.steps.rest[axis]);
            let corner = (cell.shl(level) - eye).to_floats();
            let share = (self.lines.place(self.relief, axis, start) - corner) * shrink;
            // On the line by which the cell was entered the share is known.
            let known = L::F::select(self.lines.forward[axis], none, full);
            let entry = entries[axis].eq(start);
            from[axis] = L::F::select(entry, known, share.max(none).min(full));
        }
        self.steps.post = L::I::select(lanes, post::<L>(self.cell), self.steps.post);
        self.steps.passed = L::I::select(lanes, L::I::splat(0), self.steps.passed);
        let (_, [sw, se, nw, ne]) = soil.corners::<L>(self.steps.post, lanes);
        // On an edge exactly what the cell on its other side has: between two posts.
        let low = sw + (se - sw) * from[0];
        let high = nw + (ne - nw) * from[0];
        let west = sw + (nw - sw) * from[1];
        let east = se + (ne - se) * from[1];
        let value = low + (high - low) * from[1];
        let value = L::F::select(from[1].eq(none), low, value);
        let value = L::F::select(from[1].eq(full), high, value);
        let value = L::F::select(from[0].eq(none), west, value);
        let value = L::F::select(from[0].eq(full), east, value);
        let value = soil.height::<L>(value);
        self.profile.low = L::F::select(lanes, value, self.profile.low);
        start
    }

    /// Reads the ground of the cells that lanes have come to at `start`, but for its height
    /// there. Returns which have any.
    #[inline(always)]
    fn look(&mut self, soil: &Soils, start: L::F, lanes: L::M) -> L::M {
        self.looked += u64::from(lanes.count());
        let (zero, one) = (L::F::splat(0.0), L::F::splat(1.0));
        let shrink = L::F::load(&soil.shrink);
        let eye_x = L::F::splat(self.relief.eye_place[0]);
        let eye_y = L::F::splat(self.relief.eye_place[1]);
        let steps = &mut self.steps;
        let x = (steps.line[0] - eye_x) * self.lines.inverse[0];
        let y = (steps.line[1] - eye_y) * self.lines.inverse[1];
        steps.crossing[0] = L::F::select(lanes, x, steps.crossing[0]);
        steps.crossing[1] = L::F::select(lanes, y, steps.crossing[1]);
        let along_x = x.le(y);
        let end = x.min(y);
        let (solid, [sw, se, nw, ne]) = soil.corners::<L>(steps.post, lanes);
        // Where on the far edge: the share of the axis that is not crossed.
        let rate = L::F::select(along_x, self.lines.rate[1], self.lines.rate[0]);
        let eye = L::F::select(along_x, eye_y, eye_x);
        let line = L::F::select(along_x, steps.line[1], steps.line[0]);
        let [ahead_x, ahead_y] = self.lines.forward;
        let forward = L::M::select(along_x, ahead_y, ahead_x);
        let share = (eye + end * rate - line) * shrink + L::F::select(forward, one, zero);
        let share = share.max(zero).min(one);
        let east = [L::F::select(ahead_x, se, sw), L::F::select(ahead_x, ne, nw)];
        let north = [L::F::select(ahead_y, nw, sw), L::F::select(ahead_y, ne, se)];
        let near = L::F::select(along_x, east[0], north[0]);
        let far = L::F::select(along_x, east[1], north[1]);
        let high = soil.height::<L>(near + (far - near) * share);
        let length = (end - start) * shrink;
        let twist = ((ne - nw) - (se - sw)) * L::F::load(&soil.step);
        let curl = twist * (length * self.lines.rate[0]) * (length * self.lines.rate[1]);
        let profile = &mut self.profile;
        profile.start = L::F::select(lanes, start, profile.start);
        profile.end = L::F::select(lanes, end, profile.end);
        profile.high = L::F::select(lanes, high, profile.high);
        profile.curl = L::F::select(lanes, curl, profile.curl);
        solid & lanes
    }
}

impl Soils {
    fn new(eye_z: f64) -> Self {
        let high = eye_z as f32;
        Soils {
            posts: [std::ptr::null(); MOST],
            maxima: [std::ptr::null(); MOST],
            size: [0; MOST],
            base: [0.0; MOST],
            step: [0.0; MOST],
            level: [0; MOST],
            shrink: [1.0; MOST],
            wide: 0,
            eye: [high, (eye_z - f64::from(high)) as f32],
        }
    }

    /// Puts a tile under a lane. The lane may be looked at as long as the tile lives.
    #[inline(always)]
    fn set(&mut self, lane: usize, tile: &HeightTile, level: u32) {
        self.level[lane] = level as i32;
        self.shrink[lane] = 1.0 / (1u32 << level) as f32;
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

    /// Height over the camera of values between posts.
    #[inline(always)]
    fn height<L: Lanes>(&self, value: L::F) -> L::F {
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
    fn maximum<L: Lanes>(&self, at: L::I, lanes: L::M) -> L::F {
        let value = self.read::<L>(&self.maxima, MAXIMA, at, lanes);
        self.height::<L>(value)
    }

    /// Posts at and east of, and north of both, a place in the tile, in the lanes' units;
    /// and whether all four are there.
    #[inline(always)]
    fn corners<L: Lanes>(&self, at: L::I, lanes: L::M) -> (L::M, [L::F; 4]) {
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
