//! `terrafarm bench speed-accuracy`: what a smaller error costs.
//!
//! A point is a method with a setting, seen through a camera: milliseconds for a whole
//! shaded picture on one core against two errors. *Screen error* is the distance on the
//! picture between what is shown and the surface, its 99th percentile over a net of pixels.
//! *Image error* is the root mean square difference in 8-bit levels to the `reference` with
//! 8 x 8 samples, over patches spread over the picture. Patches stand for the picture
//! because that reference would take hours; the `reference` itself is timed on them, too,
//! and its time scaled to the picture, since none of its rays helps another.
//!
//! A point is dominated by an error if another one at the same camera is no worse in time
//! and in this error, and better in one of them.

use super::chart::{self, Curve, Spot};
use super::clock;
use super::kernel::{self, Refusal};
use super::land::{Land, Load};
use super::report::{Promise, Spread, digits, median, save, table};
use crate::{Outcome, args};
use glam::DVec3;
use serde::Serialize;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_common::shading::{Haze, Shading, Sky, Sun};
use terrafarm_raycast::View;
use terrafarm_synth::SynthSpec;

/// Tolerances, pixels.
const TOLERANCES_PX: [f64; 7] = [0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0];
/// Samples along a side of a pixel of the measure of truth.
const TRUTH_SAMPLES: u32 = 8;
/// Cameras: name, share of the side of the land, height above the highest ground around
/// in metres, pitch in degrees.
const CAMERAS: [(&str, f64, f64, f64); 4] = [
    ("grazing", 0.15, 60.0, -2.0),
    ("oblique", 0.25, 600.0, -25.0),
    ("far", 0.08, 1800.0, -10.0),
    ("down", 0.5, 2500.0, -80.0),
];
const HEADING_DEG: f64 = 45.0;
const HFOV_DEG: f64 = 60.0;
const CLEARED_M: f64 = 200.0;

/// How much is done.
struct Extent {
    size: (u32, u32),
    synth: SynthSpec,
    /// Patches along x and y, and their side in pixels.
    patches: ([u32; 2], u32),
    repeats: u32,
}

const FULL: Extent = Extent {
    size: (1920, 1080),
    synth: SynthSpec { posts: 2049, spacing_m: 15.0, seed: 3, photo_scale: 2 },
    patches: ([6, 4], 16),
    repeats: 3,
};
const SHORT: Extent = Extent {
    size: (320, 180),
    synth: SynthSpec { posts: 257, spacing_m: 60.0, seed: 3, photo_scale: 1 },
    patches: ([2, 2], 8),
    repeats: 1,
};

/// A method and how it is set.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Setting(Quality);

impl Setting {
    /// All that are compared, in the order of the curves.
    fn all() -> Vec<Setting> {
        let tolerant = [Method::Lod, Method::Column, Method::Frustum, Method::Voxel];
        let sampled = |method, samples_per_side| {
            Setting(Quality { method, samples_per_side, ..Quality::default() })
        };
        let tolerant = tolerant.into_iter().flat_map(|method| {
            TOLERANCES_PX
                .map(|tolerance_px| Setting(Quality { method, samples_per_side: 1, tolerance_px }))
        });
        tolerant
            .chain([1, 2].map(|samples| sampled(Method::Exact, samples)))
            .chain([1, 4, TRUTH_SAMPLES].map(|samples| sampled(Method::Reference, samples)))
            .collect()
    }

    fn has_tolerance(&self) -> bool {
        !matches!(self.0.method, Method::Exact | Method::Reference)
    }

    fn name(&self) -> String {
        if self.has_tolerance() {
            return format!("{} px", self.0.tolerance_px);
        }
        match self.0.samples_per_side {
            1 => "1 sample".into(),
            side => format!("{} samples", side * side),
        }
    }
}

/// What is written as JSON. Keys are promises.
#[derive(Debug, Serialize)]
struct Report {
    program: String,
    clock: &'static str,
    size: [u32; 2],
    points: Vec<Point>,
    refused: Vec<Refused>,
}

#[derive(Debug, Clone, Serialize)]
struct Point {
    terrain: String,
    camera: String,
    method: &'static str,
    setting: String,
    ms_per_frame: f64,
    error_px_p50: f64,
    error_px_p99: f64,
    error_px_max: f64,
    /// Root mean square, 8-bit levels.
    image_error: f64,
    /// Share of the pixels that the method gave a ray of their own.
    fallback_share: f64,
    /// Another point is better by time and screen error.
    dominated_px: bool,
    /// Another point is better by time and image error.
    dominated_image: bool,
    /// Both.
    dominated: bool,
    /// The screen error is within what the method promises.
    kept: bool,
}

