//! One job on all cores: pieces of its region, each rendered as far as its tiles allow.
//!
//! A job keeps what is done of every piece, so that a pause for missing tiles repeats
//! nothing. A live job does not wait: what is left of it is shown as coarse as it is at hand.
//! A piece whose pixels are done has some of them measured, if the shot asks for
//! that; tiles that only the measurement needs are waited for like others. The stop flag is looked at before each piece: a revoked job ends within the
//! time of one piece a core. A panic of the ray caster ends the job, not the worker.

use crate::clock::CoreClock;
use crate::office::Gate;
use std::any::Any;
use std::collections::BTreeSet;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use terrafarm_common::accuracy::{PixelError, Share, Summary, pixel_number};
use terrafarm_common::id::{FrameIndex, LeaseId};
use terrafarm_common::image::Rgb8;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::{Region, tiles};
use terrafarm_raycast::meter::measure;
use terrafarm_raycast::{
    Glimpse, Missing, Progress, Pyramid, Rendered, Stats, Unfit, Unseen, View, depths,
    render_at_hand,
};
use terrafarm_terrain::layout::{StoreIndex, TileKey};
use terrafarm_terrain::resident::Resident;

/// Side of a piece, pixels: dozens of pieces even in a small frame. Views of the demo's flight
/// by `auto`, 1920 x 1080, nanoseconds a pixel for sides of 32, 64, 128 and 256: finding depths
/// 33, 16, 13, 11.5, all 46, 29, 25, 23.5 (example `frame` of the ray caster).
const PIECE_PX: u32 = 128;
/// The shortest side of a piece, pixels.
const LEAST_PIECE_PX: u32 = 16;
/// Side of a piece where each thread gets at least [`LARGE_PIECES`] of them, or one thread all.
const LARGE_PIECE_PX: u32 = 256;
/// So many that threads that wait for the last one cost less than the larger pieces save.
const LARGE_PIECES: u64 = 16;

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
    ///
    /// # Errors
    /// If the method is not made for the view.
    fn advance(
        &self,
        scene: &Scene<Self::Prepared>,
        view: &View,
        piece: &mut Self::Piece,
    ) -> Result<Vec<TileKey>, Unfit>;

    /// The pixels of a piece that waits for nothing.
    fn finish(&self, piece: Self::Piece) -> Rendered;

    /// What can be shown of a region with the tiles in memory, whatever is missing.
    ///
    /// # Errors
    /// If there is nothing to show, or the method is not made for the view.
    fn glimpse(
        &self,
        scene: &Scene<Self::Prepared>,
        view: &View,
        region: Region,
    ) -> Result<Glimpse, Unseen>;

    /// The tiles that a region of a view will probably need and that are not in memory: a
    /// guess, soon made. A caster that needs no tiles has none to name.
    fn scout(&self, _scene: &Scene<Self::Prepared>, _view: &View, _region: Region) -> Vec<TileKey> {
        Vec::new()
    }

    /// How wrong the answer of the view's method is for pixel (x, y).
    ///
    /// # Errors
    /// The tiles that are needed to tell and are not in memory, or why the method will not.
    fn gauge(
        &self,
        scene: &Scene<Self::Prepared>,
        view: &View,
        x: u32,
        y: u32,
    ) -> Result<PixelError, Unseen>;

    /// Tries how many pixels it renders in a second on the thread pool that it is called on;
    /// `None` if that would say nothing.
    fn trial(&self) -> Option<u64> {
        None
    }
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

    fn advance(
        &self,
        scene: &Scene<Pyramid>,
        view: &View,
        piece: &mut Progress,
    ) -> Result<Vec<TileKey>, Unfit> {
        piece.advance(&scene.resident, &scene.prepared, view)
    }

    fn finish(&self, piece: Progress) -> Rendered {
        piece.into_rendered(Vec::new())
    }

    fn glimpse(
        &self,
        scene: &Scene<Pyramid>,
        view: &View,
        region: Region,
    ) -> Result<Glimpse, Unseen> {
        // Of the methods, these two can do with coarser ground.
        let method = match view.quality.method {
            Method::Column => Method::Column,
            _ => Method::Lod,
        };
        let quality = Quality { method, ..view.quality };
        let view = View { quality, ..view.clone() };
        render_at_hand(&scene.resident, &scene.prepared, &view, region)
    }

    fn scout(&self, scene: &Scene<Pyramid>, view: &View, region: Region) -> Vec<TileKey> {
        terrafarm_raycast::scout(&scene.resident, &scene.prepared, view, region)
    }

    fn gauge(
        &self,
        scene: &Scene<Pyramid>,
        view: &View,
        x: u32,
        y: u32,
    ) -> Result<PixelError, Unseen> {
        let (resident, pyramid) = (&scene.resident, &scene.prepared);
        // A pixel does not depend on the region that it is asked for in.
        let alone = Region { x, y, width: 1, height: 1 };
        let found = depths(resident, pyramid, view, alone)?;
        let claimed = found.distance_m(view, x, y);
        measure(resident, pyramid, view, x, y, claimed)
            .map_err(|Missing(tiles)| Unseen::Missing(tiles))
    }

    fn trial(&self) -> Option<u64> {
        crate::trial::pixels_per_s()
    }
}

