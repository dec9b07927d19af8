//! `terrafarm bench core`: speed of the methods on one core, every answer checked.
//!
//! A case is a method, a camera and a terrain. Runs of the methods alternate, so that
//! whatever else the PC does meets all of them; the median of the runs counts. Distances
//! alone are timed, without colour. Each method's answer is compared with the surface over
//! a net of pixels, and every later run with the first, bit for bit: nothing wrong is
//! reported as fast.

use super::clock;
use super::kernel::{self, Depths, Refusal};
use super::land::{Land, Load};
use super::report::{Promise, Spread, digits, median, save, table};
use crate::input::flight;
use crate::place::StorePlace;
use crate::{Outcome, args};
use anyhow::bail;
use glam::DVec3;
use serde::Serialize;
use std::path::Path;
use terrafarm_common::camera::Camera;
use terrafarm_common::flight::Pose;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_common::shading::{Earth, Shading};
use terrafarm_raycast::View;

/// Keyframes that a flight may have to be benched.
const MAX_CAMERAS: usize = 64;
/// Horizontal field of view, degrees, of the cameras of the bench and of flights that do
/// not say theirs.
const HFOV_DEG: f64 = 60.0;
const HEADING_DEG: f64 = 50.0;
/// Where the cameras of the bench look for the highest ground below them, metres around.
const CLEARED_M: f64 = 300.0;

/// Cameras of the bench: name, share of the side of the land at which they stand, height
/// above the highest ground around in metres, pitch and roll in degrees.
const CAMERAS: [(&str, f64, f64, f64, f64); 4] = [
    ("horizon", 0.10, 300.0, -5.0, 0.0),
    ("down30", 0.25, 1500.0, -30.0, 0.0),
    ("down80", 0.50, 3000.0, -80.0, 0.0),
    ("rolled45", 0.25, 1500.0, -30.0, 45.0),
];

/// What is written as JSON. Keys are promises.
#[derive(Debug, Serialize)]
struct Report {
    program: String,
    /// What `mpix_per_cpu_s` divides by.
    clock: &'static str,
    repeats: u32,
    cases: Vec<Case>,
}

/// One method, camera and terrain. Numbers are absent where the method refused.
#[derive(Debug, Serialize)]
struct Case {
    terrain: String,
    /// Posts along the longer side of the terrain.
    posts: u64,
    /// `flat` or `round`.
    earth: &'static str,
    /// Index of the keyframe.
    camera: usize,
    camera_name: String,
    /// Width and height, pixels.
    size: [u32; 2],
    method: &'static str,
    tolerance_px: f64,
    /// `timed`, `wrong` or `refused`.
    outcome: &'static str,
    /// What is wrong, or why it was refused.
    why: Option<String>,
    mpix_per_cpu_s: Option<f64>,
    ns_per_pixel: Option<f64>,
    steps_per_pixel: Option<f64>,
    /// Share of the pixels that the method gave a ray of their own.
    fallback_share: Option<f64>,
    /// Share of the pixels that show ground.
    ground: Option<f64>,
    error_px_p50: Option<f64>,
    error_px_p99: Option<f64>,
    error_px_max: Option<f64>,
    /// Share of the pixels that show another cell than is there, sky counted as one.
    mismatch: Option<f64>,
    /// Memory of the terrain, all levels, per post of level 0.
    bytes_per_post: f64,
}

/// A camera with its name.
struct Stand {
    name: String,
    camera: Camera,
}

/// Runs of one method at one camera.
struct Runs {
    view: View,
    seconds: Vec<f64>,
    first: Option<Result<Depths, Refusal>>,
    /// A later run differed from the first.
    unsteady: bool,
}

