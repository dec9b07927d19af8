#![allow(clippy::unwrap_used)]
use super::levels::BATCH;
use super::*;
use crate::fixture::{Ground, height_layer, hills};
use crate::layout::{TILE_CELLS, TileKey};
use crate::resident::Tile;
use crate::store::StoreReader;
use crate::tile::HeightTile;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

fn heights(store: &StoreReader, level: u16, tx: u32, ty: u32) -> Arc<HeightTile> {
    match store.read_tile(TileKey { layer: 0, level, tx, ty }) {
        Ok(Some(Tile::Height(tile))) => tile,
        Ok(_) => panic!("tile ({tx}, {ty}) of level {level} is empty or a photo"),
        Err(error) => panic!("{error}"),
    }
}

/// Height of a post of a level.
fn post(store: &StoreReader, level: u16, i: u64, j: u64) -> f32 {
    let tiles = store.index().layers[0].levels[usize::from(level)].tiles;
    let [tx, ty] = [(i, tiles[0]), (j, tiles[1])]
        .map(|(n, tiles)| ((n / TILE_CELLS as u64) as u32).min(tiles - 1));
    let local = |n: u64, t: u32| (n - u64::from(t) * TILE_CELLS as u64) as isize;
    heights(store, level, tx, ty).post(local(i, tx), local(j, ty))
}

#[test]
fn odd_sizes_keep_every_post_and_make_no_surface_beyond_the_edge() {
    let folder = tempfile::tempdir().unwrap();
    let sizes = [[1, 1], [1, 600], [600, 1], [2, 2], [257, 257], [258, 3], [513, 258], [514, 2]];
    for posts in sizes {
        let path = folder.path().join("odd.terrain");
        Ground::new().heights(height_layer(posts), hills).build(&path).unwrap();
        let store = StoreReader::open(&path).unwrap();
        let layer = &store.index().layers[0];
        let tiles = layer.levels[0].tiles;
        for ty in 0..tiles[1] {
            for tx in 0..tiles[0] {
                let tile = heights(&store, 0, tx, ty);
                for j in -1..=257 {
                    for i in -1..=257 {
                        let place = [(i, tx), (j, ty)].map(|(n, t)| n as i64 + i64::from(t) * 256);
                        let inside = (0..2)
                            .all(|axis| u64::try_from(place[axis]).is_ok_and(|n| n < posts[axis]));
                        let height = tile.post(i, j);
                        if inside {
                            assert_eq!(height, hills(place[0] as u64, place[1] as u64));
                        } else {
                            assert!(height.is_nan(), "{posts:?}: post {place:?} does not exist");
                        }
                    }
                }
            }
        }
        let top = layer.levels.last().unwrap();
        assert_eq!(top.entries.len(), 1);
        assert!(top.entries[0].deviation.is_finite(), "{posts:?} has no voids");
        assert_eq!(store.index().report.void_posts, 0);
    }
}

#[test]
fn coarser_levels_are_the_rounded_tent_of_finer_ones_across_tile_borders() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.terrain");
    Ground::new().heights(height_layer([1200, 700]), hills).build(&path).unwrap();
    let store = StoreReader::open(&path).unwrap();
    for (i, j) in [(1, 1), (127, 128), (128, 128), (256, 255), (257, 3), (512, 256), (598, 348)] {
        let mut sum = 0.0;
        for (dj, wj) in [(0, 1.0), (1, 2.0), (2, 1.0)] {
            for (di, wi) in [(0, 1.0), (1, 2.0), (2, 1.0)] {
                sum += hills(2 * i + di - 1, 2 * j + dj - 1) * wi * wj;
            }
        }
        // Posts of level 1 are 20 m apart: eighths of a metre.
        let expected = (sum / 2.0).round() / 8.0;
        assert_eq!(post(&store, 1, i, j), expected, "post ({i}, {j})");
    }
    // The edge keeps to the edge: post (0, 0), and post 600 beyond the last one, 1199.
    assert_eq!(post(&store, 1, 0, 0), hills(0, 0));
    assert_eq!(post(&store, 1, 600, 0), hills(1199, 0));
    // A post that two tiles share is the same in both, and a ring is the neighbour's.
    for level in 0..2 {
        let (west, east) = (heights(&store, level, 0, 0), heights(&store, level, 1, 0));
        for j in 0..=256 {
            assert_eq!(west.post(256, j), east.post(0, j));
            assert_eq!(west.post(257, j), east.post(1, j));
            assert_eq!(west.post(255, j), east.post(-1, j));
        }
    }
}

