//! Size and speed of the tile encoding.
//!
//! `cargo run --release -p terrafarm-terrain --example codec_speed -- FILE` cuts an SRTM
//! file (.hgt, big-endian int16, square) or a photo (.ppm, 8 bits) into tiles and prints
//! bytes a post and millions of posts a second; heights as they are, and interpolated
//! between posts as reprojection does.

use std::time::Instant;
use terrafarm_terrain::codec::{
    TILE_AREA, decode, decode_colors, decode_posts, encode_colors, encode_heights,
};
use terrafarm_terrain::layout::{TILE_CELLS, TILE_POSTS};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args().nth(1).ok_or("which .hgt or .ppm file?")?;
    let bytes = std::fs::read(&path)?;
    if bytes.starts_with(b"P6") {
        return photo(&bytes);
    }
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
        let tiles = cut(heights, side, side);
        measure(name, &tiles, |tile| encode_heights(tile, None), |b| decode_posts(b).is_ok());
    }
    Ok(())
}

fn photo(bytes: &[u8]) -> Result<(), Box<dyn std::error::Error>> {
    let mut words = bytes.splitn(5, |byte| byte.is_ascii_whitespace()).skip(1);
    let mut number = || -> Result<usize, Box<dyn std::error::Error>> {
        Ok(std::str::from_utf8(words.next().ok_or("the header is cut short")?)?.parse()?)
    };
    let (width, height, _largest) = (number()?, number()?, number()?);
    let pixels = &bytes[bytes.len() - width * height * 3..];
    let colors: Vec<[u8; 4]> = pixels.chunks_exact(3).map(|p| [p[0], p[1], p[2], 255]).collect();
    let tiles = cut(&colors, width, height);
    measure("photo", &tiles, encode_colors, |bytes| decode_colors(bytes).is_ok());
    Ok(())
}

fn cut<T: Copy>(grid: &[T], width: usize, height: usize) -> Vec<Vec<T>> {
    let mut tiles = Vec::new();
    for j in (0..=height - TILE_POSTS).step_by(TILE_CELLS) {
        for i in (0..=width - TILE_POSTS).step_by(TILE_CELLS) {
            let rows = (j..j + TILE_POSTS).flat_map(|row| &grid[row * width + i..][..TILE_POSTS]);
            tiles.push(rows.copied().collect());
        }
    }
    tiles
}

fn measure<T>(
    name: &str,
    tiles: &[Vec<T>],
    encode: impl Fn(&[T]) -> Vec<u8>,
    is_sound: impl Fn(&[u8]) -> bool,
) {
    let posts = (tiles.len() * TILE_AREA) as f64;
    let rate = |start: Instant| posts * 1e-6 / start.elapsed().as_secs_f64();
    let start = Instant::now();
    let encoded: Vec<Vec<u8>> = tiles.iter().map(|tile| encode(tile)).collect();
    let encode = rate(start);
    let start = Instant::now();
    let sound = encoded.iter().filter(|bytes| is_sound(bytes)).count();
    let decode_only = rate(start);
    let start = Instant::now();
    let ready = encoded.iter().filter(|bytes| decode(bytes).is_ok()).count();
    let for_use = rate(start);
    assert_eq!((sound, ready), (tiles.len(), tiles.len()));
    let size = encoded.iter().map(Vec::len).sum::<usize>() as f64 / posts;
    println!(
        "{name}: {size:.3} bytes a post; million posts a second: encode {encode:.0}, decode {decode_only:.0}, ready for use {for_use:.0}"
    );
}
