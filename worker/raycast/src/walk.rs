//! N rays over the level-of-detail surface, each along its own line on the map.
//!
//! A line has a direction on the map and rays that are numbered as they rise. A point of the
//! ground over it is held by the ray through it, which is a number between the whole ones,
//! and by one over its depth; over the Earth, whose rays are straight, from the height at
//! which it appears (`lines`). So a ray meets the ground at the first point whose number is
//! no lower than its own (`profile`), and all rays up to that number are answered at once.
//!
//! Lanes walk on their own, from cell to cell, and past blocks of cells whose maximum
//! they clear, as `exact` does. A lane remembers the cell where its last ray ended, with
//! the ground along its line there. A ray of the same line that rises more steeply meets
//! nothing before that cell (Cohen-Or et al., section 2), so it begins there.
//!
//! **What is found depends on the line and the slope alone**, not on where the lane began:
//! where a line crosses the grid is one expression, a cell's answer depends on nothing but
//! the cell, and a block is passed only with more room than all rounding takes.

mod answers;
mod lines;
mod profile;
mod rows;
mod soils;

pub(crate) use lines::{Lines, Slopes};
pub(crate) use rows::{Places, Rows};
pub(crate) use soils::{maximum, post};

use crate::lanes::{Floats, Ints, Lanes, MOST, Mask};
use crate::relief::{Relief, Soil};
use profile::{Cuts, Profile, Stretch};
use soils::Soils;
use terrafarm_terrain::tile::MAXIMA_LEVELS;

/// How far above a block's maximum a ray must stay to pass it: metres, and a share of its
/// height over or under the camera. Rounding is an eighth of that; what rounding adds to the
/// ray itself comes on top.
const CLEARANCE_M: f32 = 0.02;
const CLEARANCE_SHARE: f32 = 2e-6;
/// The plot of lanes that have left the layer.
const NOWHERE: i32 = -1;
/// Rounds of which one each is for the lanes that seek, that walk and that come to a plot,
/// however few.
const TURNS: u32 = 8;
/// How many cells ahead posts are asked for; twice as many is no better.
const AHEAD: f32 = 4.0;
/// Cells that a ray passes one by one before it looks at blocks of them. Measured at the
/// views of `bench core`.
const PATIENCE: i32 = 6;

/// How fine the ground is looked at.
#[derive(Clone, Copy)]
pub(crate) struct Fineness {
    /// Vertical distance that may be between the ground and straight lines, metres for each
    /// metre away.
    pub straight: f32,
    /// Distance between rays, metres for each metre of depth. The last bits of an answer's `b`
    /// (see [`Places`]) are [`crate::column::WHOLE`] if no post of the tile is void, and
    /// [`crate::column::TOLD`] if besides posts are further apart where it lies. With 0 for the
    /// distance they are not.
    pub apart: f32,
}

/// N lanes: their lines and rays, and where each is.
pub(crate) struct Walk<'r, 'a, L: Lanes> {
    relief: &'r Relief<'a>,
    lines: Lines<L>,
    rows: Rows<L>,
    places: Places<L>,
    /// The ray that each lane casts.
    ray: L::F,
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
    /// Height over the camera where the cell ends, and the vertices inside.
    height: L::F,
    cuts: Cuts<L>,
    stretch: Stretch<L>,
    fineness: Fineness,
    /// Lanes whose ray meets the stretch, and lanes with more vertices in their cell.
    ready: L::M,
    split: L::M,
    /// Lanes whose cell reaches beyond the layer.
    beyond: L::M,
    /// A tile was missing on the way.
    unsure: L::M,
    /// Blocks and cells looked at.
    pub looked: u64,
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
    /// What to add to it to come to the next post along y.
    row: L::I,
    /// What to add to it to come to a post about [`AHEAD`] cells further on.
    ahead: L::I,
    /// Cells passed since the last hit.
    passed: L::I,
}

