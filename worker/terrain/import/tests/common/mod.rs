//! Rasters in memory, and stores read back whole.

#![allow(clippy::unwrap_used, dead_code, missing_docs)]

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use terrafarm_import::{ImportError, ImportSettings, ImportSummary, Sources, import_rasters};
use terrafarm_raster::info::{
    Content, GeoTransform, Raster, RasterError, RasterInfo, Vertical, Window,
};
use terrafarm_terrain::layout::{Layer, TILE_CELLS, TileKey};
use terrafarm_terrain::resident::Tile;
use terrafarm_terrain::store::StoreReader;

pub struct MemoryRaster {
    pub info: RasterInfo,
    pub heights: Vec<f32>,
    pub colors: Vec<[u8; 4]>,
}

impl MemoryRaster {
    /// North-up heights from a function of x, y; `north_west` is the first sample.
    pub fn heights(
        crs: &str,
        north_west: [f64; 2],
        step: [f64; 2],
        size: [u64; 2],
        height: impl Fn(f64, f64) -> f32,
    ) -> MemoryRaster {
        let transform = GeoTransform {
            origin: north_west,
            step_column: [step[0], 0.0],
            step_row: [0.0, -step[1]],
        };
        Self::with_transform(crs, transform, size, height)
    }

    pub fn with_transform(
        crs: &str,
        transform: GeoTransform,
        size: [u64; 2],
        height: impl Fn(f64, f64) -> f32,
    ) -> MemoryRaster {
        let place = |n: u64| {
            let (column, row) = ((n % size[0]) as f64, (n / size[0]) as f64);
            [0, 1].map(|axis| {
                transform.origin[axis]
                    + column * transform.step_column[axis]
                    + row * transform.step_row[axis]
            })
        };
        let heights = (0..size[0] * size[1]).map(|n| {
            let [x, y] = place(n);
            height(x, y)
        });
        MemoryRaster {
            heights: heights.collect(),
            colors: Vec::new(),
            info: info(crs, transform, size, Content::Heights),
        }
    }

    pub fn photo(
        crs: &str,
        north_west: [f64; 2],
        step: [f64; 2],
        size: [u64; 2],
        color: impl Fn(u64, u64) -> [u8; 4],
    ) -> MemoryRaster {
        let transform = GeoTransform {
            origin: north_west,
            step_column: [step[0], 0.0],
            step_row: [0.0, -step[1]],
        };
        MemoryRaster {
            heights: Vec::new(),
            colors: (0..size[0] * size[1]).map(|n| color(n % size[0], n / size[0])).collect(),
            info: info(crs, transform, size, Content::Photo),
        }
    }

    /// Samples wherever they are, for the oracle: column and row, bilinear, never
    /// across voids.
    pub fn bilinear(&self, u: f64, v: f64) -> Option<f64> {
        let (width, height) = (self.info.width as f64, self.info.height as f64);
        if !(0.0..=width - 1.0).contains(&u) || !(0.0..=height - 1.0).contains(&v) {
            return None;
        }
        let (c, r) = (u.floor().min(width - 2.0), v.floor().min(height - 2.0));
        let (s, t) = (u - c, v - r);
        let at = |c: f64, r: f64| f64::from(self.heights[(r * width + c) as usize]);
        let low = at(c, r) * (1.0 - s) + at(c + 1.0, r) * s;
        let high = at(c, r + 1.0) * (1.0 - s) + at(c + 1.0, r + 1.0) * s;
        Some(low * (1.0 - t) + high * t).filter(|height| height.is_finite())
    }
}

fn info(crs: &str, transform: GeoTransform, size: [u64; 2], content: Content) -> RasterInfo {
    RasterInfo {
        path: PathBuf::from("memory.tif"),
        format: "memory".into(),
        width: size[0],
        height: size[1],
        transform: Some(transform),
        crs: (!crs.is_empty()).then(|| crs.to_owned()),
        vertical: Vertical::Unknown,
        content,
        quantum_m: None,
        warnings: Vec::new(),
    }
}

impl Raster for MemoryRaster {
    fn info(&self) -> &RasterInfo {
        &self.info
    }

    fn read_heights(&self, window: Window, into: &mut [f32]) -> Result<(), RasterError> {
        copy(&self.heights, self.info.width, window, into);
        Ok(())
    }

    fn read_colors(&self, window: Window, into: &mut [[u8; 4]]) -> Result<(), RasterError> {
        copy(&self.colors, self.info.width, window, into);
        Ok(())
    }
}

fn copy<T: Copy>(from: &[T], width: u64, window: Window, into: &mut [T]) {
    for row in 0..window.height {
        let start = (window.row + row as u64) * width + window.column;
        let line = &from[start as usize..start as usize + window.width];
        into[row * window.width..][..window.width].copy_from_slice(line);
    }
}

