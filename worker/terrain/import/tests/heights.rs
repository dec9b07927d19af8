//! Heights from rasters in memory.

#![allow(clippy::unwrap_used, missing_docs)]

mod common;

use common::{MemoryRaster, error_of, import, shared, sources};
use proptest::prelude::*;
use terrafarm_geo::Crs;
use terrafarm_import::{ImportSettings, Sources};
use terrafarm_raster::info::GeoTransform;

const UTM: &str = "EPSG:32612";

/// A wild but repeatable height.
fn noise(x: f64, y: f64) -> f32 {
    let bits = (x * 12.9898 + y * 78.233).to_bits().wrapping_mul(0x9e37_79b9_7f4a_7c15);
    (bits >> 40) as f32 / 1e4
}

fn plain() -> ImportSettings {
    ImportSettings::default()
}

#[test]
fn posts_on_the_stores_grid_are_taken_bit_for_bit() {
    let raster =
        MemoryRaster::heights(UTM, [300_015.5, 4_100_000.25], [30.0, 10.0], [600, 300], noise);
    let samples = raster.heights.clone();
    let store = import(sources(vec![raster]), &plain());
    let layer = store.layer(0);
    assert_eq!(layer.posts, [600, 300]);
    assert_eq!(layer.spacing, [30.0, 10.0]);
    assert_eq!(layer.origin, [300_015.5, 4_100_000.25 - 299.0 * 10.0]);
    let heights = store.heights(0);
    for row in 0..300 {
        for column in 0..600 {
            let post = heights[(299 - row) * 600 + column];
            assert_eq!(post.to_bits(), samples[row * 600 + column].to_bits());
        }
    }
    assert_eq!(store.summary.report.max_resampling_error_m, 0.0);
    assert_eq!(store.reader.index().crs, UTM);
    assert!(store.reader.index().earth_radius_m.unwrap() > 6.3e6);
}

#[test]
fn a_spacing_that_is_asked_for_is_used_and_its_own_is_no_resampling() {
    let raster =
        || MemoryRaster::heights(UTM, [300_015.5, 4_100_000.25], [30.0, 30.0], [60, 30], noise);
    let with = |spacing| ImportSettings { spacing_m: Some(spacing), ..plain() };
    let finer = import(sources(vec![raster()]), &with(12.5));
    assert_eq!(finer.layer(0).spacing, [12.5; 2]);
    assert!(finer.summary.report.max_resampling_error_m > 0.0);
    let own = import(sources(vec![raster()]), &with(30.0));
    assert_eq!(own.summary.report.max_resampling_error_m, 0.0);
    for wrong in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let error = error_of(sources(vec![raster()]), &with(wrong));
        assert!(error.contains("apart"), "{error}");
    }
}

#[test]
fn south_up_and_mirrored_rasters_are_turned_untouched() {
    for (sx, sy) in [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)] {
        let transform = GeoTransform {
            origin: [5000.0, 7000.0],
            step_column: [10.0 * sx, 0.0],
            step_row: [0.0, 10.0 * sy],
        };
        let raster = MemoryRaster::with_transform(UTM, transform, [40, 30], noise);
        let store = import(sources(vec![raster]), &plain());
        let layer = store.layer(0).clone();
        for (n, height) in store.heights(0).into_iter().enumerate() {
            let x = layer.origin[0] + 10.0 * (n % 40) as f64;
            let y = layer.origin[1] + 10.0 * (n / 40) as f64;
            assert_eq!(height, noise(x, y));
        }
    }
}

#[test]
fn a_rotated_raster_is_resampled_to_its_own_surface() {
    let transform = GeoTransform {
        origin: [50_000.0, 70_000.0],
        step_column: [8.0, 6.0],
        step_row: [6.0, -8.0],
    };
    let plane = |x: f64, y: f64| (0.25 * (x - 5e4) - 0.5 * (y - 7e4)) as f32;
    let store = import(
        sources(vec![MemoryRaster::with_transform(UTM, transform, [80, 60], plane)]),
        &plain(),
    );
    assert_eq!(store.layer(0).spacing, [10.0, 10.0]);
    let layer = store.layer(0).clone();
    let mut valid = 0;
    for (n, height) in store.heights(0).into_iter().enumerate() {
        let x = layer.origin[0] + 10.0 * (n as u64 % layer.posts[0]) as f64;
        let y = layer.origin[1] + 10.0 * (n as u64 / layer.posts[0]) as f64;
        if !height.is_nan() {
            valid += 1;
            assert!((height - plane(x, y)).abs() < 1e-2);
        }
    }
    assert!(valid > 4000, "{valid}");
    assert!(store.summary.report.max_resampling_error_m < 0.03);
}

