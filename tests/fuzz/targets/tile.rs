//! Tiles of heights and of colours. What is read can be written again and reads the
//! same, bit for bit.

#![no_main]

use terrafarm_terrain::codec::{
    TILE_AREA, decode, decode_colors, decode_posts, encode_colors, encode_heights,
};
use xxhash_rust::xxh3::xxh3_64;

/// First byte of an input whose length and check sum are set right.
const SEALED: u8 = 1;
const HEADER_BYTES: usize = 32;
const CHECK_BYTES: usize = 8;

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    let heights = |rule: fn(usize) -> f32| (0..TILE_AREA).map(rule).collect::<Vec<f32>>();
    let colors = |rule: fn(usize) -> [u8; 4]| (0..TILE_AREA).map(rule).collect::<Vec<[u8; 4]>>();
    let tiles = [
        encode_heights(&heights(|_| 12.0), Some(1.0)),
        encode_heights(&heights(|k| (k / 259) as f32 * 0.1), Some(0.1)),
        encode_heights(&heights(|k| if k % 259 < 9 { f32::NAN } else { (k / 259) as f32 }), None),
        encode_heights(&heights(|k| if k == 700 { 1.0 / 3.0 } else { 1e-3 }), None),
        encode_colors(&colors(|_| [10, 200, 30, 255])),
        encode_colors(&colors(|k| [(k / 2590) as u8, 0, 9, if k < 518 { 0 } else { 255 }])),
    ];
    let sealed = |tile: &Vec<u8>| [&[SEALED], &tile[..tile.len() - CHECK_BYTES]].concat();
    let plain = |tile: &Vec<u8>| [&[0], &tile[..]].concat();
    tiles.iter().map(sealed).chain(tiles[4..5].iter().map(plain)).collect()
}

fn accepts(input: &[u8]) -> bool {
    let Some((&first, tile)) = input.split_first() else { return false };
    let mut tile = tile.to_vec();
    if first & SEALED != 0 && tile.len() >= HEADER_BYTES {
        let length = (tile.len() - HEADER_BYTES) as u32;
        tile[12..16].copy_from_slice(&length.to_le_bytes());
        let check = xxh3_64(&tile);
        tile.extend(check.to_le_bytes());
    }
    let is_tile = decode(&tile).is_ok();
    let (posts, colors) = (decode_posts(&tile), decode_colors(&tile));
    assert_eq!(is_tile, posts.is_ok() || colors.is_ok());
    if let Ok(posts) = posts {
        let again = decode_posts(&encode_heights(&posts, Some(0.1))).expect("an honest tile");
        let same = |(one, other): (&f32, &f32)| {
            one.to_bits() == other.to_bits() || one.is_nan() && other.is_nan()
        };
        assert!(posts.iter().zip(&again).all(same), "a height changed");
    }
    if let Ok(colors) = colors {
        assert!(decode_colors(&encode_colors(&colors)) == Ok(colors), "a colour changed");
    }
    is_tile
}
