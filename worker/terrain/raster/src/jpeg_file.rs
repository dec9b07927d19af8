//! JPEG photos, placed by the files beside them. Decoded whole.

use crate::info::{Content, Raster, RasterError, RasterInfo, Vertical};
use crate::limits::MAX_WHOLE_FILE_BYTES;
use crate::options::OpenOptions;
use crate::png_file::check_size;
use crate::sidecar::Placement;
use crate::source::{Source, conversion_hint};
use crate::whole::WholePhoto;
use std::panic::AssertUnwindSafe;
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
    if !is_sampling_usual(&bytes) {
        let what =
            format!("the JPEG samples its components in an unusual way; {}", conversion_hint(path));
        return Err(RasterError::unsupported(path, what));
    }
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
    // The decoder has been seen to panic on a damaged file (see `is_sampling_usual`); the
    // next such file shall be an error, too.
    let pixels = std::panic::catch_unwind(AssertUnwindSafe(|| decoder.decode()))
        .map_err(|_| {
            let what = format!("the JPEG cannot be decoded; {}", conversion_hint(path));
            RasterError::damaged(path, what)
        })?
        .map_err(damaged)?;
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

/// Whether in every frame header before the first scan the first component is the one
/// with the most samples, and the others have as many or an even part of them. All other
/// ways are allowed by the format and used by nobody; the decoder panics on some.
fn is_sampling_usual(bytes: &[u8]) -> bool {
    let mut rest = bytes.get(2..).unwrap_or_default();
    while let Some(at) = rest.windows(2).position(|pair| pair[0] == 0xff && pair[1] != 0xff) {
        let marker = rest[at + 1];
        rest = &rest[at + 2..];
        match marker {
            0xd9 | 0xda => return true,
            0x00 | 0x01 | 0xd0..=0xd8 => continue,
            _ => {}
        }
        let Some(length) = rest.first_chunk().map(|length| u16::from_be_bytes(*length)) else {
            return true;
        };
        let (segment, after) = rest.split_at(rest.len().min(usize::from(length).max(2)));
        let is_frame = matches!(marker, 0xc0..=0xcf) && !matches!(marker, 0xc4 | 0xc8 | 0xcc);
        let components = segment.get(8..).unwrap_or_default().chunks_exact(3);
        let mut sampling = components.map(|component| [component[1] >> 4, component[1] & 15]);
        if let (true, Some(first)) = (is_frame, sampling.next()) {
            let divides = |part: u8, whole: u8| part > 0 && whole.is_multiple_of(part);
            let is_usual = |other: [u8; 2]| (0..2).all(|axis| divides(other[axis], first[axis]));
            if !is_usual(first) || !sampling.all(is_usual) {
                return false;
            }
        }
        rest = after;
    }
    true
}
