//! Which pixels of a frame have arrived: one bit each, rows beginning at a word.

use terrafarm_common::region::Region;

/// Bits of a word.
const WORD: u32 = u64::BITS;

/// The pixels of one frame that are there.
#[derive(Debug, Clone)]
pub(crate) struct Coverage {
    words_per_row: usize,
    bits: Vec<u64>,
    missing_px: u64,
}

impl Coverage {
    /// Nothing is there.
    pub(crate) fn new(width: u32, height: u32) -> Self {
        let words_per_row = width.div_ceil(WORD) as usize;
        Coverage {
            words_per_row,
            bits: vec![0; words_per_row * height as usize],
            missing_px: u64::from(width) * u64::from(height),
        }
    }

    /// Pixels that are not there yet.
    pub(crate) fn missing_px(&self) -> u64 {
        self.missing_px
    }

    /// How many pixels of a region inside the frame are there.
    pub(crate) fn count(&self, region: Region) -> u64 {
        let rows = region.y as usize..(region.y + region.height) as usize;
        let words = rows.flat_map(|row| self.words(row, region));
        words.map(|(word, mask)| u64::from((self.bits[word] & mask).count_ones())).sum()
    }

    /// Marks a region inside the frame, of which nothing was there.
    pub(crate) fn add(&mut self, region: Region) {
        for row in region.y as usize..(region.y + region.height) as usize {
            for (word, mask) in self.words(row, region) {
                self.bits[word] |= mask;
            }
        }
        self.missing_px -= region.area();
    }

    /// Marks a region inside the frame, all of which was there, as missing.
    pub(crate) fn remove(&mut self, region: Region) {
        for row in region.y as usize..(region.y + region.height) as usize {
            for (word, mask) in self.words(row, region) {
                self.bits[word] &= !mask;
            }
        }
        self.missing_px += region.area();
    }

    /// The words that a region touches in a row, each with the bits that belong to it.
    fn words(&self, row: usize, region: Region) -> impl Iterator<Item = (usize, u64)> + use<> {
        let (left, right) = (region.x, region.x + region.width);
        let first = row * self.words_per_row;
        (left / WORD..right.div_ceil(WORD)).map(move |word| {
            let from = left.saturating_sub(word * WORD);
            let to = (right - word * WORD).min(WORD);
            let mask = (u64::MAX >> (WORD - (to - from))) << from;
            (first + word as usize, mask)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn it_agrees_with_a_list_of_pixels(
            width in 1u32..200, height in 1u32..6,
            regions in prop::collection::vec((0u32..200, 0u32..6, 1u32..200, 1u32..6), 1..12),
        ) {
            let mut coverage = Coverage::new(width, height);
            let mut there = vec![false; (width * height) as usize];
            for (x, y, w, h) in regions {
                let region = Region { x, y, width: w, height: h };
                if !region.fits(width, height) {
                    continue;
                }
                let rows = (y..y + h).flat_map(|y| (x..x + w).map(move |x| (y * width + x) as usize));
                let rows: Vec<usize> = rows.collect();
                let count = rows.iter().filter(|&&at| there[at]).count() as u64;
                prop_assert_eq!(coverage.count(region), count);
                if count == 0 {
                    coverage.add(region);
                    rows.iter().for_each(|&at| there[at] = true);
                } else if count == region.area() {
                    coverage.remove(region);
                    rows.iter().for_each(|&at| there[at] = false);
                }
                let missing = there.iter().filter(|there| !**there).count() as u64;
                prop_assert_eq!(coverage.missing_px(), missing);
            }
        }
    }
}
