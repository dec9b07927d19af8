//! What the tests share: a TIFF writer, windows, and GDAL as a second opinion.

use std::path::{Path, PathBuf};
use std::process::Command;
use terrafarm_raster::{Content, OpenOptions, Raster, RasterError, Sidecars, Source, Window};

pub fn heights_wanted() -> OpenOptions {
    OpenOptions { content: Some(Content::Heights), ..Default::default() }
}

pub fn photo_wanted() -> OpenOptions {
    OpenOptions { content: Some(Content::Photo), ..Default::default() }
}

pub fn memory(name: &str, bytes: Vec<u8>) -> Source {
    Source::from_bytes(name, bytes, Sidecars::default())
}

fn whole(raster: &dyn Raster) -> Window {
    let info = raster.info();
    Window { column: 0, row: 0, width: info.width as usize, height: info.height as usize }
}

/// All heights, read in windows of odd sizes so that block borders are crossed.
pub fn all_heights(raster: &dyn Raster) -> Result<Vec<f32>, RasterError> {
    let Window { width, height, .. } = whole(raster);
    let mut heights = vec![0.0; width * height];
    for row in (0..height).step_by(37) {
        for column in (0..width).step_by(101) {
            let size = [101.min(width - column), 37.min(height - row)];
            let window =
                Window { column: column as u64, row: row as u64, width: size[0], height: size[1] };
            let mut part = vec![0.0; size[0] * size[1]];
            raster.read_heights(window, &mut part)?;
            for (k, line) in part.chunks(size[0]).enumerate() {
                let at = (row + k) * width + column;
                heights[at..at + size[0]].copy_from_slice(line);
            }
        }
    }
    Ok(heights)
}

pub fn all_colors(raster: &dyn Raster) -> Result<Vec<[u8; 4]>, RasterError> {
    let window = whole(raster);
    let mut colors = vec![[0; 4]; window.width * window.height];
    raster.read_colors(window, &mut colors)?;
    Ok(colors)
}

/// Whether GDAL's programs are there; says that the test skips if not.
pub fn gdal() -> bool {
    let found = Command::new("gdal_translate").arg("--version").output().is_ok();
    if !found {
        println!("skipped: gdal_translate is not on the PATH");
    }
    found
}

