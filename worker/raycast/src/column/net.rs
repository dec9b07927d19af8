//! What the rays of a part of a band have found, and what that tells of the pixels between.

use crate::lanes::{Floats, Ints, Lanes, MOST, Mask};
use std::ops::Range;

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

/// By what the pixels between rays are judged.
#[derive(Clone, Copy)]
pub(super) struct Rules {
    pub bends: Bends,
    /// Rays are lower in the row before, not in the next one.
    pub rising: bool,
    /// How many rows lower ground is looked for that may come up between rays.
    pub reach: usize,
}

/// The answers of rays, row by row, in each line by line.
#[derive(Default)]
pub(super) struct Net {
    /// One over the depths; 0 for the sky, NaN where a tile is missing. The last two bits
    /// are [`WHOLE`] and [`TOLD`].
    pub answers: Vec<f32>,
    /// Closer ground that ends a row lower, else 0; of rows that have any ...
    tips: Vec<f32>,
    tipped: Vec<bool>,
    /// ... and such ground if beside it it has ended already, so that it may come to a peak
    /// between rays.
    peaks: Vec<f32>,
    peaked: Vec<bool>,
    /// Answers of a row, and how many of them are of lines that pixels lie between.
    pub width: usize,
    lines: usize,
    first_row: i32,
    pub first_line: i32,
}

/// What is known of the pixels of a row.
#[derive(Default)]
pub(super) struct Verdict {
    /// By the left of two answers [`EVEN`] and so on.
    pub states: Vec<f32>,
    /// The closest ground that ends in the row, or comes to a peak a little lower.
    pub tips: Vec<f32>,
    /// How much each answer and those beside it bend.
    bends: Vec<f32>,
}

impl Net {
    /// Room for rays that have found nothing.
    pub fn clear(&mut self, first_row: i32, rows: usize, lines: Range<i32>) {
        (self.first_row, self.first_line, self.lines) = (first_row, lines.start, lines.len());
        // Whole vectors are looked at, and twice as much.
        self.width = self.lines + 2 * MOST;
        // A margin for the vectors beyond the end.
        let count = self.width * rows + 2 * MOST;
        self.answers.clear();
        self.answers.resize(count, 0.0);
        for list in [&mut self.tips, &mut self.peaks] {
            list.resize(count, 0.0);
        }
        for list in [&mut self.tipped, &mut self.peaked] {
            list.clear();
            list.resize(rows, false);
        }
    }

    /// What it holds, apart from a few values a row.
    pub fn bytes(&self) -> usize {
        let lists = [&self.answers, &self.tips, &self.peaks];
        lists.iter().map(|list| list.capacity() * size_of::<f32>()).sum()
    }

    fn rows(&self) -> usize {
        self.tipped.len()
    }

    /// Where the answer of a ray of a line belongs.
    pub fn place(&self, row: i32, line: i32) -> i32 {
        (row - self.first_row) * self.width as i32 + (line - self.first_line)
    }

    /// The answers of a row.
    #[inline(always)]
    pub fn row(&self, row: i32) -> &[f32] {
        let at = (row - self.first_row) as usize * self.width;
        &self.answers[at..at + self.width]
    }

