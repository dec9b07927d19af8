//! One job on all cores: pieces of its region, each rendered as far as its tiles allow.
//!
//! A job keeps what is done of every piece, so that a pause for missing tiles repeats
//! nothing. The stop flag is looked at before each piece: a revoked job ends within the
//! time of one piece a core. A panic of the ray caster ends the job, not the worker.

use rayon::prelude::*;
use std::any::Any;
use std::collections::BTreeSet;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use terrafarm_common::id::LeaseId;
use terrafarm_common::image::Rgb8;
use terrafarm_common::region::{Region, tiles};
use terrafarm_raycast::{Progress, Pyramid, Rendered, Stats, View};
use terrafarm_terrain::layout::{StoreIndex, TileKey};
use terrafarm_terrain::resident::Resident;

/// Side of a piece, pixels: some milliseconds of one core, and a hundred pieces even in
/// a small frame.
const PIECE_PX: u32 = 32;

/// How rays are cast. There is one way, [`RayCaster`]; tests put others in its place.
pub trait Caster: Send + Sync + 'static {
    /// What is worked out once for each store.
    type Prepared: Send + Sync;
    /// A piece of a region that may be done in part.
    type Piece: Send;

    /// Works out what is needed of a store's index.
    fn prepare(&self, index: &StoreIndex) -> Self::Prepared;

    /// A piece of which nothing is done.
    fn begin(&self, region: Region) -> Self::Piece;

    /// Does what can be done of a piece; the tiles that the rest of it waits for.
    fn advance(
        &self,
        scene: &Scene<Self::Prepared>,
        view: &View,
        piece: &mut Self::Piece,
    ) -> Vec<TileKey>;

    /// The pixels of a piece that waits for nothing.
    fn finish(&self, piece: Self::Piece) -> Rendered;
}

/// The terrain as a job sees it.
pub struct Scene<P> {
    /// The tiles in memory.
    pub resident: Arc<Resident>,
    /// What was worked out for the store.
    pub prepared: Arc<P>,
}

/// The ray caster of this program.
#[derive(Debug, Clone, Copy, Default)]
pub struct RayCaster;

impl Caster for RayCaster {
    type Prepared = Pyramid;
    type Piece = Progress;

    fn prepare(&self, index: &StoreIndex) -> Pyramid {
        Pyramid::new(index)
    }

    fn begin(&self, region: Region) -> Progress {
        Progress::new(region)
    }

    fn advance(&self, scene: &Scene<Pyramid>, view: &View, piece: &mut Progress) -> Vec<TileKey> {
        piece.advance(&scene.resident, &scene.prepared, view)
    }

    fn finish(&self, piece: Progress) -> Rendered {
        piece.into_rendered(Vec::new())
    }
}

/// A job that has been begun.
pub struct Job<C: Caster> {
    /// Under which it is answered.
    pub lease: LeaseId,
    view: View,
    region: Region,
    pieces: Vec<Piece<C>>,
    stop: Arc<AtomicBool>,
    spent: Duration,
}

struct Piece<C: Caster> {
    region: Region,
    progress: C::Piece,
    done: bool,
}

/// How far a job has come.
pub enum Outcome<C: Caster> {
    /// All of it.
    Done(Picture),
    /// It waits for these tiles.
    Missing(Box<Job<C>>, Vec<TileKey>),
    /// It was stopped.
    Stopped,
}

/// The pixels of a job.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Picture {
    /// Three bytes a pixel, rows from the top.
    pub pixels: Vec<u8>,
    /// Rays, steps and the like.
    pub stats: Stats,
    /// Time on the pool, waiting for tiles left out.
    pub spent: Duration,
}

impl<C: Caster> Job<C> {
    /// A job of which nothing is done. Setting `stop` ends it early.
    pub fn new(
        caster: &C,
        lease: LeaseId,
        view: View,
        region: Region,
        stop: Arc<AtomicBool>,
    ) -> Self {
        let pieces = tiles(region.width, region.height, PIECE_PX).into_iter().map(|piece| {
            let region = Region { x: region.x + piece.x, y: region.y + piece.y, ..piece };
            Piece { region, progress: caster.begin(region), done: false }
        });
        Job { lease, view, region, pieces: pieces.collect(), stop, spent: Duration::ZERO }
    }

    /// Renders what can be rendered, on the thread pool it is called on. Gives the reason
    /// if the ray caster panics.
    pub fn advance(
        mut self: Box<Self>,
        caster: &C,
        scene: &Scene<C::Prepared>,
    ) -> Result<Outcome<C>, String> {
        let began = Instant::now();
        let missing = catch_unwind(AssertUnwindSafe(|| self.sweep(caster, scene)));
        self.spent += began.elapsed();
        let missing =
            missing.map_err(|panic| format!("the ray caster failed: {}", said(&*panic)))?;
        if self.stop.load(Ordering::Relaxed) {
            return Ok(Outcome::Stopped);
        }
        if !missing.is_empty() {
            return Ok(Outcome::Missing(self, missing.into_iter().collect()));
        }
        self.assemble(caster).map(Outcome::Done)
    }

    /// One go over all pieces that are not done; the tiles they wait for.
    fn sweep(&mut self, caster: &C, scene: &Scene<C::Prepared>) -> BTreeSet<TileKey> {
        let (view, stop) = (&self.view, &self.stop);
        let open = self.pieces.par_iter_mut().with_max_len(1).filter(|piece| !piece.done);
        let advanced = open.map(|piece| {
            if stop.load(Ordering::Relaxed) {
                return BTreeSet::new();
            }
            let missing = caster.advance(scene, view, &mut piece.progress);
            piece.done = missing.is_empty();
            missing.into_iter().collect()
        });
        advanced.reduce(BTreeSet::new, |mut all, more: BTreeSet<_>| {
            all.extend(more);
            all
        })
    }

    fn assemble(self, caster: &C) -> Result<Picture, String> {
        let began = Instant::now();
        let mut picture = Rgb8::new(self.region.width, self.region.height);
        let mut stats = Stats::default();
        for piece in self.pieces {
            let Region { x, y, .. } = self.region;
            let place = Region { x: piece.region.x - x, y: piece.region.y - y, ..piece.region };
            let rendered = caster.finish(piece.progress);
            if !piece.done || !picture.paste(place, &rendered.pixels) {
                return Err(format!("the ray caster left {:?} undone", piece.region));
            }
            stats.rays += rendered.stats.rays;
            stats.steps += rendered.stats.steps;
            stats.hits += rendered.stats.hits;
            stats.below_ground |= rendered.stats.below_ground;
        }
        let spent = self.spent + began.elapsed();
        Ok(Picture { pixels: picture.into_pixels(), stats, spent })
    }
}

/// What a panic said.
pub(crate) fn said(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("no reason given")
}
