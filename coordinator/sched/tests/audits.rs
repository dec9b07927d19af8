//! Who is found out by an audit, and what becomes of what they rendered.

#![allow(clippy::unwrap_used)]

mod world;

use proptest::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use terrafarm_common::accuracy::Share;
use terrafarm_common::id::{ShotId, WorkerId};
use terrafarm_common::region::Region;
use terrafarm_sched::*;
use world::{Pixels, SECOND, World};

fn audited(percent: u32) -> Config {
    let audit = Share::from_millionths(percent * 10_000).unwrap();
    Config { audit, ..Config::default() }
}

/// A farm in which some workers render something else.
fn farm(percent: u32, workers: u64, others: &[(u64, Pixels)]) -> World {
    let mut world = World::new(audited(percent));
    for worker in 1..=workers {
        world.join(worker, 1, 1.0 + (worker % 3) as f64);
    }
    for &(worker, pixels) in others {
        world.machines.get_mut(&WorkerId(worker)).unwrap().pixels = pixels;
    }
    world
}

fn distrusted(world: &World) -> Vec<(u64, u64)> {
    let distrusted = world.said.iter().filter_map(|(at, action)| match action {
        Action::Distrusted { worker, .. } => Some((*at, worker.0)),
        _ => None,
    });
    distrusted.collect()
}

fn is_over(world: &World) -> bool {
    world.said.iter().any(|(_, action)| matches!(action, Action::ShotComplete { .. }))
}

/// What the film of a shot holds: who rendered which pixels of the frames that were open
/// at the end of the story.
fn merged(world: &World) -> BTreeMap<(u32, Region), u64> {
    let mut merged = BTreeMap::new();
    for (_, action) in &world.said {
        match action {
            Action::Accept { frame, region, lease, .. } => {
                assert_eq!(merged.insert((*frame, *region), lease.0), None, "merged twice");
            }
            Action::Retract { frame, region, .. } => {
                assert!(merged.remove(&(*frame, *region)).is_some(), "taken back, never there");
            }
            _ => {}
        }
    }
    merged
}

#[test]
fn a_share_of_the_jobs_is_rendered_again_by_someone_else_and_agrees() {
    let mut world = farm(10, 5, &[]);
    world.submit(1, 50, 0, 4e6);
    world.play(120 * SECOND, |_| ());
    assert!(is_over(&world));
    let account = world.scheduler.account();
    let share = account.audited as f64 / account.accepted as f64;
    assert!((0.05..0.15).contains(&share), "{account:?}");
    assert_eq!(distrusted(&world), []);
    assert_eq!(world.frames[&ShotId(1)], 50);
    let all_agree = world.said.iter().all(|(_, action)| {
        !matches!(action, Action::Compared { agrees: false, .. } | Action::Disputed { .. })
    });
    assert!(all_agree);
}

#[test]
fn without_audits_nothing_is_audited_and_the_same_happens() {
    let mut world = farm(0, 5, &[(2, Pixels::Wrong)]);
    world.submit(1, 20, 0, 4e6);
    world.play(60 * SECOND, |_| ());
    assert!(is_over(&world) && distrusted(&world).is_empty());
    assert_eq!(world.scheduler.account().audited, 0);
}

#[test]
fn a_worker_that_differs_from_two_others_is_distrusted_and_its_open_work_done_again() {
    let mut world = farm(5, 4, &[(3, Pixels::Wrong)]);
    world.submit(1, 20, 0, 40e6);
    world.play(240 * SECOND, |_| ());
    let [(found_at, 3)] = distrusted(&world)[..] else { panic!("{:?}", distrusted(&world)) };
    println!("found after {} s", found_at as f64 / 1e6);
    let (why, sent) = world
        .said
        .iter()
        .find_map(|(_, action)| match action {
            Action::Distrusted { why, sent, .. } => Some((why.clone(), sent.clone())),
            _ => None,
        })
        .unwrap();
    assert!(why.to_string().contains("which agree"), "{why}");
    assert!(!world.scheduler.blocked(WorkerId(3)).contains(&ShotId(1)));
    // Nothing is granted to it afterwards.
    let machine = &world.machines[&WorkerId(3)];
    assert!(machine.running.is_none() && machine.queue.is_empty());
    // Of the frames that were open, nothing of it is left.
    let retracted = world
        .said
        .iter()
        .filter(|(_, action)| matches!(action, Action::Retract { worker: WorkerId(3), .. }));
    assert!(retracted.count() > 0);
    merged(&world);
    assert!(is_over(&world) && world.frames[&ShotId(1)] == 20);
    let named: Vec<_> = sent.iter().flat_map(|sent| &sent.frames).collect();
    println!("sent with its pixels: {named:?}");
}

