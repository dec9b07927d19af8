//! Damaged, cut and hostile files give an error or a raster, never a panic.

use crate::support::{
    TiffVariant, all_colors, all_heights, heights_wanted, memory, photo_wanted, tiff_variants,
    tiny_jpeg, tiny_tiff,
};
use proptest::prelude::*;
use terrafarm_raster::{OpenOptions, RasterError, Window, open_source};

/// Opens bytes under a name and reads a corner, whatever they are.
fn attempt(name: &str, bytes: &[u8]) -> Result<(), RasterError> {
    for options in [heights_wanted(), photo_wanted()] {
        let Ok(raster) = open_source(memory(name, bytes.to_vec()), &options) else { continue };
        let (width, height) = (raster.info().width.min(40), raster.info().height.min(40));
        let window = Window {
            column: raster.info().width - width,
            row: raster.info().height - height,
            width: width as usize,
            height: height as usize,
        };
        let _ = raster.read_heights(window, &mut vec![0.0; (width * height) as usize]);
        let _ = raster.read_colors(window, &mut vec![[0; 4]; (width * height) as usize]);
    }
    open_source(memory(name, bytes.to_vec()), &heights_wanted())
        .and_then(|raster| all_heights(&*raster))
        .map(|_| ())
}

const TILED: TiffVariant =
    TiffVariant { big_endian: false, big_tiff: false, tiled: true, compression: 8, floats: true };

#[test]
fn every_variant_of_the_small_tiff_holds_its_samples_and_its_place() {
    for variant in tiff_variants() {
        let raster = open_source(memory("a.tif", tiny_tiff(variant)), &heights_wanted()).unwrap();
        let heights = all_heights(&*raster).unwrap();
        for (k, height) in heights.iter().enumerate() {
            let expected = (k % 20 + 100 * (k / 20)) as f32;
            if expected == 105.0 {
                assert!(height.is_nan(), "{variant:?}");
            } else {
                assert_eq!(*height, expected, "{variant:?}");
            }
        }
        let info = raster.info();
        assert_eq!(info.transform.unwrap().origin, [500_015.0, 3_999_985.0], "{variant:?}");
        assert_eq!(info.crs.as_deref(), Some("EPSG:32612"), "{variant:?}");
    }
}

#[test]
fn another_decoder_reads_the_small_tiffs_alike() {
    for variant in tiff_variants().into_iter().filter(|variant| !variant.tiled) {
        let mut decoder =
            tiff::decoder::Decoder::new(std::io::Cursor::new(tiny_tiff(variant))).unwrap();
        let samples: Vec<f32> = match decoder.read_image().unwrap() {
            tiff::decoder::DecodingResult::U16(samples) => {
                samples.into_iter().map(f32::from).collect()
            }
            tiff::decoder::DecodingResult::F32(samples) => samples,
            _ => panic!("{variant:?}"),
        };
        let expected: Vec<f32> = (0..200).map(|k| (k % 20 + 100 * (k / 20)) as f32).collect();
        assert_eq!(samples, expected, "{variant:?}");
    }
}

#[test]
fn every_truncation_of_a_tiff_is_an_error() {
    for variant in tiff_variants() {
        let bytes = tiny_tiff(variant);
        for cut in 0..bytes.len() {
            assert!(attempt("a.tif", &bytes[..cut]).is_err(), "{variant:?} cut at {cut}");
        }
    }
}

#[test]
fn every_flipped_bit_of_a_tiff_gives_a_raster_or_an_error() {
    for (big_tiff, tiled) in [(false, false), (false, true), (true, true)] {
        let bytes = tiny_tiff(TiffVariant { big_tiff, tiled, ..TILED });
        for bit in 0..bytes.len() * 8 {
            let mut bytes = bytes.clone();
            bytes[bit / 8] ^= 1 << (bit % 8);
            let _ = attempt("a.tif", &bytes);
        }
    }
}

