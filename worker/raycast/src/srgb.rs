//! From linear light to the bytes of a picture, the same on every PC.
//!
//! The power of the sRGB curve (IEC 61966-2-1) is a polynomial from one power of two to the
//! next, off by at most 0.004 of a byte.

use crate::lanes::{self, Floats, Ints, Kernel, Lanes, MOST, One, Width};
use terrafarm_common::shading::LinearRgb;

/// Light up to which the curve is a line, and the line's steepness.
const LINE_END: f32 = 0.003_130_8;
const LINE: f32 = 12.92 * 255.0;
/// The power of the curve above, m^(5/12) for m from 1 to 2: interpolation at the Chebyshev
/// nodes.
const CURVE: [f32; 5] = [0.412_809_97, 0.824_403_6, -0.313_670_52, 0.086_953_54, -0.010_483_21];
/// Its scale in bytes, 255 * 1.055 * 2^(5 n / 12), for n from -9 to 0; nothing is darker.
const SCALE: [f32; 16] = [
    19.995_4, 26.690_66, 35.627_76, 47.557_35, 63.481_45, 84.737_57, 113.111_1, 150.985_2, 201.541,
    269.025, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
];
/// What is taken off in the end, and half a byte to round.
const OFFSET: f32 = 0.5 - 0.055 * 255.0;

/// The bytes of a colour; what is too bright or too dark is cut off.
pub(crate) fn encode(color: LinearRgb) -> [u8; 3] {
    color.map(|light| {
        let mut byte = [0];
        bytes::<One>(Floats::splat(light)).store(&mut byte);
        byte[0] as u8
    })
}

/// The bytes of many colours, red, green and blue apart: three a pixel.
pub(crate) fn encode_all(light: [&[f32]; 3], pixels: &mut [u8], width: Width) {
    lanes::run(Encode { light, pixels }, width);
}

struct Encode<'e> {
    light: [&'e [f32]; 3],
    pixels: &'e mut [u8],
}

impl Kernel for Encode<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let [red, green, blue] = self.light;
        for (n, pixels) in self.pixels.chunks_mut(3 * L::N).enumerate() {
            let at = n * L::N;
            let count = pixels.len() / 3;
            let [r, g, b] = if count == L::N {
                [L::F::load(&red[at..]), L::F::load(&green[at..]), L::F::load(&blue[at..])]
            } else {
                let mut part = [[0.0f32; MOST]; 3];
                for (part, all) in part.iter_mut().zip(self.light) {
                    part[..count].copy_from_slice(&all[at..at + count]);
                }
                [L::F::load(&part[0]), L::F::load(&part[1]), L::F::load(&part[2])]
            };
            store::<L>([r, g, b], pixels);
        }
    }
}

/// The bytes of a vector of colours, three a pixel; as many pixels as there is room for.
#[inline(always)]
pub(crate) fn store<L: Lanes>([red, green, blue]: [L::F; 3], pixels: &mut [u8]) {
    let color = bytes::<L>(red)
        + bytes::<L>(green).shl(L::I::splat(8))
        + bytes::<L>(blue).shl(L::I::splat(16));
    if pixels.len() >= 3 * L::N {
        color.store_threes(pixels);
    } else {
        let mut all = [0; 3 * MOST];
        color.store_threes(&mut all);
        pixels.copy_from_slice(&all[..pixels.len()]);
    }
}

#[inline(always)]
fn bytes<L: Lanes>(light: L::F) -> L::I {
    let light = light.max(L::F::splat(0.0)).min(L::F::splat(1.0));
    let bits = light.to_bits();
    let octave = bits.shr(L::I::splat(23)) - L::I::splat(127 - 9);
    let m = L::F::from_bits((bits & L::I::splat(0x7F_FFFF)) + L::I::splat(127 << 23));
    let square = m * m;
    let [a, b, c, d, e] = CURVE;
    let low = L::F::splat(a) + L::F::splat(b) * m;
    let high = L::F::splat(c) + L::F::splat(d) * m + L::F::splat(e) * square;
    let curve = (low + high * square) * L::F::pick(&SCALE, octave) + L::F::splat(OFFSET);
    let line = light * L::F::splat(LINE) + L::F::splat(0.5);
    L::F::select(light.le(L::F::splat(LINE_END)), line, curve).truncate()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Light of an sRGB value, both 0 to 1.
    fn decode(value: f64) -> f64 {
        if value <= 0.04045 { value / 12.92 } else { libm::pow((value + 0.055) / 1.055, 2.4) }
    }

    #[test]
    fn every_byte_comes_back_and_nothing_else_breaks_it() {
        for byte in 0..=255u8 {
            let light = decode(f64::from(byte) / 255.0) as f32;
            assert_eq!(encode([light; 3]), [byte; 3]);
        }
        assert_eq!(encode([f32::NAN, -1.0, 7.0]), [0, 0, 255]);
        assert_eq!(encode([f32::INFINITY, 1e-30, 1.0]), [255, 0, 255]);
    }

    #[test]
    fn bytes_grow_with_light_and_break_halfway() {
        let mut last = 0;
        for n in 0..200_000 {
            let light = n as f32 / 199_999.0;
            let [byte, ..] = encode([light; 3]);
            assert!(byte >= last);
            let exact = {
                let v = f64::from(light);
                let s = if v <= 0.003_130_8 {
                    12.92 * v
                } else {
                    1.055 * libm::pow(v, 1.0 / 2.4) - 0.055
                };
                s * 255.0
            };
            assert!((exact - f64::from(byte)).abs() < 0.504, "{light}: {byte} for {exact}");
            last = byte;
        }
    }

    #[test]
    fn many_colours_are_encoded_as_one_by_one_at_all_widths() {
        let light = |n: u32, c: u32| match n % 17 {
            0 => f32::NAN,
            1 => -1.0,
            2 => f32::INFINITY,
            _ => ((n.wrapping_mul(2_654_435_761 + c * 97)) >> 8) as f32 / 16_777_216.0,
        };
        for count in [0, 1, 15, 16, 17, 500] {
            let [r, g, b] = [0, 1, 2].map(|c| (0..count).map(|n| light(n, c)).collect::<Vec<_>>());
            let one_by_one: Vec<u8> =
                (0..count as usize).flat_map(|n| encode([r[n], g[n], b[n]])).collect();
            for width in Width::available() {
                let mut pixels = vec![0; 3 * count as usize];
                encode_all([&r, &g, &b], &mut pixels, width);
                assert_eq!(pixels, one_by_one, "{} {count}", width.name());
            }
        }
    }
}