/// Which pixels of a frame are measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Check {
    /// How many of them.
    pub share: Share,
    /// Number of the frame, for the choice.
    pub frame: FrameIndex,
}

/// A job that has been begun.
pub struct Job<C: Caster> {
    /// Under which it is answered.
    pub lease: LeaseId,
    view: View,
    region: Region,
    check: Check,
    pieces: Vec<Piece<C>>,
    stop: Arc<AtomicBool>,
    spent: Duration,
    /// How much of it others had the cores, all threads together.
    coreless: AtomicU64,
}

struct Piece<C: Caster> {
    region: Region,
    progress: C::Piece,
    rendered: bool,
    /// What is shown instead, if it was not to be waited for.
    glimpse: Option<Glimpse>,
    /// Pixels that are still to be measured.
    unmeasured: Vec<[u32; 2]>,
    errors: Summary,
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
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// Three bytes a pixel, rows from the top.
    pub pixels: Vec<u8>,
    /// Rays, steps and the like; those of the check left out.
    pub stats: Stats,
    /// Pixels that show coarser terrain, because it had not come: counted by pieces
    /// of the job, of ground and colour whichever is more.
    pub coarser: u64,
    /// The errors of the pixels that were measured, if any were to be.
    pub errors: Option<Summary>,
    /// Time on the pool, waiting for tiles left out.
    pub spent: Duration,
    /// Time that threads of the pool were at work without a core, all of them together.
    pub coreless: Duration,
}

impl<C: Caster> Job<C> {
    /// A job of which nothing is done. Setting `stop` ends it early.
    pub fn new(
        caster: &C,
        lease: LeaseId,
        view: View,
        region: Region,
        check: Check,
        stop: Arc<AtomicBool>,
    ) -> Self {
        let side =
            piece_px(region, rayon::current_num_threads() as u64, view.quality.samples_per_side);
        let pieces = tiles(region.width, region.height, side).into_iter().map(|piece| {
            let region = Region { x: region.x + piece.x, y: region.y + piece.y, ..piece };
            Piece {
                region,
                progress: caster.begin(region),
                rendered: false,
                glimpse: None,
                unmeasured: check.pixels(region),
                errors: Summary::default(),
            }
        });
        Job {
            lease,
            view,
            region,
            check,
            pieces: pieces.collect(),
            stop,
            spent: Duration::ZERO,
            coreless: AtomicU64::new(0),
        }
    }

