//! A coordinator without sockets: farm, queue, workers that paint each frame in the colour
//! of its number, and terrain for them.

use super::super::*;
use crate::Config;
use crate::driver::FarmLine;
use glam::DVec3;
use std::collections::HashMap;
use std::fmt::Debug;
use std::sync::Mutex;
use std::sync::atomic::AtomicBool;
use std::time::Instant;
use terrafarm_common::accuracy::Share;
use terrafarm_common::camera::Camera;
use terrafarm_common::id::WorkerId;
use terrafarm_common::quality::Quality;
use terrafarm_common::region::Split;
use terrafarm_common::shading::Shading;
use terrafarm_terrain::build::{LayerSource, LayerSpec, SourceError, StoreBuilder};
use terrafarm_terrain::layout::{HeightDatum, ImportReport, LayerKind, PostWindow};
use terrafarm_terrain::store::StoreReader;
use terrafarm_wire::Message;
use terrafarm_wire::message::{Done, Grant, RenderReport, Timesheet, WantBlobs};
use terrafarm_wire::pixels::Pixels;
use tokio::sync::Semaphore;
use tokio::task::JoinHandle;

/// How long anything may take before a test gives up on it.
pub const PATIENCE: Duration = Duration::from_secs(60);
pub const SIZE: (u32, u32) = (32, 16);

/// Every grant that was answered: the shot, and the frame's number.
pub type Log = Arc<Mutex<Vec<(ShotId, FrameIndex)>>>;

pub struct House {
    pub queue: Queue,
    pub line: FarmLine,
    config: QueueConfig,
    log: Log,
    task: JoinHandle<()>,
    stop: CancellationToken,
}

/// Settings for tests: five shots in the farm, no reserve.
pub fn config(folder: &Path) -> QueueConfig {
    QueueConfig {
        reserve_bytes: 0,
        active: 5,
        retry: Duration::from_millis(50),
        ..QueueConfig::new(folder)
    }
}

impl House {
    pub async fn open(folder: &Path) -> Self {
        Self::with(config(folder)).await
    }

    pub async fn with(config: QueueConfig) -> Self {
        Self::with_farm(config, Config::default()).await
    }

    pub async fn with_farm(config: QueueConfig, farm: Config) -> Self {
        let stop = CancellationToken::new();
        let line = FarmLine::to_new_farm(farm, stop.clone());
        let deadline = Instant::now() + PATIENCE;
        let (queue, task) = loop {
            match Queue::open(config.clone(), line.clone()).await {
                Ok(open) => break open,
                // Threads of the one before still write.
                Err(QueueError::Locked { .. }) if Instant::now() < deadline => {
                    tokio::task::yield_now().await;
                }
                Err(why) => panic!("{why}"),
            }
        };
        let task = tokio::spawn(task.run(CancellationToken::new()));
        House { queue, line, config, log: Log::default(), task, stop }
    }

    /// Cuts everything off where it is, and begins again.
    pub async fn restart(self) -> Self {
        let config = self.cut_off();
        Self::with(config).await
    }

    /// Cuts everything off where it is.
    pub fn cut_off(self) -> QueueConfig {
        self.task.abort();
        self.stop.cancel();
        self.config
    }

    pub async fn hire(&self, worker: WorkerId) -> JoinHandle<()> {
        self.hire_for(worker, usize::MAX).await
    }

    /// A worker that answers so many grants.
    pub async fn hire_for(&self, worker: WorkerId, jobs: usize) -> JoinHandle<()> {
        tokio::spawn(work(self.line.clone(), worker, jobs, self.log.clone()))
    }

    /// A worker all of whose pixels are wrong; it answers a grant for each permit.
    pub async fn hire_liar(&self, worker: WorkerId, permits: Arc<Semaphore>) -> JoinHandle<()> {
        let (line, log) = (self.line.clone(), self.log.clone());
        tokio::spawn(paint(line, worker, log, permits, 1))
    }

    /// The numbers of the frames that were rendered, in order.
    pub fn rendered(&self) -> Vec<FrameIndex> {
        self.log.lock().unwrap().iter().map(|(_, frame)| *frame).collect()
    }

    /// Every frame that was rendered.
    pub fn log(&self) -> Vec<(ShotId, FrameIndex)> {
        self.log.lock().unwrap().clone()
    }

    /// The numbers of the frames of one shot that were rendered.
    pub fn rendered_of(&self, shot: ShotId) -> Vec<FrameIndex> {
        let log = self.log.lock().unwrap();
        log.iter().filter(|(of, _)| *of == shot).map(|(_, frame)| *frame).collect()
    }

    pub fn shots_rendered(&self) -> Vec<ShotId> {
        self.log.lock().unwrap().iter().map(|(shot, _)| *shot).collect()
    }
}

/// Renders: asks for the whole terrain of a shot, then answers grants by their camera's
/// position.
pub async fn work(line: FarmLine, worker: WorkerId, jobs: usize, log: Log) {
    let permits = Arc::new(Semaphore::new(jobs.min(Semaphore::MAX_PERMITS)));
    paint(line, worker, log, permits, 0).await;
}