#[test]
fn the_deviation_bounds_the_distance_to_the_finest_level() {
    let spiky = |i: u64, j: u64| hills(i, j) + if i % 37 == 5 && j % 41 == 7 { 200.0 } else { 0.0 };
    check_deviation(height_layer([1100, 530]), spiky, 2.0, 0.0);
}

#[test]
fn the_deviation_holds_where_rounding_is_most_of_it() {
    for (spacing, seed) in [(3.0, 1), (10.0, 2), (90.0, 3)] {
        // Slopes of a few steps between posts, and noise below a step.
        let noise = move |i: u64, j: u64| {
            let mixed = (seed ^ i << 20 ^ j).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40;
            (mixed % 1000) as f32 * 1e-5
        };
        let calm = move |i: u64, j: u64| 700.0 + 0.013 * i as f32 - 0.0071 * j as f32 + noise(i, j);
        let spec = LayerSpec { spacing: [spacing; 2], quantum_m: None, ..height_layer([700, 300]) };
        check_deviation(spec, calm, 2.0, 4.0 * COARSEST_STEP_M);
    }
}

/// The coarsest step of [`crate::rounding`], metres.
const COARSEST_STEP_M: f64 = 0.125;

/// Compares the coarser levels' first tile with level 0, and its deviation with what is
/// found: it must not be less, and neither more than `slack` times as much and `slack_m`.
fn check_deviation(
    spec: LayerSpec,
    rule: impl Fn(u64, u64) -> f32 + Copy + Sync + 'static,
    slack: f64,
    slack_m: f64,
) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.terrain");
    let [width, height] = spec.posts;
    Ground::new().heights(spec, rule).build(&path).unwrap();
    let store = StoreReader::open(&path).unwrap();
    let layer = &store.index().layers[0];
    for level in 1..layer.levels.len() as u16 {
        let tile = heights(&store, level, 0, 0);
        let entry = layer.entry(usize::from(level), 0, 0).unwrap();
        let scale = 1u64 << level;
        let mut largest: f64 = 0.0;
        for j in 0..height.min(256 * scale) {
            for i in 0..width.min(256 * scale) {
                let cell = |n: u64| ((n / scale).min(255), (n as f64) / scale as f64);
                let ((ci, x), (cj, y)) = (cell(i), cell(j));
                let (u, v) = (x - ci as f64, y - cj as f64);
                let [sw, se, nw, ne] = tile.corners(ci as usize, cj as usize).map(f64::from);
                let coarse = (sw * (1.0 - u) + se * u) * (1.0 - v) + (nw * (1.0 - u) + ne * u) * v;
                largest = largest.max((coarse - f64::from(rule(i, j))).abs());
            }
        }
        let bound = f64::from(entry.deviation);
        assert!(largest <= bound, "level {level}: {largest} > {bound}");
        let (slack, slack_m) = if level == 1 { (1e-6, 0.0) } else { (slack, slack_m) };
        let most = largest * (1.0 + slack) + slack_m;
        assert!(bound <= most, "level {level}: {bound} is far from {largest}");
        let step = crate::rounding::step_m(layer.level_spacing(usize::from(level))).unwrap();
        assert!(tile.to_posts().iter().all(|post| post.is_nan() || f64::from(*post) % step == 0.0));
    }
}

#[test]
fn voids_shrink_with_the_level_and_make_it_incomparable() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.terrain");
    let holed =
        |i: u64, j: u64| if (40..60).contains(&i) && j < 90 { f32::NAN } else { hills(i, j) };
    Ground::new().heights(height_layer([520, 260]), holed).build(&path).unwrap();
    let store = StoreReader::open(&path).unwrap();
    let layer = &store.index().layers[0];
    assert_eq!(store.index().report.void_posts, 20 * 90);
    assert!(post(&store, 1, 25, 3).is_nan());
    assert!(!post(&store, 1, 20, 3).is_nan(), "post 39 to its west is valid");
    assert_eq!(layer.levels[1].entries[0].deviation, f32::INFINITY);
    assert!(layer.levels[1].entries[1].deviation.is_finite(), "the next tile has no voids");
    let entry = layer.levels[0].entries[0];
    assert!((entry.min, entry.max) == (30.0, 170.0), "{entry:?}");
}

