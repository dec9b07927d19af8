//! One picture that stands for a shot.

use super::{SinkError, png};
use std::path::Path;
use terrafarm_common::image::Rgb8;

/// Saves one PNG, whole or not at all, over what may be there; returns its size in bytes.
pub fn save(path: &Path, picture: &Rgb8) -> Result<u64, SinkError> {
    png::save(path, picture)
}