    /// Looks for ground behind which there is other ground, once all rays are cast.
    #[inline(always)]
    pub fn find_tips<L: Lanes>(&mut self, rising: bool) {
        let Net { answers, tips, tipped, peaks, peaked, width, lines, .. } = self;
        let (width, rows) = (*width, tipped.len());
        let load = |at: usize| L::F::load(&answers[at..]);
        let (zero, neighbours) = (L::F::splat(0.0), L::F::splat(1.0 - NEIGHBOURS));
        for row in 0..rows {
            let (Some(below), Some(lower)) =
                (below(row, 1, rows, rising), below(row, 2, rows, rising))
            else {
                continue;
            };
            let (row_at, below, lower) = (row * width, below * width, lower * width);
            for column in (1..*lines).step_by(L::N) {
                let (here, ground) = (load(row_at + column), load(below + column));
                let before = (load(lower + column) - ground).abs();
                let ending =
                    here.lt(ground * neighbours) & (before * L::F::splat(ENDS)).lt(ground - here);
                if !ending.any() {
                    continue;
                }
                if !tipped[row] {
                    tips[row_at..row_at + width].fill(0.0);
                    tipped[row] = true;
                }
                let at = row_at + column;
                L::F::select(ending, ground, zero).store(&mut tips[at..]);
                let beside = load(below + column - 1).min(load(below + column + 1));
                let peak = ending & !(ground * neighbours).le(beside);
                if peak.any() {
                    if !peaked[row] {
                        peaks[row_at..row_at + width].fill(0.0);
                        peaked[row] = true;
                    }
                    L::F::select(peak, ground, zero).store(&mut peaks[at..]);
                }
            }
        }
    }

    /// Finds out what is known of the pixels of a row.
    ///
    /// Between two rays the ground is a line as far as it does not bend. Where it bends by
    /// s in one place, t of the way from ray to ray, the answers bend by (1 - t) s at the one
    /// and by t s at the other, and the line is off by at most t (1 - t) s: their product over
    /// their sum. Where it bends evenly, or in more places to the same side, it is off by
    /// less. It counts in pixels, by the change of the answers from row to row, or by what
    /// they are. Bends to both sides can hide each other at a ray, hence [`MOST_BENT`].
    #[inline(always)]
    pub fn judge<L: Lanes>(&self, row: i32, rules: Rules, verdict: &mut Verdict) {
        let width = self.width;
        let Verdict { states, tips, bends } = verdict;
        for list in [&mut *states, tips, bends] {
            list.resize(width + 2 * MOST, 0.0);
        }
        let row = (row - self.first_row) as usize;
        self.find_closest::<L>(row, rules, tips);
        // The rows beside this one, or one of them twice.
        let rows = self.rows();
        let after = if row + 1 < rows { row + 1 } else { row.saturating_sub(1) };
        let before = if row > 0 { row - 1 } else { after };
        let [before, row, after] = [before, row, after].map(|row| &self.answers[row * width..]);
        for column in (1..=self.lines).step_by(L::N) {
            let here = L::F::load(&row[column..]);
            let beside = L::F::load(&row[column - 1..]) + L::F::load(&row[column + 1..]);
            (beside - (here + here)).abs().store(&mut bends[column..]);
        }
        let (zero, half) = (L::F::splat(0.0), L::F::splat(0.5));
        let of_change = L::F::splat(rules.bends.of_change);
        let of_depth = L::F::splat(rules.bends.of_depth);
        let told = L::I::splat(TOLD);
        let (flat, uneven) = (L::F::splat(EVEN), L::F::splat(BENT));
        let (broken, behind) = (L::F::splat(BROKEN), L::F::splat(BEHIND));
        let neighbours = L::F::splat(1.0 - NEIGHBOURS);
        for column in (0..self.lines).step_by(L::N) {
            let (a, b) = (L::F::load(&row[column..]), L::F::load(&row[column + 1..]));
            let (low, high) = (a.min(b), a.max(b));
            let bend_a = L::F::load(&bends[column..]);
            let bend_b = L::F::load(&bends[column + 1..]);
            let before = [L::F::load(&before[column..]), L::F::load(&before[column + 1..])];
            let after = [L::F::load(&after[column..]), L::F::load(&after[column + 1..])];
            let change = (a - before[0]).abs().min((b - before[1]).abs());
            let change = change.min((a - after[0]).abs().min((b - after[1]).abs()));
            let even = (change * of_change).max(low * of_depth);
            let told = (a.to_bits() & b.to_bits() & told).eq(told);
            let sky = high.eq(zero);
            let bend = bend_a.max(bend_b);
            let same = same::<L>(a, b) & bend.le(even * L::F::splat(TORN)) | sky;
            let off = (bend_a * bend_b).le(even * half * (bend_a + bend_b));
            let straight = off & bend.le(even * L::F::splat(MOST_BENT));
            let state = L::F::select((told & straight) | sky, flat, uneven);
            let state = L::F::select(same, state, broken);
            let tip = L::F::load(&tips[column..]).max(L::F::load(&tips[column + 1..]));
            let state = L::F::select(high.lt(tip * neighbours), behind, state);
            // Of what is NaN, any sum is.
            let known = bend_a + bend_b + (before[0] + before[1]) + (after[0] + after[1]);
            let state = L::F::select(known.eq(known), state, L::F::splat(OPEN));
            state.store(&mut states[column..]);
        }
    }

