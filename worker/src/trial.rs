//! How fast this worker is: a small scene that is the same on every PC.
//!
//! The work is fixed and the time is measured, once, when the worker starts: hills from whole
//! numbers in one tile, seen by `auto`, so many pixels for each thread. What comes of it is
//! compared with that of other workers only, so the scene need not be like those that are
//! rendered later.

use glam::DVec3;
use rayon::prelude::*;
use std::sync::Arc;
use std::time::Instant;
use terrafarm_common::camera::Camera;
use terrafarm_common::id::BlobHash;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::{Region, tiles};
use terrafarm_common::shading::{Shading, Sky, Sun};
use terrafarm_raycast::{Pyramid, View, render};
use terrafarm_terrain::layout::{
    HeightDatum, ImportReport, Layer, LayerKind, Level, STORE_VERSION, StoreIndex, TILE_CELLS,
    TILE_POSTS, TileEntry, TileKey,
};
use terrafarm_terrain::resident::{Resident, Tile};
use terrafarm_terrain::tile::HeightTile;

/// Side of the picture, pixels.
const SIDE_PX: u32 = 512;
/// Side of a piece, pixels.
const PIECE_PX: u32 = 128;
/// How many pictures each thread renders: about 50 ms of a core.
const PICTURES: usize = 4;
/// Distance between posts, metres.
const SPACING_M: f64 = 30.0;

/// Pixels in a second on all threads of the pool that it is called on; `None` if the scene
/// cannot be rendered, which nobody but a test would see.
pub(crate) fn pixels_per_s() -> Option<u64> {
    let resident = scene()?;
    let pyramid = Pyramid::new(resident.index());
    let view = view();
    let pieces = tiles(SIDE_PX, SIDE_PX, PIECE_PX);
    let count = rayon::current_num_threads() * PICTURES * pieces.len();
    let began = Instant::now();
    let pixels: Option<u64> = (0..count)
        .into_par_iter()
        .with_max_len(1)
        .map(|at| piece(&resident, &pyramid, &view, pieces[at % pieces.len()]))
        .try_reduce(|| 0, |a, b| Some(a + b));
    let seconds = began.elapsed().as_secs_f64();
    Some(((pixels? as f64 / seconds.max(1e-6)) as u64).max(1))
}

/// Renders a piece; the number of its pixels.
fn piece(resident: &Resident, pyramid: &Pyramid, view: &View, region: Region) -> Option<u64> {
    let rendered = render(resident, pyramid, view, region).ok()?;
    // Looked at, so that nothing can be left out as unused.
    (rendered.missing.is_empty() && !rendered.pixels.is_empty()).then(|| region.area())
}

fn view() -> View {
    let middle_m = TILE_CELLS as f64 * SPACING_M / 2.0;
    let eye = DVec3::new(middle_m, 100.0, 700.0);
    View {
        camera: Camera::from_angles(eye, 0.0, -15.0, 0.0, 60.0, (SIDE_PX, SIDE_PX)),
        shading: Shading {
            sun: Some(Sun::at(255.0, 34.0, 0.2, 1.0)),
            haze: None,
            sky: Sky::default(),
            earth: None,
            below_ground: [0.0; 3],
            bare_ground: None,
        },
        quality: Quality { method: Method::Auto, ..Quality::default() },
    }
}

/// Height of a post, metres: ridges of four sizes, from whole numbers.
fn height_m(i: usize, j: usize) -> f32 {
    let ridge = |at: usize, side: usize| (at % (2 * side)).abs_diff(side);
    let octave = |side: usize| ridge(i * 3 + j * 2, side) + ridge(i * 2 + 3 * TILE_POSTS - j, side);
    (3 * octave(71) + 2 * octave(29) + octave(13) + octave(5)) as f32
}

/// A store of one tile, in memory.
fn scene() -> Option<Resident> {
    let posts = (0..TILE_POSTS * TILE_POSTS).map(|at| height_m(at % TILE_POSTS, at / TILE_POSTS));
    let posts: Box<[f32]> = posts.collect();
    let bounds = posts.iter().fold((f32::MAX, f32::MIN), |(a, b), &h| (a.min(h), b.max(h)));
    let entry = TileEntry {
        hash: BlobHash([1; 32]),
        offset: 0,
        length: 1,
        min: bounds.0,
        max: bounds.1,
        deviation: 0.0,
    };
    let layer = Layer {
        kind: LayerKind::Height,
        origin: [0.0; 2],
        spacing: [SPACING_M; 2],
        posts: [TILE_CELLS as u64 + 1; 2],
        levels: vec![Level { tiles: [1, 1], entries: vec![entry] }],
    };
    let index = StoreIndex {
        version: STORE_VERSION,
        crs: "LOCAL".into(),
        height_datum: HeightDatum::Unknown,
        earth_radius_m: None,
        layers: vec![layer],
        report: ImportReport::default(),
    };
    let mut resident = Resident::new(Arc::new(index));
    let key = TileKey { layer: 0, level: 0, tx: 0, ty: 0 };
    let tile = Tile::Height(Arc::new(HeightTile::new(posts)?));
    resident.insert(key, tile).then_some(resident)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scene_is_sound_and_shows_ground_as_well_as_sky() {
        let resident = scene().expect("a tile of the right size");
        resident.index().check().expect("a sound index");
        let pyramid = Pyramid::new(resident.index());
        let whole = Region::whole(SIDE_PX, SIDE_PX);
        let rendered = render(&resident, &pyramid, &view(), whole).expect("auto does any view");
        assert!(rendered.missing.is_empty());
        let ground = rendered.stats.hits as f64 / whole.area() as f64;
        assert!((0.4..0.99).contains(&ground), "{ground}");
    }

    #[test]
    fn a_trial_takes_a_blink_and_says_a_likely_speed() {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().expect("two threads");
        let began = Instant::now();
        let speed = pool.install(pixels_per_s).expect("it renders");
        println!("{speed} pixels a second, {:?}", began.elapsed());
        assert!((10_000..10_000_000_000).contains(&speed));
    }
}
