//! `terrafarm bench terrain-size`: what a frame costs over ever larger terrain.
//!
//! The same short flight over the middle of terrains of the same ground, each with more land
//! up to the horizon than the one before, from disk through a worker's cache. First every
//! flight is flown with an empty cache: tiles, memory, and time for loading. Then each frame
//! is timed with its tiles in memory: all terrains and methods in turn, so that whatever
//! else the PC does meets all of them; the median counts. *Rays* are the distances alone,
//! *picture* is what a worker does for a job: rays in pieces, and shading. Pixels of each
//! terrain are compared with `exact`.
//!
//! The land is flat, so that the Earth hides nothing, and noise of 2 km of relief that is
//! rough at every scale: real terrain is easier.

mod cache;
mod stores;

use self::cache::Cache;
use self::stores::{Made, SPACING_M};
use super::clock;
use super::report::{Promise, Spread, digits, median, save, table};
use crate::{Outcome, args};
use anyhow::Context;
use glam::DVec3;
use serde::Serialize;
use std::path::Path;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::shading::{Shading, Sky, Sun};
use terrafarm_raycast::{Depths, View};

/// The methods whose cost is to follow the picture and not the terrain.
const METHODS: [Method; 2] = [Method::Lod, Method::Column];
const TOLERANCE_PX: f64 = 1.0;
/// Posts along a side of the terrain that others are compared with.
const BASE_POSTS: u32 = 4097;
/// How much more a frame over any larger terrain may cost.
const MOST_RATIO: f64 = 1.3;
/// Cameras: name, and pitch in degrees.
const CAMERAS: [(&str, f64); 2] = [("horizon", -5.0), ("down30", -30.0)];
const HEADING_DEG: f64 = 50.0;
const HFOV_DEG: f64 = 60.0;
/// Height of the cameras above the highest ground so many posts around the middle.
const ABOVE_M: f64 = 1500.0;
const CLEARED_POSTS: u64 = 30;
/// Frames of the flight, and the way from one to the next.
const FRAMES: u32 = 4;
const STEP_M: f64 = 60.0;
/// Pixels along the sides of the picture that are compared with `exact`.
const CHECKED: [u32; 2] = [24, 14];
/// The short form.
const SHORT_POSTS: [u32; 3] = [513, 1025, 2049];
const SHORT_SIZE: (u32, u32) = (160, 90);

/// What is written as JSON. Keys are promises.
#[derive(Debug, Serialize)]
struct Report {
    program: String,
    /// What times of frames are.
    clock: &'static str,
    size: [u32; 2],
    tolerance_px: f64,
    spacing_m: f64,
    cache_limit_bytes: u64,
    frames: u32,
    repeats: u32,
    /// Posts along a side of the terrain that ratios refer to.
    base_posts: u32,
    stores: Vec<Store>,
    cases: Vec<Case>,
    /// The largest ratios of terrains larger than the base.
    worst_ratio_rays: f64,
    worst_ratio_picture: f64,
    /// Nothing is wrong, no cache was too small, and no ratio is above the bound where the
    /// base is of the full form.
    kept: bool,
}

#[derive(Debug, Serialize)]
struct Store {
    posts: u32,
    bytes: u64,
    /// Absent if it was there.
    built_s: Option<f64>,
}

/// A terrain, a camera and a method.
#[derive(Debug, Serialize)]
struct Case {
    posts: u32,
    camera: &'static str,
    method: &'static str,
    /// The flight with an empty cache: tiles that were asked for ...
    tiles: u64,
    /// ... loads, those of tiles that had gone included, and the time for them ...
    loads: u64,
    load_s: f64,
    /// ... and the most memory, of the cache and of the process (where the system tells).
    peak_cache_bytes: u64,
    peak_process_bytes: Option<u64>,
    /// Medians over the frames, tiles in memory.
    rays_ms: f64,
    picture_ms: f64,
    /// The same over those of the base.
    ratio_rays: f64,
    ratio_picture: f64,
    steps_per_pixel: f64,
    /// Share of the pixels of the first frame that show ground, and the farthest of it.
    ground: f64,
    farthest_m: f64,
    error_px_p99: f64,
    error_px_max: f64,
    /// The error is within what the method promises.
    right: bool,
    #[serde(skip)]
    times: [Vec<f64>; 2],
}

