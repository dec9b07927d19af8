//! Rows of a frame that are columns of the picture, on their way there.
//!
//! The pixels of such a row are a whole row of the picture apart in memory. So some rows
//! are collected and then written side by side.

use std::ops::Range;
use terrafarm_common::region::Region;

/// Rows that are written at once, at most: as many as a line of the cache has pixels. They end
/// at multiples of it, as lines do where regions begin at such.
const ROWS: usize = 16;
/// Room for a row, pixels. One line of the cache more than needed, or the rows would all lie in
/// the same few places of it.
const PITCH: usize = super::WIDEST_PX as usize + 16;

/// Rows one after another, none of them empty, and the pixels of each.
#[derive(Default)]
pub(super) struct Turned {
    values: Vec<f32>,
    /// Which of the minor axis they are.
    rows: Vec<Range<u32>>,
    /// Number of the first row, and where values begin along the minor axis.
    first: u32,
    start: u32,
}

impl Turned {
    /// Whether there is room for a row. All must be of the same part.
    pub fn takes(&self, row: u32) -> bool {
        let next = self.first + self.rows.len() as u32;
        self.rows.is_empty() || (row == next && !row.is_multiple_of(ROWS as u32))
    }

    /// Room for the pixels of a row that it takes, in a part that begins at `start` along the
    /// minor axis.
    pub fn add(&mut self, row: u32, start: u32, pixels: Range<u32>) -> &mut [f32] {
        self.values.resize(ROWS * PITCH, 0.0);
        if self.rows.is_empty() {
            (self.first, self.start) = (row, start);
        }
        let at = self.rows.len() * PITCH + (pixels.start - start) as usize;
        let end = at + pixels.len();
        self.rows.push(pixels);
        &mut self.values[at..end]
    }

    /// Puts all rows into a region of the picture.
    pub fn write(&mut self, region: Region, depths: &mut [f32]) {
        let count = self.rows.len();
        if count == 0 {
            return;
        }
        let width = region.width as usize;
        let common = self
            .rows
            .iter()
            .fold(0..u32::MAX, |common, row| common.start.max(row.start)..common.end.min(row.end));
        // All that every row has ...
        let at =
            |minor: u32| (minor - region.y) as usize * width + (self.first - region.x) as usize;
        let (rows, _) = self.values.as_chunks::<PITCH>();
        if let Ok(rows) = <&[[f32; PITCH]; ROWS]>::try_from(&rows[..count]) {
            for minor in common.clone() {
                let from = (minor - self.start) as usize;
                let line: [f32; ROWS] = std::array::from_fn(|n| rows[n][from]);
                depths[at(minor)..][..ROWS].copy_from_slice(&line);
            }
        } else {
            for minor in common.clone() {
                let from = (minor - self.start) as usize;
                for (depth, row) in depths[at(minor)..][..count].iter_mut().zip(rows) {
                    *depth = row[from];
                }
            }
        }
        // ... and what only some have.
        for (n, row) in self.rows.drain(..).enumerate() {
            let before = row.start..row.end.min(common.start.max(row.start));
            let after = row.start.max(common.end.max(before.end))..row.end;
            for minor in before.chain(after) {
                depths[at(minor) + n] = self.values[n * PITCH + (minor - self.start) as usize];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::oracle::Dice;

    #[test]
    fn pixels_come_to_where_they_would_have_been_written_one_by_one() {
        let region = Region { x: 3, y: 40, width: 70, height: 90 };
        let mut dice = Dice::new(7);
        let mut turned = Turned::default();
        for _ in 0..200 {
            let mut written = vec![0.0; region.area() as usize];
            let mut expected = written.clone();
            let cut = region.y + 1 + dice.below(u64::from(region.height) - 1) as u32;
            for part in [region.y..cut, cut..region.y + region.height] {
                let mut row = region.x;
                while row < region.x + region.width {
                    let bound = |dice: &mut Dice| part.start + dice.below(part.len() as u64) as u32;
                    let (a, b) = (bound(&mut dice), bound(&mut dice));
                    let pixels = a.min(b)..a.max(b) + 1;
                    if !turned.takes(row) {
                        turned.write(region, &mut written);
                    }
                    let values = turned.add(row, part.start, pixels.clone());
                    for (minor, value) in pixels.zip(values) {
                        *value = (minor * 1000 + row) as f32;
                        let at = (minor - region.y) * region.width + (row - region.x);
                        expected[at as usize] = *value;
                    }
                    row += if dice.below(10) == 0 { 2 } else { 1 };
                }
                turned.write(region, &mut written);
            }
            assert!(written == expected);
        }
    }
}
