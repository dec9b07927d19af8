//! Heights of a layer's posts, on demand and for any window.
//!
//! Sources are stacked: [`Stack`] takes posts from mosaics, [`Filled`] closes small
//! voids of what is below it, [`Inset`] continues a fine raster with the layers below.
//! Every source gives the same height for a post whichever window asks, so that tiles
//! agree on the posts they share.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use terrafarm_geo::{Crs, Transformer};
use terrafarm_terrain::build::{LayerSource, SourceError};
use terrafarm_terrain::layout::{self, TILE_CELLS};
use terrafarm_terrain::rounding::rounded;

use crate::grid::{Grid, PostWindow};
use crate::mosaic::{LatticeWindow, Mosaic};
use crate::request::ImportError;
use crate::sample::{Sample, bilinear};
use crate::step::computed_step_m;
use crate::warp::Warp;

/// Where heights come from.
pub(crate) trait Heights: Send + Sync {
    /// The posts of the layer.
    fn grid(&self) -> &Grid;

    /// Heights of a window of posts, row by row from the south; NaN for voids and
    /// beyond the grid.
    ///
    /// # Errors
    /// If an input is damaged.
    fn heights(&self, window: PostWindow) -> Result<Vec<f32>, ImportError>;
}

/// The way from posts of a grid to samples of a mosaic.
pub(crate) enum Way {
    /// Post (i, j) is the sample at `offset + (i, j) * sign`: nothing is resampled.
    Untouched {
        /// Column and row of post (0, 0).
        offset: [i64; 2],
        /// 1 or −1 along columns and rows.
        sign: [i64; 2],
    },
    /// Posts lie between samples.
    Resampled(Box<Warp>),
}

impl Way {
    /// The way from a grid in a store's system to a mosaic.
    ///
    /// # Errors
    /// If one of the two systems is `LOCAL` and the other is not.
    pub(crate) fn new(grid: &Grid, crs: &Crs, mosaic: &Mosaic) -> Result<Way, ImportError> {
        if let Some((offset, sign)) = untouched(grid, crs, mosaic) {
            return Ok(Way::Untouched { offset, sign });
        }
        let transformer = Transformer::new(crs, &mosaic.crs)?;
        let warp = Warp::new(grid.affine(), transformer, mosaic.frame, mosaic.longitude_centre());
        Ok(Way::Resampled(Box::new(warp)))
    }

    /// Whether samples become posts unchanged.
    pub(crate) fn is_untouched(&self) -> bool {
        matches!(self, Way::Untouched { .. })
    }

    /// Samples of a mosaic at the posts of a window.
    ///
    /// # Errors
    /// If an input is damaged.
    pub(crate) fn samples<S: Sample>(
        &self,
        window: PostWindow,
        mosaic: &Mosaic,
        read: &dyn Fn(LatticeWindow) -> Result<Vec<S>, ImportError>,
    ) -> Result<Vec<S>, ImportError> {
        match self {
            Way::Resampled(warp) => {
                let extent = mosaic.extent;
                let open = if mosaic.is_ring() {
                    [extent[0] - 1, extent[1], extent[2] + 1, extent[3]]
                } else {
                    extent
                };
                bilinear(&warp.window(window), open, read)
            }
            Way::Untouched { offset, sign } => {
                let [width, height] = [window.width, window.height];
                let start = [window.i, window.j];
                let size = [width as i64, height as i64];
                // The first sample in the order of the lattice.
                let first = [0, 1].map(|axis| {
                    let end = if sign[axis] > 0 { 0 } else { size[axis] - 1 };
                    offset[axis] + (start[axis] + end) * sign[axis]
                });
                let samples =
                    read(LatticeWindow { column: first[0], row: first[1], width, height })?;
                if *sign == [1, 1] {
                    return Ok(samples);
                }
                let turned = |n: usize| {
                    let (i, j) = (n % width, n / width);
                    let column = if sign[0] > 0 { i } else { width - 1 - i };
                    let row = if sign[1] > 0 { j } else { height - 1 - j };
                    samples[row * width + column]
                };
                Ok((0..samples.len()).map(turned).collect())
            }
        }
    }
}

