//! Colours of one tile of a photo, as the kernels read them.
//!
//! Four bytes a texel: the square roots of linear red, green and blue, premultiplied by
//! coverage, in 10, 11 and 10 bits. Squaring a root gives the light: one multiplication
//! where the curve of sRGB would take a table. A root is off by at most half a step, which
//! is an eighth of a step of the photo's own eight bits where they are finest, in the dark.
//!
//! The texels are kept twice, by rows and by columns, so that two neighbours are one load
//! of eight bytes along either axis. Coverage is kept apart, and only if some is missing.

use crate::color::{LINEAR_OF_SRGB, linear_premultiplied, srgb_of_linear};
use crate::layout::{TILE_POSTS, TILE_RING};
use std::sync::LazyLock;

/// Where the texels by columns begin: texel (i, j) is at `row * TILE_POSTS + column` and
/// at `TURNED + column * TILE_POSTS + row`.
pub const TURNED: usize = TILE_POSTS * TILE_POSTS;
/// The bits of red, green and blue in a texel: each is that many 2^n steps, all of them
/// set being the root of full light.
pub const FIELDS: [u32; 3] = [0x3FF, 0x7FF << 10, 0x3FF << 21];
const SHIFTS: [u32; 3] = [0, 10, 21];
/// Bytes of the largest [`PhotoTile`] in memory: one with coverage.
pub const PHOTO_TILE_BYTES: usize =
    size_of::<PhotoTile>() + (size_of::<u32>() + size_of::<u16>()) * (2 * TURNED + 1);

/// The texels of opaque sRGB colours, by channel and code.
static OPAQUE: LazyLock<[[u32; 256]; 3]> = LazyLock::new(|| {
    [0, 1, 2].map(|c| std::array::from_fn(|code| root(LINEAR_OF_SRGB[code], c)))
});

/// Colours of one tile of a photo, ready to be filtered.
///
/// Addressed as [`HeightTile`](super::HeightTile) is.
pub struct PhotoTile {
    light: Box<[u32]>,
    coverage: Option<Box<[u16]>>,
}

/// The arrays of a photo tile as the kernels read them: [`TILE_POSTS`] texels a row from
/// the south-west, ring included, then the same [`TURNED`], and one element more, so that
/// a load of two elements at the last texel stays inside.
#[derive(Debug, Clone, Copy)]
pub struct Texels<'a> {
    /// Roots of light, in [`FIELDS`].
    pub light: &'a [u32],
    /// Coverage, 65535 = 1; `None` if it is 1 everywhere.
    pub coverage: Option<&'a [u16]>,
}

impl PhotoTile {
    /// A tile from its texels (linear red, green, blue, coverage, 65535 = 1;
    /// premultiplied), row by row from the south-west, ring included. `None` if their
    /// number is wrong.
    pub fn new(texels: &[[u16; 4]]) -> Option<Self> {
        let coverage = |texel: &[u16; 4]| texel[3];
        let light = |texel: &[u16; 4]| (0..3).fold(0, |bits, c| bits | root(texel[c], c));
        Self::of(texels, light, coverage)
    }

    /// A tile from stored colours: sRGB red, green, blue, and coverage.
    pub(crate) fn from_colors(colors: &[[u8; 4]]) -> Option<Self> {
        let opaque = &*OPAQUE;
        let coverage = |color: &[u8; 4]| u16::from(color[3]) * 257;
        let light = |color: &[u8; 4]| {
            if color[3] == u8::MAX {
                (0..3).fold(0, |bits, c| bits | opaque[c][usize::from(color[c])])
            } else {
                let texel = linear_premultiplied(*color);
                (0..3).fold(0, |bits, c| bits | root(texel[c], c))
            }
        };
        Self::of(colors, light, coverage)
    }

    fn of<T>(
        texels: &[T],
        light: impl Fn(&T) -> u32,
        coverage: impl Fn(&T) -> u16,
    ) -> Option<Self> {
        if texels.len() != TURNED {
            return None;
        }
        let holes = texels.iter().any(|texel| coverage(texel) < u16::MAX);
        let coverage = holes.then(|| both_ways(texels.iter().map(coverage)));
        Some(PhotoTile { light: both_ways(texels.iter().map(light)), coverage })
    }

