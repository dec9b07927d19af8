//! Finished frames on the disk, and what is made of them at the end.

use super::ledger::{FrameRecord, ShotRecord};
use super::plan::Film;
use super::{QueueError, ShotFiles, disk};
use crate::sink::manifest::{FrameEntry, Manifest};
use crate::sink::{self, Encoder, FrameSink, SinkError, Spec, failed_frame, poster};
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::BufReader;
use std::path::Path;
use terrafarm_common::id::FrameIndex;
use terrafarm_common::image::Rgb8;
use tokio_util::sync::CancellationToken;

/// Writes a finished picture, synced, under its name; returns its size in bytes.
///
/// # Errors
/// If there is no room, or the disk fails.
pub fn store(
    queue: &Path,
    reserve_bytes: u64,
    path: &Path,
    picture: &Rgb8,
) -> Result<u64, QueueError> {
    // Compressed it is smaller; this is not the place to be exact.
    disk::has_room(queue, reserve_bytes, picture.pixels().len() as u64)?;
    poster::save(path, picture).map_err(|why| sink_error(queue, why))
}

fn sink_error(queue: &Path, why: SinkError) -> QueueError {
    match why {
        SinkError::DiskFull { .. } => disk::full(queue, 1),
        SinkError::Io { what, path, source } => disk::error(queue, what, &path, &source),
        other => {
            QueueError::Io { what: "write", path: queue.to_path_buf(), why: other.to_string() }
        }
    }
}

/// Removes what a killed coordinator left half-written in the folder of a shot.
pub fn tidy(folder: &Path) {
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        if entry.file_name().to_str().is_some_and(|name| name.contains(".partial.")) {
            let _ = fs::remove_file(entry.path());
        }
    }
}

/// Why a shot could not be finished.
#[derive(Debug)]
pub enum Unfinished {
    /// Pictures of these frames are not on the disk as they were written.
    Lost(Vec<FrameIndex>),
    /// The disk failed or is full.
    Disk(QueueError),
    /// Nobody wants it any more.
    Canceled,
}

/// Makes film and manifest of a shot, all of whose frames are over. Returns a note for
/// people if the film could not be made.
///
/// # Errors
/// See [`Unfinished`]; what was there before stays.
pub fn finish(
    queue: &Path,
    files: &ShotFiles,
    record: &ShotRecord,
    frames: &BTreeMap<FrameIndex, FrameRecord>,
    stop: &CancellationToken,
) -> Result<String, Unfinished> {
    tidy(&files.folder);
    let lost = frames.iter().filter(|(index, record)| is_lost(files, **index, record));
    let lost: Vec<_> = lost.map(|(index, _)| *index).collect();
    if !lost.is_empty() {
        return Err(Unfinished::Lost(lost));
    }
    mark_failed(queue, files, record, frames).map_err(Unfinished::Disk)?;
    let note = match record.plan.film {
        Some(Film::Mp4) => make_film(queue, files, record, frames, stop)?,
        None => String::new(),
    };
    let output = match record.plan.film {
        Some(Film::Mp4) if note.is_empty() => files.film(),
        _ => files.folder.clone(),
    };
    let manifest = manifest(record, frames, &output);
    manifest.save(&files.folder).map_err(|why| Unfinished::Disk(sink_error(queue, why)))?;
    Ok(note)
}

/// Whether a finished picture is not there any more in its size.
fn is_lost(files: &ShotFiles, index: FrameIndex, record: &FrameRecord) -> bool {
    let FrameRecord::Done { bytes, .. } = record else { return false };
    let path = files.frame(files.first_frame + index);
    let facts = path.and_then(|path| fs::metadata(path).ok());
    facts.is_none_or(|facts| facts.len() != *bytes)
}

/// Puts marked pictures in the places of frames that failed, as every sequence has them.
fn mark_failed(
    queue: &Path,
    files: &ShotFiles,
    record: &ShotRecord,
    frames: &BTreeMap<FrameIndex, FrameRecord>,
) -> Result<(), QueueError> {
    let [width, height] = record.plan.size;
    let failed = frames.iter().filter(|(_, frame)| matches!(frame, FrameRecord::Failed(_)));
    for path in failed.filter_map(|(index, _)| files.frame(files.first_frame + index)) {
        let saved = poster::save(&path, &failed_frame(width, height));
        saved.map_err(|why| sink_error(queue, why))?;
    }
    Ok(())
}

