//! How wrong a picture is: the error of one pixel, and the summary of many.
//!
//! A [`Summary`] keeps every measured value as long as there are few, and beyond
//! [`KEPT_MAX`] those with the lowest numbers of a hash of frame and pixel. So summaries
//! of the parts of a picture, merged in any order, are the summary of the picture, however
//! it was split: a picture's lowest numbers are among the lowest of its parts. Counts and
//! maxima are exact always; quantiles are those of the kept values.

use crate::stats::quantile;
use serde::{Deserialize, Serialize};
use std::str::FromStr;

/// Errors above this are not told apart, pixels: 64 stands for 64 and more.
pub const ERROR_MAX_PX: f64 = 64.0;
/// Most values that a summary keeps. Among so many, 40 lie above the 99th percentile.
pub const KEPT_MAX: usize = 4096;

/// How wrong the answer for one pixel is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PixelError {
    /// Distance of the answer from the true surface, pixels, at most [`ERROR_MAX_PX`].
    pub surface_px: f64,
    /// How much ground in front of it the answer ignores, pixels, at most
    /// [`ERROR_MAX_PX`]; 0 where the first number explains it.
    pub occlusion_px: f64,
    /// Claimed less true distance, metres; `None` if one of them is sky.
    pub depth_m: Option<f64>,
    /// Another cell of the ground is seen, or sky instead of ground, or ground instead of
    /// sky.
    pub mismatch: bool,
}

impl PixelError {
    /// The larger of both errors, pixels.
    pub fn error_px(&self) -> f64 {
        self.surface_px.max(self.occlusion_px)
    }
}

/// A value that is kept.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Kept {
    /// Number of the pixel: see [`pixel_number`].
    pub number: u32,
    /// Its error, pixels.
    pub error_px: f32,
    /// Its error in depth without its sign, metres; `None` where one answer is sky.
    pub depth_m: Option<f32>,
}

impl Kept {
    fn key(&self) -> (u32, u32, Option<u32>) {
        (self.number, self.error_px.to_bits(), self.depth_m.map(f32::to_bits))
    }

    fn is_valid(&self) -> bool {
        (0.0..=ERROR_MAX_PX as f32).contains(&self.error_px)
            && self.depth_m.is_none_or(|depth| depth.is_finite() && depth >= 0.0)
    }
}

/// The errors of many pixels.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Summary {
    samples: u64,
    mismatches: u64,
    error_max_px: f64,
    depth_max_m: Option<f64>,
    /// Sorted by [`Kept::key`].
    kept: Vec<Kept>,
}

/// Median, 99th percentile and maximum of something.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    /// Median.
    pub p50: f64,
    /// 99th percentile.
    pub p99: f64,
    /// Maximum.
    pub max: f64,
}

impl Summary {
    /// A summary from what travels; `None` if it is not one that [`Summary::add`] and
    /// [`Summary::merge`] make.
    pub fn from_parts(
        [samples, mismatches]: [u64; 2],
        error_max_px: f64,
        depth_max_m: Option<f64>,
        kept: Vec<Kept>,
    ) -> Option<Self> {
        let fits = mismatches <= samples
            && (0.0..=ERROR_MAX_PX).contains(&error_max_px)
            && depth_max_m.is_none_or(|depth| depth.is_finite() && depth >= 0.0)
            && kept.len() as u64 == samples.min(KEPT_MAX as u64)
            && kept.iter().all(Kept::is_valid)
            && kept.is_sorted_by_key(Kept::key);
        fits.then_some(Summary { samples, mismatches, error_max_px, depth_max_m, kept })
    }

    /// Takes a pixel in.
    pub fn add(&mut self, number: u32, error: &PixelError) {
        let depth_m = error.depth_m.map(f64::abs).filter(|depth| depth.is_finite());
        // What is no number is as wrong as can be.
        let error_px = Some(error.error_px()).filter(|error| !error.is_nan());
        let error_px = error_px.unwrap_or(ERROR_MAX_PX).clamp(0.0, ERROR_MAX_PX);
        self.samples += 1;
        self.mismatches += u64::from(error.mismatch);
        self.error_max_px = self.error_max_px.max(error_px);
        self.depth_max_m = larger(self.depth_max_m, depth_m);
        let depth_m = depth_m.map(|depth| depth.min(f64::from(f32::MAX)) as f32);
        let kept = Kept { number, error_px: error_px as f32, depth_m };
        let at = self.kept.partition_point(|other| other.key() < kept.key());
        if at < KEPT_MAX {
            self.kept.truncate(KEPT_MAX - 1);
            self.kept.insert(at, kept);
        }
    }

    /// Takes in all pixels of another summary.
    pub fn merge(&mut self, other: &Summary) {
        self.samples = self.samples.saturating_add(other.samples);
        self.mismatches = self.mismatches.saturating_add(other.mismatches);
        self.error_max_px = self.error_max_px.max(other.error_max_px);
        self.depth_max_m = larger(self.depth_max_m, other.depth_max_m);
        self.kept.extend_from_slice(&other.kept);
        self.kept.sort_unstable_by_key(Kept::key);
        self.kept.truncate(KEPT_MAX);
    }