#[test]
fn tiles_of_one_grid_become_one_mosaic_without_gap_and_later_ones_lie_on_top() {
    // The second begins one step east of the first's last column; the third overlaps.
    let a = MemoryRaster::heights(UTM, [0.0, 1000.0], [10.0, 10.0], [50, 101], |_, _| 1.0);
    let b = MemoryRaster::heights(UTM, [500.0, 1000.0], [10.0, 10.0], [51, 101], |_, _| 2.0);
    let c = MemoryRaster::heights(UTM, [400.0, 600.0], [10.0, 10.0], [20, 20], |x, _| {
        if x == 450.0 { f32::NAN } else { 3.0 }
    });
    let store = import(sources(vec![a, b, c]), &plain());
    assert_eq!(store.layer(0).posts, [101, 101]);
    for (n, height) in store.heights(0).into_iter().enumerate() {
        let (x, y) = (10 * (n % 101), 10 * (n / 101));
        let on_top = (400..600).contains(&x) && (410..=600).contains(&y) && x != 450;
        let expected = if on_top {
            3.0
        } else if x < 500 {
            1.0
        } else {
            2.0
        };
        assert_eq!(height, expected, "{x} {y}");
    }
    assert_eq!(store.summary.report.inputs.len(), 3);
    assert_eq!(store.summary.report.max_resampling_error_m, 0.0);
}

#[test]
fn another_phase_is_resampled_to_the_finest_and_never_across_voids() {
    let fine = MemoryRaster::heights(UTM, [0.0, 400.0], [10.0, 10.0], [41, 41], |x, y| {
        (x + 2.0 * y) as f32
    });
    let coarse = MemoryRaster::heights(UTM, [405.0, 415.0], [20.0, 20.0], [21, 21], |x, y| {
        if (x, y) == (605.0, 215.0) { f32::NAN } else { (x + 2.0 * y) as f32 }
    });
    let store = import(sources(vec![fine, coarse]), &plain());
    let layer = store.layer(0).clone();
    assert_eq!(layer.spacing, [10.0, 10.0]);
    for (n, height) in store.heights(0).into_iter().enumerate() {
        let x = layer.origin[0] + 10.0 * (n as u64 % layer.posts[0]) as f64;
        let y = layer.origin[1] + 10.0 * (n as u64 / layer.posts[0]) as f64;
        let in_fine = x <= 400.0 && (0.0..=400.0).contains(&y);
        let in_coarse = (405.0..=805.0).contains(&x) && (15.0..=415.0).contains(&y);
        let near_void = (x - 605.0).abs() < 20.0 && (y - 215.0).abs() < 20.0;
        if in_fine || in_coarse && !near_void {
            assert!((f64::from(height) - (x + 2.0 * y)).abs() < 1e-3, "{x} {y} {height}");
        } else {
            assert!(height.is_nan(), "{x} {y} {height}");
        }
    }
}

/// A one-degree tile with its shared edge samples, as SRTM cuts them.
fn degree_tile(west: f64, north: f64, cells: u64) -> MemoryRaster {
    let step = 1.0 / cells as f64;
    MemoryRaster::heights("EPSG:4326", [west, north], [step, step], [cells + 1; 2], hills)
}

fn hills(longitude: f64, latitude: f64) -> f32 {
    // The same on both sides of the antimeridian.
    let turn = longitude.to_radians();
    (500.0 + 300.0 * (97.0 * turn).sin() * (latitude * 2.0).cos() + 150.0 * (latitude * 31.0).sin())
        as f32
}

