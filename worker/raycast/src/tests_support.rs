//! Stores in memory for tests and examples: terrain and photos from plain functions.

use std::sync::Arc;
use terrafarm_common::id::BlobHash;
use terrafarm_terrain::layout::{
    HeightDatum, ImportReport, Layer, LayerKind, Level, STORE_VERSION, StoreIndex, TILE_CELLS,
    TILE_POSTS, TileEntry, TileKey,
};
use terrafarm_terrain::resident::{Resident, Tile};
use terrafarm_terrain::tile::{HeightTile, PhotoTile};

/// A layer in the making.
pub struct Plan {
    pub origin: [f64; 2],
    pub spacing: [f64; 2],
    pub posts: [u64; 2],
    pub samples: Samples,
}

/// The samples of a layer: by post of level 0, row by row from the south-west.
pub enum Samples {
    Heights(Vec<f32>),
    /// Linear light and coverage, premultiplied.
    Colors(Vec<[f32; 4]>),
}

impl Plan {
    pub fn heights(
        origin: [f64; 2],
        spacing: [f64; 2],
        posts: [u64; 2],
        height: impl Fn(u64, u64) -> f32,
    ) -> Self {
        let heights = places(posts).map(|(i, j)| height(i, j)).collect();
        Plan { origin, spacing, posts, samples: Samples::Heights(heights) }
    }

    pub fn photo(
        origin: [f64; 2],
        spacing: [f64; 2],
        posts: [u64; 2],
        color: impl Fn(u64, u64) -> [f32; 4],
    ) -> Self {
        let colors = places(posts).map(|(i, j)| color(i, j)).collect();
        Plan { origin, spacing, posts, samples: Samples::Colors(colors) }
    }
}

fn places(posts: [u64; 2]) -> impl Iterator<Item = (u64, u64)> {
    (0..posts[1]).flat_map(move |j| (0..posts[0]).map(move |i| (i, j)))
}

/// A store with all of its tiles loaded. Heights first, as an index has them.
pub fn resident(plans: Vec<Plan>) -> Resident {
    let (mut resident, tiles) = store(plans);
    for (key, tile) in tiles {
        assert!(resident.insert(key, tile));
    }
    resident
}

/// A store without any tile in memory, and all of its tiles that are not empty.
pub fn store(plans: Vec<Plan>) -> (Resident, Vec<(TileKey, Tile)>) {
    let mut tiles = Vec::new();
    let mut layers = Vec::new();
    for (number, plan) in plans.into_iter().enumerate() {
        layers.push(build_layer(number, plan, &mut tiles));
    }
    let index = StoreIndex {
        version: STORE_VERSION,
        crs: "LOCAL".into(),
        height_datum: HeightDatum::Unknown,
        earth_radius_m: None,
        layers,
        report: ImportReport::default(),
    };
    index.check().expect("the plans make a sound index");
    (Resident::new(Arc::new(index)), tiles)
}

/// All tiles of a store that are not empty.
pub fn keys(index: &StoreIndex) -> Vec<TileKey> {
    let mut keys = Vec::new();
    for (layer, plan) in index.layers.iter().enumerate() {
        for (level, grid) in plan.levels.iter().enumerate() {
            for (at, entry) in grid.entries.iter().enumerate() {
                let (tx, ty) = (at as u32 % grid.tiles[0], at as u32 / grid.tiles[0]);
                if !entry.is_empty() {
                    keys.push(TileKey { layer: layer as u16, level: level as u16, tx, ty });
                }
            }
        }
    }
    keys
}

fn build_layer(number: usize, plan: Plan, tiles: &mut Vec<(TileKey, Tile)>) -> Layer {
    let kind = match plan.samples {
        Samples::Heights(_) => LayerKind::Height,
        Samples::Colors(_) => LayerKind::Photo,
    };
    let Plan { origin, spacing, posts, mut samples } = plan;
    let mut layer = Layer { kind, origin, spacing, posts, levels: Vec::new() };
    for level in 0..Layer::level_count(posts) {
        let size = layer.level_posts(level);
        if level > 0 {
            samples = samples.halved(layer.level_posts(level - 1), size);
        }
        let count = Layer::tiles_for(size);
        let mut entries = Vec::new();
        for ty in 0..count[1] {
            for tx in 0..count[0] {
                let key = TileKey { layer: number as u16, level: level as u16, tx, ty };
                let (mut entry, tile) = samples.tile(size, tx, ty);
                if level > 0 {
                    // Nobody has measured it.
                    entry.deviation = f32::INFINITY;
                }
                entries.push(entry);
                if let Some(tile) = tile {
                    tiles.push((key, tile));
                }
            }
        }
        layer.levels.push(Level { tiles: count, entries });
    }
    layer
}

