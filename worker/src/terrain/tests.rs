//! Tiles, a limit, and what goes first.

use super::*;
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
    let posts = vec![0.0; TILE_POSTS * TILE_POSTS].into_boxed_slice();
    Tile::Height(Arc::new(HeightTile::new(posts).expect("the right number of posts")))
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
fn a_tile_that_nobody_awaits_changes_nothing() {
    let mut terrain = terrain(9);
    terrain.await_tiles(STORE, &[key(0)]);
    terrain.begin_job(SHOT, 0);
    terrain.add_tile(BlobHash([10; 32]), &tile()).expect("it is dropped");
    assert!(in_memory(&terrain).is_empty());
    assert_eq!(terrain.bytes(), 0);
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
