//! Which format a file has: told by its bytes, by its name only where the format needs it.

use crate::info::{Raster, RasterError};
use crate::options::OpenOptions;
use crate::source::{Source, conversion_hint};
use crate::{esri_ascii, hgt, jpeg_file, png_file, tiff, usgs_dem};
use std::path::Path;

/// Opens a raster file of any format that is read here.
///
/// # Errors
/// If the system refuses, the format is not known, or the file is damaged.
pub fn open(path: &Path, options: &OpenOptions) -> Result<Box<dyn Raster>, RasterError> {
    open_source(Source::open(path)?, options)
}

/// Opens a raster from a source, which may be a piece of memory.
///
/// # Errors
/// As [`open`].
pub fn open_source(source: Source, options: &OpenOptions) -> Result<Box<dyn Raster>, RasterError> {
    let extension = source.path().extension().and_then(|extension| extension.to_str());
    if extension.is_some_and(|extension| extension.eq_ignore_ascii_case("hgt")) {
        return hgt::open(source, options);
    }
    let head = source.head(1024)?;
    match &head[..] {
        [b'I', b'I', 42 | 43, 0, ..] | [b'M', b'M', 0, 42 | 43, ..] => tiff::open(source, options),
        [0x89, b'P', b'N', b'G', ..] => png_file::open(source, options),
        [0xff, 0xd8, 0xff, ..] => jpeg_file::open(source, options),
        [b'P', b'K', 3, 4, ..] => hgt::open_zip(source, options),
        text if esri_ascii::is_ascii_grid(text) => esri_ascii::open(source, options),
        text if usgs_dem::is_dem(text) => usgs_dem::open(source, options),
        [] => Err(RasterError::damaged(source.path(), "the file is empty; fetch it again")),
        _ => {
            let what = format!(
                "{}; read are GeoTIFF, SRTM .hgt and .hgt.zip, ESRI ASCII grid, USGS DEM, PNG and \
                 JPEG; {}",
                unknown_format(&head),
                conversion_hint(source.path())
            );
            Err(RasterError::unsupported(source.path(), what))
        }
    }
}

/// What a file that is not read here may be, in words.
fn unknown_format(head: &[u8]) -> &'static str {
    match head {
        [b'S', b'Q', b'L', b'i', b't', b'e', ..] => "this is a GeoPackage or another SQLite file",
        [0x89, b'H', b'D', b'F', ..] | [b'C', b'D', b'F', ..] => "this is a NetCDF or HDF file",
        [0, 0, 0, 12, b'j', b'P', ..] => "this is a JPEG 2000 file",
        [b'E', b'H', b'F', b'A', ..] => "this is an ERDAS Imagine file",
        [b'<', b'V', b'R', b'T', ..] => "this is a virtual raster of GDAL",
        [0x1f, 0x8b, ..] => "this is a gzip file, to be unpacked first",
        _ => "the format is not known here",
    }
}
