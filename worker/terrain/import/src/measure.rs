//! How far the store's surface lies from the surfaces of its inputs.
//!
//! Both are bilinear, on different posts. They are compared at every sample of the
//! inputs, halfway between neighbours and in the middle of every cell, wherever the
//! input is the topmost one with a height and the store has one, too. Positions are
//! good to [`POSITION_SLACK`] of a post; what that can make up on the slope concerned is
//! added, so that whoever samples the store finds no larger error.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use rayon::prelude::*;
use terrafarm_geo::{Crs, Transformer};

use crate::grid::{Grid, PostWindow, overlap};
use crate::mosaic::{LatticeWindow, Mosaic};
use crate::request::ImportError;
use crate::sample::bilinear;
use crate::surface::{Heights, StackedMosaic, surface_at};
use crate::warp::Warp;

/// Samples along a side of the blocks that are compared at once.
const BLOCK: i64 = 128;
/// Uncertainty of a position on either side, in posts; both approximate by 0.0005.
const POSITION_SLACK: f64 = 1e-3;

/// Errors seen.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Errors {
    pub(crate) max_m: f64,
    sum_of_squares: f64,
    count: u64,
}

impl Errors {
    pub(crate) fn rms_m(&self) -> f64 {
        if self.count == 0 { 0.0 } else { (self.sum_of_squares / self.count as f64).sqrt() }
    }

    fn merge(self, other: Errors) -> Errors {
        Errors {
            max_m: self.max_m.max(other.max_m),
            sum_of_squares: self.sum_of_squares + other.sum_of_squares,
            count: self.count + other.count,
        }
    }
}

/// A store in the making and the inputs of its heights.
pub(crate) struct Measurement<'a> {
    pub(crate) crs: &'a Crs,
    /// Coarsest first.
    pub(crate) layers: &'a [Arc<dyn Heights>],
    /// Topmost last.
    pub(crate) mosaics: Vec<&'a StackedMosaic>,
}

impl Measurement<'_> {
    /// Whether anything can differ: more than one mosaic, or one that was resampled.
    pub(crate) fn is_needed(&self) -> bool {
        self.mosaics.len() > 1 || self.mosaics.iter().any(|stacked| !stacked.way.is_untouched())
    }

    /// Compares everything. `progress` is told blocks done and to do.
    ///
    /// # Errors
    /// If an input is damaged, or `cancel` was raised.
    pub(crate) fn run(
        &self,
        progress: &dyn Fn(u64, u64),
        cancel: &AtomicBool,
    ) -> Result<Errors, ImportError> {
        let counts = self.mosaics.iter().map(|stacked| blocks(&stacked.mosaic));
        let total: u64 = counts.map(|[columns, rows]| columns * rows).sum();
        let mut errors = Errors::default();
        let done = AtomicU64::new(0);
        for (rank, stacked) in self.mosaics.iter().enumerate() {
            let [columns, rows] = blocks(&stacked.mosaic);
            let probe = self.probe(rank)?;
            for row in 0..rows {
                if cancel.load(Ordering::Relaxed) {
                    return Err(ImportError::Cancelled);
                }
                let found: Result<Vec<Errors>, ImportError> = (0..columns)
                    .into_par_iter()
                    .map(|column| probe.block([column as i64 * BLOCK, row as i64 * BLOCK]))
                    .collect();
                // Added in order: the sum does not depend on threads.
                errors = found?.into_iter().fold(errors, Errors::merge);
                progress(done.fetch_add(columns, Ordering::Relaxed) + columns, total);
            }
        }
        Ok(errors)
    }

    fn probe(&self, rank: usize) -> Result<Probe<'_>, ImportError> {
        let mosaic = &self.mosaics[rank].mosaic;
        let finest = self.layers.last().map(|layer| *layer.grid());
        let grid = finest.unwrap_or(Grid { origin: [0.0; 2], spacing: [1.0; 2], posts: [1; 2] });
        let there = Transformer::new(&mosaic.crs, self.crs)?;
        let forth = Warp::new(mosaic.frame.subdivided(2.0), there, grid.affine(), None);
        let mut above = Vec::new();
        for stacked in &self.mosaics[rank + 1..] {
            above.push((*stacked, Transformer::new(self.crs, &stacked.mosaic.crs)?));
        }
        Ok(Probe { measurement: self, mosaic, grid, forth, above })
    }
}

/// Number of blocks along columns and rows.
fn blocks(mosaic: &Mosaic) -> [u64; 2] {
    [0, 1].map(|axis| {
        let count = mosaic.extent[axis + 2] - mosaic.extent[axis];
        count.max(0).unsigned_abs().div_ceil(BLOCK as u64)
    })
}

