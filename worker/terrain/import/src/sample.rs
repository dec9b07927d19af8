//! The bilinear surface of samples at any positions.

use crate::mosaic::LatticeWindow;
use crate::request::ImportError;

/// Samples read at once for one window: 16 MB of heights.
const MAX_SAMPLES: i64 = 1 << 22;
/// Positions nearer to a sample than this take it alone: rounding noise must not draw a
/// void neighbour in.
const SNAP: f64 = 1e-6;

/// A sample that can be interpolated.
pub(crate) trait Sample: Copy {
    /// What is found where nothing is.
    const NOTHING: Self;
    /// The mean of south-west, south-east, north-west, north-east (in the order of the
    /// lattice) with fractions along columns and rows.
    fn blend(corners: [Self; 4], fraction: [f64; 2]) -> Self;
}

impl Sample for f32 {
    const NOTHING: f32 = f32::NAN;

    /// A void corner with any weight makes the whole void.
    fn blend(corners: [f32; 4], [s, t]: [f64; 2]) -> f32 {
        if s == 0.0 && t == 0.0 {
            return corners[0];
        }
        let along = |a: f32, b: f32| {
            let (a, b) = (f64::from(a), f64::from(b));
            if s == 0.0 { a } else { a + (b - a) * s }
        };
        let low = along(corners[0], corners[1]);
        if t == 0.0 {
            return low as f32;
        }
        let high = along(corners[2], corners[3]);
        (low + (high - low) * t) as f32
    }
}

impl Sample for [u8; 4] {
    const NOTHING: [u8; 4] = [0; 4];

    fn blend(corners: [[u8; 4]; 4], [s, t]: [f64; 2]) -> [u8; 4] {
        let weights = [(1.0 - s) * (1.0 - t), s * (1.0 - t), (1.0 - s) * t, s * t];
        crate::color::mean(corners, weights)
    }
}

/// The surface at positions given in columns and rows. Positions that are NaN or lie
/// outside `extent` (first column and row, those after the last) give nothing. `read` is
/// asked for windows that hold what is needed.
///
/// # Errors
/// Those of `read`.
pub(crate) fn bilinear<S: Sample>(
    positions: &[[f64; 2]],
    extent: [i64; 4],
    read: &dyn Fn(LatticeWindow) -> Result<Vec<S>, ImportError>,
) -> Result<Vec<S>, ImportError> {
    let mut found = vec![S::NOTHING; positions.len()];
    fill(positions, extent, read, &mut found)?;
    Ok(found)
}

fn fill<S: Sample>(
    positions: &[[f64; 2]],
    extent: [i64; 4],
    read: &dyn Fn(LatticeWindow) -> Result<Vec<S>, ImportError>,
    found: &mut [S],
) -> Result<(), ImportError> {
    let [mut c0, mut r0, mut c1, mut r1] = [i64::MAX, i64::MAX, i64::MIN, i64::MIN];
    for &position in positions {
        if let Some(([c, r], [s, t])) = cell(position, extent) {
            (c0, r0) = (c0.min(c), r0.min(r));
            (c1, r1) = (c1.max(c + i64::from(s > 0.0)), r1.max(r + i64::from(t > 0.0)));
        }
    }
    if c0 > c1 {
        return Ok(());
    }
    let (width, height) = (c1 - c0 + 1, r1 - r0 + 1);
    if width.saturating_mul(height) > MAX_SAMPLES && positions.len() > 1 {
        let half = positions.len() / 2;
        let (first, second) = found.split_at_mut(half);
        fill(&positions[..half], extent, read, first)?;
        return fill(&positions[half..], extent, read, second);
    }
    let window =
        LatticeWindow { column: c0, row: r0, width: width as usize, height: height as usize };
    let samples = read(window)?;
    for (position, found) in positions.iter().zip(found) {
        let Some(([c, r], [s, t])) = cell(*position, extent) else { continue };
        let at = (r - r0) as usize * window.width + (c - c0) as usize;
        let right = usize::from(s > 0.0);
        let up = if t > 0.0 { window.width } else { 0 };
        let corners =
            [samples[at], samples[at + right], samples[at + up], samples[at + up + right]];
        *found = S::blend(corners, [s, t]);
    }
    Ok(())
}

/// The cell in which a position lies, and where in it; `None` outside the extent.
fn cell([u, v]: [f64; 2], extent: [i64; 4]) -> Option<([i64; 2], [f64; 2])> {
    let split = |value: f64, first: i64, end: i64| {
        let nearest = value.round();
        let value = if (value - nearest).abs() < SNAP { nearest } else { value };
        let inside = value >= first as f64 && value <= (end - 1) as f64;
        inside.then(|| (value.floor() as i64, value - value.floor()))
    };
    let (c, s) = split(u, extent[0], extent[2])?;
    let (r, t) = split(v, extent[1], extent[3])?;
    Some(([c, r], [s, t]))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    const EXTENT: [i64; 4] = [0, 0, 3, 2];

    fn at(positions: &[[f64; 2]]) -> Vec<f32> {
        let read = |w: LatticeWindow| {
            let place = |n: usize| [w.column + (n % w.width) as i64, w.row + (n / w.width) as i64];
            let height =
                |[c, r]: [i64; 2]| if c == 2 && r == 1 { f32::NAN } else { (c + 10 * r) as f32 };
            Ok((0..w.len()).map(|n| height(place(n))).collect())
        };
        bilinear(positions, EXTENT, &read).unwrap()
    }

    #[test]
    fn positions_between_samples_are_bilinear() {
        assert_eq!(at(&[[0.5, 0.0], [0.25, 0.5], [1.0, 1.0]]), [0.5, 5.25, 11.0]);
    }

    #[test]
    fn a_void_sample_spoils_exactly_where_it_has_weight() {
        let found =
            at(&[[1.5, 0.5], [1.0, 0.5], [1.5, 0.0], [2.0, 0.0], [2.0, 1.0], [1.0 + 1e-8, 1.0]]);
        let void: Vec<bool> = found.iter().map(|height| height.is_nan()).collect();
        assert_eq!(void, [true, false, false, false, true, false]);
    }

    #[test]
    fn nothing_is_found_outside() {
        let outside = [[-0.1, 0.0], [2.1, 0.0], [0.0, 1.01], [f64::NAN, 0.0], [f64::INFINITY, 0.0]];
        assert!(at(&outside).iter().all(|height| height.is_nan()));
    }
}
