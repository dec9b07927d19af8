//! Value noise in octaves: the terrain that ray casters are compared on.
//!
//! Octaves have wavelengths of 1024 posts down to 2; each is 0.53 as high as the one
//! before, and a quintic eases between the values. It is rough at every scale, which real
//! terrain is not: the worst that a skipping method can meet.

/// Every height is a multiple of this, metres.
pub const QUANTUM_M: f32 = 0.125;
/// Mean height, metres.
const MEAN_M: f32 = 1800.0;
/// Amplitude of the first octave, metres.
const RELIEF_M: f32 = 1000.0;
const LONGEST_POSTS: u64 = 1024;
const PERSISTENCE: f32 = 0.53;
const SEED: u64 = 12;
const RANGE_M: (f32, f32) = (0.0, 6500.0);

/// Height of a post, metres.
pub fn height(i: u64, j: u64) -> f32 {
    let sum = octaves()
        .fold(MEAN_M, |sum, (wave, amplitude, seed)| sum + amplitude * octave(i, j, wave, seed));
    in_steps(sum)
}

/// Heights of a row of posts from (i, j) eastwards, bit for bit those of [`height`]: what
/// neighbours share is computed once.
pub fn row(i: u64, j: u64, into: &mut [f32]) {
    into.fill(MEAN_M);
    for (wave, amplitude, seed) in octaves() {
        let (row, v) = (j / wave, ease((j % wave) as f32 / wave as f32));
        let corners = |column| [unit(column, row, seed), unit(column, row + 1, seed)];
        let [mut sw, mut nw] = corners(i / wave);
        let mut post = i;
        let mut rest = &mut *into;
        while !rest.is_empty() {
            let [se, ne] = corners(post / wave + 1);
            let count = ((wave - post % wave) as usize).min(rest.len());
            let (cell, after) = rest.split_at_mut(count);
            for (sum, step) in cell.iter_mut().zip(post % wave..) {
                let u = ease(step as f32 / wave as f32);
                let (south, north) = (sw + (se - sw) * u, nw + (ne - nw) * u);
                *sum += amplitude * (south + (north - south) * v);
            }
            [sw, nw] = [se, ne];
            post += count as u64;
            rest = after;
        }
    }
    into.iter_mut().for_each(|height| *height = in_steps(*height));
}

/// Wavelengths in posts, amplitudes in metres, and seeds.
fn octaves() -> impl Iterator<Item = (u64, f32, u64)> {
    let next = |&(wave, amplitude, seed): &(u64, f32, u64)| {
        (wave > 2).then(|| (wave / 2, amplitude * PERSISTENCE, seed + 1))
    };
    std::iter::successors(Some((LONGEST_POSTS, RELIEF_M, SEED)), next)
}

fn in_steps(height: f32) -> f32 {
    (height.clamp(RANGE_M.0, RANGE_M.1) / QUANTUM_M).round() * QUANTUM_M
}

fn ease(t: f32) -> f32 {
    t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
}

fn octave(i: u64, j: u64, wave: u64, seed: u64) -> f32 {
    let (column, row) = (i / wave, j / wave);
    let u = ease((i % wave) as f32 / wave as f32);
    let v = ease((j % wave) as f32 / wave as f32);
    let at = |di, dj| unit(column + di, row + dj, seed);
    let south = at(0, 0) + (at(1, 0) - at(0, 0)) * u;
    let north = at(0, 1) + (at(1, 1) - at(0, 1)) * u;
    south + (north - south) * v
}

/// A number from -1 to 1 out of three, by the finaliser of splitmix64.
pub fn unit(x: u64, y: u64, seed: u64) -> f32 {
    let mut bits = x.wrapping_mul(0x9E37_79B9_7F4A_7C15)
        ^ y.wrapping_mul(0xC2B2_AE3D_27D4_EB4F)
        ^ seed.wrapping_mul(0x1656_67B1_9E37_79F9);
    bits = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    bits = (bits ^ (bits >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((bits >> 40) as f32) / 8_388_608.0 - 1.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_is_its_posts_bit_for_bit() {
        for (i, j) in [(0, 0), (1_048_570, 1_048_577), (77, 1023), (1, 512)] {
            let mut heights = [0.0; 259];
            row(i, j, &mut heights);
            for (post, height) in (i..).zip(heights) {
                assert_eq!(height.to_bits(), super::height(post, j).to_bits(), "{post} {j}");
            }
        }
        row(5, 5, &mut []);
    }

    #[test]
    fn relief_is_about_two_kilometres_and_rough_from_post_to_post() {
        let heights: Vec<f32> = (0..4096).map(|n| height(n % 64 * 61, n / 64 * 61)).collect();
        let low = heights.iter().copied().fold(f32::INFINITY, f32::min);
        let high = heights.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        assert!((1500.0..4500.0).contains(&(high - low)), "{low} {high}");
        assert!((0..100).any(|i| (height(i, 7) - height(i + 1, 7)).abs() > 3.0));
    }
}
