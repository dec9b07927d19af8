//! The queue with a farm and workers inside the test: shots to their files, and every way
//! of being cut off.
#![allow(clippy::unwrap_used)]

mod damaged;
mod full;
pub(crate) mod house;
mod killed;
mod rules;

use super::*;
use crate::sink::manifest::Manifest;
use house::{House, Land, plan, until};
use std::fs;
use terrafarm_common::accuracy::Share;
use terrafarm_common::id::WorkerId;
use terrafarm_common::image::Rgb8;

fn manifest(files: &ShotFiles) -> Manifest {
    serde_json::from_slice(&fs::read(files.manifest()).unwrap()).unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_shot_becomes_pictures_a_film_and_a_manifest() {
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let house = House::open(folder.path()).await;
    let _worker = house.hire(WorkerId(1)).await;
    let mut plan = plan(&land, 7);
    (plan.film, plan.first_frame) = (Some(Film::Mp4), 100);
    let refused = house.queue.submit(plan.clone()).await.unwrap_err();
    assert!(matches!(refused, QueueError::Missing(blobs) if blobs == [land.index]));
    land.send(&house.queue).await;
    let shot = house.queue.submit(plan).await.unwrap();
    assert_eq!(shot, ShotId(1));
    until(&house.queue, |list| list[0].state == ShotState::Done).await;
    let view = house.queue.shot(shot).unwrap();
    assert_eq!((view.frames_done, view.frames_failed, view.note.as_str()), (7, 0, ""));
    let files = house.queue.files(shot).unwrap();
    assert!((100..107).all(|number| files.frame(number).unwrap().is_file()));
    assert_eq!((files.frame(99), files.frame(107)), (None, None));
    assert!(files.film().metadata().unwrap().len() > 100);
    let manifest = manifest(&files);
    assert_eq!(manifest.frames.len(), 7);
    assert_eq!(manifest.frames[6].index, 106);
    assert_eq!(manifest.terrain_sha256, land.index.to_hex());
    assert!(manifest.workers[0].jobs >= 7);
    assert_eq!(house.queue.order(Order::Why(shot, 103)).await.unwrap(), "it is done");
    assert!(matches!(
        house.queue.order(Order::Why(shot, 99)).await,
        Err(QueueError::NoFrame { first: 100, last: 106, .. })
    ));
    assert!(matches!(house.queue.order(Order::Pause(shot)).await, Err(QueueError::Over { .. })));
    assert!(matches!(
        house.queue.order(Order::Pause(ShotId(9))).await,
        Err(QueueError::NoShot(ShotId(9)))
    ));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn orders_take_effect_and_are_there_after_a_restart() {
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let mut house = House::open(folder.path()).await;
    land.send(&house.queue).await;
    let mut shots = Vec::new();
    for _ in 0..3 {
        shots.push(house.queue.submit(plan(&land, 4)).await.unwrap());
    }
    until(&house.queue, |list| list.iter().all(|shot| shot.state == ShotState::Running)).await;
    house.queue.order(Order::Pause(shots[0])).await.unwrap();
    house.queue.order(Order::Cancel(shots[1])).await.unwrap();
    house.queue.order(Order::Prioritise(shots[2], 5)).await.unwrap();
    let why = house.queue.order(Order::Why(shots[0], 0)).await.unwrap();
    assert_eq!(why, "its shot is paused");
    for _ in 0..2 {
        let list = house.queue.shots();
        let states: Vec<_> = list.iter().map(|shot| shot.state).collect();
        assert_eq!(states[..2], [ShotState::Paused, ShotState::Canceled]);
        assert_eq!(list[2].priority, 5);
        house = house.restart().await;
    }
    let _worker = house.hire(WorkerId(1)).await;
    until(&house.queue, |list| list[2].state == ShotState::Done).await;
    assert_eq!(house.queue.shot(shots[0]).unwrap().frames_done, 0);
    house.queue.order(Order::Resume(shots[0])).await.unwrap();
    until(&house.queue, |list| list[0].state == ShotState::Done).await;
    assert_eq!(house.queue.submit(plan(&land, 1)).await.unwrap(), ShotId(4), "no number twice");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn damaged_terrain_stalls_a_shot_until_it_is_sent_again() {
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let house = House::open(folder.path()).await;
    land.send(&house.queue).await;
    let tile = land.blobs[1].0;
    let name = tile.to_hex();
    let shot = house.queue.submit(plan(&land, 3)).await.unwrap();
    fs::write(folder.path().join("blobs").join(&name[..2]).join(&name), b"damaged").unwrap();
    let _worker = house.hire(WorkerId(1)).await;
    until(&house.queue, |list| list[0].state == ShotState::Stalled).await;
    assert!(house.queue.shot(shot).unwrap().note.contains(&name));
    assert_eq!(house.queue.missing_blobs(vec![tile]).await.unwrap(), [tile]);
    land.send(&house.queue).await;
    until(&house.queue, |list| list[0].state == ShotState::Done).await;
    assert_eq!(house.queue.shot(shot).unwrap().frames_failed, 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_submission_that_is_sent_again_with_its_key_is_the_shot_that_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let mut house = House::open(folder.path()).await;
    land.send(&house.queue).await;
    let key = |key: &str, content: &[u8]| SubmissionKey::new(key, content).unwrap();
    let (first, second) = (key("k-1", b"hills"), key("k-2", b"hills"));
    let (one, other) = tokio::join!(
        house.queue.submit_once(plan(&land, 2), first.clone()),
        house.queue.submit_once(plan(&land, 2), first.clone()),
    );
    assert_eq!((one.unwrap(), other.unwrap()), (ShotId(1), ShotId(1)), "at the same time");
    assert_eq!(house.queue.submit_once(plan(&land, 2), second).await.unwrap(), ShotId(2));
    house.queue.order(Order::Cancel(ShotId(1))).await.unwrap();
    for (hash, _) in &land.blobs {
        fs::remove_file(folder.path().join("blobs").join(&hash.to_hex()[..2]).join(hash.to_hex()))
            .unwrap();
    }
    for _ in 0..2 {
        // Over by now, and without its terrain: it was taken all the same.
        assert_eq!(
            house.queue.submit_once(plan(&land, 2), first.clone()).await.unwrap(),
            ShotId(1)
        );
        let reused = house.queue.submit_once(plan(&land, 2), key("k-1", b"valley")).await;
        let shot = ShotId(1);
        assert!(matches!(reused, Err(QueueError::KeyReused { shot: of, .. }) if of == shot));
        house = house.restart().await;
    }
    assert_eq!(house.queue.shots().len(), 2);
    for bad in ["", "a b", "\u{fc}", &"x".repeat(KEY_BYTES_MAX + 1)] {
        assert!(SubmissionKey::new(bad, b"").is_err(), "{bad:?}");
    }
}

#[test]
fn keys_of_submissions_are_forgotten_when_they_are_old_and_not_before() {
    use ledger::{Ledger, ShotRecord, Stage};
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let mut ledger = Ledger::open(&folder.path().join("queue.redb")).unwrap();
    for (number, submitted_s) in [(1, 100), (2, 200), (3, 300)] {
        let (note, workers, history) = (String::new(), Vec::new(), Vec::new());
        let plan = plan(&land, 1);
        let (frames, stage) = (1, Stage::Open);
        let record = ShotRecord { plan, frames, submitted_s, stage, note, workers, history };
        let key = SubmissionKey::new(&format!("k-{number}"), b"").unwrap();
        ledger.add(ShotId(number), &record, &[], Some(&key)).unwrap();
    }
    assert_eq!(ledger.forget_keys(100).unwrap(), 0);
    assert_eq!(ledger.forget_keys(201).unwrap(), 2);
    assert_eq!(ledger.recall("k-2").unwrap(), None);
    assert_eq!(ledger.recall("k-3").unwrap().unwrap().0, ShotId(3));
}

#[cfg(target_os = "linux")]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn terrain_that_the_disk_does_not_read_is_waited_for_and_fails_no_frame() {
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let house = House::open(folder.path()).await;
    land.send(&house.queue).await;
    let name = land.blobs[1].0.to_hex();
    house.queue.submit(plan(&land, 3)).await.unwrap();
    let (blob, aside) = (folder.path().join("blobs").join(&name[..2]).join(&name), "aside");
    fs::rename(&blob, folder.path().join(aside)).unwrap();
    // A file that can be opened, and of which the first byte cannot be read.
    std::os::unix::fs::symlink("/proc/self/mem", &blob).unwrap();
    let _worker = house.hire(WorkerId(1)).await;
    until(&house.queue, |list| list[0].state == ShotState::Stalled).await;
    fs::rename(folder.path().join(aside), &blob).unwrap();
    until(&house.queue, |list| list[0].state == ShotState::Done).await;
    assert_eq!(house.queue.shots()[0].frames_failed, 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn terrain_that_a_power_cut_emptied_is_asked_for_before_the_shot_is_taken() {
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let house = House::open(folder.path()).await;
    land.send(&house.queue).await;
    let house = house.restart().await;
    let (torn, _) = land.blobs[1];
    let name = torn.to_hex();
    fs::write(folder.path().join("blobs").join(&name[..2]).join(name), b"").unwrap();
    let refused = house.queue.submit(plan(&land, 1)).await.unwrap_err();
    assert!(matches!(&refused, QueueError::Missing(blobs) if *blobs == [torn]), "{refused}");
    land.send(&house.queue).await;
    house.queue.submit(plan(&land, 1)).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn damaged_pictures_are_rendered_again_before_the_film_is_made() {
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let house = House::open(folder.path()).await;
    land.send(&house.queue).await;
    let mut plan = plan(&land, 4);
    plan.film = Some(Film::Mp4);
    let shot = house.queue.submit(plan).await.unwrap();
    // One frame of four: the rest comes when the worker does.
    let worker = house.hire_for(WorkerId(1), 1).await;
    until(&house.queue, |list| list[0].frames_done == 1).await;
    worker.abort();
    let files = house.queue.files(shot).unwrap();
    let done = house.queue.shot(shot).unwrap().last_frame.unwrap();
    let path = files.frame(done).unwrap();
    let mut bytes = fs::read(&path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0x55;
    fs::write(&path, bytes).unwrap();
    let _worker = house.hire(WorkerId(2)).await;
    until(&house.queue, |list| list[0].state == ShotState::Done).await;
    let rendered = house.rendered();
    assert_eq!(rendered.iter().filter(|&&frame| frame == done).count(), 2, "{rendered:?}");
    assert_eq!(manifest(&files).frames.len(), 4);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn frames_of_a_worker_that_an_audit_finds_at_fault_are_rendered_again() {
    const FRAMES: u32 = 60;
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let mut farm = crate::Config::default();
    farm.scheduler.audit = Share::from_millionths(1_000_000).unwrap();
    let house = House::with_farm(house::config(folder.path()), farm).await;
    land.send(&house.queue).await;
    let mut plan = plan(&land, FRAMES);
    (plan.film, plan.frames_in_flight) = (Some(Film::Mp4), 16);
    let shot = house.queue.submit(plan).await.unwrap();
    // Alone it is not audited, and what it sends is finished.
    let permits = Arc::new(tokio::sync::Semaphore::new(5));
    let _liar = house.hire_liar(WorkerId(1), permits.clone()).await;
    until(&house.queue, |list| list[0].frames_done == 5).await;
    let _honest = [house.hire(WorkerId(2)).await, house.hire(WorkerId(3)).await];
    until(&house.queue, |list| list[0].frames_done >= 10).await;
    permits.add_permits(FRAMES as usize);
    until(&house.queue, |list| list[0].state == ShotState::Done).await;
    let view = house.queue.shot(shot).unwrap();
    assert_eq!((view.frames_done, view.frames_failed, view.film), (FRAMES, 0, true));
    let what = &view.history[0].what;
    assert!(what.contains("rendered again") && what.contains("worker-1"), "{what}");
    let files = house.queue.files(shot).unwrap();
    for frame in &manifest(&files).frames {
        let pixels = vec![frame.index as u8; (house::SIZE.0 * house::SIZE.1 * 3) as usize];
        let right = Rgb8::from_pixels(house::SIZE.0, house::SIZE.1, pixels).unwrap();
        let hash = crate::sink::pixels_sha256(&right).to_hex();
        assert_eq!(frame.sha256, hash, "frame {}", frame.index);
    }
    // It is remembered with the shot.
    let house = house.restart().await;
    assert_eq!(house.queue.shot(shot).unwrap().history, view.history);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn more_urgent_shots_come_first_and_few_are_in_the_farm() {
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let house = House::open(folder.path()).await;
    land.send(&house.queue).await;
    for _ in 0..40 {
        house.queue.submit(plan(&land, 1)).await.unwrap();
    }
    let mut urgent = plan(&land, 1);
    urgent.priority = 9;
    let urgent = house.queue.submit(urgent).await.unwrap();
    let running =
        |list: &ShotList| list.iter().filter(|shot| shot.state == ShotState::Running).count();
    // The fifth is displaced, and keeps what it has begun.
    until(&house.queue, |list| list[40].state == ShotState::Running && running(list) == 6).await;
    assert_eq!(house.queue.shot(ShotId(6)).unwrap().state, ShotState::Waiting);
    let _worker = house.hire(WorkerId(1)).await;
    until(&house.queue, |list| list.iter().all(|shot| shot.state == ShotState::Done)).await;
    assert_eq!(house.shots_rendered()[0], urgent);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_second_coordinator_is_told_who_holds_the_folder() {
    let folder = tempfile::tempdir().unwrap();
    let house = House::open(folder.path()).await;
    let refused = Queue::open(house::config(folder.path()), house.line.clone()).await;
    let why = refused.err().unwrap().to_string();
    assert!(why.contains(&format!("process {}", std::process::id())), "{why}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn terrain_that_nobody_needs_goes_beyond_its_limit() {
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let house = House::open(folder.path()).await;
    land.send(&house.queue).await;
    house.queue.submit(plan(&land, 2)).await.unwrap();
    // Without grace from here on: before, the first sweep would take what is being sent.
    let mut config = house.cut_off();
    (config.terrain_cache_bytes, config.terrain_grace) = (0, Duration::ZERO);
    let house = House::with(config).await;
    let _worker = house.hire(WorkerId(1)).await;
    until(&house.queue, |list| list[0].state == ShotState::Done).await;
    let all: Vec<_> = land.blobs.iter().map(|(hash, _)| *hash).collect();
    let deadline = std::time::Instant::now() + house::PATIENCE;
    while house.queue.missing_blobs(all.clone()).await.unwrap().len() < all.len() {
        assert!(std::time::Instant::now() < deadline, "terrain stays");
        tokio::task::yield_now().await;
    }
}

/// Not a check but a measurement: `cargo test queue::tests::speed -- --ignored --nocapture`.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "a measurement"]
async fn speed_and_memory() {
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let house = House::open(folder.path()).await;
    land.send(&house.queue).await;
    for (frames, in_flight) in [(300, 3), (1000, 16), (2000, 64)] {
        let mut plan = plan(&land, frames);
        plan.frames_in_flight = in_flight;
        let at = house.queue.shots().len();
        house.queue.submit(plan).await.unwrap();
        let worker = house.hire(WorkerId(1 + u64::from(frames))).await;
        let since = std::time::Instant::now();
        until(&house.queue, |list| list[at].state == ShotState::Done).await;
        let rate = f64::from(frames) / since.elapsed().as_secs_f64();
        println!("{frames} frames of 32 x 16 pixels, {in_flight} in flight: {rate:.0} frames/s");
        worker.abort();
    }
    let before = resident_bytes();
    let since = std::time::Instant::now();
    for _ in 0..10_000 {
        house.queue.submit(plan(&land, 100)).await.unwrap();
    }
    let took = since.elapsed().as_secs_f64();
    let grown = (resident_bytes() - before) >> 10;
    println!("10000 shots of 100 frames: {took:.1} s, {grown} KiB more memory");
    let since = std::time::Instant::now();
    house.queue.order(Order::Pause(ShotId(9000))).await.unwrap();
    println!("an order among them: {:.1} ms", 1e3 * since.elapsed().as_secs_f64());
    let config = house.cut_off();
    let since = std::time::Instant::now();
    let house = House::with(config).await;
    let took = since.elapsed().as_secs_f64();
    println!("opened again: {} shots, {took:.2} s", house.queue.shots().len());
}

/// Memory of this process, bytes; 0 where nobody says.
fn resident_bytes() -> i64 {
    let text = fs::read_to_string("/proc/self/statm").unwrap_or_default();
    text.split(' ').nth(1).and_then(|pages| pages.parse::<i64>().ok()).unwrap_or(0) * 4096
}
