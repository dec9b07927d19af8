//! From the stored bytes of a strip or tile to samples: decompression and predictors.
//!
//! Everything here is told the length that must come out and gives at most that.

use crate::tiff::directory::Order;
use std::io::Read;

/// How strips and tiles are compressed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Compression {
    /// Not at all.
    None,
    /// LZW.
    Lzw,
    /// DEFLATE with a zlib header, codes 8 and 32946.
    Deflate,
    /// PackBits run lengths.
    PackBits,
}

/// Decompresses exactly `expected` bytes; what follows them is ignored.
pub fn decompress(
    compression: Compression,
    mut stored: Vec<u8>,
    expected: usize,
) -> Result<Vec<u8>, String> {
    let out = match compression {
        Compression::None => {
            stored.truncate(expected);
            stored
        }
        Compression::Lzw => lzw(&stored, expected)?,
        Compression::Deflate => {
            let mut out = Vec::new();
            let decoder = flate2::read::ZlibDecoder::new(stored.as_slice());
            if let Err(error) = decoder.take(expected as u64).read_to_end(&mut out) {
                return Err(format!("DEFLATE: {error}, after {} of {expected} bytes", out.len()));
            }
            out
        }
        Compression::PackBits => pack_bits(&stored, expected),
    };
    if out.len() < expected {
        return Err(format!("it holds {} bytes of samples, {expected} are needed", out.len()));
    }
    Ok(out)
}

fn lzw(stored: &[u8], expected: usize) -> Result<Vec<u8>, String> {
    let mut decoder = weezl::decode::Configuration::with_tiff_size_switch(weezl::BitOrder::Msb, 8)
        .with_yield_on_full_buffer(true)
        .build();
    let mut out = vec![0; expected];
    let (mut read, mut written) = (0, 0);
    while written < expected {
        let step = decoder.decode_bytes(&stored[read..], &mut out[written..]);
        read += step.consumed_in;
        written += step.consumed_out;
        match step.status {
            Ok(weezl::LzwStatus::Ok) if step.consumed_in + step.consumed_out > 0 => {}
            Ok(_) => break,
            Err(error) => return Err(format!("LZW: {error}, after {written} of {expected} bytes")),
        }
    }
    out.truncate(written);
    Ok(out)
}

fn pack_bits(stored: &[u8], expected: usize) -> Vec<u8> {
    let mut out = Vec::new();
    let mut rest = stored;
    while let (Some((&code, tail)), true) = (rest.split_first(), out.len() < expected) {
        let room = expected - out.len();
        match code {
            0..=127 => {
                let (run, tail) = tail.split_at(tail.len().min(usize::from(code) + 1));
                out.extend_from_slice(&run[..run.len().min(room)]);
                rest = tail;
            }
            128 => rest = tail,
            129..=255 => {
                let Some((&value, tail)) = tail.split_first() else { break };
                out.resize(out.len() + (257 - usize::from(code)).min(room), value);
                rest = tail;
            }
        }
    }
    out
}

/// Undoes the predictor row by row and leaves samples in this machine's byte order.
/// `size` is bytes per sample (1, 2, 4 or 8), `stride` samples from one value to the next
/// one of the same band, `row` bytes per row.
pub fn to_native(
    bytes: &mut [u8],
    predictor: u64,
    order: Order,
    size: usize,
    stride: usize,
    row: usize,
) {
    if predictor == 3 {
        let mut planes = vec![0; row];
        for row in bytes.chunks_exact_mut(row) {
            undo_floating_point(row, &mut planes, size, stride);
        }
        return;
    }
    let native = if cfg!(target_endian = "big") { Order::Big } else { Order::Little };
    if order != native && size > 1 {
        bytes.chunks_exact_mut(size).for_each(<[u8]>::reverse);
    }
    if predictor == 2 {
        for row in bytes.chunks_exact_mut(row) {
            match size {
                1 => {
                    (stride..row.len()).for_each(|k| row[k] = row[k].wrapping_add(row[k - stride]))
                }
                2 => undo_horizontal(row, stride, u16::from_ne_bytes, u16::wrapping_add, |v| {
                    v.to_ne_bytes()
                }),
                4 => undo_horizontal(row, stride, u32::from_ne_bytes, u32::wrapping_add, |v| {
                    v.to_ne_bytes()
                }),
                _ => undo_horizontal(row, stride, u64::from_ne_bytes, u64::wrapping_add, |v| {
                    v.to_ne_bytes()
                }),
            }
        }
    }
}

