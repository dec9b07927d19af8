//! The ground along N lines: from vertex to vertex, and which rays meet it in between.
//!
//! A vertex is a point of the ground over a line. Seen from the camera it lies on a ray, whose
//! number is between the whole ones, at a depth; from one vertex to the next the ground counts
//! as straight: along it one over the depth is linear in the number. So a stretch between
//! two vertices is met by the rays up to the greater of its two numbers, and all of them find
//! `a + n b` (the drawing step of voxel columns, Cohen-Or et al., section 2, with
//! perspective-correct interpolation). Where the ground within a cell, or the Earth under
//! it, bends too much for that, a cell has more vertices.

use super::Rows;
use super::lines::seen_height;
use crate::lanes::{Floats, Ints, Lanes, Mask};
use crate::relief::Relief;

/// The most stretches that a cell is cut into.
const MOST_STRETCHES: f32 = 64.0;
/// What counts as no distance from the camera, metres: less than that of what a ray along
/// the axis sees from a millimetre.
const NO_DISTANCE: f32 = 1e-9;
/// What counts as no depth: one over it, times metres, is still a number.
const NO_DEPTH: f32 = 1e-20;
/// Beyond all rays there are: these are whole numbers that an f32 holds.
const FARTHEST_RAY: f32 = (1 << 22) as f32;
/// Part of the way from ray to ray within which ground counts as equally far. Rounding is up
/// to a tenth of that a thousand rays from the first.
const SHORT_RAYS: f32 = 1.0 / 512.0;

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

/// A point of the ground over each line, as the camera sees it.
#[derive(Clone, Copy)]
struct Vertex<L: Lanes> {
    /// Distance along the map.
    s: L::F,
    /// The ray through it, between the whole ones; and one over its depth, so that over
    /// a straight stretch this is linear in the ray. Behind the plane through the camera, where
    /// rays of the line never come to, both go on beyond infinity: the depth is negative.
    ray: L::F,
    inverse: L::F,
    /// Up to this, rays do not pass over it. Behind the plane that is all of them, if the plane
    /// rises along the line and the point is above it, or none, if it falls.
    limit: L::F,
}

/// The ground between two vertices.
#[derive(Clone, Copy)]
pub(super) struct Stretch<L: Lanes> {
    before: Vertex<L>,
    last: Vertex<L>,
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

impl<L: Lanes> Vertex<L> {
    fn none() -> Self {
        let zero = L::F::splat(0.0);
        Vertex { s: zero, ray: zero, inverse: zero, limit: zero }
    }

    /// A point at a distance `s`, of a height over the camera.
    #[inline(always)]
    fn new(relief: &Relief, rows: &Rows<L>, s: L::F, height: L::F) -> Self {
        let zero = L::F::splat(0.0);
        let s = s.max(L::F::splat(NO_DISTANCE));
        let height = seen_height::<L>(relief, s, height);
        let depth = rows.higher * s - rows.longer * height;
        let least = L::F::splat(NO_DEPTH);
        let depth = L::F::select(depth.abs().lt(least), least, depth);
        let share = L::F::splat(1.0).div(depth);
        let ray = (height * rows.length - rows.rise * s) * share;
        let limit = L::F::select(zero.lt(depth), ray, rows.hidden);
        Vertex { s, ray, inverse: rows.turn * share, limit }
    }

    #[inline(always)]
    fn select(lanes: L::M, yes: Self, no: Self) -> Self {
        Vertex {
            s: L::F::select(lanes, yes.s, no.s),
            ray: L::F::select(lanes, yes.ray, no.ray),
            inverse: L::F::select(lanes, yes.inverse, no.inverse),
            limit: L::F::select(lanes, yes.limit, no.limit),
        }
    }
}

impl<L: Lanes> Stretch<L> {
    pub fn new() -> Self {
        Stretch { before: Vertex::none(), last: Vertex::none() }
    }

    /// Puts the first vertex of a piece of ground.
    #[inline(always)]
    pub fn begin(&mut self, relief: &Relief, rows: &Rows<L>, s: L::F, height: L::F, lanes: L::M) {
        let vertex = Vertex::new(relief, rows, s, height);
        self.last = Vertex::select(lanes, vertex, self.last);
    }

    /// Goes on to the next vertex.
    #[inline(always)]
    pub fn reach(&mut self, relief: &Relief, rows: &Rows<L>, s: L::F, height: L::F, lanes: L::M) {
        let vertex = Vertex::new(relief, rows, s, height);
        self.before = Vertex::select(lanes, self.last, self.before);
        self.last = Vertex::select(lanes, vertex, self.last);
    }

    /// Whether a ray meets the stretch, if it has passed over all before.
    #[inline(always)]
    pub fn is_met(&self, ray: L::F) -> L::M {
        ray.le(self.before.limit.max(self.last.limit))
    }

    /// The first ray that passes over the stretch.
    #[inline(always)]
    pub fn next(&self) -> L::F {
        after::<L>(self.before.limit.max(self.last.limit))
    }

    /// Whether a ray comes from below the ground where the stretch begins: if it has met none
    /// before.
    #[inline(always)]
    pub fn is_below(&self, ray: L::F) -> L::M {
        ray.le(self.before.limit)
    }

    /// The first ray that does not.
    #[inline(always)]
    pub fn above(&self) -> L::F {
        after::<L>(self.before.limit)
    }

    /// What rays from below find: one over the depth of the ground at the distance at which
    /// the stretch begins, at ray 0, and how that changes from ray to ray.
    #[inline(always)]
    pub fn wall(&self, rows: &Rows<L>) -> [L::F; 2] {
        let inverse = L::F::splat(1.0).div(self.before.s);
        [rows.length * inverse, rows.longer * inverse]
    }

    /// One over the depth of the plane that goes along the stretch, at ray 0, and how that
    /// changes from ray to ray.
    #[inline(always)]
    pub fn plane(&self) -> [L::F; 2] {
        let (before, last) = (&self.before, &self.last);
        let rays = last.ray - before.ray;
        let change = (last.inverse - before.inverse).div(rays);
        let short = rays.abs().lt(L::F::splat(SHORT_RAYS));
        let change = L::F::select(short, L::F::splat(0.0), change);
        // From the vertex closer to ray 0: the other one may be so far from it that nothing is
        // left of what is added.
        let near = before.ray.abs().le(last.ray.abs());
        let ray = L::F::select(near, before.ray, last.ray);
        let inverse = L::F::select(near, before.inverse, last.inverse);
        [inverse - ray * change, change]
    }

    /// One over the greater depth of the two vertices.
    #[inline(always)]
    pub fn least(&self) -> L::F {
        self.before.inverse.min(self.last.inverse)
    }
}

/// The first ray behind a distance that meets a plane, as [`Stretch::plane`] has it.
#[inline(always)]
pub(super) fn first_behind<L: Lanes>(rows: &Rows<L>, [start, change]: [L::F; 2], s: L::F) -> L::F {
    let inverse = L::F::splat(1.0).div(s.max(L::F::splat(NO_DISTANCE)));
    after::<L>((rows.length * inverse - start).div(change - rows.longer * inverse))
}

/// The first whole ray after a place between rays.
#[inline(always)]
fn after<L: Lanes>(ray: L::F) -> L::F {
    let most = L::F::splat(FARTHEST_RAY);
    (ray.max(-most).min(most).floor() + L::I::splat(1)).to_floats()
}
