//! USGS ASCII DEM: heights in profiles from south to north, written by FORTRAN.
//!
//! Record A (1024 characters) holds the header in fixed columns; each record B one
//! profile. Numbers of a profile are read as words of at most their field's width, so that
//! files with and without line ends, padded or not, read the same. Profiles may begin
//! and end anywhere (a quadrangle is not upright in UTM); what they leave out is void.

use crate::info::{Content, GeoTransform, Raster, RasterError, RasterInfo, Vertical};
use crate::limits::{MAX_WHOLE_FILE_BYTES, MAX_WHOLE_SAMPLES};
use crate::options::{HeightUnit, OpenOptions};
use crate::source::Source;
use crate::whole::WholeHeights;
use std::path::Path;

/// Length of record A.
const RECORD_A_BYTES: usize = 1024;
/// The elevation that stands for no data.
const VOID: i64 = -32767;
/// Posts of the grid for each post in the file, at most; more says that the positions of
/// profiles are damaged.
const MAX_SPARSENESS: u64 = 64;

/// What record A says.
struct RecordA {
    /// 0 geographic, 1 UTM, others state plane and older systems.
    system: i64,
    zone: i64,
    datum: i64,
    /// Degrees or metres in a unit of position.
    ground: f64,
    /// Metres in a unit of height.
    unit: HeightUnit,
    /// Distance between posts, in units of position, and steps of height.
    spacing: [f64; 3],
    profiles: i64,
    /// 1 local mean sea level, 2 NGVD 29, 3 NAVD 88; 0 not said.
    vertical: i64,
}

/// One profile: position of its first post, and heights in metres.
struct Profile {
    start: [f64; 2],
    heights: Vec<f32>,
}

/// Whether a file begins like a USGS DEM: whole numbers in the columns of level, pattern,
/// system and units.
pub fn is_dem(head: &[u8]) -> bool {
    let in_range = |from, low, high| {
        field_number(head, from, 6).is_some_and(|value| (low..=high).contains(&value))
    };
    head.len() >= 864
        && head[..144].iter().all(|byte| matches!(byte, b' '..=b'~'))
        && in_range(144, 1.0, 4.0)
        && in_range(156, 0.0, 20.0)
        && in_range(528, 0.0, 3.0)
        && in_range(534, 1.0, 2.0)
}

/// Opens a DEM.
///
/// # Errors
/// If records are damaged or cut short.
pub fn open(source: Source, options: &OpenOptions) -> Result<Box<dyn Raster>, RasterError> {
    let path = source.path();
    if options.content == Some(Content::Photo) {
        return Err(RasterError::unsupported(path, "a USGS DEM holds heights, not a photo"));
    }
    let bytes = source.whole(MAX_WHOLE_FILE_BYTES)?;
    let (header, start) = record_a(path, &bytes)?;
    let metres = options.unit.unwrap_or(header.unit).metres();
    let profiles = read_profiles(path, &bytes, start, &header, metres)?;
    let (size, first, heights) = fill_grid(path, &header, &profiles)?;
    let step = [0, 1].map(|axis| header.spacing[axis] * header.ground);
    let [width, height] = size;
    let top = first[1] * header.ground + (height - 1) as f64 * step[1];
    let mut info = RasterInfo {
        path: path.to_owned(),
        format: "USGS ASCII DEM".into(),
        width,
        height,
        transform: Some(GeoTransform {
            origin: [first[0] * header.ground, top],
            step_column: [step[0], 0.0],
            step_row: [0.0, -step[1]],
        }),
        crs: None,
        vertical: if header.vertical > 0 { Vertical::Geoid } else { Vertical::Unknown },
        content: Content::Heights,
        quantum_m: Some(header.spacing[2] * metres),
        warnings: Vec::new(),
    };
    match crs(&header) {
        Some(code) => info.crs = Some(format!("EPSG:{code}")),
        None => info.warnings.push(format!(
            "the reference system is not used: system {}, zone {}, datum {} have no EPSG code here",
            header.system, header.zone, header.datum
        )),
    }
    Ok(Box::new(WholeHeights { info, heights }))
}

