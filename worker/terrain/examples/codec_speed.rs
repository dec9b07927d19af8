//! Size and speed of the tile encoding: `cargo run --release -p terrafarm-terrain
//! --example codec_speed -- FILE.hgt` cuts an SRTM file (big-endian int16, square) into
//! tiles and prints bytes a post and MB of f32 heights a second, for heights as they are
//! and for the same turned by a fraction of a post (as reprojection does).

use std::time::Instant;
use terrafarm_terrain::codec::{TILE_AREA, decode_heights, decode_posts, encode_heights};
use terrafarm_terrain::layout::{TILE_CELLS, TILE_POSTS};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args().nth(1).ok_or("which .hgt file?")?;
    let bytes = std::fs::read(&path)?;
    let side = (bytes.len() / 2).isqrt();
    let heights: Vec<f32> = bytes
        .chunks_exact(2)
        .map(|pair| i16::from_be_bytes([pair[0], pair[1]]))
        .map(|metres| if metres == i16::MIN { f32::NAN } else { metres.into() })
        .collect();
    let between = |at: usize| heights[at] * 0.7 + heights[at + 1] * 0.3;
    let resampled: Vec<f32> = (0..heights.len() - 1).map(between).chain([0.0]).collect();
    let rounded: Vec<f32> = resampled.iter().map(|h| (h * 16.0).round() / 16.0).collect();
    for (name, heights) in [
        ("whole metres", &heights),
        ("resampled, f32", &resampled),
        ("resampled, 1/16 m", &rounded),
    ] {
        measure(name, heights, side);
    }
    Ok(())
}

fn measure(name: &str, heights: &[f32], side: usize) {
    let mut tiles = Vec::new();
    for j in (0..side - TILE_POSTS).step_by(TILE_CELLS) {
        for i in (0..side - TILE_POSTS).step_by(TILE_CELLS) {
            let rows = (j..j + TILE_POSTS).flat_map(|row| &heights[row * side + i..][..TILE_POSTS]);
            tiles.push(rows.copied().collect::<Vec<f32>>());
        }
    }
    let posts = (tiles.len() * TILE_AREA) as f64;
    let rate = |start: Instant| posts * 4e-6 / start.elapsed().as_secs_f64();
    let start = Instant::now();
    let encoded: Vec<_> = tiles.iter().map(|tile| encode_heights(tile, None)).collect();
    let encode = rate(start);
    let start = Instant::now();
    let sound = encoded.iter().filter(|bytes| decode_posts(bytes).is_ok()).count();
    let decode = rate(start);
    let start = Instant::now();
    let ready = encoded.iter().filter(|bytes| decode_heights(bytes).is_ok()).count();
    let with_maxima = rate(start);
    assert_eq!((sound, ready), (tiles.len(), tiles.len()));
    let size = encoded.iter().map(Vec::len).sum::<usize>() as f64 / posts;
    println!(
        "{name}: {size:.3} bytes a post; encode {encode:.0}, decode {decode:.0}, with maxima {with_maxima:.0} MB/s"
    );
}
