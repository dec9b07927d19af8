//! The frames that are being put together.

use crate::coverage::Coverage;
use std::collections::BTreeMap;
use terrafarm_common::camera::MAX_SIDE_PX;
use terrafarm_common::id::FrameIndex;
use terrafarm_common::image::Rgb8;
use terrafarm_common::region::Region;

/// What a merged region did to its frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Merge {
    /// The frame is whole; the film has given it away and forgotten it.
    Complete(Rgb8),
    /// Something is missing still.
    Partial {
        /// How much, pixels.
        missing_px: u64,
    },
}

/// Why nothing was opened or merged. The film is as it was before.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FilmError {
    /// When as many frames are open as the film may hold.
    #[error("cannot open frame {frame}: {open} frames are open; finish or discard one first")]
    Full {
        /// The frame that was to be opened.
        frame: FrameIndex,
        /// How many are open.
        open: usize,
    },
    /// When a side is 0 or larger than [`MAX_SIDE_PX`].
    #[error("cannot open frame {frame} of {width} x {height} pixels: sides are 1 to {MAX_SIDE_PX}")]
    Size {
        /// The frame that was to be opened.
        frame: FrameIndex,
        /// Its width, pixels.
        width: u32,
        /// Its height, pixels.
        height: u32,
    },
    /// When a frame is opened twice.
    #[error("frame {frame} is open already")]
    AlreadyOpen {
        /// The frame.
        frame: FrameIndex,
    },
    /// When pixels come for a frame that was never opened, is whole, or was discarded.
    #[error("frame {frame} is not open; its pixels came too late or too early")]
    NotOpen {
        /// The frame.
        frame: FrameIndex,
    },
    /// When a region is empty or leaves the frame.
    #[error("{region:?} is not a part of frame {frame} of {width} x {height} pixels")]
    Outside {
        /// The frame.
        frame: FrameIndex,
        /// The region.
        region: Region,
        /// Width of the frame, pixels.
        width: u32,
        /// Height of the frame, pixels.
        height: u32,
    },
    /// When the number of bytes is not three for each pixel of the region.
    #[error("{region:?} of frame {frame} came with {bytes} bytes; it has three for each pixel")]
    Length {
        /// The frame.
        frame: FrameIndex,
        /// The region.
        region: Region,
        /// How many bytes came.
        bytes: usize,
    },
    /// When some of the pixels are there already.
    #[error("{twice_px} pixels of {region:?} of frame {frame} are there already")]
    Overlap {
        /// The frame.
        frame: FrameIndex,
        /// The region.
        region: Region,
        /// How many of its pixels are there, at least 1.
        twice_px: u64,
    },
}

#[derive(Debug)]
struct OpenFrame {
    picture: Rgb8,
    coverage: Coverage,
}

/// The open frames of one shot.
///
/// A frame costs 3 bytes a pixel and one bit more: 6.5 MB at 1920 x 1080.
#[derive(Debug)]
pub struct Film {
    max_open: usize,
    open: BTreeMap<FrameIndex, OpenFrame>,
}

impl Film {
    /// A film that holds at most so many open frames.
    pub fn new(max_open: usize) -> Self {
        Film { max_open, open: BTreeMap::new() }
    }

    /// Makes room for a frame.
    ///
    /// # Errors
    /// [`FilmError::Full`], [`FilmError::Size`], [`FilmError::AlreadyOpen`].
    pub fn open(&mut self, frame: FrameIndex, width: u32, height: u32) -> Result<(), FilmError> {
        if self.open.contains_key(&frame) {
            return Err(FilmError::AlreadyOpen { frame });
        }
        if self.open.len() >= self.max_open {
            return Err(FilmError::Full { frame, open: self.open.len() });
        }
        let sides = 1..=MAX_SIDE_PX;
        if !sides.contains(&width) || !sides.contains(&height) {
            return Err(FilmError::Size { frame, width, height });
        }
        let picture = Rgb8::new(width, height);
        let coverage = Coverage::new(width, height);
        self.open.insert(frame, OpenFrame { picture, coverage });
        Ok(())
    }

    /// Whether a frame is open.
    pub fn is_open(&self, frame: FrameIndex) -> bool {
        self.open.contains_key(&frame)
    }

    /// Number of open frames.
    pub fn open_frames(&self) -> usize {
        self.open.len()
    }

