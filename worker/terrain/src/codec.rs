//! One tile as bytes: the unit that is hashed, stored, sent and cached.
//!
//! ```text
//! 0  magic "TFtl"   4  version   5  kind   6  form   7  flags
//! 8  bits of each of up to four channels      12  length of the body, u32
//! heights in whole steps only: 16  step, f64   24  base, i64; heights as f32: 24 base
//! 32 body: bit planes, as they are or as one LZ4 block
//! .. XXH3-64 of everything before it
//! ```
//! All numbers are little-endian. The body is made in three steps, all lossless:
//!
//! 1. *Values.* Heights that are whole multiples of a step become integers (int16
//!    metres, tenths, sixteenths); others become their f32 bits, reordered so that the
//!    integers sort as the heights do. Either way less that of the first valid post.
//!    Voids are one bit a post. Colours become green, red − green, blue − green and
//!    coverage; coverage is dropped if it is 255 everywhere.
//! 2. *Prediction* from the posts to the west and south; what is left is small.
//! 3. *Bit planes* of what is left, sign folded into the lowest bit, then LZ4. High
//!    planes are nearly all zero and vanish, low ones are noise and cost their size:
//!    LZ4 alone, on bytes, would pay eight bits for noise of three.
//!
//! Decoding survives any bytes: every length is known before a buffer is made, and no
//! tile is larger than [`MAX_TILE_BYTES`].

use crate::layout::{MAX_HEIGHT_M, STORE_VERSION, TILE_POSTS};
use crate::planes::{self, PLANE_BYTES, Predictor};
use crate::resident::Tile;
use crate::tile::{HeightTile, PhotoTile};
use std::sync::Arc;
use xxhash_rust::xxh3::xxh3_64;

/// Posts of a tile, ring included.
pub const TILE_AREA: usize = TILE_POSTS * TILE_POSTS;
/// The largest encoded tile: a void plane, 32 planes of noise, header and check sum.
pub const MAX_TILE_BYTES: usize = HEADER_BYTES + 33 * PLANE_BYTES + CHECK_BYTES;

const MAGIC: &[u8; 4] = b"TFtl";
const VERSION: u8 = STORE_VERSION as u8;
const HEADER_BYTES: usize = 32;
const CHECK_BYTES: usize = 8;

const KIND_HEIGHT: u8 = 0;
const KIND_PHOTO: u8 = 1;
const FORM_F32: u8 = 0;
const FORM_STEPS: u8 = 1;
const FORM_COLOR: u8 = 2;
/// Some posts are void, or coverage is kept.
const FLAG_HOLES: u8 = 1;
/// The body is not packed.
const FLAG_PLAIN: u8 = 2;
/// [`Predictor::Planar`], else [`Predictor::Median`].
const FLAG_PLANAR: u8 = 4;

/// Heights are kept in whole steps only while they span fewer steps than this: an f32
/// has no more digits.
const MAX_STEPS: f64 = (1u32 << 24) as f64;
/// Largest magnitude of a base that is exact in f64.
const MAX_BASE: i64 = 1 << 53;

/// Why bytes are not a tile.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum CodecError {
    /// The bytes do not begin as a tile does.
    #[error("these bytes are not a terrain tile")]
    NotATile,
    /// Written by a program with another encoding.
    #[error("the tile has version {found}, this program reads version {VERSION}")]
    OtherVersion {
        /// The version in the tile.
        found: u8,
    },
    /// A photo where heights are asked for, or the reverse.
    #[error("the tile is of the other kind (heights or photo)")]
    OtherKind,
    /// The length is not what the header says, or is out of range.
    #[error("the tile is cut short or too long")]
    Length,
    /// The check sum does not fit the bytes.
    #[error("the tile is damaged: its check sum is wrong")]
    CheckSum,
    /// The check sum fits, but the content breaks a rule.
    #[error("the tile is invalid: {0}")]
    Invalid(&'static str),
}

