//! Video by the program `ffmpeg`: pictures go down a pipe, complaints come back in errors.
//!
//! The pictures are converted here, as for the built-in encoder, so that both show the
//! same colours.

use super::beside::Beside;
use super::colour::{even, halved};
use super::rate::Rate;
use super::{Arrivals, Finished, FrameSink, SinkError, Spec};
use std::io::{ErrorKind, Read, Write};
use std::path::Path;
use std::process::{Child, ChildStderr, Command, Stdio};
use std::thread::JoinHandle;
use terrafarm_common::id::FrameIndex;
use terrafarm_common::image::Rgb8;

/// The most of its complaints that is kept, bytes.
const MAX_COMPLAINT: u64 = 16 << 10;

/// One video, compressed by a child process.
pub(super) struct Ffmpeg {
    child: Child,
    complaint: Option<JoinHandle<String>>,
    /// Gone once it is committed.
    file: Option<Beside>,
    arrivals: Arrivals,
}

impl Ffmpeg {
    pub fn open(output: &Path, spec: Spec) -> Result<Box<dyn FrameSink>, SinkError> {
        Ok(Box::new(Self::with_program("ffmpeg", output, spec)?))
    }

    pub(super) fn with_program(
        program: &str,
        output: &Path,
        spec: Spec,
    ) -> Result<Self, SinkError> {
        let rate = Rate::of(spec.fps, output)?;
        let file = Beside::for_program(output)?;
        let (width, height) = (even(spec.width as usize), even(spec.height as usize));
        let mut command = Command::new(program);
        command
            .args(["-hide_banner", "-nostdin", "-loglevel", "error", "-y"])
            .args(["-f", "rawvideo", "-pixel_format", "yuv420p"])
            .args(["-video_size", &format!("{width}x{height}")])
            .args(["-framerate", &format!("{}/{}", rate.frames, rate.per)])
            .args(["-i", "pipe:0", "-an"])
            .args(codec(output))
            .args(["-color_range", "tv", "-colorspace", "bt709", "-color_primaries", "bt709"])
            .args(["-color_trc", "bt709", "-chroma_sample_location", "center"])
            .arg(file.temporary())
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped());
        let mut child = command.spawn().map_err(|error| match error.kind() {
            ErrorKind::NotFound => failed(format!(
                "there is no program \"{program}\" on the path; install it, or leave --encoder out to use the built-in one"
            )),
            _ => failed(format!("cannot start \"{program}\": {error}")),
        })?;
        let complaint = child.stderr.take().map(|pipe| std::thread::spawn(|| hear(pipe)));
        Ok(Ffmpeg { child, complaint, file: Some(file), arrivals: Arrivals::new(spec) })
    }

    /// Closes the pipe and waits for the child; its complaint if it failed.
    fn end(&mut self) -> Result<(), SinkError> {
        drop(self.child.stdin.take());
        let status = self.child.wait().map_err(|error| failed(error.to_string()))?;
        let said = self.complaint.take().and_then(|thread| thread.join().ok()).unwrap_or_default();
        if status.success() {
            return Ok(());
        }
        let said = if said.trim().is_empty() { "it gave no reason" } else { said.trim() };
        Err(failed(format!("{status}: {said}")))
    }
}

impl FrameSink for Ffmpeg {
    fn put(&mut self, frame: FrameIndex, picture: &Rgb8) -> Result<(), SinkError> {
        self.arrivals.admit(frame, picture)?;
        let planes = halved(picture);
        let pipe = self.child.stdin.as_mut();
        let pipe = pipe.ok_or_else(|| failed("it has ended already".to_string()))?;
        let written = [&planes.y, &planes.cb, &planes.cr]
            .into_iter()
            .try_for_each(|plane| pipe.write_all(plane));
        if written.is_ok() {
            return Ok(());
        }
        // It has closed its end: what it says is the reason.
        self.end()?;
        Err(failed("it stopped reading before the last frame".to_string()))
    }

    fn finish(mut self: Box<Self>) -> Result<Finished, SinkError> {
        let Some(file) = self.file.take() else {
            return Err(failed("it is finished already".to_string()));
        };
        let output = file.target().to_path_buf();
        self.arrivals.all_here(&output)?;
        self.end()?;
        let bytes = file.commit()?;
        Ok(Finished { output, frames: self.arrivals.next, bytes })
    }
}

impl Drop for Ffmpeg {
    fn drop(&mut self) {
        // Both fail only if it has ended, and then there is nothing to do.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// What to compress with, by the ending of the output.
fn codec(output: &Path) -> &'static [&'static str] {
    match output.extension().and_then(|ending| ending.to_str()) {
        Some("webm") => &["-c:v", "libvpx-vp9", "-crf", "24", "-b:v", "0", "-row-mt", "1"],
        Some("mkv") => &["-c:v", "libx264", "-crf", "18"],
        _ => &["-c:v", "libx264", "-crf", "18", "-movflags", "+faststart"],
    }
}

/// Reads to the end, so that the child never waits for us; keeps the beginning.
fn hear(mut pipe: ChildStderr) -> String {
    let mut said = Vec::new();
    // A broken pipe ends it like a closed one.
    let _ = pipe.by_ref().take(MAX_COMPLAINT).read_to_end(&mut said);
    let _ = std::io::copy(&mut pipe, &mut std::io::sink());
    String::from_utf8_lossy(&said).into_owned()
}

fn failed(why: String) -> SinkError {
    SinkError::Encoder { encoder: "ffmpeg", why }
}
