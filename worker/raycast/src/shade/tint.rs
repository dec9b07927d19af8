//! Colours for terrain without a photo: by height, and rock where it is steep.

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
pub(crate) fn tint(height: f64, slopes: [f64; 2]) -> LinearRgb {
    let height = height as f32;
    let above = RAMP.iter().position(|&(step, _)| height < step).unwrap_or(RAMP.len());
    let color = if above == 0 {
        RAMP[0].1
    } else if above == RAMP.len() {
        RAMP[RAMP.len() - 1].1
    } else {
        let ((low, from), (high, to)) = (RAMP[above - 1], RAMP[above]);
        mix(from, to, (height - low) / (high - low))
    };
    let steep = (slopes[0] * slopes[0] + slopes[1] * slopes[1]) as f32;
    let rock = (steep - ROCK_SLOPES[0]) / (ROCK_SLOPES[1] - ROCK_SLOPES[0]);
    mix(color, ROCK, rock.clamp(0.0, 1.0))
}

fn mix(from: LinearRgb, to: LinearRgb, share: f32) -> LinearRgb {
    [0, 1, 2].map(|c| from[c] + (to[c] - from[c]) * share)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ramp_is_continuous_and_bounded() {
        let mut last = tint(-1000.0, [0.0, 0.0]);
        for step in 0..60_000 {
            let color = tint(-1000.0 + f64::from(step) * 0.1, [0.0, 0.0]);
            for c in 0..3 {
                assert!((color[c] - last[c]).abs() < 1e-3 && (0.0..=1.0).contains(&color[c]));
            }
            last = color;
        }
        assert_eq!(tint(100.0, [9.0, 0.0]), ROCK);
    }
}
