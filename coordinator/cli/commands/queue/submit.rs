//! `terrafarm submit`: terrain that the coordinator lacks, then the shot.

use super::{Desk, read, say};
use crate::args::queue as args;
use crate::commands::runtime;
use crate::shot::Plan;
use crate::{Outcome, progress};
use anyhow::{Context, bail};
use bytes::Bytes;
use serde::Deserialize;
use serde_json::json;
use std::collections::HashSet;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use terrafarm_common::id::{BlobHash, ShotId};
use terrafarm_coordinator::ask::{Line, Turn};
use terrafarm_coordinator::queue::{Film, MISSING_MAX, ShotPlan, Source, parse_hash};
use terrafarm_coordinator::view::{ShotState, ShotView};
use terrafarm_terrain::store::StoreReader;
use terrafarm_wire::limits::clip_name;
use terrafarm_wire::message::Verb;
use tokio::task::JoinSet;

/// Blobs that are sent at once, each over a line of its own, if the coordinator has places for
/// so many.
const LINES: usize = 4;
/// How often a shot that is waited for is looked at.
const LOOK: Duration = Duration::from_secs(1);

/// Submits, and waits if told to.
pub fn run(args: &args::Submit) -> anyhow::Result<Outcome> {
    let plan = args.shot.plan()?;
    let store = plan.store.clone();
    let shot = shot_plan(args, plan);
    runtime()?.block_on(async {
        let mut desk = Desk::open(&args.office).await?;
        send_terrain(&mut desk, &store).await?;
        #[derive(Deserialize)]
        struct Taken {
            shot: ShotId,
        }
        let body = serde_json::to_vec(&shot).context("cannot write the shot as JSON")?;
        // If the answer is lost, the same is sent again, and is the same shot.
        let path = format!("/api/v1/shots?idempotency_key={}", fresh_key()?);
        let answer = desk.ask(Verb::Post, &path, body.into()).await?;
        let Taken { shot: id } = read(&answer)?;
        if !args.wait {
            return match args.json {
                true => say(&json!({"shot": id}).to_string()),
                false => say(&id.0.to_string()),
            };
        }
        if !args.json {
            eprintln!("terrafarm: {id} is in the queue; Ctrl-C ends the waiting, not the shot");
        }
        let over = wait(&mut desk, id).await?;
        match args.json {
            true => say(&serde_json::to_string_pretty(&over).context("cannot print JSON")?)?,
            false => say(&id.0.to_string())?,
        };
        match over.state {
            ShotState::Done if over.frames_failed == 0 => Ok(Outcome::Done),
            ShotState::Done => Ok(Outcome::FailedFrames),
            _ => bail!("{id} is {}: {}", over.state.name(), over.note),
        }
    })
}