/// One mosaic, ready to be compared.
struct Probe<'a> {
    measurement: &'a Measurement<'a>,
    mosaic: &'a Mosaic,
    grid: Grid,
    /// From half columns and rows to posts of `grid`.
    forth: Warp,
    /// Mosaics that hide this one, with the way to them.
    above: Vec<(&'a StackedMosaic, Transformer)>,
}

impl Probe<'_> {
    /// Compares a block of samples; `start` counts from the first sample of the mosaic.
    fn block(&self, start: [i64; 2]) -> Result<Errors, ImportError> {
        let extent = self.mosaic.extent;
        let first = [extent[0] + start[0], extent[1] + start[1]];
        // One sample more than the block, shared with the next, where there is one.
        let size = [0, 1].map(|axis| (BLOCK + 1).min(extent[axis + 2] - first[axis]) as usize);
        let window =
            LatticeWindow { column: first[0], row: first[1], width: size[0], height: size[1] };
        let samples = self.mosaic.heights(window)?;
        if samples.iter().all(|sample| sample.is_nan()) {
            return Ok(Errors::default());
        }
        let halves = PostWindow {
            i: 2 * first[0],
            j: 2 * first[1],
            width: 2 * size[0] - 1,
            height: 2 * size[1] - 1,
        };
        let expected = half_samples(&samples, size);
        let mut posts = self.forth.window(halves);
        for (post, expected) in posts.iter_mut().zip(&expected) {
            if expected.is_nan() {
                *post = [f64::NAN; 2];
            }
        }
        let frame = self.grid.affine();
        let mut positions: Vec<[f64; 2]> = posts.iter().map(|&post| frame.at(post)).collect();
        self.drop_hidden(&mut positions)?;
        self.compare(&positions, &expected, halves.width)
    }

    /// Makes positions NaN at which a mosaic further up has a height.
    fn drop_hidden(&self, positions: &mut [[f64; 2]]) -> Result<(), ImportError> {
        for (stacked, way) in &self.above {
            let bounds = bounds_of(positions);
            if !overlap(bounds, stacked.bounds) {
                continue;
            }
            let mosaic = &stacked.mosaic;
            let mut there = positions.to_vec();
            way.apply(&mut there);
            for point in &mut there {
                if let Some(centre) = mosaic.longitude_centre() {
                    point[0] = centre + (point[0] - centre + 180.0).rem_euclid(360.0) - 180.0;
                }
                *point = mosaic.frame.invert(*point);
            }
            let read = |window| mosaic.heights(window).map_err(ImportError::from);
            let hidden: Vec<f32> = bilinear(&there, mosaic.extent, &read)?;
            for (position, hidden) in positions.iter_mut().zip(hidden) {
                if !hidden.is_nan() {
                    *position = [f64::NAN; 2];
                }
            }
        }
        Ok(())
    }

    fn compare(
        &self,
        positions: &[[f64; 2]],
        expected: &[f32],
        columns: usize,
    ) -> Result<Errors, ImportError> {
        let layers = self.measurement.layers;
        let found = surface_at(layers, positions)?;
        let mut errors = Errors::default();
        for (n, (&found, &here)) in found.iter().zip(expected).enumerate() {
            let error = (f64::from(found) - f64::from(here)).abs();
            if error.is_nan() {
                continue;
            }
            // Change of the input per sample along both axes, where it can be seen.
            let change = |step: usize, first: bool| {
                let next = if first { here } else { expected[n - step] };
                let change = 2.0 * (f64::from(here) - f64::from(next)).abs();
                if change.is_nan() { 0.0 } else { change }
            };
            let along = change(1, n % columns == 0) + change(columns, n < columns);
            let slack = along * POSITION_SLACK;
            errors.max_m = errors.max_m.max(error + slack);
            errors.sum_of_squares += error * error;
            errors.count += 1;
        }
        Ok(errors)
    }
}

/// The bilinear surface of samples at every half column and row.
fn half_samples(samples: &[f32], [width, height]: [usize; 2]) -> Vec<f32> {
    let [columns, rows] = [2 * width - 1, 2 * height - 1];
    let mean = |a: f32, b: f32| ((f64::from(a) + f64::from(b)) * 0.5) as f32;
    let at = |n: usize| {
        let (a, b) = (n % columns, n / columns);
        let (west, east) = (a / 2, a.div_ceil(2));
        let (low, high) = (b / 2 * width, b.div_ceil(2) * width);
        let first = mean(samples[low + west], samples[low + east]);
        let second = mean(samples[high + west], samples[high + east]);
        mean(first, second)
    };
    (0..columns * rows).map(at).collect()
}

/// West, south, east, north of the positions that are not NaN.
fn bounds_of(positions: &[[f64; 2]]) -> [f64; 4] {
    let nothing = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
    positions
        .iter()
        .filter(|p| p[0].is_finite())
        .fold(nothing, |bounds, &[x, y]| crate::grid::union(bounds, [x, y, x, y]))
}
