//! What the farm shows of itself.

use super::*;
use crate::order::{Order, OrderError};
use crate::shots::Adoption;
use crate::view::{FarmView, ShotState, WorkerState};
use std::time::Instant;
use terrafarm_wire::message::Status;

/// Seconds since 1970 began, when the farm is looked at.
const WALL_S: u64 = 1_800_000_000;

fn look(bench: &mut Bench) -> FarmView {
    bench.farm.view(bench.now, WALL_S)
}

#[test]
fn a_view_says_who_renders_what_and_how_far_it_is() {
    let mut bench = Bench::new();
    bench.join(worker(1), 2);
    bench.submit(10);
    let busy = look(&mut bench);
    let (one, shot) = (&busy.workers[0], &busy.shots[0]);
    assert_eq!((one.state, one.job.map(|job| job.frame)), (WorkerState::Busy, Some(0)));
    assert!(one.jobs_held > 0 && busy.jobs_running == u64::from(one.jobs_held));
    assert_eq!((shot.state, shot.frames, shot.frames_done), (ShotState::Running, 10, 0));
    assert_eq!((shot.eta_s, shot.last_frame, shot.submitted_s), (None, None, WALL_S));
    // What it holds is done; frames wait to be taken, so no more are begun.
    while let Some(lease) = bench.farm.granted.keys().next().copied() {
        let Granted { worker: by, region, .. } = bench.farm.granted[&lease];
        let pixels = Pixels::raw(vec![7; region.area() as usize * 3].into()).unwrap();
        let timesheet = Timesheet { render_us: 900, ..Timesheet::default() };
        let report = RenderReport { cost_us: 900, ..RenderReport::default() };
        bench.say(Peer::Worker(by), Done { lease, pixels, report, timesheet, check: None });
    }
    let done = look(&mut bench);
    let (one, shot) = (&done.workers[0], &done.shots[0]);
    assert_eq!((one.state, shot.frames_done, done.frames_done), (WorkerState::Idle, 2, 2));
    assert_eq!((shot.last_frame, one.jobs_done), (Some(1), done.jobs_done));
    assert!(one.rendering > 0.0 && one.rendering <= 1.0);
    assert!(shot.frames_per_s > 0.0 && shot.eta_s.is_some());
}

#[test]
fn orders_change_what_is_seen_and_unknown_ones_say_what_there_is_not() {
    let mut bench = Bench::new();
    bench.submit(3);
    let shot = look(&mut bench).shots[0].id;
    let order = |bench: &mut Bench, order| {
        let said = bench.farm.order(bench.now, order);
        (said, look(bench).shots.first().map(|shot| (shot.state, shot.priority)))
    };
    let (_, seen) = order(&mut bench, Order::Pause(shot));
    assert_eq!(seen, Some((ShotState::Paused, 0)));
    let (why, _) = order(&mut bench, Order::Why(shot, 2));
    assert!(why.unwrap().contains("paused"));
    let (why, _) = order(&mut bench, Order::Why(shot, 3));
    assert_eq!(why, Err(OrderError::NoFrame { shot, frames: 3, frame: 3 }));
    order(&mut bench, Order::Resume(shot)).0.unwrap();
    let (_, seen) = order(&mut bench, Order::Prioritise(shot, -4));
    assert_eq!(seen, Some((ShotState::Running, -4)));
    let (none, _) = order(&mut bench, Order::Drain(WorkerId(9)));
    assert_eq!(none, Err(OrderError::NoWorker(WorkerId(9))));
    let (_, seen) = order(&mut bench, Order::Cancel(shot));
    assert_eq!(seen, None);
    let (gone, _) = order(&mut bench, Order::Pause(shot));
    assert_eq!(gone, Err(OrderError::NoShot(shot)));
}

