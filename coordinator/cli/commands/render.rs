//! `terrafarm render`: a scene and a flight become pictures.

use crate::farm::Crew;
use crate::input::{self, Scene};
use crate::shot::{self, FRAMES_IN_FLIGHT, Farm, Plan, Report};
use crate::{Outcome, args};
use anyhow::{Context, bail};
use std::path::Path;
use std::sync::Arc;
use terrafarm_coordinator::sink::Encoder;
use terrafarm_terrain::store::StoreReader;

/// Size of the picture unless the scene or the user says otherwise.
const SIZE: (u32, u32) = (1280, 720);
/// Frames per second unless the scene or the user says otherwise.
const FPS: f64 = 30.0;

/// Renders and prints where the result is.
pub fn run(args: &args::Render) -> anyhow::Result<Outcome> {
    let plan = plan(args)?;
    let report = super::runtime()?.block_on(shot::carry_out(plan))?;
    print(&report, args.json)?;
    Ok(report.outcome())
}

fn plan(args: &args::Render) -> anyhow::Result<Plan> {
    let scene = read_scene(&args.scene)?;
    let store = StoreReader::open(&scene.terrain)
        .with_context(|| format!("cannot use the terrain of {}", args.scene.display()))?;
    let store = Arc::new(store);
    let place = input::StorePlace::new(store.clone())?;
    let flight = input::read_flight(&args.flight, &place)?;
    for warning in &flight.warnings {
        eprintln!("terrafarm: warning: {warning}");
    }
    let fps = args.fps.or(scene.fps).unwrap_or(FPS);
    let size = args.size.or(scene.size).unwrap_or(SIZE);
    let times = flight.flight.frame_times(fps).context("cannot cut the flight into frames")?;
    let total = times.len() as u32;
    let (first, end) = args.frames.unwrap_or((0, total));
    if first >= total {
        bail!("--frames {first}..{end}: the flight has {total} frames at {fps} frames/s");
    }
    let end = end.min(total);
    let cameras: Vec<_> = times
        .skip(first as usize)
        .take((end - first) as usize)
        .map(|t| flight.flight.pose_at(t).camera(size))
        .collect();
    let mut quality = scene.quality();
    if let Some(method) = args.method {
        quality.method = method;
        quality.samples_per_side = input::default_samples(method);
    }
    if let Some(samples) = args.samples {
        quality.samples_per_side = samples;
    }
    input::check_quality(quality)?;
    Ok(Plan {
        name: args.output.display().to_string(),
        scene: args.scene.clone(),
        shading: scene.shading(store.index())?,
        quality,
        split: args.split,
        first_frame: first,
        cameras,
        fps,
        frames_in_flight: args.frames_in_flight.unwrap_or(FRAMES_IN_FLIGHT),
        output: args.output.clone(),
        encoder: match args.encoder {
            args::Encoder::Builtin => Encoder::BuiltIn,
            args::Encoder::Ffmpeg => Encoder::Ffmpeg,
        },
        poster: None,
        farm: match &args.coordinator {
            Some(address) => Farm::Remote(address.clone()),
            None => Farm::Local(Crew::fill(args.workers, args.threads)),
        },
        store,
    })
}

/// A scene file, or a bare store with the light that a scene has by default.
fn read_scene(path: &Path) -> anyhow::Result<Scene> {
    if path.extension().is_some_and(|extension| extension == "terrain") {
        return Ok(Scene::of_terrain(path));
    }
    Scene::read(path)
}

/// Says what was made, for people or for scripts.
pub fn print(report: &Report, json: bool) -> anyhow::Result<()> {
    let frames = report.manifest.frames.len();
    if json {
        let summary = serde_json::json!({
            "output": report.finished.output,
            "manifest": report.manifest_path,
            "frames": frames,
            "failed": report.manifest.failed,
            "bytes": report.finished.bytes,
            "seconds": report.seconds,
            "frames_per_s": report.frames_per_s(),
            "workers": report.manifest.workers.len(),
        });
        println!("{}", serde_json::to_string_pretty(&summary).context("cannot print JSON")?);
        return Ok(());
    }
    let [width, height] = report.manifest.size;
    println!(
        "{}: {frames} frames of {width} x {height} in {:.1} s ({:.1} frames/s, {} workers)",
        report.finished.output.display(),
        report.seconds,
        report.frames_per_s(),
        report.manifest.workers.len(),
    );
    println!("{}: SHA-256, time and workers of each frame", report.manifest_path.display());
    if report.manifest.frames.iter().any(|frame| frame.below_ground) {
        println!("warning: the camera was below the ground in some frames; see below_ground there");
    }
    if !report.manifest.failed.is_empty() {
        println!("{} frames failed and are shown in magenta", report.manifest.failed.len());
    }
    Ok(())
}
