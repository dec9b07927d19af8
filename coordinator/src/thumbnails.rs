//! Small pictures of the newest frames, for the page: one a shot, and not of every frame.

use crate::view::ShotView;
use bytes::Bytes;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use terrafarm_common::camera::MAX_SIDE_PX;
use terrafarm_common::id::{FrameIndex, ShotId};
use terrafarm_common::image::Rgb8;

/// Widest and highest, pixels.
pub const SIDE_MAX_PX: u32 = 480;
/// Most pictures that are kept: of more shots, the one that was looked at or made longest
/// ago goes. About 10 MB.
const KEPT: usize = 256;
/// Frames of one shot that follow each other faster than this have no picture each.
const PACE: Duration = Duration::from_millis(400);
/// Quality of the JPEG, 1 to 100.
const JPEG_QUALITY: u8 = 80;

/// The pictures.
#[derive(Debug, Default)]
pub struct Thumbnails(Mutex<Kept>);

#[derive(Debug, Default)]
struct Kept {
    clock: u64,
    by_shot: BTreeMap<ShotId, Thumbnail>,
}

#[derive(Debug)]
struct Thumbnail {
    frame: FrameIndex,
    made: Instant,
    /// Order of use.
    used: u64,
    jpeg: Bytes,
}

impl Thumbnails {
    /// A frame is finished: keeps a small picture of it, unless one of the same shot is
    /// very young.
    pub fn keep(&self, shot: ShotId, frame: FrameIndex, picture: &Rgb8) {
        let now = Instant::now();
        let young = |kept: &Thumbnail| now.duration_since(kept.made) < PACE;
        if self.lock().by_shot.get(&shot).is_some_and(young) {
            return;
        }
        if let Some(jpeg) = jpeg(&shrink(picture)) {
            self.put(shot, frame, jpeg, now);
        }
    }

    /// The newest picture of a shot and its frame.
    pub fn get(&self, shot: ShotId) -> Option<(FrameIndex, Bytes)> {
        let mut kept = self.lock();
        kept.clock += 1;
        let clock = kept.clock;
        let thumbnail = kept.by_shot.get_mut(&shot)?;
        thumbnail.used = clock;
        Some((thumbnail.frame, thumbnail.jpeg.clone()))
    }

    /// The picture of a frame that is on the disk, made now and kept. Waits for the disk.
    ///
    /// # Errors
    /// In words, if there is no such file or it is no picture.
    pub fn read(&self, shot: &ShotView, frame: FrameIndex, png: &Path) -> Result<Bytes, String> {
        let picture = read_png(png)?;
        let jpeg = jpeg(&shrink(&picture)).ok_or("the picture cannot be compressed")?;
        self.put(shot.id, frame, jpeg.clone(), Instant::now());
        Ok(jpeg)
    }

    fn put(&self, shot: ShotId, frame: FrameIndex, jpeg: Bytes, made: Instant) {
        let mut kept = self.lock();
        kept.clock += 1;
        let used = kept.clock;
        kept.by_shot.insert(shot, Thumbnail { frame, made, used, jpeg });
        if kept.by_shot.len() > KEPT {
            let oldest = kept.by_shot.iter().min_by_key(|(_, kept)| kept.used).map(|(id, _)| *id);
            oldest.map(|shot| kept.by_shot.remove(&shot));
        }
    }

