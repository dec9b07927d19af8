//! Where finished frames go: pictures, raw video, compressed video, a manifest.
//!
//! [`open`] chooses by the path. Frames arrive in order, once each. Every output appears
//! whole or not at all: it is written beside its place, synced and renamed; what a failed
//! or dropped sink leaves is at most the pictures of a sequence that were complete.
//!
//! | output | what is written |
//! |---|---|
//! | `folder/`, a folder that exists, `name_%05d.png` | one PNG a frame; frames count from 0 |
//! | `name.png` | one PNG, for a shot of one frame |
//! | `name.y4m` | raw video, 4:4:4, BT.709, limited range |
//! | `name.mp4` | H.264, by the built-in encoder or by ffmpeg |
//! | `name.mov`, `name.mkv`, `name.webm` | by ffmpeg only |

mod beside;
mod colour;
mod ffmpeg;
pub(crate) mod h264;
pub mod manifest;
mod mp4;
mod png;
pub mod poster;
mod rate;
mod sps;
mod video;
mod y4m;

use sha2::{Digest, Sha256};
use std::io;
use std::path::{Path, PathBuf};
use terrafarm_common::camera::MAX_SIDE_PX;
use terrafarm_common::id::{BlobHash, FrameIndex};
use terrafarm_common::image::Rgb8;

/// Takes the finished frames of one shot. Calls block while the sink is busy: that is the
/// back-pressure of a batch, so call them off the async threads.
pub trait FrameSink: Send {
    /// Takes the next frame. Frames come in order from 0, each once.
    fn put(&mut self, frame: FrameIndex, picture: &Rgb8) -> Result<(), SinkError>;

    /// Completes the output and gives it its name. Fails if frames are missing.
    fn finish(self: Box<Self>) -> Result<Finished, SinkError>;
}

/// What a sink has written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finished {
    /// The file, or the folder of a sequence.
    pub output: PathBuf,
    /// Number of frames in it.
    pub frames: u32,
    /// Size of all of it, bytes.
    pub bytes: u64,
}

/// What is going to be written.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spec {
    /// Width of every frame, pixels.
    pub width: u32,
    /// Height of every frame, pixels.
    pub height: u32,
    /// Frames per second; pictures ignore it.
    pub fps: f64,
    /// Number that the first picture of a sequence gets: a part of a flight keeps the
    /// numbers of the whole. Videos ignore it.
    pub first: FrameIndex,
    /// Number of frames.
    pub frames: u32,
}

/// Who compresses video.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Encoder {
    /// H.264 inside this program: needs nothing installed.
    #[default]
    BuiltIn,
    /// The program `ffmpeg`, found on the path.
    Ffmpeg,
}

/// Why an output could not be written.
#[derive(Debug, thiserror::Error)]
pub enum SinkError {
    /// The path names nothing that can be written, or not this shot.
    #[error("cannot write {}: {why}", path.display())]
    Output {
        /// What was asked for.
        path: PathBuf,
        /// Why not, and what to do.
        why: String,
    },
    /// The disk is full, or the user's share of it.
    #[error("no space left for {}; free some space, or choose another place with -o", path.display())]
    DiskFull {
        /// The file that was being written.
        path: PathBuf,
    },
    /// The file system said no.
    #[error("cannot {what} {}: {source}", path.display())]
    Io {
        /// What was tried.
        what: &'static str,
        /// On which file.
        path: PathBuf,
        /// What the system answered.
        source: io::Error,
    },
    /// A frame came out of order, or of another size: a mistake of the caller.
    #[error("frame {frame} does not belong here: {why}")]
    Frame {
        /// Which one.
        frame: FrameIndex,
        /// What was expected.
        why: String,
    },
    /// The shot ended early.
    #[error("only {got} of {frames} frames arrived, so {} was not written", path.display())]
    Missing {
        /// Frames that came.
        got: u32,
        /// Frames that were promised.
        frames: u32,
        /// The output.
        path: PathBuf,
    },
    /// The encoder failed.
    #[error("the {encoder} encoder failed: {why}")]
    Encoder {
        /// Which encoder.
        encoder: &'static str,
        /// What it said, and what to do.
        why: String,
    },
}

