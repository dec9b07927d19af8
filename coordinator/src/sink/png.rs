//! PNG files: one, or one a frame.

use super::beside::Beside;
use super::{Arrivals, Finished, FrameSink, SinkError, Spec, ends_with_separator};
use std::path::{Path, PathBuf};
use terrafarm_common::id::FrameIndex;
use terrafarm_common::image::Rgb8;

/// Name of the frames in a folder.
const IN_A_FOLDER: &str = "frame_%05d.png";
/// More digits than any frame index has are a mistake.
const MAX_DIGITS: usize = 20;

/// A numbered sequence, or a single picture.
pub(super) struct Sequence {
    names: Names,
    output: PathBuf,
    first: FrameIndex,
    arrivals: Arrivals,
    bytes: u64,
}

impl Sequence {
    pub fn open(output: &Path, spec: Spec) -> Result<Box<dyn FrameSink>, SinkError> {
        let names = Names::of(output, spec.frames)?;
        let example = names.path(0);
        let folder = example.parent().unwrap_or(Path::new("."));
        let output = match &names {
            Names::One(path) => path.clone(),
            Names::Numbered { .. } => folder.to_path_buf(),
        };
        let first = spec.first;
        Ok(Box::new(Sequence { names, output, first, arrivals: Arrivals::new(spec), bytes: 0 }))
    }
}

impl FrameSink for Sequence {
    fn put(&mut self, frame: FrameIndex, picture: &Rgb8) -> Result<(), SinkError> {
        self.arrivals.admit(frame, picture)?;
        self.bytes += save(&self.names.path(self.first.saturating_add(frame)), picture)?;
        Ok(())
    }

    fn finish(self: Box<Self>) -> Result<Finished, SinkError> {
        self.arrivals.all_here(&self.output)?;
        Ok(Finished { output: self.output, frames: self.arrivals.next, bytes: self.bytes })
    }
}

/// Writes one picture, whole or not at all, over what may be there; returns its size in
/// bytes. Compressed fast: the slower levels take twenty times as long to save a third.
pub(super) fn save(path: &Path, picture: &Rgb8) -> Result<u64, SinkError> {
    let mut file = Beside::create(path)?;
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, picture.width(), picture.height());
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
    let written = encoder.write_header().and_then(|mut writer| {
        writer.write_image_data(picture.pixels())?;
        writer.finish()
    });
    written.map_err(|error| SinkError::Encoder { encoder: "PNG", why: error.to_string() })?;
    file.write(&bytes)?;
    file.commit()
}

/// How the files are called.
enum Names {
    One(PathBuf),
    Numbered { folder: PathBuf, before: String, digits: usize, after: String },
}

impl Names {
    fn of(output: &Path, frames: u32) -> Result<Self, SinkError> {
        if output.is_dir() || ends_with_separator(output) || output.extension().is_none() {
            return Self::numbered(output.to_path_buf(), IN_A_FOLDER, output);
        }
        let name = output.file_name().and_then(|name| name.to_str());
        let name = name.ok_or_else(|| SinkError::output(output, "its name is not Unicode"))?;
        if name.contains('%') {
            let folder = output.parent().unwrap_or(Path::new("")).to_path_buf();
            return Self::numbered(folder, name, output);
        }
        if frames == 1 {
            return Ok(Names::One(output.to_path_buf()));
        }
        let stem = name.trim_end_matches(".png").trim_end_matches(".PNG");
        Err(SinkError::output(
            output,
            format!("{frames} frames do not fit one picture; number them: {stem}_%05d.png"),
        ))
    }

    /// Reads `%d` or `%05d`; `%%` is a percent sign.
    fn numbered(folder: PathBuf, pattern: &str, output: &Path) -> Result<Self, SinkError> {
        let wrong = |why: &str| Err(SinkError::output(output, format!("{why}; use name_%05d.png")));
        let mut texts = [String::new(), String::new()];
        let mut digits = None;
        let mut rest = pattern;
        while let Some((text, tail)) = rest.split_once('%') {
            let side = usize::from(digits.is_some());
            texts[side].push_str(text);
            if let Some(tail) = tail.strip_prefix('%') {
                texts[side].push('%');
                rest = tail;
                continue;
            }
            let Some((width, tail)) = tail.split_once('d') else {
                return wrong("its pattern has a \"%\" that no \"d\" ends");
            };
            let width = if width.is_empty() { Ok(0) } else { width.parse::<usize>() };
            match (width, digits) {
                (Ok(width), None) if width <= MAX_DIGITS => digits = Some(width),
                (Ok(_), Some(_)) => return wrong("its pattern has two numbers"),
                _ => return wrong("its pattern is not like %05d"),
            }
            rest = tail;
        }
        texts[usize::from(digits.is_some())].push_str(rest);
        let Some(digits) = digits else { return wrong("its pattern has no number") };
        let [before, after] = texts;
        Ok(Names::Numbered { folder, before, digits, after })
    }

    fn path(&self, frame: FrameIndex) -> PathBuf {
        match self {
            Names::One(path) => path.clone(),
            Names::Numbered { folder, before, digits, after } => {
                folder.join(format!("{before}{frame:0digits$}{after}"))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name_of(pattern: &str, frame: FrameIndex) -> Result<String, String> {
        match Names::of(Path::new(pattern), 9) {
            Ok(names) => Ok(names.path(frame).display().to_string().replace('\\', "/")),
            Err(error) => Err(error.to_string()),
        }
    }

    #[test]
    fn patterns_become_names() {
        for (pattern, frame, name) in [
            ("no/such/folder/", 7, "no/such/folder/frame_00007.png"),
            ("no-such-folder", 123_456, "no-such-folder/frame_123456.png"),
            ("no-such/a%03d.png", 5, "no-such/a005.png"),
            ("a%d.png", 12, "a12.png"),
            ("100%%_%02d_b.png", 3, "100%_03_b.png"),
        ] {
            assert_eq!(name_of(pattern, frame).as_deref(), Ok(name));
        }
    }

    #[test]
    fn wrong_patterns_say_what_to_write() {
        for pattern in ["a%x.png", "a%.png", "a%99d.png", "a%d_%d.png", "a%%.png", "a%-3d.png"] {
            assert!(name_of(pattern, 0).is_err_and(|e| e.contains("name_%05d.png")), "{pattern}");
        }
        assert!(name_of("film.png", 0).is_err_and(|e| e.contains("film_%05d.png")));
    }
}
