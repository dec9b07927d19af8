//! `terrafarm terrain ...`: stores made, inspected and sampled.

mod sample;

use crate::args::terrain::{HeightUnit, Import, PngEncoding, Synth, Terrain};
use crate::{Outcome, progress};
use anyhow::{Context, bail};
use std::cell::RefCell;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use terrafarm_common::camera::MAX_SIDE_PX;
use terrafarm_common::image::Rgb8;
use terrafarm_coordinator::sink::poster;
use terrafarm_import::{ImportRequest, ImportSettings, ImportSummary, Stage};
use terrafarm_raster::info::Content;
use terrafarm_raster::{OpenOptions, options};
use terrafarm_synth::SynthSpec;
use terrafarm_terrain::hillshade;
use terrafarm_terrain::info::{StoreInfo, summary};
use terrafarm_terrain::layout::{LayerKind, PostWindow};
use terrafarm_terrain::store::StoreReader;

/// Carries out one of the terrain commands.
pub fn run(command: Terrain) -> anyhow::Result<Outcome> {
    match command {
        Terrain::Import(args) => import(&args)?,
        Terrain::Info { store, json } => info(&store, json)?,
        Terrain::Sample { store, points } => sample::run(&store, &points)?,
        Terrain::Synth(args) => synth(&args)?,
        Terrain::Hillshade { store, output, azimuth, altitude } => {
            write_hillshade(&store, &output, azimuth, altitude)?;
        }
    }
    Ok(Outcome::Done)
}

fn import(args: &Import) -> anyhow::Result<()> {
    refuse_existing(&args.output, args.force)?;
    let elevation_options = OpenOptions {
        content: Some(Content::Heights),
        png_encoding: match args.png_encoding {
            PngEncoding::Auto => options::PngEncoding::Auto,
            PngEncoding::TerrainRgb => options::PngEncoding::TerrainRgb,
            PngEncoding::Terrarium => options::PngEncoding::Terrarium,
            PngEncoding::SrtmRgba => options::PngEncoding::SrtmRgba,
            PngEncoding::Grey16 => options::PngEncoding::Grey16,
        },
        unit: args.height_unit.map(|unit| match unit {
            HeightUnit::Metres => options::HeightUnit::Metre,
            HeightUnit::Feet => options::HeightUnit::Foot,
            HeightUnit::UsFeet => options::HeightUnit::UsSurveyFoot,
        }),
        web_tile: args.tile.as_deref().map(parse_tile).transpose()?,
        ..OpenOptions::default()
    };
    let photo_options = OpenOptions {
        content: Some(Content::Photo),
        collar: args.collar.as_deref().map(parse_color).transpose()?,
        ..OpenOptions::default()
    };
    let request = ImportRequest {
        elevation: args.elevation.clone(),
        insets: args.insets.clone(),
        photos: args.photos.clone(),
        output: args.output.clone(),
        settings: ImportSettings {
            crs: args.crs.clone(),
            source_crs: args.source_crs.clone(),
            spacing_m: args.spacing,
            fill_voids: args.fill_voids,
            elevation_options,
            photo_options,
        },
    };
    // One bar a stage.
    let shown: RefCell<Option<(Stage, indicatif::ProgressBar)>> = RefCell::new(None);
    let show = |now: terrafarm_import::Progress| {
        let mut shown = shown.borrow_mut();
        if shown.as_ref().is_none_or(|(stage, _)| *stage != now.stage) {
            if let Some((_, bar)) = shown.take() {
                bar.finish_and_clear();
            }
            *shown = Some((now.stage, progress::bar(&now.stage.to_string(), now.total)));
        }
        if let Some((_, bar)) = shown.as_ref() {
            bar.set_position(now.done);
        }
    };
    let cancel = cancel_on_interrupt()?;
    let done = terrafarm_import::import(&request, &show, &cancel)?;
    if let Some((_, bar)) = shown.take() {
        bar.finish_and_clear();
    }
    print_import(args, &done)
}