/// Encodes the heights of a tile, row by row from the south-west, ring included.
///
/// `step_m` is the step that the heights are expected to be multiples of, if any. It
/// changes the size of the result, never its content: every finite height within
/// [`MAX_HEIGHT_M`] comes back bit for bit, anything else comes back as a void.
///
/// # Panics
/// If there are not [`TILE_AREA`] posts.
pub fn encode_heights(posts: &[f32], step_m: Option<f64>) -> Vec<u8> {
    assert_eq!(posts.len(), TILE_AREA, "a tile has TILE_AREA posts");
    let is_void = |height: f32| !(-MAX_HEIGHT_M..=MAX_HEIGHT_M).contains(&height);
    let void: Vec<bool> = posts.iter().map(|&height| is_void(height)).collect();
    let first = posts.iter().copied().find(|&height| !is_void(height)).unwrap_or(0.0);
    let stepped = step_m
        .into_iter()
        .chain(dyadic_step(posts, &void))
        .find_map(|step| in_steps(posts, &void, first, step).map(|coded| (step, coded)));
    let (form, step, base, values) = match stepped {
        Some((step, (base, values))) => (FORM_STEPS, step, base, values),
        None => {
            let base = ordered_bits(first);
            let value = |&height: &f32| ordered_bits(height).wrapping_sub(base) as i32;
            (FORM_F32, 0.0, i64::from(base), posts.iter().map(value).collect())
        }
    };
    let any_void = void.iter().any(|&is| is);
    let values = if any_void { fill_voids(values, &void) } else { values };
    let (predictor, residuals) = planes::best_residuals(&values);
    let bits = planes::bits_needed(&residuals);

    let mut body = Vec::with_capacity((usize::from(any_void) + usize::from(bits)) * PLANE_BYTES);
    if any_void {
        let mask: Vec<u32> = void.iter().map(|&is| u32::from(is)).collect();
        planes::push_planes(&mask, 1, &mut body);
    }
    planes::push_planes(&residuals, bits, &mut body);

    let mut flags = if any_void { FLAG_HOLES } else { 0 };
    if predictor == Predictor::Planar {
        flags |= FLAG_PLANAR;
    }
    let header = Header { kind: KIND_HEIGHT, form, flags, bits: [bits, 0, 0, 0], step, base };
    seal(header, body)
}

/// Encodes the colours of a tile (sRGB red, green, blue and coverage), row by row from
/// the south-west, ring included. Everything comes back as it was.
///
/// # Panics
/// If there are not [`TILE_AREA`] of them.
pub fn encode_colors(colors: &[[u8; 4]]) -> Vec<u8> {
    assert_eq!(colors.len(), TILE_AREA, "a tile has TILE_AREA posts");
    let opaque = colors.iter().all(|color| color[3] == 255);
    let mut bits = [0; 4];
    let mut body = Vec::with_capacity(32 * PLANE_BYTES);
    let channels = if opaque { 3 } else { 4 };
    for (channel, bits) in bits.iter_mut().enumerate().take(channels) {
        let values: Vec<i32> =
            colors.iter().map(|color| i32::from(decorrelate(*color)[channel])).collect();
        let residuals = planes::residuals::<true>(&values, Predictor::Median);
        *bits = planes::bits_needed(&residuals);
        planes::push_planes(&residuals, *bits, &mut body);
    }
    let flags = if opaque { 0 } else { FLAG_HOLES };
    seal(Header { kind: KIND_PHOTO, form: FORM_COLOR, flags, bits, step: 0.0, base: 0 }, body)
}

/// Decodes a tile of either kind for use.
pub fn decode(bytes: &[u8]) -> Result<Tile, CodecError> {
    match open(bytes)?.0.kind {
        KIND_HEIGHT => decode_heights(bytes).map(|tile| Tile::Height(Arc::new(tile))),
        _ => decode_photo(bytes).map(|tile| Tile::Photo(Arc::new(tile))),
    }
}

/// Decodes heights for use.
pub fn decode_heights(bytes: &[u8]) -> Result<HeightTile, CodecError> {
    let posts = decode_posts(bytes)?;
    HeightTile::new(posts.into_boxed_slice()).ok_or(CodecError::Length)
}

/// Decodes a photo for use.
pub fn decode_photo(bytes: &[u8]) -> Result<PhotoTile, CodecError> {
    PhotoTile::from_colors(&decode_colors(bytes)?).ok_or(CodecError::Length)
}

/// Decodes heights as they were given to [`encode_heights`].
pub fn decode_posts(bytes: &[u8]) -> Result<Vec<f32>, CodecError> {
    let (header, body) = open(bytes)?;
    if header.kind != KIND_HEIGHT {
        return Err(CodecError::OtherKind);
    }
    let body = unpack(&header, body)?;
    let (mask, body) = body.split_at(if header.flags & FLAG_HOLES != 0 { PLANE_BYTES } else { 0 });
    let residuals = planes::read_planes(body, header.bits[0]);
    let predictor =
        if header.flags & FLAG_PLANAR != 0 { Predictor::Planar } else { Predictor::Median };
    let values = planes::restore::<false>(&residuals, predictor);
    let mut posts: Vec<f32> = if header.form == FORM_STEPS {
        values.iter().map(|&value| from_steps(header.base, value, header.step)).collect()
    } else {
        let base = header.base as u32;
        values.iter().map(|&value| from_ordered_bits(base.wrapping_add(value as u32))).collect()
    };
    for (post, height) in posts.iter_mut().enumerate() {
        if mask.get(post / 8).is_some_and(|byte| byte >> (post % 8) & 1 != 0) {
            *height = f32::NAN;
        } else if !(-MAX_HEIGHT_M..=MAX_HEIGHT_M).contains(height) {
            return Err(CodecError::Invalid("a height is out of range"));
        }
    }
    Ok(posts)
}

