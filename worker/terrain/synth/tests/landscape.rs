//! What makes it a landscape, and what makes it the same one every time.

#![allow(clippy::unwrap_used, missing_docs)]

use proptest::prelude::*;
use std::sync::OnceLock;
use std::sync::atomic::AtomicBool;
use terrafarm_synth::{Synth, SynthError, SynthSpec, synthesize, write_store};
use terrafarm_terrain::info::summary;
use terrafarm_terrain::layout::TileKey;
use terrafarm_terrain::resident::Tile;
use terrafarm_terrain::store::StoreReader;
use terrafarm_terrain::tile::Heights;

fn spec(posts: u32, seed: u64) -> SynthSpec {
    SynthSpec { posts, spacing_m: 60.0, seed, photo_scale: 1 }
}

fn make(spec: SynthSpec) -> Synth {
    synthesize(spec, &|_| (), &AtomicBool::new(false)).unwrap()
}

/// A terrain of 30 km that several tests look at.
fn land() -> &'static (Synth, Vec<f32>) {
    static LAND: OnceLock<(Synth, Vec<f32>)> = OnceLock::new();
    LAND.get_or_init(|| {
        let synth = make(spec(501, 3));
        let heights = synth.all_heights();
        (synth, heights)
    })
}

const SIDE: usize = 501;

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn any_window_agrees_with_the_whole(i in 0usize..490, j in 0usize..490, w in 1usize..40, h in 1usize..40) {
        let (synth, whole) = land();
        let (w, h) = (w.min(SIDE - i), h.min(SIDE - j));
        let mut window = vec![0.0; w * h];
        synth.heights(i as i64, j as i64, w, h, &mut window).unwrap();
        for row in 0..h {
            prop_assert_eq!(&window[row * w..][..w], &whole[(j + row) * SIDE + i..][..w]);
        }
        let mut colors = vec![[0; 4]; w * h];
        synth.colors(i as i64, j as i64, w, h, &mut colors).unwrap();
        let mut one = [[0; 4]];
        synth.colors((i + w - 1) as i64, (j + h - 1) as i64, 1, 1, &mut one).unwrap();
        prop_assert_eq!(one[0], colors[w * h - 1]);
    }
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| make(spec(129, 5)).all_heights())
    };
    assert!(with(1) == with(3));
}

#[test]
fn another_seed_is_another_terrain() {
    let differ = make(spec(65, 1))
        .all_heights()
        .iter()
        .zip(make(spec(65, 2)).all_heights())
        .filter(|(a, b)| **a != *b)
        .count();
    assert!(differ > 65 * 60, "{differ}");
}

#[test]
fn odd_sizes_are_made_and_all_numbers_are_finite() {
    for posts in [2, 3, 257, 300] {
        let heights = make(spec(posts, 9)).all_heights();
        assert_eq!(heights.len(), (posts * posts) as usize);
        assert!(
            heights.iter().all(|height| height.is_finite() && (-500.0..6000.0).contains(height))
        );
    }
}

#[test]
fn numbers_out_of_range_are_refused_and_a_stop_is_obeyed() {
    let refused = |spec: SynthSpec| synthesize(spec, &|_| (), &AtomicBool::new(false)).is_err();
    assert!(refused(spec(1, 1)));
    assert!(refused(spec(65_538, 1)));
    assert!(refused(SynthSpec { spacing_m: f64::NAN, ..spec(9, 1) }));
    assert!(refused(SynthSpec { photo_scale: 0, ..spec(9, 1) }));
    let stopped = synthesize(spec(257, 1), &|_| (), &AtomicBool::new(true));
    assert!(matches!(stopped, Err(SynthError::Cancelled)));
}

/// Slopes between neighbouring posts, rise over run.
fn slopes() -> Vec<f32> {
    let (_, heights) = land();
    let mut slopes = Vec::new();
    for j in 0..SIDE - 1 {
        for i in 0..SIDE - 1 {
            let at = j * SIDE + i;
            let (dx, dy) = (heights[at + 1] - heights[at], heights[at + SIDE] - heights[at]);
            slopes.push((dx * dx + dy * dy).sqrt() / 60.0);
        }
    }
    slopes.sort_by(f32::total_cmp);
    slopes
}

#[test]
fn there_are_floors_slopes_and_few_walls() {
    let slopes = slopes();
    let share =
        |below: f32| slopes.partition_point(|slope| *slope < below) as f64 / slopes.len() as f64;
    let (flat, steep) = (share(0.1), 1.0 - share(1.2));
    let median = slopes[slopes.len() / 2];
    assert!((0.02..0.5).contains(&flat), "{flat} of the ground is nearly level");
    assert!(steep < 0.05, "{steep} of the ground is steeper than 50 degrees");
    assert!((0.2..0.8).contains(&median), "half of the ground is steeper than {median}");
}

