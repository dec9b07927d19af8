//! PNG: photos and the encodings of heights in pictures.
//!
//! A PNG is decoded whole. Its place comes from the files beside it, or, for the tiles of
//! web maps, from the number of the tile.

use crate::info::{Content, GeoTransform, Raster, RasterError, RasterInfo, Vertical};
use crate::limits::{MAX_WHOLE_FILE_BYTES, MAX_WHOLE_SAMPLES};
use crate::options::{HeightUnit, OpenOptions, PngEncoding};
use crate::sidecar::Placement;
use crate::source::Source;
use crate::whole::{WholeHeights, WholePhoto};
use png::{BitDepth, ColorType, Transformations};
use std::io::Cursor;
use std::path::Path;

/// Memory that the decoder may take besides the picture itself, bytes.
const DECODER_BYTES: usize = 64 << 20;
/// The most bytes that one byte of DEFLATE can unpack to: a bit for each of four matches
/// of 258 bytes. A file that declares more than that cannot be whole.
const MAX_EXPANSION: u64 = 1032;
/// Half the length of the equator on the sphere of web maps, metres.
const WEB_MERCATOR_EDGE_M: f64 = 20_037_508.342_789_244;
/// The finest zoom level that a tile number may have.
const MAX_ZOOM: u32 = 24;

/// A decoded picture.
struct Picture {
    width: u64,
    height: u64,
    channels: usize,
    /// Whether samples have 16 bits, big-endian.
    deep: bool,
    bytes: Vec<u8>,
}

/// Opens a PNG.
///
/// # Errors
/// If the picture is damaged or too large, or its encoding of heights is not clear.
pub fn open(source: Source, options: &OpenOptions) -> Result<Box<dyn Raster>, RasterError> {
    let bytes = source.whole(MAX_WHOLE_FILE_BYTES)?;
    let (kind, depth) = header(source.path(), &bytes)?;
    let heights = match options.content {
        Some(content) => content == Content::Heights,
        None => {
            options.png_encoding != PngEncoding::Auto
                || (kind, depth) == (ColorType::Grayscale, BitDepth::Sixteen)
        }
    };
    let mut placement = Placement::from_sidecars(source.sidecars());
    let mut info = RasterInfo {
        path: source.path().to_owned(),
        format: String::new(),
        width: 0,
        height: 0,
        transform: None,
        crs: None,
        vertical: Vertical::Unknown,
        content: if heights { Content::Heights } else { Content::Photo },
        quantum_m: None,
        warnings: std::mem::take(&mut placement.warnings),
    };
    let transformations = match heights {
        true => Transformations::EXPAND,
        false => Transformations::EXPAND | Transformations::STRIP_16,
    };
    let picture = decode(source.path(), bytes, transformations)?;
    (info.width, info.height) = (picture.width, picture.height);
    if let Some(transform) = placement.transform {
        (info.transform, info.crs) = (Some(transform), placement.crs);
    } else if let Some(tile) = web_tile(&mut info, heights, options)? {
        info.transform = Some(tile_transform(tile, info.width, info.height));
        info.crs = Some("EPSG:3857".into());
    } else {
        info.crs = placement.crs;
    }
    if !heights {
        let bits =
            if depth == BitDepth::Sixteen { "16 bits, the upper 8 are read" } else { "8 bits" };
        info.format = format!("PNG photo, {bits}");
        let Picture { channels, bytes, .. } = picture;
        return Ok(Box::new(WholePhoto { info, channels, bytes, collar: options.collar }));
    }
    heights_of(picture, info, options)
}

/// Colour type and bit depth, after the declared size has been checked.
fn header(path: &Path, bytes: &[u8]) -> Result<(ColorType, BitDepth), RasterError> {
    let mut decoder = png::Decoder::new(Cursor::new(bytes));
    let info = decoder.read_header_info().map_err(|error| {
        RasterError::damaged(path, format!("the PNG header is damaged: {error}"))
    })?;
    let (width, height) = (u64::from(info.width), u64::from(info.height));
    check_size(path, width, height)?;
    let packed = (width * height * info.bits_per_pixel() as u64).div_ceil(8);
    if packed > bytes.len() as u64 * MAX_EXPANSION {
        let what = format!(
            "the picture is declared as {width} x {height} pixels, which cannot be in a file of \
             {} bytes; it is cut short or damaged: fetch it again",
            bytes.len()
        );
        return Err(RasterError::damaged(path, what));
    }
    Ok((info.color_type, info.bit_depth))
}

