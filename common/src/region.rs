//! Rectangles of pixels, and how a frame is cut into jobs.

use serde::{Deserialize, Serialize};

/// A rectangle of pixels of a frame. Pixel (0, 0) is the top left one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Region {
    /// Left edge, pixels.
    pub x: u32,
    /// Top edge, pixels.
    pub y: u32,
    /// Width, pixels, at least 1.
    pub width: u32,
    /// Height, pixels, at least 1.
    pub height: u32,
}

impl Region {
    /// The whole of a frame.
    pub fn whole(width: u32, height: u32) -> Self {
        Region { x: 0, y: 0, width, height }
    }

    /// Its pixels, column and row, row by row from the top left.
    pub fn pixels(self) -> impl Iterator<Item = [u32; 2]> {
        let columns = move |y: u32| (self.x..self.x + self.width).map(move |x| [x, y]);
        (self.y..self.y + self.height).flat_map(columns)
    }

    /// Number of pixels.
    pub fn area(&self) -> u64 {
        u64::from(self.width) * u64::from(self.height)
    }

    /// Whether the region is not empty and lies within a frame of this size.
    pub fn fits(&self, width: u32, height: u32) -> bool {
        let end = |start: u32, length: u32| u64::from(start) + u64::from(length);
        self.width > 0
            && self.height > 0
            && end(self.x, self.width) <= u64::from(width)
            && end(self.y, self.height) <= u64::from(height)
    }
}

/// The shape of the jobs of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
pub enum Split {
    /// Strips of full height: the split of the flythrough paper (section 3), and the
    /// one that follows the terrain, since a column's footprint is one line on the map.
    #[default]
    Columns,
    /// Squares of at most this many pixels a side.
    Tiles(u32),
}

impl Split {
    /// The longest side of a tile, pixels: its result is 12 MiB on the wire.
    pub const MAX_TILE_SIDE: u32 = 2048;
}

/// Cuts a frame into columns at the given x positions.
///
/// `cuts` are interior positions in ascending order; each region has full height.
pub fn columns(width: u32, height: u32, cuts: &[u32]) -> Vec<Region> {
    let mut regions = Vec::with_capacity(cuts.len() + 1);
    let mut left = 0;
    for &right in cuts.iter().chain([&width]) {
        if right > left && right <= width {
            regions.push(Region { x: left, y: 0, width: right - left, height });
            left = right;
        }
    }
    regions
}

/// Cuts a frame into squares of `side` pixels, row by row from the top left; the last
/// ones of a row and the last row may be smaller.
///
/// # Panics
/// If `side` is 0.
pub fn tiles(width: u32, height: u32, side: u32) -> Vec<Region> {
    assert!(side > 0, "a tile has at least one pixel a side");
    let mut regions = Vec::new();
    for y in (0..height).step_by(side as usize) {
        for x in (0..width).step_by(side as usize) {
            regions.push(Region { x, y, width: side.min(width - x), height: side.min(height - y) });
        }
    }
    regions
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn covers_once(width: u32, height: u32, regions: &[Region]) -> bool {
        let mut seen = vec![0u8; (width * height) as usize];
        for region in regions {
            assert!(region.fits(width, height), "{region:?}");
            for y in region.y..region.y + region.height {
                for x in region.x..region.x + region.width {
                    seen[(y * width + x) as usize] += 1;
                }
            }
        }
        seen.iter().all(|&count| count == 1)
    }

    proptest! {
        #[test]
        fn tiles_cover_every_pixel_once(w in 1u32..80, h in 1u32..80, side in 1u32..90) {
            prop_assert!(covers_once(w, h, &tiles(w, h, side)));
        }

        #[test]
        fn columns_cover_every_pixel_once(w in 1u32..80, h in 1u32..20, mut cuts in prop::collection::vec(0u32..90, 0..9)) {
            cuts.sort_unstable();
            prop_assert!(covers_once(w, h, &columns(w, h, &cuts)));
        }
    }

    #[test]
    fn a_region_that_overflows_does_not_fit() {
        assert!(!Region { x: u32::MAX, y: 0, width: 2, height: 1 }.fits(10, 10));
        assert!(!Region { x: 0, y: 0, width: 0, height: 1 }.fits(10, 10));
    }
}