#[derive(Debug, Serialize)]
struct Refused {
    terrain: String,
    camera: String,
    method: &'static str,
    setting: String,
    why: String,
}

/// Measures, prints and draws.
pub fn run(args: &args::bench::BenchSpeedAccuracy) -> anyhow::Result<Outcome> {
    let extent = if args.short { SHORT } else { FULL };
    let mut report = Report {
        program: format!("terrafarm {}", env!("CARGO_PKG_VERSION")),
        clock: clock::KIND,
        size: [extent.size.0, extent.size.1],
        points: Vec::new(),
        refused: Vec::new(),
    };
    bench_land(&Land::synth(extent.synth)?, &extent, args, &mut report)?;
    for path in &args.terrains {
        bench_land(&Land::open(path, Load::All)?, &extent, args, &mut report)?;
    }
    let mut means = means(&report);
    mark_dominated(&mut means);
    print!("{}", text(&report, &means));
    if args.svg.is_some() || args.png.is_some() {
        let drawing = chart::draw(&title(&report), &panels(&means));
        chart::save(&drawing, args.svg.as_deref(), args.png.as_deref())?;
    }
    let broken: Vec<_> = report.points.iter().filter(|point| !point.kept).collect();
    for point in &broken {
        eprintln!(
            "terrafarm: {} at {} is off by {} px at {} over {}: more than it promises",
            point.method,
            point.setting,
            digits(point.error_px_p99),
            point.camera,
            point.terrain
        );
    }
    Ok(if broken.is_empty() { Outcome::Done } else { Outcome::BrokenPromise })
}

fn bench_land(
    land: &Land,
    extent: &Extent,
    args: &args::bench::BenchSpeedAccuracy,
    report: &mut Report,
) -> anyhow::Result<()> {
    for &(name, share, above_m, pitch_deg) in &CAMERAS {
        let [x, y] = land.at(share);
        let z = land.highest_around([x, y], CLEARED_M)? + above_m;
        let eye = DVec3::new(x, y, z);
        let camera = Camera::from_angles(eye, HEADING_DEG, pitch_deg, 0.0, HFOV_DEG, extent.size);
        let from = report.points.len();
        bench_camera(land, name, camera, extent, report)?;
        mark_dominated(&mut report.points[from..]);
        // What is done stays known, whatever happens to the rest.
        save(args.json.as_deref(), report)?;
    }
    Ok(())
}

fn bench_camera(
    land: &Land,
    name: &str,
    camera: Camera,
    extent: &Extent,
    report: &mut Report,
) -> anyhow::Result<()> {
    let patches = patches(extent);
    let view = |quality| View { camera, shading: shading(land), quality };
    let truth = Quality {
        method: Method::Reference,
        samples_per_side: TRUTH_SAMPLES,
        ..Quality::default()
    };
    let truth = pictures(land, &view(truth), &patches)
        .map_err(|Refusal(why)| anyhow::anyhow!("{}, camera {name}: {why}", land.name))?;
    for setting in Setting::all() {
        let (terrain, camera) = (land.name.clone(), name.to_owned());
        let (method, label) = (setting.0.method.name(), setting.name());
        match measure(land, &view(setting.0), &patches, &truth, extent.repeats) {
            Ok(measured) => {
                let promise = Promise::of(setting.0.method, setting.0.tolerance_px);
                let Spread { p50, p99, max } = measured.screen;
                report.points.push(Point {
                    terrain,
                    camera,
                    method,
                    setting: label,
                    ms_per_frame: measured.seconds * 1e3,
                    error_px_p50: p50,
                    error_px_p99: p99,
                    error_px_max: max,
                    image_error: measured.image,
                    fallback_share: measured.fallbacks,
                    dominated_px: false,
                    dominated_image: false,
                    dominated: false,
                    kept: promise.holds(&measured.screen),
                });
            }
            Err(Refusal(why)) => {
                report.refused.push(Refused { terrain, camera, method, setting: label, why });
            }
        }
    }
    Ok(())
}

/// Sun, haze and sky as in an ordinary scene.
fn shading(land: &Land) -> Shading {
    let color = Sky::default().horizon;
    Shading {
        sun: Some(Sun::at(315.0, 35.0, 0.35, 0.5)),
        haze: Some(Haze { visibility_m: 60_000.0, scale_height_m: 0.0, color }),
        sky: Sky::default(),
        earth: land.earth(),
        below_ground: [0.03, 0.02, 0.02],
        bare_ground: None,
    }
}