/// As [`work`], a grant for each permit, in another colour.
async fn paint(line: FarmLine, worker: WorkerId, log: Log, permits: Arc<Semaphore>, fault: u8) {
    let mut end = line.hire(worker).await;
    let (mut wanted, mut waiting) = (Vec::new(), Vec::<Grant>::new());
    let mut index_of = HashMap::new();
    while let Some(message) = end.recv().await {
        match message {
            Message::OpenShot(open) => {
                let is_known = index_of.insert(open.shot, open.index) == Some(open.index);
                if is_known {
                    continue;
                }
                wanted.push(open.index);
                line.work(worker, WantBlobs { hashes: vec![open.index], elsewhere: true }).await;
            }
            Message::Blob(blob) => {
                wanted.retain(|hash| *hash != blob.hash);
                if let Ok(index) = terrafarm_terrain::store::decode_index(&blob.bytes) {
                    let levels = index.layers.iter().flat_map(|layer| &layer.levels);
                    let tiles = levels.flat_map(|level| &level.entries);
                    let hashes: Vec<_> =
                        tiles.filter(|tile| !tile.is_empty()).map(|tile| tile.hash).collect();
                    wanted.extend(&hashes);
                    line.work(worker, WantBlobs { hashes, elsewhere: true }).await;
                }
            }
            // A patient worker: it asks when it is to render again.
            Message::NoBlob(_) => {}
            Message::Revoke(revoke) => waiting.retain(|grant| grant.lease != revoke.lease),
            Message::Grant(grant) => {
                if !wanted.is_empty() {
                    line.work(worker, WantBlobs { hashes: wanted.clone(), elsewhere: true }).await;
                }
                waiting.push(grant);
            }
            _ => {}
        }
        while wanted.is_empty() && !waiting.is_empty() {
            let grant = waiting.remove(0);
            permits.acquire().await.unwrap().forget();
            let number = grant.camera.position.x as FrameIndex;
            log.lock().unwrap().push((grant.shot, number));
            if !line.work(worker, done(&grant, number, fault)).await {
                return;
            }
        }
    }
}

fn done(grant: &Grant, number: FrameIndex, fault: u8) -> Done {
    let pixels = vec![number as u8 ^ fault; grant.region.area() as usize * 3];
    let report = RenderReport { cost_us: 10, rays: 1, steps: 1, fallbacks: 0, below_ground: false };
    let pixels = Pixels::raw(Bytes::from(pixels)).unwrap();
    let timesheet = Timesheet::default();
    Done { lease: grant.lease, report, timesheet, check: None, pixels }
}

/// A shot whose cameras stand at the numbers of their frames. One job a frame.
pub fn plan(land: &Land, frames: u32) -> ShotPlan {
    let camera = |number: u32| {
        let position = DVec3::new(f64::from(number), 0.1, 0.2);
        Camera::from_angles(position, 10.0, -20.0, 0.0, 60.0, SIZE)
    };
    ShotPlan {
        name: "hills".into(),
        priority: 0,
        index: land.index,
        shading: Shading::default(),
        quality: Quality::default(),
        check: Share::NONE,
        size: [SIZE.0, SIZE.1],
        split: Split::Tiles(64),
        fps: 25.0,
        first_frame: 0,
        cameras: (0..frames).map(camera).collect(),
        frames_in_flight: 3,
        film: None,
        source: Source::default(),
    }
}

/// A little terrain.
pub struct Land {
    pub index: BlobHash,
    pub blobs: Vec<(BlobHash, Bytes)>,
}

struct Slope;

impl LayerSource for Slope {
    fn heights(&self, window: PostWindow, into: &mut [f32]) -> Result<(), SourceError> {
        window.fill(into, |i, j| (i + 3 * j) as f32);
        Ok(())
    }
}

impl Land {
    pub fn new(folder: &Path) -> Self {
        let path = folder.join("land.terrain");
        let mut builder = StoreBuilder::create(&path, "LOCAL", HeightDatum::Unknown, None).unwrap();
        let spec = LayerSpec {
            kind: LayerKind::Height,
            origin: [0.0; 2],
            spacing: [10.0; 2],
            posts: [300, 20],
            quantum_m: Some(1.0),
        };
        builder.add_layer(spec, &Slope, &|_, _| (), &AtomicBool::new(false)).unwrap();
        builder.finish(ImportReport::default()).unwrap();
        let store = StoreReader::open(&path).unwrap();
        let (index, bytes) = store.index_blob();
        let mut blobs = vec![(index, Bytes::copy_from_slice(bytes))];
        let levels = store.index().layers.iter().flat_map(|layer| &layer.levels);
        for tile in levels.flat_map(|level| &level.entries).filter(|tile| !tile.is_empty()) {
            blobs.push((tile.hash, store.read_blob(&tile.hash).unwrap().into()));
        }
        Land { index, blobs }
    }

    pub async fn send(&self, queue: &Queue) {
        for (hash, bytes) in &self.blobs {
            queue.put_blob(*hash, bytes.clone()).await.unwrap();
        }
    }
}

/// Waits until the list is as it should be.
pub async fn until(queue: &Queue, is_so: impl Fn(&ShotList) -> bool) {
    let mut watch = queue.watch();
    let waited = tokio::time::timeout(PATIENCE, watch.wait_for(|list| is_so(list)));
    let last = queue.shots();
    match waited.await {
        Ok(found) => drop(found.unwrap()),
        Err(_) => panic!("did not come; at first {}, now {}", show(&last), show(&queue.shots())),
    }
}

fn show(list: &impl Debug) -> String {
    format!("{list:#?}")
}