    /// The arrays of the tile.
    #[inline(always)]
    pub fn texels(&self) -> Texels<'_> {
        Texels { light: &self.light, coverage: self.coverage.as_deref() }
    }

    /// One texel: linear red, green, blue and coverage, 65535 = 1; if it is opaque, that of
    /// the nearest sRGB codes. `i` and `j` from −1 to 257.
    pub fn texel(&self, i: isize, j: isize) -> [u16; 4] {
        let column = (i + TILE_RING as isize) as usize;
        let row = (j + TILE_RING as isize) as usize;
        let at = row * TILE_POSTS + column;
        let coverage = self.coverage.as_ref().map_or(u16::MAX, |coverage| coverage[at]);
        let [red, green, blue] = [0, 1, 2].map(|c| {
            let root = f64::from(self.light[at] & FIELDS[c]) / f64::from(FIELDS[c]);
            let light = (root * root * 65535.0).round() as u16;
            let code = usize::from(srgb_of_linear(light));
            if coverage == u16::MAX { LINEAR_OF_SRGB[code] } else { light }
        });
        [red, green, blue, coverage]
    }

    /// Bytes this tile takes in memory.
    pub fn memory_bytes(&self) -> usize {
        let coverage = self.coverage.as_ref().map_or(0, |coverage| size_of_val(&**coverage));
        size_of_val(&*self.light) + coverage + size_of::<Self>()
    }
}

/// The root of a light, 65535 = 1, as the bits of a channel.
fn root(light: u16, channel: usize) -> u32 {
    let most = f64::from(FIELDS[channel] >> SHIFTS[channel]);
    let root = (f64::from(light) / 65535.0).sqrt() * most;
    ((root + 0.5) as u32) << SHIFTS[channel]
}

/// Texels by rows, then by columns, then one more.
fn both_ways<T: Copy + Default>(texels: impl Iterator<Item = T>) -> Box<[T]> {
    let mut both = Vec::with_capacity(2 * TURNED + 1);
    both.extend(texels);
    for column in 0..TILE_POSTS {
        for row in 0..TILE_POSTS {
            both.push(both[row * TILE_POSTS + column]);
        }
    }
    both.push(T::default());
    both.into_boxed_slice()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn tile(color: impl Fn(usize, usize) -> [u8; 4]) -> PhotoTile {
        let colors: Vec<_> =
            (0..TURNED).map(|at| color(at % TILE_POSTS, at / TILE_POSTS)).collect();
        PhotoTile::from_colors(&colors).unwrap()
    }

    #[test]
    fn every_code_comes_back() {
        let tile = tile(|i, j| [i as u8, j as u8, (i + j) as u8, 255]);
        for j in 0..256 {
            for i in 0..256 {
                let [red, green, blue, coverage] = tile.texel(i - 1, j - 1);
                let codes = [red, green, blue].map(srgb_of_linear);
                assert_eq!(codes, [i as u8, j as u8, (i + j) as u8]);
                assert_eq!(coverage, 65535);
            }
        }
        assert!(tile.texels().coverage.is_none());
    }

    #[test]
    fn light_is_off_by_at_most_an_eighth_of_a_step() {
        for code in 0..=255u16 {
            let exact = f64::from(LINEAR_OF_SRGB[usize::from(code)]) / 65535.0;
            let near = if code == 255 { code - 1 } else { code + 1 };
            let step = (f64::from(LINEAR_OF_SRGB[usize::from(near)]) / 65535.0 - exact).abs();
            for c in 0..3 {
                let bits = root(LINEAR_OF_SRGB[usize::from(code)], c);
                let root = f64::from(bits) / f64::from(FIELDS[c]);
                let off = (root * root - exact).abs() / step;
                assert!(off < 1.0 / 8.0, "{code} {c}: {off}");
            }
        }
    }

    #[test]
    fn texels_lie_by_rows_and_by_columns() {
        let tile = tile(|i, j| [i as u8, j as u8, 7, if i == j { 40 } else { 255 }]);
        let Texels { light, coverage } = tile.texels();
        let coverage = coverage.unwrap();
        assert_eq!([light.len(), coverage.len()], [2 * TURNED + 1; 2]);
        for (i, j) in [(0, 0), (258, 258), (17, 200), (200, 17), (5, 5)] {
            let (by_rows, by_columns) = (j * TILE_POSTS + i, TURNED + i * TILE_POSTS + j);
            assert_eq!(light[by_rows], light[by_columns]);
            assert_eq!(coverage[by_rows], coverage[by_columns]);
            assert_eq!(coverage[by_rows], if i == j { 40 * 257 } else { 65535 });
        }
        assert_eq!(tile.memory_bytes(), PHOTO_TILE_BYTES);
    }

    #[test]
    fn both_makers_agree_and_a_wrong_number_of_texels_is_no_tile() {
        let color = |at: usize| [at as u8, (at / 7) as u8, 9, (at / 300) as u8];
        let colors: Vec<_> = (0..TURNED).map(color).collect();
        let linear: Vec<_> = colors.iter().map(|&color| linear_premultiplied(color)).collect();
        let (a, b) = (PhotoTile::from_colors(&colors).unwrap(), PhotoTile::new(&linear).unwrap());
        assert_eq!(a.texels().light, b.texels().light);
        assert_eq!(a.texels().coverage, b.texels().coverage);
        assert!(PhotoTile::new(&linear[1..]).is_none());
    }
}
