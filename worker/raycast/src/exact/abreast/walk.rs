//! A vector of rays on their way over blocks and cells: a step of each kind.

use super::Sight;
use crate::exact::arc::{Rise, Spans};
use crate::exact::rays::{Part, Rays};
use crate::exact::tiles::{Corners, Tiles};
use crate::exact::{CLEARANCE_M, FIRST_LEVEL};
use crate::lanes::{Doubles, Ints, Lanes, MOST, Mask};
use terrafarm_terrain::tile::MAXIMA_LEVELS;

/// Lanes on their way.
pub(super) struct Walk<L: Lanes> {
    /// Those that are not done.
    pub(super) active: L::M,
    /// The number of the ray.
    pub(super) ray: L::I,
    pub(super) cell: [L::I; 2],
    pub(super) level: L::I,
    /// How far the ray is known to be free ...
    pub(super) u: L::D,
    /// ... and its height there.
    pub(super) z: L::D,
    pub(super) rate: [L::D; 2],
    pub(super) inverse: [L::D; 2],
    /// 1 along an axis on which the index of the cell grows, else 0.
    pub(super) ahead: [L::I; 2],
    pub(super) first: L::D,
    pub(super) last: L::D,
    /// Over a round Earth.
    pub(super) end: L::D,
    pub(super) rise: Rise<L>,
    /// Over flat ground only the slope counts.
    pub(super) spans: Spans<L>,
}

/// Where lanes leave their blocks; see `Exit` of the slow twin.
pub(super) struct Exits<L: Lanes> {
    pub(super) lines: [L::I; 2],
    pub(super) u: L::D,
    pub(super) z: L::D,
    /// A line across y is crossed, not one across x.
    pub(super) north: L::M,
    pub(super) ends: L::M,
}

impl<L: Lanes> Walk<L> {
    #[inline(always)]
    pub(super) fn new() -> Self {
        let (none, zero) = (L::D::splat(0.0), L::I::splat(0));
        Walk {
            active: L::M::none(),
            ray: zero,
            cell: [zero; 2],
            level: zero,
            u: none,
            z: none,
            rate: [none; 2],
            inverse: [none; 2],
            ahead: [zero; 2],
            first: none,
            last: none,
            end: none,
            rise: Rise { across: none, up: none },
            spans: Spans {
                number: none,
                start_u: none,
                end_u: none,
                start_z: none,
                end_z: none,
                slope: none,
                bend: none,
            },
        }
    }

    /// Puts all lanes into cells of the rays from `at` on.
    #[inline(always)]
    pub(super) fn load<const ROUND: bool>(&mut self, rays: &Rays, at: usize, cell: [L::I; 2]) {
        self.rate[0] = L::D::load(&rays.part(Part::RateX)[at..]);
        self.rate[1] = L::D::load(&rays.part(Part::RateY)[at..]);
        self.inverse[0] = L::D::load(&rays.part(Part::InverseX)[at..]);
        self.inverse[1] = L::D::load(&rays.part(Part::InverseY)[at..]);
        self.first = L::D::load(&rays.part(Part::First)[at..]);
        self.last = L::D::load(&rays.part(Part::Last)[at..]);
        self.spans.slope = L::D::load(&rays.part(Part::Slope)[at..]);
        if ROUND {
            self.spans.start_u = L::D::load(&rays.part(Part::StartU)[at..]);
            self.spans.end_u = L::D::load(&rays.part(Part::EndU)[at..]);
            self.spans.start_z = L::D::load(&rays.part(Part::StartZ)[at..]);
            self.spans.end_z = L::D::load(&rays.part(Part::EndZ)[at..]);
            self.spans.bend = L::D::load(&rays.part(Part::Bend)[at..]);
        }
        for axis in 0..2 {
            let forward = L::D::splat(0.0).lt(self.rate[axis]);
            self.ahead[axis] = L::I::select(forward, L::I::splat(1), L::I::splat(0));
            self.cell[axis] = cell[axis];
        }
    }

