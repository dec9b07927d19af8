//! Procedural terrain: eroded mountains with a plausible aerial photo, from a seed.
//!
//! [`synthesize`] shapes a macro map of at most [`MACRO_SIDE`] cells a side: uplift and
//! rivers make valleys (`erode`), gravel, fans and dams make floors and lakes
//! (`valley`). The [`Synth`] it returns answers for any window of heights or colours:
//! the macro map enlarged smoothly, with ribs, gullies and roughness added as a pure
//! function of place (`surface`, `photo`). A terrain of 32 769 posts a side is never
//! held in memory.
//!
//! Same [`SynthSpec`], same bytes: on every platform, with any number of threads, by any
//! split into windows. Only additions, multiplications, divisions and square roots are
//! used, and parallel loops never share a sum.

mod erode;
mod flow;
mod grid;
mod landscape;
mod noise;
mod photo;
mod surface;
mod valley;
mod write;

pub use write::{WriteError, write_store};

use landscape::Landscape;
use rayon::prelude::*;
use std::cell::Cell;
use std::sync::atomic::{AtomicBool, Ordering};
use surface::Surface;
use terrafarm_terrain::rounding;

/// The largest number of posts a side.
pub const MAX_POSTS: u32 = 65_537;
/// The largest number of photo pixels per post.
pub const MAX_PHOTO_SCALE: u32 = 4;
/// The largest side of the macro map, cells.
pub const MACRO_SIDE: usize = 1025;

/// The step of heights that [`rounding`] would leave as they are, metres.
const FINEST_STEP_M: f64 = 1.0 / 1024.0;

/// What terrain to make.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SynthSpec {
    /// Posts along each side, 2 to [`MAX_POSTS`].
    pub posts: u32,
    /// Distance between posts, metres, 0.1 to 1000.
    pub spacing_m: f64,
    /// Another seed, another terrain.
    pub seed: u64,
    /// Photo pixels per post along each axis, 1 to [`MAX_PHOTO_SCALE`].
    pub photo_scale: u32,
}

/// Why a terrain could not be made.
#[derive(Debug, thiserror::Error)]
pub enum SynthError {
    /// A number of posts out of range.
    #[error("a terrain of {0} posts a side cannot be made; choose 2 to {MAX_POSTS}")]
    Posts(u32),
    /// A distance between posts out of range.
    #[error("posts {0} m apart make no terrain; choose 0.1 to 1000")]
    Spacing(f64),
    /// A photo scale out of range.
    #[error("{0} photo pixels per post are not possible; choose 1 to {MAX_PHOTO_SCALE}")]
    PhotoScale(u32),
    /// The user stopped it.
    #[error("the synthesis was cancelled")]
    Cancelled,
    /// A window that leaves the terrain or does not fit its buffer.
    #[error("window of {width} x {height} at ({i0}, {j0}) does not fit {what}")]
    Window {
        /// First column.
        i0: i64,
        /// First row.
        j0: i64,
        /// Number of columns.
        width: usize,
        /// Number of rows.
        height: usize,
        /// What it does not fit.
        what: &'static str,
    },
}

impl SynthSpec {
    /// Checks every number against its range.
    ///
    /// # Errors
    /// The first one that is out of range.
    pub fn check(&self) -> Result<(), SynthError> {
        if !(2..=MAX_POSTS).contains(&self.posts) {
            return Err(SynthError::Posts(self.posts));
        }
        if !(0.1..=1000.0).contains(&self.spacing_m) {
            return Err(SynthError::Spacing(self.spacing_m));
        }
        if !(1..=MAX_PHOTO_SCALE).contains(&self.photo_scale) {
            return Err(SynthError::PhotoScale(self.photo_scale));
        }
        Ok(())
    }

    /// Length of a side, metres.
    pub fn extent_m(&self) -> f64 {
        f64::from(self.posts - 1) * self.spacing_m
    }

    /// What all heights are multiples of, metres: a power of two.
    pub fn height_step_m(&self) -> f32 {
        rounding::step_m([self.spacing_m; 2]).unwrap_or(FINEST_STEP_M) as f32
    }