    /// The closest ground that ends in a row, or comes to a peak a little lower.
    #[inline(always)]
    fn find_closest<L: Lanes>(&self, row: usize, rules: Rules, closest: &mut [f32]) {
        let width = self.width;
        if self.tipped[row] {
            closest[..width].copy_from_slice(&self.tips[row * width..(row + 1) * width]);
        } else {
            closest[..width].fill(0.0);
        }
        for lower in 0..rules.reach {
            let Some(peak) = below(row, lower, self.rows(), rules.rising) else { break };
            if !self.peaked[peak] {
                continue;
            }
            let peaks = &self.peaks[peak * width..];
            for column in (0..=self.lines).step_by(L::N) {
                let found = L::F::load(&closest[column..]).max(L::F::load(&peaks[column..]));
                found.store(&mut closest[column..]);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lanes::One;
    use crate::oracle::Dice;

    #[test]
    fn ground_with_one_bend_is_even_only_where_the_line_is_off_by_no_more_than_allowed() {
        const LINES: i32 = 24;
        let of_depth = 1e-3;
        let rules = Rules { bends: Bends { of_change: 0.0, of_depth }, rising: false, reach: 1 };
        let (mut net, mut verdict) = (Net::default(), Verdict::default());
        let mut dice = Dice::new(5);
        // Intervals with the bend inside: even, and not; and those beside them that are even.
        let (mut even, mut bent, mut beside) = (0, 0, 0);
        for _ in 0..4000 {
            let (nearest, slope) = (dice.between(1e-3, 2e-3), dice.between(-2e-6, 2e-6));
            let (place, bend) = (dice.between(4.0, 19.0), dice.between(-9e-6, 9e-6));
            let ground = |x: f64| nearest + slope * x + bend * (x - place).max(0.0);
            net.clear(0, 3, 0..LINES);
            for row in 0..3 {
                for line in 0..LINES {
                    let bits = (ground(f64::from(line)) as f32).to_bits() as i32;
                    let at = net.place(row, line) as usize;
                    net.answers[at] = f32::from_bits((bits & !3 | TOLD | WHOLE) as u32);
                }
            }
            net.find_tips::<One>(rules.rising);
            net.judge::<One>(1, rules, &mut verdict);
            for line in 1..LINES - 2 {
                let (a, b) = (ground(f64::from(line)), ground(f64::from(line + 1)));
                let off = (0..=16)
                    .map(|n| f64::from(n) / 16.0)
                    .map(|t| (a + (b - a) * t - ground(f64::from(line) + t)).abs());
                let off = off.fold(0.0, f64::max);
                let inside = (place.floor() as i32) == line;
                let is_even = verdict.states[line as usize] == EVEN;
                even += i32::from(inside && is_even);
                bent += i32::from(inside && !is_even);
                beside += i32::from((place.floor() as i32 - line).abs() == 1 && is_even);
                // Half of what is allowed at both rays, and the rounding of answers.
                let most = 0.5 * f64::from(of_depth) * a.min(b) + 4e-9;
                assert!(!is_even || off <= most, "{off} above {most}: {line}, {place} {bend}");
            }
        }
        assert!(even > 500 && bent > 500 && beside > 4000, "{even} {bent} {beside}");
    }
}