/// Offset and signs, if the mosaic's samples are posts of the grid.
fn untouched(grid: &Grid, crs: &Crs, mosaic: &Mosaic) -> Option<([i64; 2], [i64; 2])> {
    if !mosaic.frame.is_upright() || !mosaic.crs.is_same_grid(crs) || crs.is_geographic() {
        return None;
    }
    let steps = [mosaic.frame.column[0], mosaic.frame.row[1]];
    let start = mosaic.frame.invert(grid.origin);
    for axis in 0..2 {
        let count = (mosaic.extent[axis + 2] - mosaic.extent[axis]) as f64;
        let drift = (steps[axis].abs() / grid.spacing[axis] - 1.0).abs() * count;
        let phase = (start[axis] - start[axis].round()).abs();
        if !(drift <= 1e-3 && phase <= 1e-3 && start[axis].abs() < 1e15) {
            return None;
        }
    }
    let sign = steps.map(|step| if step > 0.0 { 1 } else { -1 });
    Some((start.map(|value| value.round() as i64), sign))
}

/// Mosaics over one another.
pub(crate) struct Stack {
    pub(crate) grid: Grid,
    /// Topmost last.
    pub(crate) mosaics: Vec<StackedMosaic>,
    /// What computed heights are rounded to, metres.
    step_m: Option<f64>,
}

impl Stack {
    pub(crate) fn new(grid: Grid, mosaics: Vec<StackedMosaic>) -> Stack {
        let step_m = computed_step_m(&grid, &mosaics);
        Stack { grid, mosaics, step_m }
    }

    /// A height that is no sample of a file, as it is kept.
    fn computed(&self, height: f32) -> f32 {
        rounded(height.into(), self.step_m)
    }
}

/// A mosaic with its way from the posts.
pub(crate) struct StackedMosaic {
    pub(crate) mosaic: Mosaic,
    pub(crate) way: Way,
    /// Where it lies: west, south, east, north in the store's system.
    pub(crate) bounds: [f64; 4],
}

impl Heights for Stack {
    fn grid(&self) -> &Grid {
        &self.grid
    }

    fn heights(&self, window: PostWindow) -> Result<Vec<f32>, ImportError> {
        let mut found = vec![f32::NAN; window.len()];
        let bounds = window_bounds(&self.grid, window);
        for stacked in self.mosaics.iter().rev() {
            if !crate::grid::overlap(bounds, stacked.bounds) {
                continue;
            }
            let mosaic = &stacked.mosaic;
            let read = |window| mosaic.heights(window).map_err(ImportError::from);
            let own: Vec<f32> = stacked.way.samples(window, mosaic, &read)?;
            let mut complete = true;
            let untouched = stacked.way.is_untouched();
            for (post, own) in found.iter_mut().zip(own) {
                if post.is_nan() {
                    *post = if untouched { own } else { self.computed(own) };
                }
                complete &= !post.is_nan();
            }
            if complete {
                break;
            }
        }
        Ok(found)
    }
}

/// West, south, east, north of the posts of a window, grown by one spacing.
pub(crate) fn window_bounds(grid: &Grid, window: PostWindow) -> [f64; 4] {
    let at = |axis: usize, post: i64| grid.origin[axis] + post as f64 * grid.spacing[axis];
    let (right, top) = (window.i + window.width as i64, window.j + window.height as i64);
    [at(0, window.i - 1), at(1, window.j - 1), at(0, right), at(1, top)]
}

/// Closes voids near valid posts.
///
/// From a void post one looks along sixteen directions, at most `reach` posts far; the
/// first valid posts found are averaged with weights 1/distance². Nothing is carried on
/// from filled posts, so the result does not depend on the order of the work.
pub(crate) struct Filled {
    pub(crate) below: Arc<Stack>,
    pub(crate) reach: usize,
}

