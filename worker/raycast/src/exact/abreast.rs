//! Rays abreast: the walk of `exact`, a ray a lane.
//!
//! ```text
//! for some hundred rays at a time, but for those whose beam meets nothing
//!   direction, stretch, span, where the walk begins
//!   in f32, down to planes over the ground (`glide`)
//!   in f32, while it is seen that the ray clears its cell or block: go on (`approach`)
//!   test the cells in which that has ended: nearly all meet the surface there
//! walk, for the others, from behind these cells on
//!   lanes that are done take the next rays of the list
//!   if most lanes are at a block
//!     those pass it or go one level down
//!   else
//!     those at a cell test it; they stop at a contact or go to the next cell
//! ```
//!
//! Every operation that bears on a contact is that of the slow twin (`exact`, `cell`,
//! `grid`, `path`), in the same order, on the same numbers: so are the bits.
//!
//! What else differs costs time at most. A contact is the first in the order of the cells,
//! and each cell's answer depends on the ray and the cell alone; so a walk may come to
//! any number of cells too early, but must leave out none that the twin tests.
//!
//! - Blocks are passed by the twin's comparison, with its clearance.
//! - Behind a block the twin finds the cell at `u` by comparing with both of its lines.
//!   Here the position is moved back by `slack` instead. Where lines are crossed is
//!   `(line - start) * (1 / rate)`, the position `start + u * rate`: five roundings, each
//!   of at most 2^-53 of `1 + |start| + cells`, of which `slack` is 32. So the cell is the
//!   twin's or the one before, whose exit is at or before `u`: tested, it has nothing to
//!   hit after the first of the course or was known to be free; passed, it leads on. No
//!   walk goes back behind a cell that it has reached, so it ends.
//! - There are no levels above a tile.
//!
//! Left to the twin are rays along the lines of the grid, and rays that come to a tile
//! which is not loaded, from their start on.

mod approach;
mod glide;
mod walk;

use super::arc::{Globe, Rise};
use super::rays::{Part, Rays, Verdict};
use super::tiles::Tiles;
use crate::lanes::{Doubles, Floats, Ints, Kernel, Lanes, MOST, Mask};
use crate::painter::ROUNDING;
use crate::path::{FLAT_REACH_M, REACH_RAD};
use approach::Approach;
use terrafarm_common::camera::Camera;
use walk::Walk;

/// The share of lanes that must be done before they take new rays: one in so many.
const IDLE_SHARE: usize = 4;
/// Steps from cell to cell before blocks are tried: approaches begin close to the ground,
/// and a step that looks at both costs nearly twice as much.
const CELLS_FIRST: u32 = 8;
/// Steps after which an approach ends when few lanes of its vector are left: the walk packs
/// them with others.
const LONG: u32 = CELLS_FIRST + 10;
/// One lane of so many, or fewer, are few.
const FEW: usize = 5;
/// Vectors of rays that are aimed before any of them is stepped: few enough for the nearest
/// cache.
const FLEET: usize = 16;

/// What all rays have in common.
#[derive(Clone, Copy)]
pub(super) struct Sight<'a> {
    pub camera: &'a Camera,
    /// `None` for flat ground.
    pub globe: Option<Globe>,
    /// The camera, in cells from post (0, 0).
    pub start: [f64; 2],
    /// What rounding may add to positions along x and y, cells.
    pub slack: [f64; 2],
    /// Cells per metre.
    pub scale: [f64; 2],
    pub cells: [i32; 2],
    /// Highest height of the terrain, metres.
    pub highest: f64,
    /// How far the terrain is from height 0 at most, metres.
    pub largest: f64,
}

/// Where rays are at the start of their approach.
struct Start<L: Lanes> {
    begin: L::D,
    last: L::D,
    rate: [L::D; 2],
    inverse: [L::D; 2],
    z: L::D,
    /// Rise for each unit of u.
    fall: L::D,
}

/// The first so many lanes, at most all.
#[inline(always)]
fn lanes_up_to<L: Lanes>(count: usize) -> L::M {
    if count < L::N { L::M::from_bits((1 << count) - 1) } else { !L::M::none() }
}

/// What became of a list of rays.
pub(super) struct Tally {
    /// Blocks and cells looked at.
    pub steps: u64,
    /// Rays that met the surface.
    pub hits: u64,
    /// Whether rays are left to the slow twin.
    pub any_open: bool,
}

