//! From linear light to the bytes of a picture, the same on every PC.
//!
//! The sRGB curve is never evaluated per pixel: a table holds the light at which each
//! byte gives way to the next, made once with a software power function.

use std::sync::LazyLock;
use terrafarm_common::shading::LinearRgb;

/// Entries of the table of first guesses, over the square root of light.
const GUESSES: usize = 1024;

struct Table {
    /// `steps[n]` is the least light that is shown as byte n + 1 or more.
    steps: [f32; 256],
    /// Byte of the least light with this entry.
    guesses: [u8; GUESSES + 1],
}

static TABLE: LazyLock<Table> = LazyLock::new(|| {
    let mut steps = [f32::INFINITY; 256];
    for (byte, step) in steps.iter_mut().enumerate().take(255) {
        *step = decode((byte as f64 + 0.5) / 255.0) as f32;
    }
    let mut guesses = [0; GUESSES + 1];
    for (entry, guess) in guesses.iter_mut().enumerate() {
        let root = entry as f32 / GUESSES as f32;
        *guess = steps.iter().take_while(|&&step| step <= root * root).count() as u8;
    }
    Table { steps, guesses }
});

/// Light of an sRGB value, both 0 to 1 (IEC 61966-2-1).
fn decode(value: f64) -> f64 {
    if value <= 0.04045 { value / 12.92 } else { libm::pow((value + 0.055) / 1.055, 2.4) }
}

/// The bytes of a colour; what is too bright or too dark is cut off.
pub(crate) fn encode(color: LinearRgb) -> [u8; 3] {
    let table = &*TABLE;
    let byte = |light: f32| {
        let light = if light > 0.0 { light.min(1.0) } else { 0.0 };
        let entry = (light.sqrt() * GUESSES as f32) as usize;
        let mut byte = table.guesses[entry.min(GUESSES)];
        while byte > 0 && light < table.steps[usize::from(byte) - 1] {
            byte -= 1;
        }
        while light >= table.steps[usize::from(byte)] {
            byte += 1;
        }
        byte
    };
    [byte(color[0]), byte(color[1]), byte(color[2])]
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
            assert!((exact - f64::from(byte)).abs() < 0.501, "{light}: {byte} for {exact}");
            last = byte;
        }
    }
}
