//! How a picture is to be made: the method, its tolerance and the number of samples.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// A way to find what a ray sees. ARCHITECTURE.md states what each promises.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, Default)]
pub enum Method {
    /// The cheapest of the others whose bound meets the tolerance for the camera and the
    /// terrain; decided anew for each frame, from these two alone.
    Auto,
    /// Finest level, bilinear surface, maximum pyramid for skipping only.
    #[default]
    Exact,
    /// The level of detail follows from the tolerance: wherever a coarser level is within
    /// it, the coarser level is the surface.
    Lod,
    /// The surface of `Lod`, seen along lines through the nadir: each ray of a line begins
    /// where the one below it ended.
    Column,
    /// Frusta of pixels halved until the bounds pyramid decides them.
    Frustum,
    /// The historical integer traversal: nearest posts, levels by distance.
    Voxel,
    /// The slow twin of `Exact`: a plain walk over every cell, 8 x 8 samples a pixel
    /// unless told otherwise. The measure of truth.
    Reference,
}

impl Method {
    /// All methods, in the order a user should read them.
    pub const ALL: [Method; 7] = [
        Method::Auto,
        Method::Exact,
        Method::Lod,
        Method::Column,
        Method::Frustum,
        Method::Voxel,
        Method::Reference,
    ];

    /// Whether [`Quality::tolerance_px`] means something to this method.
    pub fn reads_tolerance(self) -> bool {
        !matches!(self, Method::Exact | Method::Reference)
    }

    /// The name on the command line and in the manifest.
    pub fn name(self) -> &'static str {
        match self {
            Method::Auto => "auto",
            Method::Exact => "exact",
            Method::Lod => "lod",
            Method::Column => "column",
            Method::Frustum => "frustum",
            Method::Voxel => "voxel",
            Method::Reference => "reference",
        }
    }
}

impl fmt::Display for Method {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Method {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Method::ALL.into_iter().find(|method| method.name() == text).ok_or_else(|| {
            let names: Vec<_> = Method::ALL.iter().map(|method| method.name()).collect();
            format!("unknown method \"{text}\"; choose one of {}", names.join(", "))
        })
    }
}

/// What is asked of a render call.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// How rays find the ground.
    pub method: Method,
    /// Samples along each side of a pixel: n gives n x n stratified samples, averaged
    /// in linear light. 1 casts one ray through the pixel's centre.
    pub samples_per_side: u32,
    /// How far a method that trades accuracy for speed may displace what is seen, pixels;
    /// positive and finite. `Exact` and `Reference` do not read it.
    pub tolerance_px: f64,
}

impl Quality {
    /// The largest number of samples along a side: 32 x 32 = 1024 a pixel.
    pub const MAX_SAMPLES_PER_SIDE: u32 = 32;
    /// The tolerance unless told otherwise, pixels.
    pub const DEFAULT_TOLERANCE_PX: f64 = 0.5;
    /// The largest tolerance, pixels.
    pub const MAX_TOLERANCE_PX: f64 = 64.0;
    /// The smallest tolerance, pixels: that of `Exact`.
    pub const MIN_TOLERANCE_PX: f64 = 0.01;

    /// Whether the number of samples and the tolerance are within their limits.
    pub fn is_valid(&self) -> bool {
        (1..=Self::MAX_SAMPLES_PER_SIDE).contains(&self.samples_per_side)
            && (Self::MIN_TOLERANCE_PX..=Self::MAX_TOLERANCE_PX).contains(&self.tolerance_px)
    }
}

impl Default for Quality {
    fn default() -> Self {
        Quality {
            method: Method::Exact,
            samples_per_side: 1,
            tolerance_px: Quality::DEFAULT_TOLERANCE_PX,
        }
    }
}