/// Casts all rays of a list.
pub(super) struct Abreast<'r, 'a> {
    pub sight: Sight<'a>,
    pub tiles: &'r mut Tiles<'a>,
    pub rays: &'r mut Rays,
    /// Those that the walk takes.
    pub rest: &'r mut Rays,
}

impl Kernel for Abreast<'_, '_> {
    type Output = Tally;

    #[inline(always)]
    fn run<L: Lanes>(mut self) -> Tally {
        let steps = match self.sight.globe {
            None => {
                let steps = self.begin::<L, false>();
                steps + self.walk::<L, false>()
            }
            Some(_) => {
                let steps = self.begin::<L, true>();
                steps + self.walk::<L, true>()
            }
        };
        let (hits, any_open) = self.measure::<L>();
        Tally { steps, hits, any_open }
    }
}

impl Abreast<'_, '_> {
    /// Brings rays to the first cell that they may hit, or close to it, some at a time. What
    /// does not hit there is left for the walk. Those whose beam meets nothing have missed.
    #[inline(always)]
    fn begin<L: Lanes, const ROUND: bool>(&mut self) -> u64 {
        self.rest.count = 0;
        let count = self.rays.count;
        let mut steps = 0;
        let mut fleet = [Approach::<L>::none(); FLEET];
        let mut under_way = [0; FLEET];
        let mut from = 0;
        while from < count {
            let to = count.min(from + FLEET * L::N);
            let mut left = 0;
            for n in 0..FLEET {
                let at = from + n * L::N;
                if at >= to {
                    break;
                }
                let lanes = lanes_up_to::<L>(to - at);
                let free = self.load::<L>(Part::Depth, at);
                if (lanes & free.lt(L::D::splat(f64::INFINITY))).any() {
                    let approach = &mut fleet[n];
                    self.aim_at::<L, ROUND>(at, lanes, approach);
                    approach.glide(&self.sight, self.tiles);
                    if approach.active.any() {
                        approach.reach_nearby(self.tiles);
                        under_way[left] = n;
                        left += 1;
                    }
                } else {
                    L::I::splat(Verdict::Miss as i32).store(&mut self.rays.verdicts[at..]);
                    L::D::splat(f64::NEG_INFINITY).store(&mut self.rays.part_mut(Part::Last)[at..]);
                }
            }
            let mut turn = 0;
            while left > 0 {
                let few = if turn < LONG { 0 } else { L::N / FEW };
                let mut kept = 0;
                for n in 0..left {
                    let number = under_way[n];
                    let approach = &mut fleet[number];
                    steps += if turn < CELLS_FIRST {
                        approach.step_cells(self.tiles)
                    } else {
                        approach.step(&self.sight, self.tiles)
                    };
                    under_way[kept] = number;
                    kept += usize::from(approach.active.count() as usize > few);
                }
                left = kept;
                turn += 1;
            }
            for (n, approach) in fleet.iter().enumerate() {
                let at = from + n * L::N;
                if at < to {
                    self.touch_at::<L, ROUND>(at, approach, lanes_up_to::<L>(to - at));
                }
            }
            from = to;
        }
        let count = self.rest.count;
        self.rest.part_mut(Part::Last)[count..count + MOST].fill(f64::NEG_INFINITY);
        steps
    }

    /// Unit directions of N rays, and the parameters up to which they are free.
    #[inline(always)]
    fn directions<L: Lanes>(&self, at: usize) -> ([L::D; 3], L::D) {
        let camera = self.sight.camera;
        let (width, height) = (f64::from(camera.width), f64::from(camera.height));
        let scale = L::D::splat(2.0 * camera.tan_half_hfov / width);
        let across = (self.load::<L>(Part::PlaceX, at) - L::D::splat(0.5 * width)) * scale;
        let upward = (L::D::splat(0.5 * height) - self.load::<L>(Part::PlaceY, at)) * scale;
        let mut direction = [across; 3];
        for axis in 0..3 {
            direction[axis] = L::D::splat(camera.forward[axis])
                + L::D::splat(camera.right[axis]) * across
                + L::D::splat(camera.up[axis]) * upward;
        }
        let [x, y, z] = direction;
        let length = (x * x + y * y + z * z).sqrt();
        let free = self.load::<L>(Part::Depth, at) * (length * L::D::splat(1.0 - ROUNDING));
        ([x.div(length), y.div(length), z.div(length)], free)
    }