/// Every input point, sampled anywhere, must lie within the reported error.
fn assert_within_report(store: &common::Imported, inputs: &[MemoryRaster], seed: u64) {
    let sample = store.sampler(0);
    let crs = Crs::parse(&store.reader.index().crs).unwrap();
    let report = &store.summary.report;
    let mut compared = 0;
    let mut state = seed;
    let mut random = || {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1u64 << 53) as f64
    };
    let mut worst: f64 = 0.0;
    for input in inputs {
        let transform = input.info.transform.unwrap();
        let source = Crs::parse(input.info.crs.as_ref().unwrap()).unwrap();
        for _ in 0..20_000 {
            let u = random() * (input.info.width - 1) as f64;
            let v = random() * (input.info.height - 1) as f64;
            let x = transform.origin[0] + u * transform.step_column[0];
            let y = transform.origin[1] + v * transform.step_row[1];
            let xy = crs.from_lonlat(source.to_lonlat([x, y]).unwrap()).unwrap();
            if let (Some(expected), Some(found)) = (input.bilinear(u, v), sample(xy)) {
                worst = worst.max((expected - found).abs());
                compared += 1;
            }
        }
    }
    assert!(compared > 1000 * inputs.len(), "{compared}");
    assert!(
        worst <= report.max_resampling_error_m + 1e-3,
        "{worst} m off, reported {} m",
        report.max_resampling_error_m
    );
    assert!(report.rms_resampling_error_m <= report.max_resampling_error_m);
    assert!(report.max_resampling_error_m < worst * 3.0 + 0.05, "the report exaggerates");
}

#[test]
fn geographic_tiles_are_reprojected_within_the_reported_error_and_without_seam() {
    let tiles = || vec![degree_tile(-113.0, 38.0, 120), degree_tile(-112.0, 38.0, 120)];
    let store = import(sources(tiles()), &plain());
    assert_eq!(store.reader.index().crs, UTM);
    // 30 arc seconds are 731 m by 925 m here.
    assert_eq!(store.layer(0).spacing, [600.0, 600.0]);
    assert_within_report(&store, &tiles(), 1);
    let sample = store.sampler(0);
    let crs = Crs::parse(UTM).unwrap();
    for n in 0..1000 {
        let place =
            [-112.02 + 0.04 * f64::from(n % 37) / 37.0, 37.05 + 0.9 * f64::from(n) / 1000.0];
        assert!(sample(crs.from_lonlat(place).unwrap()).is_some(), "a hole at {place:?}");
    }
    assert!(store.summary.report.inputs[0].contains("resampled to 600 x 600 m"));
}

#[test]
fn areas_that_abut_without_a_shared_sample_have_no_seam_either() {
    // Samples are the centres of areas: the tiles meet between two columns.
    let step = 1.0 / 120.0;
    let tile = |west: f64| {
        let first = [west + step / 2.0, 38.0 - step / 2.0];
        MemoryRaster::heights("EPSG:4326", first, [step, step], [120, 120], hills)
    };
    let store = import(sources(vec![tile(-113.0), tile(-112.0)]), &plain());
    let sample = store.sampler(0);
    let crs = Crs::parse(UTM).unwrap();
    for n in 0..1000 {
        let place =
            [-112.02 + 0.04 * f64::from(n % 37) / 37.0, 37.05 + 0.9 * f64::from(n) / 1000.0];
        assert!(sample(crs.from_lonlat(place).unwrap()).is_some(), "a hole at {place:?}");
    }
}

#[test]
fn the_antimeridian_is_crossed_however_longitudes_are_counted() {
    for east in [-180.0, 180.0] {
        let tiles = || vec![degree_tile(179.0, 1.0, 60), degree_tile(east, 1.0, 60)];
        let store = import(sources(tiles()), &plain());
        let index = store.reader.index();
        assert!(["EPSG:32660", "EPSG:32601"].contains(&index.crs.as_str()), "{}", index.crs);
        assert!(store.layer(0).posts[0] < 200, "{:?}", store.layer(0).posts);
        let sample = store.sampler(0);
        let crs = Crs::parse(&index.crs).unwrap();
        for n in -90..=90 {
            let place = [180.0 + f64::from(n) / 100.0, 0.5];
            let found = sample(crs.from_lonlat(place).unwrap()).unwrap();
            assert!((found - f64::from(hills(place[0], 0.5))).abs() < 60.0, "{place:?}");
        }
        assert_within_report(&store, &tiles(), 7);
    }
}