/// Measures and prints.
pub fn run(args: &args::bench::BenchTerrainSize) -> anyhow::Result<Outcome> {
    let (mut sizes, size) = match args.short {
        true => (SHORT_POSTS.to_vec(), SHORT_SIZE),
        false => (args.posts.clone(), args.size),
    };
    sizes.sort_unstable();
    sizes.dedup();
    let temporary = match args.stores {
        Some(_) => None,
        None => Some(tempfile::tempdir().context("cannot make a temporary folder")?),
    };
    let own = temporary.as_ref().map(|folder| folder.path());
    let folder = args.stores.as_deref().or(own).unwrap_or(Path::new("."));
    std::fs::create_dir_all(folder)
        .with_context(|| format!("cannot make the folder {}", folder.display()))?;
    let made = stores::all(folder, &sizes)?;
    // One thread, which is the one that is timed.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    let report = pool.install(|| bench(&made, size, args))?;
    print!("{}", text(&report));
    Ok(if report.kept { Outcome::Done } else { Outcome::BrokenPromise })
}

fn bench(
    made: &[Made],
    size: (u32, u32),
    args: &args::bench::BenchTerrainSize,
) -> anyhow::Result<Report> {
    let base = made.iter().find(|made| made.posts == BASE_POSTS).or(made.first());
    let mut report = Report {
        program: format!("terrafarm {}", env!("CARGO_PKG_VERSION")),
        clock: clock::KIND,
        size: [size.0, size.1],
        tolerance_px: TOLERANCE_PX,
        spacing_m: SPACING_M,
        cache_limit_bytes: args.cache << 20,
        frames: FRAMES,
        repeats: args.repeats,
        base_posts: base.map_or(0, |made| made.posts),
        stores: made.iter().map(Store::of).collect(),
        cases: Vec::new(),
        worst_ratio_rays: 0.0,
        worst_ratio_picture: 0.0,
        kept: false,
    };
    for made in made {
        for (camera, pitch_deg) in CAMERAS {
            for method in METHODS {
                let views = flight(pitch_deg, size, method);
                let case = fly(made, camera, &views, report.cache_limit_bytes)?;
                eprintln!(
                    "terrafarm: flew {camera} over {} posts by {method}: {} tiles, {} s of loading",
                    made.posts,
                    case.tiles,
                    digits(case.load_s)
                );
                report.cases.push(case);
                save(args.json.as_deref(), &report)?;
            }
        }
    }
    time(made, size, args.repeats, &mut report)?;
    compare(&mut report);
    save(args.json.as_deref(), &report)?;
    Ok(report)
}

/// The views of the flight over the middle of every terrain.
fn flight(pitch_deg: f64, size: (u32, u32), method: Method) -> Vec<View> {
    let z = stores::highest_in_the_middle(CLEARED_POSTS) + ABOVE_M;
    let shading = Shading {
        sun: Some(Sun::at(315.0, 35.0, 0.35, 0.5)),
        haze: None,
        sky: Sky::default(),
        earth: None,
        below_ground: [0.0; 3],
        bare_ground: None,
    };
    let quality = Quality { method, samples_per_side: 1, tolerance_px: TOLERANCE_PX };
    let start = Camera::from_angles(DVec3::ZERO, HEADING_DEG, 0.0, 0.0, HFOV_DEG, size);
    let ahead = start.ray(f64::from(size.0) / 2.0, f64::from(size.1) / 2.0);
    let ahead = DVec3::new(ahead.x, ahead.y, 0.0).normalize_or_zero();
    let view = |frame: u32| {
        let eye = ahead * (f64::from(frame) * STEP_M) + DVec3::new(0.0, 0.0, z);
        let camera = Camera::from_angles(eye, HEADING_DEG, pitch_deg, 0.0, HFOV_DEG, size);
        View { camera, shading: shading.clone(), quality }
    };
    (0..FRAMES).map(view).collect()
}