    /// Renders what can be rendered, on the thread pool it is called on, by as many threads
    /// as the gate lets. Gives the reason if the ray caster panics.
    pub fn advance(
        self: Box<Self>,
        caster: &C,
        scene: &Scene<C::Prepared>,
        gate: &Gate,
    ) -> Result<Outcome<C>, String> {
        self.go(caster, gate, |piece, view, frame| piece.advance(caster, scene, view, frame))
    }

    /// As [`Job::advance`], but nothing is tried again: what waits for tiles is shown as it is
    /// at hand, and not measured. A job still waits if there is nothing to show.
    pub fn settle(
        self: Box<Self>,
        caster: &C,
        scene: &Scene<C::Prepared>,
        gate: &Gate,
    ) -> Result<Outcome<C>, String> {
        let outcome = self.go(caster, gate, |piece, view, _| piece.settle(caster, scene, view))?;
        Ok(match outcome {
            Outcome::Missing(job, keys) => {
                // With the roots there is something to show: it waits for no more.
                let resident = &scene.resident;
                let mut roots = resident.index().roots();
                roots.retain(|root| !resident.is_loaded(*root));
                Outcome::Missing(job, if roots.is_empty() { keys } else { roots })
            }
            outcome => outcome,
        })
    }

    fn go(
        mut self: Box<Self>,
        caster: &C,
        gate: &Gate,
        step: impl Fn(&mut Piece<C>, &View, FrameIndex) -> Result<BTreeSet<TileKey>, Unfit> + Sync,
    ) -> Result<Outcome<C>, String> {
        let began = Instant::now();
        let missing = catch_unwind(AssertUnwindSafe(|| self.sweep(gate, step)));
        self.spent += began.elapsed();
        let missing = missing
            .map_err(|panic| format!("the ray caster failed: {}", said(&*panic)))?
            .map_err(|unfit| unfit.to_string())?;
        if self.stop.load(Ordering::Relaxed) {
            return Ok(Outcome::Stopped);
        }
        if !missing.is_empty() {
            return Ok(Outcome::Missing(self, missing.into_iter().collect()));
        }
        self.assemble(caster).map(Outcome::Done)
    }

    /// One go over all pieces that are not done; the tiles they wait for.
    fn sweep(
        &mut self,
        gate: &Gate,
        step: impl Fn(&mut Piece<C>, &View, FrameIndex) -> Result<BTreeSet<TileKey>, Unfit> + Sync,
    ) -> Result<BTreeSet<TileKey>, Unfit> {
        let (view, stop, frame) = (&self.view, &self.stop, self.check.frame);
        let coreless = &self.coreless;
        let missing = Mutex::new(Ok(BTreeSet::new()));
        let open = self.pieces.iter_mut().filter(|piece| !piece.is_done());
        share_out(open, gate, |piece| {
            if stop.load(Ordering::Relaxed) {
                return;
            }
            let counted = CoreClock::start(coreless);
            let more = step(piece, view, frame);
            drop(counted);
            let mut missing = missing.lock().unwrap_or_else(PoisonError::into_inner);
            match (&mut *missing, more) {
                (Ok(all), Ok(more)) => all.extend(more),
                (Ok(_), Err(unfit)) => *missing = Err(unfit),
                (Err(_), _) => {}
            }
        });
        missing.into_inner().unwrap_or_else(PoisonError::into_inner)
    }

