//! The ground that a pixel covers: an ellipse on the map.

use glam::{DVec2, DVec3};

/// The widest stretch of a footprint by a slanted view. Steeper views of a wall would
/// smear a pixel over the whole map.
const MAX_STRETCH: f64 = 64.0;

/// The two sides of a pixel, laid on the ground.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Footprint {
    sides: [DVec2; 2],
}

/// An ellipse by its axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Axes {
    /// The long axis, whole length, as a vector.
    pub major: DVec2,
    /// Length of the long axis.
    pub major_length: f64,
    /// Length of the short axis.
    pub minor_length: f64,
}

impl Footprint {
    /// Lays the sides of a pixel (vectors across the view, metres) along the unit vector
    /// `view` onto ground of the given slopes.
    pub(crate) fn new(sides: [DVec3; 2], view: DVec3, slopes: [f64; 2]) -> Self {
        let normal = DVec3::new(-slopes[0], -slopes[1], 1.0);
        let facing = view.dot(normal).min(-normal.length() / MAX_STRETCH);
        let sides = sides.map(|side| {
            let along = -side.dot(normal) / facing;
            (side + view * along).truncate()
        });
        Footprint { sides }
    }

    /// The axes in units of `spacing` along x and y.
    pub(crate) fn axes(&self, spacing: [f64; 2]) -> Axes {
        let scale = DVec2::new(1.0 / spacing[0], 1.0 / spacing[1]);
        let [a, b] = self.sides.map(|side| side * scale);
        // Eigenvalues of the sum of a a^T and b b^T.
        let (xx, yy, xy) = (a.x * a.x + b.x * b.x, a.y * a.y + b.y * b.y, a.x * a.y + b.x * b.y);
        let (half_sum, half_difference) = (0.5 * (xx + yy), 0.5 * (xx - yy));
        let root = (half_difference * half_difference + xy * xy).sqrt();
        let major_length = (half_sum + root).sqrt();
        if !major_length.is_normal() {
            return Axes { major: DVec2::ZERO, major_length: 0.0, minor_length: 0.0 };
        }
        // An eigenvector has two forms; the one without cancellation is taken.
        let eigenvector = if half_difference >= 0.0 {
            DVec2::new(half_difference + root, xy)
        } else {
            DVec2::new(xy, root - half_difference)
        };
        let length = eigenvector.length();
        let direction = if length > 0.0 { eigenvector / length } else { DVec2::X };
        let area = (a.x * b.y - a.y * b.x).abs();
        Axes { major: direction * major_length, major_length, minor_length: area / major_length }
    }
}

/// A size in samples as a level of a pyramid and the share of the next coarser one: sizes
/// 2^n (1 + w) give (n, w), sizes below 1 give (0, 0).
#[inline]
pub(crate) fn level_of(size: f64, last: usize) -> (usize, f32) {
    if size < 1.0 || size.is_nan() {
        return (0, 0.0);
    }
    let bits = size.to_bits();
    let level = (bits >> 52) as usize - 1023;
    if level >= last {
        return (last, 0.0);
    }
    let mantissa = f64::from_bits(bits & ((1 << 52) - 1) | (1023 << 52));
    (level, (mantissa - 1.0) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pixel_seen_from_straight_above_is_round() {
        let footprint = Footprint::new([DVec3::X * 2.0, DVec3::Y * 2.0], DVec3::NEG_Z, [0.0, 0.0]);
        let axes = footprint.axes([1.0, 1.0]);
        assert!((axes.major_length - 2.0).abs() < 1e-12 && (axes.minor_length - 2.0).abs() < 1e-12);
    }

    #[test]
    fn a_slanted_view_stretches_along_the_view_whatever_the_roll() {
        let (sin, cos) = (0.1, (1.0f64 - 0.01).sqrt());
        let view = DVec3::new(cos, 0.0, -sin);
        let (right, up) = (DVec3::NEG_Y, DVec3::new(sin, 0.0, cos));
        for roll in [0.0, 0.3, 0.8, 1.5] {
            let (s, c) = (libm::sin(roll), libm::cos(roll));
            let sides = [right * c + up * s, up * c - right * s];
            let axes = Footprint::new(sides, view, [0.0, 0.0]).axes([1.0, 1.0]);
            assert!((axes.major_length - 10.0).abs() < 1e-9, "{axes:?}");
            assert!((axes.minor_length - 1.0).abs() < 1e-9, "{axes:?}");
            assert!((axes.major.x.abs() - 10.0).abs() < 1e-9 && axes.major.y.abs() < 1e-9);
        }
    }

    #[test]
    fn levels_are_continuous_in_size() {
        assert_eq!(level_of(0.3, 5), (0, 0.0));
        assert_eq!(level_of(1.0, 5), (0, 0.0));
        assert_eq!(level_of(3.0, 5), (1, 0.5));
        assert_eq!(level_of(1e9, 5), (5, 0.0));
        assert_eq!(level_of(f64::NAN, 5), (0, 0.0));
        assert_eq!(level_of(f64::INFINITY, 5), (5, 0.0));
        assert_eq!(level_of(7.0, 0), (0, 0.0));
    }
}
