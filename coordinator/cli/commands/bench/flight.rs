//! `terrafarm bench flight`: finished frames a second of this process, with nothing else in it.
//!
//! The flight is that of `terrafarm demo`, or any other. Its terrain is in memory. Threads
//! take the pieces of one frame after another, in the order of the flight, and put them into
//! the picture; a frame is finished when its last piece is. That is what a worker does for
//! its jobs, without links and without encoding, so it is the most that this PC could film.
//!
//! The first, the middle and the last frame of every run are compared, bit for bit, with
//! the same frame rendered in one piece, and their distances with the surface.

use super::kernel::{self, Refusal};
use super::land::{Land, Load};
use super::report::{Promise, Spread, digits, median, save};
use crate::args::shot::Casting;
use crate::commands::demo;
use crate::input::scene::Scene;
use crate::shot::{Choice, Plan};
use crate::{Outcome, args};
use anyhow::{Context, anyhow, bail};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Instant;
use tempfile::TempDir;
use terrafarm_common::accuracy::Share;
use terrafarm_common::region::{Region, tiles};
use terrafarm_raycast::{View, render};

/// Side of the pieces, pixels: what a worker takes when it has enough of them.
const PIECE_PX: u32 = 256;
/// The short form: posts of the demo's land, size of the picture, frames.
const SHORT_POSTS: u32 = 257;
const SHORT_SIZE: (u32, u32) = (320, 180);
const SHORT_FRAMES: usize = 6;
/// Bytes of a pixel.
const PIXEL_BYTES: usize = 3;

/// What is written as JSON. Keys are promises.
#[derive(Debug, Serialize)]
struct Report {
    program: String,
    flight: String,
    size: [u32; 2],
    frames: usize,
    threads: usize,
    /// Threads that this PC runs at once.
    cores: usize,
    method: &'static str,
    tolerance_px: f64,
    /// Of each run, in their order; wall time.
    runs_frames_per_s: Vec<f64>,
    /// The run in the middle.
    frames_per_s: f64,
    /// Time of one thread for a pixel of it.
    ns_per_pixel: f64,
    /// Share of the pixels that had rays of their own.
    fallback_share: f64,
    /// Frames that were compared, by their number in the flight.
    checked: Vec<usize>,
    error_px_p50: f64,
    error_px_p99: f64,
    error_px_max: f64,
    /// The errors are within the tolerance, and the compared frames are those rendered in
    /// one piece.
    kept: bool,
}

/// A flight with its terrain in memory.
struct Stage {
    name: String,
    land: Land,
    views: Vec<View>,
    /// Goes away with the stage.
    _folder: Option<TempDir>,
}

/// One run.
struct Run {
    seconds: f64,
    fallbacks: u64,
    /// The frames that are to be compared.
    kept: BTreeMap<usize, Vec<u8>>,
}

/// A frame on its way.
#[derive(Default)]
struct Frame {
    /// Empty before the first piece and after the last one.
    pixels: Vec<u8>,
    pieces: usize,
    fallbacks: u64,
}

/// Measures and prints.
pub fn run(args: &args::bench::BenchFlight) -> anyhow::Result<Outcome> {
    let cores = std::thread::available_parallelism().map_or(1, |cores| cores.get());
    let threads = args.threads.map_or(cores, |threads| threads as usize);
    let stage = stage(args)?;
    let checked: Vec<usize> = {
        let last = stage.views.len() - 1;
        let mut checked = vec![0, last / 2, last];
        checked.dedup();
        checked
    };
    let repeats = if args.short { 1 } else { args.repeats };
    let mut runs: Vec<Run> = Vec::new();
    let mut steady = true;
    for _ in 0..repeats {
        let mut run = fly(&stage, threads, &checked).map_err(|Refusal(why)| anyhow!("{why}"))?;
        let rate = stage.views.len() as f64 / run.seconds;
        eprintln!("terrafarm: {} frames/s", digits(rate));
        // The frames of the first run stand for all.
        if let Some(first) = runs.first() {
            steady &= run.kept == first.kept;
            run.kept.clear();
        }
        runs.push(run);
    }
    let (report, wrong) = judge(&stage, [threads, cores], &checked, &runs, steady)?;
    save(args.json.as_deref(), &report)?;
    print!("{}", text(&report));
    for why in &wrong {
        eprintln!("terrafarm: {why}");
    }
    Ok(if report.kept { Outcome::Done } else { Outcome::BrokenPromise })
}