/// The EPSG code of the horizontal system. A datum that is not given is NAD27, as before
/// the field existed.
fn crs(header: &RecordA) -> Option<i64> {
    let (utm, geographic) = match header.datum {
        0 | 1 => (26700, 4267),
        2 => (32200, 4322),
        3 => (32600, 4326),
        4 => (26900, 4269),
        _ => return None,
    };
    match (header.system, header.zone) {
        (0, _) => Some(geographic),
        (1, 1..=60) if header.datum == 2 || header.datum == 3 => Some(utm + header.zone),
        (1, -60..=-1) if header.datum == 2 || header.datum == 3 => Some(utm + 100 - header.zone),
        (1, 1..=22) => Some(utm + header.zone),
        (1, 23) if header.datum == 4 => Some(26923),
        _ => None,
    }
}

/// A number in fixed columns, FORTRAN's D exponents included.
fn field_number(bytes: &[u8], from: usize, width: usize) -> Option<f64> {
    let text = std::str::from_utf8(bytes.get(from..from + width)?).ok()?.trim();
    let number: f64 = text.replace(['D', 'd'], "E").parse().ok()?;
    number.is_finite().then_some(number)
}

/// Reads record A; also gives where it ends.
fn record_a(path: &Path, bytes: &[u8]) -> Result<(RecordA, usize), RasterError> {
    let damaged = |what: String| RasterError::damaged(path, what);
    // A record that was cut after its last character ends with its line.
    let line = bytes.iter().take(RECORD_A_BYTES).position(|&byte| byte == b'\n' || byte == b'\r');
    let length = line.unwrap_or(RECORD_A_BYTES).min(bytes.len());
    let record = &bytes[..length];
    let number = |from: usize, width: usize, name: &str| {
        field_number(record, from, width).ok_or_else(|| {
            damaged(format!(
                "record A has no number for {name} in columns {} to {}",
                from + 1,
                from + width
            ))
        })
    };
    let ground = match number(528, 6, "the unit of position")? as i64 {
        0 => 180.0 / std::f64::consts::PI,
        1 => HeightUnit::Foot.metres(),
        2 => 1.0,
        3 => 1.0 / 3600.0,
        unit => return Err(damaged(format!("record A gives the unknown unit of position {unit}"))),
    };
    let unit = match number(534, 6, "the unit of height")? as i64 {
        1 => HeightUnit::Foot,
        2 => HeightUnit::Metre,
        unit => return Err(damaged(format!("record A gives the unknown unit of height {unit}"))),
    };
    let spacing = [
        number(816, 12, "the spacing along x")?,
        number(828, 12, "the spacing along y")?,
        number(840, 12, "the steps of height")?,
    ];
    if spacing.iter().any(|&step| step <= 0.0) {
        return Err(damaged(format!(
            "record A gives the spacing {spacing:?}, which is not positive"
        )));
    }
    let optional = |from| field_number(record, from, 2).unwrap_or(0.0) as i64;
    let header = RecordA {
        system: number(156, 6, "the reference system")? as i64,
        zone: number(162, 6, "the zone")? as i64,
        datum: optional(890),
        ground,
        unit,
        spacing,
        profiles: number(858, 6, "the number of profiles")? as i64,
        vertical: optional(888),
    };
    Ok((header, length))
}

/// Goes through the words of records B.
struct Words<'a> {
    path: &'a Path,
    bytes: &'a [u8],
    at: usize,
}

