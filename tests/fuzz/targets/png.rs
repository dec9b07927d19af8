//! PNG as heights in every encoding and as a photo: first byte the encoding, then the
//! file. Its check sums are not looked at, see `--cfg fuzzing` in the crate png.

#![no_main]

use png::{BitDepth, ColorType};
use terrafarm_fuzz::raster::corner_is_readable;
use terrafarm_raster::{Content, OpenOptions, PngEncoding, Sidecars, Source, open_source};

const ENCODINGS: [PngEncoding; 5] = [
    PngEncoding::Auto,
    PngEncoding::TerrainRgb,
    PngEncoding::Terrarium,
    PngEncoding::Grey16,
    PngEncoding::SrtmRgba,
];

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    let picture = |encoding: u8, color, depth, sample_bytes: usize| {
        let mut bytes = vec![encoding];
        let mut encoder = png::Encoder::new(&mut bytes, 3, 2);
        encoder.set_color(color);
        encoder.set_depth(depth);
        if color == ColorType::Indexed {
            encoder.set_palette(vec![9; 768]);
            encoder.set_trns(vec![0, 255]);
        }
        let mut writer = encoder.write_header().expect("a header in memory");
        let samples: Vec<u8> = (0..6 * sample_bytes).map(|k| [1, 134, 160, 255][k % 4]).collect();
        writer.write_image_data(&samples).expect("six pixels");
        writer.finish().expect("six pixels");
        bytes
    };
    let (eight, sixteen) = (BitDepth::Eight, BitDepth::Sixteen);
    vec![
        picture(0, ColorType::Grayscale, sixteen, 2),
        picture(1, ColorType::Rgb, eight, 3),
        picture(2, ColorType::Rgba, eight, 4),
        picture(3, ColorType::Grayscale, sixteen, 2),
        picture(4, ColorType::Rgba, eight, 4),
        picture(0, ColorType::Indexed, eight, 1),
        picture(0, ColorType::GrayscaleAlpha, eight, 2),
        picture(0, ColorType::Rgb, sixteen, 6),
    ]
}

fn accepts(input: &[u8]) -> bool {
    let Some((&first, file)) = input.split_first() else { return false };
    let png_encoding = ENCODINGS[usize::from(first) % ENCODINGS.len()];
    let read = [Content::Heights, Content::Photo].map(|content| {
        let options = OpenOptions { content: Some(content), png_encoding, ..Default::default() };
        let source = Source::from_bytes("10-300-400.png", file.to_vec(), Sidecars::default());
        open_source(source, &options).is_ok_and(|raster| corner_is_readable(&*raster))
    });
    read.contains(&true)
}
