//! What the rays of a part of a band have found, and what that tells of the pixels between.

use crate::lanes::{Floats, Ints, Lanes, MOST, Mask};

/// Rays see the same ground if their depths differ by no more than this share.
const NEIGHBOURS: f32 = 0.02;

/// What is known of the pixels between two rays of a row. They lie on the ground between
/// the two, to the tolerance ...
pub(super) const EVEN: f32 = 0.0;
/// ... or have to be compared with it ...
pub(super) const BENT: f32 = 1.0;
/// ... or the two rays see different ground ...
pub(super) const BROKEN: f32 = 2.0;
/// ... or ground that is closer than what both see ends a few rows below.
pub(super) const BEHIND: f32 = 3.0;
/// ... or nothing, for a ray around them waits for a tile.
pub(super) const OPEN: f32 = 4.0;

/// The last bits of an answer: the tile that it lies on has no void, and ...
pub(crate) const WHOLE: i32 = 2;
/// ... posts are further apart there than rays.
pub(crate) const TOLD: i32 = 1;

/// How many times more answers must bend than straight lines may, for two rays to see
/// different ground.
const TORN: f32 = 8.0;
/// How many times more answers may bend at one of two rays, if they hardly bend at the
/// other, than at both.
const MOST_BENT: f32 = 4.0;
/// How many times larger the change from row to row must be than that before it, for closer
/// ground to end there.
const ENDS: f32 = 2.0;

/// How much answers may bend at both of two rays, for pixels between to lie on straight lines.
#[derive(Clone, Copy)]
pub(super) struct Bends {
    /// As a share of what they change by from row to row, where that is a measure of what
    /// a pixel is off ...
    pub of_change: f32,
    /// ... and of what they are, which is one wherever the ground is no steeper than 45
    /// degrees.
    pub of_depth: f32,
}

/// The answers of rays, row by row, in each line by line.
pub(super) struct Net {
    /// One over the depths; 0 for the sky, NaN where a tile is missing. The last two bits
    /// are [`WHOLE`] and [`TOLD`].
    pub answers: Vec<f32>,
    /// By the left of two answers [`EVEN`] and so on.
    states: Vec<f32>,
    /// How much each answer and those beside it bend.
    bends: Vec<f32>,
    /// Answers behind which there is other ground, if beside them it has ended already, so
    /// that it may come to a peak between rays; else 0. And whether a row has any.
    ends: Vec<f32>,
    peaked: Vec<bool>,
    /// The closest ground that ends in a row, or comes to a peak a little lower.
    tips: Vec<f32>,
    /// Answers of a row.
    pub width: usize,
    pub first_row: i32,
    pub first_line: i32,
}

impl Net {
    pub fn new() -> Self {
        Net {
            answers: Vec::new(),
            states: Vec::new(),
            bends: Vec::new(),
            ends: Vec::new(),
            peaked: Vec::new(),
            tips: Vec::new(),
            width: 0,
            first_row: 0,
            first_line: 0,
        }
    }

    /// Room for rays that have found nothing.
    pub fn clear(&mut self, first_row: i32, rows: usize, first_line: i32, width: usize) {
        self.answers.clear();
        self.answers.resize(width * rows, 0.0);
        (self.first_row, self.first_line, self.width) = (first_row, first_line, width);
    }

    /// A row: its answers, what is known of the pixels between them, and the closest ground
    /// that ends a little lower.
    #[inline(always)]
    pub fn row(&self, row: i32) -> [&[f32]; 3] {
        let at = (row - self.first_row) as usize * self.width;
        let end = at + self.width;
        [&self.answers[at..end], &self.states[at..end], &self.tips[at..end]]
    }

