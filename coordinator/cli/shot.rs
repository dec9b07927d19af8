//! One shot from its plan to its files: what `render` and `demo` have in common.

use crate::Outcome;
use crate::farm::{Crew, LocalFarm};
use crate::input::flight;
use crate::input::scene::Scene;
use crate::place::StorePlace;
use crate::progress;
use anyhow::{Context, anyhow, bail};
use indicatif::ProgressBar;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use terrafarm_common::accuracy::{Share, Summary};
use terrafarm_common::camera::Camera;
use terrafarm_common::id::{BlobHash, FrameIndex};
use terrafarm_common::image::Rgb8;
use terrafarm_common::quality::Quality;
use terrafarm_common::region::Split;
use terrafarm_common::shading::Shading;
use terrafarm_coordinator::client::{
    self, ClientError, Coordinator, FrameFacts, Submission, Update,
};
use terrafarm_coordinator::sink::manifest::{FrameEntry, Manifest, WorkerEntry};
use terrafarm_coordinator::sink::{self, Encoder, Finished, FrameSink, Spec};
use terrafarm_film::OrderedFrames;
use terrafarm_terrain::store::{StoreReader, hash_of};
use terrafarm_wire::link::Trust;
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;

/// Frames under way at once unless the user says otherwise: one being written, one whose
/// last jobs run, one that has begun.
pub const FRAMES_IN_FLIGHT: u32 = 3;
/// How long nothing may come back before the user is told why that may be.
const PATIENCE: Duration = Duration::from_secs(8);
/// How long a coordinator that went away is waited for: a PC that restarts takes minutes.
const COORDINATOR_PATIENCE: Duration = Duration::from_secs(15 * 60);

/// Everything that is decided before the first ray.
pub struct Plan {
    /// What to call it.
    pub name: String,
    /// The scene as the user named it, for the manifest.
    pub scene: PathBuf,
    /// What stood in it.
    pub scene_sha256: BlobHash,
    /// The flight as the user named it, for the manifest.
    pub flight: PathBuf,
    /// Its terrain.
    pub store: Arc<StoreReader>,
    /// Light, air and sky.
    pub shading: Shading,
    /// Method, tolerance and samples.
    pub quality: Quality,
    /// What share of the pixels is measured.
    pub check: Share,
    /// How frames are cut into jobs.
    pub split: Split,
    /// Index of the first camera within the flight.
    pub first_frame: FrameIndex,
    /// One camera a frame, all of one size.
    pub cameras: Vec<Camera>,
    /// Frames per second.
    pub fps: f64,
    /// Frames that may be under way at once.
    pub frames_in_flight: u32,
    /// Shots of a higher priority come first.
    pub priority: i32,
    /// Whether somebody waits for each frame.
    pub live: bool,
    /// Where the pictures go.
    pub output: PathBuf,
    /// Who compresses video.
    pub encoder: Encoder,
    /// A frame to be kept as a picture of its own.
    pub poster: Option<(FrameIndex, PathBuf)>,
    /// Who renders.
    pub farm: Farm,
}

/// What is chosen for a flight over a scene.
pub struct Choice<'a> {
    /// The scene file.
    pub scene: &'a Path,
    /// The flight file.
    pub flight: &'a Path,
    /// Size of the picture, pixels.
    pub size: (u32, u32),
    /// Frames per second.
    pub fps: f64,
    /// Frames to render, the end not included; all if `None`.
    pub frames: Option<(FrameIndex, FrameIndex)>,
}