/// Measures and prints.
pub fn run(args: &args::bench::BenchCore) -> anyhow::Result<Outcome> {
    let mut report = Report {
        program: format!("terrafarm {}", env!("CARGO_PKG_VERSION")),
        clock: clock::KIND,
        repeats: args.repeats,
        cases: Vec::new(),
    };
    match &args.terrain {
        Some(store) => bench_land(&Land::open(store, Load::Heights)?, args, &mut report)?,
        None => {
            for &posts in &args.posts {
                bench_land(&Land::noise(posts)?, args, &mut report)?;
            }
        }
    }
    print!("{}", text(&report));
    let wrong: Vec<_> = report.cases.iter().filter(|case| case.outcome == "wrong").collect();
    for case in &wrong {
        let why = case.why.as_deref().unwrap_or_default();
        eprintln!("terrafarm: {} is wrong at {}: {why}", case.method, case.camera_name);
    }
    Ok(if wrong.is_empty() { Outcome::Done } else { Outcome::BrokenPromise })
}

fn bench_land(
    land: &Land,
    args: &args::bench::BenchCore,
    report: &mut Report,
) -> anyhow::Result<()> {
    let stands = match &args.flight {
        Some(flight) => keyframes(land, flight, args.size)?,
        None => own_cameras(land, args.size)?,
    };
    let earth = if args.flat { None } else { land.earth() };
    for (number, stand) in stands.iter().enumerate() {
        for runs in alternate(land, stand, earth, args) {
            report.cases.push(judge(land, number, stand, runs));
        }
        // What is done stays known, whatever happens to the rest.
        save(args.json.as_deref(), report)?;
    }
    Ok(())
}

/// The keyframes of a flight as cameras.
fn keyframes(land: &Land, path: &Path, size: (u32, u32)) -> anyhow::Result<Vec<Stand>> {
    let place = StorePlace::new(&land.store)?;
    let file = flight::read(path, &place, HFOV_DEG);
    place.check()?;
    let file = file?;
    let keyframes = file.flight.keyframes();
    if keyframes.len() > MAX_CAMERAS {
        bail!(
            "{}: {} keyframes are too many cameras for a bench; keep {MAX_CAMERAS}",
            path.display(),
            keyframes.len()
        );
    }
    let stand = |(number, keyframe): (usize, &terrafarm_common::flight::Keyframe)| {
        let pose = Pose {
            position: keyframe.position,
            attitude: keyframe.attitude,
            hfov_deg: keyframe.hfov_deg,
        };
        Stand { name: format!("keyframe {number}"), camera: pose.camera(size) }
    };
    Ok(keyframes.iter().enumerate().map(stand).collect())
}

/// The cameras of the bench over a terrain.
fn own_cameras(land: &Land, size: (u32, u32)) -> anyhow::Result<Vec<Stand>> {
    let stands = CAMERAS.iter().map(|&(name, share, above_m, pitch_deg, roll_deg)| {
        let [x, y] = land.at(share);
        let z = land.highest_around([x, y], CLEARED_M)? + above_m;
        let eye = DVec3::new(x, y, z);
        let camera = Camera::from_angles(eye, HEADING_DEG, pitch_deg, roll_deg, HFOV_DEG, size);
        Ok(Stand { name: name.to_owned(), camera })
    });
    stands.collect()
}

/// Times all methods at a camera in turn.
fn alternate(
    land: &Land,
    stand: &Stand,
    earth: Option<Earth>,
    args: &args::bench::BenchCore,
) -> Vec<Runs> {
    let mut all: Vec<Runs> = args
        .methods
        .iter()
        .map(|&method| Runs {
            view: view(stand.camera, earth, method, args.tolerance),
            seconds: Vec::new(),
            first: None,
            unsteady: false,
        })
        .collect();
    for _ in 0..args.repeats {
        for runs in &mut all {
            runs.once(land);
        }
    }
    all
}

fn view(camera: Camera, earth: Option<Earth>, method: Method, tolerance_px: f64) -> View {
    let shading = Shading { earth, ..Shading::default() };
    View { camera, shading, quality: Quality { method, samples_per_side: 1, tolerance_px } }
}

impl Runs {
    fn once(&mut self, land: &Land) {
        let (seconds, answer) = clock::timed(|| kernel::answer(land, &self.view));
        match (&self.first, &answer) {
            (None, _) => self.first = Some(answer),
            (Some(Ok(first)), Ok(again)) => {
                let bits = |depths: &[f32]| depths.iter().map(|d| d.to_bits()).collect::<Vec<_>>();
                self.unsteady |= bits(&first.inverse_depth) != bits(&again.inverse_depth);
            }
            (Some(first), again) => self.unsteady |= first.is_ok() != again.is_ok(),
        }
        self.seconds.push(seconds);
    }
}