    /// Where the rays enter their cells.
    #[inline(always)]
    pub(super) fn entry(&self, sight: &Sight) -> L::D {
        let one = L::I::splat(1);
        let x = self.line_u(sight, 0, self.cell[0] + one - self.ahead[0]);
        let y = self.line_u(sight, 1, self.cell[1] + one - self.ahead[1]);
        x.max(y)
    }

    /// Puts lanes at the start of the rays from `at` on.
    #[inline(always)]
    pub(super) fn refill<const ROUND: bool>(&mut self, rays: &Rays, at: usize, lanes: L::M) {
        self.u = self.u.refill(&rays.part(Part::U)[at..], lanes);
        self.z = self.z.refill(&rays.part(Part::Z)[at..], lanes);
        self.rate[0] = self.rate[0].refill(&rays.part(Part::RateX)[at..], lanes);
        self.rate[1] = self.rate[1].refill(&rays.part(Part::RateY)[at..], lanes);
        self.inverse[0] = self.inverse[0].refill(&rays.part(Part::InverseX)[at..], lanes);
        self.inverse[1] = self.inverse[1].refill(&rays.part(Part::InverseY)[at..], lanes);
        self.first = self.first.refill(&rays.part(Part::First)[at..], lanes);
        self.last = self.last.refill(&rays.part(Part::Last)[at..], lanes);
        self.spans.slope = self.spans.slope.refill(&rays.part(Part::Slope)[at..], lanes);
        if ROUND {
            self.end = self.end.refill(&rays.part(Part::End)[at..], lanes);
            self.rise.across = self.rise.across.refill(&rays.part(Part::Across)[at..], lanes);
            self.rise.up = self.rise.up.refill(&rays.part(Part::DirectionZ)[at..], lanes);
            self.spans.number = self.spans.number.refill(&rays.part(Part::Number)[at..], lanes);
            self.spans.start_u = self.spans.start_u.refill(&rays.part(Part::StartU)[at..], lanes);
            self.spans.end_u = self.spans.end_u.refill(&rays.part(Part::EndU)[at..], lanes);
            self.spans.start_z = self.spans.start_z.refill(&rays.part(Part::StartZ)[at..], lanes);
            self.spans.end_z = self.spans.end_z.refill(&rays.part(Part::EndZ)[at..], lanes);
            self.spans.bend = self.spans.bend.refill(&rays.part(Part::Bend)[at..], lanes);
        }
        const RANKS: [f64; MOST] = {
            let mut ranks = [0.0; MOST];
            let mut rank = 0;
            while rank < MOST {
                ranks[rank] = rank as f64;
                rank += 1;
            }
            ranks
        };
        let number = L::D::splat(0.0).refill(&RANKS, lanes).truncate() + L::I::splat(at as i32);
        self.ray = L::I::select(lanes, number, self.ray);
        let zero = L::I::splat(0);
        let level = L::I::splat(FIRST_LEVEL as i32);
        self.level = L::I::select(lanes, level, self.level);
        for axis in 0..2 {
            let forward = L::D::splat(0.0).lt(self.rate[axis]);
            self.ahead[axis] = L::I::select(forward, L::I::splat(1), zero);
            let part = [Part::CellX, Part::CellY][axis];
            let cell = L::D::splat(0.0).refill(&rays.part(part)[at..], lanes).truncate();
            self.cell[axis] = L::I::select(lanes, cell, self.cell[axis]);
        }
        self.active = self.active | (lanes & self.u.lt(self.last));
    }

    /// The cell of an axis in which the rays are at `u`, or the one before.
    #[inline(always)]
    pub(super) fn cell_at(&self, sight: &Sight, axis: usize, u: L::D) -> L::I {
        cell_at::<L>(
            L::D::splat(sight.start[axis]) + u * self.rate[axis],
            L::D::splat(sight.slack[axis]),
            L::I::splat(0).lt(self.ahead[axis]),
            L::I::splat(sight.cells[axis] - 1),
        )
    }

    /// Heights of the rays at `u`.
    #[inline(always)]
    pub(super) fn z<const ROUND: bool>(&self, sight: &Sight, u: L::D) -> L::D {
        if ROUND {
            self.spans.z(u)
        } else {
            L::D::splat(sight.camera.position.z) + u * self.spans.slope
        }
    }