impl Plan {
    /// Opens the terrain of a scene and turns a flight into cameras: local workers, PNG
    /// pictures in the current folder, to be changed by the caller.
    pub fn read(scene: &Scene, choice: &Choice) -> anyhow::Result<Plan> {
        let store = StoreReader::open(&scene.terrain)
            .with_context(|| format!("cannot use the terrain of {}", choice.scene.display()))?;
        let place = StorePlace::new(&store)?;
        let file = flight::read(choice.flight, &place, scene.hfov_deg);
        // A damaged store is the cause of whatever else seems wrong.
        place.check()?;
        let file = file?;
        for warning in &file.warnings {
            eprintln!("terrafarm: warning: {warning}");
        }
        let times = file.flight.frame_times(choice.fps)?;
        let total = times.len() as u32;
        let (first, end) = choice.frames.unwrap_or((0, total));
        if first >= total {
            bail!(
                "--frames {first}..{end}: the flight has {total} frames at {} a second",
                choice.fps
            );
        }
        let cameras = times
            .skip(first as usize)
            .take((end.min(total) - first) as usize)
            .map(|t| file.flight.pose_at(t).camera(choice.size))
            .collect();
        let shading = scene
            .shading(store.index().earth_radius_m, place.middle_convergence_deg())
            .map_err(|why| anyhow!("{}: {why}", choice.scene.display()))?;
        // A store that stands for a scene has an identity already, and may be large.
        let scene_sha256 = if choice.scene == scene.terrain {
            store.index_blob().0
        } else {
            let bytes = std::fs::read(choice.scene);
            hash_of(&bytes.with_context(|| format!("cannot read {}", choice.scene.display()))?)
        };
        Ok(Plan {
            name: choice.scene.display().to_string(),
            scene: choice.scene.to_owned(),
            scene_sha256,
            flight: choice.flight.to_owned(),
            shading,
            quality: scene.quality,
            check: Share::NONE,
            split: Split::Columns,
            first_frame: first,
            cameras,
            fps: choice.fps,
            frames_in_flight: FRAMES_IN_FLIGHT,
            priority: 0,
            live: false,
            output: PathBuf::from("."),
            encoder: Encoder::BuiltIn,
            poster: None,
            farm: Farm::Local(Crew::fill(None, None)),
            store: Arc::new(store),
        })
    }
}

/// Who renders.
pub enum Farm {
    /// Worker processes on this PC.
    Local(Crew),
    /// A coordinator somewhere, and how it is known.
    Remote(String, Trust),
}

/// What became of a shot.
pub struct Report {
    /// What was written.
    pub finished: Finished,
    /// The manifest beside it.
    pub manifest_path: PathBuf,
    /// Its content.
    pub manifest: Manifest,
    /// The errors of the pixels that were measured, all frames together.
    pub errors: Option<Summary>,
    /// Wall time, seconds.
    pub seconds: f64,
}

impl Report {
    /// Whether every frame was rendered.
    pub fn outcome(&self) -> Outcome {
        if self.manifest.failed.is_empty() { Outcome::Done } else { Outcome::FailedFrames }
    }

    /// Frames per second of wall time.
    pub fn frames_per_s(&self) -> f64 {
        self.manifest.frames.len() as f64 / self.seconds.max(1e-9)
    }
}

