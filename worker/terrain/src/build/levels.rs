//! The levels of a layer, tile by tile.

use super::{BuildError, LayerSource, SourceError, StoreBuilder, Watch};
use crate::codec::TILE_AREA;
use crate::layout::{
    Layer, LayerKind, Level, PostWindow, TILE_CELLS, TILE_POSTS, TILE_RING, TileEntry,
};
use crate::positioned::read_exact_at;
use crate::pyramid::{FINE_REACH, FinePosts, Post, post_in_tile};
use crate::rounding;
use crate::store::hash_of;
use rayon::prelude::*;

/// Level 0 tiles in work at once: 17 MB of heights.
pub(super) const BATCH: usize = 64;
/// Coarse tiles in work at once, all of one row: 26 MB of finer heights.
const COARSE_BATCH: u32 = 16;
/// A tile that is ready to be written: its bytes, and its entry but for the place.
pub(super) struct Made {
    pub(super) bytes: Vec<u8>,
    pub(super) entry: TileEntry,
    pub(super) void_posts: u64,
}

impl StoreBuilder {
    /// Level 0, from its source.
    pub(super) fn build_finest<P: Post>(
        &mut self,
        posts: [u64; 2],
        step: Option<f64>,
        source: &dyn LayerSource,
        watch: &mut Watch<'_>,
    ) -> Result<Level, BuildError> {
        let number = self.index.layers.len();
        let tiles = Layer::tiles_for(posts);
        let count = tiles[0] as usize * tiles[1] as usize;
        let mut entries = Vec::with_capacity(count);
        for first in (0..count).step_by(BATCH) {
            let made: Result<Vec<Made>, SourceError> = (first..count.min(first + BATCH))
                .into_par_iter()
                .map(|at| {
                    let [tx, ty] = [at % tiles[0] as usize, at / tiles[0] as usize];
                    let [tx, ty] = [tx as u32, ty as u32];
                    let tile = read_tile::<P>(source, tx, ty, posts)?;
                    Ok(make(&tile, step, count_voids(&tile, tx, ty, posts), || 0.0))
                })
                .collect();
            let made = made.map_err(|source| BuildError::Source { layer: number, source })?;
            self.append(made, &mut entries, watch)?;
        }
        Ok(Level { tiles, entries })
    }

    /// A level from the one below it, which is written already.
    pub(super) fn build_coarser<P: Post>(
        &mut self,
        layer: &Layer,
        level: usize,
        watch: &mut Watch<'_>,
    ) -> Result<Level, BuildError> {
        let posts = layer.level_posts(level);
        let step = rounding::step_m(layer.level_spacing(level));
        let tiles = Layer::tiles_for(posts);
        let mut entries = Vec::with_capacity(tiles[0] as usize * tiles[1] as usize);
        for ty in 0..tiles[1] {
            for first in (0..tiles[0]).step_by(COARSE_BATCH as usize) {
                let end = tiles[0].min(first + COARSE_BATCH);
                let fine = self.fine_posts::<P>(layer, level - 1, first..end, ty)?;
                let made = (first..end)
                    .into_par_iter()
                    .map(|tx| {
                        let tile = fine.coarse_tile(tx, ty, posts, step);
                        let below = deviation_below(layer, level - 1, tx, ty);
                        make(&tile, None, 0, || round_up(fine.deviation(tx, ty, &tile) + below))
                    })
                    .collect();
                self.append(made, &mut entries, watch)?;
            }
        }
        Ok(Level { tiles, entries })
    }

    /// The posts of a finished level under a run of coarse tiles of one row, read back.
    fn fine_posts<P: Post>(
        &self,
        layer: &Layer,
        level: usize,
        columns: std::ops::Range<u32>,
        row: u32,
    ) -> Result<FinePosts<P>, BuildError> {
        let grid = layer.level_posts(level);
        let side = 2 * TILE_CELLS as i64;
        let reach = FINE_REACH as i64;
        let window = PostWindow::clipped(
            [i64::from(columns.start) * side - reach, i64::from(row) * side - reach],
            [i64::from(columns.end) * side + reach, (i64::from(row) + 1) * side + reach],
            grid,
        );
        let tiles = layer.levels[level].tiles;
        let span = |first: u64, length: usize, count: u32| {
            let tile_of = |post: u64| ((post / TILE_CELLS as u64) as u32).min(count - 1);
            tile_of(first)..=tile_of(first + length as u64 - 1)
        };
        let keys: Vec<[u32; 2]> = span(window.j0, window.height, tiles[1])
            .flat_map(|ty| span(window.i0, window.width, tiles[0]).map(move |tx| [tx, ty]))
            .collect();
        let decoded: Result<Vec<Option<Vec<P>>>, BuildError> =
            keys.par_iter().map(|&[tx, ty]| self.read_back(layer.entry(level, tx, ty))).collect();
        let mut posts = vec![P::VOID; window.area()];
        for (key, tile) in keys.iter().zip(decoded?) {
            if let Some(tile) = tile {
                copy_tile(*key, &tile, window, &mut posts);
            }
        }
        Ok(FinePosts { grid, window, posts })
    }

