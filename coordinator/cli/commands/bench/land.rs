//! Terrain of a bench: made or opened, and loaded whole.
//!
//! What is made is written as a store to a temporary folder and read back: a method sees
//! the same coarser levels and error bounds as in a render.

pub mod noise;

use anyhow::{Context, bail};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use tempfile::TempDir;
use terrafarm_common::shading::Earth;
use terrafarm_import::{ImportRequest, ImportSettings};
use terrafarm_raycast::Pyramid;
use terrafarm_synth::SynthSpec;
use terrafarm_terrain::build::{LayerSource, LayerSpec, SourceError, StoreBuilder};
use terrafarm_terrain::layout::{
    HeightDatum, ImportReport, Layer, LayerKind, Level, PostWindow, StoreIndex, TILE_CELLS,
    TileEntry, TileKey,
};
use terrafarm_terrain::resident::{Resident, Tile};
use terrafarm_terrain::sample::Sampler;
use terrafarm_terrain::store::StoreReader;
use terrafarm_terrain::tile::{HEIGHT_TILE_BYTES, PHOTO_TILE_BYTES};

/// Memory that the tiles of a bench may take, bytes.
const MAX_LOADED_BYTES: u64 = 16 << 30;
/// Distance between the posts of noise, metres.
const NOISE_SPACING_M: f64 = 10.0;
/// Coefficient of refraction over a round Earth, that of ordinary air.
const REFRACTION: f64 = 0.13;

/// Terrain with its tiles in memory.
pub struct Land {
    /// What to call it.
    pub name: String,
    /// Its file.
    pub store: StoreReader,
    /// Its tiles.
    pub resident: Resident,
    /// The maxima of its index.
    pub pyramid: Pyramid,
    /// Memory of the tiles of heights, bytes.
    height_bytes: usize,
    /// Goes away with the land.
    _folder: Option<TempDir>,
}

/// Which layers are loaded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Load {
    /// Those that rays meet.
    Heights,
    /// All.
    All,
}

/// Heights as a function of column and row.
pub struct Rule<F>(pub F);

impl<F: Fn(u64, u64) -> f32 + Sync> LayerSource for Rule<F> {
    fn heights(&self, window: PostWindow, into: &mut [f32]) -> Result<(), SourceError> {
        window.fill(into, &self.0);
        Ok(())
    }
}

/// Colours as a function of column and row: sRGB, opaque.
pub struct Paint<F>(pub F);

impl<F: Fn(u64, u64) -> [u8; 3] + Sync> LayerSource for Paint<F> {
    fn colors(&self, window: PostWindow, into: &mut [[u8; 4]]) -> Result<(), SourceError> {
        window.fill(into, |i, j| {
            let [r, g, b] = self.0(i, j);
            [r, g, b, 255]
        });
        Ok(())
    }
}

impl Land {
    /// Opens a store and loads it.
    pub fn open(path: &Path, load: Load) -> anyhow::Result<Land> {
        Self::load(path.display().to_string(), StoreReader::open(path)?, load, None)
    }

    /// Value noise with 2 km of relief and posts 10 m apart, nowhere on Earth.
    pub fn noise(posts: u32) -> anyhow::Result<Land> {
        let side = u64::from(posts);
        let spec = height_layer([NOISE_SPACING_M; 2], [side; 2], Some(noise::QUANTUM_M));
        Self::made(&format!("noise {posts}"), None, spec, &Rule(noise::height))
    }

    /// Eroded mountains with a photo.
    pub fn synth(spec: SynthSpec) -> anyhow::Result<Land> {
        let folder = tempfile::tempdir().context("cannot make a temporary folder")?;
        let path = folder.path().join("synth.terrain");
        terrafarm_synth::write_store(spec, &path, &|_| (), &AtomicBool::new(false))?;
        let name = format!("synth {}", spec.posts);
        Self::load(name, StoreReader::open(&path)?, Load::All, Some(folder))
    }

    /// A single layer of heights, over an Earth of this radius if there is one.
    pub fn made(
        name: &str,
        earth_radius_m: Option<f64>,
        spec: LayerSpec,
        heights: &dyn LayerSource,
    ) -> anyhow::Result<Land> {
        let folder = tempfile::tempdir().context("cannot make a temporary folder")?;
        let path = folder.path().join("made.terrain");
        let mut builder =
            StoreBuilder::create(&path, "LOCAL", HeightDatum::Unknown, earth_radius_m)?;
        builder.add_layer(spec, heights, &|_, _| (), &AtomicBool::new(false))?;
        builder.finish(ImportReport::default())?;
        Self::load(name.to_owned(), StoreReader::open(&path)?, Load::Heights, Some(folder))
    }