/// The largest distance over which voids are filled, posts.
pub const MAX_FILL_POSTS: u32 = 256;

/// Sixteen directions in whole posts; rings are walked in multiples of them.
const DIRECTIONS: [[i32; 2]; 16] = [
    [1, 0],
    [2, 1],
    [1, 1],
    [1, 2],
    [0, 1],
    [-1, 2],
    [-1, 1],
    [-2, 1],
    [-1, 0],
    [-2, -1],
    [-1, -1],
    [-1, -2],
    [0, -1],
    [1, -2],
    [1, -1],
    [2, -1],
];

impl Heights for Filled {
    fn grid(&self) -> &Grid {
        self.below.grid()
    }

    fn heights(&self, window: PostWindow) -> Result<Vec<f32>, ImportError> {
        let mut own = self.below.heights(window)?;
        let posts = self.grid().posts;
        let inside = |post: i64, axis: usize| (0..posts[axis] as i64).contains(&post);
        if !own.iter().any(|post| post.is_nan()) {
            return Ok(own);
        }
        let wide = window.grown(self.reach);
        let around = self.below.heights(wide)?;
        for (n, post) in own.iter_mut().enumerate() {
            let (i, j) = (n % window.width, n / window.width);
            let in_grid = inside(window.i + i as i64, 0) && inside(window.j + j as i64, 1);
            if post.is_nan() && in_grid {
                *post = self.rim_mean(&around, wide.width, [i + self.reach, j + self.reach]);
            }
        }
        Ok(own)
    }
}

impl Filled {
    fn rim_mean(&self, around: &[f32], width: usize, [i, j]: [usize; 2]) -> f32 {
        let (mut sum, mut weights) = (0.0, 0.0);
        for [di, dj] in DIRECTIONS {
            let stride = di.abs().max(dj.abs()) as usize;
            for step in 1..=self.reach / stride {
                let column = i as i64 + i64::from(di) * step as i64;
                let row = j as i64 + i64::from(dj) * step as i64;
                let height = around[row as usize * width + column as usize];
                if !height.is_nan() {
                    let squared = f64::from(di * di + dj * dj) * (step * step) as f64;
                    sum += f64::from(height) / squared;
                    weights += 1.0 / squared;
                    break;
                }
            }
        }
        if weights > 0.0 { self.below.computed((sum / weights) as f32) } else { f32::NAN }
    }
}

/// A fine raster in its rectangle; where it is void, and on the outermost ring of posts,
/// the surface of the layers below, so that the two join.
pub(crate) struct Inset {
    pub(crate) own: Arc<Stack>,
    /// Coarsest first.
    pub(crate) below: Vec<Arc<dyn Heights>>,
}

impl Heights for Inset {
    fn grid(&self) -> &Grid {
        &self.own.grid
    }

    fn heights(&self, window: PostWindow) -> Result<Vec<f32>, ImportError> {
        let grid = self.own.grid;
        let mut own = self.own.heights(window)?;
        let place =
            |n: usize| [window.i + (n % window.width) as i64, window.j + (n / window.width) as i64];
        let edge = |[i, j]: [i64; 2]| {
            let last = grid.posts.map(|n| n as i64 - 1);
            i <= 0 || j <= 0 || i >= last[0] || j >= last[1]
        };
        for (n, post) in own.iter_mut().enumerate() {
            if edge(place(n)) {
                *post = f32::NAN;
            }
        }
        let missing: Vec<usize> = (0..own.len()).filter(|&n| own[n].is_nan()).collect();
        if missing.is_empty() {
            return Ok(own);
        }
        let frame = grid.affine();
        let positions: Vec<[f64; 2]> =
            missing.iter().map(|&n| frame.at(place(n).map(|post| post as f64))).collect();
        let found = surface_at(&self.below, &positions)?;
        for (n, found) in missing.into_iter().zip(found) {
            own[n] = self.own.computed(found);
        }
        Ok(own)
    }
}