/// Decodes colours as they were given to [`encode_colors`].
pub fn decode_colors(bytes: &[u8]) -> Result<Vec<[u8; 4]>, CodecError> {
    let (header, body) = open(bytes)?;
    if header.kind != KIND_PHOTO {
        return Err(CodecError::OtherKind);
    }
    let body = unpack(&header, body)?;
    let mut rest = &body[..];
    let mut channels = vec![[0, 0, 0, 255]; TILE_AREA];
    for channel in 0..if header.flags & FLAG_HOLES != 0 { 4 } else { 3 } {
        let (planes, after) = rest.split_at(usize::from(header.bits[channel]) * PLANE_BYTES);
        rest = after;
        let residuals = planes::read_planes(planes, header.bits[channel]);
        let values = planes::restore::<true>(&residuals, Predictor::Median);
        for (color, value) in channels.iter_mut().zip(values) {
            color[channel] = value as u8;
        }
    }
    Ok(channels.into_iter().map(recorrelate).collect())
}

struct Header {
    kind: u8,
    form: u8,
    flags: u8,
    bits: [u8; 4],
    step: f64,
    base: i64,
}

impl Header {
    /// Length of the bit planes before LZ4.
    fn plane_bytes(&self) -> usize {
        let mask = self.kind == KIND_HEIGHT && self.flags & FLAG_HOLES != 0;
        let planes = self.bits.iter().map(|&bits| usize::from(bits)).sum::<usize>();
        (usize::from(mask) + planes) * PLANE_BYTES
    }

    fn check(&self) -> Result<(), CodecError> {
        let invalid = |what| Err(CodecError::Invalid(what));
        let (known_flags, bits_limit, form_fits) = match self.kind {
            KIND_HEIGHT => (
                FLAG_HOLES | FLAG_PLAIN | FLAG_PLANAR,
                [32, 0, 0, 0],
                matches!(self.form, FORM_F32 | FORM_STEPS),
            ),
            KIND_PHOTO => {
                let coverage = if self.flags & FLAG_HOLES != 0 { 8 } else { 0 };
                (FLAG_HOLES | FLAG_PLAIN, [8, 8, 8, coverage], self.form == FORM_COLOR)
            }
            _ => return invalid("unknown kind"),
        };
        if !form_fits || self.flags & !known_flags != 0 {
            return invalid("unknown form");
        }
        if self.bits.iter().zip(bits_limit).any(|(&bits, limit)| bits > limit) {
            return invalid("too many bits a post");
        }
        let step_fits = self.form != FORM_STEPS || (self.step.is_finite() && self.step > 0.0);
        if !step_fits || self.base.unsigned_abs() > MAX_BASE as u64 {
            return invalid("step or base is out of range");
        }
        Ok(())
    }
}

/// Joins header, body and check sum.
fn seal(mut header: Header, planes: Vec<u8>) -> Vec<u8> {
    let packed = lz4_flex::block::compress(&planes);
    let body = if packed.len() < planes.len() {
        packed
    } else {
        header.flags |= FLAG_PLAIN;
        planes
    };
    let mut bytes = Vec::with_capacity(HEADER_BYTES + body.len() + CHECK_BYTES);
    bytes.extend_from_slice(MAGIC);
    bytes.extend_from_slice(&[VERSION, header.kind, header.form, header.flags]);
    bytes.extend_from_slice(&header.bits);
    bytes.extend_from_slice(&(body.len() as u32).to_le_bytes());
    bytes.extend_from_slice(&header.step.to_le_bytes());
    bytes.extend_from_slice(&header.base.to_le_bytes());
    bytes.extend_from_slice(&body);
    let check = xxh3_64(&bytes);
    bytes.extend_from_slice(&check.to_le_bytes());
    bytes
}

