//! How long jobs wait for terrain over a slow link, with and without what lies ahead.
//!
//! A cold worker flies over hills that it has to fetch through a link of so many megabytes a
//! second; its coordinator, in this process, grants one column of a frame after another.
//! `cargo run --release -p terrafarm-worker --example prefetch [MB/s]`

use glam::DVec3;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};
use terrafarm_common::accuracy::Share;
use terrafarm_common::camera::Camera;
use terrafarm_common::id::{BlobHash, LeaseId, ShotId};
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_common::shading::{Shading, Sky, Sun};
use terrafarm_terrain::codec::encode_heights;
use terrafarm_terrain::layout::*;
use terrafarm_terrain::store::hash_of;
use terrafarm_wire::Message;
use terrafarm_wire::link::{Trust, accept, outbox};
use terrafarm_wire::message::{Ahead, Blob, Grant, OpenShot, Timesheet};
use terrafarm_worker::office::Rules;
use terrafarm_worker::{Reconnect, ShareTiles, WorkerConfig, run};
use tokio::net::TcpListener;
use tokio::sync::mpsc;

const SIZE: (u32, u32) = (960, 540);
const FRAMES: u32 = 160;
const COLUMNS: u32 = 4;
/// Posts along a side: 16 tiles.
const POSTS: u64 = 4097;
const SPACING_M: f64 = 10.0;
const SHOT: ShotId = ShotId(1);

struct Land {
    index: BlobHash,
    blobs: BTreeMap<BlobHash, Vec<u8>>,
}

fn height(x: i64, y: i64) -> f32 {
    let fold = |v: i64, period: i64| (v.rem_euclid(2 * period) - period).abs() as f32;
    let rough = ((x * 7919 + y * 104_729) % 97) as f32 / 60.0;
    fold(x, 190) * fold(y, 230) / 90.0 + fold(x + y, 41) * 0.8 + rough
}

fn land() -> Land {
    let mut blobs = BTreeMap::new();
    let mut layer = Layer {
        kind: LayerKind::Height,
        origin: [0.0; 2],
        spacing: [SPACING_M; 2],
        posts: [POSTS; 2],
        levels: Vec::new(),
    };
    for level in 0..Layer::level_count(layer.posts) {
        let tiles = Layer::tiles_for(layer.level_posts(level));
        let places = (0..tiles[1]).flat_map(|ty| (0..tiles[0]).map(move |tx| (tx, ty)));
        let entries = places.map(|place| tile(level, place, &mut blobs)).collect();
        layer.levels.push(Level { tiles, entries });
    }
    let index = StoreIndex {
        version: STORE_VERSION,
        crs: "LOCAL".to_owned(),
        height_datum: HeightDatum::Unknown,
        earth_radius_m: None,
        layers: vec![layer],
        report: ImportReport::default(),
    };
    let bytes = postcard::to_stdvec(&index).expect("an index");
    let hash = hash_of(&bytes);
    blobs.insert(hash, bytes);
    Land { index: hash, blobs }
}

fn tile(level: usize, (tx, ty): (u32, u32), blobs: &mut BTreeMap<BlobHash, Vec<u8>>) -> TileEntry {
    let side = TILE_POSTS as i64;
    let last = POSTS as i64 - 1;
    let post = |at: i64| {
        let (i, j) = (at % side - 1 + i64::from(tx) * 256, at / side - 1 + i64::from(ty) * 256);
        height((i << level).clamp(0, last), (j << level).clamp(0, last))
    };
    let posts: Vec<f32> = (0..side * side).map(post).collect();
    let bytes = encode_heights(&posts, None);
    let hash = hash_of(&bytes);
    let length = bytes.len() as u32;
    blobs.insert(hash, bytes);
    let deviation = if level == 0 { 0.0 } else { 6.0 * level as f32 };
    TileEntry { hash, offset: 4096, length, min: 0.0, max: 600.0, deviation }
}

fn camera(frame: u32) -> Camera {
    let along = f64::from(frame) / f64::from(FRAMES);
    let position = DVec3::new(6e3 + 24e3 * along, 4e3 + 26e3 * along, 900.0);
    Camera::from_angles(position, 42.0 + 10.0 * along, -18.0, 0.0, 60.0, SIZE)
}

/// A worker's time on the first frame and on all others, and the bytes of terrain that it was sent.
async fn fly(land: Arc<Land>, bytes_per_s: f64, told: bool, memory: u64) -> ([Timesheet; 2], u64) {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a socket");
    let folder = tempfile::tempdir().expect("a folder");
    let config = WorkerConfig {
        rules: Rules::default(),
        bandwidth_bytes_per_s: None,
        coordinator: listener.local_addr().expect("an address").to_string(),
        trust: Trust::Loopback,
        name: "cold".to_owned(),
        threads: 1,
        cache_dir: Some(folder.path().to_owned()),
        cache_limit_bytes: 1 << 30,
        memory_limit_bytes: memory,
        share: ShareTiles::Never,
        reconnect: Reconnect::NEVER,
        seed: 1,
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
            let bytes = source.blobs[&hash].clone();
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
        index: land.index,
        shading,
        quality,
        check: Share::NONE,
        width,
        height,
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
    let land = Arc::new(land());
    let bytes: usize = land.blobs.values().map(Vec::len).sum();
    println!(
        "{} blobs, {:.1} MB, made in {:.1} s; {FRAMES} frames of {} x {}",
        land.blobs.len(),
        bytes as f64 / 1e6,
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