    /// Puts pixels (rows from the top, three bytes each) in their place: all of them, or
    /// none if there is an error.
    ///
    /// # Errors
    /// [`FilmError::NotOpen`], [`FilmError::Outside`], [`FilmError::Length`],
    /// [`FilmError::Overlap`].
    pub fn merge(
        &mut self,
        frame: FrameIndex,
        region: Region,
        pixels: &[u8],
    ) -> Result<Merge, FilmError> {
        let open = self.open.get_mut(&frame).ok_or(FilmError::NotOpen { frame })?;
        let (width, height) = (open.picture.width(), open.picture.height());
        if !region.fits(width, height) {
            return Err(FilmError::Outside { frame, region, width, height });
        }
        // Checked before the pasting, since afterwards the older pixels are gone.
        let twice_px = open.coverage.count(region);
        if twice_px > 0 {
            return Err(FilmError::Overlap { frame, region, twice_px });
        }
        if !open.picture.paste(region, pixels) {
            return Err(FilmError::Length { frame, region, bytes: pixels.len() });
        }
        open.coverage.add(region);
        let missing_px = open.coverage.missing_px();
        if missing_px > 0 {
            return Ok(Merge::Partial { missing_px });
        }
        let whole = self.open.remove(&frame).ok_or(FilmError::NotOpen { frame })?;
        Ok(Merge::Complete(whole.picture))
    }

    /// Forgets pixels of an open frame, as if they had not been merged. Whether all of them
    /// were there; nothing is changed otherwise.
    pub fn retract(&mut self, frame: FrameIndex, region: Region) -> bool {
        let Some(open) = self.open.get_mut(&frame) else { return false };
        let is_there = region.fits(open.picture.width(), open.picture.height())
            && open.coverage.count(region) == region.area();
        if is_there {
            open.coverage.remove(region);
        }
        is_there
    }

