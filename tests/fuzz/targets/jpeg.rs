//! JPEG photos.

#![no_main]

use terrafarm_fuzz::raster::is_readable;
use terrafarm_raster::{Sidecars, Source};

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    vec![jpeg(1, 0x11), jpeg(3, 0x11), jpeg(3, 0x22)]
}

/// A grey picture of 16 x 16 pixels whose only codes are "no change" and "end of block",
/// one zero bit each.
fn jpeg(components: u8, sampling: u8) -> Vec<u8> {
    let mut bytes = vec![0xff, 0xd8];
    let mut segment = |marker: u8, content: &[u8]| {
        bytes.extend([0xff, marker]);
        bytes.extend((content.len() as u16 + 2).to_be_bytes());
        bytes.extend(content);
    };
    segment(0xdb, &[&[0], &[1; 64][..]].concat());
    let frame = (1..=components).flat_map(|id| [id, if id == 1 { sampling } else { 0x11 }, 0]);
    let size = [8, 0, 16, 0, 16, components];
    segment(0xc0, &size.into_iter().chain(frame).collect::<Vec<u8>>());
    for table in [0x00, 0x10] {
        let mut lengths = [0; 16];
        lengths[0] = 1;
        segment(0xc4, &[&[table][..], &lengths, &[0]].concat());
    }
    let scan = (1..=components).flat_map(|id| [id, 0]).chain([0, 63, 0]);
    segment(0xda, &[components].into_iter().chain(scan).collect::<Vec<u8>>());
    let blocks = match sampling {
        0x22 => 6,
        _ => 4 * u32::from(components),
    };
    let bits = 2 * blocks;
    bytes.extend(vec![0; (bits / 8) as usize]);
    if bits % 8 != 0 {
        bytes.push(0xff >> (bits % 8));
    }
    bytes.extend([0xff, 0xd9]);
    bytes
}

fn accepts(input: &[u8]) -> bool {
    is_readable(|| Source::from_bytes("a.jpg", input.to_vec(), Sidecars::default()))
}
