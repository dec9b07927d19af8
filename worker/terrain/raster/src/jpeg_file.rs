//! JPEG photos, placed by the files beside them. Decoded whole.

use crate::info::{Content, Raster, RasterError, RasterInfo, Vertical};
use crate::limits::MAX_WHOLE_FILE_BYTES;
use crate::options::OpenOptions;
use crate::png_file::check_size;
use crate::sidecar::Placement;
use crate::source::{Source, conversion_hint};
use crate::whole::WholePhoto;
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

/// Passes over the picture that a progressive file may ask for.
const MAX_SCANS: usize = 64;
/// The most pixels that one byte of a file can hold. A block of 8 x 8 samples takes a bit
/// at least, and the component with the most samples has one for every four pixels or
/// more. A file that declares more cannot be whole.
const MAX_PIXELS_PER_BYTE: u64 = 8 * 64 * 4;

/// Opens a JPEG.
///
/// # Errors
/// If heights are asked for, or the picture is damaged or too large.
pub fn open(source: Source, options: &OpenOptions) -> Result<Box<dyn Raster>, RasterError> {
    let path = source.path();
    if options.content == Some(Content::Heights) {
        let what = "heights in a JPEG have lost their values; use the file they were made from";
        return Err(RasterError::unsupported(path, what));
    }
    let bytes = source.whole(MAX_WHOLE_FILE_BYTES)?;
    let length = bytes.len() as u64;
    let settings = DecoderOptions::new_safe()
        .set_strict_mode(true)
        .set_max_width(1 << 16)
        .set_max_height(1 << 16)
        .jpeg_set_max_scans(MAX_SCANS)
        .jpeg_set_out_colorspace(ColorSpace::RGB);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), settings);
    let damaged = |error: zune_jpeg::errors::DecodeErrors| {
        let what = format!(
            "the JPEG cannot be decoded: {error}; fetch it again, or else {}",
            conversion_hint(path)
        );
        RasterError::damaged(path, what)
    };
    decoder.decode_headers().map_err(damaged)?;
    let (width, height) = decoder
        .info()
        .map(|info| (u64::from(info.width), u64::from(info.height)))
        .ok_or_else(|| RasterError::damaged(path, "the JPEG header is damaged"))?;
    check_size(path, width, height)?;
    if width * height > length * MAX_PIXELS_PER_BYTE {
        let what = format!(
            "the picture is declared as {width} x {height} pixels, which cannot be in a file of \
             {length} bytes; it is cut short or damaged: fetch it again"
        );
        return Err(RasterError::damaged(path, what));
    }
    let pixels = decoder.decode().map_err(damaged)?;
    if pixels.len() as u64 != width * height * 3 {
        let what = format!("this kind of JPEG is not read; {}", conversion_hint(path));
        return Err(RasterError::unsupported(path, what));
    }
    let placement = Placement::from_sidecars(source.sidecars());
    let info = RasterInfo {
        path: path.to_owned(),
        format: "JPEG photo".into(),
        width,
        height,
        transform: placement.transform,
        crs: placement.crs,
        vertical: Vertical::Unknown,
        content: Content::Photo,
        quantum_m: None,
        warnings: placement.warnings,
    };
    Ok(Box::new(WholePhoto { info, channels: 3, bytes: pixels, collar: options.collar }))
}