    #[inline(always)]
    fn line_u(&self, sight: &Sight, axis: usize, line: L::I) -> L::D {
        (L::D::from_ints(line) - L::D::splat(sight.start[axis])) * self.inverse[axis]
    }

    /// Where the rays leave the blocks that they are in.
    #[inline(always)]
    pub(super) fn exits<const ROUND: bool>(&self, sight: &Sight) -> Exits<L> {
        let lines = [
            (self.cell[0].shr(self.level) + self.ahead[0]).shl(self.level),
            (self.cell[1].shr(self.level) + self.ahead[1]).shl(self.level),
        ];
        let x = self.line_u(sight, 0, lines[0]);
        let y = self.line_u(sight, 1, lines[1]);
        let north = y.lt(x);
        let line_u = y.min(x);
        let ends = self.last.le(line_u);
        let u = line_u.min(self.last);
        Exits { lines, u, z: self.z::<ROUND>(sight, u), north, ends }
    }

    /// Whether the rays stay above heights until they leave their blocks.
    #[inline(always)]
    pub(super) fn clears<const ROUND: bool>(&self, exits: &Exits<L>, highest: L::D) -> L::M {
        let mut lowest = exits.z.min(self.z);
        if ROUND {
            let length = exits.u - self.u;
            let bend = L::D::splat(0.25) * self.spans.bend;
            lowest = lowest - bend * (length * length);
        }
        (highest + L::D::splat(CLEARANCE_M)).lt(lowest)
    }

    /// The cells, along the line by which the rays leave their blocks, at its crossing, or
    /// the ones before.
    #[inline(always)]
    pub(super) fn beside(&self, sight: &Sight, exits: &Exits<L>) -> L::I {
        let north = exits.north;
        let start = [L::D::splat(sight.start[0]), L::D::splat(sight.start[1])];
        let slack = [L::D::splat(sight.slack[0]), L::D::splat(sight.slack[1])];
        let (x, y) = (L::I::splat(sight.cells[0] - 1), L::I::splat(sight.cells[1] - 1));
        let rate = L::D::select(north, self.rate[0], self.rate[1]);
        let ahead = L::I::splat(0).lt(L::I::select(north, self.ahead[0], self.ahead[1]));
        let position = L::D::select(north, start[0], start[1]) + exits.u * rate;
        let slack = L::D::select(north, slack[0], slack[1]);
        let cell = cell_at::<L>(position, slack, ahead, L::I::select(north, x, y));
        further::<L>(cell, L::I::select(north, self.cell[0], self.cell[1]), ahead)
    }

    /// Goes on behind cells; lanes that have no more way to go are done.
    #[inline(always)]
    pub(super) fn pass<const ROUND: bool>(&mut self, sight: &Sight, exits: &Exits<L>, lanes: L::M) {
        let beside = L::I::select(exits.north, self.cell[0], self.cell[1]);
        self.pass_beside::<ROUND>(sight, exits, lanes, beside);
    }

    #[inline(always)]
    pub(super) fn pass_beside<const ROUND: bool>(
        &mut self,
        sight: &Sight,
        exits: &Exits<L>,
        lanes: L::M,
        beside: L::I,
    ) {
        let (zero, one) = (L::I::splat(0), L::I::splat(1));
        let north = exits.north;
        self.u = L::D::select(lanes, exits.u, self.u);
        self.z = L::D::select(lanes, exits.z, self.z);
        let before = L::I::select(north, self.cell[1], self.cell[0]);
        let line = L::I::select(north, exits.lines[1], exits.lines[0]);
        let after = line - one + L::I::select(north, self.ahead[1], self.ahead[0]);
        let (columns, rows) = (L::I::splat(sight.cells[0]), L::I::splat(sight.cells[1]));
        let counts = L::I::select(north, rows, columns);
        let outside = after.lt(zero) | !after.lt(counts);
        let mut gone = lanes & (outside | exits.ends);
        let moving = lanes & !gone;
        self.cell[0] = L::I::select(moving, L::I::select(north, beside, after), self.cell[0]);
        self.cell[1] = L::I::select(moving, L::I::select(north, after, beside), self.cell[1]);
        let parent = self.level + one;
        let crossed = !before.shr(parent).eq(after.shr(parent));
        let up = moving & crossed & self.level.lt(L::I::splat(MAXIMA_LEVELS as i32));
        self.level = L::I::select(up, parent, self.level);
        if ROUND {
            let joint = lanes & exits.ends & self.last.lt(self.end);
            if joint.any() {
                gone = gone & !self.join(sight, joint);
            }
        }
        self.active = self.active & !gone;
    }

