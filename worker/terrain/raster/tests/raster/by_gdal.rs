//! GeoTIFF files as GDAL writes them.

use crate::support::{
    all_colors, all_heights, assert_heights, gdal, gdal_samples, heights_wanted, photo_wanted, run,
};
use std::path::Path;
use terrafarm_raster::{HeightUnit, OpenOptions, Vertical, open};

const WIDTH: usize = 203;
const HEIGHT: usize = 131;
const NODATA: f64 = -9999.0;

/// Writes a raw grid with a void corner that GDAL reads by its header: `terrain.bin`.
fn write_terrain(
    folder: &Path,
    bands: usize,
    value: impl Fn(usize, usize, usize) -> f32,
) -> String {
    let raw = folder.join("terrain.bin");
    let mut bytes = Vec::new();
    for band in 0..bands {
        for row in 0..HEIGHT {
            bytes.extend((0..WIDTH).flat_map(|column| value(column, row, band).to_le_bytes()));
        }
    }
    std::fs::write(&raw, bytes).unwrap();
    let header = format!(
        "ENVI\nsamples = {WIDTH}\nlines = {HEIGHT}\nbands = {bands}\ndata type = 4\ninterleave = bsq\n\
         byte order = 0\n"
    );
    std::fs::write(folder.join("terrain.hdr"), header).unwrap();
    raw.to_str().unwrap().to_owned()
}

fn hills(column: usize, row: usize, _: usize) -> f32 {
    if column >= 128 && row >= 64 && row < 128 {
        return NODATA as f32;
    }
    let (x, y) = (column as f32 / 20.0, row as f32 / 15.0);
    1000.25 + 400.0 * x.sin() * y.cos() + ((column * 7919 + row * 104_729) % 97) as f32 / 8.0
}

fn words(text: &str) -> Vec<&str> {
    text.split(' ').filter(|word| !word.is_empty()).collect()
}

#[test]
fn every_type_compression_and_order_holds_the_samples_that_gdal_reads() {
    if !gdal() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let source = write_terrain(folder.path(), 1, hills);
    let out = folder.path().join("out.tif");
    let out = out.to_str().unwrap();
    let mut files = 0;
    for kind in ["Int8", "Byte", "UInt16", "Int16", "UInt32", "Int32", "Float32", "Float64"] {
        let signed = kind == "Int8";
        let typed = if signed { "Byte" } else { kind };
        let scaled = if typed == "Byte" { "-scale 600 1500 10 250" } else { "" };
        let floats = kind.starts_with("Float");
        let mut reference: Vec<f64> = Vec::new();
        for compression in [
            "NONE",
            "PACKBITS",
            "LZW -co PREDICTOR=1",
            "LZW -co PREDICTOR=2",
            "LZW -co PREDICTOR=3",
            "DEFLATE -co PREDICTOR=1",
            "DEFLATE -co PREDICTOR=2",
            "DEFLATE -co PREDICTOR=3",
        ] {
            if compression.ends_with('3') && !floats {
                continue;
            }
            for layout in ["TILED=NO", "TILED=YES -co BLOCKXSIZE=64 -co BLOCKYSIZE=32"] {
                for order in ["LITTLE -co BIGTIFF=NO", "BIG -co BIGTIFF=YES"] {
                    let pixel = if signed { "-co PIXELTYPE=SIGNEDBYTE" } else { "" };
                    let arguments = format!(
                        "-q -ot {typed} {scaled} {pixel} -co COMPRESS={compression} -co {layout} -co ENDIANNESS={order}"
                    );
                    let arguments = [words(&arguments), vec![&source, out]].concat();
                    assert!(run("gdal_translate", &arguments));
                    if reference.is_empty() {
                        reference = gdal_samples(out, folder.path());
                        if signed {
                            reference
                                .iter_mut()
                                .for_each(|v| *v = f64::from(*v as i64 as u8 as i8));
                        }
                    }
                    // GDAL 3.6 writes the planes of predictor 3 in the wrong order into
                    // big-endian files, and reads other values back; so must we.
                    if compression.ends_with('3') {
                        reference = gdal_samples(out, folder.path());
                    }
                    let raster = open(Path::new(out), &heights_wanted()).unwrap();
                    let heights = all_heights(&*raster).unwrap();
                    assert_heights(&heights, reference.iter().copied(), &arguments.join(" "));
                    files += 1;
                }
            }
        }
    }
    println!("{files} files compared");
}

