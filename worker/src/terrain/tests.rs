//! Tiles, a limit, and what goes first.

use super::*;
use proptest::prelude::*;
use std::collections::BTreeSet;
use std::sync::LazyLock;
use terrafarm_terrain::layout::*;
use terrafarm_terrain::resident::Lookup;
use terrafarm_terrain::tile::HeightTile;

const STORE: BlobHash = BlobHash([1; 32]);
const SHOT: ShotId = ShotId(1);

/// A store of a row of tiles; the last one is the same as the first.
fn resident() -> Resident {
    let count = 6;
    let entry = |number: u32| TileEntry {
        hash: BlobHash([10 + (number % (count - 1)) as u8; 32]),
        length: 1,
        min: 0.0,
        max: 0.0,
        ..TileEntry::EMPTY
    };
    let level = |count| Level { tiles: [count, 1], entries: (0..count).map(entry).collect() };
    let layer = Layer {
        kind: LayerKind::Height,
        origin: [0.0; 2],
        spacing: [1.0; 2],
        posts: [u64::from(count) * TILE_CELLS as u64 + 1, 2],
        levels: [6, 3, 2, 1].map(level).into(),
    };
    let index = StoreIndex {
        version: STORE_VERSION,
        crs: "LOCAL".to_owned(),
        height_datum: HeightDatum::Unknown,
        earth_radius_m: None,
        layers: vec![layer],
        report: ImportReport::default(),
    };
    index.check().expect("a sound index");
    Resident::new(Arc::new(index))
}

fn tile() -> Tile {
    static TILE: LazyLock<Tile> = LazyLock::new(|| {
        let posts = vec![0.0; TILE_POSTS * TILE_POSTS].into_boxed_slice();
        Tile::Height(Arc::new(HeightTile::new(posts).expect("the right number of posts")))
    });
    TILE.clone()
}

fn key(tx: u32) -> TileKey {
    TileKey { layer: 0, level: 0, tx, ty: 0 }
}

/// Room for this many tiles.
fn terrain(tiles: usize) -> Terrain<()> {
    let mut terrain = Terrain::new((tiles * tile().memory_bytes()) as u64);
    terrain.add_store(STORE, resident(), ());
    terrain
}

fn load(terrain: &mut Terrain<()>, keys: &[TileKey]) {
    for hash in terrain.await_tiles(STORE, keys) {
        terrain.add_tile(hash, &tile()).expect("it belongs there");
    }
}

fn in_memory(terrain: &Terrain<()>) -> Vec<u32> {
    let scene = terrain.scene(STORE).expect("the store is there");
    let found = |tx: &u32| matches!(scene.resident.height(key(*tx)), Lookup::Found(_));
    (0..6).filter(found).collect()
}

#[test]
fn the_oldest_tiles_go_when_the_next_job_needs_room() {
    let mut terrain = terrain(3);
    load(&mut terrain, &[key(0), key(1)]);
    terrain.begin_job(SHOT, 0);
    load(&mut terrain, &[key(2), key(3)]);
    assert_eq!(in_memory(&terrain), [1, 2, 3]);
    assert_eq!(terrain.bytes(), 3 * tile().memory_bytes() as u64);
    assert_eq!(terrain.over_limit(), None);
}

#[test]
fn the_tiles_of_the_present_job_stay_and_too_many_of_them_are_told() {
    let mut terrain = terrain(2);
    load(&mut terrain, &[key(0), key(1), key(2)]);
    assert_eq!(in_memory(&terrain), [0, 1, 2]);
    assert!(terrain.over_limit().is_some_and(|why| why.contains("limit is 1 MB")));
    terrain.begin_job(SHOT, 0);
    assert_eq!(in_memory(&terrain), [1, 2]);
    assert_eq!(terrain.over_limit(), None);
}

#[test]
fn a_tile_that_lies_at_two_places_is_fetched_and_counted_once() {
    let mut terrain = terrain(9);
    assert_eq!(terrain.await_tiles(STORE, &[key(0), key(5), key(0)]).len(), 1);
    load(&mut terrain, &[]);
    assert!(in_memory(&terrain).is_empty());
    terrain.add_tile(BlobHash([10; 32]), &tile()).expect("it belongs there");
    assert_eq!(in_memory(&terrain), [0, 5]);
    assert_eq!(terrain.bytes(), tile().memory_bytes() as u64);
}

