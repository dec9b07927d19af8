//! What `terrafarm terrain info` says of a store. Field names are read by scripts.

use crate::layout::{HeightDatum, ImportReport, Layer, LayerKind, StoreIndex, TileEntry, TileKey};
use crate::store::StoreReader;
use crate::tile::{HEIGHT_TILE_BYTES, PHOTO_TILE_BYTES};
use rayon::prelude::*;
use serde::Serialize;
use std::collections::HashSet;

/// Tiles of a level that are read, evenly spread, to learn what they take in memory.
const MEASURED_TILES: usize = 64;

/// A store in figures.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StoreInfo {
    /// Identity of the store: hash of its index, 64 hexadecimal digits.
    pub hash: String,
    /// Length of the file, bytes.
    pub file_bytes: u64,
    /// The metric system of the grid.
    pub crs: String,
    /// What the heights are measured from.
    pub height_datum: HeightDatum,
    /// Radius of curvature of the Earth there, metres.
    pub earth_radius_m: Option<f64>,
    /// South-west corner of all height layers, metres.
    pub min: [f64; 2],
    /// North-east corner of all height layers, metres.
    pub max: [f64; 2],
    /// Lowest and highest post, metres; `None` if all are void.
    pub height_range_m: Option<[f32; 2]>,
    /// Level 0 posts of the height layers.
    pub height_posts: u64,
    /// How many of them are void.
    pub void_posts: u64,
    /// Bytes in memory for each of them with all tiles of all levels of the height layers
    /// loaded, rings and maxima included. Measured on the tiles themselves: on all of a
    /// level of up to 64, else on 64 of them; one that cannot be read counts as the
    /// largest.
    pub bytes_per_post: f64,
    /// The layers, in the order of the index.
    pub layers: Vec<LayerInfo>,
    /// How the store was made.
    pub report: ImportReport,
}

/// A layer in figures.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LayerInfo {
    /// Heights or colours.
    pub kind: LayerKind,
    /// Position of the south-west post, metres.
    pub origin: [f64; 2],
    /// Distance between posts, metres.
    pub spacing_m: [f64; 2],
    /// Number of posts of level 0.
    pub posts: [u64; 2],
    /// Lowest and highest post of level 0, metres; `None` for photos and voids.
    pub height_range_m: Option<[f32; 2]>,
    /// Bytes in the file for each post of level 0, all levels included.
    pub disk_bytes_per_post: f64,
    /// Bytes in memory for each post of level 0, measured as
    /// [`StoreInfo::bytes_per_post`] is.
    pub memory_bytes_per_post: f64,
    /// The levels, finest first.
    pub levels: Vec<LevelInfo>,
}

/// A level in figures.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LevelInfo {
    /// Number of posts.
    pub posts: [u64; 2],
    /// Number of tiles along x and y.
    pub tiles: [u32; 2],
    /// Tiles that hold anything.
    pub filled_tiles: u64,
    /// Length of its tiles in the file, each content counted once, bytes.
    pub bytes: u64,
    /// Largest distance of its surface from level 0, metres, over the tiles where the two
    /// can be compared.
    pub deviation_m: f32,
    /// Tiles where voids make them incomparable.
    pub incomparable_tiles: u64,
}

/// South-west and north-east corner of all height layers, metres.
pub fn bounds(index: &StoreIndex) -> [[f64; 2]; 2] {
    let heights = || index.layers_of(LayerKind::Height).map(|(_, layer)| layer);
    let corner = |start: f64, pick: fn(f64, f64) -> f64, of: fn(&Layer) -> [f64; 2]| {
        [0, 1].map(|axis| heights().map(|layer| of(layer)[axis]).fold(start, pick))
    };
    let min = corner(f64::INFINITY, f64::min, |layer| layer.origin);
    [min, corner(f64::NEG_INFINITY, f64::max, Layer::far_corner)]
}

