//! Adds what the encoder leaves out of its sequence parameter set: the colours.
//!
//! H.264 keeps the matrix, the range, the place of chroma samples and the frame rate in
//! the "video usability information" at the very end of that set (ITU-T H.264, annex E).
//! Without it a player guesses, and guesses BT.601 for small pictures. Our encoder ends
//! the set with the bit that says there is none; here that bit is set and the rest added.

use super::rate::Rate;

/// BT.709 in the tables of H.264: primaries, transfer and matrix share one number.
const BT709: u32 = 1;
/// `video_format`: not specified.
const ANY_FORMAT: u32 = 5;
/// Chroma samples lie in the middle of their 2 x 2 pixels.
const CHROMA_CENTRED: u32 = 1;
/// Longest motion vectors, log2 of quarter pixels: no promise.
const ANY_VECTOR: u32 = 16;

/// The parameter set, a NAL unit without its start code, with the information added.
/// `None` if its last bit is not the "none" that was expected.
pub(super) fn with_colour(nal: &[u8], rate: Rate, reference_frames: u32) -> Option<Vec<u8>> {
    let plain = unescape(nal);
    let mut bits: Vec<bool> =
        plain.iter().flat_map(|byte| (0..8).rev().map(move |bit| byte >> bit & 1 == 1)).collect();
    while !bits.pop()? {}
    if bits.pop()? {
        return None;
    }
    let mut out = Bits(bits);
    out.fixed(1, 1);
    out.fixed(1, 1);
    out.fixed(1, 8); // Pixels are square.
    out.fixed(0, 1);
    out.fixed(1, 1);
    out.fixed(ANY_FORMAT, 3);
    out.fixed(0, 1); // Limited range.
    out.fixed(1, 1);
    for _ in 0..3 {
        out.fixed(BT709, 8);
    }
    out.fixed(1, 1);
    out.golomb(CHROMA_CENTRED);
    out.golomb(CHROMA_CENTRED);
    out.fixed(1, 1);
    out.fixed(rate.per, 32);
    out.fixed(rate.frames * 2, 32); // The tick is a field, half a frame.
    out.fixed(1, 1);
    out.fixed(0, 3); // No buffer models, no picture structure.
    out.fixed(1, 1);
    out.fixed(1, 1);
    out.golomb(0);
    out.golomb(0);
    out.golomb(ANY_VECTOR);
    out.golomb(ANY_VECTOR);
    out.golomb(0); // Pictures are shown in the order they come.
    out.golomb(reference_frames);
    Some(escape(&out.ended()))
}

/// Bits in the order they are sent.
struct Bits(Vec<bool>);

impl Bits {
    fn fixed(&mut self, value: u32, count: u32) {
        self.0.extend((0..count).rev().map(|bit| value >> bit & 1 == 1));
    }

    /// Exponential Golomb code of a number.
    fn golomb(&mut self, value: u32) {
        let code = value + 1;
        let length = 32 - code.leading_zeros();
        self.fixed(0, length - 1);
        self.fixed(code, length);
    }

    /// Closes with the stop bit and fills the last byte.
    fn ended(mut self) -> Vec<u8> {
        self.0.push(true);
        let byte = |bits: &[bool]| {
            bits.iter().enumerate().fold(0, |byte, (i, bit)| byte | u8::from(*bit) << (7 - i))
        };
        self.0.chunks(8).map(byte).collect()
    }
}

/// Takes the 3 out of every 0 0 3.
fn unescape(nal: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(nal.len());
    let mut zeros = 0;
    for &byte in nal {
        if zeros >= 2 && byte == 3 {
            zeros = 0;
            continue;
        }
        zeros = if byte == 0 { zeros + 1 } else { 0 };
        out.push(byte);
    }
    out
}

/// Puts a 3 wherever two zeros could be taken for the start of a unit.
fn escape(plain: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(plain.len() + 8);
    let mut zeros = 0;
    for &byte in plain {
        if zeros >= 2 && byte <= 3 {
            out.push(3);
            zeros = 0;
        }
        zeros = if byte == 0 { zeros + 1 } else { 0 };
        out.push(byte);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const RATE: Rate = Rate { frames: 30, per: 1 };

    proptest! {
        #[test]
        fn escaping_is_undone_and_hides_every_start_code(plain in prop::collection::vec(0u8..5, 0..200)) {
            let escaped = escape(&plain);
            prop_assert_eq!(unescape(&escaped), plain);
            prop_assert!(!escaped.windows(3).any(|w| w[0] == 0 && w[1] == 0 && w[2] < 3));
        }

        #[test]
        fn any_bytes_give_an_answer(nal in prop::collection::vec(any::<u8>(), 0..40)) {
            let _ = with_colour(&nal, RATE, 1);
        }
    }

    #[test]
    fn a_set_that_has_the_information_already_is_left_alone() {
        assert_eq!(with_colour(&[0x67, 0b1100_0000], RATE, 1), None);
        assert_eq!(with_colour(&[0, 0, 0], RATE, 1), None);
        assert!(with_colour(&[0x67, 0b0100_0000], RATE, 1).is_some());
    }
}