/// Flies with an empty cache, and checks the first frame.
fn fly(
    made: &Made,
    camera: &'static str,
    views: &[View],
    limit_bytes: u64,
) -> anyhow::Result<Case> {
    let peak = ProcessPeak::begin();
    let mut cache = Cache::new(&made.store, limit_bytes);
    let mut first = None;
    for view in views {
        cache.begin();
        cache.picture(view)?;
        let depths = cache.depths(view)?;
        first.get_or_insert((view, depths));
    }
    let (view, depths) = first.context("the flight has no frame")?;
    let pixels = depths.region.area() as f64;
    let peak_process_bytes = peak.bytes();
    let shown: Vec<f64> = depths
        .region
        .pixels()
        .map(|[x, y]| depths.distance_m(view, x, y))
        .filter(|distance| distance.is_finite())
        .collect();
    let spread = check(made, view, &depths, limit_bytes)?;
    Ok(Case {
        posts: made.posts,
        camera,
        method: view.quality.method.name(),
        tiles: cache.touched.len() as u64,
        loads: cache.loads,
        load_s: cache.load_s,
        peak_cache_bytes: cache.peak_bytes,
        peak_process_bytes,
        rays_ms: 0.0,
        picture_ms: 0.0,
        ratio_rays: 0.0,
        ratio_picture: 0.0,
        steps_per_pixel: depths.stats.steps as f64 / pixels,
        ground: shown.len() as f64 / pixels,
        farthest_m: shown.into_iter().fold(0.0, f64::max),
        error_px_p99: spread.p99,
        error_px_max: spread.max,
        right: Promise::of(view.quality.method, TOLERANCE_PX).holds(&spread),
        times: Default::default(),
    })
}

/// Compares a net of pixels with `exact`, in a cache of its own: what only `exact` needs is
/// no part of the method's memory.
fn check(made: &Made, view: &View, depths: &Depths, limit_bytes: u64) -> anyhow::Result<Spread> {
    let mut cache = Cache::new(&made.store, limit_bytes);
    let mut errors = Vec::new();
    let step = [(view.camera.width, CHECKED[0]), (view.camera.height, CHECKED[1])]
        .map(|(side, count)| (side / count).max(1));
    for y in (step[1] / 2..view.camera.height).step_by(step[1] as usize) {
        for x in (step[0] / 2..view.camera.width).step_by(step[0] as usize) {
            cache.begin();
            errors.push(cache.error_px(view, [x, y], depths.distance_m(view, x, y))?);
        }
    }
    Ok(Spread::of(errors))
}

/// Times every frame over all terrains in turn, its tiles in memory.
fn time(made: &[Made], size: (u32, u32), repeats: u32, report: &mut Report) -> anyhow::Result<()> {
    let limit_bytes = report.cache_limit_bytes;
    for (camera, pitch_deg) in CAMERAS {
        let flights = METHODS.map(|method| flight(pitch_deg, size, method));
        let mut caches: Vec<_> =
            made.iter().map(|made| Cache::new(&made.store, limit_bytes)).collect();
        for frame in 0..FRAMES as usize {
            for cache in &mut caches {
                cache.begin();
                for views in &flights {
                    cache.picture(&views[frame])?;
                    cache.depths(&views[frame])?;
                }
            }
            for _ in 0..repeats {
                for (made, cache) in made.iter().zip(&mut caches) {
                    for views in &flights {
                        let view = &views[frame];
                        let method = view.quality.method.name();
                        let this = |case: &&mut Case| {
                            (case.posts, case.camera, case.method) == (made.posts, camera, method)
                        };
                        let case = report.cases.iter_mut().find(this).context("no such case")?;
                        let loads = cache.loads;
                        let (rays_s, depths) = clock::timed(|| cache.depths(view));
                        depths?;
                        let (picture_s, picture) = clock::timed(|| cache.picture(view));
                        picture?;
                        anyhow::ensure!(cache.loads == loads, "tiles were loaded while timed");
                        case.times[0].push(rays_s * 1e3);
                        case.times[1].push(picture_s * 1e3);
                    }
                }
            }
        }
    }
    Ok(())
}