#[test]
fn frames_of_the_queue_are_seen_by_their_numbers_in_the_flight() {
    let mut bench = Bench::new();
    bench.join(worker(1), 2);
    bench.join(Peer::Client(CLIENT), 0);
    let camera = Camera::from_angles(DVec3::ZERO, 0.0, 0.0, 0.0, 60.0, SIZE);
    let adoption = |numbers: Vec<u32>| {
        let (shot, submit, cameras) = (ShotId(7), submission(3), vec![camera; 3]);
        let (doubts, _) = tokio::sync::mpsc::unbounded_channel();
        PeerEvent::Adopt(Box::new(Adoption { shot, submit, cameras, numbers, doubts }))
    };
    bench.event(Peer::Client(CLIENT), adoption(vec![117, 140]));
    assert!(look(&mut bench).shots.is_empty(), "a number is missing");
    bench.event(Peer::Client(CLIENT), adoption(vec![117, 140, 141]));
    let view = look(&mut bench);
    assert_eq!(view.workers[0].job.map(|job| job.frame), Some(117));
    // Two frames wait to be taken then, so the third is not begun.
    while let Some(lease) = bench.farm.granted.keys().next().copied() {
        let Granted { worker: by, region, .. } = bench.farm.granted[&lease];
        let pixels = Pixels::raw(vec![7; region.area() as usize * 3].into()).unwrap();
        let (report, timesheet) = (RenderReport::default(), Timesheet::default());
        bench.say(Peer::Worker(by), Done { lease, pixels, report, timesheet, check: None });
    }
    assert_eq!(look(&mut bench).shots[0].last_frame, Some(140));
}

#[test]
fn what_a_worker_says_of_its_caches_is_seen() {
    let mut bench = Bench::new();
    bench.join(worker(1), 8);
    let view = look(&mut bench);
    assert_eq!((view.workers[0].threads_allowed, view.workers[0].cache), (8, None));
    let status = Status {
        memory_bytes: 10,
        memory_limit_bytes: 20,
        disk_bytes: 30,
        disk_limit_bytes: 40,
        damaged: 1,
        given_bytes: 50,
        threads_allowed: 3,
    };
    bench.say(worker(1), status);
    let view = look(&mut bench);
    let cache = view.workers[0].cache.unwrap();
    assert_eq!((view.workers[0].threads_allowed, cache.disk_bytes), (3, 30));
    assert_eq!((view.blobs_damaged, view.given_bytes), (1, 50));
    bench.say(worker(1), Status { threads_allowed: 9, ..status });
    assert_eq!(look(&mut bench).workers[0].threads_allowed, 8, "no more than it has");
}

#[test]
fn a_distrusted_worker_is_cleared_when_no_shot_is_under_way() {
    let mut bench = Bench::new();
    bench.join(worker(1), 2);
    bench.farm.schedule(bench.now, Event::WorkerDistrusted { worker: WorkerId(1) });
    assert!(look(&mut bench).workers[0].distrusted);
    let said = bench.farm.order(bench.now, Order::Clear(WorkerId(1), Some(ShotId(7))));
    assert_eq!(said, Err(OrderError::NoShot(ShotId(7))));
    bench.farm.order(bench.now, Order::Clear(WorkerId(1), None)).unwrap();
    assert!(!look(&mut bench).workers[0].distrusted);
    let nobody = bench.farm.order(bench.now, Order::Clear(WorkerId(2), None));
    assert_eq!(nobody, Err(OrderError::NoWorker(WorkerId(2))));
}

#[test]
fn a_view_of_1000_workers_and_256_shots_takes_the_driver_milliseconds() {
    let mut bench = Bench::new();
    let camera = Camera::from_angles(DVec3::ZERO, 0.0, 0.0, 0.0, 60.0, SIZE);
    for number in 0..1000 {
        bench.join(worker(number), 8);
    }
    for number in 0..256 {
        // A client has at most 64 shots.
        let client = Peer::Client(ClientId(10_000 + number / 64));
        if number % 64 == 0 {
            bench.join(client, 0);
        }
        let mut submit = submission(20);
        submit.number = number as u32;
        bench.say(client, submit);
        let cameras = vec![camera; 20];
        bench.say(client, Cameras { number: number as u32, first: 0, cameras });
    }
    let mut times: Vec<_> = (0..9)
        .map(|_| {
            let since = Instant::now();
            let view = look(&mut bench);
            assert_eq!((view.workers.len(), view.shots.len()), (1000, 256));
            since.elapsed()
        })
        .collect();
    times.sort();
    println!("a view of 1000 workers and 256 shots: {times:?}");
    assert!(times[4].as_millis() < 20, "{times:?}");
}