    /// Throws an open frame away; whether there was one.
    pub fn discard(&mut self, frame: FrameIndex) -> bool {
        self.open.remove(&frame).is_some()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;
    use terrafarm_common::region::{columns, tiles};

    fn part(picture: &Rgb8, region: Region) -> Vec<u8> {
        let rows = region.y..region.y + region.height;
        let places = rows.flat_map(|y| (region.x..region.x + region.width).map(move |x| (x, y)));
        places.flat_map(|(x, y)| picture.get(x, y)).collect()
    }

    fn any_picture() -> impl Strategy<Value = Rgb8> {
        (1u32..150, 1u32..20).prop_flat_map(|(width, height)| {
            let pixels = prop::collection::vec(any::<u8>(), (width * height * 3) as usize);
            pixels.prop_map(move |pixels| Rgb8::from_pixels(width, height, pixels).unwrap())
        })
    }

    proptest! {
        #[test]
        fn any_split_in_any_order_gives_the_same_picture(
            picture in any_picture(),
            cuts in prop::collection::btree_set(1u32..150, 0..8),
            side in 1u32..70,
            by_columns in any::<bool>(),
            order in any::<prop::sample::Index>(),
            stride in any::<prop::sample::Index>(),
            repeated in any::<prop::sample::Index>(),
        ) {
            let (width, height) = (picture.width(), picture.height());
            let cuts: Vec<u32> = cuts.into_iter().collect();
            let regions =
                if by_columns { columns(width, height, &cuts) } else { tiles(width, height, side) };
            let count = regions.len();
            // Start anywhere and go on by a stride that is prime to the count.
            let stride = (1 + stride.index(count)..).find(|s| gcd(*s, count) == 1).unwrap();
            let start = order.index(count);
            let repeat_after = repeated.index(count);
            let mut film = Film::new(1);
            film.open(7, width, height).unwrap();
            for i in 0..count {
                let region = regions[(start + i * stride) % count];
                let pixels = part(&picture, region);
                match film.merge(7, region, &pixels).unwrap() {
                    Merge::Complete(whole) => {
                        prop_assert_eq!(i, count - 1);
                        prop_assert_eq!(&whole, &picture);
                    }
                    Merge::Partial { missing_px } => {
                        prop_assert!(missing_px > 0 && i < count - 1);
                        if i == repeat_after {
                            let inverted: Vec<u8> = pixels.iter().map(|value| !value).collect();
                            let twice_px = region.area();
                            let refused = film.merge(7, region, &inverted);
                            let expected = FilmError::Overlap { frame: 7, region, twice_px };
                            prop_assert_eq!(refused, Err(expected));
                        }
                    }
                }
            }
            prop_assert!(!film.is_open(7));
        }

        #[test]
        fn nothing_that_arrives_can_panic_or_tear_a_frame(
            merges in prop::collection::vec(
                (0u32..3, any::<[u8; 4]>(), 0usize..700, any::<u8>()), 0..60),
        ) {
            let mut film = Film::new(2);
            film.open(0, 20, 10).unwrap();
            film.open(1, 20, 10).unwrap();
            for (frame, [x, y, w, h], bytes, value) in merges {
                let at = |value: u8, limit: u32| u32::from(value) % limit;
                let region = Region { x: at(x, 22), y: at(y, 12), width: at(w, 9), height: at(h, 9) };
                let bytes = if bytes % 2 == 0 { region.area() as usize * 3 } else { bytes };
                let before = film.open.get(&frame).map(|open| open.picture.clone());
                if film.merge(frame, region, &vec![value; bytes]).is_err() {
                    prop_assert_eq!(film.open.get(&frame).map(|open| &open.picture), before.as_ref());
                }
            }
            let absurd = Region { x: u32::MAX, y: 1, width: u32::MAX, height: 1 };
            prop_assert!(film.merge(0, absurd, &[]).is_err());
        }
    }

    fn gcd(a: usize, b: usize) -> usize {
        if b == 0 { a } else { gcd(b, a % b) }
    }

    #[test]
    fn a_duplicate_that_overlaps_by_one_pixel_is_refused_whole() {
        let mut film = Film::new(1);
        film.open(0, 10, 1).unwrap();
        let left = Region { x: 0, y: 0, width: 4, height: 1 };
        let right = Region { x: 3, y: 0, width: 7, height: 1 };
        film.merge(0, left, &[1; 12]).unwrap();
        let refused = film.merge(0, right, &[2; 21]);
        assert_eq!(refused, Err(FilmError::Overlap { frame: 0, region: right, twice_px: 1 }));
        let rest = Region { x: 4, width: 6, ..right };
        let Merge::Complete(whole) = film.merge(0, rest, &[3; 18]).unwrap() else {
            panic!("the frame is whole")
        };
        assert_eq!((whole.get(3, 0), whole.get(4, 0)), ([1; 3], [3; 3]));
    }

    #[test]
    fn what_is_taken_back_can_be_merged_again() {
        let mut film = Film::new(1);
        film.open(0, 2, 1).unwrap();
        let [left, right] = [0, 1].map(|x| Region { x, y: 0, width: 1, height: 1 });
        film.merge(0, left, &[1; 3]).unwrap();
        assert!(!film.retract(0, Region::whole(2, 1)), "half of it is not there");
        assert!(!film.retract(0, Region::whole(9, 9)) && !film.retract(1, left));
        assert!(film.retract(0, left) && !film.retract(0, left));
        assert_eq!(film.merge(0, right, &[3; 3]), Ok(Merge::Partial { missing_px: 1 }));
        let Ok(Merge::Complete(picture)) = film.merge(0, left, &[2; 3]) else { panic!() };
        assert_eq!(picture.pixels(), [2, 2, 2, 3, 3, 3]);
    }

    #[test]
    fn a_full_film_refuses_until_a_frame_is_discarded() {
        let mut film = Film::new(1);
        film.open(0, 2, 2).unwrap();
        assert_eq!(film.open(0, 2, 2), Err(FilmError::AlreadyOpen { frame: 0 }));
        assert_eq!(film.open(1, 2, 2), Err(FilmError::Full { frame: 1, open: 1 }));
        assert!(film.discard(0));
        assert!(!film.discard(0));
        let late = film.merge(0, Region::whole(2, 2), &[0; 12]);
        assert_eq!(late, Err(FilmError::NotOpen { frame: 0 }));
        film.open(1, 2, 2).unwrap();
        assert_eq!(film.open_frames(), 1);
    }

    #[test]
    fn absurd_sizes_are_refused_before_anything_is_allocated() {
        let mut film = Film::new(1);
        for (width, height) in [(0, 1), (1, 0), (MAX_SIDE_PX + 1, 1), (u32::MAX, u32::MAX)] {
            let refused = film.open(0, width, height);
            assert_eq!(refused, Err(FilmError::Size { frame: 0, width, height }));
        }
    }
}
