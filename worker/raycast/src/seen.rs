//! What a method has seen of a region, or why it will not look.

use std::fmt;
use terrafarm_common::quality::Method;
use terrafarm_common::region::Region;

/// Depths, pixel by pixel, and what they took.
#[derive(Debug, Clone)]
pub(crate) struct Seen {
    /// One over the depth of what the ray through the pixel's centre sees, per metre: 0 for
    /// the sky, NaN where a tile is missing. See [`crate::Depths::inverse_depth`].
    pub inverse_depth: Vec<f32>,
    /// Blocks and cells looked at.
    pub steps: u64,
    /// Rays cast.
    pub rays: u64,
    /// Pixels that fell back to a ray of their own.
    pub alone: u64,
    /// Pixels that show a coarser level than they should, for want of a tile.
    pub coarser: u64,
}

impl Seen {
    /// Nothing is known of any pixel.
    pub(crate) fn new(region: Region) -> Self {
        Seen::with(vec![f32::NAN; region.area() as usize])
    }

    /// The sky, for a method that writes every pixel: memory that is zero need not be written
    /// before.
    pub(crate) fn sky(region: Region) -> Self {
        Seen::with(vec![0.0; region.area() as usize])
    }

    fn with(inverse_depth: Vec<f32>) -> Self {
        Seen { inverse_depth, steps: 0, rays: 0, alone: 0, coarser: 0 }
    }
}

/// A method was asked for something that it is not made for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unfit {
    /// The method.
    pub method: Method,
    /// What it cannot do here, in words.
    pub why: String,
    /// A method that can.
    pub instead: Method,
}

impl fmt::Display for Unfit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Unfit { method, why, instead } = self;
        write!(f, "method {method} cannot do this: {why}; use {instead}")?;
        if *method == Method::Auto { Ok(()) } else { f.write_str(", or auto") }
    }
}

impl std::error::Error for Unfit {}
