//! ESRI ASCII grids (`.asc`).
//!
//! Opening goes once through the text, counts values and notes where each row begins, so
//! that windows can be read later without holding the grid. Rows of the grid need not be
//! lines of the text. Values are parsed when a window asks for them.

use crate::blocks::{Block, BlockCache, check_window, read_window, wrong_content};
use crate::info::{Content, GeoTransform, Raster, RasterError, RasterInfo, Vertical, Window};
use crate::limits::{MAX_CHUNK_BYTES, MAX_SIDE};
use crate::options::{HeightUnit, OpenOptions};
use crate::sidecar::Placement;
use crate::source::Source;

/// The value for no data where the header names none.
const DEFAULT_NODATA: f64 = -9999.0;
/// The longest header, bytes.
const HEADER_BYTES: u64 = 1 << 16;
/// Bytes read at a time while the text is searched for rows.
const SEARCH_BYTES: u64 = 1 << 20;
/// Samples of a block, about.
const BLOCK_SAMPLES: u64 = 1 << 16;

struct AsciiGrid {
    source: Source,
    info: RasterInfo,
    nodata: f64,
    metres: f64,
    /// Position of the first value of each row, then the end of the last row.
    rows: Vec<u64>,
    block_rows: u64,
    cache: BlockCache<f32>,
}

/// What the header says.
#[derive(Debug, Default)]
struct Header {
    size: [Option<u64>; 2],
    /// Lower left position along x and y, and whether it is that of a sample's centre.
    corner: [Option<(f64, bool)>; 2],
    cell: [Option<f64>; 2],
    nodata: Option<f64>,
    /// Length of the header, bytes.
    length: u64,
}

/// Whether a file begins like an ESRI ASCII grid.
pub fn is_ascii_grid(head: &[u8]) -> bool {
    let text = String::from_utf8_lossy(head);
    let key = text.trim_start_matches('\u{feff}').split_ascii_whitespace().next();
    key.is_some_and(|key| is_key(&key.to_ascii_lowercase()))
}

fn is_key(key: &str) -> bool {
    matches!(
        key,
        "ncols"
            | "nrows"
            | "xllcorner"
            | "yllcorner"
            | "xllcenter"
            | "yllcenter"
            | "xllcentre"
            | "yllcentre"
            | "cellsize"
            | "dx"
            | "dy"
            | "nodata_value"
            | "nodata"
    )
}

/// Opens a grid.
///
/// # Errors
/// If the header is incomplete, or fewer values follow than it declares.
pub fn open(source: Source, options: &OpenOptions) -> Result<Box<dyn Raster>, RasterError> {
    let path = source.path();
    if options.content == Some(Content::Photo) {
        return Err(RasterError::unsupported(path, "an ASCII grid holds heights, not a photo"));
    }
    let header = read_header(&source)?;
    let (width, height) = match header.size {
        [Some(width), Some(height)] => (width, height),
        _ => return Err(RasterError::damaged(path, "the header lacks ncols or nrows")),
    };
    let in_range = |side: u64| (1..=MAX_SIDE).contains(&side);
    // Each value takes a digit and a space at least.
    let room = (source.length() - header.length).div_ceil(2);
    if !in_range(width) || !in_range(height) || width * height > room {
        let what = format!(
            "the header declares {width} x {height} values; the {} bytes that follow cannot hold \
             them: the file is cut short or its header is wrong",
            source.length() - header.length
        );
        return Err(RasterError::damaged(path, what));
    }
    let transform = transform(&header, height).ok_or_else(|| {
        let what = "the header lacks a usable xllcorner, yllcorner or cellsize";
        RasterError::damaged(path, what)
    })?;
    let found = find_rows(&source, header.length, width, height)?;
    let metres = options.unit.unwrap_or(HeightUnit::Metre).metres();
    let info = RasterInfo {
        path: path.to_owned(),
        format: "ESRI ASCII grid".into(),
        width,
        height,
        transform: Some(transform),
        crs: Placement::from_sidecars(source.sidecars()).crs,
        vertical: Vertical::Unknown,
        content: Content::Heights,
        quantum_m: found.whole.then_some(metres),
        warnings: found.warnings,
    };
    let block_rows = (BLOCK_SAMPLES / width).clamp(1, height);
    let nodata = header.nodata.unwrap_or(DEFAULT_NODATA);
    let cache = BlockCache::new(options.block_cache_bytes);
    Ok(Box::new(AsciiGrid { source, info, nodata, metres, rows: found.rows, block_rows, cache }))
}

