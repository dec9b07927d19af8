//! How a picture is to be made: the method and the number of samples.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// A way to find what a ray sees. ARCHITECTURE.md states what each promises.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, Default)]
pub enum Method {
    /// Finest level, bilinear surface, maximum pyramid for skipping only.
    #[default]
    Exact,
    /// The slow twin of `Exact`: a plain walk over every cell, 8 x 8 samples a pixel
    /// unless told otherwise. The measure of truth.
    Reference,
}

impl Method {
    /// All methods, in the order a user should read them.
    pub const ALL: [Method; 2] = [Method::Exact, Method::Reference];

    /// The name on the command line and in the manifest.
    pub fn name(self) -> &'static str {
        match self {
            Method::Exact => "exact",
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Quality {
    /// How rays find the ground.
    pub method: Method,
    /// Samples along each side of a pixel: n gives n x n stratified samples, averaged
    /// in linear light. 1 casts one ray through the pixel's centre.
    pub samples_per_side: u32,
}

impl Quality {
    /// The largest number of samples along a side: 32 x 32 = 1024 a pixel.
    pub const MAX_SAMPLES_PER_SIDE: u32 = 32;
}

impl Default for Quality {
    fn default() -> Self {
        Quality { method: Method::Exact, samples_per_side: 1 }
    }
}