/// Takes header, body and check sum apart, and checks all three.
fn open(bytes: &[u8]) -> Result<(Header, &[u8]), CodecError> {
    if !bytes.starts_with(MAGIC) {
        return Err(CodecError::NotATile);
    }
    match bytes.get(MAGIC.len()) {
        Some(&VERSION) => {}
        Some(&found) => return Err(CodecError::OtherVersion { found }),
        None => return Err(CodecError::Length),
    }
    let (front, body_and_check) =
        bytes.split_first_chunk::<HEADER_BYTES>().ok_or(CodecError::Length)?;
    let (body, check) =
        body_and_check.split_last_chunk::<CHECK_BYTES>().ok_or(CodecError::Length)?;
    let field = |at: usize| front[at..].first_chunk().expect("the header has 32 bytes");
    let length = u32::from_le_bytes([front[12], front[13], front[14], front[15]]);
    if bytes.len() > MAX_TILE_BYTES || body.len() != length as usize {
        return Err(CodecError::Length);
    }
    if xxh3_64(&bytes[..HEADER_BYTES + body.len()]) != u64::from_le_bytes(*check) {
        return Err(CodecError::CheckSum);
    }
    let header = Header {
        kind: front[5],
        form: front[6],
        flags: front[7],
        bits: [front[8], front[9], front[10], front[11]],
        step: f64::from_le_bytes(*field(16)),
        base: i64::from_le_bytes(*field(24)),
    };
    header.check()?;
    Ok((header, body))
}

/// The bit planes of a checked header and body.
fn unpack(header: &Header, body: &[u8]) -> Result<Vec<u8>, CodecError> {
    let expected = header.plane_bytes();
    if header.flags & FLAG_PLAIN != 0 {
        return if body.len() == expected { Ok(body.to_vec()) } else { Err(CodecError::Length) };
    }
    let mut planes = vec![0; expected];
    match lz4_flex::block::decompress_into(body, &mut planes) {
        Ok(length) if length == expected => Ok(planes),
        Ok(_) => Err(CodecError::Length),
        Err(_) => Err(CodecError::Invalid("its LZ4 block cannot be read")),
    }
}

/// The largest power of two that divides all heights; `None` if all are void or 0.
fn dyadic_step(posts: &[f32], void: &[bool]) -> Option<f64> {
    let lowest_bit = |height: f32| {
        let bits = height.to_bits();
        let exponent = (bits >> 23 & 0xff) as i32;
        let fraction = bits & 0x7f_ffff;
        let (exponent, mantissa) =
            if exponent == 0 { (1, fraction) } else { (exponent, fraction | 0x80_0000) };
        exponent - 150 + mantissa.trailing_zeros() as i32
    };
    let valid = posts.iter().zip(void).filter(|&(&height, &void)| !void && height != 0.0);
    valid.map(|(&height, _)| lowest_bit(height)).min().map(power_of_two)
}

/// 2 to a power that an f32 can have.
fn power_of_two(exponent: i32) -> f64 {
    f64::from_bits(((1023 + exponent) as u64) << 52)
}

/// All heights as whole numbers of steps, less that of the first valid one; `None`
/// unless every height comes back bit for bit.
fn in_steps(posts: &[f32], void: &[bool], first: f32, step: f64) -> Option<(i64, Vec<i32>)> {
    let base = (f64::from(first) / step).round();
    if !base.is_finite() || base.abs() > MAX_BASE as f64 {
        return None;
    }
    let mut values = Vec::with_capacity(TILE_AREA);
    for (&height, &void) in posts.iter().zip(void) {
        let value = if void { 0.0 } else { (f64::from(height) / step).round() - base };
        if !(-MAX_STEPS..=MAX_STEPS).contains(&value) {
            return None;
        }
        let value = value as i32;
        let same = from_steps(base as i64, value, step).to_bits() == height.to_bits();
        if !void && !same {
            return None;
        }
        values.push(value);
    }
    Some((base as i64, values))
}

#[inline]
fn from_steps(base: i64, value: i32, step: f64) -> f32 {
    ((base + i64::from(value)) as f64 * step) as f32
}

/// The bits of a height, so that the integers sort as the heights do.
#[inline]
fn ordered_bits(height: f32) -> u32 {
    let bits = height.to_bits();
    if bits >> 31 != 0 { !bits } else { bits | 1 << 31 }
}

#[inline]
fn from_ordered_bits(ordered: u32) -> f32 {
    f32::from_bits(if ordered >> 31 != 0 { ordered & !(1 << 31) } else { !ordered })
}

/// Gives voids the value of the post before them, so that they cost nothing.
fn fill_voids(mut values: Vec<i32>, void: &[bool]) -> Vec<i32> {
    let mut before = 0;
    for (value, &void) in values.iter_mut().zip(void) {
        if void {
            *value = before;
        }
        before = *value;
    }
    values
}

/// Green, red − green, blue − green (128 = none), coverage.
fn decorrelate([red, green, blue, coverage]: [u8; 4]) -> [u8; 4] {
    let over_green = |code: u8| code.wrapping_sub(green).wrapping_add(128);
    [green, over_green(red), over_green(blue), coverage]
}

fn recorrelate([green, red, blue, coverage]: [u8; 4]) -> [u8; 4] {
    let code = |over_green: u8| over_green.wrapping_sub(128).wrapping_add(green);
    [code(red), green, code(blue), coverage]
}

#[cfg(test)]
mod tests;