#[test]
fn sparse_files_overviews_scale_and_nodata_are_understood() {
    if !gdal() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let source = write_terrain(folder.path(), 1, hills);
    let out = folder.path().join("out.tif");
    let out = out.to_str().unwrap();
    for (arguments, scale, offset) in [
        (
            "-ot Int16 -a_nodata -9999 -co TILED=YES -co SPARSE_OK=TRUE -co BLOCKXSIZE=64 -co BLOCKYSIZE=64",
            1.0,
            0.0,
        ),
        ("-ot Float32 -a_nodata -9999 -co SPARSE_OK=TRUE -co COMPRESS=LZW", 1.0, 0.0),
        (
            "-ot Float32 -a_nodata -9999 -of COG -co COMPRESS=DEFLATE -co PREDICTOR=YES -co BLOCKSIZE=128 \
          -co SPARSE_OK=TRUE",
            1.0,
            0.0,
        ),
        ("-ot Int16 -a_nodata -9999 -of COG -co COMPRESS=LZW -co BLOCKSIZE=128", 1.0, 0.0),
        ("-ot Int16 -a_nodata -9999 -a_scale 0.1 -a_offset 500", 0.1, 500.0),
        ("-ot Int32 -a_nodata -9999 -a_scale 0.01 -co COMPRESS=DEFLATE", 0.01, 0.0),
    ] {
        let arguments =
            [words("-q -a_srs EPSG:32612 -a_ullr 300000 4200000 306090 4196070"), words(arguments)]
                .concat();
        assert!(run("gdal_translate", &[arguments.clone(), vec![&source, out]].concat()));
        let expected = gdal_samples(out, folder.path())
            .into_iter()
            .map(|value| if value == NODATA { f64::NAN } else { value * scale + offset });
        let raster = open(Path::new(out), &heights_wanted()).unwrap();
        assert_heights(&all_heights(&*raster).unwrap(), expected, &arguments.join(" "));
        assert_eq!(raster.info().transform.unwrap().origin, [300_015.0, 4_199_985.0]);
        assert_eq!(raster.info().crs.as_deref(), Some("EPSG:32612"));
        assert!(raster.info().warnings.is_empty(), "{:?}", raster.info().warnings);
        let whole = !arguments.contains(&"Float32");
        assert_eq!(raster.info().quantum_m, whole.then_some(scale));
    }
}

#[test]
fn posts_areas_rotations_and_south_up_grids_lie_where_gdal_puts_them() {
    if !gdal() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let source = write_terrain(folder.path(), 1, hills);
    let vrt = folder.path().join("placed.vrt");
    let out = folder.path().join("out.tif");
    let [vrt, out] = [&vrt, &out].map(|path| path.to_str().unwrap());
    for [c, a, b, f, d, e] in [
        [300_000.0, 30.0, 0.0, 4_200_000.0, 0.0, -20.0],
        [300_000.0, 30.0, 0.0, 4_200_000.0, 0.0, 20.0],
        [300_000.0, 26.0, 15.0, 4_200_000.0, -15.0, 26.0],
    ] {
        assert!(run("gdal_translate", &["-q", "-of", "VRT", &source, vrt]));
        let text = std::fs::read_to_string(vrt).unwrap();
        let place = format!("<GeoTransform>{c},{a},{b},{f},{d},{e}</GeoTransform><VRTRasterBand");
        std::fs::write(vrt, text.replacen("<VRTRasterBand", &place, 1)).unwrap();
        for meaning in ["AREA_OR_POINT=Area", "AREA_OR_POINT=Point"] {
            let arguments = ["-q", "-a_srs", "EPSG:32612", "-mo", meaning, vrt, out];
            assert!(run("gdal_translate", &arguments));
            let transform =
                open(Path::new(out), &heights_wanted()).unwrap().info().transform.unwrap();
            assert_eq!(transform.step_column, [a, d], "{meaning}");
            assert_eq!(transform.step_row, [b, e], "{meaning}");
            let expected = [c + (a + b) / 2.0, f + (d + e) / 2.0];
            assert_eq!(transform.origin, expected, "{meaning}");
        }
    }
}

