//! JPEG photos.

#![no_main]

use terrafarm_fuzz::raster::is_readable;
use terrafarm_raster::{Sidecars, Source};

/// The writer of small JPEGs that the tests of the crate use.
#[allow(dead_code, reason = "the other things that those tests share")]
#[path = "../../../worker/terrain/raster/tests/raster/support.rs"]
mod support;

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    vec![support::tiny_jpeg(1, 0x11), support::tiny_jpeg(3, 0x11), support::tiny_jpeg(3, 0x22)]
}

fn accepts(input: &[u8]) -> bool {
    is_readable(|| Source::from_bytes("a.jpg", input.to_vec(), Sidecars::default()))
}