/// The flight that is asked for, or that of the demo over its own terrain.
fn stage(args: &args::bench::BenchFlight) -> anyhow::Result<Stage> {
    let size = if args.short { SHORT_SIZE } else { args.size };
    let (scene_path, flight, name, folder) = match args.scene.as_ref().zip(args.flight.as_ref()) {
        Some((scene, flight)) => {
            (scene.clone(), flight.clone(), flight.display().to_string(), None)
        }
        None => {
            let folder = tempfile::tempdir().context("cannot make a temporary folder")?;
            let [scene, flight] = props(folder.path(), args.short)?;
            (scene, flight, "demo".into(), Some(folder))
        }
    };
    let scene = Scene::read(&scene_path)?;
    let choice = Choice { scene: &scene_path, flight: &flight, size, fps: demo::FPS, frames: None };
    let plan = Plan::read(&scene, &choice)?;
    let (method, tolerance) = (args.method, args.tolerance);
    let quality = Casting { method, tolerance, check: Share::NONE }.over(scene.quality);
    let most = args.frames.map_or(usize::MAX, |frames| frames as usize);
    let most = if args.short { SHORT_FRAMES } else { most };
    // Fewer frames are spread over the flight, so that they are of the same kind.
    let frames = plan.cameras.len().min(most);
    let views: Vec<View> = (0..frames)
        .map(|frame| View {
            camera: plan.cameras[frame * plan.cameras.len() / frames],
            shading: plan.shading.clone(),
            quality,
        })
        .collect();
    if views.is_empty() {
        bail!("{name}: the flight has no frames");
    }
    let land = Land::open(&scene.terrain, Load::All)?;
    Ok(Stage { name, land, views, _folder: folder })
}

/// The demo's terrain, scene and flight in a folder: scene and flight.
fn props(folder: &Path, short: bool) -> anyhow::Result<[PathBuf; 2]> {
    let mut spec = demo::TERRAIN;
    if short {
        // As much land, with fewer posts.
        let share = f64::from(spec.posts - 1) / f64::from(SHORT_POSTS - 1);
        (spec.posts, spec.spacing_m, spec.photo_scale) = (SHORT_POSTS, spec.spacing_m * share, 1);
    }
    let terrain = folder.join("demo.terrain");
    terrafarm_synth::write_store(spec, &terrain, &|_| (), &AtomicBool::new(false))?;
    let write = |name: &str, text: &str| {
        let path = folder.join(name);
        fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))?;
        anyhow::Ok(path)
    };
    Ok([write("demo.toml", demo::SCENE)?, write("demo.csv", demo::FLIGHT)?])
}

/// Renders all frames by so many threads, and keeps those that are to be compared.
fn fly(stage: &Stage, threads: usize, keep: &[usize]) -> Result<Run, Refusal> {
    let camera = &stage.views[0].camera;
    let (width, height) = (camera.width, camera.height);
    let regions = tiles(width, height, PIECE_PX);
    let frames: Vec<Mutex<Frame>> = stage.views.iter().map(|_| Mutex::default()).collect();
    let (next, free) = (AtomicUsize::new(0), Mutex::new(Vec::<Vec<u8>>::new()));
    let kept = Mutex::new(BTreeMap::new());
    let refused = Mutex::new(None);
    let work = || {
        loop {
            let number = next.fetch_add(1, Ordering::Relaxed);
            let (at, region) = (number / regions.len(), regions[number % regions.len()]);
            let Some(view) = stage.views.get(at) else { break };
            let rendered = match piece(&stage.land, view, region) {
                Ok(rendered) => rendered,
                Err(why) => {
                    *lock(&refused) = Some(why);
                    next.store(frames.len() * regions.len(), Ordering::Relaxed);
                    break;
                }
            };
            let mut frame = lock(&frames[at]);
            if frame.pieces == 0 {
                let bytes = width as usize * height as usize * PIXEL_BYTES;
                frame.pixels = lock(&free).pop().unwrap_or_else(|| vec![0; bytes]);
            }
            place(&mut frame.pixels, width, region, &rendered.pixels);
            frame.fallbacks += rendered.stats.fallbacks;
            frame.pieces += 1;
            if frame.pieces == regions.len() {
                let pixels = std::mem::take(&mut frame.pixels);
                if keep.contains(&at) {
                    lock(&kept).insert(at, pixels);
                } else {
                    lock(&free).push(pixels);
                }
            }
        }
    };
    let start = Instant::now();
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(work);
        }
    });
    let seconds = start.elapsed().as_secs_f64().max(1e-9);
    if let Some(why) = lock(&refused).take() {
        return Err(why);
    }
    let fallbacks = frames.iter().map(|frame| lock(frame).fallbacks).sum();
    let kept = std::mem::take(&mut *lock(&kept));
    Ok(Run { seconds, fallbacks, kept })
}

