//! Files that people own, against `gdalwarp` where it is installed. The data lie beside
//! the repository; without them these tests say that they skip.

#![allow(clippy::unwrap_used, missing_docs)]

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::AtomicBool;

use terrafarm_geo::Crs;
use terrafarm_import::{ImportRequest, ImportSettings, ImportSummary, import};
use terrafarm_terrain::info::summary;
use terrafarm_terrain::layout::{HeightDatum, Layer, LayerKind, TILE_CELLS, TILE_POSTS};
use terrafarm_terrain::sample::Sampler;
use terrafarm_terrain::store::StoreReader;

/// The folder of test data, if it and GDAL are there.
fn data() -> Option<PathBuf> {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../../shared/data");
    if !data.is_dir() {
        println!("skipped: no test data at {}", data.display());
        return None;
    }
    if Command::new("gdalwarp").arg("--version").output().is_err() {
        println!("skipped: gdalwarp is not installed");
        return None;
    }
    Some(data)
}

struct Store {
    folder: tempfile::TempDir,
    summary: ImportSummary,
    reader: StoreReader,
}

fn store_of(mut request: ImportRequest) -> Store {
    let folder = tempfile::tempdir().unwrap();
    request.output = folder.path().join("t.terrain");
    let cancel = AtomicBool::new(false);
    let summary = import(&request, &|_| {}, &cancel).unwrap_or_else(|error| panic!("{error}"));
    let reader = StoreReader::open(&request.output).unwrap();
    Store { folder, summary, reader }
}

impl Store {
    fn base(&self) -> &Layer {
        &self.reader.index().layers[0]
    }

    /// What `gdalwarp` finds at the posts of the base, row by row from the north.
    fn warped(&self, inputs: &[String]) -> Vec<f32> {
        let layer = self.base();
        let [west, south] = layer.origin;
        let [east, north] = layer.far_corner();
        let [dx, dy] = layer.spacing;
        let output = self.folder.path().join("warped.bin");
        let number = |value: f64| format!("{value:?}");
        let status = Command::new("gdalwarp")
            .args(["-q", "-of", "ENVI", "-ot", "Float32", "-r", "bilinear", "-et", "0"])
            .args(["-dstnodata", "-99999", "-t_srs", &self.reader.index().crs, "-te"])
            .args(
                [west - dx / 2.0, south - dy / 2.0, east + dx / 2.0, north + dy / 2.0].map(number),
            )
            .args(["-ts", &layer.posts[0].to_string(), &layer.posts[1].to_string()])
            .args(inputs)
            .arg(&output)
            .status()
            .unwrap();
        assert!(status.success());
        let bytes = std::fs::read(&output).unwrap();
        bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
    }

    /// Compares the valid posts of every `stride`th row with `gdalwarp`: number compared and
    /// largest difference.
    fn against_warp(&self, inputs: &[String], stride: u64) -> (usize, f64) {
        let layer = self.base();
        let warped = self.warped(inputs);
        let mut sampler = Sampler::new(&self.reader);
        let (mut count, mut worst) = (0, 0f64);
        for (n, expected) in warped.into_iter().enumerate() {
            let (i, row) = (n as u64 % layer.posts[0], n as u64 / layer.posts[0]);
            if row % stride != 0 {
                continue;
            }
            let j = layer.posts[1] - 1 - row;
            let x = layer.origin[0] + i as f64 * layer.spacing[0];
            let y = layer.origin[1] + j as f64 * layer.spacing[1];
            let found = sampler.height_at(x, y).unwrap();
            if let Some(found) = found.filter(|_| expected > -9999.0) {
                count += 1;
                worst = worst.max((found - f64::from(expected)).abs());
            }
        }
        (count, worst)
    }
}

impl Store {
    /// Checks that all tiles take two bytes a post; says what that comes to.
    #[track_caller]
    fn takes_two_bytes_a_post(&self) {
        let layer = self.base();
        let tile_bytes = 2 * (TILE_POSTS * TILE_POSTS + TILE_CELLS * TILE_CELLS / 3);
        let tiles = layer.levels.iter().flat_map(|level| &level.entries);
        let filled = tiles.filter(|entry| !entry.is_empty()).count();
        let found = summary(&self.reader).layers[0].memory_bytes_per_post;
        let posts = (layer.posts[0] * layer.posts[1]) as f64;
        println!("{:?} posts: {found:.2} bytes per post in memory", layer.posts);
        assert!(found < (filled * (tile_bytes + 200)) as f64 / posts, "{found}");
    }
}

fn text(path: &Path) -> String {
    path.display().to_string()
}

