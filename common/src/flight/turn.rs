//! A turn between two attitudes, smooth at both ends.
//!
//! The cumulative cubic of Kim, Kim and Shin (SIGGRAPH 1995): three rotations, one after
//! the other, each faded in by a cumulative Bernstein polynomial,
//! `from * exp(a b1(u)) * exp(b b2(u)) * exp(c b3(u))`. `a` and `c` follow from the rates
//! of turn at the ends, `b` is what is left. It is a rotation at every `u`, knows no
//! axis better than another, and turns evenly when the rates are even.

use glam::{DQuat, DVec3};
use std::f64::consts::{PI, TAU};

/// A turn counts as one of 180 degrees if its cosine of half the angle is below this.
const HALF_TURN: f64 = 1e-9;
/// Components of a unit vector below this are zero.
const LEVEL: f64 = 1e-9;

/// One turn, from share 0 to share 1.
#[derive(Debug, Clone)]
pub(super) struct Turn {
    from: DQuat,
    /// Rotation vectors in camera axes, radians.
    parts: [DVec3; 3],
}

impl Turn {
    /// No turn at all.
    pub fn still(attitude: DQuat) -> Self {
        Turn { from: attitude, parts: [DVec3::ZERO; 3] }
    }

    /// The turn between two attitudes with these rates at its ends: rotation vectors in
    /// camera axes, radians over the length of the turn.
    pub fn new(from: DQuat, to: DQuat, rates: [DVec3; 2]) -> Self {
        let [first, third] = rates.map(|rate| rate / 3.0);
        let rest = exp(-first) * (from.conjugate() * to) * exp(-third);
        let expected = short_way(from, to) - first - third;
        Turn { from, parts: [first, log_near(rest, expected), third] }
    }

    /// The attitude at a share of the turn, 0 to 1.
    pub fn at(&self, u: f64) -> DQuat {
        let rest = 1.0 - u;
        let faded = [1.0 - rest * rest * rest, u * u * (3.0 - 2.0 * u), u * u * u];
        let turned = self.parts.iter().zip(faded).fold(self.from, |q, (r, f)| q * exp(*r * f));
        turned.normalize()
    }
}

/// The rotation vector in camera axes, radians, that leads from one attitude to another
/// by at most 180 degrees. At exactly 180 the way is chosen: see [`super`].
pub(super) fn short_way(from: DQuat, to: DQuat) -> DVec3 {
    let between = from.conjugate() * to;
    let short = if between.w < 0.0 { -between } else { between };
    let turn = log(short);
    if short.w >= HALF_TURN {
        return turn;
    }
    let axis = turn.normalize_or_zero();
    let (right, rolls_right, lifts) = (-(from * axis).z, axis.y, axis.x);
    let way = [right, rolls_right, lifts].into_iter().find(|c| c.abs() > LEVEL).unwrap_or(1.0);
    axis * PI.copysign(way)
}

/// The unit quaternion of a rotation vector, radians.
fn exp(turn: DVec3) -> DQuat {
    let angle = turn.length();
    let half = angle / 2.0;
    let scale = if angle < 1e-12 { 0.5 } else { libm::sin(half) / angle };
    let v = turn * scale;
    DQuat::from_xyzw(v.x, v.y, v.z, libm::cos(half))
}

/// The rotation vector of a unit quaternion, radians: shorter than a full turn, and at
/// most half a turn if `w` is not negative.
fn log(q: DQuat) -> DVec3 {
    let v = DVec3::new(q.x, q.y, q.z);
    let sin_half = v.length();
    if sin_half < 1e-12 {
        return v * 2.0;
    }
    v * (2.0 * libm::atan2(sin_half, q.w) / sin_half)
}

/// Of the two ways round that a quaternion stands for, the one nearer to `expected`.
fn log_near(q: DQuat, expected: DVec3) -> DVec3 {
    let one = log(if q.w < 0.0 { -q } else { q });
    let other = one - one.normalize_or_zero() * TAU;
    if one.distance_squared(expected) <= other.distance_squared(expected) { one } else { other }
}
