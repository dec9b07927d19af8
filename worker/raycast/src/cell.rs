//! One cell of the surface and one piece of a ray: where the two meet.
//!
//! The surface in a cell is the bilinear interpolant of its four posts, the ray a
//! parabola over its map line, so the height of the ray above the surface is a quadratic
//! in u. It is held by its values at both ends of the piece and its bend:
//! with s from 0 to 1 along the piece,
//!
//! `g(s) = g0 (1 - s) + g1 s - bend s (1 - s)`.
//!
//! The values at the ends are what makes the surface watertight. On a grid line the
//! surface is the straight line between two posts, computed by one function from these
//! two alone, so the cells on both sides get the same bits and no ray slips between
//! them. There is no tolerance anywhere in the decision.

use crate::grid::GridRay;

/// The corners of a cell, metres, and what follows from them.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Corners {
    /// South-west, south-east, north-west, north-east.
    heights: [f64; 4],
}

impl Corners {
    /// `None` for a cell that has no surface: a corner is void.
    #[inline(always)]
    pub(crate) fn new(heights: [f32; 4]) -> Option<Self> {
        let [sw, se, nw, ne] = heights;
        let heights = [f64::from(sw), f64::from(se), f64::from(nw), f64::from(ne)];
        let sum = heights[0] + heights[1] + heights[2] + heights[3];
        sum.is_finite().then_some(Corners { heights })
    }

    /// Height at a place within the cell, 0 to 1 along each axis.
    #[inline]
    pub(crate) fn height(&self, x: f64, y: f64) -> f64 {
        let [sw, se, nw, ne] = self.heights;
        lerp(lerp(sw, se, x), lerp(nw, ne, x), y)
    }

    /// Coefficient of x y in the height.
    #[inline(always)]
    fn twist(&self) -> f64 {
        let [sw, se, nw, ne] = self.heights;
        (sw - se) + (ne - nw)
    }

    /// Height on the line that the ray crosses at `u`. `axis` is the axis that the line
    /// cuts, `far` whether it is the eastern or northern side of cell `cell`.
    #[inline(always)]
    pub(crate) fn edge_height(
        &self,
        ray: &GridRay,
        cell: [i32; 2],
        axis: usize,
        far: bool,
        u: f64,
    ) -> f64 {
        let [sw, se, nw, ne] = self.heights;
        let along = 1 - axis;
        let place = (ray.position(along, u) - f64::from(cell[along])).clamp(0.0, 1.0);
        let (first, second) = match (axis, far) {
            (0, false) => (sw, nw),
            (0, true) => (se, ne),
            (_, false) => (sw, se),
            (_, true) => (nw, ne),
        };
        lerp(first, second, place)
    }

    /// Height under the ray at `u`, anywhere in the cell.
    #[inline]
    pub(crate) fn height_under(&self, ray: &GridRay, cell: [i32; 2], u: f64) -> f64 {
        let place = place_in_cell(ray, cell, u);
        self.height(place[0], place[1])
    }

    /// How much the surface bends under a piece of the ray of length `length`.
    #[inline(always)]
    pub(crate) fn bend(&self, ray: &GridRay, length: f64) -> f64 {
        self.twist() * (ray.rate[0] * length) * (ray.rate[1] * length)
    }
}

/// Where in a cell the ray is at `u`, 0 to 1 along each axis.
#[inline]
pub(crate) fn place_in_cell(ray: &GridRay, cell: [i32; 2], u: f64) -> [f64; 2] {
    let along = |axis| (ray.position(axis, u) - f64::from(cell[axis])).clamp(0.0, 1.0);
    [along(0), along(1)]
}

#[inline(always)]
fn lerp(a: f64, b: f64, t: f64) -> f64 {
    a + (b - a) * t
}

/// The first s in 0..=1 at which the ray is at or below the surface: `g0` and `g1` are
/// its heights above the surface at the ends of the piece.
#[inline(always)]
pub(crate) fn first_contact(g0: f64, g1: f64, bend: f64) -> Option<f64> {
    if g0 <= 0.0 {
        return Some(0.0);
    }
    // g(s) = g0 + b s + bend s^2. Roots by the form that does not cancel.
    let b = (g1 - g0) - bend;
    if g1 > 0.0 {
        // Above at both ends. The lowest point touches zero if bend reaches
        // (sqrt(g0) + sqrt(g1))^2, and then lies between the ends.
        let excess = bend - (g0 + g1);
        if excess <= 0.0 || excess * excess < 4.0 * g0 * g1 {
            return None;
        }
    }
    let root = (b * b - 4.0 * bend * g0).max(0.0).sqrt();
    let s = if b < 0.0 { 2.0 * g0 / (root - b) } else { (b + root) / (-2.0 * bend) };
    Some(s.clamp(0.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn contact_of_lines_and_parabolas() {
        assert_eq!(first_contact(1.0, -1.0, 0.0), Some(0.5));
        assert_eq!(first_contact(0.0, 5.0, 0.0), Some(0.0));
        assert_eq!(first_contact(1.0, 0.0, 0.0), Some(1.0));
        assert_eq!(first_contact(1.0, 1.0, 3.9), None);
        // g = 1 - 4 s (1 - s) touches zero in the middle.
        assert_eq!(first_contact(1.0, 1.0, 4.0), Some(0.5));
        // Concave: rises first, then falls through zero.
        let s = first_contact(1.0, -1.0, -8.0).expect("it falls below");
        assert!((1.0 - 2.0 * s + 8.0 * s * (1.0 - s)).abs() < 1e-12);
    }

    proptest! {
        #[test]
        fn contact_is_the_first_zero(g0 in 1e-6..10.0f64, g1 in -10.0..10.0f64, bend in -40.0..40.0f64) {
            let g = |s: f64| g0 * (1.0 - s) + g1 * s - bend * s * (1.0 - s);
            let sampled = (0..=1000).map(|n| f64::from(n) / 1000.0).find(|&s| g(s) <= 0.0);
            match first_contact(g0, g1, bend) {
                Some(s) => {
                    prop_assert!(g(s).abs() < 1e-9);
                    prop_assert!(sampled.is_none_or(|seen| s <= seen + 1e-9));
                }
                None => prop_assert!(sampled.is_none()),
            }
        }
    }
}