    /// Number of pixels measured.
    pub fn samples(&self) -> u64 {
        self.samples
    }

    /// Number of pixels that see another part of the ground.
    pub fn mismatches(&self) -> u64 {
        self.mismatches
    }

    /// Share of pixels that see another part of the ground, 0 to 1.
    pub fn mismatch(&self) -> f64 {
        self.mismatches as f64 / self.samples.max(1) as f64
    }

    /// The largest error, pixels; 0 for no pixels.
    pub fn error_max_px(&self) -> f64 {
        self.error_max_px
    }

    /// The largest error in depth, metres; `None` if no answer and its truth were both
    /// ground.
    pub fn depth_max_m(&self) -> Option<f64> {
        self.depth_max_m
    }

    /// The values that are kept, in the order of their numbers.
    pub fn kept(&self) -> &[Kept] {
        &self.kept
    }

    /// The errors, pixels; `None` for no pixels.
    pub fn error_px(&self) -> Option<Spread> {
        let errors = self.kept.iter().map(|kept| f64::from(kept.error_px));
        spread(errors, self.error_max_px)
    }

    /// The errors in depth without their signs, metres; `None` if no answer and its truth
    /// were both ground.
    pub fn depth_m(&self) -> Option<Spread> {
        let depths = self.kept.iter().filter_map(|kept| kept.depth_m.map(f64::from));
        spread(depths, self.depth_max_m?)
    }
}

fn larger(one: Option<f64>, other: Option<f64>) -> Option<f64> {
    match (one, other) {
        (Some(a), Some(b)) => Some(a.max(b)),
        (a, b) => a.or(b),
    }
}

fn spread(values: impl Iterator<Item = f64>, max: f64) -> Option<Spread> {
    let mut sorted: Vec<f64> = values.collect();
    sorted.sort_unstable_by(f64::total_cmp);
    Some(Spread { p50: quantile(&sorted, 0.5)?, p99: quantile(&sorted, 0.99)?, max })
}

/// What share of the pixels of a picture is measured, in millionths.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(try_from = "u32", into = "u32")]
pub struct Share(u32);

impl Share {
    /// No pixel.
    pub const NONE: Share = Share(0);
    /// Every pixel, in millionths.
    const WHOLE: u32 = 1_000_000;

    /// A share in millionths; `None` beyond all.
    pub fn from_millionths(millionths: u32) -> Option<Self> {
        (millionths <= Self::WHOLE).then_some(Share(millionths))
    }

    /// The share in millionths.
    pub fn millionths(self) -> u32 {
        self.0
    }

    /// Whether the pixel of a number, see [`pixel_number`], is among those measured. The
    /// pixels of a share are among those of every larger one.
    pub fn takes(self, number: u32) -> bool {
        (u64::from(number) * u64::from(Self::WHOLE)) >> 32 < u64::from(self.0)
    }
}

impl TryFrom<u32> for Share {
    type Error = &'static str;

    fn try_from(millionths: u32) -> Result<Self, Self::Error> {
        Share::from_millionths(millionths).ok_or("a share is at most one")
    }
}

impl From<Share> for u32 {
    fn from(share: Share) -> u32 {
        share.0
    }
}

impl FromStr for Share {
    type Err = String;

    /// Reads a percentage: `1%`, `0.1%`, `1`.
    fn from_str(text: &str) -> Result<Self, String> {
        let number = text.strip_suffix('%').unwrap_or(text).trim().parse::<f64>().ok();
        let per_percent = f64::from(Self::WHOLE) / 100.0;
        let fits = |percent: &f64| *percent == 0.0 || (1.0 / per_percent..=100.0).contains(percent);
        number.filter(fits).map(|percent| Share((percent * per_percent).round() as u32)).ok_or_else(
            || {
                "write the share of pixels to check as 0.0001% to 100%, such as 1%; 0 for none"
                    .into()
            },
        )
    }
}