/// Renders a plan. Ctrl-C stops it; finished pictures of a sequence are kept.
pub async fn carry_out(plan: Plan) -> anyhow::Result<Report> {
    let started = Instant::now();
    let camera = plan.cameras.first().ok_or_else(|| anyhow!("the flight has no frame"))?;
    let spec = Spec {
        width: camera.width,
        height: camera.height,
        fps: plan.fps,
        first: plan.first_frame,
        frames: plan.cameras.len() as u32,
    };
    // Before anything is rendered: an output that cannot be written is no reason to wait.
    let sink = sink::open(&plan.output, spec, plan.encoder)?;
    let farm = match &plan.farm {
        Farm::Local(crew) => Some(LocalFarm::start(*crew).await?),
        Farm::Remote(..) => None,
    };
    let coordinator = match (&plan.farm, &farm) {
        (Farm::Remote(address, trust), _) => {
            let (address, trust) = (address.clone(), trust.clone());
            Coordinator { address, trust, patience: COORDINATOR_PATIENCE }
        }
        (Farm::Local(_), Some(farm)) => farm.coordinator.clone(),
        (Farm::Local(_), None) => unreachable!("a local farm was started above"),
    };
    let stop = CancellationToken::new();
    let interrupt = tokio::spawn({
        let stop = stop.clone();
        async move {
            crate::commands::stop_signal().await;
            stop.cancel();
        }
    });

    let in_flight = plan.frames_in_flight as usize;
    let (updates, inbox) = mpsc::channel(2 * in_flight + 8);
    let (taken, taken_out) = mpsc::channel(in_flight + 8);
    let bar = progress::bar("frames", u64::from(spec.frames));
    let (first_sign, begun) = oneshot::channel();
    let desk = Desk {
        spec,
        first: plan.first_frame,
        poster: plan.poster.clone(),
        bar: bar.clone(),
        first_sign: Some(first_sign),
        workers: 0,
        worst_p99_px: None,
        samples_per_side: plan.quality.samples_per_side,
    };
    let hint = tokio::spawn(say_if_nobody_works(begun, bar.clone(), coordinator.address.clone()));
    let writing = tokio::task::spawn_blocking(move || desk.write(sink, inbox, &taken));
    let submission = Submission {
        name: plan.name.clone(),
        store: plan.store.clone(),
        shading: plan.shading.clone(),
        quality: plan.quality,
        check: plan.check,
        split: plan.split,
        cameras: plan.cameras.clone(),
        frames_in_flight: plan.frames_in_flight,
        priority: plan.priority,
        live: plan.live,
    };
    let deserted = farm.as_ref().map_or_else(CancellationToken::new, |farm| farm.deserted.clone());
    let give_up = tokio::spawn({
        let (deserted, stop) = (deserted.clone(), stop.clone());
        async move {
            deserted.cancelled().await;
            stop.cancel();
        }
    });
    let rendered = client::render(&coordinator, submission, updates, taken_out, stop).await;
    interrupt.abort();
    give_up.abort();
    hint.abort();
    if deserted.is_cancelled() && rendered.is_err() {
        bail!("every local worker ended and would not start again; their messages stand above");
    }
    if let Some(farm) = farm {
        farm.stop().await;
    }
    let written = writing.await.context("the task that writes frames ended early")?;
    bar.finish_and_clear();
    // What went wrong with a file is the cause; that the shot then stopped is not.
    let Written { finished, records, errors, fallbacks, failed } = match (written, &rendered) {
        (Ok(written), _) => written,
        (Err(why), Ok(_) | Err(ClientError::Stopped)) => return Err(why),
        (Err(_), Err(_)) => Written::default(),
    };
    let done = rendered?;
    let finished = finished.ok_or_else(|| anyhow!("the output was not finished"))?;
    let method = plan.quality.method;
    let manifest = Manifest {
        program: format!("terrafarm {}", env!("CARGO_PKG_VERSION")),
        scene: plan.scene.display().to_string(),
        scene_sha256: plan.scene_sha256.to_hex(),
        terrain: plan.store.path().display().to_string(),
        terrain_sha256: plan.store.index_blob().0.to_hex(),
        flight: Some(plan.flight.display().to_string()),
        output: finished.output.display().to_string(),
        method: method.name().to_owned(),
        samples: plan.quality.samples_per_side,
        tolerance_px: method.reads_tolerance().then_some(plan.quality.tolerance_px),
        size: [spec.width, spec.height],
        fps: plan.fps,
        fallbacks: fallbacks.count,
        fallback_share: fallbacks.share(),
        frames: records,
        failed,
        workers: done.workers.iter().map(WorkerEntry::new).collect(),
    };
    let manifest_path = manifest.save(&finished.output)?;
    let seconds = started.elapsed().as_secs_f64();
    Ok(Report { finished, manifest_path, manifest, errors, seconds })
}

/// A farm without workers looks like a slow one: tells the user which it is.
async fn say_if_nobody_works(begun: oneshot::Receiver<()>, bar: ProgressBar, address: String) {
    if tokio::time::timeout(PATIENCE, begun).await.is_err() {
        bar.suspend(|| {
            eprintln!(
                "terrafarm: no worker has finished a job yet; start some with \
                 \"terrafarm worker --coordinator {address}\", or wait"
            );
        });
    }
}

/// Puts frames in order and into the sink.
struct Desk {
    spec: Spec,
    first: FrameIndex,
    poster: Option<(FrameIndex, PathBuf)>,
    bar: ProgressBar,
    /// Told once, when anything comes back.
    first_sign: Option<oneshot::Sender<()>>,
    workers: u32,
    /// The largest 99th percentile of the errors of a frame so far, pixels.
    worst_p99_px: Option<f64>,
    /// Samples along each side of a pixel.
    samples_per_side: u32,
}

/// Samples that a method could not do its own way and gave a ray of their own.
#[derive(Debug, Clone, Copy, Default)]
struct Fallbacks {
    count: u64,
    of: u64,
}

