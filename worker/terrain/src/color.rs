//! The transfer curve of sRGB, as tables.
//!
//! Photos are stored in sRGB, 8 bits; they are filtered in linear light, 16 bits. Both
//! directions are tables made once with `libm`, so that every PC has the same ones.

use std::sync::LazyLock;

/// Linear light of every sRGB code, 65535 = 1 (IEC 61966-2-1).
pub static LINEAR_OF_SRGB: LazyLock<[u16; 256]> = LazyLock::new(|| {
    std::array::from_fn(|code| {
        let encoded = code as f64 / 255.0;
        let linear = if encoded <= 0.04045 {
            encoded / 12.92
        } else {
            libm::pow((encoded + 0.055) / 1.055, 2.4)
        };
        (linear * 65535.0).round() as u16
    })
});

/// The nearest sRGB code of every linear light.
static SRGB_OF_LINEAR: LazyLock<Box<[u8]>> = LazyLock::new(|| {
    let code = |value: u16| {
        let linear = f64::from(value) / 65535.0;
        let encoded = if linear <= 0.003_130_8 {
            linear * 12.92
        } else {
            1.055 * libm::pow(linear, 1.0 / 2.4) - 0.055
        };
        (encoded * 255.0).round() as u8
    };
    (0..=u16::MAX).map(code).collect()
});

/// The nearest sRGB code of a linear light, 65535 = 1.
#[inline]
pub fn srgb_of_linear(linear: u16) -> u8 {
    SRGB_OF_LINEAR[usize::from(linear)]
}

/// A stored colour (sRGB red, green, blue and coverage) as linear light, premultiplied
/// by coverage, 65535 = 1.
#[inline]
pub fn linear_premultiplied(color: [u8; 4]) -> [u16; 4] {
    let coverage = u32::from(color[3]);
    let light = |code: u8| {
        let linear = u32::from(LINEAR_OF_SRGB[usize::from(code)]);
        ((linear * coverage + 127) / 255) as u16
    };
    [light(color[0]), light(color[1]), light(color[2]), (coverage * 257) as u16]
}

#[cfg(test)]
mod tests {
    use super::*;
    use sha2::{Digest, Sha256};

    #[test]
    fn the_table_is_the_one_computed_with_fifty_digits() {
        let bytes: Vec<u8> = LINEAR_OF_SRGB.iter().flat_map(|value| value.to_le_bytes()).collect();
        let digest: String =
            Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect();
        assert_eq!(digest, "fdb7af3c01815a2118db8e50aac3c2304205ccc3f381f8976c588642c1aa60b6");
        let some = [0, 1, 10, 11, 127, 128, 188, 254, 255].map(|code| LINEAR_OF_SRGB[code]);
        assert_eq!(some, [0, 20, 199, 219, 13909, 14146, 32957, 64952, 65535]);
    }

    #[test]
    fn every_code_comes_back() {
        for code in 0..=255u8 {
            assert_eq!(srgb_of_linear(LINEAR_OF_SRGB[usize::from(code)]), code);
        }
        assert!((1..=u16::MAX).all(|v| srgb_of_linear(v) >= srgb_of_linear(v - 1)));
    }

    #[test]
    fn coverage_scales_light() {
        assert_eq!(linear_premultiplied([255, 255, 0, 255]), [65535, 65535, 0, 65535]);
        assert_eq!(linear_premultiplied([255, 0, 255, 51]), [13107, 0, 13107, 13107]);
        assert_eq!(linear_premultiplied([200, 100, 50, 0]), [0; 4]);
    }
}