/// Replaces the value of a directory entry of a little-endian classic TIFF.
fn with_tag(mut bytes: Vec<u8>, tag: u16, value: u32) -> Vec<u8> {
    let at = u32::from_le_bytes(bytes[4..8].try_into().unwrap()) as usize + 2;
    let entry = bytes[at..].chunks(12).position(|entry| entry[..2] == tag.to_le_bytes()).unwrap();
    let at = at + entry * 12;
    bytes[at + 2..at + 12]
        .copy_from_slice(&[&[4, 0, 1, 0, 0, 0], &value.to_le_bytes()[..]].concat());
    bytes
}

#[test]
fn hostile_sizes_are_refused_with_a_reason() {
    let bytes = tiny_tiff(TILED);
    for (tag, value, reason) in [
        (256, 1_000_000_000, "at most"),
        (257, 60_000_000, "tag 324 lists"),
        (322, 1_000_000_000, "too large"),
        (324, 0xffff_ff00, "tag 324 lists"),
        (259, 50000, "gdal_translate"),
        (259, 7, "JPEG"),
        (317, 9, "predictor 9"),
        (258, 64, "cannot be decoded"),
        (258, 12, "12-bit"),
    ] {
        let damaged = if tag == 317 {
            // There is no predictor tag to replace: take that of the nodata value.
            let mut bytes = with_tag(bytes.clone(), 42113, value);
            let at = bytes.windows(2).rposition(|pair| pair == 42113u16.to_le_bytes()).unwrap();
            bytes[at..at + 2].copy_from_slice(&317u16.to_le_bytes());
            bytes
        } else {
            with_tag(bytes.clone(), tag, value)
        };
        let error = attempt("a.tif", &damaged).unwrap_err().to_string();
        assert!(error.contains(reason), "tag {tag} = {value}: {error}");
        assert!(error.starts_with("a.tif: "), "{error}");
    }
}

#[test]
fn a_jpeg_that_declares_more_pixels_than_its_bytes_can_hold_is_refused() {
    for sampling in [0x11, 0x22] {
        let bytes = tiny_jpeg(3, sampling);
        let raster = open_source(memory("a.jpg", bytes.clone()), &photo_wanted()).unwrap();
        assert_eq!(all_colors(&*raster).unwrap(), [[128, 128, 128, 255]; 256]);
        let mut hostile = bytes;
        let size = hostile.windows(4).position(|bytes| bytes == [0, 16, 0, 16]).unwrap();
        hostile[size..size + 4].copy_from_slice(&[0x40, 0, 0x40, 0]);
        let error = open_source(memory("a.jpg", hostile), &photo_wanted()).err().unwrap();
        assert!(error.to_string().contains("cannot be in a file"), "{error}");
    }
}

#[test]
fn a_jpeg_whose_first_component_has_fewer_samples_than_another_is_refused() {
    let mut bytes = tiny_jpeg(3, 0x11);
    let frame = bytes.windows(4).position(|bytes| bytes == [0, 16, 0, 16]).unwrap();
    bytes[frame + 9] = 0x24;
    let error = open_source(memory("a.jpg", bytes), &photo_wanted()).err().unwrap();
    assert!(error.to_string().contains("unusual"), "{error}");
}

#[test]
fn directories_in_a_circle_are_walked_once() {
    let mut bytes = tiny_tiff(TILED);
    let first = bytes[4..8].to_vec();
    let end = bytes.len();
    bytes[end - 4..].copy_from_slice(&first);
    assert!(attempt("a.tif", &bytes).is_ok());
    // Nothing but overviews, in a circle.
    let overviews = with_tag(bytes, 262, 1);
    let at = overviews.windows(2).rposition(|pair| pair == 262u16.to_le_bytes()).unwrap();
    let mut overviews = overviews;
    overviews[at..at + 2].copy_from_slice(&254u16.to_le_bytes());
    let error = attempt("a.tif", &overviews).unwrap_err().to_string();
    assert!(error.contains("full resolution"), "{error}");
}