impl Words<'_> {
    /// The next number, from at most `width` characters. A sign begins a new number unless
    /// it belongs to an exponent, so that -32767-32767 is two of them.
    fn number(&mut self, width: usize) -> Result<f64, RasterError> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let Some(blank) = rest.iter().position(|byte| !byte.is_ascii_whitespace()) else {
            let what = format!(
                "the file ends at byte {} within a profile; it is cut short: fetch it again",
                self.bytes.len()
            );
            return Err(RasterError::damaged(self.path, what));
        };
        let word = &rest[blank..];
        let ends = |k: usize| {
            let sign = matches!(word[k], b'-' | b'+');
            word[k].is_ascii_whitespace()
                || sign && k > 0 && !matches!(word[k - 1], b'D' | b'd' | b'E' | b'e')
        };
        let most = width.min(word.len());
        let length = (0..most).find(|&k| ends(k)).unwrap_or(most);
        let position = self.at + blank;
        self.at = position + length;
        field_number(word, 0, length).ok_or_else(|| {
            let text = String::from_utf8_lossy(&word[..length]).into_owned();
            let what =
                format!("\"{text}\" at byte {position} is not a number; the file is damaged");
            RasterError::damaged(self.path, what)
        })
    }
}

fn read_profiles(
    path: &Path,
    bytes: &[u8],
    start: usize,
    header: &RecordA,
    metres: f64,
) -> Result<Vec<Profile>, RasterError> {
    let mut words = Words { path, bytes, at: start };
    let mut profiles = Vec::new();
    for number in 0..header.profiles {
        let _row = words.number(6)?;
        let _column = words.number(6)?;
        let rows = words.number(6)?;
        let columns = words.number(6)?;
        if columns != 1.0 || !(0.0..=bytes.len() as f64).contains(&rows) {
            let what = format!(
                "profile {} before byte {} is declared as {rows} x {columns} posts; the file is \
                 damaged",
                number + 1,
                words.at
            );
            return Err(RasterError::damaged(path, what));
        }
        let start = [words.number(24)?, words.number(24)?];
        let datum = words.number(24)?;
        let _lowest = words.number(24)?;
        let _highest = words.number(24)?;
        let mut heights = Vec::new();
        for _ in 0..rows as u64 {
            let value = words.number(6)?;
            let height = (value * header.spacing[2] + datum) * metres;
            heights.push(if value as i64 == VOID { f32::NAN } else { height as f32 });
        }
        profiles.push(Profile { start, heights });
    }
    Ok(profiles)
}

