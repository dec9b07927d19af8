//! SRTM tiles: `.hgt` and `.hgt.zip`.
//!
//! A square of big-endian 16-bit metres, -32768 for no data, that covers one degree. Its
//! outer samples lie on the whole degrees, so that neighbours share a row or column. The
//! name of the file gives the south-west corner and nothing in it does; size tells 3" (1201)
//! from 1" (3601). A zipped tile is unpacked into memory (3 or 26 MB).

use crate::blocks::{check_window, wrong_content};
use crate::info::{Content, GeoTransform, Raster, RasterError, RasterInfo, Vertical, Window};
use crate::limits::{MAX_WHOLE_FILE_BYTES, MAX_ZIP_ENTRIES};
use crate::options::{HeightUnit, OpenOptions};
use crate::source::{Sidecars, Source};
use std::io::{Cursor, Read};
use std::path::Path;

/// Posts along a side that a tile may have.
const SIDES: [u64; 2] = [1201, 3601];
/// Length of the largest tile, bytes.
const MAX_TILE_BYTES: u64 = 2 * SIDES[1] * SIDES[1];

struct Hgt {
    source: Source,
    info: RasterInfo,
    metres: f32,
}

/// Opens a tile; its name must tell the corner.
///
/// # Errors
/// If the name or the size is not that of a tile.
pub fn open(source: Source, options: &OpenOptions) -> Result<Box<dyn Raster>, RasterError> {
    let path = source.path();
    if options.content == Some(Content::Photo) {
        return Err(RasterError::unsupported(path, "an SRTM tile holds heights, not a photo"));
    }
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let Some([west, south]) = corner(name) else {
        let what = "the name does not give the south-west corner of the tile; rename it like \
                    N34W121.hgt";
        return Err(RasterError::damaged(path, what));
    };
    let Some(side) = SIDES.into_iter().find(|side| 2 * side * side == source.length()) else {
        let what = format!(
            "the tile has {} bytes; an SRTM tile has 2884802 (1201 x 1201 posts) or 25934402 \
             (3601 x 3601 posts): fetch it again",
            source.length()
        );
        return Err(RasterError::damaged(path, what));
    };
    let step = 1.0 / (side - 1) as f64;
    let metres = options.unit.unwrap_or(HeightUnit::Metre).metres();
    let info = RasterInfo {
        path: path.to_owned(),
        format: format!("SRTM, int16, {} posts per degree", side - 1),
        width: side,
        height: side,
        transform: Some(GeoTransform {
            origin: [west, south + 1.0],
            step_column: [step, 0.0],
            step_row: [0.0, -step],
        }),
        crs: Some("EPSG:4326".into()),
        vertical: Vertical::Geoid,
        content: Content::Heights,
        quantum_m: Some(metres),
        warnings: Vec::new(),
    };
    Ok(Box::new(Hgt { source, info, metres: metres as f32 }))
}

/// Opens a zipped tile: the first `.hgt` in the archive, under its own name.
///
/// # Errors
/// If the archive is damaged, holds no tile, or unpacks to more than a tile.
pub fn open_zip(source: Source, options: &OpenOptions) -> Result<Box<dyn Raster>, RasterError> {
    let path = source.path().to_owned();
    let damaged = |what: String| RasterError::damaged(&path, what);
    // Nothing in the archive may be much longer than what it unpacks to.
    let bytes = source.whole(MAX_WHOLE_FILE_BYTES.min(4 * MAX_TILE_BYTES))?;
    let mut archive = zip::ZipArchive::new(Cursor::new(bytes))
        .map_err(|error| damaged(format!("the zip archive cannot be read: {error}")))?;
    let tile = (0..archive.len().min(MAX_ZIP_ENTRIES)).find_map(|index| {
        let name = archive.name_for_index(index)?.ok()?.into_owned();
        let file = name.rsplit(['/', '\\']).next()?.to_owned();
        file.to_ascii_lowercase().ends_with(".hgt").then_some((index, file))
    });
    let Some((index, inner)) = tile else {
        let what = "the zip archive holds no .hgt file; unpack it and name the raster in it";
        return Err(RasterError::unsupported(&path, what));
    };
    let entry = archive
        .by_index(index)
        .map_err(|error| damaged(format!("{inner} in the archive cannot be read: {error}")))?;
    if entry.size() > MAX_TILE_BYTES {
        let what = format!("{inner} unpacks to {} bytes; no SRTM tile is that long", entry.size());
        return Err(damaged(what));
    }
    let mut tile = Vec::new();
    entry
        .take(MAX_TILE_BYTES + 1)
        .read_to_end(&mut tile)
        .map_err(|error| damaged(format!("{inner} in the archive cannot be unpacked: {error}")))?;
    let outer = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let name = if corner(&inner).is_some() { Path::new(&inner) } else { Path::new(outer) };
    let unpacked = Source::from_bytes(path.with_file_name(name), tile, Sidecars::default());
    open(unpacked, options).map_err(|error| match error {
        RasterError::Damaged { what, .. } => damaged(format!("{inner} in the archive: {what}")),
        other => other,
    })
}