    /// Photo pixels along a side: the first and the last lie on the outermost posts.
    pub fn photo_side(&self) -> u32 {
        (self.posts - 1) * self.photo_scale + 1
    }
}

/// A terrain that answers for any window of itself.
pub struct Synth {
    spec: SynthSpec,
    surface: Surface,
}

/// Makes a terrain. `progress` is told the share done, 0 to 1; `cancel` is looked at
/// many times a second.
///
/// # Errors
/// If the spec is out of range, or `cancel` became true.
pub fn synthesize(
    spec: SynthSpec,
    progress: &dyn Fn(f32),
    cancel: &AtomicBool,
) -> Result<Synth, SynthError> {
    spec.check()?;
    let watch = Watch { progress, cancel, done: Cell::new(0.0) };
    let landscape = Landscape::new(&spec, &watch).map_err(|Cancelled| SynthError::Cancelled)?;
    progress(1.0);
    Ok(Synth { spec, surface: Surface::new(&spec, landscape) })
}

impl Synth {
    /// What was asked for.
    pub fn spec(&self) -> &SynthSpec {
        &self.spec
    }

    /// Heights of a window, metres, row by row from the south-west.
    ///
    /// # Errors
    /// If the buffer does not fit the window. Posts outside the terrain are made like
    /// those at its border.
    pub fn heights(
        &self,
        i0: i64,
        j0: i64,
        width: usize,
        height: usize,
        into: &mut [f32],
    ) -> Result<(), SynthError> {
        fits(i0, j0, width, height, into.len())?;
        for (row, heights) in into.chunks_mut(width.max(1)).enumerate() {
            for (column, value) in heights.iter_mut().enumerate() {
                *value = self.surface.post(i0 + column as i64, j0 + row as i64).height;
            }
        }
        Ok(())
    }

    /// Colours of a window of the photo: sRGB and full coverage, row by row from the
    /// south-west. Pixel (i, j) has its centre at post (i, j) / `photo_scale`.
    ///
    /// # Errors
    /// If the buffer does not fit the window.
    pub fn colors(
        &self,
        i0: i64,
        j0: i64,
        width: usize,
        height: usize,
        into: &mut [[u8; 4]],
    ) -> Result<(), SynthError> {
        fits(i0, j0, width, height, into.len())?;
        photo::paint(
            &self.surface,
            i64::from(self.spec.photo_scale),
            (i0, j0),
            (width, height),
            into,
        );
        Ok(())
    }

    /// All heights, row by row from the south-west, made in parallel: for terrains that
    /// fit in memory.
    pub fn all_heights(&self) -> Vec<f32> {
        let side = self.spec.posts as usize;
        let mut all = vec![0.0; side * side];
        all.par_chunks_mut(side).enumerate().for_each(|(row, heights)| {
            for (column, value) in heights.iter_mut().enumerate() {
                *value = self.surface.post(column as i64, row as i64).height;
            }
        });
        all
    }
}

fn fits(i0: i64, j0: i64, width: usize, height: usize, len: usize) -> Result<(), SynthError> {
    let far = i64::from(MAX_POSTS * MAX_PHOTO_SCALE) * 2;
    let error = |what| SynthError::Window { i0, j0, width, height, what };
    if !(-far..=far).contains(&i0) || !(-far..=far).contains(&j0) {
        return Err(error("the terrain"));
    }
    if width.checked_mul(height) != Some(len) {
        return Err(error("its buffer"));
    }
    Ok(())
}

/// The caller wants no more of it.
#[derive(Debug)]
struct Cancelled;

/// Reports how far the work has come, and whether to go on.
struct Watch<'a> {
    progress: &'a dyn Fn(f32),
    cancel: &'a AtomicBool,
    done: Cell<f32>,
}

impl Watch<'_> {
    fn check(&self) -> Result<(), Cancelled> {
        if self.cancel.load(Ordering::Relaxed) { Err(Cancelled) } else { Ok(()) }
    }

    fn advance(&self, share: f32) {
        let done = (self.done.get() + share).min(1.0);
        self.done.set(done);
        (self.progress)(done);
    }
}