    #[inline(always)]
    fn aim_at<L: Lanes, const ROUND: bool>(
        &mut self,
        at: usize,
        lanes: L::M,
        approach: &mut Approach<L>,
    ) {
        let sight = self.sight;
        let ([x, y, up], free) = self.directions::<L>(at);
        let across = x * x + y * y;
        let rise = Rise { across, up };
        let eye_z = sight.camera.position.z;
        let mut exit = L::D::splat(FLAT_REACH_M);
        if let (true, Some(globe)) = (ROUND, sight.globe) {
            let radius = 1.0 / globe.curvature;
            let arc = L::D::splat(REACH_RAD * radius).div(across.sqrt());
            let down = L::D::splat(0.5 * radius + 2.0 * eye_z.abs());
            let rises = L::D::splat(0.0).lt(up);
            exit = arc.min(L::D::select(rises, L::D::splat(0.5 * radius), down));
        }
        let mut enter = L::D::splat(0.0);
        let mut open = L::M::none();
        let (mut rate, mut inverse) = ([x, y], [x, y]);
        for axis in 0..2 {
            rate[axis] = [x, y][axis] * L::D::splat(sight.scale[axis]);
            inverse[axis] = L::D::splat(1.0).div(rate[axis]);
            open = open | !inverse[axis].abs().lt(L::D::splat(f64::INFINITY));
            let count = f64::from(sight.cells[axis]);
            let first = L::D::splat(0.0 - sight.start[axis]) * inverse[axis];
            let second = L::D::splat(count - sight.start[axis]) * inverse[axis];
            enter = enter.max(first.min(second));
            exit = exit.min(first.max(second));
        }
        let begin = enter.max(free);
        let mut over = enter.lt(exit) & free.lt(exit);
        let (mut first, mut last) = (enter, exit);
        let (z, fall);
        if let (true, Some(globe)) = (ROUND, sight.globe) {
            let (spans, uncountable) = globe.spans_at::<L>(&rise, begin);
            open = open | uncountable;
            z = spans.z(begin);
            let since = begin - spans.start_u;
            fall = spans.slope + (since + since) * spans.bend;
            first = first.max(spans.start_u);
            last = last.min(spans.end_u);
            let away =
                L::D::splat(sight.highest).lt(spans.start_z) & L::D::splat(0.0).le(spans.slope);
            over = over & !away;
            self.store::<L>(Part::Across, at, across);
            self.store::<L>(Part::End, at, exit);
            self.store::<L>(Part::Number, at, spans.number);
            self.store::<L>(Part::StartU, at, spans.start_u);
            self.store::<L>(Part::EndU, at, spans.end_u);
            self.store::<L>(Part::StartZ, at, spans.start_z);
            self.store::<L>(Part::EndZ, at, spans.end_z);
            self.store::<L>(Part::Slope, at, spans.slope);
            self.store::<L>(Part::Bend, at, spans.bend);
        } else {
            // Turns -0 into 0, as adding the missing bend does.
            let slope = up + L::D::splat(0.0);
            z = L::D::splat(eye_z) + begin * slope;
            fall = slope;
            if eye_z > sight.highest {
                over = over & up.lt(L::D::splat(0.0));
            }
            self.store::<L>(Part::Slope, at, slope);
        }
        last = L::D::select(over & !open, last, L::D::splat(f64::NEG_INFINITY));
        self.store::<L>(Part::DirectionX, at, x);
        self.store::<L>(Part::DirectionY, at, y);
        self.store::<L>(Part::DirectionZ, at, up);
        self.store::<L>(Part::U, at, begin);
        self.store::<L>(Part::Z, at, z);
        self.store::<L>(Part::RateX, at, rate[0]);
        self.store::<L>(Part::RateY, at, rate[1]);
        self.store::<L>(Part::InverseX, at, inverse[0]);
        self.store::<L>(Part::InverseY, at, inverse[1]);
        self.store::<L>(Part::First, at, first);
        self.store::<L>(Part::Last, at, last);
        let (open_code, miss) =
            (L::I::splat(Verdict::Open as i32), L::I::splat(Verdict::Miss as i32));
        L::I::select(open, open_code, miss).store(&mut self.rays.verdicts[at..]);
        let start = Start { begin, last, rate, inverse, z, fall };
        approach.begin(&sight, &start, lanes);
    }

