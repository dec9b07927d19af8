//! What is submitted to the queue: a whole shot, as JSON or in memory.

use super::QueueError;
use crate::sink::h264::MAX_MACROBLOCKS;
use serde::{Deserialize, Serialize};
use terrafarm_common::accuracy::Share;
use terrafarm_common::camera::{Camera, MAX_SIDE_PX};
use terrafarm_common::flight::MAX_FRAMES;
use terrafarm_common::id::{BlobHash, FrameIndex};
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Split;
use terrafarm_common::shading::Shading;
use terrafarm_wire::limits::{CAMERAS_MAX, FRAMES_MAX, NEWEST_VERSION};
use terrafarm_wire::message::{Cameras, Submit};
use terrafarm_wire::{Message, encode};

/// Longest text that is kept for the manifest, bytes of UTF-8.
pub const TEXT_BYTES_MAX: usize = 4 << 10;
/// Pixels of the frames of a shot that may be in flight: as much memory as a farm gives to
/// all shots together would leave nothing for others.
pub const PIXELS_IN_FLIGHT_MAX: u64 = 1 << 30;
/// Fewest and most frames per second.
const FPS: std::ops::RangeInclusive<f64> = 1e-3..=1e3;

/// A film that is made of the frames when they are all there.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Film {
    /// H.264 in MP4, by the built-in encoder.
    Mp4,
}

/// A shot, with all that is needed to render it when whoever submitted it has gone. Its
/// terrain travels apart from it, as blobs.
///
/// As JSON, numbers keep every bit: write them with 17 digits.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShotPlan {
    /// What to call it.
    pub name: String,
    /// Larger is more urgent.
    #[serde(default)]
    pub priority: i32,
    /// The index of its terrain store, 64 hexadecimal digits.
    #[serde(with = "hex")]
    pub index: BlobHash,
    /// Light, air and sky.
    pub shading: Shading,
    /// Method, samples and tolerance.
    #[serde(with = "quality")]
    pub quality: Quality,
    /// What share of the pixels is to be measured, millionths.
    #[serde(with = "share", default = "Share::default", rename = "check_millionths")]
    pub check: Share,
    /// Width and height of its frames, pixels.
    pub size: [u32; 2],
    /// How frames are cut into jobs.
    #[serde(default)]
    pub split: Split,
    /// Frames per second of the film.
    pub fps: f64,
    /// Number of the first frame within the flight: a part of a flight keeps the numbers
    /// of the whole.
    #[serde(default)]
    pub first_frame: FrameIndex,
    /// One camera a frame, all of the shot's size.
    pub cameras: Vec<Camera>,
    /// Frames that may be begun and not yet stored.
    #[serde(default = "frames_in_flight")]
    pub frames_in_flight: u32,
    /// The film to be made of it, if any.
    #[serde(default)]
    pub film: Option<Film>,
    /// What the manifest says of where it comes from.
    #[serde(default)]
    pub source: Source,
}

/// Where a shot comes from, for its manifest.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Source {
    /// The scene file, as the user named it.
    pub scene: String,
    /// SHA-256 of the scene file, hexadecimal.
    pub scene_sha256: String,
    /// The terrain store, as the scene names it.
    pub terrain: String,
    /// The flight file, as the user named it.
    pub flight: Option<String>,
}

fn frames_in_flight() -> u32 {
    3
}

impl ShotPlan {
    /// Whether a farm can render it.
    ///
    /// # Errors
    /// [`QueueError::Unfit`], with what is wrong.
    pub fn check(&self) -> Result<(), QueueError> {
        let unfit = |why: String| Err(QueueError::Unfit(why));
        let [width, height] = self.size;
        let frames = self.cameras.len();
        if frames == 0 || frames > FRAMES_MAX as usize {
            return unfit(format!("a shot has 1 to {FRAMES_MAX} cameras, this one {frames}"));
        }
        self.check_kept(frames as u32)?;
        if self.cameras.iter().any(|camera| [camera.width, camera.height] != self.size) {
            return unfit(format!("not all of its cameras have {width} x {height} pixels"));
        }
        for cameras in self.cameras.chunks(CAMERAS_MAX) {
            let piece: Message = Cameras { number: 0, first: 0, cameras: cameras.to_vec() }.into();
            encode(NEWEST_VERSION, &piece).map(|_| ()).or_else(|why| unfit(why.to_string()))?;
        }
        Ok(())
    }

    /// As [`ShotPlan::check`], of a shot whose cameras, so many, are kept apart.
    ///
    /// # Errors
    /// [`QueueError::Unfit`], with what is wrong.
    pub(super) fn check_kept(&self, frames: u32) -> Result<(), QueueError> {
        let unfit = |why: String| Err(QueueError::Unfit(why));
        if self.first_frame >= MAX_FRAMES {
            return unfit(format!(
                "its first frame is {}; a flight has {MAX_FRAMES} at most",
                self.first_frame
            ));
        }
        if !FPS.contains(&self.fps) {
            let (least, most) = (FPS.start(), FPS.end());
            return unfit(format!("its fps is {}; choose {least} to {most}", self.fps));
        }
        let Source { scene, scene_sha256, terrain, flight } = &self.source;
        let texts = [Some(scene), Some(scene_sha256), Some(terrain), flight.as_ref()];
        if texts.into_iter().flatten().any(|text| text.len() > TEXT_BYTES_MAX) {
            return unfit(format!("a name in its source is longer than {TEXT_BYTES_MAX} bytes"));
        }
        let [width, height] = self.size;
        self.check_size(width, height)?;
        // What the wire would refuse is refused here, by the same rules.
        let submit = self.submission(0, frames);
        let fits = encode(NEWEST_VERSION, &submit.into()).map(|_| ());
        fits.or_else(|why| unfit(why.to_string()))
    }