/// Squares spread evenly over the picture.
fn patches(extent: &Extent) -> Vec<Region> {
    let ([columns, rows], side) = extent.patches;
    let (width, height) = extent.size;
    let place =
        |number: u32, count: u32, length: u32| (2 * number + 1) * length / (2 * count) - side / 2;
    let spots = (0..rows).flat_map(|row| (0..columns).map(move |column| (column, row)));
    spots
        .map(|(column, row)| Region {
            x: place(column, columns, width),
            y: place(row, rows, height),
            width: side,
            height: side,
        })
        .collect()
}

/// What a setting costs and how far it is off.
struct Measured {
    seconds: f64,
    screen: Spread,
    image: f64,
    /// Share of the pixels.
    fallbacks: f64,
}

fn measure(
    land: &Land,
    view: &View,
    patches: &[Region],
    truth: &[u8],
    repeats: u32,
) -> Result<Measured, Refusal> {
    let frame = Region::whole(view.camera.width, view.camera.height);
    let whole = [frame];
    // No ray of the reference helps another: patches tell what the picture costs.
    let is_slow = view.quality.method == Method::Reference;
    let timed = if is_slow { patches } else { &whole };
    let (mut errors, mut fallbacks) = (Vec::new(), 0);
    for &region in timed {
        let answer = kernel::answer_in(land, view, region)?;
        fallbacks += answer.stats.fallbacks;
        errors.extend(kernel::errors(land, view, region, &answer)?.error_px);
    }
    let mut times = Vec::new();
    for _ in 0..repeats {
        let (seconds, picture) = clock::timed(|| pictures(land, view, timed));
        picture?;
        times.push(seconds);
    }
    let area: u64 = timed.iter().map(Region::area).sum();
    let shown = pictures(land, view, patches)?;
    let squares: f64 =
        shown.iter().zip(truth).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    Ok(Measured {
        seconds: median(&mut times) * frame.area() as f64 / area.max(1) as f64,
        screen: Spread::of(errors),
        image: (squares / shown.len().max(1) as f64).sqrt(),
        fallbacks: fallbacks as f64 / area.max(1) as f64,
    })
}

/// The pixels of some regions, one after the other.
fn pictures(land: &Land, view: &View, regions: &[Region]) -> Result<Vec<u8>, Refusal> {
    let mut pixels = Vec::new();
    for &region in regions {
        pixels.extend(kernel::picture(land, view, region)?);
    }
    Ok(pixels)
}

/// Marks the points that others of the same list beat.
fn mark_dominated(points: &mut [Point]) {
    let beats = |a: [f64; 2], b: [f64; 2]| a[0] <= b[0] && a[1] <= b[1] && a != b;
    let dominated = |error: fn(&Point) -> f64| -> Vec<bool> {
        let place = |point: &Point| [point.ms_per_frame, error(point)];
        let is = |point| points.iter().any(|other| beats(place(other), place(point)));
        points.iter().map(is).collect()
    };
    let by_px = dominated(|point| point.error_px_p99.max(chart::SCREEN_FLOOR_PX));
    let by_image = dominated(|point| point.image_error.max(chart::IMAGE_FLOOR));
    for ((point, by_px), by_image) in points.iter_mut().zip(by_px).zip(by_image) {
        point.dominated_px = by_px;
        point.dominated_image = by_image;
        point.dominated = by_px && by_image;
    }
}

/// One point a setting: the mean time over all cameras, the largest screen error and the
/// mean image error. Settings that were refused at a camera have none.
fn means(report: &Report) -> Vec<Point> {
    let mut means = Vec::new();
    for setting in Setting::all() {
        let (method, label) = (setting.0.method.name(), setting.name());
        if report.refused.iter().any(|r| r.method == method && r.setting == label) {
            continue;
        }
        let points: Vec<&Point> = report
            .points
            .iter()
            .filter(|point| point.method == method && point.setting == label)
            .collect();
        let Some(first) = points.first() else { continue };
        let mean = |value: fn(&Point) -> f64| {
            points.iter().map(|point| value(point)).sum::<f64>() / points.len() as f64
        };
        let worst =
            |value: fn(&Point) -> f64| points.iter().map(|point| value(point)).fold(0.0, f64::max);
        means.push(Point {
            terrain: "all".into(),
            camera: "all".into(),
            ms_per_frame: mean(|point| point.ms_per_frame),
            error_px_p50: worst(|point| point.error_px_p50),
            error_px_p99: worst(|point| point.error_px_p99),
            error_px_max: worst(|point| point.error_px_max),
            image_error: mean(|point| point.image_error),
            fallback_share: mean(|point| point.fallback_share),
            kept: points.iter().all(|point| point.kept),
            ..(*first).clone()
        });
    }
    means
}