/// A folder for stores, and what an import left in it.
pub struct Imported {
    pub folder: tempfile::TempDir,
    pub summary: ImportSummary,
    pub reader: StoreReader,
}

pub fn sources(elevation: Vec<MemoryRaster>) -> Sources {
    Sources { elevation: shared(elevation), ..Sources::default() }
}

pub fn shared(rasters: Vec<MemoryRaster>) -> Vec<Arc<dyn Raster>> {
    rasters.into_iter().map(|raster| Arc::new(raster) as Arc<dyn Raster>).collect()
}

pub fn import(sources: Sources, settings: &ImportSettings) -> Imported {
    try_import(sources, settings).unwrap()
}

pub fn try_import(sources: Sources, settings: &ImportSettings) -> Result<Imported, ImportError> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("t.terrain");
    let cancel = AtomicBool::new(false);
    let result = import_rasters(sources, settings, &path, &|_| {}, &cancel);
    if result.is_err() {
        let left = std::fs::read_dir(folder.path()).unwrap().count();
        assert_eq!(left, 0, "a failed import leaves nothing behind");
    }
    let summary = result?;
    let reader = StoreReader::open(&path).unwrap();
    reader.index().check().unwrap();
    Ok(Imported { folder, summary, reader })
}

pub fn error_of(sources: Sources, settings: &ImportSettings) -> String {
    match try_import(sources, settings) {
        Ok(_) => panic!("the import should have failed"),
        Err(error) => error.to_string(),
    }
}

impl Imported {
    pub fn layer(&self, number: usize) -> &Layer {
        &self.reader.index().layers[number]
    }

    /// All heights of a layer, row by row from the south.
    pub fn heights(&self, number: usize) -> Vec<f32> {
        let layer = self.layer(number);
        let mut all = vec![f32::NAN; (layer.posts[0] * layer.posts[1]) as usize];
        self.each_tile(number, |tile, i, j, at| {
            if let Tile::Height(tile) = tile {
                all[at] = tile.post(i, j);
            }
        });
        all
    }

    /// All colours of a layer, as decoded: linear light, premultiplied.
    pub fn texels(&self, number: usize) -> Vec<[u16; 4]> {
        let layer = self.layer(number);
        let mut all = vec![[0; 4]; (layer.posts[0] * layer.posts[1]) as usize];
        self.each_tile(number, |tile, i, j, at| {
            if let Tile::Photo(tile) = tile {
                all[at] = tile.texel(i, j);
            }
        });
        all
    }

    fn each_tile(&self, number: usize, mut visit: impl FnMut(&Tile, isize, isize, usize)) {
        let layer = self.layer(number);
        let [columns, rows] = layer.levels[0].tiles;
        for (tx, ty) in (0..rows).flat_map(|ty| (0..columns).map(move |tx| (tx, ty))) {
            let key = TileKey { layer: number as u16, level: 0, tx, ty };
            let Some(tile) = self.reader.read_tile(key).unwrap() else { continue };
            for j in 0..=TILE_CELLS {
                for i in 0..=TILE_CELLS {
                    let x = tx as usize * TILE_CELLS + i;
                    let y = ty as usize * TILE_CELLS + j;
                    if x < layer.posts[0] as usize && y < layer.posts[1] as usize {
                        let at = y * layer.posts[0] as usize + x;
                        visit(&tile, i as isize, j as isize, at);
                    }
                }
            }
        }
    }

    /// The bilinear surface of one layer at a position in the store's system.
    pub fn sampler(&self, number: usize) -> impl Fn([f64; 2]) -> Option<f64> + use<> {
        let layer = self.layer(number).clone();
        let heights = self.heights(number);
        move |xy| {
            let [u, v] = [0, 1].map(|a| (xy[a] - layer.origin[a]) / layer.spacing[a]);
            let last = layer.posts.map(|n| (n - 1) as f64);
            if !(0.0..=last[0]).contains(&u) || !(0.0..=last[1]).contains(&v) {
                return None;
            }
            let (c, r) = (u.floor().min(last[0] - 1.0), v.floor().min(last[1] - 1.0));
            let (s, t) = (u - c, v - r);
            let at = |c: f64, r: f64| f64::from(heights[(r * layer.posts[0] as f64 + c) as usize]);
            let low = at(c, r) * (1.0 - s) + at(c + 1.0, r) * s;
            let high = at(c, r + 1.0) * (1.0 - s) + at(c + 1.0, r + 1.0) * s;
            Some(low * (1.0 - t) + high * t).filter(|height| height.is_finite())
        }
    }
}