    /// Tests the cells in which the approaches have ended; rays that meet nothing there are
    /// left for the walk.
    #[inline(always)]
    fn touch_at<L: Lanes, const ROUND: bool>(
        &mut self,
        at: usize,
        approach: &Approach<L>,
        lanes: L::M,
    ) {
        let (sight, cell) = (self.sight, approach.cell());
        let mut walk = Walk::<L>::new();
        walk.load::<ROUND>(self.rays, at, cell);
        let begin = self.load::<L>(Part::U, at);
        let lanes = lanes & begin.lt(walk.last);
        if !lanes.any() {
            return;
        }
        let u = begin.max(walk.entry(&sight));
        let near = lanes & u.lt(walk.last);
        let (hits, absent, hit_u, hit_z) = {
            let held = approach.nearby.corners(cell, near);
            walk.contacts::<ROUND>(&sight, self.tiles, near, held)
        };
        let left = lanes & !hits;
        self.store::<L>(Part::U, at, L::D::select(hits, hit_u, L::D::select(near, u, begin)));
        self.store::<L>(Part::Z, at, hit_z);
        cell[0].store(&mut self.rays.cells[0][at..]);
        cell[1].store(&mut self.rays.cells[1][at..]);
        let before = L::I::load(&self.rays.verdicts[at..]);
        let verdicts = L::I::select(hits, L::I::splat(Verdict::Hit as i32), before);
        verdicts.store(&mut self.rays.verdicts[at..]);
        if left.any() {
            self.leave::<L, ROUND>(at, walk, left, near, absent);
        }
    }

    /// Leaves rays for the walk: behind the cells that were tested, where these were loaded
    /// and the course goes on.
    #[inline(always)]
    fn leave<L: Lanes, const ROUND: bool>(
        &mut self,
        at: usize,
        mut walk: Walk<L>,
        left: L::M,
        near: L::M,
        absent: L::M,
    ) {
        let sight = self.sight;
        walk.u = self.load::<L>(Part::U, at);
        walk.z = walk.z::<ROUND>(&sight, walk.u);
        let exits = walk.exits::<ROUND>(&sight);
        // A course that ends on the way goes on in another: from its start on.
        for axis in 0..2 {
            let first = walk.cell_at(&sight, axis, walk.u);
            walk.cell[axis] = L::I::select(near, walk.cell[axis], first);
        }
        walk.active = left;
        walk.pass::<ROUND>(&sight, &exits, left & near & !(absent | exits.ends));
        let z = L::D::select(left, walk.z, self.load::<L>(Part::Z, at));
        self.store::<L>(Part::U, at, walk.u);
        self.store::<L>(Part::Z, at, z);
        self.store::<L>(Part::CellX, at, L::D::from_ints(walk.cell[0]));
        self.store::<L>(Part::CellY, at, L::D::from_ints(walk.cell[1]));
        let mut bits = walk.active.bits();
        while bits != 0 {
            self.rest.take(self.rays, at + bits.trailing_zeros() as usize);
            bits &= bits - 1;
        }
    }

    #[inline(always)]
    fn load<L: Lanes>(&self, part: Part, at: usize) -> L::D {
        L::D::load(&self.rays.part(part)[at..])
    }

    #[inline(always)]
    fn store<L: Lanes>(&mut self, part: Part, at: usize, value: L::D) {
        value.store(&mut self.rays.part_mut(part)[at..]);
    }

    /// One over the depths of all contacts. Returns how many there are, and whether rays
    /// are left to the slow twin.
    #[inline(always)]
    fn measure<L: Lanes>(&mut self) -> (u64, bool) {
        let (mut count, mut open) = (0, L::M::none());
        let [x, y, z] = self.sight.camera.forward.to_array();
        let mut at = 0;
        while at < self.rays.count {
            let along_axis = self.load::<L>(Part::DirectionX, at) * L::D::splat(x)
                + self.load::<L>(Part::DirectionY, at) * L::D::splat(y)
                + self.load::<L>(Part::DirectionZ, at) * L::D::splat(z);
            let depth = self.load::<L>(Part::U, at) * along_axis;
            let verdicts = L::I::load(&self.rays.verdicts[at..]);
            let lanes = lanes_up_to::<L>(self.rays.count - at);
            let hits = lanes & verdicts.eq(L::I::splat(Verdict::Hit as i32));
            let inverse = L::D::splat(1.0).div(depth).to_floats();
            let seen = L::F::select(hits, inverse, L::F::splat(0.0));
            seen.store(&mut self.rays.inverse_depths[at..]);
            count += u64::from(hits.count());
            open = open | (lanes & verdicts.eq(L::I::splat(Verdict::Open as i32)));
            at += L::N;
        }
        (count, open.any())
    }