    /// Finds out what is known of the pixels, once all rays are cast. Rays are lower in the
    /// next row, or with `rising` in the one before; `reach` rows lower are looked at for
    /// ground that may come up between rays.
    ///
    /// Between two rays the ground is a line as far as it does not bend. Where it bends by
    /// s in one place, t of the way from ray to ray, the answers bend by (1 - t) s at the one
    /// and by t s at the other, and the line is off by at most t (1 - t) s: their product over
    /// their sum. Where it bends evenly, or in more places to the same side, it is off by
    /// less. It counts in pixels, by the change of the answers from row to row, or by what
    /// they are. Bends to both sides can hide each other at a ray, hence [`MOST_BENT`].
    #[inline(always)]
    pub fn compare<L: Lanes>(&mut self, allowed: Bends, rising: bool, reach: usize) {
        let Net { answers, states, bends, ends, tips, peaked, width, .. } = self;
        let (width, count) = (*width, answers.len());
        // A margin for the vectors beyond the end.
        answers.resize(count + 2 * MOST, 0.0);
        for list in [&mut *states, &mut *bends, &mut *ends, &mut *tips] {
            list.clear();
            list.resize(count + 2 * MOST, 0.0);
        }
        let load = |at: usize| L::F::load(&answers[at..]);
        // The first has none beside it.
        for at in (1..count).step_by(L::N) {
            let here = load(at);
            let bend = (load(at - 1) - (here + here) + load(at + 1)).abs();
            bend.store(&mut bends[at..]);
        }
        let (zero, neighbours) = (L::F::splat(0.0), L::F::splat(1.0 - NEIGHBOURS));
        let rows = count / width.max(1);
        peaked.clear();
        peaked.resize(rows, false);
        for row in 0..rows {
            let (Some(below), Some(lower)) =
                (below(row, 1, rows, rising), below(row, 2, rows, rising))
            else {
                continue;
            };
            let (row_at, below, lower) = (row * width, below * width, lower * width);
            for column in (1..width).step_by(L::N) {
                let (here, ground) = (load(row_at + column), load(below + column));
                let before = (load(lower + column) - ground).abs();
                let ending =
                    here.lt(ground * neighbours) & (before * L::F::splat(ENDS)).lt(ground - here);
                if ending.any() {
                    let beside = load(below + column - 1).min(load(below + column + 1));
                    let level = (ground * neighbours).le(beside);
                    let at = row_at + column;
                    L::F::select(ending, ground, zero).store(&mut tips[at..]);
                    let peak = ending & !level;
                    L::F::select(peak, ground, zero).store(&mut ends[at..]);
                    peaked[row] |= peak.any();
                }
            }
        }
        for row in 0..rows {
            for lower in 0..reach {
                let Some(peak) = below(row, lower, rows, rising).filter(|&row| peaked[row]) else {
                    continue;
                };
                let (row_at, peak) = (row * width, peak * width);
                for column in (0..width).step_by(L::N) {
                    let ends = L::F::load(&ends[peak + column..]);
                    let closest = L::F::load(&tips[row_at + column..]).max(ends);
                    closest.store(&mut tips[row_at + column..]);
                }
            }
        }
        let of_change = L::F::splat(allowed.of_change);
        let of_depth = L::F::splat(allowed.of_depth);
        let told = L::I::splat(TOLD);
        let (flat, uneven) = (L::F::splat(EVEN), L::F::splat(BENT));
        let (broken, behind) = (L::F::splat(BROKEN), L::F::splat(BEHIND));
        let open = L::F::splat(OPEN);
        for row in (0..count).step_by(width.max(1)) {
            // The rows beside this one, or one of them twice.
            let after = if row + width < count { row + width } else { row.saturating_sub(width) };
            let before = if row > 0 { row - width } else { after };
            for column in (0..width).step_by(L::N) {
                let (here, before, after) = (row + column, before + column, after + column);
                let (a, b) = (load(here), load(here + 1));
                let (low, high) = (a.min(b), a.max(b));
                let same = same::<L>(a, b);
                let (bend_a, bend_b) = (L::F::load(&bends[here..]), L::F::load(&bends[here + 1..]));
                let bend = bend_a.max(bend_b);
                let around = (load(before) + load(before + 1)) + (load(after) + load(after + 1));
                let known = bend_a + bend_b + around;
                let change = (a - load(before)).abs().min((b - load(before + 1)).abs());
                let change = change.min((a - load(after)).abs().min((b - load(after + 1)).abs()));
                let even = (change * of_change).max(low * of_depth);
                let told = (a.to_bits() & b.to_bits() & told).eq(told);
                let same = same & bend.le(even * L::F::splat(TORN)) | high.eq(zero);
                let off = (bend_a * bend_b).le(even * L::F::splat(0.5) * (bend_a + bend_b));
                let straight = off & bend.le(even * L::F::splat(MOST_BENT));
                let even = (told & straight) | high.eq(zero);
                let tip = L::F::load(&tips[here..]).max(L::F::load(&tips[here + 1..]));
                let state = L::F::select(even, flat, uneven);
                let state = L::F::select(same, state, broken);
                let state = L::F::select(high.lt(tip * neighbours), behind, state);
                let state = L::F::select(known.eq(known), state, open);
                state.store(&mut states[here..]);
            }
        }
    }
}

/// Whether two answers are of the same ground.
#[inline(always)]
pub(super) fn same<L: Lanes>(a: L::F, b: L::F) -> L::M {
    (a.max(b) * L::F::splat(1.0 - NEIGHBOURS)).le(a.min(b))
}

/// The row that is so many rows lower, if there is one.
#[inline(always)]
fn below(row: usize, by: usize, rows: usize, rising: bool) -> Option<usize> {
    if rising { row.checked_sub(by) } else { Some(row + by).filter(|&row| row < rows) }
}
