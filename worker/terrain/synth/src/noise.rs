//! Noise as a pure function of position: gradient noise, sums of it, and gullies that
//! run down a slope.
//!
//! Everything here is additions, multiplications and integer hashing, so a value is the
//! same, bit for bit, on every machine.

/// A mixing of the bits of a lattice point: different enough for neighbours.
#[inline]
fn hash(x: u32, y: u32, seed: u32) -> u32 {
    let mut h = x.wrapping_mul(0x8DA6_B343) ^ y.wrapping_mul(0xD816_3841) ^ seed;
    h = (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
    h = (h ^ (h >> 12)).wrapping_mul(0x297A_2D39);
    h ^ (h >> 15)
}

/// 0 below `low`, 1 above `high`, smooth between; falls if `high < low`.
#[inline]
pub(crate) fn smoothstep(low: f32, high: f32, x: f32) -> f32 {
    let t = ((x - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Linear blend.
#[inline]
pub(crate) fn mix(a: f32, b: f32, share: f32) -> f32 {
    a + (b - a) * share
}

/// Cosine of an angle in turns, by a polynomial: error below 1e-3, slope smooth enough
/// for waves.
#[inline]
pub(crate) fn cos_turns(turns: f32) -> f32 {
    let t = turns - (turns + 0.5).floor();
    let s = 16.0 * t * t;
    // cos(pi/2 * sqrt(s)) for s in 0..4, exact at s = 0, 1 and 4.
    1.0 + s * (-1.233_700_5 + s * (0.253_669_5 + s * (-0.020_863_1 + s * 0.000_825_5)))
}

/// One stream of noise; streams of different purpose or seed are unrelated.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Noise {
    seed: u32,
}

impl Noise {
    /// The stream of a purpose within a terrain.
    pub fn new(seed: u64, purpose: u32) -> Self {
        let low = hash(seed as u32, purpose, 0x9E37_79B9);
        Noise { seed: hash((seed >> 32) as u32, low, 0x85EB_CA6B) }
    }

    /// Uniform in 0..1, for a lattice point.
    #[inline]
    pub fn uniform(&self, x: i64, y: i64) -> f32 {
        (hash(x as u32, y as u32, self.seed) >> 8) as f32 * (1.0 / 16_777_216.0)
    }

    /// Gradient noise of wavelength 1, about −1 to 1, mean 0.
    #[inline]
    pub fn at(&self, x: f64, y: f64) -> f32 {
        let (floor_x, floor_y) = (x.floor(), y.floor());
        let (fx, fy) = ((x - floor_x) as f32, (y - floor_y) as f32);
        let (ix, iy) = (floor_x as i64 as u32, floor_y as i64 as u32);
        let corner = |dx: u32, dy: u32| {
            let h = hash(ix.wrapping_add(dx), iy.wrapping_add(dy), self.seed);
            let gx = (h & 0xFFFF) as f32 * (1.0 / 32_768.0) - 1.0;
            let gy = (h >> 16) as f32 * (1.0 / 32_768.0) - 1.0;
            gx * (fx - dx as f32) + gy * (fy - dy as f32)
        };
        let fade = |t: f32| t * t * t * (t * (t * 6.0 - 15.0) + 10.0);
        let (sx, sy) = (fade(fx), fade(fy));
        let south = mix(corner(0, 0), corner(1, 0), sx);
        let north = mix(corner(0, 1), corner(1, 1), sx);
        1.6 * mix(south, north, sy)
    }

    /// A sum of octaves, each of half the wavelength and half the strength, about −1 to 1.
    #[inline]
    pub fn fbm(&self, x: f64, y: f64, octaves: u32) -> f32 {
        let (mut sum, mut strength, mut scale) = (0.0, 1.0, 1.0);
        let mut norm = 0.0;
        for octave in 0..octaves {
            let shift = f64::from(octave) * 17.31;
            sum += strength * self.at(x * scale + shift, y * scale - shift);
            norm += strength;
            strength *= 0.5;
            scale *= 2.03;
        }
        sum / norm * 1.3
    }

    /// Waves whose crests run along the direction of (`down_x`, `down_y`), a unit vector:
    /// ribs and gullies down a slope. Returns the height of the wave, −1 to 1, and its
    /// slope across that direction in heights per wavelength.
    #[inline]
    pub fn gullies(&self, x: f64, y: f64, down_x: f32, down_y: f32) -> (f32, f32) {
        let (floor_x, floor_y) = (x.floor(), y.floor());
        let (fx, fy) = ((x - floor_x) as f32, (y - floor_y) as f32);
        let (mut sum, mut slope, mut total) = (0.0, 0.0, 1e-6);
        for dy in -1i64..=1 {
            for dx in -1i64..=1 {
                let h = hash((floor_x as i64 + dx) as u32, (floor_y as i64 + dy) as u32, self.seed);
                let px = dx as f32 + (h & 0xFFF) as f32 * (1.0 / 4096.0);
                let py = dy as f32 + ((h >> 12) & 0xFFF) as f32 * (1.0 / 4096.0);
                let (vx, vy) = (fx - px, fy - py);
                let near = (1.0 - (vx * vx + vy * vy) * 0.62).max(0.0);
                let weight = near * near * near;
                let phase = vy * down_x - vx * down_y + (h >> 24) as f32 * (1.0 / 256.0);
                sum += weight * cos_turns(phase);
                slope -= weight * cos_turns(phase - 0.25);
                total += weight;
            }
        }
        (sum / total, slope / total * std::f32::consts::TAU)
    }
}
