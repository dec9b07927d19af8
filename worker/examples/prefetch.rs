//! How long jobs wait for terrain over a slow link, with and without what lies ahead.
//!
//! A cold worker flies over hills that it has to fetch through a link of so many megabytes a
//! second; its coordinator, in this process, grants one column of a frame after another.
//! `cargo run --release -p terrafarm-worker --example prefetch [MB/s]`

use glam::DVec3;
use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};
use terrafarm_common::accuracy::Share;
use terrafarm_common::camera::Camera;
use terrafarm_common::id::{BlobHash, LeaseId, ShotId};
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_common::shading::{Shading, Sky, Sun};
use terrafarm_terrain::build::{LayerSource, LayerSpec, SourceError, StoreBuilder};
use terrafarm_terrain::layout::{HeightDatum, ImportReport, LayerKind, PostWindow};
use terrafarm_terrain::store::StoreReader;
use terrafarm_wire::Message;
use terrafarm_wire::link::{Trust, accept, outbox};
use terrafarm_wire::message::{Ahead, Blob, Grant, OpenShot, Timesheet};
use terrafarm_worker::office::Rules;
use terrafarm_worker::{Reconnect, ShareTiles, Whereabouts, WorkerConfig, run};
use tokio::net::TcpListener;
use tokio::sync::mpsc;

const SIZE: (u32, u32) = (960, 540);
const FRAMES: u32 = 160;
const COLUMNS: u32 = 4;
/// Posts along a side: 16 tiles.
const POSTS: u64 = 4097;
const SPACING_M: f64 = 10.0;
const SHOT: ShotId = ShotId(1);

struct Hills;

impl LayerSource for Hills {
    fn heights(&self, window: PostWindow, into: &mut [f32]) -> Result<(), SourceError> {
        let fold = |v: u64, period: u64| (v % (2 * period)).abs_diff(period) as f32;
        window.fill(into, |x, y| {
            let rough = ((x * 7919 + y * 104_729) % 97) as f32 / 60.0;
            fold(x, 190) * fold(y, 230) / 90.0 + fold(x + y, 41) * 0.8 + rough
        });
        Ok(())
    }
}

fn land(folder: &Path) -> StoreReader {
    let path = folder.join("hills.terrain");
    let spec = LayerSpec {
        kind: LayerKind::Height,
        origin: [0.0; 2],
        spacing: [SPACING_M; 2],
        posts: [POSTS; 2],
        quantum_m: None,
    };
    let mut builder =
        StoreBuilder::create(&path, "LOCAL", HeightDatum::Unknown, None).expect("a file");
    builder.add_layer(spec, &Hills, &|_, _| (), &AtomicBool::new(false)).expect("heights");
    builder.finish(ImportReport::default()).expect("a store");
    StoreReader::open(&path).expect("a store")
}

/// A blob of a store: its index or a tile.
fn blob(land: &StoreReader, hash: BlobHash) -> Vec<u8> {
    let (index_hash, index) = land.index_blob();
    match hash == index_hash {
        true => index.to_vec(),
        false => land.read_blob(&hash).expect("a tile of the store"),
    }
}

fn camera(frame: u32) -> Camera {
    let along = f64::from(frame) / f64::from(FRAMES);
    let position = DVec3::new(6e3 + 24e3 * along, 4e3 + 26e3 * along, 900.0);
    Camera::from_angles(position, 42.0 + 10.0 * along, -18.0, 0.0, 60.0, SIZE)
}