impl Fallbacks {
    fn add(&mut self, more: Fallbacks) {
        self.count += more.count;
        self.of += more.of;
    }

    /// Their share, 0 to 1.
    fn share(self) -> f64 {
        self.count as f64 / self.of.max(1) as f64
    }
}

#[derive(Default)]
struct Written {
    finished: Option<Finished>,
    records: Vec<FrameEntry>,
    errors: Option<Summary>,
    fallbacks: Fallbacks,
    failed: BTreeMap<FrameIndex, String>,
}

impl Desk {
    fn write(
        mut self,
        mut sink: Box<dyn FrameSink>,
        mut inbox: mpsc::Receiver<Update>,
        taken: &mpsc::Sender<FrameIndex>,
    ) -> anyhow::Result<Written> {
        let mut order = OrderedFrames::new(self.spec.frames as usize);
        let mut written = Written::default();
        let mut lost = false;
        while let Some(update) = inbox.blocking_recv() {
            let is_lost = matches!(update, Update::Lost(_));
            let was_lost = std::mem::replace(&mut lost, is_lost);
            if let Some(first_sign) = self.first_sign.take_if(|_| !is_lost) {
                let _ = first_sign.send(());
            }
            match update {
                // Once for each time, however often it is tried.
                Update::Lost(why) if !was_lost => {
                    self.bar.suspend(|| eprintln!("terrafarm: {why}; trying again"));
                }
                Update::Lost(_) => {}
                Update::Progress(progress) => {
                    self.workers = progress.workers;
                    self.say(&written);
                }
                Update::Frame(index, picture, facts) => order.put(index, Some((picture, facts)))?,
                Update::FrameFailed(index, reason) => {
                    let number = self.first + index;
                    self.bar.suspend(|| eprintln!("frame {number} failed: {reason}"));
                    written.failed.insert(number, reason);
                    order.put(index, None)?;
                }
            }
            while let Some((index, frame)) = order.take() {
                self.put(sink.as_mut(), index, frame, &mut written)?;
                // The shot may be over by now; then nobody needs to know.
                let _ = taken.blocking_send(index);
                self.bar.inc(1);
            }
        }
        if order.next() == self.spec.frames {
            self.bar.set_message("finishing the file");
            written.finished = Some(sink.finish()?);
        }
        Ok(written)
    }

    /// Says on the bar who works, how wrong the pictures are, and how much of them the
    /// method could not do its own way.
    fn say(&self, written: &Written) {
        let checked = self.worst_p99_px.map(|px| format!(", error p99 up to {px:.2} px"));
        let fallbacks = written.fallbacks;
        let alone = (fallbacks.count > 0).then(|| {
            format!(", {:.1} % of pixels by rays of their own", 100.0 * fallbacks.share())
        });
        let [checked, alone] = [checked, alone].map(Option::unwrap_or_default);
        self.bar.set_message(format!("on {} workers{checked}{alone}", self.workers));
    }

    fn put(
        &mut self,
        sink: &mut dyn FrameSink,
        index: FrameIndex,
        frame: Option<(Rgb8, FrameFacts)>,
        written: &mut Written,
    ) -> anyhow::Result<()> {
        let Some((picture, facts)) = frame else {
            sink.put(index, &sink::failed_frame(self.spec.width, self.spec.height))?;
            return Ok(());
        };
        sink.put(index, &picture)?;
        if let Some((poster, path)) = &self.poster
            && *poster == index
        {
            sink::poster::save(path, &picture)?;
        }
        let entry = FrameEntry::new(self.first + index, &picture, &facts, self.samples_per_side);
        if let Some(errors) = &facts.check {
            written.errors.get_or_insert_default().merge(errors);
            self.worst_p99_px =
                entry.error_px_p99.into_iter().chain(self.worst_p99_px).reduce(f64::max);
        }
        let pixels = u64::from(self.spec.width) * u64::from(self.spec.height);
        let samples = pixels * u64::from(self.samples_per_side).pow(2);
        written.fallbacks.add(Fallbacks { count: entry.fallbacks, of: samples });
        self.say(written);
        written.records.push(entry);
        Ok(())
    }
}