fn print_import(args: &Import, done: &ImportSummary) -> anyhow::Result<()> {
    if args.json {
        let reader = StoreReader::open(&args.output)?;
        return print_json(&summary(&reader));
    }
    for line in &done.report.inputs {
        print_line!("{line}");
    }
    for warning in &done.report.warnings {
        eprintln!("terrafarm: warning: {warning}");
    }
    if done.filled_posts > 0 {
        print_line!("{} void posts filled", done.filled_posts);
    }
    let error = match done.report.max_resampling_error_m {
        0.0 => "every post untouched".to_owned(),
        error => format!(
            "largest resampling error {error:.2} m, rms {:.2} m (a smaller --spacing makes it less)",
            done.report.rms_resampling_error_m
        ),
    };
    print_line!("{}: {}, {error}", args.output.display(), done.crs);
    print_line!(
        "look at it:  terrafarm terrain hillshade {0} -o hillshade.png",
        args.output.display()
    );
    Ok(())
}

fn info(store: &Path, json: bool) -> anyhow::Result<()> {
    let reader = StoreReader::open(store)?;
    let info: StoreInfo = summary(&reader);
    if json {
        return print_json(&info);
    }
    print_info(&info);
    Ok(())
}

fn print_info(info: &StoreInfo) {
    const MIB: f64 = 1048576.0;
    let [[x0, y0], [x1, y1]] = [info.min, info.max];
    print_line!("crs           {}", info.crs);
    print_line!(
        "extent        {x0:.2} {y0:.2} to {x1:.2} {y1:.2} ({:.1} x {:.1} km)",
        (x1 - x0) / 1e3,
        (y1 - y0) / 1e3
    );
    print_line!("height datum  {:?}", info.height_datum);
    match info.height_range_m {
        Some([low, high]) => print_line!("heights       {low} to {high} m"),
        None => print_line!("heights       none: every post is void"),
    }
    print_line!("voids         {} of {} posts", info.void_posts, info.height_posts);
    print_line!(
        "memory        {:.2} bytes per post of heights, all levels and maxima",
        info.bytes_per_post
    );
    for (number, layer) in info.layers.iter().enumerate() {
        let tiles: u64 = layer.levels.iter().map(|level| level.filled_tiles).sum();
        print_line!(
            "layer {number}       {:?}: {} x {} posts, {} x {} m, {} levels, {tiles} tiles, bytes per post {:.2} on disk, {:.2} in memory",
            layer.kind,
            layer.posts[0],
            layer.posts[1],
            layer.spacing_m[0],
            layer.spacing_m[1],
            layer.levels.len(),
            layer.disk_bytes_per_post,
            layer.memory_bytes_per_post,
        );
    }
    let report = &info.report;
    print_line!(
        "resampling    largest error {:.3} m, rms {:.3} m",
        report.max_resampling_error_m,
        report.rms_resampling_error_m
    );
    for input in &report.inputs {
        print_line!("input         {input}");
    }
    for warning in &report.warnings {
        print_line!("warning       {warning}");
    }
    print_line!("made by       {}", report.made_by);
    print_line!("file          {:.1} MiB, index {}", info.file_bytes as f64 / MIB, info.hash);
}

fn synth(args: &Synth) -> anyhow::Result<()> {
    let spec = SynthSpec {
        posts: args.size,
        spacing_m: args.spacing,
        seed: args.seed,
        photo_scale: args.photo_scale,
    };
    write_synth(&args.output, spec, args.force)?;
    let reader = StoreReader::open(&args.output)?;
    if args.json {
        return print_json(&summary(&reader));
    }
    print_line!(
        "{}: {} x {} posts, {} m apart, seed {}",
        args.output.display(),
        args.size,
        args.size,
        args.spacing,
        args.seed
    );
    Ok(())
}

/// Makes procedural terrain with progress bars.
pub fn write_synth(path: &Path, spec: SynthSpec, force: bool) -> anyhow::Result<()> {
    refuse_existing(path, force)?;
    let bar = progress::bar("terrain", 1000);
    let show = |share: f32| bar.set_position((share * 1000.0) as u64);
    let cancel = cancel_on_interrupt()?;
    terrafarm_synth::write_store(spec, path, &show, &cancel)?;
    bar.finish_and_clear();
    Ok(())
}

