//! ESRI ASCII grids.

#![no_main]

use terrafarm_fuzz::raster::is_readable;
use terrafarm_raster::{Sidecars, Source};

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    let grids = [
        "ncols 3\nnrows 2\nxllcorner 500000\nyllcorner 4e6\ncellsize 30\nNODATA_value -9999\n1 2 3\n4.5 -9999 6e0\n",
        "NCOLS 2\r\nNROWS 2\r\nXLLCENTER 7.5\r\nYLLCENTER 47\r\nDX 0.5\r\nDY 0.25\r\n1 2\r\n3 4\r\n",
    ];
    grids.map(|grid| grid.as_bytes().to_vec()).to_vec()
}

fn accepts(input: &[u8]) -> bool {
    is_readable(|| Source::from_bytes("a.asc", input.to_vec(), Sidecars::default()))
}
