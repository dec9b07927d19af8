//! What the rays of a part of a band have found, and what that tells of the pixels between.

use crate::lanes::{Floats, Ints, Lanes, MOST};

/// Rays see the same ground if their depths differ by no more than this share.
const NEIGHBOURS: f32 = 0.02;

/// What is known of the pixels between two rays of a row. They lie on the ground between
/// the two, to the tolerance ...
pub(super) const EVEN: f32 = 0.0;
/// ... or have to be compared with it ...
pub(super) const BENT: f32 = 1.0;
/// ... or the two rays see different ground.
pub(super) const BROKEN: f32 = 2.0;

/// How much answers may bend, for pixels between to lie on straight lines.
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
    /// One over the depths; 0 for the sky, NaN where a tile is missing. The last bit is set
    /// where no post can hide between rays; see [`crate::walk::Walk`].
    pub answers: Vec<f32>,
    /// By the left of two answers [`EVEN`], [`BENT`] or [`BROKEN`].
    states: Vec<f32>,
    /// How much each answer and those beside it bend.
    bends: Vec<f32>,
    /// Answers of a row.
    pub width: usize,
    pub first_row: usize,
    pub first_line: i32,
}

impl Net {
    pub fn new() -> Self {
        let (answers, states, bends) = (Vec::new(), Vec::new(), Vec::new());
        Net { answers, states, bends, width: 0, first_row: 0, first_line: 0 }
    }

    /// Room for rays that have found nothing.
    pub fn clear(&mut self, first_row: usize, rows: usize, first_line: i32, width: usize) {
        self.answers.clear();
        self.answers.resize(width * rows, 0.0);
        (self.first_row, self.first_line, self.width) = (first_row, first_line, width);
    }

    /// The answers of a row, and what is known of the pixels between them.
    #[inline(always)]
    pub fn row(&self, row: usize) -> (&[f32], &[f32]) {
        let at = (row - self.first_row) * self.width;
        let end = at + self.width;
        (&self.answers[at..end], &self.states[at..end])
    }

    /// Finds out what is known of the pixels, once all rays are cast.
    ///
    /// Between two rays the ground is a line as far as it does not bend: what the answers
    /// bend by at both rays bounds what it is off by if it bends in one place, and is
    /// eight times that if it bends evenly. It counts in pixels, by the change of the
    /// answers from row to row, or by what they are.
    #[inline(always)]
    pub fn compare<L: Lanes>(&mut self, allowed: Bends) {
        let Net { answers, states, bends, width, .. } = self;
        let (width, count) = (*width, answers.len());
        // A margin for the vectors beyond the end.
        answers.resize(count + 2 * MOST, 0.0);
        for list in [&mut *states, &mut *bends] {
            list.clear();
            list.resize(count + 2 * MOST, 0.0);
        }
        let load = |at: usize| L::F::load(&answers[at..]);
        let (one, unknown) = (L::I::splat(1), L::F::splat(f32::INFINITY));
        // The first has none beside it.
        for at in (1..count).step_by(L::N) {
            let here = load(at);
            let bend = (load(at - 1) - (here + here) + load(at + 1)).abs();
            let told = (here.to_bits() & one).eq(one);
            L::F::select(told, bend, unknown).store(&mut bends[at..]);
        }
        let neighbours = L::F::splat(1.0 - NEIGHBOURS);
        let of_change = L::F::splat(allowed.of_change);
        let of_depth = L::F::splat(allowed.of_depth);
        let (flat, uneven, broken) = (L::F::splat(EVEN), L::F::splat(BENT), L::F::splat(BROKEN));
        for row in (0..count).step_by(width.max(1)) {
            // The rows beside this one, or one of them twice.
            let after = if row + width < count { row + width } else { row.saturating_sub(width) };
            let before = if row > 0 { row - width } else { after };
            for column in (0..width).step_by(L::N) {
                let (here, before, after) = (row + column, before + column, after + column);
                let (a, b) = (load(here), load(here + 1));
                let (low, high) = (a.min(b), a.max(b));
                let same = (high * neighbours).le(low);
                let bend = L::F::load(&bends[here..]).max(L::F::load(&bends[here + 1..]));
                let change = (a - load(before)).abs().min((b - load(before + 1)).abs());
                let change = change.min((a - load(after)).abs().min((b - load(after + 1)).abs()));
                let even = bend.le((change * of_change).max(low * of_depth));
                let state = L::F::select(even, flat, uneven);
                L::F::select(same, state, broken).store(&mut states[here..]);
            }
        }
    }
}
