//! Rasters that are held whole, because their format can only be decoded at once.

use crate::blocks::{check_window, wrong_content};
use crate::info::{Raster, RasterError, RasterInfo, Window};

/// Heights in memory.
pub struct WholeHeights {
    /// What the file says.
    pub info: RasterInfo,
    /// Metres, row by row, NaN for no data; width times height of them.
    pub heights: Vec<f32>,
}

/// A photo in memory.
pub struct WholePhoto {
    /// What the file says.
    pub info: RasterInfo,
    /// Bytes per pixel: 1 grey, 2 grey and coverage, 3 colour, 4 colour and coverage.
    pub channels: usize,
    /// The pixels, row by row.
    pub bytes: Vec<u8>,
    /// A colour that means no data.
    pub collar: Option<[u8; 3]>,
}

/// Positions of the rows of a window in a raster, in samples.
fn rows(info: &RasterInfo, window: Window) -> impl Iterator<Item = usize> + use<> {
    let (width, first) = (info.width as usize, window.row as usize);
    (0..window.height).map(move |row| (first + row) * width + window.column as usize)
}

impl Raster for WholeHeights {
    fn info(&self) -> &RasterInfo {
        &self.info
    }

    fn read_heights(&self, window: Window, into: &mut [f32]) -> Result<(), RasterError> {
        check_window(&self.info, window, into.len())?;
        for (row, at) in into.chunks_exact_mut(window.width.max(1)).zip(rows(&self.info, window)) {
            row.copy_from_slice(&self.heights[at..at + window.width]);
        }
        Ok(())
    }

    fn read_colors(&self, _: Window, _: &mut [[u8; 4]]) -> Result<(), RasterError> {
        Err(wrong_content(&self.info, "colours"))
    }
}

impl Raster for WholePhoto {
    fn info(&self) -> &RasterInfo {
        &self.info
    }

    fn read_heights(&self, _: Window, _: &mut [f32]) -> Result<(), RasterError> {
        Err(wrong_content(&self.info, "heights"))
    }

    fn read_colors(&self, window: Window, into: &mut [[u8; 4]]) -> Result<(), RasterError> {
        check_window(&self.info, window, into.len())?;
        for (row, at) in into.chunks_exact_mut(window.width.max(1)).zip(rows(&self.info, window)) {
            let pixels = &self.bytes[at * self.channels..(at + window.width) * self.channels];
            for (texel, pixel) in row.iter_mut().zip(pixels.chunks_exact(self.channels)) {
                *texel = match *pixel {
                    [grey] => [grey, grey, grey, 255],
                    [grey, alpha] => [grey, grey, grey, alpha],
                    [red, green, blue] => [red, green, blue, 255],
                    [red, green, blue, alpha, ..] => [red, green, blue, alpha],
                    [] => [0; 4],
                };
                if texel[3] == 0 || self.collar.is_some_and(|collar| texel[..3] == collar) {
                    *texel = [0; 4];
                }
            }
        }
        Ok(())
    }
}