    /// Goes on in the next spans. Returns the lanes that need to.
    #[inline(always)]
    fn join(&mut self, sight: &Sight, lanes: L::M) -> L::M {
        let Some(globe) = sight.globe else { return L::M::none() };
        let number = self.spans.number + L::D::splat(1.0);
        let spans = globe.spans_from(&self.rise, number, self.spans.end_z);
        self.spans = Spans::select(lanes, &spans, &self.spans);
        self.first = L::D::select(lanes, spans.start_u, self.first);
        self.last = L::D::select(lanes, self.end.min(spans.end_u), self.last);
        self.z = L::D::select(lanes, self.spans.z(self.u), self.z);
        for axis in 0..2 {
            let ahead = L::I::splat(0).lt(self.ahead[axis]);
            let cell = self.cell_at(sight, axis, self.u);
            let cell = further::<L>(cell, self.cell[axis], ahead);
            self.cell[axis] = L::I::select(lanes, cell, self.cell[axis]);
        }
        let highest = L::D::splat(sight.highest);
        lanes & !(highest.lt(spans.start_z) & L::D::splat(0.0).le(spans.slope))
    }

    /// Tests cells. Returns the lanes that meet the surface in theirs, those whose tile is
    /// not loaded, and the parameters and heights of the contacts.
    #[inline(always)]
    pub(super) fn contacts<const ROUND: bool>(
        &self,
        sight: &Sight,
        tiles: &mut Tiles,
        lanes: L::M,
        held: Option<Corners<L>>,
    ) -> (L::M, L::M, L::D, L::D) {
        let (zero, one) = (L::D::splat(0.0), L::D::splat(1.0));
        let corners = match held {
            Some(corners) => corners,
            None => tiles.corners::<L>(self.cell, lanes),
        };
        let [sw, se, nw, ne] = corners.heights;
        let [x, y] = self.ahead;
        let ahead = [!x.eq(L::I::splat(0)), !y.eq(L::I::splat(0))];
        let in_x = self.line_u(sight, 0, self.cell[0] + L::I::splat(1) - x);
        let in_y = self.line_u(sight, 1, self.cell[1] + L::I::splat(1) - y);
        let out_x = self.line_u(sight, 0, self.cell[0] + x);
        let out_y = self.line_u(sight, 1, self.cell[1] + y);
        // Whether the line that is crossed is one across x.
        let x_in = in_y.lt(in_x);
        let x_out = out_x.le(out_y);
        let in_u = L::D::select(x_in, in_x, in_y);
        let out_u = L::D::select(x_out, out_x, out_y);
        let start_u = in_u.max(self.first);
        let end_u = out_u.min(self.last);
        let back = [!ahead[0], !ahead[1]];
        let mut start_height = self.edge_height(sight, &corners.heights, x_in, back, in_u);
        let mut end_height = self.edge_height(sight, &corners.heights, x_out, ahead, out_u);
        let starts = in_u.lt(self.first);
        if (lanes & starts).any() {
            let height = self.height_under(sight, &corners.heights, self.first);
            start_height = L::D::select(starts, height, start_height);
        }
        let ends = self.last.lt(out_u);
        if (lanes & ends).any() {
            let height = self.height_under(sight, &corners.heights, self.last);
            end_height = L::D::select(ends, height, end_height);
        }
        let length = end_u - start_u;
        let twist = (sw - se) + (ne - nw);
        let curl = twist * (self.rate[0] * length) * (self.rate[1] * length);
        let bend = if ROUND { self.spans.bend * length * length - curl } else { zero - curl };
        let g0 = self.z::<ROUND>(sight, start_u) - start_height;
        let g1 = self.z::<ROUND>(sight, end_u) - end_height;
        // As `first_contact`.
        let below = g0.le(zero);
        let b = (g1 - g0) - bend;
        let excess = bend - (g0 + g1);
        let four = L::D::splat(4.0);
        let above = excess.le(zero) | (excess * excess).lt(four * g0 * g1);
        let missed = !below & zero.lt(g1) & above;
        let hits = lanes & corners.solid & start_u.lt(end_u) & !missed;
        if !hits.any() {
            return (hits, corners.absent, zero, zero);
        }
        let root = (b * b - four * bend * g0).max(zero).sqrt();
        let falls = b.lt(zero);
        let numerator = L::D::select(falls, L::D::splat(2.0) * g0, b + root);
        let denominator = L::D::select(falls, root - b, L::D::splat(-2.0) * bend);
        let s = one.min(zero.max(numerator.div(denominator)));
        let s = L::D::select(below, zero, s);
        let u = L::D::select(one.le(s), end_u, start_u + s * length);
        (hits, corners.absent, u, self.z::<ROUND>(sight, u))
    }