#[test]
fn a_polar_cap_is_whole_on_a_polar_grid() {
    // Centres of areas all around the Earth: the lattice must close at 180 degrees.
    let cap = || {
        let height = |longitude: f64, latitude: f64| {
            (1000.0 - 40.0 * (90.0 - latitude) + 5.0 * longitude.to_radians().cos()) as f32
        };
        MemoryRaster::heights("EPSG:4326", [-179.5, 90.0], [1.0, 0.25], [360, 41], height)
    };
    let store = import(sources(vec![cap()]), &plain());
    assert_eq!(store.reader.index().crs, "EPSG:5041");
    let sample = store.sampler(0);
    let crs = Crs::parse("EPSG:5041").unwrap();
    for n in 0..3600 {
        for latitude in [81.0, 85.0, 89.0] {
            let place = [f64::from(n) / 10.0, latitude];
            assert!(sample(crs.from_lonlat(place).unwrap()).is_some(), "a hole at {place:?}");
        }
    }
}

#[test]
fn voids_stay_voids_and_zero_is_sea() {
    let raster = MemoryRaster::heights(UTM, [0.0, 90.0], [10.0, 10.0], [10, 10], |x, y| {
        if x == 30.0 && y == 40.0 { f32::NAN } else { 0.0 }
    });
    let store = import(sources(vec![raster]), &plain());
    assert_eq!(store.summary.report, store.reader.index().report);
    assert_eq!(store.summary.report.void_posts, 1);
    assert_eq!(store.heights(0).iter().filter(|h| h.is_nan()).count(), 1);
    assert_eq!(store.summary.filled_posts, 0);
}

#[test]
fn voids_are_filled_from_their_rim_as_far_as_asked() {
    let plane = |x: f64, y: f64| (0.1 * x + 0.2 * y) as f32;
    let raster = || {
        MemoryRaster::heights(UTM, [0.0, 5990.0], [10.0, 10.0], [600, 600], |x, y| {
            let small = (2500.0..2620.0).contains(&x) && (2500.0..2620.0).contains(&y);
            let large = (4000.0..4600.0).contains(&x) && (4000.0..4600.0).contains(&y);
            if small || large { f32::NAN } else { plane(x, y) }
        })
    };
    let settings = ImportSettings { fill_voids: Some(12), ..plain() };
    let store = import(sources(vec![raster()]), &settings);
    let void = store.heights(0).iter().filter(|h| h.is_nan()).count();
    assert_eq!(store.summary.report, store.reader.index().report);
    assert_eq!(store.summary.report.void_posts, void as u64);
    assert_eq!(store.summary.filled_posts + void as u64, 144 + 3600);
    assert!(void > 1000, "the middle of the large void is out of reach: {void}");
    for (n, height) in store.heights(0).into_iter().enumerate() {
        let (x, y) = (10.0 * (n % 600) as f64, 10.0 * (n / 600) as f64);
        if (2500.0..2620.0).contains(&x) && (2500.0..2620.0).contains(&y) {
            assert!((height - plane(x, y)).abs() < 20.0, "{x} {y} {height}");
        } else if !height.is_nan() && x < 3000.0 {
            assert_eq!(height, plane(x, y));
        }
    }
}