/// Refuses a picture that is too large to be held whole.
pub fn check_size(path: &Path, width: u64, height: u64) -> Result<(), RasterError> {
    if width == 0 || height == 0 {
        return Err(RasterError::damaged(path, "the picture is declared to have no pixels"));
    }
    if width.saturating_mul(height) > MAX_WHOLE_SAMPLES {
        let what = format!(
            "the picture is declared as {width} x {height} pixels; this format has to be held \
             whole, and at most {MAX_WHOLE_SAMPLES} pixels are read; {}",
            crate::source::conversion_hint(path)
        );
        return Err(RasterError::unsupported(path, what));
    }
    Ok(())
}

fn decode(path: &Path, bytes: Vec<u8>, wanted: Transformations) -> Result<Picture, RasterError> {
    let damaged = |error: png::DecodingError| {
        RasterError::damaged(path, format!("the PNG cannot be decoded: {error}; fetch it again"))
    };
    let limits = png::Limits { bytes: DECODER_BYTES };
    let mut decoder = png::Decoder::new_with_limits(Cursor::new(bytes), limits);
    decoder.set_transformations(wanted);
    decoder.set_ignore_text_chunk(true);
    decoder.set_ignore_iccp_chunk(true);
    let mut reader = decoder.read_info().map_err(damaged)?;
    let (width, height) = (u64::from(reader.info().width), u64::from(reader.info().height));
    let (color, depth) = reader.output_color_type();
    let size =
        width * height * color.samples() as u64 * if depth == BitDepth::Sixteen { 2 } else { 1 };
    if reader.output_buffer_size() != usize::try_from(size).ok() {
        return Err(RasterError::unsupported(path, "this PNG has a layout that is not read"));
    }
    let mut pixels = vec![0; size as usize];
    reader.next_frame(&mut pixels).map_err(damaged)?;
    let deep = depth == BitDepth::Sixteen;
    Ok(Picture { width, height, channels: color.samples(), deep, bytes: pixels })
}

fn heights_of(
    picture: Picture,
    mut info: RasterInfo,
    options: &OpenOptions,
) -> Result<Box<dyn Raster>, RasterError> {
    let encoding = match options.png_encoding {
        PngEncoding::Auto => guess_encoding(&info.path, &picture)?,
        chosen => chosen,
    };
    let fits = match encoding {
        PngEncoding::Grey16 => picture.deep && picture.channels == 1,
        _ => !picture.deep && picture.channels >= 3,
    };
    if !fits {
        let what = format!(
            "the PNG has {} channels of {} bits, which is not how {} is stored",
            picture.channels,
            if picture.deep { 16 } else { 8 },
            name(encoding)
        );
        return Err(RasterError::unsupported(&info.path, what));
    }
    let metres = options.unit.unwrap_or(HeightUnit::Metre).metres();
    let (scale, offset) = (options.height_scale, options.height_offset);
    let quantum = match encoding {
        PngEncoding::TerrainRgb => Some(0.1),
        PngEncoding::Terrarium => Some(1.0 / 256.0),
        PngEncoding::SrtmRgba => Some(1.0),
        _ => ((offset / scale).fract() == 0.0).then_some(scale.abs()),
    };
    info.format = format!("PNG, {}", name(encoding));
    info.quantum_m = quantum.map(|quantum| quantum * metres);
    if encoding == PngEncoding::SrtmRgba {
        info.vertical = Vertical::Geoid;
    }
    let heights = match encoding {
        PngEncoding::Grey16 => {
            let values = picture.bytes.as_chunks::<2>().0.iter();
            let height = |value: &[u8; 2]| offset + scale * f64::from(u16::from_be_bytes(*value));
            values.map(|value| (height(value) * metres) as f32).collect()
        }
        _ => {
            let pixels = picture.bytes.chunks_exact(picture.channels);
            let height =
                |pixel| color_height(encoding, pixel).map_or(f32::NAN, |h| (h * metres) as f32);
            pixels.map(height).collect()
        }
    };
    Ok(Box::new(WholeHeights { info, heights }))
}

