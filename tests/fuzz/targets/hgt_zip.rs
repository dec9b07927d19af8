//! Zipped SRTM tiles. The check sum of the archive stays as it is: what is packed reaches
//! the tile only untouched, the archive around it in any shape.

#![no_main]

use std::io::{Cursor, Write};
use terrafarm_fuzz::raster::is_readable;
use terrafarm_raster::{Sidecars, Source};
use zip::write::SimpleFileOptions;

/// Length of a tile of 3 seconds of arc, bytes.
const TILE_BYTES: usize = 2 * 1201 * 1201;

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    let zipped = |name: &str| {
        let mut writer = zip::ZipWriter::new(Cursor::new(Vec::new()));
        let options = SimpleFileOptions::default();
        writer.start_file("readme.txt", options).expect("an archive in memory");
        writer.start_file(name, options).expect("an archive in memory");
        writer.write_all(&vec![0; TILE_BYTES]).expect("an archive in memory");
        writer.finish().expect("an archive in memory").into_inner()
    };
    ["N34W121.hgt", "folder/tile.HGT"].map(zipped).to_vec()
}

fn accepts(input: &[u8]) -> bool {
    is_readable(|| Source::from_bytes("S01E000.zip", input.to_vec(), Sidecars::default()))
}