impl SinkError {
    /// An error of the file system on a path; a full disk has a message of its own.
    fn io(what: &'static str, path: &Path, source: io::Error) -> Self {
        let path = path.to_path_buf();
        match source.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
                SinkError::DiskFull { path }
            }
            _ => SinkError::Io { what, path, source },
        }
    }

    fn output(path: &Path, why: impl Into<String>) -> Self {
        SinkError::Output { path: path.to_path_buf(), why: why.into() }
    }
}

/// Opens the sink that the path asks for; see the table above. Folders that lead to it
/// are made.
pub fn open(output: &Path, spec: Spec, encoder: Encoder) -> Result<Box<dyn FrameSink>, SinkError> {
    let sides = 1..=MAX_SIDE_PX;
    if !sides.contains(&spec.width) || !sides.contains(&spec.height) || spec.frames == 0 {
        let why = format!(
            "{} frames of {} x {} pixels cannot be; at least one frame, sides of 1 to {MAX_SIDE_PX}",
            spec.frames, spec.width, spec.height
        );
        return Err(SinkError::output(output, why));
    }
    let ending = output.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
    let is_folder = output.is_dir() || ends_with_separator(output);
    match (ending.as_deref(), encoder) {
        _ if is_folder => png::Sequence::open(output, spec),
        (None | Some("png"), _) => png::Sequence::open(output, spec),
        (Some("y4m"), _) => y4m::Y4m::open(output, spec),
        (Some("mp4"), Encoder::BuiltIn) => video::Mp4Sink::open(output, spec),
        (Some("mp4" | "mov" | "mkv" | "webm"), Encoder::Ffmpeg) => {
            ffmpeg::Ffmpeg::open(output, spec)
        }
        (Some("mov" | "mkv" | "webm"), Encoder::BuiltIn) => Err(SinkError::output(
            output,
            "the built-in encoder writes .mp4; choose that, or ffmpeg with --encoder ffmpeg",
        )),
        (Some(other), _) => Err(SinkError::output(
            output,
            format!(
                "\".{other}\" is no known ending; use name_%05d.png, .y4m or .mp4, or end the name of a folder with \"/\""
            ),
        )),
    }
}

/// SHA-256 of a picture's pixels: RGB8, row-major, top row first, no padding. The number
/// that the manifest keeps for each frame.
pub fn pixels_sha256(picture: &Rgb8) -> BlobHash {
    BlobHash(Sha256::digest(picture.pixels()).into())
}

/// Shown instead of a frame that could not be rendered: nobody takes it for terrain.
const FAILED_FRAME_RGB: [u8; 3] = [255, 0, 255];

/// What stands in place of a frame that could not be rendered.
pub fn failed_frame(width: u32, height: u32) -> Rgb8 {
    let mut picture = Rgb8::new(width, height);
    for pixel in picture.pixels_mut().chunks_exact_mut(3) {
        pixel.copy_from_slice(&FAILED_FRAME_RGB);
    }
    picture
}

fn ends_with_separator(path: &Path) -> bool {
    path.as_os_str().to_str().is_some_and(|text| text.ends_with(std::path::is_separator))
}

/// Counts the frames in, and refuses those that do not belong.
#[derive(Debug)]
struct Arrivals {
    spec: Spec,
    next: FrameIndex,
}

impl Arrivals {
    fn new(spec: Spec) -> Self {
        Arrivals { spec, next: 0 }
    }

    fn admit(&mut self, frame: FrameIndex, picture: &Rgb8) -> Result<(), SinkError> {
        let refuse = |why| Err(SinkError::Frame { frame, why });
        if frame != self.next || frame >= self.spec.frames {
            return refuse(format!("frame {} of {} is next", self.next, self.spec.frames));
        }
        let (width, height) = (picture.width(), picture.height());
        if (width, height) != (self.spec.width, self.spec.height) {
            let (w, h) = (self.spec.width, self.spec.height);
            return refuse(format!("it has {width} x {height} pixels, the shot {w} x {h}"));
        }
        self.next += 1;
        Ok(())
    }

    fn all_here(&self, output: &Path) -> Result<(), SinkError> {
        if self.next == self.spec.frames {
            return Ok(());
        }
        let (got, frames) = (self.next, self.spec.frames);
        Err(SinkError::Missing { got, frames, path: output.to_path_buf() })
    }
}

#[cfg(test)]
mod tests;