fn name(encoding: PngEncoding) -> &'static str {
    match encoding {
        PngEncoding::Auto => "heights",
        PngEncoding::TerrainRgb => "Terrain-RGB",
        PngEncoding::Terrarium => "Terrarium",
        PngEncoding::Grey16 => "16-bit grey heights",
        PngEncoding::SrtmRgba => "SRTM metres in RGBA",
    }
}

/// Height of a pixel in the unit of the encoding; `None` where it stands for no data:
/// black in the encodings of web maps, -32768 in that of SRTM, and where it is
/// transparent.
fn color_height(encoding: PngEncoding, pixel: &[u8]) -> Option<f64> {
    let [red, green, blue] = [0, 1, 2].map(|k: usize| i32::from(pixel[k]));
    if pixel.get(3) == Some(&0) {
        return None;
    }
    match encoding {
        PngEncoding::SrtmRgba => {
            let stored = i32::from((green << 8 | red) as u16 as i16);
            let height = if blue == 255 { stored - 1 } else { stored };
            (height > i32::from(i16::MIN)).then_some(f64::from(height))
        }
        _ if (red, green, blue) == (0, 0, 0) => None,
        PngEncoding::Terrarium => {
            Some(f64::from(red * 256 + green) + f64::from(blue) / 256.0 - 32768.0)
        }
        // A tenth of a whole number, so that the result is the f64 nearest to the decimal.
        _ => Some(f64::from((red << 16 | green << 8 | blue) - 100_000) / 10.0),
    }
}

/// Tells the encodings apart by whether they give heights that exist on Earth, from the
/// deepest trench to the highest peak. No pixel can be plausible in both: one needs a red
/// of 0 to 2, the other one of 84 to 163.
fn guess_encoding(path: &Path, picture: &Picture) -> Result<PngEncoding, RasterError> {
    if picture.deep && picture.channels == 1 {
        return Ok(PngEncoding::Grey16);
    }
    let unclear = |why: &str| {
        let what = format!(
            "{why}; say how it stores heights: terrain-rgb, terrarium, grey16 or srtm-rgba"
        );
        Err(RasterError::unsupported(path, what))
    };
    if picture.deep || picture.channels < 3 {
        return unclear("the PNG is neither 16-bit grey nor 8-bit colour");
    }
    let share = |encoding| {
        let (mut known, mut plausible) = (0u64, 0u64);
        for pixel in picture.bytes.chunks_exact(picture.channels) {
            if let Some(height) = color_height(encoding, pixel) {
                known += 1;
                plausible += u64::from((-11_000.0..=9_000.0).contains(&height));
            }
        }
        known > 0 && plausible >= known - known / 1000
    };
    match (share(PngEncoding::TerrainRgb), share(PngEncoding::Terrarium)) {
        (true, false) => Ok(PngEncoding::TerrainRgb),
        (false, true) => Ok(PngEncoding::Terrarium),
        _ => unclear("neither Terrain-RGB nor Terrarium gives heights that exist on Earth"),
    }
}

/// The web-mercator tile from the options, or, for heights, from the name of the file.
fn web_tile(
    info: &mut RasterInfo,
    heights: bool,
    options: &OpenOptions,
) -> Result<Option<(u32, u32, u32)>, RasterError> {
    if let Some((zoom, x, y)) = options.web_tile {
        let tile = (u32::from(zoom), x, y);
        if !is_tile(tile) {
            let what = format!("there is no web map tile {zoom}/{x}/{y}; correct its number");
            return Err(RasterError::unsupported(&info.path, what));
        }
        return Ok(Some(tile));
    }
    let tile = tile_from_name(&info.path).filter(|_| heights);
    if let Some((zoom, x, y)) = tile {
        info.warnings.push(format!("placed as web map tile {zoom}/{x}/{y}, after its name"));
    }
    Ok(tile)
}

fn is_tile((zoom, x, y): (u32, u32, u32)) -> bool {
    zoom <= MAX_ZOOM && x < 1 << zoom && y < 1 << zoom
}

