//! sRGB pixels to the luma and chroma of video: BT.709 matrix, limited range.
//!
//! Rounded fixed point, so that every PC writes the same bytes. The transfer curve is
//! left as it is, as every video of a screen does: the pixels are what a display shows.

use terrafarm_common::image::Rgb8;

/// Fractional bits of the factors.
const BITS: u32 = 16;
const HALF: i32 = 1 << (BITS - 1);

/// Rows of the matrix for R, G, B, scaled by 2^16: 219 / 255 of BT.709 luma, and 224 / 255
/// of its colour differences. Chroma rows add to 0, so that grey has no colour.
const LUMA: [i32; 3] = [11_966, 40_254, 4_064];
const BLUE: [i32; 3] = [-6_596, -22_189, 28_785];
const RED: [i32; 3] = [28_785, -26_145, -2_640];

/// Three planes, rows from the top. Chroma planes have the size of luma, or half of it
/// along both sides.
#[derive(Debug, Clone)]
pub(super) struct Planes {
    pub y: Vec<u8>,
    pub cb: Vec<u8>,
    pub cr: Vec<u8>,
}

fn weigh(row: [i32; 3], rgb: [i32; 3], offset: i32, shift: u32) -> u8 {
    let sum: i32 = row.iter().zip(rgb).map(|(factor, value)| factor * value).sum();
    let rounded = (sum + (HALF << shift)) >> (BITS + shift);
    (rounded + offset).clamp(0, 255) as u8
}

/// One chroma sample a pixel.
pub(super) fn full(picture: &Rgb8) -> Planes {
    let count = picture.pixels().len() / 3;
    let mut planes = Planes {
        y: Vec::with_capacity(count),
        cb: Vec::with_capacity(count),
        cr: Vec::with_capacity(count),
    };
    for pixel in picture.pixels().chunks_exact(3) {
        let rgb = [pixel[0], pixel[1], pixel[2]].map(i32::from);
        planes.y.push(weigh(LUMA, rgb, 16, 0));
        planes.cb.push(weigh(BLUE, rgb, 128, 0));
        planes.cr.push(weigh(RED, rgb, 128, 0));
    }
    planes
}

/// One chroma sample for 2 x 2 pixels, in their middle. An odd last column or row is
/// repeated, since both sides must be even: see [`even`].
pub(super) fn halved(picture: &Rgb8) -> Planes {
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    let (wide, high) = (even(width), even(height));
    let mut planes = Planes {
        y: vec![0; wide * high],
        cb: Vec::with_capacity(wide * high / 4),
        cr: Vec::with_capacity(wide * high / 4),
    };
    let row = |y: usize| &picture.pixels()[y.min(height - 1) * width * 3..][..width * 3];
    for (pair, luma) in planes.y.chunks_exact_mut(2 * wide).enumerate() {
        let rows = [row(2 * pair), row(2 * pair + 1)];
        let (upper, lower) = luma.split_at_mut(wide);
        for x in (0..wide).step_by(2) {
            let mut sum = [0; 3];
            for (source, out) in rows.iter().zip([&mut *upper, &mut *lower]) {
                for column in [x, x + 1] {
                    let at = column.min(width - 1) * 3;
                    let rgb = [source[at], source[at + 1], source[at + 2]].map(i32::from);
                    out[column] = weigh(LUMA, rgb, 16, 0);
                    for (total, value) in sum.iter_mut().zip(rgb) {
                        *total += value;
                    }
                }
            }
            planes.cb.push(weigh(BLUE, sum, 128, 2));
            planes.cr.push(weigh(RED, sum, 128, 2));
        }
    }
    planes
}

/// The next even number: video with halved chroma has even sides.
pub(super) fn even(side: usize) -> usize {
    side + side % 2
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one(rgb: [u8; 3]) -> [u8; 3] {
        let planes = full(&Rgb8::from_pixels(1, 1, rgb.to_vec()).expect("one pixel"));
        [planes.y[0], planes.cb[0], planes.cr[0]]
    }

    #[test]
    fn known_colours_have_the_values_of_the_standard() {
        assert_eq!(one([0, 0, 0]), [16, 128, 128]);
        assert_eq!(one([255, 255, 255]), [235, 128, 128]);
        // 100 % bars of BT.709: red, green, blue.
        assert_eq!(one([255, 0, 0]), [63, 102, 240]);
        assert_eq!(one([0, 255, 0]), [173, 42, 26]);
        assert_eq!(one([0, 0, 255]), [32, 240, 118]);
    }

    #[test]
    fn every_grey_is_grey() {
        for level in 0..=255 {
            let [y, cb, cr] = one([level; 3]);
            assert_eq!((cb, cr), (128, 128));
            let expected = 16.0 + 219.0 * f64::from(level) / 255.0;
            assert!((f64::from(y) - expected).abs() <= 0.51);
        }
    }

    #[test]
    fn every_colour_is_within_a_level_of_the_real_numbers() {
        for r in (0..=255).step_by(5) {
            for g in (0..=255).step_by(5) {
                for b in (0..=255).step_by(5) {
                    let (rr, gg, bb) = (f64::from(r), f64::from(g), f64::from(b));
                    let luma = 0.2126 * rr + 0.7152 * gg + 0.0722 * bb;
                    let real = [
                        16.0 + luma * 219.0 / 255.0,
                        128.0 + (bb - luma) / 1.8556 * 224.0 / 255.0,
                        128.0 + (rr - luma) / 1.5748 * 224.0 / 255.0,
                    ];
                    for (got, want) in one([r as u8, g as u8, b as u8]).into_iter().zip(real) {
                        assert!((f64::from(got) - want).abs() <= 0.51, "{r} {g} {b}");
                    }
                }
            }
        }
    }

    #[test]
    fn odd_sides_repeat_their_last_pixels() {
        let picture = Rgb8::from_pixels(3, 1, vec![10, 10, 10, 20, 20, 20, 200, 200, 200]);
        let planes = halved(&picture.expect("three pixels"));
        assert_eq!(planes.y.len(), 8);
        assert_eq!(planes.y[2], planes.y[3]);
        assert_eq!(planes.y[..4], planes.y[4..]);
        assert_eq!((planes.cb.len(), planes.cr.len()), (2, 2));
    }
}