impl<'r, 'a, L: Lanes> Walk<'r, 'a, L> {
    /// Lanes where their lines come over the layer, or at `free` if that is later.
    #[inline(always)]
    pub(crate) fn new(
        relief: &'r Relief<'a>,
        lines: Lines<L>,
        rows: Rows<L>,
        places: Places<L>,
        free: L::F,
        block: i32,
        fineness: Fineness,
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
        let ray = L::F::splat(rows.first as f32);
        let none = L::F::splat(0.0);
        Walk {
            relief,
            lines,
            rows,
            places,
            ray,
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
                row: zero,
                ahead: zero,
                passed: zero,
            },
            height: none,
            cuts: Cuts::new(),
            stretch: Stretch::new(),
            fineness,
            ready: L::M::none(),
            split: L::M::none(),
            beyond: L::M::none(),
            unsure: L::M::none(),
            looked: 0,
        }
    }

    /// Casts all rays. The answers go to their places in `met`: NaN where a missing tile
    /// leaves them open, and 0 for rays that meet nothing.
    ///
    /// Rays that meet the ground before their lanes are answered, all that do. Then lanes
    /// go on to the next cell, or look for it among blocks of cells: what most wait for.
    #[inline(always)]
    pub(crate) fn run(&mut self, met: &mut [f32]) {
        let nowhere = L::I::splat(NOWHERE);
        // Apart from the rest, which is to stay in registers.
        let mut soil = Soils::new(self.relief.eye_z);
        let mut left = !self.plot.eq(nowhere);
        let mut entering = left;
        let mut seeking = L::M::none();
        let mut turn = 0;
        loop {
            loop {
                if self.ready.any() {
                    self.answer(&soil, met);
                }
                if !self.split.any() {
                    break;
                }
                self.go_on();
            }
            left = left & !self.plot.eq(nowhere);
            entering = entering & left;
            if !left.any() {
                break;
            }
            let walking = left & !seeking & !entering;
            let (b, c, e) = (walking.count(), seeking.count(), entering.count());
            // Now and then it is the turn of the few, or they would starve.
            turn = (turn + 1) % TURNS;
            let to_enter = e > 0 && (turn == 2 || e > b.max(c));
            let to_seek = c > 0 && (turn == 0 || c > b);
            if to_enter {
                let inside = self.enter(&mut soil, entering);
                seeking = seeking | inside;
                entering = entering & !inside;
            } else if to_seek {
                let found = self.seek(&soil, seeking, &mut entering);
                seeking = seeking & !found & !entering;
            } else if b > 0 {
                let tired = self.advance(&soil, walking, &mut entering);
                seeking = seeking | tired;
            }
        }
        let none = L::F::splat(0.0);
        let rest = self.ray.le(self.rows.last());
        let open = L::F::select(self.unsure, L::F::splat(f32::NAN), none);
        self.put(met, [open, none], rest);
    }

    /// Takes lanes to the next vertices within their cells.
    #[inline(always)]
    fn go_on(&mut self) {
        let lanes = self.split;
        let (split, [s, height]) = self.cuts.go_on(lanes);
        self.stretch.reach(self.relief, &self.rows, s, height, lanes);
        self.ready = lanes & self.stretch.is_met(self.ray);
        self.split = split;
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
            match &plot.ground {
                Soil::Loaded(loaded) => {
                    inside |= 1 << lane;
                    let spacing = self.relief.spacing[0].min(self.relief.spacing[1]) as f32;
                    soil.set(lane, loaded, plot.level, self.fineness.apart / spacing);
                }
                Soil::Void => {}
                Soil::Absent => unsure |= 1 << lane,
            }
        }
        self.unsure = self.unsure | L::M::from_bits(unsure);
        let inside = L::M::from_bits(inside);
        self.steps.row = soil.row::<L>(self.lines.forward[1]);
        let [x, y] = self.lines.rate;
        let whole = x.abs() + y.abs();
        let far = L::F::splat(AHEAD).div(whole);
        let [x, y] = [(x * far).truncate(), (y * far).truncate()];
        self.steps.ahead = x + y.times(L::I::load(&soil.row));
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

    /// Takes lanes to their next cells. Returns those that are to seek; those that leave
    /// their plot are added to `entering`.
    #[inline(always)]
    fn advance(&mut self, soil: &Soils, walking: L::M, entering: &mut L::M) -> L::M {
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
        let next = steps.post + L::I::select(along_x, self.lines.next, steps.row);
        steps.post = L::I::select(walking, next, steps.post);
        steps.passed = L::I::select(walking, steps.passed + one, steps.passed);
        let ahead = steps.post + steps.ahead;
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
        if self.fineness.apart > 0.0 {
            soil.expect_post::<L>(ahead, going);
        }
        self.look(soil, s, self.height, going);
        tired
    }

    /// Looks for the next cells of lanes among blocks of cells. Returns those that have
    /// found one; those that leave their plot are added to `entering`.
    #[inline(always)]
    fn seek(&mut self, soil: &Soils, seeking: L::M, entering: &mut L::M) -> L::M {
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
        let (tangent, rounded) = self.rows.tangent(self.ray);
        let slopes = Slopes::<L>::new(self.relief, tangent);
        let lowest = slopes.height(self.free).min(slopes.height(out))
            - L::F::splat(0.25) * slopes.bend(out - self.free, out);
        let room = L::F::splat(CLEARANCE_M) + lowest.abs() * L::F::splat(CLEARANCE_SHARE);
        let room = room + rounded * out;
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
        if self.fineness.apart > 0.0 {
            self.expect(soil, seeking & !found);
        }
        if found.any() {
            let (start, low) = self.arrive(soil, found);
            self.look(soil, start, low, found);
        }
        found
    }

    /// Asks for what lanes will look at when they seek next.
    #[inline(always)]
    fn expect(&self, soil: &Soils, lanes: L::M) {
        let within = [self.cell[0].shr(self.block), self.cell[1].shr(self.block)];
        let found = self.block.eq(L::I::splat(0));
        soil.expect_maximum::<L>(maximum::<L>(within, self.block), lanes & !found);
        soil.expect_post::<L>(soil.post::<L>(self.cell), lanes & found);
    }

    /// Readies lanes to walk from the cells that they have found. Returns where their lines
    /// enter these, not where the ray is free from, or the answer would depend on that; and
    /// the height there.
    #[inline(always)]
    fn arrive(&mut self, soil: &Soils, lanes: L::M) -> (L::F, L::F) {
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
        self.steps.post = L::I::select(lanes, soil.post::<L>(self.cell), self.steps.post);
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
        self.stretch.begin(self.relief, &self.rows, start, value, lanes);
        (start, value)
    }

    /// Reads the ground of the cells that lanes have come to at `start`, where its height is
    /// `low`, and takes them to their next vertices.
    #[inline(always)]
    fn look(&mut self, soil: &Soils, start: L::F, low: L::F, lanes: L::M) {
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
        self.height = L::F::select(lanes, high, self.height);
        let solid = solid & lanes;
        self.beyond = self.lines.leave.lt(end);
        let cell = Profile { start, end, low, high, curl };
        let straight = self.fineness.straight;
        let (split, [s, height]) = self.cuts.begin(self.relief, straight, cell, solid);
        self.split = split;
        self.stretch.reach(self.relief, &self.rows, s, height, lanes);
        self.ready = solid & self.stretch.is_met(self.ray);
    }
}