#[test]
fn a_layer_of_voids_has_no_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.terrain");
    let summary = Ground::new()
        .heights(height_layer([300, 300]), |_, _| f32::NAN)
        .colors(height_layer([5, 5]), |_, _| [9, 9, 9, 0])
        .build(&path)
        .unwrap();
    assert_eq!(summary.tiles, 0);
    let store = StoreReader::open(&path).unwrap();
    assert_eq!(store.index().report.void_posts, 300 * 300);
    assert!(store.read_tile(TileKey { layer: 0, level: 1, tx: 0, ty: 0 }).unwrap().is_none());
}

#[test]
fn layers_are_put_in_the_order_that_the_index_asks_for() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.terrain");
    let fine = LayerSpec { spacing: [1.0; 2], ..height_layer([9, 9]) };
    Ground::new()
        .colors(fine, |_, _| [200, 100, 50, 255])
        .heights(fine, |_, _| 2.0)
        .heights(height_layer([9, 9]), |_, _| 1.0)
        .build(&path)
        .unwrap();
    let index = StoreReader::open(&path).unwrap().index().clone();
    let order: Vec<_> = index.layers.iter().map(|layer| (layer.kind, layer.spacing[0])).collect();
    use LayerKind::{Height, Photo};
    assert_eq!(order, [(Height, 10.0), (Height, 1.0), (Photo, 1.0)]);
}

#[test]
fn the_bytes_do_not_depend_on_the_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let ground = || {
        Ground::new()
            .heights(height_layer([2000, 1100]), hills)
            .colors(height_layer([700, 300]), |i, j| [i as u8, j as u8, (i ^ j) as u8, 255])
    };
    let build = |threads: usize| {
        let path = folder.path().join(format!("{threads}.terrain"));
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let ground = ground();
        pool.install(|| ground.build(&path)).unwrap();
        fs::read(path).unwrap()
    };
    assert_eq!(build(1), build(5));
}

#[test]
fn equal_tiles_are_stored_once() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.terrain");
    let summary =
        Ground::new().heights(height_layer([256 * 8 + 1; 2]), |_, _| 4.0).build(&path).unwrap();
    assert_eq!(summary.tiles, 64 + 16 + 4 + 1);
    // Inner ones and eight kinds of border by where the ring is void, the same of coarser
    // levels (which have another step), and the single one on top.
    assert_eq!(summary.distinct_tiles, 9 + 9 + 1);
    assert_eq!(summary.bytes, fs::metadata(&path).unwrap().len());
}

/// Flat ground, unreadable east of a column.
struct Failing(u64);

impl LayerSource for Failing {
    fn heights(&self, window: PostWindow, into: &mut [f32]) -> Result<(), SourceError> {
        into.fill(0.0);
        if window.i0 > self.0 { Err("the input ends".into()) } else { Ok(()) }
    }
}

#[test]
fn nothing_is_left_behind_by_a_failure_a_stop_or_a_drop() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.terrain");
    fs::write(&path, "the old store").unwrap();
    let never = AtomicBool::new(false);
    let create = || StoreBuilder::create(&path, "LOCAL", HeightDatum::Unknown, None).unwrap();

    let mut builder = create();
    let error =
        builder.add_layer(height_layer([3000, 9]), &Failing(1000), &|_, _| (), &never).unwrap_err();
    assert_eq!(error.to_string(), "cannot read the posts of layer 0: the input ends");
    drop(builder);

    let mut builder = create();
    let stop = AtomicBool::new(false);
    let told = AtomicU64::new(0);
    let progress = |done: u64, total: u64| {
        told.store(done, Ordering::Relaxed);
        assert_eq!(total, 20 * 20 + 10 * 10 + 5 * 5 + 3 * 3 + 2 * 2 + 1);
        stop.store(true, Ordering::Relaxed);
    };
    let spec = height_layer([256 * 20 + 1; 2]);
    let error = builder.add_layer(spec, &Failing(u64::MAX), &progress, &stop).unwrap_err();
    assert!(matches!(error, BuildError::Cancelled));
    assert_eq!(told.load(Ordering::Relaxed), BATCH as u64);
    drop(builder);

    let error = create().finish(ImportReport::default()).unwrap_err();
    assert_eq!(error.to_string(), "the store cannot be finished: the store has no heights");

    let names: Vec<_> =
        fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(names, ["a.terrain"]);
    assert_eq!(fs::read_to_string(&path).unwrap(), "the old store");
}

