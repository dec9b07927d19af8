//! Real files, sample by sample against GDAL.

use crate::support::{
    all_colors, all_heights, assert_heights, gdal, gdal_samples, heights_wanted, photo_wanted,
    shared_data,
};
use terrafarm_raster::{Content, OpenOptions, PngEncoding, Vertical, open};

#[test]
fn elevation_files_hold_the_samples_that_gdal_reads() {
    let Some(data) = shared_data().filter(|_| gdal()) else { return };
    let folder = tempfile::tempdir().unwrap();
    for (name, nodata) in [
        ("zion/srtm.tif", 65535.0),
        ("zion/raw/landsat_b2.tif", 65535.0),
        ("rmnp/rmnp-dem.tif", 65535.0),
        ("rmnp/SRTMGL3_40.09_-105.55.asc", 0.0),
        ("santa_barbara/N34W121.hgt.zip", -32768.0),
        ("santa_barbara/N33W121.hgt.zip", -32768.0),
    ] {
        let file = data.join(name);
        let inner = name.rsplit('/').next().unwrap().strip_suffix(".zip");
        let path = file.to_str().unwrap();
        let by_gdal = match inner {
            Some(inner) => format!("/vsizip/{path}/{inner}"),
            None => path.to_owned(),
        };
        let raster = open(&file, &heights_wanted()).unwrap();
        let samples = gdal_samples(&by_gdal, folder.path());
        let expected = samples.into_iter().map(|v| if v == nodata { f64::NAN } else { v });
        let heights = all_heights(&*raster).unwrap();
        assert_heights(&heights, expected, name);
        println!("{name}: {} samples equal", heights.len());
    }
}

#[test]
fn the_usgs_dem_holds_the_samples_that_gdal_reads() {
    let Some(data) = shared_data().filter(|_| gdal()) else { return };
    let folder = tempfile::tempdir().unwrap();
    let file = data.join("helens/SainteHelens.dem");
    let raster = open(&file, &heights_wanted()).unwrap();
    let top = raster.info().transform.unwrap().origin[1];
    // GDAL rounds the corners of the quadrangle outwards, to 468 rows from 5 121 990 m; we
    // keep the rows that profiles reach.
    let first = ((5_121_990.0 - top) / 30.0) as usize;
    let rows = first..first + raster.info().height as usize;
    let samples = gdal_samples(file.to_str().unwrap(), folder.path());
    let (inside, outside): (Vec<_>, Vec<_>) =
        samples.chunks(327).enumerate().partition(|(row, _)| rows.contains(row));
    assert!(outside.iter().all(|(_, row)| row.iter().all(|&value| value == -32767.0)));
    let expected = inside.into_iter().flat_map(|(_, row)| row.iter());
    let expected = expected.map(|&v| if v == -32767.0 { f64::NAN } else { v });
    assert_heights(&all_heights(&*raster).unwrap(), expected, "SainteHelens.dem");
}

#[test]
fn the_places_of_real_files_are_those_of_gdal() {
    let Some(data) = shared_data() else { return };
    for (name, size, origin, crs, vertical) in [
        (
            "zion/srtm.tif",
            [465, 457],
            [-113.239_166_546_1, 37.512_500_096_5],
            "EPSG:4326",
            Vertical::Unknown,
        ),
        (
            "helens/SainteHelens.dem",
            [327, 468],
            [557_820.0, 5_121_990.0],
            "EPSG:26710",
            Vertical::Unknown,
        ),
        (
            "santa_barbara/N34W121.hgt.zip",
            [3601, 3601],
            [-121.0, 35.0],
            "EPSG:4326",
            Vertical::Geoid,
        ),
    ] {
        let raster = open(&data.join(name), &heights_wanted()).unwrap();
        let info = raster.info();
        assert_eq!([info.width, info.height], size, "{name}");
        assert_eq!((info.crs.as_deref(), info.vertical), (Some(crs), vertical), "{name}");
        let found = info.transform.unwrap().origin;
        for axis in [0, 1] {
            assert!((found[axis] - origin[axis]).abs() < 1e-6, "{name}: {found:?}");
        }
    }
}

