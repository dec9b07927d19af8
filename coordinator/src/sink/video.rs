//! `.mp4` by the built-in encoder: groups of pictures encoded side by side.
//!
//! A closed group is one task for a pool of this sink's own threads. Groups are written
//! in order; when as many are being encoded as there are threads, the caller waits for
//! the oldest. The length of a group follows from the size of the picture alone, so the
//! file is the same on any number of threads.

use super::beside::Beside;
use super::colour::{self, Planes, even};
use super::h264::{Group, MAX_MACROBLOCKS, Settings};
use super::mp4::{Mp4, Track};
use super::rate::Rate;
use super::{Arrivals, Finished, FrameSink, SinkError, Spec};
use rayon::{ThreadPool, ThreadPoolBuilder};
use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};
use terrafarm_common::id::FrameIndex;
use terrafarm_common::image::Rgb8;

/// Raw pictures of one group, bytes: 30 pictures at 1280 x 720, 21 at 1920 x 1080.
const GROUP_BYTES: usize = 64 << 20;
/// Shorter groups would be mostly pictures that stand alone.
const MIN_GROUP: usize = 4;
/// A second at 30 pictures a second: how far a player must go back to seek.
const MAX_GROUP: usize = 30;
/// More groups at once would only hold memory: 16 of them are 1 GiB.
const MAX_THREADS: usize = 16;

/// One `.mp4` file.
pub(super) struct Mp4Sink {
    output: PathBuf,
    arrivals: Arrivals,
    settings: Arc<Settings>,
    pool: ThreadPool,
    at_once: usize,
    gathered: Vec<Planes>,
    encoding: VecDeque<Receiver<Result<Group, String>>>,
    file: File,
}

/// The file waits for the first group, which brings the parameter sets.
enum File {
    Empty(Beside),
    Begun(Mp4),
    /// A write failed.
    Lost,
}

impl Mp4Sink {
    pub fn open(output: &Path, spec: Spec) -> Result<Box<dyn FrameSink>, SinkError> {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        Ok(Box::new(Self::with_threads(output, spec, cores.min(MAX_THREADS))?))
    }

    pub(super) fn with_threads(
        output: &Path,
        spec: Spec,
        threads: usize,
    ) -> Result<Self, SinkError> {
        let rate = Rate::of(spec.fps, output)?;
        let size = (even(spec.width as usize), even(spec.height as usize));
        let blocks = size.0.div_ceil(16) * size.1.div_ceil(16);
        if blocks > MAX_MACROBLOCKS {
            let why = format!(
                "{} x {} pixels are more than H.264 players take, about 4096 x 2304; write pictures or .y4m",
                spec.width, spec.height
            );
            return Err(SinkError::output(output, why));
        }
        let picture_bytes = size.0 * size.1 * 3 / 2;
        let group = (GROUP_BYTES / picture_bytes).clamp(MIN_GROUP, MAX_GROUP);
        let name = |i| format!("encode-{i}");
        let pool = ThreadPoolBuilder::new().num_threads(threads).thread_name(name).build();
        let pool = pool.map_err(|error| encoder_failed(error.to_string()))?;
        Ok(Mp4Sink {
            output: output.to_path_buf(),
            arrivals: Arrivals::new(spec),
            settings: Arc::new(Settings { size, rate, group }),
            pool,
            at_once: threads,
            gathered: Vec::new(),
            encoding: VecDeque::new(),
            file: File::Empty(Beside::create(output)?),
        })
    }

    /// Hands what is gathered to the pool.
    fn encode_gathered(&mut self) -> Result<(), SinkError> {
        while self.encoding.len() >= self.at_once {
            self.write_oldest()?;
        }
        let pictures = std::mem::take(&mut self.gathered);
        let settings = Arc::clone(&self.settings);
        let (done, result) = sync_channel(1);
        self.pool.spawn(move || {
            // Nobody listens any more if the sink was dropped.
            let _ = done.send(settings.encode(&pictures));
        });
        self.encoding.push_back(result);
        Ok(())
    }

    fn write_oldest(&mut self) -> Result<(), SinkError> {
        let Some(result) = self.encoding.pop_front() else { return Ok(()) };
        let group = result.recv().map_err(|error| encoder_failed(error.to_string()))?;
        let group = group.map_err(encoder_failed)?;
        let mut mp4 = match std::mem::replace(&mut self.file, File::Lost) {
            File::Begun(mp4) => mp4,
            File::Empty(file) => Mp4::begin(file, self.track(&group)?)?,
            File::Lost => return Err(encoder_failed("an earlier write failed".to_string())),
        };
        group.pictures.iter().try_for_each(|picture| mp4.put(picture))?;
        self.file = File::Begun(mp4);
        Ok(())
    }

    fn track(&self, group: &Group) -> Result<Track, SinkError> {
        let side = |pixels: usize| {
            u16::try_from(pixels).map_err(|error| encoder_failed(error.to_string()))
        };
        Ok(Track {
            size: (side(self.settings.size.0)?, side(self.settings.size.1)?),
            rate: self.settings.rate,
            frames: self.arrivals.spec.frames,
            group: self.settings.group as u32,
            sets: group.sets.clone(),
        })
    }
}

impl FrameSink for Mp4Sink {
    fn put(&mut self, frame: FrameIndex, picture: &Rgb8) -> Result<(), SinkError> {
        self.arrivals.admit(frame, picture)?;
        self.gathered.push(colour::halved(picture));
        if self.gathered.len() == self.settings.group {
            self.encode_gathered()?;
        }
        Ok(())
    }

    fn finish(mut self: Box<Self>) -> Result<Finished, SinkError> {
        self.arrivals.all_here(&self.output)?;
        if !self.gathered.is_empty() {
            self.encode_gathered()?;
        }
        while !self.encoding.is_empty() {
            self.write_oldest()?;
        }
        let bytes = match self.file {
            File::Begun(mp4) => mp4.finish()?,
            File::Empty(_) | File::Lost => {
                return Err(encoder_failed("no picture was written".to_string()));
            }
        };
        Ok(Finished { output: self.output, frames: self.arrivals.next, bytes })
    }
}

fn encoder_failed(why: String) -> SinkError {
    SinkError::Encoder { encoder: "built-in", why }
}