/// Lays the profiles out on a grid, row 0 in the north. Gives its size, the position of
/// its south-west post, and its heights.
fn fill_grid(
    path: &Path,
    header: &RecordA,
    profiles: &[Profile],
) -> Result<([u64; 2], [f64; 2], Vec<f32>), RasterError> {
    let damaged = |what: &str| RasterError::damaged(path, what);
    let filled: Vec<&Profile> = profiles.iter().filter(|p| !p.heights.is_empty()).collect();
    let least = |axis: usize| filled.iter().map(|p| p.start[axis]).fold(f64::INFINITY, f64::min);
    let first = [least(0), least(1)];
    if filled.is_empty() {
        return Err(damaged("the file holds no profile with heights"));
    }
    let place = |profile: &Profile| {
        [0, 1].map(|axis| ((profile.start[axis] - first[axis]) / header.spacing[axis]).round())
    };
    let end = |profile: &Profile| {
        let [column, row] = place(profile);
        [column + 1.0, row + profile.heights.len() as f64]
    };
    let most = |axis: usize| filled.iter().map(|p| end(p)[axis]).fold(0.0, f64::max);
    let posts: u64 = filled.iter().map(|p| p.heights.len() as u64).sum();
    let cells = most(0) * most(1);
    let limit = MAX_WHOLE_SAMPLES.min(posts.saturating_mul(MAX_SPARSENESS)) as f64;
    if !(cells > 0.0 && cells <= limit) {
        return Err(damaged(
            "the positions of the profiles lie too far apart for their number; the file is damaged",
        ));
    }
    let (width, height) = (most(0) as usize, most(1) as usize);
    let mut heights = vec![f32::NAN; width * height];
    for profile in filled {
        let [column, row] = place(profile).map(|at| at as usize);
        for (k, &value) in profile.heights.iter().enumerate() {
            heights[(height - 1 - row - k) * width + column] = value;
        }
    }
    Ok(([width as u64, height as u64], first, heights))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::info::Window;
    use crate::source::Sidecars;
    use proptest::prelude::*;

    fn double(value: f64) -> String {
        format!("{:>24}", format!("{value:.15e}").replace('e', "D"))
    }

    /// Two profiles of 3 and 2 posts, the second one beginning one post further north.
    fn sample(feet: bool, datum: &str) -> Vec<u8> {
        let mut a = vec![b' '; RECORD_A_BYTES];
        let mut put =
            |from: usize, text: &str| a[from..from + text.len()].copy_from_slice(text.as_bytes());
        put(0, "TEST QUADRANGLE");
        put(144, "     1     1     1    10");
        put(528, "     2");
        put(534, if feet { "     1" } else { "     2" });
        put(816, "  30.0000000  30.0000000   0.1000000");
        put(852, "     1     2");
        put(890, datum);
        let mut text = String::from_utf8(a).unwrap();
        for (column, y, heights) in
            [(1, 5100000.0, vec![100, -32767, 300]), (2, 5100030.0, vec![-32767, -5])]
        {
            let mut record = format!("     1{column:6}{:6}     1", heights.len());
            record += &double(500000.0 + 30.0 * f64::from(column - 1));
            record += &[y, 10.0, 0.0, 0.0].map(double).concat();
            record.extend(heights.iter().map(|height| format!("{height:6}")));
            text += &format!("{record:1024}");
        }
        text.into_bytes()
    }

    fn read(bytes: Vec<u8>) -> Result<(RasterInfo, Vec<f32>), RasterError> {
        let raster =
            open(Source::from_bytes("a.dem", bytes, Sidecars::default()), &OpenOptions::default())?;
        let info = raster.info().clone();
        let (width, height) = (info.width as usize, info.height as usize);
        let mut heights = vec![0.0; width * height];
        raster.read_heights(Window { column: 0, row: 0, width, height }, &mut heights)?;
        Ok((info, heights))
    }

    #[test]
    fn ragged_profiles_are_laid_out_from_the_south() {
        let (info, heights) = read(sample(false, " 4")).unwrap();
        assert_eq!((info.width, info.height), (2, 3));
        assert_eq!(info.crs.as_deref(), Some("EPSG:26910"));
        assert_eq!(info.transform.unwrap().origin, [500000.0, 5100060.0]);
        assert_eq!((heights[0], heights[1], heights[4]), (40.0, 9.5, 20.0));
        assert!(heights[2].is_nan() && heights[3].is_nan() && heights[5].is_nan());
    }

    #[test]
    fn feet_become_metres_and_a_missing_datum_is_nad27() {
        let (info, heights) = read(sample(true, "  ")).unwrap();
        assert_eq!(info.crs.as_deref(), Some("EPSG:26710"));
        assert_eq!(heights[0], (40.0 * 0.3048) as f32);
    }

    #[test]
    fn line_ends_and_trimmed_records_change_nothing() {
        let bytes = sample(false, " 3");
        let lines =
            bytes.chunks(1024).map(|line| String::from_utf8_lossy(line).trim_end().to_owned());
        let text = lines.collect::<Vec<_>>().join("\r\n");
        let bits = |heights: Vec<f32>| heights.into_iter().map(f32::to_bits).collect::<Vec<_>>();
        assert_eq!(bits(read(text.into_bytes()).unwrap().1), bits(read(bytes).unwrap().1));
    }

    #[test]
    fn every_truncation_is_an_error() {
        let bytes = sample(false, " 3");
        assert!(is_dem(&bytes));
        let end = String::from_utf8(bytes.clone()).unwrap().trim_end().len();
        for cut in 0..end - 1 {
            assert!(read(bytes[..cut].to_vec()).is_err(), "{cut}");
        }
    }

    proptest! {
        #[test]
        fn damaged_characters_give_a_grid_or_an_error(
            changes in proptest::collection::vec((0usize..3072, any::<u8>()), 1..8)
        ) {
            let mut bytes = sample(false, " 3");
            for (at, byte) in changes {
                bytes[at] = byte;
            }
            let _ = read(bytes);
        }
    }
}
