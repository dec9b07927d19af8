//! Pictures in memory.

use crate::region::Region;

/// An 8-bit sRGB picture: rows from the top, three bytes a pixel.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rgb8 {
    width: u32,
    height: u32,
    pixels: Vec<u8>,
}

impl Rgb8 {
    /// A black picture.
    ///
    /// # Panics
    /// If the picture would not fit in memory; check sizes from outside against
    /// [`crate::camera::MAX_SIDE_PX`] first.
    pub fn new(width: u32, height: u32) -> Self {
        Rgb8 { width, height, pixels: vec![0; width as usize * height as usize * 3] }
    }

    /// Wraps pixels that already exist; `None` if their number does not fit the size.
    pub fn from_pixels(width: u32, height: u32, pixels: Vec<u8>) -> Option<Self> {
        let expected = (width as usize).checked_mul(height as usize)?.checked_mul(3)?;
        (pixels.len() == expected).then_some(Rgb8 { width, height, pixels })
    }

    /// Width, pixels.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Height, pixels.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// All pixels, row-major from the top left.
    pub fn pixels(&self) -> &[u8] {
        &self.pixels
    }

    /// All pixels, to be written.
    pub fn pixels_mut(&mut self) -> &mut [u8] {
        &mut self.pixels
    }

    /// Gives the pixels away.
    pub fn into_pixels(self) -> Vec<u8> {
        self.pixels
    }

    /// One pixel.
    ///
    /// # Panics
    /// Outside the picture.
    pub fn get(&self, x: u32, y: u32) -> [u8; 3] {
        let at = (y as usize * self.width as usize + x as usize) * 3;
        [self.pixels[at], self.pixels[at + 1], self.pixels[at + 2]]
    }

    /// Copies the pixels of a region (rows from the top, three bytes a pixel) into place.
    /// Returns `false`, and changes nothing, if the region or the length does not fit.
    #[must_use]
    pub fn paste(&mut self, region: Region, pixels: &[u8]) -> bool {
        if !region.fits(self.width, self.height) || pixels.len() as u64 != region.area() * 3 {
            return false;
        }
        let row_bytes = region.width as usize * 3;
        for (row, source) in pixels.chunks_exact(row_bytes).enumerate() {
            let y = region.y as usize + row;
            let start = (y * self.width as usize + region.x as usize) * 3;
            self.pixels[start..start + row_bytes].copy_from_slice(source);
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pasted_regions_make_the_whole() {
        let mut picture = Rgb8::new(3, 2);
        for region in crate::region::tiles(3, 2, 2) {
            let value = region.x as u8 + 10 * region.y as u8 + 1;
            assert!(picture.paste(region, &vec![value; region.area() as usize * 3]));
        }
        assert_eq!(picture.get(0, 0), [1; 3]);
        assert_eq!(picture.get(2, 1), [3; 3]);
    }

    #[test]
    fn a_region_outside_or_of_another_length_changes_nothing() {
        let mut picture = Rgb8::new(4, 4);
        let before = picture.clone();
        assert!(!picture.paste(Region { x: 3, y: 0, width: 2, height: 1 }, &[9; 6]));
        assert!(!picture.paste(Region { x: 0, y: 0, width: 2, height: 1 }, &[9; 5]));
        assert_eq!(picture, before);
    }
}