/// The surface of layers, coarsest first, at positions in the store's system: the last
/// layer that has one there.
///
/// # Errors
/// If an input is damaged.
pub(crate) fn surface_at(
    layers: &[Arc<dyn Heights>],
    positions: &[[f64; 2]],
) -> Result<Vec<f32>, ImportError> {
    let mut found = vec![f32::NAN; positions.len()];
    for layer in layers.iter().rev() {
        let frame = layer.grid().affine();
        let posts: Vec<[f64; 2]> = positions
            .iter()
            .zip(&found)
            .map(|(&xy, height)| if height.is_nan() { frame.invert(xy) } else { [f64::NAN; 2] })
            .collect();
        let [width, height] = layer.grid().posts.map(|n| n as i64);
        let read = |w: LatticeWindow| {
            layer.heights(PostWindow { i: w.column, j: w.row, width: w.width, height: w.height })
        };
        let own: Vec<f32> = bilinear(&posts, [0, 0, width, height], &read)?;
        for (post, own) in found.iter_mut().zip(own) {
            if post.is_nan() {
                *post = own;
            }
        }
    }
    Ok(found)
}

/// Heights as the store's builder asks for them, a tile at a time; watches for anything
/// valid, for voids, and for posts that were filled.
pub(crate) struct Watched<'a> {
    pub(crate) heights: &'a dyn Heights,
    /// The same before voids were filled.
    pub(crate) unfilled: Option<&'a dyn Heights>,
    pub(crate) any_valid: AtomicBool,
    pub(crate) filled: AtomicU64,
    pub(crate) void: AtomicU64,
}

impl<'a> Watched<'a> {
    pub(crate) fn new(heights: &'a dyn Heights, unfilled: Option<&'a dyn Heights>) -> Self {
        Watched {
            heights,
            unfilled,
            any_valid: AtomicBool::new(false),
            filled: AtomicU64::new(0),
            void: AtomicU64::new(0),
        }
    }

    /// Counts void and filled posts of a tile's window; those that two tiles share count
    /// for one.
    fn count(&self, window: PostWindow, heights: &[f32]) -> Result<(), ImportError> {
        let side = TILE_CELLS as i64;
        let posts = self.heights.grid().posts.map(|n| n as i64);
        let owned = |first: i64, axis: usize| {
            let start = (first + 1) / side * side;
            let last = start + side >= posts[axis] - 1;
            start..if last { posts[axis] } else { start + side }
        };
        let (columns, rows) = (owned(window.i, 0), owned(window.j, 1));
        let is_owned = |n: usize| {
            let (i, j) = (n % window.width, n / window.width);
            columns.contains(&(window.i + i as i64)) && rows.contains(&(window.j + j as i64))
        };
        let voids = |heights: &[f32]| {
            let voids = heights.iter().enumerate().filter(|(n, h)| h.is_nan() && is_owned(*n));
            voids.count() as u64
        };
        let void = voids(heights);
        self.void.fetch_add(void, Ordering::Relaxed);
        if let Some(unfilled) = self.unfilled {
            let before = voids(&unfilled.heights(window)?);
            self.filled.fetch_add(before - void, Ordering::Relaxed);
        }
        Ok(())
    }
}

impl LayerSource for Watched<'_> {
    fn heights(&self, window: layout::PostWindow, into: &mut [f32]) -> Result<(), SourceError> {
        let window = PostWindow::from(window);
        let heights = self.heights.heights(window).map_err(Box::new)?;
        if heights.iter().any(|height| !height.is_nan()) {
            self.any_valid.store(true, Ordering::Relaxed);
        }
        self.count(window, &heights).map_err(Box::new)?;
        into.copy_from_slice(&heights);
        Ok(())
    }
}