    fn assemble(self, caster: &C) -> Result<Picture, String> {
        let began = Instant::now();
        let mut picture = Rgb8::new(self.region.width, self.region.height);
        let mut stats = Stats::default();
        let mut errors = Summary::default();
        let mut coarser = 0;
        for piece in self.pieces {
            let Region { x, y, .. } = self.region;
            let place = Region { x: piece.region.x - x, y: piece.region.y - y, ..piece.region };
            let done = piece.is_done();
            let rendered = caster.finish(piece.progress);
            let shown = piece.glimpse.as_ref().map_or(&rendered.pixels, |glimpse| &glimpse.pixels);
            if !done || !picture.paste(place, shown) {
                return Err(format!("the ray caster left {:?} undone", piece.region));
            }
            stats.rays += rendered.stats.rays;
            stats.steps += rendered.stats.steps;
            stats.hits += rendered.stats.hits;
            stats.fallbacks += rendered.stats.fallbacks;
            stats.below_ground |= rendered.stats.below_ground;
            errors.merge(&piece.errors);
            if let Some(glimpse) = &piece.glimpse {
                coarser += glimpse.coarser_ground.max(glimpse.coarser_color);
            }
        }
        let spent = self.spent + began.elapsed();
        let coreless = Duration::from_nanos(self.coreless.into_inner());
        let errors = (self.check.share != Share::NONE).then_some(errors);
        Ok(Picture { pixels: picture.into_pixels(), stats, coarser, errors, spent, coreless })
    }
}

/// The side of the pieces of a region that so many threads render, with so many samples along
/// a side of each pixel: what a piece takes in memory grows with its samples.
fn piece_px(region: Region, threads: u64, samples: u32) -> u32 {
    let pixels = u64::from(region.width) * u64::from(region.height);
    let large = pixels / u64::from(LARGE_PIECE_PX).pow(2);
    let alone = threads == 1 || large >= LARGE_PIECES * threads;
    let side = if alone { LARGE_PIECE_PX } else { PIECE_PX };
    (side / samples.max(1)).max(LEAST_PIECE_PX)
}

/// Has the threads of the pool that it is called on take items until there are none, never
/// more threads at once than the gate lets. One that is too many leaves after the item in its hand;
/// the gate lets at least one, so that the items always come to an end.
fn share_out<T: Send>(items: impl Iterator<Item = T> + Send, gate: &Gate, work: impl Fn(T) + Sync) {
    let items = Mutex::new(items);
    let at_work = AtomicUsize::new(0);
    let step = |change: fn(usize, usize) -> Option<usize>| {
        let changed = at_work.try_update(Ordering::Relaxed, Ordering::Relaxed, |count| {
            change(count, gate.threads())
        });
        changed.is_ok()
    };
    let turn = |_: &rayon::Scope<'_>| {
        if !step(|count, most| (count < most).then_some(count + 1)) {
            return;
        }
        while !step(|count, most| (count > most).then(|| count - 1)) {
            let item = items.lock().unwrap_or_else(PoisonError::into_inner).next();
            let Some(item) = item else { return };
            work(item);
        }
    };
    rayon::scope(|scope| {
        for _ in 1..rayon::current_num_threads() {
            scope.spawn(turn);
        }
        turn(scope);
    });
}

impl Check {
    /// The pixels of a region that are measured.
    fn pixels(self, region: Region) -> Vec<[u32; 2]> {
        if self.share == Share::NONE {
            return Vec::new();
        }
        let rows = region.y..region.y + region.height;
        let all = rows.flat_map(|y| (region.x..region.x + region.width).map(move |x| [x, y]));
        all.filter(|&[x, y]| self.share.takes(pixel_number(self.frame, x, y))).collect()
    }
}

impl<C: Caster> Piece<C> {
    fn is_done(&self) -> bool {
        self.rendered && self.unmeasured.is_empty()
    }

    /// Does what can be done; the tiles that the rest waits for.
    fn advance(
        &mut self,
        caster: &C,
        scene: &Scene<C::Prepared>,
        view: &View,
        frame: FrameIndex,
    ) -> Result<BTreeSet<TileKey>, Unfit> {
        if !self.rendered {
            let missing = caster.advance(scene, view, &mut self.progress)?;
            self.rendered = missing.is_empty();
            if !self.rendered {
                return Ok(missing.into_iter().collect());
            }
        }
        self.measure(caster, scene, view, frame)
    }

