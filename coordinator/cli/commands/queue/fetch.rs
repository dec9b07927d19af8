//! `terrafarm fetch`: the frames or the film of a shot, piece by piece. What was there
//! before a break stays, and what is there is checked rather than fetched again.

use super::Desk;
use crate::args::queue as args;
use crate::commands::runtime;
use crate::{Outcome, progress};
use anyhow::{Context, bail, ensure};
use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{BufReader, Write};
use std::path::{Path, PathBuf};
use terrafarm_common::camera::MAX_SIDE_PX;
use terrafarm_common::image::Rgb8;
use terrafarm_coordinator::sink::manifest::Manifest;
use terrafarm_coordinator::sink::pixels_sha256;
use terrafarm_wire::message::Verb;

/// Bytes that are asked for at once.
const PIECE_BYTES: u64 = 4 << 20;

/// Fetches.
pub fn run(args: &args::Fetch) -> anyhow::Result<Outcome> {
    runtime()?.block_on(async {
        let mut desk = Desk::open(&args.office).await?;
        let shot = format!("/api/v1/shots/{}", args.shot);
        let film = args.output.extension().is_some_and(|extension| extension == "mp4");
        if film {
            let bytes = download(&mut desk, &format!("{shot}/film.mp4"), &args.output).await?;
            super::say(&format!("{}: {bytes} bytes", args.output.display()))?;
            return Ok(Outcome::Done);
        }
        frames(&mut desk, &shot, &args.output).await
    })
}

/// All frames of a shot into a folder; its manifest comes last.
async fn frames(desk: &mut Desk, shot: &str, folder: &Path) -> anyhow::Result<Outcome> {
    let path = format!("{shot}/manifest.json");
    let text = desk.ask(Verb::Get, &path, Default::default()).await?.body;
    let manifest: Manifest = serde_json::from_slice(&text)
        .context("the manifest is not understood; is the coordinator of the same version?")?;
    fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))?;
    let bar = progress::bar("frames", manifest.frames.len() as u64);
    for frame in &manifest.frames {
        let path = folder.join(format!("frame_{:05}.png", frame.index));
        if hash(&path).ok().as_deref() != Some(frame.sha256.as_str()) {
            download(desk, &format!("{shot}/frames/{}.png", frame.index), &path).await?;
            let found = hash(&path)?;
            if found != frame.sha256 {
                let _ = fs::remove_file(&path);
                bail!(
                    "frame {} is not what the manifest says: its pixels are {found}, not {}; the \
                     file at the coordinator is damaged",
                    frame.index,
                    frame.sha256
                );
            }
        }
        bar.inc(1);
    }
    for number in manifest.failed.keys() {
        // They stand in the folder as everywhere: marked.
        let path = folder.join(format!("frame_{number:05}.png"));
        let _ = download(desk, &format!("{shot}/frames/{number}.png"), &path).await;
    }
    bar.finish_and_clear();
    put(&folder.join("manifest.json"), &text)?;
    let failed = manifest.failed.len();
    super::say(&format!(
        "{}: {} frames, each as its manifest says{}",
        folder.display(),
        manifest.frames.len(),
        if failed > 0 { format!("; {failed} failed") } else { String::new() }
    ))?;
    Ok(if failed > 0 { Outcome::FailedFrames } else { Outcome::Done })
}

/// Fetches a file, from where an earlier try ended; returns its length. It appears when all
/// of it is here.
async fn download(desk: &mut Desk, from: &str, to: &Path) -> anyhow::Result<u64> {
    let part = beside(to);
    let cannot = |what: &str, path: &Path| format!("cannot {what} {}", path.display());
    let mut file = File::options()
        .create(true)
        .append(true)
        .open(&part)
        .with_context(|| cannot("write", &part))?;
    let mut here = file.metadata().with_context(|| cannot("read", &part))?.len();
    // The last byte is asked for again, so that a finished part learns its length, too.
    if here > 0 {
        here -= 1;
        file.set_len(here).with_context(|| cannot("write", &part))?;
    }
    loop {
        let (range, body) = (Some((here, PIECE_BYTES)), Default::default());
        let answer = desk.line.ask_again(Verb::Get, from, range, body, &desk.turn).await;
        let answer = match answer {
            Ok(answer) => answer,
            Err(why) => {
                if here == 0 {
                    let _ = fs::remove_file(&part);
                }
                return Err(why.into());
            }
        };
        ensure!(!answer.body.is_empty(), "the coordinator sends nothing of {from}");
        file.write_all(&answer.body).with_context(|| cannot("write", &part))?;
        here += answer.body.len() as u64;
        if here >= answer.total {
            break;
        }
    }
    file.sync_all().with_context(|| cannot("write", &part))?;
    fs::rename(&part, to).with_context(|| cannot("write", to))?;
    Ok(here)
}

/// Where a file grows.
fn beside(path: &Path) -> PathBuf {
    let mut name = path.file_name().map_or_else(OsString::new, OsString::from);
    name.push(".part");
    path.with_file_name(name)
}

fn put(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let part = beside(path);
    let write = || {
        let mut file = File::create(&part)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        fs::rename(&part, path)
    };
    write().with_context(|| format!("cannot write {}", path.display()))
}

/// SHA-256 of a frame's pixels, hexadecimal.
fn hash(path: &Path) -> anyhow::Result<String> {
    let file = File::open(path).with_context(|| format!("cannot read {}", path.display()))?;
    let read = || -> anyhow::Result<Rgb8> {
        let mut reader = png::Decoder::new(BufReader::new(file)).read_info()?;
        let (width, height) = (reader.info().width, reader.info().height);
        let rgb = reader.output_color_type() == (png::ColorType::Rgb, png::BitDepth::Eight);
        ensure!(rgb && width <= MAX_SIDE_PX && height <= MAX_SIDE_PX, "it is no frame");
        let mut pixels = vec![0; width as usize * height as usize * 3];
        reader.next_frame(&mut pixels)?;
        Rgb8::from_pixels(width, height, pixels).context("its size is wrong")
    };
    let picture = read().with_context(|| format!("{} is no picture", path.display()))?;
    Ok(pixels_sha256(&picture).to_hex())
}