#[test]
fn sizes_beyond_the_limits_are_refused_before_anything_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let never = AtomicBool::new(false);
    let create = |name: &str| {
        StoreBuilder::create(&folder.path().join(name), "LOCAL", HeightDatum::Unknown, None)
    };
    let mut builder = create("a.terrain").unwrap();
    let mut refused = |spec: LayerSpec| {
        struct Untouched;
        impl LayerSource for Untouched {}
        let error = builder.add_layer(spec, &Untouched, &|_, _| (), &never).unwrap_err();
        assert!(matches!(error, BuildError::Layer { .. }), "{error}");
        error.to_string()
    };
    assert!(refused(height_layer([0, 5])).contains("0 x 5 posts"));
    assert!(refused(height_layer([MAX_POSTS + 1, 5])).contains("are allowed"));
    assert!(refused(height_layer([MAX_POSTS, MAX_POSTS])).contains("tiles"));
    assert!(refused(height_layer([u64::MAX, u64::MAX])).contains("posts"));
    refused(LayerSpec { spacing: [0.0, 1.0], ..height_layer([5, 5]) });
    refused(LayerSpec { spacing: [1e308, 1.0], ..height_layer([5, 5]) });
    refused(LayerSpec { quantum_m: Some(0.0), ..height_layer([5, 5]) });
    refused(LayerSpec { origin: [f64::NAN, 1.0], ..height_layer([5, 5]) });
    let missing = create("no/such/folder.terrain").err().unwrap().to_string();
    assert!(missing.contains("does the folder exist?"), "{missing}");
}

#[test]
fn a_full_disk_is_said_to_be_full() {
    let source = io::Error::from(io::ErrorKind::StorageFull);
    let error = BuildError::Io { path: "a.terrain".into(), source };
    assert!(error.to_string().ends_with("; free some space or choose another disk"), "{error}");
}

#[test]
fn photos_keep_their_colors_and_fade_into_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.terrain");
    let color = |i: u64, _: u64| if i < 100 { [10, 200, 30, 255] } else { [77, 0, 0, 0] };
    Ground::new()
        .heights(height_layer([2, 2]), hills)
        .colors(height_layer([300, 9]), color)
        .build(&path)
        .unwrap();
    let store = StoreReader::open(&path).unwrap();
    let texel = |level: u16, i: isize| match store
        .read_tile(TileKey { layer: 1, level, tx: 0, ty: 0 })
        .unwrap()
    {
        Some(Tile::Photo(tile)) => tile.texel(i, 4),
        _ => panic!("a photo"),
    };
    assert_eq!(texel(0, 99), crate::color::linear_premultiplied([10, 200, 30, 255]));
    assert_eq!(texel(0, 100), [0; 4]);
    assert_eq!(texel(0, -1), [0; 4]);
    assert_eq!(texel(1, 49), texel(0, 99));
    // Post 50 lies over 99, 100 and 101: a quarter of the weight is covered.
    let faded = crate::color::linear_premultiplied([10, 200, 30, 64]);
    let kept = |c: usize| texel(1, 50)[c].abs_diff(faded[c]) < 10;
    assert!((0..4).all(kept), "{:?} {faded:?}", texel(1, 50));
    assert_eq!(store.index().layers[1].levels[0].entries[1], TileEntry::EMPTY);
}

#[test]
fn a_decimal_quantum_means_the_decimal() {
    let folder = tempfile::tempdir().unwrap();
    let terrain_rgb = |i: u64, j: u64| (-10000.0 + 0.1 * (100_000 + 37 * i + 11 * j) as f64) as f32;
    let size = |quantum_m: Option<f32>| {
        let path = folder.path().join("a.terrain");
        let spec = LayerSpec { quantum_m, ..height_layer([257, 257]) };
        Ground::new().heights(spec, terrain_rgb).build(&path).unwrap();
        let store = StoreReader::open(&path).unwrap();
        assert_eq!(post(&store, 0, 200, 100), terrain_rgb(200, 100));
        store.index().layers[0].levels[0].entries[0].length
    };
    let (tenths, floats) = (size(Some(0.1)), size(None));
    assert!(tenths * 10 < floats, "{tenths} and {floats} bytes");
    assert!(size(Some(0.3)) <= floats, "a quantum that does not fit costs nothing");
}