#[test]
fn reference_systems_that_gdal_writes_come_back() {
    if !gdal() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let source = write_terrain(folder.path(), 1, hills);
    let out = folder.path().join("out.tif");
    let out = out.to_str().unwrap();
    for (srs, expected) in [
        ("EPSG:4326", "EPSG:4326"),
        ("EPSG:4269", "EPSG:4269"),
        ("EPSG:3857", "EPSG:3857"),
        ("EPSG:2263", "EPSG:2263"),
        ("EPSG:32633+5773", "EPSG:32633"),
        (
            "+proj=tmerc +lat_0=10 +lon_0=20 +k=0.9996 +x_0=1000 +y_0=2000 +datum=WGS84 +units=m",
            "+proj=tmerc +lat_0=10 +lon_0=20 +k=0.9996 +x_0=1000 +y_0=2000 +datum=WGS84 +units=m +no_defs",
        ),
        (
            "+proj=lcc +lat_1=40 +lat_2=50 +lat_0=45 +lon_0=7 +x_0=100 +y_0=200 +ellps=GRS80 +units=m",
            "+proj=lcc +lat_1=40 +lat_2=50 +lat_0=45 +lon_0=7 +x_0=100 +y_0=200 +ellps=GRS80 +units=m +no_defs",
        ),
        (
            "+proj=lcc +lat_1=46.5 +lat_0=46.5 +lon_0=3 +k_0=0.99987742 +x_0=600000 +y_0=200000 +datum=WGS84",
            "+proj=lcc +lat_1=46.5 +lat_0=46.5 +lon_0=3 +k_0=0.99987742 +x_0=600000 +y_0=200000 +datum=WGS84 \
          +units=m +no_defs",
        ),
        (
            "+proj=aea +lat_1=29.5 +lat_2=45.5 +lat_0=23 +lon_0=-96 +x_0=0 +y_0=0 +datum=NAD83",
            "+proj=aea +lat_1=29.5 +lat_2=45.5 +lat_0=23 +lon_0=-96 +x_0=0 +y_0=0 +datum=NAD83 +units=m +no_defs",
        ),
        (
            "+proj=laea +lat_0=52 +lon_0=10 +x_0=4321000 +y_0=3210000 +ellps=GRS80",
            "+proj=laea +lat_0=52 +lon_0=10 +x_0=4321000 +y_0=3210000 +ellps=GRS80 +units=m +no_defs",
        ),
        (
            "+proj=stere +lat_0=90 +lat_ts=71 +lon_0=-45 +datum=WGS84",
            "+proj=stere +lat_0=90 +lat_ts=71 +lon_0=-45 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs",
        ),
        (
            "+proj=merc +lat_ts=5 +lon_0=10 +datum=WGS84",
            "+proj=merc +lat_ts=5 +lon_0=10 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs",
        ),
        (
            "+proj=tmerc +lat_0=40 +lon_0=-100 +k=1 +x_0=304800.6096012192 +y_0=0 +datum=NAD83 +units=us-ft",
            "+proj=tmerc +lat_0=40 +lon_0=-100 +k=1 +x_0=304800.6096012192 +y_0=0 +datum=NAD83 +units=us-ft +no_defs",
        ),
    ] {
        let arguments =
            ["-q", "-ot", "Int16", "-a_srs", srs, "-a_ullr", "0", "10", "10", "0", &source, out];
        assert!(run("gdal_translate", &arguments));
        let raster = open(Path::new(out), &heights_wanted()).unwrap();
        assert_eq!(
            raster.info().crs.as_deref(),
            Some(expected),
            "{srs} {:?}",
            raster.info().warnings
        );
        if srs.ends_with("5773") {
            assert_eq!(raster.info().vertical, Vertical::Geoid);
        }
    }
}

#[test]
fn feet_by_option_become_metres() {
    if !gdal() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let source = write_terrain(folder.path(), 1, |column, row, _| (column + row) as f32);
    let out = folder.path().join("out.tif");
    assert!(run("gdal_translate", &["-q", &source, out.to_str().unwrap()]));
    let options = OpenOptions { unit: Some(HeightUnit::Foot), ..heights_wanted() };
    let heights = all_heights(&*open(&out, &options).unwrap()).unwrap();
    assert_heights(
        &heights,
        (0..WIDTH * HEIGHT).map(|k| (k % WIDTH + k / WIDTH) as f64 * 0.3048),
        "feet",
    );
}