fn transform(header: &Header, height: u64) -> Option<GeoTransform> {
    let ([Some(x), Some(y)], [Some(dx), Some(dy)]) = (header.corner, header.cell) else {
        return None;
    };
    let centre =
        |(at, is_centre): (f64, bool), step: f64| if is_centre { at } else { at + 0.5 * step };
    let top = centre(y, dy) + dy * (height - 1) as f64;
    Some(GeoTransform {
        origin: [centre(x, dx), top],
        step_column: [dx, 0.0],
        step_row: [0.0, -dy],
    })
}

fn read_header(source: &Source) -> Result<Header, RasterError> {
    let head = source.head(HEADER_BYTES)?;
    let damaged = |what: String| RasterError::damaged(source.path(), what);
    let mut header = Header::default();
    let mut at = if head.starts_with(b"\xef\xbb\xbf") { 3 } else { 0 };
    while let Some((start, end)) = next_word(&head, at) {
        let key = String::from_utf8_lossy(&head[start..end]).to_ascii_lowercase();
        if !is_key(&key) {
            if !key.starts_with(|c: char| c.is_ascii_alphabetic())
                || key.starts_with("nan")
                || key.starts_with("inf")
            {
                break;
            }
            return Err(damaged(format!("the header has the unknown key \"{key}\"")));
        }
        let (start, end) =
            next_word(&head, end).ok_or_else(|| damaged(format!("the header ends after {key}")))?;
        let word = String::from_utf8_lossy(&head[start..end]);
        let value = word.parse::<f64>().map_err(|_| {
            damaged(format!("the header gives {key} as \"{word}\", which is not a number"))
        })?;
        let whole = (value.fract() == 0.0 && (0.0..1e15).contains(&value)).then_some(value as u64);
        let length = Some(value).filter(|value| value.is_finite() && *value > 0.0);
        let place = Some(value).filter(|value| value.is_finite());
        match key.as_str() {
            "ncols" => header.size[0] = whole,
            "nrows" => header.size[1] = whole,
            "xllcorner" => header.corner[0] = place.map(|at| (at, false)),
            "yllcorner" => header.corner[1] = place.map(|at| (at, false)),
            "xllcenter" | "xllcentre" => header.corner[0] = place.map(|at| (at, true)),
            "yllcenter" | "yllcentre" => header.corner[1] = place.map(|at| (at, true)),
            "cellsize" => header.cell = [length; 2],
            "dx" => header.cell[0] = length,
            "dy" => header.cell[1] = length,
            _ => header.nodata = Some(value),
        }
        at = end;
        header.length = end as u64;
    }
    Ok(header)
}

/// Start and end of the next word.
fn next_word(text: &[u8], from: usize) -> Option<(usize, usize)> {
    let start = from + text.get(from..)?.iter().position(|byte| !byte.is_ascii_whitespace())?;
    let length = text[start..].iter().position(u8::is_ascii_whitespace);
    Some((start, length.map_or(text.len(), |length| start + length)))
}

/// What going through the values gave.
struct Rows {
    rows: Vec<u64>,
    whole: bool,
    warnings: Vec<String>,
}

/// Notes where rows begin and counts values.
fn find_rows(source: &Source, from: u64, width: u64, height: u64) -> Result<Rows, RasterError> {
    let mut rows = Vec::new();
    let (mut count, mut in_word, mut whole) = (0, false, true);
    // The number of values at which the next row begins.
    let mut next_row = 0;
    let mut at = from;
    while at < source.length() {
        let bytes = source.bytes_at(at, SEARCH_BYTES.min(source.length() - at))?;
        for (k, byte) in bytes.iter().enumerate() {
            let space = byte.is_ascii_whitespace();
            if !space && !in_word {
                if count == next_row && rows.len() as u64 <= height {
                    rows.push(at + k as u64);
                    next_row += width;
                }
                count += 1;
            }
            whole &= space || byte.is_ascii_digit() || *byte == b'-';
            in_word = !space;
        }
        at += bytes.len() as u64;
    }
    let expected = width * height;
    if count < expected {
        let what = format!(
            "the header declares {width} x {height} = {expected} values, the file ends at line {} \
             after {count}; it is cut short: fetch it again",
            line_of(source, source.length())?
        );
        return Err(RasterError::damaged(source.path(), what));
    }
    let mut warnings = Vec::new();
    if count > expected {
        let line = line_of(source, rows[height as usize])?;
        warnings.push(format!(
            "{} values follow the {expected} that the header declares, from line {line} on; they \
             are ignored",
            count - expected
        ));
    } else {
        rows.push(source.length());
    }
    Ok(Rows { rows, whole, warnings })
}