impl Samples {
    /// Every second post; colours and heights smoothed by 1 2 1 before.
    fn halved(&self, from: [u64; 2], to: [u64; 2]) -> Samples {
        let smooth = |at: &dyn Fn(u64, u64) -> [f32; 4], i: u64, j: u64| {
            let mut sum = [0.0f32; 4];
            for (dj, wj) in [(0, 0.25), (1, 0.5), (2, 0.25)] {
                for (di, wi) in [(0, 0.25), (1, 0.5), (2, 0.25)] {
                    let inside = |k: u64, d: u64, n: u64| (2 * k + d).saturating_sub(1).min(n - 1);
                    let value = at(inside(i, di, from[0]), inside(j, dj, from[1]));
                    (0..4).for_each(|c| sum[c] += value[c] * wi * wj);
                }
            }
            sum
        };
        let index = |i: u64, j: u64| (j * from[0] + i) as usize;
        match self {
            Samples::Heights(heights) => {
                let at = |i, j| [heights[index(i, j)]; 4];
                Samples::Heights(places(to).map(|(i, j)| smooth(&at, i, j)[0]).collect())
            }
            Samples::Colors(colors) => {
                let at = |i, j| colors[index(i, j)];
                Samples::Colors(places(to).map(|(i, j)| smooth(&at, i, j)).collect())
            }
        }
    }

    fn tile(&self, size: [u64; 2], tx: u32, ty: u32) -> (TileEntry, Option<Tile>) {
        let cells = TILE_CELLS as i64;
        let spots = (0..TILE_POSTS * TILE_POSTS).map(|at| {
            let i = i64::from(tx) * cells + (at % TILE_POSTS) as i64 - 1;
            let j = i64::from(ty) * cells + (at / TILE_POSTS) as i64 - 1;
            (i, j)
        });
        let inside =
            |i: i64, j: i64| (0..size[0] as i64).contains(&i) && (0..size[1] as i64).contains(&j);
        let made = BlobHash([1; 32]);
        match self {
            Samples::Heights(heights) => {
                let post = |(i, j): (i64, i64)| {
                    if inside(i, j) { heights[(j * size[0] as i64 + i) as usize] } else { f32::NAN }
                };
                let posts: Box<[f32]> = spots.map(post).collect();
                let (mut min, mut max) = (f32::INFINITY, f32::NEG_INFINITY);
                for j in 1..TILE_POSTS - 1 {
                    for height in &posts[j * TILE_POSTS + 1..(j + 1) * TILE_POSTS - 1] {
                        min = min.min(*height);
                        max = max.max(*height);
                    }
                }
                if min > max {
                    return (TileEntry::EMPTY, None);
                }
                let entry =
                    TileEntry { hash: made, offset: 0, length: 1, min, max, deviation: 0.0 };
                (entry, HeightTile::new(posts).map(|tile| Tile::Height(Arc::new(tile))))
            }
            Samples::Colors(colors) => {
                let clamped = |k: i64, n: u64| k.clamp(0, n as i64 - 1);
                let texel = |(i, j): (i64, i64)| {
                    let at = clamped(j, size[1]) * size[0] as i64 + clamped(i, size[0]);
                    colors[at as usize].map(|value| (value * 65535.0 + 0.5) as u16)
                };
                let tile = PhotoTile::new(&spots.map(texel).collect::<Vec<_>>());
                let entry = TileEntry { hash: made, length: 1, ..TileEntry::EMPTY };
                (TileEntry { min: 0.0, max: 0.0, ..entry }, tile.map(|t| Tile::Photo(Arc::new(t))))
            }
        }
    }
}

/// A number from -1 to 1 out of three.
pub fn noise(x: u64, y: u64, seed: u64) -> f32 {
    let mut bits = x.wrapping_mul(0x9E37_79B9_7F4A_7C15)
        ^ y.wrapping_mul(0xC2B2_AE3D_27D4_EB4F)
        ^ seed.wrapping_mul(0x1656_67B1_9E37_79F9);
    bits = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    bits = (bits ^ (bits >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((bits >> 40) as f32) / 8_388_608.0 - 1.0
}

/// Value noise in octaves from `longest` posts down to 2, about `relief` from the mean.
pub fn mountains(i: u64, j: u64, longest: u64, relief: f32, seed: u64) -> f32 {
    let mut sum = 0.0;
    let (mut wave, mut amplitude, mut octave) = (longest, relief, seed);
    while wave >= 2 {
        let (cx, cy) = (i / wave, j / wave);
        let ease = |t: f32| t * t * t * (t * (t * 6.0 - 15.0) + 10.0);
        let u = ease((i % wave) as f32 / wave as f32);
        let v = ease((j % wave) as f32 / wave as f32);
        let at = |dx, dy| noise(cx + dx, cy + dy, octave);
        let south = at(0, 0) + (at(1, 0) - at(0, 0)) * u;
        let north = at(0, 1) + (at(1, 1) - at(0, 1)) * u;
        sum += amplitude * (south + (north - south) * v);
        amplitude *= 0.53;
        wave /= 2;
        octave += 1;
    }
    sum
}