/// Sums up an open store: from its index, and from some tiles of each level.
pub fn summary(store: &StoreReader) -> StoreInfo {
    let index = store.index();
    let layers: Vec<LayerInfo> =
        (0..index.layers.len()).map(|number| layer_info(store, number)).collect();
    let heights = || layers.iter().filter(|layer| layer.kind == LayerKind::Height);
    let posts_of = |layer: &LayerInfo| layer.posts[0] * layer.posts[1];
    let height_posts: u64 = heights().map(posts_of).sum();
    let memory_bytes: f64 =
        heights().map(|layer| layer.memory_bytes_per_post * posts_of(layer) as f64).sum();
    let [min, max] = bounds(index);
    StoreInfo {
        hash: store.index_blob().0.to_hex(),
        file_bytes: store.file_bytes(),
        crs: index.crs.clone(),
        height_datum: index.height_datum,
        earth_radius_m: index.earth_radius_m,
        min,
        max,
        height_range_m: layers
            .iter()
            .filter_map(|layer| layer.height_range_m)
            .reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])]),
        height_posts,
        void_posts: index.report.void_posts,
        bytes_per_post: memory_bytes / height_posts as f64,
        layers,
        report: index.report.clone(),
    }
}

fn layer_info(store: &StoreReader, number: usize) -> LayerInfo {
    let layer = &store.index().layers[number];
    let levels: Vec<LevelInfo> =
        (0..layer.levels.len()).map(|level| level_info(layer, level)).collect();
    let posts = (layer.posts[0] * layer.posts[1]) as f64;
    let memory_bytes: f64 =
        (0..layer.levels.len()).map(|level| memory_bytes(store, number, level)).sum();
    let bytes: u64 = levels.iter().map(|level| level.bytes).sum();
    LayerInfo {
        kind: layer.kind,
        origin: layer.origin,
        spacing_m: layer.spacing,
        posts: layer.posts,
        height_range_m: match layer.kind {
            LayerKind::Height => filled(&layer.levels[0].entries)
                .map(|entry| [entry.min, entry.max])
                .reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])]),
            LayerKind::Photo => None,
        },
        disk_bytes_per_post: bytes as f64 / posts,
        memory_bytes_per_post: memory_bytes / posts,
        levels,
    }
}

/// What the tiles of a level take in memory, from some of them; see
/// [`StoreInfo::bytes_per_post`].
fn memory_bytes(store: &StoreReader, layer: usize, level: usize) -> f64 {
    let Layer { kind, ref levels, .. } = store.index().layers[layer];
    let entries = levels[level].entries.iter().enumerate();
    let filled: Vec<usize> =
        entries.filter(|(_, entry)| !entry.is_empty()).map(|(at, _)| at).collect();
    if kind == LayerKind::Photo {
        return (filled.len() * PHOTO_TILE_BYTES) as f64;
    }
    let measured = filled.len().min(MEASURED_TILES);
    if measured == 0 {
        return 0.0;
    }
    let columns = levels[level].tiles[0] as usize;
    let tile_bytes = |n: usize| {
        let at = filled[n * filled.len() / measured];
        let (tx, ty) = ((at % columns) as u32, (at / columns) as u32);
        let key = TileKey { layer: layer as u16, level: level as u16, tx, ty };
        let tile = store.read_tile(key).ok().flatten();
        tile.map_or(HEIGHT_TILE_BYTES, |tile| tile.memory_bytes())
    };
    let bytes: usize = (0..measured).into_par_iter().map(tile_bytes).sum();
    bytes as f64 * (filled.len() as f64 / measured as f64)
}

fn level_info(layer: &Layer, number: usize) -> LevelInfo {
    let level = &layer.levels[number];
    let distinct: HashSet<(u64, u32)> =
        filled(&level.entries).map(|entry| (entry.offset, entry.length)).collect();
    let comparable = || filled(&level.entries).filter(|entry| entry.deviation.is_finite());
    let filled_tiles = filled(&level.entries).count() as u64;
    LevelInfo {
        posts: layer.level_posts(number),
        tiles: level.tiles,
        filled_tiles,
        bytes: distinct.iter().map(|&(_, length)| u64::from(length)).sum(),
        deviation_m: comparable().map(|entry| entry.deviation).fold(0.0, f32::max),
        incomparable_tiles: filled_tiles - comparable().count() as u64,
    }
}