#[test]
fn relief_is_that_of_a_mountain_range() {
    let (_, heights) = land();
    let mut sorted = heights.clone();
    sorted.sort_by(f32::total_cmp);
    let at = |share: f64| sorted[(share * (sorted.len() - 1) as f64) as usize];
    assert!((1800.0..2900.0).contains(&(at(0.998) - at(0.0))), "{} to {}", at(0.0), at(0.998));
    // High ground is rare: blobs of noise are symmetric about their middle.
    assert!(at(0.5) - at(0.0) < 0.45 * (at(0.998) - at(0.0)), "median {}", at(0.5));
}

#[test]
fn water_finds_its_way_out_of_nearly_everywhere() {
    // Noise has a pit in one of some twenty posts; a drained land has few besides lakes.
    let (_, heights) = land();
    let mut pits = 0;
    for j in 1..SIDE - 1 {
        for i in 1..SIDE - 1 {
            let own = heights[j * SIDE + i];
            let lower = [-1isize, 0, 1].iter().any(|dj| {
                [-1isize, 0, 1].iter().any(|di| {
                    let at = (j as isize + dj) as usize * SIDE + (i as isize + di) as usize;
                    heights[at] <= own && (*di, *dj) != (0, 0)
                })
            });
            pits += usize::from(!lower);
        }
    }
    let share = pits as f64 / (SIDE * SIDE) as f64;
    assert!(share < 0.006, "{pits} pits, {share}");
}

#[test]
fn lakes_are_flat_and_blue() {
    let (synth, heights) = land();
    // The most frequent height of all is that of a lake.
    let mut sorted = heights.clone();
    sorted.sort_by(f32::total_cmp);
    let (mut best, mut run) = ((0, 0.0), 0);
    for pair in sorted.windows(2) {
        run = if pair[0] == pair[1] { run + 1 } else { 0 };
        if run > best.0 {
            best = (run, pair[0]);
        }
    }
    assert!(best.0 > 60, "the largest level surface has {} posts", best.0);
    let mut colors = vec![[0; 4]; SIDE * SIDE];
    synth.colors(0, 0, SIDE, SIDE, &mut colors).unwrap();
    let lake = heights.iter().zip(&colors).filter(|(height, _)| **height == best.1);
    let (blue, all) = lake
        .fold((0, 0), |(blue, all), (_, color)| (blue + usize::from(color[2] > color[0]), all + 1));
    assert!(blue * 10 > all * 8, "{blue} of {all} posts are blue");
}

#[test]
fn a_store_holds_what_was_made() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("land.terrain");
    let spec = SynthSpec { photo_scale: 2, ..spec(90, 4) };
    write_store(spec, &path, &|_| (), &AtomicBool::new(false)).unwrap();
    let store = StoreReader::open(&path).unwrap();
    let mut sampler = terrafarm_terrain::sample::Sampler::new(&store);
    let heights = make(spec).all_heights();
    for (i, j) in [(0, 0), (89, 89), (17, 60)] {
        let sampled = sampler.height_at(i as f64 * 60.0, j as f64 * 60.0).unwrap();
        assert_eq!(sampled, Some(f64::from(heights[j * 90 + i])));
    }
    assert_eq!(store.index().layers[1].posts, [179, 179]);
}

#[test]
fn its_tiles_take_two_bytes_a_post() {
    let folder = tempfile::tempdir().unwrap();
    for (posts, spacing_m, step) in
        [(513, 2.0, "1/64 m"), (1025, 15.0, "1/16 m"), (513, 200.0, "1/8 m")]
    {
        let path = folder.path().join("land.terrain");
        let spec = SynthSpec { spacing_m, ..spec(posts, 3) };
        write_store(spec, &path, &|_| (), &AtomicBool::new(false)).unwrap();
        let store = StoreReader::open(&path).unwrap();
        let levels = store.index().layers[0].levels.iter().enumerate();
        for (level, grid) in levels {
            for ty in 0..grid.tiles[1] {
                for tx in 0..grid.tiles[0] {
                    let key = TileKey { layer: 0, level: level as u16, tx, ty };
                    let Some(Tile::Height(tile)) = store.read_tile(key).unwrap() else { panic!() };
                    assert!(matches!(tile.heights(), Heights::Codes(_)), "{spacing_m} m: {key:?}");
                }
            }
        }
        let line = &store.index().report.inputs[0];
        assert!(line.ends_with(&format!("heights in steps of {step}")), "{line}");
        let found = summary(&store).bytes_per_post;
        println!("{posts} posts, {spacing_m} m: {found:.2} bytes per post in memory");
        assert!(found < 4.0, "{found}");
    }
}
