//! SRTM tiles: a name, a line feed, and the first posts of a tile, which is made whole
//! with zeros unless the name says otherwise.

#![no_main]

use terrafarm_fuzz::raster::is_readable;
use terrafarm_raster::{Sidecars, Source};

/// Length of a tile of 3 seconds of arc, bytes.
const TILE_BYTES: usize = 2 * 1201 * 1201;

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    let posts: Vec<u8> = (0..100i16).flat_map(|k| (k * 300).to_be_bytes()).collect();
    let names = ["N34W121.hgt\n", "s01e000.SRTMGL3.HGT\n"];
    names.map(|name| [name.as_bytes(), &posts].concat()).to_vec()
}

fn accepts(input: &[u8]) -> bool {
    let end = input.iter().position(|&byte| byte == b'\n').unwrap_or(input.len());
    let Ok(name) = std::str::from_utf8(&input[..end]) else { return false };
    let mut tile = input.get(end + 1..).unwrap_or_default().to_vec();
    if !name.contains("short") {
        tile.resize(TILE_BYTES, 0);
    }
    is_readable(|| Source::from_bytes(name, tile.clone(), Sidecars::default()))
}