    fn read_back<P: Post>(&self, entry: Option<&TileEntry>) -> Result<Option<Vec<P>>, BuildError> {
        let Some(entry) = entry.filter(|entry| !entry.is_empty()) else { return Ok(None) };
        let path = || self.partial.path.clone();
        let mut bytes = vec![0; entry.length as usize];
        read_exact_at(&self.partial.file, &mut bytes, entry.offset)
            .map_err(|source| BuildError::Io { path: path(), source })?;
        P::decode(&bytes).map(Some).map_err(|source| BuildError::ReadBack { path: path(), source })
    }
}

/// A tile of level 0; what lies outside the layer is void.
fn read_tile<P: Post>(
    source: &dyn LayerSource,
    tx: u32,
    ty: u32,
    posts: [u64; 2],
) -> Result<Vec<P>, SourceError> {
    let window = PostWindow::of_tile(tx, ty, posts);
    let mut read = vec![P::VOID; window.area()];
    P::read(source, window, &mut read)?;
    let mut tile = vec![P::VOID; TILE_AREA];
    for (row, read) in read.chunks_exact(window.width).enumerate() {
        let start = post_in_tile([tx, ty], [window.i0, window.j0 + row as u64]);
        for (post, read) in tile[start..].iter_mut().zip(read) {
            *post = read.cleaned();
        }
    }
    Ok(tile)
}

/// Encodes a tile and measures it. `deviation` is asked only if anything is valid.
fn make<P: Post>(
    tile: &[P],
    step: Option<f64>,
    void_posts: u64,
    deviation: impl Fn() -> f32,
) -> Made {
    let rows = tile.chunks_exact(TILE_POSTS).skip(TILE_RING).take(TILE_CELLS + 1);
    let inner = || rows.clone().flat_map(|row| row[TILE_RING..TILE_POSTS - TILE_RING].iter());
    if inner().all(|post| post.is_void()) {
        return Made { bytes: Vec::new(), entry: TileEntry::EMPTY, void_posts };
    }
    let bytes = P::encode(tile, step);
    let (min, max) = P::extent(inner().copied());
    let entry = TileEntry {
        hash: hash_of(&bytes),
        offset: 0,
        length: bytes.len() as u32,
        min,
        max,
        deviation: deviation(),
    };
    Made { bytes, entry, void_posts }
}

/// Void posts of a height tile of level 0; one that two tiles share counts for the
/// eastern or northern one.
fn count_voids<P: Post>(tile: &[P], tx: u32, ty: u32, posts: [u64; 2]) -> u64 {
    if P::KIND != LayerKind::Height {
        return 0;
    }
    let tiles = Layer::tiles_for(posts);
    let end = |t: u32, axis: usize| {
        if t + 1 == tiles[axis] { posts[axis] } else { u64::from(t + 1) * TILE_CELLS as u64 }
    };
    let start = [tx, ty].map(|t| u64::from(t) * TILE_CELLS as u64);
    let places = (start[1]..end(ty, 1)).flat_map(|j| (start[0]..end(tx, 0)).map(move |i| [i, j]));
    places.filter(|&place| tile[post_in_tile([tx, ty], place)].is_void()).count() as u64
}

/// Copies what a tile, ring left out, has of a window.
fn copy_tile<P: Post>([tx, ty]: [u32; 2], tile: &[P], window: PostWindow, posts: &mut [P]) {
    let overlap = |t: u32, first: u64, length: usize| {
        let start = u64::from(t) * TILE_CELLS as u64;
        start.max(first)..(start + TILE_CELLS as u64 + 1).min(first + length as u64)
    };
    let columns = overlap(tx, window.i0, window.width);
    let width = (columns.end - columns.start) as usize;
    for j in overlap(ty, window.j0, window.height) {
        let from = post_in_tile([tx, ty], [columns.start, j]);
        let to = (j - window.j0) as usize * window.width + (columns.start - window.i0) as usize;
        posts[to..to + width].copy_from_slice(&tile[from..from + width]);
    }
}

/// The largest deviation of the tiles of a level under a tile of the next coarser one.
fn deviation_below(layer: &Layer, level: usize, tx: u32, ty: u32) -> f64 {
    let children = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(dx, dy)| (2 * tx + dx, 2 * ty + dy));
    let entries = children.into_iter().filter_map(|(tx, ty)| layer.entry(level, tx, ty));
    entries.map(|entry| f64::from(entry.deviation)).fold(0.0, f64::max)
}

/// The smallest f32 that is not below.
fn round_up(value: f64) -> f32 {
    let nearest = value as f32;
    if f64::from(nearest) < value { nearest.next_up() } else { nearest }
}
