//! The files beside a picture: world file, .prj and .aux.xml, with a zero byte between.

#![no_main]

use terrafarm_fuzz::raster::corner_is_readable;
use terrafarm_raster::{OpenOptions, Sidecars, Source, open_source};

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    let seeds = [
        "30.0\r\n0\r\n0\r\n-30.0\r\n301920.0\r\n4154070.0\r\n\0EPSG:32612\0",
        "\0\0<PAMDataset>\n<SRS dataAxisToSRSAxisMapping=\"2,1\">GEOGCS[&quot;WGS 84&quot;]</SRS>\
         <GeoTransform> 301905.0, 30, 0, 4154085, 0, -30</GeoTransform></PAMDataset>",
    ];
    seeds.map(|seed| seed.as_bytes().to_vec()).to_vec()
}

fn accepts(input: &[u8]) -> bool {
    let texts = String::from_utf8_lossy(input);
    let mut texts = texts.splitn(3, '\0').map(|text| (!text.is_empty()).then(|| text.to_owned()));
    let mut next = || texts.next().flatten();
    let sidecars = Sidecars { world: next(), prj: next(), aux: next() };
    let raster = open_source(
        Source::from_bytes("a.png", picture(), sidecars),
        &OpenOptions::default(),
    )
    .expect(
        "the picture is sound, and what lies beside it may be useless but no reason to refuse it",
    );
    assert!(corner_is_readable(&*raster));
    raster.info().transform.is_some()
}

/// A PNG of one pixel.
fn picture() -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut writer = png::Encoder::new(&mut bytes, 1, 1).write_header().expect("a header");
    writer.write_image_data(&[7]).expect("one pixel");
    writer.finish().expect("one pixel");
    bytes
}
