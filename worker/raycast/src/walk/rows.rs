//! The rays of N lines, and where what they find belongs.

use crate::lanes::{Floats, Lanes};

/// A bound of what rounding adds to the parts of [`Rows::tangent`] and of a vertex, as a share
/// of what they are made of: each is rounded at most six times, by 6e-8.
const ROUNDING: f32 = 4e-7;

/// The rays of each line, in the order in which they rise: ray n has the tangent of
/// elevation `(rise + n higher) / (length + n longer)`.
pub(crate) struct Rows<L: Lanes> {
    pub(super) rise: L::F,
    pub(super) higher: L::F,
    pub(super) length: L::F,
    pub(super) longer: L::F,
    /// `length higher - longer rise`.
    pub(super) turn: L::F,
    /// The last ray that does not pass over ground behind the plane through the camera that
    /// all rays leave on the same side.
    pub(super) hidden: L::F,
    /// The first ray, and the last one of those that are cast.
    pub(super) first: i32,
    last: i32,
}

/// Where answers belong. What a ray finds is an inverse depth: the ray's length along the map,
/// `length + n longer`, over the distance at which it meets the ground. Of flat ground it is
/// a plane over the picture, so that many rays of a line find `a + n b`. For the first of
/// these `a` is written at `at + (n - first) pitch`, and `b` so many places behind; the
/// others are left as they are.
pub(crate) struct Places<L: Lanes> {
    pub at: L::I,
    pub pitch: i32,
    /// None if there is but one ray: `b` is not wanted then.
    pub behind: Option<i32>,
}

impl<L: Lanes> Rows<L> {
    /// Rays that rise by `rise` over `length`, and by `higher` more over `longer` more from
    /// ray to ray.
    #[inline(always)]
    pub(crate) fn new(
        [rise, higher]: [L::F; 2],
        [length, longer]: [L::F; 2],
        first: i32,
        last: i32,
    ) -> Self {
        let turn = length * higher - longer * rise;
        let all = L::F::splat(f32::INFINITY);
        let hidden = L::F::select(longer.lt(L::F::splat(0.0)), -all, all);
        Rows { rise, higher, length, longer, turn, hidden, first, last }
    }

    /// The last ray.
    #[inline(always)]
    pub(super) fn last(&self) -> L::F {
        L::F::splat(self.last as f32)
    }

    /// Tangents of elevation; and by how much heights that a ray is compared with may seem off
    /// by rounding, metres for each metre of the way.
    #[inline(always)]
    pub(super) fn tangent(&self, ray: L::F) -> (L::F, L::F) {
        let (higher, longer) = (ray * self.higher, ray * self.longer);
        let share = L::F::splat(1.0).div(self.length + longer);
        let tangent = (self.rise + higher) * share;
        let rounded = self.rise.abs() + higher.abs() + tangent.abs() * (self.length + longer.abs());
        (tangent, rounded * share * L::F::splat(ROUNDING))
    }
}
