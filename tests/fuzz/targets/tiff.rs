//! GeoTIFF, as heights and as a photo.

#![no_main]

use terrafarm_fuzz::raster::is_readable;
use terrafarm_raster::{Sidecars, Source};

/// The writer of small TIFFs that the tests of the crate use.
#[allow(dead_code, reason = "the other things that those tests share")]
#[path = "../../../worker/terrain/raster/tests/raster/support.rs"]
mod support;

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    support::tiff_variants().into_iter().map(support::tiny_tiff).collect()
}

fn accepts(input: &[u8]) -> bool {
    is_readable(|| Source::from_bytes("a.tif", input.to_vec(), Sidecars::default()))
}
