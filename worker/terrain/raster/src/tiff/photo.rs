//! Photos of a GeoTIFF: samples to 8-bit red, green, blue and coverage.
//!
//! 16-bit bands are stretched, each by itself: 0 is the 2nd and 255 the 98th percentile
//! of a subsample of at most 64 blocks spread evenly over the picture, samples without
//! data left out.

use crate::blocks::{Block, BlockCache, check_window, read_window, wrong_content};
use crate::info::{Raster, RasterError, RasterInfo, Window};
use crate::options::OpenOptions;
use crate::source::{Source, conversion_hint};
use crate::tiff::directory::Directory;
use crate::tiff::layout::{Layout, SampleKind};

/// Blocks looked at for the stretch.
const STRETCH_BLOCKS: u64 = 64;

struct Photo {
    source: Source,
    layout: Layout,
    info: RasterInfo,
    bands: Bands,
    cache: BlockCache<[u8; 4]>,
}

/// What the bands mean.
struct Bands {
    /// Red, green and blue, the same one three times for grey.
    colors: [usize; 3],
    alpha: Option<usize>,
    premultiplied: bool,
    palette: Option<Vec<[u8; 3]>>,
    inverted: bool,
    nodata: Option<f64>,
    collar: Option<[u8; 3]>,
    /// Lowest and highest value per colour, 16-bit pictures.
    stretch: Option<[[f64; 2]; 3]>,
}

/// Opens the picture as a photo.
pub fn open(
    source: Source,
    directory: &Directory,
    layout: Layout,
    mut info: RasterInfo,
    options: &OpenOptions,
) -> Result<Box<dyn Raster>, RasterError> {
    if !matches!(layout.kind, SampleKind::U8 | SampleKind::U16)
        || !matches!(layout.photometric, 0..=3)
    {
        let what = format!(
            "{} samples of photometric interpretation {} are not read as a photo; convert it \
             with: gdal_translate -ot Byte -scale in.tif out.tif",
            layout.kind.name(),
            layout.photometric
        );
        return Err(RasterError::unsupported(source.path(), what));
    }
    let extra = directory.numbers(&source, 338, 4096)?.unwrap_or_default();
    let palette =
        if layout.photometric == 3 { Some(palette(&source, directory, &layout)?) } else { None };
    // The extra samples are the last ones; 1 is premultiplied, 2 plain coverage.
    let first_extra = layout.bands.saturating_sub(extra.len());
    let alpha_at = extra.iter().position(|&kind| kind == 1 || kind == 2);
    let alpha = alpha_at.map(|at| first_extra + at).filter(|&band| band > 0 && band < layout.bands);
    let plain = layout.bands - usize::from(alpha.is_some());
    let colors = if plain >= 3 && palette.is_none() { [0, 1, 2] } else { [0; 3] };
    if plain > 3 || plain == 2 {
        let used =
            if colors[1] == 0 { "the first is read, as grey" } else { "the first three are read" };
        info.warnings.push(format!("the file has {} bands; {used}", layout.bands));
    }
    let nodata = directory.text(&source, 42113)?;
    let nodata = nodata.and_then(|text| text.trim().parse::<f64>().ok());
    let bands = Bands {
        colors,
        alpha,
        premultiplied: alpha_at.is_some_and(|at| extra[at] == 1),
        palette,
        inverted: layout.photometric == 0,
        nodata,
        collar: options.collar,
        stretch: None,
    };
    let cache = BlockCache::new(options.block_cache_bytes);
    let mut photo = Photo { source, layout, info, bands, cache };
    if photo.layout.kind == SampleKind::U16 {
        let stretch = photo.find_stretch()?;
        let words = stretch.map(|[low, high]| format!("{low}..{high}")).join(", ");
        photo.info.warnings.push(format!(
            "16-bit colours are stretched to 8 bits, 2nd to 98th percentile of red, green, blue: \
             {words}"
        ));
        photo.bands.stretch = Some(stretch);
    }
    Ok(Box::new(photo))
}

/// The colours of a palette; stored as 16-bit values, all reds first.
fn palette(
    source: &Source,
    directory: &Directory,
    layout: &Layout,
) -> Result<Vec<[u8; 3]>, RasterError> {
    let values = directory.numbers(source, 320, 1 << 18)?.unwrap_or_default();
    if layout.kind != SampleKind::U8 || layout.bands != 1 || values.len() != 768 {
        let what = format!(
            "only palettes of 256 colours are read; {} -expand rgb",
            conversion_hint(source.path())
        );
        return Err(RasterError::unsupported(source.path(), what));
    }
    Ok((0..256).map(|k| [0, 256, 512].map(|at| (values[at + k] >> 8) as u8)).collect())
}

impl Photo {
    /// The planes of a block, one vector per wanted band; `None` where the file leaves
    /// the block out.
    fn planes(
        &self,
        bx: u64,
        by: u64,
        wanted: &[usize],
    ) -> Result<Option<Vec<Vec<u16>>>, RasterError> {
        let (mut planes, layout) = (Vec::new(), &self.layout);
        let mut collect = |bytes: &[u8], first, stride| {
            let mut plane = Vec::new();
            layout.kind.for_each(bytes, first, stride, |sample| plane.push(sample as u16));
            planes.push(plane);
        };
        if layout.separate {
            for &band in wanted {
                match layout.decode(&self.source, bx, by, band)? {
                    Some(bytes) => collect(&bytes, 0, 1),
                    None => return Ok(None),
                }
            }
        } else {
            let Some(bytes) = layout.decode(&self.source, bx, by, 0)? else { return Ok(None) };
            wanted.iter().for_each(|&band| collect(&bytes, band, layout.bands));
        }
        Ok(Some(planes))
    }