#[test]
fn the_root_is_loaded_with_the_first_tile_and_stays() {
    let least = ROOTS_PART as usize * HEIGHT_TILE_BYTES.max(PHOTO_TILE_BYTES);
    let mut terrain: Terrain<()> = Terrain::new(least as u64);
    terrain.add_store(STORE, resident(), ());
    let root = TileKey { layer: 0, level: 3, tx: 0, ty: 0 };
    let is_there = |terrain: &Terrain<()>| {
        let scene = terrain.scene(STORE).expect("the store is there");
        matches!(scene.resident.height(root), Lookup::Found(_))
    };
    load(&mut terrain, &[key(1)]);
    assert!(is_there(&terrain));
    assert_eq!(terrain.bytes(), 2 * tile().memory_bytes() as u64);
    assert_eq!(terrain.await_tiles(STORE, &[key(2)]).len(), 1, "it is not asked for again");
    terrain.limit_bytes = 1;
    terrain.begin_job(SHOT, 0);
    assert!(in_memory(&terrain).is_empty() && is_there(&terrain));
    assert_eq!(terrain.bytes(), tile().memory_bytes() as u64);
    terrain.release(STORE);
    for number in 0..IDLE_STORES_MAX {
        let other = BlobHash([100 + number as u8; 32]);
        terrain.add_store(other, resident(), ());
        terrain.release(other);
    }
    assert_eq!(terrain.bytes(), 0);
}

#[test]
fn a_tile_that_came_while_a_job_rendered_is_not_fetched_again() {
    let mut terrain = terrain(6);
    let awaited = terrain.await_tiles(STORE, &[key(1)]);
    assert!(awaited.iter().all(|&hash| !terrain.has_come(hash)));
    for &hash in &awaited {
        terrain.add_tile(hash, &tile()).expect("it belongs there");
    }
    // A job that began before says so now.
    let hash = *terrain.await_tiles(STORE, &[key(1)]).first().expect("a tile");
    assert!(terrain.has_come(hash));
    assert!(!terrain.has_come(hash), "nobody awaits it any more");
}

#[test]
fn a_tile_that_nobody_awaits_changes_nothing() {
    let mut terrain = terrain(9);
    terrain.await_tiles(STORE, &[key(0)]);
    terrain.begin_job(SHOT, 0);
    terrain.begin_job(SHOT, 1);
    terrain.add_tile(BlobHash([10; 32]), &tile()).expect("it is dropped");
    assert!(in_memory(&terrain).is_empty());
    assert_eq!(terrain.bytes(), 0);
}

#[test]
fn a_tile_that_comes_one_job_late_is_there_for_the_next_and_does_not_have_to_stay() {
    let mut terrain = terrain(3);
    let awaited = terrain.await_tiles(STORE, &[key(0)]);
    terrain.begin_job(SHOT, 0);
    for hash in awaited {
        terrain.add_tile(hash, &tile()).expect("it belongs there");
    }
    assert!(in_memory(&terrain).contains(&0));
    // The job needs three others, and there is room for three.
    load(&mut terrain, &[key(1), key(2), key(3)]);
    assert_eq!(in_memory(&terrain), [1, 2, 3]);
}

#[test]
fn released_stores_stay_for_a_while_and_take_their_tiles_along_when_they_go() {
    let mut terrain = terrain(9);
    load(&mut terrain, &[key(0)]);
    terrain.release(STORE);
    assert!(terrain.has_store(STORE), "still there, and in use again");
    terrain.release(STORE);
    for number in 0..IDLE_STORES_MAX {
        let other = BlobHash([100 + number as u8; 32]);
        terrain.add_store(other, resident(), ());
        terrain.release(other);
    }
    assert!(!terrain.has_store(STORE));
    assert_eq!(terrain.bytes(), 0);
    assert!(terrain.await_tiles(STORE, &[key(0)]).is_empty());
}

#[test]
fn what_no_job_has_looked_at_for_longest_goes_first() {
    let mut terrain = terrain(3);
    load(&mut terrain, &[key(0), key(1), key(2)]);
    terrain.begin_job(SHOT, 0);
    terrain.scene(STORE).expect("the store is there").resident.touch(key(0));
    terrain.begin_job(SHOT, 1);
    load(&mut terrain, &[key(3)]);
    assert_eq!(in_memory(&terrain), [0, 2, 3]);
}