fn filled(entries: &[TileEntry]) -> impl Iterator<Item = &TileEntry> {
    entries.iter().filter(|entry| !entry.is_empty())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::build::LayerSpec;
    use crate::fixture::{Ground, height_layer, hills};

    #[test]
    fn a_store_is_summed_up() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.terrain");
        let inset =
            LayerSpec { origin: [-50.0, 20.0], spacing: [1.0; 2], ..height_layer([11, 31]) };
        Ground::new()
            .heights(height_layer([600, 300]), |i, j| if i < 11 { f32::NAN } else { hills(i, j) })
            .heights(inset, |_, _| 500.0)
            .colors(height_layer([30, 20]), |i, j| [i as u8, j as u8, 0, 255])
            .build(&path)
            .unwrap();
        let store = StoreReader::open(&path).unwrap();
        let info = summary(&store);
        assert_eq!((info.min, info.max), ([-50.0, 0.0], [5990.0, 2990.0]));
        assert_eq!(info.height_range_m, Some([30.0, 500.0]));
        assert_eq!((info.height_posts, info.void_posts), (600 * 300 + 11 * 31, 3300));
        assert_eq!(info.file_bytes, std::fs::metadata(&path).unwrap().len());
        assert_eq!(info.hash.len(), 64);

        let base = &info.layers[0];
        assert_eq!(base.levels.len(), 3);
        assert_eq!(base.levels[0].tiles, [3, 2]);
        assert_eq!((base.levels[0].deviation_m, base.levels[0].incomparable_tiles), (0.0, 0));
        assert_eq!(base.levels[1].posts, [301, 151]);
        assert_eq!(base.levels[1].incomparable_tiles, 1, "where a void meets the ground");
        assert!(base.levels[1].deviation_m > 0.0);
        let memory = |number: u16| {
            let levels = store.index().layers[usize::from(number)].levels.iter().enumerate();
            let keys = levels.flat_map(|(level, grid)| {
                let place = move |at: u32| (at % grid.tiles[0], at / grid.tiles[0]);
                (0..grid.entries.len() as u32).map(place).map(move |(tx, ty)| TileKey {
                    layer: number,
                    level: level as u16,
                    tx,
                    ty,
                })
            });
            let tiles = keys.filter_map(|key| store.read_tile(key).unwrap());
            tiles.map(|tile| tile.memory_bytes()).sum::<usize>() as f64
        };
        let near = |a: f64, b: f64| (a / b - 1.0).abs() < 1e-12;
        assert!(near(base.memory_bytes_per_post, memory(0) / 180_000.0));
        assert!(near(info.bytes_per_post, (memory(0) + memory(1)) / (180_000.0 + 341.0)));
        assert!(near(info.layers[2].memory_bytes_per_post, memory(2) / 600.0));
        assert_eq!(info.layers[2].height_range_m, None);
    }

    #[test]
    fn many_tiles_are_estimated_from_some_and_damaged_ones_count_in_full() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.terrain");
        let summary = || super::summary(&StoreReader::open(&path).unwrap());
        Ground::new().heights(height_layer([20 * 256 + 1; 2]), hills).build(&path).unwrap();
        let whole = summary();
        assert!((2.7..4.0).contains(&whole.bytes_per_post), "{}", whole.bytes_per_post);

        let entries = StoreReader::open(&path).unwrap().index().layers[0].levels[0].entries.clone();
        let mut bytes = std::fs::read(&path).unwrap();
        for entry in entries {
            bytes[entry.offset as usize + 40] ^= 1;
        }
        std::fs::write(&path, bytes).unwrap();
        assert!(summary().bytes_per_post > 5.0);
    }
}