    fn check_size(&self, width: u32, height: u32) -> Result<(), QueueError> {
        let unfit = |why: String| Err(QueueError::Unfit(why));
        let sides = 1..=MAX_SIDE_PX;
        if !sides.contains(&width) || !sides.contains(&height) {
            return unfit(format!("{width} x {height} pixels; each side has 1 to {MAX_SIDE_PX}"));
        }
        let in_flight =
            u64::from(width) * u64::from(height) * u64::from(self.frames_in_flight.max(1));
        if in_flight > PIXELS_IN_FLIGHT_MAX {
            return unfit(format!(
                "{} frames of {width} x {height} pixels in flight are too many; choose {} or fewer",
                self.frames_in_flight,
                PIXELS_IN_FLIGHT_MAX / (u64::from(width) * u64::from(height))
            ));
        }
        let blocks = u64::from(width.div_ceil(16)) * u64::from(height.div_ceil(16));
        if self.film.is_some() && blocks > MAX_MACROBLOCKS as u64 {
            return unfit(format!(
                "{width} x {height} pixels are more than H.264 players take; ask for no film"
            ));
        }
        Ok(())
    }

    /// The message that submits so many frames of it to the farm.
    pub(super) fn submission(&self, number: u32, frames: u32) -> Submit {
        let [width, height] = self.size;
        Submit {
            number,
            name: self.name.clone(),
            index: self.index,
            shading: self.shading.clone(),
            quality: self.quality,
            check: self.check,
            width,
            height,
            split: self.split,
            frames,
            frames_in_flight: self.frames_in_flight,
            priority: self.priority,
            // What is left overnight has nobody who waits for each frame.
            live: false,
        }
    }
}

/// Hashes as hexadecimal digits.
pub(super) mod hex {
    use serde::{Deserialize, Deserializer, Serializer, de::Error};
    use terrafarm_common::id::BlobHash;

    pub fn serialize<S: Serializer>(hash: &BlobHash, to: S) -> Result<S::Ok, S::Error> {
        to.serialize_str(&hash.to_hex())
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<BlobHash, D::Error> {
        let text = String::deserialize(from)?;
        super::parse_hash(&text).ok_or_else(|| D::Error::custom("a hash has 64 hexadecimal digits"))
    }
}

/// A hash from its 64 hexadecimal digits.
pub fn parse_hash(text: &str) -> Option<BlobHash> {
    let bytes = text.as_bytes();
    if bytes.len() != 64 {
        return None;
    }
    let mut hash = [0; 32];
    for (byte, digits) in hash.iter_mut().zip(bytes.chunks_exact(2)) {
        let digit = |symbol: u8| char::from(symbol).to_digit(16);
        *byte = (16 * digit(digits[0])? + digit(digits[1])?) as u8;
    }
    Some(BlobHash(hash))
}

/// The share of measured pixels, in millionths.
mod share {
    use serde::{Deserialize, Deserializer, Serializer, de::Error};
    use terrafarm_common::accuracy::Share;

    pub fn serialize<S: Serializer>(share: &Share, to: S) -> Result<S::Ok, S::Error> {
        to.serialize_u32(share.millionths())
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Share, D::Error> {
        let millionths = u32::deserialize(from)?;
        Share::from_millionths(millionths)
            .ok_or_else(|| D::Error::custom("check_millionths is 0 to 1000000"))
    }
}

/// Quality under the names that the manifest uses.
mod quality {
    use super::{Method, Quality};
    use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error};

    #[derive(Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Named {
        method: String,
        samples: u32,
        #[serde(default = "tolerance_px")]
        tolerance_px: f64,
    }

    fn tolerance_px() -> f64 {
        Quality::DEFAULT_TOLERANCE_PX
    }

    pub fn serialize<S: Serializer>(quality: &Quality, to: S) -> Result<S::Ok, S::Error> {
        let method = quality.method.name().to_owned();
        let (samples, tolerance_px) = (quality.samples_per_side, quality.tolerance_px);
        Named { method, samples, tolerance_px }.serialize(to)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Quality, D::Error> {
        let Named { method, samples, tolerance_px } = Named::deserialize(from)?;
        let method: Method = method.parse().map_err(D::Error::custom)?;
        Ok(Quality { method, samples_per_side: samples, tolerance_px })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn the_plan_in_the_documents_is_one_that_a_farm_takes() {
        let text = std::fs::read_to_string("../docs/API.md").unwrap();
        let (_, rest) = text.split_once("```json\n{\n  \"name\"").unwrap();
        let (rest, _) = rest.split_once("```").unwrap();
        let plan: ShotPlan = serde_json::from_str(&format!("{{ \"name\"{rest}")).unwrap();
        plan.check().unwrap();
    }
}
