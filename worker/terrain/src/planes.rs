//! Prediction and bit planes: the two lossless steps between the values of a tile and
//! what LZ4 packs.

use crate::codec::TILE_AREA;
use crate::layout::TILE_POSTS;

/// Bytes of one bit plane of a tile.
pub(crate) const PLANE_BYTES: usize = TILE_AREA.div_ceil(8);

/// How a value is guessed from its neighbours to the west, south and south-west.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Predictor {
    /// west + south − southwest: exact on a plane, best for smooth ground.
    Planar,
    /// The same, kept between west and south (the median of the three, as in JPEG-LS):
    /// best for rough ground, steps and photos.
    Median,
}

/// The difference between values and their prediction, sign in the lowest bit. With
/// `BYTE`, values are 0 ..= 255 and differences are taken modulo 256.
pub(crate) fn residuals<const BYTE: bool>(values: &[i32], predictor: Predictor) -> Vec<u32> {
    let mut residuals = Vec::with_capacity(values.len());
    for (post, &value) in values.iter().enumerate() {
        let difference = value.wrapping_sub(predict(values, post, predictor));
        let difference = if BYTE { i32::from(difference as i8) } else { difference };
        residuals.push((difference << 1 ^ difference >> 31) as u32);
    }
    residuals
}

/// Undoes [`residuals`].
pub(crate) fn restore<const BYTE: bool>(residuals: &[u32], predictor: Predictor) -> Vec<i32> {
    let mut values = vec![0; residuals.len()];
    for (post, &residual) in residuals.iter().enumerate() {
        let difference = (residual >> 1) as i32 ^ -((residual & 1) as i32);
        let value = predict(&values, post, predictor).wrapping_add(difference);
        values[post] = if BYTE { value & 0xff } else { value };
    }
    values
}

/// Predicts the value of a post from those before it; 0 for the first one.
#[inline]
fn predict(values: &[i32], post: usize, predictor: Predictor) -> i32 {
    if post.is_multiple_of(TILE_POSTS) {
        return if post == 0 { 0 } else { values[post - TILE_POSTS] };
    }
    let west = values[post - 1];
    if post < TILE_POSTS {
        return west;
    }
    let south = values[post - TILE_POSTS];
    let plane = west.wrapping_add(south).wrapping_sub(values[post - TILE_POSTS - 1]);
    match predictor {
        Predictor::Planar => plane,
        Predictor::Median => plane.clamp(west.min(south), west.max(south)),
    }
}

/// The residuals of the predictor that leaves fewer bits, and which one it was.
pub(crate) fn best_residuals(values: &[i32]) -> (Predictor, Vec<u32>) {
    let cost = |residuals: &[u32]| residuals.iter().map(|&r| u64::from(bits(r))).sum::<u64>();
    let planar = residuals::<false>(values, Predictor::Planar);
    let median = residuals::<false>(values, Predictor::Median);
    if cost(&planar) < cost(&median) {
        (Predictor::Planar, planar)
    } else {
        (Predictor::Median, median)
    }
}

#[inline]
fn bits(value: u32) -> u8 {
    (u32::BITS - value.leading_zeros()) as u8
}

/// Number of planes that hold all of these values.
pub(crate) fn bits_needed(values: &[u32]) -> u8 {
    bits(values.iter().fold(0, |all, &value| all | value))
}

/// Appends the lowest `count` bit planes of a tile's values. Bit k of byte n of a plane
/// belongs to value 8 n + k.
pub(crate) fn push_planes(values: &[u32], count: u8, into: &mut Vec<u8>) {
    let start = into.len();
    into.resize(start + usize::from(count) * PLANE_BYTES, 0);
    let planes = &mut into[start..];
    for (group, values) in values.chunks(8).enumerate() {
        for first in (0..usize::from(count)).step_by(8) {
            let mut square = 0u64;
            for (row, &value) in values.iter().enumerate() {
                square |= u64::from((value >> first) as u8) << (8 * row);
            }
            let square = transpose(square).to_le_bytes();
            for (plane, byte) in (first..usize::from(count)).zip(square) {
                planes[plane * PLANE_BYTES + group] = byte;
            }
        }
    }
}

/// The values of a tile from `count` bit planes.
///
/// # Panics
/// If there are not `count` planes.
pub(crate) fn read_planes(planes: &[u8], count: u8) -> Vec<u32> {
    assert_eq!(planes.len(), usize::from(count) * PLANE_BYTES, "the header gives the length");
    let mut values = vec![0u32; TILE_AREA];
    for (group, values) in values.chunks_mut(8).enumerate() {
        for first in (0..usize::from(count)).step_by(8) {
            let mut square = [0; 8];
            for (plane, byte) in (first..usize::from(count)).zip(&mut square) {
                *byte = planes[plane * PLANE_BYTES + group];
            }
            let square = transpose(u64::from_le_bytes(square)).to_le_bytes();
            for (value, byte) in values.iter_mut().zip(square) {
                *value |= u32::from(byte) << first;
            }
        }
    }
    values
}

/// Transposes 8 x 8 bits: bit c of byte r changes places with bit r of byte c. By
/// exchanging halves of halves.
#[inline]
fn transpose(mut square: u64) -> u64 {
    for (shift, mask) in
        [(7, 0x00aa_00aa_00aa_00aa), (14, 0x0000_cccc_0000_cccc), (28, 0x0000_0000_f0f0_f0f0)]
    {
        let differs = (square ^ square >> shift) & mask;
        square ^= differs ^ differs << shift;
    }
    square
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn transposing_moves_each_bit() {
        for row in 0..8 {
            for column in 0..8 {
                assert_eq!(transpose(1 << (8 * row + column)), 1 << (8 * column + row));
            }
        }
    }

    #[test]
    fn a_plane_is_predicted_exactly() {
        let values: Vec<i32> = (0..TILE_AREA as i32)
            .map(|post| 3 * (post % TILE_POSTS as i32) + 7 * (post / TILE_POSTS as i32))
            .collect();
        let (predictor, residuals) = best_residuals(&values);
        assert_eq!(predictor, Predictor::Planar);
        let inner = |post: usize| post > TILE_POSTS && !post.is_multiple_of(TILE_POSTS);
        assert!((0..TILE_AREA).filter(|&post| inner(post)).all(|post| residuals[post] == 0));
    }

    #[test]
    fn extreme_values_wrap_and_come_back() {
        let values: Vec<i32> =
            (0..TILE_AREA).map(|post| [i32::MIN, i32::MAX, 0, -1, 1][post * post % 5]).collect();
        for predictor in [Predictor::Planar, Predictor::Median] {
            let residuals = residuals::<false>(&values, predictor);
            let mut planes = Vec::new();
            push_planes(&residuals, 32, &mut planes);
            assert_eq!(restore::<false>(&read_planes(&planes, 32), predictor), values);
        }
    }
}