    /// Heights on the lines that the rays cross at `u`: across x where `x_line`, the far
    /// ones of the cell where `far`.
    #[inline(always)]
    fn edge_height(
        &self,
        sight: &Sight,
        corners: &[L::D; 4],
        x_line: L::M,
        far: [L::M; 2],
        u: L::D,
    ) -> L::D {
        let [sw, se, nw, ne] = *corners;
        let across_x = [L::D::select(far[0], se, sw), L::D::select(far[0], ne, nw)];
        let across_y = [L::D::select(far[1], nw, sw), L::D::select(far[1], ne, se)];
        let first = L::D::select(x_line, across_x[0], across_y[0]);
        let second = L::D::select(x_line, across_x[1], across_y[1]);
        let start = sight.start;
        let start = L::D::select(x_line, L::D::splat(start[1]), L::D::splat(start[0]));
        let rate = L::D::select(x_line, self.rate[1], self.rate[0]);
        let cell = L::I::select(x_line, self.cell[1], self.cell[0]);
        lerp::<L>(first, second, share::<L>(start + u * rate, cell))
    }

    /// Heights of the surface under the rays at `u`, within their cells.
    #[inline(always)]
    fn height_under(&self, sight: &Sight, corners: &[L::D; 4], u: L::D) -> L::D {
        let x = share::<L>(L::D::splat(sight.start[0]) + u * self.rate[0], self.cell[0]);
        let y = share::<L>(L::D::splat(sight.start[1]) + u * self.rate[1], self.cell[1]);
        let [sw, se, nw, ne] = *corners;
        lerp::<L>(lerp::<L>(sw, se, x), lerp::<L>(nw, ne, x), y)
    }
}

/// Where in their cells positions are, 0 to 1.
#[inline(always)]
fn share<L: Lanes>(position: L::D, cell: L::I) -> L::D {
    let inside = L::D::splat(0.0).max(position - L::D::from_ints(cell));
    L::D::splat(1.0).min(inside)
}

#[inline(always)]
fn lerp<L: Lanes>(a: L::D, b: L::D, t: L::D) -> L::D {
    a + (b - a) * t
}

/// The cells of an axis in which rays are at a position, or the ones before, by what
/// rounding adds. A cell too early is left in the next step; one too late would leave
/// ground out.
#[inline(always)]
pub(super) fn cell_at<L: Lanes>(position: L::D, slack: L::D, ahead: L::M, last: L::I) -> L::I {
    let behind = L::D::select(ahead, position - slack, position + slack);
    behind.truncate().max(L::I::splat(0)).min(last)
}

/// The further of two cells along rays.
#[inline(always)]
fn further<L: Lanes>(a: L::I, b: L::I, ahead: L::M) -> L::I {
    L::I::select(ahead, a.max(b), a.min(b))
}