/// A key that nobody else draws.
fn fresh_key() -> anyhow::Result<String> {
    let mut bytes = [0; 16];
    getrandom::fill(&mut bytes).context("the system gives no random numbers")?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

fn shot_plan(args: &args::Submit, plan: Plan) -> ShotPlan {
    let size = plan.cameras.first().map_or([0, 0], |camera| [camera.width, camera.height]);
    let stem = |path: &std::path::Path| {
        path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
    };
    let name = args.name.clone();
    let name = name.unwrap_or_else(|| format!("{} {}", stem(&plan.scene), stem(&plan.flight)));
    ShotPlan {
        name: clip_name(&name),
        priority: plan.priority,
        index: plan.store.index_blob().0,
        shading: plan.shading,
        quality: plan.quality,
        check: plan.check,
        size,
        split: plan.split,
        fps: plan.fps,
        first_frame: plan.first_frame,
        cameras: plan.cameras,
        frames_in_flight: plan.frames_in_flight,
        film: args.film.map(|args::Film::Mp4| Film::Mp4),
        source: Source {
            scene: plan.scene.display().to_string(),
            scene_sha256: plan.scene_sha256.to_hex(),
            terrain: plan.store.path().display().to_string(),
            flight: Some(plan.flight.display().to_string()),
        },
    }
}

/// Sends what the coordinator has not of a store.
async fn send_terrain(desk: &mut Desk, store: &Arc<StoreReader>) -> anyhow::Result<()> {
    #[derive(Deserialize)]
    struct Missing {
        missing: Vec<String>,
    }
    let levels = store.index().layers.iter().flat_map(|layer| &layer.levels);
    let tiles = levels.flat_map(|level| &level.entries).filter(|tile| !tile.is_empty());
    let mut known = HashSet::new();
    let mut hashes: Vec<_> =
        tiles.map(|tile| tile.hash).filter(|&hash| known.insert(hash)).collect();
    hashes.push(store.index_blob().0);
    let mut missing = Vec::new();
    for some in hashes.chunks(MISSING_MAX) {
        let texts: Vec<_> = some.iter().map(|hash| hash.to_hex()).collect();
        let body = json!(texts).to_string().into();
        let answer = desk.ask(Verb::Post, "/api/v1/blobs/missing", body).await?;
        let Missing { missing: texts } = read(&answer)?;
        for text in texts {
            missing.push(parse_hash(&text).context("the coordinator asks for no hash")?);
        }
    }
    let more_lines = missing.len().min(LINES).saturating_sub(1);
    let load = Load {
        store: store.clone(),
        bar: progress::bar("terrain", missing.len() as u64),
        left: Arc::new(Mutex::new(missing)),
        turn: desk.turn.clone(),
    };
    let mut senders = JoinSet::new();
    for _ in 0..more_lines {
        let Some(mut line) = desk.another().await? else { break };
        let load = load.clone();
        senders.spawn(async move { load.send(&mut line).await });
    }
    load.send(&mut desk.line).await?;
    while let Some(sent) = senders.join_next().await {
        sent.context("a task that sends terrain ended early")??;
    }
    load.bar.finish_and_clear();
    Ok(())
}

/// Blobs that are to be sent.
#[derive(Clone)]
struct Load {
    store: Arc<StoreReader>,
    left: Arc<Mutex<Vec<BlobHash>>>,
    bar: indicatif::ProgressBar,
    turn: Arc<Turn>,
}

impl Load {
    /// Sends blobs until none is left.
    async fn send(&self, line: &mut Line) -> anyhow::Result<()> {
        loop {
            let next = self.left.lock().unwrap_or_else(PoisonError::into_inner).pop();
            let Some(hash) = next else { return Ok(()) };
            let from = self.store.clone();
            let read = move || -> anyhow::Result<Bytes> {
                let (index_hash, index) = from.index_blob();
                match hash == index_hash {
                    true => Ok(Bytes::copy_from_slice(index)),
                    false => Ok(from.read_blob(&hash)?.into()),
                }
            };
            let read = tokio::task::spawn_blocking(read).await;
            let bytes = read.context("reading terrain failed")??;
            let path = format!("/api/v1/blobs/{}", hash.to_hex());
            line.ask_again(Verb::Put, &path, None, bytes, &self.turn).await?;
            self.bar.inc(1);
        }
    }
}

/// Looks at a shot until it is over.
async fn wait(desk: &mut Desk, shot: ShotId) -> anyhow::Result<ShotView> {
    let path = format!("/api/v1/shots/{}", shot.0);
    let mut bar = None;
    loop {
        let view: ShotView = desk.get(&path).await?;
        let bar = bar.get_or_insert_with(|| progress::bar("frames", u64::from(view.frames)));
        bar.set_position(u64::from(view.frames_done + view.frames_failed));
        bar.set_message(view.state.name());
        if view.state.is_over() {
            bar.finish_and_clear();
            return Ok(view);
        }
        // A person watches: the API is asked now and then, nothing is decided by it.
        tokio::time::sleep(LOOK).await;
    }
}