/// Runs one of GDAL's programs; `false` if it refuses (a driver or codec is missing).
pub fn run(program: &str, arguments: &[&str]) -> bool {
    let output = Command::new(program).args(arguments).output().unwrap();
    if !output.status.success() {
        println!("{program} {arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    }
    output.status.success()
}

/// The samples of a file as GDAL reads them, band after band.
pub fn gdal_samples(file: &str, folder: &Path) -> Vec<f64> {
    let raw = folder.join("reference.bin");
    let arguments = ["-q", "-of", "ENVI", "-ot", "Float64", "-co", "INTERLEAVE=BSQ", file];
    assert!(run("gdal_translate", &[&arguments[..], &[raw.to_str().unwrap()]].concat()));
    let bytes = std::fs::read(&raw).unwrap();
    bytes.as_chunks::<8>().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect()
}

/// Asserts that heights are bit for bit those expected; NaN equals NaN.
#[track_caller]
pub fn assert_heights(found: &[f32], expected: impl IntoIterator<Item = f64>, what: &str) {
    let expected: Vec<f32> = expected.into_iter().map(|value| value as f32).collect();
    assert_eq!(found.len(), expected.len(), "{what}");
    for (k, (found, expected)) in found.iter().zip(&expected).enumerate() {
        let same = found == expected || found.is_nan() && expected.is_nan();
        assert!(same, "{what}: sample {k} is {found}, expected {expected}");
    }
}

/// The folder of real data beside the repository, or `None` and a word about skipping.
pub fn shared_data() -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../../shared/data");
    if !folder.is_dir() {
        println!("skipped: there is no ../shared/data beside the repository");
        return None;
    }
    Some(folder)
}

/// How the TIFF writer stores a picture of one band of 16-bit or float samples.
#[derive(Debug, Clone, Copy)]
pub struct TiffVariant {
    pub big_endian: bool,
    pub big_tiff: bool,
    pub tiled: bool,
    /// 1, 5, 8 or 32773.
    pub compression: u16,
    pub floats: bool,
}

/// A small TIFF of 20 x 10 samples, value = column + 100 row, with a place on the map.
pub fn tiny_tiff(variant: TiffVariant) -> Vec<u8> {
    let number = |value: u64, size: usize| {
        let bytes = value.to_le_bytes()[..size].to_vec();
        if variant.big_endian { bytes.into_iter().rev().collect() } else { bytes }
    };
    let sample = |column: u64, row: u64| match (column < 20 && row < 10, variant.floats) {
        (false, _) => vec![0; if variant.floats { 4 } else { 2 }],
        (true, true) => number(u64::from(((column + 100 * row) as f32).to_bits()), 4),
        (true, false) => number(column + 100 * row, 2),
    };
    let blocks: Vec<(u64, u64)> =
        if variant.tiled { vec![(0, 0), (16, 0)] } else { vec![(0, 0), (0, 4), (0, 8)] };
    let [width, height] = if variant.tiled { [16, 16] } else { [20, 4] };
    let blocks = blocks.into_iter().map(|(left, top)| {
        let rows = if variant.tiled { height } else { height.min(10 - top) };
        let places = (top..top + rows).flat_map(|row| (left..left + width).map(move |c| (c, row)));
        compress(
            variant.compression,
            places.flat_map(|(column, row)| sample(column, row)).collect(),
        )
    });
    let word = if variant.big_tiff { 8 } else { 4 };
    let mut file = if variant.big_endian { b"MM".to_vec() } else { b"II".to_vec() };
    file.extend(number(if variant.big_tiff { 43 } else { 42 }, 2));
    if variant.big_tiff {
        file.extend([number(8, 2), number(0, 2)].concat());
    }
    let first_directory = file.len();
    file.extend(vec![0; word]);
    let (mut offsets, mut lengths) = (Vec::new(), Vec::new());
    for block in blocks {
        offsets.push(file.len() as u64);
        lengths.push(block.len() as u64);
        file.extend(block);
    }
    let bits = if variant.floats { 32 } else { 16 };
    let doubles = |values: &[f64]| values.iter().map(|v| v.to_bits()).collect::<Vec<u64>>();
    let (chunk, format) =
        (if variant.tiled { [322, 323] } else { [278, 278] }, if variant.floats { 3 } else { 1 });
    let mut tags: Vec<(u16, u16, Vec<u64>)> = vec![
        (256, 3, vec![20]),
        (257, 3, vec![10]),
        (258, 3, vec![bits]),
        (259, 3, vec![u64::from(variant.compression)]),
        (262, 3, vec![1]),
        (chunk[1], 3, vec![height]),
        (if variant.tiled { 324 } else { 273 }, 4, offsets),
        (if variant.tiled { 325 } else { 279 }, 4, lengths),
        (339, 3, vec![format]),
        (33550, 12, doubles(&[30.0, 30.0, 0.0])),
        (33922, 12, doubles(&[0.0, 0.0, 0.0, 500_000.0, 4_000_000.0, 0.0])),
        (34735, 3, vec![1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, 32612]),
        (42113, 2, "105\0".bytes().map(u64::from).collect()),
    ];
    if variant.tiled {
        tags.push((322, 3, vec![width]));
    }
    tags.sort();
    let size = |kind: u16| match kind {
        2 => 1,
        3 => 2,
        4 => 4,
        _ => 8,
    };
    let mut entries = Vec::new();
    for (tag, kind, values) in &tags {
        let mut bytes: Vec<u8> =
            values.iter().flat_map(|value| number(*value, size(*kind))).collect();
        if bytes.len() > word {
            let at = file.len() as u64;
            file.extend(bytes);
            bytes = number(at, word);
        }
        bytes.resize(word, 0);
        let head = [
            number(u64::from(*tag), 2),
            number(u64::from(*kind), 2),
            number(values.len() as u64, word),
        ];
        entries.extend([head.concat(), bytes].concat());
    }
    let at = number(file.len() as u64, word);
    file[first_directory..first_directory + word].copy_from_slice(&at);
    file.extend(number(tags.len() as u64, if variant.big_tiff { 8 } else { 2 }));
    file.extend(entries);
    file.extend(vec![0; word]);
    file
}

fn compress(code: u16, bytes: Vec<u8>) -> Vec<u8> {
    use std::io::Write;
    match code {
        5 => weezl::encode::Encoder::with_tiff_size_switch(weezl::BitOrder::Msb, 8)
            .encode(&bytes)
            .unwrap(),
        8 => {
            let mut encoder =
                flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
            encoder.write_all(&bytes).unwrap();
            encoder.finish().unwrap()
        }
        32773 => {
            let literal = |run: &[u8]| [&[(run.len() - 1) as u8], run].concat();
            bytes.chunks(100).flat_map(literal).collect()
        }
        _ => bytes,
    }
}

/// All variants of the writer.
pub fn tiff_variants() -> Vec<TiffVariant> {
    let mut variants = Vec::new();
    for bits in 0..16 {
        for compression in [1, 5, 8, 32773] {
            variants.push(TiffVariant {
                big_endian: bits & 1 > 0,
                big_tiff: bits & 2 > 0,
                tiled: bits & 4 > 0,
                compression,
                floats: bits & 8 > 0,
            });
        }
    }
    variants
}

/// A grey JPEG of 16 x 16 pixels whose only codes are "as before" and "end of block", one
/// zero bit each. `sampling` is that of the first component: 0x11, or 0x22 to halve the
/// others.
pub fn tiny_jpeg(components: u8, sampling: u8) -> Vec<u8> {
    let mut bytes = vec![0xff, 0xd8];
    let mut segment = |marker: u8, content: &[u8]| {
        bytes.extend([0xff, marker]);
        bytes.extend((content.len() as u16 + 2).to_be_bytes());
        bytes.extend(content);
    };
    segment(0xdb, &[&[0], &[1; 64][..]].concat());
    let frame = (1..=components).flat_map(|id| [id, if id == 1 { sampling } else { 0x11 }, 0]);
    let size = [8, 0, 16, 0, 16, components];
    segment(0xc0, &size.into_iter().chain(frame).collect::<Vec<u8>>());
    for table in [0x00, 0x10] {
        let mut lengths = [0; 16];
        lengths[0] = 1;
        segment(0xc4, &[&[table][..], &lengths, &[0]].concat());
    }
    let scan = (1..=components).flat_map(|id| [id, 0]).chain([0, 63, 0]);
    segment(0xda, &[components].into_iter().chain(scan).collect::<Vec<u8>>());
    let blocks = if sampling == 0x22 { 6 } else { 4 * usize::from(components) };
    bytes.extend(vec![0; blocks / 4]);
    if blocks % 4 != 0 {
        bytes.push(0xff >> (2 * (blocks % 4)));
    }
    bytes.extend([0xff, 0xd9]);
    bytes
}
