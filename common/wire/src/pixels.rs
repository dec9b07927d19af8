//! How pixels are packed behind a message: as they are, or by LZ4.
//!
//! Loopback takes them raw, a network takes them compressed; both give back the same
//! bytes. What does not get smaller travels raw in any case.

use crate::limits::PIXEL_BYTES_MAX;
use crate::message::Unfit;
use bytes::Bytes;
use serde::{Deserialize, Serialize};

/// How the payload holds the pixels. Numbers on the wire: append only.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Encoding {
    /// Three bytes a pixel, rows from the top.
    Raw,
    /// The same as one LZ4 block without a length before it.
    Lz4,
}

/// RGB8 pixels of a frame or of a region, packed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Pixels {
    encoding: Encoding,
    /// Length when unpacked, bytes.
    raw_len: u32,
    #[serde(skip)]
    pub(crate) bytes: Bytes,
}

impl Pixels {
    /// Takes pixels as they are.
    ///
    /// # Errors
    /// If they are more than [`PIXEL_BYTES_MAX`].
    pub fn raw(pixels: Bytes) -> Result<Self, Unfit> {
        Unfit::unless(pixels.len() <= PIXEL_BYTES_MAX, "more pixels than the largest frame has")?;
        Ok(Pixels { encoding: Encoding::Raw, raw_len: pixels.len() as u32, bytes: pixels })
    }

    /// Compresses pixels; keeps them as they are if that does not help.
    ///
    /// # Errors
    /// If they are more than [`PIXEL_BYTES_MAX`].
    pub fn compressed(pixels: Bytes) -> Result<Self, Unfit> {
        let raw = Pixels::raw(pixels)?;
        let packed = lz4_flex::block::compress(&raw.bytes);
        if packed.len() >= raw.bytes.len() {
            return Ok(raw);
        }
        Ok(Pixels { encoding: Encoding::Lz4, bytes: packed.into(), ..raw })
    }

    /// How they are packed.
    pub fn encoding(&self) -> Encoding {
        self.encoding
    }

    /// Bytes that travel.
    pub fn packed_len(&self) -> usize {
        self.bytes.len()
    }

    /// The pixels, if they are exactly as many bytes as the receiver expects of the
    /// region it asked for.
    pub fn unpack(self, expected_len: usize) -> Result<Bytes, Unfit> {
        if self.raw_len as usize != expected_len {
            let found = self.raw_len;
            return Err(Unfit(format!("{found} bytes of pixels where {expected_len} belong")));
        }
        match self.encoding {
            Encoding::Raw => Ok(self.bytes),
            Encoding::Lz4 => {
                let mut pixels = vec![0; expected_len];
                match lz4_flex::block::decompress_into(&self.bytes, &mut pixels) {
                    Ok(length) if length == expected_len => Ok(pixels.into()),
                    _ => Err(Unfit("the compressed pixels are damaged".into())),
                }
            }
        }
    }

    /// Whether the lengths agree with each other and with the limit.
    pub(crate) fn check(&self) -> Result<(), Unfit> {
        let fits = match self.encoding {
            Encoding::Raw => self.raw_len as usize == self.bytes.len(),
            Encoding::Lz4 => self.bytes.len() < self.raw_len as usize,
        };
        let within = self.raw_len as usize <= PIXEL_BYTES_MAX;
        Unfit::unless(fits && within, "the length of the pixels is not what it says")
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;
    use proptest::prelude::*;
    use xxhash_rust::xxh3::xxh3_64;

    proptest! {
        #[test]
        fn pixels_come_back_as_they_were(pixels in prop::collection::vec(0u8..4, 0..3000)) {
            let pixels = Bytes::from(pixels);
            for packed in [Pixels::raw(pixels.clone()), Pixels::compressed(pixels.clone())] {
                let packed = packed.unwrap();
                prop_assert!(packed.check().is_ok());
                prop_assert_eq!(packed.unpack(pixels.len()).unwrap(), pixels.clone());
            }
        }

        #[test]
        fn damaged_pixels_are_an_error_or_of_the_right_length(noise: Vec<u8>, raw_len in 0u32..5000) {
            let packed = Pixels { encoding: Encoding::Lz4, raw_len, bytes: noise.into() };
            if let Ok(pixels) = packed.unpack(raw_len as usize) {
                prop_assert_eq!(pixels.len(), raw_len as usize);
            }
        }
    }

    #[test]
    fn noise_travels_raw_and_flat_colour_shrinks() {
        let noise: Bytes = (0..1000u32).map(|i| xxh3_64(&i.to_le_bytes()) as u8).collect();
        assert_eq!(Pixels::compressed(noise).unwrap().encoding(), Encoding::Raw);
        let flat = Pixels::compressed(vec![7; 3000].into()).unwrap();
        assert_eq!(flat.encoding(), Encoding::Lz4);
        assert!(flat.packed_len() < 100);
    }

    #[test]
    fn another_length_than_expected_is_refused_before_anything_is_unpacked() {
        let bomb = Pixels { encoding: Encoding::Lz4, raw_len: u32::MAX, bytes: Bytes::new() };
        assert!(bomb.check().is_err());
        assert!(bomb.unpack(3).is_err());
    }
}
