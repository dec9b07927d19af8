//! Photos from rasters in memory.

#![allow(clippy::unwrap_used, missing_docs)]

mod common;

use common::{Imported, MemoryRaster, import, shared, try_import};
use terrafarm_geo::Crs;
use terrafarm_import::{ImportError, ImportSettings, Sources};
use terrafarm_terrain::layout::LayerKind;

const UTM: &str = "EPSG:32612";

fn ground() -> MemoryRaster {
    MemoryRaster::heights(UTM, [400_000.0, 4_010_000.0], [50.0, 50.0], [201, 201], |_, _| 9.0)
}

fn with_photos(photos: Vec<MemoryRaster>) -> Result<Imported, ImportError> {
    let sources =
        Sources { elevation: shared(vec![ground()]), photos: shared(photos), ..Sources::default() };
    try_import(sources, &ImportSettings::default())
}

/// The tile decoder's linear light of an opaque sRGB value.
fn linear(value: u8) -> f64 {
    let v = f64::from(value) / 255.0;
    let linear = if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) };
    linear * 65535.0
}

#[test]
fn a_photo_on_the_stores_grid_keeps_its_pixels() {
    let color = |c: u64, r: u64| [(c % 256) as u8, (r % 256) as u8, 77, 255];
    let photo = MemoryRaster::photo(UTM, [401_000.0, 4_009_000.0], [10.0, 10.0], [300, 200], color);
    let store = with_photos(vec![photo]).unwrap();
    let layer = store.layer(1).clone();
    assert_eq!((layer.kind, layer.posts), (LayerKind::Photo, [300, 200]));
    for (n, texel) in store.texels(1).into_iter().enumerate() {
        let expected = color((n % 300) as u64, 199 - (n / 300) as u64);
        assert_eq!(texel[3], 65535);
        for band in 0..3 {
            assert!((f64::from(texel[band]) - linear(expected[band])).abs() < 2.0);
        }
    }
    assert!(store.summary.report.inputs[1].contains("covers part"));
}

#[test]
fn a_geographic_photo_is_warped_to_where_it_belongs() {
    let crs = Crs::parse(UTM).unwrap();
    let [west, north] = crs.to_lonlat([401_000.0, 4_009_000.0]).unwrap();
    // Red grows with the longitude, green with the latitude.
    let step = 2e-4;
    let color = |c: u64, r: u64| [c as u8, r as u8, 0, 255];
    let photo = MemoryRaster::photo("EPSG:4326", [west, north], [step, step], [250, 250], color);
    let store = with_photos(vec![photo]).unwrap();
    let layer = store.layer(1).clone();
    assert!(layer.spacing[0] <= 2e-4 * 111_000.0 * 0.82 && layer.spacing[0] == layer.spacing[1]);
    let mut covered = 0;
    for (n, texel) in store.texels(1).into_iter().enumerate() {
        let i = n as u64 % layer.posts[0];
        let j = n as u64 / layer.posts[0];
        let xy = [
            layer.origin[0] + i as f64 * layer.spacing[0],
            layer.origin[1] + j as f64 * layer.spacing[1],
        ];
        let [longitude, latitude] = crs.to_lonlat(xy).unwrap();
        let (u, v) = ((longitude - west) / step, (north - latitude) / step);
        let inside = (0.01..248.99).contains(&u) && (0.01..248.99).contains(&v);
        let outside = !(-0.01..249.01).contains(&u) || !(-0.01..249.01).contains(&v);
        if inside {
            covered += 1;
            assert_eq!(texel[3], 65535);
            let range =
                |w: f64| (linear((w - 0.51) as u8) - 2.0)..=(linear((w + 0.51) as u8) + 2.0);
            assert!(range(u).contains(&f64::from(texel[0])), "{u}: {texel:?}");
            assert!(range(v).contains(&f64::from(texel[1])), "{v}: {texel:?}");
        } else if outside {
            assert_eq!(texel, [0; 4]);
        }
    }
    assert!(covered > 40_000, "{covered}");
}

#[test]
fn photos_of_one_resolution_share_a_layer_and_finer_ones_have_their_own() {
    let photo = |west: f64, step: f64, value: u8| {
        let north_west = [west, 4_008_000.0];
        MemoryRaster::photo(UTM, north_west, [step, step], [100, 100], move |_, _| {
            [value, 0, 0, 255]
        })
    };
    let photos =
        vec![photo(402_000.0, 1.0, 50), photo(401_000.0, 10.0, 10), photo(402_000.0, 10.0, 20)];
    let store = with_photos(photos).unwrap();
    let layers: Vec<[f64; 2]> = store.reader.index().layers.iter().map(|l| l.spacing).collect();
    assert_eq!(layers, [[50.0; 2], [10.0; 2], [1.0; 2]]);
    assert_eq!(store.layer(1).posts, [200, 100]);
}

#[test]
fn the_later_photo_lies_on_top_where_it_has_coverage() {
    let below = MemoryRaster::photo(UTM, [401_000.0, 4_009_000.0], [10.0; 2], [50, 50], |_, _| {
        [255, 0, 0, 255]
    });
    let above = MemoryRaster::photo(UTM, [401_000.0, 4_009_000.0], [10.0; 2], [50, 50], |c, _| {
        [0, 255, 0, if c < 25 { 255 } else { 0 }]
    });
    let store = with_photos(vec![below, above]).unwrap();
    let texels = store.texels(1);
    assert_eq!((texels[0], texels[49]), ([0, 65535, 0, 65535], [65535, 0, 0, 65535]));
}

#[test]
fn a_photo_is_cut_to_the_terrain() {
    let photo =
        MemoryRaster::photo(UTM, [390_000.0, 4_020_000.0], [100.0; 2], [400, 400], |_, _| {
            [9, 9, 9, 255]
        });
    let store = with_photos(vec![photo]).unwrap();
    assert_eq!(store.layer(1).posts, [101, 101]);
    assert!(!store.summary.report.inputs[1].contains("covers part"));
}

#[test]
fn a_photo_of_elsewhere_is_refused_with_both_extents() {
    let photo =
        MemoryRaster::photo(UTM, [500_000.0, 4_009_000.0], [10.0; 2], [50, 50], |_, _| [9; 4]);
    let error = with_photos(vec![photo]).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("500000 to 500490") && error.contains("400000 to 410000"), "{error}");
}

#[test]
fn a_single_pixel_is_a_photo() {
    let photo = MemoryRaster::photo(UTM, [401_000.0, 4_009_000.0], [10.0; 2], [1, 1], |_, _| {
        [9, 9, 9, 255]
    });
    assert_eq!(with_photos(vec![photo]).unwrap().layer(1).posts, [1, 1]);
    let store = import(
        Sources { elevation: shared(vec![ground()]), ..Sources::default() },
        &ImportSettings::default(),
    );
    assert_eq!(store.reader.index().layers.len(), 1);
}