    /// A photo over level ground of one cell, its south-west pixel at (0, 0).
    pub fn photo(
        name: &str,
        spacing_m: f64,
        pixels: u64,
        colors: &dyn LayerSource,
    ) -> anyhow::Result<Land> {
        let side = (pixels - 1) as f64 * spacing_m;
        let folder = tempfile::tempdir().context("cannot make a temporary folder")?;
        let path = folder.path().join("photo.terrain");
        let mut builder = StoreBuilder::create(&path, "LOCAL", HeightDatum::Unknown, None)?;
        let ground = height_layer([side; 2], [2; 2], Some(1.0));
        let photo = LayerSpec {
            kind: LayerKind::Photo,
            quantum_m: None,
            ..height_layer([spacing_m; 2], [pixels; 2], None)
        };
        let stop = AtomicBool::new(false);
        builder.add_layer(ground, &Rule(|_, _| 0.0), &|_, _| (), &stop)?;
        builder.add_layer(photo, colors, &|_, _| (), &stop)?;
        builder.finish(ImportReport::default())?;
        Self::load(name.to_owned(), StoreReader::open(&path)?, Load::All, Some(folder))
    }

    /// Files of elevation, by name and content, imported as those of a user are.
    pub fn imported(
        name: &str,
        files: &[(&str, String)],
        source_crs: &str,
    ) -> anyhow::Result<Land> {
        let folder = tempfile::tempdir().context("cannot make a temporary folder")?;
        let mut request = ImportRequest {
            output: folder.path().join("imported.terrain"),
            settings: ImportSettings { source_crs: Some(source_crs.into()), ..Default::default() },
            ..ImportRequest::default()
        };
        for (file, content) in files {
            let path = folder.path().join(file);
            std::fs::write(&path, content)
                .with_context(|| format!("cannot write {}", path.display()))?;
            request.elevation.push(path);
        }
        terrafarm_import::import(&request, &|_| (), &AtomicBool::new(false))?;
        let store = StoreReader::open(&request.output)?;
        Self::load(name.to_owned(), store, Load::Heights, Some(folder))
    }

    /// The only tile of a land as the north-east corner of one of so many cells, all else
    /// void. Coarser levels repeat the tile and say that it cannot be compared, as those of
    /// tiles with voids do: nobody who heeds that looks at them.
    pub fn moved_to_far_corner(self, cells: [u64; 2]) -> anyhow::Result<Land> {
        let mut index = StoreIndex::clone(self.resident.index());
        let layer = &mut index.layers[0];
        let own = layer.levels[0].entries[0];
        let origin = [0, 1].map(|axis| {
            layer.origin[axis] - (cells[axis] - TILE_CELLS as u64) as f64 * layer.spacing[axis]
        });
        (layer.origin, layer.posts) = (origin, cells.map(|cells| cells + 1));
        let level = |level: usize| {
            let tiles = Layer::tiles_for(layer.level_posts(level));
            let mut entries = vec![TileEntry::EMPTY; tiles[0] as usize * tiles[1] as usize];
            if let Some(last) = entries.last_mut() {
                let deviation = if level == 0 { 0.0 } else { f32::INFINITY };
                *last = TileEntry { deviation, ..own };
            }
            Level { tiles, entries }
        };
        layer.levels = (0..Layer::level_count(layer.posts)).map(level).collect();
        index.check().map_err(|why| anyhow::anyhow!("{}: {why}", self.name))?;
        let mut resident = Resident::new(Arc::new(index));
        let first = TileKey { layer: 0, level: 0, tx: 0, ty: 0 };
        for (number, level) in resident.index().clone().layers[0].levels.iter().enumerate() {
            if let Some(tile) = self.store.read_tile(first)? {
                let [tx, ty] = level.tiles.map(|count| count - 1);
                resident.insert(TileKey { layer: 0, level: number as u16, tx, ty }, tile);
            }
        }
        let pyramid = Pyramid::new(resident.index());
        Ok(Land { resident, pyramid, ..self })
    }