fn write_hillshade(store: &Path, output: &Path, azimuth: f64, altitude: f64) -> anyhow::Result<()> {
    if !output.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("png")) {
        bail!("{}: a hillshade is a PNG; choose a name that ends in .png", output.display());
    }
    let reader = StoreReader::open(store)?;
    let (number, layer) =
        reader.index().layers_of(LayerKind::Height).next().context("the store has no heights")?;
    let [width, height] = layer.posts;
    if layer.posts.iter().any(|&side| side > u64::from(MAX_SIDE_PX)) {
        bail!("{width} x {height} posts make too large a picture; at most {MAX_SIDE_PX} a side");
    }
    let window = PostWindow { i0: 0, j0: 0, width: width as usize, height: height as usize };
    let grey = hillshade::hillshade(&reader, number as u16, window, azimuth, altitude)?;
    let pixels = grey.iter().flat_map(|&grey| [grey; 3]).collect();
    let picture = Rgb8::from_pixels(width as u32, height as u32, pixels)
        .context("the hillshade has the wrong number of posts")?;
    poster::save(output, &picture)?;
    print_line!("{}: {} x {}", output.display(), picture.width(), picture.height());
    Ok(())
}

fn refuse_existing(path: &Path, force: bool) -> anyhow::Result<()> {
    if path.exists() && !force {
        bail!(
            "{} exists already; choose another name, or say --force to replace it",
            path.display()
        );
    }
    Ok(())
}

/// Set when the user presses Ctrl-C: long work stops at its next step and leaves nothing.
fn cancel_on_interrupt() -> anyhow::Result<Arc<AtomicBool>> {
    let cancel = Arc::new(AtomicBool::new(false));
    let raise = cancel.clone();
    std::thread::Builder::new()
        .name("interrupt".into())
        .spawn(move || {
            let Ok(runtime) = tokio::runtime::Builder::new_current_thread().enable_all().build()
            else {
                return;
            };
            runtime.block_on(async { super::stop_signal().await });
            raise.store(true, Ordering::Relaxed);
        })
        .context("cannot start a thread")?;
    Ok(cancel)
}

fn print_json(value: &impl serde::Serialize) -> anyhow::Result<()> {
    print_line!("{}", serde_json::to_string_pretty(value).context("cannot print JSON")?);
    Ok(())
}

fn parse_tile(text: &str) -> anyhow::Result<(u8, u32, u32)> {
    let parts: Vec<_> = text.split('/').collect();
    let parsed = match parts[..] {
        [z, x, y] => z.parse().ok().zip(x.parse().ok()).zip(y.parse().ok()),
        _ => None,
    };
    match parsed {
        Some(((z, x), y)) if z <= 24 && x < 1u32 << z && y < 1u32 << z => Ok((z, x, y)),
        _ => bail!("--tile {text}: write Z/X/Y as in a map's address, such as 10/906/404"),
    }
}

fn parse_color(text: &str) -> anyhow::Result<[u8; 3]> {
    let digits = text.trim_start_matches('#');
    let parsed = u32::from_str_radix(digits, 16).ok().filter(|_| digits.len() == 6);
    let Some(value) = parsed else {
        bail!("--collar {text}: write a colour as RRGGBB, such as ffffff")
    };
    let [_, red, green, blue] = value.to_be_bytes();
    Ok([red, green, blue])
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn tiles_and_colours_are_read() {
        assert_eq!(parse_tile("10/906/404").unwrap(), (10, 906, 404));
        for wrong in ["10/906", "10/1024/0", "a/b/c", "40/0/0"] {
            assert!(parse_tile(wrong).is_err(), "{wrong}");
        }
        assert_eq!(parse_color("#ff8000").unwrap(), [255, 128, 0]);
        assert!(parse_color("white").is_err());
    }
}
