//! The ground along N lines: from vertex to vertex, and which rays meet it in between.
//!
//! A vertex is a point of the ground over a line. Seen from the camera it has a tangent of
//! elevation T, and from one vertex to the next the ground counts as straight: along it one
//! over the map distance is linear in T. So a stretch between two vertices is met by the
//! rays with tangents up to the greater of its two, and where is a multiplication and an
//! addition (the drawing step of voxel columns, Cohen-Or et al., section 2, with
//! perspective-correct interpolation). Where the ground within a cell, or the Earth under
//! it, bends too much for that, a cell has more vertices.

use super::lines::tangent;
use crate::lanes::{Floats, Ints, Lanes, Mask};
use crate::relief::Relief;

/// The most stretches that a cell is cut into.
const MOST_STRETCHES: f32 = 64.0;
/// What counts as no distance from the camera, metres: less than that of what a ray along
/// the axis sees from a millimetre.
const NO_DISTANCE: f32 = 1e-9;

/// The ground of a cell along a line, over the camera.
#[derive(Clone, Copy)]
pub(super) struct Profile<L: Lanes> {
    /// Distance at which the line enters the cell ...
    pub start: L::F,
    /// ... and leaves it.
    pub end: L::F,
    /// Height at both.
    pub low: L::F,
    pub high: L::F,
    /// How much the ground bends in between: t of the way it is `t (1 - t) curl` below the
    /// straight line.
    pub curl: L::F,
    /// How far through the cell the last vertex is, 0 to 1, and how much further the next.
    pub t: L::F,
    pub step: L::F,
}

/// The ground between the last two vertices.
#[derive(Clone, Copy)]
pub(super) struct Stretch<L: Lanes> {
    /// The last vertex: one over its distance, and its tangent of elevation.
    inverse: L::F,
    tangent: L::F,
    /// One over the distance of the vertex before.
    near: L::F,
    /// One over the distance at the tangent of the last vertex, and how it changes.
    base: L::F,
    rate: L::F,
    /// Rays of tangents up to this meet the stretch.
    limit: L::F,
}

impl<L: Lanes> Profile<L> {
    pub fn new() -> Self {
        let (zero, one) = (L::F::splat(0.0), L::F::splat(1.0));
        Profile { start: zero, end: zero, low: zero, high: zero, curl: zero, t: one, step: one }
    }

    /// Sets out for the first vertex behind the start of a cell. With more than `allowed`
    /// metres a metre away between ground and stretches there will be more of these, if
    /// there is ground. Returns the lanes with more than one.
    #[inline(always)]
    pub fn cut(&mut self, relief: &Relief, allowed: f32, lanes: L::M, solid: L::M) -> L::M {
        let one = L::F::splat(1.0);
        let length = self.end - self.start;
        let arc = L::F::splat(0.5 * relief.curvature as f32) * length * length;
        let off = (self.curl - arc).abs() * L::F::splat(0.25);
        let allowed = L::F::splat(allowed) * self.start;
        let many = solid & allowed.lt(off);
        (self.t, self.step) =
            (L::F::select(lanes, one, self.t), L::F::select(lanes, one, self.step));
        if many.any() {
            let count = off.div(allowed.max(L::F::splat(NO_DISTANCE))).sqrt();
            let count = count.min(L::F::splat(MOST_STRETCHES - 1.0)).floor() + L::I::splat(1);
            let step = one.div(count.to_floats());
            self.step = L::F::select(many, step, self.step);
            self.t = L::F::select(many, step, self.t);
        }
        many
    }

    /// Whether there are more vertices in the cell.
    #[inline(always)]
    pub fn is_cut(&self) -> L::M {
        (L::F::splat(0.5) * self.step).le(L::F::splat(1.0) - self.t)
    }

    /// Distance and height of the vertex at t.
    #[inline(always)]
    pub fn vertex(&self) -> (L::F, L::F) {
        let one = L::F::splat(1.0);
        let more = self.is_cut();
        let s = self.start + self.t * (self.end - self.start);
        let height = self.low + self.t * ((self.high - self.low) - self.curl * (one - self.t));
        (L::F::select(more, s, self.end), L::F::select(more, height, self.high))
    }
}

impl<L: Lanes> Stretch<L> {
    pub fn new() -> Self {
        let zero = L::F::splat(0.0);
        Stretch { inverse: zero, tangent: zero, near: zero, base: zero, rate: zero, limit: zero }
    }

    /// Puts the first vertex of a piece of ground.
    #[inline(always)]
    pub fn begin(&mut self, relief: &Relief, s: L::F, height: L::F, lanes: L::M) {
        let s = s.max(L::F::splat(NO_DISTANCE));
        let inverse = L::F::splat(1.0).div(s);
        let tangent = tangent::<L>(relief, s, inverse, height);
        self.inverse = L::F::select(lanes, inverse, self.inverse);
        self.tangent = L::F::select(lanes, tangent, self.tangent);
    }

    /// Goes on to the next vertex.
    #[inline(always)]
    pub fn reach(&mut self, relief: &Relief, s: L::F, height: L::F, lanes: L::M) {
        let s = s.max(L::F::splat(NO_DISTANCE));
        let inverse = L::F::splat(1.0).div(s);
        let tangent = tangent::<L>(relief, s, inverse, height);
        let rises = self.tangent.lt(tangent);
        let rate = (inverse - self.inverse).div(tangent - self.tangent);
        let rate = L::F::select(rises, rate, L::F::splat(0.0));
        let base = L::F::select(rises, inverse, self.inverse);
        let limit = self.tangent.max(tangent);
        self.rate = L::F::select(lanes, rate, self.rate);
        self.base = L::F::select(lanes, base, self.base);
        self.limit = L::F::select(lanes, limit, self.limit);
        self.near = L::F::select(lanes, self.inverse, self.near);
        self.inverse = L::F::select(lanes, inverse, self.inverse);
        self.tangent = L::F::select(lanes, tangent, self.tangent);
    }

    /// Whether rays that rise by `rise` over `across` meet the stretch, if they have passed
    /// over all before.
    #[inline(always)]
    pub fn is_met(&self, rise: L::F, across: L::F) -> L::M {
        rise.le(self.limit * across)
    }

    /// One over the distance at which they meet it, times `across`. Ground that does not
    /// rise as seen from the camera is met where it begins, as by rays from below it.
    #[inline(always)]
    pub fn contact(&self, rise: L::F, across: L::F) -> L::F {
        let found = across * self.base + self.rate * (rise - self.tangent * across);
        found.min(across * self.near)
    }
}
