//! Tangents of a cubic through knots: those of the C2 spline, limited.
//!
//! The C2 spline (each end a parabola) follows an arc through few knots closely: an orbit
//! with a knot every 45 degrees keeps its speed to 0.3 %, where the mean of the two
//! slopes would lose 10 %. But it swings: hence three departures, after which the curve
//! is C1 and, wherever none applies, C2.
//!
//! 1. A knot whose two slopes agree is pinned to that slope, so that a straight leg at
//!    constant speed stays one and a swing does not run along it.
//! 2. A knot between opposite slopes, or beside a slope of 0, is pinned to 0: a turning
//!    point is an extremum, and a hover stands still.
//! 3. Any other tangent is shortened to three times the smaller slope, then moved to the
//!    nearest one that does not point against either slope. For numbers on a line this is
//!    the condition of Fritsch and Carlson (1980): the cubic is monotone between two
//!    knots.

use glam::DVec3;

/// Two slopes are the same if they differ by less than this share of the longer.
const SAME_SLOPE: f64 = 1e-6;
/// Two slopes are opposite if the sine of the angle between them is below this.
const SAME_LINE: f64 = 1e-9;
/// The longest tangent, in slopes.
const LONGEST: f64 = 3.0;

/// The chords between knots: one more knot than steps.
pub(super) struct Knots<'a> {
    /// Lengths of the steps in time, seconds, each above 0; at least one.
    pub steps_s: &'a [f64],
    /// Mean rate of change over each step, per second.
    pub slopes: &'a [DVec3],
}

impl Knots<'_> {
    /// The rate of change at each knot, per second.
    pub fn tangents(&self) -> Vec<DVec3> {
        let last = self.slopes.len();
        if last == 1 {
            return vec![self.slopes[0]; 2];
        }
        let limited = |(i, tangent): (usize, DVec3)| {
            limit(tangent, self.slopes[i.saturating_sub(1)], self.slopes[i.min(last - 1)])
        };
        self.solve().into_iter().enumerate().map(limited).collect()
    }

    /// Equations of the knots, each `below d[i-1] + on d[i] + above d[i+1] = right`, solved
    /// from the first to the last and back. No pivot comes near 0: `above` stays below
    /// half of `on` in every row but the first, where they are equal.
    fn solve(&self) -> Vec<DVec3> {
        let last = self.slopes.len();
        let mut carried: Vec<(f64, DVec3)> = Vec::with_capacity(last + 1);
        for i in 0..=last {
            let (below, on, above, right) = self.row(i);
            let (share, value) = carried.last().copied().unwrap_or((0.0, DVec3::ZERO));
            let pivot = on - below * share;
            carried.push((above / pivot, (right - value * below) / pivot));
        }
        let mut tangents = vec![DVec3::ZERO; last + 1];
        let mut next = DVec3::ZERO;
        for (tangent, (share, value)) in tangents.iter_mut().zip(&carried).rev() {
            *tangent = *value - next * *share;
            next = *tangent;
        }
        tangents
    }

    fn row(&self, i: usize) -> (f64, f64, f64, DVec3) {
        let last = self.slopes.len();
        if i == 0 {
            return (0.0, 1.0, 1.0, self.slopes[0] * 2.0);
        }
        if i == last {
            return (1.0, 1.0, 0.0, self.slopes[last - 1] * 2.0);
        }
        let (before, after) = (self.slopes[i - 1], self.slopes[i]);
        if let Some(pinned) = pinned(before, after) {
            return (0.0, 1.0, 0.0, pinned);
        }
        // Divided by the sum, so that very long and very short steps stay in range.
        let sum = self.steps_s[i - 1] + self.steps_s[i];
        let (short, long) = (self.steps_s[i - 1] / sum, self.steps_s[i] / sum);
        (long, 2.0, short, (before * long + after * short) * 3.0)
    }
}

/// The tangent at a knot that has no choice.
fn pinned(before: DVec3, after: DVec3) -> Option<DVec3> {
    let (a, b) = (before.length(), after.length());
    if (after - before).length() <= SAME_SLOPE * a.max(b) {
        return Some((before + after) / 2.0);
    }
    let turns_back = before.dot(after) <= 0.0 && before.cross(after).length() <= SAME_LINE * a * b;
    turns_back.then_some(DVec3::ZERO)
}

/// A tangent no longer than [`LONGEST`] times the shorter slope, moved to the nearest one
/// that does not point against either. Shortened first: what rounding leaves of a long
/// one would still point the wrong way.
fn limit(tangent: DVec3, before: DVec3, after: DVec3) -> DVec3 {
    let longest = LONGEST * before.length().min(after.length());
    in_both_half_spaces(tangent.clamp_length_max(longest), before, after)
}

fn in_both_half_spaces(tangent: DVec3, a: DVec3, b: DVec3) -> DVec3 {
    let (against_a, against_b) = (tangent.dot(a) < 0.0, tangent.dot(b) < 0.0);
    if !against_a && !against_b {
        return tangent;
    }
    let on_plane = |normal: DVec3| {
        let unit = normal.normalize_or_zero();
        tangent - unit * tangent.dot(unit)
    };
    let tolerance = -1e-12 * tangent.length();
    let (on_a, on_b) = (on_plane(a), on_plane(b));
    if against_a && on_a.dot(b) >= tolerance * b.length() {
        return on_a;
    }
    if against_b && on_b.dot(a) >= tolerance * a.length() {
        return on_b;
    }
    let edge = a.cross(b).normalize_or_zero();
    edge * tangent.dot(edge)
}

/// The cubic with these ends and rates (per second) over a step of `length_s`, at a share
/// of it from 0 to 1.
pub(super) fn hermite(
    from: DVec3,
    to: DVec3,
    rates: [DVec3; 2],
    length_s: f64,
    share: f64,
) -> DVec3 {
    let rest = 1.0 - share;
    let eased = share * share * (3.0 - 2.0 * share);
    from + (to - from) * eased + (rates[0] * rest - rates[1] * share) * (length_s * share * rest)
}