#[test]
fn photos_of_every_layout_hold_the_colours_that_gdal_reads() {
    if !gdal() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let source = write_terrain(folder.path(), 4, |column, row, band| match band {
        3 => {
            if (column / 10 + row / 10) % 2 == 0 {
                255.0
            } else {
                0.0
            }
        }
        _ => ((column * (band + 1) + row * 3) % 250) as f32,
    });
    let out = folder.path().join("out.tif");
    let out = out.to_str().unwrap();
    for (bands, alpha) in [
        ("-b 1", false),
        ("-b 1 -b 4 -colorinterp_2 alpha", true),
        ("-b 1 -b 2 -b 3", false),
        ("-b 1 -b 2 -b 3 -b 4 -colorinterp_4 alpha", true),
        ("-b 1 -b 2 -b 3 -b 4 -co ALPHA=NO", false),
    ] {
        for layout in [
            "INTERLEAVE=PIXEL",
            "INTERLEAVE=BAND -co TILED=YES -co BLOCKXSIZE=64 -co BLOCKYSIZE=64",
            "INTERLEAVE=PIXEL -co COMPRESS=LZW -co PREDICTOR=2",
            "INTERLEAVE=BAND -co COMPRESS=DEFLATE -co PREDICTOR=2",
        ] {
            let arguments = format!("-q -ot Byte {bands} -co {layout}");
            assert!(run("gdal_translate", &[words(&arguments), vec![&source, out]].concat()));
            let samples = gdal_samples(out, folder.path());
            let count = WIDTH * HEIGHT;
            let planes = samples.len() / count;
            let raster = open(Path::new(out), &photo_wanted()).unwrap();
            let colors = all_colors(&*raster).unwrap();
            for (k, color) in colors.iter().enumerate() {
                let at = |band: usize| samples[band * count + k] as u8;
                let rgb = if planes >= 3 { [at(0), at(1), at(2)] } else { [at(0); 3] };
                let expected = match alpha {
                    true if at(planes - 1) == 0 => [0; 4],
                    _ => [rgb[0], rgb[1], rgb[2], 255],
                };
                assert_eq!(*color, expected, "{arguments}: pixel {k}");
            }
        }
    }
}

#[test]
fn a_palette_is_resolved_and_16_bits_are_stretched() {
    if !gdal() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let source = write_terrain(folder.path(), 1, |column, _, _| (column % 3) as f32);
    let (vrt, out) = (folder.path().join("p.vrt"), folder.path().join("out.tif"));
    let [vrt, out] = [&vrt, &out].map(|path| path.to_str().unwrap());
    assert!(run("gdal_translate", &["-q", "-ot", "Byte", "-of", "VRT", &source, vrt]));
    let table = "<ColorInterp>Palette</ColorInterp><ColorTable><Entry c1=\"10\" c2=\"20\" c3=\"30\" c4=\"255\"/>\
                 <Entry c1=\"200\" c2=\"100\" c3=\"50\" c4=\"255\"/><Entry c1=\"1\" c2=\"2\" c3=\"3\" c4=\"255\"/>\
                 </ColorTable>";
    let text = std::fs::read_to_string(vrt).unwrap();
    let at = text.find("<SimpleSource>").or(text.find("<ComplexSource")).unwrap();
    std::fs::write(vrt, format!("{}{table}{}", &text[..at], &text[at..])).unwrap();
    assert!(run("gdal_translate", &["-q", vrt, out]));
    let colors = all_colors(&*open(Path::new(out), &OpenOptions::default()).unwrap()).unwrap();
    assert_eq!(colors[..3], [[10, 20, 30, 255], [200, 100, 50, 255], [1, 2, 3, 255]]);
    // A ramp of 0 to 1010 in steps of 5: the 2nd percentile is 20, the 98th 990.
    let source = write_terrain(folder.path(), 3, |column, _, _| (column * 5) as f32);
    assert!(run("gdal_translate", &["-q", "-ot", "UInt16", &source, out]));
    let colors = all_colors(&*open(Path::new(out), &photo_wanted()).unwrap()).unwrap();
    assert_eq!((colors[0], colors[202]), ([0, 0, 0, 255], [255, 255, 255, 255]));
    assert_eq!(colors[101], [128, 128, 128, 255]);
}

#[test]
fn compressions_that_are_not_read_are_refused_with_the_command_that_helps() {
    if !gdal() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let source = write_terrain(folder.path(), 1, hills);
    for compression in ["JPEG", "ZSTD", "LERC", "LZMA", "WEBP"] {
        let out = folder.path().join(format!("{compression}.tif"));
        let option = format!("COMPRESS={compression}");
        if !run(
            "gdal_translate",
            &["-q", "-ot", "Byte", "-co", &option, &source, out.to_str().unwrap()],
        ) {
            continue;
        }
        let error = open(&out, &heights_wanted()).err().unwrap().to_string();
        let help =
            format!("gdal_translate -co TILED=YES -co COMPRESS=DEFLATE \"{compression}.tif\"");
        assert!(error.contains(&help), "{error}");
    }
}