/// The line in which a position lies, counted from 1.
fn line_of(source: &Source, position: u64) -> Result<u64, RasterError> {
    let (mut line, mut at) = (1, 0);
    while at < position {
        let bytes = source.bytes_at(at, SEARCH_BYTES.min(position - at))?;
        line += bytes.iter().filter(|&&byte| byte == b'\n').count() as u64;
        at += bytes.len() as u64;
    }
    Ok(line)
}

/// A number in decimal notation. Short ones, which are nearly all, are exact products or
/// quotients of two numbers that f64 holds; the others go to the standard library.
fn parse_value(word: &[u8]) -> Option<f64> {
    const TENS: [f64; 16] =
        [1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15];
    let digits = word.strip_prefix(b"-").unwrap_or(word);
    let (mut value, mut decimals, mut after_point) = (0u64, 0, false);
    if digits.len() <= 16 && digits.first().is_some_and(u8::is_ascii_digit) {
        let simple = digits.iter().all(|&byte| match byte {
            b'0'..=b'9' => {
                value = value * 10 + u64::from(byte - b'0');
                decimals += usize::from(after_point);
                true
            }
            b'.' => !std::mem::replace(&mut after_point, true),
            _ => false,
        });
        if simple && value < 1 << 53 {
            let amount = value as f64 / TENS[decimals];
            return Some(if digits.len() < word.len() { -amount } else { amount });
        }
    }
    std::str::from_utf8(word).ok()?.parse().ok()
}

impl AsciiGrid {
    fn decode(&self, by: u64) -> Result<Block<f32>, RasterError> {
        let first = by * self.block_rows;
        let last = (first + self.block_rows).min(self.info.height);
        let (start, end) = (self.rows[first as usize], self.rows[last as usize]);
        if end - start > MAX_CHUNK_BYTES {
            let what = format!("rows {first} to {last} take {} bytes of text", end - start);
            return Err(RasterError::damaged(&self.info.path, what));
        }
        let text = self.source.bytes_at(start, end - start)?;
        let mut samples = Vec::with_capacity(((last - first) * self.info.width) as usize);
        let mut at = 0;
        while let Some((from, to)) = next_word(&text, at) {
            let word = &text[from..to];
            let value = parse_value(word).ok_or_else(|| {
                let line = line_of(&self.source, start + from as u64);
                let word = String::from_utf8_lossy(&word[..word.len().min(32)]).into_owned();
                let what = format!(
                    "\"{word}\" in line {} is not a number (decimals need a point)",
                    line.unwrap_or_default()
                );
                RasterError::damaged(&self.info.path, what)
            })?;
            let height = if value == self.nodata || !value.is_finite() {
                f32::NAN
            } else {
                (value * self.metres) as f32
            };
            samples.push(height);
            at = to;
        }
        Ok(Block { width: self.info.width as usize, samples })
    }
}

impl Raster for AsciiGrid {
    fn info(&self) -> &RasterInfo {
        &self.info
    }

    fn read_heights(&self, window: Window, into: &mut [f32]) -> Result<(), RasterError> {
        check_window(&self.info, window, into.len())?;
        read_window(window, [self.info.width, self.block_rows], into, |_, by| {
            self.cache.get(by, || self.decode(by))
        })
    }

