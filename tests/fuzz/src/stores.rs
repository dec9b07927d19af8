//! Small stores, for the targets that read them.

use std::path::Path;
use std::sync::atomic::AtomicBool;
use terrafarm_terrain::build::{LayerSource, LayerSpec, SourceError, StoreBuilder};
use terrafarm_terrain::layout::{HeightDatum, ImportReport, LayerKind, PostWindow};

/// Stores as files: one of a single tile, one with a photo and two levels.
pub fn small() -> Vec<Vec<u8>> {
    let heights = |posts| LayerSpec {
        kind: LayerKind::Height,
        origin: [-30.0, 40.0],
        spacing: [10.0, 10.0],
        posts,
        quantum_m: Some(1.0),
    };
    let photo = LayerSpec { kind: LayerKind::Photo, quantum_m: None, ..heights([7, 5]) };
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("seed.terrain");
    let stores = [vec![heights([3, 4])], vec![heights([300, 20]), photo]];
    let build = |layers: Vec<LayerSpec>| {
        write(&path, &layers);
        std::fs::read(&path).expect("the store that was just made")
    };
    stores.into_iter().map(build).collect()
}

fn write(path: &Path, layers: &[LayerSpec]) {
    let mut builder = StoreBuilder::create(path, "EPSG:32612", HeightDatum::Geoid, Some(6.37e6))
        .expect("a store can be begun");
    for layer in layers {
        let built = builder.add_layer(*layer, &Ramp, &|_, _| (), &AtomicBool::new(false));
        built.expect("a small layer");
    }
    builder.finish(ImportReport::default()).expect("a small store");
}

/// Ground that rises to the east.
struct Ramp;

impl LayerSource for Ramp {
    fn heights(&self, window: PostWindow, into: &mut [f32]) -> Result<(), SourceError> {
        window.fill(into, |i, _| i as f32);
        Ok(())
    }

    fn colors(&self, _: PostWindow, into: &mut [[u8; 4]]) -> Result<(), SourceError> {
        into.fill([90, 120, 60, 255]);
        Ok(())
    }
}
