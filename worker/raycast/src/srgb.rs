//! From linear light to the bytes of a picture, the same on every PC.
//!
//! The sRGB curve is never evaluated per pixel: a table holds the light at which each
//! byte gives way to the next, made once with a software power function.

use crate::lanes::{self, Floats, Ints, Kernel, Lanes, MOST, Mask, One, Width};
use std::sync::LazyLock;
use terrafarm_common::shading::LinearRgb;

/// Entries of the table, over the square root of light: so many that none holds more than
/// one step from a byte to the next.
const ENTRIES: usize = 1024;
/// The bits of an entry that are its byte.
const BYTE: u32 = 0xFF;

/// By entry the byte of its least light, and in the upper bits the light from which on it
/// is one more: an f32 to 16 bits, which moves a step by at most 0.002 of a byte.
static TABLE: LazyLock<Box<[u32]>> = LazyLock::new(|| {
    let mut steps = (0..255u8).map(|byte| {
        let light = decode((f64::from(byte) + 0.5) / 255.0) as f32;
        f32::from_bits((light.to_bits() + BYTE / 2 + 1) & !BYTE)
    });
    let mut next = steps.next();
    let mut byte = 0;
    let entries = (0..=ENTRIES).map(|entry| match next {
        Some(step) if (step.sqrt() * ENTRIES as f32) as usize <= entry => {
            next = steps.next();
            byte += 1;
            step.to_bits() | (byte - 1)
        }
        // More than any light.
        _ => 2.0f32.to_bits() | byte,
    });
    entries.collect()
});

/// Light of an sRGB value, both 0 to 1 (IEC 61966-2-1).
fn decode(value: f64) -> f64 {
    if value <= 0.04045 { value / 12.92 } else { libm::pow((value + 0.055) / 1.055, 2.4) }
}

/// The bytes of a colour; what is too bright or too dark is cut off.
pub(crate) fn encode(color: LinearRgb) -> [u8; 3] {
    color.map(|light| {
        let mut byte = [0];
        bytes::<One>(&TABLE, Floats::splat(light)).store(&mut byte);
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
        let table = &**TABLE;
        let [red, green, blue] = self.light;
        let mut colors = [0i32; MOST];
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
            let color = bytes::<L>(table, r)
                + bytes::<L>(table, g).shl(L::I::splat(8))
                + bytes::<L>(table, b).shl(L::I::splat(16));
            color.store(&mut colors);
            for (pixel, color) in pixels.chunks_exact_mut(3).zip(&colors) {
                let [red, green, blue, _] = color.to_le_bytes();
                pixel.copy_from_slice(&[red, green, blue]);
            }
        }
    }
}

#[inline(always)]
fn bytes<L: Lanes>(table: &[u32], light: L::F) -> L::I {
    let light = light.max(L::F::splat(0.0)).min(L::F::splat(1.0));
    let entry = (light.sqrt() * L::F::splat(ENTRIES as f32)).truncate();
    let found = L::I::gather(table, entry, !L::M::none());
    let step = L::F::from_bits(found & L::I::splat(!BYTE as i32));
    let one_more = L::I::select(step.le(light), L::I::splat(1), L::I::splat(0));
    (found & L::I::splat(BYTE as i32)) + one_more
}

#[cfg(test)]
mod tests {
    use super::*;

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
            assert!((exact - f64::from(byte)).abs() < 0.502, "{light}: {byte} for {exact}");
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