    fn load(
        name: String,
        store: StoreReader,
        load: Load,
        folder: Option<TempDir>,
    ) -> anyhow::Result<Land> {
        let index = store.index().clone();
        let keys = keys(&index, load);
        let bytes: u64 = keys
            .iter()
            .map(|key| match index.layers[usize::from(key.layer)].kind {
                LayerKind::Height => HEIGHT_TILE_BYTES as u64,
                LayerKind::Photo => PHOTO_TILE_BYTES as u64,
            })
            .sum();
        if bytes > MAX_LOADED_BYTES {
            bail!(
                "{name}: its tiles take {} MiB in memory, a bench loads at most {}; \
                 choose smaller terrain",
                bytes >> 20,
                MAX_LOADED_BYTES >> 20
            );
        }
        let mut resident = Resident::new(index.clone());
        let mut height_bytes = 0;
        for key in keys {
            if let Some(tile) = store.read_tile(key)? {
                if tile.kind() == LayerKind::Height {
                    height_bytes += tile.memory_bytes();
                }
                resident.insert(key, tile);
            }
        }
        let pyramid = Pyramid::new(&index);
        Ok(Land { name, store, resident, pyramid, height_bytes, _folder: folder })
    }

    /// All of its tiles, read anew.
    pub fn tiles(&self) -> anyhow::Result<Vec<(TileKey, Tile)>> {
        let mut tiles = Vec::new();
        for key in keys(self.store.index(), Load::All) {
            if let Some(tile) = self.store.read_tile(key)? {
                tiles.push((key, tile));
            }
        }
        Ok(tiles)
    }

    /// The Earth under it; flat if the store lies nowhere on it.
    pub fn earth(&self) -> Option<Earth> {
        let radius = self.resident.index().earth_radius_m;
        radius.map(|radius_m| Earth { radius_m, refraction: REFRACTION })
    }

    /// Memory of its tiles of heights, all levels, per post of level 0, bytes.
    pub fn bytes_per_post(&self) -> f64 {
        let index = self.resident.index();
        let layers = index.layers_of(LayerKind::Height);
        let posts: f64 =
            layers.map(|(_, layer)| layer.posts[0] as f64 * layer.posts[1] as f64).sum();
        self.height_bytes as f64 / posts.max(1.0)
    }

    /// South-west and north-east corner of its first layer, metres.
    pub fn corners(&self) -> [[f64; 2]; 2] {
        let layer = &self.resident.index().layers[0];
        [layer.origin, layer.far_corner()]
    }

    /// The place at a share of the way from the south-west to the north-east corner.
    pub fn at(&self, share: f64) -> [f64; 2] {
        let [near, far] = self.corners();
        [0, 1].map(|axis| near[axis] + share * (far[axis] - near[axis]))
    }

    /// The highest ground within so many metres east, west, north and south of a place,
    /// looked at in 61 x 61 points; 0 where there is none.
    pub fn highest_around(&self, at: [f64; 2], reach_m: f64) -> anyhow::Result<f64> {
        let mut sampler = Sampler::new(&self.store);
        let mut highest = f64::NEG_INFINITY;
        for j in -30..=30 {
            for i in -30..=30 {
                let [x, y] = [i, j].map(|step| f64::from(step) / 30.0 * reach_m);
                let ground = sampler.height_at(at[0] + x, at[1] + y)?;
                highest = highest.max(ground.unwrap_or(f64::NEG_INFINITY));
            }
        }
        Ok(if highest.is_finite() { highest } else { 0.0 })
    }
}

/// A layer of heights with its south-west post at (0, 0).
pub fn height_layer(spacing: [f64; 2], posts: [u64; 2], quantum_m: Option<f32>) -> LayerSpec {
    LayerSpec { kind: LayerKind::Height, origin: [0.0; 2], spacing, posts, quantum_m }
}

fn keys(index: &StoreIndex, load: Load) -> Vec<TileKey> {
    let wanted = |kind| load == Load::All || kind == LayerKind::Height;
    let mut keys = Vec::new();
    for (layer, grids) in index.layers.iter().enumerate().filter(|(_, l)| wanted(l.kind)) {
        for (level, grid) in grids.levels.iter().enumerate() {
            for (at, entry) in grid.entries.iter().enumerate() {
                if !entry.is_empty() {
                    let (tx, ty) = (at as u32 % grid.tiles[0], at as u32 / grid.tiles[0]);
                    keys.push(TileKey { layer: layer as u16, level: level as u16, tx, ty });
                }
            }
        }
    }
    keys
}
