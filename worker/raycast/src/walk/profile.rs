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
}

/// Cells with vertices inside.
#[derive(Clone, Copy)]
pub(super) struct Cuts<L: Lanes> {
    profile: Profile<L>,
    /// How far through the cell the last vertex is, 0 to 1, and how much further the next.
    t: L::F,
    step: L::F,
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

impl<L: Lanes> Cuts<L> {
    pub fn new() -> Self {
        let (zero, one) = (L::F::splat(0.0), L::F::splat(1.0));
        let profile = Profile { start: zero, end: zero, low: zero, high: zero, curl: zero };
        Cuts { profile, t: one, step: one }
    }

    /// Sets out through cells, as far as there is ground: those in which more than `allowed`
    /// metres a metre away would be between it and a straight line have vertices inside.
    /// Returns the lanes that have more than one left, and the next vertices of all, by
    /// distance and height.
    #[inline(always)]
    pub fn begin(
        &mut self,
        relief: &Relief,
        allowed: f32,
        profile: Profile<L>,
        solid: L::M,
    ) -> (L::M, [L::F; 2]) {
        let Profile { start, end, high, curl, .. } = profile;
        let length = end - start;
        let arc = L::F::splat(0.5 * relief.curvature as f32) * length * length;
        let off = (curl - arc).abs() * L::F::splat(0.25);
        let allowed = L::F::splat(allowed) * start;
        let many = solid & allowed.lt(off);
        if !many.any() {
            return (many, [end, high]);
        }
        let count = off.div(allowed.max(L::F::splat(NO_DISTANCE))).sqrt();
        let count = count.min(L::F::splat(MOST_STRETCHES - 1.0)).floor() + L::I::splat(1);
        let step = L::F::splat(1.0).div(count.to_floats());
        self.profile = Profile::select(many, profile, self.profile);
        self.step = L::F::select(many, step, self.step);
        self.t = L::F::select(many, step, self.t);
        let inside = many & self.is_within();
        let [s, height] = self.vertex();
        (inside, [L::F::select(many, s, end), L::F::select(many, height, high)])
    }

    /// Goes on to the next vertices of lanes. Returns the same.
    #[inline(always)]
    pub fn go_on(&mut self, lanes: L::M) -> (L::M, [L::F; 2]) {
        self.t = L::F::select(lanes, self.t + self.step, self.t);
        (lanes & self.is_within(), self.vertex())
    }

    /// Whether the vertex is inside the cell.
    #[inline(always)]
    fn is_within(&self) -> L::M {
        (L::F::splat(0.5) * self.step).le(L::F::splat(1.0) - self.t)
    }

    /// Distance and height of the vertex.
    #[inline(always)]
    fn vertex(&self) -> [L::F; 2] {
        let Profile { start, end, low, high, curl } = self.profile;
        let within = self.is_within();
        let s = start + self.t * (end - start);
        let height = low + self.t * ((high - low) - curl * (L::F::splat(1.0) - self.t));
        [L::F::select(within, s, end), L::F::select(within, height, high)]
    }
}

impl<L: Lanes> Profile<L> {
    #[inline(always)]
    fn select(lanes: L::M, yes: Self, no: Self) -> Self {
        Profile {
            start: L::F::select(lanes, yes.start, no.start),
            end: L::F::select(lanes, yes.end, no.end),
            low: L::F::select(lanes, yes.low, no.low),
            high: L::F::select(lanes, yes.high, no.high),
            curl: L::F::select(lanes, yes.curl, no.curl),
        }
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
