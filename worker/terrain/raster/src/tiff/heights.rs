//! Heights of a GeoTIFF: samples to metres.

use crate::blocks::{Block, BlockCache, check_window, read_window, wrong_content};
use crate::info::{Raster, RasterError, RasterInfo, Window};
use crate::options::{HeightUnit, OpenOptions};
use crate::sidecar::unescape;
use crate::source::Source;
use crate::tiff::directory::Directory;
use crate::tiff::geokeys::GeoKeys;
use crate::tiff::layout::{Layout, SampleKind};

/// No height on Earth, in any unit: what larger amounts stand for in floating-point
/// files is no data, however their nodata tag was rounded.
const ABSURD_HEIGHT: f64 = 1e30;

struct Heights {
    source: Source,
    layout: Layout,
    info: RasterInfo,
    recipe: Recipe,
    cache: BlockCache<f32>,
}

/// From a sample to metres.
struct Recipe {
    nodata: Option<f64>,
    scale: f64,
    offset: f64,
    metres: f64,
}

/// Opens the first band as heights.
pub fn open(
    source: Source,
    directory: &Directory,
    layout: Layout,
    keys: &GeoKeys,
    mut info: RasterInfo,
    options: &OpenOptions,
) -> Result<Box<dyn Raster>, RasterError> {
    if layout.photometric == 3 {
        let what = "the values of a palette are not heights; open it as a photo";
        return Err(RasterError::unsupported(source.path(), what));
    }
    if layout.bands > 1 {
        info.warnings.push(format!("the file has {} bands; the first is read", layout.bands));
    }
    let metadata = directory.text(&source, 42112)?.unwrap_or_default();
    let item = |role: &str| band_item(&metadata, role);
    let number = |role: &str| item(role).and_then(|text| text.trim().parse::<f64>().ok());
    let scale = number("scale").filter(|scale| scale.is_finite() && *scale != 0.0).unwrap_or(1.0);
    let offset = number("offset").filter(|offset| offset.is_finite()).unwrap_or(0.0);
    let declared = item("unittype").and_then(|words| HeightUnit::from_words(&words));
    let unit = options.unit.or(declared).or(keys.vertical_unit()).unwrap_or(HeightUnit::Metre);
    let tag = directory.text(&source, 42113)?;
    let nodata = nodata_value(tag.as_deref(), layout.kind, &mut info.warnings);
    info.quantum_m = (layout.kind.is_whole() && (offset / scale).fract() == 0.0)
        .then(|| (scale * unit.metres()).abs());
    let recipe = Recipe { nodata, scale, offset, metres: unit.metres() };
    let cache = BlockCache::new(options.block_cache_bytes);
    Ok(Box::new(Heights { source, layout, info, recipe, cache }))
}

/// The item of GDAL's metadata with that role for the first band.
fn band_item(metadata: &str, role: &str) -> Option<String> {
    metadata.split("<Item ").skip(1).find_map(|item| {
        let (attributes, rest) = item.split_once('>')?;
        let wanted =
            attributes.contains(&format!("role=\"{role}\"")) && attributes.contains("sample=\"0\"");
        let (text, _) = rest.split_once("</Item>")?;
        wanted.then(|| unescape(text))
    })
}

/// The sample value that the tag names; `None`, with a warning, if no sample can have it.
fn nodata_value(tag: Option<&str>, kind: SampleKind, warnings: &mut Vec<String>) -> Option<f64> {
    let text = tag.map(str::trim).filter(|text| !text.is_empty())?;
    let Ok(value) = text.parse::<f64>() else {
        warnings.push(format!("the nodata tag \"{text}\" is not a number; it is not used"));
        return None;
    };
    if value.is_nan() && !kind.is_whole() {
        return None;
    }
    if !kind.holds(value) {
        let what =
            format!("the nodata value {text} cannot occur in {}; it is not used", kind.name());
        warnings.push(what);
        return None;
    }
    Some(if kind == SampleKind::F32 { f64::from(value as f32) } else { value })
}

impl Recipe {
    fn metres(&self, sample: f64) -> f32 {
        if self.nodata == Some(sample) || sample.is_nan() || sample.abs() > ABSURD_HEIGHT {
            return f32::NAN;
        }
        ((sample * self.scale + self.offset) * self.metres) as f32
    }
}

impl Heights {
    fn decode(&self, bx: u64, by: u64) -> Result<Block<f32>, RasterError> {
        let width = self.layout.chunk[0] as usize;
        let Some(bytes) = self.layout.decode(&self.source, bx, by, 0)? else {
            let count = width * self.layout.chunk_rows(by) as usize;
            return Ok(Block { width, samples: vec![f32::NAN; count] });
        };
        let stride = if self.layout.separate { 1 } else { self.layout.bands };
        let mut samples = Vec::with_capacity(bytes.len() / self.layout.kind.bytes() / stride);
        self.layout.kind.for_each(&bytes, 0, stride, |sample| {
            samples.push(self.recipe.metres(sample));
        });
        Ok(Block { width, samples })
    }
}

impl Raster for Heights {
    fn info(&self) -> &RasterInfo {
        &self.info
    }

    fn read_heights(&self, window: Window, into: &mut [f32]) -> Result<(), RasterError> {
        check_window(&self.info, window, into.len())?;
        read_window(window, self.layout.chunk, into, |bx, by| {
            self.cache.get(self.layout.chunk_number(bx, by, 0), || self.decode(bx, by))
        })
    }

    fn read_colors(&self, _: Window, _: &mut [[u8; 4]]) -> Result<(), RasterError> {
        Err(wrong_content(&self.info, "colours"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nodata_tags_are_read_as_gdal_and_others_write_them() {
        let value = |tag: &str, kind| nodata_value(Some(tag), kind, &mut Vec::new());
        assert_eq!(value("-9999", SampleKind::I16), Some(-9999.0));
        assert_eq!(value(" -32768 ", SampleKind::I16), Some(-32768.0));
        assert_eq!(value("nan", SampleKind::F32), None);
        let lowest = Some(f64::from(f32::MIN));
        assert_eq!(value("-3.4028234663852886e+38", SampleKind::F32), lowest);
        assert_eq!(value("-3.40282347e+38", SampleKind::F32), lowest);
        for (tag, kind) in [
            ("-9999", SampleKind::U16),
            ("nan", SampleKind::I16),
            ("0.5", SampleKind::U8),
            ("none", SampleKind::F32),
        ] {
            let mut warnings = Vec::new();
            assert_eq!(nodata_value(Some(tag), kind, &mut warnings), None);
            assert_eq!(warnings.len(), 1, "{tag}");
        }
    }

    #[test]
    fn absurd_amounts_are_no_data_even_when_the_tag_was_rounded() {
        let recipe = Recipe { nodata: Some(-3.4e38), scale: 1.0, offset: 0.0, metres: 1.0 };
        assert!(recipe.metres(f64::from(f32::MIN)).is_nan());
        assert!(recipe.metres(f64::INFINITY).is_nan());
        assert_eq!(recipe.metres(1234.5), 1234.5);
    }

    #[test]
    fn scale_and_offset_are_found_by_role() {
        let metadata = "<GDALMetadata>\n  <Item name=\"OFFSET\" sample=\"0\" role=\"offset\">100</Item>\n  \
                        <Item name=\"SCALE\" sample=\"0\" role=\"scale\">0.5</Item>\n</GDALMetadata>";
        assert_eq!(band_item(metadata, "scale").as_deref(), Some("0.5"));
        assert_eq!(band_item(metadata, "offset").as_deref(), Some("100"));
        assert_eq!(band_item(metadata, "unittype"), None);
    }
}