#[test]
fn an_inset_keeps_its_posts_and_joins_the_base_without_a_hole() {
    let base = |x: f64, y: f64| (100.0 + 0.05 * x + 0.03 * y) as f32;
    let fine = |x: f64, y: f64| base(x, y) + 2.0;
    let elevation = MemoryRaster::heights(UTM, [0.0, 3000.0], [30.0, 30.0], [101, 101], base);
    let inset = MemoryRaster::heights(UTM, [1001.0, 1500.0], [2.0, 2.0], [200, 150], |x, y| {
        if (1101.0..1121.0).contains(&x) && y < 1400.0 { f32::NAN } else { fine(x, y) }
    });
    let samples = inset.heights.clone();
    let sources = Sources {
        elevation: shared(vec![elevation]),
        insets: shared(vec![inset]),
        ..Sources::default()
    };
    let store = import(sources, &plain());
    let layer = store.layer(1).clone();
    assert_eq!((layer.posts, layer.spacing), ([202, 152], [2.0, 2.0]));
    let heights = store.heights(1);
    for j in 0..152usize {
        for i in 0..202usize {
            let height = heights[j * 202 + i];
            let x = layer.origin[0] + 2.0 * i as f64;
            let y = layer.origin[1] + 2.0 * j as f64;
            let inner = (1..201).contains(&i) && (1..151).contains(&j);
            let sample = if inner { samples[(150 - j) * 200 + i - 1] } else { f32::NAN };
            if sample.is_nan() {
                // Borrowed heights are rounded to 1/64 m where posts are 2 m apart.
                assert_eq!((height * 64.0).fract(), 0.0);
                let half_step = 0.5 / 64.0;
                assert!((height - base(x, y)).abs() < half_step + 1e-3, "{x} {y}: {height}");
            } else {
                assert_eq!(height.to_bits(), sample.to_bits());
            }
        }
    }
}

#[test]
fn a_finer_inset_within_an_inset_rests_on_it() {
    let level = |height: f32| move |_: f64, _: f64| height;
    let elevation = MemoryRaster::heights(UTM, [0.0, 3000.0], [30.0, 30.0], [101, 101], level(1.0));
    let fine = MemoryRaster::heights(UTM, [1000.0, 2000.0], [5.0, 5.0], [201, 201], level(2.0));
    let finer = MemoryRaster::heights(UTM, [1200.0, 1800.0], [1.0, 1.0], [101, 101], level(3.0));
    let sources = Sources {
        elevation: shared(vec![elevation]),
        insets: shared(vec![finer, fine]),
        ..Sources::default()
    };
    let store = import(sources, &plain());
    let spacings: Vec<f64> = (0..3).map(|n| store.layer(n).spacing[0]).collect();
    assert_eq!(spacings, [30.0, 5.0, 1.0]);
    assert_eq!(store.heights(2)[0], 2.0, "the ring around the finer one lies on the fine one");
    assert_eq!(store.heights(1)[0], 1.0);
}

#[test]
fn a_web_map_is_reprojected_to_true_scale_unless_told_otherwise() {
    let raster =
        || MemoryRaster::heights("EPSG:3857", [15.44e6, 4.22e6], [76.4, 76.4], [80, 80], noise);
    let store = import(sources(vec![raster()]), &plain());
    assert_eq!(store.reader.index().crs, "EPSG:32654");
    assert_eq!(store.layer(0).spacing, [60.0, 60.0]);
    assert!(store.summary.report.warnings.iter().any(|w| w.contains("stretches")));
    let settings = ImportSettings { crs: Some("EPSG:3857".into()), ..plain() };
    let kept = import(sources(vec![raster()]), &settings);
    assert_eq!(kept.layer(0).spacing, [76.4, 76.4]);
    assert!(kept.summary.report.warnings.iter().any(|w| w.contains("wrong by up to 2")));
}

#[test]
fn heights_that_cannot_be_are_voids_with_a_warning() {
    let raster = MemoryRaster::heights(UTM, [0.0, 30.0], [10.0, 10.0], [4, 4], |x, y| {
        match (x as i32, y as i32) {
            (0, 0) => f32::INFINITY,
            (10, 0) => -3.4e38,
            (20, 0) => 100_001.0,
            _ => 5.0,
        }
    });
    let store = import(sources(vec![raster]), &plain());
    assert_eq!(store.heights(0).iter().filter(|h| h.is_nan()).count(), 3);
    assert!(store.summary.report.warnings[0].contains("beyond 100 km"));
}

#[test]
fn local_terrain_stays_local() {
    let raster = MemoryRaster::heights("LOCAL", [0.0, 30.0], [1.0, 1.0], [4, 31], noise);
    let store = import(sources(vec![raster]), &plain());
    assert_eq!(store.reader.index().crs, "LOCAL");
    assert_eq!(store.reader.index().earth_radius_m, None);
}