    fn read_colors(&self, _: Window, _: &mut [[u8; 4]]) -> Result<(), RasterError> {
        Err(wrong_content(&self.info, "colours"))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::source::Sidecars;
    use proptest::prelude::*;

    fn grid(text: &str) -> Result<Box<dyn Raster>, RasterError> {
        let source = Source::from_bytes("grid.asc", text.into(), Sidecars::default());
        open(source, &OpenOptions::default())
    }

    fn all(raster: &dyn Raster) -> Result<Vec<f32>, RasterError> {
        let (width, height) = (raster.info().width as usize, raster.info().height as usize);
        let mut heights = vec![0.0; width * height];
        raster.read_heights(Window { column: 0, row: 0, width, height }, &mut heights)?;
        Ok(heights)
    }

    #[test]
    fn keys_come_in_any_case_and_order_and_rows_are_wrapped_anywhere() {
        let text = "NROWS 2\r\nXLLCENTER 10\r\nNcols 3\r\nyllcorner 20\r\ndx 2\r\ndy 4\r\n1 2\r\n\
                    3 -4.5 \t 1e2 -9999";
        let raster = grid(text).unwrap();
        let expected =
            GeoTransform { origin: [10.0, 26.0], step_column: [2.0, 0.0], step_row: [0.0, -4.0] };
        assert_eq!(raster.info().transform, Some(expected));
        assert_eq!(raster.info().quantum_m, None);
        let heights = all(&*raster).unwrap();
        assert_eq!(heights[..5], [1.0, 2.0, 3.0, -4.5, 100.0]);
        assert!(heights[5].is_nan());
    }

    const HEADER: &str = "ncols 3\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\nnodata_value 0\n";

    #[test]
    fn a_short_file_says_how_many_values_are_there_and_where_it_ends() {
        let error = grid(&format!("{HEADER}1 2 3\n400000 5\n")).err().unwrap().to_string();
        assert!(error.contains("3 x 2 = 6 values") && error.contains("line 9 after 5"), "{error}");
    }

    #[test]
    fn values_beyond_the_declared_ones_are_a_warning() {
        let raster = grid(&format!("{HEADER}1 2 3\n4 0 6\n7 8\n9")).unwrap();
        assert!(raster.info().warnings[0].contains("3 values follow"), "{:?}", raster.info());
        assert!(raster.info().warnings[0].contains("line 9"), "{:?}", raster.info());
        let heights = all(&*raster).unwrap();
        assert!(heights[4].is_nan());
        assert_eq!(heights[5], 6.0);
        assert_eq!(raster.info().quantum_m, Some(1.0));
    }

    #[test]
    fn a_word_that_is_no_number_is_named_with_its_line() {
        let raster = grid(&format!("{HEADER}1 2 3\n4,5 5 nan\n")).unwrap();
        let error = all(&*raster).unwrap_err().to_string();
        assert!(error.contains("\"4,5\" in line 8"), "{error}");
    }

    #[test]
    fn huge_declared_sizes_and_broken_headers_are_errors() {
        for text in [
            "ncols 1000000000\nnrows 1000000000\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2 3",
            "ncols 3\nnrows 2\ncellsize 1\n1 2 3 4 5 6 7 8 9",
            "ncols 3\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 0\n1 2 3 4 5 6 7 8 9",
            "ncols 0\nnrows 0\nxllcorner 0\nyllcorner 0\ncellsize 1\n",
            "ncols",
            "ncols -3",
            "colour 3",
        ] {
            assert!(grid(text).is_err(), "{text}");
        }
    }

    proptest! {
        #[test]
        fn values_are_what_the_standard_library_reads(mantissa in any::<i64>(), decimals in 0usize..12) {
            for shift in [1i64, 1_000_000, 1_000_000_000_000] {
                let mut text = format!("{:013}", (mantissa / shift).unsigned_abs());
                text.insert(text.len() - decimals, '.');
                let expected: f64 = text.parse().unwrap();
                prop_assert_eq!(parse_value(text.as_bytes()), Some(expected));
                prop_assert_eq!(parse_value(format!("-{text}").as_bytes()), Some(-expected));
            }
        }

        #[test]
        fn any_text_gives_a_grid_or_an_error(tail in "[-0-9a-z. \n]{0,80}", cut in 0usize..90) {
            let text = format!("{HEADER}{tail}");
            if let Ok(raster) = grid(&text[..cut.min(text.len())]) {
                let _ = all(&*raster);
            }
        }
    }
}