    /// Casts all rays, by two sets of lanes in turn: each takes a step while the other
    /// waits for the outcome of its own.
    #[inline(always)]
    fn walk<L: Lanes, const ROUND: bool>(&mut self) -> u64 {
        let mut walks = [Walk::<L>::new(), Walk::<L>::new()];
        let (mut taken, mut steps) = (0, 0);
        let mut left = true;
        while left {
            left = false;
            for walk in &mut walks {
                let idle = !walk.active;
                if taken < self.rest.count && idle.count() as usize * IDLE_SHARE >= L::N {
                    walk.refill::<ROUND>(self.rest, taken, idle);
                    taken += idle.count() as usize;
                }
                if walk.active.any() {
                    steps += self.step::<L, ROUND>(walk);
                    left = true;
                }
            }
            left |= taken < self.rest.count;
        }
        steps
    }

    /// Takes lanes that are at a block a step further, or those that are at a cell:
    /// whichever are more. Returns how many.
    #[inline(always)]
    fn step<L: Lanes, const ROUND: bool>(&mut self, walk: &mut Walk<L>) -> u64 {
        let (zero, one) = (L::I::splat(0), L::I::splat(1));
        let cells = walk.active & walk.level.eq(zero);
        let blocks = walk.active & !cells;
        let exits = walk.exits::<ROUND>(&self.sight);
        if cells.count() >= blocks.count() {
            let (hits, absent, u, z) = walk.contacts::<ROUND>(&self.sight, self.tiles, cells, None);
            if hits.any() {
                self.keep_hits(walk, hits, u, z);
            }
            if absent.any() {
                self.leave_open(walk, absent);
            }
            walk.active = walk.active & !(hits | absent);
            walk.pass::<ROUND>(&self.sight, &exits, cells & walk.active);
            u64::from(cells.count())
        } else {
            let (highest, absent) = self.tiles.maxima::<L>(walk.cell, walk.level, blocks);
            let clear = blocks & walk.clears::<ROUND>(&exits, highest);
            if absent.any() {
                self.leave_open(walk, absent);
                walk.active = walk.active & !absent;
            }
            let down = blocks & !clear;
            walk.level = L::I::select(down, walk.level - one, walk.level);
            let beside = walk.beside(&self.sight, &exits);
            walk.pass_beside::<ROUND>(&self.sight, &exits, clear & walk.active, beside);
            u64::from(blocks.count())
        }
    }

    /// Writes contacts down.
    #[inline(always)]
    fn keep_hits<L: Lanes>(&mut self, walk: &Walk<L>, hits: L::M, u: L::D, z: L::D) {
        let (mut us, mut zs) = ([0.0; MOST], [0.0; MOST]);
        let (mut xs, mut ys, mut numbers) = ([0; MOST], [0; MOST], [0; MOST]);
        u.store(&mut us);
        z.store(&mut zs);
        walk.cell[0].store(&mut xs);
        walk.cell[1].store(&mut ys);
        walk.ray.store(&mut numbers);
        let mut bits = hits.bits();
        while bits != 0 {
            let lane = bits.trailing_zeros() as usize % MOST;
            let ray = self.rest.origins[numbers[lane] as usize] as usize;
            self.rays.part_mut(Part::U)[ray] = us[lane];
            self.rays.part_mut(Part::Z)[ray] = zs[lane];
            self.rays.cells[0][ray] = xs[lane];
            self.rays.cells[1][ray] = ys[lane];
            self.rays.verdicts[ray] = Verdict::Hit as i32;
            bits &= bits - 1;
        }
    }

    /// Leaves rays to the slow twin.
    #[cold]
    fn leave_open<L: Lanes>(&mut self, walk: &Walk<L>, lanes: L::M) {
        let mut numbers = [0; MOST];
        walk.ray.store(&mut numbers);
        for (lane, &ray) in numbers.iter().enumerate().take(L::N) {
            if lanes.bits() >> lane & 1 == 1 {
                let ray = self.rest.origins[ray as usize] as usize;
                self.rays.verdicts[ray] = Verdict::Open as i32;
            }
        }
    }
}
