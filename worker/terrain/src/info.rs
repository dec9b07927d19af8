//! What `terrafarm terrain info` says of a store. Field names are read by scripts.

use crate::layout::{HeightDatum, ImportReport, Layer, LayerKind, TileEntry};
use crate::store::StoreReader;
use crate::tile::{HEIGHT_TILE_BYTES, PHOTO_TILE_BYTES};
use serde::Serialize;
use std::collections::HashSet;

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
    /// Bytes in memory for each post of level 0 with all tiles of all levels loaded,
    /// rings and maxima included.
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

/// Sums up an open store from its index alone.
pub fn summary(store: &StoreReader) -> StoreInfo {
    let index = store.index();
    let layers: Vec<LayerInfo> = index.layers.iter().map(layer_info).collect();
    let heights = || index.layers_of(LayerKind::Height).map(|(_, layer)| layer);
    let corner = |start: f64, pick: fn(f64, f64) -> f64, of: fn(&Layer) -> [f64; 2]| {
        [0, 1].map(|axis| heights().map(|layer| of(layer)[axis]).fold(start, pick))
    };
    StoreInfo {
        hash: store.index_blob().0.to_hex(),
        file_bytes: store.file_bytes(),
        crs: index.crs.clone(),
        height_datum: index.height_datum,
        earth_radius_m: index.earth_radius_m,
        min: corner(f64::INFINITY, f64::min, |layer| layer.origin),
        max: corner(f64::NEG_INFINITY, f64::max, Layer::far_corner),
        height_range_m: layers
            .iter()
            .filter_map(|layer| layer.height_range_m)
            .reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])]),
        height_posts: heights().map(|layer| layer.posts[0] * layer.posts[1]).sum(),
        void_posts: index.report.void_posts,
        layers,
        report: index.report.clone(),
    }
}

fn layer_info(layer: &Layer) -> LayerInfo {
    let levels: Vec<LevelInfo> =
        (0..layer.levels.len()).map(|level| level_info(layer, level)).collect();
    let posts = (layer.posts[0] * layer.posts[1]) as f64;
    let tile_bytes = match layer.kind {
        LayerKind::Height => HEIGHT_TILE_BYTES,
        LayerKind::Photo => PHOTO_TILE_BYTES,
    };
    let tiles: u64 = levels.iter().map(|level| level.filled_tiles).sum();
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
        memory_bytes_per_post: tiles as f64 * tile_bytes as f64 / posts,
        levels,
    }
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
        let tiles: u64 = base.levels.iter().map(|level| level.filled_tiles).sum();
        let expected = (tiles as usize * HEIGHT_TILE_BYTES) as f64 / 180_000.0;
        assert_eq!(base.memory_bytes_per_post, expected);
        assert_eq!(info.layers[2].height_range_m, None);
    }
}
