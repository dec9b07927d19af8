//! The ground that a pixel covers: an ellipse on the map, and the strip of texels that
//! stands for it.

use crate::lanes::{Floats, Lanes};

/// The widest stretch of a footprint by a slanted view. Steeper views of a wall would
/// smear a pixel over the whole map.
const MAX_STRETCH: f32 = 64.0;

/// The two sides of a pixel, laid on the ground: metres along x and y.
pub(crate) struct Footprint<L: Lanes> {
    sides: [[L::F; 2]; 2],
}

/// Samples in a row: along x or y, whichever the ellipse is longer along, and along the
/// other axis so much a sample as the ellipse slants.
pub(crate) struct Strip<L: Lanes> {
    /// The row runs along x.
    pub along_x: L::M,
    /// Extent along the axis of the row, in samples.
    pub length: L::F,
    /// Samples along the other axis per sample along this.
    pub slant: L::F,
    /// Lengths of the long and the short axis of the ellipse, in samples.
    pub major: L::F,
    pub minor: L::F,
}

impl<L: Lanes> Footprint<L> {
    /// Lays the sides of a pixel (unit vectors to its right and top, and their length)
    /// along the unit vector `view` onto ground of the given slopes, the length of whose
    /// normal (-slopes, 1) is given.
    #[inline(always)]
    pub(crate) fn new(
        sides: [[f32; 3]; 2],
        length: L::F,
        view: [L::F; 3],
        slopes: [L::F; 2],
        steepness: L::F,
    ) -> Self {
        let facing = view[2] - view[0] * slopes[0] - view[1] * slopes[1];
        let facing = facing.min(-steepness * L::F::splat(1.0 / MAX_STRETCH));
        let reach = length.div(facing);
        Footprint {
            sides: [
                lay::<L>(sides[0], length, reach, view, slopes),
                lay::<L>(sides[1], length, reach, view, slopes),
            ],
        }
    }

    /// The strip for samples so many a metre along x and y.
    #[inline(always)]
    pub(crate) fn strip(&self, rate: [f32; 2]) -> Strip<L> {
        let (rx, ry) = (L::F::splat(rate[0]), L::F::splat(rate[1]));
        let (ax, ay) = (self.sides[0][0] * rx, self.sides[0][1] * ry);
        let (bx, by) = (self.sides[1][0] * rx, self.sides[1][1] * ry);
        // Eigenvalues of the sum of a a^T and b b^T.
        let (xx, yy, xy) = (ax * ax + bx * bx, ay * ay + by * by, ax * ay + bx * by);
        let half = L::F::splat(0.5);
        let (half_sum, half_difference) = ((xx + yy) * half, (xx - yy) * half);
        let root = (half_difference * half_difference + xy * xy).sqrt();
        // What is no number or too small to be one is round and of no size.
        let least = L::F::splat(4e-19);
        let root = root.max(least);
        let square = (half_sum + root).max(least);
        let major = square.sqrt();
        let minor = (ax * by - ay * bx).abs().div(major);
        // The eigenvector of the long axis, its larger part first. The square of its cosine
        // is long / (2 root).
        let long = (half_difference.abs() + root).max(least + least);
        let share = L::F::splat(1.0).div(root * long);
        let slant = xy * root * share;
        let length = major * (long * long * share * half).sqrt();
        Strip { along_x: L::F::splat(0.0).le(half_difference), length, slant, major, minor }
    }
}

/// Length of the normal (-slopes, 1).
#[inline(always)]
pub(crate) fn steepness<L: Lanes>(slopes: [L::F; 2]) -> L::F {
    (slopes[0] * slopes[0] + slopes[1] * slopes[1] + L::F::splat(1.0)).sqrt()
}

/// One side on the ground.
#[inline(always)]
fn lay<L: Lanes>(
    side: [f32; 3],
    length: L::F,
    reach: L::F,
    view: [L::F; 3],
    slopes: [L::F; 2],
) -> [L::F; 2] {
    let (x, y) = (L::F::splat(side[0]), L::F::splat(side[1]));
    let along = (slopes[0] * x + slopes[1] * y - L::F::splat(side[2])) * reach;
    [x * length + view[0] * along, y * length + view[1] * along]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lanes::{Mask, One};

    /// Along x, length, slant, major, minor.
    fn strip(
        sides: [[f32; 3]; 2],
        size: f32,
        view: [f32; 3],
        slopes: [f32; 2],
    ) -> (bool, [f32; 4]) {
        let view = view.map(Floats::splat);
        let slopes = slopes.map(Floats::splat);
        let footprint = Footprint::<One>::new(
            sides,
            Floats::splat(size),
            view,
            slopes,
            steepness::<One>(slopes),
        );
        let strip = footprint.strip([1.0, 1.0]);
        let values = [strip.length, strip.slant, strip.major, strip.minor].map(|value| {
            let mut out = [0.0];
            value.store(&mut out);
            out[0]
        });
        (strip.along_x.any(), values)
    }

    #[test]
    fn a_pixel_seen_from_straight_above_is_round() {
        let sides = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
        let (_, [length, slant, major, minor]) = strip(sides, 2.0, [0.0, 0.0, -1.0], [0.0; 2]);
        assert_eq!([length, slant, major, minor], [2.0, 0.0, 2.0, 2.0]);
        let (_, [length, _, major, minor]) = strip(sides, 0.0, [0.0, 0.0, -1.0], [0.0; 2]);
        assert!(length < 1e-9 && major < 1e-9 && minor == 0.0);
    }

    #[test]
    fn a_slanted_view_stretches_along_the_view_whatever_the_roll() {
        let (sin, cos) = (0.1f32, 0.994_987_4f32);
        for (heading, x) in [(0.0f64, true), (0.5, true), (1.2, false), (2.0, false), (3.0, true)] {
            let (hs, hc) = (libm::sin(heading) as f32, libm::cos(heading) as f32);
            let view = [cos * hc, cos * hs, -sin];
            let (right, up) = ([hs, -hc, 0.0], [sin * hc, sin * hs, cos]);
            for roll in [0.0f64, 0.3, 0.8, 1.5] {
                let (s, c) = (libm::sin(roll) as f32, libm::cos(roll) as f32);
                let mix = |a: [f32; 3], p: f32, b: [f32; 3], q: f32| {
                    [0, 1, 2].map(|n| a[n] * p + b[n] * q)
                };
                let sides = [mix(right, c, up, s), mix(up, c, right, -s)];
                let (along_x, [length, slant, major, minor]) = strip(sides, 1.0, view, [0.0, 0.0]);
                assert!((major - 10.0).abs() < 1e-4 && (minor - 1.0).abs() < 1e-4);
                assert_eq!(along_x, x, "{heading}");
                let (longer, shorter) = if x { (hc, hs) } else { (hs, hc) };
                assert!((slant - shorter / longer).abs() < 1e-4, "{heading} {slant}");
                assert!((length - 10.0 * longer.abs()).abs() < 1e-3, "{heading} {length}");
            }
        }
    }
}