#[test]
fn a_worker_that_audits_wrongly_is_found_out_by_a_third() {
    // It renders everything right but what it is asked to compare.
    let mut world = farm(100, 3, &[(2, Pixels::Unsteady(3))]);
    world.submit(1, 30, 0, 4e6);
    world.play(200 * SECOND, |_| ());
    let all: BTreeSet<u64> = distrusted(&world).into_iter().map(|(_, worker)| worker).collect();
    assert_eq!(all, BTreeSet::from([2]));
    assert!(is_over(&world));
}

#[test]
fn of_two_that_keep_to_what_they_say_nobody_is_distrusted_and_both_are_reported() {
    let mut world = farm(20, 2, &[(2, Pixels::Wrong)]);
    world.submit(1, 10, 0, 4e6);
    world.play(120 * SECOND, |_| ());
    assert_eq!(distrusted(&world), []);
    let both = vec![WorkerId(1), WorkerId(2)];
    let disputes = world.said.iter().filter(
        |(_, action)| matches!(action, Action::Disputed { workers, .. } if *workers == both),
    );
    assert!(disputes.count() > 0);
    assert!(is_over(&world), "the shot is not held up");
}

#[test]
fn of_two_the_one_that_contradicts_itself_is_distrusted() {
    let mut world = farm(100, 2, &[(1, Pixels::Unsteady(4))]);
    world.submit(1, 10, 0, 4e6);
    world.play(200 * SECOND, |_| ());
    let all: Vec<u64> = distrusted(&world).into_iter().map(|(_, worker)| worker).collect();
    assert_eq!(all, [1]);
    assert!(is_over(&world));
}

#[test]
fn an_only_worker_is_not_audited() {
    let mut world = farm(100, 1, &[]);
    world.submit(1, 3, 0, 4e6);
    world.play(60 * SECOND, |_| ());
    assert!(is_over(&world));
    assert_eq!(world.scheduler.account().audited, 0);
}

#[test]
fn a_live_shot_is_not_audited_for_workers_may_have_different_terrain() {
    let mut world = farm(100, 4, &[]);
    world.submit_as(1, 3, 0, 4e6, true);
    world.play(60 * SECOND, |_| ());
    assert!(is_over(&world));
    assert_eq!(world.scheduler.account().audited, 0);
}

#[test]
fn an_operator_lifts_distrust_and_one_who_comes_back_keeps_it() {
    let mut world = farm(0, 2, &[]);
    world.submit(1, 1000, 0, 4e6);
    let worker = WorkerId(2);
    world.tell(Event::WorkerDistrusted { worker });
    assert!(world.scheduler.is_distrusted(worker));
    world.play(5 * SECOND, |_| ());
    assert!(world.machines[&worker].running.is_none());
    world.tell(Event::WorkerCleared { worker, shot: None });
    assert!(!world.scheduler.is_distrusted(worker));
    world.play(6 * SECOND, |_| ());
    assert!(world.machines[&worker].running.is_some());
    assert!(world.said.iter().any(|(_, action)| *action == Action::Trusted { worker }));
}

#[test]
fn when_all_are_distrusted_the_shot_waits_for_someone_new() {
    let mut world = farm(0, 1, &[]);
    world.submit(1, 2, 0, 1e6);
    world.tell(Event::WorkerDistrusted { worker: WorkerId(1) });
    world.play(5 * SECOND, |_| ());
    assert_eq!(world.scheduler.why(ShotId(1), 0), Why::NoWorker);
    world.join(2, 1, 1.0);
    world.play(20 * SECOND, |_| ());
    assert!(is_over(&world));
}

#[test]
fn a_frame_does_not_wait_for_its_audit() {
    // The only other worker takes ages: what is audited stays audited for long.
    let mut world = farm(100, 1, &[]);
    world.join(2, 1, 0.000_1);
    world.submit(1, 20, 0, 1e6);
    world.play(30 * SECOND, |_| ());
    assert!(world.frames[&ShotId(1)] >= 15, "{:?}", world.frames);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn a_minority_of_liars_is_found_out_and_no_honest_worker_is(
        workers in 3u64..8, liars in 1u64..3, percent in 3u32..101, steady in any::<bool>(),
        pause in prop::option::of(1u64..20),
    ) {
        let liars = liars.min((workers - 1) / 2);
        let kind = if steady { Pixels::Wrong } else { Pixels::Unsteady(2) };
        let others: Vec<(u64, Pixels)> = (1..=liars).map(|worker| (worker, kind)).collect();
        let mut world = farm(percent, workers, &others);
        world.submit(1, 150, 0, 4e6);
        if let Some(pause) = pause {
            world.play(pause * SECOND, |_| ());
            world.tell(Event::ShotPaused { shot: ShotId(1) });
            world.tell(Event::ShotResumed { shot: ShotId(1) });
        }
        world.play(2000 * SECOND, |_| ());
        let all: BTreeSet<u64> = distrusted(&world).into_iter().map(|(_, worker)| worker).collect();
        prop_assert_eq!(all, (1..=liars).collect::<BTreeSet<u64>>());
        prop_assert!(is_over(&world));
        prop_assert_eq!(world.frames[&ShotId(1)], 150);
        merged(&world);
    }
}