    /// Shows what is at hand of what is not rendered; the tiles to wait for if there is
    /// nothing.
    fn settle(
        &mut self,
        caster: &C,
        scene: &Scene<C::Prepared>,
        view: &View,
    ) -> Result<BTreeSet<TileKey>, Unfit> {
        if !self.rendered {
            match caster.glimpse(scene, view, self.region) {
                Ok(glimpse) if glimpse.holes == 0 => self.glimpse = Some(glimpse),
                Ok(Glimpse { wanted, .. }) | Err(Unseen::Missing(wanted)) => {
                    return Ok(wanted.into_iter().collect());
                }
                Err(Unseen::Unfit(unfit)) => return Err(unfit),
            }
        }
        self.rendered = true;
        self.unmeasured.clear();
        Ok(BTreeSet::new())
    }

    /// Measures what can be measured; the tiles that the rest waits for.
    fn measure(
        &mut self,
        caster: &C,
        scene: &Scene<C::Prepared>,
        view: &View,
        frame: FrameIndex,
    ) -> Result<BTreeSet<TileKey>, Unfit> {
        let mut missing = BTreeSet::new();
        let errors = &mut self.errors;
        let mut refused = None;
        self.unmeasured.retain(|&[x, y]| match caster.gauge(scene, view, x, y) {
            Ok(error) => {
                errors.add(pixel_number(frame, x, y), &error);
                false
            }
            Err(Unseen::Unfit(unfit)) => {
                refused = Some(unfit);
                true
            }
            Err(Unseen::Missing(tiles)) => {
                missing.extend(tiles);
                true
            }
        });
        refused.map_or(Ok(missing), Err)
    }
}

/// What a panic said.
pub(crate) fn said(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("no reason given")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;
    use proptest::prelude::*;

    fn pool(threads: usize) -> rayon::ThreadPool {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap()
    }

    /// Shares numbers out and returns those that came, and how many were in hand at once.
    fn shared(
        threads: usize,
        gate: &Gate,
        count: u32,
        at: impl Fn(u32) + Sync,
    ) -> (Vec<u32>, usize) {
        let (seen, in_hand, most) =
            (Mutex::new(Vec::new()), AtomicUsize::new(0), AtomicUsize::new(0));
        pool(threads).install(|| {
            share_out(0..count, gate, |number| {
                most.fetch_max(in_hand.fetch_add(1, Ordering::SeqCst) + 1, Ordering::SeqCst);
                at(number);
                seen.lock().unwrap().push(number);
                in_hand.fetch_sub(1, Ordering::SeqCst);
            });
        });
        let mut seen = seen.into_inner().unwrap();
        seen.sort_unstable();
        (seen, most.into_inner())
    }

    #[test]
    fn threads_that_are_too_many_leave_after_the_item_in_their_hand() {
        let gate = Gate::new(4);
        let closed = AtomicBool::new(false);
        let after: [AtomicUsize; 4] = std::array::from_fn(|_| AtomicUsize::new(0));
        let (seen, _) = shared(4, &gate, 2000, |number| {
            if closed.load(Ordering::SeqCst) {
                after[rayon::current_thread_index().unwrap()].fetch_add(1, Ordering::SeqCst);
            }
            if number == 100 {
                gate.set(1);
                closed.store(true, Ordering::SeqCst);
            }
        });
        assert_eq!(seen, (0..2000).collect::<Vec<_>>());
        // A thread may just have looked at the gate: then it takes one more.
        let stayed = after.iter().filter(|count| count.load(Ordering::SeqCst) > 1).count();
        assert_eq!(stayed, 1);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn every_item_is_done_once_by_no_more_threads_than_the_gate_lets(
            threads in 1usize..6, gate in 1usize..8, count in 0u32..200,
        ) {
            let (seen, most) = shared(threads, &Gate::new(gate), count, |_| {});
            prop_assert_eq!(seen, (0..count).collect::<Vec<_>>());
            prop_assert!(most <= gate.min(threads));
        }
    }
}