/// Zoom, x and y from a name like `10/906/404.png` or `fuji-10-906-404@2x.png`.
fn tile_from_name(path: &Path) -> Option<(u32, u32, u32)> {
    let stem = path.file_stem()?.to_str()?;
    let stem = stem.strip_suffix("@2x").unwrap_or(stem);
    let folders = path.parent().into_iter().flat_map(|parent| parent.components());
    let folders = folders.filter_map(|part| part.as_os_str().to_str());
    let from_folders: Vec<&str> = folders.chain([stem]).collect();
    let from_stem: Vec<&str> = stem.split(['-', '_', '.']).collect();
    [from_stem, from_folders].iter().find_map(|parts| {
        let [.., zoom, x, y] = parts[..] else { return None };
        let tile = (zoom.parse().ok()?, x.parse().ok()?, y.parse().ok()?);
        is_tile(tile).then_some(tile)
    })
}

fn tile_transform((zoom, x, y): (u32, u32, u32), width: u64, height: u64) -> GeoTransform {
    let tile_m = 2.0 * WEB_MERCATOR_EDGE_M / f64::from(1u32 << zoom);
    let step = [tile_m / width as f64, tile_m / height as f64];
    GeoTransform {
        origin: [
            f64::from(x) * tile_m - WEB_MERCATOR_EDGE_M + 0.5 * step[0],
            WEB_MERCATOR_EDGE_M - f64::from(y) * tile_m - 0.5 * step[1],
        ],
        step_column: [step[0], 0.0],
        step_row: [0.0, -step[1]],
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::info::Window;
    use crate::source::Sidecars;
    use proptest::prelude::*;

    fn encode(width: u32, color: ColorType, depth: BitDepth, bytes: &[u8]) -> Vec<u8> {
        let row = width as usize * color.samples() * if depth == BitDepth::Sixteen { 2 } else { 1 };
        let mut out = Vec::new();
        let mut encoder = png::Encoder::new(&mut out, width, (bytes.len() / row) as u32);
        encoder.set_color(color);
        encoder.set_depth(depth);
        encoder.write_header().unwrap().write_image_data(bytes).unwrap();
        out
    }

    fn memory(name: &str, bytes: Vec<u8>) -> Source {
        Source::from_bytes(name, bytes, Sidecars::default())
    }

    fn as_heights() -> OpenOptions {
        OpenOptions { content: Some(Content::Heights), ..Default::default() }
    }

    fn first_height(bytes: Vec<u8>, options: &OpenOptions) -> Result<f32, RasterError> {
        let raster = open(memory("a.png", bytes), options)?;
        let mut height = [0.0];
        let window = Window { column: 0, row: 0, width: 1, height: 1 };
        raster.read_heights(window, &mut height)?;
        Ok(height[0])
    }

    fn rgb(pixel: [u8; 3]) -> Vec<u8> {
        encode(1, ColorType::Rgb, BitDepth::Eight, &pixel)
    }

    #[test]
    fn encodings_of_heights_are_told_apart_and_decoded() {
        assert_eq!(first_height(rgb([1, 0x86, 0xa0 + 7]), &as_heights()).unwrap(), 0.7);
        assert_eq!(first_height(rgb([0x80 + 4, 1, 128]), &as_heights()).unwrap(), 1025.5);
        let grey = encode(1, ColorType::Grayscale, BitDepth::Sixteen, &[4, 1]);
        assert_eq!(first_height(grey.clone(), &OpenOptions::default()).unwrap(), 1025.0);
        let scaled = OpenOptions { height_scale: 0.5, height_offset: -100.0, ..Default::default() };
        assert_eq!(first_height(grey, &scaled).unwrap(), 412.5);
        let srtm = OpenOptions { png_encoding: PngEncoding::SrtmRgba, ..Default::default() };
        assert_eq!(first_height(rgb([243, 255, 255]), &srtm).unwrap(), -14.0);
        assert_eq!(first_height(rgb([2, 1, 0]), &srtm).unwrap(), 258.0);
        assert!(first_height(rgb([1, 128, 255]), &srtm).unwrap().is_nan());
    }

    #[test]
    fn a_picture_that_is_no_map_of_heights_asks_for_the_encoding() {
        for pixel in [[0, 0, 0], [50, 60, 70], [255, 255, 255]] {
            let error = first_height(rgb(pixel), &as_heights()).unwrap_err().to_string();
            assert!(error.contains("terrarium"), "{error}");
        }
    }

    #[test]
    fn a_tile_is_placed_by_option_or_by_name() {
        let sample = rgb([1, 0x86, 0xa7]);
        for name in ["t/10/906/404.png", "fuji-10-906-404@2x.png"] {
            let raster = open(memory(name, sample.clone()), &as_heights()).unwrap();
            let transform = raster.info().transform.unwrap();
            // The one sample is the middle of the tile: 138.69 E, 35.32 N.
            let longitude = transform.origin[0] / WEB_MERCATOR_EDGE_M * 180.0;
            assert!((longitude - 138.691_406_25).abs() < 1e-9, "{longitude}");
            assert_eq!(raster.info().crs.as_deref(), Some("EPSG:3857"));
        }
        let wrong = OpenOptions { web_tile: Some((2, 4, 0)), ..as_heights() };
        assert!(open(memory("a.png", sample.clone()), &wrong).is_err());
        assert!(open(memory("a.png", sample), &as_heights()).unwrap().info().transform.is_none());
    }

    #[test]
    fn a_photo_keeps_its_coverage_and_loses_its_collar() {
        let pixels = [1, 2, 3, 255, 4, 5, 6, 0, 9, 9, 9, 255];
        let bytes = encode(3, ColorType::Rgba, BitDepth::Eight, &pixels);
        let options = OpenOptions { collar: Some([9; 3]), ..Default::default() };
        let raster = open(memory("a.png", bytes), &options).unwrap();
        let mut colors = [[0; 4]; 3];
        raster.read_colors(Window { column: 0, row: 0, width: 3, height: 1 }, &mut colors).unwrap();
        assert_eq!(colors, [[1, 2, 3, 255], [0; 4], [0; 4]]);
    }

    #[test]
    fn a_bomb_is_refused_by_its_declared_size() {
        let mut bytes = rgb([1, 2, 3]);
        bytes[16..24].copy_from_slice(&[0x3b, 0x9a, 0xca, 0, 0x3b, 0x9a, 0xca, 0]);
        // The header's checksum no longer fits; either reason is a refusal.
        assert!(open(memory("bomb.png", bytes), &OpenOptions::default()).is_err());
        assert!(check_size(Path::new("a"), 1_000_000_000, 1_000_000_000).is_err());
    }

    #[test]
    fn a_size_that_cannot_be_in_so_short_a_file_is_refused_before_memory_is_asked_for() {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, 1 << 13, 1 << 13);
        encoder.set_color(ColorType::Rgba);
        encoder.write_header().unwrap();
        let error = open(memory("a.png", bytes), &OpenOptions::default()).err().unwrap();
        assert!(error.to_string().contains("cannot be in a file"), "{error}");
    }

    #[test]
    fn a_flat_picture_packed_as_tightly_as_can_be_is_read() {
        let (side, mut bytes) = (1 << 12, Vec::new());
        let mut encoder = png::Encoder::new(&mut bytes, side, side);
        encoder.set_compression(png::Compression::High);
        encoder.write_header().unwrap().write_image_data(&vec![0; 1 << 24]).unwrap();
        assert!(bytes.len() < 1 << 15, "{} bytes", bytes.len());
        assert!(open(memory("a.png", bytes), &OpenOptions::default()).is_ok());
    }

    proptest! {
        #[test]
        fn cut_and_flipped_files_give_a_raster_or_an_error(cut in 0usize..400, at in 0usize..400, bit in 0u8..8) {
            let pixels: Vec<u8> = (0..20 * 4 * 4).map(|k| (k * 7) as u8).collect();
            let mut bytes = encode(20, ColorType::Rgba, BitDepth::Eight, &pixels);
            let whole = bytes.len();
            bytes.truncate(cut);
            let _ = open(memory("a.png", bytes.clone()), &OpenOptions::default());
            let mut bytes = encode(20, ColorType::Rgba, BitDepth::Eight, &pixels);
            bytes[at % whole] ^= 1 << bit;
            let _ = open(memory("a.png", bytes), &OpenOptions::default());
        }
    }
}
