#![allow(clippy::unwrap_used)]
use super::*;
use proptest::prelude::*;

fn same_bits(posts: &[f32], decoded: &[f32]) -> bool {
    posts.iter().zip(decoded).all(|(a, b)| {
        if a.is_nan() { b.to_bits() == f32::NAN.to_bits() } else { a.to_bits() == b.to_bits() }
    })
}

/// A tile from a rule of column and row.
fn posts(rule: impl Fn(usize, usize) -> f32) -> Vec<f32> {
    (0..TILE_AREA).map(|post| rule(post % TILE_POSTS, post / TILE_POSTS)).collect()
}

/// Noise of a number, the same everywhere.
fn noise(number: usize) -> u32 {
    let mixed = (number as u64 ^ 0x5bd1_e995).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    ((mixed ^ mixed >> 29).wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 32) as u32
}

fn rough_metres() -> Vec<f32> {
    posts(|i, j| {
        (1500.0 + 300.0 * libm::sin(i as f64 / 40.0) * libm::cos(j as f64 / 60.0)).round() as f32
            + (noise(i * 1000 + j) % 7) as f32
    })
}

#[track_caller]
fn comes_back(posts: &[f32], step_m: Option<f64>) -> usize {
    let bytes = encode_heights(posts, step_m);
    assert!(bytes.len() <= MAX_TILE_BYTES);
    assert!(same_bits(posts, &decode_posts(&bytes).unwrap()));
    bytes.len()
}

#[test]
fn heights_come_back_bit_for_bit_and_small_where_they_can_be() {
    let metres = comes_back(&rough_metres(), Some(1.0));
    assert!(metres < TILE_AREA, "{metres} bytes for int16 metres");
    assert_eq!(comes_back(&rough_metres(), None), metres, "whole metres are found unasked");
    let tenths = posts(|i, j| (-10000.0 + 0.1 * (100_000 + 37 * i + 11 * j) as f64) as f32);
    assert!(comes_back(&tenths, Some(0.1)) * 10 < comes_back(&tenths, None));
    comes_back(&posts(|i, j| noise(i * 512 + j) as f32 / 1e4 - 1e5), Some(1.0));
    comes_back(&vec![0.0; TILE_AREA], None);
    comes_back(&vec![-0.0; TILE_AREA], Some(1.0));
    comes_back(&posts(|i, j| if i < j { MAX_HEIGHT_M } else { -MAX_HEIGHT_M }), Some(0.001));
    comes_back(&posts(|i, _| f32::from_bits(i as u32)), None);
}

#[test]
fn voids_come_back_as_voids_and_cost_little() {
    let whole = rough_metres();
    let mut holed = whole.clone();
    for (post, height) in holed.iter_mut().enumerate() {
        if post / TILE_POSTS > 100 && post % TILE_POSTS > 130 {
            *height = f32::NAN;
        }
    }
    assert!(comes_back(&holed, Some(1.0)) < comes_back(&whole, Some(1.0)));
    assert!(comes_back(&vec![f32::NAN; TILE_AREA], Some(1.0)) < 200);
    assert!(comes_back(&posts(|i, _| if i == 3 { 1.5 } else { f32::NAN }), None) < 1000);
}

#[test]
fn what_is_no_height_becomes_a_void() {
    let bytes = encode_heights(
        &posts(|i, _| [f32::INFINITY, -3.4e38, 7.0, f32::NEG_INFINITY][i % 4]),
        None,
    );
    let decoded = decode_posts(&bytes).unwrap();
    assert!(decoded[0].is_nan() && decoded[1].is_nan() && decoded[3].is_nan());
    assert_eq!(decoded[2], 7.0);
}

#[test]
fn colors_come_back_and_an_opaque_tile_keeps_no_coverage() {
    let mut colors: Vec<[u8; 4]> = (0..TILE_AREA)
        .map(|post| {
            let [a, b, c, _] = noise(post).to_le_bytes();
            let shade = (post % TILE_POSTS / 2) as u8;
            [shade ^ (a & 3), shade.wrapping_add(b & 7), shade / 2 + (c & 3), 255]
        })
        .collect();
    let opaque = encode_colors(&colors);
    assert_eq!(decode_colors(&opaque).unwrap(), colors);
    assert!(opaque.len() < TILE_AREA * 2, "{} bytes", opaque.len());
    for (post, color) in colors.iter_mut().enumerate() {
        color[3] = noise(post + 99) as u8;
    }
    let covered = encode_colors(&colors);
    assert_eq!(decode_colors(&covered).unwrap(), colors);
    assert!(covered.len() <= MAX_TILE_BYTES);
    let empty = vec![[9, 8, 7, 0]; TILE_AREA];
    assert_eq!(decode_colors(&encode_colors(&empty)).unwrap(), empty);
    assert_eq!(decode_photo(&encode_colors(&empty)).unwrap().texel(-1, 257), [0; 4]);
}

#[test]
fn a_tile_of_the_other_kind_or_version_is_refused() {
    let heights = encode_heights(&vec![1.0; TILE_AREA], None);
    assert_eq!(decode_colors(&heights), Err(CodecError::OtherKind));
    assert!(matches!(decode(&heights), Ok(Tile::Height(_))));
    let photo = encode_colors(&vec![[1; 4]; TILE_AREA]);
    assert_eq!(decode_posts(&photo), Err(CodecError::OtherKind));
    let mut newer = heights.clone();
    newer[4] = 9;
    assert_eq!(decode_posts(&newer), Err(CodecError::OtherVersion { found: 9 }));
    assert_eq!(decode_posts(b"PNG"), Err(CodecError::NotATile));
}