#[test]
fn a_geographic_srtm_cutout_agrees_with_gdalwarp() {
    let Some(data) = data() else { return };
    let input = data.join("zion/srtm.tif");
    let photo = data.join("zion/zion_landsat_rgb.tif");
    let store = store_of(ImportRequest {
        elevation: vec![input.clone()],
        photos: vec![photo],
        ..ImportRequest::default()
    });
    assert_eq!(store.reader.index().crs, "EPSG:32612");
    store.takes_two_bytes_a_post();
    let (count, worst) = store.against_warp(&[text(&input)], 1);
    println!("{count} posts, {worst} m; report: {:?}", store.summary.report);
    assert!(count as u64 * 10 > store.base().posts[0] * store.base().posts[1] * 9);
    assert!(worst < 0.1, "{worst}");
    let photos: Vec<&Layer> =
        store.reader.index().layers_of(LayerKind::Photo).map(|(_, layer)| layer).collect();
    assert_eq!(photos.len(), 1);
    assert_eq!(photos[0].spacing, [30.0, 30.0]);
    assert!(store.summary.report.inputs[1].contains("untouched"));
}

#[test]
fn two_srtm_tiles_join_as_in_gdalwarp() {
    let Some(data) = data() else { return };
    let names = ["N33W121", "N34W121"];
    let paths = names.map(|name| data.join(format!("santa_barbara/{name}.hgt.zip")));
    let store = store_of(ImportRequest { elevation: paths.to_vec(), ..ImportRequest::default() });
    // Warped one by one, GDAL would stretch each tile by half a sample beyond its edge.
    let joined = store.folder.path().join("joined.vrt");
    let inside =
        names.iter().zip(&paths).map(|(n, path)| format!("/vsizip/{}/{n}.hgt", text(path)));
    let status = Command::new("gdalbuildvrt").arg("-q").arg(&joined).args(inside).status().unwrap();
    assert!(status.success());
    assert_eq!(store.base().spacing, [25.0, 25.0]);
    store.takes_two_bytes_a_post();
    assert!(summary(&store.reader).bytes_per_post < 4.0);
    assert_eq!(store.reader.index().height_datum, HeightDatum::Geoid);
    let (count, worst) = store.against_warp(&[text(&joined)], 10);
    println!("{count} posts, {worst} m; report: {:?}", store.summary.report);
    assert!(count > 3_000_000, "{count}");
    assert!(worst < 0.1, "{worst}");
    // Along the shared parallel there is no hole, the outermost cells left out.
    let crs = Crs::parse(&store.reader.index().crs).unwrap();
    let mut sampler = Sampler::new(&store.reader);
    let holes = (10..9_990).filter(|n| {
        let [x, y] = crs.from_lonlat([-121.0 + f64::from(*n) / 10_000.0, 34.0]).unwrap();
        sampler.height_at(x, y).unwrap().is_none()
    });
    assert_eq!(holes.count(), 0);
}

#[test]
fn a_projected_quadrangle_is_taken_untouched() {
    let Some(data) = data() else { return };
    let input = data.join("helens/SainteHelens.dem");
    let store =
        store_of(ImportRequest { elevation: vec![input.clone()], ..ImportRequest::default() });
    assert_eq!(store.reader.index().crs, "EPSG:26710");
    assert_eq!(store.base().posts[0], 327);
    store.takes_two_bytes_a_post();
    let (count, worst) = store.against_warp(&[text(&input)], 1);
    assert!(count > 140_000 && worst < 1e-3, "{count} {worst}");
    assert_eq!(store.summary.report.max_resampling_error_m, 0.0);
    assert!(store.reader.index().report.void_posts > 3000);
}

#[test]
fn non_square_posts_and_a_photo_with_a_collar_are_imported() {
    let Some(data) = data() else { return };
    let inputs = [data.join("rmnp/rmnp-dem.tif"), data.join("rmnp/rmnp-rgb.tif")];
    let inset = data.join("rmnp/SRTMGL3_40.09_-105.55.asc");
    let store = store_of(ImportRequest {
        elevation: vec![inputs[0].clone()],
        insets: vec![inset],
        photos: vec![inputs[1].clone()],
        settings: ImportSettings {
            source_crs: Some("EPSG:4326".into()),
            ..ImportSettings::default()
        },
        ..ImportRequest::default()
    });
    let layers = &store.reader.index().layers;
    assert_eq!(layers.len(), 3);
    assert!(layers[1].spacing[0] < layers[0].spacing[0] / 2.0);
    println!("{:#?}", store.summary.report);
    assert!(store.summary.report.max_resampling_error_m > 0.0);
}