/// A worker's time on the first frame and on all others, and the bytes of terrain that it was sent.
async fn fly(
    land: Arc<StoreReader>,
    bytes_per_s: f64,
    told: bool,
    memory: u64,
) -> ([Timesheet; 2], u64) {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a socket");
    let folder = tempfile::tempdir().expect("a folder");
    let config = WorkerConfig {
        rules: Rules::default(),
        bandwidth_bytes_per_s: None,
        coordinator: Whereabouts::At(listener.local_addr().expect("an address").to_string()),
        trust: Trust::Loopback,
        name: "cold".to_owned(),
        threads: 1,
        cache_dir: Some(folder.path().to_owned()),
        cache_limit_bytes: 1 << 30,
        memory_limit_bytes: memory,
        share: ShareTiles::Never,
        reconnect: Reconnect::NEVER,
        seed: 1,
        identity: 0,
    };
    let worker = tokio::spawn(run(config, std::future::pending()));
    let (stream, _) = listener.accept().await.expect("a worker");
    let patience = Duration::from_secs(600);
    let greeting = accept(stream, None, "example", patience).await.expect("a greeting");
    let heartbeat = Duration::from_secs(1);
    let (connection, _) =
        greeting.welcome(1, "example", heartbeat, patience).await.expect("a welcome");
    let (mut reader, writer) = connection.split();
    let (outbox, queues) = outbox(4096, 4096);
    let writing = tokio::spawn(writer.run(queues));
    let (asked, mut questions) = mpsc::unbounded_channel::<BlobHash>();
    let (link, source) = (outbox.clone(), land.clone());
    let serving = tokio::spawn(async move {
        let mut sent = 0;
        let mut free_at = Instant::now();
        while let Some(hash) = questions.recv().await {
            let bytes = blob(&source, hash);
            sent += bytes.len() as u64;
            // The link is busy for as long as the blob takes.
            free_at = free_at.max(Instant::now())
                + Duration::from_secs_f64(bytes.len() as f64 / bytes_per_s);
            tokio::time::sleep_until(free_at.into()).await;
            if link.send(Blob { hash, bytes: bytes.into() }).await.is_err() {
                break;
            }
        }
        sent
    });
    let shading = Shading {
        sun: Some(Sun::at(120.0, 40.0, 0.3, 1.0)),
        haze: None,
        sky: Sky::default(),
        earth: None,
        below_ground: [0.1; 3],
        bare_ground: None,
    };
    let quality = Quality { method: Method::Auto, ..Quality::default() };
    let (width, height) = SIZE;
    let open = OpenShot {
        shot: SHOT,
        index: land.index_blob().0,
        shading,
        quality,
        check: Share::NONE,
        width,
        height,
        live: false,
    };
    outbox.send(open).await.expect("open");
    let mut grants: VecDeque<Grant> = (0..FRAMES * COLUMNS)
        .map(|number| {
            let (frame, column) = (number / COLUMNS, number % COLUMNS);
            let part = width / COLUMNS;
            let region = Region { x: column * part, y: 0, width: part, height };
            let lease = LeaseId(u64::from(number) + 1);
            Grant { lease, shot: SHOT, frame, region, camera: camera(frame) }
        })
        .collect();
    // Without a way ahead there is one grant at a time, so that nothing can be foreseen.
    let depth = if told { 2 } else { 1 };
    let mut sums = [Timesheet::default(); 2];
    let mut left = grants.len();
    for grant in grants.drain(..depth).collect::<Vec<_>>() {
        outbox.send(grant).await.expect("grant");
    }
    while left > 0 {
        match reader.recv().await.expect("a message") {
            Some(Message::WantBlobs(want)) => {
                want.hashes.into_iter().for_each(|hash| asked.send(hash).expect("a server"));
            }
            Some(Message::Done(done)) => {
                left -= 1;
                let later = done.lease.0 > u64::from(COLUMNS);
                sums[usize::from(later)].add(&done.timesheet);
                if let Some(grant) = grants.pop_front() {
                    if told && grant.frame % 128 == 0 && grant.region.x == 0 {
                        let first = grant.frame + 8;
                        let frames = (first..FRAMES).step_by(8).take(32);
                        let cameras: Vec<_> = frames.map(camera).collect();
                        let ahead = Ahead { shot: SHOT, first, stride: 8, cameras };
                        outbox.send(ahead).await.expect("ahead");
                    } else if told && left == (FRAMES * COLUMNS) as usize - 1 {
                        let cameras: Vec<_> = (8..FRAMES).step_by(8).map(camera).collect();
                        let ahead = Ahead { shot: SHOT, first: 8, stride: 8, cameras };
                        outbox.send(ahead).await.expect("ahead");
                    }
                    outbox.send(grant).await.expect("grant");
                }
            }
            Some(Message::Failed(failed)) => panic!("{}", failed.reason),
            Some(_) => {}
            None => panic!("the worker left"),
        }
    }
    drop(asked);
    let sent = serving.await.expect("the link");
    worker.abort();
    writing.abort();
    (sums, sent)
}

#[tokio::main]
async fn main() {
    let megabytes: Vec<f64> = std::env::args().skip(1).filter_map(|arg| arg.parse().ok()).collect();
    let megabytes = if megabytes.is_empty() { vec![1.0, 2.0, 4.0, 16.0] } else { megabytes };
    let began = Instant::now();
    let folder = tempfile::tempdir().expect("a folder");
    let land = Arc::new(land(folder.path()));
    println!(
        "{:.1} MB of terrain, made in {:.1} s; {FRAMES} frames of {} x {}",
        land.file_bytes() as f64 / 1e6,
        began.elapsed().as_secs_f64(),
        SIZE.0,
        SIZE.1
    );
    println!("                          first frame  later frames");
    println!("link MB/s  told  memory MB  waited s  seconds  waited             rendered  sent MB");
    for rate in megabytes {
        for (told, memory) in [(false, 1024), (true, 1024)] {
            let ([first, sheet], sent) = fly(land.clone(), rate * 1e6, told, memory << 20).await;
            let share = |us: u64| 100.0 * us as f64 / sheet.total_us() as f64;
            println!(
                "{rate:9}  {told:5}  {memory:8}  {:8.2}  {:7.2}  {:5.2} s = {:5.1} %  {:6.1} %  {:6.1}",
                first.terrain_us as f64 / 1e6,
                sheet.total_us() as f64 / 1e6,
                sheet.terrain_us as f64 / 1e6,
                share(sheet.terrain_us),
                share(sheet.render_us + sheet.coreless_us),
                sent as f64 / 1e6,
            );
        }
    }
}