/// Each sample is stored as its difference from the one before.
fn undo_horizontal<const N: usize, T: Copy>(
    row: &mut [u8],
    stride: usize,
    read: impl Fn([u8; N]) -> T,
    add: impl Fn(T, T) -> T,
    write: impl Fn(T) -> [u8; N],
) {
    let (samples, _) = row.as_chunks_mut::<N>();
    for k in stride..samples.len() {
        samples[k] = write(add(read(samples[k]), read(samples[k - stride])));
    }
}

/// Bytes of equal weight are stored together, most significant first whatever the file's
/// byte order, each as its difference from the one before.
fn undo_floating_point(row: &mut [u8], planes: &mut [u8], size: usize, stride: usize) {
    for k in stride..row.len() {
        row[k] = row[k].wrapping_add(row[k - stride]);
    }
    planes.copy_from_slice(row);
    let count = row.len() / size;
    for (k, sample) in row.chunks_exact_mut(size).enumerate() {
        for (weight, byte) in sample.iter_mut().enumerate() {
            let plane = if cfg!(target_endian = "big") { weight } else { size - 1 - weight };
            *byte = planes[plane * count + k];
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn pack_bits_of_the_tiff_specification_unpack() {
        let stored = [
            0xfe, 0xaa, 0x02, 0x80, 0x00, 0x2a, 0xfd, 0xaa, 0x80, 0x03, 0x80, 0, 0x2a, 0x22, 0xf7,
            0xaa,
        ];
        let expected = [
            0xaa, 0xaa, 0xaa, 0x80, 0x00, 0x2a, 0xaa, 0xaa, 0xaa, 0xaa, 0x80, 0x00, 0x2a, 0x22,
            0xaa, 0xaa, 0xaa, 0xaa, 0xaa, 0xaa, 0xaa, 0xaa, 0xaa, 0xaa,
        ];
        let out = decompress(Compression::PackBits, stored.to_vec(), 24).unwrap();
        assert_eq!(out, expected);
    }

    #[test]
    fn the_floating_point_predictor_has_its_most_significant_bytes_first_in_both_orders() {
        let samples = [1000.25f32, 2.0, 3.5, -4.0, 5.0, 6.125];
        // Two bands of three pixels: bytes of equal weight together, then differences.
        let mut stored: Vec<u8> =
            (0..4).flat_map(|weight| samples.map(|sample| sample.to_be_bytes()[weight])).collect();
        for k in (2..stored.len()).rev() {
            stored[k] = stored[k].wrapping_sub(stored[k - 2]);
        }
        for order in [Order::Little, Order::Big] {
            let mut bytes = stored.clone();
            let row = bytes.len();
            to_native(&mut bytes, 3, order, 4, 2, row);
            assert_eq!(bytes, samples.map(f32::to_ne_bytes).concat());
        }
    }

    proptest! {
        #[test]
        fn random_bytes_give_the_asked_length_or_an_error(
            stored in proptest::collection::vec(any::<u8>(), 0..200),
            expected in 0usize..3000,
        ) {
            for compression in
                [Compression::None, Compression::Lzw, Compression::Deflate, Compression::PackBits]
            {
                if let Ok(out) = decompress(compression, stored.clone(), expected) {
                    prop_assert_eq!(out.len(), expected);
                }
            }
        }
    }
}