    /// Nothing that could panic happens under the lock.
    fn lock(&self) -> MutexGuard<'_, Kept> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A picture no larger than [`SIDE_MAX_PX`]: each pixel is the mean of those that it covers,
/// by whole pixels. Bytes are averaged as they are: it is for looking at, small.
fn shrink(picture: &Rgb8) -> Rgb8 {
    let (width, height) = (picture.width().max(1), picture.height().max(1));
    let longest = width.max(height);
    if longest <= SIDE_MAX_PX {
        return picture.clone();
    }
    let scaled = |side: u32| (u64::from(side) * u64::from(SIDE_MAX_PX) / u64::from(longest)).max(1);
    let (columns, rows) = (scaled(width) as usize, scaled(height) as usize);
    let (width, height) = (width as usize, height as usize);
    let mut small = Rgb8::new(columns as u32, rows as u32);
    for (row, line) in small.pixels_mut().chunks_exact_mut(columns * 3).enumerate() {
        let (top, bottom) = (row * height / rows, (row + 1) * height / rows);
        for (column, pixel) in line.chunks_exact_mut(3).enumerate() {
            let (left, right) = (column * width / columns, (column + 1) * width / columns);
            let mut sum = [0u32; 3];
            for y in top..bottom {
                let from = &picture.pixels()[3 * (y * width + left)..3 * (y * width + right)];
                for source in from.chunks_exact(3) {
                    for (sum, byte) in sum.iter_mut().zip(source) {
                        *sum += u32::from(*byte);
                    }
                }
            }
            let count = ((bottom - top) * (right - left)) as u32;
            for (byte, sum) in pixel.iter_mut().zip(sum) {
                *byte = ((sum + count / 2) / count) as u8;
            }
        }
    }
    small
}

fn jpeg(picture: &Rgb8) -> Option<Bytes> {
    let (width, height) = (picture.width() as u16, picture.height() as u16);
    let mut bytes = Vec::new();
    let encoder = jpeg_encoder::Encoder::new(&mut bytes, JPEG_QUALITY);
    encoder.encode(picture.pixels(), width, height, jpeg_encoder::ColorType::Rgb).ok()?;
    Some(bytes.into())
}

/// A picture that this program wrote.
fn read_png(path: &Path) -> Result<Rgb8, String> {
    let unusable = |why: String| format!("cannot read {}: {why}", path.display());
    let file = std::fs::File::open(path).map_err(|error| unusable(error.to_string()))?;
    let decoder = png::Decoder::new(std::io::BufReader::new(file));
    let mut reader = decoder.read_info().map_err(|error| unusable(error.to_string()))?;
    let (width, height) = (reader.info().width, reader.info().height);
    let rgb = reader.output_color_type() == (png::ColorType::Rgb, png::BitDepth::Eight);
    if !rgb || width > MAX_SIDE_PX || height > MAX_SIDE_PX {
        return Err(unusable("it is none of this program's pictures".into()));
    }
    let mut pixels = vec![0; width as usize * height as usize * 3];
    reader.next_frame(&mut pixels).map_err(|error| unusable(error.to_string()))?;
    Rgb8::from_pixels(width, height, pixels).ok_or_else(|| unusable("its size is wrong".into()))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// Left half black, right half white.
    fn halves(width: u32, height: u32) -> Rgb8 {
        let mut picture = Rgb8::new(width, height);
        for (at, pixel) in picture.pixels_mut().chunks_exact_mut(3).enumerate() {
            pixel.fill(if at as u32 % width < width / 2 { 0 } else { 255 });
        }
        picture
    }

    #[test]
    fn pictures_shrink_to_the_longest_side_and_keep_their_content() {
        let small = shrink(&halves(1920, 1080));
        assert_eq!((small.width(), small.height()), (480, 270));
        assert_eq!(
            (small.get(0, 0), small.get(239, 269), small.get(240, 0)),
            ([0; 3], [0; 3], [255; 3])
        );
        assert_eq!(shrink(&halves(100, 1000)).width(), 48);
        assert_eq!(shrink(&halves(2, 16_384)).width(), 1);
        assert_eq!(shrink(&halves(64, 32)), halves(64, 32));
    }

    #[test]
    fn the_newest_frame_of_a_shot_is_kept_and_the_number_of_shots_is_bounded() {
        let thumbnails = Thumbnails::default();
        for shot in 0..=KEPT as u64 {
            thumbnails.keep(ShotId(shot), 7, &halves(16, 16));
            // Looked at again and again: it stays.
            assert!(thumbnails.get(ShotId(0)).is_some());
        }
        assert_eq!(thumbnails.lock().by_shot.len(), KEPT);
        assert!(thumbnails.get(ShotId(1)).is_none());
        let (frame, jpeg) = thumbnails.get(ShotId(5)).unwrap();
        assert_eq!((frame, &jpeg[..2]), (7, &[0xff, 0xd8][..]));
    }
}
