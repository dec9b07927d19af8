//! H.264 for one group of pictures at a time.
//!
//! Every group is closed: it begins with a picture that stands alone and refers to
//! nothing outside. Each is encoded by an encoder of its own, so groups can be encoded in
//! any order, on any number of threads, and the bytes are the same.

use super::colour::Planes;
use super::rate::Rate;
use super::sps::with_colour;
use rusty_h264::{Encoder, EncoderConfig, Preset, YuvPlanes};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// The most macroblocks (16 x 16 pixels) of a picture at level 5.2, which is what
/// decoders in hardware and browsers stop at: 4096 x 2304.
pub(crate) const MAX_MACROBLOCKS: usize = 36_864;

/// NAL unit types.
const SLICE: u8 = 1;
const KEY_SLICE: u8 = 5;
const SEQUENCE_SET: u8 = 7;
const PICTURE_SET: u8 = 8;

/// The settings that all groups of a video share.
#[derive(Debug, Clone)]
pub(super) struct Settings {
    /// Width and height, pixels, both even.
    pub size: (usize, usize),
    pub rate: Rate,
    /// Pictures in a group.
    pub group: usize,
}

/// One encoded group.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Group {
    /// The sequence and the picture parameter set, equal in all groups.
    pub sets: ParameterSets,
    /// Each picture's NAL units, every one behind its length (4 bytes, big end first).
    /// The first picture is the one that stands alone.
    pub pictures: Vec<Vec<u8>>,
}

/// What a decoder must know before the first picture: NAL units without start codes.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) struct ParameterSets {
    pub sequence: Vec<u8>,
    pub picture: Vec<u8>,
}

/// The quantiser, constant over a video. Measured with the settings below on 30 pictures
/// of 1280 x 720, a flight over a Landsat photo with haze, on one core of a shared server
/// (CPU time, +-15 %), luma PSNR by ffmpeg; at 30 pictures a second:
///
/// | quantiser | dB | Mbit/s | pictures/s |
/// |---|---|---|---|
/// | 18 | 45.9 | 15.1 | 18 |
/// | 20 | 44.5 | 11.3 | 18 |
/// | **22** | **43.0** | **8.2** | **20** |
/// | 24 | 41.6 | 5.9 | 20 |
/// | 26 | 40.3 | 4.2 | 22 |
///
/// At 24, without vectors finer than a pixel: 40.4 dB, 10.7 Mbit/s, 34 pictures/s. The
/// preset above it, `Balanced`: 41.6 dB, 5.9 Mbit/s, 11 pictures/s.
const QUANTISER: u8 = 22;

impl Settings {
    fn config(&self) -> EncoderConfig {
        let (width, height) = self.size;
        let mut config = EncoderConfig::new(width, height);
        config.preset = Preset::Fast;
        config.qp = QUANTISER;
        config.num_ref_frames = 1;
        // Ground moves by fractions of a pixel: vectors that fine halve the file.
        config.tune_subpel = true;
        config.framerate = (f64::from(self.rate.frames) / f64::from(self.rate.per)) as f32;
        config.gop_size = self.group as u32;
        config.min_keyint = self.group as u32;
        // One picture in, one picture out: anything that looks ahead would hand back
        // several in one call.
        config.lookahead = 0;
        config.mbtree = false;
        config.bframes = 0;
        config.scenecut = 0;
        config
    }

    /// Encodes one group. The encoder is young: should it panic, that is an error here.
    pub fn encode(&self, pictures: &[Planes]) -> Result<Group, String> {
        let encoded = catch_unwind(AssertUnwindSafe(|| self.encode_unguarded(pictures)));
        encoded.unwrap_or_else(|_| Err("it stopped on an internal error".to_string()))
    }

    fn encode_unguarded(&self, pictures: &[Planes]) -> Result<Group, String> {
        let (width, height) = self.size;
        let mut encoder = Encoder::new(self.config()).map_err(|error| format!("{error:?}"))?;
        let mut group = Group { sets: ParameterSets::default(), pictures: Vec::new() };
        for planes in pictures {
            let view = YuvPlanes {
                width,
                height,
                y: &planes.y,
                u: &planes.cb,
                v: &planes.cr,
                stride_y: width,
                stride_c: width / 2,
            };
            let stream = encoder.encode_planes(&view).map_err(|error| format!("{error:?}"))?;
            let picture = self.take(&stream, &mut group)?;
            group.pictures.push(picture);
        }
        if encoder.flush().is_empty() {
            return Ok(group);
        }
        Err("it held pictures back".to_string())
    }