fn title(report: &Report) -> chart::Title {
    let mut terrains: Vec<&str> = report.points.iter().map(|p| p.terrain.as_str()).collect();
    terrains.dedup();
    let base = |name: &str| {
        let file = std::path::Path::new(name).file_stem();
        file.map_or_else(|| name.to_owned(), |stem| stem.to_string_lossy().into_owned())
    };
    let terrains: Vec<String> = terrains.into_iter().map(base).collect();
    let [width, height] = report.size;
    chart::Title {
        main: "What accuracy costs: time per frame against error".into(),
        sub: format!(
            "{width} x {height} pixels, one core, mean of {} cameras over {}; filled: nothing is \
             both faster and more accurate",
            CAMERAS.len(),
            terrains.join(", ")
        ),
    }
}

/// The two panels of the chart.
fn panels(means: &[Point]) -> [chart::Panel; 2] {
    let curves = |error: fn(&Point) -> f64, dominated: fn(&Point) -> bool| {
        let mut curves: Vec<Curve> = Vec::new();
        for point in means {
            let spot = Spot {
                ms: point.ms_per_frame,
                error: error(point),
                dominated: dominated(point),
                label: point.setting.clone(),
            };
            match curves.iter_mut().find(|curve| curve.method == point.method) {
                Some(curve) => curve.spots.push(spot),
                None => curves.push(Curve { method: point.method, spots: vec![spot] }),
            }
        }
        curves
    };
    [
        chart::Panel {
            axis: "screen error, 99th percentile, worst camera (pixels)",
            floor: chart::SCREEN_FLOOR_PX,
            curves: curves(|point| point.error_px_p99, |point| point.dominated_px),
        },
        chart::Panel {
            axis: "image error against 64 samples, RMS (8-bit levels)",
            floor: chart::IMAGE_FLOOR,
            curves: curves(|point| point.image_error, |point| point.dominated_image),
        },
    ]
}

fn text(report: &Report, means: &[Point]) -> String {
    let head =
        ["method", "setting", "ms/frame", "p99 px", "max px", "RMS levels", "fallbacks %", ""];
    let rows: Vec<Vec<String>> = means
        .iter()
        .map(|point| {
            vec![
                point.method.to_owned(),
                point.setting.clone(),
                digits(point.ms_per_frame),
                digits(point.error_px_p99),
                digits(point.error_px_max),
                digits(point.image_error),
                digits(100.0 * point.fallback_share),
                match (point.dominated_px, point.dominated_image) {
                    (false, false) => "best by both errors".into(),
                    (false, true) => "best by screen error".into(),
                    (true, false) => "best by image error".into(),
                    (true, true) => "dominated".into(),
                },
            ]
        })
        .collect();
    let mut text = table(&head, &rows);
    let named = |dominated: bool| {
        let mut names: Vec<&str> = Vec::new();
        for method in Method::ALL.map(Method::name) {
            let mut of = means.iter().filter(|point| point.method == method).peekable();
            if of.peek().is_some() && of.all(|point| point.dominated) == dominated {
                names.push(method);
            }
        }
        if names.is_empty() { "none".to_owned() } else { names.join(", ") }
    };
    text.push_str(&format!("on the Pareto front with some setting: {}\n", named(false)));
    text.push_str(&format!("dominated with every setting: {}\n", named(true)));
    // Mostly it is not the setting that is refused.
    let mut refusals: Vec<(&Refused, Vec<&str>)> = Vec::new();
    for refused in &report.refused {
        let alike = |other: &Refused| {
            let parts =
                |r: &Refused| (r.method, r.camera.clone(), r.terrain.clone(), r.why.clone());
            parts(other) == parts(refused)
        };
        match refusals.iter_mut().find(|(other, _)| alike(other)) {
            Some((_, settings)) => settings.push(&refused.setting),
            None => refusals.push((refused, vec![&refused.setting])),
        }
    }
    for (Refused { method, camera, terrain, why, .. }, settings) in refusals {
        let settings = settings.join(", ");
        text.push_str(&format!("{method} at {settings} refused {camera} over {terrain}: {why}\n"));
    }
    text
}