/// Compares an answer with the surface and sums the runs up.
fn judge(land: &Land, number: usize, stand: &Stand, mut runs: Runs) -> Case {
    let layer = &land.resident.index().layers[0];
    let quality = runs.view.quality;
    let size = [stand.camera.width, stand.camera.height];
    let mut case = Case {
        terrain: land.name.clone(),
        posts: layer.posts[0].max(layer.posts[1]),
        earth: if runs.view.shading.earth.is_some() { "round" } else { "flat" },
        camera: number,
        camera_name: stand.name.clone(),
        size,
        method: quality.method.name(),
        tolerance_px: quality.tolerance_px,
        outcome: "refused",
        why: None,
        mpix_per_cpu_s: None,
        ns_per_pixel: None,
        steps_per_pixel: None,
        fallback_share: None,
        ground: None,
        error_px_p50: None,
        error_px_p99: None,
        error_px_max: None,
        mismatch: None,
        bytes_per_post: land.bytes_per_post(),
    };
    let Some(first) = runs.first.take() else { return case };
    let frame = Region::whole(size[0], size[1]);
    let checked = first.and_then(|depths| {
        let errors = kernel::errors(land, &runs.view, frame, &depths)?;
        Ok((depths, errors))
    });
    let (depths, errors) = match checked {
        Ok(checked) => checked,
        Err(Refusal(why)) => return Case { why: Some(why), ..case },
    };
    let pixels = f64::from(size[0]) * f64::from(size[1]);
    let seconds = median(&mut runs.seconds);
    let ground = depths.inverse_depth.iter().filter(|&&inverse| inverse > 0.0).count();
    let mismatch = errors.mismatch();
    let spread = Spread::of(errors.error_px);
    let promise = Promise::of(quality.method, quality.tolerance_px);
    case.outcome = "timed";
    if runs.unsteady {
        case.outcome = "wrong";
        case.why = Some("its answer changed from run to run".into());
    } else if !promise.holds(&spread) {
        let Promise { figure, bound_px } = promise;
        let off = digits(promise.value(&spread));
        case.outcome = "wrong";
        case.why = Some(format!("{figure} of the error is {off} px, promised are {bound_px} px"));
    }
    Case {
        mpix_per_cpu_s: Some(pixels / seconds * 1e-6),
        ns_per_pixel: Some(seconds / pixels * 1e9),
        steps_per_pixel: Some(depths.stats.steps as f64 / pixels),
        fallback_share: Some(depths.stats.fallbacks as f64 / pixels),
        ground: Some(ground as f64 / pixels),
        error_px_p50: Some(spread.p50),
        error_px_p99: Some(spread.p99),
        error_px_max: Some(spread.max),
        mismatch: Some(mismatch),
        ..case
    }
}

fn text(report: &Report) -> String {
    let head = [
        "camera",
        "terrain",
        "method",
        "Mpix/s",
        "ns/pixel",
        "steps/pixel",
        "fallbacks %",
        "error px p50",
        "p99",
        "max",
        "mismatch %",
        "bytes/post",
        "",
    ];
    let number = |value: Option<f64>| value.map_or_else(|| "-".to_owned(), digits);
    let rows: Vec<Vec<String>> = report
        .cases
        .iter()
        .map(|case| {
            vec![
                case.camera_name.clone(),
                case.terrain.clone(),
                case.method.to_owned(),
                number(case.mpix_per_cpu_s),
                number(case.ns_per_pixel),
                number(case.steps_per_pixel),
                number(case.fallback_share.map(|share| share * 100.0)),
                number(case.error_px_p50),
                number(case.error_px_p99),
                number(case.error_px_max),
                number(case.mismatch.map(|share| share * 100.0)),
                digits(case.bytes_per_post),
                if case.outcome == "timed" { String::new() } else { case.outcome.to_uppercase() },
            ]
        })
        .collect();
    let time = report.clock;
    table(&head, &rows) + &format!("one thread; time: {time}, median of {}\n", report.repeats)
}
