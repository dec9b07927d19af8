//! `terrafarm render`: a scene and a flight become pictures.

use crate::args::shot::{Casting, Shot};
use crate::farm::Crew;
use crate::input::scene::Scene;
use crate::secret;
use crate::shot::{self, Choice, FRAMES_IN_FLIGHT, Farm, Plan, Report};
use crate::{Outcome, args};
use anyhow::Context;
use std::path::Path;
use terrafarm_common::accuracy::{Spread, Summary};
use terrafarm_common::quality::{Method, Quality};
use terrafarm_coordinator::sink::Encoder;

/// Renders and prints where the result is.
pub fn run(args: &args::Render) -> anyhow::Result<Outcome> {
    let plan = plan(args)?;
    let report = super::runtime()?.block_on(shot::carry_out(plan))?;
    print(&report, args.json)?;
    Ok(report.outcome())
}

fn plan(args: &args::Render) -> anyhow::Result<Plan> {
    Ok(Plan {
        name: args.output.display().to_string(),
        output: args.output.clone(),
        live: args.live,
        encoder: match args.encoder {
            args::Encoder::Builtin => Encoder::BuiltIn,
            args::Encoder::Ffmpeg => Encoder::Ffmpeg,
        },
        farm: match farm_of(args) {
            Some(address) => Farm::Remote(address, secret::to_connect(&args.security)?),
            None => Farm::Local(Crew::fill(args.workers, args.threads)),
        },
        ..args.shot.plan()?
    })
}

impl Shot {
    /// Reads the scene and the flight: what is typed goes before what the scene says.
    pub fn plan(&self) -> anyhow::Result<Plan> {
        let scene = read_scene(&self.scene)?;
        let mut quality = self.casting.over(scene.quality);
        if let Some(samples) = self.samples {
            quality.samples_per_side = samples;
        }
        let choice = Choice {
            scene: &self.scene,
            flight: &self.flight,
            size: self.size.unwrap_or(scene.size),
            fps: self.fps.unwrap_or(scene.fps),
            frames: self.frames,
        };
        Ok(Plan {
            quality,
            check: self.casting.check,
            split: self.split,
            frames_in_flight: self.frames_in_flight.unwrap_or(FRAMES_IN_FLIGHT),
            priority: self.priority,
            ..Plan::read(&scene, &choice)?
        })
    }
}

/// The farm to render on: the environment names one for those who do not say that they
/// want local workers.
fn farm_of(args: &args::Render) -> Option<String> {
    let wants_local = args.workers.is_some() || args.threads.is_some();
    let usual = || std::env::var("TERRAFARM_COORDINATOR").ok().filter(|_| !wants_local);
    args.coordinator.clone().or_else(usual)
}

impl Casting {
    /// What the scene says, but for what the user says.
    pub fn over(&self, mut quality: Quality) -> Quality {
        if let Some(method) = self.method {
            let samples_per_side = if method == Method::Reference { 8 } else { 1 };
            quality = Quality { method, samples_per_side, ..quality };
        }
        if let Some(tolerance_px) = self.tolerance {
            quality.tolerance_px = tolerance_px;
        }
        quality
    }
}

fn check_json(errors: &Summary) -> serde_json::Value {
    let spread = |spread: Spread| serde_json::json!({"p50": spread.p50, "p99": spread.p99, "max": spread.max});
    serde_json::json!({
        "checked_pixels": errors.samples(),
        "error_px": errors.error_px().map(spread),
        "depth_error_m": errors.depth_m().map(spread),
        "mismatch": errors.mismatch(),
    })
}

fn print_check(errors: &Summary) {
    let Some(error) = errors.error_px() else {
        print_line!("checked: no pixel; a larger share would choose some");
        return;
    };
    print_line!(
        "checked {} pixels against exact: error p50 {:.3}, p99 {:.3}, max {:.3} pixels",
        errors.samples(),
        error.p50,
        error.p99,
        error.max
    );
    let other = 100.0 * errors.mismatch();
    match errors.depth_m() {
        Some(depth) => print_line!(
            "  depth p50 {:.3}, p99 {:.3}, max {:.3} m; {other:.2} % see another cell or sky",
            depth.p50,
            depth.p99,
            depth.max
        ),
        None => print_line!(
            "  no depth to compare; {other:.2} % see ground in place of sky or sky in place of ground"
        ),
    }
}

/// A scene file, or a bare store with the light that a scene has by default.
fn read_scene(path: &Path) -> anyhow::Result<Scene> {
    if path.extension().is_some_and(|extension| extension == "terrain") {
        // What a scene file of this one line would say.
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let line = format!("terrain = {}\n[sun]\n", toml::Value::String(name.into_owned()));
        return Ok(Scene::parse(path, &line)?);
    }
    Ok(Scene::read(path)?)
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
            "fallbacks": report.manifest.fallbacks,
            "fallback_share": report.manifest.fallback_share,
            "coarser_pixels": report.manifest.coarser_pixels,
            "check": report.errors.as_ref().map(check_json),
        });
        print_line!("{}", serde_json::to_string_pretty(&summary).context("cannot print JSON")?);
        return Ok(());
    }
    let [width, height] = report.manifest.size;
    print_line!(
        "{}: {frames} frames of {width} x {height} in {:.1} s ({:.1} frames/s, {} workers)",
        report.finished.output.display(),
        report.seconds,
        report.frames_per_s(),
        report.manifest.workers.len(),
    );
    if let Some(errors) = &report.errors {
        print_check(errors);
    }
    if report.manifest.fallbacks > 0 {
        print_line!(
            "{:.2} % of the pixels were not done the method's own way but by rays of their own",
            100.0 * report.manifest.fallback_share
        );
    }
    let coarser = report.manifest.coarser_pixels;
    if coarser > 0 {
        let all = f64::from(width) * f64::from(height) * frames as f64;
        print_line!(
            "{:.2} % of the pixels show coarser terrain: the finer had not come yet",
            100.0 * coarser as f64 / all
        );
    }
    print_line!("{}: SHA-256, time and workers of each frame", report.manifest_path.display());
    if report.manifest.frames.iter().any(|frame| frame.below_ground) {
        print_line!(
            "warning: the camera was below the ground in some frames; see below_ground there"
        );
    }
    if !report.manifest.failed.is_empty() {
        print_line!("{} frames failed and are shown in magenta", report.manifest.failed.len());
    }
    Ok(())
}
