//! The MP4 container for one H.264 track (ISO/IEC 14496-12 and 14496-15).
//!
//! Pictures go to the disk as they come: nothing but four bytes a picture stays in
//! memory, and the file may be larger than 4 GiB. Since the number of pictures is known,
//! so is the size of the index: its place is kept free in front of them and filled at the
//! end, and a browser can play before it has everything.

use super::SinkError;
use super::beside::Beside;
use super::h264::ParameterSets;
use super::rate::Rate;

/// The track, known before the first picture.
#[derive(Debug, Clone)]
pub(super) struct Track {
    /// Width and height, pixels.
    pub size: (u16, u16),
    pub rate: Rate,
    /// Number of pictures.
    pub frames: u32,
    /// Every so many pictures, one stands alone.
    pub group: u32,
    pub sets: ParameterSets,
}

/// A file that is being written.
pub(super) struct Mp4 {
    file: Beside,
    track: Track,
    sizes: Vec<u32>,
    bytes: u64,
}

impl Mp4 {
    /// Writes everything in front of the pictures, the index still empty.
    pub fn begin(mut file: Beside, track: Track) -> Result<Self, SinkError> {
        file.write(&file_type())?;
        file.write(&track.index(&[]))?;
        file.write(&data_header(0))?;
        Ok(Mp4 { file, track, sizes: Vec::new(), bytes: 0 })
    }

    /// Appends one picture.
    pub fn put(&mut self, picture: &[u8]) -> Result<(), SinkError> {
        let size = u32::try_from(picture.len()).map_err(|_| SinkError::Encoder {
            encoder: "built-in",
            why: "a picture of more than 4 GiB came out".to_string(),
        })?;
        self.file.write(picture)?;
        self.sizes.push(size);
        self.bytes += u64::from(size);
        Ok(())
    }

    /// Fills the index in and gives the file its name; returns its size in bytes.
    pub fn finish(mut self) -> Result<u64, SinkError> {
        let index_at = file_type().len() as u64;
        let index = self.track.index(&self.sizes);
        self.file.overwrite(index_at, &index)?;
        self.file.overwrite(index_at + index.len() as u64, &data_header(self.bytes))?;
        self.file.commit()
    }
}

fn file_type() -> Vec<u8> {
    boxed(b"ftyp", &[b"isom", &512u32.to_be_bytes(), b"isomiso2avc1mp41"])
}

/// The header of the pictures: with a 64-bit length, so that it never grows.
fn data_header(bytes: u64) -> Vec<u8> {
    let length = DATA_HEADER + bytes;
    [&1u32.to_be_bytes()[..], b"mdat", &length.to_be_bytes()].concat()
}

const DATA_HEADER: u64 = 16;

impl Track {
    /// The box `moov`. Its length depends on the number of pictures alone, so that with no
    /// sizes it is as long as with all.
    fn index(&self, sizes: &[u32]) -> Vec<u8> {
        let length = self.index_at(sizes, 0).len() as u64;
        self.index_at(sizes, file_type().len() as u64 + length + DATA_HEADER)
    }

    fn index_at(&self, sizes: &[u32], first_picture_at: u64) -> Vec<u8> {
        let (scale, step) = self.clock();
        let duration = u64::from(self.frames) * u64::from(step);
        let movie = boxed(
            b"mvhd",
            &[
                &version(1, 0),
                &[0; 16],
                &be32(scale),
                &duration.to_be_bytes(),
                &be32(0x0001_0000),
                &be16(0x0100),
                &[0; 10],
                &UPRIGHT,
                &[0; 24],
                &be32(2),
            ],
        );
        let (width, height) = self.size;
        let header = boxed(
            b"tkhd",
            &[
                &version(1, 3),
                &[0; 16],
                &be32(1),
                &[0; 4],
                &duration.to_be_bytes(),
                &[0; 16],
                &UPRIGHT,
                &be32(u32::from(width) << 16),
                &be32(u32::from(height) << 16),
            ],
        );
        let media = boxed(
            b"mdhd",
            &[
                &version(1, 0),
                &[0; 16],
                &be32(scale),
                &duration.to_be_bytes(),
                &be16(0x55c4), // Language "und".
                &[0; 2],
            ],
        );
        let handler = boxed(b"hdlr", &[&[0; 8], b"vide", &[0; 12], b"video\0"]);
        let place = boxed(b"url ", &[&version(0, 1)]);
        let places = boxed(b"dinf", &[&boxed(b"dref", &[&[0; 4], &be32(1), &place])]);
        let about = boxed(b"vmhd", &[&version(0, 1), &[0; 8]]);
        let table = self.sample_table(sizes, first_picture_at, step);
        let information = boxed(b"minf", &[&about, &places, &table]);
        let media = boxed(b"mdia", &[&media, &handler, &information]);
        boxed(b"moov", &[&movie, &boxed(b"trak", &[&header, &media])])
    }

    /// Ticks a second, and ticks a picture.
    fn clock(&self) -> (u32, u32) {
        let finer = if self.rate.frames < 1000 { 1000 } else { 1 };
        (self.rate.frames * finer, self.rate.per * finer)
    }