/// Tiles are stowed for a frame.
fn stow(terrain: &mut Terrain<()>, frame: u32, keys: &[TileKey]) -> Vec<BlobHash> {
    let hashes = terrain.foresee_tiles(STORE, (SHOT, frame), keys);
    hashes.iter().for_each(|hash| terrain.stow(*hash, tile()));
    hashes
}

#[test]
fn a_tile_before_its_turn_comes_in_when_its_frame_does() {
    let mut terrain = terrain(80);
    assert_eq!(stow(&mut terrain, 7, &[key(0), key(5), key(1)]).len(), 2);
    assert!(stow(&mut terrain, 7, &[key(0)]).is_empty(), "it is here");
    assert_eq!(terrain.bytes(), 2 * tile().memory_bytes() as u64);
    terrain.begin_job(SHOT, 6);
    assert!(in_memory(&terrain).is_empty());
    terrain.begin_job(SHOT, 7);
    assert_eq!(in_memory(&terrain), [0, 1, 5]);
    assert_eq!(terrain.bytes(), 2 * tile().memory_bytes() as u64);
}

#[test]
fn a_job_that_needs_a_tile_before_its_turn_gets_it_and_a_closed_shot_frees_the_rest() {
    let mut terrain = terrain(80);
    let hash = stow(&mut terrain, 7, &[key(2)])[0];
    stow(&mut terrain, 9, &[key(3)]);
    assert!(terrain.await_tiles(STORE, &[key(2)]).contains(&hash));
    let stowed = terrain.take_stowed(hash).expect("it was stowed");
    terrain.add_tile(hash, &stowed).expect("it belongs there");
    assert_eq!(in_memory(&terrain), [2]);
    assert_eq!(terrain.bytes(), 2 * tile().memory_bytes() as u64);
    terrain.close_shot(SHOT);
    assert_eq!(terrain.bytes(), tile().memory_bytes() as u64);
}

#[test]
fn tiles_before_their_turn_take_the_room_of_those_that_no_job_has_looked_at_for_long() {
    // Room for one of the largest tiles before its turn.
    let mut terrain: Terrain<()> = Terrain::new(8 * HEIGHT_TILE_BYTES.max(PHOTO_TILE_BYTES) as u64);
    let size = tile().memory_bytes() as u64;
    for number in 0..(terrain.limit_bytes / size) as u32 {
        let store = BlobHash([1 + (number / 5) as u8; 32]);
        if !terrain.has_store(store) {
            terrain.add_store(store, resident(), ());
        }
        for hash in terrain.await_tiles(store, &[key(number % 5)]) {
            terrain.add_tile(hash, &tile()).expect("it belongs there");
        }
    }
    assert!(!terrain.has_room_ahead());
    for _ in 0..UNUSED_JOBS - 1 {
        terrain.begin_job(SHOT, 0);
        let scene = terrain.scene(STORE).expect("the store is there");
        scene.resident.touch(key(1));
        assert!(!terrain.has_room_ahead(), "jobs have looked at all of it");
    }
    terrain.begin_job(SHOT, 0);
    assert!(terrain.has_room_ahead());
    assert!(in_memory(&terrain).contains(&1), "it was in use");
}

proptest! {
    /// Whatever is loaded, foreseen and stowed: the limit holds, but for the tiles of one job.
    #[test]
    fn memory_stays_within_the_limit(
        limit in 1usize..40,
        steps in prop::collection::vec((0u8..7, 0u32..6, 0u32..20), 0..200),
    ) {
        let mut terrain = terrain(limit);
        let size = tile().memory_bytes() as u64;
        for (kind, tx, frame) in steps {
            match kind {
                0 => terrain.begin_job(SHOT, frame),
                1 | 2 => load(&mut terrain, &[key(tx)]),
                3 | 4 => drop(stow(&mut terrain, frame, &[key(tx)])),
                5 => terrain.close_shot(SHOT),
                _ => terrain.scene(STORE).expect("the store is there").resident.touch(key(tx)),
            }
            let pinned = terrain.loaded.iter().filter(|loaded| loaded.pinned).count() as u64;
            let most = (limit as u64).max(pinned) * size;
            prop_assert!(terrain.bytes() <= most, "{} tiles", terrain.bytes() / size);
            let distinct: BTreeSet<_> = in_memory(&terrain).into_iter().map(|tx| tx % 5).collect();
            prop_assert!(distinct.len() as u64 * size <= terrain.bytes());
            let stowed = terrain.pantry.bytes();
            prop_assert!(stowed <= limit as u64 * size / PANTRY_PART);
        }
    }
}