fn piece(land: &Land, view: &View, region: Region) -> Result<terrafarm_raycast::Rendered, Refusal> {
    let rendered = render(&land.resident, &land.pyramid, view, region)?;
    match rendered.missing.len() {
        0 => Ok(rendered),
        missing => Err(Refusal(format!("{missing} tiles are not loaded"))),
    }
}

/// Copies the rows of a piece into the picture.
fn place(picture: &mut [u8], width: u32, region: Region, pixels: &[u8]) {
    let row = region.width as usize * PIXEL_BYTES;
    for (y, from) in (region.y..).zip(pixels.chunks_exact(row)) {
        let at = (y as usize * width as usize + region.x as usize) * PIXEL_BYTES;
        picture[at..at + row].copy_from_slice(from);
    }
}

/// A thread that panicked has ended the bench anyway.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Compares what was rendered with the truth, all runs alike if they are steady. Also returns
/// what is wrong, in words.
fn judge(
    stage: &Stage,
    [threads, cores]: [usize; 2],
    checked: &[usize],
    runs: &[Run],
    steady: bool,
) -> anyhow::Result<(Report, Vec<String>)> {
    let view = &stage.views[0];
    let (camera, quality) = (&view.camera, view.quality);
    let whole = Region::whole(camera.width, camera.height);
    let mut wrong = Vec::new();
    if !steady {
        wrong.push("a later run rendered other frames than the first".into());
    }
    let mut errors_px = Vec::new();
    for &at in checked {
        let view = &stage.views[at];
        let look = || -> Result<_, Refusal> {
            let picture = kernel::picture(&stage.land, view, whole)?;
            let answer = kernel::answer(&stage.land, view)?;
            Ok((picture, kernel::errors(&stage.land, view, whole, &answer)?))
        };
        let (picture, errors) = look().map_err(|Refusal(why)| anyhow!("{why}"))?;
        if runs[0].kept.get(&at) != Some(&picture) {
            wrong.push(format!("frame {at} is not the one that is rendered in one piece"));
        }
        errors_px.extend(errors.error_px);
    }
    let spread = Spread::of(errors_px);
    let promise = Promise::of(quality.method, quality.tolerance_px);
    if !promise.holds(&spread) {
        let (value, bound) = (promise.value(&spread), promise.bound_px);
        wrong.push(format!("the {} of the error is {value} px, above {bound}", promise.figure));
    }
    let (frames, pixels) = (stage.views.len(), whole.area() as f64);
    let mut rates: Vec<f64> = runs.iter().map(|run| frames as f64 / run.seconds).collect();
    let runs_frames_per_s = rates.clone();
    let frames_per_s = median(&mut rates);
    let report = Report {
        program: format!("terrafarm {}", env!("CARGO_PKG_VERSION")),
        flight: stage.name.clone(),
        size: [camera.width, camera.height],
        frames,
        threads,
        cores,
        method: quality.method.name(),
        tolerance_px: quality.tolerance_px,
        runs_frames_per_s,
        frames_per_s,
        ns_per_pixel: threads.min(cores) as f64 / (frames_per_s * pixels) * 1e9,
        fallback_share: runs[0].fallbacks as f64 / (frames as f64 * pixels),
        checked: checked.to_vec(),
        error_px_p50: spread.p50,
        error_px_p99: spread.p99,
        error_px_max: spread.max,
        kept: wrong.is_empty(),
    };
    Ok((report, wrong))
}

fn text(report: &Report) -> String {
    let Report { flight, size: [width, height], frames, threads, method, .. } = report;
    let slowest = report.runs_frames_per_s.iter().copied().fold(f64::INFINITY, f64::min);
    let fastest = report.runs_frames_per_s.iter().copied().fold(0.0, f64::max);
    let count = |count: usize, what: &str| {
        let many = if count == 1 { "" } else { "s" };
        format!("{count} {what}{many}")
    };
    format!(
        "{flight}: {} of {width} x {height}, finished, by {method} to {} px, {}: \
         {} frames/s\n\
         {} to {} in {}; {} ns a pixel for one thread; {} % of the pixels had rays of their own\n\
         error of {}: half within {}, 99 of 100 within {}, all within {} px\n",
        count(*frames, "frame"),
        report.tolerance_px,
        count(*threads, "thread"),
        digits(report.frames_per_s),
        digits(slowest),
        digits(fastest),
        count(report.runs_frames_per_s.len(), "run"),
        digits(report.ns_per_pixel),
        digits(100.0 * report.fallback_share),
        count(report.checked.len(), "frame"),
        digits(report.error_px_p50),
        digits(report.error_px_p99),
        digits(report.error_px_max),
    )
}
