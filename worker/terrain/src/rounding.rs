//! The steps to which computed heights are rounded.
//!
//! Heights that are copied from a file are never changed. Those that are computed (by
//! reprojection, by the filter of a coarser level, by synthesis) have digits that mean
//! nothing and cost two bytes a post in memory and more on disk. They are rounded to a
//! power of two that goes by the distance between posts:
//!
//! - The step is at most 1/128 of the spacing, so that a slope, taken over two cells as
//!   shading does, is off by at most 1/256: a shade of grey.
//! - The codes of a tile (see [`crate::tile`]) reach 65 533 steps. Up to a step of 1/8 m,
//!   which is 8191 m of relief, that is at least the width of the tile: 45 degrees from
//!   one side to the other. What is steeper is kept as floats.
//! - It is the same for all tiles of a level, which share posts, and known before any
//!   height is: one absurd height cannot spoil the others.

/// The coarsest step, metres.
const COARSEST_M: f64 = 1.0 / 8.0;
/// The finest, metres: the finest that [`crate::tile`] keeps in two bytes.
const FINEST_M: f64 = 1.0 / 1024.0;
/// Steps within the distance between two posts ...
const STEPS_IN_SPACING: f64 = 128.0;
/// ... and the fewest that may be, where the finest step is too coarse for that.
const FEWEST_STEPS_IN_SPACING: f64 = 64.0;

/// The step for computed heights of posts so far apart along x and y, metres: a power of
/// two. `None` where posts are nearer than 1/16 m: those are better not rounded.
pub fn step_m(spacing_m: [f64; 2]) -> Option<f64> {
    let spacing_m = spacing_m[0].min(spacing_m[1]);
    let mut step = COARSEST_M;
    while step > FINEST_M && step * STEPS_IN_SPACING > spacing_m {
        step /= 2.0;
    }
    (step * FEWEST_STEPS_IN_SPACING <= spacing_m).then_some(step)
}

/// The nearest whole multiple of a step, if there is one; NaN stays NaN.
pub fn rounded(height_m: f64, step_m: Option<f64>) -> f32 {
    let rounded = step_m.map_or(height_m, |step| (height_m / step).round() * step);
    // Adding zero makes −0 a plain 0.
    rounded as f32 + 0.0
}

/// A step as people write it: "1/16 m", "0.1 m".
pub fn in_words(step_m: f64) -> String {
    let parts = 1.0 / step_m;
    if parts.fract() == 0.0 && parts > 1.0 && (parts as u64).is_power_of_two() {
        format!("1/{parts} m")
    } else {
        format!("{step_m} m")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_step_follows_the_nearer_spacing() {
        for (spacing, step) in [
            (1000.0, Some(1.0 / 8.0)),
            (90.0, Some(1.0 / 8.0)),
            (25.0, Some(1.0 / 8.0)),
            (16.0, Some(1.0 / 8.0)),
            (15.0, Some(1.0 / 16.0)),
            (10.0, Some(1.0 / 16.0)),
            (4.0, Some(1.0 / 32.0)),
            (1.0, Some(1.0 / 128.0)),
            (0.25, Some(1.0 / 512.0)),
            (0.125, Some(1.0 / 1024.0)),
            (0.0625, Some(1.0 / 1024.0)),
            (0.06, None),
            (1e-300, None),
        ] {
            assert_eq!(step_m([spacing, 2000.0]), step, "{spacing} m");
            assert_eq!(step_m([2000.0, spacing]), step, "{spacing} m");
        }
    }

    #[test]
    fn rounding_takes_the_nearest_step_and_makes_no_negative_zero() {
        assert_eq!(rounded(10.04, Some(1.0 / 16.0)), 10.0625);
        assert_eq!(rounded(-10.04, Some(0.1)), -10.0);
        assert_eq!(rounded(10.04, None), 10.04);
        assert_eq!(rounded(-0.001, Some(0.125)).to_bits(), 0);
        assert!(rounded(f64::NAN, Some(0.125)).is_nan());
    }

    #[test]
    fn steps_are_written_as_people_do() {
        assert_eq!(in_words(1.0 / 16.0), "1/16 m");
        assert_eq!(in_words(0.1), "0.1 m");
        assert_eq!(in_words(1.0), "1 m");
        assert_eq!(in_words(0.3048), "0.3048 m");
    }
}