/// A tile whose header says something else, with a check sum that fits.
fn resealed(mut bytes: Vec<u8>, change: impl FnOnce(&mut [u8])) -> Vec<u8> {
    let end = bytes.len() - CHECK_BYTES;
    change(&mut bytes[..end]);
    let check = xxh3_64(&bytes[..end]);
    bytes[end..].copy_from_slice(&check.to_le_bytes());
    bytes
}

#[test]
fn a_well_sealed_lie_is_refused() {
    let good = encode_heights(&rough_metres(), Some(1.0));
    let lie = |change: fn(&mut [u8])| decode_posts(&resealed(good.clone(), change));
    assert!(lie(|_| ()).is_ok());
    assert!(lie(|bytes| bytes[8] = 33).is_err(), "33 bits a post");
    assert!(lie(|bytes| bytes[8] = 31).is_err(), "more planes than there are");
    assert!(lie(|bytes| bytes[9] = 1).is_err(), "a second channel of heights");
    assert!(lie(|bytes| bytes[6] = 2).is_err(), "a colour form");
    assert!(lie(|bytes| bytes[7] |= FLAG_PLAIN).is_err(), "packed, said to be plain");
    assert!(lie(|bytes| bytes[7] |= 128).is_err(), "an unknown flag");
    assert!(lie(|bytes| bytes[16..24].copy_from_slice(&f64::NAN.to_le_bytes())).is_err());
    assert!(lie(|bytes| bytes[16..24].copy_from_slice(&1e300f64.to_le_bytes())).is_err());
    assert!(lie(|bytes| bytes[24..32].copy_from_slice(&i64::MIN.to_le_bytes())).is_err());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn any_bytes_are_survived(bytes in prop::collection::vec(any::<u8>(), 0..600), seal_it: bool) {
        prop_assert!(decode(&bytes).is_err());
        let mut dressed = encode_heights(&vec![5.0; TILE_AREA], None);
        let end = dressed.len() - CHECK_BYTES;
        dressed.splice(5..end, bytes);
        if seal_it && dressed.len() >= HEADER_BYTES + CHECK_BYTES {
            let length = (dressed.len() - HEADER_BYTES - CHECK_BYTES) as u32;
            dressed = resealed(dressed, |front| front[12..16].copy_from_slice(&length.to_le_bytes()));
        }
        let _ = decode(&dressed);
    }

    #[test]
    fn any_cut_and_any_flipped_bit_is_noticed(cut: prop::sample::Index, flip: prop::sample::Index) {
        let bytes = encode_heights(&rough_metres(), None);
        prop_assert!(decode(&bytes[..cut.index(bytes.len())]).is_err());
        let bit = flip.index(bytes.len() * 8);
        let mut flipped = bytes.clone();
        flipped[bit / 8] ^= 1 << (bit % 8);
        prop_assert!(decode(&flipped).is_err());
        let mut longer = bytes;
        longer.push(0);
        prop_assert!(decode(&longer).is_err());
    }

    #[test]
    fn any_body_under_a_good_header_is_survived(at: prop::sample::Index, value: u8) {
        let bytes = encode_colors(&(0..TILE_AREA).map(|post| noise(post).to_le_bytes()).collect::<Vec<_>>());
        let _ = decode(&resealed(bytes, |front| { let at = at.index(front.len()); front[at] = value; }));
        let bytes = encode_heights(&rough_metres(), None);
        let _ = decode(&resealed(bytes, |front| { let at = at.index(front.len()); front[at] = value; }));
    }

    #[test]
    fn any_heights_come_back(seed: usize, shift in 0u32..30, holes in 0u32..4, step in prop::option::of(1e-3..10.0f64)) {
        let posts = posts(|i, j| {
            let value = noise(seed ^ (j * TILE_POSTS + i));
            if holes > 0 && value % 64 < holes { f32::NAN } else { (value >> shift) as i32 as f32 / 256.0 }
        });
        let decoded = decode_posts(&encode_heights(&posts, step)).unwrap();
        let expected: Vec<f32> = posts.iter().map(|&h| if h.abs() <= MAX_HEIGHT_M { h } else { f32::NAN }).collect();
        prop_assert!(same_bits(&expected, &decoded));
    }
}

#[test]
fn tiles_of_version_1_are_read_and_written_as_ever() {
    let heights = include_bytes!("golden-v1-heights.bin");
    assert!(same_bits(&golden_posts(), &decode_posts(heights).unwrap()));
    assert!(encode_heights(&golden_posts(), Some(0.5)) == heights, "the hash of tiles changes");
    let colors = include_bytes!("golden-v1-colors.bin");
    assert!(golden_colors() == decode_colors(colors).unwrap());
    assert!(encode_colors(&golden_colors()) == colors, "the hash of tiles changes");
}

fn golden_posts() -> Vec<f32> {
    posts(
        |i, j| {
            if i < 3 { f32::NAN } else { 100.5 + 0.5 * i as f32 + if j > 200 { 7.0 } else { 0.0 } }
        },
    )
}

fn golden_colors() -> Vec<[u8; 4]> {
    (0..TILE_AREA).map(|post| if post < 9999 { [1, 200, 30, 255] } else { [9, 8, 7, 6] }).collect()
}