#[test]
fn a_block_that_is_left_out_is_void() {
    let bytes = tiny_tiff(TILED);
    let at = bytes.len() - 4 - 12 * 14;
    let entry =
        bytes[at..].chunks(12).position(|entry| entry[..2] == 325u16.to_le_bytes()).unwrap();
    let table = &bytes[at + entry * 12 + 8..][..4];
    let lengths = u32::from_le_bytes(table.try_into().unwrap()) as usize;
    let mut sparse = bytes;
    sparse[lengths + 4..lengths + 8].fill(0);
    let raster = open_source(memory("a.tif", sparse), &heights_wanted()).unwrap();
    let heights = all_heights(&*raster).unwrap();
    assert!(
        heights.iter().enumerate().all(|(k, height)| height.is_nan() == (k % 20 >= 16 || k == 25))
    );
}

#[test]
fn a_window_outside_the_raster_is_refused() {
    let raster = open_source(memory("a.tif", tiny_tiff(TILED)), &heights_wanted()).unwrap();
    for (column, row, width, height, room) in [
        (20, 0, 1, 1, 1),
        (0, 9, 1, 2, 2),
        (u64::MAX, 0, 2, 1, 2),
        (0, 0, 2, 2, 3),
        (0, 0, usize::MAX, 2, 4),
    ] {
        let window = Window { column, row, width, height };
        assert!(raster.read_heights(window, &mut vec![0.0; room]).is_err());
    }
    let nothing = Window { column: 20, row: 10, width: 0, height: 0 };
    assert!(raster.read_heights(nothing, &mut []).is_ok());
    let error = raster.read_colors(nothing, &mut []).unwrap_err().to_string();
    assert!(error.contains("the file is heights"), "{error}");
}

#[test]
fn an_unknown_file_says_what_is_read_and_how_to_convert_it() {
    for bytes in [&b"<VRTDataset>"[..], b"SQLite format 3\0", b"", b"\0\0\0", b"hello"] {
        let error =
            open_source(memory("a.xyz", bytes.to_vec()), &OpenOptions::default()).err().unwrap();
        assert!(error.to_string().starts_with("a.xyz: "), "{error}");
    }
}

proptest! {
    #[test]
    fn random_bytes_behind_every_magic_number_give_a_raster_or_an_error(
        tail in proptest::collection::vec(any::<u8>(), 0..300),
        directory in proptest::collection::vec((0usize..24, 1u16..14, 0u32..70, any::<u32>()), 0..20),
    ) {
        for magic in [&b"II*\0"[..], b"MM\0*", b"II+\0\x08\0\0\0", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0",
            b"\xff\xd8\xff\xdb", b"PK\x03\x04", b"ncols 3 nrows 2 cellsize 1 xllcorner 0 yllcorner 0 ", b""] {
            let bytes = [magic, &tail].concat();
            let _ = attempt("a.bin", &bytes);
            let _ = attempt("N34W121.hgt", &bytes);
        }
        // A directory of plausible tags with random values.
        const TAGS: [u16; 24] = [254, 256, 257, 258, 259, 262, 273, 277, 278, 279, 284, 317, 320, 322,
            323, 324, 325, 338, 339, 33550, 33922, 34264, 34735, 34736];
        let mut bytes = b"II*\0\x08\0\0\0".to_vec();
        bytes.extend((directory.len() as u16).to_le_bytes());
        for (tag, kind, count, value) in directory {
            bytes.extend([TAGS[tag].to_le_bytes(), kind.to_le_bytes()].concat());
            bytes.extend([count.to_le_bytes(), (value % 400).to_le_bytes()].concat());
        }
        bytes.extend([&[0; 4], &tail[..]].concat());
        let _ = attempt("a.tif", &bytes);
    }
}