#[test]
fn photos_hold_the_colours_that_gdal_reads() {
    let Some(data) = shared_data().filter(|_| gdal()) else { return };
    let folder = tempfile::tempdir().unwrap();
    // Decoders of JPEG may differ by rounding.
    for (name, tolerance, nodata) in [
        ("zion/zion_landsat_rgb.tif", 0, None),
        ("rmnp/rmnp-rgb.tif", 0, Some(255.0)),
        ("zion/zion_landsat_rgb.jpg", 4, None),
    ] {
        let file = data.join(name);
        let raster = open(&file, &photo_wanted()).unwrap();
        let colors = all_colors(&*raster).unwrap();
        let samples = gdal_samples(file.to_str().unwrap(), folder.path());
        let count = colors.len();
        let mut void = 0;
        for (k, color) in colors.iter().enumerate() {
            let expected = [0, 1, 2].map(|band| samples[band * count + k]);
            if nodata.is_some_and(|nodata| expected == [nodata; 3]) {
                void += 1;
                assert_eq!(*color, [0; 4], "{name}: pixel {k}");
                continue;
            }
            assert_eq!(color[3], 255, "{name}: pixel {k}");
            for band in 0..3 {
                let distance = (f64::from(color[band]) - expected[band]).abs();
                assert!(
                    distance <= f64::from(tolerance),
                    "{name}: pixel {k} {color:?} {expected:?}"
                );
            }
        }
        assert!(raster.info().transform.is_some(), "{name}");
        println!("{name}: {count} pixels equal within {tolerance}, {void} void");
    }
}

#[test]
fn the_jpeg_lies_where_the_tiff_does() {
    let Some(data) = shared_data() else { return };
    let [tiff, jpeg] = ["tif", "jpg"].map(|extension| {
        let file = data.join(format!("zion/zion_landsat_rgb.{extension}"));
        open(&file, &OpenOptions::default()).unwrap().info().clone()
    });
    assert_eq!(tiff.transform, jpeg.transform);
    assert_eq!((tiff.content, jpeg.content), (Content::Photo, Content::Photo));
}

#[test]
fn a_terrain_rgb_tile_has_the_summit_in_its_place() {
    let Some(data) = shared_data() else { return };
    let options = OpenOptions { web_tile: Some((10, 906, 404)), ..heights_wanted() };
    let raster = open(&data.join("fuji/fuji.png"), &options).unwrap();
    let heights = all_heights(&*raster).unwrap();
    let (at, highest) = heights
        .iter()
        .enumerate()
        .fold((0, 0.0f32), |best, (k, &h)| if h > best.1 { (k, h) } else { best });
    assert!((highest - 3751.0).abs() < 1.0, "{highest}");
    let transform = raster.info().transform.unwrap();
    let edge = 20_037_508.342_789_244;
    let longitude =
        (transform.origin[0] + (at % 512) as f64 * transform.step_column[0]) / edge * 180.0;
    assert!((longitude - 138.7275).abs() < 0.001, "{longitude}");
    assert!(raster.info().format.contains("Terrain-RGB"));
}

#[test]
fn the_pictures_of_srtm_hold_the_heights_of_its_tiles() {
    let Some(data) = shared_data() else { return };
    let options = OpenOptions { png_encoding: PngEncoding::SrtmRgba, ..heights_wanted() };
    for (picture, tile) in [("n34w121.png", "N34W121.hgt.zip"), ("n33w121.png", "N33W121.hgt.zip")]
    {
        let folder = data.join("santa_barbara");
        let picture = open(&folder.join("png").join(picture), &options).unwrap();
        let tile = open(&folder.join(tile), &heights_wanted()).unwrap();
        let expected = all_heights(&*tile).unwrap().into_iter().map(f64::from);
        assert_heights(&all_heights(&*picture).unwrap(), expected, "srtm-rgba");
    }
}