fn make_film(
    queue: &Path,
    files: &ShotFiles,
    record: &ShotRecord,
    frames: &BTreeMap<FrameIndex, FrameRecord>,
    stop: &CancellationToken,
) -> Result<String, Unfinished> {
    let [width, height] = record.plan.size;
    let spec = Spec { width, height, fps: record.plan.fps, first: 0, frames: record.frames };
    let film = sink::open(&files.film(), spec, Encoder::BuiltIn);
    let made = film.and_then(|mut film| {
        let lost = put_all(film.as_mut(), files, record, frames, stop)?;
        if stop.is_cancelled() || !lost.is_empty() {
            return Ok(lost);
        }
        film.finish().map(|_| lost)
    });
    match made {
        _ if stop.is_cancelled() => Err(Unfinished::Canceled),
        Ok(lost) if lost.is_empty() => Ok(String::new()),
        Ok(lost) => Err(Unfinished::Lost(lost)),
        Err(why @ (SinkError::DiskFull { .. } | SinkError::Io { .. })) => {
            Err(Unfinished::Disk(sink_error(queue, why)))
        }
        // Trying again would not help; the frames are all there.
        Err(why) => Ok(format!("there is no film: {why}")),
    }
}

/// Puts every frame into a film; returns those whose pictures are not what was rendered.
/// From the first such frame on, the others are only looked at.
fn put_all(
    film: &mut dyn FrameSink,
    files: &ShotFiles,
    record: &ShotRecord,
    frames: &BTreeMap<FrameIndex, FrameRecord>,
    stop: &CancellationToken,
) -> Result<Vec<FrameIndex>, SinkError> {
    let [width, height] = record.plan.size;
    let mut lost = Vec::new();
    for index in 0..record.frames {
        if stop.is_cancelled() {
            break;
        }
        let picture = match frames.get(&index) {
            Some(FrameRecord::Done { entry, .. }) => read(files, index, entry, [width, height]),
            _ => Some(failed_frame(width, height)),
        };
        match picture {
            Some(picture) if lost.is_empty() => film.put(index, &picture)?,
            Some(_) => {}
            None => lost.push(index),
        }
    }
    Ok(lost)
}

/// Reads a picture back; `None` if it is not the one that was rendered.
fn read(files: &ShotFiles, index: FrameIndex, entry: &FrameEntry, size: [u32; 2]) -> Option<Rgb8> {
    let path = files.frame(files.first_frame + index)?;
    let picture = decode(&path, size)?;
    (sink::pixels_sha256(&picture).to_hex() == entry.sha256).then_some(picture)
}

/// Reads a picture of this size that this program wrote; `None` if it is anything else.
fn decode(path: &Path, size: [u32; 2]) -> Option<Rgb8> {
    let mut reader = png::Decoder::new(BufReader::new(File::open(path).ok()?)).read_info().ok()?;
    if [reader.info().width, reader.info().height] != size {
        return None;
    }
    let mut pixels = vec![0; reader.output_buffer_size()?];
    let facts = reader.next_frame(&mut pixels).ok()?;
    let is_ours =
        facts.color_type == png::ColorType::Rgb && facts.bit_depth == png::BitDepth::Eight;
    if !is_ours {
        return None;
    }
    Rgb8::from_pixels(facts.width, facts.height, pixels)
}

/// What is written of a shot, with the keys of every render.
fn manifest(
    record: &ShotRecord,
    frames: &BTreeMap<FrameIndex, FrameRecord>,
    output: &Path,
) -> Manifest {
    let plan = &record.plan;
    let entries: Vec<_> = frames
        .values()
        .filter_map(|frame| match frame {
            FrameRecord::Done { entry, .. } => Some(entry.clone()),
            FrameRecord::Failed(_) => None,
        })
        .collect();
    let failed = frames.iter().filter_map(|(index, frame)| match frame {
        FrameRecord::Failed(reason) => Some((plan.first_frame + index, reason.clone())),
        FrameRecord::Done { .. } => None,
    });
    let fallbacks = entries.iter().map(|entry| entry.fallbacks).sum::<u64>();
    let samples = u64::from(plan.size[0])
        * u64::from(plan.size[1])
        * u64::from(plan.quality.samples_per_side).pow(2)
        * entries.len() as u64;
    Manifest {
        program: format!("terrafarm {}", env!("CARGO_PKG_VERSION")),
        scene: plan.source.scene.clone(),
        scene_sha256: plan.source.scene_sha256.clone(),
        terrain: plan.source.terrain.clone(),
        terrain_sha256: plan.index.to_hex(),
        flight: plan.source.flight.clone(),
        output: output.display().to_string(),
        method: plan.quality.method.name().to_owned(),
        samples: plan.quality.samples_per_side,
        tolerance_px: plan.quality.method.reads_tolerance().then_some(plan.quality.tolerance_px),
        size: plan.size,
        fps: plan.fps,
        fallbacks,
        fallback_share: fallbacks as f64 / samples.max(1) as f64,
        // Nobody waits for the frames of a queue.
        coarser_pixels: 0,
        failed: failed.collect(),
        frames: entries,
        workers: record.workers.clone(),
    }
}