#[test]
fn the_smallest_surface_has_four_posts() {
    let tiny = |size| MemoryRaster::heights(UTM, [0.0, 10.0], [10.0, 10.0], size, |_, _| 1.0);
    assert_eq!(import(sources(vec![tiny([2, 2])]), &plain()).layer(0).posts, [2, 2]);
    for size in [[1, 1], [1, 7], [7, 1]] {
        let error = error_of(sources(vec![tiny(size)]), &plain());
        assert!(error.contains("at least 2 x 2"), "{error}");
    }
    assert!(error_of(sources(vec![tiny([0, 3])]), &plain()).contains("no samples"));
}

#[test]
fn bad_requests_say_what_to_do() {
    let good = || MemoryRaster::heights(UTM, [0.0, 30.0], [10.0, 10.0], [4, 4], |_, _| 1.0);
    let with_crs = |crs: &str| MemoryRaster::heights(crs, [0.0, 30.0], [10.0, 10.0], [4, 4], noise);
    assert!(error_of(sources(vec![]), &plain()).contains("at least one"));
    assert!(error_of(sources(vec![with_crs("")]), &plain()).contains("--source-crs"));
    assert!(error_of(sources(vec![with_crs("EPSG:1")]), &plain()).contains("--source-crs"));
    let settings = ImportSettings { source_crs: Some(UTM.into()), ..plain() };
    assert_eq!(import(sources(vec![with_crs("")]), &settings).reader.index().crs, UTM);
    for crs in ["EPSG:4326", "EPSG:2225"] {
        let settings = ImportSettings { crs: Some(crs.into()), ..plain() };
        assert!(error_of(sources(vec![good()]), &settings).contains("--crs"));
    }
    let mut nowhere = good();
    nowhere.info.transform = None;
    assert!(error_of(sources(vec![nowhere]), &plain()).contains("world file"));
    let mut flat = good();
    flat.info.transform =
        Some(GeoTransform { origin: [0.0; 2], step_column: [1.0, 0.0], step_row: [2.0, 0.0] });
    assert!(error_of(sources(vec![flat]), &plain()).contains("no extent"));
    let photo = MemoryRaster::photo(UTM, [0.0, 30.0], [10.0, 10.0], [4, 4], |_, _| [1; 4]);
    assert!(error_of(sources(vec![photo]), &plain()).contains("give it as a photo"));
    let void = MemoryRaster::heights(UTM, [0.0, 30.0], [10.0, 10.0], [4, 4], |_, _| f32::NAN);
    assert!(error_of(sources(vec![void]), &plain()).contains("every sample is void"));
    let far = MemoryRaster::heights(UTM, [9e8, 9e8], [10.0, 10.0], [4, 4], noise);
    let error = error_of(sources(vec![good(), far]), &plain());
    assert!(error.contains("at most"), "{error}");
    let settings = ImportSettings { fill_voids: Some(100_000), ..plain() };
    assert!(error_of(sources(vec![good()]), &settings).contains("256"));
}

#[test]
fn an_import_that_is_stopped_leaves_nothing() {
    let raster = MemoryRaster::heights(UTM, [0.0, 9000.0], [10.0, 10.0], [900, 900], noise);
    let folder = tempfile::tempdir().unwrap();
    let cancel = std::sync::atomic::AtomicBool::new(false);
    let stop = |_| cancel.store(true, std::sync::atomic::Ordering::Relaxed);
    let path = folder.path().join("t.terrain");
    let result =
        terrafarm_import::import_rasters(sources(vec![raster]), &plain(), &path, &stop, &cancel);
    assert!(matches!(result, Err(terrafarm_import::ImportError::Cancelled)));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 12, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn rough_ground_anywhere_is_reprojected_within_the_reported_error(
        longitude in -179i32..179, latitude in -78i32..78, seconds in 1u32..40, seed in 0u64..1000,
    ) {
        let step = f64::from(seconds) / 3600.0;
        let tile = || MemoryRaster::heights(
            "EPSG:4326",
            [f64::from(longitude), f64::from(latitude)],
            [step, step],
            [70, 50],
            |x, y| noise(x + seed as f64, y) / 10.0,
        );
        let store = import(sources(vec![tile()]), &plain());
        assert_within_report(&store, &[tile()], seed);
    }
}