/// A number of a pixel that looks random: the same on every PC and for every split. By
/// the finaliser of splitmix64.
pub fn pixel_number(frame: u32, x: u32, y: u32) -> u32 {
    let mut bits = (u64::from(x) << 32) | u64::from(y);
    bits ^= u64::from(frame).wrapping_mul(0xD1B5_4A32_D192_ED03);
    for _ in 0..2 {
        bits = bits.wrapping_add(0x9E37_79B9_7F4A_7C15);
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        bits ^= bits >> 31;
    }
    (bits >> 32) as u32
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;

    fn error(error_px: f64, depth_m: Option<f64>) -> PixelError {
        PixelError { surface_px: error_px, occlusion_px: 0.0, depth_m, mismatch: error_px > 1.0 }
    }

    #[test]
    fn a_summary_of_a_few_pixels_is_exact() {
        let mut summary = Summary::default();
        assert_eq!(summary.error_px(), None);
        for (x, px) in [0.0, 3.0, 0.5, 100.0, 0.25].into_iter().enumerate() {
            let depth = (px < 1.0).then_some(-2.0 * px);
            summary.add(pixel_number(7, x as u32, 1), &error(px, depth));
        }
        assert_eq!((summary.samples(), summary.mismatch()), (5, 0.4));
        assert_eq!(summary.error_px(), Some(Spread { p50: 0.5, p99: 64.0, max: 64.0 }));
        assert_eq!(summary.depth_m(), Some(Spread { p50: 0.5, p99: 1.0, max: 1.0 }));
    }

    #[test]
    fn what_is_no_number_counts_as_wrong() {
        let mut summary = Summary::default();
        let nothing = PixelError { occlusion_px: f64::NAN, ..error(f64::NAN, Some(f64::NAN)) };
        summary.add(1, &nothing);
        assert_eq!(summary.error_max_px(), ERROR_MAX_PX);
        assert_eq!(summary.depth_m(), None);
    }

    #[test]
    fn numbers_are_spread_evenly_and_differ_from_frame_to_frame() {
        let low = |frame: u32| {
            let pixels = (0..100u32).flat_map(|y| (0..100u32).map(move |x| (x, y)));
            pixels.filter(|(x, y)| pixel_number(frame, *x, *y) < u32::MAX / 10).collect::<Vec<_>>()
        };
        for frame in 0..20 {
            assert!((880..1120).contains(&low(frame).len()), "{}", low(frame).len());
        }
        let (one, other) = (low(0), low(1));
        assert!(one.iter().filter(|pixel| other.contains(pixel)).count() < 200);
    }

    #[test]
    fn shares_are_percentages_and_those_that_are_none_are_refused() {
        for (text, millionths) in [
            ("1%", 10_000),
            ("0.1%", 1000),
            ("1", 10_000),
            ("100 %", 1_000_000),
            ("0", 0),
            ("0%", 0),
            ("1e-4", 1),
        ] {
            assert_eq!(text.parse::<Share>().unwrap().millionths(), millionths, "{text}");
        }
        for wrong in ["", "%", "-1%", "101%", "nan", "inf", "1%%", "all", "1e-5", "1 000"] {
            let error = wrong.parse::<Share>().unwrap_err();
            assert!(error.contains("0.0001% to 100%"), "{wrong}: {error}");
        }
        assert_eq!(Share::from_millionths(1_000_001), None);
    }

    #[test]
    fn a_share_takes_about_as_many_pixels_as_it_says() {
        let count = |share: &str| {
            let share: Share = share.parse().unwrap();
            let pixels = (0..200u32).flat_map(|y| (0..500u32).map(move |x| (x, y)));
            pixels.filter(|(x, y)| share.takes(pixel_number(3, *x, *y))).count()
        };
        assert_eq!((count("0"), count("100%")), (0, 100_000));
        assert!((900..1100).contains(&count("1%")), "{}", count("1%"));
        assert!(Share::from_millionths(1_000_000).unwrap().takes(u32::MAX));
        assert!(!Share::NONE.takes(0));
    }

    proptest! {
        #[test]
        fn parts_make_the_whole_however_they_are_cut(
            seeds in prop::collection::vec(any::<u32>(), 0..9000),
            cut in any::<prop::sample::Index>(),
        ) {
            let pixel = |seed: &u32| error(f64::from(seed % 700) / 10.0, seed.is_multiple_of(3).then_some(f64::from(*seed)));
            let summary_of = |seeds: &[u32]| {
                let mut summary = Summary::default();
                seeds.iter().for_each(|seed| summary.add(seed.wrapping_mul(2_654_435_761), &pixel(seed)));
                summary
            };
            let (left, right) = seeds.split_at(if seeds.is_empty() { 0 } else { cut.index(seeds.len()) });
            let mut merged = summary_of(right);
            merged.merge(&summary_of(left));
            let whole = summary_of(&seeds);
            prop_assert!(whole.kept().len() <= KEPT_MAX);
            prop_assert_eq!(&merged, &whole);
            let again = Summary::from_parts(
                [whole.samples(), whole.mismatches()],
                whole.error_max_px(),
                whole.depth_max_m(),
                whole.kept().to_vec(),
            );
            prop_assert_eq!(again, Some(whole));
        }
    }

    #[test]
    fn parts_that_contradict_each_other_make_no_summary() {
        let kept = |error_px| Kept { number: 3, error_px, depth_m: None };
        assert!(Summary::from_parts([1, 1], 1.0, None, vec![kept(1.0)]).is_some());
        assert!(Summary::from_parts([1, 2], 1.0, None, vec![kept(1.0)]).is_none());
        assert!(Summary::from_parts([2, 1], 1.0, None, vec![kept(1.0)]).is_none());
        assert!(Summary::from_parts([1, 1], f64::NAN, None, vec![kept(1.0)]).is_none());
        assert!(Summary::from_parts([1, 1], 1.0, Some(-1.0), vec![kept(1.0)]).is_none());
        assert!(Summary::from_parts([1, 1], 1.0, None, vec![kept(f32::NAN)]).is_none());
        assert!(Summary::from_parts([2, 1], 1.0, None, vec![kept(1.0), kept(0.5)]).is_none());
    }
}
