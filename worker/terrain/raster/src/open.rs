//! Which format a file has: told by its bytes, by its name only where the format needs it.

use crate::info::{Raster, RasterError};
use crate::options::OpenOptions;
use crate::source::{Source, conversion_hint};
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
    let head = source.head(1024)?;
    match &head[..] {
        [b'I', b'I', 42 | 43, 0, ..] | [b'M', b'M', 0, 42 | 43, ..] => {
            crate::tiff::open(source, options)
        }
        _ => Err(RasterError::unsupported(source.path(), conversion_hint(source.path()))),
    }
}