    fn sample_table(&self, sizes: &[u32], first_picture_at: u64, step: u32) -> Vec<u8> {
        let frames = self.frames;
        let times = boxed(b"stts", &[&[0; 4], &be32(1), &be32(frames), &be32(step)]);
        let alone: Vec<u8> =
            (0..frames).step_by(self.group as usize).flat_map(|frame| be32(frame + 1)).collect();
        let keys = boxed(b"stss", &[&[0; 4], &be32(alone.len() as u32 / 4), &alone]);
        let chunk = boxed(b"stsc", &[&[0; 4], &be32(1), &be32(1), &be32(frames), &be32(1)]);
        let mut list: Vec<u8> = sizes.iter().flat_map(|size| be32(*size)).collect();
        list.resize(frames as usize * 4, 0);
        let lengths = boxed(b"stsz", &[&[0; 8], &be32(frames), &list]);
        let offset = boxed(b"co64", &[&[0; 4], &be32(1), &first_picture_at.to_be_bytes()]);
        let kind = boxed(b"stsd", &[&[0; 4], &be32(1), &self.sample_entry()]);
        boxed(b"stbl", &[&kind, &times, &keys, &chunk, &lengths, &offset])
    }

    fn sample_entry(&self) -> Vec<u8> {
        let ParameterSets { sequence, picture } = &self.sets;
        let profile = sequence.get(1..4).unwrap_or(&[100, 0, 52]);
        let mut decoder = [&[1], profile, &[0xff, 0xe1]].concat();
        decoder.extend(be16(sequence.len() as u16));
        decoder.extend(sequence);
        decoder.push(1);
        decoder.extend(be16(picture.len() as u16));
        decoder.extend(picture);
        if profile[0] >= 100 {
            decoder.extend([0xfd, 0xf8, 0xf8, 0]); // 4:2:0, 8 bits.
        }
        // BT.709 three times, limited range: the same as in the parameter set.
        let colour = boxed(b"colr", &[b"nclx", &be16(1), &be16(1), &be16(1), &[0]]);
        let square = boxed(b"pasp", &[&be32(1), &be32(1)]);
        let (width, height) = self.size;
        boxed(
            b"avc1",
            &[
                &[0; 6],
                &be16(1),
                &[0; 16],
                &be16(width),
                &be16(height),
                &be32(72 << 16),
                &be32(72 << 16),
                &[0; 4],
                &be16(1),
                &[0; 32],
                &be16(24),
                &[0xff; 2],
                &boxed(b"avcC", &[&decoder]),
                &colour,
                &square,
            ],
        )
    }
}

/// The identity, as 16.16 and 2.30 fixed point.
const UPRIGHT: [u8; 36] = {
    let mut matrix = [0; 36];
    matrix[1] = 1;
    matrix[17] = 1;
    matrix[32] = 0x40;
    matrix
};

fn boxed(kind: &[u8; 4], parts: &[&[u8]]) -> Vec<u8> {
    let length = 8 + parts.iter().map(|part| part.len()).sum::<usize>();
    let mut out = Vec::with_capacity(length);
    out.extend(be32(length as u32));
    out.extend(kind);
    parts.iter().for_each(|part| out.extend_from_slice(part));
    out
}

fn version(version: u8, flags: u8) -> [u8; 4] {
    [version, 0, 0, flags]
}

fn be32(value: u32) -> [u8; 4] {
    value.to_be_bytes()
}

fn be16(value: u16) -> [u8; 2] {
    value.to_be_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn track(frames: u32) -> Track {
        let sets = ParameterSets { sequence: vec![0x67, 100, 0, 31, 9], picture: vec![0x68, 1] };
        Track { size: (1280, 720), rate: Rate { frames: 30, per: 1 }, frames, group: 30, sets }
    }

    #[test]
    fn the_index_has_the_same_length_empty_and_full() {
        for frames in [1, 29, 30, 31, 1000] {
            let full = track(frames).index(&vec![77; frames as usize]);
            assert_eq!(track(frames).index(&[]).len(), full.len());
        }
    }

    #[test]
    fn boxes_nest_without_a_gap() {
        fn walk(bytes: &[u8], seen: &mut Vec<String>) {
            let mut at = 0;
            while at < bytes.len() {
                let length = u32::from_be_bytes(bytes[at..at + 4].try_into().expect("4 bytes"));
                let kind = String::from_utf8_lossy(&bytes[at + 4..at + 8]).into_owned();
                let inside = &bytes[at + 8..at + length as usize];
                if ["moov", "trak", "mdia", "minf", "stbl", "dinf"].contains(&kind.as_str()) {
                    walk(inside, seen);
                }
                seen.push(kind);
                at += length as usize;
            }
            assert_eq!(at, bytes.len());
        }
        let mut seen = Vec::new();
        walk(&track(40).index(&[5; 40]), &mut seen);
        for kind in ["mvhd", "tkhd", "mdhd", "hdlr", "stsd", "stts", "stss", "stsz", "co64"] {
            assert!(seen.iter().any(|s| s == kind), "{kind}");
        }
    }
}
