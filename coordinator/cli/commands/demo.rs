//! `terrafarm demo`: everything at once, with nothing but this program.

use super::render;
use crate::farm::Crew;
use crate::input::scene::Scene;
use crate::shot::{self, Choice, Farm, Plan};
use crate::{Outcome, args};
use anyhow::Context;
use std::fs;
use std::path::Path;
use terrafarm_synth::SynthSpec;

/// Terrain of the demo: the seed was chosen for its lake and its ridge.
pub const TERRAIN: SynthSpec = SynthSpec { posts: 2049, spacing_m: 15.0, seed: 3, photo_scale: 2 };
/// The light of the demo.
pub const SCENE: &str = include_str!("../../../deploy/scenes/demo.toml");
/// The flight of the demo.
pub const FLIGHT: &str = include_str!("../../../deploy/scenes/demo.csv");
/// Size of the picture, pixels.
const SIZE: (u32, u32) = (1280, 720);
/// Frames per second.
pub const FPS: f64 = 24.0;
/// The frame kept as a picture.
const POSTER: u32 = 20;

/// Makes terrain, renders a flight, leaves a video.
pub fn run(args: &args::Demo) -> anyhow::Result<Outcome> {
    let folder = &args.output;
    fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))?;
    let spec = SynthSpec { seed: args.seed.unwrap_or(TERRAIN.seed), ..TERRAIN };
    let terrain = folder.join("demo.terrain");
    super::terrain::write_synth(&terrain, spec, true)?;
    let scene_path = write(folder, "demo.toml", SCENE)?;
    let flight_path = write(folder, "demo.csv", FLIGHT)?;

    let scene = Scene::read(&scene_path)?;
    let choice =
        Choice { scene: &scene_path, flight: &flight_path, size: SIZE, fps: FPS, frames: None };
    let plan = Plan {
        name: "demo".into(),
        output: folder.join("demo.mp4"),
        poster: Some((POSTER, folder.join("poster.png"))),
        quality: args.casting.over(scene.quality),
        check: args.casting.check,
        farm: Farm::Local(Crew::fill(Some(args.workers), None)),
        ..Plan::read(&scene, &choice)?
    };
    let report = super::runtime()?.block_on(shot::carry_out(plan))?;
    render::print(&report, args.json)?;
    if !args.json {
        print_next(folder);
    }
    Ok(report.outcome())
}

fn write(folder: &Path, name: &str, text: &str) -> anyhow::Result<std::path::PathBuf> {
    let path = folder.join(name);
    fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))?;
    Ok(path)
}

fn print_next(folder: &Path) {
    let folder = folder.display();
    print_line!("{folder}/poster.png: a frame of it");
    print_line!();
    print_line!("Next:");
    print_line!("  open {folder}/demo.mp4 in a browser");
    print_line!("  edit {folder}/demo.csv (the flight) or {folder}/demo.toml (the light), then");
    print_line!(
        "    terrafarm render {folder}/demo.toml --flight {folder}/demo.csv -o {folder}/mine.mp4"
    );
    print_line!("  bring your own terrain:");
    print_line!(
        "    terrafarm terrain import YOUR_DEM.tif --photo YOUR_PHOTO.tif -o yours.terrain"
    );
}
