//! What is computed is rounded, what is copied is not, and tiles take two bytes a post.

#![allow(clippy::unwrap_used, missing_docs)]

mod common;

use common::{Imported, MemoryRaster, import, shared, sources};
use terrafarm_import::{ImportSettings, Sources};
use terrafarm_terrain::info::summary;

const UTM: &str = "EPSG:32612";

fn plain() -> ImportSettings {
    ImportSettings::default()
}

/// Heights that need all digits of an f32.
fn smooth(x: f64, y: f64) -> f32 {
    (1200.0 + 90.0 * (x / 700.0).sin() + 40.0 * (y / 300.0).cos()) as f32
}

fn bytes_per_post(store: &Imported) -> f64 {
    summary(&store.reader).bytes_per_post
}

#[test]
fn resampled_heights_are_multiples_of_a_step_and_the_report_says_so() {
    let raster =
        MemoryRaster::heights(UTM, [300_000.0, 4_100_000.0], [30.0; 2], [683, 683], smooth);
    let settings = ImportSettings { spacing_m: Some(20.0), ..plain() };
    let store = import(sources(vec![raster]), &settings);
    let mut heights = store.heights(0);
    heights.retain(|height| !height.is_nan());
    assert!(heights.len() > 1_040_000, "{}", heights.len());
    assert!(heights.iter().all(|height| (height * 8.0).fract() == 0.0));
    let line = &store.summary.report.inputs[0];
    assert!(line.ends_with("resampled to 20 x 20 m, rounded to 1/8 m"), "{line}");
    assert!(store.summary.report.max_resampling_error_m > 1.0 / 64.0, "rounding is an error");
    assert!(bytes_per_post(&store) < 3.7, "{}", bytes_per_post(&store));
}

#[test]
fn copied_floats_stay_bit_for_bit_and_only_coarser_levels_are_rounded() {
    let raster =
        MemoryRaster::heights(UTM, [300_000.0, 4_100_000.0], [30.0; 2], [600, 300], smooth);
    let samples = raster.heights.clone();
    let store = import(sources(vec![raster]), &plain());
    let heights = store.heights(0);
    for (row, samples) in samples.chunks_exact(600).enumerate() {
        let posts = &heights[(299 - row) * 600..][..600];
        assert!(posts.iter().zip(samples).all(|(a, b)| a.to_bits() == b.to_bits()));
    }
    let line = &store.summary.report.inputs[0];
    assert!(line.ends_with("taken untouched, 30 x 30 m"), "{line}");
}

#[test]
fn filled_voids_take_the_step_of_the_tenths_around_them() {
    let hole = |x: f64, y: f64| (x - 303_000.0).abs() < 100.0 && (y - 4_096_000.0).abs() < 100.0;
    let tenths = |x: f64, y: f64| (f64::from((smooth(x, y) * 10.0).round()) * 0.1) as f32;
    let holed = |x: f64, y: f64| if hole(x, y) { f32::NAN } else { tenths(x, y) };
    let mut raster =
        MemoryRaster::heights(UTM, [300_000.0, 4_100_000.0], [20.0; 2], [500, 500], holed);
    raster.info.quantum_m = Some(0.1);
    let settings = ImportSettings { fill_voids: Some(20), ..plain() };
    let store = import(sources(vec![raster]), &settings);
    assert!(store.summary.filled_posts > 50);
    for height in store.heights(0) {
        assert_eq!(((f64::from(height) * 10.0).round() * 0.1) as f32, height);
    }
    assert!(bytes_per_post(&store) < 4.6, "small tiles at the border count in full");
}

#[test]
fn an_inset_of_whole_metres_borrows_binary_fractions() {
    let base = MemoryRaster::heights(UTM, [0.0, 6000.0], [30.0; 2], [201, 201], smooth);
    let mut inset = MemoryRaster::heights(UTM, [1001.0, 2500.0], [8.0; 2], [100, 90], |x, y| {
        smooth(x, y).round()
    });
    inset.info.quantum_m = Some(1.0);
    let sources = Sources {
        elevation: shared(vec![base]),
        insets: shared(vec![inset]),
        ..Sources::default()
    };
    let store = import(sources, &plain());
    let heights = store.heights(1);
    let width = store.layer(1).posts[0] as usize;
    assert!(heights[..width].iter().any(|height| height.fract() != 0.0), "the ring is borrowed");
    assert!(heights.iter().all(|height| (height * 16.0).fract() == 0.0));
    assert!(heights[width + 1..2 * width - 1].iter().all(|height| height.fract() == 0.0));
}
