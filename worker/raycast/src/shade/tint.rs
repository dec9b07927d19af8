//! Colours for terrain without a photo: by height, and rock where it is steep.

use super::slope::lerp;
use crate::lanes::{Floats, Lanes};
use terrafarm_common::shading::LinearRgb;

/// Heights and their colours, linear light: lowland green, meadow, dry slopes, rock, snow.
const RAMP: [(f32, LinearRgb); 7] = [
    (-50.0, [0.07, 0.15, 0.07]),
    (200.0, [0.10, 0.20, 0.06]),
    (700.0, [0.19, 0.25, 0.08]),
    (1300.0, [0.31, 0.28, 0.12]),
    (2000.0, [0.30, 0.23, 0.15]),
    (2800.0, [0.42, 0.39, 0.36]),
    (3600.0, [0.82, 0.84, 0.88]),
];
const ROCK: LinearRgb = [0.24, 0.21, 0.18];
/// Squared slope at which rock begins to show, and at which nothing else is left.
const ROCK_SLOPES: [f32; 2] = [0.35, 1.6];

/// The tint of ground at a height, metres, with slopes along x and y.
#[inline(always)]
pub(crate) fn tint<L: Lanes>(height: L::F, slopes: [L::F; 2]) -> [L::F; 3] {
    let (zero, one) = (L::F::splat(0.0), L::F::splat(1.0));
    let mut color = [
        L::F::splat(RAMP[0].1[0]),
        L::F::splat(RAMP[0].1[1]),
        L::F::splat(RAMP[0].1[2]),
    ];
    let mut step = 1;
    while step < RAMP.len() {
        let ((low, from), (high, to)) = (RAMP[step - 1], RAMP[step]);
        let share = (height - L::F::splat(low)) * L::F::splat(1.0 / (high - low));
        let share = share.max(zero).min(one);
        for c in 0..3 {
            color[c] = color[c] + share * L::F::splat(to[c] - from[c]);
        }
        step += 1;
    }
    let steep = slopes[0] * slopes[0] + slopes[1] * slopes[1];
    let rock = (steep - L::F::splat(ROCK_SLOPES[0]))
        * L::F::splat(1.0 / (ROCK_SLOPES[1] - ROCK_SLOPES[0]));
    let rock = rock.max(zero).min(one);
    [
        lerp::<L>(color[0], L::F::splat(ROCK[0]), rock),
        lerp::<L>(color[1], L::F::splat(ROCK[1]), rock),
        lerp::<L>(color[2], L::F::splat(ROCK[2]), rock),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lanes::One;

    fn at(height: f32, slope: f32) -> LinearRgb {
        let color = tint::<One>(Floats::splat(height), [Floats::splat(slope), Floats::splat(0.0)]);
        color.map(|channel| {
            let mut value = [0.0];
            channel.store(&mut value);
            value[0]
        })
    }

    #[test]
    fn the_ramp_is_continuous_and_bounded() {
        let mut last = at(-1000.0, 0.0);
        for step in 0..60_000 {
            let color = at(-1000.0 + step as f32 * 0.1, 0.0);
            for c in 0..3 {
                assert!((color[c] - last[c]).abs() < 1e-3 && (0.0..=1.0).contains(&color[c]));
            }
            last = color;
        }
        let near = |a: LinearRgb, b: LinearRgb| (0..3).all(|c| (a[c] - b[c]).abs() < 1e-6);
        assert!(RAMP.iter().all(|&(height, color)| near(at(height, 0.0), color)));
        assert!(near(at(100.0, 9.0), ROCK));
    }
}