    /// Sorts the units of one picture out: parameter sets to the group, slices to the
    /// picture. Insists on exactly one picture, of the kind that belongs here.
    fn take(&self, stream: &[u8], group: &mut Group) -> Result<Vec<u8>, String> {
        let is_first = group.pictures.is_empty();
        let mut picture = Vec::with_capacity(stream.len() + 16);
        let mut begun = 0;
        for unit in units(stream) {
            match unit[0] & 0x1f {
                SEQUENCE_SET => {
                    let references = self.config().num_ref_frames;
                    group.sets.sequence = with_colour(unit, self.rate, references)
                        .ok_or("its parameter set has an unknown ending")?;
                }
                PICTURE_SET => group.sets.picture = unit.to_vec(),
                kind @ (SLICE | KEY_SLICE) => {
                    if (kind == KEY_SLICE) != is_first {
                        return Err("a picture of the wrong kind came out".to_string());
                    }
                    // A slice that starts a picture has macroblock 0 first: Golomb "1".
                    begun += usize::from(unit.get(1).is_some_and(|byte| byte & 0x80 != 0));
                    let length = u32::try_from(unit.len()).map_err(|error| error.to_string())?;
                    picture.extend_from_slice(&length.to_be_bytes());
                    picture.extend_from_slice(unit);
                }
                _ => {}
            }
        }
        let has_sets = !group.sets.sequence.is_empty() && !group.sets.picture.is_empty();
        if begun != 1 || !has_sets {
            return Err(format!("{begun} pictures came out for one that went in"));
        }
        Ok(picture)
    }
}

/// The NAL units of a stream with start codes, none of them empty.
fn units(stream: &[u8]) -> Vec<&[u8]> {
    let mut units = Vec::new();
    let mut start = None;
    let mut at = 0;
    while at + 3 <= stream.len() {
        if stream[at..at + 3] == [0, 0, 1] {
            units.extend(start.map(|from: usize| &stream[from..at]));
            start = Some(at + 3);
            at += 3;
        } else {
            at += 1;
        }
    }
    units.extend(start.map(|from| &stream[from..]));
    // A unit never ends with a zero: those belong to the next start code.
    let trimmed = units.into_iter().map(|unit| {
        let end = unit.iter().rposition(|byte| *byte != 0).map_or(0, |last| last + 1);
        &unit[..end]
    });
    trimmed.filter(|unit| !unit.is_empty()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sink::colour::halved;
    use terrafarm_common::image::Rgb8;

    fn moving(width: u32, height: u32, count: u32) -> Vec<Planes> {
        let frame = |n: u32| {
            let pixel = |i: u32| {
                let (x, y) = (i % width + n, i / width);
                [(x * 7) as u8, (y * 5) as u8, (x ^ y) as u8]
            };
            let pixels = (0..width * height).flat_map(pixel).collect();
            halved(&Rgb8::from_pixels(width, height, pixels).expect("pixels of that size"))
        };
        (0..count).map(frame).collect()
    }

    fn settings(width: usize, height: usize) -> Settings {
        Settings { size: (width, height), rate: Rate { frames: 25, per: 1 }, group: 8 }
    }

    #[test]
    fn one_picture_comes_out_for_each_that_goes_in() {
        let group = settings(64, 48).encode(&moving(64, 48, 8)).expect("a small video");
        assert_eq!(group.pictures.len(), 8);
        assert!(group.pictures.iter().all(|picture| picture.len() > 5));
    }

    #[test]
    fn the_same_group_gives_the_same_bytes_and_the_same_sets() {
        let all = settings(64, 48).encode(&moving(64, 48, 8)).expect("a small video");
        let again = settings(64, 48).encode(&moving(64, 48, 8)).expect("a small video");
        let short = settings(64, 48).encode(&moving(64, 48, 3)).expect("a small video");
        assert_eq!(all, again);
        assert_eq!(all.sets, short.sets);
    }

    #[test]
    fn the_smallest_picture_is_encoded() {
        assert_eq!(settings(2, 2).encode(&moving(1, 1, 2)).expect("a dot").pictures.len(), 2);
    }

    #[test]
    fn planes_of_another_size_are_an_error_not_a_panic() {
        assert!(settings(64, 48).encode(&moving(32, 32, 1)).is_err());
    }

    #[test]
    fn units_are_found_behind_long_and_short_start_codes() {
        let stream = [9, 0, 0, 0, 1, 7, 8, 0, 0, 1, 5, 0, 0, 0, 1, 6];
        assert_eq!(units(&stream), [&[7u8, 8][..], &[5], &[6]]);
        assert!(units(&[]).is_empty());
        assert!(units(&[0, 0, 1]).is_empty());
    }
}