/// Longitude and latitude of the south-west corner from a name that begins like N34W121.
fn corner(name: &str) -> Option<[f64; 2]> {
    let name = name.as_bytes().get(..7)?;
    let number = |digits: &[u8]| {
        digits.iter().try_fold(0, |value, digit| {
            digit.is_ascii_digit().then(|| value * 10 + i32::from(digit - b'0'))
        })
    };
    let south = match name[0].to_ascii_uppercase() {
        b'N' => number(&name[1..3])?,
        b'S' => -number(&name[1..3])?,
        _ => return None,
    };
    let west = match name[3].to_ascii_uppercase() {
        b'E' => number(&name[4..7])?,
        b'W' => -number(&name[4..7])?,
        _ => return None,
    };
    ((-90..90).contains(&south) && (-180..180).contains(&west))
        .then(|| [f64::from(west), f64::from(south)])
}

impl Raster for Hgt {
    fn info(&self) -> &RasterInfo {
        &self.info
    }

    fn read_heights(&self, window: Window, into: &mut [f32]) -> Result<(), RasterError> {
        check_window(&self.info, window, into.len())?;
        let mut bytes = vec![0; 2 * window.width];
        for (row, posts) in (window.row..).zip(into.chunks_exact_mut(window.width.max(1))) {
            self.source.read_at(2 * (row * self.info.width + window.column), &mut bytes)?;
            for (post, bytes) in posts.iter_mut().zip(bytes.as_chunks::<2>().0) {
                *post = match i16::from_be_bytes(*bytes) {
                    i16::MIN => f32::NAN,
                    height => f32::from(height) * self.metres,
                };
            }
        }
        Ok(())
    }

    fn read_colors(&self, _: Window, _: &mut [[u8; 4]]) -> Result<(), RasterError> {
        Err(wrong_content(&self.info, "colours"))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::io::Write;

    fn tile() -> Vec<u8> {
        (0..1201u32 * 1201).flat_map(|k| (k as i16).to_be_bytes()).collect()
    }

    fn zipped(name: &str, bytes: &[u8]) -> Vec<u8> {
        let mut writer = zip::ZipWriter::new(Cursor::new(Vec::new()));
        let options = zip::write::SimpleFileOptions::default();
        writer.start_file("readme.txt", options).unwrap();
        writer.start_file(name, options).unwrap();
        writer.write_all(bytes).unwrap();
        writer.finish().unwrap().into_inner()
    }

    fn memory(name: &str, bytes: Vec<u8>) -> Source {
        Source::from_bytes(name, bytes, Sidecars::default())
    }

    #[test]
    fn the_name_gives_the_corner_in_any_case() {
        assert_eq!(corner("n34w121.hgt"), Some([-121.0, 34.0]));
        assert_eq!(corner("S07E110.SRTMGL1.hgt"), Some([110.0, -7.0]));
        for wrong in ["", "N34", "X34W121", "N3aW121", "N95W121", "N34W200", "N34é121.hgt"] {
            assert_eq!(corner(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn posts_lie_on_the_degree_grid_and_the_lowest_value_is_void() {
        let raster = open(memory("n34w121.hgt", tile()), &OpenOptions::default()).unwrap();
        let transform = raster.info().transform.unwrap();
        assert_eq!(transform.origin, [-121.0, 35.0]);
        assert_eq!(transform.step_row, [0.0, -1.0 / 1200.0]);
        let mut row = [0.0; 3];
        // 32768 = 27 * 1201 + 341.
        let window = Window { column: 340, row: 27, width: 3, height: 1 };
        raster.read_heights(window, &mut row).unwrap();
        assert_eq!((row[0], row[2]), (32767.0, -32767.0));
        assert!(row[1].is_nan());
    }

    #[test]
    fn a_zipped_tile_is_the_tile() {
        let bytes = zipped("inner/S07E110.hgt", &tile());
        let raster = open_zip(memory("anything.zip", bytes), &OpenOptions::default()).unwrap();
        assert_eq!(raster.info().transform.unwrap().origin, [110.0, -6.0]);
        let mut row = [0.0; 2];
        let window = Window { column: 5, row: 0, width: 2, height: 1 };
        raster.read_heights(window, &mut row).unwrap();
        assert_eq!(row, [5.0, 6.0]);
    }

    #[test]
    fn a_wrong_size_names_the_sizes_that_are_allowed() {
        let refused = |source| open(source, &OpenOptions::default()).err().unwrap().to_string();
        let text = refused(memory("N34W121.hgt", vec![0; 100]));
        assert!(text.contains("2884802") && text.contains("25934402"), "{text}");
        assert!(refused(memory("tile.hgt", tile())).contains("N34W121.hgt"));
    }

    #[test]
    fn a_zip_bomb_is_refused_before_it_is_unpacked() {
        let bytes = zipped("N34W121.hgt", &vec![0; 30 << 20]);
        assert!(bytes.len() < 100_000);
        let error = open_zip(memory("bomb.zip", bytes), &OpenOptions::default()).err().unwrap();
        assert!(error.to_string().contains("unpacks to"), "{error}");
    }

    #[test]
    fn damaged_archives_are_errors() {
        let bytes = zipped("N34W121.hgt", &[7; 5000]);
        for cut in 0..bytes.len() {
            let source = memory("a.zip", bytes[..cut].to_vec());
            assert!(open_zip(source, &OpenOptions::default()).is_err());
        }
    }
}