/// Medians, ratios and the verdict.
fn compare(report: &mut Report) {
    for case in &mut report.cases {
        case.rays_ms = median(&mut case.times[0]);
        case.picture_ms = median(&mut case.times[1]);
    }
    let base_posts = report.base_posts;
    let bases: Vec<_> = report
        .cases
        .iter()
        .filter(|case| case.posts == base_posts)
        .map(|case| (case.camera, case.method, case.rays_ms, case.picture_ms))
        .collect();
    for case in &mut report.cases {
        let same = |base: &&(&str, &str, f64, f64)| (base.0, base.1) == (case.camera, case.method);
        if let Some(&(_, _, rays_ms, picture_ms)) = bases.iter().find(same) {
            case.ratio_rays = case.rays_ms / rays_ms.max(f64::MIN_POSITIVE);
            case.ratio_picture = case.picture_ms / picture_ms.max(f64::MIN_POSITIVE);
        }
        if case.posts > base_posts {
            report.worst_ratio_rays = report.worst_ratio_rays.max(case.ratio_rays);
            report.worst_ratio_picture = report.worst_ratio_picture.max(case.ratio_picture);
        }
    }
    let worst = report.worst_ratio_rays.max(report.worst_ratio_picture);
    let within = base_posts != BASE_POSTS || worst <= MOST_RATIO;
    report.kept = within && report.cases.iter().all(|case| case.right);
}

impl Store {
    fn of(made: &Made) -> Self {
        Store { posts: made.posts, bytes: made.store.file_bytes(), built_s: made.built_s }
    }
}

/// The most memory that this process has had since some moment, where Linux tells.
struct ProcessPeak;

impl ProcessPeak {
    fn begin() -> Self {
        // 5 resets the peak; where that is not allowed it is that of the whole run.
        let _ = std::fs::write("/proc/self/clear_refs", "5");
        ProcessPeak
    }

    fn bytes(&self) -> Option<u64> {
        let status = std::fs::read_to_string("/proc/self/status").ok()?;
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
        let kibibytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
        Some(kibibytes << 10)
    }
}

fn text(report: &Report) -> String {
    let head = [
        "camera",
        "method",
        "posts",
        "rays ms",
        "ratio",
        "picture ms",
        "ratio",
        "steps/pixel",
        "farthest km",
        "tiles",
        "load s",
        "cache MiB",
        "process MiB",
        "p99 px",
        "",
    ];
    let mebibytes = |bytes: u64| digits(bytes as f64 / f64::from(1 << 20));
    let mut rows = Vec::new();
    for (camera, _) in CAMERAS {
        for method in METHODS.map(Method::name) {
            let of = |case: &&Case| (case.camera, case.method) == (camera, method);
            rows.extend(report.cases.iter().filter(of).map(|case| {
                vec![
                    camera.to_owned(),
                    method.to_owned(),
                    case.posts.to_string(),
                    digits(case.rays_ms),
                    digits(case.ratio_rays),
                    digits(case.picture_ms),
                    digits(case.ratio_picture),
                    digits(case.steps_per_pixel),
                    digits(case.farthest_m * 1e-3),
                    case.tiles.to_string(),
                    digits(case.load_s),
                    mebibytes(case.peak_cache_bytes),
                    case.peak_process_bytes.map_or_else(|| "-".to_owned(), mebibytes),
                    digits(case.error_px_p99),
                    if case.right { String::new() } else { "WRONG".into() },
                ]
            }));
        }
    }
    let Report { clock, size: [width, height], repeats, base_posts, .. } = report;
    table(&head, &rows)
        + &format!(
            "{width} x {height} pixels, {TOLERANCE_PX} px; one thread; time: {clock}, median of \
             {FRAMES} frames x {repeats}; ratios to {base_posts} posts\nlargest ratio over larger \
             terrain: rays {}, picture {} (at most {MOST_RATIO} from {BASE_POSTS} posts on)\n",
            digits(report.worst_ratio_rays),
            digits(report.worst_ratio_picture)
        )
}