    fn wanted(&self) -> Vec<usize> {
        let mut wanted = self.bands.colors.to_vec();
        if self.bands.colors[1] == 0 {
            wanted.truncate(1);
        }
        wanted.extend(self.bands.alpha);
        wanted
    }

    fn decode(&self, bx: u64, by: u64) -> Result<Block<[u8; 4]>, RasterError> {
        let width = self.layout.chunk[0] as usize;
        let count = width * self.layout.chunk_rows(by) as usize;
        let Some(planes) = self.planes(bx, by, &self.wanted())? else {
            return Ok(Block { width, samples: vec![[0; 4]; count] });
        };
        let colors = planes.len() - usize::from(self.bands.alpha.is_some());
        let samples = (0..count).map(|k| {
            let raw = [0, 1, 2].map(|band: usize| planes[band.min(colors - 1)][k]);
            let alpha = self.bands.alpha.map(|_| planes[colors][k]);
            self.bands.color(raw, alpha)
        });
        Ok(Block { width, samples: samples.collect() })
    }

    fn find_stretch(&self) -> Result<[[f64; 2]; 3], RasterError> {
        let [across, down] = self.layout.chunks();
        let blocks = across * down;
        let wanted = self.wanted();
        let mut counts = [(); 3].map(|_| vec![0u64; 1 << 16]);
        for pick in 0..STRETCH_BLOCKS.min(blocks) {
            let block = pick * blocks / STRETCH_BLOCKS.min(blocks);
            let (bx, by) = (block % across, block / across);
            let Some(planes) = self.planes(bx, by, &wanted)? else { continue };
            let colors = planes.len() - usize::from(self.bands.alpha.is_some());
            // Tiles are filled up beyond the edge of the picture.
            let width = self.layout.chunk[0] as usize;
            let columns =
                (self.layout.size[0] - bx * self.layout.chunk[0]).min(width as u64) as usize;
            let rows =
                (self.layout.size[1] - by * self.layout.chunk[1]).min(self.layout.chunk_rows(by));
            for k in (0..rows as usize).flat_map(|row| row * width..row * width + columns) {
                let raw = [0, 1, 2].map(|band: usize| planes[band.min(colors - 1)][k]);
                let covered = self.bands.alpha.is_none() || planes[colors][k] > 0;
                if covered && !self.bands.is_nodata(raw) {
                    (0..3).for_each(|band| counts[band][usize::from(raw[band])] += 1);
                }
            }
        }
        Ok(counts.map(|counts| percentiles(&counts)))
    }
}

/// The 2nd and the 98th percentile of a histogram, at least 1 apart.
fn percentiles(counts: &[u64]) -> [f64; 2] {
    let total: u64 = counts.iter().sum();
    let value_at = |rank: u64| {
        let mut below = 0;
        let found = counts.iter().position(|&count| {
            below += count;
            below > rank
        });
        found.unwrap_or(0) as f64
    };
    let low = value_at(total / 50);
    [low, value_at(total - total / 50 - u64::from(total > 0)).max(low + 1.0)]
}

impl Bands {
    fn is_nodata(&self, raw: [u16; 3]) -> bool {
        self.nodata.is_some_and(|nodata| raw.map(f64::from) == [nodata; 3])
    }

    fn color(&self, raw: [u16; 3], alpha: Option<u16>) -> [u8; 4] {
        if self.is_nodata(raw) {
            return [0; 4];
        }
        let alpha = match (alpha, self.stretch) {
            (None, _) => 255,
            (Some(alpha), None) => alpha as u8,
            (Some(alpha), Some(_)) => ((u32::from(alpha) + 128) / 257) as u8,
        };
        let mut color = match (&self.palette, self.stretch) {
            (Some(palette), _) => palette[usize::from(raw[0] & 255)],
            (None, None) => raw.map(|value| value as u8),
            (None, Some(stretch)) => [0, 1, 2].map(|band| {
                let [low, high] = stretch[band];
                ((f64::from(raw[band]) - low) / (high - low) * 255.0 + 0.5).clamp(0.0, 255.0) as u8
            }),
        };
        if self.inverted {
            color = color.map(|value| 255 - value);
        }
        if self.premultiplied && alpha > 0 {
            let straight = |value: u8| (u32::from(value) * 255 / u32::from(alpha)).min(255) as u8;
            color = color.map(straight);
        }
        if alpha == 0 || self.collar == Some(color) {
            return [0; 4];
        }
        [color[0], color[1], color[2], alpha]
    }
}

impl Raster for Photo {
    fn info(&self) -> &RasterInfo {
        &self.info
    }

    fn read_heights(&self, _: Window, _: &mut [f32]) -> Result<(), RasterError> {
        Err(wrong_content(&self.info, "heights"))
    }

    fn read_colors(&self, window: Window, into: &mut [[u8; 4]]) -> Result<(), RasterError> {
        check_window(&self.info, window, into.len())?;
        read_window(window, self.layout.chunk, into, |bx, by| {
            self.cache.get(self.layout.chunk_number(bx, by, 0), || self.decode(bx, by))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_leave_out_two_in_a_hundred_on_each_side() {
        let mut counts = vec![0; 1 << 16];
        counts[1000..1100].fill(10);
        assert_eq!(percentiles(&counts), [1002.0, 1097.0]);
        assert_eq!(percentiles(&vec![0; 1 << 16]), [0.0, 1.0]);
    }
}
