//! Pictures that are read: PNG files, alone or numbered in a folder.

use anyhow::{Context, anyhow, bail};
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::BufReader;
use std::path::{Path, PathBuf};
use terrafarm_common::compare::Rgb16;

/// The largest picture, pixels: a comparison takes about 40 bytes for each.
const PIXELS_MAX: u64 = 64 << 20;
/// Most memory that the decoder may take for what is not pixels, bytes.
const DECODER_BYTES_MAX: usize = 1 << 30;

/// Reads a PNG of any kind but with transparent pixels.
pub fn read(path: &Path) -> anyhow::Result<Rgb16> {
    let file = File::open(path).with_context(|| format!("cannot read {}", path.display()))?;
    decode(file).with_context(|| format!("{} cannot be compared", path.display()))
}

fn decode(file: File) -> anyhow::Result<Rgb16> {
    let limits = png::Limits { bytes: DECODER_BYTES_MAX };
    let mut decoder = png::Decoder::new_with_limits(BufReader::new(file), limits);
    decoder.set_transformations(png::Transformations::EXPAND);
    let mut reader = decoder.read_info().context("it is no PNG picture")?;
    let (width, height) = reader.info().size();
    if u64::from(width) * u64::from(height) > PIXELS_MAX {
        bail!("{width} x {height} pixels are more than {} million", PIXELS_MAX >> 20);
    }
    let (color, depth) = reader.output_color_type();
    let bytes = reader.output_buffer_size().ok_or_else(|| anyhow!("it is too large"))?;
    let mut buffer = vec![0; bytes];
    let info = reader.next_frame(&mut buffer).context("it is damaged")?;
    buffer.truncate(info.buffer_size());
    let values: Vec<u16> = match depth {
        png::BitDepth::Sixteen => {
            buffer.chunks_exact(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect()
        }
        _ => buffer.iter().map(|byte| u16::from(*byte) * 257).collect(),
    };
    let (channels, grey, alpha) = match color {
        png::ColorType::Grayscale => (1, true, false),
        png::ColorType::GrayscaleAlpha => (2, true, true),
        png::ColorType::Rgb | png::ColorType::Indexed => (3, false, false),
        png::ColorType::Rgba => (4, false, true),
    };
    if alpha && values.chunks_exact(channels).any(|pixel| pixel[channels - 1] != u16::MAX) {
        bail!("it has transparent pixels; put it on a background first");
    }
    let rgb = |pixel: &[u16]| {
        if grey { [pixel[0]; 3] } else { [pixel[0], pixel[1], pixel[2]] }
    };
    let values = values.chunks_exact(channels).flat_map(rgb).collect();
    Rgb16::from_values(width, height, values).ok_or_else(|| anyhow!("it has no pixels"))
}

/// The folder of a sequence, if a path is one: a folder, or the manifest in it.
pub fn sequence(path: &Path) -> Option<&Path> {
    if path.is_dir() {
        return Some(path);
    }
    let folder = path.parent().unwrap_or(Path::new(""));
    let is_manifest = path.file_name().is_some_and(|name| name == "manifest.json");
    is_manifest.then_some(if folder.as_os_str().is_empty() { Path::new(".") } else { folder })
}

/// The numbered PNG pictures of a folder, by the last number of their names.
pub fn numbered(folder: &Path) -> anyhow::Result<BTreeMap<u64, PathBuf>> {
    let cannot = || format!("cannot read the folder {}", folder.display());
    let mut pictures = BTreeMap::new();
    for entry in fs::read_dir(folder).with_context(cannot)? {
        let path = entry.with_context(cannot)?.path();
        let is_png = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("png"));
        let number = path.file_stem().and_then(|stem| stem.to_str()).and_then(last_number);
        let (true, Some(number)) = (is_png, number) else { continue };
        if let Some(other) = pictures.insert(number, path.clone()) {
            let (one, other) = (path.display(), other.display());
            bail!("{one} and {other} have the same number; keep one sequence in a folder");
        }
    }
    if pictures.is_empty() {
        bail!("there is no numbered PNG picture in {}, such as frame_00001.png", folder.display());
    }
    Ok(pictures)
}

fn last_number(stem: &str) -> Option<u64> {
    let end = stem.rfind(|c: char| c.is_ascii_digit())? + 1;
    let start = stem[..end]
        .rfind(|c: char| !c.is_ascii_digit())
        .map_or(0, |at| at + stem[at..].chars().next().map_or(1, char::len_utf8));
    stem[start..end].parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_number_of_a_name_counts() {
        assert_eq!(last_number("frame_00012"), Some(12));
        assert_eq!(last_number("shot3_é007_b"), Some(7));
        assert_eq!(last_number("42"), Some(42));
        assert_eq!(last_number("poster"), None);
        assert_eq!(last_number("99999999999999999999999"), None);
    }
}
