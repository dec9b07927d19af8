//! Colours with coverage.

/// One colour laid over another; neither is premultiplied.
pub(crate) fn over(top: [u8; 4], below: [u8; 4]) -> [u8; 4] {
    match (top[3], below[3]) {
        (255, _) | (_, 0) => top,
        (0, _) => below,
        (a, b) => {
            let (a, b) = (u32::from(a), u32::from(b));
            let rest = b * (255 - a);
            let sum = a * 255 + rest;
            let mix = |n: usize| {
                let value = u32::from(top[n]) * a * 255 + u32::from(below[n]) * rest;
                ((value + sum / 2) / sum) as u8
            };
            [mix(0), mix(1), mix(2), ((sum + 127) / 255) as u8]
        }
    }
}

/// The mean of four colours with weights that add to 1, coverage taken into account:
/// what is not covered has no colour. Done on sRGB values, as photo software does.
pub(crate) fn mean(colors: [[u8; 4]; 4], weights: [f64; 4]) -> [u8; 4] {
    let mut coverage = 0.0;
    let mut sums = [0.0; 3];
    for (color, weight) in colors.iter().zip(weights) {
        let share = weight * f64::from(color[3]);
        coverage += share;
        for (sum, &value) in sums.iter_mut().zip(color) {
            *sum += share * f64::from(value);
        }
    }
    let alpha = (coverage + 0.5) as u8;
    if alpha == 0 {
        return [0; 4];
    }
    let [r, g, b] = sums.map(|sum| (sum / coverage + 0.5) as u8);
    [r, g, b, alpha]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn full_coverage_hides_and_none_shows() {
        let (red, blue) = ([255, 0, 0, 255], [0, 0, 255, 255]);
        assert_eq!(over(red, blue), red);
        assert_eq!(over([9, 9, 9, 0], blue), blue);
        assert_eq!(over([255, 0, 0, 128], blue), [128, 0, 127, 255]);
    }

    #[test]
    fn a_mean_takes_no_colour_from_what_is_not_covered() {
        let red = [200, 0, 0, 255];
        assert_eq!(mean([red, red, [0; 4], [0; 4]], [0.25; 4]), [200, 0, 0, 128]);
        assert_eq!(mean([red; 4], [0.1, 0.2, 0.3, 0.4]), red);
        assert_eq!(mean([[7; 4]; 4].map(|c| [c[0], c[1], c[2], 0]), [0.25; 4]), [0; 4]);
    }
}
